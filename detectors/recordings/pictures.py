"""Pictures that somebody else may have written: only PNG and JPEG, and decoded only where their size is a picture's.

A picture's kind is told by its first bytes, not by its name: OpenCV would take a TIFF, EXR or WebP called ``.png``, and
decode a header of 30,000 x 30,000 pixels into gigabytes. Pillow reads the headers, which takes no such memory.
"""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
from PIL import ImageFile, JpegImagePlugin, PngImagePlugin

from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import PICTURE_BYTES, bounded_bytes, refuse_pixels

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
LEGAL_PICTURE = "PNG or JPEG"


def read_picture(path: Path, flags: int) -> np.ndarray:
    """Return a PNG or JPEG decoded by OpenCV with its ``flags``: (h, w) or (h, w, 3), blue first.

    Raises UserError where it is another kind of file, cannot be decoded, or is too large (`harness.vocabulary.limits`).
    """
    try:
        content = bounded_bytes(path, PICTURE_BYTES)
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})", legal=LEGAL_PICTURE) from error
    return decoded(str(path), content, flags)


def decoded(name: str, content: bytes, flags: int) -> np.ndarray:
    """Return the same of a file's content."""
    refuse_pixels(name, *picture_size(name, content))
    try:
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:
        picture = None
    if picture is None:
        raise UserError(f"{name}: cannot be decoded", legal=LEGAL_PICTURE, fix="copy or export it again")
    return picture


def picture_size(name: str, content: bytes) -> tuple[int, int]:
    """Return (width, height) from the header. Raises UserError where it is neither PNG nor JPEG, or cut off."""
    return _header(name, content).size


def png_texts(content: bytes) -> dict[str, str]:
    """Return the names and values that a PNG holds as text before its picture; none of what is no PNG."""
    try:
        return {str(key): str(value) for key, value in _header("", content).info.items()}
    except UserError:
        return {}


def refuse_broken_png(name: str, content: bytes) -> None:
    """Raise UserError where a PNG is cut off or a checksum fails: the decoder may fill a cut picture up with zeros."""
    try:
        _header(name, content).verify()
    except (SyntaxError, OSError, ValueError) as error:
        what = "damaged" if "broken" in str(error) or "checksum" in str(error) else "truncated"
        raise UserError(
            f"{name}: is {what} ({error}; {len(content)} bytes)", legal="a whole PNG", fix="copy or export it again"
        ) from error


def _header(name: str, content: bytes) -> ImageFile.ImageFile:
    """Read a picture's header alone, as the kind that its first bytes say."""
    kind = PngImagePlugin.PngImageFile if content.startswith(PNG_SIGNATURE) else JpegImagePlugin.JpegImageFile
    try:
        return kind(io.BytesIO(content))
    except (SyntaxError, OSError, ValueError, EOFError, LookupError) as error:
        raise UserError(
            f"{name}: cannot be decoded: it begins neither as PNG nor as JPEG does, or is truncated",
            legal=LEGAL_PICTURE,
            fix="copy or export it again",
        ) from error
