"""The results folders ``<out>/<experiment>/<digest>`` and the link ``latest`` beside them."""

import contextlib
import os
import re
import secrets
import sys
from pathlib import Path

from harness.records.outputs import LATEST

EXPERIMENT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
DIGEST_NAME = re.compile(r"[0-9a-f]{16}")


def folders_in(folder: Path, names: re.Pattern[str]) -> list[Path]:
    """Return the folders with such names, sorted and without links."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        folders = [
            entry
            for entry in entries
            if names.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False)
        ]
        return sorted(Path(entry.path) for entry in folders)
    return []


def latest_run(parent: Path) -> str | None:
    """Return the name of the run to which ``parent/latest`` points; None without a link that
    tofpod made."""
    path = Path(parent) / LATEST
    target = os.readlink(path) if path.is_symlink() else ""
    return target if DIGEST_NAME.fullmatch(target) else None


def point_to(run: Path) -> None:
    """Point the link ``latest`` beside a run to it, unless somebody else made the link; print
    failures to stderr."""
    path = Path(run).parent / LATEST
    if os.path.lexists(path) and latest_run(path.parent) is None:
        print(
            f"{path}: was not written by tofpod and is left unchanged; the newest run is {run}",
            file=sys.stderr,
        )
        return
    part = path.with_name(f".{LATEST}.{secrets.token_hex(4)}.part")
    try:
        os.symlink(Path(run).name, part)
        os.replace(part, path)
    except (OSError, NotImplementedError) as error:
        print(f"{path}: cannot be created ({error}); the newest run is {run}", file=sys.stderr)
