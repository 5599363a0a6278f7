"""The page of an answer of the atlas, with sliders that need no network, and its picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from harness.programs.atlas.tables import Row
from harness.report.blocks import COLOURS, plain_decades, save_png, template
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PALETTE = ("blue", "orange", "green", "red", "sky", "purple")
"""The page's colours of lines, by their CSS variables; as many cameras are drawn."""


def atlas_html(
    lines: Sequence[Row],
    rows: Sequence[Row],
    answer: str,
    *,
    warnings: Sequence[str],
    notes: Sequence[str],
    command: str,
) -> str:
    """Return the page, which opens at the question. ``lines``: rows along all curves; ``rows``:
    those of the question, the best first."""
    best = rows[0]
    opens = {
        "size_mm": None if np.isnan(best.size_mm) else best.size_mm,
        "distance_m": best.conditions.distance_m,
        "frames": best.conditions.frames,
        "albedo": best.conditions.albedo,
    }
    page_data = {"curves": _curves(lines), "colours": PALETTE, "opens": opens}
    text = json.dumps(page_data, separators=(",", ":"), allow_nan=False)
    return template("atlas.html", Path(__file__).parent).render(
        title="Which camera finds it?",
        answer=answer,
        data=Markup(text.replace("<", "\\u003c")),
        warnings=warnings,
        notes=notes,
        damage=best.damage,
        command=command,
    )


def _curves(lines: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the limits against distance of each camera, albedo and number of frames, with four
    digits."""
    curves: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in lines:
        settings = {
            "camera": row.surface.title,
            "albedo": row.conditions.albedo,
            "frames": row.conditions.frames,
        }
        curve = curves.setdefault(tuple(settings.values()), dict(settings))
        numbers = {
            "distance_m": row.conditions.distance_m,
            "a90": row.answer.a90_mm,
            "low": row.answer.low_mm,
            "high": row.answer.high_mm,
            "found": row.answer.found_mm,
            "missed": row.answer.missed_mm,
            "lost": row.answer.lost_mm,
            "error": row.answer.size_error,
        }
        for name, value in numbers.items():
            curve.setdefault(name, []).append(_rounded(value))
    return list(curves.values())


def _rounded(value: float) -> float | None:
    """Return a number with four digits, or None if it is not finite."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def save_atlas_png(path: Path, lines: Sequence[Row]) -> None:
    """Draw a90 against distance of the six cameras that find the smallest damage on the brightest
    target, with their 95 % intervals: a panel for each number of frames."""
    albedo = max(row.conditions.albedo for row in lines)
    counts = sorted({row.conditions.frames for row in lines})
    drawn = [row for row in lines if row.conditions.albedo == albedo]
    titles = _best_titles(drawn, counts[-1])

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(counts), sharex=True, sharey=True, squeeze=False)[0]
        for panel, count in zip(panels, counts, strict=True):
            for title, colour in zip(titles, COLOURS, strict=False):
                curve = [
                    row
                    for row in drawn
                    if (row.surface.title, row.conditions.frames) == (title, count)
                ]
                distance_m = [row.conditions.distance_m for row in curve]
                low_mm = [max(row.answer.low_mm, row.answer.sizes_mm[0]) for row in curve]
                high_mm = [min(row.answer.high_mm, row.answer.sizes_mm[-1]) for row in curve]
                panel.plot(
                    distance_m, [row.answer.a90_mm for row in curve], color=colour, label=title
                )
                is_known = np.isfinite([row.answer.a90_mm for row in curve])
                panel.fill_between(
                    distance_m, low_mm, high_mm, where=is_known, color=colour, alpha=0.12, lw=0
                )
            panel.set(title=many(count, "frame"), xscale="log", yscale="log")
            panel.set_xlabel("distance (m)")
            plain_decades(panel.xaxis)
            plain_decades(panel.yaxis)
        panels[0].set_ylabel("size found 90 % of the time (mm)")
        figure.suptitle(f"{lines[0].damage}, albedo {albedo:g}", fontsize="medium")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)

    save_png(path, (3.6 * max(len(counts), 2), 4.9), draw)


def _best_titles(rows: Sequence[Row], frames: int) -> list[str]:
    """Return the titles of the cameras with the smallest limit in the middle of all distances."""
    sizes: dict[str, list[float]] = {}
    for row in rows:
        if row.conditions.frames == frames and np.isfinite(row.answer.a90_mm):
            sizes.setdefault(row.surface.title, []).append(row.answer.a90_mm)
    ranked = sorted(sizes, key=lambda title: float(np.median(sizes[title])))
    return ranked[: len(PALETTE)]
