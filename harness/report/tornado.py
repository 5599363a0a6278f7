"""The tornado chart: how far each unknown alone moves a90, largest first. It is a template, because
Matplotlib would take 0.1 s for each set-up, thirty times as long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.evaluation.study.result import SetUpResult
from harness.evaluation.study.unknowns import UnknownEffect
from harness.report.blocks import template
from harness.tables.unknowns import level_text, unknown_names

WIDTH_PX = 500
"""Its text is then readable on a screen of 400 pixels."""
ROW_PX = 36
BAR_PX = 20
TOP_PX = 6
BELOW_PX = 66
"""Height of the axis with its title, and of the key."""
KEY_PX = 180
"""Distance of the entries of the key."""
MARGIN_PX = 16
LETTER_PX = 6.6
"""About the mean width of a letter; names on the left have as much room as the longest needs."""
LEVEL_LETTER_PX = 6.0
GAP_PX = 6
"""Distance of a value from the end of its bar."""
ROOM = 1.3
"""Right end of the axis over the largest size inspected."""
MOST_TICKS = 7


@dataclass(frozen=True)
class _Axis:
    """The axis of sizes."""

    left_px: float
    """Its left end."""
    right_px: float
    """Its right end."""
    low_mm: float
    """The size at its left end."""
    high_mm: float
    """The size at its right end; larger ones are drawn there."""

    def px(self, size_mm: float) -> float:
        """Return where a size stands."""
        share = (min(size_mm, self.high_mm) - self.low_mm) / (self.high_mm - self.low_mm)
        return round(self.left_px + share * (self.right_px - self.left_px), 1)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Return the round sizes on the axis, in steps of 1, 2 or 5, with their texts."""
        decade = 10.0 ** np.floor(np.log10((self.high_mm - self.low_mm) / MOST_TICKS))
        steps = decade * np.array([1.0, 2.0, 5.0, 10.0])
        step_mm = steps[(self.high_mm - self.low_mm) / steps <= MOST_TICKS][0]
        numbers = np.arange(np.ceil(self.low_mm / step_mm), self.high_mm / step_mm)
        return [(self.px(number * step_mm), f"{number * step_mm:.4g}") for number in numbers]


def tornado_figure(result: SetUpResult, stated_mm: float) -> str:
    """Draw a bar for each unknown of a set-up from its smallest a90 to its largest, with the
    interval of each end, and a line at a90 at the stated values."""
    unknowns = result.unknowns
    assert unknowns is not None
    effects = unknowns.effects
    names = [unknown_names(effects)[effect.unknown.key] for effect in effects]
    lines_mm = {"at the stated values": stated_mm, "over all unknowns": result.limit.a90_mm}
    drawn_mm = {text: size_mm for text, size_mm in lines_mm.items() if np.isfinite(size_mm)}
    most_mm = ROOM * result.limit.largest_mm
    low_mm, high_mm = _ends_mm(effects, [*drawn_mm.values()], most_mm)
    axis = _Axis(
        left_px=MARGIN_PX + LETTER_PX * max(len(text) for text in names),
        right_px=WIDTH_PX - MARGIN_PX,
        low_mm=low_mm,
        high_mm=high_mm,
    )
    rows = []
    for number, (text, effect) in enumerate(zip(names, effects, strict=True)):
        rows.append({"name": text, "y": TOP_PX + ROW_PX * (number + 0.5), **_bar(effect, axis)})
    lines = []
    for number, (text, size_mm) in enumerate(drawn_mm.items()):
        line = {
            "x": axis.px(size_mm),
            "name": text,
            "dashes": "5 3" if text == "at the stated values" else "none",
            "key_x": axis.left_px + KEY_PX * number,
        }
        lines.append(line)
    bottom_px = TOP_PX + ROW_PX * len(rows)
    return template("tornado.svg").render(
        alt=f"How far each unknown moves a90 of {result.limit.record.label}, as unknowns.csv says.",
        width=WIDTH_PX,
        height=bottom_px + BELOW_PX,
        left=axis.left_px,
        right=axis.right_px,
        top=TOP_PX,
        bottom=bottom_px,
        bar=BAR_PX,
        rows=rows,
        ticks=axis.ticks,
        lines=lines,
    )


def _ends_mm(
    effects: Sequence[UnknownEffect], further_mm: Sequence[float], most_mm: float
) -> tuple[float, float]:
    """Return the ends of the axis: of all that is drawn up to ``most_mm``, with a margin."""
    sizes_mm = list(further_mm)
    for effect in effects:
        sizes_mm += effect.a90_mm.tolist()
        for level in (effect.lowest_level, effect.highest_level):
            interval = effect.intervals_mm[level]
            sizes_mm += [interval.low, interval.high]
    drawn_mm = np.clip([size for size in sizes_mm if np.isfinite(size)], 0.0, most_mm)
    margin_mm = 0.05 * float(np.ptp(drawn_mm)) or 0.05 * most_mm
    low_mm = max(float(drawn_mm.min()) - margin_mm, 0.0)
    return low_mm, min(float(drawn_mm.max()) + margin_mm, most_mm)


def _bar(effect: UnknownEffect, axis: _Axis) -> dict[str, Any]:
    """Return what the template shows of an unknown: its bar, pale if its effect may be chance, and
    the value and the interval at each end."""
    start_px = axis.px(float(effect.a90_mm[effect.lowest_level]))
    end_px = axis.px(float(effect.a90_mm[effect.highest_level]))
    ends = []
    for level, x_px, side in (
        (effect.lowest_level, start_px, -1),
        (effect.highest_level, end_px, 1),
    ):
        interval = effect.intervals_mm[level]
        text = level_text(effect, level)
        room_px = GAP_PX + LEVEL_LETTER_PX * len(text)
        is_inside = axis.left_px < x_px + side * room_px < axis.right_px
        at_edge_px = axis.right_px if side > 0 else axis.left_px
        ends.append(
            {
                "side": side,
                "line": (axis.px(max(interval.low, axis.low_mm)), axis.px(interval.high)),
                "text": text,
                "x": x_px + side * GAP_PX if is_inside else at_edge_px,
                "anchor": "start" if (side > 0) == is_inside else "end",
            }
        )
    return {
        "bar": (start_px, round(end_px - start_px, 1)),
        "colour": "blue" if effect.beyond_chance else "line",
        "ends": ends,
    }
