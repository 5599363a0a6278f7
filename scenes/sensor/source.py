"""A simulated camera as a source of frames, with the same interface as a recording."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any

import numpy as np

from harness.vocabulary.geometry import Frame, Region
from harness.vocabulary.seeds import random_stream
from scenes.optics import NoiseFreeView
from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.first_order import FirstOrder, first_order
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.camera import AnyCamera
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.common.unit import DecodedFrame, frame_errors_m
from scenes.sensor.empirical.imager import EmpiricalImager
from scenes.sensor.lidar.scanner import LidarScanner


@dataclass(frozen=True)
class SimulatedUnit:
    """A unit of a camera in front of a view: all that its frames share. Build it once, then
    `capture` many times."""

    camera: AnyCamera
    """The camera's numbers."""
    config: CameraConfig
    """The unit, and the effects that are on."""
    view: NoiseFreeView
    """The light before it, with a margin around its own region."""

    @cached_property
    def model(self) -> AmcwImager | LidarScanner | EmpiricalImager:
        """The model of the camera's kind on the view's region; it has `expose` and `frame`."""
        kinds = {
            "amcw_imager": AmcwImager,
            "scanned_lidar": LidarScanner,
            "empirical": EmpiricalImager,
        }
        return kinds[self.camera.kind](self.camera, self.config, self.view.region, self.view.slopes)

    @cached_property
    def exposure(self) -> Any:
        """The noise-free input that all frames share; its type depends on the model."""
        return self.model.expose(self.view)

    @cached_property
    def exposure_share(self) -> float:
        """The mean exposure time of the region's pixels over the camera's longest, chosen once for
        the view; 1 for kinds of camera without exposures."""
        if not isinstance(self.exposure, AmcwExposure):
            return 1.0
        shares = self.exposure.time_share.reshape(self.exposure.shape)
        return float(shares[self.cut].mean())

    @cached_property
    def jitter_mm(self) -> float:
        """Deviation of the small displacement of every frame before this view."""
        if isinstance(self.model, AmcwImager):
            return self.model.jitter_mm(self.exposure)
        return float(self.camera.unit.jitter_mm.value)

    @cached_property
    def first_order(self) -> FirstOrder | None:
        """The first-order model of this view; None if whole frames cost less, or for other
        kinds."""
        if not isinstance(self.model, AmcwImager):
            return None
        wanted = np.zeros(self.view.range_m.shape, bool)
        wanted[self.cut] = True
        return first_order(self.model, self.exposure, wanted, self.jitter_mm)

    @cached_property
    def region(self) -> Region:
        """The view's region without the margin where the filter's window is cut, except at the
        sensor's own border."""
        outer = self.view.region
        lens = self.camera.nominal_lens
        margin = self.camera.optics.margin_px
        return Region(
            outer.row0 + margin * (outer.row0 > 0),
            outer.row1 - margin * (outer.row1 < lens.height),
            outer.col0 + margin * (outer.col0 > 0),
            outer.col1 - margin * (outer.col1 < lens.width),
        )

    @cached_property
    def rgb(self) -> np.ndarray:
        """Colour (h, w, 3) uint8 on the depth pixels, read-only: the albedo, evenly lit, without
        noise of a colour camera."""
        rgb = np.asarray(np.round(255 * self.view.rgb[self.cut]), np.uint8)
        rgb.flags.writeable = False
        return rgb

    @property
    def cut(self) -> tuple[slice, slice]:
        """Slices from the view's region to this unit's region."""
        return self.region.within(self.view.region)

    def capture(self, frames: int, seed: int, *labels: str | int) -> SimulatedCapture:
        """Return ``frames`` exposures with noise of the stream (seed, labels); fewer are a prefix
        of more."""
        return SimulatedCapture(self, frames, seed, labels)


@dataclass(eq=False)
class SimulatedCapture:
    """Frames of one simulated unit; a `harness.vocabulary.geometry.FrameSource`."""

    unit: SimulatedUnit
    """The unit that takes them."""
    n_frames: int
    """Number of frames."""
    seed: int
    """Seed of all noise."""
    labels: tuple[str | int, ...]
    """Names of the noise's stream."""
    organised = True

    def __post_init__(self) -> None:
        camera = self.unit.camera
        self.name = f"simulated {camera.name}"
        self.region = self.unit.region
        self.lens = camera.nominal_lens
        self.z_step_m = camera.z_step_m

    @property
    def slopes(self) -> np.ndarray:
        """Slopes (h, w, 2): x/z and y/z."""
        return self.unit.view.slopes[self.unit.cut]

    @cached_property
    def errors_m(self) -> np.ndarray:
        """Displacements (n_frames,) of each frame as a whole, metres of half path."""
        camera = self.unit.camera
        config = self.unit.config
        stream = random_stream(self.seed, "frame errors", *self.labels)
        errors_m = frame_errors_m(
            camera.unit,
            config.effects,
            minutes=config.minutes_since_power_on,
            jitter_mm=self.unit.jitter_mm,
            rng=stream,
        )
        return np.array(list(islice(errors_m, self.n_frames)))

    def frames(self) -> Iterator[Frame]:
        """Yield the frames; each call repeats the same noise."""
        rng = random_stream(self.seed, "frames", *self.labels)
        cut = self.unit.cut
        for number in range(self.n_frames):
            decoded = self._drawn(float(self.errors_m[number]), rng)
            yield Frame(
                f"frame {number}",
                decoded.z_m[cut],
                decoded.reason[cut],
                rgb=self.unit.rgb,
                amplitude=decoded.amplitude[cut],
            )

    def _drawn(self, error_m: float, rng: np.random.Generator) -> DecodedFrame:
        """Draw a frame, displaced by ``error_m``, on the view's region, by the cheaper model that
        holds."""
        unit = self.unit
        model = unit.first_order
        if model is None or abs(error_m) > model.farthest_error_m:
            return unit.model.frame(unit.exposure, rng, error_m)
        return model.frame(rng, error_m)
