"""sensor_msgs/PointCloud2: a message's bytes as points, whatever its layout (ROS' common_interfaces, REP 103)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from detectors.recordings.distances import frame_from_points
from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError

FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""PointField's codes."""
AMPLITUDE_FIELDS = ("intensity", "amplitude", "i")
LEGAL_CLOUD = "sensor_msgs/PointCloud2 with the fields x, y, z, each a single number"


def frame_from_message(name: str, message: Any, scale_m: float) -> Frame:
    """A PointCloud2 as a frame (h, w), or (1, n) without a grid. NaN and (0, 0, 0) mean no return.

    Fields may lie anywhere in a point, be of any numeric type and byte order, and rows may be padded. Raises UserError
    where x, y or z is missing, a field lies outside its point, or the data are shorter than the layout needs.
    """
    points = structured(name, message)
    have = points.dtype.names or ()
    stored = np.stack([points[axis] for axis in "xyz"], axis=-1)
    if stored.dtype.kind == "f":
        stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
    amplitude = next((points[field].astype(np.float32) for field in AMPLITUDE_FIELDS if field in have), None)
    frame = frame_from_points(name, stored, scale_m, rgb=_colours(points), amplitude=amplitude)
    # NaN is this message's code for "no return" (REP 118), which other files write as 0
    frame.reason[frame.reason == Reason.NOT_FINITE] = Reason.NO_RETURN
    return frame


def structured(name: str, message: Any) -> np.ndarray:
    """(height, width) structured array over the message's data: a view, not a copy. Raises UserError as above."""
    height, width, step, row = (int(n) for n in (message.height, message.width, message.point_step, message.row_step))
    if height * width == 0:
        raise UserError(f"{name}: holds no points ({width} x {height})", legal=LEGAL_CLOUD)
    row = row if height > 1 or row else width * step
    data = np.asarray(message.data, np.uint8)
    needed = (height - 1) * row + width * step
    if row < width * step:
        raise UserError(f"{name}: rows of {row} bytes cannot hold {width} points of {step} bytes", legal=LEGAL_CLOUD)
    if data.size < needed:
        raise UserError(
            f"{name}: is truncated: {data.size} bytes of points, but {width} x {height} points of {step} bytes"
            f" in rows of {row} need {needed}",
            legal="height * row_step bytes",
            fix="record or convert it again",
        )
    layout = _layout(name, message, step)
    return np.ndarray((height, width), layout, data.data, strides=(row, step))


def _layout(name: str, message: Any, step: int) -> np.dtype:
    """The fields with one number each as a structured type of ``step`` bytes."""
    order = ">" if message.is_bigendian else "<"
    # some drivers leave count at 0 where they mean 1
    single = {f.name: f for f in message.fields if f.count <= 1 and f.datatype in FIELD_TYPES}
    missing = [axis for axis in "xyz" if axis not in single]
    if missing:
        held = ", ".join(f"{f.name} (type {f.datatype}, count {f.count})" for f in message.fields) or "none"
        raise UserError(f"{name}: has no field {' or '.join(missing)}; its fields: {held}", legal=LEGAL_CLOUD)
    types = {key: np.dtype(order + FIELD_TYPES[f.datatype]) for key, f in single.items()}
    for key, field in single.items():
        if field.offset + types[key].itemsize > step:
            raise UserError(
                f"{name}: its field {key} ends at byte {field.offset + types[key].itemsize} of points of {step} bytes",
                legal=LEGAL_CLOUD,
            )
    for key in ("rgb", "rgba"):
        # four packed bytes, whatever the field calls them
        if key in types and types[key].itemsize == 4:
            types[key] = np.dtype(order + "u4")
    return np.dtype(
        {
            "names": list(types),
            "formats": list(types.values()),
            "offsets": [single[key].offset for key in types],
            "itemsize": step,
        }
    )


def _colours(points: np.ndarray) -> np.ndarray | None:
    """(h, w, 3) uint8 from 0x00RRGGBB packed in ``rgb`` or ``rgba``, or from the bytes ``r``, ``g``, ``b``."""
    have: Mapping[str, Any] = points.dtype.fields or {}
    packed = next((key for key in ("rgb", "rgba") if key in have and have[key][0].kind == "u"), None)
    if packed is not None and have[packed][0].itemsize == 4:
        bits = points[packed].astype(np.uint32)
        return np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=-1).astype(np.uint8)
    if all(key in have and have[key][0] == np.uint8 for key in "rgb"):
        return np.stack([points[key] for key in "rgb"], axis=-1)
    return None
