"""Odometry: it follows a textured board, drifts, says when it is lost, and sees through the lens's
distortion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from detectors.views.registration.by_points import register_by_odometry
from detectors.views.registration.register import register
from detectors.views.registration.settings import PlainRegistration
from harness.vocabulary.geometry import Lens
from tests.support.board_views import LENS, pose, target_error_m, views

PITCH_M = 0.5 / 300
WALK = [
    pose(2 * np.sin(t), 3 * t, 1.5 * t, (0.004 * t, 0.003 * np.sin(2 * t), 0.004 * t))
    for t in np.arange(5.0)
]


def test_it_follows_a_walk_and_drifts():
    created = views(WALK, noise_m=2e-4, textured=True)
    result = register([each.prepared for each in created], PlainRegistration(method="odometry"))
    errors = [
        np.hypot(*target_error_m(each, created[0], view))
        for each, view in zip(result, created, strict=True)
    ]
    assert not any(each.failure for each in result) and errors[0] == 0.0
    # steps of 3 degrees and 5 mm; without following them the last view would be 24 mm off
    assert max(errors[1:]) < 1.5 * PITCH_M and errors[-1] > errors[1] > 1e-5
    assert all(
        np.isnan(each.covariance).all() and "no covariance" in each.notes[0] for each in result[1:]
    )


def test_the_same_walk_gives_the_same_bits():
    created = [view.prepared for view in views(WALK[:3], noise_m=2e-4, textured=True)]
    first = register_by_odometry(created)
    second = register_by_odometry(created)
    assert [a.T_reference_view.tobytes() for a in first] == [
        b.T_reference_view.tobytes() for b in second
    ]


def test_after_a_view_that_shows_nothing_it_is_lost_for_good():
    created = [view.prepared for view in views(WALK[:4], noise_m=2e-4, textured=True)]
    nothing = np.zeros_like(created[2].inside)
    # only a corner of three pixels is left of the target
    nothing[tuple(np.argwhere(created[2].inside)[:3].T)] = True
    created[2] = replace(created[2], inside=nothing)
    by_odometry = register_by_odometry(created)
    assert [bool(each.failure) for each in by_odometry] == [False, True, True]
    assert all("failed at view 2" in each.failure for each in by_odometry[1:])


def test_distortion_is_taken_out():
    bent = Lens(
        LENS.width,
        LENS.height,
        LENS.fx,
        LENS.fy,
        LENS.cx,
        LENS.cy,
        (0.25, -0.1, 1e-3, -1e-3, 0, 0, 0, 0),
    )
    errors = []
    for lens in (LENS, bent):
        created = views(WALK[:2], noise_m=2e-4, textured=True, lens=lens)
        (result,) = register_by_odometry([each.prepared for each in created])
        errors.append(np.hypot(*target_error_m(result, created[0], created[1])))
    # left in, the distortion shifts the board's corners by 3 pixels
    assert errors[1] < 2 * errors[0] + 0.2 * PITCH_M
