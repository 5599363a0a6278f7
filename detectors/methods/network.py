"""A small network of convolutions on a picture, and the file that holds it.

Every layer is a convolution with 3 x 3 taps that lie ``dilation_px`` apart (Yu and Koltun 2016),
so that a few small layers see as far as the widest damage; values below 0 become 0 between
layers. The last layer gives one number for each pixel: the logarithm of the odds of damage.

The four taps beside the middle share a weight, and the four at the corners another: a picture
that is turned or mirrored gives the turned or mirrored odds, with a third of the weights and of
the work. Not modelled: what has a direction, but as far as several layers tell it by its parts.

The file is an ``.npz``: ``weights_0``, ``bias_0``, ``weights_1`` ..., and ``facts``, a text of
JSON with the version of the format, the dilations, and what the network was trained on."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from detectors.recordings.arrays import load_npz
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import strict_json, write_bytes
from harness.vocabulary.provenance import check_version

NETWORK_VERSION = 1  # of the file; increased when the meaning of an entry changes
RINGS = 3  # weights of an input: of the middle tap, of the four beside it, and of the corners
HALF = np.float32(0.5)
"""Factor of the sum of a ring's four taps, which leaves the deviation of independent noise."""
INPUTS = 2  # pictures that a network sees: whitened residuals, and where pixels are known
STRIP_PIXELS = 1 << 17
"""Pixels of a strip in which a picture is judged: 24 channels then need 80 MB."""
MOST_LAYERS = 64
MOST_DILATION_PX = 1000
AGAIN = "write it again with tofpod train"


class Layer(NamedTuple):
    """A convolution."""

    weights: np.ndarray
    """(outputs, inputs, `RINGS`) float32."""
    bias: np.ndarray
    """(outputs,) float32."""
    dilation_px: int
    """Distance between neighbouring taps."""


@dataclass(frozen=True, eq=False)
class Network:
    """Layers, and what is known of their training."""

    layers: tuple[Layer, ...]
    prior_log_odds: float
    """Logarithm of the odds of damage among the pixels that it was trained on."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Plain data on its training."""

    @property
    def weight_count(self) -> int:
        """Number of trained numbers."""
        return sum(layer.weights.size + layer.bias.size for layer in self.layers)

    @property
    def reach_px(self) -> int:
        """Distance of the farthest pixels that count for a pixel, along an axis."""
        return sum(layer.dilation_px for layer in self.layers)

    def log_odds(self, pictures: np.ndarray) -> np.ndarray:
        """Return the logarithm (r, c) of the odds of damage from pictures (`INPUTS`, r, c)
        float32; beyond their edges, values are 0 in every layer.

        Large pictures are cut into strips that overlap by the reach, so that memory stays small
        and results are those of the whole."""
        _, height, width = pictures.shape
        rows = max(STRIP_PIXELS // width, 4 * self.reach_px, 1)
        log_odds = np.empty((height, width), pictures.dtype)
        for first in range(0, height, rows):
            end = min(first + rows, height)
            top = max(first - self.reach_px, 0)
            strip = self._log_odds_of_strip(pictures[:, top : end + self.reach_px])
            log_odds[first:end] = strip[first - top : end - top]
        return log_odds

    def _log_odds_of_strip(self, pictures: np.ndarray) -> np.ndarray:
        values = pictures
        for layer in self.layers[:-1]:
            values = np.maximum(convolved(values, layer), np.float32(0.0))
        return np.asarray(convolved(values, self.layers[-1])[0])


# --- one convolution ---


def convolved(pictures: np.ndarray, layer: Layer) -> np.ndarray:
    """Return the outputs (outputs, r, c) of a layer for pictures (inputs, r, c).
    `detectors.methods.network_reference.convolved` is the same, written plainly."""
    _, height, width = pictures.shape
    columns = columns_of(pictures, layer.dilation_px)
    outputs = layer.weights.reshape(len(layer.weights), -1) @ columns
    outputs += layer.bias[:, None]
    return outputs.reshape(-1, height, width)


def columns_of(pictures: np.ndarray, dilation_px: int) -> np.ndarray:
    """Return what each pixel sees of pictures (inputs, r, c): (inputs x `RINGS`, r x c), the
    middle, and half the sums beside it and at the corners."""
    count, height, width = pictures.shape
    columns = np.empty((count, RINGS, height, width), pictures.dtype)
    columns[:, 0] = pictures
    beside, corners = ring_sums(pictures, dilation_px)
    np.multiply(beside, HALF, out=columns[:, 1])
    np.multiply(corners, HALF, out=columns[:, 2])
    return columns.reshape(count * RINGS, height * width)


def ring_sums(pictures: np.ndarray, step_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the sums (n, r, c) of the four pixels beside each pixel of pictures (n, r, c), so
    many pixels away, and of the four at the corners; beyond the edges lies 0."""
    above_and_below = _pair_sums(pictures, step_px, axis=1)
    beside = above_and_below + _pair_sums(pictures, step_px, axis=2)
    return beside, _pair_sums(above_and_below, step_px, axis=2)


def _pair_sums(pictures: np.ndarray, step_px: int, axis: int) -> np.ndarray:
    """Return the sums (n, r, c) of the two pixels before and behind along an axis."""
    moved = np.moveaxis(pictures, axis, 1)
    sums = np.zeros_like(pictures)
    into = np.moveaxis(sums, axis, 1)
    into[:, step_px:] = moved[:, :-step_px]
    into[:, :-step_px] += moved[:, step_px:]
    return sums


# --- the file ---


def network_bytes(network: Network) -> bytes:
    """Return the content of a network's file; equal networks give equal bytes."""
    facts = {
        "network_version": NETWORK_VERSION,
        "dilations_px": [layer.dilation_px for layer in network.layers],
        "prior_log_odds": network.prior_log_odds,
        "training": dict(network.facts),
    }
    arrays = {"facts": np.array(json.dumps(facts, sort_keys=True, allow_nan=False))}
    for number, layer in enumerate(network.layers):
        arrays[f"weights_{number}"] = np.asarray(layer.weights, np.float32)
        arrays[f"bias_{number}"] = np.asarray(layer.bias, np.float32)
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def write_network(path: Path, network: Network) -> None:
    """Write a network's file. Raises UserError if it cannot be written."""
    write_bytes(path, network_bytes(network))


def read_network(path: Path) -> Network:
    """Read a network. Raises UserError if the file is not a network's, or its layers do not fit
    one another."""
    arrays = load_npz(path)
    stated = arrays.get("facts")
    if stated is None or stated.dtype.kind != "U" or stated.ndim != 0:
        problem = "has no text `facts`, so it is not a network's file"
        raise UserError(f"{path}: {problem}", fix=AGAIN)
    try:
        facts = dict(strict_json(str(stated)))
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: `facts` cannot be read ({error})", fix=AGAIN) from error
    check_version(facts.get("network_version"), NETWORK_VERSION, path, "a network", again=AGAIN)
    dilations_px = _dilations_of(facts.get("dilations_px"))
    prior = facts.get("prior_log_odds")
    training = facts.get("training")
    if dilations_px is None:
        problem = f"`dilations_px` is not a list of 1 to {MOST_LAYERS} distances in pixels"
        raise UserError(f"{path}: {problem}", legal=f"1 to {MOST_DILATION_PX} each", fix=AGAIN)
    if isinstance(prior, bool) or not isinstance(prior, int | float) or abs(prior) > 1e3:
        raise UserError(f"{path}: `prior_log_odds` is not a number within 1000 of 0", fix=AGAIN)
    if not isinstance(training, dict):
        raise UserError(f"{path}: `training` is not an object", fix=AGAIN)
    layers = _layers_of(path, arrays, dilations_px)
    return Network(layers, float(prior), training)


def _dilations_of(value: object) -> list[int] | None:
    """Return the dilations that a file states, or None if they are none."""
    if not isinstance(value, list) or not 1 <= len(value) <= MOST_LAYERS:
        return None
    for item in value:
        if isinstance(item, bool) or not isinstance(item, int):
            return None
        if not 1 <= item <= MOST_DILATION_PX:
            return None
    return value


def _layers_of(
    path: Path, arrays: Mapping[str, np.ndarray], dilations_px: Sequence[int]
) -> tuple[Layer, ...]:
    """Return the layers of a file's arrays. Raises UserError if one is missing or does not fit."""
    layers = []
    inputs = INPUTS
    for number, dilation_px in enumerate(dilations_px):
        is_last = number == len(dilations_px) - 1
        weights = arrays.get(f"weights_{number}")
        bias = arrays.get(f"bias_{number}")
        if weights is None or bias is None:
            raise UserError(f"{path}: layer {number} lacks its weights or bias", fix=AGAIN)
        outputs = 1 if is_last else len(bias)
        shape = (outputs, inputs, RINGS)
        if weights.shape != shape or bias.shape != (outputs,):
            shapes = f"weights {weights.shape} and a bias {bias.shape}"
            legal = f"weights {shape} and a bias ({outputs},)"
            raise UserError(f"{path}: layer {number} has {shapes}", legal=legal, fix=AGAIN)
        layer = Layer(weights.astype(np.float32), bias.astype(np.float32), dilation_px)
        if not (np.isfinite(layer.weights).all() and np.isfinite(layer.bias).all()):
            raise UserError(f"{path}: layer {number} has numbers that are not finite", fix=AGAIN)
        layers.append(layer)
        inputs = outputs
    return tuple(layers)
