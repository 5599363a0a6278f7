"""Frames and their sums, and the light and range errors of a unit or frame, for every kind of
camera."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import cached_property
from itertools import count
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import scipy.fft
from scipy import ndimage

from harness.vocabulary.geometry import MM, Region
from harness.vocabulary.seeds import canonical_json, random_stream
from scenes.optics import NoiseFreeView
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.common.facts import CameraFacts, UnitFacts

Camera = TypeVar("Camera", bound=CameraFacts)


class DecodedFrame(NamedTuple):
    """A frame of h x w pixels."""

    z_m: np.ndarray
    """(h, w) float32: NaN where ``reason`` is not VALID."""
    reason: np.ndarray
    """(h, w) uint8: the pixel's `Reason`."""
    amplitude: np.ndarray
    """(h, w): in the camera's units."""


def rays_of(slopes: np.ndarray, offset_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, (h, w) each, an offset's (3,) component along each pixel's unit ray, and the ray's
    cosine to the axis."""
    x = slopes[..., 0]
    y = slopes[..., 1]
    length = np.sqrt(x * x + y * y + 1)
    along_m = x * offset_m[0] + y * offset_m[1] + offset_m[2]
    return along_m / length, 1 / length


def smooth_field(white: np.ndarray, length_px: float) -> np.ndarray:
    """Smooth white noise (h, w) to unit variance and autocorrelation exp(-k^2 / 2 length^2),
    periodic."""
    h, w = white.shape
    spectrum = scipy.fft.rfft2(white)
    down = _smoothing_spectrum(h, length_px)
    across = _smoothing_spectrum(w, length_px)[: spectrum.shape[1]]
    return np.asarray(scipy.fft.irfft2(spectrum * down[:, None] * across, white.shape), float)


def _smoothing_spectrum(size: int, length_px: float) -> np.ndarray:
    """Return the spectrum (size,) complex64 of a periodic Gaussian whose squares sum to 1."""
    impulse = np.eye(1, size)[0]
    response = ndimage.gaussian_filter1d(impulse, length_px / np.sqrt(2), mode="wrap")
    spectrum = scipy.fft.fft(response / np.linalg.norm(response))
    return np.asarray(spectrum.astype(np.complex64))


# these reproduce correlations to 0.015
SPECTRUM = 256  # frequencies of a filter's spectrum
LEAST_POWER = 1e-3  # its least power relative to the largest
FAINT = 0.05  # least tap relative to the largest


def taps_of(correlation: np.ndarray) -> np.ndarray:
    """Return causal taps (k,) with a sum of squares of 1 that give white noise this correlation
    (n,) at lags 0 to n - 1: the minimum-phase factor of its spectrum, by the cepstrum (Oppenheim
    and Schafer), as it is short."""
    lags = len(correlation)
    half = SPECTRUM // 2
    circle = np.zeros(SPECTRUM)
    circle[:lags] = correlation
    circle[SPECTRUM - lags + 1 :] = correlation[:0:-1]
    power = np.fft.fft(circle).real
    power = np.maximum(power, LEAST_POWER * power.max())
    # the cepstrum of the amplitude, folded onto positive times, is that of the minimum phase
    cepstrum = np.fft.ifft(0.5 * np.log(power)).real
    cepstrum[1:half] *= 2.0
    cepstrum[half + 1 :] = 0.0
    taps = np.fft.ifft(np.exp(np.fft.fft(cepstrum))).real
    loud = np.abs(taps[:half]) > FAINT * np.abs(taps).max()
    taps = taps[: 1 + int(np.flatnonzero(loud).max())]
    return np.asarray(taps / np.sqrt((taps**2).sum()), np.float32)


def light_of(view: NoiseFreeView, effects: EffectsConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return phasors (f, h, w) and intensity (h, w) of all light or, with multipath off, of direct
    light; intensity is then the longest phasor over the frequencies, too small where two surfaces
    cancel at every frequency."""
    if effects.multipath:
        return view.phasor, view.intensity
    direct = np.abs(view.phasor_direct).max(axis=0)
    return view.phasor_direct, np.minimum(direct, view.intensity)


KEPT_PATTERNS = 4  # whole sensors' patterns that a process keeps for other views of the same unit
_patterns_mm: dict[tuple[Any, ...], np.ndarray] = {}


class UnitModel(ABC, Generic[Camera]):
    """A unit of a camera on a region of its sensor whose central rays have ``slopes`` (h, w, 2)."""

    def __init__(
        self, camera: Camera, config: CameraConfig, region: Region, slopes: np.ndarray
    ) -> None:
        self.camera = camera
        self.config = config
        self.region = region
        self.slopes = slopes

    @abstractmethod
    def pattern_mm(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """Draw the fixed pattern on the whole sensor (h, w)."""

    @cached_property
    def static_error_m(self) -> np.ndarray:
        """All range errors (h, w) that the frames of this unit share, if they are switched on."""
        camera = self.camera
        config = self.config
        effects = config.effects
        error_m = _drift_m(camera.unit, effects, config.minutes_since_power_on, self.slopes[..., 0])
        if effects.unit_offset:
            stream = random_stream(config.unit_seed, "unit offset", camera.name)
            deviation = float(stream.standard_normal())
            error_m = error_m + deviation * camera.unit.offset_mm.value * MM
        if effects.fixed_pattern:
            cut = self.region.within(camera.nominal_lens.whole)
            pattern_m = self._sensor_pattern_mm()[cut] * MM
            error_m = error_m + pattern_m * config.fixed_pattern_scale
        return np.asarray(error_m)

    def _sensor_pattern_mm(self) -> np.ndarray:
        """Return the fixed pattern of the whole sensor, drawn or kept."""
        camera = self.camera
        config = self.config
        lens = camera.nominal_lens
        numbers = canonical_json([config.numbers, camera.to_data()["fixed_pattern"]])
        key = camera.name, numbers, config.unit_seed, lens  # several files may have the same name
        if key not in _patterns_mm:
            while len(_patterns_mm) >= KEPT_PATTERNS:
                del _patterns_mm[next(iter(_patterns_mm))]
            stream = random_stream(config.unit_seed, "fixed pattern", camera.name)
            _patterns_mm[key] = self.pattern_mm(stream, (lens.height, lens.width))
        return _patterns_mm[key]


def _drift_m(
    facts: UnitFacts, effects: EffectsConfig, minutes: float, slope_x: np.ndarray
) -> np.ndarray:
    """Return the error of range ``minutes`` after power-on; zeros where off."""
    if not effects.warm_up_drift:
        return np.zeros(slope_x.shape)
    decayed = facts.drift_mm.value * MM * np.exp(-minutes / facts.drift_min.value)
    return np.asarray(decayed * (1 + facts.drift_ramp.value * slope_x))


def frame_errors_m(
    facts: UnitFacts,
    effects: EffectsConfig,
    minutes: float,
    jitter_mm: float,
    rng: np.random.Generator,
) -> Iterator[float]:
    """Yield range errors in metres for endless frames: jitter of deviation ``jitter_mm`` in all, a
    jump either way in a few, and the change of the drift on the axis since the first frame,
    ``minutes`` after power-on. An effect that is off adds 0."""
    axis = np.zeros(1)
    per_minute = facts.frames_per_second.value * 60
    first_m = _drift_m(facts, effects, minutes, axis)[0]
    for frame in count():
        now_m = _drift_m(facts, effects, minutes + frame / per_minute, axis)[0]
        drifted_m = float(now_m - first_m)
        jittered_mm = rng.standard_normal() * jitter_mm
        # a number from 0 to 1 is a jump; each half of them stands for one direction
        chance = rng.random() / max(facts.jump_rate.value, 1e-12)
        jump_mm = 0.0
        if chance < 1:
            jump_mm = math.copysign(facts.jump_mm.value, chance - 0.5)
        moved_m = (jittered_mm + jump_mm) * MM if effects.frame_jumps else 0.0
        yield moved_m + drifted_m
