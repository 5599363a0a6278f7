"""The form of a study's file (``study.json``, a baseline): what each field may hold, and mistakes in it in words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

from pydantic import Field, ValidationError, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import shown

Number = Annotated[int, Field(ge=0, le=2**53)]
Name = Annotated[str, Field(min_length=1)]
Size = Annotated[float, Field(gt=0)]
Length = Annotated[float, Field(ge=0)]
WORDS = {
    "Input should be": "should be",
    "a valid integer": "a whole number",
    "a valid number": "a number",
    "a valid boolean": "true or false",
    "a valid string": "text",
    "a valid dictionary": "a mapping",
    "a valid tuple": "a list",
}
"""pydantic's words and ours, for what JSON holds."""


class _Columns(Config):
    """A table by columns: all of one length, no row twice."""

    board: tuple[Number, ...]
    repeat: tuple[Number, ...]

    @model_validator(mode="after")
    def _one_table(self) -> _Columns:
        there = {name: getattr(self, name) for name in type(self).model_fields}
        columns = {name: column for name, column in there.items() if column is not None}
        lengths = {len(column): name for name, column in columns.items()}
        if len(lengths) > 1:
            raise ValueError("columns of different lengths: " + ", ".join(f"`{k}` {n}" for n, k in lengths.items()))
        named = [column for name, column in columns.items() if name in ("board", "repeat", "hole")]
        if len(set(zip(*named, strict=True))) < len(self.board):
            raise ValueError("the same inspection stands there twice")
        return self


class InspectedForm(_Columns):
    """Of `harness.evaluation.study.record.Inspected`. A signal is null where no pixel was judged."""

    hole: tuple[Name, ...] = Field(min_length=1)
    diameter_mm: tuple[Size, ...]
    depth_mm: tuple[Length, ...]
    x_mm: tuple[float, ...]
    y_mm: tuple[float, ...]
    hit: tuple[bool, ...]
    signal: tuple[float | None, ...]
    by_depth: tuple[bool, ...] | None = None
    by_no_return: tuple[bool, ...] | None = None


class UnflawedForm(_Columns):
    """Of `harness.evaluation.study.record.Unflawed`."""

    calls: tuple[Number, ...]
    area_m2: tuple[Size, ...]
    no_return_calls: tuple[Number, ...] | None = None


class CalibratedForm(_Columns):
    """Of `harness.evaluation.study.record.Calibrated`. A place is null where it is off the board."""

    score: tuple[float, ...]
    x_mm: tuple[float | None, ...]
    y_mm: tuple[float | None, ...]


class SetUpForm(Config):
    """Of `harness.evaluation.study.record.SetUpRecord`. ``threshold_mm`` is null where the detector has no scale."""

    variant: Name
    frames: int = Field(ge=1)
    axes: dict[str, Any]
    detector: Name
    detector_version: int
    threshold: float
    threshold_mm: float | None
    calibration_runs: Number
    failed: Number
    targets_digest: Name
    frames_digest: Name
    inspected: InspectedForm
    unflawed: UnflawedForm
    calibrated: CalibratedForm | None = None


class StudyForm(Config):
    """Of `harness.evaluation.study.record.StudyRecord`."""

    record_version: int
    name: Name
    digest: Name
    hit_radius_mm: Size
    false_calls_per_m2: Size | None
    provenance: dict[str, Any]
    set_ups: tuple[SetUpForm, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _no_set_up_twice(self) -> StudyForm:
        seen: set[tuple[str, int]] = set()
        for one in self.set_ups:
            if (one.variant, one.frames) in seen:
                raise ValueError(f"set-up {one.variant!r} with frames {one.frames} stands there twice")
            seen.add((one.variant, one.frames))
        return self


def mistake_in(data: Any) -> str:
    """What is wrong with a study's data (as JSON holds it) in one sentence, with its place; empty where nothing is."""
    try:
        StudyForm.from_data(data)
    except ValidationError as error:
        first, *others = error.errors(include_url=False)
        more = f"; and {len(others)} more" if others else ""
        return f"{', '.join(_place(first['loc'], data))}{_what(first)}{more}"
    return ""


def _place(location: tuple[int | str, ...], data: Any) -> Iterator[str]:
    """Set-up, field and row, as far as the location goes."""
    path = list(location)
    if path[:1] == ["set_ups"] and len(path) > 1 and isinstance(path[1], int):
        yield _set_up(path[1], data)
        path = path[2:]
    rows = [part for part in path if isinstance(part, int)]
    if names := [part for part in path if isinstance(part, str) and not part.startswith(("float", "none"))]:
        yield f"`{'.'.join(names)}`"
    if rows:
        yield f"value {rows[0] + 1}"


def _set_up(place: int, data: Any) -> str:
    """A set-up by its number, and by its name where that can be read."""
    one = data["set_ups"][place]
    variant = one.get("variant") if isinstance(one, dict) else None
    named = f" ({variant}, frames {one.get('frames')})" if isinstance(variant, str) else ""
    return f"set-up {place + 1}{named}"


def _what(error: Any) -> str:
    """One of pydantic's errors as the end of our sentence."""
    kind, value = error["type"], error.get("input")
    if kind == "missing":
        return " is missing"
    if kind == "extra_forbidden":
        return " is no field of a record"
    if kind == "value_error":
        return f"{': ' if error['loc'] else ''}{error['ctx']['error']}"
    if kind == "too_short":
        return " is empty"
    text = str(error["msg"]).partition(" or instance of")[0].partition(" or object to")[0]
    for old, new in WORDS.items():
        text = text.replace(old, new)
    return f" {text}, not {shown(value)}"
