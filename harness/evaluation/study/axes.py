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

from harness.evaluation.intervals import Interval
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.over_boards import percentiles
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
        """Whether the interval leaves out 1."""
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
        """Whether the axis can be drawn to scale."""
        return all(isinstance(value, int | float) and not isinstance(value, bool) for value in self.values)


def axis_lines(limits: Sequence[SetUpLimit]) -> tuple[AxisLine, ...]:
    """Every line of two set-ups or more, axis by axis; frames last."""
    places = [{**limit.record.axes, FRAMES: limit.record.frames} for limit in limits]
    axes = list(dict.fromkeys(name for place in places for name in place))
    lines = []
    for axis in axes:
        groups: dict[str, list[int]] = {}
        for index, place in enumerate(places):
            if axis in place:
                held = {name: value for name, value in place.items() if name != axis}
                groups.setdefault(canonical_json(held), []).append(index)
        for members in groups.values():
            ordered = _ascending([(places[index][axis], limits[index]) for index in members])
            if len(ordered) > 1:
                held = {name: value for name, value in places[members[0]].items() if name != axis}
                lines.append(_line(axis, held, ordered))
    return tuple(lines)


def difference(frm: SetUpLimit, to: SetUpLimit) -> Difference:
    """How a90 changes from one set-up to another."""
    paired = _same_boards(frm, to)
    before, after = frm.a90_draws_mm, to.a90_draws_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = after / before if paired else np.divide.outer(after, before).ravel()
        return Difference(frm, to, float(np.divide(to.a90_mm, frm.a90_mm)), percentiles(ratios), paired)


def _same_boards(frm: SetUpLimit, to: SetUpLimit) -> bool:
    """Boards of one family keep number, places and sizes where something else is changed, such as depth or albedo.
    Those whose trials failed in one of the two are missing there, and draws of different boards are no pairs."""
    a, b = frm.record.inspected, to.record.inspected
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("board", "hole", "x_mm", "y_mm"))


def _ascending(members: list[tuple[Any, SetUpLimit]]) -> list[tuple[Any, SetUpLimit]]:
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value, _ in members)
    return sorted(members, key=lambda member: member[0]) if numbers else members


def _line(axis: str, held: Mapping[str, Any], ordered: list[tuple[Any, SetUpLimit]]) -> AxisLine:
    limits = tuple(limit for _, limit in ordered)
    return AxisLine(
        axis=axis,
        held=held,
        values=tuple(value for value, _ in ordered),
        limits=limits,
        steps=tuple(difference(one, other) for one, other in pairwise(limits)),
        whole=difference(limits[0], limits[-1]),
    )
