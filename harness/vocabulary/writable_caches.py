"""Places for the caches of Numba and Matplotlib, if neither the installation nor the user's home
can be written: a read-only image, a system service.

Numba compiles a loop when it is first called, and keeps it beside its source, or else in the user's
cache; without any place it refuses to import the loop. Matplotlib keeps its list of fonts in the
user's home, or else makes it again in each process, with a warning. Loops are compiled code, so no
place is used that somebody else can write."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

NUMBA = "NUMBA_CACHE_DIR"
MATPLOTLIB = "MPLCONFIGDIR"
"""Environment variables of the two, which processes inherit."""


def use_writable_caches() -> None:
    """Set `NUMBA` and `MATPLOTLIB` to a private temporary folder unless each has a place of its
    own. Costs 60 microseconds where they have; call it before they are imported."""
    cache = _can_be_written(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    if not cache and not _can_be_written(str(Path(__file__).parent)):
        _use_temporary_folder(NUMBA)
    if not cache or not _can_be_written(os.environ.get("XDG_CONFIG_HOME") or "~/.config"):
        _use_temporary_folder(MATPLOTLIB)


def _use_temporary_folder(variable: str) -> None:
    """Set a variable unless it states a folder that can be written."""
    stated = os.environ.get(variable)
    if not stated or not _can_be_written(stated):
        os.environ[variable] = str(_temporary_folder())


def _can_be_written(path: str) -> bool:
    """Return whether a folder can be written, or created."""
    folder = Path(path).expanduser()
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK | os.X_OK)


def _temporary_folder() -> Path:
    """Return the user's folder, which later runs use as well, or a new one if somebody else has
    taken its name."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"tofpod-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    is_private = stat.S_ISDIR(status.st_mode) and stat.S_IMODE(status.st_mode) == 0o700
    if is_private and status.st_uid == user:
        return folder
    return Path(tempfile.mkdtemp(prefix="tofpod-"))
