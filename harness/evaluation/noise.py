"""The error of an averaged range split into noise, offset and pattern, and each against the number of frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.intervals import Interval, bootstrap

if TYPE_CHECKING:
    import pandas as pd

BLOCKS = 40
"""Blocks of neighbouring probe pixels that the bootstrap resamples: a camera's filter correlates neighbours, so pixels
are not exchangeable; contiguous blocks far larger than the filter nearly are. 40 of them carry a quantile."""


COLUMNS = ["variant", "frames", "pixels", "repeats", "temporal_rms_mm", "offset_mm", "pattern_mm"]
COLUMNS += ["systematic_mm", "displacement_mm", "total_rms_mm"]


@dataclass(frozen=True)
class FloorFit:
    """``total^2 = white^2 / N + floor^2``: one frame's white noise and what no averaging removes, in mm."""

    white_mm: float
    floor_mm: float

    def at(self, frames: np.ndarray) -> np.ndarray:
        """The fitted total error in mm for numbers of frames."""
        return np.sqrt(self.white_mm**2 / np.asarray(frames, float) + self.floor_mm**2)


@dataclass(frozen=True)
class NoiseLaw:
    """Effect of averaging on each part of the error.

    ``slope``: exponent of the temporal noise against the number of frames (white noise: -0.5), with its interval.
    ``systematic_ratio``: systematic error (offset and pattern) of the longest over the shortest average, interval.
    """

    slope: float
    slope_interval: Interval
    systematic_ratio: float
    systematic_ratio_interval: Interval
    few_frames: int
    many_frames: int
    pixels: int


def noise_against_frames(probes: pd.DataFrame) -> pd.DataFrame:
    """Make one row per (variant, frames): the parts of the error over the probe pixels, in mm.

    ``temporal_rms_mm``: root mean square over pixels of the standard deviation over repeats. ``offset_mm``: mean over
    pixels of the mean error. ``pattern_mm``: standard deviation over pixels of the mean error, less the temporal
    variance that the finite number of repeats leaves in it (temporal^2 / repeats; 0 where that is the greater).
    ``systematic_mm``: offset and pattern together. ``total_rms_mm``: temporal and systematic together.
    ``displacement_mm``: standard deviation over repeats of how the whole cloud is displaced; in no other column.
    ``guide_mm``: the shortest average's temporal noise falling as 1/sqrt(N). Pixels without a value
    are left out, and with them rows that have no pixel (a single repeat has no scatter).
    """
    import pandas as pd

    rows = []
    for (variant, frames), part in probes.groupby(["variant", "frames"], sort=False):
        moments = _moments(part)
        if len(moments):
            mean = moments.mean(axis=0)
            systematic2 = _systematic_variance(mean, len(moments))
            rows.append(
                {
                    "variant": variant,
                    "frames": frames,
                    "pixels": len(moments),
                    "repeats": int(part["repeats"].median()),
                    "temporal_rms_mm": np.sqrt(mean[0]),
                    "offset_mm": mean[1],
                    "pattern_mm": np.sqrt(_pattern_variance(mean, len(moments))),
                    "systematic_mm": np.sqrt(systematic2),
                    "displacement_mm": float(part["displacement_std_mm"].median()),
                    "total_rms_mm": np.sqrt(mean[0] + systematic2),
                }
            )
    table = pd.DataFrame(rows, columns=COLUMNS)
    table = table.sort_values("frames", kind="stable").sort_values("variant", kind="stable", ignore_index=True)
    first = table.groupby("variant")[["frames", "temporal_rms_mm"]].transform("first")
    table["guide_mm"] = first["temporal_rms_mm"] * np.sqrt(first["frames"] / table["frames"])
    return table


def fit_floor(frames: Sequence[int] | np.ndarray, total_rms_mm: Sequence[float] | np.ndarray) -> FloorFit | None:
    """Fit least squares of total^2 on 1/N with both parts non-negative, weighted to equal relative error.

    None below two different numbers of frames (the two parts cannot be told apart).
    """
    from scipy.optimize import nnls

    n, total2 = np.asarray(frames, float), np.asarray(total_rms_mm, float) ** 2
    usable = np.isfinite(total2) & (total2 > 0)
    if len(np.unique(n[usable])) < 2:
        return None
    n, total2 = n[usable], total2[usable]
    design = np.column_stack([1 / n, np.ones_like(n)]) / total2[:, None]
    (white2, floor2), _ = nnls(design, np.ones_like(n))
    return FloorFit(float(np.sqrt(white2)), float(np.sqrt(floor2)))


def noise_law(probes: pd.DataFrame, variant: str) -> NoiseLaw | None:
    """Fit the exponent of the temporal noise and the change of the systematic error, with block-bootstrap intervals.

    Uses the pixels that have a value at every number of frames. None where fewer than two numbers of frames or pixels
    are left, or where the temporal noise is zero.
    """
    rows = probes[probes["variant"] == variant]
    frames = np.array(sorted(rows["frames"].unique()), float)
    if len(frames) < 2:
        return None
    usable = rows[np.isfinite(rows["mean_error_mm"]) & np.isfinite(rows["temporal_std_mm"])]
    present = usable.groupby("pixel")["frames"].nunique()
    common = present.index[present == len(frames)].sort_values()
    parts = [usable[usable["frames"] == n].set_index("pixel").loc[common] for n in frames]
    stacked = np.stack([_moments(part) for part in parts], axis=1)  # (pixels, frames, 4), pixels that have all
    if stacked.shape[0] < 2 or not (stacked[..., 0].mean(axis=0) > 0).all():
        return None
    blocks = min(BLOCKS, stacked.shape[0])
    edges = np.linspace(0, stacked.shape[0], blocks + 1).astype(int)
    sums = np.add.reduceat(stacked, edges[:-1], axis=0)
    counts = np.diff(edges)

    def means(indices: np.ndarray) -> np.ndarray:
        return sums[indices].sum(axis=1) / counts[indices].sum(axis=1)[:, None, None]

    pixels, whole = stacked.shape[0], np.arange(blocks)[None]
    return NoiseLaw(
        slope=float(_slope(means(whole), frames)[0]),
        slope_interval=bootstrap(lambda chosen: _slope(means(chosen), frames), blocks),
        systematic_ratio=float(_systematic_ratio(means(whole), pixels)[0]),
        systematic_ratio_interval=bootstrap(lambda chosen: _systematic_ratio(means(chosen), pixels), blocks),
        few_frames=int(frames[0]),
        many_frames=int(frames[-1]),
        pixels=pixels,
    )


def _moments(part: pd.DataFrame) -> np.ndarray:
    """(pixels, 4): temporal variance, mean error, its square, temporal variance left in the mean error."""
    error, variance = part["mean_error_mm"].to_numpy(float), part["temporal_std_mm"].to_numpy(float) ** 2
    moments = np.stack([variance, error, error**2, variance / part["repeats"].to_numpy(float)], axis=-1)
    return moments[np.isfinite(moments).all(axis=1)]


def _pattern_variance(mean: np.ndarray, pixels: int) -> np.ndarray:
    """Variance over pixels of the mean error, less the leftover temporal variance, from means of `_moments`."""
    unbiased = (mean[..., 2] - mean[..., 1] ** 2) * (pixels / max(pixels - 1, 1))
    return np.maximum(unbiased - mean[..., 3], 0.0)


def _systematic_variance(mean: np.ndarray, pixels: int) -> np.ndarray:
    """Offset^2 + pattern^2 in mm^2."""
    return mean[..., 1] ** 2 + _pattern_variance(mean, pixels)


def _slope(means: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """(resamples,): slope of log temporal rms on log frames from means (resamples, frames, 4)."""
    x = np.log(frames) - np.log(frames).mean()
    y = 0.5 * np.log(means[..., 0])
    return (y @ x) / (x @ x)


def _systematic_ratio(means: np.ndarray, pixels: int) -> np.ndarray:
    """(resamples,): systematic error of the longest over the shortest average; NaN where the latter is 0."""
    systematic = np.sqrt(_systematic_variance(means, pixels))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(systematic[:, 0] > 0, systematic[:, -1] / systematic[:, 0], np.nan)
