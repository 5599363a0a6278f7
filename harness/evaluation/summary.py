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
    "A hole counts as found when the 95 % Wilson interval of its detection rate over the repeats "
    "lies above 0.5, as missed when it lies below, and as undecided otherwise."
)
FEWEST_TRIALS = 4  # 4 of 4 have a Wilson interval from 0.51; with 3 nothing is certain
GROUP = ["variant", "frames", "hole"]
TRUTH_COLUMNS = [column.name for column in TRUTH]


def by_hole(names: pd.Series) -> pd.Series:
    """Return a sort key: holes by number if they have one ("2" before "11"), then the others by
    name."""

    def key(name: Any) -> tuple[int, int, str]:
        return (0, int(name), "") if str(name).isdecimal() else (1, 0, str(name))

    return names.map(key)


def summarise_holes(holes: pd.DataFrame, axes: Sequence[str] = ()) -> pd.DataFrame:
    """Return one row per (variant, frames, hole): counts, rates, sizes and positions, each with
    its interval. ``axes``: columns to keep. ``margin_``: highest score within the hit radius over
    the threshold. ``status`` is by `FOUND_RULE`. ``extent_``: the
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
    certain = [out["rate_low"] > 0.5, out["rate_high"] < 0.5]
    out["status"] = np.select(certain, ["found", "missed"], "undecided")
    out = out.join(_margins(holes))
    for measure in ("extent", "model"):
        out = pd.concat([out, _measured(groups, out, measure)], axis=1)
    out = pd.concat([out, _fitted(holes, out)], axis=1)
    out["median_residual_mm"] = groups["median_residual_mm"].mean()
    out["invalid_fraction"] = groups["invalid_fraction"].mean()
    return out.reset_index().sort_values(GROUP, key=_order, kind="stable").reset_index(drop=True)


def with_columns(holes: pd.DataFrame) -> pd.DataFrame:
    """Return the table of holes, with its columns even if no trial on the damaged board ended."""
    if "hole" in holes:
        return holes
    return holes.reindex(columns=[column.name for column in TRIALS.columns])


def found_rule(trials: int) -> str:
    """Return `FOUND_RULE`, with a remark if the trials are too few to call any hole found."""
    if trials >= FEWEST_TRIALS:
        return FOUND_RULE
    too_few = f"{trials} repeats are too few for either"
    return f"{FOUND_RULE} {too_few}: at least {FEWEST_TRIALS} are needed."


def found_holes(
    summary: pd.DataFrame,
    variant: str,
    frames: int,
) -> dict[str, HoleState]:
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
    judged = runs[runs["threshold"].notna()]
    judged = judged.assign(threshold_mm=judged["threshold"] * judged["scale_mm"])
    out = judged.groupby([*keys, "role"], sort=False, as_index=False).agg(
        runs=("repeat", "size"),
        false_calls=("false_calls", "sum"),
        threshold=("threshold", "mean"),
        threshold_mm=("threshold_mm", "mean"),
        surface_noise_mm=("surface_noise_mm", "mean"),
    )
    hole_free = runs[runs["role"] == "hole_free"].groupby(keys, as_index=False)
    quiet = hole_free.agg(quiet_runs=("repeat", "size"), quiet_highest=("quiet_threshold", "max"))
    out = out.merge(quiet, "left", keys)
    out["false_calls"] = out["false_calls"].astype(int)
    out["per_run"] = out["false_calls"] / out["runs"]
    low, high = intervals.poisson_rate(out["false_calls"], out["runs"])
    out["per_run_low"] = low
    out["per_run_high"] = high
    return out.sort_values([*keys, "role"], key=_order, kind="stable", ignore_index=True)


def _margins(holes: pd.DataFrame) -> pd.DataFrame:
    """Return mean, lowest and highest margin over the trials of each group: the highest score
    within the hit radius over the threshold."""
    margins = holes.assign(margin=holes["signal"] / holes["threshold"])
    groups = margins.groupby(GROUP, sort=False)
    return groups.agg(
        margin_mean=("margin", "mean"),
        margin_lowest=("margin", "min"),
        margin_highest=("margin", "max"),
    )


def _measured(
    groups: Any,
    truth: pd.DataFrame,
    measure: Measure,
) -> pd.DataFrame:
    """Return means, standard deviations and biases of one measure's diameters and offsets."""
    diameter = groups[f"{measure}_diameter_mm"]
    offset = groups[f"{measure}_offset_mm"]
    out: pd.DataFrame = diameter.agg(
        measured="count", diameter_mean_mm="mean", diameter_std_mm="std"
    )
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
    error_mm = (holes["model_diameter_mm"] - holes["true_diameter_mm"]).abs()
    standard_errors = error_mm / holes["model_diameter_se_mm"]
    covered = (standard_errors <= 1.96).astype(float).where(standard_errors.notna())
    groups = holes.assign(covered=covered).groupby(GROUP, sort=False)
    out = groups.agg(
        model_diameter_se_mean_mm=("model_diameter_se_mm", "mean"),
        model_diameter_covered=("covered", "mean"),
        model_depth_mean_mm=("model_depth_mm", "mean"),
        model_depth_std_mm=("model_depth_mm", "std"),
        model_depth_se_mean_mm=("model_depth_se_mm", "mean"),
    )
    out["model_depth_bias_mm"] = out["model_depth_mean_mm"] - truth["seen_depth_mm"]
    return out


def _order(column: pd.Series) -> pd.Series:
    """Return a sort key of one group column: the main variant first, holes by number, frames as
    numbers."""
    if column.name == "hole":
        return by_hole(column)
    if column.name == "variant":
        order = {name: position for position, name in enumerate(dict.fromkeys(column))}
        order[MAIN] = -1
        return column.map(order)
    return column


BLOCKS = 40
"""Blocks of neighbouring probe pixels that the bootstrap resamples: a camera's filter correlates
neighbours, so pixels are not exchangeable, but contiguous blocks far larger than the filter nearly
are. 40 give a quantile."""
COLUMNS = [
    "variant",
    "frames",
    "pixels",
    "repeats",
    "temporal_rms_mm",
    "offset_mm",
    "pattern_mm",
    "systematic_mm",
    "displacement_mm",
    "total_rms_mm",
]


@dataclass(frozen=True)
class NoiseLaw:
    """Effect of averaging."""

    slope: float
    """Exponent of the temporal noise against the number of frames (white noise: -0.5)."""
    slope_interval: Interval
    """Its interval over blocks of pixels."""
    systematic_ratio: float
    """Systematic error (offset and pattern) of the longest over the shortest average."""
    systematic_ratio_interval: Interval
    """Its interval over blocks of pixels."""
    few_frames: int
    """Number of frames of the shortest average."""
    many_frames: int
    """Number of frames of the longest average."""
    pixels: int
    """Number of pixels with a value at every number of frames."""


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
        if not len(moments):
            continue
        mean = moments.mean(axis=0)
        variance = mean[0]
        offset = mean[1]
        pattern2 = float(_pattern_variance(mean, len(moments)))
        row = {
            "variant": variant,
            "frames": frames,
            "pixels": len(moments),
            "repeats": int(part["repeats"].median()),
            "temporal_rms_mm": np.sqrt(variance),
            "offset_mm": offset,
            "pattern_mm": np.sqrt(pattern2),
            "systematic_mm": np.sqrt(offset**2 + pattern2),
            "displacement_mm": float(part["displacement_std_mm"].median()),
            "total_rms_mm": np.sqrt(variance + offset**2 + pattern2),
        }
        rows.append(row)
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = table.sort_values("frames", kind="stable")
    table = table.sort_values("variant", kind="stable", ignore_index=True)
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
    (_, floor2), _ = nnls(design, np.ones_like(n))
    return float(np.sqrt(floor2))


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
    # (pixels, frames, 4), only pixels that have all
    stacked = np.stack([_moments(part) for part in parts], axis=1)
    pixels = len(stacked)
    if pixels < 2 or not (stacked[..., 0].mean(axis=0) > 0).all():
        return None
    blocks = min(BLOCKS, pixels)
    edges = np.linspace(0, pixels, blocks + 1).astype(int)
    sums = np.add.reduceat(stacked, edges[:-1], axis=0)
    counts = np.diff(edges)
    x = np.log(frames) - np.log(frames).mean()

    def means(indices: np.ndarray) -> np.ndarray:
        """Return mean moments (draws, frames, 4) over the blocks ``indices`` (draws, blocks)."""
        return np.asarray(sums[indices].sum(axis=1) / counts[indices].sum(axis=1)[:, None, None])

    def slope(indices: np.ndarray) -> np.ndarray:
        """Return the slope (draws,) of ln temporal noise over ln frames."""
        return np.asarray((0.5 * np.log(means(indices)[..., 0]) @ x) / (x @ x))

    def ratio(indices: np.ndarray) -> np.ndarray:
        """Return the systematic error of the longest over the shortest average; NaN if the latter
        is 0."""
        mean = means(indices)
        systematic = np.sqrt(mean[..., 1] ** 2 + _pattern_variance(mean, pixels))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(systematic[:, 0] > 0, systematic[:, -1] / systematic[:, 0], np.nan)

    all_blocks = np.arange(blocks)[None]
    return NoiseLaw(
        slope=float(slope(all_blocks)[0]),
        slope_interval=bootstrap(slope, blocks),
        systematic_ratio=float(ratio(all_blocks)[0]),
        systematic_ratio_interval=bootstrap(ratio, blocks),
        few_frames=int(frames[0]),
        many_frames=int(frames[-1]),
        pixels=pixels,
    )


def _moments(part: pd.DataFrame) -> np.ndarray:
    """Return (pixels, 4): temporal variance, mean error, its square, temporal variance left in the
    mean error."""
    error = part["mean_error_mm"].to_numpy(float)
    variance = part["temporal_std_mm"].to_numpy(float) ** 2
    left_over = variance / part["repeats"].to_numpy(float)
    moments = np.stack([variance, error, error**2, left_over], axis=-1)
    return np.asarray(moments[np.isfinite(moments).all(axis=1)])


def _pattern_variance(mean: np.ndarray, pixels: int) -> np.ndarray:
    """Return the variance over pixels of the mean error, minus leftover temporal variance, from
    means of `_moments`."""
    unbiased = (mean[..., 2] - mean[..., 1] ** 2) * (pixels / max(pixels - 1, 1))
    return np.asarray(np.maximum(unbiased - mean[..., 3], 0.0))
