"""Measured noise before the rounding of the stored depth; dropouts; edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from harness.programs.camera import measure
from harness.programs.camera.measure import StillCapture
from harness.vocabulary.geometry import MM, Lens
from scenes.closed_form import Plane

STEP_M = 1.0 * MM
LENS = Lens(120, 90, 100.0, 100.0, 60.0, 45.0)


def still(z_m: np.ndarray, **changes: Any) -> StillCapture:
    """A capture of a scene without a flat surface."""
    facts: dict[str, Any] = {
        "name": "still",
        "lens": LENS,
        "z_m": z_m.astype(np.float32),
        "slopes": np.zeros((*z_m.shape[1:], 2)),
        "amplitude": None,
        "step_m": 0.0,
        "planes": (),
        "used": np.ones(z_m.shape[1:], bool),
        **changes,
    }
    return StillCapture(**facts)


def noisy(noise_m: np.ndarray) -> np.ndarray:
    """Frames of a slope, so that all phases of the rounding occur, in whole steps."""
    ramp_m = np.linspace(0.95, 1.0, noise_m[0].size).reshape(noise_m[0].shape)
    return np.round((ramp_m + noise_m) / STEP_M) * STEP_M


def variance_after_rounding(sigma_steps: float) -> float:
    """Variance of rounded normal numbers in squared steps, averaged over the rounding's phases."""
    phases = (np.arange(64) + 0.5) / 64
    integers = np.arange(-30, 31)
    upper = stats.norm.cdf((integers + 0.5 - phases[:, None]) / sigma_steps)
    lower = stats.norm.cdf((integers - 0.5 - phases[:, None]) / sigma_steps)
    probability = upper - lower
    mean = probability @ integers
    return float((probability @ integers**2 - mean**2).mean())


@pytest.mark.parametrize("sigma_steps", [0.25, 0.4, 0.7, 1.5])
def test_rounding_is_taken_out_of_a_variance(sigma_steps: float) -> None:
    after_m2 = variance_after_rounding(sigma_steps) * STEP_M**2
    before_m2 = measure.before_rounding_m2(after_m2, STEP_M)
    assert before_m2 == pytest.approx((sigma_steps * STEP_M) ** 2, rel=0.01)


def test_numbers_that_are_not_rounded_keep_their_variance() -> None:
    assert measure.before_rounding_m2(0.3, 0.0) == 0.3
    assert measure.before_rounding_m2(101.0, 1.0) == 101.0
    assert measure.before_rounding_m2(99.0, 1.0) == pytest.approx(99.0 - 1 / 12)


def test_the_noise_of_cells_is_that_before_rounding() -> None:
    """Half a step of noise: with rounding, it would be 15 % more."""
    noise_m = np.random.default_rng(1).normal(0.0, 0.5 * STEP_M, (60, 90, 120))
    capture = still(noisy(noise_m), step_m=STEP_M)
    cells = list(measure.cells_of(capture))
    sigma_m = np.average([cell.sigma_m for cell in cells], weights=[cell.pixels for cell in cells])
    assert sigma_m == pytest.approx(0.5 * STEP_M, rel=0.01)


def test_noise_along_the_ray_is_larger_than_along_the_axis() -> None:
    noise_m = np.random.default_rng(2).normal(0.0, 2e-3, (60, 90, 120))
    slopes = np.broadcast_to([0.75, 0.0], (90, 120, 2))
    capture = still(1.0 + noise_m, slopes=slopes)
    (cell,) = measure.cells_of(capture)
    assert cell.sigma_m == pytest.approx(1.25 * 2e-3, rel=0.01)
    assert cell.range_m == pytest.approx(1.25, rel=1e-3)


def test_correlations_are_those_before_rounding() -> None:
    """Neighbours along x share half of their noise; rounding alone would make that 0.38."""
    white = np.random.default_rng(3).normal(0.0, 0.5 * STEP_M, (16, 90, 121))
    noise_m = (white[..., 1:] + white[..., :-1]) / np.sqrt(2)
    capture = still(noisy(noise_m), step_m=STEP_M)
    along_x, along_y = measure.correlations(capture)
    assert along_x[:3] == pytest.approx([1.0, 0.5, 0.0], abs=0.015)
    assert along_y[:2] == pytest.approx([1.0, 0.0], abs=0.015)


def test_dropouts_are_counted_by_brightness() -> None:
    """The dark half of a wall is lost in 3 of 10 frames, the bright half never."""
    z_m = np.ones((10, 90, 120))
    z_m[:3, :, :60] = np.nan
    amplitude = np.where(np.arange(120) < 60, 10.0, 1000.0) * np.ones((90, 1))
    surface = (Plane(1.0), np.ones((90, 120), bool))
    capture = still(z_m, amplitude=amplitude, planes=(surface,))
    dropouts = measure.dropouts_of([capture])
    assert dropouts.amplitude == pytest.approx([10.0, 1000.0])
    assert dropouts.share == pytest.approx([0.3, 0.0])
    assert dropouts.pixels.tolist() == [(90 - 6) * 57, (90 - 6) * 57]


def test_the_pixels_across_an_edge_are_counted() -> None:
    """Two walls; between them, two columns without a return, and one off both in half the
    frames."""
    z_m = np.ones((10, 90, 120))
    z_m[:, :, 60:] = 1.2
    z_m[:, :, 60:62] = np.nan
    z_m[:5, :, 62] = 1.1
    z_m[5:, :, 62] = np.nan
    in_front = np.arange(120) < 60
    behind = np.arange(120) > 62
    rows = np.ones((90, 1), bool)
    surfaces = ((Plane(1.0), rows & in_front), (Plane(1.2), rows & behind))
    edge = measure.edge_of([still(z_m, planes=surfaces)])
    assert edge is not None
    assert (edge.lines, edge.gap_px, edge.flying_px) == pytest.approx((90, 2.5, 0.5))
    assert edge.step_m == pytest.approx(0.2)
