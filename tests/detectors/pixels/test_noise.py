"""Robust statistics, what rounding leaves in an average, and the reach of shared noise."""

from __future__ import annotations

import warnings
from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.pixels.noise import (
    LEAST_FRAMES,
    _side_of_tent,
    average_variance_m2,
    median_of,
    noise_reach_px,
    noise_sides_at,
    noise_sides_px,
    quantile_of,
    rounding_floor,
    rounding_left_m2,
    rounding_variances,
    sigma_of,
    with_noise,
)
from harness.testing.synthetic_clouds import SHAPE, plane
from harness.vocabulary.geometry import Cloud, Frame, LeftOut, Region

STEP_M = 1e-3


@pytest.mark.parametrize("count", [1, 2, 3, 10, 101])
def test_robust_statistics_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).standard_normal(count)
    assert median_of(values) == pytest.approx(np.median(values), abs=1e-15)
    assert sigma_of(values) == pytest.approx(np.median(np.abs(values)) / 0.6745, rel=1e-12)
    for share in (0.0, 0.25, 0.9, 1.0):
        assert quantile_of(values, share) == pytest.approx(np.quantile(values, share), abs=1e-14)


@pytest.mark.parametrize("noise_steps", [0.0, 0.1, 0.3, 0.5])
def test_rounding_leaves_what_an_average_of_many_frames_shows(noise_steps: float) -> None:
    """The mean of z + noise rounded, at 400 positions within a step, by the integral over the
    noise."""
    positions = (np.arange(400) + 0.5) / 400
    if noise_steps == 0.0:
        errors = np.round(positions) - positions
    else:
        noise = np.linspace(-4, 4, 8001) * noise_steps
        density = np.exp(-0.5 * (noise / noise_steps) ** 2)
        rounded = np.round(positions[:, None] + noise)
        errors = rounded @ (density / density.sum()) - positions
    left_m2 = rounding_left_m2(STEP_M, (noise_steps * STEP_M) ** 2)
    assert left_m2 / STEP_M**2 == pytest.approx(
        (errors**2).mean(),
        rel=0.01,
        abs=2e-7,
    )


def cloud_with(variance_m2: float, frames: int, step_m: float = STEP_M) -> Cloud:
    flat = plane(seed=1, tilt=0.1)
    return replace(
        flat,
        variance_m2=np.full(SHAPE, variance_m2),
        n_frames=frames,
        z_step_m=step_m,
    )


def test_what_rounding_leaves_is_fixed_or_averages_out() -> None:
    everywhere = np.ones(SHAPE, bool)
    whole_m2 = STEP_M**2 / 12
    dither_m2 = (0.3 * STEP_M) ** 2
    fixed_m2, random_m2 = rounding_variances(cloud_with(dither_m2 + whole_m2, 20), everywhere)
    assert fixed_m2 == pytest.approx(rounding_left_m2(STEP_M, dither_m2), rel=1e-9)
    assert random_m2 == pytest.approx((whole_m2 - fixed_m2) / 20, rel=1e-9)
    floor_m = rounding_floor(cloud_with(dither_m2 + whole_m2, 20), everywhere)
    assert floor_m == pytest.approx(np.sqrt(fixed_m2 + random_m2), rel=1e-12)
    # without a step, z counts as float32
    fine = rounding_floor(cloud_with(1e-6, 20, step_m=0.0), everywhere)
    z_m = plane(seed=1, tilt=0.1).points_m[..., 2].max()
    assert fine == pytest.approx(2.0**-23 * z_m / np.sqrt(12 * 20), rel=1e-6)


@pytest.mark.parametrize(
    ("frames", "parts", "is_whole"),
    [
        (3, 2, True),
        (2, 2, False),
        (3, 4, False),
    ],
)
def test_a_median_that_lies_on_half_steps_keeps_the_whole_rounding(frames, parts, is_whole) -> None:
    cloud = cloud_with(1e-6, frames)
    points_m = cloud.points_m.copy()
    points_m[..., 2] = np.round(points_m[..., 2] / STEP_M * parts) / parts * STEP_M
    result = rounding_variances(replace(cloud, points_m=points_m), np.ones(SHAPE, bool))
    assert (result == (STEP_M**2 / 12, 0.0)) == is_whole


def test_the_variance_of_an_average_is_the_scatter_nearby_over_its_frames() -> None:
    scatter_m2 = np.random.default_rng(1).chisquare(4, SHAPE) * 1e-6
    cloud = replace(plane(seed=1), variance_m2=scatter_m2, n_frames=5)
    everywhere = np.ones(SHAPE, bool)
    result = average_variance_m2(cloud, everywhere)
    assert result is not None
    expected = cv2.blur(scatter_m2, (7, 7))[10:-10, 10:-10] / 5
    np.testing.assert_allclose(result[10:-10, 10:-10], expected, rtol=1e-9)
    # unknown ones have the typical variance; their neighbours do not count them
    scatter_m2[20:40, 20:40] = np.nan
    gap = average_variance_m2(replace(cloud, variance_m2=scatter_m2), everywhere)
    assert gap is not None
    assert gap[30, 30] == pytest.approx(np.median(expected), rel=0.05)
    assert gap[30, 42] == pytest.approx(scatter_m2[27:34, 40:46].mean() / 5, rel=1e-9)


def test_the_variance_of_an_average_is_unknown_with_few_frames_or_pixels() -> None:
    everywhere = np.ones(SHAPE, bool)
    cloud = cloud_with(1e-6, LEAST_FRAMES)
    assert average_variance_m2(cloud, everywhere) is not None
    assert average_variance_m2(replace(cloud, n_frames=LEAST_FRAMES - 1), everywhere) is None
    assert average_variance_m2(replace(cloud, organised=False), everywhere) is None
    sparse_m2 = cloud.variance_m2.copy()
    sparse_m2[: SHAPE[0] // 2 + 1] = np.nan
    assert average_variance_m2(replace(cloud, variance_m2=sparse_m2), everywhere) is None
    sparse_m2[SHAPE[0] // 2 - 1 :] = 1e-6
    assert average_variance_m2(replace(cloud, variance_m2=sparse_m2), everywhere) is not None


def frames_of(
    side: int,
    count: int,
    tilt: float = 0.0,
    shape: tuple[int, int] = (200, 260),
) -> list[Frame]:
    """Frames of a plane whose noise a square of pixels correlates."""
    frames = []
    columns = np.arange(shape[1])
    for seed in range(count):
        white = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
        noise = cv2.blur(white, (side, side)) * side
        z_m = (0.7 + tilt * columns + 1e-3 * noise).astype(np.float32)
        frames.append(Frame(f"frame {seed}", z_m, np.zeros(shape, np.uint8)))
    return frames


@pytest.mark.parametrize("count", [1, 2, 6])
@pytest.mark.parametrize("side", [1, 3, 5])
def test_noise_reaches_as_far_as_the_square_that_correlates_it(side: int, count: int) -> None:
    assert noise_reach_px(frames_of(side, count, tilt=1e-4), 0.0) == side


def test_noise_that_rounding_or_few_pixels_hide_has_no_reach() -> None:
    assert noise_reach_px(frames_of(3, 1), 1e-2) == 0.0
    assert noise_reach_px(frames_of(3, 1), 1.9e-3) == 3.0
    assert noise_reach_px(frames_of(3, 2, shape=(70, 71)), 0.0) == 0.0
    assert noise_reach_px(frames_of(3, 2, shape=(71, 71)), 0.0) == 3.0
    assert noise_reach_px(frames_of(9, 2), 0.0) == 9.0
    assert noise_reach_px([], 0.0) == 0.0


def test_noise_that_all_pixels_of_a_row_share_has_no_reach_along_rows() -> None:
    """A narrow picture whose rows have one value each: along rows there is no end, and one end of
    two is not enough."""
    frames = []
    for seed in range(2):
        rows = np.random.default_rng(seed).standard_normal((600, 1)).astype(np.float32)
        z_m = (0.7 + 1e-3 * rows + np.zeros((600, 9))).astype(np.float32)
        frames.append(Frame(f"frame {seed}", z_m, np.zeros(z_m.shape, np.uint8)))
    assert noise_reach_px(frames, 0.0) == 0.0
    turned = [replace(frame, z_m=frame.z_m.T.copy(), reason=frame.reason.T) for frame in frames]
    assert noise_reach_px(turned, 0.0) == 0.0


def rounded_plane(side: int, noise_steps: float, step_m: float = 1e-3) -> Frame:
    """A frame of a tilted plane that is rounded to steps, whose contours are 16 rows apart."""
    rows, columns = np.indices((300, 300))
    white = np.random.default_rng(5).standard_normal((300, 300))
    steps = 500.3 + 0.06 * rows + 0.02 * columns + noise_steps * side * cv2.blur(white, (side,) * 2)
    z_m = (np.round(steps) * step_m).astype(np.float32)
    return Frame("0", z_m, np.zeros(z_m.shape, np.uint8))


@pytest.mark.parametrize(
    ("side", "noise_steps", "reach_px"),
    [
        (1, 0.1, 1),
        (1, 0.3, 1),
        (3, 0.2, 3),
        (3, 0.45, 3),
        (5, 1.0, 5),
        (5, 0.0, 0),
        (1, 0.05, 0),
    ],
)
def test_one_rounded_frame_shows_noise_finer_than_its_steps(side, noise_steps, reach_px) -> None:
    """Contours of the rounded plane, 16 pixels apart, are not taken for noise."""
    frame = rounded_plane(side, noise_steps)
    assert noise_reach_px([frame], 1e-3) == pytest.approx(reach_px, abs=0.5)


def test_one_frame_tells_upsampled_noise_from_a_pattern_under_native_noise() -> None:
    rng = np.random.default_rng(2)
    shape = (300, 300)
    coarse = cv2.blur(rng.standard_normal((100, 100)), (3, 3)) * 3
    upsampled = cv2.resize(coarse, shape, interpolation=cv2.INTER_LINEAR)
    pattern = 18 * cv2.blur(cv2.blur(rng.standard_normal(shape), (15, 15)), (7, 7))
    fine = rng.standard_normal(shape)
    blank = np.zeros(shape, np.uint8)

    def reach_of(noise: np.ndarray) -> float:
        z_m = (0.7 + 1e-3 * noise).astype(np.float32)
        return noise_reach_px([Frame("0", z_m, blank)], 0.0)

    assert reach_of(upsampled) == 7.0
    # the fine noise's own reach, or none: never that of the pattern
    assert reach_of(fine + 1.5 * pattern) == 0.0
    assert reach_of(fine + 0.3 * pattern) == 1.0


def test_the_side_of_a_square_is_the_sum_of_its_correlation() -> None:
    white = np.random.default_rng(8).standard_normal((900, 900))
    noise = cv2.blur(white, (9, 9))[10:-10, 10:-10]
    assert _side_of_tent(noise, np.ones(noise.shape, bool)) == pytest.approx(9.0, abs=0.4)


def upsampled_frames(noise_steps: float, step_m: float, count: int = 5) -> list[Frame]:
    """Rounded frames of a tilted plane. A rectangle of 9 x 13 pixels (columns x rows) averages the
    noise at the left, one of 21 x 13 at the right."""
    rows, columns = np.indices((480, 960))
    frames = []
    for seed in range(count):
        white = np.random.default_rng(seed).standard_normal(rows.shape)
        noise = np.where(
            columns < 480,
            np.sqrt(9 * 13) * cv2.blur(white, (9, 13)),
            np.sqrt(21 * 13) * cv2.blur(white, (21, 13)),
        )
        steps = 500.3 + 0.11 * rows + 0.05 * columns + noise_steps * noise
        z_m = (1e-3 * steps).astype(np.float32)
        if step_m > 0:
            z_m = (np.round(steps * 1e-3 / step_m) * step_m).astype(np.float32)
        frames.append(Frame(f"{seed}", z_m, np.zeros(z_m.shape, np.uint8)))
    return frames


@pytest.mark.parametrize(("noise_steps", "step_m"), [(0.15, 1e-3), (0.3, 1e-3), (0.3, 0.0)])
def test_upsampled_noise_has_its_own_rectangle_at_each_place(
    noise_steps: float, step_m: float
) -> None:
    sides_px = noise_sides_px(upsampled_frames(noise_steps, step_m), step_m)
    assert sides_px is not None
    assert sides_px.shape == (2, 3, 6)
    assert np.median(sides_px[0][:, :2]) == pytest.approx(9.0, abs=1.0)
    assert np.median(sides_px[0][:, 4:]) == pytest.approx(20.0, abs=2.0)
    assert np.median(sides_px[1][:, :2]) == pytest.approx(12.5, abs=1.5)
    assert np.median(sides_px[1][:, 4:]) == pytest.approx(12.5, abs=1.5)


def test_wide_noise_far_below_a_step_is_not_judged_where_rounding_hides_it() -> None:
    """Of noise of 0.12 steps, rounding passes hardly any between means half a step apart: 10
    columns or 5 rows."""
    sides_px = noise_sides_px(upsampled_frames(0.12, 1e-3), 1e-3)
    assert sides_px is not None
    assert np.median(sides_px[0][:, 4:]) == pytest.approx(20.0, abs=2.0)
    assert np.median(sides_px[1][:, 4:]) == pytest.approx(12.5, abs=1.5)


@pytest.mark.parametrize("is_noisy", [True, False])
def test_parts_without_pixels_have_the_sides_of_the_nearest_part(is_noisy: bool) -> None:
    """The left half has no range, as beyond the edge of the depth camera's view. Where all frames
    are alike, pixels do not show their noise."""
    is_empty = np.arange(960) < 480
    frames = []
    for frame in upsampled_frames(0.3, 0.0):
        frames.append(replace(frame, z_m=np.where(is_empty, np.float32(np.nan), frame.z_m)))
    if not is_noisy:
        frames = [frames[0]] * len(frames)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sides_px = noise_sides_px(frames, 0.0)
    if not is_noisy:
        assert sides_px is None
        return
    assert sides_px is not None
    assert (sides_px[:, :, :2] == sides_px[:, :, 2:3]).all()
    assert np.median(sides_px[0]) == pytest.approx(20.0, abs=2.0)
    assert np.median(sides_px[1]) == pytest.approx(12.5, abs=1.5)


def test_one_part_that_hides_its_noise_leaves_the_sides_unknown() -> None:
    """All frames are alike in the left half, three parts wide."""
    frames = upsampled_frames(0.3, 0.0)
    still_m = frames[0].z_m
    is_still = np.arange(960) < 480
    frames = [replace(frame, z_m=np.where(is_still, still_m, frame.z_m)) for frame in frames]
    assert noise_sides_px(frames, 0.0) is None


def test_the_sides_at_the_middle_of_a_part_are_those_of_the_part() -> None:
    """Two by four parts of a grid of 480 x 960 pixels; half-way between two, their mean."""
    along_rows = np.array([[9.0, 11.0, 14.0, 18.0], [10.0, 12.0, 15.0, 19.0]], np.float32)
    blank = np.zeros((480, 960))
    cloud = Cloud(
        points_m=np.zeros((480, 960, 3)),
        reason=blank.astype(np.uint8),
        count=blank,
        variance_m2=blank,
        region=Region(0, 480, 0, 960),
        z_step_m=0.0,
        n_frames=5,
        noise_sides_px=np.stack([along_rows, 2.0 * along_rows]),
    )
    assert noise_sides_at(cloud, 119.5, 359.5) == (11.0, 22.0)
    assert noise_sides_at(cloud, 359.5, 839.5) == (19.0, 38.0)
    assert noise_sides_at(cloud, 239.5, 479.5) == (13.0, 26.0)
    assert noise_sides_at(cloud, 0.0, 0.0) == (9.0, 18.0)


def test_a_cloud_knows_the_sides_of_upsampled_noise_alone() -> None:
    """A frame that the cloud leaves out does not count."""
    frames = upsampled_frames(0.3, 0.0)
    blank = np.zeros((480, 960))
    cloud = Cloud(
        points_m=np.zeros((480, 960, 3)),
        reason=blank.astype(np.uint8),
        count=blank,
        variance_m2=blank,
        region=Region(0, 480, 0, 960),
        z_step_m=0.0,
        n_frames=5,
    )
    measured = with_noise(cloud, frames, 0.0)
    assert noise_sides_at(measured, 240, 100)[0] == pytest.approx(9.0, abs=1.0)
    assert noise_sides_at(measured, 240, 900)[0] == pytest.approx(20.0, abs=2.5)
    between = noise_sides_at(measured, 240, 480)[0]
    assert 10.0 < between < 19.0
    native = with_noise(cloud, frames_of(5, 5, shape=(480, 960)), 0.0)
    assert native.noise_sides_px is None
    assert noise_sides_at(native, 240, 100) == (5.0, 5.0)
    white = np.random.default_rng(9).normal(0.0, 5e-3, (480, 960)).astype(np.float32)
    torn = replace(frames[4], z_m=frames[4].z_m + white)
    spoilt = [*frames[:4], torn]
    left_out = replace(cloud, left_out=(LeftOut("4", "it jumps"),))
    kept = with_noise(left_out, spoilt, 0.0)
    assert kept.noise_sides_px is not None
    assert noise_sides_at(kept, 240, 100)[0] == pytest.approx(9.0, abs=1.0)
