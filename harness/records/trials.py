"""Tables of trials: the measurements of each trial, whose columns are the fields of the classes in
`harness.records.rows`, and summaries of experiments that are not studies.

The columns of summaries declare a name and a note; their values come from `harness.evaluation`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from harness.records import outputs
from harness.records.rows import (
    DamageRow,
    FindingRow,
    NoiseRow,
    OperatingRow,
    PixelsRow,
    ProbeRow,
    RegistrationRow,
    RunRow,
    SiteRow,
)
from harness.records.schema import Column, Table, declared_columns
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
    if share is None or math.isnan(share):
        return text.UNKNOWN_TEXT
    return f"{100 * share:.0f} %"


def _word(name: str | None) -> str:
    return name or "as declared"


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

TRIALS = Table(
    "trials",
    "one row per trial on a damaged board and damage",
    declared_columns(DamageRow),
    order=("variant", "frames", "board", "repeat", "true_diameter_mm", "hole"),
    formats=("parquet",),
    always=True,
)
RUNS = Table(
    "runs",
    "one row per trial",
    declared_columns(RunRow),
    order=("variant", "role", "frames", "board", "repeat"),
    formats=("parquet",),
    always=True,
)
PROBES = Table(
    "probes",
    "one row per set-up, number of frames and sample pixel, over the hole-free repeats",
    declared_columns(ProbeRow),
    order=("variant", "frames", "pixel"),
    formats=("parquet",),
)
NOISE = Table(
    "noise",
    "one row per hole-free trial of a single view: noise and pixels on an undamaged board",
    declared_columns(NoiseRow),
    order=("variant", "frames", "repeat"),
)
REGISTRATIONS = Table(
    "registrations",
    "one row per registration of a view; registrations that set-ups share are under the first "
    "of them",
    declared_columns(RegistrationRow),
    order=("variant", "role", "frames", "repeat", "view"),
)
SITES = Table(
    "sites",
    "one row per repeat and place on a hole-free board from which the damage was left out",
    declared_columns(SiteRow),
    order=("variant", "frames", "board", "repeat", "true_diameter_mm", "hole"),
    formats=("parquet",),
)
FINDINGS = Table(
    "findings",
    "one row per finding on a study's boards",
    declared_columns(FindingRow),
    order=("variant", "frames", "role", "board", "repeat"),
    formats=("parquet",),
)
OPERATING = Table(
    "operating",
    "one row per trial of a study and threshold of a grid, besides the threshold in use",
    declared_columns(OperatingRow),
    order=("variant", "frames", "role", "board", "repeat"),
    formats=("parquet",),
    lists=("threshold", "findings", "hits"),
)
PIXELS = Table(
    "pixels",
    "one row per trial on a study's damaged boards, damage, and threshold on a finer grid",
    declared_columns(PixelsRow),
    order=("variant", "frames", "board", "repeat"),
    formats=("parquet",),
    lists=("threshold", "above"),
)
STORED = (TRIALS, RUNS, PROBES, NOISE, REGISTRATIONS, SITES, FINDINGS, OPERATING, PIXELS)
STUDY_ONLY = (SITES, FINDINGS, OPERATING, PIXELS)
SET_UP = (TRIALS.column("variant"), TRIALS.column("frames"))
TRUTH = tuple(
    TRIALS.column(name)
    for name in (
        "kind",
        "true_diameter_mm",
        "true_depth_mm",
        "seen_depth_mm",
        "true_x_mm",
        "true_y_mm",
        "true_offset_mm",
    )
)


def _mean(kind: str, label: str) -> Column:
    """Return a column for pages with a mean and its standard deviation."""

    def mean(row: Mapping[str, Any]) -> str:
        return text.plus_minus(row[f"{kind}_mean_mm"], row[f"{kind}_std_mm"])

    return Column("", label, mean)


def _error(kind: str, label: str) -> Column:
    """Return a column for pages with a mean error, its standard deviation and the number of
    values."""

    def error(row: Mapping[str, Any]) -> str:
        count = int(row[f"{kind}_n"])
        if not count:
            return "–"
        mean = text.plus_minus(row[f"{kind}_bias_mm"], row[f"{kind}_std_mm"], "+")
        return f"{mean} ({count})"

    return Column("", label, error)


def _holes_found(row: Mapping[str, Any]) -> Cell:
    """Return the number of holes found, and their names if there are few enough to read."""
    lists_names = row["holes"] <= MOST_NAMES
    words = []
    if lists_names:
        words.append(hole_list(row["found"]))
    if row["undecided"]:
        undecided = hole_list(row["undecided"]) if lists_names else str(len(row["undecided"]))
        words.append(f"undecided {undecided}")
    count = len(row["found"])
    share = f"{count} of {row['holes']}"
    return Cell(f"{share}\n{'; '.join(words)}".strip(), share=count / row["holes"])


def hole_list(names: Iterable[str]) -> str:
    """Return hole names as text, runs of numbers joined: ``4–7, 9``; ``none``."""
    all_names = [str(name) for name in names]
    numbered = sorted(int(name) for name in all_names if name.isdecimal())
    runs: list[list[int]] = []
    for number in numbered:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    parts = [str(run[0]) if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs]
    parts += [name for name in all_names if not name.isdecimal()]
    return ", ".join(parts) or "none"


def _false_calls(row: Mapping[str, Any]) -> str:
    """Return the number of false calls in a number of runs."""
    if not row["runs"] > 0:
        return "–"
    return f"{row['false_calls']:.0f} in {row['runs']:.0f}"


MOST_NAMES = 15  # most holes that a cell lists by name; for more holes it gives only the number
CALLS_OF = Column("", "false calls", _false_calls)
SUMMARY = Table(
    "summary",
    "one row per set-up, number of frames and damage, with 95 % intervals; means are over the "
    "trials that detected it",
    (
        *SET_UP,
        Column("hole", "hole", note="number of the damage"),
        *(
            replace(column, label="true (mm)") if column.name == "true_diameter_mm" else column
            for column in TRUTH
        ),
        *_columns(n="number of trials", detected="number of trials that detected it"),
        Column(
            "rate", note="share of trials that detected it, with Wilson's interval", interval=True
        ),
        *_columns(
            status="found, missed or undecided: the interval lies above, lies below or contains 0.5"
        ),
        *_columns(
            margin_mean="highest score within the hit radius over the threshold: mean of trials",
            margin_lowest="its lowest value",
            margin_highest="its highest value",
        ),
        _mean("extent_diameter", "extent (mm)"),
        _mean("model_diameter", "model (mm)"),
        *(
            Column(f"{k}_{name}", note=f"{note} ({estimator})")
            for k, estimator in BY
            for name, note in STATISTICS.items()
        ),
        *(
            Column(
                f"{k}_bias_mm",
                note=f"mean diameter minus true diameter ({estimator})",
                interval=True,
            )
            for k, estimator in BY
        ),
        *(
            Column(
                f"{k}_error_mean_mm",
                f"centre off, {k} (mm)",
                note=f"mean error of place ({estimator})",
            )
            for k, estimator in BY
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
        TRIALS.column("variant"),
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
        Column(
            "role", "board", note=RUNS.column("role").note, text=lambda role: role.replace("_", "-")
        ),
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
    "one row per set-up and number of frames: holes found, errors of size and place, noise, "
    "threshold",
    (
        Column("variant", "set-up", None, "name of the set-up", in_words),
        Column("registration", "registration", note="maps: method of registration", text=_word),
        Column("merge", "merge", note="maps: how views are merged", text=_word),
        Column("views", "views", note="maps: number of views"),
        Column("frames", "frames", note="number of averaged frames"),
        *_columns(holes="number of holes", repeats="number of repeats"),
        *_columns(found="numbers of the holes found", undecided="numbers of the undecided holes"),
        Column("", "found", _holes_found),
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
        Column("valid_share", "valid", note=NOISE.column("valid_share").note, text=_percent),
        *(NOISE.column(name) for name in PITCH),
        replace(NOISE.column("single_frame_mm"), label="one frame (mm)"),
        Column("temporal_mm", "average (mm)", None, "temporal noise of the averaged z", _fine),
        Column("offset_mm", "offset (mm)", None, "mean error of z", _fine),
        Column(
            "pattern_mm",
            "pattern (mm)",
            None,
            "standard deviation over pixels of the mean error",
            _fine,
        ),
        *(column for column in NOISE.columns if column.name.startswith("correlation_")),
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
    "one row per set-up and per value of an axis: how well it agrees with the thesis' result "
    "(from 20 set-ups on)",
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
        *_columns(
            posterior_low="lower end of its interval over set-ups, at 95 % for all values jointly; "
            "empty for a set-up",
            posterior_high="upper end of that interval",
        ),
    ),
    formats=("csv",),
    left=2,
)
EFFECTS = Table(
    "effects",
    "one row per effect, condition and number of frames of an experiment with `switches`: the "
    "effect's loss",
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
            note=(
                "whether both sizes lie within the range inspected; otherwise the loss is a bound"
            ),
        ),
    ),
)
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
    """Tables of trials as declared above. A table that an experiment lacks is empty."""

    holes: pd.DataFrame
    """`TRIALS`: one row for each trial on a damaged board and damage."""
    runs: pd.DataFrame
    """`RUNS`: one row for each trial."""
    probes: pd.DataFrame
    """`PROBES`: one row for each set-up, number of frames and sample pixel."""
    variants: pd.DataFrame
    """One row for each set-up and then for each variation: variant, reason, settings,
    is_variation, reference, switches, and the axes."""
    noise: pd.DataFrame
    """`NOISE`: one row for each hole-free trial of a single view."""
    axes: pd.DataFrame
    """Path, name and unit of every axis on which set-ups differ, in order."""
    registrations: pd.DataFrame = field(default_factory=_empty)
    """`REGISTRATIONS`: one row for each registration of a view."""
    sites: pd.DataFrame = field(default_factory=_empty)
    """`SITES`: one row for each repeat and place on a hole-free board."""
    findings: pd.DataFrame = field(default_factory=_empty)
    """`FINDINGS`: one row for each finding of a study."""
    operating: pd.DataFrame = field(default_factory=_empty)
    """`OPERATING`: one row for each trial of a study."""
    pixels: pd.DataFrame = field(default_factory=_empty)
    """`PIXELS`: one row for each trial of a study and damage, and for the intact face."""

    def of(self, variant: str, frames: int) -> ResultTables:
        """Return the rows of one set-up."""
        selected = {}
        for name, table in vars(self).items():
            if {"variant", "frames"} <= set(table.columns):
                is_own = (table["variant"] == variant) & (table["frames"] == frames)
                selected[name] = table[is_own]
        return replace(self, **selected)

    def stored(self) -> dict[Table, pd.DataFrame]:
        """Return the tables that are written to files, in order."""
        tables = {}
        for table in STORED:
            tables[table] = getattr(self, "holes" if table is TRIALS else table.name)
        return tables


# ---------------------------------------------------------------- real captures

FINDINGS_VERSION = 5
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
        Column("diameter_mm", "", "diameter_mm", "diameter of the mouth, averaged over shapes"),
        Column("diameter_se_mm", "", "diameter_se_mm", "its standard error"),
        Column("depth_mm", "", "depth_mm", "depth normal to the surface; negative for a bump"),
        Column("depth_se_mm", "", "depth_se_mm", "its standard error"),
        Column(
            "sight_depth_mm",
            "",
            "sight_depth_mm",
            "depth along the line of sight; negative for a bump",
        ),
        Column(
            "shape",
            "",
            "shape",
            "disc, cap, bowl, slot, ragged (no shape fits), or empty if the blur hides it",
        ),
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
            "length_se_mm",
            "",
            "length_se_mm",
            "standard error of the length of a fitted slot; empty for other shapes",
        ),
        Column("width_se_mm", "", "width_se_mm", "standard error of its width"),
        Column("angle_se_deg", "", "angle_se_deg", "standard error of its angle"),
        Column(
            "noise_probability",
            "",
            "noise_probability",
            "probability that it is a false call; empty if the capture sets no threshold itself",
        ),
        Column(
            "certainty",
            "",
            "certainty",
            "sure; doubtful (noise may explain it); rim or blind (its rest was not seen, or no"
            " light came back); feature (joints, no damage)",
        ),
        Column(
            "flags",
            "",
            "flags",
            "remarks, separated by spaces: faint, at_rim, open_behind, size_from_contour,"
            " size_from_extent, depth_at_least, depth_open, depth_from_extreme"
            " (docs/recordings.md)",
        ),
        Column(
            "term",
            "",
            "term",
            "hole; dent (a floor was seen, less deep than a quarter of the width); hole or dent"
            " (too narrow to see a floor); slot (long); joints (slots that repeat); bump; no"
            " return",
        ),
        Column("count", "", "count", "number of places: of joints, all that are alike; else 1"),
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
