"""Meshes against closed forms: volumes, frames, faces, textures and surroundings."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import invert, rotate_vectors, transform_points
from scenes.target.custom import (
    BackingConfig,
    BoardConfig,
    CastingConfig,
    CylinderConfig,
    DentConfig,
    FlatConfig,
    HoleConfig,
    MaterialConfig,
    PolynomialConfig,
    PoseConfig,
    RoomConfig,
    SphereConfig,
    TapeConfig,
    TargetConfig,
    TermConfig,
)
from scenes.target.mesh import (
    Target,
    board_solid,
    build_target,
    cutter,
    grain,
    look_up,
    reflectance,
    sheet,
    subtract,
)
from scenes.target.thesis import ThesisTargetConfig
from scenes.target.truth import face_of

WAVY = PolynomialConfig(
    kind="polynomial",
    terms=(
        TermConfig(
            power_x=1,
            power_y=0,
            coefficient_mm=20,
        ),
        TermConfig(
            power_x=2,
            power_y=0,
            coefficient_mm=-10,
        ),
        TermConfig(
            power_x=1,
            power_y=1,
            coefficient_mm=5,
        ),
        TermConfig(
            power_x=3,
            power_y=0,
            coefficient_mm=8,
        ),
        TermConfig(
            power_x=0,
            power_y=3,
            coefficient_mm=-2,
        ),
    ),
)
CURVED = [
    CylinderConfig(kind="cylinder", radius_mm=500),
    CylinderConfig(
        kind="cylinder",
        radius_mm=300,
        bulge="away",
        straight_along="x",
    ),
    SphereConfig(kind="sphere", radius_mm=1000),
    SphereConfig(
        kind="sphere",
        radius_mm=500,
        bulge="away",
    ),
    WAVY,
]


def target(shape: Any = FlatConfig(), **parts: Any) -> TargetConfig:  # noqa: B008
    board = BoardConfig(
        width_mm=300,
        height_mm=100,
        thickness_mm=12.7,
        shape=shape,
    )
    return TargetConfig(board=board, **parts)


def removed_m3(config: TargetConfig, sagitta_m: float) -> list[float]:
    """What each damage alone takes out of the board's mesh."""
    face = face_of(config.board)
    size_m = (config.board.width_mm * 1e-3, config.board.height_mm * 1e-3)
    body = sheet(
        face,
        size_m,
        top_m=0.0,
        bottom_m=-config.board.thickness_mm * 1e-3,
        sagitta_m=sagitta_m,
    )
    removed = []
    for damage, item in zip(build_target(config).truth, config.damages, strict=True):
        remaining = subtract(body, [cutter(damage, item)])
        assert remaining.is_watertight
        removed.append(float(body.volume - remaining.volume))
    return removed


# ---- volumes


def test_thesis_board_is_watertight_and_each_hole_has_its_volume() -> None:
    config = ThesisTargetConfig().declare()
    built = build_target(config)
    board = built.parts[0].mesh
    assert board.is_watertight
    assert board.is_winding_consistent
    assert board.euler_number == 2 - 2 * 11
    analytic = [math.pi / 4 * (hole.diameter_mm * 1e-3) ** 2 * 12.7e-3 for hole in config.holes]
    assert [damage.volume_m3 for damage in built.truth] == pytest.approx(analytic, rel=1e-12)
    # Polygons of equal area: only rounding is left.
    assert removed_m3(config, 2e-6) == pytest.approx(analytic, rel=1e-7)
    assert 0.6096 * 0.1143 * 12.7e-3 - board.volume == pytest.approx(sum(analytic), rel=1e-9)


def test_thesis_blind_holes_leave_a_floor() -> None:
    built = build_target(ThesisTargetConfig(hole_kind="blind").declare())
    board = built.parts[0].mesh
    assert board.is_watertight
    assert board.euler_number == 2
    undamaged_m3 = 0.6096 * 0.1143 * 12.7e-3
    assert undamaged_m3 - board.volume == pytest.approx(
        sum(d.volume_m3 for d in built.truth), rel=1e-9
    )
    assert built.truth[3].volume_m3 == pytest.approx(math.pi / 4 * 6.35e-3**2 * 9.5e-3, rel=1e-9)
    assert {damage.depth_m for damage in built.truth} == {9.5e-3}


@pytest.mark.parametrize(("kind", "depth_mm"), [("through", None), ("blind", 6.0)])
def test_a_chamfer_takes_a_cone_off_the_edge(
    kind: Any,
    depth_mm: float | None,
) -> None:
    hole = HoleConfig(
        id=1,
        diameter_mm=5,
        centre_mm=(0, 0),
        kind=kind,
        depth_mm=depth_mm,
        chamfer_mm=0.8,
    )
    config = target(holes=(hole,))
    built = build_target(config)
    cylinder = math.pi * 2.5**2 * (depth_mm or 12.7)
    cone = math.pi * 0.8 * (2.5**2 + 2.5 * 3.3 + 3.3**2) / 3
    expected = (cylinder + cone - math.pi * 2.5**2 * 0.8) * 1e-9
    assert built.truth[0].volume_m3 == pytest.approx(expected, rel=1e-12)
    assert built.truth[0].diameter_m == 5e-3
    assert removed_m3(config, 2e-6) == pytest.approx([expected], rel=1e-6)
    # on the face the mouth is as wide as drill and chamfer
    plan = built.parts[0].mesh.copy().apply_transform(invert(built.T_camera_board)).vertices
    on_face = plan[(np.abs(plan[:, 2]) < 1e-6) & (np.linalg.norm(plan[:, :2], axis=1) < 0.01)]
    assert np.linalg.norm(on_face[:, :2], axis=1) == pytest.approx(3.3e-3, abs=5e-6)


@pytest.mark.parametrize(
    ("diameter_mm", "depth_mm"), [(20, 0.04), (20, 1), (20, 10), (1, 0.3), (40, 12)]
)
def test_dent_on_a_flat_board_is_a_spherical_cap(
    diameter_mm: float,
    depth_mm: float,
) -> None:
    config = target(
        dents=(
            DentConfig(
                id=1,
                diameter_mm=diameter_mm,
                depth_mm=depth_mm,
                centre_mm=(30, -10),
            ),
        )
    )
    truth = build_target(config).truth[0]
    a = diameter_mm / 2
    h = depth_mm
    assert truth.volume_m3 * 1e9 == pytest.approx(math.pi * h * (3 * a**2 + h**2) / 6, rel=1e-9)
    assert truth.diameter_m * 1e3 == pytest.approx(diameter_mm, rel=1e-12)
    # 48 rings leave 1 / (3 * 48^2) = 1.4e-4 of a shallow cap, twice that of half a ball.
    assert removed_m3(config, 2e-6)[0] == pytest.approx(truth.volume_m3, rel=3e-4)


@pytest.mark.parametrize(
    "shape", [CURVED[0], *(pytest.param(shape, marks=pytest.mark.slow) for shape in CURVED[1:])]
)
def test_volumes_on_curved_boards(shape: Any) -> None:
    """Facets 1 um off the face change a 2 mm dent by 2 * 0.7 um / 2 mm = 0.07 %; the rest is
    second order."""
    config = target(
        shape,
        holes=(
            HoleConfig(
                id=1,
                diameter_mm=25.4,
                centre_mm=(100, 20),
            ),
            HoleConfig(
                id=2,
                diameter_mm=25.4,
                centre_mm=(-100, 20),
                kind="blind",
                depth_mm=9.5,
            ),
            HoleConfig(
                id=3,
                diameter_mm=1.6,
                centre_mm=(-60, -20),
            ),
        ),
        dents=(
            DentConfig(
                id=4,
                diameter_mm=20,
                depth_mm=2,
                centre_mm=(0, 0),
            ),
            DentConfig(
                id=5,
                diameter_mm=20,
                depth_mm=10,
                centre_mm=(40, 20),
            ),
        ),
    )
    built = build_target(config)
    assert built.parts[0].mesh.is_watertight
    truth = [damage.volume_m3 for damage in built.truth]
    assert removed_m3(config, 1e-6) == pytest.approx(truth, rel=2e-3)
    # Curvature matters: without its correction the dent of 2 mm would be off by more than that
    # tolerance.
    assert abs(truth[3] / (math.pi * 2 * (300 + 4) / 6 * 1e-9) - 1) > 5e-3


def test_dent_on_a_sphere_is_a_lens_of_two_spheres() -> None:
    """Ball of 26 mm (a = 10, h = 2) into a sphere of 100 mm: the standard lens of two balls, d =
    100 + 26 - 2."""
    board = BoardConfig(
        width_mm=60,
        height_mm=60,
        thickness_mm=12,
        shape=SphereConfig(
            kind="sphere",
            radius_mm=100,
            bulge="towards",
        ),
    )
    config = TargetConfig(
        board=board,
        dents=(
            DentConfig(
                id=1,
                diameter_mm=20,
                depth_mm=2,
                centre_mm=(0, 0),
            ),
        ),
    )
    big = 100.0
    small = 26.0
    d = 124.0
    lens = math.pi * (big + small - d) ** 2
    lens *= (d**2 + 2 * d * small - 3 * small**2 + 2 * d * big + 6 * small * big - 3 * big**2) / (
        12 * d
    )
    rim = math.sqrt(4 * d**2 * big**2 - (d**2 - small**2 + big**2) ** 2) / (2 * d)
    truth = build_target(config).truth[0]
    assert truth.volume_m3 * 1e9 == pytest.approx(lens, rel=1e-9)
    assert truth.diameter_m * 1e3 == pytest.approx(2 * rim, rel=1e-9)


@settings(max_examples=15, deadline=None)
@given(
    diameter_mm=st.floats(0.5, 40),
    x_mm=st.floats(-120, 120),
    y_mm=st.floats(-25, 25),
    depth_mm=st.one_of(st.none(), st.floats(0.1, 12.5)),
    pose=st.tuples(st.floats(-60, 60), st.floats(-60, 60), st.floats(-180, 180)),
)
def test_any_hole_in_a_flat_board(
    diameter_mm: float,
    x_mm: float,
    y_mm: float,
    depth_mm: float | None,
    pose: tuple[float, float, float],
) -> None:
    hole = HoleConfig(
        id=7,
        diameter_mm=diameter_mm,
        centre_mm=(x_mm, y_mm),
        kind="through" if depth_mm is None else "blind",
        depth_mm=depth_mm,
    )
    config = target(
        holes=(hole,),
        material=MaterialConfig(grain_contrast=0.0),
        pose=PoseConfig(
            distance_m=1.0,
            tilt_x_deg=pose[0],
            tilt_y_deg=pose[1],
            roll_deg=pose[2],
        ),
    )
    built = build_target(config)
    board = built.parts[0].mesh
    assert board.is_watertight
    expected = math.pi / 4 * diameter_mm**2 * (12.7 if depth_mm is None else depth_mm)
    assert (300 * 100 * 12.7) - board.volume * 1e9 == pytest.approx(expected, rel=1e-3, abs=1e-4)
    back = transform_points(invert(built.T_camera_board), built.truth[0].centre_camera_m)
    assert back == pytest.approx(np.array([x_mm, y_mm, 0]) * 1e-3, abs=1e-12)


# ---- frames


def test_frames_at_zero_tilt() -> None:
    hole = HoleConfig(
        id=1,
        diameter_mm=5,
        centre_mm=(40, 30),
    )
    built = build_target(
        target(
            holes=(hole,),
            pose=PoseConfig(
                distance_m=0.7,
                offset_x_mm=10,
                offset_y_mm=-20,
            ),
        )
    )
    damage = built.truth[0]
    assert damage.centre_camera_m == pytest.approx([0.050, -0.050, 0.7], abs=1e-12)
    assert damage.axis_camera == pytest.approx([0, 0, -1], abs=1e-12)
    assert damage.axis_board == pytest.approx([0, 0, 1], abs=1e-12)
    low, high = built.parts[0].mesh.bounds
    assert low == pytest.approx([-0.140, -0.070, 0.7], abs=1e-12)
    assert high == pytest.approx([0.160, 0.030, 0.7127], abs=1e-12)
    assert np.linalg.det(built.T_camera_board) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("turn", "nearer_mm"),
    [({"tilt_x_deg": 10.0}, (0, 40, 0)), ({"tilt_y_deg": 10.0}, (-100, 0, 0))],
)
def test_signs_of_tilts(
    turn: dict[str, float],
    nearer_mm: tuple[float, ...],
) -> None:
    T_camera_board = build_target(target(pose=PoseConfig(**turn))).T_camera_board
    z_m = transform_points(T_camera_board, np.array(nearer_mm) * 1e-3)[2]
    assert 0.7 - z_m == pytest.approx(math.sin(math.radians(10)) * np.linalg.norm(nearer_mm) * 1e-3)


def test_sign_of_roll() -> None:
    T_camera_board = build_target(target(pose=PoseConfig(roll_deg=90))).T_camera_board
    assert rotate_vectors(T_camera_board, np.array([1.0, 0, 0])) == pytest.approx(
        [0, -1, 0], abs=1e-12
    )


def test_truth_rows_are_millimetres() -> None:
    row = (
        build_target(ThesisTargetConfig(tilt_x_deg=0.0, tilt_y_deg=0.0).declare())
        .truth[10]
        .to_row()
    )
    assert row["id"] == 11
    assert row["kind"] == "through"
    assert row["diameter_mm"] == pytest.approx(25.4)
    assert row["depth_mm"] == pytest.approx(12.7)
    assert row["volume_mm3"] == pytest.approx(math.pi / 4 * 25.4**2 * 12.7)
    assert [row[f"{a}_camera_mm"] for a in "xyz"] == pytest.approx([254.0, 0, 700])
    assert [row[f"axis_{a}_camera"] for a in "xyz"] == pytest.approx([0, 0, -1])


# ---- faces


@pytest.mark.parametrize("shape", [FlatConfig(), *CURVED], ids=lambda shape: shape.kind)
def test_slopes_and_bends_are_the_derivatives(shape: Any) -> None:
    face = face_of(target(shape).board)
    x, y = np.meshgrid(np.linspace(-0.14, 0.14, 7), np.linspace(-0.045, 0.045, 5))
    step = 1e-5

    def by_x(function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        return (function(x + step, y) - function(x - step, y)) / (2 * step)

    def by_y(function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> np.ndarray:
        return (function(x, y + step) - function(x, y - step)) / (2 * step)

    slope = np.stack([by_x(face.height_m), by_y(face.height_m)], axis=-1)
    assert face.slope(x, y) == pytest.approx(slope, abs=1e-7)
    slope_by_x = by_x(face.slope)
    slope_by_y = by_y(face.slope)
    bend = np.stack([slope_by_x[..., 0], slope_by_x[..., 1], slope_by_y[..., 1]], axis=-1)
    assert face.bend(x, y) == pytest.approx(bend, abs=1e-6)
    assert face.height_m(0.0, 0.0) == 0.0


def test_curvatures_of_round_faces() -> None:
    x = np.array([0.0, 0.1])
    y = np.array([0.0, 0.03])
    ball = face_of(target(SphereConfig(kind="sphere", radius_mm=500)).board)
    assert ball.curvatures(x, y) == pytest.approx(np.full((2, 2), 2.0), rel=1e-6)
    trough = face_of(
        target(
            CylinderConfig(
                kind="cylinder",
                radius_mm=250,
                bulge="away",
            )
        ).board
    )
    assert trough.curvatures(x, y) == pytest.approx(np.array([[0.0, -4.0]] * 2), abs=1e-9)


@pytest.mark.parametrize("shape", CURVED, ids=lambda shape: shape.kind)
def test_facets_stay_close_to_the_face(shape: Any) -> None:
    """Edge middles and centroids of the front's triangles are within 2 um of the face."""
    config = target(shape)
    built = build_target(config)
    mesh = board_solid(config, ())
    on_face = (
        np.abs(mesh.vertices[:, 2] - face_of(built.config.board).height_m(*mesh.vertices[:, :2].T))
        < 1e-9
    )
    corners = mesh.triangles[on_face[mesh.faces].all(axis=1)]
    weights = np.array([[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5], [1 / 3, 1 / 3, 1 / 3]])
    points = np.einsum("wk,tkc->twc", weights, corners)
    off = points[..., 2] - face_of(built.config.board).height_m(points[..., 0], points[..., 1])
    assert 1e-7 < np.abs(off).max() <= 2e-6


def test_ribs_and_a_boss_are_close_to_the_face_with_few_cells() -> None:
    sizes_mm = {"high_mm": 6.0, "rib_width_mm": 10.0, "boss_width_mm": 40.0, "flank_mm": 3.0}
    casting = CastingConfig(kind="casting", rib_y_mm=30.0, **sizes_mm)
    board = BoardConfig(width_mm=300, height_mm=100, thickness_mm=1, shape=casting)
    config = TargetConfig(board=board)
    face = face_of(board)
    # a rib 10 mm wide is .07 of its height lower than the boss, where two cross .07 squared
    tops_m = face.height_m(np.array([0.0, 0.09, -0.09, 0.09]), np.array([0.0, 0.0, -0.02, 0.03]))
    short = 1.0 - math.tanh(5 / 3)
    assert tops_m == pytest.approx(-6e-3 * np.array([0, short, short, short**2]), abs=2e-7)
    assert face.height_m(0.05, -0.02) == pytest.approx(-6e-3, abs=1e-6)
    x, y = np.random.default_rng(1).uniform([[-0.14], [-0.045]], [[0.14], [0.045]], (2, 400))
    step = 1e-6
    along_x = (face.height_m(x + step, y) - face.height_m(x - step, y)) / (2 * step)
    along_y = (face.height_m(x, y + step) - face.height_m(x, y - step)) / (2 * step)
    assert face.slope(x, y) == pytest.approx(np.stack([along_x, along_y], -1), abs=1e-6)
    bend_x = (face.slope(x + step, y) - face.slope(x - step, y)) / (2 * step)
    bend_y = (face.slope(x, y + step) - face.slope(x, y - step)) / (2 * step)
    bend = np.stack([bend_x[..., 0], bend_x[..., 1], bend_y[..., 1]], -1)
    assert face.bend(x, y) == pytest.approx(bend, abs=1e-3)
    mesh = board_solid(config, ())
    front = mesh.triangles[mesh.face_normals[:, 2] > 0.3]
    weights = np.random.default_rng(2).dirichlet([1.0, 1.0, 1.0], len(front))
    points = np.einsum("tw,twc->tc", weights, front)
    off = points[:, 2] - face.height_m(points[:, 0], points[:, 1])
    assert 1e-5 < np.abs(off).max() <= 2e-5
    # four triangles are a cell of both sides; cells that are all alike would be some 110,000
    assert len(mesh.faces) / 4 < 24_000


@pytest.mark.parametrize("shape", [FlatConfig(), *CURVED], ids=lambda shape: shape.kind)
def test_outline_runs_round_the_rim(shape: Any) -> None:
    built = build_target(target(shape))
    x, y, z = built.outline_board_m.T
    assert np.allclose(np.maximum(np.abs(x) / 0.15, np.abs(y) / 0.05), 1.0)
    assert z == pytest.approx(face_of(built.config.board).height_m(x, y), abs=1e-12)
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    assert area == pytest.approx(0.3 * 0.1)


def test_back_face_is_parallel() -> None:
    built = build_target(target(SphereConfig(kind="sphere", radius_mm=300)))
    points = transform_points(invert(built.T_camera_board), built.parts[0].mesh.vertices)
    radii = np.linalg.norm(points - (0, 0, -0.3), axis=1)
    assert np.minimum(np.abs(radii - 0.3), np.abs(radii - 0.2873)).max() < 1e-9


# ---- what else stands there


def test_tape_lies_on_the_face_with_its_size_and_angle() -> None:
    tape = TapeConfig(
        centre_mm=(50, 10),
        size_mm=(40, 12),
        angle_deg=30,
        thickness_mm=0.15,
    )
    built = build_target(target(tapes=(tape,)))
    strip = built.parts[1]
    assert strip.name == "tape_1"
    assert strip.mesh.is_watertight
    points = transform_points(invert(built.T_camera_board), strip.mesh.vertices)
    top = points[points[:, 2] > 0]
    assert top[:, 2] == pytest.approx(np.full(4, 0.15e-3), abs=1e-12)
    c = math.cos(math.radians(30))
    s = math.sin(math.radians(30))
    local = (top[:, :2] - (0.05, 0.01)) @ np.array([[c, -s], [s, c]])
    assert sorted(map(tuple, np.round(local * 1e3, 9))) == [(-20, -6), (-20, 6), (20, -6), (20, 6)]


def test_backing_fills_the_view_through_every_hole() -> None:
    config = target(backing=BackingConfig(distance_mm=20))
    backing = build_target(config).parts[1]
    assert backing.name == "backing"
    z_m = 0.7 + 0.0127 + 0.020
    low, high = backing.mesh.bounds
    assert low == pytest.approx([-0.15 * z_m / 0.7, -0.05 * z_m / 0.7, z_m], abs=1e-12)
    assert high == pytest.approx([0.15 * z_m / 0.7, 0.05 * z_m / 0.7, z_m], abs=1e-12)
    assert np.allclose(backing.mesh.face_normals, [0, 0, -1])


def test_backing_of_a_bulging_board_clears_its_deepest_point() -> None:
    shape = SphereConfig(kind="sphere", radius_mm=300)
    built = build_target(target(shape, backing=BackingConfig(distance_mm=5, size_mm=(500, 400))))
    assert built.parts[1].mesh.bounds[0, 2] - built.parts[0].mesh.bounds[1, 2] == pytest.approx(
        5e-3, abs=1e-9
    )


def test_room_faces_the_light() -> None:
    room = RoomConfig(
        floor_below_lens_m=0.75,
        back_wall_distance_m=2.5,
        width_m=4,
        height_m=2.5,
    )
    built = build_target(target(room=room))
    parts = {part.name: part for part in built.parts}
    assert list(parts) == ["board", "floor", "back_wall"]
    assert np.allclose(parts["floor"].mesh.face_normals, [0, -1, 0])
    assert np.allclose(parts["back_wall"].mesh.face_normals, [0, 0, -1])
    assert parts["floor"].mesh.bounds == pytest.approx(np.array([[-2, 0.75, 0], [2, 0.75, 2.5]]))
    assert parts["back_wall"].mesh.bounds == pytest.approx(
        np.array([[-2, -1.75, 2.5], [2, 0.75, 2.5]])
    )
    assert parts["floor"].albedo_850 == 0.3
    assert parts["floor"].rgb_at(np.zeros((3, 2))).shape == (3, 3)


# ---- textures


def test_grain_has_mean_contrast_and_direction() -> None:
    material = MaterialConfig(grain_seed=3)
    pattern = grain(material, 300, 100)
    albedo = reflectance(pattern, 0.6, 0.05)
    assert albedo.dtype == np.float32
    assert albedo.mean(dtype=float) == pytest.approx(0.6, abs=1e-6)
    assert albedo.std(dtype=float) == pytest.approx(0.03, rel=1e-3)
    assert np.abs(np.diff(pattern, axis=0)).mean() > 5 * np.abs(np.diff(pattern, axis=1)).mean()
    assert np.array_equal(pattern, grain(material, 300, 100))
    assert not np.array_equal(pattern, grain(MaterialConfig(grain_seed=4), 300, 100))


def test_grain_lines_repeat_with_their_period() -> None:
    """The strongest frequency across the grain, averaged over columns, is one line a period."""
    pattern = grain(MaterialConfig(grain_period_mm=12), 300, 300)
    power = (np.abs(np.fft.rfft(pattern, axis=0)) ** 2).mean(axis=1)
    per_mm = np.fft.rfftfreq(pattern.shape[0], d=300 / pattern.shape[0])
    assert 1 / per_mm[1 + power[1:].argmax()] == pytest.approx(12, rel=0.25)


@settings(max_examples=20, deadline=None)
@given(mean=st.floats(0.0, 1.0), contrast=st.floats(0.0, 0.3))
def test_clipping_keeps_the_mean(mean: float, contrast: float) -> None:
    noise = np.random.default_rng(1).standard_normal((40, 50))
    albedo = reflectance(noise - noise.mean(), mean, contrast)
    assert albedo.min() >= 0
    assert albedo.max() <= 1
    assert albedo.mean(dtype=float) == pytest.approx(mean, abs=1e-6)


def test_an_image_is_the_albedo_of_the_face(tmp_path: Path) -> None:
    image = np.full((40, 60), 188, np.uint8)  # sRGB of half the light
    image[:20, :30] = 255
    cv2.imwrite(str(tmp_path / "face.png"), image)
    texture = {"file": str(tmp_path / "face.png")}
    material = {
        "albedo_850": 0.5,
        "rgb": (0.5, 0.25, 0.25),
        "grain_contrast": 0.0,
        "texture": texture,
    }
    board = build_target(target(material=MaterialConfig.from_data(material))).parts[0]
    assert board.texture_850 is not None and board.texture_rgb is not None
    assert board.texture_850.mean() == pytest.approx(0.5, rel=1e-6)
    half = ((188 / 255 + 0.055) / 1.055) ** 2.4
    assert board.texture_850[5, 5] / board.texture_850[30, 50] == pytest.approx(1 / half, rel=1e-5)
    assert board.texture_rgb[30, 50] == pytest.approx(
        board.texture_850[30, 50] * np.array([1.0, 0.5, 0.5]), rel=1e-5
    )
    (tmp_path / "face.png").write_text("no image")
    with pytest.raises(UserError, match="is not a readable image"):
        build_target(target(material=MaterialConfig.from_data(material)))


def test_look_up_is_bilinear_between_texel_centres() -> None:
    texture = np.array([[0.0, 1.0], [2.0, 5.0]])
    uv = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.5], [0.0, 0.0], [1.0, 1.0]])
    assert look_up(texture, uv) == pytest.approx([0, 1, 2, 2, 0, 5])
    assert look_up(np.stack([texture, -texture], -1), uv)[:, 1] == pytest.approx(
        [0, -1, -2, -2, 0, -5]
    )


def test_board_uv_follow_the_plan() -> None:
    """Row 0 is the board's upper edge, column 0 its -x edge."""
    built: Target = build_target(
        target(
            holes=(
                HoleConfig(
                    id=1,
                    diameter_mm=20,
                    centre_mm=(50, 10),
                ),
            )
        )
    )
    board = built.parts[0]
    assert board.uv is not None
    points = transform_points(invert(built.T_camera_board), board.mesh.vertices)
    assert board.uv[:, 0] == pytest.approx(points[:, 0] / 0.3 + 0.5, abs=1e-12)
    assert board.uv[:, 1] == pytest.approx(0.5 - points[:, 1] / 0.1, abs=1e-12)
    assert board.texture_850 is not None
    rows, columns = board.texture_850.shape
    assert 0.5 <= 300 / columns <= 1.0
    assert 0.5 <= 100 / rows <= 1.0
    centre = np.array([[(7 + 0.5) / columns, (3 + 0.5) / rows]])
    assert look_up(board.texture_850, centre)[0] == pytest.approx(float(board.texture_850[3, 7]))
    assert board.rgb_at(centre).shape == (1, 3)
