"""The thesis' detector: it clusters points that lie more than k deviations from a surface. The
defaults follow the text: a robust cubic and a robust deviation of the residual. Its script uses
``surface: {method: least_squares, drop_cross_terms: true}, scale: raw_z_std`` with k = 1.2.
`highest_before` follows the text's rule against outliers."""

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from detectors.crop import BoxCrop, CropConfig, crop
from detectors.interface import Evidence
from detectors.pixels.noise import median_of, rounding_floor, sigma_of
from detectors.score_map import ScoreMapConfig, ScoreMapDetector, on_grid
from detectors.surfaces.background import background
from detectors.surfaces.shared import shared, stated_surface
from detectors.surfaces.surface import SurfaceConfig
from harness.vocabulary.geometry import Cloud


class ThesisConfig(ScoreMapConfig):
    """Settings of the thesis' detector.

    - ``scale``: the unit of score: ``mad`` (median |residual| / 0.6745), ``residual_std``,
      ``raw_z_std``, or ``highest_before``, the cloud's largest residual towards the camera, where
      no hole can be; k = 1 then requires a residual behind the surface to exceed it. With a shape
      other than ``polynomial``, the unit is the local noise.
    - ``use_variance``: whether a map's stated variance scales the unit at each point (not with
      ``raw_z_std``)."""

    crop: CropConfig = Field(default_factory=BoxCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    scale: Literal["mad", "residual_std", "raw_z_std", "highest_before"] = "mad"
    use_variance: bool = True


class ThesisDetector(ScoreMapDetector[ThesisConfig]):
    """The thesis' detector: clusters of points that lie k deviations off a surface through the
    cropped cloud."""

    settings_type: ClassVar[type[ThesisConfig]] = ThesisConfig
    name = "thesis"
    version = 11

    @property
    def default_threshold(self) -> float | None:
        """The threshold k that the thesis states: 1 with ``highest_before``, none with other
        scales."""
        return 1.0 if self.settings.scale == "highest_before" else None

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score |residual| / scale in the crop. Raises UserError if it determines no surface."""
        mask = crop(cloud, self.settings.crop)
        if self.settings.surface.shape != "polynomial":
            return self._before_background(cloud, mask)
        x = cloud.points_m[..., 0][mask]
        y = cloud.points_m[..., 1][mask]
        z = cloud.points_m[..., 2][mask]
        surface = shared(stated_surface, cloud, mask, self.settings.surface)
        fitted = surface.evaluate(x, y)
        residual_m = z - fitted
        floor_m = rounding_floor(cloud, mask)
        deviation = self._stated_deviation(cloud, mask)
        if deviation is None:
            deviation = np.ones(len(z))
        spread = self._spread(residual_m / deviation, z)
        scale_m = np.maximum(spread * deviation, floor_m)
        return Evidence(
            score=on_grid(np.abs(residual_m) / scale_m, mask),
            residual_m=on_grid(residual_m, mask),
            surface_z_m=on_grid(fitted, mask),
            scale_m=float(np.median(scale_m)),
            notes={
                "surface": surface.note,
                "points": len(z),
                "spread_m": spread * median_of(deviation),
                "floor_m": floor_m,
            },
            residual_along="axis",
        )

    def _spread(self, residuals: np.ndarray, z_m: np.ndarray) -> float:
        """Return the spread that makes one unit of score, from residuals (n,), in metres or over
        their stated deviations, or from z (n,)."""
        kind = self.settings.scale
        if kind == "mad":
            return sigma_of(residuals)
        if kind == "highest_before":
            return max(0.0, -float(residuals.min()))
        # MATLAB's std divides by n - 1
        values = z_m if kind == "raw_z_std" else residuals
        return float(np.std(values, ddof=min(1, len(values) - 1)))

    def _before_background(self, cloud: Cloud, mask: np.ndarray) -> Evidence:
        """Analyse with a surface whose shape is chosen. One unit of score is the noise around each
        pixel."""
        ground = shared(background, cloud, mask, self.settings.surface)
        unit_m = np.maximum(ground.noise_m, rounding_floor(cloud, mask))
        stated_m = self._stated_deviation(cloud, mask)
        if stated_m is not None:
            deviation_m = on_grid(stated_m, mask)
            is_known = np.isfinite(ground.residual_m)
            ratio = sigma_of(ground.residual_m[is_known] / deviation_m[is_known])
            unit_m = np.maximum(unit_m, ratio * deviation_m)
        return Evidence(
            score=np.abs(ground.residual_m) / unit_m,
            residual_m=ground.residual_m,
            surface_z_m=ground.surface_z_m,
            scale_m=float(np.nanmedian(unit_m)),
            notes={"surface": ground.description, **ground.notes},
            warnings=(ground.warning,) if ground.warning else (),
        )

    def rescored(self, cloud: Cloud, evidence: Evidence, residual_m: np.ndarray) -> Evidence:
        """Return the evidence for other residuals (h, w) from the same surface, in the same units
        of score."""
        with np.errstate(divide="ignore", invalid="ignore"):
            unit_m = np.abs(evidence.residual_m) / evidence.score
        unit_m[~(unit_m > 0)] = evidence.scale_m
        score = np.where(np.isfinite(evidence.score), np.abs(residual_m) / unit_m, np.nan)
        return replace(evidence, score=score, residual_m=residual_m)

    def _stated_deviation(self, cloud: Cloud, mask: np.ndarray) -> np.ndarray | None:
        """Return the standard deviation (n,) that the cloud states of each point, metres."""
        variance_m2 = cloud.mean_variance_m2
        if variance_m2 is None or not self.settings.use_variance:
            return None
        if self.settings.scale == "raw_z_std":
            return None
        return np.sqrt(variance_m2[mask])
