"""A table as text: the same cells for a terminal with colours, for plain lines and for a page."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from markupsafe import Markup
    from rich.table import Table as RichTable

Tone = Literal["", "good", "key", "bad", "open", "changed"]
COLOURS = {"good": "green", "key": "bold green", "bad": "bold red", "open": "yellow"}
"""Colours of a terminal; the text says the same without them."""
MOST_WIDE = 14
"""Columns up to which a page's table has room for wide cells."""
CLASSES = {"good": "good", "key": "key", "bad": "none", "open": "open", "changed": "changed"}


@dataclass(frozen=True)
class Cell:
    """A cell's text, and how it is meant. On a page ``share`` (0 to 1) shades it, the bluer the more, ``hover`` is
    shown where one points at it, and what follows `` (`` or a line's end stands below in small letters."""

    text: str
    tone: Tone = ""
    share: float | None = None
    hover: str = ""


@dataclass(frozen=True)
class Grid:
    """Rows of cells below their ``heads``; the first ``left`` columns are flush left, the others flush right."""

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    left: int = 1
    title: str = ""

    @staticmethod
    def of(heads: Iterable[str], rows: Iterable[Iterable[object]], left: int = 1, title: str = "") -> Grid:
        """Make a grid of cells, or of what stands in them as text."""
        cells = tuple(tuple(one if isinstance(one, Cell) else Cell(str(one)) for one in row) for row in rows)
        return Grid(tuple(heads), cells, left, title)

    def lines(self) -> list[str]:
        """Return plain lines, columns below each other."""
        return aligned([self.heads, *([cell.text for cell in row] for row in self.rows)], self.left)

    def rich(self) -> RichTable:
        """Return the table for a terminal; without a box, so that many columns fit 80 characters."""
        from rich.table import Table
        from rich.text import Text

        table = Table(title=self.title or None, box=None, pad_edge=False, collapse_padding=True)
        for place, head in enumerate(self.heads):
            first = place < self.left
            table.add_column(head, justify="left" if first else "right", no_wrap=place > 0, overflow="fold")
        for row in self.rows:
            table.add_row(*(Text(cell.text, style=COLOURS.get(cell.tone, "")) for cell in row))
        return table

    def html(self) -> Markup:
        """Return the table for a page: the first cell of a row is its head, an interval stands below its estimate."""
        from markupsafe import Markup

        heads = Markup("").join(
            Markup("<th{}>{}</th>").format(Markup("" if place < self.left else ' class="n"'), head)
            for place, head in enumerate(self.heads)
        )
        grouped = any(not row[0].text for row in self.rows)
        rows = []
        for row in self.rows:
            cells = [Markup('<th scope="row">{}</th>').format(row[0].text)]
            cells += [self._data_cell(place, cell) for place, cell in enumerate(row[1:], 1)]
            start = Markup('<tr class="group">' if grouped and row[0].text else "<tr>")
            rows.append(start + Markup("{}</tr>").format(Markup("").join(cells)))
        kind = "limits dense" if len(self.heads) > MOST_WIDE else "limits"
        return Markup(
            '<div class="scroll"><table class="{}"><thead><tr>{}</tr></thead><tbody>\n{}\n</tbody></table></div>'
        ).format(kind, heads, Markup("\n").join(rows))

    def _data_cell(self, place: int, cell: Cell) -> Markup:
        from markupsafe import Markup, escape

        if isinstance(cell.text, Markup):
            shown = cell.text
        else:
            estimate, mark, beside = _parts(cell.text)
            below = Markup(" <small>{}{}</small>").format(mark, beside) if beside else Markup("")
            shown = escape(estimate) + below
        kinds = ("" if place < self.left else "n", CLASSES.get(cell.tone, ""), "" if cell.share is None else "rate")
        style = Markup("") if cell.share is None else Markup(' style="{}"').format(_shade(cell.share))
        hover = Markup(' title="{}"').format(cell.hover) if cell.hover else Markup("")
        kind = " ".join(filter(None, kinds))
        start = Markup("<td{}").format(Markup(f' class="{kind}"') if kind else Markup(""))
        return start + style + hover + Markup(">{}</td>").format(shown)


def _parts(text: str) -> tuple[str, str, str]:
    """Split a text into the part in large letters and the part below it in small ones."""
    large, newline, small = text.partition("\n")
    if newline:
        return large, "", small
    large, bracket, small = text.partition(" (")
    return large, "(" if bracket else "", small


def _shade(share: float) -> str:
    """CSS of a cell: the bluer, the greater the share."""
    weight = 0.06 + 0.94 * share
    red, green, blue = (round(255 + (channel - 255) * weight) for channel in (0, 94, 156))
    return f"background:rgb({red},{green},{blue});color:{'#fff' if share > 0.72 else '#1d2530'}"


def aligned(lines: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Return a plain table: columns of one width each, the first ``left`` flush left, the others flush right."""
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))] if lines else []
    return [
        "  ".join(
            f"{text:{'<' if column < left else '>'}{widths[column]}}" for column, text in enumerate(line)
        ).rstrip()
        for line in lines
    ]


def text_of(parts: Iterable[str | Grid]) -> str:
    """Return tables and sentences as plain lines."""
    return "\n".join(line for part in parts for line in (part.lines() if isinstance(part, Grid) else [part]))


def show(parts: Iterable[str | Grid]) -> None:
    """Print tables and sentences: in colour at a terminal that is wide enough, else as plain lines."""
    parts = list(parts)
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
        # rich would cut the numbers on a narrow terminal; wrapped lines can still be read
        fits = console.measure(table, options=console.options.update(max_width=1000)).maximum <= console.width
        console.print(table) if fits else print(text_of([part]))
