"""A kernel of `detectors.methods.local`, written plainly."""

import numpy as np


def tent_squares(image: np.ndarray, width: int) -> np.ndarray:
    """Return the sums (r, c) of an image (r, c) times the squares (``width`` - |d|)^2 of a tent
    along both axes; values beyond the edges count as 0."""
    box = np.ones(width)
    squares = np.convolve(box, box) ** 2
    same_size = slice(width - 1, 1 - width)
    down = [np.convolve(column, squares)[same_size] for column in image.T]
    across = [np.convolve(row, squares)[same_size] for row in np.transpose(down)]
    return np.array(across)
