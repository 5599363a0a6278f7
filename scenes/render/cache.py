"""Renders kept by content: the key is everything that can change a number, the file carries its own checksum.

At the end stands the folder of stored renders as a whole: what is in it, who uses it, and what goes when it grows too
large.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import re
import stat
import struct
import time
import zipfile
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from math import prod
from operator import index
from pathlib import Path
from typing import IO, Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes
from harness.vocabulary.geometry import Region
from harness.vocabulary.locks import lock, one_at_a_time, opened_lock
from harness.vocabulary.seeds import digest
from harness.vocabulary.sources import source_digest
from scenes.optics import Optics
from scenes.render.settings import RenderConfig
from scenes.render.view import render_view
from scenes.target.custom import TargetConfig
from scenes.target.mesh import build_target
from scenes.view import NoiseFreeView

CODE = ("scenes.render.view", "scenes.target.mesh")
PACKAGES = ("mitsuba", "drjit", "trimesh", "manifold3d", "numba", "numpy", "scipy")
"""A render's numbers are decided, beside its declaration, by these modules with all that they import and by the
versions of these packages. The variant (GPU or processor) is left out: it changes them by 1e-6."""

VIEW_VERSION = 1
"""Stands in every file. One of another version counts as absent: rendering anew is always possible."""
RENDERING = ".rendering"
"""The file of which a process locks a byte while it renders a view."""
FACTS = "facts.json"
MOST_FACTS_BYTES = 1 << 20
"""They take some 500 bytes; names of ten thousand surfaces would take 200 kB."""
ARRAYS = tuple(f.name for f in fields(NoiseFreeView) if f.type == "np.ndarray")
AXES = {"phasor": "fhw", "phasor_direct": "fhw", "slopes": "hw2", "rgb": "hw3"}
"""Axes of the arrays: frequencies, rows and columns of the region; those not named have "hw"."""
TYPES = {np.dtype(name).str: np.dtype(name) for name in ("c8", "c16", "f4", "f8", "i2", "i4", "i8")}
MOST_PIXELS = 1 << 16
"""Most pixels across a region or down: ten times the largest sensor."""
RENDER_NAME = re.compile(r"[0-9a-f]{16}\.npz")
LEFTOVER_NAME = re.compile(r"\.[0-9a-f]{16}\.\w+\.part\.npz")
"""Names that `harness.vocabulary.files.atomic_path` gives a render that is being written: left behind by killed
processes."""
LEFTOVER_AFTER_S = 86_400.0
"""A render is written in less than a second; a day is far from any that is still being written, on any file system."""
LOCK = ".lock"


def render_key(target: TargetConfig, optics: Optics, config: RenderConfig) -> str:
    """Digest of what a render depends on: target, optics of the camera, work, and the code itself.

    The sensor's noise and engine are left out: cameras that differ there share renders.
    """
    return digest(
        {
            "code": source_digest(CODE, PACKAGES),
            "target": target.to_data(),
            "optics": optics.content(),
            "render": config.to_data(),
        }
    )


def cached_view(target: TargetConfig, optics: Optics, config: RenderConfig, folder: Path) -> tuple[NoiseFreeView, bool]:
    """The view of a declared target, and whether it came from the cache. A damaged file is rendered again; a view that
    another process renders is waited for.

    Raises UserError as `build_target` and `render_view` do, and where the folder cannot be written.
    """
    key = render_key(target, optics, config)
    path = folder / f"{key}.npz"
    found = read_view(path)
    if found is not None:
        return found, True
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    with one_at_a_time(folder / RENDERING, int(key[:8], 16)):
        found = read_view(path)
        if found is not None:
            return found, True
        view = render_view(build_target(target), optics, config)
        write_view(path, view)
    return view, False


def write_view(path: Path, view: NoiseFreeView) -> None:
    """Store a view as .npz, not compressed, atomically, with a checksum over all that is in it."""
    arrays = {name: np.ascontiguousarray(getattr(view, name)) for name in ARRAYS}
    facts = {
        "version": VIEW_VERSION,
        "region": asdict(view.region),
        "frequencies_hz": list(view.frequencies_hz),
        "surface_names": list(view.surface_names),
        "seconds": view.seconds,
        "variant": view.variant,
        "types": {name: array.dtype.str for name, array in arrays.items()},
    }
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(zipfile.ZipInfo(FACTS), json.dumps({**facts, "checksum": _checksum(facts, arrays)}))
        for name, array in arrays.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), _header(array.dtype, array.shape) + array.tobytes())
    write_bytes(path, buffer.getvalue(), durable=False)


def read_view(path: Path) -> NoiseFreeView | None:
    """A stored view, or None where the file is absent, truncated, damaged or of another version. A view that was read
    has been used: its file's time says so, for `trim_cache`."""
    view = stored_view(path)
    if view is not None:
        with contextlib.suppress(OSError):  # a cache that may only be read serves as well
            os.utime(path)
    return view


def stored_view(path: Path) -> NoiseFreeView | None:
    """Read a view as `read_view` does, without a trace. Nothing of a file is believed before it is checked: a part is
    read only if it is not compressed, lies in the file and has just the size that its array takes, so that memory is
    bounded by the file's size; nothing is unpickled, and nothing parsed but the facts."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            return None  # reading a pipe would wait for ever
        with open(path, "rb") as file, zipfile.ZipFile(file) as archive:
            length = archive.getinfo(FACTS).file_size
            facts = json.loads(_part(archive, file, FACTS, min(length, MOST_FACTS_BYTES)))
            arrays = {name: _array(archive, file, name, facts) for name in ARRAYS}
        checksum = facts.pop("checksum")
        if facts["version"] != VIEW_VERSION or checksum != _checksum(facts, arrays):
            return None
        return NoiseFreeView(
            region=_region(facts),
            frequencies_hz=tuple(facts["frequencies_hz"]),
            surface_names=tuple(facts["surface_names"]),
            seconds=facts["seconds"],
            variant=facts["variant"],
            **arrays,
        )
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, EOFError, struct.error, zipfile.BadZipFile):
        return None  # RuntimeError: what zipfile cannot do, and JSON that is nested too deeply


def view_bytes(region: Region, frequencies: int) -> int:
    """Return the size of a render on the disk, within 1 %, before it is made."""
    h, w = region.shape
    return h * w * (2 * 8 * frequencies + 3 * 8 + 2 + 4 + 3 * 4 + 2 * 8) + 4096


def _array(archive: zipfile.ZipFile, file: IO[bytes], name: str, facts: dict[str, Any]) -> np.ndarray:
    """An array as the facts describe it. Raises ValueError, KeyError or TypeError where it is anything else."""
    h, w = _region(facts).shape
    if not 0 < h <= MOST_PIXELS or not 0 < w <= MOST_PIXELS:
        raise ValueError("region: of no sensor")
    lengths = {"f": len(facts["frequencies_hz"]), "h": h, "w": w, "2": 2, "3": 3}
    shape = tuple(lengths[axis] for axis in AXES.get(name, "hw"))
    dtype = TYPES[facts["types"][name]]
    header = _header(dtype, shape)
    content = _part(archive, file, f"{name}.npy", len(header) + prod(shape) * dtype.itemsize)
    if not content.startswith(header):
        raise ValueError(f"{name}: is another array than the facts say")
    return np.frombuffer(bytearray(content), dtype, offset=len(header)).reshape(shape)


def _region(facts: dict[str, Any]) -> Region:
    """Raises KeyError or TypeError where there is none."""
    return Region(*(index(facts["region"][f.name]) for f in fields(Region)))


def _part(archive: zipfile.ZipFile, file: IO[bytes], name: str, size: int) -> bytes:
    """A part of an archive. Raises ValueError where it is compressed, or not of this size."""
    part = archive.getinfo(name)
    sizes = {part.compress_size, part.file_size, size}
    if part.compress_type != zipfile.ZIP_STORED or len(sizes) > 1 or size > os.fstat(file.fileno()).st_size:
        raise ValueError(f"{name}: is compressed, or of another size than its array")
    return archive.read(part)


def _header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    """Return what stands before an array in a .npy file."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": dtype.str, "fortran_order": False, "shape": shape})
    return header.getvalue()


def _checksum(facts: dict[str, Any], arrays: dict[str, np.ndarray]) -> str:
    """BLAKE2b over the facts, and over names, shapes and contents of the arrays."""
    state = hashlib.blake2b(json.dumps(facts, sort_keys=True).encode(), digest_size=16)
    for name in sorted(arrays):
        state.update(f"{name}{arrays[name].shape}{arrays[name].dtype}".encode())
        state.update(arrays[name].data)
    return state.hexdigest()


# ---- the folder of stored renders


@dataclass(frozen=True)
class StoredFile:
    """A file of the cache. ``used_s``: when it was last read or written, seconds since 1970 by the file system's
    clock; how far it can be trusted is that clock's matter, and only the order in which renders go rests on it."""

    path: Path
    size_bytes: int
    used_s: float


@dataclass(frozen=True)
class Removed:
    """Count and size of removed files and of those left."""

    renders: int = 0
    leftovers: int = 0
    freed_bytes: int = 0
    left: int = 0
    left_bytes: int = 0


def stored_renders(folder: Path) -> list[StoredFile]:
    """All renders of a folder, the longest unused first; links and anything else are passed over."""
    return sorted(_files(folder, RENDER_NAME), key=lambda file: (file.used_s, file.path.name))


def leftovers(folder: Path, older_than_s: float = LEFTOVER_AFTER_S) -> list[StoredFile]:
    """Temporary files of renders that were never finished, not touched for so long."""
    before_s = time.time() - older_than_s
    return sorted((f for f in _files(folder, LEFTOVER_NAME) if f.used_s < before_s), key=lambda f: f.path)


def damaged_renders(renders: Iterable[StoredFile]) -> list[StoredFile]:
    """Those that cannot be read: truncated, altered, or of another version. Reads them whole, 5 ms each."""
    return [file for file in renders if stored_view(file.path) is None]


def removed(files: Iterable[StoredFile]) -> list[StoredFile]:
    """Remove files; returns those that are gone. One that cannot be removed, or is gone already, is passed over."""
    gone = []
    for file in files:
        with contextlib.suppress(OSError):
            file.path.unlink()
            gone.append(file)
    return gone


def longest_unused(renders: Iterable[StoredFile], limit_bytes: int, keep: Collection[Path]) -> list[StoredFile]:
    """Choose the renders that go so that all fit into ``limit_bytes``: the longest unused first, never those of
    ``keep`` (by name), so that the limit may still be exceeded."""
    kept = {path.name for path in keep}
    renders = sorted(renders, key=lambda file: (file.used_s, file.path.name))
    excess = sum(file.size_bytes for file in renders) - limit_bytes
    going = []
    for file in renders:
        if excess <= 0:
            break
        if file.path.name not in kept:
            going.append(file)
            excess -= file.size_bytes
    return going


def trim_cache(folder: Path, limit_bytes: int, keep: Collection[Path] = ()) -> Removed:
    """Remove the longest unused renders until the rest fits into ``limit_bytes``, never those of ``keep``; and what
    killed processes left, when it is older than a day.

    Does nothing where another process uses the folder (`in_use`): its trials may need any of them.
    """
    try:
        with alone(folder):
            renders = stored_renders(folder)
            gone = removed(longest_unused(renders, limit_bytes, keep))
            left_behind = removed(leftovers(folder))
    except UserError:
        gone, left_behind, renders = [], [], stored_renders(folder)
    freed = sum(file.size_bytes for file in gone)
    return Removed(
        renders=len(gone),
        leftovers=len(left_behind),
        freed_bytes=freed + sum(file.size_bytes for file in left_behind),
        left=len(renders) - len(gone),
        left_bytes=sum(file.size_bytes for file in renders) - freed,
    )


@contextlib.contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """While a sweep runs: nobody removes renders of this folder. Any number of sweeps may use it at once.

    A process that dies gives it back. On systems without such locks nothing is held. Raises nothing where the folder
    cannot be written: who cannot write a lock cannot be kept from reading.
    """
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            lock(held.enter_context(opened_lock(folder / LOCK)), shared=True, wait=True)
        yield


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """While renders are removed: no sweep uses this folder. Raises UserError where one does, or where the folder cannot
    be written."""
    with contextlib.ExitStack() as held:
        try:
            file = held.enter_context(opened_lock(folder / LOCK))
        except OSError as error:
            raise UserError(f"{folder}: cannot be written ({error.strerror})", fix="ask whoever owns it") from error
        if lock(file, shared=False, wait=False) == "busy":
            raise UserError(
                f"{folder}: a sweep that is running uses these renders",
                fix="wait until it has ended; nothing was removed",
            )
        yield


def _files(folder: Path, names: re.Pattern[str]) -> Iterator[StoredFile]:
    """Regular files of a folder by their names; one that vanishes meanwhile is passed over."""
    try:
        entries = os.scandir(folder)
    except (FileNotFoundError, NotADirectoryError):
        return
    with entries:
        for entry in entries:
            if names.fullmatch(entry.name) is None:
                continue
            with contextlib.suppress(OSError):
                found = entry.stat(follow_symlinks=False)
                if stat.S_ISREG(found.st_mode):
                    yield StoredFile(Path(entry.path), found.st_size, found.st_mtime)
