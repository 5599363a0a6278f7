"""The light of a view at the imager's converter, and the time for which it is collected."""

from typing import NamedTuple

import numpy as np

from scenes.sensor.amcw.facts import ExposuresFacts

DARKEST = 1e-9  # fullness below which light is taken as dark


class AmcwExposure(NamedTuple):
    """Samples of a view at the converter, before noise, in converter units, over n = h w pixels."""

    means: np.ndarray
    """(f, k, n) float32: noise-free samples at each frequency and phase step."""
    sigma: np.ndarray
    """(n,) float32: deviation of each sample."""
    limit: np.ndarray
    """(n,) float32: largest sample that wells and converter hold; infinite if saturation is off.
    """
    time_share: np.ndarray
    """(n,) float32: exposure time over the longest, as it was chosen or ended early."""
    shape: tuple[int, int]
    """(h, w) of the view."""

    def part(self, pixels: np.ndarray) -> "AmcwExposure":
        """Return the exposure of flat ``pixels`` (m,), as a view of 1 x m pixels."""
        return AmcwExposure(
            means=self.means.take(pixels, axis=-1),
            sigma=self.sigma[pixels],
            limit=self.limit[pixels],
            time_share=self.time_share[pixels],
            shape=(1, len(pixels)),
        )


def time_shares(facts: ExposuresFacts, fullness: np.ndarray) -> np.ndarray:
    """Return the exposure times (h, w) of a view's pixels over the longest.

    The choice is made once for a view, from its light without noise, so that all frames of a scene
    share it, and a scene gets the same times again. A whole frame's time is chosen from the
    rendered part of the image only. Not modelled: a control that needs several frames to settle,
    or that looks at a part of the image; the lower frame rate where several exposures are combined.

    Args:
        facts: the times that can be chosen, and the rule.
        fullness: (h, w), the share of the wells' and the converter's capacity that light takes in
            the longest exposure.
    """
    deciding = fullness
    if facts.bright_share is not None:
        brightest = np.quantile(fullness, 1 - facts.bright_share.value)
        deciding = np.full_like(fullness, brightest)
    longest_fitting = facts.fill.value / np.maximum(deciding, DARKEST)
    shares = np.array(facts.shares.value)
    if facts.continuous.value:
        return np.clip(longest_fitting, shares[-1], shares[0])
    rising = shares[::-1]
    index = np.searchsorted(rising, longest_fitting, side="right") - 1
    return np.asarray(rising[np.maximum(index, 0)])
