"""Solids and Booleans: bent sheets, cutters of holes and dents, one subtraction in double precision."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM
from scenes.target.face import Face
from scenes.target.truth import Damage, ball_radius_m

if TYPE_CHECKING:
    import trimesh

SEGMENTS = 128
"""Sides of a circle. The polygon has the circle's area; at 1 in, corners are 2.5 um outside, sides 1.3 um inside."""
RINGS = 48
"""Steps of a dent's profile from pole to rim: volume short by 1 / (3 RINGS^2) = 0.014 %."""
MAX_CELLS = 1_000_000
"""Of one bent sheet: some 300 MB."""


def sheet(
    face: Face,
    size_m: tuple[float, float],
    *,
    top_m: float,
    bottom_m: float,
    sagitta_m: float,
    centre_m: tuple[float, float] = (0.0, 0.0),
    angle_rad: float = 0.0,
) -> trimesh.Trimesh:
    """A watertight sheet over a rectangle in plan, between two parallels of the face (offsets along its normals).

    Its facets stay within ``sagitta_m`` of the face; a flat sheet has 12 triangles. Board frame. UserError where the
    face needs more than MAX_CELLS.
    """
    import trimesh

    turn = np.array([[np.cos(angle_rad), -np.sin(angle_rad)], [np.sin(angle_rad), np.cos(angle_rad)]])
    columns, rows = _cells(face, size_m, turn, centre_m, sagitta_m)
    across, up = np.meshgrid(
        np.linspace(-0.5, 0.5, columns + 1) * size_m[0], np.linspace(-0.5, 0.5, rows + 1) * size_m[1]
    )
    plan = np.stack([across, up], axis=-1) @ turn.T + centre_m
    points, normals = face.point(plan[..., 0], plan[..., 1]), face.normal(plan[..., 0], plan[..., 1])
    vertices = np.concatenate([(points + offset * normals).reshape(-1, 3) for offset in (top_m, bottom_m)])
    return trimesh.Trimesh(vertices=vertices, faces=_sheet_faces(columns, rows), process=False)


def _cells(
    face: Face, size_m: tuple[float, float], turn: np.ndarray, centre_m: tuple[float, float], sagitta_m: float
) -> tuple[int, int]:
    """Columns and rows of a grid whose triangles stay within the sagitta of the face.

    Linear interpolation on a right triangle of legs a, b errs by (|f_aa| a^2 + 2 |f_ab| ab + |f_bb| b^2) / 8 or less.
    Legs with a^2 (|f_aa| + |f_ab|) = b^2 (|f_bb| + |f_ab|) = 4 sagitta keep that below the sagitta.
    """
    steps = np.linspace(-0.5, 0.5, 65)
    across, up = np.meshgrid(steps * size_m[0], steps * size_m[1])
    plan = np.stack([across, up], axis=-1) @ turn.T + centre_m
    fxx, fxy, fyy = np.moveaxis(face.bend(plan[..., 0], plan[..., 1]), -1, 0)
    hessian = turn.T @ np.stack([np.stack([fxx, fxy], -1), np.stack([fxy, fyy], -1)], -2) @ turn
    bends = np.abs(hessian).sum(axis=-1).max(axis=(0, 1))
    # 1e-9 per metre: rounding of a turned straight direction must not cut it into cells.
    lengths = np.where(bends > 1e-9, np.sqrt(4 * sagitta_m / np.maximum(bends, 1e-9)), np.inf)
    columns, rows = (max(1, int(np.ceil(size / length))) for size, length in zip(size_m, lengths, strict=True))
    if columns * rows > MAX_CELLS:
        raise UserError(
            f"board: its face needs {columns} x {rows} cells to be followed within {sagitta_m / MM * 1e3:.3g} um",
            legal=f"at most {MAX_CELLS} cells",
            fix="make the board smaller or bend it less",
        )
    return columns, rows


def _sheet_faces(columns: int, rows: int) -> np.ndarray:
    """Triangles of two (rows + 1) x (columns + 1) grids of vertices, upper one first, and the walls between."""
    grid = np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, columns + 1)
    below = grid.size
    a, b, c, d = (part.ravel() for part in (grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]))
    upper = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    rim = np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[:0:-1, 0]])
    following = np.roll(rim, -1)
    walls = np.concatenate(
        [np.column_stack([rim + below, following + below, following]), np.column_stack([rim + below, following, rim])]
    )
    return np.concatenate([upper, upper[:, ::-1] + below, walls])


def cutter(damage: Damage, radius_m: float) -> trimesh.Trimesh:
    """The solid that a damage takes away, board frame; it sticks out of the face, and for a through-hole of the back.

    ``radius_m`` is the declared one: on a bent face a dent's rim, which the truth holds, is not that of its ball.
    """
    import trimesh

    depth_m = damage.depth_m
    # A face or back that bends to a radius of twice the damage's lies 0.27 radius off the tangent plane at the rim.
    spare_m = 0.2 * MM + 0.5 * radius_m
    if damage.kind == "dent":
        profile = _dent_profile(radius_m, depth_m, spare_m)
    else:
        bottom_m = -depth_m - (spare_m if damage.kind == "through" else 0.0)
        profile = np.array([(0.0, bottom_m), (radius_m, bottom_m), (radius_m, spare_m), (0.0, spare_m)])
    angle = 2 * np.pi / SEGMENTS
    equal_area = np.sqrt(angle / np.sin(angle))
    # In millimetres: trimesh takes areas below 1e-8 for nothing, and in m2 that is a facet of a small hole.
    solid = trimesh.creation.revolve(profile / MM * (equal_area, 1.0), sections=SEGMENTS)
    across = np.cross([0.0, 1.0, 0.0], damage.axis_board)
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = MM * np.column_stack([across, np.cross(damage.axis_board, across), damage.axis_board])
    pose[:3, 3] = damage.centre_board_m
    return solid.apply_transform(pose)


def _dent_profile(radius_m: float, depth_m: float, spare_m: float) -> np.ndarray:
    """(n, 2) radius and height of a ball from pole to rim and on above the face, then straight up, then a lid."""
    ball_m = ball_radius_m(radius_m, depth_m)
    middle_m = ball_m - depth_m
    rim = np.arctan2(radius_m, middle_m)
    top = np.arccos(max(middle_m - spare_m, 0.0) / ball_m)
    angle = np.linspace(0.0, rim, RINGS + 1)
    if top > rim + 1e-6:
        angle = np.concatenate([angle, np.linspace(rim, top, RINGS // 4)[1:]])
    profile = np.column_stack([ball_m * np.sin(angle), middle_m - ball_m * np.cos(angle)])
    profile[0, 0] = 0.0
    if profile[-1, 1] < spare_m:
        profile = np.vstack([profile, (profile[-1, 0], spare_m)])
    return np.vstack([profile, (0.0, spare_m)])


def subtract(body: trimesh.Trimesh, cutters: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Body minus cutters by Manifold, watertight.

    Called directly, because trimesh's own wrapper rounds to float32: 30 nm on a board of 0.6 m, 1e-3 of the facets of
    a 1/16 in hole.
    """
    import manifold3d  # type: ignore[import-not-found]
    import trimesh

    solids = [
        manifold3d.Manifold(
            manifold3d.Mesh64(
                vert_properties=np.ascontiguousarray(mesh.vertices, dtype=np.float64),
                tri_verts=np.ascontiguousarray(mesh.faces, dtype=np.uint64),
            )
        )
        for mesh in (body, *cutters)
    ]
    broken = [solid.status() for solid in solids if solid.status() != manifold3d.Error.NoError]
    if broken:
        raise RuntimeError(f"a solid is not closed: {broken}")
    result = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Subtract).to_mesh64()
    return trimesh.Trimesh(
        vertices=result.vert_properties[:, :3], faces=result.tri_verts.astype(np.int64), process=False
    )
