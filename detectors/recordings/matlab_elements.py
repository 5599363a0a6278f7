"""What a MATLAB 5 file says of itself, read without believing it: its variables, and how much it would unpack to.

Source: MathWorks, MAT-File Format (the elements of level 5). scipy believes every length that stands in a file and
takes that much memory, and its own list of variables fails on objects.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import BinaryIO

from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import ARRAYS_BYTES, ARRAYS_COUNT, RAISE, refuse_bytes

LEGAL_MAT = "MATLAB 5 to 7 files (-v6, -v7) of numeric arrays: Location (h, w, 3), (n, 3) or (k, n, 3), and Color"
FILE_HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
"""miMATRIX, and miCOMPRESSED: a variable as a zlib stream."""
NUMERIC = range(6, 16)
"""Classes of arrays of numbers, mxDOUBLE to mxUINT64."""
OPAQUE = 17
"""An object of MATLAB's classes, such as ``pointCloud``."""
PIECE_BYTES = 1 << 20
BEGINNING_BYTES = 4096
"""Of a variable: flags, dimensions (numpy knows 64 at most) and a name (63 letters in MATLAB)."""


@dataclass(frozen=True)
class Variable:
    """``kind``: MATLAB's number of the class. ``shape`` as stated. ``object_of``: the class' name of an object."""

    name: str
    kind: int
    shape: tuple[int, ...] = ()
    object_of: str = ""

    @property
    def is_numeric(self) -> bool:
        return self.kind in NUMERIC


@lru_cache(maxsize=100)
def variables_of(path: Path, size: int, changed_ns: int) -> tuple[Variable, ...]:
    """The file's variables. ``size`` and ``changed_ns`` tell whether it is still the same file.

    Compressed ones are unpacked once to their end, in pieces that are thrown away. Raises UserError where the file is
    none of these, is cut off, or would unpack to more than `limits.ARRAYS_BYTES`.
    """
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}.get(file.read(FILE_HEADER_BYTES)[126:128])
        if order is None:
            raise broken(path, "it does not begin as MATLAB 5 files do")
        return tuple(_variables(path, file, size, order))


def broken(path: Path, why: str) -> UserError:
    """The message for a file that cannot be read."""
    return UserError(
        f"{path}: cannot be read as a MATLAB file ({why})",
        legal=LEGAL_MAT,
        fix="save it again with '-v7', or copy it again if it was cut off",
    )


def _variables(path: Path, file: BinaryIO, size: int, order: str) -> Iterator[Variable]:
    at, total, count = FILE_HEADER_BYTES, 0, 0
    while at < size:
        file.seek(at)
        head = file.read(8)
        kind, length = struct.unpack(f"{order}II", head) if len(head) == 8 else (0, size)
        if at + 8 + length > size:
            raise broken(path, f"the element at byte {at} is cut off")
        count += 1
        if count > ARRAYS_COUNT:
            raise UserError(f"{path}: holds more than {ARRAYS_COUNT} variables", legal=LEGAL_MAT)
        if kind == COMPRESSED:
            beginning, unpacked = _beginning(path, at, file.read(length), ARRAYS_BYTES - total)
        else:
            beginning, unpacked = head + file.read(min(length, BEGINNING_BYTES)), length
        total += unpacked
        refuse_bytes(str(path), total, ARRAYS_BYTES, "unpacks to at least", RAISE)
        if beginning[:4] == struct.pack(f"{order}I", MATRIX):
            variable = _variable(path, at, beginning[8:], order)
            if prod(variable.shape) > unpacked and variable.is_numeric:
                raise broken(path, f"{variable.name} states {variable.shape} numbers in {unpacked} bytes")
            yield variable
        at += 8 + length


def _beginning(path: Path, at: int, content: bytes, at_most: int) -> tuple[bytes, int]:
    """The first bytes that a compressed element unpacks to, and the count of all; no further than ``at_most``."""
    unpacker, beginning, count = zlib.decompressobj(), b"", 0
    try:
        while content and not unpacker.eof and count <= at_most:
            piece = unpacker.decompress(content, PIECE_BYTES)
            beginning = beginning or piece[:BEGINNING_BYTES]
            count += len(piece)
            content = unpacker.unconsumed_tail
    except zlib.error as error:
        raise broken(path, f"the element at byte {at} cannot be unpacked") from error
    return beginning, count


def _variable(path: Path, at: int, content: bytes, order: str) -> Variable:
    try:
        flags, rest = _element(content, order)
        kind = struct.unpack(f"{order}I", flags[:4])[0] & 0xFF
        if kind == OPAQUE:
            name, rest = _element(rest, order)
            _, rest = _element(rest, order)
            return Variable(name.decode("latin1"), kind, object_of=_element(rest, order)[0].decode("latin1"))
        dimensions, rest = _element(rest, order)
        shape = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
        name, _ = _element(rest, order)
    except struct.error as error:
        raise broken(path, f"the variable at byte {at} is cut off") from error
    if any(length < 0 for length in shape):
        raise broken(path, f"the variable at byte {at} states the shape {shape}")
    return Variable(name.decode("latin1"), kind, shape)


def _element(content: bytes, order: str) -> tuple[bytes, bytes]:
    """The data of the first element, and what follows it. Four bytes and less may stand within the tag."""
    (word,) = struct.unpack_from(f"{order}I", content)
    if word >> 16:
        return content[4 : 4 + (word >> 16)], content[8:]
    (length,) = struct.unpack_from(f"{order}I", content, 4)
    if 8 + length > len(content):
        raise struct.error("cut off")
    return content[8 : 8 + length], content[8 + -(-length // 8) * 8 :]
