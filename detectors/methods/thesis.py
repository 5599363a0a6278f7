"""The thesis' detector: it clusters points that lie more than k deviations from a surface. The
defaults follow the text: a robust cubic and a robust deviation of the residual. Its script uses
``surface: {method: least_squares, drop_cross_terms: true}, scale: raw_z_std`` with k = 1.2.
`highest_before` follows the text's rule against outliers."""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from detectors.averages.noise import median_of, rounding_floor, sigma_of
from detectors.crop import BoxCrop, CropConfig, crop
from detectors.interface import Evidence
from detectors.score_map import ScoreMapConfig, ScoreMapDetector, on_grid
from detectors.surfaces.background import background
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from harness.vocabulary.geometry import Cloud


class ThesisConfig(ScoreMapConfig):
    """``scale``: the unit of score: ``mad`` (median |residual| / 0.6745), ``residual_std``,
    ``raw_z_std``, or ``highest_before``, the cloud's largest residual towards the camera, where no
    hole can be; k = 1 then requires a residual behind the surface to exceed it. With a shape other
    than ``polynomial``, the unit is the local noise. ``use_variance``: whether a map's stated
    variance scales the unit at each point (not with ``raw_z_std``)."""

    crop: CropConfig = Field(default_factory=BoxCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    scale: Literal["mad", "residual_std", "raw_z_std", "highest_before"] = "mad"
    use_variance: bool = True


class ThesisDetector(ScoreMapDetector[ThesisConfig]):
    """The thesis' detector: clusters of points that lie k deviations off a surface through the
    cropped cloud."""

    settings_type: ClassVar[type[ThesisConfig]] = ThesisConfig
    name = "thesis"
    version = 6

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
        x, y, z = (cloud.points_m[..., axis][mask] for axis in range(3))
        surface = fit_surface(x, y, z, self.settings.surface)
        fitted = surface.evaluate(x, y)
        residual = z - fitted
        floor = rounding_floor(cloud, mask)
        deviation = self._stated_deviation(cloud, mask)
        off = residual if deviation is None else residual / deviation
        kind = self.settings.scale
        if kind == "mad":
            spread = sigma_of(off)
        elif kind == "highest_before":
            spread = max(0.0, -float(off.min()))
        else:  # MATLAB's std divides by n - 1
            spread = float(np.std(z if kind == "raw_z_std" else off, ddof=min(1, len(z) - 1)))
        typical = 1.0 if deviation is None else median_of(deviation)
        scale = max(spread, floor) if deviation is None else np.maximum(spread * deviation, floor)
        notes = {
            "surface": surface.note,
            "points": len(z),
            "spread_m": spread * typical,
            "floor_m": floor,
        }
        score = on_grid(np.abs(residual) / scale, mask)
        residual_m = on_grid(residual, mask)
        z_m = on_grid(fitted, mask)
        return Evidence(score, residual_m, z_m, float(np.median(scale)), notes)

    def _before_background(self, cloud: Cloud, mask: np.ndarray) -> Evidence:
        """Analyse with a surface whose shape is chosen. One unit of score is the noise around each
        pixel."""
        behind = background(cloud, mask, self.settings.surface)
        unit = np.maximum(behind.noise_m, rounding_floor(cloud, mask))
        stated = self._stated_deviation(cloud, mask)
        if stated is not None:
            deviation = on_grid(stated, mask)
            known = np.isfinite(behind.residual_m)
            unit = np.maximum(
                unit, sigma_of(behind.residual_m[known] / deviation[known]) * deviation
            )
        score = np.abs(behind.residual_m) / unit
        notes = {"surface": behind.description, **behind.notes}
        warnings = (behind.warning,) if behind.warning else ()
        return Evidence(
            score, behind.residual_m, behind.surface_z_m, float(np.nanmedian(unit)), notes, warnings
        )

    def _stated_deviation(self, cloud: Cloud, mask: np.ndarray) -> np.ndarray | None:
        """Return the standard deviation (n,) that the cloud states of each point, metres."""
        wanted = self.settings.use_variance and self.settings.scale != "raw_z_std"
        known = cloud.mean_variance_m2 if wanted else None
        return None if known is None else np.asarray(np.sqrt(known[mask]))
