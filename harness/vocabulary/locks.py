"""Locks on files: the system's own, so a process that dies gives them back, and no clock is asked.

A lock file is never reached through a link, and nothing but a regular file is taken for it: opening one empties no
file of somebody else's and waits for no pipe.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Literal

from harness.vocabulary.files import open_plain

Answer = Literal["held", "busy", "no locks"]
"""``busy``: another process holds it. ``no locks``: the system (Windows) or the file system knows none."""


def opened_lock(path: Path) -> IO[str]:
    """Open a lock file, made where there is none. Raises OSError where it cannot be opened, UserError where the path is
    a link, a pipe or a folder."""
    with open_plain(path, os.O_RDWR | os.O_CREAT | os.O_APPEND) as file:
        return os.fdopen(os.dup(file.fileno()), "a+", encoding="utf-8")


def lock(file: IO[str], *, shared: bool, wait: bool) -> Answer:
    """Lock an open file until it is closed."""
    try:
        import fcntl
    except ImportError:
        return "no locks"
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return "busy"
    except OSError:
        return "no locks"
    return "held"


@contextmanager
def one_at_a_time(path: Path, number: int) -> Iterator[None]:
    """Wait for other processes that hold the same ``number`` of a lock file, and hold it: one byte of the file, so that
    any number of things needs one file. Processes, not threads. Holds nothing where the system knows no locks."""
    try:
        import fcntl

        file = opened_lock(path)
    except (ImportError, OSError):
        yield
        return
    with file:
        with suppress(OSError):  # a file system without locks
            fcntl.lockf(file, fcntl.LOCK_EX, 1, number)
        yield
