"""The thesis' grid by hand, the volume on planes, which views go in, and the law of a view's
noise."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.views.mapping.fusion import depth_noise
from detectors.views.mapping.merge import merge
from detectors.views.mapping.placing import CellGrid, raster_between
from detectors.views.mapping.settings import FusedMerge, GridMerge, VolumeMerge
from detectors.views.view import PreparedView
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, LeftOut, Lens, Region, invert, transform_points
from tests.support.mapped_views import (
    PITCH_M,
    Hole,
    Plane,
    arc,
    plane_height,
    prepared,
    reference,
    registered,
    seen,
    turned,
)

EVERY_WAY = [GridMerge(), FusedMerge(), VolumeMerge()]


def points_view(points_mm: list[list[float]], name: str, **fields: object) -> PreparedView:
    n = len(points_mm)
    given_fields = {
        "points_m": np.array([points_mm], dtype=float) * MM,
        "reason": np.zeros((1, n), dtype=np.uint8),
        "count": np.full((1, n), 10, dtype=np.int32),
        "variance_m2": np.full((1, n), 1e-6),
        "region": Region(0, 1, 0, n),
        "z_step_m": 1e-3,
        "n_frames": 10,
        "organised": False,
    }
    return prepared(Cloud(**(given_fields | fields)), np.ones((1, n), dtype=bool), None, name)


# ---------------------------------------------------------------- the thesis' grid


def test_boxes_of_two_clouds_by_hand() -> None:
    red = [[(200, 0, 0)] * 3]
    blue = [[(0, 0, 101)] * 3]
    fixed = points_view(
        [[-50, 0, 700], [10.0, 10.0, 700.0], [20, 20, 702]], "a", rgb=np.array(red, np.uint8)
    )
    moving = points_view(
        [[0.04, 0.02, 700.01], [10.05, 10.02, 700.06], [60, 30, 703]],
        "b",
        rgb=np.array(blue, np.uint8),
        count=np.full((1, 3), 30, dtype=np.int32),
        variance_m2=np.full((1, 3), 5e-6),
    )
    result = merge([fixed, moving], [reference(), registered("b", np.eye(4))], GridMerge())
    # the overlap is x 0.04..20, y 0.02..20, z 700.01..702: the pair near (10, 10, 700) has one
    # point below it in z
    points = result.cloud.points_m[0] / MM
    expected = [
        [10.05, 10.02, 700.06],
        [20, 20, 702],
        [-50, 0, 700],
        [10, 10, 700],
        [0.04, 0.02, 700.01],
        [60, 30, 703],
    ]
    assert sorted(map(tuple, np.round(points, 6))) == sorted(map(tuple, expected))
    np.testing.assert_array_equal(result.T_reference_cloud, np.eye(4))
    assert not result.cloud.organised and result.cloud.lens is None
    assert (result.cloud.z_step_m, result.cloud.n_frames) == (1e-3, 10)


def test_points_of_one_box_become_their_mean() -> None:
    colours = np.array([[(0, 0, 0), (10, 1, 0), (0, 0, 0)]], np.uint8)
    fixed = points_view([[0, 0, 700], [10.01, 10.01, 701.01], [20, 20, 702]], "a", rgb=colours)
    moving = points_view(
        [[0, 0, 700], [10.05, 10.03, 701.09], [20, 20, 702]],
        "b",
        rgb=colours + np.array([1, 0, 0], np.uint8),
        count=np.full((1, 3), 30, dtype=np.int32),
        variance_m2=np.full((1, 3), 5e-6),
    )
    result = merge([fixed, moving], [reference(), registered("b", np.eye(4))], GridMerge())
    np.testing.assert_allclose(
        result.cloud.points_m[0] / MM,
        [[0, 0, 700], [10.03, 10.02, 701.05], [20, 20, 702]],
        atol=1e-9,
    )
    # 10.5 and 0.5 round up, as MATLAB does
    np.testing.assert_array_equal(result.cloud.rgb[0], [[1, 0, 0], [11, 1, 0], [1, 0, 0]])
    np.testing.assert_array_equal(result.cloud.count[0], [40, 40, 40])
    # (10 x 1 + 30 x 5) / 40
    np.testing.assert_allclose(result.cloud.variance_m2[0], 4e-6, rtol=1e-12)


def test_a_single_cloud_and_clouds_apart_stay_as_they_are() -> None:
    points = [[0, 0, 700], [0.01, 0.01, 700.01]]
    alone = merge([points_view(points, "a")], [reference()], GridMerge())
    np.testing.assert_allclose(alone.cloud.points_m[0] / MM, points, atol=1e-9)
    separation = np.eye(4)
    separation[0, 3] = 1.0
    pair = merge(
        [points_view(points, "a")] * 2, [reference(), registered("b", separation)], GridMerge()
    )
    assert pair.cloud.points_m.shape == (1, 4, 3)
    assert pair.cloud.rgb is None


def test_colour_is_dropped_where_one_cloud_has_none() -> None:
    coloured = points_view([[0, 0, 700]], "a", rgb=np.zeros((1, 1, 3), np.uint8))
    result = merge(
        [coloured, points_view([[0, 0, 700]], "b")],
        [reference(), registered("b", np.eye(4))],
        GridMerge(),
    )
    assert result.cloud.rgb is None


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 20.0), st.integers(2, 4))
def test_the_grid_keeps_the_mean_and_no_two_points_of_a_box(
    seed: int, step_mm: float, views: int
) -> None:
    rng = np.random.default_rng(seed)
    clouds = [
        points_view((rng.uniform(-20, 20, (50, 3)) + np.array([0, 0, 700])).tolist(), str(i))
        for i in range(views)
    ]
    merged = merge(
        clouds,
        [reference()] + [registered(str(i), np.eye(4)) for i in range(1, views)],
        GridMerge(step_mm=step_mm),
    )
    weights = merged.cloud.count[0] / 10.0
    assert weights.sum() == 50 * views
    mean = np.average(merged.cloud.points_m[0], axis=0, weights=weights)
    np.testing.assert_allclose(
        mean, np.mean([c.points_m.mean(axis=0) for c in clouds], axis=0), atol=1e-12
    )
    assert len(merged.cloud.points_m[0]) <= 50 * views


# ---------------------------------------------------------------- the volume


@pytest.mark.parametrize("distortion", [(0.0,) * 8, (0.3, -0.2, 1e-3, -1e-3, 0.1, 0.0, 0.0, 0.0)])
def test_volume_of_a_plane_lies_on_it(distortion: tuple[float, ...]) -> None:
    pytest.importorskip("open3d")
    lens = Lens(160, 120, 500.0, 500.0, 79.5, 59.5, distortion)
    plane = Plane(10.0, -15.0)
    poses = arc(3, 15.0)
    colour = np.full((120, 160, 3), (200, 100, 50), np.uint8)
    views = [seen(plane, T, lens=lens, name=str(i), rgb=colour) for i, T in enumerate(poses)]
    result = merge(
        views,
        [reference(), *(registered(str(i), T) for i, T in enumerate(poses) if i)],
        VolumeMerge(),
    )
    assert not result.cloud.organised and result.cloud.valid.all()
    height = plane_height(result.cloud.points_m[0], result.T_reference_cloud, plane)
    # depth is looked up up to a quarter of a pixel beside its place along each axis, at incidences
    # up to 35 degrees
    assert float(np.abs(height).max()) < np.sqrt(2.0) / 4.0 * np.tan(np.deg2rad(35.0)) * PITCH_M
    assert abs(float(height.mean())) < 0.02 * PITCH_M
    np.testing.assert_allclose(result.cloud.rgb[0].mean(axis=0), [200, 100, 50], atol=1.0)
    first = result.cloud.points_m[0][:-1]
    second = result.cloud.points_m[0][1:]
    assert (first[:, 0] <= second[:, 0]).all()


def test_volume_is_the_same_twice_and_noise_falls_with_views() -> None:
    pytest.importorskip("open3d")
    plane = Plane(5.0, 5.0)
    poses = arc(4, 10.0)
    rng = np.random.default_rng(3)
    views = [seen(plane, T, rng, noise_m=0.5 * MM, name=str(i)) for i, T in enumerate(poses)]
    registrations = [reference(), *(registered(str(i), T) for i, T in enumerate(poses) if i)]
    first, second = (merge(views, registrations, VolumeMerge()).cloud.points_m for _ in range(2))
    np.testing.assert_array_equal(first, second)
    spread = {}
    for count in (1, 4):
        points = merge(views[:count], registrations[:count], VolumeMerge()).cloud.points_m[0]
        middle = (np.abs(points[:, 0]) < 0.05) & (np.abs(points[:, 1]) < 0.04)
        spread[count] = float(np.std(plane_height(points[middle], np.eye(4), plane)))
    assert spread[1] / spread[4] == pytest.approx(2.0, rel=0.15)


def test_volume_keeps_face_and_floor_apart_from_the_walls_of_a_hole() -> None:
    pytest.importorskip("open3d")
    hole = Hole(25.4 * MM, 12.7 * MM, (0.01, 0.0))
    plane = Plane(5.0, 5.0, hole)
    poses = arc(5, 25.0)
    views = [seen(plane, T, name=str(i), blur=3) for i, T in enumerate(poses)]
    result = merge(
        views,
        [reference(), *(registered(str(i), T) for i, T in enumerate(poses) if i)],
        VolumeMerge(),
    )
    assert re.search(r"[1-9]\d\d points on walls steeper than 60 degrees", " ".join(result.notes))
    points = transform_points(
        invert(plane.T_reference_plane) @ result.T_reference_cloud, result.cloud.points_m[0]
    )
    from_axis = np.hypot(points[:, 0] - hole.at[0], points[:, 1] - hole.at[1])
    nearby = from_axis < 0.6 * hole.diameter_m
    floor = nearby & (points[:, 2] > 0.8 * hole.depth_m)
    on_wall = nearby & (points[:, 2] > 0.25 * hole.depth_m) & (points[:, 2] < 0.75 * hole.depth_m)
    # without the rule there are more points on the walls (391) than on the floor (375)
    assert floor.sum() > 250 and on_wall.sum() < 0.1 * floor.sum()


def test_volume_leaves_out_what_lies_outside_the_target() -> None:
    pytest.importorskip("open3d")
    view = seen(Plane(5.0, 5.0), np.eye(4))
    inside = np.zeros(view.inside.shape, dtype=bool)
    inside[40:80, 50:110] = True
    result = merge([prepared(view.view.cloud, inside, None, "view")], [reference()], VolumeMerge())
    limits = view.view.cloud.points_m[inside]
    for axis in (0, 1):
        assert result.cloud.points_m[0][:, axis].min() > limits[:, axis].min() - 1.5 * PITCH_M
        assert result.cloud.points_m[0][:, axis].max() < limits[:, axis].max() + 1.5 * PITCH_M


def test_volume_without_a_surface_is_a_users_error() -> None:
    pytest.importorskip("open3d")
    view = seen(Plane(), np.eye(4))
    inside = np.zeros(view.inside.shape, dtype=bool)
    inside[40:43, 50:53] = True
    with pytest.raises(UserError, match="no surface"):
        merge(
            [prepared(view.view.cloud, inside, None, "view")],
            [reference()],
            VolumeMerge(voxel_mm=50.0),
        )


# ---------------------------------------------------------------- which views go in


@pytest.mark.parametrize("config", EVERY_WAY, ids=lambda config: config.kind)
def test_failed_views_are_left_out_and_named(config: GridMerge | FusedMerge | VolumeMerge) -> None:
    pytest.importorskip("open3d")
    poses = arc(3, 10.0)
    views = [seen(Plane(), T, name=f"v{i}") for i, T in enumerate(poses)]
    wrong = registered("v1", turned(0, 0, (0.0, 0.0, 0.3)), failure="too few marks")
    result = merge(views, [reference(), wrong, registered("v2", poses[2])], config)
    assert result.views_used == ("v0", "v2")
    assert any("v1" in note and "too few marks" in note for note in result.notes)
    height = plane_height(
        result.cloud.points_m[result.cloud.valid], result.T_reference_cloud, Plane()
    )
    assert float(np.abs(height).max()) < 0.3 * MM
    assert result.seconds > 0


def test_nothing_left_is_a_users_error_that_names_each_view() -> None:
    views = [seen(Plane(), np.eye(4), name="v0"), seen(Plane(), np.eye(4), name="v1")]
    nowhere = prepared(views[0].view.cloud, np.zeros_like(views[0].inside), None, "v0")
    failed = registered("v1", np.eye(4), failure="no overlap")
    with pytest.raises(UserError, match="no view is left") as refusal:
        merge([nowhere, views[1]], [reference(), failed], FusedMerge())
    assert "v0" in str(refusal.value) and "no overlap" in str(refusal.value)


def test_frames_left_out_of_the_views_stay_named() -> None:
    view = seen(Plane(), np.eye(4))
    cloud = replace(view.view.cloud, left_out=(LeftOut("f3", "jumps"),))
    for config in (GridMerge(), FusedMerge()):
        assert (
            merge([prepared(cloud, view.inside, None, "v")], [reference()], config).cloud.left_out
            == cloud.left_out
        )


# ---------------------------------------------------------------- triangles


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 1.5), st.integers(1, 3))
def test_triangles_reproduce_what_is_linear(seed: int, step: float, parts: int) -> None:
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:12, :15].astype(float)
    turn = rng.uniform(-0.15, 0.15)  # so that the cells below lie well within the samples
    positions = np.stack(
        [u * np.cos(turn) - v * np.sin(turn), u * np.sin(turn) + v * np.cos(turn)], axis=-1
    )
    positions += 0.2 * rng.uniform(-1, 1, positions.shape)
    slope = rng.uniform(-2, 2, 2)
    values = positions @ slope + 3.0
    grid = CellGrid(1.0, 1.0, step, (int(8 / step), int(8 / step)))
    flat = positions.reshape(1, -1, 2)
    valid = np.ones(v.shape, dtype=bool)
    for where, inside, organised in ((positions, valid, True), (flat, valid.reshape(1, -1), False)):
        result = raster_between(where, inside, organised, step / parts, grid).at_cells(
            values.reshape(-1)
        )
        x, y = grid.places()
        # cells well within; a cell that is covered in part takes the mean of that part
        complete = (x > 3) & (x < 9) & (y > 3) & (y < 7)
        np.testing.assert_allclose(
            result[complete], (slope[0] * x + slope[1] * y + 3.0)[complete], atol=1e-9
        )


def test_cells_beyond_the_samples_are_unknown_and_one_invalid_corner_costs_a_triangle() -> None:
    v, u = np.mgrid[:4, :4].astype(float)
    valid = np.ones((4, 4), dtype=bool)
    valid[0, 0] = False
    grid = CellGrid(-0.25, -0.25, 0.5, (6, 6))
    result = raster_between(np.stack([u, v], axis=-1), valid, True, 0.5, grid).at_cells(
        np.arange(16.0)
    )
    assert np.isnan(result[0]).all() and np.isnan(result[:, 0]).all()
    assert np.isnan(result[1, 1]) and result[2, 2] == pytest.approx(0.75 * 5)


def test_concentration_is_the_variance_of_white_noise() -> None:
    v, u = np.mgrid[:40, :40].astype(float)
    positions = np.stack([u, v], axis=-1)
    rng = np.random.default_rng(0)
    for step in (0.93, 2.1, 2.9):
        grid = CellGrid(3.2, 3.1, step, (int(30 / step), int(30 / step)))
        raster = raster_between(positions, np.ones((40, 40), bool), True, 1.0, grid)
        drawn = raster.at_cells(rng.standard_normal((1600, 400)))
        np.testing.assert_allclose(
            (drawn.var(axis=-1) / raster.concentration).mean(), 1.0, rtol=0.02
        )


# ---------------------------------------------------------------- a view's noise


def noisy_cloud(
    amplitude: np.ndarray | None, frame_sigma_m: np.ndarray, frames: int, seed: int
) -> PreparedView:
    rng = np.random.default_rng(seed)
    view = seen(Plane(), np.eye(4))
    variance = frame_sigma_m**2 * (
        rng.chisquare(frames - 1, frame_sigma_m.shape) / (frames - 1) if frames > 1 else np.nan
    )
    z = frame_sigma_m / np.sqrt(frames) * rng.standard_normal(frame_sigma_m.shape)
    cloud = replace(
        view.view.cloud,
        points_m=view.view.cloud.points_m + np.stack([0 * z, 0 * z, z], axis=-1),
        variance_m2=variance,
        count=np.full(z.shape, frames, dtype=np.int32),
        n_frames=frames,
        amplitude=amplitude,
    )
    return prepared(cloud, view.inside, None, "v")


@pytest.mark.parametrize("frames", [1, 3, 30])
def test_noise_law_by_amplitude(frames: int) -> None:
    across = np.linspace(200.0, 1000.0, 160)[None, :].repeat(120, axis=0)
    sigma = np.hypot(0.4 * MM * 500.0 / across, 0.1 * MM)
    view = noisy_cloud(across, sigma, frames, 1)
    cloud = view.view.cloud
    deviation = cloud.points_m[..., 2] - 0.7
    # damage: a tenth of the target is a hole with wild variances
    deviation[30:66, 20:70] = 10 * MM
    cloud.variance_m2[30:66, 20:70] *= 100.0
    mean, repeated = depth_noise(cloud, view.inside, deviation)
    assert repeated == (frames > 1)
    clean = np.ones(sigma.shape, dtype=bool)
    clean[30:66, 20:70] = False
    ratio = np.sqrt(mean * frames / sigma**2)[clean]
    # a class of 1200 pixels of which a sixth are damaged, one degree of freedom at worst
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)


def test_noise_law_without_amplitude_goes_with_range_to_the_fourth() -> None:
    view = seen(Plane(0.0, 50.0), np.eye(4))
    distance = np.linalg.norm(view.view.cloud.points_m, axis=-1)
    sigma = 0.5 * MM * (distance / 0.7) ** 2
    found = noisy_cloud(None, sigma, 20, 2).view.cloud
    cloud = replace(found, points_m=view.view.cloud.points_m)
    mean, _ = depth_noise(cloud, view.inside, np.full(sigma.shape, np.nan))
    np.testing.assert_allclose(np.sqrt(20 * mean) / sigma, 1.0, atol=0.06)


@pytest.mark.parametrize("frames", [2, 4, 50])
def test_rounding_stays_in_the_mean_where_nothing_dithers_it(frames: int) -> None:
    """Frames that repeat each other scatter by nothing, however many they are: the step's q^2 / 12
    is left."""
    quiet = np.full((120, 160), 1e-9)
    cloud = replace(noisy_cloud(None, quiet, frames, 3).view.cloud, z_step_m=1e-3)
    mean, _ = depth_noise(cloud, cloud.valid, np.full(quiet.shape, np.nan))
    np.testing.assert_allclose(np.sqrt(mean), 1e-3 / np.sqrt(12.0), rtol=0.02)
