"""Detects holes, dents and bumps by a bank of matched filters on whitened noise.

The residuals' autocovariance, temporal noise and fixed pattern together, is measured on the
capture itself, without strong residuals, or learned from hole-free clouds. Each template t (discs
of several radii through a camera's window or lens, slots at several angles, dents) is then
compared with the residuals r of the known pixels under that covariance C:

score = t' C^-1 r / sqrt(t' C^-1 t)

C^-1 r is solved for by conjugate gradients, so missing pixels and borders add nothing and need no
filling. The scores of each template are then divided by their own deviation, separately for each
distance from the outline. Wide templates have few independent places, so their scores are raised
(`detectors.findings.whitening.Worth`).

Strong findings are removed (their pixels count as unknown) and the rest is judged again, so that
no filter sees the shoulder of a neighbouring hole. What pixels along the target's outline share
beyond those farther in is subtracted. Upsampled depth is judged on squares of pixels in which its
noise reaches no farther than a camera's window.

Not modelled: slots that no template fits; slots within `RIM_PX` of outlines and of removed
findings; distortion of templates on steep surfaces; missing returns, except the few that are not
findings by themselves (`detectors.findings.missing`). The denominator takes the share of a
template's whitened energy on known pixels for t' C^-1 t, by a rectangle that spreads as widely; a
template does not judge places where less than `LEAST_SEEN` of it is visible. Slots are scored on
every second pixel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar

import cv2
import numba
import numpy as np
from scipy import special

from detectors.averages.noise import median_of
from detectors.findings import whitening
from detectors.findings.clusters import PLAIN
from detectors.findings.missing import missing_evidence
from detectors.interface import Evidence
from detectors.masks import grown
from detectors.methods import local
from detectors.methods.local import FilterConfig, LocalDetector, LocalEvidence, LocalPicture
from harness.vocabulary.geometry import Cloud

LEAST_SEEN = 0.6
# width over which noise is compared between places: wider filters count there as much as elsewhere
SHORT_PX = 13
QUIET_SIGMAS = 4.0  # larger residuals and their neighbours do not count for the covariance
CLIP_SIGMAS = 5.0
"""Limit to which a pixel is clipped if its neighbours are smaller: a single flying pixel is not a
finding."""
STRONG = 6.0
LOUD_SIGMAS = 3.0
MARGIN_PX = 2
"""A peak with this score, the loud pixels connected to it, and those around are removed; the rest
is judged again."""
LOUD_SHARE = 0.5  # the loud pixels at a peak fill at least this share of its template's disc
ALONE_PX = 7  # half of the square in which a peak is the highest
RIM_PX = 6  # depth of the target's rim, to which the camera's window and lens reach over its edge
LAYER_PX = 4
MODEST_SIGMAS = local.LEVEL_SIGMAS
"""Side of the squares in which what the rim shares is averaged, and the limit to which residuals
are clipped there."""
RIM_ENDS_PX = (1, 2, 3, 5, 8, 12)
"""Distances from the outline up to which scores have their own scatter; farther inside, all scores
share one."""
N_ZONES = len(RIM_ENDS_PX) + 1
ZONES = np.searchsorted(RIM_ENDS_PX, np.arange(RIM_ENDS_PX[-1] + 2)).astype(np.uint8)
WINDOW_RADII = 6
PART_PX = 8
UNEVEN = 1.25
"""Half of the window of the local scatter in radii, the side of its squares, and scatter that
chance explains."""
# largest score that counts in the scatter, and the fewest scores that determine it
CAP = 2.0
FEWEST = 200
DEVIATIONS = np.geomspace(0.2, 50.0, 200)
CAPPED = DEVIATIONS * np.sqrt(2.0 / np.pi) * (
    1.0 - np.exp(-0.5 * (CAP / DEVIATIONS) ** 2)
) + 2.0 * CAP * special.ndtr(-CAP / DEVIATIONS)
STEPS = 4096
DEVIATION_OF = np.interp(np.arange(STEPS * CAP + 2) / STEPS, CAPPED, DEVIATIONS)
"""Deviations of a Gaussian, the mean of its size if more than `CAP` counts as `CAP`; and the
inverse, by `STEPS`."""
FAINT = 3.5  # scores below this are all raised by the same factor, because `Worth` counts maxima
LOBE_SHARE = 0.5
"""A score below this share of a score of the other sign within `RIM_PX` is a side lobe of the
whitening."""
WIDE_PX = 5.0  # radius from which noise may split a template's finding into several peaks
ROUGH = 0.4  # error at which C^-1 r is solved for strong findings, as `whitening.CONVERGED`
TAIL_PX = 1.5
TAIL_SHARE = 0.0005
TAIL_SIGMAS = 3.29
"""Largest radius at which a template's own scores show their tail; the share of pixels beyond it
on either side; and where a Gaussian has it. Wider means are near Gaussian, and too few of them are
independent."""


class MatchedConfig(FilterConfig):
    """``surface``: the thesis' polynomial unless its ``shape`` is given. ``hole_model``: measures
    sizes."""


class MatchedDetector(LocalDetector):
    """A bank of matched filters on noise that the capture itself whitens; findings are peaks."""

    settings_type: ClassVar[type[MatchedConfig]] = MatchedConfig
    name = "matched"
    version = 9

    def __init__(self, settings: FilterConfig, covariance: np.ndarray | None = None) -> None:
        """``covariance``: the noise's, in squared deviations, that `calibrate` has learned."""
        super().__init__(settings)
        self._covariance = covariance

    def analyse(self, cloud: Cloud) -> LocalEvidence:
        """Score every pixel of the crop by its depth and by the missing pixels around: the
        logarithms of the two likelihoods add up. Raises UserError on an empty crop, or if no
        surface can be fitted."""
        evidence = super().analyse(cloud)
        lost = missing_evidence(cloud, evidence)
        if lost is None:
            return evidence
        score = np.sqrt(evidence.score**2 + lost)
        signed = evidence.signed.copy()
        there = evidence.cell >= 0
        signed.ravel()[evidence.cell[there]] = np.copysign(
            score[there], signed.ravel()[evidence.cell[there]]
        )
        return replace(evidence, score=score, signed=signed)

    def picture(self, cloud: Cloud, pixels: int = 1) -> LocalPicture:
        """Return the residuals on a grid in which noise reaches no farther than a camera's own
        window."""
        return super().picture(
            cloud, max(pixels, round(cloud.noise_reach_px / max(whitening.WINDOWS_PX)))
        )

    def scored(
        self, residual_m: np.ndarray, weights: np.ndarray, rounding_m2: tuple[float, float]
    ) -> tuple[np.ndarray, float, str]:
        """Return signed scores (r, c), the deviation of the narrowest template's depth (m), and
        the unit of score."""
        values, known, depth_px, unit_m = _in_deviations(residual_m, weights, rounding_m2)
        signed, narrowest = _judged(values, known, depth_px, self._covariance)
        depth_m = narrowest * float(np.median(unit_m[known]))
        text = f"the deviation of matched filters on whitened noise, {1e3 * depth_m:.3g} mm for the narrowest"
        return signed, depth_m, text

    def correlation(self, evidence: Evidence) -> np.ndarray:
        """Return the correlation of the noise by lag, learned or from the residuals."""
        return (
            _own_correlation(evidence)
            if self._covariance is None
            else whitening.correlation(self._covariance)
        )

    def calibrate(self, hole_free: Sequence[Cloud]) -> Mapping[str, np.ndarray]:
        """Return the mean covariance of the clouds' residuals by lag, in squared deviations of the
        local noise."""
        pictures = (self.picture(cloud) for cloud in hole_free)
        seen = [_covariance(*_in_deviations(*picture.residuals)[:3]) for picture in pictures]
        return {"covariance": np.mean(seen, axis=0)} if seen else {}

    def calibrated(self, learned: Mapping[str, np.ndarray]) -> MatchedDetector:
        """Return the detector that whitens with the learned covariance instead of the capture's
        own."""
        return type(self)(self.settings, learned.get("covariance"))


def _in_deviations(
    residual_m: np.ndarray, weights: np.ndarray, rounding_m2: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals (r, c) in units of the noise nearby, increased where a point's own variance
    is larger, and minus what they share along the outline; (r, c) bool, the known pixels; their
    distances (r, c) from the outline; and that unit (r, c) in metres."""
    known = weights > 0
    floor_m = max(float(np.sqrt(sum(rounding_m2))), 1e-9)
    values = np.where(known, residual_m * np.sqrt(weights), 0.0).astype(np.float32)
    # structure wider than a filter's window, objects and the surface's misfit are not noise of
    # pixels
    side = (SHORT_PX, SHORT_PX)
    around = (
        cv2.blur(each, side, borderType=cv2.BORDER_REFLECT)
        for each in (values, known.astype(np.float32))
    )
    short = values - next(around) / np.maximum(next(around), np.float32(1e-6))
    short[~known] = np.nan
    some = slice(None, None, max(1, np.count_nonzero(known) // 65536))
    share = median_of(np.abs(short[known][some])) / max(
        median_of(np.abs(values[known][some])), 1e-12
    )
    unit_m = np.maximum(local.local_sigma(short) / max(share, 1e-3), floor_m)
    depth_px = _depth_px(known)
    return _without_rim(values / unit_m, depth_px * known), known, depth_px, unit_m


@lru_cache(maxsize=1)
def _own_correlation(evidence: Evidence) -> np.ndarray:
    """Return the correlation of a cloud's residuals by lag, once for all findings of the cloud."""
    rows, columns = np.nonzero(np.isfinite(evidence.residual_m))
    residual_m = evidence.residual_m[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    weights = np.isfinite(residual_m).astype(np.float32)
    return whitening.correlation(
        _covariance(*_in_deviations(np.nan_to_num(residual_m), weights, (0.0, 0.0))[:3])
    )


def _covariance(noise: np.ndarray, known: np.ndarray, depth_px: np.ndarray) -> np.ndarray:
    """Return the covariance of weak residuals, away from the rim unless most pixels lie there."""
    inner = known & (depth_px > RIM_PX)
    inner = inner if 2 * inner.sum() > known.sum() else known
    loud = cv2.dilate((np.abs(noise) > QUIET_SIGMAS).astype(np.uint8), np.ones((5, 5), np.uint8))
    return whitening.noise_covariance(noise, inner & (loud == 0), whitening.grid_of(noise.shape))


def _judged(
    values: np.ndarray, known: np.ndarray, depth_px: np.ndarray, covariance: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """Return signed scores (r, c) of residuals in deviations, and the deviation of the narrowest
    template's height."""
    covariance = _covariance(values, known, depth_px) if covariance is None else covariance
    window_px = whitening.window_of(covariance)
    worths = whitening.worths(
        whitening.spectrum(covariance, (whitening.GRID, whitening.GRID)), window_px
    )
    noise = whitening.filters(covariance, values.shape), window_px, worths
    tamed = _tamed(values)
    heard = np.zeros(known.shape, np.uint8)
    signed, by, solved, _ = _scored(tamed, known, noise)
    radius_px = np.array([each.radius_px for each in whitening.bank(window_px)], np.float32)
    size = np.abs(signed)
    peaks = np.argwhere((size > STRONG) & _highest(size))
    peaks = peaks[np.argsort(size[tuple(peaks.T)], kind="stable")]
    strong = size[tuple(peaks.T)]
    strong_by = by[tuple(peaks.T)]
    for (row, column), radius in zip(peaks.tolist(), radius_px[strong_by].tolist(), strict=True):
        cv2.circle(heard, (column, row), round(radius), 1, cv2.FILLED)
    core, heights, peak_of = _cores(peaks, radius_px[strong_by], values, known)
    seen = known & ~grown(core, MARGIN_PX) if core.any() else known
    # where much is removed, the first solution is a poor start
    signed, by, _, spread = _scored(
        tamed * seen, seen, noise, heard > 0, None if core.any() else solved
    )
    # only now are deviations known; that of the narrowest template is known best
    strong = strong / spread
    _fill_discs(signed, radius_px[by])
    signed *= known
    signed[core] = heights[core] * strong[peak_of[core]]
    reach = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
    low = np.asarray(cv2.erode(signed, reach))
    high = np.asarray(cv2.dilate(signed, reach))
    lobe = (signed < -LOBE_SHARE * low) & (signed > -LOBE_SHARE * high)
    return (signed * ~lobe).astype(np.float64), worths[0].energy ** -0.5


def _tamed(values: np.ndarray) -> np.ndarray:
    """Return values (r, c) clipped so that none exceeds both `CLIP_SIGMAS` and its eight
    neighbours."""
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    low = np.asarray(cv2.erode(values, ring))
    high = np.asarray(cv2.dilate(values, ring))
    return np.clip(values, np.minimum(low, -CLIP_SIGMAS), np.maximum(high, CLIP_SIGMAS))


def _scored(
    values: np.ndarray,
    seen: np.ndarray,
    noise: tuple[whitening.Filters, int, Sequence[whitening.Worth]],
    heard: np.ndarray | None = None,
    start: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return each pixel's strongest score (r, c) with its sign, the index of its template, and
    C^-1 r, from the pixels ``seen`` (r, c); and the deviation of the narrowest template.
    ``noise``: its `whitening.filters`, the window's side, and each template's `Worth`. ``heard``
    (r, c) bool: strong findings, which the scatter of scores ignores; None to seek them, at the
    centres of pixels and with deviations of 1. ``start``: an approximate solution."""
    (filters, window_px, worths), rough = noise, heard is None
    solved = whitening.inverse_times(
        values, seen, filters, start, ROUGH if rough else whitening.CONVERGED
    )
    spectra = [whitening.transformed(solved, filters[0].shape)]
    visible = {}
    tail = 1.0
    views = [(seen.astype(np.float32), _depth_px(seen))]
    spectra.append(whitening.halved(spectra[0]))
    views.append((_halved(views[0][0]), _halved(views[0][1])))
    louds = () if heard is None else (heard, np.ascontiguousarray(heard[::2, ::2]))
    zones = [_zones(*view, loud) for view, loud in zip(views, louds, strict=False)]
    scores = [np.empty_like(there) for there, _ in views]
    products = [np.empty_like(each) for each in spectra]
    # of fine, coarse and slots' scores
    best = [
        (np.zeros_like(there), np.zeros(there.shape, np.uint8)) for there, _ in (*views, views[1])
    ]
    templates = whitening.bank(window_px)
    spread = 1.0
    for pair, numbers in whitening.spectra(filters[0].shape, window_px):
        wanted = [not rough or not any(templates[number].halves) for number in numbers]
        if not any(wanted):
            continue
        coarse = templates[numbers[0]].coarse
        (there, depth_px), score = views[coarse], scores[coarse]
        both = whitening.responses(spectra[coarse], pair, products[coarse])[
            : len(score), : score.shape[1]
        ]
        for channel, number in [each for each in enumerate(numbers) if wanted[each[0]]]:
            template = templates[number]
            worth = worths[number]
            key = coarse, template.slot, worth.sides
            if key not in visible:
                share = cv2.blur(there, worth.sides, borderType=cv2.BORDER_CONSTANT)
                # errors along outlines, from light and flying pixels, look like slots
                visible[key] = _visible(
                    share, there * (depth_px > RIM_PX) if template.slot else there
                )
            cv2.extractChannel(both, channel, dst=score)
            cv2.multiply(score, visible[key], dst=score, scale=worth.energy**-0.5)
            deviation = 1.0
            if heard is not None:
                deviation = _evened(score, template, zones[coarse])
                if template.radius_px <= TAIL_PX:
                    tail = tail if any(template.halves) else _tail(score, deviation)
                    deviation *= tail
            spread = spread if number else deviation
            _keep_stronger(
                *best[coarse + template.slot],
                score,
                1 / deviation,
                worth.raised,
                *template.halves,
                number,
            )
    signed, by = best[0]
    # linear interpolation would lower the narrow ridges of slots' scores by a seventh
    for (half, half_by), smooth in zip(
        best[1:], (cv2.INTER_LINEAR, cv2.INTER_NEAREST), strict=True
    ):
        wide, wide_by = (
            np.ascontiguousarray(
                cv2.resize(each, None, fx=2, fy=2, interpolation=how)[: len(seen), : seen.shape[1]]
            )
            for each, how in ((half, smooth), (half_by, cv2.INTER_NEAREST))
        )
        wider = (np.abs(wide) > np.abs(signed)).view(np.uint8)
        cv2.copyTo(wide, wider, signed)
        cv2.copyTo(wide_by, wider, by)
    return signed * seen, by, solved, spread


@numba.njit(**PLAIN)
def _visible(share: np.ndarray, judged: np.ndarray) -> np.ndarray:
    """Return 1 / sqrt(share) (r, c) where ``judged`` is not 0 and enough of a template is visible,
    0 elsewhere."""
    found = np.empty(share.shape, np.float32)
    least = np.float32(LEAST_SEEN)
    for i in range(share.shape[0]):
        shares = share[i]
        is_judged = judged[i]
        factors = found[i]
        for j in range(len(factors)):
            factor = np.float32(1.0) / np.sqrt(max(shares[j], least))
            factors[j] = factor if (shares[j] > least) & (is_judged[j] > 0) else np.float32(0.0)
    return found


def _zones(
    there: np.ndarray, depth_px: np.ndarray, loud: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ``loud`` (r, c) bool, the scores that do not count for the scatter; the flat indices
    (n,) of the known pixels outside the last zone, in the order of their zones; and where each
    zone ends (z,) among them."""
    zone = ZONES[np.ceil(np.minimum(depth_px, len(ZONES) - 1)).astype(np.uint8)]
    zone[there == 0] = N_ZONES - 1
    order = np.argsort(zone, axis=None, kind="stable")
    ends = np.cumsum(np.bincount(zone.ravel(), minlength=N_ZONES))[:-1]
    return loud, order[: ends[-1]], ends


def _halved(image: np.ndarray) -> np.ndarray:
    """Return the means (r / 2, c / 2) of 2 x 2 pixels; an odd last row or column is repeated."""
    even = cv2.copyMakeBorder(
        image, 0, image.shape[0] % 2, 0, image.shape[1] % 2, cv2.BORDER_REPLICATE
    )
    return np.asarray(cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def _evened(
    score: np.ndarray, template: whitening.Template, zones: tuple[np.ndarray, ...]
) -> float:
    """Return the deviation of the scores (r, c) in the last zone, and divide the scores where
    others scatter more: in other zones, and where the squares around scatter by more than `UNEVEN`
    deviations because the noise there differs from elsewhere. Loud scores do not count, nor strong
    ones of wide templates, nor those next to them."""
    step, (loud, *rim) = 1 + template.coarse, zones
    if template.radius_px >= WIDE_PX and not template.slot:
        most = FAINT * _scatter(score, np.zeros_like(loud), *rim)[0][-1]
        strong = loud | (np.abs(score) > most) if cv2.norm(score, cv2.NORM_INF) > most else loud
        loud = grown(strong, round(template.radius_px / step)) if strong.any() else loud
    found, sums, counts = _scatter(score, loud, *rim)
    if counts.sum() <= FEWEST:
        found = _scatter(score, np.zeros_like(loud), *rim)[0]
    deviation = float(found[-1])
    half_px = max(WINDOW_RADII * template.radius_px, local.LEAST_WINDOW) / step
    window = (2 * round(half_px / PART_PX) + 1,) * 2
    size = cv2.blur(sums, window) / np.maximum(cv2.blur(counts, window), 0.05 * PART_PX**2)
    if DEVIATION_OF[int(STEPS * size.max())] > UNEVEN * deviation:
        more = np.maximum(np.interp(size, CAPPED, DEVIATIONS) / (UNEVEN * deviation), 1.0).astype(
            np.float32
        )
        score /= cv2.resize(more, score.shape[::-1], interpolation=cv2.INTER_LINEAR)
    _even(score, *rim, (deviation / found).astype(np.float32))
    return deviation


@numba.njit(**PLAIN)
def _even(score: np.ndarray, rim: np.ndarray, ends: np.ndarray, factors: np.ndarray) -> None:
    flat = score.ravel()
    start = 0
    for zone in range(len(ends)):
        for k in range(start, ends[zone]):
            flat[rim[k]] *= factors[zone]
        start = ends[zone]


@numba.njit(**PLAIN)
def _scatter(
    score: np.ndarray, loud: np.ndarray, rim: np.ndarray, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the deviations (z,) of the scores (r, c) that are neither 0 nor ``loud`` in each
    zone, at least that of the last, from sizes up to `CAP`; and the sums of these sizes in squares
    of `PART_PX`, and their numbers."""
    (h, w), most, last = score.shape, np.float32(CAP), N_ZONES - 1
    rows = max(1, h // PART_PX)
    columns = max(1, w // PART_PX)
    sums = np.zeros((rows, columns))
    counts = np.zeros((rows, columns))
    whole = 0.0
    number = 0.0
    for row in range(rows):
        sizes = np.zeros(w, np.float32)
        numbers = np.zeros(w, np.int32)
        for i in range(row * h // rows, (row + 1) * h // rows):
            values = score[i]
            hidden = loud[i]
            for j in range(w):
                value = np.float32(0.0) if hidden[j] else values[j]
                sizes[j] += min(abs(value), most)
                numbers[j] += value != 0
        for part in range(columns):
            for j in range(part * w // columns, (part + 1) * w // columns):
                sums[row, part] += sizes[j]
                counts[row, part] += numbers[j]
            whole += sums[row, part]
            number += counts[row, part]
    totals = np.zeros(N_ZONES)
    known = np.zeros(N_ZONES)
    found = np.zeros(N_ZONES)
    flat = score.ravel()
    hides = loud.ravel()
    start = 0
    for zone in range(last):
        size = 0.0
        count = 0
        for k in range(start, ends[zone]):
            value = np.float32(0.0) if hides[rim[k]] else flat[rim[k]]
            size += min(abs(value), most)
            count += value != 0
        totals[zone], known[zone], start = size, count, ends[zone]
    totals[last], known[last] = whole - totals.sum(), number - known.sum()
    if known[last] < FEWEST:
        totals[last], known[last] = whole, number
    for zone in range(last, -1, -1):
        if zone == last or known[zone] >= FEWEST:
            found[zone] = DEVIATION_OF[int(STEPS * max(totals[zone], 0.0) / max(known[zone], 1.0))]
        found[zone] = max(found[zone], found[last])
    return found, sums, counts


@numba.njit(**PLAIN)
def _keep_stronger(  # type: ignore[no-untyped-def]
    signed, by, score, per_deviation, raised, down, right, number
):
    """Keep the larger of each pixel's scores (r, c) by size, and that template's ``number``.
    Scores are scaled by ``per_deviation`` and raised: their squares grow by ``raised``, in
    proportion below `FAINT`. Scores between pixels, ``down`` or ``right``, belong to all around.
    """
    scale = np.float32(per_deviation)
    more = np.float32(raised)
    faint = np.float32(per_deviation * np.sqrt(1.0 + raised / FAINT**2))
    height, width = score.shape
    for y in range(down + 1):
        for x in range(right + 1):
            for i in range(height - y):
                of = score[i]
                most = signed[i + y][x:]
                most_by = by[i + y][x:]
                for j in range(width - x):
                    size = min(abs(of[j]) * faint, np.sqrt((of[j] * scale) ** 2 + more))
                    stronger = size > abs(most[j])
                    most[j] = np.copysign(size, of[j]) if stronger else most[j]
                    most_by[j] = number if stronger else most_by[j]


def _tail(scores: np.ndarray, deviation: float) -> float:
    """Return how much farther the tail of scores (r, c) over their ``deviation`` reaches than a
    Gaussian's, on its shorter side; at least 1."""
    count = int(TAIL_SHARE * np.count_nonzero(scores))
    limit = TAIL_SIGMAS * deviation
    sides = [np.sort(np.abs(scores[beyond])) for beyond in (scores > limit, scores < -limit)]
    if count == 0 or min(map(len, sides)) < count:
        return 1.0
    return float(min(side[-count] for side in sides)) / limit


def _fill_discs(signed: np.ndarray, radius_px: np.ndarray) -> None:
    """Raise the scores (r, c) inside the disc of each wide template that peaks, so that it is one
    finding."""
    size = np.abs(signed)
    peaks = (size > STRONG / 2) & (radius_px >= WIDE_PX) & _highest(size)
    for row, column in np.argwhere(peaks).tolist():
        radius = int(radius_px[row, column])
        least = local.SADDLE * 1.01 * signed[row, column]
        cut = np.s_[
            max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1
        ]
        rows, columns = np.ogrid[: size[cut].shape[0], : size[cut].shape[1]]
        inside = (rows - min(row, radius)) ** 2 + (columns - min(column, radius)) ** 2 <= radius**2
        signed[cut][inside & (size[cut] < abs(least))] = least


def _highest(size: np.ndarray) -> np.ndarray:
    """Return (r, c) bool: pixels that are the largest within `ALONE_PX`."""
    return np.asarray(size >= cv2.dilate(size, np.ones((2 * ALONE_PX + 1,) * 2, np.uint8)))


def _cores(
    peaks: np.ndarray, radius_px: np.ndarray, values: np.ndarray, known: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (r, c) bool: the loud pixels under ``peaks`` (n, 2), weakest first, and what lies
    between them, where they fill a disc of the template's ``radius_px`` (n,). Also return their
    signed heights (r, c), up to 1, in proportion to the values over 3 x 3 pixels, so that two
    holes that touch keep two peaks; and each pixel's peak (r, c)."""
    core = np.zeros(known.shape, bool)
    signed = np.zeros(known.shape)
    peak_of = np.zeros(known.shape, np.intp)
    loud = known & (np.abs(values) > LOUD_SIGMAS)
    around = (cv2.blur(each, (3, 3)) for each in (values, known.astype(np.float32)))
    smooth = next(around) / np.maximum(next(around), 0.1)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(grown(loud, 1).astype(np.uint8))
    highest = np.full(count, -1)
    for peak, (row, column) in enumerate(peaks.tolist()):
        for number in np.unique(parts[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]):
            if (
                number > 0
                and stats[number, cv2.CC_STAT_AREA] > LOUD_SHARE * np.pi * radius_px[peak] ** 2
            ):
                highest[number] = peak
    for number in np.flatnonzero(highest >= 0):
        left, top, width, height = stats[number, :4]
        cut = np.s_[top : top + height, left : left + width]
        part = (parts[cut] == number) & known[cut]
        heights = smooth[cut][part].astype(np.float64)
        # quiet pixels between loud ones are not a finding of the other sign
        side = np.sign(heights[np.abs(heights).argmax()])
        heights = np.where(
            np.abs(heights) > LOUD_SIGMAS, heights, side * np.maximum(side * heights, 0.0)
        )
        signed[cut][part], peak_of[cut][part] = heights / np.abs(heights).max(), highest[number]
        core[cut] |= part
    return core, signed, peak_of


def _depth_px(known: np.ndarray) -> np.ndarray:
    """Return the distance (r, c) of each pixel to the outline of the known pixels, ignoring single
    unknown pixels."""
    padded = cv2.copyMakeBorder(known.astype(np.uint8), 2, 2, 2, 2, cv2.BORDER_CONSTANT)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    return np.ascontiguousarray(cv2.distanceTransform(closed, cv2.DIST_C, 3)[2:-2, 2:-2])


def _without_rim(noise: np.ndarray, depth_px: np.ndarray) -> np.ndarray:
    """Return the residuals (r, c) minus what they share, along some 65 pixels, with those at the
    same distance from the outline, beyond what those next to the rim share: subtracting a mean
    would leave a step there. Pixels whose ``depth_px`` (r, c) is 0 are unknown."""
    noise, sums = (
        noise.astype(np.float32),
        np.zeros((2, *(-(-side // LAYER_PX) for side in noise.shape), RIM_PX + 1)),
    )
    _layers(noise, depth_px, sums, True)
    side = 2 * (local.LEAST_WINDOW // LAYER_PX) + 1
    total, count = (cv2.blur(each, (side, side), borderType=cv2.BORDER_CONSTANT) for each in sums)
    sums[0] = total / np.maximum(count, 1e-6)
    sums[0] -= sums[0, ..., RIM_PX:]
    _layers(noise, depth_px, sums, False)
    return noise


@numba.njit(**PLAIN)
def _layers(noise: np.ndarray, depth_px: np.ndarray, sums: np.ndarray, summed: bool) -> None:
    """Add clipped residuals to ``sums``, and their numbers (2, r, c, `RIM_PX` + 1), in squares of
    `LAYER_PX`, for each distance from the outline within the rim, and for those next to it
    together; or subtract from the rim's residuals the first of the sums there."""
    for i in range(noise.shape[0]):
        for j in range(noise.shape[1]):
            if 0 < depth_px[i, j] <= (2 * RIM_PX if summed else RIM_PX):
                at = i // LAYER_PX, j // LAYER_PX, min(int(depth_px[i, j]) - 1, RIM_PX)
                if summed:
                    sums[0][at] += min(max(noise[i, j], -MODEST_SIGMAS), MODEST_SIGMAS)
                    sums[1][at] += 1
                else:
                    noise[i, j] -= np.float32(sums[0][at])
