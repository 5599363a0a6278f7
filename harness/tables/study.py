"""Tables of a study besides its limits: thresholds, chance hits, operating points, axes, and
limits of depth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from harness.evaluation.study.curves import PRO_LIMIT
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import Calibrated, StudyRecord
from harness.evaluation.study.result import FRAMES, AxisLine, Difference, SetUpResult, StudyResult
from harness.records.schema import Column, Estimate, Table
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
from harness.tables.unknowns import UNKNOWN_TABLE, unknown_rows
from harness.vocabulary import text
from harness.vocabulary.path_names import (
    NAMED,
    camera_title,
    differing,
    names_of,
    on_one_line,
    unit_of,
    value_text,
)
from harness.vocabulary.text import Grid

# distance on the sensor within which two highest scores are one blob: the width of a camera's
# filter
BLOB_PX = 5.0
HIGH_THRESHOLD = 10.0
"""Standard deviations. A hole-free board's highest score is 4 with Gaussian noise, 5 to 6 with a
fixed pattern."""
OFF_BOARD = "off the board"
SHOWN_ROWS = 60
BOUND = "upper bound of a90 at 95 % confidence; empty if not demonstrated"

SET_UP_OF = Column("set_up", "set-up", "limit.record.label", SET_UP.note, text.unbroken)
UNFLAWED = ("chance.of_sites", "chance.sites_interval")
CHANCE = Table(
    "chance",
    "one row per set-up and number of frames: how often an unrelated finding would count as a hit",
    (
        SET_UP_OF,
        Column(
            "shuffled_share",
            "shuffled positions",
            "chance.probability",
            "places near another board's finding",
        ),
        Column(
            "unflawed_share",
            "unflawed places (95 %)",
            UNFLAWED,
            "share of undamaged places with a finding",
        ),
        Column("places", "places", "chance.sites", "number of undamaged places"),
        Column(
            "expected_share",
            "from the rate",
            "chance.expected",
            "share if false calls were spread evenly",
        ),
    ),
)
GIVEN = "number of calibration runs; 0 for a given threshold"
UNSET = "none: given"


def _of_error(name: str) -> Callable[[SetUpLimit], float]:
    """Return the reader of a number of the thresholds' error; NaN without one."""
    return lambda limit: float(getattr(limit.record.threshold_error, name, np.nan))


THRESHOLDS = Table(
    "thresholds",
    "one row per set-up and number of frames: its threshold, "
    "and the false calls at that threshold on other boards",
    (
        SET_UP,
        Column("threshold", "threshold", "record.threshold", "threshold in the detector's units"),
        Column(
            "threshold_mm",
            "in mm",
            "record.threshold_mm",
            "threshold times the mean residual per unit of score",
        ),
        Column(
            "calibration_runs",
            "calibration runs",
            "record.calibration_runs",
            GIVEN,
            lambda n: str(n or UNSET),
        ),
        Column(
            "rate_low_per_m2",
            "true rate from",
            _of_error("low_per_m2"),
            "lower end of the 95 % interval of the true rate at the threshold, from the boards "
            "that set it",
        ),
        Column("rate_high_per_m2", "to per m²", _of_error("high_per_m2"), "its upper end"),
        Column(
            "threshold_error",
            "",
            _of_error("error"),
            "standard error of the threshold at which the rate is as wanted",
        ),
        Column(
            "threshold_method",
            "",
            lambda row: getattr(row.record.threshold_error, "method", "given"),
            "how the threshold was set",
        ),
        replace(CALLS[0], label="counted per m² (95 %)"),
        replace(CALLS[1], label="false calls on other boards"),
        replace(CALLS[2], label="undamaged m²"),
    ),
)


@dataclass(frozen=True)
class SetBy:
    """The hole-free run that set a threshold."""

    limit: SetUpLimit
    """The set-up."""
    board: int
    """The run's board."""
    x_mm: float
    """Position of its highest score on the board, to the right; NaN off the board."""
    y_mm: float
    """Position of its highest score on the board, upwards; NaN off the board."""
    runs: int
    """Number of calibration runs."""
    same_pixels: int | None
    """Number of runs with the highest score on the same pixels; None if unknown."""

    @property
    def place(self) -> str:
        """The place on the board in mm, as text."""
        if not np.isfinite(self.x_mm):
            return OFF_BOARD
        return f"{self.x_mm:.0f}, {self.y_mm:.0f}".replace("-", "−")


def set_by(limits: Sequence[SetUpLimit]) -> list[SetBy]:
    """Return the run that set each calibrated threshold."""
    rows = []
    for limit in limits:
        runs = limit.record.calibrated
        if runs is None:
            continue
        index = int(np.abs(runs.score - limit.record.threshold).argmin())
        row = SetBy(
            limit=limit,
            board=int(runs.board[index]),
            x_mm=float(runs.x_mm[index]),
            y_mm=float(runs.y_mm[index]),
            runs=len(runs.score),
            same_pixels=_same_pixels(runs, index),
        )
        rows.append(row)
    return rows


def _same_pixels(runs: Calibrated, index: int) -> int | None:
    """Return the number of runs with the highest score on the pixels of this run's."""
    if runs.u_px is None or runs.v_px is None:
        return None
    distance_px = np.hypot(runs.u_px - runs.u_px[index], runs.v_px - runs.v_px[index])
    return int((distance_px <= BLOB_PX).sum())


def threshold_warnings(limits: Sequence[SetUpLimit]) -> list[str]:
    """Return warnings about calibrated thresholds that are too high for noise or set by one place
    on the sensor."""
    rows = set_by(limits)
    warnings = []
    crowded = [row for row in rows if (row.same_pixels or 0) > max(row.runs / 2, 1)]
    if crowded:
        warnings.append(_crowd_warning(crowded, len(limits)))
    for row in rows:
        threshold = row.limit.record.threshold
        if threshold > HIGH_THRESHOLD:
            where = row.place if row.place == OFF_BOARD else f"at x, y = {row.place} mm"
            warnings.append(
                f"{row.limit.record.label}: the threshold is {threshold:.3g} deviations, "
                f"above {HIGH_THRESHOLD:g}: something other than noise sets it "
                f"(calibration board {row.board}, {where}) and thus the limit"
            )
    return warnings


def _crowd_warning(crowded: Sequence[SetBy], set_ups: int) -> str:
    """Return a warning about thresholds that one place on the sensor sets."""
    counts = sorted({row.same_pixels or 0 for row in crowded})
    span = str(counts[0])
    if len(counts) > 1:
        span += f" to {counts[-1]}"
    subject = f"{len(crowded)} of {set_ups} set-ups"
    if len(crowded) == 1:
        subject = crowded[0].limit.record.label
    return (
        f"{subject}: {span} of {crowded[0].runs} calibration boards have their highest score on "
        "the same pixels of the sensor: one place of this unit's fixed pattern sets the threshold "
        "(set study.units to draw several units)"
    )


def threshold_note(record: StudyRecord) -> str:
    """Return how the thresholds were set."""
    stated = record.provenance.get("thresholds")
    if stated:
        return str(stated)
    wanted = record.false_calls_per_m2
    if wanted is None:
        return (
            "Thresholds were given, not calibrated; "
            "the rates beside them are those that were observed."
        )
    plural = "" if wanted == 1 else "s"
    return (
        f"Thresholds are calibrated to {wanted:g} false call{plural} per m² on separate undamaged "
        "boards, by a tail through the strongest findings of each, or by order statistics "
        "(Wilks 1941) where these contradict it. A threshold is itself an estimate: the table "
        "states the interval of the true rate, and the intervals of a50 and a90 and a90/95 "
        "contain the threshold's error."
    )


OPERATING = Table(
    "operating_points",
    "one row per set-up and number of frames: areas under the curves over all thresholds",
    (
        SET_UP_OF,
        Column("damages", "damages", "roc.damages", "number of inspected damages"),
        Column("places", "places", "roc.unflawed", "number of undamaged places"),
        Column(
            "roc_area",
            "ROC's area",
            "roc.area",
            "area under the ROC curve of damages and undamaged places",
        ),
        Column("pro_area", "AU-PRO", "pixels.pro", "area under the per-region overlap of pixels"),
    ),
)


def operating_notes(results: Sequence[SetUpResult]) -> list[str]:
    """Return the definition of AU-PRO, and the set-ups for which it could not be computed."""
    notes = [
        "AU-PRO: area under the mean share of a damage's pixels above the threshold, against the "
        f"share of undamaged pixels above it, up to a share of {PRO_LIMIT:g} and divided by "
        f"{PRO_LIMIT:g}, as in MVTec AD."
    ]
    for result in results:
        if result.pixels is not None and result.pixels.why:
            notes.append(f"{name_of(result.limit)}: no AU-PRO: {result.pixels.why}.")
    return notes


@dataclass(frozen=True, eq=False)
class AxisGroup:
    """An axis and its lines."""

    path: str
    """Dotted path of the axis."""
    name: str
    """Name of the axis in words."""
    values: tuple[Any, ...]
    """Its values, ascending if they are numbers."""
    lines: dict[str, AxisLine]
    """Its lines by their values on the other axes."""

    @property
    def numeric(self) -> bool:
        """True if the values have places on a scale."""
        return all(line.numeric for line in self.lines.values())

    def words(self, value: Any) -> str:
        """Return a value in words; of a mapping, only the keys in which the values differ."""
        return axis_value(self.path, differing(value, self.values))

    @property
    def title(self) -> str:
        """The name of the axis with its unit."""
        unit = unit_of(self.path)
        return f"{self.name} ({unit})" if unit else self.name


def axis_groups(lines: Sequence[AxisLine]) -> list[AxisGroup]:
    """Return the lines of each axis. A line's label gives its values on those other axes on which
    the lines differ."""
    names = names_of(dict.fromkeys(path for line in lines for path in (line.axis, *line.fixed)))
    groups = []
    for path in dict.fromkeys(line.axis for line in lines):
        of_axis = [line for line in lines if line.axis == path]
        values: list[Any] = []
        for line in of_axis:
            values += [value for value in line.values if value not in values]
        if all(line.numeric for line in of_axis):
            values.sort()
        labels = _line_labels(of_axis, names)
        by_label = dict(zip(labels, of_axis, strict=True))
        groups.append(AxisGroup(path, names[path], tuple(values), by_label))
    return groups


def _line_labels(lines: Sequence[AxisLine], names: Mapping[str, str]) -> list[str]:
    """Return the values of each line on those other axes on which the lines differ."""
    axes = dict.fromkeys(axis for line in lines for axis in line.fixed)
    values_of = {axis: [line.fixed.get(axis) for line in lines] for axis in axes}
    varied = [axis for axis, values in values_of.items() if len(set(map(on_one_line, values))) > 1]
    labels = []
    for line in lines:
        parts = []
        for axis in varied:
            if axis in line.fixed:
                words = axis_value(axis, differing(line.fixed[axis], values_of[axis]))
                # a name such as kinect_v2 explains itself, a number needs a key (albedo=0.2)
                is_named = axis == FRAMES or names[axis] in NAMED
                explains_itself = is_named or isinstance(line.fixed[axis], str)
                parts.append(words if explains_itself else f"{names[axis]}={words}")
        labels.append(", ".join(parts))
    return labels


def axis_value(path: str, value: Any) -> str:
    """Return a value in words: ``50 frames``, ``0.7 m``, ``kinect_v2``."""
    if path.endswith("camera.name"):
        return camera_title(value)
    return text.many(value, "frame") if path == FRAMES else value_text(path, value)


class AxisRow(NamedTuple):
    """One value of one line of an axis."""

    group: AxisGroup
    """The axis."""
    line: str
    """Label of the line."""
    value: Any
    """The value."""
    limit: SetUpLimit
    """The limit at this value."""
    step: Difference | None
    """The change of a90 from the previous value."""


def axis_rows(group: AxisGroup) -> list[AxisRow]:
    """Return the values of all lines of an axis."""
    rows = []
    for label, line in group.lines.items():
        steps = (None, *line.steps)
        for value, limit, step in zip(line.values, line.limits, steps, strict=True):
            rows.append(AxisRow(group, label, value, limit, step))
    return rows


def _step_text(row: AxisRow) -> str:
    step = row.step
    if step is None:
        return ""
    beyond = " *" if step.beyond_chance else ""
    if not np.isfinite(step.ratio):
        row_without = "here" if np.isnan(step.to.a90_mm) else "above"
        return f"no a90 {row_without}{beyond}"
    if step.frm.beyond(step.frm.a90_mm) and step.to.beyond(step.to.a90_mm):
        return f"both beyond{beyond}"
    interval = text.interval(step.interval.low, step.interval.high)
    return f"× {step.ratio:.2f} ({interval}){beyond}"


AXES = Table(
    "axes",
    "one row per axis, line (set-ups that differ only on this axis) and value: "
    "the limits and the change of a90",
    (
        Column("axis", "", "group.path", "dotted path of the axis"),
        Column("line", "set-ups", "line", "values of the line's set-ups on the other axes"),
        Column("value", "", lambda row: on_one_line(row.value), "value on the axis"),
        Column("", "value", lambda row: row.group.words(row.value)),
        replace(SET_UP_OF, label=""),
        Column(
            "a50_mm",
            "a50 (mm)",
            lambda row: a50_of(row.limit),
            f"{FOUND_50}, with interval",
            interval=True,
        ),
        Column(
            "a90_mm",
            "a90 (mm)",
            lambda row: a90_of(row.limit),
            f"{FOUND_90}, with interval",
            interval=True,
        ),
        Column(
            "a90_95_mm",
            "a90/95 (mm)",
            lambda row: bound_estimate(row.limit, row.limit.a90_95),
            BOUND,
            bound_text,
        ),
        Column("", "a90 over the row above", _step_text),
        Column(
            "ratio",
            "",
            ("step.ratio", "step.interval"),
            "a90 over a90 at the previous value, with interval",
        ),
        Column("beyond_chance", "", "step.beyond_chance", "whether that interval excludes 1"),
        Column("paired", "", "step.paired", "whether both set-ups inspected the same boards"),
    ),
)


def axis_grid(group: AxisGroup) -> Grid:
    """Return the table of one axis, at most `SHOWN_ROWS` rows."""
    lines = "" if list(group.lines) == [""] else "set-ups"
    return AXES.grid(axis_rows(group)[:SHOWN_ROWS], heads={"set-ups": lines, "value": group.title})


def axis_note(group: AxisGroup) -> str:
    """Explain the changes of a90 and their intervals."""
    steps = [step for line in group.lines.values() for step in line.steps]
    paired = "not all of them the same"
    if all(step.paired for step in steps):
        paired = "the same boards, resampled together"
    beyond = sum(step.beyond_chance for step in steps)
    rows = sum(len(line.values) for line in group.lines.values())
    cut = f" The first {SHOWN_ROWS} of {rows} rows are shown." if rows > SHOWN_ROWS else ""
    return (
        f"Ratio of a90 with its 95 % interval over boards ({paired}). A * marks an interval that "
        f"excludes 1: {beyond} of {len(steps)}. The intervals are a little narrow: 8 to 9 % of "
        f"equal pairs get a *, not 5 %.{cut}"
    )


class DepthAt(NamedTuple):
    """The depth that one set-up finds 90 % of the time at one diameter."""

    limit: SetUpLimit
    """The set-up."""
    diameter_mm: float
    """The diameter."""
    depth: Estimate
    """The depth in mm with its interval."""


def depths_at(results: Sequence[SetUpResult]) -> list[DepthAt]:
    """Return the contours at a probability of 90 % of all surfaces."""
    rows = []
    for result in results:
        surface = result.surface
        if surface is None:
            continue
        deepest = surface.depth_range_mm[1]
        for index, diameter_mm in enumerate(surface.diameter_mm.tolist()):
            depth = Estimate(
                value=float(surface.d90_mm[index]),
                low=float(surface.d90_low_mm[index]),
                high=float(surface.d90_high_mm[index]),
                most=deepest,
            )
            rows.append(DepthAt(result.limit, diameter_mm, depth))
    return rows


DEPTH_LIMITS = Table(
    "depth_limits",
    "one row per set-up, number of frames and diameter: the depth found 90 % of the time, "
    "where limits depend on both",
    (
        SET_UP_OF,
        Column("diameter_mm", "diameter (mm)", "diameter_mm", "diameter of the damage"),
        Column(
            "depth_mm",
            "depth (mm)",
            "depth",
            "depth found 90 % of the time; inf if no depth is",
            interval=True,
        ),
    ),
)
STUDY_TABLES = (LIMITS, THRESHOLDS, CHANCE, OPERATING, AXES, DEPTH_LIMITS, UNKNOWN_TABLE)


def study_tables(result: StudyResult) -> dict[Table, list[Any]]:
    """Return every table of a study with its rows."""
    limits = result.limits
    set_ups = result.set_ups
    return {
        LIMITS: list(limits),
        THRESHOLDS: list(limits),
        CHANCE: [set_up for set_up in set_ups if set_up.chance is not None],
        OPERATING: list(set_ups),
        AXES: [row for group in axis_groups(result.axes) for row in axis_rows(group)],
        DEPTH_LIMITS: depths_at(set_ups),
        UNKNOWN_TABLE: unknown_rows(set_ups),
    }
