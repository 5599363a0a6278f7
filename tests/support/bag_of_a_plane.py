"""ROS bags of the recorded plane, in whatever layout a test asks for, written without the
project's own writer."""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from tests.support import recorded_plane as plane


@cache
def types_of(store: Stores = Stores.ROS2_HUMBLE) -> Typestore:
    """Return the message types. To read them takes over a second, which no import of this module
    should cost."""
    return get_typestore(store)


CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
CLOUD = "sensor_msgs/msg/PointCloud2"
INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"
PACKED = "sensor_msgs/msg/CompressedImage"
TEXT = "std_msgs/msg/String"


def header(frame: str = "depth_camera_link") -> Any:
    time = types_of().types["builtin_interfaces/msg/Time"](sec=12, nanosec=34)
    return types_of().types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def cloud(
    points: np.ndarray,
    *,
    rgb: np.ndarray | None = None,
    number: str = "f4",
    big: bool = False,
    lead: int = 0,
    row_padding: int = 0,
    organised: bool = True,
    leave_out: str = "",
    packed_as: str = "f4",
    cut: int = 0,
) -> Any:
    """PointCloud2 of points (h, w, 3): ``lead`` bytes before x, ``row_padding`` after each row;
    ``cut`` bytes lack."""
    order = ">" if big else "<"
    size = int(number[1])
    names = ["x", "y", "z"]
    offsets = [lead, lead + size, lead + 2 * size]
    types = [number] * 3
    if rgb is not None:
        names.append("rgb")
        offsets.append(lead + 3 * size + 4)
        types.append("u4")
    step = offsets[-1] + 8
    kind = np.dtype(
        {
            "names": names,
            "formats": [order + t for t in types],
            "offsets": offsets,
            "itemsize": step,
        }
    )
    grid = points if organised else points.reshape(1, -1, 3)
    height, width = grid.shape[:2]
    values = np.zeros((height, width), kind)
    for i, axis in enumerate("xyz"):
        values[axis] = grid[..., i]
    if rgb is not None:
        r, g, b = rgb.astype(np.uint32).reshape(height, width, 3).transpose(2, 0, 1)
        # alpha 255: as a float these bytes are a NaN wherever red is above 127
        values["rgb"] = 0xFF000000 | r << 16 | g << 8 | b
    rows = values.view(np.uint8).reshape(height, width * step)
    data = np.concatenate([rows, np.full((height, row_padding), 171, np.uint8)], axis=1).ravel()
    field = types_of().types["sensor_msgs/msg/PointField"]
    fields = []
    for name, offset, declared in zip(names, offsets, types, strict=True):
        if name != leave_out:
            code = CODES[packed_as if name == "rgb" else declared]
            fields.append(field(name=name, offset=offset, datatype=code, count=1))
    return types_of().types[CLOUD](
        header=header(),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big,
        point_step=step,
        row_step=width * step + row_padding,
        data=data[: len(data) - cut],
        is_dense=False,
    )


def info(
    shift_px: float = 0.0,
    width: int = plane.LENS.width,
    d: Sequence[float] = (0.0,) * 5,
    model: str = "plumb_bob",
) -> Any:
    """The plane's lens as CameraInfo, its centre moved by ``shift_px``."""
    matrix = plane.LENS.matrix.copy()
    matrix[0, 2] += shift_px
    roi = types_of().types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return types_of().types[INFO](
        header=header(),
        height=plane.LENS.height,
        width=width,
        distortion_model=model,
        d=np.array(d),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def image() -> Any:
    return types_of().types[IMAGE](
        header=header(),
        height=1,
        width=1,
        encoding="mono8",
        is_bigendian=0,
        step=1,
        data=np.zeros(1, np.uint8),
    )


def depth_image(
    stored_mm: np.ndarray, encoding: str = "16UC1", big: bool = False, padding: int = 0
) -> Any:
    """Depth (h, w) as an Image: whole millimetres or float metres, rows padded with 171."""
    kind = "f4" if encoding == "32FC1" else "u2"
    values = stored_mm / 1e3 if kind == "f4" else stored_mm
    rows = np.ascontiguousarray(values.astype((">" if big else "<") + kind)).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=171)
    height, width = stored_mm.shape
    return types_of().types[IMAGE](
        header=header(),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.ravel(),
    )


def packed_depth(stored_mm: np.ndarray, encoding: str = "16UC1", form: str = "png") -> Any:
    """The same as compressedDepth, with image_transport's quantisation of 32FC1 (100 at most 10 m
    away)."""
    a = b = 0.0
    values = stored_mm
    if encoding == "32FC1":
        a = 100.0 * 101.0
        b = 1.0 - a / 10.0
        inverse = np.rint(a / np.maximum(stored_mm / 1e3, 1e-9) + b)
        values = np.where(stored_mm == 0, 0, inverse).astype(np.uint16)
    content = cv2.imencode(".png", values)[1].tobytes() if form == "png" else rvl(values)
    data = struct.pack("<iff", 0, a, b) + content
    name = f"{encoding}; compressedDepth {form}"
    return types_of().types[PACKED](
        header=header(), format=name, data=np.frombuffer(data, np.uint8)
    )


def rvl(values: np.ndarray) -> bytes:
    """Wilson's published encoder, number by number."""
    nibbles: list[int] = []

    def put(number: int) -> None:
        while True:
            nibble = number & 7
            number = number >> 3
            nibbles.append(nibble | (8 if number else 0))
            if not number:
                return

    flat = values.ravel().tolist()
    index = 0
    previous = 0
    while index < len(flat):
        start = index
        while index < len(flat) and flat[index] == 0:
            index += 1
        put(index - start)
        start = index
        while index < len(flat) and flat[index] != 0:
            index += 1
        put(index - start)
        for value in flat[start:index]:
            delta = value - previous
            previous = value
            put((delta << 1) ^ (delta >> 31))
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        int("".join(f"{n:x}" for n in nibbles[i : i + 8]), 16) for i in range(0, len(nibbles), 8)
    ]
    return struct.pack(f"<II{len(words)}I", values.shape[1], values.shape[0], *words)


def number(value: float) -> Any:
    return types_of().types["std_msgs/msg/Float32"](data=value)


def text(content: str) -> Any:
    return types_of().types[TEXT](data=content)


def write_ros1(
    path: Path, messages: Sequence[tuple[str, str, Any]], compression: str | None = None
) -> Path:
    """The same messages as a bag of ROS 1: headers count, and CameraInfo has capitals."""
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    with writer:
        connections: dict[str, Any] = {}
        for i, (topic, kind, message) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    topic, kind, typestore=types_of(Stores.ROS1_NOETIC)
                )
            content = types_of(Stores.ROS1_NOETIC).serialize_ros1(_in_ros1(message), kind)
            writer.write(connections[topic], 10**9 + i * 33_333_333, content)
    return path


def _in_ros1(message: Any) -> Any:
    """A message of ROS 2 as one of ROS 1."""
    if not hasattr(message, "__msgtype__"):
        return [_in_ros1(item) for item in message] if isinstance(message, list) else message
    kind = types_of(Stores.ROS1_NOETIC).types[message.__msgtype__]
    values = {
        name: _in_ros1(getattr(message, name, getattr(message, name.lower(), 0)))
        for name in _names(kind)
    }
    return kind(**values)


def _names(kind: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(kind) if field.name != "__msgtype__"]


def write_bag(
    folder: Path,
    messages: Sequence[tuple[str, str, Any]],
    *,
    mcap: bool = False,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A bag of (topic, type, message), a thirtieth of a second apart."""
    storage = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    writer = Writer(folder, version=8, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for i, (topic, kind, message) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types_of())
            content = types_of().serialize_cdr(message, kind)
            writer.write(connections[topic], 10**9 + i * 33_333_333, content)
    return folder


def clouds(frames: int, topic: str = "/points2") -> list[tuple[str, str, Any]]:
    """The plane's first frames with their colours."""
    messages = []
    for i in range(frames):
        points = plane.points_m(plane.depth_mm(i, noise_mm=0.6))
        messages.append((topic, CLOUD, cloud(points, rgb=plane.rgb(i))))
    return messages
