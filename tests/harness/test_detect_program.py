"""``tofpod detect`` from files to findings: numbers, files, messages, exit codes."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.interface import Detection, Evidence, Measurement
from harness import detect
from harness.inspection.arguments import crop_from_text
from harness.inspection.output import print_findings
from harness.records.trials import FINDINGS_OF_CAPTURE
from harness.report.findings import finding_of
from harness.vocabulary.errors import UserError
from tests.support import recorded_plane as plane

SLOT_ERRORS = ("length_se_mm", "width_se_mm", "angle_se_deg")
"""Columns that are empty for round damage."""
TRUE_CENTRE_MM = 1e3 * plane.points_m(plane.depth_mm(hole=False))[plane.HOLE_V, plane.HOLE_U]
TRUE_DIAMETER_MM = 2 * plane.HOLE_RADIUS_PX * TRUE_CENTRE_MM[2] / plane.LENS.fx
NO_BLUR = ("--set", "hole_model.blur_px=1")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Four good frames, and one (the third) that stands 18 mm behind them."""
    folder = plane.write_open3d_folder(tmp_path / "capture", 5, noise_mm=0.6)
    cv2.imwrite(str(folder / "depth" / "00002.png"), plane.depth_mm(2, noise_mm=0.6) + 18)
    return folder


def failed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The message of a run that must end with exit code 2 and print nothing else."""
    assert detect.main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and "Traceback" not in captured.err
    return captured.err


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


# ---- which surface is the target
# -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def before_wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A board of 300 x 240 mm with a hole of 40 mm before a wall, as 16-bit images."""
    from tests.support.target_scenes import Scene

    scene = Scene("pico")
    scene.board(1, [0.0, 0.0, 0.5], [0.1, 0.0, -1.0], (0.3, 0.24), holes=((0.05, 0.03, 0.02),))
    scene.wall(0, 1.2)
    folder = tmp_path_factory.mktemp("captures") / "before_wall"
    (folder / "depth").mkdir(parents=True)
    random = np.random.default_rng(0)
    for number in range(4):
        z = scene.cloud(random, 1e-3, mix_px=1).points_m[..., 2]
        cv2.imwrite(
            str(folder / "depth" / f"{number:05d}.png"), np.round(1e3 * z).astype(np.uint16)
        )
    lens = scene.lens
    stated = {
        "fx": lens.fx,
        "fy": lens.fy,
        "cx": lens.cx,
        "cy": lens.cy,
        "width": 160,
        "height": 120,
    }
    (folder / "intrinsic.json").write_text(json.dumps(stated))
    return folder


def test_it_says_first_what_it_took_and_how_to_take_another(
    before_wall: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        detect.main([str(before_wall), "--out", str(tmp_path / "out"), "--false-calls", "0.1"]) == 0
    )
    verdict, part, first, second = capsys.readouterr().out.splitlines()[:4]
    assert verdict.startswith("One hole found on 0.0")
    assert part.startswith("part: 1 piece, 0.07")
    assert (
        first.startswith("target 1 of 2: 0.50 m away (0.49 to 0.51 m), 30")
        and " % of the view, tilted by 6" in first
    )
    assert second.startswith("  instead, with --target 2: 1.20 m away (1.20 to 1.20 m), ")
    message = json.loads((tmp_path / "out" / "findings.json").read_text())["target"]
    assert message["taken"] == 1 and [
        candidate["number"] for candidate in message["candidates"]
    ] == [1, 2]
    assert message["candidates"][0]["extent_mm"] == pytest.approx([300, 240], abs=8)
    picture = cv2.imread(str(tmp_path / "out" / "targets.png"))
    assert (picture == (255, 0, 255)).all(axis=-1).sum() > 1000
    assert [row["kind"] for row in rows_of(tmp_path / "out" / "findings.csv")] == ["hole"]
    assert detect.main([str(before_wall), "--target", "2"]) == 0
    _, _, first, second = capsys.readouterr().out.splitlines()[:4]
    assert first.startswith("target 2 of 2: 1.20 m away") and second.startswith(
        "  instead, with --target 1: 0.50 m"
    )


def test_a_target_that_is_not_there_is_refused_with_those_that_are(
    before_wall: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    message = failed(capsys, before_wall, "--target", "3")
    assert "there are 2 large smooth surfaces" in message and "--target 1: 0.50 m" in message
    assert "another crop" in failed(capsys, before_wall, "--target", "1", "--crop", "none")


# ---- what it finds
# ---------------------------------------------------------------------------------------------------


def test_it_finds_the_hole_and_writes_everything(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "found"
    assert detect.main([str(capture), "--out", str(out), "--false-calls", "0.1", *NO_BLUR]) == 0
    printed = capsys.readouterr().out
    assert "4 frames averaged" in printed
    assert "left out: depth/00002.png: the whole range jumps by +18" in printed
    assert "from this capture's own null: 0.1 false calls expected" in printed
    assert sorted(path.name for path in out.iterdir()) == sorted(
        (
            "annotated.png",
            "blind.png",
            "cloud.ply",
            "findings.csv",
            "findings.json",
            "report.html",
            "targets.png",
        )
    )
    with (out / "findings.csv").open() as stream:
        header = stream.readline()
    columns = "id,kind,u_px,v_px,x_mm,y_mm,z_mm,diameter_mm,diameter_se_mm,depth_mm,depth_se_mm"
    columns += ",sight_depth_mm,shape,volume_mm3,points,score,length_mm,width_mm"
    said = "noise_probability,certainty,flags,term,count"
    columns += ",angle_deg," + ",".join(SLOT_ERRORS)
    assert header == f"{columns},{said},findings_version\n"
    (row,) = rows_of(out / "findings.csv")
    assert row["kind"] == "hole"
    assert not any(row[name] for name in SLOT_ERRORS)
    words = ("kind", "shape", "noise_probability", "certainty", "flags", "term", *SLOT_ERRORS)
    number = {key: float(value) for key, value in row.items() if key not in words}
    assert (number["u_px"], number["v_px"]) == pytest.approx((plane.HOLE_U, plane.HOLE_V), abs=0.2)
    position = [number["x_mm"], number["y_mm"], number["z_mm"]]
    np.testing.assert_allclose(position, TRUE_CENTRE_MM, atol=1.0)
    assert number["diameter_mm"] == pytest.approx(TRUE_DIAMETER_MM, rel=0.05)
    assert number["depth_mm"] == pytest.approx(plane.HOLE_DEPTH_MM, rel=0.05)
    area = np.pi / 4 * TRUE_DIAMETER_MM**2
    assert number["volume_mm3"] == pytest.approx(area * plane.HOLE_DEPTH_MM, rel=0.1)


def test_long_damage_is_told_with_length_width_and_angle(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A scratch of 24 x 4 mm that runs down to the right at 30 degrees, beside a round hole."""
    evidence = Evidence(np.zeros((2, 2)), np.full((2, 2), 5e-3), np.ones((2, 2)), 1e-3)
    detection = Detection(9.0, np.arange(4), np.zeros(3))
    turned = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0])
    measured = Measurement(
        3.0, 4.0, 4, 9.0, 0.02, np.zeros(3), length_m=0.024, width_m=0.004, along=-turned
    )
    scratch = finding_of(1, evidence, detection, replace(measured, width_m=0.004))
    hole = finding_of(2, evidence, detection, replace(measured, width_m=0.02))
    assert (scratch.length_mm, scratch.width_mm) == pytest.approx(
        (24, 4)
    ) and scratch.angle_deg == pytest.approx(30)
    print_findings([scratch, hole])
    head, first, second = capsys.readouterr().out.splitlines()
    assert "long damage" in head and first.endswith("24.0 x 4.0, 30") and second.endswith("-")
    print_findings([hole])
    assert "long" not in capsys.readouterr().out


@pytest.mark.usefixtures("unpictured")
def test_the_json_says_where_every_number_comes_from(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    local = (
        "--detector",
        "local",
    )  # matched filters find the hole too wide for their model and measure its contour
    assert detect.main([str(capture), "--out", str(out), "--threshold", "6", *local, *NO_BLUR]) == 0
    message = json.loads((out / "findings.json").read_text(), parse_constant=pytest.fail)
    (finding,) = message["findings"]
    row = rows_of(out / "findings.csv")[0]
    assert row["kind"] == finding["kind"] == "hole"
    assert [row[name] for name in ("certainty", "flags", "term")] == ["sure", "", "hole"]
    assert row["noise_probability"] == "" and finding["noise_probability"] is None
    assert all(finding[name] is None for name in SLOT_ERRORS)
    for column in {column.name for column in FINDINGS_OF_CAPTURE.columns} - {
        *SLOT_ERRORS,
        "kind",
        "shape",
        "noise_probability",
        "certainty",
        "flags",
        "term",
        "findings_version",
    }:
        assert float(row[column]) == pytest.approx(finding[column], abs=1e-4)
    assert finding["size_from"] == "model" and finding["model"]["diameter_se_mm"] > 0
    assert (
        finding["diameter_mm"]
        == finding["model"]["diameter_mm"]
        != finding["extent"]["diameter_mm"]
    )
    assert message["capture"]["frames_used"] == 4
    assert message["capture"]["frames_left_out"][0]["name"] == "depth/00002.png"
    assert message["threshold"]["k"] == 6 and message["threshold"]["from"] == "given"
    assert message["settings"]["detector"]["settings"]["crop"]["kind"] == "auto"
    assert message["settings"]["detector"]["settings"]["hole_model"]["blur_px"] == 1
    digests = {Path(file["path"]).name: file["sha256"] for file in message["provenance"]["files"]}
    assert set(digests) >= {"00000.png", "00004.png", "intrinsic.json"}
    assert (
        digests["intrinsic.json"]
        == hashlib.sha256((capture / "intrinsic.json").read_bytes()).hexdigest()
    )


@pytest.mark.usefixtures("unpictured")
def test_the_cloud_has_the_damage_in_magenta(capture: Path, tmp_path: Path) -> None:
    import trimesh

    out = tmp_path / "out"
    assert (
        detect.main([str(capture), "--out", str(out), "--threshold", "6", "--detector", "thesis"])
        == 0
    )
    content = (out / "cloud.ply").read_bytes()
    assert content.startswith(b"ply\nformat binary_little_endian")
    cloud = trimesh.load(out / "cloud.ply")
    assert len(cloud.vertices) == 72 * 96 - 1
    magenta = (cloud.colors[:, :3] == (255, 0, 255)).all(axis=1)
    assert magenta.sum() == sum(int(row["points"]) for row in rows_of(out / "findings.csv"))
    distance_mm = np.linalg.norm(1e3 * cloud.vertices[magenta] - TRUE_CENTRE_MM, axis=1)
    assert distance_mm.max() < TRUE_DIAMETER_MM


def test_the_picture_is_a_picture(capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    by_name = capture.rename(capture.with_name("board $x_$"))  # which is wrong as mathematics
    assert detect.main([str(by_name), "--out", str(out)]) == 0
    picture = cv2.imread(str(out / "annotated.png"))
    assert picture is not None and picture.shape[1] == 1650
    magenta = (picture == (255, 0, 255)).all(axis=-1)
    assert magenta.sum() > 200  # two circles


def shuffled_points_m() -> np.ndarray:
    """The plane's points in an order that shows no grid."""
    points_m = plane.points_m(plane.depth_mm())
    shuffled_m = np.random.default_rng(1).permutation(points_m.reshape(-1, 3))
    return np.asarray(shuffled_m.reshape(points_m.shape))


@pytest.mark.usefixtures("unpictured")
def test_a_cloud_without_a_grid_works_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = plane.write_ply(tmp_path / "c.ply", shuffled_points_m(), grid=False)
    assert detect.main([str(cloud), "--crop", "none", "--out", str(tmp_path / "out")]) == 0
    row, *remaining = rows_of(tmp_path / "out" / "findings.csv")
    # rounding is all the noise: too few peaks stand out to set the threshold, as a warning says
    assert (
        float(row["score"]) > 100
        and all(float(other["score"]) < 10 for other in remaining)
        and len(remaining) < 6
    )
    assert row["u_px"] == "" and row["volume_mm3"] == ""
    # The thesis' centre is the mean of four extreme points, of which rounding picks some: good to
    # a part of the hole.
    offset = np.array([float(row[f"{a}_mm"]) for a in "xy"]) - TRUE_CENTRE_MM[:2]
    assert np.hypot(*offset) < TRUE_DIAMETER_MM / 3
    assert float(row["depth_mm"]) == pytest.approx(plane.HOLE_DEPTH_MM, abs=1.0)
    finding = json.loads((tmp_path / "out" / "findings.json").read_text())["findings"][0]
    assert finding["size_from"] == "extent" and finding["depth_from"] == "extreme residual"
    assert finding["u_px"] is None
    printed = capsys.readouterr().out
    assert re.match(
        r"warning: the capture cannot set its own threshold, 5 is used: only \d peaks of noise stand",
        printed,
    )
    assert "unorganised points" in printed


@pytest.mark.usefixtures("unpictured")
def test_auto_crop_without_a_grid_keeps_the_hole_and_leaves_the_rim(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = plane.write_ply(tmp_path / "c.ply", shuffled_points_m(), grid=False)
    assert detect.main([str(cloud), "--out", str(tmp_path / "out"), "--detector", "thesis"]) == 0
    assert "points lie off the target or on its rim" in capsys.readouterr().out
    (row,) = rows_of(tmp_path / "out" / "findings.csv")
    v, u = np.mgrid[: plane.LENS.height, : plane.LENS.width]
    assert (
        int(row["points"])
        == (np.hypot(u - plane.HOLE_U, v - plane.HOLE_V) < plane.HOLE_RADIUS_PX).sum()
    )
    message = json.loads((tmp_path / "out" / "findings.json").read_text())
    assert message["settings"]["detector"]["settings"]["crop"]["inset_px"] == 3


@pytest.mark.usefixtures("unpictured")
def test_a_quiet_capture_sets_the_threshold(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quiet = plane.write_open3d_folder(tmp_path / "quiet", 4, noise_mm=0.6, hole=False)
    assert (
        detect.main([str(capture), "--quiet-capture", str(quiet), "--out", str(tmp_path / "a")])
        == 0
    )
    files = json.loads((tmp_path / "a" / "findings.json").read_text())["provenance"]["files"]
    assert {str(quiet), str(capture)} == {
        str(Path(file["path"]).parent.parent) for file in files if "depth" in file["path"]
    }
    assert "silent on" in capsys.readouterr().out
    facts = json.loads((tmp_path / "a" / "findings.json").read_text())
    k = facts["threshold"]["k"]
    # a threshold is in units of the detector that was chosen
    chosen = ["--detector", facts["settings"]["detector"]["name"]]
    assert detect.main([str(quiet), *chosen, "--threshold", str(k)]) == 0
    assert "no findings" in capsys.readouterr().out
    assert detect.main([str(quiet), *chosen, "--threshold", str(0.99 * k)]) == 0
    assert "no findings" not in capsys.readouterr().out


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize(
    ("crop", "found"),
    (
        ("none", 1),
        ("polygon:2,2,40,2,40,60,2,60", 0),
        ("polygon:45,10,80,10,80,60,45,60", 1),
        ("box:-500,500,-500,500,100,900", 1),
        ("box:-500,-10,-500,500,100,900", 0),
    ),
)
def test_the_crop_decides_what_is_searched(
    capture: Path, tmp_path: Path, crop: str, found: int
) -> None:
    arguments = [str(capture), "--crop", crop, "--threshold", "8", "--out", str(tmp_path / "out")]
    assert detect.main(arguments) == 0
    assert len(rows_of(tmp_path / "out" / "findings.csv")) == found


@pytest.mark.usefixtures("unpictured")
@pytest.mark.parametrize(("left_u_px", "is_cut"), [(45, False), (plane.HOLE_U, True)])
def test_a_finding_that_the_crop_cuts_is_flagged_and_no_doubt_about_the_answer(
    capture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    left_u_px: float,
    is_cut: bool,
) -> None:
    crop = f"polygon:{left_u_px},2,80,2,80,60,{left_u_px},60"
    arguments = [str(capture), "--crop", crop, "--threshold", "8", "--out", str(tmp_path / "out")]
    assert detect.main(arguments) == 0
    (row,) = rows_of(tmp_path / "out" / "findings.csv")
    assert ("at_rim" in row["flags"].split()) == is_cut
    assert row["certainty"] == ("rim or blind" if is_cut else "sure")
    printed = capsys.readouterr().out
    assert "warning" not in printed
    assert printed.startswith("No damage is sure on" if is_cut else "One hole found on")
    assert ("one place is cut by the rim" in printed) == is_cut


@pytest.mark.usefixtures("unpictured")
def test_a_hole_to_the_room_behind_is_flagged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    v, u = np.mgrid[:120, :160]
    is_open = np.hypot(u - 90, v - 50) < 8
    is_pit = np.hypot(u - 40, v - 80) < 8
    clean = np.where(is_open, 2500.0, np.where(is_pit, 740.0, 700.0))
    frames = clean + rng.standard_normal((8, 120, 160))
    np.save(tmp_path / "depth.npy", np.rint(frames).astype(np.uint16))
    (tmp_path / "lens.json").write_text('{"fx": 400, "fy": 400, "cx": 80, "cy": 60}')
    lens = ["--intrinsics", str(tmp_path / "lens.json")]
    out = ["--out", str(tmp_path / "out"), "--false-calls", "0.01"]
    assert detect.main([str(tmp_path / "depth.npy"), *lens, *out]) == 0
    rows = rows_of(tmp_path / "out" / "findings.csv")[:2]
    pit, through = sorted(rows, key=lambda row: float(row["u_px"]))
    assert "open_behind" in through["flags"].split()
    assert "open_behind" not in pit["flags"].split()
    assert capsys.readouterr().out.startswith("Two holes found on 0.059 m2, 100 % of the part; ")


def test_settings_reach_the_detector(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own_scale = ["--detector", "thesis", "--set", "scale=highest_before"]
    assert detect.main([str(capture), *own_scale, "--average", "median"]) == 0
    printed = capsys.readouterr().out
    assert "threshold: 1 x" in printed and "the detector's own" in printed
    assert detect.main([str(capture), "--max-frames", "2"]) == 0
    assert "2 frames averaged" in capsys.readouterr().out


def test_a_camera_may_lend_its_lens(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from scenes.sensor.camera import load_camera

    lens = load_camera("azure_kinect_nfov").nominal_lens
    slopes = lens.region_slopes(lens.whole)
    z_mm = np.rint(900 / (1 - 0.1 * slopes[..., 0])).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "1.png"), z_mm)
    quick = ["--detector", "thesis", "--threshold", "6"]
    assert detect.main([str(tmp_path), "--intrinsics", "azure_kinect_nfov", *quick]) == 0
    assert "no findings" in capsys.readouterr().out


# ---- what it refuses
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "told"),
    (
        (("--crop", "circle"), "--crop circle"),
        (("--crop", "box:1,2,3"), "box:x0,x1,y0,y1,z0,z1"),
        (("--crop", "box:500,-500,-500,500,100,900"), "a lower bound is not below the upper one"),
        (("--crop", "box:a,2,3,4,5,6"), "not all of its values are numbers"),
        (("--crop", "box:-500,500,-500,500,5000,9000"), "holds none of the cloud's"),
        (("--crop", "polygon:200,1,300,1,200,90"), "none of the cloud's 6911 points"),
        (("--set", "surface.degre=3"), "unknown key `degre` in `surface`"),
        (("--set", "surface"), "KEY=VALUE"),
        (("--set", "min_points=0"), "min_points"),
        (("--detector", "thesys"), "did you mean 'thesis'"),
        (("--threshold", "0"), "above 0"),
        (("--threshold", "nan"), "above 0"),
        (("--threshold", "3", "--quiet-capture", "x"), "give one of them"),
        (
            ("--threshold", "3", "--false-calls", "1"),
            "--threshold and --false-calls set the threshold",
        ),
        (("--quiet-capture", "x", "--false-calls", "1"), "--quiet-capture and --false-calls set"),
        (("--false-calls", "0"), "above 0"),
        (("--false-calls", "inf"), "above 0"),
        (("--intrinsics", "no_such_camera"), "azure_kinect_nfov"),
        (("--unit", "m"), "--unit mm"),
        (("--quiet-capture", "nowhere"), "nowhere: no such file"),
    ),
)
def test_a_mistake_is_one_message_and_leaves_nothing(
    capture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    told: str,
) -> None:
    assert told in failed(capsys, capture, "--out", tmp_path / "out", *arguments)
    assert not (tmp_path / "out").exists()


def test_fewer_points_than_coefficients(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    stored = np.zeros((72, 96), np.uint16)
    stored[10:13, 10:13] = 500
    np.save(tmp_path / "d.npy", stored)
    arguments = (
        tmp_path / "d.npy",
        "--intrinsics",
        plane.write_lens(tmp_path / "lens.json"),
        "--crop",
        "none",
    )
    message = failed(capsys, *arguments, "--set", "surface.degree=3")
    assert "9 valid points" in message and "10 coefficients" in message
    assert detect.main([*map(str, arguments)]) == 0
    assert capsys.readouterr().out.startswith(
        "warning: 9 points are too few to tell whether the surface (degree 1"
    )


def test_a_folder_that_cannot_be_written_is_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert "cannot be written" in failed(capsys, capture, "--out", tmp_path / "file")
    assert "cannot be written" in failed(capsys, capture, "--out", tmp_path / "file" / "below")


@pytest.mark.parametrize("existing", (False, True))
def test_a_full_disk_leaves_the_old_files_or_none(
    capture: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    existing: bool,
) -> None:
    out = tmp_path / "out"
    if existing:
        out.mkdir()
        (out / "findings.csv").write_text("old")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("harness.report.findings._save", full)
    assert "the disk is full" in failed(capsys, capture, "--out", out)
    assert out.exists() == existing
    assert not existing or [path.read_text() for path in out.iterdir()] == ["old"]


def test_help_is_there_without_the_heavy_libraries() -> None:
    code = "import sys; sys.argv = ['detect', '--help']\nimport harness.detect as d\n"
    code += "try: d.main()\nexcept SystemExit: pass\n"
    code += (
        "print([m for m in ('numpy', 'cv2', 'numba', 'matplotlib', 'open3d', 'mitsuba') if m in "
        "sys.modules])"
    )
    stdout = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout
    assert "--quiet-capture" in stdout and stdout.strip().endswith("[]")


# ---- parts
# -----------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.text(max_size=30))
def test_a_crop_is_read_or_refused(text: str) -> None:
    try:
        assert crop_from_text(text)["kind"] in ("auto", "none", "box", "polygon")
    except UserError as mistake:
        assert "auto" in (mistake.legal or "")


# ---- real captures
# ---------------------------------------------------------------------------------------------------


# Mouths that are seen in the mean depth and that nothing lies beside, in pixels.
UPPER = [
    (716, 147),
    (803, 144),
    (718, 222),
    (809, 219),
    (902, 216),
    (721, 303),
    (816, 302),
    (726, 392),
    (825, 392),
]
LOWER = [
    (244, 394),
    (340, 394),
    (437, 393),
    (218, 492),
    (321, 491),
    (423, 491),
    (729, 491),
    (836, 491),
    (944, 493),
]
LOWEST = [(1059, 494), (190, 603), (300, 602), (407, 601), (517, 603), (626, 603), (736, 605)]
MOUTHS = np.array(UPPER + LOWER + LOWEST)
# Calls behind the surface where the picture shows the edge of a tag and no mouth.
BESIDE_TAGS = np.array([(272, 379), (206, 699), (210, 265), (98, 668), (84, 648)])


def missed_and_false(findings: list[dict[str, str]], mouths: np.ndarray) -> tuple[int, int]:
    """How many mouths no hole was found at; and how many findings of the rows of mouths between
    the tags, where nothing else is, are no mouth."""
    all_rows = np.array(
        [(row["kind"] == "bump", float(row["u_px"]), float(row["v_px"])) for row in findings]
    )
    result = all_rows[all_rows[:, 0] == 0, 1:]
    missed = np.linalg.norm(mouths[:, None] - result[None], axis=2).min(axis=1) > 12
    bare = all_rows[
        (all_rows[:, 1] > 150)
        & (all_rows[:, 1] < 500)
        & (all_rows[:, 2] > 410)
        & (all_rows[:, 2] < 650)
    ]
    strays = np.linalg.norm(MOUTHS[:, None] - bare[None, :, 1:], axis=2).min(axis=0) > 12
    return int(missed.sum()), int((strays | (bare[:, 0] > 0)).sum())


@pytest.mark.usefixtures("unpictured")
def test_a_part_of_the_drilled_plate(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The default command on the rows of mouths at the lower left."""
    part = "polygon:120,350,520,350,520,680,120,680"
    assert (
        detect.main(
            [str(shared_data / "azure_drilled_board"), "--crop", part, "--out", str(tmp_path)]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert (
        "17 frames averaged" in printed
        and "left out: depth/00003.png: the whole range jumps" in printed
    )
    assert "from this capture's own null" in printed and "cannot set its own" not in printed
    mouths = MOUTHS[(MOUTHS[:, 0] < 500) & (MOUTHS[:, 1] > 350)]
    missed, false = missed_and_false(rows_of(tmp_path / "findings.csv"), mouths)
    assert len(mouths) == 9 and missed <= 1 and false <= 2


@pytest.mark.slow
def test_the_drilled_plate_as_it_stands(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The default command, with no setting of its own, and `matched`, which calls at tags."""
    plate = str(shared_data / "azure_drilled_board")
    assert detect.main([plate, "--out", str(tmp_path / "default")]) == 0
    printed = capsys.readouterr().out
    assert "17 frames averaged" in printed
    assert "left out: depth/00003.png: the whole range jumps" in printed
    assert "cannot set its own" not in printed
    assert "noise explains" not in printed
    assert "detector: local, as it found" in printed
    missed, false = missed_and_false(rows_of(tmp_path / "default" / "findings.csv"), MOUTHS)
    assert missed <= 1 and false <= 2
    assert detect.main([plate, "--detector", "matched", "--out", str(tmp_path)]) == 0
    findings = rows_of(tmp_path / "findings.csv")
    # The object on the plate stands 30 mm before the surface, and is a bump.
    assert any(row["kind"] == "bump" and float(row["depth_mm"]) < -10 for row in findings)
    missed, false = missed_and_false(findings, MOUTHS)
    assert missed <= 1 and false <= 2
    # one false call is expected on the bare plate, the others at the tags, where they are
    null = json.loads((tmp_path / "findings.json").read_text())["surface"]["own_null"]
    assert null["expected"] - null["at_marks"] == pytest.approx(1.0, rel=1e-3)
    centres_px = np.array([(float(row["u_px"]), float(row["v_px"])) for row in findings])
    probabilities = np.array([float(row["noise_probability"]) for row in findings])
    is_bump = np.array([row["kind"] == "bump" for row in findings])
    no_holes = np.linalg.norm(centres_px[:, None] - BESIDE_TAGS, axis=2).min(axis=1) < 12
    assert no_holes.sum() >= 4
    assert (probabilities[no_holes] > 0.3).all()
    # all bumps but the object are false
    doubtful = no_holes.sum() + is_bump.sum() - 1
    assert null["low"] < doubtful < null["high"]
    mouths = np.linalg.norm(centres_px[:, None] - MOUTHS, axis=2).min(axis=1) < 12
    assert (probabilities[mouths & ~is_bump] < 0.05).mean() > 0.85
    assert probabilities[~is_bump & (probabilities < 0.05)].sum() < 1.0


@pytest.mark.slow
def test_the_recording_as_it_stands(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        detect.main([str(shared_data / "azure_mkv" / "recording.mkv"), "--out", str(tmp_path)]) == 0
    )
    printed = capsys.readouterr().out
    assert "1 frame averaged" in printed
    assert printed.startswith("warning: it is doubtful which surface is the target")
