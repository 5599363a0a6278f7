"""The training of a network (`detectors.methods.network`): loss, gradients by hand, and steps.

The loss is the weighted mean over pixels of ln(1 + e^L) - y L, where L is the network's log-odds
and y is 1 for damage: it is least where L is the logarithm of the true odds. Steps are those of
Adam (Kingma and Ba 2015), whose rate rises over the first steps and falls to 0 by a cosine. All
arithmetic is on one thread in single precision, so that equal pictures and seeds give equal
weights on one machine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from detectors.methods.network import HALF, INPUTS, RINGS, Layer, Network, columns_of, ring_sums

RATE = 6e-3
"""Largest step of a weight, in units of its gradient's own size. After 120 steps on 24 pictures the
loss on 12 others was .0111, .0081 and .0130 with .002, .008 and .020."""
FIRST_ODDS = 0.1  # factor of the last layer's first weights, so that training begins at the prior
WARM_UP = 0.05  # share of the steps over which the rate rises
MEAN_KEPT = 0.9  # share of the mean gradient that a step keeps
SQUARE_KEPT = 0.999  # the same for its mean square
LEAST_SIZE = 1e-8  # least size of a gradient by which a step is divided
DILATIONS_PX = (1, 1, 2, 4, 8, 2, 1)
"""Dilations of a new network's layers: it sees 19 pixels to each side, as far as the widest
template of `matched`; the last layers even out what dilated taps leave between pixels."""


class Example(NamedTuple):
    """A picture with the truth."""

    pictures: np.ndarray
    """(`INPUTS`, r, c) float32: what the network sees."""
    damage: np.ndarray
    """(r, c) float32: 1 on damage, else 0."""
    weights: np.ndarray
    """(r, c) float32: how much each pixel counts."""


def new_network(
    channels: int,
    prior_log_odds: float,
    stream: np.random.Generator,
    dilations_px: Sequence[int] = DILATIONS_PX,
) -> Network:
    """Return an untrained network with so many outputs of each layer, which states the prior.

    Weights are drawn so that values keep their size from layer to layer (He et al. 2015)."""
    layers = []
    inputs = INPUTS
    for number, dilation_px in enumerate(dilations_px):
        is_last = number == len(dilations_px) - 1
        outputs = 1 if is_last else channels
        deviation = math.sqrt(2.0 / (inputs * RINGS))
        if is_last:
            deviation *= FIRST_ODDS
        weights = stream.standard_normal((outputs, inputs, RINGS)) * deviation
        bias = np.full(outputs, prior_log_odds if is_last else 0.0)
        layers.append(Layer(weights.astype(np.float32), bias.astype(np.float32), dilation_px))
        inputs = outputs
    return Network(tuple(layers), prior_log_odds)


# --- loss and gradient ---


def loss_of(log_odds: np.ndarray, example: Example) -> float:
    """Return the loss of the log-odds (r, c) of an example."""
    losses = np.logaddexp(np.float32(0.0), log_odds) - example.damage * log_odds
    total = float(np.sum(losses * example.weights, dtype=np.float64))
    return total / float(np.sum(example.weights, dtype=np.float64))


def gradient_of(network: Network, example: Example) -> tuple[float, list[np.ndarray]]:
    """Return the loss of an example, and its gradients in the order of `parameters_of`."""
    _, height, width = example.pictures.shape
    layer_inputs = []
    values = example.pictures
    for number, layer in enumerate(network.layers):
        columns = columns_of(values, layer.dilation_px)
        layer_inputs.append(columns)
        outputs = layer.weights.reshape(len(layer.weights), -1) @ columns
        outputs += layer.bias[:, None]
        if number < len(network.layers) - 1:
            np.maximum(outputs, np.float32(0.0), out=outputs)
        values = outputs.reshape(-1, height, width)
    log_odds = values[0]
    loss = loss_of(log_odds, example)

    probability = 0.5 * (1.0 + np.tanh(0.5 * log_odds))
    error = (probability - example.damage) * example.weights
    error /= np.sum(example.weights, dtype=np.float64)
    back = error.reshape(1, -1).astype(example.pictures.dtype)
    gradients: list[np.ndarray] = []
    for number in range(len(network.layers) - 1, -1, -1):
        layer = network.layers[number]
        weights = layer.weights.reshape(len(layer.weights), -1)
        gradients.append(back.sum(axis=1))
        gradients.append((back @ layer_inputs[number].T).reshape(layer.weights.shape))
        if number > 0:
            shape = (layer.weights.shape[1], height, width)
            inputs = _summed(weights.T @ back, shape, layer.dilation_px)
            # what the layer below cut off at 0 does not count; its middle taps are its outputs
            middle = layer_inputs[number].reshape(shape[0], RINGS, -1)[:, 0]
            back = inputs.reshape(shape[0], -1) * (middle > 0)
    return loss, gradients[::-1]


def _summed(columns: np.ndarray, shape: tuple[int, ...], dilation_px: int) -> np.ndarray:
    """Return pictures of this shape (inputs, r, c), each pixel the sum over what sees it: the
    transpose of `columns_of`."""
    count, height, width = shape
    rings = columns.reshape(count, RINGS, height, width)
    # rings are symmetric, so that the sums are their own transposes
    beside, _ = ring_sums(rings[:, 1], dilation_px)
    _, corners = ring_sums(rings[:, 2], dilation_px)
    return rings[:, 0] + HALF * (beside + corners)


# --- steps ---


def parameters_of(network: Network) -> list[np.ndarray]:
    """Return all arrays of weights and biases, by layer."""
    parameters = []
    for layer in network.layers:
        parameters.append(layer.weights)
        parameters.append(layer.bias)
    return parameters


@dataclass
class AdamDescent:
    """The steps of Adam, which change a network's arrays in place."""

    network: Network
    """The network in training."""
    steps: int
    """Number of steps in all."""

    def __post_init__(self) -> None:
        self._parameters = parameters_of(self.network)
        self._means = [np.zeros_like(array) for array in self._parameters]
        self._squares = [np.zeros_like(array) for array in self._parameters]
        self._done = 0

    @property
    def rate(self) -> float:
        """The rate of the next step."""
        share = (self._done + 1) / self.steps
        rising = min(share / WARM_UP, 1.0)
        return RATE * rising * 0.5 * (1.0 + math.cos(math.pi * share))

    def step(self, gradients: Sequence[np.ndarray]) -> None:
        """Take one step against the gradients."""
        rate = self.rate
        self._done += 1
        mean_share = 1.0 - MEAN_KEPT**self._done
        square_share = 1.0 - SQUARE_KEPT**self._done
        for number, gradient in enumerate(gradients):
            mean = self._means[number]
            square = self._squares[number]
            mean += np.float32(1.0 - MEAN_KEPT) * (gradient - mean)
            square += np.float32(1.0 - SQUARE_KEPT) * (gradient**2 - square)
            size = np.sqrt(square / np.float32(square_share)) + np.float32(LEAST_SIZE)
            change = np.float32(rate / mean_share) * mean / size
            self._parameters[number] -= change
