"""Light that counts for a camera, and errors of range that belong to a unit as a whole or to a frame as a whole, the
same for every kind of camera."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np
from scipy import ndimage

from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.sensor.camera import AnyCamera, CameraConfig, EffectsConfig
from scenes.sensor.facts import UnitFacts
from scenes.view import NoiseFreeView


def smooth_field(white: np.ndarray, length_px: float) -> np.ndarray:
    """Smooth white noise (h, w) of unit variance: unit variance, autocorrelation exp(-k^2 / 2 length^2), periodic.

    Through a Gaussian of s it has autocorrelation exp(-k^2 / 4 s^2), so s = length / sqrt 2; its variance falls to the
    kernel's sum of squares, 1 / (4 pi s^2) where s is some pixels and far less than the field.
    """
    s = length_px / np.sqrt(2)
    smooth, power = ndimage.gaussian_filter(white, s, mode="wrap"), []
    for size in white.shape:
        impulse = np.zeros(size)
        impulse[0] = 1.0
        power.append(float((ndimage.gaussian_filter1d(impulse, s, mode="wrap") ** 2).sum()))
    return np.asarray(smooth / np.sqrt(np.prod(power)))


def light_of(view: NoiseFreeView, effects: EffectsConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return phasors (f, h, w) and intensity (h, w) of all light, or of direct light only where multipath is off.

    The intensity of the direct part is taken as its longest phasor over the frequencies: exact where one surface fills
    the pixel, too small where the phasors of two surfaces cancel at every frequency.
    """
    if effects.multipath:
        return view.phasor, view.intensity
    return view.phasor_direct, np.minimum(np.abs(view.phasor_direct).max(axis=0), view.intensity)


def unit_error_m(camera: AnyCamera, config: CameraConfig, slope_x: np.ndarray) -> np.ndarray:
    """Return the error of range in metres that all frames of a unit share, for pixels with x/z = ``slope_x``: its drift
    and its constant offset, drawn from its seed, as far as they are on."""
    error = drift_m(camera.unit, config.effects, config.minutes_since_power_on, slope_x)
    if config.effects.unit_offset:
        deviation = float(random_stream(config.unit_seed, "unit offset", camera.name).standard_normal())
        error = error + deviation * camera.unit.offset_mm.value * MM
    return np.asarray(error)


def drift_m(facts: UnitFacts, effects: EffectsConfig, minutes: float, slope_x: np.ndarray) -> np.ndarray:
    """Return the error of range in metres ``minutes`` after power-on, for pixels with x/z = ``slope_x``; zeros where
    off."""
    if not effects.warm_up_drift:
        return np.zeros(slope_x.shape)
    decayed = facts.drift_mm.value * MM * np.exp(-minutes / facts.drift_min.value)
    return np.asarray(decayed * (1 + facts.drift_ramp.value * slope_x))


def frame_errors_m(
    facts: UnitFacts, effects: EffectsConfig, minutes: float, rng: np.random.Generator
) -> Iterator[float]:
    """Yield endless errors of range in metres, one a frame: jitter in all, a jump of either sign in a few; 0 where off.

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
