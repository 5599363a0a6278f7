"""The model of a blurred hole, and its fit to the residuals around one detection.

The model is a round tube between a mouth in the surface and a flat floor, seen and lit obliquely,
and averaged over a rectangle of pixels. Light that reaches depth t passes the mouth and the circle
at depth t on its way in and out; in the image each is an ellipse that parallax shifts. The tube's
length, as a share of the depth, is fitted too: the model's ``wall``.

The lens averages too, by a second rectangle. A filter may weigh pixels: a bilateral one gives deep
neighbours less weight, and one that sums phasors gives each pixel that of its light
(`HolePatch.half_m`, `HolePatch.brightness`).

A hole is five numbers: u, v (px), radius, depth along the optical axis (m), and wall (0 to 1).
`pictures` draws holes, `fit_hole` fits one. `detectors.findings.hole_model_reference` is the same
model and the same least squares, written plainly.

Not modelled: light between wall and floor, which makes holes of 33 mm look 4 % deeper; walls darker
than the floor; a floor that is not flat; what weights do to other shapes than holes."""

import math
from dataclasses import dataclass

import numba
import numpy as np

from detectors.findings.shapes import DISC, SHAPES, SLOT, Shape, reliefs
from detectors.findings.whitening import correlated_products
from detectors.pixels.clusters import PLAIN

# --- the picture ---

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

# --- the descent ---

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

# --- what is known beforehand ---

WALL_PRIOR = (0.5, 12.0**-0.5)
"""Prior mean and standard deviation of the wall, which is uniform from 0 to 1."""


# --- viewpoints ---


def normal_of(per_px_m: np.ndarray) -> np.ndarray:
    """Return the vector product (3,) of a surface's derivatives by u and v (2, 3)."""
    (ax, ay, az), (bx, by, bz) = per_px_m.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def sight(
    centre_m: np.ndarray,
    per_px_m: np.ndarray,
    emitter_m: np.ndarray,
    share: float = 1.0,
) -> np.ndarray:
    """Return the viewpoint (8,) of a hole, reduced to what moves in the image.

    A circle at depth h along the normal has the image of the same circle on the surface, moved by
    h * drift / (1 + h * shrinking) and divided by that divisor. Light from depth h entered beam *
    h / (h + height) away from it.

    Args:
        centre_m: (3,), the surface's point at the hole, camera frame.
        per_px_m: (2, 3), its derivatives by u and v.
        emitter_m: (3,), the light source, camera frame.
        share: of the image that this viewpoint contributes.

    Returns:
        the cosine between ray and normal, times the ray's length per z; the drift along u and v;
        the shrinking; the beam along u and v; the emitter's height; and the share."""
    normal = normal_of(per_px_m)
    normal = normal / math.copysign(math.hypot(*normal), normal @ centre_m)
    ray = centre_m / centre_m[2]
    z = centre_m[2]
    slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
    drift = np.linalg.solve(slopes_per_px, (normal - normal[2] * ray)[:2]) / z
    distance = normal @ centre_m
    before = normal @ emitter_m
    # the offset in the surface's plane by least squares
    aside_m = emitter_m - centre_m * before / distance
    beam = np.linalg.solve(per_px_m @ per_px_m.T, per_px_m @ aside_m)
    return np.array([normal @ ray, *drift, normal[2] / z, *beam, distance - before, share])


def straight_sight(per_px_m: np.ndarray) -> np.ndarray:
    """Return the viewpoint (8,) of a parallel projection of unknown origin: view and light are
    along z."""
    normal = normal_of(per_px_m)
    normal = normal / math.copysign(math.hypot(*normal), normal[2])
    drift = np.linalg.solve(per_px_m[:, :2].T, normal[:2])
    return np.array([normal[2], *drift, 0.0, 0.0, 0.0, 1.0, 1.0])


# --- the picture of holes ---


@dataclass(frozen=True)
class HolePatch:
    """Residuals around one detection, and how they come about."""

    residual_m: np.ndarray
    """(h, w), along the optical axis, positive behind the surface."""
    used: np.ndarray
    """(h, w) bool: the pixels that the fit uses."""
    metric_m2: np.ndarray
    """(2, 2): its quadratic form is the squared length of a pixel offset (du, dv)."""
    blur_px: tuple[float, float]
    """Sides, along u and along v, of the rectangle over which the image is averaged."""
    noise_m: float
    """Standard deviation of the residuals beside the hole."""
    sights: np.ndarray
    """(s, 8): the viewpoints (`sight`)."""
    soft: bool = False
    """True if the blur falls off from its middle like a lens' or a beam's: two rectangles in turn,
    of 1 / sqrt(2) of its sides; False if it ends sharply like a filter's window."""
    brightness: float = 0.0
    """Light from the floor over that from the face, by which the camera's filter weighs pixels; 0
    if it weighs all alike."""
    half_m: float = math.inf
    """Difference in depth at which the filter gives a pixel half of the weight."""
    lens_px: tuple[float, float] = (1.0, 1.0)
    """Sides of the rectangle of pixels over which the lens averages, before the filter does; 1
    where it is sharp (`lens_side`)."""
    shared_px: tuple[float, float] | None = None
    """Sides of the rectangle over which the noise is averaged; None: those of the blur."""

    @property
    def noise_px(self) -> tuple[float, float]:
        """Sides of the rectangle over which the noise is averaged."""
        return self.blur_px if self.shared_px is None else self.shared_px

    @property
    def weighing(self) -> tuple[float, float, float, float]:
        """Brightness, half depth and the lens' sides as the kernels take them."""
        lens_u, lens_v = self.lens_px
        return self.brightness, self.half_m, lens_u, lens_v

    @property
    def prior_weight(self) -> float:
        """Misfit in metres that corresponds to a deviation of the wall by 1."""
        return self.noise_m * math.sqrt(math.prod(self.noise_px)) / WALL_PRIOR[1]


def lens_side(deviation_px: float) -> float:
    """Return the side of the rectangle of pixels, each in parts, that has the second moment of a
    blur: (s - 1) / s for sides up to 3, some (s^2 - 1) / 12 beyond."""
    variance_px2 = deviation_px**2
    if variance_px2 < 2.0 / 3.0:
        return 1.0 / (1.0 - variance_px2)
    return math.sqrt(12.0 * variance_px2 + 1.0)


def pictures(patch: HolePatch, holes: np.ndarray, shape: Shape = "disc") -> np.ndarray:
    """Return the residuals (m, h, w), without offset, of holes (m, 5): u, v, radius, depth along
    the optical axis, and wall in 0..1; a disc if the depth is negative. Other shapes have 7
    numbers (`detectors.findings.shapes`).

    The mouth is cut into strips along u. Each viewpoint gives a hole three layers of wall and one
    of all that is deeper."""
    blur_u, blur_v = patch.blur_px
    height, width = patch.used.shape
    return _drawn(
        SHAPES.index(shape),
        holes,
        patch.sights,
        patch.metric_m2,
        blur_u,
        blur_v,
        patch.soft,
        patch.weighing,
        height,
        width,
    )


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
    """Return the `pictures` (m, h, w) of holes.

    Each layer is a shape with one start and one end in each strip. The mean over the blur's
    rectangle is the integral over u, exact for each column and strip (``across``), and over v by
    the running sum of the strips (``above``)."""
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


# --- the fit ---


@dataclass(frozen=True)
class HoleFit:
    """A fitted hole."""

    u_px: float
    """Centre of the mouth in the patch, along columns."""
    v_px: float
    """Centre of the mouth in the patch, along rows."""
    radius_m: float
    depth_m: float
    """Along the optical axis, positive behind the surface."""
    offset_m: float
    """Residual of the surface around the hole."""
    wall: float
    """Length of the tube over the depth, 0 to 1."""
    covariance: np.ndarray
    """(8, 8): of u, v, radius, depth, offset, wall, stretch and angle, in px, metres and radians;
    0 for those that the shape lacks."""
    converged: bool
    shape: Shape = "disc"
    stretch: float = 0.0
    """Logarithm of a slot's length over its width."""
    angle_rad: float = 0.0
    """Angle of a slot's length on the surface, from the direction of the rows."""
    chi_square: float = np.nan
    """Sum of squared residuals over the noise's variance, of independent pixels."""
    independent: float = np.nan
    """Number of independent pixels: one in each rectangle that shares noise."""

    @property
    def numbers(self) -> np.ndarray:
        """The damage (7,) as `pictures` draws it."""
        place_and_size = [self.u_px, self.v_px, self.radius_m, self.depth_m]
        return np.array([*place_and_size, self.wall, self.stretch, self.angle_rad])


def fit_hole(
    patch: HolePatch,
    u: float,
    v: float,
    radius_m: float,
    depth_m: float,
    offset_m: float,
    *,
    shape: Shape = "disc",
    stretch: float = 0.0,
    angle_rad: float = 0.0,
    largest_chi_square: float = math.inf,
) -> HoleFit:
    """Fit a damage of one shape to at least eight used pixels by least squares (Levenberg and
    Marquardt) from start values. Its covariance is that of `sandwich_covariance`. The descent ends,
    without having converged, where it can hardly come below ``largest_chi_square`` any more.

    The parameters are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2),
    which has `WALL_PRIOR`; of a slot, its stretch and angle instead of the wall. The fourth is the
    hole's volume. The blur preserves it, so that only the radius of a small hole is
    ill-determined."""
    blur_u, blur_v = patch.blur_px
    height, width = patch.used.shape
    volume = depth_m * radius_m**2
    x = WALL_PRIOR[0]
    sharing = math.prod(patch.noise_px)
    per_chi_square_m2 = max(patch.noise_m, LEAST_M) ** 2 * sharing
    hole, offset, rows, converged = _descent(
        patch.residual_m[patch.used],
        np.flatnonzero(patch.used),
        patch.prior_weight,
        np.array([u, v, math.log(radius_m), volume, offset_m, x, stretch, angle_rad]),
        SHAPES.index(shape),
        patch.sights,
        patch.metric_m2,
        blur_u,
        blur_v,
        patch.soft,
        patch.weighing,
        height,
        width,
        largest_chi_square * per_chi_square_m2,
    )
    derivatives = rows[:8]
    misfit = rows[8]
    square = float(misfit @ misfit)
    u, v, radius, depth, wall, stretch, angle = hole.tolist()
    return HoleFit(
        u_px=u,
        v_px=v,
        radius_m=radius,
        depth_m=depth,
        offset_m=offset,
        wall=wall,
        covariance=sandwich_covariance(patch, derivatives, square),
        converged=converged,
        shape=shape,
        stretch=stretch,
        angle_rad=angle,
        chi_square=square / per_chi_square_m2,
        independent=len(misfit) / sharing,
    )


def sandwich_covariance(
    patch: HolePatch,
    derivatives: np.ndarray,
    square_m2: float,
) -> np.ndarray:
    """Return the covariance (p, p) of (u, v, radius, depth, offset, wall ..) if the square filter
    correlates the noise; NaN if it is singular.

    With A = J' J + W it is A^-1 (s^2 J' C J + p^2 W) A^-1. W is the prior's square weight on the
    wall, p^2 its variance; E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)).

    Args:
        patch: the pixels, their noise and blur.
        derivatives: J' (p, n), of the used pixels; rows of 0 for parameters that are not fitted.
        square_m2: sum of their squared residuals."""
    count = len(derivatives)
    fitted = np.flatnonzero(derivatives.any(axis=1) | (np.arange(count) < 6))
    derivatives = derivatives[fitted]
    columns = np.zeros((*patch.used.shape, len(fitted)))
    columns[patch.used] = derivatives.T
    blur_u, blur_v = patch.noise_px
    across = _nearest_odd(blur_u)
    down = _nearest_odd(blur_v)
    prior = np.diag(np.where(fitted == 5, patch.prior_weight**2, 0.0))
    unknown = np.full((count, count), np.nan)
    try:
        bread = np.linalg.inv(derivatives @ derivatives.T + prior)
    except np.linalg.LinAlgError:
        return unknown
    meat = correlated_products(columns, across, down) / (across * down)
    freedom = derivatives.shape[1] - float(np.vdot(bread, meat))
    if freedom <= 0:
        return unknown
    prior_variance = patch.noise_m**2 * blur_u * blur_v
    covariance = np.zeros((count, count))
    inner = square_m2 / freedom * meat + prior_variance * prior
    covariance[np.ix_(fitted, fitted)] = bread @ inner @ bread
    return covariance


def _nearest_odd(blur: float) -> int:
    """Return the odd number of pixels nearest to a blur: pixels this far apart share no noise."""
    return 2 * max(round((blur - 1) / 2), 0) + 1


@numba.njit(**PLAIN)
def _drawn(  # type: ignore[no-untyped-def]
    shape,
    holes,
    sights,
    metric,
    blur_u,
    blur_v,
    soft,
    weighing,
    h,
    w,
):
    """Return the `pictures` (m, h, w) of damages (m, 7) of a shape."""
    brightness, half, lens_u, lens_v = weighing
    lens = (lens_u, lens_v)
    images = _averaged(shape, holes, sights, metric, blur_u, blur_v, soft, lens, h, w)
    if shape != DISC or not (brightness > 0.0 or half < np.inf):
        return images
    sharp = _averaged(shape, holes, sights, metric, 1.0, 1.0, False, lens, h, w)
    faces = sharp  # what is seen of the face matters only where light weighs
    if brightness > 0.0:
        mouths = holes.copy()
        mouths[:, 3] = -1.0
        faces = 1.0 + _averaged(shape, mouths, sights, metric, blur_u, blur_v, soft, lens, h, w)
    for n in range(len(images)):
        if holes[n, 3] > 0.0:
            _weigh(images[n], sharp[n], faces[n], holes[n, 3], brightness, half)
    return images


@numba.njit(**PLAIN)
def _averaged(  # type: ignore[no-untyped-def]
    shape,
    holes,
    sights,
    metric,
    blur_u,
    blur_v,
    soft,
    lens,
    h,
    w,
):
    """Return the `pictures` (m, h, w) of a filter that weighs all pixels alike."""
    if soft:
        blur_u = math.sqrt(0.5) * blur_u
        blur_v = math.sqrt(0.5) * blur_v
    if shape == DISC:
        images = _painted(holes, sights, metric, max(blur_u, 1.0), max(blur_v, 1.0), h, w)
    else:
        images = reliefs(shape, holes, sights, metric, max(blur_u, 1.0), max(blur_v, 1.0), h, w)
    if soft:
        for n in range(len(images)):
            _smooth(images[n], blur_u, blur_v)
    lens_u, lens_v = lens
    if lens_u > 1.0 or lens_v > 1.0:
        for n in range(len(images)):
            _smooth(images[n], lens_u, lens_v)
    return images


@numba.njit(**PLAIN)
def _weigh(  # type: ignore[no-untyped-def]
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


@numba.njit(**PLAIN)
def _smooth(image, side_u, side_v):  # type: ignore[no-untyped-def]
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
    _smooth_columns(turned, side_u, first_column)
    window[:] = turned.T
    _smooth_columns(window, side_v, first_row)


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
def _smooth_columns(image, side, first):  # type: ignore[no-untyped-def]
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
def _descent(  # type: ignore[no-untyped-def]
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
        image = _drawn(
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
            drawn = _drawn(
                shape, varied_holes, sights, metric, blur_u, blur_v, soft, weighing, h, w
            )
            images = drawn.ravel()
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
