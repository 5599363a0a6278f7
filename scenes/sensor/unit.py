"""Frames and their sums, and the light and range errors of a unit or frame, for every kind of
camera."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import scipy.fft
from scipy import ndimage

from harness.vocabulary.geometry import MM, Reason, Region
from harness.vocabulary.seeds import canonical_json, random_stream
from scenes.optics import NoiseFreeView
from scenes.sensor.camera import AnyCamera, CameraConfig, EffectsConfig
from scenes.sensor.facts import UnitFacts

Camera = TypeVar("Camera", bound=AnyCamera)
N_REASONS = max(Reason) + 1
SUMMED = ("count", "total", "squares", "amplitude")


class DecodedFrame(NamedTuple):
    """A frame. ``z_m`` (h, w) float32: NaN where ``reason`` (h, w) uint8 is not VALID.
    ``amplitude``: (h, w)."""

    z_m: np.ndarray
    reason: np.ndarray
    amplitude: np.ndarray


@dataclass(frozen=True)
class FrameTotals:
    """Sums over ``frames`` frames on pixels (h, w), with z in whole steps of ``step_m``, so that
    sums are exact. ``count``: of valid samples. ``total``, ``squares``: of their z minus ``base``.
    ``amplitude``: in the camera's units. ``reasons`` (r, h, w): how often each `Reason` occurred.
    """

    frames: int
    step_m: float
    base: np.ndarray
    count: np.ndarray
    total: np.ndarray
    squares: np.ndarray
    amplitude: np.ndarray
    reasons: np.ndarray

    def cut(self, at: tuple[slice, slice]) -> FrameTotals:
        """Return the same on a part of the pixels."""
        images = {name: getattr(self, name)[at] for name in ("base", *SUMMED)}
        return replace(self, reasons=self.reasons[:, *at], **images)


def rays_of(slopes: np.ndarray, offset_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, (h, w) each, an offset's (3,) component along each pixel's unit ray, and the ray's
    cosine to the axis."""
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    length = np.linalg.norm(rays, axis=-1)
    return rays @ offset_m / length, 1 / length


def smooth_field(white: np.ndarray, length_px: float) -> np.ndarray:
    """Smooth white noise (h, w) to unit variance and autocorrelation exp(-k^2 / 2 length^2),
    periodic."""
    responses = []
    for size in white.shape:
        response = ndimage.gaussian_filter1d(
            np.eye(1, size)[0], length_px / np.sqrt(2), mode="wrap"
        )
        responses.append(scipy.fft.fft(response / np.linalg.norm(response)).astype(np.complex64))
    down, across = responses
    spectrum = scipy.fft.rfft2(white)
    return np.asarray(
        scipy.fft.irfft2(spectrum * down[:, None] * across[: spectrum.shape[1]], white.shape), float
    )


SPECTRUM = 256
LEAST_POWER = 1e-3
FAINT = 0.05
"""Frequencies of a filter's spectrum, and its least power and tap relative to the largest:
correlations to 0.015."""


def taps_of(correlation: np.ndarray) -> np.ndarray:
    """Return causal taps (k,) with a sum of squares of 1 that give white noise this correlation
    (n,) at lags 0 to n - 1: the minimum-phase factor of its spectrum, by the cepstrum (Oppenheim
    and Schafer), as it is short."""
    lags = len(correlation)
    circle = np.zeros(SPECTRUM)
    circle[:lags] = correlation
    circle[SPECTRUM - lags + 1 :] = correlation[:0:-1]
    spectrum = np.fft.fft(circle).real
    cepstrum = np.fft.ifft(0.5 * np.log(np.maximum(spectrum, LEAST_POWER * spectrum.max()))).real
    cepstrum[1 : SPECTRUM // 2] *= 2.0
    cepstrum[SPECTRUM // 2 + 1 :] = 0.0
    taps = np.fft.ifft(np.exp(np.fft.fft(cepstrum))).real
    taps = taps[
        : 1 + int(np.flatnonzero(np.abs(taps[: SPECTRUM // 2]) > FAINT * np.abs(taps).max()).max())
    ]
    return np.asarray(taps / np.sqrt((taps**2).sum()), np.float32)


def light_of(view: NoiseFreeView, effects: EffectsConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return phasors (f, h, w) and intensity (h, w) of all light or, with multipath off, of direct
    light; intensity is then the longest phasor over the frequencies, too small where two surfaces
    cancel at every frequency."""
    if effects.multipath:
        return view.phasor, view.intensity
    return view.phasor_direct, np.minimum(np.abs(view.phasor_direct).max(axis=0), view.intensity)


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
        lens = self.camera.nominal_lens
        error = _drift_m(
            camera.unit, config.effects, config.minutes_since_power_on, self.slopes[..., 0]
        )
        if config.effects.unit_offset:
            deviation = float(
                random_stream(config.unit_seed, "unit offset", camera.name).standard_normal()
            )
            error = error + deviation * camera.unit.offset_mm.value * MM
        if not config.effects.fixed_pattern:
            return error
        numbers = canonical_json([config.numbers, camera.fixed_pattern.to_data()])
        key = camera.name, numbers, config.unit_seed, lens  # several files may have the same name
        if key not in _patterns_mm:
            while len(_patterns_mm) >= KEPT_PATTERNS:
                del _patterns_mm[next(iter(_patterns_mm))]
            stream = random_stream(config.unit_seed, "fixed pattern", camera.name)
            _patterns_mm[key] = self.pattern_mm(stream, (lens.height, lens.width))
        drawn_mm = _patterns_mm[key][self.region.within(lens.whole)]
        return np.asarray(error + drawn_mm * MM * config.fixed_pattern_scale)


def _drift_m(
    facts: UnitFacts, effects: EffectsConfig, minutes: float, slope_x: np.ndarray
) -> np.ndarray:
    """Return the error of range ``minutes`` after power-on; zeros where off."""
    if not effects.warm_up_drift:
        return np.zeros(slope_x.shape)
    decayed = facts.drift_mm.value * MM * np.exp(-minutes / facts.drift_min.value)
    return np.asarray(decayed * (1 + facts.drift_ramp.value * slope_x))


def frame_errors_m(
    facts: UnitFacts, effects: EffectsConfig, minutes: float, rng: np.random.Generator
) -> Iterator[float]:
    """Yield range errors in metres for endless frames: jitter in all, a jump either way in a few,
    and the change of the drift on the axis since the first frame, ``minutes`` after power-on. An
    effect that is off adds 0."""
    axis = np.zeros(1)
    per_minute = facts.frames_per_second.value * 60
    first = _drift_m(facts, effects, minutes, axis)[0]
    for frame in count():
        drifted = float(_drift_m(facts, effects, minutes + frame / per_minute, axis)[0] - first)
        # each half of the chances of a jump stands for one direction
        jitter = rng.standard_normal()
        chance = rng.random() / max(facts.jump_rate.value, 1e-12)
        jump = math.copysign(facts.jump_mm.value, chance - 0.5) if chance < 1 else 0.0
        moved = (jitter * facts.jitter_mm.value + jump) * MM if effects.frame_jumps else 0.0
        yield moved + drifted
