"""The templates of the matched filters, and the whitening of noise. Pictures are residuals in
standard deviations of the local noise, on grids padded by the longest lag, so that nothing wraps
around."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numba
import numpy as np
import scipy.fft
import scipy.linalg

from detectors.findings.clusters import PLAIN

Filters = tuple[np.ndarray, np.ndarray]
SMALL_RADII_PX = (0.5, 1.5)
HALVES_PX = ((0.0, 0.0), (0.5, 0.5), (0.0, 0.5), (0.5, 0.0))
"""Radii of small discs, and the positions between pixels at which they are compared: half a pixel
costs up to a seventh of the score if the window has sharp sides. The first radius stands for all
holes smaller than a pixel."""
RADII_PX = (2.2, 3.2, 4.5, 6.4, 9.0, 13.0, 18.0)  # radii of further discs
DEEP_PX = 1.0
DEEP_WINDOW_PX = 3
"""Radius of a disc that only the lens blurs, and the window with which it is compared too: a
filter that weighs pixels by phase (libfreenect2) does not average narrow deep holes. The bank's
discs have .74 of the score of such a hole."""
DENT_RADII_PX = (5.0, 6.5, 8.0, 10.0, 12.0, 14.5, 17.5)
"""Radii of paraboloids. They are denser because before a fixed pattern the rims decide."""
SLOT_PX = (12.0, 2.0)
SLOTS_DEG = tuple(15.0 * k for k in range(12))
"""Length and width of slots, and their angles to the rows: shorter than most, so that a few angles
suffice."""
WINDOWS_PX = (1, 3, 5)
"""Sides of the square over which cameras average: 3 for a Kinect v2, 5 for an Azure Kinect, 1:
only the lens blurs."""
LENS_BLUR_PX = 0.6
LONGEST_LAG_PX = 28  # lag at which Parzen's window fades the covariance to 0
COARSE_PX = 9.0
"""Radius from which only every second pixel is scored: between these pixels, scores change by some
hundredths."""
LEAST_POWER = 0.01  # least value of the spectrum, as a share of its mean
MOST_WHITENED = 2000  # most pixels whose dense covariance is factored: 0.1 s and 32 MB
SIDES_PX = (
    0,
    1,
    2,
    3,
    5,
    8,
    12,
    18,
)  # half-sides that a `Worth` may have: the visible share is computed once for each
GRID = 96  # side of the grid that holds the widest template and the reach of its whitened edge
CONVERGED = 0.15
MOST_ITERATIONS = 80
FADED = 0.3
"""Error at which C^-1 r is solved, most steps, and weight of 0 in the values that fill unknown
pixels."""
EDGE_PX = 7.0
"""Depth of an outline's pixels among which errors count, in units of the sum of what is unknown
around its pixels."""
TAPS = np.array([1.0, 2.0, 3.0], np.float32) / np.float32(9.0)
"""Weights, along each axis, of second and direct neighbours and of the pixel itself, which fill
unknown pixels."""


def grid_of(
    shape: tuple[int, ...], least: int = GRID, more: int = LONGEST_LAG_PX
) -> tuple[int, ...]:
    """Return the grid for transforms of pictures of this shape, as they are fast; it holds every
    template, and its half is even. ``least``: its least side without the margin of ``more``
    pixels."""
    return tuple(
        8 * scipy.fft.next_fast_len(math.ceil((max(side, least) + more) / 8)) for side in shape
    )


def noise_covariance(noise: np.ndarray, quiet: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the autocovariance (2 `LONGEST_LAG_PX` + 1, squared) of the quiet pixels, lag 0 in
    the middle: mean products of pairs of known pixels, faded out by Parzen's window."""
    lags = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
    sums = _by_lag(quiet * noise, shape)
    counts = _by_lag(quiet * np.float32(1.0), shape)
    lag = np.minimum(np.hypot(lags[:, None], lags) / LONGEST_LAG_PX, 1.0)
    parzen = np.where(lag <= 0.5, 1.0 - 6.0 * lag**2 * (1.0 - lag), 2.0 * (1.0 - lag) ** 3)
    return np.asarray(parzen * sums / np.maximum(counts, 1.0), np.float32)


def _by_lag(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the sums of products of an image's pairs of pixels by lag, up to `LONGEST_LAG_PX`."""
    whole = np.zeros(shape, np.float32)
    reach = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
    whole[: image.shape[0], : image.shape[1]] = image
    cv2.dft(whole, dst=whole)
    cv2.mulSpectrums(whole, whole, 0, c=whole, conjB=True)
    return np.asarray(cv2.dft(whole, dst=whole, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE))[
        np.ix_(reach, reach)
    ]


def spectrum(covariance: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the power spectrum of an autocovariance on ``shape``, ordered as by
    `scipy.fft.rfft2`."""
    power = scipy.fft.rfft2(_centred(covariance, shape)).real
    return np.asarray(
        np.maximum(power, max(LEAST_POWER * float(power.mean()), 1e-12)).astype(np.float32)
    )


def correlation(covariance: np.ndarray) -> np.ndarray:
    """Return the correlation (2 `LONGEST_LAG_PX` + 1, squared) by lag of noise with the `spectrum`
    of a covariance."""
    reach = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
    lags = scipy.fft.irfft2(spectrum(covariance, (GRID, GRID)), (GRID, GRID))[np.ix_(reach, reach)]
    return np.asarray(lags / lags[LONGEST_LAG_PX, LONGEST_LAG_PX], np.float64)


def window_of(covariance: np.ndarray) -> int:
    """Return the side of `WINDOWS_PX` that the noise indicates: averaging over a square makes the
    covariance fall steadily with the lag up to its side, and bend there. A correlation of
    neighbours below 0.5 means no averaging."""
    middle = len(covariance) // 2
    by_lag = (covariance[middle, middle:] + covariance[middle:, middle]) / 2.0
    if by_lag[1] < 0.5 * by_lag[0]:
        return 1
    return max(
        WINDOWS_PX[1:],
        key=lambda side: float(by_lag[side - 1] - 2.0 * by_lag[side] + by_lag[side + 1]),
    )


def _centred(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an image of odd sides on a larger grid, its middle at pixel (0, 0)."""
    padded = np.zeros(shape, np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    return np.roll(padded, (-(image.shape[0] // 2), -(image.shape[1] // 2)), (0, 1))


def filters(covariance: np.ndarray, shape: tuple[int, ...]) -> Filters:
    """Return the power spectrum of noise with this covariance on the grid of pictures of this
    ``shape``, and its inverse on a smaller grid, where what wraps around costs no steps. Both are
    packed as by `cv2.dft`, over sizes."""
    powers = []
    for each in (grid_of(shape), grid_of(shape, 2 * LONGEST_LAG_PX, 4)):
        power = cv2.dft(_centred(covariance, each))
        # a real spectrum: the real factor of each number takes the imaginary one's place too
        power[:, 2::2], power[2::2, :: each[1] - 1] = (
            power[:, 1:-1:2],
            power[1:-1:2, :: each[1] - 1],
        )
        powers.append(
            np.maximum(power, np.float32(max(LEAST_POWER * float(covariance.max()), 1e-12)))
        )
    return powers[0] / np.float32(powers[0].size), np.float32(1.0 / powers[1].size) / powers[1]


def inverse_times(
    values: np.ndarray,
    known: np.ndarray,
    by: Filters,
    start: np.ndarray | None = None,
    error: float = CONVERGED,
) -> np.ndarray:
    """Return C^-1 r (r, c) over the known pixels, 0 elsewhere, for the `filters` of C. Conjugate
    gradients go on from ``start`` (r, c) until scores near unknown pixels, where errors gather,
    err by some ``error`` deviations. The preconditioner fills unknown pixels from their
    neighbours, applies the stationary inverse, and then the transpose of the filling: with zeros
    instead, ragged outlines and missing pixels take up to four times the steps. It would still be
    too large along outlines: damping it the more, the less is known around a pixel, saves a fifth
    of the steps."""
    (h, w), mask, (power, inverse) = values.shape, known.astype(np.float32), by
    wide = np.zeros_like(power)
    whole = np.empty_like(power)
    onward = np.empty_like(mask)
    tight = np.zeros_like(inverse)
    share = np.empty_like(inverse)
    towards = np.empty_like(mask)
    tight[:h, :w] = mask
    near = cv2.GaussianBlur(tight, (13, 13), 2.0, borderType=cv2.BORDER_CONSTANT)[:h, :w]
    damp = mask * np.sqrt(near)
    unknown = float(mask.sum() - np.vdot(mask, near))
    enough = error**2 * min(EDGE_PX * unknown, float(mask.sum()))
    _spread(mask, mask, np.ones_like(share), False, share)
    share = (1.0 - tight) / (share + FADED)

    def filtered(image: np.ndarray, factors: np.ndarray, out: np.ndarray) -> np.ndarray:
        np.multiply(cv2.dft(image, dst=out), factors, out=out)
        return np.asarray(cv2.dft(out, dst=out, flags=cv2.DFT_INVERSE))

    def covered(image: np.ndarray) -> np.ndarray:
        wide[:h, :w] = image
        return np.multiply(filtered(wide, power, whole)[:h, :w], mask, out=onward)

    def conditioned(image: np.ndarray) -> np.ndarray:
        filled = filtered(_spread(image, damp, share, False, tight), inverse, tight)
        return _spread(filled, share, damp, True, towards)

    solution = np.zeros_like(mask)
    rest = values * mask
    if start is not None:
        solution = mask * start
        rest -= covered(solution)
    direction = conditioned(rest).copy()
    product = float(np.vdot(rest, towards))
    for _ in range(MOST_ITERATIONS):
        if product <= enough:
            break
        step = product / float(np.vdot(direction, covered(direction)))
        cv2.scaleAdd(direction, step, solution, dst=solution)
        cv2.scaleAdd(onward, -step, rest, dst=rest)
        before = product
        product = float(np.vdot(rest, conditioned(rest)))
        cv2.scaleAdd(direction, product / before, towards, dst=direction)
    return solution


@numba.njit(**PLAIN)
def _spread(
    image: np.ndarray, inner: np.ndarray, outer: np.ndarray, back: bool, out: np.ndarray
) -> np.ndarray:
    """Write s = ``image`` x ``inner``, on a grid that is 0 elsewhere, plus ``outer`` x s blurred
    by `TAPS`, into the grid ``out``; or if ``back``, the transpose: the image plus s blurred,
    times ``outer``. Grids share a corner."""
    (height, width), (h, w) = out.shape, image.shape
    columns, (one, two, three) = max(width, w), (TAPS[0], TAPS[1], TAPS[2])
    lines = np.zeros((5, columns), np.float32)
    down = np.zeros(columns + 4, np.float32)
    # views instead of offsets, so that the compiler uses vectors
    left = down
    beside = down[1:]
    middle = down[2 : 2 + columns]
    next_to = down[3:]
    right = down[4:]
    for i in range(height + 2):
        line = lines[i % 5]
        if i < h:
            seen = image[i]
            by = inner[i]
            for j in range(w):
                line[j] = seen[j] * by[j]
        else:
            for j in range(w):
                line[j] = 0
        row = i - 2
        if row >= 0:
            above = lines[(i + 1) % 5]
            over = lines[(i + 2) % 5]
            own = lines[(i + 3) % 5]
            under = lines[(i + 4) % 5]
            to = out[row]
            times = outer[row]
            for j in range(columns):
                middle[j] = one * (above[j] + line[j]) + two * (over[j] + under[j]) + three * own[j]
            add = image[row] if back else own
            for j in range(width):
                sides = one * (left[j] + right[j]) + two * (beside[j] + next_to[j])
                blurred = sides + three * middle[j]
                to[j] = (add[j] + blurred) * times[j] if back else add[j] + blurred * times[j]
    return out


def transformed(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the spectrum, complex (r, c), of an image padded with zeros to a grid of this shape."""
    padded = np.zeros((*shape, 2), np.float32)
    padded[: image.shape[0], : image.shape[1], 0] = image
    return np.asarray(cv2.dft(padded, dst=padded)).view(np.complex64)[..., 0]


def responses(
    spectrum_of: np.ndarray, pair: np.ndarray, out: np.ndarray | None = None
) -> np.ndarray:
    """Return the correlations (r, c, 2) of a picture with two templates, from its spectrum and
    theirs (`spectra`). For a `halved` picture, they are those in the middles of 2 x 2 pixels."""
    whole = np.multiply(spectrum_of, pair, out=out).view(np.float32).reshape(*pair.shape, 2)
    return np.asarray(cv2.dft(whole, dst=whole, flags=cv2.DFT_INVERSE))


def halved(spectrum_of: np.ndarray) -> np.ndarray:
    """Return the spectrum of a picture sampled in the middles of 2 x 2 pixels, without higher
    frequencies."""
    return _low(spectrum_of) * _middles(spectrum_of.shape)


@lru_cache(maxsize=4)
def _middles(shape: tuple[int, ...]) -> np.ndarray:
    """Return the factors that shift a spectrum's lower half by half a pixel and scale it to a
    quarter of the pixels."""
    cycles = np.add.outer(*(np.fft.fftfreq(side // 2) / 2 for side in shape))
    factors = np.asarray(np.exp(1j * np.pi * cycles) / 4.0, np.complex64)
    # the highest frequency has no sign, so that half a pixel of it is not real
    factors[shape[0] // 4], factors[:, shape[1] // 4] = 0.0, 0.0
    return factors


def _low(spectrum_of: np.ndarray) -> np.ndarray:
    """Return the lower half of a spectrum's frequencies along both axes."""
    rows, columns = (np.r_[: side // 4, -(side // 4) : 0] for side in spectrum_of.shape)
    return spectrum_of[np.ix_(rows, columns)]


class Template(NamedTuple):
    """A damage's picture on a square of odd side. ``radius_px``: of a disc of equal size.
    ``halves`` (down, right): offset of its centre from the middle in half pixels. ``coarse``:
    whether it is scored on every second pixel."""

    image: np.ndarray
    radius_px: float
    halves: tuple[int, int] = (0, 0)
    slot: bool = False
    coarse: bool = False


class Worth(NamedTuple):
    """``energy``: whitened energy of a template. ``sides`` (along columns, along rows): of the
    rectangle that spreads as widely, in pixels of its scores' picture. ``raised``: amount by which
    the square of a score exceeds that of the template with the most independent places where
    maxima are equally rare; half of it for the many wide templates."""

    energy: float
    sides: tuple[int, int]
    raised: float


def worths(power: np.ndarray, window_px: int) -> tuple[Worth, ...]:
    """Return each template's `Worth` under noise with this spectrum on `GRID`."""
    found = []
    crowds = []
    for cut, squares, beside, weights in _energies(window_px):
        white = 1.0 / np.sqrt(power[cut])
        side = len(white)
        pairs = (white * np.roll(white, 1, axis=0), white * np.roll(white, -1, axis=1))
        energy, of_rows, of_columns = (squares @ (weights * np.square(white).ravel()).T).T
        # Parseval's theorem: a second moment over space is the energy of a derivative over
        # frequency
        spread = [
            2.0 * (energy - of @ each.ravel()) for of, each in zip(beside, pairs, strict=True)
        ]
        reach = (
            np.sqrt(3.0 * np.stack(spread[::-1], axis=1) / energy[:, None]) * side / (2.0 * math.pi)
        )
        halves = np.array(SIDES_PX)[np.abs(np.array(SIDES_PX) - reach[..., None]).argmin(axis=2)]
        # the density of maxima is the root of the score's second spectral moments (Adler 1981)
        crowds += (np.sqrt(of_rows * of_columns) / energy * side**2).tolist()
        found += [
            Worth(each / GRID**2, (2 * across + 1, 2 * along + 1), 0.0)
            for each, (across, along) in zip(energy.tolist(), halves.tolist(), strict=True)
        ]
    # slots of all angles together are as rare as one round template
    most = max(crowds)
    alike = [len(SLOTS_DEG) if template.slot else 1 for template in bank(window_px)]
    rarer = (most / (crowd * number) for crowd, number in zip(crowds, alike, strict=True))
    return tuple(
        each._replace(raised=max(math.log(by), 0.0)) for each, by in zip(found, rarer, strict=True)
    )


@lru_cache(maxsize=3)
def _energies(
    window_px: int,
) -> list[tuple[tuple[np.ndarray, ...], np.ndarray, list[np.ndarray], np.ndarray]]:
    """Return what `worths` sums over half of the spectra (r, c) on `GRID`, of fine and coarse
    templates: where these frequencies lie, the squares (t, r c) of the magnitudes, their products
    (t, r c) with those of the frequencies above and to the right, and the weights (3, r c) of the
    squares: 1, and the squares of both frequencies."""
    sizes = [
        np.abs(scipy.fft.rfft2(_centred(template.image, (GRID, GRID))))
        for template in bank(window_px)
    ]
    found = []
    for coarse, side in ((False, GRID), (True, GRID // 2)):
        cut = np.ix_(np.r_[: side // 2, GRID - side // 2 : GRID], np.arange(side // 2 + 1))
        values = np.stack(
            [
                size[cut]
                for size, each in zip(sizes, bank(window_px), strict=True)
                if each.coarse == coarse
            ]
        )
        half = np.full(side // 2 + 1, 2.0, np.float32)
        half[[0, -1]] = 1.0
        beside = [
            half * values * np.roll(values, 1, axis=1),
            2.0 * values * np.roll(values, -1, axis=2),
        ]
        beside[1][..., -1] = 0.0
        rows = np.fft.fftfreq(side)[:, None] ** 2
        columns = (np.arange(side // 2 + 1) / side) ** 2
        weights = np.stack([half + 0.0 * rows, half * rows, half * columns + 0.0 * rows]).reshape(
            3, -1
        )
        flat = [
            np.asarray(each.reshape(len(values), -1), np.float32) for each in (values**2, *beside)
        ]
        found.append((cut, flat[0], flat[1:], weights.astype(np.float32)))
    return found


@lru_cache(maxsize=6)
def spectra(
    shape: tuple[int, ...], window_px: int
) -> tuple[tuple[np.ndarray, tuple[int, ...]], ...]:
    """Return the spectra of pairs of templates (an odd one alone) of undisturbed damage of height
    1 on a grid, and their numbers in the `bank`: one complex transform correlates a real picture
    with both. They are divided by the size of the inverse transform. Coarse templates have only
    the lower half."""
    pairs = []
    for coarse in (False, True):
        numbers = [
            number for number, template in enumerate(bank(window_px)) if template.coarse == coarse
        ]
        for pair in (tuple(numbers[at : at + 2]) for at in range(0, len(numbers), 2)):
            drawn = [
                transformed(_centred(bank(window_px)[number].image, shape), shape)
                for number in pair
            ]
            both = sum(
                np.conj(_low(each) if coarse else each) * 1j**at for at, each in enumerate(drawn)
            )
            pairs.append(
                (np.asarray(both / drawn[0].size * (4 if coarse else 1), np.complex64), pair)
            )
    return tuple(pairs)


@lru_cache(maxsize=3)
def bank(window_px: int) -> tuple[Template, ...]:
    """Return the templates as seen through a window of `WINDOWS_PX`: discs, paraboloids and slots;
    coarse ones last."""

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
        """Return a shape of x and y in pixels, averaged over pixels and blurred by a lens."""
        finer = 4
        half = int(reach_px + 5)
        places = (np.arange((2 * half + 1) * finer) + 0.5) / finer - (half + 0.5)
        height = shape(places[None, :], places[:, None]).astype(float)
        pixels = height.reshape(2 * half + 1, finer, 2 * half + 1, finer).mean(axis=(1, 3))
        return np.asarray(
            cv2.GaussianBlur(pixels, (0, 0), LENS_BLUR_PX, borderType=cv2.BORDER_CONSTANT)
        )

    small = (disc(radius_px, off) for radius_px in SMALL_RADII_PX for off in HALVES_PX)
    sharp = [*small, *map(disc, RADII_PX), *map(dent, DENT_RADII_PX), *map(slot, SLOTS_DEG)]
    window = (window_px, window_px)
    border = cv2.BORDER_CONSTANT
    found = [
        each._replace(image=np.asarray(cv2.blur(each.image, window, borderType=border)))
        for each in sharp
    ]
    found += [disc(DEEP_PX, off) for off in HALVES_PX if window_px == DEEP_WINDOW_PX]
    return tuple(sorted(found, key=lambda template: template.coarse))


def covariance_factor(
    used: np.ndarray, correlation: np.ndarray | None, deviation: float, model_error: np.ndarray
) -> np.ndarray | None:
    """Return the lower triangular L (n, n) of the covariance L L' of the errors at the ``used``
    pixels (r, c). None if there are too many pixels, or if the correlation is unknown or zero.
    Errors are noise of one ``deviation`` and the model's own (r, c), both with the ``correlation``
    by lag (odd, odd)."""
    if correlation is None or np.count_nonzero(used) > MOST_WHITENED:
        return None
    matrix = _lower_covariance(*np.nonzero(used), model_error[used], deviation**2, correlation)
    # in LAPACK's order of elements its transpose is an upper triangle, which needs no copy
    _, failed = scipy.linalg.lapack.dpotrf(matrix.T, lower=False, clean=False, overwrite_a=True)
    return None if failed else matrix


@numba.njit(**PLAIN)
def _lower_covariance(  # type: ignore[no-untyped-def]
    rows, columns, error, variance, correlation
):
    """Return the lower triangle (n, n) of the covariance of pixels, 0 above it."""
    found, (down, right) = (
        np.zeros((len(rows), len(rows))),
        (len(correlation) // 2, correlation.shape[1] // 2),
    )
    for i in range(len(rows)):
        for j in range(i + 1):
            row = rows[i] - rows[j] + down
            column = columns[i] - columns[j] + right
            if row < len(correlation) and 0 <= column < correlation.shape[1]:
                found[i, j] = correlation[row, column] * (variance + error[i] * error[j])
    return found


def correlated_products(columns: np.ndarray, across: int, down: int) -> np.ndarray:
    """Return S' S (p, p); S is the columns (h, w, p), zero outside, summed over ``down`` x
    ``across`` windows."""
    h, w, count = columns.shape
    padded = np.zeros((h + down - 1, w + across - 1, count))
    padded[:h, :w] = columns
    # windows end at their pixel
    size = (across, down)
    last = (across - 1, down - 1)
    border = cv2.BORDER_CONSTANT
    summed = cv2.boxFilter(
        padded, -1, size, anchor=last, normalize=False, borderType=border
    ).reshape(-1, count)
    return np.asarray(summed.T @ summed)
