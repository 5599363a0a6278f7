"""Formats numbers and tables as text: for a terminal with colours, as plain lines, and for a
page."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from markupsafe import Markup
    from rich.table import Table as RichTable

UNKNOWN_TEXT = "–"
EQUAL_CONTRAST = 0.179
"""Relative luminance of a ground on which black and white text have equal contrast, 4.6: the root
of 0.05 * 1.05, less 0.05."""
INCHES = {n: str(Fraction(n, 16)) for n in (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16)}


def plain(value: Any) -> str:
    """Return text and counts unchanged, other numbers with three digits, and a dash for unknown
    values."""
    if value is None or (isinstance(value, float | np.floating) and np.isnan(value)):
        return UNKNOWN_TEXT
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float | np.floating) else str(value)


def mm(value: float, digits: int = 2) -> str:
    """Return a number of millimetres, or a dash if it is not finite."""
    return f"{value:.{digits}f}" if np.isfinite(value) else UNKNOWN_TEXT


def plus_minus(mean: float, std: float, sign: str = "") -> str:
    """Return ``3.20 ± 0.10``, or a dash if the mean is unknown; ``sign`` is "+" for differences."""
    text = f"{mean:{sign}.2f}".replace("-", "−") + (
        "" if np.isnan(std) else f"\u00a0±\u00a0{std:.2f}"
    )
    return UNKNOWN_TEXT if np.isnan(mean) else text


def size(value: float, largest: float = np.inf) -> str:
    """Return a limit in mm with two digits; ``> 15.9`` beyond the largest inspected, ``largest``;
    ``none`` for NaN."""
    if np.isnan(value) or value > largest:
        return "none" if np.isnan(value) else f">\u00a0{largest:.3g}"
    if np.isinf(value):
        return "∞"
    if abs(value) < 99.5:
        return f"{value:#.2g}".removesuffix(".")
    return f"{value:.3g}"


def percent(share: float) -> str:
    """Return ``93`` for 0.93. Shares near 0 and 1 get a decimal, since 0 and 100 would mean
    impossible and certain."""
    value = 100 * share
    if np.isnan(value) or 1 <= value <= 99:
        return UNKNOWN_TEXT if np.isnan(value) else f"{value:.0f}"
    if value < 0.05:
        return "< 0.1"
    if value > 99.95:
        return "> 99.9"
    return f"{value:.1f}"


def p_value(p: float) -> str:
    """Return a p-value with two digits."""
    if np.isnan(p):
        return UNKNOWN_TEXT
    return "< 0.0001" if p < 0.0001 else f"{p:.2g}"


def interval(low: float, high: float, digits: int = 2, largest: float = np.inf) -> str:
    """Return ``4.80 to 5.62``, or ``4.80 to > 15.9`` if an end lies beyond ``largest``;
    ``unknown`` without interval."""
    if np.isnan(low) or np.isnan(high):
        return "unknown"
    return " to ".join(_number(end, digits, largest) for end in (low, high))


def with_interval(
    value: float, low: float, high: float, digits: int = 2, largest: float = np.inf
) -> str:
    """Return ``5.1 (4.8 to 5.6)``, or only the estimate if its interval is unknown or beyond
    ``largest``. Numbers have at most ``digits`` decimals. They have two significant digits if the
    interval is wider than `ROUGH` times the value (or times its upper end if the value is 0)."""
    if np.isnan(low) or np.isnan(high) or np.isnan(value) or min(value, low) > largest:
        return _number(value, digits, largest)
    scale = abs(value or high)
    if np.isfinite([scale, low, high]).all() and scale and high - low > ROUGH * scale:
        digits = min(digits, max(0, 1 - int(np.floor(np.log10(scale)))))
    return f"{_number(value, digits, largest)} ({interval(low, high, digits, largest)})"


def many(count: int, noun: str) -> str:
    """Return ``1 trial``, ``2 trials``."""
    return f"{count} {noun}" + ("" if count == 1 else "s")


def joined_words(parts: Sequence[str]) -> str:
    """Return ``a``, ``a and b``, or ``a, b and c``."""
    if len(parts) < 2:
        return "".join(parts)
    return f"{', '.join(parts[:-1])} and {parts[-1]}"


def unbroken(text: str) -> str:
    """Return ``text`` with no-break spaces between numbers and the words after them: ``0.7 m``,
    ``50 frames``."""
    return re.sub(r"(?<=\d) (?=[^\W\d])", "\u00a0", text)


def inches(diameter_mm: float) -> str:
    """Return the size of a common inch drill as a fraction, such as ``1/4 in``; an empty text for
    other sizes."""
    sixteenths = diameter_mm / 25.4 * 16
    fraction = INCHES.get(round(sixteenths)) if abs(sixteenths - round(sixteenths)) < 1e-3 else None
    return f"{fraction} in" if fraction else ""


def _number(value: float, digits: int, largest: float) -> str:
    return (
        f"{value:.{digits}f}"
        if np.isfinite(value) and not value > largest
        else size(value, largest)
    )


Tone = Literal["", "good", "key", "bad", "open", "changed"]
COLOURS = {"good": "green", "key": "bold green", "bad": "bold red", "open": "yellow"}
"""Colours at a terminal; the text alone conveys the same."""
ROUGH = 0.1  # ratio of an interval's width to the value beyond which a third digit is meaningless
CLASSES = {"good": "good", "key": "key", "bad": "none", "open": "open", "changed": "changed"}


@dataclass(frozen=True)
class Cell:
    """A cell's text and tone. On a page, ``share`` (0 to 1) shades the cell, and text after a line
    break or, in columns of numbers, after `` (`` stands below in small letters."""

    text: str
    tone: Tone = ""
    share: float | None = None


@dataclass(frozen=True)
class Grid:
    """Rows of cells below their ``heads``; the first ``left`` columns are flush left. ``kind`` is
    a class on pages."""

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    left: int = 1
    title: str = ""
    kind: str = "limits"

    @staticmethod
    def of(
        heads: Iterable[str],
        rows: Iterable[Iterable[object]],
        left: int = 1,
        title: str = "",
        kind: str = "limits",
    ) -> Grid:
        """Make a grid of cells, or of their text."""
        cells = tuple(
            tuple(cell if isinstance(cell, Cell) else Cell(str(cell)) for cell in row)
            for row in rows
        )
        return Grid(tuple(heads), cells, left, title, kind)

    def lines(self) -> list[str]:
        """Return plain lines with aligned columns."""
        lines = [self.heads, *([cell.text for cell in row] for row in self.rows)]
        widths = [max(len(line[column]) for line in lines) for column in range(len(self.heads))]
        signs = "<" * self.left + ">" * len(self.heads)
        return [
            "  ".join(
                f"{text:{sign}{width}}"
                for text, sign, width in zip(line, signs, widths, strict=False)
            ).rstrip()
            for line in lines
        ]

    def rich(self) -> RichTable:
        """Return the table for a terminal; it has no box, so that many columns fit into 80
        characters."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title=self.title or None, box=None, pad_edge=False, collapse_padding=True)
        for column, head in enumerate(self.heads):
            justify: Literal["left", "right"] = "left" if column < self.left else "right"
            table.add_column(head, justify=justify, no_wrap=column > 0, overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(cell.text, style=COLOURS.get(cell.tone, "")) for cell in row))
        return table

    def html(self) -> Markup:
        """Return the table for a page. The first cell of a row is its head; an interval stands
        below its estimate."""
        from markupsafe import Markup

        number = [
            Markup("" if column < self.left else ' class="n"') for column in range(len(self.heads))
        ]
        heads = Markup("").join(map(Markup("<th{}>{}</th>").format, number, self.heads))
        rows = []
        for row in self.rows:
            cells = [Markup('<th scope="row">{}</th>').format(row[0].text)]
            cells += [
                _data_cell(cell, column >= self.left) for column, cell in enumerate(row[1:], 1)
            ]
            rows.append(Markup("<tr>{}</tr>").format(Markup("").join(cells)))
        table = (
            '<div class="scroll"><table '
            'class="{}"><thead><tr>{}</tr></thead><tbody>\n{}\n</tbody></table></div>'
        )
        return Markup(table).format(self.kind, heads, Markup("\n").join(rows))


def _data_cell(cell: Cell, is_number: bool) -> Markup:
    from markupsafe import Markup, escape

    large, newline, small = cell.text.partition("\n")
    bracket = ""
    if is_number and not newline:
        large, bracket, small = cell.text.partition(" (")
    below = Markup(" <small>{}{}</small>").format(bracket.strip(), small) if small else Markup("")
    style = Markup("")
    if cell.share is not None:
        weight = 0.06 + 0.94 * cell.share
        red = round(255 + (0 - 255) * weight)
        green = round(255 + (94 - 255) * weight)
        blue = round(255 + (156 - 255) * weight)
        is_dark = _luminance(red, green, blue) < EQUAL_CONTRAST
        ink = "#fff" if is_dark else "#000"
        style = Markup(' style="background:rgb({},{},{});color:{}"').format(red, green, blue, ink)
    kinds = (
        "n" if is_number else "",
        CLASSES.get(cell.tone, ""),
        "" if cell.share is None else "rate",
    )
    kind = " ".join(filter(None, kinds))
    class_attribute = Markup(' class="{}"').format(kind) if kind else Markup("")
    return Markup("<td{}{}>{}{}</td>").format(class_attribute, style, escape(large), below)


def _luminance(red: int, green: int, blue: int) -> float:
    """Return the relative luminance of a colour (0 to 255), from 0 to 1 (WCAG 2.2)."""
    linear = []
    for channel in (red, green, blue):
        value = channel / 255
        linear.append(value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4)
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def text_of(parts: Iterable[str | Grid]) -> str:
    """Return tables and sentences as plain lines."""
    return "\n".join(
        line for part in parts for line in (part.lines() if isinstance(part, Grid) else [part])
    )


def show(parts: Sequence[str | Grid]) -> None:
    """Print tables and sentences: in colour at a terminal that is wide enough, else as plain
    lines."""
    if not sys.stdout.isatty():
        print(text_of(parts))
        return
    from rich.console import Console

    console = Console()
    for part in parts:
        if isinstance(part, str):
            console.print(part, markup=False, highlight=False)
            continue
        table = part.rich()
        # rich would cut off numbers on a narrow terminal; wrapped lines remain readable
        fits = (
            console.measure(table, options=console.options.update(max_width=1000)).maximum
            <= console.width
        )
        console.print(table) if fits else print(text_of([part]))
