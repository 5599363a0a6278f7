"""The journal: one file for each trial that ended, however it did, written whole or not at all, so that the same
command resumes, and journals of several machines merge by copying files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from harness.engine.work import STATES, Ended, State
from harness.vocabulary.files import write_text
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import RECORD_BYTES, bounded_bytes
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.versions import check_version

JOURNAL_VERSION = 5
"""Raised by every change to the records' content or to what a trial computes."""
SUFFIX = ".jsonl"
NOTHING = "null"
"""In the place of a record."""


@dataclass(frozen=True)
class Entry:
    """How a trial ended. ``text``: its record as JSON where it is done, None else; the other fields as in `Ended`."""

    state: State
    text: str | None = None
    why: str = ""
    is_bug: bool = False
    seconds: float = 0.0
    peak_mb: float = 0.0
    worker: str = ""

    @classmethod
    def of(cls, ended: Ended) -> Entry:
        """The entry of a job whose value is a record's text."""
        text = ended.value if ended.state == "done" else None
        return cls(ended.state, text, ended.why, ended.is_bug, round(ended.seconds, 4), ended.peak_mb, ended.worker)

    @cached_property
    def record(self) -> dict[str, Any] | None:
        """Rows by table of a trial that is done."""
        return None if self.text is None else json.loads(self.text)


class Journal:
    """Entries in a folder, by key. A file is two lines of JSON: what happened, with the second line's digest; and the
    record. One that cannot be read, or that is under another name than it was written, counts as not there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, key: str) -> Entry | None:
        """The entry of a trial, or None. Raises UserError where a newer tofpod wrote it."""
        return read_entry(self._path(key), key)

    def write(self, key: str, entry: Entry) -> None:
        """Store how a trial ended. Raises UserError where the folder cannot be written or the disk is full."""
        text = NOTHING if entry.text is None else entry.text
        said = {name: value for name, value in asdict(entry).items() if name != "text"}
        head = canonical_json({"version": JOURNAL_VERSION, "key": key, "digest": _digest(text), **said})
        write_text(self._path(key), f"{head}\n{text}\n", durable=False)

    def entries(self) -> Iterator[tuple[str, Path]]:
        """(key, file) of every entry, in order of keys."""
        found = self.folder.glob(f"??/[!.]*{SUFFIX}")  # a name with a dot is a file that is being written
        paths = {path.stem: path for path in found}
        yield from sorted(paths.items())

    def _path(self, key: str) -> Path:
        """In one of 256 folders, by the end of the key's digest: no folder gets too long to list."""
        return self.folder / key[-2:] / f"{key}{SUFFIX}"


def read_entry(path: Path, key: str) -> Entry | None:
    """The entry in a file, or None where it is absent, damaged, older, or another trial's.

    Raises UserError where a newer tofpod wrote it.
    """
    try:
        head, text, rest = bounded_bytes(path, RECORD_BYTES).decode().split("\n")
        said = strict_json(head)
        if rest or not isinstance(said, dict):
            return None
        version = said.pop("version", None)
        if type(version) is int and version > JOURNAL_VERSION:
            check_version(version, JOURNAL_VERSION, path, "a journal's entry")
        if version != JOURNAL_VERSION or said.pop("key", None) != key or said.pop("digest", None) != _digest(text):
            return None
        entry = Entry(text=None if text == NOTHING else text, **said)
    except (OSError, ValueError, TypeError):
        return None
    is_whole = entry.state in STATES and (entry.text is not None) == (entry.state == "done")
    return entry if is_whole else None


def _digest(text: str) -> str:
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def record_text(record: dict[str, Any]) -> str:
    """A trial's record as one line of JSON; NaN, which JSON cannot hold, become null."""
    return canonical_json(without_nan(record))


def without_nan(record: Any) -> Any:
    """The record with NaN as None, which JSON can hold."""
    if isinstance(record, dict):
        return {key: without_nan(value) for key, value in record.items()}
    if isinstance(record, list):
        return [without_nan(value) for value in record]
    if isinstance(record, float) and record != record:
        return None
    return record
