"""Claim C10, a SLAM map against the single cloud and two views, and H1, maps that lower the noise against one view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from harness.evaluation.claim_rules import Verdict, decide, hole_list
from harness.evaluation.intervals import CONFIDENCE, RESAMPLES, UNKNOWN, Interval, mean_difference
from harness.evaluation.map_case import THESIS_MERGE, THESIS_REGISTRATION, Map, MapCase
from harness.evaluation.map_text import change_text, ratio_text, span
from harness.evaluation.paired import FEWEST_BOTH, run_ratio, size_errors

if TYPE_CHECKING:
    import pandas as pd

Standing = Literal["ahead", "behind", "level", "open"]

SLAM = ("odometry", "volume")
"""Registration and merge of the map that stands in for a SLAM system: no marks, no closing of loops."""
NOISE_REDUCING = "fusion"
MARKED = ("joint", "marks")
"""The registrations of H1's map, the first that was tried."""
C10 = "A SLAM map is noisier and less precise than the single cloud and the merge of two views."
C10_RULE = (
    "The map by odometry and volume (as a variation where there is one, with the most views and frames that it has) is "
    "held against one view and against two merged as the thesis did, both with 50 frames (else the most). Borne out "
    "when, against both, the noise of its fitted surface is higher (95 % Welch interval) and the root mean square "
    "errors of size and of position (distance from the largest hole; thesis' measure) over the holes that all three "
    "measure are larger (95 % bootstrap intervals over repeats). Where it finds no hole and the others do, its "
    "precision counts as worse. One comparison on the wrong side refutes."
)
H1 = "Mapping with noise reduction beats single clouds."
H1_RULE = (
    "The fused map of the most views, registered by marks and surface (else by marks), is held against one view with "
    "as many frames as each of its views (50, else the most), and against one view with as many exposures in all "
    "(views times frames; of such pairs that of the most views, then frames) where the experiment has one. Respects: "
    "holes found (counts, undecided holes leaving room for both), |size error| of the holes that both measure (thesis' "
    "measure) and noise of the fitted surface (95 % Student intervals over repeats). Borne out when the map is ahead "
    "of each rival in one respect at least and behind in none; refuted when it is behind any of them in any."
)


def claim_c10(case: MapCase) -> Verdict:
    """The SLAM map is noisier and less precise than one view and than two merged ones."""
    slam = _slam_map(case)
    one, two = case.single(), case.named(2, THESIS_REGISTRATION, THESIS_MERGE)
    if slam is None or one is None or two is None:
        missing = [
            name for name, found in (("SLAM map", slam), ("single view", one), ("merge of two", two)) if not found
        ]
        return Verdict("C10", C10, "undecided", f"Not judged: the experiment has no {', no '.join(missing)}.", C10_RULE)
    rivals = {"one view": one, "two": two}
    common = _measured_by_all(case, [slam, *rivals.values()])
    noise, noise_text = _compared("surface noise", [_noise(case, one_map) for one_map in (slam, *rivals.values())])
    parts, said = [*noise], [noise_text]
    for what, errors in (("size error", _size_errors), ("position error", _place_errors)):
        found = [errors(case, one_map, common) for one_map in (slam, *rivals.values())]
        if found[0].size:
            answers, text = _compared(what, found)
            parts += answers
            said.append(text)
    if not common:
        parts.append(_finds_none(case, slam, list(rivals.values())))
        said.append("no hole is measured by all three")
    counts = ", ".join(_found_text(case, one_map) for one_map in (slam, *rivals.values()))
    evidence = (
        f"{slam.views} views of {_frames(slam)} against one and two of {_frames(one)}: {'; '.join(said)}. Holes "
        f"measured by all: {hole_list(common)}. Found: {counts}."
    )
    return Verdict("C10", C10, decide(parts), evidence, C10_RULE)


def _compared(what: str, values: Sequence[np.ndarray]) -> tuple[list[bool | None], str]:
    """Whether the first is surely greater than each of the others, and the numbers: of runs' noise (n,) their means, of
    errors (repeats, h) their root mean squares."""
    means = values[0].ndim == 1
    gaps = [(mean_difference if means else rms_gap)(values[0], other) for other in values[1:]]
    sizes = [float(one.mean()) if means else _rms(one) for one in values]
    text = (
        f"{what} {sizes[0]:.2f} mm against {sizes[1]:.2f} and {sizes[2]:.2f} (more by {' and '.join(map(span, gaps))})"
    )
    return [_above(gap) for gap in gaps], text


@dataclass(frozen=True)
class Duel:
    """A fused map, registered as ``registration`` says, against one view: its standing in each respect, and numbers."""

    mapped: Map
    registration: str
    rival: Map
    standings: dict[str, Standing]
    text: str


def claim_h1(case: MapCase) -> Verdict:
    """A fused map of many views beats one view, with as many frames and with as many exposures in all."""
    duels = [duel for duel in (equal_frames(case), equal_exposures(case)) if duel is not None]
    if not duels:
        return Verdict("H1", H1, "undecided", "Not judged: no fused map stands beside a single view.", H1_RULE)
    answers: list[bool | None] = []
    for duel in duels:
        standings = list(duel.standings.values())
        answers.append(False if "behind" in standings else True if "ahead" in standings else None)
    evidence = " ".join(duel.text for duel in duels)
    if len(duels) == 1:
        evidence += " No single view has as many exposures in all: judged without."
    return Verdict("H1", H1, decide(answers), evidence, H1_RULE)


def equal_frames(case: MapCase) -> Duel | None:
    """H1's map against one view with as many frames as each of its views."""
    for variant, registration, views in _fused(case):
        single = case.single()
        frames = case.common_frames(variant, single.variant if single else None)
        rival = case.single(frames) if frames is not None else None
        if rival is not None:
            return _duel(case, Map(variant, rival.frames, views), rival, registration)
    return None


def equal_exposures(case: MapCase) -> Duel | None:
    """H1's map against one view with as many exposures in all, see the rule for which."""
    lone = [one for one in case.maps if one.views == 1]
    first = case.single()
    lone.sort(key=lambda one: (first is None or one.variant != first.variant, one.is_variation))
    for variant, registration, views in _fused(case):
        for frames in reversed(case.frames(variant)):
            alone = next((one.variant for one in lone if views * frames in case.frames(one.variant)), None)
            if alone is not None:
                rival = Map(alone, views * frames, 1)
                return _duel(case, Map(variant, frames, views), rival, registration)
    return None


def _fused(case: MapCase) -> list[tuple[str, str, int]]:
    """(variant, registration, views) of fused maps of several views by the first of `MARKED`, most views first."""
    fused = [one for one in case.set_ups if one.merge == NOISE_REDUCING and one.views > 1 and case.frames(one.variant)]
    registration = next((name for name in MARKED if any(one.registration == name for one in fused)), None)
    chosen = sorted((one for one in fused if one.registration == registration), key=lambda one: -one.views)
    return [(one.variant, one.registration, one.views) for one in chosen]


def _duel(case: MapCase, mapped: Map, rival: Map, registration: str) -> Duel:
    sizes = size_errors(case.holes(rival), case.holes(mapped)).change()
    noise = run_ratio(case.runs(rival), case.runs(mapped), "surface_noise_mm")
    standings: dict[str, Standing] = {
        "holes": _counts_standing(case, mapped, rival),
        "size": _standing(sizes.is_below, sizes.is_above),
        "noise": _standing(noise.is_below, noise.is_above),
    }
    said = ", ".join(f"{respect} {standing}" for respect, standing in standings.items())
    text = (
        f"{mapped.views} views ({registration}, fusion) of {_frames(mapped)} against one of {_frames(rival)}: {said}. "
        f"Found {_found_text(case, mapped)} against {_found_text(case, rival)}; |size error| {change_text(sizes)}; "
        f"surface noise {ratio_text(noise)}."
    )
    return Duel(mapped, registration, rival, standings, text)


def _frames(one: Map) -> str:
    return f"{one.frames} frame{'s' if one.frames > 1 else ''}"


def _standing(better: bool | None, worse: bool | None) -> Standing:
    return "ahead" if better else "behind" if worse else "open"


def _counts_standing(case: MapCase, mapped: Map, rival: Map) -> Standing:
    (low, high), (rival_low, rival_high) = _bounds(case, mapped), _bounds(case, rival)
    if low > rival_high:
        return "ahead"
    if high < rival_low:
        return "behind"
    return "level" if low == high == rival_low == rival_high else "open"


def _bounds(case: MapCase, one: Map) -> tuple[int, int]:
    states = list(case.status(one).values())
    found = states.count("found")
    return found, found + states.count("undecided")


def _found_text(case: MapCase, one: Map) -> str:
    low, high = _bounds(case, one)
    total = len(case.status(one))
    return f"{low} of {total}" if low == high else f"{low} to {high} of {total}"


def _slam_map(case: MapCase) -> Map | None:
    chosen = [one for one in case.maps if (one.registration, one.merge) == SLAM and one.views > 1]
    for one in sorted(chosen, key=lambda one: (not one.is_variation, -one.views)):
        if frames := case.frames(one.variant):
            return Map(one.variant, frames[-1], one.views)
    return None


def _noise(case: MapCase, one: Map) -> np.ndarray:
    runs = case.runs(one)
    return runs["surface_noise_mm"][runs["role"] == "damaged"].dropna().to_numpy(float)


def _measured_by_all(case: MapCase, maps: Sequence[Map]) -> list[str]:
    """Holes that each map measures in `FEWEST_BOTH` repeats at least."""
    counts = [case.holes(one).groupby("hole", sort=False)["extent_diameter_mm"].count() for one in maps]
    return [str(hole) for hole in counts[0].index if all(count.get(hole, 0) >= FEWEST_BOTH for count in counts)]


def _finds_none(case: MapCase, slam: Map, others: Sequence[Map]) -> bool | None:
    """Whether the map surely finds no hole while each of the others surely finds one."""
    return True if _bounds(case, slam)[1] == 0 and all(_bounds(case, one)[0] > 0 for one in others) else None


def _size_errors(case: MapCase, one: Map, holes: Sequence[str]) -> np.ndarray:
    return _errors(case.holes(one), holes, lambda rows: rows["extent_diameter_mm"] - rows["true_diameter_mm"])


def _place_errors(case: MapCase, one: Map, holes: Sequence[str]) -> np.ndarray:
    rows = case.holes(one)
    away = rows[rows["true_offset_mm"] > 0]
    return _errors(away, holes, lambda part: part["extent_offset_mm"] - part["true_offset_mm"])


def _errors(rows: pd.DataFrame, holes: Sequence[str], error: Callable[[pd.DataFrame], pd.Series]) -> np.ndarray:
    """(repeats, h) of the named holes that there are, NaN where not measured."""
    rows = rows[rows["hole"].isin(holes)]
    return rows.assign(_error=error(rows)).pivot(index="repeat", columns="hole", values="_error").to_numpy(float)


def rms_gap(first: np.ndarray, second: np.ndarray) -> Interval:
    """95 % interval of rms(first) - rms(second) over (repeats, h), NaN left out, by bootstrap over the repeats of each,
    which are independent; unknown below two repeats of either."""
    if min(len(first), len(second)) < 2 or not (np.isfinite(first).any() and np.isfinite(second).any()):
        return UNKNOWN
    rng = np.random.default_rng(0)
    draws = [_rms_draws(errors, rng) for errors in (first, second)]
    gaps = draws[0] - draws[1]
    tail = (1 - CONFIDENCE) / 2
    low, high = np.nanquantile(gaps, [tail, 1 - tail])
    return Interval(float(low), float(high))


def _rms_draws(errors: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    weights = rng.multinomial(len(errors), np.full(len(errors), 1 / len(errors)), RESAMPLES)
    there = np.isfinite(errors)
    squares = np.where(there, errors, 0.0) ** 2
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(weights @ squares.sum(axis=1) / (weights @ there.sum(axis=1))))


def _rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(errors**2)))


def _above(interval: Interval) -> bool | None:
    """Whether a difference is surely above zero."""
    return True if interval.above(0) else (False if interval.high <= 0 else None)
