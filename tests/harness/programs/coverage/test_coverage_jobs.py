"""Patches of a part and what a camera sees of them, in closed form."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from harness.experiment.load import load_experiment
from harness.programs.coverage import jobs
from harness.programs.coverage.jobs import (
    MOST_PATCHES,
    _board_seen,
    _inspections,
    _part_seen,
    _unit_and_residual_m,
    _widened,
    declared,
    patches_of,
    refuse_size,
)
from harness.programs.coverage.statistics import Patches
from harness.runs.plan import Group, plan_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Lens, Region
from scenes.perspectives import ArcViews
from scenes.target.custom import BoardConfig
from scenes.target.truth import Damage

PIPE_M = 0.15
LENS = Lens(80, 60, 100.0, 120.0, 40.0, 30.0)
REGION = Region(10, 50, 15, 70)
TILT_RAD = np.radians(30.0)


# ---- patches


def test_patches_of_a_flat_board_are_square_and_cover_it() -> None:
    patches = patches_of(BoardConfig(width_mm=400.0, height_mm=300.0, thickness_mm=5.0))
    assert len(patches.areas_m2) == pytest.approx(MOST_PATCHES, rel=0.03)
    assert patches.areas_m2.sum() == pytest.approx(0.4 * 0.3)
    x = np.unique(patches.points_m[:, 0].round(12))
    y = np.unique(patches.points_m[:, 1].round(12))
    # 400 / sqrt(400 x 300 / 3000) = 63.2 columns, and 47.4 rows
    assert (len(x), len(y)) == (63, 47)
    assert x == pytest.approx((np.arange(63) + 0.5) * 0.4 / 63 - 0.2)
    assert y == pytest.approx((np.arange(47) + 0.5) * 0.3 / 47 - 0.15)
    assert patches.normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (63 * 47, 1)))


def test_a_narrow_board_has_two_patches_across() -> None:
    patches = patches_of(BoardConfig(width_mm=5000.0, height_mm=20.0, thickness_mm=5.0))
    assert len(np.unique(patches.points_m[:, 1])) > 1
    assert patches.areas_m2.sum() == pytest.approx(0.1)


def test_patches_of_a_pipe_have_its_area_and_normals() -> None:
    """An arc of 200 mm chord on a radius of 150 mm: 2 asin(2 / 3) x 150 mm wide."""
    board = load_experiment("pipe").points[0].config.simulated.target.board
    patches = patches_of(board)
    arc_m = 2 * np.arcsin(0.1 / PIPE_M) * PIPE_M
    assert patches.areas_m2.sum() == pytest.approx(arc_m * 0.4, rel=2e-3)
    assert np.linalg.norm(patches.normals, axis=1) == pytest.approx(1.0)
    assert patches.normals[:, 0] == pytest.approx(patches.points_m[:, 0] / PIPE_M, abs=1e-9)


# ---- sizes and boards


@cache
def pipe_group() -> Group:
    (group,) = plan_of(load_experiment("pipe"), Path("cache")).groups
    return group


def test_sizes_outside_the_declared_range_are_refused() -> None:
    """All gouges of the pipe are 10 mm wide: their size is the depth, 0.5 to 7 mm."""
    config = load_experiment("pipe").points[0].config
    for size_mm in (None, 0.5, 3.0, 7.0):
        refuse_size(config, size_mm)
    for size_mm in (0.49, 7.01, 10.0):
        with pytest.raises(UserError, match="inspects no damage of that size") as error:
            refuse_size(config, size_mm)
        assert "0.5 to 7 mm (depth)" in str(error.value)


def test_only_studies_of_drawn_damage_in_single_views_are_declared() -> None:
    config = load_experiment("pipe").points[0].config
    source = config.simulated
    assert declared(config) == (source, source.target)
    views = ArcViews(kind="arc", count=3, spread_deg=20.0)
    for wrong in (
        config.model_copy(update={"study": None}),
        config.model_copy(update={"source": source.model_copy(update={"views": views})}),
        load_experiment("plate").points[0].config,
    ):
        with pytest.raises(UserError, match="is not a study of drawn damage in single views"):
            declared(wrong)


def test_sizes_in_plan_count_if_they_differ() -> None:
    config = load_experiment("detection_limit").points[0].config
    damage = config.simulated.target.damage
    low, high = damage.size_mm
    assert high > low
    refuse_size(config, low)
    refuse_size(config, high)
    for size_mm in (0.99 * low, 1.01 * high):
        with pytest.raises(UserError, match="inspects no damage of that size"):
            refuse_size(config, size_mm)


def test_boards_to_learn_from_are_as_wide_as_the_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pipe is bent by asin(2 / 3) = 41.5 degrees at the outermost patches, and its boards are
    tilted by 5; distances of 0.6 and 0.9 m."""
    monkeypatch.setattr(jobs, "BOARDS", 2)
    boards: list[Any] = []

    def batch(board: Any, role: str, source: Any, cache: Any, number: int) -> Any:
        assert role == "damaged"
        boards.append((board, number))
        return number

    drawn: list[Any] = []
    real = type(pipe_group().points[0].config.simulated.target).drawn
    monkeypatch.setattr(jobs, "batch_of", batch)
    monkeypatch.setattr(
        type(pipe_group().points[0].config.simulated.target),
        "drawn",
        lambda self, role, number: (drawn.append(self), real(self, role, number))[1],
    )
    group: Any = SimpleNamespace(points=pipe_group().points, then=pipe_group().then)
    monkeypatch.setattr(jobs, "replace", lambda old, **new: SimpleNamespace(**new))
    widened: Any = _widened(group, [(0.6, -4.0, 2.0), (0.9, 1.0, 3.0)])
    assert widened.then == (0, 1)
    assert [number for _, number in boards] == [0, 1]
    family = drawn[0]
    outermost = np.degrees(np.arcsin((0.1 - 0.1 / 39) / PIPE_M))
    assert family.tilt_deg == pytest.approx(5.0 + outermost + 4.0, abs=0.3)
    assert family.distance_m == pytest.approx(0.75)
    own_mm = pipe_group().points[0].config.simulated.target.distance_jitter_mm
    assert family.distance_jitter_mm == pytest.approx(own_mm + 150.0)
    assert {point.config.repeats for point in widened.points} == {jobs.LOOKS}
    drawn.clear()
    _widened(group, [(0.6, 0.0, -30.0)])
    assert drawn[0].tilt_deg == 60.0


def damage_of(number: int, diameter_m: float, depth_m: float, **changes: Any) -> Damage:
    facts: dict[str, Any] = {
        "id": number,
        "kind": "blind",
        "diameter_m": diameter_m,
        "depth_m": depth_m,
        "volume_m3": 0.0,
        "centre_board_m": np.zeros(3),
        "axis_board": np.array([0.0, 0.0, 1.0]),
        "centre_camera_m": np.array([0.0, 0.0, 1.0]),
        "axis_camera": np.array([0.0, 0.0, -1.0]),
        **changes,
    }
    return Damage(**facts)


def test_inspections_are_the_scores_of_each_damage() -> None:
    point: Any = SimpleNamespace(
        variant="v", label="", config=SimpleNamespace(capture=SimpleNamespace(frames=5))
    )
    boards = [
        (
            3,
            [
                (damage_of(1, 0.005, 0.002), (1e-3, 0.9, 0.7, 1e-4)),
                (damage_of(2, 0.008, 0.002), (2e-3, 0.8, 0.6, 2e-4)),
            ],
        ),
        (4, [(damage_of(1, 0.006, 0.002), (3e-3, 0.7, 0.5, -3e-4))]),
    ]
    scores = {
        ("v", 5, 3, "1"): [7.0, np.nan],
        ("v", 5, 4, "1"): [np.inf],
        ("v", 6, 3, "2"): [9.0],
        ("w", 5, 3, "2"): [9.0],
    }
    table = _inspections(boards, point, scores)
    assert table.size_of == "diameter"
    assert table.size_mm.tolist() == [5.0, 5.0, 6.0]
    assert table.damage[0] == table.damage[1] != table.damage[2]
    assert table.seen.deviation_m.tolist() == [1e-3, 1e-3, 3e-3]
    assert table.seen.cosine.tolist() == [0.9, 0.9, 0.7]
    assert table.seen.range_m.tolist() == [0.7, 0.7, 0.5]
    assert table.seen.residual_m.tolist() == [1e-4, 1e-4, -3e-4]
    assert table.score[[0, 2]].tolist() == [7.0, np.inf]
    assert np.isnan(table.score[1])
    deep = [
        (
            3,
            [
                (damage_of(1, 0.005, 0.002), (1e-3, 0.9, 0.7, 1e-4)),
                (damage_of(2, 0.005, 0.003), (2e-3, 0.8, 0.6, 2e-4)),
            ],
        )
    ]
    table = _inspections(deep, point, {("v", 5, 3, "1"): [7.0], ("v", 5, 3, "2"): [8.0]})
    assert table.size_of == "depth"
    assert table.size_mm.tolist() == [2.0, 3.0]
    with pytest.raises(UserError, match="v: no damaged board was judged"):
        _inspections(boards, point, {})


# ---- the unit of score


def test_the_unit_of_score_is_residual_over_score_nearby(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two averages of random residuals; of some columns one or none is judged."""
    rng = np.random.default_rng(2)
    shape = (60, 90)
    residual_m = 1e-3 * rng.standard_normal((2, *shape))
    score = rng.standard_normal((2, *shape)) * np.linspace(1.0, 2.0, 90)
    score[:, :, :30] = np.nan
    score[0, :, 30:50] = np.nan
    evidence = [
        SimpleNamespace(score=s, residual_m=r) for s, r in zip(score, residual_m, strict=True)
    ]
    taken = iter(evidence)
    detector = SimpleNamespace(analyse=lambda cloud: next(taken))
    monkeypatch.setattr(jobs, "detector_of", lambda *_: detector)
    monkeypatch.setattr(jobs, "cloud_of", lambda task, point: None)
    monkeypatch.setattr(jobs, "Trial", lambda **facts: SimpleNamespace(**facts))
    criteria = SimpleNamespace(detector="d", settings_json="{}", learned=None)
    batch: Any = SimpleNamespace(before=lambda repeat: (), board=1)
    point: Any = SimpleNamespace(criteria=criteria)
    unit_m, around_m = _unit_and_residual_m(batch, point, 1)
    judged = np.isfinite(score)
    share = judged.mean(axis=0)
    residual_square = np.where(judged, residual_m**2, 0.0).mean(axis=0)
    score_square = np.where(judged, score**2, 0.0).mean(axis=0)
    window = np.ones((31, 31)) / 31**2
    near = np.ones((15, 15)) / 15**2
    square = ndimage.convolve(residual_square, window)[:, 30:]
    square /= ndimage.convolve(score_square, window)[:, 30:]
    square /= ndimage.convolve(share, near)[:, 30:]
    assert np.isinf(unit_m[:, :30]).all()
    assert unit_m[:, 30:] == pytest.approx(np.sqrt(square), rel=1e-6)
    residual = ndimage.convolve(np.where(judged, residual_m, 0.0).mean(axis=0), window)
    assert (around_m[:, :30] == 0).all()
    mean_m = residual[:, 30:] / ndimage.convolve(share, window)[:, 30:]
    assert around_m[:, 30:] == pytest.approx(mean_m, rel=1e-6)


def test_damage_is_seen_from_its_own_place(monkeypatch: pytest.MonkeyPatch) -> None:
    unit_m = np.arange(12.0).reshape(3, 4)
    damage = damage_of(
        7,
        0.005,
        0.002,
        centre_camera_m=np.array([0.3, 0.0, 0.4]),
        axis_camera=np.array([0.0, 0.6, -0.8]),
    )
    set_up = SimpleNamespace(truth=(damage,), outlines={7: np.array([1, 2, 9])})
    monkeypatch.setattr(jobs, "load_board", lambda ref: set_up)
    monkeypatch.setattr(jobs, "_unit_and_residual_m", lambda *_: (unit_m, unit_m**2))
    batch: Any = SimpleNamespace(views=("a view",), board=5)
    number, ((found, seen),) = _board_seen(batch, batch, None, 1)  # type: ignore[arg-type]
    assert number == 5
    assert found is damage
    # a cosine of 0.8 x 0.4 / 0.5
    # the mean of 1, 4 and 81
    assert seen == pytest.approx((2.0, 0.64, 0.5, 86.0 / 3.0))
    batch.board = None
    assert _board_seen(batch, batch, None, 1)[0] == 0  # type: ignore[arg-type]


# ---- the part


def seen_by(monkeypatch: pytest.MonkeyPatch, points_m: Any, normals: Any, in_front_m: float) -> Any:
    """What a camera whose sensor is `REGION` sees of patches of a wall at 1 m, tilted by 30
    degrees about y; something stands in front of the wall by so much in the rows from 40 on."""
    slopes = LENS.region_slopes(REGION)
    wall_z_m = 1.0 / (1.0 - np.tan(TILT_RAD) * slopes[..., 0])
    wall_z_m[30:] -= in_front_m
    camera = SimpleNamespace(nominal_lens=LENS, images=LENS.images)
    unit = SimpleNamespace(region=REGION, camera=camera)
    set_up = SimpleNamespace(T_camera_board=np.eye(4), unit=unit, seen_z_m=wall_z_m)
    rows, columns = REGION.shape
    unit_m = np.arange(float(rows * columns)).reshape(rows, columns)
    monkeypatch.setattr(jobs, "load_board", lambda ref: set_up)
    monkeypatch.setattr(jobs, "_unit_and_residual_m", lambda *_: (unit_m, 2.0 * unit_m))
    patches = Patches(np.array(points_m), np.array(normals), np.ones(len(points_m)))
    return _part_seen(SimpleNamespace(views=("a view",)), None, 1, patches)  # type: ignore[arg-type]


def on_wall(u: float, v: float, off_m: float = 0.0) -> list[float]:
    """The point of the wall that a pixel sees, moved along the ray to another z."""
    x = (u - LENS.cx) / LENS.fx
    y = (v - LENS.cy) / LENS.fy
    z = 1.0 / (1.0 - np.tan(TILT_RAD) * x) + off_m
    return [x * z, y * z, z]


FACING = [np.sin(TILT_RAD), 0.0, -np.cos(TILT_RAD)]


def test_patches_have_the_noise_of_their_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels at each corner of the region and one beyond each side."""
    pixels = [(15, 10), (69, 10), (15, 49), (69, 49), (14, 30), (70, 30), (40, 9), (40, 50)]
    points = [on_wall(u, v) for u, v in pixels]
    visibility = seen_by(monkeypatch, points, len(pixels) * [FACING], 0.0)
    columns = REGION.shape[1]
    corners = [0, columns - 1, 39 * columns, 40 * columns - 1]
    assert visibility.deviation_m.tolist() == [*corners, np.inf, np.inf, np.inf, np.inf]
    assert visibility.residual_m.tolist() == [*(2 * corner for corner in corners), 0, 0, 0, 0]
    ranges_m = np.linalg.norm(points, axis=1)
    assert visibility.range_m == pytest.approx(ranges_m)
    assert visibility.cosine == pytest.approx(-(np.array(points) @ FACING) / ranges_m)


def test_a_patch_behind_something_is_not_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a slope, two pixels along it: 2 tan(angle) x range / 100, here about 12 mm at the axis."""
    point = on_wall(40, 30)
    angle = np.arccos(np.cos(TILT_RAD))
    reach_m = 2 * np.tan(angle) * 1.0 / 100.0
    points = [point, on_wall(40, 30, 0.99 * reach_m), on_wall(40, 30, 1.02 * reach_m)]
    visibility = seen_by(monkeypatch, points, 3 * [FACING], 0.0)
    assert np.isfinite(visibility.deviation_m).tolist() == [True, True, False]
    level = [0.0, 0.0, -1.0]
    points = [on_wall(40, 30, 4.9e-3), on_wall(40, 30, 5.1e-3), on_wall(40, 30, -5.1e-3)]
    visibility = seen_by(monkeypatch, points, 3 * [level], 0.0)
    assert np.isfinite(visibility.deviation_m).tolist() == [True, False, False]
    visibility = seen_by(monkeypatch, [on_wall(40, 39), on_wall(40, 40)], 2 * [FACING], 0.05)
    assert np.isfinite(visibility.deviation_m).tolist() == [True, False]


def test_a_patch_that_faces_away_is_not_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    away = [0.0, 0.0, 1.0]
    seen = seen_by(monkeypatch, 2 * [on_wall(40, 30)], [away, [1.0, 0.0, -1e-9]], 0.0)
    assert np.isinf(seen.deviation_m[0])
    assert seen.cosine[0] == 1e-3
    assert seen.cosine[1] == 1e-3
