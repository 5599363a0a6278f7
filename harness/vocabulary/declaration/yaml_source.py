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
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent, NodeEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.reader import ReaderError

from harness.vocabulary.declaration.problems import MAX_PROBLEMS, DeclarationError, Place, Problem

KeyPath = tuple[str | int, ...]
"""Position of a value in the data: keys of mappings and indices of lists."""

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
    path, origin = Path(path), str(path)

    def refused(
        message: str, place: Place | None = None, legal: str | None = None, fix: str | None = None
    ) -> DeclarationError:
        return DeclarationError(origin, [Problem(message, place, legal=legal, fix=fix)])

    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
    except FileNotFoundError:
        found = sorted(str(near) for near in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
        raise refused("there is no such file", legal=", ".join(found[:10]) or None) from None
    except IsADirectoryError:
        raise refused("this is a folder, not a YAML file") from None
    except OSError as error:
        raise refused(f"cannot be read ({error.strerror})") from error
    if len(content) > MAX_BYTES:
        raise refused("the file is too large for a declaration", legal=f"at most {MAX_BYTES} bytes")
    try:
        text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        before = content[: error.start].decode("utf-8", errors="replace")
        rest = content[error.start :].split(b"\n")[0].decode("utf-8", errors="replace")
        start = before.rfind("\n") + 1
        place = Place(origin, before.count("\n") + 1, len(before) - start + 1, before[start:] + rest)
        message = f"byte 0x{content[error.start]:02x} is not UTF-8"
        raise refused(message, place, fix="save the file as UTF-8") from None
    source = parse_yaml(text, origin)
    if not isinstance(source.data, dict):
        kind = "is empty" if source.data is None else "does not hold a mapping at its top level"
        raise refused(f"the file {kind}", source.place_of(()), legal="keys and values, as in `name: thesis`")
    return source


def parse_yaml(text: str, origin: str, *, start: int = 0, is_argument: bool = False) -> Source:
    """Parse ``text[start:]``; places are those in the whole text. Raises DeclarationError.

    ``is_argument``: the text is an argument of the command line, so that places have no line number.
    """
    line_starts = [0, *(match.end() for match in re.finditer("\n", text))]
    lines: dict[int, str] = {}
    """Each line once: its places share it, however many they are and however long it is."""

    def place(index: int, end: int) -> Place:
        """The place of the characters from ``index`` to ``end``, counted after ``start``."""
        index, end = min(index + start, len(text)), end + start
        line = bisect_right(line_starts, index) - 1
        first = line_starts[line]
        if line not in lines:
            line_end = text.find("\n", first)
            lines[line] = text[first:] if line_end < 0 else text[first:line_end]
        width = max(1, min(end, first + len(lines[line])) - index)
        return Place(origin, 0 if is_argument else line + 1, index - first + 1, lines[line], width)

    version = _OTHER_VERSION.search(text)
    if version:
        problem = Problem("only YAML 1.2 is read", place(version.start() - start, version.end()))
        raise DeclarationError(origin, [problem])
    root = _composed(text[start:], origin, place)
    builder = _Builder(place)
    data = builder.build(root, (), ()) if root is not None else None
    if builder.problems:
        raise DeclarationError(origin, builder.problems)
    builder.values.setdefault((), place(0, 0))
    return Source(origin, text, data, builder.values, builder.keys)


def to_yaml(data: Any) -> str:
    """Plain data as YAML 1.2, in its own order of keys; `parse_yaml` inverts it."""
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


def _composed(text: str, origin: str, place: Callable[[int, int], Place]) -> Node | None:
    """ruamel.yaml's node tree; its errors become a problem with a place.

    Too deep and too long texts are refused first: composing recurses, scanning slows with depth, nodes take memory.
    """
    depth, nodes, problem = 0, 0, None
    try:
        for event in YAML(typ="safe", pure=True).parse(text):
            depth += isinstance(event, CollectionStartEvent) - isinstance(event, CollectionEndEvent)
            nodes += isinstance(event, NodeEvent)
            at = int(event.start_mark.index)
            if depth > MAX_DEPTH:
                problem = Problem("nested too deep", place(at, at + 1), legal=f"at most {MAX_DEPTH} levels")
            elif nodes > 2 * MAX_NODES:  # keys are nodes, too
                problem = Problem("too many values", place(at, at + 1), legal=f"at most {MAX_NODES} values")
            if problem is not None:
                break
        else:
            return YAML(typ="safe", pure=True).compose(text)
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
        return self._scalar(node, here)

    def _mapping(self, node: MappingNode, path: KeyPath, within: tuple[Node, ...]) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            if len(self.problems) >= MAX_PROBLEMS:
                break
            at, before = self._place(key_node), len(self.problems)
            if key_node.tag == _TAG + "merge":
                fix = "write the keys out, or an alias for a whole value"
                self._problem("merge keys (`<<`) are not part of YAML 1.2", at, fix=fix)
                continue
            key = self._scalar(key_node, at) if isinstance(key_node, ScalarNode) else None
            if not isinstance(key, str):
                if len(self.problems) == before:
                    self._problem("a key must be text", at, "text; put quotes around numbers")
            elif key in result:
                first = self.keys[(*path, key)]
                self.problems.append(
                    Problem(f"duplicate key `{key}`", at, other=first, other_says="already written at", fix="keep one")
                )
            else:
                self.keys[(*path, key)] = at
                result[key] = self.build(value_node, (*path, key), within)
        return result

    def _scalar(self, node: Node, here: Place) -> Any:
        kind, text = str(node.tag).removeprefix(_TAG), node.value
        plain = text.lower().replace("_", "") if isinstance(node, ScalarNode) else ""
        try:
            if not isinstance(node, ScalarNode):
                kind = ""
            elif kind == "null":
                return None
            elif kind == "bool":
                return {"true": True, "false": False}[text.lower()]
            elif kind == "int":
                return int(plain, 0) if re.match(r"[-+]?0[ox]", text) else int(plain)
            elif kind == "float":
                return float(plain.replace(".inf", "inf").replace(".nan", "nan"))
            elif kind in ("str", "timestamp"):  # YAML 1.2 has no dates: they are text
                text.encode()
                return text
        except (ValueError, KeyError):
            return self._problem(f"{text[:40]!r} cannot be read as {kind}", here)
        tag = str(node.tag).replace(_TAG, "!!")
        return self._problem(f"the tag {tag} is not read", here, "plain mappings, lists, text and numbers")

    def _problem(self, message: str, place: Place, legal: str | None = None, fix: str | None = None) -> None:
        self.problems.append(Problem(message, place, legal=legal, fix=fix))

    def _place(self, node: Node) -> Place:
        return self.place(node.start_mark.index, node.end_mark.index)
