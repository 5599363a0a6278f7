"""YAML 1.2 as plain data that remembers the place of every key and value.

The parser is ruamel.yaml's; only its node tree is used, so that no tag can build an object, every duplicate key is
seen, and places come from the nodes. Not supported on purpose: merge keys (``<<``, no part of YAML 1.2), tags, several
documents, keys that are no text.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent, NodeEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from harness.vocabulary.declaration.problems import MAX_PROBLEMS, DeclarationError, Place, Problem

KeyPath = tuple[str | int, ...]
"""Where a value is in the data: keys of mappings and indices of lists."""

MAX_BYTES = 500_000
"""An experiment written by hand has a few kB; the parser needs up to 20 s for a megabyte."""
MAX_NODES = 50_000
"""Values as written, and after aliases are followed: what bounds an alias bomb."""
MAX_DEPTH = 40
"""Nesting; the schema needs 8."""

_TAG = "tag:yaml.org,2002:"
_OTHER_VERSION = re.compile(r"^%YAML[ \t]+(?!1\.2\b).*", re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """Plain data (dicts, lists, text, numbers, booleans, None) and the place of everything in it.

    ``values`` and ``keys`` map a `KeyPath` to the place of the value, respectively of its key.
    """

    origin: str
    text: str
    data: Any
    values: Mapping[KeyPath, Place]
    keys: Mapping[KeyPath, Place]

    def place_of(self, path: KeyPath) -> Place:
        """The place of a value; of the innermost enclosing value where it is not written (a default)."""
        return _innermost(self.values, path)

    def key_place_of(self, path: KeyPath) -> Place:
        """The place of a key; of the value where it has none (list items, the top level)."""
        return self.keys[path] if path in self.keys else _innermost({**self.values, **self.keys}, path)

    def with_value(self, path: KeyPath, data: Any, donor: Source, donor_path: KeyPath = ()) -> Source:
        """This source with ``data`` whose value at ``path`` came from ``donor`` at ``donor_path``, places and all."""
        values = {at: place for at, place in self.values.items() if at[: len(path)] != path}
        keys = {at: place for at, place in self.keys.items() if at[: len(path)] != path}
        depth = len(donor_path)
        values |= {path + at[depth:]: place for at, place in donor.values.items() if at[:depth] == donor_path}
        keys |= {path + at[depth:]: place for at, place in donor.keys.items() if at[:depth] == donor_path}
        keys[path] = donor.place_of(donor_path)
        return Source(self.origin, self.text, data, values, keys)


def read_yaml(path: Path) -> Source:
    """Read a file whose top level is a mapping. Raises DeclarationError with every problem of the text, and places."""
    origin = str(path)
    text = _decoded(origin, _bytes_of(Path(path)))
    source = parse_yaml(text, origin)
    if not isinstance(source.data, dict):
        kind = "is empty" if source.data is None else "does not hold a mapping at its top level"
        raise DeclarationError(
            origin, [Problem(f"the file {kind}", source.place_of(()), legal="keys and values, as in `name: thesis`")]
        )
    return source


def parse_yaml(text: str, origin: str, *, start: int = 0, is_argument: bool = False) -> Source:
    """Parse ``text[start:]``; places are those in the whole text. Raises DeclarationError.

    ``is_argument``: the text is an argument of the command line, so that places have no line number.
    """
    place = _places_in(text, origin, start, is_argument)
    version = _OTHER_VERSION.search(text)
    if version:
        raise DeclarationError(
            origin, [Problem("only YAML 1.2 is read", place(version.start() - start, version.end()))]
        )
    root = _composed(text[start:], origin, place)
    builder = _Builder(place)
    data = builder.build(root, (), ()) if root is not None else None
    if builder.problems:
        raise DeclarationError(origin, builder.problems)
    builder.values.setdefault((), place(0, 0))
    return Source(origin, text, data, builder.values, builder.keys)


def to_yaml(data: Any) -> str:
    """Plain data as YAML 1.2, in its own order of keys; `parse_yaml` inverts it."""
    from io import StringIO

    writer = YAML()
    writer.default_flow_style = False
    writer.width = 120
    stream = StringIO()
    writer.dump(data, stream)
    return stream.getvalue()


def _innermost(places: Mapping[KeyPath, Place], path: KeyPath) -> Place:
    while path and path not in places:
        path = path[:-1]
    return places[path]


def _bytes_of(path: Path) -> bytes:
    origin = str(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        found = sorted(str(near) for near in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
        beside = ", ".join(found[:10]) or None
        raise DeclarationError(origin, [Problem("there is no such file", None, legal=beside)]) from None
    except IsADirectoryError:
        raise DeclarationError(origin, [Problem("this is a folder, not a YAML file", None)]) from None
    except OSError as error:
        raise DeclarationError(origin, [Problem(f"cannot be read ({error.strerror})", None)]) from error
    if len(content) > MAX_BYTES:
        raise DeclarationError(
            origin, [Problem("the file is too large for a declaration", None, legal=f"at most {MAX_BYTES} bytes")]
        )
    return content


def _decoded(origin: str, content: bytes) -> str:
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        before = content[: error.start].decode("utf-8", errors="replace")
        rest = content[error.start :].split(b"\n")[0].decode("utf-8", errors="replace")
        line_start = before.rfind("\n") + 1
        where = Place(origin, before.count("\n") + 1, len(before) - line_start + 1, before[line_start:] + rest)
        problem = Problem(f"byte 0x{content[error.start]:02x} is not UTF-8", where, fix="save the file as UTF-8")
        raise DeclarationError(origin, [problem]) from None


def _places_in(text: str, origin: str, start: int, is_argument: bool) -> Callable[[int, int], Place]:
    """A function from (index, end index) after ``start`` to the place."""
    line_starts = [0, *(match.end() for match in re.finditer("\n", text))]
    lines: dict[int, str] = {}
    """Each line once: its places share it, however many they are and however long it is."""

    def place(index: int, end: int) -> Place:
        index, end = min(index + start, len(text)), end + start
        line = bisect_right(line_starts, index) - 1
        first = line_starts[line]
        line_text = lines.get(line)
        if line_text is None:
            line_end = text.find("\n", first)
            line_text = lines[line] = text[first:] if line_end < 0 else text[first:line_end]
        width = max(1, min(end, first + len(line_text)) - index)
        return Place(origin, 0 if is_argument else line + 1, index - first + 1, line_text, width)

    return place


def _composed(text: str, origin: str, place: Callable[[int, int], Place]) -> Node | None:
    """ruamel.yaml's node tree; its errors become a problem with a place."""
    try:
        too_much = _first_too_much(text)
        if too_much is None:
            return YAML(typ="safe", pure=True).compose(text)
        index, what, legal = too_much
        problem = Problem(what, place(index, index + 1), legal=legal)
    except MarkedYAMLError as error:
        mark, context = error.problem_mark or error.context_mark, error.context_mark
        where = place(mark.index, mark.index + 1) if mark else None
        begun = place(context.index, context.index + 1) if context and mark and context.index != mark.index else None
        what = " ".join(filter(None, [error.context, error.problem])).replace("\n", " ")
        problem = Problem(f"no valid YAML: {what}", where, other=begun, other_says="begun at")
    except ReaderError as error:
        index = int(error.position)
        problem = Problem(f"character U+{ord(text[index]):04X} is not allowed in YAML", place(index, index + 1))
    except YAMLError as error:
        problem = Problem(f"no valid YAML: {error}", place(0, 1))
    raise DeclarationError(origin, [problem]) from None


def _first_too_much(text: str) -> tuple[int, str, str] | None:
    """The index of the first mapping or list beyond `MAX_DEPTH`, or of the first value beyond `MAX_NODES`, with what it
    is and what is legal: composing recurses, scanning slows with depth, and nodes take memory."""
    depth, nodes = 0, 0
    for event in YAML(typ="safe", pure=True).parse(text):
        depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
        nodes += isinstance(event, NodeEvent)
        if depth > MAX_DEPTH:
            return int(event.start_mark.index), "nested too deep", f"at most {MAX_DEPTH} levels"
        if nodes > 2 * MAX_NODES:  # keys are nodes, too
            return int(event.start_mark.index), "too many values", f"at most {MAX_NODES} values"
    return None


@dataclass
class _Builder:
    """Turns nodes into plain data, noting places and problems on the way."""

    place: Callable[[int, int], Place]
    values: dict[KeyPath, Place] = field(default_factory=dict)
    keys: dict[KeyPath, Place] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)
    nodes: int = 0

    def build(self, node: Node, path: KeyPath, within: tuple[Node, ...]) -> Any:
        self.values[path] = here = self._place(node)
        self.nodes += 1
        if len(self.problems) >= MAX_PROBLEMS:
            return None
        if self.nodes > MAX_NODES:
            if self.nodes == MAX_NODES + 1:
                self._problem("too many values", here, f"at most {MAX_NODES} values, aliases followed")
            return None
        if any(node is outer for outer in within):
            return self._problem("an alias within its own anchor", here)
        if len(within) >= MAX_DEPTH:
            return self._problem("nested too deep", here, f"at most {MAX_DEPTH} levels")
        if isinstance(node, MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node, path, (*within, node))
        if isinstance(node, SequenceNode) and node.tag == _TAG + "seq":
            return [self.build(item, (*path, index), (*within, node)) for index, item in enumerate(node.value)]
        if isinstance(node, ScalarNode):
            return self._scalar(node, here)
        return self._problem(f"the tag {_short(node.tag)} is not read", here, "plain mappings, lists, text and numbers")

    def _mapping(self, node: MappingNode, path: KeyPath, within: tuple[Node, ...]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if len(self.problems) >= MAX_PROBLEMS:
                break
            at = self._place(key_node)
            key = self._key(key_node, at)
            if key is None:
                continue
            if key in result:
                first = self.keys[(*path, key)]
                self.problems.append(
                    Problem(f"duplicate key `{key}`", at, other=first, other_says="already written at", fix="keep one")
                )
                continue
            self.keys[(*path, key)] = at
            result[key] = self.build(value_node, (*path, key), within)
        return result

    def _key(self, node: Node, at: Place) -> str | None:
        if node.tag == _TAG + "merge":
            fix = "write the keys out, or an alias for a whole value"
            self.problems.append(Problem("merge keys (`<<`) are not part of YAML 1.2", at, fix=fix))
            return None
        key = self._scalar(node, at) if isinstance(node, ScalarNode) else None
        if not isinstance(key, str):
            if not self.problems or self.problems[-1].place != at:
                self.problems.append(Problem("a key must be text", at, legal="text; put quotes around numbers"))
            return None
        return key

    def _scalar(self, node: ScalarNode, here: Place) -> Any:
        kind, text = str(node.tag).removeprefix(_TAG), node.value
        try:
            if kind == "null":
                return None
            if kind == "bool":
                return {"true": True, "false": False}[text.lower()]
            if kind == "int":
                return int(_plain_number(text), 0) if re.match(r"[-+]?0[ox]", text) else int(_plain_number(text))
            if kind == "float":
                return float(_plain_number(text).replace(".inf", "inf").replace(".nan", "nan"))
            if kind in ("str", "timestamp"):  # YAML 1.2 has no dates: they are text
                text.encode()
                return text
        except (ValueError, KeyError):
            return self._problem(f"{text[:40]!r} cannot be read as {kind}", here)
        return self._problem(f"the tag {_short(node.tag)} is not read", here, "plain mappings, lists, text and numbers")

    def _problem(self, message: str, place: Place, legal: str | None = None) -> None:
        self.problems.append(Problem(message, place, legal=legal))

    def _place(self, node: Node) -> Place:
        return self.place(node.start_mark.index, node.end_mark.index)


def _plain_number(text: str) -> str:
    return text.lower().replace("_", "")


def _short(tag: str | None) -> str:
    return str(tag).replace(_TAG, "!!")
