"""Detects holes, dents and bumps by a bank of matched filters on whitened noise.

The residuals' autocovariance, temporal noise and fixed pattern together, is measured on the
capture itself, without strong residuals, or learned from hole-free clouds. Each template t (discs
of several radii through a camera's window or lens, slots, dents) is then compared with the
residuals r of the known pixels under that covariance C:

    score = t' C^-1 r / sqrt(t' C^-1 t)

C^-1 r is solved for by conjugate gradients, so missing pixels and borders add nothing and need no
filling. Pixels of the target's rim, where an edge leaves errors that are no noise, have variances
of their own in C, by their distance from the outline (`detectors.findings.rim`). The scores of each
template are then divided by their own deviation, separately for each distance from the outline
(`detectors.methods.scatter`). Wide templates have few independent positions, so their scores are
raised (`detectors.findings.templates.Worth`). Slots are scored on every second pixel, and around
each of their peaks the best of many others is looked for (`detectors.methods.slots`).

Strong findings are removed (their pixels count as unknown) and the rest is judged again, until
none is left, so that no filter sees the shoulder of a neighbouring hole or peaks between two.
Single pixels that stand out alone are clipped, unless hole-free clouds have shown that the camera
makes none. What pixels along the target's outline share beyond those farther in is subtracted.
Upsampled depth is judged on squares of pixels in which its noise reaches no farther than a camera's
window.

Not modelled: slots within `RIM_PX` of outlines and of removed findings; distortion of templates on
steep surfaces; missing returns, except the few that are not findings by themselves
(`detectors.findings.missing`). The denominator takes the share of a
template's whitened energy on known pixels for t' C^-1 t, by a rectangle that spreads as widely; a
template does not judge pixels where less than `template_scores.LEAST_SEEN` of it is visible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple

import cv2
import numpy as np

from detectors.findings import templates, whitening
from detectors.findings.missing import missing_evidence
from detectors.findings.rim import BLOCK_PX, on_pixels
from detectors.interface import Evidence
from detectors.methods import local
from detectors.methods.deviations import RIM_PX, Residuals, covariance_of, in_deviations, rim_of
from detectors.methods.local import FilterConfig, LocalDetector, LocalEvidence, LocalPicture
from detectors.methods.scatter import WIDE_PX
from detectors.methods.template_scores import PictureNoise, scored, template_noise
from detectors.pixels.masks import grown
from detectors.pixels.noise import median_of
from harness.vocabulary.geometry import Cloud

# --- single pixels ---

CLIP_SIGMAS = 5.0
"""Limit to which a pixel is clipped if its neighbours are smaller: a single flying pixel is not a
finding."""
MOST_LONE = 1
"""Most such pixels on the hole-free clouds of a camera that has none by nature. Before it, a hole
that only one pixel sees may be a finding, so that nothing is clipped."""

# --- strong findings, which are removed before the rest is judged again ---

STRONG = 6.0  # least score of their peaks
MOST_ROUNDS = 6  # of removing them and judging the rest
LOUD_SIGMAS = 3.0  # least residual of the pixels that are connected to such a peak
LOUD_SHARE = 0.5  # the loud pixels at a peak fill at least this share of its template's disc
MARGIN_PX = 2  # what is removed around loud pixels
ALONE_PX = 7  # half of the square in which a peak is the highest
OWN_SHARE = 0.75
"""A loud part whose score is less than this share of another's nearby is judged once that one is
removed: wide templates see both."""
WHOLE_SHARE = 0.01
"""A loud part whose score is less than this share of the picture's highest is judged once that one
is removed: the whitening is solved in single precision, and leaves up to a thousandth of the
highest score anywhere in the picture."""

# --- scores ---

LOBE_SHARE = 0.5
"""A score below this share of a score of the other sign within `RIM_PX` is a side lobe of the
whitening."""


class MatchedConfig(FilterConfig):
    """``surface``: the thesis' polynomial unless its ``shape`` is given. ``hole_model``: measures
    sizes."""


class Whitened(NamedTuple):
    """A picture of residuals whose noise is independent from pixel to pixel."""

    values: np.ndarray
    """(r, c) float32: C^-1/2 r, in deviations; beside unknown pixels its noise differs from 1."""
    is_known: np.ndarray
    """(r, c) bool."""
    unit_m: np.ndarray
    """(r, c): deviation of the residuals nearby, metres."""


class MatchedDetector(LocalDetector):
    """A bank of matched filters on noise that the capture itself whitens; findings are peaks."""

    settings_type: ClassVar[type[MatchedConfig]] = MatchedConfig
    name = "matched"
    version = 15

    def __init__(
        self,
        settings: FilterConfig,
        covariance: np.ndarray | None = None,
        rim: np.ndarray | None = None,
        lone: np.ndarray | None = None,
    ) -> None:
        """``covariance``: the noise's. ``rim`` (n,): the variances that the rim adds
        (`rim_variances`). Both are in squared deviations. ``lone`` (): number of pixels without
        damage that stand out alone. All are as `calibrate` has learned them."""
        super().__init__(settings)
        self._covariance = covariance
        self._rim = rim
        self._clips = lone is None or int(lone) > MOST_LONE

    def analyse(self, cloud: Cloud) -> LocalEvidence:
        """Score every pixel of the crop by its depth and by the missing pixels around: the
        logarithms of the two likelihoods add up. Raises UserError on an empty crop, or if no
        surface can be fitted."""
        return _with_missing(cloud, super().analyse(cloud))

    def rescored(
        self,
        cloud: Cloud,
        evidence: Evidence,
        residual_m: np.ndarray,
    ) -> LocalEvidence:
        """Return the evidence for other residuals (h, w) from the same surface, on the same
        pixels: as `analyse`, without a fit."""
        return _with_missing(cloud, super().rescored(cloud, evidence, residual_m))

    def picture(self, cloud: Cloud, pixels: int = 1) -> LocalPicture:
        """Return the residuals on a grid in which noise reaches no farther than a camera's own
        window."""
        windows = round(cloud.noise_reach_px / max(templates.WINDOWS_PX))
        return super().picture(cloud, max(pixels, windows))

    def scored(
        self,
        residual_m: np.ndarray,
        weights: np.ndarray,
        rounding_m2: tuple[float, float],
        reach_px: float,
    ) -> tuple[np.ndarray, float, str]:
        """Return signed scores (r, c), the deviation of the narrowest template's depth (m), and
        the unit of score."""
        residuals = in_deviations(residual_m, weights, rounding_m2)
        covariance = self._covariance
        if covariance is None:
            covariance = covariance_of(residuals)
        rim = self._rim
        if rim is None:
            rim = rim_of(residuals, covariance, reach_px, is_alone=True)
        tamed = _tamed(residuals.values) if self._clips else residuals.values
        signed, narrowest = _judged(residuals, tamed, covariance, rim)
        depth_m = narrowest * median_of(residuals.unit_m[residuals.is_known])
        unit = (
            f"the deviation of matched filters on whitened noise, {1e3 * depth_m:.3g} mm for the"
            " narrowest"
        )
        return signed, depth_m, unit

    def whitened(
        self,
        residual_m: np.ndarray,
        weights: np.ndarray,
        rounding_m2: tuple[float, float],
    ) -> Whitened:
        """Return residuals (r, c), with weights (r, c), 0 where unknown, as independent noise."""
        residuals = in_deviations(residual_m, weights, rounding_m2)
        covariance = self._covariance
        if covariance is None:
            covariance = covariance_of(residuals)
        is_known = residuals.is_known
        filters = whitening.filters(covariance, is_known.shape)
        solved = whitening.inverse_times(_tamed(residuals.values), is_known, filters)
        return Whitened(whitening.root_times(solved, filters), is_known, residuals.unit_m)

    def calibrate(self, hole_free: Sequence[Cloud]) -> Mapping[str, np.ndarray]:
        """Return the mean covariance of the clouds' residuals by lag, in squared deviations of the
        local noise, the mean variances that their rims add, and how many pixels stand out
        alone."""
        pictures = [self.picture(cloud) for cloud in hole_free]
        if not pictures:
            return {}
        residuals = [in_deviations(*picture.residuals) for picture in pictures]
        covariance = np.mean([covariance_of(picture) for picture in residuals], axis=0)
        reach_px = max(picture.reach_px for picture in pictures)
        is_alone = len(residuals) == 1
        rims = [rim_of(picture, covariance, reach_px, is_alone=is_alone) for picture in residuals]
        lone = sum(int((_tamed(picture.values) != picture.values).sum()) for picture in residuals)
        return {"covariance": covariance, "rim": np.mean(rims, axis=0), "lone": np.array(lone)}

    def calibrated(self, learned: Mapping[str, np.ndarray]) -> MatchedDetector:
        """Return the detector that whitens with the learned covariance and rim instead of the
        capture's own, and that clips only what the camera shows without damage."""
        return type(self)(
            self.settings,
            learned.get("covariance"),
            learned.get("rim"),
            learned.get("lone"),
        )


def _with_missing(cloud: Cloud, evidence: LocalEvidence) -> LocalEvidence:
    """Return the evidence with what missing pixels around each cell add to its score: the most
    that they add at one of its pixels, so that all of its pixels keep one score."""
    missing = missing_evidence(cloud, evidence)
    if missing is None:
        return evidence
    scored = evidence.cell >= 0
    cells = evidence.cell[scored]
    missing_of_cell = np.zeros(evidence.signed.size)
    np.maximum.at(missing_of_cell, cells, missing[scored])
    score = np.full_like(evidence.score, np.nan)
    score[scored] = np.sqrt(evidence.score[scored] ** 2 + missing_of_cell[cells])
    signed = evidence.signed.copy()
    flat = signed.ravel()
    flat[cells] = np.copysign(score[scored], flat[cells])
    return replace(evidence, score=score, signed=signed)


# --- two passes: strong findings, and the rest without them ---


def _judged(
    residuals: Residuals,
    tamed: np.ndarray,
    covariance: np.ndarray,
    rim: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return signed scores (r, c) of residuals in deviations, and the deviation of the narrowest
    template's height. ``tamed`` (r, c): their values, clipped or not. ``rim`` (n,): variances that
    the rim adds to the covariance."""
    is_known = residuals.is_known
    noise = PictureNoise(
        filters=whitening.filters(covariance, is_known.shape),
        rim=BLOCK_PX * on_pixels(rim, residuals.depth_px),
        on_templates=template_noise(covariance),
    )
    bank = noise.bank
    radius_px = np.array([template.radius_px for template in bank], np.float32)
    strong = _strong_findings(residuals.values, tamed, is_known, noise)
    quiet = is_known & ~grown(strong.core, MARGIN_PX)
    second = scored(tamed * quiet, quiet, noise, strong.discs, strong.solved)
    signed = second.signed
    _fill_discs(signed, radius_px[second.template])
    signed *= is_known
    # only now are deviations known; among those of round templates, that of the narrowest is known
    # best
    is_slot = np.array([template.slot is not None for template in bank])
    deviations = np.where(is_slot, second.deviations, second.deviations[0])
    signed[strong.core] = (strong.signed / deviations[strong.template])[strong.core]
    scores = (signed * ~_side_lobes(signed)).astype(np.float64)
    return scores, noise.on_templates.worths[0].energy ** -0.5


def _tamed(values: np.ndarray) -> np.ndarray:
    """Return values (r, c) clipped so that none exceeds both `CLIP_SIGMAS` and its eight
    neighbours."""
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    low = cv2.erode(values, ring)
    high = cv2.dilate(values, ring)
    return np.clip(values, np.minimum(low, -CLIP_SIGMAS), np.maximum(high, CLIP_SIGMAS))


def _side_lobes(signed: np.ndarray) -> np.ndarray:
    """Return (r, c) bool: scores that are less than `LOBE_SHARE` of one of the other sign within
    `RIM_PX`."""
    reach = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
    low = cv2.erode(signed, reach)
    high = cv2.dilate(signed, reach)
    return (signed < -LOBE_SHARE * low) & (signed > -LOBE_SHARE * high)


def _fill_discs(signed: np.ndarray, radius_px: np.ndarray) -> None:
    """Raise the scores (r, c) inside the disc of each wide template that peaks, so that it is one
    finding."""
    size = np.abs(signed)
    peaks = (size > STRONG / 2) & (radius_px >= WIDE_PX) & _highest(size)
    for row, column in np.argwhere(peaks).tolist():
        radius = int(radius_px[row, column])
        least = local.SADDLE * 1.01 * signed[row, column]
        top = max(row - radius, 0)
        left = max(column - radius, 0)
        cut = np.s_[top : row + radius + 1, left : column + radius + 1]
        rows, columns = np.ogrid[: size[cut].shape[0], : size[cut].shape[1]]
        inside = (rows - (row - top)) ** 2 + (columns - (column - left)) ** 2 <= radius**2
        signed[cut][inside & (size[cut] < abs(least))] = least


def _highest(size: np.ndarray) -> np.ndarray:
    """Return (r, c) bool: pixels that are the largest within `ALONE_PX`."""
    return size >= cv2.dilate(size, np.ones((2 * ALONE_PX + 1,) * 2, np.uint8))


class _Strong(NamedTuple):
    """The strong findings of a picture."""

    core: np.ndarray
    """(r, c) bool: their pixels."""
    signed: np.ndarray
    """(r, c): scores of these pixels, 0 elsewhere."""
    template: np.ndarray
    """(r, c): number of the template with the highest score of a pixel's finding, 0 elsewhere."""
    discs: np.ndarray
    """(r, c) bool: discs of these templates around their peaks, and of those of other peaks that
    are as high over quiet pixels."""
    solved: np.ndarray | None
    """(r, c): C^-1 r; None if pixels were removed since."""


def _strong_findings(
    values: np.ndarray,
    tamed: np.ndarray,
    known: np.ndarray,
    noise: PictureNoise,
) -> _Strong:
    """Find strong findings among residuals (r, c) in deviations, as they are and ``tamed``.

    A template may peak between two holes, so each loud part is judged by its own highest score.
    What lies beside a stronger part is judged once that one is removed, until no part is strong."""
    core = np.zeros(known.shape, bool)
    signed = np.zeros(known.shape)
    template = np.zeros(known.shape, np.uint8)
    discs = np.zeros(known.shape, np.uint8)
    radius_px = np.array([template.radius_px for template in noise.bank])
    for _ in range(MOST_ROUNDS):
        quiet = known & ~grown(core, MARGIN_PX)
        scores = scored(tamed * quiet, quiet, noise)
        cores = _cores(scores.signed, radius_px[scores.template], values, quiet)
        for part in cores:
            core[part.cut] |= part.inside
            signed[part.cut][part.inside] = part.signed
            template[part.cut][part.inside] = scores.template[part.peak]
        size = np.abs(scores.signed)
        quiet_peaks = np.argwhere((size > STRONG) & _highest(size)).tolist()
        for row, column in [part.peak for part in cores] or quiet_peaks:
            radius = round(float(radius_px[scores.template[row, column]]))
            cv2.circle(discs, (column, row), radius, 1, cv2.FILLED)
        if not cores:
            break
    # where much is removed, the rough solution is a poor start
    solved = None if core.any() else scores.solved
    return _Strong(core, signed, template, discs > 0, solved)


class _Core(NamedTuple):
    """The pixels of a strong finding."""

    cut: tuple[slice, slice]
    """The rectangle around them in the picture."""
    inside: np.ndarray
    """(h, w) bool: these pixels in the rectangle."""
    signed: np.ndarray
    """(n,): their scores, in proportion to the values over 3 x 3 pixels, so that two holes that
    touch keep two peaks."""
    peak: tuple[int, int]
    """Row and column of the highest score."""


def _cores(
    signed: np.ndarray,
    radius_px: np.ndarray,
    values: np.ndarray,
    known: np.ndarray,
) -> list[_Core]:
    """Return the strong findings: connected loud parts of the values (r, c) with a score (r, c) of
    their sign above `STRONG`, at least `OWN_SHARE` of those of loud parts nearby and `WHOLE_SHARE`
    of the strongest finding's, whose template, of ``radius_px`` (r, c), has a disc that they fill
    by half."""
    loud = known & (np.abs(values) > LOUD_SIGMAS)
    smooth = cv2.blur(values * known, (3, 3))
    smooth = smooth / np.maximum(cv2.blur(known.astype(np.float32), (3, 3)), 0.1)
    loud = grown(loud, 1)
    nearby = cv2.dilate(np.abs(signed) * loud, np.ones((2 * ALONE_PX + 1,) * 2, np.uint8))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(loud.astype(np.uint8))
    cores = []
    for number in range(1, count):
        left, top, width, height, area = stats[number].tolist()
        cut = np.s_[top : top + height, left : left + width]
        inside = (parts[cut] == number) & known[cut]
        heights = smooth[cut][inside].astype(np.float64)
        side = np.sign(heights[np.abs(heights).argmax()])
        side_scores = np.where(inside, side * signed[cut], 0.0)
        row, column = np.unravel_index(side_scores.argmax(), side_scores.shape)
        score = float(side_scores[row, column])
        peak = int(top + row), int(left + column)
        least = max(STRONG, OWN_SHARE * float(nearby[peak]))
        if score <= least or area <= LOUD_SHARE * np.pi * radius_px[peak] ** 2:
            continue
        # quiet pixels between loud ones are not a finding of the other sign
        one_sided = side * np.maximum(side * heights, 0.0)
        heights = np.where(np.abs(heights) > LOUD_SIGMAS, heights, one_sided)
        scores = score * heights / np.abs(heights).max()
        cores.append(_Core(cut, inside, scores, peak))
    strengths = [abs(float(signed[core.peak])) for core in cores]
    least = WHOLE_SHARE * max(strengths, default=0.0)
    return [core for core, strength in zip(cores, strengths, strict=True) if strength >= least]
