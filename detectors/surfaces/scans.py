"""Captures as references: an earlier capture of the part, or the mean of several good parts, with
the variance of each place.

Points become triangles between neighbours in the view. A capture is placed by marks that both show,
else by the outline and the relief: from the same orientation, then from those of its principal
axes. Its variance is that of its average; of several good parts it is that of the mean and how
much parts differ beyond the noise. Parts must show the same side of the part, within some 60
degrees. Not modelled: a fixed pattern of the unit, which cancels where the part lies at the same
pixels and else counts as a difference between parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from detectors.pixels.medians import group_medians
from detectors.pixels.noise import average_variance_m2, rounding_floor, sigma_of
from detectors.surfaces.expected import (
    LARGER,
    LEAST_OVERLAP,
    SMALLER,
    KnownPose,
    Pose,
    Triangles,
    another_part,
    diagonal,
    expected,
    few_of,
    fitted,
    met,
    normals_of,
    refined,
    sampled,
    spacing,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, ExpectedSurface, invert

LEAST_POINTS = 100
"""Fewest points of a part: with less, cells of 16 do not span a surface."""
LONGEST_EDGES = 3.0
"""Longest edge of a triangle, in typical edges: longer ones span gaps of the view."""
COARSE = 4.0
"""Side, in typical edges, of the cells whose medians place a scan: their noise is a quarter of a
pixel's, so that it hardly turns the triangles."""
FEW = 150
"""Points that choose among orientations: their mean distance is known to a tenth."""
BETTER = 0.8
"""Another orientation is taken if its mean distance is less than this share of the first's."""
SCATTER_PX = 5
"""Side of the window over which the scatter of parts is averaged."""
PRIOR_PARTS = 3.0
"""The scatter of all places counts like that of so many further parts at each place."""


@dataclass(frozen=True, eq=False)
class PartScan:
    """A part as captures show it, in the camera frame of the first of them."""

    name: str
    """What it is, in words."""
    points_m: np.ndarray
    """(n, 3): its points."""
    variances_m2: np.ndarray
    """(n,): variance of each along its ray, as a statement about the next part."""
    noise_m2: np.ndarray
    """(n,): the part of it that is noise of the captures."""
    triangles: Triangles
    """Its surface."""
    coarse: Triangles
    """The same through medians of cells."""
    pitch_m: float
    """Typical distance between neighbours."""
    share_px: float
    """Number of neighbours that share their noise."""
    parts: int = 1
    """Number of parts."""


def noise_m2_of(cloud: Cloud, mask: np.ndarray) -> np.ndarray:
    """Return the variance (n,) of the averaged z at the pixels of ``mask`` (h, w): from the scatter
    of the frames, or from that of neighbours if there are too few frames."""
    floor_m2 = rounding_floor(cloud, mask) ** 2
    variances_m2 = average_variance_m2(cloud, mask)
    if variances_m2 is not None:
        return np.asarray(np.maximum(variances_m2[mask], floor_m2))
    points = cloud.points_m[mask]
    # neighbours in the view share a plane through the five nearest
    plan = _plan(points, cloud.projection == "central")
    sample = np.arange(0, len(points), max(1, len(points) // 5000))
    _, neighbours = cKDTree(plan).query(plan[sample], k=min(7, len(points)))
    bends_m = points[sample, 2] - points[neighbours[:, 1:], 2].mean(axis=1)
    noise_m2 = sigma_of(bends_m) ** 2 / (1.0 + 1.0 / (neighbours.shape[1] - 1))
    return np.full(len(points), max(noise_m2, floor_m2))


def scan_of(cloud: Cloud, mask: np.ndarray, name: str) -> PartScan:
    """Return the part that a cloud shows where ``mask`` (h, w) is true. Raises UserError if the
    points span no surface."""
    noise_m2 = noise_m2_of(cloud, mask)
    return _scan(
        name,
        cloud.points_m[mask],
        central=cloud.projection == "central",
        variances_m2=noise_m2,
        noise_m2=noise_m2,
        share_px=max(cloud.noise_reach_px, 1.0) ** 2,
        parts=1,
    )


def _scan(
    name: str,
    points_m: np.ndarray,
    *,
    central: bool,
    variances_m2: np.ndarray,
    noise_m2: np.ndarray,
    share_px: float,
    parts: int,
) -> PartScan:
    plan = _plan(points_m, central)
    no_surface = UserError(
        f"{name}: {len(points_m)} points of the part span no surface",
        fix="record more of the part, or choose another surface (--target, --crop)",
    )
    if len(points_m) < LEAST_POINTS:
        raise no_surface
    faces, edge = _faces(plan)
    if not len(faces):
        raise no_surface
    # cells of the view, each with the median of its points
    cells = np.floor((plan - plan.min(axis=0)) / (COARSE * edge)).astype(np.int64)
    _, group = np.unique(cells, axis=0, return_inverse=True)
    group = group.ravel()
    count = int(group.max()) + 1
    medians_m, _ = group_medians(points_m[:, 2], group, count)
    sizes = np.bincount(group, minlength=count)
    middles = np.column_stack(
        [np.bincount(group, plan[:, axis], count) / sizes for axis in range(2)]
    )
    scale = medians_m[:, None] if central else 1.0
    coarse_m = np.column_stack([middles * scale, medians_m])
    coarse_faces, _ = _faces(middles)
    if not len(coarse_faces):
        raise no_surface
    triangles = _towards_viewer(points_m, faces, variances_m2, central)
    sides_m = np.linalg.norm(triangles.corners_m[:, 0] - triangles.corners_m[:, 1], axis=1)
    return PartScan(
        name=name,
        points_m=points_m,
        variances_m2=variances_m2,
        noise_m2=noise_m2,
        triangles=triangles,
        coarse=_towards_viewer(coarse_m, coarse_faces, np.zeros(count), central),
        pitch_m=float(np.median(sides_m)),
        share_px=share_px,
        parts=parts,
    )


def _plan(points_m: np.ndarray, central: bool) -> np.ndarray:
    """Return the places (n, 2) of points in the view."""
    return points_m[:, :2] / points_m[:, 2:] if central else points_m[:, :2]


def _faces(plan: np.ndarray) -> tuple[np.ndarray, float]:
    """Return triangles (m, 3) between neighbours of places (n, 2), without those that span gaps,
    and the length of a typical edge. No triangles and 0 if the places lie on a line."""
    try:
        faces = Delaunay(plan).simplices
    except (QhullError, ValueError):
        return np.zeros((0, 3), np.int64), 0.0
    corners = plan[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    typical = float(np.median(edges))
    return faces[edges.max(axis=1) < LONGEST_EDGES * typical], typical


def _towards_viewer(
    points_m: np.ndarray, faces: np.ndarray, variances_m2: np.ndarray, central: bool
) -> Triangles:
    """Return triangles of points whose normals face the viewer."""
    corners = points_m[faces]
    normals = normals_of(corners)
    rays = corners.mean(axis=1) if central else np.array([[0.0, 0.0, 1.0]])
    away = (normals * rays).sum(axis=1) > 0
    normals[away] *= -1.0
    has_normal = np.isfinite(normals).all(axis=1)
    return Triangles(corners, normals, variances_m2[faces]).chosen(has_normal)


# ---------------------------------------------------------------- where it lies


def placed(
    scan: PartScan, points_m: np.ndarray, share_px: float, central: bool, known: KnownPose | None
) -> Pose:
    """Return the pose of a part's points (n, 3) on a scan. ``central``: their rays leave the lens;
    ``known``: the pose by marks."""
    sample = sampled(points_m)
    shared = max(1.0, share_px * len(sample) / len(points_m))
    if known is not None:
        best = fitted(scan.coarse, sample, known.T_part_camera, known, share_px=shared)
    else:
        coarse = _coarse_pose(scan, points_m, few_of(sample, FEW))
        best = fitted(scan.coarse, sample, coarse.T_part_camera, share_px=shared)
    return refined(scan.triangles, best, sample, central=central, known=known, share_px=shared)


def _coarse_pose(scan: PartScan, points_m: np.ndarray, few_m: np.ndarray) -> Pose:
    """Return the pose at which some of a part's points (n, 3) come closest to a scan. All starts
    are tried: the outline of a part that lies upside down may fit to a pixel. All points go on from
    this pose, not from its start, since they reach less far (`fitted`)."""
    starts = _starts(scan.points_m, points_m)
    poses = [fitted(scan.coarse, few_m, start) for start in starts]
    best = poses[0]
    for pose in poses[1:]:
        if pose.apart_m < BETTER * best.apart_m:
            best = pose
    return best


def _starts(scan_m: np.ndarray, part_m: np.ndarray) -> list[np.ndarray]:
    """Return T_scan_part (4, 4) that lay the planes and middles on one another: with the part as
    upright as in the scan, then with its principal axes in four directions."""
    scan_frame = _frame(scan_m)
    part_frame = _frame(part_m)
    to_scan = invert(scan_frame.upright)
    starts = [to_scan @ part_frame.upright]
    for turn in range(4):
        quarter = np.eye(4)
        angle = turn * np.pi / 2
        c, s = np.rint([np.cos(angle), np.sin(angle)])
        quarter[:2, :2] = [[c, -s], [s, c]]
        starts.append(invert(scan_frame.principal) @ quarter @ part_frame.principal)
    return starts


@dataclass(frozen=True, eq=False)
class _PlaneFrames:
    """Two frames on a part's plane, z to the camera: transforms from the camera's (4, 4)."""

    upright: np.ndarray
    """y as close to the camera's as possible."""
    principal: np.ndarray
    """x along the longest extent."""


def _frame(points_m: np.ndarray) -> _PlaneFrames:
    middle_m = np.median(points_m, axis=0)
    arms = points_m - points_m.mean(axis=0)
    _, axes = np.linalg.eigh(arms.T @ arms)
    normal = axes[:, 0] if axes[2, 0] < 0 else -axes[:, 0]
    return _PlaneFrames(
        upright=_facing(normal, np.array([1.0, 0.0, 0.0]), middle_m),
        principal=_facing(normal, axes[:, 2], middle_m),
    )


def _facing(normal: np.ndarray, along: np.ndarray, middle_m: np.ndarray) -> np.ndarray:
    """Return the transform to a frame at ``middle_m`` with z along the normal and x towards
    ``along``."""
    x = along - (along @ normal) * normal
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(normal, x), normal])
    T[:3, 3] = -T[:3, :3] @ middle_m
    return T


# ---------------------------------------------------------------- what it says of a cloud


def laid_under(
    scan: PartScan, cloud: Cloud, mask: np.ndarray, known: KnownPose | None = None
) -> ExpectedSurface:
    """Return what a scan says that a cloud should show where ``mask`` (h, w) is true. ``known``:
    the pose by marks. Raises UserError if the scan does not show this part."""
    central = cloud.projection == "central"
    points_m = cloud.points_m[mask]
    part_m = diagonal(points_m)
    reference_m = diagonal(scan.points_m)
    if not reference_m / SMALLER < part_m < LARGER * reference_m:
        raise UserError(
            f"{scan.name}: is {reference_m / MM:.3g} mm large, and this part {part_m / MM:.3g} mm",
            legal=f"a part of {1 / SMALLER:g} to {LARGER:g} times the reference's size",
            fix="state a unit that holds for both (--unit), or choose the same surface in both"
            " (--target, --crop)",
        )
    share_px = max(cloud.noise_reach_px, 1.0) ** 2
    pose = placed(scan, points_m, share_px, central, known)
    z_m, variances_m2 = met(scan.triangles, pose.T_part_camera, _plan(points_m, central), central)
    off_m = points_m[:, 2] - z_m
    overlap = float(np.isfinite(off_m).mean())
    if overlap < LEAST_OVERLAP:
        raise UserError(
            f"{scan.name}: shows {100 * overlap:.0f} % of the part",
            legal=f"a reference that shows at least {100 * LEAST_OVERLAP:.0f} %",
            fix="record the part as the reference was recorded, or choose the same surface"
            " (--target, --crop)",
        )
    noise_m2 = noise_m2_of(cloud, mask)
    doubt = another_part(points_m, off_m, np.nan_to_num(variances_m2) + noise_m2)
    if doubt:
        raise UserError(
            f"{scan.name}: is not this part: {doubt}",
            fix="name a reference of this part, or choose the same surface in both (--target,"
            " --crop)",
        )
    median_off_m = float(np.nanmedian(np.abs(off_m)))
    return expected(
        scan.triangles,
        pose,
        pitch=spacing(_plan(points_m, central)),
        central=central,
        is_sharp=False,
        text=_text(scan, pose, median_off_m, known is not None),
        facts=_facts(scan, pose, median_off_m, overlap, known is not None),
    )


def _text(scan: PartScan, pose: Pose, median_off_m: float, by_marks: bool) -> str:
    """Return what the reference is and how well it fits, in words."""
    method = "by marks and surface" if by_marks else "by outline and surface"
    return (
        f"{scan.name}, placed {method}, with half of the points within {median_off_m / MM:.2g} mm"
        f" of it; {pose.error_m / MM:.2g} mm along its normals (standard error)"
    )


def _facts(
    scan: PartScan, pose: Pose, median_off_m: float, overlap: float, by_marks: bool
) -> dict[str, Any]:
    return {
        "name": scan.name,
        "parts": scan.parts,
        "placed_by": "marks and surface" if by_marks else "outline and surface",
        "T_reference_camera": pose.T_part_camera.tolist(),
        "covariance": pose.covariance.tolist(),
        "covariance_about_mm": (pose.middle_m / MM).tolist(),
        "median_off_mm": median_off_m / MM,
        "standard_error_mm": pose.error_m / MM,
        "overlap": overlap,
    }


# ---------------------------------------------------------------- several good parts


@dataclass(frozen=True, eq=False)
class GoodParts:
    """Several good parts on the places of the first."""

    first: PartScan
    """The part on whose places the others lie."""
    central: bool
    """Whether its rays leave the lens, else they are parallel."""
    heights_m: np.ndarray
    """(k, n): z of each part along the first one's rays, NaN where it shows nothing."""
    noises_m2: np.ndarray
    """(k, n): variance of that z by the noise of its capture."""

    def first_parts(self, count: int) -> GoodParts:
        """Return the first ``count`` parts."""
        return GoodParts(self.first, self.central, self.heights_m[:count], self.noises_m2[:count])

    def mean(self, name: str, left_out: int | None = None) -> PartScan:
        """Return the mean of all parts, or of all but one, with the variance of the next part.

        With k parts the mean's error is 1/k of the scatter. The scatter of one place is known
        from k - 1 differences, so that it is averaged over `SCATTER_PX` and drawn towards that of
        all."""
        kept = np.arange(len(self.heights_m)) != left_out
        heights_m = self.heights_m[kept]
        count = np.isfinite(heights_m).sum(axis=0)
        is_measured = count >= max(1, len(heights_m) // 2)
        heights_m = heights_m[:, is_measured]
        count = count[is_measured]
        mean_m = np.nanmean(heights_m, axis=0)
        squares_m2 = np.nansum((heights_m - mean_m) ** 2, axis=0)
        noise_m2 = np.nanmean(self.noises_m2[kept][:, is_measured], axis=0)
        points_m = self.first.points_m[is_measured]
        scatter_m2 = noise_m2
        if len(heights_m) > 1:
            scatter_m2 = _scatter(_plan(points_m, self.central), squares_m2, count - 1.0)
        differing_m2 = np.maximum(scatter_m2 - noise_m2, 0.0)
        scale = mean_m / points_m[:, 2] if self.central else np.ones(len(mean_m))
        return _scan(
            name,
            np.column_stack([points_m[:, :2] * scale[:, None], mean_m]),
            central=self.central,
            variances_m2=differing_m2 + np.maximum(scatter_m2, noise_m2) / count,
            noise_m2=noise_m2 / count,
            share_px=self.first.share_px,
            parts=len(heights_m),
        )


def good_parts(
    first: PartScan, others: Sequence[tuple[PartScan, KnownPose | None]], central: bool
) -> GoodParts:
    """Lay good parts on the first. ``others``: each with the pose of the first on it by marks, if
    it is known; ``central``: whether the first one's rays leave the lens. Raises UserError for a
    part that is not like the first."""
    rays = _plan(first.points_m, central)
    heights_m = [first.points_m[:, 2]]
    noises_m2 = [first.noise_m2]
    for scan, known_pose in others:
        pose = placed(scan, first.points_m, first.share_px, central, known_pose)
        z_m, noise_m2 = met(scan.triangles, pose.T_part_camera, rays, central)
        off_m = first.points_m[:, 2] - z_m
        overlap = float(np.isfinite(off_m).mean())
        doubt = f"it shows {100 * overlap:.0f} % of it"
        if overlap >= LEAST_OVERLAP:
            doubt = another_part(first.points_m, off_m, first.noise_m2 + np.nan_to_num(noise_m2))
        if doubt:
            raise UserError(
                f"{scan.name}: is not like {first.name}: {doubt}",
                fix="keep only captures of good parts, all of the same surface, in the folder",
            )
        heights_m.append(z_m)
        noises_m2.append(noise_m2)
    return GoodParts(first, central, np.stack(heights_m), np.stack(noises_m2))


def _scatter(rays: np.ndarray, squares_m2: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Return the variance (n,) between parts at places (n, 2) of the view, from sums of squares
    with so many degrees of freedom."""
    _, edge = _faces(rays)
    cells = np.floor((rays - rays.min(axis=0)) / edge).astype(np.int64)
    shape = tuple(cells.max(axis=0) + 1)
    sums = np.zeros(shape)
    counts = np.zeros(shape)
    np.add.at(sums, tuple(cells.T), squares_m2)
    np.add.at(counts, tuple(cells.T), freedom)
    side = (SCATTER_PX, SCATTER_PX)
    border = cv2.BORDER_CONSTANT
    # sums over the window of one place's squares and degrees of freedom
    window_m2 = cv2.blur(sums, side, borderType=border)[tuple(cells.T)]
    near_freedom = cv2.blur(counts, side, borderType=border)[tuple(cells.T)]
    typical_m2 = squares_m2.sum() / max(freedom.sum(), 1.0)
    return np.asarray((window_m2 + PRIOR_PARTS * typical_m2) / (near_freedom + PRIOR_PARTS))
