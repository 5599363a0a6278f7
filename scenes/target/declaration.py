"""The front door of target declarations: every kind of target, told apart by ``name``.

    AnyTargetConfig  a TargetConfig ("custom": all parts spelt out), a ThesisTargetConfig ("thesis": the named board) or
                     a DrawnTargetConfig ("drawn": a family of boards with random damage)

Each answers ``declare()`` with the full TargetConfig, which `scenes.target.mesh.build_target` builds.
"""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from scenes.target.custom import (
    BackingConfig,
    BoardConfig,
    CylinderConfig,
    DentConfig,
    FlatConfig,
    HoleConfig,
    MaterialConfig,
    PolynomialConfig,
    PoseConfig,
    RoomConfig,
    SphereConfig,
    TapeConfig,
    TargetConfig,
    TermConfig,
)
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.thesis import OpenFact, ThesisTargetConfig, open_facts

__all__ = [
    "TARGETS",
    "AnyTargetConfig",
    "BackingConfig",
    "BoardConfig",
    "CylinderConfig",
    "DentConfig",
    "DrawnTargetConfig",
    "FlatConfig",
    "HoleConfig",
    "MaterialConfig",
    "OpenFact",
    "PolynomialConfig",
    "PoseConfig",
    "RoomConfig",
    "SphereConfig",
    "TapeConfig",
    "TargetConfig",
    "TermConfig",
    "ThesisTargetConfig",
    "open_facts",
    "target_from_data",
]

AnyTargetConfig = Annotated[ThesisTargetConfig | TargetConfig | DrawnTargetConfig, Field(discriminator="name")]

TARGETS: dict[str, type[ThesisTargetConfig] | type[TargetConfig] | type[DrawnTargetConfig]] = {
    "thesis": ThesisTargetConfig,
    "custom": TargetConfig,
    "drawn": DrawnTargetConfig,
}
"""The kinds by name."""


def target_from_data(data: Any) -> ThesisTargetConfig | TargetConfig | DrawnTargetConfig:
    """Validate plain data (as of YAML and JSON). Raises pydantic.ValidationError; its ``loc`` starts with the kind."""
    return TypeAdapter(AnyTargetConfig).validate_json(json.dumps(data))
