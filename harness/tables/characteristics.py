"""Tables of one's own camera: figures of its captures beside simulations, and the data of its page's diagrams."""

from __future__ import annotations

from dataclasses import dataclass

from harness.tables.schema import Column, Estimate, Table

NOT_SIMULATED = float("nan")


@dataclass(frozen=True)
class OwnFigure:
    """One figure: ``measured`` on captures, ``simulated`` from the camera file that they gave, and of the nearest
    ``known`` camera, NaN where there is none."""

    figure: str
    where: str
    unit: str
    measured: Estimate
    simulated: float
    known: float
    meaning: str

    @property
    def ratio(self) -> float:
        """Simulated by measured."""
        return self.simulated / self.measured.value if self.measured.value else NOT_SIMULATED

    @property
    def known_ratio(self) -> float:
        """The known camera's by measured."""
        return self.known / self.measured.value if self.measured.value else NOT_SIMULATED


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
        Column("meaning", "meaning", "meaning", "what the figure says", brief=False),
    ),
    formats=("csv",),
    left=3,
)  # fmt: skip

NOISE_CELLS = Table(
    "noise",
    "one row per cell of like range, angle and brightness",
    (
        Column("source", note="measured, simulated or known camera"),
        Column("capture", note="name of the capture"),
        Column("range_m", note="mean distance along the ray"),
        Column("angle_deg", note="mean angle of incidence on the surface"),
        Column("amplitude", note="mean amplitude in the recording's units, empty where not recorded"),
        Column("pixels", note="number of pixels"),
        Column("sigma_mm", note="temporal deviation along the ray, before rounding"),
    ),
    formats=("csv",),
)
CORRELATIONS = Table(
    "correlation",
    "one row per lag",
    (
        Column("source", note="measured, simulated or known camera"),
        Column("of", note="noise, or fixed pattern"),
        Column("axis", note="x along rows, y along columns"),
        Column("lag_px", note="pixels between the two"),
        Column("correlation", note="of pixels so far apart"),
    ),
    formats=("csv",),
)
OWN_FRAMES = Table(
    "frames",
    "one row per frame of one's own captures",
    (
        Column("capture", note="name of the capture"),
        Column("frame", note="number of the frame, from 0"),
        Column("displacement_mm", note="of the whole frame against the mean of all, along the optical axis"),
        Column("kept", note="whether the frame counts for the noise"),
    ),
    formats=("csv",),
)
DROPOUTS = Table(
    "dropouts",
    "one row per step of brightness",
    (
        Column("amplitude", note="mean amplitude in the recording's units, empty where not recorded"),
        Column("share", note="share of frames in which a pixel of a surface returns nothing"),
        Column("pixels", note="number of pixels"),
    ),
    formats=("csv",),
)
CERTIFIED = Table(
    "certificate",
    "one row per figure of a certificate",
    (
        Column("quantity", "quantity", note="what was measured"),
        Column("conditions", "conditions", note="capture, distance and angle, or frames"),
        Column("value", "value", note="with its unit"),
        Column("manner", "how", note="definition, and the standard in whose manner it is"),
        Column("share", "", note="measured or simulated"),
    ),
    formats=(),
    left=4,
)
