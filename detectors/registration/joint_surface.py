"""The common surface of a joint registration, and what one view says about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detectors.marks.mark import Mark
from detectors.marks.pairing import SHARED_M
from detectors.registration.registered import displacement_jacobian
from detectors.registration.sampling import MEDIAN_TO_SIGMA, independent, sampling_of, thinned
from detectors.surface import BISQUARE_TUNING
from detectors.views import PreparedView
from harness.vocabulary.geometry import transform_points

DEGREE = 3
TERMS = tuple((k - j, j) for k in range(DEGREE + 1) for j in range(k + 1))
"""Chebyshev orders in x and y by total degree: a level, two tilts, then seven that no pose can imitate."""
POSE_TERMS = 3
MARK_GATE = 16.3
"""Of a mark's place, three degrees of freedom: a true one is passed over once in a thousand."""
START_STEPS = 10


@dataclass(frozen=True)
class SurfaceFrame:
    """Where the surface is z(x, y): z along the mean normal of the reference's target, towards the camera; x and y are
    scaled to -1..1 by ``half_m`` (2,)."""

    T_surface_reference: np.ndarray
    half_m: np.ndarray

    def basis(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """(n, 10) terms of the cubic."""
        in_x = np.polynomial.chebyshev.chebvander(x_m / self.half_m[0], DEGREE)
        in_y = np.polynomial.chebyshev.chebvander(y_m / self.half_m[1], DEGREE)
        return np.stack([in_x[:, i] * in_y[:, j] for i, j in TERMS], axis=1)

    def normals(self, x_m: np.ndarray, y_m: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """(n, 3) directions (-dz/dx, -dz/dy, 1), by differences over a thousandth of the extent."""
        dx, dy = 1e-3 * self.half_m
        along_x = (self.basis(x_m + dx, y_m) - self.basis(x_m - dx, y_m)) @ coefficients / (2 * dx)
        along_y = (self.basis(x_m, y_m + dy) - self.basis(x_m, y_m - dy)) @ coefficients / (2 * dy)
        return np.stack([-along_x, -along_y, np.ones(len(x_m))], axis=1)


@dataclass(frozen=True)
class ViewData:
    """One view's part, in its camera frame: thinned target points (n, 3), marks, and ``labels`` (m,) which of the
    reference's marks they are. ``noise_m``: of one point across the surface. ``sigma_m``: the same, so inflated that
    the points count as if they were independent."""

    points_m: np.ndarray
    marks: tuple[Mark, ...]
    labels: np.ndarray
    noise_m: float
    sigma_m: float


@dataclass(frozen=True)
class Across:
    """A view's points against the surface: residuals (n,), basis (n, 10), derivatives (n, 6) by the pose's motion about
    the surface frame's origin, and robust weights (n,) in 1/m^2."""

    residual_m: np.ndarray
    basis: np.ndarray
    by_pose: np.ndarray
    weight: np.ndarray


def surface_frame(reference: PreparedView) -> SurfaceFrame:
    """The frame of the reference's target."""
    sampling = sampling_of(reference)
    z = sampling.normal
    # x of the frame is the camera's x as far as the surface allows, its y where the surface stands edge-on to that
    along = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = along - (along @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    T[:3, 3] = -T[:3, :3] @ sampling.centre_m
    reach = np.abs(transform_points(T, reference.points_m)[:, :2]).max(axis=0)
    return SurfaceFrame(T, np.maximum(reach, 1e-6))


def view_data(view: PreparedView, reference: PreparedView, T_reference_view: np.ndarray) -> ViewData:
    """What a view contributes; its marks are those of the reference to which ``T_reference_view`` brings them."""
    points = thinned(view.points_m)
    noise = max(sampling_of(view).noise_m, 1e-9)
    inflation = max(len(points) / independent(int(view.inside.sum())), 1.0)
    marks, labels = _labelled(view.marks.trusted, reference.marks.trusted, T_reference_view)
    return ViewData(points, marks, labels, noise, noise * float(np.sqrt(inflation)))


def across(
    data: ViewData, T_surface_view: np.ndarray, frame: SurfaceFrame, surface: np.ndarray, own: np.ndarray
) -> Across:
    """A view's points against the common surface (10,) plus the view's own smooth error (10,)."""
    points = transform_points(T_surface_view, data.points_m)
    basis = frame.basis(points[:, 0], points[:, 1])
    residual = points[:, 2] - basis @ (surface + own)
    normals = frame.normals(points[:, 0], points[:, 1], surface)
    by_pose = np.einsum("ni,nij->nj", normals, displacement_jacobian(points, np.zeros(3)))
    scale = max(data.noise_m, float(np.median(np.abs(residual))) * MEDIAN_TO_SIGMA)
    return Across(residual, basis, by_pose, tukey(residual / scale) / data.sigma_m**2)


def first_surface(frame: SurfaceFrame, points_m: np.ndarray) -> np.ndarray:
    """(10,) coefficients of the robust cubic through points (n, 3) of the surface's frame."""
    basis = frame.basis(points_m[:, 0], points_m[:, 1])
    surface: np.ndarray = np.zeros(len(TERMS))
    root: np.ndarray = np.ones(len(points_m))
    for _ in range(START_STEPS):
        surface = np.linalg.lstsq(basis * root[:, None], points_m[:, 2] * root, rcond=None)[0]
        residual = points_m[:, 2] - basis @ surface
        root = np.sqrt(tukey(residual / max(float(np.median(np.abs(residual))) * MEDIAN_TO_SIGMA, 1e-9)))
    return surface


def tukey(scaled: np.ndarray) -> np.ndarray:
    """Tukey's bisquare weights of residuals in standard deviations."""
    inside = np.clip(1 - (scaled / BISQUARE_TUNING) ** 2, 0.0, None)
    weights: np.ndarray = inside**2
    return weights


def _labelled(
    marks: Sequence[Mark], reference: Sequence[Mark], T_reference_view: np.ndarray
) -> tuple[tuple[Mark, ...], np.ndarray]:
    """Marks that are one of the reference's, each at most once, the best fit first; and which."""
    turn = T_reference_view[:3, :3]
    fits = []
    for i, mark in enumerate(marks):
        for j, other in enumerate(reference):
            if mark.code != other.code:
                continue
            apart = transform_points(T_reference_view, mark.centre_m) - other.centre_m
            spread = turn @ mark.covariance_m2 @ turn.T + other.covariance_m2 + 2 * SHARED_M**2 * np.eye(3)
            fits.append((float(apart @ np.linalg.solve(spread, apart)), i, j))
    chosen: dict[int, int] = {}
    for chi2, i, j in sorted(fits):
        if chi2 <= MARK_GATE and i not in chosen and j not in chosen.values():
            chosen[i] = j
    return tuple(marks[i] for i in sorted(chosen)), np.array([chosen[i] for i in sorted(chosen)], dtype=int)
