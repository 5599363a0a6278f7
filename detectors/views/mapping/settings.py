"""Settings that turn registered views into one cloud."""

from typing import Annotated, Literal

from pydantic import Field

from detectors.crop import AutoCrop, CropConfig
from detectors.views.marks.mark import ColourMarks, MarksConfig
from detectors.views.registration.settings import PlainRegistration, RegistrationConfig
from harness.vocabulary.config import Config


class GridMerge(Config):
    """The thesis' merge (MATLAB's pcmerge): the mean of all points in each cube of a grid in the
    first view's frame."""

    kind: Literal["grid"] = "grid"
    step_mm: float = Field(default=0.1, gt=0, le=50, description="side of a cube")


class FusedMerge(Config):
    """A map over the fitted surface. Each cell holds the views' inverse-variance mean, its
    variance and count."""

    kind: Literal["fusion"] = "fusion"
    cell_mm: float | None = Field(
        default=None,
        gt=0,
        le=50,
        description="null: the first view's pixel pitch",
    )


class VolumeMerge(Config):
    """A truncated signed distance field (Open3D's VoxelBlockGrid), in the first view's frame."""

    kind: Literal["volume"] = "volume"
    voxel_mm: float | None = Field(
        default=None,
        gt=0,
        le=50,
        description="null: the first view's pixel pitch",
    )


MergeConfig = Annotated[GridMerge | FusedMerge | VolumeMerge, Field(discriminator="kind")]
AnyMerge = GridMerge | FusedMerge | VolumeMerge


class MappingConfig(Config):
    """Settings of crop (in each view's own frame), marks, registration and merge."""

    views: int | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="number of views to use; null: all",
    )
    crop: CropConfig = Field(default_factory=AutoCrop)
    marks: MarksConfig = Field(default_factory=ColourMarks)
    registration: RegistrationConfig = Field(
        default_factory=lambda: PlainRegistration(method="marks")
    )
    merge: MergeConfig = Field(default_factory=FusedMerge)
