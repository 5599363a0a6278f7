"""The structure that a declaration's models require, read from the annotations of their fields. A
*splice* places a model where another model holds free data, such as the settings of a detector
that is chosen by name."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from harness.vocabulary.config import Config
from harness.vocabulary.declaration.yaml_source import KeyPath

# Characters of the longest field description that a message repeats as a statement of limits
LONGEST_NOTE = 100
BOUNDS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
Splices = Mapping[KeyPath, type[Config]]


@dataclass(frozen=True)
class Slot:
    """A place for data, as an annotation describes it."""

    # The alternatives of its type, each with its constraints by name: "ge", "pattern", ...
    branches: tuple[tuple[Any, Mapping[str, Any]], ...]
    # The model's field that holds the data; None for a member of a list or of a union
    field: FieldInfo | None = None

    @property
    def models(self) -> tuple[type[BaseModel], ...]:
        """The alternatives that are models."""
        return tuple(
            kind
            for kind, _ in self.branches
            if isinstance(kind, type) and issubclass(kind, BaseModel)
        )


@dataclass(frozen=True)
class Declared:
    """The declaration of a document: a model, and the models that belong in its free data."""

    # The model of the whole document
    model: type[BaseModel]
    # Plain data that is meant to fill the model; it may be wrong anywhere
    data: Any
    # The model that belongs at each path of free data
    splices: Splices

    def at(self, path: KeyPath) -> Slot | None:
        """Return the slot at ``path``, or None if a key on the way is unknown."""
        slot = slot_of(self.model)
        data = self.data
        for depth, key in enumerate(path, start=1):
            spliced = self.splices.get(path[:depth])
            below = slot_of(spliced) if spliced else _below(slot, data, key)
            if below is None:
                return None
            slot = below
            data = child(data, key)
        return slot

    def names(self, path: KeyPath) -> tuple[str, ...]:
        """Return the legal keys of the mapping at ``path``: the fields of its model, or the keys
        of free data."""
        data = get(self.data, path)
        model = model_for(self.at(path), data)
        if model is not None:
            return tuple(model.model_fields)
        return tuple(data) if isinstance(data, Mapping) else ()

    def paths(self, path: KeyPath = (), depth: int = 8) -> Iterator[KeyPath]:
        """Yield every path that can be set: model fields down to ``depth`` levels, and the list
        items in the data."""
        if depth == 0:
            return
        data = get(self.data, path)
        keys = range(len(data)) if isinstance(data, list) else self.names(path)
        for key in keys:
            yield (*path, key)
            yield from self.paths((*path, key), depth - 1)


DeclaredOf = Callable[[Any], Declared]
"""A function that returns what is declared for given data; the data decides which detector's
settings belong in it."""


def slot_of(annotation: Any, field: FieldInfo | None = None) -> Slot:
    """Return the slot for an annotation, or for a field with this annotation."""
    constraints = tuple(field.metadata) if field else ()
    return Slot(tuple(_branches(annotation, constraints)), field)


def _branches(
    annotation: Any, metadata: tuple[Any, ...]
) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    """Yield the alternatives of an annotation, each with the constraints in ``metadata``."""
    if get_origin(annotation) is Annotated:
        inner, *inner_metadata = get_args(annotation)
        constraints = list(metadata)
        for item in inner_metadata:
            # A pydantic Field groups several constraints
            constraints.extend(getattr(item, "metadata", (item,)))
        yield from _branches(inner, tuple(constraints))
    elif get_origin(annotation) in (Union, UnionType):
        for member in get_args(annotation):
            yield from _branches(member, metadata)
    else:
        limits = {}
        for constraint in metadata:
            for name in (*BOUNDS, "min_length", "max_length", "pattern"):
                limit = getattr(constraint, name, None)
                if limit is not None:
                    limits[name] = limit
        yield annotation, limits


def kinds_of(slot: Slot | None) -> tuple[str, Mapping[str, type[BaseModel]]] | None:
    """Return the key that distinguishes the models of a slot, and the model for each value; None
    without such a key."""
    return _kinds(slot.models) if slot else None


@lru_cache(maxsize=1000)
def _kinds(models: tuple[type[BaseModel], ...]) -> tuple[str, Mapping[str, type[BaseModel]]] | None:
    if len(models) < 2:
        return None
    for key in models[0].model_fields:
        tags_of_models = [_tags(model, key) for model in models]
        models_by_tag = {
            str(tag): model
            for model, tags in zip(models, tags_of_models, strict=True)
            for tag in tags
        }
        if all(tags_of_models) and len(models_by_tag) == sum(map(len, tags_of_models)):
            return key, models_by_tag
    return None


def _tags(model: type[BaseModel], key: str) -> tuple[Any, ...]:
    """Return the values of a model's Literal field, () without such a field."""
    field = model.model_fields.get(key)
    if field is None or get_origin(field.annotation) is not Literal:
        return ()
    return get_args(field.annotation)


def model_for(slot: Slot | None, data: Any) -> type[BaseModel] | None:
    """Return the model that a mapping is meant to fill: by its kind, or else the model with most
    keys in common."""
    if slot is None:
        return None
    values = data if isinstance(data, Mapping) else {}
    kinds = kinds_of(slot)
    if kinds is not None:
        tag_key, models_by_tag = kinds
        tag = str(values.get(tag_key))
        if tag in models_by_tag:
            return models_by_tag[tag]
    return max(
        slot.models,
        key=lambda model: len(values.keys() & model.model_fields.keys()),
        default=None,
    )


def _below(slot: Slot, data: Any, key: str | int) -> Slot | None:
    """Return the slot one key (or index) deeper, given the data at this level; None if the key is
    unknown."""
    model = model_for(slot, data)
    if model is not None and isinstance(key, str):
        field = model.model_fields.get(key)
        return None if field is None else slot_of(field.annotation, field)
    for kind, _ in slot.branches:
        arguments = get_args(kind)
        if kind is Any:
            return slot
        if isinstance(key, int) and get_origin(kind) in (tuple, list):
            if get_origin(kind) is list or arguments[-1] is Ellipsis:
                return slot_of(arguments[0])
            return slot_of(arguments[key]) if key < len(arguments) else None
        if isinstance(key, str) and get_origin(kind) is dict:
            return slot_of(arguments[1])
    return None


def default_at(slot: Slot | None) -> tuple[Any, ...]:
    """Return a field's default as plain data, () if it has none. A model's default has only the
    keys that are needed, so that a preset can fill in the others."""
    if slot is None or slot.field is None or slot.field.is_required():
        return ()
    default = slot.field.get_default(call_default_factory=True)
    if not isinstance(default, Config):
        return (json.loads(json.dumps(default)),)
    model = type(default)
    least = {}
    for name, field in model.model_fields.items():
        if len(choices_of(slot_of(field.annotation))) == 1:
            least[name] = getattr(default, name)
    least.update(default.model_dump(mode="json", exclude_defaults=True))
    is_enough = model.from_data(json.loads(json.dumps(least))) == default
    return (least if is_enough else default.to_data(),)


def get(data: Any, path: KeyPath) -> Any:
    """Return the value at a path, or None if there is none."""
    for key in path:
        data = child(data, key)
    return data


def child(data: Any, key: str | int) -> Any:
    """Return the value under a key or index, or None if there is none."""
    if isinstance(data, Mapping):
        return data.get(key)
    if isinstance(data, list) and isinstance(key, int) and 0 <= key < len(data):
        return data[key]
    return None


def choices_of(slot: Slot | None) -> tuple[Any, ...]:
    """Return the values of a Literal in this slot, or () if it is not a Literal."""
    choices: list[Any] = []
    branches = slot.branches if slot else ()
    for kind, _ in branches:
        if get_origin(kind) is Literal:
            choices.extend(get_args(kind))
    return tuple(choices)


def legal_at(slot: Slot | None) -> str | None:
    """Describe in words what a slot accepts: type, bounds, choices, and the field's description."""
    if slot is None:
        return None
    alternatives = dict.fromkeys(_words(kind, limits) for kind, limits in slot.branches)
    words = " or ".join(filter(None, alternatives))
    if not words:
        return None
    note = slot.field.description if slot.field else None
    return f"{words} ({note})" if note and len(note) <= LONGEST_NOTE else words


def _words(kind: Any, limits: Mapping[str, Any]) -> str:
    """Describe one alternative of a slot; empty if there is nothing to say."""
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin is Literal:
        lead = "one of " if len(arguments) > 1 else ""
        return lead + ", ".join(map(plain, arguments))
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return "a mapping with the keys " + ", ".join(kind.model_fields)
    if origin is dict:
        inner = legal_at(slot_of(arguments[1]))
        return f"a mapping of names to {inner}" if inner else "a mapping"
    if origin is tuple and arguments[-1] is not Ellipsis:
        items = [legal_at(slot_of(argument)) or "a value" for argument in arguments]
        return "a list of " + ", ".join(items)
    if origin in (tuple, list):
        return _words_of_list(legal_at(slot_of(arguments[0])), limits)
    if kind is str:
        return f"text that matches {limits['pattern']}" if "pattern" in limits else "text"
    return _words_of_number(kind, limits)


def _words_of_list(item: str | None, limits: Mapping[str, Any]) -> str:
    """Describe a list of any number of items within the limits."""
    fewest = limits.get("min_length")
    longest = limits.get("max_length")
    words = "a list"
    if fewest and longest:
        words += f" ({fewest} to {longest} items)"
    elif fewest:
        words += f" (at least {fewest} items)"
    elif longest:
        words += f" (at most {longest} items)"
    return f"{words}, each {item}" if item else words


def _words_of_number(kind: Any, limits: Mapping[str, Any]) -> str:
    """Describe a number with its bounds, a truth value or null; empty for any other type."""
    nouns = {int: "a whole number", float: "a number", bool: "true or false", NoneType: "null"}
    noun = nouns.get(kind, "")
    bounds = {}
    for name in BOUNDS:
        if name in limits:
            limit = limits[name]
            bounds[name] = f"{limit:g}" if isinstance(limit, float) else str(limit)
    if {"ge", "le"} <= bounds.keys():
        return f"{noun} from {bounds['ge']} to {bounds['le']}"
    bound_texts = [f"{BOUNDS[name]} {bound}" for name, bound in bounds.items()]
    return f"{noun} {' and '.join(bound_texts)}".strip()


def every_key(
    model: type[BaseModel], before: str = ""
) -> Iterator[tuple[str, Slot, type[BaseModel]]]:
    """Yield every key below a model: its path (items as ``key[]``, kinds as ``key[kind=name]``),
    its slot, and the model that declares it."""
    for name, field in model.model_fields.items():
        path = f"{before}{name}"
        slot = slot_of(field.annotation, field)
        yield path, slot, model
        for kind, _ in slot.branches:
            if get_origin(kind) in (tuple, list):
                path = f"{path}[]"
                slot = slot_of(get_args(kind)[0])
                break
        kinds = kinds_of(slot)
        if kinds is not None:
            tag_key, models_by_tag = kinds
            for tag, tagged_model in models_by_tag.items():
                yield from every_key(tagged_model, f"{path}[{tag_key}={tag}].")
        elif slot.models:
            yield from every_key(slot.models[0], f"{path}.")


def plain(value: Any) -> str:
    """Return a legal value as a user would write it."""
    return value if isinstance(value, str) else json.dumps(value)
