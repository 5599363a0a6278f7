"""The whitening and the scores of templates (`detectors.findings.whitening`,
`detectors.findings.templates`), written plainly: dense matrices over the known pixels."""

import numpy as np

from detectors.findings.whitening import LONGEST_LAG_PX, TAPS


def autocovariance(
    noise: np.ndarray,
    quiet: np.ndarray,
    down: int,
    across: int,
) -> float:
    """Return the mean product of pairs of quiet pixels at one lag (down, across >= 0), faded out
    by Parzen's window: 1 - 6 x^2 (1 - x) up to x = 1/2, then 2 (1 - x)^3, of the lag x over the
    longest one."""
    height, width = noise.shape
    first = np.s_[: height - down, : width - across]
    second = np.s_[down:, across:]
    is_quiet = quiet[first] & quiet[second]
    mean = (noise[first] * noise[second])[is_quiet].mean()
    lag = min(np.hypot(down, across) / LONGEST_LAG_PX, 1.0)
    if lag <= 0.5:
        return float(mean * (1.0 - 6.0 * lag**2 * (1.0 - lag)))
    return float(mean * 2.0 * (1.0 - lag) ** 3)


def dense_covariance(known: np.ndarray, by_lag: np.ndarray) -> np.ndarray:
    """Return C (n, n) of the known pixels (r, c) bool, from a covariance by lag (odd, odd), lag 0
    in the middle, 0 beyond."""
    pixels = np.argwhere(known)
    lag_0 = np.array(by_lag.shape) // 2
    indices = pixels[:, None] - pixels + lag_0
    is_known_lag = ((indices >= 0) & (indices < by_lag.shape)).all(axis=-1)
    indices[~is_known_lag] = 0
    values = by_lag[indices[..., 0], indices[..., 1]]
    return np.where(is_known_lag, values, 0.0)


def score(
    template: np.ndarray,
    values: np.ndarray,
    covariance: np.ndarray,
) -> float:
    """Return t' C^-1 r / sqrt(t' C^-1 t) of a template t (n,) and values r (n,)."""
    whitened = np.linalg.solve(covariance, template)
    return float(whitened @ values / np.sqrt(whitened @ template))


def spread(
    image: np.ndarray,
    inner: np.ndarray,
    outer: np.ndarray,
    back: bool,
) -> np.ndarray:
    """Return s + outer x blur(s) on the grid of ``outer``, where s is image x inner, 0 beyond the
    image, and the blur has the weights `TAPS` on both axes; if ``back``, the transpose, (image +
    blur(image x inner)) x outer on the grid of ``outer``."""
    taps = np.array([TAPS[0], TAPS[1], TAPS[2], TAPS[1], TAPS[0]], float)
    rows = max(image.shape[0], outer.shape[0])
    columns = max(image.shape[1], outer.shape[1])
    s = np.zeros((rows + 4, columns + 4))
    s[2 : 2 + image.shape[0], 2 : 2 + image.shape[1]] = image * inner
    height, width = outer.shape
    blurred = np.zeros(outer.shape)
    for y in range(5):
        for x in range(5):
            blurred += taps[y] * taps[x] * s[y : y + height, x : x + width]
    if back:
        return (image[:height, :width] + blurred) * outer
    return s[2 : 2 + height, 2 : 2 + width] + outer * blurred
