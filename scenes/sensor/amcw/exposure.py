"""The light of a view as the pixels of a continuous-wave imager collect it, before noise.

Modelled: the fundamental of each modulation frequency with its contrast, the harmonics that the number of phases
aliases onto it, the lens' gathering of light, light of the surroundings, the wells' and the converter's full scale.
Not modelled: dark current, the harmonics that no phase sees (they could only change a sample's rounding), in-pixel
rejection of ambient light, gain switching and exposures of unequal length (high dynamic range), light that changes
during a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from harness.vocabulary.units import SPEED_OF_LIGHT_AIR, UW_CM2
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.camera import CameraConfig
from scenes.sensor.unit import light_of
from scenes.view import NoiseFreeView

f4 = np.float32

HIGHEST_HARMONIC = 31
"""Harmonics above change the phase by less than 0.1 mrad in all."""


@dataclass(frozen=True)
class AmcwExposure:
    """Light of a view as the converter sees it before noise, in converter units, flat over n = h w pixels.

    ``means`` (f, k, n): noise-free samples; ``sigma`` (n,): deviation of each sample; ``limit`` (n,): the largest
    sample that wells and converter hold, infinite where saturation is off; ``shape``: (h, w).
    """

    means: np.ndarray
    sigma: np.ndarray
    limit: np.ndarray
    shape: tuple[int, int]


def exposure_of(
    camera: AmcwCamera, config: CameraConfig, view: NoiseFreeView, gathered: np.ndarray, error_m: np.ndarray
) -> AmcwExposure:
    """Return the noise-free samples of a view.

    ``gathered`` (h, w): light that each pixel's optics gather, 1 on the axis; ``error_m`` (h, w): errors of range that
    all frames share, put in as a delay of the light.
    """
    photons, modulation = camera.photons, camera.modulation
    phasor, intensity = light_of(view, config.effects)
    electrons = photons.signal_electrons.value * gathered
    contrast = np.array(modulation.contrast.value)[:, None, None]
    turns = np.array(camera.frequencies_hz)[:, None, None] * (2 * error_m / SPEED_OF_LIGHT_AIR)
    signal = contrast * electrons * phasor * np.exp(2j * np.pi * turns)
    if config.effects.wiggling:
        signal = with_harmonics(signal, modulation.phases.value, np.array(modulation.wiggling_residual.value))
    both_wells = electrons * intensity + ambient_electrons(camera, config, view, gathered)
    variance = both_wells + 2 * photons.read_noise_electrons.value**2
    sigma = np.sqrt(variance) if config.effects.noise else np.zeros_like(variance)
    samples = sampled(signal, modulation.phases.value)
    # the largest sample that fits: the fuller well holds half of both wells' electrons and half the sample
    limit = np.full(both_wells.shape, np.inf)
    if config.effects.saturation:
        limit = np.full(both_wells.shape, float(camera.converter.full_scale_units.value))
        if photons.full_well_electrons is not None:
            room = 2 * photons.full_well_electrons.value - both_wells
            limit = np.clip(room / photons.electrons_per_unit.value, 0, limit)
    return AmcwExposure(
        (samples / photons.electrons_per_unit.value).reshape(*samples.shape[:2], -1).astype(f4),
        (sigma / photons.electrons_per_unit.value).ravel().astype(f4),
        limit.ravel().astype(f4),
        intensity.shape,
    )


def sampled(signal: np.ndarray, phases: int) -> np.ndarray:
    """Return (f, k, h, w): the samples Re(S exp(-2 pi j k / N)) of a demodulated signal S (f, h, w) at N phases."""
    steps = 2 * np.pi * np.arange(phases)[None, :, None, None] / phases
    return np.asarray(signal.real[:, None] * np.cos(steps) + signal.imag[:, None] * np.sin(steps))


def with_harmonics(signal: np.ndarray, phases: int, residual: np.ndarray) -> np.ndarray:
    """Return the signal (f, h, w) with the harmonics that N ``phases`` alias onto the fundamental, times ``residual``
    (f,).

    Square light under square demodulation correlates to a triangle: odd harmonics n of 1/n^2. N equidistant samples
    see the n-th as the fundamental where n = +1 mod N, as its conjugate where n = -1: for N = 3 the 5th and 7th, 11th
    and 13th and so on, 19.5 mrad at most; for N = 4 the 3rd and 5th, 71 mrad.
    Approximation: a pixel that sees several paths has the harmonics of their sum, not the sum of their harmonics.
    """
    size = np.abs(signal)
    direction = np.divide(signal, size, out=np.zeros_like(signal), where=size > 0)
    apart = phases if phases % 2 == 0 else 2 * phases
    wave = direction**apart
    alias, power = np.zeros_like(signal), np.ones_like(signal)
    for centre in range(apart, HIGHEST_HARMONIC, apart):
        power = power * wave
        alias = alias + power.conj() / (centre - 1) ** 2 + power / (centre + 1) ** 2
    return np.asarray(signal * (1 + residual[:, None, None] * alias))


def ambient_electrons(
    camera: AmcwCamera, config: CameraConfig, view: NoiseFreeView, gathered: np.ndarray
) -> np.ndarray:
    """Return (h, w): electrons of daylight or lamps in both wells of one exposure; zeros where the effect is off.

    As many as the emitter's own, times the ratio of irradiances within the filter's band, for light that falls on the
    surface as the camera's own does: a bright sky behind the camera. A pixel that sees several surfaces is taken to get
    its light from the nearest within a pixel, which sends the most of the emitter's; what farther ones add is left out.
    Rays that meet nothing see none.
    """
    if not config.effects.ambient:
        return np.zeros(view.intensity.shape)
    irradiance = config.ambient_uw_cm2_nm * UW_CM2 * camera.photons.band_nm.value
    one_metre = camera.photons.signal_electrons.value * irradiance / camera.emitter.irradiance_w_m2.value
    _, intensity = light_of(view, config.effects)
    nearest_m = ndimage.minimum_filter(np.where(np.isfinite(view.range_m), view.range_m, np.inf), 3, mode="nearest")
    range_m = np.where(view.coverage < 1, np.where(np.isfinite(nearest_m), nearest_m, 0.0), np.nan_to_num(view.range_m))
    return np.asarray(one_metre * gathered * intensity * range_m**2)
