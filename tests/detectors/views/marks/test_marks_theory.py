"""The parts that marks rest on: the lattice's error, the plane under a mark, the target's own
colour."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy import stats

from detectors.views.marks.blobs import (
    CORE,
    CORE_SHRINKS,
    FALSE_RATE,
    GAUSSIAN_LIMITS,
    above_half,
    centroid_covariance_px2,
    chromaticity,
    region_covariance_px2,
    stand_out,
)
from detectors.views.marks.find import fit_patch
from harness.vocabulary.seeds import random_stream


def rectangle(
    length: float,
    breadth: float,
    turn_deg: float = 0.0,
) -> np.ndarray:
    turn = np.deg2rad(turn_deg)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2 * [length, breadth] @ axes


def lattice_within(polygon: np.ndarray) -> np.ndarray:
    reach = np.arange(-25, 26)
    points = (
        np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(-1, 2).astype(float)
    )
    edges = np.roll(polygon, -1, axis=0) - polygon
    arms = points[:, None] - polygon[None]
    return points[np.all(edges[:, 0] * arms[..., 1] - edges[:, 1] * arms[..., 0] >= 0, axis=1)]


def test_a_whole_number_of_pixels_shifts_by_up_to_half_a_pixel_and_a_half_one_by_a_quarter():
    # both ends of a whole length are rounded alike: uniform in +-1/2; of a half one they
    # alternate: uniform in +-1/4
    covariance = centroid_covariance_px2(rectangle(30.0, 9.5))
    assert covariance[0, 0] == pytest.approx(1 / 12, rel=0.01)
    assert covariance[1, 1] == pytest.approx(1 / 48, rel=0.1)
    assert covariance[0, 1] == pytest.approx(0.0, abs=1e-12)


def test_the_order_of_the_vertices_does_not_matter():
    polygon = rectangle(20.3, 7.7, 12.0)
    np.testing.assert_allclose(
        centroid_covariance_px2(polygon),
        centroid_covariance_px2(polygon[::-1]),
        rtol=1e-9,
    )


@pytest.mark.parametrize(
    ("length", "breadth", "turn"), [(28.3, 9.1, 1.0), (28.3, 9.1, 3.0), (14.2, 14.6, 45.0)]
)
def test_the_lattice_error_is_that_of_random_shifts(
    length,
    breadth,
    turn,
):
    rng = random_stream(1, "shifts", turn)
    polygon = rectangle(length, breadth, turn)
    shifts = rng.uniform(-0.5, 0.5, (1000, 2))
    errors = np.array([lattice_within(polygon + shift).mean(axis=0) - shift for shift in shifts])
    # a variance of 1000 bounded values is known to 4 %; the frequencies left out and the first
    # order cost 12 % more
    np.testing.assert_allclose(
        np.diag(centroid_covariance_px2(polygon)),
        errors.var(axis=0),
        rtol=0.15,
    )


@pytest.mark.parametrize(
    "turn",
    [pytest.param(0.0, marks=pytest.mark.slow), 3.0, pytest.param(10.0, marks=pytest.mark.slow)],
)
def test_a_region_known_by_its_pixels_alone_states_its_error_within_a_factor(turn):
    rng = random_stream(2, "regions", turn)
    errors = []
    stated = []
    for _ in range(200):
        size = np.array([28.0, 9.0]) + rng.uniform(0.0, 1.0, 2)
        shift = rng.uniform(-0.5, 0.5, 2)
        pixels = lattice_within(rectangle(*size, turn) + shift)
        errors.append(pixels.mean(axis=0) - shift)
        stated.append(np.diag(region_covariance_px2(pixels)))
    ratio = np.sqrt(np.mean(stated, axis=0) / np.mean(np.square(errors), axis=0))
    # a slope of one or two steps cannot be told from none, so the error may be stated twice too
    # large
    assert np.all((ratio > 1 / 1.5) & (ratio < 2.0)), ratio


def test_the_plane_under_a_mark_survives_a_hole_beside_it():
    rng = random_stream(3, "patch")
    x, y = rng.uniform(-0.03, 0.03, (2, 600))
    z = 0.7 + 0.3 * x - 0.2 * y + 2e-4 * rng.standard_normal(600)
    z[:150] += 0.03
    patch = fit_patch(np.stack([x, y, z], axis=1))
    assert patch is not None
    # slopes of 450 points over 17 mm rms are known to 0.2 / 17 / 21, here to four such deviations
    assert (patch.slope_x, patch.slope_y) == pytest.approx((0.3, -0.2), abs=2.5e-3)
    assert patch.sigma_m == pytest.approx(2e-4, rel=0.1)


def test_rays_meet_the_plane_along_themselves():
    ticks_m = [-0.01, 0.0, 0.01]
    x_m, y_m = np.meshgrid(ticks_m, ticks_m)
    z_m = 0.5 + 0.1 * x_m
    patch = fit_patch(np.column_stack([x_m.ravel(), y_m.ravel(), z_m.ravel()]))
    assert patch is not None
    point = np.array([[0.02, -0.01, 0.6]])
    central = patch.cut(point, "central")
    parallel = patch.cut(point, "parallel")
    np.testing.assert_allclose(central / central[0, 2], point / 0.6)
    np.testing.assert_allclose(patch.above_m(central), 0.0, atol=1e-9)
    np.testing.assert_allclose(parallel, [[0.02, -0.01, 0.502]], atol=1e-9)
    np.testing.assert_allclose(patch.normal, np.array([0.1, 0.0, -1.0]) / np.sqrt(1.01), atol=1e-9)


def test_points_on_a_line_or_too_few_give_no_plane():
    line = np.column_stack([np.linspace(0, 1, 50), np.linspace(0, 2, 50), np.ones(50)])
    assert fit_patch(line) is None
    assert fit_patch(line[:5]) is None


def wood(
    rng: np.random.Generator,
    noise: np.ndarray,
    pixels: int,
) -> tuple[np.ndarray, np.ndarray]:
    positions = rng.uniform(-1, 1, (pixels, 2))
    light = np.exp(0.5 * np.log(3.0) * positions[:, :1]) * np.array([1.0, 0.9, 0.7])
    # no channel is clipped: 98 * 1.73 * 1.5 = 254
    colours = (
        np.array([98.0, 75.0, 50.0]) * light * (1.0 + 0.15 * rng.standard_normal((pixels, 1)))
        + noise
    )
    return np.clip(np.rint(colours), 0, 255).astype(np.uint8), positions


@pytest.mark.parametrize(("tail", "factor"), [("gaussian", 30), ("laplace", 150)])
def test_as_many_of_the_targets_own_pixels_pass_as_stated(tail, factor):
    rng = random_stream(4, "false rate", tail)
    pixels = 100_000
    noise = 2.0 * (
        rng.standard_normal((pixels, 3))
        if tail == "gaussian"
        else rng.laplace(size=(pixels, 3)) / np.sqrt(2)
    )
    rgb, positions = wood(rng, noise, pixels)
    passed = (stand_out(*chromaticity(rgb), positions)[1] > 1.0).mean()
    assert passed < factor * FALSE_RATE


def test_shares_of_colours_and_their_rounding_by_hand():
    """Half a count is added to each channel; a count is uniform over a step of 1."""
    shares, variance = chromaticity(np.array([[0, 0, 0], [10, 20, 30]], np.uint8))
    assert shares == pytest.approx(np.array([[1 / 3, 1 / 3], [10.5 / 61.5, 30.5 / 61.5]]))
    assert variance == pytest.approx([1 / 12 / 1.5**2, 1 / 12 / 61.5**2])


def test_a_quarter_of_the_target_may_be_marked():
    rng = random_stream(5, "many marks")
    rgb, positions = wood(rng, 3.0 * rng.standard_normal((20_000, 3)), 20_000)
    marked = positions[:, 1] > 0.5
    rgb[marked] = (200, 30, 30)
    chosen = stand_out(*chromaticity(rgb), positions)[1] > 1.0
    assert chosen[marked].all()
    assert chosen[~marked].mean() < 30 * FALSE_RATE


def test_what_is_smeared_around_a_mark_is_not_of_it():
    contrast = np.zeros((40, 40))
    contrast[15:25, 15:25] = 20.0
    contrast[15:25, 25:30] = 8.0
    kept = above_half(contrast > 4.0, contrast)
    expected = np.zeros((40, 40), bool)
    expected[15:25, 15:25] = True
    np.testing.assert_array_equal(kept, expected)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_the_bulk_and_the_limit_are_those_of_a_gaussian(dimensions: int) -> None:
    """Squared distances are chi square; its innermost part has a smaller mean."""
    innermost = stats.chi2.ppf(CORE, dimensions)
    shrinks = stats.chi2.cdf(innermost, dimensions + 2) / CORE
    assert CORE_SHRINKS[dimensions] == pytest.approx(shrinks, rel=1e-3)
    limit = stats.chi.isf(FALSE_RATE, dimensions)
    assert GAUSSIAN_LIMITS[dimensions] == pytest.approx(limit, rel=1e-4)


@pytest.mark.parametrize("dimensions", [1, 2])
def test_the_contrast_is_in_deviations_and_the_margin_in_limits(dimensions: int) -> None:
    """Of correlated Gaussian colours over a bend of the light: squared contrasts are chi square,
    and the margin is their root over the limit. 4096 pixels tell a deviation to 2 %."""
    random = np.random.default_rng(6)
    xy = random.uniform(-1.0, 1.0, (40_000, 2))
    root = np.array([[0.02, 0.0], [0.015, 0.01]])[:dimensions, :dimensions]
    own_errors = random.standard_normal((40_000, dimensions)) @ root.T
    features = own_errors + 0.3 + 0.1 * xy[:, :1] - 0.2 * xy[:, :1] * xy[:, 1:]
    contrast, margin = stand_out(features, np.full(40_000, 1e-9), xy)
    for share in (0.25, 0.5, 0.9):
        expected = stats.chi.ppf(share, dimensions)
        assert np.quantile(contrast, share) == pytest.approx(expected, rel=0.05)
    ratio = margin / contrast
    np.testing.assert_allclose(ratio, ratio[0])
    # the tail's shape is extrapolated from quantiles, and never below the Gaussian's
    assert 0.7 / GAUSSIAN_LIMITS[dimensions] < ratio[0] <= 1.0001 / GAUSSIAN_LIMITS[dimensions]
    # where whole counts make four times the variance, twice the deviation is needed
    rounding = np.where(xy[:, 0] > 0.5, 4e-9, 1e-9)
    dark_contrast, dark_margin = stand_out(features, rounding, xy)
    dark = dark_contrast / dark_margin
    assert np.median(dark[xy[:, 0] > 0.5]) == pytest.approx(
        2.0 * np.median(dark[xy[:, 0] < 0.5]), rel=1e-9
    )


@pytest.mark.parametrize("kind", ["turned rectangle", "rectangle", "ellipse"])
def test_a_region_s_error_is_the_mean_over_outlines_and_shifts(kind: str) -> None:
    """Beside the points of the lattice within each outline, counted one by one: outlines of five
    sizes up to a pixel larger, turned by a third of a pixel over their length."""
    if kind == "ellipse":
        v, u = np.mgrid[-12:13, -12:13]
        pixels = np.stack([u, v], axis=-1)[(u / 11.3) ** 2 + (v / 6.2) ** 2 < 1].astype(float)
        outline = cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(float)
    else:
        turn_deg = 20.0 if kind == "turned rectangle" else 0.0
        pixels = lattice_within(rectangle(23.2, 8.4, turn_deg))
        middle, size, angle = cv2.minAreaRect(pixels.astype(np.float32))
        outline = cv2.boxPoints((middle, (size[0] + 1, size[1] + 1), angle)).astype(float)
    following = np.roll(outline, -1, axis=0)
    cross = outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]
    if cross.sum() < 0:
        outline = outline[::-1]
    area = abs(cross.sum()) / 2
    outline = outline * np.sqrt(len(pixels) / area)
    outline -= (outline.max(axis=0) + outline.min(axis=0)) / 2
    extent = np.ptp(outline, axis=0)
    errors = []
    for step in range(5):
        larger = 1.0 + np.array([step, 2 * step % 5]) / 5 / extent
        for turn in (-1 / 3, 0.0, 1 / 3):
            angle = turn / extent.max()
            axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            polygon = outline * larger @ axes
            ahead = np.roll(polygon, -1, axis=0)
            products = polygon[:, 0] * ahead[:, 1] - polygon[:, 1] * ahead[:, 0]
            centre = ((polygon + ahead) * products[:, None]).sum(axis=0) / (3 * products.sum())
            for across in range(0, 12, 3):
                for down in range(0, 12, 3):
                    shift = (np.array([across, down]) + 0.5) / 12
                    errors.append(lattice_within(polygon - centre + shift).mean(axis=0) - shift)
    # every third shift along each axis; all shifts differ from these by some per cent
    expected = np.mean(np.square(errors), axis=0)
    np.testing.assert_allclose(np.diag(region_covariance_px2(pixels)), expected, rtol=0.2)
