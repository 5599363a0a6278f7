"""The kinds of small faults, found on the syntax tree and written by position, so that the
formatting stays.

Docstrings, messages, f-strings, annotations, decorators, raised errors and the options of programs
are left alone."""

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

GUARD = 1e-6
"""A constant up to this size only prevents a division by zero: doubled or 0, it is no fault that a
test could see."""
OUTSIDE = "<module>"  # the function of a statement outside of all functions
SKIPPED_FUNCTIONS = {"_options", "_draw", "_figure", "_plot"}  # options of a program, and figures
DRAWN_ON = re.compile(r"(axis|axes|ax|figure|plt)\.")  # objects whose methods lay out a figure
SKIPPED_CALLS = {"UserError", "add_argument", "print", "warn", "subplots", "figure", "savefig"}
SYMMETRIC_CALLS = {
    "min",
    "max",
    "minimum",
    "maximum",
    "fmin",
    "fmax",
    "hypot",
    "isclose",
    "allclose",
} | {
    *(
        "array_equal",
        "isinstance",
        "issubclass",
        "getattr",
        "hasattr",
        "zip",
        "product",
        "chain",
        "gcd",
    )
}
COMPARISONS: dict[type, tuple[str, tuple[str, ...]]] = {
    ast.Lt: ("<", ("<=", ">")),
    ast.LtE: ("<=", ("<", ">=")),
    ast.Gt: (">", (">=", "<")),
    ast.GtE: (">=", (">", "<=")),
    ast.Eq: ("==", ("!=",)),
    ast.NotEq: ("!=", ("==",)),
}
SIGNS: dict[type, tuple[str, str]] = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
}
MASKS: dict[type, tuple[str, str]] = {ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&")}
WORDS: dict[type, tuple[str, str]] = {ast.And: ("and", "or"), ast.Or: ("or", "and")}
OPPOSITES = [("min", "max"), ("minimum", "maximum"), ("fmin", "fmax"), ("argmin", "argmax")]
OPPOSITES += [("nanmin", "nanmax"), ("floor", "ceil"), ("any", "all")]
OPPOSITE_OF = dict(OPPOSITES) | {second: first for first, second in OPPOSITES}
DROPPED_CALLS = {"abs", "absolute", "fabs", "sqrt"}
SIMPLE = (ast.Name, ast.Constant, ast.Call, ast.Attribute, ast.Subscript)
SEQUENCES = (ast.JoinedStr, ast.List, ast.ListComp, ast.Tuple)


@dataclass(frozen=True)
class Mutant:
    """A fault: a replacement of the bytes from ``start`` to ``end`` of a file by ``text``."""

    file: str
    """Path in the checkout."""
    function: str
    """Name of the function or class, with those around it; `OUTSIDE` for a statement of the
    module."""
    kind: str
    """Name of a rule of `RULES`, or "named"."""
    original: str
    """The lines that change, on one line."""
    mutant: str
    """These lines after the change, on one line."""
    repeat: int
    """Number of equal mutants before this one in the function."""
    start: int
    end: int
    text: str
    site: tuple[int, int] = (0, 0)
    """Bytes of the expression that several mutants share."""

    @property
    def key(self) -> tuple[str, ...]:
        """What identifies the mutant in files, whichever line it stands on."""
        return (self.file, self.function, self.kind, self.original, self.mutant, str(self.repeat))

    def applied(self, data: bytes) -> bytes:
        """Return the file's content (bytes) with the fault."""
        return data[: self.start] + self.text.encode() + data[self.end :]


class Source:
    """The content of a file, with the offsets in bytes of the nodes of its syntax tree."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.tree = ast.parse(data)
        self._line_starts = [0]
        for line in data.splitlines(keepends=True):
            self._line_starts.append(self._line_starts[-1] + len(line))

    def start(self, node: ast.AST) -> int:
        """Return the offset of a node's first byte."""
        return self._line_starts[node.lineno - 1] + node.col_offset  # type: ignore[attr-defined]

    def end(self, node: ast.AST) -> int:
        """Return the offset behind a node's last byte."""
        return self._line_starts[node.end_lineno - 1] + node.end_col_offset  # type: ignore[attr-defined]

    def text(self, node: ast.AST) -> str:
        """Return a node as it is written, without parentheses around it."""
        return self.data[self.start(node) : self.end(node)].decode()

    def operand(self, node: ast.AST) -> str:
        """Return a node as it is written, in parentheses unless it needs none anywhere."""
        return self.text(node) if isinstance(node, SIMPLE) else f"({self.text(node)})"

    def lines(self, start: int, end: int) -> tuple[int, int]:
        """Return the offsets of the whole lines that the bytes from ``start`` to ``end`` touch."""
        first = self.data.rfind(b"\n", 0, start) + 1
        last = self.data.find(b"\n", end)
        return first, last if last >= 0 else len(self.data)


@dataclass(frozen=True)
class Edit:
    """A replacement of the bytes from ``start`` to ``end`` by ``text``."""

    start: int
    end: int
    text: str


def _whole(source: Source, node: ast.AST, text: str) -> Edit:
    return Edit(source.start(node), source.end(node), text)


def _between(source: Source, left: ast.AST, right: ast.AST, old: str, new: str) -> Iterator[Edit]:
    """Yield the replacement of an operator between two operands, unless a comment makes it
    unclear."""
    start = source.end(left)
    gap = source.data[start : source.start(right)].decode()
    position = gap.find(old)
    if position >= 0 and "#" not in gap:
        offset = start + len(gap[:position].encode())
        yield Edit(offset, offset + len(old), new)


def _name_of(call: ast.Call) -> str:
    return ast.unparse(call.func).rpartition(".")[2]


def _is_sequence(node: ast.AST) -> bool:
    """Return whether a sum is one of texts or lists."""
    if isinstance(node, ast.BinOp):
        return _is_sequence(node.left) or _is_sequence(node.right)
    is_text = isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    return is_text or isinstance(node, SEQUENCES)


def _constants(source: Source, node: ast.AST) -> Iterator[Edit]:
    if not isinstance(node, ast.Constant) or type(node.value) not in (int, float):
        return
    value = node.value
    is_guard = 0 < value <= GUARD
    values = [value + 1] if is_guard else [2 * value, value + 1, 0 * value]
    for fromkey in dict.fromkeys(values):
        if fromkey != value:
            yield _whole(source, node, repr(fromkey))


def _comparisons(source: Source, node: ast.AST) -> Iterator[Edit]:
    if not isinstance(node, ast.Compare):
        return
    operands = [node.left, *node.comparators]
    for first, operator, second in zip(operands, node.ops, node.comparators, strict=False):
        old, replacements = COMPARISONS.get(type(operator), ("", ()))
        for new in replacements:
            yield from _between(source, first, second, old, new)


def _signs(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield _whole(source, node, source.operand(node.operand))
    elif isinstance(node, ast.BinOp) and type(node.op) in SIGNS and not _is_sequence(node):
        yield from _between(source, node.left, node.right, *SIGNS[type(node.op)])
    elif isinstance(node, ast.AugAssign) and type(node.op) in SIGNS:
        if _is_sequence(node.value):
            return
        yield from _between(source, node.target, node.value, *SIGNS[type(node.op)])


def _dropped_terms(source: Source, node: ast.AST) -> Iterator[Edit]:
    if not isinstance(node, ast.BinOp) or type(node.op) not in SIGNS or _is_sequence(node):
        return
    yield _whole(source, node, source.operand(node.left))
    if isinstance(node.op, ast.Add | ast.Mult):
        yield _whole(source, node, source.operand(node.right))
    elif isinstance(node.op, ast.Sub):
        yield _whole(source, node, f"-{source.operand(node.right)}")


def _swapped_arguments(source: Source, node: ast.AST) -> Iterator[Edit]:
    if not isinstance(node, ast.Call) or _name_of(node) in SYMMETRIC_CALLS:
        return
    for first, second in zip(node.args, node.args[1:], strict=False):
        is_same_kind = isinstance(first, SIMPLE) and type(first) is type(second)
        texts = (source.text(first), source.text(second))
        if (
            is_same_kind
            and texts[0] != texts[1]
            and not (_is_sequence(first) or _is_sequence(second))
        ):
            gap = source.data[source.end(first) : source.start(second)].decode()
            swapped = texts[1] + gap + texts[0]
            yield Edit(source.start(first), source.end(second), swapped)


def _negated_conditions(source: Source, node: ast.AST) -> Iterator[Edit]:
    tests: list[ast.expr] = []
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        tests = [node.test]
    elif isinstance(node, ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp):
        tests = [test for generator in node.generators for test in generator.ifs]
    for test in tests:
        is_negated = isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not)
        if not is_negated:
            yield _whole(source, test, f"not ({source.text(test)})")


def _dropped_not(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.Invert):
        yield _whole(source, node, source.operand(node.operand))


def _min_and_max(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Call) and _name_of(node) in OPPOSITE_OF:
        name = _name_of(node)
        end = source.end(node.func)
        yield Edit(end - len(name), end, OPPOSITE_OF[name])


def _and_and_or(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.BinOp) and type(node.op) in MASKS:
        yield from _between(source, node.left, node.right, *MASKS[type(node.op)])
    elif isinstance(node, ast.BoolOp):
        for first, second in zip(node.values, node.values[1:], strict=False):
            yield from _between(source, first, second, *WORDS[type(node.op)])


def _dropped_functions(source: Source, node: ast.AST) -> Iterator[Edit]:
    if isinstance(node, ast.Call) and _name_of(node) in DROPPED_CALLS and len(node.args) == 1:
        yield _whole(source, node, f"({source.text(node.args[0])})")


RULES = {
    "constant": _constants,
    "comparison": _comparisons,
    "sign": _signs,
    "dropped term": _dropped_terms,
    "swapped arguments": _swapped_arguments,
    "negated condition": _negated_conditions,
    "dropped not": _dropped_not,
    "min and max": _min_and_max,
    "and and or": _and_and_or,
    "dropped function": _dropped_functions,
}


def _is_skipped(node: ast.AST) -> bool:
    """Return whether no fault is sought in a node: a message, an import, a version, an option."""
    if isinstance(node, ast.Call):
        is_layout = DRAWN_ON.match(ast.unparse(node.func)) is not None
        return is_layout or _name_of(node) in SKIPPED_CALLS
    if isinstance(node, ast.FunctionDef):
        return node.name in SKIPPED_FUNCTIONS
    if isinstance(node, ast.Assign):
        return ast.unparse(node.targets[0]).lower().endswith("version")
    return isinstance(node, ast.JoinedStr | ast.Raise | ast.Assert | ast.Import | ast.ImportFrom)


def _parts(node: ast.AST) -> list[ast.AST]:
    """Return the parts of a node but decorators, bases and annotations."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        defaults = [*node.args.defaults, *node.args.kw_defaults]
        return [part for part in [*defaults, *node.body] if part is not None]
    if isinstance(node, ast.ClassDef):
        return list(node.body)
    if isinstance(node, ast.AnnAssign):
        return [] if node.value is None else [node.value]
    return list(ast.iter_child_nodes(node))


def _nodes(node: ast.AST, function: str) -> Iterator[tuple[ast.AST, str]]:
    """Yield the nodes in which faults are sought, with the name of the function around each."""
    for part in _parts(node):
        if _is_skipped(part):
            continue
        inside = function
        if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inside = part.name if function == OUTSIDE else f"{function}.{part.name}"
        yield part, inside
        yield from _nodes(part, inside)


def on_one_line(text: str) -> str:
    """Return a text with each run of white space as one space."""
    return " ".join(text.split())


def mutant_of(source: Source, file: str, function: str, kind: str, edit: Edit) -> Mutant:
    """Return an edit as a mutant, with the lines that it changes."""
    first, last = source.lines(edit.start, edit.end)
    lines = source.data[first:last].decode()
    changed = source.data[first : edit.start] + edit.text.encode() + source.data[edit.end : last]
    original = on_one_line(lines)
    after = on_one_line(changed.decode())
    return Mutant(file, function, kind, original, after, 0, edit.start, edit.end, edit.text)


def mutants_of(file: str, data: bytes) -> list[Mutant]:
    """Return all mutants of a file with this content, in the order of the tree."""
    source = Source(data)
    mutants: list[Mutant] = []
    repeats: Counter[tuple[str, ...]] = Counter()
    for node, function in _nodes(source.tree, OUTSIDE):
        for kind, rule in RULES.items():
            for edit in rule(source, node):
                mutant = mutant_of(source, file, function, kind, edit)
                site = (source.start(node), source.end(node))
                mutants.append(replace(mutant, site=site, repeat=repeats[mutant.key]))
                repeats[mutant.key] += 1
    return mutants


def named_mutant(
    file: str, data: bytes, function: str, original: str, replaced: str
) -> Mutant | None:
    """Return the fault that replaces ``original``, a text that occurs once in a function or, if not
    there, in the file; else None. Line breaks and commas before closing brackets may differ."""
    source = Source(data)
    ranges = [(0, len(data))]
    for node, name in _nodes(source.tree, OUTSIDE):
        if name == function and isinstance(node, ast.FunctionDef | ast.ClassDef):
            ranges.insert(0, (source.start(node), source.end(node)))
    tokens = [re.escape(token) for token in re.findall(r"\w+|\S", original)]
    broken = [rf",?\s*{token}" if token in (r"\)", r"\]") else token for token in tokens]
    pattern = re.compile(r"\s*".join(broken).encode())
    for start, end in ranges:
        hits = list(pattern.finditer(data, start, end))
        if len(hits) == 1:
            edit = Edit(hits[0].start(), hits[0].end(), replaced)
            return mutant_of(source, file, function, "named", edit)
    return None
