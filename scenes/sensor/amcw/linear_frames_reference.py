"""A frame of linear pixels (`scenes.sensor.amcw.linear_frames`) in NumPy: its four equations."""

import numpy as np

from scenes.sensor.amcw.linear_frames import Linear
from scenes.sensor.amcw.windows import windows_of


def linear_frame(
    shape: tuple[int, int], linear: Linear, normals: np.ndarray, error: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return z in steps, NaN at pixels that are not linear, and amplitudes, (n,) each. Arguments
    as of `linear_frames.draw_linear_frame`."""
    side = linear.taps.size
    pixels = np.arange(linear.z.size)
    weights = np.outer(linear.taps, linear.taps).ravel()
    noise = linear.noise * normals[0]
    windows = windows_of(noise.reshape(shape), side, 0.0, pixels)
    moved = linear.by_neighbour * (windows @ weights) + linear.by_centre * noise
    moved[linear.uneven] = (windows[linear.uneven] * linear.moves).sum(axis=1)
    steps = linear.base + np.floor(linear.z + linear.by_path * error + moved + 0.5)

    windows = windows_of(normals[1].reshape(shape), side, 0.0, pixels)
    unit_weights = weights / np.sqrt((weights**2).sum())
    change = linear.amplitude_noise * (windows @ unit_weights)
    change[linear.uneven] = (windows[linear.uneven] * linear.amplitude_moves).sum(axis=1)
    return steps, linear.amplitude + change
