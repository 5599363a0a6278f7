"""The origin of a result: the code and its digest, versions of packages and stored files, and the
machine.

Every stored file states its version: JSON and Parquet in a key, CSV in a column, YAML in a comment
on the first line, HTML in ``<meta name="generator">``. A newer file is refused; an older file is
read or made again."""

import contextlib
import hashlib
import importlib.metadata
import importlib.util
import os
import platform
import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from harness.vocabulary.errors import UserError

PACKAGES = (
    "mitsuba",
    "drjit",
    "trimesh",
    "numpy",
    "scipy",
    "numba",
    "pandas",
    "open3d-cpu",
    "open3d",
    "opencv-python-headless",
)


def commit_and_dirty() -> tuple[str | None, bool | None]:
    """Return the commit of the checkout that this code runs from, and whether it has changes; None
    without checkout."""
    root = Path(__file__).resolve().parents[2]

    def git(*arguments: str) -> str | None:
        command = ["git", "-C", str(root), *arguments]
        try:
            return subprocess.run(
                command, capture_output=True, text=True, timeout=10, check=True
            ).stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return None

    top = git("rev-parse", "--show-toplevel")
    if top is None or Path(top) != root:
        return None, None
    status = git("status", "--porcelain")
    return git("rev-parse", "HEAD"), None if status is None else bool(status)


def versions() -> dict[str, str]:
    """Return the versions of tofpod, Python and the packages that affect results."""
    from harness import __version__

    versions_found = {"tofpod": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions_found[name] = importlib.metadata.version(name)
    return versions_found


def record(command: str) -> dict[str, Any]:
    """Return the origin for a stored result: command, commit, dirty flag, versions and machine,
    without any names."""
    commit, dirty = commit_and_dirty()
    machine = {
        "system": platform.system(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
    }
    return {
        "command": command,
        "commit": commit,
        "dirty": dirty,
        "versions": versions(),
        "machine": machine,
    }


def made_by(origin: Mapping[str, Any]) -> str:
    """Return ``tofpod 0.2.0`` from the origin that a stored file states, which may lack it."""
    versions_stated = origin.get("versions")
    version = versions_stated.get("tofpod") if isinstance(versions_stated, Mapping) else None
    return f"tofpod {version}" if isinstance(version, str) else "an unknown version of tofpod"


# version of files that have none of their own; increased when the tables' meaning changes
RESULTS_VERSION = 1
GENERATOR = f"tofpod results {RESULTS_VERSION}"  # written into pages
STAMP = re.compile(r"#\s*tofpod (\w+)(.*)")


def check_version(
    version: object,
    newest: int,
    path: Path,
    noun: str,
    *,
    oldest: int | None = None,
    again: str | None = None,
) -> int:
    """Return a file's version if it lies between ``oldest`` (default: ``newest``) and ``newest``;
    else raise UserError. ``noun`` names the kind of file, such as "a record"; ``again`` says how
    to make an outdated file again."""
    first = newest if oldest is None else oldest
    legal = f"version {newest}" if first == newest else f"versions {first} to {newest}"
    fix = again
    if isinstance(version, bool) or not isinstance(version, int) or version < 0:
        fault = (
            "states no version"
            if version is None
            else f"states the invalid version {str(version)[:40]!r}"
        )
        message = f"is {noun} that {fault}"
    elif version > newest:
        message = f"was written by a newer tofpod: it is {noun} of version {version}"
        fix = "upgrade tofpod, or use the version that wrote it"
    elif version < first:
        message = f"is {noun} of version {version}"
    else:
        return version
    raise UserError(f"{path}: {message}", legal=legal, fix=fix)


def stamped(kind: str, version: int) -> str:
    """Return the first line of a text file that tofpod writes, with its newline."""
    return f"# tofpod {kind} {version}\n"


def stamp_of(text: str, kind: str) -> object:
    """Return the version that a text's first line states: an int, or the text after the kind if it
    is not a number, or None if the line is not a stamp of this kind, as in a file that was written
    by hand."""
    match = STAMP.match(text.partition("\n")[0].removeprefix("\ufeff").strip())
    number = match[2].strip() if match and match[1] == kind else None
    return int(number) if number and re.fullmatch(r"[0-9]{1,9}", number) else number


ROOT = Path(__file__).resolve().parents[2]
OWN = ("detectors", "harness", "scenes")  # The project's packages
IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]+)|import[ \t]+([^\n#]+))",
    re.MULTILINE,
)
"""Matches import statements, a hundred times faster than a parser; a false match in a text only
adds a file."""


@lru_cache
def source_digest(modules: tuple[str, ...], packages: tuple[str, ...]) -> str:
    """Return the digest of all project sources that ``modules`` reach, and of the versions of
    ``packages``. A module of another project counts with all sources of its package. Computed
    once, since a process runs what it first read."""
    state = hashlib.blake2b(digest_size=8)
    own_modules = tuple(name for name in modules if name.partition(".")[0] in OWN)
    files = {path.relative_to(ROOT).as_posix(): path for path in reached_sources(own_modules)}
    for name in sorted(set(modules) - set(own_modules)):
        files |= {f"{name}/{relative}": path for relative, path in _foreign_sources(name)}
    for shown, path in sorted(files.items()):
        content = first_content(path)
        state.update(f"{shown} {len(content)}\n".encode())
        state.update(content)
    for package in packages:
        state.update(f"{package} {_installed_version(package)}\n".encode())
    return state.hexdigest()


def _installed_version(package: str) -> str:
    """Return a package's version, or ``absent``: nothing of an extra that is not installed runs."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


@lru_cache
def reached_sources(modules: tuple[str, ...]) -> tuple[Path, ...]:
    """Return the sorted source files that modules reach by import statements, also inside
    functions and for type checking. A module that is loaded by a name in a variable is not seen:
    list it in ``modules``."""
    paths: dict[str, Path] = {}
    waiting = list(_sources_of(modules))
    while waiting:
        name, path = waiting.pop()
        if name in paths:
            continue
        paths[name] = path
        package = name.rpartition(".")[0]
        if package not in paths:  # a package's own code runs before its modules
            waiting += _sources_of((package,))
        waiting += imported_sources(path)
    return tuple(sorted(paths.values()))


@cache
def imported_sources(path: Path) -> tuple[tuple[str, Path], ...]:
    """Return name and file of each module of the project that a source imports, as this process
    first read it."""
    return _sources_of(dict.fromkeys(_imported(first_content(path).decode())))


def _sources_of(names: Iterable[str]) -> tuple[tuple[str, Path], ...]:
    """Return name and file of those of the names that are modules of the project."""
    sources = []
    for name in names:
        path = _source_of(name)
        if path is not None:
            sources.append((name, path))
    return tuple(sources)


@cache
def first_content(path: Path) -> bytes:
    """Return a source as this process first read it: later edits do not affect this process or its
    forks."""
    return path.read_bytes()


def _source_of(name: str) -> Path | None:
    """Return the file of a module of the project, or None if there is no such module."""
    base = ROOT.joinpath(*name.split("."))
    files = (base / "__init__.py", base.with_suffix(".py")) if name.partition(".")[0] in OWN else ()
    return next((path for path in files if path.is_file()), None)


def _imported(text: str) -> Iterator[str]:
    """Yield every dotted name that absolute imports may mean: both ``a`` and ``a.b`` for ``from a
    import b``."""
    for start, names, plain in IMPORT.findall(text):
        words = [
            name.split()[0] for name in (names or plain).strip("()\n ").split(",") if name.strip()
        ]
        yield from ([start, *(f"{start}.{word}" for word in words)] if start else words)


def _foreign_sources(module: str) -> Iterable[tuple[str, Path]]:
    """Yield (display name, file) for all sources of the package that a module of another project
    belongs to."""
    try:
        spec = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        for path in sorted(Path(folder).rglob("*.py")):
            yield path.relative_to(folder).as_posix(), path
    if spec and not spec.submodule_search_locations and spec.origin and Path(spec.origin).is_file():
        yield Path(spec.origin).name, Path(spec.origin)
