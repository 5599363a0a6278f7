"""ROS bags (ROS 2: folder, .db3, .mcap; ROS 1: .bag) with depth images or sensor_msgs/PointCloud2 as captures.

A depth image needs the CameraInfo that its driver publishes beside it. Where a bag of clouds (the thesis recorded
``points2``) holds a CameraInfo of the cloud's size whose rays pass through the cloud's points, z and that lens are
used: then a pixel's ray is the same in all frames, as it was in the camera, and not rounded anew in each.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from detectors.recordings.bag_files import LEGAL_BAG, Bag, find_bag
from detectors.recordings.distances import UNITS_M, default_metres, rounding_step_m
from detectors.recordings.intrinsics import KNOWN_MODELS, LEGAL_LENS, lens_for, read_lens
from detectors.recordings.messages import DEPTH_NUMBERS, encoding_of, frame_of_message, stored_depth
from detectors.recordings.recording import NO_GRID, Asked, Recording, slopes_of
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
UNIT_TYPE = "std_msgs/msg/Float32"
USUAL_TOPIC = "points2"
NOT_DEPTH = re.compile(r"(^|[/_])(ir|infra\w*|confidence|amplitude|intensity|reflectivity)([/_]|\d|$)", re.IGNORECASE)
"""Words in the topics of other pictures that a depth camera publishes in 16 bits or floating point."""
TRANSPORTS = ("/compressedDepth", "/compressed")
RAY_TOLERANCE_PX = 0.01
"""A lens counts where each point lies within this of its pixel's ray: 14 um at 0.7 m with the Azure Kinect's focal
length, three hundred times what float32 leaves of it."""

Topics = dict[str, str]
"""Topic to message type."""


def open_bag(path: Path, asked: Asked) -> Recording:
    """Open a bag's depth images or clouds. A lens that is given must fit clouds' points.

    Raises UserError where the bag is broken or empty, has no such topic, or the topic holds something else.
    """
    bag = find_bag(path)
    topics = bag.topics()
    chosen, notes = _chosen_topic(path, bag, topics, asked)
    opened = _open_clouds if topics[chosen] == CLOUD_TYPE else _open_images
    recording = opened(path, bag, topics, chosen, asked)
    files = (*bag.files, *filter(None, (bag.metadata, asked.intrinsics)))
    return replace(recording, files=files, notes=(*notes, *recording.notes))


def _frames(bag: Bag, topic: str, scale_m: float, by_lens: bool) -> Iterator[Frame]:
    """Yield the images or clouds of one topic, a frame a message. ``by_lens``: x and y come from the lens."""
    for name, message in bag.messages(topic):
        frame = frame_of_message(name, message, scale_m)
        yield replace(frame, xy_m=None) if by_lens else frame


def _open_clouds(path: Path, bag: Bag, topics: Topics, topic: str, asked: Asked) -> Recording:
    scale_m = asked.scale_m or UNITS_M["m"]
    first = next(_frames(bag, topic, scale_m, by_lens=False), None)
    if first is None:
        raise UserError(f"{path}: no message on {topic}", legal="at least one cloud", fix="record again")
    height, width = first.z_m.shape
    lens = read_lens(asked.intrinsics, width, height) if asked.intrinsics else asked.lens
    notes: tuple[str, ...] = ()
    if lens is not None:
        if (lens.height, lens.width) != (height, width):
            what = f"clouds of {width} x {height} points, but the lens is of {lens.width} x {lens.height}"
            raise UserError(f"{path}: {what}")
        if (off := _off_ray_px(lens, first)) > RAY_TOLERANCE_PX:
            raise UserError(
                f"{path}: the named lens is not that of these points: they lie up to {off:.2g} pixels beside its rays",
                fix="leave --intrinsics out: the points are used as they stand",
            )
    elif height == 1:
        notes = (NO_GRID,)
    else:
        for info in (name for name, kind in topics.items() if kind == INFO_TYPE):
            message = bag.first(info)
            found = lens_of_info(message, (height, width)) if message is not None else ""
            if isinstance(found, Lens) and _off_ray_px(found, first) <= RAY_TOLERANCE_PX:
                lens = found
                break
        else:
            notes = ("no CameraInfo in the bag fits the points; each frame's own x and y are averaged",)
    return Recording(
        name=bag.name,
        read=partial(_frames, bag, topic, scale_m, lens is not None),
        shape=(height, width),
        scale_m=scale_m,
        z_step_m=rounding_step_m(first.z_m),
        lens=lens,
        organised=height > 1,
        unit_from="ROS, whose clouds are in metres",
        notes=notes,
    )


def _open_images(path: Path, bag: Bag, topics: Topics, topic: str, asked: Asked) -> Recording:
    name, message = next(bag.messages(topic), ("", None))
    if message is None:
        raise UserError(f"{path}: no message on {topic}", legal="at least one depth image", fix="record again")
    stored = stored_depth(name, message)
    height, width = stored.shape
    is_whole = stored.dtype.kind == "u"

    def own() -> tuple[Lens, None]:
        return _lens_of_images(path, bag, topics, topic, (height, width)), None

    lens, _ = lens_for(str(path), asked, width, height, own)
    scale_m, unit_from = (
        asked.scale_m,
        "ROS, which sets millimetres for integers and metres for floating point (REP 118)",
    )
    for name, kind in topics.items():
        # RealSense's viewer states the unit beside a sensor's streams
        sensor, _, option = name.partition("/option/")
        is_stated = kind == UNIT_TYPE and option.startswith("Depth_Units") and topic.startswith(sensor + "/")
        if scale_m is None and is_whole and is_stated:
            message = bag.first(name)
            if message is not None and 1e-6 <= message.data <= 1:
                # the option is a float32: 0.00025 is stored as 0.00025000001
                scale_m, unit_from = float(f"{message.data:.6g}"), name
    scale_m = scale_m or default_metres(stored.dtype)
    read = partial(_frames, bag, topic, scale_m, by_lens=False)
    step_m = scale_m if is_whole else rounding_step_m(next(read()).z_m)
    return Recording(bag.name, read, (height, width), scale_m, step_m, lens=lens, unit_from=unit_from)


# ---- which topic -----------------------------------------------------------------------------------------------------


def _chosen_topic(path: Path, bag: Bag, topics: Topics, asked: Asked) -> tuple[str, tuple[str, ...]]:
    """Return the topic to read, and what the user should know of the others: the depth image with its lens, else the
    cloud."""
    clouds = [topic for topic, kind in topics.items() if kind == CLOUD_TYPE]
    images = _depth_topics(bag, topics)
    held = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "none"
    kinds = f"a topic with {CLOUD_TYPE} or depth images ({', '.join(DEPTH_NUMBERS)})"
    if asked.topic is not None:
        name = asked.topic if asked.topic in topics else f"/{asked.topic}"
        if name not in topics:
            legal = ", ".join([*clouds, *images])
            raise UserError(f"{path}: no topic {asked.topic}; its topics: {held}", legal=legal or LEGAL_BAG)
        if topics[name] not in (CLOUD_TYPE, *IMAGE_TYPES):
            raise UserError(f"{path}: {name} holds {topics[name]}", legal=kinds)
        return name, ()
    usual = [topic for topic in clouds if topic.removeprefix("/") == USUAL_TOPIC] or clouds
    has_lens = bool(asked.intrinsics or asked.lens)
    if len(images) == 1 and (not clouds or has_lens or _infos_of(topics, images[0])):
        others = ", ".join(clouds)
        note = f"the depth images on {images[0]} are read, with their lens, not the clouds on {others}; --topic chooses"
        return images[0], (note,) if clouds else ()
    if len(usual) == 1:
        note = f"the clouds on {usual[0]} are read; depth images: {', '.join(images)}; --topic chooses"
        return usual[0], (note,) if images else ()
    if not images and not clouds:
        raise UserError(
            f"{path}: no topic with {CLOUD_TYPE} or depth images; its topics: {held}",
            legal=kinds,
            fix="record the camera's depth with its lens: ros2 bag record /depth/image_raw /depth/camera_info",
        )
    own = next((topic for topic in images if _infos_of(topics, topic)), "")
    found = f"{len(clouds)} topics hold clouds" if clouds else f"{len(images)} topics hold depth images"
    raise UserError(
        f"{path}: {found}",
        legal=", ".join([*clouds, *images]),
        fix=f"choose one, for instance --topic {own or (images or clouds)[0]}",
    )


def _depth_topics(bag: Bag, topics: Topics) -> list[str]:
    """Return the topics whose first picture may be depth. 16-bit grey counts as depth only under a name that says so,
    and a compressed copy only where the pictures themselves are not in the bag."""
    found = []
    for topic, kind in topics.items():
        if kind not in IMAGE_TYPES or NOT_DEPTH.search(topic):
            continue
        message = bag.first(topic)
        encoding = encoding_of(message) if message is not None else ""
        if encoding in DEPTH_NUMBERS and (encoding != "mono16" or "depth" in topic.lower()):
            found.append(topic)
    return [topic for topic in found if _of_pictures(topic) == topic or _of_pictures(topic) not in found]


def _of_pictures(topic: str) -> str:
    """Return a topic without the name of its transport."""
    transport = next((end for end in TRANSPORTS if topic.endswith(end)), "")
    return topic.removesuffix(transport)


# ---- the lens and the unit -------------------------------------------------------------------------------------------


def _infos_of(topics: Topics, topic: str) -> list[str]:
    """Return the CameraInfo topics that belong to a picture by name: camera_info beside it; info/camera_info beside its
    folder (RealSense)."""
    folder = _of_pictures(topic).rpartition("/")[0]
    names = (f"{folder}/camera_info", f"{folder.rpartition('/')[0]}/info/camera_info", f"{topic}/camera_info")
    return [name for name in names if topics.get(name) == INFO_TYPE]


def _lens_of_images(path: Path, bag: Bag, topics: Topics, topic: str, shape: tuple[int, ...]) -> Lens:
    """Return the lens of depth images. Raises UserError where the bag has none for them, or one of another model."""
    every = [name for name, kind in topics.items() if kind == INFO_TYPE]
    why: list[str] = []
    for info in _infos_of(topics, topic) or (every if len(every) == 1 else []):
        message = bag.first(info)
        if message is None:
            continue
        lens = lens_of_info(message, shape, is_rectified="rect" in _of_pictures(topic).rpartition("/")[2])
        if isinstance(lens, Lens):
            return lens
        why.append(f"{info} {lens}")
    told = "; ".join(why) or f"no CameraInfo lies beside {topic} (the bag's: {', '.join(every) or 'none'})"
    raise UserError(
        f"{path}: {told}: nothing says which lens took these depth images, and without it they are no points",
        legal=LEGAL_LENS,
        fix=f"pass --intrinsics FILE{', or the rectified topic by --topic' if why else ''}",
    )


def lens_of_info(message: Any, shape: tuple[int, ...], is_rectified: bool = False) -> Lens | str:
    """Return the lens of a CameraInfo for images of a shape (h, w), or why it is none of theirs.

    A rectified image has the lens P and no distortion. K and P are of the whole sensor: binning and the region of
    interest are taken off. ROS 1 writes the matrices in capitals.
    """
    d, k, p = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), ())), float) for name in ("d", "k", "p")
    )
    d = np.zeros(0) if is_rectified or not d.any() else d
    model = str(message.distortion_model)
    across, down = max(1, int(message.binning_x)), max(1, int(message.binning_y))
    roi = message.roi
    width, height = (int(roi.width), int(roi.height)) if roi.width and roi.height else (message.width, message.height)
    if (height // down, width // across) != tuple(shape):
        return f"is for images of {width // across} x {height // down} pixels, not {shape[1]} x {shape[0]}"
    if d.size and (model.lower() not in KNOWN_MODELS or d.size not in (4, 5, 8, 12, 14) or d[8:].any()):
        return f"has the distortion model {model or '(none)'} with {d.size} numbers, which is not read"
    fx, fy, cx, cy = p[[0, 5, 2, 6]] if is_rectified and p.size == 12 and p[0] > 0 else k[[0, 4, 2, 5]]
    if not np.isfinite([*d, fx, fy, cx, cy]).all() or not (fx > 0 and fy > 0):
        return f"states the focal length {fx:g}, {fy:g}, as of a camera that is not calibrated"
    return Lens(
        width=shape[1],
        height=shape[0],
        fx=float(fx / across),
        fy=float(fy / down),
        # pixel positions count from the first pixel's centre, which lies half a pixel inside
        cx=float((cx - roi.x_offset + 0.5) / across - 0.5),
        cy=float((cy - roi.y_offset + 0.5) / down - 0.5),
        distortion=tuple(float(x) for x in np.pad(d[:8], (0, 8 - min(d.size, 8)))),
    )


def _off_ray_px(lens: Lens, frame: Frame) -> float:
    """Return the distance of a frame's worst point from its pixel's ray."""
    assert frame.xy_m is not None
    valid = np.isfinite(frame.z_m)
    if not valid.any():
        return float("inf")
    slopes = slopes_of(lens, lens.whole)[valid]
    off = np.abs(frame.xy_m[valid] / frame.z_m[valid][:, None].astype(np.float64) - slopes) * (lens.fx, lens.fy)
    worst = float(off.max())
    return worst if np.isfinite(worst) else float("inf")
