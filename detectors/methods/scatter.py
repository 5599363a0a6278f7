"""The scatter of a template's scores, by which they are divided.

Scores near the target's outline scatter more than others, so that each distance from it (a zone)
has its own deviation; so do scores where the noise differs from elsewhere. Deviations come from
the mean size of scores, of which none counts more than `CAP`, so that damage does not raise them.
`detectors.methods.scatter_reference` has the same deviations, written plainly."""

from typing import NamedTuple

import cv2
import numba
import numpy as np
from scipy import special

from detectors.findings.templates import Template
from detectors.methods import local
from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import grown

RIM_ENDS_PX = (1, 2, 3, 5, 8, 12)
"""Distances from the outline up to which scores have their own scatter; farther inside, all scores
share one."""
N_ZONES = len(RIM_ENDS_PX) + 1
ZONES = np.searchsorted(RIM_ENDS_PX, np.arange(RIM_ENDS_PX[-1] + 2)).astype(np.uint8)
"""Zone of each whole distance from the outline; the last one is that of all greater distances."""

CAP = 2.0  # largest score that counts in the scatter
FEWEST = 200  # scores that determine it
FAINT = 3.5
"""Scores below this are all raised by the same factor, because `templates.Worth` counts maxima;
higher ones of wide templates do not count in the scatter."""
WIDE_PX = 5.0  # radius from which noise may split a template's finding into several peaks
DEVIATIONS = np.geomspace(0.2, 50.0, 200)
CAPPED = DEVIATIONS * np.sqrt(2.0 / np.pi) * (
    1.0 - np.exp(-0.5 * (CAP / DEVIATIONS) ** 2)
) + 2.0 * CAP * special.ndtr(-CAP / DEVIATIONS)
"""Mean size of a Gaussian with these deviations if more than `CAP` counts as `CAP`."""
STEPS = 4096
DEVIATION_OF = np.interp(np.arange(STEPS * CAP + 2) / STEPS, CAPPED, DEVIATIONS)
"""The inverse of `CAPPED`: the deviation by the mean size in steps of 1 / `STEPS`."""

WINDOW_RADII = 6  # half of the window of the local scatter, in radii of the template
PART_PX = 8  # side of the squares from which it is computed
UNEVEN = 1.25  # ratio of local to typical scatter that chance explains

TAIL_SHARE = 0.0005  # share of the pixels beyond the tail's limit on either side
TAIL_SIGMAS = 3.29  # where a Gaussian has that share


class Zones(NamedTuple):
    """The pixels whose scores count for the scatter, by their zone."""

    loud: np.ndarray
    """(r, c) bool: scores that do not count."""
    pixels: np.ndarray
    """(n,): flat indices of the pixels outside the last zone, in the order of their zones."""
    ends: np.ndarray
    """(z,): where each of these zones ends among them."""


def zones_of(
    seen: np.ndarray,
    depth_px: np.ndarray,
    loud: np.ndarray,
) -> Zones:
    """Return the zones of the ``seen`` pixels (r, c) by their distance ``depth_px`` (r, c) from
    the outline."""
    zone = ZONES[np.ceil(np.minimum(depth_px, len(ZONES) - 1)).astype(np.uint8)]
    zone[seen == 0] = N_ZONES - 1
    order = np.argsort(zone, axis=None, kind="stable")
    ends = np.cumsum(np.bincount(zone.ravel(), minlength=N_ZONES))[:-1]
    return Zones(loud, order[: ends[-1]], ends)


def evened(score: np.ndarray, template: Template, zones: Zones) -> float:
    """Return the deviation of the scores (r, c) in the last zone, and divide the scores where
    others scatter more.

    That is in other zones, and where the squares around scatter by more than `UNEVEN` deviations
    because the noise there differs from elsewhere. Loud scores do not count, nor strong ones of
    wide templates, nor those next to them."""
    step = 2 if template.coarse else 1
    loud = zones.loud
    if template.radius_px >= WIDE_PX and template.slot is None:
        limit = FAINT * scatter(score, zones, np.zeros_like(loud)).deviations[-1]
        if cv2.norm(score, cv2.NORM_INF) > limit:
            loud = loud | (np.abs(score) > limit)
        if loud.any():
            loud = grown(loud, round(template.radius_px / step))
    measured = scatter(score, zones, loud)
    deviations = measured.deviations
    if measured.counts.sum() <= FEWEST:
        deviations = scatter(score, zones, np.zeros_like(loud)).deviations
    deviation = float(deviations[-1])

    # the mean size in the window around each square
    half_px = max(WINDOW_RADII * template.radius_px, local.LEAST_WINDOW) / step
    side = 2 * round(half_px / PART_PX) + 1
    counts = np.maximum(cv2.blur(measured.counts, (side, side)), 0.05 * PART_PX**2)
    size = cv2.blur(measured.sums, (side, side)) / counts
    if DEVIATION_OF[int(STEPS * size.max())] > UNEVEN * deviation:
        excess = np.interp(size, CAPPED, DEVIATIONS) / (UNEVEN * deviation)
        divisor = np.maximum(excess, 1.0).astype(np.float32)
        score /= cv2.resize(divisor, score.shape[::-1], interpolation=cv2.INTER_LINEAR)
    _multiply(
        score,
        zones.pixels,
        zones.ends,
        (deviation / deviations).astype(np.float32),
    )
    return deviation


@numba.njit(**PLAIN)
def _multiply(
    score: np.ndarray,
    pixels: np.ndarray,
    ends: np.ndarray,
    factors: np.ndarray,
) -> None:
    """Multiply the scores in each zone by its factor."""
    flat = score.ravel()
    start = 0
    for zone in range(len(ends)):
        for k in range(start, ends[zone]):
            flat[pixels[k]] *= factors[zone]
        start = ends[zone]


class Scatter(NamedTuple):
    """The scatter of scores that are neither 0 nor loud."""

    deviations: np.ndarray
    """(z,): by zone, at least that of the last one, which is the whole picture's inside."""
    sums: np.ndarray
    """(a, b): sums of sizes up to `CAP` in squares of `PART_PX`."""
    counts: np.ndarray
    """(a, b): their numbers."""


def scatter(score: np.ndarray, zones: Zones, loud: np.ndarray) -> Scatter:
    """Return the scatter of scores (r, c) except the ``loud`` ones (r, c) bool."""
    sums, counts, total, number = _by_square(score, loud)
    deviations = _by_zone(score, loud, zones.pixels, zones.ends, total, number)
    return Scatter(deviations, sums, counts)


@numba.njit(**PLAIN)
def _by_square(score: np.ndarray, loud: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return the sums (a, b) of sizes in squares, their numbers (a, b), and both over all."""
    h, w = score.shape
    cap = np.float32(CAP)
    rows = max(1, h // PART_PX)
    columns = max(1, w // PART_PX)
    sums = np.zeros((rows, columns))
    counts = np.zeros((rows, columns))
    total = 0.0
    number = 0.0
    for row in range(rows):
        sizes = np.zeros(w, np.float32)
        numbers = np.zeros(w, np.int32)
        for i in range(row * h // rows, (row + 1) * h // rows):
            values = score[i]
            hidden = loud[i]
            for j in range(w):
                value = np.float32(0.0) if hidden[j] else values[j]
                sizes[j] += min(abs(value), cap)
                numbers[j] += value != 0
        for column in range(columns):
            for j in range(column * w // columns, (column + 1) * w // columns):
                sums[row, column] += sizes[j]
                counts[row, column] += numbers[j]
            total += sums[row, column]
            number += counts[row, column]
    return sums, counts, total, number


@numba.njit(**PLAIN)
def _by_zone(  # type: ignore[no-untyped-def]
    score,
    loud,
    pixels,
    ends,
    total,
    number,
):
    """Return the deviation (z,) of each zone. The last zone holds what is left of the ``total``
    and the ``number``, or all if that is too little."""
    cap = np.float32(CAP)
    last = N_ZONES - 1
    sums = np.zeros(N_ZONES)
    counts = np.zeros(N_ZONES)
    deviations = np.zeros(N_ZONES)
    flat = score.ravel()
    hidden = loud.ravel()
    start = 0
    for zone in range(last):
        size = 0.0
        count = 0
        for k in range(start, ends[zone]):
            value = np.float32(0.0) if hidden[pixels[k]] else flat[pixels[k]]
            size += min(abs(value), cap)
            count += value != 0
        sums[zone] = size
        counts[zone] = count
        start = ends[zone]
    sums[last] = total - sums.sum()
    counts[last] = number - counts.sum()
    if counts[last] < FEWEST:
        sums[last] = total
        counts[last] = number
    for zone in range(last, -1, -1):
        if zone == last or counts[zone] >= FEWEST:
            mean_size = max(sums[zone], 0.0) / max(counts[zone], 1.0)
            deviations[zone] = DEVIATION_OF[int(STEPS * mean_size)]
        deviations[zone] = max(deviations[zone], deviations[last])
    return deviations


def tail_of(score: np.ndarray, deviation: float) -> float:
    """Return how much farther the tail of scores (r, c) over their ``deviation`` reaches than a
    Gaussian's, on its shorter side; at least 1."""
    count = int(TAIL_SHARE * np.count_nonzero(score))
    limit = TAIL_SIGMAS * deviation
    high = np.sort(score[score > limit])
    low = np.sort(-score[score < -limit])
    if count == 0 or min(len(high), len(low)) < count:
        return 1.0
    return float(min(high[-count], low[-count])) / limit
