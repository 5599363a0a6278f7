"""Which mutants are tried: the numeric modules, a draw that depends on content alone, and the
listed faults."""

from collections.abc import Sequence
from fnmatch import fnmatch
from hashlib import blake2b
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from tests.mutants.kinds import Mutant, mutants_of, named_mutant, on_one_line

PRODUCT = ("scenes", "detectors", "harness")
NUMERIC = (
    "scenes/*.py",
    "detectors/*.py",
    "harness/evaluation/*.py",
    "harness/inspection/*.py",
    "harness/programs/*.py",
    "harness/runs/*.py",
    "harness/stills/*.py",
    "harness/trials/*.py",
    "harness/vocabulary/geometry.py",
)
"""Modules whose mutants are drawn; ``*`` also stands for folders."""
NOT_NUMERIC = (
    "*/__init__.py",
    "*page.py",
    "*tables.py",
    "*/program.py",
    "*/settings.py",
    # open, read, write or show files
    "detectors/recordings/bags.py",
    "detectors/recordings/devices.py",
    "detectors/recordings/messages.py",
    "detectors/recordings/opening.py",
    "harness/inspection/arguments.py",
    "harness/inspection/output.py",
    "harness/inspection/presentation.py",
    "harness/programs/dataset/exchange.py",
    "harness/programs/keeping/*",
    "scenes/render/cache.py",
    # start and end processes
    "harness/programs/cluster/*",
    "harness/runs/engines.py",
    "harness/runs/journal.py",
    "harness/runs/options.py",
    "harness/runs/pictures.py",
    "harness/runs/processes.py",
    "harness/runs/results_folder.py",
)
"""Modules among these that compute nothing."""
COMMAND = b"@program("  # in a module that is the command of a program


def numeric_modules(root: Path) -> list[str]:
    """Return the paths of the numeric modules in a checkout."""
    modules: list[str] = []
    for path in product_modules(root):
        file = path.relative_to(root).as_posix()
        is_numeric = _matches(file, NUMERIC) and not _matches(file, NOT_NUMERIC)
        if is_numeric and COMMAND not in path.read_bytes():
            modules.append(file)
    return modules


def _matches(file: str, patterns: Sequence[str]) -> bool:
    return any(fnmatch(file, pattern) for pattern in patterns)


def product_modules(root: Path) -> list[Path]:
    """Return all modules of the product in a checkout."""
    return sorted(path for folder in PRODUCT for path in (root / folder).rglob("*.py"))


def drawn(mutants: Sequence[Mutant], number: int, seed: int) -> list[Mutant]:
    """Return so many of the mutants, at most one of an expression, in the order of the files.

    The rank of a mutant depends on the seed, its file's name, its function and its text, so that
    changes elsewhere and moves of files leave the draw as it is."""

    def rank(mutant: Mutant) -> bytes:
        content = (str(seed), Path(mutant.file).name, *mutant.key[1:])
        return blake2b("\n".join(content).encode(), digest_size=8).digest()

    first_of_site: dict[tuple[str, tuple[int, int]], Mutant] = {}
    for mutant in sorted(mutants, key=rank):
        first_of_site.setdefault((mutant.file, mutant.site), mutant)
    chosen = sorted(first_of_site.values(), key=rank)[:number]
    return sorted(chosen, key=lambda mutant: (mutant.file, mutant.start, mutant.end, mutant.text))


def all_mutants(root: Path, only: str) -> list[Mutant]:
    """Return all mutants of the numeric modules whose path matches ``only``."""
    mutants: list[Mutant] = []
    for file in numeric_modules(root):
        if fnmatch(file, only):
            mutants += mutants_of(file, (root / file).read_bytes())
    return mutants


def entries(path: Path) -> list[dict[str, Any]]:
    """Return the entries of one of the YAML files beside this module."""
    return YAML(typ="safe").load(path) or []


def named(root: Path, path: Path) -> tuple[list[Mutant], list[str]]:
    """Return the faults listed in a YAML file, and a sentence on each that the code no longer has.
    A fault whose file has moved is sought in all modules."""
    mutants: list[Mutant] = []
    lost: list[str] = []
    for entry in entries(path):
        candidates = [root / entry["file"]]
        if not candidates[0].exists():
            candidates = product_modules(root)
        texts = (entry["function"], entry["original"], entry["replaced"])
        hits: list[Mutant] = []
        for module in candidates:
            file = module.relative_to(root).as_posix()
            hit = named_mutant(file, module.read_bytes(), *texts)
            if hit is not None:
                hits.append(hit)
        if len(hits) == 1:
            mutants.append(hits[0])
        else:
            lost.append(
                f"{entry['file']}: {entry['function']} does not have once: {entry['original']}"
            )
    return mutants, lost


class Equivalents:
    """The survivors that are no faults, with the reason, by file name, function and text."""

    def __init__(self, path: Path) -> None:
        self._reasons: dict[tuple[str, ...], str] = {}
        for entry in entries(path):
            texts = (on_one_line(entry["original"]), on_one_line(entry["mutant"]))
            key = (Path(entry["file"]).name, entry["function"], *texts)
            self._reasons[key] = on_one_line(entry["reason"])

    def reason(self, mutant: Mutant) -> str | None:
        """Return why a mutant is no fault, or None."""
        return self._reasons.get(_texts(mutant))

    def stale(self, root: Path) -> list[str]:
        """Return the entries that are no mutants of the code any more, as lines of text."""
        names = {key[0] for key in self._reasons}
        present: set[tuple[str, ...]] = set()
        for file in numeric_modules(root):
            if Path(file).name in names:
                mutants = mutants_of(file, (root / file).read_bytes())
                present.update(_texts(mutant) for mutant in mutants)
        return [" | ".join(key) for key in self._reasons if key not in present]


def _texts(mutant: Mutant) -> tuple[str, ...]:
    return (Path(mutant.file).name, mutant.function, mutant.original, mutant.mutant)
