"""Compiled passes of the automatic crop: where neighbours lie on one surface, where it bends, and its connected
parts."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from detectors.disjoint_sets import root_of

PLAIN: dict[str, Any] = {"cache": True, "nogil": True}


@numba.njit(**PLAIN)
def _is_step(
    points_m: np.ndarray, a: tuple[int, int], b: tuple[int, int], tilt: float, noise_m: float, central: bool
) -> bool:
    """Whether z changes between two pixels by more than a surface of that tilt and noise explain, or is missing.

    ``central``: the way across is measured between the two rays at the nearer depth, so that a step in depth, which
    off the axis moves x and y too, does not pass for a way across.
    """
    za, zb = points_m[a[0], a[1], 2], points_m[b[0], b[1], 2]
    xa, ya, xb, yb = points_m[a[0], a[1], 0], points_m[a[0], a[1], 1], points_m[b[0], b[1], 0], points_m[b[0], b[1], 1]
    if central:
        nearer = min(za, zb)
        dx, dy = nearer * (xb / zb - xa / za), nearer * (yb / zb - ya / za)
    else:
        dx, dy = xb - xa, yb - ya
    return not abs(zb - za) <= tilt * np.sqrt(dx * dx + dy * dy) + noise_m


@numba.njit(**PLAIN)
def links(points_m: np.ndarray, tilt: float, noise_m: float, central: bool) -> tuple[np.ndarray, np.ndarray]:
    """Whether each of pixels (h, w, 3) lies on one surface with its right (h, w) and its lower neighbour (h, w)."""
    h, w = points_m.shape[:2]
    right, down = np.zeros((h, w), dtype=np.bool_), np.zeros((h, w), dtype=np.bool_)
    for r in range(h):
        for c in range(w):
            if c + 1 < w:
                right[r, c] = not _is_step(points_m, (r, c), (r, c + 1), tilt, noise_m, central)
            if r + 1 < h:
                down[r, c] = not _is_step(points_m, (r, c), (r + 1, c), tilt, noise_m, central)
    return right, down


@numba.njit(**PLAIN)
def components(nodes: np.ndarray, right: np.ndarray, down: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray]:
    """Sets of nodes (h, w) that are joined by links to the right and downwards (both (h, w)): (h, w) the number of
    each pixel's set, 0 for none and for sets of fewer than ``least`` pixels; and their sizes, largest first, of equal
    ones the first in the order of the pixels. Set number i has the size ``sizes[i - 1]``."""
    h, w = nodes.shape
    parents = np.arange(h * w)
    for r in range(h):
        for c in range(w):
            if not nodes[r, c]:
                continue
            if c > 0 and nodes[r, c - 1] and right[r, c - 1]:
                ours, theirs = root_of(parents, r * w + c), root_of(parents, r * w + c - 1)
                parents[max(ours, theirs)] = min(ours, theirs)
            if r > 0 and nodes[r - 1, c] and down[r - 1, c]:
                ours, theirs = root_of(parents, r * w + c), root_of(parents, (r - 1) * w + c)
                parents[max(ours, theirs)] = min(ours, theirs)
    counts = np.zeros(h * w, dtype=np.int64)
    for i in range(h * w):
        # a parent comes before its children: one step leads to the root
        parents[i] = parents[parents[i]]
        if nodes[i // w, i % w]:
            counts[parents[i]] += 1
    roots = np.flatnonzero(counts >= max(least, 1))
    roots = roots[np.argsort(-counts[roots], kind="mergesort")]
    number = np.zeros(h * w, dtype=np.int32)
    for i in range(len(roots)):
        number[roots[i]] = i + 1
    numbers = np.zeros((h, w), dtype=np.int32)
    for i in range(h * w):
        if nodes[i // w, i % w]:
            numbers[i // w, i % w] = number[parents[i]]
    return numbers, counts[roots]


@numba.njit(**PLAIN)
def unit_normals(surface_m: np.ndarray) -> np.ndarray:
    """(h, w, 3) of a surface given by its points (h, w, 3), by central differences; 0 where it has no area."""
    h, w = surface_m.shape[:2]
    normals = np.empty((h, w, 3))
    for r in range(h):
        up, low = max(r - 1, 0), min(r + 1, h - 1)
        for c in range(w):
            left, far = max(c - 1, 0), min(c + 1, w - 1)
            ux = (surface_m[r, far, 0] - surface_m[r, left, 0]) / max(far - left, 1)
            uy = (surface_m[r, far, 1] - surface_m[r, left, 1]) / max(far - left, 1)
            uz = (surface_m[r, far, 2] - surface_m[r, left, 2]) / max(far - left, 1)
            vx = (surface_m[low, c, 0] - surface_m[up, c, 0]) / max(low - up, 1)
            vy = (surface_m[low, c, 1] - surface_m[up, c, 1]) / max(low - up, 1)
            vz = (surface_m[low, c, 2] - surface_m[up, c, 2]) / max(low - up, 1)
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            length = max(np.sqrt(x * x + y * y + z * z), 1e-15)
            normals[r, c, 0], normals[r, c, 1], normals[r, c, 2] = x / length, y / length, z / length
    return normals


@numba.njit(**PLAIN)
def turns(normals: np.ndarray, half: int, least_cosine: float) -> np.ndarray:
    """(h, w) bool: unit normals ``half`` pixels to the left and right, or above and below, enclose a wider angle."""
    h, w = normals.shape[:2]
    turned = np.zeros((h, w), dtype=np.bool_)
    for r in range(h):
        for c in range(w):
            if half <= c < w - half:
                cosine = 0.0
                for k in range(3):
                    cosine += normals[r, c + half, k] * normals[r, c - half, k]
                turned[r, c] = cosine < least_cosine
            if half <= r < h - half:
                cosine = 0.0
                for k in range(3):
                    cosine += normals[r + half, c, k] * normals[r - half, c, k]
                turned[r, c] |= cosine < least_cosine
    return turned
