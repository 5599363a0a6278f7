"""Parts of pages: the skeleton with the stylesheet, blocks, figures as SVG or PNG. All text but
`Markup` is escaped.

page(title, answer, [heading("Limits"), LIMITS.grid(rows).html(), figure(figures, "curves", "Each
stroke is ...")])"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape

from harness.vocabulary.files import atomic_path
from harness.vocabulary.provenance import GENERATOR
from harness.vocabulary.text import Grid, many

if TYPE_CHECKING:
    from jinja2 import Template
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

HERE = Path(__file__).parent
SHOWN_FIRST = (
    *("commit", "dirty", "seed", "started", "machine", "mitsuba_variant"),
    *("renders", "versions"),
)
"""Keys of the provenance that every page shows, as "not recorded" if they are missing."""
MOST_VALUES = 81  # most points of a line whose values are shown under the pointer
SHOWN_APART = ("command", "seconds", "failures")
NAMED = 3  # Most trials that are named for the same failure


def template(name: str, folder: Path | None = None) -> Template:
    """Load a template from ``folder`` or from this folder; undefined names are errors, and text is
    escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([place for place in (folder, HERE) if place]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals |= {
        "generator": GENERATOR,
        "style": Markup((HERE / "style.css").read_text(encoding="utf-8")),
        "script": Markup((HERE / "page.js").read_text(encoding="utf-8")),
        "figure": figure,
        **{"warnings": (), "figures": {}},
        **dict.fromkeys(("closing", "conditions", "first", "caption", "scene"), ""),
    }
    return environment.get_template(name)


def page(
    title: str,
    answer: str,
    body: Iterable[Markup],
    under: Iterable[Markup] = (),
    warnings: Iterable[str] = (),
) -> str:
    """Return a whole page: ``title``, ``warnings``, the ``answer`` in large letters, parts
    ``under`` it, the body."""
    parts = {"body": joined(body), "under": joined(under), "warnings": list(warnings)}
    return template("page.html").render(title=title, answer=answer, **parts)


def tag(name: str, *content: str | Markup, **attributes: str) -> Markup:
    """Return an HTML element; attributes without a value are left out, ``kind`` is the class."""
    named = (
        (key.replace("_", "-") if key != "kind" else "class", value)
        for key, value in attributes.items()
        if value
    )
    written = Markup("").join(Markup(' {}="{}"').format(key, value) for key, value in named)
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
    return tag(
        "figure",
        tag("div", Markup(figures[name]), kind="scroll"),
        tag("figcaption", caption),
        id=name,
    )


def fold(summary: str, *content: str | Markup, is_open: bool = False) -> Markup:
    """Return content that opens with a click on its summary."""
    return tag("details", tag("summary", summary), joined(content), open="open" if is_open else "")


def folded(tables: Sequence[tuple[str, Markup]]) -> list[Markup]:
    """Return titled tables in folds, of which the first is open."""
    return [
        fold(title, content, is_open=not place) for place, (title, content) in enumerate(tables)
    ]


def command_of(command: str) -> list[Markup]:
    """Return the section with the command that made a page."""
    return [subheading("Command"), tag("pre", command)]


def closing(
    provenance: Mapping[str, Any], experiment_yaml_text: str, left_out: str = ""
) -> list[Markup]:
    """Return the last sections of every sweep's page. ``left_out`` is a sentence on frames
    excluded from averages."""
    reasons: dict[str, list[str]] = {}
    for failure in provenance.get("failures", ()):
        reasons.setdefault(f"{failure['state']}: {failure['why']}", []).append(failure["what"])
    missing = f"{many(sum(map(len, reasons.values())), 'part')} of the experiment failed; no number above includes it."
    parts = [heading("Failures"), paragraph(missing if reasons else "No trial failed.")]
    for why, parts_of in reasons.items():
        more = f" and {len(parts_of) - NAMED} others" if len(parts_of) > NAMED else ""
        parts.append(tag("p", f"{', '.join(parts_of[:NAMED])}{more}: {why}", kind="fail"))
    parts += [paragraph(left_out)] if left_out else []
    rows = [
        (stage, f"{float(value):.1f}") for stage, value in provenance.get("seconds", {}).items()
    ]
    cost = Grid.of(("stage", "seconds"), rows).html() if rows else paragraph("Not recorded.")
    keys = [key for key in provenance if key not in (*SHOWN_FIRST, *SHOWN_APART)]
    lines = []
    for key in (*SHOWN_FIRST, *keys):
        name = key.replace("_mm", " (mm)").replace("_", " ")
        value = plain(provenance.get(key, "not recorded"))
        lines.append(tag("tr", tag("th", name, scope="row"), tag("td", value)))
    parts += [heading("Provenance")]
    table = tag("table", tag("tbody", joined(lines)), kind="prov")
    folds = fold(
        "Cost, versions and command",
        cost,
        table,
        *command_of(provenance.get("command", "not recorded")),
    )
    return [*parts, folds, fold("The resolved experiment", tag("pre", experiment_yaml_text))]


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
DAMAGE = "#ff00ff"  # magenta, the colour of damage in the clouds of the thesis

STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    **dict.fromkeys(("axes.spines.top", "axes.spines.right", "legend.frameon"), False),
    **dict.fromkeys(("axes.axisbelow", "axes.grid", "svg.image_inline"), True),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), GREY),
    **dict.fromkeys(("axes.labelcolor", "text.color", "xtick.labelcolor", "ytick.labelcolor"), INK),
    "grid.color": PALE,
    "legend.fontsize": 9,
    "lines.linewidth": 1.6,
    "svg.fonttype": "path",
    "image.interpolation": "nearest",
}
COLOURS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE)
MARKERS = "osD^vP"


def svg(name: str, size_in: tuple[float, float], alt: str, draw: Callable[[Figure], None]) -> str:
    """Draw a figure of ``size_in`` (width, height) inches; return it as an inline ``<svg>`` with
    the label ``alt`` and the values of its lines, which are shown under the pointer. ``name``
    seeds the ids in it, so that a page can hold several figures. The text contains no dates and no
    random numbers."""
    buffer = io.StringIO()
    drawn = _save(
        buffer, size_in, draw, name, format="svg", metadata={"Date": None, "Creator": None}
    )
    text = buffer.getvalue()
    body = re.sub(
        r"<metadata>.*?</metadata>", "", text[text.index("<svg") :].strip(), flags=re.DOTALL
    )
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{name}-", body)
    for size in ("width", "height"):
        body = re.sub(rf'(<svg[^>]*?) {size}="[^"]*"', r"\1", body, count=1)
    values = json.dumps(_values(drawn), separators=(",", ":"), ensure_ascii=False)
    return body.replace(
        "<svg", f'<svg role="img" aria-label="{escape(alt)}" data-values="{escape(values)}"', 1
    )


def _values(figure: Figure) -> list[dict[str, Any]]:
    """Return each panel's box (left, top, right, bottom), axis and lines. A line is its name, then
    x and y in the drawing and on the axes for at most `MOST_VALUES` points. Lengths are in points
    from the upper left."""
    panels = []
    scale = 72 / figure.dpi
    height = figure.bbox.height
    for axes in figure.axes:
        names = {
            id(bars[0]): bars.get_label() for bars in axes.containers if hasattr(bars, "has_yerr")
        }
        lines = []
        for line in axes.get_lines():
            name = str(names.get(id(line), line.get_label()))
            xy = np.asarray(line.get_xydata(), float)
            xy = xy[np.isfinite(xy).all(axis=1)]
            if name.startswith("_") or len(xy) < 2 or line.get_transform() != axes.transData:
                continue
            xy = xy[np.unique(np.linspace(0, len(xy) - 1, MOST_VALUES).round().astype(int))]
            at = axes.transData.transform(xy)
            rows = np.column_stack([at[:, 0] * scale, (height - at[:, 1]) * scale, xy])
            lines.append(
                [name.replace("\n", " "), *(float(f"{value:.4g}") for value in rows.ravel())]
            )
        left, low, right, top = axes.get_window_extent().extents
        if lines:
            box = [round(end * scale) for end in (left, height - top, right, height - low)]
            panels.append({"box": box, "x": axes.get_xlabel().replace("\\$", "$"), "lines": lines})
    return panels


def plain_decades(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, at 1, 2 and 5 of every decade."""
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else "")


def save_png(path: Path, size_in: tuple[float, float], draw: Callable[[Figure], None]) -> None:
    """Draw a figure of ``size_in`` (width, height) inches to a PNG with 160 dpi; the same data
    give the same bytes."""
    with atomic_path(path) as temporary:
        _save(temporary, size_in, draw, format="png", metadata={"Software": None})


def _save(
    target: Any, size_in: Any, draw: Callable[[Figure], None], name: str = "", **how: Any
) -> Figure:
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    style: Any = {**STYLE, "svg.hashsalt": name or None}
    with rc_context(style):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        figure.savefig(target, dpi=160, **how)
        return figure
