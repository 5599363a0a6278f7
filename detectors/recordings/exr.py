"""Depth in OpenEXR files, as renderers and simulators write it.

FFmpeg, which the wheel of PyAV brings along, decodes the picture; OpenCV's wheel has no OpenEXR.
FFmpeg knows only channels with the names of colours, so the depth channel gets such a name in the
copy that it decodes. Not read: several parts, deep pixels, depth within a named layer, whole
numbers of 32 bits."""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from detectors.recordings.recording import read_errors
from harness.vocabulary.files import PICTURE_BYTES, bounded_bytes, refuse_pixels

LEGAL_EXR = (
    "an OpenEXR file of one part with a channel Z, Y or R, or a single channel of one letter, "
    "in 16- or 32-bit floating point"
)
MAGIC = b"v/1\x01"
HEADER_FROM = 8
"""Bytes of the magic number and the version, which precede the header."""
UNSUPPORTED_FLAGS = 0x1800
"""Bits of the version for deep pixels and several parts."""
DEPTH_CHANNELS = ("Z", "Y", "R")
GREY = b"Y"
UNKNOWN = b"_"
"""A name that FFmpeg passes over."""
NUMBERS = {"grayf32le": "<f4", "grayf32be": ">f4", "grayf16le": "<f2", "grayf16be": ">f2"}
"""FFmpeg's names of grey pictures in floating point, and the numbers in them."""
WHOLE_NUMBERS = 0  # a channel's type for 32-bit integers
CHANNEL_BYTES = 16  # type, use and sampling after a channel's name
MOST_NAME = 255


class Channel(NamedTuple):
    """A channel in the header of a file."""

    name: bytes
    # place of the name in the file, bytes
    start: int
    # OpenEXR's number of the type
    kind: int


def load_exr(path: Path) -> dict[str, np.ndarray]:
    """Return the depth (h, w) of an OpenEXR file, float32. Raises UserError if it is broken, too
    large, or has no depth channel."""
    with read_errors(f"{path}: cannot be read as OpenEXR", LEGAL_EXR):
        content = bytearray(bounded_bytes(path, PICTURE_BYTES))
        channels, (width, height) = _header(content)
        refuse_pixels(str(path), width, height)
        depth = _depth_channel(channels)
        for channel in channels:
            if len(channel.name) == 1:
                name = GREY if channel is depth else UNKNOWN
                content[channel.start : channel.start + 1] = name
        return {"": _decoded(bytes(content))}


def _header(content: bytearray) -> tuple[list[Channel], tuple[int, int]]:
    """Return the channels, and width and height. Raises ValueError, IndexError or struct.error if
    the header is broken."""
    if content[: len(MAGIC)] != MAGIC:
        raise ValueError("it does not begin as OpenEXR does")
    (version,) = struct.unpack_from("<I", content, len(MAGIC))
    if version & UNSUPPORTED_FLAGS:
        raise ValueError("it has several parts or deep pixels")
    channels: list[Channel] = []
    size = (0, 0)
    offset = HEADER_FROM
    while content[offset]:
        name, offset = _text(content, offset)
        _, offset = _text(content, offset)
        (length,) = struct.unpack_from("<I", content, offset)
        offset += 4
        if name == b"channels":
            channels = _channels(content, offset)
        if name in (b"dataWindow", b"displayWindow"):
            left, top, right, bottom = struct.unpack_from("<4i", content, offset)
            size = (max(size[0], right - left + 1), max(size[1], bottom - top + 1))
        offset += length
    return channels, size


def _text(content: bytearray, start: int) -> tuple[bytes, int]:
    """Return a text that a zero byte ends, and the place after it. Raises ValueError if it is too
    long."""
    end = content.index(0, start, start + MOST_NAME + 1)
    return bytes(content[start:end]), end + 1


def _channels(content: bytearray, offset: int) -> list[Channel]:
    """Return the channels of a list that begins at a place. Raises as `_header` does."""
    channels = []
    while content[offset]:
        start = offset
        name, offset = _text(content, start)
        (kind,) = struct.unpack_from("<i", content, offset)
        channels.append(Channel(name, start, kind))
        offset += CHANNEL_BYTES
    return channels


def _depth_channel(channels: list[Channel]) -> Channel:
    """Return the channel that holds the depth. Raises ValueError if none does."""
    by_name = {channel.name.decode("latin1").upper(): channel for channel in channels}
    for name in DEPTH_CHANNELS:
        if name in by_name:
            depth = by_name[name]
            break
    else:
        names = ", ".join(by_name) or "none"
        if len(channels) != 1 or len(channels[0].name) != 1:
            raise ValueError(f"no channel Z, Y or R; its channels: {names[:100]}")
        depth = channels[0]
    if depth.kind == WHOLE_NUMBERS:
        raise ValueError("its depth is in whole numbers of 32 bits")
    return depth


def _decoded(content: bytes) -> np.ndarray:
    """Return the grey picture (h, w) of a file's content. Raises ValueError or FFmpeg's errors."""
    import av

    decoder = av.CodecContext.create("exr", "r")
    pictures = [*decoder.decode(av.Packet(content)), *decoder.decode(None)]
    if len(pictures) != 1 or pictures[0].format.name not in NUMBERS:
        raise ValueError("it holds no grey picture in floating point")
    picture = pictures[0]
    (plane,) = picture.planes
    rows = np.frombuffer(bytes(plane), NUMBERS[picture.format.name]).reshape(plane.height, -1)
    return rows[:, : picture.width].astype(np.float32)
