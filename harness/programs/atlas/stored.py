"""The stored atlas: a JSON file with a shard for each camera.

A shard states its camera's title, cameras of the same numbers (``twins``), noise, the law of each
kind of damage with the set-ups that it was fitted to, what they were computed with, what could not
be computed, and how precisely the camera's own noise is known."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from harness.programs.atlas.law import TERMS, Law
from harness.programs.atlas.limits import AXES, FailedSetUp, LimitSurface, PlaneNoise
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, strict_json, write_text

STORED = "atlas.json"
"""The atlas that comes with tofpod, in baselines."""
VERSION = 2
"""Version of the file's layout."""
LEGAL = "a file that tofpod atlas writes"
DIGITS = 6
"""Digits of stored coefficients and ranges; of all other numbers four."""
LARGEST = 1e4
"""Bound of stored coefficients and ranges; beyond it a file is no atlas."""
LARGEST_LOG = 20.0
"""Bound of logarithms of sizes in pixels."""
LEAST_EIGENVALUE = 1e-6
"""What rounding may take from the least eigenvalue of a covariance."""


@dataclass(frozen=True)
class SetUp:
    """The damages of a kind that were inspected in a set-up, and what the law of the other
    distances expects of them."""

    distance_m: float
    """Distance of the boards."""
    albedo: float
    """Of the boards."""
    backing_mm: float
    """Distance of the surface behind them."""
    frames: int
    """Number of averaged frames."""
    sites: int
    """Number of damages."""
    hits: int
    """Number found."""
    expected: float
    """Number that the law expects to be found."""
    log_signal: float
    """Difference of ln(signal / threshold) from the law."""
    deviation: float
    """Its standard error by these damages alone."""


SET_UP = tuple(SetUp.__annotations__)
"""Columns of the rows of set-ups."""


@dataclass(frozen=True)
class KindLimits:
    """The law of a kind of damage."""

    law: Law
    """The law."""
    set_ups: tuple[SetUp, ...]
    """What it was fitted to."""


@dataclass(frozen=True)
class CameraLimits:
    """The stored limits of one camera and of its twins."""

    camera: str
    """Name of the camera."""
    titles: Mapping[str, str]
    """Titles by name, of the camera first and then of its twins."""
    warning: str
    """How uncertain the camera's own noise is; empty if it is measured."""
    about: Mapping[str, Any]
    """What it was computed with: commit, versions, digests, detector, boards."""
    problems: tuple[str, ...]
    """What could not be computed, and why."""
    failed: tuple[FailedSetUp, ...]
    """Set-ups in which nothing could be judged."""
    noise: PlaneNoise
    """The camera's noise."""
    kinds: Mapping[str, KindLimits]
    """The law of each kind of damage."""

    def surfaces(self, kind: str, camera: str | None = None) -> list[LimitSurface]:
        """Return the surface of a kind of damage; none if the shard lacks it. ``camera``: the
        twin that it is shown as."""
        if kind not in self.kinds:
            return []
        name = camera or self.camera
        surface = LimitSurface(
            camera=name,
            title=self.titles[name],
            kind=kind,
            thickness_mm=float(self.about["thickness_mm"]),
            focal_px=float(self.about["focal_px"]),
            noise=self.noise,
            law=self.kinds[kind].law,
            failed=self.failed,
            sites=sum(set_up.sites for set_up in self.kinds[kind].set_ups),
            hits=sum(set_up.hits for set_up in self.kinds[kind].set_ups),
        )
        return [surface]

    def to_data(self) -> dict[str, Any]:
        """Return the shard as plain data."""
        return {
            "titles": dict(self.titles),
            "warning": self.warning,
            "about": dict(self.about),
            "problems": list(self.problems),
            "failed": [list(vars(set_up).values()) for set_up in self.failed],
            "noise": {
                "distance_m": list(self.noise.distance_m),
                "albedo": list(self.noise.albedo),
                "frame_mm": _stored_numbers(self.noise.frame_mm),
                "fixed_mm": _stored_numbers(self.noise.fixed_mm),
            },
            "columns": list(SET_UP),
            "kinds": {kind: _kind_data(limits) for kind, limits in self.kinds.items()},
        }


def _kind_data(limits: KindLimits) -> dict[str, Any]:
    """Return the law of a kind of damage and its set-ups as plain data."""
    law = limits.law
    ranges = {}
    for name, ends in law.ranges.items():
        ranges[name] = [_stored_number(end, DIGITS) for end in ends]
    return {
        "coefficients": [_stored_number(value, DIGITS) for value in law.coefficients],
        "covariance": [[_stored_number(value, DIGITS) for value in row] for row in law.covariance],
        "scatter": _stored_number(law.scatter),
        "error": _stored_number(law.error),
        "degrees": law.degrees,
        "ranges": ranges,
        "rows": [_row(set_up) for set_up in limits.set_ups],
    }


def read_atlas(path: Path) -> list[CameraLimits]:
    """Return the shards of an atlas. Raises UserError if the file is none."""
    if not path.is_file():
        raise UserError(f"{path}: there is no such atlas", legal=LEGAL, fix="run tofpod atlas")
    try:
        data = strict_json(bounded_bytes(path, TEXT_BYTES))
        if data["version"] != VERSION:
            raise ValueError(f"its version is {data['version']!r}, not {VERSION}")
        shards = [shard_of(camera, stored) for camera, stored in data["cameras"].items()]
    except (OSError, ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:
        problem = f"{path}: cannot be read as an atlas: {error!r}"
        raise UserError(problem, legal=LEGAL) from error
    if not shards:
        raise UserError(f"{path}: has no camera", legal=LEGAL)
    return shards


def write_atlas(path: Path, shards: Sequence[CameraLimits]) -> None:
    """Write an atlas, a kind of damage of each camera on a line."""
    cameras = []
    for shard in sorted(shards, key=lambda shard: shard.camera):
        data = shard.to_data()
        kinds = []
        for kind, limits in data.pop("kinds").items():
            kinds.append(f"{json.dumps(kind)}: {json.dumps(limits, allow_nan=False)}")
        rows = ",\n".join(kinds)
        head = json.dumps(data, allow_nan=False, ensure_ascii=False, sort_keys=True)
        cameras.append(f'{json.dumps(shard.camera)}: {head[:-1]}, "kinds": {{\n{rows}}}}}')
    body = ",\n".join(cameras)
    write_text(path, f'{{"version": {VERSION}, "cameras": {{\n{body}}}}}\n')


def shard_of(camera: str, data: Mapping[str, Any]) -> CameraLimits:
    """Return a shard from plain data. Raises ValueError, KeyError or TypeError if it is none."""
    titles = {str(name): str(title) for name, title in data["titles"].items()}
    about = dict(data["about"])
    for name in ("thickness_mm", "focal_px"):
        _above_0(name, about[name])
    if camera not in titles:
        raise ValueError(f"{camera}: it lacks its title")
    noise = data["noise"]
    distances_m = _ascending(noise["distance_m"])
    albedos = _ascending(noise["albedo"])
    shape = (len(distances_m), len(albedos))
    kinds = {}
    for kind, limits in data["kinds"].items():
        kinds[str(kind)] = _kind_of(data["columns"], limits)
    return CameraLimits(
        camera=camera,
        titles=titles,
        warning=str(data["warning"]),
        about=about,
        problems=tuple(str(problem) for problem in data["problems"]),
        failed=tuple(_failed_of(values) for values in data["failed"]),
        noise=PlaneNoise(
            distance_m=distances_m,
            albedo=albedos,
            frame_mm=_not_negative("noise", noise["frame_mm"], shape),
            fixed_mm=_not_negative("noise", noise["fixed_mm"], shape),
        ),
        kinds=kinds,
    )


def _failed_of(values: Sequence[Any]) -> FailedSetUp:
    """Return a set-up that failed. Raises ValueError for odd values."""
    distance_m, albedo, frames = values
    return FailedSetUp(
        distance_m=_above_0("failed", distance_m),
        albedo=_above_0("failed", albedo),
        frames=int(_above_0("failed", frames)),
    )


def _kind_of(columns: Sequence[str], data: Mapping[str, Any]) -> KindLimits:
    """Return the law of a kind of damage from plain data. Raises ValueError, KeyError or
    TypeError if it is none."""
    count = len(TERMS)
    ranges = {}
    for name in (*AXES, "x", "log_size_px"):
        low, high = (float(end) for end in data["ranges"][name])
        if not -LARGEST < low <= high < LARGEST:
            raise ValueError(f"the range of {name} does not ascend")
        ranges[name] = (low, high)
    if not -LARGEST_LOG < ranges["log_size_px"][0] < ranges["log_size_px"][1] < LARGEST_LOG:
        raise ValueError("the range of log_size_px does not ascend, or is no logarithm of pixels")
    degrees = data["degrees"]
    if type(degrees) is not int or degrees < 1:
        raise ValueError(f"degrees holds {degrees!r}, which is no count")
    coefficients = _table("coefficients", [data["coefficients"]], (1, count))[0]
    covariance = _table("covariance", data["covariance"], (count, count))
    for numbers in (coefficients, covariance):
        if not (np.abs(numbers) < LARGEST).all():
            raise ValueError("the law has unknown or huge coefficients")
    if np.linalg.eigvalsh(covariance).min() < -LEAST_EIGENVALUE:
        raise ValueError("the covariance is none")
    law = Law(
        coefficients=coefficients,
        covariance=covariance,
        scatter=_above_0("scatter", data["scatter"]),
        error=math.nan if data["error"] is None else _above_or_0("error", data["error"]),
        degrees=degrees,
        ranges=ranges,
    )
    set_ups = []
    for values in data["rows"]:
        set_ups.append(_set_up(dict(zip(columns, values, strict=True))))
    return KindLimits(law, tuple(set_ups))


def _set_up(row: Mapping[str, Any]) -> SetUp:
    """Return the set-up of a stored row. Raises ValueError for odd values."""
    for name in ("frames", "sites", "hits"):
        if type(row[name]) is not int or row[name] < 0:
            raise ValueError(f"{name} holds {row[name]!r}, which is no count")
    return SetUp(
        distance_m=_above_0("distance_m", row["distance_m"]),
        albedo=_above_0("albedo", row["albedo"]),
        backing_mm=_above_0("backing_mm", row["backing_mm"]),
        frames=row["frames"],
        sites=row["sites"],
        hits=row["hits"],
        expected=_above_or_0("expected", row["expected"]),
        log_signal=float(row["log_signal"]),
        deviation=_above_0("deviation", row["deviation"]),
    )


def _row(set_up: SetUp) -> list[Any]:
    """Return the stored values of a set-up, in the order of `SET_UP`."""
    values = []
    for value in vars(set_up).values():
        values.append(value if isinstance(value, int) else _stored_number(value))
    return values


def _above_0(name: str, value: Any) -> float:
    """Return a number above 0. Raises ValueError for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise ValueError(f"{name} holds {value!r}, which is no number above 0")
    return float(value)


def _ascending(values: Any) -> tuple[float, ...]:
    """Return ascending numbers above 0. Raises ValueError for others."""
    numbers = tuple(_above_0("noise", value) for value in values)
    if not numbers or any(above <= below for below, above in pairwise(numbers)):
        raise ValueError("the nodes of the noise do not ascend")
    return numbers


def _above_or_0(name: str, value: Any) -> float:
    """Return a number of 0 or more. Raises ValueError for any other value."""
    return 0.0 if value == 0 and not isinstance(value, bool) else _above_0(name, value)


def _not_negative(name: str, rows: Any, shape: tuple[int, int]) -> np.ndarray:
    """Return a table of numbers of 0 or more, NaN for None. Raises ValueError for odd ones."""
    table = _table(name, rows, shape)
    if (table < 0).any():
        raise ValueError(f"the table of {name} has negative numbers")
    return table


def _table(name: str, rows: Any, shape: tuple[int, int]) -> np.ndarray:
    """Return a table of stored numbers, NaN for None. Raises ValueError for another shape."""
    table = np.array([[math.nan if v is None else float(v) for v in row] for row in rows])
    if table.shape != shape:
        raise ValueError(f"the table of {name} has another shape")
    return table


def _stored_numbers(table: np.ndarray) -> list[list[float | None]]:
    """Return a table of numbers as plain data, None for NaN."""
    return [[_stored_number(value) for value in row] for row in table]


def _stored_number(value: float, digits: int = 4) -> float | None:
    """Return a number with so many digits, or None if it is not finite."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None
