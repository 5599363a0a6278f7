"""Dotted paths: reading them, setting one value in plain data, and ``--set path=value`` of the command line."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import dotted, nearest, shown, unknown_key
from harness.vocabulary.declaration.problems import DeclarationError, Place, Problem
from harness.vocabulary.declaration.yaml_source import KeyPath, Source, parse_yaml

OPTION = "--set"
NOT_VARIED = ("sweep", "sensitivity")
"""Keys that hold dotted paths themselves."""


class PathError(Exception):
    """A dotted path that leads nowhere in the data: the message, and the part of the path that could be followed."""

    def __init__(self, message: str, path: KeyPath) -> None:
        super().__init__(message)
        self.message, self.path = message, path


def key_path(text: str) -> KeyPath:
    """``a.b.2.c`` as keys and indices. After ``sweep.`` the rest is one key, as it is in the file."""
    head, _, rest = text.partition(".")
    if head == "sweep" and rest:
        return (head, rest)
    return tuple(int(part) if part.isascii() and part.isdigit() else part for part in text.split("."))


def get_path(data: Any, path: KeyPath) -> Any:
    """The value at a path. Raises PathError where there is none."""
    for depth, key in enumerate(path):
        try:
            data = data[_index(data, key, path[:depth])]
        except LookupError:
            raise PathError(f"there is no `{key}`", path[: depth + 1]) from None
    return data


def set_path(data: Any, path: KeyPath, value: Any, declared: shape.Declared | None = None, above: KeyPath = ()) -> Any:
    """``data`` with the value at ``path`` replaced or added; the argument itself and all off the path stay unchanged.

    A mapping that is missing on the way is filled with its declared defaults where ``declared`` is given, so that
    setting one key of it leaves the others at what they would have been. Likewise a key that says which of several
    kinds a mapping is (``merge.kind``) leaves out what only the former kind has. ``above`` is where ``data`` stands in
    the declared data. Raises PathError where the way is barred.
    """
    if not path:
        return value
    key, rest = _index(data, path[0], above), path[1:]
    here = (*above, key)
    if isinstance(data, list):
        if not isinstance(key, int) or key >= len(data):
            raise PathError(f"the list has no item {key}; it has {len(data)}, counted from 0", here)
        return [*data[:key], set_path(data[key], rest, value, declared, here), *data[key + 1 :]]
    inner = data.get(key)
    if key not in data and rest:
        schema = declared.at(here) if declared else None
        if schema is None or "default" not in schema:
            raise PathError(f"there is no `{key}`", here)
        inner = schema["default"]
    around = declared.at(above) if declared and not rest else None
    kinds = shape.kinds_of(around or {})
    if around is not None and kinds and kinds[0] == key:
        old, new = (shape.object_for(around, kind) or {} for kind in (data, {**data, key: value}))
        gone = set(old.get("properties", ())) - set(new.get("properties", ()))
        data = {name: held for name, held in data.items() if name not in gone}
    return {**data, key: set_path(inner, rest, value, declared, here)}


def _index(data: Any, key: str | int, above: KeyPath) -> Any:
    if isinstance(data, dict):
        return str(key)
    if isinstance(data, list) and isinstance(key, int):
        return key
    raise PathError(f"`{dotted(above)}` is {shown(data)} here, which has no `{key}`", above)


def path_problem(path: KeyPath, declared: shape.Declared, place: Place) -> Problem | None:
    """The problem of a path that the declaration does not have, None where it is legal; with the nearest legal path."""
    for depth in range(1, len(path) + 1):
        if declared.at(path[:depth]) is None:
            known = [dotted(legal) for legal in declared.paths() if path[0] in NOT_VARIED or legal[0] not in NOT_VARIED]
            found = unknown_key(str(path[depth - 1]), path[: depth - 1], declared.names(path[: depth - 1]), place)
            return Problem(
                f"unknown path `{dotted(path)}`: {found.message}", place, found.legal, nearest(dotted(path), known)
            )
    return None


def overridden(source: Source, overrides: Sequence[str], declared_of: shape.DeclaredOf) -> tuple[Source, list[Problem]]:
    """The source with every legal ``path=value`` applied in order, and what is wrong with the others."""
    problems: list[Problem] = []
    for text in overrides:
        try:
            source = _override(source, text, declared_of(source.data))
        except DeclarationError as error:
            problems += error.problems
    return source, [*problems, *_in_vain(source, overrides)]


def _override(source: Source, text: str, declared: shape.Declared) -> Source:
    name, equals, value_text = text.partition("=")
    place = _place_of(text)
    if not equals or not name.strip() or not value_text.strip():
        fix = "write null for nothing" if equals and name.strip() else None
        raise DeclarationError(OPTION, [Problem("not of the form path=value", place, "capture.frames=10", fix=fix)])
    path = key_path(name.strip())
    value = parse_yaml(text, OPTION, start=len(name) + 1, is_argument=True)
    problem = path_problem(path, declared, place)
    if problem is None:
        try:
            return source.with_value(path, set_path(source.data, path, value.data, declared), value)
        except PathError as error:
            problem = Problem(error.message, place)
    raise DeclarationError(OPTION, [problem])


def _in_vain(source: Source, overrides: Sequence[str]) -> Iterator[Problem]:
    """Overrides of keys that are swept: their value would never be used."""
    swept = shape.child(source.data, "sweep")
    for text in overrides:
        name, _, value = text.partition("=")
        if isinstance(swept, dict) and name.strip() in swept:
            message = f"`{name.strip()}` is swept, so this value would never be used"
            yield Problem(message, _place_of(text), fix=f"{OPTION} 'sweep.{name.strip()}=[{value.strip()}]'")


def _place_of(text: str) -> Place:
    """The path of an override, as a place."""
    return Place(OPTION, 0, 1, text, max(1, len(text.partition("=")[0])))
