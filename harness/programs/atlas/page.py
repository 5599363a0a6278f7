"""The atlas of limits: a page with sliders that needs no network, and its picture."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from markupsafe import Markup

from harness.programs.atlas.tables import Row
from harness.report.blocks import COLOURS, GREY, INK, plain_decades, save_png, template
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = (*COLOURS, INK, GREY)
DASHES = {"-": "", "--": "7 4", ":": "2 4"}
"""Line styles for numbers of frames, from least to most: Matplotlib's names, and the dashes in
SVG."""


def atlas_html(
    rows: Sequence[Row], warnings: Sequence[str], about: Mapping[str, Any], command: str
) -> str:
    """Return the page, on which a user chooses damage, size, distance and frames and sees which
    cameras find it."""
    page_data = {
        "curves": _curves(rows),
        "colours": PALETTE,
        "dashes": list(DASHES.values()),
    }
    text = json.dumps(page_data, separators=(",", ":"), allow_nan=False)
    worst = max((row.surface.error for row in rows), default=float("nan"))
    return template("atlas.html", Path(__file__).parent).render(
        title="Which camera finds it, how far away, with how many frames?",
        answer="",
        data=Markup(text.replace("<", "\\u003c")),
        warnings=warnings,
        error=f"{100 * worst:.0f}",
        experiment=about.get("experiment", "a study"),
        commit=about.get("commit", "not recorded"),
        command=command,
    )


def _curves(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the limits against distance of each camera, damage, detector and position, with four
    digits."""
    curves: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        settings: dict[str, Any] = {
            "camera": row.title,
            "damage": row.damage,
            "detector": row.surface.detector,
        }
        settings.update(row.position)
        distance_m = settings.pop("distance_m")
        curve = curves.setdefault(tuple(settings.values()), settings)
        numbers = {
            "distance_m": distance_m,
            "a90": row.answer.a90_mm,
            "low": row.answer.low_mm,
            "high": row.answer.high_mm,
            "largest": row.answer.largest_mm,
        }
        for name, value in numbers.items():
            rounded = float(f"{value:.4g}") if np.isfinite(value) else None
            curve.setdefault(name, []).append(rounded)
    return list(curves.values())


def save_atlas_png(path: Path, rows: Sequence[Row]) -> None:
    """Draw a90 against distance for each camera with the fewest and the most frames. Each damage
    that has a limit in at least half of the places gets a panel. If there are several albedos, the
    brightest target is drawn."""
    albedos = sorted({row.position["albedo"] for row in rows if "albedo" in row.position})
    rows = [row for row in rows if row.position.get("albedo") in (None, *albedos[-1:])]
    damages = _damages_with_limits(rows)
    titles = list(dict.fromkeys(row.title for row in rows))
    frames = sorted({int(row.position["frames"]) for row in rows})
    fewest_frames = frames[0]
    most_frames = frames[-1]
    styles = {fewest_frames: "--", most_frames: "-"}
    detector = rows[0].surface.detector
    columns = len(damages) if len(damages) <= 3 else 2
    columns = max(1, columns)
    lines = max(1, -(-len(damages) // columns))

    def draw(figure: Figure) -> None:
        axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
        for panel in axes.ravel()[len(damages) :]:
            panel.set_axis_off()
        for panel, damage in zip(axes.ravel(), damages, strict=False):
            for count, style in styles.items():
                for title, colour in zip(titles, PALETTE, strict=False):
                    curve = [
                        row
                        for row in rows
                        if (row.damage, row.title, row.surface.detector)
                        == (damage, title, detector)
                        and row.position["frames"] == count
                    ]
                    _draw_curve(panel, curve, style, colour, title if count == most_frames else "")
            panel.set(title=damage, yscale="log")
            plain_decades(panel.yaxis)
        for panel in axes[-1]:
            panel.set_xlabel("distance (m)")
        for panel in axes[:, 0]:
            panel.set_ylabel("size found 90 % of the time (mm)")
        target = f"target of albedo {albedos[-1]:g}; " if albedos else ""
        bands = f"bands: 95 % intervals, {many(most_frames, 'frame')}"
        figure.suptitle(target + bands, fontsize="medium")
        for count, style in styles.items():
            axes[0, 0].plot([], [], style, color=GREY, label=many(count, "frame"))
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    save_png(path, (3.6 * max(columns, 2), 1.7 + 3.2 * lines), draw)


def _damages_with_limits(rows: Sequence[Row]) -> list[str]:
    """Return the damages that have a limit in at least half of the places."""
    damages = [row.damage for row in rows]
    has_limit = pd.Series([np.isfinite(row.answer.a90_mm) for row in rows], index=damages)
    shares = has_limit.groupby(level=0, sort=False).mean()
    return [str(damage) for damage, share in shares.items() if share >= 0.5]


def _draw_curve(
    panel: Axes,
    curve: Sequence[Row],
    style: str,
    colour: str,
    name: str,
) -> None:
    """Draw a camera's limits against distance; a curve with a name has its band."""
    distance_m = [row.position["distance_m"] for row in curve]
    a90_mm = [row.answer.a90_mm for row in curve]
    panel.plot(distance_m, a90_mm, style, color=colour, label=name or None)
    if name:
        low_mm = [row.answer.low_mm for row in curve]
        high_mm = [row.answer.high_mm for row in curve]
        panel.fill_between(distance_m, low_mm, high_mm, color=colour, alpha=0.12, linewidth=0)
