"""How much work goes into a render: the declaration that an experiment may hold."""

from __future__ import annotations

from pydantic import Field

from harness.vocabulary.config import Config


class RenderConfig(Config):
    """How much work goes into the indirect light. ``bounces`` 0 leaves direct light only."""

    bounces: int = Field(5, ge=0, le=32, description="reflections beyond the first; albedo 0.6 leaves 5 % after 5")
    face_spacing_mm: float = Field(40.0, gt=0, description="grid of nodes on the face")
    face_samples: int = Field(4096, ge=8, description="paths for each node on the face")
    hole_samples: int = Field(512, ge=8, description="paths for each pixel inside the board's outline but off its face")
    rest_samples: int = Field(32, ge=8, description="paths for each pixel around the board")
    seed: int = Field(1, ge=0)
