"""The seam between a kind of camera and everything that uses cameras: a model turns a view into frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from harness.vocabulary.geometry import Region
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.camera import AnyCamera, CameraConfig
from scenes.sensor.decoded import Decoded
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.lidar.scanner import LidarScanner
from scenes.sensor.totals import FrameTotals
from scenes.view import NoiseFreeView


class SensorModel(Protocol):
    """A camera of one kind on one region of its sensor: `expose` once per view, then `frame` for each exposure."""

    def expose(self, view: NoiseFreeView) -> Any:
        """Everything of a view that its frames share; only `frame` knows what is in it."""
        ...

    def frame(self, exposure: Any, rng: np.random.Generator, error_m: float = 0.0) -> Decoded:
        """One frame: noise from ``rng``, the camera's processing; ``error_m`` displaces the whole frame's range."""
        ...

    def at_once(self, exposure: Any, asked: np.ndarray) -> FrameSummer | None:
        """What sums frames without drawing each, at the pixels ``asked`` (h, w) bool; None where this kind of camera,
        or this exposure, has no way that is equal in distribution: then only frames will do."""
        ...


class FrameSummer(Protocol):
    """Sums over frames of one exposure, equal in distribution to those of single frames, for a fraction of their cost.

    ``sure_pixels``: how many pixels have a range in every frame; ``noise_m``: the median over them of the deviation of
    one frame's z, before rounding and without what frames share; ``z_by_error``: by how much of a frame's displacement
    z moves, the median too; ``farthest_error_m``: by how much frames may be displaced.
    """

    @property
    def sure_pixels(self) -> int: ...
    @property
    def noise_m(self) -> float: ...
    @property
    def farthest_error_m(self) -> float: ...
    @property
    def z_by_error(self) -> float: ...
    def totals(
        self, frames: np.ndarray, errors_m: np.ndarray, stream: Callable[[int], np.random.Generator]
    ) -> FrameTotals:
        """Sums over the frames of numbers ``frames`` (t,), displaced by ``errors_m`` (t,). Noise is from the random
        streams of blocks of frames, so that a frame has the same, whichever others are asked for."""
        ...


def model_of(camera: AnyCamera, config: CameraConfig, region: Region, slopes: np.ndarray) -> SensorModel:
    """The model of a camera's kind on a region whose pixels look along ``slopes`` (h, w, 2)."""
    if isinstance(camera, ScannedLidar):
        return LidarScanner(camera, config, region, slopes)
    return AmcwImager(camera, config, region, slopes)
