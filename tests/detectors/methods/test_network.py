"""A network's convolutions against loops, and its file: what it holds, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from detectors.methods import network_reference
from detectors.methods.network import (
    Layer,
    Network,
    convolved,
    network_bytes,
    read_network,
    write_network,
)
from harness.vocabulary.errors import UserError


def layer_of(outputs: int, inputs: int, dilation_px: int, seed: int = 1) -> Layer:
    stream = np.random.default_rng(seed)
    weights = stream.standard_normal((outputs, inputs, 3)).astype(np.float32)
    return Layer(weights, stream.standard_normal(outputs).astype(np.float32), dilation_px)


def network_of(*layers: Layer) -> Network:
    return Network(layers, -4.5, {"experiment": "a"})


GOOD = network_of(layer_of(3, 2, 1), layer_of(3, 3, 4), layer_of(1, 3, 2))


@pytest.mark.parametrize("dilation_px", [1, 2, 5, 9])
def test_a_convolution_is_the_sum_over_its_taps(dilation_px):
    """With 9 pixels between taps, most of them lie beyond the edges."""
    pictures = np.random.default_rng(2).standard_normal((2, 8, 7)).astype(np.float32)
    layer = layer_of(3, 2, dilation_px)
    expected = network_reference.convolved(pictures, layer)
    np.testing.assert_allclose(convolved(pictures, layer), expected, atol=1e-5)


def test_layers_follow_one_another_and_the_last_may_be_negative():
    pictures = np.random.default_rng(3).standard_normal((2, 12, 10)).astype(np.float32)
    first = np.maximum(network_reference.convolved(pictures, GOOD.layers[0]), 0)
    second = np.maximum(network_reference.convolved(first, GOOD.layers[1]), 0)
    (expected,) = network_reference.convolved(second, GOOD.layers[2])
    log_odds = GOOD.log_odds(pictures)
    np.testing.assert_allclose(log_odds, expected, rtol=1e-4, atol=1e-3)
    assert log_odds.min() < 0


def test_a_pixel_sees_as_far_as_stated_and_no_farther():
    pictures = np.zeros((2, 31, 31), np.float32)
    before = GOOD.log_odds(pictures)
    pictures[0, 15, 15] = 100.0
    changed = np.argwhere(GOOD.log_odds(pictures) != before)
    assert GOOD.reach_px == 7
    assert np.abs(changed - 15).max() == 7
    assert GOOD.weight_count == 3 * 2 * 3 + 3 + 3 * 3 * 3 + 3 + 3 * 3 + 1


def test_a_turned_or_mirrored_picture_gives_turned_or_mirrored_odds():
    pictures = np.random.default_rng(4).standard_normal((2, 15, 12)).astype(np.float32)
    log_odds = GOOD.log_odds(pictures)
    turned = GOOD.log_odds(np.ascontiguousarray(np.rot90(pictures, axes=(1, 2))))
    np.testing.assert_allclose(turned, np.rot90(log_odds), rtol=1e-4, atol=1e-4)
    mirrored = GOOD.log_odds(np.ascontiguousarray(pictures[:, :, ::-1]))
    np.testing.assert_allclose(mirrored, log_odds[:, ::-1], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("height", [28, 29, 55, 90])
def test_strips_give_what_the_whole_picture_gives(monkeypatch, height):
    """With 28 rows to a strip, four times the reach of 7."""
    pictures = np.random.default_rng(6).standard_normal((2, height, 20)).astype(np.float32)
    expected = GOOD.log_odds(pictures)
    monkeypatch.setattr("detectors.methods.network.STRIP_PIXELS", 1)
    np.testing.assert_allclose(GOOD.log_odds(pictures), expected, rtol=1e-5, atol=1e-4)


def test_a_network_comes_back_from_its_file(tmp_path):
    write_network(tmp_path / "n.npz", GOOD)
    again = read_network(tmp_path / "n.npz")
    assert again.prior_log_odds == -4.5
    assert again.facts == {"experiment": "a"}
    assert network_bytes(again) == network_bytes(GOOD) == (tmp_path / "n.npz").read_bytes()


def stored(path: Path, stated: dict, changed: dict) -> Path:
    """A file of the network with other facts or arrays; an array of None is left out."""
    write_network(path, GOOD)
    with np.load(path) as archive:
        arrays = dict(archive)
    facts = json.loads(str(arrays["facts"]))
    arrays["facts"] = np.array(json.dumps({**facts, **stated}))
    arrays.update(changed)
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


@pytest.mark.parametrize(
    ("facts", "arrays", "message"),
    [
        ({}, {"weights_1": np.zeros((3, 2, 3))}, r"layer 1 has weights \(3, 2, 3\)"),
        ({}, {"weights_0": np.zeros((3, 1, 3))}, "layer 0 has weights"),
        ({}, {"weights_2": np.zeros((2, 3, 3))}, "layer 2 has weights"),
        ({}, {"bias_2": np.zeros(2)}, "layer 2 has weights"),
        ({}, {"bias_0": None}, "layer 0 lacks"),
        ({}, {"weights_1": np.full((3, 3, 3), np.nan)}, "layer 1 has numbers that are not"),
        ({}, {"facts": np.zeros(3)}, "no text `facts`"),
        ({}, {"facts": np.array("{")}, "`facts` cannot be read"),
        ({"network_version": 99}, {}, "newer tofpod"),
        ({"network_version": None}, {}, "states no version"),
        ({"dilations_px": [1, 0, 2]}, {}, "`dilations_px`"),
        ({"dilations_px": [1, 4, 2, 1]}, {}, "layer 3 lacks"),
        ({"prior_log_odds": "low"}, {}, "`prior_log_odds`"),
        ({"training": 3}, {}, "`training`"),
    ],
)
def test_a_file_of_another_shape_is_refused_in_one_message(tmp_path, facts, arrays, message):
    path = stored(tmp_path / "n.npz", facts, arrays)
    with pytest.raises(UserError, match=message) as raised:
        read_network(path)
    assert str(path) in str(raised.value)


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    (tmp_path / "n.npz").write_text("weights")
    with pytest.raises(UserError, match="cannot be read as arrays"):
        read_network(tmp_path / "n.npz")
