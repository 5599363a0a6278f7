"""The surface that a reference says a cloud should show: triangles with a variance at each corner,
placed on the cloud and met by its rays.

An earlier capture, good parts and a drawing differ in how their triangles come about
(`detectors.surfaces.scans`, `detectors.surfaces.drawing`), not in what a detector receives.

Closest points, then closest planes, move the cloud onto the triangles (Besl and McKay 1992; Chen
and Medioni 1992); points off them count less (Tukey). Where marks state the pose, the planes
refine it, and both count by their covariances. A direction that neither fixes, such as a shift of
a plane along itself, is known by the outline to a pixel. Not modelled: a part that bends between
the captures, and an error of range that a whole capture shares, which the placement absorbs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from detectors.pixels.noise import median_of
from detectors.rigid_motion import displacement_jacobian, kabsch, moved_by
from detectors.surfaces.surface import (
    BISQUARE_TUNING,
    SurfaceConfig,
    bisquare_weights,
    fit_surface,
)
from detectors.surfaces.triangle_tree import TriangleTree, closest_places, first_hits, tree_of
from harness.vocabulary.geometry import (
    MM,
    ExpectedSurface,
    invert,
    rotate_vectors,
    transform_points,
)

SAMPLE = 4000
STEPS = 20
"""Number of steps by closest points (twice as many by distances follow, then as many by planes).
"""
LEAST_SCALE_M = 0.1 * MM
FAR_M = 10.0
EDGE_PX = 1.5  # pixels within this distance of a step or edge of the part are not judged
BENT = 0.5
"""Bend, in pixels, that makes an edge."""
REFINEMENTS = 40
"""Most steps along rays."""
STILL = 1e-4
"""Step along rays, in pixels, after which no further follows. On the mean of several parts, steps
shrink slowly: eight end 0.1 pixels too early."""
NOISE_MARGIN = 2.0
"""Multiple of the information that noise feigns which is taken off: rounding and filters make it
differ from that of independent pixels."""
BEND_NOISE = 24.0
"""A second difference of noise has 6 of its variances, and its square is below 4 times that in 95 %
of places."""
BETWEEN = 0.25
"""Most that a straight line between two samples is off a kink between them, as a share of the
second difference."""
LARGER = 2.0
"""Ratio of the target's size to the reference's from which that cannot show the part."""
SMALLER = 10.0
"""Ratio of the reference's size to the target's from which its outline cannot place the target."""
LEAST_OVERLAP = 0.5
"""Least share of the part's points that the reference must show."""
WORSE = 1.5
"""A reference is another part if the part lies off it by more than this many times what it lies
off a cubic surface, ..."""
BEYOND_NOISE = 3.0
"""... by more than this many deviations of the noise of both, ..."""
APART_M = 2.0 * MM
"""... and by more than this, which is where registered views count as different targets, too."""
MOST = 0.8
"""Share of the part, nearest first, on which this and starts are judged: damage may cover the
rest."""
# a direction with a smaller share of the largest information is not fixed by the part
LOOSE = 1e-6


@dataclass(frozen=True, eq=False)
class Triangles:
    """The surface of a part in its own frame."""

    corners_m: np.ndarray
    """(m, 3, 3): the corners of each triangle."""
    normals: np.ndarray
    """(m, 3): unit normals, out of the part."""
    variances_m2: np.ndarray
    """(m, 3): variance of each corner along the rays; 0 for a drawing."""

    @cached_property
    def tree(self) -> TriangleTree:
        """The triangles for rays and closest points, identified by their numbers."""
        return tree_of(self.corners_m)

    @property
    def middle_m(self) -> np.ndarray:
        """(3,): median of the corners."""
        return np.asarray(np.median(self.corners_m.reshape(-1, 3), axis=0))

    def chosen(self, mask: np.ndarray) -> Triangles:
        """Return the triangles where ``mask`` (m,) is true."""
        return Triangles(self.corners_m[mask], self.normals[mask], self.variances_m2[mask])


def normals_of(corners_m: np.ndarray) -> np.ndarray:
    """Return the unit normals (m, 3) of triangles (m, 3, 3), by the order of their corners."""
    first_side = corners_m[:, 1] - corners_m[:, 0]
    second_side = corners_m[:, 2] - corners_m[:, 0]
    normals = np.cross(first_side, second_side)
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Pose:
    """A pose of a cloud on triangles."""

    T_part_camera: np.ndarray
    """(4, 4): rigid."""
    off_m: float
    """Median distance of the points from the triangles' planes."""
    apart_m: float
    """Mean distance of the points from the triangles, beyond their edges too."""
    nearest_m: float
    """The same of those `MOST` of the points that are nearest."""
    error_m: float
    """Root mean square standard error along the planes of where the triangles lie, if the points
    are independent."""
    covariance: np.ndarray
    """(6, 6): of a small motion (w, t) of the points about ``middle_m``, radians and metres."""
    middle_m: np.ndarray
    """(3,): centre of the small rotation, part's frame."""


@dataclass(frozen=True, eq=False)
class KnownPose:
    """A pose from elsewhere, such as marks."""

    T_part_camera: np.ndarray
    """(4, 4): rigid."""
    covariance: np.ndarray
    """(6, 6): as `Pose.covariance`, about ``middle_m``."""
    middle_m: np.ndarray
    """(3,): part's frame."""

    def information_about(self, middle_m: np.ndarray) -> np.ndarray:
        """Return the inverse (6, 6) of the covariance of the same motion about another centre."""
        # w' = w, and t' = t + w x (middle' - middle) is how the other centre moves
        moved = np.eye(6)
        moved[3:] = displacement_jacobian(middle_m[None], self.middle_m)[0]
        return np.linalg.inv(moved @ self.covariance @ moved.T)

    def offset_of(self, T_part_camera: np.ndarray, middle_m: np.ndarray) -> np.ndarray:
        """Return the motion (6,) about ``middle_m`` from this pose to another."""
        change = T_part_camera @ invert(self.T_part_camera)
        turn = Rotation.from_matrix(change[:3, :3]).as_rotvec()
        return np.concatenate([turn, transform_points(change, middle_m) - middle_m])


def spacing(points: np.ndarray) -> float:
    """Return the side of a square with one of the points (n, 3), in x and y."""
    extent = np.ptp(points[:, :2], axis=0)
    return float(np.sqrt(np.prod(extent) / len(points)))


def diagonal(points: np.ndarray) -> float:
    """Return the diagonal of the box around points (n, 3), without the outermost hundredth."""
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    return float(np.linalg.norm(high - low))


def sampled(points: np.ndarray) -> np.ndarray:
    """Return some `SAMPLE` of points (n, 3), evenly strided."""
    return few_of(points, SAMPLE)


def few_of(sample: np.ndarray, count: int) -> np.ndarray:
    """Return some ``count`` of points (n, 3), evenly strided."""
    return sample[:: max(1, len(sample) // count)]


def fitted(
    triangles: Triangles,
    points: np.ndarray,
    T_start: np.ndarray,
    known: KnownPose | None = None,
    share_px: float = 1.0,
) -> Pose:
    """Move points (n, 3) from ``T_start`` (part's frame from the points') onto the triangles.

    A point counts within a few of the points' spacings at least: the sparser they are, the farther
    from its start a part is found, and the less precisely.

    ``known``: a pose that counts by its covariance, at which the search starts by planes;
    ``share_px``: number of points that share their noise."""
    T = T_start
    pitch_m = spacing(points)
    information = np.zeros((6, 6))
    feet: np.ndarray | None = None
    for step in range(3 * STEPS if known else 0, 4 * STEPS):
        by_planes = step >= 3 * STEPS
        moved = transform_points(T, points)
        triangle, feet = closest_places(triangles.tree, moved, feet)
        offsets = moved - feet
        towards = triangles.normals[triangle]
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
        if known is None:
            # no motion along a direction that the part does not fix
            inverse = np.linalg.pinv(weighted @ slopes, rcond=LOOSE, hermitian=True)
            T = moved_by(-inverse @ weighted @ off, middle) @ T
            continue
        spread_m2 = share_px * scale_m**2
        information = known.information_about(middle)
        away = known.offset_of(T, middle)
        inverse = np.linalg.inv(weighted @ slopes / spread_m2 + information)
        T = moved_by(-inverse @ (weighted @ off / spread_m2 + information @ away), middle) @ T
    spread_m2 = float((weight * off**2).sum() / weight.sum())
    covariance = _covariance(
        weighted @ slopes / max(share_px * spread_m2, 1e-18),
        information,
        arm_m=float(np.sqrt(((moved - middle) ** 2).sum(axis=1).mean())),
        loosest_m=pitch_m,
    )
    inverse = np.linalg.pinv(weighted @ slopes, rcond=LOOSE, hermitian=True)
    variances = np.einsum("ni,ij,nj->n", slopes, inverse, slopes)
    distances_m = np.sort(np.linalg.norm(offsets, axis=1))
    return Pose(
        T_part_camera=T,
        off_m=float(np.median(np.abs(off))),
        apart_m=float(distances_m.mean()),
        nearest_m=float(distances_m[: math.ceil(MOST * len(distances_m))].mean()),
        error_m=float(np.sqrt(spread_m2 * variances.mean())),
        covariance=covariance,
        middle_m=middle,
    )


def _covariance(
    of_surface: np.ndarray, of_start: np.ndarray, *, arm_m: float, loosest_m: float
) -> np.ndarray:
    """Return the inverse (6, 6) of the information on a motion (w, t) about the middle of points
    that lie ``arm_m`` from it: that of the surface, where it holds any, and that of the start. No
    direction moves the points by more than ``loosest_m``."""
    unit = np.array([1.0 / arm_m] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(of_surface * np.outer(unit, unit))
    information = (vectors * np.maximum(values, 0.0)) @ vectors.T
    information += of_start * np.outer(unit, unit)
    values, vectors = np.linalg.eigh(information)
    variances = 1.0 / np.maximum(values, loosest_m**-2)
    return np.asarray((vectors * variances) @ vectors.T * np.outer(unit, unit))


def expected(
    triangles: Triangles,
    pose: Pose,
    *,
    pitch: float,
    central: bool,
    is_sharp: bool,
    text: str,
    facts: dict[str, Any],
) -> ExpectedSurface:
    """Return the placed triangles as seen along rays from the lens (``central``) or along z.

    ``pitch``: distance of neighbouring rays, at z = 1 if they are central; ``is_sharp``: the
    triangles have steps that a camera mixes with what lies beside them, as a drawing has, so that
    nothing is expected within `EDGE_PX` of one."""

    def rays_of(queries: np.ndarray) -> np.ndarray:
        return queries[:, :2] / queries[:, 2:] if central else queries[:, :2]

    def z_at(queries: np.ndarray) -> np.ndarray:
        rays = rays_of(queries)
        z, _ = met(triangles, pose.T_part_camera, rays, central)
        if not is_sharp:
            return z
        bends = _bends(triangles, pose, rays, z, EDGE_PX * pitch, central)
        limit = BENT * pitch * (np.abs(z) if central else 1.0)
        return np.where(np.abs(bends).max(axis=0) < limit, z, np.nan)

    def spread_at(queries: np.ndarray) -> np.ndarray:
        rays = rays_of(queries)
        z, variances_m2 = met(triangles, pose.T_part_camera, rays, central)
        if is_sharp:
            return np.sqrt(variances_m2)
        bends = np.nan_to_num(_bends(triangles, pose, rays, z, pitch, central))
        beyond_m2 = (bends**2).max(axis=0) - BEND_NOISE * variances_m2
        return np.sqrt(variances_m2 + np.maximum(beyond_m2, 0.0) * BETWEEN**2)

    def registration_at(queries: np.ndarray) -> np.ndarray:
        rays = rays_of(queries)
        values, vectors = np.linalg.eigh(pose.covariance)
        motions = (np.sqrt(np.maximum(values, 0.0)) * vectors).T
        poses = [pose.T_part_camera]
        for motion in (*motions, *-motions):
            poses.append(moved_by(motion, pose.middle_m) @ pose.T_part_camera)
        z_m, _ = met_from(poses, triangles, rays, central)
        changes_m = np.abs(z_m[1:] - z_m[0])
        # beside an edge only one of the two directions may meet the part
        of_motions_m = np.nan_to_num(np.fmax(changes_m[:6], changes_m[6:]))
        variances_m2 = (of_motions_m**2).sum(axis=0)
        return np.where(np.isfinite(z_m[0]), np.sqrt(variances_m2), np.nan)

    return ExpectedSurface(text, z_at, spread_at, registration_at, facts)


def _bends(
    triangles: Triangles,
    pose: Pose,
    rays: np.ndarray,
    z_m: np.ndarray,
    side: float,
    central: bool,
) -> np.ndarray:
    """Return the second differences (2, n) of z over ``side`` of the view, across and down."""
    bends = []
    for shift in ([side, 0], [0, side]):
        after, _ = met(triangles, pose.T_part_camera, rays + np.array(shift), central)
        before, _ = met(triangles, pose.T_part_camera, rays - np.array(shift), central)
        bends.append(after + before - 2 * z_m)
    return np.array(bends)


def refined(
    triangles: Triangles,
    pose: Pose,
    points: np.ndarray,
    *,
    central: bool,
    known: KnownPose | None = None,
    share_px: float = 1.0,
) -> Pose:
    """Return a pose at which the rays of points (n, 3) meet the triangles at the points' own z, as
    nearly as possible: steps and walls, which closest points blur, then fix the part along itself.

    Slopes are differences over two pixels, whose noise is independent of that of the pixel between
    them. What this noise adds to the information is taken off again, `NOISE_MARGIN` times.
    ``known`` and ``share_px`` as of `fitted`."""
    rays = points[:, :2] / points[:, 2:] if central else points[:, :2]
    T = pose.T_part_camera
    pitch_m = spacing(points)
    middle = transform_points(T, points).mean(axis=0)
    arms = transform_points(T, points) - middle
    arm_m = float(np.sqrt((arms**2).sum(axis=1).mean()))
    steps = pitch_m * np.array([1.0 / arm_m] * 3 + [1.0] * 3)
    # by the outline, the start is known to a pixel
    start = known or KnownPose(T, np.diag(steps**2), middle)
    for _ in range(REFINEMENTS):
        poses = [T]
        poses += [moved_by(motion, middle) @ T for motion in np.diag(steps)]
        poses += [moved_by(-motion, middle) @ T for motion in np.diag(steps)]
        z, variances_m2 = met_from(poses, triangles, rays, central)
        off = points[:, 2] - z[0]
        slopes = (z[1:7] - z[7:]).T / (2.0 * steps)
        is_met = np.isfinite(off) & np.isfinite(slopes).all(axis=1)
        off = off[is_met]
        slopes = slopes[is_met]
        scale_m = max(float(np.median(np.abs(off))) / 0.6745, LEAST_SCALE_M)
        weight = bisquare_weights(off, BISQUARE_TUNING * scale_m)
        spread_m2 = share_px * scale_m**2
        weighted = (slopes * weight[:, None]).T / spread_m2
        by_noise = _noise_information(
            displacement_jacobian(arms[is_met], np.zeros(3)),
            weight * variances_m2[is_met] / (2.0 * pitch_m**2 * spread_m2),
            _normal_of(arms),
        )
        information = start.information_about(middle)
        gradient = weighted @ off - information @ start.offset_of(T, middle)
        motion = np.linalg.inv(weighted @ slopes + information) @ gradient
        T = moved_by(motion, middle) @ T
        if np.abs(motion / steps).max() < STILL:
            break
    covariance = _covariance(
        weighted @ slopes - NOISE_MARGIN * by_noise, information, arm_m=arm_m, loosest_m=pitch_m
    )
    variances = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    return replace(
        pose,
        T_part_camera=T,
        off_m=float(np.median(np.abs(off))),
        error_m=float(np.sqrt(variances.mean())),
        covariance=covariance,
        middle_m=middle,
    )


def _normal_of(arms_m: np.ndarray) -> np.ndarray:
    """Return the unit normal (3,) of the plane through points (n, 3) about their middle."""
    _, axes = np.linalg.eigh(arms_m.T @ arms_m)
    return np.asarray(axes[:, 0])


def _noise_information(
    displacements: np.ndarray, shares: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Return the information (6, 6) that slopes of pure noise seem to hold: of shifts (n, 3, 6)
    along the plane with this normal, with ``shares`` (n,) for a unit shift along either axis."""
    within = np.eye(3) - np.outer(normal, normal)
    along = np.einsum("ij,njk->nik", within, displacements)
    return np.asarray(np.einsum("n,nik,nil->kl", shares, along, along))


def met(
    triangles: Triangles, T_part_camera: np.ndarray, rays: np.ndarray, central: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return z (n,) where rays meet the triangles, and the variance (n,) there: from the lens
    through (n, 2) at z = 1 (``central``), or along z at (n, 2). NaN where they meet none."""
    z, variances_m2 = met_from([T_part_camera], triangles, rays, central)
    return z[0], variances_m2


def met_from(
    poses: Sequence[np.ndarray], triangles: Triangles, rays: np.ndarray, central: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return z (k, n) as `met` does from each of several ``poses`` (4, 4), and the variance (n,)
    from the first.

    The poses are alike: rays through one place are traced one after the other, and find the
    triangles that they pass in the processor's cache."""
    if central:
        along = np.column_stack([rays, np.full(len(rays), 1.0)])
        starts = np.zeros(along.shape)
    else:
        starts = np.column_stack([rays, np.full(len(rays), -FAR_M)])
        along = np.eye(3)[[2] * len(rays)]
    by_place = (len(rays), len(poses), 3)
    origins = np.empty(by_place)
    ways = np.empty(by_place)
    for number, T_part_camera in enumerate(poses):
        origins[:, number] = transform_points(T_part_camera, starts)
        ways[:, number] = rotate_vectors(T_part_camera, along)
    origin = origins.reshape(-1, 3)
    ray = ways.reshape(-1, 3)
    triangle, shares = first_hits(triangles.tree, origin, ray)
    is_hit = triangle >= 0
    number_of = np.where(is_hit, triangle, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        normals = triangles.normals[number_of]
        reach = np.einsum("ni,ni->n", triangles.corners_m[number_of, 0] - origin, normals)
        reach /= np.einsum("ni,ni->n", ray, normals)
    z = np.where(is_hit, np.repeat(starts[:, 2], len(poses)) + reach, np.nan)
    first = slice(None, None, len(poses))
    variances_m2 = (shares[first] * triangles.variances_m2[number_of[first]]).sum(axis=1)
    return z.reshape(by_place[:2]).T, np.where(is_hit[first], variances_m2, np.nan)


def another_part(points_m: np.ndarray, off_m: np.ndarray, variances_m2: np.ndarray) -> str:
    """Return why points (n, 3) that lie ``off_m`` (n,) off a reference are another part's; empty
    if they need not be."""
    is_met = np.isfinite(off_m)
    x, y, z = points_m[is_met].T
    smooth = fit_surface(x, y, z, SurfaceConfig(method="bisquare"))
    off_reference_m = float(np.quantile(np.abs(off_m[is_met]), MOST))
    off_smooth_m = float(np.quantile(np.abs(z - smooth.evaluate(x, y)), MOST))
    noise_m = float(np.sqrt(median_of(variances_m2[is_met])))
    if off_reference_m < max(WORSE * off_smooth_m, BEYOND_NOISE * noise_m, APART_M):
        return ""
    return (
        f"after the best placement {100 * MOST:.0f} % of it lie within"
        f" {off_reference_m / MM:.2g} mm of the reference, and within {off_smooth_m / MM:.2g} mm of"
        " a smooth surface"
    )


def closest_of(poses: Sequence[Pose]) -> Pose:
    """Return the pose whose nearest points lie closest to the triangles. What lies beside the part
    does not count, and what lies beyond an edge does, as it does not for distances from planes."""
    return min(poses, key=lambda pose: pose.nearest_m)
