"""Least absolute residuals where a few points lie many widths of the others away."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.optimize import linprog

from detectors.surfaces import interior_point, surface
from detectors.surfaces.interior_point import least_absolute, least_absolute_of_many
from detectors.surfaces.surface import Chebyshev, SurfaceConfig, fit_surface

TERMS = 10


def drilled_plate(columns: int, rows: int) -> np.ndarray:
    """Return (n, 3) points of a plate at 0.26 m; three rays of 1000 pass it and go up to 10 m."""
    random = np.random.default_rng(1)
    across, down = np.meshgrid(np.linspace(-1.2, 1.2, columns), np.linspace(-0.9, 0.9, rows))
    noise_m = random.normal(0.0, 0.002, across.shape)
    z = 0.26 * (1 + 0.1 * down) + noise_m
    passes = random.random(across.shape) < 0.003
    z[passes] = random.uniform(0.3, 10.0, passes.sum())
    return np.stack([across * z, down * z, z], axis=-1).reshape(-1, 3)


def least_sum(basis: np.ndarray, z: np.ndarray) -> float:
    """The least sum of absolute residuals, by linear programming."""
    n = len(z)
    cost = np.concatenate([np.zeros(TERMS), np.ones(2 * n)])
    equalities = np.hstack([basis.T, np.eye(n), -np.eye(n)])
    bounds = [(None, None)] * TERMS + [(0, None)] * (2 * n)
    return float(linprog(cost, A_eq=equalities, b_eq=z, bounds=bounds, method="highs").fun)


@pytest.mark.parametrize("gap", [1e-3, 1e-6])
def test_the_sum_exceeds_the_least_by_no_more_than_it_says(gap: float) -> None:
    points = drilled_plate(60, 40)
    basis = Chebyshev.over(points[:, :2], degree=3).basis(points[:, :2])
    z = points[:, 2]
    c, reached = least_absolute(basis, z, np.zeros(TERMS), gap)
    exact = least_sum(basis, z)
    excess = np.abs(z - c @ basis).sum() / exact - 1
    assert -1e-9 < excess <= reached * (1 + 1e-6) + 1e-9
    assert reached <= gap


def test_points_that_lie_on_a_surface_are_solved_at_once() -> None:
    points = drilled_plate(60, 40)
    basis = Chebyshev.over(points[:, :2], degree=3).basis(points[:, :2])
    truth = np.linspace(1.0, -1.0, TERMS)
    c, reached = least_absolute(basis, truth @ basis, truth, 1e-6)
    assert np.array_equal(c, truth)
    assert reached <= 1e-6


def many_points(columns: int = 200, rows: int = 150) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the products (p, n) of a drilled plate, z (n,), and the solution (p,) of every eighth
    point."""
    points = drilled_plate(columns, rows)
    basis = Chebyshev.over(points[:, :2], degree=3).basis(points[:, :2])
    z = points[:, 2]
    start, _ = least_absolute(basis[:, ::8], z[::8], np.zeros(TERMS), 1e-6)
    return basis, z, start


@pytest.mark.parametrize("rounds", [interior_point.MOST_ROUNDS, 0])
def test_points_on_one_side_that_count_as_one_leave_the_least_sum(monkeypatch, rounds: int) -> None:
    """Also where all have to be solved for at last."""
    basis, z, start = many_points()
    monkeypatch.setattr(interior_point, "MOST_ROUNDS", rounds)
    expected, _ = least_absolute(basis, z, start, 1e-7)
    c, reached = least_absolute_of_many(basis, z, start, 1e-6)
    excess = np.abs(z - c @ basis).sum() / np.abs(z - expected @ basis).sum() - 1
    assert -1e-7 < excess <= reached + 1e-7
    assert reached <= 1e-6


def test_few_of_many_points_are_solved_for_one_by_one(monkeypatch) -> None:
    """Those on a wrong side of the first surface are solved for then: a fifth suffices."""
    basis, z, start = many_points(400, 300)
    solved_for = []

    def counting(few_basis: np.ndarray, *arguments: object) -> object:
        solved_for.append(few_basis.shape[1] / len(z))
        return least_absolute(few_basis, *arguments)

    monkeypatch.setattr(interior_point, "least_absolute", counting)
    least_absolute_of_many(basis, z, start, 1e-6)
    assert 1 < len(solved_for) <= interior_point.MOST_ROUNDS
    assert max(solved_for) < 0.2


def test_leverages_are_those_of_the_projection() -> None:
    basis, _, _ = many_points()
    few = basis[:, :300]
    projection = few.T @ np.linalg.solve(few @ few.T, few)
    np.testing.assert_allclose(interior_point._leverage(few), projection.diagonal(), rtol=1e-3)


def test_few_points_far_away_cost_hundreds_of_steps_not_thousands(monkeypatch) -> None:
    """The points that keep their side pulled a surface that they do not determine: it went to
    infinity in 60 steps, for each of ten margins."""
    steps: Counter[str] = Counter()

    def counted(module: object, name: str) -> None:
        function = getattr(module, name)

        def counting(*arguments: object) -> object:
            steps[name] += 1
            return function(*arguments)

        monkeypatch.setattr(module, name, counting)

    counted(surface, "_huber")
    counted(interior_point, "_stepped")
    x, y, z = drilled_plate(240, 180).T
    fitted = fit_surface(x, y, z, SurfaceConfig())
    assert steps["_huber"] + steps["_stepped"] < 800
    # the sum that 3321 steps reached
    assert np.abs(z - fitted.evaluate(x, y)).sum() < 467.80707
