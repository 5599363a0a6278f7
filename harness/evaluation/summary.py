"""Rates, means and intervals of rows per trial, and the error of an averaged range against the
number of frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from scipy.optimize import nnls

from harness.evaluation import intervals
from harness.evaluation.intervals import Interval, bootstrap
from harness.records.trials import TRIALS, TRUTH

HoleState = Literal["found", "missed", "undecided"]
Measure = Literal["extent", "model"]

# the variant that the experiment declares; all others change a fact that the thesis leaves open
MAIN = "main"
FOUND_RULE = (
    "A hole counts as found when the 95 % Wilson interval of its detection rate over the repeats lies above 0.5, "
    "as missed when it lies below, and as undecided otherwise."
)
FEWEST_TRIALS = 4  # 4 of 4 have a Wilson interval from 0.51; with 3 nothing is certain
GROUP = ["variant", "frames", "hole"]
TRUTH_COLUMNS = [column.name for column in TRUTH]


def by_hole(names: pd.Series) -> pd.Series:
    """Return a sort key: holes by number if they have one ("2" before "11"), then the others by
    name."""
    return names.map(
        lambda name: (0, int(name), "") if str(name).isdecimal() else (1, 0, str(name))
    )


def summarise_holes(holes: pd.DataFrame, axes: Sequence[str] = ()) -> pd.DataFrame:
    """Return one row per (variant, frames, hole): counts, rates, sizes and positions, each with
    its interval. ``axes``: columns to keep. ``status`` is by `FOUND_RULE`. ``extent_``: the
    thesis' measure. ``model_``: of the fit; its bias of depth is relative to ``seen_depth_mm``
    (behind a through-hole the backing is visible). ``model_diameter_covered``: share of fits
    within 1.96 standard errors. Means are over detected trials only: the sizes of a hole detected
    in few trials are those of its lucky trials."""
    holes = with_columns(holes)
    groups = holes.groupby(GROUP, sort=False)
    out = groups[[*axes, *TRUTH_COLUMNS]].first()
    out["n"] = groups.size()
    out["detected"] = groups["detected"].sum().astype(int)
    out["rate"] = out["detected"] / out["n"]
    out["rate_low"], out["rate_high"] = intervals.wilson(out["detected"], out["n"])
    out["status"] = np.select(
        [out["rate_low"] > 0.5, out["rate_high"] < 0.5], ["found", "missed"], "undecided"
    )
    for measure in ("extent", "model"):
        out = pd.concat([out, _measured(groups, out, measure)], axis=1)
    out = pd.concat([out, _fitted(holes, out)], axis=1)
    out["median_residual_mm"] = groups["median_residual_mm"].mean()
    out["invalid_fraction"] = groups["invalid_fraction"].mean()
    return out.reset_index().sort_values(GROUP, key=_order, kind="stable").reset_index(drop=True)


def with_columns(holes: pd.DataFrame) -> pd.DataFrame:
    """Return the table of holes, with its columns even if no trial on the damaged board ended."""
    return (
        holes
        if "hole" in holes
        else holes.reindex(columns=[column.name for column in TRIALS.columns])
    )


def found_rule(trials: int) -> str:
    """Return `FOUND_RULE`, with a remark if the trials are too few to call any hole found."""
    if trials >= FEWEST_TRIALS:
        return FOUND_RULE
    return f"{FOUND_RULE} {trials} repeats are too few for either: at least {FEWEST_TRIALS} are needed."


def found_holes(summary: pd.DataFrame, variant: str, frames: int) -> dict[str, HoleState]:
    """Return each hole's status by `FOUND_RULE`, in the holes' order; empty if the variant lacks
    these frames."""
    rows = summary[(summary["variant"] == variant) & (summary["frames"] == frames)]
    return dict(zip(rows["hole"], rows["status"], strict=True))


def false_calls(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row per (variant, frames, role): runs, false calls, and their rate per run with
    Garwood's Poisson interval. Only runs judged at a threshold count. For hole-free runs that set
    it (their threshold is NaN), ``quiet_runs`` is their number and ``quiet_highest`` the highest
    of their quiet thresholds."""
    keys = ["variant", "frames"]
    judged = runs[runs["threshold"].notna()].assign(
        threshold_mm=lambda r: r["threshold"] * r["scale_mm"]
    )
    counts = {"runs": ("repeat", "size"), "false_calls": ("false_calls", "sum")}
    means = ("threshold", "threshold_mm")
    counts |= {name: (name, "mean") for name in (*means, "surface_noise_mm")}
    out = judged.groupby([*keys, "role"], sort=False, as_index=False).agg(**counts)
    quiet = runs[runs["role"] == "hole_free"].groupby(keys, as_index=False)
    out = out.merge(
        quiet.agg(quiet_runs=("repeat", "size"), quiet_highest=("quiet_threshold", "max")),
        "left",
        keys,
    )
    out["false_calls"] = out["false_calls"].astype(int)
    out["per_run"] = out["false_calls"] / out["runs"]
    out["per_run_low"], out["per_run_high"] = intervals.poisson_rate(
        out["false_calls"], out["runs"]
    )
    return out.sort_values([*keys, "role"], key=_order, kind="stable", ignore_index=True)


def _measured(groups: Any, truth: pd.DataFrame, measure: Measure) -> pd.DataFrame:
    """Return means, standard deviations and biases of one measure's diameters and offsets."""
    diameter = groups[f"{measure}_diameter_mm"]
    offset = groups[f"{measure}_offset_mm"]
    out = diameter.agg(measured="count", diameter_mean_mm="mean", diameter_std_mm="std")
    out["bias_mm"] = out["diameter_mean_mm"] - truth["true_diameter_mm"]
    out["bias_low_mm"], out["bias_high_mm"] = intervals.mean_t(
        out["bias_mm"], out["diameter_std_mm"], out["measured"]
    )
    out = out.join(offset.agg(offset_mean_mm="mean", offset_std_mm="std"))
    out["offset_bias_mm"] = out["offset_mean_mm"] - truth["true_offset_mm"]
    out["error_mean_mm"] = groups[f"{measure}_error_mm"].mean()
    return out.add_prefix(f"{measure}_")


def _fitted(holes: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Return depths, which only the model gives, and each fit's stated standard errors, compared
    with the truth."""
    miss = (holes["model_diameter_mm"] - holes["true_diameter_mm"]).abs() / holes[
        "model_diameter_se_mm"
    ]
    covered = (miss <= 1.96).astype(float).where(miss.notna())
    columns = {"model_diameter_se_mean_mm": ("model_diameter_se_mm", "mean")}
    columns |= {"model_diameter_covered": ("covered", "mean")}
    columns |= {f"model_depth_{how}_mm": ("model_depth_mm", how) for how in ("mean", "std")}
    columns |= {"model_depth_se_mean_mm": ("model_depth_se_mm", "mean")}
    out = holes.assign(covered=covered).groupby(GROUP, sort=False).agg(**columns)
    out["model_depth_bias_mm"] = out["model_depth_mean_mm"] - truth["seen_depth_mm"]
    return out


def _order(column: pd.Series) -> pd.Series:
    """Return a sort key of one group column: the main variant first, holes by number, frames as
    numbers."""
    if column.name == "hole":
        return by_hole(column)
    if column.name == "variant":
        first_seen = {name: place for place, name in enumerate(dict.fromkeys(column))}
        return column.map(lambda name: -1 if name == MAIN else first_seen[name])
    return column


BLOCKS = 40
"""Blocks of neighbouring probe pixels that the bootstrap resamples: a camera's filter correlates
neighbours, so pixels are not exchangeable, but contiguous blocks far larger than the filter nearly
are. 40 give a quantile."""
COLUMNS = ["variant", "frames", "pixels", "repeats", "temporal_rms_mm", "offset_mm", "pattern_mm"]
COLUMNS += ["systematic_mm", "displacement_mm", "total_rms_mm"]


@dataclass(frozen=True)
class NoiseLaw:
    """Effect of averaging. ``slope``: exponent of the temporal noise against the number of frames
    (white noise: -0.5). ``systematic_ratio``: systematic error (offset and pattern) of the longest
    over the shortest average."""

    slope: float
    slope_interval: Interval
    systematic_ratio: float
    systematic_ratio_interval: Interval
    few_frames: int
    many_frames: int
    pixels: int


def noise_against_frames(probes: pd.DataFrame) -> pd.DataFrame:
    """Return one row per (variant, frames): root mean squares over the probe pixels, in mm.
    ``temporal``: deviation over repeats. ``offset``: mean error. ``pattern``: deviation over
    pixels of the mean error, minus the remaining noise of few repeats. ``systematic``: offset and
    pattern. ``displacement``: deviation over repeats of the whole cloud, in no other column.
    ``guide``: the shortest average's temporal noise, falling as 1/sqrt(N). Pixels without a value
    are out."""
    rows = []
    for (variant, frames), part in probes.groupby(["variant", "frames"], sort=False):
        moments = _moments(part)
        if len(moments):
            variance, offset, *_ = mean = moments.mean(axis=0)
            pattern2 = float(_pattern_variance(mean, len(moments)))
            repeats = int(part["repeats"].median())
            temporal, systematic, total = np.sqrt(
                [variance, offset**2 + pattern2, variance + offset**2 + pattern2]
            )
            displacement = float(part["displacement_std_mm"].median())
            start = (variant, frames, len(moments), repeats)
            rows.append(
                (*start, temporal, offset, np.sqrt(pattern2), systematic, displacement, total)
            )
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = table.sort_values("frames", kind="stable").sort_values(
        "variant", kind="stable", ignore_index=True
    )
    first = table.groupby("variant")[["frames", "temporal_rms_mm"]].transform("first")
    table["guide_mm"] = first["temporal_rms_mm"] * np.sqrt(first["frames"] / table["frames"])
    return table


def fit_floor(
    frames: Sequence[int] | np.ndarray, total_rms_mm: Sequence[float] | np.ndarray
) -> float:
    """Return the error that averaging cannot remove, in mm, of ``total^2 = white^2 / N +
    floor^2``: least squares with both parts non-negative, weighted for equal relative error. NaN
    below two different numbers of frames."""
    n = np.asarray(frames, float)
    total2 = np.asarray(total_rms_mm, float) ** 2
    usable = np.isfinite(total2) & (total2 > 0)
    if len(np.unique(n[usable])) < 2:
        return np.nan
    n = n[usable]
    total2 = total2[usable]
    design = np.column_stack([1 / n, np.ones_like(n)]) / total2[:, None]
    return float(np.sqrt(nnls(design, np.ones_like(n))[0][1]))


def noise_law(probes: pd.DataFrame, variant: str) -> NoiseLaw | None:
    """Fit the exponent of the temporal noise and the change of the systematic error, with
    block-bootstrap intervals, to pixels that have a value at every number of frames. None below
    two of either, or without temporal noise."""
    rows = probes[probes["variant"] == variant]
    frames = np.array(sorted(rows["frames"].unique()), float)
    if len(frames) < 2:
        return None
    usable = rows[np.isfinite(rows["mean_error_mm"]) & np.isfinite(rows["temporal_std_mm"])]
    present = usable.groupby("pixel")["frames"].nunique()
    common = present.index[present == len(frames)].sort_values()
    parts = [usable[usable["frames"] == n].set_index("pixel").loc[common] for n in frames]
    stacked = np.stack(
        [_moments(part) for part in parts], axis=1
    )  # (pixels, frames, 4), only pixels that have all
    pixels = len(stacked)
    if pixels < 2 or not (stacked[..., 0].mean(axis=0) > 0).all():
        return None
    blocks = min(BLOCKS, pixels)
    edges = np.linspace(0, pixels, blocks + 1).astype(int)
    sums = np.add.reduceat(stacked, edges[:-1], axis=0)
    counts = np.diff(edges)
    x = np.log(frames) - np.log(frames).mean()

    def means(indices: np.ndarray) -> np.ndarray:
        return sums[indices].sum(axis=1) / counts[indices].sum(axis=1)[:, None, None]

    def slope(indices: np.ndarray) -> np.ndarray:
        return (0.5 * np.log(means(indices)[..., 0]) @ x) / (x @ x)

    def ratio(indices: np.ndarray) -> np.ndarray:
        """Return the systematic error of the longest over the shortest average; NaN if the latter
        is 0."""
        mean = means(indices)
        systematic = np.sqrt(mean[..., 1] ** 2 + _pattern_variance(mean, pixels))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(systematic[:, 0] > 0, systematic[:, -1] / systematic[:, 0], np.nan)

    whole = np.arange(blocks)[None]
    exponent = float(slope(whole)[0])
    change = float(ratio(whole)[0])
    intervals = bootstrap(slope, blocks), bootstrap(ratio, blocks)
    return NoiseLaw(
        exponent, intervals[0], change, intervals[1], int(frames[0]), int(frames[-1]), pixels
    )


def _moments(part: pd.DataFrame) -> np.ndarray:
    """Return (pixels, 4): temporal variance, mean error, its square, temporal variance left in the
    mean error."""
    error = part["mean_error_mm"].to_numpy(float)
    variance = part["temporal_std_mm"].to_numpy(float) ** 2
    moments = np.stack(
        [variance, error, error**2, variance / part["repeats"].to_numpy(float)], axis=-1
    )
    return moments[np.isfinite(moments).all(axis=1)]


def _pattern_variance(mean: np.ndarray, pixels: int) -> np.ndarray:
    """Return the variance over pixels of the mean error, minus leftover temporal variance, from
    means of `_moments`."""
    unbiased = (mean[..., 2] - mean[..., 1] ** 2) * (pixels / max(pixels - 1, 1))
    return np.maximum(unbiased - mean[..., 3], 0.0)
