"""ROS bags (ROS 2: folder, .db3, .mcap; ROS 1: .bag) with depth images or sensor_msgs/PointCloud2
as captures.

``rosbags`` unpacks whole chunks, so it runs within `files.limited_memory`. A depth image needs the
CameraInfo that its driver publishes with it. If the rays of a CameraInfo pass through a cloud's
points, z and that lens are used: a pixel's ray is then the same in all frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.recordings.depth_images import NOT_DEPTH
from detectors.recordings.distances import UNITS_M, default_metres
from detectors.recordings.intrinsics import KNOWN_MODELS, LEGAL_LENS, lens_for, read_lens
from detectors.recordings.messages import DEPTH_NUMBERS, encoding_of, frame_of_message, stored_depth
from detectors.recordings.recording import NO_GRID, CaptureOptions, Recording, read_errors
from harness.vocabulary.declaration.yaml_source import MAX_BYTES, read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader

BAG_SUFFIXES = (".mcap", ".db3")
ROS1_SUFFIX = ".bag"
METADATA = "metadata.yaml"
LEGAL_BAG = "a ROS 2 bag (its folder with metadata.yaml, one .db3 or one .mcap) or a .bag of ROS 1"
MAX_MESSAGE_BYTES = 2**28  # 256 MiB: a cloud of four million points with 64 bytes each


@dataclass(frozen=True)
class Bag:
    """A ROS bag, as its recorder left it."""

    # the folder or file that the user names
    path: Path
    # the files that hold the messages, in order
    files: tuple[Path, ...]
    # the description in a folder of ROS 2
    metadata: Path | None = None

    @cached_property
    def topics(self) -> dict[str, str]:
        """Return the message type of each topic, sorted; the last of several types."""
        with self._opened() as reader:
            pairs = [(connection.topic, connection.msgtype) for connection in reader.connections]
        return dict(sorted(pairs))

    def first(self, topic: str) -> Any:
        """Return the first message of a topic, None if it has none."""
        return next(self.messages(topic), ("", None))[1]

    def messages(self, topic: str) -> Iterator[tuple[str, Any]]:
        """Yield (name, message) of a topic in the order of their times within each file, one held
        at a time. Raises UserError if a file is damaged or a message is larger than
        `MAX_MESSAGE_BYTES`."""
        types = _types(self._is_ros1)
        decode = types.deserialize_ros1 if self._is_ros1 else types.deserialize_cdr
        with self._opened() as reader:
            wanted = [connection for connection in reader.connections if connection.topic == topic]
            stored_messages = reader.messages(wanted) if wanted else iter(())
            for number in count():
                name = f"{self.path.name} {topic} message {number}"
                with self._readable():
                    item = next(stored_messages, None)
                    if item is None:
                        break
                    connection, _, content = item
                    if len(content) > MAX_MESSAGE_BYTES:
                        limit = f"{MAX_MESSAGE_BYTES >> 20} MiB"
                        legal = f"messages up to {limit}"
                        raise UserError(f"{name}: has more than {limit}", legal=legal)
                    message = decode(content, connection.msgtype)
                yield name, message

    @property
    def _is_ros1(self) -> bool:
        return self.path.suffix.lower() == ROS1_SUFFIX

    def _readable(self) -> AbstractContextManager[None]:
        mend = "ros2 bag reindex, or mcap recover"
        if self._is_ros1:
            mend = f"rosbag reindex {self.path}"
        files = ", ".join(map(str, self.files))
        problem = f"{files}: is truncated or damaged, or is not a bag"
        fix = f"copy it again; if the recording was cut off, run: {mend}"
        return read_errors(problem, LEGAL_BAG, fix)

    @contextmanager
    def _opened(self) -> Iterator[Reader | Ros1Reader]:
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader

        with self._readable():
            reader = Ros1Reader(self.path) if self._is_ros1 else Reader(self.path)
            reader.open()
        with closing(reader):
            yield reader


@lru_cache
def _types(is_ros1: bool) -> Any:
    """Return the message types. They are kept, because the code that reads a type is made when it
    is first used."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_JAZZY)


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag's file, or a folder with a bag, complete or not."""
    if path.is_file():
        return path.suffix.lower() in (*BAG_SUFFIXES, ROS1_SUFFIX)
    try:
        if any(_holds_messages(inside) for inside in path.iterdir()):
            return True
        metadata = path / METADATA
        if not metadata.is_file():
            return False
        return b"rosbag2_bagfile_information" in metadata.open("rb").read(MAX_BYTES)
    except OSError:
        return False


def find_bag(path: Path) -> Bag:
    """Return a folder or file as a bag. Raises UserError if its description or one of its files is
    missing."""
    if path.is_file():
        return Bag(path, (path,))
    metadata = path / METADATA
    if not metadata.is_file():
        pieces = sorted(inside.name for inside in path.iterdir() if _holds_messages(inside))
        raise UserError(
            f"{path}: has no {METADATA} (the recorder writes it when it stops), "
            f"but {', '.join(pieces)}",
            legal=LEGAL_BAG,
            fix="name that file itself, or run: ros2 bag reindex",
        )
    problem = f"{metadata}: is not a description of a ROS 2 bag, or is cut off"
    fix = "copy it again, name the .db3 or .mcap itself, or run: ros2 bag reindex"
    with read_errors(problem, LEGAL_BAG, fix):
        info = read_yaml(metadata).data["rosbag2_bagfile_information"]
        files = tuple(path / Path(name).name for name in info["relative_file_paths"])
        mode = str(info.get("compression_mode") or "none").lower()
    if mode == "file":
        fix = f"unpack it (zstd -d {files[0] if files else path}) and name the unpacked file"
        raise UserError(f"{path}: its files are compressed as a whole", legal=LEGAL_BAG, fix=fix)
    absent = []
    for file in files:
        if not file.is_file() or file.suffix.lower() not in BAG_SUFFIXES:
            absent.append(file.name)
    if absent or not files:
        raise UserError(
            f"{path}: {METADATA} names {', '.join(absent) or 'no file'}, "
            "which is missing or is not a file that can be read",
            legal=LEGAL_BAG,
            fix="copy the whole folder again",
        )
    return Bag(path, files, metadata)


def _holds_messages(path: Path) -> bool:
    return path.name.lower().removesuffix(".zstd").endswith(BAG_SUFFIXES)


CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
UNIT_TYPES = ("std_msgs/msg/Float32", "std_msgs/msg/String")
USUAL_TOPIC = "points2"
RAY_TOLERANCE_PX = 0.01
"""A lens fits if each point lies within this distance of its pixel's ray: far more than the error
of float32."""


def open_bag(path: Path, options: CaptureOptions) -> Recording:
    """Open a bag's depth images or clouds. Raises UserError if it is broken or empty, or a lens
    does not fit."""
    bag = find_bag(path)
    chosen, note = _chosen_topic(bag, options)
    if bag.first(chosen) is None:
        problem = f"{path}: no message on {chosen}"
        raise UserError(problem, legal="clouds or depth images", fix="record again")
    opener = _open_clouds if bag.topics[chosen] == CLOUD_TYPE else _open_images
    recording = opener(bag, chosen, options)
    files = (*bag.files, *filter(None, (bag.metadata, options.intrinsics)))
    return replace(recording, files=files, notes=(note, *recording.notes))


def _frames(bag: Bag, topic: str, scale_m: float, by_lens: bool) -> Iterator[Frame]:
    """Yield the images or clouds of one topic, one frame per message. ``by_lens``: x and y come
    from the lens."""
    for name, message in bag.messages(topic):
        frame = frame_of_message(name, message, scale_m)
        stamp = message.header.stamp
        frame = replace(frame, time_s=stamp.sec + 1e-9 * stamp.nanosec)
        yield replace(frame, xy_m=None) if by_lens else frame


def _open_clouds(bag: Bag, topic: str, options: CaptureOptions) -> Recording:
    scale_m = options.scale_m or UNITS_M["m"]
    first = next(_frames(bag, topic, scale_m, by_lens=False))
    height, width = first.z_m.shape
    lens = options.lens
    if options.intrinsics:
        lens = read_lens(options.intrinsics, width, height)
    note = ""
    if lens is not None:
        _refuse_misfit(bag, lens, first)
    elif height == 1:
        note = NO_GRID
    else:
        lens = _lens_of_points(bag, first)
        if lens is None:
            note = "no CameraInfo in the bag fits the points; each frame's own x and y are averaged"
    return Recording.begun(
        bag.path.name,
        partial(_frames, bag, topic, scale_m, lens is not None),
        scale_m,
        lens=lens,
        organised=height > 1,
        unit_from="ROS, whose clouds are in metres",
        notes=(note,),
    )


def _refuse_misfit(bag: Bag, lens: Lens, frame: Frame) -> None:
    """Raise UserError if a cloud's points do not lie on the rays of the lens."""
    height, width = frame.z_m.shape
    if (lens.height, lens.width) != (height, width):
        raise UserError(
            f"{bag.path}: clouds of {width} x {height} points, "
            f"but the lens is of {lens.width} x {lens.height}"
        )
    off_px = _off_ray_px(lens, frame)
    if off_px > RAY_TOLERANCE_PX:
        raise UserError(
            f"{bag.path}: the named lens does not fit these points: "
            f"they lie up to {off_px:.2g} pixels beside its rays",
            fix="leave --intrinsics out: the points are then used as they are stored",
        )


def _lens_of_points(bag: Bag, frame: Frame) -> Lens | None:
    """Return the lens of the first CameraInfo whose rays pass through a cloud's points."""
    for name, kind in bag.topics.items():
        message = bag.first(name) if kind == INFO_TYPE else None
        if message is None:
            continue
        lens = lens_of_info(message, frame.z_m.shape)
        if isinstance(lens, Lens) and _off_ray_px(lens, frame) <= RAY_TOLERANCE_PX:
            return lens
    return None


def _open_images(bag: Bag, topic: str, options: CaptureOptions) -> Recording:
    name, message = next(bag.messages(topic))
    stored = stored_depth(name, message)
    height, width = stored.shape
    is_whole = stored.dtype.kind == "u"
    capture_lens = partial(_lens_of_images, bag, topic, (height, width))
    lens, _ = lens_for(str(bag.path), options, width, height, capture_lens)
    scale_m = options.scale_m
    unit_from = "ROS, which sets millimetres for integers and metres for floating point (REP 118)"
    if scale_m is None and is_whole:
        stated = _stated_unit(bag, topic)
        if stated is not None:
            unit_from, scale_m = stated
    scale_m = scale_m or default_metres(stored.dtype)
    read = partial(_frames, bag, topic, scale_m, by_lens=False)
    return Recording.begun(bag.path.name, read, scale_m, is_whole, lens=lens, unit_from=unit_from)


def _stated_unit(bag: Bag, topic: str) -> tuple[str, float] | None:
    """Return the topic that states the unit of a depth topic, and the unit in metres: RealSense's
    recorder states it with a sensor's streams, as a number in .bag and as a text in .db3."""
    for name, kind in bag.topics.items():
        sensor, _, option = name.partition("/option/")
        is_unit = kind in UNIT_TYPES and option.startswith("Depth_Units")
        message = bag.first(name) if is_unit and topic.startswith(sensor + "/") else None
        if message is None:
            continue
        with suppress(ValueError):  # its description is a text, too
            unit_m = float(message.data)
            if 1e-6 <= unit_m <= 1:
                # the option is a float32: 0.00025 is stored as 0.00025000001
                return name, float(f"{unit_m:.6g}")
    return None


def _chosen_topic(bag: Bag, options: CaptureOptions) -> tuple[str, str]:
    """Return the topic to read, and a note on the other topics."""
    path = bag.path
    topics = bag.topics
    clouds = [topic for topic, kind in topics.items() if kind == CLOUD_TYPE]
    images = _depth_topics(bag)
    depth_topics = ", ".join([*clouds, *images])
    contents = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "none"
    kinds = f"a topic with {CLOUD_TYPE} or depth images ({', '.join(DEPTH_NUMBERS)})"
    if options.topic is not None:
        name = options.topic if options.topic in topics else f"/{options.topic}"
        if name not in topics:
            problem = f"{path}: no topic {options.topic}; its topics: {contents}"
            raise UserError(problem, legal=depth_topics or LEGAL_BAG)
        if topics[name] not in (CLOUD_TYPE, *IMAGE_TYPES):
            raise UserError(f"{path}: {name} holds {topics[name]}", legal=kinds)
        return name, ""
    if len(images) == 1:
        has_lens = options.intrinsics or options.lens or _infos_of(bag, images[0])
        if not clouds:
            return images[0], ""
        if has_lens:
            clause = f"with their lens, not the clouds on {', '.join(clouds)}; --topic chooses"
            return images[0], f"the depth images on {images[0]} are read, {clause}"
    usual = [topic for topic in clouds if topic.removeprefix("/") == USUAL_TOPIC] or clouds
    if len(usual) == 1:
        note = ""
        if images:
            note = f"the clouds on {usual[0]} are read; depth images: {', '.join(images)}"
            note += "; --topic chooses"
        return usual[0], note
    if not depth_topics:
        raise UserError(
            f"{path}: no topic with {CLOUD_TYPE} or depth images; its topics: {contents}",
            legal=kinds,
            fix="record the camera's depth with its lens: "
            "ros2 bag record /depth/image_raw /depth/camera_info",
        )
    problem = f"{len(images)} topics hold depth images"
    if clouds:
        problem = f"{len(clouds)} topics hold clouds"
    calibrated = [topic for topic in images if _infos_of(bag, topic)]
    fix = f"choose one, for instance --topic {(calibrated or images or clouds)[0]}"
    raise UserError(f"{path}: {problem}", legal=depth_topics, fix=fix)


def _depth_topics(bag: Bag) -> list[str]:
    """Return the topics whose first picture may be depth: 16-bit grey only with such a name, and
    no copies."""
    topics = []
    for topic, kind in bag.topics.items():
        if kind not in IMAGE_TYPES or NOT_DEPTH.search(topic):
            continue
        message = bag.first(topic)
        encoding = encoding_of(message) if message is not None else ""
        if encoding in DEPTH_NUMBERS and (encoding != "mono16" or "depth" in topic.lower()):
            topics.append(topic)
    # a compressed topic repeats the pictures of the plain one
    return [
        topic
        for topic in topics
        if _of_pictures(topic) == topic or _of_pictures(topic) not in topics
    ]


def _of_pictures(topic: str) -> str:
    return topic.removesuffix("/compressedDepth").removesuffix("/compressed")


def _infos_of(bag: Bag, topic: str) -> list[str]:
    """Return the CameraInfo topics that belong to a picture by name."""
    folder = _of_pictures(topic).rpartition("/")[0]
    names = (
        f"{folder}/camera_info",
        f"{folder.rpartition('/')[0]}/info/camera_info",
        f"{topic}/camera_info",
    )
    return [name for name in names if bag.topics.get(name) == INFO_TYPE]


def _lens_of_images(bag: Bag, topic: str, shape: tuple[int, ...]) -> Lens:
    """Return the lens of depth images. Raises UserError if the bag has none for them, or one of
    another model."""
    all_infos = [name for name, kind in bag.topics.items() if kind == INFO_TYPE]
    infos = _infos_of(bag, topic)
    if not infos and len(all_infos) == 1:
        infos = all_infos
    is_rectified = "rect" in _of_pictures(topic).rpartition("/")[2]
    reasons: list[str] = []
    for info in infos:
        message = bag.first(info)
        lens = "is empty" if message is None else lens_of_info(message, shape, is_rectified)
        if isinstance(lens, Lens):
            return lens
        reasons.append(f"{info} {lens}")
    fix = "pass --intrinsics FILE"
    if reasons:
        fix += ", or the rectified topic by --topic"
        reason = "; ".join(reasons)
    else:
        stated = ", ".join(all_infos) or "none"
        reason = f"no CameraInfo lies beside {topic} (the bag's: {stated})"
    raise UserError(
        f"{bag.path}: {reason}: the lens of these depth images is unknown; "
        "without it they give no points",
        legal=LEGAL_LENS,
        fix=fix,
    )


def lens_of_info(message: Any, shape: tuple[int, ...], is_rectified: bool = False) -> Lens | str:
    """Return the lens of a CameraInfo for images of a shape (h, w), or why it does not fit. A
    rectified image has the lens P and no distortion. K and P are of the whole sensor: binning and
    the region of interest are accounted for."""
    height, width = shape
    across = max(1, int(message.binning_x))
    down = max(1, int(message.binning_y))
    roi = message.roi
    full_width = message.width
    full_height = message.height
    if roi.width and roi.height:
        full_width = int(roi.width)
        full_height = int(roi.height)
    if (full_height // down, full_width // across) != (height, width):
        size = f"{full_width // across} x {full_height // down}"
        return f"is for images of {size} pixels, not {width} x {height}"
    d = _info_numbers(message, "d")
    if is_rectified or not d.any():
        d = np.zeros(0)
    model = str(message.distortion_model)
    is_counted = d.size in (4, 5, 8, 12, 14) and not d[8:].any()
    is_known = model.lower() in KNOWN_MODELS and is_counted
    if d.size and not is_known:
        model = model or "(none)"
        return f"has the distortion model {model} with {d.size} numbers, which is not supported"
    p = _info_numbers(message, "p")
    if is_rectified and p.size == 12 and p[0] > 0:
        fx, fy, cx, cy = p[[0, 5, 2, 6]]
    else:
        fx, fy, cx, cy = _info_numbers(message, "k")[[0, 4, 2, 5]]
    if not np.isfinite([*d, fx, fy, cx, cy]).all() or not (fx > 0 and fy > 0):
        return f"states the focal length {fx:g}, {fy:g}, as an uncalibrated camera does"
    distortion = np.pad(d[:8], (0, 8 - min(d.size, 8)))
    return Lens(
        width=width,
        height=height,
        fx=float(fx / across),
        fy=float(fy / down),
        # pixel positions count from the first pixel's centre, which lies half a pixel inside
        cx=float((cx - roi.x_offset + 0.5) / across - 0.5),
        cy=float((cy - roi.y_offset + 0.5) / down - 0.5),
        distortion=tuple(float(coefficient) for coefficient in distortion),
    )


def _info_numbers(message: Any, key: str) -> np.ndarray:
    """Return the numbers of a CameraInfo's matrix: ROS 1 spells it in upper case."""
    return np.asarray(getattr(message, key, getattr(message, key.upper(), ())), float)


def _off_ray_px(lens: Lens, frame: Frame) -> float:
    """Return the distance of a frame's worst point from its pixel's ray."""
    assert frame.xy_m is not None
    valid = np.isfinite(frame.z_m)
    if not valid.any():
        return float("inf")
    slopes = frame.xy_m[valid] / frame.z_m[valid][:, None].astype(np.float64)
    off = np.abs(slopes - lens.region_slopes(lens.whole)[valid]) * (lens.fx, lens.fy)
    worst = float(off.max())
    return worst if np.isfinite(worst) else float("inf")
