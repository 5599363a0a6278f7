"""Holes, dents and bumps by a bank of matched filters on whitened noise.

The residuals' autocovariance, temporal noise and fixed pattern together, is measured on the capture itself, off what
stands out, or learned from hole-free clouds. Each template t (discs of several radii through a camera's window or lens,
slots at several angles, dents) is then compared with the residuals r under that covariance C, restricted to the pixels
that are known:

    score = t' C^-1 r / sqrt(t' C^-1 t)

which has the deviation 1 where there is no damage, whatever the noise's spectrum. C^-1 r is solved for by conjugate
gradients, so missing pixels and borders add nothing and need no filling. Background structure that is not damage is
part of the covariance, and counts as little as its power demands.

What stands out strongly is taken out (its pixels count as unknown) and the rest is judged again, so that no filter
sees the shoulder of a neighbour's hole. What pixels along the target's outline share is subtracted: what lies behind
the edge, and light from beside, have a part in them. Depth that was upsampled, so that its noise reaches beyond a
camera's window, is judged on squares of pixels in which it does not.

Not modelled: slots that no template fits, but for what they have in common with one; slots within `RIM_PX` of outlines
and of what was taken out; templates' distortion where a surface is steep; missing returns but for the few that are no
findings by themselves (`detectors.missing`). Tails that are heavier than Gaussian scale the narrow templates' scores as
a whole. The denominator takes the share of a template's whitened energy on known pixels for t' C^-1 t, by a rectangle
that spreads as widely, which is exact where all of the template is seen; places where less than `LEAST_SEEN` of it is
seen are not judged by that template. Scores of slots are taken on every second pixel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import cv2
import numba
import numpy as np
import scipy.fft
from pydantic import model_validator

from detectors.clusters import PLAIN
from detectors.interface import Evidence
from detectors.local import LEVEL_SIGMAS, SADDLE, LocalConfig, LocalDetector, LocalEvidence, LocalPicture, local_sigma
from detectors.masks import grown
from detectors.missing import missing_evidence
from detectors.noise import median_of
from detectors.whitening import (
    ALL_RADII_PX,
    CONVERGED,
    FIRST_SLOT,
    GRID,
    LONGEST_LAG_PX,
    ROUGHLY_CONVERGED,
    WINDOW,
    coarse,
    grid_of,
    halved,
    inverse_times,
    noise_covariance,
    response,
    spectrum,
    worths,
)
from harness.vocabulary.geometry import Cloud

WINDOW_RADII, LEAST_WINDOW = 6, 32
"""Half of the window in which scores are set beside their own scatter: so many radii, and pixels at least."""
SCATTER_SAMPLES = 7
"""Samples from a window's middle to its edge: scores, which templates correlate, tell no more."""
LEAST_SEEN = 0.5
SHORT_PX = 13
"""Width over which noise is compared from place to place: what is wider counts there as much as elsewhere."""
QUIET_SIGMAS = 4.0
"""Pixels beyond it, and their neighbours, do not count for the covariance."""
CLIP_SIGMAS = 5.0
"""Deviations beyond which no single pixel counts for more: a flying pixel alone is no finding."""
STRONG, LOUD_SIGMAS, MARGIN_PX = 6.0, 3.0, 2
"""A peak of this score, with the pixels joined to it that are louder than so many deviations, and those around them, is
taken out before the rest is judged."""
ROUGHLY = (0, 2, 4, 5, 9, 11)
"""Templates that tell what stands out strongly."""
LOUD_SHARE = 0.5
"""The loud pixels at a peak fill at least this share of its template's disc."""
ALONE_PX = 7
"""Half of the square in which a peak is the highest."""
RIM_PX = 6
"""Depth of the target's rim: the camera's window and lens reach so far over its edge."""
LOBE_SHARE = 0.5
"""A score so much smaller than one of the other sign within `RIM_PX` is the lobe that whitening leaves beside
damage."""
WIDE_PX = 6.0
"""Radius from which on noise may break a template's finding into several peaks."""
TAIL_PX, TAIL_SHARE, TAIL_SIGMAS = 1.5, 0.0005, 3.29
"""Radius up to which a template's scores tell their own tail, the share of pixels beyond it on either side, and where
a Gaussian has it. Wider means are near Gaussian, and too few of them are independent."""


class MatchedConfig(LocalConfig):
    """The settings of `local`, but for ``surface``: the thesis' polynomial, unless ``shape: auto`` asks for a chosen
    shape, whose uncertain long waves count as noise here."""

    @model_validator(mode="before")
    @classmethod
    def _chosen_shape(cls, data: Any) -> Any:
        return data


class MatchedDetector(LocalDetector):
    """A bank of matched filters on noise that the capture itself whitens; findings are peaks."""

    settings_type: ClassVar[type[MatchedConfig]] = MatchedConfig
    name = "matched"
    version = 6

    def __init__(self, settings: LocalConfig, covariance: np.ndarray | None = None) -> None:
        """``covariance``: the noise's, in squared deviations, that `calibrate` has learned."""
        super().__init__(settings)
        self._covariance = covariance

    def analyse(self, cloud: Cloud) -> LocalEvidence:
        """Score every pixel of the crop, by its depth and by the missing pixels round about: the logarithms of the two
        likelihoods add up. Raises UserError on an empty crop and where no surface can be fitted."""
        evidence = super().analyse(cloud)
        lost = missing_evidence(cloud, evidence)
        if lost is None:
            return evidence
        score, signed, there = np.sqrt(evidence.score**2 + lost), evidence.signed.copy(), evidence.cell >= 0
        signed.ravel()[evidence.cell[there]] = np.copysign(score[there], signed.ravel()[evidence.cell[there]])
        return replace(evidence, score=score, signed=signed)

    def picture(self, cloud: Cloud, pixels: int = 1) -> LocalPicture:
        """Return the residuals on a grid in which noise reaches no farther than through a camera's own window: depth
        that was upsampled is no sharper than its camera's pixels."""
        return super().picture(cloud, max(pixels, round(cloud.noise_reach_px / len(WINDOW))))

    def scored(
        self, residual_m: np.ndarray, weights: np.ndarray, rounding_m2: tuple[float, float]
    ) -> tuple[np.ndarray, float, str]:
        """Return signed scores (r, c), the deviation of the narrowest template's depth (m), and the unit."""
        values, unit_m, known = _in_deviations(residual_m, weights, rounding_m2)
        signed, narrowest = _judged(values, known, self._covariance)
        depth_m = narrowest * float(np.median(unit_m[known]))
        text = f"the deviation of matched filters on whitened noise, {1e3 * depth_m:.3g} mm of the narrowest"
        return signed, depth_m, text

    def correlation(self, evidence: Evidence) -> np.ndarray:
        """Return the learned correlation of the noise by lag, or that of the residuals."""
        covariance = self._covariance
        if covariance is None:
            known = np.isfinite(evidence.residual_m)
            residual_m = np.where(known, evidence.residual_m, 0.0)
            covariance = _covariance(_in_deviations(residual_m, known.astype(np.float32), (0.0, 0.0))[0], known)
        reach = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)
        lags = scipy.fft.irfft2(spectrum(covariance, (GRID, GRID)), (GRID, GRID))[np.ix_(reach, reach)]
        return np.asarray(lags / lags[LONGEST_LAG_PX, LONGEST_LAG_PX], np.float64)

    def calibrate(self, hole_free: Sequence[Cloud]) -> Mapping[str, np.ndarray]:
        """Return the mean covariance of the clouds' residuals, in squared deviations of the noise round about, by
        lag."""
        pictures = (self.picture(cloud) for cloud in hole_free)
        seen = [_covariance(*_in_deviations(*one.residuals)[::2]) for one in pictures]
        return {"covariance": np.mean(seen, axis=0)} if seen else {}

    def calibrated(self, learned: Mapping[str, np.ndarray]) -> MatchedDetector:
        """Return the detector that whitens by the learned covariance instead of the capture's own."""
        return type(self)(self.settings, learned.get("covariance"))


def _in_deviations(
    residual_m: np.ndarray, weights: np.ndarray, rounding_m2: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals (r, c) in units of the noise round about, louder where a point's own variance says so, and less
    what they share along the outline; that unit (r, c) in metres; and (r, c) bool, what is known."""
    known = weights > 0
    floor_m = max(float(np.sqrt(sum(rounding_m2))), 1e-9)
    values = np.where(known, residual_m * np.sqrt(weights), 0.0).astype(np.float32)
    # what is wider than a filter's window, objects and the surface's misfit, is no noise of pixels
    side = (SHORT_PX, SHORT_PX)
    around = (cv2.blur(each, side, borderType=cv2.BORDER_REFLECT) for each in (values, known.astype(np.float32)))
    short = np.where(known, values - next(around) / np.maximum(next(around), 1e-6), np.nan)
    share = median_of(np.abs(short[known])) / max(median_of(np.abs(values[known])), 1e-12)
    unit_m = np.maximum(local_sigma(short) / max(share, 1e-3), floor_m)
    return _without_rim(values / unit_m, known), unit_m, known


def _covariance(noise: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the covariance of the residuals that do not stand out, off the rim unless most pixels lie there."""
    inner = known & (_depth_px(known) > RIM_PX)
    inner = inner if 2 * inner.sum() > known.sum() else known
    loud = cv2.dilate((np.abs(noise) > QUIET_SIGMAS).astype(np.uint8), np.ones((5, 5), np.uint8))
    return noise_covariance(noise, inner & (loud == 0), grid_of(noise.shape))


def _judged(noise: np.ndarray, known: np.ndarray, covariance: np.ndarray | None) -> tuple[np.ndarray, float]:
    """Return signed scores (r, c) of residuals in deviations, and the deviation of the narrowest template's height."""
    grid = grid_of(noise.shape)
    covariance = _covariance(noise, known) if covariance is None else covariance
    power, worth_of = spectrum(covariance, grid), worths(spectrum(covariance, (GRID, GRID)))
    clipped = np.clip(noise, -CLIP_SIGMAS, CLIP_SIGMAS)

    # what stands out strongly: its pixels count as unknown for the rest
    roughly = inverse_times(clipped, known, power, grid, ROUGHLY_CONVERGED)
    rough, every = scipy.fft.rfft2(roughly, grid), np.ones_like(noise)
    size, by = np.zeros_like(noise), np.zeros(noise.shape, np.uint8)
    for k in ROUGHLY:
        score = response(rough, k, noise.shape) * np.float32(worth_of[k].energy ** -0.5)
        _keep_stronger(size, by, score, every, k)
    core, taken, taken_by = _cores(np.abs(size), by, noise, known)
    seen = known & ~grown(core, MARGIN_PX)

    rest = np.where(seen, clipped, np.float32(0.0))
    whole = scipy.fft.rfft2(inverse_times(rest, seen, power, grid, CONVERGED, roughly), grid)
    weighed = whole, halved(whole)
    there, divisors = [seen.astype(np.float32)], np.ones(len(ALL_RADII_PX), np.float32)
    even = np.pad(seen, ((0, seen.shape[0] % 2), (0, seen.shape[1] % 2)))
    there.append(cv2.resize(even.astype(np.float32), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    # what light and flying pixels leave along outlines looks like a slot
    off_rim = there[1] * (cv2.resize(_depth_px(even), None, fx=0.5, fy=0.5) > RIM_PX)
    best = [(np.zeros_like(each), np.zeros(each.shape, np.uint8)) for each in there]
    for k, worth in enumerate(worth_of):
        step = coarse(k)
        share = cv2.blur(there[step], worth.sides, borderType=cv2.BORDER_CONSTANT)
        score = response(weighed[step], k, noise.shape)
        _normalise(score, share, off_rim if k >= FIRST_SLOT else there[step], worth.energy)
        # where the scores of a neighbourhood scatter by more than 1, the noise there is not as elsewhere
        window = int(max(WINDOW_RADII * ALL_RADII_PX[k], LEAST_WINDOW) / (1 + step))
        scatter = local_sigma(score, window, 1.0, SCATTER_SAMPLES)
        if ALL_RADII_PX[k] <= TAIL_PX:
            scatter *= _tail(np.nan_to_num(score[seen] / scatter[seen]))
        divisors[k] = scatter.mean()
        _keep_stronger(*best[step], score, scatter, k)
    (signed, by), (wide, wide_by) = best
    h, w = seen.shape
    wide = cv2.resize(wide, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)[:h, :w]
    wide_by = np.repeat(np.repeat(wide_by, 2, axis=0), 2, axis=1)[:h, :w]
    wider = np.abs(wide) > np.abs(signed)
    signed, by = np.where(wider, wide, signed), np.where(wider, wide_by, by)
    _fill_discs(signed, np.asarray(ALL_RADII_PX, np.float32)[by])
    signed = np.where(core, taken / divisors[taken_by], np.where(known, signed, 0.0))
    near = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
    behind, before = (cv2.dilate(np.maximum(each, 0.0), near) for each in (signed, -signed))
    lobe = np.abs(signed) < LOBE_SHARE * np.where(signed > 0, before, behind)
    return np.where(lobe, 0.0, signed).astype(np.float64), worth_of[0].energy ** -0.5


@numba.njit(**PLAIN)
def _normalise(score: np.ndarray, share: np.ndarray, there: np.ndarray, energy: float) -> None:
    """Turn responses (r, c) into scores, NaN where too little of a template is seen."""
    for i in range(score.shape[0]):
        for j in range(score.shape[1]):
            if share[i, j] > LEAST_SEEN and there[i, j] > 0:
                score[i, j] /= np.sqrt(energy * share[i, j])
            else:
                score[i, j] = np.nan


@numba.njit(**PLAIN)
def _keep_stronger(signed: np.ndarray, by: np.ndarray, score: np.ndarray, over: np.ndarray, number: int) -> None:
    """Keep of each pixel's scores (r, c) and a score ``over`` (r, c) the larger in size, and that template's
    ``number``."""
    for i in range(score.shape[0]):
        for j in range(score.shape[1]):
            one = score[i, j] / over[i, j]
            if abs(one) > abs(signed[i, j]):
                signed[i, j], by[i, j] = one, number


def _tail(scores: np.ndarray) -> float:
    """Return how much farther the tail of scores (n,) reaches than a Gaussian's, on the side where it is shorter,
    since damage lengthens one; 1 at least."""
    count = int(TAIL_SHARE * len(scores))
    if count == 0:
        return 1.0
    parted = np.partition(scores, (count - 1, len(scores) - count))
    return max(1.0, float(min(parted[-count], -parted[count - 1])) / TAIL_SIGMAS)


def _fill_discs(signed: np.ndarray, radius_px: np.ndarray) -> None:
    """Raise the scores (r, c) inside the disc of each wide template that peaks, so that what it explains is one
    finding."""
    size = np.abs(signed)
    peaks = (size > LOUD_SIGMAS) & (radius_px >= WIDE_PX) & (size >= cv2.dilate(size, np.ones((2 * ALONE_PX + 1,) * 2)))
    for row, column in np.argwhere(peaks):
        radius = int(radius_px[row, column])
        cut = np.s_[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
        rows, columns = np.indices(size[cut].shape)
        apart = np.hypot(rows - min(row, radius), columns - min(column, radius))
        least = SADDLE * 1.01 * signed[row, column]
        inside = (apart <= radius) & (signed[cut] * np.sign(least) > 0)
        signed[cut][inside] = np.sign(least) * np.maximum(size[cut][inside], abs(least))


def _cores(
    size: np.ndarray, by: np.ndarray, noise: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (r, c) bool: the loud pixels, and what lies between them, that peaks of the scores' ``size`` stand on,
    where they fill the disc of the template (r, c) that the peak is ``by``: of what is wide and shallow only the
    loudest pixels would go. Further their signed scores (r, c), in proportion to the residual over 3 x 3 pixels, so
    that two holes that touch keep two peaks, and higher where the loud pixels' median exceeds the clipped size; and
    these templates (r, c)."""
    peaks = (size > STRONG) & (size >= cv2.dilate(size, np.ones((2 * ALONE_PX + 1,) * 2, np.uint8)))
    core, signed, found_by = np.zeros(size.shape, bool), np.zeros(size.shape), np.zeros(size.shape, np.uint8)
    if not peaks.any():
        return core, signed, found_by
    loud = known & (np.abs(noise) > LOUD_SIGMAS)
    around = (cv2.blur(each, (3, 3)) for each in (np.where(known, noise, np.float32(0.0)), known.astype(np.float32)))
    smooth = next(around) / np.maximum(next(around), 0.1)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(
        cv2.dilate(loud.astype(np.uint8), np.ones((3, 3), np.uint8))
    )
    score, template = np.zeros(count), np.zeros(count, np.uint8)
    for row, column in np.argwhere(peaks):
        for number in np.unique(parts[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]):
            least = LOUD_SHARE * np.pi * ALL_RADII_PX[by[row, column]] ** 2
            if number > 0 and stats[number, cv2.CC_STAT_AREA] > least and size[row, column] > score[number]:
                score[number], template[number] = size[row, column], by[row, column]
    for number in np.flatnonzero(score):
        left, top, width, height = stats[number, :4]
        cut = np.s_[top : top + height, left : left + width]
        part = (parts[cut] == number) & known[cut]
        sizes, heights = np.abs(noise[cut][part]), smooth[cut][part].astype(np.float64)
        louder = max(float(np.median(sizes[sizes > LOUD_SIGMAS])) / CLIP_SIGMAS, 1.0)
        # quiet pixels between loud ones are no finding of the other sign
        side = np.sign(heights[np.abs(heights).argmax()])
        heights = np.where(np.abs(heights) > LOUD_SIGMAS, heights, side * np.maximum(side * heights, 0.0))
        signed[cut][part] = score[number] * louder * heights / np.abs(heights).max()
        core[cut] |= part
        found_by[cut][part] = template[number]
    return core, signed, found_by


def _depth_px(known: np.ndarray) -> np.ndarray:
    """Return the distance (r, c) of each pixel to the outline of what is known; single unknown pixels are no part."""
    closed = cv2.morphologyEx(np.pad(known.astype(np.uint8), 2), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.asarray(cv2.distanceTransform(closed, cv2.DIST_C, 3)[2:-2, 2:-2])


def _without_rim(noise: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the residuals (r, c) less what they share, along some 65 pixels, with those as near to the outline."""
    noise, depth_px = noise.astype(np.float32), _depth_px(known)
    side = (2 * LEAST_WINDOW + 1,) * 2
    modest = np.clip(noise, -LEVEL_SIGMAS, LEVEL_SIGMAS)
    for step in range(1, RIM_PX + 1):
        layer = known & (depth_px == step)
        of, total = (
            cv2.blur(each, side, borderType=cv2.BORDER_CONSTANT)[layer]
            for each in (layer.astype(np.float32), np.where(layer, modest, np.float32(0.0)))
        )
        noise[layer] -= total / np.maximum(of, 1e-6)
    return noise
