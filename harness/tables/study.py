"""Tables of a study beside its limits: thresholds, hits by chance, signals, operating points, axes, known sizes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.pod.statement import CONFIDENCE
from harness.evaluation.study.axes import FRAMES, AxisLine, Difference
from harness.evaluation.study.curves import PRO_LIMIT, PixelCurves, Roc
from harness.evaluation.study.limit import SetUpLimit, SizeRow
from harness.evaluation.study.record import StudyRecord
from harness.evaluation.study.result import SetUpResult, StudyResult
from harness.tables import text
from harness.tables.grid import Grid
from harness.tables.limits import (
    CALLS,
    FOUND_50,
    FOUND_90,
    LIMITS,
    SET_UP,
    a50_of,
    a90_of,
    bound_estimate,
    bound_text,
    name_of,
)
from harness.tables.schema import Column, Estimate, Table
from harness.vocabulary.path_names import names_of, on_one_line, unit_of, value_text

HIGH_THRESHOLD = 10.0
"""Deviations: the highest of a hole-free board's 30,000 pixels is 4 with Gaussian noise, and 5 to 6 with the fixed
pattern that an Azure Kinect's average of 50 frames keeps."""
OFF_BOARD = "off the board"
MOST_COLUMNS = 4
"""Set-ups side by side in a table of holes."""
SHOWN_ROWS = 60
BOUND = "its upper bound at 95 % confidence; empty where not demonstrated"


SET_UP_OF = Column("set_up", "set-up", "limit.record.label", SET_UP.note, text.unbroken)

# ---------------------------------------------------------------- hits by chance, thresholds


def _pod_at_smallest(result: SetUpResult) -> float | None:
    stated = result.limit.statement
    return None if stated is None else float(stated.curve.pod(np.array(stated.size.min())))


def _smallest_text(result: SetUpResult) -> str:
    pod, stated = _pod_at_smallest(result), result.limit.statement
    return f"{text.percent(pod)} % at {stated.size.min():.2f} mm" if pod is not None and stated else text.UNKNOWN_TEXT


SHUFFLED, UNFLAWED = ("chance.probability", "chance.interval"), ("chance.of_sites", "chance.sites_interval")
CHANCE = Table(
    "chance",
    "one row per set-up and number of frames: how often a damage would be hit by a finding of something else",
    (
        SET_UP_OF,
        Column("shuffled_share", "shuffled positions (95 %)", SHUFFLED, "places with another board's finding near"),
        Column("shuffled_pairs", "", "chance.laid", "pairs of a place and a run that this counts"),
        Column("unflawed_share", "unflawed places (95 %)", UNFLAWED, "unflawed places that were found"),
        Column("places", "places", "chance.sites", "unflawed places"),
        Column("expected_share", "from the rate", "chance.expected", "hits, were false calls spread evenly"),
        Column("expected_upper_share", "", "chance.expected_upper", "its upper bound"),
        Column("pod_at_smallest", "", _pod_at_smallest, "curve at the smallest size inspected"),
        Column("", "curve at the smallest size", _smallest_text),
    ),
)


def _calls_text(limit: SetUpLimit) -> str:
    calls, unseen = limit.false_calls, _unseen(limit)
    if calls is None:
        return text.UNKNOWN_TEXT
    beside = "" if unseen is None else f", {unseen} without return"
    return f"{text.many(calls.calls, 'call')} on {calls.area_m2:.3g} m²{beside}"


def _unseen(limit: SetUpLimit) -> int | None:
    unseen = limit.record.unflawed.no_return_calls
    return None if unseen is None else int(unseen.sum())


def _runs_text(runs: int) -> str:
    return str(runs) if runs else "none: given"


def _ends_text(rate: Estimate) -> str:
    return text.UNKNOWN_TEXT if np.isnan(rate.low) else text.interval(rate.low, rate.high)


OVER_BOARDS = ("false_calls.rate_per_m2", "false_calls_interval_per_m2")
THRESHOLDS = Table(
    "thresholds",
    "one row per set-up and number of frames: its threshold and the false calls that it lets through on other boards",
    (
        SET_UP,
        Column("threshold", "threshold", "record.threshold", "in the detector's units"),
        Column("threshold_mm", "in mm", "record.threshold_mm", "times the mean scale"),
        Column("calibration_runs", "calibration runs", "record.calibration_runs", "that set it; 0: given", _runs_text),
        Column("", "false calls on other boards", _calls_text),
        *(replace(column, label="per m² (95 %)" if column.label else "") for column in CALLS),
        Column("no_return_calls", "", _unseen, "false calls without return"),
        Column("over_boards_per_m2", "over boards (95 %)", OVER_BOARDS, "the rate, interval over boards", _ends_text),
    ),
)


@dataclass(frozen=True)
class SetBy:
    """The hole-free run whose highest score is a set-up's threshold: its board, the place of that score on it, its rank
    among so many runs, and the highest score of all with its board."""

    limit: SetUpLimit
    board: int
    x_mm: float
    y_mm: float
    rank: int
    runs: int
    highest_score: float
    highest_board: int

    @property
    def place(self) -> str:
        """The place in mm as text."""
        return f"{self.x_mm:.0f}, {self.y_mm:.0f}".replace("-", "−") if np.isfinite(self.x_mm) else OFF_BOARD


def set_by(limits: Sequence[SetUpLimit]) -> list[SetBy]:
    """Return the run that set each calibrated threshold."""
    found = []
    for limit in limits:
        if (runs := limit.record.calibrated) is not None:
            at, top = int(np.abs(runs.score - limit.record.threshold).argmin()), int(runs.score.argmax())
            place = (int(runs.board[at]), float(runs.x_mm[at]), float(runs.y_mm[at]))
            rank = 1 + int((runs.score > runs.score[at]).sum())
            found.append(SetBy(limit, *place, rank, len(runs.score), float(runs.score[top]), int(runs.board[top])))
    return found


def _rank_text(row: SetBy) -> str:
    return f"{'highest' if row.rank == 1 else f'number {row.rank}'} of {row.runs}"


SET_BY = Table(
    "threshold_runs",
    "one row per calibrated threshold: the hole-free finding that set it",
    (
        SET_UP_OF,
        Column("threshold", "threshold (deviations)", "limit.record.threshold", "in the detector's units"),
        Column("board", "board", "board", "calibration board"),
        Column("", "x, y on it (mm)", "place"),
        Column("x_mm", "", "x_mm", "place of the pixel with the highest score"),
        Column("y_mm", "", "y_mm", "likewise"),
        Column("rank", "", "rank", "rank of the score among all calibration runs; 1: highest"),
        Column("runs", "", "runs", "calibration runs"),
        Column("", "of the runs", _rank_text),
        Column("highest_score", "", "highest_score", "highest score of all runs"),
        Column("highest_board", "", "highest_board", "its board"),
        Column("", "highest of all", lambda one: f"{one.highest_score:.3g} on board {one.highest_board}"),
    ),
)


def threshold_warnings(limits: Sequence[SetUpLimit]) -> list[str]:
    """Return a sentence for each calibrated threshold that is too high for noise to have set it."""
    said = []
    for one in set_by(limits):
        threshold = one.limit.record.threshold
        if threshold > HIGH_THRESHOLD:
            where = one.place if one.place == OFF_BOARD else f"at x, y = {one.place} mm"
            said.append(
                f"{one.limit.record.label}: the threshold is {threshold:.3g} deviations, above {HIGH_THRESHOLD:g}: "
                f"something other than noise sets it (calibration board {one.board}, {where}), and "
                "the limit is that of it"
            )
    return said


def threshold_note(record: StudyRecord) -> str:
    """Return how thresholds came about."""
    if record.false_calls_per_m2 is None:
        return "Thresholds were given, not calibrated: the rates beside them are what came of it."
    wanted = record.false_calls_per_m2
    return (
        f"Calibrated to {wanted:g} false call{'' if wanted == 1 else 's'} per m² on hole-free boards of their own, "
        "never on those that are judged: the threshold is the lowest of their runs' highest scores that, by order "
        "statistics (Wilks 1941), keeps to that rate. A threshold is itself an estimate: the rate on other boards "
        "scatters about the wanted one."
    )


# ---------------------------------------------------------------- signals, operating points


def _hits_bound(limit: SetUpLimit) -> Estimate:
    return bound_estimate(limit, limit.a90_95)


def _p_values(limit: SetUpLimit) -> dict[str, float]:
    return {} if limit.signals is None else {what: p for what, p, _ in limit.signals.tests}


def _tests(limit: SetUpLimit) -> dict[str, float]:
    return {f"p: {what}": p for what, p in _p_values(limit).items()}


SIGNALS = Table(
    "signals",
    "one row per set-up and number of frames whose signals can be regressed on size",
    (
        SET_UP,
        Column("signals", "signals", lambda one: len(one.signals.size), "signals in the regression"),
        Column("model", "model", "signals.model", "the regression chosen"),
        Column("a50_mm", "a50 (mm)", lambda one: Estimate(one.signals.a50, most=one.largest_mm), FOUND_50),
        Column("a90_mm", "a90 (mm)", lambda one: Estimate(one.signals.a90, most=one.largest_mm), FOUND_90),
        Column("a90_95_mm", "a90/95 (mm)", lambda one: bound_estimate(one, one.signals.bound), BOUND, bound_text),
        Column("hits_a90_95_mm", "from hits: a90/95 (mm)", _hits_bound, "the same from hits", bound_text),
        Column("p: <test>", "", _tests, "p-value of a test of what the regression takes for granted", spread=True),
    ),
)


def signal_tests(limits: Sequence[SetUpLimit]) -> Grid | None:
    """Return the p-values of what a regression takes for granted; * marks those that speak against it."""
    tested = {
        name_of(limit): {what: f"{p:.2g}{' *' if p < 1 - CONFIDENCE else ''}" for what, p in _p_values(limit).items()}
        for limit in limits
        if limit.signals is not None
    }
    names = list(dict.fromkeys(name for tests in tested.values() for name in tests))
    rows = [(label, *(tests.get(name, text.UNKNOWN_TEXT) for name in names)) for label, tests in tested.items()]
    return Grid.of(("set-up", *names), rows) if names else None


def signal_notes(limits: Sequence[SetUpLimit]) -> list[str]:
    """Return why a set-up has no regression, and what to know of a regression that it has."""
    notes = [f"{name_of(limit)}: no regression: {limit.signals_why}" for limit in limits if limit.signals is None]
    for limit in limits:
        said = () if limit.signals is None else limit.signals.notes
        notes += [f"{name_of(limit)}: {'; '.join(text.unmeasured(note) for note in said)}"] if said else []
    return notes


@dataclass(frozen=True)
class OperatingRow:
    """A class of sizes of a set-up; ``pixels`` stand in its first row."""

    limit: SetUpLimit
    roc: Roc | None
    pixels: PixelCurves | None


def operating_rows(results: Sequence[SetUpResult]) -> list[OperatingRow]:
    """Return the classes of sizes of all set-ups."""
    return [
        OperatingRow(one.limit, roc, None if k else one.pixels)
        for one in results
        for k, roc in enumerate(one.roc or (None,))
    ]


OPERATING = Table(
    "operating_points",
    "one row per set-up, number of frames and class of sizes: areas under the curves over all thresholds",
    (
        SET_UP_OF,
        Column("sizes", "sizes", "roc.name", "class of sizes"),
        Column("damages", "damages", "roc.damages", "damages of the class"),
        Column("places", "places", "roc.unflawed", "unflawed places"),
        Column("roc_area", "ROC's area (95 %)", ("roc.area", "roc.area_interval"), "over sites; interval over boards"),
        Column("pro_area", "AU-PRO (95 %)", ("pixels.pro", "pixels.pro_interval"), "per-region overlap of pixels"),
        Column("pixel_area", "pixels' ROC's area", ("pixels.auroc", "pixels.auroc_interval"), "ROC of pixels"),
    ),
)


def operating_notes(results: Sequence[SetUpResult]) -> list[str]:
    """Return what the areas are, and which of them could not be had."""
    notes = [
        f"AU-PRO: mean over damages of the share of pixels above, against undamaged pixels above, up to a share of "
        f"{PRO_LIMIT:g} and divided by it, as MVTec AD does; judged pixels of damaged boards. Intervals over boards."
    ]
    for result in results:
        if result.pixels is not None and result.pixels.why:
            notes.append(f"{name_of(result.limit)}: no AU-PRO: {result.pixels.why}.")
    return notes


# ---------------------------------------------------------------- axes, depths, known sizes


@dataclass(frozen=True, eq=False)
class AxisGroup:
    """One axis: its ``values``, ascending where they are numbers, and its ``lines`` by what tells them apart."""

    path: str
    name: str
    values: tuple[Any, ...]
    lines: dict[str, AxisLine]

    @property
    def numeric(self) -> bool:
        """True where the values have places on a scale."""
        return all(line.numeric for line in self.lines.values())

    @property
    def title(self) -> str:
        """The axis with its unit."""
        unit = unit_of(self.path)
        return f"{self.name} ({unit})" if unit else self.name


def axis_groups(lines: Sequence[AxisLine]) -> list[AxisGroup]:
    """Return the lines axis by axis; a line is called by those of its other axes that differ among lines."""
    names = names_of(dict.fromkeys(path for line in lines for path in (line.axis, *line.held)))
    groups = []
    for path in dict.fromkeys(line.axis for line in lines):
        of_axis = [line for line in lines if line.axis == path]
        others = dict.fromkeys(other for line in of_axis for other in line.held)
        varied = [other for other in others if len({on_one_line(line.held.get(other)) for line in of_axis}) > 1]

        def held(line: AxisLine, other: str) -> str:
            """``kinect_v2`` says what it is, ``albedo=0.2`` has to."""
            said = axis_value(other, line.held[other])
            return said if other == FRAMES or isinstance(line.held[other], str) else f"{names[other]}={said}"

        labels = [", ".join(held(line, other) for other in varied if other in line.held) for line in of_axis]
        every = [value for line in of_axis for value in line.values]
        values = [value for at, value in enumerate(every) if value not in every[:at]]
        if all(line.numeric for line in of_axis):
            values.sort()
        groups.append(AxisGroup(path, names[path], tuple(values), dict(zip(labels, of_axis, strict=True))))
    return groups


def axis_value(path: str, value: Any) -> str:
    """Return a value in words: ``50 frames``, ``0.7 m``, ``kinect_v2``."""
    return text.many(value, "frame") if path == FRAMES else value_text(path, value)


@dataclass(frozen=True)
class AxisRow:
    """One value of one line of an axis; ``step``: the change of a90 from the value before."""

    group: AxisGroup
    line: str
    value: Any
    limit: SetUpLimit
    step: Difference | None


def axis_rows(group: AxisGroup) -> list[AxisRow]:
    """Return the values of all lines of an axis."""
    return [
        AxisRow(group, label, value, limit, step)
        for label, line in group.lines.items()
        for value, limit, step in zip(line.values, line.limits, (None, *line.steps), strict=True)
    ]


def _step_text(row: AxisRow) -> str:
    step = row.step
    if step is None:
        return ""
    beyond = " *" if step.beyond_chance else ""
    if not np.isfinite(step.ratio):
        return f"no a90 {'here' if np.isnan(step.to.a90_mm) else 'above'}{beyond}"
    if all(one.beyond(one.a90_mm) for one in (step.frm, step.to)):
        return f"both beyond{beyond}"
    return f"× {step.ratio:.2f} ({text.interval(step.interval.low, step.interval.high)}){beyond}"


AXES = Table(
    "axes",
    "one row per axis, line of set-ups that differ in it alone, and value: the limits and the change of a90",
    (
        Column("axis", "", "group.path", "dotted path of the axis"),
        Column("line", "set-ups", "line", "what the line's other axes are at"),
        Column("value", "", lambda one: on_one_line(one.value), "value on the axis"),
        Column("", "value", lambda one: axis_value(one.group.path, one.value)),
        replace(SET_UP_OF, label=""),
        Column(
            "a50_mm", "a50 (mm)", lambda one: a50_of(one.limit), f"{FOUND_50}, with its 95 % interval", interval=True
        ),
        Column("a90_mm", "a90 (mm)", lambda one: a90_of(one.limit), f"{FOUND_90}, likewise", interval=True),
        Column("a90_95_mm", "a90/95 (mm)", lambda one: bound_estimate(one.limit, one.limit.a90_95), BOUND, bound_text),
        Column("", "a90 over that above", _step_text),
        Column("ratio", "", ("step.ratio", "step.interval"), "a90 over that of the value before, with its interval"),
        Column("beyond_chance", "", "step.beyond_chance", "the interval leaves out 1"),
        Column("paired", "", "step.paired", "both were judged on the same boards"),
    ),
)


def axis_grid(group: AxisGroup) -> Grid:
    """Return the table of one axis, at most `SHOWN_ROWS` rows."""
    lines = "" if list(group.lines) == [""] else "set-ups"
    return AXES.grid(axis_rows(group)[:SHOWN_ROWS], heads={"set-ups": lines, "value": group.title})


def axis_note(group: AxisGroup) -> str:
    """Return how the changes are to be read."""
    steps = [step for line in group.lines.values() for step in line.steps]
    paired = "same boards, drawn again together" if all(step.paired for step in steps) else "not all of the same boards"
    beyond = sum(step.beyond_chance for step in steps)
    rows = sum(len(line.values) for line in group.lines.values())
    cut = f" The first {SHOWN_ROWS} of {rows} rows are shown." if rows > SHOWN_ROWS else ""
    return (
        f"Ratio of a90 with its 95 % interval over boards ({paired}); {beyond} of {len(steps)} leave out 1 (*). Each "
        f"interval is taken for itself and a little narrow: of ratios that are 1, 8 to 9 % get a *, not 5 %.{cut}"
    )


def _at_depth(result: SetUpResult, at: int) -> Estimate:
    """The diameter found 90 % of the time at the ``at``-th depth."""
    surface = result.surface
    assert surface is not None
    low, high = float(surface.a90_low_mm[at]), float(surface.a90_high_mm[at])
    return Estimate(float(surface.a90_mm[at]), low, high, surface.diameter_range_mm[1])


def _exponent(result: SetUpResult) -> Estimate:
    assert result.surface is not None
    slope, ends = result.surface.depth_slope, result.surface.depth_slope_interval
    return Estimate(-slope, -ends.high, -ends.low)


EXPONENT: dict[str, Any] = {"text": lambda power: power.text().replace("-", "−"), "interval": True}
SURFACES = Table(
    "depths",
    "one row per set-up and number of frames with a surface over diameter and depth",
    (
        SET_UP_OF,
        Column("", "depths (mm)", lambda one: "{:.3g} to {:.3g}".format(*one.surface.depth_range_mm)),
        Column("shallowest_mm", "", lambda one: one.surface.depth_range_mm[0], "least depth inspected"),
        Column("deepest_mm", "", lambda one: one.surface.depth_range_mm[1], "greatest depth inspected"),
        Column("a90_shallow_mm", "a90 at the least (mm)", lambda one: _at_depth(one, 0), "there", interval=True),
        Column("a90_deep_mm", "a90 at the most (mm)", lambda one: _at_depth(one, -1), "there", interval=True),
        Column(
            "exponent", "a90 ~ depth to the power of", _exponent, "exponent of depth that a90 goes with", **EXPONENT
        ),
        Column("interaction_p", "interaction, p", "surface.interaction_p", "p-value, of diameter and depth"),
    ),
)


@dataclass(frozen=True)
class KnownSize:
    """POD of one set-up at a known hole; ``number`` of the hole."""

    limit: SetUpLimit
    number: int
    row: SizeRow

    @property
    def ends(self) -> Interval:
        """The bounds of its POD."""
        return Interval(self.row.lower, self.row.upper)


def known_sizes(results: Sequence[SetUpResult]) -> list[KnownSize]:
    """Return POD at the sizes asked for, set-up by set-up."""
    return [KnownSize(one.limit, k + 1, row) for one in results for k, row in enumerate(one.sizes)]


POD_OF_SIZE = ("row.pod", "ends")
SIZES = Table(
    "known_sizes",
    "one row per set-up, number of frames and hole of the thesis' board: probability of detection at its diameter",
    (
        SET_UP_OF,
        Column("hole", "", "number", "number of the hole"),
        Column("diameter_mm", "", "row.diameter_mm", "its diameter"),
        Column("pod", "", POD_OF_SIZE, "from the curve, with one-sided 95 % bounds by the likelihood ratio"),
        Column("extrapolated", "", "row.extrapolated", "outside the sizes inspected"),
        Column("near", "", "row.near", "targets within 10 % of the diameter"),
        Column("near_rate", "", ("row.near_rate", "row.near_interval"), "share of them found (Clopper and Pearson)"),
    ),
)


def size_grids(results: Sequence[SetUpResult]) -> Iterator[Grid]:
    """Yield POD at known sizes, holes down and at most `MOST_COLUMNS` set-ups across; nothing without sizes."""
    shown = [one for one in results if one.sizes]
    for first in range(0, len(shown), MOST_COLUMNS):
        part = shown[first : first + MOST_COLUMNS]
        rows = []
        for number, line in enumerate(zip(*(one.sizes for one in part), strict=True), 1):
            size_mm = line[0].diameter_mm
            rows.append(
                (str(number), text.inches(size_mm) or "–", f"{size_mm:.2f}", *(_size_text(one) for one in line))
            )
        yield Grid.of(("hole", "drill", "mm", *(name_of(one.limit) for one in part)), rows)


def _size_text(row: SizeRow) -> str:
    near = f"{100 * row.near_rate:.0f} % of {row.near} near" if row.near else "none near"
    if np.isnan(row.pod):
        return f"no curve ({near})"
    outside = " outside" if row.extrapolated else ""
    ends = f"{text.percent(row.lower)} to {text.percent(row.upper)}"
    return f"{text.percent(row.pod)} % ({ends}){outside}; {near}"


STUDY_TABLES = (LIMITS, THRESHOLDS, SET_BY, CHANCE, SIGNALS, OPERATING, AXES, SURFACES, SIZES)


def study_tables(result: StudyResult) -> dict[Table, list[Any]]:
    """Return every table of a study with its rows."""
    limits, set_ups = result.limits, result.set_ups
    return {
        LIMITS: list(limits),
        THRESHOLDS: list(limits),
        SET_BY: set_by(limits),
        CHANCE: [one for one in set_ups if one.chance is not None],
        SIGNALS: [one for one in limits if one.signals is not None],
        OPERATING: operating_rows(set_ups),
        AXES: [row for group in axis_groups(result.axes) for row in axis_rows(group)],
        SURFACES: [one for one in set_ups if one.surface is not None],
        SIZES: known_sizes(set_ups),
    }
