"""A part compared with an earlier capture and with good parts, from files to findings."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from detectors.interface import Evidence
from detectors.surfaces.scans import laid_under, scan_of
from harness import detect
from harness.inspection.arguments import is_mesh
from harness.inspection.changes import (
    GONE,
    GROWN,
    NEW,
    SHRUNK,
    DamageSize,
    _change,
    _departure_m,
    _rest,
    changes_of,
)
from harness.inspection.references import captures_in
from harness.inspection.verdict import MOST_NOISE
from harness.report.findings import Judged
from tests.harness.inspection.test_verdict import finding, judged_of
from tests.support import marked_board
from tests.support.made_parts import Dent, MadePart, cloud_of, pose, write_capture

THEN = MadePart((Dent(0, 0, 14, 1.0), Dent(20, -30, 12, 2.5), Dent(-15, -30, 12, 1.5)))
NOW = MadePart((Dent(0, 0, 18, 2.5), Dent(20, -30, 12, 2.5), Dent(40, 10, 12, 1.5)))
OPTIONS = ("--unit", "m", "--detector", "local")


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A part then and now, and four good parts that differ as made parts do."""
    folder = tmp_path_factory.mktemp("captures")
    write_capture(folder / "then", THEN, pose(), seed=1)
    write_capture(folder / "now", NOW, pose((3.0, -2.0, 4.0), (4.0, -3.0)), seed=2)
    for number in range(4):
        part = MadePart(bend_mm=0.3 * (number - 2), rib_mm=0.15 * (number % 3 - 1))
        # each lies somewhere else, and the last is upside down
        roll_deg = (0.0, 15.0, -30.0, 175.0)[number]
        T = pose((number - 2.0, 1.0, roll_deg), (number, -number))
        write_capture(folder / "good" / f"part{number}", part, T, seed=10 + number)
    return folder


def inspected(folder: Path, reference: str, out: str) -> dict[str, Any]:
    """The findings of the part now, against a reference."""
    paths = [str(folder / "now"), "--reference", str(folder / reference)]
    assert detect.main([*paths, *OPTIONS, "--out", str(folder / out)]) == 0
    data: dict[str, Any] = json.loads((folder / out / "findings.json").read_text())
    return data


def test_damage_is_new_grown_or_gone(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = inspected(captures, "then", "changed")
    change = data["change"]
    assert [damage["state"] for damage in change["damage"]] == [GROWN, NEW, GONE]
    grown, new, gone = change["damage"]
    assert grown["then"]["diameter_mm"] == pytest.approx(14, abs=1.0)
    assert grown["then"]["depth_mm"] == pytest.approx(1.0, abs=0.15)
    assert grown["now"]["diameter_mm"] == pytest.approx(18, abs=1.0)
    assert grown["now"]["depth_mm"] == pytest.approx(2.5, abs=0.25)
    assert grown["distance_mm"] == pytest.approx(1.5, abs=0.1)
    assert (new["then"], gone["now"]) == (None, None)
    assert new["now"]["depth_mm"] == pytest.approx(1.5, abs=0.15)
    assert gone["then"]["depth_mm"] == pytest.approx(1.5, abs=0.15)
    # 20 pixels of .12 mm in each capture, and the placement
    assert 0.05 < change["typical_level_of_detection_mm"] < 0.12
    assert data["surface"]["reference"]["placed_by"] == "outline and surface"
    assert "change: 1 new, 1 grown, 1 gone; changes over 11 mm are" in capsys.readouterr().out
    with (captures / "changed" / "change.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    significant = np.array([row["significant"] == "1" for row in rows])
    assert 0.02 < significant.mean() < 0.12  # three of its places changed
    page = (captures / "changed" / "report.html").read_text()
    assert "What changed" in page and "grown" in page


def test_features_of_good_parts_are_no_findings(
    captures: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = inspected(captures, "good", "compared")
    threshold = data["threshold"]["k"]
    clear = [finding for finding in data["findings"] if finding["score"] > 2 * threshold]
    assert [finding["term"] for finding in clear] == ["dent"] * 3
    # one false call is expected at this threshold, up to five by its interval; none is called sure
    others = [finding for finding in data["findings"] if finding not in clear]
    assert len(others) <= 5
    assert all(finding["noise_probability"] > MOST_NOISE for finding in others)
    assert data["surface"]["reference"]["parts"] == 4
    assert data["change"] is None
    assert "on 4 good parts, each left out once" in capsys.readouterr().out


def test_an_earlier_inspection_is_a_reference(captures: Path) -> None:
    then = [str(captures / "then"), *OPTIONS, "--crop", "box:-70,70,-50,50,300,450"]
    assert detect.main([*then, "--out", str(captures / "result")]) == 0
    data = inspected(captures, "result", "since_result")
    # a cloud without a grid shows no frames, but the same change
    assert data["change"]["damage"][0]["state"] == GROWN
    assert data["change"]["damage"][0]["distance_mm"] == pytest.approx(1.5, abs=0.15)


def test_marks_place_a_flat_board(tmp_path: Path) -> None:
    for name, turn_deg, seed in (("then", 0.0, 1), ("now", 12.0, 2)):
        pose_of_board = marked_board.T_camera_board(turn_deg)
        marked_board.write_view(tmp_path / name, pose_of_board, seed=seed)
    arguments = [str(tmp_path / "now"), "--reference", str(tmp_path / "then")]
    arguments += ["--detector", "local", "--marks", "red", "--out", str(tmp_path / "out")]
    assert detect.main(arguments) == 0
    data = json.loads((tmp_path / "out" / "findings.json").read_text())
    facts = data["surface"]["reference"]
    assert facts["placed_by"] == "marks and surface"
    true = marked_board.T_camera_board(0.0) @ np.linalg.inv(marked_board.T_camera_board(12.0))
    change = np.array(facts["T_reference_camera"]) @ np.linalg.inv(true)
    middle_mm = np.array(facts["covariance_about_mm"])
    away_mm = change[:3, :3] @ middle_mm + 1e3 * change[:3, 3] - middle_mm
    stated_mm = 1e3 * np.sqrt(np.diag(np.array(facts["covariance"])))[3:]
    # along the board, which has no relief, by five strips that each capture shifts by a millimetre
    assert stated_mm[:2] == pytest.approx([np.sqrt(2 / 5)] * 2, rel=0.1)
    assert (np.abs(away_mm) < 3 * stated_mm).all()


def test_the_kind_of_a_reference_is_seen(captures: Path, tmp_path: Path) -> None:
    assert captures_in(captures / "then") == ()
    assert [path.name for path in captures_in(captures / "good")] == [
        f"part{number}" for number in range(4)
    ]
    for name, count in (("a.mkv", 2), ("b.ply", 0)):
        folder = tmp_path / name
        folder.mkdir()
        for number in (1, 2):
            (folder / f"{number}{name[1:]}").touch()
        assert len(captures_in(folder)) == count
    box = trimesh.creation.box((1, 1, 1))
    box.export(tmp_path / "part.ply")
    trimesh.PointCloud(box.vertices).export(tmp_path / "scan.ply")
    assert is_mesh(tmp_path / "part.ply")
    assert not is_mesh(tmp_path / "scan.ply")
    assert is_mesh(tmp_path / "part.stl")


def test_mistakes_are_told(captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    now = str(captures / "now")
    flat = write_capture(captures / "arched", MadePart(has_ribs=False, bend_mm=20), pose(), seed=3)
    for reference, message in (
        (str(flat), "is not this part: after the best placement"),
        (str(captures / "none"), "none"),
    ):
        assert detect.main([now, "--reference", reference, *OPTIONS]) == 2
        assert message in capsys.readouterr().err
    quiet = ["--reference", str(captures / "then"), "--quiet-capture", str(captures / "then")]
    assert detect.main([now, *quiet, *OPTIONS]) == 2
    assert "leave out --quiet-capture" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change_mm", "then_mm", "now_mm", "was_there", "state"),
    [
        (1.5, None, None, False, NEW),
        (-1.5, None, None, True, GONE),
        (1.5, 1.0, 2.5, False, GROWN),
        (-1.5, 2.5, 1.0, True, SHRUNK),
        (1.5, None, 2.5, False, GROWN),  # 1.0 mm is left of it then
        (1.5, None, 1.6, False, NEW),
        (-1.5, 1.6, None, True, GONE),
        (1.0, -8.0, -8.1, False, NEW),  # a dent on a rib
    ],
)
def test_states(
    change_mm: float, then_mm: float | None, now_mm: float | None, was_there: bool, state: str
) -> None:
    def size(depth_mm: float | None) -> DamageSize | None:
        return None if depth_mm is None else DamageSize(10.0, depth_mm, 0.1)

    changed = finding(depth_mm=change_mm, depth_se_mm=0.1, diameter_mm=10.0)
    change = _change(
        changed, size(then_mm), size(now_mm), was_there=was_there, distance_m=1e-3, lod_m=1e-4
    )
    assert change.state == state
    if change_mm == 1.5 and now_mm == 2.5:
        assert change.then is not None
        assert change.then.depth_mm == pytest.approx(1.0)


@pytest.mark.parametrize(("depth_mm", "is_left"), [(1.29, True), (1.27, False), (-1.29, True)])
def test_what_is_left_of_a_damage_exceeds_two_standard_errors(
    depth_mm: float, is_left: bool
) -> None:
    """Depth and change have errors of 0.1 mm each: 0.28 mm is twice that of their difference."""
    size = DamageSize(10.0, depth_mm, 0.1)
    change = DamageSize(10.0, math.copysign(1.0, depth_mm), 0.1)
    rest = _rest(size, change, -1.0)
    assert (rest is not None) == is_left
    if rest is not None:
        assert rest.depth_mm == pytest.approx(math.copysign(0.29, depth_mm))
        assert rest.depth_se_mm == pytest.approx(0.1 * math.sqrt(2.0))
        assert math.isnan(rest.diameter_mm)


def test_pixels_that_share_their_noise_count_once_in_a_change() -> None:
    """Cylinders hold 20 points of the earlier capture. If nine pixels of the later one share their
    noise, the variance of its mean is nine times as large, that of the difference five times."""
    earlier, earlier_mask = cloud_of(MadePart(), pose(), seed=1)
    scan = scan_of(earlier, earlier_mask, "earlier")
    seen, mask = cloud_of(MadePart(), pose((4.0, -3.0, 5.0)), seed=2)
    seen = replace(seen, expected=laid_under(scan, seen, mask))
    residual_m = np.where(mask, 0.0, np.nan)
    noise_m = []
    for reach_px in (1.0, 3.0):
        cloud = replace(seen, noise_reach_px=reach_px)
        evidence = Evidence(residual_m, residual_m, cloud.points_m[..., 2], 1e-3)
        capture = Judged(cloud, evidence, (), ())
        changes = changes_of(capture, scan, capture, capture)
        assert changes.radius_m == pytest.approx(math.sqrt(20 / math.pi) * scan.pitch_m)
        noise_m.append(np.nanmedian(changes.distances.noise_m))
    assert noise_m[1] / noise_m[0] == pytest.approx(math.sqrt(5.0), rel=0.06)


def test_a_departure_is_that_of_the_core_from_the_ring_around_it() -> None:
    """On a plane seen from 1 m: a disc of 10 mm radius 3 mm deep, where all else is 1 mm deep."""
    capture = judged_of()
    x_m, y_m, _ = np.moveaxis(capture.cloud.points_m, -1, 0)
    from_middle_m = np.hypot(x_m - 0.011, y_m - 0.003)
    residual_m = np.where(from_middle_m < 0.010, 3e-3, 1e-3)
    # neither the middle of the way between core and ring nor what is far away counts
    residual_m[(from_middle_m > 0.006) & (from_middle_m < 0.0115)] = 9e-3
    residual_m[from_middle_m > 0.021] = -9e-3
    capture = replace(capture, evidence=replace(capture.evidence, residual_m=residual_m))
    corners_m = np.array([[0.010, 0.0, 1.0], [-0.010, 0.0, 1.0], [0.0, 0.010, 1.0]])
    places_m = np.concatenate([corners_m, corners_m * [-1.0, -1.0, 1.0]])
    T = np.eye(4)
    T[:2, 3] = [0.011, 0.003]
    assert _departure_m(places_m, capture, T) == pytest.approx(2e-3)
    assert _departure_m(places_m[:0], capture, T) == 0.0
    T[0, 3] = 1.0
    assert _departure_m(places_m, capture, T) == 0.0
