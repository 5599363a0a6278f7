"""Coherent point drift against a dense implementation written from the paper's figure, and against
known transforms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from detectors.views.registration.by_points import (
    coherent_point_drift,
    drift_covariance,
    posterior_moments,
)
from detectors.views.registration.settings import CpdRegistration
from harness.vocabulary.geometry import transform_points

EXACT = CpdRegistration(max_iterations=300, tolerance=1e-14)


def cloud(points: int, seed: int = 0) -> np.ndarray:
    """Points without symmetry, some decimetres across."""
    random = np.random.default_rng(seed)
    return random.standard_normal((points, 3)) ** 3 * [0.05, 0.03, 0.01] + [0.1, -0.2, 0.7]


def transform(
    rotation_deg: tuple[float, float, float], shift_m: tuple[float, float, float]
) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix()
    T[:3, 3] = shift_m
    return T


def dense_posterior(
    fixed: np.ndarray,
    moving: np.ndarray,
    variance: float,
    w: float,
) -> np.ndarray:
    """Equation 6 of Myronenko & Song: (m, n), moving by fixed."""
    gauss = np.exp(-cdist(moving, fixed, "sqeuclidean") / (2 * variance))
    uniform = (2 * np.pi * variance) ** 1.5 * w / (1 - w) * len(moving) / len(fixed)
    return gauss / (gauss.sum(axis=0) + uniform)


def dense_cpd(
    fixed: np.ndarray,
    moving: np.ndarray,
    w: float,
    iterations: int,
) -> np.ndarray:
    """Figure 2 of the paper with s = 1, in the normalised units of the module under test."""
    middle = fixed.mean(axis=0)
    scale = np.sqrt(np.mean(np.sum((fixed - middle) ** 2, axis=1)))
    x = (fixed - middle) / scale
    y = (moving - moving.mean(axis=0)) / scale
    m = len(y)
    n = len(x)
    turn = np.eye(3)
    shift = np.zeros(3)
    variance = cdist(y, x, "sqeuclidean").sum() / (3 * m * n)
    for _ in range(iterations):
        p = dense_posterior(x, y @ turn.T + shift, variance, w)
        total = p.sum()
        mean_x = x.T @ p.sum(axis=0) / total
        mean_y = y.T @ p.sum(axis=1) / total
        x0 = x - mean_x
        y0 = y - mean_y
        a = x0.T @ p.T @ y0
        u, _, vt = np.linalg.svd(a)
        turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        shift = mean_x - turn @ mean_y
        spread = np.sum(x0**2 * p.sum(axis=0)[:, None]) + np.sum(y0**2 * p.sum(axis=1)[:, None])
        variance = (spread - 2 * np.trace(a.T @ turn)) / (3 * total)
    T = np.eye(4)
    T[:3, :3] = turn
    T[:3, 3] = middle + scale * shift - turn @ moving.mean(axis=0)
    return T


@pytest.mark.parametrize("w", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("variance", [1e-2, 1e-4, 1e-6])
def test_the_expectation_is_the_papers(w, variance):
    fixed = cloud(70)
    moving = cloud(40, 1)
    background = (2 * np.pi * variance) ** 1.5 * w / (1 - w) * 40 / 70
    moments, objective = posterior_moments(fixed, moving, variance, background)
    # logarithms, because the paper's own form underflows where the kernel's does not
    exponents = -cdist(moving, fixed, "sqeuclidean") / (2 * variance)
    with np.errstate(divide="ignore"):
        density = np.logaddexp(logsumexp(exponents, axis=0), np.log(background))
    homogeneous = np.concatenate([moving, np.ones((40, 1))], axis=1)
    expected = np.einsum("mn,mi,mj->nij", np.exp(exponents - density), homogeneous, homogeneous)
    np.testing.assert_allclose(moments, expected, rtol=1e-9, atol=1e-15)
    assert objective == pytest.approx(-float(density.sum()), rel=1e-10)


@pytest.mark.parametrize("w", [0.05, 0.1, 0.4])
def test_every_iteration_is_that_of_a_dense_implementation(w):
    noise = 0.003 * np.random.default_rng(5).standard_normal((80, 3))
    fixed = cloud(60)
    moving = transform_points(transform((8, -5, 12), (0.02, 0.01, -0.03)), cloud(80) + noise)
    for iterations in (1, 5, 20):
        config = CpdRegistration(outlier_ratio=w, max_iterations=iterations, tolerance=1e-300)
        result = coherent_point_drift(fixed, moving, config)
        assert result.iterations == iterations
        np.testing.assert_allclose(
            result.T_fixed_moving,
            dense_cpd(fixed, moving, w, iterations),
            rtol=0,
            atol=1e-9,
        )


@given(
    turn=st.tuples(*[st.floats(-25, 25)] * 3),
    shift=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
    seed=st.integers(0, 5),
)
@settings(max_examples=8, deadline=None)
def test_known_transforms_come_back_through_outliers(
    turn,
    shift,
    seed,
):
    T = transform(turn, shift)
    fixed = cloud(150, seed)
    moving = transform_points(np.linalg.inv(T), fixed)
    random = np.random.default_rng(seed)
    low = fixed.min(axis=0)
    high = fixed.max(axis=0)
    strays = random.uniform(low, high, (20, 3))
    result = coherent_point_drift(np.concatenate([fixed, strays]), moving, EXACT)
    np.testing.assert_allclose(transform_points(result.T_fixed_moving, moving), fixed, atol=2e-5)
    rotation = result.T_fixed_moving[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_the_background_is_that_of_the_last_iteration():
    """With it and the width found, metres give the posterior that the drift itself ended with."""
    random = np.random.default_rng(2)
    truth = 0.1 * cloud(300)
    fixed = np.concatenate(
        [truth + 3e-4 * random.standard_normal((300, 3)), random.uniform(-0.1, 0.1, (60, 3))]
    )
    drift = coherent_point_drift(fixed, truth, CpdRegistration(max_iterations=500, tolerance=1e-13))
    moved = transform_points(drift.T_fixed_moving, truth)
    moments, _ = posterior_moments(fixed, moved, drift.sigma_m**2, drift.background)
    assert drift.converged
    assert drift.matched < 359
    np.testing.assert_allclose(float(moments[:, 3, 3].sum()), drift.matched, rtol=0, atol=1e-9)


def test_a_grown_cloud_gives_no_scale():
    fixed = cloud(200)
    middle = fixed.mean(axis=0)
    result = coherent_point_drift(fixed, middle + 1.02 * (fixed - middle), EXACT)
    assert np.linalg.svd(result.T_fixed_moving[:3, :3])[1] == pytest.approx([1, 1, 1], abs=1e-12)


def test_a_mirrored_cloud_is_not_mirrored_back():
    fixed = cloud(200)
    result = coherent_point_drift(fixed, fixed * [-1, 1, 1], EXACT)
    assert np.linalg.det(result.T_fixed_moving[:3, :3]) == pytest.approx(1.0)


def test_only_the_turn_of_the_guess_matters():
    fixed = cloud(100)
    moving = transform_points(transform((60, 0, 0), (0, 0, 0)), cloud(100))
    start = transform((-55, 3, 0), (0.0, 0.0, 0.0))
    far = transform((0, 0, 0), (3.0, -2.0, 1.0)) @ start
    from_guess = coherent_point_drift(fixed, moving, EXACT, start).T_fixed_moving
    np.testing.assert_allclose(
        coherent_point_drift(fixed, moving, EXACT, far).T_fixed_moving,
        from_guess,
        atol=1e-9,
    )
    np.testing.assert_allclose(transform_points(from_guess, moving), fixed, atol=1e-5)


def test_equal_clouds_end_at_once_and_stay():
    result = coherent_point_drift(
        cloud(50),
        cloud(50),
        CpdRegistration(outlier_ratio=0.0, max_iterations=1000),
    )
    assert result.converged
    np.testing.assert_allclose(result.T_fixed_moving, np.eye(4), atol=1e-9)


def test_a_loose_tolerance_stops_early_and_a_tight_one_runs_on():
    noise = 0.003 * np.random.default_rng(5).standard_normal((100, 3))
    fixed = cloud(100)
    moving = transform_points(transform((5, 0, 0), (0.01, 0, 0)), cloud(100) + noise)
    loose = coherent_point_drift(fixed, moving, CpdRegistration(tolerance=0.5))
    tight = coherent_point_drift(fixed, moving, CpdRegistration(tolerance=1e-12))
    assert loose.converged
    assert loose.iterations < 5 < tight.iterations


@pytest.mark.slow
def test_the_covariance_is_that_of_repeats():
    """120 repeats of 300 noisy points: the mean of d'C^-1 d over repeats is 6 for a true
    covariance.

    The clouds' noise is independent from point to point, and each cube of 5 pitches holds one
    point. The covariance may overstate the variances by a factor of 1.6 (it does so by 1.5), and
    may not understate them: the upper limit is three standard errors of the mean above 6, so that
    half the covariance fails.
    """
    truth = cloud(300)
    noise = 0.001
    distances = []
    for seed in range(120):
        random = np.random.default_rng(seed)
        fixed = truth + noise * random.standard_normal(truth.shape)
        moving = truth + noise * random.standard_normal(truth.shape)
        drift = coherent_point_drift(fixed, moving, CpdRegistration(max_iterations=60))
        moved = transform_points(drift.T_fixed_moving, moving)
        covariance = drift_covariance(fixed, moved, drift, pitch_m=1e-5)
        centre = fixed.mean(axis=0)
        error = np.concatenate(
            [
                Rotation.from_matrix(drift.T_fixed_moving[:3, :3]).as_rotvec(),
                transform_points(drift.T_fixed_moving, centre) - centre,
            ]
        )
        distances.append(error @ np.linalg.solve(covariance, error))
    assert 6 / 1.6 < np.mean(distances) < 6 + 3 * np.sqrt(12 / 120)


def test_points_all_over_a_flat_disc_hold_no_turn():
    random = np.random.default_rng(0)
    radius = 0.1 * np.sqrt(random.uniform(size=3000))
    angle = random.uniform(0, 2 * np.pi, 3000)
    disc = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(3000, 0.5)], axis=1)
    fixed = disc[:1500]
    moving = disc[1500:]
    drift = coherent_point_drift(fixed, moving, CpdRegistration())
    covariance = drift_covariance(
        fixed,
        transform_points(drift.T_fixed_moving, moving),
        drift,
        pitch_m=0.004,
    )
    assert np.isnan(covariance).all()


def test_the_last_step_is_the_distance_that_it_moves_the_points() -> None:
    """The first step starts from equal centroids."""
    fixed = cloud(300)
    moving = transform_points(transform((2, -3, 5), (0.01, 0.02, -0.01)), cloud(280, seed=1))
    drift = coherent_point_drift(fixed, moving, CpdRegistration(max_iterations=1))
    before = moving - moving.mean(axis=0) + fixed.mean(axis=0)
    after = transform_points(drift.T_fixed_moving, moving)
    assert drift.iterations == 1
    moved_m = np.sqrt(((after - before) ** 2).sum(axis=1).mean())
    assert drift.step_m == pytest.approx(moved_m, rel=1e-9)
