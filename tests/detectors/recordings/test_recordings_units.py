"""What stored numbers mean: codes for no return, the unit and who says so, and clouds that look
backwards."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from detectors.pixels.noise import noise_reach_px
from detectors.recordings import Recording, open_capture
from detectors.recordings.distances import decided_unit, no_return_codes
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens, Reason
from scenes.sensor.camera import lens_named, lens_names
from tests.support import recorded_plane as plane

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"
LENS = Lens(640, 576, 504.6, 504.6, 321.7, 333.3)


def noisy(distance_m: float, unit_m: float, seed: int = 0) -> np.ndarray:
    """(72, 96) stored whole numbers of a tilted plane with noise of 1 mm."""
    x = plane.slopes()[..., 0]
    noise_m = np.random.default_rng(seed).normal(0, 1e-3, x.shape)
    return np.rint((distance_m / (1 - 0.1 * x) + noise_m) / unit_m)


def opened(
    folder: Path,
    stored: np.ndarray,
    unit: str | None = None,
    lens: Lens | None = plane.LENS,
) -> Recording:
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "1.png"), stored.astype(np.uint16))
    return open_capture([folder], lens=lens, unit=unit)


# ---- codes for no return


@pytest.mark.parametrize(
    ("codes", "dtype"),
    (
        ((65535,), np.uint16),
        ((65534,), np.uint16),
        ((65300, 65400, 65500), np.uint16),
        ((4095,), np.uint16),
        ((32767,), np.int16),
        ((-1,), np.int16),
        ((1,), np.uint16),
        ((10_000.0,), np.float32),
        ((-1.0,), np.float64),
    ),
)
def test_a_code_for_no_return_is_told_by_its_place_among_the_distances(
    codes: tuple[float, ...],
    dtype: type,
) -> None:
    stored = noisy(0.7, 1e-3).astype(dtype).ravel()
    assert no_return_codes(stored) == ()
    for n, code in enumerate(codes):
        stored[30 * n : 30 * n + 30] = code
    assert sorted(no_return_codes(stored)) == sorted(codes)


def test_distances_are_no_codes() -> None:
    far = np.concatenate([noisy(0.4, 1e-3).ravel(), noisy(2.5, 1e-3).ravel()[:40]]).astype(
        np.uint16
    )
    assert no_return_codes(far) == ()  # a wall six times as far, with noise
    assert no_return_codes(np.repeat([400, 2500], 500)) == ()  # two faces without noise
    assert no_return_codes(np.array([], np.uint16)) == ()


def test_the_largest_number_of_16_bits_is_a_code_in_metres_too() -> None:
    stored = np.concatenate(
        [noisy(0.7, 1e-3).ravel(), np.geomspace(1000, 64000, 3000), np.full(9, 65535.0)]
    )
    assert no_return_codes((stored / 1000).astype(np.float32)) == (float(np.float32(65.535)),)
    assert no_return_codes((stored / 1000).astype(np.float32)[:-9]) == ()


def test_no_return_is_said_and_left_out(tmp_path: Path) -> None:
    stored = noisy(0.7, 1e-3)
    stored[:7] = 65535
    recording = opened(tmp_path / "c", stored)
    frame = next(recording.frames())
    assert (frame.reason[:7] == Reason.NO_RETURN).all()
    assert np.isfinite(frame.z_m[7:]).all()
    assert "65535 is read as no return, 9.7 % of pixels" in recording.notes


def test_a_cloud_that_looks_backwards_is_turned_and_said(tmp_path: Path) -> None:
    points = plane.points_m(plane.depth_mm())
    recording = open_capture([plane.write_pcd(tmp_path / "c.pcd", points * [1, -1, -1])])
    frame = next(recording.frames())
    assert any("turned" in note for note in recording.notes)
    np.testing.assert_allclose(np.dstack([frame.xy_m, frame.z_m]), points, atol=1e-6)


# ---- units


@pytest.mark.parametrize(
    ("stored", "unit_mm"),
    (
        (noisy(0.7, 1e-3).astype(np.uint16), 1.0),
        (
            noisy(0.7, 1e-3).astype(np.uint16) * np.uint16(5),
            0.2,
        ),  # TUM RGB-D from a camera with 1 mm
        (noisy(0.7, 1e-3) * 1e-3, 1000.0),
        (noisy(0.7, 1e-3), 1.0),
        (noisy(0.7, 1e-4) / 100, 10.0),
    ),
)
def test_the_unit_is_told_by_the_data_and_printed(
    tmp_path: Path,
    stored: np.ndarray,
    unit_mm: float,
) -> None:
    path = tmp_path / "d.npy"
    np.save(path, stored)
    recording = open_capture([path], lens=plane.LENS)
    assert recording.unit_text.startswith(f"depth unit {unit_mm:.4g} mm, from ")
    assert np.nanmedian(next(recording.frames()).z_m) == pytest.approx(0.7, rel=0.02)
    # whole numbers are millimetres, whatever their type
    usual = 1.0 if (stored % 1 == 0).all() else 1000.0
    assert bool(recording.warnings) == (unit_mm != usual)


@pytest.mark.parametrize("unit_m", (2.5e-4, 1e-4))
def test_where_two_units_are_plausible_it_asks(tmp_path: Path, unit_m: float) -> None:
    path = tmp_path / "c"
    with pytest.raises(UserError, match="nothing states the unit") as caught:
        opened(path, noisy(0.9, unit_m))
    assert f"--unit {1 / unit_m:.0f}/m (0.9 m)" in str(caught.value)
    assert "--unit mm (" in str(caught.value)
    recording = opened(path, noisy(0.9, unit_m), unit=f"{1 / unit_m:.0f}/m")
    assert recording.warnings == ()
    assert f"from --unit {1 / unit_m:.0f}/m" in recording.unit_text


def test_a_camera_with_millimetres_is_believed_within_its_reach_only(tmp_path: Path) -> None:
    assert opened(tmp_path / "near", np.full((576, 640), 1700), lens=LENS).warnings == ()
    (warning,) = opened(tmp_path / "far", np.full((576, 640), 3200), lens=LENS).warnings
    assert "3.2 m" in warning
    assert "--unit 4000/m (0.8 m)" in warning
    with pytest.raises(UserError, match="--unit 4000/m"):
        opened(tmp_path / "beyond", np.full((576, 640), 5200), lens=LENS)


@pytest.mark.parametrize(
    ("key", "value", "unit_mm"),
    (
        ("depth_scale", 0.00025, 0.25),
        ("depth_units", "0.25 mm", 0.25),
        ("depth_scale", 4000.0, 0.25),
        ("DepthMapFactor", 5000.0, 0.2),
        ("depth_scale", 0.1, 0.1),
        ("depth_unit", "millimeters", 1.0),
    ),
)
def test_a_file_beside_the_pictures_states_the_unit(
    tmp_path: Path,
    key: str,
    value: object,
    unit_mm: float,
) -> None:
    path = tmp_path / "c"
    path.mkdir()
    (path / "metadata.json").write_text(json.dumps({"serial": "f1", key: value}))
    recording = opened(path, noisy(0.9, unit_mm / 1e3))
    assert recording.unit_text == f"depth unit {unit_mm:g} mm, from metadata.json"
    assert not recording.warnings
    assert np.nanmedian(next(recording.frames()).z_m) == pytest.approx(0.9, rel=0.02)


def test_inches_are_asked_for_and_read(tmp_path: Path) -> None:
    path = tmp_path / "d.npy"
    np.save(path, noisy(1.1, 1e-5) / 2540)
    with pytest.raises(UserError, match=r"--unit in \(1\.1 m\)"):
        open_capture([path], lens=plane.LENS)
    z_m = next(open_capture([path], lens=plane.LENS, unit="in").frames()).z_m
    assert np.nanmedian(z_m) == pytest.approx(1.1, rel=0.02)


def test_lengths_along_the_rays_are_told_from_z(tmp_path: Path) -> None:
    slopes = plane.slopes()
    noise_m = np.random.default_rng(2).normal(0, 1e-4, (72, 96))
    z_m = 0.7 + noise_m + 0.1 * slopes[..., 0]
    rays = np.dstack([slopes, np.ones_like(z_m)])
    range_m = z_m * np.linalg.norm(rays, axis=-1)
    for name, stored, doubts in (("z", z_m, 0), ("range", range_m, 1)):
        np.save(tmp_path / f"{name}.npy", stored)
        warnings = open_capture([tmp_path / f"{name}.npy"], lens=plane.LENS).warnings
        assert sum("lengths along the rays" in text for text in warnings) == doubts


def test_a_repeated_frame_is_told(tmp_path: Path) -> None:
    path = tmp_path / "d.npy"
    np.save(
        path,
        np.stack([noisy(0.7, 1e-3, seed) for seed in (1, 1, 2)]).astype(np.uint16),
    )
    assert "first two frames are equal" in open_capture([path], lens=plane.LENS).warnings[0]


# ---- named cameras and lenses of other sizes


@pytest.mark.parametrize(
    ("name", "size", "mode", "unit_mm"),
    (
        ("azure_kinect_nfov", (640, 576), "azure_kinect_nfov", 1.0),
        ("azure_kinect_nfov", (512, 512), "azure_kinect_wfov_binned", 1.0),
        ("azure_kinect_wfov_binned", (512, 512), "azure_kinect_wfov_binned", 1.0),
        ("realsense_l515", (640, 480), "realsense_l515_vga", 0.25),
    ),
)
def test_a_named_camera_knows_its_modes_and_its_unit(
    tmp_path: Path,
    name: str,
    size: tuple[int, int],
    mode: str,
    unit_mm: float,
) -> None:
    recording = opened(
        tmp_path / "c", np.full(size[::-1], round(900 / unit_mm)), lens=lens_named(name)
    )
    assert recording.unit_text == f"depth unit {unit_mm:g} mm, from the camera of {mode}"
    assert f"the lens is the nominal one of {mode}" in recording.notes
    assert type(recording.lens) is Lens
    assert (recording.lens.width, recording.lens.height) == size


def test_a_size_that_no_mode_of_the_camera_has_is_told_with_those_that_exist(
    tmp_path: Path,
) -> None:
    with pytest.raises(UserError, match="1280 x 720") as caught:
        opened(
            tmp_path / "c", np.full((720, 1280), 900), lens=lens_named("azure_kinect_wfov_binned")
        )
    assert "azure_kinect_nfov_binned 320 x 288" in str(caught.value)
    assert "aligned" in str(caught.value)


def test_modes_look_along_the_directions_of_the_factory_calibration() -> None:
    """A pixel of a binned mode covers four of the sensor, whose directions surround its own."""
    assert set(lens_names()) >= {
        "azure_kinect_nfov_binned",
        "azure_kinect_wfov_unbinned",
        "realsense_l515_vga",
    }
    wide = lens_named("azure_kinect_wfov_unbinned")
    binned = lens_named("azure_kinect_wfov_binned")
    np.testing.assert_allclose(binned.slopes(100, 200), wide.slopes(200.5, 400.5), atol=1e-6)
    narrow = lens_named("azure_kinect_nfov")
    small = lens_named("azure_kinect_nfov_binned")
    np.testing.assert_allclose(narrow.slopes(8, 20), wide.slopes(200, 200), atol=1e-6)
    np.testing.assert_allclose(small.slopes(8, 20), narrow.slopes(16.5, 40.5), atol=1e-6)


def test_a_lens_of_larger_images_of_the_same_shape_is_scaled_and_said(tmp_path: Path) -> None:
    text = {"width": 192, "height": 144, "fx": 300.0, "fy": 302.0, "cx": 94.5, "cy": 72.5}
    path = tmp_path / "c"
    path.mkdir()
    (path / "intrinsic.json").write_text(json.dumps(text))
    recording = opened(path, noisy(0.7, 1e-3), lens=None)
    assert recording.lens == plane.LENS
    assert "scaled to 96 x 72" in recording.warnings[0]


# ---- images that are not the camera's own


def test_a_lens_whose_middle_lies_at_the_rim_of_the_images_is_doubted(tmp_path: Path) -> None:
    half = {
        "fx": plane.LENS.fx / 2,
        "fy": plane.LENS.fy / 2,
        "cx": plane.LENS.cx / 2,
        "cy": plane.LENS.cy / 2,
    }
    for lens, is_doubted in (
        (half, True),
        ({**half, "cx": plane.LENS.cx, "cy": plane.LENS.cy}, False),
    ):
        (tmp_path / "lens.json").write_text(json.dumps(lens))
        np.save(tmp_path / "d.npy", plane.depth_mm())
        warnings = open_capture([tmp_path / "d.npy"], intrinsics=tmp_path / "lens.json").warnings
        assert any("principal point" in warning for warning in warnings) == is_doubted


@pytest.mark.parametrize(
    ("side", "finer", "least", "largest"),
    ((1, 1, 1, 1), (5, 1, 5, 5), (5, 2, 9, 11), (3, 3, 8, 10)),
)
def test_the_reach_of_noise_is_the_filter_times_the_upsampling(
    side: int,
    finer: int,
    least: int,
    largest: int,
) -> None:
    rng = np.random.default_rng(3)
    frames = []
    for number in range(3):
        noise = cv2.blur(rng.normal(0, 1e-3 * side, (240, 240)), (side, side))
        z_m = cv2.resize(
            0.7 + noise, None, fx=finer, fy=finer, interpolation=cv2.INTER_LINEAR
        ).astype(np.float32)
        frames.append(Frame(str(number), z_m, np.zeros(z_m.shape, np.uint8)))
    assert least <= noise_reach_px(frames, 0.0) <= largest
    assert noise_reach_px([frames[0], frames[0]], 0.0) == 0.0


@pytest.mark.parametrize("side", (1, 3, 5))
def test_six_frames_of_a_small_target_show_the_reach_of_their_noise_and_two_do_not(
    side: int,
) -> None:
    """Five pairs of 1,600 pixels show as much as one of 8,000; 5,000 are needed."""
    rng = np.random.default_rng(4)
    frames = []
    for number in range(6):
        z_m = np.full((100, 100), np.nan, np.float32)
        noise_m = cv2.blur(rng.normal(0, 1e-3 * side, (60, 60)), (side, side))
        z_m[30:70, 30:70] = 0.7 + noise_m[10:50, 10:50]
        frames.append(Frame(str(number), z_m, np.zeros(z_m.shape, np.uint8)))
    assert noise_reach_px(frames, 0.0) == side
    assert noise_reach_px(frames[:2], 0.0) == 0.0


@pytest.mark.parametrize("slope_m", (2e-4, 1.5e-3))
@pytest.mark.parametrize(("side", "reach_px"), ((1, 1), (3, 3), (5, 5), (12, 8)))
def test_a_lone_frame_shows_the_reach_of_its_noise_beside_edges(side, reach_px, slope_m) -> None:
    """The noise of 1 mm is unknown where rounding hides it. A tilted board's edges do not lengthen
    it, and the local mean shortens noise that is wide."""
    v, u = np.mgrid[:240, :320]
    z_m = (
        0.7
        + slope_m * u
        + cv2.blur(np.random.default_rng(3).normal(0, 1e-3 * side, u.shape), (side, side))
    )
    z_m[:, :70] += 0.5  # a wall behind the board
    z_m[(v - 120) ** 2 + (u - 200) ** 2 < 15**2] += 0.02
    frame = Frame("0", z_m.astype(np.float32), np.zeros(u.shape, np.uint8))
    assert noise_reach_px([frame], 0.0) == reach_px
    assert noise_reach_px([rounded(frame, 1e-3)], 1e-3) == pytest.approx(reach_px, abs=1)
    assert noise_reach_px([rounded(frame, 50e-3)], 50e-3) == 0.0


def rounded(frame: Frame, step_m: float) -> Frame:
    return replace(frame, z_m=(np.round(frame.z_m / step_m) * step_m).astype(np.float32))


@pytest.mark.skipif(not DATA.is_dir(), reason="needs the real captures")
def test_real_depth_that_was_aligned_to_colour_is_told_from_the_cameras_own() -> None:
    aligned = list(islice(open_capture([DATA / "azure_drilled_board"]).frames(), 6))
    native = list(islice(open_capture(walls(), lens=lens_named("azure_kinect_nfov")).frames(), 6))
    assert noise_reach_px(native, 1e-3) == 5.0  # the depth engine's filter
    assert (
        noise_reach_px(aligned, 1e-3) > 7.0
    )  # 5 pixels of 252 px focal length in an image of 601 px
    for frame in aligned:
        assert noise_reach_px([frame], 1e-3) == 8.0
    for frame in native:
        assert noise_reach_px([frame], 1e-3) == 5.0


def walls() -> list[Path]:
    return sorted((DATA / "azure_nfov_walls").glob("[0-9]*.png"))


def test_a_missing_colour_picture_is_said(tmp_path: Path) -> None:
    folder = plane.write_open3d_folder(tmp_path / "o", 4)
    (folder / "color" / "00003.png").unlink()
    assert (
        "4 depth and 3 colour pictures: 1 depth pictures have no colour"
        in open_capture([folder]).notes
    )


# ---- how often the unit is right


def test_units_of_many_scenes_are_right_or_asked_for() -> None:
    """Targets at 0.3 to 1.5 m over a tenth to all of the view, up to 2 m before walls."""
    counts = {unit_mm: verdicts(unit_mm) for unit_mm in (1.0, 0.25, 0.2, 0.1, 10.0)}
    assert (
        counts[1.0]["asked"] <= 2 and counts[1.0]["wrong"] == counts[1.0]["silently wrong"] == 0
    ), counts
    for unit_mm in (0.25, 0.2, 0.1, 10.0):
        assert counts[unit_mm]["silently wrong"] <= 0.05 * 200, counts


def verdicts(unit_mm: float, scenes: int = 200) -> Counter[str]:
    rng = np.random.default_rng(11)
    counts = Counter[str]()
    for _ in range(scenes):
        near_m = rng.uniform(0.3, 1.5)
        share = rng.uniform(0.1, 1.0)
        behind_m = rng.uniform(0.2, 2.0)
        z_m = np.where(np.arange(2000) < 2000 * share, near_m, near_m + behind_m) + rng.normal(
            0, 2e-3, 2000
        )
        stored = np.rint(z_m * 1e3 / unit_mm)
        # 1024 x 768 is the L515's alone, which stores 0.25 mm
        size = rng.choice(
            [(640, 576), (640, 480), (512, 512), (1280, 720), (1024, 768)][
                : 4 if unit_mm == 1 else 5
            ]
        )
        try:
            unit = decided_unit("x", stored, 1e-3, (int(size[0]), int(size[1])))
        except UserError:
            counts["asked"] += 1
            continue
        right = unit.scale_m == pytest.approx(unit_mm * 1e-3)
        counts[("" if unit.warning else "silently ") + ("right" if right else "wrong")] += 1
    return counts
