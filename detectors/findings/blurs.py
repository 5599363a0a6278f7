"""Means of pictures over rectangles of pixels, of which those at the edges count in parts, and of
filters that do not weigh all pixels alike."""

import math

import numba
import numpy as np

from detectors.pixels.clusters import PLAIN


@numba.njit(**PLAIN)
def smooth(image, side_u, side_v):  # type: ignore[no-untyped-def]
    """Replace an image (h, w) by its means over rectangles of ``side_u`` x ``side_v`` pixels.
    Beyond its edges, the image goes on as its last pixels. Most of it is 0 and stays so."""
    top, bottom, left, right = _extent(image)
    if bottom == 0:
        return
    margin_u = math.ceil(0.5 * side_u) + 1
    margin_v = math.ceil(0.5 * side_v) + 1
    first_row = max(top - margin_v, 0)
    first_column = max(left - margin_u, 0)
    window = image[first_row : bottom + margin_v, first_column : right + margin_u]
    turned = window.T.copy()
    smooth_columns(turned, side_u, first_column)
    window[:] = turned.T
    smooth_columns(window, side_v, first_row)


@numba.njit(**PLAIN)
def _extent(image):  # type: ignore[no-untyped-def]
    """Return the first row and column of an image (h, w) that hold a number but 0, and the ends
    of such rows and columns: first row, end of rows, first column, end of columns."""
    h, w = image.shape
    top = h
    bottom = 0
    left = w
    right = 0
    for r in range(h):
        first = 0
        while first < w and image[r, first] == 0.0:
            first += 1
        if first == w:
            continue
        last = w - 1
        while image[r, last] == 0.0:
            last -= 1
        top = min(top, r)
        bottom = r + 1
        left = min(left, first)
        right = max(right, last + 1)
    return top, bottom, left, right


@numba.njit(**PLAIN)
def smooth_columns(image, side, first):  # type: ignore[no-untyped-def]
    """Replace each column of an image (h, w) by its means over ``side`` pixels, all columns at
    once: sums along rows would wait for one another. ``first``: the row of a larger picture at
    which the image begins, so that parts of pixels are rounded as there."""
    h, w = image.shape
    margin = math.ceil(0.5 * side) + 1
    sums = np.zeros((h + 2 * margin + 1, w))
    for r in range(h + 2 * margin):
        pixels = image[min(max(r - margin, 0), h - 1)]
        above = sums[r]
        sum_row = sums[r + 1]
        for c in range(w):
            sum_row[c] = above[c] + pixels[c]
    for r in range(h):
        middle = first + r + 0.5 + margin
        low = middle - 0.5 * side
        high = middle + 0.5 * side
        to_low = low - int(low)
        to_high = high - int(high)
        i = int(low) - first
        j = int(high) - first
        row = image[r]
        for c in range(w):
            before = sums[i, c] + to_low * (sums[i + 1, c] - sums[i, c])
            after = sums[j, c] + to_high * (sums[j + 1, c] - sums[j, c])
            row[c] = (after - before) / side


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
