"""Limits against each swept axis, and which of their differences are beyond chance.

Set-ups that differ in one axis alone stand in one line. Where they were judged on the same boards, the ratio of their
a90 is taken draw by draw of boards, so that what boards do to both cancels; else every draw of one over every draw of
the other. Each interval holds for itself, and is a little narrow: of differences that are none, on the same boards of
eight damages, 9 % are called beyond chance with 20 boards and 8 % with 60, not 5 % (300 and 900 pairs of studies).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from harness.evaluation.intervals import Interval, percentiles
from harness.evaluation.study.limit import SetUpLimit
from harness.vocabulary.seeds import canonical_json

FRAMES = "capture.frames"
"""The dotted path of the axis that every experiment has."""


@dataclass(frozen=True, eq=False)
class Difference:
    """a90 of ``to`` over that of ``frm``, with its 95 % interval over boards; ``paired``: judged on the same boards.

    Infinite draws of both are no ratio and are left out; the interval is unknown where they are more than half.
    """

    frm: SetUpLimit
    to: SetUpLimit
    ratio: float
    interval: Interval
    paired: bool

    @property
    def beyond_chance(self) -> bool:
        """Return whether the interval leaves out 1."""
        return self.interval.above(1.0) or self.interval.below(1.0)


@dataclass(frozen=True, eq=False)
class AxisLine:
    """Set-ups that differ in ``axis`` (a dotted path) alone: ``values`` and ``limits`` in ascending order, text as
    declared; ``held``: what the other axes are at. ``steps``: from each to the next, ``whole``: from first to last."""

    axis: str
    held: Mapping[str, Any]
    values: tuple[Any, ...]
    limits: tuple[SetUpLimit, ...]
    steps: tuple[Difference, ...]
    whole: Difference

    @property
    def numeric(self) -> bool:
        """Return whether the axis can be drawn to scale."""
        return all(_is_number(value) for value in self.values)


def axis_lines(limits: Sequence[SetUpLimit]) -> tuple[AxisLine, ...]:
    """Find every line of two set-ups or more, axis by axis; frames last."""
    places = [{**limit.record.axes, FRAMES: limit.record.frames} for limit in limits]
    lines = []
    for axis in dict.fromkeys(name for place in places for name in place):
        groups: dict[str, list[int]] = {}
        for index, place in enumerate(places):
            if axis in place:
                groups.setdefault(canonical_json({name: place[name] for name in place if name != axis}), []).append(
                    index
                )
        for members in groups.values():
            if all(_is_number(places[index][axis]) for index in members):
                members = sorted(members, key=lambda index: places[index][axis])
            if len(members) > 1:
                line = tuple(limits[index] for index in members)
                lines.append(
                    AxisLine(
                        axis=axis,
                        held={name: value for name, value in places[members[0]].items() if name != axis},
                        values=tuple(places[index][axis] for index in members),
                        limits=line,
                        steps=tuple(difference(one, other) for one, other in pairwise(line)),
                        whole=difference(line[0], line[-1]),
                    )
                )
    return tuple(lines)


def difference(frm: SetUpLimit, to: SetUpLimit) -> Difference:
    """Compare a90 of one set-up with that of another.

    Boards of one family keep number, places and sizes where something else is changed, such as depth or albedo. Those
    whose trials failed in one of the two are missing there, and draws of different boards are no pairs.
    """
    a, b = frm.record.inspected, to.record.inspected
    paired = all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("board", "hole", "x_mm", "y_mm"))
    before, after = frm.a90_draws_mm, to.a90_draws_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = after / before if paired else np.divide.outer(after, before).ravel()
        return Difference(frm, to, float(np.divide(to.a90_mm, frm.a90_mm)), percentiles(ratios), paired)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
