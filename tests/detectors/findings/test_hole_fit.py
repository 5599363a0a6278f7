"""The fit of the hole model against a plainly written one, and its covariance against a plain one."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from detectors.findings.hole_model import WALL_PRIOR, HolePatch, fit_hole, pictures, sight
from detectors.findings.measure import local_plane
from detectors.findings.whitening import correlated_products

PER_PX_M = np.array([[1.4e-3, 0.0, 1.5e-4], [0.0, 1.4e-3, -2.0e-4]])
CENTRE_M = np.array([0.03, -0.02, 0.7])


def patch_of(hole: np.ndarray, noise_m: float, seed: int) -> HolePatch:
    """A hole seen by a camera that averages over 5 x 5 pixels, with the noise that this leaves."""
    random = np.random.default_rng(seed)
    shape = (34, 37)
    used = random.random(shape) > 0.02
    sights = sight(CENTRE_M, PER_PX_M, np.array([-14e-3, 0.0, 1e-3]))[None]
    blank = HolePatch(np.zeros(shape), used, PER_PX_M @ PER_PX_M.T, (5.0, 5.0), noise_m, sights)
    noise = cv2.blur(random.standard_normal(shape), (5, 5)) * 5.0 * noise_m
    residual = np.where(used, pictures(blank, hole[None])[0] + noise + 1e-4, np.nan)
    return HolePatch(residual, used, blank.metric_m2, blank.blur_px, noise_m, sights)


def by_minpack(
    patch: HolePatch, start: tuple[float, float, float, float, float]
) -> tuple[np.ndarray, float, bool]:
    """(hole, offset, converged) by the same least squares, written plainly, with scipy's MINPACK."""
    u, v, radius_m, depth_m, offset_m = start
    weight = patch.noise_m * math.sqrt(patch.blur_px[0] * patch.blur_px[1]) / WALL_PRIOR[1]
    data = patch.residual_m[patch.used]

    def hole_of(q: np.ndarray) -> np.ndarray:
        radius = math.exp(q[2])
        return np.array([q[0], q[1], radius, q[3] / radius**2, math.sin(0.5 * math.pi * q[5]) ** 2])

    def misfit(q: np.ndarray) -> np.ndarray:
        hole = hole_of(q)
        image = pictures(patch, hole[None])[0][patch.used]
        return np.append(image + q[4] - data, weight * (hole[4] - WALL_PRIOR[0]))

    def jacobian(q: np.ndarray) -> np.ndarray:
        hole = hole_of(q)
        steps = np.array([1e-3, 1e-3, 1e-6, 1e-6, 1e-3])
        ends = (
            pictures(patch, hole + sign * np.diag(steps))[:, patch.used] for sign in (0.5, -0.5)
        )
        by = (next(ends) - next(ends)) / steps[:, None]
        slope = 0.5 * math.pi * math.sin(math.pi * q[5])
        columns = [
            by[0],
            by[1],
            hole[2] * by[2] - 2.0 * hole[3] * by[3],
            by[3] / hole[2] ** 2,
            np.ones(len(data)),
        ]
        rows = np.column_stack([*columns, by[4] * slope])
        return np.vstack([rows, [0.0, 0.0, 0.0, 0.0, 0.0, weight * slope]])

    begin = np.array([u, v, math.log(radius_m), depth_m * radius_m**2, offset_m, WALL_PRIOR[0]])
    stop = {"xtol": 1e-9, "ftol": 1e-9, "gtol": 1e-12, "max_nfev": 500}
    # its default scaling is MINPACK's own, by the columns of the Jacobian
    found = least_squares(misfit, begin, jacobian, method="lm", x_scale="jac", **stop)
    return hole_of(found.x), float(found.x[4]), bool(found.success)


def square_of(patch: HolePatch, hole: np.ndarray, offset_m: float) -> float:
    """The sum of squares that is least."""
    left = (pictures(patch, hole[None])[0] + offset_m - patch.residual_m)[patch.used]
    return float(left @ left + (patch.prior_weight * (hole[4] - WALL_PRIOR[0])) ** 2)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("radius_mm", "depth_mm"),
    [(2.1, 12.7), (3.2, 6.0), (4.8, 33.0), (6.4, 3.0), (12.7, 12.7), (4.0, -5.0)],
)
def test_the_fit_is_that_of_the_plainly_written_least_squares(
    radius_mm: float, depth_mm: float, seed: int
) -> None:
    hole = np.array([18.3, 16.4, radius_mm * 1e-3, depth_mm * 1e-3, 0.6])
    patch = patch_of(hole, 1.5e-4, seed)
    start = (17.6, 16.9, 1.2e-3 * radius_mm, 0.7e-3 * depth_mm, 0.0)
    found = fit_hole(patch, *start)
    expected, offset, converged = by_minpack(patch, start)
    assert found.converged == converged
    ours = np.array(
        [found.u_px, found.v_px, found.radius_m, found.depth_m, found.offset_m, found.wall]
    )
    apart = np.abs(ours - [*expected[:4], offset, expected[4]])
    error = np.sqrt(np.diag(found.covariance))
    # the sum of squares has kinks where circles cross strips, so that descents end near its least,
    # not at one place
    assert (apart < error).all()
    sums = [
        square_of(patch, *fit)
        for fit in ((ours[[0, 1, 2, 3, 5]], found.offset_m), (expected, offset))
    ]
    assert sums[0] < 1.005 * sums[1]


def test_a_hopeless_start_is_told_and_not_looped_over() -> None:
    patch = patch_of(np.array([18.3, 16.4, 3e-3, 0.01, 0.6]), 1.5e-4, 0)
    flat = HolePatch(
        np.where(patch.used, 1e-4, np.nan),
        patch.used,
        patch.metric_m2,
        (5.0, 5.0),
        1.5e-4,
        patch.sights,
    )
    fit = fit_hole(flat, 1000.0, -1000.0, 50.0, 0.1, 0.0)
    assert np.isfinite([fit.u_px, fit.v_px, fit.radius_m]).all()


@pytest.mark.parametrize("window", [(5, 5), (1, 1), (3, 7)])
def test_correlated_products_equal_box_filters(window: tuple[int, int]) -> None:
    across, down = window
    columns = np.random.default_rng(1).standard_normal((6, 19, 23))
    padded = np.pad(columns, ((0, 0), (down - 1, down - 1), (across - 1, across - 1)))
    filtered = [
        cv2.boxFilter(one, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        for one in padded
    ]
    summed = np.stack(filtered).reshape(6, -1)
    np.testing.assert_allclose(
        correlated_products(np.moveaxis(columns, 0, -1), across, down),
        summed @ summed.T,
        rtol=1e-10,
        atol=1e-9,
    )


@pytest.mark.parametrize("projection", ["central", "parallel"])
def test_a_local_plane_is_that_of_exact_points(projection: str) -> None:
    """A point and derivatives of a plane that is known everywhere, from some of its pixels with
    other depths."""
    random = np.random.default_rng(2)
    v, u = np.mgrid[:9, :11].astype(float)
    if projection == "parallel":
        surface = np.stack([1e-3 * u, 1.1e-3 * v, 0.7 + 2e-4 * u - 1e-4 * v], axis=-1)
        points = surface + np.multiply.outer(random.uniform(-0.01, 0.01, u.shape), [0.0, 0.0, 1.0])
        expected = np.array([[1e-3, 0.0, 2e-4], [0.0, 1.1e-3, -1e-4]])
    else:
        rays = np.stack([2e-3 * (u - 40), 2e-3 * (v + 30), np.ones(u.shape)], axis=-1)
        z = 0.7 + 2e-4 * u - 1e-4 * v
        surface = rays * z[..., None]
        points = rays * random.uniform(0.69, 0.71, u.shape)[..., None]
    finite = random.random(u.shape) > 0.3
    own = np.zeros(u.shape, dtype=bool)
    own[3:6, 4:7] = True
    found = local_plane(points, surface[..., 2], finite, own, projection)
    assert found is not None
    if projection == "central":
        expected = np.stack(
            [(surface[4, 6] - surface[4, 4]) / 2, (surface[5, 5] - surface[3, 5]) / 2]
        )
    np.testing.assert_allclose(found[0], surface[4, 5], rtol=1e-10)
    np.testing.assert_allclose(found[1], expected, rtol=1e-9, atol=1e-12)


def test_a_sight_equals_the_one_by_pseudo_inverses() -> None:
    emitter = np.array([-14e-3, 0.0, 1e-3])
    found = sight(CENTRE_M, PER_PX_M, emitter)
    normal = np.cross(*PER_PX_M)
    normal /= np.copysign(np.linalg.norm(normal), normal @ CENTRE_M)
    ray = CENTRE_M / CENTRE_M[2]
    z = CENTRE_M[2]
    slopes = ((PER_PX_M - np.outer(PER_PX_M[:, 2], ray)) / z)[:, :2].T
    np.testing.assert_allclose(
        found[1:3], np.linalg.pinv(slopes) @ (normal - normal[2] * ray)[:2] / z, rtol=1e-10
    )
    on_axis = emitter - CENTRE_M * float(normal @ emitter) / float(normal @ CENTRE_M)
    np.testing.assert_allclose(found[4:6], np.linalg.pinv(PER_PX_M.T) @ on_axis, rtol=1e-10)
