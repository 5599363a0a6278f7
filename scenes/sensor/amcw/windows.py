"""Windows around pixels: their content, and the pixels whose windows touch a set."""

import cv2
import numpy as np


def windows_of(image: np.ndarray, side: int, beyond: float, pixels: np.ndarray) -> np.ndarray:
    """Return the windows (m, side^2) of an image (h, w) at flat ``pixels`` (m,), with ``beyond``
    outside the border."""
    padded = np.pad(image, side // 2, constant_values=beyond)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    rows, columns = np.divmod(pixels, image.shape[1])
    return windows[rows, columns].reshape(-1, side * side)


def pixels_within(pixels: np.ndarray, side: int) -> np.ndarray:
    """Return the pixels (h, w) bool whose window of ``side`` contains one of ``pixels`` (h, w)
    bool."""
    square = np.ones((side, side), np.uint8)
    return cv2.dilate(pixels.view(np.uint8), square).view(bool)
