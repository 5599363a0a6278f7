"""The thesis' detector: a surface through the cropped cloud, points farther from it than k standard deviations,
clusters of them at 10 mm.

The text's variant: robust cubic by least absolute residuals, k robust standard deviations of the residual. The
script's (``variant: script``): least squares without cross terms, 1.2 standard deviations of the *raw z*.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from detectors.background import background
from detectors.crop import BoxCrop, CropConfig, crop
from detectors.interface import Evidence
from detectors.noise import median_of, rounding_floor, sigma_of
from detectors.score_map import ScoreMapConfig, ScoreMapDetector, on_grid
from detectors.surface import SurfaceConfig, fit_surface
from harness.vocabulary.capture import Cloud

SCRIPT_VARIANT: dict[str, Any] = {
    "surface": {"degree": 3, "method": "least_squares", "drop_cross_terms": True},
    "scale": "raw_z_std",
}
SCRIPT_THRESHOLD = 1.2
"""The script's k, in standard deviations of the raw z."""


class ThesisConfig(ScoreMapConfig):
    """``variant: script`` sets ``surface`` and ``scale`` as the script has them; what is given beside it still counts.

    ``surface``: with a shape other than ``polynomial`` one unit of score is the local noise, whatever ``scale`` says.
    ``scale``: the standard deviation that one unit of score means: ``mad`` (median |residual| / 0.6745),
    ``residual_std`` or ``raw_z_std``. ``use_variance``: where the cloud's maker states each point's variance, as a map
    does, one unit of score is a multiple of each point's own deviation, and the scale is taken of residuals over
    deviations (``raw_z_std`` knows no residual and leaves the variances alone).
    """

    variant: Literal["text", "script"] = "text"
    crop: CropConfig = Field(default_factory=BoxCrop)
    surface: SurfaceConfig = Field(default_factory=SurfaceConfig)
    scale: Literal["mad", "residual_std", "raw_z_std"] = "mad"
    use_variance: bool = True

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("variant") != "script":
            return data
        filled = {**SCRIPT_VARIANT, **data}
        if isinstance(data.get("surface"), dict):
            filled["surface"] = {**SCRIPT_VARIANT["surface"], **data["surface"]}
        return filled


class ThesisDetector(ScoreMapDetector[ThesisConfig]):
    """A surface through the cropped cloud; whatever lies k deviations off it, clustered: the thesis' way."""

    settings_type: ClassVar[type[ThesisConfig]] = ThesisConfig
    name = "thesis"
    version = 4

    @property
    def default_threshold(self) -> float | None:
        """Threshold k that the thesis states: 1.2 for the script; None for the text, whose k is set by hand or
        calibrated."""
        return SCRIPT_THRESHOLD if self.settings.variant == "script" else None

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score |residual| / scale of every pixel in the crop; a pixel is damage if its score is *above* k.

        Raises UserError on an empty crop and where the points do not determine the surface.
        """
        mask = crop(cloud, self.settings.crop)
        if self.settings.surface.shape != "polynomial":
            return self._before_background(cloud, mask)
        x, y, z = np.ascontiguousarray(cloud.points_m[mask].T)
        surface = fit_surface(x, y, z, self.settings.surface)
        fitted = surface.evaluate(x, y)
        residual = z - fitted
        floor = rounding_floor(cloud, mask)
        deviation = self._stated_deviation(cloud, mask)
        spread = _spread(residual if deviation is None else residual / deviation, z, self.settings.scale)
        typical = 1.0 if deviation is None else median_of(deviation)
        scale = max(spread, floor) if deviation is None else np.maximum(spread * deviation, floor)
        notes = {
            "surface": surface.note,
            "surface_iterations": surface.iterations,
            "surface_converged": surface.converged,
            "points": len(z),
            "spread_m": spread * typical,
            "floor_m": floor,
        }
        return Evidence(
            score=on_grid(np.abs(residual) / scale, mask),
            residual_m=on_grid(residual, mask),
            surface_z_m=on_grid(fitted, mask),
            scale_m=float(np.median(scale)),
            notes=notes,
        )

    def _before_background(self, cloud: Cloud, mask: np.ndarray) -> Evidence:
        """Analyse with a surface whose shape is chosen: one unit of score is the noise round about each pixel, so
        that neither the surface's misfit nor a noisy part of the target sets the scale of all of it."""
        behind = background(cloud, mask, self.settings.surface)
        unit = np.maximum(behind.noise_m, rounding_floor(cloud, mask))
        stated = self._stated_deviation(cloud, mask)
        if stated is not None:
            deviation = on_grid(stated, mask)
            known = np.isfinite(behind.residual_m)
            spread = sigma_of(behind.residual_m[known] / deviation[known])
            unit = np.maximum(unit, spread * deviation)
        return Evidence(
            score=np.abs(behind.residual_m) / unit,
            residual_m=behind.residual_m,
            surface_z_m=behind.surface_z_m,
            scale_m=float(np.nanmedian(unit)),
            notes={"surface": behind.description, **behind.notes},
            warnings=(behind.warning,) if behind.warning else (),
        )

    def _stated_deviation(self, cloud: Cloud, mask: np.ndarray) -> np.ndarray | None:
        """Return the standard deviation (n,) that the cloud states of each point, metres; None where it states none or
        none is wanted."""
        wanted = self.settings.use_variance and self.settings.scale != "raw_z_std"
        if cloud.mean_variance_m2 is None or not wanted:
            return None
        deviation: np.ndarray = np.sqrt(cloud.mean_variance_m2[mask])
        return deviation


def _spread(residual: np.ndarray, z: np.ndarray, scale: str) -> float:
    if scale == "mad":
        return sigma_of(residual)
    values = z if scale == "raw_z_std" else residual
    # MATLAB's std divides by n - 1
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
