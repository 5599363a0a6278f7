"""Surface fits against exact solutions: linear programming, a plain robust fit, closed forms; and
gross damage."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.chebyshev import chebvander2d
from scipy.interpolate import BSpline
from scipy.optimize import linprog

from detectors.surfaces.free_form import free_form
from detectors.surfaces.surface import Chebyshev, Surface, SurfaceConfig, fit_surface
from harness.vocabulary.errors import UserError

METHODS = ("lar", "bisquare", "lts", "least_squares")


def truth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.75 + 0.1 * x - 0.2 * y + 0.3 * x * x + 0.2 * x * y - 0.5 * y**3 + 0.4 * x * x * y


def cloud(
    n: int, seed: int = 0, sigma_m: float = 3e-4
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    x = random.uniform(-0.2, 0.3, n)
    y = random.uniform(-0.1, 0.2, n)
    return x, y, truth(x, y) + sigma_m * random.standard_normal(n)


def monomials(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The ten columns of a cubic, scaled by hand and independently of the fit's basis."""
    u = 4 * x - 0.2
    v = 6 * y - 0.3
    return np.stack([u**i * v**j for i in range(4) for j in range(4) if i + j <= 3], axis=1)


def difference_m(surface: Surface, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    return float(np.abs(surface.evaluate(x, y) - values).max())


def fit(x: np.ndarray, y: np.ndarray, z: np.ndarray, **settings: object) -> Surface:
    return fit_surface(x, y, z, SurfaceConfig.from_data(settings))


@pytest.mark.parametrize("method", METHODS)
def test_a_noise_free_cubic_is_recovered(method: str) -> None:
    x, y, z = cloud(5000, sigma_m=0.0)
    assert difference_m(fit(x, y, z, method=method), truth(x, y), x, y) < 1e-9


def test_least_squares_equals_numpy() -> None:
    x, y, z = cloud(3000)
    a = monomials(x, y)
    expected = a @ np.linalg.lstsq(a, z, rcond=None)[0]
    assert difference_m(fit(x, y, z, method="least_squares"), expected, x, y) < 1e-12


@pytest.mark.parametrize("n", [40, 300, 2500])
def test_lar_is_the_exact_least_absolute_solution(n: int) -> None:
    x, y, z = cloud(n, seed=n)
    z[: n // 10] += 0.03
    a = monomials(x, y)
    p = a.shape[1]
    cost = np.concatenate([np.zeros(p), np.ones(2 * n)])
    equalities = np.hstack([a, np.eye(n), -np.eye(n)])
    bounds = [(None, None)] * p + [(0, None)] * (2 * n)
    exact = linprog(cost, A_eq=equalities, b_eq=z, bounds=bounds, method="highs")
    surface = fit(x, y, z, method="lar")
    assert np.abs(z - surface.evaluate(x, y)).sum() <= exact.fun * (1 + 2e-6)
    # 0.3 mm of noise; the standard error of an L1 fit is 1.25 sigma sqrt(p / n), at the corners
    # three times that
    assert difference_m(surface, a @ exact.x[:p], x, y) < 0.15 * 3e-4 * np.sqrt(10 / n)


def matlab_bisquare(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """robustfit's algorithm, written plainly and run to the end on all points."""
    a = monomials(x, y)
    q, _ = np.linalg.qr(a)
    adjust = 1 / np.sqrt(1 - np.minimum(0.9999, (q**2).sum(axis=1)))
    c = np.linalg.lstsq(a, z, rcond=None)[0]
    for _ in range(100):
        r = (z - a @ c) * adjust
        scale = np.median(np.sort(np.abs(r))[9:]) / 0.6745
        w = np.sqrt(np.where(np.abs(r) < 4.685 * scale, (1 - (r / (4.685 * scale)) ** 2) ** 2, 0.0))
        c = np.linalg.lstsq(a * w[:, None], z * w, rcond=None)[0]
    return a @ c


@pytest.mark.parametrize("n", [200, 33_000])
def test_bisquare_is_the_fixed_point_of_matlabs_iteration(n: int) -> None:
    x, y, z = cloud(n)
    z[: n // 20] += 0.02
    surface = fit(x, y, z, method="bisquare")
    standard_error = 3e-4 * np.sqrt(10 / n)
    assert difference_m(surface, matlab_bisquare(x, y, z), x, y) < 0.05 * standard_error


def test_dropped_cross_terms_leave_a_separable_surface() -> None:
    x, y, z = cloud(4000, sigma_m=0.0)
    surface = fit(x, y, z, method="least_squares", drop_cross_terms=True)
    assert len(surface.coefficients) == 7
    a = np.stack([np.ones_like(x), x, y, x**2, y**2, x**3, y**3], axis=1)
    expected = a @ np.linalg.lstsq(a, z, rcond=None)[0]
    assert difference_m(surface, expected, x, y) < 1e-10
    corners = surface.evaluate(np.array([-0.1, 0.2, -0.1, 0.2]), np.array([0.0, 0.0, 0.1, 0.1]))
    assert abs(corners[0] - corners[1] - corners[2] + corners[3]) < 1e-13


@pytest.mark.parametrize(("method", "limit_mm"), [("lar", 1.0), ("bisquare", 0.1), ("lts", 0.1)])
def test_damage_of_a_tenth_of_the_area_is_survived(method: str, limit_mm: float) -> None:
    x, y, z = cloud(40_000)
    for cx, cy in (
        (-0.1, 0.0),
        (0.05, 0.1),
        (0.2, 0.02),
    ):  # three craters, a tenth of the area in all
        z[(x - cx) ** 2 + (y - cy) ** 2 < 0.04**2] += 0.03
    assert 0.09 < np.mean(z - truth(x, y) > 0.015) < 0.11
    assert difference_m(fit(x, y, z, method=method), truth(x, y), x, y) < limit_mm * 1e-3
    plain = difference_m(fit(x, y, z, method="least_squares"), truth(x, y), x, y)
    assert plain > 3e-3


@pytest.mark.parametrize("part", [0.25, 0.35])
def test_contiguous_damage_needs_the_lts_start(part: float) -> None:
    x, y, z = cloud(20_000)
    z[x < -0.2 + 0.5 * part] += 0.03
    inside = x > -0.2 + 0.5 * part
    assert difference_m(fit(x, y, z, method="lts"), truth(x, y), x, y) < 0.1e-3
    for method in ("lar", "bisquare"):
        surface = fit(x, y, z, method=method)
        assert difference_m(surface, truth(x, y), x, y) > 10e-3
        assert np.isfinite(surface.evaluate(x[inside], y[inside])).all()


@settings(max_examples=4, deadline=None)
@given(
    dx=st.floats(-3, 3), dy=st.floats(-3, 3), dz=st.floats(-0.5, 3), method=st.sampled_from(METHODS)
)
def test_moving_the_cloud_moves_the_surface(dx: float, dy: float, dz: float, method: str) -> None:
    x, y, z = cloud(1500)
    surface = fit(x, y, z, method=method)
    moved = fit(x + dx, y + dy, z + dz, method=method)
    assert difference_m(moved, surface.evaluate(x, y) + dz, x + dx, y + dy) < 1e-6


@pytest.mark.parametrize("method", ["lar", "bisquare", "least_squares"])
def test_the_order_of_points_does_not_matter(method: str) -> None:
    x, y, z = cloud(20_000)
    order = np.random.default_rng(1).permutation(len(x))
    surface = fit(x, y, z, method=method)
    shuffled = fit(x[order], y[order], z[order], method=method)
    assert difference_m(shuffled, surface.evaluate(x, y), x, y) < 0.2 * 3e-4 * np.sqrt(10 / len(x))


def test_repeating_a_fit_repeats_every_bit() -> None:
    x, y, z = cloud(20_000)
    for method in METHODS:
        a = fit(x, y, z, method=method)
        b = fit(x, y, z, method=method)
        np.testing.assert_array_equal(a.coefficients, b.coefficients)


@pytest.mark.parametrize("method", ["lar", "bisquare", "lts"])
def test_depths_rounded_to_a_few_steps_are_fitted(method: str) -> None:
    x, y, z = cloud(20_000, sigma_m=2e-4)
    flat = np.round((0.75 + (z - truth(x, y))) * 1e3) * 1e-3
    assert difference_m(fit(x, y, flat, method=method), np.full(len(x), 0.75), x, y) < 0.2e-3


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 8])
def test_every_degree_holds_its_polynomials(degree: int) -> None:
    x, y, _ = cloud(4000)
    z = 0.8 + (2 * x - 3 * y) ** degree * 0.05
    surface = fit(x, y, z, degree=degree, method="least_squares")
    assert len(surface.coefficients) == (degree + 1) * (degree + 2) // 2
    assert difference_m(surface, z, x, y) < 1e-10


def test_too_few_or_degenerate_points_are_a_clear_mistake() -> None:
    x, y, z = cloud(9)
    with pytest.raises(UserError, match="9 valid points cannot determine the 10 coefficients"):
        fit(x, y, z)
    with pytest.raises(UserError, match="lie on a line"):
        fit(np.linspace(0, 1, 50), np.linspace(0, 1, 50), np.ones(50))


@pytest.mark.parametrize("degree", [0, 1, 5])
def test_products_and_their_sum_are_numpys(degree: int) -> None:
    xy = np.random.default_rng(degree).uniform(-0.2, 0.3, (50, 2))
    chebyshev = Chebyshev.over(xy, degree)
    scaled = 2 * (xy - xy.min(axis=0)) / np.ptp(xy, axis=0) - 1
    a, b = chebyshev.powers.T
    expected = chebvander2d(*scaled.T, [degree, degree]).reshape(50, degree + 1, degree + 1)[
        :, a, b
    ]
    np.testing.assert_allclose(chebyshev.basis(xy).T, expected, atol=1e-13)
    surface = Surface(chebyshev, np.arange(1.0, 1.0 + len(chebyshev.powers)), "")
    np.testing.assert_allclose(surface.evaluate(*xy.T), expected @ surface.coefficients, atol=1e-11)


def test_a_free_form_is_the_penalised_spline() -> None:
    """The same knots and penalty, built densely from scipy's splines."""
    random = np.random.default_rng(4)
    spacing = 0.05
    wavelength = 0.2
    cell = 0.01
    points = np.column_stack([random.uniform(0, 0.3, (400, 2)), random.normal(0, 1e-3, 400)])
    points[:2, :2] = [[0, 0], [0.3, 0.3]]
    weights = random.uniform(0, 1, 400)
    counts = np.ceil(np.ptp(points[:, :2], axis=0) / spacing).astype(int) + 3
    designs = []
    for k in (0, 1):
        knots = spacing * (np.arange(counts[k] + 4) - 3.0)
        designs.append(
            BSpline.design_matrix(np.minimum(points[:, k], 0.3 - 1e-12), knots, 3).toarray()
        )
    design = np.einsum("ni,nj->nij", *designs).reshape(400, -1)
    squares = [
        [d.T @ d for d in (np.diff(np.eye(n), order, axis=0) for order in range(4))] for n in counts
    ]
    penalty = sum(f * np.kron(squares[0][k], squares[1][3 - k]) for k, f in enumerate((1, 3, 3, 1)))
    stiffness = (wavelength / (2 * np.pi)) ** 6 / cell**2 / spacing**4
    gram = design.T @ (weights[:, None] * design) + stiffness * penalty
    gram += 1e-9 * gram.diagonal().max() * np.eye(len(gram))
    expected = design @ np.linalg.solve(gram, design.T @ (weights * points[:, 2]))
    fitted = free_form(
        points, weights, lambda p: np.zeros(len(p)), wavelength, cell, central=False
    )(points)
    np.testing.assert_allclose(fitted, expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-4
