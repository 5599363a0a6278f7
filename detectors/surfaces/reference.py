"""The part's own mesh as the undamaged surface: fitted to the cloud, it gives the point where each
ray should end.

The part's front axis is turned to the camera, upright or rolled by multiples of 90 degrees, and
`detectors.surfaces.expected` moves it onto the cloud. Triangles that face away are left out. A part
turned by more than about 30 degrees is not found."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from detectors.surfaces.expected import (
    LEAST_OVERLAP,
    LOOSE,
    Pose,
    Triangles,
    another_part,
    closest_of,
    expected,
    fitted,
    met,
    normals_of,
    sampled,
    spacing,
)
from detectors.surfaces.surface import ReferenceConfig
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, ExpectedSurface
from harness.vocabulary.meshes import UNITS_M, front_first, read_mesh

LARGER = 2.0
"""Ratio of the target's size to the mesh's from which the mesh cannot be the part."""
SMALLER = 10.0
"""Ratio of the mesh's size to the target's from which its outline cannot place the target."""


@lru_cache(maxsize=4)
def front_of(reference: ReferenceConfig) -> Triangles:
    """Return a part's triangles, x right, y up, z to the camera, in metres. Raises UserError if the
    file is not a mesh or no triangle faces the front."""
    mesh = read_mesh(reference.file)
    corners = front_first(mesh, reference.unit, reference.front)[np.asarray(mesh.faces)]
    normals = normals_of(corners)
    if not (normals[:, 2] > 0).any():
        fix = "state its front, or turn its faces outwards"
        raise UserError(f"{reference.file}: none of its triangles faces {reference.front}", fix=fix)
    return Triangles(corners, normals, np.zeros((len(corners), 3)))


def laid_on(points: np.ndarray, reference: ReferenceConfig, central: bool) -> ExpectedSurface:
    """Fit the part to points (n, 3) of the camera's frame. Return the surface seen along rays from
    the lens (``central``) or along z. Raises UserError as `front_of` does."""
    part = front_of(reference)
    front = part.chosen(part.normals[:, 2] > -LOOSE)
    sample = sampled(points)
    _refuse_unit(reference, front, points)
    poses = []
    for turn in range(4):
        poses.append(fitted(front, sample, _start(front, sample, turn)))
    pose = closest_of(poses)
    _refuse_other(reference, part, pose, sample, central)
    return expected(
        part,
        pose,
        pitch=spacing(points / points[:, 2:] if central else points),
        central=central,
        is_sharp=True,
        text=_text(reference, pose),
        facts={"median_off_m": pose.off_m, "standard_error_m": pose.error_m},
    )


def _start(front: Triangles, points: np.ndarray, turn: int) -> np.ndarray:
    """Return T_part_camera (4, 4) of a part before the camera, rolled by quarters of a turn."""
    angle = turn * np.pi / 2
    c, s = np.rint([np.cos(angle), np.sin(angle)])
    roll = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, :3] = roll @ T[:3, :3]
    T[:3, 3] = front.middle_m - T[:3, :3] @ np.median(points, axis=0)
    return T


def _refuse_unit(reference: ReferenceConfig, front: Triangles, points: np.ndarray) -> None:
    """Raise UserError if points (n, 3) extend beyond the part or are a tiny piece of it, as in a
    wrong unit of length."""
    extent_m = _diagonal(points)
    part_m = _diagonal(front.corners_m.reshape(-1, 3))
    if part_m / SMALLER < extent_m < LARGER * part_m:
        return
    fitting = []
    for unit, unit_m in UNITS_M.items():
        ratio = part_m * unit_m / UNITS_M[reference.unit] / extent_m
        if 1.0 / LARGER < ratio < LARGER:
            fitting.append(unit)
    fix = "name the mesh of this part, or choose its surface (--target, --crop)"
    if fitting:
        fix = (
            f"state its unit, if it is {' or '.join(fitting)}: surface.reference.unit={fitting[0]}"
        )
    raise UserError(
        f"{reference.file}: is {part_m / MM:.3g} mm large in {reference.unit}, and the target"
        f" {extent_m / MM:.3g} mm",
        legal=f"a target of {1 / SMALLER:g} to {LARGER:g} times the part's size",
        fix=fix,
    )


def _diagonal(points: np.ndarray) -> float:
    """Return the diagonal of the box around points (n, 3), without the outermost hundredth."""
    low, high = np.quantile(points, (0.01, 0.99), axis=0)
    return float(np.linalg.norm(high - low))


def _refuse_other(
    reference: ReferenceConfig,
    part: Triangles,
    pose: Pose,
    points: np.ndarray,
    central: bool,
) -> None:
    """Raise UserError if points (n, 3) are beside the placed part, or lie off it."""
    rays = points[:, :2] / points[:, 2:] if central else points[:, :2]
    z_m, variances_m2 = met(part, pose.T_part_camera, rays, central)
    off_m = points[:, 2] - z_m
    overlap = float(np.isfinite(off_m).mean())
    doubt = f"it shows {100 * overlap:.0f} % of the target"
    if overlap >= LEAST_OVERLAP:
        doubt = another_part(points, off_m, variances_m2)
    if doubt:
        raise UserError(
            f"{reference.file}: is not this part: {doubt}",
            fix="name the mesh of this part, state its front (surface.reference.front) and unit, or"
            " choose its surface (--target, --crop)",
        )


def _text(reference: ReferenceConfig, pose: Pose) -> str:
    """Return how well the part fits, in words."""
    return (
        f"the mesh {Path(reference.file).name}, with half of the points within "
        f"{pose.off_m / MM:.2g} mm of it, placed along its normals within "
        f"{pose.error_m / MM:.2g} mm (standard error)"
    )
