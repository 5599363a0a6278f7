"""ROS messages: depth images and point clouds as frames (common_interfaces, REP 103 and 118).

``compressedDepth``: twelve bytes (a format, two numbers of the quantisation), then a PNG or RVL
(Wilson 2017)."""

import struct
from typing import Any

import cv2
import numpy as np

from detectors.recordings.depth_images import PNG_SIGNATURE, decoded, refuse_broken_png
from detectors.recordings.distances import frame_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import refuse_pixels
from harness.vocabulary.geometry import Frame, Reason

FIELD_TYPES = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    8: "f8",
}  # PointField's codes
AMPLITUDE_FIELDS = ("intensity", "amplitude", "i")
LEGAL_CLOUD = "sensor_msgs/PointCloud2 with the fields x, y, z, each a single number"
DEPTH_NUMBERS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings that may hold depth: whole millimetres, or floating-point metres."""
LEGAL_IMAGE = "sensor_msgs/Image as 16UC1, mono16 or 32FC1; CompressedImage as compressedDepth (PNG or RVL) of these"
CONFIG_BYTES = 12


def encoding_of(message: Any) -> str:
    """Return the encoding of a picture's numbers: for a compressed picture that of its content, ""
    for colour."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    encoding, _, transport = str(message.format).partition(";")
    return encoding.strip() if "compressedDepth" in transport else ""


def stored_depth(name: str, message: Any) -> np.ndarray:
    """Return the stored numbers (h, w), uint16 or float32. Raises UserError if depth is missing or
    truncated."""
    encoding = encoding_of(message)
    if encoding not in DEPTH_NUMBERS:
        problem = encoding or getattr(message, "format", "")
        raise UserError(f"{name}: holds {problem[:60]!r} pictures, not depth", legal=LEGAL_IMAGE)
    if hasattr(message, "format"):
        return _unpacked(name, encoding, bytes(message.data))
    kind = np.dtype((">" if message.is_bigendian else "<") + DEPTH_NUMBERS[encoding])
    return _rows(name, message, kind, int(message.step)).astype(kind.newbyteorder("="))


def _rows(name: str, message: Any, kind: np.dtype, row_bytes: int) -> np.ndarray:
    """Return a (height, width) view of a message's data. Raises UserError if the data are too
    short."""
    height = int(message.height)
    width = int(message.width)
    refuse_pixels(name, width, height)
    data = np.asarray(message.data, np.uint8)
    if (
        row_bytes < width * kind.itemsize
        or data.size < (height - 1) * row_bytes + width * kind.itemsize
    ):
        problem = f"{data.size} bytes in rows of {row_bytes} cannot hold {width} of {kind.itemsize} bytes, {height} times"
        raise UserError(f"{name}: is truncated: {problem}", fix="record or convert it again")
    return np.ndarray((height, width), kind, data.data, strides=(row_bytes, kind.itemsize))


def _unpacked(name: str, encoding: str, data: bytes) -> np.ndarray:
    """Unpack the picture of compressedDepth. Depth of 32FC1 is stored as a / (number - b), and 0
    is no return."""
    if len(data) <= CONFIG_BYTES:
        raise UserError(
            f"{name}: is truncated ({len(data)} bytes)", legal=LEGAL_IMAGE, fix="record it again"
        )
    _, a, b = struct.unpack_from("<iff", data)
    content = data[CONFIG_BYTES:]
    if content.startswith(PNG_SIGNATURE):
        refuse_broken_png(name, content)
        stored = decoded(name, content, cv2.IMREAD_UNCHANGED)
    else:
        stored = _rvl(name, content)
    if stored.ndim != 2 or stored.dtype != np.uint16:
        raise UserError(f"{name}: its picture is not a 16-bit grey image", legal=LEGAL_IMAGE)
    if encoding != "32FC1":
        return stored
    with np.errstate(divide="ignore"):
        return np.where(
            stored == 0, np.float32(np.nan), np.float32(a) / (stored - np.float32(b))
        ).astype(np.float32)


def _rvl(name: str, content: bytes) -> np.ndarray:
    """Unpack width and height, then runs of zeros and differences, in numbers of three bits per
    nibble."""
    width, height = struct.unpack_from("<II", content.ljust(8, b"\0"))
    refuse_pixels(name, width, height)
    words = np.frombuffer(content, "<u4", (len(content) - 8) // 4, 8)
    nibbles = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).ravel()
    last = np.flatnonzero(nibbles < 8)
    first = np.concatenate([[0], last[:-1] + 1]) if last.size else last
    digit = np.arange(last[-1] + 1 if last.size else 0) - np.repeat(first, last - first + 1)
    # no number of this stream has more than seven nibbles
    parts = (nibbles[: digit.size] & 7).astype(np.int64) << 3 * np.minimum(digit, 10)
    numbers = np.add.reduceat(parts, first) if last.size else np.zeros(0, np.int64)
    filled = np.zeros(width * height, bool)
    folded: list[np.ndarray] = []
    pixel = index = 0
    while pixel < filled.size:
        run = int(numbers[index + 1]) if index + 1 < numbers.size else numbers.size
        if (
            run > numbers.size - index - 2
            or pixel + numbers[index] + run > filled.size
            or run + numbers[index] == 0
        ):
            problem = f"{name}: its RVL stream is damaged or ends too early"
            raise UserError(problem, legal=LEGAL_IMAGE, fix="record it again")
        pixel += int(numbers[index])
        filled[pixel : pixel + run] = True
        folded.append(numbers[index + 2 : index + 2 + run])
        pixel = pixel + run
        index = index + 2 + run
    differences = np.concatenate(folded)
    stored = np.zeros(filled.size, np.uint16)
    stored[filled] = np.cumsum(differences >> 1 ^ -(differences & 1)).astype(np.uint16)
    return stored.reshape(height, width)


def frame_of_message(name: str, message: Any, scale_m: float) -> Frame:
    """Convert a depth image or a PointCloud2 to a frame, (1, n) without a grid; NaN means no
    return. Raises UserError if x, y or z is missing, a field lies outside its point, or the data
    are shorter than the layout needs."""
    if not hasattr(message, "point_step"):
        frame = frame_of(name, stored_depth(name, message), scale_m)
    else:
        points = _points(name, message)
        have: Any = points.dtype.fields
        stored = np.stack([points[axis] for axis in "xyz"], axis=-1)
        if stored.dtype.kind == "f":
            stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
        rgb = None
        packed = next(
            (key for key in ("rgb", "rgba") if key in have and have[key][0].str[1:] == "u4"), None
        )
        if packed is not None:  # 0x00RRGGBB
            bits = points[packed].astype(np.uint32)
            rgb = np.stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255], axis=-1).astype(
                np.uint8
            )
        amplitude = next(
            (points[field].astype(np.float32) for field in AMPLITUDE_FIELDS if field in have), None
        )
        frame = frame_of(name, stored, scale_m, rgb, amplitude)
    # NaN is these messages' code for "no return" (REP 118), which other files write as 0
    frame.reason[frame.reason == Reason.NOT_FINITE] = Reason.NO_RETURN
    return frame


def _points(name: str, message: Any) -> np.ndarray:
    """Return a (height, width) structured array over the message's data: a view, not a copy."""
    height = int(message.height)
    width = int(message.width)
    step = int(message.point_step)
    row = int(message.row_step)
    if height * width == 0:
        raise UserError(f"{name}: holds no points ({width} x {height})", legal=LEGAL_CLOUD)
    order = ">" if message.is_bigendian else "<"
    # some drivers leave count at 0 where they mean 1
    single = {f.name: f for f in message.fields if f.count <= 1 and f.datatype in FIELD_TYPES}
    missing = [axis for axis in "xyz" if axis not in single]
    if missing:
        contents = (
            ", ".join(f"{f.name} (type {f.datatype}, count {f.count})" for f in message.fields)
            or "none"
        )
        raise UserError(
            f"{name}: has no field {' or '.join(missing)}; its fields: {contents}",
            legal=LEGAL_CLOUD,
        )
    types = {key: np.dtype(order + FIELD_TYPES[f.datatype]) for key, f in single.items()}
    for key, field in single.items():
        end = field.offset + types[key].itemsize
        if end > step:
            raise UserError(
                f"{name}: its field {key} ends at byte {end} of points of {step} bytes",
                legal=LEGAL_CLOUD,
            )
        if key in ("rgb", "rgba") and types[key].itemsize == 4:
            types[key] = np.dtype(order + "u4")  # four packed bytes, whatever the field calls them
    offsets = [single[key].offset for key in types]
    layout: Any = {
        "names": list(types),
        "formats": list(types.values()),
        "offsets": offsets,
        "itemsize": step,
    }
    return _rows(name, message, np.dtype(layout), row if height > 1 or row else width * step)
