"""The picture of drilled holes, averaged over a rectangle of pixels.

A hole is a round tube between a mouth in the surface and a flat floor, seen and lit obliquely.
Light that reaches depth t passes the mouth and the circle at depth t on its way in and out; in the
image each is an ellipse that parallax shifts.
`detectors.findings.hole_model_reference.picture` is the same, written plainly."""

import math

import numba
import numpy as np

from detectors.pixels.clusters import PLAIN

STRIPS = 64
"""Strips that approximate the disc: the total coverage is exact, that of a pixel right to 0.001
for a blur of 3."""
NODES = np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5, 1.0])
"""Depths of a hole's layers over the tube's length: the Gauss-Legendre rule with three points on
(0, 1) for the integral over the wall's depth, and the wall's end."""
WEIGHTS = np.array([5.0, 8.0, 5.0, 0.0]) / 18.0  # of these nodes, in the integral over the wall
_THETA = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
EDGES = np.sin(_THETA)
"""Edges (s + 1,) of the strips across a unit disc: narrow where the chord changes fast."""
HALF_CHORDS = np.diff(_THETA / 2 + np.sin(2 * _THETA) / 4) / np.diff(EDGES)
"""Mean half-chords (s,) of the strips."""
MIDDLES = 0.5 * (EDGES[:-1] + EDGES[1:])  # of the strips


@numba.njit(**PLAIN)
def painted_holes(
    holes: np.ndarray,
    sights: np.ndarray,
    metric: np.ndarray,
    blur_u: float,
    blur_v: float,
    h: int,
    w: int,
) -> np.ndarray:
    """Return the residuals (m, h, w) of holes (m, 5 or more).

    The mouth is cut into strips along u. Each viewpoint gives a hole three layers of wall and one
    of all that is deeper. Each layer is a shape with one start and one end in each strip. The mean
    over the blur's rectangle is the integral over u, exact for each column and strip (``across``),
    and over v by the running sum of the strips (``above``)."""
    half_u = 0.5 * blur_u
    half_v = 0.5 * blur_v
    layers = len(sights) * len(NODES)
    # half-width and half-height in px per metre of radius
    area = math.sqrt(metric[0, 0] * metric[1, 1] - metric[0, 1] ** 2)
    half_width = math.sqrt(metric[1, 1]) / area
    half_height = math.sqrt(metric[0, 0]) / area
    images = np.zeros((len(holes), h, w))
    weights = np.empty(layers)
    chords = np.empty((2, layers, STRIPS))
    # for each column from ``left`` on and each strip: the sum of the layers, and its integral over
    # the strips above
    across = np.empty((w, STRIPS))
    above = np.zeros((w, STRIPS + 1))
    for n in range(len(holes)):
        u = holes[n, 0]
        v = holes[n, 1]
        radius = holes[n, 2]
        depth = holes[n, 3]
        wall = holes[n, 4]
        reach = half_u + radius * half_width
        height = radius * half_height
        left = max(0, math.ceil(u - reach))
        width = max(min(w - 1, math.floor(u + reach)) + 1 - left, 0)
        _cut(radius, depth, wall, sights, metric, weights, chords)
        for c in range(width):
            low = left + c - half_u - u
            high = left + c + half_u - u
            column = across[c]
            for s in range(STRIPS):
                column[s] = 0.0
            for k in range(layers):
                starts = chords[0, k]
                ends = chords[1, k]
                weight = weights[k] / (blur_u * blur_v)
                for s in range(STRIPS):
                    column[s] += weight * max(min(ends[s], high) - max(starts[s], low), 0.0)
            for s in range(STRIPS):
                above[c, s + 1] = above[c, s] + height * (EDGES[s + 1] - EDGES[s]) * column[s]
        first_row = max(0, math.ceil(v - height - half_v))
        last_row = min(h - 1, math.floor(v + height + half_v))
        i = 0  # the strips that hold the top and the bottom of the blur's rectangle
        j = 0
        for r in range(first_row, last_row + 1):
            top = max(r - half_v - v, -height)
            bottom = min(r + half_v - v, height)
            while i < STRIPS - 1 and height * EDGES[i + 1] < top:
                i += 1
            while j < STRIPS - 1 and height * EDGES[j + 1] < bottom:
                j += 1
            top = top - height * EDGES[i]
            bottom = bottom - height * EDGES[j]
            row = images[n, r, left:]
            for c in range(width):
                row[c] = above[c, j] + bottom * across[c, j] - above[c, i] - top * across[c, i]
    return images


@numba.njit(**PLAIN)
def _cut(  # type: ignore[no-untyped-def]
    radius,
    depth,
    wall,
    sights,
    metric,
    weights,
    chords,
):
    """Write the ``weights`` (k,) of a hole's layers and their ``chords`` (2, k, s): each layer's
    start and end in each strip, in pixels along u from the centre.

    The layer at depth t is lit and seen through four circles: the mouth; the circle at depth t, as
    the camera sees it; and both as the emitter's beam shifts them."""
    g11 = metric[0, 0]
    g12 = metric[0, 1]
    g22 = metric[1, 1]
    # the mouth's height and half-width in px per metre of radius, and the drift of its chords
    # along u by v
    height = math.sqrt(g11 / (g11 * g22 - g12 * g12))
    width = 1.0 / math.sqrt(g11)
    slant = -g12 / g11
    # computed here: a division in the loop, which may fail, would prevent vectorisation
    per_height = 1.0 / height
    # the three circles beside the mouth that a layer's light passes: shift along u and v, radius
    shift_u = np.empty(3)
    shift_v = np.empty(3)
    size = np.empty(3)
    for k in range(len(weights)):
        viewpoint = sights[k // len(NODES)]
        cosine = viewpoint[0]
        drift_u = viewpoint[1]
        drift_v = viewpoint[2]
        shrinking = viewpoint[3]
        beam_u = viewpoint[4]
        beam_v = viewpoint[5]
        emitter = viewpoint[6]
        share = viewpoint[7]
        node = NODES[k % len(NODES)]
        deepest = depth * cosine
        length = wall * deepest if depth > 0 else 0.0
        tube = length * node
        is_wall = node < 1.0
        end = tube if is_wall else max(deepest, 0.0)
        deep = length * WEIGHTS[k % len(NODES)] if is_wall else deepest - length
        weights[k] = share / cosine * deep
        scale = 1.0 / (1.0 + tube * shrinking)
        lit = end / (end + emitter)
        below = (end - tube) / (end - tube + emitter)
        # the circle at the layer's depth, as seen
        size[0] = radius * scale
        shift_u[0] = tube * drift_u * scale
        shift_v[0] = tube * drift_v * scale
        # the mouth, as the light passes it
        size[1] = radius
        shift_u[1] = -lit * beam_u
        shift_v[1] = -lit * beam_v
        # the circle at the layer's depth, as the light passes it
        size[2] = radius * scale
        shift_u[2] = shift_u[0] - below * beam_u
        shift_v[2] = shift_v[0] - below * beam_v
        starts = chords[0, k]
        ends = chords[1, k]
        for s in range(STRIPS):
            middle = slant * radius * height * MIDDLES[s]
            half = radius * HALF_CHORDS[s] * width
            starts[s] = middle - half
            ends[s] = middle + half
        for circle in range(3):
            for s in range(STRIPS):
                off = radius * height * MIDDLES[s] - shift_v[circle]
                middle = shift_u[circle] + slant * off
                half = width * math.sqrt(max(size[circle] ** 2 - (off * per_height) ** 2, 0.0))
                starts[s] = max(starts[s], middle - half)
                ends[s] = min(ends[s], middle + half)
