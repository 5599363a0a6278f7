"""The thesis' claims as criteria that are the same for every run: one function a claim, each a verdict.

A verdict needs certainty in either direction: where an interval leaves room for both, it is "undecided". Nothing here
is a parameter of the experiment, and nothing is chosen to make a claim come out.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from harness.evaluation.comparisons import falling_rank, scatter_ratio
from harness.evaluation.intervals import Interval, mean_difference, standardised_bias
from harness.evaluation.noise import noise_law
from harness.evaluation.profile import AveragedCloud, HoleShape, hole_shapes
from harness.evaluation.summary import Measure, found_holes

if TYPE_CHECKING:
    import pandas as pd

Answer = Literal["borne out", "not borne out", "undecided"]

FEW, MANY = 1, 50
"""The numbers of frames that the thesis' claims speak of."""
THESIS_HOLES = tuple(str(number) for number in range(1, 12))
FOUND_WITH_MANY, FOUND_WITH_FEW = frozenset(THESIS_HOLES[3:]), frozenset(THESIS_HOLES[4:])
RULER_MM = 25.4 / 16
"""One graduation of a ruler in 1/16 in: what the thesis' reference positions were read with."""
SLOPE_MARGIN = 0.05
"""Exponents within -0.5 +- this count as 1/sqrt(N): over 50 frames it is a factor of 1.22 in noise."""
UNCHANGED = 0.9
"""The systematic error counts as lowered when it falls below this share; the white noise falls to 0.14 meanwhile."""
FEWEST_RANKED = 4
"""With fewer holes even a perfect order has a chance above 1 in 20."""


class Example(AveragedCloud, Protocol):
    """An averaged cloud that knows which variant and how many frames it shows."""

    @property
    def frames(self) -> int: ...
    @property
    def variant(self) -> str: ...


@dataclass(frozen=True)
class Case:
    """What one variant offers to the rules; every table holds this variant's rows only."""

    variant: str
    summary: pd.DataFrame
    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    examples: Sequence[Example] = ()

    def found(self, frames: int) -> pd.DataFrame:
        """Summary rows of the holes found with so many frames."""
        return self.summary[(self.summary["frames"] == frames) & (self.summary["status"] == "found")]


@dataclass(frozen=True)
class Verdict:
    """A claim, what the data say about it, the numbers behind that, and the criterion fixed beforehand."""

    claim: str
    text: str
    verdict: Answer
    evidence: str
    rule: str


def claim_c1(case: Case) -> Verdict:
    """Averaging 50 frames finds holes 4 to 11 and no smaller one."""
    text = "With 50 averaged frames the holes of 1/4 in and larger (4 to 11) are found."
    rule = (
        "Borne out when, with 50 frames, holes 4 to 11 are found and 1 to 3 missed; one hole on the wrong side refutes."
    )
    answer, evidence = _exact_set(case, MANY, FOUND_WITH_MANY)
    return Verdict("C1", text, answer, evidence, rule)


def claim_c2(case: Case) -> Verdict:
    """One frame finds holes 5 to 11 only, because noise forces a higher threshold."""
    text = "A single frame finds holes 5 to 11 only: its noise forces a higher threshold."
    rule = (
        "Borne out when, with 1 frame, holes 5 to 11 are found and 1 to 4 missed, and the calibrated threshold in mm "
        "(k times scale) is higher than with 50 frames (95 % Welch interval of the difference above 0)."
    )
    answer, evidence = _exact_set(case, FEW, FOUND_WITH_FEW)
    higher, threshold = _threshold_change(case.runs)
    set_agrees = {"borne out": True, "not borne out": False, "undecided": None}[answer]
    return Verdict("C2", text, decide([set_agrees, higher]), f"{evidence} {threshold}", rule)


def claim_c3(case: Case) -> Verdict:
    """Each hole's mean size lies within one standard deviation of the true one."""
    text = "From one viewpoint, each hole's mean size lies within one standard deviation of its true size."
    rule = (
        "Judged by the thesis' measure on each hole found with 50 frames: |mean - true| <= 1 standard deviation over "
        "the repeats. Borne out when every hole's 95 % interval of (mean - true)/std lies within -1 to 1; refuted when "
        "one hole's lies outside."
    )
    rows = case.found(MANY)
    if rows.empty:
        return Verdict("C3", text, "undecided", _nothing_found(case), rule)
    extent = {row["hole"]: _standardised(row, "extent") for _, row in rows.iterrows()}
    model = {row["hole"]: _standardised(row, "model") for _, row in rows.iterrows()}
    parts = [_within_one(spread) for spread in extent.values()]
    evidence = (
        f"(mean - true)/std by the thesis' measure: {_per_hole(extent)}. "
        f"By the model of the blurred hole: {_per_hole(model, spans=False)}. "
        f"Within one std: {_share(rows, 'extent')} (thesis' measure), {_share(rows, 'model')} (model)."
    )
    return Verdict("C3", text, decide(parts), evidence, rule)


def claim_c4(case: Case) -> Verdict:
    """The size error grows as the hole shrinks."""
    text = "The error of the measured size grows as the hole shrinks."
    rule = (
        "Spearman's rank correlation between the true diameter and |mean size - true size| (thesis' measure) over the "
        "holes found with 50 frames. Borne out when it is negative with a one-sided permutation p below 0.05; refuted "
        f"when it is zero or positive; undecided between, or with fewer than {FEWEST_RANKED} holes."
    )
    rows = case.found(MANY)
    rows = rows[rows["extent_bias_mm"].notna()]
    if len(rows) < FEWEST_RANKED:
        return Verdict("C4", text, "undecided", f"Only {len(rows)} holes are found with 50 frames.", rule)
    diameter = rows["true_diameter_mm"].to_numpy(float)
    error = rows["extent_bias_mm"].abs().to_numpy(float)
    rho, p = falling_rank(diameter, error)
    relative, p_relative = falling_rank(diameter, error / diameter)
    refuted = not rho < 0
    answer: Answer = "not borne out" if refuted else ("borne out" if p < 0.05 else "undecided")
    smallest, largest = rows.iloc[diameter.argmin()], rows.iloc[diameter.argmax()]
    evidence = (
        f"Rank correlation {rho:+.2f} ({_chance(p)}) over {len(rows)} holes; of the error relative to the size "
        f"{relative:+.2f} ({_chance(p_relative)}). Error {abs(smallest['extent_bias_mm']):.2f} mm at "
        f"{smallest['true_diameter_mm']:.2f} mm, {abs(largest['extent_bias_mm']):.2f} mm at "
        f"{largest['true_diameter_mm']:.2f} mm."
    )
    return Verdict("C4", text, answer, evidence, rule)


def claim_c5(case: Case) -> Verdict:
    """Mean positions agree with the ruler; they scatter more than the sizes."""
    text = "Mean positions agree with the ruler, and scatter clearly more than the sizes."
    rule = (
        "Over the holes found with 50 frames but the reference hole (thesis' measure): every |mean - true| position is "
        f"at most 1 standard deviation or one ruler graduation (1/16 in = {RULER_MM:.2f} mm), and the median over "
        "holes of var(position)/var(size) is above 1 with its 95 % bootstrap interval over repeats; refuted when a "
        "hole disagrees or the interval lies below 1."
    )
    rows = case.found(MANY)
    rows = rows[(rows["true_offset_mm"] > 0) & rows["extent_offset_mean_mm"].notna()]
    if rows.empty:
        return Verdict("C5", text, "undecided", "No hole but the reference is found with 50 frames.", rule)
    off = rows["extent_offset_bias_mm"].abs()
    agrees = off <= np.maximum(rows["extent_offset_std_mm"].fillna(0.0), RULER_MM)
    many = case.holes[(case.holes["frames"] == MANY) & case.holes["hole"].isin(rows["hole"])]
    ratio, interval = scatter_ratio(many, "extent_offset_mm", "extent_diameter_mm")
    larger = True if interval.above(1) else (False if interval.below(1) else None)
    worst = rows.iloc[int(off.to_numpy().argmax())]
    evidence = (
        f"{int(agrees.sum())} of {len(rows)} mean positions agree"
        f"{'' if agrees.all() else ' (not: ' + hole_list(rows['hole'][~agrees]) + ')'}; the largest difference is "
        f"{worst['extent_offset_bias_mm']:+.2f} mm, std {worst['extent_offset_std_mm']:.2f} mm (hole {worst['hole']}). "
        f"Median variance ratio position to size {ratio:.2f} ({_span(interval)}). Median std of positions "
        f"{rows['extent_offset_std_mm'].median():.2f} mm, of sizes {rows['extent_diameter_std_mm'].median():.2f} mm."
    )
    return Verdict("C5", text, decide([bool(agrees.all()), larger]), evidence, rule)


def claim_c6(case: Case) -> Verdict:
    """A cylindrical hole looks nearly hemispherical."""
    text = "A cylindrical hole looks nearly hemispherical in the averaged cloud."
    rule = (
        "On the 50-frame cloud, a flat floor and a hemisphere scaled in depth (one free number each) are fitted to the "
        "pixels inside the outline of every hole with at least 12 valid pixels. A shape fits clearly better when its "
        "rms misfit is at most 0.8 of the other's. Borne out when most holes look like bowls and none like a cylinder; "
        "refuted when most look like cylinders and none like a bowl."
    )
    shapes = [shape for cloud in case.examples if cloud.frames == MANY for shape in hole_shapes(cloud)]
    if not shapes:
        why = (
            "no cloud of 50 frames was kept"
            if not any(c.frames == MANY for c in case.examples)
            else ("no hole has enough valid pixels inside its outline")
        )
        return Verdict("C6", text, "undecided", f"Not judged: {why}.", rule)
    bowls, cylinders = (sum(shape.looks == look for shape in shapes) for look in ("bowl", "cylinder"))
    answer: Answer = "undecided"
    if bowls > len(shapes) / 2 and not cylinders:
        answer = "borne out"
    elif cylinders > len(shapes) / 2 and not bowls:
        answer = "not borne out"
    return Verdict("C6", text, answer, _shapes_text(shapes), rule)


def claim_c9(case: Case) -> Verdict:
    """Averaging lowers the noise but not the systematic error."""
    text = "Averaging lowers the noise but not the systematic error."
    rule = (
        f"Borne out when the exponent of the temporal noise against the number of frames is -0.5 within {SLOPE_MARGIN} "
        f"(whole 95 % interval) and the systematic error of the longest average is above {UNCHANGED} of the shortest's "
        "(whole 95 % interval, bootstrap over blocks of pixels); refuted when either interval lies wholly on the "
        "other side."
    )
    law = noise_law(case.probes, case.variant)
    if law is None:
        return Verdict("C9", text, "undecided", "Too few probe pixels or numbers of frames to tell.", rule)
    low, high = -0.5 - SLOPE_MARGIN, -0.5 + SLOPE_MARGIN
    slope, ratio = law.slope_interval, law.systematic_ratio_interval
    falls = True if slope.within(low, high) else (False if slope.below(low) or slope.above(high) else None)
    stays = True if ratio.above(UNCHANGED) else (False if ratio.below(UNCHANGED) else None)
    evidence = (
        f"Temporal noise goes as N to the power {law.slope:.3f} ({_span(slope, 3)}); the systematic error with "
        f"{law.many_frames} frames is {law.systematic_ratio:.2f} times that with {law.few_frames} ({_span(ratio)}); "
        f"{law.pixels} pixels."
    )
    return Verdict("C9", text, decide([falls, stays]), evidence, rule)


def decide(parts: Iterable[bool | None]) -> Answer:
    """All parts hold: borne out. One fails: not borne out. Else undecided."""
    values = list(parts)
    if any(value is False for value in values):
        return "not borne out"
    return "borne out" if values and all(value is True for value in values) else "undecided"


def hole_list(names: Iterable[str]) -> str:
    """Hole names as text, runs of numbers joined: ``4–7, 9``; ``none``."""
    numbered = sorted(int(name) for name in names if str(name).isdecimal())
    others = [str(name) for name in names if not str(name).isdecimal()]
    runs: list[list[int]] = []
    for number in numbered:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    parts = [str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs]
    return ", ".join(parts + others) or "none"


def _exact_set(case: Case, frames: int, expected: frozenset[str]) -> tuple[Answer, str]:
    """Whether exactly the expected ones of the thesis' holes are found; with the counts."""
    status = found_holes(case.summary, case.variant, frames)
    if set(status) != set(THESIS_HOLES):
        why = f"no trial has {frames} frames" if not status else "the target is not the thesis' row of eleven holes"
        return "undecided", f"Not judged: {why}."
    more = [hole for hole, state in status.items() if state == "found" and hole not in expected]
    fewer = [hole for hole, state in status.items() if state == "missed" and hole in expected]
    open_ = [hole for hole, state in status.items() if state == "undecided"]
    rows = case.summary[case.summary["frames"] == frames]
    alike: dict[str, list[str]] = {}
    for _, row in rows.sort_values("detected", kind="stable").iterrows():
        alike.setdefault(f"{row['detected']} of {row['n']}", []).append(row["hole"])
    counts = ", ".join(f"{count} ({hole_list(names)})" for count, names in alike.items())
    found = [hole for hole, state in status.items() if state == "found"]
    parts = [f"With {frames} frame{'s' if frames > 1 else ''} found: {hole_list(found)}."]
    parts += [f"More than the thesis: {hole_list(more)}."] if more else []
    parts += [f"Fewer than the thesis: {hole_list(fewer)}."] if fewer else []
    parts += [f"Undecided: {hole_list(open_)}."] if open_ else []
    answer = decide([not (more or fewer), None if open_ else True])
    return answer, " ".join([*parts, f"Detections of trials (holes): {counts}."])


def _threshold_change(runs: pd.DataFrame) -> tuple[bool | None, str]:
    """Whether the threshold in mm is higher with one frame than with 50, and the numbers."""
    damaged = runs[runs["role"] == "damaged"]
    in_mm = damaged["threshold"] * damaged["scale_mm"]
    few, many = (in_mm[damaged["frames"] == frames].dropna() for frames in (FEW, MANY))
    interval = mean_difference(few, many)
    if not interval.known:
        return None, "The thresholds cannot be compared: too few runs."
    text = (
        f"Threshold {few.mean():.2f} mm with 1 frame, {many.mean():.2f} mm with 50 "
        f"(difference {_span(interval)} mm, {len(few)} and {len(many)} runs)."
    )
    return (True if interval.above(0) else (False if interval.high <= 0 else None)), text


def _standardised(row: pd.Series, measure: Measure) -> tuple[float, Interval]:
    """(mean - true)/std of one hole's sizes, with its interval."""
    bias, std = float(row[f"{measure}_bias_mm"]), float(row[f"{measure}_diameter_std_mm"])
    interval = standardised_bias(bias, std, int(row[f"{measure}_measured"]))
    return (bias / std if std > 0 else interval.low), interval


def _within_one(spread: tuple[float, Interval]) -> bool | None:
    _, interval = spread
    if interval.within(-1, 1):
        return True
    return False if interval.above(1) or interval.below(-1) else None


def _per_hole(spreads: dict[str, tuple[float, Interval]], *, spans: bool = True) -> str:
    return ", ".join(
        f"hole {hole} {ratio:+.1f}{f' ({_span(interval, 1)})' if spans else ''}" if interval.known else f"hole {hole} –"
        for hole, (ratio, interval) in spreads.items()
    )


def _share(rows: pd.DataFrame, measure: Measure) -> str:
    inside = rows[f"{measure}_bias_mm"].abs() <= rows[f"{measure}_diameter_std_mm"]
    return f"{int(inside.sum())} of {len(rows)} holes"


def _nothing_found(case: Case) -> str:
    if not (case.summary["frames"] == MANY).any():
        return "No trial has 50 frames."
    return "No hole is found with 50 frames."


def _shapes_text(shapes: list[HoleShape]) -> str:
    looks = {look: [s.hole for s in shapes if s.looks == look] for look in ("bowl", "cylinder", "neither")}
    reached = np.array([shape.reached for shape in shapes])
    known = reached[np.isfinite(reached).all(axis=1)]
    ratio, seen = (
        float(np.median([getattr(shape, f"{name}_rms_mm") / shape.cylinder_rms_mm for shape in shapes]))
        for name in ("bowl", "seen")
    )
    depths = ", ".join(f"{100 * share:.0f} %" for share in np.median(known, axis=0)) if len(known) else "unknown"
    control = sum(shape.true_bowl_rms_mm < shape.true_cylinder_rms_mm for shape in shapes)
    return (
        f"Of {len(shapes)} holes judged, like a bowl: {hole_list(looks['bowl'])}; like a cylinder: "
        f"{hole_list(looks['cylinder'])}; neither clearly: {hole_list(looks['neither'])}. Median misfit of the bowl "
        f"{ratio:.2f} of the cylinder's, of the true hole as seen from the camera {seen:.2f}. "
        f"Median share of the true depth reached at 1/4, 1/2 and 3/4 of the radius: "
        f"{depths} (a hemisphere as deep: 97, 87 and 66 %). Control: the true geometry at the same pixels is nearer "
        f"to a bowl in {control} of {len(shapes)} holes."
    )


def _chance(p: float) -> str:
    return "p < 0.001" if p < 0.001 else f"p = {p:.3f}"


def _span(interval: Interval, digits: int = 2) -> str:
    low, high = (round(end, digits) + 0.0 for end in (interval.low, interval.high))  # + 0.0 turns -0.0 into 0.0
    return f"{low:.{digits}f} to {high:.{digits}f}"
