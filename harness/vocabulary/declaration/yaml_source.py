"""Reads YAML 1.2 as plain data with the place of every key and value, so that all problems are
shown at their places.

Only ruamel.yaml's node tree is used, so that no tag can build an object and every duplicate key is
seen. Deliberately unsupported: merge keys (``<<``, not part of YAML 1.2), tags, several documents,
and keys that are not text."""

from __future__ import annotations

import re
import textwrap
from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import CollectionEndEvent, CollectionStartEvent, NodeEvent
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.parser import Parser
from ruamel.yaml.reader import ReaderError

from harness.vocabulary.errors import UserError
from harness.vocabulary.lengths import converted
from harness.vocabulary.words import nearest

# Characters of a source line that a message shows; longer lines are cut around the caret
SHOWN_COLUMNS = 110
# Most problems that a message lists, and most that are searched for in a single mapping
MAX_PROBLEMS = 100


@dataclass(frozen=True)
class Place:
    """A position in a text. ``line`` and ``column`` count from 1, in characters; ``width`` is that
    of the caret. A ``line`` of 0 means an argument of the command line; ``line_text`` is then the
    whole argument."""

    origin: str
    line: int
    column: int
    line_text: str
    width: int = 1

    @property
    def head(self) -> str:
        """``file:line:column``, or the option's name."""
        return f"{self.origin}:{self.line}:{self.column}" if self.line else self.origin

    def excerpt(self) -> list[str]:
        """Return the source line and a line with a caret under the place, both indented."""
        start = (
            max(0, self.column - 1 - SHOWN_COLUMNS // 2)
            if len(self.line_text) > SHOWN_COLUMNS
            else 0
        )
        cut = self.line_text[start : start + SHOWN_COLUMNS]
        shown = "".join(letter if letter.isprintable() else " " for letter in cut)
        offset = self.column - 1 - start
        width = max(1, min(self.width, len(shown) - offset))
        return [
            f"{self.line or '':>5} | {shown}".rstrip(),
            f"{' ' * 5} | {' ' * offset}^{'~' * (width - 1)}",
        ]


@dataclass(frozen=True)
class Problem:
    """A mistake: message, place, legal values, the nearest legal word, and a second place that is
    involved."""

    message: str
    place: Place | None
    legal: str | None = None
    nearest: str | None = None
    fix: str | None = None
    other: Place | None = None
    other_says: str = ""

    def __str__(self) -> str:
        lines = (
            [f"{self.place.head}: {self.message}", *self.place.excerpt()]
            if self.place
            else [self.message]
        )
        if self.other:
            lines += [f"  {self.other_says} {self.other.head}", *self.other.excerpt()]
        lines += [f"  did you mean: {self.nearest}"] if self.nearest else []
        if self.legal:
            lines += textwrap.wrap(
                self.legal, 118, initial_indent="  legal: ", subsequent_indent=" " * 9
            )
        return "\n".join(lines + ([f"  to do: {self.fix}"] if self.fix else []))


class DeclarationError(UserError):
    """All problems of an experiment, in the order of the file."""

    def __init__(self, origin: str, problems: Iterable[Problem]) -> None:
        self.origin = origin
        self.problems = in_order(problems)
        count = "1 problem" if len(self.problems) == 1 else f"{len(self.problems)} problems"
        lines = [*map(str, self.problems[:MAX_PROBLEMS])]
        lines += (
            [f"and {hidden_count} more"]
            if (hidden_count := len(self.problems) - MAX_PROBLEMS) > 0
            else []
        )
        super().__init__(f"{origin}: {count}; nothing was run\n\n" + "\n\n".join(lines))

    def __reduce__(self) -> tuple[object, ...]:
        return DeclarationError, (self.origin, self.problems)


def in_order(problems: Iterable[Problem]) -> tuple[Problem, ...]:
    """Return the problems sorted by place, without duplicates: without place first, then the
    command line's."""
    unique = {(problem.place, problem.message): problem for problem in problems}.values()

    def position(problem: Problem) -> tuple[int, int]:
        position = problem.place
        return (
            (-1, 0)
            if position is None
            else (position.line, position.column if position.line else 0)
        )

    return tuple(sorted(unique, key=position))


KeyPath = tuple[
    str | int, ...
]  # Position of a value in the data: keys of mappings and indices of lists
# An experiment written by hand has a few kB; the parser needs up to 20 s for a megabyte
MAX_BYTES = 500_000
MAX_NODES = 50_000  # Values after aliases are expanded; this stops an alias bomb
MAX_DEPTH = 40  # Levels of nesting; the schema needs 8
INDENTATION = {
    r"'\t'": "indent with spaces, not with tabs",
    "expected <block end>": "let all keys of a mapping begin in the same column",
    "mapping values are not allowed": (
        "write the keys that belong to a key on lines of their own, indented further; put quotes "
        "around text with a colon"
    ),
}
"""What to do about the parser's messages that a wrong indentation causes."""
NAMING = ("path", "key")
"""Keys of variations and of unknowns that name another key."""
NAMED = ("values", "range")
"""Keys beside these with values of the key that is named."""
_TAG = "tag:yaml.org,2002:"
_OTHER_VERSION = re.compile(r"^%YAML[ \t]+(?!1\.2\b).*", re.MULTILINE)


@dataclass(frozen=True)
class Source:
    """Plain data with the places of all its ``values`` and ``keys``, by `KeyPath`."""

    origin: str
    text: str
    data: Any
    values: Mapping[KeyPath, Place]
    keys: Mapping[KeyPath, Place]

    def place_of(self, path: KeyPath) -> Place:
        """Return the place of a value, or of the innermost enclosing value if it is not in the
        text (a default)."""
        while path and path not in self.values:
            path = path[:-1]
        return self.values[path]

    def key_place_of(self, path: KeyPath) -> Place:
        """Return the place of a key, or else of the innermost enclosing key or value that has a
        place."""
        while path and path not in self.keys and path not in self.values:
            path = path[:-1]
        return self.keys[path] if path in self.keys else self.values[path]

    def with_value(
        self, path: KeyPath, data: Any, donor: Source, donor_path: KeyPath = ()
    ) -> Source:
        """Return this source with new ``data``, whose value at ``path`` came from ``donor`` at
        ``donor_path``."""
        depth = len(donor_path)
        merged = []
        for own_positions, donated in ((self.values, donor.values), (self.keys, donor.keys)):
            kept = {
                path_there: position
                for path_there, position in own_positions.items()
                if path_there[: len(path)] != path
            }
            merged.append(
                kept
                | {
                    path + path_there[depth:]: p
                    for path_there, p in donated.items()
                    if path_there[:depth] == donor_path
                }
            )
        values, keys = merged
        keys[path] = donor.place_of(donor_path)
        return Source(self.origin, self.text, data, values, keys)


def read_yaml(path: Path) -> Source:
    """Read a file whose top level is a mapping. Raises DeclarationError with every problem and its
    place."""
    path = Path(path)
    position = None
    legal = None
    meant = None
    fix = None
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_BYTES + 1)
        if len(content) <= MAX_BYTES:
            text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
            source = parse_yaml(text, str(path))
            if isinstance(source.data, dict):
                return source
            kind = "is empty" if source.data is None else "does not hold a mapping at its top level"
            message = f"the file {kind}"
            position = source.place_of(())
            legal = "keys and values, as in `name: thesis`"
        else:
            message = "the file is too large for a declaration"
            legal = f"at most {MAX_BYTES} bytes"
    except FileNotFoundError:
        yaml_files = (
            sorted(str(file) for file in path.parent.glob("*.yaml")) if path.parent.is_dir() else []
        )
        message = "there is no such file"
        meant = nearest(path, yaml_files)
        legal = ", ".join(yaml_files[:10]) or None
    except IsADirectoryError:
        message = "this is a folder, not a YAML file"
    except OSError as error:
        message = f"cannot be read ({error.strerror})"
    except UnicodeDecodeError as error:
        lines = content[: error.start].decode("utf-8", errors="replace").split("\n")
        undecodable = content[error.start :].split(b"\n")[0].decode("utf-8", errors="replace")
        position = Place(str(path), len(lines), len(lines[-1]) + 1, lines[-1] + undecodable)
        message = f"byte 0x{content[error.start]:02x} is not UTF-8"
        fix = "save the file as UTF-8"
    raise DeclarationError(str(path), [Problem(message, position, legal, meant, fix)])


def parse_yaml(
    text: str, origin: str, *, start: int = 0, is_argument: bool = False, key: str = ""
) -> Source:
    """Parse ``text[start:]``; places refer to the whole text. ``is_argument`` says that the text
    is an argument of the command line, so that places have no line number; ``key`` is the key
    whose value the text is. Lengths with a unit become numbers in the unit that their key's name
    states: ``distance_m: 90cm`` is 0.9. Raises DeclarationError."""
    starts = [0, *(match.end() for match in re.finditer("\n", text))]
    lines = text.split("\n")

    def place(index: int, end: int) -> Place:
        """Return the place of the characters from ``index`` to ``end``, counted after ``start``."""
        index = min(index + start, len(text))
        line = bisect_right(starts, index) - 1
        width = max(1, min(end + start, starts[line] + len(lines[line])) - index)
        return Place(
            origin, 0 if is_argument else line + 1, index - starts[line] + 1, lines[line], width
        )

    if version := _OTHER_VERSION.search(text):
        version_place = place(version.start() - start, version.end())
        raise DeclarationError(origin, [Problem("only YAML 1.2 is supported", version_place)])
    reader = YAML(typ="safe", pure=True)
    reader.Parser = _BoundedParser
    try:
        root = reader.compose(text[start:])
        builder = _Builder(place)
        data = None if root is None else converted(key, builder.build(root, (), ()))
        if not builder.problems:
            return Source(origin, text, data, {(): place(0, 0), **builder.values}, builder.keys)
        raise DeclarationError(origin, builder.problems)
    except _TooMuch as error:
        message, limit, index = error.args
        problem = Problem(message, place(index, index + 1), legal=f"at most {limit}")
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        context = error.context_mark
        where = place(mark.index, mark.index + 1) if mark else None
        begun = (
            place(context.index, context.index + 1)
            if context and mark and context.index != mark.index
            else None
        )
        reason = " ".join(filter(None, [error.context, error.problem])).replace("\n", " ")
        fix = next((fix for said, fix in INDENTATION.items() if said in reason), None)
        problem = Problem(
            f"not valid YAML: {reason}", where, fix=fix, other=begun, other_says="which began at"
        )
    except ReaderError as error:
        index = int(error.position)
        letter = f"U+{ord(text[start + index]):04X}"
        problem = Problem(f"character {letter} is not allowed in YAML", place(index, index + 1))
    except YAMLError as error:
        problem = Problem(f"not valid YAML: {error}", place(0, 1))
    raise DeclarationError(origin, [problem])


def to_yaml(data: Any) -> str:
    """Return plain data as YAML 1.2 with the order of keys kept; `parse_yaml` inverts it."""
    writer = YAML()
    stream = StringIO()
    writer.default_flow_style = False
    writer.width = 120
    writer.dump(data, stream)
    return stream.getvalue()


class _TooMuch(Exception):
    """A declaration exceeds a limit. Its arguments are the message, the limit, and the character
    where that happens."""


class _BoundedParser(Parser):
    """Refuses a text before the composer recurses too deeply, the scanner becomes slow, or nodes
    fill the memory."""

    depth = nodes = 0

    def get_event(self) -> Any:
        event = super().get_event()
        self.depth += isinstance(event, CollectionStartEvent) - isinstance(
            event, CollectionEndEvent
        )
        self.nodes += isinstance(event, NodeEvent)  # keys count too
        if self.depth > MAX_DEPTH or self.nodes > 2 * MAX_NODES:
            excess = (
                ("nested too deeply", MAX_DEPTH)
                if self.depth > MAX_DEPTH
                else ("too many values", MAX_NODES)
            )
            raise _TooMuch(*excess, event.start_mark.index)
        return event


class _Builder:
    """Converts nodes to plain data and collects places and problems."""

    def __init__(self, place_of_span: Callable[[int, int], Place]) -> None:
        self._place = place_of_span
        self.values: dict[KeyPath, Place] = {}
        self.keys: dict[KeyPath, Place] = {}
        self.problems: list[Problem] = []
        self._nodes = 0

    def build(self, node: Node, path: KeyPath, within: tuple[Node, ...]) -> Any:
        """Return the data of a node at a path; ``within`` are the nodes that enclose it."""
        self.values[path] = position = self._of(node)
        self._nodes += 1
        if len(self.problems) >= MAX_PROBLEMS or self._nodes > MAX_NODES + 1:
            return None
        if self._nodes > MAX_NODES:
            return self._refuse(
                "too many values",
                position,
                f"at most {MAX_NODES} values after aliases are expanded",
            )
        if any(node is outer for outer in within):
            return self._refuse("an alias refers to a value that contains it", position)
        if len(within) >= MAX_DEPTH:
            return self._refuse("nested too deeply", position, f"at most {MAX_DEPTH} levels")
        if isinstance(node, MappingNode) and node.tag == _TAG + "map":
            return self._mapping(node, path, (*within, node))
        if isinstance(node, SequenceNode) and node.tag == _TAG + "seq":
            return [
                self.build(item, (*path, index), (*within, node))
                for index, item in enumerate(node.value)
            ]
        return self._scalar(node, position)

    def _mapping(
        self, node: MappingNode, path: KeyPath, within: tuple[Node, ...]
    ) -> dict[str, Any]:
        result: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key_place = self._of(key_node)
            before = len(self.problems)
            if key_node.tag == _TAG + "merge":
                fix = "write the keys out, or use an alias for a whole value"
                self.problems.append(
                    Problem("merge keys (`<<`) are not part of YAML 1.2", key_place, fix=fix)
                )
                continue
            key = self._scalar(key_node, key_place) if isinstance(key_node, ScalarNode) else None
            if isinstance(key, str) and key not in result:
                self.keys[(*path, key)] = key_place
                result[key] = converted(key, self.build(value_node, (*path, key), within))
            elif isinstance(key, str):
                first = self.keys[(*path, key)]
                message = f"duplicate key `{key}`"
                self.problems.append(
                    Problem(
                        message,
                        key_place,
                        other=first,
                        other_says="already written at",
                        fix="keep one",
                    )
                )
            elif len(self.problems) == before:
                self._refuse("a key must be text", key_place, "text; put quotes around numbers")
        for naming, values in product(NAMING, NAMED):
            if values in result and isinstance(result.get(naming), str):
                result[values] = converted(result[naming], result[values])
        return result

    def _scalar(self, node: Node, position: Place) -> Any:
        kind = str(node.tag).removeprefix(_TAG)
        text = node.value
        try:
            if not isinstance(node, ScalarNode):
                pass
            elif kind == "null":
                return None
            elif kind == "bool":
                return {"true": True, "false": False}[text.lower()]
            elif kind in ("int", "float"):
                digits = text.lower().replace("_", "").replace(".inf", "inf").replace(".nan", "nan")
                return (
                    float(digits)
                    if kind == "float"
                    else int(digits, 0 if re.match("[-+]?0[ox]", digits) else 10)
                )
            elif kind in ("str", "timestamp"):  # YAML 1.2 has no dates: they are text
                text.encode()
                return text
        except (ValueError, KeyError):
            return self._refuse(f"{text[:40]!r} cannot be read as {kind}", position)
        tag = str(node.tag).replace(_TAG, "!!")
        return self._refuse(
            f"the tag {tag} is not supported", position, "plain mappings, lists, text and numbers"
        )

    def _refuse(self, message: str, position: Place, legal: str | None = None) -> None:
        self.problems.append(Problem(message, position, legal=legal))

    def _of(self, node: Node) -> Place:
        return self._place(node.start_mark.index, node.end_mark.index)
