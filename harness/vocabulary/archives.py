"""Arrays of ``.npy`` and ``.npz`` files that somebody else may have written.

Nothing is unpacked, and no memory taken, before what the archive's list, an array's header and the limits say of sizes
agree. Arrays of objects are refused: they would need pickle, which runs whatever its author likes.
"""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError
from typing import IO

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import ARRAYS_BYTES, ARRAYS_COUNT, RAISE, refuse_bytes, size_text

LEGAL_ARRAYS = "numeric arrays as numpy.save or numpy.savez write them, no objects"
COPY_AGAIN = "save it again, or copy it again if it was cut off"
PIECE_BYTES = 1 << 20
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""How numpy packs."""
LIST_BYTES = 1 << 20
"""Of the archive's list of contents: `ARRAYS_COUNT` entries with names of 900 letters."""
END, END_64 = b"PK\x05\x06", b"PK\x06\x06"
TAIL_BYTES = (1 << 16) + 128
"""Within which both records of an archive's end lie: a comment of up to 65,535 bytes may follow them."""
STRONGEST = 1032
"""Times that deflate can shorten anything (zlib's documentation)."""
KINDS = "biufcUSmM"
"""Kinds of dtype whose elements are plain memory."""

DAMAGES = (
    *(ValueError, OSError, EOFError, KeyError, RuntimeError, MemoryError, SyntaxError, OverflowError),
    *(zipfile.BadZipFile, zlib.error, struct.error, TokenError),
)
"""What a wrong byte raises in numpy and zipfile; RuntimeError: an encrypted entry; MemoryError: more than there is."""


def read_npy(path: Path) -> np.ndarray:
    """The array of an ``.npy`` file, mapped and not read. Raises UserError where it is broken or holds objects."""
    try:
        array: np.ndarray = np.lib.format.open_memmap(path, mode="r")
        _refuse_kind(array.dtype)
        return array
    except (*DAMAGES, TypeError) as error:
        raise broken(path, error) from error


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` file by name.

    Raises UserError where it is broken, holds objects, or would unpack to more than `limits.ARRAYS_BYTES`.
    """
    try:
        refuse_long_list(path)
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            _refuse_entries(path, entries)
            return {_name(one): _unpacked(archive, one) for one in entries}
    except DAMAGES as error:
        raise broken(path, error) from error


def broken(path: Path, error: Exception) -> UserError:
    """The message for a file whose arrays cannot be read."""
    why = "there is not memory enough" if isinstance(error, MemoryError) else str(error) or type(error).__name__
    return UserError(f"{path}: cannot be read as arrays ({why})", legal=LEGAL_ARRAYS, fix=COPY_AGAIN)


def _name(entry: zipfile.ZipInfo) -> str:
    return entry.filename.removesuffix(".npy")


def refuse_long_list(path: Path) -> None:
    """The list of contents is read whole when an archive is opened; its size stands at the file's end."""
    with path.open("rb") as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - TAIL_BYTES))
        tail = file.read()
    sizes = [0]
    if (at := tail.rfind(END)) >= 0 and at + 16 <= len(tail):
        sizes += struct.unpack_from("<I", tail, at + 12)
    if (at := tail.rfind(END_64)) >= 0 and at + 48 <= len(tail):
        sizes += struct.unpack_from("<Q", tail, at + 40)
    refuse_bytes(f"{path}: its list of contents", max(sizes), LIST_BYTES)


def _refuse_entries(path: Path, entries: Sequence[zipfile.ZipInfo]) -> None:
    if len(entries) > ARRAYS_COUNT:
        raise UserError(f"{path}: holds {len(entries)} arrays", legal=f"at most {ARRAYS_COUNT}", fix=RAISE)
    names = [_name(one) for one in entries]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{twice} stands there twice")
    fix = f"save its frames as .npy, which is not unpacked; {RAISE}"
    refuse_bytes(str(path), sum(one.file_size for one in entries), ARRAYS_BYTES, "unpacks to", fix)
    if lie := next((one for one in entries if one.file_size > STRONGEST * (one.compress_size + 1)), None):
        raise ValueError(f"{lie.filename} states {size_text(lie.file_size)} packed into {lie.compress_size} bytes")


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    if entry.compress_type not in METHODS:
        raise ValueError(f"{entry.filename} is packed by method {entry.compress_type}, which numpy does not use")
    with archive.open(entry) as stream:
        shape, is_fortran, dtype = _header(stream, entry.filename)
        count = _count(shape)
        if stream.tell() + count * dtype.itemsize != entry.file_size:
            stated = size_text(stream.tell() + count * dtype.itemsize)
            raise ValueError(f"{entry.filename} states an array of {stated}, but has {size_text(entry.file_size)}")
        flat = np.empty(count, dtype)
        _fill(stream, flat.view(np.uint8) if count else np.empty(0, np.uint8), entry.filename)
    return flat.reshape(shape, order="F" if is_fortran else "C")


def _header(stream: IO[bytes], name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    major, minor = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if (major, minor) not in readers:
        raise ValueError(f"{name} is of version {major}.{minor} of the format, which plain numbers do not need")
    shape, is_fortran, dtype = readers[major, minor](stream)
    _refuse_kind(dtype)
    if any(length < 0 for length in shape):
        raise ValueError(f"{name} states the shape {shape}")
    return shape, is_fortran, dtype


def _refuse_kind(dtype: np.dtype) -> None:
    if dtype.hasobject:
        raise ValueError("it holds objects, which would need pickle")
    if dtype.kind not in KINDS or dtype.itemsize == 0:
        raise ValueError(f"it holds {dtype}, not numbers")


def _count(shape: Sequence[int]) -> int:
    """The number of elements, in Python's integers, which do not overflow."""
    count = 1
    for length in shape:
        count *= int(length)
    return count


def _fill(stream: IO[bytes], target: np.ndarray, name: str) -> None:
    """Unpack into an array of bytes, in pieces: an entry that ends early has cost no more than its own length."""
    at = 0
    while at < len(target):
        piece = stream.read(min(PIECE_BYTES, len(target) - at))
        if not piece:
            raise ValueError(f"{name} ends early")
        target[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
        at += len(piece)
    if stream.read(1):
        raise ValueError(f"{name} goes on after its end")
