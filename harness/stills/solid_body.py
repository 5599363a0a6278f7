"""The bodies of a solid gauge as watertight meshes, in mm."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.stills.solid_gauge import SolidGauge

if TYPE_CHECKING:
    import trimesh

# facets of a full circle: a sphere of 30 mm is then within 9 um of round
FACETS = 96
OVERLAP_MM = 0.5  # depth by which joined bodies overlap, so that no faces coincide
# modules are this much too wide, so that those that touch at a corner are one body
JOINED_MM = 0.05


def solid_of(gauge: SolidGauge) -> trimesh.Trimesh:
    """Return the gauge as one watertight body, in mm."""
    import manifold3d  # type: ignore[import-not-found]

    plate_mm = (gauge.width_mm, gauge.height_mm, gauge.thickness_mm)
    bodies = [_box(plate_mm, (0, 0, -gauge.thickness_mm))]
    for step in gauge.steps:
        size_mm = (step.side_mm, step.side_mm, step.height_mm + OVERLAP_MM)
        bodies.append(_box(size_mm, (step.x_mm, step.y_mm, -OVERLAP_MM)))
    for ball in gauge.spheres:
        post_mm = ball.z_mm + OVERLAP_MM
        bodies.append(_cylinder(gauge.post_mm, post_mm, (ball.x_mm, ball.y_mm, -OVERLAP_MM)))
        radius_mm = ball.diameter_mm / 2
        sphere = manifold3d.Manifold.sphere(radius_mm, FACETS)
        # facets within the sphere would make it 7 um too small on the average
        larger = float(np.cbrt(4 / 3 * np.pi * radius_mm**3 / sphere.volume()))
        sphere = sphere.scale((larger, larger, larger))
        bodies.append(sphere.translate((ball.x_mm, ball.y_mm, ball.z_mm)))
    body = manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add)
    cutters = [*_marks_of(gauge, above_mm=OVERLAP_MM)]
    for pocket in gauge.pockets:
        deep_mm = pocket.depth_mm + OVERLAP_MM
        place_mm = (pocket.x_mm, pocket.y_mm, -pocket.depth_mm)
        cutters.append(_cylinder(pocket.diameter_mm, deep_mm, place_mm))
    for groove in gauge.grooves:
        deep_mm = groove.depth_mm + OVERLAP_MM
        straight_mm = groove.length_mm - groove.width_mm
        place_mm = (groove.x_mm, groove.y_mm, -groove.depth_mm)
        cutters.append(_box((groove.width_mm, straight_mm, deep_mm), place_mm))
        for end in (-1, 1):
            y_mm = groove.y_mm + end * straight_mm / 2
            end_mm = (groove.x_mm, y_mm, -groove.depth_mm)
            cutters.append(_cylinder(groove.width_mm, deep_mm, end_mm))
    cut = manifold3d.Manifold.batch_boolean([body, *cutters], manifold3d.OpType.Subtract)
    return _mesh(cut)


def inlay_of(gauge: SolidGauge) -> trimesh.Trimesh:
    """Return the black modules of all marks, which fill their recesses flush with the face."""
    import manifold3d

    modules = list(_marks_of(gauge, above_mm=0.0))
    return _mesh(manifold3d.Manifold.batch_boolean(modules, manifold3d.OpType.Add))


def _marks_of(gauge: SolidGauge, above_mm: float) -> Iterable[Any]:
    """Yield the black modules of the marks as boxes from the recess's floor to ``above_mm``."""
    import cv2

    codes = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, gauge.dictionary))
    count = codes.markerSize + 2
    for mark in gauge.marks:
        picture = cv2.aruco.generateImageMarker(codes, mark.code, count)
        module_mm = mark.side_mm / count
        side_mm = module_mm + JOINED_MM
        size_mm = (side_mm, side_mm, gauge.mark_depth_mm + above_mm)
        for row, column in np.argwhere(picture == 0).tolist():
            x_mm = mark.x_mm + (column + 0.5) * module_mm - mark.side_mm / 2
            y_mm = mark.y_mm - (row + 0.5) * module_mm + mark.side_mm / 2
            yield _box(size_mm, (x_mm, y_mm, -gauge.mark_depth_mm))


def _box(size_mm: tuple[float, float, float], foot_mm: tuple[float, float, float]) -> Any:
    """Return a box that stands on a point."""
    import manifold3d

    box = manifold3d.Manifold.cube(size_mm, True)
    return box.translate((foot_mm[0], foot_mm[1], foot_mm[2] + size_mm[2] / 2))


def _cylinder(diameter_mm: float, tall_mm: float, foot_mm: tuple[float, float, float]) -> Any:
    """Return an upright cylinder that stands on a point."""
    import manifold3d

    radius_mm = diameter_mm / 2
    return manifold3d.Manifold.cylinder(tall_mm, radius_mm, radius_mm, FACETS).translate(foot_mm)


def _mesh(solid: Any) -> trimesh.Trimesh:
    import trimesh

    mesh = solid.to_mesh64()
    corners_mm = np.asarray(mesh.vert_properties)[:, :3]
    return trimesh.Trimesh(corners_mm, np.asarray(mesh.tri_verts), process=False)
