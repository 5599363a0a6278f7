"""Means of pictures over rectangles of pixels, of which those at the edges count in parts, and of
filters that do not weigh all pixels alike."""

import math

import numba
import numpy as np

from detectors.pixels.clusters import PLAIN


@numba.njit(**PLAIN)
def smooth(image, side_u, side_v):  # type: ignore[no-untyped-def]
    """Replace an image (h, w) by its means over rectangles of ``side_u`` x ``side_v`` pixels.
    Beyond its edges, the image goes on as its last pixels. Rows that are 0 stay so."""
    h, w = image.shape
    taps_u = _taps(side_u)
    taps_v = _taps(side_v)
    reach_u = len(taps_u) // 2
    reach_v = len(taps_v) // 2
    first, end = _rows_with_numbers(image)
    first = max(first - reach_v, 0)
    end = min(end + reach_v, h)
    means = np.zeros((max(end - first, 0), w + 2 * reach_u))  # over columns, and beyond both edges
    for r in range(first, end):
        wide = means[r - first]
        middle = wide[reach_u : reach_u + w]
        for k in range(len(taps_v)):
            row = image[min(max(r + k - reach_v, 0), h - 1)]
            for c in range(w):
                middle[c] += taps_v[k] * row[c]
        wide[:reach_u] = middle[0]
        wide[reach_u + w :] = middle[w - 1]
    for r in range(first, end):
        row = image[r]
        row[:] = 0.0
        for k in range(len(taps_u)):
            shifted = means[r - first, k : k + w]
            for c in range(w):
                row[c] += taps_u[k] * shifted[c]


@numba.njit(**PLAIN)
def _taps(side):  # type: ignore[no-untyped-def]
    """Return the weights (odd,) of a pixel and its neighbours along one axis in the mean over
    ``side`` pixels: those at the ends count in parts."""
    if side <= 1.0:
        return np.ones(1)
    reach = math.ceil(0.5 * (side - 1.0))
    taps = np.full(2 * reach + 1, 1.0 / side)
    taps[0] = 0.5 * (side - (2.0 * reach - 1.0)) / side
    taps[2 * reach] = taps[0]
    return taps


@numba.njit(**PLAIN)
def _rows_with_numbers(image):  # type: ignore[no-untyped-def]
    """Return the first row of an image that holds a number but 0, and the end of such rows."""
    h, w = image.shape
    first = h
    end = 0
    for r in range(h):
        numbers = 0
        for c in range(w):
            numbers += image[r, c] != 0.0
        if numbers > 0:
            first = min(first, r)
            end = r + 1
    return first, end


@numba.njit(**PLAIN)
def weigh(  # type: ignore[no-untyped-def]
    image,
    sharp,
    face,
    depth,
    brightness,
    half,
):
    """Replace the depths of an image (h, w) of a hole, which are its ``depth`` times the floor's
    share of each average, by those of a filter that does not weigh all pixels alike.

    A ``brightness`` above 0 is that of the floor; what of it is not lit weighs nothing, and the
    ``face`` (h, w) has the rest outside the mouth. A pixel that differs by ``half`` from that in
    the middle of the filter, whose depth is ``sharp`` (h, w), has half of its weight."""
    h, w = image.shape
    per_half = (depth / half) ** 2
    for r in range(h):
        for c in range(w):
            share = image[r, c] / depth
            if share > 0.0:
                middle = min(sharp[r, c] / depth, 1.0)
                floor = share * 2.0 ** (per_half * (2.0 * middle - 1.0))
                beside = 1.0 - share
                if brightness > 0.0:
                    floor = brightness * floor
                    beside = max(face[r, c], 0.0)
                image[r, c] = floor * depth / (floor + beside)
