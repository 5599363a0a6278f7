"""Noise of a view's depth, estimated from the capture itself: the variance of each pixel's z from a law, not a sample.

The law is v = k q + c with q = 1 / amplitude^2 (phase noise of a correlation camera falls as 1 / amplitude: Lange and
Seitz 2001) and c what does not depend on it (rounding, jitter). A sample variance of ten frames is off by a factor of
two either way; as a weight it would favour pixels that are quiet by chance. Without amplitude q is the range to the
fourth: what comes back falls with its square.

Not modelled: noise that frames share (slow drift), multipath, and the fixed pattern, which no capture of a static view
shows; several views do (`detectors.mapping.combine`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detectors.noise import rounding_left_m2
from harness.vocabulary.capture import Cloud

BINS, PER_BIN = 16, 40
"""Classes of q with equal numbers of pixels, and the least number worth a median."""
SAMPLED = 16_384
"""Pixels from which the law is read, evenly taken: each class' median is then known to 7 % from three frames."""
LEAST_M2 = 1e-14
"""(0.1 um)^2: no point is known better, and no weight is infinite."""


@dataclass(frozen=True)
class DepthNoise:
    """Variance of one frame's z at a pixel: ``slope`` * q / ``typical`` + ``constant``, m^2. ``source`` says what it
    was read off."""

    slope: float
    constant: float
    typical: float
    source: str

    def frame_variance(self, cloud: Cloud) -> np.ndarray:
        """(h, w) of one frame's z, NaN where the cloud has no point."""
        return self.slope * _regressor(cloud) / self.typical + self.constant

    def mean_variance(self, cloud: Cloud) -> np.ndarray:
        """(h, w) of the average's z: the scatter of frames over their number, and what rounding leaves in any average,
        which no scatter shows: where frames repeat each other exactly it is all there is."""
        variance = self.frame_variance(cloud)
        left = 0.0
        if cloud.z_step_m > 0 and self.source == "frames":
            left = rounding_left_m2(cloud.z_step_m, max(self.slope + self.constant - cloud.z_step_m**2 / 12.0, 0.0))
        with np.errstate(invalid="ignore", divide="ignore"):
            mean: np.ndarray = variance / cloud.count + left
        return np.maximum(mean, LEAST_M2)


def noise_of(cloud: Cloud, inside: np.ndarray, deviation_m: np.ndarray) -> DepthNoise:
    """The law of one view, from the sample variances of its frames inside the target.

    ``deviation_m`` (h, w): z less the view's own smooth surface; where there is one frame only, its squares stand in
    for the variances, so the fixed pattern counts as noise.
    """
    repeated = inside & (cloud.count > 1) & np.isfinite(cloud.variance_m2)
    if repeated.sum() >= PER_BIN:
        source, used = "frames", repeated
        samples, freedom = cloud.variance_m2[used], cloud.count[used].astype(np.float64) - 1.0
    else:
        source, used = "surface", inside & np.isfinite(deviation_m)
        # one sample has the variance of a frame: `mean_variance` divides by their number again
        samples, freedom = deviation_m[used] ** 2 * cloud.count[used], np.ones(int(used.sum()))
    q = _regressor(cloud)[used]
    if len(q) == 0:
        return DepthNoise(0.0, LEAST_M2, 1.0, source)
    some = slice(None, None, max(1, len(q) // SAMPLED))
    q, samples, freedom = q[some], samples[some], freedom[some]
    typical = float(np.median(q))
    slope, constant = _law(q / typical, samples / _median_chi_square(freedom))
    return DepthNoise(slope, constant, typical, source)


def _regressor(cloud: Cloud) -> np.ndarray:
    """(h, w) q: 1 / amplitude^2, or range^4 where a tenth of the points has no amplitude."""
    valid = cloud.valid
    if cloud.amplitude is not None:
        known = valid & (np.nan_to_num(cloud.amplitude) > 0)
        if known.sum() >= 0.9 * valid.sum():
            with np.errstate(divide="ignore", invalid="ignore"):
                q = 1.0 / cloud.amplitude**2
            return np.where(known, q, np.where(valid, np.median(q[known]), np.nan))
    return np.einsum("...i,...i->...", cloud.points_m, cloud.points_m) ** 2


def _median_chi_square(freedom: np.ndarray) -> np.ndarray:
    """(n,) median of a sample variance over its expectation."""
    from scipy.stats import chi2

    numbers, places = np.unique(freedom, return_inverse=True)
    medians: np.ndarray = (chi2.median(numbers) / numbers)[places]
    return medians


def _law(q: np.ndarray, variances: np.ndarray) -> tuple[float, float]:
    """(slope, constant), neither negative, through the medians of classes of q: robust against damage in the view."""
    from scipy.optimize import nnls

    classes = max(1, min(BINS, len(q) // PER_BIN))
    parts = np.array_split(np.argsort(q, kind="stable"), classes)
    middle = np.array([np.median(q[part]) for part in parts])
    height = np.maximum([np.median(variances[part]) for part in parts], LEAST_M2)
    # each median is known to the same part of itself
    design = np.column_stack([middle, np.ones(classes)]) / height[:, None]
    (slope, constant), _ = nnls(design, np.ones(classes))
    return float(slope), float(constant)
