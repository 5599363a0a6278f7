"""What a study leaves to be judged: every inspection of every set-up, by itself enough for limits and comparisons.

Stored as ``study.json`` in a result folder and as the baseline of a gate, so that a comparison needs no other file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from harness.evaluation.study.record_form import mistake_in
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


@dataclass(frozen=True, eq=False)
class Inspected:
    """Inspections of damage, one a row: each damage of each board once for every repeat of the noise.

    ``board``, ``repeat`` (n,) int, ``hole`` (n,) str name it; ``diameter_mm``, ``depth_mm`` (removed material),
    ``x_mm``, ``y_mm`` (on the board) are true. ``hit`` (n,) bool. ``signal`` (n,): the highest score within the hit
    radius of the damage's centre, NaN where no pixel there was judged. ``by_depth``, ``by_no_return`` (n,) bool: hits
    by each kind of finding, either of which is a ``hit``; None where hits were counted by depth alone.
    """

    board: np.ndarray
    hole: np.ndarray
    repeat: np.ndarray
    diameter_mm: np.ndarray
    depth_mm: np.ndarray
    x_mm: np.ndarray
    y_mm: np.ndarray
    hit: np.ndarray
    signal: np.ndarray
    by_depth: np.ndarray | None = None
    by_no_return: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Unflawed:
    """Runs on hole-free boards that set no threshold: ``board``, ``repeat`` (m,) int, ``calls`` (m,) int false calls,
    ``area_m2`` (m,) of face that was judged; ``no_return_calls`` (m,) int: calls without return among them, or None."""

    board: np.ndarray
    repeat: np.ndarray
    calls: np.ndarray
    area_m2: np.ndarray
    no_return_calls: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Calibrated:
    """Hole-free runs that set a threshold: ``board``, ``repeat`` (k,) int; ``score`` (k,): of the highest pixel, above
    which the run has no finding; ``x_mm``, ``y_mm`` (k,): where that pixel lies on the board, NaN where off it."""

    board: np.ndarray
    repeat: np.ndarray
    score: np.ndarray
    x_mm: np.ndarray
    y_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class SetUpRecord:
    """One set-up at one number of frames.

    ``axes``: its place on the experiment's axes other than frames, by dotted path. ``threshold`` in the detector's
    units, ``threshold_mm`` that times the mean scale; ``calibration_runs`` hole-free runs on boards of their own set
    it (0: given). ``failed``: trials that raised. ``targets_digest`` names boards and damage, ``frames_digest`` those
    with camera, noise seed and the code that simulates: equal for identical frames. ``calibrated``: what those runs
    found; None in records that do not keep it.
    """

    variant: str
    frames: int
    axes: Mapping[str, Any]
    detector: str
    detector_version: int
    threshold: float
    threshold_mm: float
    calibration_runs: int
    failed: int
    targets_digest: str
    frames_digest: str
    inspected: Inspected
    unflawed: Unflawed
    calibrated: Calibrated | None = None

    @property
    def label(self) -> str:
        """Set-up and frames, for tables."""
        frames = f"{self.frames} frame{'s' if self.frames > 1 else ''}"
        return frames if self.variant == "main" else f"{self.variant}, {frames}"


@dataclass(frozen=True, eq=False)
class StudyRecord:
    """A whole study. ``hit_radius_mm``: what counts as a hit, fixed beforehand. ``false_calls_per_m2``: the rate that
    thresholds were calibrated to, None where they were given. ``provenance``: commit, dirty, versions, seed."""

    name: str
    digest: str
    hit_radius_mm: float
    false_calls_per_m2: float | None
    provenance: Mapping[str, Any]
    set_ups: tuple[SetUpRecord, ...]

    def to_data(self) -> dict[str, Any]:
        """As JSON's types; NaN becomes None."""
        data = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "set_ups"}
        return {"record_version": RECORD_VERSION, **data, "set_ups": [_set_up_data(one) for one in self.set_ups]}


def record_text(record: StudyRecord) -> str:
    """The record as JSON text, one set-up a line, so that a changed baseline reads as a change of few lines."""
    data = record.to_data()
    lines = ",\n  ".join(json.dumps(one, sort_keys=True) for one in data.pop("set_ups"))
    head = json.dumps(data, sort_keys=True, indent=1)[:-2]
    return f'{head},\n "set_ups": [\n  {lines}\n ]\n}}\n'


def read_record(path: Path) -> StudyRecord:
    """The record at ``path``: a file, or a result folder with its ``study.json``.

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
    check_version(data["record_version"], RECORD_VERSION, file, "a record", oldest=OLDEST_VERSION, again=AGAIN)
    if wrong := mistake_in(data):
        raise UserError(f"{file}: is damaged: {wrong}", fix=AGAIN)
    named = {field.name: data[field.name] for field in fields(StudyRecord) if field.name != "set_ups"}
    return StudyRecord(**named, set_ups=tuple(_set_up(one) for one in data["set_ups"]))


def _set_up_data(one: SetUpRecord) -> dict[str, Any]:
    data = {field.name: getattr(one, field.name) for field in fields(one)}
    data["threshold_mm"] = None if np.isnan(one.threshold_mm) else one.threshold_mm
    calibrated = {} if one.calibrated is None else {"calibrated": _columns(one.calibrated)}
    del data["calibrated"]
    return {**data, "inspected": _columns(one.inspected), "unflawed": _columns(one.unflawed), **calibrated}


def _columns(table: Inspected | Unflawed | Calibrated) -> dict[str, list[Any]]:
    there = {field.name: getattr(table, field.name) for field in fields(table)}
    columns = {name: column.tolist() for name, column in there.items() if column is not None}
    return {name: [None if value != value else value for value in column] for name, column in columns.items()}


def _set_up(data: Mapping[str, Any]) -> SetUpRecord:
    tables = ("inspected", "unflawed", "calibrated")
    plain = {f.name: data[f.name] for f in fields(SetUpRecord) if f.name not in tables}
    plain["threshold_mm"] = np.nan if plain["threshold_mm"] is None else plain["threshold_mm"]
    inspected = Inspected(**{name: _array(name, column) for name, column in data["inspected"].items()})
    unflawed = Unflawed(**{name: _array(name, column) for name, column in data["unflawed"].items()})
    columns = data.get("calibrated")
    calibrated = columns and Calibrated(**{name: _array(name, column) for name, column in columns.items()})
    return SetUpRecord(**plain, inspected=inspected, unflawed=unflawed, calibrated=calibrated)


def _array(name: str, column: list[Any]) -> np.ndarray:
    kinds: dict[str, Any] = {"board": int, "repeat": int, "calls": int, "no_return_calls": int, "hole": str}
    kind = bool if name in ("hit", "by_depth", "by_no_return") else kinds.get(name, float)
    return np.array([np.nan if value is None else value for value in column], kind)
