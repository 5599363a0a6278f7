"""Optics of a camera, as the render needs them: its lens, the light of the scene, the frequencies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from harness.vocabulary.lens import Lens

FWHM_PER_DEVIATION = 2 * np.sqrt(2 * np.log(2))
"""Full width at half maximum of a Gaussian by its standard deviation."""


@dataclass(frozen=True)
class PixelFootprint:
    """An imager's pixel: the quadrilateral between the pixel's corners, evenly weighted."""


@dataclass(frozen=True)
class BeamFootprint:
    """A scanner's beam: a round Gaussian in angle about the pixel's central ray; full width at half maximum, rad."""

    fwhm_rad: float


@dataclass(frozen=True)
class Optics:
    """The geometry of a camera's light, in the camera's frame.

    An imager looks through ``lens`` and is lit by a point at ``emitter_m`` (3,), of uniform intensity within a cone
    about the axis with a linear roll-off between two half angles. A scanner sends its beam from the origin and
    receives at ``emitter_m``: on Lambertian surfaces the light of a path is the same in both directions (Helmholtz'
    reciprocity), so it is described as an imager whose pixels are beams and whose emitter is the receiver.
    ``frequencies_hz``: where phasors are wanted. ``margin_px``: pixels beyond a region whose light reaches it through
    the camera's own filter. ``wavelength_nm``: at which surfaces need an albedo. The camera gives no range below
    ``nearest_m`` or beyond ``farthest_m``, counted along its rays or its axis, whatever the light; they change no
    render.
    """

    title: str
    lens: Lens
    emitter_m: np.ndarray
    full_half_angle_deg: float
    cutoff_half_angle_deg: float
    frequencies_hz: tuple[float, ...]
    footprint: PixelFootprint | BeamFootprint
    wavelength_nm: float
    margin_px: int
    nearest_m: float = 0.0
    farthest_m: float = float("inf")
    limits_along: Literal["ray", "axis"] = "ray"

    def content(self) -> dict[str, Any]:
        """Plain data of everything here that can change a render; equal for cameras that share renders."""
        return {
            "lens": [*self.lens.__dict__.values()],
            "emitter_m": self.emitter_m.tolist(),
            "half_angles_deg": [self.full_half_angle_deg, self.cutoff_half_angle_deg],
            "frequencies_hz": list(self.frequencies_hz),
            "footprint": [type(self.footprint).__name__, *self.footprint.__dict__.values()],
            "wavelength_nm": self.wavelength_nm,
            "margin_px": self.margin_px,
        }
