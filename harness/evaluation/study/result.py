"""The evaluation of a whole study: every set-up's limit and curves, limits along each swept axis,
and their validity.

Intervals of ratios are slightly narrow: 8 to 9 % of those of equal set-ups exclude 1 (60 and 20
boards of 8)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, starmap
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.intervals import SITES_PER_TARGET, Interval, percentiles
from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.pod.hit_miss import NEAR_DEVIANCE
from harness.evaluation.study import curves
from harness.evaluation.study.boards import DRAWS
from harness.evaluation.study.curves import ChanceHits
from harness.evaluation.study.limit import ALL_FOUND, SetUpLimit, limit_of
from harness.evaluation.study.record import SetUpRecord, StudyRecord
from harness.evaluation.study.surface import PodSurface, surface_of
from harness.evaluation.study.unknowns import OverUnknowns, over_unknowns
from harness.records.trials import ResultTables
from harness.vocabulary.path_names import UNKNOWNS, camera_title, in_words
from harness.vocabulary.seeds import canonical_json

if TYPE_CHECKING:
    import pandas as pd

FRAMES = "capture.frames"  # the dotted path of the axis that every experiment has


@dataclass(frozen=True, eq=False)
class Difference:
    """Ratio of two set-ups' a90."""

    frm: SetUpLimit
    """The set-up whose a90 divides."""
    to: SetUpLimit
    """The set-up whose a90 is divided."""
    ratio: float
    """a90 of ``to`` over that of ``frm``."""
    interval: Interval
    """95 % interval over boards, without draws that are infinite for both."""
    paired: bool
    """True if both were judged on the same boards."""
    beyond_chance: bool
    """True if the interval excludes 1."""


@dataclass(frozen=True, eq=False)
class AxisLine:
    """Set-ups that differ only in one axis."""

    axis: str
    """Dotted path of the axis."""
    fixed: Mapping[str, Any]
    """Values of the other axes by dotted path."""
    values: tuple[Any, ...]
    """Values of the axis, ascending; text in the declared order."""
    limits: tuple[SetUpLimit, ...]
    """The limit at each value."""
    steps: tuple[Difference, ...]
    """The change from each value to the next."""
    numeric: bool
    """True if the values can be drawn to scale."""


def axis_lines(limits: Sequence[SetUpLimit]) -> tuple[AxisLine, ...]:
    """Return every line of two or more set-ups, axis by axis; frames last."""
    settings = [{**limit.record.axes, FRAMES: limit.record.frames} for limit in limits]
    lines = []
    for axis in dict.fromkeys(name for setting in settings for name in setting):
        groups: dict[str, list[int]] = {}
        for index, setting in enumerate(settings):
            if axis in setting:
                # a depth is not compared with a diameter
                size_name = limits[index].record.inspected.limit_of
                key = canonical_json([size_name, _without(setting, axis)])
                groups.setdefault(key, []).append(index)
        for members in groups.values():
            if len(members) > 1:
                lines.append(
                    _axis_line(
                        axis,
                        [settings[index] for index in members],
                        [limits[index] for index in members],
                    )
                )
    return tuple(lines)


def _without(setting: Mapping[str, Any], axis: str) -> dict[str, Any]:
    return {name: value for name, value in setting.items() if name != axis}


def _axis_line(
    axis: str,
    settings: Sequence[Mapping[str, Any]],
    limits: Sequence[SetUpLimit],
) -> AxisLine:
    """Return the line of these set-ups, with numbers in ascending order."""
    numeric = all(_is_number(setting[axis]) for setting in settings)
    order = list(range(len(limits)))
    if numeric:
        order.sort(key=lambda index: settings[index][axis])
    ordered = [limits[index] for index in order]
    return AxisLine(
        axis=axis,
        fixed=_without(settings[order[0]], axis),
        values=tuple(settings[index][axis] for index in order),
        limits=tuple(ordered),
        steps=tuple(difference(frm, to) for frm, to in pairwise(ordered)),
        numeric=numeric,
    )


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


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
        ratios = after / before if paired else np.divide.outer(after, before).ravel()
        ratio = float(np.divide(to.a90_mm, frm.a90_mm))
    interval = percentiles(ratios)
    return Difference(
        frm=frm,
        to=to,
        ratio=ratio,
        interval=interval,
        paired=paired,
        beyond_chance=interval.above(1.0) or interval.below(1.0),
    )


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
    sections = (
        ("What was inspected", _inspected(limits, facts.get("sweep") or {})),
        ("Precision", _precision(record)),
        ("What counts as a hit", _hits(record, limits)),
        ("Departures from MIL-HDBK-1823A", _departures(limits, chances, facts)),
        ("What is not included", _missing(limits, facts)),
        ("What is measured and what is simulated", tuple(facts.get("implanted", ()))),
    )
    return tuple((heading, sentences) for heading, sentences in sections if sentences)


def _precision(record: StudyRecord) -> tuple[str, ...]:
    """Return how many boards a study with a precision took, and what its sizes do to others."""
    if not record.designs:
        return ()
    sentences = [design.sentence for design in record.designs]
    sentences.append(
        "a90/95 is the bound over boards: damages of chosen sizes on one board tend to be found or "
        "missed together."
    )
    sentences.append(
        "Shares over all damages, such as the ROC, are those of these sizes; they lie higher or "
        "lower with sizes over the whole range."
    )
    return tuple(sentences)


def _hits(record: StudyRecord, limits: Sequence[SetUpLimit]) -> tuple[str, ...]:
    """Return the rule for a hit, and what it does to long and to large damage."""
    counted = (
        "closest pairs first, each finding for one damage at most; fixed beforehand, "
        "the same for all sizes"
    )
    sentences = [f"A damage is hit {record.hit_rule} ({counted})."]
    if record.hit_overlap is not None:
        sentences += [
            "Further findings that lie on a damage are its parts and not false calls.",
            "Chance hits are counted by centres alone, so those of long damage come out too low.",
        ]
    largest = max((limit.largest_mm for limit in limits), default=np.nan)
    if largest / 2 > record.hit_radius_mm:
        sentences.append(f"The largest damages, up to {largest:.3g} mm, reach beyond that radius.")
    return tuple(sentences)


def _true(rules: Sequence[tuple[object, str]]) -> tuple[str, ...]:
    return tuple(sentence for holds, sentence in rules if holds)


def _span(low: float, high: float) -> str:
    return f"{low:.3g} mm" if low == high else f"{low:.3g} to {high:.3g} mm"


def _inspected(limits: Sequence[SetUpLimit], sweep: Mapping[str, Sequence[Any]]) -> tuple[str, ...]:
    """Return sizes, depths and boards, together if all set-ups share them, else by set-up; and the
    axes."""
    labels_of: dict[str, list[str]] = {}
    for limit in limits:
        inspected = limit.record.inspected
        if not len(inspected.hit):
            continue
        wide = _span(inspected.diameter_mm.min(), inspected.diameter_mm.max())
        deep = _span(inspected.depth_mm.min(), inspected.depth_mm.max())
        text = (
            f"{limit.targets} damages on {limit.boards} boards, "
            f"{wide} in {inspected.size_of} and {deep} deep"
        )
        times = limit.inspections / limit.targets
        if times != 1:
            text += f", each inspected {times:.3g} times with new noise"
        labels_of.setdefault(text, []).append(limit.record.label)
    sentences = []
    for text, labels in labels_of.items():
        prefix = f"{', '.join(labels)}: " if len(labels_of) > 1 else ""
        sentences.append(f"{prefix}{text}.")
    for path, values in sweep.items():
        words = [in_words(f"{path}={canonical_json(value)}") for value in values]
        sentences.append(f"Varied: {'; '.join(words)}.")
    return tuple(sentences)


def _departures(
    limits: Sequence[SetUpLimit],
    chances: Sequence[ChanceHits | None],
    facts: Mapping[str, Any],
) -> tuple[str, ...]:
    per_board = max((limit.targets / limit.boards for limit in limits if limit.boards), default=1.0)
    # Unflawed sites are those of drawn damage on hole-free boards.
    sites_per_damage = [
        chance.sites / limit.targets
        for limit, chance in zip(limits, chances, strict=True)
        if chance and limit.targets
    ]
    fewest_sites = min(sites_per_damage, default=np.inf)
    failed = sum(limit.record.failed for limit in limits)
    units = max((limit.record.units for limit in limits), default=1)
    all_found = any(limit.statement is None and limit.a90_95.demonstrated for limit in limits)
    rules = [
        (
            facts.get("source", {}).get("kind") == "simulated",
            (
                "Boards and camera are simulated. The handbook demands real flaws and the real "
                "system."
            ),
        ),
        (
            per_board > 1,
            f"Targets share boards, {per_board:.3g} per board. a90/95 takes them as independent; "
            "the bound with their design effect stands beside it (Rao and Scott 1984).",
        ),
        (
            any(limit.inspections > limit.targets for limit in limits),
            "Targets were inspected more than once with new noise and count once each, the "
            "criterion of a90/95 scaled by the number of inspections.",
        ),
        (
            units > 1,
            f"{units} units of the camera inspected each damaged board, and every board on which "
            "false calls were counted was recorded by its own unit. Intervals of sizes resample "
            "units and boards; patches of one sensor are assumed to be alike.",
        ),
        (
            any(limit.record.calibration_runs for limit in limits),
            "Other calibration boards would give another threshold; no interval here includes "
            "this scatter.",
        ),
        (
            fewest_sites < SITES_PER_TARGET,
            f"Unflawed places for each damage: {fewest_sites:.3g}; the handbook asks for "
            f"{SITES_PER_TARGET}. Besides, false calls are counted on the whole face of undamaged "
            "boards.",
        ),
    ]
    for limit in limits:
        if limit.statement is not None:
            rules += _sizes_miss_the_rise(limit, limit.statement.curve)
    rules += [
        (
            any(limit.statement is not None for limit in limits),
            f"The same data chose the model: a90/95 is the largest over models whose {NEARLY}.",
        ),
        (
            all_found,
            "Where all damages were found there is no curve. a90/95 is then the "
            f"{ALL_FOUND}th smallest size: were its POD below 90 %, the {ALL_FOUND} smallest "
            "would all be found in less than 5 % of studies.",
        ),
        (
            len(limits) > 1,
            f"{len(limits)} limits are stated; each interval holds for one limit, not for all "
            "jointly.",
        ),
        (
            failed > 0,
            f"Failed trials ({failed}) are not counted: a refused board is not a miss.",
        ),
    ]
    return _true(rules)


def _sizes_miss_the_rise(limit: SetUpLimit, curve: PodCurve) -> list[tuple[bool, str]]:
    smallest_mm = limit.record.inspected.size_mm.min()
    low, high = curve.pod(np.array([smallest_mm, limit.largest_mm])).tolist()
    label = limit.record.label
    return [
        (
            low > RISE[0],
            f"{label}: the smallest size inspected is found with a POD of {100 * low:.2g} %.",
        ),
        (
            high < RISE[1],
            f"{label}: the largest size inspected is found with a POD of {100 * high:.2g} %.",
        ),
    ]


def _one_kind(facts: Mapping[str, Any]) -> str:
    """Return the kind of all damage; empty if nothing is drawn or an axis varies the damage."""
    kind = facts.get("source", {}).get("target", {}).get("damage", {}).get("kind", "")
    sweep = facts.get("sweep") or {}
    varied = any("source.target.damage.kind".startswith(axis) for axis in sweep)
    return kind if kind in KINDS and not varied else ""


def _damage_words(facts: Mapping[str, Any]) -> str:
    """Return all damage as ``gouges 60 mm long, 10 mm wide``: its kind, and the sizes that are the
    same everywhere."""
    kind = _one_kind(facts)
    if not kind:
        return ""
    sweep = facts.get("sweep") or {}
    damage = facts["source"]["target"]["damage"]
    same = []
    for name, words in SIZES.items():
        ends = damage.get(name)
        varied = f"source.target.damage.{name}" in sweep
        if ends and ends[0] == ends[1] and not varied:
            same.append(f"{ends[0]:g} mm {words}")
    return f"{KINDS[kind]} {', '.join(same)}".strip()


def _missing(limits: Sequence[SetUpLimit], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the subjects that this study does not cover."""
    source = facts.get("source", {})
    sweep = facts.get("sweep") or {}
    kind = _one_kind(facts)
    only = f": all are {KINDS[kind]}" if kind else ""
    one_seed = "camera" in source and "source.camera.unit_seed" not in sweep
    rules = (
        (
            True,
            "An inspector, who can miss findings and doubt others: "
            "the POD is that of the program alone.",
        ),
        (
            source.get("target", {}).get("name") == "drawn",
            "Damage of another kind, damage in rows or clusters, "
            f"or several kinds on one board{only}.",
        ),
        (
            source.get("kind") == "simulated",
            "Translucency, undeclared light and gloss, motion, dirt and wear.",
        ),
        (
            one_seed and all(limit.record.units == 1 for limit in limits),
            "Other units of the camera: fixed pattern and offset are those of one unit. The error "
            "that remains after many frames lies on the same pixels of all its boards, which the "
            "intervals ignore.",
        ),
        (
            any(limit.boards for limit in limits),
            "Boards of another family: the intervals hold for boards drawn like these.",
        ),
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
    damage = _damage_words(facts)
    conditions = [damage] if damage else []
    varied_paths = [*(facts.get("sweep") or {})]
    varied_paths += [unknown["key"] for unknown in facts.get(UNKNOWNS) or ()]
    has_threshold = False
    for path, words in CONDITIONS:
        value = _value_at(facts, path)
        is_threshold = path.startswith("threshold")
        varied = any(path.startswith(varied_path) for varied_path in varied_paths)
        if value is None or varied or (is_threshold and has_threshold):
            continue
        text = words.format(camera_title(value) if isinstance(value, str) else value)
        conditions.append(text.replace(" 1 false calls", " 1 false call"))
        has_threshold = has_threshold or is_threshold
    declared = _declared_damages(facts)
    if inspected is not None and inspected < declared:
        conditions.append(
            f"only {inspected} of {declared} damages were in view and inspected by every set-up"
        )
    return ", ".join(conditions)


def _value_at(facts: Mapping[str, Any], path: str) -> Any:
    """Return the value at a dotted path; None if there is none."""
    value: Any = facts
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _declared_damages(facts: Mapping[str, Any]) -> int:
    """Return the number of damages of the experiment: drawn on all boards, or holes of one; 0 if
    their number follows from a precision."""
    target = facts.get("source", {}).get("target") or {}
    study = facts.get("study") or {}
    if study.get("precision"):
        return 0
    drawn: int = target.get("damage", {}).get("per_board", 0) * study.get("boards", 0)
    return drawn or len(target.get("holes") or ())


@dataclass(frozen=True, eq=False)
class SetUpResult:
    """One set-up: its limit, chance hits and curves."""

    limit: SetUpLimit
    """The detection limit."""
    chance: ChanceHits | None
    """Chance hits; None if there are no other boards to compare."""
    roc: curves.Roc | None
    """ROC of damages and undamaged sites; None if not counted."""
    free_response: curves.FreeResponse | None
    """Free-response curve; None if not counted."""
    pixels: curves.PixelCurves | None
    """Per-region overlap; None if not counted."""
    surface: PodSurface | None
    """POD over diameter and depth; None if there is none."""
    surface_why: str
    """Reason why there is no surface; else empty."""
    unknowns: OverUnknowns | None = None
    """What unknowns do to the limit; None if the set-up draws none."""


@dataclass(frozen=True, eq=False)
class StudyResult:
    """A whole study."""

    record: StudyRecord
    """Its inspections."""
    set_ups: tuple[SetUpResult, ...]
    """Set-ups in the record's order."""
    limits: tuple[SetUpLimit, ...]
    """Their limits."""
    axes: tuple[AxisLine, ...]
    """Lines along swept axes."""
    validity: tuple[Section, ...]
    """Headings and sentences on what the limits hold for."""
    facts: Mapping[str, Any]
    """The resolved experiment as plain data."""

    @property
    def conditions(self) -> str:
        """Return what all set-ups have in common, in one line."""
        fewest = min((limit.targets for limit in self.limits), default=None)
        precisions = [design.outcome for design in self.record.designs]
        conditions = ", ".join(filter(None, [conditions_of(self.facts, fewest), *precisions]))
        errors = [result.limit.record.threshold_error for result in self.set_ups]
        known_errors = [error for error in errors if error is not None]
        if not known_errors:
            return conditions
        low = min(error.low_per_m2 for error in known_errors)
        high = max(error.high_per_m2 for error in known_errors)
        wanted = f"{self.record.false_calls_per_m2:g} false call"
        plural = "" if self.record.false_calls_per_m2 == 1 else "s"
        stated = f"threshold for {wanted}{plural} per m²"
        return conditions.replace(stated, f"{stated} ({low:.1f} to {high:.1f})")


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
    arguments = []
    for set_up in record.set_ups:
        own_tables = tables.of(set_up.variant, set_up.frames)
        arguments.append((set_up, own_tables, record.hit_radius_mm, draws))
    set_ups = []
    for result, own_arguments in zip(each_of(_set_up, arguments), arguments, strict=True):
        set_ups.append(result or _set_up(*own_arguments))
    limits = tuple(result.limit for result in set_ups)
    return StudyResult(
        record=record,
        set_ups=tuple(set_ups),
        limits=limits,
        axes=axis_lines(limits),
        validity=validity_of(record, limits, [result.chance for result in set_ups], facts),
        facts=facts,
    )


def _set_up(
    record: SetUpRecord,
    tables: ResultTables,
    radius_mm: float,
    draws: int,
) -> SetUpResult:
    """Evaluate a set-up from its own ``tables``."""
    holes = tables.holes
    sites = tables.sites
    runs = tables.runs
    limit = limit_of(record, draws=draws, tested=True)
    chance = None
    if not holes.empty and not runs.empty:
        limit = _with_measures(limit, holes, runs)
        chance = curves.chance_hits(
            holes, sites, runs, tables.findings, radius_mm, limit.false_calls
        )
    surface, why = surface_of(record, draws)
    return SetUpResult(
        limit=limit,
        chance=chance,
        roc=curves.roc_curve(holes, sites, record.threshold),
        free_response=curves.free_response(tables.operating, runs, holes, draws),
        pixels=curves.pixel_curves(tables.pixels),
        surface=surface,
        surface_why=why,
        unknowns=over_unknowns(record, draws),
    )


def _with_measures(
    limit: SetUpLimit,
    holes: pd.DataFrame,
    runs: pd.DataFrame,
) -> SetUpLimit:
    """Add the typical error of measured sizes, and the time of a cloud."""
    size_of = limit.record.inspected.size_of
    column = "model_diameter_mm" if size_of == "diameter" else f"{size_of}_mm"
    sized = holes[holes["detected"].astype(bool) & holes[column].notna()]
    error_mm = (sized[column] - sized["true_diameter_mm"]).abs()
    seconds = runs.loc[runs["role"] == "damaged", "seconds_detect"]
    return replace(
        limit,
        size_error_mm=float(error_mm.median()),
        sized=len(sized),
        seconds_detect=float(seconds.median()),
    )
