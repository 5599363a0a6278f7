"""The descent to the damage of one shape that fits a patch best (Levenberg and Marquardt)."""

import math

import numba
import numpy as np

from detectors.findings.hole_patch import WALL_PRIOR
from detectors.findings.pictures import drawn
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
def descend(  # type: ignore[no-untyped-def]
    data,
    pixels,
    weight,
    start,
    shape,
    sights,
    metric,
    blur_u,
    blur_v,
    soft,
    weighing,
    h,
    w,
    largest_square,
):
    """Return the best damage (7,) of a shape, its offset, rows (10, n) and whether the descent
    from ``start`` (8,) has converged.

    The first rows are derivatives of the used pixels, at flat indices ``pixels`` (n,), by (u, v,
    radius, depth, offset, wall, stretch, angle), 0 for those that the shape lacks; the ninth is the
    damage minus ``data`` (n,); the tenth is that of the last trial. ``weight``: of the prior.

    The descent ends where the sum of squares can hardly come below ``largest_square``: a step that
    was taken has a linear model, and later steps gained at most `MOST_GAIN` times what it
    promises."""
    n = len(data)
    parameters = start
    step = np.zeros(8)
    damping = 10.0 * DAMPING
    converged = False
    square = np.inf
    promised = np.inf
    rows = np.zeros((10, n))
    rows[4] = 1.0
    products = np.eye(9)
    best = np.zeros(7)
    holes = np.zeros((8, 7))  # the damage, and seven with one parameter varied
    sizes = np.zeros(7)  # of these changes
    misfit = rows[9:]  # damage minus data of the trial, a view of the last row
    by_parameters = np.eye(9)  # derivatives of the hole by the parameters
    # the parameters of the damage that vary, and their rows
    if shape == SLOT:
        varied = np.array([0, 1, 2, 3, 5, 6])
    elif shape == DISC:
        varied = np.array([0, 1, 2, 3, 4])
    else:
        varied = np.array([0, 1, 2, 3])
    # no disc is larger than ten patches, so that a far trial step stays finite
    widest = math.log(10.0 * (h + w) * math.sqrt(max(metric[0, 0], metric[1, 1])))
    for trial in range(MOST_STEPS + 1):
        trial_parameters = parameters + step
        radius = math.exp(min(max(trial_parameters[2], -20.0), widest))
        for k in range(8):
            holes[k, 0] = min(max(trial_parameters[0], -10.0 * w), 10.0 * w)
            holes[k, 1] = min(max(trial_parameters[1], -10.0 * h), 10.0 * h)
            holes[k, 2] = radius
            holes[k, 3] = trial_parameters[3] / radius**2
            holes[k, 4] = math.sin(0.5 * math.pi * trial_parameters[5]) ** 2
            holes[k, 5] = min(max(trial_parameters[6], -LONGEST), LONGEST)
            holes[k, 6] = trial_parameters[7]
        image = drawn(
            shape, holes[:1], sights, metric, blur_u, blur_v, soft, weighing, h, w
        ).ravel()
        for i in range(n):
            misfit[0, i] = image[pixels[i]] + trial_parameters[4] - data[i]
        prior = weight * (holes[0, 4] - WALL_PRIOR[0])
        new_square = prior**2
        for i in range(n):
            new_square += misfit[0, i] ** 2
        enough = TOLERANCE * square + SMALLEST
        converged = promised < enough or 0.0 <= square - new_square < enough
        is_taken = trial == 0 or new_square < square
        if is_taken:
            parameters = trial_parameters
            square = new_square
            damping = 0.1 * damping
            for k in range(7):
                best[k] = holes[0, k]
            depth = best[3]
            sizes[0] = STEP
            sizes[1] = STEP
            sizes[2] = STEP * radius
            sizes[3] = STEP * (depth if depth != 0.0 else STEP)
            sizes[4] = -STEP if best[4] >= 0.5 else STEP
            sizes[5] = STEP
            sizes[6] = STEP
            count = len(varied)
            for k in range(count):
                holes[k + 1, varied[k]] += sizes[varied[k]]
            varied_holes = holes[1 : 1 + count]
            varied_images = drawn(
                shape, varied_holes, sights, metric, blur_u, blur_v, soft, weighing, h, w
            )
            images = varied_images.ravel()
            for k in range(count):
                row = varied[k] if varied[k] < 4 else varied[k] + 1
                per_step = 1.0 / sizes[varied[k]]
                for i in range(n):
                    rows[row, i] = (images[k * h * w + pixels[i]] - image[pixels[i]]) * per_step
            for i in range(n):
                rows[8, i] = misfit[0, i]
            # derivatives by the unbounded parameters, from those by the hole's own numbers
            bend = 0.5 * math.pi * math.sin(math.pi * trial_parameters[5])
            by_parameters[2, 2] = radius
            by_parameters[2, 3] = -2.0 * depth
            by_parameters[3, 3] = radius**-2.0
            by_parameters[5, 5] = bend
            products = np.dot(np.dot(by_parameters, np.dot(rows[:9], rows[:9].T)), by_parameters.T)
            products[5, 5] += (weight * bend) ** 2
            products[5, 8] += weight * bend * prior
            if shape != SLOT:
                products[6, 6] = 1.0
                products[7, 7] = 1.0
        else:
            damping = max(10.0 * damping, 10.0 * DAMPING)
        if converged:
            break
        step, promised = _damped(products, damping)
        if is_taken and square - MOST_GAIN * promised > largest_square:
            break
    return best, parameters[4], rows, converged


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
