"""Folders of results: what is in them, how far they are, who is at work in them. Only read, and no link is followed."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes
from harness.vocabulary.locks import lock, opened_lock

EXPERIMENT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
DIGEST_NAME = re.compile(r"[0-9a-f]{16}")
ENTRY_NAME = re.compile(r"[a-z_]+-[0-9]+-[0-9a-f]{16}\.jsonl?|[0-9]{6}-[0-9a-f]{8}\.jsonl")
"""Files of a journal: `harness.engine.journal.SEGMENT_NAME`, and those of version 5 and before, of one trial each."""

POINT_NAME = re.compile(r"point-[0-9]{3,6}")
"""Of a folder with the findings in one real capture."""


@dataclass(frozen=True)
class ResultFolder:
    """One run's results. ``state``: complete, unfinished, running or broken, with ``note`` in words. ``done``,
    ``failed`` and ``planned``: trials as the provenance has them, None without one; ``records``: of its journal.
    ``version``: of the results, None where none stands in them."""

    path: Path
    experiment: str
    digest: str
    state: str
    note: str
    size_bytes: int
    records: int
    has_report: bool
    date: str | None = None
    commit: str | None = None
    dirty: bool | None = None
    done: int | None = None
    failed: int | None = None
    planned: int | None = None
    version: int | None = None

    def to_data(self) -> dict[str, Any]:
        """For programs."""
        return {**self.__dict__, "path": str(self.path)}


def result_folders(out: Path, experiment: str | None = None) -> Iterator[ResultFolder]:
    """Every folder of results below ``out``, or those of one experiment, in order of their names."""
    for parent in folders_in(out, EXPERIMENT_NAME):
        if experiment is None or parent.name == experiment:
            for path in folders_in(parent, DIGEST_NAME):
                yield described(path)


def folders_in(folder: Path, names: re.Pattern[str]) -> list[Path]:
    """Folders with such names, links left out, sorted."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        found = [entry for entry in entries if names.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False)]
        return sorted(Path(entry.path) for entry in found)
    return []


def described(path: Path) -> ResultFolder:
    """What a folder of results holds; a broken one is described as such."""
    from harness.engine.journal import Journal

    size = _measured(path)
    try:
        records = len(Journal(path / "journal"))
    except UserError:  # of a newer tofpod, or reached through a link
        records = 0
    has_report = (path / "report.html").is_file()
    found = ResultFolder(path, path.parent.name, path.name, "broken", "", size, records, has_report)
    try:
        said = _provenance(path / "provenance.json")
    except (UserError, ValueError) as error:
        return replace(found, note=f"broken: provenance.json: {error}")
    return _without_provenance(found) if said is None else _with_provenance(found, said)


def _without_provenance(found: ResultFolder) -> ResultFolder:
    """Of a run that is not over, or of real captures, which have no trials."""
    judged = len(folders_in(found.path, POINT_NAME))
    if judged and not found.records:
        state = "complete" if (found.path / "summary.csv").is_file() else "unfinished"  # which is written last
        return replace(found, state=state, note=f"{state}: {_count(judged, 'real capture')} judged")
    if not found.records and not (found.path / "experiment.yaml").is_file():
        return replace(found, note="broken: it has neither an experiment nor records")
    state = "running" if in_use(found.path) else "unfinished"
    return replace(found, state=state, note=f"{state}: {_count(found.records, 'record')}")


def _with_provenance(found: ResultFolder, said: dict[str, Any]) -> ResultFolder:
    done, failed = _trials(said)
    version, dirty = _whole(said.get("results_version")), said.get("dirty")
    state = "running" if in_use(found.path) else "unfinished" if failed else "complete"
    return replace(
        found,
        state=state,
        note=_note(state, done, failed, version),
        date=_text(said.get("started")),
        commit=_text(said.get("commit")),
        dirty=dirty if isinstance(dirty, bool) else None,
        done=done,
        failed=failed,
        planned=None if done is None or failed is None else done + failed,
        version=version,
    )


def in_use(path: Path) -> bool:
    """Whether a sweep is at work in this folder; False where the system has no locks. Holds it for no longer than it
    takes to ask."""
    from harness.engine.shard import LOCK

    if not (path / LOCK).is_file():
        return False
    try:
        with opened_lock(path / LOCK) as file:
            return lock(file, shared=False, wait=False) == "busy"
    except (OSError, UserError):
        return False


def _measured(path: Path) -> int:
    """What a folder takes on the disk, in bytes."""
    size = 0
    for entry in files_below(path):
        with contextlib.suppress(OSError):
            found = entry.stat(follow_symlinks=False)
            size += getattr(found, "st_blocks", -(-found.st_size // 512)) * 512
    return size


def files_below(path: Path) -> Iterator[os.DirEntry[str]]:
    """Everything below a folder that is no folder; a link is what it is, and not followed."""
    try:
        entries = os.scandir(path)
    except OSError:
        return
    with entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                yield from files_below(Path(entry.path))
            else:
                yield entry


def _provenance(path: Path) -> dict[str, Any] | None:
    """Raises UserError or ValueError where it cannot be read; None where there is none."""
    try:
        said = strict_json(bounded_bytes(path, TEXT_BYTES), nan=True)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ValueError(error.strerror or "cannot be read") from error
    if not isinstance(said, dict):
        raise ValueError("is no provenance")
    return said


def _trials(said: dict[str, Any]) -> tuple[int | None, int | None]:
    """Trials done, in this run or before, and failed; None where the provenance does not say."""
    trials, failures = said.get("trials"), said.get("failures")
    if not isinstance(trials, dict) or (done := _whole(trials.get("done"))) is None:
        return None, None
    failed = _whole(trials.get("failed"))
    if failed is None:  # earlier results only list them
        failed = len(failures) if isinstance(failures, list) else 0
    return done + (_whole(trials.get("resumed")) or 0), failed


def _note(state: str, done: int | None, failed: int | None, version: int | None) -> str:
    from harness.vocabulary.versions import RESULTS_VERSION

    note = state
    if done is not None and failed is not None:
        some = f"{done} of {_count(done + failed, 'trial')} done, {failed} failed"
        note += f": {some if failed else _count(done, 'trial')}"
    if version is not None and version != RESULTS_VERSION:
        age = "newer" if version > RESULTS_VERSION else "older"
        note += f" ({age}: results version {version}, this tofpod writes {RESULTS_VERSION})"
    return note


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _text(value: Any) -> str | None:
    """One short line of a file that anybody may have written, or None."""
    return value[:40] if isinstance(value, str) and value.isprintable() else None


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None
