"""Averages drawn at once, from sums over frames that a test writes by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from detectors.averages.average import AverageConfig
from harness.trials import averages
from harness.trials.averages import FEWEST_FRAMES, averages_of
from harness.vocabulary.geometry import MM, Region
from scenes.sensor.common.unit import FrameTotals

REGION = Region(0, 1, 0, 4)
STEP_M = 1e-3
NOISE_M = 2e-3
ERRORS_M = np.zeros(40)
REACH_PX = 4


class WrittenCapture:
    """A capture whose sums over frames are written by hand: a pixel that returned always, one that
    returned half of the time, one that never did, one that returned once."""

    n_frames = 40
    seed = 1
    region = REGION
    lens = None
    organised = True
    z_step_m = 0.0

    def __init__(self, *, noise_m: float = NOISE_M, sure_pixels: int = 8192) -> None:
        summer = SimpleNamespace(noise_m=noise_m, sure_pixels=sure_pixels, z_by_error=2.0)
        camera = SimpleNamespace(optics=SimpleNamespace(margin_px=REACH_PX))
        self.unit = SimpleNamespace(at_once=summer, rgb=None, camera=camera)
        self.errors_m = ERRORS_M.copy()
        self.slopes = np.zeros((1, 4, 2))
        self.slopes[0, 0] = 0.5, -0.25
        self.parts: list[np.ndarray] = []

    def totals(self, parts: list[np.ndarray]) -> list[FrameTotals]:
        self.parts = list(parts)
        frames = np.cumsum([len(part) for part in parts]).tolist()
        return [self.sums(n) for n in frames]

    def sums(self, n: int) -> FrameTotals:
        count = np.array([[n, n // 2, 0, 1]])
        # deviations of +-2 steps about a mean of 3 steps above the base
        total = 3.0 * count
        squares = (9.0 + 4.0) * count
        reasons = np.zeros((5, 1, 4), int)
        reasons[2] = n
        return FrameTotals(
            count=count,
            base=np.full((1, 4), 700),
            total=total,
            squares=squares,
            amplitude=10.0 * count,
            reasons=reasons,
            step_m=STEP_M,
            frames=n,
        )


def drawn(capture: WrittenCapture, counts: list[int], **config: Any) -> dict[int, Any]:
    """Averages that are drawn at once; those of single frames are refused."""
    return averages._drawn_at_once(capture, counts, AverageConfig(**config))  # type: ignore[arg-type]


def test_an_average_follows_from_sums_of_steps() -> None:
    cloud = drawn(WrittenCapture(), [20], judge_frames=False)[20]
    z_m = 0.703
    np.testing.assert_allclose(cloud.points_m[0, 0], [0.5 * z_m, -0.25 * z_m, z_m])
    assert cloud.count.tolist() == [[20, 10, 0, 1]]
    # of n values with squares 13 n and sum 3 n: (13 n - 9 n) / (n - 1)
    expected_m2 = np.array([4 * 20 / 19, 4 * 10 / 9]) * STEP_M**2
    np.testing.assert_allclose(cloud.variance_m2[0, :2], expected_m2)
    assert np.isnan(cloud.variance_m2[0, 2:]).all()
    assert cloud.reason.tolist() == [[0, 0, 2, 0]]
    assert cloud.amplitude[0, :2].tolist() == [10.0, 10.0]
    assert (cloud.n_frames, cloud.left_out) == (20, ())


def test_frames_that_jump_are_left_out_of_the_averages_that_contain_them() -> None:
    capture = WrittenCapture()
    capture.errors_m[12] = 5e-3  # z changes by twice as much
    capture.errors_m[30] = -5e-3
    clouds = drawn(capture, [10, 20, 40], changed_mm=100.0, disturbed_fraction=1.0)
    assert [part.tolist() for part in capture.parts] == [
        list(range(10)),
        [10, 11, *range(13, 20)],
        [*range(20, 30), *range(31, 40)],
    ]
    left_out = {n: [frame.name for frame in cloud.left_out] for n, cloud in clouds.items()}
    assert left_out == {10: [], 20: ["frame 12"], 40: ["frame 12", "frame 30"]}
    assert "jumps by +10.0 mm" in clouds[20].left_out[0].why
    assert "jumps by -10.0 mm" in clouds[40].left_out[1].why


@pytest.mark.parametrize(("factor", "jumps"), [(0.98, False), (1.02, True)])
@pytest.mark.parametrize("is_loud", [False, True])
def test_a_jump_has_to_exceed_the_larger_of_both_limits(
    factor: float, jumps: bool, is_loud: bool
) -> None:
    config = AverageConfig()
    noise_m = 0.5 if is_loud else 1e-4
    capture = WrittenCapture(noise_m=noise_m)
    # the median's standard error over pixels of which 25 are correlated
    sampled = 8192 / -(-8192 // averages.SAMPLED_PIXELS)
    independent = sampled / averages.CORRELATED_PIXELS
    error_m = 1.2533 * noise_m * np.sqrt(2 / independent)
    limit_m = config.jump_sigmas * error_m if is_loud else config.jump_mm * MM
    capture.errors_m[3] = factor * limit_m / 2
    left_out = averages._left_out(capture, capture.unit.at_once, config, noise_m)  # type: ignore[arg-type]
    assert list(left_out) == ([3] if jumps else [])


def cloud_with(count: list[int], deviation_mm: list[float]) -> Any:
    variance = np.square(np.array(deviation_mm) * MM)
    return SimpleNamespace(count=np.array(count), variance_m2=variance, n_frames=100)


def test_pixels_that_lose_their_range_or_change_disturb_frames() -> None:
    config = AverageConfig(disturbed_fraction=0.1, changed_mm=10.0, changed_sigmas=5.0)

    def disturbed(count: list[int], deviation_mm: list[float], noise_m: float = 1e-3) -> bool:
        return averages._is_disturbed(cloud_with(count, deviation_mm), noise_m, config)

    quiet = [0.1] * 4
    # half of the fraction, 0.05, may be lost
    assert not disturbed([96, 96, 96, 96], quiet)
    assert disturbed([94, 94, 94, 94], quiet)
    # a pixel that lost half of its frames is not judged
    assert not disturbed([100, 100, 100, 50], quiet)
    assert disturbed([50, 50, 50, 50], quiet)
    # erfc(10 / (sqrt(2) s)) of one pixel in four: .20 for s = 8 mm, .21 in 4 makes .05
    assert not disturbed([100] * 4, [0.1, 0.1, 0.1, 7.7])
    assert disturbed([100] * 4, [0.1, 0.1, 0.1, 8.1])
    # with ten times the noise the change has to be larger
    assert not disturbed([100] * 4, [0.1, 0.1, 0.1, 8.1], noise_m=1e-2)


def test_few_frames_medians_and_exact_averages_are_drawn_singly(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    singly: list[list[int]] = []

    def one_by_one(capture: Any, counts: list[int], config: object) -> dict[int, Any]:
        singly.append(list(counts))
        return {n: averages._cloud(capture, capture.sums(n), ()) for n in counts}

    monkeypatch.setattr(averages, "prefix_averages", one_by_one)
    mean = AverageConfig(judge_frames=False)
    capture: Any = WrittenCapture()
    clouds = averages_of(capture, [1, FEWEST_FRAMES - 1, FEWEST_FRAMES, 30], mean, exact=False)
    assert singly.pop() == [1, FEWEST_FRAMES - 1]
    assert sorted(clouds) == [1, FEWEST_FRAMES - 1, FEWEST_FRAMES, 30]
    assert clouds[30].n_frames == 30
    assert {cloud.edge_reach_px for cloud in clouds.values()} == {REACH_PX}
    averages_of(capture, [FEWEST_FRAMES], mean, exact=False)
    assert singly == []
    averages_of(capture, [20], mean, exact=True)
    assert singly.pop() == [20]
    averages_of(capture, [20], AverageConfig(method="median"), exact=False)
    assert singly.pop() == [20]
    averages_of(capture, [41], mean, exact=False)  # more than the capture has
    assert singly.pop() == [41]
    unsure: Any = WrittenCapture(sure_pixels=0)
    averages_of(unsure, [20], AverageConfig(), exact=False)
    assert singly.pop() == [20]
