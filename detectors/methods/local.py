"""Detects holes, dents and bumps by filters of several widths, each relative to its surroundings
and its local noise.

A pixel is judged by means over windows of several widths, each compared with the mean of its
surroundings. One unit of score is the standard deviation of that difference as measured nearby, so
that correlated noise, a fixed pattern and texture raise the threshold where they are. Near the
outline it includes the errors that an edge leaves there (`detectors.findings.rim`). Findings are
peaks of the score.

Not modelled: the noise's spectrum, damage narrower than a pixel or wider than the widest filter,
texture that resembles damage, and steps of the noise within a window."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import cv2
import numba
import numpy as np
from pydantic import Field, model_validator

from detectors.crop import AutoCrop, CropConfig, crop
from detectors.findings import whitening
from detectors.findings.measure import measure_detection
from detectors.findings.rim import on_pixels, reach_of, rim_variances
from detectors.findings.surroundings import HoleModelConfig
from detectors.interface import Detection, Evidence, Measurement
from detectors.pixels.clusters import PLAIN, root_of
from detectors.pixels.masks import outline_depth_px
from detectors.pixels.noise import average_variance_m2, median_of, rounding_variances, sigma_of
from detectors.pixels.ordering import falling_order
from detectors.score_map import Findings, above, on_grid
from detectors.surfaces.background import Background, background
from detectors.surfaces.shared import shared
from detectors.surfaces.smooth_surfaces import raster
from detectors.surfaces.surface import SurfaceConfig
from harness.vocabulary.config import Config
from harness.vocabulary.geometry import Cloud

HALF_WIDTHS = (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90)
"""Half-widths of the filters in pixels: a tent of half-width h is as wide at half of its height as
a hole of 2 h + 1 pixels. The ratio of 1.5 keeps nine tenths of the signal of a width between two
of them."""
SURROUNDINGS = 3  # steps by which a filter's surroundings are wider
WIDEST_SHARE = 6.0  # the target's least width in widths of the widest filter
FAINT = 0.02  # weight of the value 0 in every mean
CLIP_SIGMAS = 6.0
"""Clipping of single pixels in deviations of the local noise, because a flying pixel alone is no
finding."""
# the same for the local level and for surroundings, which damage must not shift
LEVEL_SIGMAS = 2.0
STRONG = 4.0
"""Pixels with such scores are excluded from surroundings and noise; with twice as much, from
others' wider means."""
GATE_SHARE = 0.5  # share of a wider filter's signal that narrower filters must confirm
GATE_SIGMAS = 1.5  # allowance for their noise

# --- the local noise ---

WINDOW_WIDTHS = 6
LEAST_WINDOW = 32
"""Half of the window of the local noise, in half-widths of the filter and at least in pixels: some
200 independent means, which give a standard deviation to 8 %."""
SAMPLES_SIDE = 14
"""Samples from the window's middle to its edge, because neighbours in a mean add nothing new."""
LEAST_SAMPLES = 32  # fewest finite samples of a local median

# --- peaks ---

SADDLE = 0.75  # two peaks are one if the saddle is higher than this share of the lower one
PROMINENCE = 1.5  # or fewer units of score below it
CORE = 0.5  # a finding's size is measured on the pixels with at least this share of its score


class FilterConfig(Config):
    """``hole_model``: measures sizes."""

    crop: CropConfig = Field(default_factory=AutoCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    hole_model: HoleModelConfig = Field(default_factory=HoleModelConfig)


class LocalConfig(FilterConfig):
    """``surface``: ``shape: auto`` unless a shape or degree is given. ``hole_model``: measures
    sizes."""

    @model_validator(mode="before")
    @classmethod
    def _chosen_shape(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        surface = data.get("surface", {})
        if not isinstance(surface, dict) or "shape" in surface or "degree" in surface:
            return data
        return {**data, "surface": {"shape": "auto", **surface}}


@dataclass(frozen=True, eq=False)
class LocalEvidence(Evidence):
    """Evidence of a detector that scores a picture."""

    signed: np.ndarray = None  # type: ignore[assignment]
    """(r, c): score of each cell of the picture, negative in front of the surface."""
    cell: np.ndarray = None  # type: ignore[assignment]
    """(h, w): flat index of each point's cell, -1 where there is no score."""
    spread_m: np.ndarray = None  # type: ignore[assignment]
    """(h, w): standard deviation of the surface itself, metres."""
    reach_px: float = 0.0
    """Cells to which an edge of the target reaches inwards."""


class LocalPicture(NamedTuple):
    """The residuals of a cloud on a grid of cells."""

    ground: Background
    """The fitted surface."""
    cell: np.ndarray
    """(h, w): flat index of each point's cell, -1 where there is none."""
    residuals: tuple[np.ndarray, np.ndarray, tuple[float, float]]
    """Arguments of `LocalDetector.scored`: residuals (r, c), metres; their weights (r, c), 0 where
    nothing is known; and the variances that rounding leaves (`rounding_variances`)."""
    reach_px: float
    """Cells to which an edge of the target reaches inwards."""


class LocalDetector:
    """Filters of several widths relative to their surroundings, in units of the local noise;
    findings are peaks."""

    settings_type: ClassVar[type[FilterConfig]] = LocalConfig
    name = "local"
    version = 8

    def __init__(self, settings: FilterConfig) -> None:
        self.settings = settings

    def picture(self, cloud: Cloud, pixels: int = 1) -> LocalPicture:
        """Return the residuals of the crop on a grid: the cloud's own, cut to its judged part, or
        a raster if it has none.

        For an organised cloud, they are the means over squares of ``pixels`` a side. Raises
        UserError on an empty crop, or if no surface can be fitted."""
        mask = crop(cloud, self.settings.crop)
        ground = shared(background, cloud, mask, self.settings.surface)
        judged = mask & np.isfinite(ground.residual_m)
        if cloud.organised:
            rows, columns = np.nonzero(judged)
            rows = (rows - rows.min()) // pixels
            columns = (columns - columns.min()) // pixels
        else:
            _, rows, columns, _ = raster(cloud.points_m[judged], cloud)
        shape = int(rows.max()) + 1, int(columns.max()) + 1
        cell = np.full(mask.shape, -1, dtype=np.int64)
        cell[judged] = rows * shape[1] + columns
        residuals = _on_cells(
            cloud,
            ground.residual_m,
            spread_m=ground.spread_m,
            cell=cell,
            shape=shape,
        )
        return LocalPicture(ground, cell, residuals, reach_of(cloud) / pixels)

    def analyse(self, cloud: Cloud) -> LocalEvidence:
        """Score every pixel of the crop. Raises UserError on an empty crop, or if no surface can
        be fitted."""
        ground, cell, residuals, reach_px = self.picture(cloud)
        signed, typical_m, unit = self.scored(*residuals, reach_px)
        judged = cell >= 0
        scores = on_grid(signed.ravel()[cell[judged]], judged)
        return LocalEvidence(
            score=np.abs(scores),
            residual_m=ground.residual_m,
            surface_z_m=ground.surface_z_m,
            scale_m=typical_m,
            notes={**ground.notes, "surface": ground.description, "points": int(judged.sum())},
            warnings=(ground.warning,) if ground.warning else (),
            behind=scores > 0,
            unit=unit,
            signed=signed,
            cell=cell,
            spread_m=ground.spread_m,
            reach_px=reach_px,
        )

    def rescored(
        self,
        cloud: Cloud,
        evidence: Evidence,
        residual_m: np.ndarray,
    ) -> LocalEvidence:
        """Return the evidence for other residuals (h, w) from the same surface, on the same
        pixels: as `analyse`, without a fit."""
        assert isinstance(evidence, LocalEvidence)
        residuals = _on_cells(
            cloud,
            residual_m,
            spread_m=evidence.spread_m,
            cell=evidence.cell,
            shape=evidence.signed.shape,
        )
        signed, typical_m, unit = self.scored(*residuals, evidence.reach_px)
        judged = evidence.cell >= 0
        scores = on_grid(signed.ravel()[evidence.cell[judged]], judged)
        return replace(
            evidence,
            score=np.abs(scores),
            residual_m=residual_m,
            scale_m=typical_m,
            behind=scores > 0,
            unit=unit,
            signed=signed,
        )

    def scored(
        self,
        residual_m: np.ndarray,
        weights: np.ndarray,
        rounding_m2: tuple[float, float],
        reach_px: float,
    ) -> tuple[np.ndarray, float, str]:
        """Return signed scores (r, c) of a picture of residuals with weights, 0 where nothing is
        known, and edges that reach so far; the deviation in metres of the narrowest filter at a
        typical point; and the meaning of a unit of score, in words."""
        signed, widths, typical_m = _scored(residual_m, weights, rounding_m2, reach_px)
        unit = (
            f"the local noise of means over {widths[0]} to {widths[-1]} pixels,"
            f" {1e3 * typical_m:.3g} mm for the narrowest at a typical point"
        )
        return signed, typical_m, unit

    def find(
        self,
        cloud: Cloud,
        evidence: Evidence,
        threshold: float,
    ) -> tuple[Detection, ...]:
        """Return peaks of the score, strongest first, each with the pixels above the threshold
        that belong to it. The centre is the mean of a finding's core, with pixels weighted by how
        far their score exceeds the core's least."""
        return self.findings(cloud, evidence, [threshold])[0].detections

    def findings(
        self,
        cloud: Cloud,
        evidence: Evidence,
        thresholds: Sequence[float],
    ) -> list[Findings]:
        """Return the results of `find` at each of the thresholds, which ascend."""
        assert isinstance(evidence, LocalEvidence)
        pixels = above(evidence, thresholds[0])
        scores = evidence.score.reshape(-1)[pixels]
        cell_of_pixel = evidence.cell.reshape(-1)[pixels]
        signed = evidence.signed
        # peaks join cells of their own sign only
        if not (signed.reshape(-1)[cell_of_pixel] > 0).any():
            signed = np.minimum(signed, 0.0)
        peaks = _peak_of_cells(signed, thresholds[0])[cell_of_pixel]
        # number the peaks that have pixels in the order of their heights
        numbers = np.cumsum(np.bincount(peaks) > 0) - 1
        labels = numbers[peaks]
        strengths = np.zeros(int(labels.max(initial=-1)) + 1)
        np.maximum.at(strengths, labels, scores)
        # by level and peak, the sums over pixels above the level's threshold: first over those not
        # above the next one
        level = np.searchsorted(thresholds, scores) - 1
        shape = (len(thresholds), len(strengths))
        cells = level * len(strengths) + labels

        def sums_above(values: np.ndarray) -> np.ndarray:
            sums = np.bincount(cells, values, shape[0] * shape[1]).reshape(shape)
            return np.cumsum(sums[::-1], axis=0)[::-1]

        excess = np.maximum(scores - CORE * strengths[labels], 0.0)
        x, y, z = cloud.points_m.reshape(-1, 3)[pixels].T
        weights = sums_above(excess)
        moments = [sums_above(excess * coordinate) for coordinate in (x, y, z)]
        findings = []
        for n, threshold in enumerate(thresholds):
            high = strengths > threshold
            exceeds = scores > threshold
            centres_m = [moment[n, high] / weights[n, high] for moment in moments]
            number = np.cumsum(high) - 1
            findings.append(
                Findings(
                    scores=strengths[high],
                    pixels=pixels[exceeds],
                    labels=number[labels[exceeds]],
                    centres_m=np.stack(centres_m, axis=-1),
                )
            )
        return findings

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return the highest score."""
        return float(np.nanmax(evidence.score, initial=0.0))

    def measure(
        self,
        cloud: Cloud,
        evidence: Evidence,
        detection: Detection,
    ) -> Measurement:
        """Measure the thesis' extents and the model of a blurred hole on the finding's core."""
        scores = evidence.score.reshape(-1)[detection.pixels]
        core = replace(detection, pixels=detection.pixels[scores >= CORE * detection.score])
        return measure_detection(cloud, evidence, core, self.settings.hole_model)


def _on_cells(
    cloud: Cloud,
    residual_m: np.ndarray,
    *,
    spread_m: np.ndarray,
    cell: np.ndarray,
    shape: tuple[int, ...],
) -> tuple[np.ndarray, np.ndarray, tuple[float, float]]:
    """Return the ``residuals`` of a `LocalPicture` (r, c) = ``shape`` from those of points (h, w),
    the surface's own deviation at each (h, w) and the cell of each (h, w)."""
    judged = cell >= 0
    cells = cell[judged]
    size = shape[0] * shape[1]
    share = _shares(
        cloud,
        judged,
        residual_m=residual_m[judged],
        spread_m=spread_m[judged],
    )
    weights = np.bincount(cells, share, size)
    typical = 1.0
    if not cloud.organised or np.bincount(cells).max() > 1:
        typical = median_of(weights[weights > 0])
    share = share / typical
    weights = (weights / typical).reshape(shape).astype(np.float32)
    sums = np.bincount(cells, share * residual_m[judged], size).reshape(shape)
    means_m = sums / np.maximum(weights, 1e-12)
    return means_m, weights, rounding_variances(cloud, judged)


def _shares(
    cloud: Cloud,
    judged: np.ndarray,
    *,
    residual_m: np.ndarray,
    spread_m: np.ndarray,
) -> np.ndarray:
    """Return the weight (n,) of each judged point: the median variance over its own, at most 4.

    The variance of a point is that of its z plus that of the surface itself.

    Args:
        cloud: may state the variances (`mean_variance_m2`).
        judged: (h, w) bool.
        residual_m: (n,), metres.
        spread_m: (n,), standard deviation of the surface itself, metres."""
    variances_m2 = _variances_m2(cloud, judged, residual_m)
    variances_m2 = np.maximum(variances_m2 + spread_m**2, 1e-18)
    return np.minimum(median_of(variances_m2) / variances_m2, 4.0)


def _variances_m2(cloud: Cloud, judged: np.ndarray, residual_m: np.ndarray) -> np.ndarray:
    """Return the variance (n,) of z of the judged points, whose residuals (n,) are given: as the
    cloud's maker states it, or from the scatter of frames nearby plus what is fixed in all frames;
    without either it is the same everywhere."""
    variance_m2 = sigma_of(residual_m) ** 2
    if cloud.mean_variance_m2 is not None:
        return cloud.mean_variance_m2[judged]
    noise_m2 = average_variance_m2(cloud, judged)
    if noise_m2 is None:
        return np.full(len(residual_m), variance_m2)
    random_m2 = noise_m2[judged]
    fixed_m2 = max(variance_m2 - median_of(random_m2), 0.0)
    return random_m2 + fixed_m2


# --- the score of all filters ---


def _scored(
    residual_m: np.ndarray,
    weights: np.ndarray,
    rounding_m2: tuple[float, float],
    reach_px: float,
) -> tuple[np.ndarray, list[int], float]:
    """Return signed scores (r, c) of a picture of residuals (r, c) with ``weights`` (r, c), 0
    where nothing is known, and edges that reach ``reach_px`` inwards; the filters' widths in
    pixels; and the deviation of the narrowest at a typical point, metres.

    The errors of an edge are alike along it, so that a filter's mean does not reduce their
    variance.

    Filters are applied from the narrowest to the widest. A pixel that is sure in one filter, by a
    share from 0 to 1, is excluded from the wider means of other pixels; a strong pixel is excluded
    from surroundings and noise. A sure pixel's score still grows with the width, if narrower means
    confirm it (`_strongest`)."""
    is_known = weights > 0
    # in units of a typical pixel's noise, so that single precision is enough
    unit_m = max(sigma_of(residual_m[is_known]), float(np.sqrt(sum(rounding_m2))), 1e-9)
    fixed = rounding_m2[0] / unit_m**2
    random = rounding_m2[1] / unit_m**2
    count = _filter_count(is_known)
    values: np.ndarray = (residual_m / unit_m).astype(np.float32)
    levelled, sigma = _levelled(values, weights, HALF_WIDTHS[count + SURROUNDINGS - 1])
    clipped = np.clip(levelled, -CLIP_SIGMAS * sigma, CLIP_SIGMAS * sigma)
    modest = np.clip(levelled, -LEVEL_SIGMAS * sigma, LEVEL_SIGMAS * sigma)
    rim = sigma**2 * _rim_variances(levelled / sigma, is_known, reach_px)

    best = np.zeros(is_known.shape, np.float32)
    sure = np.zeros_like(best)
    quiet = np.ones_like(best)
    typical_m = 0.0
    means = []
    surroundings = []
    deviations = []
    for half, wide in zip(HALF_WIDTHS[:count], HALF_WIDTHS[SURROUNDINGS:], strict=False):
        width = 2 * half + 1
        # a tent's mean of white noise has 4/9 of the variance of a square's
        floor = float(np.sqrt(fixed + random * (2.0 / 3.0 / width) ** 2))
        window = max(WINDOW_WIDTHS * width // 2, LEAST_WINDOW)
        mean, covered = _mean(clipped, (1.0 - sure) * weights, half)
        worth = np.sqrt(_worth((1.0 - sure) * weights, covered, half))
        rim_mean, _ = _mean(rim, weights, half)
        rim_mean = np.maximum(rim_mean, 0.0)  # the rounding of its sums may leave less than 0
        for _ in range(2):
            around, _ = _mean(modest, quiet * weights, wide)
            # scale differences to the noise of a whole window
            difference = (mean - around) * worth
            sigma = local_sigma(np.where(is_known & (quiet > 0), difference, np.nan), window, floor)
            sigma = np.hypot(sigma, worth * np.sqrt(rim_mean))
            score = np.where(is_known, difference / sigma, 0.0)
            quiet = np.minimum(quiet, np.clip(STRONG - np.abs(score), 0.0, 1.0))
        typical_m = typical_m or unit_m * float(np.median(sigma[is_known]))
        best = np.where((sure < 1.0) & (np.abs(score) > np.abs(best)), score, best)
        sure = np.maximum(sure, np.clip(np.abs(best) / STRONG - 1.0, 0.0, 1.0))
        # for sure pixels, the mean over all
        mean, covered = _mean(clipped, weights, half)
        means.append(mean)
        surroundings.append(around)
        deviations.append(sigma / np.sqrt(np.maximum(_worth(weights, covered, half), FAINT)))
    strongest = np.zeros_like(best)
    strongest[sure > 0] = _strongest(
        np.stack(means)[:, sure > 0],
        np.stack(surroundings)[:, sure > 0],
        np.stack(deviations)[:, sure > 0],
    )
    is_stronger = strongest * np.sign(best) > np.abs(best)
    signed = np.where(is_stronger, best + sure * (strongest - best), best)
    return signed.astype(np.float64), [2 * half + 1 for half in HALF_WIDTHS[:count]], typical_m


def _rim_variances(noise: np.ndarray, seen: np.ndarray, reach_px: float) -> np.ndarray:
    """Return the variances (r, c) that the ``seen`` pixels (r, c) of the rim have beyond the noise
    (r, c) of deviation 1."""
    depth_px = outline_depth_px(seen) * seen
    inner = depth_px > reach_px
    loud = (np.abs(noise) > STRONG).astype(np.uint8)
    quiet = inner & (cv2.dilate(loud, np.ones((5, 5), np.uint8)) == 0)
    values = np.where(seen, noise, 0.0).astype(np.float32)
    covariance = whitening.noise_covariance(values, quiet, whitening.grid_of(seen.shape))
    filters = whitening.filters(covariance, seen.shape)
    variances = rim_variances(values, depth_px, filters, reach_px, is_alone=True)
    return on_pixels(variances, depth_px)


def _filter_count(seen: np.ndarray) -> int:
    """Return how many of the filters fit a target: those whose width is a sixth of its own."""
    extent = min(int(seen.any(axis=0).sum()), int(seen.any(axis=1).sum()))
    narrow = [
        half for half in HALF_WIDTHS[:-SURROUNDINGS] if WIDEST_SHARE * (2 * half + 1) <= extent
    ]
    return max(1, len(narrow))


def _levelled(
    values: np.ndarray,
    weights: np.ndarray,
    widest: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return values (r, c) minus their level over the widest surroundings, and their local noise
    (r, c). Values count for the level only within `LEVEL_SIGMAS` of this noise."""
    total_weight = _tent(weights, widest) + FAINT
    level = np.zeros_like(values)
    for _ in range(3):
        levelled = values - level
        sigma = local_sigma(np.where(weights > 0, levelled, np.nan), LEAST_WINDOW, 1e-3)
        limit = LEVEL_SIGMAS * sigma
        level = level + _tent(np.clip(levelled, -limit, limit) * weights, widest) / total_weight
    return values - level, sigma


def _mean(
    values: np.ndarray,
    weights: np.ndarray,
    half: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted mean (r, c) of values, drawn towards 0 where little is known, and the
    mean of weights."""
    covered = _tent(weights, half)
    return _tent(values * weights, half) / (covered + FAINT), covered


def _tent(image: np.ndarray, half: int) -> np.ndarray:
    """Average over a square of 2 ``half`` + 1 pixels, twice; values beyond the edges count as 0."""
    size = (2 * half + 1, 2 * half + 1)
    once = cv2.blur(
        np.ascontiguousarray(image, np.float32),
        size,
        borderType=cv2.BORDER_CONSTANT,
    )
    return cv2.blur(once, size, borderType=cv2.BORDER_CONSTANT)


def _worth(
    weights: np.ndarray,
    covered: np.ndarray,
    half: int,
) -> np.ndarray:
    """Return the variance (r, c) of a tent's mean of white noise with all weights 1, over that of
    its mean with ``weights``, whose own mean is ``covered``."""
    width = 2 * half + 1
    total = width * (2 * width**2 + 1) / 3
    # in double precision, so that the order of sums does not depend on the orientation of the
    # picture
    squares = tent_squares(weights.astype(np.float64), width) / total**2
    worth = covered * np.minimum(covered / np.maximum(squares, 1e-6), 1.0)
    return worth.astype(np.float32)


def tent_squares(image: np.ndarray, width: int) -> np.ndarray:
    """Return the sums (r, c) of an image (r, c) float64 times the squares (``width`` - |d|)^2 of a
    tent along both axes; values beyond the edges count as 0.
    `detectors.methods.local_reference.tent_squares` is the same, written plainly."""
    down = _squares_down(image, width)
    return np.asarray(cv2.transpose(_squares_down(cv2.transpose(down), width)))


@numba.njit(**PLAIN)
def _squares_down(image: np.ndarray, width: int) -> np.ndarray:
    """Return the `tent_squares` (r, c) along columns only.

    The second difference of (n - |d|)^2 is 2 within the tent, 2 - 4 n at its middle, and 1 just
    beyond its ends. Summed twice it gives the squares back, in equal time for all widths."""
    height, length = image.shape
    nothing = np.zeros(length)
    inside = np.zeros(length)  # sums over the rows within the tent
    slope = np.zeros(length)
    total = np.zeros(length)
    squares = np.empty((height, length))
    for k in range(-width, height - 1):
        first = image[k - width] if k >= width else nothing
        middle = image[k] if k >= 0 else nothing
        entering = image[k + width - 1] if 0 <= k + width - 1 < height else nothing
        last = image[k + width] if k + width < height else nothing
        for j in range(length):
            inside[j] += entering[j] - first[j]
            slope[j] += 2.0 * inside[j] - 4.0 * width * middle[j] + first[j] + last[j]
            total[j] += slope[j]
        if k >= -1:
            squares[k + 1] = total
    return squares


def _strongest(
    means: np.ndarray,
    around: np.ndarray,
    deviation: np.ndarray,
) -> np.ndarray:
    """Return the largest (n,) (mean - around) / deviation by size, with its sign, over filters (k,
    n) from narrow to wide; 0 where no filter counts.

    A wide filter also covers what lies beside it. So it counts fully only if all narrower means
    depart from the same surroundings by `GATE_SHARE` of its own departure, minus `GATE_SIGMAS` of
    their deviations; it does not count if one departs by half as much."""
    best = np.zeros(means.shape[1], np.float32)
    for k in range(len(means)):
        signal = means[k] - around[k]
        with np.errstate(invalid="ignore", divide="ignore"):
            allowance = GATE_SIGMAS * deviation[:k] / np.abs(signal)
            confirmed = (means[:k] - around[k]) / signal + allowance
            say = np.maximum(2.0 * confirmed / GATE_SHARE - 1.0, 0.0).min(axis=0, initial=1.0)
            score = signal / deviation[k] * say
            best = np.where(np.abs(score) > np.abs(best), score, best)
    return best


# --- the local noise ---


def local_sigma(
    values: np.ndarray,
    half: int = LEAST_WINDOW,
    floor: float = 0.0,
    samples: int = SAMPLES_SIDE,
) -> np.ndarray:
    """Return the robust standard deviation (r, c) of the values' finite neighbours, from so many
    ``samples`` from the window's middle to its edge, interpolated between nodes ``half`` apart."""
    height, width = values.shape
    rows = _nodes(height, half)
    columns = _nodes(width, half)
    nodes = _local_medians(values, rows, columns, half, max(1, half // samples)) / 0.6745
    is_finite = np.isfinite(nodes)
    finite = nodes[is_finite] if is_finite.any() else np.abs(values[np.isfinite(values)]) / 0.6745
    everywhere = median_of(finite) if len(finite) else floor
    nodes = np.maximum(np.where(is_finite, nodes, everywhere), floor).astype(np.float32)
    even = cv2.blur(nodes, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return cv2.resize(even, (width, height), interpolation=cv2.INTER_LINEAR)


def _nodes(length: int, half: int) -> np.ndarray:
    """Return the centres of equal parts of some ``half`` pixels, as `cv2.resize` assumes, moved to
    pixels symmetrically about both ends."""
    count = max(1, round(length / half))
    half_pixel = 0.0
    if length % 2 == 0:
        count += count % 2
        half_pixel = 0.5
    from_middle = (np.arange(count) + 0.5) * length / count - 0.5 * length
    moved = np.sign(from_middle) * (np.round(np.abs(from_middle) - half_pixel) + half_pixel)
    return np.round(moved + 0.5 * (length - 1)).astype(np.int64)


@numba.njit(**PLAIN)
def _local_medians(
    values: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    half: int,
    stride: int,
) -> np.ndarray:
    """Return the medians (r, c) of finite sizes in windows of 2 ``half`` + 1 around nodes, every
    ``stride``-th."""
    h, w = values.shape
    medians = np.full((len(rows), len(columns)), np.nan)
    side = 2 * (half // stride) + 1
    sizes = np.empty(side * side, np.float32)
    reach = half // stride * stride
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            n = 0
            for y in range(row - reach, row + reach + 1, stride):
                if 0 <= y < h:
                    for x in range(column - reach, column + reach + 1, stride):
                        if 0 <= x < w and np.isfinite(values[y, x]):
                            sizes[n] = abs(values[y, x])
                            n += 1
            if n >= LEAST_SAMPLES:
                medians[i, j] = np.median(sizes[:n])
    return medians


# --- peaks ---


def _peak_of_cells(signed: np.ndarray, threshold: float) -> np.ndarray:
    """Return for each cell of the signed scores (r, c), flat, the number of its peak, which counts
    cells by falling score; -1 for cells far below the threshold.

    Saddles below a threshold also part or join peaks; otherwise a peak would be two at some
    thresholds. A lower threshold's saddles do not affect peaks above a higher one."""
    sizes = np.abs(signed).ravel()
    lowest_saddle = max(min(SADDLE * threshold, threshold - PROMINENCE), 0.0)
    cells = np.flatnonzero(sizes > lowest_saddle)
    order = cells[falling_order(sizes[cells])]
    peak_of = np.full(sizes.size, -1, dtype=np.int64)
    peak_of[order] = _peaks(signed, order, SADDLE, PROMINENCE)
    return peak_of


@numba.njit(**PLAIN)
def _peaks(
    score: np.ndarray,
    order: np.ndarray,
    saddle: float,
    prominence: float,
) -> np.ndarray:
    """Return (n,), for each of the pixels ``order`` (n,), flat indices in falling size of the
    score (h, w), the index in ``order`` of the peak that it belongs to.

    Pixels join the highest neighbouring peak of their sign; two peaks that meet become one by the
    rules of `SADDLE` and `PROMINENCE`."""
    h, w = score.shape
    index_of = np.full(h * w, -1, np.int64)
    parents = np.empty(len(order), np.int64)
    met = np.empty(8, np.int64)
    flat = score.ravel()
    for n in range(len(order)):
        pixel = order[n]
        parents[n] = n
        index_of[pixel] = n
        row = pixel // w
        column = pixel % w
        is_behind = flat[pixel] > 0
        count = 0
        for y in range(max(row - 1, 0), min(row + 2, h)):
            for x in range(max(column - 1, 0), min(column + 2, w)):
                neighbour = index_of[y * w + x]
                if neighbour >= 0 and neighbour != n and (flat[y * w + x] > 0) == is_behind:
                    met[count] = root_of(parents, neighbour)
                    count += 1
        if count == 0:
            continue
        # an earlier index is a higher peak
        highest = met[:count].min()
        parents[n] = highest
        height = abs(flat[pixel])
        for peak in met[:count]:
            top = abs(flat[order[peak]])
            if peak != highest and (height > saddle * top or top - height < prominence):
                parents[peak] = highest
    for n in range(len(order)):
        parents[n] = root_of(parents, n)
    return parents
