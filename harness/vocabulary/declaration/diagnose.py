"""From pydantic's errors to problems with a place: what is wrong, what is legal there, the nearest legal word."""

from __future__ import annotations

import difflib
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.problems import MAX_PROBLEMS, Place, Problem
from harness.vocabulary.declaration.shape import Declared
from harness.vocabulary.declaration.yaml_source import KeyPath, Source

YES_AND_NO = {"yes": "true", "on": "true", "no": "false", "off": "false"}
"""Booleans of YAML 1.1, text in YAML 1.2."""

LEAST_HELD = 3
"""Letters of a word that is looked for within others: fewer are in too many."""

C = TypeVar("C", bound=Config)


@dataclass(frozen=True)
class _Located:
    """One error of pydantic with where it leads in the data."""

    kind: str
    text: str
    context: Mapping[str, Any]
    landing: shape.Landing


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


def problems_of(error: ValidationError, declared: Declared, source: Source, base: KeyPath = ()) -> list[Problem]:
    """The problems behind a ValidationError whose locations start at ``base``; the first `MAX_PROBLEMS` of them."""
    located = []
    for one in error.errors(include_url=False, include_input=False)[:MAX_PROBLEMS]:
        landing = shape.land(declared, (*base, *one["loc"]))
        located.append(_Located(one["type"], one["msg"], one.get("ctx", {}), landing))
    return [_problem(one, declared, source) for one in _meant(located, declared)]


def nearest(word: object, words: Iterable[object], cutoff: float = 0.6) -> str | None:
    """The likeliest of ``words`` that the user meant, whatever the case and dashes: one spelt nearly so, else the
    shortest that holds the word (three letters at least), as realsense_l515 holds l515. None where there is neither."""
    folded = {str(one).lower().replace("-", "_"): str(one) for one in words}
    sought = str(word).lower().replace("-", "_")
    found = difflib.get_close_matches(sought, folded, n=1, cutoff=cutoff)
    if not found and len(sought) >= LEAST_HELD:
        found = sorted((one for one in folded if sought in one), key=lambda one: (len(one), one))
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
    words = [choice if isinstance(choice, str) else json.dumps(choice) for choice in choices]
    message = f"`{dotted(path)}` is {shown(value)}, which is none of the legal values"
    return Problem(message, place, legal="one of " + ", ".join(words), nearest=nearest(value, words))


def unknown_key(name: str, where: KeyPath, legal: Sequence[str], place: Place, taken: Iterable[str] = ()) -> Problem:
    """The problem of a key that is not legal in the mapping at ``where``, which has the keys ``taken`` already."""
    inside = f" in `{dotted(where)}`" if where else ""
    free = [one for one in legal if one not in set(taken)]
    return Problem(f"unknown key `{name}`{inside}", place, ", ".join(legal) or "no key here", nearest(name, free))


def _with_spliced(config: C, path: KeyPath, filled: BaseModel) -> C:
    """The declaration with free data at ``path`` replaced by its completed form."""
    head, rest = str(path[0]), path[1:]
    value = _with_spliced(getattr(config, head), rest, filled) if rest else filled.model_dump(mode="json")
    return config.model_copy(update={head: value})


def _meant(located: list[_Located], declared: Declared) -> Iterator[_Located | list[_Located]]:
    """Single errors, and of each union without a discriminator those of the branch meant: all where it is unclear."""
    by_union: dict[KeyPath, list[_Located]] = defaultdict(list)
    for one in located:
        if one.landing.unions:
            by_union[one.landing.unions[0].path].append(one)
        else:
            yield one
    for path, errors in by_union.items():
        data = shape.get(declared.data, path)
        labels = {one.landing.unions[0].label for one in errors}
        if isinstance(data, dict):
            model = shape.model_for(declared.at(path), data)
            wanted = {model.__name__} if model else set()
        else:
            wanted = {label for label in labels if label.startswith(("list[", "tuple["))} if data else set()
        if wanted & labels and isinstance(data, dict | list):
            yield from (one for one in errors if one.landing.unions[0].label in wanted)
        else:
            yield errors


def _problem(one: _Located | list[_Located], declared: Declared, source: Source) -> Problem:
    """One error, or the errors of all branches of one union, in the user's terms."""
    if isinstance(one, list):
        path = one[0].landing.unions[0].path
        message = f"`{dotted(path)}` is {shown(shape.get(source.data, path))}, which fits none of what is legal here"
        return Problem(message, source.place_of(path), legal=shape.legal_at(declared.at(path)))
    path = one.landing.path
    value, annotation = shape.get(source.data, path), declared.at(path)
    if one.kind == "missing":
        return _missing(path, annotation, source)
    if one.kind == "extra_forbidden":
        within = path[:-1]
        taken = shape.get(source.data, within)
        return unknown_key(str(path[-1]), within, declared.names(within), source.key_place_of(path), taken)
    no_mapping = shape.bare(annotation)[1] is not None and not isinstance(value, dict)
    if no_mapping or one.kind in ("union_tag_invalid", "union_tag_not_found"):
        return _wrong_tag(path, annotation, source)
    if one.kind in ("literal_error", "enum", "is_instance_of") and (choices := shape.choices_of(annotation)):
        return wrong_choice(path, value, choices, source.place_of(path))
    if one.kind in ("value_error", "assertion_error"):
        where = f"`{dotted(path)}`: " if path else ""
        message = where + str(one.context.get("error", one.text))
        # what a validator of a whole mapping says is complete; its keys are no help
        legal = None if isinstance(value, dict) else shape.legal_at(annotation)
        return Problem(message, source.place_of(path), legal=legal)
    if isinstance(value, dict | list) and one.kind in ("model_type", "dict_type", "tuple_type", "list_type"):
        return Problem(f"`{dotted(path)}` is {shown(value)}", source.place_of(path), shape.legal_at(annotation))
    message = f"`{dotted(path)}` is {shown(value)}: {_in_words_of_yaml(one.text)}"
    return Problem(message, source.place_of(path), legal=shape.legal_at(annotation), fix=_rewriting(one.kind, value))


def _in_words_of_yaml(text: str) -> str:
    """pydantic's sentence, as the end of ours, without words of JSON and Python."""
    words = {"Input should be": "it should be", "an object": "a mapping", "valid array": "list", "valid tuple": "list"}
    words |= {"valid string": "text", "valid boolean": "true or false", " in strict mode": ""}
    text = re.sub(r"valid dictionary( or (instance of|object to) .*)?$", "mapping", text)
    for old, new in words.items():
        text = text.replace(old, new)
    return text[0].lower() + text[1:].replace("be a true", "be true").replace("be a text", "be text")


def _rewriting(kind: str, value: Any) -> str | None:
    """How to write what was meant, where YAML 1.2 reads it as another type."""
    if kind.startswith("int_") and isinstance(value, float) and value.is_integer():
        return f"write {int(value)}, without point or exponent"
    if kind.startswith("bool_") and str(value).lower() in YES_AND_NO:
        return f"write {YES_AND_NO[str(value).lower()]}"
    return None


def _missing(path: KeyPath, annotation: Any, source: Source) -> Problem:
    parent, name = path[:-1], path[-1]
    inside = f"`{dotted(parent)}` lacks" if parent else "the file lacks"
    if isinstance(name, int):
        return Problem(f"{inside} an item number {name + 1}", source.place_of(parent), shape.legal_at(annotation))
    return Problem(f"{inside} the key `{name}`", source.key_place_of(parent), shape.legal_at(annotation))


def _wrong_tag(path: KeyPath, annotation: Any, source: Source) -> Problem:
    """A mapping whose discriminator chooses no branch of its union."""
    key = shape.bare(annotation)[1] or "kind"
    tags = [tag for branch in shape.branches(annotation) for tag in shape.tags_of(branch, key)]
    mapping = shape.get(source.data, path)
    if not isinstance(mapping, dict):
        message = f"`{dotted(path)}` is {shown(mapping)}, not a mapping"
        return Problem(message, source.place_of(path), legal=f"a mapping with `{key}`: one of {', '.join(tags)}")
    if key in mapping:
        return wrong_choice((*path, key), mapping[key], tags, source.place_of((*path, key)))
    near = nearest(key, mapping)
    fix = f"rename `{near}` to `{key}`" if near else None
    message = f"`{dotted(path)}` lacks the key `{key}`, which says what it is"
    return Problem(message, source.key_place_of(path), legal="one of " + ", ".join(tags), fix=fix)
