"""OpenEXR files without compression, written byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

KINDS = {"uint32": 0, "float16": 1, "float32": 2}
"""OpenEXR's number of a channel's type."""


def write_exr(path: Path, channels: Mapping[str, np.ndarray], version: int = 2) -> Path:
    """Write channels (h, w) of any of `KINDS`."""
    ordered = dict(sorted(channels.items()))
    height, width = next(iter(ordered.values())).shape
    listed = b""
    for name, values in ordered.items():
        listed += name.encode() + b"\0"
        listed += struct.pack("<iIii", KINDS[values.dtype.name], 0, 1, 1)
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = b"v/1\x01" + struct.pack("<I", version)
    header += _attribute("channels", "chlist", listed + b"\0")
    header += _attribute("compression", "compression", b"\0")
    header += _attribute("dataWindow", "box2i", box)
    header += _attribute("displayWindow", "box2i", box)
    header += _attribute("lineOrder", "lineOrder", b"\0")
    header += _attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
    header += _attribute("screenWindowCenter", "v2f", bytes(8))
    header += _attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)) + b"\0"
    lines = []
    for row in range(height):
        numbers = b"".join(values[row].tobytes() for values in ordered.values())
        lines.append(struct.pack("<ii", row, len(numbers)) + numbers)
    offset = len(header) + 8 * height
    table = b""
    for line in lines:
        table += struct.pack("<Q", offset)
        offset += len(line)
    path.write_bytes(header + table + b"".join(lines))
    return path


def _attribute(name: str, kind: str, value: bytes) -> bytes:
    head = name.encode() + b"\0" + kind.encode() + b"\0"
    return head + struct.pack("<I", len(value)) + value
