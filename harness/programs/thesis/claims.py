"""Rules for the claims on a single view (C1 to C6 and C9), the same for every run.

A verdict needs certainty in either direction: if an interval allows both, it is "undecided". No
experiment can change a rule, and no rule was chosen to make a claim come out."""

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations
from pathlib import Path

import numpy as np
import pandas as pd

from harness.evaluation.intervals import Interval, bootstrap, mean_difference, standardised_bias
from harness.evaluation.maps import CAMERA_UNIT, MANY, span
from harness.evaluation.profile import hole_shapes
from harness.evaluation.summary import (
    MAIN,
    found_holes,
    noise_law,
    summarise_holes,
    with_columns,
)
from harness.records.examples import ExampleCloud
from harness.records.trials import ResultTables, hole_list
from harness.report.claims import Answer, Verdict
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.text import many

FEW = 1
"""The smaller number of frames in the claims; `harness.evaluation.maps.MANY` is the larger."""
THESIS_HOLES = tuple(str(number) for number in range(1, 12))
FOUND_WITH_MANY = frozenset(THESIS_HOLES[3:])
FOUND_WITH_FEW = frozenset(THESIS_HOLES[4:])
NO_HOLES = frozenset[str]()
RULER_MM = 25.4 / 16
"""A graduation of the ruler (1/16 in) with which the thesis read its reference positions."""
SLOPE_MARGIN = 0.05
"""Exponents within this distance of -0.5 count as 1/sqrt(N); over 50 frames, it is a factor of
1.22 in noise."""
UNCHANGED = 0.9
"""The systematic error is lowered if it falls below this share; white noise falls to 0.14."""
FEWEST_UNITS = 3
"""Fewest units of a camera, which must all agree, to decide a claim that depends on its fixed
pattern."""
FEWEST_PAIRS = 5
"""Fewest pairs of views to compare registrations."""
FEWEST_RANKED = 4
"""Fewest holes to rank; of fewer, even a perfect order is above 1 in 20 by chance."""
SIGNIFICANT = 0.05
"""A permutation p below this decides a claim on ranks."""
IN_CRITERIA = {
    "MANY": MANY,
    "RULER_MM": RULER_MM,
    "SLOPE_MARGIN": SLOPE_MARGIN,
    "UNCHANGED": UNCHANGED,
    "FEWEST_UNITS": FEWEST_UNITS,
    "FEWEST_PAIRS": FEWEST_PAIRS,
    "FEWEST_RANKED": FEWEST_RANKED,
}
"""The constants that the criteria of claims.yaml name in braces."""

# ---------------------------------------------------------------- claims and answers


@lru_cache
def declared() -> dict[str, dict[str, str]]:
    """Return the claims and their criteria by name, from claims.yaml."""
    claims: dict[str, dict[str, str]] = read_yaml(Path(__file__).with_name("claims.yaml")).data
    return claims


def verdict_of(claim: str, answer: Answer, evidence: str) -> Verdict:
    """Return the verdict on a claim of claims.yaml, with this module's constants filled into its
    criterion."""
    declaration = declared()[claim]
    criterion = declaration["criterion"].format_map(IN_CRITERIA)
    return Verdict(
        claim=claim,
        text=declaration["says"],
        verdict=answer,
        evidence=evidence,
        rule=criterion,
    )


def decide(parts: Iterable[bool | None]) -> Answer:
    """Return "borne out" if all parts hold, "not borne out" if any part fails, and "undecided"
    otherwise."""
    values = list(parts)
    if any(value is False for value in values):
        return "not borne out"
    return "borne out" if values and all(value is True for value in values) else "undecided"


def certain(holds: bool, fails: bool) -> bool | None:
    """Return True if a part of a claim certainly holds, False if it certainly fails, else None."""
    if holds:
        return True
    return False if fails else None


@dataclass(frozen=True)
class Case:
    """The tables of the main set-up that rules use."""

    summary: pd.DataFrame
    """Its rows of `summarise_holes`."""
    units: pd.DataFrame
    """The same rows, and those of variations that change only the camera's unit."""
    holes: pd.DataFrame
    """Its rows per trial and hole."""
    runs: pd.DataFrame
    """Its rows per trial."""
    probes: pd.DataFrame
    """Its rows of sample pixels."""
    examples: Sequence[ExampleCloud]
    """Its averaged clouds."""

    def found_with_many(self) -> pd.DataFrame:
        """Summary rows of the holes found with `MANY` frames."""
        with_many = self.summary["frames"] == MANY
        return self.summary[with_many & (self.summary["status"] == "found")]

    def thresholds_mm(self, frames: int) -> pd.Series:
        """Thresholds on the damaged board with this number of frames."""
        damaged = self.runs[self.runs["role"] == "damaged"]
        thresholds_mm = damaged["threshold"] * damaged["scale_mm"]
        return thresholds_mm[damaged["frames"] == frames].dropna()


# ---------------------------------------------------------------- C1, C2: which holes are found


def _c1(case: Case) -> tuple[Answer, str]:
    return _found(case, MANY, expected=FOUND_WITH_MANY, unexpected=NO_HOLES)


def _c1b(case: Case) -> tuple[Answer, str]:
    small = frozenset(THESIS_HOLES) - FOUND_WITH_MANY
    return _found(case, MANY, expected=NO_HOLES, unexpected=small)


def _c2(case: Case) -> tuple[Answer, str]:
    small = frozenset(THESIS_HOLES) - FOUND_WITH_FEW
    answer, evidence = _found(case, FEW, expected=FOUND_WITH_FEW, unexpected=small)
    agrees = certain(holds=answer == "borne out", fails=answer == "not borne out")
    few_mm = case.thresholds_mm(FEW)
    many_mm = case.thresholds_mm(MANY)
    fall_mm = mean_difference(few_mm, many_mm)
    if not fall_mm.known:
        evidence += " There are too few runs to compare the thresholds."
        return decide([agrees, None]), evidence
    evidence += (
        f" Threshold {few_mm.mean():.2f} mm with 1 frame, {many_mm.mean():.2f} mm with 50"
        f" (difference {span(fall_mm)} mm)."
    )
    return decide([agrees, fall_mm.over(0)]), evidence


def _found(
    case: Case, frames: int, expected: frozenset[str], unexpected: frozenset[str]
) -> tuple[Answer, str]:
    """Judge whether the expected holes are found and the unexpected holes missed; return also the
    counts."""
    status = found_holes(case.summary, MAIN, frames)
    if not status:
        return "undecided", f"Not judged: no trial has {frames} frames."
    if set(status) != set(THESIS_HOLES):
        return "undecided", "Not judged: the target is not the thesis' row of eleven holes."
    detected = [hole for hole, state in status.items() if state == "found"]
    missed = [hole for hole, state in status.items() if state == "missed"]
    undecided = [hole for hole, state in status.items() if state == "undecided"]
    too_many = [hole for hole in detected if hole in unexpected]
    too_few = [hole for hole in missed if hole in expected]
    open_holes = [hole for hole in undecided if hole in expected | unexpected]
    sentences = [f"With {many(frames, 'frame')} found: {hole_list(detected)}."]
    if too_many:
        sentences.append(f"More than the thesis: {hole_list(too_many)}.")
    if too_few:
        sentences.append(f"Fewer than the thesis: {hole_list(too_few)}.")
    if open_holes:
        sentences.append(f"Undecided: {hole_list(open_holes)}.")
    sentences.append(f"Detections of trials (holes): {_detections(case, frames)}.")
    agrees = not (too_many or too_few)
    return decide([agrees, None if open_holes else True]), " ".join(sentences)


def _detections(case: Case, frames: int) -> str:
    """Return the holes by their number of detections: ``0 of 50 (1-3), 50 of 50 (4-11)``."""
    rows = case.summary[case.summary["frames"] == frames]
    holes_by_count: dict[str, list[str]] = {}
    for _, row in rows.sort_values("detected", kind="stable").iterrows():
        count = f"{row['detected']} of {row['n']}"
        holes_by_count.setdefault(count, []).append(row["hole"])
    return ", ".join(f"{count} ({hole_list(holes)})" for count, holes in holes_by_count.items())


# ---------------------------------------------------------------- C3, C4: sizes


def _c3(case: Case) -> tuple[Answer, str]:
    rows = case.found_with_many()
    if rows.empty:
        return "undecided", "No hole is found with 50 frames."
    parts: list[bool | None] = []
    ratios = []
    for _, row in rows.iterrows():
        bias_mm = float(row["extent_bias_mm"])
        std_mm = float(row["extent_diameter_std_mm"])
        interval = standardised_bias(bias_mm, std_mm, int(row["extent_measured"]))
        is_outside = interval.above(1) or interval.below(-1)
        parts.append(certain(holds=interval.within(-1, 1), fails=is_outside))
        ratio = bias_mm / std_mm if std_mm > 0 else interval.low
        text = f"{ratio:+.1f} ({span(interval, 1)})" if interval.known else "–"
        ratios.append(f"hole {row['hole']} {text}")
    evidence = (
        f"(mean - true)/std by the thesis' measure: {', '.join(ratios)}."
        f" {_between_units(case, rows)}"
    )
    return decide(parts), evidence


def _between_units(case: Case, rows: pd.DataFrame) -> str:
    """Return the error of the mean size of the holes found (``rows``) in standard deviations
    between units."""
    with_many = case.units[case.units["frames"] == MANY]
    means_mm = with_many.pivot(index="variant", columns="hole", values="extent_diameter_mean_mm")
    if len(means_mm) < FEWEST_UNITS:
        return "Between units: not judged, because all repeats have the same unit's fixed pattern."
    true_mm = rows.set_index("hole")["true_diameter_mm"]
    ratios = ((means_mm.mean() - true_mm) / means_mm.std())[true_mm.index]
    texts = [f"hole {hole} {ratio:+.1f}" for hole, ratio in ratios.items()]
    return f"Between {len(means_mm)} units: {', '.join(texts)}."


def _c4(case: Case) -> tuple[Answer, str]:
    rows = case.found_with_many()
    rows = rows[rows["extent_bias_mm"].notna()]
    if len(rows) < FEWEST_RANKED:
        return "undecided", f"Only {len(rows)} holes are found with 50 frames."
    diameter_mm = rows["true_diameter_mm"].to_numpy(float)
    error_mm = rows["extent_bias_mm"].abs().to_numpy(float)
    rho, p_falls = falling_rank(diameter_mm, error_mm)
    _, p_rises = falling_rank(diameter_mm, -error_mm)
    smallest = rows.iloc[diameter_mm.argmin()]
    largest = rows.iloc[diameter_mm.argmax()]
    evidence = (
        f"Rank correlation {rho:+.2f} over {len(rows)} holes (one-sided p {p_text(p_falls)} that"
        f" it falls with the diameter, {p_text(p_rises)} that it grows)."
        f" Error {_size_error(smallest)}, {_size_error(largest)}."
    )
    if p_falls < SIGNIFICANT:
        return "borne out", evidence
    return "not borne out" if p_rises < SIGNIFICANT else "undecided", evidence


def p_text(p: float) -> str:
    """Return ``= 0.042``, or ``< 0.001``."""
    return "< 0.001" if p < 0.001 else f"= {p:.3f}"


def _size_error(row: pd.Series) -> str:
    return f"{abs(row['extent_bias_mm']):.2f} mm at {row['true_diameter_mm']:.2f} mm"


def falling_rank(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return Spearman's rho and the one-sided permutation p of "y falls as x grows", exact up to 8
    pairs, or (0, 1)."""
    x_ranks = _ranks(x)
    y_ranks = _ranks(y)
    if np.ptp(x_ranks) == 0 or np.ptp(y_ranks) == 0:
        return 0.0, 1.0
    x_centred = x_ranks - x_ranks.mean()
    y_centred = y_ranks - y_ranks.mean()
    norm = np.sqrt((x_centred @ x_centred) * (y_centred @ y_centred))
    product = x_centred @ y_centred
    by_chance = x_centred[_orders(len(x_centred))] @ y_centred
    p = (by_chance <= product + 1e-12 * norm).mean()
    return float(product / norm), float(p)


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return the rank (n,) of each value from 1; equal values share the mean of theirs."""
    ordered = np.sort(values)
    below = np.searchsorted(ordered, values, "left")
    at_most = np.searchsorted(ordered, values, "right")
    return np.asarray((below + at_most + 1) / 2)


@lru_cache
def _orders(count: int) -> np.ndarray:
    """Return all orders of up to 8 numbers, or 20,000 random orders of more numbers, including the
    given order."""
    if count <= 8:
        return np.array(list(permutations(range(count))))
    in_order = np.arange(count)
    shuffled = np.random.default_rng(0).permuted(np.tile(in_order, (20_000, 1)), axis=1)
    return np.vstack([in_order, shuffled])


# ---------------------------------------------------------------- C5: positions


def _c5(case: Case) -> tuple[Answer, str]:
    rows = case.found_with_many()
    rows = rows[(rows["true_offset_mm"] > 0) & rows["extent_offset_mean_mm"].notna()]
    if rows.empty:
        return "undecided", "With 50 frames, only the reference hole is found."
    error_mm = rows["extent_offset_bias_mm"].abs()
    tolerance_mm = np.maximum(rows["extent_offset_std_mm"].fillna(0.0), RULER_MM)
    agrees = error_mm <= tolerance_mm
    with_many = case.holes["frames"] == MANY
    trials = case.holes[with_many & case.holes["hole"].isin(rows["hole"])]
    ratio, interval = scatter_ratio(trials, "extent_offset_mm", "extent_diameter_mm")
    exceptions = "" if agrees.all() else f" (except {hole_list(rows['hole'][~agrees])})"
    worst = rows.iloc[int(error_mm.to_numpy().argmax())]
    evidence = (
        f"{int(agrees.sum())} of {len(rows)} mean positions agree{exceptions}; the largest"
        f" difference is {worst['extent_offset_bias_mm']:+.2f} mm, std"
        f" {worst['extent_offset_std_mm']:.2f} mm (hole {worst['hole']})."
        f" Median ratio of the variances of position and size {ratio:.2f} ({span(interval)})."
    )
    return decide([bool(agrees.all()), interval.over(1)]), evidence


def scatter_ratio(trials: pd.DataFrame, numerator: str, denominator: str) -> tuple[float, Interval]:
    """Return the median over holes of var(numerator) / var(denominator) over repeats with both
    values, and its bootstrap interval over repeats; infinite if no hole's denominator varies.
    ``trials`` has a row per repeat and hole."""
    upper = trials.pivot(index="repeat", columns="hole", values=numerator).to_numpy(float)
    lower = trials.pivot(index="repeat", columns="hole", values=denominator).to_numpy(float)
    is_complete = np.isfinite(upper) & np.isfinite(lower)
    upper = np.where(is_complete, upper, np.nan)
    lower = np.where(is_complete, lower, np.nan)

    def median_ratio(repeats: np.ndarray) -> np.ndarray:
        """Return the median ratio (b,) of each choice of ``repeats`` (b, n)."""
        with (
            np.errstate(invalid="ignore", divide="ignore"),
            warnings.catch_warnings(action="ignore"),
        ):
            upper_variance = np.nanvar(upper[repeats], axis=1, ddof=1)
            lower_variance = np.nanvar(lower[repeats], axis=1, ddof=1)
            ratios = upper_variance / lower_variance
        no_hole_varies = np.isnan(ratios).all(axis=1, keepdims=True)
        return np.nanmedian(np.where(no_hole_varies, np.inf, ratios), axis=1)

    every_repeat = np.arange(len(upper))[None]
    return float(median_ratio(every_repeat)[0]), bootstrap(median_ratio, len(upper))


# ---------------------------------------------------------------- C6, C9: shape and noise


def _c6(case: Case) -> tuple[Answer, str]:
    clouds = [cloud for cloud in case.examples if cloud.frames == MANY]
    if not clouds:
        return "undecided", "Not judged: no cloud of 50 frames was stored."
    shapes = [shape for cloud in clouds for shape in hole_shapes(cloud)]
    if not shapes:
        return "undecided", "Not judged: no hole has enough valid pixels inside its outline."
    bowls = [shape.hole for shape in shapes if shape.looks == "bowl"]
    cylinders = [shape.hole for shape in shapes if shape.looks == "cylinder"]
    unclear = [shape.hole for shape in shapes if shape.looks == "neither"]
    half = len(shapes) / 2
    are_bowls = len(bowls) > half and not cylinders
    are_cylinders = len(cylinders) > half and not bowls
    ratio = float(np.median([shape.bowl_rms_mm / shape.cylinder_rms_mm for shape in shapes]))
    truly_bowls = sum(shape.true_bowl_rms_mm < shape.true_cylinder_rms_mm for shape in shapes)
    evidence = (
        f"Of {len(shapes)} holes judged, like a bowl: {hole_list(bowls)}; like a cylinder:"
        f" {hole_list(cylinders)}; unclear: {hole_list(unclear)}. Median misfit of the bowl"
        f" relative to the cylinder {ratio:.2f}. Control: the true geometry at the same pixels is"
        f" closer to a bowl in {truly_bowls} of {len(shapes)} holes."
    )
    return decide([certain(holds=are_bowls, fails=are_cylinders)]), evidence


def _c9(case: Case) -> tuple[Answer, str]:
    law = noise_law(case.probes, MAIN)
    if law is None:
        return "undecided", "Not judged: too few sample pixels or numbers of frames."
    steepest = -0.5 - SLOPE_MARGIN
    flattest = -0.5 + SLOPE_MARGIN
    slope = law.slope_interval
    ratio = law.systematic_ratio_interval
    is_outside = slope.below(steepest) or slope.above(flattest)
    falls = certain(holds=slope.within(steepest, flattest), fails=is_outside)
    stays = ratio.over(UNCHANGED)
    evidence = (
        f"Temporal noise varies as N to the power {law.slope:.3f} ({span(slope, 3)}); the"
        f" systematic error with {law.many_frames} frames is {law.systematic_ratio:.2f} times that"
        f" with {law.few_frames} ({span(ratio)}); {law.pixels} pixels."
    )
    return decide([falls, stays]), evidence


# ---------------------------------------------------------------- all claims on a single view

RULES: dict[str, Callable[[Case], tuple[Answer, str]]] = {
    "C1": _c1,
    "C1b": _c1b,
    "C2": _c2,
    "C3": _c3,
    "C4": _c4,
    "C5": _c5,
    "C6": _c6,
    "C9": _c9,
}


def score_claims(
    tables: ResultTables,
    examples: Sequence[ExampleCloud] = (),
    summary: pd.DataFrame | None = None,
) -> list[Verdict]:
    """Return a verdict for each of `RULES` on the main set-up. ``summary`` is the result of
    `summarise_holes`, if it exists."""
    if summary is None:
        summary = summarise_holes(tables.holes)
    case = _case_of(tables, examples, summary)
    verdicts = []
    for claim, rule in RULES.items():
        answer, evidence = rule(case)
        verdicts.append(verdict_of(claim, answer, evidence))
    return verdicts


def _case_of(tables: ResultTables, examples: Sequence[ExampleCloud], summary: pd.DataFrame) -> Case:
    holes = with_columns(tables.holes)
    other_units = tables.variants["variant"][tables.variants["settings"].map(_changes_only_unit)]
    return Case(
        summary=summary[summary["variant"] == MAIN],
        units=summary[summary["variant"].isin({MAIN, *other_units})],
        holes=holes[holes["variant"] == MAIN],
        runs=tables.runs[tables.runs["variant"] == MAIN],
        probes=tables.probes[tables.probes["variant"] == MAIN],
        examples=[example for example in examples if example.variant == MAIN],
    )


def _changes_only_unit(settings_json: str) -> bool:
    return list(json.loads(settings_json or "{}")) == [CAMERA_UNIT]
