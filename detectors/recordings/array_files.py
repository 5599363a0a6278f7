"""Arrays in files that somebody else may have written: ``.npy``, ``.npz``, MATLAB's ``.mat``, and bare numbers.

The libraries that read them believe what a file states: they run within `limits.limited_memory`. Arrays of objects are
refused: they would need pickle, which runs whatever its author likes.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness.vocabulary import limits
from harness.vocabulary.errors import UserError
from harness.vocabulary.limits import ARRAYS_COUNT, RAISE, limited_memory, refuse_bytes, refuse_pixels

LEGAL_ARRAYS = "numeric arrays as numpy.save or numpy.savez write them, no objects"
LEGAL_MAT = "MATLAB 5 to 7 files (-v6, -v7) of numeric arrays: Location (h, w, 3), (n, 3) or (k, n, 3), and Color"
LEGAL_RAW = (
    "--raw WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]]: TYPE u2 (the default), >u2, u4, f4 ..; STEP bytes from pixel to pixel; "
    "BYTES before the first frame"
)
EXPORT = "Location = pc.Location; Color = pc.Color; save('cloud.mat','Location','Color','-v7')"
"""The line for MATLAB that turns a point cloud ``pc`` into arrays."""

ArraysLoader = Callable[[Path], Mapping[str, np.ndarray]]
"""Loads a file's arrays by name; the only array of a file without names is called ""."""


@contextmanager
def _readable(path: Path, kind: str, legal: str, fix: str) -> Iterator[None]:
    """Turn whatever a damaged file raises in a library, of any type, into one UserError."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        why = "there is not memory enough for what it states" if isinstance(error, MemoryError) else str(error)
        why = why or type(error).__name__
        raise UserError(f"{path}: cannot be read as {kind} ({why[:200]})", legal=legal, fix=fix) from error


def load_npy(path: Path) -> dict[str, np.ndarray]:
    """Map an ``.npy`` file. Raises UserError where it is broken or holds objects."""
    with _readable(path, "arrays", LEGAL_ARRAYS, "save it again, or copy it again if it was cut off"):
        return {"": np.lib.format.open_memmap(path, mode="r")}


def load_npz(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an ``.npz`` file by name.

    Raises UserError where it is broken, holds objects, or would unpack to more than `limits.ARRAYS_BYTES`.
    """
    fix = "save it again, or copy it again if it was cut off"
    with _readable(path, "arrays", LEGAL_ARRAYS, fix), limited_memory():
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
        if len(entries) > ARRAYS_COUNT:
            raise UserError(f"{path}: holds {len(entries)} arrays", legal=f"at most {ARRAYS_COUNT}", fix=RAISE)
        if len({entry.filename for entry in entries}) < len(entries):
            raise ValueError("a name stands there twice")
        fix = f"save its frames as .npy, which is not unpacked; {RAISE}"
        stated = sum(entry.file_size for entry in entries)
        refuse_bytes(str(path), stated, limits.ARRAYS_BYTES, "unpacks to", fix)
        with np.load(path, allow_pickle=False) as held:
            return {name: np.asarray(held[name]) for name in held}


# ---- MATLAB ----------------------------------------------------------------------------------------------------------

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
MATRIX, COMPRESSED = 14, 15
"""miMATRIX, and miCOMPRESSED: a variable as a zlib stream."""
NUMERIC, OPAQUE = range(6, 16), 17
"""Classes of arrays of numbers, mxDOUBLE to mxUINT64; and of objects of MATLAB's classes, such as ``pointCloud``."""
BEGINNING_BYTES = 4096
"""Bytes that the flags, dimensions (numpy knows 64 at most) and name (63 letters) of a variable take at most."""


class _Variable(NamedTuple):
    """A variable: its name, MATLAB's number of its class, and of an object the class' name."""

    name: str
    kind: int
    object_of: str


def load_mat(path: Path) -> dict[str, np.ndarray]:
    """Return the numeric arrays of a ``.mat`` file by name; (h, w, 3, k) has its frames moved first.

    Raises UserError for -v7.3 (HDF5), for objects such as ``pointCloud``, and for a broken file. Cells and structs,
    which nest without end, are left unread.
    """
    import scipy.io

    with path.open("rb") as file:
        head = file.read(520)
    if HDF5_SIGNATURE in (head[:8], head[512:520]) or b"MATLAB 7.3" in head[:116]:
        fix = "save it with '-v7' in place of '-v7.3', for a cloud: " + EXPORT
        raise UserError(f"{path}: is a -v7.3 file (HDF5)", legal=LEGAL_MAT, fix=fix)
    fix = "save it again with '-v7', or copy it again if it was cut off"
    with _readable(path, "a MATLAB file", LEGAL_MAT, fix), limited_memory():
        variables = list(_variables(path))
        names = [each.name for each in variables if each.kind in NUMERIC]
        loaded = scipy.io.loadmat(str(path), squeeze_me=False, variable_names=names) if names else {}
    arrays = {}
    for name, value in loaded.items():
        # MATLAB's scalars are 1 x 1 arrays; text, cells, structs and objects have other kinds.
        if isinstance(value, np.ndarray) and value.dtype.kind in "iuf" and value.size > 1:
            stacked_last = value.ndim == 4 and value.shape[2] == 3 and value.shape[3] != 3
            arrays[name] = np.moveaxis(value, -1, 0) if stacked_last else value
    if arrays:
        return arrays
    opaque = next((each for each in variables if each.object_of), None)
    if opaque is not None:
        raise UserError(
            f"{path}: the variable {opaque.name} is a MATLAB object ({opaque.object_of}), which cannot be read outside"
            " MATLAB",
            legal=LEGAL_MAT,
            fix=f"in MATLAB, with the cloud named pc: {EXPORT}",
        )
    raise UserError(f"{path}: holds no numeric array", legal=LEGAL_MAT, fix=f"in MATLAB: {EXPORT}")


def _variables(path: Path) -> Iterator[_Variable]:
    """Yield a file's variables by the beginnings of its elements (MathWorks, MAT-File Format, level 5): scipy's own
    list of variables fails on objects. Raises ValueError or struct.error where the file is none of these."""
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:128])
        if order is None:
            raise ValueError("it does not begin as MATLAB 5 files do")
        for _ in range(ARRAYS_COUNT + 1):
            if not (head := file.read(8)):
                return
            kind, length = struct.unpack(f"{order}II", head)
            end = file.tell() + length
            if end > path.stat().st_size:
                raise ValueError(f"the element at byte {file.tell() - 8} is cut off")
            content = head + file.read(length if kind == COMPRESSED else min(length, BEGINNING_BYTES))
            if kind == COMPRESSED:
                content = zlib.decompressobj().decompress(content[8:], BEGINNING_BYTES)
            if content[:4] == struct.pack(f"{order}I", MATRIX):
                flags, rest = _element(content[8:], order)
                kind = struct.unpack(f"{order}I", flags[:4])[0] & 0xFF
                dimensions, rest = (b"", rest) if kind == OPAQUE else _element(rest, order)
                if any(each < 0 for each in struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)):
                    raise ValueError("it states a negative dimension")
                name, rest = _element(rest, order)
                words = [name]
                while kind == OPAQUE and len(words) < 3:
                    word, rest = _element(rest, order)
                    words.append(word)
                yield _Variable(name.decode("latin1"), kind, b"".join(words[2:]).decode("latin1"))
            file.seek(end)
        raise UserError(f"{path}: holds more than {ARRAYS_COUNT} variables", legal=LEGAL_MAT)


def _element(content: bytes, order: str) -> tuple[bytes, bytes]:
    """Return the data of the first element, and what follows it. Four bytes and fewer may stand within the tag."""
    (word,) = struct.unpack_from(f"{order}I", content)
    if word >> 16:
        return content[4 : 4 + (word >> 16)], content[8:]
    (length,) = struct.unpack_from(f"{order}I", content, 4)
    if 8 + length > len(content):
        raise ValueError("a variable is cut off")
    return content[8 : 8 + length], content[8 + -(-length // 8) * 8 :]


# ---- bare numbers ----------------------------------------------------------------------------------------------------

SENSOR_SIZES = (
    *((640, 576), (320, 288), (512, 512), (1024, 1024), (640, 480), (512, 424), (320, 240), (224, 172), (224, 171)),
    *((256, 192), (160, 120), (240, 180), (1024, 768), (1280, 720), (848, 480), (1280, 960), (1280, 1024)),
)
"""(width, height) of the depth images of usual cameras."""
SAME_SCENE = 0.05
"""Part of its distance by which the median pixel of two frames of one scene differs at most."""
NEIGHBOURS = 0.1
"""The same of neighbouring pixels: rows of a floor seen flat differ by 1 %, noise by less; a wrong layout by 100 %."""


@dataclass(frozen=True)
class RawLoader:
    """Whole frames of ``width`` x ``height`` numbers, row by row, from a byte of a file on. ``step``: bytes from pixel
    to pixel, more than a number's where brightness and confidence stand between."""

    width: int
    height: int
    kind: str
    step: int
    offset: int

    @classmethod
    def stated(cls, text: str) -> RawLoader:
        """Parse WIDTHxHEIGHT[:TYPE[/STEP][:BYTES]]. Raises UserError for anything else."""
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})(?::([<>]?[uif][248])(?:/(\d{1,3}))?)?(?::(\d{1,12}))?", text)
        if match is None:
            raise UserError(f"--raw {text}: no such layout", legal=LEGAL_RAW)
        width, height, kind, step, offset = match.groups()
        refuse_pixels(f"--raw {text}", int(width), int(height))
        kind = kind or "u2"
        own = np.dtype(kind).itemsize
        if int(step or own) < own:
            raise UserError(f"--raw {text}: a number of {own} bytes in every {step}", legal=LEGAL_RAW)
        return cls(int(width), int(height), kind if kind[0] in "<>" else f"<{kind}", int(step or own), int(offset or 0))

    def __call__(self, path: Path) -> dict[str, np.ndarray]:
        """Map the frames (n, h, w). Raises UserError where there is none."""
        kind, size = np.dtype(self.kind), path.stat().st_size - self.offset
        frame = self.width * self.height * self.step
        if size < frame:
            raise UserError(
                f"{path}: has {size} bytes from byte {self.offset} on, but a frame of {self.width} x {self.height}"
                f" numbers in steps of {self.step} bytes needs {frame}",
                legal=LEGAL_RAW,
            )
        content = np.memmap(path, np.uint8, "r", self.offset, (size // frame * frame,))
        strides = (frame, self.width * self.step, self.step)
        return {"": np.ndarray((size // frame, self.height, self.width), kind, content, strides=strides)}

    def refuse_doubtful(self, path: Path, frames: np.ndarray) -> None:
        """Raise UserError where neighbours differ as no surface's do, or the planes are no frames of one scene."""
        first, last = (frames[i].astype(np.float64) for i in (0, -1))
        rough = _apart(first[:, 1:], first[:, :-1])
        if not rough < NEIGHBOURS:
            raise UserError(
                f"{path}: in this layout the median pixel differs from its neighbour by {100 * rough:.3g} %: the"
                " layout is another",
                legal=LEGAL_RAW,
                fix=raw_layout_of(path).fix,
            )
        left_over = (path.stat().st_size - self.offset) % (self.width * self.height * self.step)
        apart = _apart(first, last)
        if len(frames) > 1 and (left_over or not apart < SAME_SCENE):
            raise UserError(
                f"{path}: {len(frames)} planes and {left_over} bytes more; the median pixel differs by"
                f" {100 * apart:.3g} % between the first and the last plane: depth beside brightness and confidence?",
                legal="frames of one scene, or one plane",
                fix="choose the plane with the depth: --array :0",
            )


def _apart(first: np.ndarray, second: np.ndarray) -> float:
    """Return the median relative difference of two arrays where both have a number; infinity where none has."""
    both = (first > 0) & (second > 0)
    return float(np.median(np.abs(first - second)[both] / first[both])) if both.any() else float("inf")


def raw_layout_of(path: Path) -> UserError:
    """Return the message for a file of bare numbers: the layouts of usual cameras that its size fits."""
    size = path.stat().st_size
    layouts = {f"{w}x{h}": size // (w * h) for w, h in SENSOR_SIZES if size % (w * h) == 0 and size >= 2 * w * h}
    ranked = sorted(layouts, key=lambda wh: layouts[wh] != 2)[:4]
    fitting = " or ".join(f"--raw {wh}" + ("" if (n := layouts[wh]) == 2 else f":u2/{n}" * (n < 17)) for wh in ranked)
    return UserError(
        f"{path}: nothing says how its {size} bytes are laid out",
        legal=LEGAL_RAW,
        fix=f"state the layout; its size fits {fitting}" if fitting else "state the layout",
    )
