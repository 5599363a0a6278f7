"""Robust statistics, and the noise of an average: the error that rounding leaves, and the range of
shared noise."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
from scipy import ndimage

from detectors.pixels.ordering import values_at_ranks
from harness.vocabulary.geometry import Cloud, Frame

REACH_FRAMES = 6  # frames that show the range of shared noise
REACH_WINDOW_PX = 384  # side of the window at the centre of the valid pixels
REACH_PIXELS = 5000
"""Least number of pixels valid in pairs of frames, summed over all pairs: they show a correlation
to 0.07 if 25 pixels are alike."""
FARTHEST_LAG_PX = 30
LARGEST_NOISE = 8.0
"""Largest difference of two frames, over the mean one, that is noise: 6 deviations."""
LONE_LEVEL_PX = 21  # side of the square of the local mean in a single frame
LONE_SIGMAS = 5.0  # deviations that mark an edge there
LONE_MOST_PX = 7
"""Longest lag there up to which noise may lie over a wider pattern."""
LONE_FARTHEST_PX = 15
"""Longest lag of upsampled noise there: wider noise is lost with the local mean."""
LONE_TENT = 0.2
"""Largest difference of upsampled noise's correlation from that of a square of pixels. Native noise
on a wider pattern falls at once and then lingers: it differs by 0.3 and more."""
LONE_OFF_PX = 0.3  # largest distance from the middle of the known pixels around
LONE_FRACTIONS = 20  # parts of a rounding step in which the mean error of rounding is taken
LONE_LEAST_STEPS = 0.2
"""Least scatter there, in rounding steps, that noise before the rounding leaves: 0.24 for a
deviation of 0.1 step."""
WIDEST_NATIVE_PX = 6.5
"""Noise that reaches farther was upsampled, aligned to another camera or smoothed: filters of known
cameras average at most 5 pixels, and a measured reach scatters by one."""
PART_PX = 160
"""Side of the parts of a picture whose noise is compared: 40 to 200 squares of wide noise."""
PHASE_PX = 9  # side of the square of the local mean that shows where between two steps it lies
LEAST_GAIN = 1e-3  # weight up to which terms of the gain of rounding are left out
LEAST_PASSED = 0.25
"""Mean product of two gains below which a correlation is not judged: means half a step apart pass
little of what they share."""
SMALLEST_STEPS = 0.05  # deviation before the rounding below which it leaves no noise
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
    lower, upper = values_at_ranks(values, max(middle - 1, 0), middle)
    if len(values) % 2:
        return float(upper)
    return float(0.5 * (lower + upper))


def quantile_of(values: np.ndarray, share: float) -> float:
    """Return the linearly interpolated quantile of finite values (n,), n >= 1, at this share."""
    rank = share * (len(values) - 1)
    below = int(rank)
    lower, upper = values_at_ranks(values, below, min(below + 1, len(values) - 1))
    return float(lower + (rank - below) * (upper - lower))


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
    exponents = -((2.0 * np.pi * k) ** 2) * dither_m2 / step_m**2
    terms = np.exp(exponents) / k**2
    left_m2 = (step_m / np.pi) ** 2 / 2.0 * float(terms.sum())
    # without noise, the variance of an even distribution over a step
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


def with_noise(cloud: Cloud, frames: Sequence[Frame], z_step_m: float) -> Cloud:
    """Return a cloud with what its first frames show of the noise: how far it reaches
    (`noise_reach_px`), and where depth was upsampled, over which rectangle it is averaged at each
    place (`noise_sides_px`), by the frames that the cloud does not leave out."""
    reach_px = noise_reach_px(frames, z_step_m)
    left_out = {frame.name for frame in cloud.left_out}
    averaged = [frame for frame in frames if frame.name not in left_out]
    sides_px = sides_if_upsampled(averaged, reach_px, z_step_m)
    return replace(cloud, noise_reach_px=reach_px, noise_sides_px=sides_px)


def sides_if_upsampled(
    frames: Sequence[Frame], reach_px: float, z_step_m: float
) -> np.ndarray | None:
    """Return the `noise_sides_px` of at least two frames whose reach shows that they were
    upsampled; None for others."""
    if reach_px <= WIDEST_NATIVE_PX or len(frames) < 2:
        return None
    return noise_sides_px(frames, z_step_m)


def noise_reach_px(frames: Sequence[Frame], z_step_m: float) -> float:
    """Return the lag, in pixels, at which neighbours along rows and columns stop sharing noise:
    the median over pairs of successive frames.

    A single frame is judged by its deviations from its local mean, without what rounding to
    ``z_step_m`` makes of that mean (`reach_of_one`). 0 means unknown (no noise beyond rounding,
    movement, or a pattern or a curved surface in one frame)."""
    pictures = [frame.z_m.astype(np.float64) for frame in frames]
    if len(frames) == 1:
        return reach_of_one(pictures[0], z_step_m)
    lags: list[int] = []
    least_pixels = math.ceil(REACH_PIXELS / max(len(pictures) - 1, 1))
    for first, second in pairwise(pictures):
        lags += _lags(_noise_of_two(second - first, least_pixels))
    ends = [lag for lag in lags if 0 < lag <= FARTHEST_LAG_PX]
    return float(np.median(ends)) if len(ends) > len(lags) / 2 else 0.0


def reach_of_one(picture: np.ndarray, z_step_m: float) -> float:
    """Return the reach that a single picture (h, w) of z shows, in pixels; 0 if it is unknown.

    Lags up to `LONE_MOST_PX` are those of a camera's own pixels, whatever lies below. Where
    correlation goes on, a pattern of the camera or the target's shape may be the reason; upsampled
    depth has no finer noise, so that its correlation falls as that of a square of pixels whose side
    is the sum of the correlation over all lags, in both directions. The shorter side counts, as the
    contours of rounded depth lengthen the other. The local mean takes wide noise with it: 12 pixels
    come out as some 9, and noise below 0.2 rounding steps as half as wide."""
    noise_and_known = _noise_of_one(picture, z_step_m)
    if noise_and_known is None:
        return 0.0
    lags = _lags(noise_and_known)
    ends = [lag for lag in lags if 0 < lag <= LONE_MOST_PX]
    if len(ends) > len(lags) / 2:
        return float(np.median(ends))
    noise, usable = noise_and_known
    sides = [_side_of_tent(noise, usable), _side_of_tent(noise.T, usable.T)]
    return float(round(min(sides)))


def _side_of_tent(noise: np.ndarray, usable: np.ndarray) -> float:
    """Return the side, in pixels, of the square whose mean correlates noise (h, w) along rows like
    this; 0 if none does, or if it is wider than `LONE_FARTHEST_PX`."""
    variance = _mean_product(noise, usable, 0)
    if not variance > 0:
        return 0.0
    lags = np.arange(LONE_LEVEL_PX)
    products = [_mean_product(noise, usable, int(lag)) for lag in lags]
    correlation = np.array(products) / variance
    low = np.flatnonzero(correlation < SHARED)
    end = int(low[0]) if len(low) else len(lags)
    # the correlation of a square of b pixels, 1 - lag / b, adds up to (b + 1) / 2
    side = 2.0 * float(correlation[:end].sum()) - 1.0
    tent = np.maximum(1.0 - lags / max(side, 1.0), 0.0)
    differs = float(np.abs(correlation - tent)[:end].max()) > LONE_TENT
    return 0.0 if differs or side > LONE_FARTHEST_PX else side


def _lags(noise_and_known: tuple[np.ndarray, np.ndarray] | None) -> list[int]:
    """Return the first unlike lags along rows and along columns; none without noise."""
    if noise_and_known is None:
        return []
    noise, usable = noise_and_known
    return [_first_unlike_lag(noise, usable), _first_unlike_lag(noise.T, usable.T)]


def _window(picture: np.ndarray, least_pixels: int = REACH_PIXELS) -> np.ndarray | None:
    """Return the part of a picture around the centre of its finite pixels; None if they are
    fewer than ``least_pixels``."""
    rows, columns = np.isfinite(picture).nonzero()
    if rows.size < least_pixels:
        return None
    top = max(0, int(np.median(rows)) - REACH_WINDOW_PX // 2)
    first_column = max(0, int(np.median(columns)) - REACH_WINDOW_PX // 2)
    return picture[top : top + REACH_WINDOW_PX, first_column : first_column + REACH_WINDOW_PX]


def _noise_of_two(
    difference: np.ndarray, least_pixels: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the noise (h, w) in the difference of two frames, and where it is known (h, w); None
    with fewer than ``least_pixels``."""
    window = _window(difference, least_pixels)
    if window is None:
        return None
    usable = np.isfinite(window)
    largest = LARGEST_NOISE * float(np.abs(window[usable]).mean())
    usable &= np.abs(np.nan_to_num(window)) < largest
    return _levelled(window, usable, 2 * FARTHEST_LAG_PX + 1), usable


def _noise_of_one(picture: np.ndarray, z_step_m: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the noise (h, w) of a single frame away from edges, and where it is known (h, w); None
    where rounding hides it.

    Rounding makes contours of a smooth surface, whose errors are alike along them. This error
    depends on the local mean alone, by its fraction of a step, and is subtracted."""
    window = _window(picture)
    if window is None:
        return None
    usable = np.isfinite(window)
    noise = _levelled(window, usable, LONE_LEVEL_PX)
    sigma = max(sigma_of(noise[usable]), 0.5 * z_step_m)
    usable &= np.abs(noise) < LONE_SIGMAS * sigma
    # where known pixels lie to one side, their mean keeps a part of the surface's tilt
    rows, columns = np.indices(usable.shape, float)
    off_rows = _levelled(rows, usable, LONE_LEVEL_PX)
    off_columns = _levelled(columns, usable, LONE_LEVEL_PX)
    noise = _levelled(window, usable, LONE_LEVEL_PX)
    usable &= np.hypot(off_rows, off_columns) < LONE_OFF_PX
    if usable.sum() < REACH_PIXELS:
        return None
    if z_step_m > 0:
        noise = noise - _rounding_of_means(window - noise, noise, usable, z_step_m)
        if float(np.std(noise[usable])) < LONE_LEAST_STEPS * z_step_m:
            return None
    return noise * usable, usable


def _rounding_of_means(
    means_m: np.ndarray,
    noise_m: np.ndarray,
    usable: np.ndarray,
    z_step_m: float,
) -> np.ndarray:
    """Return the mean noise (h, w) of the usable pixels whose local means (h, w) have the same
    fraction of a step."""
    steps = np.where(usable, means_m, 0.0) / z_step_m
    fractions = ((steps - np.floor(steps)) * LONE_FRACTIONS).astype(np.int64)
    fractions = np.minimum(fractions, LONE_FRACTIONS - 1)
    counts = np.bincount(fractions[usable], minlength=LONE_FRACTIONS)
    sums_m = np.bincount(fractions[usable], noise_m[usable], LONE_FRACTIONS)
    return np.asarray((sums_m / np.maximum(counts, 1))[fractions])


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

    variance = _mean_product(noise, usable, 0)
    if not variance > 0:
        return 0
    for lag in range(1, min(FARTHEST_LAG_PX, noise.shape[1])):
        if _mean_product(noise, usable, lag) < SHARED * variance:
            return lag
    return 0


def _mean_product(noise: np.ndarray, usable: np.ndarray, lag: int) -> float:
    """Return the mean product of noise (h, w) at usable pixels that are ``lag`` apart along
    rows."""
    width = noise.shape[1] - lag
    pairs = (usable[:, lag:] & usable[:, :width]).sum()
    return float((noise[:, lag:] * noise[:, :width]).sum()) / max(pairs, 1)


# --- the range of upsampled noise at each place ---


def noise_sides_px(frames: Sequence[Frame], z_step_m: float) -> np.ndarray | None:
    """Return the sides (2, r, c), along rows and along columns, of the rectangle over which noise
    is averaged in r x c equal parts of a picture; None if a part with enough pixels and all around
    it do not show it. Parts with too few pixels, as beyond the edge of the depth camera's view,
    have the sides of the nearest part.

    Where a camera of another lens was upsampled, its pixels have different widths at each place.
    Successive frames of at least two differ by noise alone. Rounding to ``z_step_m`` makes noise
    look narrower, because it passes a change only where the mean lies between two steps: noise
    before the rounding correlates the rounded one by the product of two `_gains`. Each side is the
    median over the parts around: one part errs by a tenth."""
    pictures = np.stack([frame.z_m.astype(np.float64) for frame in frames])
    mean_m = pictures.mean(axis=0)
    usable = np.isfinite(mean_m)
    local_means_m = mean_m - _levelled(mean_m, usable, PHASE_PX)
    noise_m = np.diff(pictures, axis=0) / np.sqrt(2.0)
    row_parts = _parts(mean_m.shape[0])
    column_parts = _parts(mean_m.shape[1])
    sides_px = np.zeros((2, len(row_parts), len(column_parts)))
    is_filled = np.zeros(sides_px.shape[1:], bool)
    for i, rows in enumerate(row_parts):
        for j, columns in enumerate(column_parts):
            is_filled[i, j] = usable[rows, columns].sum() >= REACH_PIXELS
            if is_filled[i, j]:
                sides_px[:, i, j] = _sides_of_part(
                    noise_m[:, rows, columns],
                    usable[rows, columns],
                    local_means_m[rows, columns],
                    z_step_m,
                )
    sides_px[sides_px == 0.0] = np.nan
    with warnings.catch_warnings():
        # nothing is known around parts far beyond the edge of the depth camera's view
        warnings.simplefilter("ignore", RuntimeWarning)
        smooth_px = ndimage.generic_filter(
            sides_px, np.nanmedian, size=(1, 3, 3), mode="constant", cval=np.nan
        )
    is_unknown = ~np.isfinite(smooth_px).all(axis=0)
    if is_unknown.all() or (is_unknown & is_filled).any():
        return None
    nearest = ndimage.distance_transform_edt(
        is_unknown, return_distances=False, return_indices=True
    )
    return smooth_px[:, *nearest].astype(np.float32)


def noise_sides_at(cloud: Cloud, row: float, column: float) -> tuple[float, float]:
    """Return the sides, along rows and along columns, of the rectangle over which noise is averaged
    at a pixel of a cloud's grid, interpolated between the parts; 0 where they are unknown."""
    if cloud.noise_sides_px is None:
        return cloud.noise_reach_px, cloud.noise_reach_px
    _, rows, columns = cloud.noise_sides_px.shape
    height, width = cloud.points_m.shape[:2]
    part_row = np.array([[(row + 0.5) * rows / height - 0.5]], np.float32)
    part_column = np.array([[(column + 0.5) * columns / width - 0.5]], np.float32)
    border = cv2.BORDER_REPLICATE
    sides_px = []
    for parts_px in cloud.noise_sides_px:
        side_px = cv2.remap(parts_px, part_column, part_row, cv2.INTER_LINEAR, borderMode=border)
        sides_px.append(float(side_px[0, 0]))
    return sides_px[0], sides_px[1]


def _parts(length: int) -> list[slice]:
    """Return the equal parts, of some `PART_PX` pixels, into which a ``length`` is cut."""
    count = max(1, round(length / PART_PX))
    ends = np.round(np.linspace(0, length, count + 1)).astype(int).tolist()
    return [slice(start, end) for start, end in pairwise(ends)]


def _sides_of_part(
    noise_m: np.ndarray,
    usable: np.ndarray,
    local_means_m: np.ndarray,
    z_step_m: float,
) -> tuple[float, float]:
    """Return the sides, along rows and along columns, that the noise (k, h, w) of differences of
    frames shows at usable pixels (h, w); 0 where it shows none. ``local_means_m`` (h, w): before
    the rounding."""
    sizes_m = np.abs(np.where(usable, noise_m, 0.0)).max(axis=0)
    usable = usable & (sizes_m <= LARGEST_NOISE * sizes_m[usable].mean())
    offsets_m = noise_m[:, usable].mean(axis=1)
    centred_m = np.where(usable, noise_m - offsets_m[:, None, None], 0.0)
    rounded_m2 = float(np.square(centred_m[:, usable]).mean())
    variance_m2 = _before_rounding_m2(rounded_m2, z_step_m)
    if variance_m2 <= (SMALLEST_STEPS * z_step_m) ** 2:
        return 0.0, 0.0
    gains = _gains(local_means_m, variance_m2, z_step_m) * usable
    total_m2 = len(centred_m) * variance_m2
    along_rows = _end_of_correlation(centred_m, gains, total_m2)
    along_columns = _end_of_correlation(centred_m.transpose(0, 2, 1), gains.T, total_m2)
    return along_rows, along_columns


def _before_rounding_m2(variance_m2: float, z_step_m: float) -> float:
    """Return the variance of noise before rounding from the mean variance of rounded noise, which
    is s^2 + q^2 / 12 minus the fixed pattern (`rounding_left_m2`); 0 if it is smaller."""
    if z_step_m <= 0:
        return variance_m2
    low_m2 = 0.0
    high_m2 = variance_m2
    for _ in range(30):
        middle_m2 = 0.5 * (low_m2 + high_m2)
        fixed_m2 = rounding_left_m2(z_step_m, middle_m2)
        rounded_m2 = middle_m2 + z_step_m**2 / 12.0 - fixed_m2
        if rounded_m2 > variance_m2:
            high_m2 = middle_m2
        else:
            low_m2 = middle_m2
    return low_m2


def _gains(means_m: np.ndarray, variance_m2: float, z_step_m: float) -> np.ndarray:
    """Return by how much the mean of rounded values changes with that of the values before, whose
    means (h, w) and variance s^2 are known (Bussgang 1952): 1 on average over a step q, and 1 + 2
    sum_k (-1)^k cos(2 pi k mean / q) exp(-2 (pi k s / q)^2)."""
    gains = np.ones(means_m.shape)
    if z_step_m <= 0:
        return gains
    phases_rad = 2.0 * np.pi * np.nan_to_num(means_m) / z_step_m
    factor = np.exp(-2.0 * np.pi**2 * variance_m2 / z_step_m**2)
    k = 1
    weight = factor
    while weight > LEAST_GAIN:
        gains += 2.0 * (-1) ** k * weight * np.cos(k * phases_rad)
        k += 1
        weight = factor ** (k**2)
    return gains


def _end_of_correlation(noise_m: np.ndarray, gains: np.ndarray, total_m2: float) -> float:
    """Return the first lag along rows at which noise (k, h, w), over the product of the gains (h,
    w), correlates less than `SHARED`; 0 if there is none. Lags are left out at which rounding
    passes less than `LEAST_PASSED` of the correlation. ``total_m2``: k times the variance before
    the rounding."""
    width = noise_m.shape[2]
    usable = gains != 0.0
    for lag in range(1, min(FARTHEST_LAG_PX, width)):
        first = slice(0, width - lag)
        second = slice(lag, width)
        pairs = int((usable[:, second] & usable[:, first]).sum())
        product_m2 = float(np.einsum("kij,kij->", noise_m[..., second], noise_m[..., first]))
        passed = float(np.einsum("ij,ij->", gains[:, second], gains[:, first]))
        is_judged = passed >= LEAST_PASSED * pairs
        if is_judged and product_m2 < SHARED * total_m2 * passed:
            return float(lag)
    return 0.0
