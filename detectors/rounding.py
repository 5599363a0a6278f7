"""What rounding leaves in an average."""

from __future__ import annotations

import numpy as np

from detectors.median import median_of
from harness.vocabulary.capture import Cloud


def rounding_left_m2(step_m: float, dither_m2: float) -> float:
    """Variance that rounding to a step q leaves in the average of endless frames, whose noise before the rounding has
    the variance s^2 = ``dither_m2``: that of a fixed pattern.

    (q / pi)^2 / 2 * sum_k exp(-4 pi^2 k^2 s^2 / q^2) / k^2: q^2 / 12 without noise, next to nothing from s = q / 2.
    """
    k = np.arange(1, 200)
    left = (step_m / np.pi) ** 2 / 2.0 * float((np.exp(-((2.0 * np.pi * k) ** 2) * dither_m2 / step_m**2) / k**2).sum())
    return min(left, step_m**2 / 12.0)


def rounding_variances(cloud: Cloud, mask: np.ndarray) -> tuple[float, float]:
    """Variances that the rounding of z leaves in the average where ``mask`` (h, w) is true, square metres: of a fixed
    pattern, which neighbours may share, and of what differs from pixel to pixel.

    Rounding to a step q errs by q / sqrt(12). Noise of deviation s before the rounding (a dither) turns part of that
    into noise, which averages out, and leaves a fixed pattern with the variance b^2 (`rounding_left_m2`). So after n
    frames the rounding's variance is b^2 + (q^2 / 12 - b^2) / n. s^2 is the frames' median variance less q^2 / 12; on a
    surface so quiet that most pixels never change it is 0 and the rest stays q / sqrt(12), 0.29 mm for 1 mm; likewise
    where the averaged z still lies on the steps, as a median does. Without a step, z is taken to have been stored as
    float32.
    """
    z = cloud.points_m[..., 2][mask]
    step = cloud.z_step_m if cloud.z_step_m > 0 else float(np.finfo(np.float32).eps) * float(np.abs(z).max())
    whole = step**2 / 12.0
    if cloud.n_frames > 2 and _on_half_steps(z, step):
        return float(whole), 0.0
    variances = cloud.variance_m2[mask]
    variances = variances[np.isfinite(variances)]
    dither = max(median_of(variances) - whole, 0.0) if len(variances) else 0.0
    fixed = rounding_left_m2(step, dither)
    return fixed, (whole - fixed) / max(cloud.n_frames, 1)


def _on_half_steps(z: np.ndarray, step: float) -> bool:
    """Whether nine in ten of some points lie on multiples of half a step (the median of an even number of frames)."""
    some = z[:: max(1, len(z) // 1000)] / (0.5 * step)
    return bool(np.mean(np.abs(some - np.round(some)) < 0.01) > 0.9)
