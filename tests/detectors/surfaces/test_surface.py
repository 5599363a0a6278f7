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
from detectors.surfaces.surface import (
    Chebyshev,
    Surface,
    SurfaceConfig,
    bisquare_weights,
    fit_surface,
    polynomial,
    quadric,
)
from harness.vocabulary.errors import UserError

METHODS = ("lar", "bisquare", "lts", "least_squares")


def truth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    slope = 0.75 + 0.1 * x - 0.2 * y
    bend = 0.3 * x * x + 0.2 * x * y
    return slope + bend - 0.5 * y**3 + 0.4 * x * x * y


def cloud(
    n: int,
    seed: int = 0,
    sigma_m: float = 3e-4,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    x = random.uniform(-0.2, 0.3, n)
    y = random.uniform(-0.1, 0.2, n)
    return x, y, truth(x, y) + sigma_m * random.standard_normal(n)


def monomials(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The ten columns of a cubic, scaled by hand and independently of the fit's basis."""
    u = 4 * x - 0.2
    v = 6 * y - 0.3
    columns = []
    for i in range(4):
        for j in range(4 - i):
            columns.append(u**i * v**j)
    return np.stack(columns, axis=1)


def difference_m(surface: Surface, values: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """Largest distance of a surface from values at x, y."""
    return float(np.abs(surface.evaluate(x, y) - values).max())


def error_m(surface: Surface, x: np.ndarray, y: np.ndarray) -> float:
    """Largest distance of a surface from the truth."""
    return difference_m(surface, truth(x, y), x, y)


def fit(x: np.ndarray, y: np.ndarray, z: np.ndarray, **settings: object) -> Surface:
    return fit_surface(x, y, z, SurfaceConfig.from_data(settings))


@pytest.mark.parametrize("method", METHODS)
def test_a_noise_free_cubic_is_recovered(method: str) -> None:
    x, y, z = cloud(5000, sigma_m=0.0)
    surface = fit(x, y, z, method=method)
    assert error_m(surface, x, y) < 1e-9


def test_least_squares_equals_numpy() -> None:
    x, y, z = cloud(3000)
    design = monomials(x, y)
    coefficients = np.linalg.lstsq(design, z, rcond=None)[0]
    surface = fit(x, y, z, method="least_squares")
    assert difference_m(surface, design @ coefficients, x, y) < 1e-12


@pytest.mark.parametrize("n", [40, 300, 2500])
def test_lar_is_the_exact_least_absolute_solution(n: int) -> None:
    x, y, z = cloud(n, seed=n)
    z[: n // 10] += 0.03
    design = monomials(x, y)
    terms = design.shape[1]
    # residuals are the differences of two numbers above 0, whose sum is least
    cost = np.concatenate([np.zeros(terms), np.ones(2 * n)])
    equalities = np.hstack([design, np.eye(n), -np.eye(n)])
    free = [(None, None)] * terms
    positive = [(0, None)] * (2 * n)
    exact = linprog(cost, A_eq=equalities, b_eq=z, bounds=free + positive, method="highs")
    surface = fit(x, y, z, method="lar")
    residuals = z - surface.evaluate(x, y)
    assert np.abs(residuals).sum() <= exact.fun * (1 + 2e-6)
    # 0.3 mm of noise; the standard error of an L1 fit is 1.25 sigma sqrt(p / n), at the corners
    # three times that
    standard_error = 3e-4 * np.sqrt(10 / n)
    assert difference_m(surface, design @ exact.x[:terms], x, y) < 0.15 * standard_error


def matlab_bisquare(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """robustfit's algorithm, written plainly and run to the end on all points."""
    design = monomials(x, y)
    q, _ = np.linalg.qr(design)
    leverage = (q**2).sum(axis=1)
    adjust = 1 / np.sqrt(1 - np.minimum(0.9999, leverage))
    c = np.linalg.lstsq(design, z, rcond=None)[0]
    for _ in range(100):
        r = (z - design @ c) * adjust
        scale = np.median(np.sort(np.abs(r))[9:]) / 0.6745
        u = r / (4.685 * scale)
        weights = np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0.0)
        w = np.sqrt(weights)
        c = np.linalg.lstsq(design * w[:, None], z * w, rcond=None)[0]
    return design @ c


@pytest.mark.parametrize("n", [200, 33_000])
def test_bisquare_is_the_fixed_point_of_matlabs_iteration(n: int) -> None:
    x, y, z = cloud(n)
    z[: n // 20] += 0.02
    surface = fit(x, y, z, method="bisquare")
    expected = matlab_bisquare(x, y, z)
    standard_error = 3e-4 * np.sqrt(10 / n)
    assert difference_m(surface, expected, x, y) < 0.05 * standard_error


def test_dropped_cross_terms_leave_a_separable_surface() -> None:
    x, y, z = cloud(4000, sigma_m=0.0)
    surface = fit(x, y, z, method="least_squares", drop_cross_terms=True)
    assert len(surface.coefficients) == 7
    design = np.stack([np.ones_like(x), x, y, x**2, y**2, x**3, y**3], axis=1)
    coefficients = np.linalg.lstsq(design, z, rcond=None)[0]
    assert difference_m(surface, design @ coefficients, x, y) < 1e-10
    corner_x = np.array([-0.1, 0.2, -0.1, 0.2])
    corner_y = np.array([0.0, 0.0, 0.1, 0.1])
    near_left, near_right, far_left, far_right = surface.evaluate(corner_x, corner_y)
    assert abs(near_left - near_right - far_left + far_right) < 1e-13


def test_gradients_are_those_of_a_plane_and_of_a_bend() -> None:
    """z - surface falls by the surface's slope; central differences are exact up to degree 2."""
    x, y, _ = cloud(500)
    z = 0.7 + 0.3 * x - 0.2 * y + 0.5 * x * x + 0.4 * x * y
    surface = fit(x, y, z, degree=2, method="least_squares")
    gradients = surface.gradients(x, y, 1e-3)
    np.testing.assert_allclose(gradients[:, 0], -(0.3 + x + 0.4 * y), atol=1e-9)
    np.testing.assert_allclose(gradients[:, 1], -(-0.2 + 0.4 * x), atol=1e-9)
    np.testing.assert_array_equal(gradients[:, 2], 1.0)


@pytest.mark.parametrize(("method", "limit_mm"), [("lar", 1.0), ("bisquare", 0.1), ("lts", 0.1)])
def test_damage_of_a_tenth_of_the_area_is_survived(method: str, limit_mm: float) -> None:
    x, y, z = cloud(40_000)
    # three craters, a tenth of the area in all
    for centre_x, centre_y in ((-0.1, 0.0), (0.05, 0.1), (0.2, 0.02)):
        inside = (x - centre_x) ** 2 + (y - centre_y) ** 2 < 0.04**2
        z[inside] += 0.03
    assert 0.09 < np.mean(z - truth(x, y) > 0.015) < 0.11
    robust = fit(x, y, z, method=method)
    assert error_m(robust, x, y) < limit_mm * 1e-3
    plain = fit(x, y, z, method="least_squares")
    assert error_m(plain, x, y) > 3e-3


@pytest.mark.parametrize("part", [0.25, 0.35])
def test_contiguous_damage_needs_the_lts_start(part: float) -> None:
    x, y, z = cloud(20_000)
    edge = -0.2 + 0.5 * part
    z[x < edge] += 0.03
    inside = x > edge
    by_lts = fit(x, y, z, method="lts")
    assert error_m(by_lts, x, y) < 0.1e-3
    for method in ("lar", "bisquare"):
        surface = fit(x, y, z, method=method)
        assert error_m(surface, x, y) > 10e-3
        assert np.isfinite(surface.evaluate(x[inside], y[inside])).all()


@settings(max_examples=4, deadline=None)
@given(
    dx=st.floats(-3, 3),
    dy=st.floats(-3, 3),
    dz=st.floats(-0.5, 3),
    method=st.sampled_from(METHODS),
)
def test_moving_the_cloud_moves_the_surface(dx: float, dy: float, dz: float, method: str) -> None:
    x, y, z = cloud(1500)
    surface = fit(x, y, z, method=method)
    moved = fit(x + dx, y + dy, z + dz, method=method)
    expected = surface.evaluate(x, y) + dz
    assert difference_m(moved, expected, x + dx, y + dy) < 1e-6


@pytest.mark.parametrize("method", ["lar", "bisquare", "least_squares"])
def test_the_order_of_points_does_not_matter(method: str) -> None:
    x, y, z = cloud(20_000)
    order = np.random.default_rng(1).permutation(len(x))
    surface = fit(x, y, z, method=method)
    shuffled = fit(x[order], y[order], z[order], method=method)
    standard_error = 3e-4 * np.sqrt(10 / len(x))
    assert difference_m(shuffled, surface.evaluate(x, y), x, y) < 0.2 * standard_error


def test_repeating_a_fit_repeats_every_bit() -> None:
    x, y, z = cloud(20_000)
    for method in METHODS:
        a = fit(x, y, z, method=method)
        b = fit(x, y, z, method=method)
        np.testing.assert_array_equal(a.coefficients, b.coefficients)


@pytest.mark.parametrize("method", ["lar", "bisquare", "lts"])
def test_depths_rounded_to_a_few_steps_are_fitted(method: str) -> None:
    x, y, z = cloud(20_000, sigma_m=2e-4)
    noise = z - truth(x, y)
    rounded = np.round((0.75 + noise) * 1e3) * 1e-3
    surface = fit(x, y, rounded, method=method)
    assert difference_m(surface, np.full(len(x), 0.75), x, y) < 0.2e-3


@pytest.mark.parametrize("degree", [0, 1, 2, 5, 8])
def test_every_degree_holds_its_polynomials(degree: int) -> None:
    x, y, _ = cloud(4000)
    z = 0.8 + (2 * x - 3 * y) ** degree * 0.05
    surface = fit(x, y, z, degree=degree, method="least_squares")
    terms = (degree + 1) * (degree + 2) // 2
    assert len(surface.coefficients) == terms
    assert difference_m(surface, z, x, y) < 1e-10


def test_too_few_or_degenerate_points_are_a_clear_mistake() -> None:
    x, y, z = cloud(10)
    for degree, cross, terms in ((3, True, 10), (3, False, 7), (2, True, 6), (1, False, 3)):
        settings = {"degree": degree, "drop_cross_terms": not cross, "method": "least_squares"}
        too_few = terms - 1
        message = f"{too_few} valid points cannot determine the {terms} coefficients"
        with pytest.raises(UserError, match=message):
            fit(x[:too_few], y[:too_few], z[:too_few], **settings)
        # just enough points lie on the surface
        exact = fit(x[:terms], y[:terms], z[:terms], **settings)
        assert difference_m(exact, z[:terms], x[:terms], y[:terms]) < 1e-9
    line = np.linspace(0, 1, 50)
    with pytest.raises(UserError, match="lie on a line"):
        fit(line, line, np.ones(50))


@pytest.mark.parametrize("degree", [0, 1, 5])
def test_products_and_their_sum_are_numpys(degree: int) -> None:
    xy = np.random.default_rng(degree).uniform(-0.2, 0.3, (50, 2))
    chebyshev = Chebyshev.over(xy, degree)
    scaled = 2 * (xy - xy.min(axis=0)) / np.ptp(xy, axis=0) - 1
    products = chebvander2d(scaled[:, 0], scaled[:, 1], [degree, degree])
    products = products.reshape(50, degree + 1, degree + 1)
    a, b = chebyshev.powers.T
    expected = products[:, a, b]
    np.testing.assert_allclose(chebyshev.basis(xy).T, expected, atol=1e-13)
    coefficients = np.arange(1.0, 1.0 + len(chebyshev.powers))
    surface = Surface(chebyshev, coefficients, "")
    values = surface.evaluate(xy[:, 0], xy[:, 1])
    np.testing.assert_allclose(values, expected @ coefficients, atol=1e-11)


def test_a_free_form_is_the_penalised_spline() -> None:
    """The same knots and penalty, built densely from scipy's splines."""
    random = np.random.default_rng(4)
    spacing = 0.05
    wavelength = 0.2
    cell = 0.01
    xy = random.uniform(0, 0.3, (400, 2))
    points = np.column_stack([xy, random.normal(0, 1e-3, 400)])
    points[:2, :2] = [[0, 0], [0.3, 0.3]]
    weights = random.uniform(0, 1, 400)
    rows, columns = np.ceil(np.ptp(points[:, :2], axis=0) / spacing).astype(int) + 3
    down = spline_design(points[:, 0], spacing, rows)
    across = spline_design(points[:, 1], spacing, columns)
    design = np.einsum("ni,nj->nij", down, across).reshape(400, -1)
    penalty = 0
    for order, factor in enumerate((1, 3, 3, 1)):
        mixed = np.kron(squared_differences(rows, order), squared_differences(columns, 3 - order))
        penalty = penalty + factor * mixed
    stiffness = (wavelength / (2 * np.pi)) ** 6 / cell**2 / spacing**4
    gram = design.T @ (weights[:, None] * design) + stiffness * penalty
    gram += 1e-9 * gram.diagonal().max() * np.eye(len(gram))
    right = design.T @ (weights * points[:, 2])
    expected = design @ np.linalg.solve(gram, right)
    surface = free_form(points, weights, flat, wavelength, cell, central=False)
    np.testing.assert_allclose(surface(points), expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-4


def flat(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


def spline_design(places: np.ndarray, spacing: float, count: int) -> np.ndarray:
    """The cubic splines (n, count) at places from 0 to 0.3."""
    knots = spacing * (np.arange(count + 4) - 3.0)
    inside = np.minimum(places, 0.3 - 1e-12)
    return BSpline.design_matrix(inside, knots, 3).toarray()


def squared_differences(count: int, order: int) -> np.ndarray:
    differences = np.diff(np.eye(count), order, axis=0)
    return differences.T @ differences


def test_the_weights_are_tukeys() -> None:
    r = np.array([0.0, 1.0, -1.0, 1.999, -2.0, 5.0])
    expected = [1.0, 0.75**2, 0.75**2, (1.0 - 0.9995**2) ** 2, 0.0, 0.0]
    np.testing.assert_allclose(bisquare_weights(r, 2.0), expected, atol=1e-15)
    # below a nanometre all is rounding
    np.testing.assert_allclose(bisquare_weights(np.array([5e-10]), 0.0), [0.75**2])


def test_a_weighted_polynomial_is_numpys() -> None:
    random = np.random.default_rng(5)
    points = np.column_stack(cloud(300, seed=5))
    weights = random.uniform(0.0, 2.0, 300)
    weights[:30] = 0.0
    points[:30, 2] += 1.0
    root = np.sqrt(weights)
    design = monomials(points[:, 0], points[:, 1])
    coefficients = np.linalg.lstsq(design * root[:, None], points[:, 2] * root, rcond=None)[0]
    surface = polynomial(points, weights, 3)
    # the ridge is 1e-9 of the largest element
    np.testing.assert_allclose(surface(points), design @ coefficients, atol=1e-7)


CENTRE_M = np.array([0.1, -0.05, 1.0])


def rays(seed: int, central: bool) -> np.ndarray:
    """Places (x/z, y/z) of rays through the origin, or (x, y) of parallel ones."""
    width = 0.22 if central else 0.2
    return np.random.default_rng(seed).uniform(-width, width, (400, 2)) + (
        CENTRE_M[:2] / CENTRE_M[2] if central else CENTRE_M[:2]
    )


@pytest.mark.parametrize("central", [True, False])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("radii_m", [(0.4, 0.4, 0.4), (0.4, 1e6, 0.4), (0.5, 0.4, 0.3)])
def test_a_quadric_is_the_near_or_the_far_side_of_an_ellipsoid(central, sign, radii_m) -> None:
    """A sphere, a cylinder and an ellipsoid, from outside and from inside; points without weight
    do not count, and other rays meet the same surface."""

    def seen(places: np.ndarray) -> np.ndarray:
        count = len(places)
        direction = np.tile([0.0, 0.0, 1.0], (count, 1))
        start = np.zeros((count, 3))
        if central:
            direction[:, :2] = places
        else:
            start[:, :2] = places
        ray = direction / radii_m
        off = (start - CENTRE_M) / radii_m
        a = (ray**2).sum(axis=1)
        b = (ray * off).sum(axis=1)
        c = (off**2).sum(axis=1) - 1.0
        t = (-b + sign * np.sqrt(b * b - a * c)) / a
        return start + direction * t[:, None]

    points = seen(rays(1, central))
    assert np.isfinite(points).all()
    weights = np.ones(400)
    weights[:40] = 0.0
    spoiled = points.copy()
    spoiled[:40] *= 1.02
    surface = quadric(spoiled, weights, central)
    assert surface is not None
    second = seen(rays(2, central))
    np.testing.assert_allclose(surface(second), second[:, 2], atol=2e-5)
    # a point off the surface gets the surface on its own ray
    moved = second * 1.1 if central else second + np.array([0.0, 0.0, 0.1])
    np.testing.assert_allclose(surface(moved), second[:, 2], atol=2e-5)


def test_a_ray_that_misses_a_quadric_has_no_surface() -> None:
    points = rays(1, False)
    off = points - CENTRE_M[:2]
    z = CENTRE_M[2] - np.sqrt(0.16 - (off**2).sum(axis=1))
    surface = quadric(np.column_stack([points, z]), np.ones(400), False)
    assert surface is not None
    beside = np.array(
        [[CENTRE_M[0] + 0.39, CENTRE_M[1], 1.0], [CENTRE_M[0] + 0.41, CENTRE_M[1], 1.0]]
    )
    np.testing.assert_array_equal(np.isfinite(surface(beside)), [True, False])
