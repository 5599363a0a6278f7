"""Holes, dents and bumps against the surface around them: filters of several widths, each on the scale of its own local
noise.

A pixel is judged by means over windows of several widths against the mean of the surroundings of each. One unit of
score is the standard deviation of that difference as it is measured round about, so that correlated noise, a fixed
pattern and texture raise the threshold where they are, and only there. Findings are peaks of the score, so that
neighbouring holes stay apart.

Not modelled: the noise's spectrum (filters are not prewhitened), damage that is narrower than a pixel or wider than the
widest filter, what texture has in common with damage, and steps of the noise: within a window of one, the quiet side's
noise is taken for larger and the loud side's for smaller than it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, ClassVar

import cv2
import numpy as np
from pydantic import Field, model_validator

from detectors import local_kernels as kernels
from detectors.background import background
from detectors.crop import AutoCrop, CropConfig, crop
from detectors.interface import Detection, Evidence, Measurement
from detectors.measure import HoleModelConfig, measure_detection
from detectors.median import median_of, median_size_of
from detectors.rounding import rounding_variances
from detectors.score_map import above, on_grid
from detectors.smooth_surfaces import raster
from detectors.surface import SurfaceConfig
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config

HALF_WIDTHS = (1, 2, 3, 5, 8, 12, 18, 27, 40, 60, 90)
"""Of the filters, in pixels: a tent of half-width h is as wide at half of its height as a hole of 2 h + 1 pixels. The
ratio of 1.5 keeps nine tenths of the signal of a width between two."""
SURROUNDINGS = 3
"""The filter so many steps wider, 3.4 times as wide, is a filter's surroundings."""
WIDEST_SHARE = 6.0
"""The target is at least so many times as wide as the widest filter."""
FAINT = 0.02
"""Weight that 0 has in every mean."""
CLIP_SIGMAS = 6.0
"""Of the pixels' local noise: no single pixel counts for more, so that a flying pixel alone is no finding."""
LEVEL_SIGMAS = 2.0
"""The same for the local level and for surroundings, which damage must not draw."""
STRONG = 4.0
"""Pixels with such scores are kept out of surroundings and noise; from there to twice as much, by and by, out of the
wider means of other pixels too."""
GATE_SHARE, GATE_SIGMAS = 0.5, 1.5
"""What narrower filters must confirm of a wider one's signal, and the noise that is granted to them."""
WINDOW_WIDTHS, LEAST_WINDOW = 6, 32
"""Half of the window of the local noise: so many times the filter's half-width, and pixels at least: some 200
independent means, which give a standard deviation to 8 %."""
SAMPLES_SIDE = 14
"""Samples from the middle of such a window to its edge: neighbours in a mean tell nothing new."""
SADDLE, PROMINENCE = 0.75, 1.5
"""Two peaks are one finding where the saddle between them is higher than this share of the lower, or fewer units of
score below it than that."""
LEAST_FRAMES, SCATTER_PX = 4, 7
"""From so many frames on their scatter weighs pixels, averaged over a square: known to 12 % from 49 x 3 differences."""
CORE = 0.5
"""A finding's size is taken of the pixels with this share of its score or more."""


class LocalConfig(Config):
    """``surface``: the shape of the undamaged surface; chosen by evidence where neither shape nor degree is given.
    ``hole_model``: what sizes are measured with."""

    crop: CropConfig = Field(default_factory=AutoCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    hole_model: HoleModelConfig = Field(default_factory=HoleModelConfig)

    @model_validator(mode="before")
    @classmethod
    def _chosen_shape(cls, data: Any) -> Any:
        surface = data.get("surface", {}) if isinstance(data, dict) else None
        if not isinstance(surface, dict) or surface.keys() & {"shape", "degree"}:
            return data
        return {**data, "surface": {"shape": "auto", **surface}}


@dataclass(frozen=True)
class LocalEvidence(Evidence):
    """``signed`` (r, c): the score of each cell of a picture, negative before the surface. ``cell`` (h, w): the
    flat index of each point's cell in it, -1 where there is no score."""

    signed: np.ndarray = None  # type: ignore[assignment]
    cell: np.ndarray = None  # type: ignore[assignment]


class LocalDetector:
    """Filters of several widths against their surroundings, on the scale of the local noise; findings are peaks."""

    settings_type: ClassVar[type[LocalConfig]] = LocalConfig
    name = "local"
    version = 1

    def __init__(self, settings: LocalConfig) -> None:
        self.settings = settings

    def analyse(self, cloud: Cloud) -> LocalEvidence:
        """Score every pixel of the crop. Raises UserError on an empty crop and where no surface can be fitted."""
        mask = crop(cloud, self.settings.crop)
        ground = background(cloud, mask, self.settings.surface)
        judged = mask & np.isfinite(ground.residual_m)
        picture = _Picture.of(cloud, judged, _variances(cloud, judged, ground.residual_m))
        residual = picture.means(ground.residual_m[judged])
        fixed_m2, random_m2 = rounding_variances(cloud, judged)
        bank = _Bank(residual, picture.weights, (fixed_m2, random_m2), ground.scale_m)
        signed = bank.scores().astype(np.float64)
        cell = np.full(mask.shape, -1, dtype=np.int64)
        cell[judged] = picture.cell
        return LocalEvidence(
            score=on_grid(np.abs(signed.ravel()[picture.cell]), judged),
            residual_m=ground.residual_m,
            surface_z_m=ground.surface_z_m,
            scale_m=bank.typical_m,
            notes={
                **ground.notes,
                "surface": ground.description,
                "points": int(judged.sum()),
                "filters_px": bank.widths,
            },
            warnings=() if ground.fits else (ground.warning,),
            behind=on_grid(signed.ravel()[picture.cell], judged) > 0,
            unit=f"the local noise of means over {bank.widths[0]} to {bank.widths[-1]} pixels,"
            f" {1e3 * bank.typical_m:.3g} mm of the narrowest at a typical point",
            signed=signed,
            cell=cell,
        )

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        """Peaks of the score with the pixels above the threshold that belong to each, strongest first."""
        return tuple(
            Detection(float(scores.max()), pixels, _centre(cloud, pixels, scores))
            for pixels, scores in _findings(evidence, threshold)
        )

    def centres_at(self, cloud: Cloud, evidence: Evidence, thresholds: Sequence[float]) -> tuple[np.ndarray, ...]:
        """Where the findings at each threshold lie, (m, 3)."""
        found = ([_centre(cloud, *one) for one in _findings(evidence, float(k))] for k in thresholds)
        return tuple(np.array(centres).reshape(-1, 3) for centres in found)

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """The highest score."""
        return float(np.nanmax(evidence.score, initial=0.0))

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        """The thesis' extents, and the model of a blurred hole, of the finding's core."""
        scores = evidence.score.reshape(-1)[detection.pixels]
        core = replace(detection, pixels=detection.pixels[scores >= CORE * detection.score])
        return measure_detection(cloud, evidence, core, self.settings.hole_model)


def _findings(evidence: Evidence, threshold: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pixels and scores of each finding, strongest first."""
    assert isinstance(evidence, LocalEvidence)
    sizes = np.abs(evidence.signed).ravel()
    cells = np.flatnonzero(sizes > threshold)
    order = cells[np.argsort(-sizes[cells], kind="stable")]
    peak_of = np.full(sizes.size, -1, dtype=np.int64)
    peak_of[order] = kernels.peaks(evidence.signed, order, SADDLE, PROMINENCE)
    pixels = above(evidence, threshold)
    labels = peak_of[evidence.cell.reshape(-1)[pixels]]
    by_label = np.argsort(labels, kind="stable")
    bounds = np.flatnonzero(np.diff(labels[by_label], prepend=-1, append=-1))
    scores = evidence.score.reshape(-1)
    groups = [pixels[by_label[start:end]] for start, end in pairwise(bounds)]
    return [(group, scores[group]) for group in groups]


def _centre(cloud: Cloud, pixels: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """(3,) mean of a finding's core, each pixel weighted by how far its score exceeds the core's least."""
    excess = np.maximum(scores - CORE * scores.max(), 0.0)
    centre: np.ndarray = excess @ cloud.points_m.reshape(-1, 3)[pixels] / excess.sum()
    return centre


def _variances(cloud: Cloud, judged: np.ndarray, residual_m: np.ndarray) -> np.ndarray | None:
    """(n,) variance of each judged point, m^2: stated by the cloud's maker, else by the frames' scatter round about and
    what is fixed in all of them; None where neither is known.

    The frames tell of a louder patch to the pixel, the local noise only to half a window.
    """
    if cloud.mean_variance_m2 is not None:
        return np.maximum(cloud.mean_variance_m2[judged], 1e-18)
    seen = judged & np.isfinite(cloud.variance_m2)
    if not cloud.organised or cloud.n_frames < LEAST_FRAMES or seen.sum() < 0.5 * judged.sum():
        return None
    side = (SCATTER_PX, SCATTER_PX)
    known = cv2.blur(seen.astype(np.float64), side, borderType=cv2.BORDER_CONSTANT)
    scatter = cv2.blur(np.where(seen, cloud.variance_m2, 0.0), side, borderType=cv2.BORDER_CONSTANT)
    random = np.where(known > 0, scatter / np.maximum(known, 1e-9), np.nan)[judged] / cloud.n_frames
    typical = median_of(random[np.isfinite(random)])
    random = np.where(np.isfinite(random), random, typical)
    fixed = max((median_size_of(residual_m[judged]) / 0.6745) ** 2 - typical, 0.0)
    return np.maximum(random + fixed, 1e-18)


@dataclass(frozen=True)
class _Picture:
    """A grid that the points are filtered on: the cloud's own, cut to its judged part, or a raster where it has none.
    ``cell`` (n,): flat index of each point's cell; ``weights`` (r, c): 0 in empty cells, 1 for a typical point."""

    cell: np.ndarray
    weights: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, cloud: Cloud, judged: np.ndarray, variances: np.ndarray | None) -> _Picture:
        """A point's weight is the median variance over its own of ``variances`` (n,) m^2; 1 where they are None."""
        share = np.ones(int(judged.sum()))
        if variances is not None:
            share = np.minimum(median_of(variances) / variances, 4.0)
        if cloud.organised:
            rows, columns = np.nonzero(judged)
            rows, columns = rows - rows.min(), columns - columns.min()
        else:
            _, rows, columns, _ = raster(cloud.points_m[judged], cloud)
        shape = (int(rows.max()) + 1, int(columns.max()) + 1)
        cell = rows * shape[1] + columns
        weights = np.bincount(cell, share, shape[0] * shape[1])
        typical = 1.0 if cloud.organised else median_of(weights[weights > 0])
        return cls(cell, (weights / typical).reshape(shape).astype(np.float32), share / typical)

    def means(self, values: np.ndarray) -> np.ndarray:
        """(r, c) weighted means of the points' values (n,) in each cell; 0 in empty cells."""
        sums = np.bincount(self.cell, self.share * values, self.weights.size).reshape(self.weights.shape)
        return np.asarray(sums / np.maximum(self.weights, 1e-12))


class _Bank:
    """The filters on one picture: ``residual`` (r, c) metres with ``weights`` (r, c), 0 where nothing is known.
    ``rounding_m2``: variances that rounding leaves, the same in all neighbours and different in each."""

    def __init__(
        self, residual: np.ndarray, weights: np.ndarray, rounding_m2: tuple[float, float], scale_m: float | None
    ) -> None:
        self.weights, self.seen = weights, weights > 0
        # in units of the typical pixel's noise: single precision is then enough
        self.rounding_m2 = rounding_m2
        floor = float(np.sqrt(sum(rounding_m2)))
        self.unit_m = max(median_size_of(residual[self.seen]) / 0.6745, floor, 1e-9)
        extent = min(int(self.seen.any(axis=axis).sum()) for axis in (0, 1))
        count = max(1, sum(WIDEST_SHARE * (2 * h + 1) <= extent for h in HALF_WIDTHS[:-SURROUNDINGS]))
        self.halves = HALF_WIDTHS[:count]
        self.widths = [2 * h + 1 for h in self.halves]
        self.values, self.modest = self._clipped((residual / self.unit_m).astype(np.float32))
        self.typical_m = self.unit_m

    def scores(self) -> np.ndarray:
        """(r, c) float32 signed scores, from the narrowest filter to the widest.

        What is sure in one filter, by a share from 0 to 1, takes no part in the wider ones of other pixels, over which
        it would spread; what is strong takes no part in the surroundings and in the noise. A sure pixel's score still
        grows with the width, where narrower means confirm it (`local_kernels.strongest`).
        """
        best = np.zeros(self.seen.shape, np.float32)
        sure, quiet = np.zeros_like(best), np.ones_like(best)
        means: list[np.ndarray] = []
        surroundings: list[np.ndarray] = []
        deviations: list[np.ndarray] = []
        for half, wide in zip(self.halves, HALF_WIDTHS[SURROUNDINGS:], strict=False):
            mean, covered = self._mean(self.values, (1.0 - sure) * self.weights, half)
            for _ in range(2):
                around, _ = self._mean(self.modest, quiet * self.weights, wide)
                sigma = self._sigma((mean - around) * np.sqrt(covered), quiet, half)
                score = np.where(self.seen, (mean - around) * np.sqrt(covered) / sigma, 0.0)
                quiet = np.minimum(quiet, np.clip(STRONG - np.abs(score), 0.0, 1.0))
            if not deviations:
                self.typical_m = self.unit_m * float(np.median(sigma[self.seen]))
            best = np.where((sure < 1.0) & (np.abs(score) > np.abs(best)), score, best)
            sure = np.maximum(sure, np.clip(np.abs(best) / STRONG - 1.0, 0.0, 1.0))
            mean, covered = self._mean(self.values, self.weights, half)
            means.append(mean)
            surroundings.append(around)
            deviations.append(sigma / np.sqrt(np.maximum(covered, FAINT)))
        grown = kernels.strongest(
            np.stack(means), np.stack(surroundings), np.stack(deviations), sure > 0, GATE_SHARE, GATE_SIGMAS
        )
        return np.where(grown * np.sign(best) > np.abs(best), best + sure * (grown - best), best)

    def _mean(self, values: np.ndarray, weights: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
        """Weighted mean of values, drawn towards 0 where hardly anything is known, and what it is worth (`_worth`),
        both (r, c)."""
        covered = _tent(weights, half)
        return _tent(values * weights, half) / (covered + FAINT), _worth(weights, covered, half)

    def _sigma(self, differences: np.ndarray, quiet: np.ndarray, half: int) -> np.ndarray:
        """(r, c) deviation of a filter's differences, which are brought to the noise of a whole window."""
        fixed, random = (variance / self.unit_m**2 for variance in self.rounding_m2)
        width = 2 * half + 1
        # a tent's mean of white noise has 4/9 of the variance of a square's
        floor = float(np.sqrt(fixed + random * (2.0 / 3.0 / width) ** 2))
        window = max(WINDOW_WIDTHS * width // 2, LEAST_WINDOW)
        return _local_sigma(np.where(self.seen & (quiet > 0), differences, np.nan), window, floor)

    def _clipped(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The values less their local level, no farther from it than `CLIP_SIGMAS` of the local noise for the filters,
        and than `LEVEL_SIGMAS` for their surroundings."""
        wide = HALF_WIDTHS[len(self.halves) + SURROUNDINGS - 1]
        known = _tent(self.weights, wide) + FAINT
        level = np.zeros_like(values)
        for _ in range(3):
            rest = values - level
            sigma = _local_sigma(np.where(self.seen, rest, np.nan), LEAST_WINDOW, 1e-3)
            limit = LEVEL_SIGMAS * sigma
            level = level + _tent(np.clip(rest, -limit, limit) * self.weights, wide) / known
        modest, limit = LEVEL_SIGMAS * sigma, CLIP_SIGMAS * sigma
        rest = values - level
        return np.clip(rest, -limit, limit), np.clip(rest, -modest, modest)


def _tent(image: np.ndarray, half: int) -> np.ndarray:
    """Mean over a square of 2 ``half`` + 1 pixels, twice; what lies beyond the edges counts as 0."""
    size = (2 * half + 1, 2 * half + 1)
    once = cv2.blur(np.ascontiguousarray(image, np.float32), size, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(cv2.blur(once, size, borderType=cv2.BORDER_CONSTANT))


def _worth(weights: np.ndarray, covered: np.ndarray, half: int) -> np.ndarray:
    """(r, c) the variance of a tent's mean of white noise where all weights are 1 over that of its mean by ``weights``,
    whose own mean is ``covered``. Beside a rim or an object single pixels may be all that a narrow filter holds."""
    side = np.convolve(np.ones(2 * half + 1), np.ones(2 * half + 1)) ** 2
    side /= side.sum()
    # in double precision, so that the order of its sums does not tell which way the picture is turned
    squares = cv2.sepFilter2D(weights.astype(np.float64), -1, side, side, borderType=cv2.BORDER_CONSTANT)
    return np.asarray((covered * np.minimum(covered / np.maximum(squares, 1e-6), 1.0)).astype(np.float32))


def _local_sigma(values: np.ndarray, half: int, floor: float) -> np.ndarray:
    """(r, c) robust standard deviation of the values' finite neighbours, interpolated between nodes ``half`` apart."""
    rows, columns = (_nodes(length, half) for length in values.shape)
    sizes = np.abs(values).astype(np.float32)
    nodes = kernels.local_medians(sizes, rows, columns, half, max(1, half // SAMPLES_SIDE)) / 0.6745
    known = np.isfinite(nodes)
    everywhere = float(np.median(nodes[known])) if known.any() else float(np.nanmedian(sizes)) / 0.6745
    nodes = np.maximum(np.where(known, nodes, everywhere), floor).astype(np.float32)
    h, w = values.shape
    even = cv2.blur(nodes, (3, 3), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(even, (w, h), interpolation=cv2.INTER_LINEAR))


def _nodes(length: int, spacing: int) -> np.ndarray:
    """Middles of equal parts of about ``spacing`` pixels, where `cv2.resize` takes its samples to lie, moved to pixels
    such that they lie alike from both ends."""
    count = max(1, round(length / spacing))
    count += (length - count) % 2 if length % 2 == 0 else 0
    half_pixel = 0.5 if length % 2 == 0 else 0.0
    from_middle = (np.arange(count) + 0.5) * length / count - 0.5 * length
    moved = np.sign(from_middle) * (np.round(np.abs(from_middle) - half_pixel) + half_pixel)
    return np.asarray(np.round(moved + 0.5 * (length - 1)).astype(np.int64))
