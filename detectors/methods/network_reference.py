"""A convolution of `detectors.methods.network`, written plainly; a test compares the two."""

import numpy as np

from detectors.methods.network import Layer


def convolved(pictures: np.ndarray, layer: Layer) -> np.ndarray:
    """Return the outputs (outputs, r, c) of a layer for pictures (inputs, r, c); 0 beyond their
    edges."""
    _, height, width = pictures.shape
    outputs = np.zeros((len(layer.weights), height, width))
    for row in range(height):
        for column in range(width):
            total = layer.bias.astype(float)
            for down in (-1, 0, 1):
                seen_row = row + down * layer.dilation_px
                for right in (-1, 0, 1):
                    seen_column = column + right * layer.dilation_px
                    if 0 <= seen_row < height and 0 <= seen_column < width:
                        inputs = pictures[:, seen_row, seen_column]
                        ring = abs(down) + abs(right)
                        share = 1.0 if ring == 0 else 0.5
                        total = total + share * layer.weights[:, :, ring] @ inputs
            outputs[:, row, column] = total
    return outputs
