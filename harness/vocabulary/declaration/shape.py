"""The shape that a declaration's models give to data: which keys are legal where, and what a place accepts.

It is read from the JSON schema that pydantic makes of a model, with every reference filled in. A *splice* puts a model
where another holds free data (the settings of a detector chosen by name).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaWarningKind, NoDefault

from harness.vocabulary.config import Config
from harness.vocabulary.declaration.yaml_source import KeyPath

LONGEST_NOTE = 100
"""Characters of a field's description that a message repeats; longer ones are essays, not limits."""

Schema = Mapping[str, Any]
"""A JSON schema without references; empty where anything is legal."""
Splices = Mapping[KeyPath, type[Config]]


@dataclass(frozen=True)
class Declared:
    """A model, the data that is meant to fill it, and the models that belong in its free data."""

    model: type[BaseModel]
    data: Any
    splices: Splices

    def at(self, path: KeyPath) -> Schema | None:
        """The schema of what belongs at ``path``; None where some key on the way is unknown."""
        schema: Schema | None = schema_of(self.model)
        data = self.data
        for depth in range(len(path) + 1):
            schema = schema_of(self.splices[path[:depth]]) if path[:depth] in self.splices else schema
            if depth == len(path) or schema is None:
                return schema
            schema, data = _below(schema, data, path[depth]), child(data, path[depth])
        return schema

    def names(self, path: KeyPath) -> tuple[str, ...]:
        """The legal keys of the mapping at ``path``: its model's fields, or the keys that free data has."""
        schema, data = self.at(path), get(self.data, path)
        model = object_for(schema, data) if schema is not None else None
        return tuple(model["properties"] if model else data if isinstance(data, Mapping) else ())

    def paths(self, path: KeyPath = (), depth: int = 8) -> Iterator[KeyPath]:
        """Every path that can be set: fields of models to ``depth`` levels, list items as the data has them."""
        data = get(self.data, path)
        for key in (range(len(data)) if isinstance(data, list) else self.names(path)) if depth else ():
            yield (*path, key)
            yield from self.paths((*path, key), depth - 1)


DeclaredOf = Callable[[Any], Declared]
"""Function from data to what is declared for it (which detector's settings belong in it depends on the data)."""


class _Generator(GenerateJsonSchema):
    """pydantic's generator, but with defaults of factories, with defaults of models in the fewest keys that mean the
    same (so that what a preset fills in is left to it), and with an empty schema for a type that has none."""

    ignored_warning_kinds: set[JsonSchemaWarningKind] = {  # noqa: RUF012 (declared so by the base class)
        "skipped-choice",
        "non-serializable-default",
    }

    def sort(self, value: Any, parent_key: str | None = None) -> Any:
        return value  # kinds stay in the order in which they are declared

    def handle_invalid_for_json_schema(self, schema: Any, error_info: str) -> dict[str, Any]:
        return {}

    def get_default_value(self, schema: Any) -> Any:
        factory = None if schema.get("default_factory_takes_data") else schema.get("default_factory")
        return factory() if factory else schema.get("default", NoDefault)

    def encode_default(self, dft: Any) -> Any:
        if not isinstance(dft, BaseModel):
            return super().encode_default(dft)
        constant = {
            name: getattr(dft, name)
            for name, field in type(dft).model_fields.items()
            if get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1
        }
        least = {**constant, **dft.model_dump(mode="json", exclude_defaults=True)}
        try:
            same = type(dft).model_validate(json.loads(json.dumps(least))) == dft
        except ValidationError:
            same = False
        return least if same else dft.model_dump(mode="json")


@lru_cache(maxsize=200)
def schema_of(model: type[BaseModel]) -> Schema:
    """The JSON schema of a model with references filled in; a model within itself is free data there.

    ``discriminator.mapping`` holds the schema of each tag. ``description`` is a field's own, never a docstring.
    """
    whole = model.model_json_schema(schema_generator=_Generator)
    definitions = whole.pop("$defs", {})

    def filled(part: Any, within: tuple[str, ...]) -> Any:
        if isinstance(part, list):
            return [filled(item, within) for item in part]
        if not isinstance(part, dict):
            return part
        name = part.get("$ref", "").rsplit("/", 1)[-1] if isinstance(part.get("$ref", ""), str) else ""
        if not name:
            return {key: filled(value, within) for key, value in part.items()}
        target = {} if name in within else filled(definitions[name], (*within, name))
        own = {key: filled(value, within) for key, value in part.items() if key != "$ref"}
        return {**{key: value for key, value in target.items() if key != "description"}, **own}

    def with_tags(part: Any) -> Any:
        if (
            isinstance(part, dict)
            and isinstance(part.get("discriminator"), dict)
            and "mapping" in part["discriminator"]
        ):
            tags = {tag: {"$ref": ref} for tag, ref in part["discriminator"]["mapping"].items()}
            part = {**part, "discriminator": {**part["discriminator"], "mapping": tags}}
        if isinstance(part, dict):
            return {key: with_tags(value) for key, value in part.items()}
        return [with_tags(item) for item in part] if isinstance(part, list) else part

    definitions = {name: with_tags(part) for name, part in definitions.items()}
    return dict(filled(with_tags(whole), ()))


def branches(schema: Schema) -> tuple[Schema, ...]:
    """The alternatives of a union but null; the schema itself where it is no union."""
    members = schema.get("anyOf") or schema.get("oneOf")
    if members is None:
        return () if schema.get("type") == "null" else (schema,)
    return tuple(branch for member in members for branch in branches(member))


def kinds_of(schema: Schema) -> tuple[str, Mapping[str, Schema]] | None:
    """The key that tells the kinds of a mapping apart and the schema of each; None where there is no such key."""
    for part in (schema, *schema.get("anyOf", ())):
        if "discriminator" in part:
            return part["discriminator"]["propertyName"], part["discriminator"]["mapping"]
    return None


def object_for(schema: Schema, data: Any) -> Schema | None:
    """The model that a mapping at this place is meant to fill: by its kind, else by most keys in common.

    Most keys in common decide too where the kind is not legal, which is a problem of its own.
    """
    keys = set(data) if isinstance(data, Mapping) else set()
    kinds = kinds_of(schema)
    if kinds and isinstance(data, Mapping) and str(data.get(kinds[0])) in kinds[1]:
        return kinds[1][str(data[kinds[0]])]
    models = [branch for branch in branches(schema) if "properties" in branch]
    return max(models, key=lambda model: len(keys & set(model["properties"])), default=None)


def _below(schema: Schema, data: Any, key: str | int) -> Schema | None:
    """The schema one key (or index) deeper, given the data here; None where the key is unknown there."""
    model = object_for(schema, data)
    if model is not None and isinstance(key, str):
        return model["properties"].get(key)
    for branch in branches(schema):
        kind = branch.get("type")
        if isinstance(key, int) and kind == "array":
            items = branch.get("prefixItems")
            return branch.get("items", {}) if items is None else items[key] if key < len(items) else None
        if isinstance(key, str) and kind == "object":
            by_pattern: Any = next(iter(branch.get("patternProperties", {}).values()), {})
            values: Any = branch.get("additionalProperties") or by_pattern
            return values if isinstance(values, Mapping) else {}
        if isinstance(key, str) and not {"type", "enum", "const"} & set(branch):
            return {}
    return None


def get(data: Any, path: KeyPath) -> Any:
    """The value at a path, None where there is none."""
    for key in path:
        data = child(data, key)
    return data


def child(data: Any, key: str | int) -> Any:
    """The value under a key or index, None where there is none."""
    if isinstance(data, Mapping):
        return data.get(key)
    if isinstance(data, list) and isinstance(key, int) and 0 <= key < len(data):
        return data[key]
    return None


def choices_of(schema: Schema | None) -> tuple[Any, ...]:
    """The values of an enumeration or Literal at this place, () where it is neither."""
    found = [one.get("enum", [one["const"]] if "const" in one else []) for one in branches(schema or {})]
    return tuple(value for values in found for value in values)


def legal_at(schema: Schema | None) -> str | None:
    """Say in words what a place accepts: type, bounds, choices, and what the field's description says of it."""
    words, note = _words(schema or {}), (schema or {}).get("description", "")
    return f"{words} ({note})" if words and 0 < len(note) <= LONGEST_NOTE else words or None


def _words(schema: Schema) -> str:
    for union in ("anyOf", "oneOf", "allOf"):
        if union in schema:
            return " or ".join(filter(None, dict.fromkeys(map(_words, schema[union]))))
    if "enum" in schema:
        return "one of " + ", ".join(map(plain, schema["enum"]))
    if "const" in schema:
        return plain(schema["const"])
    kind = schema.get("type")
    if kind == "object":
        if "properties" in schema:
            return "a mapping with the keys " + ", ".join(schema["properties"])
        values = schema.get("additionalProperties")
        inner = _words(values) if isinstance(values, Mapping) else ""
        return f"a mapping of names to {inner}" if inner else "a mapping"
    if kind == "array":
        if "prefixItems" in schema:
            return "a list of " + ", ".join(_words(item) or "a value" for item in schema["prefixItems"])
        least, most = schema.get("minItems"), schema.get("maxItems")
        counts = {(True, True): f" ({least} to {most} items)", (True, False): f" (at least {least} items)"}
        count = counts.get((bool(least), bool(most)), f" (at most {most} items)" if most else "")
        inner = _words(schema.get("items", {}))
        return f"a list{count}" + (f", each {inner}" if inner else "")
    if kind == "string":
        return f"text that matches {schema['pattern']}" if "pattern" in schema else "text"
    numbers = {"integer": "a whole number", "number": "a number", "boolean": "true or false", "null": "null"}
    if kind not in numbers:
        return ""
    bounds = {
        word: f"{schema[key]:g}" if isinstance(schema[key], float) else str(schema[key])
        for key, word in (
            ("minimum", "at least"),
            ("exclusiveMinimum", "above"),
            ("maximum", "at most"),
            ("exclusiveMaximum", "below"),
        )
        if key in schema
    }
    if {"at least", "at most"} <= set(bounds):
        return f"{numbers[kind]} from {bounds['at least']} to {bounds['at most']}"
    return " ".join([numbers[kind], " and ".join(f"{word} {bound}" for word, bound in bounds.items())]).strip()


def plain(value: Any) -> str:
    """A legal value as a user writes it."""
    return value if isinstance(value, str) else json.dumps(value)


def landing(data: Any, location: Sequence[str | int], missing: bool) -> tuple[KeyPath, tuple[KeyPath, str] | None]:
    """The path in the data of pydantic's error location, which mixes keys of the data with labels of union branches,
    and the first such label with the path where it stands. ``missing``: the last key is not in the data."""
    path: KeyPath = ()
    label: tuple[KeyPath, str] | None = None
    for number, key in enumerate(location):
        known = key in data if isinstance(data, Mapping) else isinstance(data, list) and key in range(len(data))
        if known or (missing and number == len(location) - 1):
            path, data = (*path, key), child(data, key)
        else:
            label = label or (path, str(key))
    return path, label
