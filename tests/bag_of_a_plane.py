"""ROS 2 bags of the recorded plane, in whatever layout a test asks for, written without the project's own writer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import recorded_plane as plane
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_HUMBLE)
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
CLOUD = "sensor_msgs/msg/PointCloud2"
INFO = "sensor_msgs/msg/CameraInfo"
IMAGE = "sensor_msgs/msg/Image"


def header(frame: str = "depth_camera_link") -> Any:
    time = TYPES.types["builtin_interfaces/msg/Time"](sec=12, nanosec=34)
    return TYPES.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


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
    """PointCloud2 of points (h, w, 3): ``lead`` bytes before x, ``row_padding`` after each row; ``cut`` bytes lack."""
    order = ">" if big else "<"
    size = int(number[1])
    names, offsets, types = ["x", "y", "z"], [lead, lead + size, lead + 2 * size], [number] * 3
    if rgb is not None:
        names.append("rgb")
        offsets.append(lead + 3 * size + 4)
        types.append("u4")
    step = offsets[-1] + 8
    kind = np.dtype({"names": names, "formats": [order + t for t in types], "offsets": offsets, "itemsize": step})
    grid = points if organised else points.reshape(1, -1, 3)
    height, width = grid.shape[:2]
    values = np.zeros((height, width), kind)
    for i, axis in enumerate("xyz"):
        values[axis] = grid[..., i]
    if rgb is not None:
        r, g, b = (rgb[..., i].astype(np.uint32).reshape(height, width) for i in range(3))
        # alpha 255: as a float these bytes are a NaN wherever red is above 127
        values["rgb"] = 0xFF000000 | r << 16 | g << 8 | b
    rows = values.view(np.uint8).reshape(height, width * step)
    data = np.concatenate([rows, np.full((height, row_padding), 171, np.uint8)], axis=1).ravel()
    field = TYPES.types["sensor_msgs/msg/PointField"]
    declared = [packed_as if name == "rgb" else kind_ for name, kind_ in zip(names, types, strict=True)]
    fields = [
        field(name=n, offset=o, datatype=CODES[t], count=1)
        for n, o, t in zip(names, offsets, declared, strict=True)
        if n != leave_out
    ]
    return TYPES.types[CLOUD](
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


def info(shift_px: float = 0.0, width: int = plane.LENS.width) -> Any:
    """The plane's lens as CameraInfo, its centre moved by ``shift_px``."""
    matrix = plane.LENS.matrix.copy()
    matrix[0, 2] += shift_px
    roi = TYPES.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return TYPES.types[INFO](
        header=header(),
        height=plane.LENS.height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def image() -> Any:
    return TYPES.types[IMAGE](
        header=header(), height=1, width=1, encoding="mono8", is_bigendian=0, step=1, data=np.zeros(1, np.uint8)
    )


def write_bag(
    folder: Path,
    messages: Sequence[tuple[str, str, Any]],
    *,
    mcap: bool = False,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A bag of (topic, type, message), a thirtieth of a second apart."""
    writer = Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        made: dict[str, Any] = {}
        for i, (topic, kind, message) in enumerate(messages):
            if topic not in made:
                made[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(made[topic], 10**9 + i * 33_333_333, TYPES.serialize_cdr(message, kind))
    return folder


def clouds(frames: int, topic: str = "/points2") -> list[tuple[str, str, Any]]:
    """The plane's first frames with their colours."""
    return [
        (topic, CLOUD, cloud(plane.points_m(plane.depth_mm(i, noise_mm=0.6)), rgb=plane.rgb(i))) for i in range(frames)
    ]
