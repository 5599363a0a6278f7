"""Which set-up of one study is which of another, and whether the two were measured with the same stick."""

from __future__ import annotations

from collections.abc import Callable, Hashable

import numpy as np

from harness.evaluation.study.record import SetUpRecord, StudyRecord
from harness.vocabulary.seeds import canonical_json

Pair = tuple[SetUpRecord | None, SetUpRecord | None]
OTHER_DAMAGE_P = 0.001
"""Boards drawn anew from one family differ by chance; less likely than this, they are taken for another family."""


def paired_set_ups(first: StudyRecord, second: StudyRecord) -> tuple[Pair, ...]:
    """Pairs by variant and frames; of what is left, by place on the axes and frames; a single one of each is a pair.

    In the order of ``first``; what only one study has stands with None, the second's at the end.
    """
    if len(first.set_ups) == len(second.set_ups) == 1:
        return ((first.set_ups[0], second.set_ups[0]),)
    ways: tuple[Callable[[SetUpRecord], Hashable], ...] = (
        lambda one: (one.variant, one.frames),
        lambda one: (canonical_json(dict(one.axes)), one.frames),
    )
    partner: dict[int, SetUpRecord] = {}
    free = list(second.set_ups)
    for way in ways:
        for place, one in enumerate(first.set_ups):
            found = [other for other in free if way(other) == way(one)] if place not in partner else []
            if len(found) == 1:
                partner[place] = found[0]
                free.remove(found[0])
    pairs: list[Pair] = [(one, partner.get(place)) for place, one in enumerate(first.set_ups)]
    return (*pairs, *((None, one) for one in free))


def not_comparable(first: StudyRecord, second: StudyRecord, one: SetUpRecord, other: SetUpRecord) -> str:
    """Why the two were not measured with the same stick: what a hit is, the wanted false calls, or the damage.

    Empty where they were: another detector, camera, number of frames or noise is what is to be compared.
    """
    if first.hit_radius_mm != second.hit_radius_mm:
        return f"hits within {first.hit_radius_mm:g} mm there, within {second.hit_radius_mm:g} mm here"
    if first.false_calls_per_m2 != second.false_calls_per_m2:
        return f"thresholds for {_wanted(first)} there, for {_wanted(second)} here"
    if bool(one.calibration_runs) != bool(other.calibration_runs):
        return "the threshold of one is calibrated, that of the other given"
    if one.targets_digest == other.targets_digest:
        return ""
    for column, what in (("diameter_mm", "sizes"), ("depth_mm", "depths")):
        if _other_family(one, other, column):
            return f"the damage is of other {what}"
    return ""


def differences(one: SetUpRecord, other: SetUpRecord) -> tuple[str, ...]:
    """What differs and may be the cause, in words."""
    said = []
    if (one.detector, one.detector_version) != (other.detector, other.detector_version):
        said.append(f"{one.detector} {one.detector_version} → {other.detector} {other.detector_version}")
    if one.frames != other.frames:
        said.append(f"frames {one.frames} → {other.frames}")
    for axis in sorted({*one.axes, *other.axes}):
        before, now = one.axes.get(axis, "default"), other.axes.get(axis, "default")
        if before != now:
            said.append(f"{axis} {before} → {now}")
    if one.targets_digest != other.targets_digest:
        said.append("other boards")
    elif one.frames_digest != other.frames_digest:
        said.append("other frames of the same boards")
    return tuple(said)


def _wanted(study: StudyRecord) -> str:
    rate = study.false_calls_per_m2
    return f"{rate:g} false calls per m²" if rate is not None else "no stated rate of false calls"


def _other_family(one: SetUpRecord, other: SetUpRecord, column: str) -> bool:
    """Kolmogorov and Smirnov's test of two samples with as many values as there are boards, since damages of one board
    may be alike: cautious where they are not."""
    from scipy.stats import kstwobign

    tables = (one.inspected, other.inspected)
    values = [np.sort(getattr(table, column)) for table in tables]
    boards = [len(np.unique(table.board)) for table in tables]
    if not min(boards):
        return False
    at = np.concatenate(values)
    shares = [np.searchsorted(one, at, side="right") / len(one) for one in values]
    distance = float(np.abs(shares[0] - shares[1]).max())
    return bool(kstwobign.sf(distance / np.sqrt(1 / boards[0] + 1 / boards[1])) < OTHER_DAMAGE_P)
