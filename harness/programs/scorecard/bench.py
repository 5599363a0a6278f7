"""Places a simulated camera in front of a scene of known geometry and takes frames of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.vocabulary.geometry import Region
from scenes.optics import NoiseFreeView
from scenes.sensor.camera import AnyCamera, camera_of
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit

SEED = 1
NOISE = NO_EFFECTS.model_copy(update={"noise": True, "ambient": True, "saturation": True})
"""Effects of each pixel's noise, to which the calibration point refers, without effects of a unit
or of a frame."""
STEADY = EffectsConfig().model_copy(update={"frame_jumps": False})
PATTERNED = NOISE.model_copy(update={"fixed_pattern": True})


@dataclass(frozen=True)
class Effort:
    """Numbers of frames and units that are simulated for each kind of measurement."""

    noise_frames: int
    """Frames for the noise of single pixels."""
    few_frames: int
    """Frames for shares of pixels and widths of edges, which need few."""
    whole_frames: int
    """Frames for noise that whole frames share, such as jitter and jumps."""
    units: int
    """Units of the camera, for the error of a unit."""


FULL = Effort(noise_frames=80, few_frames=12, whole_frames=400, units=10)
BRIEF = Effort(noise_frames=24, few_frames=3, whole_frames=100, units=10)
"""For comparing a camera with itself: both are measured with the same noise, so that few frames
suffice."""


@dataclass(frozen=True)
class Bench:
    """A camera and the effort of its measurements."""

    camera_name: str
    effort: Effort
    numbers: tuple[tuple[str, Any], ...] = ()
    """Numbers of the camera file that are replaced, by their dotted keys."""

    @property
    def config(self) -> CameraConfig:
        """The camera's declaration, with all effects."""
        return CameraConfig(name=self.camera_name, numbers=dict(self.numbers))

    @property
    def camera(self) -> AnyCamera:
        """The camera of the camera file, with the replaced numbers."""
        return camera_of(self.config)

    def patch(self, height: int, width: int) -> Region:
        """Return pixels about the optical axis with the margin for the camera's own filter,
        clipped to the sensor."""
        lens = self.camera.nominal_lens
        row = round(lens.cy) - height // 2
        column = round(lens.cx) - width // 2
        tight = Region(row, row + height, column, column + width)
        return tight.grown(self.camera.optics.margin_px, lens.height, lens.width)

    def taken(
        self,
        view: NoiseFreeView,
        effects: EffectsConfig,
        frames: int,
        *labels: str | int,
        **settings: Any,
    ) -> FrameStack:
        """Return frames of a unit with ``settings`` of `CameraConfig` and a view; ``labels``
        select the noise."""
        config = self.config.model_copy(update={"effects": effects, **settings})
        unit = SimulatedUnit(self.camera, config, view)
        cut = unit.cut
        taken = unit.capture(frames, SEED, "scorecard", self.camera_name, *labels)
        slopes = view.slopes[cut]
        true_z_m = view.range_m[cut] / np.sqrt(1 + (slopes**2).sum(axis=-1))
        z_m = np.stack([frame.z_m for frame in taken.frames()]).astype(float)
        return FrameStack(z_m, true_z_m, slopes, unit.region)


@dataclass(frozen=True)
class FrameStack:
    """Frames of a static scene."""

    z_m: np.ndarray
    """Frames (n, h, w), NaN where invalid."""
    true_z_m: np.ndarray
    """True z (h, w)."""
    slopes: np.ndarray
    """Slopes (h, w, 2) of the pixels' rays."""
    region: Region
    """The pixels of the sensor."""
