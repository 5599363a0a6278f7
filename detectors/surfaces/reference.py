"""The part's own mesh as the undamaged surface: fitted to the cloud, it gives the point where each
ray should end.

The part's front axis is turned to the camera, upright or rolled by multiples of 90 degrees.
Closest points, then closest planes, move it onto the cloud (Besl and McKay 1992; Chen and Medioni
1992); points off the part count less (Tukey). Triangles that face away are left out. A part turned
by more than about 30 degrees is not found. A direction that the mesh does not fix, such as a shift
of a plane along itself, stays undetermined; no result depends on it."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from detectors.open3d_library import load_open3d
from detectors.rigid_motion import displacement_jacobian, kabsch, moved_by
from detectors.surfaces.surface import BISQUARE_TUNING, Fit, ReferenceConfig, bisquare_weights
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, rotate_vectors, transform_points
from harness.vocabulary.meshes import front_first, read_mesh

SAMPLE = 4000
STEPS = 20
"""Number of steps by closest points (twice as many by distances follow, then as many by planes)."""
LEAST_SCALE_M = 0.1 * MM
FAR_M = 10.0
EDGE_PX = 1.5  # pixels within this distance of a step or edge of the part are not judged
BENT = 0.5
"""Bend, in pixels, that makes an edge."""
# a direction with a smaller share of the largest information is not fixed by the part
LOOSE = 1e-6


@lru_cache(maxsize=4)
def front_of(reference: ReferenceConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (m, 3, 3) of a part's triangles, x right, y up, z to the camera, in
    metres, and their unit normals (m, 3). Raises UserError if the file is not a mesh or no
    triangle faces the front."""
    mesh = read_mesh(reference.file)
    corners = front_first(mesh, reference.unit, reference.front)[np.asarray(mesh.faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if not (normals[:, 2] > 0).any():
        fix = "state its front, or turn its faces outwards"
        raise UserError(f"{reference.file}: none of its triangles faces {reference.front}", fix=fix)
    return corners, normals


def laid_on(points: np.ndarray, reference: ReferenceConfig, central: bool) -> tuple[str, Fit]:
    """Fit the part to points (n, 3) of the camera's frame. Return a text on the quality of the
    fit, and the surface seen along rays from the lens (``central``) or along z. Raises UserError
    as `front_of` does."""
    corners, normals = front_of(reference)
    ahead = normals[:, 2] > -LOOSE
    part = _scene(corners)
    front = _scene(corners[ahead])
    sample = points[:: max(1, len(points) // SAMPLE)]
    poses = [_fitted(front, corners[ahead], normals[ahead], sample, turn) for turn in range(4)]
    T_part_camera, off_m, error_m = min(poses, key=lambda pose: pose[1])

    flat = points / points[:, 2:] if central else points
    pitch = float(np.sqrt(np.prod(np.ptp(flat[:, :2], axis=0)) / len(flat)))

    def met(rays: np.ndarray) -> np.ndarray:
        """Return z where rays meet the part: from the lens through (n, 2) at z = 1, or along z at
        (n, 2)."""
        if central:
            along = np.column_stack([rays, np.full(len(rays), 1.0)])
            starts = np.zeros(along.shape)
        else:
            starts = np.column_stack([rays, np.full(len(rays), -FAR_M)])
            along = np.eye(3)[[2] * len(rays)]
        origin = transform_points(T_part_camera, starts)
        ray = rotate_vectors(T_part_camera, along)
        hits = part.cast_rays(np.concatenate([origin, ray], axis=1).astype(np.float32))
        triangle = hits["primitive_ids"].numpy()
        is_hit = triangle != part.INVALID_ID
        number = np.where(is_hit, triangle, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.einsum("ni,ni->n", corners[number, 0] - origin, normals[number])
            reach /= np.einsum("ni,ni->n", ray, normals[number])
            return np.where(is_hit, starts[:, 2] + reach, np.nan)

    def z_at(queries: np.ndarray) -> np.ndarray:
        """Return z of the surface; NaN within `EDGE_PX` of a step, where a camera mixes both
        sides."""
        rays = queries[:, :2] / queries[:, 2:] if central else queries[:, :2]
        z = met(rays)
        side = EDGE_PX * pitch
        bends = []
        for shift in ([side, 0], [0, side]):
            bends.append(met(rays + np.array(shift)) + met(rays - np.array(shift)) - 2 * z)
        limit = BENT * pitch * (np.abs(z) if central else 1.0)
        return np.where(np.abs(bends).max(axis=0) < limit, z, np.nan)

    text = (
        f"the mesh {Path(reference.file).name}, with half of the points within "
        f"{off_m / MM:.2g} mm of it, placed along its normals within "
        f"{error_m / MM:.2g} mm (standard error)"
    )
    return text, z_at


def _scene(corners: np.ndarray) -> Any:
    """Return triangles (m, 3, 3) as a scene for rays and closest points, identified by their
    numbers."""
    scene = load_open3d().t.geometry.RaycastingScene(nthreads=1)
    faces = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(corners.reshape(-1, 3).astype(np.float32), faces)
    return scene


def _fitted(
    scene: Any, corners: np.ndarray, normals: np.ndarray, points: np.ndarray, turn: int
) -> tuple[np.ndarray, float, float]:
    """Return T_part_camera, found from one rotation by a multiple of 90 degrees; the median
    distance of the points (n, 3) from the part's planes; and the standard error of its position
    along them, if the points are independent."""
    c, s = np.rint([np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)])
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ T[:3, :3]
    T[:3, 3] = np.median(corners.reshape(-1, 3), axis=0) - T[:3, :3] @ np.median(points, axis=0)
    pitch_m = float(np.sqrt(np.prod(np.ptp(points[:, :2], axis=0)) / len(points)))
    for step in range(4 * STEPS):
        by_planes = step >= 3 * STEPS
        moved = transform_points(T, points)
        closest = scene.compute_closest_points(moved.astype(np.float32))
        offsets = moved - closest["points"].numpy()
        towards = normals[closest["primitive_ids"].numpy()]
        if by_planes:
            off = np.einsum("ni,ni->n", offsets, towards)
            least_scale_m = LEAST_SCALE_M
        else:  # a point beyond an edge attracts that edge
            off = np.linalg.norm(offsets, axis=1)
            lengths_m = np.maximum(off, LEAST_SCALE_M)[:, None]
            towards = np.where(off[:, None] > LEAST_SCALE_M, offsets / lengths_m, towards)
            least_scale_m = pitch_m
        scale_m = max(float(np.median(np.abs(off))) / 0.6745, least_scale_m)
        weight = bisquare_weights(off, BISQUARE_TUNING * scale_m)
        if step < STEPS:
            T = kabsch(moved, moved - offsets, weight) @ T
            continue
        off = np.einsum("ni,ni->n", offsets, towards)
        middle = moved.mean(axis=0)
        slopes = np.einsum("ni,nij->nj", towards, displacement_jacobian(moved, middle))
        weighted = (slopes * weight[:, None]).T
        # no motion along a direction that the part does not fix
        inverse = np.linalg.pinv(weighted @ slopes, rcond=LOOSE, hermitian=True)
        T = moved_by(-inverse @ weighted @ off, middle) @ T
    spread_m2 = float((weight * off**2).sum() / weight.sum())
    variances = np.einsum("ni,ij,nj->n", slopes, inverse, slopes)
    error_m = float(np.sqrt(spread_m2 * variances.mean()))
    return T, float(np.median(np.abs(off))), error_m
