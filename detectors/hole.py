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
from typing import Any

import cv2
import numba
import numpy as np
from scipy.optimize import leastsq

STRIPS = 64
"""Strips that stand for the disc: the coverage is exact in total, and in each pixel within 0.001 for a blur of 3 or 5
pixels, 0.01 for none."""
NODES, WEIGHTS = (np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5]), np.array([5.0, 8.0, 5.0]) / 18.0)
"""Gauss and Legendre's rule of three points on (0, 1), for the integral over the depth of the wall."""
FAST: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz"}}
STEP = 1e-3
"""Size of the differences that stand for derivatives: in pixels, relative for radius and depth, absolute for the wall.
"""
IMAGES, TOLERANCE = 60, 1e-4
"""Limits of a descent: the most images drawn (most fits take eight), and the relative change of the sum of squares or
of the parameters below which it ends: some hundredth of a standard error."""
WALL_PRIOR = (0.5, 12.0**-0.5)
"""Mean and standard deviation of the tube's length over the depth before the image is seen: uniform from 0 to 1."""

_THETA = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
EDGES = np.sin(_THETA)
"""Edges (s + 1,) of strips across a unit disc, narrow where the chord changes fast."""
HALF_CHORDS = np.diff(_THETA / 2 + np.sin(2 * _THETA) / 4) / np.diff(EDGES)
"""Mean half-chords (s,) of these strips."""
MIDDLES = 0.5 * (EDGES[:-1] + EDGES[1:])


# ---------------------------------------------------------------- from where a hole is seen


def crossed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product (3,) of two vectors."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _in_pixels(per_px: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return the pixels (2,), along u and v, that come nearest to a vector (n,) by steps ``per_px`` (n, 2)."""
    (uu, uv), (_, vv) = (per_px.T @ per_px).tolist()
    u, v = (per_px.T @ vector).tolist()
    determinant = uu * vv - uv * uv
    if determinant <= 1e-12 * uu * vv:
        # seen edge on, up to a millionth
        return np.asarray(np.linalg.pinv(per_px) @ vector)
    return np.array([vv * u - uv * v, uu * v - uv * u]) / determinant


@dataclass(frozen=True)
class Sight:
    """The place from where a hole is seen and lit, reduced to what moves in the image. Depths h here are along the
    normal. A map is seen from several places: the fields then stand for one of them, ``others`` for the rest, and the
    image is their mean by ``share``, in which the mouth lies still and what is below it moves.

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
    share: float = 1.0
    others: tuple[Sight, ...] = ()

    @classmethod
    def of(cls, centre_m: np.ndarray, per_px_m: np.ndarray, emitter_camera_m: np.ndarray) -> Sight:
        """Return the sight of a surface's point (3,) in the camera's frame with its derivatives by u and v (2, 3)."""
        normal = crossed(per_px_m[0], per_px_m[1])
        normal = normal / np.copysign(np.linalg.norm(normal), normal @ centre_m)
        ray, z = centre_m / centre_m[2], centre_m[2]
        slopes_per_px = ((per_px_m - np.outer(per_px_m[:, 2], ray)) / z)[:, :2].T
        drift = _in_pixels(slopes_per_px, (normal - normal[2] * ray)[:2]) / z
        distance, before = float(normal @ centre_m), float(normal @ emitter_camera_m)
        beam = _in_pixels(per_px_m.T, emitter_camera_m - centre_m * before / distance)
        return cls(float(normal @ ray), drift, float(normal[2] / z), beam, distance - before)

    @classmethod
    def straight(cls, per_px_m: np.ndarray) -> Sight:
        """Return the sight along z from everywhere at once, lit likewise: a parallel projection of unknown origin."""
        normal = crossed(per_px_m[0], per_px_m[1])
        normal = normal / np.copysign(np.linalg.norm(normal), normal[2])
        drift = _in_pixels(per_px_m[:, :2].T, normal[:2])
        return cls(float(normal[2]), drift, 0.0, np.zeros(2), 1.0)

    @cached_property
    def numbers(self) -> np.ndarray:
        """Rows (s, 8) for the compiled loops, one for each place."""
        rows = [[s.cosine, *s.drift_px, s.shrink, *s.beam_px, s.emitter_m, s.share] for s in (self, *self.others)]
        return np.array(rows)


@dataclass(frozen=True)
class HolePatch:
    """Residuals around one detection. ``residual_m`` (h, w), ``used`` (h, w) bool; pixel (0, 0) is the patch's corner.

    ``metric_m2`` (2, 2): squared length on the surface of a pixel offset (du, dv) is its quadratic form. ``noise_m``:
    standard deviation of the residual beside the hole. ``blur_px`` (along u, along v): sides of the rectangle over
    which the image is averaged: equal and whole for a camera, in cells and neither for a map.
    """

    residual_m: np.ndarray
    used: np.ndarray
    metric_m2: np.ndarray
    blur_px: tuple[float, float]
    noise_m: float
    sight: Sight

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.used.shape[0], self.used.shape[1]

    @property
    def window(self) -> tuple[int, int]:
        """Odd numbers of pixels nearest to the blur: pixels so far apart have no noise in common."""
        across, down = (2 * max(round((blur - 1) / 2), 0) + 1 for blur in self.blur_px)
        return across, down

    @property
    def prior_weight(self) -> float:
        """Misfit in metres that a deviation of the wall by 1 is worth: noise that is equal over blur x blur pixels
        counts as often in the sum of squares."""
        return self.noise_m * math.sqrt(self.blur_px[0] * self.blur_px[1]) / WALL_PRIOR[1]

    @cached_property
    def seen(self) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
        """Form of the mouth, places that it is seen from, and blur, as the compiled loops take them."""
        return _form(self.metric_m2), self.sight.numbers, self.blur_px


def _form(metric_m2: np.ndarray) -> np.ndarray:
    """Return the mouth's height and half-width in px per metre of radius, and the drift of its chords along u by v."""
    g11, g12, g22 = metric_m2[0, 0], metric_m2[0, 1], metric_m2[1, 1]
    return np.array([math.sqrt(g11 / (g11 * g22 - g12 * g12)), 1.0 / math.sqrt(g11), -g12 / g11])


# ---------------------------------------------------------------- the image


@numba.njit(cache=True, nogil=True)
def _layers(depth: float, wall: float, sights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return layers whose weighted sum is the hole: for each of the sights (s, 8) three of wall, then what is deeper.

    Weights (4 s,), and circles (4 s, 3, 3) that a ray must pass besides the mouth, as shift in u, in v, and scale. A
    negative depth is a disc before the surface: one layer without further circles.
    """
    if depth <= 0.0:
        return np.full(1, depth), np.empty((1, 0, 3))
    weights, circles = np.zeros(4 * len(sights)), np.ones((4 * len(sights), 3, 3))
    for layer in range(4 * len(sights)):
        k = layer % 4
        cosine, drift_u, drift_v, shrink, beam_u, beam_v, emitter, share = sights[layer // 4]
        deepest = depth * cosine
        length = wall * deepest
        tube = length * NODES[k] if k < 3 else length
        end = tube if k < 3 else deepest
        weights[layer] = share * (length * WEIGHTS[k] if k < 3 else deepest - length) / cosine
        scale = 1.0 / (1.0 + tube * shrink)
        u, v = tube * drift_u * scale, tube * drift_v * scale
        lit = end / (end + emitter)
        lit_below = (end - tube) / (end - tube + emitter)
        circles[layer, 0] = (u, v, scale)
        circles[layer, 1] = (-lit * beam_u, -lit * beam_v, 1.0)
        circles[layer, 2] = (u - lit_below * beam_u, v - lit_below * beam_v, scale)
    return weights, circles


@numba.njit(**FAST)
def _ends(radius: float, form: np.ndarray, circles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (layers, strips) along u, from the mouth's centre, of the part of each strip of the mouth that
    lies in all circles (n, 3) of each layer."""
    height, width, slant = form
    low, high = np.empty((len(circles), STRIPS)), np.empty((len(circles), STRIPS))
    for k in range(len(circles)):
        for s in range(STRIPS):
            low[k, s] = radius * (slant * height * MIDDLES[s] - HALF_CHORDS[s] * width)
            high[k, s] = radius * (slant * height * MIDDLES[s] + HALF_CHORDS[s] * width)
        for j in range(circles.shape[1]):
            shift_u, shift_v, scale = circles[k, j]
            if shift_u == 0.0 and shift_v == 0.0 and scale == 1.0:
                continue
            for s in range(STRIPS):
                v = radius * height * MIDDLES[s] - shift_v
                half = width * np.sqrt(max((radius * scale) ** 2 - (v / height) ** 2, 0.0))
                low[k, s] = max(low[k, s], shift_u + slant * v - half)
                high[k, s] = min(high[k, s], shift_u + slant * v + half)
    return low, high


@numba.njit(**FAST)
def _paint(
    u: float,
    v: float,
    tall: float,
    weights: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    blur: tuple[float, float],
    image: np.ndarray,
) -> None:
    """Set an image (h, w) to the layers, each a stack of strips, averaged over the rectangle around each pixel.
    ``tall``: half the mouth's height in px."""
    h, w = image.shape
    half_u, half_v = 0.5 * blur[0], 0.5 * blur[1]
    area = blur[0] * blur[1]
    across = np.empty(w)
    image[:] = 0.0
    for s in range(STRIPS):
        first, last = w, -1
        for k in range(len(weights)):
            if high[k, s] > low[k, s]:
                first = min(first, max(0, int(np.ceil(u + low[k, s] - half_u))))
                last = max(last, min(w - 1, int(np.floor(u + high[k, s] + half_u))))
        if last < first:
            continue
        across[first : last + 1] = 0.0
        for k in range(len(weights)):
            start, end, weight = u + low[k, s], u + high[k, s], weights[k]
            if end > start:
                for c in range(first, last + 1):
                    across[c] += weight * max(min(end, c + half_u) - max(start, c - half_u), 0.0)
        bottom, top = v + tall * EDGES[s], v + tall * EDGES[s + 1]
        for r in range(max(0, int(np.ceil(bottom - half_v))), min(h - 1, int(np.floor(top + half_v))) + 1):
            along = max(min(top, r + half_v) - max(bottom, r - half_v), 0.0) / area
            row = image[r]
            for c in range(first, last + 1):
                row[c] += along * across[c]


@numba.njit(**FAST)
def _picture(
    hole: np.ndarray, form: np.ndarray, sights: np.ndarray, blur: tuple[float, float], image: np.ndarray
) -> None:
    """Set ``image`` (h, w) to `blurred_hole`."""
    weights, circles = _layers(hole[3], hole[4], sights)
    low, high = _ends(hole[2], form, circles)
    _paint(hole[0], hole[1], hole[2] * form[0], weights, low, high, blur, image)


@numba.njit(**FAST)
def _differences(
    hole: np.ndarray,
    image: np.ndarray,
    form: np.ndarray,
    sights: np.ndarray,
    blur: tuple[float, float],
    by: np.ndarray,
) -> None:
    """Set ``by`` (5, h, w) to `derivatives`. A hole that only moves keeps its strips."""
    weights, circles = _layers(hole[3], hole[4], sights)
    low, high = _ends(hole[2], form, circles)
    for k in range(len(hole)):
        step = STEP
        if k == 2 or (k == 3 and hole[3] != 0.0):
            step *= hole[k]
        elif k == 3:
            step *= STEP
        elif k == 4 and hole[4] >= 0.5:
            step = -step
        moved = hole.copy()
        moved[k] += step
        if k < 2:
            _paint(moved[0], moved[1], hole[2] * form[0], weights, low, high, blur, by[k])
        else:
            _picture(moved, form, sights, blur, by[k])
        for r in range(image.shape[0]):
            for c in range(image.shape[1]):
                by[k, r, c] = (by[k, r, c] - image[r, c]) / step


def blurred_disc(
    shape: tuple[int, int], u: float, v: float, radius_m: float, metric_m2: np.ndarray, blur_px: float
) -> np.ndarray:
    """Return the covered part of the square around each pixel, (h, w) in 0..1.

    The disc is an ellipse in pixels: the set where the metric's form of the offset from (u, v) is below radius^2.
    """
    image, form, blur = np.empty(shape), _form(metric_m2), (float(blur_px), float(blur_px))
    low, high = _ends(radius_m, form, np.empty((1, 0, 3)))
    _paint(float(u), float(v), radius_m * form[0], np.ones(1), low, high, blur, image)
    return image


def blurred_hole(patch: HolePatch, hole: np.ndarray) -> np.ndarray:
    """Return the residual (h, w) of a hole (u, v, radius, depth, wall) without offset.

    Depth along the optical axis, wall in 0..1. Where the depth is negative (something before the surface) a disc.
    """
    image = np.empty(patch.shape)
    _picture(hole, *patch.seen, image)
    return image


def derivatives(patch: HolePatch, hole: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the derivatives (5, h, w) of `blurred_hole`, whose value is ``image``, by u, v, radius, depth and wall, by
    differences."""
    by = np.empty((len(hole), *patch.shape))
    _differences(hole, image, *patch.seen, by)
    return by


# ---------------------------------------------------------------- the fit


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


@numba.njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"})
def _products(
    by: np.ndarray,
    image: np.ndarray,
    data: np.ndarray,
    used: np.ndarray,
    q: np.ndarray,
    hole: np.ndarray,
    prior: np.ndarray,
) -> np.ndarray:
    """Return the products (7, 7) of the Jacobian's columns by the fitted parameters ``q``, and the misfit, over the
    used pixels (h, w). ``prior``: mean and weight of the wall's."""
    h, w = image.shape
    rows, products = np.empty((7, w)), np.zeros((7, 7))
    radius, depth = hole[2], hole[3]
    slope = 0.5 * math.pi * math.sin(math.pi * q[5])
    for r in range(h):
        for c in range(w):
            share = 1.0 if used[r, c] else 0.0
            rows[0, c] = share * by[0, r, c]
            rows[1, c] = share * by[1, r, c]
            rows[2, c] = share * (radius * by[2, r, c] - 2.0 * depth * by[3, r, c])
            rows[3, c] = share * by[3, r, c] / radius**2
            rows[4, c] = share
            rows[5, c] = share * by[4, r, c] * slope
            rows[6, c] = image[r, c] + q[4] - data[r, c] if used[r, c] else 0.0
        for a in range(7):
            for b in range(a + 1):
                total = 0.0
                for c in range(w):
                    total += rows[a, c] * rows[b, c]
                products[a, b] += total
    by_wall, apart = prior[1] * slope, prior[1] * (hole[4] - prior[0])
    products[5, 5] += by_wall * by_wall
    products[6, 5] += by_wall * apart
    products[6, 6] += apart * apart
    for a in range(7):
        for b in range(a):
            products[b, a] = products[a, b]
    return products


def fit_hole(patch: HolePatch, u: float, v: float, radius_m: float, depth_m: float, offset_m: float) -> HoleFit:
    """Fit by least squares from a start, by Levenberg's and Marquardt's way (MINPACK's), with `sandwich_covariance`.

    Fitted are (u, v, ln radius, depth * radius^2, offset, x) with the wall sin^2(pi x / 2). The fourth is the hole's
    volume, which the blur keeps, so that a hole smaller than the blur still has one well-determined direction for each
    parameter but its radius; x may run free where the wall must stay in 0..1. The wall has `WALL_PRIOR` for one more
    observation: a small hole, or one seen straight on, does not determine it.
    """
    start = np.array([u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    h, w = patch.shape
    # keeps a wild trial step finite: no disc is larger than ten patches
    low = np.array([-10.0 * w, -10.0 * h, -20.0])
    high = np.array([10.0 * w, 10.0 * h, math.log(10.0 * (h + w) * math.sqrt(patch.metric_m2.max()))])
    prior, data = np.array([WALL_PRIOR[0], patch.prior_weight]), np.ascontiguousarray(patch.residual_m)
    used, at, root = np.ascontiguousarray(patch.used), np.full(6, np.nan), np.empty((7, 7))
    image, by = np.empty(patch.shape), np.empty((5, *patch.shape))

    def hole_of(q: np.ndarray) -> np.ndarray:
        u, v, log_radius = np.clip(q[:3], low, high).tolist()
        radius = math.exp(log_radius)
        return np.array([u, v, radius, q[3] / radius**2, math.sin(0.5 * math.pi * q[5]) ** 2])

    def root_at(q: np.ndarray) -> np.ndarray:
        """Return (7, 7) whose columns, the Jacobian's six and the misfit, have the products of the full ones: MINPACK
        needs no more, and a factor of 7 rows takes no time."""
        if not np.array_equal(q, at):
            at[:] = q
            hole = hole_of(q)
            _picture(hole, *patch.seen, image)
            _differences(hole, image, *patch.seen, by)
            products = _products(by, image, data, used, q, hole, prior)
            size = np.sqrt(np.diagonal(products))
            size[size == 0.0] = 1.0
            values, vectors = np.linalg.eigh(products / np.outer(size, size))
            root[:] = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * size
        return root

    q, _, _, _, outcome = leastsq(
        lambda q: root_at(q)[:, 6].copy(),
        start,
        Dfun=lambda q: root_at(q)[:, :6].copy(),
        full_output=True,
        ftol=TOLERANCE,
        xtol=TOLERANCE,
        gtol=1e-9,
        maxfev=IMAGES,
    )
    hole, offset = hole_of(q), float(q[4])
    covariance = sandwich_covariance(patch, hole, offset)
    u, v, radius, depth, wall = hole.tolist()
    return HoleFit(u, v, radius, depth, offset, wall, covariance, outcome in (1, 2, 3, 4))


def sandwich_covariance(patch: HolePatch, hole: np.ndarray, offset_m: float) -> np.ndarray:
    """Return the covariance (6, 6) of (u, v, radius, depth, offset, wall) of the least-squares fit under correlated
    noise, where the fit gave a hole (u, v, radius, depth, wall) and an offset.

    The noise is white noise through the same square filter, so its correlation is C = B B' / blur^2 with B the sum over
    blur x blur pixels, and cov = A^-1 (s^2 J' C J + p^2 W) A^-1 with A = J' J + W, W the prior's square weight on the
    wall and p^2 its variance in the same unit. The variance s^2 of one pixel comes from the misfit:
    E[misfit' misfit] = s^2 (n - trace(A^-1 J' C J)); so what the model does not describe counts as noise. NaN where the
    fit determines no variance.
    """
    unknown = np.full((6, 6), np.nan)
    image = blurred_hole(patch, hole)
    by = derivatives(patch, hole, image)
    columns = np.stack([*by[:4], np.ones(patch.shape), by[4]]) * patch.used
    flat = columns.reshape(6, -1)
    across, down = patch.window
    prior = np.zeros((6, 6))
    prior[5, 5] = patch.prior_weight**2
    try:
        bread = np.linalg.inv(flat @ flat.T + prior)
    except np.linalg.LinAlgError:
        return unknown
    meat = correlated_products(columns, across, down) / (across * down)
    freedom = int(patch.used.sum()) - float(np.trace(bread @ meat))
    if freedom <= 0:
        return unknown
    misfit = (image + offset_m - patch.residual_m)[patch.used]
    variance = float(misfit @ misfit) / freedom
    prior_variance = patch.noise_m**2 * patch.blur_px[0] * patch.blur_px[1]
    return bread @ (variance * meat + prior_variance * prior) @ bread


def correlated_products(columns: np.ndarray, across: int, down: int) -> np.ndarray:
    """Return S' S (p, p) with S the columns (p, h, w), zero outside, summed over a window of ``down`` x ``across``
    pixels around every place that it reaches."""
    padded = np.pad(np.moveaxis(columns, 0, -1), ((down - 1, down - 1), (across - 1, across - 1), (0, 0)))
    summed = cv2.boxFilter(padded, -1, (across, down), normalize=False, borderType=cv2.BORDER_CONSTANT)
    flat = summed.reshape(-1, len(columns))
    return np.asarray(flat.T @ flat)
