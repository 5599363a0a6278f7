"""Problems of a declaration with their places: they are collected and shown all at once."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass

from harness.vocabulary.errors import UserError

SHOWN_COLUMNS = 110
"""Characters of a source line that a message shows; longer lines are cut around the caret."""

MAX_PROBLEMS = 100
"""Most problems that a message lists, and that are looked for in a single mapping."""


@dataclass(frozen=True)
class Place:
    """Position of something written: ``line`` and ``column`` count from 1, in characters; ``width`` is the caret's.

    ``line`` 0 means an argument of the command line, whose ``line_text`` is the whole argument.
    """

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
        """The source line and a caret under the place, both indented."""
        start = max(0, self.column - 1 - SHOWN_COLUMNS // 2) if len(self.line_text) > SHOWN_COLUMNS else 0
        cut = self.line_text[start : start + SHOWN_COLUMNS]
        shown = "".join(letter if letter.isprintable() else " " for letter in cut)
        offset = self.column - 1 - start
        width = max(1, min(self.width, len(shown) - offset))
        label = f"{self.line:5d}" if self.line else " " * 5
        return [f"{label} | {shown}".rstrip(), f"{' ' * 5} | {' ' * offset}^{'~' * (width - 1)}"]


@dataclass(frozen=True)
class Problem:
    """One mistake: what, where, what would be legal, the nearest legal word, and a second place that it concerns."""

    message: str
    place: Place | None
    legal: str | None = None
    nearest: str | None = None
    fix: str | None = None
    other: Place | None = None
    other_says: str = ""

    def __str__(self) -> str:
        lines = [f"{self.place.head}: {self.message}" if self.place else self.message]
        lines += self.place.excerpt() if self.place else []
        if self.other:
            lines += [f"  {self.other_says} {self.other.head}", *self.other.excerpt()]
        if self.nearest:
            lines.append(f"  did you mean: {self.nearest}")
        if self.legal:
            lines += textwrap.wrap(self.legal, 118, initial_indent="  legal: ", subsequent_indent=" " * 9)
        if self.fix:
            lines.append(f"  to do: {self.fix}")
        return "\n".join(lines)


class DeclarationError(UserError):
    """Everything that is wrong with an experiment, in the order of the file."""

    def __init__(self, origin: str, problems: Iterable[Problem]) -> None:
        self.origin = origin
        self.problems = in_order(problems)
        count = "1 problem" if len(self.problems) == 1 else f"{len(self.problems)} problems"
        told = [*map(str, self.problems[:MAX_PROBLEMS])]
        told += [f"and {further} more"] if (further := len(self.problems) - MAX_PROBLEMS) > 0 else []
        super().__init__(f"{origin}: {count}; nothing was run\n\n" + "\n\n".join(told))

    def __reduce__(self) -> tuple[object, ...]:
        return DeclarationError, (self.origin, self.problems)


def in_order(problems: Iterable[Problem]) -> tuple[Problem, ...]:
    """Problems by place, each (place, message) once; first those without a place, then those of the command line."""
    unique = {(problem.place, problem.message): problem for problem in problems}.values()

    def position(problem: Problem) -> tuple[int, int]:
        place = problem.place
        return (-1, 0) if place is None else (place.line, place.column if place.line else 0)

    return tuple(sorted(unique, key=position))
