"""Planes in a depth image: fitting one robustly, finding several.

A plane z = d + sx x + sy y is exactly linear in 1/z over the rays' slopes: 1/z = (1 - sx X - sy Y) / d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from harness.vocabulary.seeds import random_stream
from scenes.closed_form import Plane

BISQUARE = 4.685
"""Tukey's constant: 95 % efficient on normal errors."""
CANDIDATES = 400
"""Planes tried in each round: triples of near points, of which half hit a plane that covers half of the image."""
TRIPLE_PX = 40
"""Distance of a triple's points: near enough to lie on one surface, far enough to tell its slope."""
SCREENED = 4000
"""Pixels on which a candidate is judged; the best is then fitted to all."""
GROWN = 2.0


@dataclass(frozen=True)
class FoundPlane:
    """A plane and the connected pixels that lie on it: ``mask`` (h, w)."""

    plane: Plane
    mask: np.ndarray


def robust_inverse_fit(basis: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients c with 1/z = basis c, and which points count, by Tukey's bisquare on the residuals of z.

    ``basis`` (n, k) is well conditioned: normal equations are then exact enough, and a tenth of the time.
    """
    weight = np.ones_like(z)
    for _ in range(15):
        # an error of z is z^2 times one of 1/z
        row = weight * z**4
        coefficients = np.linalg.lstsq(basis.T @ (basis * row[:, None]), basis.T @ (row / z), rcond=None)[0]
        residual = z - 1 / (basis @ coefficients)
        # on exact data the median is 0: a micrometre counts as exact
        u = residual / (BISQUARE * max(1.4826 * float(np.median(np.abs(residual))), 1e-6))
        weight = np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0.0)
    return coefficients, weight > 0


def fit_plane(z_m: np.ndarray, slopes: np.ndarray) -> Plane:
    """The plane through points of z (n,) on rays with ``slopes`` (n, 2), robust against a minority of others."""
    (a, b, c), _ = robust_inverse_fit(np.column_stack([np.ones(z_m.size), slopes]), z_m)
    return Plane(float(1 / a), float(-b / a), float(-c / a))


def find_planes(
    z_m: np.ndarray, slopes: np.ndarray, tolerance_m: float, least_px: int, most: int = 6
) -> list[FoundPlane]:
    """The planes of a depth image, largest first: RANSAC round by round, each plane's largest connected piece.

    ``z_m`` (h, w), NaN where unknown. Points within ``tolerance_m`` of a plane belong to it, and connected points up to
    `GROWN` times as far: a wall that a wrong lens bows stays one. Planes of fewer than ``least_px`` pixels are left
    out. The same image gives the same planes.
    """
    left = np.isfinite(z_m) & np.isfinite(slopes).all(axis=-1)
    found: list[FoundPlane] = []
    for number in range(2 * most):
        if len(found) == most or left.sum() < least_px:
            break
        inverse = _best_candidate(z_m, slopes, left, tolerance_m, number)
        mask = left
        for _ in range(3):
            mask = left & (_distance_m(inverse, slopes, z_m) < tolerance_m)
            if mask.sum() < 3:
                break
            inverse, _ = robust_inverse_fit(np.column_stack([np.ones(int(mask.sum())), slopes[mask]]), z_m[mask])
        else:
            labels, _ = ndimage.label(left & (_distance_m(inverse, slopes, z_m) < GROWN * tolerance_m))
            mask = labels == int(np.argmax(np.bincount(labels[mask])))
        if mask.sum() < least_px:
            break
        found.append(FoundPlane(fit_plane(z_m[mask], slopes[mask]), mask))
        left = left & ~mask
    return sorted(found, key=lambda plane: -int(plane.mask.sum()))


def _best_candidate(
    z_m: np.ndarray, slopes: np.ndarray, left: np.ndarray, tolerance_m: float, number: int
) -> np.ndarray:
    """(3,) coefficients of 1/z of the candidate that the most of the screened pixels lie on."""
    rng = random_stream(0, "planes", number)
    rows, columns = np.nonzero(left)
    first = rng.integers(0, rows.size, CANDIDATES)
    shift = rng.integers(-TRIPLE_PX, TRIPLE_PX + 1, (CANDIDATES, 2, 2))
    at = np.stack([rows[first], columns[first]], axis=-1)[:, None] + np.concatenate([0 * shift[:, :1], shift], axis=1)
    at = np.clip(at, 0, np.array(left.shape) - 1)
    known = left[at[..., 0], at[..., 1]].all(axis=1)
    at = at[known] if known.any() else at[:1]
    basis = np.concatenate([np.ones((*at.shape[:2], 1)), slopes[at[..., 0], at[..., 1]]], axis=-1)
    straight = np.abs(np.linalg.det(basis)) < 1e-8
    basis[straight] = np.eye(3)
    candidates = np.linalg.solve(basis, 1 / np.nan_to_num(z_m, nan=1.0)[at[..., 0], at[..., 1]][..., None])[..., 0]
    pick = rng.integers(0, rows.size, min(SCREENED, rows.size))
    place, z = slopes[rows[pick], columns[pick]], z_m[rows[pick], columns[pick]]
    near = _distance_m(candidates[:, None, :], place, z) < tolerance_m
    return np.asarray(candidates[int(near.sum(axis=1).argmax())])


def _distance_m(inverse: np.ndarray, slopes: np.ndarray, z_m: np.ndarray) -> np.ndarray:
    """Distance of points from the plane a z + b x + c y = 1, (a, b, c) = ``inverse`` (..., 3): the coefficients of 1/z.

    Infinite for NaN.
    """
    by_z = inverse[..., 0] + inverse[..., 1] * slopes[..., 0] + inverse[..., 2] * slopes[..., 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.abs(z_m * by_z - 1) / np.linalg.norm(inverse, axis=-1)
    return np.nan_to_num(distance, nan=np.inf)
