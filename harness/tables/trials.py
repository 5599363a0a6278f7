"""Tables of trials: what each trial measured, and the summaries of experiments that are no study.

Columns are declared by name and note alone; their values come from `harness.engine.trial` and `harness.evaluation`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from harness.tables import outputs, text
from harness.tables.schema import Column, Table
from harness.tables.text import Cell, Tone
from harness.vocabulary.path_names import in_words
from harness.vocabulary.provenance import RESULTS_VERSION

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


COMMON = _columns(variant="name of the set-up", frames="frames averaged", repeat="draw of noise, and of study.units")
BOARD = _columns(board="number of the board, in a study")
POINT = _columns(point="digest of the set-up with its frames")
ROLE = _columns(role="damaged, hole_free or calibration")
TRUTH = _columns(
    kind="kind of damage",
    true_diameter_mm="diameter",
    true_depth_mm="depth of removed material",
    seen_depth_mm="depth of what is seen; behind a through-hole one sees farther",
    true_x_mm="place on the board",
    true_y_mm="likewise",
    true_offset_mm="distance from the largest hole",
)
SHAPE = _columns(
    size_of="what true_diameter_mm is: the diameter, or of long damage its width or length",
    true_length_mm="length; empty for holes and ball dents",
    true_width_mm="width, likewise",
    true_angle_deg="angle of the length from the board's x",
)
SIZES = _columns(
    extent_diameter_mm="diameter by the thesis' measure",
    extent_offset_mm="distance from the largest cluster's centre by the thesis' measure",
    extent_error_mm="distance from the true centre by the thesis' measure",
    model_diameter_mm="diameter of the model of a blurred hole",
    model_diameter_se_mm="its standard error as the fit states it",
    model_depth_mm="depth of the model",
    model_depth_se_mm="its standard error as the fit states it",
    model_offset_mm="distance from the largest cluster's centre by the model",
    model_error_mm="distance from the true centre by the model",
    length_mm="length of the rectangle that has the second moments of the residual, less the blur",
    width_mm="its width",
    angle_deg="angle of its length from the board's x, -90 to 90",
    model_note="what the fit says of itself",
)
STATISTICS = {
    "measured": "trials with a finite diameter",
    "diameter_mean_mm": "mean diameter",
    "diameter_std_mm": "its standard deviation",
    "offset_mean_mm": "mean distance from the largest hole",
    "offset_std_mm": "its standard deviation",
    "offset_bias_mm": "mean less the true distance",
}
BY = (("extent", "the thesis' measure"), ("model", "the model"))
ERRORS = {
    "extent": "size, extent (mm)",
    "model": "size, model (mm)",
    "extent_place": "position, extent (mm)",
    "model_place": "position, model (mm)",
}
COVERED = "share of fits within 1.96 of their own standard errors of the truth"
MARKS: dict[str, tuple[str, Tone]] = {
    "borne out": ("✓", "good"),
    "not borne out": ("✗", "bad"),
    "undecided": ("?", "open"),
}
PITCH = ("pitch_u_mm", "pitch_v_mm")
LAGS = tuple(f"correlation_{way}{lag}" for way in "uv" for lag in (1, 2, 3))

TRIALS = Table(
    "trials",
    "one row per trial on a damaged board and hole",
    (
        *(*POINT, *COMMON, *BOARD, *_columns(hole="number of the hole"), *TRUTH, *SHAPE),
        *_columns(
            detected="whether a finding counts for it",
            threshold="threshold in use, in the detector's units",
            invalid_fraction="share of its pixels without a range",
            median_residual_mm="median distance of its pixels behind the surface",
            state="found, wrong depth, invalid or invisible: what its pixels tell, whatever the detector says",
            score="score of the finding",
            points="points of the finding",
            signal="of a study: highest score within the hit radius",
            no_return="of a study: whether a finding without return counts for it",
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
            threshold="threshold in use; empty in runs that set it",
            quiet_threshold="of hole-free runs: score above which nothing is found",
            scale_mm="one unit of score",
            surface_noise_mm="robust deviation from the fitted surface on undamaged face",
            frames_used="frames in the average",
            left_out="frames left out as disturbed",
            detections="findings",
            false_calls="findings that count for no damage",
            inspected_m2="of a study: face that was judged",
            no_return_calls="of a study: false calls without return",
            loudest_x_mm="of calibration: place of the highest score",
            loudest_y_mm="likewise",
            loudest_u_px="its column on the sensor",
            loudest_v_px="its row on the sensor",
            views_used="of maps: views merged",
            views_left_out="of maps: views left out after a failed registration",
            seconds_map="of maps: time of making the map",
            seconds_frames="time of simulating and averaging",
            seconds_detect="time of detection and measurement",
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
            temporal_std_mm="standard deviation over repeats",
            displacement_std_mm="deviation of whole clouds, which is taken out of the other two",
            repeats="repeats",
        ),
    ),
    ("variant", "frames", "pixel"),
    ("parquet",),
)
NOISE = Table(
    "noise",
    "one row per hole-free trial of a single view: what the camera makes of an undamaged board",
    (
        *COMMON,
        *_columns(
            valid_share="share of the board's pixels with a range",
            pitch_u_mm="median distance on the board between pixels of a row",
            pitch_v_mm="likewise of a column",
            single_frame_mm="standard deviation of one frame's temporal noise of z",
            **{name: "correlation of that noise with itself so many columns (u) or rows (v) on" for name in LAGS},
        ),
    ),
    ("variant", "frames", "repeat"),
)
REGISTRATIONS = Table(
    "registrations",
    "one row per registration of a view, under the first set-up that shares it",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(
            view="number of the view; the reference is 0",
            method="method of registration",
            tre_mm="target registration error, root mean square over the board",
            tre_in_plane_mm="its part in the board's plane",
            tre_across_mm="its part across the plane",
            predicted_in_plane_mm="what the method itself predicts; empty without an estimate",
            predicted_across_mm="likewise",
            guess_tre_mm="error of the starting guess",
            residual_mm="root mean square residual",
            overlap="share of points with a partner",
            pairs="pairs of points",
            marks="marks trusted",
            iterations="iterations",
            converged="whether it converged",
            seconds="time",
            failure="reason of a failure; empty for none",
        ),
    ),
    ("variant", "role", "frames", "repeat", "view"),
)
SITES = Table(
    "sites",
    "one row per place of left-out damage on a hole-free board, and repeat",
    (
        *(*COMMON, *BOARD, *ROLE, *_columns(hole="number of the place"), *TRUTH[1:3], *TRUTH[4:6]),
        *_columns(detected="whether a finding lies there by chance", signal="highest score within the hit radius"),
    ),
    ("variant", "frames", "board", "repeat", "true_diameter_mm", "hole"),
    ("parquet",),
)
FINDINGS = Table(
    "findings",
    "one row per finding on a study's boards",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(x_mm="place on the board", y_mm="likewise", score="score", hole="damage it counts for; empty: none"),
    ),
    ("variant", "frames", "role", "board", "repeat"),
    ("parquet",),
)
OPERATING = Table(
    "operating",
    "one row per trial of a study and threshold other than the one in use, on a grid",
    (*(*COMMON, *BOARD, *ROLE), *_columns(threshold="threshold", findings="findings above it", hits="hits among them")),
    ("variant", "frames", "role", "board", "repeat"),
    ("parquet",),
    lists=("threshold", "findings", "hits"),
)
PIXELS = Table(
    "pixels",
    "one row per trial on a study's damaged boards, damage and threshold of a finer grid",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(hole="damage; empty: intact face", pixels="pixels judged", threshold="threshold", above="above it"),
    ),
    ("variant", "frames", "board", "repeat"),
    ("parquet",),
    lists=("threshold", "above"),
)


def _mean(of: str, label: str) -> Column:
    """Return a page's column of a mean with its standard deviation."""
    return Column("", label, lambda row: text.plus_minus(row[f"{of}_mean_mm"], row[f"{of}_std_mm"]))


def _error(of: str, label: str) -> Column:
    """Return a page's column of a mean error with its standard deviation and number."""

    def error(row: Mapping[str, Any]) -> str:
        count = int(row[f"{of}_n"])
        return f"{text.plus_minus(row[f'{of}_bias_mm'], row[f'{of}_std_mm'], '+')} ({count})" if count else "–"

    return Column("", label, error)


def _found(row: Mapping[str, Any]) -> Cell:
    """Return the number of holes found, and their names where there are few enough to read."""
    from harness.evaluation.summary import hole_list

    names = hole_list(row["found"]) if row["holes"] <= MOST_NAMES else ""
    undecided = hole_list(row["undecided"]) if row["holes"] <= MOST_NAMES else str(len(row["undecided"]))
    said = "; ".join(part for part in (names, f"undecided {undecided}" if row["undecided"] else "") if part)
    return Cell(f"{len(row['found'])} of {row['holes']}\n{said}".strip(), share=len(row["found"]) / row["holes"])


MOST_NAMES = 15
"""Holes up to which a cell lists them by name; beyond it their number and the limit say more."""
CALLS_OF = Column(
    "", "false calls", lambda row: f"{row['false_calls']:.0f} in {row['runs']:.0f}" if row["runs"] > 0 else "–"
)
SUMMARY = Table(
    "summary",
    "one row per set-up, number of frames and hole, with 95 % intervals; means are over the trials that detected it",
    (
        *COMMON[:2],
        Column("hole", "hole", note="number of the hole"),
        *(replace(one, label={"true_diameter_mm": "true (mm)"}.get(one.name, "")) for one in TRUTH),
        *_columns(n="trials", detected="trials that detected it"),
        Column("rate", note="their share, with Wilson's interval", interval=True),
        *_columns(status="found, missed or undecided: the interval lies above, below or about 0.5"),
        _mean("extent_diameter", "extent (mm)"),
        _mean("model_diameter", "model (mm)"),
        *(Column(f"{of}_{name}", note=f"{note} ({by})") for of, by in BY for name, note in STATISTICS.items()),
        *(Column(f"{of}_bias_mm", note=f"mean diameter less the true ({by})", interval=True) for of, by in BY),
        *(Column(f"{of}_error_mean_mm", f"centre off, {of} (mm)", note="mean distance from it") for of, _ in BY),
        Column("model_diameter_se_mean_mm", "its stated error (mm)", note="mean standard error as the fits state it"),
        Column("model_diameter_covered", "truth within 1.96 of it", None, COVERED, _percent),
        Column("model_depth_mean_mm", "depth (mm)", note="mean depth of the model"),
        *_columns(
            model_depth_std_mm="its standard deviation",
            model_depth_se_mean_mm="mean standard error as the fits state it",
            model_depth_bias_mm="mean depth less the depth seen",
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
    "one row per set-up and number of frames: parts of the error over the sample pixels",
    (
        COMMON[0],
        Column("frames", "frames", note="frames averaged"),
        *_columns(pixels="pixels", repeats="repeats"),
        Column("temporal_rms_mm", "temporal noise (mm)", None, "root mean square of the deviation over repeats", _fine),
        Column("guide_mm", "1/√N guide (mm)", None, "the shortest average's noise falling as 1/sqrt(N)", _fine),
        Column("offset_mm", "offset (mm)", None, "mean error", lambda mm: f"{mm:+.3f}"),
        Column("pattern_mm", "pattern (mm)", None, "standard deviation over pixels of the mean error", _fine),
        Column("systematic_mm", "systematic (mm)", None, "offset and pattern together", _fine),
        Column("total_rms_mm", "total (mm)", None, "temporal and systematic together", _fine),
        Column("displacement_mm", "whole cloud displaced (mm)", None, "deviation of whole clouds", _fine),
    ),
)
FALSE_CALLS = Table(
    "false_calls",
    "one row per set-up, number of frames and role of the board",
    (
        Column("variant", "set-up", None, "name of the set-up", in_words),
        Column("frames", "frames", note="frames averaged"),
        Column("role", "board", note=ROLE[0].note, text=lambda role: role.replace("_", "-")),
        CALLS_OF,
        *_columns(runs="runs judged at a threshold", false_calls="false calls"),
        Column("per_run", "per run (95 %)", note="false calls a run, with Garwood's interval", interval=True),
        Column("threshold", "threshold (k)", note="mean threshold"),
        Column("threshold_mm", "threshold (mm)", note="mean of threshold times scale"),
        Column("surface_noise_mm", "surface noise (mm)", None, "mean deviation from the fitted surface", _fine),
        Column("quiet_runs", "hole-free runs", note="hole-free runs"),
        Column("quiet_highest", "highest quiet k", note="highest of their quiet thresholds"),
    ),
)
SET_UPS = Table(
    "set_ups",
    "one row per set-up and number of frames: holes found, errors of size and place, noise, threshold",
    (
        Column("variant", "set-up", None, "name of the set-up", in_words),
        Column("registration", "registration", note="of maps: method of registration", text=_word),
        Column("merge", "merge", note="of maps: how views are merged", text=_word),
        Column("views", "views", note="of maps: number of views"),
        Column("frames", "frames", note="frames averaged"),
        *_columns(holes="holes", repeats="repeats", found="holes found", undecided="holes undecided"),
        Column("", "found", _found),
        Column("limit_mm", "from (mm)", note="smallest diameter from which on all are found"),
        Column("half_mm", "50 % size (mm)", note="50 % size, with its interval", interval=True, brief=False),
        *(_error(of, label) for of, label in ERRORS.items()),
        *(
            Column(f"{of}_{name}", note=f"{note} of errors over found holes: {label.removesuffix(' (mm)')}")
            for of, label in ERRORS.items()
            for name, note in (("bias_mm", "mean"), ("std_mm", "standard deviation"), ("n", "number"))
        ),
        Column("", "mm per pixel", lambda row: " × ".join(text.mm(row.get(name, math.nan)) for name in PITCH)),
        Column("valid_share", "valid", note=NOISE.columns[3].note, text=_percent),
        *NOISE.columns[4:6],
        Column("single_frame_mm", "one frame (mm)", note=NOISE.columns[6].note),
        Column("temporal_mm", "average (mm)", None, "temporal noise of the averaged z", _fine),
        Column("offset_mm", "offset (mm)", None, "mean error of z", _fine),
        Column("pattern_mm", "pattern (mm)", None, "standard deviation over pixels of the mean error", _fine),
        *NOISE.columns[7:],
        Column("surface_mm", "surface noise (mm)", None, "robust deviation from the fitted surface", _fine),
        Column("threshold", "threshold (k)", note="mean threshold"),
        Column("threshold_mm", "threshold (mm)", note="mean of threshold times scale"),
        CALLS_OF,
        *_columns(
            false_calls="false calls on the damaged board",
            runs="runs on it",
            place="of maps: values on the other axes",
            is_variation="whether it varies another set-up",
            reference="that set-up",
            surface_std_mm="of maps: standard deviation over runs of the surface's deviation",
        ),
        Column("views_left_out", "views left out", note="of maps: mean number of views left out"),
        Column("seconds_map", "time (s)", note="of maps: median time of making the map"),
    ),
    title="holes found, and the smallest diameter from which on all are",
)
REGISTRATION_ERRORS = Table(
    "registration_errors",
    "one row per method of registration, number of frames and number of views",
    (
        Column("method", "method", note="method of registration"),
        Column("frames", "frames", note="frames averaged"),
        Column("views", "views", note="views of the map"),
        Column("n", "number", note="registrations"),
        Column("failed", "failed", note="registrations that failed"),
        Column("guess_mm", "before (mm)", note="median error of the starting guess"),
        *(
            column
            for part, label in (("in_plane", "in plane"), ("across", "across"))
            for column in (
                Column(f"{part}_median_mm", f"{label}: median", note="median error"),
                Column(f"{part}_rms_mm", "rms", note="root mean square error"),
                Column(f"{part}_predicted_mm", "predicted", note="error that the covariances predict"),
                Column(f"{part}_ratio", "ratio", note="actual over predicted error (1: honest)", interval=True),
            )
        ),
        Column("seconds", "time (s)", note="median time"),
        Column("reasons", "why it failed", note="commonest reasons", text=lambda reasons: "; ".join(reasons) or "–"),
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
        Column("evidence", "evidence", note="numbers behind the verdict"),
        Column("rule", "criterion", note="criterion fixed beforehand"),
    ),
    formats=("csv",),
    left=5,
    kind="claims",
)
POSTERIOR = Table(
    "posterior",
    "one row per set-up and per value of an axis: how well it agrees with the thesis' outcome (of 20 set-ups and more)",
    (
        Column("axis", note="the fact that the thesis does not state; `set-up` for all of them together"),
        Column("value", "set-up", None, "its value; of a set-up its name", in_words),
        Column("prior_share", note="probability beforehand"),
        Column("likelihood", "likelihood", note="probability of exactly the thesis' holes with 1 and 50 frames; mean"),
        Column("posterior_share", "posterior", note="probability afterwards"),
    ),
    formats=("csv",),
    left=2,
)
EFFECTS = Table(
    "effects",
    "one row per effect, condition and number of frames, of an experiment with `switches`: what the effect costs",
    (
        Column("place", "place", note="values of the other axes"),
        Column("frames", "frames", note="frames averaged"),
        Column("effect", "effect", note="switch that goes on; `all` together at last"),
        Column("against", "against", note="what else is on: nothing, or all other effects"),
        Column("loss_mm", "loss (mm)", note="change of the 50 % size when it goes on"),
        *_columns(loss_low_mm="lower end of its 95 % bootstrap interval", loss_high_mm="upper end"),
        Column("on_ladder", note="whether both sizes lie on the ladder of sizes; the loss is a bound otherwise"),
    ),
)
STORED = (TRIALS, RUNS, PROBES, NOISE, REGISTRATIONS, SITES, FINDINGS, OPERATING, PIXELS)
STUDY_ONLY = (SITES, FINDINGS, OPERATING, PIXELS)
SUMMARISED = (SUMMARY, NOISE_BY_FRAMES, FALSE_CALLS, SET_UPS, REGISTRATION_ERRORS, CLAIMS, POSTERIOR, EFFECTS)


def _empty() -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame()


@dataclass(frozen=True)
class ResultTables:
    """Tables of trials as declared above, ``holes`` being `TRIALS`; a table that an experiment lacks is empty.
    ``variants``: per set-up, then per variation: variant, reason, settings, is_variation, reference, switches, and the
    axes. ``axes``: path, name, unit of what tells set-ups apart, in their order."""

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

    def stored(self) -> dict[Table, pd.DataFrame]:
        """Return the tables that are written, in their order."""
        return {table: getattr(self, "holes" if table is TRIALS else table.name) for table in STORED}


# ---------------------------------------------------------------- real captures

FINDINGS_VERSION = 3
"""Raised when a column's or a key's meaning changes; in the CSV it is the last column."""
FINDINGS_OF_CAPTURE = Table(
    outputs.FINDINGS.name.removesuffix(".csv"),
    outputs.FINDINGS.note,
    (
        Column("id", "", "id", "number, strongest first"),
        Column("kind", "", "kind", "hole (behind the surface), bump (before it) or no return"),
        Column("u_px", "", "u_px", "column of its middle"),
        Column("v_px", "", "v_px", "row of its middle"),
        Column("x_mm", "", "x_mm", "centre in the camera's frame, to the right"),
        Column("y_mm", "", "y_mm", "likewise, down"),
        Column("z_mm", "", "z_mm", "likewise, away"),
        Column("diameter_mm", "", "diameter_mm", "diameter, of the model where it fits"),
        Column("depth_mm", "", "depth_mm", "depth, negative of a bump"),
        Column("volume_mm3", "", "volume_mm3", "volume behind the surface"),
        Column("points", "", "points", "points of the cluster"),
        Column("score", "", "score", "the detector's score"),
        Column("length_mm", "", "length_mm", "of the rectangle with the second moments of the residual, less the blur"),
        Column("width_mm", "", "width_mm", "its width"),
        Column("angle_deg", "", "angle_deg", "of its length, from x towards y (down), -90 to 90"),
        Column("findings_version", "", lambda finding: FINDINGS_VERSION, "version of the table's meaning"),
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
        Column("what", note="the set-up with its frames"),
        Column("frames_used", note="frames in the average"),
        Column("frames_left_out", note="frames left out as disturbed"),
        Column("threshold_k", note="threshold in the detector's units"),
        Column("threshold_mm", note="the same in mm"),
        Column("findings", note="findings"),
        Column("results_version", "", lambda row: RESULTS_VERSION, "version of the results"),
    ),
    formats=("csv",),
    always=True,
)
