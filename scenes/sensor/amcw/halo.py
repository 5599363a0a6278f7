"""Noisy light of the pixels around listed ones, which shares its noise with linear pixels.

A sum of many samples with normal noise is a phasor with normal noise across and along its mean, to
within the converter's rounding, which acts as noise of step^2/12. At f frequencies, a pixel's f
normals across are the mirror image of the one that linear pixels have of it (see
`scenes.sensor.amcw.linear_frames`) and of f - 1 others, at the plane that swaps the first axis with
the frequencies' shares in the noise of z: so their sum by these shares is that one. The same holds
along, for amplitudes. Pixels that may saturate, or whose noise does not hide the converter's steps,
are drawn sample by sample; no linear pixel sees those.

`draw_light` is the door of the compiled part; `scenes.sensor.amcw.halo_reference` has the same in
NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.exposure import AmcwExposure
from scenes.sensor.amcw.imager import AmcwImager, NoisyLight
from scenes.sensor.amcw.light import Light
from scenes.sensor.common.normals import FAST, standard_normals

f4 = np.float32
ZERO = f4(0)
ONE = f4(1)
SMALLEST = 1e-12  # distance of shares from the first axis below which they are on it


class Halo(NamedTuple):
    """The g pixels whose light the list needs, at f frequencies."""

    pixels: np.ndarray
    """(g,): flat indices."""
    direction: np.ndarray
    """(2, f, g) float32: real and imaginary part of the mean phasor's direction."""
    length: np.ndarray
    """(f, g) float32: its length, in converter units times the gain."""
    across: np.ndarray
    """(f, g) float32: deviation of the noise across it."""
    along: np.ndarray
    """(f, g) float32: deviation of the noise along it."""
    mirror_across: np.ndarray
    """(f, g) float32: normal of the plane of reflection, of length sqrt(2), for noise across."""
    mirror_along: np.ndarray
    """(f, g) float32: the same for noise along."""
    by_sample: np.ndarray
    """(u,): indices in ``pixels`` of those that are drawn sample by sample."""
    exposure: AmcwExposure
    """The samples of those u."""


def halo_of(
    pixels: np.ndarray,
    light: Light,
    metres_by_phase: np.ndarray,
    is_by_sample: np.ndarray,
    exposure: AmcwExposure,
) -> Halo:
    """Return the halo at flat ``pixels`` (g,) of a view.

    Args:
        pixels: (g,) flat indices.
        light: of the whole view, n pixels.
        metres_by_phase: (f, n), metres of half path per radian of each phase, times its carrier.
        is_by_sample: (n,) bool, pixels to be drawn sample by sample.
        exposure: of the whole view.
    """
    light = Light._make(part.take(pixels, axis=1) for part in light)
    across = light.amplitude * light.phase_noise
    along = light.amplitude * light.relative_noise
    by_sample = np.flatnonzero(is_by_sample[pixels])
    return Halo(
        pixels=pixels,
        direction=np.stack([light.phasor.real, light.phasor.imag]),
        length=light.amplitude,
        across=across,
        along=along,
        mirror_across=_mirror(metres_by_phase.take(pixels, axis=1) * light.phase_noise),
        mirror_along=_mirror(along),
        by_sample=by_sample,
        exposure=exposure.part(pixels[by_sample]),
    )


def _mirror(noise: np.ndarray) -> np.ndarray:
    """Return the normals (f, g), of length sqrt(2), of the planes that swap the first axis with the
    direction of ``noise`` (f, g); 0 where they are one."""
    shares = noise / np.sqrt((noise.astype(float) ** 2).sum(axis=0))
    normal = -shares
    normal[0] += 1.0
    # the length of the first axis minus the shares is sqrt(2 (1 - first share))
    distance = 1.0 - shares[0]
    apart = distance > SMALLEST
    return np.asarray(normal * apart / np.sqrt(np.where(apart, distance, 1.0)), f4)


def drawn_light(
    halo: Halo, imager: AmcwImager, normals: np.ndarray, rng: np.random.Generator
) -> NoisyLight:
    """Draw the light of g + 1 pixels that shares the ``normals`` (2, n) of the view's phases and
    amplitudes. The last pixel is saturated, as the filter takes saturated pixels like those beyond
    the picture."""
    f, g = halo.length.shape
    unit = np.empty((2, f, g + 1), f4)
    amplitude = np.empty((f, g + 1), f4)
    saturated = np.zeros(g + 1, np.uint8)
    draw_light(halo, normals, standard_normals(rng, (2, f - 1, g)), unit, amplitude)
    if halo.by_sample.size:
        reading = imager.reading(halo.exposure, rng)
        unit[:, :, halo.by_sample] = reading.unit
        amplitude[:, halo.by_sample] = reading.amplitude
        saturated[halo.by_sample] = reading.saturated
    unit[:, :, g] = ZERO
    amplitude[:, g] = kernels.OUTSIDE
    saturated[g] = 1
    return NoisyLight(unit, amplitude, saturated)


@numba.njit(**FAST)
def draw_light(halo, normals, others, unit, amplitude):  # type: ignore[no-untyped-def]
    """Write noisy phasors.

    Args:
        halo: the `Halo`.
        normals: (2, n) normals of the view's phases and amplitudes.
        others: (2, f - 1, g) further normals.
        unit: (2, f, g or more) real and imaginary parts of unit phasors; written.
        amplitude: (f, g or more) amplitudes; written.
    """
    frequencies, g = halo.length.shape
    across = np.empty((frequencies, g), f4)
    along = np.empty((frequencies, g), f4)
    for x in range(np.uint64(g)):
        across[0, x] = normals[0, halo.pixels[x]]
        along[0, x] = normals[1, halo.pixels[x]]
    across[1:] = others[0]
    along[1:] = others[1]
    _reflect(halo.mirror_across, across)
    _reflect(halo.mirror_along, along)
    for f in range(frequencies):
        _write_phasors(
            halo.direction[0, f],
            halo.direction[1, f],
            halo.length[f],
            halo.across[f],
            halo.along[f],
            across[f],
            along[f],
            unit[0, f],
            unit[1, f],
            amplitude[f],
        )


@numba.njit(**FAST)
def _reflect(mirror, values):  # type: ignore[no-untyped-def]
    """Replace ``values`` (f, g) by their image in planes with these normals of length sqrt(2)."""
    frequencies, g = values.shape
    along_normal = np.zeros(g, f4)
    for f in range(frequencies):
        for x in range(np.uint64(g)):
            along_normal[x] += mirror[f, x] * values[f, x]
    for f in range(frequencies):
        for x in range(np.uint64(g)):
            values[f, x] -= along_normal[x] * mirror[f, x]


@numba.njit(**FAST)
def _write_phasors(  # type: ignore[no-untyped-def]
    direction_re,
    direction_im,
    length,
    deviation_across,
    deviation_along,
    across,
    along,
    re,
    im,
    amplitude,
):
    """Write the noisy phasors of one frequency, (g,) each: ``re`` and ``im`` of length 1, and the
    amplitude."""
    for x in range(np.uint64(length.size)):
        forward = length[x] + deviation_along[x] * along[x]
        sideways = deviation_across[x] * across[x]
        size = np.sqrt(forward * forward + sideways * sideways)
        inverse = ONE / size if size > ZERO else ZERO
        re[x] = (forward * direction_re[x] - sideways * direction_im[x]) * inverse
        im[x] = (forward * direction_im[x] + sideways * direction_re[x]) * inverse
        amplitude[x] = size
