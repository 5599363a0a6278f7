"""The temporal filter of librealsense, on depth: an exponential mean with persistence.

Source: librealsense, ``src/proc/temporal-filter.h`` and ``.cpp`` (Apache 2.0) and
``doc/post-processing-filters.md``. Luxonis documents the same modes of persistence for its
``TemporalFilter``. Depth in whole steps is cut, not rounded, after each mean, as in the source: a
static scene reads too near."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from detectors.filters.interface import DepthFunction, in_metres, in_units
from harness.vocabulary.config import Config

REMEMBERED = 8  # frames of history, a bit each
PERSISTENCE = {
    0: (0, 1),  # no history is long enough
    1: (8, 8),
    2: (3, 2),
    3: (4, 2),
    4: (8, 2),
    5: (2, 1),
    6: (5, 1),
    7: (8, 1),
    8: (0, 0),
}
"""(last frames, least number of them with a depth that agreed) from which a missing pixel keeps its
last depth, by ``holes_fill``: never, 8 of 8, 2 of 3, 2 of 4, 2 of 8, 1 of 2, 1 of 5, 1 of 8,
always."""


class TemporalConfig(Config):
    """Names, ranges and defaults are librealsense's.

    - ``filter_smooth_alpha``: weight of the new frame; 1 smooths nothing.
    - ``filter_smooth_delta``: steps of the stored depth from which a change starts the mean anew.
    - ``holes_fill``: mode of persistence, see `PERSISTENCE`."""

    filter_smooth_alpha: float = Field(default=0.4, ge=0, le=1)
    filter_smooth_delta: int = Field(default=20, ge=1, le=100)
    holes_fill: int = Field(default=3, ge=0, le=8)


@dataclass(frozen=True)
class TemporalFilter:
    """Averages pixels exponentially over frames and keeps depth that goes missing (librealsense).

    The first frame has no history and passes unchanged."""

    settings: TemporalConfig
    """Its settings."""
    settings_type = TemporalConfig
    name = "temporal"
    version = 1
    remembers_frames = True

    def started(self, unit_m: float, *, whole: bool) -> DepthFunction:
        """Return the function with an empty history."""
        history = _History(self.settings, whole)

        def filtered(z_m: np.ndarray) -> np.ndarray:
            return in_metres(history.after(in_units(z_m, unit_m, whole=whole)), unit_m)

        return filtered


@dataclass
class _History:
    """The past of a stream of frames."""

    settings: TemporalConfig
    """Settings of the filter."""
    has_whole_steps: bool
    """Whether depth is stored in whole steps."""
    last: np.ndarray | None = None
    """Last depth (h, w) of each pixel in steps, 0 for none yet."""
    agreed: np.ndarray = field(default_factory=lambda: np.zeros(0, np.uint8))
    """Frames (h, w) uint8 that agreed with their last depth: the newest in the highest bit."""

    def after(self, units: np.ndarray) -> np.ndarray:
        """Return the filtered depth (h, w) of the next frame, in steps."""
        if self.last is None:
            self.last = np.zeros_like(units)
            self.agreed = np.zeros(units.shape, np.uint8)
        newest = np.uint8(1 << (REMEMBERED - 1))
        is_there = units > 0
        has_last = self.last > 0
        agrees = (
            is_there & has_last & (np.abs(units - self.last) < self.settings.filter_smooth_delta)
        )
        alpha = np.float32(self.settings.filter_smooth_alpha)
        mean = alpha * units + (np.float32(1) - alpha) * self.last
        if self.has_whole_steps:
            mean = np.floor(mean)
        kept = ~is_there & has_last & self._persists()
        result = np.where(agrees, mean, units)
        self.last = np.where(is_there, result, self.last)
        self.agreed = self.agreed >> np.uint8(1)
        self.agreed[is_there & ~agrees] = 0
        self.agreed[is_there] |= newest
        return np.where(kept, self.last, result)

    def _persists(self) -> np.ndarray:
        """Return where enough of the last frames agreed, (h, w) bool."""
        frames, least = PERSISTENCE[self.settings.holes_fill]
        recent = (
            self.agreed >> np.uint8(REMEMBERED - frames) if frames else np.zeros_like(self.agreed)
        )
        return np.bitwise_count(recent) >= least
