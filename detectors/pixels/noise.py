"""Robust statistics, and the noise of an average: the error that rounding leaves, and the range of
shared noise."""

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from harness.vocabulary.geometry import Cloud, Frame

REACH_FRAMES = 6  # frames that show the range of shared noise
REACH_WINDOW_PX = 384  # side of the window at the centre of the valid pixels
REACH_PIXELS = 5000
"""Least number of pixels valid in two frames: they show a correlation to 0.07 if 25 pixels are
alike."""
FARTHEST_LAG_PX = 30
LONE_LEVEL_PX = 21  # side of the square of the local mean in a single frame
LONE_SIGMAS = 5.0  # deviations that mark an edge there
LONE_MOST_PX = 7
"""Longest lag that is attributed to noise there, and not to a pattern or the surface."""
LONE_OFF_PX = 0.3  # largest distance from the middle of the known pixels around
LEAST_FRAMES = 4  # fewest frames whose scatter shows noise
SCATTER_PX = 7
"""Side of the square of its average: to 12 % from 49 x 3 differences."""
SHARED = 0.1
"""Correlation below which pixels share no noise: a box of b pixels, up to 9, falls below it at lag
b."""


# --- robust statistics ---


def median_of(values: np.ndarray) -> float:
    """Return the median of finite values (n,), n >= 1."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    low, high = np.partition(values, (middle - 1, middle))[middle - 1 : middle + 1]
    return float(0.5 * (low + high))


def quantile_of(values: np.ndarray, share: float) -> float:
    """Return the linearly interpolated quantile of finite values (n,), n >= 1, at this share."""
    rank = share * (len(values) - 1)
    low = int(rank)
    high = min(low + 1, len(values) - 1)
    ordered = np.partition(values, (low, high))
    return float(ordered[low] + (rank - low) * (ordered[high] - ordered[low]))


def sigma_of(values: np.ndarray) -> float:
    """Return the robust standard deviation of finite values (n,) about 0: the median magnitude
    over 0.6745."""
    return median_of(np.abs(values)) / 0.6745


# --- the noise of an average ---


def rounding_left_m2(step_m: float, dither_m2: float) -> float:
    """Return the variance of the fixed pattern that rounding to a step q leaves in an average of
    infinitely many frames. With noise of variance s^2 before it is (q / pi)^2 / 2 * sum_k exp(-4
    pi^2 k^2 s^2 / q^2) / k^2."""
    k = np.arange(1, 200)
    terms = np.exp(-((2.0 * np.pi * k) ** 2) * dither_m2 / step_m**2) / k**2
    left_m2 = (step_m / np.pi) ** 2 / 2.0 * float(terms.sum())
    return min(left_m2, step_m**2 / 12.0)


def rounding_variances(cloud: Cloud, mask: np.ndarray) -> tuple[float, float]:
    """Return the variances that rounding of z leaves in the average where ``mask`` (h, w) is true,
    square metres: of a fixed pattern, which neighbours may share, and of the part that differs
    from pixel to pixel.

    Rounding to a step q errs by q / sqrt(12). Noise before the rounding turns part of that into
    noise, which averages out, and leaves a fixed pattern b^2 (`rounding_left_m2`): b^2 + (q^2 / 12
    - b^2) / n after n frames. The whole error remains if the averaged z still lies on the steps,
    as a median does. Without a step, z counts as float32."""
    z_m = cloud.points_m[..., 2][mask]
    step_m = cloud.z_step_m
    if step_m <= 0:
        step_m = float(np.finfo(np.float32).eps) * float(np.abs(z_m).max())
    whole_m2 = step_m**2 / 12.0
    # the median of an even number of frames may lie on half a step
    steps = z_m[:: max(1, len(z_m) // 1000)] / (0.5 * step_m)
    if cloud.n_frames > 2 and np.mean(np.abs(steps - np.round(steps)) < 0.01) > 0.9:
        return float(whole_m2), 0.0
    variances = cloud.variance_m2[mask]
    variances = variances[np.isfinite(variances)]
    dither_m2 = max(median_of(variances) - whole_m2, 0.0) if len(variances) else 0.0
    fixed_m2 = rounding_left_m2(step_m, dither_m2)
    return fixed_m2, (whole_m2 - fixed_m2) / max(cloud.n_frames, 1)


def rounding_floor(cloud: Cloud, mask: np.ndarray) -> float:
    """Return the standard deviation in metres that rounding leaves in the average: the smallest
    credible scale."""
    return float(np.sqrt(sum(rounding_variances(cloud, mask))))


def average_variance_m2(cloud: Cloud, where: np.ndarray) -> np.ndarray | None:
    """Return the variance (h, w) of the average's z where ``where`` (h, w) is true, from the
    scatter of its frames nearby, or the typical variance if that is unknown. None without a pixel
    grid, with fewer than `LEAST_FRAMES` frames, or if fewer than half of the pixels have a
    scatter."""
    has_scatter = where & np.isfinite(cloud.variance_m2)
    if (
        not cloud.organised
        or cloud.n_frames < LEAST_FRAMES
        or has_scatter.sum() < 0.5 * where.sum()
    ):
        return None
    side = (SCATTER_PX, SCATTER_PX)
    border = cv2.BORDER_CONSTANT
    counts = cv2.blur(has_scatter.astype(np.float64), side, borderType=border)
    scatter = cv2.blur(np.where(has_scatter, cloud.variance_m2, 0.0), side, borderType=border)
    mean = scatter / np.maximum(counts, 1e-9)
    variance = np.where(where & (counts > 0), mean, np.nan) / cloud.n_frames
    typical = median_of(variance[np.isfinite(variance)])
    return np.where(where & np.isnan(variance), typical, variance)


# --- the range of shared noise ---


def noise_reach_px(frames: Sequence[Frame], z_step_m: float) -> float:
    """Return the lag, in pixels, at which neighbours along rows and columns stop sharing noise:
    the median over pairs of successive frames.

    A single frame is judged by its deviations from its local mean, if they exceed the rounding to
    ``z_step_m``. 0 means unknown (no noise beyond rounding, movement, or a curved surface in one
    frame)."""
    pictures = [frame.z_m.astype(np.float64) for frame in frames]
    lags: list[int] = []
    if len(frames) == 1:
        farthest = LONE_MOST_PX
        lags += _lags(_noise_of_one(pictures[0], z_step_m))
    else:
        farthest = FARTHEST_LAG_PX
        for first, second in pairwise(pictures):
            lags += _lags(_noise_of_two(second - first))
    ends = [lag for lag in lags if 0 < lag <= farthest]
    return float(np.median(ends)) if len(ends) > len(lags) / 2 else 0.0


def _lags(noise_and_known: tuple[np.ndarray, np.ndarray] | None) -> list[int]:
    """Return the first unlike lags along rows and along columns; none without noise."""
    if noise_and_known is None:
        return []
    noise, usable = noise_and_known
    return [_first_unlike_lag(noise, usable), _first_unlike_lag(noise.T, usable.T)]


def _window(picture: np.ndarray) -> np.ndarray | None:
    """Return the part of a picture around the centre of its finite pixels; None if they are few."""
    rows, columns = np.isfinite(picture).nonzero()
    if rows.size < REACH_PIXELS:
        return None
    top = max(0, int(np.median(rows)) - REACH_WINDOW_PX // 2)
    first_column = max(0, int(np.median(columns)) - REACH_WINDOW_PX // 2)
    return picture[top : top + REACH_WINDOW_PX, first_column : first_column + REACH_WINDOW_PX]


def _noise_of_two(difference: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the noise (h, w) in the difference of two frames, and where it is known (h, w)."""
    window = _window(difference)
    if window is None:
        return None
    usable = np.isfinite(window)
    largest = 8 * float(np.abs(window[usable]).mean())
    usable &= np.abs(np.nan_to_num(window)) < largest
    return _levelled(window, usable, 2 * FARTHEST_LAG_PX + 1), usable


def _noise_of_one(picture: np.ndarray, z_step_m: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the noise (h, w) of a single frame away from edges, and where it is known (h, w)."""
    window = _window(picture)
    if window is None:
        return None
    usable = np.isfinite(window)
    noise = _levelled(window, usable, LONE_LEVEL_PX)
    sigma = sigma_of(noise[usable])
    # with smaller noise, rounding errors are correlated
    if sigma < 0.5 * z_step_m:
        return None
    usable &= np.abs(noise) < LONE_SIGMAS * sigma
    # where known pixels lie to one side, their mean keeps a part of the surface's tilt
    rows, columns = np.indices(usable.shape, float)
    off_rows = _levelled(rows, usable, LONE_LEVEL_PX)
    off_columns = _levelled(columns, usable, LONE_LEVEL_PX)
    noise = _levelled(window, usable, LONE_LEVEL_PX)
    usable &= np.hypot(off_rows, off_columns) < LONE_OFF_PX
    return noise * usable, usable


def _levelled(
    values: np.ndarray,
    usable: np.ndarray,
    side: int,
) -> np.ndarray:
    """Return the values (h, w) minus their mean over a square of known ones; 0 where unknown."""
    size = (side, side)
    border = cv2.BORDER_CONSTANT
    weight = cv2.boxFilter(usable.astype(np.float64), -1, size, borderType=border)
    total = cv2.boxFilter(np.where(usable, values, 0.0), -1, size, borderType=border)
    return np.where(usable, values - total / np.maximum(weight, 1e-9), 0.0)


def _first_unlike_lag(noise: np.ndarray, usable: np.ndarray) -> int:
    """Return the first lag along rows at which the mean product of noise falls below `SHARED` of
    that at lag 0; 0 if there is none."""

    def product(lag: int) -> float:
        width = noise.shape[1] - lag
        pairs = (usable[:, lag:] & usable[:, :width]).sum()
        return float((noise[:, lag:] * noise[:, :width]).sum()) / max(pairs, 1)

    variance = product(0)
    if not variance > 0:
        return 0
    for lag in range(1, min(FARTHEST_LAG_PX, noise.shape[1])):
        if product(lag) < SHARED * variance:
            return lag
    return 0
