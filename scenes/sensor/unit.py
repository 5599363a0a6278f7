"""Errors of range that belong to a unit as a whole or to a frame as a whole, the same for every kind of camera."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np
from scipy import ndimage

from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.sensor.effects import EffectsConfig
from scenes.sensor.facts import UnitFacts


def smooth_field(white: np.ndarray, length_px: float) -> np.ndarray:
    """White noise (h, w) of unit variance made smooth: unit variance, autocorrelation exp(-k^2 / 2 length^2), periodic.

    Through a Gaussian of s it has autocorrelation exp(-k^2 / 4 s^2), so s = length / sqrt 2; its variance falls to the
    kernel's sum of squares, 1 / (4 pi s^2) where s is some pixels and far less than the field.
    """
    s = length_px / np.sqrt(2)
    smooth = ndimage.gaussian_filter(white, s, mode="wrap")
    return np.asarray(smooth / np.sqrt(np.prod([_power(n, s) for n in white.shape])))


def _power(size: int, s: float) -> float:
    """Sum of squares of the periodic Gaussian kernel along an axis of ``size`` pixels."""
    impulse = np.zeros(size)
    impulse[0] = 1.0
    return float((ndimage.gaussian_filter1d(impulse, s, mode="wrap") ** 2).sum())


def static_error_m(facts: UnitFacts, effects: EffectsConfig, camera: str, unit_seed: int) -> float:
    """The unit's constant error of range in metres, drawn from its seed; 0 where the effect is off."""
    if not effects.unit_offset:
        return 0.0
    return float(random_stream(unit_seed, "unit offset", camera).standard_normal()) * facts.offset_mm.value * MM


def drift_m(facts: UnitFacts, effects: EffectsConfig, minutes: float, slope_x: np.ndarray) -> np.ndarray:
    """Error of range in metres ``minutes`` after power-on, for pixels with x/z = ``slope_x``; zeros where off."""
    if not effects.warm_up_drift:
        return np.zeros(slope_x.shape)
    decayed = facts.drift_mm.value * MM * np.exp(-minutes / facts.drift_min.value)
    return np.asarray(decayed * (1 + facts.drift_ramp.value * slope_x))


def frame_errors_m(
    facts: UnitFacts, effects: EffectsConfig, minutes: float, rng: np.random.Generator
) -> Iterator[float]:
    """Endless errors of range in metres, one a frame: jitter in all, a jump of either sign in a few; 0 where off.

    To them comes what the drift, on the axis, has changed since the first frame, ``minutes`` after power-on.
    """
    axis = np.zeros(1)
    first = drift_m(facts, effects, minutes, axis)[0]
    for frame in count():
        now = minutes + frame / facts.frames_per_second.value / 60
        drifted = float(drift_m(facts, effects, now, axis)[0] - first)
        jitter, sign, chance = rng.standard_normal(), rng.choice([-1.0, 1.0]), rng.random()
        jump = sign * facts.jump_mm.value if chance < facts.jump_rate.value else 0.0
        moved = float(jitter * facts.jitter_mm.value + jump) * MM if effects.frame_jumps else 0.0
        yield moved + drifted
