"""Reading files within size limits and as strict JSON, writing them atomically, and locking them.

A hostile file may try to fill the memory. Most such files are refused unread; libraries run in
`limited_memory`."""

import errno
import hashlib
import json
import math
import os
import shutil
import stat
import sysconfig
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

from harness.vocabulary import system
from harness.vocabulary.errors import DiskFull, UserError

# A frame, picture or cloud: sixty times the largest depth sensor; 1.5 GB as points
FRAME_PIXELS = 64_000_000
ARRAYS_BYTES = (
    4 << 30
)  # All arrays of one ``.npz`` or ``.mat``: 5,800 frames of an Azure Kinect in 16 bits
READING_BYTES = (
    5 << 30
)  # Memory of a library that reads one file: `ARRAYS_BYTES` and the memory to unpack them
PICTURE_BYTES = (
    512 << 20
)  # A picture file: more than `FRAME_PIXELS` of 48 bits need without compression
RECORD_BYTES = (
    256 << 20
)  # A study's record: three million inspections; Python objects take 10 times as much
TEXT_BYTES = (
    16 << 20
)  # A file of settings, poses or calibration, or a bag's description: usually a few kB
TABLE_BYTES = 256 << 20  # A table of inspections: five million rows
RAISE = "if the file must be this large, raise the limit in harness/vocabulary/files.py"


def size_text(count: int) -> str:
    """Return a number of bytes as text in the unit that is easiest to read."""
    units = (("GiB", 1 << 30), ("MiB", 1 << 20), ("kiB", 1 << 10))
    return next(
        (f"{count / factor:.4g} {unit}" for unit, factor in units if count >= factor),
        f"{count} bytes",
    )


def refuse_bytes(name: str, count: int, at_most: int, verb: str = "has", fix: str = RAISE) -> None:
    """Raise UserError if ``count`` bytes exceed ``at_most``."""
    if count > at_most:
        raise UserError(
            f"{name}: {verb} {size_text(count)}", legal=f"at most {size_text(at_most)}", fix=fix
        )


def refuse_pixels(name: str, width: int, height: int) -> None:
    """Raise UserError if an image has no pixels, or more than `FRAME_PIXELS`."""
    if min(width, height) < 1 or width * height > FRAME_PIXELS:
        legal = f"1 to {FRAME_PIXELS // 10**6} million pixels"
        fix = RAISE if min(width, height) > 0 else None
        raise UserError(f"{name}: {width} x {height} pixels", legal=legal, fix=fix)


def bounded_bytes(path: Path, at_most: int) -> bytes:
    """Return the content of a file, device or pipe. Raises UserError if it exceeds ``at_most``,
    OSError as `open`."""
    with Path(path).open("rb") as stream:
        content = stream.read(at_most + 1)
    if len(content) > at_most:
        raise UserError(
            f"{path}: has more than {size_text(at_most)}",
            legal=f"at most {size_text(at_most)}",
            fix=RAISE,
        )
    return content


def shipped(kind: str) -> Path:
    """Return the folder ``experiments`` or ``baselines``: of tofpod's checkout, or else of the
    environment."""
    folder = Path(__file__).resolve().parents[2] / (
        "results/baselines" if kind == "baselines" else kind
    )
    return (
        folder if folder.is_dir() else Path(sysconfig.get_path("data")) / "share" / "tofpod" / kind
    )


@contextmanager
def limited_memory() -> Iterator[None]:
    """Limit the additional memory of the process to `READING_BYTES`, where the system can; an
    excess raises MemoryError."""
    with system.limited_memory(READING_BYTES):
        yield


def strict_json(content: bytes | str, *, nan: bool = False) -> Any:
    """Return the value of a JSON text (UTF-8). Raises ValueError with the reason if the text is
    not JSON, repeats a key in an object, holds NaN or Infinity (unless ``nan``), is nested too
    deeply, or holds too long an integer."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        for key, value in pairs:
            if key in mapping:
                raise ValueError(f"the key {key[:60]} occurs twice")
            mapping[key] = value
        return mapping

    def no_number(word: str) -> Any:
        raise ValueError(f"{word} is not a JSON number")

    text = content.decode("utf-8-sig") if isinstance(content, bytes) else content
    try:
        return json.loads(text, object_pairs_hook=unique, parse_constant=None if nan else no_number)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


NOT_WRITABLE = {
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOTDIR,
    errno.EEXIST,
    errno.EISDIR,
    errno.ENOENT,
}
NOT_WRITABLE |= {errno.ENAMETOOLONG, errno.EINVAL}
"""Error numbers for a place where no file can be created (ENOENT for a place inside /proc)."""


@contextmanager
def atomic_path(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` (same suffix); rename it on success, delete it on
    failure. ``durable`` flushes the file to disk before the rename. Raises UserError if the folder
    is not writable or the disk is full."""
    path = Path(path)

    def make() -> str:
        handle, name = tempfile.mkstemp(
            prefix=f".{path.stem}.", suffix=f".part{path.suffix}", dir=path.parent
        )
        os.close(handle)
        return name

    with _renamed(path, make, 0o666) as temporary:
        yield temporary
        if durable:
            system.flush_to_disk(temporary)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to ``path`` on success. Raises UserError if it
    cannot be created."""
    path = Path(path)
    if path.is_dir() and any(path.iterdir()):
        raise UserError(
            f"{path}: the folder is not empty; it was not changed",
            fix="name a new folder with --out",
        )

    def make() -> str:
        if path.exists() and not path.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))
        return tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)

    with _renamed(path, make, 0o777) as temporary:
        yield temporary


@contextmanager
def _renamed(path: Path, make: Callable[[], str], mode: int) -> Iterator[Path]:
    """Create a temporary file or folder and rename it, with the user's umask: tempfile makes
    everything private."""
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(make())
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(mode & ~umask)
        system.replace(temporary, path)
    except OSError as error:
        raise explained(error, path) from error
    finally:
        if temporary is not None and temporary.exists():
            shutil.rmtree(
                temporary, ignore_errors=True
            ) if temporary.is_dir() else temporary.unlink()


def inside(folder: Path, *parts: str) -> Path:
    """Return ``folder`` joined with ``parts``, names that may come from an untrusted file. Raises
    UserError if a part is not a plain name, or if a link in ``folder`` leads out of it. ``folder``
    itself may be a link."""
    for part in parts:
        if part in ("", ".", "..") or any(letter in part for letter in "/\\\0"):
            raise UserError(
                f"{part!r} is not a name for a file or folder", legal="letters, digits, - and _"
            )
    path = Path(folder).joinpath(*parts)
    if not path.resolve().is_relative_to(Path(folder).resolve()):
        fix = f"remove the link, or name its target with --out; {folder} itself may be a link"
        raise UserError(
            f"{path}: is a link that leads out of {folder}, to {path.resolve()}", fix=fix
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
    """Open a regular file, never through a link; a file opened for writing is unbuffered.
    ``flags`` are those of `os.open`. Raises UserError if the path is a link, a pipe or a folder;
    OSError as `os.open` does."""
    irregular = UserError(
        f"{path}: is not a regular file, so it is neither read nor written", fix="remove it"
    )
    if path.is_symlink() or path.is_dir():
        raise irregular
    descriptor = os.open(path, flags | system.flags_of_plain_file(), 0o666)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise irregular
    writes = flags & (os.O_WRONLY | os.O_RDWR)
    return os.fdopen(descriptor, "r+b" if writes else "rb", buffering=0 if writes else -1)


def explained(error: OSError, path: Path) -> Exception:
    """Return the user's mistake that caused an OSError during writing, or the error itself if the
    cause is unknown."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        fix = "free some space and run the same command again; finished work is kept"
        return DiskFull(f"{path}: the disk is full", fix=fix)
    if error.errno == errno.EFBIG:
        problem = f"{path}: becomes larger than this system lets a file be"
        return UserError(
            problem, fix="raise the limit (ulimit -f), or name another disk with --out"
        )
    if error.errno is not None and error.errno in NOT_WRITABLE:
        reason = os.strerror(error.errno).lower()
        return UserError(
            f"{path}: cannot be written ({reason})",
            fix="name a folder that you may write to with --out",
        )
    return error


def opened_lock(path: Path) -> IO[bytes]:
    """Open a lock file; create it if it is missing. Raises OSError, or UserError if it is not a
    regular file."""
    return open_plain(path, os.O_RDWR | os.O_CREAT | os.O_APPEND)


@contextmanager
def one_at_a_time(path: Path, number: int) -> Iterator[None]:
    """Lock byte ``number`` of a lock file against other processes, if the system supports locks."""
    try:
        file = opened_lock(path)
    except OSError:
        yield
        return
    with file, system.locked_byte(file, number):
        yield


def file_digest(path: Path) -> str:
    """Return the digest of a file's content; the file is read again if its size or modification
    time has changed."""
    status = path.stat()
    return _digest_of(path, status.st_size, status.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _digest_of(path: Path, size: int, changed_ns: int) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, lambda: hashlib.blake2b(digest_size=16)).hexdigest()


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write `plain_json` atomically. Raises UserError as `atomic_path` does."""
    write_text(path, plain_json(data))


def plain_json(data: Mapping[str, Any]) -> str:
    """Return readable JSON of `jsonable` data."""
    return json.dumps(jsonable(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def jsonable(value: Any) -> Any:
    """Convert plain data, tuples, arrays and NumPy numbers to JSON types; numbers that are not
    finite become None."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [jsonable(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
