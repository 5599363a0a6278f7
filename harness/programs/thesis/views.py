"""Rules for the claims on several views (C7, C8, C10) and the thesis' proposal (H1), each for a
place of an experiment.

Repeats vary the noise and the errors of the nominal poses, but not the poses, the board or the
camera's unit. So C7 is judged over pairs of views; C8 and C10, which have a single pair, are
judged over units of the camera."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pandas as pd

from harness.evaluation import intervals, maps
from harness.programs.thesis.claims import (
    FEWEST_PAIRS,
    FEWEST_UNITS,
    decide,
    verdict_of,
)
from harness.records.trials import hole_list
from harness.report.claims import Answer, Verdict
from harness.vocabulary.text import many

Standing = Literal["ahead", "behind", "level", "open"]

SLAM = ("odometry", "volume")
"""Registration and merging of the map that represents a SLAM system, without marks or loop
closure."""
NOISE_REDUCING = "fusion"
MARKED = ("joint", "marks")
RESPECTS = ("holes", "size", "noise")
OVER_UNITS = ("C8", "C10")


def _c7(case: maps.MapCase) -> tuple[Answer, str]:
    alone = case.single()
    if alone is None:
        return "undecided", "Not judged: the experiment has no single view to compare with."
    rows = case.registrations(alone.frames)
    most = max(set_up.views for set_up in case.set_ups)
    pairs = {method: maps.of_map(rows, method, most) for method in dict.fromkeys(rows["method"])}
    if not {"icp", "cpd"} <= set(pairs):
        return "undecided", "Not judged: the experiment does not try both ICP and CPD."
    runs = case.runs(alone)
    noise_mm = float(runs["surface_noise_mm"][runs["role"] == "damaged"].median())
    planes = [_is_in_one_plane(pairs[method], noise_mm) for method in ("icp", "cpd")]
    ratio, low, high, n = maps.paired_ratio(pairs["icp"], pairs["cpd"], "tre_in_plane_mm")
    better = None if n < FEWEST_PAIRS else True if high < 1 else (False if low >= 1 else None)
    errors = []
    for method, part in pairs.items():
        good = maps.trusted(part)
        plane = float(good[f"tre_{'in_plane'}_mm"].median())
        across = float(good[f"tre_{'across'}_mm"].median())
        errors.append(
            f"{method} {plane:.2f} and {across:.2f} mm, {len(part) - len(good)} of {len(part)}"
        )
    evidence = (
        f"With {maps.frames_text(alone.frames)}, median errors in the plane and across it, and failed registrations: "
        f"{'; '.join(errors)}. The noise of a single cloud's surface is {noise_mm:.2f} mm. In the plane, CPD has "
        f"{ratio:.2f} times the error of ICP ({maps.span(intervals.Interval(low, high))}, {many(n, 'pair')} of views)."
    )
    return decide([*planes, better]), evidence


def _is_in_one_plane(rows: pd.DataFrame, noise_mm: float) -> bool | None:
    """Return whether a method's error perpendicular to the board is at most the noise of a
    surface."""
    if intervals.wilson(len(rows) - len(maps.trusted(rows)), len(rows))[0] > 0.5:
        return False
    across = maps.per_pair(rows, "tre_across_mm").to_numpy(float)
    if len(across) < FEWEST_PAIRS:
        return None
    over = intervals.bootstrap(lambda chosen: np.median(across[chosen], axis=1), len(across)).over(
        noise_mm
    )
    return None if over is None else not over


def _c8(case: maps.MapCase) -> tuple[Answer, str]:
    found = maps.against_one(case, maps.THESIS_REGISTRATION, maps.THESIS_MERGE)
    if found is None:
        why = "the experiment has not finished both one view and two views, registered by CPD and merged on the grid"
        return "undecided", f"Not judged: {why}."
    small = True if not found.small.n and found.lost else found.small.interval.over(0)
    parts = [
        f"With {maps.frames_text(found.frames)}, two views minus one: |size error| of holes of 3/8 in and larger "
        f"{maps.change_text(found.large)}, of smaller holes {maps.change_text(found.small)}.",
        f"Threshold {maps.change_text(found.threshold)}, surface noise {maps.ratio_text(found.noise)}.",
    ]
    parts += [f"Found only by one view: {hole_list(found.lost)}."] if found.lost else []
    parts += [f"Found only by two views: {hole_list(found.gained)}."] if found.gained else []
    return decide([found.large.is_below, small, found.threshold.interval.over(0)]), " ".join(parts)


def _c10(case: maps.MapCase) -> tuple[Answer, str]:
    chosen = [
        set_up
        for set_up in case.maps
        if (set_up.registration, set_up.merge) == SLAM and set_up.views > 1
    ]
    chosen.sort(key=lambda set_up: (not set_up.is_variation, -set_up.views))
    ended = [set_up for set_up in chosen if case.frames(set_up.variant)]
    finished = (
        maps.Map(set_up.variant, case.frames(set_up.variant)[-1], set_up.views) for set_up in ended
    )
    slam = next(finished, None)
    alone = case.single()
    two = case.named(2, maps.THESIS_REGISTRATION, maps.THESIS_MERGE)
    if slam is None or alone is None or two is None:
        named = {"SLAM map": slam, "single view": alone, "merge of two": two}
        missing = ", no ".join(name for name, found in named.items() if not found)
        return "undecided", f"Not judged: the experiment has no {missing}."
    three = (slam, alone, two)
    # holes that all three maps measure in enough repeats
    counts = [
        case.holes(each).groupby("hole", sort=False)["extent_diameter_mm"].count() for each in three
    ]
    common = [
        str(hole)
        for hole in counts[0].index
        if all(count.get(hole, 0) >= maps.FEWEST_BOTH for count in counts)
    ]

    def noise(mapped: maps.Map) -> np.ndarray:
        runs = case.runs(mapped)
        return runs["surface_noise_mm"][runs["role"] == "damaged"].dropna().to_numpy(float)

    def errors(mapped: maps.Map, measured: str, true: str) -> np.ndarray:
        """Return errors (repeats, h), NaN if not measured, without the hole from which positions
        are measured."""
        rows = case.holes(mapped)
        rows = rows[rows["hole"].isin(common) & (rows[true] > 0)]
        rows = rows.assign(_error=rows[measured] - rows[true])
        return rows.pivot(index="repeat", columns="hole", values="_error").to_numpy(float)

    parts = []
    texts = []
    for what, values, size, gap in (
        (
            "surface noise",
            [noise(each) for each in three],
            lambda v: float(v.mean()),
            intervals.mean_difference,
        ),
        (
            "size error",
            [errors(each, "extent_diameter_mm", "true_diameter_mm") for each in three],
            _rms,
            rms_gap,
        ),
        (
            "position error",
            [errors(each, "extent_offset_mm", "true_offset_mm") for each in three],
            _rms,
            rms_gap,
        ),
    ):
        if what == "surface noise" or values[0].size:
            gaps = [gap(values[0], value) for value in values[1:]]
            parts += [interval.over(0) for interval in gaps]
            sizes = [size(value) for value in values]
            more = " and ".join(map(maps.span, gaps))
            texts.append(
                f"{what} {sizes[0]:.2f} mm against {sizes[1]:.2f} and {sizes[2]:.2f} (more by {more})"
            )
    if not common:
        (_, most), *others = (_bounds(case, each) for each in three)
        parts.append(True if most == 0 and all(least > 0 for least, _ in others) else None)
        texts.append("no hole is measured by all three")
    evidence = (
        f"{slam.views} views of {many(slam.frames, 'frame')} against one and two of {many(alone.frames, 'frame')}: "
        f"{'; '.join(texts)}. Found: {', '.join(_found_text(case, each) for each in three)}."
    )
    return decide(parts), evidence


def rms_gap(first: np.ndarray, second: np.ndarray) -> intervals.Interval:
    """Return the 95 % bootstrap interval of rms(first) - rms(second), both (repeats, h) with NaN;
    unknown below two."""
    if min(len(first), len(second)) < 2 or not (
        np.isfinite(first).any() and np.isfinite(second).any()
    ):
        return intervals.UNKNOWN
    rng = np.random.default_rng(0)
    draws = []
    for errors in (first, second):
        weights = rng.multinomial(
            len(errors), np.full(len(errors), 1 / len(errors)), intervals.RESAMPLES
        )
        valid = np.isfinite(errors)
        squares = np.where(valid, errors, 0.0) ** 2
        with np.errstate(invalid="ignore"):
            draws.append(np.sqrt(weights @ squares.sum(axis=1) / (weights @ valid.sum(axis=1))))
    tail = (1 - intervals.CONFIDENCE) / 2
    low, high = np.nanquantile(draws[0] - draws[1], [tail, 1 - tail])
    return intervals.Interval(float(low), float(high))


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def _h1(case: maps.MapCase) -> tuple[Answer, str]:
    duels = duels_of(case)
    if not duels:
        return (
            "undecided",
            "Not judged: the experiment has no fused map and single view to compare.",
        )
    answers = [
        False if "behind" in standings else True if "ahead" in standings else None
        for standings, _ in duels
    ]
    evidence = " ".join(text for _, text in duels)
    if len(duels) == 1:
        evidence += (
            " No single view has as many exposures in total, so that comparison is left out."
        )
    return decide(answers), evidence


def duels_of(case: maps.MapCase) -> list[tuple[tuple[Standing, ...], str]]:
    """Compare H1's map with a single view that has as many frames as each of its views, and with a
    single view that has as many exposures in total, if they exist. Return the standing in each
    respect, and the numbers as text."""
    fused = [
        way
        for way in case.set_ups
        if way.merge == NOISE_REDUCING and way.views > 1 and case.frames(way.variant)
    ]
    registration = next(
        (name for name in MARKED if any(way.registration == name for way in fused)), None
    )
    fused = sorted(
        (way for way in fused if way.registration == registration), key=lambda way: -way.views
    )
    first = case.single()
    equal_frames = (
        (maps.Map(way.variant, rival.frames, way.views), rival)
        for way in fused
        for frames in [case.common_frames(way.variant, first.variant if first else None)]
        for rival in [case.single(frames) if frames is not None else None]
        if rival is not None
    )
    lone = [way for way in case.maps if way.views == 1]
    lone.sort(key=lambda way: (first is None or way.variant != first.variant, way.is_variation))
    equal_exposures = (
        (maps.Map(way.variant, frames, way.views), maps.Map(alone.variant, way.views * frames, 1))
        for way in fused
        for frames in reversed(case.frames(way.variant))
        for alone in lone
        if way.views * frames in case.frames(alone.variant)
    )
    pairs = [next(iter(kind), None) for kind in (equal_frames, equal_exposures)]
    return [_duel(case, *pair, registration or "") for pair in pairs if pair is not None]


def _duel(
    case: maps.MapCase, mapped: maps.Map, rival: maps.Map, registration: str
) -> tuple[tuple[Standing, ...], str]:
    sizes = maps.size_errors(case.holes(rival), case.holes(mapped)).change()
    noise = maps.run_ratio(case.runs(rival), case.runs(mapped), "surface_noise_mm")
    (low, high), (rival_low, rival_high) = _bounds(case, mapped), _bounds(case, rival)
    sure = low == high == rival_low == rival_high
    standings: tuple[Standing, ...] = (
        "ahead"
        if low > rival_high
        else "behind"
        if high < rival_low
        else "level"
        if sure
        else "open",
        *(
            "ahead" if gap.is_below else "behind" if gap.interval.over(0) else "open"
            for gap in (sizes, noise)
        ),
    )
    each = ", ".join(
        f"{respect} {standing}" for respect, standing in zip(RESPECTS, standings, strict=True)
    )
    text = (
        f"{mapped.views} views ({registration}, fusion) of {many(mapped.frames, 'frame')} against one of "
        f"{many(rival.frames, 'frame')}: {each}. Found {_found_text(case, mapped)} against {_found_text(case, rival)}; "
        f"|size error| {maps.change_text(sizes)}; surface noise {maps.ratio_text(noise)}."
    )
    return standings, text


def _bounds(case: maps.MapCase, mapped: maps.Map) -> tuple[int, int]:
    """Return the fewest and most holes that a map finds."""
    states = list(case.status(mapped).values())
    found = states.count("found")
    return found, found + states.count("undecided")


def _found_text(case: maps.MapCase, mapped: maps.Map) -> str:
    low, high = _bounds(case, mapped)
    total = len(case.status(mapped))
    return f"{low} of {total}" if low == high else f"{low} to {high} of {total}"


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
        judged = [(case, verdict_of(claim, *rule(case))) for case in cases]
        if len(cases) > 1:
            judged = [
                (case, replace(result, evidence=f"{case.conditions}: {result.evidence}"))
                for case, result in judged
            ]
        if claim in OVER_UNITS:
            places = dict.fromkeys(case.without_unit for case in cases)
            verdicts += [
                _over_units([result for case, result in judged if case.without_unit == position])
                for position in places
            ]
        else:
            verdicts += [result for _, result in judged]
    return verdicts


def _over_units(verdicts: Sequence[Verdict]) -> Verdict:
    """Combine the verdicts on units of a camera: their common verdict if they agree and are
    enough, or "undecided"."""
    evidence = " ".join(verdict.evidence for verdict in verdicts)
    answers = [verdict.verdict for verdict in verdicts]
    if len(verdicts) < FEWEST_UNITS and set(answers) != {"undecided"}:
        on = f"{many(len(verdicts), 'unit')} of the camera"
        evidence = (
            f"Judged on only {on}, so nothing follows for others: {', '.join(answers)}. {evidence}"
        )
    agreed = len(verdicts) >= FEWEST_UNITS and len(set(answers)) == 1
    return replace(verdicts[0], verdict=answers[0] if agreed else "undecided", evidence=evidence)
