"""The truth on a board's pixels, from a view in closed form and from hand-made clouds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from harness.trials import board as boards
from harness.trials.board import (
    FEWEST_PROBES,
    INTACT_MARGIN_PX,
    PROBES,
    Board,
    _ticks_m,
    board_places_m,
    face_errors_m,
    far_from,
    load_board,
    outlined,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Region
from scenes.target.custom import TargetConfig
from scenes.target.truth import truth_of
from tests.support.board_in_closed_form import (
    BACKING_M,
    CAMERA,
    DISTANCE_M,
    HOLE_MM,
    TARGET,
    board_of,
    reference_of,
)


@pytest.fixture(scope="module")
def board() -> Board:
    return board_of()


def test_central_rays_meet_the_face_where_the_lens_says(board: Board) -> None:
    slopes = board.unit.view.slopes[board.unit.cut]
    expected_m = slopes * DISTANCE_M * [1.0, -1.0]  # y points up on the board
    np.testing.assert_allclose(board.on_face_m[..., :2], expected_m, atol=1e-9)
    np.testing.assert_allclose(board.on_face_m[..., 2], 0.0, atol=1e-12)
    assert board.on_board.all()


def test_pixels_off_the_board_have_no_place() -> None:
    small = TARGET.model_copy(
        update={"board": TARGET.board.model_copy(update={"width_mm": 60.0, "height_mm": 50.0})}
    )
    board = replace(board_of(), target=small)
    x_m, y_m = np.moveaxis(board.board_xy_m[board.on_board], -1, 0)
    pitch_m = np.array(board.pitch_mm) * MM
    assert 0.03 - pitch_m[0] < np.abs(x_m).max() < 0.03
    assert 0.025 - pitch_m[1] < np.abs(y_m).max() < 0.025
    assert np.isnan(board.on_face_m[~board.on_board]).all()


def test_a_hole_is_outlined_by_the_pixels_that_see_into_it(board: Board) -> None:
    x_m, y_m = np.moveaxis(board.board_xy_m, -1, 0)
    inside = np.hypot(x_m - 8e-3, y_m + 4e-3) < HOLE_MM / 2 * MM
    np.testing.assert_array_equal(board.outlines[7], np.flatnonzero(inside))
    # a hole between the pixels has the nearest one
    (hole,) = board.truth
    places_m = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0]), axis=-1)
    assert outlined([hole], places_m)[7].tolist() == [0]
    assert outlined([hole], places_m[:, ::-1])[7].tolist() == [1]


def test_the_depth_that_is_seen_is_that_of_the_floor(board: Board) -> None:
    assert board.seen_depth_m[7] == pytest.approx(BACKING_M, abs=1e-6)
    seen_z_m = np.full(board.on_board.shape, DISTANCE_M)
    pixels = board.outlines[7]
    seen_z_m.ravel()[pixels] += 4e-3  # walls
    seen_z_m.ravel()[pixels[:9]] += np.linspace(7.5e-3, 8e-3, 9)
    walled = replace(board)
    vars(walled)["seen_z_m"] = seen_z_m
    assert walled.seen_depth_m[7] == pytest.approx(11.75e-3)


def test_raised_damage_is_seen_before_the_face() -> None:
    (hole,) = board_of().truth
    raised = replace(board_of(), truth=(replace(hole, raised=True),))
    seen_z_m = np.full(raised.on_board.shape, DISTANCE_M)
    seen_z_m.ravel()[raised.outlines[7]] -= 3e-3
    vars(raised)["seen_z_m"] = seen_z_m
    assert raised.seen_depth_m[7] == pytest.approx(-3e-3)
    vars(raised)["seen_z_m"] = np.full(seen_z_m.shape, np.nan)
    del vars(raised)["seen_depth_m"]
    assert np.isnan(raised.seen_depth_m[7])


def test_what_is_intact_lies_away_from_rim_and_hole(board: Board) -> None:
    rows, columns = np.nonzero(board.bare)
    h, w = board.on_board.shape
    assert (rows.min(), rows.max()) == (INTACT_MARGIN_PX, h - 1 - INTACT_MARGIN_PX)
    assert (columns.min(), columns.max()) == (INTACT_MARGIN_PX, w - 1 - INTACT_MARGIN_PX)
    hole_rows, hole_columns = np.unravel_index(board.outlines[7], (h, w))
    row = hole_rows[0]
    column = hole_columns[0]
    assert not board.intact[row, column - INTACT_MARGIN_PX]
    assert board.intact[row, hole_columns.min() - INTACT_MARGIN_PX - 1]
    assert board.bare[row, column]


def test_probes_are_spread_over_intact_pixels(board: Board) -> None:
    assert board.intact.ravel()[board.probes].all()
    assert len(board.probes) == PROBES
    assert len(set(np.diff(board.probes[:10]).tolist())) <= 2
    crowded = replace(board)
    vars(crowded)["intact"] = np.zeros(board.intact.shape, bool)
    vars(crowded)["intact"].ravel()[: FEWEST_PROBES - 1] = True
    assert crowded.bare.ravel()[crowded.probes].all()
    assert len(crowded.probes) == PROBES


def test_a_board_without_intact_face_uses_the_bare_face_if_it_has_no_damage() -> None:
    cloud = SimpleNamespace()
    for damaged in (True, False):
        board = board_of(damaged=damaged)
        assert board.labelled(cloud).undamaged is board.intact  # type: ignore[arg-type]
        vars(board)["intact"] = np.zeros(board.intact.shape, bool)
        expected = board.intact if damaged else board.bare
        assert board.labelled(cloud).undamaged is expected  # type: ignore[arg-type]


def map_over(board: Board, half_mm: float, step_mm: float = 2.0) -> tuple[Cloud, np.ndarray]:
    """A parallel map of the face with cells of a step, and its frame in the camera's."""
    ticks = np.arange(-half_mm, half_mm + 1e-9, step_mm) * MM
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x, y, np.full(x.shape, 0.5)], axis=-1)
    zeros = np.zeros(x.shape, np.uint8)
    cloud = Cloud(
        points_m=points,
        reason=zeros,
        count=zeros.astype(int),
        variance_m2=np.full(x.shape, np.nan),
        region=Region(0, len(ticks), 0, len(ticks)),
        z_step_m=0.0,
        n_frames=1,
        projection="parallel",
    )
    T_board_map = np.diag([1.0, -1.0, -1.0, 1.0])
    T_board_map[2, 3] = 0.5
    return cloud, board.T_camera_board @ T_board_map


def test_a_map_of_little_face_uses_the_bare_face_if_it_has_no_damage() -> None:
    for damaged in (True, False):
        board = board_of(damaged=damaged)
        margin_mm = INTACT_MARGIN_PX * max(board.pitch_mm)
        cloud, T_reference_cloud = map_over(board, 6.0)  # all within the margin of the hole
        labelled = board.labelled_map(cloud, T_reference_cloud)
        assert labelled.undamaged.any() != damaged
        wide, T_reference_cloud = map_over(board, 60.0)
        labelled = board.labelled_map(wide, T_reference_cloud)
        x_m, y_m = np.moveaxis(labelled.places_m[labelled.undamaged], -1, 0)
        distance_mm = np.hypot(x_m - 8e-3, y_m + 4e-3) / MM
        limit_mm = HOLE_MM / 2 + margin_mm
        assert limit_mm < distance_mm.min() < limit_mm + 2.0


def test_errors_of_a_face_count_where_the_cloud_has_points(board: Board) -> None:
    cloud, T_reference_cloud = map_over(board, 60.0)
    cloud.points_m[..., 2] += 1e-3  # the map looks down on the face
    cloud.points_m[0, 0, 2] = -1.0  # far behind the face
    labelled = board.labelled_map(cloud, T_reference_cloud)
    places_m = np.array([[0.0, 0.0], [0.0649, 0.0], [0.067, 0.0]])
    errors_m = face_errors_m(labelled, places_m)
    np.testing.assert_allclose(errors_m[:2], 1e-3, atol=1e-12)
    assert np.isnan(errors_m[2])
    cloud.points_m[..., 2] = -1.0
    assert np.isnan(face_errors_m(labelled, places_m)).all()


def test_empty_columns_of_a_map_have_places_too(board: Board) -> None:
    cloud, T_reference_cloud = map_over(board, 10.0)
    whole = board.labelled_map(cloud, T_reference_cloud).places_m
    cloud.points_m[:, [0, 4]] = np.nan
    cloud.points_m[3] = np.nan
    np.testing.assert_allclose(
        board_places_m(cloud, np.diag([1.0, -1.0, -1.0, 1.0])), whole, atol=1e-12
    )
    single = np.full((2, 3), np.nan)
    single[1, 1] = 5.0
    assert _ticks_m(single).tolist() == [5.0, 5.0, 5.0]


def test_places_far_from_all_damage() -> None:
    target = TargetConfig.from_data(
        {**TARGET.to_data(), "holes": [{"id": 1, "diameter_mm": 10, "centre_mm": [0, 0]}]}
    )
    truth = truth_of(target, target.pose.T_camera_board)
    places_m = np.array([[[0.0069, 0.0], [0.0071, 0.0], [0.0, -0.0071]]])
    assert far_from(truth, places_m, 0.002).tolist() == [[False, True, True]]
    assert far_from((), places_m, 0.002).all()


def test_boards_that_a_view_shows_alike_share_the_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is not damaged shows nothing of the damage that was left out."""
    shown = board_of(damaged=False)
    monkeypatch.setattr(boards, "_kept", type(boards._kept)())
    ref = reference_of(shown)
    data = ref.target.to_data()
    wider = TargetConfig.from_data({**data, "holes": [{**data["holes"][0], "diameter_mm": 30.0}]})
    other = load_board(replace(ref, target=wider))
    assert other.unit is shown.unit
    assert [damage.diameter_m for damage in other.truth] == [0.030]
    read = []
    monkeypatch.setattr(boards, "read_view", lambda path: read.append(path) or shown.unit.view)
    other_camera = ref.camera.model_copy(update={"unit_seed": 2})
    assert load_board(replace(ref, camera=other_camera)).unit.config == other_camera
    assert load_board(replace(ref, view_path="another")).unit is not shown.unit
    assert len(read) == 2


def test_boards_are_kept_up_to_a_number_and_a_size(monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def loaded(ref: boards.BoardRef) -> Board:
        made.append(ref.view_path)
        view = SimpleNamespace(phasor=np.zeros(1000))
        return Board(SimpleNamespace(view=view), True, (), TARGET, np.eye(4))  # type: ignore[arg-type]

    monkeypatch.setattr(boards, "_loaded", loaded)
    monkeypatch.setattr(boards, "_kept", type(boards._kept)())
    monkeypatch.setattr(boards, "KEPT", 3)
    refs = [boards.BoardRef(str(number), CAMERA, TARGET, True) for number in range(5)]
    for number in (0, 1, 2, 0, 3):
        load_board(refs[number])
    assert made == ["0", "1", "2", "3"]
    assert [ref.view_path for ref in boards._kept] == ["2", "0", "3"]
    monkeypatch.setattr(boards, "KEPT_BYTES", 16_000)  # two views of 8,000
    load_board(refs[4])
    assert [ref.view_path for ref in boards._kept] == ["3", "4"]
    monkeypatch.setattr(boards, "KEPT_BYTES", 1)
    load_board(refs[0])
    assert [ref.view_path for ref in boards._kept] == ["0"]


def test_a_view_that_is_missing_is_refused() -> None:
    with pytest.raises(UserError, match="missing or damaged"):
        load_board(replace(reference_of(board_of()), view_path="nowhere.npz"))
