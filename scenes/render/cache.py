"""Stores renders by content, in files with a checksum; lists, locks and trims their folder."""

import contextlib
import io
import json
import os
import re
import stat
import time
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import IO, Any

import numpy as np

from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import one_at_a_time, opened_lock, write_bytes
from harness.vocabulary.geometry import Region
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import digest
from scenes.optics import NoiseFreeView, Optics, RenderConfig
from scenes.target.custom import TargetConfig

# modules (with all that they import) and packages that determine a render's results; a GPU changes
# them by 1e-6
CODE = ("scenes.render.view", "scenes.target.mesh")
PACKAGES = ("mitsuba", "drjit", "trimesh", "manifold3d", "numba", "numpy", "scipy")
VIEW_VERSION = 3  # stored in every file; a file of another version counts as absent
MOST_BYTES = 2 << 30  # a sensor of a million pixels at a hundred frequencies needs 1.7 GB
CHECKSUM_BYTES = 4  # any flipped byte or run of bytes changes them; BLAKE2 takes four times as long
ARRAYS = tuple(f.name for f in fields(NoiseFreeView) if f.type == "np.ndarray")
RENDER_NAME = re.compile(r"[0-9a-f]{16}\.npz")
# names of renders being written, by `files`
LEFTOVER_NAME = re.compile(r"\.[0-9a-f]{16}\.\w+\.part\.npz")
LEFTOVER_AFTER_S = 86_400.0  # writing a render takes less than a second
# each render locks a byte of the first; a running sweep holds the second
RENDERING = ".rendering"
LOCK = ".lock"


def render_key(
    target: TargetConfig,
    optics: Optics,
    config: RenderConfig,
    region: Region | None = None,
) -> str:
    """Return the digest of all inputs of a render: target, the camera's optics (not its engine),
    effort, code, and the region unless it is that of the target."""
    inputs = {
        "code": source_digest(CODE, PACKAGES),
        "target": target.to_data(),
        "optics": optics.content(),
        "render": config.to_data(),
    }
    if region is not None:
        inputs["region"] = asdict(region)
    return digest(inputs)


def cached_view(
    target: TargetConfig,
    optics: Optics,
    config: RenderConfig,
    folder: Path,
    region: Region | None = None,
) -> tuple[NoiseFreeView, bool]:
    """Return the view of a declared target on ``region`` or on that of the target, and whether it
    came from the cache. If another process renders it, wait for that. Raises UserError as
    `build_target` and `render_view` do, and if the folder cannot be written."""
    key = render_key(target, optics, config, region)
    path = folder / f"{key}.npz"
    stored = read_view(path)
    if stored is not None:
        return stored, True
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    with one_at_a_time(folder / RENDERING, int(key[:8], 16)):
        stored = read_view(path)  # another process may have rendered it meanwhile
        if stored is not None:
            return stored, True
        from scenes.render.view import render_view  # with trimesh, which no trial needs
        from scenes.target.mesh import build_target

        view = render_view(build_target(target), optics, config, region)
        write_view(path, view)
        return view, False


def write_view(path: Path, view: NoiseFreeView) -> None:
    """Write a view as .npz, uncompressed and atomically, with a checksum of the whole file after
    it."""
    facts: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    for field in fields(view):
        value = getattr(view, field.name)
        if field.name in ARRAYS:
            arrays[field.name] = value
        else:
            facts[field.name] = value
    facts["version"] = VIEW_VERSION
    facts["region"] = asdict(view.region)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in {"facts": np.array(json.dumps(facts)), **arrays}.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as part:
                _write_array(part, np.asanyarray(array, order="C"))
    with buffer.getbuffer() as content:
        checksum = _checksum(content)
    buffer.write(checksum)
    write_bytes(path, buffer.getvalue(), durable=False)


def _write_array(file: IO[bytes], array: np.ndarray) -> None:
    """Write an array as .npy, as `numpy.lib.format.write_array` does, without a copy of it."""
    header = np.lib.format.header_data_from_array_1_0(array)
    np.lib.format.write_array_header_1_0(file, header)
    file.write(array.reshape(-1).view(np.uint8).data)


def _checksum(content: bytes | memoryview) -> bytes:
    return zlib.crc32(content).to_bytes(CHECKSUM_BYTES, "little")


def read_view(path: Path) -> NoiseFreeView | None:
    """Return a stored view; None if the file is absent, truncated, damaged or of another version.
    Nothing is parsed before the checksum has been verified, and nothing is unpickled; the file's
    size bounds the memory. Reading a view updates its file's time, from which `trim_cache` knows
    the last use."""
    try:
        status = os.stat(path)
        if not stat.S_ISREG(status.st_mode) or status.st_size > MOST_BYTES:
            return None  # reading a pipe would wait forever
        content = memoryview(path.read_bytes())
        body = content[:-CHECKSUM_BYTES]
        if _checksum(body) != content[-CHECKSUM_BYTES:]:
            return None
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            facts = json.loads(str(_array_in(archive, "facts")))
            if facts.pop("version") != VIEW_VERSION:
                return None
            facts |= {name: _array_in(archive, name) for name in ARRAYS}
        facts["region"] = Region(**facts["region"])
        for name in ("frequencies_hz", "surface_names"):
            facts[name] = tuple(facts[name])
        view = NoiseFreeView(**facts)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
    with contextlib.suppress(OSError):  # a read-only cache works too
        os.utime(path)
    return view


def _array_in(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Return a stored array, as `numpy.load` does, in half of its time. Raises ValueError for
    objects."""
    content = io.BytesIO(archive.read(f"{name}.npy"))
    if np.lib.format.read_magic(content) != (1, 0):
        raise ValueError(f"{name}: another version of the format")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(content)
    if is_fortran:
        raise ValueError(f"{name}: columns first")
    values = np.frombuffer(content.getbuffer(), dtype, offset=content.tell())
    return values.reshape(shape).copy()


@dataclass(frozen=True)
class StoredFile:
    """A file of the cache."""

    path: Path
    """Its path."""
    size_bytes: int
    """Its size."""
    used_s: float
    """Time when it was last read or written, in seconds since 1970 (file system's)."""


def stored_renders(folder: Path) -> list[StoredFile]:
    """Return all renders of a folder, the longest unused first, without links and other files."""
    return sorted(_files(folder, RENDER_NAME), key=_last_use)


def _last_use(file: StoredFile) -> tuple[float, str]:
    return file.used_s, file.path.name


def leftovers(
    folder: Path,
    older_than_s: float = LEFTOVER_AFTER_S,
) -> list[StoredFile]:
    """Return the temporary files of renders that were never finished, if untouched for
    ``older_than_s``."""
    before_s = time.time() - older_than_s
    old = [file for file in _files(folder, LEFTOVER_NAME) if file.used_s < before_s]
    return sorted(old, key=lambda file: file.path)


def removed(files: Iterable[StoredFile]) -> list[StoredFile]:
    """Remove files and return those that are gone. Files that cannot be removed, or are gone
    already, are skipped."""
    gone = []
    for file in files:
        with contextlib.suppress(OSError):
            file.path.unlink()
            gone.append(file)
    return gone


def longest_unused(
    renders: Iterable[StoredFile],
    limit_bytes: int,
    keep: Collection[Path],
) -> list[StoredFile]:
    """Return the longest unused renders to remove so that the rest fits ``limit_bytes``; none of
    ``keep`` (names)."""
    names_to_keep = {path.name for path in keep}
    by_last_use = sorted(renders, key=_last_use)
    excess_bytes = sum(file.size_bytes for file in by_last_use) - limit_bytes
    to_remove = []
    for file in by_last_use:
        if excess_bytes > 0 and file.path.name not in names_to_keep:
            to_remove.append(file)
            excess_bytes -= file.size_bytes
    return to_remove


def trim_cache(
    folder: Path,
    limit_bytes: int,
    keep: Collection[Path] = (),
) -> int:
    """Remove the longest unused renders until the rest fits ``limit_bytes``, but none of ``keep``,
    and old leftovers of killed processes; remove nothing while another process uses the folder.
    Return how many are left."""
    with contextlib.suppress(UserError), alone(folder):
        removed(longest_unused(stored_renders(folder), limit_bytes, keep))
        removed(leftovers(folder))
    return len(stored_renders(folder))


@contextlib.contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """Prevent the removal of renders from this folder while a sweep runs, if system and folder
    allow locks."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            file = stack.enter_context(opened_lock(folder / LOCK))
            system.lock(
                file,
                shared=True,
                wait=True,
            )
        yield


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep sweeps from using this folder. Raises UserError if one does, or if the folder cannot be
    written."""
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(opened_lock(folder / LOCK))
        except OSError as error:
            raise UserError(
                f"{folder}: cannot be written ({error.strerror})", fix="ask its owner"
            ) from error
        if (
            system.lock(
                file,
                shared=False,
                wait=False,
            )
            == "busy"
        ):
            raise UserError(
                f"{folder}: a sweep that is running uses these renders",
                fix="wait until it has ended; nothing was removed",
            )
        yield


def _files(folder: Path, names: re.Pattern[str]) -> Iterator[StoredFile]:
    """Yield the regular files of a folder by name; files that vanish meanwhile are skipped."""
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if names.fullmatch(path.name):
            with contextlib.suppress(OSError):
                status = path.lstat()
                if stat.S_ISREG(status.st_mode):
                    yield StoredFile(path, status.st_size, status.st_mtime)
