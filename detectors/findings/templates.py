"""The templates of the matched filters: discs, dents and slots as a camera sees them.

Each is drawn through a camera's window and lens, and compared with a picture at every pixel by
transforms: two templates at a time, because a real picture leaves half of a complex transform
free, and wide ones on every second pixel only."""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
import scipy.fft

from detectors.findings.whitening import GRID, centred

WINDOWS_PX = (1, 3, 5)
"""Sides of the square over which cameras average: 3 for a Kinect v2, 5 for an Azure Kinect, 1:
only the lens blurs."""
LENS_BLUR_PX = 0.6  # standard deviation of the lens' blur

SMALL_RADII_PX = (0.5, 1.5)
"""Radii of small discs. The first stands for all holes smaller than a pixel."""
HALVES_PX = ((0.0, 0.0), (0.5, 0.5), (0.0, 0.5), (0.5, 0.0))
"""Positions (down, right) between pixels at which small discs are compared: half a pixel costs up
to a seventh of the score if the window has sharp sides."""
RADII_PX = (2.2, 3.2, 4.5, 6.4, 9.0, 13.0, 18.0)  # radii of further discs
DEEP_PX = 1.0  # radius of a disc as a camera shows a deep hole
DEEP_BLUR_PX = 0.9
"""Standard deviation of its blur: between those of the lens alone and of lens and window."""
DEEP_WINDOW_PX = 3
"""Window with which the deep disc is compared too: a filter that weighs pixels by phase
(libfreenect2) averages a deep hole with those of its neighbours alone that resemble it. On holes of
5 to 7 mm of simulated boards the bank has .81 and .86 of the score of the hole's own image if the
lens' blur is taken, .88 and .89 with this one (50 frames; boards from which it was chosen, and
others)."""
DENT_RADII_PX = (5.0, 6.5, 8.0, 10.0, 12.0, 14.5, 17.5)
"""Radii of paraboloids. They are denser because before a fixed pattern the rims decide."""
SLOT_LENGTHS_PX = (8.0, 14.0, 24.0)
SLOT_WIDTH_PX = 2.0
SLOTS_DEG = tuple(11.25 * k for k in range(16))  # angles of slots to the rows
COARSE_PX = 9.0
"""Radius from which only every second pixel is scored: between these pixels, scores change by some
hundredths."""
FINER = 4  # sub-pixels along each axis from which a template is drawn
SIDES_PX = (0, 1, 2, 3, 5, 8, 12, 18)
"""Half-sides that a `Worth` may have: the visible share is computed once for each."""


# --- the bank ---


class SlotSides(NamedTuple):
    """A rectangle."""

    length_px: float
    width_px: float
    angle_deg: float
    """Angle of its length to the rows."""


class Template(NamedTuple):
    """A damage of height 1 as a camera sees it."""

    image: np.ndarray
    """Picture on a square of odd side."""
    radius_px: float
    """Radius of a disc of equal size."""
    halves: tuple[int, int] = (0, 0)
    """Offset (down, right) of its centre from the middle, in half pixels."""
    slot: SlotSides | None = None
    """Sides and angle of a slot."""
    coarse: bool = False
    """True if it is scored on every second pixel."""


@lru_cache(maxsize=3)
def bank(window_px: int) -> tuple[Template, ...]:
    """Return the templates as seen through a window of `WINDOWS_PX`: discs, paraboloids and slots;
    coarse ones last."""
    sharp = [_disc(radius_px, offset) for radius_px in SMALL_RADII_PX for offset in HALVES_PX]
    sharp += map(_disc, RADII_PX)
    sharp += map(_dent, DENT_RADII_PX)
    for length_px in SLOT_LENGTHS_PX:
        sharp += [_slot(SlotSides(length_px, SLOT_WIDTH_PX, angle)) for angle in SLOTS_DEG]
    window = (window_px, window_px)
    templates = []
    for template in sharp:
        image = cv2.blur(template.image, window, borderType=cv2.BORDER_CONSTANT)
        templates.append(template._replace(image=image))
    if window_px == DEEP_WINDOW_PX:
        templates += [_disc(DEEP_PX, offset, DEEP_BLUR_PX) for offset in HALVES_PX]
    return tuple(sorted(templates, key=lambda template: template.coarse))


def _disc(
    radius_px: float,
    offset_px: tuple[float, float] = (0.0, 0.0),
    blur_px: float = LENS_BLUR_PX,
) -> Template:
    down, right = offset_px

    def inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.hypot(x - right, y - down) < radius_px

    return Template(
        image=_drawn(inside, radius_px, blur_px),
        radius_px=radius_px,
        halves=(int(2 * down), int(2 * right)),
        coarse=radius_px >= COARSE_PX,
    )


def _dent(radius_px: float) -> Template:
    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.maximum(1.0 - (x**2 + y**2) / radius_px**2, 0.0)

    return Template(_drawn(height, radius_px), radius_px, coarse=radius_px >= COARSE_PX)


def _slot(sides: SlotSides) -> Template:
    turn = np.exp(-1j * math.radians(sides.angle_deg))

    def inside(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        along = (x + 1j * y) * turn
        is_along = np.abs(along.real) < sides.length_px / 2
        return is_along & (np.abs(along.imag) < sides.width_px / 2)

    area_px = sides.length_px * sides.width_px
    return Template(
        image=_drawn(inside, sides.length_px / 2),
        radius_px=math.sqrt(area_px / math.pi),
        slot=sides,
        coarse=True,
    )


def _drawn(
    height: Callable[[np.ndarray, np.ndarray], np.ndarray],
    reach_px: float,
    blur_px: float = LENS_BLUR_PX,
) -> np.ndarray:
    """Return a height over x and y in pixels, averaged over pixels and blurred by a Gaussian."""
    half = int(reach_px + 5)
    side = 2 * half + 1
    positions = (np.arange(side * FINER) + 0.5) / FINER - (half + 0.5)
    fine = height(positions[None, :], positions[:, None]).astype(float)
    pixels = fine.reshape(side, FINER, side, FINER).mean(axis=(1, 3))
    border = cv2.BORDER_CONSTANT
    return cv2.GaussianBlur(pixels, (0, 0), blur_px, borderType=border)


# --- correlation with a picture ---


def transformed(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the spectrum, complex (r, c), of an image on a grid of this shape, 0 beside it."""
    padded = np.zeros((*shape, 2), np.float32)
    padded[: image.shape[0], : image.shape[1], 0] = image
    return cv2.dft(padded, dst=padded).view(np.complex64)[..., 0]


def halved(image_spectrum: np.ndarray) -> np.ndarray:
    """Return the spectrum of a picture sampled in the middles of 2 x 2 pixels, without higher
    frequencies."""
    return _low(image_spectrum) * _middles(image_spectrum.shape)


def _low(image_spectrum: np.ndarray) -> np.ndarray:
    """Return the lower half of a spectrum's frequencies along both axes."""
    height, width = image_spectrum.shape
    rows = np.r_[: height // 4, -(height // 4) : 0]
    columns = np.r_[: width // 4, -(width // 4) : 0]
    return image_spectrum[np.ix_(rows, columns)]


@lru_cache(maxsize=4)
def _middles(shape: tuple[int, ...]) -> np.ndarray:
    """Return the factors that shift a spectrum's lower half by half a pixel and scale it to a
    quarter of the pixels."""
    height, width = shape
    rows = np.fft.fftfreq(height // 2) / 2
    columns = np.fft.fftfreq(width // 2) / 2
    cycles = np.add.outer(rows, columns)
    factors = np.asarray(np.exp(1j * np.pi * cycles) / 4.0, np.complex64)
    # the highest frequency has no sign, so that half a pixel of it is not real
    factors[height // 4] = 0.0
    factors[:, width // 4] = 0.0
    return factors


@lru_cache(maxsize=6)
def spectra(
    shape: tuple[int, ...], window_px: int
) -> tuple[tuple[np.ndarray, tuple[int, ...]], ...]:
    """Return the spectra of pairs of templates on a grid, and their numbers in the `bank`.

    An odd template is alone. One complex transform correlates a real picture with both: the second
    is imaginary. Spectra are divided by the size of the inverse transform. Coarse templates have
    only the lower half of the frequencies."""
    pairs = []
    for coarse in (False, True):
        numbers = [n for n, template in enumerate(bank(window_px)) if template.coarse == coarse]
        for first in range(0, len(numbers), 2):
            pair = tuple(numbers[first : first + 2])
            pairs.append((_pair_spectrum(pair, shape, window_px, coarse), pair))
    return tuple(pairs)


def _pair_spectrum(
    pair: tuple[int, ...],
    shape: tuple[int, ...],
    window_px: int,
    coarse: bool,
) -> np.ndarray:
    total: np.ndarray | int = 0
    for channel, number in enumerate(pair):
        drawn = transformed(centred(bank(window_px)[number].image, shape), shape)
        total = total + np.conj(_low(drawn) if coarse else drawn) * 1j**channel
    pixels = math.prod(shape)
    return np.asarray(total / pixels * (4 if coarse else 1), np.complex64)


def responses(
    image_spectrum: np.ndarray,
    pair: np.ndarray,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return the correlations (r, c, 2) of a picture with two templates, from its spectrum and
    theirs (`spectra`). For a `halved` picture, they are those in the middles of 2 x 2 pixels."""
    product = np.multiply(image_spectrum, pair, out=out).view(np.float32)
    product = product.reshape(*pair.shape, 2)
    return cv2.dft(product, dst=product, flags=cv2.DFT_INVERSE)


# --- what a score of each template is worth ---


class Worth(NamedTuple):
    """The worth of a template's response under noise with a given spectrum."""

    energy: float
    """Whitened energy t' C^-1 t of the template."""
    sides: tuple[int, int]
    """Sides (along columns, along rows) of the rectangle that spreads as widely, in pixels of its
    scores' picture."""
    raised: float
    """Amount by which the square of a score exceeds that of the template with the most independent
    positions where maxima are equally rare; half of it for the many wide templates."""


def worths(power: np.ndarray, window_px: int) -> tuple[Worth, ...]:
    """Return each template's `Worth` under noise with this power spectrum on `GRID`."""
    energies: list[float] = []
    sides: list[tuple[int, int]] = []
    maxima: list[float] = []
    for coarse in (False, True):
        sums = _sums_of(window_px, coarse)
        white = 1.0 / np.sqrt(power[sums.frequencies])
        side = len(white)
        whitened = sums.squares @ (sums.weights * np.square(white).ravel()).T
        energy, row_moment, column_moment = whitened.T
        reach_px = _reach_px(sums, white, energy)
        nearest = np.abs(np.array(SIDES_PX) - reach_px[..., None]).argmin(axis=2)
        half_sides = np.array(SIDES_PX)[nearest]
        energies += [value / GRID**2 for value in energy.tolist()]
        sides += [(2 * across + 1, 2 * down + 1) for across, down in half_sides.tolist()]
        # the density of maxima is the root of the score's second spectral moments (Adler 1981)
        maxima += (np.sqrt(row_moment * column_moment) / energy * side**2).tolist()
    template_worths = []
    highest = max(maxima)
    slots = len(SLOT_LENGTHS_PX) * len(SLOTS_DEG)
    for number, template in enumerate(bank(window_px)):
        # slots of all angles together are as rare as one round template
        crowd = maxima[number] * (slots if template.slot else 1)
        raised = max(math.log(highest / crowd), 0.0)
        template_worths.append(Worth(energies[number], sides[number], raised))
    return tuple(template_worths)


class _SpectrumSums(NamedTuple):
    """The parts that `worths` sums over half of the spectra of t templates on `GRID`, at f
    frequencies."""

    frequencies: tuple[np.ndarray, ...]
    """Indices of these frequencies in the spectra."""
    squares: np.ndarray
    """Squares (t, f) of the magnitudes."""
    above: np.ndarray
    """Products (t, f) of the magnitudes with those of the frequencies above."""
    right: np.ndarray
    """Products (t, f) of the magnitudes with those of the frequencies to the right."""
    weights: np.ndarray
    """Weights (3, f) of the squares: how often a frequency counts, and that times the squares of
    its frequency along columns and along rows."""


@lru_cache(maxsize=6)
def _sums_of(window_px: int, coarse: bool) -> _SpectrumSums:
    """Return the sums of the fine templates, or of the coarse ones, which have half the
    frequencies."""
    grid = (GRID, GRID)
    side = GRID // 2 if coarse else GRID
    rows = np.r_[: side // 2, GRID - side // 2 : GRID]
    frequencies = np.ix_(rows, np.arange(side // 2 + 1))
    sizes = np.stack(
        [
            np.abs(scipy.fft.rfft2(centred(template.image, grid)))[frequencies]
            for template in bank(window_px)
            if template.coarse == coarse
        ]
    )
    # each frequency stands for its mirror image too, except the first and the last
    doubled = np.full(side // 2 + 1, 2.0, np.float32)
    doubled[[0, -1]] = 1.0
    above = doubled * sizes * np.roll(sizes, 1, axis=1)
    right = 2.0 * sizes * np.roll(sizes, -1, axis=2)
    right[..., -1] = 0.0
    row_squares = np.fft.fftfreq(side)[:, None] ** 2
    column_squares = (np.arange(side // 2 + 1) / side) ** 2
    weights = np.stack(
        [
            doubled + 0.0 * row_squares,
            doubled * row_squares,
            doubled * column_squares + 0.0 * row_squares,
        ]
    )
    count = len(sizes)
    return _SpectrumSums(
        frequencies,
        squares=np.asarray((sizes**2).reshape(count, -1), np.float32),
        above=np.asarray(above.reshape(count, -1), np.float32),
        right=np.asarray(right.reshape(count, -1), np.float32),
        weights=weights.reshape(3, -1).astype(np.float32),
    )


def window_of(covariance: np.ndarray) -> int:
    """Return the side of `WINDOWS_PX` that the noise indicates.

    Averaging over a square makes the covariance fall steadily with the lag up to its side, and
    bend there. A correlation of neighbours below 0.5 means no averaging."""
    middle = len(covariance) // 2
    by_lag = (covariance[middle, middle:] + covariance[middle:, middle]) / 2.0
    if by_lag[1] < 0.5 * by_lag[0]:
        return 1

    def bend(side: int) -> float:
        return float(by_lag[side - 1] - 2.0 * by_lag[side] + by_lag[side + 1])

    return max(WINDOWS_PX[1:], key=bend)


def _reach_px(sums: _SpectrumSums, white: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """Return how far each template's whitened energy (t,) reaches across and down (t, 2): half of
    the sides of the rectangle with the same second moments. ``white`` (k, k): the spectrum of the
    whitening.

    Parseval's theorem: a second moment over space is the energy of a derivative over frequency."""
    pairs_above = (white * np.roll(white, 1, axis=0)).ravel()
    pairs_right = (white * np.roll(white, -1, axis=1)).ravel()
    spread_down = 2.0 * (energy - sums.above @ pairs_above)
    spread_across = 2.0 * (energy - sums.right @ pairs_right)
    spread = np.stack([spread_across, spread_down], axis=1)
    return np.asarray(np.sqrt(3.0 * spread / energy[:, None]) * len(white) / (2.0 * math.pi))
