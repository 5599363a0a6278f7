"""Dotted paths: reading them, setting one value in plain data, and ``--set path=value`` of the command line."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError
from pydantic.fields import FieldInfo

from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import dotted, nearest, shown, unknown_key
from harness.vocabulary.declaration.problems import DeclarationError, Place, Problem
from harness.vocabulary.declaration.yaml_source import KeyPath, Source, parse_yaml

OPTION = "--set"
NOT_VARIED = ("sweep", "sensitivity")
"""Keys that hold dotted paths themselves."""


_ABSENT = object()


class PathError(Exception):
    """A dotted path that leads nowhere in the data: what was met at ``path``, the part that could be followed."""

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


def set_path(data: Any, path: KeyPath, value: Any, declared: shape.Declared | None = None) -> Any:
    """``data`` with the value at ``path`` replaced or added; the argument itself and all off the path stay unchanged.

    A mapping that is missing on the way is filled with its declared defaults where ``declared`` is given, so that
    setting one key of it leaves the others at what they would have been. Likewise a key that says which of several
    kinds a mapping is (``merge.kind``) leaves out what only the former kind has. Raises PathError where the way is
    barred.
    """
    return _with(data, path, value, declared, ())


def _with(data: Any, path: KeyPath, value: Any, declared: shape.Declared | None, above: KeyPath) -> Any:
    if not path:
        return value
    key, rest = _index(data, path[0], above), path[1:]
    here = (*above, key)
    if isinstance(data, list):
        if not isinstance(key, int) or key >= len(data):
            raise PathError(f"the list has no item {key}; it has {len(data)}, counted from 0", here)
        return [*data[:key], _with(data[key], rest, value, declared, here), *data[key + 1 :]]
    if key in data or not rest:
        inner = data.get(key)
    else:
        inner = default_at(declared, here)
        if inner is _ABSENT:
            raise PathError(f"there is no `{key}`", here)
    kept = data if rest else _of_kind(data, key, value, declared, above)
    return {**kept, key: _with(inner, rest, value, declared, here)}


def _of_kind(data: Any, key: Any, value: Any, declared: shape.Declared | None, path: KeyPath) -> Any:
    """The mapping at ``path`` without keys of its kind that the kind which ``value`` chooses does not know."""
    annotation = declared.at(path) if declared else None
    if annotation is None or shape.bare(annotation)[1] != key:
        return data
    old, new = (shape.model_for(annotation, one) for one in (data, {**data, key: value}))
    if old is None or new is None:
        return data
    gone = set(old.model_fields) - set(new.model_fields)
    return {name: one for name, one in data.items() if name not in gone}


def _index(data: Any, key: str | int, above: KeyPath) -> Any:
    if isinstance(data, dict):
        return str(key)
    if isinstance(data, list) and isinstance(key, int):
        return key
    raise PathError(f"`{dotted(above)}` is {shown(data)} here, which has no `{key}`", above)


def default_at(declared: shape.Declared | None, path: KeyPath) -> Any:
    """The declared default of a field as plain data, `_ABSENT` where it has none."""
    annotation: Any = declared.at(path) if declared else None
    for extra in get_args(annotation)[1:] if get_origin(annotation) is Annotated else ():
        if isinstance(extra, FieldInfo) and not extra.is_required():
            default = extra.get_default(call_default_factory=True, validated_data={})
            if isinstance(default, BaseModel):
                return _least(default, annotation)
            adapter: TypeAdapter[Any] = TypeAdapter(annotation)
            return adapter.dump_python(default, mode="json")
    return _ABSENT


def _least(default: BaseModel, annotation: Any) -> dict[str, Any]:
    """The fewest keys that say what a default says, so that what a preset fills in is left to it."""
    discriminator = shape.bare(annotation)[1]
    least = default.model_dump(mode="json", exclude_defaults=True)
    if discriminator:
        least[discriminator] = getattr(default, discriminator)
    try:
        same = TypeAdapter(annotation).validate_json(json.dumps(least)) == default
    except ValidationError:
        same = False
    return least if same else default.model_dump(mode="json")


def path_problem(path: KeyPath, declared: shape.Declared, place: Place) -> Problem | None:
    """The problem of a path that the declaration does not have, None where it is legal; with the nearest legal path."""
    for depth in range(1, len(path) + 1):
        if declared.at(path[:depth]) is None:
            known = [dotted(one) for one in declared.paths() if path[0] in NOT_VARIED or one[0] not in NOT_VARIED]
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
