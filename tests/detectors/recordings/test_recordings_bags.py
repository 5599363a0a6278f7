"""ROS 2 bags as captures: every layout of a cloud gives the same frame, and every fault is told
once."""

from __future__ import annotations

import shutil
import sqlite3
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionMode

from detectors.averages.average import AverageConfig, average
from detectors.recordings import bags as bag_reader
from detectors.recordings import open_capture
from detectors.recordings.bags import lens_of_info
from detectors.recordings.messages import frame_of_message, stored_depth
from harness.vocabulary import files
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Lens, Reason
from tests.support import bag_of_a_plane as bags
from tests.support import recorded_plane as plane

POINTS = plane.points_m(plane.depth_mm())
VALID = np.isfinite(POINTS[..., 2])
BOMB_BYTES = 1 << 27
MAGIC_BYTES = 8
CHUNK_INDEX = 8
"""MCAP: the length of its first and last bytes, and the code of a chunk's entry in the index."""


def refusal(path: Path, **options: Any) -> str:
    """The message of opening and reading a capture to its end."""
    with pytest.raises(UserError) as caught:
        list(open_capture([path], **options).frames())
    return str(caught.value)


# ---- a message


@settings(max_examples=60, deadline=None)
@given(
    number=st.sampled_from(["f4", "f8"]),
    big=st.booleans(),
    lead=st.integers(0, 9),
    row_padding=st.integers(0, 40),
    organised=st.booleans(),
    coloured=st.booleans(),
    packed_as=st.sampled_from(["f4", "u4"]),
)
def test_every_layout_of_one_cloud_is_one_frame(
    number: str,
    big: bool,
    lead: int,
    row_padding: int,
    organised: bool,
    coloured: bool,
    packed_as: str,
) -> None:
    rgb = np.stack([np.full(VALID.shape, c, np.uint8) for c in (200, 7, 129)], axis=-1)
    message = bags.cloud(
        POINTS,
        number=number,
        big=big,
        lead=lead,
        row_padding=row_padding,
        organised=organised,
        rgb=rgb if coloured else None,
        packed_as=packed_as,
    )
    frame = frame_of_message("m", message, 1.0)
    shape = VALID.shape if organised else (1, VALID.size)
    assert frame.z_m.dtype == np.float32
    assert frame.xy_m is not None
    np.testing.assert_array_equal(frame.z_m, POINTS[..., 2].astype(np.float32).reshape(shape))
    np.testing.assert_array_equal(frame.xy_m, POINTS[..., :2].astype(number).reshape(*shape, 2))
    np.testing.assert_array_equal(
        frame.reason, np.where(VALID, Reason.VALID, Reason.NO_RETURN).reshape(shape)
    )
    if coloured:
        np.testing.assert_array_equal(frame.rgb, rgb.reshape(*shape, 3))
    else:
        assert frame.rgb is None


def test_whole_millimetres_are_read_in_their_unit() -> None:
    stored = np.rint(1e3 * np.nan_to_num(POINTS)).astype(int)
    frame = frame_of_message("m", bags.cloud(stored, number="i2"), 1e-3)
    np.testing.assert_array_equal(
        frame.z_m, np.where(VALID, POINTS[..., 2], np.nan).astype(np.float32)
    )
    assert frame.reason[plane.NO_RETURN] == Reason.NO_RETURN


@pytest.mark.parametrize(
    ("options", "message"),
    (
        ({"leave_out": "z"}, "has no field z; its fields: x (type 7, count 1), y"),
        ({"cut": 1}, "is truncated"),
        ({"cut": 10_000, "row_padding": 8}, "is truncated"),
    ),
)
def test_a_broken_cloud_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match="the cloud: ") as caught:
        frame_of_message("the cloud", bags.cloud(POINTS, **options), 1.0)
    assert message in str(caught.value)


def test_layouts_that_contradict_themselves_are_refused() -> None:
    def refusal_of(**changes: Any) -> str:
        message = bags.cloud(POINTS)
        for key, value in changes.items():
            setattr(message, key, value)
        with pytest.raises(UserError) as caught:
            frame_of_message("m", message, 1.0)
        return str(caught.value)

    message = bags.cloud(POINTS)
    assert "cannot hold 96 of" in refusal_of(row_step=100)
    assert "holds no points (0 x 72)" in refusal_of(width=0)
    assert "ends at byte 12 of points of 8 bytes" in refusal_of(point_step=8)
    assert "x (type 9" in refusal_of(
        fields=[type(f)(f.name, f.offset, 9, 1) for f in message.fields]
    )
    assert "count 3" in refusal_of(fields=[type(f)(f.name, f.offset, 7, 3) for f in message.fields])


# ---- a bag


@pytest.mark.parametrize("mcap", (False, True))
def test_a_bag_is_read_as_its_folder_and_as_its_file(tmp_path: Path, mcap: bool) -> None:
    messages = [
        ("/depth/camera_info", bags.INFO, bags.info()),
        *bags.clouds(3),
        ("/other", bags.IMAGE, bags.image()),
    ]
    folder = bags.write_bag(tmp_path / "bag", messages, mcap=mcap)
    for path in (folder, folder / f"bag.{'mcap' if mcap else 'db3'}"):
        recording = open_capture([path])
        assert recording.lens == plane.LENS
        assert recording.z_step_m == 1e-3
        assert recording.notes == ()
        frames = list(recording.frames())
        assert len(frames) == 3
        for i, frame in enumerate(frames):
            stored = plane.depth_mm(i, noise_mm=0.6)
            np.testing.assert_array_equal(
                np.nan_to_num(frame.z_m), (stored * 1e-3).astype(np.float32)
            )
            np.testing.assert_array_equal(frame.rgb, plane.rgb(i))
        assert frames[2].name == f"{path.name} /points2 message 2"


def test_the_digest_covers_the_messages_and_the_metadata(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    assert [path.name for path in open_capture([folder]).files] == ["bag.db3", "metadata.yaml"]


@pytest.mark.parametrize(
    ("mcap", "compression"),
    (
        (True, CompressionMode.STORAGE),
        (False, CompressionMode.MESSAGE),
        (True, CompressionMode.MESSAGE),
    ),
)
def test_compressed_chunks_and_messages_are_unpacked(
    tmp_path: Path,
    mcap: bool,
    compression: CompressionMode,
) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(2), mcap=mcap, compression=compression)
    stored = [np.nan_to_num(frame.z_m) for frame in open_capture([folder]).frames()]
    for i in range(2):
        np.testing.assert_array_equal(
            stored[i], (plane.depth_mm(i, noise_mm=0.6) * 1e-3).astype(np.float32)
        )


def test_a_lens_counts_only_where_the_points_lie_on_its_rays(tmp_path: Path) -> None:
    points = bags.clouds(2)
    beside = [("/a", bags.INFO, bags.info(shift_px=0.02)), ("/b", bags.INFO, bags.info(width=97))]
    separate = open_capture([bags.write_bag(tmp_path / "apart", [*beside, *points])])
    assert separate.lens is None
    assert "no CameraInfo in the bag fits" in separate.notes[0]
    assert next(separate.frames()).xy_m is not None
    right = [*beside, ("/c", bags.INFO, bags.info(shift_px=0.005))]
    assert open_capture([bags.write_bag(tmp_path / "right", [*right, *points])]).lens is not None
    # both ways give the same points, to what float32 leaves of x and y
    exact = open_capture(
        [bags.write_bag(tmp_path / "exact", [("/c", bags.INFO, bags.info()), *points])]
    )
    by_lens = average(exact, AverageConfig()).points_m
    by_points = average(separate, AverageConfig()).points_m
    np.testing.assert_allclose(by_lens, by_points, atol=3e-8)


def test_a_named_lens_must_be_that_of_the_points(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    assert open_capture([folder], lens=plane.LENS).lens == plane.LENS
    assert "they lie up to" in refusal(
        folder, lens=type(plane.LENS)(96, 72, 140.0, 141.0, 47.0, 36.0)
    )
    assert "but the lens is of 10 x 10" in refusal(
        folder, lens=type(plane.LENS)(10, 10, 15.0, 15.0, 5.0, 5.0)
    )


def test_single_points_stay_single_points(tmp_path: Path) -> None:
    flat = bags.cloud(POINTS, organised=False)
    messages = [("/c", bags.INFO, bags.info()), ("/points2", bags.CLOUD, flat)]
    recording = open_capture([bags.write_bag(tmp_path / "bag", messages)])
    assert not recording.organised
    assert recording.lens is None
    assert "unorganised points" in recording.notes[0]


def test_the_usual_topic_the_only_one_or_the_named_one(tmp_path: Path) -> None:
    two = bags.write_bag(tmp_path / "two", [*bags.clouds(1, "/near"), *bags.clouds(2, "/far")])
    assert "2 topics hold clouds" in refusal(two)
    assert "legal: /far, /near" in refusal(two)
    assert len(list(open_capture([two], topic="far").frames())) == 2
    assert len(list(open_capture([two], topic="/near").frames())) == 1
    usual = bags.write_bag(
        tmp_path / "usual", [*bags.clouds(1, "/near"), *bags.clouds(3, "points2")]
    )
    assert len(list(open_capture([usual]).frames())) == 3
    only = bags.write_bag(tmp_path / "only", bags.clouds(1, "/only"))
    assert len(list(open_capture([only]).frames())) == 1


# ---- depth images

STORED = plane.depth_mm()
DEPTH = "/camera/depth/image_raw"
LENS_TOPIC = "/camera/depth/camera_info"


@settings(max_examples=40, deadline=None)
@given(
    encoding=st.sampled_from(("16UC1", "mono16", "32FC1")),
    big=st.booleans(),
    padding=st.integers(0, 40),
    packed=st.sampled_from(("", "png", "rvl")),
)
def test_every_encoding_of_one_depth_image_is_one_image(
    encoding: str,
    big: bool,
    padding: int,
    packed: str,
) -> None:
    if packed:
        stored = stored_depth("m", bags.packed_depth(STORED, encoding, packed))
    else:
        stored = stored_depth("m", bags.depth_image(STORED, encoding, big, padding))
    if encoding != "32FC1":
        assert stored.dtype == np.uint16
        np.testing.assert_array_equal(stored, STORED)
        return
    # a / (n - b) is quantised: within one step of n
    true_m = np.where(STORED == 0, np.nan, STORED / 1e3) if packed else STORED / 1e3
    np.testing.assert_allclose(stored, true_m, rtol=2e-4 if packed else 1e-7)


@pytest.mark.parametrize("kind", ("ros1", "db3", "mcap"))
@pytest.mark.parametrize("compressed", (False, True))
def test_a_bag_of_depth_images_has_their_lens(tmp_path: Path, kind: str, compressed: bool) -> None:
    pictures = [
        (DEPTH, bags.IMAGE, bags.depth_image(plane.depth_mm(i, noise_mm=0.6))) for i in range(3)
    ]
    unrelated = [
        ("/camera/color/camera_info", bags.INFO, bags.info(shift_px=9.0)),
        ("/camera/ir/image_raw", bags.IMAGE, bags.depth_image(STORED, "mono16")),
        (LENS_TOPIC, bags.INFO, bags.info()),
    ]
    if kind == "ros1":
        path = bags.write_ros1(
            tmp_path / "a.bag", [*unrelated, *pictures], "lz4" if compressed else None
        )
    else:
        storage = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
        mode = storage if compressed else CompressionMode.NONE
        path = bags.write_bag(
            tmp_path / "a", [*unrelated, *pictures], mcap=kind == "mcap", compression=mode
        )
    recording = open_capture([path])
    assert recording.lens == plane.LENS
    assert recording.z_step_m == 1e-3
    frames = list(recording.frames())
    assert len(frames) == 3
    for i, frame in enumerate(frames):
        stored = plane.depth_mm(i, noise_mm=0.6)
        np.testing.assert_array_equal(np.nan_to_num(frame.z_m), (stored * 1e-3).astype(np.float32))
    assert frames[0].reason[plane.NO_RETURN] == Reason.NO_RETURN


def test_clouds_of_ros_1_are_read(tmp_path: Path) -> None:
    path = bags.write_ros1(
        tmp_path / "a.bag", [("/c", bags.INFO, bags.info()), *bags.clouds(2)], "bz2"
    )
    recording = open_capture([path])
    assert recording.lens == plane.LENS
    assert len(list(recording.frames())) == 2


def test_depth_images_with_their_lens_come_before_clouds(tmp_path: Path) -> None:
    picture = (DEPTH, bags.IMAGE, bags.depth_image(STORED))
    lens = (LENS_TOPIC, bags.INFO, bags.info())
    combined = bags.write_bag(tmp_path / "both", [picture, lens, *bags.clouds(1)])
    recording = open_capture([combined])
    assert next(recording.frames()).rgb is None
    assert "not the clouds on /points2" in recording.notes[0]
    assert next(open_capture([combined], topic="points2").frames()).rgb is not None
    lacking = bags.write_bag(tmp_path / "lacking", [picture, *bags.clouds(1)])
    assert "the clouds on /points2 are read" in open_capture([lacking]).notes[0]
    several = [
        picture,
        ("/camera/aligned_depth_to_color/image_raw", bags.IMAGE, bags.depth_image(STORED)),
        lens,
    ]
    message = refusal(bags.write_bag(tmp_path / "several", several))
    assert "2 topics hold depth images" in message
    assert f"instance --topic {DEPTH}" in message
    copies = [picture, (f"{DEPTH}/compressedDepth", bags.PACKED, bags.packed_depth(STORED)), lens]
    assert open_capture([bags.write_bag(tmp_path / "copies", copies)]).lens == plane.LENS


def test_realsense_names_and_its_unit(tmp_path: Path) -> None:
    sensor = "/device_0/sensor_0"
    messages = [
        (f"{sensor}/Depth_0/info/camera_info", bags.INFO, bags.info(model="Inverse Brown Conrady")),
        (f"{sensor}/option/Depth_Units/value", "std_msgs/msg/Float32", bags.number(0.00025)),
        ("/device_0/sensor_1/Color_0/info/camera_info", bags.INFO, bags.info(shift_px=9)),
        (f"{sensor}/Depth_0/image/data", bags.IMAGE, bags.depth_image(4 * STORED, "mono16")),
        (f"{sensor}/Infrared_0/image/data", bags.IMAGE, bags.depth_image(STORED, "mono16")),
    ]
    recording = open_capture([bags.write_ros1(tmp_path / "a.bag", messages)])
    assert recording.lens == plane.LENS
    assert recording.scale_m == 0.00025
    np.testing.assert_allclose(np.nan_to_num(next(recording.frames()).z_m), STORED / 1e3, rtol=1e-6)
    assert recording.unit_text.startswith("depth unit 0.25 mm, from /device_0")


def test_the_unit_of_realsense_in_a_bag_of_ros_2_is_a_text(tmp_path: Path) -> None:
    sensor = "/device_0/sensor_0"
    messages = [
        (f"{sensor}/Depth_0/image/camera_info", bags.INFO, bags.info()),
        (f"{sensor}/option/Depth_Units/description", bags.TEXT, bags.text("units of depth")),
        (f"{sensor}/option/Depth_Units/value", bags.TEXT, bags.text("0.000100")),
        (f"{sensor}/Depth_0/image/data", bags.IMAGE, bags.depth_image(10 * STORED, "mono16")),
    ]
    recording = open_capture([bags.write_bag(tmp_path / "bag", messages)])
    assert recording.scale_m == 0.0001
    np.testing.assert_allclose(np.nan_to_num(next(recording.frames()).z_m), STORED / 1e3, rtol=1e-6)


def test_the_lens_of_a_camera_info() -> None:
    shape = plane.LENS.height, plane.LENS.width
    distorted = (0.1, -0.2, 0.001, 0.002, 0.03)
    lens = lens_of_info(bags.info(d=distorted), shape)
    assert isinstance(lens, Lens)
    assert lens.distortion == (*distorted, 0, 0, 0)
    rectified = bags.info(d=distorted)
    rectified.p = np.array([140.0, 0, 45, 0, 0, 141, 35, 0, 0, 0, 1, 0])
    flat = lens_of_info(rectified, shape, is_rectified=True)
    assert isinstance(flat, Lens)
    assert (flat.fx, flat.cy, any(flat.distortion)) == (140, 35, False)
    # the centre of a binned pixel lies between those of its four; the region's first pixel is (10,
    # 20)
    binned = bags.info()
    binned.binning_x = binned.binning_y = 2
    binned.roi = type(binned.roi)(x_offset=10, y_offset=20, width=40, height=30, do_rectify=False)
    small = lens_of_info(binned, (15, 20))
    assert isinstance(small, Lens)
    np.testing.assert_allclose(small.slopes(3, 4), plane.LENS.slopes(10 + 6.5, 20 + 8.5))
    assert "distortion model equidistant" in str(
        lens_of_info(bags.info(d=(0.1, 0, 0, 0), model="equidistant"), shape)
    )
    assert "for images of 96 x 72 pixels, not 10 x 10" in str(lens_of_info(bags.info(), (10, 10)))
    unset = bags.info()
    unset.k = np.zeros(9)
    assert "uncalibrated camera" in str(lens_of_info(unset, shape))


def test_depth_images_without_their_lens_are_refused(tmp_path: Path) -> None:
    picture = (DEPTH, bags.IMAGE, bags.depth_image(STORED))
    none = bags.write_bag(tmp_path / "none", [picture])
    assert "the bag's: none" in refusal(none)
    assert "--intrinsics FILE" in refusal(none)
    assert open_capture([none], lens=plane.LENS).lens == plane.LENS
    fisheye = bags.info(d=(0.1, 0, 0, 0), model="equidistant")
    assert "equidistant" in refusal(
        bags.write_bag(tmp_path / "fish", [picture, (LENS_TOPIC, bags.INFO, fisheye)])
    )
    short = bags.depth_image(STORED)
    short.data = short.data[:-1]
    cut = bags.write_bag(
        tmp_path / "cut", [(DEPTH, bags.IMAGE, short), (LENS_TOPIC, bags.INFO, bags.info())]
    )
    assert "is truncated" in refusal(cut)


@settings(max_examples=40, deadline=None)
@example(form="rvl", cut=0.005, share=0.0, byte=0)  # ends within the width
@example(form="png", cut=1.0, share=0.0, byte=0)  # whole
@example(form="rvl", cut=1.0, share=0.0, byte=0)
@example(form="rvl", cut=1.0, share=1.0, byte=1)  # another number at the end
@given(
    form=st.sampled_from(("png", "rvl")),
    cut=st.floats(0, 1),
    share=st.floats(0, 1),
    byte=st.integers(0, 255),
)
def test_a_damaged_compressed_image_is_read_or_told(
    form: str,
    cut: float,
    share: float,
    byte: int,
) -> None:
    message = bags.packed_depth(STORED, "16UC1", form)
    data = message.data.copy()
    data[int(share * (data.size - 1))] ^= byte
    message.data = data[: int(cut * data.size)]
    is_whole = cut == 1.0 and byte == 0
    try:
        depth = stored_depth("m", message)
    except UserError as mistake:
        assert str(mistake)
        assert not is_whole
    else:
        assert depth.dtype == np.uint16
        assert not is_whole or np.array_equal(depth, STORED)


@pytest.mark.parametrize("part", (0.0, 0.001, 0.3, 0.9, 0.999))
def test_a_truncated_bag_of_ros_1_is_named(tmp_path: Path, part: float) -> None:
    path = bags.write_ros1(tmp_path / "a.bag", bags.clouds(2))
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    message = refusal(path)
    assert "a.bag: is truncated or damaged" in message
    assert "rosbag reindex" in message


@settings(max_examples=12, deadline=None)
@given(share=st.floats(0, 1), byte=st.integers(1, 255))
def test_a_changed_byte_of_ros_1_is_read_or_told(
    tmp_path_factory: pytest.TempPathFactory,
    share: float,
    byte: int,
) -> None:
    path = bags.write_ros1(tmp_path_factory.mktemp("ros1") / "a.bag", bags.clouds(1))
    content = bytearray(path.read_bytes())
    content[int(share * (len(content) - 1))] ^= byte
    path.write_bytes(content)
    try:
        assert len(list(open_capture([path]).frames())) <= 1
    except UserError as mistake:
        assert str(mistake)


@pytest.mark.parametrize("compression", (pytest.param("bz2", marks=pytest.mark.slow), "lz4"))
def test_a_chunk_of_ros_1_may_not_fill_the_memory(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    compression: str,
) -> None:
    zeros = bags.image()
    zeros.data = np.zeros(BOMB_BYTES, np.uint8)
    path = bags.write_ros1(tmp_path / "a.bag", [(DEPTH, bags.IMAGE, zeros)], compression)
    assert path.stat().st_size < BOMB_BYTES // 100
    monkeypatch.setattr(files, "READING_BYTES", BOMB_BYTES // 4)
    assert "there is not enough memory" in refusal(path)


# ---- what it refuses


def test_a_missing_topic_lists_those_that_are_there(tmp_path: Path) -> None:
    none = bags.write_bag(tmp_path / "none", [("/picture", bags.IMAGE, bags.image())])
    assert "or depth images; its topics: /picture (sensor_msgs/msg/Image)" in refusal(none)
    bag = bags.write_bag(
        tmp_path / "some", [("/picture", bags.IMAGE, bags.image()), *bags.clouds(1)]
    )
    assert "no topic points; its topics: /picture" in refusal(bag, topic="points")
    assert "/picture message 0: holds 'mono8' pictures, not depth" in refusal(bag, topic="picture")
    path = tmp_path / "d.npy"
    np.save(path, plane.depth_mm())
    assert "is not a ROS bag" in refusal(path, topic="points2", lens=plane.LENS)


@pytest.mark.parametrize("mcap", (False, True))
def test_an_empty_bag_is_refused(tmp_path: Path, mcap: bool) -> None:
    folder = bags.write_bag(tmp_path / "bag", [], mcap=mcap)
    assert "no topic with sensor_msgs/msg/PointCloud2 or depth images; its topics: none" in refusal(
        folder
    )


def test_a_topic_without_messages_is_refused(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    with sqlite3.connect(folder / "bag.db3") as database:
        database.execute("DELETE FROM messages")
    assert "no message on /points2" in refusal(folder)


def test_a_recording_that_was_not_closed_has_no_metadata(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    (folder / "metadata.yaml").unlink()
    assert "has no metadata.yaml" in refusal(folder)
    assert "bag.db3" in refusal(folder)
    assert next(open_capture([folder / "bag.db3"]).frames()).z_m.shape == VALID.shape


@pytest.mark.parametrize(
    "text", ("rosbag2_bagfile_information: [", "rosbag2_bagfile_information: 3", "\xff")
)
def test_metadata_that_says_nothing_is_refused(tmp_path: Path, text: str) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    (folder / "metadata.yaml").write_bytes(text.encode("latin1"))
    assert "metadata.yaml:" in refusal(folder)


def test_metadata_may_not_name_what_is_not_there(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1))
    (folder / "bag.db3").rename(folder / "other.db3")
    assert "names bag.db3, which is missing" in refusal(folder)


def test_files_that_are_compressed_whole_are_told_how_to_be_unpacked(tmp_path: Path) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(1), compression=CompressionMode.FILE)
    assert "zstd -d" in refusal(folder)


@pytest.mark.parametrize("part", (0.0, 0.001, 0.3, 0.9, 0.999))
@pytest.mark.parametrize("mcap", (False, True))
def test_a_truncated_file_is_named(tmp_path: Path, mcap: bool, part: float) -> None:
    folder = bags.write_bag(tmp_path / "bag", bags.clouds(3), mcap=mcap)
    file = folder / f"bag.{'mcap' if mcap else 'db3'}"
    content = file.read_bytes()
    file.write_bytes(content[: int(part * len(content))])
    for path in (folder, file):
        message = refusal(path)
        assert file.name in message
        assert "is truncated or damaged" in message


@settings(max_examples=12, deadline=None)
@given(share=st.floats(0, 1), byte=st.integers(1, 255), mcap=st.booleans())
def test_a_changed_byte_is_read_or_told(
    tmp_path_factory: pytest.TempPathFactory,
    share: float,
    byte: int,
    mcap: bool,
) -> None:
    folder = bags.write_bag(tmp_path_factory.mktemp("bags") / "bag", bags.clouds(1), mcap=mcap)
    file = folder / f"bag.{'mcap' if mcap else 'db3'}"
    content = bytearray(file.read_bytes())
    content[int(share * (len(content) - 1))] ^= byte
    file.write_bytes(content)
    try:
        frames = list(open_capture([file]).frames())
    except UserError as mistake:
        assert str(mistake)
    else:
        assert len(frames) == 1
    shutil.rmtree(folder)


@pytest.mark.parametrize("mode", (CompressionMode.STORAGE, CompressionMode.MESSAGE))
def test_a_chunk_or_message_may_not_fill_the_memory(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mode: CompressionMode,
) -> None:
    zeros = bags.image()
    zeros.data = np.zeros(BOMB_BYTES, np.uint8)
    folder = bags.write_bag(
        tmp_path / "bag", [(DEPTH, bags.IMAGE, zeros)], mcap=True, compression=mode
    )
    assert (folder / "bag.mcap").stat().st_size < BOMB_BYTES // 100
    monkeypatch.setattr(files, "READING_BYTES", BOMB_BYTES // 4)
    assert "there is not enough memory" in refusal(folder)


def test_a_chunk_that_unpacks_to_another_size_than_it_states_is_refused(tmp_path: Path) -> None:
    folder = bags.write_bag(
        tmp_path / "bag", bags.clouds(1), mcap=True, compression=CompressionMode.STORAGE
    )
    file = folder / "bag.mcap"
    content = bytearray(file.read_bytes())
    # the index repeats the size: op 8, eight bytes of length, .., and at its end the sizes, packed
    # and unpacked
    start = next(start for start in _records(content) if content[start] == CHUNK_INDEX)
    end = start + 9 + struct.unpack_from("<Q", content, start + 1)[0]
    (promised,) = struct.unpack_from("<Q", content, end - 8)
    struct.pack_into("<Q", content, end - 8, promised - 1)
    file.write_bytes(content)
    assert "is truncated or damaged" in refusal(file)


def test_a_message_may_not_be_larger_than_a_cloud(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(bag_reader, "MAX_MESSAGE_BYTES", 2**17)
    for mode in (CompressionMode.NONE, CompressionMode.MESSAGE):
        folder = bags.write_bag(tmp_path / mode.name, bags.clouds(1), compression=mode)
        assert "has more than 0 MiB" in refusal(folder)


def _records(content: bytearray) -> list[int]:
    """Where the records of an MCAP begin."""
    start = MAGIC_BYTES
    starts = []
    while start < len(content) - MAGIC_BYTES:
        starts.append(start)
        start += 9 + struct.unpack_from("<Q", content, start + 1)[0]
    return starts
