"""The claims on one view (C1 to C6, C9): one rule each, the same for every run, and their verdicts by variant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from harness.evaluation.intervals import Interval, bootstrap, mean_difference, standardised_bias
from harness.evaluation.maps import span
from harness.evaluation.noise import noise_law
from harness.evaluation.profile import AveragedCloud, hole_shapes
from harness.evaluation.summary import MAIN, Measure, found_holes, hole_list, summarise_holes, with_columns
from harness.tables.trials import ResultTables
from harness.thesis.verdicts import FEW, MANY, Answer, Rules, Verdict, decide, is_above_zero, rule_of

if TYPE_CHECKING:
    import pandas as pd

THESIS_HOLES = tuple(str(number) for number in range(1, 12))
FOUND_WITH_MANY, FOUND_WITH_FEW = frozenset(THESIS_HOLES[3:]), frozenset(THESIS_HOLES[4:])
RULER_MM = 25.4 / 16
"""One graduation of a ruler in 1/16 in: what the thesis' reference positions were read with."""
SLOPE_MARGIN = 0.05
"""Exponents within -0.5 +- this count as 1/sqrt(N): over 50 frames it is a factor of 1.22 in noise."""
UNCHANGED = 0.9
"""The systematic error counts as lowered when it falls below this share; the white noise falls to 0.14 meanwhile."""
FEWEST_RANKED = 4
"""Holes below which even a perfect order has a chance above 1 in 20."""


class Example(AveragedCloud, Protocol):
    """An averaged cloud that knows which variant and how many frames it shows."""

    @property
    def frames(self) -> int: ...
    @property
    def variant(self) -> str: ...


@dataclass(frozen=True)
class Case:
    """The tables of one variant that rules judge by; every table holds this variant's rows only."""

    variant: str
    summary: pd.DataFrame
    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    examples: Sequence[Example] = ()

    def found_with_many(self) -> pd.DataFrame:
        """Summary rows of the holes found with `MANY` frames."""
        return self.summary[(self.summary["frames"] == MANY) & (self.summary["status"] == "found")]


RULES: Rules[Case] = {}


@rule_of(
    RULES,
    "C1",
    "With 50 averaged frames the holes of 1/4 in and larger (4 to 11) are found.",
    "Borne out when, with 50 frames, holes 4 to 11 are found and 1 to 3 missed; one hole on the wrong side refutes.",
)
def claim_c1(case: Case) -> tuple[Answer, str]:
    """Judge whether averaging 50 frames finds holes 4 to 11 and no smaller one."""
    return _exact_set(case, MANY, FOUND_WITH_MANY)


@rule_of(
    RULES,
    "C2",
    "A single frame finds holes 5 to 11 only: its noise forces a higher threshold.",
    "Borne out when, with 1 frame, holes 5 to 11 are found and 1 to 4 missed, and the calibrated threshold in mm "
    "(k times scale) is higher than with 50 frames (95 % Welch interval of the difference above 0).",
)
def claim_c2(case: Case) -> tuple[Answer, str]:
    """Judge whether one frame finds holes 5 to 11 only, because noise forces a higher threshold."""
    answer, evidence = _exact_set(case, FEW, FOUND_WITH_FEW)
    set_agrees = {"borne out": True, "not borne out": False, "undecided": None}[answer]
    damaged = case.runs[case.runs["role"] == "damaged"]
    in_mm = damaged["threshold"] * damaged["scale_mm"]
    few, many = (in_mm[damaged["frames"] == frames].dropna() for frames in (FEW, MANY))
    interval = mean_difference(few, many)
    if not interval.known:
        return decide([set_agrees, None]), f"{evidence} The thresholds cannot be compared: too few runs."
    threshold = (
        f"Threshold {few.mean():.2f} mm with 1 frame, {many.mean():.2f} mm with 50 "
        f"(difference {span(interval)} mm, {len(few)} and {len(many)} runs)."
    )
    return decide([set_agrees, is_above_zero(interval)]), f"{evidence} {threshold}"


@rule_of(
    RULES,
    "C3",
    "From one viewpoint, each hole's mean size lies within one standard deviation of its true size.",
    "Judged by the thesis' measure on each hole found with 50 frames: |mean - true| <= 1 standard deviation over "
    "the repeats. Borne out when every hole's 95 % interval of (mean - true)/std lies within -1 to 1; refuted when "
    "one hole's lies outside.",
)
def claim_c3(case: Case) -> tuple[Answer, str]:
    """Judge whether each hole's mean size lies within one standard deviation of the true one."""
    rows = case.found_with_many()
    if rows.empty:
        none = "No hole is found with 50 frames." if (case.summary["frames"] == MANY).any() else ""
        return "undecided", none or "No trial has 50 frames."

    def spread(row: pd.Series, measure: Measure) -> tuple[float, Interval]:
        bias, std = float(row[f"{measure}_bias_mm"]), float(row[f"{measure}_diameter_std_mm"])
        interval = standardised_bias(bias, std, int(row[f"{measure}_measured"]))
        return (bias / std if std > 0 else interval.low), interval

    def per_hole(measure: Measure, *, with_intervals: bool) -> str:
        return ", ".join(
            f"hole {row['hole']} {ratio:+.1f}{f' ({span(interval, 1)})' if with_intervals else ''}"
            if interval.known
            else f"hole {row['hole']} –"
            for _, row in rows.iterrows()
            for ratio, interval in [spread(row, measure)]
        )

    def share(measure: Measure) -> str:
        inside = rows[f"{measure}_bias_mm"].abs() <= rows[f"{measure}_diameter_std_mm"]
        return f"{int(inside.sum())} of {len(rows)} holes"

    intervals = [spread(row, "extent")[1] for _, row in rows.iterrows()]
    parts = [True if i.within(-1, 1) else False if i.above(1) or i.below(-1) else None for i in intervals]
    evidence = (
        f"(mean - true)/std by the thesis' measure: {per_hole('extent', with_intervals=True)}. "
        f"By the model of the blurred hole: {per_hole('model', with_intervals=False)}. "
        f"Within one std: {share('extent')} (thesis' measure), {share('model')} (model)."
    )
    return decide(parts), evidence


@rule_of(
    RULES,
    "C4",
    "The error of the measured size grows as the hole shrinks.",
    "Spearman's rank correlation between the true diameter and |mean size - true size| (thesis' measure) over the "
    "holes found with 50 frames. Borne out when it is negative with a one-sided permutation p below 0.05; refuted "
    f"when it is zero or positive; undecided between, or with fewer than {FEWEST_RANKED} holes.",
)
def claim_c4(case: Case) -> tuple[Answer, str]:
    """Judge whether the size error grows as the hole shrinks."""
    rows = case.found_with_many()
    rows = rows[rows["extent_bias_mm"].notna()]
    if len(rows) < FEWEST_RANKED:
        return "undecided", f"Only {len(rows)} holes are found with 50 frames."
    diameter = rows["true_diameter_mm"].to_numpy(float)
    error = rows["extent_bias_mm"].abs().to_numpy(float)
    rho, p = falling_rank(diameter, error)
    relative, p_relative = falling_rank(diameter, error / diameter)
    chance, chance_relative = ("p < 0.001" if one < 0.001 else f"p = {one:.3f}" for one in (p, p_relative))
    smallest, largest = rows.iloc[diameter.argmin()], rows.iloc[diameter.argmax()]
    evidence = (
        f"Rank correlation {rho:+.2f} ({chance}) over {len(rows)} holes; of the error relative to the size "
        f"{relative:+.2f} ({chance_relative}). Error {abs(smallest['extent_bias_mm']):.2f} mm at "
        f"{smallest['true_diameter_mm']:.2f} mm, {abs(largest['extent_bias_mm']):.2f} mm at "
        f"{largest['true_diameter_mm']:.2f} mm."
    )
    return ("not borne out" if not rho < 0 else "borne out" if p < 0.05 else "undecided"), evidence


@rule_of(
    RULES,
    "C5",
    "Mean positions agree with the ruler, and scatter clearly more than the sizes.",
    "Over the holes found with 50 frames but the reference hole (thesis' measure): every |mean - true| position is "
    f"at most 1 standard deviation or one ruler graduation (1/16 in = {RULER_MM:.2f} mm), and the median over "
    "holes of var(position)/var(size) is above 1 with its 95 % bootstrap interval over repeats; refuted when a "
    "hole disagrees or the interval lies below 1.",
)
def claim_c5(case: Case) -> tuple[Answer, str]:
    """Judge whether mean positions agree with the ruler and scatter more than the sizes."""
    rows = case.found_with_many()
    rows = rows[(rows["true_offset_mm"] > 0) & rows["extent_offset_mean_mm"].notna()]
    if rows.empty:
        return "undecided", "No hole but the reference is found with 50 frames."
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
        f"Median variance ratio position to size {ratio:.2f} ({span(interval)}). Median std of positions "
        f"{rows['extent_offset_std_mm'].median():.2f} mm, of sizes {rows['extent_diameter_std_mm'].median():.2f} mm."
    )
    return decide([bool(agrees.all()), larger]), evidence


@rule_of(
    RULES,
    "C6",
    "A cylindrical hole looks nearly hemispherical in the averaged cloud.",
    "On the 50-frame cloud, a flat floor and a hemisphere scaled in depth (one free number each) are fitted to the "
    "pixels inside the outline of every hole with at least 12 valid pixels. A shape fits clearly better when its "
    "rms misfit is at most 0.8 of the other's. Borne out when most holes look like bowls and none like a cylinder; "
    "refuted when most look like cylinders and none like a bowl.",
)
def claim_c6(case: Case) -> tuple[Answer, str]:
    """Judge whether a cylindrical hole looks nearly hemispherical."""
    clouds = [cloud for cloud in case.examples if cloud.frames == MANY]
    shapes = [shape for cloud in clouds for shape in hole_shapes(cloud)]
    if not shapes:
        why = "no hole has enough valid pixels inside its outline" if clouds else "no cloud of 50 frames was kept"
        return "undecided", f"Not judged: {why}."
    looks = {look: [s.hole for s in shapes if s.looks == look] for look in ("bowl", "cylinder", "neither")}
    bowls, cylinders = len(looks["bowl"]), len(looks["cylinder"])
    answer: Answer = "undecided"
    if bowls > len(shapes) / 2 and not cylinders:
        answer = "borne out"
    elif cylinders > len(shapes) / 2 and not bowls:
        answer = "not borne out"
    reached = np.array([shape.reached for shape in shapes])
    known = reached[np.isfinite(reached).all(axis=1)]
    depths = ", ".join(f"{100 * share:.0f} %" for share in np.median(known, axis=0)) if len(known) else "unknown"
    ratio = float(np.median([shape.bowl_rms_mm / shape.cylinder_rms_mm for shape in shapes]))
    seen = float(np.median([shape.seen_rms_mm / shape.cylinder_rms_mm for shape in shapes]))
    control = sum(shape.true_bowl_rms_mm < shape.true_cylinder_rms_mm for shape in shapes)
    evidence = (
        f"Of {len(shapes)} holes judged, like a bowl: {hole_list(looks['bowl'])}; like a cylinder: "
        f"{hole_list(looks['cylinder'])}; neither clearly: {hole_list(looks['neither'])}. Median misfit of the bowl "
        f"{ratio:.2f} of the cylinder's, of the true hole as seen from the camera {seen:.2f}. "
        f"Median share of the true depth reached at 1/4, 1/2 and 3/4 of the radius: "
        f"{depths} (a hemisphere as deep: 97, 87 and 66 %). Control: the true geometry at the same pixels is nearer "
        f"to a bowl in {control} of {len(shapes)} holes."
    )
    return answer, evidence


@rule_of(
    RULES,
    "C9",
    "Averaging lowers the noise but not the systematic error.",
    f"Borne out when the exponent of the temporal noise against the number of frames is -0.5 within {SLOPE_MARGIN} "
    f"(whole 95 % interval) and the systematic error of the longest average is above {UNCHANGED} of the shortest's "
    "(whole 95 % interval, bootstrap over blocks of pixels); refuted when either interval lies wholly on the "
    "other side.",
)
def claim_c9(case: Case) -> tuple[Answer, str]:
    """Judge whether averaging lowers the noise but not the systematic error."""
    law = noise_law(case.probes, case.variant)
    if law is None:
        return "undecided", "Too few probe pixels or numbers of frames to tell."
    low, high = -0.5 - SLOPE_MARGIN, -0.5 + SLOPE_MARGIN
    slope, ratio = law.slope_interval, law.systematic_ratio_interval
    falls = True if slope.within(low, high) else (False if slope.below(low) or slope.above(high) else None)
    stays = True if ratio.above(UNCHANGED) else (False if ratio.below(UNCHANGED) else None)
    evidence = (
        f"Temporal noise goes as N to the power {law.slope:.3f} ({span(slope, 3)}); the systematic error with "
        f"{law.many_frames} frames is {law.systematic_ratio:.2f} times that with {law.few_frames} ({span(ratio)}); "
        f"{law.pixels} pixels."
    )
    return decide([falls, stays]), evidence


def score_claims(
    tables: ResultTables,
    variant: str = MAIN,
    examples: Sequence[Example] = (),
    summary: pd.DataFrame | None = None,
) -> list[Verdict]:
    """A verdict for each of `RULES` on one variant. ``summary`` saves making `summarise_holes` again."""
    summary = summarise_holes(tables.holes) if summary is None else summary
    holes = with_columns(tables.holes)
    case = Case(
        variant=variant,
        summary=summary[summary["variant"] == variant],
        holes=holes[holes["variant"] == variant],
        runs=tables.runs[tables.runs["variant"] == variant],
        probes=tables.probes[tables.probes["variant"] == variant],
        examples=[example for example in examples if example.variant == variant],
    )
    return [rule(case) for rule in RULES.values()]


def verdicts_by_variant(
    tables: ResultTables, examples: Sequence[Example] = (), summary: pd.DataFrame | None = None
) -> pd.DataFrame:
    """One row per variant: ``variant`` and a column per claim with its verdict, in the table's order."""
    import pandas as pd

    summary = summarise_holes(tables.holes) if summary is None else summary
    rows = [
        {"variant": name} | {v.claim: v.verdict for v in score_claims(tables, name, examples, summary)}
        for name in tables.variants["variant"]
    ]
    return pd.DataFrame(rows, columns=["variant", *RULES])


def falling_rank(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Spearman's rho of (x, y) and the one-sided p of "y falls as x grows".

    Exact permutation test up to 8 pairs, 20000 fixed random permutations beyond. A constant input has rho 0, p 1.
    """
    from scipy.stats import permutation_test, rankdata

    ranks, other = rankdata(x), rankdata(y)
    if np.ptp(ranks) == 0 or np.ptp(other) == 0:
        return 0.0, 1.0
    a, b = ranks - ranks.mean(), other - other.mean()
    norm = np.sqrt((a @ a) * (b @ b))
    test = permutation_test(
        (a,),
        lambda permuted, axis=-1: np.sum(permuted * b, axis=axis) / norm,
        permutation_type="pairings",
        alternative="less",
        vectorized=True,
        n_resamples=50_000 if len(a) <= 8 else 20_000,
        rng=np.random.default_rng(0),
        batch=10_000,
    )
    return float(a @ b / norm), float(test.pvalue)


def scatter_ratio(holes: pd.DataFrame, first: str, second: str) -> tuple[float, Interval]:
    """Median over holes of var(first) / var(second) over repeats, with its interval by bootstrap over repeats.

    ``holes``: one row per repeat and hole. Repeats in which a hole lacks either value are left out of that hole's two
    variances; infinite where no hole's second column varies.
    """
    top, bottom = (holes.pivot(index="repeat", columns="hole", values=c).to_numpy(float) for c in (first, second))
    both = np.isfinite(top) & np.isfinite(bottom)

    def variance(values: np.ndarray) -> np.ndarray:
        """(resamples, holes) of (resamples, n, holes), NaN left out; NaN below two values."""
        there = np.isfinite(values)
        count = there.sum(axis=1)
        mean = np.where(there, values, 0).sum(axis=1) / count
        squares = np.where(there, (values - mean[:, None]) ** 2, 0).sum(axis=1)
        return np.where(count >= 2, squares / (count - 1), np.nan)

    def ratio(chosen: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore", divide="ignore"):
            ratios = variance(np.where(both, top, np.nan)[chosen]) / variance(np.where(both, bottom, np.nan)[chosen])
        return np.nanmedian(np.where(np.isnan(ratios).all(axis=1, keepdims=True), np.inf, ratios), axis=1)

    return float(ratio(np.arange(len(top))[None])[0]), bootstrap(ratio, len(top))


def _exact_set(case: Case, frames: int, expected: frozenset[str]) -> tuple[Answer, str]:
    """Judge whether exactly the expected ones of the thesis' holes are found; with the counts."""
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
