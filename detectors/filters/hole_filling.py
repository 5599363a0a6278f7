"""The hole filling filter of librealsense: missing pixels take a neighbour's depth.

Source: librealsense, ``src/proc/hole-filling-filter.h`` and ``.cpp`` (Apache 2.0) and
``doc/post-processing-filters.md``. Orbbec's SDK documents nearest and farthest neighbours for its
``HoleFillingFilter`` too. "Hole" is the vendors' word for missing pixels, not for damage."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from pydantic import Field

from detectors.filters.interface import DepthFunction, in_metres, in_units
from detectors.pixels.clusters import PLAIN
from harness.vocabulary.config import Config

FROM_LEFT = 0
FARTHEST = 1
NEAREST = 2


class HoleFillingConfig(Config):
    """Name, range and default are librealsense's. ``holes_fill``: 0 takes the left neighbour's
    depth, 1 the farthest and 2 the nearest of the neighbours above, below and to the left."""

    holes_fill: int = Field(default=FARTHEST, ge=FROM_LEFT, le=NEAREST)


@dataclass(frozen=True)
class HoleFillingFilter:
    """Gives missing pixels a neighbour's depth (librealsense).

    It works row by row, so that what is filled fills the next."""

    settings: HoleFillingConfig
    """Its settings."""
    settings_type = HoleFillingConfig
    name = "hole_filling"
    version = 1

    def started(self, unit_m: float, *, whole: bool) -> DepthFunction:
        """Return the function, which remembers no frame."""

        def filtered(z_m: np.ndarray) -> np.ndarray:
            units = in_units(z_m, unit_m, whole=whole)
            if self.settings.holes_fill == FROM_LEFT:
                _fill_from_left(units)
            else:
                _fill_from_around(units, self.settings.holes_fill == FARTHEST)
            return in_metres(units, unit_m)

        return filtered


@numba.njit(**PLAIN)
def _fill_from_left(units):  # type: ignore[no-untyped-def]
    """Fill the missing pixels of ``units`` (h, w) in place."""
    height, width = units.shape
    for v in range(height):
        for u in range(1, width):
            if units[v, u] == 0:
                units[v, u] = units[v, u - 1]


@numba.njit(**PLAIN)
def _fill_from_around(units, farthest):  # type: ignore[no-untyped-def]
    """Fill the missing pixels of ``units`` (h, w) in place, but those of the first and last row
    and of the first column. The nearest of five neighbours is missing if the one above is, as in
    the source."""
    height, width = units.shape
    for v in range(1, height - 1):
        for u in range(1, width):
            if units[v, u] > 0:
                continue
            chosen = units[v - 1, u]
            for dv, du in ((-1, -1), (0, -1), (1, -1), (1, 0)):
                value = units[v + dv, u + du]
                if farthest:
                    chosen = max(chosen, value)
                elif 0 < value < chosen:
                    chosen = value
            units[v, u] = chosen
