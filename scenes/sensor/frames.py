"""Output of a camera: a frame of range with a reason for each invalid pixel, and sums over frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from harness.vocabulary.capture import Reason

N_REASONS = max(Reason) + 1
SUMMED = ("count", "total", "squares", "amplitude")


@dataclass(frozen=True)
class DecodedFrame:
    """A frame from a camera's own processing: ``z_m`` (h, w) float32, NaN where ``reason`` (h, w) uint8 is not VALID;
    ``amplitude`` (h, w) float32, in the camera's units."""

    z_m: np.ndarray
    reason: np.ndarray
    amplitude: np.ndarray


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
        """Return the same on a part of the pixels."""
        images = {name: getattr(self, name)[at] for name in ("base", *SUMMED)}
        return replace(self, reasons=self.reasons[:, *at], **images)

    def __add__(self, other: FrameTotals) -> FrameTotals:
        """Add the sums over other frames of the same view; step and base are equal."""
        sums = {name: getattr(self, name) + getattr(other, name) for name in ("frames", "reasons", *SUMMED)}
        return replace(self, **sums)
