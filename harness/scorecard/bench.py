"""The bench: a camera before a scene of known geometry, and the frames that it takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.vocabulary.geometry import Region
from scenes.sensor.camera import NO_EFFECTS, AnyCamera, CameraConfig, EffectsConfig, load_camera
from scenes.sensor.source import SimulatedUnit
from scenes.view import NoiseFreeView

SEED = 1
"""Of all noise on the bench; streams differ by camera and scene."""
NOISE = NO_EFFECTS.model_copy(update={"noise": True, "ambient": True, "saturation": True})
"""What the calibration point speaks of: the noise of each pixel, without traits of a unit or of a frame."""
WHOLE = EffectsConfig()
"""The camera as it is."""


@dataclass(frozen=True)
class Effort:
    """How many frames each kind of measurement takes, and on how many units a unit's error is judged."""

    noise_frames: int
    valid_frames: int
    edge_frames: int
    bias_frames: int
    whole_frames: int
    units: int


FULL = Effort(noise_frames=80, valid_frames=12, edge_frames=12, bias_frames=12, whole_frames=400, units=10)
QUICK = Effort(noise_frames=20, valid_frames=4, edge_frames=4, bias_frames=4, whole_frames=80, units=4)


@dataclass(frozen=True)
class Bench:
    """One camera, the effort spent on it, and the folder of stored renders."""

    camera_name: str
    effort: Effort
    renders: Path

    @property
    def camera(self) -> AnyCamera:
        """The camera of the file."""
        return load_camera(self.camera_name)

    def patch(self, height: int, width: int) -> Region:
        """Pixels about the optical axis, with the margin that the camera's own filter needs, within the sensor."""
        lens, margin = self.camera.nominal_lens, self.camera.optics.margin_px
        row, column = round(lens.cy) - height // 2, round(lens.cx) - width // 2
        tight = Region(row, row + height, column, column + width)
        return tight.grown(margin, lens.height, lens.width)

    def unit(self, view: NoiseFreeView, effects: EffectsConfig, unit_seed: int = 1) -> SimulatedUnit:
        """A unit of the camera before a view."""
        return SimulatedUnit(
            self.camera, CameraConfig(name=self.camera_name, unit_seed=unit_seed, effects=effects), view
        )


@dataclass(frozen=True)
class Stack:
    """Frames of a static scene: ``z_m`` (n, h, w), NaN where invalid; ``true_z_m`` (h, w); ``amplitude`` (h, w) mean
    over frames in the camera's units; ``slopes`` (h, w, 2)."""

    z_m: np.ndarray
    true_z_m: np.ndarray
    amplitude: np.ndarray
    slopes: np.ndarray

    @property
    def everywhere(self) -> np.ndarray:
        """(h, w) bool, all true."""
        return np.ones(self.true_z_m.shape, bool)


def taken(unit: SimulatedUnit, frames: int, *labels: str | int) -> Stack:
    """``frames`` frames of a unit; the noise is the stream of the labels."""
    view, cut = unit.view, unit.cut
    z_m = np.empty((frames, *unit.region.shape))
    amplitude = np.zeros(unit.region.shape)
    for number, frame in enumerate(unit.capture(frames, SEED, "scorecard", *labels).frames()):
        z_m[number] = frame.z_m
        amplitude += 0.0 if frame.amplitude is None else frame.amplitude / frames
    true_z_m = view.range_m[cut] / np.sqrt(1 + (view.slopes[cut] ** 2).sum(axis=-1))
    return Stack(z_m, true_z_m, amplitude, view.slopes[cut])
