"""The variance of a target's rim beyond that of the noise farther in.

At an edge a camera's beam and filters mix what lies behind it into the pixels inside. The error is
the same in all frames and units, changes with the place of the edge between two pixels, and falls
off over the filter's reach. On smooth noise, a whitening filter takes this for damage: an error of
a tenth of the noise's deviation that changes from pixel to pixel stands far above what such noise
does there. So pixels of the rim get a variance of their own, by their distance from the outline:
what a layer of pixels holds beyond its prediction from all that lies farther in, less the same for
layers farther in.

Not modelled: that these errors are alike along an edge, and that they differ between the sides of
a target."""

import cv2
import numpy as np

from detectors.findings import whitening
from detectors.pixels.masks import grown
from detectors.pixels.noise import sigma_of
from harness.vocabulary.geometry import Cloud

UNKNOWN_REACH_PX = 6.0
"""Reach of an edge if neither the camera nor the noise tells it: above the 5 pixels of a window of
5 x 5 pixels with a lens' blur and mixed pixels."""
BLOCK_PX = 3
"""Pixels along the outline over whose mean the errors are measured, as wide as the narrowest
filters: an edge's errors are alike along it, so that a mean does not reduce them."""
FEWEST = 200  # pixels of a layer that determine its variance
LOUD_SIGMAS = 5.0  # values that do not count, nor those next to them: they are damage
CHANCE_ERRORS = 2.5
"""Standard errors of a single picture's excess that chance explains: of six layers of white noise,
one exceeds them in 4 of 100 pictures."""
CLIP_SIGMAS = 2.5
"""Limit to which the errors of a layer are clipped, in their own deviations: damage on a tenth of
the rim adds half of its variance."""
CLIPPED = 0.9775  # mean square of a Gaussian of deviation 1 that is so clipped


def reach_of(cloud: Cloud) -> float:
    """Return how far, in pixels, the camera mixes what lies beyond an edge into the pixels inside:
    as its model states, or as far as pixels share noise."""
    return cloud.edge_reach_px or cloud.noise_reach_px or UNKNOWN_REACH_PX


def rim_variances(
    values: np.ndarray,
    depth_px: np.ndarray,
    noise: whitening.Filters,
    reach_px: float,
    *,
    is_alone: bool,
) -> np.ndarray:
    """Return the variance (n,) that means over `BLOCK_PX` pixels along the outline have beyond the
    noise's, at distances of 1, 2, ... up to ``reach_px`` from it; 0 where too few pixels show it.

    Args:
        values: (r, c), residuals in units of the noise.
        depth_px: (r, c), distance of each pixel from the outline, 0 where nothing is known.
        noise: the covariance of ``values`` away from the rim, as filters.
        reach_px: see above.
        is_alone: whether this is the only picture. What chance explains is then no excess; in a
            mean over pictures of one camera it leaves 0.4 standard errors at most."""
    count = int(np.ceil(reach_px))
    layer = np.ceil(depth_px).astype(np.int64)
    layer[grown(np.abs(values) > LOUD_SIGMAS, 2)] = 0
    at_rim = _layers(values.astype(np.float32), layer, noise, range(1, count + 1))
    farther_in = _layers(values.astype(np.float32), layer, noise, range(count + 1, 2 * count + 1))
    excess = at_rim - farther_in
    if is_alone:
        counts = np.bincount(layer.ravel(), minlength=2 * count + 1)[1:]
        errors = np.sqrt(2.0 * BLOCK_PX / np.maximum(counts, 1))
        error = np.hypot(errors[:count] * at_rim, errors[count : 2 * count] * farther_in)
        excess -= CHANCE_ERRORS * error
    excess = np.maximum(np.nan_to_num(excess), 0.0)
    # an edge's errors fall off inwards: a layer varies at least as much as those farther in
    return np.asarray(np.maximum.accumulate(excess[::-1])[::-1])


def on_pixels(variances: np.ndarray, depth_px: np.ndarray) -> np.ndarray:
    """Return the variances (r, c) float32 of pixels at these distances (r, c) from the outline."""
    by_layer = np.concatenate([[0.0], variances, [0.0]])
    layer = np.minimum(np.ceil(depth_px), len(by_layer) - 1).astype(np.int64)
    return np.asarray(by_layer[layer], np.float32)


def _layers(
    values: np.ndarray,
    layer: np.ndarray,
    noise: whitening.Filters,
    layers: range,
) -> np.ndarray:
    """Return the variance (n,) of the errors, averaged along the outline, with which all values
    deeper than ``layers`` predict the values (r, c) of each; NaN where pixels are too few."""
    deeper = layer >= layers.stop
    variances = np.full(len(layers), np.nan)
    if deeper.sum() < FEWEST:
        return variances
    solved = whitening.inverse_times(values, deeper, noise)
    errors = values - whitening.covariance_product(solved, noise)
    for number, wanted in enumerate(layers):
        inside = (layer == wanted).astype(np.float32)
        total = cv2.blur(errors * inside, (BLOCK_PX, BLOCK_PX), borderType=cv2.BORDER_CONSTANT)
        count = cv2.blur(inside, (BLOCK_PX, BLOCK_PX), borderType=cv2.BORDER_CONSTANT)
        sizes = np.abs((total / np.maximum(count, 1e-6))[inside > 0])
        if len(sizes) >= FEWEST:
            limit = CLIP_SIGMAS * sigma_of(sizes)
            variances[number] = np.mean(np.minimum(sizes, limit) ** 2) / CLIPPED
    return variances
