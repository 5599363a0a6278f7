"""Views of a small board with four marks, ray-cast by a pinhole camera: what registrations are
tested on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from detectors.views.marks.mark import Mark, MarkSet
from detectors.views.registration.registered import Registration
from detectors.views.view import PreparedView, View
from harness.vocabulary.geometry import (
    Cloud,
    Lens,
    invert,
    rays_of,
    rotation_xyz_deg,
    transform_points,
)

LENS = Lens(220, 160, 300.0, 300.0, 109.5, 79.5)
HALF_X_M = 0.15
HALF_Y_M = 0.09
DISTANCE_M = 0.5
TAPE_M = (0.036, 0.014)
TAPES_M = ((-0.11, 0.06), (0.10, 0.065), (-0.105, -0.06), (0.115, -0.05))
"""Centres on the board; no turn of the board brings them onto themselves."""


@dataclass(frozen=True)
class BoardView:
    """A view, and the truth: ``T_camera_board``."""

    prepared: PreparedView
    T_camera_board: np.ndarray


def pose(
    tilt_x_deg: float = 0.0,
    tilt_y_deg: float = 0.0,
    roll_deg: float = 0.0,
    shift_m: object = (0, 0, 0),
) -> np.ndarray:
    """``T_camera_board``: the board's x and y along the camera's x and -y, then turned, at
    `DISTANCE_M`."""
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ rotation_xyz_deg(tilt_x_deg, tilt_y_deg, roll_deg)
    T[:3, 3] = np.array([0.0, 0.0, DISTANCE_M]) + np.asarray(shift_m, dtype=float)
    return T


def board_view(
    T_camera_board: np.ndarray,
    guess: np.ndarray | None,
    *,
    noise_m: float = 0.0,
    seed: int = 0,
    lens: Lens = LENS,
    tapes_m: tuple[tuple[float, float], ...] = TAPES_M,
    textured: bool = False,
    smooth_m: np.ndarray | None = None,
) -> BoardView:
    """One view. ``smooth_m`` (4, 4): coefficients T_i(x) T_j(y) of Chebyshev polynomials, x and y
    from -1 to 1 on the board, that are added to z as an error of the whole view."""
    slopes = lens.region_slopes(lens.whole)
    rays = rays_of(slopes)
    normal = T_camera_board[:3, 2]
    point = T_camera_board[:3, 3]
    points = rays * (normal @ point / (rays @ normal))[..., None]
    on_board = transform_points(invert(T_camera_board), points)
    inside = (np.abs(on_board[..., 0]) <= HALF_X_M) & (np.abs(on_board[..., 1]) <= HALF_Y_M)
    z = points[..., 2] + np.random.default_rng(seed).standard_normal(inside.shape) * noise_m
    if smooth_m is not None:
        u = on_board[..., 0] / HALF_X_M
        v = on_board[..., 1] / HALF_Y_M
        z = z + np.polynomial.chebyshev.chebval2d(u, v, smooth_m)
    z = np.where(inside, z, np.nan)
    points = rays * z[..., None]
    labels = np.full(inside.shape, -1)
    for k, (x, y) in enumerate(tapes_m):
        close = (np.abs(on_board[..., 0] - x) <= TAPE_M[0] / 2) & (
            np.abs(on_board[..., 1] - y) <= TAPE_M[1] / 2
        )
        labels[close & inside] = k
    reason = np.where(inside, 0, 1).astype(np.uint8)
    count = inside.astype(int)
    rgb = _colour(on_board, labels, textured)
    unknown = np.full(inside.shape, np.nan)
    cloud = Cloud(points, reason, count, unknown, lens.whole, 0.0, 1, lens=lens, rgb=rgb)
    marks = tuple(
        _mark(points, labels, k, noise_m) for k in range(len(tapes_m)) if (labels == k).sum() >= 10
    )
    mark_set = MarkSet(
        marks,
        np.flatnonzero(labels >= 0),
        "" if len(marks) >= 3 else f"{len(marks)} marks found, 3 needed",
    )
    return BoardView(PreparedView(View("view", cloud, guess), inside, mark_set), T_camera_board)


def views(
    poses: list[np.ndarray],
    *,
    guess_error: np.ndarray | None = None,
    noise_m: float = 0.0,
    seed: int = 0,
    **more: Any,
) -> list[BoardView]:
    """Views of one board, named view 0, 1, ...; guesses are the truth, times ``guess_error`` (4,
    4) after the first."""
    created = []
    for i, T_camera_board in enumerate(poses):
        guess = poses[0] @ invert(T_camera_board) if i else np.eye(4)
        if i and guess_error is not None:
            guess = guess_error @ guess
        one = board_view(T_camera_board, guess, noise_m=noise_m, seed=1000 * seed + i, **more)
        view = View(f"view {i}", one.prepared.view.cloud, guess)
        created.append(
            BoardView(PreparedView(view, one.prepared.inside, one.prepared.marks), T_camera_board)
        )
    return created


def usual_error() -> np.ndarray:
    """A guess's error: 3 degrees about an oblique axis through the board's centre, and 10 mm."""
    error = np.eye(4)
    error[:3, :3] = rotation_xyz_deg(1.5, -1.8, 1.8)
    centre = np.array([0.0, 0.0, DISTANCE_M])
    error[:3, 3] = centre - error[:3, :3] @ centre + [0.006, -0.005, 0.006]
    return error


def target_error_m(
    registration: Registration, reference: BoardView, view: BoardView
) -> tuple[float, float]:
    """Root mean square error over the board against the truth: within its plane, and across it."""
    x, y = np.meshgrid(np.linspace(-HALF_X_M, HALF_X_M, 9), np.linspace(-HALF_Y_M, HALF_Y_M, 7))
    board = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    placed = transform_points(
        registration.T_reference_view, transform_points(view.T_camera_board, board)
    )
    error = placed - transform_points(reference.T_camera_board, board)
    across = error @ reference.T_camera_board[:3, 2]
    within = np.sum(error**2, axis=1) - across**2
    return float(np.sqrt(max(within.mean(), 0.0))), float(np.sqrt(np.mean(across**2)))


def _mark(points_m: np.ndarray, labels: np.ndarray, label: int, noise_m: float) -> Mark:
    picked = np.flatnonzero(labels == label)
    own_points = points_m.reshape(-1, 3)[picked]
    # the rim lies anywhere within a pixel: the centroid of n pixels with about 4 sqrt(n) at the
    # rim
    pitch = DISTANCE_M / LENS.fx
    rim = 4 * np.sqrt(len(picked)) * pitch**2 / 12 * (TAPE_M[0] / 2 / (len(picked) * pitch)) ** 2
    covariance = np.diag([rim, rim, max(noise_m, 1e-6) ** 2 / len(picked)])
    normal = np.array([0.0, 0.0, -1.0])
    return Mark(own_points.mean(axis=0), covariance, normal, picked, TAPE_M[0] * TAPE_M[1])


def _colour(on_board_m: np.ndarray, labels: np.ndarray, textured: bool) -> np.ndarray:
    """Grey with red tapes; or with a pattern of bars of several widths, fixed to the board."""
    grey = np.full(labels.shape, 150.0)
    if textured:
        x = on_board_m[..., 0]
        y = on_board_m[..., 1]
        grey += 45 * np.sin(2 * np.pi * (x / 0.031 + 0.3 * y / 0.02)) + 40 * np.sin(
            2 * np.pi * (y / 0.023 - 0.4 * x / 0.05)
        )
    rgb = np.repeat(np.clip(grey, 0, 255)[..., None], 3, axis=-1).astype(np.uint8)
    rgb[labels >= 0] = (200, 30, 30)
    return rgb
