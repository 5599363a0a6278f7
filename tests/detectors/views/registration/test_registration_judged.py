"""`register`: every way in which a registration fails is noticed and said; users' mistakes are
refused."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from detectors.rigid_motion import displacement_jacobian
from detectors.views.registration.register import judge, register
from detectors.views.registration.registered import (
    Registration,
    predicted_error_m,
    sampling_of,
    still_moving,
)
from detectors.views.registration.settings import (
    AnyRegistration,
    CpdRegistration,
    IcpRegistration,
    PlainRegistration,
)
from detectors.views.view import PreparedView, View
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Lens
from tests.support.board_views import TAPES_M, board_view, pose, target_error_m, usual_error, views

POSES = [pose(3, 4), pose(-6, 15, 2, (0.01, 0.0, 0.01)), pose(8, -12, -1, (-0.01, 0.01, 0.0))]
NOISE_M = 3e-4
PITCH_M = 0.5 / 300
BY_MARKS: list[AnyRegistration] = [
    PlainRegistration(method="marks"),
    CpdRegistration(),
    PlainRegistration(method="joint"),
]
SLOW_CPD = pytest.param(
    CpdRegistration(), marks=pytest.mark.slow
)  # test_registration_cpd has its own


def prepared(made) -> list[PreparedView]:
    return [each.prepared for each in made]


def changed(view: PreparedView, **cloud) -> PreparedView:
    """The view with other fields of its cloud."""
    return PreparedView(
        replace(view.view, cloud=replace(view.view.cloud, **cloud)), view.inside, view.marks
    )


@pytest.mark.parametrize(
    "config", [*BY_MARKS[::2], IcpRegistration(), SLOW_CPD], ids=lambda config: config.method
)
def test_good_views_are_registered_and_nothing_is_said(config):
    created = views(POSES, guess_error=usual_error(), noise_m=NOISE_M)
    reference, *result = register(prepared(created), config)
    np.testing.assert_array_equal(reference.T_reference_view, np.eye(4))
    assert reference.overlap == 1.0 and not reference.covariance.any()
    for each, view, expected in zip(result, created[1:], ("view 1", "view 2"), strict=True):
        assert (each.view, each.method, each.failure) == (expected, config.method, "")
        within, across = target_error_m(each, created[0], view)
        assert (
            within < (2.0 if config.method == "icp" else 0.5) * PITCH_M and across < 0.3 * PITCH_M
        )
        assert each.overlap > 0.9 and each.seconds > 0


def test_one_view_is_its_own_reference():
    (only,) = register(prepared(views(POSES[:1])), CpdRegistration())
    assert only.failure == "" and only.converged


def test_no_views_are_refused():
    with pytest.raises(UserError, match="no views"):
        register([], PlainRegistration(method="marks"))


# ------------------------------------------------------------ failures, in words


def only_failure(made, config: AnyRegistration) -> str:
    return register(prepared(made), config)[1].failure


def test_views_that_do_not_overlap():
    away = np.eye(4)
    away[0, 3] = 0.29
    created = views(POSES[:2])
    moved = View(
        "view 1",
        created[1].prepared.view.cloud,
        away @ created[1].prepared.view.T_reference_view_guess,
    )
    side = PreparedView(moved, created[1].prepared.inside, created[1].prepared.marks)
    failure = register([created[0].prepared, side], PlainRegistration(method="nominal"))[1].failure
    assert "the views do not overlap" in failure and "%" in failure


def test_other_marks_on_the_other_target():
    reference = board_view(POSES[0], np.eye(4), noise_m=NOISE_M)
    remaining = tuple((x * 0.5, y * 0.6) for x, y in TAPES_M)
    guess = POSES[0] @ np.linalg.inv(POSES[1])
    other = board_view(POSES[1], guess, noise_m=NOISE_M, tapes_m=remaining)
    assert "do not coincide" in only_failure(
        [reference, other], IcpRegistration()
    ) or "no pairs" in only_failure([reference, other], IcpRegistration())
    assert "do not coincide" in only_failure([reference, other], CpdRegistration())
    assert only_failure([reference, other], PlainRegistration(method="marks"))


def test_a_target_of_another_shape_lies_apart():
    bent = np.zeros((4, 4))
    bent[2, 0] = 0.012
    reference = board_view(POSES[0], np.eye(4), noise_m=NOISE_M)
    other = board_view(POSES[1], POSES[0] @ np.linalg.inv(POSES[1]), noise_m=NOISE_M, smooth_m=bent)
    result = register(prepared([reference, other]), CpdRegistration())[1]
    assert "apart" in result.failure and "different targets" in result.failure


FINE = Lens(440, 320, 600.0, 600.0, 219.5, 159.5)
"""Pixels of 0.83 mm on the board: finer than what a real camera's views disagree by."""


@cache
def fine_pair(bend_mm: float, seed: int = 0):
    """Make two views through fine pixels; the second errs as a whole by a bend."""
    smooth = np.zeros((4, 4))
    smooth[2, 0], smooth[0, 2] = 1e-3 * bend_mm, -0.7e-3 * bend_mm
    reference = board_view(POSES[0], np.eye(4), noise_m=NOISE_M, lens=FINE, seed=2 * seed)
    guess = POSES[0] @ np.linalg.inv(POSES[1])
    return reference, board_view(
        POSES[1], guess, noise_m=NOISE_M, lens=FINE, seed=2 * seed + 1, smooth_m=smooth
    )


@pytest.mark.parametrize("config", [*BY_MARKS[::2], SLOW_CPD], ids=lambda config: config.method)
def test_views_that_differ_by_their_own_smooth_errors_are_merged_with_a_note(config):
    exact = fine_pair(0.0)
    bent = fine_pair(1.2)
    result = register(prepared(bent), config)[1]
    plain = register(prepared(exact), config)[1]
    assert result.failure == plain.failure == ""
    assert not any("beyond what noise explains" in note for note in plain.notes)
    normal = bent[0].T_camera_board[:3, 2]
    points = bent[0].prepared.points_m
    wider = predicted_error_m(result, points, normal)[1]
    narrow = predicted_error_m(plain, points, normal)[1]
    assert wider > 3 * narrow
    if config.method != "joint":  # whose covariance holds such errors already
        assert any("the covariance is widened" in note for note in result.notes)
        # root mean square of the bend over the board is 0.7 mm, of which a turn cannot take
        # anything
        assert 0.3e-3 < wider < 1.2e-3


def test_views_whose_errors_would_blur_the_map_are_refused():
    result = register(prepared(fine_pair(9.0)), PlainRegistration(method="marks"))[1]
    assert "which would blur the map (up to" in result.failure


@pytest.mark.slow
def test_the_widened_covariance_holds_the_true_errors():
    """Random bends: true errors across over predicted ones, of 12 pairs, as chi square with 12
    degrees."""
    random = np.random.default_rng(5)
    ratios = []
    for seed in range(12):
        pair = fine_pair(1.2 * random.standard_normal(), seed)
        result = register(prepared(pair), PlainRegistration(method="marks"))[1]
        assert result.failure == ""
        _, predicted = predicted_error_m(
            result, pair[0].prepared.points_m, pair[0].T_camera_board[:3, 2]
        )
        ratios.append(target_error_m(result, *pair)[1] / predicted)
    # chi square of 12 degrees lies below 32.9 with a probability of 0.999: the covariance may be
    # cautious, not too sure
    assert np.sum(np.square(ratios)) < 32.9


def test_a_wrong_guess_turns_the_board_about():
    twins = ((-0.1, 0.06), (0.1, 0.06), (-0.1, -0.06), (0.1, -0.06))
    reference = board_view(POSES[0], np.eye(4), noise_m=NOISE_M, tapes_m=twins)
    guess = POSES[0] @ np.linalg.inv(POSES[1])
    other = board_view(POSES[1], guess, noise_m=NOISE_M, tapes_m=twins)
    half_turn = POSES[0] @ np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(POSES[1])
    turned = register(
        [reference.prepared, replace_guess(other.prepared, half_turn)], CpdRegistration()
    )[1]
    # the twin fits as well, and nothing in the clouds tells: what the guess says is what is
    # believed
    assert not turned.failure and target_error_m(turned, reference, other)[0] > 0.1
    judged = judge(turned, reference.prepared, other.prepared)
    assert judged.failure.startswith("is 180 degrees and ")


def replace_guess(view: PreparedView, guess: np.ndarray | None) -> PreparedView:
    return PreparedView(replace(view.view, T_reference_view_guess=guess), view.inside, view.marks)


def test_points_on_a_line_leave_a_turn_open():
    created = views(POSES[:2], noise_m=NOISE_M)
    result = register(prepared(created), PlainRegistration(method="marks"))[1]
    open_turn = np.diag([0.2**2, 1e-8, 1e-8, 1e-8, 1e-8, 1e-8])
    judged = judge(replace(result, covariance=open_turn), created[0].prepared, created[1].prepared)
    assert "lie on a line" in judged.failure and "which would blur" in judged.failure
    slides = np.diag([1e-8, 1e-8, 1e-8, 0.01**2, 1e-8, 1e-8])
    judged = judge(replace(result, covariance=slides), created[0].prepared, created[1].prepared)
    assert "not determined: the points let the target slide" in judged.failure


@pytest.mark.parametrize("broken", [np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)])
def test_a_mirror_image_or_nothing_is_no_registration(broken):
    created = views(POSES[:2])
    result = register(prepared(created), PlainRegistration(method="marks"))[1]
    judged = judge(
        replace(result, T_reference_view=broken), created[0].prepared, created[1].prepared
    )
    assert judged.failure in (
        "mirrored: the transform is a reflection, not a rotation",
        "no transform was found",
    )


def test_an_iteration_that_still_moves_has_failed():
    assert still_moving(0.4e-3, 1e-3) == ""
    assert "0.60 mm" in still_moving(0.6e-3, 1e-3)


def test_one_bad_view_does_not_spoil_the_others():
    created = views(POSES, guess_error=usual_error(), noise_m=NOISE_M)
    hidden = board_view(POSES[1], None, tapes_m=TAPES_M[:1]).prepared
    for config in BY_MARKS[:1] + BY_MARKS[2:]:
        _, bad, good = register([created[0].prepared, hidden, created[2].prepared], config)
        assert "3 needed" in bad.failure and good.failure == ""


def test_what_nominal_leaves_is_noted_and_not_refused():
    created = views(POSES, guess_error=usual_error(), noise_m=NOISE_M)
    result = register(prepared(created), PlainRegistration(method="nominal"))[1]
    assert result.failure == "" and "apart" in result.notes[-1]
    np.testing.assert_array_equal(
        result.T_reference_view, created[1].prepared.view.T_reference_view_guess
    )


# ------------------------------------------------------------ users' mistakes


@pytest.mark.parametrize(
    "config", [*BY_MARKS, IcpRegistration(), PlainRegistration(method="odometry")]
)
def test_a_capture_without_colour_is_refused_where_colour_is_needed(config):
    created = prepared(views(POSES[:2]))
    with pytest.raises(UserError, match=r"view 1: registration by \w+ needs colour"):
        register([created[0], changed(created[1], rgb=None)], config)


def test_odometry_needs_a_lens_and_nominal_a_guess():
    created = prepared(views(POSES[:2]))
    with pytest.raises(UserError, match="needs a pixel grid and the lens"):
        register([created[0], changed(created[1], lens=None)], PlainRegistration(method="odometry"))
    with pytest.raises(UserError, match="needs the nominal pose of every view"):
        register([created[0], replace_guess(created[1], None)], PlainRegistration(method="nominal"))


# ------------------------------------------------------------ the yardstick


@pytest.mark.parametrize("noise_m", [2e-4, 2e-3])
def test_pitch_and_noise_are_those_of_the_view(noise_m):
    view = board_view(pose(), None, noise_m=noise_m).prepared
    sampling = sampling_of(view)
    assert sampling.pitch_m == pytest.approx(PITCH_M, rel=0.02)
    assert sampling.noise_m == pytest.approx(noise_m, rel=0.05)
    np.testing.assert_allclose(sampling.normal, [0, 0, -1], atol=5e-3)
    grid_free = changed(
        view,
        points_m=view.points_m[None],
        organised=False,
        reason=np.zeros((1, view.inside.sum()), np.uint8),
        count=np.ones((1, view.inside.sum()), int),
    )
    loose = PreparedView(grid_free.view, np.ones((1, view.inside.sum()), bool), view.marks)
    assert sampling_of(loose).noise_m == pytest.approx(noise_m, rel=0.15)
    assert sampling_of(loose).pitch_m == pytest.approx(
        np.hypot(PITCH_M, 0), rel=0.25 if noise_m < PITCH_M else 2
    )


def test_the_predicted_error_is_the_jacobians():
    """Monte Carlo of small errors (w, t) from the covariance, moved over points: rms within and
    across a plane."""
    random = np.random.default_rng(0)
    root = random.standard_normal((6, 6)) * 1e-3
    points = random.standard_normal((20, 3))
    centre = np.array([0.1, 0.2, 0.3])
    normal = np.array([0.6, 0.0, 0.8])
    registration = Registration("", "", np.eye(4), root @ root.T, centre, 0.0, 1.0, 0, 0, True, 0.0)
    motions = random.standard_normal((20000, 6)) @ root.T
    errors = np.cross(motions[:, None, :3], points - centre) + motions[:, None, 3:]
    np.testing.assert_allclose(
        errors[0], displacement_jacobian(points, centre) @ motions[0], atol=1e-12
    )
    across = np.sqrt(np.mean((errors @ normal) ** 2))
    within = np.sqrt(np.mean(np.sum(errors**2, axis=2)) - across**2)
    assert predicted_error_m(registration, points, normal) == pytest.approx(
        (within, across), rel=0.03
    )
