"""Files that `harness.clean` may remove: those that tofpod wrote, inside ``--out``, never through a link."""

from __future__ import annotations

import contextlib
import re
import stat
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.listing.latest import DIGEST_NAME, repoint
from harness.listing.results import ENTRY_NAME, EXPERIMENT_NAME, POINT_NAME, described, files_below, folders_in
from harness.tables.outputs import EXPERIMENT, JOURNAL, LOCK_NAME, is_output
from harness.vocabulary.errors import UserError
from scenes.render.cache import StoredFile, damaged_renders, leftovers, longest_unused, stored_renders

OURS = b"# tofpod experiment "
"""First words of an experiment.yaml that a sweep wrote."""
UNFINISHED_NAME = re.compile(r"\.(?P<stem>.+)\.\w{8}\.part(?P<suffix>\.\w+)")
"""A file that a killed process was writing (`harness.vocabulary.files.atomic_path`)."""


@dataclass(frozen=True)
class Removable:
    """A file of a folder of results."""

    path: Path
    size_bytes: int


def checked_inside(out: Path, folder: Path) -> None:
    """Raise UserError where the way from ``out`` to a folder below it goes through a link."""
    for part in (folder, *folder.parents):
        if part == Path(out):
            return
        if part.is_symlink():
            raise UserError(
                f"{part}: is a link to another place, where nothing is removed", fix="remove it there by hand"
            )
    raise AssertionError(f"{folder} is not below {out}")


def cache_removal(
    folder: Path, limit_bytes: int | None, older_s: float | None, *, damaged: bool, everything: bool
) -> list[StoredFile]:
    """Return the renders that any of the conditions names, and what killed processes left: with ``everything`` all of
    it, else what is older than a day."""
    renders = stored_renders(folder)
    going: dict[Path, StoredFile] = {}

    def add(files: Iterable[StoredFile]) -> None:
        going.update({one.path: one for one in files})

    if everything:
        add(renders)
    if older_s is not None:
        before_s = time.time() - older_s
        add(one for one in renders if one.used_s < before_s)
    if damaged:
        add(damaged_renders(renders))
    if limit_bytes is not None:
        add(longest_unused((one for one in renders if one.path not in going), limit_bytes, ()))
    add(leftovers(folder, 0.0) if everything else leftovers(folder))
    return list(going.values())


def chosen_results(out: Path, name: str) -> list[Path]:
    """Return the folders of results named ``NAME`` or ``NAME/DIGEST``. Raises UserError where there are none."""
    experiment, slash, digest = name.partition("/")
    if not EXPERIMENT_NAME.fullmatch(experiment) or (slash and not DIGEST_NAME.fullmatch(digest)):
        raise UserError(
            f"{name!r} names no results", legal="NAME or NAME/DIGEST, as python -m harness.ls results shows them"
        )
    parent = Path(out) / experiment
    for path in (parent, parent / digest) if slash else (parent,):
        if path.is_symlink():
            raise UserError(
                f"{path}: is a link to another place, where nothing is removed", fix="remove it there by hand"
            )
    found = [path for path in folders_in(parent, DIGEST_NAME) if not slash or path.name == digest]
    if not found:
        raise UserError(f"{parent / digest if slash else parent}: holds no results", fix="python -m harness.ls results")
    for folder in found:
        # every sweep begins with its declaration, whose first line says whose it is
        with contextlib.ExitStack() as opened:
            try:
                first = opened.enter_context((folder / EXPERIMENT.name).open("rb")).read(len(OURS))
            except OSError:
                first = b""
        if first != OURS:
            raise UserError(
                f"{folder}: has no experiment.yaml of tofpod's, so it is no folder of results",
                fix="remove it by hand, if it is to go",
            )
    return found


def removable(folder: Path, *, journal_only: bool) -> list[Removable]:
    """Return the files of a folder of results that tofpod wrote, locks last; with ``journal_only`` the records."""
    found = []
    for entry in files_below(folder):
        with contextlib.suppress(OSError):
            file = entry.stat(follow_symlinks=False)
            if not stat.S_ISREG(file.st_mode):
                continue
            path = Path(entry.path)
            parts = path.relative_to(folder).parts
            unfinished = UNFINISHED_NAME.fullmatch(path.name)
            name = path.name if unfinished is None else unfinished["stem"] + unfinished["suffix"]
            if parts[0] == JOURNAL:
                ours = len(parts) in (2, 3) and ENTRY_NAME.fullmatch(name) is not None
            elif len(parts) == 1:
                ours = not journal_only and (is_output(name, "results") or LOCK_NAME.fullmatch(name) is not None)
            else:
                capture = len(parts) == 2 and POINT_NAME.fullmatch(parts[0]) is not None
                ours = not journal_only and capture and is_output(name, "capture")
            if ours:
                found.append(Removable(path, file.st_size))
    return sorted(found, key=lambda one: (LOCK_NAME.fullmatch(one.path.name) is not None, one.path))


def remove_files(folders: Sequence[Path], files: Iterable[Removable]) -> list[Removable]:
    """Remove files, then folders that are empty, the experiment's own included; `latest` goes or moves on where the run
    that it names is gone. Returns what is gone."""
    gone = []
    for one in files:
        with contextlib.suppress(OSError):
            one.path.unlink()
            gone.append(one)
    for folder in folders:
        inner = folders_in(folder, re.compile(f"{JOURNAL}|{POINT_NAME.pattern}"))
        deepest = [below for one in inner for below in folders_in(one, re.compile("[0-9a-f]{2}"))]
        for path in (*deepest, *inner, folder):
            _remove_if_empty(path)
    for parent in {folder.parent for folder in folders}:
        left = [described(path) for path in folders_in(parent, DIGEST_NAME)]
        reported = [one for one in left if one.has_report or one.state == "complete"]
        repoint(parent, [one.path for one in sorted(reported, key=lambda one: one.date or "")])
        _remove_if_empty(parent)
    return gone


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()
