"""Views of a plane, with or without a drilled hole, from rays in space: what the tests of maps are
made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from detectors.views.marks.mark import MarkSet
from detectors.views.registration.registered import Registration, reference_registration
from detectors.views.view import PreparedView, View
from harness.vocabulary.geometry import (
    Cloud,
    Lens,
    invert,
    rays_of,
    rotate_vectors,
    rotation_xyz_deg,
    transform_points,
)

LENS = Lens(160, 120, 500.0, 500.0, 79.5, 59.5)
DISTANCE_M = 0.7
PITCH_M = DISTANCE_M / 500.0


@dataclass(frozen=True)
class Hole:
    """Blind, straight into the plane at its place (x, y) in the first view's plane co-ordinates."""

    diameter_m: float
    depth_m: float
    at: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Plane:
    """In the first view's frame: through (0, 0, ``DISTANCE_M``) with a unit normal away from the
    viewer."""

    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    hole: Hole | None = None

    @property
    def T_reference_plane(self) -> np.ndarray:
        """x, y in the plane, z along the normal."""
        T = np.eye(4)
        T[:3, :3] = rotation_xyz_deg(self.tilt_x_deg, self.tilt_y_deg, 0.0)
        T[2, 3] = DISTANCE_M
        return T

    def z_m(self, slopes: np.ndarray, T_reference_view: np.ndarray) -> np.ndarray:
        """(h, w) where rays with ``slopes`` (h, w, 2) end: on the plane, on the hole's wall or on
        its floor."""
        T_plane_view = invert(self.T_reference_plane) @ T_reference_view
        rays = rotate_vectors(T_plane_view, rays_of(slopes))
        start = T_plane_view[:3, 3]
        part = -start[2] / rays[..., 2]
        if self.hole is None:
            return part
        # in the hole's own frame, from the mouth on: leave the circle (the wall) or reach the
        # floor
        mouth = (start + part[..., None] * rays)[..., :2] - np.array(self.hole.at)
        a = (rays[..., :2] ** 2).sum(axis=-1)
        b = (mouth * rays[..., :2]).sum(axis=-1)
        c = (mouth**2).sum(axis=-1) - (self.hole.diameter_m / 2) ** 2
        with np.errstate(invalid="ignore", divide="ignore"):
            to_wall = np.where(
                a > 1e-12, (-b + np.sqrt(np.maximum(b * b - a * c, 0.0))) / a, np.inf
            )
        return part + np.where(c < 0, np.minimum(to_wall, self.hole.depth_m / rays[..., 2]), 0.0)


def turned(
    about_x_deg: float, about_y_deg: float, shift_m: tuple[float, float, float] = (0, 0, 0)
) -> np.ndarray:
    """T_reference_view of a camera that has gone around the point (0, 0, ``DISTANCE_M``), and then
    aside."""
    T = np.eye(4)
    T[:3, :3] = rotation_xyz_deg(about_x_deg, about_y_deg, 0.0)
    middle = np.array([0.0, 0.0, DISTANCE_M])
    T[:3, 3] = middle - T[:3, :3] @ middle + np.array(shift_m)
    return T


def arc(count: int, half_deg: float) -> list[np.ndarray]:
    """The reference and views to both sides, each shifted a little, so that pixels fall
    differently."""
    angles = np.linspace(-half_deg, half_deg, count - 1) if count > 1 else []
    return [np.eye(4)] + [
        turned(0.3 * angle, angle, (0.0007 * i, -0.0004 * i, 0.003 * i))
        for i, angle in enumerate(angles)
    ]


def seen(
    plane: Plane,
    T_reference_view: np.ndarray,
    rng: np.random.Generator | None = None,
    *,
    noise_m: float = 0.0,
    frames: int = 1,
    pattern_m: np.ndarray | None = None,
    blur: int = 1,
    lens: Lens = LENS,
    name: str = "view",
    **fields: Any,
) -> PreparedView:
    """A view of a plane: average of frames with white noise, a pattern added, all pixels inside.

    ``variance_m2`` is a sample variance as frames would give it. ``fields`` replace those of the
    cloud.
    """
    slopes = lens.region_slopes(lens.whole)
    over = 4
    v, u = np.mgrid[: lens.height * over, : lens.width * over]
    fine = lens.slopes((u + 0.5) / over - 0.5, (v + 0.5) / over - 0.5) if plane.hole else slopes
    z = plane.z_m(fine, T_reference_view)
    if plane.hole:
        flat = Plane(plane.tilt_x_deg, plane.tilt_y_deg)
        deep = z - flat.z_m(fine, T_reference_view)
        deep = deep.reshape(lens.height, over, lens.width, over).mean(axis=(1, 3))
        z = flat.z_m(slopes, T_reference_view) + cv2.blur(deep, (blur, blur))
    shape = z.shape
    variance = np.full(shape, np.nan)
    if rng is not None:
        z = z + noise_m * rng.standard_normal(shape) / np.sqrt(frames)
        if frames > 1:
            variance = noise_m**2 * rng.chisquare(frames - 1, shape) / (frames - 1)
    if pattern_m is not None:
        z = z + pattern_m
    arguments: dict[str, Any] = {
        "points_m": np.concatenate([slopes * z[..., None], z[..., None]], axis=-1),
        "reason": np.zeros(shape, dtype=np.uint8),
        "count": np.full(shape, frames, dtype=np.int32),
        "variance_m2": variance,
        "region": lens.whole,
        "z_step_m": 0.0,
        "n_frames": frames,
        "lens": lens,
    }
    cloud = Cloud(**(arguments | fields))
    return prepared(cloud, cloud.valid, T_reference_view, name)


def prepared(cloud: Cloud, inside: np.ndarray, guess: np.ndarray | None, name: str) -> PreparedView:
    return PreparedView(View(name, cloud, guess), inside, MarkSet((), np.empty(0, dtype=np.int64)))


def registered(
    name: str, T_reference_view: np.ndarray, covariance: np.ndarray | None = None, failure: str = ""
) -> Registration:
    """A registration that is right; exact where no covariance is given."""
    reference = np.zeros((6, 6)) if covariance is None else covariance
    centre = np.array([0.0, 0.0, DISTANCE_M])
    return Registration(
        name, "truth", T_reference_view, reference, centre, 0.0, 1.0, 4, 1, True, 0.0, failure
    )


def reference() -> Registration:
    return reference_registration("view", "truth")


def plane_height(points_m: np.ndarray, T_reference_cloud: np.ndarray, plane: Plane) -> np.ndarray:
    """How far behind the plane points (..., 3) of a merged cloud lie, along its normal."""
    height: np.ndarray = transform_points(
        invert(plane.T_reference_plane) @ T_reference_cloud, points_m
    )[..., 2]
    return height
