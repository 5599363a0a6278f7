"""Turning pydantic's errors into problems with a place: what is wrong, what is legal there, the nearest legal word."""

from __future__ import annotations

import difflib
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.problems import MAX_PROBLEMS, DeclarationError, Place, Problem, in_order
from harness.vocabulary.declaration.shape import Declared
from harness.vocabulary.declaration.yaml_source import KeyPath, Source
from harness.vocabulary.errors import UserError

YES_AND_NO = {"yes": "true", "on": "true", "no": "false", "off": "false"}
"""Booleans of YAML 1.1, text in YAML 1.2."""

LEAST_HELD = 3
"""Letters of a word that is looked for within others: fewer are in too many."""

C = TypeVar("C", bound=Config)


def validated(model: type[C], source: Source, splices: shape.Splices) -> tuple[C | None, list[Problem]]:
    """Validate a source's data, and free data at ``splices`` by the model that belongs there.

    Returns the declaration with spliced data completed by its defaults (None where anything is wrong) and all problems.
    """
    problems: list[Problem] = []
    declared = Declared(model, source.data, splices)
    config: C | None = None
    try:
        config = model.from_data(source.data)
    except ValidationError as error:
        problems += problems_of(error, declared, source)
    for path, spliced in splices.items():
        data = shape.get(source.data, path)
        try:
            filled = spliced.from_data({} if data is None else data)
        except ValidationError as error:
            problems += problems_of(error, declared, source, path)
        else:
            config = _with_spliced(config, path, filled) if config is not None else None
    return (None if problems else config), problems


def read_as(models: Mapping[str, type[C]], key: str, source: Source) -> C:
    """The declaration in a file whose ``key`` names which of ``models`` it fills. Raises DeclarationError."""
    name = source.data.get(key)
    if not isinstance(name, str) or name not in models:
        place = source.place_of((key,))
        lacking = Problem(f"the file lacks the key `{key}`", place, legal="one of " + ", ".join(models))
        raise DeclarationError(
            source.origin, [lacking if name is None else wrong_choice((key,), name, list(models), place)]
        )
    config, problems = validated(models[name], source, {})
    if config is None:
        raise DeclarationError(source.origin, problems)
    return config


def settings_of(model: type[C], data: Mapping[str, Any], what: str, within: str | None = None) -> C:
    """Plain data that options of the command line state, as a declaration.

    Raises UserError with every problem at once, under ``what``; ``within``: the key that stands before each path there.
    """
    try:
        return model.from_data(data)
    except ValidationError as error:
        # there is no text to point into: a path alone says which option is wrong
        base: KeyPath = () if within is None else (within,)
        whole = data if within is None else {within: data}
        source = Source(what, "", whole, {(): Place(what, 0, 1, "")}, {})
        declared = Declared(Config if base else model, whole, {base: model} if base else {})
        problems = [replace(each, place=None) for each in problems_of(error, declared, source, base)]
        told = [str(each).replace("\n", "\n  ") for each in in_order(problems)]
        raise UserError(f"{what}:\n  " + "\n  ".join(told)) from error


def _with_spliced(config: Any, path: KeyPath, filled: BaseModel) -> Any:
    """The declaration (or a tuple or mapping in it) with free data at ``path`` replaced by its completed form."""
    if not path:
        return filled.model_dump(mode="json")
    head, rest = path[0], path[1:]
    if isinstance(config, tuple) and isinstance(head, int):
        return (*config[:head], _with_spliced(config[head], rest, filled), *config[head + 1 :])
    return config.model_copy(update={str(head): _with_spliced(getattr(config, str(head)), rest, filled)})


@dataclass(frozen=True)
class _Located:
    """One of pydantic's errors with its path in the data."""

    kind: str
    text: str
    context: Mapping[str, Any]
    path: KeyPath
    label: str = ""


def problems_of(error: ValidationError, declared: Declared, source: Source, base: KeyPath = ()) -> list[Problem]:
    """The problems behind a ValidationError whose locations start at ``base``; the first `MAX_PROBLEMS` of them.

    Of a union without a discriminator only the errors of the branch that was meant are told; where that is unclear,
    the union as a whole is a problem.
    """
    alone: list[_Located] = []
    unions: dict[KeyPath, list[_Located]] = defaultdict(list)
    for each in error.errors(include_url=False, include_input=False)[:MAX_PROBLEMS]:
        missing = each["type"] == "missing"
        path, label = shape.landing(declared.data, (*base, *each["loc"]), missing)
        located = _Located(each["type"], each["msg"], each.get("ctx", {}), path, label[1] if label else "")
        (unions[label[0]] if label else alone).append(located)
    problems = []
    for path, errors in unions.items():
        labels = {located.label for located in errors}
        if len(labels) == 1:
            alone += errors
            continue
        data, schema = shape.get(declared.data, path), declared.at(path)
        if isinstance(data, dict):
            meant = {(shape.object_for(schema or {}, data) or {}).get("title")} & labels
        else:
            meant = {label for label in labels if data and label.startswith(("list[", "tuple["))}
        if meant and isinstance(data, dict | list):
            alone += [located for located in errors if located.label in meant]
        else:
            message = f"`{dotted(path)}` is {shown(data)}, which fits none of what is legal here"
            problems.append(Problem(message, source.place_of(path), legal=shape.legal_at(schema)))
    return problems + [_problem(located, declared, source) for located in alone]


def _problem(error: _Located, declared: Declared, source: Source) -> Problem:
    """One error in the user's terms."""
    path = error.path
    value, schema, place = shape.get(source.data, path), declared.at(path), source.place_of(path)
    legal = shape.legal_at(schema)
    if error.kind == "missing":
        parent, name = path[:-1], path[-1]
        inside = f"`{dotted(parent)}` lacks" if parent else "the file lacks"
        if isinstance(name, int):
            return Problem(f"{inside} an item number {name + 1}", source.place_of(parent), legal)
        return Problem(f"{inside} the key `{name}`", source.key_place_of(parent), legal)
    if error.kind == "extra_forbidden":
        within = path[:-1]
        taken = shape.get(source.data, within)
        return unknown_key(str(path[-1]), within, declared.names(within), source.key_place_of(path), taken)
    kinds = shape.kinds_of(schema or {})
    if kinds and not isinstance(value, dict):
        message = f"`{dotted(path)}` is {shown(value)}, not a mapping"
        return Problem(message, place, legal=f"a mapping with `{kinds[0]}`: one of {', '.join(kinds[1])}")
    if kinds and error.kind in ("union_tag_invalid", "union_tag_not_found"):
        key, tags = kinds[0], list(kinds[1])
        if key in value:
            return wrong_choice((*path, key), value[key], tags, source.place_of((*path, key)))
        near = nearest(key, value)
        message = f"`{dotted(path)}` lacks the key `{key}`, which says what it is"
        fix = f"rename `{near}` to `{key}`" if near else None
        return Problem(message, source.key_place_of(path), legal="one of " + ", ".join(tags), fix=fix)
    if error.kind in ("literal_error", "enum", "is_instance_of") and (choices := shape.choices_of(schema)):
        return wrong_choice(path, value, choices, place)
    if error.kind in ("value_error", "assertion_error"):
        message = (f"`{dotted(path)}`: " if path else "") + str(error.context.get("error", error.text))
        # what a validator of a whole mapping says is complete; its keys are no help
        return Problem(message, place, legal=None if isinstance(value, dict) else legal)
    if isinstance(value, dict | list) and error.kind in ("model_type", "dict_type", "tuple_type", "list_type"):
        return Problem(f"`{dotted(path)}` is {shown(value)}", place, legal)
    fix = None
    if error.kind.startswith("int_") and isinstance(value, float) and value.is_integer():
        fix = f"write {int(value)}, without point or exponent"
    if error.kind.startswith("bool_") and str(value).lower() in YES_AND_NO:
        fix = f"write {YES_AND_NO[str(value).lower()]}"
    return Problem(f"`{dotted(path)}` is {shown(value)}: {_in_words_of_yaml(error.text)}", place, legal, fix=fix)


def _in_words_of_yaml(text: str) -> str:
    """pydantic's sentence, as the end of ours, without words of JSON and Python."""
    words = {"Input should be": "it should be", "an object": "a mapping", "valid array": "list", "valid tuple": "list"}
    words |= {"valid string": "text", "valid boolean": "true or false", " in strict mode": ""}
    text = re.sub(r"valid dictionary( or (instance of|object to) .*)?$", "mapping", text)
    for old, new in words.items():
        text = text.replace(old, new)
    return text[0].lower() + text[1:].replace("be a true", "be true").replace("be a text", "be text")


def nearest(word: object, words: Iterable[object], cutoff: float = 0.6) -> str | None:
    """The likeliest of ``words`` that the user meant, whatever the case and dashes: a similar spelling, else the
    shortest that holds the word (three letters at least), as realsense_l515 holds l515. None where there is neither."""
    folded = {str(known).lower().replace("-", "_"): str(known) for known in words}
    sought = str(word).lower().replace("-", "_")
    found = difflib.get_close_matches(sought, folded, n=1, cutoff=cutoff)
    if not found and len(sought) >= LEAST_HELD:
        found = sorted((known for known in folded if sought in known), key=lambda known: (len(known), known))
    return folded[found[0]] if found else None


def dotted(path: Sequence[str | int]) -> str:
    """A path as it is written in ``sweep:``: keys and indices with dots between."""
    return ".".join(map(str, path))


def shown(value: Any) -> str:
    """A value in a message: as YAML's flow style would have it, cut at 40 characters."""
    if isinstance(value, dict):
        return "a mapping" if value else "an empty mapping"
    if isinstance(value, list):
        return "a list" if value else "an empty list"
    text = json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        text = text.replace("Infinity", ".inf").replace("NaN", ".nan")
    return text if len(text) <= 40 else text[:39] + "…"


def wrong_choice(path: Sequence[str | int], value: Any, choices: Iterable[Any], place: Place) -> Problem:
    """The problem of a value that is none of the legal ones."""
    words = [shape.plain(choice) for choice in choices]
    message = f"`{dotted(path)}` is {shown(value)}, which is none of the legal values"
    return Problem(message, place, legal="one of " + ", ".join(words), nearest=nearest(value, words))


def unknown_key(name: str, where: KeyPath, legal: Sequence[str], place: Place, taken: Iterable[str] = ()) -> Problem:
    """The problem of a key that is not legal in the mapping at ``where``, which has the keys ``taken`` already."""
    inside = f" in `{dotted(where)}`" if where else ""
    free = [key for key in legal if key not in set(taken)]
    return Problem(f"unknown key `{name}`{inside}", place, ", ".join(legal) or "no key here", nearest(name, free))
