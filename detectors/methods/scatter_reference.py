"""The scatter of scores by zone (`detectors.methods.scatter`) and the strongest of several
templates (`detectors.methods.template_scores`), written plainly."""

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from detectors.methods.scatter import CAP, FAINT, FEWEST, RIM_ENDS_PX


def deviation_of(sizes: np.ndarray) -> float:
    """Return the deviation d of a Gaussian whose size, of which no more than `CAP` counts, has the
    same mean as these sizes (n,): d sqrt(2 / pi) (1 - exp(-CAP^2 / 2 d^2)) + 2 CAP Phi(-CAP /
    d)."""
    mean = np.minimum(sizes, CAP).mean()

    def excess(deviation: float) -> float:
        inner = np.sqrt(2.0 / np.pi) * (1.0 - np.exp(-0.5 * (CAP / deviation) ** 2))
        return float(deviation * inner + 2.0 * CAP * ndtr(-CAP / deviation) - mean)

    return float(brentq(excess, 0.2, 50.0))


def deviations(
    scores: np.ndarray,
    depth_px: np.ndarray,
    loud: np.ndarray,
) -> np.ndarray:
    """Return the deviation (z,) of the scores (r, c) in each zone of distances from the outline
    (r, c): up to each of `RIM_ENDS_PX`, and beyond, which sets the least of all. Scores that are 0
    or loud do not count; a zone with fewer than `FEWEST` has the deviation of the last one."""
    counted = (scores != 0) & ~loud
    zone = np.searchsorted(RIM_ENDS_PX, depth_px)
    inside = counted & (zone == len(RIM_ENDS_PX))
    if inside.sum() < FEWEST:
        inside = counted
    last = deviation_of(np.abs(scores[inside]))
    by_zone = []
    for number in range(len(RIM_ENDS_PX)):
        sizes = np.abs(scores[counted & (zone == number)])
        by_zone.append(max(deviation_of(sizes), last) if len(sizes) >= FEWEST else last)
    return np.array([*by_zone, last])


def raised(
    scores: np.ndarray,
    deviation: float,
    more: float,
) -> np.ndarray:
    """Return scores over their deviation, whose squares grow by ``more``; those below `FAINT` grow
    in proportion to what the square of `FAINT` grows by."""
    scaled = scores / deviation
    large = np.sqrt(scaled**2 + more)
    small = np.abs(scaled) * np.sqrt(1.0 + more / FAINT**2)
    return np.sign(scores) * np.minimum(small, large)
