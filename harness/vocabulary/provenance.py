"""The origin of a result: code, versions, machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

PACKAGES = ("mitsuba", "drjit", "trimesh", "numpy", "scipy", "numba", "pandas", "open3d-cpu", "opencv-python-headless")


def commit_and_dirty() -> tuple[str | None, bool | None]:
    """The commit of the checkout that this code runs from, and whether it has changes; None outside a checkout."""
    here = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str | None:
        try:
            done = subprocess.run(
                ["git", "-C", str(here), *arguments], capture_output=True, text=True, timeout=10, check=True
            )
        except (OSError, subprocess.SubprocessError):
            return None
        return done.stdout.strip()

    top = git("rev-parse", "--show-toplevel")
    if top is None or Path(top) != here:
        return None, None
    status = git("status", "--porcelain")
    return git("rev-parse", "HEAD"), None if status is None else bool(status)


def versions() -> dict[str, str]:
    """Versions of tofpod, Python and the packages that decide numbers."""
    from harness import __version__

    found = {"tofpod": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, Any]:
    """Facts that a run's times depend on; no host or user name."""
    return {"system": platform.system(), "machine": platform.machine(), "processors": os.cpu_count()}


def record(command: str) -> dict[str, Any]:
    """The origin that every stored result states: command, commit, dirty flag, versions, machine."""
    commit, dirty = commit_and_dirty()
    return {"command": command, "commit": commit, "dirty": dirty, "versions": versions(), "machine": machine()}
