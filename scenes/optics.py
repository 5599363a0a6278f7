"""Cameras as the renderer sees them (lens, light, footprints), and the view that a sensor gets.
Slopes: x/z, y/z."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydantic import Field
from scipy.special import ndtri

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Lens, Region

FWHM_PER_DEVIATION = 2 * np.sqrt(2 * np.log(2))  # of a Gaussian


@dataclass(frozen=True)
class Optics:
    """The geometry of a camera's light, in the camera's frame.

    An imager looks through ``lens`` and is lit by a point of uniform intensity within a cone about
    the axis, with a linear roll-off between two half angles. A scanner sends its beam from the
    origin and receives at ``emitter_m``: by Helmholtz' reciprocity it is an imager whose pixels
    are beams and whose emitter is the receiver."""

    title: str
    """Name of the camera in messages."""
    lens: Lens
    """The lens, or the directions of a scanner's beams."""
    emitter_m: np.ndarray
    """(3,): the emitter, or a scanner's receiver."""
    full_half_angle_deg: float
    """Angle from the axis up to which the emitter has its full intensity."""
    cutoff_half_angle_deg: float
    """Angle at which nothing is left of it."""
    frequencies_hz: tuple[float, ...]
    """Modulation frequencies at which phasors are wanted."""
    wavelength_nm: float
    """Wavelength of the light."""
    margin_px: int
    """Pixels beyond a region whose light reaches it through the camera's own filter."""
    beam_fwhm_rad: float | None = None
    """Full width at half maximum of the beam, a round Gaussian in angle about the pixel's central
    ray; None for an imager, whose pixel is evenly weighted between its corners."""
    nearest_m: float = 0.0
    """The camera gives no range below; this changes no render."""
    farthest_m: float = float("inf")
    """The camera gives no range beyond; this changes no render."""
    limits_along: Literal["ray", "axis"] = "ray"
    """Direction along which these two count: the camera's rays or its axis."""

    def cone(self, slopes: np.ndarray) -> np.ndarray:
        """Return the emitter's light along rays from it (..., 2) relative to the axis."""
        full, cutoff = np.cos(np.radians([self.full_half_angle_deg, self.cutoff_half_angle_deg]))
        cosine = 1 / np.sqrt(1 + (slopes**2).sum(axis=-1))
        return np.clip((cosine - cutoff) / (full - cutoff), 0.0, 1.0)

    def content(self) -> dict[str, Any]:
        """Return all data that can change a render; equal for cameras that share renders."""
        return {
            "lens": [*self.lens.__dict__.values()],
            "emitter_m": self.emitter_m.tolist(),
            "half_angles_deg": [self.full_half_angle_deg, self.cutoff_half_angle_deg],
            "frequencies_hz": list(self.frequencies_hz),
            "beam_fwhm_rad": self.beam_fwhm_rad,
            "wavelength_nm": self.wavelength_nm,
            "margin_px": self.margin_px,
        }


def wave_numbers(frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return 2 pi f / c (f,) in rad per metre of full path, for the speed of light in air."""
    return 2 * np.pi * np.array(frequencies_hz, float) / SPEED_OF_LIGHT_AIR


COARSE = 4  # sub-rays per side on a smooth surface: the midpoint rule leaves 1e-4 mm
FINE = 256  # sub-rays where a footprint meets an edge: one of them is 0.4 % of a step
# deviations of a beam within which edges are considered: 1 % of the light lies beyond
BEAM_REACH = 3.0
GOLDEN = (np.sqrt(5) - 1) / 2


def footprint_of(
    lens: Lens,
    region: Region,
    beam_fwhm_rad: float | None,
) -> Quadrilaterals:
    """Return the footprints of a region's pixels: beams if the camera has a beam width."""
    if beam_fwhm_rad:
        return Beams(lens, region, beam_fwhm_rad / FWHM_PER_DEVIATION)
    return Quadrilaterals(lens, region)


class Quadrilaterals:
    """An imager's pixels: the areas between their corners, evenly weighted; slopes are linear
    within, to 1e-7. Fine sub-rays form a golden lattice, so that an edge along rows or columns
    crosses them one by one."""

    # distance from an edge within which footprints contain a part of it, besides the edge's own
    # pixels
    reach_px = 0

    def __init__(
        self,
        lens: Lens,
        region: Region,
    ) -> None:
        # slopes (h + 1, w + 1, 2) of the corners of the region's pixels
        corners = Region(region.row0, region.row1 + 1, region.col0, region.col1 + 1)
        self.corner = lens.region_slopes(corners, -0.5)

    def axes(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Return (n, 3, k): a pixel's sub-rays are these vectors, weighted by `grid` or `lattice`;
        z is 1."""
        c00 = self.corner[rows, cols]
        c01 = self.corner[rows, cols + 1]
        c10 = self.corner[rows + 1, cols]
        c11 = self.corner[rows + 1, cols + 1]
        axes = np.zeros((3, 4, len(rows)))
        axes[:2, 0] = c00.T
        axes[:2, 1] = (c01 - c00).T
        axes[:2, 2] = (c10 - c00).T
        axes[:2, 3] = (c00 - c01 - c10 + c11).T
        axes[2, 0] = 1.0
        return np.moveaxis(axes, 2, 0)

    def grid(self, side: int = COARSE) -> np.ndarray:
        """Return weights (k, side^2) of the centres of side x side cells of a pixel, row by row."""
        fy, fx = (np.indices((side, side)).reshape(2, -1) + 0.5) / side
        return np.stack([np.ones(side**2), fx, fy, fx * fy])

    def lattice(self, count: int = FINE) -> np.ndarray:
        """Return weights (k, count) of sub-rays where a footprint meets an edge."""
        number = np.arange(count) + 0.5
        fx = number / count
        fy = (number * GOLDEN) % 1
        return np.stack([np.ones(count), fx, fy, fx * fy])

    def slopes(
        self,
        rows: np.ndarray,
        cols: np.ndarray,
        weights: np.ndarray,
    ) -> np.ndarray:
        """Return slopes (n, m, 2) of the sub-rays of pixels with ``weights`` (k, m)."""
        rays = self.axes(rows, cols) @ weights
        return np.moveaxis(rays[:, :2] / rays[:, 2:], 1, 2)


class Beams(Quadrilaterals):
    """A scanner's beams: round Gaussians in angle about the pixels' central rays. Fine sub-rays
    lie on a sunflower's spiral (Vogel, Mathematical Biosciences 44, 1979) at radii of equal
    shares: a knife edge cuts off its share of the Gaussian to 0.02. The coarse grid has the
    Gaussian's second moments. Angles are approximated by tangents."""

    def __init__(
        self,
        lens: Lens,
        region: Region,
        deviation_rad: float,
    ) -> None:
        super().__init__(lens, region)
        self._slopes = lens.region_slopes(region)
        self._deviation_rad = deviation_rad
        # away from the axis, an angle spans a larger slope, and so more pixels, by 1 + slope^2
        widest = 1 + float((self._slopes**2).sum(axis=-1).max())
        reach_px = BEAM_REACH * deviation_rad * widest * max(lens.fx, lens.fy)
        self.reach_px = 1 + int(np.ceil(reach_px))

    def axes(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Return (n, 3, k): the central ray and two axes across it, for angles."""
        centre = np.concatenate([self._slopes[rows, cols], np.ones((len(rows), 1))], axis=-1)
        centre /= np.linalg.norm(
            centre,
            axis=-1,
            keepdims=True,
        )
        across = np.cross([0.0, 1.0, 0.0], centre)
        across /= np.linalg.norm(
            across,
            axis=-1,
            keepdims=True,
        )
        return np.stack([centre, across, np.cross(centre, across)], axis=-1)

    def grid(self, side: int = COARSE) -> np.ndarray:
        """Return weights (k, side^2) of a grid by rows."""
        quantile = ndtri((np.arange(side) + 0.5) / side)
        quantile *= self._deviation_rad / np.sqrt((quantile**2).mean())
        y, x = np.meshgrid(quantile, quantile, indexing="ij")
        return np.stack([np.ones(side**2), x.ravel(), y.ravel()])

    def lattice(self, count: int = FINE) -> np.ndarray:
        """Return weights (k, count) of sub-rays where a footprint meets an edge."""
        # a sunflower spiral: turned by the golden angle, at even quantiles of a Gaussian's radius
        number = np.arange(count) + 0.5
        radius = self._deviation_rad * np.sqrt(-2 * np.log1p(-number / count))
        angle = np.pi * (3 - np.sqrt(5)) * number
        spiral = radius * np.stack([np.cos(angle), np.sin(angle)])
        centred = spiral - spiral.mean(axis=1, keepdims=True)
        return np.concatenate([np.ones((1, count)), centred])


@dataclass(frozen=True)
class NoiseFreeView:
    """Noise-free light of a view on a region (h, w) of the sensor.

    Amplitudes are in units of an unoccluded albedo-1 Lambertian plane facing emitter and camera at
    1 m on the axis (=1)."""

    region: Region
    """The pixels."""
    frequencies_hz: tuple[float, ...]
    """Modulation frequencies."""
    phasor: np.ndarray
    """(f, h, w) complex64: per modulation frequency the light of all paths, sum over paths of a *
    exp(+i 2 pi f L / c), L the full path length. Its rounding turns 200 MHz by 10 nm."""
    phasor_direct: np.ndarray
    """(f, h, w) complex64: the part without interreflection."""
    intensity: np.ndarray
    """(h, w): the same sum at frequency 0."""
    indirect_noise_m: np.ndarray
    """(h, w): one standard deviation of range that the Monte Carlo part leaves in a pixel."""
    range_m: np.ndarray
    """(h, w): true distance from the lens along the pixel's central ray; NaN where it meets
    nothing."""
    surface: np.ndarray
    """(h, w) int16: index into ``surface_names`` at the central ray; -1 for nothing."""
    surface_names: tuple[str, ...]
    """Names of the surfaces."""
    coverage: np.ndarray
    """(h, w) float32: fraction of the footprint on that surface."""
    rgb: np.ndarray
    """(h, w, 3) float32: albedo at the central ray."""
    slopes: np.ndarray
    """(h, w, 2): x/z, y/z of the central ray."""
    seconds: float
    """Time that it took to compute."""
    variant: str
    """Name of what computed it: the variant of Mitsuba, or "closed form"."""


class RenderConfig(Config):
    """Effort for the simulation of indirect light. ``bounces: 0`` leaves direct light only."""

    bounces: int = Field(
        10,
        ge=0,
        le=32,
        description="reflections beyond the first; albedo 0.6 leaves 0.4 % after 10",
    )
    face_spacing_mm: float = Field(
        80.0,
        gt=0,
        description="spacing of the nodes on the face",
    )
    face_samples: int = Field(
        8192,
        ge=8,
        description="light paths for each node on the face",
    )
    hole_noise_mm: float = Field(
        0.1,
        gt=0,
        description="aim for the noise of range in pixels off the face",
    )
    hole_samples: int = Field(
        8192,
        ge=8,
        description="most light paths for each of those pixels",
    )
    rest_samples: int = Field(
        16,
        ge=8,
        description="light paths for each pixel around the board",
    )
    seed: int = Field(
        1,
        ge=0,
        le=1_000_000,
    )
