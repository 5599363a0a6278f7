"""Tables of a user's camera: its flat field, figures of its captures and of simulations, diagrams,
its certificate."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.records.schema import Column, Estimate, Table
from harness.vocabulary.geometry import MM

LEAST = {"mm": 0.01, "px": 0.05, "1": 0.05, "1/px": 0.01}
"""Measured values below these (by unit) are too small to divide by."""


@dataclass(frozen=True)
class OwnFigure:
    """A figure as measured, as simulated from the camera file, and for the nearest known camera
    (or NaN)."""

    figure: str
    where: str
    unit: str
    measured: Estimate
    simulated: float
    known: float
    meaning: str

    @property
    def ratio(self) -> float:
        """The simulated value divided by the measured value; NaN if the measured value is close to
        0."""
        return self._by_measured(self.simulated)

    @property
    def known_ratio(self) -> float:
        """The known camera's value divided by the measured value; NaN if the measured value is
        close to 0."""
        return self._by_measured(self.known)

    def _by_measured(self, value: float) -> float:
        measured = self.measured.value
        return value / measured if abs(measured) >= LEAST[self.unit] else float("nan")


OWN_FIGURES = Table(
    "characteristics",
    "one row per figure of the user's camera",
    (
        Column("figure", "figure", "figure", "name of the figure, as manufacturers use it"),
        Column("where", "where", "where", "surface, or direction and lag"),
        Column("unit", "unit", "unit", "mm, px or 1"),
        Column(
            "measured",
            "measured",
            "measured",
            "value in the captures, with 95 % interval if known",
            interval=True,
        ),
        Column(
            "simulated",
            "simulated",
            "simulated",
            "value in frames that are simulated from the camera file",
        ),
        Column("ratio", "ratio", "ratio", "simulated value divided by measured value"),
        Column(
            "known",
            "known camera",
            "known",
            "value of the nearest known camera, simulated with the same surfaces",
        ),
        Column(
            "known_ratio",
            "its ratio",
            "known_ratio",
            "known camera's value over measured value",
            brief=False,
        ),
        Column("meaning", "", "meaning", "meaning of the figure"),
    ),
    formats=("csv",),
    left=3,
)

OWN_CURVES = Table(
    "curves",
    "one row per point of a diagram of the user's camera",
    (
        Column("diagram", note="what y is, and what it is plotted against"),
        Column("source", note="measured, simulated or known camera"),
        Column("series", note="capture, or direction"),
        Column(
            "x",
            note="value on the x axis; the diagram decides whether m, degrees, amplitude, px, "
            "1/px or frames",
        ),
        Column(
            "y",
            note="value on the y axis; the diagram decides whether mm, share, correlation or "
            "density",
        ),
    ),
    formats=("csv",),
)
FLAT_SURFACES = Table(
    "surfaces",
    "one row per flat surface of a certificate",
    (
        Column("surface", "surface", note="capture, distance and angle of incidence"),
        Column(
            "temporal_mm",
            "temporal noise (mm)",
            note="temporal noise of single pixels",
            interval=True,
        ),
        Column(
            "frame_rms_mm",
            "plane-fit rms, one frame (mm)",
            note="rms distance of points from their own plane",
        ),
        Column("average_rms_mm", "average (mm)", note="the same for the average of all frames"),
        Column(
            "form95_mm",
            "dispersion, 95 % (mm)",
            note="width of the layer that holds 95 % of a frame's points",
        ),
        Column("form997_mm", "flatness, 99.7 % (mm)", note="width of the layer that holds 99.7 %"),
        Column("fill_rate", "fill rate", note="share of pixels and frames with a return"),
        Column(
            "lod95_1_mm",
            "LoD95, 1 frame (mm)",
            note="level of detection at 95 % of a pixel's z in 1 frame",
        ),
        Column("lod95_10_mm", "10 frames (mm)", note="the same for the average of 10 frames"),
        Column("lod95_50_mm", "50 frames (mm)", note="the same for the average of 50 frames"),
    ),
    formats=(),
)
CERTIFIED = Table(
    "certificate",
    "one row per figure of a certificate",
    (
        Column("quantity", "quantity", note="what was measured"),
        Column("conditions", "conditions", note="capture, distance and angle, or frames"),
        Column("value", "value", note="the value with its unit"),
        Column("manner", "how", note="definition, and the standard that it follows"),
    ),
    formats=(),
    left=4,
)

FLAT_CAPTURES = Table(
    "flat_captures",
    "one row per capture of the flat surface",
    (
        Column("capture", "capture", "name", "name of the capture"),
        Column("frames", "frames", "frames", "number of averaged frames"),
        Column(
            "distance_m", "distance (m)", "distance_m", "median distance along the optical axis"
        ),
        Column(
            "tilt_deg",
            "tilt (°)",
            "tilt_deg",
            "angle between the optical axis and the surface's normal",
        ),
        Column("pixels", "pixels", "pixels", "number of pixels used"),
        Column(
            "noise_mm",
            "noise (mm)",
            lambda row: row.noise_m / MM,
            "temporal noise of the averaged distance",
        ),
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


def figures_of(separated: Any) -> Iterator[dict[str, Any]]:
    """Yield the rows of `FLAT_FIGURES` for a `detectors.averages.flat_captures.Separated`."""

    def row(figure: str, value: float | None, meaning: str, unit: str = "mm") -> dict[str, Any]:
        return {"figure": figure, "value": value, "unit": unit, "meaning": meaning}

    yield row(
        "pattern",
        separated.field.rms_m / MM,
        "rms of the unit's fixed pattern, corrected for the map's noise",
    )
    yield row("noise of the map", separated.noise_m / MM, "rms of the map's standard deviation")
    shape = (
        "the surface's shape"
        if separated.separated
        else "the surface's shape, or a part of the pattern that changes"
    )
    yield row(
        "between captures",
        separated.surface_m / MM,
        f"deviation between captures beyond their noise: {shape}",
    )
    for part, compared in (
        (separated.in_time, "first and last captures"),
        (separated.in_range, "near and far captures"),
    ):
        excess, correlation = (
            (None, None) if part is None else (part.excess_m / MM, part.correlation)
        )
        yield row(
            f"change, {compared}",
            excess,
            f"rms of the difference of the maps of {compared} beyond their noise",
        )
        yield row(
            f"correlation, {compared}", correlation, f"correlation of the maps of {compared}", "1"
        )
