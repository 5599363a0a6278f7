"""``python -m harness.merge``: join the journals of shards and machines into one folder of results."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from math import isclose
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError, exit_code_of

if TYPE_CHECKING:
    from harness.engine.journal import Journal


def main(arguments: list[str] | None = None) -> int:
    """The program. Returns 0, 1 where two journals give different results for one trial, 2 on a mistake of the user."""
    options = _parser().parse_args(arguments)
    return exit_code_of(lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.merge",
        description="Copy the trials of one or more folders of results (as `harness.sweep --shard` leaves them) into "
        "another. Nothing is run; where a trial is in several, one that is done counts.",
        epilog="example: python -m harness.merge shard1/averaging/0123456789abcdef shard2/averaging/0123456789abcdef "
        "--into results/averaging/0123456789abcdef; then the sweep's own command, without --shard, writes the report",
    )
    parser.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="a folder with a journal")
    parser.add_argument("--into", type=Path, required=True, metavar="FOLDER", help="made if it is not there")
    return parser


@dataclass
class MergedShards:
    """Counts of trials that were copied, and that were there. Of the latter, ``alike`` differ in last digits, and those
    with the keys ``different`` in more; ``damaged``: lines and files of journals that were left out."""

    copied: int = 0
    known: int = 0
    alike: int = 0
    damaged: list[str] = field(default_factory=list)
    different: list[str] = field(default_factory=list)


def _run(options: argparse.Namespace) -> int:
    from harness.engine.journal import Journal
    from harness.engine.shard import locked
    from harness.vocabulary.files import write_bytes
    from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes

    _refuse_others(options.folders, options.into)
    merged = MergedShards()
    declared = next((path for folder in options.folders if (path := folder / "experiment.yaml").is_file()), None)
    if declared is None:
        raise UserError(f"{options.folders[0]}: has no experiment.yaml", fix="name folders as sweeps leave them")
    # written again where it is there: a folder that cannot be written shows before anything is copied
    write_bytes(options.into / "experiment.yaml", bounded_bytes(declared, TEXT_BYTES))
    with locked(options.into):
        into = Journal(options.into / "journal")
        for folder in options.folders:
            before = merged.copied
            merge_into(into, Journal(folder / "journal"), merged)
            print(f"{folder}: {merged.copied - before} trials copied")
    return _told(merged, into)


def merge_into(into: Journal, other: Journal, merged: MergedShards) -> None:
    """Copy what ``into`` lacks, or has not done. Raises UserError where a newer tofpod wrote either."""
    for key, entry in other.entries():
        known = into.read(key)
        if known is None or (known.state != "done" and entry.state == "done"):
            into.write(key, entry)
            merged.copied += key not in other.thresholds
            continue
        merged.known += key not in other.thresholds
        if known.state == entry.state == "done" and known.text != entry.text:
            first, second = (_without_seconds(one.record) for one in (known, entry))
            merged.alike += first != second and _alike(first, second)
            if not _alike(first, second):
                merged.different.append(key)
    merged.damaged += other.damaged
    into.sync()


def _without_seconds(value: object) -> object:
    """A record without its timings, which no two runs have in common."""
    if isinstance(value, dict):
        return {name: _without_seconds(one) for name, one in value.items() if not name.startswith("seconds")}
    if isinstance(value, list):
        return [_without_seconds(one) for one in value]
    return value


def _alike(first: Any, second: Any, *, in_tenth_um: bool = False) -> bool:
    """Return whether two values agree as unlike processors make them agree: to a thousandth, or in mm to 1 um.
    Whole numbers are counts, which must be equal, but for errors in tenths of a micrometre."""
    if isinstance(first, dict) and isinstance(second, dict):
        names = first.keys() if first.keys() == second.keys() else [""]
        return all(_alike(first.get(n), second.get(n, n), in_tenth_um=n == "error_tenth_um") for n in names)
    if isinstance(first, list) and isinstance(second, list):
        same = len(first) == len(second)
        return same and all(_alike(a, b, in_tenth_um=in_tenth_um) for a, b in zip(first, second, strict=True))
    if isinstance(first, float) and isinstance(second, float):
        return isclose(first, second, rel_tol=1e-3, abs_tol=1e-3)
    if in_tenth_um and isinstance(first, int) and isinstance(second, int):
        return abs(first - second) <= 10
    return bool(first == second)


def _refuse_others(folders: list[Path], into: Path) -> None:
    """Only journals of one experiment belong together; its folder's name is its digest."""
    for folder in folders:
        if not (folder / "journal").is_dir():
            raise UserError(
                f"{folder}: has no journal",
                legal="folders such as results/averaging/0123456789abcdef, that a sweep has written",
                fix="python -m harness.ls results lists them",
            )
        if folder.resolve() == into.resolve():
            raise UserError(f"{folder}: is the folder to merge into", fix="name it with --into only")
    names = {"/".join(folder.resolve().parts[-2:]) for folder in folders}
    if len(names) > 1:
        raise UserError(
            f"these are results of different experiments: {', '.join(sorted(names))}",
            legal="folders whose last two names are alike: the experiment's name and its digest",
            fix="merge those of each experiment by themselves",
        )
    (name,) = names
    if "/".join(into.resolve().parts[-2:]) != name:
        raise UserError(
            f"--into {into}: results of {name} are looked for in a folder of that name",
            fix=f"--into {into}/{name}, and --out {into} for the sweep",
        )


def _told(merged: MergedShards, into: Journal) -> int:
    print(f"{into.folder}: {merged.copied} trials copied, {merged.known} were there")
    if merged.damaged:
        some = ", ".join(merged.damaged[:3])
        print(f"{len(merged.damaged)} damaged or older records left out, to be run again: {some}", file=sys.stderr)
    if merged.alike:
        print(f"{merged.alike} trials differ in last digits, as unlike processors make them; the first copied was kept")
    if merged.different:
        some = ", ".join(merged.different[:3])
        print(
            f"{len(merged.different)} trials have different results in different folders, the first copied was kept: "
            f"{some}. The machines do not compute alike (other processors, or versions?)",
            file=sys.stderr,
        )
        return 1
    out = into.folder.parent.parent.parent
    print(f"next: the sweep's command without --shard, with --out {out}: it runs what is missing and writes the report")
    return 0


if __name__ == "__main__":
    sys.exit(main())
