"""The image of a hole through a camera that averages over a square of pixels: forward model, fit, standard errors.

A drilled hole on a locally plane surface: a round tube that starts with the surface's mouth, of some length, and behind
it a floor of one depth, seen and lit obliquely, through the pixel's aperture and a filter that averages ``blur_px`` x
``blur_px`` pixels: a unit pixel convolved with that comb is a square of side ``blur_px``. A ray that has come as deep
as t has passed the mouth and the circle at depth t, and so has the light that comes back along it (a ray counts as
deep as light reaches along it, so a dark end for less); in the image each is an ellipse, shifted by parallax. So the
residual is the integral over t of the blurred overlap of such ellipses. It is the mouth that has the diameter; the
floor alone would look smaller and displaced.

The tube's length over the depth (1 in a blind hole, less where a backing stands behind a board) is fitted too, with
every length from none to the whole depth as plausible.

Not modelled: light between wall and floor, which makes a wall look deeper than it is (the fitted length is then too
short) and the floor too (by 1 mm of 9.5); walls that return less light than the floor; a floor that is not flat; the
loss of weight of deep neighbours in a bilateral filter (0.87 at 33 mm for the Azure Kinect: holes of 2 to 3 times the
blur come out up to 16 % too deep there). Of what stands out before the surface only the disc is modelled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numba
import numpy as np

STRIPS = 64
"""Strips that stand for the disc: the coverage is exact in total, and in each pixel within 0.001 for a blur of 3 or 5
pixels, 0.01 for none."""
PARAMETERS = 6
"""u, v, radius, depth, offset, wall."""
WALL_PRIOR = (0.5, 12.0**-0.5)
"""Mean and standard deviation of the tube's length over the depth before the image is seen: uniform from 0 to 1."""
NODES, WEIGHTS = (np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5]), np.array([5.0, 8.0, 5.0]) / 18.0)
"""Gauss and Legendre's rule of three points on (0, 1), for the integral over the depth of the wall."""
STEP = 1e-3
"""Of the differences that stand for derivatives: in pixels, relative for radius and depth, absolute for the wall."""


@dataclass(frozen=True)
class Sight:
    """From where a hole is seen and lit, reduced to what moves in the image. Depths h here are along the normal.

    A circle at depth h below the surface looks like the same circle on the surface, moved by ``h * drift_px`` /
    (1 + h * ``shrink``), and smaller by that divisor. Light that comes back along a ray from depth h came through the
    surface at ``beam_px * h / (h + emitter_m)`` from it. ``cosine``: between the ray and the normal, times the ray's
    length per z: h over depth along the optical axis.
    """

    cosine: float
    drift_px: np.ndarray
    shrink: float
    beam_px: np.ndarray
    emitter_m: float

    @classmethod
    def of(cls, centre_m: np.ndarray, per_px_m: np.ndarray, emitter_camera_m: np.ndarray) -> Sight:
        """At a surface's point (3,) in the camera's frame with its derivatives by u and v (2, 3)."""
        normal = np.cross(per_px_m[0], per_px_m[1])
        normal = normal / np.copysign(np.linalg.norm(normal), normal @ centre_m)
        ray, z = centre_m / centre_m[2], centre_m[2]
        slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
        drift = np.linalg.pinv(slopes_per_px) @ (normal - normal[2] * ray)[:2] / z
        distance, before = float(normal @ centre_m), float(normal @ emitter_camera_m)
        beam = np.linalg.pinv(per_px_m.T) @ (emitter_camera_m - centre_m * before / distance)
        return cls(float(normal @ ray), drift, float(normal[2] / z), beam, distance - before)

    @cached_property
    def numbers(self) -> np.ndarray:
        """(7,) for the compiled loops."""
        return np.array([self.cosine, *self.drift_px, self.shrink, *self.beam_px, self.emitter_m])


@dataclass(frozen=True)
class Patch:
    """Residuals around one detection. ``residual_m`` (h, w), ``used`` (h, w) bool; pixel (0, 0) is the patch's corner.

    ``metric_m2`` (2, 2): squared length on the surface of a pixel offset (du, dv) is its quadratic form. ``noise_m``:
    standard deviation of the residual beside the hole.
    """

    residual_m: np.ndarray
    used: np.ndarray
    metric_m2: np.ndarray
    blur_px: int
    noise_m: float
    sight: Sight

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.used.shape[0], self.used.shape[1]

    @cached_property
    def form(self) -> np.ndarray:
        """Of the metric, as `_chord` takes it."""
        return _form(self.metric_m2)


@dataclass(frozen=True)
class HoleFit:
    """``u_px``, ``v_px`` in the patch; ``wall``: the tube's length over the depth; ``covariance`` (6, 6) of (u, v,
    radius, depth, offset, wall) in px and metres."""

    u_px: float
    v_px: float
    radius_m: float
    depth_m: float
    offset_m: float
    wall: float
    covariance: np.ndarray
    converged: bool


def _unit_strips() -> tuple[np.ndarray, np.ndarray]:
    """Edges (s + 1,) and mean half-chords (s,) of strips across a unit disc, narrow where the chord changes fast."""
    theta = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
    edges = np.sin(theta)
    areas = np.diff(theta / 2 + np.sin(2 * theta) / 4)
    return edges, areas / np.diff(edges)


EDGES, HALF_CHORDS = _unit_strips()


@numba.njit(cache=True, nogil=True)
def _layers(depth: float, wall: float, sight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Layers whose weighted sum is the hole: three of wall, then what is deeper than the wall.

    Weights (4,), and circles (4, 3, 3) that a ray must pass besides the mouth, as shift in u, in v, and scale.
    """
    cosine, drift_u, drift_v, shrink, beam_u, beam_v, emitter = sight
    deepest = depth * cosine
    length = wall * deepest
    weights = np.zeros(4)
    circles = np.ones((4, 3, 3))
    for k in range(4):
        tube = length * NODES[k] if k < 3 else length
        end = tube if k < 3 else deepest
        weights[k] = (length * WEIGHTS[k] if k < 3 else deepest - length) / cosine
        scale = 1.0 / (1.0 + tube * shrink)
        u, v = tube * drift_u * scale, tube * drift_v * scale
        lit = end / (end + emitter)
        lit_below = (end - tube) / (end - tube + emitter)
        circles[k, 0] = (u, v, scale)
        circles[k, 1] = (-lit * beam_u, -lit * beam_v, 1.0)
        circles[k, 2] = (u - lit_below * beam_u, v - lit_below * beam_v, scale)
    return weights, circles


@numba.njit(cache=True, nogil=True)
def _chord(
    y: float, mean_half_chord: float, radius: float, form: np.ndarray, circles: np.ndarray
) -> tuple[float, float]:
    """Ends along u, from the mouth's centre, of the part of a strip of the mouth that lies in all circles (n, 3).

    ``y`` in -1..1: the strip's middle. ``form``: the ellipse's height and half-width in px per metre of radius, and the
    drift of its chords along u by v.
    """
    height, width, slant = form
    low = radius * (slant * height * y - mean_half_chord * width)
    high = radius * (slant * height * y + mean_half_chord * width)
    for j in range(len(circles)):
        shift_u, shift_v, scale = circles[j]
        if shift_u == 0.0 and shift_v == 0.0 and scale == 1.0:
            continue
        v = radius * height * y - shift_v
        half = width * np.sqrt(max((radius * scale) ** 2 - (v / height) ** 2, 0.0))
        low = max(low, shift_u + slant * v - half)
        high = min(high, shift_u + slant * v + half)
    return low, high


@numba.njit(cache=True, nogil=True)
def _render(
    hole: np.ndarray, form: np.ndarray, weights: np.ndarray, circles: np.ndarray, blur: int, image: np.ndarray
) -> None:
    """Add to an image (h, w) the layers, each a stack of strips, averaged over the square around each pixel."""
    u, v, radius = hole[0], hole[1], hole[2]
    h, w = image.shape
    half = 0.5 * blur
    across = np.empty(w)
    for s in range(STRIPS):
        bottom, top = v + radius * form[0] * EDGES[s], v + radius * form[0] * EDGES[s + 1]
        first, last = w, -1
        across[:] = 0.0
        for k in range(len(weights)):
            low, high = _chord(0.5 * (EDGES[s] + EDGES[s + 1]), HALF_CHORDS[s], radius, form, circles[k])
            if not high > low:
                continue
            left, right = max(0, int(np.ceil(u + low - half))), min(w - 1, int(np.floor(u + high + half)))
            first, last = min(first, left), max(last, right)
            for c in range(left, right + 1):
                across[c] += weights[k] * max(min(u + high, c + half) - max(u + low, c - half), 0.0)
        for r in range(max(0, int(np.ceil(bottom - half))), min(h - 1, int(np.floor(top + half))) + 1):
            along = max(min(top, r + half) - max(bottom, r - half), 0.0) / blur**2
            for c in range(first, last + 1):
                image[r, c] += along * across[c]


def blurred_disc(
    shape: tuple[int, int], u: float, v: float, radius_m: float, metric_m2: np.ndarray, blur_px: int
) -> np.ndarray:
    """Covered part of the square around each pixel, (h, w) in 0..1.

    The disc is an ellipse in pixels: the set where the metric's form of the offset from (u, v) is below radius^2.
    """
    image = np.zeros(shape)
    disc = np.array([u, v, radius_m])
    _render(disc, _form(metric_m2), np.ones(1), np.empty((1, 0, 3)), blur_px, image)
    return image


def blurred_hole(patch: Patch, hole: np.ndarray) -> np.ndarray:
    """The residual (h, w) of a hole (u, v, radius, depth, wall) without offset.

    Depth along the optical axis, wall in 0..1. Where the depth is negative (something before the surface) a disc.
    """
    image: np.ndarray = _image(hole, patch.shape, patch.form, patch.sight.numbers, patch.blur_px)
    return image


def derivatives(patch: Patch, hole: np.ndarray, image: np.ndarray) -> np.ndarray:
    """(5, h, w): of `blurred_hole`, whose value is ``image``, by u, v, radius, depth and wall, by differences."""
    steps = STEP * np.array([1.0, 1.0, hole[2], hole[3] or STEP, 1.0 if hole[4] < 0.5 else -1.0])
    by: np.ndarray = _differences(hole, steps, image, patch.form, patch.sight.numbers, patch.blur_px)
    return by


@numba.njit(cache=True, nogil=True)
def _image(hole: np.ndarray, shape: tuple[int, int], form: np.ndarray, sight: np.ndarray, blur: int) -> np.ndarray:
    image = np.zeros(shape)
    if hole[3] > 0.0:
        weights, circles = _layers(hole[3], hole[4], sight)
    else:
        weights, circles = np.full(1, hole[3]), np.empty((1, 0, 3))
    _render(hole, form, weights, circles, blur, image)
    return image


@numba.njit(cache=True, nogil=True)
def _differences(
    hole: np.ndarray, steps: np.ndarray, image: np.ndarray, form: np.ndarray, sight: np.ndarray, blur: int
) -> np.ndarray:
    by = np.empty((len(hole), *image.shape))
    for k in range(len(hole)):
        moved = hole.copy()
        moved[k] += steps[k]
        by[k] = (_image(moved, image.shape, form, sight, blur) - image) / steps[k]
    return by


def _form(metric_m2: np.ndarray) -> np.ndarray:
    g11, g12, g22 = metric_m2[0, 0], metric_m2[0, 1], metric_m2[1, 1]
    return np.array([math.sqrt(g11 / (g11 * g22 - g12 * g12)), 1.0 / math.sqrt(g11), -g12 / g11])


def fit_hole(patch: Patch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float) -> HoleFit:
    """Least squares from a start, by Levenberg and Marquardt (MINPACK), with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2). The fourth is the hole's
    volume, which the blur keeps, so that a hole smaller than the blur still has one well-determined direction for each
    parameter but its radius; x may run free where the wall must stay in 0..1. The wall has `WALL_PRIOR` for one more
    observation: a small hole, or one seen straight on, does not determine it.
    """
    from scipy.optimize import least_squares

    model = _Model(patch)
    start = np.array([u, v, np.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    scales = np.array([1.0, 1.0, 0.3, 0.3 * abs(start[3]) + 1e-12, 0.1 * abs(depth_m) + 1e-6, 0.3])
    found = least_squares(
        lambda q: model.misfit(q * scales),
        start / scales,
        lambda q: model.jacobian(q * scales) * scales,
        method="lm",
        max_nfev=60,
        xtol=1e-4,
        ftol=1e-4,
        gtol=1e-9,
    )
    q = found.x * scales
    hole, offset = model.hole(q), float(q[4])
    covariance = sandwich_covariance(patch, hole, offset)
    u, v, radius, depth, wall = (float(value) for value in hole)
    return HoleFit(u, v, radius, depth, offset, wall, covariance, bool(found.success))


def _prior_weight(patch: Patch) -> float:
    """What a deviation of the wall of 1 is worth, in metres of misfit: noise that is equal over blur x blur pixels
    counts as often in the sum of squares."""
    return patch.noise_m * patch.blur_px / WALL_PRIOR[1]


def _wall(x: float) -> float:
    return math.sin(0.5 * math.pi * x) ** 2


class _Model:
    """Misfit and Jacobian of one patch with the prior as last row; MINPACK asks for both at the same place."""

    def __init__(self, patch: Patch) -> None:
        self._patch = patch
        self._data = patch.residual_m[patch.used]
        self._weight = _prior_weight(patch)
        h, w = patch.used.shape
        # keeps a wild trial step finite: no disc is larger than ten patches
        self._low = np.array([-10.0 * w, -10.0 * h, -20.0])
        self._high = np.array([10.0 * w, 10.0 * h, math.log(10.0 * (h + w) * math.sqrt(patch.metric_m2.max()))])
        self._at = np.full(PARAMETERS, np.nan)
        self._image = np.empty((h, w))

    def misfit(self, q: np.ndarray) -> np.ndarray:
        self._image, self._at = blurred_hole(self._patch, self.hole(q)), q.copy()
        hole = self._image[self._patch.used]
        return np.append(hole + q[4] - self._data, self._weight * (_wall(q[5]) - WALL_PRIOR[0]))

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        hole = self.hole(q)
        image = self._image if np.array_equal(q, self._at) else blurred_hole(self._patch, hole)
        by = derivatives(self._patch, hole, image)[:, self._patch.used]
        radius, depth = hole[2], hole[3]
        rows = np.zeros((by.shape[1] + 1, PARAMETERS))
        rows[:-1, :2] = by[:2].T
        rows[:-1, 2] = radius * by[2] - 2.0 * depth * by[3]
        rows[:-1, 3] = by[3] / radius**2
        rows[:-1, 4] = 1.0
        rows[:-1, 5] = by[4]
        rows[-1, 5] = self._weight
        rows[:, 5] *= 0.5 * math.pi * math.sin(math.pi * q[5])
        return rows

    def hole(self, q: np.ndarray) -> np.ndarray:
        """(u, v, radius, depth, wall) of the fitted parameters."""
        u, v, log_radius = np.minimum(np.maximum(q[:3], self._low), self._high)
        radius = math.exp(log_radius)
        return np.array([u, v, radius, q[3] / radius**2, _wall(q[5])])


def sandwich_covariance(patch: Patch, hole: np.ndarray, offset_m: float) -> np.ndarray:
    """(6, 6) covariance of (u, v, radius, depth, offset, wall) of the least-squares fit under correlated noise, where
    the fit gave a hole (u, v, radius, depth, wall) and an offset.

    The noise is white noise through the same square filter, so its correlation is C = B B' / blur^2 with B the sum over
    blur x blur pixels, and cov = A^-1 (s^2 J' C J + p^2 W) A^-1 with A = J' J + W, W the prior's square weight on the
    wall and p^2 its variance in the same unit. The variance s^2 of one pixel comes from the misfit:
    E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)); so what the model does not describe counts as noise. NaN where the
    fit determines no variance.
    """
    h, w = patch.used.shape
    image = blurred_hole(patch, hole)
    by = derivatives(patch, hole, image)
    columns = np.stack([*by[:4], np.ones((h, w)), by[4]], axis=-1) * patch.used[..., None]
    flat = columns.reshape(-1, PARAMETERS)
    pad = patch.blur_px - 1
    padded = np.pad(columns, ((pad, pad), (pad, pad), (0, 0)))
    summed = np.dstack(
        [
            cv2.boxFilter(part, -1, (patch.blur_px,) * 2, normalize=False, borderType=cv2.BORDER_CONSTANT)
            for part in (padded[..., :3], padded[..., 3:])
        ]
    ).reshape(-1, PARAMETERS)
    prior = np.zeros((PARAMETERS, PARAMETERS))
    prior[5, 5] = _prior_weight(patch) ** 2
    try:
        bread = np.linalg.inv(flat.T @ flat + prior)
    except np.linalg.LinAlgError:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    meat = summed.T @ summed / patch.blur_px**2
    freedom = int(patch.used.sum()) - float(np.trace(bread @ meat))
    misfit = (image + offset_m - patch.residual_m)[patch.used]
    if freedom <= 0:
        return np.full((PARAMETERS, PARAMETERS), np.nan)
    variance = float(misfit @ misfit) / freedom
    return bread @ (variance * meat + (patch.noise_m * patch.blur_px) ** 2 * prior) @ bread
