"""The light of a view at the imager's converter."""

from typing import NamedTuple

import numpy as np


class AmcwExposure(NamedTuple):
    """Samples of a view at the converter, before noise, in converter units, over n = h w pixels."""

    means: np.ndarray
    """(f, k, n) float32: noise-free samples at each frequency and phase step."""
    sigma: np.ndarray
    """(n,) float32: deviation of each sample."""
    limit: np.ndarray
    """(n,) float32: largest sample that wells and converter hold; infinite if saturation is off.
    """
    shape: tuple[int, int]
    """(h, w) of the view."""
