"""Frames, and averages of frames, through a filter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors.averages.average import AverageConfig, prefix_averages
from detectors.filters import DepthFilterConfig, load_filter
from detectors.filters.interface import DepthFilter, DepthFunction
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Frame, FrameSource, Lens, Reason, Region, rays_of

USUAL_UNIT_M = 1 * MM
"""Step of the stored depth where it is unknown, which most drivers use."""


@dataclass(frozen=True)
class FilteredFrames:
    """The frames of a source through a filter: a `FrameSource`. The scatter of its frames no
    longer shows the error of their average, as filters correlate frames or pixels."""

    source: FrameSource
    """The frames; they have a lens."""
    depth_filter: DepthFilter
    """The filter."""

    @property
    def name(self) -> str:
        """The source's name, and the filter's."""
        return f"{self.source.name} through {self.depth_filter.name}"

    @property
    def region(self) -> Region:
        """The source's region."""
        return self.source.region

    @property
    def lens(self) -> Lens | None:
        """The source's lens."""
        return self.source.lens

    @property
    def slopes(self) -> np.ndarray | None:
        """The source's slopes (h, w, 2)."""
        return self.source.slopes

    @property
    def organised(self) -> bool:
        """The source's, which has a pixel grid."""
        return self.source.organised

    @property
    def z_step_m(self) -> float:
        """The source's rounding step."""
        return self.source.z_step_m

    def frames(self) -> Iterator[Frame]:
        """Yield the filtered frames; each call starts the filter anew. Raises UserError for a
        source without pixel grid and lens, and for a filter that changes the size."""
        if self.source.slopes is None:
            raise _without_lens(self.source)
        unit_m = self.z_step_m or USUAL_UNIT_M
        function = self.depth_filter.started(unit_m, whole=self.z_step_m > 0)
        for frame in self.source.frames():
            z_m = _through(function, frame.z_m, self.depth_filter.name)
            reason = _reasons(frame.reason, z_m, frame.z_m)
            yield replace(frame, z_m=z_m, reason=reason)


def averages_through(
    source: FrameSource,
    counts: Sequence[int],
    average: AverageConfig,
    config: DepthFilterConfig | None,
) -> dict[int, Cloud]:
    """Return the averages of the first n frames for each n in ``counts``, by `prefix_averages`,
    with a filter before or behind them. Raises UserError."""
    if config is None:
        return prefix_averages(source, counts, average)
    depth_filter = load_filter(config.name, config.settings)
    if config.acts_on == "frames":
        return prefix_averages(FilteredFrames(source, depth_filter), counts, average)
    clouds = prefix_averages(source, counts, average)
    if source.slopes is None:
        raise _without_lens(source)
    slopes = source.slopes
    return {n: filtered_average(cloud, slopes, depth_filter) for n, cloud in clouds.items()}


def filtered_average(cloud: Cloud, slopes: np.ndarray, depth_filter: DepthFilter) -> Cloud:
    """Return an average through a filter, whose pixels lie along ``slopes`` (h, w, 2). The scatter
    of its frames is unknown then."""
    before_m = cloud.points_m[..., 2]
    function = depth_filter.started(cloud.z_step_m or USUAL_UNIT_M, whole=False)
    z_m = _through(function, before_m, depth_filter.name).astype(float)
    rays = rays_of(slopes)
    return replace(
        cloud,
        points_m=rays * z_m[..., None],
        reason=_reasons(cloud.reason, z_m, before_m),
        variance_m2=np.full(z_m.shape, np.nan),
    )


def _without_lens(source: FrameSource) -> UserError:
    """Return the error for stored points, whose x and y a filter of z would leave behind."""
    problem = f"{source.name}: a filter needs depth images with a lens"
    return UserError(problem, fix="name depth images, or leave the filter out")


def _through(function: DepthFunction, z_m: np.ndarray, name: str) -> np.ndarray:
    """Return z (h, w) float32 through a function, NaN where it gives no distance. Raises UserError
    if it changes the size."""
    result = np.asarray(function(z_m.astype(np.float32)), np.float32)
    if result.shape != z_m.shape:
        sizes = [" x ".join(map(str, shape)) for shape in (result.shape, z_m.shape)]
        problem = f"filter {name!r} returns {sizes[0]} pixels for {sizes[1]}"
        raise UserError(problem, legal="depth images of the size that it is given")
    return np.where(np.isfinite(result) & (result > 0), result, np.float32(np.nan))


def _reasons(reason: np.ndarray, after_m: np.ndarray, before_m: np.ndarray) -> np.ndarray:
    """Return why pixels (h, w) lack a distance after a filter."""
    lost = np.isnan(after_m) & np.isfinite(before_m)
    changed = np.where(np.isfinite(after_m), np.uint8(Reason.VALID), reason)
    return np.where(lost, np.uint8(Reason.NO_RETURN), changed)
