"""Put small faults into the numeric modules, run the tests of their rooms, and print the page of
survivors.

Results are appended to mutants.jsonl in --home, and what stands there is not tried again."""

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from tests.mutants.draw import Equivalents, all_mutants, drawn, named
from tests.mutants.kinds import Mutant
from tests.mutants.page import MutantTrial, page
from tests.mutants.rooms import room_tests
from tests.mutants.trying import BrokenTests, Tree, tried

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
STATES = {"passed": "survived", "failed": "killed", "timed out": "timed out"}
Records = dict[tuple[str, ...], tuple[str, str]]
"""The state of a mutant and the first test that failed, by the mutant's key."""


def options() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    add = parser.add_argument
    add("--sample", type=int, default=300, metavar="N", help="number of mutants (default 300)")
    add("--seed", type=int, default=1, metavar="S", help="seed of the draw (default 1)")
    add("--jobs", type=int, default=1, metavar="J", help="mutants tried at once (default 1)")
    add("--only", default="*", metavar="GLOB", help="draw among the modules whose path matches")
    add(
        "--list",
        action="store_true",
        help="print the drawn mutants and their test files; run nothing",
    )
    add("--named", action="store_true", help="try the faults of named.yaml instead of drawn ones")
    add("--rerun-survivors", action="store_true", help="try again what survived before")
    add("--page", type=Path, metavar="FILE", help="write the page into a file as well")
    add(
        "--home",
        type=Path,
        default=ROOT / "build" / "mutants",
        metavar="DIR",
        help="where results are kept",
    )
    return parser.parse_args()


def stored(path: Path) -> Records:
    """Return the last result of each mutant in a file of JSON lines."""
    records: Records = {}
    for line in path.read_text().splitlines() if path.exists() else ():
        record = json.loads(line)
        records[tuple(record["key"])] = (record["state"], record["test"])
    return records


def try_all(mutants: Iterable[Mutant], tree: Tree, path: Path, jobs: int) -> Records:
    """Try mutants, append each result to the file of JSON lines, print it, and return all."""
    records: Records = {}
    with ThreadPoolExecutor(jobs) as pool, path.open("a") as file:
        mutant_of = {pool.submit(tried, mutant, tree): mutant for mutant in mutants}
        for future in as_completed(mutant_of):
            mutant = mutant_of[future]
            run = future.result()
            state = STATES[run.state]
            records[mutant.key] = (state, run.test)
            record = {"key": mutant.key, "state": state, "test": run.test}
            file.write(json.dumps({**record, "seconds": round(run.seconds, 1)}) + "\n")
            file.flush()
            print(f"{state:9s} {run.seconds:6.1f} s {mutant.file} {mutant.function}", flush=True)
            print(f"    - {mutant.original}\n    + {mutant.mutant}\n    {run.test}", flush=True)
    return records


def main() -> int:
    """Run the program; returns 1 if the unchanged tests fail or a named fault lives, else 0."""
    arguments = options()
    if arguments.list:
        _print_list(_chosen(ROOT, arguments)[0])
        return 0
    arguments.home.mkdir(parents=True, exist_ok=True)
    tree = Tree(ROOT, arguments.home)
    mutants, lost = _chosen(tree.folder, arguments)
    results = arguments.home / "mutants.jsonl"
    records = stored(results)
    if arguments.rerun_survivors:
        records = {key: record for key, record in records.items() if record[0] != "survived"}
    missing = [mutant for mutant in mutants if mutant.key not in records]
    broken = _broken_files(missing, tree)
    for file, why in broken.items():
        print(f"{file}: not tried: {why}", file=sys.stderr)
    ready = [mutant for mutant in missing if mutant.file not in broken]
    records.update(try_all(ready, tree, results, arguments.jobs))
    equivalents = Equivalents(HERE / "equivalent.yaml")
    trials: list[MutantTrial] = []
    for mutant in mutants:
        if mutant.key in records:
            state, test = records[mutant.key]
            trials.append(MutantTrial(mutant, state, test, equivalents.reason(mutant)))
    if arguments.named:
        return max(_report_named(trials, lost), int(bool(broken)))
    text = page(trials, arguments.seed)
    print(text)
    if arguments.page is not None:
        arguments.page.write_text(text)
    for line in equivalents.stale(tree.folder):
        print(f"equivalent.yaml: no longer in the code: {line}", file=sys.stderr)
    return int(bool(broken))


def _broken_files(mutants: Sequence[Mutant], tree: Tree) -> dict[str, str]:
    """Return why mutants cannot be tried, by file: the tests of its room fail anyway."""
    broken: dict[str, str] = {}
    for file in dict.fromkeys(mutant.file for mutant in mutants):
        direct, indirect = room_tests(tree.folder, file)
        try:
            tree.seconds([*direct, *indirect])
        except BrokenTests as error:
            broken[file] = str(error)
    return broken


def _chosen(root: Path, arguments: argparse.Namespace) -> tuple[list[Mutant], list[str]]:
    """Return the mutants to try, and a sentence on each named fault that the code no longer has."""
    if arguments.named:
        return named(root, HERE / "named.yaml")
    mutants = all_mutants(root, arguments.only)
    return drawn(mutants, arguments.sample, arguments.seed), []


def _print_list(mutants: Sequence[Mutant]) -> None:
    for mutant in mutants:
        direct, indirect = room_tests(ROOT, mutant.file)
        print(f"{mutant.file} {mutant.function} ({mutant.kind})")
        print(f"    - {mutant.original}\n    + {mutant.mutant}")
        names = " ".join(Path(file).stem for file in direct)
        print(f"    {names}; then {len(indirect)} files of the room")


def _report_named(trials: Sequence[MutantTrial], lost: Sequence[str]) -> int:
    living = [trial for trial in trials if trial.lives]
    print(f"{len(trials) - len(living)} of {len(trials)} named faults are killed")
    for trial in living:
        print(f"lives: {trial.mutant.file} {trial.mutant.function}: {trial.mutant.mutant}")
    for line in lost:
        print(f"to be mended in named.yaml: {line}")
    return int(bool(living or lost))


if __name__ == "__main__":
    sys.exit(main())
