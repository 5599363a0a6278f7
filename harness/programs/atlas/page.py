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
    curves: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        place = {axis: value for axis, value in row.place.items() if axis != "distance_m"}
        named = {
            "camera": row.title,
            "damage": row.damage,
            "detector": row.surface.detector,
            **place,
        }
        curve = curves.setdefault(tuple(named.values()), named)
        answer = row.answer
        for name, value in (("distance_m", row.place["distance_m"]), ("a90", answer.a90_mm), ("low", answer.low_mm),
                            ("high", answer.high_mm), ("largest", answer.largest_mm)):  # fmt: skip
            curve.setdefault(name, []).append(float(f"{value:.4g}") if np.isfinite(value) else None)
    lines = {"curves": list(curves.values()), "colours": PALETTE, "dashes": list(DASHES.values())}
    data = json.dumps(lines, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    worst = max((row.surface.error for row in rows), default=float("nan"))
    return template("atlas.html", Path(__file__).parent).render(
        title="Which camera finds it, how far away, with how many frames?",
        answer="",
        data=Markup(data),
        warnings=warnings,
        error=f"{100 * worst:.0f}",
        experiment=about.get("experiment", "a study"),
        commit=about.get("commit", "not recorded"),
        command=command,
    )


def save_atlas_png(path: Path, rows: Sequence[Row]) -> None:
    """Draw a90 against distance for each camera with the fewest and the most frames. Each damage
    that has a limit in at least half of the places gets a panel. If there are several albedos, the
    brightest target is drawn."""
    albedos = sorted({row.place["albedo"] for row in rows if "albedo" in row.place})
    rows = [row for row in rows if row.place.get("albedo") in (None, *albedos[-1:])]
    known = pd.Series(
        [np.isfinite(row.answer.a90_mm) for row in rows], index=[row.damage for row in rows]
    )
    damages = [
        damage
        for damage, share in known.groupby(level=0, sort=False).mean().items()
        if share >= 0.5
    ]
    titles = list(dict.fromkeys(row.title for row in rows))
    counts = sorted({int(row.place["frames"]) for row in rows})
    shown = {counts[0]: "--", counts[-1]: "-"}
    detector = rows[0].surface.detector

    def draw(figure: Figure) -> None:
        axes = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
        for panel in axes.ravel()[len(damages) :]:
            panel.set_axis_off()
        for panel, damage in zip(axes.ravel(), damages, strict=False):
            for frames, style in shown.items():
                for title, colour in zip(titles, PALETTE, strict=False):
                    wanted = (damage, title, detector)
                    line = [
                        row
                        for row in rows
                        if (row.damage, row.title, row.surface.detector) == wanted
                    ]
                    line = [row for row in line if row.place["frames"] == frames]
                    x = [row.place["distance_m"] for row in line]
                    names = ("low_mm", "a90_mm", "high_mm")
                    low, middle, high = (
                        [getattr(row.answer, name) for row in line] for name in names
                    )
                    panel.plot(
                        x,
                        middle,
                        style,
                        color=colour,
                        label=title if frames == counts[-1] else None,
                    )
                    if frames == counts[-1]:
                        panel.fill_between(x, low, high, color=colour, alpha=0.12, linewidth=0)
            panel.set(title=damage, yscale="log")
            plain_decades(panel.yaxis)
        for panel in axes[-1]:
            panel.set_xlabel("distance (m)")
        for panel in axes[:, 0]:
            panel.set_ylabel("size found 90 % of the time (mm)")
        target = f"target of albedo {albedos[-1]:g}; " if albedos else ""
        figure.suptitle(
            f"{target}bands: 95 % intervals, {many(counts[-1], 'frame')}", fontsize="medium"
        )
        for frames, style in shown.items():
            axes[0, 0].plot([], [], style, color=GREY, label=many(frames, "frame"))
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3)

    columns = max(1, len(damages) if len(damages) <= 3 else 2)
    lines = max(1, -(-len(damages) // columns))
    save_png(path, (3.6 * max(columns, 2), 1.7 + 3.2 * lines), draw)
