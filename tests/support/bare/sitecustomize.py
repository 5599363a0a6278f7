"""Takes away what Linux has and Windows lacks: with this folder first in PYTHONPATH, Python imports
this file at its start, in each process.

No `fcntl` and `resource`; no fork; no /proc; no links, if WITHOUT_LINKS is set; no `poll`, masks of signals and SIGUSR1; a
file that is open can neither be removed nor renamed over, and is flushed only if it is open for
writing. A stand-in for `msvcrt` locks as Windows does: for a single open file, without waiting."""

from __future__ import annotations

import errno
import faulthandler
import fcntl
import multiprocessing
import multiprocessing.context
import os
import select
import signal
import struct
import subprocess  # noqa: F401 (would take the stand-in for Windows)
import sys
import types
from typing import Any

flags_of = fcntl.fcntl
# threadpoolctl reads this; it has a way of its own on each system
OF_A_LIBRARY = "/proc/self/maps"
LOCK_FORMAT = "hhqqi"  # struct flock of Linux


def locking(descriptor: int, mode: int, count: int) -> None:
    """Lock ``count`` bytes from the file's position on."""
    start = os.lseek(descriptor, 0, os.SEEK_CUR)
    if start >= 1 << 31:
        raise OSError(errno.EINVAL, "a position of more than 32 bits")
    wanted = struct.pack(LOCK_FORMAT, fcntl.F_WRLCK, os.SEEK_SET, start, count, 0)
    flags_of(descriptor, fcntl.F_OFD_SETLK, wanted)


def refuse_open_file(path: Any) -> None:
    """Raise PermissionError if this process has a file open, as Windows does."""
    wanted = os.path.abspath(os.fsdecode(path))
    for number in os.listdir("/dev/fd"):
        try:
            is_open = os.readlink(f"/dev/fd/{number}") == wanted
        except OSError:
            continue
        if is_open:
            raise PermissionError(errno.EACCES, "is open", wanted)


def watch(event: str, arguments: tuple[Any, ...]) -> None:
    """Refuse what Windows refuses."""
    path = str(arguments[0]) if event == "open" else ""
    if path.startswith("/proc/") and path != OF_A_LIBRARY:
        raise FileNotFoundError(errno.ENOENT, "there is no /proc", arguments[0])
    if event == "os.remove":
        refuse_open_file(arguments[0])
    if event == "os.rename":
        refuse_open_file(arguments[0])
        refuse_open_file(arguments[1])
    if event == "os.symlink" and "WITHOUT_LINKS" in os.environ:
        raise OSError(errno.EPERM, "a link needs a privilege")


fsync = os.fsync


def fsync_of_written(file: Any) -> None:
    """Flush a file that is open for writing."""
    number = file if isinstance(file, int) else file.fileno()
    if flags_of(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(errno.EBADF, "is not open for writing")
    fsync(number)


def spawn_only(_: object = None) -> list[str]:
    """Return the ways in which Windows starts processes."""
    return ["spawn"]


msvcrt: Any = types.ModuleType("msvcrt")
msvcrt.locking = locking
msvcrt.LK_NBLCK = 2
sys.modules["msvcrt"] = msvcrt
sys.modules["fcntl"] = None  # type: ignore[assignment]
sys.modules["resource"] = None  # type: ignore[assignment]
multiprocessing.get_all_start_methods = spawn_only
multiprocessing.context.DefaultContext.get_all_start_methods = spawn_only  # type: ignore[method-assign]
default: Any = multiprocessing.context._default_context  # type: ignore[attr-defined]
default._default_context = multiprocessing.get_context("spawn")
for method in ("fork", "forkserver"):
    del multiprocessing.context._concrete_contexts[method]  # type: ignore[attr-defined]
os.fsync = fsync_of_written
for module, names in (
    (os, ("fork", "forkpty", "O_NOFOLLOW", "O_NONBLOCK", "sched_getaffinity")),
    (signal, ("SIGUSR1", "pthread_sigmask")),
    (select, ("poll", "epoll")),
    (faulthandler, ("register",)),
):
    for name in names:
        delattr(module, name)
sys.addaudithook(watch)
