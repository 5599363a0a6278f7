"""Results that an earlier run has written: a run that finds all of them unchanged, and has nothing
new to add, shows the same again instead of computing and writing it once more.

Results hang on the trials with their thresholds, on the resolved experiment, on what decides its
numbers, and on the code of tables and pages. Of the files, the digests of their bytes are kept, so
that one which somebody has changed or removed is written anew."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from harness.records.outputs import WRITTEN
from harness.report.claims import CLAIM_SETS
from harness.runs.jobs import Outcome
from harness.runs.shards import LOCK
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import RECORD_BYTES, bounded_bytes, strict_json, write_json
from harness.vocabulary.provenance import ROOT, source_digest
from harness.vocabulary.seeds import digest
from harness.vocabulary.text import Cell, Grid

PAGES = ROOT / "harness" / "report"
"""Templates, stylesheet and script of pages."""
PACKAGES = ("numpy", "scipy", "pandas", "pyarrow", "matplotlib", "jinja2")
"""Packages whose version can change tables and pages."""


@dataclass(frozen=True)
class Written:
    """The results in a folder, as a run wrote them."""

    folder: Path
    """The folder."""
    origin: str
    """Digest of all that they hang on."""

    def shown_again(self, outcome: Outcome) -> list[str | Grid] | None:
        """Return what the terminal showed, if the results in the folder hang on the same, and the
        run had nothing to do; else None."""
        if outcome.trials.done or outcome.renders.done or outcome.failures:
            return None
        with suppress(OSError, ValueError, UserError, KeyError, TypeError):
            stored = strict_json(bounded_bytes(self.folder / WRITTEN.name, RECORD_BYTES))
            if stored["origin"] == self.origin and stored["files"] == self._files(stored["files"]):
                return [_part_of(data) for data in stored["shown"]]
        return None

    def store(self, shown: Sequence[str | Grid]) -> None:
        """Keep the digests of all files in the folder, and what the terminal shows."""
        names = [path.name for path in self.folder.iterdir() if path.is_file()]
        results = [
            name for name in sorted(names) if name != WRITTEN.name and not name.startswith(LOCK)
        ]
        data = {
            "origin": self.origin,
            "files": self._files(results),
            "shown": [part if isinstance(part, str) else asdict(part) for part in shown],
        }
        write_json(self.folder / WRITTEN.name, data)

    def _files(self, names: Sequence[str]) -> dict[str, str]:
        """Return the digest of each file. Raises OSError if one is absent."""
        digests = {}
        for name in names:
            with (self.folder / name).open("rb") as stream:
                digests[name] = hashlib.file_digest(stream, "blake2b").hexdigest()[:16]
        return digests


def origin_of(outcome: Outcome, resolved: str, digests: Mapping[str, str]) -> str:
    """Return the digest of all that results hang on. ``resolved``: the experiment with all
    defaults; ``digests``: of what decides its numbers."""
    claims = [target.partition(":")[0] for target in CLAIM_SETS.values()]
    pages = [path for path in sorted(PAGES.iterdir()) if path.suffix in (".html", ".css", ".js")]
    return digest(
        {
            "trials": sorted(outcome.finished),
            "thresholds": outcome.thresholds,
            "experiment": resolved,
            "numbers": dict(digests),
            "code": source_digest(("harness.runs.study", *claims), PACKAGES),
            "pages": [hashlib.blake2b(path.read_bytes()).hexdigest() for path in pages],
        }
    )


def _part_of(data: Any) -> str | Grid:
    """Return a sentence or table from its stored data."""
    if isinstance(data, str):
        return data
    rows = []
    for row in data["rows"]:
        rows.append([Cell(**cell) for cell in row])
    return Grid.of(data["heads"], rows, left=data["left"], title=data["title"], kind=data["kind"])
