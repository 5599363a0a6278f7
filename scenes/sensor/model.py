"""The seam between a kind of camera and everything that uses cameras: a model turns a view into frames."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from harness.vocabulary.geometry import Region
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.camera import AnyCamera, CameraConfig
from scenes.sensor.decoded import Decoded
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.lidar.scanner import LidarScanner
from scenes.view import NoiseFreeView


class SensorModel(Protocol):
    """A camera of one kind on one region of its sensor: `expose` once per view, then `frame` for each exposure."""

    def expose(self, view: NoiseFreeView) -> Any:
        """Everything of a view that its frames share; only `frame` knows what is in it."""
        ...

    def frame(self, exposure: Any, rng: np.random.Generator, error_m: float = 0.0) -> Decoded:
        """One frame: noise from ``rng``, the camera's processing; ``error_m`` displaces the whole frame's range."""
        ...


def model_of(camera: AnyCamera, config: CameraConfig, region: Region, slopes: np.ndarray) -> SensorModel:
    """The model of a camera's kind on a region whose pixels look along ``slopes`` (h, w, 2)."""
    if isinstance(camera, ScannedLidar):
        return LidarScanner(camera, config, region, slopes)
    return AmcwImager(camera, config, region, slopes)
