"""Pictures that moved across the image between two frames, and those that did not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from detectors.averages.moved import displacement_px, motion_doubt
from harness.testing.synthetic_clouds import plane
from harness.vocabulary.geometry import Frame, LeftOut

SHAPE = (180, 240)
HOLES = ((40, 50), (90, 180), (130, 70), (60, 120))


def picture(seed: int, across: int = 0, down: int = 0, holes: Any = HOLES) -> np.ndarray:
    """A tilted plane with holes of 7 pixels' radius, 4 mm deep, displaced by so many pixels."""
    rows, columns = np.indices(SHAPE)
    z_m = 0.5 + 2e-4 * (rows - down) + 1e-4 * (columns - across)
    for row, column in holes:
        z_m += 4e-3 * (np.hypot(rows - down - row, columns - across - column) < 7)
    return np.asarray(z_m + 5e-4 * np.random.default_rng(seed).standard_normal(SHAPE))


@pytest.mark.parametrize("moved_px", [(12, 4), (-9, 0), (0, -20)])
def test_a_picture_that_moved_is_told_with_its_displacement(moved_px: tuple[int, int]) -> None:
    across, down = moved_px
    assert displacement_px(picture(1), picture(2, across, down), 1e-3) == moved_px


def test_a_picture_that_stays_is_not() -> None:
    assert displacement_px(picture(1), picture(2), 1e-3) is None
    # the mean of a camera that warms up drifts, and missing pixels come and go
    drifted = picture(2) + 3e-3
    drifted[np.random.default_rng(3).random(SHAPE) < 0.01] = np.nan
    assert displacement_px(picture(1), drifted, 1e-3) is None


def test_noise_alone_does_not_tell() -> None:
    assert displacement_px(picture(1, holes=()), picture(2, holes=()), 1e-3) is None


def test_steps_of_rounding_that_drift_do_not_tell() -> None:
    """On a tilted surface without noise, contours of whole millimetres move by five columns."""
    columns = np.indices(SHAPE)[1]
    surface_m = 0.5 + 1e-4 * columns
    first, last = [np.round(surface_m + drift_m, 3) for drift_m in (0.0, 5e-4)]
    assert displacement_px(first, last, 1e-3) is None


def frame_of(name: str, z_m: np.ndarray) -> Frame:
    return Frame(name, z_m.astype(np.float32), np.zeros(SHAPE, np.uint8))


def test_the_warning_names_the_first_and_the_last_frame_used() -> None:
    frames = [frame_of("a", picture(1)), frame_of("b", picture(2)), frame_of("c", picture(3, 12))]
    cloud = replace(plane(seed=1), n_frames=3)
    text = motion_doubt(frames, cloud, 1e-3)
    assert text.startswith("the picture moved by 12 pixels from a to c:")
    without_last = replace(cloud, n_frames=2, left_out=(LeftOut("c", "disturbed"),))
    assert motion_doubt(frames, without_last, 1e-3) == ""
    assert motion_doubt(frames[:1], replace(cloud, n_frames=1), 1e-3) == ""
