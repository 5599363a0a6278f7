"""Slots, coarse to fine: where the bank's few slots peak, the best of many is looked for.

The bank (`detectors.findings.templates`) has slots of a few lengths and angles on every second
pixel. Around each peak of their scores, rectangles of other lengths, widths, angles and places
between pixels are compared with the same C^-1 r. A rectangle's score is a sum of C^-1 r, blurred
as the camera blurs, over the rectangle. So each angle takes one turned patch of that picture, and
its running sums give all rectangles along this angle. Their whitened energies t' C^-1 t are sums
over the noise's spectrum.

Not modelled: bent slots, which the best straight piece represents; tapered ends; what is unknown
within a rectangle, which adds nothing to its score but counts in its energy."""

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numba
import numpy as np

from detectors.findings import templates
from detectors.findings.whitening import GRID
from detectors.methods.scatter import FAINT
from detectors.pixels.clusters import PLAIN

LEAST = 3.5  # least score of a peak around which slots are refined
MOST_PEAKS = 64  # strongest peaks that are
APART_PX = 2  # half of the square in which such a peak is the highest, in pixels of its picture

CROWD = 4.0
"""Amount by which the squares of slots' scores are lowered. Half of it is the logarithm of how much
more frequent their peaks above 4.6 are than those of all other templates: 5 to 7 times, in
simulated noise with the spectra of two cameras and in white noise."""

LENGTHS_PX = (6, 8, 10, 14, 18, 24, 32, 40)
WIDTHS_PX = (1.0, 2.0, 3.0, 4.0, 6.0)
ACROSS_PX = 0.5  # distance of the lines over which a rectangle is summed; along them, 1 pixel
LINES = tuple(round(width / ACROSS_PX) for width in WIDTHS_PX)
"""Numbers of lines of the widths: even, as those of points along the lengths, so that the middle of
each lies between two."""
ASIDE = 3  # lines by which a rectangle's middle may lie beside the peak
TURNS_DEG = (-5.625, -2.8125, 0.0, 2.8125, 5.625)
"""Angles relative to the bank's slot; those of the bank are 11.25 degrees apart."""
_TURNS_RAD = np.radians(TURNS_DEG)
_LENGTHS = np.array(LENGTHS_PX)
_LINES = np.array(LINES)
_HALF_LENGTH = max(LENGTHS_PX)
_HALF_LINES = ASIDE + max(LINES) // 2
TENT_VARIANCE_PX2 = 1.0 / 6.0  # of linear interpolation between pixels
PIXEL_VARIANCE_PX2 = 1.0 / 12.0  # of the mean over a pixel


class BestSlot(NamedTuple):
    """The best rectangle around a peak, in pixels of the picture."""

    row: float
    """Row of its centre."""
    column: float
    """Column of its centre."""
    length_px: float
    width_px: float
    angle_deg: float
    """Angle of its length from the rows' direction, towards higher rows."""
    score: float
    """t' C^-1 r / sqrt(t' C^-1 t), with its sign."""


def blurred(solved: np.ndarray, window_px: int) -> np.ndarray:
    """Return C^-1 r (r, c) summed over what a point of the scene reaches on the sensor."""
    kernel = _kernel(window_px)
    return cv2.sepFilter2D(solved, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT)


@lru_cache(maxsize=3)
def _kernel(window_px: int) -> np.ndarray:
    """Return the blur along one axis by window and lens.

    Linear interpolation blurs more than the mean over a pixel, as which templates are drawn: the
    lens' blur is less by that much."""
    lens_px = math.sqrt(templates.LENS_BLUR_PX**2 + PIXEL_VARIANCE_PX2 - TENT_VARIANCE_PX2)
    lens = cv2.getGaussianKernel(7, lens_px).ravel()
    return np.convolve(lens, np.full(window_px, 1.0 / window_px)).astype(np.float32)


def energies(power: np.ndarray, window_px: int) -> np.ndarray:
    """Return t' C^-1 t of rectangles by angle of the bank, length and width (a, l, w), for noise
    with this power spectrum on `GRID`."""
    parts = _parts(window_px)
    weights = parts.blur / power.ravel()
    across = parts.across * weights
    return np.asarray(np.matmul(parts.along, across.transpose(0, 2, 1)))


class _Parts(NamedTuple):
    """The squared spectra of rectangles, by f frequencies on half of `GRID`."""

    along: np.ndarray
    """(a, l, f): of a line along each of the bank's angles, by its length."""
    across: np.ndarray
    """(a, w, f): of a line across, by its width."""
    blur: np.ndarray
    """(f,): of the camera's blur and of the interpolation; counts a frequency and its mirror
    image, and is divided by the size of the grid."""


@lru_cache(maxsize=3)
def _parts(window_px: int) -> _Parts:
    rows = np.fft.fftfreq(GRID)[:, None]
    columns = np.fft.rfftfreq(GRID)[None, :]
    kernel = _kernel(window_px)
    offsets = np.arange(len(kernel)) - len(kernel) // 2

    def blur(cycles: np.ndarray) -> np.ndarray:
        waves = np.cos(2.0 * math.pi * cycles[..., None] * offsets)
        return np.asarray((waves @ kernel) * np.sinc(cycles) ** 2)

    doubled = np.full(columns.shape, 2.0)
    doubled[:, [0, -1]] = 1.0
    angles_rad = np.radians(templates.SLOTS_DEG)[:, None]
    shape = (len(angles_rad), GRID, columns.size)
    cosine = np.cos(angles_rad)[..., None]
    sine = np.sin(angles_rad)[..., None]
    cycles_along = np.broadcast_to(cosine * columns + sine * rows, shape)
    cycles_across = np.broadcast_to(cosine * rows - sine * columns, shape)
    along = [_line(cycles_along, length, 1.0) for length in LENGTHS_PX]
    across = [_line(cycles_across, lines, ACROSS_PX) for lines in LINES]
    count = len(angles_rad)
    power = (blur(rows) * blur(columns)) ** 2 * doubled / GRID**2
    return _Parts(
        np.stack(along, axis=1).reshape(count, len(along), -1),
        np.stack(across, axis=1).reshape(count, len(across), -1),
        power.ravel().astype(np.float32),
    )


def _line(cycles: np.ndarray, count: int, step_px: float) -> np.ndarray:
    """Return the squared spectrum of ``count`` points in a line, at frequencies along it."""
    points = (np.arange(count) - (count - 1) / 2.0) * step_px
    total = np.zeros(cycles.shape)
    for point in points.tolist():
        total += np.cos(2.0 * math.pi * point * cycles)
    return np.asarray(np.square(total), np.float32)


def peaks_of(signed: np.ndarray) -> np.ndarray:
    """Return the places (n, 2) of the strongest peaks of slots' scores (r, c)."""
    size = np.abs(signed)
    side = 2 * APART_PX + 1
    highest = (size > LEAST) & (size >= cv2.dilate(size, np.ones((side, side), np.uint8)))
    peaks = np.argwhere(highest)
    order = np.argsort(-size[tuple(peaks.T)], kind="stable")
    return peaks[order[:MOST_PEAKS]]


def lowered(signed: np.ndarray) -> np.ndarray:
    """Return slots' scores (...) lowered by `CROWD`, as `templates.Worth` raises those of templates
    with few places: below `FAINT` all by the same factor."""
    size = np.abs(signed)
    faint = size * math.sqrt(1.0 - CROWD / FAINT**2)
    strong = np.sqrt(np.maximum(size**2 - CROWD, 0.0))
    return np.copysign(np.where(size > FAINT, strong, faint), signed).astype(np.float32)


def best_slot(
    picture: np.ndarray,
    energy: np.ndarray,
    place: tuple[float, float],
    slot: templates.SlotSides,
    sign: float,
) -> BestSlot:
    """Return the best rectangle around a place (row, column).

    ``picture`` (r, c): `blurred`. ``energy``: `energies`. ``slot``: the bank's slot there,
    ``sign``: of its score."""
    angle_deg = slot.angle_deg
    angle = templates.SLOTS_DEG.index(angle_deg)
    size, along, across, turn, length, lines = _best(
        picture,
        np.sqrt(energy[angle]),
        *place,
        sign,
        math.radians(angle_deg),
    )
    turned_deg = angle_deg + TURNS_DEG[turn]
    cosine = math.cos(math.radians(turned_deg))
    sine = math.sin(math.radians(turned_deg))
    return BestSlot(
        row=place[0] + along * sine + across * cosine,
        column=place[1] + along * cosine - across * sine,
        length_px=LENGTHS_PX[length],
        width_px=WIDTHS_PX[lines],
        angle_deg=turned_deg,
        score=sign * size,
    )


@numba.njit(**PLAIN)
def _patch(  # type: ignore[no-untyped-def]
    picture,
    row,
    column,
    turned_rad,
    sums,
):
    """Write a patch of the picture, turned about a place, as running sums over lines."""
    height = picture.shape[0]
    breadth = picture.shape[1]
    cosine = math.cos(turned_rad)
    sine = math.sin(turned_rad)
    for k in range(2 * _HALF_LINES):
        across = (k - _HALF_LINES + 0.5) * ACROSS_PX
        for n in range(2 * _HALF_LENGTH):
            along = n - _HALF_LENGTH + 0.5
            y = row + along * sine + across * cosine
            x = column + along * cosine - across * sine
            value = 0.0
            if 0.0 <= y < height - 1 and 0.0 <= x < breadth - 1:
                i = int(y)
                j = int(x)
                low = picture[i, j] + (x - j) * (picture[i, j + 1] - picture[i, j])
                high = picture[i + 1, j] + (x - j) * (picture[i + 1, j + 1] - picture[i + 1, j])
                value = low + (y - i) * (high - low)
            sums[k + 1, n] = sums[k, n] + value


@numba.njit(**PLAIN)
def _best(  # type: ignore[no-untyped-def]
    picture,
    root_energy,
    row,
    column,
    sign,
    angle_rad,
):
    """Return size of score, offsets along and across, and the indices of turn, length and width of
    the best rectangle that covers a place."""
    columns = 2 * _HALF_LENGTH
    sums = np.zeros((2 * _HALF_LINES + 1, columns))
    running = np.zeros(columns + 1)
    best = 0.0
    best_along = 0.0
    best_across = 0.0
    best_turn = 0
    best_length = 0
    best_width = 0
    for t in range(len(_TURNS_RAD)):
        _patch(picture, row, column, angle_rad + _TURNS_RAD[t], sums)
        for w in range(len(_LINES)):
            half = _LINES[w] // 2
            for aside in range(-ASIDE, ASIDE + 1):
                top = sums[_HALF_LINES + aside - half]
                bottom = sums[_HALF_LINES + aside + half]
                lowest = 0.0
                highest = 0.0
                for n in range(columns):
                    running[n + 1] = running[n] + sign * (bottom[n] - top[n])
                    lowest = min(lowest, running[n + 1])
                    highest = max(highest, running[n + 1])
                for m in range(len(_LENGTHS)):
                    if (highest - lowest) / root_energy[m, w] <= best:
                        continue  # no piece of the line has a larger sum
                    points = _LENGTHS[m]
                    largest = 0.0
                    for n in range(_HALF_LENGTH - points, _HALF_LENGTH + 1):
                        largest = max(largest, running[n + points] - running[n])
                    score = largest / root_energy[m, w]
                    if score > best:
                        best = score
                        best_across = aside * ACROSS_PX
                        best_turn = t
                        best_length = m
                        best_width = w
                        for n in range(_HALF_LENGTH - points, _HALF_LENGTH + 1):
                            if running[n + points] - running[n] == largest:
                                best_along = n + 0.5 * points - _HALF_LENGTH
    return best, best_along, best_across, best_turn, best_length, best_width
