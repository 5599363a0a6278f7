"""Figure: false calls of each set-up with their interval, beside the rate that its threshold was calibrated to."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.report.canvas import BLUE, ORANGE, RED, svg
from harness.report.pod import plain
from harness.report.study_rows import name_of, rate_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_ROWS = 40
"""Set-ups up to which a figure can be read; the table has all."""


def calls_figure(limits: Sequence[SetUpLimit], wanted_per_m2: float | None) -> str:
    """A line for each set-up with hole-free boards: estimate, exact Poisson interval, interval over boards."""
    shown = [limit for limit in limits if limit.false_calls is not None][:MOST_ROWS]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        for row, limit in enumerate(shown):
            calls = limit.false_calls
            assert calls is not None
            ends = calls.interval_per_m2
            axes.plot([ends.low, ends.high], [row - 0.12] * 2, color=BLUE, lw=2.2, solid_capstyle="butt")
            axes.plot([calls.rate_per_m2], [row - 0.12], "o", color=BLUE, ms=6)
            over = limit.false_calls_interval_per_m2
            if over.known:
                axes.plot([over.low, over.high], [row + 0.16] * 2, color=ORANGE, lw=2.2, solid_capstyle="butt")
        axes.plot([], [], "o-", color=BLUE, ms=6, lw=2.2, label="found, exact Poisson interval (95 %)")
        axes.plot([], [], color=ORANGE, lw=2.2, label="interval over boards (95 %)")
        if wanted_per_m2 is not None:
            axes.axvline(wanted_per_m2, color=RED, lw=1.4, ls="--", label=f"wanted: {wanted_per_m2:g} per m²")
        axes.set_yticks(
            np.arange(len(shown)), [plain(fill(name_of(limit), 40, break_long_words=False)) for limit in shown]
        )
        axes.set(ylim=(len(shown) - 0.4, -0.6), xlabel="false calls per m²")
        axes.set_xlim(left=0)
        axes.grid(axis="y", visible=False)
        figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)

    said = "; ".join(f"{name_of(limit)}: {rate_text(limit.false_calls)}" for limit in shown)
    return svg("calls", (8.6, 1.3 + 0.5 * len(shown)), f"False calls per square metre of hole-free face. {said}.", draw)
