"""Azure Kinect recordings: the calibration's rules, the tracks, the colour on the depth pixels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from detectors.recordings import open_capture
from detectors.recordings.devices import colour_on_depth
from detectors.recordings.intrinsics import (
    ColourCamera,
    colour_camera,
    depth_lens,
    parse_calibration,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Lens, Reason
from tests.support import recorded_plane as plane

CAMERAS = parse_calibration("test", plane.calibration())
DEPTH = np.full((576, 640), 1000, np.uint16)


def refusal(path: Path) -> str:
    with pytest.raises(UserError) as caught:
        list(open_capture([path]).frames())
    return str(caught.value)


# ---- the calibration


def test_the_nfov_lens_by_hand() -> None:
    lens = depth_lens("test", CAMERAS, "NFOV_UNBINNED")
    assert (lens.width, lens.height) == (640, 576)
    expected = (0.49 * 1024, 0.5 * 1024, 0.51 * 1024 - 192 - 0.5, 0.52 * 1024 - 180 - 0.5)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx(expected)
    # k1 k2 p1 p2 k3 k4 k5 k6 from k1..k6, codx, cody, p2, p1
    assert lens.distortion == (0.55, -0.02, 2e-5, -7e-5, -0.003, 0.89, 0.086, -0.014)


@pytest.mark.parametrize(
    ("mode", "second_mode", "scale", "shift"),
    (
        ("NFOV_UNBINNED", "WFOV_UNBINNED", 1, (192, 180)),
        ("NFOV_2X2BINNED", "NFOV_UNBINNED", 2, (0, 0)),
        ("WFOV_2X2BINNED", "WFOV_UNBINNED", 2, (0, 0)),
    ),
)
def test_modes_look_along_the_same_rays(
    mode: str,
    second_mode: str,
    scale: int,
    shift: tuple[int, int],
) -> None:
    """A pixel of a crop, or the middle of four binned pixels, sees what it sees on the whole
    sensor."""
    u, v = np.meshgrid(np.linspace(100, 200, 5), np.linspace(100, 200, 5))
    there_u = scale * u + (scale - 1) / 2 + shift[0]
    there_v = scale * v + (scale - 1) / 2 + shift[1]
    slopes = depth_lens("test", CAMERAS, mode).slopes(u, v)
    np.testing.assert_allclose(
        slopes, depth_lens("test", CAMERAS, second_mode).slopes(there_u, there_v), atol=1e-9
    )


def test_colour_modes_are_crops_of_one_picture() -> None:
    full_sensor = colour_camera("test", CAMERAS, 4096, 3072)
    cropped = colour_camera("test", CAMERAS, 1280, 720)
    assert full_sensor is not None
    assert cropped is not None
    # 1280 x 960 scaled down from 4096 x 3072, then rows 120 to 839
    u = 300.0
    v = 200.0
    scale = 3.2
    expected = full_sensor.lens.slopes(
        np.array((u + 0.5) * scale - 0.5), np.array((v + 120 + 0.5) * scale - 0.5)
    )
    np.testing.assert_allclose(cropped.lens.slopes(np.array(u), np.array(v)), expected, atol=1e-12)
    assert colour_camera("test", CAMERAS, 333, 222) is None


def test_the_early_wide_calibration_is_the_same_camera() -> None:
    data = json.loads(plane.calibration().rstrip(b"\0"))
    camera = data["CalibrationInformation"]["Cameras"][1]
    camera["SensorHeight"] = 2304
    numbers = camera["Intrinsics"]["ModelParameters"]
    numbers[1], numbers[3] = (0.5 * 3072 - 384) / 2304, 0.64 * 3072 / 2304
    early = colour_camera("test", parse_calibration("test", json.dumps(data).encode()), 1280, 720)
    late = colour_camera("test", CAMERAS, 1280, 720)
    assert early is not None
    assert late is not None
    assert (early.lens.fy, early.lens.cy) == pytest.approx((late.lens.fy, late.lens.cy))


@pytest.mark.parametrize(
    ("path", "value", "message"),
    (
        (("Intrinsics", "ModelType"), "CALIBRATION_LensDistortionModelOther", "ModelOther"),
        (("Intrinsics", "ModelParameters"), [1.0], "1 parameters"),
        (("Intrinsics", "ModelParameters"), [0.5] * 10 + [0.1, 0, 0, 0], "centre of distortion"),
        (("Intrinsics", "ModelParameters"), [0.5, 0.5, -1.0, 0.5] + [0.0] * 10, "focal length"),
        (("SensorWidth",), 512, "1024"),
    ),
)
def test_a_calibration_that_is_not_understood_is_refused(
    path: tuple[str, ...],
    value: object,
    message: str,
) -> None:
    data = json.loads(plane.calibration().rstrip(b"\0"))
    camera = data["CalibrationInformation"]["Cameras"][0]
    for key in path[:-1]:
        camera = camera[key]
    camera[path[-1]] = value
    with pytest.raises(UserError, match=message):
        depth_lens("test", parse_calibration("test", json.dumps(data).encode()), "NFOV_UNBINNED")


# ---- colour


def test_colour_is_taken_where_the_point_appears_in_the_colour_camera() -> None:
    """A plane at 1 m seen by two pinholes 50 mm apart: the disparity is f * 50 mm / 1 m = 10 px."""
    depth = Lens(64, 48, 200.0, 200.0, 31.5, 23.5)
    colour = ColourCamera(Lens(64, 48, 200.0, 200.0, 31.5, 23.5), np.eye(4))
    colour.T_colour_depth[0, 3] = -0.05
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[..., 0] = np.arange(64)[None, :]
    picture[..., 1] = np.arange(48)[:, None]
    z_m = np.ones((48, 64), np.float32)
    z_m[7, 30] = np.nan
    sampled = colour_on_depth(z_m, depth.region_slopes(depth.whole), colour, picture)
    expected = np.zeros_like(picture)
    expected[:, 10:] = picture[:, :54]
    expected[7, 30] = 0
    np.testing.assert_array_equal(sampled, expected)


# ---- the file


def test_a_recording_gives_its_pictures_together(tmp_path: Path) -> None:
    colour = np.full((720, 1280, 3), (10, 20, 30), np.uint8)
    frames = [{"COLOR": colour + i, "DEPTH": DEPTH + i, "IR": DEPTH // 10 + i} for i in range(3)]
    recording = open_capture(
        [plane.write_mkv(tmp_path / "r.mkv", frames, attached=plane.calibration())]
    )
    assert recording.lens == depth_lens("test", CAMERAS, "NFOV_UNBINNED")
    read = list(recording.frames())
    assert [frame.name for frame in read] == ["r.mkv frame 0", "r.mkv frame 1", "r.mkv frame 2"]
    for i, frame in enumerate(read):
        np.testing.assert_allclose(frame.z_m, 1.0 + i / 1000, atol=1e-6)
        assert frame.amplitude is not None
        assert (frame.amplitude == 100 + i).all()
        assert frame.rgb is not None
        assert frame.rgb[288, 320].tolist() == [10 + i, 20 + i, 30 + i]


def test_captures_without_depth_are_skipped(tmp_path: Path) -> None:
    frames = [{"DEPTH": DEPTH, "IR": DEPTH}, {"IR": DEPTH}, {"DEPTH": DEPTH + 2, "IR": DEPTH + 2}]
    recording = open_capture(
        [plane.write_mkv(tmp_path / "r.mkv", frames, attached=plane.calibration())]
    )
    assert [float(frame.z_m[0, 0]) for frame in recording.frames()] == pytest.approx([1.0, 1.002])
    assert [
        frame.amplitude[0, 0] for frame in recording.frames() if frame.amplitude is not None
    ] == [1000, 1002]


def test_faulty_recordings_are_explained(tmp_path: Path) -> None:
    intact = plane.write_mkv(
        tmp_path / "r.mkv", [{"DEPTH": DEPTH}] * 3, attached=plane.calibration()
    )
    content = intact.read_bytes()
    path = tmp_path / "cut.mkv"
    for part in (0.0, 0.001, 0.3, 0.7, 0.99):
        path.write_bytes(content[: int(part * len(content))])
        assert "cut.mkv" in refusal(path)
        assert "truncated" in refusal(path)
    assert "no DEPTH track (its tracks: IR)" in refusal(
        plane.write_mkv(tmp_path / "ir.mkv", [{"IR": DEPTH}])
    )
    assert "lens of these depth images" in refusal(
        plane.write_mkv(tmp_path / "bare.mkv", [{"DEPTH": DEPTH}])
    )
    odd = plane.write_mkv(
        tmp_path / "odd.mkv", [{"DEPTH": DEPTH}], "PASSIVE_IR", plane.calibration()
    )
    assert "PASSIVE_IR" in refusal(odd)
    assert "NFOV_UNBINNED" in refusal(odd)
    wrong = plane.write_mkv(
        tmp_path / "wrong.mkv", [{"DEPTH": DEPTH}], "WFOV_UNBINNED", plane.calibration()
    )
    assert "640 x 576 pixels, but the lens is of 1024 x 1024" in refusal(wrong)
    assert "calibration" in refusal(
        plane.write_mkv(tmp_path / "j.mkv", [{"DEPTH": DEPTH}], attached=b"{}")
    )


# ---- a real one


def plane_rms_mm(points: np.ndarray) -> float:
    centred = points - points.mean(axis=0)
    return 1e3 * float(np.linalg.svd(centred, full_matrices=False)[1][2]) / np.sqrt(len(points))


def test_the_calibration_flattens_a_real_wall(shared_data: Path) -> None:
    recording = open_capture([shared_data / "azure_mkv" / "recording.mkv"])
    (frame,) = recording.frames()
    assert frame.rgb is not None
    assert frame.amplitude is not None
    assert recording.lens is not None
    cut = slice(60, 260), slice(20, 230)  # the papered wall on the left
    valid = frame.reason[cut] == Reason.VALID
    z = frame.z_m[cut][valid].astype(float)[:, None]
    pinhole = Lens(
        640, 576, recording.lens.fx, recording.lens.fy, recording.lens.cx, recording.lens.cy
    )
    rms = []
    for slopes in (recording.slopes, pinhole.region_slopes(pinhole.whole)):
        assert slopes is not None
        rms.append(plane_rms_mm(np.concatenate([slopes[cut][valid] * z, z], axis=1)))
    assert rms[0] < 0.5 * rms[1]


def test_real_colour_falls_on_the_depth_pixels(shared_data: Path) -> None:
    """The window's blind is bright in colour and dark in infrared: its edge must lie on the same
    pixels in both."""
    (frame,) = open_capture([shared_data / "azure_mkv" / "recording.mkv"]).frames()
    assert frame.rgb is not None
    assert frame.amplitude is not None
    rows = slice(160, 300)
    grey = np.abs(np.diff(frame.rgb[rows, 380:450].mean(axis=(0, 2))))
    infrared = np.abs(np.diff(frame.amplitude[rows, 380:450].mean(axis=0)))
    shifts = np.arange(-12, 13)
    scores = []
    for shift in shifts:
        moved = np.roll(infrared, shift)
        scores.append(np.corrcoef(grey[12:-12], moved[12:-12])[0, 1])
    assert abs(shifts[np.argmax(scores)]) <= 2


def test_a_recording_without_the_tag_of_its_mode_has_the_mode_of_its_size(tmp_path: Path) -> None:
    depth = np.full((576, 640), 900, np.uint16)
    path = plane.write_mkv(
        tmp_path / "femto.mkv", [{"DEPTH": depth}], mode="", attached=plane.calibration()
    )
    lens = open_capture([path]).lens
    assert lens is not None
    assert (lens.fx, lens.cx) == pytest.approx((0.49 * 1024, 0.51 * 1024 - 192.5))
