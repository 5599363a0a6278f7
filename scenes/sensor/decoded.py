"""What leaves a camera: one frame of range with a reason for each pixel that has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Decoded:
    """One frame from a camera's own processing: ``z_m`` (h, w) float32, NaN where ``reason`` (h, w) uint8 is not
    VALID; ``amplitude`` (h, w) float32, in the camera's units."""

    z_m: np.ndarray
    reason: np.ndarray
    amplitude: np.ndarray
