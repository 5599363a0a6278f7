"""The table of detection limits, and the limits in words: the answer, a sentence for each set-up,
and notes.

A curve says nothing about sizes that were not inspected, so a size beyond the largest is written
as ``> 15.9``."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from harness.evaluation.pod.curve import Bound
from harness.evaluation.study.limit import SetUpLimit
from harness.records.schema import Column, Estimate, Table
from harness.vocabulary import text
from harness.vocabulary.text import Grid

MOST_ANSWERS = 3
ONE_UNIT = "One unit of the camera"
FOUND = "Nine in ten found"
SIZES = re.compile("(diameter|depth|width|length) ")
"""Begins the part of a set-up's label that states a range of sizes."""
NOT_DEMONSTRATED = "not demonstrated"
BEYOND = "lies beyond the largest size inspected"
"""Words of a statement's note on an extrapolated bound, which `notes_of` replaces by a sentence of
its own."""


def is_within_sizes(limit: SetUpLimit, bound: Bound | None = None) -> bool:
    """Return whether a bound (a90/95 if None) is demonstrated by sizes that were inspected."""
    bound = bound or limit.a90_95
    return bound.demonstrated and not limit.beyond(bound.value)


def name_of(limit: SetUpLimit) -> str:
    """Return the set-up with its frames, with no-break spaces between numbers and units."""
    return text.unbroken(limit.record.label)


def bound_estimate(limit: SetUpLimit, bound: Bound) -> Estimate:
    """Return a bound as tables need it; NaN if it is not demonstrated."""
    return Estimate(bound.value if bound.demonstrated else np.nan, most=limit.largest_mm)


def bound_text(bound: Estimate) -> str:
    """Return a bound in mm as text without its unit, or that it is not demonstrated."""
    if np.isnan(bound.value):
        return NOT_DEMONSTRATED
    return text.size(bound.value, bound.most)


def size_estimate(limit: SetUpLimit, name: str) -> Estimate:
    """Return a50 or a90 (``name``) with its interval; an upper bound if nothing was missed;
    unknown if not above 0."""
    size_mm = getattr(limit, f"{name}_mm")
    ends = getattr(limit, f"{name}_interval_mm")
    if size_mm <= 0:
        return Estimate(np.nan)
    return Estimate(size_mm, ends.low, ends.high, limit.largest_mm, limit.is_at_most)


a50_of = partial(size_estimate, name="a50")
a90_of = partial(size_estimate, name="a90")
FOUND_50 = f"size found {50} % of the time"
FOUND_90 = f"size found {90} % of the time"
BRIEF: dict[str, Any] = {
    "interval": True,
    "brief": lambda estimate: estimate.text().partition(" ")[0],
}
SIZES_OF = (
    "what these sizes are: diameters (for long damage, widths or lengths), "
    "or depths if only the depth varies"
)
VERDICT = "status of that bound: demonstrated, beyond the sizes inspected, or not demonstrated"
EFFECT = "variance of a90 with boards as sampling units over that with damages as sampling units"
SET_UP = Column(
    "set_up",
    "set-up",
    "record.label",
    "name of the set-up, with its frames",
    text.unbroken,
    brief=str,
)
CALLS = (
    Column(
        "false_calls_per_m2",
        "calls/m² (95 %)",
        ("false_calls.rate_per_m2", "false_calls.interval_per_m2"),
        "rate of false calls on undamaged boards, with the exact 95 % Poisson interval",
        lambda rate: "none inspected" if np.isnan(rate.value) else rate.text(),
    ),
    Column("false_calls", "", "false_calls.calls", "number of these false calls"),
    Column(
        "hole_free_m2",
        "",
        lambda row: float(row.record.unflawed.area_m2.sum()),
        "undamaged area inspected",
    ),
)


def quoted(limit: SetUpLimit) -> Bound:
    """Return the limit to quote: that of a new unit if the study has several units, else a90/95 of
    its single unit."""
    return limit.a90_95 if limit.over_units is None else limit.over_units.new_unit


def _one_unit(limit: SetUpLimit) -> Estimate:
    """Return the a90/95 of the single unit, or the median, lowest and highest a90/95 of several
    units."""
    units = limit.over_units
    if units is None:
        return bound_estimate(limit, limit.a90_95)
    middle = float(np.median(units.a90_95_mm))
    return Estimate(
        value=middle if np.isfinite(middle) else np.nan,
        low=float(np.min(units.a90_95_mm)),
        high=float(np.max(units.a90_95_mm)),
        most=limit.largest_mm,
    )


def _by_signals(limit: SetUpLimit) -> str:
    """Return a90 from signals with its interval, or why it is not stated."""
    signals = limit.from_signals
    if signals.why:
        return f"not stated: {signals.why}"
    ends = signals.a90_interval_mm
    return Estimate(signals.a90_mm, ends.low, ends.high, limit.largest_mm).text()


def _verdict(limit: SetUpLimit, bound: Bound) -> str:
    if is_within_sizes(limit, bound):
        return "demonstrated"
    return "beyond the sizes inspected" if bound.demonstrated else NOT_DEMONSTRATED


def _by_depth(limit: SetUpLimit) -> int | None:
    """Return the number of hits by depth; None if kinds of hits were not counted separately."""
    inspected = limit.record.inspected
    if inspected.by_depth is None or inspected.by_no_return is None:
        return None
    return int(inspected.by_depth.sum())


def _by_no_return(limit: SetUpLimit) -> int | None:
    """Return the number of hits by missing returns; None if they were not counted separately."""
    inspected = limit.record.inspected
    if inspected.by_depth is None or inspected.by_no_return is None:
        return None
    return int(inspected.by_no_return.sum())


def _found(limit: SetUpLimit) -> str:
    by_no_return = _by_no_return(limit)
    text_of_hits = f"{limit.hits} of {limit.inspections}"
    if not by_no_return:
        return text_of_hits
    return f"{text_of_hits} ({_by_depth(limit)} by depth, {by_no_return} by missing returns)"


LIMITS = Table(
    "limits",
    "one row per set-up and number of frames of a study: its detection limit, "
    "and the data behind it",
    (
        SET_UP,
        Column("variant", "", "record.variant", "name of the set-up"),
        Column("frames", "", "record.frames", "number of averaged frames"),
        Column(
            "<axis>",
            "",
            "record.axes",
            "one column per axis, named by its dotted path: the value",
            spread=True,
        ),
        Column(
            "a90_95_mm",
            "a90/95 (mm)",
            lambda row: bound_estimate(row, row.a90_95),
            "upper bound of a90 at 95 % confidence, which is the limit to quote; "
            "empty if not demonstrated",
            bound_text,
            tone=lambda row: "key" if is_within_sizes(row) else "bad",
        ),
        Column("a90_95_verdict", "", lambda row: _verdict(row, row.a90_95), VERDICT),
        Column("a90_95_method", "", "a90_95.method", "method by which the bound was computed"),
        Column(
            "over_boards_mm",
            "over boards (mm)",
            lambda row: bound_estimate(row, row.over_boards),
            "a90/95 that allows for correlated results of the damages on a board",
            bound_text,
            tone=lambda row: "" if is_within_sizes(row, row.over_boards) else "bad",
        ),
        Column("over_boards_verdict", "", lambda row: _verdict(row, row.over_boards), VERDICT),
        Column(
            "new_unit_mm",
            "new unit (mm)",
            lambda row: bound_estimate(row, quoted(row)) if row.over_units else None,
            (
                "if there are several units: upper bound, at 95 % confidence, of the a90 of a "
                "new unit"
            ),
            lambda bound: text.UNKNOWN_TEXT if bound is None else bound_text(bound),
        ),
        Column(
            "new_unit_verdict",
            "",
            lambda row: _verdict(row, quoted(row)) if row.over_units else None,
            VERDICT,
        ),
        Column(
            "one_unit_mm",
            "one unit (mm)",
            _one_unit,
            "a90/95 of single units: median, lowest, highest",
            **BRIEF,
        ),
        Column(
            "unit_spread",
            "",
            "over_units.spread",
            "standard deviation of ln a90 between units, noise included",
        ),
        Column("units", "", "record.units", "number of units of the camera"),
        Column(
            "a90_mm", "a90 (mm)", a90_of, f"{FOUND_90}, with its 95 % interval over boards", **BRIEF
        ),
        Column(
            "a50_mm", "a50 (mm)", a50_of, f"{FOUND_50}, with its 95 % interval over boards", **BRIEF
        ),
        Column("", "a90 by signals (mm)", _by_signals, brief=False),
        Column(
            "a90_signal_mm",
            "",
            ("from_signals.a90_mm", "from_signals.a90_interval_mm"),
            f"{FOUND_90} by the damages' signals, with its 95 % interval; empty if not stated",
        ),
        Column(
            "a50_signal_mm",
            "",
            ("from_signals.a50_mm", "from_signals.a50_interval_mm"),
            f"{FOUND_50} likewise",
        ),
        Column(
            "a90_95_signal_mm",
            "",
            "from_signals.a90_95_mm",
            "upper bound of a90_signal_mm at 95 % confidence",
        ),
        Column("signal_why", "", "from_signals.why", "reason why these are not stated, if any"),
        Column("limit_of", "", "record.inspected.limit_of", SIZES_OF),
        Column(
            "is_at_most",
            "",
            "is_at_most",
            "whether everything was found, so that a50 and a90 are upper bounds",
        ),
        Column("smallest_mm", "", lambda row: _ends_mm(row)[0], "smallest size inspected"),
        Column("largest_mm", "", lambda row: _ends_mm(row)[1], "largest size inspected"),
        *CALLS,
        Column(
            "beside_per_m2",
            "beside/m²",
            ("beside.rate_per_m2", "beside.interval_per_m2"),
            (
                "findings on damaged boards that match no damage, with the exact 95 % Poisson "
                "interval"
            ),
            CALLS[0].text,
            brief=lambda rate: text.UNKNOWN_TEXT if np.isnan(rate.value) else f"{rate.value:.2g}",
        ),
        Column("beside_calls", "", "beside.calls", "number of these findings"),
        Column("", "found", _found, brief=False),
        Column("hits", "", "hits", "number of hits"),
        Column("inspections", "", "inspections", "number of inspections: damages times repeats"),
        Column(
            "size_error_mm",
            "size error (mm)",
            "size_error_mm",
            "median error of the measured size of hits "
            "(the model's diameter; for long damage, width or length)",
            brief=False,
        ),
        Column("sized", "", "sized", "number of hits whose size was measured"),
        Column(
            "seconds_detect",
            "ms a cloud",
            "seconds_detect",
            "median time in seconds to detect and measure damage on a damaged board",
            lambda seconds: text.UNKNOWN_TEXT if np.isnan(seconds) else f"{1e3 * seconds:.0f}",
            brief=False,
        ),
        Column("hits_by_depth", "", _by_depth, "hits by depth"),
        Column("hits_by_no_return", "", _by_no_return, "hits by missing returns"),
        Column("targets", "targets", "targets", "number of damages", brief=False),
        Column("boards", "boards", "boards", "number of damaged boards"),
        Column("design_effect", "design effect", "design_effect", EFFECT, text.mm, brief=False),
        Column("threshold", "", "record.threshold", "threshold in the detector's units"),
        Column(
            "threshold_mm",
            "",
            "record.threshold_mm",
            "threshold times the mean residual per unit of score",
        ),
        Column(
            "calibration_runs",
            "",
            "record.calibration_runs",
            "number of calibration runs; 0: threshold was given",
        ),
        Column("detector", "", "record.detector", "name of the detector"),
        Column("detector_version", "", "record.detector_version", "version of the detector"),
        Column("failed", "", "record.failed", "number of trials that failed"),
        Column("notes", "", lambda row: "; ".join(notes_of(row)), "remarks on the limit"),
    ),
    title="detection limits: sizes found 50 and 90 % of the time, and 90 % with 95 % confidence",
)

SCORES = Table(
    "scores",
    "one row per category of a data set: quality of anomaly maps on the inspected pixels",
    (
        Column("category", "category", note="name of the category"),
        Column(
            "au_pro",
            "AU-PRO",
            note="area under the per-region overlap up to 30 % false pixels, divided by 0.3",
        ),
        Column("pixel_auroc", "AUROC of pixels", note="area under the ROC curve of pixels"),
        Column(
            "board_auroc",
            "AUROC of boards",
            note="area under the ROC curve of boards, by their highest pixels",
        ),
    ),
    title="anomaly maps",
)


def limits_grid(limits: Sequence[SetUpLimit], *, terminal: bool = False) -> Grid:
    """Return the table. It has columns on units if there are several; if there is only one, the
    title says so."""
    if any(limit.over_units for limit in limits):
        return LIMITS.grid(
            limits,
            terminal=terminal,
            heads={"a90/95 (mm)": "all units (mm)", "over boards (mm)": ""},
        )
    grid = LIMITS.grid(limits, terminal=terminal, heads={"new unit (mm)": "", "one unit (mm)": ""})
    return replace(grid, title=f"{ONE_UNIT}: {grid.title.partition(': ')[2]}")


def _ends_mm(*limits: SetUpLimit) -> tuple[float, float]:
    sizes = np.concatenate([limit.record.inspected.size_mm for limit in limits])
    if not len(sizes):
        return np.nan, np.nan
    return float(sizes.min()), float(sizes.max())


def study_answer(limits: Sequence[SetUpLimit]) -> str:
    """Return a sentence for each set-up, or the range of many limits. An answer for a single unit
    says so first."""
    if not limits:
        return "No set-up was inspected, so there is no answer."
    answer = _answer(limits)
    if any(limit.over_units for limit in limits):
        return answer
    if answer.startswith(FOUND):
        return answer.replace(FOUND, f"{FOUND} by one unit", 1)
    if answer.startswith("None "):
        answer = answer[0].lower() + answer[1:]
    return f"{ONE_UNIT}: {answer}"


def _answer(limits: Sequence[SetUpLimit]) -> str:
    count = len(limits)
    if count <= MOST_ANSWERS:
        sentences = [limit_sentence(limit, again=index > 0) for index, limit in enumerate(limits)]
        return " ".join(sentences)
    within = [limit for limit in limits if is_within_sizes(limit, quoted(limit))]
    if not within:
        none = f"None of {count} set-ups demonstrates a limit (a90/95) within the sizes inspected"
        return f"{none}{_sizes(*limits)}."
    within.sort(key=lambda limit: quoted(limit).value)
    names = short_names(limits)
    kinds = sorted({limit.record.inspected.limit_of for limit in within}, reverse=True)
    spans = []
    for kind in kinds:  # a depth is not compared with a diameter
        of_kind = [limit for limit in within if limit.record.inspected.limit_of == kind]
        prefix = f"a {kind} of " if len(kinds) > 1 else ""
        smallest = _size_and_name(of_kind[0], names)
        largest = _size_and_name(of_kind[-1], names)
        spans.append(f"{prefix}{smallest} to {largest}")
    answer = f"{FOUND} (a90/95): {'; '.join(spans)}"
    without = count - len(within)
    if not without:
        return f"{answer}."
    verb = "demonstrates" if without == 1 else "demonstrate"
    return f"{answer}; {without} of {count} set-ups {verb} no limit within the sizes inspected."


def _size_and_name(limit: SetUpLimit, names: dict[str, str]) -> str:
    return f"{text.size(quoted(limit).value)} mm ({names[limit.record.label]})"


def short_names(limits: Sequence[SetUpLimit]) -> dict[str, str]:
    """Return the set-ups' labels without the ranges of their sizes, by label; whole labels if two
    set-ups differ in these only."""
    names = {}
    for limit in limits:
        label = limit.record.label
        parts = [part for part in label.split(", ") if not SIZES.match(part)]
        names[label] = ", ".join(parts)
    if len(set(names.values())) < len(names):
        return {label: label for label in names}
    return names


def limit_sentence(limit: SetUpLimit, *, again: bool = False) -> str:
    """Return ``50 frames: damage of 5.31 mm is found 90 % ...``, or only the size after such a
    sentence (``again``)."""
    bound = quoted(limit)
    if not bound.demonstrated:
        answer = f"a90/95 is {NOT_DEMONSTRATED}: {_short_reason(limit, bound)}"
    elif not is_within_sizes(limit, bound):
        answer = f"no limit (a90/95) within the sizes inspected{_sizes(limit)}"
    elif again:
        answer = _size_words(limit, bound).removeprefix("of ")
    else:
        unit = ""
        if limit.over_units is not None:
            unit = f" by a new unit of the camera, judged from {limit.over_units.units},"
        confidence = f"{100 * bound.confidence:.0f} % confidence (a90/95)"
        size = _size_words(limit, bound)
        answer = f"damage {size} is found 90 % of the time{unit} with {confidence}"
    return f"{limit.record.label}: {answer}{_false_call_words(limit, bound)}."


def _short_reason(limit: SetUpLimit, bound: Bound) -> str:
    """Return why there is no bound; the statistics in brackets are left to the notes."""
    reason = _reason(bound)
    if reason.startswith("a constant probability"):
        reason = f"the hits do not grow clearly with {limit.record.inspected.limit_of}"
    return re.sub(r" [(][^()]*[<>=][^()]*[)]", "", reason)


def _size_words(limit: SetUpLimit, bound: Bound) -> str:
    """Return ``of 5.31 mm``, ``5.31 mm deep``, ``5.31 mm wide`` or ``5.31 mm long``."""
    size = f"{text.size(bound.value)} mm"
    adjectives = {"depth": "deep", "width": "wide", "length": "long"}
    adjective = adjectives.get(limit.record.inspected.limit_of)
    return f"{size} {adjective}" if adjective else f"of {size}"


def _false_call_words(limit: SetUpLimit, bound: Bound) -> str:
    """Return ``, at 0.65 false calls per m² (0.3 to 1.2)``; empty without hole-free boards."""
    calls = limit.false_calls
    if calls is None:
        return ""
    low = calls.interval_per_m2.low
    high = calls.interval_per_m2.high
    if limit.over_units is not None:
        # each board has its own unit: false calls on one board are not independent
        over_boards = limit.false_calls_interval_per_m2
        low = float(np.fmin(low, over_boards.low))
        high = float(np.fmax(high, over_boards.high))
    rate = _rate_text(calls.rate_per_m2)
    plural = "" if rate == "1" else "s"
    joint = ", at" if is_within_sizes(limit, bound) else ";"
    interval = f"({_rate_text(low)} to {_rate_text(high)})"
    return f"{joint} {rate} false call{plural} per m² {interval}"


def _rate_text(rate: float) -> str:
    return f"{rate:.2g}" if rate < 99.5 else f"{rate:.0f}"


def notes_of(limit: SetUpLimit) -> list[str]:
    """Return the reasons why there is no limit, or why the limit is cautious or doubtful."""
    stated = limit.statement
    demonstrated = limit.a90_95.demonstrated
    notes = []
    if not demonstrated:
        notes.append(_reason(limit.a90_95))
    if stated is None and demonstrated:
        notes.append(limit.a90_95.method)
    if stated is not None:
        if demonstrated and not is_within_sizes(limit):
            notes.append(
                f"a90/95 {BEYOND}, {limit.largest_mm:.3g} mm, so no inspection supports it"
            )
        notes += [note.partition(": see --")[0] for note in stated.notes if BEYOND not in note]
    if limit.a50_mm <= 0:
        notes.append(
            "the curve hardly rises with size: the sizes found would lie below 0, "
            "so they are not stated"
        )
    if limit.boards_matter and limit.over_units is None:
        effect = f"design effect {limit.design_effect:.1f}"
        notes.append(
            f"the results of damages on one board are correlated ({effect}): "
            "quote the limit over boards"
        )
    by_depth = _by_depth(limit)
    if by_depth is not None and by_depth != limit.hits:
        notes.append(
            f"{limit.hits - by_depth} of {limit.hits} hits by missing returns alone, "
            "which leave no depth to measure"
        )
    if limit.record.failed:
        notes.append(f"{limit.record.failed} trials failed and are not included")
    return notes


def limit_notes(limits: Sequence[SetUpLimit]) -> list[str]:
    """Return notes on the limits: first those that all set-ups share, then a line for each
    set-up."""
    notes = [notes_of(limit) for limit in limits]
    shared: list[str] = []
    if len(notes) > 1:
        shared = [note for note in notes[0] if all(note in of_set_up for of_set_up in notes)]
    lines = [("every set-up", shared)]
    for limit, of_set_up in zip(limits, notes, strict=True):
        lines.append((limit.record.label, [note for note in of_set_up if note not in shared]))
    return [f"{label}: {'; '.join(of_line)}" for label, of_line in lines if of_line]


def _reason(bound: Bound) -> str:
    return bound.why.removeprefix(f"{NOT_DEMONSTRATED}: ")


def _sizes(*limits: SetUpLimit) -> str:
    """Return the range of sizes inspected as `` (4.3 to 15.9 mm)``; empty if there is none."""
    low, high = _ends_mm(*limits)
    return "" if np.isnan(low) else f" ({low:.3g} to {high:.3g} mm)"
