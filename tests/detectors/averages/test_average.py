"""Averaging: exact against NumPy, prefixes of one pass, faulty frames noticed and named."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from detectors.averages.average import (
    CORRELATED_PIXELS,
    FEW_SAMPLES,
    OTHER_SCENE,
    RECORDED,
    SAMPLED_PIXELS,
    AverageConfig,
    FrameSums,
    _changed_share,
    average,
    pixel_medians,
    prefix_averages,
    unsteadiness,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Frame, Lens, Reason, Region

METHODS = ("mean", "median", "clipped")


@dataclass
class Stack:
    """Frames in memory. ``extra`` holds further fields of every frame."""

    z_m: np.ndarray
    slopes: np.ndarray | None = None
    z_step_m: float = 0.0
    reason: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    names: list[str] | None = None
    name: str = "stack"
    organised: bool = True
    lens: Lens | None = None

    @property
    def region(self) -> Region:
        return Region(0, self.z_m.shape[1], 0, self.z_m.shape[2])

    def frames(self) -> Iterator[Frame]:
        for i, z in enumerate(self.z_m):
            reason = (~np.isfinite(z)).astype(np.uint8) if self.reason is None else self.reason[i]
            names = self.names or [f"frame {k}" for k in range(len(self.z_m))]
            yield Frame(
                names[i],
                z,
                reason,
                **{key: value[i] for key, value in self.extra.items()},
            )


def noisy(
    frames: int = 12,
    shape: tuple[int, int] = (40, 50),
    sigma_m: float = 1e-3,
    seed: int = 1,
) -> Stack:
    random = np.random.default_rng(seed)
    slopes = np.stack(
        np.meshgrid(np.linspace(-0.2, 0.2, shape[1]), np.linspace(-0.2, 0.2, shape[0])), axis=-1
    )
    z = 0.8 + 0.1 * slopes[..., 0] + sigma_m * random.standard_normal((frames, *shape))
    return Stack(z.astype(np.float32), slopes)


def with_gaps(stack: Stack, part: float = 0.1) -> Stack:
    holes = np.random.default_rng(2).random(stack.z_m.shape) < part
    return replace(stack, z_m=np.where(holes, np.nan, stack.z_m).astype(np.float32))


def test_mean_count_and_variance_equal_numpy() -> None:
    stack = with_gaps(noisy())
    cloud = average(stack, AverageConfig())
    z = stack.z_m.astype(np.float64)
    np.testing.assert_allclose(
        cloud.points_m[..., 2],
        np.nanmean(z, axis=0),
        rtol=1e-13,
    )
    np.testing.assert_array_equal(cloud.count, np.isfinite(z).sum(axis=0))
    np.testing.assert_allclose(
        cloud.variance_m2,
        np.nanvar(z, axis=0, ddof=1),
        rtol=1e-9,
    )
    np.testing.assert_allclose(
        cloud.points_m[..., :2],
        stack.slopes * cloud.points_m[..., 2:],
        rtol=1e-15,
    )
    assert cloud.n_frames == 12
    assert cloud.left_out == ()


def test_variance_keeps_its_digits_far_from_the_camera() -> None:
    stack = noisy(sigma_m=0.0)
    steps = np.arange(12) % 2 * np.float32(2**-20)
    z = np.float32(3.0) + np.broadcast_to(steps[:, None, None], stack.z_m.shape).astype(np.float32)
    cloud = average(replace(stack, z_m=z), AverageConfig())
    np.testing.assert_allclose(
        cloud.variance_m2,
        np.var(steps.astype(float), ddof=1),
        rtol=1e-9,
    )


@pytest.mark.parametrize("frames", [3, 8, 31])
def test_median_equals_numpy(frames: int) -> None:
    stack = with_gaps(noisy(frames), 0.3)
    with (
        np.errstate(all="ignore"),
        pytest.warns() if np.isnan(stack.z_m).all(axis=0).any() else np.errstate(),
    ):
        expected = np.nanmedian(stack.z_m.astype(np.float64), axis=0)
    cloud = average(stack, AverageConfig(method="median", judge_frames=False))
    np.testing.assert_allclose(cloud.points_m[..., 2], expected, rtol=1e-7)


@pytest.mark.parametrize("method", METHODS)
def test_prefixes_of_one_pass_equal_separate_averages(method: str) -> None:
    stack = with_gaps(noisy())
    stack.z_m[7] += np.float32(0.02)
    config = AverageConfig.from_data({"method": method})
    clouds = prefix_averages(stack, [10, 1, 2, 5, 8], config)
    assert sorted(clouds) == [1, 2, 5, 8, 10]
    for n, cloud in clouds.items():
        alone = average(stack, AverageConfig.from_data({"method": method, "frames": n}))
        np.testing.assert_array_equal(cloud.points_m, alone.points_m)
        np.testing.assert_array_equal(cloud.variance_m2, alone.variance_m2)
        assert cloud.left_out == alone.left_out
        assert cloud.n_frames == n - (n >= 8)


@settings(max_examples=10, deadline=None)
@given(order=st.permutations(range(9)))
def test_the_order_of_good_frames_does_not_matter(order: list[int]) -> None:
    stack = with_gaps(noisy(9))
    shuffled = replace(stack, z_m=stack.z_m[order])
    for method in ("mean", "median"):
        config = AverageConfig.from_data({"method": method})
        a = average(stack, config)
        b = average(shuffled, config)
        np.testing.assert_allclose(a.points_m, b.points_m, rtol=1e-12)


@pytest.mark.parametrize("bad", [0, 2, 4, 9])
def test_a_frame_that_jumps_is_left_out_and_named_wherever_it_stands(bad: int) -> None:
    stack = noisy()
    good = np.delete(stack.z_m, bad, axis=0)
    stack.z_m[bad] += np.float32(0.018)
    cloud = average(stack, AverageConfig())
    assert [skipped.name for skipped in cloud.left_out] == [f"frame {bad}"]
    assert "jumps by +18.0 mm" in cloud.left_out[0].why
    assert "allowed 3.0 mm" in cloud.left_out[0].why
    np.testing.assert_allclose(
        cloud.points_m[..., 2],
        good.astype(float).mean(axis=0),
        rtol=1e-12,
    )


def test_a_step_below_the_allowance_is_no_jump() -> None:
    stack = noisy()
    stack.z_m[6] += np.float32(0.002)
    assert average(stack, AverageConfig()).left_out == ()


@pytest.mark.parametrize(
    ("frames", "shape"),
    [
        (5, (40, 50)),
        (3, (100, 130)),
        (1, (40, 50)),
    ],
)
def test_the_limit_of_jumps_is_that_of_the_difference_of_two_medians(frames, shape) -> None:
    """Six standard errors of the difference of two frames' medians, each 1.2533 times that of a
    mean, where 25 pixels share one value; the noise is known to some per cent."""
    stack = noisy(frames, shape, sigma_m=2e-3)
    config = AverageConfig(jump_mm=1e-3, changed_mm=1e-3)
    sums = FrameSums(stack, list(stack.frames()), config)
    pixels = len(sums.sample)
    assert SAMPLED_PIXELS / 2 < pixels <= SAMPLED_PIXELS or pixels == shape[0] * shape[1]
    if frames == 1:
        # one frame shows no noise
        assert sums.jump_m == pytest.approx(1e-6)
        return
    standard_error_m = 1.2533 * 2e-3 * np.sqrt(2 * CORRELATED_PIXELS / pixels)
    assert sums.jump_m == pytest.approx(6.0 * standard_error_m, rel=0.05)
    assert sums.change_m == pytest.approx(6.0 * 2e-3, rel=0.05)


def test_rounding_sets_the_least_noise() -> None:
    stack = replace(noisy(5, sigma_m=0.0), z_step_m=0.012)
    sums = FrameSums(
        stack,
        list(stack.frames()),
        AverageConfig(jump_mm=1e-3, changed_mm=1e-3),
    )
    assert sums.change_m == pytest.approx(6.0 * 0.012 / np.sqrt(12), rel=1e-6)


def test_changes_beyond_the_usual_count() -> None:
    """A tenth of the pixels flicker: the allowed share is the setting's and half as much again as
    the reference frames have."""
    stack = noisy(5)
    flicker = np.random.default_rng(5).random(stack.z_m.shape) < 0.1
    stack.z_m[flicker] = np.nan
    sums = FrameSums(stack, list(stack.frames()), AverageConfig())
    assert sums.fraction == pytest.approx(0.05 + 1.5 * 0.1, abs=0.02)


def test_the_clipped_mean_allows_sigmas_of_the_frame_or_of_the_pixel() -> None:
    stack = noisy(5, (60, 80), sigma_m=1e-3)
    # a pixel whose median deviation is 25 mm
    stack.z_m[:, 0, 0] = np.array([0.75, 0.775, 0.8, 0.825, 0.85], np.float32)
    config = AverageConfig(method="clipped", changed_mm=200.0)
    gate = FrameSums(stack, list(stack.frames()), config).gate.reshape(60, 80)
    assert gate[0, 0] == pytest.approx(5.0 * 0.025 / 0.6745, rel=1e-4)
    # a pixel's own median deviation of five frames is seldom above the frame's
    assert np.median(gate) == pytest.approx(5e-3, rel=0.2)
    assert gate.min() == pytest.approx(5e-3, rel=0.05)


def test_of_two_frames_that_disagree_the_first_is_kept() -> None:
    stack = noisy(2)
    stack.z_m[1] -= np.float32(0.018)
    cloud = average(stack, AverageConfig())
    assert [skipped.name for skipped in cloud.left_out] == ["frame 1"]
    assert cloud.n_frames == 1
    np.testing.assert_array_equal(cloud.points_m[..., 2].astype(np.float32), stack.z_m[0])


@pytest.mark.parametrize("bad", [0, 3, 8])
def test_a_disturbed_frame_is_left_out_with_its_fraction(bad: int) -> None:
    stack = noisy()
    stack.z_m[bad, :, :10] = 0.4  # a hand over a fifth of the picture
    [skipped] = average(stack, AverageConfig()).left_out
    assert skipped.name == f"frame {bad}"
    assert skipped.why.startswith("disturbed: 20.0 %")


def test_a_frame_that_lost_its_range_is_left_out() -> None:
    stack = noisy()
    stack.z_m[8, :20] = np.nan
    stack.z_m[9] = np.nan
    half, none = average(stack, AverageConfig()).left_out
    assert half.name == "frame 8"
    assert half.why.startswith("disturbed: 50.0 %")
    assert none.name == "frame 9"
    assert none.why == "no pixel has a range"


def test_flickering_validity_is_usual_and_no_disturbance() -> None:
    stack = noisy(20)
    flicker = np.random.default_rng(5).random(stack.z_m.shape) < 0.3
    stack.z_m[flicker] = np.nan
    assert average(stack, AverageConfig()).left_out == ()


def test_a_knocked_camera_is_told() -> None:
    """A step of 0.3 m at a board's edge moves by two of fifty columns."""
    stack = noisy()
    z_m = stack.z_m + 0.3 * (np.arange(50) > 30).astype(np.float32)
    z_m[8:] = np.roll(z_m[8:], 2, axis=2)
    cloud = average(replace(stack, z_m=z_m), RECORDED)
    assert len(cloud.left_out) == 4
    assert unsteadiness(cloud).startswith("4 of 12 frames differ")
    assert unsteadiness(average(stack, RECORDED)) == ""


HEIGHT = 96
WIDTH = 128


def heap(number: int, depth_m: float = 0.03) -> np.ndarray:
    """(h, w): parts of ``depth_m`` at random on a table at 0.8 m, another heap for each number."""
    rng = np.random.default_rng([8, number])
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    z_m = np.full((HEIGHT, WIDTH), 0.8, np.float32)
    for _ in range(40):
        centre_u = rng.uniform(0, WIDTH)
        centre_v = rng.uniform(0, HEIGHT)
        z_m[np.hypot(u - centre_u, v - centre_v) < 8] -= depth_m * rng.uniform(0.5, 1.5)
    return z_m


def heaps(numbers: list[int], noise_m: float = 1e-3, blur_px: int = 1) -> Stack:
    """A frame of each heap, with noise that ``blur_px`` pixels share, or 1 for none."""
    rng = np.random.default_rng(9)
    frames = []
    for number in numbers:
        noise = rng.normal(0, noise_m * blur_px, (HEIGHT, WIDTH))
        frames.append(heap(number) + cv2.blur(noise, (blur_px, blur_px)))
    z_m = np.stack(frames).astype(np.float32)
    return Stack(z_m, np.zeros((HEIGHT, WIDTH, 2)))


def test_frames_of_three_scenes_are_told_by_name() -> None:
    """Their differences are no noise, which would let all of them pass."""
    cloud = average(heaps([0, 1, 2]), RECORDED)
    assert cloud.n_frames == 1
    assert [frame.name for frame in cloud.left_out] == ["frame 1", "frame 2"]
    assert unsteadiness(cloud) == (
        "the 3 frames do not show the same scene: only one frame is used, and frame 1, frame 2"
        " left out; name the frames of one scene only"
    )


def test_the_scene_of_most_frames_counts() -> None:
    cloud = average(heaps([1, 0, 0, 2, 0, 0]), RECORDED)
    assert [frame.name for frame in cloud.left_out] == ["frame 0", "frame 3"]
    text = unsteadiness(cloud)
    assert text.startswith("2 of 6 frames differ from the others and are left out (frame 0, frame")
    enough = average(heaps([0, *range(1, 9)]), RECORDED)
    assert "frame 5, frame 6, .. left out" in unsteadiness(enough)


@pytest.mark.parametrize(("noise_m", "blur_px"), [(1e-3, 1), (8e-3, 5), (30e-3, 1), (4e-3, 9)])
def test_noise_is_no_other_scene(noise_m: float, blur_px: int) -> None:
    """Also far noisier than the least change, or shared by the pixels of a depth engine's filter."""
    cloud = average(heaps([0] * 6, noise_m, blur_px), RECORDED)
    assert cloud.n_frames == 6 and unsteadiness(cloud) == ""


def test_still_blocks_are_seen_without_their_medians() -> None:
    """The medians of blocks in NumPy decide alike, for shares of changed blocks about the limit and
    changes about theirs."""
    rng = np.random.default_rng(12)
    decisions = []
    for number in range(300):
        share = rng.uniform(0.15, 0.5)
        change_m = rng.choice([0.002, 0.004, 0.008])
        first = 0.7 + rng.normal(0, 0.001, (64, 9))
        second = first + rng.normal(0, 0.0005, (64, 9)) + (0.01 if number % 2 else 0.0)
        changed = second[: int(share * 64)]
        changed += rng.uniform(0.5, 1.5) * change_m * (rng.random(changed.shape) < 0.7)
        second[rng.random(second.shape) < rng.choice([0.0, 0.4])] = np.nan
        differences = first - second
        counts = np.isfinite(differences).sum(axis=1)
        medians = np.nanmedian(differences[2 * counts > 9], axis=1)
        off_m = np.abs(medians - np.median(medians))
        expected = np.mean(off_m > change_m) >= OTHER_SCENE
        assert (_changed_share(first, second, change_m) >= OTHER_SCENE) == expected
        decisions.append(expected)
    assert 0.1 < np.mean(decisions) < 0.9


@pytest.mark.parametrize("frames", range(1, FEW_SAMPLES + 2))
def test_medians_of_pixels_equal_numpy(frames: int) -> None:
    rng = np.random.default_rng(frames)
    stack = rng.normal(size=(frames, 40, 61)).astype(np.float32)
    stack[rng.random(stack.shape) < 0.3] = np.nan
    stack[0, 0, :2] = (np.inf, -np.inf)
    finite = np.where(np.isfinite(stack), stack, np.nan)
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without a sample
        expected = np.nanmedian(finite, axis=0)
    medians = pixel_medians(stack)
    assert medians.dtype == np.float32
    np.testing.assert_array_equal(medians, expected)


def test_a_jump_of_the_range_is_no_other_scene() -> None:
    """One of three frames lies 20 mm farther: it jumps, and the two others are averaged."""
    stack = heaps([0, 0, 0])
    stack.z_m[1] += 0.02
    cloud = average(stack, RECORDED)
    assert cloud.n_frames == 2 and cloud.left_out[0].why.startswith("the whole range jumps")


def test_judging_can_be_switched_off() -> None:
    stack = noisy()
    stack.z_m[3] += np.float32(0.018)
    cloud = average(stack, AverageConfig(judge_frames=False))
    assert cloud.left_out == ()
    assert cloud.n_frames == 12


def test_clipped_mean_ignores_samples_wrong_by_metres() -> None:
    stack = noisy(20)
    clean = average(stack, AverageConfig()).points_m[..., 2]
    wrong = np.random.default_rng(3).random(stack.z_m.shape) < 0.01
    stack.z_m[wrong] += np.float32(1.0)
    plain = average(stack, AverageConfig()).points_m[..., 2]
    clipped = average(stack, AverageConfig(method="clipped"))
    assert np.abs(plain - clean).max() > 0.04
    assert np.abs(clipped.points_m[..., 2] - clean).max() < 0.5e-3
    assert clipped.count.sum() <= (~wrong).sum()


def test_clipped_mean_of_gaussian_noise_is_the_mean() -> None:
    stack = noisy(50, sigma_m=1e-3)
    plain = average(stack, AverageConfig()).points_m[..., 2]
    clipped = average(stack, AverageConfig(method="clipped")).points_m[..., 2]
    # a standard error is 1 mm / sqrt(50) = 0.14 mm; clipping at five sigma moves the mean by a
    # small part of it
    assert np.sqrt(np.mean((plain - clipped) ** 2)) < 0.01e-3


def test_never_valid_pixels_carry_the_commonest_reason() -> None:
    stack = noisy(5)
    stack.z_m[:, 0, 0] = np.nan
    stack.z_m[:4, 0, 1] = np.nan
    reason = np.where(np.isfinite(stack.z_m), Reason.VALID, Reason.EDGE).astype(np.uint8)
    reason[:3, 0, 0] = Reason.UNWRAP
    cloud = average(replace(stack, reason=reason), AverageConfig())
    assert cloud.reason[0, 0] == Reason.UNWRAP
    assert not cloud.valid[0, 0]
    assert cloud.reason[0, 1] == Reason.VALID
    assert cloud.count[0, 1] == 1
    assert np.isnan(cloud.variance_m2[0, 1])


def test_one_colour_picture_of_many_frames_counts_as_often_as_it_comes() -> None:
    stack = noisy(9)
    random = np.random.default_rng(5)
    shared, other = random.integers(0, 256, (2, *stack.z_m.shape[1:], 3)).astype(np.uint8)
    shared = shared.copy()
    shared.flags.writeable = False
    pictures = [shared] * 9
    pictures[3] = other
    pictures[7] = other
    cloud = average(replace(stack, extra={"rgb": pictures}), AverageConfig())
    expected = np.round(np.mean(pictures, axis=0))
    np.testing.assert_array_equal(cloud.rgb, expected)


def test_a_colour_picture_that_is_filled_anew_counts_as_what_it_shows() -> None:
    stack = noisy(4)
    picture = np.zeros((*stack.z_m.shape[1:], 3), np.uint8)
    first, *others = stack.frames()
    sums = FrameSums(stack, [replace(first, rgb=picture)], AverageConfig())
    for number, frame in enumerate(others, 1):
        picture[:] = 10 * number
        sums.take(replace(frame, rgb=picture))
    assert (sums.cloud().rgb == 15).all()


def test_colour_amplitude_and_xy_are_averaged() -> None:
    stack = noisy(4)
    random = np.random.default_rng(4)
    shape = stack.z_m.shape
    extra = {
        "rgb": random.integers(0, 256, (*shape, 3)).astype(np.uint8),
        "amplitude": random.random(shape).astype(np.float32),
        "xy_m": random.random((*shape, 2)),
    }
    cloud = average(replace(stack, slopes=None, extra=extra), AverageConfig())
    np.testing.assert_array_equal(cloud.rgb, np.round(extra["rgb"].mean(axis=0)).astype(np.uint8))
    np.testing.assert_allclose(
        cloud.amplitude,
        extra["amplitude"].astype(float).mean(axis=0),
        rtol=1e-6,
    )
    np.testing.assert_allclose(
        cloud.points_m[..., :2],
        extra["xy_m"].mean(axis=0),
        rtol=1e-12,
    )


def test_mistakes_are_named() -> None:
    stack = noisy(6)
    with pytest.raises(UserError, match="7 frames to average, but there are 6"):
        average(stack, AverageConfig(frames=7))
    with pytest.raises(UserError, match="there are 6"):
        prefix_averages(stack, [1, 9], AverageConfig())
    with pytest.raises(UserError, match="whole numbers from 1"):
        prefix_averages(stack, [0, 2], AverageConfig())
    with pytest.raises(UserError, match="no frames"):
        average(replace(stack, z_m=stack.z_m[:0]), AverageConfig())
    with pytest.raises(UserError, match="no pixel has a range"):
        average(replace(stack, z_m=np.full_like(stack.z_m, np.nan)), AverageConfig())
    with pytest.raises(UserError, match=r"median of 2 frames.*median_memory_mb"):
        average(stack, AverageConfig(method="median", median_memory_mb=0.02))


def test_frames_of_different_size_are_refused() -> None:
    stack = noisy(2, (4, 5))
    stack.slopes = None
    stack.z_m = [stack.z_m[0], np.ones((4, 6), np.float32)]  # type: ignore[assignment]
    with pytest.raises(UserError, match=r"frame 1: 6 x 4 pixels, but 5 x 4 pixels expected"):
        average(stack, AverageConfig())


def read_pngs(folder: Path) -> Stack:
    files = sorted(path for path in folder.glob("*.png") if "mask" not in path.name)
    raw = np.stack([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in files])
    z = np.where(raw == 0, np.nan, raw * 1e-3).astype(np.float32)
    return Stack(
        z,
        np.zeros((*z.shape[1:], 2)),
        1e-3,
        names=[path.name for path in files],
    )


def test_the_jump_of_a_real_capture_is_named(shared_data: Path) -> None:
    stack = read_pngs(shared_data / "azure_drilled_board" / "depth")
    cloud = average(stack, AverageConfig())
    assert [skipped.name for skipped in cloud.left_out] == ["00003.png"]
    assert cloud.n_frames == 17
    assert "+17.0 mm" in cloud.left_out[0].why


def test_a_clean_real_capture_loses_no_frame(shared_data: Path) -> None:
    cloud = average(read_pngs(shared_data / "azure_nfov_walls"), AverageConfig(method="clipped"))
    assert cloud.left_out == ()
    assert cloud.n_frames == 22
    assert 0.5e-3 < np.sqrt(np.nanmedian(cloud.variance_m2)) < 3e-3
