"""The results folders ``<out>/<experiment>/<digest>`` and the link ``latest`` beside them."""

import contextlib
import os
import re
import secrets
import sys
from pathlib import Path

from harness.records.outputs import LATEST, run_named_by
from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text

EXPERIMENT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")


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
    """Return the name of the run to which ``parent/latest`` points; None if tofpod did not make
    that."""
    return run_named_by(Path(parent) / LATEST)


def point_to(run: Path) -> None:
    """Point ``latest`` beside a run to it, unless somebody else made that; print failures to
    stderr."""
    path = Path(run).parent / LATEST
    if os.path.lexists(path) and latest_run(path.parent) is None:
        print(
            f"{path}: was not written by tofpod and is left unchanged; the newest run is {run}",
            file=sys.stderr,
        )
        return
    try:
        _point(path, Path(run).name)
    except (OSError, UserError) as error:
        print(f"{path}: cannot be created ({error}); the newest run is {run}", file=sys.stderr)


def _point(path: Path, name: str) -> None:
    """Make ``path`` a link to a name beside it, or a text where the system has no links."""
    part = path.with_name(f".{LATEST}.{secrets.token_hex(4)}.part")
    try:
        os.symlink(name, part)
    except (OSError, NotImplementedError):  # Windows, but for developers; some file systems
        write_text(path, name)
        return
    system.replace(part, path)
