"""Pictures that somebody else may have written: only PNG and JPEG, and decoded only where their size is a picture's.

A picture's kind is told by its first bytes, not by its name: OpenCV would take a TIFF, EXR or WebP called ``.png``, and
decode a header of 30,000 x 30,000 pixels into gigabytes.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import PICTURE_BYTES, bounded_bytes, refuse_pixels

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"
JPEG_SIZES = frozenset({*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC})
"""Markers of JPEG's frame headers (ITU-T T.81, table B.1), which hold the picture's size."""
JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD9)})
"""Markers without a length."""
LEGAL_PICTURE = "PNG or JPEG"


def read_picture(path: Path, flags: int) -> np.ndarray:
    """A PNG or JPEG decoded by OpenCV with its ``flags``: (h, w) or (h, w, 3), blue first.

    Raises UserError where it is another kind of file, cannot be decoded, or is too large (`harness.vocabulary.limits`).
    """
    try:
        content = bounded_bytes(path, PICTURE_BYTES)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})", legal=LEGAL_PICTURE) from error
    return decoded(str(path), content, flags)


def decoded(name: str, content: bytes, flags: int) -> np.ndarray:
    """The same of a file's content."""
    refuse_pixels(name, *picture_size(name, content))
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        picture = None
    if picture is None:
        raise UserError(f"{name}: cannot be decoded", legal=LEGAL_PICTURE, fix="copy or export it again")
    return picture


def png_texts(content: bytes) -> dict[str, str]:
    """The names and values that a PNG's tEXt chunks hold before its picture."""
    texts, at = {}, len(PNG_SIGNATURE)
    while at + 12 <= len(content) and content[at + 4 : at + 8] != b"IDAT":
        end = at + 8 + int.from_bytes(content[at : at + 4], "big")
        if content[at + 4 : at + 8] == b"tEXt":
            key, _, value = content[at + 8 : end].decode("latin1").partition("\0")
            texts[key] = value
        at = end + 4
    return texts


def picture_size(name: str, content: bytes) -> tuple[int, int]:
    """(width, height) from the header. Raises UserError where it is neither PNG nor JPEG, or cut off before."""
    if content.startswith(PNG_SIGNATURE) and content[12:16] == b"IHDR" and len(content) >= 24:
        width, height = struct.unpack(">II", content[16:24])
        return width, height
    if content.startswith(JPEG_SIGNATURE):
        size = _jpeg_size(content)
        if size is not None:
            return size
    raise UserError(
        f"{name}: cannot be decoded: it begins neither as PNG nor as JPEG does, or is cut off",
        legal=LEGAL_PICTURE,
        fix="copy or export it again",
    )


def refuse_broken_png(name: str, content: bytes) -> None:
    """Walk the chunks to the end and compare their checksums: the decoder may fill a cut picture up with zeros."""
    at = len(PNG_SIGNATURE)
    while at + 12 <= len(content):
        length, kind = struct.unpack(">I4s", content[at : at + 8])
        end = at + 12 + length
        if end > len(content):
            break
        if zlib.crc32(content[at + 4 : end - 4]) != int.from_bytes(content[end - 4 : end], "big"):
            raise UserError(f"{name}: is damaged (checksum of {kind.decode('latin1')})", fix="copy or export it again")
        if kind == b"IEND":
            return
        at = end
    raise UserError(f"{name}: is truncated ({len(content)} bytes)", legal="a whole PNG", fix="copy or export it again")


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Walk the segments to the frame header."""
    at = 2
    while at + 9 <= len(content) and content[at] == 0xFF:
        marker = content[at + 1]
        if marker == 0xFF:
            at += 1
        elif marker in JPEG_SIZES:
            height, width = struct.unpack(">HH", content[at + 5 : at + 9])
            return width, height
        elif marker in JPEG_BARE:
            at += 2
        else:
            at += 2 + max(2, int.from_bytes(content[at + 2 : at + 4], "big"))
    return None
