"""Residuals as the matched filters judge them: in deviations of the noise nearby, without what the
target's rim shares, with the noise's covariance and the variances that the rim adds."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numba
import numpy as np

from detectors.findings import whitening
from detectors.findings.rim import rim_variances
from detectors.methods import local
from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import outline_depth_px
from detectors.pixels.noise import median_of

SHORT_PX = 13
"""Width over which noise is compared between pixels: wider filters count there as much as
elsewhere."""
QUIET_SIGMAS = 4.0  # larger residuals and their neighbours do not count for the covariance
RIM_PX = 6  # depth of the target's rim, to which the camera's window and lens reach over its edge
LAYER_PX = 4  # side of the squares in which what the rim shares is averaged
MODEST_SIGMAS = local.LEVEL_SIGMAS  # limit to which residuals are clipped there


class Residuals(NamedTuple):
    """A picture of residuals in units of the local noise."""

    values: np.ndarray
    """(r, c) float32: residuals in units of the noise nearby, reduced where a point's own variance
    is larger, minus what they share along the outline."""
    is_known: np.ndarray
    """(r, c) bool."""
    depth_px: np.ndarray
    """(r, c): distance of each pixel from the outline of the known ones."""
    unit_m: np.ndarray
    """(r, c): the unit, metres."""


def in_deviations(
    residual_m: np.ndarray,
    weights: np.ndarray,
    rounding_m2: tuple[float, float],
) -> Residuals:
    """Return residuals (r, c) with weights (r, c), 0 where unknown, in units of the noise nearby,
    which is at least that of rounding."""
    is_known = weights > 0
    floor_m = max(float(np.sqrt(sum(rounding_m2))), 1e-9)
    values = np.where(is_known, residual_m * np.sqrt(weights), 0.0).astype(np.float32)
    # structure wider than a filter's window, objects and the surface's misfit are not noise of
    # pixels
    side = (SHORT_PX, SHORT_PX)
    total = cv2.blur(values, side, borderType=cv2.BORDER_REFLECT)
    count = cv2.blur(is_known.astype(np.float32), side, borderType=cv2.BORDER_REFLECT)
    short = values - total / np.maximum(count, np.float32(1e-6))
    short[~is_known] = np.nan
    step = max(1, np.count_nonzero(is_known) // 65536)
    short_size = median_of(np.abs(short[is_known][::step]))
    size = median_of(np.abs(values[is_known][::step]))
    share = short_size / max(size, 1e-12)
    unit_m = np.maximum(local.local_sigma(short) / max(share, 1e-3), floor_m)
    depth_px = outline_depth_px(is_known)
    return Residuals(
        without_rim(values / unit_m, depth_px * is_known),
        is_known,
        depth_px,
        unit_m,
    )


def without_rim(noise: np.ndarray, depth_px: np.ndarray) -> np.ndarray:
    """Return the residuals (r, c) minus what they share, along some 65 pixels, with those at the
    same distance from the outline, beyond what those next to the rim share: subtracting a mean
    would leave a step there. What is subtracted fades inwards, so that it ends without a step, on
    which smooth noise would be found to be damaged; in a picture that is mostly rim it does not,
    as what it left would pass for noise. Pixels whose ``depth_px`` (r, c) is 0 are unknown."""
    noise = noise.astype(np.float32)
    rows = -(-noise.shape[0] // LAYER_PX)
    columns = -(-noise.shape[1] // LAYER_PX)
    total = np.zeros((rows, columns, RIM_PX + 1))
    count = np.zeros((rows, columns, RIM_PX + 1))
    _sum_layers(noise, depth_px, total, count)
    side = 2 * (local.LEAST_WINDOW // LAYER_PX) + 1
    total = cv2.blur(total, (side, side), borderType=cv2.BORDER_CONSTANT)
    count = cv2.blur(count, (side, side), borderType=cv2.BORDER_CONSTANT)
    shared = total / np.maximum(count, 1e-6)
    shared -= shared[..., RIM_PX:]
    fade = 1.0 / RIM_PX if _has_interior(depth_px) else 0.0
    _subtract_layers(noise, depth_px, shared, fade)
    return noise


def _has_interior(depth_px: np.ndarray) -> bool:
    """Return whether most known pixels, whose ``depth_px`` (r, c) is above 0, lie inside the
    rim."""
    return bool(2 * np.count_nonzero(depth_px > RIM_PX) > np.count_nonzero(depth_px > 0))


@numba.njit(**PLAIN)
def _sum_layers(
    noise: np.ndarray,
    depth_px: np.ndarray,
    total: np.ndarray,
    count: np.ndarray,
) -> None:
    """Add clipped residuals to ``total``, and their numbers to ``count`` (r, c, `RIM_PX` + 1), in
    squares of `LAYER_PX`, for each distance from the outline within the rim, and for those next to
    it together."""
    for i in range(noise.shape[0]):
        for j in range(noise.shape[1]):
            if 0 < depth_px[i, j] <= 2 * RIM_PX:
                layer = i // LAYER_PX, j // LAYER_PX, min(int(depth_px[i, j]) - 1, RIM_PX)
                total[layer] += min(max(noise[i, j], -MODEST_SIGMAS), MODEST_SIGMAS)
                count[layer] += 1


@numba.njit(**PLAIN)
def _subtract_layers(
    noise: np.ndarray,
    depth_px: np.ndarray,
    shared: np.ndarray,
    fade: float,
) -> None:
    """Subtract from the rim's residuals what they share (r, c, `RIM_PX` + 1) in their square and
    at their distance: all of it next to the outline, and ``fade`` of it less with each pixel
    farther in."""
    for i in range(noise.shape[0]):
        for j in range(noise.shape[1]):
            if 0 < depth_px[i, j] <= RIM_PX:
                layer = i // LAYER_PX, j // LAYER_PX, min(int(depth_px[i, j]) - 1, RIM_PX)
                kept = 1.0 - fade * (depth_px[i, j] - 1.0)
                noise[i, j] -= np.float32(kept * shared[layer])


def covariance_of(residuals: Residuals) -> np.ndarray:
    """Return the covariance of weak residuals, away from the rim unless most pixels lie there."""
    inner = residuals.is_known
    if _has_interior(residuals.depth_px * residuals.is_known):
        inner = residuals.is_known & (residuals.depth_px > RIM_PX)
    loud = (np.abs(residuals.values) > QUIET_SIGMAS).astype(np.uint8)
    quiet = inner & (cv2.dilate(loud, np.ones((5, 5), np.uint8)) == 0)
    grid = whitening.grid_of(residuals.values.shape)
    return whitening.noise_covariance(residuals.values, quiet, grid)


def rim_of(
    residuals: Residuals,
    covariance: np.ndarray,
    reach_px: float,
    *,
    is_alone: bool,
) -> np.ndarray:
    """Return the variances (n,) that the rim, into which edges reach by ``reach_px``, adds to noise
    of this covariance, by distance from the outline (`rim_variances`)."""
    noise = whitening.filters(covariance, residuals.values.shape)
    depth_px = residuals.depth_px * residuals.is_known
    return rim_variances(residuals.values, depth_px, noise, reach_px, is_alone=is_alone)
