"""Holes, dents and bumps by a bank of matched filters on whitened noise.

The residuals' autocovariance, temporal noise and fixed pattern together, is measured on the capture itself, off what
stands out. Each template t (discs of several radii through a camera's window or lens, and dents) is then compared with
the residuals r under that covariance C, restricted to the pixels that are known:

    score = t' C^-1 r / sqrt(t' C^-1 t)

which has the deviation 1 where there is no damage, whatever the noise's spectrum. C^-1 r is solved for by conjugate
gradients, so missing pixels and borders add nothing and need no filling. Background structure that is not damage is
part of the covariance, and counts as little as its power demands.

What stands out strongly is taken out (its pixels count as unknown) and the rest is judged again, so that no filter
sees the shoulder of a neighbour's hole.

Not modelled: slots and scratches, missing returns (`detectors.missing` finds them), templates' distortion where a
surface is steep, tails of the noise that are heavier than Gaussian. The denominator takes the share of a template's
whitened energy on known pixels for t' C^-1 t, which is exact where all of the template is seen; places where less than
`LEAST_SEEN` of it is seen are not judged by that template.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
import scipy.fft
from pydantic import model_validator

from detectors.local import LocalConfig, LocalDetector, local_sigma

RADII_PX = (0.5, 1.5, 2.2, 3.2, 4.5, 6.4, 9.0, 13.0, 18.0)
"""Radii of discs seen through a window of 5 x 5 pixels, as continuous-wave cameras filter their phasors."""
SHARP_RADII_PX = (0.6, 1.2, 2.0)
"""Radii of discs blurred by `LENS_BLUR_PX` only: cameras without such a window."""
DENT_RADII_PX = (6.0, 9.0, 13.0, 18.0)
"""Radii of paraboloids."""
ALL_RADII_PX = (*RADII_PX, *SHARP_RADII_PX, *DENT_RADII_PX)
WINDOW_RADII, LEAST_WINDOW = 6, 32
"""Half of the window in which scores are set beside their own scatter: so many radii, and pixels at least."""
WINDOW = (0.6, 1.0, 1.0, 1.0, 0.6)
LENS_BLUR_PX = 0.6
DENT_BLUR_PX = 1.0
LONGEST_LAG_PX = 20
"""Lag at which the covariance has faded (Parzen's window): long enough for the pattern of known cameras, short enough
that 30,000 pixels tell each of its values to some per cent."""
LEAST_POWER = 0.3
"""The spectrum is nowhere below this share of its mean: frequencies that a filter or an interpolation took out hold no
signal either. 0.02 to 0.3 give the same limits with known cameras, 1.0 gives larger ones."""
LEAST_SEEN = 0.5
QUIET_SIGMAS = 4.0
"""Pixels beyond it, and their neighbours, do not count for the covariance."""
CLIP_SIGMAS = 5.0
"""Deviations beyond which no single pixel counts for more: a flying pixel alone is no finding."""
STRONG, LOUD_SIGMAS, MARGIN_PX = 6.0, 3.0, 2
"""A peak of this score, with the pixels joined to it that are louder than so many deviations, and those around them, is
taken out before the rest is judged."""
LOUD_SHARE = 0.5
"""The loud pixels at a peak fill at least this share of its template's disc."""
ALONE_PX = 7
"""Half of the square in which a peak is the highest."""
MOST_PASSES = 4
CONVERGED, MOST_ITERATIONS = 0.003, 30
"""Relative residual at which C^-1 r counts as solved."""


class MatchedConfig(LocalConfig):
    """The settings of `local`, but for ``surface``: the thesis' polynomial, unless ``shape: auto`` asks for a chosen
    shape, whose uncertain long waves count as noise here."""

    @model_validator(mode="before")
    @classmethod
    def _chosen_shape(cls, data: Any) -> Any:
        return data


class MatchedDetector(LocalDetector):
    """A bank of matched filters on noise that the capture itself whitens; findings are peaks."""

    settings_type: ClassVar[type[MatchedConfig]] = MatchedConfig
    name = "matched"
    version = 1

    def scored(
        self, residual_m: np.ndarray, weights: np.ndarray, rounding_m2: tuple[float, float]
    ) -> tuple[np.ndarray, float, str]:
        """Return signed scores (r, c), the deviation of the narrowest template's depth (m), and the unit."""
        known = weights > 0
        floor_m = max(float(np.sqrt(sum(rounding_m2))), 1e-9)
        # residuals in units of the noise round about, louder where a point's own variance says so
        values = np.where(known, residual_m * np.sqrt(weights), np.nan)
        unit_m = np.maximum(local_sigma(values, floor=floor_m), floor_m)
        signed, narrowest = _judged(np.where(known, values / unit_m, 0.0), known)
        depth_m = narrowest * float(np.median(unit_m[known]))
        text = f"the deviation of matched filters on whitened noise, {1e3 * depth_m:.3g} mm of the narrowest"
        return signed, depth_m, text


def _judged(noise: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, float]:
    """Return signed scores (r, c) of residuals in deviations, and the deviation of the narrowest template's height."""
    shape = tuple(scipy.fft.next_fast_len(side + 2 * LONGEST_LAG_PX, real=True) for side in noise.shape)
    sizes = np.abs(noise)
    noise = np.clip(noise, -CLIP_SIGMAS, CLIP_SIGMAS).astype(np.float32)
    quiet = known & (cv2.dilate((sizes > QUIET_SIGMAS).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0)
    power = noise_power(noise, quiet, shape)
    loud = sizes > LOUD_SIGMAS
    steps = np.arange(-MARGIN_PX, MARGIN_PX + 1)
    around = (np.hypot(steps[:, None], steps) <= MARGIN_PX + 0.5).astype(np.uint8)
    seen, taken = known, np.zeros(noise.shape)
    for number in range(MOST_PASSES):
        scores, narrowest = _scores(np.where(seen, noise, 0.0).astype(np.float32), seen, power, shape)
        best_by = np.abs(scores).argmax(axis=0)
        best = np.take_along_axis(scores, best_by[None], axis=0)[0]
        louder = _cores(best, np.asarray(ALL_RADII_PX)[best_by], np.where(loud & seen, sizes, 0.0), seen)
        core = louder > 0.0
        if number == MOST_PASSES - 1 or not core.any():
            break
        taken = np.where(core, best * louder, taken)
        seen = seen & (cv2.dilate(core.astype(np.uint8), around) == 0)
    # where the scores of a neighbourhood scatter by more than 1, the noise there is not as elsewhere
    signed = np.zeros(noise.shape)
    for k, radius_px in zip(range(len(scores)), ALL_RADII_PX, strict=False):
        judged = np.where(scores[k] != 0.0, scores[k], np.nan)
        scatter = np.maximum(local_sigma(judged, int(max(WINDOW_RADII * radius_px, LEAST_WINDOW))), 1.0)
        score = scores[k] / scatter
        signed = np.where((taken == 0.0) & (np.abs(score) > np.abs(signed)), score, signed)
        # which template fits a strong finding best hangs on little; the narrowest's scatter stands for all
        signed = np.where(taken != 0.0, taken / scatter, signed) if k == 0 else signed
    return np.where(known, signed, 0.0), narrowest


def _cores(score: np.ndarray, radius_px: np.ndarray, loud: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return (r, c) more than 0 on the loud pixels (their size, else 0), and on what lies between them, that peaks of
    the score stand on, where they fill the template's disc: of what is wide and shallow only the loudest pixels would
    go. The value is how often the median of the loud pixels exceeds the clipped size, 1 at least."""
    size = np.abs(score).astype(np.float32)
    peaks = (size > STRONG) & (size >= cv2.dilate(size, np.ones((2 * ALONE_PX + 1,) * 2, np.uint8)))
    joined = cv2.connectedComponents(cv2.dilate((loud > 0).astype(np.uint8), np.ones((3, 3), np.uint8)))[1]
    parts = np.where(seen, joined, 0)
    area = np.bincount(parts.ravel())
    louder = np.zeros(score.shape)
    for (row, column), radius in zip(np.argwhere(peaks), radius_px[peaks], strict=True):
        for number in np.unique(parts[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]):
            if number > 0 and area[number] > LOUD_SHARE * np.pi * radius**2:
                part = parts == number
                louder[part] = max(float(np.median(loud[part & (loud > 0)])) / CLIP_SIGMAS, 1.0)
    return louder


def noise_power(noise: np.ndarray, quiet: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the power spectrum on ``shape``, as `scipy.fft.rfft2` orders it, of the quiet pixels' autocovariance:
    means of products over pairs of known pixels, faded out by Parzen's window."""
    products = np.abs(scipy.fft.rfft2(np.where(quiet, noise, 0.0).astype(np.float32), shape)) ** 2
    pairs = np.abs(scipy.fft.rfft2(quiet.astype(np.float32), shape)) ** 2
    covariance = scipy.fft.irfft2(products, shape) / np.maximum(scipy.fft.irfft2(pairs, shape), 1.0)
    rows, columns = (np.minimum(np.arange(side), side - np.arange(side)) for side in shape)
    lag = np.minimum(np.hypot(rows[:, None], columns[None]) / LONGEST_LAG_PX, 1.0)
    parzen = np.where(lag <= 0.5, 1.0 - 6.0 * lag**2 * (1.0 - lag), 2.0 * (1.0 - lag) ** 3)
    power = scipy.fft.rfft2(covariance * parzen).real
    return np.asarray(np.maximum(power, max(LEAST_POWER * float(power.mean()), 1e-12)).astype(np.float32))


def inverse_times(values: np.ndarray, known: np.ndarray, power: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return C^-1 r (r, c) over the known pixels, 0 elsewhere, for the covariance with this power spectrum, by
    conjugate gradients that start from the stationary inverse."""
    h, w = values.shape
    mask = known.astype(np.float32)

    def filtered(image: np.ndarray, by: np.ndarray) -> np.ndarray:
        return mask * scipy.fft.irfft2(by * scipy.fft.rfft2(image, shape), shape)[:h, :w]

    inverse = 1.0 / power
    solution = filtered(values, inverse)
    rest = values * mask - filtered(solution, power)
    towards = direction = filtered(rest, inverse)
    product, enough = float((rest * towards).sum()), CONVERGED**2 * float((values * values * mask).sum())
    for _ in range(MOST_ITERATIONS):
        if float((rest * rest).sum()) <= enough or product <= 0:
            break
        onward = filtered(direction, power)
        step = product / float((direction * onward).sum())
        solution = solution + step * direction
        rest = rest - step * onward
        towards = filtered(rest, inverse)
        before, product = product, float((rest * towards).sum())
        direction = towards + product / before * direction
    return np.asarray(solution)


def _scores(
    values: np.ndarray, known: np.ndarray, power: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, float]:
    """Return the score (k, r, c) of each template at each pixel, 0 where too little of it is seen, and the deviation
    of the first template's height."""
    h, w = values.shape
    weighed = scipy.fft.rfft2(inverse_times(values, known, power, shape), shape)
    there = scipy.fft.rfft2(known.astype(np.float32), shape)
    scores, narrowest = [], 0.0
    for template in _spectra(shape):
        white = scipy.fft.irfft2(template / np.sqrt(power), shape) ** 2
        energy = float(white.sum())
        narrowest = narrowest or energy**-0.5
        share = scipy.fft.irfft2(there * np.conj(scipy.fft.rfft2(white)), shape)[:h, :w] / energy
        response = scipy.fft.irfft2(weighed * np.conj(template), shape)[:h, :w]
        judged = share > LEAST_SEEN
        scores.append(np.where(judged, response / np.sqrt(energy * np.maximum(share, LEAST_SEEN)), 0.0))
    return np.asarray(scores, dtype=np.float32), narrowest


@lru_cache(maxsize=4)
def _spectra(shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Return the templates' spectra on a grid that holds them, each with its centre at pixel (0, 0) and the height 1 of
    the undisturbed damage."""
    spectra = []
    for template in _templates():
        half = template.shape[0] // 2
        if template.shape[0] > min(shape):
            continue
        image = np.zeros(shape, np.float32)
        image[: template.shape[0], : template.shape[1]] = template
        spectra.append(scipy.fft.rfft2(np.roll(image, (-half, -half), (0, 1))))
    return tuple(spectra)


@lru_cache(maxsize=1)
def _templates() -> tuple[np.ndarray, ...]:
    """Return the templates, each on a square of an odd number of pixels."""
    window = np.outer(WINDOW, WINDOW) / np.sum(WINDOW) ** 2
    windowed = [cv2.filter2D(_drawn(r, LENS_BLUR_PX), -1, window, borderType=cv2.BORDER_CONSTANT) for r in RADII_PX]
    sharp = [_drawn(r, LENS_BLUR_PX) for r in SHARP_RADII_PX]
    return (*windowed, *sharp, *(_drawn(r, DENT_BLUR_PX, dent=True) for r in DENT_RADII_PX))


def _drawn(radius_px: float, blur_px: float, *, dent: bool = False) -> np.ndarray:
    """Return a disc, or a paraboloid, of height 1, averaged over pixels and blurred by a Gaussian."""
    finer, half = 4, int(radius_px + 5)
    places = (np.arange((2 * half + 1) * finer) + 0.5) / finer - (half + 0.5)
    apart = np.hypot(places[:, None], places[None]) / radius_px
    height = np.maximum(1.0 - apart**2, 0.0) if dent else (apart < 1.0).astype(float)
    pixels = height.reshape(2 * half + 1, finer, 2 * half + 1, finer).mean(axis=(1, 3))
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), blur_px, borderType=cv2.BORDER_CONSTANT))
