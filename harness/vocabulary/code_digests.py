"""Digests of what a stored number hangs on: its code by room, and its inputs.

A source counts by its syntax tree without docstrings, so that a comment, a layout or a docstring
ages nothing. Rooms that write tables, pages and messages do not count, as no number hangs on them;
nor do the versions of packages, which `requirements.lock` fixes and `provenance.record` states."""

import ast
import hashlib
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from harness.vocabulary import provenance
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


def code_digests(modules: Iterable[str]) -> Digests:
    """Return the digest of each room of counted sources that modules reach by imports. A module of
    another project is a part of its own, with all sources of its package."""
    own = sorted(name for name in modules if name.partition(".")[0] in provenance.OWN)
    rooms: dict[str, list[Path]] = {}
    for path in provenance.reached_sources(tuple(own)):
        shown = path.relative_to(provenance.ROOT)
        if shown.as_posix().startswith(COUNTED):
            rooms.setdefault(shown.parent.as_posix(), []).append(path)
    digests = {room: _together(paths) for room, paths in rooms.items()}
    for name in sorted(set(modules) - set(own)):
        digests[name.partition(".")[0]] = provenance.source_digest((name,), ())[:DIGITS]
    return digests


def file_digests(names: Iterable[str]) -> Digests:
    """Return the digest of each file or folder of the checkout: of Python its syntax, of YAML its
    data, of any other file its bytes. A folder counts with the Python below it. A file that is
    absent has the digest ``absent``."""
    digests = {}
    for name in names:
        path = provenance.ROOT / name
        digests[name] = _together(path.rglob("*.py")) if path.is_dir() else _of_file(path)
    return digests


def changed_parts(stored: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the parts whose digests differ, with those that only one side has."""
    parts = {*stored, *now}
    return sorted(part for part in parts if stored.get(part) != now.get(part))


def _together(paths: Iterable[Path]) -> str:
    """Return the digest of files with their names."""
    return digest([[path.name, _of_file(path)] for path in sorted(paths)])[:DIGITS]


def _of_file(path: Path) -> str:
    """Return the digest of a file's content."""
    if path.suffix == ".py":
        return _of_source(path)
    if not path.is_file():
        return "absent"
    content = path.read_bytes()
    if path.suffix == ".yaml":
        # not by `read_yaml`, whose room imports this one's
        return digest(YAML(typ="safe", pure=True).load(content))[:DIGITS]
    return hashlib.blake2b(content).hexdigest()[:DIGITS]


@cache
def _of_source(path: Path) -> str:
    """Return the digest of a Python source, as this process first read it: what a process makes
    comes from the code that it runs."""
    syntax = _syntax(ast.parse(provenance._content(path)))
    return hashlib.blake2b(" ".join(syntax).encode()).hexdigest()[:DIGITS]


def _syntax(node: Any) -> Iterator[str]:
    """Yield a syntax tree as words, without docstrings. Empty fields are left out, as versions of
    Python differ in them."""
    if isinstance(node, list):
        yield "["
        for item in node:
            yield from _syntax(item)
        yield "]"
    elif not isinstance(node, ast.AST):
        yield repr(node)
    elif not _is_docstring(node):
        yield type(node).__name__
        for name in node._fields:
            value = getattr(node, name, None)
            if name not in NOT_SYNTAX and value is not None and value != []:
                yield name
                yield from _syntax(value)


def _is_docstring(node: ast.AST) -> bool:
    """Return whether a node is a statement that consists of a text."""
    if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
        return False
    return isinstance(node.value.value, str)
