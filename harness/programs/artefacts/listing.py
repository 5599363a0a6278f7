"""The stored answers with their age, for `tofpod ls artefacts`."""

from typing import Any

from harness.programs.artefacts.declaration import declared_artefacts, refuse_without_checkout
from harness.programs.artefacts.ledger import edited_files, read_ledger, reasons_it_is_older


def ages() -> list[dict[str, Any]]:
    """Return a row for each artefact: when and by what it was made, the seconds that this took,
    and what has changed since. Raises UserError outside of a checkout."""
    refuse_without_checkout()
    ledger = read_ledger()
    rows = []
    for name, artefact in declared_artefacts().items():
        entry = ledger.get(name)
        older_than = reasons_it_is_older(name, ledger)
        older_than += [f"{file} (edited)" for file in edited_files(name, ledger)]
        row = {
            "name": name,
            "about": artefact.about,
            "by_hand": artefact.by_hand,
            "made": None if entry is None else entry.made,
            "tofpod": None if entry is None else entry.tofpod,
            "seconds": None if entry is None else entry.seconds,
            "expected_seconds": artefact.seconds,
            "older_than": older_than,
        }
        rows.append(row)
    return rows
