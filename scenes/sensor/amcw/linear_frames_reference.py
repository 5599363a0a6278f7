"""Frames of linear pixels (`scenes.sensor.amcw.linear_frames`) in NumPy: its two equations."""

import numpy as np

from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.amcw.linear_frames import BEND, EVEN, NONE, SCALE, Linear, SharedNoise
from scenes.sensor.amcw.windows import windows_of


def linear_frames(
    shape: tuple[int, int],
    linear: Linear,
    words: np.ndarray,
    shared: SharedNoise,
    errors: np.ndarray,
) -> np.ndarray:
    """Return z minus base (n, lanes) in steps, NaN at pixels that are not linear. Arguments as of
    `linear_frames.add_linear_frames`."""
    n = linear.z.size
    side = linear.taps.size
    # 256 values v in -1..1 become normals u
    v = (words.reshape(n, LANES).astype(float) + 0.5) / 128
    u = SCALE * v * (1 + BEND * v**2)
    replaced = shared.row >= 0
    u[replaced] = shared.normals[shared.row[replaced]]
    noise = linear.noise[:, None] * u
    z = np.full((n, LANES), np.nan)
    weights = np.outer(linear.taps, linear.taps).ravel()
    for lane in range(LANES):
        windows = windows_of(noise[:, lane].reshape(shape), side, 0.0, np.arange(n))
        even = linear.by_neighbour * (windows @ weights) + linear.by_centre * noise[:, lane]
        uneven = (windows * linear.moves[linear.row]).sum(axis=1)
        moved = np.where(linear.kind == EVEN, even, uneven)
        z[:, lane] = np.floor(linear.z + linear.by_path * errors[lane] + moved + 0.5)
    z[linear.kind == NONE] = np.nan
    return z
