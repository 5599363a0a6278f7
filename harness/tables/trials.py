"""Tables of trials: what each trial measured, and the summaries of experiments that are no study.

Columns are declared by name and note alone; their values come from the rows that trials leave
(`harness.engine.trial`), and from `harness.evaluation`. Every table but those of a study may have a further column for
each axis of the experiment other than the number of frames, named by its dotted path.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from harness.tables.schema import Column, Table

if TYPE_CHECKING:
    import pandas as pd


def _columns(**notes: str) -> tuple[Column, ...]:
    return tuple(Column(name, note=note) for name, note in notes.items())


COMMON = _columns(variant="name of the set-up", frames="frames averaged", repeat="number of the draw of noise")
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
    model_note="what the fit says of itself",
)
LAGS = tuple(f"correlation_{way}{lag}" for way in "uv" for lag in (1, 2, 3))

TRIALS = Table(
    "trials",
    "one row per trial on a damaged board and hole",
    (
        *(*POINT, *COMMON, *BOARD, *_columns(hole="number of the hole"), *TRUTH),
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
WALLS = Table(
    "walls",
    "one row per hole and number of views: how much of its wall no view sees",
    _columns(
        hole="number of the hole",
        views="number of views",
        true_diameter_mm="diameter",
        depth_mm="depth",
        unseen_share="share of the wall that no lens sees",
        shadowed_share="share that is unseen or unlit in every view",
    ),
    formats=("parquet",),
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
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(threshold="threshold", findings="findings above it", hits="hits among them"),
    ),
    ("variant", "frames", "role", "board", "repeat"),
    ("parquet",),
)
PIXELS = Table(
    "pixels",
    "one row per trial on a study's damaged boards, damage and threshold of a finer grid",
    (
        *(*COMMON, *BOARD, *ROLE),
        *_columns(
            hole="damage; empty: undamaged face", pixels="pixels judged", threshold="threshold", above="above it"
        ),
    ),
    ("variant", "frames", "board", "repeat"),
    ("parquet",),
)
SUMMARY = Table(
    "summary",
    "one row per set-up, number of frames and hole, with 95 % intervals; means are over the trials that detected it",
    (
        *(*COMMON[:2], *_columns(hole="number of the hole"), *TRUTH),
        *_columns(
            n="trials",
            detected="trials that detected it",
            rate="their share, with Wilson's interval (rate_low, rate_high)",
            rate_low="lower end",
            rate_high="upper end",
            status="found, missed or undecided: the interval lies above, below or about 0.5",
            **{
                f"{measure}_{name}": f"{note} ({by})"
                for measure, by in (("extent", "the thesis' measure"), ("model", "the model"))
                for name, note in (
                    ("measured", "trials with a finite diameter"),
                    ("diameter_mean_mm", "mean diameter"),
                    ("diameter_std_mm", "its standard deviation"),
                    ("bias_mm", "mean diameter less the true diameter"),
                    ("bias_low_mm", "lower end of Student's interval"),
                    ("bias_high_mm", "upper end"),
                    ("offset_mean_mm", "mean distance from the largest hole"),
                    ("offset_std_mm", "its standard deviation"),
                    ("offset_bias_mm", "mean less the true distance"),
                    ("offset_measured", "trials with a distance"),
                    ("error_mean_mm", "mean distance from the true centre"),
                )
            },
            model_diameter_se_mean_mm="mean standard error as the fits state it",
            model_diameter_covered="share of fits within 1.96 of their own standard errors of the truth",
            model_depth_mean_mm="mean depth of the model",
            model_depth_std_mm="its standard deviation",
            model_depth_se_mean_mm="mean standard error as the fits state it",
            model_depth_bias_mm="mean depth less the depth seen",
            median_residual_mm="mean of the trials' median residuals",
            invalid_fraction="mean share of pixels without a range",
            share_found="share of trials in this state",
            share_wrong_depth="likewise",
            share_invalid="likewise",
            share_invisible="likewise",
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
        *COMMON[:2],
        *_columns(
            pixels="pixels",
            repeats="repeats",
            temporal_rms_mm="root mean square of the standard deviation over repeats",
            offset_mm="mean error",
            pattern_mm="standard deviation over pixels of the mean error",
            systematic_mm="offset and pattern together",
            total_rms_mm="temporal and systematic together",
            displacement_mm="standard deviation of whole clouds, in no other column",
            guide_mm="the shortest average's noise falling as 1/sqrt(N)",
        ),
    ),
)
FALSE_CALLS = Table(
    "false_calls",
    "one row per set-up, number of frames and role of the board",
    (
        *(*COMMON[:2], *ROLE),
        *_columns(
            runs="runs judged at a threshold",
            false_calls="false calls",
            threshold="mean threshold",
            threshold_mm="mean of threshold times scale",
            surface_noise_mm="mean deviation from the fitted surface",
            quiet_runs="hole-free runs",
            quiet_highest="highest of their quiet thresholds",
            per_run="false calls a run, with Garwood's interval (per_run_low, per_run_high)",
            per_run_low="lower end",
            per_run_high="upper end",
        ),
    ),
)
SET_UPS = Table(
    "set_ups",
    "one row per set-up and number of frames: holes found, errors of size and place, noise, threshold",
    (
        *COMMON[:2],
        *_columns(
            holes="holes",
            repeats="repeats",
            found="holes found",
            undecided="holes undecided",
            limit_mm="smallest diameter from which on all are found",
            half_mm="50 % size, with its interval (half_low_mm, half_high_mm)",
            temporal_mm="temporal noise of the averaged z",
            offset_mm="mean error of z",
            pattern_mm="standard deviation over pixels of the mean error",
            surface_mm="robust deviation from the fitted surface",
            threshold="mean threshold",
            threshold_mm="mean of threshold times scale",
            false_calls="false calls on the damaged board",
            runs="runs on it",
            half_low_mm="lower end of its interval",
            half_high_mm="upper end",
            **{
                f"{measure}{of}_{name}": f"{note} of {what} of found holes ({by})"
                for measure, by in (("extent", "the thesis' measure"), ("model", "the model"))
                for of, what in (("", "diameters"), ("_place", "distances from the largest hole"))
                for name, note in (("bias_mm", "mean error"), ("std_mm", "standard deviation"), ("n", "number"))
            },
        ),
        *NOISE.columns[3:],
        *_columns(
            views="of maps: number of views",
            registration="of maps: method of registration",
            merge="of maps: how views are merged",
            place="of maps: values on the other axes",
            is_variation="whether it varies another set-up",
            reference="that set-up",
            views_left_out="of maps: mean number of views left out",
            seconds_map="of maps: median time of making the map",
            surface_std_mm="of maps: standard deviation over runs of the surface's deviation",
        ),
    ),
)
REGISTRATION_ERRORS = Table(
    "registration_errors",
    "one row per method of registration, number of frames and number of views",
    _columns(
        method="method of registration",
        frames="frames averaged",
        views="views of the map",
        n="registrations",
        failed="registrations that failed",
        failed_share="their share",
        failed_low="lower end of Wilson's interval of the share",
        failed_high="upper end",
        reasons="commonest reasons",
        converged_share="share that converged",
        guess_mm="median error of the starting guess",
        seconds="median time",
        iterations="median number of iterations",
        overlap="median share of points with a partner",
        pairs="median number of pairs",
        marks="median number of marks trusted",
        **{
            f"{part}_{name}": f"{note} {where}"
            for part, where in (("in_plane", "in the board's plane"), ("across", "across the plane"))
            for name, note in (
                ("median_mm", "median error"),
                ("q90_mm", "90 % quantile of the error"),
                ("rms_mm", "root mean square error"),
                ("predicted_mm", "error that the covariances predict"),
                ("ratio", "actual over predicted error (1: honest, above: too sure)"),
                ("ratio_low", "lower end of its interval"),
                ("ratio_high", "upper end"),
            )
        },
    ),
)
CLAIMS = Table(
    "claims",
    "one row per claim of the thesis",
    _columns(
        claim="number of the claim",
        text="the claim",
        verdict="borne out, not borne out or undecided",
        evidence="numbers behind the verdict",
        rule="criterion fixed beforehand",
    ),
    formats=("csv",),
)
STORED = (TRIALS, RUNS, PROBES, NOISE, REGISTRATIONS, WALLS, SITES, FINDINGS, OPERATING, PIXELS)
"""Tables of trials in the order in which a sweep writes them."""
STUDY_ONLY = (SITES, FINDINGS, OPERATING, PIXELS)
SUMMARISED = (SUMMARY, NOISE_BY_FRAMES, FALSE_CALLS, SET_UPS, REGISTRATION_ERRORS, CLAIMS)
"""Tables of an experiment that is no study, made of those."""


def _empty() -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame()


@dataclass(frozen=True)
class ResultTables:
    """Tables of trials as declared above, ``holes`` being `TRIALS`; a table that an experiment lacks is empty.

    ``variants``: one row per set-up, then per variation: variant, reason, settings (JSON text), is_variation, reference
    (the set-up to compare with, or empty), switches (JSON text, or empty), and the axes. ``axes``: path, name, unit of
    what tells set-ups apart, in their order.
    """

    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    variants: pd.DataFrame
    noise: pd.DataFrame
    axes: pd.DataFrame
    registrations: pd.DataFrame = field(default_factory=_empty)
    walls: pd.DataFrame = field(default_factory=_empty)
    sites: pd.DataFrame = field(default_factory=_empty)
    findings: pd.DataFrame = field(default_factory=_empty)
    operating: pd.DataFrame = field(default_factory=_empty)
    pixels: pd.DataFrame = field(default_factory=_empty)

    def stored(self) -> dict[Table, pd.DataFrame]:
        """Return the tables that are written, in their order."""
        return {table: getattr(self, "holes" if table is TRIALS else table.name) for table in STORED}
