"""The edge-preserving spatial filter of librealsense, on depth.

Source: librealsense, ``src/proc/spatial-filter.h`` and ``.cpp`` (Apache 2.0) and
``doc/post-processing-filters.md``: the recursive form of the domain transform of Gastal and
Oliveira (ACM Transactions on Graphics 30 (2011), 69). Orbbec's SDK documents a filter of the same
parameters (alpha, threshold, magnitude, radius) as ``SpatialAdvancedFilter``. Not modelled: the
form for disparity, which stereo cameras use."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from pydantic import Field

from detectors.filters.interface import DepthFunction, in_metres, in_units
from detectors.pixels.clusters import PLAIN
from harness.vocabulary.config import Config

UNLIMITED = 5  # the mode of ``holes_fill`` without a limit, for which the vendor's radius is 255


class SpatialConfig(Config):
    """Names, ranges and defaults are librealsense's.

    - ``filter_magnitude``: number of passes.
    - ``filter_smooth_alpha``: weight of the pixel against its smoothed neighbour; 1 smooths
      nothing.
    - ``filter_smooth_delta``: steps of the stored depth beyond which a difference is an edge.
    - ``holes_fill``: missing pixels along a row that take their neighbour's depth: none, fewer
      than 2, 4, 8 or 16, or up to 254."""

    filter_magnitude: int = Field(default=2, ge=1, le=5)
    filter_smooth_alpha: float = Field(default=0.5, ge=0.25, le=1)
    filter_smooth_delta: int = Field(default=20, ge=1, le=50)
    holes_fill: int = Field(default=0, ge=0, le=UNLIMITED)

    @property
    def fill_radius_px(self) -> int:
        """The vendor's radius: a run of missing pixels is filled as far as one less."""
        if self.holes_fill == UNLIMITED:
            return 255
        return 2**self.holes_fill if self.holes_fill else 0


@dataclass(frozen=True)
class SpatialFilter:
    """Smooths rows and columns, forwards and backwards, except across edges (librealsense)."""

    settings: SpatialConfig
    """Its settings."""
    settings_type = SpatialConfig
    name = "spatial"
    version = 1

    def started(self, unit_m: float, *, whole: bool) -> DepthFunction:
        """Return the function, which remembers no frame."""

        def filtered(z_m: np.ndarray) -> np.ndarray:
            units = in_units(z_m, unit_m, whole=whole)
            half = np.float32(0.5 if whole else 0.0)
            alpha = np.float32(self.settings.filter_smooth_alpha)
            delta = np.float32(self.settings.filter_smooth_delta)
            for _ in range(self.settings.filter_magnitude):
                _smooth_rows(units, alpha, delta, half, self.settings.fill_radius_px)
                _smooth_columns(units, alpha, delta, half)
            return in_metres(units, unit_m)

        return filtered


@numba.njit(**PLAIN)
def _mixed(new, old, alpha, half):  # type: ignore[no-untyped-def]
    """Return the weighted mean, rounded to whole numbers where ``half`` is 0.5."""
    mean = new * alpha + old * (np.float32(1.0) - alpha) + half
    return np.floor(mean) if half > 0 else mean


@numba.njit(**PLAIN)
def _smooth_rows(units, alpha, delta, half, radius):  # type: ignore[no-untyped-def]
    """Smooth each row (w,) of ``units`` (h, w) in place, to the right and then to the left. The
    rightmost pixel is only a neighbour, as in the source."""
    height, width = units.shape
    for v in range(height):
        for backwards in (False, True):
            before = units[v, width - 1] if backwards else units[v, 0]
            gap = 0
            for step in range(1, width if backwards else width - 1):
                u = width - 1 - step if backwards else step
                value = units[v, u]
                if before > 0 and value > 0:
                    gap = 0
                    if abs(value - before) <= delta:
                        value = _mixed(value, before, alpha, half)
                elif before > 0 and radius > 0:
                    gap += 1
                    if gap < radius:
                        value = before
                units[v, u] = value
                before = value


@numba.njit(**PLAIN)
def _smooth_columns(units, alpha, delta, half):  # type: ignore[no-untyped-def]
    """Smooth each column (h,) of ``units`` (h, w) in place, downwards and then upwards."""
    height, width = units.shape
    for backwards in (False, True):
        for step in range(1, height):
            v = height - 1 - step if backwards else step
            neighbour = v + 1 if backwards else v - 1
            for u in range(width):
                value = units[v, u]
                before = units[neighbour, u]
                if value > 0 and before > 0 and abs(value - before) < delta:
                    units[v, u] = _mixed(value, before, alpha, half)
