"""The thesis' claims on several views (C7, C8, C10) and its proposal (H1), as criteria that are the same for every run.

As in `harness.evaluation.claim_rules` a verdict needs certainty in either direction. Repeats vary the noise and the
error of the nominal poses; the poses, the board and the camera's unit stay the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.claim_maps import claim_c10, claim_h1
from harness.evaluation.claim_rules import Verdict, decide, hole_list
from harness.evaluation.intervals import Interval, bootstrap, wilson
from harness.evaluation.map_case import (
    THESIS_MERGE,
    THESIS_REGISTRATION,
    AgainstOne,
    MapCase,
    against_one,
)
from harness.evaluation.map_text import change_text, frames_text, ratio_text, span
from harness.evaluation.registration import of_map, paired_ratio, per_unit, trusted

if TYPE_CHECKING:
    import pandas as pd


C7 = "ICP and CPD both bring the fiducials of two views into one plane; CPD aligns them better within it."
C7_RULE = (
    "Judged on the registration of the second view to the first with 50 frames (else the most). A method brings the "
    "fiducials into one plane when its median target registration error across the board is at most the noise of a "
    "single cloud's fitted surface (95 % bootstrap interval over repeats wholly at or below it; wholly above refutes), "
    "and does not where most of its registrations failed. CPD aligns better when its error in the plane, over ICP's in "
    "the same repeat, has a geometric mean below 1 (95 % Student interval of the logarithm); above 1 refutes."
)
C8 = (
    "Two merged views size holes of 3/8 in and larger better than one view and smaller ones worse; merging raises the "
    "threshold."
)
C8_RULE = (
    "By the thesis' measure, with its registration (CPD) and merging (grid), with 50 frames (else the most), paired by "
    "repeat: the mean of |size error| over the holes of 3/8 in and larger falls, over the smaller holes it grows, and "
    "the calibrated threshold in mm is higher (95 % Student intervals over repeats). A hole is compared where both "
    "measure it twice at least; where no smaller hole is compared, the second part holds if one view finds a hole that "
    "two views miss. One part on the wrong side refutes."
)


def claim_c7(case: MapCase) -> Verdict:
    """Both methods bring the fiducials into one plane; CPD aligns better within it."""
    one = case.single()
    if one is None:
        return Verdict("C7", C7, "undecided", "Not judged: no single view stands beside the registrations.", C7_RULE)
    rows = case.registrations(one.frames)
    pairs = {method: of_map(rows, method, 2) for method in dict.fromkeys(rows["method"])}
    if not {"icp", "cpd"} <= set(pairs):
        return Verdict("C7", C7, "undecided", "Not judged: ICP and CPD were not both tried.", C7_RULE)
    runs = case.runs(one)
    noise_mm = float(runs["surface_noise_mm"][runs["role"] == "damaged"].median())
    planes = [_in_one_plane(pairs[method], noise_mm) for method in ("icp", "cpd")]
    ratio, low, high, n = paired_ratio(pairs["icp"], pairs["cpd"], "tre_in_plane_mm")
    better = True if high < 1 else (False if low >= 1 else None)
    said = "; ".join(f"{method} {_error_text(part)}" for method, part in pairs.items())
    evidence = (
        f"With {frames_text(one.frames)}, median error in the plane, across it, and registrations that failed: {said}. "
        f"A single cloud's surface has {noise_mm:.2f} mm of noise. In the plane CPD has {ratio:.2f} times the error of "
        f"ICP ({span(Interval(low, high))}, {n} pairs). {_all_views(rows)}"
    )
    return Verdict("C7", C7, decide([*planes, better]), evidence, C7_RULE)


def claim_c8(case: MapCase) -> Verdict:
    """Two views against one: better sizes of large holes, worse of small ones, a higher threshold."""
    found = against_one(case, THESIS_REGISTRATION, THESIS_MERGE)
    if found is None:
        why = "one and two views, registered by CPD and merged on the grid, were not both finished"
        return Verdict("C8", C8, "undecided", f"Not judged: {why}.", C8_RULE)
    small = found.small.is_above
    if not found.small.n and found.lost:
        small = True
    answer = decide([found.large.is_below, small, found.threshold.is_above])
    return Verdict("C8", C8, answer, _against_text(found), C8_RULE)


VIEW_CLAIMS = {"C7": claim_c7, "C8": claim_c8, "C10": claim_c10, "H1": claim_h1}


def score_views(cases: Sequence[MapCase]) -> list[Verdict]:
    """A verdict for each of `VIEW_CLAIMS`; of several places one for each, the evidence saying where."""
    verdicts = []
    for rule in VIEW_CLAIMS.values():
        for case in cases:
            verdict = rule(case)
            where = f"{case.place}: " if len(cases) > 1 else ""
            verdicts.append(replace(verdict, evidence=where + verdict.evidence))
    return verdicts


def _all_views(rows: pd.DataFrame) -> str:
    """What the other views say, which the rule does not judge by: the thesis had one pair."""
    views = rows["view"].nunique()
    if views < 2:
        return ""
    medians = {method: trusted(rows[rows["method"] == method])["tre_in_plane_mm"].median() for method in ("icp", "cpd")}
    said = ", ".join(f"{method} {median:.2f}" for method, median in medians.items())
    return f"Over all {views} further views (not judged): {said} mm in the plane."


def _in_one_plane(rows: pd.DataFrame, noise_mm: float) -> bool | None:
    """Whether a method's error across the board is at most the noise of a surface."""
    failed = len(rows) - len(trusted(rows))
    if wilson(failed, len(rows))[0] > 0.5:
        return False
    across = per_unit(rows, "tre_across_mm").to_numpy(float)
    if not len(across):
        return None
    interval = bootstrap(lambda chosen: np.median(across[chosen], axis=1), len(across))
    if interval.known and interval.high <= noise_mm:
        return True
    return False if interval.above(noise_mm) else None


def _error_text(rows: pd.DataFrame) -> str:
    good = trusted(rows)
    plane, across = (float(good[f"tre_{part}_mm"].median()) for part in ("in_plane", "across"))
    return f"{plane:.2f} and {across:.2f} mm, {len(rows) - len(good)} of {len(rows)}"


def _against_text(found: AgainstOne) -> str:
    holes = [
        f"{hole} {change.mean:+.2f}" for hole, change in zip(found.sizes.holes, found.sizes.by_hole(), strict=True)
    ]
    crossing = found.sizes.crossing_mm
    turn = "The change has no crossing."
    if np.isfinite(crossing):
        turn = f"It turns at {crossing:.1f} mm ({span(found.sizes.crossing_interval, 1)})."
    parts = [
        f"With {frames_text(found.one.frames)}, two views less one, |size error| of holes from 3/8 in on "
        f"{change_text(found.large)}, of smaller ones {change_text(found.small)}.",
        f"By hole (mm): {', '.join(holes)}. {turn}",
        f"Threshold {change_text(found.threshold)}, surface noise {ratio_text(found.noise)}.",
    ]
    parts += [f"Found by one view only: {hole_list(found.lost)}."] if found.lost else []
    parts += [f"Found by two views only: {hole_list(found.gained)}."] if found.gained else []
    return " ".join(parts)
