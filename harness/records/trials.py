"""Tables of trials: the measurements of each trial, and summaries of experiments that are not
studies.

Columns declare only a name and a note; their values come from `harness.trials.trial` and
`harness.evaluation`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from harness.records import outputs
from harness.records.schema import Column, Table
from harness.vocabulary import text
from harness.vocabulary.path_names import in_words
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.text import Cell, Tone

if TYPE_CHECKING:
    import pandas as pd


def _columns(**notes: str) -> tuple[Column, ...]:
    return tuple(Column(name, note=note) for name, note in notes.items())


def _fine(value: float | None) -> str:
    return text.UNKNOWN_TEXT if value is None else text.mm(value, 3)


def _percent(share: float | None) -> str:
    return text.UNKNOWN_TEXT if share is None or math.isnan(share) else f"{100 * share:.0f} %"


def _word(name: str | None) -> str:
    return name or "as declared"


COMMON = _columns(
    variant="name of the set-up",
    frames="number of averaged frames",
    repeat="draw of the noise and unit",
)
BOARD = _columns(board="number of the board in a study")
POINT = _columns(point="digest of the set-up with its number of frames")
ROLE = _columns(role="role of the board: damaged, hole_free or calibration")
TRUTH = _columns(
    kind="kind of damage",
    true_diameter_mm="true diameter",
    true_depth_mm="true depth of removed material",
    seen_depth_mm="depth of the surface that is visible in the damage; for a through-hole, of the backing",
    true_x_mm="x of its centre on the board",
    true_y_mm="y of its centre on the board",
    true_offset_mm="distance of its centre from the centre of the largest hole",
)
SHAPE = _columns(
    size_of="what true_diameter_mm is: the diameter or, for long damage, the width or length",
    true_length_mm="true length; empty for holes and ball dents",
    true_width_mm="true width; empty for holes and ball dents",
    true_angle_deg="angle from the board's x axis to its length",
)
SIZES = _columns(
    extent_diameter_mm="measured diameter (the thesis' measure)",
    extent_offset_mm="distance of its centre from the largest cluster's (the thesis' measure)",
    extent_error_mm="distance of its centre from the true centre (the thesis' measure)",
    model_diameter_mm="measured diameter (the fitted model of a blurred hole)",
    model_diameter_se_mm="standard error of that diameter, as the fit estimates it",
    model_depth_mm="measured depth (the model)",
    model_depth_se_mm="standard error of that depth, as the fit estimates it",
    model_offset_mm="distance of its centre from the largest cluster's (the model)",
    model_error_mm="distance of its centre from the true centre (the model)",
    length_mm="length of the rectangle with the second moments of the residual, corrected for blur",
    width_mm="width of that rectangle",
    angle_deg="angle from the board's x axis to that rectangle's length, -90 to 90",
    model_note="remark of the fit about its result",
)
STATISTICS = {
    "measured": "number of trials with a finite diameter",
    "diameter_mean_mm": "mean diameter",
    "diameter_std_mm": "standard deviation of the diameter",
    "offset_mean_mm": "mean distance from the largest hole",
    "offset_std_mm": "standard deviation of that distance",
    "offset_bias_mm": "mean distance minus true distance",
}
BY = (("extent", "the thesis' measure"), ("model", "the model"))
ERRORS = {
    "extent": "size, extent (mm)",
    "model": "size, model (mm)",
    "extent_place": "position, extent (mm)",
    "model_place": "position, model (mm)",
}
COVERED = "share of fits that lie within 1.96 of their own standard errors of the truth"
MARKS: dict[str, tuple[str, Tone]] = {
    "borne out": ("✓", "good"),
    "not borne out": ("✗", "bad"),
    "undecided": ("?", "open"),
}
PITCH = ("pitch_u_mm", "pitch_v_mm")
LAGS = tuple(f"correlation_{way}{lag}" for way in "uv" for lag in (1, 2, 3))

TRIALS = Table(
    "trials",
    "one row per trial on a damaged board and damage",
    (
        *(*POINT, *COMMON, *BOARD, *_columns(hole="number of the damage"), *TRUTH, *SHAPE),
        *_columns(
            detected="whether it was hit, which means that a finding matches it",
            threshold="threshold in use, in the detector's units",
            invalid_fraction="share of its pixels without a range",
            median_residual_mm="median distance of its pixels behind the surface",
            state="state of its pixels, independent of the detector: found, wrong depth, invalid or invisible",
            score="score of the finding that matches it",
            points="number of points of that finding",
            signal="in a study: highest score within the hit radius",
            no_return="in a study: whether a finding of pixels without a return matches it",
        ),
        *SIZES,
    ),
    ("variant", "frames", "board", "repeat", "true_diameter_mm", "hole"),
    ("parquet",),
    always=True,
)
RUNS = Table(
    "runs",
    "one row per trial",
    (
        *(*POINT, *COMMON, *BOARD, *ROLE),
        *_columns(
            threshold="threshold in use; empty in calibration runs",
            quiet_threshold="hole-free boards: score above which nothing is found",
            scale_mm="residual per unit of score",
            surface_noise_mm="robust deviation from the fitted surface on the undamaged face",
            frames_used="number of frames in the average",
            left_out="number of frames left out as disturbed",
            detections="number of findings",
            false_calls="number of findings that match no damage",
            inspected_m2="in a study: judged area of the face",
            no_return_calls="in a study: false calls that consist of pixels without a return",
            loudest_x_mm="calibration: x of the highest score on the board",
            loudest_y_mm="calibration: y of the highest score on the board",
            loudest_u_px="calibration: column of the highest score on the sensor",
            loudest_v_px="calibration: row of the highest score on the sensor",
            views_used="maps: number of merged views",
            views_left_out="maps: number of views left out because their registration failed",
            seconds_map="maps: time to make the map",
            seconds_frames="time to simulate and average the frames",
            seconds_detect="time to detect and measure",
        ),
    ),
    ("variant", "role", "frames", "board", "repeat"),
    ("parquet",),
    always=True,
)
PROBES = Table(
    "probes",
    "one row per set-up, number of frames and sample pixel, over the hole-free repeats",
    (
        *COMMON[:2],
        *_columns(
            pixel="number of the pixel, in sensor order",
            mean_error_mm="mean error of z",
            temporal_std_mm="standard deviation of z over repeats",
            displacement_std_mm="standard deviation of whole clouds' displacement, which the other columns exclude",
            repeats="number of repeats",
        ),
    ),
    ("variant", "frames", "pixel"),
    ("parquet",),
)
NOISE = Table(
    "noise",
    "one row per hole-free trial of a single view: noise and pixels on an undamaged board",
    (
        *COMMON,
        *_columns(
            valid_share="share of the board's pixels with a range",
            pitch_u_mm="median distance on the board between neighbouring pixels of a row",
            pitch_v_mm="median distance on the board between neighbouring pixels of a column",
            single_frame_mm="standard deviation of one frame's temporal noise of z",
            **{
                name: "correlation of that noise between pixels n columns (u) or rows (v) apart"
                for name in LAGS
            },
        ),
    ),
    ("variant", "frames", "repeat"),
)
REGISTRATIONS = Table(
    "registrations",
    "one row per registration of a view; registrations that set-ups share are under the first of them",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(
            view="number of the view; the reference is 0",
            method="method of registration",
            tre_mm="target registration error, root mean square over the board",
            tre_in_plane_mm="part of that error in the board's plane",
            tre_across_mm="part of that error perpendicular to the plane",
            predicted_in_plane_mm="predicted error in the plane; empty if the method predicts none",
            predicted_across_mm="predicted error perpendicular to the plane",
            guess_tre_mm="error of the nominal pose from which it started",
            residual_mm="root mean square residual",
            overlap="share of points with a partner",
            pairs="number of pairs of points",
            marks="number of marks that were used",
            iterations="number of iterations",
            converged="whether it converged",
            seconds="time in seconds",
            failure="reason for a failure; empty if it succeeded",
        ),
    ),
    ("variant", "role", "frames", "repeat", "view"),
)
SITES = Table(
    "sites",
    "one row per repeat and place on a hole-free board from which the damage was left out",
    (
        *(*COMMON, *BOARD, *ROLE, *_columns(hole="number of the place"), *TRUTH[1:3], *TRUTH[4:6]),
        *_columns(
            detected="whether a finding lies there by chance",
            signal="highest score within the hit radius",
        ),
    ),
    ("variant", "frames", "board", "repeat", "true_diameter_mm", "hole"),
    ("parquet",),
)
FINDINGS = Table(
    "findings",
    "one row per finding on a study's boards",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(
            x_mm="x on the board",
            y_mm="y on the board",
            score="score",
            hole="damage that it hits; empty: none",
        ),
    ),
    ("variant", "frames", "role", "board", "repeat"),
    ("parquet",),
)
OPERATING = Table(
    "operating",
    "one row per trial of a study and threshold of a grid, besides the threshold in use",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(threshold="threshold", findings="findings above it", hits="hits among them"),
    ),
    ("variant", "frames", "role", "board", "repeat"),
    ("parquet",),
    lists=("threshold", "findings", "hits"),
)
PIXELS = Table(
    "pixels",
    "one row per trial on a study's damaged boards, damage, and threshold on a finer grid",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(
            hole="damage; empty: intact face",
            pixels="judged pixels",
            threshold="threshold",
            above="above it",
        ),
    ),
    ("variant", "frames", "board", "repeat"),
    ("parquet",),
    lists=("threshold", "above"),
)


def _mean(kind: str, label: str) -> Column:
    """Return a column for pages with a mean and its standard deviation."""
    return Column(
        "", label, lambda row: text.plus_minus(row[f"{kind}_mean_mm"], row[f"{kind}_std_mm"])
    )


def _error(kind: str, label: str) -> Column:
    """Return a column for pages with a mean error, its standard deviation and the number of
    values."""

    def error(row: Mapping[str, Any]) -> str:
        count = int(row[f"{kind}_n"])
        return (
            f"{text.plus_minus(row[f'{kind}_bias_mm'], row[f'{kind}_std_mm'], '+')} ({count})"
            if count
            else "–"
        )

    return Column("", label, error)


def _found(row: Mapping[str, Any]) -> Cell:
    """Return the number of holes found, and their names if there are few enough to read."""
    from harness.evaluation.summary import hole_list

    names = hole_list(row["found"]) if row["holes"] <= MOST_NAMES else ""
    undecided = (
        hole_list(row["undecided"]) if row["holes"] <= MOST_NAMES else str(len(row["undecided"]))
    )
    words = "; ".join(
        part for part in (names, f"undecided {undecided}" if row["undecided"] else "") if part
    )
    return Cell(
        f"{len(row['found'])} of {row['holes']}\n{words}".strip(),
        share=len(row["found"]) / row["holes"],
    )


MOST_NAMES = 15  # most holes that a cell lists by name; for more holes it gives only the number
CALLS_OF = Column(
    "",
    "false calls",
    lambda row: f"{row['false_calls']:.0f} in {row['runs']:.0f}" if row["runs"] > 0 else "–",
)
SUMMARY = Table(
    "summary",
    "one row per set-up, number of frames and damage, with 95 % intervals; means are over the trials that detected it",
    (
        *COMMON[:2],
        Column("hole", "hole", note="number of the damage"),
        *(
            replace(column, label={"true_diameter_mm": "true (mm)"}.get(column.name, ""))
            for column in TRUTH
        ),
        *_columns(n="number of trials", detected="number of trials that detected it"),
        Column(
            "rate", note="share of trials that detected it, with Wilson's interval", interval=True
        ),
        *_columns(
            status="found, missed or undecided: the interval lies above, lies below or contains 0.5"
        ),
        _mean("extent_diameter", "extent (mm)"),
        _mean("model_diameter", "model (mm)"),
        *(
            Column(f"{k}_{name}", note=f"{note} ({by})")
            for k, by in BY
            for name, note in STATISTICS.items()
        ),
        *(
            Column(f"{k}_bias_mm", note=f"mean diameter minus true diameter ({by})", interval=True)
            for k, by in BY
        ),
        *(
            Column(
                f"{k}_error_mean_mm", f"centre off, {k} (mm)", note=f"mean error of place ({by})"
            )
            for k, by in BY
        ),
        Column(
            "model_diameter_se_mean_mm",
            "its stated error (mm)",
            note="mean standard error stated by the fits",
        ),
        Column("model_diameter_covered", "truth within 1.96 of it", None, COVERED, _percent),
        Column("model_depth_mean_mm", "depth (mm)", note="mean depth (the model)"),
        *_columns(
            model_depth_std_mm="standard deviation of that depth",
            model_depth_se_mean_mm="mean standard error of depth stated by the fits",
            model_depth_bias_mm="mean depth minus seen_depth_mm",
            median_residual_mm="mean of the trials' median residuals",
            invalid_fraction="mean share of pixels without a range",
            results_version="version of the results",
        ),
    ),
    formats=("csv",),
    always=True,
)
NOISE_BY_FRAMES = Table(
    "noise_by_frames",
    "one row per set-up and number of frames: components of the error of z over the sample pixels",
    (
        COMMON[0],
        Column("frames", "frames", note="number of averaged frames"),
        *_columns(pixels="number of sample pixels", repeats="number of repeats"),
        Column(
            "temporal_rms_mm",
            "temporal noise (mm)",
            None,
            "root mean square deviation over repeats",
            _fine,
        ),
        Column(
            "guide_mm",
            "1/√N guide (mm)",
            None,
            "noise of the shortest average, scaled by 1/sqrt(N)",
            _fine,
        ),
        Column("offset_mm", "offset (mm)", None, "mean error", lambda mm: f"{mm:+.3f}"),
        Column(
            "pattern_mm",
            "pattern (mm)",
            None,
            "standard deviation over pixels of the mean error",
            _fine,
        ),
        Column("systematic_mm", "systematic (mm)", None, "offset and pattern combined", _fine),
        Column("total_rms_mm", "total (mm)", None, "temporal and systematic error combined", _fine),
        Column(
            "displacement_mm",
            "whole cloud displaced (mm)",
            None,
            "deviation of whole clouds' displacement",
            _fine,
        ),
    ),
)
FALSE_CALLS = Table(
    "false_calls",
    "one row per set-up, number of frames and role of the board",
    (
        Column("variant", "set-up", None, "name of the set-up", in_words),
        Column("frames", "frames", note="number of averaged frames"),
        Column("role", "board", note=ROLE[0].note, text=lambda role: role.replace("_", "-")),
        CALLS_OF,
        *_columns(
            runs="number of runs with a threshold", false_calls="number of false calls in them"
        ),
        Column(
            "per_run",
            "per run (95 %)",
            note="false calls per run, with Garwood's interval",
            interval=True,
        ),
        Column("threshold", "threshold (k)", note="mean threshold"),
        Column("threshold_mm", "threshold (mm)", note="mean of threshold times scale"),
        Column(
            "surface_noise_mm",
            "surface noise (mm)",
            None,
            "mean deviation from the fitted surface",
            _fine,
        ),
        Column("quiet_runs", "hole-free runs", note="number of hole-free runs"),
        Column("quiet_highest", "highest quiet k", note="highest quiet_threshold of these runs"),
    ),
)
SET_UPS = Table(
    "set_ups",
    "one row per set-up and number of frames: holes found, errors of size and place, noise, threshold",
    (
        Column("variant", "set-up", None, "name of the set-up", in_words),
        Column("registration", "registration", note="maps: method of registration", text=_word),
        Column("merge", "merge", note="maps: how views are merged", text=_word),
        Column("views", "views", note="maps: number of views"),
        Column("frames", "frames", note="number of averaged frames"),
        *_columns(holes="number of holes", repeats="number of repeats"),
        *_columns(found="numbers of the holes found", undecided="numbers of the undecided holes"),
        Column("", "found", _found),
        Column(
            "limit_mm", "from (mm)", note="smallest diameter at and above which all holes are found"
        ),
        Column(
            "half_mm",
            "50 % size (mm)",
            note="size found half of the time",
            interval=True,
            brief=False,
        ),
        *(_error(kind, label) for kind, label in ERRORS.items()),
        *(
            Column(
                f"{kind}_{name}",
                note=f"{note} of the errors of found holes: {label.removesuffix(' (mm)')}",
            )
            for kind, label in ERRORS.items()
            for name, note in (
                ("bias_mm", "mean"),
                ("std_mm", "standard deviation"),
                ("n", "number"),
            )
        ),
        Column(
            "",
            "mm per pixel",
            lambda row: " × ".join(text.mm(row.get(name, math.nan)) for name in PITCH),
        ),
        Column("valid_share", "valid", note=NOISE.columns[3].note, text=_percent),
        *NOISE.columns[4:6],
        Column("single_frame_mm", "one frame (mm)", note=NOISE.columns[6].note),
        Column("temporal_mm", "average (mm)", None, "temporal noise of the averaged z", _fine),
        Column("offset_mm", "offset (mm)", None, "mean error of z", _fine),
        Column(
            "pattern_mm",
            "pattern (mm)",
            None,
            "standard deviation over pixels of the mean error",
            _fine,
        ),
        *NOISE.columns[7:],
        Column(
            "surface_mm",
            "surface noise (mm)",
            None,
            "robust deviation from the fitted surface",
            _fine,
        ),
        Column("threshold", "threshold (k)", note="mean threshold"),
        Column("threshold_mm", "threshold (mm)", note="mean of threshold times scale"),
        CALLS_OF,
        *_columns(
            false_calls="number of false calls on the damaged board",
            runs="number of runs on the damaged board",
            place="maps: values on the other axes",
            is_variation="whether it is a variation of another set-up",
            reference="the set-up that it is a variation of",
            surface_std_mm="maps: standard deviation over runs of the surface's deviation",
        ),
        Column("views_left_out", "views left out", note="maps: mean number of views left out"),
        Column("seconds_map", "time (s)", note="maps: median time to make the map"),
    ),
    title="holes found, and the smallest diameter at and above which all holes are found",
)
REGISTRATION_ERRORS = Table(
    "registration_errors",
    "one row per method of registration, number of frames and number of views",
    (
        Column("method", "method", note="method of registration"),
        Column("frames", "frames", note="number of averaged frames"),
        Column("views", "views", note="number of views of the map"),
        Column("n", "number", note="number of registrations"),
        Column("failed", "failed", note="number of registrations that failed"),
        Column("guess_mm", "before (mm)", note="median error of the nominal pose"),
        *(
            column
            for part, label in (("in_plane", "in plane"), ("across", "across"))
            for column in (
                Column(f"{part}_median_mm", f"{label}: median", note=f"median error {label}"),
                Column(f"{part}_rms_mm", "rms", note=f"root mean square error {label}"),
                Column(
                    f"{part}_predicted_mm",
                    "predicted",
                    note=f"error {label} that the covariances predict",
                ),
                Column(
                    f"{part}_ratio",
                    "ratio",
                    note=f"actual over predicted error {label}",
                    interval=True,
                ),
            )
        ),
        Column("seconds", "time (s)", note="median time"),
        Column(
            "reasons",
            "why it failed",
            note="most common reasons",
            text=lambda reasons: "; ".join(reasons) or "–",
        ),
    ),
)
CLAIMS = Table(
    "claims",
    "one row per claim of the thesis",
    (
        Column("claim", "claim", note="number of the claim"),
        Column("text", "says", note="the claim"),
        Column(
            "verdict",
            "verdict",
            note="borne out, not borne out or undecided",
            text=lambda verdict: f"{MARKS[verdict][0]} {verdict}",
            tone=lambda row: MARKS[row["verdict"]][1],
        ),
        Column("evidence", "evidence", note="the numbers that support the verdict"),
        Column("rule", "criterion", note="the criterion, fixed in advance"),
    ),
    formats=("csv",),
    left=5,
    kind="claims",
)
POSTERIOR = Table(
    "posterior",
    "one row per set-up and per value of an axis: how well it agrees with the thesis' result (from 20 set-ups on)",
    (
        Column(
            "axis",
            note="fact that the thesis does not state; `set-up` for the combination of all facts",
        ),
        Column("value", "set-up", None, "value of that fact, or name of the set-up", in_words),
        Column("prior_share", note="prior probability"),
        Column(
            "likelihood",
            "likelihood",
            note="mean probability of the thesis' exact result with 1 and 50 frames",
        ),
        Column("posterior_share", "posterior", note="posterior probability"),
    ),
    formats=("csv",),
    left=2,
)
EFFECTS = Table(
    "effects",
    "one row per effect, condition and number of frames of an experiment with `switches`: the effect's loss",
    (
        Column("place", "place", note="values of the other axes"),
        Column("frames", "frames", note="number of averaged frames"),
        Column(
            "effect", "effect", note="effect that is switched on; `all` for all effects together"
        ),
        Column("against", "against", note="whether none or all of the other effects are on"),
        Column(
            "loss_mm", "loss (mm)", note="change of the 50 % size when the effect is switched on"
        ),
        *_columns(
            loss_low_mm="lower end of its 95 % bootstrap interval",
            loss_high_mm="upper end of that interval",
        ),
        Column(
            "on_ladder",
            note="whether both sizes lie within the range inspected; otherwise the loss is a bound",
        ),
    ),
)
STORED = (TRIALS, RUNS, PROBES, NOISE, REGISTRATIONS, SITES, FINDINGS, OPERATING, PIXELS)
STUDY_ONLY = (SITES, FINDINGS, OPERATING, PIXELS)
SUMMARISED = (
    SUMMARY,
    NOISE_BY_FRAMES,
    FALSE_CALLS,
    SET_UPS,
    REGISTRATION_ERRORS,
    CLAIMS,
    POSTERIOR,
    EFFECTS,
)


def _empty() -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame()


@dataclass(frozen=True)
class ResultTables:
    """Tables of trials as declared above; ``holes`` is `TRIALS`. A table that an experiment lacks
    is empty. ``variants`` has a row per set-up and then per variation: variant, reason, settings,
    is_variation, reference, switches, and the axes. ``axes`` has the path, name and unit of every
    axis on which set-ups differ, in order."""

    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    variants: pd.DataFrame
    noise: pd.DataFrame
    axes: pd.DataFrame
    registrations: pd.DataFrame = field(default_factory=_empty)
    sites: pd.DataFrame = field(default_factory=_empty)
    findings: pd.DataFrame = field(default_factory=_empty)
    operating: pd.DataFrame = field(default_factory=_empty)
    pixels: pd.DataFrame = field(default_factory=_empty)

    def of(self, variant: str, frames: int) -> ResultTables:
        """Return the rows of one set-up."""
        found = vars(self).items()
        by_set_up = {
            name: table for name, table in found if {"variant", "frames"} <= set(table.columns)
        }
        own = {
            n: t[(t["variant"] == variant) & (t["frames"] == frames)] for n, t in by_set_up.items()
        }
        return replace(self, **own)

    def stored(self) -> dict[Table, pd.DataFrame]:
        """Return the tables that are written to files, in order."""
        return {
            table: getattr(self, "holes" if table is TRIALS else table.name) for table in STORED
        }


# ---------------------------------------------------------------- real captures

FINDINGS_VERSION = 3
"""The version is increased when the meaning of a column or key changes; the last column of the CSV
states it."""
FINDINGS_OF_CAPTURE = Table(
    outputs.FINDINGS.name.removesuffix(".csv"),
    outputs.FINDINGS.note,
    (
        Column("id", "", "id", "number, in order of decreasing score"),
        Column("kind", "", "kind", "hole (behind the surface), bump (in front of it) or no return"),
        Column("u_px", "", "u_px", "column of its centre in the image"),
        Column("v_px", "", "v_px", "row of its centre in the image"),
        Column("x_mm", "", "x_mm", "x of its centre in the camera's frame (to the right)"),
        Column("y_mm", "", "y_mm", "y of its centre in the camera's frame (down)"),
        Column("z_mm", "", "z_mm", "z of its centre in the camera's frame (away from the camera)"),
        Column("diameter_mm", "", "diameter_mm", "diameter, from the model if the model fits"),
        Column("depth_mm", "", "depth_mm", "depth; negative for a bump"),
        Column(
            "volume_mm3", "", "volume_mm3", "volume between the surface and the points behind it"
        ),
        Column("points", "", "points", "number of points of the cluster"),
        Column("score", "", "score", "the detector's score"),
        Column(
            "length_mm",
            "",
            "length_mm",
            "length of the rectangle with its second moments, corrected for blur",
        ),
        Column("width_mm", "", "width_mm", "width of that rectangle"),
        Column(
            "angle_deg",
            "",
            "angle_deg",
            "angle of the rectangle's length from x towards y (down), -90 to 90",
        ),
        Column(
            "findings_version",
            "",
            lambda finding: FINDINGS_VERSION,
            "version of this table's format",
        ),
    ),
    formats=("csv",),
    always=True,
    digits="%.4f",
)
POINTS_OF_CAPTURES = Table(
    outputs.CAPTURES.name.removesuffix(".csv"),
    outputs.CAPTURES.note,
    (
        Column("point", note="folder of its findings"),
        Column("variant", note="name of the set-up"),
        Column("what", note="name of the set-up with its number of frames"),
        Column("frames_used", note="number of frames in the average"),
        Column("frames_left_out", note="number of frames left out as disturbed"),
        Column("threshold_k", note="threshold in the detector's units"),
        Column("threshold_mm", note="threshold in mm"),
        Column("findings", note="number of findings"),
        Column("results_version", "", lambda row: RESULTS_VERSION, "version of the results"),
    ),
    formats=("csv",),
    always=True,
)
