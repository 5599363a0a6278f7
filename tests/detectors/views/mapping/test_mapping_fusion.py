"""The fused map: its frame, exactness on planes, noise against views, stated variance, outliers,
holes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.views.mapping import fusion
from detectors.views.mapping.merge import Merged, merge
from detectors.views.mapping.settings import FusedMerge
from detectors.views.view import PreparedView
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from tests.support.mapped_views import (
    DISTANCE_M,
    LENS,
    PITCH_M,
    Plane,
    arc,
    plane_height,
    prepared,
    reference,
    registered,
    seen,
    turned,
)

NOISE_M = 0.5 * MM


def fused(views: list[PreparedView], poses: list[np.ndarray], **config: float) -> Merged:
    registrations = [reference()]
    for view, T in zip(views[1:], poses[1:], strict=True):
        registrations.append(registered(view.view.name, T))
    return merge(views, registrations, FusedMerge(**config))


def noisy(poses: list[np.ndarray], seed: int, plane: Plane, **kwargs: object) -> list[PreparedView]:
    rng = np.random.default_rng(seed)
    return [
        seen(plane, T, rng, noise_m=NOISE_M, name=f"v{i}", **kwargs) for i, T in enumerate(poses)
    ]


def deviations(
    merged: Merged,
    plane: Plane,
    enough_views: int,
) -> np.ndarray:
    """Of cells that enough views see, less a common plane's worth of nothing: the plane is known."""
    cells = merged.surface_map.seen_by.sum(axis=0) >= enough_views
    return plane_height(merged.cloud.points_m, merged.T_reference_cloud, plane)[cells]


def interior(merged: Merged) -> np.ndarray:
    """(h, w) bool: seen by all views."""
    return merged.surface_map.seen_by.sum(axis=0) == len(merged.views_used)


# ---------------------------------------------------------------- frame and exactness


def test_facing_plane_is_mapped_in_the_first_cameras_own_frame() -> None:
    result = fused([seen(Plane(), np.eye(4))], [np.eye(4)])
    np.testing.assert_allclose(result.T_reference_cloud, np.eye(4), atol=1e-12)
    assert result.surface_map.cell_m == pytest.approx(PITCH_M, rel=1e-12)
    assert result.cloud.projection == "parallel"
    assert result.cloud.organised
    assert result.cloud.lens is None
    valid = result.cloud.valid
    np.testing.assert_allclose(result.cloud.points_m[valid][:, 2], DISTANCE_M, atol=1e-12)
    # cells stand at whole multiples of the pitch, half a pixel off the pixels here: 119 x 159
    # between them
    assert valid.all()
    assert valid.shape == (119, 159)


def test_frame_stands_before_the_place_where_the_axis_meets_a_tilted_plane() -> None:
    plane = Plane(20.0, -30.0)
    result = fused([seen(plane, np.eye(4))], [np.eye(4)])
    T = result.T_reference_cloud
    normal = plane.T_reference_plane[:3, 2]
    np.testing.assert_allclose(T[:3, 2], normal, atol=1e-9)
    np.testing.assert_allclose(
        T[:3, 3],
        np.array([0, 0, DISTANCE_M]) - DISTANCE_M * normal,
        atol=1e-9,
    )
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    # x has no part of the camera's y but what orthogonality to z asks for
    assert T[:3, 0] @ np.cross(normal, [1.0, 0.0, 0.0]) == pytest.approx(0.0, abs=1e-9)
    assert T[0, 0] > 0
    assert T[1, 1] > 0


def test_axis_that_misses_the_target_puts_the_origin_before_its_middle() -> None:
    view = seen(Plane(), np.eye(4))
    inside = np.zeros(view.inside.shape, dtype=bool)
    inside[20:60, 100:150] = True
    result = fused([prepared(view.view.cloud, inside, None, "v")], [np.eye(4)])
    middle = np.median(view.view.cloud.points_m[inside], axis=0)
    expected = middle - np.array([0.0, 0.0, np.linalg.norm(middle)])
    np.testing.assert_allclose(result.T_reference_cloud[:3, 3], expected, atol=1e-9)


@settings(max_examples=5, deadline=None)
@given(
    st.floats(-35, 35),
    st.floats(-35, 35),
    st.floats(-20, 20),
    st.floats(-30, 30),
    st.sampled_from([0.8, 1.4, 3.1]),
)
def test_noise_free_views_of_a_plane_reproduce_it(
    tilt_x: float,
    tilt_y: float,
    about_x: float,
    about_y: float,
    cell_mm: float,
) -> None:
    plane = Plane(tilt_x, tilt_y)
    poses = [np.eye(4), turned(about_x, about_y, (0.01, -0.02, 0.03))]
    result = fused(
        [seen(plane, T, name=str(i)) for i, T in enumerate(poses)],
        poses,
        cell_mm=cell_mm,
    )
    height = plane_height(
        result.cloud.points_m[result.cloud.valid],
        result.T_reference_cloud,
        plane,
    )
    assert result.cloud.valid.any()
    np.testing.assert_allclose(height, 0.0, atol=2e-7)


def test_equal_pitches_leave_no_gaps_and_lens_distortion_no_bend() -> None:
    from harness.vocabulary.geometry import Lens

    bent = Lens(160, 120, 500.0, 500.0, 79.5, 59.5, (0.3, -0.2, 1e-3, -1e-3, 0.1, 0.0, 0.0, 0.0))
    poses = [np.eye(4), turned(2.0, -3.0, (0.0007, 0.0003, 0.0))]
    result = fused([seen(Plane(), T, lens=bent, name=str(i)) for i, T in enumerate(poses)], poses)
    inner = result.surface_map.seen_by.sum(axis=0)[15:-15, 15:-15]
    assert (inner == 2).all()
    np.testing.assert_allclose(
        plane_height(result.cloud.points_m[result.cloud.valid], result.T_reference_cloud, Plane()),
        0,
        atol=2e-7,
    )


def test_order_of_the_other_views_changes_nothing_but_rounding() -> None:
    poses = arc(4, 20.0)
    views = noisy(poses, 5, Plane(5.0, 3.0))
    first = fused(views, poses)
    second = fused([views[0], *views[:0:-1]], [poses[0], *poses[:0:-1]])
    np.testing.assert_allclose(first.cloud.points_m, second.cloud.points_m, atol=1e-9)
    np.testing.assert_allclose(
        first.surface_map.variance_m2,
        second.surface_map.variance_m2,
        rtol=0.02,
    )


def test_the_same_views_give_the_same_bits() -> None:
    poses = arc(3, 15.0)
    first = fused(noisy(poses, 9, Plane()), poses)
    second = fused(noisy(poses, 9, Plane()), poses)
    np.testing.assert_array_equal(first.cloud.points_m, second.cloud.points_m)
    np.testing.assert_array_equal(first.cloud.mean_variance_m2, second.cloud.mean_variance_m2)


# ---------------------------------------------------------------- noise and its variance


def test_white_noise_falls_with_the_square_root_of_views() -> None:
    plane = Plane(5.0, -5.0)
    poses = arc(16, 20.0)
    views = noisy(poses, 11, plane, frames=10)
    spread = {}
    for count in (1, 4, 16):
        result = fused(views[:count], poses[:count])
        spread[count] = float(np.std(deviations(result, plane, count)))
    # 10,000 cells, neighbours share pixels: 2 % each; views at an angle and interpolation differ
    # by some percent
    assert spread[1] / spread[4] == pytest.approx(2.0, rel=0.08)
    assert spread[1] / spread[16] == pytest.approx(4.0, rel=0.08)


@pytest.mark.parametrize(
    ("count", "frames", "cell_mm"), [(2, 10, 1.4), (5, 10, 1.4), (5, 10, 4.2), (4, 1, 1.4)]
)
def test_stated_variance_is_that_of_the_heights(
    monkeypatch: pytest.MonkeyPatch,
    count: int,
    frames: int,
    cell_mm: float,
) -> None:
    # these lenses are exact
    monkeypatch.setattr(fusion, "LATERAL_PX", 0.0)
    plane = Plane(5.0, -5.0)
    poses = arc(count, 20.0)
    result = fused(noisy(poses, 3, plane, frames=frames), poses, cell_mm=cell_mm)
    cells = interior(result)
    standard = deviations(result, plane, count) / np.sqrt(result.cloud.mean_variance_m2[cells])
    assert float(np.std(standard)) == pytest.approx(1.0, rel=0.08)


def test_registration_error_is_in_the_variance() -> None:
    plane = Plane()
    poses = arc(2, 10.0)
    views = noisy(poses, 3, plane, frames=10)
    # the second view may be wrong by 0.4 mm along its normal and by 2 mrad about y through the
    # middle
    covariance = np.diag([0.0, 2e-3, 0.0, 0.0, 0.0, 0.4 * MM]) ** 2
    merged = merge(views, [reference(), registered("v1", poses[1], covariance)], FusedMerge())
    surface_map = merged.surface_map
    exact = fused(views, poses).surface_map
    added = (0.4 * MM) ** 2 + (2e-3 * merged.cloud.points_m[..., 0]) ** 2
    for cells in (
        surface_map.seen_by[1] & ~surface_map.seen_by[0],
        surface_map.seen_by.all(axis=0),
    ):
        assert cells.sum() > 100
    alone = surface_map.seen_by[1] & ~surface_map.seen_by[0]
    np.testing.assert_allclose(
        (surface_map.variance_m2 - exact.variance_m2)[alone],
        added[alone],
        rtol=0.15,
    )


def test_a_pattern_of_its_own_in_each_view_is_found() -> None:
    plane = Plane()
    poses = arc(5, 15.0)
    rng = np.random.default_rng(2)
    own_m = 1.0 * MM
    views = [
        seen(
            plane,
            T,
            rng,
            noise_m=NOISE_M,
            frames=25,
            name=f"v{i}",
            pattern_m=own_m * rng.standard_normal((120, 160)),
        )
        for i, T in enumerate(poses)
    ]
    result = fused(views, poses)
    cells = interior(result)
    standard = deviations(result, plane, 5) / np.sqrt(result.cloud.mean_variance_m2[cells])
    assert float(np.std(standard)) == pytest.approx(1.0, rel=0.1)
    # interpolation takes about half of the variance of a pattern that changes from pixel to pixel
    between = result.surface_map.between
    assert np.sqrt(between.own_m2 + between.pattern_m2) == pytest.approx(
        own_m * np.sqrt(0.5), rel=0.15
    )


def test_a_pattern_that_belongs_to_the_pixels_does_not_pass_for_independent() -> None:
    """Views a few pixels apart share a pattern 8 pixels wide: nine of them do not make it three
    times smaller."""
    import cv2

    rng = np.random.default_rng(4)
    pattern = cv2.GaussianBlur(rng.standard_normal((120, 160)), (0, 0), 4.0)
    pattern *= 0.6 * MM / pattern.std()
    poses = [np.eye(4)] + [
        turned(
            2.0 * np.sin(i),
            3.0 * np.cos(2.0 * i),
            (0.008 * np.sin(3 * i), 0.008 * np.cos(i), 0.0),
        )
        for i in range(1, 9)
    ]
    views = [
        seen(Plane(), T, rng, noise_m=NOISE_M, frames=25, name=f"v{i}", pattern_m=pattern)
        for i, T in enumerate(poses)
    ]
    result = fused(views, poses)
    cells = interior(result)
    actual = float(np.std(deviations(result, Plane(), 9)))
    stated = float(np.sqrt(result.cloud.mean_variance_m2[cells].mean()))
    independent = 0.6 * MM / 3.0
    assert actual > 1.5 * independent
    assert 0.75 < actual / stated < 1.25
    assert result.surface_map.between.pattern_m2 == pytest.approx((0.6 * MM) ** 2, rel=0.4)


def test_one_view_says_that_it_does_not_know_its_pattern() -> None:
    result = fused(noisy([np.eye(4)], 1, Plane(), frames=10), [np.eye(4)])
    assert result.cloud.mean_variance_m2 is None
    assert any("one view" in note for note in result.notes)


def test_what_a_cell_knows_of_its_views() -> None:
    poses = [np.eye(4), turned(0.0, 20.0), turned(0.0, -20.0)]
    rng = np.random.default_rng(0)
    views = [
        seen(
            Plane(),
            T,
            rng,
            noise_m=NOISE_M,
            frames=7,
            name=f"v{i}",
            rgb=np.full((120, 160, 3), (90 * i, 10, 20), np.uint8),
            amplitude=np.full((120, 160), 100.0),
        )
        for i, T in enumerate(poses)
    ]
    result = fused(views, poses)
    away = np.hypot(result.cloud.points_m[..., 0], result.cloud.points_m[..., 1])
    middle = np.unravel_index(np.nanargmin(away), away.shape)
    assert result.surface_map.seen_by.sum(axis=0)[middle] == 3
    assert result.cloud.count[middle] == 21
    cameras = result.cloud.map_views.T_cloud_cameras[:, :3, 3]
    np.testing.assert_allclose(
        np.rad2deg(np.arctan2(cameras[:, 0], DISTANCE_M - cameras[:, 2])),
        [0, -20, 20],
        atol=1,
    )
    assert result.cloud.rgb[middle][0] == pytest.approx(90, abs=15)
    assert result.cloud.amplitude[middle] == pytest.approx(100.0, abs=1e-9)
    assert result.cloud.n_frames == 21


def test_a_map_as_a_cloud_states_its_samples_variances_and_views() -> None:
    """Three views of a facing plane, of 4, 6 and 10 frames of 0.5 mm: the variance over the number
    is what more frames would lower, and the mean's variance is the map's."""
    poses = arc(3, 10.0)
    rng = np.random.default_rng(12)
    views = []
    for number, (T, frames) in enumerate(zip(poses, (4, 6, 10), strict=True)):
        views.append(
            seen(
                Plane(),
                T,
                rng,
                noise_m=NOISE_M,
                frames=frames,
                name=f"v{number}",
                rgb=np.full((120, 160, 3), (40 * number, 200 - 30 * number, 7), np.uint8),
                amplitude=np.full((120, 160), 100.0 * 2**number),
            )
        )
    result = fused(views, poses)
    cells = interior(result)
    assert cells.sum() > 1000
    surface_map = result.surface_map
    cloud = result.cloud
    assert (cloud.count[cells] == 20).all()
    assert cloud.n_frames == 20
    per_frame_m2 = cloud.variance_m2[cells] / cloud.count[cells]
    np.testing.assert_allclose(per_frame_m2, surface_map.temporal_m2[cells])
    # cells take the mean over triangles of pixels, about half of a pixel's variance
    by_frames_m2 = NOISE_M**2 / 20
    assert 0.3 * by_frames_m2 < np.median(per_frame_m2) < by_frames_m2
    np.testing.assert_array_equal(cloud.mean_variance_m2, surface_map.variance_m2)
    shares = surface_map.shares[:, cells]
    np.testing.assert_allclose(shares.sum(axis=0), 1.0)
    assert cloud.map_views is not None
    all_shares = surface_map.shares.sum(axis=(1, 2)) / surface_map.shares.sum()
    np.testing.assert_allclose(cloud.map_views.shares, all_shares)
    np.testing.assert_allclose(cloud.map_views.pixel_m, PITCH_M, rtol=0.05)
    assert cloud.rgb is not None
    assert cloud.amplitude is not None
    red = np.array([0.0, 40.0, 80.0]) @ shares
    np.testing.assert_allclose(cloud.rgb[cells][:, 0], red, atol=0.51)
    np.testing.assert_allclose(cloud.rgb[cells][:, 2], 7)
    bright = np.array([100.0, 200.0, 400.0]) @ shares
    np.testing.assert_allclose(cloud.amplitude[cells], bright, rtol=1e-9)
    covered = surface_map.seen_by.any(axis=0)
    np.testing.assert_array_equal(cloud.valid, covered)
    assert np.isnan(cloud.points_m[~covered]).all()


# ---------------------------------------------------------------- outliers


def spoiled(
    cells: tuple[slice, slice],
    by_m: float,
    view_numbers: tuple[int, ...],
    count: int = 5,
) -> Merged:
    poses = arc(count, 6.0)
    rng = np.random.default_rng(8)
    views = []
    for i, T in enumerate(poses):
        error = np.zeros((120, 160))
        if i in view_numbers:
            error[cells] = by_m
        views.append(
            seen(Plane(), T, rng, noise_m=NOISE_M, frames=10, name=f"v{i}", pattern_m=error)
        )
    return fused(views, poses)


def worst(merged: Merged) -> float:
    return float(np.abs(deviations(merged, Plane(), 5)).max())


def test_a_flying_pixel_is_rejected() -> None:
    result = spoiled((slice(60, 61), slice(80, 81)), 30 * MM, (2,))
    assert 1 <= result.surface_map.rejected <= 9
    assert worst(result) < 5 * NOISE_M
    assert any("outliers" in note for note in result.notes)


def test_what_stands_before_the_surface_in_one_view_is_rejected() -> None:
    result = spoiled((slice(50, 70), slice(70, 90)), -30 * MM, (2,))
    assert result.surface_map.rejected >= 300
    assert worst(result) < 5 * NOISE_M


def test_a_hole_that_few_views_see_into_stays() -> None:
    result = spoiled((slice(50, 70), slice(70, 90)), 30 * MM, (2, 4))
    # two of five views: 12 mm in the mean
    assert worst(result) == pytest.approx(12 * MM, rel=0.2)
    assert (result.surface_map.height_m > 10 * MM).sum() > 100


def test_two_views_have_no_majority() -> None:
    poses = arc(2, 6.0)
    views = noisy(poses, 1, Plane(), frames=10)
    error = np.zeros((120, 160))
    error[60, 80] = 30 * MM
    rng = np.random.default_rng(1)
    views[1] = seen(Plane(), poses[1], rng, noise_m=NOISE_M, frames=10, pattern_m=error, name="v1")
    assert fused(views, poses).surface_map.rejected == 0


# ---------------------------------------------------------------- other clouds, and refusals


def test_a_view_without_a_grid_gives_the_same_map() -> None:
    plane = Plane(10.0, 5.0)
    poses = arc(2, 10.0)
    views = noisy(poses, 7, plane, frames=10)
    flat = [without_grid(view) for view in views]
    first = fused(views, poses, cell_mm=1.4)
    second = fused(flat, poses, cell_mm=1.4)
    h, w = np.minimum(first.cloud.valid.shape, second.cloud.valid.shape)
    inner = (slice(5, h - 5), slice(5, w - 5))
    gap = first.surface_map.height_m[inner] - second.surface_map.height_m[inner]
    # other diagonals in the same squares, other weights: a part of the noise, no bias
    assert np.isfinite(gap).mean() > 0.6
    assert abs(float(np.nanmean(gap))) < 0.02 * NOISE_M
    assert float(np.nanstd(gap)) < NOISE_M / np.sqrt(10.0)


def without_grid(view: PreparedView) -> PreparedView:
    from dataclasses import replace

    from harness.vocabulary.geometry import Region

    cloud = view.view.cloud
    n = cloud.valid.size
    flat = replace(
        cloud,
        points_m=cloud.points_m.reshape(1, n, 3),
        reason=cloud.reason.reshape(1, n),
        count=cloud.count.reshape(1, n),
        variance_m2=cloud.variance_m2.reshape(1, n),
        region=Region(0, 1, 0, n),
        organised=False,
        lens=None,
    )
    return prepared(flat, view.inside.reshape(1, n), None, view.view.name)


def test_invalid_pixels_and_pixels_outside_the_target_leave_cells_empty() -> None:
    view = seen(Plane(), np.eye(4))
    inside = view.inside.copy()
    inside[40:60, 50:90] = False
    result = fused([prepared(view.view.cloud, inside, None, "v")], [np.eye(4)])
    hollow = (LENS.whole.shape[0] * LENS.whole.shape[1]) - result.cloud.valid.sum()
    # triangles end at the last valid pixel: one more row and column of cells is lost at most
    assert 20 * 40 <= hollow <= 22 * 42 + 120 + 160
    assert result.cloud.reason[~result.cloud.valid].min() > 0


def test_too_many_cells_are_refused() -> None:
    with pytest.raises(UserError, match="cells") as refusal:
        fused([seen(Plane(), np.eye(4))], [np.eye(4)], cell_mm=0.01)
    assert "cell_mm" in str(refusal.value)
