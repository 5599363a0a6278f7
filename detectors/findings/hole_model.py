"""The model of a blurred hole, and its fit to the residuals around one detection.

The model is a round tube between a mouth in the surface and a flat floor, seen and lit obliquely,
and averaged over ``blur_px`` x ``blur_px`` pixels. Light that reaches depth t passes the mouth and
the circle at depth t on its way in and out; in the image each is an ellipse that parallax shifts.
The tube's length is fitted too.

Not modelled: light between wall and floor, which makes a wall look deeper than it is; walls darker
than the floor; a floor that is not flat; the lower weight of deep neighbours in a bilateral filter
(holes of 2 to 3 times the blur are measured up to 16 % too deep at 33 mm)."""

import math
from dataclasses import dataclass, replace

import numba
import numpy as np

from detectors.findings.clusters import PLAIN
from detectors.findings.whitening import correlated_products, covariance_factor

STRIPS = 64
"""Strips that approximate the disc: the total coverage is exact, that of a pixel right to 0.001
for a blur of 3."""
NODES = np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5, 1.0])
WEIGHTS = np.array([5.0, 8.0, 5.0, 0.0]) / 18.0
"""Gauss-Legendre rule with three points on (0, 1) for the integral over the wall's depth, and the
wall's end."""
STEP = 1e-2
"""Step of finite differences: in pixels for the place, relative for radius and depth, absolute for
the wall. Kinks of the picture mislead more descents if it is a tenth."""
# limits of a descent: the number of steps, and the relative gain below which it ends
MOST_STEPS = 40
TOLERANCE = 1e-5
DAMPING = 1e-3
LEAST_M = 1e-9
SMALLEST = 1e-18
"""Damping of the first step; size of a deviation that is only rounding error, and its square."""
THIN_PX = 4  # far pixels tell the offset alone: of 16, one nearly suffices
MODEL_ERROR = 0.02
RADIUS_ERROR_PX = 0.05
DEPTH_ERROR = 0.05
"""Errors by light between wall and floor on simulated clouds: shares of a pixel's depth and of the
fitted sizes."""
MOST_MISFIT = 1.5
"""Largest misfit of a valid fit: simulations with the model's optics give 0.3 to 1.05, with others
1.1 to 3."""
WALL_PRIOR = (0.5, 12.0**-0.5)
"""Prior mean and standard deviation of the tube's length over the depth, which is uniform from 0
to 1."""

_THETA = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
EDGES = np.sin(
    _THETA
)  # edges (s + 1,) of strips across a unit disc: narrow where the chord changes fast
HALF_CHORDS = np.diff(_THETA / 2 + np.sin(2 * _THETA) / 4) / np.diff(
    EDGES
)  # mean half-chords (s,) of these strips
MIDDLES = 0.5 * (EDGES[:-1] + EDGES[1:])


def normal_of(per_px_m: np.ndarray) -> np.ndarray:
    """Return the vector product (3,) of a surface's derivatives by u and v (2, 3)."""
    (ax, ay, az), (bx, by, bz) = per_px_m.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def sight(
    centre_m: np.ndarray, per_px_m: np.ndarray, emitter_m: np.ndarray, share: float = 1.0
) -> np.ndarray:
    """Return the viewpoint (8,) of a hole, reduced to what moves in the image: the cosine between
    ray and normal, times the ray's length per z; the drift along u and v; the shrinking; the beam
    along u and v; the emitter's height; the share of the image that this viewpoint contributes.
    ``centre_m`` (3,): camera frame. ``per_px_m``: (2, 3).

    A circle at depth h along the normal has the image of the same circle on the surface, moved by
    h * drift / (1 + h * shrinking) and divided by that divisor. Light from depth h entered beam *
    h / (h + height) away from it."""
    normal = normal_of(per_px_m)
    normal = normal / math.copysign(math.hypot(*normal), normal @ centre_m)
    ray = centre_m / centre_m[2]
    z = centre_m[2]
    slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
    drift = np.linalg.solve(slopes_per_px, (normal - normal[2] * ray)[:2]) / z
    distance = normal @ centre_m
    before = normal @ emitter_m
    # the offset in the surface's plane by least squares
    beam = np.linalg.solve(
        per_px_m @ per_px_m.T, per_px_m @ (emitter_m - centre_m * before / distance)
    )
    return np.array([normal @ ray, *drift, normal[2] / z, *beam, distance - before, share])


def straight_sight(per_px_m: np.ndarray) -> np.ndarray:
    """Return the viewpoint (8,) of a parallel projection of unknown origin: view and light are
    along z."""
    normal = normal_of(per_px_m)
    normal = normal / math.copysign(math.hypot(*normal), normal[2])
    drift = np.linalg.solve(per_px_m[:, :2].T, normal[:2])
    return np.array([normal[2], *drift, 0.0, 0.0, 0.0, 1.0, 1.0])


@dataclass(frozen=True)
class HolePatch:
    """Residuals around one detection. ``metric_m2`` (2, 2): its quadratic form is the squared
    length of a pixel offset (du, dv). ``blur_px`` (along u, along v): sides of the rectangle over
    which the image is averaged. ``noise_m``: standard deviation beside the hole. ``sights``: (s,
    8). ``factor`` (n, n): lower triangular L of the covariance L L' of the used pixels' errors, if
    known. ``left_out``: number of pixels beside them that would add too little."""

    residual_m: np.ndarray
    used: np.ndarray
    metric_m2: np.ndarray
    blur_px: tuple[float, float]
    noise_m: float
    sights: np.ndarray
    factor: np.ndarray | None = None
    left_out: int = 0

    @property
    def prior_weight(self) -> float:
        """Misfit in metres that corresponds to a deviation of the wall by 1."""
        return self.noise_m * math.sqrt(self.blur_px[0] * self.blur_px[1]) / WALL_PRIOR[1]


def pictures(patch: HolePatch, holes: np.ndarray) -> np.ndarray:
    """Return the residuals (m, h, w), without offset, of holes (m, 5): u, v, radius, depth along
    the optical axis, and wall in 0..1; a disc if the depth is negative. The mouth is cut into
    strips along u. Each viewpoint gives a hole three layers of wall and one of all that is deeper.
    """
    return _painted(holes, patch.sights, patch.metric_m2, *patch.blur_px, *patch.used.shape)


@numba.njit(**PLAIN)
def _painted(
    holes: np.ndarray,
    sights: np.ndarray,
    metric: np.ndarray,
    blur_u: float,
    blur_v: float,
    h: int,
    w: int,
) -> np.ndarray:
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
        i = j = 0
        for r in range(
            max(0, math.ceil(v - height - half_v)), min(h - 1, math.floor(v + height + half_v)) + 1
        ):
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
    radius, depth, wall, sights, metric, weights, chords
):
    """Write the ``weights`` (k,) of a hole's layers and their ``chords`` (2, k, s): each layer's
    start and end in each strip, in pixels along u from the centre."""
    g11 = metric[0, 0]
    g12 = metric[0, 1]
    g22 = metric[1, 1]
    # the mouth's height and half-width in px per metre of radius, and the drift of its chords
    # along u by v
    height = math.sqrt(g11 / (g11 * g22 - g12 * g12))
    width = 1.0 / math.sqrt(g11)
    slant = -g12 / g11
    per_height = (
        1.0 / height
    )  # computed here: a division in the loop, which may fail, would prevent vectorisation
    # the three circles that a layer's light passes: shift along u and v, and radius
    shift_u = np.empty(3)
    shift_v = np.empty(3)
    size = np.empty(3)
    for k in range(len(weights)):
        place = sights[k // len(NODES)]
        node = k % len(NODES)
        cosine = place[0]
        beam_u = place[4]
        beam_v = place[5]
        emitter = place[6]
        deepest = depth * cosine
        length = wall * deepest if depth > 0 else 0.0
        tube = length * NODES[node]
        is_wall = NODES[node] < 1.0
        end = tube if is_wall else max(deepest, 0.0)
        weights[k] = place[7] / cosine * (length * WEIGHTS[node] if is_wall else deepest - length)
        scale = 1.0 / (1.0 + tube * place[3])
        lit = end / (end + emitter)
        below = (end - tube) / (end - tube + emitter)
        size[0], size[1], size[2] = radius * scale, radius, radius * scale
        shift_u[0], shift_v[0] = tube * place[1] * scale, tube * place[2] * scale
        shift_u[1], shift_v[1] = -lit * beam_u, -lit * beam_v
        shift_u[2], shift_v[2] = shift_u[0] - below * beam_u, shift_v[0] - below * beam_v
        starts = chords[0, k]
        ends = chords[1, k]
        for s in range(STRIPS):
            drift = slant * radius * height * MIDDLES[s]
            reach = radius * HALF_CHORDS[s] * width
            starts[s], ends[s] = drift - reach, drift + reach
        for circle in range(3):
            for s in range(STRIPS):
                off = radius * height * MIDDLES[s] - shift_v[circle]
                middle = shift_u[circle] + slant * off
                half = width * math.sqrt(max(size[circle] ** 2 - (off * per_height) ** 2, 0.0))
                starts[s], ends[s] = max(starts[s], middle - half), min(ends[s], middle + half)


@dataclass(frozen=True)
class HoleFit:
    """A fitted hole: ``u_px`` and ``v_px`` in the patch. ``covariance`` (6, 6): of u, v, radius,
    depth, offset and wall, in px and metres. ``misfit``: deviation of the residuals over that of
    noise and model error; 0 if unknown."""

    u_px: float
    v_px: float
    radius_m: float
    depth_m: float
    offset_m: float
    wall: float
    covariance: np.ndarray
    converged: bool
    misfit: float


def whitened(
    patch: HolePatch, by_lag: np.ndarray | None, offset_m: float, near: np.ndarray
) -> HolePatch:
    """Return the patch with the covariance of its errors: noise with the correlation ``by_lag``
    (odd, odd), and errors of the model, which are shares of the depth beyond ``offset_m``. Of the
    pixels that are not ``near`` (h, w) bool, those of every `THIN_PX`-th row and column are used.
    Without a covariance, the patch stays as it is."""
    used = patch.used & near
    step = (slice(None, None, THIN_PX),) * 2
    used[step] = patch.used[step]
    error_m = MODEL_ERROR * np.abs(patch.residual_m - offset_m)
    factor = covariance_factor(used, by_lag, max(patch.noise_m, LEAST_M), error_m)
    left_out = int(np.count_nonzero(patch.used) - np.count_nonzero(used))
    return patch if factor is None else replace(patch, used=used, factor=factor, left_out=left_out)


def fit_hole(
    patch: HolePatch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float
) -> HoleFit:
    """Fit a hole to at least six used pixels by least squares (Levenberg and Marquardt) from start
    values. With the covariance in the patch, the fit has maximum likelihood; else the covariance
    is that of `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2), which
    has `WALL_PRIOR`. The fourth is the hole's volume. The blur preserves it, so that only the
    radius of a small hole is ill-determined."""
    used = patch.used
    data = patch.residual_m[patch.used]
    known = patch.factor is not None
    weight = 1.0 / WALL_PRIOR[1] if known else patch.prior_weight
    start = np.array([u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    optics = patch.sights, patch.metric_m2, *patch.blur_px, *used.shape
    factor = patch.factor if known else np.zeros((0, 0))
    hole, offset, rows, converged = _descent(
        data, np.flatnonzero(used), factor, weight, start, *optics
    )
    by = rows[:6]
    left = rows[6]
    u, v, radius, depth, wall = hole.tolist()
    square = float(left @ left)
    if not known:
        return HoleFit(
            u,
            v,
            radius,
            depth,
            offset,
            wall,
            sandwich_covariance(patch, by, square),
            converged,
            0.0,
        )
    # the inverse of the information, times the residual variance, plus the model's errors
    # pixels that are left out have the noise that is known
    variance = (square + patch.left_out) / max(len(data) + patch.left_out - 6, 1)
    information = by @ by.T
    information[5, 5] += WALL_PRIOR[1] ** -2
    covariance = np.linalg.pinv(information, hermitian=True) * variance
    covariance[2, 2] += RADIUS_ERROR_PX**2 * float(np.trace(patch.metric_m2)) / 2.0
    covariance[3, 3] += (DEPTH_ERROR * depth) ** 2
    return HoleFit(u, v, radius, depth, offset, wall, covariance, converged, math.sqrt(variance))


@numba.njit(**PLAIN)
def _descent(  # type: ignore[no-untyped-def]
    data, places, factor, weight, start, sights, metric, blur_u, blur_v, h, w
):
    """Return the best hole (5,), its offset, rows (8, n) and whether the descent from ``start``
    (6,) has converged. The first rows are derivatives of the used pixels, at flat ``places`` (n,),
    by (u, v, radius, depth, offset, wall); the seventh is ``data`` (n,) minus the hole. With a
    ``factor`` (n, n) that is not empty, they are whitened."""
    n = len(data)
    q = start
    step = np.zeros(6)
    damping = 10.0 * DAMPING
    converged = False
    square = promised = np.inf
    rows = np.ones((8, n))
    products = np.eye(7)
    best = np.zeros(5)
    holes = np.zeros((6, 5))
    sizes = np.zeros(5)
    left = rows[7:]
    turn = np.eye(7)
    _whiten(rows[4:5], factor)
    # no disc is larger than ten patches, so that a far trial step stays finite
    widest = math.log(10.0 * (h + w) * math.sqrt(max(metric[0, 0], metric[1, 1])))
    for trial in range(MOST_STEPS + 1):
        at = q + step
        radius = math.exp(min(max(at[2], -20.0), widest))
        for k in range(6):
            holes[k, 0], holes[k, 1] = (
                min(max(at[0], -10.0 * w), 10.0 * w),
                min(max(at[1], -10.0 * h), 10.0 * h),
            )
            holes[k, 2], holes[k, 3] = radius, at[3] / radius**2
            holes[k, 4] = math.sin(0.5 * math.pi * at[5]) ** 2
        image = _painted(holes[:1], sights, metric, blur_u, blur_v, h, w).ravel()
        for i in range(n):
            left[0, i] = image[places[i]] + at[4] - data[i]
        _whiten(left, factor)
        prior = weight * (holes[0, 4] - WALL_PRIOR[0])
        new_square = prior**2
        enough = TOLERANCE * square + SMALLEST
        for i in range(n):
            new_square += left[0, i] ** 2
        converged = promised < enough or 0.0 <= square - new_square < enough
        if trial == 0 or new_square < square:
            q = at
            square = new_square
            damping = 0.1 * damping
            for k in range(5):
                best[k] = holes[0, k]
            depth = best[3]
            bend = 0.5 * math.pi * math.sin(math.pi * at[5])
            sizes[0] = sizes[1] = STEP
            sizes[2], sizes[3] = STEP * radius, STEP * (depth if depth != 0.0 else STEP)
            sizes[4] = -STEP if best[4] >= 0.5 else STEP
            for k in range(5):
                holes[k + 1, k] += sizes[k]
            images = _painted(holes[1:], sights, metric, blur_u, blur_v, h, w).ravel()
            for k in range(5):
                row = k if k < 4 else 5
                per_step = 1.0 / sizes[k]
                for i in range(n):
                    rows[row, i] = (images[k * h * w + places[i]] - image[places[i]]) * per_step
            for i in range(n):
                rows[6, i] = left[0, i]
            _whiten(rows[:4], factor)
            _whiten(rows[5:6], factor)
            # derivatives by q from those by the hole's parameters
            turn[2, 2], turn[2, 3], turn[3, 3], turn[5, 5] = (
                radius,
                -2.0 * depth,
                radius**-2.0,
                bend,
            )
            products = np.dot(np.dot(turn, np.dot(rows[:7], rows[:7].T)), turn.T)
            products[5, 5] += (weight * bend) ** 2
            products[5, 6] += weight * bend * prior
        else:
            damping = max(10.0 * damping, 10.0 * DAMPING)
        if converged:
            break
        step, promised = _damped(products, damping)
    return best, q[4], rows, converged


# sums in any order, so that the compiler uses vectors
@numba.njit(fastmath={"reassoc", "contract", "nsz"}, **PLAIN)
def _whiten(rows: np.ndarray, factor: np.ndarray) -> None:
    """Solve L x = r for each of the rows r (k, n) with a lower triangular ``factor`` L (n, n),
    unless it is empty."""
    first = 0
    while first < len(factor) and not rows[:, first].any():
        first += 1
    for i in range(len(factor) - first):
        by = factor[first + i, first:]
        per_pivot = 1.0 / factor[first + i, first + i]
        for k in range(len(rows)):
            row = rows[k, first:]
            total = 0.0
            for j in range(i):
                total += by[j] * row[j]
            row[i] = (row[i] - total) * per_pivot


@numba.njit(**PLAIN)
def _damped(products, damping):  # type: ignore[no-untyped-def]
    """Return the step (6,) of damped normal equations ``products`` (7, 7), right side last, and
    its predicted gain."""
    lower = np.zeros((7, 6))
    step = np.zeros(6)
    promised = 0.0
    for j in range(6):
        for i in range(j, 7):
            total = products[j, i] * (1.0 + damping if i == j else 1.0)
            least = max(1e-14 * total, SMALLEST)
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(max(total, least)) if i == j else total / lower[j, j]
    for j in range(5, -1, -1):
        total = -lower[6, j]
        for k in range(j + 1, 6):
            total -= lower[k, j] * step[k]
        step[j] = total / lower[j, j]
        promised -= step[j] * products[j, 6]
    return step, promised


def sandwich_covariance(patch: HolePatch, by: np.ndarray, square_m2: float) -> np.ndarray:
    """Return the covariance (6, 6) of (u, v, radius, depth, offset, wall), or NaN, if the square
    filter correlates the noise. ``by`` (6, n): derivatives. ``square_m2``: sum of squared
    residuals. With A = J' J + W it is A^-1 (s^2 J' C J + p^2 W) A^-1. W is the prior's square
    weight on the wall, p^2 its variance; E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J))."""
    columns = np.zeros((*patch.used.shape, 6))
    columns[patch.used] = by.T
    # the odd numbers of pixels nearest to the blur: pixels this far apart share no noise
    across, down = (2 * max(round((blur - 1) / 2), 0) + 1 for blur in patch.blur_px)
    prior = np.zeros((6, 6))
    prior[5, 5] = patch.prior_weight**2
    try:
        bread = np.linalg.inv(by @ by.T + prior)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    meat = correlated_products(columns, across, down) / (across * down)
    freedom = by.shape[1] - float(np.vdot(bread, meat))
    if freedom <= 0:
        return np.full((6, 6), np.nan)
    prior_variance = patch.noise_m**2 * patch.blur_px[0] * patch.blur_px[1]
    return np.asarray(bread @ (square_m2 / freedom * meat + prior_variance * prior) @ bread)
