"""ICP: known poses, equal bits, and the sliding of flat marks noticed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from detectors.views.marks.mark import MarkSet
from detectors.views.registration.by_points import register_by_icp, stages_m
from detectors.views.registration.registered import predicted_error_m
from detectors.views.registration.settings import IcpRegistration
from detectors.views.view import PreparedView, View
from harness.vocabulary.geometry import Cloud, Region, transform_points
from tests.support.board_views import board_view, pose, target_error_m, usual_error, views

POSES = [pose(3, 4), pose(-6, 15, 2, (0.01, 0.0, 0.01))]
PITCH_M = 0.5 / 300


def wavy_view(
    T_camera_object: np.ndarray, guess: np.ndarray | None, seed: int, noise_m: float
) -> PreparedView:
    """2500 points scattered over a wavy sheet of 0.2 m, without a pixel grid; noise across it."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(-0.1, 0.1, (2, 2500))
    z = (
        0.02 * np.sin(30 * x + 1) * np.cos(25 * y)
        + 0.015 * np.sin(20 * (x + y))
        + noise_m * random.standard_normal(2500)
    )
    points = transform_points(T_camera_object, np.stack([x, y, z], axis=1))[None]
    flat = np.zeros((1, 2500), dtype=np.uint8)
    cloud = Cloud(
        points,
        flat,
        flat + 1,
        np.full((1, 2500), np.nan),
        Region(0, 1, 0, 2500),
        0.0,
        1,
        organised=False,
    )
    return PreparedView(View("wavy", cloud, guess), cloud.valid, MarkSet((), np.empty(0, int)))


def test_a_shaped_target_is_found_from_a_usual_guess():
    """Points lie 4 mm apart, which pulls at the result."""
    T = usual_error()
    reference = wavy_view(pose(), np.eye(4), 0, 2e-4)
    view = wavy_view(pose(5, -8), pose() @ np.linalg.inv(pose(5, -8)) @ T, 1, 2e-4)
    by_icp = register_by_icp(reference, view, IcpRegistration(points="target"))
    wrong = by_icp.T_reference_view @ np.linalg.inv(pose() @ np.linalg.inv(pose(5, -8)))
    moved = transform_points(wrong, by_icp.centre_m) - by_icp.centre_m
    turn = Rotation.from_matrix(wrong[:3, :3]).magnitude()
    assert np.linalg.norm(moved) < 1.5e-3 and turn * 0.1 < 1.5e-3
    assert not by_icp.failure and by_icp.converged and by_icp.pairs > 2400


def test_flat_marks_come_as_near_as_point_to_point_can():
    """It stops at one of many near minima, 0.7 to 2.6 mm off in the plane; the guess is 15 mm off."""
    reference, view = views(POSES, guess_error=usual_error(), noise_m=3e-4)
    by_icp = register_by_icp(reference.prepared, view.prepared, IcpRegistration())
    within, across = target_error_m(by_icp, reference, view)
    assert within < 3e-3 and across < 0.2 * PITCH_M
    predicted = predicted_error_m(
        by_icp, reference.prepared.points_m[::50], reference.T_camera_board[:3, 2]
    )
    assert 0.05e-3 < predicted[0] < 2 * PITCH_M and 1e-6 < predicted[1] < 0.2 * PITCH_M


def test_the_same_views_give_the_same_bits():
    reference, view = views(POSES, guess_error=usual_error(), noise_m=3e-4)
    first, second = (
        register_by_icp(reference.prepared, view.prepared, IcpRegistration()) for _ in range(2)
    )
    assert first.T_reference_view.tobytes() == second.T_reference_view.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_without_a_guess_it_starts_at_the_reference_and_says_so():
    reference = wavy_view(pose(), np.eye(4), 0, 0.0)
    blind = wavy_view(pose(2, 3, 0, (0.004, 0.0, 0.0)), None, 0, 0.0)
    by_icp = register_by_icp(reference, blind, IcpRegistration(points="target"))
    assert "no guess" in by_icp.notes[0]
    np.testing.assert_allclose(
        by_icp.T_reference_view @ pose(2, 3, 0, (0.004, 0.0, 0.0)), pose(), atol=1e-6
    )


def test_too_few_fiducial_points_are_a_failure_in_words():
    reference = board_view(POSES[0], np.eye(4)).prepared
    bare = board_view(POSES[1], np.eye(4), tapes_m=()).prepared
    by_icp = register_by_icp(reference, bare, IcpRegistration())
    assert by_icp.failure == (
        "too few points of the fiducial colour: 730 in the reference and 0 in the view, 3 "
        "needed in each"
    )
    assert np.isnan(by_icp.covariance).all()


def test_nothing_in_reach_is_a_failure():
    far = np.eye(4)
    far[0, 3] = 5.0
    reference, view = views(POSES, guess_error=far)
    assert (
        "no pairs" in register_by_icp(reference.prepared, view.prepared, IcpRegistration()).failure
    )


def test_the_stages_go_from_the_guess_error_down_to_three_pixels():
    # 2 (10 mm + 3 degrees at 0.3 m), halved until below 6 mm
    assert stages_m(0.002, 0.3) == pytest.approx(
        (0.0514159, 0.0257080, 0.0128540, 0.0064270, 0.006), rel=1e-5
    )
    assert stages_m(0.02, 0.0) == pytest.approx((0.06,))
