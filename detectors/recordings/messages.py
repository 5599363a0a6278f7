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

FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""PointField's codes."""
AMPLITUDE_FIELDS = ("intensity", "amplitude", "i")
LEGAL_CLOUD = "sensor_msgs/PointCloud2 with the fields x, y, z, each a single number"
DEPTH_NUMBERS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings that may hold depth: whole millimetres, or floating-point metres."""
LEGAL_IMAGE = (
    "sensor_msgs/Image as 16UC1, mono16 or 32FC1; "
    "CompressedImage as compressedDepth (PNG or RVL) of these"
)
CONFIG_BYTES = 12
RVL_HEADER_BYTES = 8  # width and height
ENDS_EARLY = "its RVL stream is damaged or ends too early"


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
    used_bytes = width * kind.itemsize
    if row_bytes < used_bytes or data.size < (height - 1) * row_bytes + used_bytes:
        problem = (
            f"{name}: is truncated: {data.size} bytes in rows of {row_bytes} cannot hold "
            f"{width} of {kind.itemsize} bytes, {height} times"
        )
        raise UserError(problem, fix="record or convert it again")
    return np.ndarray((height, width), kind, data.data, strides=(row_bytes, kind.itemsize))


def _unpacked(name: str, encoding: str, data: bytes) -> np.ndarray:
    """Unpack the picture of compressedDepth. Depth of 32FC1 is stored as a / (number - b), and 0
    is no return."""
    if len(data) <= CONFIG_BYTES:
        problem = f"{name}: is truncated ({len(data)} bytes)"
        raise UserError(problem, legal=LEGAL_IMAGE, fix="record it again")
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
        depth = np.float32(a) / (stored - np.float32(b))
    return np.where(stored == 0, np.float32(np.nan), depth).astype(np.float32)


def _rvl(name: str, content: bytes) -> np.ndarray:
    """Unpack width and height, then runs of zeros and differences."""
    if len(content) < RVL_HEADER_BYTES:
        raise UserError(f"{name}: {ENDS_EARLY}", legal=LEGAL_IMAGE, fix="record it again")
    width, height = struct.unpack_from("<II", content)
    refuse_pixels(name, width, height)
    numbers = _rvl_numbers(content)
    filled = np.zeros(width * height, bool)
    folded: list[np.ndarray] = []
    pixel = 0
    index = 0
    while pixel < filled.size:
        # a count of zeros, a count of differences, and these
        start = index + 2
        zeros = 0
        run = numbers.size
        if start <= numbers.size:
            zeros = int(numbers[index])
            run = int(numbers[index + 1])
        if run > numbers.size - start or pixel + zeros + run > filled.size or run + zeros == 0:
            raise UserError(f"{name}: {ENDS_EARLY}", legal=LEGAL_IMAGE, fix="record it again")
        pixel += zeros
        filled[pixel : pixel + run] = True
        folded.append(numbers[start : start + run])
        pixel += run
        index = start + run
    differences = np.concatenate(folded)
    stored = np.zeros(filled.size, np.uint16)
    stored[filled] = np.cumsum(differences >> 1 ^ -(differences & 1)).astype(np.uint16)
    return stored.reshape(height, width)


def _rvl_numbers(content: bytes) -> np.ndarray:
    """Return the numbers of an RVL stream: three bits in each nibble, the lowest first; the
    fourth bit says that another nibble follows."""
    count = (len(content) - RVL_HEADER_BYTES) // 4
    words = np.frombuffer(content, "<u4", count, RVL_HEADER_BYTES)
    nibble_shifts = np.arange(28, -1, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> nibble_shifts) & 15).ravel()
    last = np.flatnonzero(nibbles < 8)
    if not last.size:
        return np.zeros(0, np.int64)
    first = np.concatenate([[0], last[:-1] + 1])
    digit = np.arange(last[-1] + 1) - np.repeat(first, last - first + 1)
    # no number of this stream has more than seven nibbles
    bit_shift = 3 * np.minimum(digit, 10)
    bits = (nibbles[: digit.size] & 7).astype(np.int64)
    return np.add.reduceat(bits << bit_shift, first)


def frame_of_message(name: str, message: Any, scale_m: float) -> Frame:
    """Convert a depth image or a PointCloud2 to a frame, (1, n) without a grid; NaN means no
    return. Raises UserError if x, y or z is missing, a field lies outside its point, or the data
    are shorter than the layout needs."""
    if hasattr(message, "point_step"):
        frame = _frame_of_points(name, _points(name, message), scale_m)
    else:
        frame = frame_of(name, stored_depth(name, message), scale_m)
    # NaN is these messages' code for "no return" (REP 118), which other files write as 0
    frame.reason[frame.reason == Reason.NOT_FINITE] = Reason.NO_RETURN
    return frame


def _frame_of_points(name: str, points: np.ndarray, scale_m: float) -> Frame:
    """Convert a structured array (h, w) of points to a frame."""
    fields: Any = points.dtype.fields
    stored = np.stack([points[axis] for axis in "xyz"], axis=-1)
    if stored.dtype.kind == "f":
        stored = stored.astype(stored.dtype.newbyteorder("="), copy=False)
    rgb = None
    for field in ("rgb", "rgba"):
        if rgb is None and field in fields and fields[field][0].str[1:] == "u4":
            bits = points[field].astype(np.uint32)  # 0x00RRGGBB
            channels = [bits >> 16 & 255, bits >> 8 & 255, bits & 255]
            rgb = np.stack(channels, axis=-1).astype(np.uint8)
    amplitude = None
    for field in AMPLITUDE_FIELDS:
        if amplitude is None and field in fields:
            amplitude = points[field].astype(np.float32)
    return frame_of(name, stored, scale_m, rgb, amplitude)


def _points(name: str, message: Any) -> np.ndarray:
    """Return a (height, width) structured array over the message's data: a view, not a copy."""
    height = int(message.height)
    width = int(message.width)
    step = int(message.point_step)
    if height * width == 0:
        raise UserError(f"{name}: holds no points ({width} x {height})", legal=LEGAL_CLOUD)
    order = ">" if message.is_bigendian else "<"
    # some drivers leave count at 0 where they mean 1
    single = {f.name: f for f in message.fields if f.count <= 1 and f.datatype in FIELD_TYPES}
    missing = [axis for axis in "xyz" if axis not in single]
    if missing:
        fields = [f"{f.name} (type {f.datatype}, count {f.count})" for f in message.fields]
        contents = ", ".join(fields) or "none"
        problem = f"{name}: has no field {' or '.join(missing)}; its fields: {contents}"
        raise UserError(problem, legal=LEGAL_CLOUD)
    formats = []
    for key, field in single.items():
        kind = np.dtype(order + FIELD_TYPES[field.datatype])
        end = field.offset + kind.itemsize
        if end > step:
            problem = f"{name}: its field {key} ends at byte {end} of points of {step} bytes"
            raise UserError(problem, legal=LEGAL_CLOUD)
        if key in ("rgb", "rgba") and kind.itemsize == 4:
            kind = np.dtype(order + "u4")  # four packed bytes, whatever the field calls them
        formats.append(kind)
    layout: Any = {
        "names": list(single),
        "formats": formats,
        "offsets": [field.offset for field in single.values()],
        "itemsize": step,
    }
    row_bytes = int(message.row_step)
    if height == 1 and not row_bytes:
        row_bytes = width * step
    return _rows(name, message, np.dtype(layout), row_bytes)
