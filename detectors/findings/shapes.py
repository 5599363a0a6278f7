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
line of sight meets it, and a pixel is the mean over the blur's rectangle.
`detectors.findings.hole_model_reference.relief` is the same, written plainly. Not modelled: the
emitter's shadow, more light from slopes that face the camera, light between slopes, perspective
within one damage."""

import math
from typing import Literal, NamedTuple

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
MOST_STEPS = 12  # of the search for where a line of sight meets a bowl
CLOSE = 1e-3  # error of that depth, as a share of the deepest
STRAIGHT = 1e-3  # drift over the whole depth, as a share of the radius, that is neglected
SCRATCH = 7  # rows that `reliefs` needs for intermediate values
VECTORS = {**PLAIN, "error_model": "numpy"}
"""Options of functions whose loops divide: a division that may raise would prevent vectors."""


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
    # points between pixels: the patch and half of the blur on each side
    margin_u = math.ceil(0.5 * blur_u) + 1
    margin_v = math.ceil(0.5 * blur_v) + 1
    fine_h = finer * (h + 2 * margin_v)
    fine_w = finer * (w + 2 * margin_u)
    area = math.sqrt(metric[0, 0] * metric[1, 1] - metric[0, 1] ** 2)
    edge = math.sqrt(area) / finer
    images = np.zeros((len(holes), h, w))
    work = np.empty((SCRATCH, fine_w))
    sums = np.zeros((fine_h + 1, fine_w))
    for n in range(len(holes)):
        u = holes[n, 0]
        v = holes[n, 1]
        reach = holes[n, 2] + edge
        if shape == SLOT:
            reach = holes[n, 2] * math.sqrt(1.0 + math.exp(2.0 * holes[n, 5])) + edge
        reach_u = reach * math.sqrt(metric[1, 1]) / area
        reach_v = reach * math.sqrt(metric[0, 0]) / area
        first_column = max(0, math.floor(finer * (u - reach_u + 0.5 + margin_u)))
        last_column = min(fine_w, math.ceil(finer * (u + reach_u + 0.5 + margin_u)))
        first_row = max(0, math.floor(finer * (v - reach_v + 0.5 + margin_v)))
        last_row = min(fine_h, math.ceil(finer * (v + reach_v + 0.5 + margin_v)))
        if last_column <= first_column or last_row <= first_row:
            continue
        # sums over the points above
        above = sums[: last_row - first_row + 1, : last_column - first_column]
        du = (first_column + 0.5) / finer - 0.5 - margin_u - u
        dv = (first_row + 0.5) / finer - 0.5 - margin_v - v
        for i in range(last_row - first_row):
            _see_row(
                shape, holes[n], du, dv + i / finer, finer, sights, metric, edge, work, above[i + 1]
            )
            for j in range(last_column - first_column):
                above[i + 1, j] += above[i, j]
        first_u = finer * (0.5 + margin_u) - first_column
        first_v = finer * (0.5 + margin_v) - first_row
        _average(above, first_u, first_v, finer, blur_u, blur_v, images[n])
    return images


@numba.njit(**PLAIN)
def _average(  # type: ignore[no-untyped-def]
    above,
    first_u,
    first_v,
    finer,
    blur_u,
    blur_v,
    image,
):
    """Write an image (h, w): the means over rectangles of ``blur_u`` x ``blur_v`` pixels of points,
    of which ``finer`` lie in a pixel along each axis.

    ``above`` (i + 1, j): sums over the points above. Beyond these points, all are 0. ``first_u``
    and ``first_v``: place of the image's first pixel in them."""
    h, w = image.shape
    rows = len(above) - 1
    columns = above.shape[1]
    half_u = 0.5 * finer * blur_u
    half_v = 0.5 * finer * blur_v
    per_points = 1.0 / (finer * finer * blur_u * blur_v)
    before = np.zeros(columns + 1)  # sums over the columns to the left, of a strip of rows
    # the pixels whose rectangles reach the points
    left = max(0, math.floor((-half_u - first_u) / finer))
    right = min(w, math.ceil((columns + half_u - first_u) / finer) + 1)
    top_row = max(0, math.floor((-half_v - first_v) / finer))
    end_row = min(h, math.ceil((rows + half_v - first_v) / finer) + 1)
    for r in range(top_row, end_row):
        middle = first_v + finer * r
        low = min(max(middle - half_v, 0.0), rows)
        high = min(max(middle + half_v, 0.0), rows)
        top = min(int(low), rows - 1)
        bottom = min(int(high), rows - 1)
        to_low = low - top
        to_high = high - bottom
        for j in range(columns):
            upper = above[top, j] + to_low * (above[top + 1, j] - above[top, j])
            lower = above[bottom, j] + to_high * (above[bottom + 1, j] - above[bottom, j])
            before[j + 1] = before[j] + (lower - upper)
        for c in range(left, right):
            middle = first_u + finer * c
            until_right = _sum_before(before, min(max(middle + half_u, 0.0), columns))
            until_left = _sum_before(before, min(max(middle - half_u, 0.0), columns))
            image[r, c] = per_points * (until_right - until_left)


@numba.njit(**PLAIN)
def _sum_before(sums, place):  # type: ignore[no-untyped-def]
    """Return running sums at a place between two of them."""
    first = min(int(place), len(sums) - 2)
    return sums[first] + (place - first) * (sums[first + 1] - sums[first])


# --- what lines of sight see ---


class SightLines(NamedTuple):
    """Lines of sight through a row of points on the surface, in a damage's own axes, metres."""

    along: float
    """Place of the first point from the centre, along the damage's length."""
    across: float
    """The same across it."""
    step_along: float
    """From point to point."""
    step_across: float
    drift_along: float
    """At the depth t along the normal, a line is at its point minus t times the drift."""
    drift_across: float


@numba.njit(**PLAIN)
def _see_row(  # type: ignore[no-untyped-def]
    shape,
    hole,
    du,
    dv,
    finer,
    sights,
    metric,
    edge,
    work,
    depths,
):
    """Write the depths (j,) along the optical axis that a row of points sees of a damage.

    ``du`` and ``dv``: the first point's offset from the centre in pixels, of which each has
    ``finer`` points. ``edge``: width of a slot's edge. ``work`` (`SCRATCH`, j or more): scratch."""
    # metres on the surface per pixel: along the rows by u and by v, across them by v
    x_by_u = math.sqrt(metric[0, 0])
    x_by_v = metric[0, 1] / x_by_u
    y_by_v = math.sqrt(metric[0, 0] * metric[1, 1] - metric[0, 1] ** 2) / x_by_u
    # the damage's own axes
    cosine_turn = math.cos(hole[6])
    sine_turn = math.sin(hole[6])
    x = x_by_u * du + x_by_v * dv
    y = y_by_v * dv
    step = x_by_u / finer
    radius = hole[2]
    count = len(depths)
    seen = work[0, :count]
    for j in range(count):
        depths[j] = 0.0
    for k in range(len(sights)):
        cosine = sights[k, 0]
        deepest = hole[3] * cosine
        drift_x = x_by_u * sights[k, 1] + x_by_v * sights[k, 2]
        drift_y = y_by_v * sights[k, 2]
        lines = SightLines(
            cosine_turn * x + sine_turn * y,
            cosine_turn * y - sine_turn * x,
            cosine_turn * step,
            -sine_turn * step,
            cosine_turn * drift_x + sine_turn * drift_y,
            cosine_turn * drift_y - sine_turn * drift_x,
        )
        if shape == SLOT:
            _see_slot(lines, radius, deepest, math.exp(hole[5]), edge, seen)
        elif shape == CAP:
            _see_cap(lines, radius, deepest, seen)
        else:
            _see_bowl(lines, radius, deepest, work, seen)
        per_depth = sights[k, 7] / cosine
        for j in range(count):
            depths[j] += per_depth * seen[j]


@numba.njit(**VECTORS)
def _see_cap(  # type: ignore[no-untyped-def]
    lines,
    radius,
    deepest,
    depths,
):
    """Write the depths (j,) along the normal at which lines of sight meet a cap.

    Its sphere, stretched along the normal where it is deeper than its rim's radius, makes the depth
    the root of a quadratic equation. Within the rim it has one of the cap's sign."""
    sign = math.copysign(1.0, deepest)
    height = min(abs(deepest), radius)
    flatter = height / abs(deepest)
    centre = (radius * radius - height * height) / (2.0 * height)  # of the ball, before the rim
    square = (
        flatter * flatter
        + lines.drift_along * lines.drift_along
        + lines.drift_across * lines.drift_across
    )
    per_square = sign / square
    for j in range(len(depths)):
        x = lines.along + j * lines.step_along
        y = lines.across + j * lines.step_across
        inside = radius * radius - x * x - y * y
        half = flatter * centre - sign * (x * lines.drift_along + y * lines.drift_across)
        root = math.sqrt(half * half + square * max(inside, 0.0))
        depths[j] = per_square * (root - half) if inside > 0.0 else 0.0


@numba.njit(**VECTORS)
def _see_bowl(  # type: ignore[no-untyped-def]
    lines,
    radius,
    deepest,
    work,
    depths,
):
    """Write the depths (j,) along the normal at which lines of sight meet a bowl.

    False position with halved weights, between 0 and the deepest, for all depths at once; of
    several meetings, it finds one. ``work`` (`SCRATCH`, j or more): scratch."""
    count = len(depths)
    size = abs(deepest)
    sign = math.copysign(1.0, deepest)
    close = CLOSE * size
    by_along = sign * lines.drift_along
    by_across = sign * lines.drift_across
    per_square = 1.0 / (radius * radius)
    low = work[1, :count]
    high = work[2, :count]
    at_low = work[3, :count]  # height of the line of sight above the bowl
    at_high = work[4, :count]
    last_side = work[5, :count]  # of the bowl: 1 above it, -1 below it
    error = work[6, :count]
    for j in range(count):
        x = lines.along + j * lines.step_along
        y = lines.across + j * lines.step_across
        depth = size * _raised_cosine(per_square * (x * x + y * y))
        depths[j] = sign * depth
        x -= size * by_along
        y -= size * by_across
        low[j] = 0.0
        high[j] = size
        at_low[j] = depth
        at_high[j] = size * _raised_cosine(per_square * (x * x + y * y)) - size
        last_side[j] = 0.0
        error[j] = np.inf
    if math.hypot(by_along, by_across) * size < STRAIGHT * radius:
        return
    for _ in range(MOST_STEPS):
        open_lines = 0
        for j in range(count):
            # all loads first: one that hangs on a condition would prevent vectors
            lowest = low[j]
            highest = high[j]
            at_lowest = at_low[j]
            at_highest = at_high[j]
            side = last_side[j]
            last_error = error[j]
            last_depth = depths[j]
            depth = (lowest * at_highest - highest * at_lowest) / (at_highest - at_lowest)
            x = lines.along + j * lines.step_along - depth * by_along
            y = lines.across + j * lines.step_across - depth * by_across
            beyond = size * _raised_cosine(per_square * (x * x + y * y)) - depth
            is_open = last_error >= close
            depths[j] = sign * depth if is_open else last_depth
            error[j] = abs(beyond) if is_open else last_error
            is_above = beyond > 0.0
            low[j] = depth if is_above else lowest
            high[j] = highest if is_above else depth
            half_lowest = 0.5 * at_lowest if side == -1.0 else at_lowest
            half_highest = 0.5 * at_highest if side == 1.0 else at_highest
            at_low[j] = beyond if is_above else half_lowest
            at_high[j] = half_highest if is_above else beyond
            last_side[j] = 1.0 if is_above else -1.0
            open_lines += error[j] >= close
        if open_lines == 0:
            break


@numba.njit(**PLAIN)
def _raised_cosine(square):  # type: ignore[no-untyped-def]
    """Return (1 + cos(pi p)) / 2 for the ``square`` of p, within 1e-12, and 0 beyond 1.

    It is the square of cos(pi p / 2), a short power series in the square of p. Most of the time of
    a fit of a bowl is spent here; without root and cosine it takes half of it."""
    total = COSINE_SERIES[-1]
    for k in range(len(COSINE_SERIES) - 2, -1, -1):
        total = COSINE_SERIES[k] + square * total
    return total * total if square < 1.0 else 0.0


@numba.njit(**PLAIN)
def _see_slot(  # type: ignore[no-untyped-def]
    lines,
    radius,
    deepest,
    stretch,
    edge,
    depths,
):
    """Write the depths (j,) along the normal at which lines of sight meet a slot: the floor, or an
    upright wall where they leave the mouth.

    ``edge``: width of its edge, over which coverage rises from 0 to 1."""
    sign = math.copysign(1.0, deepest)
    for j in range(len(depths)):
        x = lines.along + j * lines.step_along
        y = lines.across + j * lines.step_across
        inside = min(max(0.5 + (radius - abs(y)) / edge, 0.0), 1.0)
        ends = min(max(0.5 + (radius * stretch - abs(x)) / edge, 0.0), 1.0)
        to_end = _way_inside(x, sign * lines.drift_along, radius * stretch)
        to_side = _way_inside(y, sign * lines.drift_across, radius)
        depths[j] = deepest * inside * ends * min(min(to_end, to_side) / abs(deepest), 1.0)


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
