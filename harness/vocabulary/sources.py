"""The program's own text as part of a key: stored results are not taken for those of changed code."""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import re
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OWN = ("detectors", "harness", "scenes")
"""The project's packages."""
IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]+)|import[ \t]+([^\n#]+))", re.MULTILINE
)
"""An import statement: a hundred times faster than parsing, and a sentence of a docstring that looks like one only adds
a file to the key."""


@lru_cache
def source_digest(modules: tuple[str, ...], packages: tuple[str, ...]) -> str:
    """Digest of the project's sources that ``modules`` reach by imports, and of the versions of installed ``packages``.

    A module of another project counts with every Python source of the package that it belongs to. Taken once a process:
    files that change later are not what this process runs.
    """
    state = hashlib.blake2b(digest_size=8)
    own = tuple(name for name in modules if name.partition(".")[0] in OWN)
    files = {path.relative_to(ROOT).as_posix(): path for path in reached_sources(own)}
    for name in sorted(set(modules) - set(own)):
        files |= {f"{name}/{relative}": path for relative, path in _foreign_sources(name)}
    for shown, path in sorted(files.items()):
        content = path.read_bytes()
        state.update(f"{shown} {len(content)}\n".encode())
        state.update(content)
    for package in packages:
        state.update(f"{package} {importlib.metadata.version(package)}\n".encode())
    return state.hexdigest()


@lru_cache
def reached_sources(modules: tuple[str, ...]) -> tuple[Path, ...]:
    """Source files of the project that modules reach by import statements, those inside functions included, sorted.

    Imports that exist for type checking only count too. A module that is loaded by a name in a variable is not seen:
    name it among ``modules``.
    """
    found: dict[str, Path] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        path = None if name in found else _source_of(name)
        if path is None:
            continue
        found[name] = path
        waiting.append(name.rpartition(".")[0])  # a package runs before its modules
        waiting += _imported(path.read_text(encoding="utf-8"))
    return tuple(sorted(found.values()))


def _source_of(name: str) -> Path | None:
    """The file of a module of the project; None where there is no such module."""
    if name.partition(".")[0] not in OWN:
        return None
    place = ROOT.joinpath(*name.split("."))
    return next((path for path in (place / "__init__.py", place.with_suffix(".py")) if path.is_file()), None)


def _imported(text: str) -> Iterator[str]:
    """Every dotted name that absolute imports may mean: of ``from a import b`` both ``a`` and ``a.b``."""
    for start, names, plain in IMPORT.findall(text):
        words = [name.split()[0] for name in (names or plain).strip("()\n ").split(",") if name.strip()]
        yield from ([start, *(f"{start}.{word}" for word in words)] if start else words)


def _foreign_sources(module: str) -> Iterable[tuple[str, Path]]:
    """(name to show, file) of the sources of the package that a module of another project belongs to."""
    try:
        spec = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        for path in sorted(Path(folder).rglob("*.py")):
            yield path.relative_to(folder).as_posix(), path
    if spec and not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin).name, Path(spec.origin)
