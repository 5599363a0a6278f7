"""Volumetric merging: a truncated signed distance field over the views' depth images (Open3D's VoxelBlockGrid).

Each view's depth is resampled to an image without distortion, with its own pixels' pitch, by the same triangles
as the map (`detectors.mapping.raster`): the field's own projection knows no lens. In the field every view counts alike
and depth counts along its own optical axis (Curless and Levoy 1996, with Open3D's constant weight).

Crossings on the walls of holes and at the target's edges are left out, so that what remains is the target's face and
the floors of its damage: a field has no rays, and a surface fitted through walls is bent by them.

Not modelled: noise and incidence in the weights; what a view sees through a hole carves the rim from aside, as every
truncated field does within its truncation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from detectors.mapping.chosen_views import ChosenView
from detectors.mapping.placing import T_reference_map_of, common_surface
from detectors.mapping.raster import CellGrid, raster_between
from detectors.open3d_library import open3d_on_one_thread
from harness.vocabulary.capture import Cloud
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region, invert, transform_points

TRUNCATION_VOXELS = 4.0
"""Distance at which the field is cut off: over 5 mm for pixels of 1.4 mm, ten times the noise of a single frame, so
that both faces of a half-inch board stay apart."""
OVERSAMPLING = 2
"""Pixels of the undistorted image along a side of a pixel: the field takes the depth of the nearest one, which is wrong
by up to half a pixel's width times the tangent of the incidence."""
WALL_DEG = 60.0
"""Angle between a crossing's normal and that of the target's smooth face, beyond which the crossing lies on a wall. A
dent as deep as its radius has flanks of 45 degrees; a drilled wall has 90, less what the camera's blur takes."""
LOOKED_UP_AT = 0.5
"""Added to the principal point: Open3D's integration cuts pixel positions off, so the first pixel's centre is 0.5."""
BLOCK = 8
"""Voxels along a side of a block: of blocks of 16 most voxels lie beyond the cut and cost as much time as the rest."""
BLOCKS_AT_FIRST = 4096
"""Blocks that are reserved; the table grows by itself. 4096 hold a square of half a metre at 1.4 mm."""


@dataclass(frozen=True)
class _Pinhole:
    """A depth image (h, w) float32, 0 where there is none, with colour (h, w, 3) 0..1 and its camera matrix."""

    z_m: np.ndarray
    rgb: np.ndarray | None
    matrix: np.ndarray


def integrate(views: Sequence[ChosenView], voxel_m: float | None) -> tuple[Cloud, tuple[str, ...]]:
    """An unorganised cloud in the first view's frame: the field's zero crossings, sorted by x, y, z; and notes.

    A crossing knows neither the number of its samples nor their variance: ``count`` is 1, ``variance_m2`` of all
    points the median variance of one frame's z over the views' targets, for the floor that rounding sets.
    """
    images = [_undistorted(view) for view in views]
    voxel = voxel_m if voxel_m is not None else _pitch(views[0])
    points, normals, rgb = _crossings(views, images, voxel)
    facing = _facing(views, points, normals)
    order = np.flatnonzero(facing)[np.lexsort(points[facing].T[::-1])]
    notes = (
        f"voxels of {1e3 * voxel:.2f} mm, cut off at {1e3 * voxel * TRUNCATION_VOXELS:.1f} mm;"
        f" {len(points) - len(order)} points on walls steeper than {WALL_DEG:.0f} degrees are left out",
    )
    return _cloud(views, points[order], None if rgb is None else rgb[order]), notes


def _undistorted(view: ChosenView) -> _Pinhole:
    """The view's depth on a pinhole's grid of slopes x/z, y/z."""
    cloud, inside = view.cloud, view.inside
    with np.errstate(invalid="ignore"):
        slopes = cloud.points_m[..., :2] / cloud.points_m[..., 2:]
    step = view.slope_step / OVERSAMPLING
    low, high = slopes[inside].min(axis=0), slopes[inside].max(axis=0)
    columns, rows = np.floor((high - low) / step).astype(int) + 1
    grid = CellGrid(float(low[0]), float(low[1]), step, (int(rows), int(columns)))
    raster = raster_between(slopes, inside, cloud.organised, step, grid)
    z = np.nan_to_num(raster.at_cells(cloud.points_m[..., 2].reshape(-1))).astype(np.float32)
    rgb = None if cloud.rgb is None else raster.at_cells(cloud.rgb.reshape(-1, 3).astype(np.float64))
    colour = None if rgb is None else (np.nan_to_num(rgb) / 255.0).astype(np.float32)
    u0, v0 = LOOKED_UP_AT - low / step
    matrix = np.array([[1.0 / step, 0.0, u0], [0.0, 1.0 / step, v0], [0.0, 0.0, 1.0]])
    return _Pinhole(z, colour, matrix)


def _pitch(view: ChosenView) -> float:
    """The first view's pixels on its target."""
    return float(np.median(view.cloud.points_m[view.inside][:, 2])) * view.slope_step


def _facing(views: Sequence[ChosenView], points_m: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n,) bool: crossings whose normal is within `WALL_DEG` of that of the smooth surface through all targets.

    Raises UserError where the targets do not determine such a surface.
    """
    T_reference_map = T_reference_map_of(views[0])
    surface = common_surface(views, T_reference_map)
    x, y, _ = transform_points(invert(T_reference_map), points_m).T
    step = _pitch(views[0])
    by_x = (surface.evaluate(x + step, y) - surface.evaluate(x - step, y)) / (2 * step)
    by_y = (surface.evaluate(x, y + step) - surface.evaluate(x, y - step)) / (2 * step)
    face = np.column_stack([-by_x, -by_y, np.ones_like(x)])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    turned = normals @ T_reference_map[:3, :3]
    along: np.ndarray = np.abs(np.einsum("ni,ni->n", turned, face))
    return along >= np.cos(np.deg2rad(WALL_DEG)) * np.linalg.norm(turned, axis=1)


def _crossings(
    views: Sequence[ChosenView], images: Sequence[_Pinhole], voxel: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    with open3d_on_one_thread() as o3d:
        return _integrated(o3d, views, images, voxel)


def _integrated(
    o3d: Any, views: Sequence[ChosenView], images: Sequence[_Pinhole], voxel: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Places and normals (n, 3) of the zero crossings, in the first view's frame; colours where all views have them."""
    core = o3d.core
    coloured = all(image.rgb is not None for image in images)
    names, channels = ["tsdf", "weight"], [[1], [1]]
    if coloured:
        names, channels = [*names, "color"], [*channels, [3]]
    kinds = [core.float32] * len(names)
    field = o3d.t.geometry.VoxelBlockGrid(names, kinds, channels, voxel, BLOCK, BLOCKS_AT_FIRST)
    for view, image in zip(views, images, strict=True):
        _add(o3d, field, image, invert(view.registration.T_reference_view), coloured)
    try:
        found = field.extract_point_cloud(0.5)
    except RuntimeError as error:
        # Open3D cannot make a cloud of no points
        raise UserError(
            f"a volume with voxels of {1e3 * voxel:.3g} mm holds no surface of the target",
            fix="choose smaller voxels, check the crop, or merge in another way",
        ) from error
    points, normals = (found.point[name].numpy().astype(np.float64) for name in ("positions", "normals"))
    return points, normals, found.point.colors.numpy() if coloured else None


def _add(o3d: Any, field: Any, image: _Pinhole, T_view_reference: np.ndarray, coloured: bool) -> None:
    depth = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(image.z_m[..., None])))
    matrix, pose = o3d.core.Tensor(image.matrix), o3d.core.Tensor(T_view_reference)
    farthest = float(image.z_m.max()) * 2.0
    blocks = field.compute_unique_block_coordinates(depth, matrix, pose, 1.0, farthest, TRUNCATION_VOXELS)
    if coloured and image.rgb is not None:
        colour = o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(image.rgb)))
        field.integrate(blocks, depth, colour, matrix, pose, 1.0, farthest, TRUNCATION_VOXELS)
    else:
        field.integrate(blocks, depth, matrix, pose, 1.0, farthest, TRUNCATION_VOXELS)


def _cloud(views: Sequence[ChosenView], points: np.ndarray, rgb: np.ndarray | None) -> Cloud:
    clouds = [view.cloud for view in views]
    variances = np.concatenate([view.cloud.variance_m2[view.inside] for view in views])
    known = variances[np.isfinite(variances)]
    n = len(points)
    return Cloud(
        points_m=points[None],
        reason=np.zeros((1, n), dtype=np.uint8),
        count=np.ones((1, n), dtype=np.int32),
        variance_m2=np.full((1, n), float(np.median(known)) if len(known) else np.nan),
        region=Region(0, 1, 0, n),
        z_step_m=max(cloud.z_step_m for cloud in clouds),
        n_frames=min(cloud.n_frames for cloud in clouds),
        organised=False,
        rgb=None if rgb is None else np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)[None],
        left_out=tuple(left for cloud in clouds for left in cloud.left_out),
    )
