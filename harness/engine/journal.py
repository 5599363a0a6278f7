"""The journal: one file per finished trial, written whole or not at all, so that the same command resumes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness.vocabulary.files import write_text
from harness.vocabulary.seeds import canonical_json, digest

JOURNAL_VERSION = 3
"""Raised by every change to the records' content or to what a trial computes."""


class Journal:
    """Finished trials in a folder, by key. A record that cannot be read counts as not done."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def read(self, key: str) -> dict[str, Any] | None:
        """The record of a trial, or None."""
        try:
            stored = json.loads((self._folder / f"{key}.json").read_text())
        except (OSError, ValueError):
            return None
        if not isinstance(stored, dict) or stored.get("version") != JOURNAL_VERSION:
            return None
        record = stored.get("record")
        return record if digest(record) == stored.get("digest") else None

    def write(self, key: str, record: dict[str, Any]) -> None:
        """Store a finished trial. Raises UserError where the folder cannot be written or the disk is full."""
        content = {"version": JOURNAL_VERSION, "digest": digest(record), "record": record}
        write_text(self._folder / f"{key}.json", canonical_json(content))

    def keys(self) -> Iterator[str]:
        """Keys of all stored trials."""
        return (path.stem for path in sorted(self._folder.glob("*.json")))


def without_nan(record: Any) -> Any:
    """The record with NaN as None, which JSON can hold."""
    if isinstance(record, dict):
        return {key: without_nan(value) for key, value in record.items()}
    if isinstance(record, list):
        return [without_nan(value) for value in record]
    if isinstance(record, float) and record != record:
        return None
    return record
