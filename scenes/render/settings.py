"""Work that goes into a render: the declaration that an experiment may hold."""

from __future__ import annotations

from pydantic import Field

from harness.vocabulary.config import Config


class RenderConfig(Config):
    """Work that goes into the indirect light. ``bounces`` 0 leaves direct light only."""

    bounces: int = Field(10, ge=0, le=32, description="reflections beyond the first; albedo 0.6 leaves 0.4 % after 10")
    face_spacing_mm: float = Field(80.0, gt=0, description="grid of nodes on the face")
    face_samples: int = Field(131072, ge=8, description="paths for each node on the face")
    hole_noise_mm: float = Field(
        0.1, gt=0, description="aimed at in pixels inside the board's outline but off its face, as a deviation of range"
    )
    hole_samples: int = Field(8192, ge=8, description="paths for each of those pixels at most")
    rest_samples: int = Field(32, ge=8, description="paths for each pixel around the board")
    seed: int = Field(1, ge=0, le=1_000_000)
