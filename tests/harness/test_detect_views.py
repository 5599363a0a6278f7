"""``tofpod detect A B C --register ..``: from several captures to one cloud, its
findings, and refusals."""

from __future__ import annotations

import csv
import errno
import json
import re
from hashlib import sha256
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import stats

from detectors.views.mapping.merge import Mapped, Merged
from detectors.views.marks.mark import MarkSet
from detectors.views.registration.registered import reference_registration
from detectors.views.view import PreparedView, View
from harness import detect
from harness.inspection.arguments import read_poses
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, Region, invert, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION
from tests.support import marked_board as board

POSES = (
    board.T_camera_board(3.0, 2.0),
    board.T_camera_board(20.0, -3.0),
    board.T_camera_board(-18.0, 5.0),
)
T_FIRST_VIEW = tuple(POSES[0] @ invert(pose) for pose in POSES)
HOLE_M = transform_points(POSES[0], np.array([*board.HOLE_M, 0.0]))
CORNERS_M = transform_points(
    POSES[0],
    np.array(
        [(x * board.HALF_WIDTH_M, y * board.HALF_HEIGHT_M, 0.0) for x in (-1, 1) for y in (-1, 1)]
    ),
)
FILES = [
    "annotated.png",
    "blind.png",
    "findings.csv",
    "findings.json",
    "merged.ply",
    "registrations.json",
    "report.html",
    "view3d.html",
]
SHARP = (
    *("--set", "hole_model.blur_px=1"),
    *("--set", "hole_model.lens_px=0"),
    *("--threshold", "6.5"),  # noise of this map reaches 5.8
)
"""The board's hole is drawn without a camera's blur; the threshold is so high that no false call
is expected."""


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Three views of the board."""
    folder = tmp_path_factory.mktemp("views")
    return [
        str(board.write_view(folder / f"view_{i}", pose, seed=i)) for i, pose in enumerate(POSES)
    ]


def failed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The message of a run that must end with exit code 2."""
    assert detect.main([str(argument) for argument in arguments]) == 2
    error_text = capsys.readouterr().err
    assert error_text.startswith("error: ") and "Traceback" not in error_text
    return error_text


def findings_of(out: Path) -> list[dict[str, float]]:
    with (out / "findings.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        for word in ("kind", "shape", "certainty", "flags", "term"):
            del row[word]
    return [{k: float(v) if v else float("nan") for k, v in row.items()} for row in rows]


def error_m(T_reference_view: object, number: int) -> np.ndarray:
    """(4, 3): how far a registration puts the board's corners from where they are, in the first
    view's frame."""
    moved = np.array(T_reference_view) @ invert(T_FIRST_VIEW[number])
    wrong: np.ndarray = transform_points(moved, CORNERS_M) - CORNERS_M
    return wrong


# ---- what it finds
# ---------------------------------------------------------------------------------------------------


def test_three_views_become_one_cloud_and_the_hole_is_in_its_place(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out"
    assert detect.main([*views, "--register", "marks", "--out", str(out), *SHARP]) == 0
    printed = capsys.readouterr().out
    assert "marks: 5 of 5 are reliable" in printed and "merged: 3 views" in printed
    pictures = [f"targets-{number}.png" for number in (1, 2, 3)]
    assert sorted(path.name for path in out.iterdir()) == sorted((*FILES, *pictures))
    assert printed.count("target 1 of 1: ") == 3
    message = json.loads((out / "registrations.json").read_text(), parse_constant=pytest.fail)
    assert [row["view"] for row in message["views"]] == ["view_0", "view_1", "view_2"] and message[
        "reference"
    ] == "view_0"
    assert message["results_version"] == RESULTS_VERSION
    for number, row in enumerate(message["views"][1:], start=1):
        wrong_mm = 1e3 * np.sqrt((error_m(row["T_reference_view"], number) ** 2).sum(axis=1).mean())
        # corners lie farther out than the target's mean point: four times the prediction is beyond
        # any chance
        assert (
            wrong_mm < 4 * np.hypot(row["predicted_in_plane_mm"], row["predicted_across_mm"]) < 1.0
        )
        assert 0 < row["held_out_mark_mm"] < 1.0 and row["pairs"] == 5
    (result,) = findings_of(out)
    place_mm = np.array([result[f"{axis}_mm"] for axis in "xyz"])
    in_first_mm = 1e3 * transform_points(np.array(message["T_reference_cloud"]), 1e-3 * place_mm)
    np.testing.assert_allclose(in_first_mm, 1e3 * HOLE_M, atol=0.5)
    assert result["diameter_mm"] == pytest.approx(2e3 * board.HOLE_RADIUS_M, rel=0.05)
    assert result["depth_mm"] == pytest.approx(1e3 * board.HOLE_DEPTH_M, rel=0.05)
    facts = json.loads((out / "findings.json").read_text(), parse_constant=pytest.fail)
    assert [capture["view"] for capture in facts["captures"]] == ["view_0", "view_1", "view_2"]
    assert facts["settings"]["mapping"]["registration"]["method"] == "marks"
    assert facts["settings"]["detector"]["settings"]["crop"]["kind"] == "none"
    assert len(facts["provenance"]["files"]) == 3 * (3 + 3 + 1)
    # the fused map states each cell's deviation, and the text says so; the ring is named like its
    # row, in the page too
    (cell_mm,) = re.findall(r"cells of ([0-9.]+) mm", printed)
    assert facts["merged"]["cell_mm"] == pytest.approx(float(cell_mm), rel=0.01)
    assert (
        "one unit of score is the deviation of matched filters" in printed and " u cell " in printed
    )
    assert f'"1: {result["diameter_mm"]:.1f}"' in (out / "view3d.html").read_text()


@pytest.mark.usefixtures("unpictured")
def test_holes_are_implanted_in_a_map_to_choose_the_detector(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert detect.main([*views, "--register", "marks", "--out", str(tmp_path)]) == 0
    choice = json.loads((tmp_path / "findings.json").read_text())["surface"]["choice"]
    assert f"detector: {choice['text']}" in capsys.readouterr().out
    assert choice["implanted"] >= 12
    assert max(choice["found"].values()) > 0.1 * choice["implanted"]


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize("merge", ["grid", pytest.param("volume", marks=pytest.mark.slow)])
def test_every_merge_finds_the_hole(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], merge: str
) -> None:
    assert (
        detect.main(
            [*views[:2], "--register", "marks", "--merge", merge, "--out", str(tmp_path / "out")]
        )
        == 0
    )
    # the target was cut out of each view, so nothing is cut off the merged points
    points, judged = re.findall(
        r"merged: 2 views, (\d+) points, (\d+) judged", capsys.readouterr().out
    )[0]
    assert points == judged
    rows = findings_of(tmp_path / "out")
    place_mm = np.array([rows[0][f"{axis}_mm"] for axis in "xyz"])
    # the mean of four extreme points, of two views of one floor from two sides: good to a quarter
    # of the hole
    np.testing.assert_allclose(place_mm[:2], 1e3 * HOLE_M[:2], atol=5e2 * board.HOLE_RADIUS_M)
    assert "<canvas" in (tmp_path / "out" / "view3d.html").read_text()


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize(
    "method", ["cpd", *(pytest.param(each, marks=pytest.mark.slow) for each in ("icp", "joint"))]
)
def test_other_methods_start_from_the_marks_where_nobody_says_where_views_stand(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    subset = ["--false-calls", "0.01"]
    assert (
        detect.main([*views[:2], "--register", method, "--out", str(tmp_path / "out"), *subset])
        == 0
    )
    assert "starts from the pose of" not in capsys.readouterr().out
    row = json.loads((tmp_path / "out" / "registrations.json").read_text())["views"][1]
    assert row["method"] == method
    assert np.abs(error_m(row["T_reference_view"], 1)).max() < 2e-3
    (result,) = findings_of(tmp_path / "out")
    assert result["diameter_mm"] == pytest.approx(2e3 * board.HOLE_RADIUS_M, rel=0.15)


@pytest.mark.usefixtures("unpictured")
def test_poses_may_be_stated_and_nominal_takes_them_as_they_are(
    views: list[str], tmp_path: Path
) -> None:
    poses = tmp_path / "poses.json"
    # to the board's frame: any common one will do
    poses.write_text(json.dumps([invert(pose).tolist() for pose in POSES[:2]]))
    arguments = [
        *views[:2],
        "--register",
        "nominal",
        "--poses",
        str(poses),
        "--out",
        str(tmp_path / "out"),
    ]
    assert detect.main([*arguments, *SHARP]) == 0
    message = json.loads((tmp_path / "out" / "registrations.json").read_text())["views"][1]
    np.testing.assert_allclose(message["T_reference_view"], T_FIRST_VIEW[1], atol=1e-12)
    assert message["predicted_in_plane_mm"] is None
    files = json.loads((tmp_path / "out" / "findings.json").read_text())["provenance"]["files"]
    assert (
        files[-1]["path"] == str(poses)
        and files[-1]["sha256"] == sha256(poses.read_bytes()).hexdigest()
    )


@pytest.mark.usefixtures("unpictured")
def test_settings_reach_the_way_from_views_to_a_cloud(views: list[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    settings = (
        "mapping.merge.cell_mm=4",
        "mapping.views=2",
        "mapping.crop.inset_px=5",
        "surface.degree=1",
    )
    additional = [word for setting in settings for word in ("--set", setting)]
    assert detect.main([*views, "--register", "marks", "--out", str(out), *additional]) == 0
    facts = json.loads((out / "findings.json").read_text())["settings"]
    assert facts["mapping"]["merge"]["cell_mm"] == 4 and facts["mapping"]["crop"]["inset_px"] == 5
    assert facts["detector"]["settings"]["surface"]["degree"] == 1
    assert len(json.loads((out / "registrations.json").read_text())["views"]) == 2


@pytest.mark.usefixtures("unpictured")
def test_the_same_views_give_the_same_files(views: list[str], tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert (
            detect.main([*views[:2], "--register", "marks", "--out", str(tmp_path / name), *SHARP])
            == 0
        )
    for name in ("findings.csv", "merged.ply"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_picture_tells_which_view_a_point_is_of() -> None:
    """Two grids of points of which half lie together, merged without averaging."""
    first = np.stack(
        [*np.meshgrid(np.arange(10.0), np.arange(4.0)), np.full((4, 10), 1.0)], axis=-1
    )
    second = first + np.array([5.0, 0.01, 0.0])
    pair = np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3), [[np.nan] * 3]])[None]
    merged = Merged(_cloud(pair), np.eye(4), ("a", "b"), 0.0)
    prepared = tuple(
        PreparedView(
            View(name, _cloud(points), None), np.ones((4, 10), bool), MarkSet((), np.zeros(0, int))
        )
        for name, points in (("a", first), ("b", second))
    )
    placed = tuple(reference_registration(name, "nominal") for name in "ab")
    message = Mapped(prepared, placed, merged).view_of_points()
    expected = [*([0] * 10 * 4), *([1] * 10 * 4), -1]
    np.testing.assert_array_equal(message, expected)
    halfway = Merged(
        _cloud((first + np.array([0.0, 0.005, 0.0]))[:, 5:]), np.eye(4), ("a", "b"), 0.0
    )
    # between a point of each: of several
    assert (Mapped(prepared, placed, halfway).view_of_points() == -1).all()


def _cloud(points: np.ndarray) -> Cloud:
    shape = points.shape[:2]
    empty = np.zeros(shape)
    return Cloud(
        points,
        empty.astype(np.uint8),
        empty.astype(int),
        empty,
        Region(0, shape[0], 0, shape[1]),
        0.0,
        1,
    )


# ---- what it refuses
# -------------------------------------------------------------------------------------------------


def test_a_view_with_hidden_marks_is_named_with_what_is_missing(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hidden = board.write_view(tmp_path / "hidden", POSES[1], seed=5, hidden=(0, 2, 4))
    printed = failed(
        capsys, views[0], hidden, views[2], "--register", "marks", "--out", tmp_path / "out"
    )
    assert "one view cannot be registered to view_0" in printed
    assert (
        "\n  hidden: 2 marks found, 3 needed" in printed
        and "view_2" not in printed
        and "(--poses)" in printed
    )
    assert not (tmp_path / "out").exists()


def test_views_of_another_target_are_refused(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    remaining = ((-0.15, -0.06), (0.05, 0.02), (0.16, -0.02), (-0.05, 0.07))
    view = board.write_view(tmp_path / "other", POSES[1], seed=6, strips=remaining)
    for method in ("marks", "joint"):
        printed = failed(capsys, views[0], view, "--register", method, "--out", tmp_path / "out")
        assert "one view cannot be registered to view_0" in printed and "\n  other: " in printed
    assert not (tmp_path / "out").exists()


def test_views_without_overlap_are_refused(
    views: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    poses = tmp_path / "poses.json"
    far = np.eye(4)
    far[0, 3] = 1.0
    poses.write_text(json.dumps([np.eye(4).tolist(), far.tolist()]))
    printed = failed(
        capsys, *views[:2], "--register", "nominal", "--poses", poses, "--out", tmp_path / "out"
    )
    assert "view_1: the views do not overlap: 0 %" in printed and "correct --poses" in printed
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    (
        (("--register", "nominal"), "none are stated"),
        (("--register", "marks", "--quiet-capture", "x"), "--quiet-capture is one cloud"),
        (("--register", "marks", "--poses", "nowhere"), "nowhere: cannot be read"),
        (
            ("--register", "marks", "--set", "mapping.merge.cell=1"),
            "unknown key `cell` in `mapping.merge`",
        ),
        (
            ("--register", "marks", "--set", "mapping.registration.tolerance=1"),
            "unknown key `tolerance` in `mapping.registration`",
        ),
        (("--register", "marks", "--set", "surface.degre=1"), "unknown key `degre` in `surface`"),
        (("--register", "marks", "--crop", "box:0,1,0,1,0,1"), "view view_0: the crop box"),
        (("--register", "marks", "--threshold", "0"), "above 0"),
        (("--register", "marks", "--topic", "points2"), "is not a ROS bag"),
        (("--merge", "grid"), "--merge: concerns several views"),
        (("--marks", "red"), "--marks: concerns several views"),
        (("--poses", "x"), "--poses: concerns several views"),
        (("--set", "mapping.views=2"), "--set mapping.views=2: concerns several views"),
    ),
)
def test_a_mistake_is_one_message_and_leaves_nothing(
    views: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    told: str,
) -> None:
    assert told in failed(capsys, *views[:2], "--out", tmp_path / "out", *arguments)
    assert not (tmp_path / "out").exists()


def test_one_view_is_none_too_many(views: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "1 view cannot be registered" in failed(capsys, views[0], "--register", "marks")
    assert "1 view cannot be registered" in failed(
        capsys, *views, "--register", "marks", "--set", "mapping.views=1"
    )


def test_several_captures_are_no_list_of_frames_and_no_capture_counts_twice(
    views: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    printed = failed(capsys, *views[:2])
    assert (
        f"2 PATHs, but {views[0]} is a whole capture" in printed and "--register marks|" in printed
    )
    assert f"{views[0]}: is named twice" in failed(
        capsys, views[0], views[1], views[0] + "/", "--register", "marks"
    )


@pytest.mark.usefixtures("unpictured")
def test_a_full_disk_leaves_nothing(
    views: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("harness.report.view3d.write_text", full)
    printed = failed(capsys, *views[:2], "--register", "marks", "--out", tmp_path / "out", *SHARP)
    assert "the disk is full" in printed and not (tmp_path / "out").exists()


# ---- poses
# -----------------------------------------------------------------------------------------------------------


def test_poses_are_read_in_both_forms(tmp_path: Path) -> None:
    from harness.programs.dataset.exchange import quaternion_of

    matrices = [invert(pose).tolist() for pose in POSES]
    (tmp_path / "p.json").write_text(json.dumps(matrices))
    (tmp_path / "keyed.json").write_text(json.dumps({"T_reference_view": matrices}))
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for i, pose in enumerate(POSES):
        numbers = (*invert(pose)[:3, 3], *quaternion_of(invert(pose)))
        lines.append(f"{i} " + " ".join(f"{number:.9f}" for number in numbers))
    (tmp_path / "groundtruth.txt").write_text("\n".join(lines))
    for name, within in (("p.json", 1e-12), ("keyed.json", 1e-12), ("groundtruth.txt", 1e-8)):
        read = read_poses(tmp_path / name, 3)
        np.testing.assert_array_equal(read[0], np.eye(4))
        np.testing.assert_allclose(read, T_FIRST_VIEW, atol=within)


@pytest.mark.parametrize(
    ("text", "told"),
    (
        ("[[1, 2], [3, 4]]", "pose 0 is not a rigid 4x4 transform"),
        (
            json.dumps([np.eye(4).tolist(), np.diag([1, 1, -1, 1]).tolist()]),
            "pose 1 is not a rigid 4x4 transform",
        ),
        (
            json.dumps([np.eye(4).tolist(), np.diag([2, 2, 2, 1]).tolist()]),
            "pose 1 is not a rigid 4x4 transform",
        ),
        (
            json.dumps([np.eye(4).tolist(), np.diag([1, 1, 1, 2]).tolist()]),
            "pose 1 is not a rigid 4x4 transform",
        ),
        (
            json.dumps([[[float("inf")] * 4] * 4] * 2).replace("Infinity", "1e999"),
            "pose 0 is not a rigid 4x4 transform",
        ),
        (json.dumps([[[float("nan")] * 4] * 4] * 2), "holds no poses (NaN is not a JSON number)"),
        ("[[[" + "9" * 400 + "]]]", "holds no poses (int too large"),
        ('{"a": 1, "a": 2}', "holds no poses (the key a occurs twice)"),
        (json.dumps({"T_reference_view": 3}), "holds no poses"),
        (json.dumps({"T_reference_view": [np.eye(4).tolist()]}), "1 poses for 2 views"),
        (json.dumps([np.eye(4).tolist()]), "1 poses for 2 views .. one line per view"),
        (
            json.dumps({"views": 1, "poses": []}),
            "holds no poses (an object without the key T_reference_view)",
        ),
        ("[" * 100_000, "holds no poses"),
        ("[", "holds no poses"),
        (
            "0 0 0 0 0 0 0 1\n1 0 0 340 0 0 0 1",
            "pose 1 is 340 m from pose 0 .. metres, not millimetres",
        ),
        ("0 0 0 0 0 0 0 1\n1 1.7e308 -1.7e308 1 0 0 0 1", "pose 1 is inf m from pose 0"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1", ":2: is not a pose"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 2", ":2: is not a pose"),
        ("0 0 0 0 0 0 0 one", ":1: is not a pose"),
        ("", "0 poses for 2 views"),
    ),
)
def test_poses_that_are_none_are_refused(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "poses").write_text(text)
    with pytest.raises(UserError) as caught:
        read_poses(tmp_path / "poses", 2)
    printed = str(caught.value)
    for part in told.split(" .. "):
        assert part in printed


# ---- a real capture
# --------------------------------------------------------------------------------------------------


def _halves(source: Path, folder: Path) -> list[str]:
    """The first and last frames of a capture as two, every second row and column of each."""
    message = json.loads((source / "intrinsic.json").read_text())
    message["width"] //= 2
    message["height"] //= 2
    message["intrinsic_matrix"] = [0.5 * value for value in message["intrinsic_matrix"][:8]] + [1.0]
    colour = cv2.imread(str(source / "color" / "00000.jpg"))[::2, ::2]
    depths = sorted((source / "depth").iterdir())
    for name, part in (("first", depths[:4]), ("second", depths[-4:])):
        for inner in ("depth", "color"):
            (folder / name / inner).mkdir(parents=True)
        for path in part:
            stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(folder / name / "depth" / path.name), stored[::2, ::2])
        cv2.imwrite(str(folder / name / "color" / f"{part[0].stem}.png"), colour)
        (folder / name / "intrinsic.json").write_text(json.dumps(message))
    return [str(folder / "first"), str(folder / "second")]


@pytest.mark.usefixtures("unpictured")
@pytest.mark.slow  # a real capture, twice
def test_two_halves_of_a_static_capture_stand_where_they_stood(
    shared_data: Path, tmp_path: Path
) -> None:
    """The camera did not move, so the truth is the identity. The one colour picture serves both
    halves, so that only the marks' ranges differ: the error within the plane is not tested by it.
    """
    paths = _halves(shared_data / "azure_drilled_board", tmp_path)
    out = tmp_path / "out"
    # coarse: what is found on the plate is not the question
    coarse = ("--merge", "grid", "--set", "mapping.merge.step_mm=5")
    arguments = ("--register", "marks", "--marks", "coded", *coarse)
    assert detect.main([*paths, *arguments, "--out", str(out)]) == 0
    row = json.loads((out / "registrations.json").read_text())["views"][1]
    assert row["pairs"] == 5 and row["marks_doubtful"] == 0
    T_reference_view = np.array(row["T_reference_view"])
    centre_m = 1e-3 * np.array(row["covariance_about_mm"])
    turn = 0.5 * (T_reference_view[:3, :3] - T_reference_view[:3, :3].T)
    small = [
        turn[2, 1],
        turn[0, 2],
        turn[1, 0],
        *(transform_points(T_reference_view, centre_m) - centre_m),
    ]
    chi2 = np.array(small) @ np.linalg.solve(np.array(row["covariance"]), small)
    assert chi2 < stats.chi2.ppf(0.999, 6)
    assert np.hypot(row["predicted_in_plane_mm"], row["predicted_across_mm"]) < 0.2
    assert row["held_out_mark_mm"] < 0.1
