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
template does not judge pixels where less than `LEAST_SEEN` of it is visible."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple

import cv2
import numba
import numpy as np

from detectors.findings import templates, whitening
from detectors.findings.missing import missing_evidence
from detectors.findings.rim import BLOCK_PX, on_pixels, rim_variances
from detectors.interface import Evidence
from detectors.methods import local, slots
from detectors.methods.local import FilterConfig, LocalDetector, LocalEvidence, LocalPicture
from detectors.methods.scatter import FAINT, WIDE_PX, evened, tail_of, zones_of
from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import grown, outline_depth_px
from detectors.pixels.noise import median_of
from harness.vocabulary.geometry import Cloud

# --- residuals in deviations ---

SHORT_PX = 13
"""Width over which noise is compared between pixels: wider filters count there as much as
elsewhere."""
QUIET_SIGMAS = 4.0  # larger residuals and their neighbours do not count for the covariance
CLIP_SIGMAS = 5.0
"""Limit to which a pixel is clipped if its neighbours are smaller: a single flying pixel is not a
finding."""
MOST_LONE = 1
"""Most such pixels on the hole-free clouds of a camera that has none by nature. Before it, a hole
that only one pixel sees may be a finding, so that nothing is clipped."""
RIM_PX = 6  # depth of the target's rim, to which the camera's window and lens reach over its edge
LAYER_PX = 4  # side of the squares in which what the rim shares is averaged
MODEST_SIGMAS = local.LEVEL_SIGMAS  # limit to which residuals are clipped there

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
ROUGH = 0.4  # error at which C^-1 r is solved for strong findings, as `whitening.CONVERGED`

# --- scores ---

LEAST_SEEN = 0.6  # least visible share of a template
LOBE_SHARE = 0.5
"""A score below this share of a score of the other sign within `RIM_PX` is a side lobe of the
whitening."""
TAIL_PX = 1.5
"""Largest radius at which a template's own scores show their tail. Wider means are near Gaussian,
and too few of them are independent."""


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
    version = 13

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
        residuals = _in_deviations(residual_m, weights, rounding_m2)
        covariance = self._covariance
        if covariance is None:
            covariance = _covariance(residuals)
        rim = self._rim
        if rim is None:
            rim = _rim(residuals, covariance, reach_px, is_alone=True)
        tamed = _tamed(residuals.values) if self._clips else residuals.values
        signed, narrowest = _judged(residuals, tamed, covariance, rim)
        depth_m = narrowest * float(np.median(residuals.unit_m[residuals.is_known]))
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
        residuals = _in_deviations(residual_m, weights, rounding_m2)
        covariance = self._covariance
        if covariance is None:
            covariance = _covariance(residuals)
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
        residuals = [_in_deviations(*picture.residuals) for picture in pictures]
        covariance = np.mean([_covariance(picture) for picture in residuals], axis=0)
        reach_px = max(picture.reach_px for picture in pictures)
        is_alone = len(residuals) == 1
        rims = [_rim(picture, covariance, reach_px, is_alone=is_alone) for picture in residuals]
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
    """Return the evidence with what missing pixels around each pixel add to its score."""
    missing = missing_evidence(cloud, evidence)
    if missing is None:
        return evidence
    score = np.sqrt(evidence.score**2 + missing)
    scored = evidence.cell >= 0
    cells = evidence.cell[scored]
    signed = evidence.signed.copy()
    flat = signed.ravel()
    flat[cells] = np.copysign(score[scored], flat[cells])
    return replace(evidence, score=score, signed=signed)


# --- residuals in deviations of the local noise ---


class _Residuals(NamedTuple):
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


def _in_deviations(
    residual_m: np.ndarray,
    weights: np.ndarray,
    rounding_m2: tuple[float, float],
) -> _Residuals:
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
    return _Residuals(
        _without_rim(values / unit_m, depth_px * is_known),
        is_known,
        depth_px,
        unit_m,
    )


def _without_rim(noise: np.ndarray, depth_px: np.ndarray) -> np.ndarray:
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


def _covariance(residuals: _Residuals) -> np.ndarray:
    """Return the covariance of weak residuals, away from the rim unless most pixels lie there."""
    inner = residuals.is_known
    if _has_interior(residuals.depth_px * residuals.is_known):
        inner = residuals.is_known & (residuals.depth_px > RIM_PX)
    loud = (np.abs(residuals.values) > QUIET_SIGMAS).astype(np.uint8)
    quiet = inner & (cv2.dilate(loud, np.ones((5, 5), np.uint8)) == 0)
    grid = whitening.grid_of(residuals.values.shape)
    return whitening.noise_covariance(residuals.values, quiet, grid)


def _rim(
    residuals: _Residuals,
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


# --- two passes: strong findings, and the rest without them ---


class _Noise(NamedTuple):
    """The noise of a picture, and what it makes of the templates."""

    filters: whitening.Filters
    rim: np.ndarray
    """(r, c): variance of independent pixels whose means over `BLOCK_PX` vary as those at their
    distance from the outline do beyond it."""
    window_px: int
    """Side of the camera's window that the noise indicates."""
    worths: tuple[templates.Worth, ...]
    """Worth of each template."""
    slot_energies: np.ndarray
    """Whitened energies of slots (`slots.energies`)."""


class _Scores(NamedTuple):
    """The strongest template at each pixel."""

    signed: np.ndarray
    """(r, c): its score, negative in front of the surface."""
    template: np.ndarray
    """(r, c): its number in the bank."""
    solved: np.ndarray
    """(r, c): C^-1 r."""
    deviations: np.ndarray
    """(t,): deviation of each template's scores."""


def _judged(
    residuals: _Residuals,
    tamed: np.ndarray,
    covariance: np.ndarray,
    rim: np.ndarray,
) -> tuple[np.ndarray, float]:
    """Return signed scores (r, c) of residuals in deviations, and the deviation of the narrowest
    template's height. ``tamed`` (r, c): their values, clipped or not. ``rim`` (n,): variances that
    the rim adds to the covariance."""
    is_known = residuals.is_known
    window_px = templates.window_of(covariance)
    power = whitening.spectrum(covariance, (whitening.GRID, whitening.GRID))
    noise = _Noise(
        whitening.filters(covariance, is_known.shape),
        BLOCK_PX * on_pixels(rim, residuals.depth_px),
        window_px,
        templates.worths(power, window_px),
        slots.energies(power, window_px),
    )
    radius_px = np.array([template.radius_px for template in templates.bank(window_px)], np.float32)
    strong = _strong_findings(residuals.values, tamed, is_known, noise)
    quiet = is_known & ~grown(strong.core, MARGIN_PX)
    second = _scored(tamed * quiet, quiet, noise, strong.discs, strong.solved)
    signed = second.signed
    _fill_discs(signed, radius_px[second.template])
    signed *= is_known
    # only now are deviations known; among those of round templates, that of the narrowest is known
    # best
    is_slot = np.array([template.slot is not None for template in templates.bank(window_px)])
    deviations = np.where(is_slot, second.deviations, second.deviations[0])
    signed[strong.core] = (strong.signed / deviations[strong.template])[strong.core]
    scores = (signed * ~_side_lobes(signed)).astype(np.float64)
    return scores, noise.worths[0].energy ** -0.5


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
    noise: _Noise,
) -> _Strong:
    """Find strong findings among residuals (r, c) in deviations, as they are and ``tamed``.

    A template may peak between two holes, so each loud part is judged by its own highest score.
    What lies beside a stronger part is judged once that one is removed, until no part is strong."""
    core = np.zeros(known.shape, bool)
    signed = np.zeros(known.shape)
    template = np.zeros(known.shape, np.uint8)
    discs = np.zeros(known.shape, np.uint8)
    radius_px = np.array([template.radius_px for template in templates.bank(noise.window_px)])
    for _ in range(MOST_ROUNDS):
        quiet = known & ~grown(core, MARGIN_PX)
        scores = _scored(tamed * quiet, quiet, noise)
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
    their sign above `STRONG`, and at least `OWN_SHARE` of those of loud parts nearby, whose
    template, of ``radius_px`` (r, c), has a disc that they fill by half."""
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
    return cores


# --- the scores of all templates ---


class _SeenGrid:
    """The seen pixels, all or halved to every second one, as templates are compared with them.

    ``seen`` (r, c) float32: 1 where seen, a share where halved. ``depth_px`` (r, c): distance from
    the outline of the seen pixels. ``spectrum``: of C^-1 r on the grid of transforms. ``score``
    (r, c) and ``products``: memory for one template's scores and one pair's transform."""

    def __init__(
        self,
        seen: np.ndarray,
        depth_px: np.ndarray,
        spectrum: np.ndarray,
    ) -> None:
        self.seen = seen
        self.depth_px = depth_px
        self.spectrum = spectrum
        self.score = np.empty_like(seen)
        self.products = np.empty_like(spectrum)
        self._factors: dict[tuple[bool, tuple[int, int]], np.ndarray] = {}

    def factors(self, template: templates.Template, worth: templates.Worth) -> np.ndarray:
        """Return 1 / sqrt(visible share) (r, c) of a template, 0 where it does not judge."""
        key = template.slot is not None, worth.sides
        if key not in self._factors:
            share = cv2.blur(self.seen, worth.sides, borderType=cv2.BORDER_CONSTANT)
            judged = self.seen
            if template.slot is not None:
                # errors along outlines, from light and flying pixels, look like slots
                judged = judged * (self.depth_px > RIM_PX)
            self._factors[key] = _visible(share, judged)
        return self._factors[key]


class _Best:
    """The strongest score (r, c) at each pixel so far, with its sign, and its template's number."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.signed = np.zeros(shape, np.float32)
        self.template = np.zeros(shape, np.uint8)


def _scored(
    values: np.ndarray,
    seen: np.ndarray,
    noise: _Noise,
    strong: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> _Scores:
    """Return each pixel's strongest score.

    Args:
        values: (r, c), residuals in deviations.
        seen: (r, c) bool, the pixels that count.
        noise: of the picture.
        strong: (r, c) bool, strong findings, which the scatter of scores ignores. None in the
            first pass, which looks for them: at the centres of pixels, with deviations of 1.
        start: (r, c), an approximate C^-1 r."""
    error = ROUGH if strong is None else whitening.CONVERGED
    solved = whitening.inverse_times(values, seen, noise.filters, start, error, noise.rim)
    fine = _SeenGrid(
        seen.astype(np.float32),
        outline_depth_px(seen),
        templates.transformed(solved, noise.filters.power.shape),
    )
    coarse = _SeenGrid(_halved(fine.seen), _halved(fine.depth_px), templates.halved(fine.spectrum))
    zones = []
    if strong is not None:
        zones.append(zones_of(fine.seen, fine.depth_px, strong))
        coarse_strong = np.ascontiguousarray(strong[::2, ::2])
        zones.append(zones_of(coarse.seen, coarse.depth_px, coarse_strong))
    best = _Best(fine.seen.shape)
    coarse_best = _Best(coarse.seen.shape)
    slot_best = _Best(coarse.seen.shape)
    tail = 1.0
    deviations = np.ones(len(templates.bank(noise.window_px)))
    slot_responses = {}
    for view, number, response in _responses(fine, coarse, noise, strong is None):
        template = templates.bank(noise.window_px)[number]
        worth = noise.worths[number]
        score = view.score
        if template.slot is not None:
            slot_responses[number] = response.copy()
        factors = view.factors(template, worth)
        cv2.multiply(response, factors, dst=score, scale=worth.energy**-0.5)
        deviation = 1.0
        if strong is not None:
            deviation = evened(score, template, zones[template.coarse])
            if template.radius_px <= TAIL_PX:
                if not any(template.halves):
                    tail = tail_of(score, deviation)
                deviation *= tail
        deviations[number] = deviation
        kept = best
        if template.coarse:
            kept = coarse_best if template.slot is None else slot_best
        down, right = template.halves
        _keep_stronger(
            kept.signed,
            kept.template,
            score,
            1 / deviation,
            worth.raised,
            down,
            right,
            number,
        )
    # errors along outlines, from light and flying pixels, look like slots
    blurred = slots.blurred(solved, noise.window_px) * (fine.depth_px > RIM_PX)
    refined = _refined_slots(slot_best, slot_responses, blurred, noise)
    # linear interpolation would lower the narrow ridges of slots' scores by a seventh
    _merge(best, coarse_best, cv2.INTER_LINEAR)
    slot_best.signed = slots.lowered(slot_best.signed)
    _merge(best, slot_best, cv2.INTER_NEAREST)
    for slot, number in refined:
        _draw(best, slot, number)
    return _Scores(best.signed * seen, best.template, solved, deviations)


def _refined_slots(
    slot_best: _Best,
    responses: Mapping[int, np.ndarray],
    blurred: np.ndarray,
    noise: _Noise,
) -> list[tuple[slots.BestSlot, int]]:
    """Return the best slots around the peaks of the bank's, with their final scores, and the
    number of the bank's slot there.

    Args:
        slot_best: the bank's, on the halved picture.
        responses: (r / 2, c / 2) of each of them.
        blurred: (r, c), of `slots.blurred`.
        noise: of the picture."""
    refined = []
    for row, column in slots.peaks_of(slot_best.signed).tolist():
        number = int(slot_best.template[row, column])
        sides = templates.bank(noise.window_px)[number].slot
        assert sides is not None
        score = float(slot_best.signed[row, column])
        slot = slots.best_slot(
            blurred,
            noise.slot_energies,
            (2 * row + 0.5, 2 * column + 0.5),
            sides,
            math.copysign(1.0, score),
        )
        # what is seen there, the deviation of scores and how it differs there are those of the
        # bank's slot: of the other widths the deviations differ by up to 4 %
        response = float(responses[number][row, column]) * noise.worths[number].energy ** -0.5
        final = slots.lowered(np.array(score / response * slot.score))
        refined.append((slot._replace(score=float(final)), number))
    return refined


def _draw(best: _Best, slot: slots.BestSlot, number: int) -> None:
    """Raise the scores along a slot, so that it is one finding with its peak in the middle. A slot
    that reaches over stronger evidence has its own from there, and is left out."""
    half_px = slot.length_px / 2
    along = np.arange(-half_px, half_px + 0.5, 0.5)
    angle_rad = math.radians(slot.angle_deg)
    rows = np.rint(slot.row + math.sin(angle_rad) * along).astype(int)
    columns = np.rint(slot.column + math.cos(angle_rad) * along).astype(int)
    height, width = best.signed.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    on_grid = (rows[inside], columns[inside])
    # just above the saddle at which peaks are joined
    scores = np.full(len(along), local.SADDLE * 1.01 * slot.score, np.float32)
    scores[len(along) // 2] = slot.score
    scores = scores[inside]
    earlier = best.signed[on_grid]
    if np.abs(earlier).max(initial=0.0) > abs(slot.score):
        return
    stronger = np.abs(scores) > np.abs(earlier)
    best.signed[on_grid] = np.where(stronger, scores, earlier)
    best.template[on_grid] = np.where(stronger, number, best.template[on_grid])


def _responses(
    fine: _SeenGrid,
    coarse: _SeenGrid,
    noise: _Noise,
    only_centred: bool,
) -> Iterator[tuple[_SeenGrid, int, np.ndarray]]:
    """Yield for each template the view on which it is scored, its number, and its response t' C^-1
    r (r, c), which the next one overwrites."""
    bank = templates.bank(noise.window_px)
    for pair, numbers in templates.spectra(noise.filters.power.shape, noise.window_px):
        if only_centred and all(any(bank[number].halves) for number in numbers):
            continue
        view = coarse if bank[numbers[0]].coarse else fine
        height, width = view.seen.shape
        pair_response = templates.responses(view.spectrum, pair, view.products)[:height, :width]
        for channel, number in enumerate(numbers):
            if only_centred and any(bank[number].halves):
                continue
            cv2.extractChannel(pair_response, channel, dst=view.score)
            yield view, number, view.score


def _halved(image: np.ndarray) -> np.ndarray:
    """Return the means (r / 2, c / 2) of 2 x 2 pixels; an odd last row or column is repeated."""
    odd_rows = image.shape[0] % 2
    odd_columns = image.shape[1] % 2
    even = cv2.copyMakeBorder(image, 0, odd_rows, 0, odd_columns, cv2.BORDER_REPLICATE)
    return cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def _merge(best: _Best, halved: _Best, interpolation: int) -> None:
    """Keep the stronger of scores at all pixels and those of the halved picture."""
    height, width = best.signed.shape
    signed = cv2.resize(halved.signed, None, fx=2, fy=2, interpolation=interpolation)
    signed = np.ascontiguousarray(signed[:height, :width])
    template = cv2.resize(
        halved.template,
        None,
        fx=2,
        fy=2,
        interpolation=cv2.INTER_NEAREST,
    )
    template = np.ascontiguousarray(template[:height, :width])
    stronger = (np.abs(signed) > np.abs(best.signed)).view(np.uint8)
    cv2.copyTo(signed, stronger, best.signed)
    cv2.copyTo(template, stronger, best.template)


@numba.njit(**PLAIN)
def _visible(share: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return 1 / sqrt(share) (r, c) where ``judged`` is not 0 and enough of a template is visible,
    0 elsewhere."""
    factors = np.empty(share.shape, np.float32)
    least = np.float32(LEAST_SEEN)
    for i in range(share.shape[0]):
        share_row = share[i]
        judged_row = judged[i]
        row = factors[i]
        for j in range(len(row)):
            factor = np.float32(1.0) / np.sqrt(max(share_row[j], least))
            is_judged = (share_row[j] > least) & (judged_row[j] > 0)
            row[j] = factor if is_judged else np.float32(0.0)
    return factors


@numba.njit(**PLAIN)
def _keep_stronger(  # type: ignore[no-untyped-def]
    signed,
    by,
    score,
    per_deviation,
    raised,
    down,
    right,
    number,
):
    """Keep the larger of each pixel's scores (r, c) by size in ``signed``, and that template's
    ``number`` in ``by``.

    Scores are scaled by ``per_deviation`` and raised: their squares grow by ``raised``, in
    proportion below `FAINT`. Scores between pixels, ``down`` or ``right``, belong to all around.
    """
    scale = np.float32(per_deviation)
    raised_by = np.float32(raised)
    faint = np.float32(per_deviation * np.sqrt(1.0 + raised / FAINT**2))
    height, width = score.shape
    for y in range(down + 1):
        for x in range(right + 1):
            for i in range(height - y):
                row = score[i]
                kept = signed[i + y][x:]
                kept_by = by[i + y][x:]
                for j in range(width - x):
                    size = min(abs(row[j]) * faint, np.sqrt((row[j] * scale) ** 2 + raised_by))
                    stronger = size > abs(kept[j])
                    kept[j] = np.copysign(size, row[j]) if stronger else kept[j]
                    kept_by[j] = number if stronger else kept_by[j]
