"""Makes artefacts again: runs their commands, stores their files, and keeps the ledger."""

import json
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable

from harness.programs.artefacts.declaration import artefact_named, data_file
from harness.programs.artefacts.ledger import (
    Ledger,
    changed_since,
    edited_files,
    entry_now,
    read_ledger,
    store_entry,
)
from harness.programs.artefacts.quoted import stored_rows
from harness.vocabulary import provenance
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes, write_text

SWEEP = ["tofpod", "sweep"]


def make_all(names: Iterable[str], *, quick: bool) -> list[str]:
    """Make those of the named artefacts that are due, and print the seconds of each. Each is
    stored in the ledger at once, so that a run that is killed goes on where it was. Returns the
    names of those that fail."""
    ledger = read_ledger()
    chosen = list(names)
    due = due_of(chosen, ledger, quick=quick)
    expected_s = {name: _expected_s(name, ledger) for name in due}
    print(f"{len(due)} of {len(chosen)} artefacts are to be made, in about", end=" ")
    expected_min = sum(expected_s.values()) / 60
    print(f"{expected_min:.0f} min on two idle cores", flush=True)
    failed = []
    for name in due:
        answer = artefact_named(name).about
        print(f"{name}: {answer}; about {expected_s[name]:.0f} s", flush=True)
        began = time.monotonic()
        try:
            _make(name, quick=quick)
        except UserError as mistake:
            print(f"{name}: not made: {mistake}", file=sys.stderr)
            failed.append(name)
            continue
        seconds = round(time.monotonic() - began, 1)
        was_quick = quick and _has_quick_form(name)
        entry = entry_now(name, seconds, quick=was_quick)
        store_entry(name, entry)
        print(f"{name}: made in {seconds:.0f} s", flush=True)
    return failed


def due_of(names: Iterable[str], ledger: Ledger, *, quick: bool) -> list[str]:
    """Return those of the named artefacts that are to be made: what they hang on has changed, or
    what they are made of is made before them, or a file was edited, or they come from a quick run
    and this one is not."""
    due: list[str] = []
    for name in names:
        artefact = artefact_named(name)
        if artefact.by_hand or artefact.prints:
            continue
        has_due_source = any(source in due for source in artefact.of)
        is_older = has_due_source or bool(changed_since(name, ledger))
        if is_older or edited_files(name, ledger) or (ledger[name].quick and not quick):
            due.append(name)
    return due


def _expected_s(name: str, ledger: Ledger) -> float:
    """Return the seconds that the last whole run took, or else the declared ones."""
    entry = ledger.get(name)
    if entry is None or entry.seconds is None or entry.quick:
        return artefact_named(name).seconds
    return entry.seconds


def _make(name: str, *, quick: bool) -> None:
    """Run an artefact's commands, and store what they have made. Raises UserError if something
    that it needs is absent, or if a command fails."""
    artefact = artefact_named(name)
    for needed in artefact.needs:
        if shutil.which(needed) is None and not (provenance.ROOT / needed).exists():
            raise UserError(f"needs {needed}, which is not here")
    for command in artefact.commands:
        _run(command, quick=quick)
    store_files(name)


def store_files(name: str) -> None:
    """Store the files of an artefact and the data of its table, from the results that its commands,
    or a person, have made. Raises UserError if one is absent or lacks a column."""
    artefact = artefact_named(name)
    for file in (*artefact.stores.values(), *artefact.rows):
        if not (provenance.ROOT / file).exists():
            raise UserError(f"{name}: {file} is absent", fix=f"run {'; '.join(artefact.commands)}")
    for file, source in artefact.stores.items():
        content = (provenance.ROOT / source).read_bytes()
        write_bytes(provenance.ROOT / file, content)
    if artefact.table is not None:
        rows = stored_rows(artefact.table, artefact.rows)
        write_text(provenance.ROOT / data_file(name), rows)


def _has_quick_form(name: str) -> bool:
    """Return whether `--quick` changes one of an artefact's commands: sweeps have that option."""
    return any(shlex.split(command)[:2] == SWEEP for command in artefact_named(name).commands)


def _with_all_set_ups(experiment: str) -> list[str]:
    """Return the options by which a quick run keeps all values of its axes: documents quote set-ups
    by name."""
    written = read_yaml(provenance.ROOT / experiment).data
    sweep = shape.get(written, ("sweep",)) or {}
    return ["--set", f"sweep={json.dumps(sweep)}"]


def _run(command: str, *, quick: bool) -> None:
    """Run a command in the repository; its output goes to this terminal. Raises UserError if it
    ends with an error."""
    program, *words = shlex.split(command)
    arguments = [program, *words]
    if program == "tofpod":
        arguments = [sys.executable, "-m", "harness", *words]
        if quick and [program, words[0]] == SWEEP:
            arguments += ["--quick", *_with_all_set_ups(words[1])]
    if program == "python":
        arguments = [sys.executable, *words]
    code = subprocess.run(arguments, cwd=provenance.ROOT, check=False).returncode
    if code == 130:
        raise KeyboardInterrupt
    if code:
        raise UserError(f"{command}: ended with exit code {code}")
