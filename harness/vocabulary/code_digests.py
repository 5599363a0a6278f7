"""Digests of what a stored number hangs on: its code by room, and its inputs.

A source counts by its syntax tree without docstrings, so that a comment, a layout or a docstring
ages nothing. Rooms that write tables, pages and messages do not count, as no number hangs on them;
nor do the versions of packages, which `requirements.lock` fixes and `provenance.record` states."""

import ast
import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from harness.vocabulary import provenance
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, strict_json, write_json
from harness.vocabulary.seeds import digest

COUNTED = (
    "detectors/",
    "scenes/",
    "harness/trials/",
    "harness/evaluation/",
    "harness/stills/",
    "harness/inspection/",
    "harness/programs/",
    "harness/runs/calibration.py",
    "harness/experiment/unknowns.py",
    "harness/vocabulary/geometry.py",
    "harness/vocabulary/meshes.py",
    "harness/vocabulary/seeds.py",
)
"""Sources that decide numbers, by the beginning of their path."""
NOT_SYNTAX = ("ctx", "kind", "type_comment")
"""Fields of syntax trees that follow from others."""
DIGITS = 12
Digests = dict[str, str]
"""Digests by part: a room, a camera, an experiment or a file."""
_known: Digests = {}
"""Digests of sources by that of their bytes."""


@contextmanager
def remembered(path: Path) -> Iterator[None]:
    """Take the digests of sources that an earlier process has kept in a file, and keep those of
    this one: to parse what a study hangs on takes half a second. A file that another version of
    this code or of Python wrote, or that cannot be read or written, does not count."""
    by = f"{sys.version_info[:2]} {_content_digest(Path(__file__))}"
    with suppress(OSError, ValueError, UserError, KeyError, TypeError):
        stored = strict_json(bounded_bytes(path, TEXT_BYTES))
        if stored["by"] == by:
            _known.update(stored["digests"])
    before = len(_known)
    yield
    if len(_known) > before:
        with suppress(UserError):
            write_json(path, {"by": by, "digests": _known})


def code_digests(modules: Iterable[str]) -> Digests:
    """Return the digest of each room of counted sources that modules reach by imports. A module of
    another project is a part of its own, with all sources of its package."""
    project_modules = []
    foreign_modules = []
    for name in sorted(set(modules)):
        if _package_of(name) in provenance.OWN:
            project_modules.append(name)
        else:
            foreign_modules.append(name)
    paths_by_room: dict[str, list[Path]] = {}
    for path in provenance.reached_sources(tuple(project_modules)):
        relative = path.relative_to(provenance.ROOT)
        if relative.as_posix().startswith(COUNTED):
            room = relative.parent.as_posix()
            paths_by_room.setdefault(room, []).append(path)
    digests = {room: _files_digest(paths) for room, paths in paths_by_room.items()}
    for name in foreign_modules:
        foreign_digest = provenance.source_digest((name,), ())
        digests[_package_of(name)] = foreign_digest[:DIGITS]
    return digests


def _package_of(module: str) -> str:
    """Return the outermost package of a module."""
    return module.partition(".")[0]


def file_digests(names: Iterable[str]) -> Digests:
    """Return the digest of each file or folder of the checkout: of Python its syntax, of YAML its
    data, of any other file its bytes. A folder counts with the Python below it. A file that is
    absent has the digest ``absent``."""
    digests = {}
    for name in names:
        path = provenance.ROOT / name
        if path.is_dir():
            digests[name] = _files_digest(path.rglob("*.py"))
        else:
            digests[name] = _file_digest(path)
    return digests


def changed_parts(stored: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the parts whose digests differ, with those that only one side has."""
    parts = {*stored, *now}
    return sorted(part for part in parts if stored.get(part) != now.get(part))


def _files_digest(paths: Iterable[Path]) -> str:
    """Return the digest of files with their names."""
    digests_by_name = [[path.name, _file_digest(path)] for path in sorted(paths)]
    return digest(digests_by_name)[:DIGITS]


def _file_digest(path: Path) -> str:
    """Return the digest of a file's content."""
    if path.suffix == ".py":
        return _syntax_digest(path)
    if not path.is_file():
        return "absent"
    content = path.read_bytes()
    if path.suffix == ".yaml":
        # not by `read_yaml`, whose room imports this one's
        data = YAML(typ="safe", pure=True).load(content)
        return digest(data)[:DIGITS]
    return hashlib.blake2b(content).hexdigest()[:DIGITS]


@cache
def _syntax_digest(path: Path) -> str:
    """Return the digest of a Python source, as this process first read it: what a process makes
    comes from the code that it runs."""
    content_digest = _content_digest(path)
    if content_digest not in _known:
        tree = ast.parse(provenance.first_content(path))
        words: list[str] = []
        _add_syntax(tree, words)
        syntax_digest = hashlib.blake2b(" ".join(words).encode()).hexdigest()
        _known[content_digest] = syntax_digest[:DIGITS]
    return _known[content_digest]


def _content_digest(path: Path) -> str:
    """Return the digest of a source's bytes, as this process first read it."""
    return hashlib.blake2b(provenance.first_content(path), digest_size=16).hexdigest()


def _add_syntax(node: Any, words: list[str]) -> None:
    """Add a syntax tree as words, without docstrings. Empty fields are left out, as versions of
    Python differ in them. A list that is filled takes half the time of nested generators, and a
    study's code has 700,000 words."""
    if isinstance(node, list):
        words.append("[")
        for item in node:
            _add_syntax(item, words)
        words.append("]")
    elif not isinstance(node, ast.AST):
        words.append(repr(node))
    elif not _is_docstring(node):
        words.append(type(node).__name__)
        for name in node._fields:
            value = getattr(node, name, None)
            if name not in NOT_SYNTAX and value is not None and value != []:
                words.append(name)
                _add_syntax(value, words)


def _is_docstring(node: ast.AST) -> bool:
    """Return whether a node is a statement that consists of a text."""
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
        return False
    return isinstance(node.value.value, str)
