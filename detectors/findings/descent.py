"""The descent to the damage of one shape that fits a patch best (Levenberg and Marquardt)."""

import math

import numba
import numpy as np

from detectors.findings.hole_patch import WALL_PRIOR, CameraView
from detectors.findings.pictures import drawn
from detectors.findings.products import products_of
from detectors.findings.shapes import DISC, SLOT
from detectors.pixels.clusters import PLAIN

STEP = 1e-2
"""Step of finite differences: in pixels for the position, relative for radius and depth, absolute
for the wall. Kinks of the picture mislead more descents if it is a tenth."""
MOST_STEPS = 40
TOLERANCE = 1e-5  # relative gain of a step below which the descent ends
DAMPING = 1e-3  # of the first step
SMALLEST = 1e-18  # square of a deviation that is only rounding error, square metres
LEAST_M = 1e-9  # size of such a deviation
MOST_GAIN = 10.0
"""Times what the linear model of a step promises that later steps may still gain."""
LONGEST = 3.0  # largest logarithm of a slot's length over its width


@numba.njit(**PLAIN)
def descend(
    data: np.ndarray,
    pixels: np.ndarray,
    weight: float,
    start: np.ndarray,
    shape: int,
    view: CameraView,
    largest_square: float,
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, bool]:
    """Return the best damage (7,) of a shape, its offset, derivatives (8, n), the damage minus the
    ``data`` (n,), and whether the descent from the parameters ``start`` (8,) has converged.

    The derivatives are those of the used pixels, at flat indices ``pixels`` (n,), by (u, v, radius,
    depth, offset, wall, stretch, angle), 0 for those that the shape lacks. Where a last step that
    gained next to nothing has made the damage a little better, they are those before it.
    ``weight``: of the prior.

    The descent ends, without having converged, where the sum of squares can hardly come below
    ``largest_square``: later steps gained at most `MOST_GAIN` times what the linear model promises.
    """
    fitted = _fitted(shape)
    count = len(fitted)
    derivatives = np.zeros((8, len(data)))
    derivatives[4] = 1.0
    slopes = np.empty((count + 1, len(data)))  # by the fitted parameters; the last row: misfit
    misfit = slopes[count]
    trial_misfit = np.empty(len(data))
    parameters = start
    hole = _damage(parameters, view)
    square = _compare(hole, parameters[4], weight, data, pixels, shape, view, misfit)
    damping = DAMPING
    is_taken = True
    for _ in range(MOST_STEPS):
        if is_taken:
            _differentiate(hole, parameters, fitted, data, pixels, shape, view, derivatives, slopes)
            products = _products(slopes, parameters, weight, hole, shape)
        step, promised = _damped(products, damping)
        if is_taken and square - MOST_GAIN * promised > largest_square:
            break
        trial = parameters.copy()
        for k in range(count):
            trial[fitted[k]] += step[k]
        trial_hole = _damage(trial, view)
        trial_square = _compare(
            trial_hole, trial[4], weight, data, pixels, shape, view, trial_misfit
        )
        enough = TOLERANCE * square + SMALLEST
        gain = square - trial_square
        converged = promised < enough or 0.0 <= gain < enough
        is_taken = gain > 0.0
        if is_taken:
            parameters = trial
            hole = trial_hole
            square = trial_square
            misfit[:] = trial_misfit
            damping = 0.1 * damping
        else:
            damping = max(10.0 * damping, 10.0 * DAMPING)
        if converged:
            return hole, parameters[4], derivatives, misfit, True
    return hole, parameters[4], derivatives, misfit, False


@numba.njit(**PLAIN)
def _fitted(shape):  # type: ignore[no-untyped-def]
    """Return the parameters of a shape that vary, of (u, v, ln radius, volume, offset, x, stretch,
    angle)."""
    if shape == SLOT:
        return np.array([0, 1, 2, 3, 4, 6, 7])
    if shape == DISC:
        return np.array([0, 1, 2, 3, 4, 5])
    return np.array([0, 1, 2, 3, 4])


@numba.njit(**PLAIN)
def _damage(parameters, view):  # type: ignore[no-untyped-def]
    """Return the damage (7,) with these parameters (8,), so bounded that a far trial stays
    finite."""
    h = view.height
    w = view.width
    metric = view.metric_m2
    # no disc is larger than ten patches
    widest = math.log(10.0 * (h + w) * math.sqrt(max(metric[0, 0], metric[1, 1])))
    radius = math.exp(min(max(parameters[2], -20.0), widest))
    hole = np.empty(7)
    hole[0] = min(max(parameters[0], -10.0 * w), 10.0 * w)
    hole[1] = min(max(parameters[1], -10.0 * h), 10.0 * h)
    hole[2] = radius
    hole[3] = parameters[3] / radius**2
    hole[4] = math.sin(0.5 * math.pi * parameters[5]) ** 2
    hole[5] = min(max(parameters[6], -LONGEST), LONGEST)
    hole[6] = parameters[7]
    return hole


@numba.njit(**PLAIN)
def _compare(  # type: ignore[no-untyped-def]
    hole,
    offset,
    weight,
    data,
    pixels,
    shape,
    view,
    misfit,
):
    """Write the damage and its offset minus the ``data`` (n,) into ``misfit`` (n,), and return the
    sum of squares, with that of the prior."""
    image = drawn(shape, hole.reshape(1, 7), view).ravel()
    square = (weight * (hole[4] - WALL_PRIOR[0])) ** 2
    for i in range(len(data)):
        misfit[i] = image[pixels[i]] + offset - data[i]
        square += misfit[i] ** 2
    return square


@numba.njit(**PLAIN)
def _differentiate(  # type: ignore[no-untyped-def]
    hole,
    parameters,
    fitted,
    data,
    pixels,
    shape,
    view,
    derivatives,
    slopes,
):
    """Write the ``derivatives`` (8, n) by the damage's own numbers, and from them the ``slopes``
    (p + 1, n) by the ``fitted`` (p,) parameters, whose last row is the misfit."""
    radius = hole[2]
    depth = hole[3]
    steps = np.array([STEP, STEP, STEP * radius, STEP * depth, -STEP, STEP, STEP])
    if depth == 0.0:
        steps[3] = STEP**2
    if hole[4] < 0.5:
        steps[4] = STEP
    count = len(fitted)
    varied = np.empty((count - 1, 7))  # all but the offset
    own = np.empty(count - 1, np.int64)  # the number of each
    for k in range(count - 1):
        own[k] = fitted[k] if k < 4 else fitted[k + 1] - 1
        varied[k] = hole
        varied[k, own[k]] += steps[own[k]]
    images = drawn(shape, varied, view).reshape(count - 1, -1)
    misfit = slopes[count]
    for k in range(count - 1):
        row = derivatives[own[k] if own[k] < 4 else own[k] + 1]
        image = images[k]
        per_step = 1.0 / steps[own[k]]
        for i in range(len(data)):
            row[i] = (image[pixels[i]] - (misfit[i] - parameters[4] + data[i])) * per_step
    # by the unbounded parameters, from those by the damage's own numbers
    for k in range(count):
        slopes[k] = derivatives[fitted[k]]
    slopes[2] = radius * derivatives[2] - 2.0 * depth * derivatives[3]
    slopes[3] = derivatives[3] / radius**2
    if shape == DISC:
        slopes[5] = _bend(parameters) * derivatives[5]


@numba.njit(**PLAIN)
def _bend(parameters):  # type: ignore[no-untyped-def]
    """Return the derivative of the wall, sin^2(pi x / 2), by x."""
    return 0.5 * math.pi * math.sin(math.pi * parameters[5])


@numba.njit(**PLAIN)
def _products(  # type: ignore[no-untyped-def]
    slopes,
    parameters,
    weight,
    hole,
    shape,
):
    """Return the normal equations (p + 1, p + 1) of ``slopes`` (p + 1, n) and the wall's prior,
    right side last."""
    products = products_of(slopes)
    if shape == DISC:
        slope = weight * _bend(parameters)
        products[5, 5] += slope**2
        products[5, 6] += slope * weight * (hole[4] - WALL_PRIOR[0])
    return products


@numba.njit(**PLAIN)
def _damped(products, damping):  # type: ignore[no-untyped-def]
    """Return the step (p,) of damped normal equations ``products`` (p + 1, p + 1), right side
    last, and its predicted gain, by Cholesky's factor of the matrix with its diagonal times 1 +
    ``damping``."""
    p = len(products) - 1
    lower = np.zeros((p + 1, p))
    step = np.zeros(p)
    promised = 0.0
    for j in range(p):
        for i in range(j, p + 1):
            total = products[j, i] * (1.0 + damping if i == j else 1.0)
            least = max(1e-14 * total, SMALLEST)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(max(total, least)) if i == j else total / lower[j, j]
    for j in range(p - 1, -1, -1):
        total = -lower[p, j]
        for k in range(j + 1, p):
            total -= lower[k, j] * step[k]
        step[j] = total / lower[j, j]
        promised -= step[j] * products[j, p]
    return step, promised
