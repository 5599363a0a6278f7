"""The three kinds of target declarations, told apart by ``name``.

``custom`` spells out all parts, ``thesis`` is the named board, ``drawn`` a family of boards with random damage. Each
answers ``declare()`` with the full TargetConfig, which `scenes.target.mesh.build_target` builds.
"""

from __future__ import annotations

import json
from typing import Annotated, Any

from pydantic import Field, TypeAdapter

from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.thesis import ThesisTargetConfig

AnyTargetConfig = Annotated[ThesisTargetConfig | TargetConfig | DrawnTargetConfig, Field(discriminator="name")]

TARGETS: dict[str, type[ThesisTargetConfig] | type[TargetConfig] | type[DrawnTargetConfig]] = {
    "thesis": ThesisTargetConfig,
    "custom": TargetConfig,
    "drawn": DrawnTargetConfig,
}
"""Kinds of targets by name."""


def target_from_data(data: Any) -> ThesisTargetConfig | TargetConfig | DrawnTargetConfig:
    """Validate plain data (as of YAML and JSON). Raises pydantic.ValidationError; its ``loc`` starts with the kind."""
    return TypeAdapter(AnyTargetConfig).validate_json(json.dumps(data))
