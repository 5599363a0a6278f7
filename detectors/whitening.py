"""The bank of matched filters' templates, and the noise that they are whitened by.

Pictures are residuals in deviations of the local noise. Correlations are taken on grids that are wider than the picture
by the longest lag, so that nothing wraps around.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import scipy.fft

RADII_PX = (0.5, 1.5, 2.2, 3.2, 4.5, 6.4, 9.0, 13.0, 18.0)
"""Radii of discs seen through a window of 5 x 5 pixels, as continuous-wave cameras filter their phasors."""
SHARP_RADII_PX = (0.6, 1.2, 2.0)
"""Radii of discs blurred by `LENS_BLUR_PX` only: cameras without such a window."""
DENT_RADII_PX = (6.0, 9.0, 13.0, 18.0)
"""Radii of paraboloids."""
SLOT_PX, SLOTS_DEG = (20.0, 2.0), (0.0, 30.0, 60.0, 90.0, 120.0, 150.0)
"""Length and width of slots, each seen with and without such a window, and the angle of each to the rows."""
ALL_RADII_PX = (*RADII_PX, *SHARP_RADII_PX, *DENT_RADII_PX, *(SLOT_PX[0] / 4.0,) * 2 * len(SLOTS_DEG))
"""Radii of all templates: first discs, then paraboloids, then slots, by the radius of a disc as large."""
FIRST_SLOT = len(ALL_RADII_PX) - 2 * len(SLOTS_DEG)
WINDOW = (0.6, 1.0, 1.0, 1.0, 0.6)
LENS_BLUR_PX = 0.6
DENT_BLUR_PX = 1.0
LONGEST_LAG_PX = 20
"""Lag at which the covariance has faded (Parzen's window): long enough for the pattern of known cameras, short enough
that 30,000 pixels tell each of its values to some per cent."""
COARSE_PX = 9.0
"""Radius from which on the scores of every second pixel are taken: between them they change by some hundredths."""
LEAST_POWER = 0.1
"""The spectrum is nowhere below this share of its mean: frequencies that a filter or an interpolation took out hold no
signal either. Of 50 frames of a simulated Azure Kinect 0.3 loses a tenth of the scores of small holes, and 0.03 finds
no more of them; in interpolated depth of a real one it raises the noise that is left."""
MOST_WHITENED = 2000  # pixels whose dense covariance is factored: 0.2 s and 64 MB
GRID = 96
"""Side of the grid that holds the widest template and the reach of its whitened edge."""
CONVERGED, ROUGHLY_CONVERGED, MOST_ITERATIONS = 0.01, 0.2, 30
"""Relative residuals at which C^-1 r counts as solved, and as solved well enough to tell what stands out strongly."""


def grid_of(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the grid on which a picture of this shape is transformed; it holds every template; half of it is even."""
    quarters = (math.ceil((max(side, GRID) + 2 * LONGEST_LAG_PX) / 4) for side in shape)
    return tuple(4 * scipy.fft.next_fast_len(quarter, real=True) for quarter in quarters)


def noise_covariance(noise: np.ndarray, quiet: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the autocovariance (2 `LONGEST_LAG_PX` + 1, squared) of the quiet pixels, lag 0 in the middle: means of
    products over pairs of known pixels, faded out by Parzen's window."""
    products = np.abs(scipy.fft.rfft2(np.where(quiet, noise, np.float32(0.0)), shape)) ** 2
    pairs = np.abs(scipy.fft.rfft2(quiet.astype(np.float32), shape)) ** 2
    lags = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
    sums, counts = (scipy.fft.irfft2(each, shape)[np.ix_(lags, lags)] for each in (products, pairs))
    lag = np.minimum(np.hypot(lags[:, None], lags) / LONGEST_LAG_PX, 1.0)
    parzen = np.where(lag <= 0.5, 1.0 - 6.0 * lag**2 * (1.0 - lag), 2.0 * (1.0 - lag) ** 3)
    return np.asarray(parzen * sums / np.maximum(counts, 1.0), np.float32)


def spectrum(covariance: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the power spectrum on ``shape``, as `scipy.fft.rfft2` orders it, of an autocovariance."""
    power = scipy.fft.rfft2(_centred(covariance, shape)).real
    return np.asarray(np.maximum(power, max(LEAST_POWER * float(power.mean()), 1e-12)).astype(np.float32))


def _centred(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an image of odd sides on a larger grid, its middle at pixel (0, 0)."""
    padded = np.zeros(shape, np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    return np.roll(padded, (-(image.shape[0] // 2), -(image.shape[1] // 2)), (0, 1))


def inverse_times(
    values: np.ndarray,
    known: np.ndarray,
    power: np.ndarray,
    shape: tuple[int, ...],
    converged: float = CONVERGED,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Return C^-1 r (r, c) over the known pixels, 0 elsewhere, for the covariance with this power spectrum, by
    conjugate gradients that start from the stationary inverse, or from ``start`` (r, c)."""
    h, w = values.shape
    mask, padded = known.astype(np.float32), np.zeros(shape, np.float32)

    def filtered(image: np.ndarray, by: np.ndarray) -> np.ndarray:
        padded[:h, :w] = image
        whole = scipy.fft.rfft2(padded)
        whole *= by
        return mask * scipy.fft.irfft2(whole, shape, overwrite_x=True)[:h, :w]

    inverse = 1.0 / power
    solution = filtered(values, inverse) if start is None else mask * start
    rest = values * mask - filtered(solution, power)
    towards = direction = filtered(rest, inverse)
    product, enough = float(np.vdot(rest, towards)), converged**2 * float(np.vdot(values * mask, values))
    for _ in range(MOST_ITERATIONS):
        if float(np.vdot(rest, rest)) <= enough or product <= 0:
            break
        onward = filtered(direction, power)
        step = product / float(np.vdot(direction, onward))
        solution += step * direction
        rest -= step * onward
        towards = filtered(rest, inverse)
        before, product = product, float(np.vdot(rest, towards))
        direction = towards + product / before * direction
    return np.asarray(solution)


def response(spectrum_of: np.ndarray, number: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return the correlation (r, c) of a picture, whose spectrum is given, with a template; of a coarse template, for
    which the spectrum is that of `halved`, in the middles of 2 x 2 pixels."""
    grid = (spectrum_of.shape[0], 2 * (spectrum_of.shape[1] - 1))
    if coarse(number):
        template = spectra((2 * grid[0], 2 * grid[1]))[number]
        shape = (-(-shape[0] // 2), -(-shape[1] // 2))
    else:
        template = spectra(grid)[number]
    return np.asarray(scipy.fft.irfft2(spectrum_of * template, grid)[: shape[0], : shape[1]])


def coarse(number: int) -> bool:
    """Return whether a template is wide, or a slot's: its scores are taken on every second pixel only, so that four
    cost as much as one."""
    return number >= FIRST_SLOT or ALL_RADII_PX[number] >= COARSE_PX


def halved(spectrum_of: np.ndarray) -> np.ndarray:
    """Return the spectrum of a picture's samples in the middles of 2 x 2 pixels, without its higher frequencies."""
    return _low(spectrum_of) * _middles((spectrum_of.shape[0], 2 * (spectrum_of.shape[1] - 1)))


@lru_cache(maxsize=4)
def _middles(shape: tuple[int, ...]) -> np.ndarray:
    """Return the factors that move a spectrum's lower half by half a pixel, and scale it to a quarter of the pixels."""
    cycles = np.add.outer(np.fft.fftfreq(shape[0] // 2) / 2, np.arange(shape[1] // 4 + 1) / shape[1])
    return np.asarray(np.exp(1j * np.pi * cycles) / 4.0, np.complex64)


def _low(spectrum_of: np.ndarray) -> np.ndarray:
    """Return the lower half of a spectrum's frequencies along either axis, as `scipy.fft.rfft2` orders them."""
    rows, columns = spectrum_of.shape[0] // 4, spectrum_of.shape[1] // 2 + 1
    return np.concatenate((spectrum_of[:rows, :columns], spectrum_of[-rows:, :columns]))


class Worth(NamedTuple):
    """The whitened energy of a template, and the sides (along columns, along rows), in pixels of its scores' picture,
    of the rectangle over which it spreads as widely."""

    energy: float
    sides: tuple[int, int]


def worths(power: np.ndarray) -> tuple[Worth, ...]:
    """Return what each template is worth under noise with this spectrum on `GRID`."""
    found, white = [], 1.0 / np.sqrt(power)
    low = _low(white)
    for number, template in enumerate(spectra((GRID, GRID))):
        values = template * (low if coarse(number) else white)
        # by Parseval's theorem; a second moment over space is the energy of a derivative over frequency
        half, side = np.full(values.shape[1], 2.0), len(values)
        half[[0, -1]] = 1.0
        energy = float((values**2).sum(axis=0) @ half)
        down = float(((values - np.roll(values, 1, axis=0)) ** 2).sum(axis=0) @ half)
        along = 2.0 * float((np.diff(values, axis=1) ** 2).sum())
        sides = (2 * round(math.sqrt(3.0 * each / energy) * side / (2.0 * math.pi)) + 1 for each in (along, down))
        found.append(Worth(energy / GRID**2, (next(sides), next(sides))))
    return tuple(found)


@lru_cache(maxsize=4)
def spectra(shape: tuple[int, ...]) -> tuple[np.ndarray, ...]:
    """Return the templates' spectra on a grid that holds them, which are real as templates are symmetric, for the
    height 1 of the undisturbed damage; of coarse templates the lower half."""
    drawn = (scipy.fft.rfft2(_centred(template, shape)).real for template in _templates())
    return tuple((_low(each) if coarse(number) else each).copy() for number, each in enumerate(drawn))


@lru_cache(maxsize=1)
def _templates() -> tuple[np.ndarray, ...]:
    """Return the templates, each on a square of an odd number of pixels."""
    window = np.outer(WINDOW, WINDOW) / np.sum(WINDOW) ** 2

    def disc(radius_px: float) -> np.ndarray:
        return _drawn(lambda x, y: np.hypot(x, y) < radius_px, radius_px, LENS_BLUR_PX)

    def dent(radius_px: float) -> np.ndarray:
        return _drawn(lambda x, y: np.maximum(1.0 - (x**2 + y**2) / radius_px**2, 0.0), radius_px, DENT_BLUR_PX)

    def slot(angle_deg: float) -> np.ndarray:
        turn = np.exp(-1j * math.radians(angle_deg))

        def inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            along = (x + 1j * y) * turn
            return (np.abs(along.real) < SLOT_PX[0] / 2) & (np.abs(along.imag) < SLOT_PX[1] / 2)

        return _drawn(inside, SLOT_PX[0] / 2, LENS_BLUR_PX)

    def windowed(image: np.ndarray) -> np.ndarray:
        return cv2.filter2D(image, -1, window, borderType=cv2.BORDER_CONSTANT)

    sharp, slots = map(disc, SHARP_RADII_PX), [slot(angle_deg) for angle_deg in SLOTS_DEG]
    return (*map(windowed, map(disc, RADII_PX)), *sharp, *map(dent, DENT_RADII_PX), *map(windowed, slots), *slots)


def _drawn(shape: Callable[[np.ndarray, np.ndarray], np.ndarray], reach_px: float, blur_px: float) -> np.ndarray:
    """Return a shape of x and y in pixels, averaged over pixels and blurred by a Gaussian."""
    finer, half = 4, int(reach_px + 5)
    places = (np.arange((2 * half + 1) * finer) + 0.5) / finer - (half + 0.5)
    height = shape(places[None, :], places[:, None]).astype(float)
    pixels = height.reshape(2 * half + 1, finer, 2 * half + 1, finer).mean(axis=(1, 3))
    return np.asarray(cv2.GaussianBlur(pixels, (0, 0), blur_px, borderType=cv2.BORDER_CONSTANT))


def noise_factor(
    used: np.ndarray, correlation: np.ndarray | None, deviation: float, model_error: np.ndarray
) -> np.ndarray | None:
    """Return Cholesky's lower factor (n, n) of the covariance of the ``used`` pixels (r, c), whose inverse times values
    has independent errors of deviation 1; None where there are too many pixels, or the correlation is not known or
    none. Errors are noise of one ``deviation`` and the model's own (r, c), both correlated by lag (odd, odd)."""
    rows, columns = np.nonzero(used)
    if correlation is None or len(rows) > MOST_WHITENED:
        return None
    reach = correlation.shape[0] // 2
    lags = np.stack([rows[:, None] - rows, columns[:, None] - columns]) + reach
    inside = ((lags >= 0) & (lags <= 2 * reach)).all(axis=0)
    alike = np.where(inside, correlation[tuple(np.clip(lags, 0, 2 * reach))], 0.0)
    try:
        return np.linalg.cholesky(alike * (deviation**2 + np.outer(model_error[used], model_error[used])))
    except np.linalg.LinAlgError:
        return None


def correlated_products(columns: np.ndarray, across: int, down: int) -> np.ndarray:
    """Return S' S (p, p) with S the columns (p, h, w), zero outside, summed over ``down`` x ``across`` windows."""
    padded = np.pad(np.moveaxis(columns, 0, -1), ((down - 1, down - 1), (across - 1, across - 1), (0, 0)))
    summed = cv2.boxFilter(padded, -1, (across, down), normalize=False, borderType=cv2.BORDER_CONSTANT)
    flat = summed.reshape(-1, len(columns))
    return np.asarray(flat.T @ flat)
