"""The one way a figure becomes SVG text, or a PNG: one style, one palette, and the same bytes for the same data."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from html import escape
from typing import TYPE_CHECKING, Any

from harness.vocabulary.files import atomic_path

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.figure import Figure

# Okabe and Ito's palette (Color Universal Design, 2008): told apart with any of the common colour blindnesses.
BLUE, ORANGE, GREEN, RED, SKY, PURPLE = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7"
INK, GREY, PALE = "#1d2530", "#6b7480", "#e9ecef"
DAMAGE = "#ff00ff"
"""Magenta: the thesis' colour of damage in its clouds."""

STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": PALE,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "lines.linewidth": 1.6,
    "svg.fonttype": "path",
    "svg.image_inline": True,
    "image.interpolation": "nearest",
}


def svg(name: str, size_in: tuple[float, float], alt: str, draw: Callable[[Figure], None]) -> str:
    """Draw a figure of ``size_in`` (width, height) inches; the text of an inline ``<svg>`` with ``alt`` as its label.

    ``name`` seeds the ids inside, so that several figures live on one page; no date, no random number gets in.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    style: Any = {**STYLE, "svg.hashsalt": name}
    with rc_context(style):
        figure = Figure(figsize=size_in, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", dpi=160, metadata={"Date": None, "Creator": None})
    return _inline(buffer.getvalue(), name, alt)


def save_png(path: Path, size_in: tuple[float, float], draw: Callable[[Figure], None]) -> None:
    """Draw a figure of ``size_in`` (width, height) inches to a PNG of 160 dots an inch; the same bytes for the same
    data."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    style: Any = STYLE
    with rc_context(style), atomic_path(path) as temporary:
        figure = Figure(figsize=size_in, layout="constrained", dpi=160)
        canvas = FigureCanvasAgg(figure)
        draw(figure)
        canvas.print_png(str(temporary), metadata={"Software": None})


def _inline(text: str, name: str, alt: str) -> str:
    """Cut the XML prologue, make ids unique to this figure, and name the picture for those who cannot see it."""
    body = text[text.index("<svg") :].strip()
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'(xlink:href="#|url\(#)', rf"\g<1>{name}-", body)
    body = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", body, count=1)
    body = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", body, count=1)
    label = escape(alt, quote=True)
    return body.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
