"""What `harness.clean` may remove: what tofpod wrote, inside ``--out``, by no way through a link."""

from __future__ import annotations

import contextlib
import re
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.listing.results import DIGEST_NAME, ENTRY_NAME, EXPERIMENT_NAME, POINT_NAME, files_below, folders_in
from harness.vocabulary.errors import UserError
from scenes.render.cache import StoredFile, damaged_renders, leftovers, longest_unused, stored_renders

RESULT_FILES = frozenset(
    {"experiment.yaml", "provenance.json", "study.json", "summary.csv", "report.html", "compare.json", "compare.html"}
    | {f"{name}.parquet" for name in ("trials", "runs", "probes", "noise", "registrations", "walls")}
    | {f"{name}.parquet" for name in ("sites", "findings", "operating", "pixels")}
)
"""What sweeps and comparisons write into a folder of results, beside its journal."""
CAPTURE_FILES = frozenset({"findings.csv", "findings.json", "annotated.png", "targets.png", "blind.png", "cloud.ply"})
"""What is written for each real capture."""
OURS = b"# tofpod experiment "
LOCK_NAME = re.compile(r"\.lock(-[0-9]+-of-[0-9]+)?")
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
    """The renders that any of the conditions names, and what killed processes left: all of it with ``everything``, else
    what is older than a day."""
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
    """The folders of results named ``NAME`` or ``NAME/DIGEST``. Raises UserError where it names none, or is no name."""
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
        if not _begins_as_ours(folder / "experiment.yaml"):
            raise UserError(
                f"{folder}: has no experiment.yaml of tofpod's, so it is no folder of results",
                fix="remove it by hand, if it is to go",
            )
    return found


def _begins_as_ours(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(len(OURS)) == OURS
    except OSError:
        return False


def removable(folder: Path, *, journal_only: bool) -> list[Removable]:
    """The files of a folder of results that tofpod wrote, locks last; with ``journal_only`` the records of trials."""
    found = []
    for path in _regular_files(folder):
        if _is_record(path, folder) or (not journal_only and _is_ours(path, folder)):
            with contextlib.suppress(OSError):
                found.append(Removable(path, path.lstat().st_size))
    return sorted(found, key=lambda one: (LOCK_NAME.fullmatch(one.path.name) is not None, one.path))


def remove_files(folders: Sequence[Path], files: Iterable[Removable]) -> list[Removable]:
    """Remove files, then what folders are empty, the experiment's own included. Returns what is gone."""
    gone = []
    for one in files:
        with contextlib.suppress(OSError):
            one.path.unlink()
            gone.append(one)
    for folder in folders:
        for inner in sorted((path for path in _folders(folder)), key=lambda path: len(path.parts), reverse=True):
            _remove_if_empty(inner)
        _remove_if_empty(folder)
    for parent in {folder.parent for folder in folders}:
        _remove_if_empty(parent)
    return gone


def _remove_if_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


def _folders(folder: Path) -> Iterator[Path]:
    """The folders that tofpod makes in one of results."""
    for inner in folders_in(folder, re.compile("journal|point-[0-9]+")):
        yield inner
        yield from folders_in(inner, re.compile("[0-9a-f]{2}"))


def _regular_files(folder: Path) -> Iterator[Path]:
    for entry in files_below(folder):
        with contextlib.suppress(OSError):
            if stat.S_ISREG(entry.stat(follow_symlinks=False).st_mode):
                yield Path(entry.path)


def _is_record(path: Path, folder: Path) -> bool:
    parts = path.relative_to(folder).parts
    return (
        parts[0] == "journal" and len(parts) in (2, 3) and ENTRY_NAME.fullmatch(_finished_name(path.name)) is not None
    )


def _is_ours(path: Path, folder: Path) -> bool:
    parts, name = path.relative_to(folder).parts, _finished_name(path.name)
    if len(parts) == 1:
        return name in RESULT_FILES or LOCK_NAME.fullmatch(name) is not None
    return len(parts) == 2 and POINT_NAME.fullmatch(parts[0]) is not None and name in CAPTURE_FILES


def _finished_name(name: str) -> str:
    """Of a file that was being written, the name that it would have got."""
    found = UNFINISHED_NAME.fullmatch(name)
    return name if found is None else found["stem"] + found["suffix"]
