"""Tables of one's own camera: figures of its captures beside simulations, its diagrams' points, its certificate."""

from __future__ import annotations

from dataclasses import dataclass

from harness.tables.schema import Column, Estimate, Table

LEAST = {"mm": 0.01, "px": 0.05, "1": 0.05, "1/px": 0.01}
"""Measured values below these, by unit, are as good as none: a ratio to them says nothing."""


@dataclass(frozen=True)
class OwnFigure:
    """One figure: ``measured``, ``simulated`` from the camera file, of the nearest ``known`` camera; NaN without."""

    figure: str
    where: str
    unit: str
    measured: Estimate
    simulated: float
    known: float
    meaning: str

    @property
    def ratio(self) -> float:
        """Simulated by measured; NaN where next to nothing is measured."""
        return self._by_measured(self.simulated)

    @property
    def known_ratio(self) -> float:
        """The known camera's by measured, likewise."""
        return self._by_measured(self.known)

    def _by_measured(self, value: float) -> float:
        measured = self.measured.value
        return value / measured if abs(measured) >= LEAST[self.unit] else float("nan")


OWN_FIGURES = Table(
    "characteristics",
    "one row per figure of one's own camera",
    (
        Column("figure", "figure", "figure", "name of the figure, as makers name it"),
        Column("where", "where", "where", "surface, or direction and lag"),
        Column("unit", "unit", "unit", "mm, px or 1"),
        Column("measured", "measured", "measured", "of the captures, with its 95 % interval where told", interval=True),
        Column("simulated", "simulated", "simulated", "of frames simulated from the camera file, analysed alike"),
        Column("ratio", "ratio", "ratio", "simulated by measured"),
        Column("known", "known camera", "known", "of the nearest known camera, simulated before the same surfaces"),
        Column("known_ratio", "its ratio", "known_ratio", "known camera's by measured", brief=False),
        Column("meaning", "", "meaning", "what the figure says"),
    ),
    formats=("csv",),
    left=3,
)  # fmt: skip

OWN_CURVES = Table(
    "curves",
    "one row per point of a diagram of one's own camera",
    (
        Column("diagram", note="what y is, and against what"),
        Column("source", note="measured, simulated or known camera"),
        Column("series", note="capture, or direction"),
        Column("x", note="m, degrees, amplitude, pixels, cycles per pixel or number of the frame, by the diagram"),
        Column("y", note="mm, share, correlation or density, by the diagram"),
    ),
    formats=("csv",),
)
FLAT_SURFACES = Table(
    "surfaces",
    "one row per flat surface of a certificate",
    (
        Column("surface", "surface", note="capture, distance and angle of incidence"),
        Column("temporal_mm", "temporal noise (mm)", note="of single pixels", interval=True),
        Column("frame_rms_mm", "plane-fit rms, one frame (mm)", note="of points about their own plane"),
        Column("average_rms_mm", "average (mm)", note="the same of the average of all frames"),
        Column("form95_mm", "dispersion, 95 % (mm)", note="width that so many of a frame's points need"),
        Column("form997_mm", "flatness, 99.7 % (mm)", note="likewise"),
        Column("fill_rate", "fill rate", note="share of pixels and frames with a return"),
        Column("lod95_1_mm", "LoD95, 1 frame (mm)", note="level of detection of one pixel's z"),
        Column("lod95_10_mm", "10 frames (mm)", note="likewise"),
        Column("lod95_50_mm", "50 frames (mm)", note="likewise"),
    ),
    formats=(),
)
CERTIFIED = Table(
    "certificate",
    "one row per figure of a certificate",
    (
        Column("quantity", "quantity", note="what was measured"),
        Column("conditions", "conditions", note="capture, distance and angle, or frames"),
        Column("value", "value", note="with its unit"),
        Column("manner", "how", note="definition, and the standard in whose manner it is"),
    ),
    formats=(),
    left=4,
)
