"""The record of a study: every inspection of every set-up, which suffices for limits and
comparisons. It is stored as ``study.json`` in a result folder and as the baseline of a gate; the
classes here declare, check and write the file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    PlainSerializer,
    Strict,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import CoreSchema, core_schema

from harness.records.outputs import run_at
from harness.vocabulary.declaration.diagnose import shown
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import RECORD_BYTES, bounded_bytes, strict_json
from harness.vocabulary.path_names import in_words
from harness.vocabulary.provenance import check_version
from harness.vocabulary.words import nearest

# 1: hits by depth alone. Increased when the meaning of a field, or of a hit, changes
RECORD_VERSION = 2
# still read: if no damage is found only by missing returns, its hits are those of today
OLDEST_VERSION = 1
LEGAL = "a study.json, or a baseline that tofpod check --update wrote"
KEYS = ("board", "repeat", "hole")  # columns that identify an inspection
AGAIN = "run the study again, which rewrites the file; do not edit it by hand"


@dataclass(frozen=True)
class StoredColumn:
    """A column of a table: an array in memory, a list in JSON, where null stands for NaN."""

    dtype: type
    """Type of the array's elements."""
    value: Any
    """Declared type of the list's elements."""

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        listed = core_schema.list_schema(handler.generate_schema(self.value), strict=True)
        written = core_schema.plain_serializer_function_ser_schema(_listed)
        return core_schema.no_info_after_validator_function(
            self._array, listed, serialization=written
        )

    def _array(self, values: list[Any]) -> np.ndarray:
        return np.array([np.nan if value is None else value for value in values], self.dtype)


def _listed(column: np.ndarray) -> list[Any]:
    """Return a column as JSON's types; only NaN differs from itself."""
    return [None if value != value else value for value in column.tolist()]


def _one_table(table: Any) -> Any:
    """Refuse columns of different lengths, and repeated rows."""
    columns = {
        name: column for name, column in vars(table).items() if isinstance(column, np.ndarray)
    }
    lengths = {len(column): f"{name} {len(column)}" for name, column in columns.items()}
    if len(lengths) > 1:
        raise ValueError(f"columns of different lengths: {', '.join(lengths.values())}")
    keys = [column.tolist() for name, column in columns.items() if name in KEYS]
    if len(set(zip(*keys, strict=True))) < len(table.board):
        raise ValueError("the same inspection occurs twice")
    return table


def _no_set_up_twice(set_ups: tuple[SetUpRecord, ...]) -> tuple[SetUpRecord, ...]:
    names = [(set_up.variant, set_up.frames) for set_up in set_ups]
    for variant, frames in names:
        if names.count((variant, frames)) > 1:
            raise ValueError(f"set-up {variant!r} with frames {frames} occurs twice")
    return set_ups


Real = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Number = Annotated[Whole, Field(ge=0, le=2**53)]
Name = Annotated[str, Strict(), Field(min_length=1)]
Size = Annotated[Real, Field(gt=0)]
RealOrNull = Real | None
Counts = Annotated[np.ndarray, StoredColumn(int, Number)]
Names = Annotated[np.ndarray, StoredColumn(str, Name), Field(min_length=1)]
Sizes = Annotated[np.ndarray, StoredColumn(float, Size)]
Depths = Annotated[np.ndarray, StoredColumn(float, Annotated[Real, Field(ge=0)])]
Numbers = Annotated[np.ndarray, StoredColumn(float, Real)]
NumbersOrNull = Annotated[np.ndarray, StoredColumn(float, RealOrNull)]
Truths = Annotated[np.ndarray, StoredColumn(bool, Annotated[bool, Strict()])]
NULL_IS_NAN = BeforeValidator(lambda value: np.nan if value is None else value)
NAN_IS_NULL = PlainSerializer(lambda value: None if value != value else value)
FORM = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class Inspected:
    """Inspections of damage, one per row: each damage of each board for every repeat of the
    noise."""

    __pydantic_config__ = FORM
    board: Counts
    """Board (n,)."""
    hole: Names
    """Name (n,) of the damage on its board."""
    repeat: Counts
    """Repeat (n,) of the noise."""
    diameter_mm: Sizes
    """True diameter (n,); of long damage the width or length, as ``size_of`` says."""
    depth_mm: Depths
    """True depth (n,) removed."""
    x_mm: Numbers
    """True centre (n,) on the board, to the right."""
    y_mm: Numbers
    """True centre (n,) on the board, upwards."""
    hit: Truths
    """True if the damage was found (n,)."""
    signal: NumbersOrNull
    """Highest score (n,) within the hit radius; NaN if no pixel there was judged."""
    by_depth: Truths | None = None
    """Hits (n,) by a finding of depth; None if hits were counted by depth alone."""
    by_no_return: Truths | None = None
    """Hits (n,) by a finding of missing returns; None likewise."""
    size_of: Name = "diameter"
    """Name of what ``diameter_mm`` holds: diameter, width or length."""

    @property
    def limit_of(self) -> str:
        """The name of the limits' size: depth if only depth varies, else diameter, width or
        length."""
        one_diameter = len(self.hit) > 0 and np.ptp(self.diameter_mm) == 0
        if one_diameter and 0 < self.depth_mm.min() < self.depth_mm.max():
            return "depth"
        return self.size_of

    @property
    def size_mm(self) -> np.ndarray:
        """Sizes (n,) that `limit_of` names."""
        return self.depth_mm if self.limit_of == "depth" else self.diameter_mm


@dataclass(frozen=True, eq=False)
class Unflawed:
    """Runs (m,) on boards of one kind, hole-free or damaged, that set no threshold."""

    __pydantic_config__ = FORM
    board: Counts
    """Board (m,)."""
    repeat: Counts
    """Repeat (m,) of the noise."""
    calls: Counts
    """False calls (m,)."""
    area_m2: Sizes
    """Judged face (m,)."""
    no_return_calls: Counts | None = None
    """Calls (m,) by missing returns among them, or None."""


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Hole-free runs (k,) that set a threshold, and each run's highest pixel."""

    __pydantic_config__ = FORM
    board: Counts
    """Board (k,)."""
    repeat: Counts
    """Repeat (k,) of the noise."""
    score: Numbers
    """Score (k,) of the highest pixel; with a threshold above it, the run has no finding."""
    x_mm: NumbersOrNull
    """Position (k,) of that pixel on the board, to the right; NaN if it is off the board."""
    y_mm: NumbersOrNull
    """Position (k,) of that pixel on the board, upwards; NaN likewise."""
    u_px: NumbersOrNull | None = None
    """Its column (k,) on the sensor, or None."""
    v_px: NumbersOrNull | None = None
    """Its row (k,) on the sensor, or None."""


@dataclass(frozen=True)
class ThresholdError:
    """Uncertainty of a threshold for a rate of false calls, from the boards that set it."""

    __pydantic_config__ = FORM
    error: Annotated[Real, Field(ge=0)]
    """Standard error of the threshold at which the rate is as wanted."""
    low_per_m2: Annotated[Real, Field(ge=0)]
    """Lower end of the 95 % interval of the true rate at the threshold in use."""
    high_per_m2: Annotated[Real, Field(ge=0)]
    """Its upper end."""
    method: Name
    """How the threshold was set."""


@dataclass(frozen=True, eq=False)
class DrawnUnknown:
    """A fact that nobody has measured, and what each damaged board had of it."""

    __pydantic_config__ = FORM
    key: Name
    """Its dotted key in the experiment."""
    reason: Name
    """Reason for its values, by the experiment."""
    board: Counts
    """Board (b,)."""
    level: Numbers
    """The number (b,) that was drawn from the range, or the index of the value."""
    values: tuple[Any, ...] | None = None
    """The equally probable values; None for a range."""
    range: tuple[Real, Real] | None = None
    """Ends of the range; None for values."""
    stated: Any = None
    """What the experiment states, as plain data; None for nothing there."""


@dataclass(frozen=True, eq=False)
class SetUpRecord:
    """One set-up at one number of frames."""

    __pydantic_config__ = FORM
    variant: Name
    """Name of the set-up."""
    frames: Annotated[Whole, Field(ge=1)]
    """Number of averaged frames."""
    axes: Mapping[str, Any]
    """Values of the swept axes by dotted path, without frames."""
    detector: Name
    """Name of the detector."""
    detector_version: Whole
    """Version of the detector."""
    threshold: Real
    """Threshold in the detector's units."""
    threshold_mm: Annotated[float, Field(allow_inf_nan=True, strict=True), NULL_IS_NAN, NAN_IS_NULL]
    """Threshold in mm; NaN without a scale."""
    calibration_runs: Number
    """Number of hole-free runs on separate boards that set it; 0 if it was given."""
    failed: Number
    """Number of trials that raised."""
    targets_digest: Name
    """Identifies boards and damage."""
    frames_digest: Name
    """Identifies boards, damage, camera, noise seed and simulating code."""
    inspected: Annotated[Inspected, AfterValidator(_one_table)]
    """Inspections of damage."""
    unflawed: Annotated[Unflawed, AfterValidator(_one_table)]
    """Runs on hole-free boards."""
    calibrated: Annotated[Calibrated, AfterValidator(_one_table)] | None = None
    """Runs that set the threshold, if kept."""
    beside: Annotated[Unflawed, AfterValidator(_one_table)] | None = None
    """Findings on the damaged boards that match no damage, if kept."""
    units: Annotated[Whole, Field(ge=1)] = 1
    """Number of units of the camera. If more than one, repeat r of a damaged board shows unit r
    modulo ``units``, and every hole-free board has a unit of its own."""
    drawn: tuple[Annotated[DrawnUnknown, AfterValidator(_one_table)], ...] = ()
    """Unknowns that differ from board to board."""
    threshold_error: ThresholdError | None = None
    """Uncertainty of the threshold; None for one that was given, and in older records."""
    sizes_chosen: Annotated[bool, Strict()] = False
    """Whether sizes were chosen where POD rises (`BoardDesign`), so that the damages of one board
    are found or missed together."""

    @property
    def label(self) -> str:
        """Set-up and frames, for tables."""
        frames = f"{self.frames} frame{'s' if self.frames > 1 else ''}"
        return frames if self.variant == "main" else f"{in_words(self.variant)}, {frames}"


@dataclass(frozen=True)
class BoardDesign:
    """The damaged boards of a study with a precision, for one kind of damage: sizes by board, and
    why there are no more (`harness.evaluation.study.sequential`)."""

    __pydantic_config__ = FORM
    damage: str
    """The kind in words; empty if the study has only one."""
    range_mm: tuple[Size, Size]
    """Ends of the sizes."""
    per_board: Number
    """Damages of a board."""
    most_boards: Number
    """Largest number of boards."""
    uniform_boards: Number
    """Number of the first boards, whose sizes are drawn over the whole range."""
    a90_mm: Size | None = None
    """Widest 95 % interval of a90 that was asked for; None if it was asked for in percent."""
    a90_percent: Size | None = None
    """The same in percent of a90."""
    chosen_mm: tuple[tuple[Size, ...], ...] = ()
    """Sizes of each later board, ascending."""
    reason: str = ""
    """Why there are no more boards; empty while there are."""
    is_reached: Annotated[bool, Strict()] = False
    """Whether a90 of every set-up is as precise as wanted."""

    @property
    def boards(self) -> int:
        """Number of damaged boards."""
        return self.uniform_boards + len(self.chosen_mm)

    @property
    def wanted(self) -> str:
        """The precision that was asked for, in words."""
        return f"{self.a90_percent:g} %" if self.a90_mm is None else f"{self.a90_mm:g} mm"

    @property
    def outcome(self) -> str:
        """Precision, boards used and whether they sufficed, as a clause."""
        lead = f"{self.damage}: " if self.damage else ""
        reached = "reached" if self.is_reached else "not reached"
        return f"{lead}a90 wanted to {self.wanted}, {reached} with {self.boards} boards"

    @property
    def sentence(self) -> str:
        """Boards by the way in which their sizes were chosen, and why there are no more."""
        lead = f"{self.damage}: " if self.damage else ""
        chosen = len(self.chosen_mm)
        return (
            f"{lead}The 95 % interval of a90 was to be at most {self.wanted} wide. Of "
            f"{self.boards} boards, {self.uniform_boards} have sizes over the whole range and "
            f"{chosen} the sizes that narrow the widest interval most. No more boards: "
            f"{self.reason}."
        )

    def sizes_mm(self, board: int) -> tuple[float, ...] | None:
        """Return the chosen sizes of a board; None for one of the first."""
        if board < self.uniform_boards:
            return None
        return self.chosen_mm[board - self.uniform_boards]


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """A whole study."""

    __pydantic_config__ = FORM
    name: Name
    """Name of the experiment."""
    digest: Name
    """Identifies its result folder."""
    hit_radius_mm: Size
    """Largest distance from a damage to the centre of a finding that hits it."""
    false_calls_per_m2: Size | None
    """The thresholds' rate; None if they were given."""
    provenance: Mapping[str, Any]
    """Commit, dirty, versions, seed."""
    set_ups: Annotated[
        tuple[SetUpRecord, ...], Field(min_length=1), AfterValidator(_no_set_up_twice)
    ]
    """Set-ups in the experiment's order."""
    hit_overlap: Size | None = None
    """Share of a finding's pixels on a damage from which it is a hit; None if not used."""
    designs: tuple[BoardDesign, ...] = ()
    """Damaged boards of each kind of damage, if the study has a precision."""

    @property
    def hit_rule(self) -> str:
        """Rule for a hit, as the end of a sentence that begins with a damage."""
        long = any(set_up.inspected.size_of != "diameter" for set_up in self.set_ups)
        centre = "its own" if self.hit_overlap is None else "its centre"
        if long:
            centre = "its centre line"
        rule = f"where the centre of a finding lies within {self.hit_radius_mm:.3g} mm of {centre}"
        if self.hit_overlap is None:
            return rule
        share = f"{100 * self.hit_overlap:.3g} %"
        return f"{rule}, or at least {share} of a finding's pixels lie on it or 2 pixels beside it"

    def to_data(self) -> dict[str, Any]:
        """Return the record as JSON's types; NaN becomes None, and a column or table that is None
        is left out."""
        data = TypeAdapter(StudyRecord).dump_python(self, mode="json", exclude_none=True)
        return {"record_version": RECORD_VERSION, "false_calls_per_m2": None, **data}


def record_text(record: StudyRecord) -> str:
    """Return the record as JSON text with one set-up per line, so that a changed baseline differs
    in few lines."""
    data = record.to_data()
    lines = ",\n  ".join(json.dumps(set_up, sort_keys=True) for set_up in data.pop("set_ups"))
    head = json.dumps(data, sort_keys=True, indent=1)[:-2]
    return f'{head},\n "set_ups": [\n  {lines}\n ]\n}}\n'


def read_record(path: Path) -> StudyRecord:
    """Read the record at ``path``: a file, or a result folder with its ``study.json``. Raises
    UserError if there is none, if it is not a record or is damaged (with set-up and field), and if
    it has another version."""
    file = run_at(Path(path))
    if file.is_dir():
        file = file / "study.json"
    try:
        # NaN is allowed in the record's columns
        data = strict_json(bounded_bytes(file, RECORD_BYTES), nan=True)
    except OSError as error:
        fix = (
            "name a folder that a sweep with a `study` wrote, "
            "such as results/detection_limit/<digest>"
        )
        raise UserError(f"{file}: cannot be read ({error.strerror})", fix=fix) from error
    except ValueError as error:
        raise UserError(f"{file}: is not JSON ({error})", legal=LEGAL, fix=AGAIN) from error
    if not isinstance(data, dict) or "record_version" not in data:
        raise UserError(f"{file}: is not the record of a study", legal=LEGAL)
    check_version(
        data.pop("record_version"),
        RECORD_VERSION,
        file,
        "a record",
        oldest=OLDEST_VERSION,
        again=AGAIN,
    )
    try:
        return TypeAdapter(StudyRecord).validate_python(data)
    except ValidationError as error:
        raise UserError(f"{file}: is damaged: {_mistake(error, data)}", fix=AGAIN) from error


def set_up_named(study: StudyRecord, name: str | None) -> SetUpRecord:
    """Return the set-up with this label, or the only one. Raises UserError if there is none, or
    none is named."""
    by_label = {record.label: record for record in study.set_ups}
    legal = "; ".join(by_label)
    if not name:
        if len(by_label) > 1:
            count = f"{study.name} has {len(by_label)} set-ups"
            raise UserError(count, legal=legal, fix='name one: --set-up "..."')
        (name,) = by_label
    if name not in by_label:
        similar = nearest(name, by_label)
        meant = f"; did you mean {similar!r}?" if similar else ""
        raise UserError(f"{study.name} has no set-up {name!r}{meant}", legal=legal)
    return by_label[name]


def _mistake(error: ValidationError, data: Any) -> str:
    """Describe the first mistake in a study's data in one sentence, with its place, and count the
    rest."""
    first, *remaining = error.errors(include_url=False)
    path = [part for part in first["loc"] if not str(part).startswith(("float", "none"))]
    where = ".".join(map(str, path))
    if path[:1] == ["set_ups"] and len(path) > 1:
        set_up = data["set_ups"][path[1]]
        if isinstance(set_up, dict):
            where += f" (set-up {set_up.get('variant')}, frames {set_up.get('frames')})"
    text = str(first.get("ctx", {}).get("error", first["msg"])).partition(" or an instance of")[0]
    sentence = f"{where}: {text}"
    value = first.get("input")
    if value is None or isinstance(value, str | int | float):
        sentence += f", not {shown(value)}"
    if remaining:
        sentence += f"; and {len(remaining)} more"
    return sentence
