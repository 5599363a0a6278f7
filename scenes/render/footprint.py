"""Sub-rays of a pixel: directions of equal weight that stand for the pixel's area or the scanner's beam."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy.special import ndtri

from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from scenes.optics import FWHM_PER_DEVIATION, BeamFootprint, PixelFootprint

COARSE = 4
"""Sub-rays per side on a smooth surface: the midpoint rule leaves 1e-4 mm."""
FINE = 256
"""Sub-rays where a footprint meets an edge: one of them is 0.4 % of a step."""
FINEST = 2048
"""Sub-rays where that still leaves an error in a hole: a dark wall beside a strip of what lies behind."""
BEAM_REACH = 3.0
"""Standard deviations of a beam within which an edge is looked for: 1 % of the light lies beyond."""
GOLDEN = (np.sqrt(5) - 1) / 2


class Footprint(Protocol):
    """Where a pixel's light comes from. All sub-rays of a pixel weigh the same."""

    @property
    def reach_px(self) -> int:
        """How many pixels around an edge have a part of it in their footprint, besides the edge's own."""

    def coarse(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        """Slopes (n, COARSE^2, 2) of pixels of the region by row and column, a grid of COARSE x COARSE by rows."""

    def fine(self, rows: np.ndarray, cols: np.ndarray, count: int = FINE) -> np.ndarray:
        """Slopes (n, count, 2)."""


def footprint_of(lens: Lens, region: Region, kind: PixelFootprint | BeamFootprint) -> Footprint:
    """The footprint of a region's pixels."""
    if isinstance(kind, BeamFootprint):
        return Beams(lens, region, kind.fwhm_rad / FWHM_PER_DEVIATION)
    return Quadrilaterals(lens, region)


class Quadrilaterals:
    """An imager's pixels: the area between a pixel's corners, evenly weighted.

    Fine sub-rays lie on a golden lattice: an edge along the rows or columns, such as a board's, moves past them one by
    one and not sixteen at a time.
    Inside a pixel the lens is linear to 1e-7 in slope (0.1 um at 1 m), so slopes are interpolated between its corners.
    """

    reach_px = 1

    def __init__(self, lens: Lens, region: Region) -> None:
        v, u = np.mgrid[region.row0 : region.row1 + 1, region.col0 : region.col1 + 1] - 0.5
        self._corner = lens.slopes(u, v)

    def coarse(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        return self.strata(rows, cols, COARSE)

    def fine(self, rows: np.ndarray, cols: np.ndarray, count: int = FINE) -> np.ndarray:
        number = np.arange(count) + 0.5
        return self._placed(rows, cols, number / count, (number * GOLDEN) % 1)

    def strata(self, rows: np.ndarray, cols: np.ndarray, side: int) -> np.ndarray:
        """Slopes (n, side^2, 2) of the centres of side x side strata."""
        place = (np.arange(side) + 0.5) / side
        fy, fx = np.meshgrid(place, place, indexing="ij")
        return self._placed(rows, cols, fx.ravel(), fy.ravel())

    def _placed(self, rows: np.ndarray, cols: np.ndarray, fx: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """Slopes (n, m, 2) at fractions (m,) of pixels' widths and heights."""
        fx, fy, corner = fx[None, :, None], fy[None, :, None], self._corner
        c00, c01 = corner[rows, cols][:, None], corner[rows, cols + 1][:, None]
        c10, c11 = corner[rows + 1, cols][:, None], corner[rows + 1, cols + 1][:, None]
        return np.asarray((1 - fy) * ((1 - fx) * c00 + fx * c01) + fy * ((1 - fx) * c10 + fx * c11))


class Beams:
    """A scanner's beams: round Gaussians in angle about the pixels' central rays, cut nowhere.

    Fine sub-rays lie on a sunflower's spiral (Vogel, Mathematical Biosciences 44, 1979) at the radii of equal shares,
    so that a knife edge in any direction takes its share of the Gaussian within 0.02. The coarse grid has the
    Gaussian's second moments. Angles are taken as tangents: 1e-6 of themselves for milliradians.
    """

    def __init__(self, lens: Lens, region: Region, deviation_rad: float) -> None:
        self._slopes = lens.region_slopes(region)
        # Away from the axis an angle spans more slope, and so more pixels, by 1 + slope^2.
        widest = 1 + float((self._slopes**2).sum(axis=-1).max())
        self.reach_px = 1 + int(np.ceil(BEAM_REACH * deviation_rad * widest * max(lens.fx, lens.fy)))
        place = (np.arange(COARSE) + 0.5) / COARSE
        quantile = ndtri(place)
        quantile /= np.sqrt((quantile**2).mean())
        y, x = np.meshgrid(quantile, quantile, indexing="ij")
        self._deviation_rad = deviation_rad
        self._coarse = deviation_rad * np.column_stack([x.ravel(), y.ravel()])

    def coarse(self, rows: np.ndarray, cols: np.ndarray) -> np.ndarray:
        return self._turned(rows, cols, self._coarse)

    def fine(self, rows: np.ndarray, cols: np.ndarray, count: int = FINE) -> np.ndarray:
        number = np.arange(count) + 0.5
        radius = self._deviation_rad * np.sqrt(-2 * np.log1p(-number / count))
        angle = np.pi * (3 - np.sqrt(5)) * number
        spiral = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return self._turned(rows, cols, spiral - spiral.mean(axis=0))

    def _turned(self, rows: np.ndarray, cols: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Slopes (n, m, 2) of directions off the central ones by angles (m, 2) across the beam."""
        centre = np.concatenate([self._slopes[rows, cols], np.ones((len(rows), 1))], axis=-1)
        centre /= np.linalg.norm(centre, axis=-1, keepdims=True)
        across = np.cross([0.0, 1.0, 0.0], centre)
        across /= np.linalg.norm(across, axis=-1, keepdims=True)
        down = np.cross(centre, across)
        x, y, z = (
            centre[:, k, None] + across[:, k, None] * angles[:, 0] + down[:, k, None] * angles[:, 1] for k in range(3)
        )
        return np.stack([x / z, y / z], axis=-1)
