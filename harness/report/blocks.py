"""Parts of pages: the skeleton with the stylesheet, blocks, figures as SVG or PNG. All text but
`Markup` is escaped.

page(title, answer, [heading("Limits"), LIMITS.grid(rows).html(), figure(figures, "curves", "Each
stroke is ...")])"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape

from harness.vocabulary.files import atomic_path
from harness.vocabulary.provenance import GENERATOR
from harness.vocabulary.text import Grid, many

if TYPE_CHECKING:
    from jinja2 import Environment, Template
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

HERE = Path(__file__).parent
SHOWN_FIRST = (
    "commit",
    "dirty",
    "seed",
    "started",
    "machine",
    "mitsuba_variant",
    "renders",
    "versions",
)
"""Keys of the provenance that every page shows, as "not recorded" if they are missing."""
BILL = "processor_seconds"
"""Key of a run's bill in its provenance: seconds by phase, or a function that returns them, because
a page is a part of what it states."""
SHOWN_APART = ("command", "seconds", "failures", BILL)
"""Keys of the provenance that stand in sections of their own."""
MOST_NAMED = 3
"""Most trials that are named for the same failure."""
MOST_VALUES = 81
"""Most points of a line whose values are shown under the pointer."""

MOST_HEADLINE_WORDS = 20

# ---------------------------------------------------------------- the skeleton


def template(name: str, folder: Path = HERE) -> Template:
    """Load a template from ``folder`` or from this folder; undefined names are errors, and text is
    escaped."""
    return _environment(folder).get_template(name)


@cache
def _environment(folder: Path) -> Environment:
    """Return what compiles the templates of a folder, each once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([folder, HERE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals.update(
        generator=GENERATOR,
        style=Markup((HERE / "style.css").read_text(encoding="utf-8")),
        script=Markup((HERE / "page.js").read_text(encoding="utf-8")),
        figure=figure,
        split_answer=split_answer,
        warnings=(),
        figures={},
        closing="",
        conditions="",
        first="",
        caption="",
        scene="",
    )
    return environment


def page(
    title: str,
    answer: str,
    body: Iterable[Markup],
    under: Iterable[Markup] = (),
    warnings: Iterable[str] = (),
) -> str:
    """Return a whole page: ``title``, ``warnings``, the ``answer``, whose beginning is the
    headline (`split_answer`), parts ``under`` it, the body."""
    return template("page.html").render(
        title=title,
        answer=answer,
        body=joined(body),
        under=joined(under),
        warnings=list(warnings),
    )


def split_answer(answer: str) -> tuple[str, str]:
    """Return the headline of a page, as many sentences and clauses of the answer as have
    `MOST_HEADLINE_WORDS`, but at least one, and the others."""
    clauses = re.split(r"(?<=[.;]) ", answer)
    count = 1
    while (
        count < len(clauses) and len(" ".join(clauses[: count + 1]).split()) <= MOST_HEADLINE_WORDS
    ):
        count += 1
    headline = " ".join(clauses[:count])
    continuation = " ".join(clauses[count:])
    if headline.endswith(";"):
        headline = f"{headline[:-1]}."
        continuation = f"{continuation[0].upper()}{continuation[1:]}"
    return headline, continuation


# ---------------------------------------------------------------- elements


def tag(name: str, *content: str | Markup, **attributes: str) -> Markup:
    """Return an HTML element; attributes without a value are left out, ``kind`` is the class."""
    written = Markup("")
    for attribute, value in attributes.items():
        key = "class" if attribute == "kind" else attribute.replace("_", "-")
        if value:
            written += Markup(' {}="{}"').format(key, value)
    return Markup("<{0}{1}>{2}</{0}>").format(Markup(name), written, joined(content, ""))


def joined(parts: Iterable[str | Markup], between: str = "\n") -> Markup:
    """Join all parts in order."""
    return Markup(between).join(escape(part) for part in parts)


heading = partial(tag, "h2")
subheading = partial(tag, "h3")
paragraph = partial(tag, "p")
note = partial(tag, "p", kind="note")


def bullets(items: Iterable[str | Markup]) -> Markup:
    """Return an unordered list."""
    return tag("ul", joined(tag("li", item) for item in items))


def figure(figures: Mapping[str, str], name: str, caption: str) -> Markup:
    """Return a figure of ``figures`` (SVG text by name) with its caption, or a note that its data
    were not stored."""
    if name not in figures:
        return note("No data for this figure were stored.")
    drawing = tag("div", Markup(figures[name]), kind="scroll")
    return tag("figure", drawing, tag("figcaption", caption), id=name)


def fold(summary: str, *content: str | Markup, is_open: bool = False) -> Markup:
    """Return content that opens with a click on its summary."""
    state = "open" if is_open else ""
    return tag("details", tag("summary", summary), joined(content), open=state)


def folded(tables: Sequence[tuple[str, Markup]]) -> list[Markup]:
    """Return titled tables in folds, of which the first is open."""
    return [
        fold(title, content, is_open=number == 0) for number, (title, content) in enumerate(tables)
    ]


def command_of(command: str) -> list[Markup]:
    """Return the section with the command that made a page."""
    return [subheading("Command"), tag("pre", command)]


# ---------------------------------------------------------------- the last sections


def closing(
    provenance: Mapping[str, Any], experiment_yaml_text: str, left_out: str = ""
) -> list[Markup]:
    """Return the last sections of every sweep's page. ``left_out`` is a sentence on frames
    excluded from averages."""
    parts = [heading("Failures"), *_failures(provenance.get("failures", ()))]
    if left_out:
        parts.append(paragraph(left_out))
    command = command_of(provenance.get("command", "not recorded"))
    return [
        *parts,
        heading("Provenance"),
        fold("Cost, versions and command", *_cost(provenance), origin_table(provenance), *command),
        fold("The resolved experiment", tag("pre", experiment_yaml_text)),
    ]


def _cost(provenance: Mapping[str, Any]) -> list[Markup]:
    """Return what a run cost: its bill, or, of programs without one, seconds by stage."""
    bill = provenance.get(BILL)
    seconds = provenance.get("seconds", {})
    if bill is None:
        if not seconds:
            return [paragraph("Not recorded.")]
        stages = [(stage, f"{float(value):.1f}") for stage, value in seconds.items()]
        return [Grid.of(("stage", "seconds"), stages).html()]
    by_phase = bill() if callable(bill) else bill
    total_s = sum(by_phase.values())
    phases = []
    for phase, phase_s in [*by_phase.items(), ("in all", total_s)]:
        phases.append((phase, f"{phase_s:.1f}", f"{100 * phase_s / max(total_s, 0.01):.0f} %"))
    counts = []
    for name in ("renders", "trials"):
        if name in provenance:
            counts.append(f"{provenance[name]['done']} {name}")
    work = f", for {' and '.join(counts)}" if counts else ""
    wall_s = seconds.get("this run in all")
    took = f" It took {float(wall_s):.0f} s before this page was drawn." if wall_s else ""
    explained = (
        f"Processor seconds of all processes of this run{work}. What was stored before costs "
        f"nothing here.{took}"
    )
    return [Grid.of(("phase", "processor seconds", "share"), phases).html(), note(explained)]


def _failures(failures: Iterable[Mapping[str, str]]) -> list[Markup]:
    """Return how many parts of the experiment failed, and the parts of each reason."""
    names_by_reason: dict[str, list[str]] = {}
    for failure in failures:
        reason = f"{failure['state']}: {failure['why']}"
        names_by_reason.setdefault(reason, []).append(failure["what"])
    if not names_by_reason:
        return [paragraph("No trial failed.")]
    count = sum(len(names) for names in names_by_reason.values())
    total = f"{many(count, 'part')} of the experiment failed; no number above includes it."
    parts = [paragraph(total)]
    for reason, names in names_by_reason.items():
        unnamed = len(names) - MOST_NAMED
        text = ", ".join(names[:MOST_NAMED])
        if unnamed > 0:
            text += f" and {unnamed} others"
        parts.append(tag("p", f"{text}: {reason}", kind="fail"))
    return parts


def origin_table(provenance: Mapping[str, Any]) -> Markup:
    """Return the table of all keys that have no section of their own."""
    remaining_keys = [key for key in provenance if key not in (*SHOWN_FIRST, *SHOWN_APART)]
    lines = []
    for key in (*SHOWN_FIRST, *remaining_keys):
        name = key.replace("_mm", " (mm)").replace("_", " ")
        value = plain(provenance.get(key, "not recorded"))
        lines.append(tag("tr", tag("th", name, scope="row"), tag("td", value)))
    return tag("table", tag("tbody", joined(lines)), kind="prov")


def plain(value: Any) -> str:
    """Return a recorded value as text: yes or no, ``name: value`` pairs, or a list; never in
    Python's notation."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {plain(part)}" for key, part in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(plain(part) for part in value) or "none"
    if value is None:
        return "not recorded"
    return value if isinstance(value, str) else json.dumps(value, default=str)


# ---------------------------------------------------------------- figures

# Okabe and Ito's palette (Color Universal Design, 2008), which remains distinguishable with common
# colour blindness
BLUE = "#0072B2"
ORANGE = "#E69F00"
GREEN = "#009E73"
RED = "#D55E00"
SKY = "#56B4E9"
PURPLE = "#CC79A7"
INK = "#1d2530"
GREY = "#6b7480"
PALE = "#e9ecef"
DAMAGE = "#ff00ff"
"""Magenta, the colour of damage in the clouds of the thesis."""
COLOURS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
"""Colours of lines, in order."""
GUIDE = "#cfd6dd"
"""Colour of guides behind the data."""
ON_IMAGE = "#10151b"
"""Colour of lines and text on an image of residuals, whose colours are the same in the dark."""
THEME = {
    "#ffffff": "--page",
    INK: "--ink",
    GREY: "--grey",
    PALE: "--line",
    GUIDE: "--line",
    BLUE: "--blue",
    ORANGE: "--orange",
    GREEN: "--green",
    RED: "--red",
    SKY: "--sky",
    PURPLE: "--purple",
}
"""The page's variables (`style.css`) that a figure's colours become, so that a figure follows a
light or a dark page; `ON_IMAGE` and `DAMAGE` do not."""
MARKERS = "osD^vP"
"""Markers of lines, in order."""
STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "text.color": INK,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "grid.color": PALE,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.6,
    "svg.image_inline": True,
    "svg.fonttype": "path",
    "image.interpolation": "nearest",
}
"""Matplotlib's settings for all figures."""
DPI = 160
POINTS_PER_INCH = 72


def svg(name: str, size_in: tuple[float, float], alt: str, draw: Callable[[Figure], None]) -> str:
    """Draw a figure of ``size_in`` (width, height) inches; return it as an inline ``<svg>`` with
    the label ``alt`` and the values of its lines, which are shown under the pointer. ``name``
    seeds the ids in it, so that a page can hold several figures. The text contains no dates and no
    random numbers."""
    buffer = io.StringIO()
    no_dates = {"Date": None, "Creator": None}
    drawn = _save(buffer, size_in, draw, name, format="svg", metadata=no_dates)
    text = buffer.getvalue()
    body = text[text.index("<svg") :].strip()
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{name}-", body)
    body = _themed(body)
    for side in ("width", "height"):
        body = re.sub(rf'(<svg[^>]*?) {side}="[^"]*"', r"\1", body, count=1)
    values = json.dumps(_values(drawn), separators=(",", ":"), ensure_ascii=False)
    attributes = f'role="img" aria-label="{escape(alt)}" data-values="{escape(values)}"'
    return body.replace("<svg", f"<svg {attributes}", 1)


def _themed(body: str) -> str:
    """Return a figure whose colours of `THEME` are the page's; elsewhere they stay as drawn."""
    for colour, variable in THEME.items():
        body = body.replace(f": {colour.lower()}", f": var({variable}, {colour.lower()})")
    return body


def save_png(path: Path, size_in: tuple[float, float], draw: Callable[[Figure], None]) -> None:
    """Draw a figure of ``size_in`` (width, height) inches to a PNG with `DPI`; the same data give
    the same bytes."""
    with atomic_path(path) as temporary:
        _save(temporary, size_in, draw, format="png", metadata={"Software": None})


def _save(
    target: Any, size_in: Any, draw: Callable[[Figure], None], name: str = "", **options: Any
) -> Figure:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: Any = {**STYLE, "svg.hashsalt": name or None}
    with rc_context(style):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        if options["format"] == "svg":
            _lay_out(figure)
        figure.savefig(target, dpi=DPI, **options)
        return figure


def _lay_out(figure: Figure) -> None:
    """Lay out a figure for a file of SVG. Matplotlib itself would draw it once more for that: a
    quarter of the time."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)
    figure.set_dpi(POINTS_PER_INCH)
    layout = figure.get_layout_engine()
    if layout is not None:
        layout.execute(figure)
        figure.set_layout_engine(None)


def _values(figure: Figure) -> list[dict[str, Any]]:
    """Return each panel's box (left, top, right, bottom), axis and lines. Lengths are in points
    from the upper left."""
    panels = []
    scale = POINTS_PER_INCH / figure.dpi
    height = figure.bbox.height
    for axes in figure.axes:
        lines = _lines(axes, scale, height)
        left, low, right, top = axes.get_window_extent().extents
        if lines:
            box = [round(end * scale) for end in (left, height - top, right, height - low)]
            panels.append({"box": box, "x": axes.get_xlabel().replace("\\$", "$"), "lines": lines})
    return panels


def _lines(axes: Axes, scale: float, height: float) -> list[list[Any]]:
    """Return the lines of a panel with a name: the name, then x and y in the drawing (points from
    the upper left) and on the axes, of at most `MOST_VALUES` points. ``height``: of the figure."""
    # the name of a line with error bars is that of its container
    name_by_id = {
        id(bars[0]): bars.get_label() for bars in axes.containers if hasattr(bars, "has_yerr")
    }
    lines: list[list[Any]] = []
    for line in axes.get_lines():
        name = str(name_by_id.get(id(line), line.get_label()))
        xy = np.asarray(line.get_xydata(), float)
        xy = xy[np.isfinite(xy).all(axis=1)]
        if name.startswith("_") or len(xy) < 2 or line.get_transform() != axes.transData:
            continue
        spread = np.linspace(0, len(xy) - 1, MOST_VALUES).round().astype(int)
        xy = xy[np.unique(spread)]
        pixels = axes.transData.transform(xy)
        x_points = pixels[:, 0] * scale
        y_points = (height - pixels[:, 1]) * scale
        numbers = np.column_stack([x_points, y_points, xy]).ravel()
        lines.append([name.replace("\n", " "), *(float(f"{value:.4g}") for value in numbers)])
    return lines


def plain_decades(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, at 1, 2 and 5 of every decade."""

    def minor_label(value: float, _: object) -> str:
        return f"{value:g}" if f"{value:e}"[0] in "25" else ""

    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(minor_label)
