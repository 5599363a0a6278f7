"""Whitening against dense algebra and its plainly written reference."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import ndimage

from detectors.findings import whitening_reference as reference
from detectors.findings.templates import bank, window_of, worths
from detectors.findings.whitening import (
    CONVERGED,
    EDGE_PX,
    FADED,
    GRID,
    LEAST_POWER,
    LONGEST_LAG_PX,
    _spread,
    centred,
    covariance_product,
    filters,
    grid_of,
    inverse_times,
    noise_covariance,
    spectrum,
)

SHAPE = (26, 30)
BLUR_PX = 5


def blurred(seed: int, shape: tuple[int, int], side: int = BLUR_PX) -> np.ndarray:
    """Noise of deviation 1 that a square of pixels correlates."""
    white = np.random.default_rng(seed).standard_normal((shape[0] + side, shape[1] + side))
    filtered = cv2.blur(white, (side, side)) * side
    first = side // 2
    return filtered[first : first + shape[0], first : first + shape[1]].astype(np.float32)


def dense_of(known: np.ndarray, by_lag: np.ndarray, grid: tuple[int, ...]) -> np.ndarray:
    """The covariance of the known pixels that `filters` stand for: with the least power added."""
    covariance = np.fft.irfft2(spectrum(by_lag, grid), grid)
    reach = np.arange(-LONGEST_LAG_PX - 2, LONGEST_LAG_PX + 3)
    return reference.dense_covariance(known, covariance[np.ix_(reach, reach)])


def test_a_grid_holds_picture_template_and_margin_and_its_half_is_even() -> None:
    for side in (3, 90, 100, 240, 1023):
        (padded,) = grid_of((side,))
        assert padded >= max(side, GRID) + LONGEST_LAG_PX
        assert padded % 8 == 0
        assert padded < 1.25 * (max(side, GRID) + LONGEST_LAG_PX) + 8
    assert grid_of((100, 200), 56, 4) == (112, 216)


@pytest.mark.parametrize(
    "lag",
    [
        (0, 0),
        (0, 1),
        (2, 0),
        (3, 4),
        (5, 13),
        (0, 20),
        (12, 25),
    ],
)
def test_a_covariance_is_the_mean_product_of_quiet_pixels(lag: tuple[int, int]) -> None:
    noise = blurred(1, (60, 70))
    quiet = np.random.default_rng(2).random(noise.shape) > 0.2
    result = noise_covariance(noise, quiet, grid_of(noise.shape))
    expected = reference.autocovariance(noise, quiet, *lag)
    middle = LONGEST_LAG_PX
    down, across = lag
    assert result[middle + down, middle + across] == pytest.approx(expected, abs=2e-6)
    assert result[middle - down, middle - across] == pytest.approx(expected, abs=2e-6)


def test_the_least_power_is_a_hundredth_of_the_mean() -> None:
    lags = np.abs(np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1))
    smooth = np.exp(-0.5 * (lags / 4.0) ** 2)
    power = spectrum(np.outer(smooth, smooth), (GRID, GRID))
    assert power.shape == (GRID, GRID // 2 + 1)
    mean = np.fft.rfft2(np.eye(1), (GRID, GRID)).real.mean()
    full = np.abs(np.fft.rfft2(np.outer(smooth, smooth), (GRID, GRID)))
    assert power.min() == pytest.approx(0.01 * full.mean() * mean, rel=0.01)
    assert power[0, 0] == pytest.approx(np.outer(smooth, smooth).sum(), rel=1e-4)


@pytest.mark.parametrize(
    ("image_shape", "grid_shape"),
    [
        ((9, 13), (16, 20)),
        ((16, 20), (9, 13)),
        ((9, 20), (16, 13)),
    ],
)
@pytest.mark.parametrize("back", [False, True])
def test_unknown_pixels_are_filled_as_by_the_reference(image_shape, grid_shape, back) -> None:
    random = np.random.default_rng(3)
    image = random.standard_normal(image_shape).astype(np.float32)
    inner = random.random(image_shape).astype(np.float32)
    outer = random.random(grid_shape).astype(np.float32)
    if back:
        # the image is a grid, and the result as small as the picture
        image_rows, image_columns = np.maximum(image_shape, grid_shape)
        image = random.standard_normal((image_rows, image_columns)).astype(np.float32)
        inner = random.random(image.shape).astype(np.float32)
    result = np.zeros(grid_shape, np.float32)
    _spread(image, inner, outer, back, result)
    np.testing.assert_allclose(
        result,
        reference.spread(image, inner, outer, back),
        atol=2e-6,
    )


@pytest.mark.parametrize("added", [None, np.linspace(0.0, 2.0, 26 * 30).reshape(26, 30)])
@pytest.mark.parametrize("side", [3, 5])
def test_a_solution_is_that_of_the_dense_covariance_of_the_known_pixels(
    side: int, added: np.ndarray | None
) -> None:
    is_known = np.random.default_rng(6).random(SHAPE) > 0.1
    is_known[10:14, 8:12] = False
    by_lag = noise_covariance(
        blurred(3, (90, 120), side),
        np.ones((90, 120), bool),
        (128, 160),
    )
    values = np.where(is_known, blurred(1, SHAPE, side), np.float32(0.0))
    solved = inverse_times(values, is_known, filters(by_lag, SHAPE), error=0.01, added=added)
    dense = dense_of(is_known, by_lag, grid_of(SHAPE))
    if added is not None:
        dense += np.diag(added[is_known])
    else:
        product = covariance_product(solved, filters(by_lag, SHAPE))
        np.testing.assert_allclose(product[is_known], values[is_known], atol=0.05)
    expected = np.linalg.solve(dense, values[is_known])
    np.testing.assert_allclose(
        solved[is_known],
        expected,
        atol=0.02 * np.abs(expected).max(),
    )
    assert not solved[~is_known].any()


class PlainDescent:
    """The conjugate gradients of `inverse_times`, by NumPy's transforms in double precision."""

    def __init__(self, known: np.ndarray, by_lag: np.ndarray) -> None:
        self.known = known
        self.grid = grid_of(known.shape)
        self.small_grid = grid_of(known.shape, 2 * LONGEST_LAG_PX, 4)
        least = LEAST_POWER * by_lag.max()
        power = np.fft.rfft2(centred(by_lag, self.grid)).real
        self.power = np.maximum(power, least)
        small_power = np.fft.rfft2(centred(by_lag, self.small_grid)).real
        self.small_power = np.maximum(small_power, least)
        reach = np.arange(-6, 7)
        bell = np.exp(-0.5 * (reach / 2.0) ** 2)
        padded = self.padded(known.astype(float), self.small_grid)
        around = self.smoothed(padded, bell / bell.sum())
        self.known_around = self.cut(around)
        self.damping = known * np.sqrt(self.known_around)
        self.filling = (1.0 - padded) / (padded + self.blurred(padded) + FADED)

    @staticmethod
    def padded(image: np.ndarray, grid: tuple[int, ...]) -> np.ndarray:
        result = np.zeros(grid)
        result[: image.shape[0], : image.shape[1]] = image
        return result

    def cut(self, image: np.ndarray) -> np.ndarray:
        return image[: self.known.shape[0], : self.known.shape[1]]

    @staticmethod
    def smoothed(image: np.ndarray, taps: np.ndarray) -> np.ndarray:
        down = ndimage.convolve1d(image, taps, axis=0, mode="constant")
        return ndimage.convolve1d(down, taps, axis=1, mode="constant")

    def blurred(self, image: np.ndarray) -> np.ndarray:
        return self.smoothed(image, np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9.0)

    def multiplied(self, image: np.ndarray) -> np.ndarray:
        frequencies = np.fft.rfft2(self.padded(image, self.grid)) * self.power
        return self.cut(np.fft.irfft2(frequencies, self.grid)) * self.known

    def conditioned(self, image: np.ndarray) -> np.ndarray:
        damped = self.padded(image * self.damping, self.small_grid)
        filled = damped + self.filling * self.blurred(damped)
        frequencies = np.fft.rfft2(filled) / self.small_power
        whitened = np.fft.irfft2(frequencies, self.small_grid)
        gathered = whitened + self.blurred(whitened * self.filling)
        return self.cut(gathered) * self.damping

    def solution(self, values: np.ndarray, start: np.ndarray, error: float, most: int) -> tuple:
        """The solution, and the number of steps to it."""
        at_edges = EDGE_PX * (1.0 - self.known_around)[self.known].sum()
        enough = error**2 * min(at_edges, self.known.sum())
        solution = self.known * start
        residual = values * self.known - self.multiplied(solution)
        conditioned = self.conditioned(residual)
        direction = conditioned
        product = (residual * conditioned).sum()
        for step in range(most):
            if product <= enough:
                return solution, step
            multiplied = self.multiplied(direction)
            length = product / (direction * multiplied).sum()
            solution = solution + length * direction
            residual = residual - length * multiplied
            conditioned = self.conditioned(residual)
            last_product = product
            product = (residual * conditioned).sum()
            direction = conditioned + product / last_product * direction
        return solution, most


@pytest.mark.parametrize("is_ragged", [True, False])
@pytest.mark.parametrize("error", [CONVERGED, 0.02])
@pytest.mark.parametrize("is_started", [True, False])
def test_a_descent_takes_the_steps_of_a_plain_one(is_ragged, error, is_started) -> None:
    """Steps by another preconditioner end elsewhere within the error, so that the descent is the
    described one if the solutions are equal to rounding, also long before it has converged."""
    random = np.random.default_rng(8)
    is_known = np.ones((70, 64), bool)
    if is_ragged:
        is_known = np.hypot(*(np.indices(is_known.shape) - 32.0)) < 26.0 + 6.0 * random.random(
            is_known.shape
        )
        is_known &= random.random(is_known.shape) > 0.05
    by_lag = noise_covariance(
        blurred(3, (90, 120), 3),
        np.ones((90, 120), bool),
        (128, 160),
    )
    values = np.where(is_known, blurred(1, is_known.shape, 3), np.float32(0.0))
    start = None
    begun = np.zeros(is_known.shape)
    if is_started:
        start = (values * np.float32(0.5)).astype(np.float32)
        begun = start
    solved = inverse_times(values, is_known, filters(by_lag, is_known.shape), start, error)
    expected, steps = PlainDescent(is_known, by_lag).solution(values, begun, error, 80)
    assert 2 < steps < 80
    np.testing.assert_allclose(solved, expected, atol=2e-3 * np.abs(expected).max())


def test_a_solution_goes_on_from_another() -> None:
    is_known = np.random.default_rng(6).random(SHAPE) > 0.1
    by_lag = noise_covariance(
        blurred(3, (90, 120)),
        np.ones((90, 120), bool),
        (128, 160),
    )
    values = np.where(is_known, blurred(1, SHAPE), np.float32(0.0))
    noise_filters = filters(by_lag, SHAPE)
    solved = inverse_times(values, is_known, noise_filters, error=0.01)
    again = inverse_times(values, is_known, noise_filters, solved)
    # nothing is left to do
    np.testing.assert_array_equal(again, solved)


def test_scores_are_the_likelihoods_where_pixels_are_missing() -> None:
    """Beside the dense covariance of the known pixels alone, for each template that the picture
    holds: closely if solved to a small error, and within twice the error that `CONVERGED` states.
    """
    noise = blurred(1, SHAPE)
    is_known = np.random.default_rng(2).random(SHAPE) > 0.1
    by_lag = noise_covariance(
        blurred(3, (90, 120)),
        np.ones((90, 120), bool),
        (128, 160),
    )
    dense = dense_of(is_known, by_lag, grid_of(SHAPE))
    assert window_of(by_lag) == BLUR_PX
    values = np.where(is_known, noise, np.float32(0.0))
    noise_filters = filters(by_lag, SHAPE)
    solved = inverse_times(values, is_known, noise_filters, error=0.01)
    rough = inverse_times(values, is_known, noise_filters)
    all_worths = worths(spectrum(by_lag, (GRID, GRID)), BLUR_PX)
    for drawn, worth in zip(bank(BLUR_PX)[:10], all_worths, strict=False):
        half = len(drawn.image) // 2
        template = np.pad(drawn.image, 20)[half + 7 : half + 33, half + 5 : half + 35]
        whitened = np.linalg.solve(dense, template[is_known])
        energy = float(template[is_known] @ whitened)
        exact = reference.score(template[is_known], noise[is_known], dense)
        score = (template * solved).sum() / energy**0.5
        assert score == pytest.approx(exact, rel=0.02, abs=0.02)
        assert abs((template * rough).sum() / energy**0.5 - exact) < 2.0 * CONVERGED
        # a part of the template is hidden
        assert 0.6 * worth.energy < energy < 1.02 * worth.energy


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.8])
def test_a_covariance_fades_by_parzens_window(share: float) -> None:
    """Of equal values everywhere, the mean product is 1 at all lags."""
    lag = round(share * LONGEST_LAG_PX)
    ones = np.ones((100, 90), np.float32)
    faded = noise_covariance(ones, np.ones(ones.shape, bool), grid_of(ones.shape))
    relative = lag / LONGEST_LAG_PX
    # Parzen's window is a cubic B-spline
    spline = 2.0 * (1.0 - relative) ** 3 - 8.0 * max(0.5 - relative, 0.0) ** 3
    middle = LONGEST_LAG_PX
    for row, column in ((middle + lag, middle), (middle, middle - lag)):
        assert faded[row, column] == pytest.approx(spline, abs=1e-5)
    assert faded[0, middle] == pytest.approx(0.0, abs=1e-7)
    assert faded[0, 0] == pytest.approx(0.0, abs=1e-7)
