"""The folder of stored renders as a whole: what is in it, who uses it, and what goes when it grows too large."""

from __future__ import annotations

import contextlib
import os
import re
import stat
import time
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from harness.vocabulary.errors import UserError
from harness.vocabulary.locks import lock, opened_lock
from scenes.render.cache import stored_view

RENDER_NAME = re.compile(r"[0-9a-f]{16}\.npz")
LEFTOVER_NAME = re.compile(r"\.[0-9a-f]{16}\.\w+\.part\.npz")
"""What `harness.vocabulary.files.atomic_path` calls a render that is being written: left behind by killed processes."""
LEFTOVER_AFTER_S = 86_400.0
"""A render is written in less than a second; a day is far from any that is still being written, on any file system."""
LOCK = ".lock"


@dataclass(frozen=True)
class StoredFile:
    """A file of the cache. ``used_s``: when it was last read or written, seconds since 1970 by the file system's
    clock; how far it can be trusted is that clock's matter, and only the order in which renders go rests on it."""

    path: Path
    size_bytes: int
    used_s: float


@dataclass(frozen=True)
class Removed:
    """What was removed, and what is left."""

    renders: int = 0
    leftovers: int = 0
    freed_bytes: int = 0
    left: int = 0
    left_bytes: int = 0


def stored_renders(folder: Path) -> list[StoredFile]:
    """All renders of a folder, the longest unused first; links and anything else are passed over."""
    return sorted(_files(folder, RENDER_NAME), key=lambda one: (one.used_s, one.path.name))


def leftovers(folder: Path, older_than_s: float = LEFTOVER_AFTER_S) -> list[StoredFile]:
    """Temporary files of renders that were never finished, not touched for so long."""
    before_s = time.time() - older_than_s
    return sorted((one for one in _files(folder, LEFTOVER_NAME) if one.used_s < before_s), key=lambda one: one.path)


def damaged_renders(renders: Iterable[StoredFile]) -> list[StoredFile]:
    """Those that cannot be read: truncated, altered, or of another version. Reads them whole, 5 ms each."""
    return [one for one in renders if stored_view(one.path) is None]


def removed(files: Iterable[StoredFile]) -> list[StoredFile]:
    """Remove files; returns those that are gone. One that cannot be removed, or is gone already, is passed over."""
    gone = []
    for one in files:
        with contextlib.suppress(OSError):
            one.path.unlink()
            gone.append(one)
    return gone


def longest_unused(renders: Iterable[StoredFile], limit_bytes: int, keep: Collection[Path]) -> list[StoredFile]:
    """Which renders go so that all fit into ``limit_bytes``: the longest unused first, never those of ``keep`` (by
    name), so that the limit may still be exceeded."""
    kept = {path.name for path in keep}
    renders = sorted(renders, key=lambda one: (one.used_s, one.path.name))
    excess = sum(one.size_bytes for one in renders) - limit_bytes
    going = []
    for one in renders:
        if excess <= 0:
            break
        if one.path.name not in kept:
            going.append(one)
            excess -= one.size_bytes
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
    freed = sum(one.size_bytes for one in gone)
    return Removed(
        renders=len(gone),
        leftovers=len(left_behind),
        freed_bytes=freed + sum(one.size_bytes for one in left_behind),
        left=len(renders) - len(gone),
        left_bytes=sum(one.size_bytes for one in renders) - freed,
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
