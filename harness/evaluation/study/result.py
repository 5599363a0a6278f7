"""The evaluation of a whole study: every set-up's limit and curves, limits along each swept axis,
and their validity.

Intervals of ratios are slightly narrow: 8 to 9 % of those of equal set-ups exclude 1 (60 and 20
boards of 8)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, starmap
from typing import Any

import numpy as np

from harness.evaluation.intervals import SITES_PER_TARGET, Interval, percentiles
from harness.evaluation.pod.hit_miss import NEAR_DEVIANCE
from harness.evaluation.study import curves
from harness.evaluation.study.curves import ChanceHits
from harness.evaluation.study.limit import (
    ALL_FOUND,
    DRAWS,
    PodSurface,
    SetUpLimit,
    limit_of,
    surface_of,
)
from harness.evaluation.study.record import SetUpRecord, StudyRecord
from harness.records.trials import ResultTables
from harness.vocabulary.path_names import camera_title, in_words
from harness.vocabulary.seeds import canonical_json

FRAMES = "capture.frames"  # the dotted path of the axis that every experiment has


@dataclass(frozen=True, eq=False)
class Difference:
    """Ratio of ``to``'s a90 to ``frm``'s, with its 95 % interval over boards, without draws that
    are infinite for both. ``paired``: judged on the same boards. ``beyond_chance``: the interval
    excludes 1."""

    frm: SetUpLimit
    to: SetUpLimit
    ratio: float
    interval: Interval
    paired: bool
    beyond_chance: bool


@dataclass(frozen=True, eq=False)
class AxisLine:
    """Set-ups that differ only in ``axis`` (a dotted path). ``fixed``: the other axes. ``values``
    and ``limits``: ascending, text in the declared order. ``steps``: from each to the next.
    ``numeric``: can be drawn to scale."""

    axis: str
    fixed: Mapping[str, Any]
    values: tuple[Any, ...]
    limits: tuple[SetUpLimit, ...]
    steps: tuple[Difference, ...]
    numeric: bool


def axis_lines(limits: Sequence[SetUpLimit]) -> tuple[AxisLine, ...]:
    """Return every line of two or more set-ups, axis by axis; frames last."""
    places = [{**limit.record.axes, FRAMES: limit.record.frames} for limit in limits]
    lines = []
    for axis in dict.fromkeys(name for place in places for name in place):
        groups: dict[str, list[int]] = {}
        for index, place in enumerate(places):
            if axis in place:
                held = {name: value for name, value in place.items() if name != axis}
                same = [
                    limits[index].record.inspected.limit_of,
                    held,
                ]  # a depth is not compared with a diameter
                groups.setdefault(canonical_json(same), []).append(index)
        for members in groups.values():
            values = [places[index][axis] for index in members]
            numeric = all(
                isinstance(value, int | float) and not isinstance(value, bool) for value in values
            )
            if numeric:
                members = sorted(members, key=lambda index: places[index][axis])
            if len(members) > 1:
                line = tuple(limits[index] for index in members)
                held = {name: value for name, value in places[members[0]].items() if name != axis}
                ordered = [places[index][axis] for index in members]
                steps = [difference(*two) for two in pairwise(line)]
                lines.append(AxisLine(axis, held, tuple(ordered), line, tuple(steps), numeric))
    return tuple(lines)


def difference(frm: SetUpLimit, to: SetUpLimit) -> Difference:
    """Compare a90 of two set-ups: paired if both have the same boards and damage, and no failed
    trials."""
    a = frm.record.inspected
    b = to.record.inspected
    paired = all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for name in ("board", "hole", "x_mm", "y_mm")
    )
    before = frm.a90_draws_mm
    after = to.a90_draws_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        interval = percentiles(after / before if paired else np.divide.outer(after, before).ravel())
        ratio = float(np.divide(to.a90_mm, frm.a90_mm))
    return Difference(frm, to, ratio, interval, paired, interval.above(1.0) or interval.below(1.0))


Section = tuple[str, tuple[str, ...]]
KINDS = {
    "through": "holes drilled through",
    "blind": "holes with a flat bottom",
    "dent": "spherical dents",
    "slot": "slots",
    "gouge": "gouges",
    "pressed_dent": "pressed dents",
    "pressed_bump": "pressed bumps",
    "corrosion": "patches of corrosion",
    "chip": "chips at an edge",
    "protrusion": "protrusions",
}
SIZES = {"diameter_mm": "in diameter", "length_mm": "long", "width_mm": "wide", "depth_mm": "deep"}
NEARLY = f"deviance is at most {NEAR_DEVIANCE:g} above the least"
RISE = (0.05, 0.95)
"""POD between which the curve rises; sizes should reach beyond both, else only one side of the
curve is known."""


def validity_of(
    record: StudyRecord,
    limits: Sequence[SetUpLimit],
    chances: Sequence[ChanceHits | None],
    facts: Mapping[str, Any],
) -> tuple[Section, ...]:
    """Return headings with their sentences. ``facts``: the resolved experiment as plain data
    (``source``, ...)."""
    radius = record.hit_radius_mm
    largest = max((limit.largest_mm for limit in limits), default=np.nan)
    counted = "closest pairs first, each finding for one damage at most; fixed beforehand, the same for all sizes"
    hits = [f"A damage is hit {record.hit_rule} ({counted})."]
    if record.hit_overlap is not None:
        hits += ["Further findings that lie on a damage are its parts and not false calls."]
        hits += [
            "Chance hits are counted by centres alone, so those of long damage come out too low."
        ]
    hits += (
        [f"The largest damages, up to {largest:.3g} mm, reach beyond that radius."]
        if largest / 2 > radius
        else []
    )
    sections = (
        ("What was inspected", _inspected(limits, facts.get("sweep") or {})),
        ("What counts as a hit", tuple(hits)),
        ("Departures from MIL-HDBK-1823A", _departures(limits, chances, facts)),
        ("What is not included", _missing(limits, facts)),
        ("What is measured and what is simulated", tuple(facts.get("implanted", ()))),
    )
    return tuple((heading, sentences) for heading, sentences in sections if sentences)


def _true(rules: Sequence[tuple[object, str]]) -> tuple[str, ...]:
    return tuple(sentence for holds, sentence in rules if holds)


def _span(low: float, high: float) -> str:
    return f"{low:.3g} mm" if low == high else f"{low:.3g} to {high:.3g} mm"


def _inspected(limits: Sequence[SetUpLimit], sweep: Mapping[str, Sequence[Any]]) -> tuple[str, ...]:
    """Return sizes, depths and boards, together if all set-ups share them, else by set-up; and the
    axes."""
    reasons: dict[str, list[str]] = {}
    for limit in limits:
        seen = limit.record.inspected
        if len(seen.hit):
            times = limit.inspections / limit.targets
            wide = _span(seen.diameter_mm.min(), seen.diameter_mm.max())
            deep = _span(seen.depth_mm.min(), seen.depth_mm.max())
            text = f"{limit.targets} damages on {limit.boards} boards, {wide} in {seen.size_of} and {deep} deep"
            text += "" if times == 1 else f", each inspected {times:.3g} times with new noise"
            reasons.setdefault(text, []).append(limit.record.label)
    whose = {
        text: "" if len(reasons) == 1 else f"{', '.join(labels)}: "
        for text, labels in reasons.items()
    }
    words = (
        [in_words(f"{path}={canonical_json(value)}") for value in values]
        for path, values in sweep.items()
    )
    return (
        *(f"{labels}{text}." for text, labels in whose.items()),
        *(f"Varied: {'; '.join(each)}." for each in words),
    )


def _departures(
    limits: Sequence[SetUpLimit], chances: Sequence[ChanceHits | None], facts: Mapping[str, Any]
) -> tuple[str, ...]:
    a_board = max((limit.targets / limit.boards for limit in limits if limit.boards), default=1.0)
    # Unflawed places are places of drawn damage on hole-free boards.
    places = [
        each.sites / limit.targets
        for limit, each in zip(limits, chances, strict=True)
        if each and limit.targets
    ]
    fewest_places = min(places, default=np.inf)
    failed = sum(limit.record.failed for limit in limits)
    chosen = any(limit.statement is not None for limit in limits)
    all_found = any(limit.statement is None and limit.a90_95.demonstrated for limit in limits)
    simulated = facts.get("source", {}).get("kind") == "simulated"
    repeated = any(limit.inspections > limit.targets for limit in limits)
    calibrated = any(limit.record.calibration_runs for limit in limits)
    units = max((limit.record.units for limit in limits), default=1)
    independent = (
        "a90/95 takes them as independent; the bound with their design effect stands beside it"
    )
    counted = "and count once each, the criterion of a90/95 scaled by the number of inspections"
    rules = (
        (
            simulated,
            "Boards and camera are simulated. The handbook demands real flaws and the real system.",
        ),
        (
            a_board > 1,
            f"Targets share boards, {a_board:.3g} per board. {independent} (Rao and Scott 1984).",
        ),
        (repeated, f"Targets were inspected more than once with new noise {counted}."),
        (
            units > 1,
            f"{units} units of the camera inspected each damaged board, and every other board was recorded by its own "
            "unit. Intervals of sizes resample units and boards; patches of one sensor are assumed to be alike.",
        ),
        (
            calibrated,
            "Other calibration boards would give another threshold; no interval here includes this scatter.",
        ),
        (
            fewest_places < SITES_PER_TARGET,
            f"Unflawed places for each damage: {fewest_places:.3g}; the handbook asks for {SITES_PER_TARGET}. "
            "Besides, false calls are counted on the whole face of undamaged boards.",
        ),
        *(rule for limit in limits if limit.statement for rule in _sizes_miss_the_rise(limit)),
        (
            chosen,
            f"The same data chose the model: a90/95 is the largest over models whose {NEARLY}.",
        ),
        (
            all_found,
            f"Where all damages were found there is no curve. a90/95 is then the {ALL_FOUND}th smallest size: were its "
            f"POD below 90 %, the {ALL_FOUND} smallest would all be found in less than 5 % of studies.",
        ),
        (
            len(limits) > 1,
            f"{len(limits)} limits are stated; each interval holds for one limit, not for all jointly.",
        ),
        (failed, f"Failed trials ({failed}) are not counted: a refused board is not a miss."),
    )
    return _true(rules)


def _sizes_miss_the_rise(limit: SetUpLimit) -> tuple[tuple[bool, str], ...]:
    assert limit.statement is not None
    label = limit.record.label
    curve = limit.statement.curve
    low, high = curve.pod(
        np.array([limit.record.inspected.size_mm.min(), limit.largest_mm])
    ).tolist()
    return (
        (
            low > RISE[0],
            f"{label}: the smallest size inspected is found with a POD of {100 * low:.2g} %.",
        ),
        (
            high < RISE[1],
            f"{label}: the largest size inspected is found with a POD of {100 * high:.2g} %.",
        ),
    )


def _one_kind(facts: Mapping[str, Any]) -> str:
    """Return the kind of all damage drawn; empty if nothing is drawn or an axis varies the damage."""
    kind = facts.get("source", {}).get("target", {}).get("damage", {}).get("kind", "")
    varied = any("source.target.damage.kind".startswith(axis) for axis in facts.get("sweep") or {})
    return kind if kind in KINDS and not varied else ""


def _damage_words(facts: Mapping[str, Any]) -> str:
    """Return all damage as ``gouges 60 mm long, 10 mm wide``: its kind, and the sizes that are the
    same everywhere."""
    kind = _one_kind(facts)
    sweep = facts.get("sweep") or {}
    if not kind:
        return ""
    damage = facts["source"]["target"]["damage"]
    ranges = {
        name: damage.get(name) for name in SIZES if f"source.target.damage.{name}" not in sweep
    }
    same = [
        f"{ends[0]:g} mm {SIZES[name]}"
        for name, ends in ranges.items()
        if ends and ends[0] == ends[1]
    ]
    return f"{KINDS[kind]} {', '.join(same)}".strip()


def _missing(limits: Sequence[SetUpLimit], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the subjects that this study does not cover."""
    source = facts.get("source", {})
    sweep = facts.get("sweep") or {}
    target = source.get("target", {})
    only = f": all are {KINDS[kind]}" if (kind := _one_kind(facts)) else ""
    one_unit = "camera" in source and "source.camera.unit_seed" not in sweep
    one_unit &= all(limit.record.units == 1 for limit in limits)
    judged = any(limit.boards for limit in limits)
    simulated = source.get("kind") == "simulated"
    drawn = target.get("name") == "drawn"
    rules = (
        (
            True,
            "An inspector, who can miss findings and doubt others: the POD is that of the program alone.",
        ),
        (
            drawn,
            f"Damage of another kind, damage in rows or clusters, or several kinds on one board{only}.",
        ),
        (simulated, "Translucency, undeclared light and gloss, motion, dirt and wear."),
        (
            one_unit,
            "Other units of the camera: fixed pattern and offset are those of one unit. The error that remains "
            "after many frames lies on the same pixels of all its boards, which the intervals ignore.",
        ),
        (judged, "Boards of another family: the intervals hold for boards drawn like these."),
    )
    return _true(rules)


CONDITIONS = (
    ("source.camera.name", "{}"),
    ("source.target.distance_m", "at {:g} m"),
    ("source.target.tilt_deg", "tilted by up to {:g}°"),
    ("source.target.backing.distance_mm", "with a surface {:g} mm behind"),
    ("source.target.backing_distance_mm", "with a surface {:g} mm behind"),
    ("source.target.material.albedo_850", "albedo {:g}"),
    ("source.target.plywood_albedo_850", "albedo {:g}"),
    ("detector.name", "detector {}"),
    ("threshold.k", "threshold {:g} deviations"),
    ("threshold.calibrate.false_calls_per_m2", "threshold for {:g} false calls per m²"),
    ("threshold.calibrate.repeats", "threshold set to the highest score of {:g} hole-free runs"),
)
"""Settings that every set-up shares, in words, where no axis varies them."""


def conditions_of(facts: Mapping[str, Any], inspected: int | None = None) -> str:
    """Return the conditions common to all set-ups in one line, damage first. ``inspected``:
    damages in view."""
    conditions = [words] if (words := _damage_words(facts)) else []
    for path, words in CONDITIONS:
        value: Any = facts
        for key in path.split("."):
            value = value.get(key) if isinstance(value, Mapping) else None
        varied = any(path.startswith(axis) for axis in facts.get("sweep") or {})
        known = words.startswith("threshold") and any(
            text.startswith("threshold") for text in conditions
        )
        if value is not None and not varied and not known:
            text = words.format(camera_title(value) if isinstance(value, str) else value)
            conditions.append(text.replace(" 1 false calls", " 1 false call"))
    target = facts.get("source", {}).get("target") or {}
    study = facts.get("study") or {}
    declared = target.get("damage", {}).get("per_board", 0) * study.get("boards", 0) or len(
        target.get("holes") or ()
    )
    if inspected is not None and inspected < declared:
        conditions.append(
            f"only {inspected} of {declared} damages were in view and inspected by every set-up"
        )
    return ", ".join(conditions)


@dataclass(frozen=True, eq=False)
class SetUpResult:
    """One set-up. ``chance``: None if there are no other boards to compare. ``roc``,
    ``free_response``, ``pixels``: None if not counted. ``surface``: over diameter and depth, or
    ``surface_why`` there is none."""

    limit: SetUpLimit
    chance: ChanceHits | None
    roc: curves.Roc | None
    free_response: curves.FreeResponse | None
    pixels: curves.PixelCurves | None
    surface: PodSurface | None
    surface_why: str


@dataclass(frozen=True, eq=False)
class StudyResult:
    """``set_ups``: in the record's order. ``axes``: lines along swept axes. ``facts``: the
    resolved experiment."""

    record: StudyRecord
    set_ups: tuple[SetUpResult, ...]
    limits: tuple[SetUpLimit, ...]
    axes: tuple[AxisLine, ...]
    validity: tuple[Section, ...]
    facts: Mapping[str, Any]

    @property
    def conditions(self) -> str:
        """Return what all set-ups have in common, in one line."""
        return conditions_of(
            self.facts, min((limit.targets for limit in self.limits), default=None)
        )


def evaluate_study(
    record: StudyRecord,
    tables: ResultTables,
    facts: Mapping[str, Any],
    *,
    draws: int = DRAWS,
    each_of: Callable[..., Iterable[SetUpResult | None]] = starmap,
) -> StudyResult:
    """Evaluate a study. ``facts``: its resolved experiment, plain data. ``each_of``: calls a
    function with each of several arguments, such as in other processes, which may fail (None).
    Deterministic. A limit without a curve says why."""
    radius_mm = record.hit_radius_mm
    arguments = [
        (each, tables.of(each.variant, each.frames), radius_mm, draws) for each in record.set_ups
    ]
    set_ups = tuple(
        found or _set_up(*own)
        for found, own in zip(each_of(_set_up, arguments), arguments, strict=True)
    )
    limits = tuple(set_up.limit for set_up in set_ups)
    validity = validity_of(record, limits, [set_up.chance for set_up in set_ups], facts)
    return StudyResult(record, set_ups, limits, axis_lines(limits), validity, facts)


def _set_up(record: SetUpRecord, tables: ResultTables, radius_mm: float, draws: int) -> SetUpResult:
    """Evaluate a set-up from its own ``tables``."""
    holes = tables.holes
    sites = tables.sites
    runs = tables.runs
    limit = limit_of(record, draws=draws, tested=True)
    chance = None
    if not holes.empty and not runs.empty:
        column = (
            "model_diameter_mm"
            if record.inspected.size_of == "diameter"
            else f"{record.inspected.size_of}_mm"
        )
        sized = holes[holes["detected"].astype(bool) & holes[column].notna()]
        typical_mm = float((sized[column] - sized["true_diameter_mm"]).abs().median())
        seconds = float(runs.loc[runs["role"] == "damaged", "seconds_detect"].median())
        limit = replace(limit, size_error_mm=typical_mm, sized=len(sized), seconds_detect=seconds)
        chance = curves.chance_hits(
            holes, sites, runs, tables.findings, radius_mm, limit.false_calls
        )
    roc = curves.roc_curve(holes, sites, record.threshold)
    response = curves.free_response(tables.operating, runs, holes, draws)
    pixels = curves.pixel_curves(tables.pixels)
    return SetUpResult(limit, chance, roc, response, pixels, *surface_of(record, draws))
