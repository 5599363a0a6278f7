"""The headline of a study that compares its boards with several references and with none: what a
reference buys, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from harness.evaluation.study.limit import SetUpLimit
from harness.vocabulary.path_names import value_text
from harness.vocabulary.seeds import canonical_json

AXIS = "compared_with"
CHANCE = 0.05
"""Probability that one of the references seems to help everywhere without helping."""


@dataclass(frozen=True)
class Gain:
    """The damage found with one reference beside that without, in each kind of set-up."""

    name: str
    """The reference, in words."""
    shares: np.ndarray
    """(n,): share of the damages found with it."""
    without: np.ndarray
    """(n,): share found with no reference."""
    p_values: np.ndarray
    """(n,): probability of so large a gain by chance, over boards."""


def reference_headline(limits: Sequence[SetUpLimit]) -> str:
    """Return which reference finds most, at worst over all set-ups, beside none, and whether any
    of them helps everywhere beyond chance; empty for a study without this axis."""
    gains = reference_gains(limits)
    if not gains:
        return ""
    best = max(gains, key=lambda gain: float(gain.shares.min()))
    helping = [gain for gain in gains if gain.p_values.max() < CHANCE / len(gains)]
    if not helping:
        return (
            f"No reference clearly helps everywhere: {_range(best.shares)} found with {best.name},"
            f" {_range(best.without)} without."
        )
    best = max(helping, key=lambda gain: float(gain.shares.min()))
    return (
        f"With {best.name} {_range(best.shares)} of the damage is found, without a reference"
        f" {_range(best.without)}."
    )


def reference_gains(limits: Sequence[SetUpLimit]) -> list[Gain]:
    """Return the gain by each reference over no reference, in set-ups that are alike but for it;
    none where a kind of set-up lacks either."""
    kinds: dict[str, dict[str, SetUpLimit]] = {}
    names: dict[str, None] = {}
    for limit in limits:
        axes = dict(limit.record.axes)
        if AXIS not in axes or not limit.inspections:
            return []
        name = value_text(AXIS, axes.pop(AXIS))
        names[name] = None
        kind = canonical_json([axes, limit.record.frames])
        kinds.setdefault(kind, {})[name] = limit
    none = value_text(AXIS, None)
    if none not in names or any(len(members) < len(names) for members in kinds.values()):
        return []
    gains = []
    for name in names:
        if name == none:
            continue
        pairs = [(members[name], members[none]) for members in kinds.values()]
        gains.append(
            Gain(
                name=name,
                shares=np.array([limit.hits / limit.inspections for limit, _ in pairs]),
                without=np.array([limit.hits / limit.inspections for _, limit in pairs]),
                p_values=np.array([_p_value(limit, without) for limit, without in pairs]),
            )
        )
    return gains


def _p_value(limit: SetUpLimit, without: SetUpLimit) -> float:
    """Return the probability of so large a mean gain in hits a board if there is none: a t-test on
    the differences between boards, which two set-ups share."""
    boards = np.unique(without.record.inspected.board)
    gained = _hits(limit, boards) - _hits(without, boards)
    if len(boards) < 2 or not gained.std():
        return 0.0 if len(boards) > 1 and gained.mean() > 0 else 1.0
    statistic = gained.mean() / gained.std(ddof=1) * np.sqrt(len(boards))
    return float(special.stdtr(len(boards) - 1, -statistic))


def _hits(limit: SetUpLimit, boards: np.ndarray) -> np.ndarray:
    """Return the number of hits (n,) on each of these boards."""
    inspected = limit.record.inspected
    return np.array([inspected.hit[inspected.board == board].sum() for board in boards], float)


def _range(shares: np.ndarray) -> str:
    """Return ``60 to 71 %``, or ``60 %`` of one share."""
    low = f"{100 * shares.min():.0f}"
    high = f"{100 * shares.max():.0f}"
    return f"{low} %" if low == high else f"{low} to {high} %"
