"""The limits of validity of a study, on one page: what was varied, what was held, what is not in it, and how its
statistics depart from MIL-HDBK-1823A. Every sentence is true of the study at hand, or it is not there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from harness.evaluation.pod.false_calls import SITES_PER_TARGET
from harness.evaluation.pod.statement import LEAST_TARGETS
from harness.evaluation.study.chance import ChanceHits
from harness.evaluation.study.limit import ALL_FOUND, SetUpLimit
from harness.evaluation.study.record import StudyRecord
from harness.evaluation.study.surface import depth_varies

Section = tuple[str, tuple[str, ...]]
KINDS = {"through": "holes drilled through", "blind": "holes with a flat bottom", "dent": "spherical dents"}
TESTS_THE_HARNESS = ("oracle", "blind")
"""Detectors whose limits say something of the harness only."""
RISE = (0.05, 0.95)
"""POD between which the curve rises; sizes should reach past both, or the curve is known from one side."""


SPREADS = {
    "distance_jitter_mm": "its distance by ±{} mm",
    "offset_mm": "its place across the view by ±{} mm, both ways",
    "tilt_deg": "its tilt by ±{}° about two axes",
    "roll_deg": "its roll by ±{}°",
}
"""Half-widths (of a family of boards) of uniform distributions, by the key that declares them."""
DRAWN = {"diameter_mm": "diameter", "depth_mm": "depth"}
"""Ranges of each damage, by the key that declares them."""
GROUPS = (
    ("Boards", ("source.target",)),
    ("Camera", ("source.camera",)),
    ("Views", ("source.views",)),
    ("Averaging", ("capture",)),
    ("Map", ("mapping",)),
    ("Detector", ("detector",)),
    ("Render", ("source.render",)),
)
"""Headings of what is held, for each part of the declaration."""
NOT_HELD = ("source.target.seed", "source.target.damage", "source.target.sizes")
"""Drawn at random, or told elsewhere."""


def validity_of(
    record: StudyRecord,
    limits: Sequence[SetUpLimit],
    chances: Sequence[ChanceHits | None],
    facts: Mapping[str, Any],
) -> tuple[Section, ...]:
    """State headings with their sentences. ``facts``: the resolved experiment as plain data (``source``, ...)."""
    sections = (
        ("What was varied", (*_inspected(limits), *varied_sentences(facts), *swept_sentences(facts))),
        ("What was held", held_sentences(facts)),
        ("What counts as a hit", _hits(record, limits)),
        ("Threshold and false calls", tuple(_calls(record, limit) for limit in limits)),
        ("Hits by chance", tuple(_chance(limit, one) for limit, one in zip(limits, chances, strict=True) if one)),
        ("The model and what it stands on", tuple(_model(limit) for limit in limits)),
        ("Departures from MIL-HDBK-1823A", _departures(limits, chances, facts)),
        ("What is not in it", _missing(limits, facts)),
    )
    return tuple((heading, sentences) for heading, sentences in sections if sentences)


def _inspected(limits: Sequence[SetUpLimit]) -> tuple[str, ...]:
    """Sizes, depths, boards and places, where all set-ups have them in common, else set-up by set-up."""
    said: dict[str, list[str]] = {}
    for limit in limits:
        seen = limit.record.inspected
        if not len(seen.hit):
            continue
        low, high = float(seen.depth_mm.min()), float(seen.depth_mm.max())
        deep = f"all {number(low)} mm deep" if low == high else f"{_span(low, high)} mm deep"
        noise = limit.inspections / limit.targets
        repeats = "" if noise == 1 else f", each inspected {number(noise)} times with new noise"
        text = (
            f"{limit.targets} damages on {limit.boards} boards, "
            f"{_span(seen.diameter_mm.min(), seen.diameter_mm.max())} mm in diameter and {deep}{repeats}"
        )
        said.setdefault(text, []).append(limit.record.label)
    if len(said) == 1:
        return (f"{next(iter(said))}.",)
    return tuple(f"{', '.join(labels)}: {text}." for text, labels in said.items())


def _hits(record: StudyRecord, limits: Sequence[SetUpLimit]) -> tuple[str, ...]:
    radius = number(record.hit_radius_mm)
    rule = (
        f"A damage is hit where the centre of a finding lies within {radius} mm of its own; the closest pairs first, "
        "each finding for one damage at most. The radius was fixed beforehand and is the same for all sizes"
    )
    smaller = [one for one in limits if one.largest_mm / 2 > record.hit_radius_mm]
    if smaller:
        return (f"{rule}.", f"The largest damages, up to {number(smaller[0].largest_mm)} mm, reach beyond that radius.")
    return (f"{rule}.",)


def _calls(record: StudyRecord, limit: SetUpLimit) -> str:
    one = limit.record
    where = f"{one.label}: threshold {number(one.threshold)}, {number(one.threshold_mm)} mm"
    if one.calibration_runs and record.false_calls_per_m2 is not None:
        wanted = number(record.false_calls_per_m2)
        where += f", set for a rate of {wanted} per m² on {one.calibration_runs} hole-free runs of boards of their own"
    else:
        where += ", given and not calibrated"
    rate = limit.false_calls
    if rate is None:
        return f"{where}. False calls were not counted: no hole-free board was inspected."
    interval = rate.interval_per_m2
    found = (
        f"{where}. Found on other hole-free boards: {number(rate.rate_per_m2)} per m² "
        f"({_span(interval.low, interval.high)}, 95 %), {_counted(rate.calls, 'call')} on {number(rate.area_m2)} m²"
    )
    if record.false_calls_per_m2 is None or not one.calibration_runs:
        return f"{found}."
    apart = not interval.low <= record.false_calls_per_m2 <= interval.high
    return f"{found}; {'the rate wanted lies outside' if apart else 'the rate wanted lies inside'}."


def _chance(limit: SetUpLimit, chance: ChanceHits) -> str:
    text = f"{limit.record.label}: {_percent(chance.probability)} of damages would be hit by chance"
    if chance.interval.known:
        text += f" ({_percent(chance.interval.low)} to {_percent(chance.interval.high)}, 95 %)"
    text += ", by places laid over other boards' findings"
    if chance.sites:
        text += f"; {number(chance.found)} of {chance.sites} places without damage were hit"
    return f"{text}."


def _model(limit: SetUpLimit) -> str:
    label = limit.record.label
    basis = f"{limit.targets} targets on {limit.boards} boards"
    if limit.statement is None:
        return f"{label}: no curve, as {limit.why}; {basis}. a90/95: {_size(limit, limit.a90_95.value)}."
    text = f"{label}: {limit.statement.model}, of all links and axes the one with the least deviance; {basis}"
    if np.isfinite(limit.design_effect):
        text += f"; boards multiply the variance of a90 by {number(limit.design_effect)}"
    bounds = [_size(limit, value) for value in (limit.a90_95.value, limit.over_boards_mm)]
    text += (
        f". a90/95: {bounds[0]} with damages of one board as independent, {bounds[1]} with that factor in it, where it "
        "is above 1"
    )
    return f"{text}{': damages of one board are alike, quote the larger' if limit.boards_matter else ''}."


def _departures(
    limits: Sequence[SetUpLimit], chances: Sequence[ChanceHits | None], facts: Mapping[str, Any]
) -> tuple[str, ...]:
    said = []
    if facts.get("source", {}).get("kind") == "simulated":
        said.append("Boards and camera are simulated. The handbook speaks of real flaws, inspected by the real system.")
    if any(limit.targets > limit.boards for limit in limits):
        most = max(limit.targets / limit.boards for limit in limits if limit.boards)
        said.append(
            f"Targets share boards, {number(most)} to a board. a90/95 takes them as independent, as the handbook does; "
            "the same bound with the boards' design effect in it stands beside it (Rao and Scott 1984)."
        )
    if any(limit.inspections > limit.targets for limit in limits):
        said.append(
            "Targets were inspected more than once with new noise and count once each: the criterion of a90/95 is "
            "scaled by the number of inspections."
        )
    if any(limit.record.calibration_runs for limit in limits):
        said.append(
            "Every limit is that of its threshold as it was calibrated: another draw of the calibration boards would "
            "give another threshold, which is in no interval here."
        )
    # The handbook's curve has one size; depth is a second one.
    varied = [one.record.inspected.depth_mm for one in limits if one.statement]
    varied = [depths for depths in varied if depth_varies(depths)]
    if varied:
        span = _span(min(float(one.min()) for one in varied), max(float(one.max()) for one in varied))
        said.append(
            f"Depths from {span} mm share one curve over diameter: a50, a90 and a90/95 are those of the depths as they "
            "were drawn together, not those of any one depth."
        )
    few = [one for one in limits if one.targets < LEAST_TARGETS]
    if few:
        labels = ", ".join(one.record.label for one in few)
        said.append(f"{labels}: fewer than {LEAST_TARGETS} targets ({min(one.targets for one in few)}).")
    # Unflawed places are where damage could have been drawn, on hole-free boards.
    ratios = [one.sites / limit.targets for limit, one in zip(limits, chances, strict=True) if one and limit.targets]
    if ratios and min(ratios) < SITES_PER_TARGET:
        said.append(
            f"Unflawed places for each damage: {number(min(ratios))}; the handbook asks for {SITES_PER_TARGET}. "
            "Besides, false calls are counted on the whole face of hole-free boards."
        )
    said += _sizes_miss_the_rise(limits)
    if any(limit.statement is not None for limit in limits):
        said.append(
            "The model is the one with the least deviance, and its bound is that of this one model: that the same data "
            "chose it is not in the bound."
        )
    if any(limit.statement is None and limit.a90_95.demonstrated for limit in limits):
        said.append(
            f"Where everything was found there is no curve. a90/95 is then the {ALL_FOUND}th smallest size: were its "
            f"POD below 90 %, the {ALL_FOUND} smallest would all be found in less than 5 % of studies."
        )
    if len(limits) > 1:
        said.append(f"{len(limits)} limits stand side by side; each interval holds for itself, not for all at once.")
    failed = sum(limit.record.failed for limit in limits)
    if failed:
        said.append(
            f"{_counted(failed, 'trial')} failed and what they would have shown is missing from what is counted: "
            "boards that a detector refuses are no misses of it."
        )
    return tuple(said)


def _sizes_miss_the_rise(limits: Sequence[SetUpLimit]) -> list[str]:
    said = []
    for limit in limits:
        if limit.statement is None:
            continue
        low, high = (
            float(limit.statement.curve.pod(np.array(size)))
            for size in (limit.record.inspected.diameter_mm.min(), limit.largest_mm)
        )
        if low > RISE[0]:
            said.append(f"{limit.record.label}: the smallest size inspected is found with a POD of {_percent(low)}.")
        if high < RISE[1]:
            said.append(f"{limit.record.label}: the largest size inspected is found with a POD of {_percent(high)}.")
        if limit.a90_95.demonstrated and limit.beyond(limit.a90_95.value):
            said.append(f"{limit.record.label}: a90/95 lies beyond the largest size inspected, by the curve alone.")
    return said


def _missing(limits: Sequence[SetUpLimit], facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Name the subjects that no number of this study speaks of."""
    source = facts.get("source", {})
    simulated = source.get("kind") == "simulated"
    said = ["An inspector, who can miss findings and doubt others: the POD is that of the program alone."]
    if any(limit.record.detector in TESTS_THE_HARNESS for limit in limits):
        said.insert(0, "A detector: the oracle is handed the truth and the blind one guesses, to test the harness.")
    if source.get("target", {}).get("name") == "drawn":
        kind = source["target"].get("damage", {}).get("kind", "")
        only = f": all are {KINDS[kind]}" if kind in KINDS and not is_swept(facts, "source.target.damage.kind") else ""
        said.append(f"Damage that is not round, that stands in rows or clusters, or several kinds on one board{only}.")
    if simulated:
        said.append(
            "Gloss, translucency, light of other sources than the camera's and what is declared as ambient, motion "
            "during a capture, dirt and wear: all surfaces are Lambertian, and the camera is what its model has in it."
        )
    if "camera" in source and "source.camera.unit_seed" not in facts.get("sweep", {}):
        said.append("Other units of the camera: fixed pattern and offset are those of one unit.")
    if any(limit.boards for limit in limits):
        said.append("Boards of another family: intervals are over boards drawn as these were.")
    return tuple(said)


def number(value: float) -> str:
    """Write three significant digits without an exponent where four figures will do."""
    if value != 0 and (abs(value) >= 1e4 or abs(value) < 1e-3):
        return f"{value:.3g}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def varied_sentences(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Say what was drawn anew for every board of a family: sizes, depths, places, pose, grain; but for swept ones."""
    target = _at(facts, "source.target")
    if not isinstance(target, Mapping) or target.get("name") != "drawn":
        return ()
    damage = target.get("damage", {})
    drawn = [
        f"{name} from {_range(damage[key])} mm"
        for key, name in DRAWN.items()
        if key in damage and not is_swept(facts, f"source.target.damage.{key}")
    ]
    law = {"uniform": "uniform", "log": "uniform in its logarithm"}.get(str(damage.get("sizes")), "")
    said = []
    if drawn:
        parts = f"one from each of {damage.get('per_board')} equal parts of its range on every board"
        how = f", the diameter {law}, {parts}" if law else ""
        said.append(f"Drawn for every damage: {' and '.join(drawn)}{how}; and its place on the board.")
    pose = [
        text.format(f"{target[key]:g}")
        for key, text in SPREADS.items()
        if target.get(key) and not is_swept(facts, f"source.target.{key}")
    ]
    if pose:
        said.append(f"Drawn uniformly for every board: {', '.join(pose)}.")
    if target.get("material", {}).get("grain_contrast"):
        said.append("Every board has a grain of its own.")
    return tuple(said)


def is_swept(facts: Mapping[str, Any], path: str) -> bool:
    """Return whether an axis changes what stands at a dotted path, with its surroundings or in part."""
    return any(_under(path, [axis]) or _under(axis, [path]) for axis in facts.get("sweep") or {})


def swept_sentences(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """List the axes of the experiment with their values."""
    sweep = facts.get("sweep") or {}
    return tuple(f"{path}: {', '.join(_plain(value) for value in values)}." for path, values in sweep.items())


def held_sentences(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """State everything that was the same for all: one sentence for each part of the declaration."""
    swept = tuple(facts.get("sweep") or {})
    said = []
    for name, roots in GROUPS:
        leaves = [leaf for root in roots for leaf in _leaves(_at(facts, root), root)]
        kept = [
            f"{path.removeprefix(roots[0]).lstrip('.')} {value}"
            for path, value in leaves
            if not _under(path, NOT_HELD) and not _under(path, swept) and path.rsplit(".", 1)[-1] not in SPREADS
        ]
        if kept:
            said.append(f"{name}: {', '.join(kept)}.")
    return tuple(said)


def _leaves(value: Any, path: str) -> Iterator[tuple[str, str]]:
    """(dotted path, text) of everything that was given; nothing for what was not."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}")
    elif value is not None and value != [] and value != () and value != "":
        yield path, _plain(value)


def _under(path: str, roots: Sequence[str]) -> bool:
    return any(path == root or path.startswith(f"{root}.") for root in roots)


def _at(facts: Mapping[str, Any], path: str) -> Any:
    value: Any = facts
    for key in path.split("."):
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return value


def _range(limits: Any) -> str:
    if isinstance(limits, Sequence) and len(limits) == 2:
        return f"{limits[0]:g} to {limits[1]:g}"
    return _plain(limits)


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, int | float):
        return f"{value:g}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} {_plain(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_plain(one) for one in value) + "]"
    return str(value)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _size(limit: SetUpLimit, value: float) -> str:
    """A bound; of one that no inspection bears out only that it lies beyond them."""
    if not np.isfinite(value):
        return "not demonstrated"
    return f"more than {number(limit.largest_mm)} mm" if limit.beyond(value) else f"{number(value)} mm"


def _span(low: float, high: float) -> str:
    return f"{number(low)} to {number(high)}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.4g} %"
