"""The numbers of a fused map against matrices and closed forms: means, variances, outliers, the
laws of noise and of differences between views."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from detectors.pixels.noise import rounding_left_m2
from detectors.rigid_motion import moved_by
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from detectors.views.mapping import fusion
from detectors.views.mapping.fusion import BetweenViews, combine, depth_noise
from detectors.views.mapping.placing import (
    LONGEST_EDGE,
    CellGrid,
    ChosenView,
    grid_over,
    place,
    raster_between,
)
from detectors.views.registration.registered import Registration
from harness.vocabulary.geometry import Cloud, Lens, Region, transform_points


@pytest.mark.parametrize("exponent", [1.0, 2.0])
@pytest.mark.parametrize("noise_share", [1.0, 0.4])
def test_a_mean_has_the_variance_of_its_weights_and_covariance(
    monkeypatch: pytest.MonkeyPatch, exponent: float, noise_share: float
) -> None:
    """Cell by cell with the whole covariance of the views that see it."""
    between = BetweenViews(2e-8, 5e-8, 3.0, exponent, noise_share)
    monkeypatch.setattr(fusion, "between_views", lambda *_: between)
    random = np.random.default_rng(1)
    shape = (3, 4, 5)
    sensor = random.uniform(1e-8, 9e-8, shape)
    explained = random.uniform(1e-8, 4e-8, shape)
    looks_px = random.uniform(0.0, 6.0, (*shape, 2))
    heights = 1e-4 * random.standard_normal(shape)
    heights[random.random(shape) < 0.3] = np.nan
    heights[:, 0, 0] = np.nan
    result = combine(heights, sensor, explained, looks_px, True, 2e-3)
    assert result.cell_m == 2e-3
    assert result.rejected == 0
    assert result.between is between
    np.testing.assert_array_equal(result.seen_by, np.isfinite(heights))
    for row, column in np.ndindex(4, 5):
        used = np.flatnonzero(np.isfinite(heights[:, row, column]))
        if not len(used):
            assert np.isnan(result.height_m[row, column])
            assert np.isnan(result.variance_m2[row, column])
            assert np.isnan(result.temporal_m2[row, column])
            assert not result.shares[:, row, column].any()
            continue
        temporal = noise_share * sensor[used, row, column]
        alone = temporal + explained[used, row, column] + between.own_m2
        weights = 1.0 / (alone + between.pattern_m2)
        weights /= weights.sum()
        looks = looks_px[used, row, column]
        apart_px = np.linalg.norm(looks[:, None] - looks[None], axis=-1)
        pattern = between.pattern_m2 * np.exp(-((apart_px / 3.0) ** exponent))
        covariance = np.diag(alone) + pattern
        cell = (row, column)
        assert result.height_m[cell] == pytest.approx(weights @ heights[used, row, column])
        assert result.variance_m2[cell] == pytest.approx(weights @ covariance @ weights)
        assert result.temporal_m2[cell] == pytest.approx(weights**2 @ temporal)
        np.testing.assert_allclose(result.shares[used, row, column], weights)


def test_noise_of_single_frames_is_the_part_of_the_law_that_views_do_not_share() -> None:
    """The law of single frames holds the pattern too: if views differ by a quarter of its
    variance, that is noise. Medians of 6000 squares are known to 3 %."""
    random = np.random.default_rng(2)
    sensor = np.full((2, 60, 100), 4e-8)
    heights = 1e-4 * random.standard_normal(sensor.shape)
    looks_px = np.zeros((*sensor.shape, 2))
    result = combine(heights, sensor, 0.0 * sensor, looks_px, False, 1e-3)
    share = result.between.noise_share
    assert share == pytest.approx(0.25, rel=0.1)
    np.testing.assert_allclose(result.temporal_m2, share * 4e-8 / 2)
    np.testing.assert_allclose(result.variance_m2, share * 4e-8 / 2)


@pytest.mark.parametrize("exponent", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("repeated", [True, False])
def test_differences_between_views_follow_their_variogram(exponent: float, repeated: bool) -> None:
    """Squares of differences that are the law's medians at each distance: as all rise with the
    distance, medians of classes lie on the law, and the fit is exact."""
    distances_px = np.geomspace(0.2, 40.0, 2000)
    length_px = np.geomspace(1.0, np.median(distances_px[-167:]), 24)[11]
    rise = 1.0 - np.exp(-((distances_px / length_px) ** exponent))
    half_square = 4e-8 * rise + 3e-8 + (1e-8 if repeated else 0.0)
    if repeated:
        sensor_m2, explained_m2 = 1.2e-8, 0.8e-8  # and 2e-8 of a view and cell's own
        noise_share = 1.0
    else:
        sensor_m2, explained_m2 = 5e-8, 0.5e-8
        noise_share = 0.5
    heights = np.zeros((2, 40, 50))
    median_square = 0.6744897501960817**2
    difference = np.sqrt(2.0 * half_square * median_square)
    heights[0] = (difference * np.where(np.arange(2000) % 3 == 0, -1.0, 1.0)).reshape(40, 50)
    looks_px = np.zeros((2, 40, 50, 2))
    looks_px[1, ..., 0] = 0.6 * distances_px.reshape(40, 50)
    looks_px[1, ..., 1] = -0.8 * distances_px.reshape(40, 50)
    ones = np.ones(heights.shape)
    law = fusion.between_views(heights, sensor_m2 * ones, explained_m2 * ones, looks_px, repeated)
    assert law.exponent == exponent
    assert law.length_px == pytest.approx(length_px, rel=0.01)
    assert law.pattern_m2 == pytest.approx(4e-8, rel=0.02)
    assert law.noise_share == pytest.approx(noise_share, rel=0.03)
    assert law.own_m2 == pytest.approx(2e-8 if repeated else 0.0, rel=0.03)


@pytest.mark.parametrize(("beyond_m2", "own_m2"), [(3e-8, 3e-8), (0.0, 0.0), (-1e-8, 0.0)])
def test_equal_differences_are_errors_of_each_view_and_cell(beyond_m2, own_m2) -> None:
    """Of four views; differences as small as their noise are none."""
    random = np.random.default_rng(9)
    noise_m2 = random.uniform(1e-8, 3e-8, (4, 30, 40))
    heights = np.sqrt(2e-8 + beyond_m2) * random.standard_normal((4, 30, 40))
    looks_px = random.uniform(0.0, 30.0, (4, 30, 40, 2))
    law = fusion.between_views(heights, 0.5 * noise_m2, 0.5 * noise_m2, looks_px, True)
    assert law.pattern_m2 == 0.0
    assert law.own_m2 == pytest.approx(own_m2, rel=0.15)


@pytest.mark.parametrize(("cells", "is_known"), [(99, False), (100, True)])
def test_a_hundred_pairs_are_needed(cells: int, is_known: bool) -> None:
    heights = np.full((2, 20, 30), np.nan)
    heights[0] = 0.0
    heights.reshape(2, -1)[1, :cells] = 1e-3
    ones = np.ones(heights.shape)
    looks_px = np.zeros((*heights.shape, 2))
    law = fusion.between_views(heights, 1e-9 * ones, 1e-9 * ones, looks_px, True)
    half_square = 0.5e-6 / 0.6744897501960817**2
    assert law.own_m2 == pytest.approx(half_square - 2e-9 if is_known else 0.0, rel=1e-4)


def test_outliers_stand_in_front_of_the_surface_or_behind_it_alone() -> None:
    """Five deviations of 0.1 mm from the median of at least three views: in front, only what is in
    front of the surface too; behind, only what differs from its neighbours as well."""
    variances = np.full((4, 9, 11), 1e-8)
    heights = np.zeros((4, 9, 11))
    heights[0, 1, 1] = -5.1e-4
    heights[0, 1, 3] = -4.9e-4
    heights[1, 1, 5] = 5.1e-4
    heights[1, 1, 7] = 4.9e-4
    heights[2, 4:7, 1:4] = 9e-4  # a patch: 5 or more of 9 neighbours, but at its corners
    heights[:, 6, 6] = 8e-4  # a hole, in front of whose floor one view sees a wall
    heights[3, 6, 6] = 1e-4
    heights[2:, 4, 8] = np.nan  # two views
    heights[0, 4, 8] = -9e-4
    heights[3, 7, 9] = np.nan  # three views
    heights[0, 7, 9] = -9e-4
    rejected = fusion._outliers(heights, variances)
    assert rejected[0, 1, 1]
    assert rejected[1, 1, 5]
    assert rejected[0, 7, 9]
    corners = [(4, 1), (4, 3), (6, 1), (6, 3)]
    assert all(rejected[2, row, column] for row, column in corners)
    assert rejected.sum() == 3 + len(corners)
    # a cell whose views scatter has a wider limit: 1.4826 medians of the deviations' sizes
    spread = np.zeros((5, 1, 1))
    for value, is_rejected in ((-7.3e-4, False), (-7.5e-4, True)):
        spread[:, 0, 0] = [-1e-4, 0.0, 1e-4, 1e-4, value]
        assert fusion._outliers(spread, np.full((5, 1, 1), 1e-12))[4, 0, 0] == is_rejected


def test_a_registration_s_variance_is_that_of_displacements_along_vectors() -> None:
    """The sum over independent motions of their squared displacements, in the reference frame."""
    random = np.random.default_rng(4)
    root = 1e-3 * random.standard_normal((6, 6))
    centre_m = random.normal(size=3)
    T = moved_by(random.normal(size=6), np.zeros(3))
    points = random.normal(size=(4, 5, 3))
    along = random.normal(size=(4, 5, 3))
    registration = Registration("v", "icp", np.eye(4), root @ root.T, centre_m)
    view: Any = SimpleNamespace(known_covariance=True, registration=registration)
    expected = np.zeros((4, 5))
    for motion in root.T:
        arm = transform_points(T, points) - centre_m
        displacement = np.cross(motion[:3], arm) + motion[3:]
        expected += ((displacement @ T[:3, :3]) * along).sum(axis=-1) ** 2
    result = fusion._registration_variance(view, points, along, T)
    np.testing.assert_allclose(result, expected, rtol=1e-9)
    view.known_covariance = False
    assert not fusion._registration_variance(view, points, along, T).any()


@pytest.mark.parametrize(("width_px", "expected"), [(1, 0.0), (2, 0.5), (4, 0.75)])
def test_the_correlation_of_neighbours_is_that_of_a_filter(width_px: int, expected: float) -> None:
    """A mean over squares so wide correlates neighbours by 1 - 1 / width; outliers count little."""
    random = np.random.default_rng(5)
    white = random.standard_normal((200 + width_px, 300 + width_px))
    deviation = np.zeros((200, 300))
    for down in range(width_px):
        for right in range(width_px):
            deviation += white[down : down + 200, right : right + 300]
    deviation += 7.0
    deviation[40:50, 40:60] += 50.0
    deviation[random.random(deviation.shape) < 0.01] = np.nan
    chosen = SimpleNamespace(cloud=SimpleNamespace(organised=True))
    view: Any = SimpleNamespace(chosen=chosen, deviation_m=deviation)
    assert fusion._neighbour_correlation(view) == pytest.approx(expected, abs=0.06)
    constant: Any = SimpleNamespace(chosen=chosen, deviation_m=0.0 * deviation)
    assert fusion._neighbour_correlation(constant) == 1.0
    chosen.cloud.organised = False
    assert fusion._neighbour_correlation(view) == 1.0


LENS = Lens(200, 150, 300.0, 300.0, 99.5, 74.5)
SLOPES = LENS.region_slopes(LENS.whole)


def averaged(z_m: np.ndarray, sigma_m: np.ndarray, count: np.ndarray, seed: int = 6) -> Cloud:
    """A cloud whose samples scatter by ``sigma_m``."""
    random = np.random.default_rng(seed)
    freedom = np.maximum(count - 1, 1)
    scatter = sigma_m**2 * random.chisquare(freedom) / freedom
    return Cloud(
        points_m=np.concatenate([SLOPES * z_m[..., None], z_m[..., None]], axis=-1),
        reason=np.zeros(z_m.shape, np.uint8),
        count=count,
        variance_m2=np.where(count > 1, scatter, np.nan),
        region=LENS.whole,
        z_step_m=0.0,
        n_frames=int(count.max()),
        lens=LENS,
    )


ROWS = np.linspace(0.0, 1.0, 150)[:, None]
COLUMNS = np.linspace(0.0, 1.0, 200)[None]
INSIDE = np.ones((150, 200), bool)
INSIDE[:, :60] = False
COUNT = np.where(COLUMNS < 0.5, 6, 20) + 0 * ROWS.astype(int)


def test_the_noise_of_depth_follows_the_amplitude() -> None:
    """v = k / amplitude^2 + c over the number of samples: 21,000 variances, of which some are spoiled
    by damage, tell it to some per cent."""
    amplitude = 60.0 + 540.0 * ROWS + 0.0 * COLUMNS
    sigma_m = np.sqrt((0.06 / amplitude) ** 2 + 1e-4**2)
    cloud = replace(averaged(0.8 + 0 * amplitude, sigma_m, COUNT), amplitude=amplitude)
    spoiled = cloud.variance_m2.copy()
    spoiled[:, 100:110] *= 400.0
    spoiled[:, :60] *= 50.0  # not of the target
    cloud = replace(cloud, variance_m2=spoiled)
    variance, repeated = depth_noise(cloud, INSIDE, np.full(amplitude.shape, np.nan))
    assert repeated
    np.testing.assert_allclose(variance, sigma_m**2 / COUNT, rtol=0.12)
    # pixels without an amplitude count like the median one; with a tenth of them it is no measure
    few_dark = np.where(np.arange(200) < 15, 0.0, amplitude)
    variance, _ = depth_noise(replace(cloud, amplitude=few_dark), INSIDE, amplitude * np.nan)
    typical = np.median(sigma_m**2)
    assert variance[40, 5] * COUNT[40, 5] == pytest.approx(typical, rel=0.15)
    gappy = np.where(np.arange(200) < 25, np.nan, amplitude)
    without, _ = depth_noise(replace(cloud, amplitude=gappy), INSIDE, amplitude * np.nan)
    plain, _ = depth_noise(replace(cloud, amplitude=None), INSIDE, amplitude * np.nan)
    np.testing.assert_array_equal(without, plain)


def test_the_noise_of_depth_without_amplitude_follows_the_range() -> None:
    """To the fourth power of the range."""
    z_m = 0.5 + 1.0 * ROWS + 0.0 * COLUMNS
    range2 = z_m**2 * (1.0 + (SLOPES**2).sum(axis=-1))
    sigma_m = np.sqrt((4e-4 * range2) ** 2 + 2e-4**2)
    cloud = averaged(z_m, sigma_m, COUNT)
    variance, repeated = depth_noise(cloud, INSIDE, np.full(z_m.shape, np.nan))
    assert repeated
    np.testing.assert_allclose(variance, sigma_m**2 / COUNT, rtol=0.12)


def test_single_frames_have_the_noise_of_their_roughness() -> None:
    z_m = 0.5 + 1.0 * ROWS + 0.0 * COLUMNS
    range2 = z_m**2 * (1.0 + (SLOPES**2).sum(axis=-1))
    sigma_m = np.sqrt((4e-4 * range2) ** 2 + 2e-4**2)
    ones = np.ones(z_m.shape, int)
    cloud = averaged(z_m, sigma_m, ones)
    rough = sigma_m * np.random.default_rng(7).standard_normal(z_m.shape)
    rough[:30, :40] = np.nan
    variance, repeated = depth_noise(cloud, INSIDE, rough)
    assert not repeated
    np.testing.assert_allclose(variance, sigma_m**2, rtol=0.15)
    # 39 pixels with several samples do not make repeated frames, 40 do
    for pixels in (39, 40):
        count = ones.copy()
        count[100, 80 : 80 + pixels] = 5
        _, repeated = depth_noise(averaged(z_m, sigma_m, count), INSIDE, rough)
        assert repeated == (pixels == 40)


def test_the_mean_of_rounded_distances_keeps_an_error_of_rounding() -> None:
    """Frames that scatter by q / sqrt 12 or less, and such that scatter by 0.4 q more."""
    step_m = 1e-3
    ones = np.ones((150, 200))
    counts = np.full((150, 200), 400)
    for dither_m in (0.0, 0.4e-3):
        sigma_m = np.sqrt(step_m**2 / 12.0 + dither_m**2) * ones
        cloud = replace(averaged(0.8 * ones, sigma_m, counts), z_step_m=step_m)
        variance, _ = depth_noise(cloud, INSIDE, np.full(counts.shape, np.nan))
        left_m2 = rounding_left_m2(step_m, dither_m**2)
        expected = sigma_m[0, 0] ** 2 / 400 + left_m2
        assert float(np.median(variance)) == pytest.approx(expected, rel=0.03)
    assert rounding_left_m2(step_m, 0.0) == pytest.approx(step_m**2 / 12.0, rel=0.01)


# --- cells and places ---


@pytest.mark.parametrize("organised", [True, False])
@pytest.mark.parametrize("parts", [1, 2, 3])
def test_cells_hold_the_mean_of_their_parts(organised: bool, parts: int) -> None:
    """A linear function of unevenly spaced samples is exact in the middle of a cell of several
    spacings; a cell is unknown if less than half of it is covered."""
    random = np.random.default_rng(10)
    v, u = np.mgrid[:16, :21].astype(float)
    positions = np.stack([u, v], axis=-1) + 0.1 * random.standard_normal((16, 21, 2))
    positions[[0, -1]] = np.stack([u, v], axis=-1)[[0, -1]]
    positions[:, [0, -1]] = np.stack([u, v], axis=-1)[:, [0, -1]]
    values = 5.0 + 2.0 * positions[..., 0] - 3.0 * positions[..., 1]
    # cells from -2 on: the samples begin in the middle of a cell or between two
    grid = CellGrid(-2.0, -1.0, float(parts), (20 // parts, 26 // parts))
    if not organised:
        positions = positions.reshape(1, -1, 2)
    raster = raster_between(positions, np.ones(positions.shape[:2], bool), organised, 1.0, grid)
    result = raster.at_cells(values.ravel())
    x, y = grid.places()
    is_known = np.zeros(grid.shape, bool)
    for row, column in np.ndindex(*grid.shape):
        offsets = np.arange(parts) - (parts - 1) / 2
        part_x = x[row, column] + offsets
        part_y = y[row, column] + offsets
        inside = ((part_x >= 0) & (part_x <= 20))[None] & ((part_y >= 0) & (part_y <= 15))[:, None]
        is_known[row, column] = 2 * inside.sum() >= parts**2
        if inside.all():
            expected = 5.0 + 2.0 * x[row, column] - 3.0 * y[row, column]
            assert result[row, column] == pytest.approx(expected, abs=1e-9)
    np.testing.assert_array_equal(np.isfinite(result), is_known)
    assert is_known.any()
    assert not is_known.all()
    sums = np.asarray(raster.weights.sum(axis=1)).reshape(grid.shape)
    np.testing.assert_allclose(sums[is_known], 1.0)
    squares = np.asarray((raster.weights.toarray() ** 2).sum(axis=1)).reshape(grid.shape)
    np.testing.assert_allclose(raster.concentration, squares)


def test_triangles_without_a_grid_do_not_cross_a_gap() -> None:
    """Edges, diagonals included, of more than four times the median."""
    v, u = np.mgrid[:12, :12].astype(float)
    diagonal = np.sqrt(LONGEST_EDGE**2 - 1.0)
    for gap, is_crossed in ((diagonal - 0.05, True), (LONGEST_EDGE + 0.05, False)):
        moved = np.where(u > 5, u + gap - 1.0, u)
        positions = np.stack([moved, v], axis=-1).reshape(1, -1, 2)
        grid = CellGrid(7.0, 3.0, 1.0, (3, 1))
        raster = raster_between(positions, np.ones((1, 144), bool), False, 1.0, grid)
        assert np.isfinite(raster.at_cells(np.ones(144))).all() == is_crossed


def chosen(slope: float, fx: float, fy: float, organised: bool = True) -> ChosenView:
    """A plane z = 0.9 + slope x through a lens."""
    lens = Lens(61, 41, fx, fy, 30.0, 20.0)
    slopes = lens.region_slopes(lens.whole)
    z_m = 0.9 / (1.0 - slope * slopes[..., 0])
    points = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    inside = np.ones(z_m.shape, bool)
    inside[:5] = False
    if not organised:
        points = points.reshape(1, -1, 3)
        inside = inside.reshape(1, -1)
    flat = np.zeros(inside.shape, np.uint8)
    cloud = Cloud(
        points_m=points,
        reason=flat,
        count=flat + 1,
        variance_m2=np.full(inside.shape, np.nan),
        region=Region(0, inside.shape[0], 0, inside.shape[1]),
        z_step_m=0.0,
        n_frames=1,
        organised=organised,
        lens=lens,
    )
    return ChosenView("v", cloud, inside, Registration("v", "icp", np.eye(4)))


def test_the_step_of_slopes_is_the_median_of_both_axes() -> None:
    assert chosen(0.3, 400.0, 400.0).slope_step == pytest.approx(1 / 400.0)
    # 60 steps in each of 36 rows, 35 in each of 61 columns: slightly more along rows
    assert chosen(0.0, 300.0, 500.0).slope_step == pytest.approx(1 / 300.0)
    # without a grid, as many points on squares
    free = chosen(0.0, 300.0, 500.0, organised=False).slope_step
    assert free == pytest.approx(np.sqrt(60 / 300.0 * 35 / 500.0 / (61 * 36)))


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_pixels_are_placed_where_their_rays_meet_the_surface(slope: float) -> None:
    """A view of points 3 mm behind a plane, along their rays; and the sizes of its pixels."""
    view = chosen(slope, 300.0, 500.0)
    x, y, z = view.cloud.points_m[view.inside].T
    surface = fit_surface(x, y, z, SurfaceConfig(degree=1, method="least_squares"))
    behind = view.cloud.points_m * (1.0 + 0.003 / view.cloud.points_m[..., 2:])
    shifted = replace(view, cloud=replace(view.cloud, points_m=behind))
    placed = place(shifted, np.eye(4), surface)
    expected = view.cloud.points_m[..., :2]
    np.testing.assert_allclose(placed.places_m[view.inside], expected[view.inside], atol=2e-6)
    off_m = behind[..., 2] - (0.9 + slope * behind[..., 0])
    np.testing.assert_allclose(placed.deviation_m[view.inside], off_m[view.inside], atol=1e-9)
    assert np.isnan(placed.deviation_m[~view.inside]).all()
    assert np.isnan(placed.places_m[~view.inside]).all()
    by_u = expected[6:, 1:] - expected[6:, :-1]
    by_v = expected[6:, :-1] - expected[5:-1, :-1]
    sides = np.sqrt(np.median(by_u**2, axis=(0, 1)) + np.median(by_v**2, axis=(0, 1)))
    np.testing.assert_allclose(placed.pixel_m, sides, rtol=0.01)
    area = np.median(by_u[..., 0] * by_v[..., 1] - by_u[..., 1] * by_v[..., 0])
    assert placed.pitch_m == pytest.approx(np.sqrt(area), rel=0.01)
    if slope == 0.0:
        np.testing.assert_allclose(placed.pixel_m, [0.9 / 300.0, 0.9 / 500.0], rtol=1e-6)
    # cells at whole multiples of their side, from the first within to the last
    for cell_m in (None, 0.0137):
        grid = grid_over([placed], cell_m)
        step = placed.pitch_m if cell_m is None else cell_m
        assert grid.step == step
        low = expected[view.inside].min(axis=0)
        high = expected[view.inside].max(axis=0)
        x, y = grid.places()
        for axis, values in ((0, x), (1, y)):
            multiples = values / step
            np.testing.assert_allclose(multiples, np.rint(multiples), atol=1e-6)
            assert low[axis] - 1e-6 <= values.min() < low[axis] + step
            assert high[axis] - step < values.max() <= high[axis] + 1e-6
