"""The joint adjustment: exact without noise, honest with it, and blind to no error that it claims
to hold."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.views.marks.mark import MarkSet
from detectors.views.registration.by_marks import register_jointly
from detectors.views.registration.registered import Registration, predicted_error_m
from detectors.views.view import PreparedView
from tests.support.board_views import board_view, pose, target_error_m, usual_error, views

POSES = [
    pose(3, 4),
    pose(-6, 15, 2, (0.01, 0.0, 0.01)),
    pose(8, -12, -1, (-0.01, 0.01, 0.0)),
    pose(-2, -5, 4),
]


def across_error(found: Registration, reference, view) -> float:
    return target_error_m(found, reference, view)[1]


def test_without_noise_the_surfaces_meet_to_a_micrometre():
    created = views(POSES, guess_error=usual_error())
    for result, view in zip(
        register_jointly([each.prepared for each in created]), created[1:], strict=True
    ):
        assert not result.failure and result.converged and result.method == "joint"
        assert across_error(result, created[0], view) < 2e-6


def test_across_it_is_better_than_the_marks_where_noise_is_white():
    from detectors.views.registration.by_marks import register_by_marks

    errors = []
    for seed in range(3):
        created = views(POSES[:3], guess_error=usual_error(), noise_m=1e-3, seed=seed)
        joint = register_jointly([each.prepared for each in created])
        for result, view in zip(joint, created[1:], strict=True):
            marks = register_by_marks(created[0].prepared, view.prepared)
            errors.append([across_error(each, created[0], view) for each in (result, marks)])
    # four marks of 180 pixels against 2000 points: sqrt(720 / 2000) = 0.6 for a level, more for
    # tilts, which the marks in the corners hold well
    by_joint, by_marks = np.sqrt(np.mean(np.square(errors), axis=0))
    assert by_joint < 0.9 * by_marks


def smooth_error_repeats(repeats: int) -> np.ndarray:
    """Squared errors across the board over their predicted variance, of views that each have a
    smooth error."""
    poses = [*POSES, pose(5, 9), pose(-7, -3, 2)]
    squares = []
    for seed in range(repeats):
        random = np.random.default_rng(seed)
        errors = random.normal(0, 3e-4, (len(poses), 4, 4)) * (
            np.add.outer(np.arange(4), np.arange(4)) <= 3
        )
        guesses = [poses[0] @ np.linalg.inv(T) for T in poses]
        created = [
            board_view(T, guesses[i], noise_m=2e-4, seed=50 * seed + i, smooth_m=errors[i])
            for i, T in enumerate(poses)
        ]
        for result, view in zip(
            register_jointly([each.prepared for each in created]), created[1:], strict=True
        ):
            _, predicted = predicted_error_m(
                result, created[0].prepared.points_m[::40], created[0].T_camera_board[:3, 2]
            )
            squares.append((across_error(result, created[0], view) / predicted) ** 2)
    return np.array(squares)


@pytest.mark.slow
def test_the_predicted_error_across_holds_smooth_errors_of_views():
    """Each view errs by a cubic, every term with a deviation of 0.3 mm. The mean square error is
    the predicted one within a factor of 2.5: six repeats, each with three terms of the reference
    and fifteen of the others, whose mean is known to a third; a prediction from noise alone would
    be too small by more than a hundred."""
    squares = smooth_error_repeats(6)
    assert 1 / 2.5 < squares.mean() < 2.5


def test_a_view_whose_marks_fail_takes_no_part():
    created = views(POSES[:3], guess_error=usual_error(), noise_m=2e-4)
    good = register_jointly([created[0].prepared, created[2].prepared])[0]
    spoilt = created[1].prepared
    hidden = PreparedView(
        spoilt.view, spoilt.inside, MarkSet((), np.empty(0, int), "no mark found, 3 needed")
    )
    failed, result = register_jointly([created[0].prepared, hidden, created[2].prepared])
    assert "no mark found" in failed.failure and failed.method == "joint"
    np.testing.assert_array_equal(result.T_reference_view, good.T_reference_view)


def test_points_count_as_fewer_than_they_are():
    """The covariance across is that of one independent value in 25 pixels: between that of 1/5 and
    1/50 of them."""
    created = views(POSES[:2], noise_m=1e-3)
    result = register_jointly([each.prepared for each in created])[0]
    _, across = predicted_error_m(
        result, created[0].prepared.points_m[::40], created[0].T_camera_board[:3, 2]
    )
    pixels = created[0].prepared.inside.sum()
    # two views' noise, three unknowns of which each is known to sigma / sqrt(n)
    least = np.sqrt(2 * 3) * 0.001 / np.sqrt(pixels / 5)
    largest = np.sqrt(2 * 3) * 0.001 / np.sqrt(pixels / 50)
    assert least < across < 3 * largest
