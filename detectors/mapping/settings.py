"""Settings that turn registered views into one cloud."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from detectors.crop import AutoCrop, CropConfig
from detectors.marks.mark import ColourMarks, MarksConfig
from detectors.registration.settings import PlainRegistration, RegistrationConfig
from harness.vocabulary.config import Config


class GridMerge(Config):
    """The thesis' merge (MATLAB's pcmerge): all points, averaged within cubes of a grid. Frame: the first view's."""

    kind: Literal["grid"] = "grid"
    step_mm: float = Field(default=0.1, gt=0, le=50)


class FusedMerge(Config):
    """A map over the fitted surface: inverse-variance mean of the views, its variance and count of each cell."""

    kind: Literal["fusion"] = "fusion"
    cell_mm: float | None = Field(default=None, gt=0, le=50, description="none: the first view's pixel pitch")


class VolumeMerge(Config):
    """A truncated signed distance field (Open3D's VoxelBlockGrid). Frame: the first view's."""

    kind: Literal["volume"] = "volume"
    voxel_mm: float | None = Field(default=None, gt=0, le=50, description="none: the first view's pixel pitch")


MergeConfig = Annotated[GridMerge | FusedMerge | VolumeMerge, Field(discriminator="kind")]
AnyMerge = GridMerge | FusedMerge | VolumeMerge


class MappingConfig(Config):
    """Settings of crop (in each view's own frame), marks, registration and merge; ``views``: use the first so many."""

    views: int | None = Field(default=None, ge=1, le=1000)
    crop: CropConfig = Field(default_factory=AutoCrop)
    marks: MarksConfig = Field(default_factory=ColourMarks)
    registration: RegistrationConfig = Field(default_factory=lambda: PlainRegistration(method="marks"))
    merge: MergeConfig = Field(default_factory=FusedMerge)
