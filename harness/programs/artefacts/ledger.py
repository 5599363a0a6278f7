"""The ledger of artefacts: when each was made, by which code, and how old it is."""

import datetime
from collections.abc import Mapping
from pathlib import Path

from pydantic import Field

from harness import __version__
from harness.programs.artefacts.declaration import (
    artefact_named,
    declared_artefacts,
    digests_today,
    files_of,
)
from harness.vocabulary.code_digests import changed_parts, file_digests
from harness.vocabulary.config import Config
from harness.vocabulary.files import shipped, strict_json, write_json

LEDGER = "artefacts.json"


class LedgerEntry(Config):
    """An entry of the ledger."""

    made: str
    """Date."""
    tofpod: str | None = None
    """Version that made it; None if it is not known."""
    seconds: float | None = None
    """Seconds of the run that made it; None if nothing measured them."""
    quick: bool = False
    """It comes from a quick run, with fewer boards."""
    digests: dict[str, str] | None = None
    """Digests of all that it hangs on; None if it was made before there were digests."""
    files: dict[str, str] = Field(default_factory=dict)
    """Digests of its files."""


Ledger = Mapping[str, LedgerEntry]


def ledger_path() -> Path:
    """Return the file that holds the ledger."""
    return shipped("baselines") / LEDGER


def read_ledger() -> dict[str, LedgerEntry]:
    """Return how each artefact was made, by name."""
    path = ledger_path()
    data = strict_json(path.read_bytes()) if path.is_file() else {}
    return {name: LedgerEntry.from_data(entry) for name, entry in data.items()}


def store_entry(name: str, entry: LedgerEntry) -> None:
    """Store how an artefact was made, beside the entries that other processes may have stored."""
    ledger = read_ledger() | {name: entry}
    data = {
        declared_name: ledger[declared_name].to_data()
        for declared_name in declared_artefacts()
        if declared_name in ledger
    }
    write_json(ledger_path(), data)


def entry_now(name: str, seconds: float | None, *, quick: bool = False) -> LedgerEntry:
    """Return the entry of an artefact that has just been made."""
    today = datetime.datetime.now(datetime.UTC).date()
    return LedgerEntry(
        made=today.isoformat(),
        tofpod=__version__,
        seconds=seconds,
        quick=quick,
        digests=digests_today(name),
        files=file_digests(files_of(name)),
    )


def changed_since(name: str, ledger: Ledger) -> list[str]:
    """Return the parts that an artefact hangs on and that have changed since it was made; none of
    what is printed whenever documents are written."""
    if artefact_named(name).prints:
        return []
    entry = ledger.get(name)
    if entry is None:
        return ["it was never made"]
    if entry.digests is None:
        return ["it does not state its code"]
    return changed_parts(entry.digests, digests_today(name))


def reasons_it_is_older(name: str, ledger: Ledger) -> list[str]:
    """Return what has changed since an artefact was made, and the older artefacts that it is made
    of; nothing if it is not older."""
    older_sources = [
        f"artefact {source}"
        for source in artefact_named(name).of
        if reasons_it_is_older(source, ledger)
    ]
    return changed_since(name, ledger) + older_sources


def is_quick(name: str, ledger: Ledger) -> bool:
    """Return whether an artefact, or one that it is made of, comes from a quick run."""
    entry = ledger.get(name)
    sources = artefact_named(name).of
    if entry is not None and entry.quick:
        return True
    return any(is_quick(source, ledger) for source in sources)


def edited_files(name: str, ledger: Ledger) -> list[str]:
    """Return the files of an artefact that are not as they were made."""
    entry = ledger.get(name)
    stored = {} if entry is None else entry.files
    return changed_parts(stored, file_digests(files_of(name)))


def age_sentence(name: str, ledger: Ledger) -> str:
    """Return what a document says beside an artefact that is older than the code or comes from a
    quick run; an empty text beside any other."""
    entry = ledger.get(name)
    if entry is None:
        return "*Not yet computed.*"
    if reasons_it_is_older(name, ledger):
        maker = f" by tofpod {entry.tofpod}" if entry.tofpod else ""
        return f"*Older than the code: computed on {entry.made}{maker}.*"
    if is_quick(name, ledger):
        return "*From a quick run: fewer boards, repeats or set-ups, so wider intervals.*"
    return ""
