"""The shape that a declaration's models give to data: which keys are legal where, and what a place accepts.

Walks the type annotations of pydantic models: nested models, lists, tuples, mappings, unions with and without a
discriminator. A *splice* puts a model where another holds free data (the settings of a detector chosen by name).
"""

from __future__ import annotations

import json
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, Discriminator, Tag, TypeAdapter
from pydantic.errors import PydanticSchemaGenerationError, PydanticUserError
from pydantic.fields import FieldInfo

from harness.vocabulary.config import Config
from harness.vocabulary.declaration.yaml_source import KeyPath

LONGEST_NOTE = 100
"""Characters of a field's description that a message repeats; longer ones are essays, not limits."""

Splices = Mapping[KeyPath, type[Config]]


@dataclass(frozen=True)
class UnionChoice:
    """A union without a discriminator that an error passed, and the branch that it belongs to."""

    path: KeyPath
    label: str


@dataclass(frozen=True)
class Landing:
    """Where an error's location leads: the path in the data and the unions passed."""

    path: KeyPath
    unions: tuple[UnionChoice, ...]


@dataclass(frozen=True)
class Declared:
    """A model, the data that is meant to fill it, and the models that belong in its free data."""

    model: type[BaseModel]
    data: Any
    splices: Splices

    def at(self, path: KeyPath) -> Any:
        """What is declared at ``path``; None where some key on the way is unknown."""
        return at(self.model, self.data, path, self.splices)

    def names(self, path: KeyPath) -> tuple[str, ...]:
        """The legal keys of the mapping at ``path``."""
        return names_at(self.at(path), get(self.data, path))

    def paths(self) -> Iterator[KeyPath]:
        """Every path that can be set."""
        return all_paths(self.model, self.data, self.splices)


DeclaredOf = Callable[[Any], Declared]
"""From data to what is declared for it (which detector's settings belong in it depends on the data)."""


def bare(annotation: Any) -> tuple[Any, str | None]:
    """An annotation without ``Annotated``, and the key that discriminates its union, if any."""
    discriminator: str | None = None
    while get_origin(annotation) is Annotated:
        annotation, *extras = get_args(annotation)
        for extra in extras:
            found = extra.discriminator if isinstance(extra, FieldInfo | Discriminator) else None
            found = found.discriminator if isinstance(found, Discriminator) else found
            discriminator = found if isinstance(found, str) else discriminator
    return annotation, discriminator


def branches(annotation: Any) -> tuple[Any, ...]:
    """The members of a union but None; the annotation itself where it is no union."""
    core, _ = bare(annotation)
    if get_origin(core) in (Union, types.UnionType):
        return tuple(member for member in get_args(core) if member is not type(None))
    return (annotation,)


def fields_of(model: type[BaseModel]) -> dict[str, Any]:
    """The annotation of every field with all that its FieldInfo says."""
    return {name: Annotated[field.annotation, field] for name, field in model.model_fields.items()}


def tags_of(branch: Any, discriminator: str) -> tuple[str, ...]:
    """The values of ``discriminator`` that choose this branch of a union."""
    core, _ = bare(branch)
    tagged = tuple(extra.tag for extra in get_args(branch)[1:] if isinstance(extra, Tag))
    if tagged or not _is_model(core):
        return tagged
    literal, _ = bare(core.model_fields[discriminator].annotation)
    return tuple(map(str, get_args(literal))) if get_origin(literal) is Literal else ()


def model_for(annotation: Any, data: Any) -> type[BaseModel] | None:
    """The model that a mapping at this place is meant to fill: by its discriminator, else by most keys in common.

    Most keys in common decide too where the discriminator's value is not legal, which is a problem of its own.
    """
    _, discriminator = bare(annotation)
    models = [core for core, _ in map(bare, branches(annotation)) if _is_model(core)]
    if not models:
        return None
    keys = set(data) if isinstance(data, Mapping) else set()
    if discriminator:
        tag = data.get(discriminator) if isinstance(data, Mapping) else None
        models = [model for model in models if str(tag) in tags_of(model, discriminator)] or models
    return max(models, key=lambda model: len(keys & set(model.model_fields)))


def step(annotation: Any, data: Any, key: str | int) -> Any:
    """What is declared one key (or index) deeper, given the data here; None where the key is unknown there."""
    model = model_for(annotation, data)
    if model is not None and isinstance(key, str):
        return fields_of(model).get(key)
    for branch in branches(annotation):
        core, _ = bare(branch)
        origin, args = get_origin(core), get_args(core)
        if isinstance(key, int) and origin is tuple and args:
            return args[0] if args[-1] is Ellipsis else args[key] if key < len(args) else None
        if isinstance(key, int) and isinstance(origin, type) and issubclass(origin, Sequence | set | frozenset):
            return args[0]
        if isinstance(key, str) and isinstance(origin, type) and issubclass(origin, Mapping):
            return args[1]
        if isinstance(key, str) and core in (dict, Any):
            return Any
    return None


def at(annotation: Any, data: Any, path: KeyPath, splices: Splices) -> Any:
    """What is declared at ``path``; None where some key on the way is unknown."""
    for depth in range(len(path) + 1):
        annotation = splices.get(path[:depth], annotation)
        if depth == len(path) or annotation is None:
            return annotation
        annotation = step(annotation, data, path[depth])
        data = child(data, path[depth])
    return annotation


def names_at(annotation: Any, data: Any) -> tuple[str, ...]:
    """The legal keys of a mapping at this place: its model's fields, or the keys that free data has."""
    model = model_for(annotation, data)
    if model is not None:
        return tuple(model.model_fields)
    return tuple(data) if isinstance(data, Mapping) else ()


def all_paths(annotation: Any, data: Any, splices: Splices, path: KeyPath = (), depth: int = 8) -> Iterator[KeyPath]:
    """Every path that can be set: fields of models to ``depth`` levels, list items as the data has them."""
    annotation = splices.get(path, annotation)
    if depth == 0:
        return
    keys: Sequence[str | int] = names_at(annotation, data)
    if isinstance(data, list):
        keys = range(len(data))
    for key in keys:
        below = step(annotation, data, key)
        yield (*path, key)
        yield from all_paths(below, child(data, key), splices, (*path, key), depth - 1)


def land(declared: Declared, loc: Sequence[str | int]) -> Landing:
    """Follow pydantic's error location, which mixes keys of the data with labels of union branches."""
    annotation: Any = declared.model
    data, rest = declared.data, list(loc)
    path: KeyPath = ()
    unions: list[UnionChoice] = []
    while rest:
        annotation = declared.splices.get(path, annotation)
        members = branches(annotation)
        if len(members) > 1:
            label = str(rest.pop(0))
            _, discriminator = bare(annotation)
            if discriminator is None:
                unions.append(UnionChoice(path, label))
            annotation = next((one for one in members if label in _labels(one, discriminator)), None)
            continue
        key = rest.pop(0)
        below = step(annotation, data, key) if annotation is not None else None
        if below is None and not _has(data, key):
            continue  # the label of a wrapping validator, no key of the data
        annotation, data, path = below, child(data, key), (*path, key)
    return Landing(path, tuple(unions))


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


def _has(data: Any, key: str | int) -> bool:
    """Whether a mapping has the key, or a list the index."""
    return key in data if isinstance(data, Mapping) else isinstance(data, list) and key in range(len(data))


def choices_of(annotation: Any) -> tuple[Any, ...]:
    """The values of an enumeration or Literal at this place, () where it is neither."""
    schema = json_schema_of(annotation)
    found: list[Any] = []
    for option in (schema, *schema.get("anyOf", ())):
        option = _dereferenced(option, schema)
        found += option["enum"] if "enum" in option else [option["const"]] if "const" in option else []
    return tuple(found)


def legal_at(annotation: Any) -> str | None:
    """In words, what a place accepts: type, bounds, choices, and what the field's description says of it."""
    if annotation is None:
        return None
    schema = json_schema_of(annotation)
    words = _words(schema, schema)
    note = schema.get("description", "") if get_origin(annotation) is Annotated else ""
    return f"{words} ({note})" if words and 0 < len(note) <= LONGEST_NOTE else words or None


def json_schema_of(annotation: Any) -> dict[str, Any]:
    """The JSON schema of an annotation, {} where it has none."""
    try:
        return TypeAdapter(annotation).json_schema()
    except (PydanticSchemaGenerationError, PydanticUserError):
        return {}


def _is_model(core: Any) -> bool:
    return isinstance(core, type) and issubclass(core, BaseModel)


def _labels(branch: Any, discriminator: str | None) -> tuple[str, ...]:
    """What pydantic calls a branch of a union in an error's location."""
    if discriminator is not None:
        return tags_of(branch, discriminator)
    core, _ = bare(branch)
    name = core.__name__ if isinstance(core, type) and get_origin(core) is None else str(core)
    origin = get_origin(core)
    listed = f"{origin.__name__}[" if isinstance(origin, type) else ""
    return (name, f"constrained-{name}", listed)


def _dereferenced(schema: Mapping[str, Any], root: Mapping[str, Any]) -> Mapping[str, Any]:
    if "$ref" in schema:
        return root.get("$defs", {}).get(schema["$ref"].rsplit("/", 1)[-1], {})
    return schema


def _words(schema: Mapping[str, Any], root: Mapping[str, Any]) -> str:
    schema = _dereferenced(schema, root)
    for union in ("anyOf", "oneOf", "allOf"):
        if union in schema:
            return " or ".join(filter(None, dict.fromkeys(_words(one, root) for one in schema[union])))
    if "enum" in schema:
        return "one of " + ", ".join(map(_plain, schema["enum"]))
    if "const" in schema:
        return _plain(schema["const"])
    kind = schema.get("type")
    if kind == "object":
        return _object_words(schema, root)
    if kind == "array":
        return _array_words(schema, root)
    if kind == "string":
        pattern = f" that matches {schema['pattern']}" if "pattern" in schema else ""
        return f"text{pattern}"
    words = {"integer": "a whole number", "number": "a number", "boolean": "true or false", "null": "null"}
    return words[kind] + _bounds(schema) if kind in words else ""


def _object_words(schema: Mapping[str, Any], root: Mapping[str, Any]) -> str:
    if "properties" in schema:
        return "a mapping with the keys " + ", ".join(schema["properties"])
    values = schema.get("additionalProperties")
    inner = _words(values, root) if isinstance(values, Mapping) else ""
    return f"a mapping of names to {inner}" if inner else "a mapping"


def _array_words(schema: Mapping[str, Any], root: Mapping[str, Any]) -> str:
    if "prefixItems" in schema:
        return "a list of " + ", ".join(_words(item, root) or "a value" for item in schema["prefixItems"])
    least, most = schema.get("minItems"), schema.get("maxItems")
    count = f" ({least} to {most} items)" if least and most else f" (at least {least} items)" if least else ""
    count = f" (at most {most} items)" if most and not least else count
    inner = _words(schema.get("items", {}), root)
    return f"a list{count}" + (f", each {inner}" if inner else "")


def _bounds(schema: Mapping[str, Any]) -> str:
    least, above, most, below = (
        f"{schema[key]:g}" if isinstance(schema.get(key), float) else str(schema[key]) if key in schema else None
        for key in ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum")
    )
    if least and most:
        return f" from {least} to {most}"
    low = f"at least {least}" if least else f"above {above}" if above else ""
    high = f"at most {most}" if most else f"below {below}" if below else ""
    return " " + " and ".join(filter(None, [low, high])) if low or high else ""


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
