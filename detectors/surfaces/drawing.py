"""A part's drawing, as triangles: laid on a cloud, it gives the point where each ray should end.

The part's front axis is turned to the camera, upright or rolled by multiples of 90 degrees, and
`detectors.surfaces.expected` moves it onto the cloud. Triangles that face away are left out. A part
turned by more than about 30 degrees is not found."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from detectors.surfaces.expected import (
    LARGER,
    LEAST_OVERLAP,
    LOOSE,
    SMALLER,
    Pose,
    Triangles,
    another_part,
    closest_of,
    diagonal,
    expected,
    few_of,
    fitted,
    met,
    normals_of,
    sampled,
    spacing,
)
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, ExpectedSurface
from harness.vocabulary.meshes import (
    FILES,
    UNITS_M,
    FileUnit,
    FrontAxis,
    front_first,
    read_mesh,
)

ROLLS = 4
"""Starts by quarters of a turn."""
FEW = 500
"""Points that choose among the starts."""


class DrawingFile(Config):
    """The mesh of a part, which may be open."""

    file: Annotated[str, Field(min_length=1, max_length=1000, description=FILES)]
    unit: FileUnit = "mm"
    # the axis of the file that points to the camera
    front: FrontAxis = "+z"


@dataclass(frozen=True, eq=False)
class Drawing:
    """A part as it should be: x right, y up, z to the camera."""

    name: str
    """What it is, in words, such as its file."""
    unit: str
    """Unit of length of its file, for messages."""
    triangles: Triangles

    @cached_property
    def front(self) -> Triangles:
        """The triangles that face the camera."""
        return self.triangles.chosen(self.triangles.normals[:, 2] > -LOOSE)


def drawing_of(name: str, corners_m: np.ndarray, unit: str = "mm") -> Drawing:
    """Return the drawing of triangles (m, 3, 3), corners counter-clockwise from outside."""
    variances_m2 = np.zeros((len(corners_m), 3))
    return Drawing(name, unit, Triangles(corners_m, normals_of(corners_m), variances_m2))


def read_drawing(source: DrawingFile) -> Drawing:
    """Read a part's mesh. Raises UserError if the file is not a mesh or no triangle faces the
    front."""
    mesh = read_mesh(source.file)
    corners_m = front_first(mesh, source.unit, source.front)[np.asarray(mesh.faces)]
    drawing = drawing_of(source.file, corners_m, source.unit)
    if not (drawing.triangles.normals[:, 2] > 0).any():
        fix = "state its front, or turn its faces outwards"
        raise UserError(f"{source.file}: none of its triangles faces {source.front}", fix=fix)
    return drawing


def drawing_under(drawing: Drawing, points: np.ndarray, central: bool) -> ExpectedSurface:
    """Fit a drawing to points (n, 3) of the camera's frame. Return the surface seen along rays from
    the lens (``central``) or along z. Raises UserError if the points are not of this part."""
    sample = sampled(points)
    _refuse_unit(drawing, points)
    pose = _placed(drawing.front, sample)
    overlap = _refuse_other(drawing, pose, sample, central)
    return expected(
        drawing.triangles,
        pose,
        pitch=spacing(points / points[:, 2:] if central else points),
        central=central,
        is_sharp=True,
        text=_text(drawing, pose),
        facts=_facts(drawing, pose, overlap),
    )


def _placed(front: Triangles, sample: np.ndarray) -> Pose:
    """Return the pose of points (n, 3) on the front. Some of them choose among the poses that they
    reach from all starts; all go on from that pose, since they reach less far (`fitted`)."""
    thinned = few_of(sample, FEW)
    poses = [fitted(front, thinned, _start(front, sample, turn)) for turn in range(ROLLS)]
    best = closest_of(poses)
    return fitted(front, sample, best.T_part_camera)


def _start(front: Triangles, points: np.ndarray, turn: int) -> np.ndarray:
    """Return T_part_camera (4, 4) of a part before the camera, rolled by quarters of a turn."""
    angle = turn * 2 * np.pi / ROLLS
    cosine = np.rint(np.cos(angle))
    sine = np.rint(np.sin(angle))
    roll = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    facing = np.diag([1.0, -1.0, -1.0])
    T = np.eye(4)
    T[:3, :3] = roll @ facing
    T[:3, 3] = front.middle_m - T[:3, :3] @ np.median(points, axis=0)
    return T


def _refuse_unit(drawing: Drawing, points: np.ndarray) -> None:
    """Raise UserError if points (n, 3) extend beyond the part or are a tiny piece of it, as in a
    wrong unit of length."""
    extent_m = diagonal(points)
    part_m = diagonal(drawing.front.corners_m.reshape(-1, 3))
    if part_m / SMALLER < extent_m < LARGER * part_m:
        return
    fitting = []
    for unit, unit_m in UNITS_M.items():
        ratio = part_m * unit_m / UNITS_M[drawing.unit] / extent_m
        if 1.0 / LARGER < ratio < LARGER:
            fitting.append(unit)
    fix = "name the mesh of this part, or choose its surface (--target, --crop)"
    if fitting:
        fix = f"state its unit, if it is {' or '.join(fitting)}: reference.unit={fitting[0]}"
    raise UserError(
        f"{drawing.name}: is {part_m / MM:.3g} mm large in {drawing.unit}, and the target"
        f" {extent_m / MM:.3g} mm",
        legal=f"a target of {1 / SMALLER:g} to {LARGER:g} times the part's size",
        fix=fix,
    )


def _refuse_other(drawing: Drawing, pose: Pose, points: np.ndarray, central: bool) -> float:
    """Return the share of points (n, 3) that the placed part shows. Raises UserError if they are
    beside it, or lie off it."""
    rays = points[:, :2] / points[:, 2:] if central else points[:, :2]
    z_m, variances_m2 = met(drawing.triangles, pose.T_part_camera, rays, central)
    off_m = points[:, 2] - z_m
    overlap = float(np.isfinite(off_m).mean())
    doubt = f"it shows {100 * overlap:.0f} % of the target"
    if overlap >= LEAST_OVERLAP:
        doubt = another_part(points, off_m, variances_m2)
    if doubt:
        raise UserError(
            f"{drawing.name}: is not this part: {doubt}",
            fix="name the mesh of this part, state its front (reference.front) and unit, or"
            " choose its surface (--target, --crop)",
        )
    return overlap


def _text(drawing: Drawing, pose: Pose) -> str:
    """Return how well the part fits, in words."""
    return (
        f"the mesh {Path(drawing.name).name}, with half of the points within "
        f"{pose.off_m / MM:.2g} mm of it, placed along its normals within "
        f"{pose.error_m / MM:.2g} mm (standard error)"
    )


def _facts(drawing: Drawing, pose: Pose, overlap: float) -> dict[str, Any]:
    return {
        "name": Path(drawing.name).name,
        "placed_by": "surface",
        "T_reference_camera": pose.T_part_camera.tolist(),
        "covariance": pose.covariance.tolist(),
        "covariance_about_mm": (pose.middle_m / MM).tolist(),
        "median_off_mm": pose.off_m / MM,
        "standard_error_mm": pose.error_m / MM,
        "overlap": overlap,
    }
