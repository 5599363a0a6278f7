"""Sums over frames of a capture: all that an average of them needs, and no frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.vocabulary.capture import Reason

N_REASONS = max(Reason) + 1


@dataclass(frozen=True)
class FrameTotals:
    """Sums over ``frames`` frames on (h, w) pixels, z in whole steps of ``step_m``, so that sums are exact.

    ``count`` of valid samples; of these ``total`` and ``squares`` of z less ``base``, and ``amplitude`` in the camera's
    units; ``reasons`` (r, h, w): how often each `Reason` was given.
    """

    frames: int
    step_m: float
    base: np.ndarray
    count: np.ndarray
    total: np.ndarray
    squares: np.ndarray
    amplitude: np.ndarray
    reasons: np.ndarray

    def cut(self, at: tuple[slice, slice]) -> FrameTotals:
        """The same on a part of the pixels."""
        return FrameTotals(
            self.frames,
            self.step_m,
            self.base[at],
            self.count[at],
            self.total[at],
            self.squares[at],
            self.amplitude[at],
            self.reasons[:, *at],
        )

    def __add__(self, other: FrameTotals) -> FrameTotals:
        """Both together; of one view, so that step and base are equal."""
        return FrameTotals(
            self.frames + other.frames,
            self.step_m,
            self.base,
            self.count + other.count,
            self.total + other.total,
            self.squares + other.squares,
            self.amplitude + other.amplitude,
            self.reasons + other.reasons,
        )
