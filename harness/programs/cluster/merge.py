"""``tofpod merge``: joins the journals of shards and machines in one results folder."""

import argparse
import sys
from collections import Counter
from math import isclose
from pathlib import Path
from typing import Any

from harness.runs.journal import NOT_TRIALS, Journal
from harness.runs.shards import locked
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, write_bytes
from harness.vocabulary.program import program


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "folders", type=Path, nargs="+", metavar="FOLDER", help="a folder of results with a journal"
    )
    parser.add_argument(
        "--into", type=Path, required=True, metavar="FOLDER", help="created if it does not exist"
    )


@program(
    _options,
    "Copy the trials of results folders (such as those of `tofpod sweep --shard`) to "
    "another folder. "
    "Nothing is run; if several folders hold a trial, a finished record is used.",
    "tofpod merge shard1/averaging/DIGEST shard2/averaging/DIGEST --into results/averaging/DIGEST",
    "tofpod merge laptop/cameras/DIGEST server/cameras/DIGEST --into results/cameras/DIGEST",
    epilog="Afterwards the sweep's own command, without --shard, writes the report.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if two journals give different results for a trial, 2 for a
    user's mistake."""
    folders = options.folders
    into = options.into
    _refuse_others(folders, into)
    declared = next(
        (path for folder in folders if (path := folder / "experiment.yaml").is_file()), None
    )
    if declared is None:
        raise UserError(
            f"{folders[0]}: has no experiment.yaml", fix="name the results folders of sweeps"
        )
    # writing an existing file again shows whether the folder is writable before anything is copied
    write_bytes(into / "experiment.yaml", bounded_bytes(declared, TEXT_BYTES))
    counts: Counter[str] = Counter()
    different = []
    damaged = []
    with locked(into):
        goal = Journal(into / "journal")
        for folder in folders:
            before = counts["copied"]
            source = Journal(folder / "journal")
            different += merge_into(goal, source, counts)
            damaged += source.damaged
            print(f"{folder}: {counts['copied'] - before} trials copied")
    print(f"{goal.folder}: {counts['copied']} trials copied, {counts['known']} were already there")
    if damaged:
        note = f"{len(damaged)} damaged or older records were left out and must be run again"
        print(f"{note}: {', '.join(damaged[:3])}", file=sys.stderr)
    if counts["alike"]:
        alike_text = (
            f"{counts['alike']} trials differ in the last digits, as between different processors"
        )
        print(f"{alike_text}; the record that was copied first was kept")
    if different:
        note = (
            f"{len(different)} trials have different results in different folders; the first "
            "record was kept"
        )
        why = "The machines may have different processors or versions"
        print(f"{note}: {', '.join(different[:3])}. {why}", file=sys.stderr)
        return 1
    out = into.parent.parent
    print(
        f"next: run the sweep without --shard, with --out {out}, to run missing trials and "
        "write the report"
    )
    return 0


def merge_into(into: Journal, source: Journal, counts: Counter[str]) -> list[str]:
    """Copy trials that ``into`` lacks or has not finished; count copied, known and alike trials
    (equal but for the last digits). Return the keys of trials that differ. Raises UserError if a
    newer tofpod wrote either journal."""
    different = []
    for key, entry in source.entries():
        stored = into.read(key)
        if stored is None or (stored.state != "done" and entry.state == "done"):
            into.write(key, entry)
            counts["copied"] += not key.startswith(NOT_TRIALS)
            continue
        counts["known"] += not key.startswith(NOT_TRIALS)
        if stored.state == entry.state == "done" and stored.value != entry.value:
            first = _without_seconds(stored.record)
            second = _without_seconds(entry.record)
            if not _alike(first, second):
                different.append(key)
            elif first != second:
                counts["alike"] += 1
    into.sync()
    return different


def _without_seconds(value: object) -> object:
    """Return a record without timings and learned arrays, whose last digits differ, so that
    results can be compared."""
    if isinstance(value, dict):
        kept = {
            name: part
            for name, part in value.items()
            if not name.startswith("seconds") and name != "arrays"
        }
        return {name: _without_seconds(part) for name, part in kept.items()}
    return [_without_seconds(part) for part in value] if isinstance(value, list) else value


def _alike(first: Any, second: Any, *, in_tenth_um: bool = False) -> bool:
    """Return whether values agree within what processors differ: a thousandth, or 1 um; counts
    must be equal."""
    if isinstance(first, dict) and isinstance(second, dict) and first.keys() == second.keys():
        return all(
            _alike(first[name], second[name], in_tenth_um=name == "error_tenth_um")
            for name in first
        )
    if isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        return all(
            _alike(a, b, in_tenth_um=in_tenth_um) for a, b in zip(first, second, strict=True)
        )
    if isinstance(first, float) and isinstance(second, float):
        return isclose(first, second, rel_tol=1e-3, abs_tol=1e-3)
    if in_tenth_um and isinstance(first, int) and isinstance(second, int):
        return abs(first - second) <= 10
    return bool(first == second)


def _refuse_others(folders: list[Path], into: Path) -> None:
    """Raise UserError unless all journals belong to the same experiment, whose digest is the
    folder's name."""
    for folder in folders:
        if not (folder / "journal").is_dir():
            fix = "name folders that tofpod ls results lists"
            raise UserError(f"{folder}: has no journal", fix=fix)
        if folder.resolve() == into.resolve():
            raise UserError(
                f"{folder}: is the folder to merge into", fix="name it only with --into"
            )
    names = {"/".join(folder.resolve().parts[-2:]) for folder in folders}
    if len(names) > 1:
        message = f"these are results of different experiments: {', '.join(sorted(names))}"
        raise UserError(message, fix="merge the folders of each experiment separately")
    (name,) = names
    if "/".join(into.resolve().parts[-2:]) != name:
        fix = f"--into {into}/{name}, and --out {into} for the sweep"
        raise UserError(
            f"--into {into}: results of {name} must be in a folder of that name", fix=fix
        )


if __name__ == "__main__":
    raise SystemExit(main())
