"""The place where compiled loops are kept, if neither the installation nor the user's home can be
written: a read-only image, a system service.

Numba compiles a loop when it is first called, and keeps it beside its source, or else in the user's
cache; without any place it refuses to import the loop. Loops are compiled code, so no place is used
that somebody else can write."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
"""Numba's environment variable, which processes inherit."""


def keep_loops_where_writable() -> None:
    """Set `VARIABLE` to a private temporary folder unless Numba has a place of its own. Costs 40
    microseconds where it has; call it before Numba is imported."""
    stated = os.environ.get(VARIABLE)
    places = [Path(stated)] if stated else []
    places.append(Path(__file__).parent)
    places.append(Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")))
    if not any(_can_be_written(place) for place in places):
        os.environ[VARIABLE] = str(_temporary_folder())


def _can_be_written(folder: Path) -> bool:
    """Return whether a folder can be written, or created."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _temporary_folder() -> Path:
    """Return the user's folder for later runs as well, or a new one if somebody else has taken its
    name."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"tofpod-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    is_private = stat.S_ISDIR(status.st_mode) and stat.S_IMODE(status.st_mode) == 0o700
    if is_private and status.st_uid == user:
        return folder
    return Path(tempfile.mkdtemp(prefix="tofpod-"))
