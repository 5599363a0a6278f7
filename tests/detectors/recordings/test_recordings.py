"""Every format gives the same points, colours and reasons; lenses from every kind of file."""

from __future__ import annotations

import csv
import json
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from hypothesis import example, given, settings
from hypothesis import strategies as st

from detectors.recordings import Recording, open_capture
from detectors.recordings.distances import frame_of, metres_per_unit, rounding_step_m
from detectors.recordings.intrinsics import read_lens
from harness import detect
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens, Reason
from tests.support import recorded_plane as plane

STORED = plane.depth_mm()
TRUE_M = plane.points_m(STORED)


def points_of(recording: Recording, frame: Frame) -> np.ndarray:
    """(h, w, 3), as averaging makes them."""
    if frame.xy_m is not None:
        return np.concatenate([frame.xy_m, frame.z_m[..., None]], axis=-1)
    assert recording.slopes is not None
    z = frame.z_m.astype(float)[..., None]
    return np.concatenate([recording.slopes * z, z], axis=-1)


def open3d(tmp: Path) -> Recording:
    return open_capture([plane.write_open3d_folder(tmp / "o3d", 1)])


def tum(tmp: Path) -> Recording:
    for name in ("depth", "rgb"):
        (tmp / name).mkdir()
    cv2.imwrite(str(tmp / "depth" / "1305031102.160407.png"), STORED * 5)
    path = tmp / "rgb"
    cv2.imwrite(str(path / "1305031102.175304.png"), plane.rgb()[..., ::-1])
    cv2.imwrite(str(path / "1305031102.211214.png"), plane.rgb(9)[..., ::-1])
    (tmp / "depth.txt").write_text("# timestamp filename\n")
    return open_capture([tmp], intrinsics=plane.write_lens(tmp / "freiburg.json"))


def sdk_names(tmp: Path) -> Recording:
    cv2.imwrite(str(tmp / "depth_0001.png"), STORED)
    cv2.imwrite(str(tmp / "color_0001.png"), plane.rgb()[..., ::-1])
    cv2.imwrite(str(tmp / "ir_0001.png"), STORED)
    plane.write_lens(tmp / "camera.json")
    return open_capture([tmp])


def file_list(tmp: Path) -> Recording:
    path = tmp / "a.png"
    cv2.imwrite(str(path), STORED)
    return open_capture([path], lens=plane.LENS)


def npy_depth(tmp: Path) -> Recording:
    path = tmp / "d.npy"
    np.save(path, STORED[None])
    return open_capture([path], lens=plane.LENS)


def npz_metres(tmp: Path) -> Recording:
    path = tmp / "d.npz"
    np.savez(path, depth=(STORED / 1e3).astype(np.float32), rgb=plane.rgb())
    return open_capture([path], lens=plane.LENS)


def npy_as_networks_take_it(tmp: Path) -> Recording:
    path = tmp / "d.npy"
    np.save(path, np.stack([STORED] * 2)[:, None])
    return open_capture([path], lens=plane.LENS)


def npz_with_its_matrix_and_times(tmp: Path) -> Recording:
    path = tmp / "d.npz"
    np.savez(path, K=plane.LENS.matrix, depth_image=STORED, stamps=np.arange(3.0))
    return open_capture([path], lens=plane.LENS)


def npy_points(tmp: Path) -> Recording:
    path = tmp / "p.npy"
    np.save(path, TRUE_M)
    return open_capture([path])


def mat_grid(tmp: Path) -> Recording:
    path = tmp / "c.mat"
    scipy.io.savemat(path, {"Location": TRUE_M, "Color": plane.rgb(), "note": "plate"})
    return open_capture([path])


def mat_frames_last(tmp: Path) -> Recording:
    path = tmp / "c.mat"
    scipy.io.savemat(path, {"Location": np.stack([TRUE_M] * 5, axis=-1)})
    return open_capture([path])


def mat_lists_on_a_lens(tmp: Path) -> Recording:
    path = tmp / "c.mat"
    scipy.io.savemat(path, {"Location": np.stack([TRUE_M.reshape(-1, 3)] * 2)})
    return open_capture([path], lens=plane.LENS)


def pcd(tmp: Path) -> Recording:
    return open_capture([plane.write_pcd(tmp / "c.pcd", TRUE_M)])


def ply(tmp: Path) -> Recording:
    return open_capture([plane.write_ply(tmp / "c.ply", TRUE_M)])


def xyz_with_a_stated_grid(tmp: Path) -> Recording:
    return open_capture(
        [plane.write_points(tmp / "c.xyz", TRUE_M, head="# width: 96 height: 72\n")]
    )


def csv_with_names_and_commas(tmp: Path) -> Recording:
    head = "\N{BYTE ORDER MARK}intensity;X (m);Y (m);Z (m)\n"
    return open_capture(
        [plane.write_points(tmp / "c.csv", TRUE_M, head, ";", decimal=",", before="7")],
        lens=plane.LENS,
    )


def raw_numbers(tmp: Path) -> Recording:
    path = tmp / "d.bin"
    path.write_bytes(b"head" + STORED.astype(">u2").tobytes() * 2)
    return open_capture([path], lens=plane.LENS, raw="96x72:>u2:4")


def chosen_array(tmp: Path) -> Recording:
    path = tmp / "d.npz"
    np.savez(path, first=STORED * 0 + 9, second=np.stack([STORED * 0, STORED]))
    return open_capture([path], lens=plane.LENS, array="second:1")


def stray_scanner(tmp: Path) -> Recording:
    return open_capture([plane.write_stray(tmp / "stray", 1)])


FORMATS = (
    open3d,
    tum,
    sdk_names,
    file_list,
    npy_depth,
    npy_as_networks_take_it,
    npz_metres,
    npz_with_its_matrix_and_times,
    npy_points,
    mat_grid,
    mat_frames_last,
    mat_lists_on_a_lens,
    pcd,
    ply,
    xyz_with_a_stated_grid,
    csv_with_names_and_commas,
    raw_numbers,
    chosen_array,
    stray_scanner,
)


@pytest.mark.parametrize("opened", FORMATS, ids=lambda f: f.__name__)
def test_every_format_gives_the_points_that_were_written(
    opened: Callable[[Path], Recording],
    tmp_path: Path,
) -> None:
    recording = opened(tmp_path)
    frame = next(recording.frames())
    assert recording.organised
    assert recording.region.shape == (72, 96)
    np.testing.assert_allclose(points_of(recording, frame), TRUE_M, atol=1e-6)
    expected = np.zeros((72, 96), np.uint8)
    stores_zero = frame.reason[plane.NO_RETURN] == Reason.NO_RETURN
    expected[plane.NO_RETURN] = Reason.NO_RETURN if stores_zero else Reason.NOT_FINITE
    np.testing.assert_array_equal(frame.reason, expected)
    assert recording.z_step_m == pytest.approx(1e-3, rel=1e-12)
    assert all(path.is_file() for path in recording.files)


@pytest.mark.parametrize(
    "opened", (open3d, tum, sdk_names, npz_metres, mat_grid), ids=lambda f: f.__name__
)
def test_colour_lies_on_the_depth_pixels(
    opened: Callable[[Path], Recording],
    tmp_path: Path,
) -> None:
    np.testing.assert_array_equal(next(opened(tmp_path).frames()).rgb, plane.rgb())


@pytest.mark.parametrize(
    ("write", "suffix"),
    ((plane.write_ply, "ply"), (plane.write_pcd, "pcd"), (plane.write_packed_pcd, "pcd")),
)
def test_a_cloud_keeps_colour_and_may_lack_a_grid(
    write: Callable[..., Path],
    suffix: str,
    tmp_path: Path,
) -> None:
    points_m = np.random.default_rng(1).permutation(TRUE_M.reshape(-1, 3)).reshape(TRUE_M.shape)
    recording = open_capture([write(tmp_path / f"c.{suffix}", points_m, False)])
    frame = next(recording.frames())
    assert not recording.organised
    assert recording.region.shape == (1, 72 * 96)
    np.testing.assert_allclose(points_of(recording, frame)[0], points_m.reshape(-1, 3), atol=1e-6)
    assert frame.rgb is not None
    assert (frame.rgb == (16, 32, 48)).all()


def test_a_packed_cloud_has_the_grid_of_a_plain_one(tmp_path: Path) -> None:
    plain = open_capture([plane.write_pcd(tmp_path / "plain.pcd", TRUE_M)])
    packed = open_capture([plane.write_packed_pcd(tmp_path / "packed.pcd", TRUE_M)])
    plain_frame = next(plain.frames())
    packed_frame = next(packed.frames())
    assert packed.organised
    assert packed.lens == plain.lens
    np.testing.assert_array_equal(packed_frame.z_m, plain_frame.z_m)
    np.testing.assert_array_equal(packed_frame.rgb, plain_frame.rgb)


def test_lists_of_points_without_a_lens_have_no_grid(tmp_path: Path) -> None:
    path = tmp_path / "c.mat"
    scipy.io.savemat(path, {"Location": np.stack([TRUE_M.reshape(-1, 3)] * 2)})
    recording = open_capture([path])
    assert not recording.organised
    assert len(list(recording.frames())) == 2


def test_frames_stream_in_the_order_of_their_numbers_and_start_again(tmp_path: Path) -> None:
    for i in (2, 10, 9):
        cv2.imwrite(str(tmp_path / f"{i}.png"), plane.depth_mm() + i)
    cv2.imwrite(str(tmp_path / "wall_mask.png"), np.full((72, 96), 255, np.uint8))
    (tmp_path / "._9.png").write_bytes(b"\0\5\x16\7")  # beside each file that a Mac copied
    recording = open_capture([tmp_path], lens=plane.LENS)
    names = [frame.name.split("/")[1] for frame in recording.frames()]
    assert names == ["2.png", "9.png", "10.png"]
    assert [frame.name.split("/")[1] for frame in recording.frames()] == names
    assert len(list(open_capture([tmp_path], lens=plane.LENS, frames=slice(2)).frames())) == 2
    (tmp_path / "10.png").unlink()  # an iterator that has not come to it has not read it
    streaming = recording.frames()
    assert [next(streaming).name, next(streaming).name] == [
        f"{tmp_path.name}/2.png",
        f"{tmp_path.name}/9.png",
    ]


def test_a_recording_can_be_sent_to_another_process(tmp_path: Path) -> None:
    recording = pickle.loads(pickle.dumps(open3d(tmp_path)))
    np.testing.assert_allclose(points_of(recording, next(recording.frames())), TRUE_M, atol=1e-6)


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        # from 0 to 1
        ([0.0, 0.5, 1.0], [0, 128, 255]),
        # from 0 to 255, with what lies beyond and what is unknown
        ([-3.0, 127.6, 300.0], [0, 128, 255]),
        ([np.nan, 1.0, 255.0], [0, 1, 255]),
    ],
)
def test_colours_that_are_no_whole_numbers_become_bytes(
    tmp_path: Path, levels: list[float], expected: list[int]
) -> None:
    path = tmp_path / "c.npz"
    rgb = np.broadcast_to(levels, (72, 96, 3)).astype(np.float32)
    np.savez(path, depth=(STORED / 1e3).astype(np.float32), rgb=rgb)
    seen = next(open_capture([path], lens=plane.LENS).frames()).rgb
    assert seen is not None
    assert seen.dtype == np.uint8
    assert (seen == expected).all()


def test_colour_that_belongs_to_no_depth_picture_is_said(tmp_path: Path) -> None:
    folder = plane.write_open3d_folder(tmp_path / "plane", 2)
    pictures = sorted((folder / "color").iterdir())
    assert next(open_capture([folder]).frames()).rgb is not None
    for number, path in enumerate(pictures):
        path.rename(path.with_stem(str(100 + number)))
    recording = open_capture([folder])
    message = f"{len(pictures)} colour pictures: 2 depth pictures have no colour"
    assert any(message in note for note in recording.notes)
    assert next(recording.frames()).rgb is None


def test_colour_of_another_size_is_left_out_and_said(tmp_path: Path) -> None:
    folder = plane.write_open3d_folder(tmp_path / "o", 1)
    cv2.imwrite(str(folder / "color" / "00000.png"), np.zeros((10, 10, 3), np.uint8))
    recording = open_capture([folder])
    assert next(recording.frames()).rgb is None
    assert any("10 x 10" in note for note in recording.notes)


def test_a_cloud_behind_or_beside_the_lens_keeps_a_reason() -> None:
    stored = np.array(
        [[[0.0, 0, 1], [0, 0, 0], [np.inf, 0, 1], [0, 0, np.nan], [0, 0, -1], [0, 0, 2]]]
    )
    frame = frame_of("a", stored, 1.0)
    valid = Reason.VALID
    none = Reason.NO_RETURN
    odd = Reason.NOT_FINITE
    out = Reason.OUT_OF_RANGE
    assert frame.reason.tolist() == [[valid, none, odd, odd, out, valid]]
    np.testing.assert_array_equal(np.isfinite(frame.z_m), frame.reason == Reason.VALID)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(("mm", "m", "cm", "um", "tum", "4000/m")), st.floats(0.06, 19.0))
def test_a_unit_turns_stored_numbers_into_metres_and_back(unit: str, distance_m: float) -> None:
    stored = np.full((2, 2, 3), distance_m / metres_per_unit(unit))
    assert frame_of("a", stored, metres_per_unit(unit)).z_m[0, 0] == pytest.approx(
        distance_m, rel=1e-6
    )


@settings(max_examples=30, deadline=None)
@given(st.sampled_from((1e-3, 2.5e-4, 2e-4, 1e-4)), st.integers(0, 1000))
def test_the_rounding_step_is_found_in_floating_point_metres(step_m: float, seed: int) -> None:
    turns = np.random.default_rng(seed).integers(800, 19_000, 500)
    assert rounding_step_m((turns * step_m).astype(np.float32)) >= step_m * (1 - 1e-12)
    free = np.random.default_rng(seed).uniform(0.5, 2.0, 500).astype(np.float32)
    assert rounding_step_m(free) == 0.0


# ---- lenses

DISTORTION = (0.1, -0.2, 0.001, -0.002, 0.03, 0.4, 0.05, 0.006)


def plain_json(lens: Lens) -> str:
    k = {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy}
    return json.dumps({**k, "distortion": list(lens.distortion)})


def named_json(lens: Lens) -> str:
    k = {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy}
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    return json.dumps({**k, "distortion": dict(zip(names, lens.distortion, strict=True))})


def opencv_yaml(lens: Lens) -> str:
    def matrix(rows: int, columns: int, values: list[float]) -> str:
        head = f" !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
        return head + f"   data: [ {', '.join(map(repr, values))} ]\n"

    k = lens.matrix.ravel().tolist()
    d = list(lens.distortion)
    size = f"image_width: {lens.width}\nimage_height: {lens.height}\n"
    matrices = f"camera_matrix:{matrix(3, 3, k)}distortion_coefficients:{matrix(1, 8, d)}"
    return f"%YAML:1.0\n---\n{size}{matrices}"


def ros_yaml(lens: Lens) -> str:
    k = lens.matrix.ravel().tolist()
    d = list(lens.distortion)
    size = f"image_width: {lens.width}\nimage_height: {lens.height}\n"
    return (
        f"{size}camera_name: depth\ndistortion_model: rational_polynomial\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {k}\n"
        f"distortion_coefficients:\n  data: {d}\n"
    )


def ros_message(lens: Lens) -> str:
    k = lens.matrix.ravel().tolist()
    d = list(lens.distortion)
    return (
        f"height: {lens.height}\nwidth: {lens.width}\n"
        f"distortion_model: rational_polynomial\nD: {d}\nK: {k}\n"
    )


@settings(max_examples=15, deadline=None)
@example(plain_json, 300.0, 300.0, 200.0, 255.7725737968265)  # a sum with 0.5 rounds
@given(
    st.sampled_from((plain_json, named_json, opencv_yaml, ros_yaml, ros_message)),
    st.floats(300, 900),
    st.floats(300, 900),
    st.floats(200, 400),
    st.floats(200, 400),
)
def test_every_kind_of_lens_file_gives_the_same_lens(
    tmp_path_factory: pytest.TempPathFactory,
    written: Callable[[Lens], str],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> None:
    lens = Lens(640, 576, fx, fy, cx, cy, DISTORTION)
    path = tmp_path_factory.mktemp("lens") / "camera.txt"
    path.write_text(written(lens))
    assert read_lens(path, 640, 576) == lens


@pytest.mark.parametrize(
    ("text", "distortion"),
    (
        ("500 0 300\n0 510 200\n0 0 1\n", (0.0,) * 8),
        ("500 0 300 0\n0 510 200 0\n0 0 1 0\n0 0 0 1 # of a scan\n", (0.0,) * 8),
        ("[[500.0, 0, 300], [0, 510, 200], [0, 0, 1]]", (0.0,) * 8),
        ("500 510 300 200", (0.0,) * 8),
        ('{"intrinsic_matrix": [500, 0, 300, 0, 510, 200, 0, 0, 1]}', (0.0,) * 8),
        ('{"K": [500, 0, 0, 0, 510, 0, 300, 200, 1]}', (0.0,) * 8),
        (
            '{"width": 640, "height": 576, "ppx": 300, "ppy": 200, "fx": 500, "fy": 510,'
            ' "coeffs": [0, 0, 0, 0, 0], "model": "distortion.inverse_brown_conrady"}',
            (0.0,) * 8,
        ),
        (
            '{"fl_x": 500, "fl_y": 510, "cx": 300, "cy": 200, "w": 640, "h": 576,'
            ' "k1": 0.1, "k2": 0.2, "p1": 0.01, "p2": 0.02,'
            ' "camera_model": "OPENCV", "frames": []}',
            (0.1, 0.2, 0.01, 0.02, 0, 0, 0, 0),
        ),
        (
            '{"0": {"cam_K": [500, 0, 300, 0, 510, 200, 0, 0, 1], "depth_scale": 0.1},'
            ' "1": {"cam_K": [500, 0, 300, 0, 510, 200, 0, 0, 1], "depth_scale": 0.1}}',
            (0.0,) * 8,
        ),
        (
            '{"color": {"fx": 900, "fy": 900, "cx": 640, "cy": 360},'
            ' "depth": {"fx": 500, "fy": 510, "cx": 300, "cy": 200}}',
            (0.0,) * 8,
        ),
    ),
)
def test_lenses_as_other_programs_write_them(
    tmp_path: Path,
    text: str,
    distortion: tuple[float, ...],
) -> None:
    path = tmp_path / "lens.txt"
    path.write_text(text)
    assert read_lens(path, 640, 576) == Lens(640, 576, 500, 510, 300, 200, distortion)


def test_pictures_beside_clouds_are_told(tmp_path: Path) -> None:
    plane.write_pcd(tmp_path / "c.pcd", plane.points_m(plane.depth_mm()))
    cv2.imwrite(str(tmp_path / "1.png"), plane.depth_mm())
    assert (
        "1 pictures or arrays beside the .pcd files are ignored" in open_capture([tmp_path]).notes
    )


@pytest.mark.parametrize("suffix", (".npy", ".tiff", ".pfm"))
def test_a_folder_of_arrays_is_one_capture(tmp_path: Path, suffix: str) -> None:
    """Frames in the order of their numbers; infrared pictures beside them are left out."""
    (tmp_path / "depth").mkdir()
    (tmp_path / "K.txt").write_text(
        "\n".join(" ".join(map(str, row)) for row in plane.LENS.matrix.tolist())
    )
    frames = [plane.depth_mm(n, noise_mm=0.6).astype(np.float32) for n in range(11)]
    for name, stored in [
        *((f"f{n}", frames[n]) for n in (10, 9, 2)),
        ("ir_1", np.ones_like(frames[0])),
    ]:
        path = tmp_path / "depth" / f"{name}{suffix}"
        np.save(path, stored) if suffix == ".npy" else cv2.imwrite(str(path), stored)
    recording = open_capture([tmp_path], unit="mm")
    for frame, number in zip(recording.frames(), (2, 9, 10), strict=True):
        assert np.allclose(1e3 * np.nan_to_num(frame.z_m), frames[number], atol=1e-3)
    assert recording.lens == plane.LENS
    assert len(recording.files) == 4


def test_pages_of_a_tiff_are_frames_and_three_channels_are_points(tmp_path: Path) -> None:
    frames = [plane.depth_mm(n, noise_mm=0.6) for n in range(2)]
    cv2.imwritemulti(str(tmp_path / "two.tiff"), frames)
    assert len(list(open_capture([tmp_path / "two.tiff"], lens=plane.LENS).frames())) == 2
    points = plane.points_m(frames[0]).astype(np.float32)
    cv2.imwrite(str(tmp_path / "xyz.tiff"), np.ascontiguousarray(points[..., ::-1]))
    frame = next(open_capture([tmp_path / "xyz.tiff"]).frames())
    assert np.allclose(frame.xy_m, points[..., :2], equal_nan=True)
    cv2.imwrite(str(tmp_path / "rgb.tiff"), np.zeros((72, 96, 3), np.uint16))
    for name in ("rgb.tiff", "cut.tiff"):
        (tmp_path / "cut.tiff").write_bytes((tmp_path / "two.tiff").read_bytes()[:900])
        with pytest.raises(UserError, match=r"a picture|damaged"):
            open_capture([tmp_path / name], lens=plane.LENS)


def test_frames_along_the_last_axis(tmp_path: Path) -> None:
    """As MATLAB stacks them; three planes are told from x, y and z by their content."""
    frames = np.stack([plane.depth_mm(n, noise_mm=0.6) for n in range(3)])
    for name, stack in (("three", frames), ("two", frames[:2]), ("one", frames[:1])):
        np.save(tmp_path / f"{name}.npy", np.moveaxis(stack, 0, -1))
        recording = open_capture([tmp_path / f"{name}.npy"], lens=plane.LENS)
        assert recording.shape == frames.shape[1:]
        assert any("last axis" in note for note in recording.notes)
        for frame, stored in zip(recording.frames(), stack, strict=True):
            assert np.allclose(
                frame.z_m, np.where(stored > 0, stored / 1e3, np.nan), equal_nan=True
            )
    path = tmp_path / "points.npy"
    np.save(path, plane.points_m(frames[0]))
    assert next(open_capture([path]).frames()).xy_m is not None


def test_open3d_keeps_its_matrix_column_by_column(tmp_path: Path) -> None:
    folder = plane.write_open3d_folder(tmp_path / "o", 1)
    assert read_lens(folder / "intrinsic.json", 96, 72) == plane.LENS


# ---- real captures


def test_the_drilled_plate_opens_as_it_stands(shared_data: Path) -> None:
    recording = open_capture([shared_data / "azure_drilled_board"])
    frames = [
        (float(np.nanmedian(frame.z_m)), frame.rgb is not None) for frame in recording.frames()
    ]
    medians = np.array([median for median, _ in frames])
    assert len(frames) == 18
    assert recording.region.shape == (720, 1280)
    # Frame 3 of this capture stands 18 mm behind all others.
    np.testing.assert_allclose(np.delete(medians, 3), 0.254, atol=1e-6)
    assert medians[3] == pytest.approx(0.272)
    assert frames[0][1]
    assert not any(coloured for _, coloured in frames[1:])


def test_the_walls_need_a_lens_and_leave_their_mask_out(shared_data: Path) -> None:
    recording = open_capture(
        [shared_data / "azure_nfov_walls"], lens=Lens(640, 576, 504.0, 504.0, 332.0, 326.0)
    )
    assert len(list(recording.frames())) == 22
    assert not any("mask" in path.name for path in recording.files)


def test_pixels_without_a_ray_are_outside_the_mask(tmp_path: Path) -> None:
    """With k1 = -0.5 the distorted radius r - r^3 / 2 never exceeds 0.544: pixels beyond see
    nothing."""
    path = tmp_path / "d.npy"
    np.save(path, np.full((101, 101), 1000, np.uint16))
    lens = Lens(101, 101, 60.0, 60.0, 50.0, 50.0, (-0.5, *[0.0] * 7))
    recording = open_capture([path], lens=lens)
    frame = next(recording.frames())
    v, u = np.mgrid[:101, :101]
    radius = np.hypot(u - 50, v - 50) / 60.0
    assert (frame.reason[radius > 0.56] == Reason.OUTSIDE_MASK).all()
    assert (frame.reason[radius < 0.50] == Reason.VALID).all()
    np.testing.assert_array_equal(np.isnan(frame.z_m), frame.reason == Reason.OUTSIDE_MASK)


def test_exported_pictures_take_the_lens_from_the_calibration_beside_them(tmp_path: Path) -> None:
    (tmp_path / "calibration.json").write_bytes(plane.calibration().rstrip(b"\0"))
    cv2.imwrite(str(tmp_path / "depth0.png"), np.full((576, 640), 900, np.uint16))
    lens = open_capture([tmp_path]).lens
    assert lens is not None
    assert (lens.fx, lens.cx) == pytest.approx((0.49 * 1024, 0.51 * 1024 - 192.5))


# ---- lists of points


@pytest.mark.parametrize(
    ("head", "separator", "ending"),
    (
        ("", " ", ""),
        ("//X,Y,Z,R,G,B\n", ",", ",16,32,48"),
        ("x\ty\tz\tscalar\n", "\t", "\t7"),
        ("# a scan\n\n", ", ", ""),
        ("6912\n", " ", " 7 16 32 48"),
        ("", " ", " 0.5 -0.5 0.7"),
    ),
)
def test_lists_of_points_in_every_dialect(
    tmp_path: Path,
    head: str,
    separator: str,
    ending: str,
) -> None:
    points_m = np.random.default_rng(1).permutation(TRUE_M.reshape(-1, 3)).reshape(TRUE_M.shape)
    path = plane.write_points(tmp_path / "c.txt", points_m, head, separator, ending)
    recording = open_capture([path])
    frame = next(recording.frames())
    assert not recording.organised
    assert "unorganised points" in recording.notes[0]
    np.testing.assert_allclose(points_of(recording, frame)[0], points_m.reshape(-1, 3), atol=1e-6)
    assert (frame.rgb is not None) == ("16" in ending)
    assert (frame.amplitude is not None) == ("7" in ending.split("0.7")[0])
    if frame.rgb is not None:
        assert (frame.rgb == (16, 32, 48)).all()


def test_a_list_of_a_sensors_size_is_put_on_its_pixels_where_it_rises_as_they_do(
    tmp_path: Path,
) -> None:
    v, u = np.mgrid[:192, :256]
    points = np.stack([(u - 127) / 210, (v - 95) / 210, np.ones(u.shape)], axis=-1) * 0.8
    grid = open_capture([plane.write_points(tmp_path / "a.xyz", points)])
    assert grid.organised
    assert grid.region.shape == (192, 256)
    # Arena and pylon leave a cloud's grid out, or state it in a comment; their points without
    # return are 0 0 0
    points[3, 5] = 0
    bare = plane.write_ply(tmp_path / "a.ply", points, grid=False)
    recording = open_capture([bare])
    assert recording.organised
    assert next(recording.frames()).reason[3, 5] == Reason.NO_RETURN
    stated = plane.write_ply(tmp_path / "b.ply", TRUE_M, grid=False)
    stated.write_bytes(
        stated.read_bytes().replace(b"element", b"comment Width=96, Height=72\nelement", 1)
    )
    assert open_capture([stated]).region.shape == (72, 96)
    shuffled = np.random.default_rng(5).permutation(points.reshape(-1, 3)).reshape(192, 256, 3)
    assert not open_capture([plane.write_points(tmp_path / "b.xyz", shuffled)]).organised


# ---- height maps


def height_map(relief: float = 1.0) -> np.ndarray:
    """(72, 96) millimetres: a slope; a pit 3 mm deep of radius 6 pixels at column 60, row 30."""
    v, u = np.mgrid[:72, :96]
    return relief * (100 + 0.02 * u - 3.0 * (np.hypot(u - 60, v - 30) < 6))


def test_a_height_map_is_a_cloud_in_parallel_projection(tmp_path: Path) -> None:
    heights = height_map()
    heights[3, 5] = np.nan
    np.savez(tmp_path / "a.npz", height=heights, other=np.zeros((3, 3)))
    recording = open_capture([tmp_path / "a.npz"], pitch="0.5mm")
    frame = next(recording.frames())
    assert recording.projection == "parallel"
    assert recording.organised
    assert recording.scale_m == 1e-3
    assert "towards the viewer" in recording.notes[0]
    assert "relief" in recording.unit_from
    assert frame.reason[3, 5] == Reason.NO_RETURN
    assert np.isnan(frame.z_m[3, 5])
    assert frame.xy_m is not None
    np.testing.assert_allclose(frame.xy_m[0, 1] - frame.xy_m[0, 0], (0.5e-3, 0), atol=1e-12)
    # a pit lies farther from the viewer
    assert frame.z_m[30, 60] - frame.z_m[30, 70] == pytest.approx(3e-3 + 0.2e-3, abs=1e-6)
    scipy.io.savemat(tmp_path / "a.mat", {"depth": -height_map(1e-3)})
    down = open_capture([tmp_path / "a.mat"], pitch="500um")
    assert down.scale_m == 1
    assert "away from the viewer" in down.notes[0]
    np.testing.assert_allclose(next(down.frames()).z_m[30, 60], frame.z_m[30, 60], atol=1e-4)


@pytest.mark.usefixtures("unpictured")
def test_a_flat_height_map_has_no_findings_at_its_border_and_a_crater_is_one(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    v, u = np.mgrid[:150, :200]
    noise = cv2.GaussianBlur(np.random.default_rng(3).normal(size=u.shape), (0, 0), 1.0)
    flat = 100 + 0.01 * u + 0.1 * noise / noise.std()
    bowl = np.clip(1 - ((u - 120) ** 2 + (v - 60) ** 2) / 12**2, 0, None)
    np.savez(tmp_path / "flat.npz", height=flat)
    np.savez(tmp_path / "crater.npz", height=flat - 4 * bowl)
    for name, lines in (("flat", 0), ("crater", 1)):
        out = tmp_path / name
        asked = ["--pitch", "0.5mm", "--out", str(out), "--threshold", "5", "--detector", "thesis"]
        assert detect.main([str(tmp_path / f"{name}.npz"), *asked]) == 0, capsys.readouterr().err
        findings = [
            row
            for row in csv.DictReader((out / "findings.csv").open())
            if row["kind"] != "no return"
        ]
        assert len(findings) == lines
    assert findings[0]["kind"] == "hole"
    assert float(findings[0]["u_px"]) == pytest.approx(120, abs=2)


# ---- phones


def test_pixels_of_low_confidence_are_no_return_and_motion_is_warned_of(tmp_path: Path) -> None:
    folder = plane.write_stray(tmp_path / "still", 3)
    low = np.full((72, 96), 2, np.uint8)
    low[10:20, 30:40] = 0
    cv2.imwrite(str(folder / "confidence" / "000001.png"), low)
    recording = open_capture([folder])
    frames = list(recording.frames())
    assert recording.warnings == ()
    assert (frames[1].reason[low == 0] == Reason.NO_RETURN).all()
    assert np.isfinite(frames[0].z_m[10, 30])
    assert np.isfinite(frames[1].z_m[9, 30])
    moved = plane.write_stray(tmp_path / "moved", 3, step_m=0.02)
    warning = open_capture([moved]).warnings[0]
    assert "moved by 40 mm" in warning
    assert "--max-frames 1" in warning
    assert open_capture([moved], frames=slice(1)).warnings == ()


def test_record3d_keeps_its_depth_compressed(tmp_path: Path) -> None:
    pytest.importorskip("lzfse")
    recording = open_capture([plane.write_r3d(tmp_path / "a.r3d", 2)])
    frame = next(recording.frames())
    np.testing.assert_allclose(points_of(recording, frame), TRUE_M, atol=1e-6)
    (warning,) = recording.warnings
    assert "the first two frames are equal" in warning, "they have no noise"
    assert len(list(recording.frames())) == 2
    moved = open_capture([plane.write_r3d(tmp_path / "b.r3d", 2, step_m=0.05)])
    assert any("moved by 50 mm" in text for text in moved.warnings)


def test_the_raw_frame_of_a_plane(shared_data: Path) -> None:
    recording = open_capture(
        [shared_data / "vzense_plane" / "bg.bin"],
        lens=Lens(640, 480, 465.0, 465.0, 320.0, 240.0),
        raw="640x480",
    )
    assert float(np.nanmedian(next(recording.frames()).z_m)) == pytest.approx(0.918, abs=0.02)


def test_the_interleaved_frame_of_another_maker(shared_data: Path) -> None:
    path = shared_data / "adi_tof" / "frame_mode2.bin"
    lens = Lens(512, 512, 400.0, 400.0, 256.0, 256.0)
    with pytest.raises(UserError, match="512x512:u2/5"):
        open_capture([path])
    z_m = next(open_capture([path], lens=lens, raw="512x512:u2/5", unit="mm").frames()).z_m
    assert float(np.nanmedian(np.abs(np.diff(z_m)))) < 0.02
