"""The model of a blurred hole, and its fit to the residuals around one detection.

A round tube that starts with the surface's mouth, and behind it a floor of one depth, seen and lit obliquely, averaged
over ``blur_px`` x ``blur_px`` pixels. Light that has come as deep as t has passed the mouth and the circle at depth t
on its way in and out; in the image each is an ellipse, shifted by parallax. The tube's length is fitted too.

Not modelled: light between wall and floor, which makes a wall look deeper than it is; walls darker than the floor; a
floor that is not flat; the loss of weight of deep neighbours in a bilateral filter (holes of 2 to 3 times the blur come
out up to 16 % too deep at 33 mm).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import scipy.linalg

from detectors.clusters import PLAIN
from detectors.whitening import correlated_products, noise_factor

STRIPS = 64
"""Strips that stand for the disc: the coverage is exact in total, and in each pixel within 0.001 for a blur of 3."""
NODES, WEIGHTS = np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5, 1.0]), np.array([5.0, 8.0, 5.0, 0.0]) / 18.0
"""Gauss and Legendre's rule of three points on (0, 1), for the integral over the depth of the wall; and its end."""
STEP = 1e-3
"""Size of differences that stand for derivatives: in pixels, relative for radius and depth, absolute for the wall."""
MOST_STEPS, TOLERANCE = 40, 1e-5  # limits of a descent: its steps, and the relative gain below which it ends
DAMPING, LEAST_M, SMALLEST = 1e-3, 1e-9, 1e-18
"""Damping of the first step; deviation that is rounding of the arithmetic, and its square."""
MODEL_ERROR, RADIUS_ERROR_PX, DEPTH_ERROR = 0.02, 0.05, 0.05
"""Errors by light between wall and floor on simulated clouds: shares of a pixel's depth, and of the fitted sizes."""
MOST_MISFIT = 1.5
"""Deviation of what the fit leaves beyond which the model fails: .3 to 1.05 on its own optics, 1.1 to 3 on others."""
WALL_PRIOR = (0.5, 12.0**-0.5)
"""Mean and standard deviation of the tube's length over the depth before the image is seen: uniform from 0 to 1."""

_THETA = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
EDGES = np.sin(_THETA)  # edges (s + 1,) of strips across a unit disc, narrow where the chord changes fast
HALF_CHORDS = np.diff(_THETA / 2 + np.sin(2 * _THETA) / 4) / np.diff(EDGES)  # mean half-chords (s,) of these strips
MIDDLES = 0.5 * (EDGES[:-1] + EDGES[1:])


def normal_of(per_px_m: np.ndarray) -> np.ndarray:
    """Return the vector product (3,) of a surface's derivatives by u and v (2, 3)."""
    (ax, ay, az), (bx, by, bz) = per_px_m.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def sight(centre_m: np.ndarray, per_px_m: np.ndarray, emitter_m: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Return the place (8,) from where a hole is seen and lit, reduced to what moves in the image: the cosine between
    ray and normal, times the ray's length per z; the drift along u and v; the shrinking; the beam along u and v; the
    emitter's height; the share of the image that is seen from here. ``centre_m`` (3,) camera frame, ``per_px_m`` (2,
    3).

    A circle at depth h along the normal looks like the same circle on the surface, moved by h * drift / (1 + h *
    shrinking), and smaller by that divisor. Light from depth h came in at beam * h / (h + height) from it.
    """
    normal = normal_of(per_px_m)
    normal = normal / np.copysign(np.linalg.norm(normal), normal @ centre_m)
    ray, z = centre_m / centre_m[2], centre_m[2]
    slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
    drift = np.linalg.solve(slopes_per_px, (normal - normal[2] * ray)[:2]) / z
    distance, before = normal @ centre_m, normal @ emitter_m
    # the offset in the surface's plane by least squares
    beam = np.linalg.solve(per_px_m @ per_px_m.T, per_px_m @ (emitter_m - centre_m * before / distance))
    return np.array([normal @ ray, *drift, normal[2] / z, *beam, distance - before, share])


def straight_sight(per_px_m: np.ndarray) -> np.ndarray:
    """Return the sight along z for a parallel projection of unknown origin, with light along the same direction."""
    normal = normal_of(per_px_m)
    normal = normal / np.copysign(np.linalg.norm(normal), normal[2])
    drift = np.linalg.solve(per_px_m[:, :2].T, normal[:2])
    return np.array([normal[2], *drift, 0.0, 0.0, 0.0, 1.0, 1.0])


@dataclass(frozen=True)
class HolePatch:
    """Residuals around one detection. ``metric_m2`` (2, 2): squared length of a pixel offset (du, dv) is its quadratic
    form. ``noise_m``: deviation beside the hole. ``blur_px`` (along u, along v): sides of the rectangle over which the
    image is averaged. ``sights`` (s, 8). ``correlation`` (odd, odd): of the noise by lag, where it is known."""

    residual_m: np.ndarray
    used: np.ndarray
    metric_m2: np.ndarray
    blur_px: tuple[float, float]
    noise_m: float
    sights: np.ndarray
    correlation: np.ndarray | None = None

    @property
    def prior_weight(self) -> float:
        """Misfit in metres that a deviation of the wall by 1 is worth."""
        return self.noise_m * math.sqrt(self.blur_px[0] * self.blur_px[1]) / WALL_PRIOR[1]


def pictures(patch: HolePatch, holes: np.ndarray) -> np.ndarray:
    """Return the residuals (m, h, w) of holes (m, 5), each (u, v, radius, depth, wall), without offset: depth along the
    optical axis, wall in 0..1; a disc where the depth is negative. The mouth is cut into strips along u, and each hole
    into layers: of each sight three of wall, and what is deeper."""
    return _painted(holes, patch.sights, patch.metric_m2, *patch.blur_px, *patch.used.shape)


@numba.njit(**PLAIN)
def _painted(
    holes: np.ndarray, sights: np.ndarray, metric: np.ndarray, blur_u: float, blur_v: float, h: int, w: int
) -> np.ndarray:
    g11, g12, g22 = metric[0, 0], metric[0, 1], metric[1, 1]
    # the mouth's height and half-width in px per metre of radius, and the drift of its chords along u by v
    height, width, slant = math.sqrt(g11 / (g11 * g22 - g12 * g12)), 1.0 / math.sqrt(g11), -g12 / g11
    half_u, half_v = 0.5 * blur_u, 0.5 * blur_v
    images, across = np.zeros((len(holes), h, w)), np.zeros(w)
    # of each layer its weight, and three circles that its light has passed: shift along u and v, and scale
    layers, weights = np.empty((len(sights) * len(NODES), 3, 3)), np.empty(len(sights) * len(NODES))
    for n in range(len(holes)):
        u, v, radius, depth, wall = holes[n]
        for k in range(len(weights)):
            cosine, drift_u, drift_v, shrink, beam_u, beam_v, emitter, share = sights[k // len(NODES)]
            node = k % len(NODES)
            deepest = depth * cosine
            length = wall * deepest if depth > 0 else 0.0
            tube, is_wall = length * NODES[node], NODES[node] < 1.0
            end = tube if is_wall else max(deepest, 0.0)
            weights[k] = share / cosine * (length * WEIGHTS[node] if is_wall else deepest - length)
            scale, lit = 1.0 / (1.0 + tube * shrink), end / (end + emitter)
            below = (end - tube) / (end - tube + emitter)
            shift_u, shift_v = tube * drift_u * scale, tube * drift_v * scale
            layers[k, 0] = shift_u, shift_v, scale
            layers[k, 1] = -lit * beam_u, -lit * beam_v, 1.0
            layers[k, 2] = shift_u - below * beam_u, shift_v - below * beam_v, scale
        for s in range(STRIPS):
            first, last = w, -1
            bottom, top = v + radius * height * EDGES[s], v + radius * height * EDGES[s + 1]
            down = radius * height * MIDDLES[s]
            for k in range(len(weights)):
                reach = radius * HALF_CHORDS[s] * width
                start, end = slant * down - reach, slant * down + reach
                for shift_u, shift_v, scale in layers[k]:
                    middle = shift_u + slant * (down - shift_v)
                    half = width * math.sqrt(max((radius * scale) ** 2 - ((down - shift_v) / height) ** 2, 0.0))
                    start, end = max(start, middle - half), min(end, middle + half)
                start, end = u + start, u + end
                if end > start:
                    left, right = max(0, math.ceil(start - half_u)), min(w - 1, math.floor(end + half_u))
                    first, last = min(first, left), max(last, right)
                    for c in range(left, right + 1):
                        across[c] += weights[k] * max(min(end, c + half_u) - max(start, c - half_u), 0.0)
            for r in range(max(0, math.ceil(bottom - half_v)), min(h - 1, math.floor(top + half_v)) + 1):
                along = max(min(top, r + half_v) - max(bottom, r - half_v), 0.0) / (4.0 * half_u * half_v)
                for c in range(first, last + 1):
                    images[n, r, c] += along * across[c]
            across[first : last + 1] = 0.0
    return images


@dataclass(frozen=True)
class HoleFit:
    """``u_px``, ``v_px`` in the patch; ``covariance`` (6, 6) of (u, v, radius, depth, offset, wall), px and metres.
    ``misfit``: deviation of what is left in units of the noise and the model's own error; 0 where neither is known."""

    u_px: float
    v_px: float
    radius_m: float
    depth_m: float
    offset_m: float
    wall: float
    covariance: np.ndarray
    converged: bool
    misfit: float


def fit_hole(patch: HolePatch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float) -> HoleFit:
    """Fit by least squares (Levenberg and Marquardt) from a start, to six used pixels and more: the likelihood's
    maximum where the patch knows the noise's covariance, else with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2), which has `WALL_PRIOR`. The
    fourth is the hole's volume, which the blur keeps, so that of a small hole only the radius is ill determined.
    """
    used, data, error_m = patch.used, patch.residual_m[patch.used], MODEL_ERROR * np.abs(patch.residual_m - offset_m)
    factor = noise_factor(used, patch.correlation, max(patch.noise_m, LEAST_M), error_m)
    weight = patch.prior_weight if factor is None else 1.0 / WALL_PRIOR[1]
    start = np.array([u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    hole, offset, by, left, converged = _descent(patch, data, factor, weight, start)
    u, v, radius, depth, wall = hole.tolist()
    square = float(left @ left)
    if factor is None:
        return HoleFit(u, v, radius, depth, offset, wall, sandwich_covariance(patch, by, square), converged, 0.0)
    # the information's inverse times the variance of what is left, and the model's own errors
    variance, information = square / max(len(data) - 6, 1), by @ by.T
    information[5, 5] += WALL_PRIOR[1] ** -2
    covariance = np.linalg.pinv(information, hermitian=True) * variance
    covariance[2, 2] += RADIUS_ERROR_PX**2 * float(np.trace(patch.metric_m2)) / 2.0
    covariance[3, 3] += (DEPTH_ERROR * depth) ** 2
    return HoleFit(u, v, radius, depth, offset, wall, covariance, converged, math.sqrt(variance))


def _descent(
    patch: HolePatch, data: np.ndarray, factor: np.ndarray | None, weight: float, q: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray, np.ndarray, bool]:
    """Return the best hole (5,), its offset, derivatives (6, n) of the used pixels by (u, v, radius, depth, offset,
    wall), what is left of the ``data`` (n,), both whitened by the noise's ``factor`` (n, n) where there is any, and
    whether the descent from ``q`` (6,) has converged. ``weight``: of the prior."""
    h, w = patch.used.shape
    # keeps a wild trial step finite: no disc is larger than ten patches
    low = -10.0 * w, -10.0 * h, -20.0
    high = 10.0 * w, 10.0 * h, math.log(10.0 * (h + w) * math.sqrt(patch.metric_m2.max()))
    places = np.flatnonzero(patch.used)

    def seen(holes: np.ndarray) -> np.ndarray:
        return pictures(patch, holes).reshape(len(holes), -1).take(places, axis=1)

    def left_by(q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Return the hole (5,), its picture (n,), what it leaves of the data (n,), whitened, and of the prior."""
        u, v, log_radius = (min(max(at, least), most) for at, least, most in zip(q.tolist(), low, high, strict=False))
        radius = math.exp(log_radius)
        hole = np.array([u, v, radius, q[3] / radius**2, math.sin(0.5 * math.pi * q[5]) ** 2])
        (image,) = seen(hole[None])
        return hole, image, _whitened(factor, image + (q[4] - data)), weight * (hole[4] - WALL_PRIOR[0])

    def slopes_of(hole: np.ndarray, image: np.ndarray) -> np.ndarray:
        depth = hole[3] if hole[3] != 0.0 else STEP
        steps = STEP * np.array([1.0, 1.0, hole[2], depth, -1.0 if hole[4] >= 0.5 else 1.0])
        slopes = np.ones((6, len(data)))  # the offset, the fifth, moves all pixels alike
        slopes[[0, 1, 2, 3, 5]] = (seen(hole + np.diag(steps)) - image) / steps[:, None]
        return _whitened(factor, slopes)

    hole, image, left, prior = left_by(q)
    square, damping, by, converged = left @ left + prior**2, DAMPING, slopes_of(hole, image), False
    for _ in range(MOST_STEPS):
        # derivatives by q from those by the hole's numbers
        chain = np.eye(6)
        chain[2, 2], chain[3, 2], chain[3, 3] = hole[2], -2.0 * hole[3], hole[2] ** -2
        chain[5, 5] = 0.5 * math.pi * math.sin(math.pi * q[5])
        information, pull = chain.T @ (by @ by.T) @ chain, chain.T @ (by @ left)
        information[5, 5] += (weight * chain[5, 5]) ** 2
        pull[5] += weight * chain[5, 5] * prior
        information.flat[::7] = np.maximum(information.diagonal() * (1.0 + damping), SMALLEST)
        step = np.linalg.solve(information, -pull)
        new_hole, image, new_left, new_prior = left_by(q + step)
        new_square, enough = new_left @ new_left + new_prior**2, TOLERANCE * square + SMALLEST
        converged = bool(-(step @ pull) < enough or 0.0 <= square - new_square < enough)
        if new_square < square:
            q, hole, left, prior, square = q + step, new_hole, new_left, new_prior, new_square
            by = slopes_of(hole, image)
            damping *= 0.1
        else:
            damping *= 10.0
        if converged:
            break
    return hole, float(q[4]), by, left, converged


def _whitened(factor: np.ndarray | None, rows: np.ndarray) -> np.ndarray:
    """Return the inverse of a lower factor (n, n) times each of the rows (n,) or (k, n); the rows without a factor."""
    if factor is None:
        return rows
    return np.asarray(scipy.linalg.solve_triangular(factor, rows.T, lower=True, check_finite=False).T)


def sandwich_covariance(patch: HolePatch, by: np.ndarray, square_m2: float) -> np.ndarray:
    """Return the covariance (6, 6) of (u, v, radius, depth, offset, wall) from derivatives (6, n) by them and the sum
    of squares that is left, under noise that the square filter correlates, or NaN: A^-1 (s^2 J' C J + p^2 W) A^-1 with
    A = J' J + W, W the prior's square weight on the wall, p^2 its variance; E[misfit' misfit] = s^2 (n - trace(A^-1 J'
    C J))."""
    columns = np.zeros((6, *patch.used.shape))
    columns[:, patch.used] = by
    # the odd numbers of pixels nearest to the blur: pixels so far apart have no noise in common
    across, down = (2 * max(round((blur - 1) / 2), 0) + 1 for blur in patch.blur_px)
    prior = np.zeros((6, 6))
    prior[5, 5] = patch.prior_weight**2
    try:
        bread = np.linalg.inv(by @ by.T + prior)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    meat = correlated_products(columns, across, down) / (across * down)
    freedom = by.shape[1] - float(np.trace(bread @ meat))
    if freedom <= 0:
        return np.full((6, 6), np.nan)
    prior_variance = patch.noise_m**2 * patch.blur_px[0] * patch.blur_px[1]
    return np.asarray(bread @ (square_m2 / freedom * meat + prior_variance * prior) @ bread)
