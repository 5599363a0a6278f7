"""``results/<name>/latest``: a link to the newest run of an experiment, or a text file with its name where no link can
be made. A file or a link of that name that is not tofpod's is left alone."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import sys
from pathlib import Path

from harness.tables.outputs import LATEST
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text

DIGEST_NAME = re.compile(r"[0-9a-f]{16}")
"""Name of a folder of results."""
UNFINISHED_LINK = re.compile(rf"\.{LATEST}\.[0-9a-f]{{8}}\.part")
"""A link that a killed process had not yet given its name."""


def latest_run(parent: Path) -> str | None:
    """Return the name of the run that ``parent/latest`` points to, whether it is there or not; None where there is no
    such link of tofpod's."""
    path = Path(parent) / LATEST
    try:
        if path.is_symlink():
            said = os.readlink(path)
        elif path.is_file() and path.stat().st_size <= 32:
            said = path.read_text(encoding="ascii").strip()
        else:
            return None
    except (OSError, ValueError):
        return None
    return said if DIGEST_NAME.fullmatch(said) else None


def point_to(run: Path) -> None:
    """Let ``latest`` beside a run point to it; a failure is told on stderr, and no reason for a sweep to fail."""
    path = Path(run).parent / LATEST
    if os.path.lexists(path) and latest_run(path.parent) is None:
        print(f"{path}: is not tofpod's and is left as it is; the newest run is {run}", file=sys.stderr)
        return
    part = path.with_name(f".{LATEST}.{secrets.token_hex(4)}.part")
    try:
        os.symlink(Path(run).name, part)
        os.replace(part, path)
    except (OSError, NotImplementedError):
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        try:
            write_text(path, f"{Path(run).name}\n", durable=False)
        except (OSError, UserError) as error:
            print(f"{path}: cannot be written ({error}); the newest run is {run}", file=sys.stderr)


def repoint(parent: Path, runs: list[Path]) -> None:
    """Let ``latest`` point to the last of ``runs`` (finished, oldest first) where it names none of them; remove it
    where there are none."""
    for left in Path(parent).glob(f".{LATEST}.*.part"):
        if UNFINISHED_LINK.fullmatch(left.name) and left.is_symlink():
            left.unlink(missing_ok=True)
    named = latest_run(parent)
    if named is None or named in {run.name for run in runs}:
        return
    if runs:
        point_to(runs[-1])
    else:
        with contextlib.suppress(OSError):
            (Path(parent) / LATEST).unlink()
