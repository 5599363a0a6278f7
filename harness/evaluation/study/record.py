"""The record of a study: every inspection of every set-up, by itself enough for limits and comparisons.

Stored as ``study.json`` in a result folder and as the baseline of a gate, so that a comparison needs no other file.
The classes here declare the file: each field's type says what JSON may hold in its place, and the file is written,
checked and read by these types alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, ConfigDict, Field, GetCoreSchemaHandler, Strict, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, core_schema

from harness.vocabulary.declaration.diagnose import shown
from harness.vocabulary.errors import UserError
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import RECORD_BYTES, bounded_bytes
from harness.vocabulary.versions import check_version

RECORD_VERSION = 2
"""1: hits by depth alone. Raised when a field's meaning, or what counts as a hit, changes."""
OLDEST_VERSION = 1
"""Still read: where nothing is lost by missing returns its hits are those of today."""
LEGAL = "a study.json, or a baseline that python -m harness.check --update wrote"
AGAIN = "run the study again, which writes the file anew; it is not made to be edited by hand"


@dataclass(frozen=True)
class StoredColumn:
    """A column of a table: an array in memory, a list of ``value`` in JSON, where null stands for NaN."""

    dtype: type
    value: Any

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        listed = core_schema.list_schema(handler.generate_schema(self.value), strict=True)
        return core_schema.no_info_after_validator_function(
            lambda values: np.array([np.nan if value is None else value for value in values], self.dtype),
            listed,
            serialization=core_schema.plain_serializer_function_ser_schema(
                lambda column: [None if value != value else value for value in column.tolist()]
            ),
        )


class NumberOrNull:
    """A number in memory, NaN for null in JSON."""

    @staticmethod
    def __get_pydantic_core_schema__(source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(
            lambda value: np.nan if value is None else value,
            handler.generate_schema(RealOrNull),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda v: None if v != v else v),
        )


def _one_table(table: Any) -> Any:
    """Refuse columns of different lengths and rows that stand there twice."""
    columns = {name: column for name, column in vars(table).items() if column is not None}
    lengths = {len(column): name for name, column in columns.items()}
    if len(lengths) > 1:
        raise ValueError("columns of different lengths: " + ", ".join(f"`{k}` {n}" for n, k in lengths.items()))
    named = [column.tolist() for name, column in columns.items() if name in ("board", "repeat", "hole")]
    if len(set(zip(*named, strict=True))) < len(table.board):
        raise ValueError("the same inspection stands there twice")
    return table


def _no_set_up_twice(set_ups: tuple[SetUpRecord, ...]) -> tuple[SetUpRecord, ...]:
    seen: set[tuple[str, int]] = set()
    for one in set_ups:
        if (one.variant, one.frames) in seen:
            raise ValueError(f"set-up {one.variant!r} with frames {one.frames} stands there twice")
        seen.add((one.variant, one.frames))
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
FORM = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, eq=False)
class Inspected:
    """Inspections of damage, one a row: each damage of each board once for every repeat of the noise.

    ``board``, ``repeat`` (n,) int, ``hole`` (n,) str name it; ``diameter_mm``, ``depth_mm`` (removed material),
    ``x_mm``, ``y_mm`` (on the board) are true. ``hit`` (n,) bool. ``signal`` (n,): the highest score within the hit
    radius of the damage's centre, NaN where no pixel there was judged. ``by_depth``, ``by_no_return`` (n,) bool: hits
    by each kind of finding, either of which is a ``hit``; None where hits were counted by depth alone.
    """

    __pydantic_config__ = FORM
    board: Counts
    hole: Names
    repeat: Counts
    diameter_mm: Sizes
    depth_mm: Depths
    x_mm: Numbers
    y_mm: Numbers
    hit: Truths
    signal: NumbersOrNull
    by_depth: Truths | None = None
    by_no_return: Truths | None = None


@dataclass(frozen=True, eq=False)
class Unflawed:
    """Runs on hole-free boards that set no threshold: ``board``, ``repeat`` (m,) int, ``calls`` (m,) int false calls,
    ``area_m2`` (m,) of face that was judged; ``no_return_calls`` (m,) int: calls without return among them, or None."""

    __pydantic_config__ = FORM
    board: Counts
    repeat: Counts
    calls: Counts
    area_m2: Sizes
    no_return_calls: Counts | None = None


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Hole-free runs that set a threshold: ``board``, ``repeat`` (k,) int; ``score`` (k,): of the highest pixel, above
    which the run has no finding; ``x_mm``, ``y_mm`` (k,): where that pixel lies on the board, NaN where off it."""

    __pydantic_config__ = FORM
    board: Counts
    repeat: Counts
    score: Numbers
    x_mm: NumbersOrNull
    y_mm: NumbersOrNull


@dataclass(frozen=True, eq=False)
class SetUpRecord:
    """One set-up at one number of frames.

    ``axes``: its place on the experiment's axes other than frames, by dotted path. ``threshold`` in the detector's
    units, ``threshold_mm`` that times the mean scale, NaN where the detector has none; ``calibration_runs`` hole-free
    runs on boards of their own set it (0: given). ``failed``: trials that raised. ``targets_digest`` names boards and
    damage, ``frames_digest`` those with camera, noise seed and the code that simulates: equal for identical frames.
    ``calibrated``: what those runs found; None in records that do not keep it.
    """

    __pydantic_config__ = FORM
    variant: Name
    frames: Annotated[Whole, Field(ge=1)]
    axes: Mapping[str, Any]
    detector: Name
    detector_version: Whole
    threshold: Real
    threshold_mm: Annotated[float, NumberOrNull]
    calibration_runs: Number
    failed: Number
    targets_digest: Name
    frames_digest: Name
    inspected: Annotated[Inspected, AfterValidator(_one_table)]
    unflawed: Annotated[Unflawed, AfterValidator(_one_table)]
    calibrated: Annotated[Calibrated, AfterValidator(_one_table)] | None = None

    @property
    def label(self) -> str:
        """Set-up and frames, for tables."""
        frames = f"{self.frames} frame{'s' if self.frames > 1 else ''}"
        return frames if self.variant == "main" else f"{self.variant}, {frames}"


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """A whole study. ``hit_radius_mm``: what counts as a hit, fixed beforehand. ``false_calls_per_m2``: the rate that
    thresholds were calibrated to, None where they were given. ``provenance``: commit, dirty, versions, seed."""

    __pydantic_config__ = FORM
    name: Name
    digest: Name
    hit_radius_mm: Size
    false_calls_per_m2: Size | None
    provenance: Mapping[str, Any]
    set_ups: Annotated[tuple[SetUpRecord, ...], Field(min_length=1), AfterValidator(_no_set_up_twice)]

    def to_data(self) -> dict[str, Any]:
        """Return JSON's types; NaN becomes None, and a column or table that is None is left out."""
        data = TypeAdapter(StudyRecord).dump_python(self, mode="json", exclude_none=True)
        return {"record_version": RECORD_VERSION, "false_calls_per_m2": None, **data}


def record_text(record: StudyRecord) -> str:
    """Write the record as JSON text, one set-up a line, so that a changed baseline reads as a change of few lines."""
    data = record.to_data()
    lines = ",\n  ".join(json.dumps(one, sort_keys=True) for one in data.pop("set_ups"))
    head = json.dumps(data, sort_keys=True, indent=1)[:-2]
    return f'{head},\n "set_ups": [\n  {lines}\n ]\n}}\n'


def read_record(path: Path) -> StudyRecord:
    """Read the record at ``path``: a file, or a result folder with its ``study.json``.

    Raises UserError where there is none, where it is no record or a damaged one (with set-up and field), and where
    it is of another version.
    """
    file = Path(path) / "study.json" if Path(path).is_dir() else Path(path)
    try:
        data = strict_json(bounded_bytes(file, RECORD_BYTES), nan=True)  # its form says where a NaN stands
    except OSError as error:
        fix = "name a folder that a sweep with a `study` wrote, such as results/detection_limit/<digest>"
        raise UserError(f"{file}: cannot be read ({error.strerror})", fix=fix) from error
    except ValueError as error:
        raise UserError(f"{file}: is no JSON ({error})", legal=LEGAL, fix=AGAIN) from error
    if not isinstance(data, dict) or "record_version" not in data:
        raise UserError(f"{file}: is no study's record", legal=LEGAL)
    check_version(data.pop("record_version"), RECORD_VERSION, file, "a record", oldest=OLDEST_VERSION, again=AGAIN)
    try:
        return TypeAdapter(StudyRecord).validate_python(data)
    except ValidationError as error:
        raise UserError(f"{file}: is damaged: {_mistake(error, data)}", fix=AGAIN) from error


# mistakes in words


WORDS = {
    "Input should be": "should be",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid boolean": "true or false",
    "a valid string": "text",
    "a valid dictionary": "a mapping",
    "a dictionary": "a mapping",
    "a valid tuple": "a list",
    "a valid list": "a list",
}
"""pydantic's words and ours, for what JSON holds."""


def _mistake(error: ValidationError, data: Any) -> str:
    """Describe the first mistake in a study's data in one sentence, with set-up, field and row, and count the rest."""
    first, *others = error.errors(include_url=False)
    more = f"; and {len(others)} more" if others else ""
    return f"{', '.join(_place(first['loc'], data))}{_what(first)}{more}"


def _place(location: tuple[int | str, ...], data: Any) -> Iterator[str]:
    path = list(location)
    if path[:1] == ["set_ups"] and len(path) > 1 and isinstance(path[1], int):
        one = data["set_ups"][path[1]]
        variant = one.get("variant") if isinstance(one, dict) else None
        named = f" ({variant}, frames {one.get('frames')})" if isinstance(variant, str) else ""
        yield f"set-up {path[1] + 1}{named}"
        path = path[2:]
    rows = [part for part in path if isinstance(part, int)]
    if names := [part for part in path if isinstance(part, str) and not part.startswith(("float", "none"))]:
        yield f"`{'.'.join(names)}`"
    if rows:
        yield f"value {rows[0] + 1}"


def _what(error: Any) -> str:
    """One of pydantic's errors as the end of our sentence."""
    kind, value = error["type"], error.get("input")
    if kind == "missing":
        return " is missing"
    if kind == "unexpected_keyword_argument":
        return " is no field of a record"
    if kind == "value_error":
        return f"{': ' if error['loc'] else ''}{error['ctx']['error']}"
    if kind == "too_short":
        return " is empty"
    text = str(error["msg"]).partition(" or an instance of")[0]
    for old, new in WORDS.items():
        text = text.replace(old, new)
    return f" {text}, not {shown(value)}"
