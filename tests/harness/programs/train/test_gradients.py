"""The training of a network: gradients against differences, a falling loss, equal weights again."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.methods.network import Layer, Network, network_bytes
from harness.programs.train.gradients import (
    AdamDescent,
    Example,
    gradient_of,
    loss_of,
    new_network,
    parameters_of,
)

SHAPE = (11, 9)
STEP = 1e-6


def example_of(seed: int) -> Example:
    """Noise, with a bright square where damage is, in double precision; some pixels do not
    count."""
    stream = np.random.default_rng(seed)
    pictures = stream.standard_normal((2, *SHAPE))
    damage = np.zeros(SHAPE)
    row, column = stream.integers(1, 6, 2)
    damage[row : row + 3, column : column + 3] = 1.0
    pictures[0] += 2.0 * damage
    weights = stream.uniform(0.5, 1.5, SHAPE)
    weights[:, 0] = 0.0
    return Example(pictures, damage, weights)


def in_double_precision(network: Network) -> Network:
    layers = []
    for layer in network.layers:
        bias = layer.bias.astype(float)
        layers.append(Layer(layer.weights.astype(float), bias, layer.dilation_px))
    return Network(tuple(layers), network.prior_log_odds)


@pytest.fixture
def network() -> Network:
    stream = np.random.default_rng(5)
    return in_double_precision(new_network(3, -1.0, stream, dilations_px=(1, 2, 1)))


def test_every_gradient_is_the_slope_of_the_loss(network):
    example = example_of(1)
    loss, gradients = gradient_of(network, example)
    assert loss == pytest.approx(loss_of(network.log_odds(example.pictures), example), rel=1e-12)
    for array, gradient in zip(parameters_of(network), gradients, strict=True):
        assert gradient.shape == array.shape
        for index in np.ndindex(array.shape):
            value = array[index]
            array[index] = value + STEP
            above = loss_of(network.log_odds(example.pictures), example)
            array[index] = value - STEP
            below = loss_of(network.log_odds(example.pictures), example)
            array[index] = value
            slope = (above - below) / (2 * STEP)
            assert gradient[index] == pytest.approx(slope, rel=1e-4, abs=1e-8)


def test_the_loss_is_that_of_the_stated_odds_and_ignores_pixels_without_weight():
    example = example_of(2)
    log_odds = np.full(SHAPE, np.log(0.25 / 0.75))
    on_damage = float(example.weights[example.damage > 0].sum())
    elsewhere = float(example.weights[example.damage == 0].sum())
    expected = -(on_damage * np.log(0.25) + elsewhere * np.log(0.75)) / (on_damage + elsewhere)
    assert loss_of(log_odds, example) == pytest.approx(expected, rel=1e-12)
    log_odds[:, 0] = 50.0
    assert loss_of(log_odds, example) == pytest.approx(expected, rel=1e-12)


def test_the_loss_is_least_at_the_true_odds():
    example = example_of(3)
    share = np.average(example.damage, weights=example.weights)
    true = np.log(share / (1.0 - share))
    losses = [loss_of(np.full(SHAPE, true + shift), example) for shift in (-0.1, 0.0, 0.1)]
    assert min(losses) == losses[1]


def trained(seed: int, steps: int) -> tuple[Network, list[float]]:
    network = new_network(4, -2.0, np.random.default_rng(seed), dilations_px=(1, 1, 1))
    descent = AdamDescent(network, steps)
    losses = []
    for number in range(steps):
        example = example_of(number % 8)
        single = Example(
            pictures=np.asarray(example.pictures, np.float32),
            damage=np.asarray(example.damage, np.float32),
            weights=np.asarray(example.weights, np.float32),
        )
        loss, gradients = gradient_of(network, single)
        descent.step(gradients)
        losses.append(loss)
    return network, losses


def test_training_lowers_the_loss_and_finds_unseen_damage():
    network, losses = trained(1, 400)
    assert np.mean(losses[-8:]) < 0.4 * np.mean(losses[:8])
    unseen = example_of(99)
    log_odds = network.log_odds(unseen.pictures.astype(np.float32))
    on_damage = log_odds[unseen.damage > 0]
    assert np.median(on_damage) > np.quantile(log_odds[unseen.damage == 0], 0.95)


def test_equal_seeds_give_equal_weights_and_others_do_not():
    assert network_bytes(trained(1, 20)[0]) == network_bytes(trained(1, 20)[0])
    assert network_bytes(trained(1, 20)[0]) != network_bytes(trained(2, 20)[0])


def test_the_rate_rises_and_falls_to_0():
    network = new_network(1, 0.0, np.random.default_rng(1), dilations_px=(1,))
    descent = AdamDescent(network, 100)
    zero = [np.zeros_like(array) for array in parameters_of(network)]
    rates = []
    for _ in range(100):
        rates.append(descent.rate)
        descent.step(zero)
    assert rates[0] < 0.3 * max(rates)
    assert rates[-1] < 1e-3 * max(rates)
    assert int(np.argmax(rates)) == 4


def test_under_a_constant_gradient_each_step_moves_a_weight_by_the_rate():
    """Adam divides the mean gradient by its own size, whatever that is, from the first step on."""
    network = new_network(2, 0.0, np.random.default_rng(1), dilations_px=(1, 1))
    descent = AdamDescent(network, 10)
    for _ in range(3):
        before = [array.copy() for array in parameters_of(network)]
        rate = descent.rate
        descent.step([np.full_like(array, -3.0) for array in before])
        for old, new in zip(before, parameters_of(network), strict=True):
            np.testing.assert_allclose(new - old, rate, rtol=1e-3)
