"""The family of shapes that a fit compares: a drilled disc, a spherical cap, a smooth bowl, a slot.

A shape is a depth over the place on the surface. All have five numbers of a hole (`holes`: u, v,
radius, depth, wall); a slot has two more, the logarithm of its length over its width and its angle.
``radius`` is half of the diameter that declarations of targets state: of the mouth, where the depth
reaches 0 (`scenes.target.flaws`). So a pressed dent's diameter is that of the whole raised cosine,
whose half-depth contour is half as wide. Of a slot it is half of the width.

| shape | depth over the share p of the radius, 0 beyond the mouth |
|---|---|
| disc | the tube of `detectors.findings.hole_model`, 1 on the floor |
| cap | that of a sphere with this rim and depth |
| bowl | (1 + cos(pi p)) / 2 |
| slot | 1 within a rectangle |

`reliefs` draws all but the disc: each point of a grid between the pixels sees the relief where its
line of sight first meets it, and a pixel is the mean over the blur's rectangle.
`detectors.findings.hole_model_reference.relief` is the same, written plainly. Not modelled: the
emitter's shadow, more light from slopes that face the camera, light between slopes, perspective
within one damage."""

import math
from typing import Literal

import numba
import numpy as np

from detectors.pixels.clusters import PLAIN

Shape = Literal["disc", "cap", "bowl", "slot"]
SHAPES: tuple[Shape, ...] = ("disc", "cap", "bowl", "slot")
DISC = SHAPES.index("disc")
CAP = SHAPES.index("cap")
BOWL = SHAPES.index("bowl")
SLOT = SHAPES.index("slot")
PARAMETERS = 7
"""Numbers of a damage: u, v (px), radius (m), depth along the optical axis (m), wall, logarithm of
length over width, angle (rad) from the rows' direction on the surface."""
COSINE_SERIES = tuple(
    (-1) ** k * (0.5 * math.pi) ** (2 * k) / math.factorial(2 * k) for k in range(10)
)
"""Coefficients of cos(pi p / 2) by powers of the square of p; the next is 3e-14."""
FINER = 2  # points between pixels along each axis: volumes within 0.3 % from 3 px of radius
SMOOTH_PX = 3.0  # side of a blur from which a smooth relief needs but one
MOST_STEPS = 12  # of the search for where a line of sight meets a relief
CLOSE = 1e-3  # error of that depth, as a share of the deepest


@numba.njit(**PLAIN)
def profile(  # type: ignore[no-untyped-def]
    shape,
    along,
    across,
    radius,
    depth,
    stretch,
    edge,
):
    """Return the depth of a shape at a place on its surface, in metres.

    ``along`` and ``across``: place in the damage's axes, metres. ``depth``: the deepest, along the
    normal. ``stretch``: length over width. ``edge``: width of a slot's edge, over which coverage
    rises from 0 to 1."""
    if shape == SLOT:
        inside = min(max(0.5 + (radius - abs(across)) / edge, 0.0), 1.0)
        ends = min(max(0.5 + (radius * stretch - abs(along)) / edge, 0.0), 1.0)
        return depth * inside * ends
    square = (along * along + across * across) / (radius * radius)
    if square >= 1.0:
        return 0.0
    if shape == CAP:
        height = min(abs(depth), radius)
        ball = (radius * radius + height * height) / (2.0 * height)
        centre = ball - height
        return depth / height * (math.sqrt(ball * ball - square * radius * radius) - centre)
    return depth * _raised_cosine(square)


@numba.njit(**PLAIN)
def _raised_cosine(square):  # type: ignore[no-untyped-def]
    """Return (1 + cos(pi p)) / 2 for the ``square`` of p, from 0 to 1, within 1e-12.

    It is the square of cos(pi p / 2), a short power series in the square of p. Most of the time of
    a fit of a bowl is spent here; without root and cosine it takes half of it."""
    total = COSINE_SERIES[-1]
    for k in range(len(COSINE_SERIES) - 2, -1, -1):
        total = COSINE_SERIES[k] + square * total
    return total * total


@numba.njit(**PLAIN)
def reliefs(
    shape: int,
    holes: np.ndarray,
    sights: np.ndarray,
    metric: np.ndarray,
    blur_u: float,
    blur_v: float,
    h: int,
    w: int,
) -> np.ndarray:
    """Return the residuals (m, h, w) along the optical axis, without offset, of damages (m,
    `PARAMETERS`) of one shape; of ``sights`` (s, 8), each view counts with its share."""
    finer = FINER
    if shape != SLOT and min(blur_u, blur_v) >= SMOOTH_PX:
        finer = 1
    images = np.zeros((len(holes), h, w))
    # points between pixels: the patch and half of the blur on each side
    margin_u = math.ceil(0.5 * blur_u) + 1
    margin_v = math.ceil(0.5 * blur_v) + 1
    fine_h = finer * (h + 2 * margin_v)
    fine_w = finer * (w + 2 * margin_u)
    line = np.empty(fine_w + 1)
    rows = np.zeros((fine_h + 1, w))  # sums over the points above, of means along a row
    root = math.sqrt(metric[0, 0])
    skew = metric[0, 1] / root
    area = math.sqrt(metric[0, 0] * metric[1, 1] - metric[0, 1] ** 2)
    down = area / root
    edge = math.sqrt(area) / finer
    for n in range(len(holes)):
        u = holes[n, 0]
        v = holes[n, 1]
        radius = holes[n, 2]
        stretch = math.exp(holes[n, 5]) if shape == SLOT else 1.0
        cosine_turn = math.cos(holes[n, 6]) if shape == SLOT else 1.0
        sine_turn = math.sin(holes[n, 6]) if shape == SLOT else 0.0
        reach = radius * math.sqrt(1.0 + stretch * stretch) if shape == SLOT else radius
        reach_u = (reach + edge) * math.sqrt(metric[1, 1]) / area
        reach_v = (reach + edge) * root / area
        first_column = max(0, math.floor(finer * (u - reach_u + 0.5 + margin_u)))
        last_column = min(fine_w, math.ceil(finer * (u + reach_u + 0.5 + margin_u)))
        first_row = max(0, math.floor(finer * (v - reach_v + 0.5 + margin_v)))
        last_row = min(fine_h, math.ceil(finer * (v + reach_v + 0.5 + margin_v)))
        # the pixels whose means reach the damage; all others are 0
        left = max(0, math.floor(u - reach_u - 0.5 * blur_u) - 1)
        right = min(w, math.ceil(u + reach_u + 0.5 * blur_u) + 2)
        top_row = max(0, math.floor(v - reach_v - 0.5 * blur_v) - 1)
        end_row = min(h, math.ceil(v + reach_v + 0.5 * blur_v) + 2)
        for i in range(fine_h):
            if i < first_row or i >= last_row or last_column <= first_column:
                for c in range(left, right):
                    rows[i + 1, c] = rows[i, c]
                continue
            dv = (i + 0.5) / finer - 0.5 - margin_v - v
            for j in range(first_column + 1):
                line[j] = 0.0
            for j in range(first_column, last_column):
                du = (j + 0.5) / finer - 0.5 - margin_u - u
                total = 0.0
                for k in range(len(sights)):
                    cosine = sights[k, 0]
                    deepest = holes[n, 3] * cosine
                    drift_x = root * sights[k, 1] + skew * sights[k, 2]
                    drift_y = down * sights[k, 2]
                    x = root * du + skew * dv
                    y = down * dv
                    share = _seen(
                        shape,
                        cosine_turn * x + sine_turn * y,
                        cosine_turn * y - sine_turn * x,
                        cosine_turn * drift_x + sine_turn * drift_y,
                        cosine_turn * drift_y - sine_turn * drift_x,
                        radius,
                        deepest,
                        stretch,
                        edge,
                    )
                    total += sights[k, 7] / cosine * share
                line[j + 1] = line[j] + total
            for j in range(last_column, fine_w):
                line[j + 1] = line[j]
            for c in range(left, right):
                middle = finer * (c + 0.5 + margin_u)
                low = _sum_before(line, middle - 0.5 * finer * blur_u)
                high = _sum_before(line, middle + 0.5 * finer * blur_u)
                rows[i + 1, c] = rows[i, c] + (high - low)
        per_points = 1.0 / (finer * finer * blur_u * blur_v)
        for r in range(top_row, end_row):
            middle = finer * (r + 0.5 + margin_v)
            above = middle - 0.5 * finer * blur_v
            below = middle + 0.5 * finer * blur_v
            top = int(above)
            bottom = int(below)
            to_top = above - top
            to_bottom = below - bottom
            for c in range(left, right):
                high = rows[bottom, c] + to_bottom * (rows[bottom + 1, c] - rows[bottom, c])
                low = rows[top, c] + to_top * (rows[top + 1, c] - rows[top, c])
                images[n, r, c] = per_points * (high - low)
    return images


@numba.njit(**PLAIN)
def _sum_before(sums, place):  # type: ignore[no-untyped-def]
    """Return running sums at a place between two of them."""
    first = int(place)
    return sums[first] + (place - first) * (sums[first + 1] - sums[first])


@numba.njit(**PLAIN)
def _way_inside(place, drift, half):  # type: ignore[no-untyped-def]
    """Return the depth at which a line of sight that is at ``place`` - t * ``drift`` at the depth t
    leaves -``half`` to ``half``."""
    place = min(max(place, -half), half)
    if drift > 0.0:
        return (place + half) / drift
    if drift < 0.0:
        return (place - half) / drift
    return np.inf


@numba.njit(**PLAIN)
def _seen(  # type: ignore[no-untyped-def]
    shape,
    along,
    across,
    drift_along,
    drift_across,
    radius,
    deepest,
    stretch,
    edge,
):
    """Return the depth along the normal at which a line of sight meets the relief.

    At the depth t it has come ``drift`` * t against its place at the mouth. The depth lies between
    0 and the relief's deepest; where the sight line could meet the relief several times, false
    position with halved weights finds one of them."""
    start = profile(shape, along, across, radius, deepest, stretch, edge)
    if shape == SLOT:
        # upright walls: the line of sight ends at the floor or where it leaves the mouth
        sign = math.copysign(1.0, deepest)
        to_end = _way_inside(along, sign * drift_along, radius * stretch)
        to_side = _way_inside(across, sign * drift_across, radius)
        return start * min(min(to_end, to_side) / abs(deepest), 1.0)
    square = (drift_along**2 + drift_across**2) * deepest**2
    if start == 0.0 or square < (1e-3 * radius) ** 2:
        return start
    low = 0.0
    high = deepest
    at_low = start
    at_high = (
        profile(
            shape,
            along - deepest * drift_along,
            across - deepest * drift_across,
            radius,
            deepest,
            stretch,
            edge,
        )
        - deepest
    )
    depth = deepest
    last_side = 0
    for _ in range(MOST_STEPS):
        if at_low == at_high:
            break
        depth = (low * at_high - high * at_low) / (at_high - at_low)
        beyond = (
            profile(
                shape,
                along - depth * drift_along,
                across - depth * drift_across,
                radius,
                deepest,
                stretch,
                edge,
            )
            - depth
        )
        if abs(beyond) < CLOSE * abs(deepest):
            break
        if (beyond > 0.0) == (at_low > 0.0):
            low = depth
            at_low = beyond
            if last_side == 1:
                at_high *= 0.5
            last_side = 1
        else:
            high = depth
            at_high = beyond
            if last_side == -1:
                at_low *= 0.5
            last_side = -1
    return depth
