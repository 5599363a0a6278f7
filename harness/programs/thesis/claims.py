"""Rules for the claims on a single view (C1 to C6, C9) and on cameras (C11), the same for every
run.

A verdict needs certainty in either direction: if an interval allows both, it is "undecided". No
experiment can change a rule, and no rule was chosen to make a claim come out."""

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import rankdata

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
from harness.records.trials import ResultTables, hole_list
from harness.report.claims import Answer, Verdict
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.path_names import value_text

# the smaller number of frames in the thesis' claims; `harness.evaluation.maps.MANY` is the larger
FEW = 1


@lru_cache
def declared() -> dict[str, dict[str, str]]:
    """Return the claims and their criteria by name, from claims.yaml."""
    claims: dict[str, dict[str, str]] = read_yaml(Path(__file__).with_name("claims.yaml")).data
    return claims


def verdict_of(claim: str, answer: Answer, evidence: str) -> Verdict:
    """Return the verdict on a claim of claims.yaml, with this module's constants filled into its
    criterion."""
    declaration = declared()[claim]
    return Verdict(
        claim, declaration["says"], answer, evidence, declaration["criterion"].format_map(globals())
    )


def decide(parts: Iterable[bool | None]) -> Answer:
    """Return "borne out" if all parts hold, "not borne out" if any part fails, and "undecided"
    otherwise."""
    values = list(parts)
    if any(value is False for value in values):
        return "not borne out"
    return "borne out" if values and all(value is True for value in values) else "undecided"


THESIS_HOLES = tuple(str(number) for number in range(1, 12))
FOUND_WITH_MANY = frozenset(THESIS_HOLES[3:])
FOUND_WITH_FEW = frozenset(THESIS_HOLES[4:])
RULER_MM = (
    25.4 / 16
)  # one graduation of the ruler (1/16 in) with which the thesis read its reference positions
SLOPE_MARGIN = 0.05
"""Exponents within this distance of -0.5 count as 1/sqrt(N); over 50 frames, it is a factor of
1.22 in noise."""
# the systematic error counts as lowered if it falls below this share, while white noise falls to
# 0.14
UNCHANGED = 0.9
# fewest units of a camera, which must all agree, to decide a claim that depends on its fixed
# pattern
FEWEST_UNITS = 3
FEWEST_PAIRS = 5  # fewest pairs of views to compare registrations
# fewest holes to rank; with fewer, even a perfect order has a probability above 1 in 20 by chance
FEWEST_RANKED = 4


@dataclass(frozen=True)
class Case:
    """The tables of a variant that rules use, and its averaged clouds. ``units`` are the summary
    rows of this variant and of the variations that change only the camera's unit."""

    variant: str
    summary: pd.DataFrame
    units: pd.DataFrame
    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    examples: Sequence[Any] = ()

    def found_with_many(self) -> pd.DataFrame:
        """Summary rows of the holes found with `MANY` frames."""
        return self.summary[(self.summary["frames"] == MANY) & (self.summary["status"] == "found")]


def _c2(case: Case) -> tuple[Answer, str]:
    answer, evidence = _found(case, FEW, FOUND_WITH_FEW, frozenset(THESIS_HOLES) - FOUND_WITH_FEW)
    set_agrees = {"borne out": True, "not borne out": False, "undecided": None}[answer]
    damaged = case.runs[case.runs["role"] == "damaged"]
    in_mm = damaged["threshold"] * damaged["scale_mm"]
    few = in_mm[damaged["frames"] == FEW].dropna()
    many = in_mm[damaged["frames"] == MANY].dropna()
    interval = mean_difference(few, many)
    if not interval.known:
        return decide(
            [set_agrees, None]
        ), f"{evidence} There are too few runs to compare the thresholds."
    threshold = f"Threshold {few.mean():.2f} mm with 1 frame, {many.mean():.2f} mm with 50"
    return decide(
        [set_agrees, interval.over(0)]
    ), f"{evidence} {threshold} (difference {span(interval)} mm)."


def _c3(case: Case) -> tuple[Answer, str]:
    rows = case.found_with_many()
    if rows.empty:
        return "undecided", "No hole is found with 50 frames."
    parts: list[bool | None] = []
    ratios = []
    for _, row in rows.iterrows():
        bias = float(row["extent_bias_mm"])
        std = float(row["extent_diameter_std_mm"])
        interval = standardised_bias(bias, std, int(row["extent_measured"]))
        ratio = bias / std if std > 0 else interval.low
        within = interval.within(-1, 1)
        outside = interval.above(1) or interval.below(-1)
        parts.append(True if within else False if outside else None)
        ratios.append(
            f"hole {row['hole']} {f'{ratio:+.1f} ({span(interval, 1)})' if interval.known else '–'}"
        )
    return (
        decide(parts),
        f"(mean - true)/std by the thesis' measure: {', '.join(ratios)}. {_between_units(case, rows)}",
    )


def _between_units(case: Case, rows: pd.DataFrame) -> str:
    """Return the error of the mean size of the holes found (``rows``) in standard deviations
    between units."""
    many = case.units[case.units["frames"] == MANY]
    means = many.pivot(index="variant", columns="hole", values="extent_diameter_mean_mm")
    if len(means) < FEWEST_UNITS:
        return "Between units: not judged, because all repeats have the same unit's fixed pattern."
    true = rows.set_index("hole")["true_diameter_mm"]
    off = ((means.mean() - true) / means.std())[true.index]
    return f"Between {len(means)} units: {', '.join(f'hole {hole} {ratio:+.1f}' for hole, ratio in off.items())}."


def _c4(case: Case) -> tuple[Answer, str]:
    rows = case.found_with_many()
    rows = rows[rows["extent_bias_mm"].notna()]
    if len(rows) < FEWEST_RANKED:
        return "undecided", f"Only {len(rows)} holes are found with 50 frames."
    diameter = rows["true_diameter_mm"].to_numpy(float)
    error = rows["extent_bias_mm"].abs().to_numpy(float)
    rho, p = falling_rank(diameter, error)
    p_rises = falling_rank(diameter, -error)[1]
    smallest = rows.iloc[diameter.argmin()]
    largest = rows.iloc[diameter.argmax()]
    errors = (
        f"{abs(at['extent_bias_mm']):.2f} mm at {at['true_diameter_mm']:.2f} mm"
        for at in (smallest, largest)
    )
    falls = "< 0.001" if p < 0.001 else f"= {p:.3f}"
    rises = "< 0.001" if p_rises < 0.001 else f"= {p_rises:.3f}"
    evidence = (
        f"Rank correlation {rho:+.2f} over {len(rows)} holes (one-sided p {falls} that it falls with the diameter, "
        f"{rises} that it grows). Error {', '.join(errors)}."
    )
    return (
        "borne out" if p < 0.05 else "not borne out" if p_rises < 0.05 else "undecided"
    ), evidence


def _c5(case: Case) -> tuple[Answer, str]:
    rows = case.found_with_many()
    rows = rows[(rows["true_offset_mm"] > 0) & rows["extent_offset_mean_mm"].notna()]
    if rows.empty:
        return "undecided", "With 50 frames, only the reference hole is found."
    off = rows["extent_offset_bias_mm"].abs()
    agrees = off <= np.maximum(rows["extent_offset_std_mm"].fillna(0.0), RULER_MM)
    many = case.holes[(case.holes["frames"] == MANY) & case.holes["hole"].isin(rows["hole"])]
    ratio, interval = scatter_ratio(many, "extent_offset_mm", "extent_diameter_mm")
    larger = interval.over(1)
    worst = rows.iloc[int(off.to_numpy().argmax())]
    evidence = (
        f"{int(agrees.sum())} of {len(rows)} mean positions agree"
        f"{'' if agrees.all() else ' (except ' + hole_list(rows['hole'][~agrees]) + ')'}; the largest difference is "
        f"{worst['extent_offset_bias_mm']:+.2f} mm, std {worst['extent_offset_std_mm']:.2f} mm (hole {worst['hole']}). "
        f"Median ratio of the variances of position and size {ratio:.2f} ({span(interval)})."
    )
    return decide([bool(agrees.all()), larger]), evidence


def _c6(case: Case) -> tuple[Answer, str]:
    clouds = [cloud for cloud in case.examples if cloud.frames == MANY]
    shapes = [shape for cloud in clouds for shape in hole_shapes(cloud)]
    if not shapes:
        why = (
            "no hole has enough valid pixels inside its outline"
            if clouds
            else "no cloud of 50 frames was stored"
        )
        return "undecided", f"Not judged: {why}."
    looks = {
        look: [s.hole for s in shapes if s.looks == look]
        for look in ("bowl", "cylinder", "neither")
    }
    bowls = len(looks["bowl"])
    cylinders = len(looks["cylinder"])
    most = len(shapes) / 2
    bowl = bowls > most and not cylinders
    cylinder = cylinders > most and not bowls
    answer: Answer = "borne out" if bowl else "not borne out" if cylinder else "undecided"
    ratio = float(np.median([shape.bowl_rms_mm / shape.cylinder_rms_mm for shape in shapes]))
    control = sum(shape.true_bowl_rms_mm < shape.true_cylinder_rms_mm for shape in shapes)
    evidence = (
        f"Of {len(shapes)} holes judged, like a bowl: {hole_list(looks['bowl'])}; like a cylinder: "
        f"{hole_list(looks['cylinder'])}; unclear: {hole_list(looks['neither'])}. Median misfit of the bowl relative "
        f"to the cylinder {ratio:.2f}. Control: the true geometry at the same pixels is closer to a bowl in "
        f"{control} of {len(shapes)} holes."
    )
    return answer, evidence


def _c9(case: Case) -> tuple[Answer, str]:
    law = noise_law(case.probes, case.variant)
    if law is None:
        return "undecided", "Not judged: too few sample pixels or numbers of frames."
    low = -0.5 - SLOPE_MARGIN
    high = -0.5 + SLOPE_MARGIN
    slope = law.slope_interval
    ratio = law.systematic_ratio_interval
    falls = (
        True
        if slope.within(low, high)
        else (False if slope.below(low) or slope.above(high) else None)
    )
    stays = ratio.over(UNCHANGED)
    evidence = (
        f"Temporal noise varies as N to the power {law.slope:.3f} ({span(slope, 3)}); the systematic error with "
        f"{law.many_frames} frames is {law.systematic_ratio:.2f} times that with {law.few_frames} ({span(ratio)}); "
        f"{law.pixels} pixels."
    )
    return decide([falls, stays]), evidence


RULES: dict[str, Callable[[Case], tuple[Answer, str]]] = {
    "C1": lambda case: _found(case, MANY, FOUND_WITH_MANY, frozenset()),
    "C1b": lambda case: _found(case, MANY, frozenset(), frozenset(THESIS_HOLES) - FOUND_WITH_MANY),
    **{"C2": _c2, "C3": _c3, "C4": _c4, "C5": _c5, "C6": _c6, "C9": _c9},
}


def score_claims(
    tables: ResultTables,
    variant: str = MAIN,
    examples: Sequence[Any] = (),
    summary: pd.DataFrame | None = None,
) -> list[Verdict]:
    """Return a verdict for each of `RULES` on a variant. ``summary`` is the result of
    `summarise_holes`, if known."""
    summary = summarise_holes(tables.holes) if summary is None else summary
    alone = tables.variants["settings"].map(
        lambda text: list(json.loads(text or "{}")) == [CAMERA_UNIT]
    )
    units = summary[summary["variant"].isin({variant, *tables.variants["variant"][alone]})]
    every = (summary, with_columns(tables.holes), tables.runs, tables.probes)
    summary, holes, runs, probes = (table[table["variant"] == variant] for table in every)
    case = Case(
        variant,
        summary,
        units,
        holes,
        runs,
        probes,
        [shown for shown in examples if shown.variant == variant],
    )
    return [verdict_of(claim, *rule(case)) for claim, rule in RULES.items()]


def falling_rank(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Return Spearman's rho and the one-sided permutation p of "y falls as x grows", exact up to 8
    pairs, or (0, 1)."""
    x_ranks = rankdata(x)
    y_ranks = rankdata(y)
    if np.ptp(x_ranks) == 0 or np.ptp(y_ranks) == 0:
        return 0.0, 1.0
    a = x_ranks - x_ranks.mean()
    b = y_ranks - y_ranks.mean()
    norm = np.sqrt((a @ a) * (b @ b))
    null = a[_orders(len(a))] @ b
    return float(a @ b / norm), float((null <= a @ b + 1e-12 * norm).mean())


@lru_cache
def _orders(count: int) -> np.ndarray:
    """Return all orders of up to 8 numbers, or 20,000 random orders of more numbers, including the
    given order."""
    if count <= 8:
        return np.array(list(permutations(range(count))))
    random = np.random.default_rng(0).permuted(np.tile(np.arange(count), (20_000, 1)), axis=1)
    return np.vstack([np.arange(count), random])


def scatter_ratio(holes: pd.DataFrame, first: str, second: str) -> tuple[float, Interval]:
    """Return the median over holes of var(first) / var(second) over repeats with both values, and
    its bootstrap interval over repeats; infinite if no hole's second column varies. ``holes`` has
    a row per repeat and hole."""
    top = holes.pivot(index="repeat", columns="hole", values=first).to_numpy(float)
    bottom = holes.pivot(index="repeat", columns="hole", values=second).to_numpy(float)
    both = np.isfinite(top) & np.isfinite(bottom)

    def ratio(chosen: np.ndarray) -> np.ndarray:
        with (
            np.errstate(invalid="ignore", divide="ignore"),
            warnings.catch_warnings(action="ignore"),
        ):
            over = np.nanvar(np.where(both, top, np.nan)[chosen], axis=1, ddof=1)
            under = np.nanvar(np.where(both, bottom, np.nan)[chosen], axis=1, ddof=1)
            ratios = over / under
        return np.nanmedian(
            np.where(np.isnan(ratios).all(axis=1, keepdims=True), np.inf, ratios), axis=1
        )

    return float(ratio(np.arange(len(top))[None])[0]), bootstrap(ratio, len(top))


def _found(
    case: Case, frames: int, expected: frozenset[str], unexpected: frozenset[str]
) -> tuple[Answer, str]:
    """Judge whether the expected holes are found and the unexpected holes missed; return also the
    counts."""
    status = found_holes(case.summary, case.variant, frames)
    if set(status) != set(THESIS_HOLES):
        why = (
            f"no trial has {frames} frames"
            if not status
            else "the target is not the thesis' row of eleven holes"
        )
        return "undecided", f"Not judged: {why}."
    by_state = {
        k: [hole for hole, state in status.items() if state == k]
        for k in ("found", "missed", "undecided")
    }
    more = [hole for hole in by_state["found"] if hole in unexpected]
    fewer = [hole for hole in by_state["missed"] if hole in expected]
    open_ = [hole for hole in by_state["undecided"] if hole in expected | unexpected]
    rows = case.summary[case.summary["frames"] == frames]
    alike: dict[str, list[str]] = {}
    for _, row in rows.sort_values("detected", kind="stable").iterrows():
        alike.setdefault(f"{row['detected']} of {row['n']}", []).append(row["hole"])
    counts = ", ".join(f"{count} ({hole_list(names)})" for count, names in alike.items())
    parts = [
        f"With {frames} frame{'s' if frames > 1 else ''} found: {hole_list(by_state['found'])}."
    ]
    for what, holes in (
        ("More than the thesis", more),
        ("Fewer than the thesis", fewer),
        ("Undecided", open_),
    ):
        parts += [f"{what}: {hole_list(holes)}."] if holes else []
    answer = decide([not (more or fewer), None if open_ else True])
    return answer, " ".join([*parts, f"Detections of trials (holes): {counts}."])


CAMERA = "source.camera.name"
BEST = "azure_kinect_nfov"
OTHERS = ("kinect_v2", "realsense_l515")


def claim_c11(summary: pd.DataFrame, axes: Sequence[str]) -> Verdict | None:
    """Return the verdict from summary rows of all set-ups and variations; None if none of the
    ``axes`` holds the three cameras. At each place, a camera's range of counts covers all its
    units and variations."""
    if CAMERA not in axes or not {BEST, *OTHERS} <= set(summary[CAMERA]):
        return None
    rows = summary[(summary["frames"] == MANY) & summary[CAMERA].isin((BEST, *OTHERS))]
    if rows.empty:
        return verdict_of("C11", "undecided", f"Not judged: no trial has {MANY} frames.")
    varied = [path for path in axes if path not in (CAMERA, CAMERA_UNIT)]
    found = {
        " and ".join(map(value_text, varied, values)) or "its one place": {
            camera: _bounds(each) for camera, each in part.groupby(CAMERA)
        }
        for values, part in (
            rows.groupby(varied, sort=False, dropna=False) if varied else [((), rows)]
        )
    }
    units = rows.groupby(CAMERA)[CAMERA_UNIT].nunique().min() if CAMERA_UNIT in axes else 1
    counts = [
        f"{place} {' / '.join(' to '.join(map(str, sorted(set(held.get(who, ()))))) or '–' for who in (BEST, *OTHERS))}"
        for place, held in found.items()
    ]
    evidence = [
        f"Holes found with {MANY} frames by {BEST} / {' / '.join(OTHERS)}: {'; '.join(counts)}."
    ]
    if units < FEWEST_UNITS:
        evidence.insert(
            0, f"Only {units} of each camera's units: too few for a verdict on other units."
        )
    answers: list[bool | None] = []
    for camera in OTHERS:
        standings: dict[str, list[str]] = {
            word: [] for word in ("ahead", "level", "behind", "open")
        }
        for place, held in found.items():
            if {BEST, camera} <= set(held):
                (low, high), (other_low, other_high) = held[BEST], held[camera]
                sure = low == high and other_low == other_high
                word = (
                    "ahead"
                    if low > other_high
                    else "behind"
                    if high < other_low
                    else "level"
                    if sure
                    else "open"
                )
                standings[word].append(place)
        judged = any(standings.values())
        answer = (
            False
            if standings["behind"]
            else None
            if standings["open"]
            else bool(standings["ahead"])
        )
        answers.append(answer if judged else None)
        text = "; ".join(
            f"{word} at {', '.join(where)}" for word, where in standings.items() if where
        )
        evidence += [f"Against {camera}: {text}."] if judged else []
    return verdict_of(
        "C11", decide(answers) if units >= FEWEST_UNITS else "undecided", " ".join(evidence)
    )


def _bounds(rows: pd.DataFrame) -> tuple[int, int]:
    """Return the fewest and most holes that any unit or variation of a camera finds at a place."""
    sure = (rows["status"] == "found").groupby(rows["variant"]).sum()
    possible = (rows["status"] != "missed").groupby(rows["variant"]).sum()
    return int(sure.min()), int(possible.max())
