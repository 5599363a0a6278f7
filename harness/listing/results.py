"""Folders of results: how far they are, what they found, what tells them apart. They are only read, and no link is
followed."""

from __future__ import annotations

import contextlib
import csv
import io
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.listing.latest import DIGEST_NAME, latest_run
from harness.listing.text import many
from harness.tables.outputs import CAPTURES, EXPERIMENT, PROVENANCE, REPORT
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes
from harness.vocabulary.locks import lock, opened_lock
from harness.vocabulary.path_names import names_of, value_text
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.versions import RESULTS_VERSION

EXPERIMENT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
ENTRY_NAME = re.compile(r"[a-z_]+-[0-9]+-[0-9a-f]{16}\.jsonl?|[0-9]{6}-[0-9a-f]{8}\.jsonl")
"""Files of a journal: `harness.engine.journal.SEGMENT_NAME`, and those of version 5 and before, of one trial each."""

POINT_NAME = re.compile(r"point-[0-9]{3,6}")
"""Name of a folder with the findings in a real capture."""
SHOWN_SETTINGS = 6


@dataclass(frozen=True)
class ResultFolder:
    """One run's results. ``state``: complete, unfinished, running or broken, with ``note`` in words. ``done``,
    ``failed`` and ``planned``: trials as the provenance has them, None without one; ``records``: of its journal.
    ``version``: of the results, None where none stands in them. ``limits``: set_up, a90_95_mm (None where it is not
    demonstrated) and verdict of each set-up of a study; ``differs``: settings, by dotted path, that are not the same in
    all runs of the experiment; ``is_latest``: whether ``latest`` points to it."""

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
    limits: tuple[dict[str, Any], ...] = ()
    differs: dict[str, Any] = field(default_factory=dict)
    is_latest: bool = False

    def to_data(self) -> dict[str, Any]:
        """Return JSON's types."""
        return {**self.__dict__, "path": str(self.path)}

    @property
    def limit_text(self) -> str:
        """The detection limit that was found, with its set-up; the span of several; empty of what is no study."""
        found = [row for row in self.limits if row["a90_95_mm"] is not None and row["verdict"] == "demonstrated"]
        if not found:
            return "a90/95 not demonstrated" if self.limits else ""
        best, worst = (pick(found, key=lambda row: row["a90_95_mm"]) for pick in (min, max))
        ends = [best] if best is worst else [best, worst]
        missing = len(self.limits) - len(found)
        beside = f"; not demonstrated by {missing} of {len(self.limits)} set-ups" if missing else ""
        return "a90/95 " + " to ".join(f"{row['a90_95_mm']:.2f} mm ({row['set_up']})" for row in ends) + beside

    @property
    def differs_text(self) -> str:
        """Settings that tell the run from others of its experiment, at most `SHOWN_SETTINGS`."""
        names = names_of(self.differs)
        said = [f"{names[path]}={value_text(path, value)}" for path, value in self.differs.items()]
        more = len(said) - SHOWN_SETTINGS
        return ", ".join(said[:SHOWN_SETTINGS]) + (f" and {more} more" if more > 0 else "")


def result_folders(out: Path, experiment: str | None = None) -> Iterator[ResultFolder]:
    """Yield every folder of results below ``out``, or those of one experiment, in order of their names."""
    for parent in folders_in(out, EXPERIMENT_NAME):
        if experiment is not None and parent.name != experiment:
            continue
        runs = [described(path) for path in folders_in(parent, DIGEST_NAME)]
        settings = [_settings(run.path) for run in runs] if len(runs) > 1 else [{} for _ in runs]
        paths = dict.fromkeys(path for some in settings for path in some)
        known = [some for some in settings if some]
        apart = [path for path in paths if len({canonical_json(some.get(path)) for some in known}) > 1]
        newest = latest_run(parent)
        for run, some in zip(runs, settings, strict=True):
            differs = {path: some.get(path) for path in apart} if some else {}
            yield replace(run, limits=_limits(run.path), differs=differs, is_latest=run.digest == newest)


def _settings(path: Path) -> dict[str, Any]:
    """Every setting of a run's resolved experiment by its dotted path; empty where it cannot be read."""

    def leaves(data: dict[str, Any], before: str) -> Iterator[tuple[str, Any]]:
        for key, value in data.items():
            if isinstance(value, dict) and value:
                yield from leaves(value, f"{before}{key}.")
            else:
                yield f"{before}{key}", value

    try:
        found = dict(leaves(read_yaml(path / EXPERIMENT.name).data, ""))
        canonical_json(found)
    except (UserError, ValueError, OSError):
        return {}
    return found


def _limits(path: Path) -> tuple[dict[str, Any], ...]:
    """The detection limits of a study; empty where there are none or they cannot be read."""
    rows = []
    try:
        with contextlib.closing(io.StringIO(bounded_bytes(path / "limits.csv", TEXT_BYTES).decode())) as text:
            for row in csv.DictReader(text):
                size = row["a90_95_mm"]
                said = {"set_up": row["set_up"][:60], "verdict": row["a90_95_verdict"][:40]}
                if not all(word.isprintable() for word in said.values()):
                    return ()
                rows.append({**said, "a90_95_mm": float(size) if size else None})
    except (UserError, OSError, ValueError, KeyError, TypeError, csv.Error):
        return ()
    return tuple(rows)


def folders_in(folder: Path, names: re.Pattern[str]) -> list[Path]:
    """Return folders with such names, links left out, sorted."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        found = [entry for entry in entries if names.fullmatch(entry.name) and entry.is_dir(follow_symlinks=False)]
        return sorted(Path(entry.path) for entry in found)
    return []


def described(path: Path) -> ResultFolder:
    """Describe what a folder of results holds; a broken folder is described as such."""
    from harness.engine.journal import Journal

    size = 0
    for entry in files_below(path):
        with contextlib.suppress(OSError):
            file = entry.stat(follow_symlinks=False)
            size += getattr(file, "st_blocks", -(-file.st_size // 512)) * 512
    try:
        records = len(Journal(path / "journal"))
    except UserError:  # of a newer tofpod, or reached through a link
        records = 0
    has_report = (path / REPORT.name).is_file()
    found = ResultFolder(path, path.parent.name, path.name, "broken", "", size, records, has_report)
    try:
        said = _provenance(path / PROVENANCE.name)
    except (UserError, ValueError) as error:
        return replace(found, note=f"broken: provenance.json: {error}")
    if said is None:  # a run that is not over, or real captures, which have no trials
        judged = len(folders_in(path, POINT_NAME))
        if not judged and not records and not (path / EXPERIMENT.name).is_file():
            return replace(found, note="broken: it has neither an experiment nor records")
        if judged and not records:  # their table is written last
            state = "complete" if (path / CAPTURES.name).is_file() else "unfinished"
            return replace(found, state=state, note=f"{state}: {many(judged, 'real capture')} judged")
        state = "running" if in_use(path) else "unfinished"
        return replace(found, state=state, note=f"{state}: {many(records, 'record')}")
    trials, failures = said.get("trials"), said.get("failures")
    done = _whole(trials.get("done")) if isinstance(trials, dict) else None
    failed = None
    if isinstance(trials, dict) and done is not None:
        done += _whole(trials.get("resumed")) or 0
        failed = _whole(trials.get("failed"))
        if failed is None:  # earlier results only list them
            failed = len(failures) if isinstance(failures, list) else 0
    state = "running" if in_use(path) else "unfinished" if failed else "complete"
    note, planned = state, None
    if done is not None and failed is not None:
        planned = done + failed
        note += ": " + (f"{done} of {many(planned, 'trial')} done, {failed} failed" if failed else many(done, "trial"))
    version, dirty = _whole(said.get("results_version")), said.get("dirty")
    if version is not None and version != RESULTS_VERSION:
        age = "newer" if version > RESULTS_VERSION else "older"
        note += f" ({age}: results version {version}, this tofpod writes {RESULTS_VERSION})"
    return replace(
        found,
        state=state,
        note=note,
        date=_text(said.get("started")),
        commit=_text(said.get("commit")),
        dirty=dirty if isinstance(dirty, bool) else None,
        done=done,
        failed=failed,
        planned=planned,
        version=version,
    )


def in_use(path: Path) -> bool:
    """Return whether a sweep is at work in this folder; False where the system has no locks."""
    from harness.engine.shard import LOCK

    if not (path / LOCK).is_file():
        return False
    try:
        with opened_lock(path / LOCK) as file:
            return lock(file, shared=False, wait=False) == "busy"
    except (OSError, UserError):
        return False


def files_below(path: Path) -> Iterator[os.DirEntry[str]]:
    """Yield everything below a folder that is no folder; links are not followed."""
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


def _text(value: Any) -> str | None:
    """One short line of a file that anybody may have written, or None."""
    return value[:40] if isinstance(value, str) and value.isprintable() else None


def _whole(value: Any) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None
