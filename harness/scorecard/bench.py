"""The bench: a camera before a scene of known geometry, the frames that it takes, and numbers with their intervals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from harness.evaluation.intervals import CONFIDENCE, UNKNOWN, Interval, mean_t, wilson
from harness.vocabulary.geometry import Region
from scenes.sensor.camera import NO_EFFECTS, AnyCamera, CameraConfig, EffectsConfig, load_camera
from scenes.sensor.source import SimulatedUnit
from scenes.view import NoiseFreeView

SEED = 1
"""Seed of all noise on the bench; streams differ by camera and scene."""
NOISE = NO_EFFECTS.model_copy(update={"noise": True, "ambient": True, "saturation": True})
"""The noise of each pixel, which the calibration point speaks of, without traits of a unit or of a frame."""
WHOLE = EffectsConfig()
"""All effects of the camera."""
STEADY = WHOLE.model_copy(update={"frame_jumps": False})
JITTER = NOISE.model_copy(update={"frame_jumps": True})
PATTERNED = NOISE.model_copy(update={"fixed_pattern": True})
GROUPS = 10
"""Groups of frames of the jackknife: 9 degrees of freedom, Student's factor 2.26."""


@dataclass(frozen=True)
class Effort:
    """Numbers of frames of each kind of measurement, and of units on which a unit's error is judged."""

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
class FrameStack:
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


def taken(unit: SimulatedUnit, frames: int, *labels: str | int) -> FrameStack:
    """``frames`` frames of a unit; the noise is the stream of the labels."""
    view, cut = unit.view, unit.cut
    z_m = np.empty((frames, *unit.region.shape))
    amplitude = np.zeros(unit.region.shape)
    for number, frame in enumerate(unit.capture(frames, SEED, "scorecard", *labels).frames()):
        z_m[number] = frame.z_m
        amplitude += 0.0 if frame.amplitude is None else frame.amplitude / frames
    true_z_m = view.range_m[cut] / np.sqrt(1 + (view.slopes[cut] ** 2).sum(axis=-1))
    return FrameStack(z_m, true_z_m, amplitude, view.slopes[cut])


# ---- numbers with their intervals ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reading:
    """A value and its two-sided 95 % interval (unknown where nothing repeats); ``nan`` where there was no data."""

    value: float
    interval: Interval = UNKNOWN


NOTHING = Reading(float("nan"))
"""The estimate under a condition in which the camera sees nothing."""


def jackknifed(frames: np.ndarray, statistic: Callable[[np.ndarray], float], groups: int = GROUPS) -> Reading:
    """``statistic`` of ``frames`` (n, ...) with Student's interval from the delete-a-group jackknife over frames.

    Frames must be independent, pixels need not be: what neighbours or a whole frame share is in the interval. Groups
    are interleaved. The interval is unknown below 4 frames. Source: Efron and Tibshirani 1993, chapter 11.
    """
    from scipy.stats import t

    value = float(statistic(frames))
    g = min(groups, len(frames) // 2)
    if g < 2 or not np.isfinite(value):
        return Reading(value)
    number = np.arange(len(frames)) % g
    without = np.array([statistic(frames[number != group]) for group in range(g)])
    half = float(t.ppf(0.5 + CONFIDENCE / 2, g - 1) * np.sqrt((g - 1) / g * ((without - without.mean()) ** 2).sum()))
    return Reading(value, Interval(value - half, value + half) if np.isfinite(half) else UNKNOWN)


def mean_of(values: ArrayLike) -> Reading:
    """The mean of independent values with Student's interval; values that are NaN are left out."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if known.size < 2:
        return Reading(float(known[0])) if known.size else NOTHING
    low, high = mean_t(known.mean(), known.std(ddof=1), known.size)
    return Reading(float(known.mean()), Interval(float(low), float(high)))


def share_of(hits: np.ndarray, pixels_each: float) -> Reading:
    """The share of true values among ``hits`` with Wilson's interval, ``pixels_each`` neighbours counting as one."""
    trials = hits.size / pixels_each
    low, high = wilson(hits.mean() * trials, trials)
    return Reading(float(hits.mean()), Interval(float(low), float(high)))
