"""Writing files: a reader never sees half of one; a full disk or a locked folder is a clear message."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from harness.vocabulary.errors import DiskFull, UserError

NOT_WRITABLE = {
    getattr(errno, name)
    for name in ("EACCES", "EPERM", "EROFS", "ENOTDIR", "EEXIST", "EISDIR", "ENOENT", "ENAMETOOLONG", "EINVAL")
}
"""Errors of a place where no file can be made (ENOENT for one inside /proc)."""


@contextmanager
def atomic_path(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` (same suffix); rename it to ``path`` on success, delete it on failure.

    ``durable``: the content is on the disk before it has its name, so that a power failure leaves the old file or the
    new file; what can be made again at no cost may do without. Raises UserError where the folder cannot be written or
    the disk is full.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=f".part{path.suffix}", dir=path.parent)
        os.close(handle)
    except OSError as error:
        raise explained(error, path) from error
    temporary = Path(name)
    try:
        yield temporary
        if durable:
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
        _move_shared(temporary, path, 0o666)
    except OSError as error:
        raise explained(error, path) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield an empty temporary folder beside ``path``; rename it to ``path`` on success, delete it on failure.

    Raises UserError where ``path`` exists and is no empty folder, cannot be written, or the disk is full.
    """
    path = Path(path)
    if path.is_dir() and any(path.iterdir()):
        raise UserError(f"{path}: is not empty, and nothing is written over", fix="name a new folder with --out")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not path.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent))
    except OSError as error:
        raise explained(error, path) from error
    try:
        yield temporary
        _move_shared(temporary, path, 0o777)
    except OSError as error:
        raise explained(error, path) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _move_shared(temporary: Path, path: Path, mode: int) -> None:
    """Rename, with the permissions that the user's umask leaves: tempfile makes everything private."""
    umask = os.umask(0)
    os.umask(umask)
    temporary.chmod(mode & ~umask)
    os.replace(temporary, path)


def inside(folder: Path, *parts: str) -> Path:
    """``folder`` with ``parts`` below it, for names that somebody else may have chosen.

    Raises UserError where a part is no plain name (empty, "..", with a separator or a zero byte), or where a link that
    lies in ``folder`` leads out of it: what is written would land elsewhere. ``folder`` itself may be a link.
    """
    for part in parts:
        if part in ("", ".", "..") or any(letter in part for letter in "/\\\0"):
            raise UserError(f"{part!r} is no name of a file or folder", legal="letters, digits, - and _")
    path = Path(folder).joinpath(*parts)
    if not path.resolve().is_relative_to(Path(folder).resolve()):
        raise UserError(
            f"{path}: is a link that leads out of {folder}, to {path.resolve()}",
            fix=f"remove the link, or name its goal with --out; {folder} itself may be a link",
        )
    return path


def write_bytes(path: Path, content: bytes, *, durable: bool = True) -> None:
    """Write ``content`` atomically. Raises UserError as `atomic_path` does."""
    with atomic_path(path, durable=durable) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, content: str, *, durable: bool = True) -> None:
    """Write UTF-8 text atomically. Raises UserError as `atomic_path` does."""
    write_bytes(path, content.encode(), durable=durable)


def open_plain(path: Path, flags: int) -> IO[bytes]:
    """Open a regular file, unbuffered where it is written: never through a link, and without waiting for a pipe.

    ``flags`` as of `os.open`. Raises UserError where the path is a link, a pipe or a folder; OSError as `os.open` does.
    """
    odd = UserError(f"{path}: is not a regular file, so nothing is read from it or written to it", fix="remove it")
    if path.is_symlink() or path.is_dir():
        raise odd
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    descriptor = os.open(path, flags, 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise odd
    writes = flags & (os.O_WRONLY | os.O_RDWR)
    return os.fdopen(descriptor, "r+b" if writes else "rb", buffering=0 if writes else -1)


def explained(error: OSError, path: Path) -> Exception:
    """Return the user's mistake behind an OSError of writing, or the error itself where it is not a known one."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DiskFull(
            f"{path}: the disk is full", fix="free some space and run the same command again; finished work is kept"
        )
    if error.errno is not None and error.errno in NOT_WRITABLE:
        reason = os.strerror(error.errno).lower()
        return UserError(f"{path}: cannot be written ({reason})", fix="name a folder that you may write to with --out")
    return error
