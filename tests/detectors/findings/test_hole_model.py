"""The model of a blurred hole against its plainly written reference: pictures, fits, stated
errors."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.findings import hole_model_reference as reference
from detectors.findings.blurs import smooth
from detectors.findings.hole_model import fit_hole, sandwich_covariance
from detectors.findings.hole_patch import WALL_PRIOR, HolePatch, lens_side
from detectors.findings.pictures import pictures
from detectors.findings.surroundings import local_plane
from detectors.findings.viewpoints import sight, straight_sight

PER_PX_M = np.array([[1.4e-3, 0.0, 1.5e-4], [0.0, 1.4e-3, -2.0e-4]])
CENTRE_M = np.array([0.03, -0.02, 0.7])
EMITTER_M = np.array([-14e-3, 0.0, 1e-3])
SIGHT = sight(CENTRE_M, PER_PX_M, EMITTER_M)


def blank_patch(
    noise_m: float = 1.5e-4,
    shape: tuple[int, int] = (34, 37),
    blur_px: tuple[float, float] = (5.0, 5.0),
    sights: np.ndarray = SIGHT[None],
) -> HolePatch:
    return HolePatch(
        residual_m=np.zeros(shape),
        used=np.ones(shape, bool),
        metric_m2=PER_PX_M @ PER_PX_M.T,
        blur_px=blur_px,
        noise_m=noise_m,
        sights=sights,
    )


def patch_of(hole: np.ndarray, noise_m: float, seed: int) -> HolePatch:
    """A hole seen by a camera that averages over 5 x 5 pixels, with the noise that this leaves."""
    random = np.random.default_rng(seed)
    blank = blank_patch(noise_m)
    used = random.random(blank.used.shape) > 0.02
    noise = cv2.blur(random.standard_normal(used.shape), (5, 5)) * 5.0 * noise_m
    residual_m = np.where(
        used,
        pictures(blank, hole[None])[0] + noise + 1e-4,
        np.nan,
    )
    return replace(blank, residual_m=residual_m, used=used)


# ---- pictures


OBLIQUE = sight(np.array([0.3, -0.2, 0.7]), PER_PX_M, EMITTER_M)
TWO_CAMERAS = np.stack(
    [
        sight(np.array([0.3, -0.2, 0.7]), PER_PX_M, EMITTER_M, 0.3),
        sight(np.array([-0.2, 0.1, 0.7]), PER_PX_M, EMITTER_M, 0.7),
    ]
)


@pytest.mark.parametrize(
    ("sights", "blur_px", "radius_mm", "depth_mm", "wall"),
    [
        (SIGHT[None], (5.0, 5.0), 6.4, 12.7, 0.6),
        (SIGHT[None], (5.0, 5.0), 2.1, 33.0, 1.0),
        (OBLIQUE[None], (1.0, 1.0), 12.7, 33.0, 0.3),
        (OBLIQUE[None], (5.0, 3.0), 12.7, 20.0, 0.0),
        (OBLIQUE[None], (3.0, 3.0), 9.0, -5.0, 0.5),
        (TWO_CAMERAS, (5.0, 5.0), 9.0, 20.0, 0.7),
        (straight_sight(PER_PX_M)[None], (3.0, 3.0), 6.0, 10.0, 0.9),
    ],
)
def test_a_picture_is_that_of_the_reference(sights, blur_px, radius_mm, depth_mm, wall):
    patch = blank_patch(blur_px=blur_px, sights=sights)
    hole = np.array([18.3, 16.4, radius_mm * 1e-3, depth_mm * 1e-3, wall])
    image = pictures(patch, hole[None])[0]
    expected = reference.picture(patch, hole)
    # chords are those of the middles of strips, points lie an eighth of a pixel apart
    np.testing.assert_allclose(
        image,
        expected,
        atol=0.06e-3 * abs(depth_mm) / blur_px[0],
    )
    assert image.sum() == pytest.approx(expected.sum(), rel=6e-3)


def test_pictures_of_several_holes_are_those_of_each():
    holes = np.array([[18.3, 16.4, 5e-3, 0.01, 0.5], [3.0, 30.0, 8e-3, 0.02, 0.1]])
    patch = blank_patch()
    together = pictures(patch, holes)
    for image, hole in zip(together, holes, strict=True):
        np.testing.assert_array_equal(image, pictures(patch, hole[None])[0])
    # the second is cut by the patch's edge
    np.testing.assert_allclose(
        together[1],
        reference.picture(patch, holes[1]),
        atol=2e-4,
    )


@pytest.mark.parametrize("deviation_px", [0.0, 0.45, 0.81, 0.82, 1.5, 4.0])
def test_a_lens_rectangle_has_the_second_moment_of_its_blur(deviation_px: float) -> None:
    """Means over columns of pixels, of which the last ones count in parts; beyond sides of 3 pixels,
    these parts leave 7 %."""
    column = np.zeros((41, 1))
    column[20] = 1.0
    smooth(column, 1.0, lens_side(deviation_px))
    moment_px2 = float(column[:, 0] @ (np.arange(41) - 20.0) ** 2)
    assert column.sum() == pytest.approx(1.0)
    error = 1e-9 if deviation_px < 0.82 else 0.07
    assert moment_px2 == pytest.approx(deviation_px**2, rel=error, abs=1e-12)


@pytest.mark.parametrize("corner", [(12, 9), (0, 0), (28, 25), (40, 40)])
def test_a_picture_is_smoothed_where_it_is_not_0(corner: tuple[int, int]) -> None:
    """As the mean of a picture of small parts of pixels, in the middle, at the edges, and without
    anything."""
    top, left = corner
    image = np.zeros((31, 29))
    noise = np.random.default_rng(0).standard_normal((6, 7))
    image[top : top + 6, left : left + 7] = noise[: max(31 - top, 0), : max(29 - left, 0)]
    # pixels of 20 x 20 parts; sides of 3.7 x 1.2 pixels are 74 x 24 of them
    parts = np.kron(np.pad(image, 4, mode="edge"), np.ones((20, 20)))
    sums = np.pad(parts.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    rows = 20 * np.arange(4, 35) + 10
    columns = 20 * np.arange(4, 33) + 10
    expected = (
        sums[np.ix_(rows + 12, columns + 37)]
        - sums[np.ix_(rows + 12, columns - 37)]
        - sums[np.ix_(rows - 12, columns + 37)]
        + sums[np.ix_(rows - 12, columns - 37)]
    ) / (74 * 24)
    smooth(image, 3.7, 1.2)
    np.testing.assert_allclose(image, expected, atol=1e-11)


def pixels_of(patch: HolePatch, hole: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the share (h, w) of each pixel in which the lit floor is seen, and that of the face,
    before the filter averages them."""
    flat = np.array([*hole[:3], -1.0, 0.0])
    sharp = replace(patch, blur_px=(1.0, 1.0))
    return reference.picture(sharp, hole) / hole[3], 1.0 + reference.picture(sharp, flat)


@pytest.mark.parametrize("radius_mm", [3.2, 4.5, 9.0])
@pytest.mark.parametrize("brightness", [1.0, 0.4])
def test_a_filter_by_light_is_that_of_phasors(brightness: float, radius_mm: float) -> None:
    """Sums over 5 x 5 pixels of depth times light, over those of light."""
    emitter_m = np.array([-80e-3, 0.0, 0.0])
    sights = sight(CENTRE_M, PER_PX_M, emitter_m)[None]
    patch = replace(blank_patch(sights=sights), brightness=brightness)
    hole = np.array([18.3, 16.4, radius_mm * 1e-3, 33e-3, 0.0])
    lit, face = pixels_of(patch, hole)
    light = brightness * lit
    depths_m = cv2.blur(light * hole[3], (5, 5)) / cv2.blur(light + face, (5, 5))
    image = pictures(patch, hole[None])[0]
    np.testing.assert_allclose(image, depths_m, atol=0.02 * hole[3])
    unweighted = pictures(replace(patch, brightness=0.0), hole[None])[0]
    assert np.abs(unweighted - depths_m).max() > 0.08 * hole[3]


@pytest.mark.parametrize("radius_mm", [3.2, 4.5, 9.0])
def test_a_filter_by_depth_weighs_deep_neighbours_less(radius_mm: float) -> None:
    """A bilateral filter over 5 x 5 pixels, written out: a neighbour whose depth differs by 40 mm
    has half of the weight."""
    patch = replace(blank_patch(sights=sight(CENTRE_M, PER_PX_M, np.zeros(3))[None]), half_m=40e-3)
    hole = np.array([18.3, 16.4, radius_mm * 1e-3, 33e-3, 0.0])
    lit, _ = pixels_of(patch, hole)
    pixels_m = np.pad(lit * hole[3], 2)
    windows_m = np.lib.stride_tricks.sliding_window_view(pixels_m, (5, 5))
    differences_m = windows_m - windows_m[..., 2:3, 2:3]
    weights = 2.0 ** -((differences_m / 40e-3) ** 2)
    depths_m = (weights * windows_m).sum(axis=(2, 3)) / weights.sum(axis=(2, 3))
    image = pictures(patch, hole[None])[0]
    np.testing.assert_allclose(image, depths_m, atol=0.05 * hole[3])
    # of what the weights change, the picture has nine tenths
    change_m = depths_m - pictures(replace(patch, half_m=np.inf), hole[None])[0]
    left_m = depths_m - image
    assert (left_m**2).sum() < 0.1 * (change_m**2).sum()


def test_a_sight_equals_the_one_by_pseudo_inverses() -> None:
    normal = np.cross(*PER_PX_M)
    normal /= np.copysign(np.linalg.norm(normal), normal @ CENTRE_M)
    ray = CENTRE_M / CENTRE_M[2]
    z = CENTRE_M[2]
    slopes = ((PER_PX_M - np.outer(PER_PX_M[:, 2], ray)) / z)[:, :2].T
    drift = np.linalg.pinv(slopes) @ (normal - normal[2] * ray)[:2] / z
    before = float(normal @ EMITTER_M) / float(normal @ CENTRE_M)
    beam = np.linalg.pinv(PER_PX_M.T) @ (EMITTER_M - CENTRE_M * before)
    height = normal @ CENTRE_M - normal @ EMITTER_M
    expected = [normal @ ray, *drift, normal[2] / z, *beam, height, 1.0]
    np.testing.assert_allclose(SIGHT, expected, rtol=1e-10)


def test_a_straight_sight_moves_deep_circles_along_the_normal() -> None:
    """A circle at the depth h along the normal n stands h (n_x, n_y) beside the mouth: so many
    pixels, of which one is per_px long."""
    result = straight_sight(PER_PX_M)
    normal = np.cross(*PER_PX_M) / np.linalg.norm(np.cross(*PER_PX_M))
    drift = result[1:3] @ PER_PX_M[:, :2]
    np.testing.assert_allclose(drift, normal[:2], rtol=1e-12)
    np.testing.assert_allclose(
        result[[0, 3, 4, 5, 6, 7]],
        [normal[2], 0, 0, 0, 1, 1],
        rtol=1e-12,
    )


# ---- fits


def square_of(patch: HolePatch, hole: np.ndarray, offset_m: float) -> float:
    """The sum of squares that is least."""
    residuals = (pictures(patch, hole[None])[0] + offset_m - patch.residual_m)[patch.used]
    prior = patch.prior_weight * (hole[4] - WALL_PRIOR[0])
    return float(residuals @ residuals + prior**2)


def draw(patch: HolePatch, hole: np.ndarray) -> np.ndarray:
    return pictures(patch, hole[None])[0]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("radius_mm", "depth_mm"),
    [
        (2.1, 12.7),
        (3.2, 6.0),
        (4.8, 33.0),
        (6.4, 3.0),
        (12.7, 12.7),
        (4.0, -5.0),
    ],
)
def test_a_fit_is_that_of_the_reference(radius_mm: float, depth_mm: float, seed: int) -> None:
    hole = np.array([18.3, 16.4, radius_mm * 1e-3, depth_mm * 1e-3, 0.6])
    patch = patch_of(hole, 1.5e-4, seed)
    start = (17.6, 16.9, 1.2e-3 * radius_mm, 0.7e-3 * depth_mm, 0.0)
    fit = fit_hole(patch, *start)
    expected, offset_m, converged = reference.fitted(patch, start, draw)
    assert fit.converged == converged
    fitted = np.array([fit.u_px, fit.v_px, fit.radius_m, fit.depth_m, fit.offset_m, fit.wall])
    error = np.sqrt(np.diag(fit.covariance))[:6]
    # the sum of squares has kinks where circles cross strips, so that descents end near its least,
    # not at one point
    assert (np.abs(fitted - [*expected[:4], offset_m, expected[4]]) < error).all()
    least = square_of(patch, expected, offset_m)
    assert square_of(patch, fitted[[0, 1, 2, 3, 5]], fit.offset_m) < 1.005 * least


def test_a_hopeless_start_is_told_and_not_looped_over() -> None:
    patch = patch_of(np.array([18.3, 16.4, 3e-3, 0.01, 0.6]), 1.5e-4, 0)
    flat = replace(patch, residual_m=np.where(patch.used, 1e-4, np.nan))
    fit = fit_hole(flat, 1000.0, -1000.0, 50.0, 0.1, 0.0)
    assert np.isfinite([fit.u_px, fit.v_px, fit.radius_m]).all()


# ---- stated errors


@pytest.mark.parametrize(
    "blur_px",
    [
        (5.0, 5.0),
        (3.0, 5.0),
        (1.0, 1.0),
    ],
)
def test_a_sandwich_is_that_of_the_dense_covariance(blur_px: tuple[float, float]) -> None:
    """Few pixels, of which the six parameters and the correlation of the noise leave half as
    degrees of freedom."""
    random = np.random.default_rng(3)
    patch = replace(blank_patch(shape=(9, 11), blur_px=blur_px), used=random.random((9, 11)) > 0.1)
    derivatives = random.standard_normal((6, int(patch.used.sum()))) * 1e-4
    expected = reference.sandwich(patch, derivatives, 3e-7)
    result = sandwich_covariance(patch, derivatives, 3e-7)
    np.testing.assert_allclose(result, expected, rtol=1e-9)


def test_a_sandwich_without_freedom_or_rank_is_not_a_number() -> None:
    patch = blank_patch(shape=(2, 3), blur_px=(1.0, 1.0))
    square = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 1e9])
    assert np.isnan(sandwich_covariance(patch, square, 1e-8)).all()
    assert np.isnan(sandwich_covariance(patch, np.zeros((6, 6)), 1e-8)).all()


# ---- their parts


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
        surface = rays * (0.7 + 2e-4 * u - 1e-4 * v)[..., None]
        points = rays * random.uniform(0.69, 0.71, u.shape)[..., None]
        by_u = (surface[4, 6] - surface[4, 4]) / 2
        by_v = (surface[5, 5] - surface[3, 5]) / 2
        expected = np.stack([by_u, by_v])
    finite = random.random(u.shape) > 0.3
    detection = np.zeros(u.shape, dtype=bool)
    detection[3:6, 4:7] = True
    plane = local_plane(points, surface[..., 2], finite, detection, projection)
    assert plane is not None
    np.testing.assert_allclose(plane[0], surface[4, 5], rtol=1e-10)
    np.testing.assert_allclose(plane[1], expected, rtol=1e-9, atol=1e-12)
