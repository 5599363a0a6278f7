"""Rigid motions against SciPy's alignment of vectors, finite differences and motions by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from detectors.rigid_motion import displacement_jacobian, kabsch, moved_by


def aligned(from_m: np.ndarray, to_m: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The transform (4, 4) of points (n, 3), by SciPy."""
    from_centre = np.average(from_m, axis=0, weights=weights)
    to_centre = np.average(to_m, axis=0, weights=weights)
    rotation, _ = Rotation.align_vectors(to_m - to_centre, from_m - from_centre, weights=weights)
    T = np.eye(4)
    T[:3, :3] = rotation.as_matrix()
    T[:3, 3] = to_centre - rotation.apply(from_centre)
    return T


@pytest.mark.parametrize("noise_m", [0.0, 0.05])
def test_the_transform_of_weighted_points_is_that_of_scipy(noise_m: float) -> None:
    random = np.random.default_rng(3)
    from_m = random.normal([0.2, -0.3, 0.9], [0.3, 0.2, 0.1], (6, 9, 3))
    to_m = np.empty_like(from_m)
    for number, points in enumerate(from_m):
        rotation = Rotation.from_rotvec(random.normal(size=3))
        to_m[number] = rotation.apply(points) + random.normal(size=3)
    to_m += noise_m * random.normal(size=to_m.shape)
    weights = random.uniform(0.0, 2.0, (6, 9))
    T = kabsch(from_m, to_m, weights)
    for number in range(6):
        expected = aligned(from_m[number], to_m[number], weights[number])
        np.testing.assert_allclose(T[number], expected, atol=1e-9)
        # without a stack of transforms
        alone = kabsch(from_m[number], to_m[number], weights[number])
        np.testing.assert_allclose(alone, expected, atol=1e-9)


def test_points_without_weight_do_not_count() -> None:
    random = np.random.default_rng(4)
    points = random.normal(size=(8, 3))
    expected = moved_by(np.array([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]), np.zeros(3))
    moved = points @ expected[:3, :3].T + expected[:3, 3]
    moved[5:] += 7.0
    weights = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(kabsch(points, moved, weights), expected, atol=1e-12)


def test_mirrored_points_get_a_rotation_and_no_reflection() -> None:
    """Points mirrored at their flattest axis: the best rotation is none."""
    random = np.random.default_rng(5)
    points = random.normal(size=(300, 3)) * [3.0, 2.0, 0.1]
    axes = np.linalg.eigh(np.cov(points.T))[1]
    mirrored = points @ axes * [-1.0, 1.0, 1.0] @ axes.T
    T = kabsch(points, mirrored, np.ones(300))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T, aligned(points, mirrored, np.ones(300)), atol=1e-9)
    np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=1e-3)


def test_a_motion_turns_about_its_centre_and_then_shifts() -> None:
    centre_m = np.array([0.1, -0.2, 0.8])
    shift_m = np.array([0.01, 0.02, -0.03])
    T = moved_by(np.array([0.0, 0.0, np.pi / 2, *shift_m]), centre_m)
    np.testing.assert_allclose(T @ [*centre_m, 1.0], [*(centre_m + shift_m), 1.0], atol=1e-15)
    # a quarter turn about z takes x to y
    point = centre_m + np.array([0.5, 0.0, 0.25])
    expected = centre_m + np.array([0.0, 0.5, 0.25]) + shift_m
    np.testing.assert_allclose(T @ [*point, 1.0], [*expected, 1.0], atol=1e-15)


def test_the_derivatives_are_those_of_small_motions() -> None:
    random = np.random.default_rng(6)
    points = random.normal(size=(5, 3))
    centre_m = np.array([0.4, -0.7, 1.1])
    jacobian = displacement_jacobian(points, centre_m)
    assert jacobian.shape == (5, 3, 6)
    for parameter in range(6):
        motion = np.zeros(6)
        motion[parameter] = 1e-6
        ahead = moved_by(motion, centre_m)
        behind = moved_by(-motion, centre_m)
        change = points @ (ahead - behind)[:3, :3].T + (ahead - behind)[:3, 3]
        np.testing.assert_allclose(jacobian[:, :, parameter], change / 2e-6, atol=1e-8)
