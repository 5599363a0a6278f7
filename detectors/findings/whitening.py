"""The covariance of correlated noise, and its inverse over the known pixels of a picture.

A picture holds residuals in standard deviations of the local noise. Its noise is stationary: the
covariance C of two pixels depends on their offset alone. The matched filters need C^-1 r for the
residuals r of the known pixels (`inverse_times`). Pictures are padded to larger grids by the
longest lag, so that nothing wraps around. `detectors.findings.whitening_reference` has the same
equations in dense algebra."""

import math
from typing import NamedTuple

import cv2
import numba
import numpy as np
import scipy.fft

from detectors.pixels.clusters import PLAIN

LONGEST_LAG_PX = 28  # lag at which Parzen's window fades the covariance to 0
GRID = 96  # side of the grid that holds the widest template and the reach of its whitened edge
LEAST_POWER = 0.01  # least value of the spectrum, as a share of its mean
LEAST_VARIANCE = 1e-12  # least value of the spectrum of a picture without noise

# --- the descent of `inverse_times` ---

CONVERGED = 0.15  # error of a score, in deviations, at which C^-1 r is solved
MOST_ITERATIONS = 80  # most steps of conjugate gradients
FADED = 0.3  # weight of 0 in the values that fill unknown pixels
EDGE_PX = 7.0
"""Depth of an outline's pixels among which errors count, in units of the sum of what is unknown
around its pixels."""
TAPS = np.array([1.0, 2.0, 3.0], np.float32) / np.float32(9.0)
"""Weights, along each axis, of second and direct neighbours and of the pixel itself, which fill
unknown pixels."""


class Filters(NamedTuple):
    """The noise's covariance as factors over frequencies, each packed as by `cv2.dft` and divided
    by the size of its grid, which the inverse transform lacks."""

    power: np.ndarray
    """Power spectrum on the grid (`grid_of`) of the picture: multiplies by C."""
    inverse: np.ndarray
    """Inverse spectrum on a smaller grid, where what wraps around costs no steps: divides by C
    approximately."""


def grid_of(
    shape: tuple[int, ...],
    least: int = GRID,
    margin: int = LONGEST_LAG_PX,
) -> tuple[int, ...]:
    """Return the grid for transforms of pictures of this shape, as they are fast.

    It holds every template, and its half is even. ``least``: its least side without the
    ``margin``, both in pixels."""
    return tuple(
        8 * scipy.fft.next_fast_len(math.ceil((max(side, least) + margin) / 8)) for side in shape
    )


# --- the covariance of a picture's noise ---


def noise_covariance(
    noise: np.ndarray,
    quiet: np.ndarray,
    shape: tuple[int, ...],
) -> np.ndarray:
    """Return the autocovariance (2 `LONGEST_LAG_PX` + 1, squared) of the quiet pixels.

    Lag 0 is in the middle. It is the mean product of pairs of quiet pixels by their lag, faded
    out by Parzen's window. ``noise`` (r, c), ``quiet`` (r, c) bool, ``shape``: of the grid."""
    lags = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
    sums = _by_lag(quiet * noise, shape)
    counts = _by_lag(quiet * np.float32(1.0), shape)
    lag = np.minimum(np.hypot(lags[:, None], lags) / LONGEST_LAG_PX, 1.0)
    inner = 1.0 - 6.0 * lag**2 * (1.0 - lag)
    outer = 2.0 * (1.0 - lag) ** 3
    parzen = np.where(lag <= 0.5, inner, outer)
    return np.asarray(parzen * sums / np.maximum(counts, 1.0), np.float32)


def _by_lag(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the sums of products of an image's pairs of pixels by lag, up to `LONGEST_LAG_PX`."""
    padded = np.zeros(shape, np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    cv2.dft(padded, dst=padded)
    cv2.mulSpectrums(padded, padded, 0, c=padded, conjB=True)
    products = cv2.dft(padded, dst=padded, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE)
    return products[_lags()]


def _lags() -> tuple[np.ndarray, ...]:
    """Return the indices of all lags on a grid whose lag 0 is pixel (0, 0)."""
    lags = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
    return np.ix_(lags, lags)


def centred(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an image of odd sides on a larger grid, its middle at pixel (0, 0)."""
    padded = np.zeros(shape, np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    return np.roll(padded, (-(image.shape[0] // 2), -(image.shape[1] // 2)), (0, 1))


def spectrum(covariance: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the power spectrum of an autocovariance on a grid of this shape, ordered as by
    `scipy.fft.rfft2`."""
    power = scipy.fft.rfft2(centred(covariance, shape)).real
    least = max(LEAST_POWER * float(power.mean()), LEAST_VARIANCE)
    return np.maximum(power, least).astype(np.float32)


def filters(covariance: np.ndarray, shape: tuple[int, ...]) -> Filters:
    """Return the `Filters` of noise with this covariance by lag for pictures of this shape."""
    power = _packed_power(covariance, grid_of(shape))
    small_power = _packed_power(covariance, grid_of(shape, 2 * LONGEST_LAG_PX, 4))
    return Filters(
        power=power / np.float32(power.size),
        inverse=np.float32(1.0 / small_power.size) / small_power,
    )


def _packed_power(covariance: np.ndarray, grid: tuple[int, ...]) -> np.ndarray:
    """Return the power spectrum on a grid, packed as by `cv2.dft`."""
    power = cv2.dft(centred(covariance, grid))
    # a real spectrum: the real factor of each number takes the imaginary one's place too, which
    # follows it in the row, but in the column at the two ends of the rows
    ends = slice(None, None, grid[1] - 1)
    power[:, 2::2] = power[:, 1:-1:2]
    power[2::2, ends] = power[1:-1:2, ends]
    least = max(LEAST_POWER * float(covariance.max()), LEAST_VARIANCE)
    return np.maximum(power, np.float32(least))


# --- the inverse over the known pixels ---


def inverse_times(
    values: np.ndarray,
    known: np.ndarray,
    by: Filters,
    start: np.ndarray | None = None,
    error: float = CONVERGED,
    added: np.ndarray | None = None,
) -> np.ndarray:
    """Return C^-1 r (r, c) over the known pixels, 0 elsewhere, for the `filters` of C, to whose
    diagonal the variances ``added`` (r, c) are added.

    Preconditioned conjugate gradients go on from ``start`` (r, c) until scores near unknown
    pixels, where errors gather, err by some ``error`` deviations. The preconditioner fills unknown
    pixels from their neighbours, applies the stationary inverse, and then the transpose of the
    filling: with zeros instead, ragged outlines and missing pixels take up to four times the
    steps. It would still be too large along outlines: damping it the more, the less is known
    around a pixel, saves a fifth of the steps. What is added makes the problem easier, and is left
    out of the preconditioner."""
    height, width = values.shape
    mask = known.astype(np.float32)
    padded = np.zeros_like(by.power)
    padded_product = np.empty_like(by.power)
    covariance_times = np.empty_like(mask)
    filled = np.zeros_like(by.inverse)
    conditioned = np.empty_like(mask)

    # what is known around each pixel damps; unknown pixels are means of what is known around them
    filled[:height, :width] = mask
    known_around = cv2.GaussianBlur(
        filled,
        (13, 13),
        2.0,
        borderType=cv2.BORDER_CONSTANT,
    )
    known_around = known_around[:height, :width]
    damping = mask * np.sqrt(known_around)
    filling = np.empty_like(by.inverse)
    _spread(mask, mask, np.ones_like(filling), False, filling)
    filling = (1.0 - filled) / (filling + FADED)
    unknown = float(mask.sum() - np.vdot(mask, known_around))
    enough = error**2 * min(EDGE_PX * unknown, float(mask.sum()))

    def multiply(image: np.ndarray) -> None:
        """Write C times an image into ``covariance_times``."""
        padded[:height, :width] = image
        product = _filtered(padded, by.power, padded_product)
        np.multiply(product[:height, :width], mask, out=covariance_times)
        if added is not None:
            np.add(covariance_times, added * image, out=covariance_times)

    def condition(image: np.ndarray) -> None:
        """Write the approximate C^-1 times an image into ``conditioned``."""
        _spread(image, damping, filling, False, filled)
        _spread(
            _filtered(filled, by.inverse, filled),
            filling,
            damping,
            True,
            conditioned,
        )

    solution = np.zeros_like(mask)
    residual = values * mask
    if start is not None:
        solution = mask * start
        multiply(solution)
        residual -= covariance_times
    condition(residual)
    direction = conditioned.copy()
    product = float(np.vdot(residual, conditioned))
    for _ in range(MOST_ITERATIONS):
        if product <= enough:
            break
        multiply(direction)
        step = product / float(np.vdot(direction, covariance_times))
        cv2.scaleAdd(direction, step, solution, dst=solution)
        cv2.scaleAdd(covariance_times, -step, residual, dst=residual)
        condition(residual)
        last_product = product
        product = float(np.vdot(residual, conditioned))
        cv2.scaleAdd(direction, product / last_product, conditioned, dst=direction)
    return solution


def root_times(values: np.ndarray, by: Filters) -> np.ndarray:
    """Return C^1/2 times values (r, c) that are 0 where nothing is known, for the `filters` of C.

    Of C^-1 r it makes C^-1/2 r: white noise of deviation 1, away from unknown pixels and but for
    frequencies at which the spectrum is raised to its least value."""
    height, width = values.shape
    padded = np.zeros_like(by.power)
    padded[:height, :width] = values
    # the factors contain the size of the grid once, as the inverse transform needs it
    root = np.sqrt(by.power / np.float32(by.power.size))
    return _filtered(padded, root, padded)[:height, :width].copy()


def covariance_product(values: np.ndarray, by: Filters) -> np.ndarray:
    """Return C times values (r, c) at all pixels (r, c), for the `filters` of C."""
    height, width = values.shape
    padded = np.zeros_like(by.power)
    padded[:height, :width] = values
    return _filtered(padded, by.power, padded)[:height, :width]


def _filtered(
    image: np.ndarray,
    factors: np.ndarray,
    out: np.ndarray,
) -> np.ndarray:
    """Return ``out``, which gets the image with its frequencies multiplied by factors."""
    np.multiply(cv2.dft(image, dst=out), factors, out=out)
    return cv2.dft(out, dst=out, flags=cv2.DFT_INVERSE)


@numba.njit(**PLAIN)
def _spread(
    image: np.ndarray,
    inner: np.ndarray,
    outer: np.ndarray,
    back: bool,
    out: np.ndarray,
) -> None:
    """Write s + ``outer`` x (s blurred by `TAPS`) into the grid ``out``, where s is ``image`` x
    ``inner``, on a grid that is 0 elsewhere.

    If ``back``, write the transpose: (image + s blurred) x ``outer``. Grids share a corner.
    `detectors.findings.whitening_reference.spread` is the same, written plainly."""
    out_height, out_width = out.shape
    height, width = image.shape
    columns = max(out_width, width)
    second = TAPS[0]
    direct = TAPS[1]
    itself = TAPS[2]
    rows_of_s = np.zeros((5, columns), np.float32)  # a ring: the last five rows of s
    sums = np.zeros(columns + 4, np.float32)  # sums of these rows, between two zeros on each side
    # views instead of offsets, so that the compiler uses vectors
    two_left = sums
    left = sums[1:]
    middle = sums[2 : 2 + columns]
    right = sums[3:]
    two_right = sums[4:]
    for i in range(out_height + 2):
        newest = rows_of_s[i % 5]
        if i < height:
            image_row = image[i]
            inner_row = inner[i]
            for j in range(width):
                newest[j] = image_row[j] * inner_row[j]
        else:
            for j in range(width):
                newest[j] = 0
        row = i - 2
        if row >= 0:
            two_above = rows_of_s[(i + 1) % 5]
            above = rows_of_s[(i + 2) % 5]
            centre = rows_of_s[(i + 3) % 5]
            below = rows_of_s[(i + 4) % 5]
            out_row = out[row]
            outer_row = outer[row]
            for j in range(columns):
                middle[j] = (
                    second * (two_above[j] + newest[j])
                    + direct * (above[j] + below[j])
                    + itself * centre[j]
                )
            added = image[row] if back else centre
            for j in range(out_width):
                sides = second * (two_left[j] + two_right[j]) + direct * (left[j] + right[j])
                blurred = sides + itself * middle[j]
                if back:
                    out_row[j] = (added[j] + blurred) * outer_row[j]
                else:
                    out_row[j] = added[j] + blurred * outer_row[j]
