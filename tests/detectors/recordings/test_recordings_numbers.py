"""The numbers by which captures are read, at their limits: sizes of cameras, layouts, height maps,
units, codes, steps, shapes and lenses."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from detectors.recordings import open_capture
from detectors.recordings.arrays import (
    RawLoader,
    _apart,
    _axes,
    _frames_are_last,
    _height_unit_m,
    _pitch_m,
    raw_layout_of,
)
from detectors.recordings.clouds import _grid_of
from detectors.recordings.depth_images import (
    _colours_of,
    _depth_size,
    depth_files,
    depth_named,
    png_kind,
)
from detectors.recordings.distances import (
    _weight,
    decided_unit,
    default_metres,
    frame_of,
    metres_per_unit,
    no_return_codes,
    ray_lengths_doubt,
    refuse_far_aside,
    refuse_implausible,
    refuse_narrow,
    rounding_step_m,
    scale_in,
)
from detectors.recordings.intrinsics import (
    colour_camera,
    depth_mode_of_size,
    parse_calibration,
    parsed_lens,
    read_lens,
)
from detectors.recordings.recording import Recording
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens, OtherLens, Reason
from tests.support import recorded_plane as plane

CAMERAS = parse_calibration("test", plane.calibration())

# --- sizes of cameras ---

CAMERA_SIZES = (
    ("Azure Kinect NFOV unbinned", 640, 576),
    ("Azure Kinect NFOV binned", 320, 288),
    ("Azure Kinect WFOV binned", 512, 512),
    ("Azure Kinect WFOV unbinned", 1024, 1024),
    ("Kinect v1", 640, 480),
    ("Kinect v2", 512, 424),
    ("QVGA", 320, 240),
    ("Infineon REAL3", 224, 172),
    ("pico flexx", 224, 171),
    ("iPhone LiDAR", 256, 192),
    ("QQVGA", 160, 120),
    ("phones", 240, 180),
    ("RealSense L515", 1024, 768),
    ("RealSense D4xx", 1280, 720),
    ("RealSense D4xx at half size", 848, 480),
    ("1.2 megapixels", 1280, 960),
    ("SXGA", 1280, 1024),
)

CROWDED_OUT = ("RealSense D4xx", "1.2 megapixels")
"""Cameras whose pixels with other bytes between are those of four smaller pictures as well."""


@pytest.mark.parametrize(("name", "width", "height"), CAMERA_SIZES)
def test_the_layouts_of_usual_cameras_are_offered(
    tmp_path: Path, name: str, width: int, height: int
) -> None:
    """For one frame of 16 bits, and with other bytes between."""
    path = tmp_path / "depth.raw"
    for pixel_bytes, layout in ((2, ""), (5, ":u2/5"), (16, ":u2/16"), (34, "")):
        with path.open("wb") as file:
            file.truncate(width * height * pixel_bytes)
        fix = raw_layout_of(path).fix or ""
        offered = [f"--raw {text}".removesuffix(" or ") for text in fix.split("--raw ")[1:]]
        stated = f"--raw {width}x{height}{layout}"
        is_crowded_out = name in CROWDED_OUT and pixel_bytes > 2
        assert (stated in offered) != is_crowded_out
        # at most four are printed
        assert len(offered) == 4 or not is_crowded_out
        with path.open("wb") as file:
            file.truncate(width * height * pixel_bytes + 1)
        assert f"--raw {width}x{height}{layout} " not in (raw_layout_of(path).fix or "") + " "


@pytest.mark.parametrize(
    ("width", "height", "top"),
    [
        (1280, 720, 120),
        (1920, 1080, 180),
        (2560, 1440, 240),
        (2048, 1536, 0),
        (3840, 2160, 360),
        (4096, 3072, 0),
    ],
)
def test_every_colour_mode_sees_along_the_rays_of_the_sensor(width, height, top) -> None:
    """The modes in Microsoft's table: wide ones are the middle of the 4 : 3 sensor, scaled."""
    sensor = colour_camera("test", CAMERAS, 4096, 3072)
    mode = colour_camera("test", CAMERAS, width, height)
    assert sensor is not None
    assert mode is not None
    assert (mode.lens.width, mode.lens.height) == (width, height)
    scale = 4096 / width
    u = np.array([0.0, 100.0, width - 1.0])
    v = np.array([5.0, 300.0, height - 1.0])
    on_sensor_u = (u + 0.5) * scale - 0.5
    on_sensor_v = (v + top + 0.5) * scale - 0.5
    expected = sensor.lens.slopes(on_sensor_u, on_sensor_v)
    np.testing.assert_allclose(mode.lens.slopes(u, v), expected, atol=1e-9)
    np.testing.assert_array_equal(mode.T_colour_depth, sensor.T_colour_depth)
    assert colour_camera("test", CAMERAS, width, height + 1) is None


@pytest.mark.parametrize("is_wide", [False, True])
def test_the_colour_lens_by_hand(is_wide: bool) -> None:
    """Shares of the sides of a 4 : 3 sensor, or of the 16 : 9 part of it on which early units were
    calibrated: 2304 of 3072 rows, from row 384 on."""
    calibration = json.loads(plane.calibration().rstrip(b"\0"))
    camera = calibration["CalibrationInformation"]["Cameras"][1]
    numbers = camera["Intrinsics"]["ModelParameters"]
    numbers[:4] = [0.51, 0.47, 0.6, 0.8]
    camera["SensorWidth"] = 4096
    camera["SensorHeight"] = 2304 if is_wide else 3072
    cameras = parse_calibration("test", json.dumps(calibration).encode())
    rows_on_sensor = 2304 if is_wide else 3072
    first_row = 384 if is_wide else 0
    fy_px = 0.8 * rows_on_sensor
    cy_px = 0.47 * rows_on_sensor + first_row
    for width, height in ((1280, 720), (2048, 1536)):
        colour = colour_camera("test", cameras, width, height)
        assert colour is not None
        scale = width / 4096
        top = (3072 * scale - height) / 2
        lens = colour.lens
        assert (lens.fx, lens.fy) == pytest.approx((0.6 * width, fy_px * scale))
        assert (lens.cx, lens.cy) == pytest.approx((0.51 * width - 0.5, cy_px * scale - top - 0.5))
    expected = np.eye(4)
    expected[:3, :3] = np.reshape(camera["Rt"]["Rotation"], (3, 3))
    expected[:3, 3] = camera["Rt"]["Translation"]
    assert colour is not None
    np.testing.assert_array_equal(colour.T_colour_depth, expected)


@pytest.mark.parametrize("key", ["size", "name"])
def test_of_several_lenses_that_of_the_size_or_of_depth_is_taken(tmp_path: Path, key: str) -> None:
    lens = {"fx": 100.0, "fy": 101.0, "cx": 47.0, "cy": 35.0}
    factory_lens = {"fx": 130.0, "fy": 131.0, "cx": 48.0, "cy": 36.0}
    if key == "size":
        content = {
            "a": {**factory_lens, "width": 192, "height": 144},
            "b": {**lens, "width": 96, "height": 72},
        }
    else:
        content = {"colour": factory_lens, "depth_camera": lens}
    path = tmp_path / "lenses.json"
    path.write_text(json.dumps(content))
    result = read_lens(path, 96, 72)
    assert (result.fx, result.fy, result.cx, result.cy) == (100.0, 101.0, 47.0, 35.0)
    path.write_text(json.dumps({"left": factory_lens, "right": lens}))
    with pytest.raises(UserError, match=r"holds 2 different lenses \(left, right\)"):
        read_lens(path, 96, 72)
    path.write_text(json.dumps({"left": lens, "right": lens}))
    assert read_lens(path, 96, 72).fx == 100.0


def test_depth_modes_are_known_by_their_sizes() -> None:
    modes = {
        (320, 288): "NFOV_2X2BINNED",
        (640, 576): "NFOV_UNBINNED",
        (512, 512): "WFOV_2X2BINNED",
        (1024, 1024): "WFOV_UNBINNED",
        (576, 640): None,
    }
    for (width, height), mode in modes.items():
        assert depth_mode_of_size(width, height) == mode


# --- bare numbers ---


def test_frames_of_bare_numbers_stand_where_the_layout_says(tmp_path: Path) -> None:
    """Big-endian numbers of 16 bits in steps of 5 bytes after 7 bytes; what is left over is
    counted."""
    random = np.random.default_rng(1)
    stored = random.integers(900, 950, (2, 6, 8)).astype(">u2")
    content = random.integers(0, 255, (2, 6, 8, 5)).astype(np.uint8)
    content[..., :2] = stored[..., None].view(np.uint8)
    path = tmp_path / "d.raw"
    path.write_bytes(bytes(7) + content.tobytes() + bytes(11))
    loader = RawLoader.stated("8x6:>u2/5:7")
    frames = loader(path)[""]
    np.testing.assert_array_equal(frames, stored)
    assert loader.refuse_doubtful(path, frames) == 11
    short = tmp_path / "short.raw"
    short.write_bytes(bytes(7 + 6 * 8 * 5 - 1))
    with pytest.raises(UserError, match=f"has {6 * 8 * 5 - 1} bytes from byte 7 on"):
        loader(short)
    for text in ("8x6:u2/1", "8x6:f4/3", "8x6:u3", "8", "8x6:u2/5:", "x6"):
        with pytest.raises(UserError):
            RawLoader.stated(text)
    plain = RawLoader.stated("8x6")
    assert (plain.kind, plain.step, plain.offset) == ("<u2", 2, 0)


@pytest.mark.parametrize(("step", "is_refused"), [(0.098, False), (0.103, True)])
def test_a_layout_whose_neighbours_differ_by_a_tenth_is_wrong(tmp_path, step, is_refused) -> None:
    stored = np.full((4, 6), 10_000.0)
    stored[:, 1::2] /= 1.0 + step
    path = tmp_path / "d.raw"
    path.write_bytes(stored.astype("<u2").tobytes())
    loader = RawLoader.stated("6x4")
    frames = loader(path)[""]
    if is_refused:
        with pytest.raises(UserError, match="this layout is wrong"):
            loader.refuse_doubtful(path, frames)
    else:
        assert loader.refuse_doubtful(path, frames) == 0


def test_the_difference_of_planes_is_that_of_the_median_pixel() -> None:
    first = np.array([[100.0, 200.0, 400.0, 0.0, 50.0]])
    second = np.array([[101.0, 190.0, 400.0, 70.0, -5.0]])
    assert _apart(first, second) == pytest.approx(0.01)
    assert _apart(first, 0.0 * second) == math.inf
    assert _apart(second, first) == pytest.approx(1.0 / 101.0)


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ((30, 40), (False, (1, 30, 40), True)),
        ((5, 30, 40), (False, (5, 30, 40), True)),
        ((30, 40, 3), (True, (1, 30, 40), True)),
        ((5, 30, 40, 3), (True, (5, 30, 40), True)),
        ((1000, 3), (True, (1, 1, 1000), False)),
        # a list of points for each frame from twenty times as many points as frames on
        ((4, 80, 3), (True, (4, 1, 80), False)),
        ((4, 79, 3), (True, (1, 4, 79), True)),
        ((8, 8), (False, (1, 8, 8), True)),
    ],
)
def test_shapes_of_arrays_are_frames_of_depth_or_points(shape, expected) -> None:
    assert _axes("x", shape, None) == expected


def test_lists_as_long_as_a_lens_has_pixels_have_its_grid() -> None:
    lens = Lens(40, 30, 50.0, 50.0, 19.5, 14.5)
    assert _axes("x", (1200, 3), lens) == (True, (1, 30, 40), True)
    assert _axes("x", (2, 1200, 3), lens) == (True, (2, 30, 40), True)
    assert _axes("x", (1201, 3), lens) == (True, (1, 1, 1201), False)
    for shape in ((7, 40), (40, 7), (5,), (2, 3, 4, 5), (2, 3, 4, 5, 3)):
        with pytest.raises(UserError, match="is not a capture"):
            _axes("x", shape, lens)


def test_frames_along_the_last_axis_are_fewer_than_half_of_the_others() -> None:
    plane_mm = 1000.0 + np.arange(12.0)[:, None] + np.arange(10.0)
    for count, are_last in ((5, True), (6, False)):
        assert _frames_are_last(np.repeat(plane_mm[..., None], count, axis=2)) == are_last
    # three: nearly equal planes are frames, x, y and z are not
    third = np.stack([plane_mm, 1.04 * plane_mm, plane_mm], axis=-1)
    assert _frames_are_last(third)
    assert not _frames_are_last(np.stack([plane_mm, 1.06 * plane_mm, plane_mm], axis=-1))
    assert not _frames_are_last(np.stack([1.06 * plane_mm, plane_mm, plane_mm], axis=-1))


@pytest.mark.parametrize(("factor", "is_refused"), [(1.049, False), (1.052, True)])
def test_planes_that_differ_by_a_twentieth_are_no_frames_of_one_scene(
    tmp_path, factor, is_refused
) -> None:
    stored = np.full((3, 72, 96), 1000.0) + np.arange(96.0)
    stored[2] *= factor
    np.save(tmp_path / "d.npy", stored)
    if is_refused:
        with pytest.raises(UserError, match=r"differs by 5\.2 % from plane to plane"):
            open_capture([tmp_path / "d.npy"], lens=plane.LENS)
    else:
        assert len(list(open_capture([tmp_path / "d.npy"], lens=plane.LENS).frames())) == 3


# --- height maps ---


@pytest.mark.parametrize("leading", [(), (1,)])
def test_a_height_map_becomes_a_cloud_around_its_middle(tmp_path, leading) -> None:
    random = np.random.default_rng(2)
    heights_um = np.rint(random.uniform(-900.0, 900.0, (9, 13))) + 40_000.0
    heights_um[2, 3] = np.nan
    np.save(tmp_path / "h.npy", heights_um.reshape(*leading, 9, 13))
    recording = open_capture([tmp_path / "h.npy"], pitch="2 mm")
    assert recording.scale_m == 1e-6
    assert recording.z_step_m == 1e-6
    assert recording.projection == "parallel"
    frame = next(recording.frames())
    expected_z = 1.0 - 1e-6 * (heights_um - np.nanmedian(heights_um))
    np.testing.assert_allclose(frame.z_m, expected_z, rtol=1e-6)
    assert frame.xy_m is not None
    np.testing.assert_allclose(frame.xy_m[4, 6], [0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(frame.xy_m[8, 0], [-0.012, 0.008], atol=1e-12)
    assert np.isnan(frame.xy_m[2, 3]).all()
    assert frame.reason[2, 3] == Reason.NO_RETURN
    assert (frame.reason == Reason.VALID).sum() == 9 * 13 - 1
    # numbers that are not whole were not rounded; depth grows away from the viewer
    np.savez(tmp_path / "d.npz", depth=heights_um + 0.5)
    depth = open_capture([tmp_path / "d.npz"], pitch="0.2cm")
    assert depth.z_step_m == 0.0
    z_m = next(depth.frames()).z_m
    np.testing.assert_allclose(z_m, 2.0 - expected_z, rtol=1e-6)


@pytest.mark.parametrize("shape", [(2, 9, 13), (1, 1, 9, 13), (1, 13)])
def test_several_maps_or_a_profile_are_no_height_map(tmp_path, shape) -> None:
    np.save(tmp_path / "h.npy", np.random.default_rng(3).normal(size=shape))
    with pytest.raises(UserError, match=r"maps of 13 x 9|not a height map"):
        open_capture([tmp_path / "h.npy"], pitch="2mm")


@pytest.mark.parametrize(
    ("relief", "unit_m"),
    [
        # of a side of 0.1 m: plausible from 0.05 to 50 mm
        (0.051, 1e-3),
        (49.9, 1e-3),
        (0.049, 1.0),
        (51.0, 1e-6),
        (5.1e-5, 1.0),
        (4.9e-5, None),
        (49_900.0, 1e-6),
        (51_000.0, None),
    ],
)
def test_the_unit_of_a_height_map_makes_its_relief_plausible(relief, unit_m) -> None:
    assert _height_unit_m(relief, 0.1) == unit_m


def test_a_pitch_is_a_length_with_its_unit() -> None:
    for text, pitch_m in (("0.5mm", 5e-4), ("200 um", 2e-4), ("1m", 1.0), (" 3cm ", 0.03)):
        assert _pitch_m(text) == pytest.approx(pitch_m)
    assert _pitch_m("0.1um") == pytest.approx(1e-7)
    for text in ("0.5", "mm", "-1mm", "1.1m", "0.05um", "1 inch"):
        with pytest.raises(UserError):
            _pitch_m(text)


# --- clouds ---


def pcd_text(points: int, fields: str = "x y z") -> str:
    count = len(fields.split())
    return (
        f"VERSION .7\nFIELDS {fields}\nSIZE {'4 ' * count}\nTYPE {'F ' * count}\n"
        f"COUNT {'1 ' * count}\nWIDTH {points}\nHEIGHT 1\nPOINTS {points}\nDATA ascii\n"
    )


def ply_text(points: int) -> str:
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    return f"ply\nformat ascii 1.0\nelement vertex {points}\n{properties}end_header\n"


@pytest.mark.parametrize(
    ("suffix", "header"), [(".pcd", pcd_text(50)), (".ply", ply_text(50))], ids=["pcd", "ply"]
)
def test_a_text_cloud_has_a_digit_and_a_separator_for_each_number(tmp_path, suffix, header) -> None:
    """The shortest file of 50 points ends without a separator; one byte less is a truncated one."""
    lines = "\n".join(f"{i % 2} {i // 25} 5" for i in range(50))
    path = tmp_path / f"c{suffix}"
    path.write_text(header + lines)
    recording = open_capture([path])
    assert recording.shape == (1, 50)
    path.write_text((header + lines)[:-1])
    size = len(header) + len(lines)
    with pytest.raises(UserError, match=f"truncated: {size - 1} of at least {size} bytes"):
        open_capture([path])


def test_a_binary_cloud_has_the_bytes_of_its_types(tmp_path) -> None:
    points = np.random.default_rng(4).uniform(0.5, 1.0, (60, 3))
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 60\n"
    header += "property float x\nproperty float y\nproperty float z\nproperty uchar red\n"
    header += "property short a\nend_header\n"
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("a", "<i2")]
    rows = np.zeros(60, kind)
    for axis, column in zip("xyz", points.T, strict=True):
        rows[axis] = column
    path = tmp_path / "c.ply"
    path.write_bytes(header.encode() + rows.tobytes())
    frame = next(open_capture([path]).frames())
    np.testing.assert_allclose(frame.z_m[0], points[:, 2], rtol=1e-6)
    path.write_bytes(path.read_bytes()[:-1])
    size = len(header) + 60 * 15
    with pytest.raises(UserError, match=f"{size - 1} of at least {size} bytes"):
        open_capture([path])


@pytest.mark.parametrize(("valid", "has_grid"), [(99, False), (100, True)])
def test_points_of_a_sensors_size_fill_its_grid_if_enough_are_valid(valid, has_grid) -> None:
    v, u = np.divmod(np.arange(160 * 120), 160)
    z = np.full(len(u), 0.9)
    points = np.stack([0.002 * (u - 80) * z, 0.003 * (v - 60) * z, z], axis=1)
    sparse = points.copy()
    sparse[np.random.default_rng(5).permutation(len(u))[valid:]] = 0.0
    assert _grid_of(sparse) == ((120, 160) if has_grid else (1, 19_200))


@pytest.mark.parametrize(("shape", "has_grid"), [((90, 151), True), ((31, 200), False)])
def test_points_of_a_crop_in_rows_fill_its_grid(shape: tuple[int, int], has_grid: bool) -> None:
    """A crop has no sensor's size; one with fewer than 32 rows is not taken for a picture."""
    v, u = np.indices(shape).reshape(2, -1)
    z = 0.9 + 1e-3 * np.random.default_rng(7).standard_normal(len(u))
    points = np.stack([0.002 * (u - 30) * z, 0.002 * (v - 400) * z, z], axis=1)
    points[::50] = np.nan
    assert _grid_of(points) == (shape if has_grid else (1, len(u)))
    shuffled = np.random.default_rng(8).permutation(points)
    assert _grid_of(shuffled) == (1, len(u))


@pytest.mark.parametrize("axis", [0, 1])
def test_points_in_another_order_fill_no_grid(axis: int) -> None:
    """The correlation with the column, and with the row, must exceed 0.999 each."""
    v, u = np.divmod(np.arange(160 * 120), 160)
    points = np.stack([-0.002 * (u - 80), 0.003 * (v - 60), np.ones(len(u))], axis=1)
    assert _grid_of(points) == (120, 160)
    noise = np.random.default_rng(6).standard_normal(len(u)) * points[:, axis].std()
    for correlation, is_grid in ((0.9993, True), (0.9987, False)):
        off = points.copy()
        off[:, axis] += noise * np.sqrt(1.0 / correlation**2 - 1.0)
        assert (_grid_of(off) == (120, 160)) == is_grid


# --- units ---


def test_numbers_for_which_no_unit_is_plausible_are_refused() -> None:
    for stored in (np.full(500, 3e7), np.full(500, 1e-6)):
        with pytest.raises(UserError, match="no usual unit is plausible"):
            decided_unit("x", stored, 1.0, (64, 48))


def test_whole_numbers_beyond_metres_are_integers_also_as_floating_point() -> None:
    stored = 247.0 + np.arange(2000) % 9
    unit = decided_unit("x", stored, 1.0, (380, 300))
    assert (unit.scale_m, unit.warning) == (1e-3, "")
    assert "others are possible" in decided_unit("x", stored + 0.25, 1.0, (380, 300)).warning
    # a plane at exactly 2 m is one of metres
    assert decided_unit("x", np.full(500, 2.0), 1.0, (64, 48)).scale_m == 1.0


@pytest.mark.parametrize(
    ("unit", "size", "foreground_m", "median_m", "divisor", "expected"),
    [
        # how common it is, times a bell around 0.8 m over the logarithm, and a floor of 0.05
        ("mm", (96, 72), 0.8, 1.0, 1, 0.867 * 1.05),
        ("mm", None, 0.8, 1.0, 1, 0.15 * 1.05),
        ("m", None, 0.8 * 1.8, 2.0, 1, 0.8 * (math.exp(-0.5) + 0.05)),
        ("m", None, 0.8 / 1.8**2, 2.0, 1, 0.8 * (math.exp(-2.0) + 0.05)),
        # nearer than 0.15 m there is no floor
        (
            "m",
            None,
            0.149,
            0.2,
            1,
            0.8 * math.exp(-0.5 * (math.log(0.149 / 0.8) / math.log(1.8)) ** 2),
        ),
        (
            "m",
            None,
            0.151,
            0.2,
            1,
            0.8 * (math.exp(-0.5 * (math.log(0.151 / 0.8) / math.log(1.8)) ** 2) + 0.05),
        ),
        # beyond 0.05 to 20 m no camera measures
        ("m", None, 0.8, 20.1, 1, 0.0),
        ("m", None, 0.8, 0.049, 1, 0.0),
        ("m", None, 0.8, 19.9, 1, 0.8 * 1.05),
        # cameras that all store 1 mm, within their range
        ("mm", (640, 576), 0.8, 4.4, 1, 8.67 * 1.05),
        ("mm", (640, 576), 0.8, 4.6, 1, 0.0),
        ("4000/m", (640, 576), 0.8, 4.6, 1, 0.08 * 1.05),
        ("4000/m", (1024, 768), 0.8, 1.0, 1, 1.6 * 1.05),
        ("mm", (1024, 768), 0.8, 1.0, 1, 0.867 * 1.05),
        # a common divisor that makes whole millimetres
        ("tum", (96, 72), 0.8, 1.0, 5, 3.0 * 1.05),
        ("tum", (96, 72), 0.8, 1.0, 4, 0.03 * 1.05),
        ("4000/m", (96, 72), 0.8, 1.0, 4, 8.0 * 1.05),
        ("mm", (96, 72), 0.8, 1.0, 1, 0.867 * 1.05),
    ],
)
def test_the_weight_of_a_unit(unit, size, foreground_m, median_m, divisor, expected) -> None:
    metres = metres_per_unit(unit)
    weight = _weight(unit, foreground_m / metres, median_m / metres, size, divisor)
    assert weight == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("size", "farthest_m"),
    [
        ((640, 576), 4.5),
        ((320, 288), 6.0),
        ((512, 512), 3.5),
        ((1024, 1024), 3.0),
        ((512, 424), 8.0),
        ((256, 192), 8.0),
    ],
)
def test_cameras_that_all_store_millimetres_do_so_within_their_range(size, farthest_m) -> None:
    """Ten times as probable as millimetres elsewhere, and impossible beyond; other sizes and units
    are as usual."""
    usual = 0.867 * 1.05
    for median_m, expected in ((farthest_m - 0.01, 10 * usual), (farthest_m + 0.01, 0.0)):
        assert _weight("mm", 800.0, 1e3 * median_m, size, 1) == pytest.approx(expected)
    taller = (size[0] + 1, size[1])
    assert _weight("mm", 800.0, 1e3 * farthest_m, taller, 1) == pytest.approx(usual)
    quarter = _weight("4000/m", 3200.0, 4e3 * farthest_m, size, 1)
    assert quarter == pytest.approx(0.08 * 1.05)


@pytest.mark.parametrize(
    ("size", "factor"),
    [((1024, 768), 20.0), ((640, 480), 2.0), ((1280, 720), 2.0), ((1920, 1080), 2.0)],
)
def test_sizes_of_the_l515_and_its_colour_favour_a_quarter_of_a_millimetre(size, factor) -> None:
    usual = 0.08 * 1.05
    assert _weight("4000/m", 3200.0, 4000.0, size, 1) == pytest.approx(factor * usual)
    wider = (size[0], size[1] + 1)
    assert _weight("4000/m", 3200.0, 4000.0, wider, 1) == pytest.approx(usual)
    assert _weight("mm", 800.0, 1000.0, size, 1) == pytest.approx(0.867 * 1.05)


def test_a_doubtful_unit_is_warned_of_with_the_others() -> None:
    """Whole numbers around 1.8 m in millimetres: 0.45 m in quarters is possible."""
    stored = 1797.0 + np.arange(2000) % 7
    unit = decided_unit("x", stored, 1e-3, (96, 72))
    assert unit.scale_m == 1e-3
    assert "1 mm is taken, which puts the median at 1.8 m" in unit.warning
    assert "others are possible: --unit 4000/m (0.45 m), --unit tum (0.36 m)" in unit.warning
    sure = decided_unit("x", 800.0 + np.arange(2000) % 7, 1e-3, (640, 576))
    assert sure.warning == ""
    assert sure.origin == "what is usual for integers"


def test_units_of_names_and_types() -> None:
    assert metres_per_unit("in") == 0.0254
    assert metres_per_unit("tum") == 0.0002
    assert metres_per_unit("cm") == 0.01
    assert metres_per_unit("2500/m") == pytest.approx(4e-4)
    for unit in ("0/m", "km", "/m", "-4/m"):
        with pytest.raises(UserError, match="no such unit"):
            metres_per_unit(unit)
    assert default_metres(np.dtype("u2")) == 1e-3
    assert default_metres(np.dtype("f4")) == 1.0
    refuse_narrow("x", np.dtype("i2"))
    for kind in ("u1", "i1", "?", "c8", "U3"):
        with pytest.raises(UserError):
            refuse_narrow("x", np.dtype(kind))


@pytest.mark.parametrize(
    ("statements", "median", "scale_m"),
    [
        ({"depth_scale": 0.001}, 900, 1e-3),
        ({"depthScale": 0.1}, 9000, 1e-4),
        ({"depth_scale": 1000}, 900, 1e-3),
        ({"depth_scale": 5000.0}, 4500, 2e-4),
        ({"Depth Units": "0.25 mm"}, 3600, 2.5e-4),
        ({"depth_unit": "cm"}, 90, 1e-2),
        ({"z-units": "metres"}, 0.9, 1.0),
        ({"depth_scale": "1e-3"}, 900, 1e-3),
        ({"scale": 0.001}, 900, None),
        ({"depth_scale": "0.25 furlongs"}, 900, None),
        ({"depth_scale": 0}, 900, None),
        # 0.1 to 10 m
        ({"depth_unit": "mm"}, 99, None),
        ({"depth_unit": "mm"}, 101, 1e-3),
        ({"depth_unit": "mm"}, 9900, 1e-3),
        ({"depth_unit": "mm"}, 10_100, None),
        # two readings are possible: 1 m and 1 mm
        ({"depth_scale": 1.0}, 5.0, 1.0),
        ({"first": "x", "depth_scale": 0.001}, 900, 1e-3),
    ],
)
def test_a_unit_that_names_state(statements, median, scale_m) -> None:
    result = scale_in(statements, median)
    assert result == (None if scale_m is None else pytest.approx(scale_m))


@pytest.mark.parametrize("step_m", [1e-3, 2.5e-4, 2e-4, 1e-4])
def test_distances_within_a_fiftieth_of_a_step_are_rounded(step_m: float) -> None:
    counts = 7 * np.arange(400, 1400) + 1  # no common divisor
    off = np.zeros(1000)
    off[500] = 1.0
    for share, is_rounded in (
        (0.0, True),
        (0.018, True),
        (-0.018, True),
        (0.022, False),
        (-0.03, False),
    ):
        z_m = (counts + share * off) * step_m
        assert (rounding_step_m(z_m) == step_m) == is_rounded
    assert rounding_step_m(np.array([np.nan, 0.5, 0.502])) == 1e-3
    assert rounding_step_m(np.array([np.nan])) == 0.0
    assert rounding_step_m(np.array([0.50003])) == 0.0


# --- codes ---


def surface(count: int = 4000, nearest: int = 700) -> np.ndarray:
    """Whole millimetres of a surface, 200 different numbers."""
    return nearest + np.arange(count) % 200


def with_codes(values: Sequence[float], repeats: int, base: np.ndarray) -> np.ndarray:
    return np.concatenate([base, np.repeat(values, repeats)]).astype(base.dtype)


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        # the type's largest number, even once
        (with_codes([65535], 1, surface().astype(np.uint16)), (65535.0,)),
        # a full scale of at least 20 pixels, a quarter beyond all others
        (with_codes([4095], 20, surface(4000, 3000).astype(np.uint16)), (4095.0,)),
        (with_codes([4095], 19, surface(4000, 3000).astype(np.uint16)), ()),
        (with_codes([4095], 20, surface(4000, 3070).astype(np.uint16)), (4095.0,)),
        (with_codes([4095], 20, surface(4000, 3080).astype(np.uint16)), ()),
        # a power of two of 11 bits or more, or one or two below
        (with_codes([2047], 30, surface().astype(np.uint16)), (2047.0,)),
        (with_codes([2046], 30, surface().astype(np.uint16)), (2046.0,)),
        (with_codes([2045], 30, surface().astype(np.uint16)), ()),
        (with_codes([2048], 30, surface().astype(np.uint16)), (2048.0,)),
        (with_codes([2049], 30, surface().astype(np.uint16)), ()),
        (with_codes([1023], 30, surface(4000, 400).astype(np.uint16)), ()),
        # at most eight numbers four times farther than all others
        (with_codes(range(3600, 3608), 3, surface().astype(np.uint16)), tuple(range(3600, 3608))),
        (with_codes(range(3600, 3609), 3, surface().astype(np.uint16)), ()),
        (with_codes([3590], 3, surface().astype(np.uint16)), ()),
        # or, of whole numbers, nearer
        (with_codes([1, 2], 3, surface().astype(np.uint16)), (1.0, 2.0)),
        (with_codes([174], 3, surface().astype(np.uint16)), (174.0,)),
        (with_codes([176], 3, surface().astype(np.uint16)), ()),
        (with_codes([1.0], 3, surface() * 1.0), ()),
        (with_codes([3600.0], 3, surface() * 1.0), (3600.0,)),
        (with_codes([1.25], 3, surface(4000, 100) * 1e-3), (1.25,)),
        (with_codes([1.15], 3, surface(4000, 100) * 1e-3), ()),
        # at most three different negative numbers of at least 20 pixels
        (with_codes([-1, -2, -3], 7, surface().astype(np.int16)), (-3.0, -2.0, -1.0)),
        (with_codes([-1], 19, surface().astype(np.int16)), ()),
        (with_codes([-1, -2, -3, -4], 7, surface().astype(np.int16)), ()),
        (np.repeat([-700, -701], 40).astype(np.int16), ()),
    ],
)
def test_numbers_that_cannot_be_distances(stored, expected) -> None:
    assert sorted(no_return_codes(stored)) == sorted(expected)


# --- frames ---


@pytest.mark.parametrize(("is_depth", "most"), [(True, 500), (False, 20)])
def test_a_frame_with_too_many_points_behind_the_camera_is_refused(is_depth, most) -> None:
    """Half of the pixels of depth, or a hundredth of the points of a cloud and at least 20."""
    random = np.random.default_rng(7)
    for behind, is_refused in ((most, False), (most + 1, True)):
        z = random.uniform(0.6, 0.8, 1000)
        z[:behind] *= -1
        stored = z[None] if is_depth else np.stack([0 * z, 0 * z, z], axis=-1)[None]
        if is_refused:
            with pytest.raises(UserError, match="lie behind the camera"):
                frame_of("f", stored, 1.0)
            continue
        frame = frame_of("f", stored, 1.0)
        assert (frame.reason == Reason.OUT_OF_RANGE).sum() == behind
        assert np.isfinite(frame.z_m).sum() == 1000 - behind


@pytest.mark.parametrize(("behind", "is_turned"), [(991, True), (990, False)])
def test_a_cloud_behind_the_camera_is_turned_about_x(behind, is_turned) -> None:
    random = np.random.default_rng(8)
    points = random.uniform(0.4, 0.8, (1000, 3))
    points[:behind, 2] *= -1
    stored = points[None] * 1e3
    if not is_turned:
        with pytest.raises(UserError, match="99 % of the points lie behind"):
            frame_of("f", stored, 1e-3)
        return
    frame = frame_of("f", stored, 1e-3)
    assert frame.xy_m is not None
    np.testing.assert_allclose(frame.z_m[0, :behind], -points[:behind, 2], rtol=1e-6)
    np.testing.assert_allclose(frame.xy_m[0, :behind], points[:behind, :2] * [1.0, -1.0])
    assert (frame.reason[0, behind:] == Reason.OUT_OF_RANGE).all()
    assert np.isnan(frame.z_m[0, behind:]).all()


def test_a_frame_states_why_pixels_have_no_distance() -> None:
    points = np.full((2, 4, 3), 500.0)
    points[0, 0, 2] = 0.0
    points[0, 1, 2] = np.nan
    points[0, 2, 0] = np.inf
    points[1, 3, 1] = np.nan
    frame = frame_of("f", points, 2e-3)
    reasons = np.zeros((2, 4), int)
    reasons[0, 0] = Reason.NO_RETURN
    reasons[0, [1, 2]] = Reason.NOT_FINITE
    reasons[1, 3] = Reason.NOT_FINITE
    np.testing.assert_array_equal(frame.reason, reasons)
    assert frame.xy_m is not None
    valid = reasons == 0
    np.testing.assert_allclose(frame.z_m[valid], 1.0)
    np.testing.assert_allclose(frame.xy_m[valid], 1.0)
    assert np.isnan(frame.z_m[~valid]).all()
    assert np.isnan(frame.xy_m[~valid]).all()


def distances(median_m: float) -> Frame:
    z_m = np.full((3, 5), median_m, np.float32)
    z_m[0] = np.nan
    return Frame("f", z_m, np.zeros((3, 5), np.uint8))


def test_a_median_distance_below_50_mm_or_above_20_m_is_implausible() -> None:
    for median_m in (0.0501, 0.7, 19.99):
        refuse_implausible(distances(median_m), 1e-3)
    with pytest.raises(UserError) as caught:
        refuse_implausible(distances(0.0499), 1e-4)
    assert "--unit mm (then 0.499 m)" in str(caught.value)
    with pytest.raises(UserError) as caught:
        refuse_implausible(distances(20.01), 1e-3)
    assert "--unit tum (then 4 m)" in str(caught.value)
    assert "--unit cm" not in str(caught.value)


@pytest.mark.parametrize(("slope", "is_refused"), [(3.99, False), (4.01, True)])
def test_points_76_degrees_off_the_axis_are_in_another_frame(slope, is_refused) -> None:
    z_m = np.linspace(0.5, 1.5, 99)[None].astype(np.float32)
    xy_m = z_m[..., None] * slope * np.array([0.6, -0.8])
    frame = Frame("f", z_m, np.zeros(z_m.shape, np.uint8), xy_m=xy_m)
    if is_refused:
        with pytest.raises(UserError, match="more than 76 degrees"):
            refuse_far_aside(frame)
    else:
        refuse_far_aside(frame)


@pytest.mark.parametrize("is_length", [True, False])
def test_lengths_along_rays_are_flat_as_lengths_and_z_is_not(is_length: bool) -> None:
    """A tilted plane with a wave, whose bends are those of z by a stated factor."""
    lens = Lens(96, 72, 60.0, 60.0, 47.5, 35.5)
    slopes = lens.region_slopes(lens.whole)
    z_m = 1.0 / (1.2 + 0.3 * slopes[..., 0] - 0.2 * slopes[..., 1])
    length = np.sqrt(1.0 + (slopes**2).sum(axis=-1))
    stored = z_m * length if is_length else z_m
    noisy = stored * (1.0 + 1e-4 * np.random.default_rng(9).standard_normal(z_m.shape))
    doubt = ray_lengths_doubt(noisy, slopes)
    assert bool(doubt) == is_length
    if is_length:
        # second differences over an eighth of the picture, of rows and columns
        def bend(image: np.ndarray) -> float:
            sizes = []
            for values in (image, image.T):
                step = len(values) // 8
                second = values[2 * step :] + values[: -2 * step] - 2 * values[step:-step]
                sizes.append(np.abs(second).ravel())
            return float(np.median(np.concatenate(sizes)))

        ratio = bend(1.0 / noisy) / bend(length / noisy)
        assert ratio > 3.0
        assert f"surfaces are {ratio:.0f} times as flat" in doubt


def test_rays_that_do_not_return_to_their_pixel_are_left_out() -> None:
    """By a twentieth of a pixel or so; without distortion all do."""
    lens = Lens(96, 72, 60.0, 60.0, 47.5, 35.5)
    frame = Frame("f", np.ones((72, 96), np.float32), np.zeros((72, 96), np.uint8))
    recording = Recording("r", lambda: iter([frame]), (72, 96), 1.0, 0.0, lens=lens)
    assert recording.slopes is not None
    np.testing.assert_allclose(recording.slopes, lens.region_slopes(lens.whole))
    assert next(recording.frames()).z_m.shape == (72, 96)


# --- lenses ---


def written_lens(tmp_path: Path, **numbers: float) -> Path:
    lens = {"fx": 100.0, "fy": 100.0, "cx": 47.5, "cy": 35.5, **numbers}
    path = tmp_path / "intrinsic.json"
    path.write_text(json.dumps(lens))
    return path


@pytest.mark.parametrize(
    ("numbers", "is_refused"),
    [
        # a focal length of 0.1 to 100 widths, by height for y
        ({"fx": 9.7}, False),
        ({"fx": 9.5}, True),
        ({"fy": 9.7}, False),
        ({"fy": 9.5}, True),
        ({"fx": 9590.0}, False),
        ({"fx": 9610.0}, True),
        ({"fy": 9610.0}, True),
        # a centre at most one picture outside
        ({"cx": -95.0}, False),
        ({"cx": -97.0}, True),
        ({"cx": 191.0}, False),
        ({"cx": 193.0}, True),
        ({"cy": -71.0}, False),
        ({"cy": -73.0}, True),
        ({"cy": 143.0}, False),
        ({"cy": 145.0}, True),
    ],
)
def test_an_impossible_lens_is_refused(tmp_path, numbers, is_refused) -> None:
    path = written_lens(tmp_path, **numbers)
    if is_refused:
        with pytest.raises(UserError, match="is impossible for 96 x 72"):
            read_lens(path, 96, 72)
    else:
        lens = read_lens(path, 96, 72)
        for key, value in numbers.items():
            assert getattr(lens, key) == value


@pytest.mark.parametrize(
    ("numbers", "is_doubted"),
    [
        ({"cx": 47.5 + 0.19 * 96}, False),
        ({"cx": 47.5 + 0.21 * 96}, True),
        ({"cx": 47.5 - 0.21 * 96}, True),
        ({"cy": 35.5 + 0.19 * 72}, False),
        ({"cy": 35.5 - 0.19 * 72}, False),
        ({"cy": 35.5 + 0.21 * 72}, True),
    ],
)
def test_a_centre_a_fifth_of_the_picture_off_is_doubted(tmp_path, numbers, is_doubted) -> None:
    lens = read_lens(written_lens(tmp_path, **numbers), 96, 72)
    assert isinstance(lens, OtherLens) == is_doubted


def test_a_lens_of_larger_pictures_is_scaled_about_pixel_edges(tmp_path) -> None:
    numbers = {"width": 288, "height": 216, "fx": 290.0, "fy": 310.0, "cx": 140.0, "cy": 110.0}
    lens = read_lens(written_lens(tmp_path, **numbers), 96, 72)
    assert (lens.fx, lens.fy) == pytest.approx((290 / 3, 310 / 3))
    assert (lens.cx, lens.cy) == pytest.approx((140.5 / 3 - 0.5, 110.5 / 3 - 0.5))
    assert isinstance(lens, OtherLens)
    with pytest.raises(UserError, match="is for images of 288 x 216"):
        read_lens(tmp_path / "intrinsic.json", 96, 71)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("100 101 47 35", (100.0, 101.0, 47.0, 35.0)),
        ("100 0 47\n0 101 35\n0 0 1", (100.0, 101.0, 47.0, 35.0)),
        ("[[100, 0, 47], [0, 101, 35], [0, 0, 1]]", (100.0, 101.0, 47.0, 35.0)),
        ("100 0 47 0\n0 101 35 0\n0 0 1 0", (100.0, 101.0, 47.0, 35.0)),
        ("1e2 0 47 0\n0 101 35 0\n0 0 1 0\n0 0 0 1 # matrix", (100.0, 101.0, 47.0, 35.0)),
        ("100 0 0\n0 101 0\n47 35 1", (100.0, 101.0, 47.0, 35.0)),
    ],
)
def test_bare_numbers_are_a_lens_or_a_matrix(tmp_path, text, expected) -> None:
    path = tmp_path / "K.txt"
    path.write_text(text)
    lens = read_lens(path, 96, 72)
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == expected
    assert not any(lens.distortion)
    assert parsed_lens(path)


# --- pictures ---


def test_colours_belong_to_the_depth_nearest_in_time() -> None:
    """By time stamps within 20 ms, or by the same number."""
    depths = [Path(f"depth/{stamp}.png") for stamp in ("10.000", "10.040", "10.100")]
    colours = [Path(f"rgb/{stamp}.png") for stamp in ("9.981", "10.005", "10.0605", "10.1199")]
    assert _colours_of(depths, colours, 0.02) == [colours[1], None, colours[3]]
    numbered = [Path(f"d/depth_{number}.png") for number in (1, 2, 10)]
    pictures = [Path(f"d/color_{number}.png") for number in (10, 1)]
    assert _colours_of(numbered, pictures, 0.0) == [pictures[1], None, pictures[0]]
    assert _colours_of(numbered, [], 0.0) == [None, None, None]


def test_depth_pictures_are_sorted_by_their_numbers() -> None:
    names = ["depth_10", "depth_9", "depth_9.5", "ir_3", "conf7", "depth_100"]
    paths = [Path(f"{name}.png") for name in names]
    chosen = depth_named(paths, paths)
    assert [path.stem for path in chosen] == ["depth_9", "depth_9.5", "depth_10", "depth_100"]
    candidates = [
        Path(f"{name}.png") for name in ("b12", "b2", "ir_1", "b_mask", "b3_conf", "air1")
    ]
    assert [path.stem for path in depth_named(candidates, candidates)] == ["air1", "b2", "b12"]


def test_the_kind_of_a_png_stands_in_its_header(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "7.png"), np.zeros((5, 9), np.uint16))
    cv2.imwrite(str(tmp_path / "8.png"), np.zeros((5, 9, 3), np.uint8))
    assert png_kind(tmp_path / "7.png") == (9, 5, 16, 0)
    assert png_kind(tmp_path / "8.png") == (9, 5, 8, 2)
    (tmp_path / "9.png").write_bytes((tmp_path / "7.png").read_bytes()[:25])
    with pytest.raises(UserError, match="is truncated"):
        png_kind(tmp_path / "9.png")
    assert [path.name for path in depth_files(tmp_path)] == ["7.png", "8.png", "9.png"]


@pytest.mark.parametrize(
    ("mode", "text"),
    [
        ("L", ", grey"),
        ("RGB", ", RGB"),
        ("P", ", palette"),
        ("LA", ", grey with alpha"),
        ("RGBA", ", RGBA"),
    ],
)
def test_a_picture_is_no_depth_and_the_message_says_what_it_is(
    tmp_path: Path, mode: str, text: str
) -> None:
    PillowImage.new(mode, (9, 5)).save(tmp_path / "p.png")
    with pytest.raises(
        UserError, match=f"bits per channel{text}: a picture or a mask, not a depth image"
    ):
        _depth_size(tmp_path / "p.png")
