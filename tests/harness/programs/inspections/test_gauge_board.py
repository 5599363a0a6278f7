"""Findings of a capture matched to a gauge's holes, on planted findings."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from harness.programs.inspections.gauge_board import (
    GaugeBoard,
    GaugeHole,
    GaugeMark,
    GaugeSeen,
    _matched,
)
from harness.vocabulary.geometry import MM, invert, transform_points

COUNTED = ("plane 1", 5.0, 10.0)
HOLES = (
    GaugeHole(id=1, diameter_mm=6.0, x_mm=0.0, y_mm=0.0),
    GaugeHole(id=2, diameter_mm=6.0, x_mm=50.0, y_mm=0.0),
    GaugeHole(id=3, diameter_mm=6.0, x_mm=-50.0, y_mm=20.0),
    GaugeHole(id=4, diameter_mm=6.0, x_mm=0.0, y_mm=-60.0),
)
MARKS = (GaugeMark(code=1, x_mm=70.0, y_mm=60.0, side_mm=15.0),)
BOARD = GaugeBoard(name="b", width_mm=200.0, height_mm=160.0, marks=MARKS, holes=HOLES)


def pose() -> np.ndarray:
    T = np.eye(4)
    turn = Rotation.from_euler("x", 180, degrees=True) * Rotation.from_euler("y", 12, degrees=True)
    T[:3, :3] = turn.as_matrix()
    T[:3, 3] = [0.02, -0.01, 0.6]
    return T


def in_camera(places_mm: Any, behind_m: float = 0.0) -> np.ndarray:
    """Points of the board's face, moved along their lines of sight."""
    positions = np.atleast_2d(np.array(places_mm, float)) * MM
    points = np.column_stack([positions, np.zeros(len(positions))])
    camera_points = transform_points(pose(), points)
    range_m = np.linalg.norm(camera_points, axis=1, keepdims=True)
    return camera_points * (1 + behind_m / range_m)


def judged_with(
    findings_mm: list[tuple[float, float]], blind: Any = None, behind_m: float = 0.02
) -> Any:
    """Findings behind the face, on a face that is judged everywhere but where ``blind`` says."""
    x_mm, y_mm = np.meshgrid(np.arange(-110.0, 111.0, 2.0), np.arange(-90.0, 91.0, 2.0))
    positions = np.stack([x_mm, y_mm], axis=-1).reshape(-1, 2)
    points = in_camera(positions).reshape(*x_mm.shape, 3)
    score = np.zeros(x_mm.shape)
    if blind is not None:
        score[blind(x_mm, y_mm)] = np.nan
    detections = [
        SimpleNamespace(centre_m=in_camera(position, behind_m)[0], score=6.0 + number)
        for number, position in enumerate(findings_mm)
    ]
    cloud = SimpleNamespace(points_m=points)
    return SimpleNamespace(
        cloud=cloud, detections=detections, evidence=SimpleNamespace(score=score)
    )


def matched(judged: Any) -> tuple[list[Any], int]:
    return _matched(BOARD, COUNTED, judged, invert(pose()))


def test_findings_are_matched_where_their_line_of_sight_meets_the_face() -> None:
    """The second lies 9 mm from its hole, the third 11 mm; 20 mm behind the face, they would
    seem to lie elsewhere."""
    rows, calls = matched(judged_with([(0.0, 0.0), (50.0, 9.0), (-50.0, 31.0)]))
    assert [row.found for row in rows] == ["hit", "hit", "miss", "miss"]
    assert rows[0].offset_mm == pytest.approx(0.0, abs=1e-6)
    assert rows[1].offset_mm == pytest.approx(9.0)
    assert [row.score for row in rows] == [6.0, 7.0, None, None]
    assert rows[2].offset_mm is None
    assert [row.hole.id for row in rows] == [1, 2, 3, 4]
    assert rows[0].counted == COUNTED
    assert calls == 1


def test_findings_beside_the_board_and_on_marks_are_no_false_calls() -> None:
    """A mark keeps its side's length free on all sides."""
    beside = [(99.0, 0.0), (101.0, 0.0), (0.0, 79.0), (0.0, 81.0), (-99.0, -79.0), (-101.0, 0.0)]
    assert matched(judged_with(beside))[1] == 3
    on_mark = [(70.0, 60.0), (84.0, 46.0), (86.0, 60.0), (70.0, 44.0), (56.0, 74.0)]
    assert matched(judged_with(on_mark))[1] == 2


def test_a_hole_must_be_judged_on_all_sides() -> None:
    """Holes 2 and 4 lie beside what is not judged: a hit there does not count either. The reach is
    the hit radius and the hole's own: 13 mm."""

    def blind(x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
        return (x_mm > 48.0) | (np.hypot(x_mm, y_mm + 60.0) < 13.0)

    rows, calls = matched(judged_with([(50.0, 0.0)], blind))
    assert [row.found for row in rows] == ["miss", "NA", "miss", "NA"]
    assert rows[1].score is None
    assert calls == 0

    def small(x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
        return np.hypot(x_mm, y_mm + 60.0) < 11.0

    rows, _ = matched(judged_with([], small))
    assert [row.found for row in rows] == ["miss"] * 4


def test_the_answer_counts_holes_and_calls() -> None:
    rows, calls = matched(judged_with([(0.0, 0.0), (20.0, 50.0)]))
    reading = GaugeSeen(tuple(rows), calls, (), ())
    assert reading.answer == "gauge: 1 hits, 3 misses, 0 holes not judged, 1 false call"
