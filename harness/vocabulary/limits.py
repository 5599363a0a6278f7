"""The sizes up to which files are read. A file may be made to fill the memory: most are refused by what they state,
unread; libraries that believe what a file states run within `limited_memory`.

All limits stand here. Somebody with more memory and a file that is really so large raises the number.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness.vocabulary.errors import UserError

FRAME_PIXELS = 64_000_000
"""Pixels of one frame or picture, and points of one cloud: five times the largest colour camera beside a depth one
(12 Mpx), sixty times the largest depth sensor. 192 MB as colour, 1.5 GB as float64 points."""
ARRAYS_BYTES = 4 << 30
"""All arrays that are unpacked from one ``.npz`` or ``.mat``: 5,800 frames of an Azure Kinect in 16 bits."""
ARRAYS_COUNT = 1000
"""Arrays in one file; captures have three."""
READING_BYTES = 5 << 30
"""Memory that a library may take while it reads one file: `ARRAYS_BYTES`, and what unpacking them needs beside."""
PICTURE_BYTES = 512 << 20
"""A picture's file: what `FRAME_PIXELS` of 48 bits need without compression, and more."""
RECORD_BYTES = 256 << 20
"""A study's record: three million inspections. As Python's values it is some 10 times as large."""
TEXT_BYTES = 16 << 20
"""A file of settings, poses, a calibration, or a bag's description: those written by programs have some kB."""
TABLE_BYTES = 256 << 20
"""A table of inspections: five million rows."""

RAISE = "if the file is to be so large, raise the limit in harness/vocabulary/limits.py"


def size_text(count: int) -> str:
    """Return bytes as text in the unit that is easiest to read."""
    for unit, factor in (("GiB", 1 << 30), ("MiB", 1 << 20), ("kiB", 1 << 10)):
        if count >= factor:
            return f"{count / factor:.4g} {unit}"
    return f"{count} bytes"


def refuse_bytes(name: str, count: int, at_most: int, what: str = "has", fix: str = RAISE) -> None:
    """Raise UserError where ``count`` bytes are more than ``at_most``."""
    if count > at_most:
        raise UserError(f"{name}: {what} {size_text(count)}", legal=f"at most {size_text(at_most)}", fix=fix)


def refuse_pixels(name: str, width: int, height: int) -> None:
    """Raise UserError where an image has no pixel, or more than `FRAME_PIXELS`."""
    if width < 1 or height < 1:
        raise UserError(f"{name}: {width} x {height} pixels", legal=f"1 to {FRAME_PIXELS // 10**6} million pixels")
    if width * height > FRAME_PIXELS:
        raise UserError(
            f"{name}: {width} x {height} pixels", legal=f"at most {FRAME_PIXELS // 10**6} million pixels", fix=RAISE
        )


def bounded_bytes(path: Path, at_most: int) -> bytes:
    """Return a file's content. Raises UserError where it is larger than ``at_most``, however large it says it is (a
    sparse file, a device, a pipe); OSError as files do."""
    with Path(path).open("rb") as stream:
        content = stream.read(at_most + 1)
    if len(content) > at_most:
        raise UserError(f"{path}: has more than {size_text(at_most)}", legal=f"at most {size_text(at_most)}", fix=RAISE)
    return content


_LOCK, _BEFORE = threading.Lock(), list[tuple[int, int]]()
"""The limits before `limited_memory`, once for each place that is inside."""


@contextmanager
def limited_memory() -> Iterator[None]:
    """Limit the memory that the process may take inside to `READING_BYTES` more; beyond, MemoryError is raised.

    The limit (RLIMIT_AS) holds for all threads, from the first that enters to the last that leaves. Systems without it
    or without /proc (macOS, Windows) set none.
    """
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (ImportError, OSError):
        yield
        return
    with _LOCK:
        before = _BEFORE[0] if _BEFORE else resource.getrlimit(resource.RLIMIT_AS)
        if not _BEFORE:
            wanted = pages * resource.getpagesize() + READING_BYTES
            least = min(limit for limit in (wanted, *before) if limit != resource.RLIM_INFINITY)
            resource.setrlimit(resource.RLIMIT_AS, (least, before[1]))
        _BEFORE.append(before)
    try:
        yield
    finally:
        with _LOCK:
            before = _BEFORE.pop()
            if not _BEFORE:
                resource.setrlimit(resource.RLIMIT_AS, before)
