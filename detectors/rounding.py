"""What rounding leaves in an average."""

from __future__ import annotations

import numpy as np


def rounding_left_m2(step_m: float, dither_m2: float) -> float:
    """Variance that rounding to a step q leaves in the average of endless frames, whose noise before the rounding has
    the variance s^2 = ``dither_m2``: that of a fixed pattern.

    (q / pi)^2 / 2 * sum_k exp(-4 pi^2 k^2 s^2 / q^2) / k^2: q^2 / 12 without noise, next to nothing from s = q / 2.
    """
    k = np.arange(1, 200)
    left = (step_m / np.pi) ** 2 / 2.0 * float((np.exp(-((2.0 * np.pi * k) ** 2) * dither_m2 / step_m**2) / k**2).sum())
    return min(left, step_m**2 / 12.0)
