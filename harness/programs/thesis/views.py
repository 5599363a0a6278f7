"""Rules for the claims on several views (C7, C8, C10) and the thesis' proposal (H1), each for a
place of an experiment.

Repeats vary the noise and the errors of the nominal poses, but not the poses, the board or the
camera's unit. So C7 is judged over pairs of views; C8 and C10, which have a single pair, are
judged over units of the camera."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from harness.evaluation import intervals, maps
from harness.programs.thesis.claims import (
    FEWEST_PAIRS,
    FEWEST_UNITS,
    certain,
    decide,
    verdict_of,
)
from harness.programs.thesis.counts import HoleCount, Standing
from harness.records.trials import hole_list
from harness.report.claims import Answer, Verdict
from harness.vocabulary.text import many

SLAM = ("odometry", "volume")
"""Registration and merging of the map that represents a SLAM system, without marks or loop
closure."""
NOISE_REDUCING = "fusion"
"""The merging of the thesis' proposal."""
MARKED = ("joint", "marks")
"""Registrations by marks, the preferred first."""
OVER_UNITS = ("C8", "C10")
"""Claims that are judged over units of the camera."""

# ---------------------------------------------------------------- C7: ICP and CPD


def _c7(case: maps.MapCase) -> tuple[Answer, str]:
    single = case.single()
    if single is None:
        return "undecided", "Not judged: the experiment has no single view to compare with."
    rows = case.registrations(single.frames)
    most_views = max(set_up.views for set_up in case.set_ups)
    methods = list(dict.fromkeys(rows["method"]))
    by_method = {method: maps.of_map(rows, method, most_views) for method in methods}
    if not {"icp", "cpd"} <= set(by_method):
        return "undecided", "Not judged: the experiment does not try both ICP and CPD."
    icp = by_method["icp"]
    cpd = by_method["cpd"]
    runs = case.runs(single)
    noise_mm = float(runs["surface_noise_mm"][runs["role"] == "damaged"].median())
    ratio, low, high, pairs = maps.paired_ratio(icp, cpd, "tre_in_plane_mm")
    is_better = None
    if pairs >= FEWEST_PAIRS:
        is_better = certain(holds=high < 1, fails=low >= 1)
    errors = [f"{method} {_errors_text(part)}" for method, part in by_method.items()]
    evidence = (
        f"With {maps.frames_text(single.frames)}, median errors in the plane and across it, and"
        f" failed registrations: {'; '.join(errors)}. The noise of a single cloud's surface is"
        f" {noise_mm:.2f} mm. In the plane, CPD has {ratio:.2f} times the error of ICP"
        f" ({maps.span(intervals.Interval(low, high))}, {many(pairs, 'pair')} of views)."
    )
    parts = [_is_in_one_plane(icp, noise_mm), _is_in_one_plane(cpd, noise_mm), is_better]
    return decide(parts), evidence


def _errors_text(registrations: pd.DataFrame) -> str:
    """Return a method's median errors and its failures: ``0.12 and 0.05 mm, 1 of 8``."""
    trusted = maps.trusted(registrations)
    in_plane_mm = float(trusted["tre_in_plane_mm"].median())
    across_mm = float(trusted["tre_across_mm"].median())
    failed = len(registrations) - len(trusted)
    return f"{in_plane_mm:.2f} and {across_mm:.2f} mm, {failed} of {len(registrations)}"


def _is_in_one_plane(registrations: pd.DataFrame, noise_mm: float) -> bool | None:
    """Return whether a method's error perpendicular to the board is at most the noise of a
    surface."""
    failed = len(registrations) - len(maps.trusted(registrations))
    failed_low, _ = intervals.wilson(failed, len(registrations))
    if failed_low > 0.5:
        return False
    across_mm = maps.per_pair(registrations, "tre_across_mm").to_numpy(float)
    pairs = len(across_mm)
    if pairs < FEWEST_PAIRS:
        return None
    median_mm = intervals.bootstrap(lambda chosen: np.median(across_mm[chosen], axis=1), pairs)
    exceeds = median_mm.over(noise_mm)
    return None if exceeds is None else not exceeds


# ---------------------------------------------------------------- C8: two views against one


def _c8(case: maps.MapCase) -> tuple[Answer, str]:
    change = maps.against_one(case, maps.THESIS_REGISTRATION, maps.THESIS_MERGE)
    if change is None:
        return "undecided", (
            "Not judged: the experiment has not finished both one view and two views, "
            "registered by"
            " CPD and merged on the grid."
        )
    # if no smaller hole can be compared, one that only the single view finds speaks for the claim
    small_worse = change.small.interval.over(0)
    if change.lost and not change.small.n:
        small_worse = True
    sentences = [
        f"With {maps.frames_text(change.frames)}, two views minus one: |size error| of holes of"
        f" 3/8 in and larger {maps.change_text(change.large)}, of smaller holes"
        f" {maps.change_text(change.small)}.",
        f"Threshold {maps.change_text(change.threshold)}, surface noise"
        f" {maps.ratio_text(change.noise)}.",
    ]
    if change.lost:
        sentences.append(f"Found only by one view: {hole_list(change.lost)}.")
    if change.gained:
        sentences.append(f"Found only by two views: {hole_list(change.gained)}.")
    parts = [change.large.is_below, small_worse, change.threshold.interval.over(0)]
    return decide(parts), " ".join(sentences)


# ---------------------------------------------------------------- C10: a SLAM map


def _c10(case: maps.MapCase) -> tuple[Answer, str]:
    slam = _slam_map(case)
    single = case.single()
    pair = case.named(2, maps.THESIS_REGISTRATION, maps.THESIS_MERGE)
    if slam is None or single is None or pair is None:
        by_name = {"SLAM map": slam, "single view": single, "merge of two": pair}
        missing = ", no ".join(name for name, mapped in by_name.items() if mapped is None)
        return "undecided", f"Not judged: the experiment has no {missing}."
    three = (slam, single, pair)
    holes = _measured_by_all(case, three)
    noise_mm = [_surface_noise_mm(case, mapped) for mapped in three]
    means_mm = [float(values.mean()) for values in noise_mm]
    gaps = [intervals.mean_difference(noise_mm[0], values) for values in noise_mm[1:]]
    parts = [gap.over(0) for gap in gaps]
    texts = [_gaps_text("surface noise", means_mm, gaps)]
    for name, quantity in (("size error", "diameter"), ("position error", "offset")):
        errors_mm = [_errors_mm(case, mapped, holes, quantity) for mapped in three]
        if errors_mm[0].size:
            rms_mm = [_rms(errors) for errors in errors_mm]
            gaps = [rms_gap(errors_mm[0], errors) for errors in errors_mm[1:]]
            parts += [gap.over(0) for gap in gaps]
            texts.append(_gaps_text(name, rms_mm, gaps))
    if not holes:
        parts.append(_finds_none_of_theirs(case, three))
        texts.append("no hole is measured by all three")
    counts = ", ".join(_found_text(case, mapped) for mapped in three)
    evidence = (
        f"{slam.views} views of {many(slam.frames, 'frame')} against one and two of"
        f" {many(single.frames, 'frame')}: {'; '.join(texts)}. Found: {counts}."
    )
    return decide(parts), evidence


def _slam_map(case: maps.MapCase) -> maps.Map | None:
    """Return the map by odometry and volume: a variation if there is one, with the most views and
    frames."""
    candidates = [
        set_up
        for set_up in case.maps
        if (set_up.registration, set_up.merge) == SLAM
        and set_up.views > 1
        and case.frames(set_up.variant)
    ]
    if not candidates:
        return None
    set_up = min(candidates, key=lambda set_up: (not set_up.is_variation, -set_up.views))
    return maps.Map(set_up.variant, case.frames(set_up.variant)[-1], set_up.views)


def _measured_by_all(case: maps.MapCase, three: Sequence[maps.Map]) -> list[str]:
    """Return the holes that all maps measure in enough repeats."""
    counts = []
    for mapped in three:
        by_hole = case.holes(mapped).groupby("hole", sort=False)
        counts.append(by_hole["extent_diameter_mm"].count())
    return [
        str(hole)
        for hole in counts[0].index
        if all(count.get(hole, 0) >= maps.FEWEST_BOTH for count in counts)
    ]


def _surface_noise_mm(case: maps.MapCase, mapped: maps.Map) -> np.ndarray:
    """Return the noise of the fitted surface (n,) in the runs on the damaged board."""
    runs = case.runs(mapped)
    return runs["surface_noise_mm"][runs["role"] == "damaged"].dropna().to_numpy(float)


def _errors_mm(
    case: maps.MapCase, mapped: maps.Map, holes: Sequence[str], quantity: str
) -> np.ndarray:
    """Return errors (repeats, h) of "diameter" or "offset", NaN if not measured, without the hole
    from which positions are measured."""
    rows = case.holes(mapped)
    true_mm = rows[f"true_{quantity}_mm"]
    rows = rows.assign(error_mm=rows[f"extent_{quantity}_mm"] - true_mm)
    chosen = rows[rows["hole"].isin(holes) & (true_mm > 0)]
    return chosen.pivot(index="repeat", columns="hole", values="error_mm").to_numpy(float)


def _finds_none_of_theirs(case: maps.MapCase, three: Sequence[maps.Map]) -> bool | None:
    """Return True if the first map certainly finds no hole and the others certainly do, else
    None."""
    slam, *rivals = [_hole_count(case, mapped) for mapped in three]
    return True if slam.most == 0 and all(rival.fewest > 0 for rival in rivals) else None


def _gaps_text(what: str, sizes_mm: Sequence[float], gaps: Sequence[intervals.Interval]) -> str:
    slam_mm, single_mm, pair_mm = sizes_mm
    differences = " and ".join(map(maps.span, gaps))
    return (
        f"{what} {slam_mm:.2f} mm against {single_mm:.2f} and {pair_mm:.2f} (more by {differences})"
    )


def rms_gap(first: np.ndarray, second: np.ndarray) -> intervals.Interval:
    """Return the 95 % bootstrap interval of rms(first) - rms(second), both (repeats, h) with NaN;
    unknown below two."""
    if min(len(first), len(second)) < 2:
        return intervals.UNKNOWN
    if not (np.isfinite(first).any() and np.isfinite(second).any()):
        return intervals.UNKNOWN
    rng = np.random.default_rng(0)
    first_rms = _resampled_rms(first, rng)
    second_rms = _resampled_rms(second, rng)
    tail = (1 - intervals.CONFIDENCE) / 2
    low, high = np.nanquantile(first_rms - second_rms, [tail, 1 - tail])
    return intervals.Interval(float(low), float(high))


def _resampled_rms(errors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the root mean square (b,) of errors (repeats, h) with NaN, for repeats drawn with
    replacement."""
    repeats = len(errors)
    weights = rng.multinomial(repeats, np.full(repeats, 1 / repeats), intervals.RESAMPLES)
    valid = np.isfinite(errors)
    squares = np.where(valid, errors, 0.0) ** 2
    with np.errstate(invalid="ignore"):
        return np.sqrt(weights @ squares.sum(axis=1) / (weights @ valid.sum(axis=1)))


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


# ---------------------------------------------------------------- H1: the proposal


@dataclass(frozen=True)
class Duel:
    """The proposal's map against a single view."""

    holes: Standing
    """Standing in the number of holes found."""
    size: Standing
    """Standing in |size error| of the holes that both measure."""
    noise: Standing
    """Standing in the noise of the fitted surface."""
    text: str
    """The numbers."""

    @property
    def is_won(self) -> bool | None:
        """True if the map is ahead in a respect and behind in none, False if it is behind in any,
        else None."""
        standings = (self.holes, self.size, self.noise)
        if "behind" in standings:
            return False
        return True if "ahead" in standings else None


def _h1(case: maps.MapCase) -> tuple[Answer, str]:
    duels = duels_of(case)
    if not duels:
        return (
            "undecided",
            "Not judged: the experiment has no fused map and single view to compare.",
        )
    evidence = " ".join(duel.text for duel in duels)
    if len(duels) == 1:
        evidence += (
            " No single view has as many exposures in total, so that comparison is left out."
        )
    return decide(duel.is_won for duel in duels), evidence


def duels_of(case: maps.MapCase) -> list[Duel]:
    """Compare H1's map with a single view that has as many frames as each of its views, and with a
    single view that has as many exposures in total, if they exist."""
    fused = _fused_by_marks(case)
    pairs = [_of_equal_frames(case, fused), _of_equal_exposures(case, fused)]
    return [_duel(case, pair[0], pair[1], fused[0].registration) for pair in pairs if pair]


def _fused_by_marks(case: maps.MapCase) -> list[maps.MapSetUp]:
    """Return the set-ups of fused maps by the preferred of `MARKED`, those of most views first."""
    fused = [
        set_up
        for set_up in case.set_ups
        if set_up.merge == NOISE_REDUCING and set_up.views > 1 and case.frames(set_up.variant)
    ]
    for registration in MARKED:
        chosen = [set_up for set_up in fused if set_up.registration == registration]
        if chosen:
            return sorted(chosen, key=lambda set_up: -set_up.views)
    return []


def _of_equal_frames(
    case: maps.MapCase, fused: Sequence[maps.MapSetUp]
) -> tuple[maps.Map, maps.Map] | None:
    """Return the first map with a rival of as many frames as each of its views, and the rival."""
    single = case.single()
    for set_up in fused:
        frames = case.common_frames(set_up.variant, single.variant if single else None)
        rival = None if frames is None else case.single(frames)
        if rival is not None:
            return maps.Map(set_up.variant, rival.frames, set_up.views), rival
    return None


def _of_equal_exposures(
    case: maps.MapCase, fused: Sequence[maps.MapSetUp]
) -> tuple[maps.Map, maps.Map] | None:
    """Return the first map with the most frames that has a rival of as many exposures in total,
    and the rival."""
    preferred = case.single()
    singles = [set_up for set_up in case.maps if set_up.views == 1]
    singles.sort(
        key=lambda set_up: (
            preferred is None or set_up.variant != preferred.variant,
            set_up.is_variation,
        )
    )
    for set_up in fused:
        for frames in reversed(case.frames(set_up.variant)):
            exposures = set_up.views * frames
            for single in singles:
                if exposures in case.frames(single.variant):
                    mapped = maps.Map(set_up.variant, frames, set_up.views)
                    return mapped, maps.Map(single.variant, exposures, 1)
    return None


def _duel(case: maps.MapCase, mapped: maps.Map, rival: maps.Map, registration: str) -> Duel:
    sizes = maps.size_errors(case.holes(rival), case.holes(mapped)).change()
    noise = maps.run_ratio(case.runs(rival), case.runs(mapped), "surface_noise_mm")
    holes_standing = _hole_count(case, mapped).against(_hole_count(case, rival))
    size_standing = _standing_of(sizes)
    noise_standing = _standing_of(noise)
    text = (
        f"{mapped.views} views ({registration}, fusion) of {many(mapped.frames, 'frame')} against"
        f" one of {many(rival.frames, 'frame')}: holes {holes_standing}, size {size_standing},"
        f" noise {noise_standing}. Found {_found_text(case, mapped)} against"
        f" {_found_text(case, rival)}; |size error| {maps.change_text(sizes)}; surface noise"
        f" {maps.ratio_text(noise)}."
    )
    return Duel(
        holes=holes_standing,
        size=size_standing,
        noise=noise_standing,
        text=text,
    )


def _standing_of(change: maps.Change) -> Standing:
    """Return the standing of a map whose error has changed."""
    if change.is_below:
        return "ahead"
    return "behind" if change.interval.over(0) else "open"


def _hole_count(case: maps.MapCase, mapped: maps.Map) -> HoleCount:
    """Return the fewest and most holes that a map finds."""
    states = list(case.status(mapped).values())
    certain_holes = states.count("found")
    return HoleCount(fewest=certain_holes, most=certain_holes + states.count("undecided"))


def _found_text(case: maps.MapCase, mapped: maps.Map) -> str:
    return f"{_hole_count(case, mapped).text} of {len(case.status(mapped))}"


# ---------------------------------------------------------------- all claims on several views

VIEW_CLAIMS: dict[str, Callable[[maps.MapCase], tuple[Answer, str]]] = {
    "C7": _c7,
    "C8": _c8,
    "C10": _c10,
    "H1": _h1,
}


def score_views(cases: Sequence[maps.MapCase]) -> list[Verdict]:
    """Return a verdict for each of `VIEW_CLAIMS` and each place; if there are several, the
    evidence names the place."""
    verdicts: list[Verdict] = []
    for claim, rule in VIEW_CLAIMS.items():
        by_conditions: dict[str, list[Verdict]] = {}
        for case in cases:
            answer, evidence = rule(case)
            if len(cases) > 1:
                evidence = f"{case.conditions}: {evidence}"
            # units of a camera are different cases under the same conditions
            conditions = case.without_unit if claim in OVER_UNITS else case.conditions
            by_conditions.setdefault(conditions, []).append(verdict_of(claim, answer, evidence))
        for alike_verdicts in by_conditions.values():
            verdicts += [_over_units(alike_verdicts)] if claim in OVER_UNITS else alike_verdicts
    return verdicts


def _over_units(verdicts: Sequence[Verdict]) -> Verdict:
    """Combine the verdicts on units of a camera: their common verdict if they agree and are
    enough, or "undecided"."""
    evidence = " ".join(verdict.evidence for verdict in verdicts)
    answers = [verdict.verdict for verdict in verdicts]
    common = set(answers)
    if len(verdicts) < FEWEST_UNITS and common != {"undecided"}:
        units = many(len(verdicts), "unit")
        evidence = (
            f"Judged on only {units} of the camera, so nothing follows for others:"
            f" {', '.join(answers)}. {evidence}"
        )
    are_agreed = len(verdicts) >= FEWEST_UNITS and len(common) == 1
    return replace(
        verdicts[0], verdict=answers[0] if are_agreed else "undecided", evidence=evidence
    )
