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
    """A place for data: the alternatives of its type, each with its constraints, and its field."""

    branches: tuple[tuple[Any, Mapping[str, Any]], ...]
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
    """A model, the data that is meant to fill it, and the models that belong in its free data."""

    model: type[BaseModel]
    data: Any
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
        return tuple(model.model_fields if model else data if isinstance(data, Mapping) else ())

    def paths(self, path: KeyPath = (), depth: int = 8) -> Iterator[KeyPath]:
        """Yield every path that can be set: model fields down to ``depth`` levels, and the list
        items in the data."""
        data = get(self.data, path)
        for key in (
            (range(len(data)) if isinstance(data, list) else self.names(path)) if depth else ()
        ):
            yield (*path, key)
            yield from self.paths((*path, key), depth - 1)


DeclaredOf = Callable[[Any], Declared]
"""A function that returns what is declared for given data; the data decides which detector's
settings belong in it."""


def slot_of(annotation: Any, field: FieldInfo | None = None) -> Slot:
    """Return the slot for an annotation, or for a field with this annotation."""
    return Slot(tuple(_branches(annotation, tuple(field.metadata) if field else ())), field)


def _branches(
    annotation: Any, metadata: tuple[Any, ...]
) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    if get_origin(annotation) is Annotated:
        inner, *further_arguments = get_args(annotation)
        yield from _branches(
            inner,
            (*metadata, *(m for x in further_arguments for m in getattr(x, "metadata", (x,)))),
        )
    elif get_origin(annotation) in (Union, UnionType):
        for member in get_args(annotation):
            yield from _branches(member, metadata)
    else:
        names = (*BOUNDS, "min_length", "max_length", "pattern")
        yield (
            annotation,
            {n: v for m in metadata for n in names if (v := getattr(m, n, None)) is not None},
        )


def kinds_of(slot: Slot | None) -> tuple[str, Mapping[str, type[BaseModel]]] | None:
    """Return the key that distinguishes the models of a slot, and the model for each value; None
    without such a key."""
    return _kinds(slot.models) if slot else None


@lru_cache(maxsize=1000)
def _kinds(models: tuple[type[BaseModel], ...]) -> tuple[str, Mapping[str, type[BaseModel]]] | None:
    for key in models[0].model_fields if len(models) > 1 else ():
        fields = [model.model_fields.get(key) for model in models]
        tags = [
            get_args(f.annotation) if f and get_origin(f.annotation) is Literal else ()
            for f in fields
        ]
        models_by_tag = {
            str(tag): model
            for model, model_tags in zip(models, tags, strict=True)
            for tag in model_tags
        }
        if all(tags) and len(models_by_tag) == sum(map(len, tags)):
            return key, models_by_tag
    return None


def model_for(slot: Slot | None, data: Any) -> type[BaseModel] | None:
    """Return the model that a mapping is meant to fill: by its kind, or else the model with most
    keys in common."""
    kinds = kinds_of(slot)
    values = data if isinstance(data, Mapping) else {}
    if kinds and str(values.get(kinds[0])) in kinds[1]:
        return kinds[1][str(values[kinds[0]])]
    return max(
        slot.models if slot else (),
        key=lambda m: len(values.keys() & m.model_fields.keys()),
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
            is_list = get_origin(kind) is list or arguments[-1] is Ellipsis
            return (
                slot_of(arguments[0 if is_list else key])
                if is_list or key < len(arguments)
                else None
            )
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
    fields = type(default).model_fields
    constant = {
        n: getattr(default, n)
        for n, f in fields.items()
        if len(choices_of(slot_of(f.annotation))) == 1
    }
    least = {**constant, **default.model_dump(mode="json", exclude_defaults=True)}
    return (
        least
        if type(default).from_data(json.loads(json.dumps(least))) == default
        else default.to_data(),
    )


def get(data: Any, path: KeyPath) -> Any:
    """Return the value at a path, or None if there is none."""
    for key in path:
        data = child(data, key)
    return data


def child(data: Any, key: str | int) -> Any:
    """Return the value under a key or index, or None if there is none."""
    if isinstance(data, Mapping):
        return data.get(key)
    return (
        data[key]
        if isinstance(data, list) and isinstance(key, int) and 0 <= key < len(data)
        else None
    )


def choices_of(slot: Slot | None) -> tuple[Any, ...]:
    """Return the values of a Literal in this slot, or () if it is not a Literal."""
    branches = slot.branches if slot else ()
    return tuple(v for kind, _ in branches if get_origin(kind) is Literal for v in get_args(kind))


def legal_at(slot: Slot | None) -> str | None:
    """Describe in words what a slot accepts: type, bounds, choices, and the field's description."""
    if slot is None:
        return None
    words = " or ".join(
        filter(None, dict.fromkeys(_words(kind, limits) for kind, limits in slot.branches))
    )
    note = (slot.field.description if slot.field else None) or ""
    return f"{words} ({note})" if words and 0 < len(note) <= LONGEST_NOTE else words or None


def _words(kind: Any, limits: Mapping[str, Any]) -> str:
    origin = get_origin(kind)
    arguments = get_args(kind)
    if origin is Literal:
        return ("one of " if len(arguments) > 1 else "") + ", ".join(map(plain, arguments))
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return "a mapping with the keys " + ", ".join(kind.model_fields)
    if origin is dict:
        inner = legal_at(slot_of(arguments[1]))
        return f"a mapping of names to {inner}" if inner else "a mapping"
    if origin is tuple and arguments[-1] is not Ellipsis:
        return "a list of " + ", ".join(
            legal_at(slot_of(argument)) or "a value" for argument in arguments
        )
    if origin in (tuple, list):
        least = limits.get("min_length")
        longest = limits.get("max_length")
        inner = legal_at(slot_of(arguments[0]))
        count = (
            f"at most {longest}"
            if not least
            else f"{least} to {longest}"
            if longest
            else f"at least {least}"
        )
        return (
            "a list"
            + (f" ({count} items)" if least or longest else "")
            + (f", each {inner}" if inner else "")
        )
    if kind is str:
        return f"text that matches {limits['pattern']}" if "pattern" in limits else "text"
    words = {int: "a whole number", float: "a number", bool: "true or false", NoneType: "null"}.get(
        kind, ""
    )
    bounds = {
        n: f"{limits[n]:g}" if isinstance(limits[n], float) else str(limits[n])
        for n in BOUNDS
        if n in limits
    }
    if {"ge", "le"} <= bounds.keys():
        return f"{words} from {bounds['ge']} to {bounds['le']}"
    bound_texts = [f"{BOUNDS[name]} {bound}" for name, bound in bounds.items()]
    return f"{words} {' and '.join(bound_texts)}".strip()


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
            for kind, chosen in kinds[1].items():
                yield from every_key(chosen, f"{path}[{kinds[0]}={kind}].")
        elif slot.models:
            yield from every_key(slot.models[0], f"{path}.")


def plain(value: Any) -> str:
    """Return a legal value as a user would write it."""
    return value if isinstance(value, str) else json.dumps(value)
