"""The rows that trials record: each column of a raw table is one field of one class here.

A field is annotated with its type and with the column's note, or with a `Column` that has a label
too; the unit is the ending of the field's name. `harness.records.trials` derives the tables from
these classes (`harness.records.schema.declared_columns`). A field that is None has no entry in the
journal's record.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Role = Literal["learning", "calibration", "hole_free", "damaged"]
"""Purpose of a board: to learn from, to set a threshold (only in a study), to count false calls,
or to be inspected."""

PointDigest = Annotated[str, "digest of the set-up with its number of frames"]
Variant = Annotated[str, "name of the set-up"]
Frames = Annotated[int, "number of averaged frames"]
Repeat = Annotated[int, "draw of the noise and unit"]
BoardNumber = Annotated[int | None, "number of the board in a study"]
BoardRole = Annotated[Role, "role of the board: damaged, hole_free or calibration"]
NAN = float("nan")
TrueDiameter = Annotated[float, "true diameter"]
TrueDepth = Annotated[float, "true depth of removed material"]
TrueX = Annotated[float, "x of its centre on the board"]
TrueY = Annotated[float, "y of its centre on the board"]


@dataclass(frozen=True, kw_only=True)
class Origin:
    """The trial and the point that a row comes from."""

    variant: Variant
    frames: Frames
    repeat: Repeat
    board: BoardNumber = None


@dataclass(frozen=True, kw_only=True)
class RunRow:
    """One trial of one point."""

    point: PointDigest
    origin: Origin
    role: BoardRole
    threshold: Annotated[float, "threshold in use; empty in calibration runs"]
    quiet_threshold: Annotated[float, "hole-free boards: score above which nothing is found"]
    peaks: Annotated[
        list[float],
        "in a study's calibration: scores of the strongest findings, highest first; else empty",
    ] = field(default_factory=list)
    scale_mm: Annotated[float, "residual per unit of score"]
    surface_noise_mm: Annotated[
        float, "robust deviation from the fitted surface on the undamaged face"
    ]
    frames_used: Annotated[int, "number of frames in the average"]
    left_out: Annotated[int, "number of frames left out as disturbed"]
    exposure_share: Annotated[
        float | None,
        "mean exposure time that the camera chose for its pixels, over its longest; empty for "
        "real frames",
    ] = None
    detections: Annotated[int, "number of findings"]
    false_calls: Annotated[int, "number of findings that match no damage"]
    inspected_m2: Annotated[float | None, "in a study: judged area of the face"] = None
    no_return_calls: Annotated[
        int | None,
        "in a study: false calls that consist of pixels without a return",
    ] = None
    loudest_x_mm: Annotated[float | None, "calibration: x of the highest score on the board"] = None
    loudest_y_mm: Annotated[float | None, "calibration: y of the highest score on the board"] = None
    loudest_u_px: Annotated[
        float | None, "calibration: column of the highest score on the sensor"
    ] = None
    loudest_v_px: Annotated[float | None, "calibration: row of the highest score on the sensor"] = (
        None
    )
    views_used: Annotated[int | None, "maps: number of merged views"] = None
    views_left_out: Annotated[
        int | None,
        "maps: number of views left out because their registration failed",
    ] = None
    seconds_map: Annotated[float | None, "maps: time to make the map"] = None
    seconds_frames: Annotated[float, "time to simulate and average the frames"]
    seconds_detect: Annotated[float, "time to detect and measure"]


@dataclass(frozen=True, kw_only=True)
class DamageRow:
    """One damage of a damaged board in one trial of one point. What is measured is NaN if it was
    not found."""

    point: PointDigest
    origin: Origin
    hole: Annotated[str, "number of the damage"]
    kind: Annotated[str, "kind of damage"]
    true_diameter_mm: TrueDiameter
    true_depth_mm: TrueDepth
    seen_depth_mm: Annotated[
        float,
        "depth of the surface that is visible in the damage; for a through-hole, of the backing",
    ]
    true_x_mm: TrueX
    true_y_mm: TrueY
    true_offset_mm: Annotated[float, "distance of its centre from the centre of the largest hole"]
    size_of: Annotated[
        str,
        "what true_diameter_mm is: the diameter or, for long damage, the width or length",
    ]
    true_length_mm: Annotated[float, "true length; empty for holes and ball dents"]
    true_width_mm: Annotated[float, "true width; empty for holes and ball dents"]
    true_angle_deg: Annotated[float, "angle from the board's x axis to its length"]
    detected: Annotated[bool, "whether it was hit, which means that a finding matches it"]
    threshold: Annotated[float, "threshold in use, in the detector's units"]
    invalid_fraction: Annotated[float, "share of its pixels without a range"]
    median_residual_mm: Annotated[float, "median distance of its pixels behind the surface"]
    state: Annotated[
        str,
        "state of its pixels, independent of the detector: found, wrong depth, invalid or "
        "invisible",
    ]
    score: Annotated[float, "score of the finding that matches it"] = NAN
    points: Annotated[int, "number of points of that finding"] = 0
    signal: Annotated[float, "highest score within the hit radius; empty if none is judged"] = NAN
    no_return: Annotated[
        bool | None,
        "in a study: whether a finding of pixels without a return matches it",
    ] = None
    extent_diameter_mm: Annotated[float, "measured diameter (the thesis' measure)"] = NAN
    extent_offset_mm: Annotated[
        float,
        "distance of its centre from the largest cluster's (the thesis' measure)",
    ] = NAN
    extent_error_mm: Annotated[
        float,
        "distance of its centre from the true centre (the thesis' measure)",
    ] = NAN
    model_diameter_mm: Annotated[
        float, "measured diameter (the fitted model of a blurred hole)"
    ] = NAN
    model_diameter_se_mm: Annotated[
        float, "standard error of that diameter, as the fit estimates it"
    ] = NAN
    model_depth_mm: Annotated[float, "measured depth (the model)"] = NAN
    model_depth_se_mm: Annotated[float, "standard error of that depth, as the fit estimates it"] = (
        NAN
    )
    model_offset_mm: Annotated[
        float, "distance of its centre from the largest cluster's (the model)"
    ] = NAN
    model_error_mm: Annotated[float, "distance of its centre from the true centre (the model)"] = (
        NAN
    )
    length_mm: Annotated[
        float,
        "length of the rectangle with the second moments of the residual, corrected for blur",
    ] = NAN
    width_mm: Annotated[float, "width of that rectangle"] = NAN
    angle_deg: Annotated[
        float, "angle from the board's x axis to that rectangle's length, -90 to 90"
    ] = NAN
    model_note: Annotated[str, "remark of the fit about its result"] = ""


@dataclass(frozen=True, kw_only=True)
class ProbesRow:
    """Errors of z of the sample pixels in one hole-free trial of one point. `ProbeRow` is their
    statistics over repeats."""

    variant: Variant
    frames: Frames
    repeat: Repeat
    error_tenth_um: Annotated[
        list[int | None],
        "error of z of each pixel in tenths of a micrometre; None without a range",
    ]


@dataclass(frozen=True, kw_only=True)
class ProbeRow:
    """Errors of z of one sample pixel over the hole-free repeats of one point."""

    variant: Variant
    frames: Frames
    pixel: Annotated[int, "number of the pixel, in sensor order"]
    mean_error_mm: Annotated[float, "mean error of z"]
    temporal_std_mm: Annotated[float, "standard deviation of z over repeats"]
    displacement_std_mm: Annotated[
        float,
        "standard deviation of whole clouds' displacement, which the other columns exclude",
    ]
    repeats: Annotated[int, "number of repeats"]


Correlation = Annotated[
    float,
    "correlation of that noise between pixels n columns (u) or rows (v) apart",
]


@dataclass(frozen=True, kw_only=True)
class NoiseRow:
    """Noise and pixels of one hole-free trial of a single view of an undamaged board."""

    variant: Variant
    frames: Frames
    repeat: Repeat
    valid_share: Annotated[float, "share of the board's pixels with a range"]
    pitch_u_mm: Annotated[
        float,
        "median distance on the board between neighbouring pixels of a row",
    ]
    pitch_v_mm: Annotated[
        float,
        "median distance on the board between neighbouring pixels of a column",
    ]
    single_frame_mm: Annotated[float, "standard deviation of one frame's temporal noise of z"]
    correlation_u1: Correlation
    correlation_u2: Correlation
    correlation_u3: Correlation
    correlation_v1: Correlation
    correlation_v2: Correlation
    correlation_v3: Correlation


@dataclass(frozen=True, kw_only=True)
class RegistrationRow:
    """The registration of one view of a map."""

    origin: Origin
    role: BoardRole
    view: Annotated[int, "number of the view; the reference is 0"]
    method: Annotated[str, "method of registration"]
    tre_mm: Annotated[float, "target registration error, root mean square over the board"]
    tre_in_plane_mm: Annotated[float, "part of that error in the board's plane"]
    tre_across_mm: Annotated[float, "part of that error perpendicular to the plane"]
    predicted_in_plane_mm: Annotated[
        float, "predicted error in the plane; empty if the method predicts none"
    ]
    predicted_across_mm: Annotated[float, "predicted error perpendicular to the plane"]
    guess_tre_mm: Annotated[float, "error of the nominal pose from which it started"]
    residual_mm: Annotated[float, "root mean square residual"]
    overlap: Annotated[float, "share of points with a partner"]
    pairs: Annotated[int, "number of pairs of points"]
    marks: Annotated[int, "number of marks that were used"]
    iterations: Annotated[int, "number of iterations"]
    converged: Annotated[bool, "whether it converged"]
    seconds: Annotated[float, "time in seconds"]
    failure: Annotated[str, "reason for a failure; empty if it succeeded"]


@dataclass(frozen=True, kw_only=True)
class SiteRow:
    """A place on a hole-free board of a study from which the damage was left out."""

    origin: Origin
    role: BoardRole
    hole: Annotated[str, "number of the place"]
    true_diameter_mm: TrueDiameter
    true_depth_mm: TrueDepth
    true_x_mm: TrueX
    true_y_mm: TrueY
    detected: Annotated[bool, "whether a finding lies there by chance"]
    signal: Annotated[float, "highest score within the hit radius"]


@dataclass(frozen=True, kw_only=True)
class FindingRow:
    """A finding on a board of a study."""

    origin: Origin
    role: BoardRole
    x_mm: Annotated[float, "x on the board"]
    y_mm: Annotated[float, "y on the board"]
    score: Annotated[float, "score"]
    hole: Annotated[str, "damage that it hits; empty: none"]


@dataclass(frozen=True, kw_only=True)
class OperatingRow:
    """Findings and hits of one trial of a study at each threshold of a grid."""

    origin: Origin
    role: BoardRole
    threshold: Annotated[list[float], "threshold"]
    findings: Annotated[list[int], "findings above it"]
    hits: Annotated[list[int], "hits among them"]


@dataclass(frozen=True, kw_only=True)
class PixelsRow:
    """Pixels of one damage of a study, or of the intact face, above each threshold of a grid."""

    origin: Origin
    role: BoardRole
    hole: Annotated[str, "damage; empty: intact face"]
    pixels: Annotated[int, "judged pixels"]
    threshold: Annotated[list[float], "threshold"]
    above: Annotated[list[int], "above it"]


@dataclass
class TrialRecord:
    """The rows that a trial recorded for all its points, by table."""

    runs: list[RunRow] = field(default_factory=list)
    """One row for each point."""
    holes: list[DamageRow] = field(default_factory=list)
    """One row for each point and damage of a damaged board."""
    probes: list[ProbesRow] = field(default_factory=list)
    """One row for each point of a hole-free board, outside studies."""
    noise: list[NoiseRow] = field(default_factory=list)
    """One row for each point of a single view of a hole-free board, outside studies."""
    registrations: list[RegistrationRow] = field(default_factory=list)
    """One row for each registered view of each map."""
    sites: list[SiteRow] = field(default_factory=list)
    """One row for each point and place of a hole-free board, in a study."""
    findings: list[FindingRow] = field(default_factory=list)
    """One row for each finding of each point, in a study."""
    operating: list[OperatingRow] = field(default_factory=list)
    """One row for each point that has a threshold, in a study."""
    pixels: list[PixelsRow] = field(default_factory=list)
    """One row for each point and damage, and one for the intact face, in a study."""

    def to_data(self) -> dict[str, list[dict[str, Any]]]:
        """Return the rows as mappings, by table: the record's form in the journal."""
        data = {}
        for table in fields(self):
            rows = getattr(self, table.name)
            data[table.name] = [row_data(row) for row in rows]
        return data


def row_data(row: DataclassInstance) -> dict[str, Any]:
    """Return a row as a mapping from its columns to their values, without fields that are None."""
    data: dict[str, Any] = {}
    for column in fields(row):
        value = getattr(row, column.name)
        if is_dataclass(value) and not isinstance(value, type):
            data.update(row_data(value))
        elif value is not None:
            data[column.name] = value
    return data
