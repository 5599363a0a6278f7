"""Translates pydantic's errors into problems with a place, the legal values and the nearest legal
word."""

import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from pydantic import ValidationError

from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.yaml_source import (
    MAX_PROBLEMS,
    DeclarationError,
    KeyPath,
    Place,
    Problem,
    Source,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.lengths import LEGAL, unit_of_key
from harness.vocabulary.words import nearest

YES_AND_NO = {"yes": "true", "on": "true", "no": "false", "off": "false"}
"""Booleans of YAML 1.1, which are text in YAML 1.2."""
WORDS = {
    "Input should be": "it should be",
    "an object": "a mapping",
    "valid array": "list",
    "valid tuple": "list",
}
WORDS |= {"valid string": "text", "valid boolean": "true or false", " in strict mode": ""}
WORDS |= {"be a true": "be true", "be a text": "be text"}
"""Replaces pydantic's words with those of YAML."""

C = TypeVar("C", bound=Config)


def validated(
    model: type[C], source: Source, splices: shape.Splices
) -> tuple[C | None, list[Problem]]:
    """Validate a source's data, and free data at ``splices`` against the models that belong there.
    Returns all problems and the declaration, whose spliced data is completed with defaults (None
    if there is any problem)."""
    problems: list[Problem] = []
    declared = shape.Declared(model, source.data, splices)
    data = source.data
    config = None
    for path, spliced in splices.items():
        try:
            data = with_value_at(
                data, path, spliced.from_data(shape.get(data, path) or {}).to_data()
            )
        except ValidationError as error:
            problems += problems_of(error, declared, source, path)
    try:
        config = model.from_data(data)
    except ValidationError as error:
        problems += problems_of(error, declared, source)
    return (None if problems else config), problems


def with_value_at(data: Any, path: KeyPath, value: Any) -> Any:
    """Return data with a value set at a path; unchanged if the path passes anything but mappings
    and lists."""
    if not path:
        return value
    inner = with_value_at(shape.child(data, path[0]), path[1:], value)
    if isinstance(data, list):
        return [inner if index == path[0] else item for index, item in enumerate(data)]
    return {**(data or {}), path[0]: inner} if data is None or isinstance(data, dict) else data


def read_as(models: Mapping[str, type[C]], key: str, source: Source) -> C:
    """Return the declaration in a file whose ``key`` selects one of ``models``. Raises
    DeclarationError."""
    name = source.data.get(key)
    position = source.place_of((key,))
    if name is None:
        problems = [
            Problem(
                f"the file lacks the key `{key}`", position, legal="one of " + ", ".join(models)
            )
        ]
    elif not isinstance(name, str) or name not in models:
        problems = [wrong_choice((key,), name, list(models), position)]
    else:
        config, problems = validated(models[name], source, {})
        if config is not None:
            return config
    raise DeclarationError(source.origin, problems)


def settings_of(model: type[C], data: Mapping[str, Any], noun: str, within: str | None = None) -> C:
    """Validate plain data from command line options and return it as a declaration. Raises a
    single UserError with all problems under the heading ``noun``; ``within`` is the key that
    precedes each path there."""
    try:
        return model.from_data(data)
    except ValidationError as error:
        # without a source text, only the path says which option is wrong
        base: KeyPath = () if within is None else (within,)
        document = data if within is None else {within: data}
        source = Source(noun, "", document, {(): Place(noun, 0, 1, "")}, {})
        declared = shape.Declared(
            Config if base else model, document, {base: model} if base else {}
        )
        problems = [
            replace(problem, place=None) for problem in problems_of(error, declared, source, base)
        ]
        lines = dict.fromkeys(str(problem).replace("\n", "\n  ") for problem in problems)
        raise UserError(f"{noun}:\n  " + "\n  ".join(lines)) from error


def problems_of(
    error: ValidationError, declared: shape.Declared, source: Source, base: KeyPath = ()
) -> list[Problem]:
    """Return the first `MAX_PROBLEMS` problems of a ValidationError whose locations start at
    ``base``. pydantic's locations mix keys of the data with labels of union branches. For a union
    without a discriminator, only the errors of the intended branch are reported; if that branch is
    unclear, the union as a whole is the problem."""
    alone: list[tuple[KeyPath, Any]] = []
    unions: dict[KeyPath, list[tuple[str, KeyPath, Any]]] = defaultdict(list)
    for detail in error.errors(include_url=False, include_input=False)[:MAX_PROBLEMS]:
        path: KeyPath = ()
        label = None
        location = (*base, *detail["loc"])
        data = declared.data
        for number, key in enumerate(location, start=1):
            exists = (
                key in data
                if isinstance(data, Mapping)
                else isinstance(data, list) and key in range(len(data))
            )
            if exists or (detail["type"] == "missing" and number == len(location)):
                path = (*path, key)
                data = shape.child(data, key)
            else:
                label = label or (path, str(key))
        if label:
            unions[label[0]].append((label[1], path, detail))
        else:
            alone.append((path, detail))
    problems = []
    for path, errors in unions.items():
        labels = {label for label, _, _ in errors}
        data = shape.get(declared.data, path)
        slot = declared.at(path)
        meant = labels if len(labels) == 1 else set[str]()
        if isinstance(data, dict):
            meant = meant or {getattr(shape.model_for(slot, data), "__name__", "")} & labels
        elif isinstance(data, list):
            meant = meant or {label for label in labels if label.startswith(("list[", "tuple["))}
        alone += [(path, detail) for label, path, detail in errors if label in meant]
        if not meant:
            message = f"`{dotted(path)}` is {shown(data)}, which matches none of the legal forms"
            problems.append(Problem(message, source.place_of(path), legal=shape.legal_at(slot)))
    return problems + [_problem(path, detail, declared, source) for path, detail in alone]


def _problem(path: KeyPath, error: Any, declared: shape.Declared, source: Source) -> Problem:
    """Describe one of pydantic's errors, at a path in the data, in the user's terms."""
    value = shape.get(source.data, path)
    slot = declared.at(path)
    position = source.place_of(path)
    kind = error["type"]
    legal = shape.legal_at(slot)
    kinds = shape.kinds_of(slot)
    fix = None
    if kind == "missing":
        parent = path[:-1]
        name = path[-1]
        inside = f"`{dotted(parent)}` lacks" if parent else "the file lacks"
        if isinstance(name, int):
            return Problem(f"{inside} item number {name + 1}", source.place_of(parent), legal)
        return Problem(f"{inside} the key `{name}`", source.key_place_of(parent), legal)
    if kind == "extra_forbidden":
        within = path[:-1]
        taken = shape.get(source.data, within)
        problem = unknown_key(
            str(path[-1]), within, declared.names(within), source.key_place_of(path), taken
        )
        home = _home_of(path, declared)
        if home is None or problem.nearest is not None:
            return problem
        around = f"of `{dotted(home)}`" if home else "at the left margin"
        return replace(problem, fix=f"indent `{path[-1]}` as the keys {around}, where it belongs")
    if kinds and not isinstance(value, dict):
        message = f"`{dotted(path)}` is {shown(value)}, not a mapping"
        return Problem(
            message, position, legal=f"a mapping with `{kinds[0]}`: one of {', '.join(kinds[1])}"
        )
    if kinds and kind in ("union_tag_invalid", "union_tag_not_found"):
        key = kinds[0]
        tags = list(kinds[1])
        if key in value:
            return wrong_choice((*path, key), value[key], tags, source.place_of((*path, key)))
        nearest_word = nearest(key, value)
        message = f"`{dotted(path)}` lacks the key `{key}`, which selects its kind"
        fix = f"rename `{nearest_word}` to `{key}`" if nearest_word else None
        return Problem(
            message, source.key_place_of(path), legal="one of " + ", ".join(tags), fix=fix
        )
    if kind == "literal_error" and (choices := shape.choices_of(slot)):
        return wrong_choice(path, value, choices, position)
    if kind in ("value_error", "assertion_error"):
        message = (f"`{dotted(path)}`: " if path else "") + str(
            error.get("ctx", {}).get("error", error["msg"])
        )
        # the message of a whole mapping's validator is complete; a list of keys would not help
        return Problem(message, position, legal=None if isinstance(value, dict) else legal)
    if isinstance(value, dict | list) and kind in (
        "model_type",
        "dict_type",
        "tuple_type",
        "list_type",
    ):
        return Problem(f"`{dotted(path)}` is {shown(value)}", position, legal)
    unit = next((unit_of_key(key) for key in reversed(path) if isinstance(key, str)), None)
    if kind == "float_type" and unit is not None and isinstance(value, str):
        legal = f"{legal or 'a number'}, in {unit}; or a length with a unit, {LEGAL}"
    if kind.startswith("int_") and isinstance(value, float) and value.is_integer():
        fix = f"write {int(value)} without a decimal point or exponent"
    if kind.startswith("bool_") and str(value).lower() in YES_AND_NO:
        fix = f"write {YES_AND_NO[str(value).lower()]}"
    text = re.sub(r"valid dictionary( or (instance of|object to) .*)?$", "mapping", error["msg"])
    for old, new in WORDS.items():
        text = text.replace(old, new)
    return Problem(
        f"`{dotted(path)}` is {shown(value)}: {text[0].lower()}{text[1:]}", position, legal, fix=fix
    )


def _home_of(path: KeyPath, declared: shape.Declared) -> KeyPath | None:
    """Return the mapping nearby that has the last key of a path, where a wrong indentation has
    taken it from: one around the path's own mapping, beside it or within it; None without one."""
    key = path[-1]
    within = path[:-1]
    homes = []
    for legal in declared.paths():
        mapping = legal[:-1]
        is_near = mapping[: len(within) - 1] == within[:-1] and len(mapping) <= len(within) + 1
        if legal[-1] == key and (is_near or within[: len(mapping)] == mapping):
            homes.append(mapping)
    return min(homes, key=lambda mapping: abs(len(mapping) - len(within)), default=None)


def dotted(path: Sequence[str | int]) -> str:
    """Return a path as it is written in ``sweep:``, with dots between keys and indices."""
    return ".".join(map(str, path))


def shown(value: Any) -> str:
    """Return a value as messages show it: in YAML's flow style, cut at 40 characters."""
    if isinstance(value, dict | list):
        noun = "mapping" if isinstance(value, dict) else "list"
        return f"a {noun}" if value else f"an empty {noun}"
    text = json.dumps(value, ensure_ascii=False)
    text = (
        text.replace("Infinity", ".inf").replace("NaN", ".nan")
        if isinstance(value, float)
        else text
    )
    return text if len(text) <= 40 else text[:39] + "…"


def wrong_choice(
    path: Sequence[str | int], value: Any, choices: Iterable[Any], position: Place
) -> Problem:
    """Return the problem for a value that is not among its legal ``choices``."""
    words = [shape.plain(choice) for choice in choices]
    message = f"`{dotted(path)}` is {shown(value)}, which is none of the legal values"
    return Problem(
        message, position, legal="one of " + ", ".join(words), nearest=nearest(value, words)
    )


def unknown_key(
    name: str,
    where: KeyPath,
    legal: Sequence[str],
    position: Place | None,
    taken: Iterable[str] = (),
) -> Problem:
    """Return the problem for an illegal key in the mapping at ``where``, which already has the
    keys ``taken``."""
    inside = f" in `{dotted(where)}`" if where else ""
    free = [key for key in legal if key not in set(taken)]
    return Problem(
        f"unknown key `{name}`{inside}",
        position,
        ", ".join(legal) or "no key here",
        nearest(name, free),
    )
