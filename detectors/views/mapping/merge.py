"""The steps from views to one cloud: prepare, register (`detectors.views.registration.register`),
and merge.

A volume is a truncated signed distance field over the views' depth images (Open3D's
VoxelBlockGrid). Depth is resampled with the triangles of the map to an image without distortion,
because the field's projection has no lens model. All views have equal weight, and depth counts
along the view's own optical axis (Curless and Levoy 1996). Not modelled: noise and incidence in
the weights; views through a hole, which remove part of its rim."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from detectors.crop import crop
from detectors.open3d_library import open3d_on_one_thread
from detectors.views.mapping.fusion import SurfaceMap, fuse
from detectors.views.mapping.placing import (
    CellGrid,
    ChosenView,
    T_reference_map_of,
    common_surface,
    raster_between,
)
from detectors.views.mapping.settings import AnyMerge, FusedMerge, GridMerge, MappingConfig
from detectors.views.marks.find import find_marks
from detectors.views.registration.registered import Registration
from detectors.views.view import PreparedView, View
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Region, invert, transform_points

TRUNCATION_VOXELS = 4.0
"""Distance at which the field is truncated: over 5 mm for pixels of 1.4 mm, ten times the noise of
one frame."""
# pixels of the undistorted image along a side of an original pixel; the field takes the nearest
# depth
OVERSAMPLING = 2
WALL_DEG = 60.0
"""A crossing whose normal is farther from that of the smooth face lies on a wall. A dent as deep
as its radius has flanks of 45 degrees; a drilled wall has 90, less the effect of the camera's
blur."""
# added to the principal point, as Open3D truncates pixel positions: the first pixel's centre is
# 0.5
LOOKED_UP_AT = 0.5
BLOCK = 8
BLOCKS_AT_FIRST = 4096
"""Voxels along a side of a block (larger ones lie mostly outside the truncated field), and blocks
reserved at first."""


def integrate(views: Sequence[ChosenView], voxel_m: float | None) -> tuple[Cloud, tuple[str, ...]]:
    """Return the field's zero crossings as an unorganised cloud in the first view's frame, sorted
    by x, y, z; and notes. ``count`` is 1; ``variance_m2`` of all points is the median variance of
    one frame's z over the views' targets, for the floor that rounding sets. Raises UserError if
    the field or the targets have no smooth surface."""
    clouds = [view.cloud for view in views]
    first = views[0]
    first_z_m = clouds[0].points_m[first.inside][:, 2]
    pitch = float(np.median(first_z_m)) * first.slope_step
    voxel = voxel_m if voxel_m is not None else pitch
    points, normals, rgb = _crossings(views, voxel)
    facing = _facing(views, points, normals, pitch)
    order = np.flatnonzero(facing)[np.lexsort(points[facing].T[::-1])]
    n = len(order)
    variances = np.concatenate([view.cloud.variance_m2[view.inside] for view in views])
    finite = variances[np.isfinite(variances)]
    variance_m2 = float(np.median(finite)) if len(finite) else np.nan
    if rgb is not None:
        rgb = np.round(255.0 * np.clip(rgb[order], 0.0, 1.0)).astype(np.uint8)[None]
    merged = Cloud(
        points_m=points[order][None],
        reason=np.zeros((1, n), dtype=np.uint8),
        count=np.ones((1, n), dtype=np.int32),
        variance_m2=np.full((1, n), variance_m2),
        region=Region(0, 1, 0, n),
        z_step_m=max(cloud.z_step_m for cloud in clouds),
        n_frames=min(cloud.n_frames for cloud in clouds),
        organised=False,
        rgb=rgb,
        left_out=tuple(reason for cloud in clouds for reason in cloud.left_out),
    )
    note = (
        f"voxels of {1e3 * voxel:.2f} mm, cut off at {1e3 * voxel * TRUNCATION_VOXELS:.1f} mm; "
        f"{len(points) - n} points on walls steeper than {WALL_DEG:.0f} degrees are left out"
    )
    return merged, (note,)


def _undistorted(view: ChosenView) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
    """Return depth (h, w, 1) float32, 0 if none, on a pinhole's grid; colour (h, w, 3) 0..1 if
    any; camera matrix."""
    cloud = view.cloud
    inside = view.inside
    with np.errstate(invalid="ignore"):
        slopes = cloud.points_m[..., :2] / cloud.points_m[..., 2:]
    step = view.slope_step / OVERSAMPLING
    low = slopes[inside].min(axis=0)
    high = slopes[inside].max(axis=0)
    columns, rows = np.floor((high - low) / step).astype(int) + 1
    grid = CellGrid(float(low[0]), float(low[1]), step, (int(rows), int(columns)))
    raster = raster_between(slopes, inside, cloud.organised, step, grid)
    z = np.nan_to_num(raster.at_cells(cloud.points_m[..., 2].reshape(-1)))
    rgb = None
    if cloud.rgb is not None:
        colours = raster.at_cells(cloud.rgb.reshape(-1, 3))
        rgb = (np.nan_to_num(colours) / 255.0).astype(np.float32)
    focal_px = 1.0 / step
    cx, cy = LOOKED_UP_AT - low / step
    matrix = np.array([[focal_px, 0.0, cx], [0.0, focal_px, cy], [0.0, 0.0, 1.0]])
    return z.astype(np.float32)[..., None], rgb, matrix


def _crossings(
    views: Sequence[ChosenView], voxel: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return places and normals (n, 3) of zero crossings in the first view's frame; colours if all
    views have any."""
    coloured = all(view.cloud.rgb is not None for view in views)
    names = ["tsdf", "weight", "color"][: 2 + coloured]
    channels = [[1], [1], [3]][: 2 + coloured]
    with open3d_on_one_thread() as o3d:
        core = o3d.core
        geometry = o3d.t.geometry

        def image(values: np.ndarray) -> Any:
            return geometry.Image(core.Tensor(np.ascontiguousarray(values)))

        field = geometry.VoxelBlockGrid(
            names,
            [core.float32] * len(names),
            channels,
            voxel,
            BLOCK,
            BLOCKS_AT_FIRST,
        )
        for view in views:
            z, rgb, matrix = _undistorted(view)
            images = [image(z)]
            if coloured and rgb is not None:
                images.append(image(rgb))
            projection = (
                core.Tensor(matrix),
                core.Tensor(invert(view.registration.T_reference_view)),
                1.0,
                float(z.max()) * 2.0,
                TRUNCATION_VOXELS,
            )
            blocks = field.compute_unique_block_coordinates(images[0], *projection)
            field.integrate(blocks, *images, *projection)
        try:
            crossings = field.extract_point_cloud(0.5)
        except RuntimeError as error:
            # Open3D cannot make a cloud without points
            problem = f"a volume with voxels of {1e3 * voxel:.3g} mm holds no surface of the target"
            raise UserError(
                problem, fix="choose smaller voxels, check the crop, or merge in another way"
            ) from error
        points = crossings.point["positions"].numpy().astype(np.float64)
        normals = crossings.point["normals"].numpy().astype(np.float64)
        return points, normals, crossings.point.colors.numpy().copy() if coloured else None


def _facing(
    views: Sequence[ChosenView],
    points_m: np.ndarray,
    normals: np.ndarray,
    pitch_m: float,
) -> np.ndarray:
    """Return (n,) bool: crossings whose normal is within `WALL_DEG` of that of the smooth surface
    of all targets."""
    T_reference_map = T_reference_map_of(views[0])
    surface = common_surface(views, T_reference_map)
    x, y, _ = transform_points(invert(T_reference_map), points_m).T
    face = surface.gradients(x, y, pitch_m)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    turned = normals @ T_reference_map[:3, :3]
    along = np.abs(np.einsum("ni,ni->n", turned, face))
    return np.asarray(along >= np.cos(np.deg2rad(WALL_DEG)) * np.linalg.norm(turned, axis=1))


SEVERAL = -1  # stands for several views, or for an unknown view
MAX_BOXES = (
    1 << 21
)  # most boxes of the grid along one axis, so that three axes fit into a 63-bit key


@dataclass(frozen=True)
class Merged:
    """One cloud of several views."""

    cloud: Cloud
    T_reference_cloud: np.ndarray
    """(4, 4): from the cloud's frame to the first view's camera frame."""
    views_used: tuple[str, ...]
    """Names of the merged views."""
    seconds: float
    """Time taken by the merge."""
    notes: tuple[str, ...] = ()
    """Views that were left out, and remarks of the merge."""
    surface_map: SurfaceMap | None = None
    """Further results of a fused map."""


@dataclass(frozen=True)
class Mapped:
    """Views, their registrations, and the cloud that they form."""

    views: tuple[PreparedView, ...]
    registrations: tuple[Registration, ...]
    merged: Merged

    def view_of_points(self) -> np.ndarray:
        """Return (n,) for each point of the merged cloud the index of its view in
        ``merged.views_used``, or `SEVERAL`. A map knows its views; else it is that of the nearest
        point, or several if another has one within twice that."""
        merged = self.merged
        count = merged.cloud.valid.size
        if merged.surface_map is not None:
            seen_by = merged.surface_map.seen_by.reshape(-1, count)
            return np.where(seen_by.sum(axis=0) == 1, seen_by.argmax(axis=0), SEVERAL)
        points = merged.cloud.points_m.reshape(-1, 3)
        finite = np.isfinite(points).all(axis=1)
        pairs = zip(self.views, self.registrations, strict=True)
        distances = []
        for view, registration in pairs:
            if registration.view in merged.views_used:
                placed = transform_points(registration.T_reference_view, view.points_m)
                distances.append(cKDTree(placed).query(points[finite])[0])
        nearest = np.argmin(distances, axis=0)
        distances.append(np.full(finite.sum(), np.inf))
        least, second = np.sort(distances, axis=0)[:2]
        indices = np.full(count, SEVERAL)
        indices[finite] = np.where(second <= 2 * least, SEVERAL, nearest)
        return indices


def prepare(view: View, config: MappingConfig) -> PreparedView:
    """Cut the target out of a view and find its marks. Raises UserError if the crop leaves
    nothing."""
    inside = crop(view.cloud, config.crop)
    return PreparedView(view, inside, find_marks(view.cloud, inside, config.marks))


def merge(
    views: Sequence[PreparedView],
    registrations: Sequence[Registration],
    config: AnyMerge,
) -> Merged:
    """Merge the views, or the single view, whose registration did not fail. Raises UserError if no
    view is left, or if the settings ask for too many cells."""
    began = time.perf_counter()
    chosen = list[ChosenView]()
    left_out = tuple[str, ...]()
    for prepared, registration in zip(views, registrations, strict=True):
        cloud = prepared.view.cloud
        name = prepared.view.name
        view = ChosenView(name, cloud, prepared.inside & cloud.valid, registration)
        if registration.failure:
            left_out += (f"{name} left out: {registration.failure}",)
        elif not view.inside.any():
            left_out += (f"{name} left out: none of its points belong to the target",)
        else:
            chosen.append(view)
    if not chosen:
        legal = "at least one view that is registered and holds points of the target"
        fix = "correct the views or their crop, or choose another registration method"
        raise UserError(f"no view is left to merge: {'; '.join(left_out)}", legal=legal, fix=fix)
    T_reference_cloud = np.eye(4)
    surface_map = None
    notes = tuple[str, ...]()
    if isinstance(config, GridMerge):
        cloud = _on_grid(chosen, config.step_mm * MM)
    elif isinstance(config, FusedMerge):
        cell_m = None if config.cell_mm is None else config.cell_mm * MM
        cloud, T_reference_cloud, surface_map, notes = fuse(chosen, cell_m)
    else:
        voxel_m = None if config.voxel_mm is None else config.voxel_mm * MM
        cloud, notes = integrate(chosen, voxel_m)
    return Merged(
        cloud=cloud,
        T_reference_cloud=T_reference_cloud,
        views_used=tuple(view.name for view in chosen),
        seconds=time.perf_counter() - began,
        notes=left_out + notes,
        surface_map=surface_map,
    )


def _on_grid(views: Sequence[ChosenView], step_m: float) -> Cloud:
    """The thesis' merge (MATLAB's pcmerge) as an unorganised cloud in the first view's frame:
    boxes in the order of x, then y, then z; then the rest. Raises UserError if there are more
    boxes along an axis than can be numbered. The overlap of the clouds' axis-parallel bounding
    boxes is divided into boxes from its lowest corner; each box with points becomes their plain
    mean, in place and in colour; points beyond the overlap stay. Of more than two clouds all go
    into one grid, over the union of the pairwise overlaps, where pcmerge called in turn would
    weight a late cloud more. ``count``: samples of all points of a box; ``variance_m2``: their
    mean variance; ``n_frames``: the least."""
    limits = []
    for view in views:
        points = view.points_reference_m
        limits.append((points.min(axis=0), points.max(axis=0)))
    # x, y, z, red, green, blue, amplitude, samples, samples times variance, number of points
    columns = np.concatenate([_columns(view) for view in views])
    points = columns[:, :3]
    boxes_around = np.zeros(len(points), dtype=int)
    for low, high in limits:
        boxes_around += ((points >= low) & (points <= high)).all(axis=1)
    shared = boxes_around > 1
    sums = columns[~shared]
    if shared.any():
        box_sums = _sums_of_boxes(columns[shared], _lowest_corner(limits), step_m)
        sums = np.concatenate([box_sums, sums])
    clouds = [view.cloud for view in views]
    n = sums[:, 9:]
    samples = sums[:, 7]
    # MATLAB rounds mean colours
    rgb = None
    if all(cloud.rgb is not None for cloud in clouds):
        rgb = np.floor(sums[:, 3:6] / n + 0.5).astype(np.uint8)[None]
    amplitude = None
    if all(cloud.amplitude is not None for cloud in clouds):
        amplitude = (sums[:, 6] / n[:, 0])[None]
    return Cloud(
        points_m=(sums[:, :3] / n)[None],
        reason=np.zeros((1, len(sums)), dtype=np.uint8),
        count=np.round(samples).astype(np.int32)[None],
        variance_m2=(sums[:, 8] / samples)[None],
        region=Region(0, 1, 0, len(sums)),
        z_step_m=max(cloud.z_step_m for cloud in clouds),
        n_frames=min(cloud.n_frames for cloud in clouds),
        organised=False,
        rgb=rgb,
        amplitude=amplitude,
        left_out=tuple(reason for cloud in clouds for reason in cloud.left_out),
    )


def _lowest_corner(limits: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the lowest corner (3,) of the overlaps of two clouds each, by the lowest and highest
    corners (3,) of all clouds, of which at least two overlap."""
    corners = []
    for (low, high), (other_low, other_high) in combinations(limits, 2):
        corner = np.maximum(low, other_low)
        if (corner <= np.minimum(high, other_high)).all():
            corners.append(corner)
    return np.asarray(np.min(corners, axis=0))


def _sums_of_boxes(columns: np.ndarray, corner: np.ndarray, step_m: float) -> np.ndarray:
    """Return the sums (b, c) of the columns (n, c), of which the first three are points, over the
    boxes that hold any, counted from a corner (3,). Raises UserError if there are too many along
    an axis."""
    points = columns[:, :3]
    boxes = np.floor((points - corner) / step_m)
    if boxes.max() >= MAX_BOXES:
        extent_m = np.ptp(points, axis=0).max()
        problem = f"{extent_m:.3g} m hold too many boxes of {step_m * 1e3:.3g} mm"
        fix = "crop the views to the target, or raise merge.step_mm"
        raise UserError(problem, legal=f"up to {MAX_BOXES} boxes along an axis", fix=fix)
    # one number for each box, with 21 bits for each axis
    x, y, z = boxes.astype(np.int64).T
    keys = (x << 42) | (y << 21) | z
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return np.asarray(np.add.reduceat(columns[order], starts, axis=0))


def _columns(view: ChosenView) -> np.ndarray:
    """Return (n, 10), NaN where unknown."""
    cloud = view.cloud
    inside = view.inside
    count = cloud.count[inside].astype(np.float64)
    unknown = np.full(len(count), np.nan)
    colour = [unknown] * 3
    if cloud.rgb is not None:
        colour = list(cloud.rgb[inside].T)
    amplitude = unknown
    if cloud.amplitude is not None:
        amplitude = cloud.amplitude[inside]
    return np.column_stack(
        [
            view.points_reference_m,
            *colour,
            amplitude,
            count,
            count * cloud.variance_m2[inside],
            np.ones(len(count)),
        ]
    )
