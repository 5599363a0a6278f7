"""Writes simulated captures in formats of other programs: TUM RGB-D, ROS 2, MCAP; images and masks
of data sets."""

import errno
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, FrameSource, Lens, Reason, Region, invert

# time of the first frame, in 2001; 0 would mean "the latest" to ROS's tf
START_NS = 1_000_000_000 * 10**9
PAUSE_NS = 10**9  # time between two views to move the camera
# the world frame: x along the row of holes, y up the face, z out of it, origin at its centre
BOARD_FRAME = "board"


@dataclass(frozen=True)
class ExportedView:
    """Frames of a view."""

    name: str
    source: FrameSource
    """The frames, with a lens and a pixel grid."""
    T_board_camera: np.ndarray
    """Pose (4, 4) of the camera in the board's frame."""
    n_frames: int
    frames_per_second: float
    start_ns: int
    """Time of the first frame."""

    @property
    def lens(self) -> Lens:
        """The lens of the whole sensor."""
        lens = self.source.lens
        assert lens is not None, "only simulated cameras are exported, and they have a lens"
        return lens

    def stamp_ns(self, frame: int) -> int:
        """Return the time of a frame."""
        return self.start_ns + round(frame * 1e9 / self.frames_per_second)

    def exposures(self) -> Iterator[tuple[int, Frame]]:
        """Yield (time, frame on the whole sensor in float32), without range and black outside the
        simulated region."""
        lens = self.lens
        region = self.source.region

        def on_sensor(values: np.ndarray, outside: float) -> np.ndarray:
            return on_window(values, region, lens.whole, outside)

        for number, frame in enumerate(self.source.frames()):
            rgb = frame.rgb
            if rgb is None:
                rgb = np.zeros((*region.shape, 3), np.uint8)
            amplitude = frame.amplitude
            if amplitude is None:
                amplitude = np.full(region.shape, np.nan)
            on_whole_sensor = Frame(
                frame.name,
                on_sensor(frame.z_m.astype(np.float32), np.nan),
                on_sensor(frame.reason, Reason.OUTSIDE_MASK),
                rgb=on_sensor(rgb, 0),
                amplitude=on_sensor(amplitude.astype(np.float32), np.nan),
            )
            yield self.stamp_ns(number), on_whole_sensor


def on_window(values: np.ndarray, region: Region, window: Region, outside: float) -> np.ndarray:
    """Return values (h, w, ...) of a sensor region on a ``window`` that contains it, with
    ``outside`` elsewhere."""
    image = np.full((*window.shape, *values.shape[2:]), outside, values.dtype)
    image[region.within(window)] = values
    return image


def in_turn(
    sources: Sequence[FrameSource],
    poses: Sequence[np.ndarray],
    n_frames: int,
    frames_per_second: float,
) -> tuple[ExportedView, ...]:
    """Put views in sequence, named ``view_00`` and so on; ``poses`` are their
    ``T_camera_board``."""
    digits = max(2, len(str(len(sources) - 1)))
    length_ns = round(n_frames * 1e9 / frames_per_second) + PAUSE_NS
    views = []
    for number, (source, pose) in enumerate(zip(sources, poses, strict=True)):
        view = ExportedView(
            name=f"view_{number:0{digits}d}",
            source=source,
            T_board_camera=invert(pose),
            n_frames=n_frames,
            frames_per_second=frames_per_second,
            start_ns=START_NS + number * length_ns,
        )
        views.append(view)
    return tuple(views)


def quaternion_of(T_a_b: np.ndarray) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of a rigid transform's rotation, w >= 0, of unit length."""
    x, y, z, w = Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True).tolist()
    return x, y, z, w


# ---------------------------------------------------------------- TUM RGB-D


UNITS_PER_M = 5000  # the benchmark's depth scale
FARTHEST_M = (2**16 - 1) / UNITS_PER_M
CALIBRATION = "rtabmap_calib.yaml"
# the (3, 4) matrix from the camera's optical frame (z forward, y down) to RTAB-Map's base (x
# forward, z up)
OPTICAL_ROTATION = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]])


def write_tum(folder: Path, views: Sequence[ExportedView]) -> None:
    """Write a sequence of all views to an empty folder. Raises UserError if two views have
    different lenses."""
    lens = views[0].lens
    if any(view.lens != lens for view in views):
        raise UserError("the TUM RGB-D layout allows a single lens, but these views have several")
    for name in ("rgb", "depth"):
        (folder / name).mkdir()
    lines: dict[str, list[str]] = {
        "rgb.txt": ["# color images", "# timestamp filename"],
        "depth.txt": ["# depth maps, 5000 to the metre, 0: none", "# timestamp filename"],
        "groundtruth.txt": ["# camera in the board's frame", "# timestamp tx ty tz qx qy qz qw"],
        "associations.txt": [],
    }
    for view in views:
        pose = (*view.T_board_camera[:3, 3], *quaternion_of(view.T_board_camera))
        pose_text = " ".join(f"{value:.9g}" for value in pose)
        for stamp_ns, frame in view.exposures():
            assert frame.rgb is not None
            time = seconds_text(stamp_ns)
            pictures = {"rgb": frame.rgb[..., ::-1], "depth": depth_units(frame.z_m)}
            for name, picture in pictures.items():
                content = picture_bytes(".png", undistorted(lens, picture))
                (folder / name / f"{time}.png").write_bytes(content)
                lines[f"{name}.txt"].append(f"{time} {name}/{time}.png")
            lines["associations.txt"].append(f"{time} rgb/{time}.png {time} depth/{time}.png")
            lines["groundtruth.txt"].append(f"{time} {pose_text}")
    for name, text in lines.items():
        (folder / name).write_text("\n".join((*text, "")), encoding="utf-8")
    for name in ("rgb", "depth"):
        system.link_or_copy(folder / name, folder / f"{name}_sync")
    (folder / CALIBRATION).write_text(calibration_text(lens), encoding="utf-8")


def depth_units(z_m: np.ndarray) -> np.ndarray:
    """Return (h, w) uint16 in units of 0.2 mm; 0 without range, or beyond the 13.1 m that 16 bits
    hold."""
    with np.errstate(invalid="ignore"):
        is_storable = (z_m > 0) & (z_m <= FARTHEST_M)
    stored_m = np.where(is_storable, z_m, 0.0).astype(np.float64)
    return np.rint(stored_m * UNITS_PER_M).astype(np.uint16)


def undistorted(lens: Lens, picture: np.ndarray) -> np.ndarray:
    """Return a picture (h, w[, 3]) for the pinhole camera, from the nearest pixels of the lens's
    own image, else 0."""
    matrix = lens.matrix
    size = (lens.width, lens.height)
    u, v = cv2.initUndistortRectifyMap(
        matrix, np.array(lens.distortion), np.eye(3), matrix, size, cv2.CV_32FC1
    )
    return cv2.remap(np.ascontiguousarray(picture), np.rint(u), np.rint(v), cv2.INTER_NEAREST)


def seconds_text(stamp_ns: int) -> str:
    """Return a time in the benchmark's format: seconds with six digits, exact to the
    microsecond."""
    microseconds = (stamp_ns + 500) // 1000
    return f"{microseconds // 10**6}.{microseconds % 10**6:06d}"


def calibration_text(lens: Lens) -> str:
    """Return the pinhole camera as RTAB-Map's calibration file (OpenCV's YAML with ROS names)."""
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    facts: dict[str, Any] = {
        "camera_name": "rtabmap_calib",
        "image_width": lens.width,
        "image_height": lens.height,
        "camera_matrix": lens.matrix,
        "distortion_model": "plumb_bob",
        "distortion_coefficients": np.zeros((1, 5)),
        "rectification_matrix": np.eye(3),
        "projection_matrix": np.pad(lens.matrix, ((0, 0), (0, 1))),
        "local_transform": OPTICAL_ROTATION * 1.0,
    }
    for name, value in facts.items():
        storage.write(name, value)
    return str(storage.releaseAndGetString())


# ---------------------------------------------------------------- ROS 2 bags


POINTS_TOPIC = "/points2"
INFO_TOPIC = "/depth/camera_info"
POSE_TOPIC = "/tf_static"
# version of metadata.yaml: the oldest that the library writes; later ROS versions read it too
BAG_VERSION: Literal[8] = 8
FLOAT32 = 7  # sensor_msgs/PointField's code
# ``rgb`` holds the bytes of 0x00RRGGBB; by ROS's convention, its field is declared as a float of
# these bytes
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4"), ("intensity", "<f4")])
FOREVER = (9223372036, 854775807)  # seconds and nanoseconds of an unlimited duration in ROS 2


def write_bag(folder: Path, view: ExportedView, is_mcap: bool) -> None:
    """Write a view's bag to a new ``folder``, as compressed MCAP or as SQLite. Raises OSError as
    files do."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    plugin = StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3
    types = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(folder, version=BAG_VERSION, storage_plugin=plugin)
    if is_mcap:
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)

    def connection(topic: str, kind: str, latched: bool = False) -> Any:
        return writer.add_connection(
            topic, kind, typestore=types, offered_qos_profiles=_qos(latched)
        )

    def write(topic: Any, stamp_ns: int, message: Any) -> None:
        writer.write(topic, stamp_ns, types.serialize_cdr(message, topic.msgtype))

    try:
        with writer:
            poses = connection(POSE_TOPIC, "tf2_msgs/msg/TFMessage", latched=True)
            lenses = connection(INFO_TOPIC, "sensor_msgs/msg/CameraInfo")
            clouds = connection(POINTS_TOPIC, "sensor_msgs/msg/PointCloud2")
            slopes = view.lens.region_slopes(view.lens.whole)
            write(poses, view.start_ns, _pose_message(types.types, view))
            for stamp_ns, frame in view.exposures():
                header = _header(types.types, frame_name(view), stamp_ns)
                write(lenses, stamp_ns, _info_message(types.types, view.lens, header))
                write(clouds, stamp_ns, _cloud_message(types.types, frame, slopes, header))
    except sqlite3.OperationalError as error:
        # SQLite hides the system's error number; for a new file in a writable folder, only a full
        # disk is an error
        raise OSError(errno.ENOSPC, str(error), str(folder)) from error


def frame_name(view: ExportedView) -> str:
    """Return the name of a view's optical frame; different names let bags be played together."""
    return f"{view.name}_depth_optical_frame"


def _header(types: dict[str, Any], frame: str, stamp_ns: int) -> Any:
    time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)


def _cloud_message(types: dict[str, Any], frame: Frame, slopes: np.ndarray, header: Any) -> Any:
    """Return the frame as `POINT`: z of the camera, x and y along ``slopes`` (h, w, 2); NaN
    without range."""
    assert frame.rgb is not None
    points = np.zeros(frame.z_m.shape, POINT)
    x_y = slopes * frame.z_m[..., None].astype(np.float64)
    points["x"] = x_y[..., 0]
    points["y"] = x_y[..., 1]
    points["z"] = frame.z_m
    red, green, blue = np.moveaxis(frame.rgb.astype(np.uint32), -1, 0)
    points["rgb"] = red << 16 | green << 8 | blue
    points["intensity"] = frame.amplitude
    field = types["sensor_msgs/msg/PointField"]
    fields = [
        field(name=name, offset=4 * number, datatype=FLOAT32, count=1)
        for number, name in enumerate(POINT.names or ())
    ]
    height, width = frame.z_m.shape
    return types["sensor_msgs/msg/PointCloud2"](
        header=header,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=False,
        point_step=POINT.itemsize,
        row_step=POINT.itemsize * width,
        data=points.reshape(-1).view(np.uint8),
        is_dense=False,
    )


def _info_message(types: dict[str, Any], lens: Lens, header: Any) -> Any:
    """Return the lens in ROS's terms: D in OpenCV's order k1 k2 p1 p2 k3 .. k6; P is K, as clouds
    are not rectified."""
    distorted = any(lens.distortion)
    region = types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
    )
    return types["sensor_msgs/msg/CameraInfo"](
        header=header,
        height=lens.height,
        width=lens.width,
        distortion_model="rational_polynomial" if distorted else "plumb_bob",
        d=np.array(lens.distortion if distorted else (0.0,) * 5),
        k=lens.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.pad(lens.matrix, ((0, 0), (0, 1))).ravel(),
        binning_x=0,
        binning_y=0,
        roi=region,
    )


def _pose_message(types: dict[str, Any], view: ExportedView) -> Any:
    x, y, z = view.T_board_camera[:3, 3].tolist()
    shift = types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)
    x, y, z, w = quaternion_of(view.T_board_camera)
    turn = types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
    transform = types["geometry_msgs/msg/TransformStamped"](
        header=_header(types, BOARD_FRAME, view.start_ns),
        child_frame_id=frame_name(view),
        transform=types["geometry_msgs/msg/Transform"](translation=shift, rotation=turn),
    )
    return types["tf2_msgs/msg/TFMessage"](transforms=[transform])


def _qos(latched: bool) -> tuple[Any, ...]:
    """Return a reliable profile, history of ten; a latched topic is kept for later subscribers, as
    tf_static needs."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    endless = QosTime(sec=FOREVER[0], nsec=FOREVER[1])
    profile = Qos(
        history=QosHistory.KEEP_LAST,
        depth=10,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=endless,
        lifespan=endless,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=endless,
        avoid_ros_namespace_conventions=False,
    )
    return (profile,)


# ---------------------------------------------------------------- pictures and masks of data sets


def picture_bytes(kind: Literal[".png", ".tiff"], picture: np.ndarray) -> bytes:
    """Encode a picture (h, w[, 3]) as PNG of 8 or 16 bits or plain TIFF of float32; channels in
    OpenCV's order."""
    plain = [cv2.IMWRITE_TIFF_COMPRESSION, 1] if kind == ".tiff" else []
    coded, content = cv2.imencode(kind, np.ascontiguousarray(picture), plain)
    assert coded
    return content.tobytes()


def run_lengths(mask: np.ndarray) -> list[int]:
    """Return COCO's uncompressed run lengths of a mask (h, w) bool: pixels outside, inside,
    outside ..., by columns."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs = np.diff([0, *changes, flat.size]).tolist()
    return [0, *runs] if flat[0] else runs


def coco_data(
    pictures: Sequence[dict[str, Any]], kinds: Sequence[str], licence_facts: dict[str, Any]
) -> dict[str, Any]:
    """Return a COCO file's content. Each of the ``pictures`` has ``file_name``, ``width``,
    ``height`` and ``damages``, which have ``kind``, ``run_lengths``, ``bbox`` (left, top, width,
    height) and ``pixels``."""
    numbers = {kind: number for number, kind in enumerate(kinds, start=1)}
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for number, picture in enumerate(pictures, start=1):
        width = picture["width"]
        height = picture["height"]
        file_name = picture["file_name"]
        images.append({"id": number, "file_name": file_name, "width": width, "height": height})
        for damage in picture["damages"]:
            annotation = {
                "id": len(annotations) + 1,
                "image_id": number,
                "category_id": numbers[damage["kind"]],
                "area": damage["pixels"],
                "bbox": damage["bbox"],
                "segmentation": {"size": [height, width], "counts": damage["run_lengths"]},
                "iscrowd": 0,
            }
            annotations.append(annotation)
    categories = [{"id": number, "name": kind} for kind, number in numbers.items()]
    return {
        "info": licence_facts,
        "images": images,
        "annotations": annotations,
        "categories": categories,
    }
