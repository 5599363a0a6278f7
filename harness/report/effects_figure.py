"""Figure: what each effect costs of the detection limit, alone and beside all others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.set_ups import EffectCosts, SwitchCost
from harness.report.canvas import BLUE, GREY, INK, ORANGE, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def cost_text(cost: SwitchCost) -> str:
    """``+0.42 mm (0.30 to 0.55)``; a bound where a size lies off the ladder."""
    if not np.isfinite(cost.mm):
        return "off the ladder of sizes" if np.isnan(cost.mm) else f"{'+' if cost.mm > 0 else '−'}∞"
    low, high = (f"{end:+.2f}" if np.isfinite(end) else "∞" for end in (cost.interval.low, cost.interval.high))
    bound = "" if cost.certain else ", a bound: a size lies off the ladder"
    return f"{cost.mm:+.2f} mm ({low} to {high}{bound})".replace("-", "−")


def effects_figure(costs: Sequence[EffectCosts]) -> str:
    """Bars of every effect's cost with 95 % intervals, one panel for each place and number of frames."""
    names = [one.effect for one in costs[0].effects]

    def draw(figure: Figure) -> None:
        panels = figure.subplots(1, len(costs), squeeze=False, sharex=True, sharey=True)[0]
        for axes, one in zip(panels, costs, strict=True):
            _bars(axes, one)
            axes.set_title("1 frame" if one.frames == 1 else f"{one.frames} frames averaged")
            axes.set_xlabel("loss of the 50 % size (mm)")
            axes.axvline(0, color=GREY, lw=1)
            axes.grid(axis="y", visible=False)
        panels[0].set_yticks(range(len(names) + 1), [*names, "all together"])
        panels[0].invert_yaxis()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)

    alt = "Loss of the 50 per cent detectable diameter in millimetres to each effect, alone and on top of the others."
    return svg("effects", (10, 0.42 * (len(names) + 1) + 1.6), alt, draw)


def _bars(axes: Axes, costs: EffectCosts) -> None:
    places = np.arange(len(costs.effects), dtype=float)
    alone = [one.alone for one in costs.effects]
    last = [one.last for one in costs.effects]
    for shift, colour, label, chosen, where in (
        (-0.2, BLUE, "alone, against nothing on", [*alone, costs.together], [*places, float(len(places))]),
        (0.2, ORANGE, "on top of all the others", last, list(places)),
    ):
        sizes = np.array([one.mm if np.isfinite(one.mm) else 0.0 for one in chosen])
        ends = np.array([[one.interval.low, one.interval.high] for one in chosen])
        ends = np.where(np.isfinite(ends), ends, sizes[:, None])
        errors = np.abs(ends - sizes[:, None]).T
        axes.barh(np.array(where) + shift, sizes, 0.36, xerr=errors, color=colour, label=label, ecolor=INK, capsize=2)
        for place, one in zip(where, chosen, strict=True):
            if not np.isfinite(one.mm):
                axes.text(0, place + shift, " off the ladder", va="center", fontsize=8, color=GREY)
