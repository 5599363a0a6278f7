"""ROS 2 bags (sqlite3 or MCAP) of one view each, as ``ros2 bag record`` would leave them.

Topics: ``/points2`` (sensor_msgs/PointCloud2, the topic that Azure Kinect's driver publishes), organised on the whole
sensor; ``/depth/camera_info`` (sensor_msgs/CameraInfo) at the same times; ``/tf_static`` (the camera in the board's
frame). Coordinates are in the camera's optical frame (REP 103: x right, y down, z forward), metres, NaN where invalid.
"""

from __future__ import annotations

import errno
import sqlite3
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from harness.exchange.views import BOARD_FRAME, ExportedView, Exposure, quaternion_of
from harness.vocabulary.lens import Lens

Storage = Literal["sqlite3", "mcap"]
POINTS_TOPIC = "/points2"
INFO_TOPIC = "/depth/camera_info"
POSE_TOPIC = "/tf_static"
BAG_VERSION: Literal[8] = 8
"""Version of metadata.yaml: the oldest that the library writes; later ROS distributions read it too."""
FLOAT32 = 7
"""sensor_msgs/PointField's code."""
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("intensity", "<f4")])
"""``rgb`` holds the bytes of 0x00RRGGBB; by ROS' convention its field is declared as a float of these bytes."""
FOREVER = (9223372036, 854775807)
"""Seconds and nanoseconds that ROS 2 writes for an unlimited duration."""


def write_bag(folder: Path, view: ExportedView, storage: Storage) -> None:
    """Write one view's bag into ``folder``, which must not exist: metadata.yaml and one file named like the folder.

    MCAP is compressed in chunks (zstd); sqlite3 is not, as rosbag2 knows no such thing. Raises OSError as files do.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    types = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(folder, version=BAG_VERSION, storage_plugin=plugin)
    if storage == "mcap":
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def write(topic: str, stamp_ns: int, message: Any) -> None:
        writer.write(topics[topic], stamp_ns, types.serialize_cdr(message, topics[topic].msgtype))

    try:
        with writer:
            topics = {
                topic: writer.add_connection(topic, kind, typestore=types, offered_qos_profiles=_qos(latched))
                for topic, kind, latched in (
                    (POSE_TOPIC, "tf2_msgs/msg/TFMessage", True),
                    (INFO_TOPIC, "sensor_msgs/msg/CameraInfo", False),
                    (POINTS_TOPIC, "sensor_msgs/msg/PointCloud2", False),
                )
            }
            slopes = _slopes_of(view.lens)
            write(POSE_TOPIC, view.start_ns, _pose_message(types.types, view))
            for exposure in view.exposures():
                write(INFO_TOPIC, exposure.stamp_ns, _info_message(types.types, view, exposure.stamp_ns))
                write(POINTS_TOPIC, exposure.stamp_ns, _cloud_message(types.types, view, exposure, slopes))
    except sqlite3.OperationalError as error:
        # SQLite hides the system's error number; of a new file in our own folder it complains for want of space only
        raise OSError(errno.ENOSPC, str(error), str(folder)) from error


@lru_cache(maxsize=1)
def _slopes_of(lens: Lens) -> np.ndarray:
    """Return (h, w, 2) of the whole sensor: the views of an export share their lens."""
    return lens.region_slopes(lens.whole)


def frame_name(view: ExportedView) -> str:
    """Return the name of a camera's optical frame; each view has its own, so that bags can be played together."""
    return f"{view.name}_depth_optical_frame"


def packed_points(exposure: Exposure, slopes: np.ndarray) -> np.ndarray:
    """Return (h, w) of `POINT`: z of the camera, x and y along the lens' rays; all NaN where there is no range.

    ``slopes`` (h, w, 2) of the whole sensor. Rounding to float32 moves x and y by 0.03 um a metre.
    """
    points = np.zeros(exposure.z_m.shape, POINT)
    x_y = slopes * exposure.z_m[..., None].astype(np.float64)
    points["x"], points["y"], points["z"] = x_y[..., 0], x_y[..., 1], exposure.z_m
    red, green, blue = np.moveaxis(exposure.rgb.astype(np.uint32), -1, 0)
    points["rgb"] = red << 16 | green << 8 | blue
    points["intensity"] = exposure.amplitude
    return points


# ---- messages --------------------------------------------------------------------------------------------------------


def _header(types: dict[str, Any], frame: str, stamp_ns: int) -> Any:
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _cloud_message(types: dict[str, Any], view: ExportedView, exposure: Exposure, slopes: np.ndarray) -> Any:
    points = packed_points(exposure, slopes)
    field = types["sensor_msgs/msg/PointField"]
    height, width = points.shape
    return types["sensor_msgs/msg/PointCloud2"](
        header=_header(types, frame_name(view), exposure.stamp_ns),
        height=height,
        width=width,
        fields=[field(name=name, offset=i * 4, datatype=FLOAT32, count=1) for i, name in enumerate(POINT.names or ())],
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * width,
        data=points.reshape(-1).view(np.uint8),
        is_dense=False,
    )


def _info_message(types: dict[str, Any], view: ExportedView, stamp_ns: int) -> Any:
    """The lens in ROS' terms: D in OpenCV's order k1 k2 p1 p2 k3 .. k6; P is K, as the cloud is not rectified."""
    lens = view.lens
    distorted = any(lens.distortion)
    region = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return types["sensor_msgs/msg/CameraInfo"](
        header=_header(types, frame_name(view), stamp_ns),
        height=lens.height,
        width=lens.width,
        distortion_model="rational_polynomial" if distorted else "plumb_bob",
        d=np.array(lens.distortion if distorted else (0.0,) * 5),
        k=lens.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.concatenate([lens.matrix, np.zeros((3, 1))], axis=1).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def _pose_message(types: dict[str, Any], view: ExportedView) -> Any:
    x, y, z, w = quaternion_of(view.T_board_camera)
    shift = types["geometry_msgs/msg/Vector3"](**dict(zip("xyz", view.T_board_camera[:3, 3].tolist(), strict=True)))
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    transform = types["geometry_msgs/msg/TransformStamped"](
        header=_header(types, BOARD_FRAME, view.start_ns),
        child_frame_id=frame_name(view),
        transform=types["geometry_msgs/msg/Transform"](translation=shift, rotation=turn),
    )
    return types["tf2_msgs/msg/TFMessage"](transforms=[transform])


def _qos(latched: bool) -> tuple[Any, ...]:
    """Reliable, the last ten; a latched topic is kept for those who subscribe later, as tf_static must be."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    endless = QosTime(*FOREVER)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return (
        Qos(
            history=QosHistory.KEEP_LAST,
            depth=10,
            reliability=QosReliability.RELIABLE,
            durability=durability,
            deadline=endless,
            lifespan=endless,
            liveliness=QosLiveliness.AUTOMATIC,
            liveliness_lease_duration=endless,
            avoid_ros_namespace_conventions=False,
        ),
    )
