"""ROS 2 bags (folder, .db3, .mcap) with sensor_msgs/PointCloud2 as captures; the thesis recorded ``points2``.

Where the bag holds a CameraInfo of the cloud's size whose rays pass through the cloud's points, z and that lens are
used: then a pixel's ray is the same in all frames, as it was in the camera, and not rounded anew in each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from detectors.recordings.bag_files import LEGAL_BAG, Bag, find_bag, messages, topics_of
from detectors.recordings.distances import UNITS_M, rounding_step_m
from detectors.recordings.intrinsics import KNOWN_MODELS, read_lens
from detectors.recordings.point_messages import frame_from_message
from detectors.recordings.recording import Recording, slopes_of
from harness.vocabulary.capture import Frame
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
USUAL_TOPIC = "points2"
RAY_TOLERANCE_PX = 0.01
"""A lens counts where each point lies within this of its pixel's ray: 14 um at 0.7 m with the Azure Kinect's focal
length, three hundred times what float32 leaves of it."""


@dataclass(frozen=True)
class BagReader:
    """Streams the clouds of one topic, one frame a message. ``has_lens``: x and y come from the lens."""

    bag: Bag
    topic: str
    scale_m: float
    has_lens: bool

    def frames(self) -> Iterator[Frame]:
        for name, message in messages(self.bag, self.topic):
            frame = frame_from_message(name, message, self.scale_m)
            yield replace(frame, xy_m=None) if self.has_lens else frame


def open_bag(
    path: Path, scale_m: float | None, intrinsics: Path | None, lens: Lens | None, topic: str | None
) -> Recording:
    """Open a bag's clouds. ``topic``: which of several topics with clouds. A lens that is given must fit the points.

    Raises UserError where the bag is broken or empty, has no such topic, or the topic holds something else.
    """
    bag = find_bag(path)
    topics = topics_of(bag)
    chosen = _chosen_topic(path, topics, topic)
    scale_m = scale_m or UNITS_M["m"]
    first = next(BagReader(bag, chosen, scale_m, has_lens=False).frames(), None)
    if first is None:
        raise UserError(f"{path}: no message on {chosen}", legal="at least one cloud", fix="record again")
    height, width = first.z_m.shape
    lens = read_lens(intrinsics, width, height) if intrinsics else lens
    notes: tuple[str, ...] = ()
    if lens is not None:
        _refuse_other_rays(path, lens, first)
    else:
        lens, notes = _lens_in_bag(bag, topics, first)
    files = (*bag.files, *((bag.metadata,) if bag.metadata else ()), *((intrinsics,) if intrinsics else ()))
    return Recording(
        name=bag.name,
        reader=BagReader(bag, chosen, scale_m, has_lens=lens is not None),
        region=Region(0, height, 0, width),
        scale_m=scale_m,
        z_step_m=rounding_step_m(first.z_m),
        files=files,
        lens=lens,
        organised=height > 1,
        notes=notes,
    )


def _chosen_topic(path: Path, topics: dict[str, str], asked: str | None) -> str:
    clouds = [topic for topic, kind in topics.items() if kind == CLOUD_TYPE]
    held = ", ".join(f"{topic} ({kind})" for topic, kind in topics.items()) or "none"
    if asked is not None:
        name = asked if asked in topics else f"/{asked}"
        if name not in topics:
            raise UserError(f"{path}: no topic {asked}; its topics: {held}", legal=", ".join(clouds) or LEGAL_BAG)
        if topics[name] != CLOUD_TYPE:
            raise UserError(f"{path}: {name} holds {topics[name]}", legal=f"a topic with {CLOUD_TYPE}")
        return name
    if not clouds:
        raise UserError(
            f"{path}: no topic with {CLOUD_TYPE}; its topics: {held}",
            legal=f"a bag with clouds, usually on /{USUAL_TOPIC}",
            fix=f"record it with the camera's clouds: ros2 bag record /{USUAL_TOPIC} /depth/camera_info",
        )
    usual = [topic for topic in clouds if topic.removeprefix("/") == USUAL_TOPIC]
    if len(usual) == 1 or len(clouds) == 1:
        return (usual or clouds)[0]
    raise UserError(f"{path}: {len(clouds)} topics hold clouds", legal=", ".join(clouds), fix="choose one by --topic")


# ---- the lens --------------------------------------------------------------------------------------------------------


def _lens_in_bag(bag: Bag, topics: dict[str, str], frame: Frame) -> tuple[Lens | None, tuple[str, ...]]:
    """The first CameraInfo's lens that fits the points, and what the user should know."""
    if frame.z_m.shape[0] == 1:
        return None, ("the cloud has no pixel grid; it is treated as single points",)
    for topic in (topic for topic, kind in topics.items() if kind == INFO_TYPE):
        _, message = next(messages(bag, topic), ("", None))
        lens = _lens_of(message, frame.z_m.shape) if message is not None else None
        if lens is not None and _off_ray_px(lens, frame) <= RAY_TOLERANCE_PX:
            return lens, ()
    return None, ("no CameraInfo in the bag fits the points; each frame's own x and y are averaged",)


def _lens_of(message: Any, shape: tuple[int, ...]) -> Lens | None:
    """The lens of a CameraInfo for images of a shape; None where it is of another size or model."""
    if (message.height, message.width) != shape or message.distortion_model not in KNOWN_MODELS:
        return None
    d = tuple(float(value) for value in message.d)
    if len(d) not in (0, 4, 5, 8) or not np.isfinite([*d, *message.k]).all() or message.k[0] <= 0 or message.k[4] <= 0:
        return None
    fx, fy, cx, cy = (float(message.k[i]) for i in (0, 4, 2, 5))
    return Lens(message.width, message.height, fx, fy, cx, cy, (d + (0.0,) * 8)[:8])


def _off_ray_px(lens: Lens, frame: Frame) -> float:
    """How far the worst point of a frame lies from its pixel's ray."""
    assert frame.xy_m is not None
    valid = np.isfinite(frame.z_m)
    if not valid.any():
        return float("inf")
    slopes = slopes_of(lens, lens.whole)[valid]
    off = np.abs(frame.xy_m[valid] / frame.z_m[valid][:, None].astype(np.float64) - slopes) * (lens.fx, lens.fy)
    worst = float(off.max())
    return worst if np.isfinite(worst) else float("inf")


def _refuse_other_rays(path: Path, lens: Lens, frame: Frame) -> None:
    """Raise UserError where a lens that the user named is not the one that the points were made with."""
    if (lens.height, lens.width) != frame.z_m.shape:
        height, width = frame.z_m.shape
        raise UserError(f"{path}: clouds of {width} x {height} points, but the lens is of {lens.width} x {lens.height}")
    off = _off_ray_px(lens, frame)
    if off > RAY_TOLERANCE_PX:
        raise UserError(
            f"{path}: the named lens is not that of these points: they lie up to {off:.2g} pixels beside its rays",
            fix="leave --intrinsics out: the points are used as they stand",
        )
