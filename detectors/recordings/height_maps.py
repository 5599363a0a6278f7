"""Height maps: an array of heights over a plane, its pixels a stated pitch apart, as a cloud in parallel projection.

A profiler's or a converter's map has no lens. x and y count from its middle, and z, which points away from the viewer,
is `DISTANCE_M` at the median height. Without a stated unit, micrometres, millimetres or metres are taken, whichever
gives the relief a plausible part of the map's extent.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from detectors.recordings.arrays import ArraysLoader, named_array
from detectors.recordings.distances import UNITS_M, refuse_narrow
from detectors.recordings.recording import Recording
from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.limits import refuse_pixels

HEIGHT_NAMES = ("height", "heights", "heightmap", "height_map", "elevation", "dem", "map", "h", "z")
DOWN_NAMES = ("depth", "distance", "range", "z_depth")
"""Names of arrays whose numbers grow away from the viewer."""
DISTANCE_M = 1.0
RELIEF = (5e-4, 0.5)
"""Plausible relief (1st to 99th percentile) over the map's shorter side. Its ends are a factor of 1000 apart, as the
units are, so that no two fit: 0.12 mm to 12 cm of a map 24 cm wide."""
LEGAL_PITCH = "the distance between pixels with its unit, for instance 0.5mm, 200um or 0.001m"


@dataclass(frozen=True)
class HeightReader:
    """The map as a frame. ``sign`` -1: heights grow towards the viewer."""

    path: Path
    load: ArraysLoader
    array: str | None
    pitch_m: float
    scale_m: float
    sign: float

    def frames(self) -> Iterator[Frame]:
        name, heights = _map_in(self.path, self.load, self.array)
        known = np.isfinite(heights)
        z_m = self.sign * self.scale_m * heights.astype(np.float64)
        z_m += DISTANCE_M - (np.median(z_m[known]) if known.any() else 0.0)
        z_m[~known] = np.nan
        v, u = np.mgrid[: heights.shape[0], : heights.shape[1]]
        xy_m = np.stack([u - (heights.shape[1] - 1) / 2, v - (heights.shape[0] - 1) / 2], axis=-1) * self.pitch_m
        xy_m[~known] = np.nan
        reason = np.where(known, Reason.VALID, Reason.NO_RETURN).astype(np.uint8)
        yield Frame(name, z_m.astype(np.float32), reason, xy_m=xy_m)


def open_height_map(path: Path, load: ArraysLoader, scale_m: float | None, pitch: str, array: str | None) -> Recording:
    """Open a height map. Raises UserError where the array is no single map, or its unit cannot be told."""
    pitch_m = _pitch_m(pitch)
    name, heights = _map_in(path, load, array)
    known = heights[np.isfinite(heights)].astype(np.float64)
    if known.size == 0:
        raise UserError(f"{name}: not one finite height", legal="numbers; NaN where there is none")
    relief = float(np.ptp(np.quantile(known, (0.01, 0.99))))
    side_m = min(heights.shape) * pitch_m
    if scale_m is None:
        scale_m = next(
            (UNITS_M[u] for u in ("mm", "m", "um") if RELIEF[0] <= relief * UNITS_M[u] / side_m < RELIEF[1]), None
        )
    if scale_m is None:
        raise UserError(
            f"{name}: nothing tells the unit of its heights: they span {relief:.4g} over {1e3 * side_m:.4g} mm",
            fix="state it: --unit mm, --unit m or --unit um",
        )
    is_down = name.rpartition(" ")[2].partition(":")[0].lower() in DOWN_NAMES
    sign = "grow away from the viewer, as its name says" if is_down else "grow towards the viewer: holes are low"
    height, width = heights.shape
    return Recording(
        name=path.name,
        reader=HeightReader(path, load, array, pitch_m, scale_m, 1.0 if is_down else -1.0),
        region=Region(0, height, 0, width),
        scale_m=scale_m,
        z_step_m=_step(known) * scale_m,
        files=(path,),
        projection="parallel",
        notes=(
            f"height map {name}: {width} x {height} pixels of {1e3 * pitch_m:.4g} mm; its numbers {sign}",
            f"the median height lies at z = {1e3 * DISTANCE_M:g} mm",
        ),
        unit_from=f"the map's relief, {relief:.4g} over {1e3 * side_m:.4g} mm (--unit states another)",
    )


def _map_in(path: Path, load: ArraysLoader, array: str | None) -> tuple[str, np.ndarray]:
    """The name and the map (h, w). Raises UserError for several maps, which are no frames of one capture."""
    name, values = named_array(str(path), load(path), (*HEIGHT_NAMES, *DOWN_NAMES), array)
    refuse_narrow(name, values.dtype)
    values = values[0] if values.ndim == 3 and values.shape[0] == 1 else values
    if values.ndim == 3:
        chosen = (array or "").partition(":")[0]
        raise UserError(
            f"{name}: {values.shape[0]} maps of {values.shape[2]} x {values.shape[1]} pixels",
            legal="one map: different maps are not averaged",
            fix=f"choose one by its number: --array {chosen}:0",
        )
    if values.ndim != 2 or min(values.shape) < 2:
        raise UserError(
            f"{name}: axes {values.shape} are no height map's", legal="(h, w), or (n, h, w) with --array NAME:NUMBER"
        )
    refuse_pixels(name, values.shape[1], values.shape[0])
    return name, values


def _pitch_m(text: str) -> float:
    match = re.fullmatch(r"(\d+(?:\.\d+)?(?:e-?\d+)?)\s*(um|mm|cm|m)", text.strip())
    value = float(match.group(1)) * UNITS_M[match.group(2)] if match else math.nan
    if not 1e-7 <= value <= 1:
        raise UserError(f"--pitch {text}: no such length", legal=LEGAL_PITCH)
    return value


def _step(values: np.ndarray) -> float:
    """The rounding step of stored heights: 1 of whole numbers, and of others 0, as of none."""
    return 1.0 if not (values % 1).any() else 0.0
