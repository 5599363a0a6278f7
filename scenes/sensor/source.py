"""A simulated camera as a source of frames: the same interface as a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from harness.vocabulary.capture import Frame
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.seeds import random_stream
from scenes.sensor.camera import AnyCamera, CameraConfig
from scenes.sensor.model import SensorModel, model_of
from scenes.sensor.unit import frame_errors_m
from scenes.view import NoiseFreeView


@dataclass(frozen=True)
class SimulatedUnit:
    """One unit of a camera before one view: everything that frames share. Build once, then `capture` many times."""

    camera: AnyCamera
    config: CameraConfig
    view: NoiseFreeView

    @cached_property
    def model(self) -> SensorModel:
        """The camera's model on the view's region."""
        return model_of(self.camera, self.config, self.view.region, self.view.slopes)

    @cached_property
    def exposure(self) -> Any:
        """What the model keeps of the view for all frames."""
        return self.model.expose(self.view)

    @cached_property
    def region(self) -> Region:
        """The view's region less the margin whose filter window is cut, except at the sensor's own border."""
        outer, lens, m = self.view.region, self.camera.nominal_lens, self.camera.optics.margin_px
        return Region(
            outer.row0 + (m if outer.row0 > 0 else 0),
            outer.row1 - (m if outer.row1 < lens.height else 0),
            outer.col0 + (m if outer.col0 > 0 else 0),
            outer.col1 - (m if outer.col1 < lens.width else 0),
        )

    @cached_property
    def rgb(self) -> np.ndarray:
        """(h, w, 3) uint8 colour on the depth pixels: the albedo, evenly lit, without a colour camera's own noise."""
        return np.asarray(np.round(255 * self.view.rgb[self.cut]), np.uint8)

    @property
    def cut(self) -> tuple[slice, slice]:
        """Slices from the view's region to this unit's region."""
        return self.region.within(self.view.region)

    def capture(self, frames: int, seed: int, *labels: str | int) -> SimulatedCapture:
        """``frames`` exposures whose noise is the stream of (seed, labels): prefixes of longer captures are equal."""
        return SimulatedCapture(self, frames, seed, labels)


@dataclass(frozen=True)
class SimulatedCapture:
    """Frames of one simulated unit; a `harness.vocabulary.capture.FrameSource`."""

    unit: SimulatedUnit
    n_frames: int
    seed: int
    labels: tuple[str | int, ...]

    @property
    def name(self) -> str:
        """What messages call this source."""
        return f"simulated {self.unit.camera.name}"

    @property
    def region(self) -> Region:
        """The pixels that frames cover."""
        return self.unit.region

    @property
    def lens(self) -> Lens:
        """The camera's nominal lens."""
        return self.unit.camera.nominal_lens

    @property
    def slopes(self) -> np.ndarray:
        """(h, w, 2) x/z and y/z."""
        return self.unit.view.slopes[self.unit.cut]

    @property
    def organised(self) -> bool:
        """Always: an imager has a pixel grid."""
        return True

    @property
    def z_step_m(self) -> float:
        """The rounding step of the output."""
        return self.unit.camera.z_step_m

    def frames(self) -> Iterator[Frame]:
        """Yield the frames; each call repeats the same noise."""
        rng = random_stream(self.seed, "frames", *self.labels)
        camera, effects = self.unit.camera, self.unit.config.effects
        stream = random_stream(self.seed, "frame errors", *self.labels)
        errors_m = frame_errors_m(camera.unit, effects, self.unit.config.minutes_since_power_on, stream)
        cut = self.unit.cut
        for number in range(self.n_frames):
            decoded = self.unit.model.frame(self.unit.exposure, rng, next(errors_m))
            yield Frame(
                name=f"frame {number}",
                z_m=decoded.z_m[cut],
                reason=decoded.reason[cut],
                rgb=self.unit.rgb,
                amplitude=decoded.amplitude[cut],
            )
