"""Robust statistics, and the noise of an average: the error that rounding leaves, and the range of
shared noise."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from harness.vocabulary.geometry import Cloud, Frame

REACH_FRAMES = 6
REACH_WINDOW_PX = 384
REACH_PIXELS = 5000
FARTHEST_LAG_PX = 30
"""Number of frames used; side of the window at the centre of the valid pixels; least number of
pixels valid in two frames: they show a correlation to 0.07 if 25 pixels are alike."""
LONE_LEVEL_PX = 21
LONE_SIGMAS = 5.0
LONE_MOST_PX = 7
LONE_OFF_PX = 0.3
"""Side of the square of the local mean in a single frame; deviations that mark an edge; longest
lag that is attributed to noise and not to a pattern or the surface; largest distance from the
middle of the known pixels around."""
LEAST_FRAMES = 4
SCATTER_PX = 7
"""Fewest frames whose scatter shows noise; side of the square of its average: to 12 % from 49 x 3
differences."""
# correlation below which pixels share no noise: a box of b pixels, up to 9, falls below it at lag
# b
SHARED = 0.1


def median_of(values: np.ndarray) -> float:
    """Return the median of finite values (n,), n >= 1."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    low, high = np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1]
    return float(0.5 * (low + high))


def quantile_of(values: np.ndarray, share: float) -> float:
    """Return the linearly interpolated quantile of finite values (n,), n >= 1, at this share."""
    place = share * (len(values) - 1)
    low = int(place)
    high = min(int(place) + 1, len(values) - 1)
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + (place - low) * (ordered[high] - ordered[low]))


def sigma_of(values: np.ndarray) -> float:
    """Return the robust standard deviation of finite values (n,) about 0: the median magnitude
    over 0.6745."""
    return median_of(np.abs(values)) / 0.6745


def rounding_left_m2(step_m: float, dither_m2: float) -> float:
    """Return the variance of the fixed pattern that rounding to a step q leaves in an average of
    infinitely many frames. With noise of variance s^2 before it is (q / pi)^2 / 2 * sum_k exp(-4
    pi^2 k^2 s^2 / q^2) / k^2."""
    k = np.arange(1, 200)
    left = (
        (step_m / np.pi) ** 2
        / 2.0
        * float((np.exp(-((2.0 * np.pi * k) ** 2) * dither_m2 / step_m**2) / k**2).sum())
    )
    return min(left, step_m**2 / 12.0)


def rounding_variances(cloud: Cloud, mask: np.ndarray) -> tuple[float, float]:
    """Return the variances that rounding of z leaves in the average where ``mask`` (h, w) is true,
    square metres: of a fixed pattern, which neighbours may share, and of the part that differs
    from pixel to pixel.

    Rounding to a step q errs by q / sqrt(12). Noise before the rounding turns part of that into
    noise, which averages out, and leaves a fixed pattern b^2 (`rounding_left_m2`): b^2 + (q^2 / 12
    - b^2) / n after n frames. The whole error remains if the averaged z still lies on the steps,
    as a median does. Without a step, z counts as float32."""
    z = cloud.points_m[..., 2][mask]
    step = (
        cloud.z_step_m
        if cloud.z_step_m > 0
        else float(np.finfo(np.float32).eps) * float(np.abs(z).max())
    )
    whole = step**2 / 12.0
    # the median of an even number of frames may lie on half a step
    some = z[:: max(1, len(z) // 1000)] / (0.5 * step)
    if cloud.n_frames > 2 and np.mean(np.abs(some - np.round(some)) < 0.01) > 0.9:
        return float(whole), 0.0
    variances = cloud.variance_m2[mask]
    variances = variances[np.isfinite(variances)]
    dither = max(median_of(variances) - whole, 0.0) if len(variances) else 0.0
    fixed = rounding_left_m2(step, dither)
    return fixed, (whole - fixed) / max(cloud.n_frames, 1)


def average_variance_m2(cloud: Cloud, where: np.ndarray) -> np.ndarray | None:
    """Return the variance (h, w) of the average's z where ``where`` (h, w) is true, from the
    scatter of its frames nearby, or the typical variance if that is unknown. None without a pixel
    grid, with fewer than `LEAST_FRAMES` frames, or if fewer than half of the pixels have a
    scatter."""
    seen = where & np.isfinite(cloud.variance_m2)
    if not cloud.organised or cloud.n_frames < LEAST_FRAMES or seen.sum() < 0.5 * where.sum():
        return None
    side = (SCATTER_PX, SCATTER_PX)
    known = cv2.blur(seen.astype(np.float64), side, borderType=cv2.BORDER_CONSTANT)
    scatter = cv2.blur(np.where(seen, cloud.variance_m2, 0.0), side, borderType=cv2.BORDER_CONSTANT)
    variance = (
        np.where(where & (known > 0), scatter / np.maximum(known, 1e-9), np.nan) / cloud.n_frames
    )
    return np.where(
        where & np.isnan(variance), median_of(variance[np.isfinite(variance)]), variance
    )


def rounding_floor(cloud: Cloud, mask: np.ndarray) -> float:
    """Return the standard deviation in metres that rounding leaves in the average: the smallest
    credible scale."""
    return float(np.sqrt(sum(rounding_variances(cloud, mask))))


def noise_reach_px(frames: Sequence[Frame], z_step_m: float) -> float:
    """Return the lag, in pixels, at which neighbours along rows and columns stop sharing noise:
    the median over pairs of successive frames. A single frame is judged by its deviations from its
    local mean, if they exceed the rounding to ``z_step_m``. 0 means unknown (no noise beyond
    rounding, movement, or a curved surface in one frame)."""
    lags: list[int] = []
    lone = len(frames) == 1
    pictures = [frame.z_m.astype(np.float64) for frame in frames]
    for difference in (
        pictures if lone else [second - first for first, second in pairwise(pictures)]
    ):
        rows, columns = np.isfinite(difference).nonzero()
        if rows.size < REACH_PIXELS:
            continue
        top = max(0, int(np.median(rows)) - REACH_WINDOW_PX // 2)
        left = max(0, int(np.median(columns)) - REACH_WINDOW_PX // 2)
        difference = difference[top : top + REACH_WINDOW_PX, left : left + REACH_WINDOW_PX]
        known = np.isfinite(difference)
        if lone:
            noise = _levelled(difference, known, LONE_LEVEL_PX)
            if (
                sigma := sigma_of(noise[known])
            ) < 0.5 * z_step_m:  # with smaller noise, rounding errors are correlated
                continue
            known &= np.abs(noise) < LONE_SIGMAS * sigma
            # where known pixels lie to one side, their mean keeps a part of the surface's tilt
            off = (
                _levelled(places, known, LONE_LEVEL_PX) for places in np.indices(known.shape, float)
            )
            noise = _levelled(difference, known, LONE_LEVEL_PX)
            known &= np.hypot(*off) < LONE_OFF_PX
            noise *= known
        else:
            known &= np.abs(np.nan_to_num(difference)) < 8 * float(np.abs(difference[known]).mean())
            noise = _levelled(difference, known, 2 * FARTHEST_LAG_PX + 1)
        lags += [_first_unlike_lag(noise, known), _first_unlike_lag(noise.T, known.T)]
    ends = [lag for lag in lags if 0 < lag <= (LONE_MOST_PX if lone else FARTHEST_LAG_PX)]
    return float(np.median(ends)) if len(ends) > len(lags) / 2 else 0.0


def _levelled(values: np.ndarray, known: np.ndarray, side: int) -> np.ndarray:
    """Return the values (h, w) minus their mean over a square of known ones; 0 where unknown."""
    weight = cv2.boxFilter(
        known.astype(np.float64), -1, (side, side), borderType=cv2.BORDER_CONSTANT
    )
    total = cv2.boxFilter(
        np.where(known, values, 0.0), -1, (side, side), borderType=cv2.BORDER_CONSTANT
    )
    return np.where(known, values - total / np.maximum(weight, 1e-9), 0.0)


def _first_unlike_lag(noise: np.ndarray, known: np.ndarray) -> int:
    """Return the first lag along rows at which the mean product of noise falls below `SHARED`; 0
    if there is none."""

    def product(lag: int) -> float:
        width = noise.shape[1] - lag
        return float((noise[:, lag:] * noise[:, :width]).sum()) / max(
            (known[:, lag:] & known[:, :width]).sum(), 1
        )

    variance = product(0)
    lags = range(1, min(FARTHEST_LAG_PX, noise.shape[1]) if variance > 0 else 1)
    return next((lag for lag in lags if product(lag) < SHARED * variance), 0)
