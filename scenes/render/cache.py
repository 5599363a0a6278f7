"""Stores renders by content, in files with a checksum; lists, locks and trims their folder."""

import contextlib
import hashlib
import io
import json
import os
import re
import stat
import time
import zipfile
from collections.abc import Collection, Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import lock, one_at_a_time, opened_lock, write_bytes
from harness.vocabulary.geometry import Region
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import digest
from scenes.optics import NoiseFreeView, Optics, RenderConfig
from scenes.target.custom import TargetConfig

CODE = ("scenes.render.view", "scenes.target.mesh")
PACKAGES = ("mitsuba", "drjit", "trimesh", "manifold3d", "numba", "numpy", "scipy")
"""Modules (with all that they import) and packages that determine a render's results; a GPU
changes them by 1e-6."""
VIEW_VERSION = 2  # stored in every file; a file of another version counts as absent
MOST_BYTES = 2 << 30  # a sensor of a million pixels at a hundred frequencies needs 1.7 GB
CHECKSUM_BYTES = 16
ARRAYS = tuple(f.name for f in fields(NoiseFreeView) if f.type == "np.ndarray")
RENDER_NAME = re.compile(r"[0-9a-f]{16}\.npz")
LEFTOVER_NAME = re.compile(
    r"\.[0-9a-f]{16}\.\w+\.part\.npz"
)  # names of renders being written, by `files`
LEFTOVER_AFTER_S = 86_400.0  # writing a render takes less than a second
# each render locks a byte of the first; a running sweep holds the second
RENDERING = ".rendering"
LOCK = ".lock"


def render_key(target: TargetConfig, optics: Optics, config: RenderConfig) -> str:
    """Return the digest of all inputs of a render: target, the camera's optics (not its engine),
    effort and code."""
    content = {"target": target.to_data(), "optics": optics.content(), "render": config.to_data()}
    return digest({"code": source_digest(CODE, PACKAGES), **content})


def cached_view(
    target: TargetConfig, optics: Optics, config: RenderConfig, folder: Path
) -> tuple[NoiseFreeView, bool]:
    """Return the view of a declared target, and whether it came from the cache. If another process
    renders it, wait for that. Raises UserError as `build_target` and `render_view` do, and if the
    folder cannot be written."""
    key = render_key(target, optics, config)
    path = folder / f"{key}.npz"
    found = read_view(path)
    if found is None:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
        with one_at_a_time(folder / RENDERING, int(key[:8], 16)):
            found = read_view(path)
            if found is None:
                from scenes.render.view import render_view  # with trimesh, which no trial needs
                from scenes.target.mesh import build_target

                view = render_view(build_target(target), optics, config)
                write_view(path, view)
                return view, False
    return found, True


def write_view(path: Path, view: NoiseFreeView) -> None:
    """Write a view as .npz, uncompressed and atomically, followed by a checksum of the whole file."""
    kept = {f.name: getattr(view, f.name) for f in fields(view) if f.name not in ARRAYS}
    facts = json.dumps({**kept, "version": VIEW_VERSION, "region": asdict(view.region)})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in {
            "facts": np.array(facts),
            **{name: getattr(view, name) for name in ARRAYS},
        }.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w") as part:
                np.lib.format.write_array(part, np.asanyarray(array, order="C"), allow_pickle=False)
    content = buffer.getvalue()
    write_bytes(
        path, content + hashlib.blake2b(content, digest_size=CHECKSUM_BYTES).digest(), durable=False
    )


def read_view(path: Path) -> NoiseFreeView | None:
    """Return a stored view; None if the file is absent, truncated, damaged or of another version.
    Nothing is parsed before the checksum has been verified, and nothing is unpickled; the file's
    size bounds the memory. Reading a view updates its file's time, from which `trim_cache` knows
    the last use."""
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode) or found.st_size > MOST_BYTES:
            return None  # reading a pipe would wait forever
        content = memoryview(path.read_bytes())
        body = content[:-CHECKSUM_BYTES]
        checksum = content[-CHECKSUM_BYTES:]
        if hashlib.blake2b(body, digest_size=CHECKSUM_BYTES).digest() != checksum:
            return None
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            facts = json.loads(str(archive["facts"]))
            if facts.pop("version") != VIEW_VERSION:
                return None
            arrays = {name: archive[name] for name in ARRAYS}
        lists = {name: tuple(facts.pop(name)) for name in ("frequencies_hz", "surface_names")}
        view = NoiseFreeView(**{**facts, **lists, **arrays, "region": Region(**facts["region"])})
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
    with contextlib.suppress(OSError):  # a read-only cache works too
        os.utime(path)
    return view


@dataclass(frozen=True)
class StoredFile:
    """A file of the cache. ``used_s``: when it was last read or written, in seconds since 1970
    (file system's time)."""

    path: Path
    size_bytes: int
    used_s: float


def stored_renders(folder: Path) -> list[StoredFile]:
    """Return all renders of a folder, the longest unused first, without links and other files."""
    return sorted(_files(folder, RENDER_NAME), key=lambda file: (file.used_s, file.path.name))


def leftovers(folder: Path, older_than_s: float = LEFTOVER_AFTER_S) -> list[StoredFile]:
    """Return the temporary files of renders that were never finished, if untouched for
    ``older_than_s``."""
    before_s = time.time() - older_than_s
    return sorted(
        (f for f in _files(folder, LEFTOVER_NAME) if f.used_s < before_s), key=lambda f: f.path
    )


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
    renders: Iterable[StoredFile], limit_bytes: int, keep: Collection[Path]
) -> list[StoredFile]:
    """Return the longest unused renders to remove so that the rest fits ``limit_bytes``; none of
    ``keep`` (names)."""
    kept = {path.name for path in keep}
    renders = sorted(renders, key=lambda file: (file.used_s, file.path.name))
    excess = sum(file.size_bytes for file in renders) - limit_bytes
    going = []
    for file in renders:
        if excess > 0 and file.path.name not in kept:
            going.append(file)
            excess -= file.size_bytes
    return going


def trim_cache(folder: Path, limit_bytes: int, keep: Collection[Path] = ()) -> int:
    """Remove the longest unused renders until the rest fits ``limit_bytes``, but none of ``keep``,
    and old leftovers of killed processes; remove nothing while another process uses the folder.
    Return how many are left."""
    with contextlib.suppress(UserError), alone(folder):
        removed([*longest_unused(stored_renders(folder), limit_bytes, keep), *leftovers(folder)])
    return len(stored_renders(folder))


@contextlib.contextmanager
def in_use(folder: Path) -> Iterator[None]:
    """Prevent the removal of renders from this folder while a sweep runs, if system and folder
    allow locks."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            lock(held.enter_context(opened_lock(folder / LOCK)), shared=True, wait=True)
        yield


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Keep sweeps from using this folder. Raises UserError if one does, or if the folder cannot be
    written."""
    with contextlib.ExitStack() as held:
        try:
            file = held.enter_context(opened_lock(folder / LOCK))
        except OSError as error:
            raise UserError(
                f"{folder}: cannot be written ({error.strerror})", fix="ask its owner"
            ) from error
        if lock(file, shared=False, wait=False) == "busy":
            fix = "wait until it has ended; nothing was removed"
            raise UserError(f"{folder}: a sweep that is running uses these renders", fix=fix)
        yield


def _files(folder: Path, names: re.Pattern[str]) -> Iterator[StoredFile]:
    """Yield the regular files of a folder by name; files that vanish in the meantime are skipped."""
    for path in folder.iterdir() if folder.is_dir() else ():
        if names.fullmatch(path.name):
            with contextlib.suppress(OSError):
                found = path.lstat()
                if stat.S_ISREG(found.st_mode):
                    yield StoredFile(path, found.st_size, found.st_mtime)
