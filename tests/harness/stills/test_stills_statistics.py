"""Statistics of stacks of static frames against closed forms, enumeration and planted values."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage, stats

from harness.stills.statistics import (
    MOST_PLANES,
    _best_candidate,
    _distance_m,
    _with_ones,
    correlation,
    correlation_at,
    covariance,
    deviations,
    edge_widths,
    find_planes,
    fit_plane,
    fixed_pattern,
    jackknifed,
    mean_of,
    often_valid,
    on_surface_tolerance_m,
    robust_inverse_fit,
    share_of,
    temporal_sigma_m,
)
from scenes.closed_form import Plane

# ---- temporal noise


def white(frames: int, shape: tuple[int, int], sigma: float, seed: int = 3) -> np.ndarray:
    return 1.0 + sigma * np.random.default_rng(seed).standard_normal((frames, *shape))


def test_deviation_of_white_noise_and_of_nothing():
    """4,000 values of 3,800 degrees of freedom: the deviation is known to 1.2 %, asserted at four
    of that."""
    z = white(20, (20, 10), 2e-3)
    everywhere = np.ones((20, 10), bool)
    assert temporal_sigma_m(z, everywhere) == pytest.approx(2e-3, rel=0.05)
    assert np.isnan(temporal_sigma_m(z, ~everywhere))


def test_pixels_valid_in_less_than_half_of_the_frames_do_not_count():
    z = np.array([[[1.0, 5.0]], [[3.0, np.nan]], [[np.nan, np.nan]], [[np.nan, np.nan]]])
    # the first pixel's two values have variance 2 (n - 1); the second has one value of four
    assert temporal_sigma_m(z, np.ones((1, 2), bool)) == pytest.approx(np.sqrt(2))


@pytest.mark.parametrize(("lag_x", "lag_y"), [(1, 0), (0, 3), (1, 1), (5, 0)])
def test_correlation_of_a_boxed_field_is_the_overlap_of_the_boxes(lag_x, lag_y):
    """(5 - |dx|)(5 - |dy|) / 25; 60 frames of 100 x 100 pixels have 24,000 boxes: 0.02 is three
    deviations."""
    z = ndimage.uniform_filter(white(60, (100, 100), 1.0), (1, 5, 5), mode="wrap")
    expected = max(5 - lag_x, 0) * max(5 - lag_y, 0) / 25
    assert correlation_at(z, np.ones((100, 100), bool), lag_x, lag_y) == pytest.approx(
        expected, abs=0.02
    )


def test_jackknife_interval_covers_as_stated():
    """200 captures: 95 % coverage fails this binomial test with probability below 1e-4 on either
    side."""
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(200):
        # all pixels share half of the variance, so an interval from independent pixels would be
        # far too narrow
        z = rng.standard_normal((30, 4, 4)) + rng.standard_normal((30, 1, 1))
        reading = jackknifed(z, lambda s: temporal_sigma_m(s, np.ones((4, 4), bool)))
        hits += reading.interval.low <= np.sqrt(2) <= reading.interval.high
    low, high = stats.binom.ppf([1e-4, 1 - 1e-4], 200, 0.95)
    assert low <= hits <= high


def test_estimates_without_repeats_have_no_interval():
    assert not jackknifed(np.ones((3, 2)), lambda s: float(s.mean())).interval.known
    assert not mean_of([2.0]).interval.known
    assert np.isnan(mean_of([np.nan]).value)
    assert share_of(np.ones((4, 5, 5), bool), 25.0).interval.high == 1.0
    # 100 pixels, 25 of which count as one: Wilson for 4 of 4
    assert share_of(np.ones((4, 5, 5), bool), 25.0).interval.low == pytest.approx(
        4 / (4 + 1.959964**2)
    )


# ---- edges


def ideal_step(step: float = 0.1, columns: int = 40) -> tuple[np.ndarray, ...]:
    """A stack (3, 10, columns) with the edge between the middle columns, both surfaces' z, and
    signed distances."""
    from_edge = np.tile(np.arange(columns) - columns / 2 + 0.5, (10, 1))
    front = np.full(from_edge.shape, 1.0)
    back = np.full(from_edge.shape, 1.0 + step)
    z = np.repeat(np.where(from_edge < 0, front, back)[None], 3, axis=0)
    return z, front, back, from_edge


def test_an_ideal_step_has_no_gap_and_no_flying_pixel():
    z, front, back, from_edge = ideal_step()
    widths = edge_widths(z, front, back, from_edge, 0.01, 15, across=2)
    for width in widths.values():
        assert width.tolist() == [0, 0, 0]


def test_widths_by_hand():
    """Two columns of the back vanish, one of the front flies, and half of the lines lose another
    pixel."""
    z, front, back, from_edge = ideal_step()
    z[:, :, 20:22] = np.nan
    z[:, :, 19] = 1.05
    z[:, :5, 18] = np.nan
    widths = edge_widths(z, front, back, from_edge, 0.01, 15, across=2)
    wanted = {"gap": 2.5, "flying": 1.0, "with_flying": 1.0}
    assert {name: width.tolist() for name, width in widths.items()} == {
        name: [v] * 3 for name, v in wanted.items()
    }
    # the same image turned by 90 degrees, and an edge zone that ends before column 18
    turned = [np.swapaxes(z, 1, 2), front.T, back.T, from_edge.T]
    across_rows = edge_widths(*turned, 0.01, 15, across=1)  # type: ignore[misc]
    assert {name: width[0] for name, width in across_rows.items()} == wanted
    edge_m = edge_widths(z, front, back, from_edge, 0.01, 1.0, across=2)
    assert {name: width[0] for name, width in edge_m.items()} == {**wanted, "gap": 1.0}
    assert edge_widths(z, front, back, from_edge, np.nan, 15, across=2)["gap"][0] == 2.5


def test_a_front_pixel_that_shows_the_back_does_not_fly():
    z, front, back, from_edge = ideal_step()
    z[:, :, 19] = 1.1
    widths = edge_widths(z, front, back, from_edge, 0.01, 15, across=2)
    assert [width[0] for width in widths.values()] == [0, 0, 0]


@given(st.floats(1e-5, 1e-2), st.floats(1e-3, 1.0))
@settings(max_examples=30, deadline=None)
def test_surfaces_that_noise_makes_one_are_not_told_apart(sigma_m, step_m):
    """Ranges within four deviations, a tenth of the step and half a millimetre are on a surface."""
    tolerance_m = on_surface_tolerance_m(sigma_m, step_m)
    widest_m = max(4 * sigma_m, 0.1 * step_m, 0.5e-3)
    is_hidden = widest_m > 0.45 * step_m
    assert np.isnan(tolerance_m) == is_hidden
    if is_hidden:
        z, front, back, from_edge = ideal_step()
        widths = edge_widths(z, front, back, from_edge, tolerance_m, 15, 2)
        assert np.isnan(widths["flying"]).all()
    else:
        assert tolerance_m == widest_m


# ---- planes


def two_walls(noise_m: float = 1e-3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z and slopes of a near board before a tilted wall, and where the board is."""
    y, x = np.mgrid[-0.3:0.3:150j, -0.4:0.4:200j]
    slopes = np.stack([x, y], axis=-1)
    board = (np.abs(x) < 0.15) & (np.abs(y) < 0.2)
    z = np.where(
        board, Plane(0.9, 0.1, 0.05).z_along_m(slopes), Plane(1.6, -0.4, 0.0).z_along_m(slopes)
    )
    return z + noise_m * np.random.default_rng(2).standard_normal(z.shape), slopes, board


def test_two_planes_are_found_with_their_pixels():
    """1 mm of noise over thousands of pixels: the distance is known to 0.1 mm."""
    z, slopes, board = two_walls()
    z[:5] = np.nan
    planes = find_planes(z, slopes, 8e-3, least_px=1000)
    assert len(planes) == 2
    (wall, _), (front, on_board) = planes
    assert (wall.distance_m, wall.slope_x) == pytest.approx((1.6, -0.4), abs=1e-3)
    assert (front.distance_m, front.slope_x) == pytest.approx((0.9, 0.1), abs=1e-3)
    assert (on_board == board)[5:].mean() > 0.999
    again = find_planes(z, slopes, 8e-3, least_px=1000)
    assert all((first[1] == second[1]).all() for first, second in zip(planes, again, strict=True))


def test_no_plane_in_a_ball_nor_in_nothing():
    y, x = np.mgrid[-0.3:0.3:90j, -0.3:0.3:90j]
    slopes = np.stack([x, y], axis=-1)
    ball = 1.0 - np.sqrt(0.3**2 - np.minimum(x**2 + y**2, 0.08))
    assert find_planes(ball, slopes, 1e-3, least_px=4000) == []
    assert find_planes(np.full(ball.shape, np.nan), slopes, 1e-3, least_px=100) == []


@given(st.floats(0.3, 5.0), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
@settings(max_examples=20, deadline=None)
def test_a_plane_is_fitted_exactly(distance_m, slope_x, slope_y):
    y, x = np.mgrid[-0.2:0.2:12j, -0.2:0.2:14j]
    slopes = np.stack([x.ravel(), y.ravel()], axis=-1)
    plane = fit_plane(Plane(distance_m, slope_x, slope_y).z_along_m(slopes), slopes)
    assert (plane.distance_m, plane.slope_x, plane.slope_y) == pytest.approx(
        (distance_m, slope_x, slope_y), abs=1e-7
    )


def test_covariance_and_correlation_by_hand():
    d = np.array([[[1.0, 2.0, 0.0], [3.0, -1.0, 5.0]]])
    where = np.array([[True, True, False], [True, True, True]])
    # along x: pairs (1, 2), (3, -1), (-1, 5); along y: (1, 3), (2, -1)
    assert covariance(d, where, 1, 0) == pytest.approx(
        ((2 - 3 - 5) / 3, ((1 + 9 + 1) / 3 + (4 + 1 + 25) / 3) / 2)
    )
    assert covariance(d, where, 0, 1) == pytest.approx(
        ((3 - 2) / 2, ((1 + 4) / 2 + (9 + 1) / 2) / 2)
    )
    assert correlation(d, where, 1, 0) == pytest.approx(-2 / (41 / 6))
    assert correlation(d, where, 0, 1) == pytest.approx(0.5 / 3.75)


def test_common_jitter_is_taken_off_only_on_request():
    rng = np.random.default_rng(1)
    z = rng.standard_normal((30, 1, 1)) + 0 * rng.standard_normal((30, 8, 9))
    where = np.ones((8, 9), bool)
    assert deviations(z, where, keep_jitter=True).std() == pytest.approx(z[:, 0, 0].std())
    assert np.abs(deviations(z, where, keep_jitter=False)).max() < 1e-12


# ---- intervals


@pytest.mark.parametrize(("frames", "groups"), [(4, 2), (8, 4), (40, 10), (100, 10)])
def test_the_jackknife_of_a_mean_is_the_scatter_of_the_groups_means(
    frames: int, groups: int
) -> None:
    """Of a mean, the delete-a-group jackknife is the standard error of the means of equal groups,
    every so many frames one."""
    values = np.random.default_rng(1).normal(3.0, 1.0, frames)
    means = [values[group::groups].mean() for group in range(groups)]
    error = np.std(means, ddof=1) / np.sqrt(groups)
    half = stats.t.ppf(0.975, groups - 1) * error
    reading = jackknifed(values, lambda part: float(part.mean()))
    assert reading.value == pytest.approx(values.mean())
    assert reading.interval.low == pytest.approx(values.mean() - half)
    assert reading.interval.high == pytest.approx(values.mean() + half)


def test_a_jackknife_without_a_number_has_no_interval() -> None:
    nothing = jackknifed(np.ones(8), lambda part: float("nan"))
    assert np.isnan(nothing.value)
    assert not nothing.interval.known
    only_whole = jackknifed(np.ones(8), lambda part: 2.0 if len(part) == 8 else float("nan"))
    assert only_whole.value == 2.0
    assert not only_whole.interval.known


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_too_few_frames_are_not_divided(frames: int) -> None:
    """A statistic is never asked for the value of no frame."""

    def mean(part: np.ndarray) -> float:
        assert len(part) == frames
        return float(part.mean())

    reading = jackknifed(np.arange(1.0, 1.0 + frames), mean)
    assert reading.value == (1.0 + frames) / 2
    assert not reading.interval.known


def test_the_interval_of_a_mean_is_students() -> None:
    values = np.array([2.0, 3.5, np.nan, 5.0, 4.0])
    reading = mean_of(values)
    low, high = stats.t.interval(
        0.95, 3, values[[0, 1, 3, 4]].mean(), stats.sem(values[[0, 1, 3, 4]])
    )
    assert reading.value == pytest.approx(3.625)
    assert (reading.interval.low, reading.interval.high) == pytest.approx((low, high))
    assert mean_of([2.0]).value == 2.0


def test_the_interval_of_a_share_is_wilsons() -> None:
    """30 of 200 pixels, of which four count as one: 7.5 of 50."""
    hits = np.arange(200) < 30
    reading = share_of(hits, 4.0)
    expected = stats.binomtest(15, 100).proportion_ci(method="wilson")
    wide = share_of(hits, 2.0)
    assert reading.value == wide.value == 0.15
    assert (wide.interval.low, wide.interval.high) == pytest.approx((expected.low, expected.high))
    assert reading.interval.low < wide.interval.low
    assert reading.interval.high > wide.interval.high


# ---- pixels that count


@pytest.mark.parametrize(("frames", "least"), [(2, 2), (3, 2), (4, 2), (5, 3), (8, 4)])
def test_a_pixel_counts_with_half_of_the_frames_and_two(frames: int, least: int) -> None:
    ranges = np.arange(frames + 1)
    z = np.where(np.arange(frames)[:, None] < ranges, 1.0, np.nan)[:, None, :]
    assert often_valid(z, True)[0].tolist() == (ranges >= least).tolist()
    where = (ranges != frames)[None]
    assert often_valid(z, where)[0].tolist() == ((ranges >= least) & (ranges != frames)).tolist()


def test_deviations_by_hand() -> None:
    """Two pixels that count and one that does not, in three frames."""
    z = np.array([[[1.0, 5.0, 9.0]], [[2.0, 7.0, np.nan]], [[6.0, np.nan, np.nan]]])
    kept = deviations(z, True, keep_jitter=True)
    assert kept[:, 0, 0].tolist() == [-2.0, -1.0, 3.0]
    assert kept[:2, 0, 1].tolist() == [-1.0, 1.0]
    assert np.isnan(kept[2, 0, 1])
    assert kept[:, 0, 2].tolist() == [0.0, 0.0, 0.0]
    without = deviations(z, True, keep_jitter=False)
    assert without[:, 0, 0].tolist() == [-0.5, -1.0, 0.0]
    assert without[:2, 0, 1].tolist() == [0.5, 1.0]
    assert without[:, 0, 2].tolist() == [0.0, 0.0, 0.0]


def test_covariance_of_diagonal_neighbours_in_several_frames_by_hand() -> None:
    d = np.array([[[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], [[7.0, 8.0], [9.0, np.nan], [1.0, -2.0]]])
    everywhere = np.ones((3, 2), bool)
    product, square = covariance(d, everywhere, 1, 1)
    # pairs (1, 4), (3, 6) and, as the other frame lacks one, (9, -2)
    assert product == pytest.approx((4 + 18 - 18) / 3)
    assert square == pytest.approx(((1 + 9 + 81) / 3 + (16 + 36 + 4) / 3) / 2)
    assert np.isnan(covariance(d, everywhere, 0, 2 + 1)).all()
    assert np.isnan(correlation(0 * d, everywhere, 1, 0))


def inverse_of(plane: Plane) -> np.ndarray:
    """Coefficients of 1/z = (1 - sx X - sy Y) / d."""
    return np.array([1.0, -plane.slope_x, -plane.slope_y]) / plane.distance_m


def grid(rows: int, columns: int, half: float = 0.3) -> np.ndarray:
    """Slopes (rows, columns, 2) of evenly spaced rays."""
    y = np.linspace(-half, half, rows)
    x = np.linspace(-half, half, columns)
    return np.stack(np.meshgrid(x, y), axis=-1)


def test_the_robust_fit_solves_tukeys_equation() -> None:
    """The weights (1 - u^2)^2 at the fit's residuals, with u in 4.685 robust deviations, make the
    errors of z orthogonal to the basis; a fifth of the points are outliers."""
    rng = np.random.default_rng(5)
    slopes = rng.uniform(-0.4, 0.4, (500, 2))
    z = Plane(1.2, 0.5, -0.3).z_along_m(slopes) + 2e-3 * rng.standard_normal(500)
    z[:100] += rng.uniform(0.005, 0.2, 100)
    basis = _with_ones(slopes)
    coefficients, counts = robust_inverse_fit(basis, z)
    residual = z - 1 / (basis @ coefficients)
    u = residual / (4.685 * 1.4826 * np.median(np.abs(residual)))
    weight = np.where(np.abs(u) < 1, (1 - u**2) ** 2, 0.0)
    assert counts.tolist() == (np.abs(u) < 1).tolist()
    row = weight * z**4
    expected = np.linalg.solve(basis.T @ (row[:, None] * basis), basis.T @ (row / z))
    assert coefficients == pytest.approx(expected, rel=1e-5)
    plain = np.linalg.lstsq(basis, 1 / z, rcond=None)[0]
    assert np.abs(plain / coefficients - 1).max() > 1e-3


def test_of_exact_data_points_within_micrometres_count() -> None:
    slopes = grid(10, 12).reshape(-1, 2)
    z = Plane(1.0).z_along_m(slopes)
    z[3] += 4.6e-6
    z[70] -= 4.8e-6
    _, counts = robust_inverse_fit(_with_ones(slopes), z)
    assert np.flatnonzero(~counts).tolist() == [70]


def test_the_distance_from_a_plane_is_along_its_normal() -> None:
    plane = Plane(1.5, 0.4, -0.2)
    slopes = np.array([[0.1, 0.2], [-0.3, 0.1], [0.0, 0.0], [0.2, 0.2]])
    z = plane.z_along_m(slopes) + np.array([0.02, -0.03, 0.0, np.nan])
    points = _with_ones(slopes)[:, [1, 2, 0]] * z[:, None]
    normal = np.array([plane.slope_x, plane.slope_y, -1.0])
    off = np.abs(points @ normal + plane.distance_m) / np.linalg.norm(normal)
    distance = _distance_m(inverse_of(plane), _with_ones(slopes), z)
    assert distance[:3] == pytest.approx(off[:3], abs=1e-12)
    assert distance[3] == np.inf


def test_the_best_tried_plane_is_that_of_most_points() -> None:
    """Three fifths of the pixels lie on one of two walls, in random places."""
    slopes = grid(60, 80)
    walls = (Plane(1.0, 0.2), Plane(1.4, -0.1, 0.3))
    on_first = np.random.default_rng(2).random((60, 80)) < 0.6
    z = np.where(on_first, walls[0].z_along_m(slopes), walls[1].z_along_m(slopes))
    z[:, :10] = np.nan
    for number in range(3):
        free = np.isfinite(z)
        best = _best_candidate(z, _with_ones(slopes), free, 1e-3, number)
        assert best == pytest.approx(inverse_of(walls[0]), abs=1e-9)
        second = _best_candidate(z, _with_ones(slopes), free & ~on_first, 1e-3, number)
        assert second == pytest.approx(inverse_of(walls[1]), abs=1e-9)


def test_points_in_a_line_give_a_plane_that_faces_the_camera() -> None:
    """No three of them span a plane."""
    slopes = grid(1, 50)
    slopes[..., 1] = 0.0
    z = np.full((1, 50), 2.0)
    z[0, 25:] = 2.5
    basis = _with_ones(slopes)
    best = _best_candidate(z, basis, np.isfinite(z), 1e-3, 0)
    assert best.tolist() == [1 / 2.25, 0.0, 0.0]


def test_distant_points_give_a_plane_that_faces_the_camera() -> None:
    """No three of them are close enough for a tried plane."""
    z = np.full((300, 300), np.nan)
    z[20::120, 20::120] = [[1.0, 1.1, 1.2], [1.3, 1.4, 1.5], [1.6, 1.7, 1.8]]
    best = _best_candidate(z, _with_ones(grid(300, 300)), np.isfinite(z), 1e-3, 0)
    assert best.tolist() == [1 / 1.4, 0.0, 0.0]


def test_the_part_with_most_points_on_the_plane_is_taken() -> None:
    """The larger part lies 1.5 tolerances to either side of the plane."""
    slopes = grid(50, 60)
    tolerance_m = 2e-3
    v, u = np.mgrid[:50, :60]
    z = np.where((u + v) % 2 == 0, 1.0 + 1.5 * tolerance_m, 1.0 - 1.5 * tolerance_m)
    z[:, :25] = 1.0
    z[:, 25] = np.nan
    planes = find_planes(z, slopes, tolerance_m, least_px=1000)
    assert any(np.array_equal(mask, u < 25) for _, mask in planes)


def test_connected_points_within_two_tolerances_belong_to_a_plane() -> None:
    slopes = grid(60, 60)
    tolerance_m = 5e-3
    z = np.full((60, 60), 1.0)
    z[:, 40:45] += 1.8 * tolerance_m
    z[:, 45:50] += 2.4 * tolerance_m
    z[:, 55:] = np.nan
    ((plane, mask),) = find_planes(z, slopes, tolerance_m, least_px=1000)
    assert mask[:, :45].all()
    assert not mask[:, 45:].any()
    assert plane.distance_m == pytest.approx(1.0, abs=2e-4)


def test_a_plane_has_at_least_so_many_connected_pixels() -> None:
    """Of two parts of one plane, the larger is the plane; the smaller is another."""
    slopes = grid(40, 50)
    z = Plane(1.0, 0.3).z_along_m(slopes)
    z[:, 30] = np.nan
    for least_px, sizes in ((1200, [1200]), (1201, []), (760, [1200, 760]), (761, [1200])):
        planes = find_planes(z, slopes, 1e-3, least_px)
        assert [int(mask.sum()) for _, mask in planes] == sizes
        for plane, _ in planes:
            assert (plane.distance_m, plane.slope_x) == pytest.approx((1.0, 0.3), abs=1e-9)


def test_at_most_six_planes_are_returned_largest_first() -> None:
    slopes = grid(20, 140)
    widths = np.array([14, 16, 18, 20, 22, 24, 26])
    step = np.repeat(np.arange(7), widths)
    z = np.tile(1.0 + 0.1 * step, (20, 1))
    planes = find_planes(z, slopes, 1e-3, least_px=100)
    assert len(planes) == MOST_PLANES == 6
    sizes = [int(mask.sum()) for _, mask in planes]
    assert sizes == sorted(sizes, reverse=True)
    for plane, mask in planes:
        assert mask.sum() == 20 * widths[round((plane.distance_m - 1.0) / 0.1)]


# ---- fixed pattern


def test_a_smooth_wall_has_no_fixed_pattern() -> None:
    """1/z of degree 5 over the slopes is the wall; of degree 6 it is pattern."""
    slopes = grid(60, 80)
    x = slopes[..., 0] / 0.3
    y = slopes[..., 1] / 0.3
    everywhere = np.ones(x.shape, bool)
    smooth = 0.8 + 0.2 * x - 0.1 * y + 0.02 * x**5 - 0.01 * y**5 + 0.03 * x**2 * y**3 + 0.02 * x * y
    pattern = fixed_pattern(np.stack(3 * [1 / smooth]), everywhere, slopes, lags=2)
    assert pattern.std_m == pytest.approx(0.0, abs=1e-9)
    for bend in (x**6, y**6, x**3 * y**3):
        bent = fixed_pattern(np.stack(3 * [1 / (smooth + 0.05 * bend)]), everywhere, slopes, lags=2)
        assert bent.std_m > 5e-5


def test_a_fixed_pattern_is_what_few_noisy_frames_have_in_common() -> None:
    """Four frames with 1 mm of noise and a pattern of 1 mm, of which three columns share a part:
    without the noise, 1 mm, a correlation of 2/3 and 1/3 along x, none along y. 12,000 pixels
    tell the deviation to 1 %. A patch that stands out by 5 cm does not count."""
    rng = np.random.default_rng(8)
    shape = (100, 120)
    slopes = grid(*shape)
    where = np.ones(shape, bool)
    where[:, :10] = False
    white = rng.standard_normal((shape[0], shape[1] + 2))
    planted = (white[:, 2:] + white[:, 1:-1] + white[:, :-2]) / np.sqrt(3)
    frames = 4
    noise = rng.standard_normal((frames, *shape))
    z = Plane(1.3, 0.4).z_along_m(slopes) + 1e-3 * (planted + noise)
    z[:, 60:66, 60:66] += 0.05
    z += 0.01 * rng.standard_normal((frames, 1, 1))
    z[:, ~where] = np.nan
    pattern = fixed_pattern(z, where, slopes, lags=3)
    assert pattern.std_m == pytest.approx(1e-3, rel=0.03)
    assert pattern.covariance_m2.shape == (4,)
    # the mean of both axes
    expected = [1.0, 1 / 3, 1 / 6, 0.0]
    assert pattern.covariance_m2 * 1e6 == pytest.approx(expected, abs=0.035)


# ---- tolerances


@pytest.mark.parametrize(
    ("sigma_mm", "step_mm", "tolerance_mm"),
    [
        (1.0, 50.0, 5.0),
        (2.0, 50.0, 8.0),
        (0.01, 2.0, 0.5),
        (np.nan, 50.0, 5.0),
        (2.0, 17.8, 8.0),
        (2.0, 17.7, np.nan),
        (0.01, 1.1, np.nan),
    ],
)
def test_the_tolerance_of_a_surface(sigma_mm: float, step_mm: float, tolerance_mm: float) -> None:
    tolerance_m = on_surface_tolerance_m(sigma_mm * 1e-3, step_mm * 1e-3)
    assert tolerance_m * 1e3 == pytest.approx(tolerance_mm, nan_ok=True)
