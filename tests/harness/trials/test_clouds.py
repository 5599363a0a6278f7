"""Noise of frame pairs, errors of registrations, and maps that points share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.views.mapping.settings import MappingConfig
from detectors.views.registration.registered import Registration
from harness.records.rows import Origin
from harness.trials.board import Board
from harness.trials.clouds import (
    FEWEST_PAIRS,
    MapClouds,
    _probes_row,
    board_grid_m,
    mapping_of,
    pair_noise,
)
from scenes.perspectives import ArcViews
from tests.support.board_in_closed_form import TARGET, board_of, point_of
from tests.support.plain_clouds import cloud_of_points

ORIGIN = Origin(variant="main", frames=5, repeat=2)
MAPPED = replace(point_of(), mapping=MappingConfig(views=2))


def maps_of(board: Board, count: int = 3) -> MapClouds:
    poses = ArcViews(kind="arc", count=count, spread_deg=20.0)
    return MapClouds([board] * count, [{5: object()}] * count, poses, ("damaged", 0))  # type: ignore[list-item]


def test_noise_of_a_pair_is_that_of_one_frame() -> None:
    stream = np.random.default_rng(1)
    shape = (200, 300)
    first, second = 0.7 + 1e-3 * stream.standard_normal((2, *shape))
    noise = pair_noise(first, second + 0.05, np.ones(shape, bool))
    assert noise["single_frame_mm"] == pytest.approx(1.0, rel=0.02)
    others = [value for name, value in noise.items() if name != "single_frame_mm"]
    assert len(others) == 6
    assert np.abs(others).max() < 0.02


def test_correlations_go_along_columns_and_rows() -> None:
    stream = np.random.default_rng(2)
    white = stream.standard_normal((2, 200, 301))
    along_rows = white[..., 1:] + white[..., :-1]
    noise = pair_noise(*along_rows, np.ones((200, 300), bool))
    assert noise["correlation_u1"] == pytest.approx(0.5, abs=0.02)
    assert noise["correlation_u2"] == pytest.approx(0.0, abs=0.02)
    assert noise["correlation_v1"] == pytest.approx(0.0, abs=0.02)
    turned = pair_noise(*np.swapaxes(along_rows, 1, 2), np.ones((300, 200), bool))
    assert turned["correlation_v1"] == pytest.approx(noise["correlation_u1"], abs=1e-12)


def test_noise_counts_valid_pixels_only() -> None:
    stream = np.random.default_rng(3)
    first, second = stream.standard_normal((2, 40, 50))
    where = np.zeros((40, 50), bool)
    where[:, :25] = True
    inside = pair_noise(first[:, :25], second[:, :25], np.ones((40, 25), bool))
    first[:, 30:] = 1e3
    assert pair_noise(first, second, where) == inside
    few = np.zeros((40, 50), bool)
    few.ravel()[: FEWEST_PAIRS - 1] = True
    assert np.isnan(list(pair_noise(first, second, few).values())).all()
    few.ravel()[FEWEST_PAIRS - 1] = True
    noise = pair_noise(first, second, few)
    assert np.isfinite(noise["single_frame_mm"])
    assert np.isnan(noise["correlation_v1"])


def test_errors_of_probes_are_whole_tenths_of_a_micrometre() -> None:
    row = _probes_row(ORIGIN, np.array([1e-3, np.nan, -2.54e-6]))
    assert row.error_tenth_um == [10_000, None, -25]
    assert (row.variant, row.frames, row.repeat) == ("main", 5, 2)


def test_the_points_of_a_registrations_error_cover_the_board() -> None:
    points_m = board_grid_m(board_of())
    assert points_m.shape == (81, 3)
    board = TARGET.board
    np.testing.assert_allclose(
        np.ptp(points_m, axis=0), [board.width_mm * 1e-3, board.height_mm * 1e-3, 0.0]
    )
    np.testing.assert_allclose(points_m.mean(axis=0), 0.0, atol=1e-12)


def test_a_registrations_row_splits_its_error() -> None:
    board = board_of()
    maps = maps_of(board)
    shifted = np.eye(4)
    shifted[:3, 3] = 3e-3, 0.0, 4e-3
    registration = Registration("view 1", "icp", shifted, residual_m=2e-4, overlap=0.9, pairs=44)
    view = type("View", (), {"marks": type("Marks", (), {"trusted": (1, 2, 3)})})
    row = maps._registration_row(1, view, registration, ORIGIN, "damaged")  # type: ignore[arg-type]
    assert row.tre_mm == pytest.approx(5.0)
    assert (row.tre_in_plane_mm, row.tre_across_mm) == pytest.approx((3.0, 4.0))
    assert (row.residual_mm, row.overlap, row.pairs, row.marks) == (0.2, 0.9, 44, 3)
    assert (row.view, row.method, row.failure) == (1, "icp", "")
    assert row.guess_tre_mm > 0


def test_maps_are_shared_by_what_they_depend_on() -> None:
    maps = maps_of(board_of())
    assert maps.count(MAPPED) == 2
    assert maps.count(replace(MAPPED, mapping=MappingConfig())) == 3
    assert maps.key(MAPPED) == maps.key(replace(MAPPED, variant="other"))
    assert maps.key(MAPPED) != maps.key(replace(MAPPED, frames=7))
    assert maps.key(MAPPED) != maps.key(replace(MAPPED, mapping=MappingConfig(views=3)))
    # one view is not registered: the method does not matter
    by_method = []
    for method in ("icp", "marks"):
        data = {"views": 1, "registration": {"method": method}}
        by_method.append(maps.key(replace(MAPPED, mapping=MappingConfig.from_data(data))))
    assert by_method[0] == by_method[1]
    with pytest.raises(ValueError, match="need a mapping"):
        mapping_of(point_of())


def test_the_reference_view_is_nominal_and_others_are_off() -> None:
    maps = maps_of(board_of())
    np.testing.assert_array_equal(maps.guesses[0], np.eye(4))
    for truth in maps.truth:  # all views stand at one pose here
        np.testing.assert_allclose(truth, np.eye(4), atol=1e-12)
    assert not np.allclose(maps.guesses[1], maps.guesses[2])


def test_registrations_are_reported_once_and_not_of_one_view(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = maps_of(board_of())
    views = [type("View", (), {"marks": type("Marks", (), {"trusted": ()})})] * 2
    registered = tuple(Registration(f"view {n}", "icp", np.eye(4)) for n in range(2))
    monkeypatch.setattr(maps, "prepared", lambda point: views)
    monkeypatch.setattr(maps, "registrations", lambda point: registered)
    (row,) = maps.registration_rows(MAPPED, ORIGIN, "damaged")
    assert (row.view, row.tre_mm) == (1, 0.0)
    assert maps.registration_rows(MAPPED, ORIGIN, "damaged") == []
    single = replace(MAPPED, mapping=MappingConfig(views=1))
    assert maps.registration_rows(single, ORIGIN, "damaged") == []


def test_probes_of_a_map_are_those_of_the_first_view(monkeypatch: pytest.MonkeyPatch) -> None:
    board = board_of(damaged=False)
    maps = maps_of(board)
    ticks = np.arange(-80, 81) * 1e-3
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x, y, np.full(x.shape, 0.7 + 2e-3)], axis=-1)
    cloud = replace(cloud_of_points(points), projection="parallel")
    monkeypatch.setattr(maps, "labelled", lambda point: board.labelled_map(cloud, np.eye(4)))
    errors = maps.probes_row(MAPPED, ORIGIN).error_tenth_um
    assert len(errors) == len(board.probes)
    assert set(errors) == {20_000}
