"""sensor_msgs/Image and CompressedImage: a message's bytes as stored depth (common_interfaces, REP 118).

``compressedDepth`` is image_transport's: twelve bytes (a form, then two numbers of the quantisation of 32FC1), then a
PNG or an RVL stream (Wilson 2017, "Fast lossless depth image compression").
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from detectors.recordings.pictures import PNG_SIGNATURE, decoded, refuse_broken_png
from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import refuse_pixels

DEPTH_NUMBERS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
"""Encodings that may hold depth: whole millimetres, or floating-point metres."""
LEGAL_IMAGE = "sensor_msgs/Image as 16UC1, mono16 or 32FC1; CompressedImage as compressedDepth (PNG or RVL) of these"
CONFIG_BYTES = 12


def encoding_of(message: Any) -> str:
    """The encoding of a picture's numbers; of a compressed picture that of what was compressed, and "" for colour."""
    if hasattr(message, "encoding"):
        return str(message.encoding)
    encoding, _, transport = str(message.format).partition(";")
    return encoding.strip() if "compressedDepth" in transport else ""


def stored_depth(name: str, message: Any) -> np.ndarray:
    """The stored numbers (h, w), uint16 or float32, whatever their byte order and row padding.

    Raises UserError where the message holds no depth, or less than its size needs.
    """
    encoding = encoding_of(message)
    if encoding not in DEPTH_NUMBERS:
        what = encoding or getattr(message, "format", "")
        raise UserError(f"{name}: holds {what[:60]!r} pictures, no depth", legal=LEGAL_IMAGE)
    if hasattr(message, "format"):
        return _unpacked(name, encoding, bytes(message.data))
    kind = np.dtype((">" if message.is_bigendian else "<") + DEPTH_NUMBERS[encoding])
    height, width, step = int(message.height), int(message.width), int(message.step)
    refuse_pixels(name, width, height)
    data = np.asarray(message.data, np.uint8)
    needed = (height - 1) * step + width * kind.itemsize
    if step < width * kind.itemsize or data.size < needed:
        raise UserError(
            f"{name}: is truncated: {data.size} bytes in rows of {step}, but {width} x {height} pixels of"
            f" {kind.itemsize} bytes",
            legal="height * step bytes, each row with all its pixels",
            fix="record or convert it again",
        )
    stored = np.ndarray((height, width), kind, data.data, strides=(step, kind.itemsize))
    return stored.astype(kind.newbyteorder("="))


def _unpacked(name: str, encoding: str, data: bytes) -> np.ndarray:
    """The picture of compressedDepth. Depth of 32FC1 is stored as a / (number - b), and 0 is no return."""
    if len(data) <= CONFIG_BYTES:
        raise UserError(f"{name}: is truncated ({len(data)} bytes)", legal=LEGAL_IMAGE, fix="record it again")
    _, a, b = struct.unpack_from("<iff", data)
    content = data[CONFIG_BYTES:]
    if content.startswith(PNG_SIGNATURE):
        refuse_broken_png(name, content)
        stored = decoded(name, content, cv2.IMREAD_UNCHANGED)
    else:
        stored = _rvl(name, content)
    if stored.ndim != 2 or stored.dtype != np.uint16:
        raise UserError(f"{name}: its picture is no 16-bit grey one", legal=LEGAL_IMAGE)
    if encoding != "32FC1":
        return stored
    with np.errstate(divide="ignore"):
        return np.where(stored == 0, np.float32(np.nan), np.float32(a) / (stored - np.float32(b))).astype(np.float32)


def _rvl(name: str, content: bytes) -> np.ndarray:
    """Width and height, then runs of zeros and of differences in numbers of three bits a nibble.

    Words of 32 bits hold their first nibble on top; a nibble's top bit says that the number goes on. Differences are
    folded (0, -1, 1, -2, ..) and count from the last pixel that was not 0.
    """
    width, height = struct.unpack_from("<II", content.ljust(8, b"\0"))
    refuse_pixels(name, width, height)
    words = np.frombuffer(content, "<u4", (len(content) - 8) // 4, 8)
    nibbles = (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).ravel()
    last = np.flatnonzero(nibbles < 8)
    first = np.concatenate([[0], last[:-1] + 1]) if last.size else last
    place = np.arange(last[-1] + 1 if last.size else 0) - np.repeat(first, last - first + 1)
    # more than seven nibbles are no number of this stream
    parts = (nibbles[: place.size] & 7).astype(np.int64) << 3 * np.minimum(place, 10)
    numbers = np.add.reduceat(parts, first) if last.size else np.zeros(0, np.int64)
    filled = np.zeros(width * height, bool)
    folded: list[np.ndarray] = []
    pixel = at = 0
    while pixel < filled.size:
        if at + 1 >= numbers.size or (run := int(numbers[at + 1])) > numbers.size - at - 2:
            raise UserError(f"{name}: its RVL stream ends too early", legal=LEGAL_IMAGE, fix="record it again")
        pixel += int(numbers[at])
        if pixel + run > filled.size or run + numbers[at] == 0:
            raise UserError(f"{name}: its RVL stream is damaged", legal=LEGAL_IMAGE, fix="record it again")
        filled[pixel : pixel + run] = True
        folded.append(numbers[at + 2 : at + 2 + run])
        pixel, at = pixel + run, at + 2 + run
    differences = np.concatenate(folded)
    stored = np.zeros(filled.size, np.uint16)
    stored[filled] = np.cumsum(differences >> 1 ^ -(differences & 1)).astype(np.uint16)
    return stored.reshape(height, width)
