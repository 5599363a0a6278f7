"""A capture: frames of one static camera, simulated or real, and the cloud that their average makes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Literal, Protocol

import numpy as np

from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens


class Reason(IntEnum):
    """The reason why a pixel has no range. A recording only says NO_RETURN; a simulated camera names the gate."""

    VALID = 0
    NO_RETURN = 1
    """The file holds the code for 'no depth' (0), or the ray met nothing."""
    SATURATED = 2
    """A sample reached the converter's limit."""
    LOW_AMPLITUDE = 3
    """Too little modulated light."""
    AMPLITUDE_RATIO = 4
    """The amplitudes of the modulation frequencies disagree (a mixed pixel)."""
    UNWRAP = 5
    """The phases of the modulation frequencies fit no single distance."""
    EDGE = 6
    """The neighbourhood's phases differ too much."""
    OUT_OF_RANGE = 7
    """A distance beyond the camera's limits."""
    OUTSIDE_MASK = 8
    """Outside the illuminated field."""
    LOW_REFLECTIVITY = 9
    """Amplitude times distance squared too small."""
    NOT_FINITE = 10
    """The file holds NaN or infinity."""


@dataclass(frozen=True)
class Frame:
    """One exposure.

    ``z_m`` (h, w) float32: distance along the optical axis, NaN where invalid. ``reason`` (h, w) uint8 of `Reason`.
    ``xy_m`` (h, w, 2) only where the source has no lens (a stored point cloud). ``rgb`` (h, w, 3) uint8 and
    ``amplitude`` (h, w) float32 where known. ``name`` says in messages which frame it is. ``notes``: how its stored
    numbers were understood, where that was not plain.
    """

    name: str
    z_m: np.ndarray
    reason: np.ndarray
    xy_m: np.ndarray | None = None
    rgb: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    notes: tuple[str, ...] = ()


class FrameSource(Protocol):
    """A source of frames: a simulated camera or a recording. Frames are streamed, never all held.

    ``slopes`` (h, w, 2) are x/z and y/z per pixel, None where each frame carries ``xy_m``. ``organised`` is False for a
    cloud without a pixel grid (then h == 1). ``z_step_m`` is the rounding step of the stored distance (0 if none).
    """

    @property
    def name(self) -> str: ...
    @property
    def region(self) -> Region: ...
    @property
    def lens(self) -> Lens | None: ...
    @property
    def slopes(self) -> np.ndarray | None: ...
    @property
    def organised(self) -> bool: ...
    @property
    def z_step_m(self) -> float: ...
    def frames(self) -> Iterator[Frame]:
        """Yield the frames in order; each call starts again from the first."""
        ...


@dataclass(frozen=True)
class LeftOut:
    """A frame that averaging did not use, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class MapViews:
    """The views that a map was made from. ``T_cloud_cameras`` (k, 4, 4): their camera frames to the map's; ``shares``
    (k,): their weights in it, which sum to 1. ``pixel_m``: along x and y the sides of a rectangle that spreads as far
    as their pixels do on its surface."""

    T_cloud_cameras: np.ndarray
    shares: np.ndarray
    pixel_m: tuple[float, float]


@dataclass(frozen=True)
class Cloud:
    """The average of frames as points in the camera's frame: what a detector sees.

    ``points_m`` (h, w, 3) float64, NaN where invalid; ``reason`` (h, w) uint8 of `Reason` (the commonest among the
    frames where no sample was valid); ``count`` (h, w) valid samples; ``variance_m2`` (h, w) sample variance of one
    frame's z, NaN below two samples. An unorganised cloud has h == 1 and ``organised`` False. ``region`` places the
    grid on the sensor; ``z_step_m`` is the rounding step of one frame's z.

    A map of several views is a cloud too: its frame is its maker's, with z away from the viewer. ``projection`` says
    how its grid samples space: "central" (rays through the origin, a camera) or "parallel" (equal cells in x and y, a
    map). ``mean_variance_m2`` (h, w): variance of the point's z itself, systematic parts included, where its maker
    states it; a plain average does not. ``map_views``: of a map, what it was made from, where its maker says.
    ``noise_reach_px``: the distance at which pixels no longer share their noise, which is the side of the square that
    filter and interpolation blur over; 0 where nobody measured it.
    """

    points_m: np.ndarray
    reason: np.ndarray
    count: np.ndarray
    variance_m2: np.ndarray
    region: Region
    z_step_m: float
    n_frames: int
    organised: bool = True
    lens: Lens | None = None
    rgb: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    left_out: tuple[LeftOut, ...] = field(default=())
    projection: Literal["central", "parallel"] = "central"
    mean_variance_m2: np.ndarray | None = None
    map_views: MapViews | None = None
    noise_reach_px: float = 0.0

    @property
    def valid(self) -> np.ndarray:
        """(h, w) bool: pixels with a point."""
        return np.isfinite(self.points_m[..., 2])
