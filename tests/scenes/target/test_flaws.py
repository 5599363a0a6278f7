"""Kinds of damage as depths over a frame of their own: volumes, outlines, refusals, families, what
counts as a hit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.ndimage import uniform_filter

from detectors.findings.measure import measure_detection
from detectors.findings.surroundings import HoleModelConfig
from detectors.interface import Detection, Evidence, Measurement
from harness.trials.board import LabelledCloud
from harness.trials.judge import matched
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, Region
from scenes.target.checks import check_target
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.flaws import CorrosionConfig, _mean
from scenes.target.mesh import Target, board_solid, build_target
from scenes.target.part import crossing, part_of
from scenes.target.truth import face_of, outline_board_m, truth_of
from tests.support.declared_targets import target_from_data

BOARD = {"width_mm": 300.0, "height_mm": 200.0, "thickness_mm": 12.0}
PIPE = {**BOARD, "shape": {"kind": "cylinder", "radius_mm": 200.0}}
INSIDE = {
    **BOARD,
    "shape": {
        "kind": "cylinder",
        "radius_mm": 300.0,
        "bulge": "away",
        "straight_along": "x",
    },
}
SLOT = {
    "kind": "slot",
    "length_mm": 60.0,
    "width_mm": 3.0,
    "depth_mm": 8.0,
    "angle_deg": 30.0,
}
V_GOUGE = {
    "kind": "gouge",
    "length_mm": 60.0,
    "width_mm": 6.0,
    "depth_mm": 2.0,
    "angle_deg": -20.0,
}
ROUND_GOUGE = {**V_GOUGE, "section": "round", "run_out_mm": 10.0}
DENT = {"kind": "pressed_dent", "diameter_mm": 40.0, "depth_mm": 5.0}
CORROSION = {"kind": "corrosion", "diameter_mm": 30.0, "depth_mm": 1.5}
CHIP = {
    "kind": "chip",
    "length_mm": 40.0,
    "width_mm": 10.0,
    "depth_mm": 6.0,
    "angle_deg": 0,
}
SPATTER = {"kind": "protrusion", "diameter_mm": 8.0, "depth_mm": 3.0}
VOLUMES_MM3 = [
    (SLOT, 60 * 3 * 8),
    ({**SLOT, "wander_mm": 3.0}, 60 * 3 * 8),
    ({**SLOT, "depth_mm": None}, 60 * 3 * 12),
    (V_GOUGE, 6 * 2 * (60 - 5) / 2),
    (ROUND_GOUGE, 6 * 2 * (60 - 10) * 2 / 3),
    (DENT, math.pi * 20**2 * 5 * (0.5 - 2 / math.pi**2)),
    (CORROSION, math.pi * 15**2 * 1.5),
    (CHIP, math.pi / 3 * 20 * 10 * 6),
    (SPATTER, math.pi * 4**2 * 3 / 2),
]
"""In closed form, on a flat face."""


def target(*flaws: dict[str, Any], board: dict[str, Any] = BOARD) -> TargetConfig:
    placed = []
    for number, flaw in enumerate(flaws, start=1):
        centre = [0.0, board["height_mm"] / 2] if flaw["kind"] == "chip" else [20.0 * number, 10.0]
        placed.append({"id": number, "centre_mm": centre, **flaw})
    config = target_from_data({"name": "custom", "board": board, "flaws": placed})
    assert isinstance(config, TargetConfig)
    return config


def removed_m3(built: Target) -> float:
    undamaged = board_solid(built.config.hole_free(), ())
    remaining = built.parts[0].mesh
    assert remaining.is_watertight
    assert remaining.is_winding_consistent
    return float(undamaged.volume - remaining.volume)


@pytest.mark.parametrize(
    ("flaw", "volume_mm3"),
    VOLUMES_MM3,
    ids=lambda damage: damage["kind"] if isinstance(damage, dict) else "",
)
def test_volumes_are_those_of_closed_forms_and_of_the_mesh(
    flaw: dict[str, Any],
    volume_mm3: float,
) -> None:
    built = build_target(target(flaw))
    (truth,) = built.truth
    assert truth.volume_m3 * 1e9 == pytest.approx(volume_mm3, rel=5e-3)
    expected = {"pressed_dent": 0.0, "protrusion": -truth.volume_m3}.get(
        truth.kind, truth.volume_m3
    )
    assert removed_m3(built) == pytest.approx(expected, rel=5e-3, abs=1e-12)


@pytest.mark.parametrize("board", [PIPE, INSIDE], ids=["pipe", "inside"])
def test_volumes_on_bent_boards(board: dict[str, Any]) -> None:
    for flaw in (SLOT, V_GOUGE, CORROSION, CHIP):
        built = build_target(target(flaw, board=board))
        assert removed_m3(built) == pytest.approx(built.truth[0].volume_m3, rel=5e-3)


def test_a_sheet_pressed_deeper_than_it_is_thick_stays_whole() -> None:
    """Front and back move by the same depth: the sheet keeps its volume, and its front is
    displaced as declared."""
    sheet = {**BOARD, "thickness_mm": 0.8}
    for kind, sign in (("pressed_dent", -1.0), ("pressed_bump", 1.0)):
        built = build_target(target({**DENT, "kind": kind}, board=sheet))
        mesh = board_solid(built.config, built.truth)
        undamaged = board_solid(built.config.hole_free(), ())
        assert mesh.is_watertight
        assert mesh.euler_number == 2
        assert mesh.volume == pytest.approx(undamaged.volume, rel=1e-6)
        deep = -0.8e-3 - 5e-3 if sign < 0 else -0.8e-3
        assert mesh.vertices[:, 2].min() == pytest.approx(deep, abs=1e-9)
        assert mesh.vertices[:, 2].max() == pytest.approx(5e-3 if sign > 0 else 0.0, abs=1e-9)
        assert built.truth[0].raised is (sign > 0)


@pytest.mark.parametrize("seed", range(13))
def test_corrosion_narrower_than_its_grain_has_the_stated_depth(seed: int) -> None:
    relief = CorrosionConfig(
        id=1,
        kind="corrosion",
        centre_mm=(0.0, 0.0),
        diameter_mm=2.0,
        depth_mm=0.5,
        grain_mm=3.0,
        seed=seed,
    ).relief()
    assert np.isfinite(relief.depth_m).all()
    depth_m = _mean(relief.s_m, relief.t_m, relief.depth_m)
    assert depth_m == pytest.approx(0.5e-3)


def test_corrosion_has_the_stated_statistics() -> None:
    relief = CorrosionConfig(
        id=1,
        centre_mm=(0, 0),
        kind="corrosion",
        diameter_mm=60.0,
        depth_mm=2.0,
        rough_mm=0.4,
    ).relief()
    inner = relief.depth_m[16:49, 16:49]
    assert inner.std() * 1e3 == pytest.approx(0.4, rel=0.2)
    assert inner.mean() * 1e3 == pytest.approx(2.0, rel=0.15)


def test_outline_tells_inside_from_outside() -> None:
    (truth,) = truth_of(target({**SLOT, "angle_deg": 90.0}), np.eye(4))
    x = np.array([20.0, 20.0, 22.0, 20.0, 60.0]) * 1e-3
    y = np.array([10.0, 39.0, 10.0, 41.0, 10.0]) * 1e-3
    assert truth.within(x, y).tolist() == [True, True, False, False, False]
    assert truth.within(x, y, 1.1e-3).tolist() == [True, True, True, True, False]
    assert (truth.length_m, truth.width_m) == pytest.approx((0.06, 0.003))
    assert truth.size_of == "width"


@pytest.mark.parametrize(
    ("flaws", "message"),
    [
        ([{**SLOT, "depth_mm": 12.0}], "not less than the board's thickness"),
        ([{**SLOT, "centre_mm": [140.0, 0.0]}], "leaves the board"),
        ([{**CHIP, "centre_mm": [0.0, 50.0]}], "50 mm away from the edge that angle_deg names"),
        ([SLOT, {**SLOT, "angle_deg": -30.0}], "meet"),
        ([{**CHIP, "length_mm": 320.0}], "leaves the board"),
    ],
)
def test_what_cannot_be_built_is_refused(
    flaws: list[dict[str, Any]],
    message: str,
) -> None:
    with pytest.raises(UserError, match=message):
        check_target(target(*flaws))


def test_parallel_slots_may_lie_nearer_than_they_are_long() -> None:
    check_target(target({**SLOT, "centre_mm": [0.0, 0.0]}, {**SLOT, "centre_mm": [0.0, 15.0]}))


SHAPES = (
    {"kind": "corrugated"},
    {"kind": "corrugated", "straight_along": "x"},
    {"kind": "panel"},
    {"kind": "rough"},
    {"kind": "made", "shape": {"kind": "panel"}, "form_mm": 1.0, "sizes_percent": 5.0},
)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape["kind"])
def test_derivatives_of_faces_are_those_of_their_heights(shape: dict[str, Any]) -> None:
    face = face_of(target(board={**BOARD, "shape": shape}).board)
    x, y = np.random.default_rng(1).uniform(-0.09, 0.09, (2, 50))
    step = 1e-5
    slopes = [
        (face.height_m(x + dx, y + dy) - face.height_m(x - dx, y - dy)) / (2 * step)
        for dx, dy in ((step, 0), (0, step))
    ]
    bends = [
        (face.slope(x + dx, y + dy)[:, k] - face.slope(x - dx, y - dy)[:, k]) / (2 * step)
        for dx, dy, k in ((step, 0, 0), (0, step, 0), (0, step, 1))
    ]
    assert np.allclose(face.slope(x, y), np.transpose(slopes), atol=2e-6)
    assert np.allclose(
        face.bend(x, y), np.transpose(bends), atol=0.5 if shape["kind"] == "rough" else 1e-3
    )
    assert abs(float(face.height_m(0.0, 0.0))) < 1e-12


def test_made_boards_differ_from_the_drawing_as_declared() -> None:
    x, y = np.meshgrid(np.linspace(-0.15, 0.15, 61), np.linspace(-0.1, 0.1, 41))
    plane = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    deviations = []
    for seed in range(60):
        shape = {"kind": "made", "shape": {"kind": "flat"}, "form_mm": 0.5, "seed": seed}
        board = target(board={**BOARD, "shape": shape}).board
        assert board.as_drawn.shape.kind == "flat"
        form_m = face_of(board).height_m(x, y).ravel()
        form_m = form_m - plane @ np.linalg.lstsq(plane, form_m, rcond=None)[0]
        deviations.append(np.mean(form_m**2))
    # of 60 x 7 random amplitudes: 3.5 %
    assert np.sqrt(np.mean(deviations)) == pytest.approx(0.5e-3, rel=0.1)
    steps = []
    for seed in range(60):
        panel = {"kind": "panel", "radius_x_mm": 1e6, "radius_y_mm": 1e6}
        shape = {"kind": "made", "shape": panel, "form_mm": 0.0, "sizes_percent": 5.0, "seed": seed}
        face = face_of(target(board={**BOARD, "shape": shape}).board)
        steps.append(float(face.height_m(0.0, 0.1) - face.height_m(0.0, -0.1)))
    assert np.std(steps) / np.mean(steps) == pytest.approx(0.05, rel=0.35)


def test_a_rough_board_has_its_deviation_and_every_board_its_own_face() -> None:
    damage = {
        "kind": "slot",
        "per_board": 2,
        "width_mm": [1.0, 5.0],
        "length_mm": [40.0, 40.0],
        "depth_mm": [8.0, 8.0],
    }
    board = {**BOARD, "thickness_mm": 40.0, "shape": {"kind": "rough", "deviation_mm": 0.4}}
    family = target_from_data(
        {
            "name": "drawn",
            "damage": damage,
            "board": board,
            "apart_mm": 60.0,
        }
    )
    assert isinstance(family, DrawnTargetConfig)
    first = family.drawn("damaged", 0)
    second = family.drawn("damaged", 1)
    x, y = np.meshgrid(np.linspace(-0.14, 0.14, 200), np.linspace(-0.09, 0.09, 150))
    heights = [face_of(damage.board).height_m(x, y) for damage in (first, second)]
    assert [height.std() * 1e3 for height in heights] == pytest.approx([0.4, 0.4], rel=0.25)
    assert abs(np.corrcoef(heights[0].ravel(), heights[1].ravel())[0, 1]) < 0.5
    built = build_target(first)
    assert removed_m3(built) == pytest.approx(
        sum(damage.volume_m3 for damage in built.truth), rel=5e-3
    )
    with pytest.raises(UserError, match="smooth face"):
        check_target(
            first.model_copy(
                update={"flaws": (), "holes": target_from_data(_one_hole(board)).holes}
            )
        )


def _one_hole(board: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": "custom",
        "board": board,
        "holes": [{"id": 1, "diameter_mm": 5.0, "centre_mm": [0.0, 0.0]}],
    }


RANGES = {"depth_mm": [0.5, 3.0], "per_board": 5}
FAMILIES: tuple[dict[str, Any], ...] = (
    {
        "kind": "slot",
        "width_mm": [0.5, 5.0],
        "length_mm": [30.0, 50.0],
        "wander_mm": 1.0,
        **RANGES,
    },
    {
        "kind": "gouge",
        "width_mm": [4.0, 6.0],
        "length_mm": [20.0, 40.0],
        **RANGES,
    },
    {"kind": "pressed_bump", "diameter_mm": [10.0, 40.0], **RANGES},
    {"kind": "corrosion", "diameter_mm": [10.0, 30.0], **RANGES},
    {
        "kind": "chip",
        "length_mm": [10.0, 30.0],
        "width_mm": [3.0, 6.0],
        **RANGES,
    },
    {"kind": "protrusion", "diameter_mm": [3.0, 9.0], **RANGES},
)


@pytest.mark.parametrize("damage", FAMILIES, ids=lambda damage: damage["kind"])
def test_every_drawn_board_can_be_built_and_is_drawn_again_alike(damage: dict[str, Any]) -> None:
    family = target_from_data(
        {
            "name": "drawn",
            "damage": damage,
            "apart_mm": 60.0,
            "board": PIPE,
        }
    )
    assert isinstance(family, DrawnTargetConfig)
    for number in range(4):
        config = family.drawn("damaged", number)
        check_target(config)
        sizes = [flaw.size_mm for flaw in config.flaws]
        depths = [flaw.depth_mm for flaw in config.flaws]
        assert sizes == sorted(sizes)
        assert min(depths) >= 0.5
        assert max(depths) <= 3.0
        assert family.drawn("damaged", number) == config
    assert config.hole_free().damages == ()
    assert outline_board_m(config.board).shape[1] == 3


def known_slot() -> LabelledCloud:
    """A flat board seen straight on, a pixel each millimetre, with a slot along x about (20, 10)
    mm."""
    config = target({**SLOT, "angle_deg": 0.0})
    x, y = np.meshgrid(np.arange(-149.5, 150) * 1e-3, np.arange(-99.5, 100) * 1e-3)
    points = np.stack([x, y, np.zeros(x.shape)], axis=-1)
    zeros = np.zeros(x.shape, np.uint8)
    region = Region(0, x.shape[0], 0, x.shape[1])
    cloud = Cloud(
        points,
        zeros,
        zeros.astype(int),
        np.full(x.shape, np.nan),
        region,
        0.0,
        1,
        projection="parallel",
    )
    truth = truth_of(config, np.eye(4))
    outlines = {1: np.flatnonzero(truth[0].within(x, y))}
    return LabelledCloud(
        cloud=cloud,
        damaged=True,
        T_board_cloud=np.eye(4),
        target=config,
        truth=truth,
        outlines=outlines,
        places_m=points[..., :2],
        undamaged=zeros == 0,
        seen_depth_m={1: 0.008},
    )


def finding(
    known_cloud: LabelledCloud,
    x_mm: tuple[float, float],
    y_mm: tuple[float, float],
) -> Detection:
    x, y = np.moveaxis(known_cloud.places_m, -1, 0) * 1e3
    inside = (x > x_mm[0]) & (x < x_mm[1]) & (y > y_mm[0]) & (y < y_mm[1])
    centre = np.append(known_cloud.places_m[inside].mean(axis=0), 0.0)
    return Detection(1.0, np.flatnonzero(inside), centre)


def test_what_counts_for_a_slot() -> None:
    """The slot lies from x = -10 to 50 mm at y = 10 mm."""
    known_cloud = known_slot()
    end = finding(known_cloud, (38, 50), (8, 12))
    middle = finding(known_cloud, (0, 20), (8, 12))
    beside = finding(known_cloud, (0, 20), (16, 24))
    away = finding(known_cloud, (0, 20), (40, 44))
    assert matched(known_cloud, [end], 5e-3, None) == (
        {0: 0},
        0,
    )  # 24 mm from its centre, but on its line
    assert matched(known_cloud, [beside], 5e-3, None) == ({}, 0)
    assert matched(known_cloud, [away, middle], 15e-3, None) == ({0: 1}, 0)
    # the second piece of a slot is a false call by its centre alone, a part of the slot by overlap
    assert matched(known_cloud, [end, middle], 15e-3, None)[1] == 0
    assert matched(known_cloud, [end, middle], 15e-3, 0.5)[1] == 1
    # a wide finding whose centre lies off the line still counts where half of it lies on the slot,
    # and not otherwise
    wide = finding(known_cloud, (0, 20), (6, 20))
    assert matched(known_cloud, [wide], 1e-3, None) == ({}, 0)
    assert matched(known_cloud, [wide], 1e-3, 0.4) == ({0: 0}, 0)
    assert matched(known_cloud, [wide], 1e-3, 0.9) == ({}, 0)
    assert matched(known_cloud, [], 1e-3, 0.4) == ({}, 0)


def slot_seen(
    angle_deg: float,
    length_mm: float,
    width_mm: float,
) -> Measurement:
    """A slot 6 mm deep in a plane at 0.7 m, seen by pixels of 1 mm through a window of 5, with
    little noise."""
    u, v = np.meshgrid(np.arange(-60, 61) * 1.0, np.arange(-50, 51) * 1.0)
    turn = np.deg2rad(angle_deg)
    fine = np.repeat(np.repeat(np.zeros(u.shape), 4, axis=0), 4, axis=1)
    y, x = (np.indices(fine.shape) + 0.5) / 4 - 0.5 - np.array([50, 60])[:, None, None]
    s = x * np.cos(turn) + y * np.sin(turn)
    t = -x * np.sin(turn) + y * np.cos(turn)
    inside = (np.abs(s) < length_mm / 2) & (np.abs(t) < width_mm / 2)
    depth = uniform_filter(inside.reshape(101, 4, 121, 4).mean(axis=(1, 3)), 5) * 6e-3
    depth += np.random.default_rng(1).normal(0, 5e-5, depth.shape)
    z = 0.7 + depth
    points = np.stack([u / 700 * z, v / 700 * z, z], axis=-1)
    zeros = np.zeros(u.shape, np.uint8)
    cloud = Cloud(
        points,
        zeros,
        zeros.astype(int),
        np.full(u.shape, np.nan),
        Region(0, 101, 0, 121),
        0.0,
        1,
    )
    evidence = Evidence(depth / 5e-5, depth, np.full(u.shape, 0.7), 5e-5)
    pixels = np.flatnonzero(depth.ravel() > 1e-3)
    return measure_detection(
        cloud,
        evidence,
        Detection(20.0, pixels, points.reshape(-1, 3)[pixels].mean(0)),
        HoleModelConfig(),
    )


@pytest.mark.parametrize(
    ("angle_deg", "length_mm", "width_mm"),
    [(0.0, 40.0, 6.0), (35.0, 50.0, 8.0), (-60.0, 30.0, 10.0)],
)
def test_a_long_finding_has_length_width_and_direction(
    angle_deg: float,
    length_mm: float,
    width_mm: float,
) -> None:
    measured = slot_seen(angle_deg, length_mm, width_mm)
    assert measured.length_m * 1e3 == pytest.approx(length_mm, rel=0.05)
    assert measured.width_m * 1e3 == pytest.approx(width_mm, rel=0.2)
    seen_deg = np.degrees(np.arctan2(measured.along[1], measured.along[0]))
    assert abs((seen_deg - angle_deg + 90) % 180 - 90) < 2


# ---- parts from mesh files


def part_file(
    folder: Path,
    *,
    keep: slice = slice(None),
    name: str = "part.stl",
) -> Path:
    """An ellipsoid of 200 x 160 x 100 mm, without some of its triangles."""
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=100.0)
    mesh.apply_scale([1.0, 0.8, 0.5])
    faces = np.asarray(mesh.faces)[keep]
    trimesh.Trimesh(mesh.vertices, faces, process=False).export(folder / name)
    return folder / name


def test_the_front_of_a_part_lies_about_the_middle_of_its_bounds(tmp_path: Path) -> None:
    """A box from (10, 20, 30) to (50, 100, 60) mm, whose file has its origin elsewhere."""
    box = trimesh.creation.box(bounds=[[10.0, 20.0, 30.0], [50.0, 100.0, 60.0]])
    box.export(tmp_path / "box.stl")
    config = target_from_data({"name": "mesh", "file": str(tmp_path / "box.stl")}).declare()
    points, triangles = part_of(config.board.shape)
    assert points.min(axis=0) == pytest.approx([-0.02, -0.04, -0.03])
    assert points.max(axis=0) == pytest.approx([0.02, 0.04, 0.0], abs=1e-9)
    assert len(triangles) == 12


def test_damage_lies_on_the_front_of_a_mesh(tmp_path: Path) -> None:
    flaws = [
        {"id": 1, "centre_mm": [0.0, 0.0], **SLOT},
        {
            "id": 2,
            "centre_mm": [-45.0, 20.0],
            "kind": "corrosion",
            "diameter_mm": 20.0,
            "depth_mm": 2.0,
        },
        {"id": 3, "centre_mm": [45.0, 20.0], **SPATTER},
    ]
    data = {"name": "mesh", "file": str(part_file(tmp_path)), "flaws": flaws}
    config = target_from_data(data).declare()
    assert isinstance(config, TargetConfig)
    built = build_target(config)
    assert (
        config.board.width_mm,
        config.board.height_mm,
        config.board.thickness_mm,
    ) == pytest.approx((200, 160, 100))
    assert removed_m3(built) == pytest.approx(
        sum(damage.volume_m3 * (-1 if damage.raised else 1) for damage in built.truth), rel=5e-3
    )
    face = face_of(config.board)
    x = np.array([0.0, 60e-3, 0.0])
    y = np.array([0.0, 0.0, 40e-3])
    expected = 50e-3 * (np.sqrt(1 - (x / 0.1) ** 2 - (y / 0.08) ** 2) - 1)
    assert np.allclose(face.height_m(x, y), expected, atol=2e-4)
    assert np.isnan(face.height_m(0.11, 0.0))
    turned = target_from_data({**data, "front": "+x", "flaws": []}).declare().board
    assert (turned.width_mm, turned.height_mm, turned.thickness_mm) == pytest.approx(
        (100, 160, 200)
    )


def test_meshes_that_cannot_be_used_are_refused_with_the_place(tmp_path: Path) -> None:
    opened = part_file(
        tmp_path,
        keep=slice(3, None),
        name="open.stl",
    )
    (tmp_path / "no.stl").write_text("no mesh")
    for file, message in (
        (opened, r"open.stl: open edges: \d+, the first at \("),
        (tmp_path / "part.step", "not triangles"),
        (tmp_path / "absent.stl", "cannot be read"),
        (tmp_path / "no.stl", r"not a (readable )?mesh|are open|holds no triangles"),
    ):
        with pytest.raises(UserError, match=message):
            target_from_data({"name": "mesh", "file": str(file)}).declare()
    first = trimesh.creation.box((20.0, 20.0, 20.0))
    second = first.copy()
    trimesh.util.concatenate([first, second.apply_translation([8.0, 7.0, 6.0])]).export(
        tmp_path / "cross.stl"
    )
    with pytest.raises(
        UserError, match=r"cross.stl: triangles that cross others: \d+, the first at \(-?\d"
    ):
        target_from_data({"name": "mesh", "file": str(tmp_path / "cross.stl")}).declare()
    off = {"id": 1, "centre_mm": [95.0, 0.0], **SLOT}
    with pytest.raises(UserError, match=r"leaves the part's front|too large"):
        check_target(
            target_from_data(
                {"name": "mesh", "file": str(part_file(tmp_path)), "flaws": [off]}
            ).declare()
        )


def test_crossing_triangles_are_those_that_pierce_each_other() -> None:
    flat = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0.0]])
    upright = np.array([[1, 1, -1], [1, 1, 1], [9, 9, 0.0]])
    touching = upright + np.array([0, 0, 1])
    far = flat + np.array([20, 0, 0])
    assert crossing(np.stack([flat, far, upright])).tolist() == [0, 2]
    assert not crossing(np.stack([flat, far, touching])).size
    assert not crossing(trimesh.creation.icosphere(subdivisions=3).triangles).size


def test_a_family_of_damage_on_a_mesh_keeps_to_its_front(tmp_path: Path) -> None:
    shape = {"kind": "mesh", "file": str(part_file(tmp_path))}
    damage = {
        "kind": "corrosion",
        "per_board": 3,
        "diameter_mm": [8.0, 14.0],
        "depth_mm": [0.5, 1.5],
    }
    family = target_from_data(
        {
            "name": "drawn",
            "damage": damage,
            "board": {
                "width_mm": 200.0,
                "height_mm": 160.0,
                "thickness_mm": 100.0,
                "shape": shape,
            },
            "apart_mm": 30.0,
            "edge_mm": 30.0,
        }
    )
    assert isinstance(family, DrawnTargetConfig)
    for number in range(3):
        built = build_target(family.drawn("damaged", number))
        assert removed_m3(built) == pytest.approx(
            sum(damage.volume_m3 for damage in built.truth), rel=1e-2
        )
