"""What is wrong with a capture is told once: which file, what would be legal, what to do."""

from __future__ import annotations

import json
import re
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io

from detectors.open3d_library import load_open3d
from detectors.recordings import open_capture
from detectors.recordings.intrinsics import read_lens
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Reason
from tests.support import bag_of_a_plane as bags
from tests.support import recorded_plane as plane

STORED = plane.depth_mm()


def refusal(*paths: Path, **options: object) -> str:
    """The message of opening and reading a capture to its end."""
    with pytest.raises(UserError) as caught:
        list(open_capture(list(paths), **options).frames())  # type: ignore[arg-type]
    return str(caught.value)


def png(path: Path, stored: np.ndarray = STORED) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), stored)
    return path


def cut(path: Path, part: float) -> Path:
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    return path


def test_a_missing_path_is_named(tmp_path: Path) -> None:
    path = tmp_path / "nowhere"
    message = refusal(path)
    assert str(path) in message
    assert ".mkv" in message


def test_an_unknown_kind_of_file_lists_the_known_ones(tmp_path: Path) -> None:
    path = tmp_path / "scan.las"
    path.write_bytes(b"LASF")
    message = refusal(path)
    assert "'.las'" in message
    assert all(kind in message for kind in (".png", ".ply", ".npz", ".mat", ".mkv"))


def test_a_mixed_list_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, STORED)
    message = refusal(png(tmp_path / "a.png"), path, lens=plane.LENS)
    assert ".npy, .png" in message


def test_an_empty_folder_is_refused(tmp_path: Path) -> None:
    assert f"{tmp_path}: is empty" in refusal(tmp_path, lens=plane.LENS)
    (tmp_path / "depth").mkdir()
    assert "depth: is empty" in refusal(tmp_path, lens=plane.LENS)


def test_a_folder_of_captures_names_them(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    assert (
        refusal(tmp_path).splitlines()[0] == f"{tmp_path}: contains no capture; it holds notes.txt"
    )
    (tmp_path / "scan.e57").touch()
    assert "to do: export its points as PLY" in refusal(tmp_path)
    bag = bags.write_bag(tmp_path / "left", bags.clouds(1))
    second = tmp_path / "other.mkv"
    second.touch()
    path = tmp_path / "right"
    plane.write_open3d_folder(path, 1)
    message = refusal(tmp_path)
    assert f"to do: name one of {bag}, {second}, {path}" in message
    assert ".npz" in message


@pytest.mark.parametrize("part", (0.0, 0.02, 0.5, 0.98))
def test_a_truncated_picture_is_named(tmp_path: Path, part: float) -> None:
    folder = plane.write_open3d_folder(tmp_path / "c", 3)
    cut(folder / "depth" / "00001.png", part)
    message = refusal(folder)
    assert "00001.png" in message
    assert "truncated" in message


def test_a_damaged_picture_is_named(tmp_path: Path) -> None:
    path = png(tmp_path / "1.png")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    assert "1.png: is damaged" in refusal(tmp_path, lens=plane.LENS)


@pytest.mark.parametrize(
    ("stored", "picture_kind"),
    ((np.zeros((72, 96), np.uint8), "8 bits"), (np.ones((72, 96, 3), np.uint16), "RGB")),
)
def test_a_picture_that_is_no_depth_image_is_named(
    tmp_path: Path,
    stored: np.ndarray,
    picture_kind: str,
) -> None:
    png(tmp_path / "1.png")
    path = tmp_path / "2.png"
    png(path, stored)
    message = refusal(tmp_path, lens=plane.LENS)
    assert "2.png" in message
    assert picture_kind in message
    assert "16-bit" in message
    assert "2.png" in refusal(path, lens=plane.LENS)


def test_sizes_that_differ_name_both_pictures(tmp_path: Path) -> None:
    png(tmp_path / "1.png")
    png(tmp_path / "2.png", STORED[:-2])
    message = refusal(tmp_path, lens=plane.LENS)
    assert "2.png: 96 x 70" in message
    assert "first frame has 96 x 72" in message


def test_clouds_of_different_sizes_are_named(tmp_path: Path) -> None:
    points = plane.points_m(STORED)
    plane.write_pcd(tmp_path / "1.pcd", points)
    plane.write_pcd(tmp_path / "2.pcd", points[:-2])
    assert "2.pcd: 96 x 70 pixels, but the first frame has 96 x 72" in refusal(tmp_path)


def test_frames_without_one_valid_pixel_are_refused(tmp_path: Path) -> None:
    png(tmp_path / "1.png", STORED * 0)
    png(tmp_path / "2.png", STORED * 0)
    assert "no valid pixel in 2 frames" in refusal(tmp_path, lens=plane.LENS)
    path = tmp_path / "nan.npy"
    np.save(path, np.full((72, 96), np.nan))
    assert "no valid pixel in 1 frame" in refusal(path, lens=plane.LENS)


def test_one_empty_frame_among_good_ones_is_no_error(tmp_path: Path) -> None:
    png(tmp_path / "1.png", STORED * 0)
    png(tmp_path / "2.png")
    frames = list(open_capture([tmp_path], lens=plane.LENS).frames())
    assert [np.isfinite(frame.z_m).any() for frame in frames] == [False, True]


@pytest.mark.parametrize(
    ("stored", "unit", "advice"),
    (
        (STORED.astype(np.float32), "m", "--unit mm (then 0.5"),
        (STORED.astype(np.float32) / 1000, "mm", "--unit m (then 0.5"),
        (STORED, "m", "--unit mm (then 0.5"),
    ),
)
def test_a_wrong_unit_is_noticed_and_the_right_one_offered(
    tmp_path: Path,
    stored: np.ndarray,
    unit: str,
    advice: str,
) -> None:
    path = tmp_path / "d.npy"
    np.save(path, stored)
    message = refusal(path, lens=plane.LENS, unit=unit)
    assert "wrong unit" in message
    assert advice in message


def test_an_unknown_unit_is_refused(tmp_path: Path) -> None:
    assert "--unit furlong" in refusal(png(tmp_path / "1.png"), lens=plane.LENS, unit="furlong")


def test_depth_without_a_lens_says_what_to_give(tmp_path: Path) -> None:
    message = refusal(png(tmp_path / "1.png"))
    assert "lens of these depth images" in message
    assert "--intrinsics" in message
    assert "camera_info" in message


def test_a_lens_of_another_size_is_refused(tmp_path: Path) -> None:
    folder = plane.write_open3d_folder(tmp_path / "c", 1)
    (folder / "depth" / "00000.png").unlink()
    png(folder / "depth" / "00000.png", STORED[:-2])
    assert "96 x 72 pixels, but the depth images have 96 x 70" in refusal(folder)


@pytest.mark.parametrize(
    ("array", "message"),
    (
        (np.zeros((4, 5), np.uint8), "8-bit"),
        (np.zeros((4, 5), bool), "bool"),
        (np.zeros(7), "is not a capture"),
        (np.zeros((2, 2, 3, 4, 5)), "is not a capture"),
        (np.zeros((0, 4, 5)), "empty"),
        (np.zeros((7000, 4)), "array[:, :3]"),
        (np.zeros((3, 7000)), "is not a capture"),
        (np.zeros(9, [("x", "f4"), ("z", "f4")]), "plain numbers"),
    ),
)
def test_an_array_that_is_no_capture_is_refused(
    tmp_path: Path,
    array: np.ndarray,
    message: str,
) -> None:
    path = tmp_path / "a.npy"
    np.save(path, array)
    assert message in refusal(path, lens=plane.LENS)


@pytest.mark.parametrize("planes", ("x y z", "red green blue depth", "depth confidence"))
@pytest.mark.parametrize("axis", (0, -1))
def test_planes_that_are_no_frames_of_one_scene_are_refused(
    tmp_path: Path,
    planes: str,
    axis: int,
) -> None:
    x, y, z = np.moveaxis(np.nan_to_num(plane.points_m(STORED)), -1, 0)
    red, green, blue = np.random.default_rng(3).random((3, *z.shape))
    values = {
        "x": x,
        "y": y,
        "z": z,
        "red": red,
        "green": green,
        "blue": blue,
        "depth": z,
        "confidence": 0.1 + 0 * z,
    }
    names = planes.split()
    number = names.index("z" if "z" in names else "depth")
    path = tmp_path / "a.npy"
    np.save(path, np.stack([values[name] for name in names], axis=axis))
    if (planes, axis) != ("x y z", -1):  # these are points
        message = refusal(path, lens=plane.LENS)
        assert f"{len(names)} planes" in message
        assert "--array :N" in message
        frame = next(open_capture([path], lens=plane.LENS, array=f":{number}").frames())
        np.testing.assert_allclose(np.nan_to_num(frame.z_m), z, rtol=1e-6)


def test_arrays_of_objects_are_never_unpickled(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{}], dtype=object), allow_pickle=True)
    assert "without objects" in refusal(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", depth=np.array([{}], dtype=object))
    assert "without objects" in refusal(tmp_path / "a.npz")


def test_an_archive_with_several_arrays_must_name_one(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", first=STORED, second=STORED)
    assert "first (72, 96), second (72, 96)" in refusal(tmp_path / "a.npz", lens=plane.LENS)
    np.savez(tmp_path / "b.npz", depth=STORED, xyz=plane.points_m(STORED))
    assert "several arrays" in refusal(tmp_path / "b.npz", lens=plane.LENS)


@pytest.mark.parametrize("suffix", (".npy", ".npz", ".mat"))
def test_a_truncated_file_of_arrays_is_named(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, STORED)
    elif suffix == ".npz":
        np.savez(path, depth=STORED)
    else:
        scipy.io.savemat(path, {"Location": plane.points_m(STORED)})
    assert f"a{suffix}" in refusal(cut(path, 0.6), lens=plane.LENS)


def test_an_array_is_chosen_by_its_name_and_number(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", first=STORED, second=np.stack([STORED] * 2))
    path = tmp_path / "a.npz"
    assert "--array first" in refusal(path, lens=plane.LENS)
    assert "holds no array third" in refusal(path, lens=plane.LENS, array="third")
    assert "no such part" in refusal(path, lens=plane.LENS, array="second:2")
    assert "--array is for files of arrays" in refusal(
        png(tmp_path / "1.png"), lens=plane.LENS, array="first"
    )


def test_a_folder_whose_depth_lies_in_arrays_beside_pictures_names_them(tmp_path: Path) -> None:
    png(tmp_path / "1.png", np.zeros((72, 96, 3), np.uint8))
    scipy.io.savemat(tmp_path / "depth.mat", {"depth": STORED})
    assert f"to do: name {tmp_path / 'depth.mat'}" in refusal(tmp_path, lens=plane.LENS)
    (tmp_path / "1.png").rename(tmp_path / "1.jpg")
    np.save(tmp_path / "depth.npy", STORED)
    assert f"name one of {tmp_path / 'depth.mat'}, {tmp_path / 'depth.npy'}" in refusal(
        tmp_path, lens=plane.LENS
    )


def test_files_that_are_not_read_are_told_how_to_be_converted(tmp_path: Path) -> None:
    for name, message in (("a.pgm", "cv2.imread("), ("a.h5", "h5py.File("), ("a.e57", "as PLY")):
        (tmp_path / name).write_bytes(b"abc")
        assert message in refusal(tmp_path / name)


def test_a_file_of_bare_numbers_needs_its_layout(tmp_path: Path) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(bytes(2 * 640 * 480))
    assert "--raw 640x480" in refusal(path)
    assert "is not a layout" in refusal(path, raw="640,480")
    assert "needs 615680" in refusal(path, raw="640x481")
    # planes of depth, brightness and confidence
    path.write_bytes(
        STORED.tobytes() + (STORED // 9).tobytes() + np.full(STORED.shape, 200, np.uint8).tobytes()
    )
    assert "--array :N" in refusal(path, raw="96x72", lens=plane.LENS)
    recording = open_capture([path], raw="96x72", lens=plane.LENS, array=":0")
    assert len(list(recording.frames())) == 1
    # the same pixel by pixel
    pixels = np.zeros(STORED.shape, np.dtype([("depth", "<u2"), ("rest", "u1", 3)]))
    pixels["depth"] = STORED
    pixels["rest"] = 77
    path.write_bytes(pixels.tobytes())
    assert "this layout is wrong" in refusal(path, raw="96x72", lens=plane.LENS, array=":0")
    read = next(open_capture([path], raw="96x72:u2/5", lens=plane.LENS).frames())
    np.testing.assert_allclose(np.nan_to_num(read.z_m), STORED / 1e3, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    (
        ("", "no line of numbers"),
        ("x y z\n", "no line of numbers"),
        ("1 2\n3 4\n5 6\n", "2 numbers in a line are not a point"),
        ("1 2 3\n4 5 6 7\n", "cannot be read as points"),
        ("1 2 3\nfour five six\n", "cannot be read as points"),
        ("x y z i\n1 2 3\n", "names the columns"),
        (" ".join(["1"] * 40) + "\n", "name depth.npy"),
        ("9" * 400 + " 1 1\n", "wrong unit|no valid pixel|finite"),
    ),
)
def test_a_faulty_list_of_points_is_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(text)
    assert re.search(message, refusal(path))


def test_a_height_map_that_is_none_is_explained(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.stack([STORED * 1.0] * 3))
    path = tmp_path / "a.npy"
    assert "choose one by its number: --array :0" in refusal(path, pitch="1mm")
    assert "is not a length" in refusal(path, pitch="wide", array=":0")
    np.save(path, np.full((9, 9), np.nan))
    assert "no finite height" in refusal(path, pitch="1mm")
    np.save(path, np.zeros((9, 9)))
    assert "--unit mm" in refusal(path, pitch="1mm")
    np.save(path, np.zeros((9, 9, 3, 2)))
    assert "is not a height map" in refusal(path, pitch="1mm")
    assert "--pitch is for files of arrays" in refusal(png(tmp_path / "1.png"), pitch="1mm")


def test_a_faulty_capture_of_a_phone_is_explained(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder = plane.write_stray(tmp_path / "stray", 1)
    matrix = folder / "camera_matrix.csv"
    matrix.write_text("1500,0,400\n0,1500,720\n0,0,1\n")
    assert "not the centre of any ARKit picture" in refusal(folder)
    matrix.write_text("1,2\n3\n")
    assert "camera_matrix.csv: cannot be read" in refusal(folder)
    (tmp_path / "a.r3d").write_bytes(b"PK")
    assert "not a Record3D archive" in refusal(tmp_path / "a.r3d")
    with zipfile.ZipFile(tmp_path / "b.r3d", "w") as archive:
        archive.writestr("metadata", '{"K": [1]}')
        archive.writestr("rgbd/0.depth", b"bvx$")
    assert "metadata cannot be read" in refusal(tmp_path / "b.r3d")
    k = [300, 0, 0, 0, 300, 0, 96, 72, 1]
    with zipfile.ZipFile(tmp_path / "c.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps({"K": k, "w": 192, "h": 144, "dw": 96, "dh": 72}))
        archive.writestr("rgbd/0.depth", b"bvx-\xff\xff\xff\xffabc")
    monkeypatch.setitem(sys.modules, "lzfse", object())
    assert "is damaged" in refusal(tmp_path / "c.r3d")


EXPORT = "Location = pc.Location; Color = pc.Color; save('cloud.mat','Location','Color','-v7')"


def test_a_saved_point_cloud_object_gets_the_line_that_exports_it(tmp_path: Path) -> None:
    message = refusal(plane.write_opaque_mat(tmp_path / "pc.mat"))
    assert "it holds a MATLAB object, which cannot be read outside MATLAB" in message
    assert EXPORT in message


def test_a_v73_file_is_told_how_to_be_saved(tmp_path: Path) -> None:
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512) + b"\x89HDF\r\n\x1a\n" + bytes(100)
    path = tmp_path / "a.mat"
    path.write_bytes(head)
    message = refusal(path)
    assert "-v7.3" in message
    assert "'-v7'" in message


@pytest.mark.parametrize(("write", "suffix"), ((plane.write_ply, "ply"), (plane.write_pcd, "pcd")))
@pytest.mark.parametrize("missing", (10, 60_000, 10**6))
def test_a_truncated_cloud_is_named(
    tmp_path: Path,
    write: Callable[..., Path],
    suffix: str,
    missing: int,
    capfd: pytest.CaptureFixture[str],
) -> None:
    intact_bytes = write(tmp_path / f"c.{suffix}", plane.points_m(STORED)).stat().st_size
    message = refusal(
        write(tmp_path / f"c.{suffix}", plane.points_m(STORED), cut=min(missing, intact_bytes))
    )
    assert f"c.{suffix}" in message
    assert capfd.readouterr().out == ""


def test_a_cloud_on_both_sides_of_the_camera_is_refused(tmp_path: Path) -> None:
    points = plane.points_m(STORED) * [1, -1, -1]
    points[:20] *= [1, -1, -1]
    message = refusal(plane.write_pcd(tmp_path / "c.pcd", points))
    assert "behind the camera" in message
    assert "negate" in message
    centred = plane.points_m(STORED) - np.nanmean(plane.points_m(STORED), axis=(0, 1))
    assert "behind the camera" in refusal(plane.write_pcd(tmp_path / "d.pcd", centred))
    assert "behind the camera" in refusal(
        plane.write_pcd(tmp_path / "e.pcd", plane.points_m(STORED)[..., [2, 0, 1]])
    )


def test_a_cloud_far_off_the_axis_stands_in_another_frame(tmp_path: Path) -> None:
    message = refusal(
        plane.write_pcd(tmp_path / "c.pcd", plane.points_m(STORED) + np.array([431.0, 58.0, 0.0]))
    )
    assert "off the camera's axis" in message
    assert "another frame" in message


# ---- lenses


@pytest.mark.parametrize(
    ("text", "message"),
    (
        ('{"fx": 500, "fy": 500, "cx": 300}', "its keys: fx, fy, cx"),
        ('{"fx": 500, "fx": 500, "fy": 500, "cx": 300, "cy": 200}', "fx occurs twice"),
        ('{"fx": 500,\n "fy": }', ":2:8:"),
        ('{"fx": "500", "fy": 500, "cx": 300, "cy": 200}', "fx is '500'"),
        ('{"fx": true, "fy": 500, "cx": 300, "cy": 200}', "fx is True"),
        ('{"fx": NaN, "fy": 500, "cx": 300, "cy": 200}', "fx is nan"),
        ('{"fx": 0.79, "fy": 0.88, "cx": 0.5, "cy": 0.5}', "normalised"),
        ('{"fx": -500, "fy": 500, "cx": 300, "cy": 200}', "focal length"),
        ('{"fx": 500, "fy": 500, "cx": 9000, "cy": 200}', "principal point"),
        ('{"fx": 500, "fy": 500, "cx": 300, "cy": 200, "distortion": [1, 2, 3]}', "3 numbers"),
        (
            '{"fx": 500, "fy": 500, "cx": 300, "cy": 200, "distortion": {"k7": 1}}',
            "unknown names: k7",
        ),
        ('{"intrinsic_matrix": [1, 2, 3]}', "list of 9"),
        (
            "K: [500, 0, 300, 0, 500, 200, 0, 0, 1]\nD: [.1, 0, 0, 0]\n"
            "distortion_model: equidistant",
            "equidistant",
        ),
        (
            '{"a": {"fx": 500, "fy": 500, "cx": 300, "cy": 200},'
            ' "b": {"fx": 400, "fy": 500, "cx": 300, "cy": 200}}',
            "2 dif",
        ),
        ("fx: 500\nfx: 500\n", ":2:1:"),
        ("just text", "no keys"),
    ),
)
def test_a_faulty_lens_file_is_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "lens.txt"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        read_lens(path, 640, 576)
    assert message in str(caught.value)
    assert "lens.txt" in str(caught.value)


def test_a_missing_lens_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"none\.json: no such file"):
        read_lens(tmp_path / "none.json", 640, 576)


def test_a_missing_system_library_is_named_with_its_package(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Broken:
        def find_spec(self, name: str, path: object = None, target: object = None) -> None:
            if name == "open3d":
                raise ImportError(
                    "libGL.so.1: cannot open shared object file: No such file or directory"
                )

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Broken(), *sys.meta_path])
    with pytest.raises(UserError, match="needs Open3D") as caught:
        load_open3d()
    assert "apt install libgl1" in str(caught.value)


def test_points_that_are_no_place_before_a_camera_are_left_out(tmp_path: Path) -> None:
    """Such numbers would overflow when the picture is divided into cells."""
    points = plane.points_m(plane.depth_mm(noise_mm=0.6))
    points[10, 10, 0] = 1e30
    points[30, 30] = (25.0, 0.0, 0.5)
    points[40, 40] = (9.0, 0.0, 0.5)
    path = plane.write_pcd(tmp_path / "a.pcd", points)
    recording = open_capture([path])
    (frame,) = recording.frames()
    for pixel in ((10, 10), (30, 30)):
        assert frame.reason[pixel] == Reason.OUT_OF_RANGE and np.isnan(frame.z_m[pixel])
    assert frame.reason[40, 40] == Reason.VALID, "86.8 degrees aside"
    assert any("no place before a camera are left out" in note for note in recording.notes)


def test_a_list_whose_first_line_is_no_count_is_read(tmp_path: Path) -> None:
    """Of two numbers that are not whole, none states how many points follow."""
    points = plane.points_m(plane.depth_mm())[:20, :20]
    for head in ("nan 3\n", "inf 3\n", "2.5 3\n"):
        path = plane.write_points(tmp_path / "a.xyz", points, head=head)
        assert "cannot be read as points" in refusal(path)
