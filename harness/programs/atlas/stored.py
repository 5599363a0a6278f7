"""The stored atlas: a JSON file with a shard for each camera.

A shard states its camera's title, cameras of the same numbers (``twins``), noise, limits, what
they were computed with, and how precisely the camera's own noise is known."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from harness.programs.atlas.limits import Conditions, LimitSurface, PlaneNoise, SetUp
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, strict_json, write_text

STORED = "atlas.json"
"""The atlas that comes with tofpod, in baselines."""
VERSION = 1
"""Version of the file's layout."""
LEGAL = "a file that tofpod atlas writes"
NUMBERS = ("a90_mm", "low_mm", "high_mm", "smallest_mm", "largest_mm")
COLUMNS = (
    *("kind", "depth_mm", "distance_m", "albedo", "frames"),
    *NUMBERS,
    *("is_at_most", "hits", "is_check"),
)
"""Columns of a shard's rows; lengths are rounded to four digits."""


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
    """What it was computed with: commit, versions, digests, detector, contrast."""
    noise: PlaneNoise
    """The camera's noise."""
    set_ups: tuple[SetUp, ...]
    """The computed limits."""
    checks: tuple[SetUp, ...]
    """Limits that were kept aside from the fit."""

    def surfaces(self, kind: str, camera: str | None = None) -> list[LimitSurface]:
        """Return the surface of a kind of damage; none if the shard lacks it. ``camera``: the
        twin that it is shown as."""
        set_ups = tuple(set_up for set_up in self.set_ups if set_up.kind == kind)
        if not set_ups:
            return []
        name = camera or self.camera
        surface = LimitSurface(
            camera=name,
            title=self.titles[name],
            kind=kind,
            contrast_mm=float(self.about["contrast_mm"]),
            focal_px=float(self.about["focal_px"]),
            noise=self.noise,
            set_ups=set_ups,
            checks=tuple(check for check in self.checks if check.kind == kind),
        )
        return [surface]

    def to_data(self) -> dict[str, Any]:
        """Return the shard as plain data."""
        return {
            "titles": dict(self.titles),
            "warning": self.warning,
            "about": dict(self.about),
            "noise": {
                "distance_m": list(self.noise.distance_m),
                "albedo": list(self.noise.albedo),
                "frame_mm": _stored_numbers(self.noise.frame_mm),
                "fixed_mm": _stored_numbers(self.noise.fixed_mm),
            },
            "columns": list(COLUMNS),
            "rows": [
                *(_row(set_up, is_check=False) for set_up in self.set_ups),
                *(_row(set_up, is_check=True) for set_up in self.checks),
            ],
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
    except (OSError, ValueError, TypeError, KeyError, AttributeError, IndexError) as error:
        problem = f"{path}: cannot be read as an atlas: {error!r}"
        raise UserError(problem, legal=LEGAL) from error
    if not shards:
        raise UserError(f"{path}: has no camera", legal=LEGAL)
    return shards


def write_atlas(path: Path, shards: Sequence[CameraLimits]) -> None:
    """Write an atlas, a row of limits on each line."""
    cameras = []
    for shard in sorted(shards, key=lambda shard: shard.camera):
        data = shard.to_data()
        rows = ",\n".join(json.dumps(row, allow_nan=False) for row in data.pop("rows"))
        head = json.dumps(data, allow_nan=False, ensure_ascii=False, sort_keys=True)
        cameras.append(f'{json.dumps(shard.camera)}: {head[:-1]}, "rows": [\n{rows}]}}')
    body = ",\n".join(cameras)
    write_text(path, f'{{"version": {VERSION}, "cameras": {{\n{body}}}}}\n')


def shard_of(camera: str, data: Mapping[str, Any]) -> CameraLimits:
    """Return a shard from plain data. Raises ValueError, KeyError or TypeError if it is none."""
    titles = {str(name): str(title) for name, title in data["titles"].items()}
    about = dict(data["about"])
    for name in ("contrast_mm", "focal_px"):
        _above_0(name, about[name])
    if camera not in titles:
        raise ValueError(f"{camera}: it lacks its title")
    noise = data["noise"]
    distances_m = _ascending(noise["distance_m"])
    albedos = _ascending(noise["albedo"])
    shape = (len(distances_m), len(albedos))
    set_ups: list[SetUp] = []
    checks: list[SetUp] = []
    for values in data["rows"]:
        row = dict(zip(data["columns"], values, strict=True))
        (checks if row["is_check"] is True else set_ups).append(_set_up(row))
    return CameraLimits(
        camera=camera,
        titles=titles,
        warning=str(data["warning"]),
        about=about,
        noise=PlaneNoise(
            distance_m=distances_m,
            albedo=albedos,
            frame_mm=_numbers(noise["frame_mm"], shape),
            fixed_mm=_numbers(noise["fixed_mm"], shape),
        ),
        set_ups=tuple(set_ups),
        checks=tuple(checks),
    )


def _row(set_up: SetUp, *, is_check: bool) -> list[Any]:
    """Return the stored values of a set-up, in the order of `COLUMNS`."""
    values: dict[str, Any] = {
        "kind": set_up.kind,
        **vars(set_up.conditions),
        "is_at_most": set_up.is_at_most,
        "hits": set_up.hits,
        "is_check": is_check,
    }
    for name in NUMBERS:
        number = getattr(set_up, name)
        # the lower end of an interval may be 0, which has no logarithm: unknown
        values[name] = _stored_number(number) if number > 0 else None
    return [values[name] for name in COLUMNS]


def _set_up(row: Mapping[str, Any]) -> SetUp:
    """Return the set-up of a stored row. Raises ValueError or TypeError for odd values."""
    depth_mm = None if row["depth_mm"] is None else _above_0("depth_mm", row["depth_mm"])
    frames = row["frames"]
    hits = row["hits"]
    if type(frames) is not int or frames < 1 or type(hits) is not int or hits < 0:
        raise ValueError("frames or hits holds a value that is no count")
    if type(row["is_at_most"]) is not bool or not isinstance(row["kind"], str):
        raise TypeError("kind or is_at_most holds a value of another type")
    numbers = {}
    for name in NUMBERS:
        numbers[name] = math.nan if row[name] is None else _above_0(name, row[name])
    conditions = Conditions(
        distance_m=_above_0("distance_m", row["distance_m"]),
        albedo=_above_0("albedo", row["albedo"]),
        frames=frames,
        depth_mm=depth_mm,
    )
    return SetUp(
        kind=row["kind"], conditions=conditions, is_at_most=row["is_at_most"], hits=hits, **numbers
    )


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


def _numbers(rows: Any, shape: tuple[int, int]) -> np.ndarray:
    """Return a table (d, a) of stored numbers, NaN for None. Raises ValueError for odd ones."""
    table = np.array([[math.nan if v is None else float(v) for v in row] for row in rows])
    if table.shape != shape or (table < 0).any():
        raise ValueError("the table of noise has another shape, or negative numbers")
    return table


def _stored_numbers(table: np.ndarray) -> list[list[float | None]]:
    """Return a table of numbers as plain data, None for NaN."""
    return [[_stored_number(value) for value in row] for row in table]


def _stored_number(value: float) -> float | None:
    """Return a number with four digits, or None if it is not finite."""
    return float(f"{value:.4g}") if np.isfinite(value) else None
