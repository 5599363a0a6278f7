"""Tables of a unit's flat field: its captures, and figures that show how reliable it is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from harness.tables.schema import Column, Table
from harness.vocabulary.geometry import MM

FLAT_CAPTURES = Table(
    "flat_captures",
    "one row per capture of the flat surface",
    (
        Column("capture", "capture", "name", "name of the capture"),
        Column("frames", "frames", "frames", "number of averaged frames"),
        Column("distance_m", "distance (m)", "distance_m", "median distance along the optical axis"),
        Column("tilt_deg", "tilt (°)", "tilt_deg", "angle between the optical axis and the surface's normal"),
        Column("pixels", "pixels", "pixels", "number of pixels used"),
        Column("noise_mm", "noise (mm)", lambda row: row.noise_m / MM, "temporal noise of the averaged distance"),
        Column(
            "residual_mm",
            "residual (mm)",
            lambda row: float(np.sqrt(np.nanmean(row.residual_m**2))) / MM,
            "rms difference between the range and a smooth fit: pattern, shape and noise",
        ),
    ),
    formats=("csv",),
)

FLAT_FIGURES = Table(
    "flat_field",
    "one row per figure of the flat field",
    (
        Column("figure", "figure", note="name of the figure"),
        Column("unit", "unit", note="mm, or 1 for shares and correlations"),
        Column("value", "value", note="value; empty if the captures do not determine it"),
        Column("meaning", "meaning", note="meaning of the figure", brief=False),
    ),
    formats=("csv",),
    left=2,
)


def figures_of(found: Any) -> Iterator[dict[str, Any]]:
    """Yield the rows of `FLAT_FIGURES` for a `detectors.flat_captures.Separated`."""

    def row(figure: str, value: float | None, meaning: str, unit: str = "mm") -> dict[str, Any]:
        return {"figure": figure, "value": value, "unit": unit, "meaning": meaning}

    yield row("pattern", found.field.rms_m / MM, "rms of the unit's fixed pattern, corrected for the map's noise")
    yield row("noise of the map", found.noise_m / MM, "rms of the map's standard deviation")
    shape = "the surface's shape" if found.separated else "the surface's shape, or a part of the pattern that changes"
    yield row("between captures", found.surface_m / MM, f"deviation between captures beyond their noise: {shape}")
    for part, what in ((found.in_time, "first and last captures"), (found.in_range, "near and far captures")):
        excess, correlation = (None, None) if part is None else (part.excess_m / MM, part.correlation)
        yield row(f"change, {what}", excess, f"rms of the difference of the maps of {what} beyond their noise")
        yield row(f"correlation, {what}", correlation, f"correlation of the maps of {what}", "1")
