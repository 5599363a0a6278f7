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

SMALL_RADII_PX, HALVES_PX = (0.5, 1.5), ((0.0, 0.0), (0.5, 0.5), (0.0, 0.5), (0.5, 0.0))
"""Radii of small discs, and the places between pixels at which they are compared: through a window with sharp sides
half a pixel costs up to a seventh of the score. The first stands for all holes smaller than a pixel."""
RADII_PX = (2.2, 3.2, 4.5, 6.4, 9.0, 13.0, 18.0)
"""Radii of further discs."""
DENT_RADII_PX = (5.0, 6.5, 8.0, 10.0, 12.0, 14.5, 17.5)
"""Radii of paraboloids: denser, as before a fixed pattern their rims decide."""
SLOT_PX, SLOTS_DEG = (20.0, 2.0), tuple(22.5 * k for k in range(8))
"""Length and width of slots, and the angle of each to the rows."""
WINDOWS_PX = (1, 3, 5)
"""Sides of the square over which cameras average, continuous-wave cameras their phasors: 3 before a Kinect v2, 5 before
an Azure Kinect. Without it the lens alone blurs."""
LENS_BLUR_PX = 0.6
LONGEST_LAG_PX = 28
"""Lag at which the covariance has faded (Parzen's window)."""
COARSE_PX = 9.0
"""Radius from which on the scores of every second pixel are taken: between them they change by some hundredths."""
LEAST_POWER = 0.01
"""The spectrum is nowhere below this share of its mean."""
MOST_WHITENED = 2000  # pixels whose dense covariance is factored: 0.2 s and 64 MB
SIDES_PX = (0, 1, 2, 3, 5, 8, 12, 18)
"""Halves of the sides that a `Worth` may have: the share that is seen is taken once for each."""
GRID = 96
"""Side of the grid that holds the widest template and the reach of its whitened edge."""
CONVERGED, MOST_ITERATIONS = 0.01, 40
"""Relative residual at which C^-1 r counts as solved, and a bound on the steps there."""


def grid_of(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the grid on which a picture of this shape is transformed; it holds every template; half of it is even."""
    quarters = (math.ceil((max(side, GRID) + LONGEST_LAG_PX) / 4) for side in shape)
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


def window_of(covariance: np.ndarray) -> int:
    """Return the side of `WINDOWS_PX` that noise shows: its covariance falls steadily with the lag up to the side of a
    square, and bends there; neighbours that share less than half were not averaged."""
    middle = len(covariance) // 2
    by_lag = (covariance[middle, middle:] + covariance[middle:, middle]) / 2.0
    if by_lag[1] < 0.5 * by_lag[0]:
        return 1
    return max(WINDOWS_PX[1:], key=lambda side: float(by_lag[side - 1] - 2.0 * by_lag[side] + by_lag[side + 1]))


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
    product, enough = float(np.vdot(rest, towards)), CONVERGED**2 * float(np.vdot(values * mask, values))
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


def response(spectrum_of: np.ndarray, template: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the correlation (r, c) of a picture with a template, both as spectra; of `halved` ones for a ``shape``
    half as large, in the middles of 2 x 2 pixels."""
    grid = (spectrum_of.shape[0], 2 * (spectrum_of.shape[1] - 1))
    return np.asarray(scipy.fft.irfft2(spectrum_of * template, grid, overwrite_x=True)[: shape[0], : shape[1]])


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


class Template(NamedTuple):
    """A damage's picture on a square of an odd number of pixels, its centre ``halves`` (down, right) of half a pixel
    off the middle; the radius of a disc as large; whether it is a slot; whether its scores change so slowly that every
    second pixel tells them."""

    image: np.ndarray
    radius_px: float
    halves: tuple[int, int] = (0, 0)
    slot: bool = False
    coarse: bool = False


class Worth(NamedTuple):
    """The whitened energy of a template, and the sides (along columns, along rows), in pixels of its scores' picture,
    of the rectangle over which it spreads as widely; ``raised``: by how much the square of a score exceeds that of the
    template with the most independent places where maxima are as rare, halved so that the many wide templates together
    do not make all false calls."""

    energy: float
    sides: tuple[int, int]
    raised: float


def worths(power: np.ndarray, window_px: int) -> tuple[Worth, ...]:
    """Return what each template is worth under noise with this spectrum on `GRID`."""
    found, crowds, white = [], [], 1.0 / np.sqrt(power)
    low = _low(white)
    for template, spectrum_of in zip(bank(window_px), spectra((GRID, GRID), window_px), strict=True):
        values = np.abs(spectrum_of) * (low if template.coarse else white)
        # by Parseval's theorem; a second moment over space is the energy of a derivative over frequency
        half, side = np.full(values.shape[1], 2.0), len(values)
        half[[0, -1]] = 1.0
        energies = values**2 * half
        energy = float(energies.sum())
        down = float((((values - np.roll(values, 1, axis=0)) ** 2) * half).sum())
        along = 2.0 * float((np.diff(values, axis=1) ** 2).sum())
        reach = (math.sqrt(3.0 * each / energy) * side / (2.0 * math.pi) for each in (along, down))
        halves = (SIDES_PX[int(np.abs(np.array(SIDES_PX) - each).argmin())] for each in reach)
        sides = 2 * next(halves) + 1, 2 * next(halves) + 1
        # maxima are as dense as the root of the score's second spectral moments (Adler 1981)
        cycles = np.fft.fftfreq(side)[:, None] ** 2, np.arange(values.shape[1])[None] ** 2 / side**2
        crowds.append(math.prod(float((energies * each).sum()) / energy for each in cycles) ** 0.5 * side**2)
        found.append(Worth(energy / GRID**2, sides, 0.0))
    most = max(crowds)
    return tuple(one._replace(raised=math.log(most / crowd)) for one, crowd in zip(found, crowds, strict=True))


@lru_cache(maxsize=6)
def spectra(shape: tuple[int, ...], window_px: int) -> tuple[np.ndarray, ...]:
    """Return the templates' spectra on a grid that holds them, conjugated, for the height 1 of the undisturbed damage;
    of coarse templates the lower half. Those of symmetric templates are real."""
    found = []
    for template in bank(window_px):
        drawn = scipy.fft.rfft2(_centred(template.image, shape)).conj()
        drawn = drawn if any(template.halves) else drawn.real
        found.append((_low(drawn) if template.coarse else drawn).copy())
    return tuple(found)


@lru_cache(maxsize=3)
def bank(window_px: int) -> tuple[Template, ...]:
    """Return the templates as seen through a window of `WINDOWS_PX`: discs, paraboloids, slots."""

    def disc(radius_px: float, off: tuple[float, float] = (0.0, 0.0)) -> Template:
        def inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return np.hypot(x - off[1], y - off[0]) < radius_px

        halves = (int(2 * off[0]), int(2 * off[1]))
        return Template(seen(inside, radius_px), radius_px, halves, coarse=radius_px >= COARSE_PX)

    def dent(radius_px: float) -> Template:
        image = seen(lambda x, y: np.maximum(1.0 - (x**2 + y**2) / radius_px**2, 0.0), radius_px)
        return Template(image, radius_px, coarse=radius_px >= COARSE_PX)

    def slot(angle_deg: float) -> Template:
        turn = np.exp(-1j * math.radians(angle_deg))

        def inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            along = (x + 1j * y) * turn
            return (np.abs(along.real) < SLOT_PX[0] / 2) & (np.abs(along.imag) < SLOT_PX[1] / 2)

        return Template(seen(inside, SLOT_PX[0] / 2), SLOT_PX[0] / 4, slot=True, coarse=True)

    def seen(shape: Callable[[np.ndarray, np.ndarray], np.ndarray], reach_px: float) -> np.ndarray:
        """Return a shape of x and y in pixels, averaged over pixels, and through the window or a lens."""
        finer, half = 4, int(reach_px + 5)
        places = (np.arange((2 * half + 1) * finer) + 0.5) / finer - (half + 0.5)
        height = shape(places[None, :], places[:, None]).astype(float)
        pixels = height.reshape(2 * half + 1, finer, 2 * half + 1, finer).mean(axis=(1, 3))
        if window_px > 1:
            return np.asarray(cv2.blur(pixels, (window_px, window_px), borderType=cv2.BORDER_CONSTANT))
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), LENS_BLUR_PX, borderType=cv2.BORDER_CONSTANT))

    small = (disc(radius_px, off) for radius_px in SMALL_RADII_PX for off in HALVES_PX)
    return (*small, *map(disc, RADII_PX), *map(dent, DENT_RADII_PX), *map(slot, SLOTS_DEG))


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
