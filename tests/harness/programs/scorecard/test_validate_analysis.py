"""The scorecard's measurements on data whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage, stats

from harness.programs.scorecard.bench import Bench, Effort
from harness.programs.scorecard.quantities import QUANTITIES
from harness.stills.statistics import (
    correlation_at,
    edge_widths,
    find_planes,
    fit_plane,
    jackknifed,
    mean_of,
    on_surface_tolerance_m,
    share_of,
    temporal_sigma_m,
)
from harness.vocabulary.geometry import Region
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig

AZURE = "azure_kinect_nfov"
QUICK = Effort(noise_frames=20, few_frames=4, whole_frames=80, units=4)
PINHOLE = camera_of(
    CameraConfig(name=AZURE, numbers={"lens.distortion": [0.0] * 8, "lens.cx_px": 320.0})
)
"""An Azure Kinect whose pixels are evenly spaced, so that widths can be worked out by hand."""


# ---- temporal noise
# ------------------------------------------------------------------------------------------------


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
# ------------------------------------------------------------------------------------------------


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


def test_a_front_pixel_that_shows_the_back_does_not_fly():
    z, front, back, from_edge = ideal_step()
    z[:, :, 19] = 1.1
    widths = edge_widths(z, front, back, from_edge, 0.01, 15, across=2)
    assert [width[0] for width in widths.values()] == [0, 0, 0]


@given(st.floats(1e-5, 1e-2), st.floats(1e-3, 1.0))
@settings(max_examples=30, deadline=None)
def test_surfaces_that_noise_makes_one_are_not_told_apart(sigma_m, step_m):
    tolerance = on_surface_tolerance_m(sigma_m, step_m)
    assert np.isnan(tolerance) or 4 * sigma_m <= tolerance <= 0.45 * step_m
    if 4 * sigma_m > 0.45 * step_m:
        assert np.isnan(tolerance)
        z, front, back, from_edge = ideal_step()
        assert np.isnan(edge_widths(z, front, back, from_edge, tolerance, 15, 2)["flying"]).all()


# ---- planes
# ------------------------------------------------------------------------------------------------


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
    (wall, _), (near, on_board) = planes
    assert (wall.distance_m, wall.slope_x) == pytest.approx((1.6, -0.4), abs=1e-3)
    assert (near.distance_m, near.slope_x) == pytest.approx((0.9, 0.1), abs=1e-3)
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


# ---- views of steps
# ------------------------------------------------------------------------------------------------

REGION = Region(300, 330, 280, 360)


def half(edge_slope: float, sign: float = 1.0):  # type: ignore[no-untyped-def]
    return lambda slopes: sign * (slopes[..., 0] - edge_slope) < 0


def test_a_front_that_is_everywhere_or_nowhere_is_a_plane():
    """Averaging over the footprint turns the light by what z bends within a pixel: far below
    1e-4."""
    front = Plane(0.8, 0.1)
    back = Plane(1.1)
    for covers, plane in (
        (lambda s: np.ones(s.shape[:-1], bool), front),
        (lambda s: s[..., 0] > 9, back),
    ):
        view = layered_view(PINHOLE, REGION, front, back, covers, 0.6)
        alone = plane_view(PINHOLE, REGION, plane.distance_m, 0.6, plane.slope_x)
        assert np.abs(view.phasor / alone.phasor - 1).max() < 1e-4
        assert (view.coverage == 1).all()
        assert view.range_m == pytest.approx(alone.range_m, abs=1e-12)


def test_an_edge_within_a_pixel_mixes_phasors_by_area():
    """The edge a quarter into column 320: a quarter of the front's light and three of the back's,
    to 1/12 pixel."""
    edge = (320 - 0.25 - 320.0) / PINHOLE.nominal_lens.fx
    front = Plane(0.75)
    back = Plane(0.95)
    view = layered_view(PINHOLE, REGION, front, back, half(edge, sign=-1.0), 0.6)
    alone = [plane_view(PINHOLE, REGION, plane.distance_m, 0.6).phasor for plane in (front, back)]
    column = 320 - REGION.col0
    mixed = 0.75 * alone[0][:, :, column] + 0.25 * alone[1][:, :, column]
    assert np.abs(view.phasor[:, :, column] / mixed - 1).max() < 0.05
    assert view.coverage[:, column] == pytest.approx(0.75, abs=1 / 12)
    assert (view.surface[:, : column - 1] == 1).all() and (view.surface[:, column:] == 0).all()


def test_the_shadow_is_as_wide_as_the_emitter_says():
    """The line from the emitter by the edge ends the shadow on the back; on the other side of the
    front is none.

    The edge lies between two columns, so that no pixel is partly front; sub-rays tell the shadow's
    end to 1/12 pixel.
    """
    front = Plane(0.75)
    back = Plane(0.95)
    lit = plane_view(PINHOLE, REGION, 0.95, 0.6).intensity
    lens, (e_x, _, e_z) = PINHOLE.nominal_lens, PINHOLE.optics.emitter_m
    edge = 0.5 / lens.fx
    x_edge = edge * 0.75
    x_end = x_edge + (x_edge - e_x) * 0.2 / (0.75 - e_z)
    for sign, wanted in ((1.0, (x_end / 0.95 - edge) * lens.fx), (-1.0, 0.0)):
        view = layered_view(PINHOLE, REGION, front, back, half(edge, sign), 0.6)
        assert (view.coverage == 1).all()
        dark = np.where(view.surface == 1, 1 - view.intensity / lit, 0)
        assert dark.sum(axis=1) == pytest.approx(wanted, abs=1 / 12)
    assert x_end / 0.95 * lens.fx > 2.4


# ---- the bench
# ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(AZURE, QUICK)


def value(bench: Bench, name: str, **conditions: object) -> float:
    quantity = QUANTITIES[name]
    return quantity.measure(bench, quantity.conditions.from_data(conditions)).value


def test_the_calibration_point_comes_out(bench):
    assert value(bench, "temporal_sigma_mm") == pytest.approx(0.89, abs=0.06)


def test_noise_grows_with_distance_angle_and_darkness(bench):
    assert value(bench, "temporal_sigma_mm", distance_m=3.0) > 1.5 * value(
        bench, "temporal_sigma_mm"
    )
    assert value(bench, "temporal_sigma_mm", angle_deg=60) > 1.2 * value(bench, "temporal_sigma_mm")
    assert value(bench, "temporal_sigma_mm", albedo=0.1) > 2 * value(bench, "temporal_sigma_mm")


def test_what_the_camera_does_not_see_has_no_number(bench):
    assert value(bench, "valid_fraction", distance_m=15.0, albedo=0.05) == 0
    assert np.isnan(value(bench, "temporal_sigma_mm", distance_m=15.0, albedo=0.05))


def test_a_shadow_is_a_gap_of_its_width(bench):
    """80 mm aside, a step of 500 mm at 0.75 m: 32 mm at 1.25 m, 15.6 px; the filter takes up to
    two on each side, the lens's blur half of one."""
    v2 = Bench("kinect_v2", bench.effort)
    lit = value(v2, "edge_gap_px", step_mm=500, shadow=False)
    shadowed = value(v2, "edge_gap_px", step_mm=500, shadow=True)
    assert lit < 0.5 and 10.6 < shadowed < 15.6
    assert value(bench, "edge_gap_px", step_mm=20) == 0
