"""``tofpod export``: what is written is read back bit for bit, with the truth beside it, or not at
all."""

from __future__ import annotations

import errno
import json
import sqlite3
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from detectors import load_detector
from detectors.averages.average import AverageConfig, average
from detectors.interface import Detection, Measurement
from detectors.recordings import open_capture
from harness import detect
from harness.inspection.arguments import read_poses
from harness.programs.dataset import exchange as tum
from harness.programs.dataset import export
from harness.programs.dataset.exchange import START_NS, in_turn, quaternion_of
from harness.vocabulary.files import atomic_folder
from harness.vocabulary.geometry import (
    Cloud,
    FrameSource,
    Lens,
    Region,
    invert,
    rotation_xyz_deg,
    transform_points,
)
from harness.vocabulary.provenance import RESULTS_VERSION
from scenes.closed_form import Plane, layered_view
from scenes.optics import NoiseFreeView
from scenes.perspectives import ArcViews, guessed_T_reference_view, poses_of
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.thesis import ThesisTargetConfig

CAMERA = CameraConfig(name="azure_kinect_nfov", unit_seed=1)
FRONT = Plane(0.7, 0.1)
BACK = Plane(0.715, 0.1)
REGION = Region(260, 340, 250, 370)
FRAMES = 3
DECLARED = """
name: small
seed: 3
source:
  kind: simulated
  target: {name: thesis}
  camera: {name: azure_kinect_nfov, unit_seed: 1}
  views: {kind: arc, count: 3, spread_deg: 40.0}
capture: {frames: 3}
detector:
  name: thesis
  settings: {crop: {kind: none}}
threshold: {k: 5.0}
mapping: {}
"""


def drilled(slopes: np.ndarray) -> np.ndarray:
    """Where the front is: all but a hole of 12 mm."""
    return np.hypot(slopes[..., 0] - 0.01, slopes[..., 1] + 0.07) > 0.006 / 0.7


@pytest.fixture(scope="module")
def view() -> NoiseFreeView:
    """A drilled plane before another, as the Azure Kinect's lens sees it."""
    return layered_view(camera_of(CAMERA), REGION, FRONT, BACK, drilled, 0.6)


@pytest.fixture(scope="module", autouse=True)
def _every_render_is_the_plane(view: NoiseFreeView) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scenes.render.cache.cached_view", lambda *_: (view, True))
        yield


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """An experiment with three views."""
    path = tmp_path / "experiment.yaml"
    path.write_text(DECLARED)
    return path


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """That experiment in each form: two views as bags, all three as one sequence."""
    folder = tmp_path_factory.mktemp("exports")
    path = folder / "experiment.yaml"
    path.write_text(DECLARED)
    bags = {form: exported(path, folder / form, form, "--views", "2") for form in ("ros2", "mcap")}
    return bags | {"tum": exported(path, folder / "tum", "tum")}


def exported(experiment: Path, out: Path, form: str, *options: str) -> Path:
    assert export.main([str(experiment), "--format", form, "--out", str(out), *options]) == 0
    return out


def failed(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """The message of a run that must end with exit code 2."""
    assert export.main([str(argument) for argument in arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert "Traceback" not in message
    return message


def detected(cloud: Cloud) -> tuple[tuple[Detection, ...], tuple[Measurement, ...]]:
    box = {
        "kind": "box",
        "x_mm": [-60.0, 60.0],
        "y_mm": [-80.0, -20.0],
        "z_mm": [0.0, 1000.0],
        "range_max_m": None,
    }
    detector = load_detector("thesis", {"crop": box})
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, 5.0)
    return detections, tuple(
        detector.measure(cloud, evidence, detection) for detection in detections
    )


def simulated(view: NoiseFreeView, number: int) -> FrameSource:
    labels = ("damaged", 0) if number == 0 else ("damaged", 0, "view", number)
    return SimulatedUnit(camera_of(CAMERA), CAMERA, view).capture(FRAMES, 3, *labels)


# ---- bags
# ------------------------------------------------------------------------------------------------


def assert_measured_alike(first: Measurement, second: Measurement) -> None:
    """All numbers are equal but for the place in the picture: to it, a crop adds its own start,
    which rounds the last digit in another way."""
    assert second.u_px == pytest.approx(first.u_px, rel=1e-14)
    assert second.v_px == pytest.approx(first.v_px, rel=1e-14)
    elsewhere = replace(second, u_px=first.u_px, v_px=first.v_px)
    assert repr(elsewhere) == repr(first)


@pytest.mark.parametrize("form", ("ros2", "mcap"))
def test_written_read_back_and_detected_is_equal_bit_for_bit(
    exports: dict[str, Path], view: NoiseFreeView, form: str
) -> None:
    out = exports[form]
    for number in (0, 1):
        source = simulated(view, number)
        expected = average(source, AverageConfig())
        got = average(open_capture([out / f"view_0{number}"]), AverageConfig())
        inside = got.region.shape, source.region.within(got.region)
        assert inside[0] == (576, 640)
        for name in ("points_m", "count", "variance_m2", "rgb", "amplitude"):
            np.testing.assert_array_equal(
                getattr(got, name)[inside[1]], getattr(expected, name), err_msg=name
            )
        outside = np.ones(got.valid.shape, bool)
        outside[inside[1]] = False
        assert not got.valid[outside].any()
        assert (got.z_step_m, got.lens, got.n_frames) == (
            expected.z_step_m,
            expected.lens,
            expected.n_frames,
        )
        detections, measured = detected(expected)
        detections_read, measured_read = detected(got)
        assert len(detections) == 1
        scores = [detection.score for detection in detections]
        assert scores == [detection.score for detection in detections_read]
        assert len(measured) == 1
        assert len(measured_read) == 1
        assert_measured_alike(measured[0], measured_read[0])
        assert measured[0].model_diameter_m == pytest.approx(0.012, rel=0.1)


@pytest.mark.usefixtures("unpictured")
@pytest.mark.slow  # the readers' tests compare both storages
def test_the_program_finds_the_same_in_either_storage(
    exports: dict[str, Path], tmp_path: Path
) -> None:
    for form in ("ros2", "mcap"):
        bag = exports[form] / "view_00"
        reading = [
            "--topic",
            "points2",
            "--crop",
            "box:-60,60,-80,-20,0,1000",
            "--out",
            str(tmp_path / f"found_{form}"),
        ]
        reading += ["--threshold", "8"]
        assert detect.main([str(bag), *reading]) == 0
    first = (tmp_path / f"found_{'ros2'}" / "findings.csv").read_text()
    second = (tmp_path / f"found_{'mcap'}" / "findings.csv").read_text()
    assert first == second
    assert len(first.splitlines()) == 2


def test_a_bag_holds_lens_and_pose_at_the_clouds_times(exports: dict[str, Path]) -> None:
    with AnyReader([exports["mcap"] / "view_01"]) as reader:
        got = [
            (c.topic, stamp, reader.deserialize(raw, c.msgtype))
            for c, stamp, raw in reader.messages()
        ]
    topics = [topic for topic, _, _ in got]
    assert topics == ["/tf_static", *["/depth/camera_info", "/points2"] * FRAMES]
    start = START_NS + round(FRAMES * 1e9 / 30) + 10**9
    stamps = [
        start,
        *(start + round(frame * 1e9 / 30) for frame in range(FRAMES) for _ in range(2)),
    ]
    assert [stamp for _, stamp, _ in got] == stamps
    pose = got[0][2].transforms[0]
    assert (pose.header.frame_id, pose.child_frame_id) == ("board", "view_01_depth_optical_frame")
    target = ThesisTargetConfig().declare()
    T_camera_board = poses_of(ArcViews(kind="arc", count=3, spread_deg=40.0), target.pose)[
        1
    ].T_camera_board
    translation = pose.transform.translation
    np.testing.assert_allclose(
        [translation.x, translation.y, translation.z], invert(T_camera_board)[:3, 3], rtol=1e-14
    )
    info = got[1][2]
    cloud = got[2][2]
    assert cloud.header.stamp == info.header.stamp
    assert cloud.header.frame_id == pose.child_frame_id
    lens = camera_of(CAMERA).nominal_lens
    assert info.distortion_model == "rational_polynomial"
    np.testing.assert_array_equal(info.d, lens.distortion)
    np.testing.assert_array_equal(info.k, lens.matrix.ravel())
    assert [(f.name, f.offset, f.datatype) for f in cloud.fields] == [
        (name, 4 * i, 7) for i, name in enumerate(("x", "y", "z", "rgb", "intensity"))
    ]
    assert not cloud.is_dense
    assert (cloud.height, cloud.width) == (576, 640)


def test_the_truth_and_the_nominal_poses_stand_beside(
    exports: dict[str, Path], tmp_path: Path
) -> None:
    out = exports["ros2"]
    truth = json.loads((out / "truth.json").read_text())
    target = ThesisTargetConfig().declare()
    assert len(truth["damages"]) == 11
    views = ArcViews(kind="arc", count=3, spread_deg=40.0)
    poses = poses_of(views, target.pose)
    for number, view_truth in enumerate(truth["views"]):
        np.testing.assert_array_equal(
            view_truth["T_board_camera"], invert(poses[number].T_camera_board)
        )
    nominal = json.loads((out / "nominal_poses.json").read_text())["T_reference_view"]
    np.testing.assert_allclose(nominal[0], np.eye(4), atol=1e-15)
    np.testing.assert_array_equal(
        nominal[1], guessed_T_reference_view(views, poses, 1, "damaged", 0)
    )
    np.testing.assert_allclose(read_poses(out / "nominal_poses.json", 2), nominal, atol=1e-12)
    for name in ("truth.json", "nominal_poses.json", "provenance.json"):
        assert json.loads((out / name).read_text())["results_version"] == RESULTS_VERSION
    facts = json.loads((out / "provenance.json").read_text())
    assert facts["seed"] == 3
    assert facts["rounding_step_mm"] == 1.0
    assert "--format ros2" in facts["command"]
    # the declaration beside it exports the same again
    again = exported(
        out / "experiment.yaml", tmp_path / "again", "ros2", "--views", "2", "--frames", "1"
    )
    assert (again / "truth.json").read_text() == (out / "truth.json").read_text()


def test_without_damage_nothing_is_listed_and_the_noise_is_another(
    experiment: Path, exports: dict[str, Path], tmp_path: Path
) -> None:
    free = exported(
        experiment, tmp_path / "free", "mcap", "--hole-free", "--views", "1", "--frames", "1"
    )
    assert json.loads((free / "truth.json").read_text())["damages"] == []
    first = next(open_capture([free / "view_00"]).frames()).z_m
    second = next(open_capture([exports["mcap"] / "view_00"]).frames()).z_m
    assert not np.array_equal(first, second, equal_nan=True)


# ---- TUM
# ------------------------------------------------------------------------------------------------


def test_a_sequence_has_what_the_benchmark_and_rtabmap_read(exports: dict[str, Path]) -> None:
    out = exports["tum"]
    times = [
        line.split()[0]
        for line in (out / "depth.txt").read_text().splitlines()
        if not line.startswith("#")
    ]
    assert len(times) == 3 * FRAMES
    assert times[:4] == [
        "1000000000.000000",
        "1000000000.033333",
        "1000000000.066667",
        "1000000001.100000",
    ]
    lines = (out / "associations.txt").read_text().splitlines()
    assert lines == [f"{t} rgb/{t}.png {t} depth/{t}.png" for t in times]
    for folder in ("depth", "depth_sync", "rgb", "rgb_sync"):
        assert sorted(path.name for path in (out / folder).iterdir()) == [f"{t}.png" for t in times]
    stored = cv2.FileStorage(str(out / "rtabmap_calib.yaml"), cv2.FILE_STORAGE_READ)
    lens = camera_of(CAMERA).nominal_lens
    assert (stored.getNode("image_width").real(), stored.getNode("image_height").real()) == (
        640,
        576,
    )
    matrix = stored.getNode("camera_matrix").getNode("data")
    assert [matrix.at(i).real() for i in range(9)] == lens.matrix.ravel().tolist()
    pinhole = stored.getNode("projection_matrix").getNode("data")
    assert [pinhole.at(i).real() for i in range(12)] == [
        lens.fx, 0, lens.cx, 0, 0, lens.fy, lens.cy, 0, 0, 0, 1, 0
    ]  # fmt: skip
    assert stored.getNode("distortion_coefficients").getNode("cols").real() == 5


def test_the_ground_truth_carries_the_camera_to_the_board(exports: dict[str, Path]) -> None:
    from scipy.spatial.transform import Rotation

    rows = np.loadtxt(exports["tum"] / "groundtruth.txt")
    truth = json.loads((exports["tum"] / "truth.json").read_text())
    assert rows.shape == (3 * FRAMES, 8)
    for row, view_truth in zip(rows, np.repeat(truth["views"], FRAMES), strict=True):
        T_board_camera = np.array(view_truth["T_board_camera"])
        np.testing.assert_allclose(row[1:4], T_board_camera[:3, 3], atol=1e-9)
        rotation = Rotation.from_quat(row[4:]).as_matrix()
        np.testing.assert_allclose(rotation, T_board_camera[:3, :3], atol=1e-8)


def test_a_sequence_read_back_lies_on_the_planes(
    experiment: Path, tmp_path: Path, view: NoiseFreeView
) -> None:
    """The pinhole's pixels are wrong by half a pixel at most, which on a plane of slope 0.1 is
    0.07 mm. One view only: all frames of a sequence are read as one capture."""
    out = exported(experiment, tmp_path / "out", "tum", "--views", "1")
    recording = open_capture([out])
    assert recording.z_step_m == 1e-3
    assert recording.lens is not None
    assert not any(recording.lens.distortion)
    cloud = average(recording, AverageConfig())
    simulated_cloud = average(simulated(view, 0), AverageConfig())
    pixels = np.round(camera_of(CAMERA).nominal_lens.project(cloud.points_m[cloud.valid])).astype(
        int
    )
    cut = simulated_cloud.region
    inside_columns = (pixels[:, 0] >= cut.col0) & (pixels[:, 0] < cut.col1)
    inside_rows = (pixels[:, 1] >= cut.row0) & (pixels[:, 1] < cut.row1)
    inside = inside_columns & inside_rows
    assert inside.mean() > 0.97
    rows = pixels[inside, 1] - cut.row0
    columns = pixels[inside, 0] - cut.col0
    expected = simulated_cloud.points_m[rows, columns]
    off = cloud.points_m[cloud.valid][inside] - expected
    pitch_m = 0.72 / camera_of(CAMERA).nominal_lens.fx
    close_to_back = np.abs(off[:, 2]) < 2e-7
    assert close_to_back.mean() > 0.97  # the rest: rounding to the other pixel at just half a pixel
    assert np.abs(off[close_to_back, :2]).max() < 0.51 * pitch_m


@pytest.mark.parametrize(
    "lens", (Lens(90, 70, 80.0, 81.0, 44.0, 35.0), Lens(90, 70, 80.0, 81.0, 44.0, 35.0, (0.1,) * 8))
)
def test_the_nearest_pixel_is_within_half_a_pixel_of_the_ray(lens: Lens) -> None:
    numbers = np.arange(1, 70 * 90 + 1, dtype=np.uint16).reshape(70, 90)
    numbered = tum.undistorted(lens, numbers).astype(int)
    inside = numbered > 0
    rows, columns = np.divmod(numbered - 1, 90)
    pinhole = Lens(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
    rays = np.concatenate([pinhole.region_slopes(pinhole.whole), np.ones((70, 90, 1))], axis=-1)
    off = np.abs(lens.project(rays) - np.stack([columns, rows], axis=-1))[inside]
    assert off.max() <= 0.5 + 1e-4
    assert inside.any()
    if not any(lens.distortion):
        assert inside.all()
        assert off.max() < 1e-4


def test_depth_units() -> None:
    z_m = np.array([[np.nan, 0.0, -1.0, 0.00115, 0.7, 13.107, 13.2]], np.float32)
    assert tum.depth_units(z_m).tolist() == [[0, 0, 0, 6, 3500, 65535, 0]]
    millimetres = (np.arange(1, 13_000) * 1e-3).astype(np.float32)[None]
    np.testing.assert_array_equal(tum.depth_units(millimetres)[0], 5 * np.arange(1, 13_000))


def test_times_are_written_to_the_microsecond() -> None:
    assert tum.seconds_text(10**18 + 33_333_333) == "1000000000.033333"
    assert tum.seconds_text(10**18 + 999_999_600) == "1000000001.000000"


def test_the_quaternion_turns_as_the_matrix_does() -> None:
    T_a_b = np.eye(4)
    T_a_b[:3, :3] = rotation_xyz_deg(170.0, 20.0, -75.0)
    x, y, z, w = quaternion_of(T_a_b)
    vector = np.array([0.3, -0.2, 0.9])
    axis = np.array([x, y, z])
    turned = vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)
    np.testing.assert_allclose(turned, transform_points(T_a_b, vector), atol=1e-14)
    assert w >= 0
    assert x * x + y * y + z * z + w * w == pytest.approx(1, abs=1e-14)


def test_views_follow_each_other_in_time(view: NoiseFreeView) -> None:
    views = in_turn([simulated(view, i) for i in range(3)], [np.eye(4)] * 3, FRAMES, 30.0)
    stamps = [view.stamp_ns(frame) for view in views for frame in range(FRAMES)]
    assert stamps == sorted(set(stamps))
    assert [view.name for view in views] == [
        "view_00",
        "view_01",
        "view_02",
    ]
    assert views[1].start_ns - views[0].stamp_ns(FRAMES - 1) == pytest.approx(
        10**9 + 1e9 / 30, abs=2
    )


# ---- what it refuses
# ------------------------------------------------------------------------------------------------


def test_mistakes_are_one_message_and_leave_nothing(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = (experiment, "--format", "mcap", "--out", tmp_path / "out")
    assert "the experiment has 3" in failed(capsys, *start, "--views", "4")
    away = (
        "source.views={kind: list, poses: [{distance_m: 0.7}, {distance_m: 0.7, offset_x_mm: "
        "900.0}]}"
    )
    assert "view 1 of 2" in failed(capsys, *start, "--set", away)
    assert "spread" in failed(capsys, *start, "--set", "source.views.spred_deg=20.0")
    assert "no such file" in failed(capsys, tmp_path / "none.yaml", *start[1:]).lower()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["experiment.yaml"]


def test_a_full_folder_is_left_alone(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("kept")
    assert "is not empty" in failed(
        capsys, experiment, "--format", "tum", "--out", tmp_path / "out"
    )
    assert [path.read_text() for path in (tmp_path / "out").iterdir()] == ["kept"]
    (tmp_path / "file").write_text("kept")
    assert "cannot be written" in failed(
        capsys, experiment, "--format", "tum", "--out", tmp_path / "file"
    )


@pytest.mark.parametrize(
    "fault",
    (
        OSError(errno.ENOSPC, "full"),
        sqlite3.OperationalError("database or disk is full"),
        KeyboardInterrupt(),
        RuntimeError("a bug"),
    ),
)
def test_half_an_export_is_never_seen(
    experiment: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException
) -> None:
    def broken(self: object) -> Iterator[object]:
        raise fault
        yield

    monkeypatch.setattr("harness.programs.dataset.exchange.ExportedView.exposures", broken)
    arguments = [str(experiment), "--format", "mcap", "--out", str(tmp_path / "out")]
    if isinstance(fault, RuntimeError):
        with pytest.raises(RuntimeError):
            export.main(arguments)
    else:
        assert export.main(arguments) == (130 if isinstance(fault, KeyboardInterrupt) else 2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["experiment.yaml"]


def test_a_folder_appears_whole_with_the_users_rights(tmp_path: Path) -> None:
    with atomic_folder(tmp_path / "a" / "b") as folder:
        (folder / "x").write_text("1")
        assert not (tmp_path / "a" / "b").exists()
    assert (tmp_path / "a" / "b" / "x").read_text() == "1"
    (tmp_path / "made").mkdir()
    assert (tmp_path / "a" / "b").stat().st_mode == (tmp_path / "made").stat().st_mode
    with atomic_folder(tmp_path / "made") as folder:
        (folder / "y").write_text("2")
    assert [path.name for path in (tmp_path / "made").iterdir()] == ["y"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "made"]
