"""The image of a drilled hole through a camera that averages over a square of pixels: where it is seen from, its
layers, and the sum of their blurred overlaps. The model itself is described in `detectors.hole_model`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np

STRIPS = 64
"""Strips that stand for the disc: the coverage is exact in total, and in each pixel within 0.001 for a blur of 3 or 5
pixels, 0.01 for none."""
NODES, WEIGHTS = (np.array([0.5 - 0.15**0.5, 0.5, 0.5 + 0.15**0.5]), np.array([5.0, 8.0, 5.0]) / 18.0)
"""Gauss and Legendre's rule of three points on (0, 1), for the integral over the depth of the wall."""
FAST: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "nsz"}}
STEP = 1e-3
"""Of the differences that stand for derivatives: in pixels, relative for radius and depth, absolute for the wall."""


def crossed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3,) the cross product of two vectors."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _in_pixels(per_px: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """(2,) the pixels, along u and v, that come nearest to a vector (n,) by steps ``per_px`` (n, 2)."""
    (uu, uv), (_, vv) = (per_px.T @ per_px).tolist()
    u, v = (per_px.T @ vector).tolist()
    determinant = uu * vv - uv * uv
    if determinant <= 1e-12 * uu * vv:
        # seen edge on, up to a millionth
        return np.asarray(np.linalg.pinv(per_px) @ vector)
    return np.array([vv * u - uv * v, uu * v - uv * u]) / determinant


@dataclass(frozen=True)
class Sight:
    """From where a hole is seen and lit, reduced to what moves in the image. Depths h here are along the normal.
    A map is seen from several places: the fields then stand for one of them, ``others`` for the rest, and the image is
    their mean by ``share``, in which the mouth lies still and what is below it moves.

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
        """At a surface's point (3,) in the camera's frame with its derivatives by u and v (2, 3)."""
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
        """Along z from everywhere at once, and lit likewise: a parallel projection whose makers are not known."""
        normal = crossed(per_px_m[0], per_px_m[1])
        normal = normal / np.copysign(np.linalg.norm(normal), normal[2])
        drift = _in_pixels(per_px_m[:, :2].T, normal[:2])
        return cls(float(normal[2]), drift, 0.0, np.zeros(2), 1.0)

    @cached_property
    def numbers(self) -> np.ndarray:
        """(s, 8) for the compiled loops, one row for each place."""
        rows = [[s.cosine, *s.drift_px, s.shrink, *s.beam_px, s.emitter_m, s.share] for s in (self, *self.others)]
        return np.array(rows)


@dataclass(frozen=True)
class Patch:
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
        """(height, width)."""
        return self.used.shape[0], self.used.shape[1]

    @property
    def window(self) -> tuple[int, int]:
        """The odd numbers of pixels nearest to the blur: pixels so far apart have no noise in common."""
        across, down = (2 * max(round((blur - 1) / 2), 0) + 1 for blur in self.blur_px)
        return across, down

    @property
    def blur_area_px(self) -> float:
        """Of the rectangle."""
        return self.blur_px[0] * self.blur_px[1]

    @cached_property
    def form(self) -> np.ndarray:
        """Of the metric, as `_chord` takes it."""
        return _form(self.metric_m2)


def _unit_strips() -> tuple[np.ndarray, np.ndarray]:
    """Edges (s + 1,) and mean half-chords (s,) of strips across a unit disc, narrow where the chord changes fast."""
    theta = np.linspace(-np.pi / 2, np.pi / 2, STRIPS + 1)
    edges = np.sin(theta)
    areas = np.diff(theta / 2 + np.sin(2 * theta) / 4)
    return edges, areas / np.diff(edges)


EDGES, HALF_CHORDS = _unit_strips()
MIDDLES = 0.5 * (EDGES[:-1] + EDGES[1:])


@numba.njit(cache=True, nogil=True)
def _layers(depth: float, wall: float, sights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Layers whose weighted sum is the hole: for each of the sights (s, 8) three of wall, then what is deeper.

    Weights (4 s,), and circles (4 s, 3, 3) that a ray must pass besides the mouth, as shift in u, in v, and scale.
    """
    weights, circles = np.zeros((len(sights), 4)), np.ones((len(sights), 4, 3, 3))
    for s in range(len(sights)):
        _fill_layers(depth, wall, sights[s], weights[s], circles[s])
    return weights.reshape(-1), circles.reshape(-1, 3, 3)


@numba.njit(cache=True, nogil=True)
def _fill_layers(depth: float, wall: float, sight: np.ndarray, weights: np.ndarray, circles: np.ndarray) -> None:
    cosine, drift_u, drift_v, shrink, beam_u, beam_v, emitter, share = sight
    deepest = depth * cosine
    length = wall * deepest
    for k in range(4):
        tube = length * NODES[k] if k < 3 else length
        end = tube if k < 3 else deepest
        weights[k] = share * (length * WEIGHTS[k] if k < 3 else deepest - length) / cosine
        scale = 1.0 / (1.0 + tube * shrink)
        u, v = tube * drift_u * scale, tube * drift_v * scale
        lit = end / (end + emitter)
        lit_below = (end - tube) / (end - tube + emitter)
        circles[k, 0] = (u, v, scale)
        circles[k, 1] = (-lit * beam_u, -lit * beam_v, 1.0)
        circles[k, 2] = (u - lit_below * beam_u, v - lit_below * beam_v, scale)


@numba.njit(**FAST)
def _ends(radius: float, form: np.ndarray, circles: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    """Set ``low`` and ``high`` (layers, strips): ends along u, from the mouth's centre, of the part of each strip
    of the mouth that lies in all circles (n, 3) of each layer.

    ``form``: the ellipse's height and half-width in px per metre of radius, and the drift of its chords along u by v.
    """
    height, width, slant = form
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


def blurred_disc(
    shape: tuple[int, int], u: float, v: float, radius_m: float, metric_m2: np.ndarray, blur_px: float
) -> np.ndarray:
    """Covered part of the square around each pixel, (h, w) in 0..1.

    The disc is an ellipse in pixels: the set where the metric's form of the offset from (u, v) is below radius^2.
    """
    image = np.empty(shape)
    disc = np.array([u, v, radius_m])
    blur = (float(blur_px), float(blur_px))
    _picture(disc, _form(metric_m2), np.ones(1), np.empty((1, 0, 3)), blur, image)
    return image


def blurred_hole(patch: Patch, hole: np.ndarray) -> np.ndarray:
    """The residual (h, w) of a hole (u, v, radius, depth, wall) without offset.

    Depth along the optical axis, wall in 0..1. Where the depth is negative (something before the surface) a disc.
    """
    image = np.empty(patch.shape)
    picture(hole, patch.form, patch.sight.numbers, patch.blur_px, image)
    return image


def derivatives(patch: Patch, hole: np.ndarray, image: np.ndarray) -> np.ndarray:
    """(5, h, w): of `blurred_hole`, whose value is ``image``, by u, v, radius, depth and wall, by differences."""
    by = np.empty((len(hole), *patch.shape))
    differences(hole, image, patch.form, patch.sight.numbers, patch.blur_px, by)
    return by


@numba.njit(**FAST)
def picture(
    hole: np.ndarray, form: np.ndarray, sights: np.ndarray, blur: tuple[float, float], image: np.ndarray
) -> None:
    """Set ``image`` (h, w) to `blurred_hole`."""
    weights, circles = _hole_layers(hole, sights)
    _picture(hole, form, weights, circles, blur, image)


@numba.njit(**FAST)
def differences(
    hole: np.ndarray,
    image: np.ndarray,
    form: np.ndarray,
    sights: np.ndarray,
    blur: tuple[float, float],
    by: np.ndarray,
) -> None:
    """Set ``by`` (5, h, w) to `derivatives`. A hole that only moves keeps its strips."""
    weights, circles = _hole_layers(hole, sights)
    low, high = np.empty((len(weights), STRIPS)), np.empty((len(weights), STRIPS))
    _ends(hole[2], form, circles, low, high)
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
            picture(moved, form, sights, blur, by[k])
        for r in range(image.shape[0]):
            for c in range(image.shape[1]):
                by[k, r, c] = (by[k, r, c] - image[r, c]) / step


@numba.njit(**FAST)
def _hole_layers(hole: np.ndarray, sights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if hole[3] > 0.0:
        return _layers(hole[3], hole[4], sights)
    return np.full(1, hole[3]), np.empty((1, 0, 3))


@numba.njit(**FAST)
def _picture(
    hole: np.ndarray,
    form: np.ndarray,
    weights: np.ndarray,
    circles: np.ndarray,
    blur: tuple[float, float],
    image: np.ndarray,
) -> None:
    low, high = np.empty((len(weights), STRIPS)), np.empty((len(weights), STRIPS))
    _ends(hole[2], form, circles, low, high)
    _paint(hole[0], hole[1], hole[2] * form[0], weights, low, high, blur, image)


def _form(metric_m2: np.ndarray) -> np.ndarray:
    g11, g12, g22 = metric_m2[0, 0], metric_m2[0, 1], metric_m2[1, 1]
    return np.array([math.sqrt(g11 / (g11 * g22 - g12 * g12)), 1.0 / math.sqrt(g11), -g12 / g11])
