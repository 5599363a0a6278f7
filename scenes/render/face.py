"""Indirect light on the board's undamaged face: smooth, so gathered at the nodes of a coarse grid and interpolated."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from harness.vocabulary.geometry import invert, rotate_vectors, transform_points
from harness.vocabulary.units import MM
from scenes.render.direct import DirectLight
from scenes.render.indirect import Work, gather_at_points, noise_lines
from scenes.render.scene import LitScene
from scenes.target.mesh import Target, TargetPart

FACE_WITHIN_M = 0.001 * MM
"""The board's vertices so near its undamaged face lie on it: Booleans in double precision leave them within 1 nm."""
ABOVE_FACE_M = 1 * MM
"""Height of the nodes, so that tape does not bury them."""


def face_triangles(target: Target) -> list[np.ndarray]:
    """For each part which of its triangles (n,) lie on the undamaged face: the board's there, and all of tapes."""
    return [_of_face(target, part) for part in target.parts]


def _of_face(target: Target, part: TargetPart) -> np.ndarray:
    if part.name != "board":
        return np.full(len(part.mesh.faces), part.name.startswith("tape"))
    board = transform_points(invert(target.T_camera_board), part.mesh.vertices)
    near = np.abs(board[:, 2] - target.face_height_m(board[:, 0], board[:, 1])) < FACE_WITHIN_M
    return np.asarray(near[part.mesh.faces].all(axis=1))


def face_light(
    lit: LitScene, target: Target, direct: DirectLight, slopes: np.ndarray, work: Work, spacing_m: float, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Indirect light by way of the face in the pixels that see any of it: mean (f + 1, n), and batches (B, l, n) at
    the frequencies of `noise_lines`.

    Pixels in the order of `numpy.nonzero` of ``direct.face[-1]``. What a node would see of a hole is taken as if the
    face were whole: on a flat face it sees none.
    """
    seen = direct.face[-1].real > 0
    board = _in_board(target, slopes[seen], direct.face_range_m[seen])
    xs, ys = (_node_places(board[:, k], spacing_m) for k in range(2))
    grid_y, grid_x = np.meshgrid(ys, xs, indexing="ij")
    position, normal = _above_face(target, grid_x.ravel(), grid_y.ravel())
    light = gather_at_points(lit, position, normal, work, samples)
    weights = between_nodes(xs, ys, board[:, 0], board[:, 1])
    share = direct.face[:, seen]
    few = noise_lines(work.frequencies_hz)
    batches = np.stack([share[few] * (weights @ batch[few].T).T for batch in light.sums])
    return share * (weights @ light.mean.T).T, batches


def between_nodes(nodes_x: np.ndarray, nodes_y: np.ndarray, x: np.ndarray, y: np.ndarray) -> sparse.csr_array:
    """Bilinear weights (n, len(nodes_y) len(nodes_x)) of evenly spaced nodes, row by row, at n places between them.

    Light that left its last surface a distance D away bends over a spacing s by (s/D)^2/8 of itself: 2e-3 at 80 mm and
    0.7 m, of a part that is itself some per cent of the whole.
    """
    columns = len(nodes_x)
    parts = []
    for nodes, values in ((nodes_x, x), (nodes_y, y)):
        place = (values - nodes[0]) / (nodes[1] - nodes[0])
        cell = np.clip(place.astype(np.int64), 0, len(nodes) - 2)
        parts.append((cell, place - cell))
    (i, right), (j, down) = parts
    index = np.stack([(j + b) * columns + i + a for b in (0, 1) for a in (0, 1)], axis=1)
    weight = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
    starts = np.arange(len(x) + 1) * 4
    return sparse.csr_array((weight.ravel(), index.ravel(), starts), shape=(len(x), columns * len(nodes_y)))


def _in_board(target: Target, slopes: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Points (..., 3) in the board's frame at ranges along rays from the lens."""
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)
    rays *= (range_m / np.linalg.norm(rays, axis=-1))[..., None]
    return transform_points(invert(target.T_camera_board), rays)


def _node_places(values: np.ndarray, spacing: float) -> np.ndarray:
    """At least three evenly spaced places over the range of values."""
    low, high = float(values.min()), float(values.max())
    return np.linspace(low, high, max(int(np.ceil((high - low) / spacing)) + 1, 3))


def _above_face(target: Target, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points ABOVE_FACE_M off the undamaged face and its unit normals, both (n, 3) in the camera's frame."""
    step = 1e-5
    z = target.face_height_m(x, y)
    slope_x = (target.face_height_m(x + step, y) - target.face_height_m(x - step, y)) / (2 * step)
    slope_y = (target.face_height_m(x, y + step) - target.face_height_m(x, y - step)) / (2 * step)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    point = np.stack([x, y, z], axis=-1) + ABOVE_FACE_M * normal
    return transform_points(target.T_camera_board, point), rotate_vectors(target.T_camera_board, normal)
