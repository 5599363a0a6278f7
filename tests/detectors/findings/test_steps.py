"""Findings at the steps of a profile, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from detectors.findings.steps import explained_by_steps
from detectors.interface import Detection

SHAPE = (40, 30)
GROOVE = 12  # column


def spread(own_m: float = 1e-3) -> np.ndarray:
    """A profile that is uncertain along one column, and not judged in another."""
    spread_m = np.zeros(SHAPE)
    spread_m[:, GROOVE] = own_m
    spread_m[:, 0] = np.nan
    return spread_m


def found(rows: slice, columns: slice, kind: str = "depth") -> Detection:
    is_found = np.zeros(SHAPE, bool)
    is_found[rows, columns] = True
    return Detection(9.0, np.flatnonzero(is_found), np.zeros(3), kind)  # type: ignore[arg-type]


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("depth_m", "numbers"), [(2.9e-3, (0,)), (3.1e-3, ())])
def test_a_row_is_explained_up_to_three_deviations_of_the_step(
    sign: float, depth_m: float, numbers: tuple[int, ...]
) -> None:
    residual_m = np.zeros(SHAPE)
    residual_m[5:25, GROOVE] = sign * depth_m
    row = found(slice(5, 25), slice(GROOVE - 1, GROOVE + 2))
    assert explained_by_steps(spread(), residual_m, [row], 5.0) == numbers
    assert explained_by_steps(np.zeros(SHAPE), residual_m, [row], 5.0) == ()


def test_damage_beside_a_step_or_across_it_is_not_explained() -> None:
    residual_m = np.full(SHAPE, 2e-3)
    beside = found(slice(5, 15), slice(GROOVE + 2, GROOVE + 8))
    across = found(slice(5, 15), slice(GROOVE - 4, GROOVE + 5))  # 3 of 9 columns lie beside it
    at_step = found(slice(20, 30), slice(GROOVE - 1, GROOVE + 4))  # 3 of 5
    gone = found(slice(20, 30), slice(GROOVE, GROOVE + 1), kind="no return")
    joints = replace(at_step, count=5)
    findings = [beside, across, at_step, gone, joints]
    assert explained_by_steps(spread(), residual_m, findings, 5.0) == (2,)


def test_pixels_beside_a_step_alone_tell_nothing_about_it() -> None:
    residual_m = np.full(SHAPE, 1e-4)
    assert explained_by_steps(spread(), residual_m, [found(slice(5, 9), slice(13, 14))], 5.0) == ()


def test_one_error_of_twenty_pixels_raises_a_score_by_their_root() -> None:
    residual_m = np.zeros(SHAPE)
    residual_m[5:25, GROOVE] = 1e-3
    row = found(slice(5, 25), slice(GROOVE - 1, GROOVE + 2))
    for score, numbers in ((5.0 * 20**0.5 - 0.1, (0,)), (5.0 * 20**0.5 + 0.1, ())):
        at_row = [replace(row, score=score)]
        assert explained_by_steps(spread(), residual_m, at_row, 5.0) == numbers
