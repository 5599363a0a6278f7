"""The flat field of a unit: the pattern found again, the surface parted from it, doubts told,
files refused."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from detectors.averages.flat_captures import (
    FlatCapture,
    PatternChange,
    Separated,
    _averaged,
    _change,
    _disagreement_m2,
    _groups,
    _moved,
    _solved,
    flattened,
    separated,
)
from detectors.averages.flat_field import (
    NEAR_ENOUGH,
    FlatField,
    corrected,
    doubts,
    load_flat_field,
    save_flat_field,
)
from harness import detect
from harness.experiment.load import load_experiment
from harness.programs.camera import flatfield
from harness.runs.plan import plan_of
from harness.trials.averages import flat_field_of
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens, Region
from tests.support.serial_run import records_of, run_serially
from tests.support.tiny_sweep import STUDY

LENS = Lens(160, 128, 250.0, 250.0, 80.0, 64.0)
FRAMES = 50
NOISE_M = 0.5 * MM
SHIFTS = (
    (0.55, 0.0, 0.0),
    (0.55, 0.04, 0.01),
    (0.55, -0.03, 0.035),
    (1.0, 0.0, 0.0),
    (1.0, 0.05, -0.02),
)
"""Distance, and where the camera stands along the wall, metres."""
SIDE_M = 1 * MM
Places = tuple[tuple[float, float, float], ...]


def smooth(
    rng: np.random.Generator,
    shape: tuple[int, int],
    length: float,
    rms_m: float,
) -> np.ndarray:
    field = ndimage.gaussian_filter(
        rng.standard_normal(shape, np.float32),
        length,
        mode="wrap",
    )
    return rms_m * field / field.std()


@cache
def pattern() -> np.ndarray:
    """(h, w): as an imager's, filtered over pixels and smooth, 0.5 mm."""
    rng = np.random.default_rng(1)
    return smooth(rng, (LENS.height, LENS.width), 3.0, 0.4 * MM) + smooth(
        rng,
        (128, 160),
        1.0,
        0.3 * MM,
    )


@cache
def relief() -> np.ndarray:
    return smooth(np.random.default_rng(2), (1200, 1200), 6.0, 1.0)


def wall(rms_m: float) -> np.ndarray:
    return rms_m * relief()


def capture(
    number: int,
    shape_m: np.ndarray,
    pose_m: tuple[float, float, float] = (0.8, 0.0, 0.0),
    fixed_m: np.ndarray | None = None,
    noise_m: float = NOISE_M,
) -> Cloud:
    """An average of a wall with a shape, seen from a place, each frame's z with white noise."""
    distance_m, x_m, y_m = pose_m
    slopes = LENS.region_slopes(LENS.whole)
    rng = np.random.default_rng([3, number])
    position = (slopes[..., ::-1] * distance_m + [y_m, x_m]) / SIDE_M + 600
    length = np.sqrt(1 + (slopes**2).sum(axis=-1))
    z_m = distance_m + ndimage.map_coordinates(
        shape_m,
        np.moveaxis(position, -1, 0),
        order=1,
    )
    z_m = z_m + (pattern() if fixed_m is None else fixed_m) / length
    z_m = z_m + rng.standard_normal(z_m.shape) * noise_m / np.sqrt(FRAMES)
    scatter_m2 = noise_m**2 * rng.chisquare(FRAMES - 1, z_m.shape) / (FRAMES - 1)
    points = np.concatenate([slopes * z_m[..., None], z_m[..., None]], axis=-1)
    count = np.full(z_m.shape, FRAMES)
    return Cloud(
        points,
        np.zeros(z_m.shape, np.uint8),
        count,
        scatter_m2,
        LENS.whole,
        0.0,
        FRAMES,
        lens=LENS,
    )


def found(
    shape_m: np.ndarray,
    *,
    poses: bool,
    patterns: list[np.ndarray] | None = None,
    shifts: Places = SHIFTS,
) -> Separated:
    captures = []
    for number, (distance_m, x_m, y_m) in enumerate(shifts):
        cloud = capture(
            number,
            shape_m,
            (distance_m, x_m, y_m),
            patterns and patterns[number],
        )
        pose = np.eye(4)
        pose[:3, 3] = x_m, y_m, shifts[0][0] - distance_m
        captures.append(flattened(cloud, cloud.valid, f"capture {number}", pose if poses else None))
    return separated(captures, LENS)


@pytest.fixture(scope="module")
def truth_m() -> np.ndarray:
    """The pattern, less what a smooth fit takes of it."""
    cloud = capture(0, wall(0.0), noise_m=1e-9)
    return flattened(cloud, cloud.valid, "truth").residual_m


def errors(result: Separated, truth_m: np.ndarray) -> tuple[float, float]:
    """The rms error of a map in mm, and the rms of the error over its stated deviation."""
    off_m = result.field.error_m - truth_m
    ratio = off_m**2 / result.field.variance_m2
    return float(np.sqrt(np.nanmean(off_m**2))) / MM, float(np.sqrt(np.nanmean(ratio)))


# ---- the pattern and the surface


def test_the_pattern_is_found_within_its_stated_deviation(truth_m):
    """20,480 pixels: the ratio is known to 0.5 %; the frames' scatter tells the noise to a per
    cent."""
    result = found(wall(0.0), poses=False)
    error_mm, ratio = errors(result, truth_m)
    assert error_mm == pytest.approx(NOISE_M / MM / np.sqrt(FRAMES * len(SHIFTS)), rel=0.1)
    assert ratio == pytest.approx(1.0, abs=0.04)
    assert result.field.rms_m == pytest.approx(float(np.nanstd(truth_m)), rel=0.01)
    assert result.field.warnings == ()
    assert result.field.distances_m == pytest.approx((0.55, 1.0), rel=0.01)


@pytest.mark.parametrize(
    ("rough_mm", "gain", "most_ratio"),
    [
        (0.1, 0.85, 1.15),
        (0.25, 0.6, 1.35),
    ],
)
def test_the_surface_is_parted_from_the_pattern(truth_m, rough_mm, gain, most_ratio):
    """Walls rough by a fifth and by half of the pattern: with poses the map is better than
    without, and says nothing; the stated deviation is too small by no more than
    `detectors.averages.flat_captures` states."""
    rough = wall(rough_mm * MM)
    solved = found(rough, poses=True)
    averaged = found(rough, poses=False)
    error_mm, ratio = errors(solved, truth_m)
    assert error_mm < gain * errors(averaged, truth_m)[0]
    assert 0.85 < ratio < most_ratio
    assert solved.separated
    assert solved.field.warnings == ()
    assert solved.surface_m / MM == pytest.approx(rough_mm, rel=0.1)


def test_without_poses_a_rough_surface_counts_as_noise_and_is_told(truth_m):
    result = found(wall(0.4 * MM), poses=False)
    (warning,) = result.field.warnings
    assert "is not stable" in warning
    assert "or the surface is not flat (state --poses" in warning
    assert errors(result, truth_m)[1] < 1.0
    assert found(wall(0.4 * MM), poses=True).field.warnings == ()


def test_a_pattern_that_drifts_or_depends_on_distance_is_told_with_its_size(truth_m):
    new_m = pattern()[::-1]
    drifting = [pattern(), pattern(), pattern() + 0.8 * new_m, pattern(), pattern() + 0.8 * new_m]
    result = found(wall(0.0), poses=False, patterns=drifting)
    assert result.in_time is not None
    # two beside three captures, of which two have the new pattern
    assert result.in_time.excess_m == pytest.approx(
        2 / 3 * 0.8 * float(np.nanstd(truth_m)), rel=0.1
    )
    for poses in (True, False):
        result = found(wall(0.0), poses=poses, patterns=drifting)
        (warning,) = result.field.warnings
        assert "is not stable: it changes from the first captures to the last by" in warning
        assert errors(result, truth_m + 0.4 * new_m)[1] < 1.0
    by_range = [pattern()] * 3 + [pattern() + 0.8 * new_m] * 2
    result = found(wall(0.0), poses=False, patterns=by_range)
    assert result.in_range is not None
    assert result.in_range.excess_m == pytest.approx(0.8 * float(np.nanstd(truth_m)), rel=0.1)
    assert "with distance by" in result.field.warnings[0]
    assert "from the first" not in result.field.warnings[0]


@pytest.mark.parametrize(
    "shifts",
    [
        ((0.8, 0.0, 0.0),),
        ((0.8, 0.0, 0.0),) * 2,
        ((0.8, 0.0, 0.0), (0.8, 0.01, 0.0)),
    ],
)
@pytest.mark.parametrize("poses", [True, False])
def test_one_place_cannot_part_surface_and_pattern(shifts, poses):
    warnings = found(wall(0.0), poses=poses, shifts=shifts).field.warnings
    assert "is assumed to be flat" in warnings[0]


def test_few_frames_cannot_tell_their_noise():
    cloud = replace(capture(0, wall(0.0)), n_frames=2)
    with pytest.raises(UserError, match="2 frames: too few to estimate the noise"):
        flattened(cloud, cloud.valid, "short")


def lone(
    distance_m: float,
    tilt: tuple[float, float] = (0.0, 0.0),
    residual_m: np.ndarray | None = None,
    variance_m2: float = 1.0,
    places_m: np.ndarray | None = None,
) -> FlatCapture:
    """A capture of a few pixels."""
    normal = np.array([*tilt, -1.0])
    residual_m = np.zeros((4, 5)) if residual_m is None else residual_m
    return FlatCapture(
        name="lone",
        frames=50,
        distance_m=distance_m,
        normal=normal / np.linalg.norm(normal),
        residual_m=residual_m,
        variance_m2=np.where(np.isfinite(residual_m), variance_m2, np.nan),
        places_m=places_m,
    )


@pytest.mark.parametrize(
    ("distances_m", "expected"),
    [
        ([1.0], [[0]]),
        ([1.0, 0.5, 0.9, 0.55], [[1, 3], [0, 2]]),
        # a ratio of just `NEAR_ENOUGH` is near, and counts from the nearest of the group
        ([NEAR_ENOUGH * 0.5, 0.5], [[0, 1]]),
        ([0.5, NEAR_ENOUGH * 0.501], [[0], [1]]),
        ([1.0, 1.15, 1.25, 0.95], [[0, 3], [1, 2]]),
        ([3.0, 2.0, 1.0], [[2], [1], [0]]),
    ],
)
def test_captures_at_similar_distances_are_one_group(distances_m, expected) -> None:
    assert list(_groups(distances_m)) == expected


def test_an_average_over_captures_weighs_by_the_variance() -> None:
    residuals = np.array([[[1.0, 2.0, np.nan]], [[4.0, np.nan, np.nan]]])
    variances = np.array([[[1.0, 3.0, np.nan]], [[2.0, np.nan, np.nan]]])
    mean, variance = _averaged(residuals, variances)
    np.testing.assert_allclose(mean, [[(1.0 + 4.0 / 2.0) / 1.5, 2.0, np.nan]])
    np.testing.assert_allclose(variance, [[1 / 1.5, 3.0, np.nan]])


def test_the_disagreement_is_the_variance_beyond_the_noise() -> None:
    residuals = np.array([[[1.0, 2.0, 5.0]], [[4.0, 2.5, np.nan]], [[np.nan, 6.0, np.nan]]])
    variances = np.full(residuals.shape, 0.5)
    variances[1] = 0.7
    counts = np.isfinite(residuals).sum(axis=0)
    # pixel 0: 4.5 between two values, their noise 0.6; pixel 1: 4.75 among three, noise 1.7 / 3
    expected = ((4.5 - 0.6) + (4.75 - 1.7 / 3)) / 2
    assert _disagreement_m2(residuals, variances, counts) == pytest.approx(expected)
    assert _disagreement_m2(residuals, 50.0 * variances, counts) == 0.0
    alone = np.where(counts > 1, np.nan, residuals[0])
    assert _disagreement_m2(alone[None], variances[:1], counts * (counts == 1)) == 0.0


def test_a_change_of_the_pattern_is_that_of_the_means() -> None:
    random = np.random.default_rng(5)
    patterns = random.normal(size=(4, 6, 7))
    patterns[0, 0, 0] = np.nan
    patterns[2:, 5, 6] = np.nan
    variances = random.uniform(0.5, 2.0, patterns.shape)
    change = _change(patterns, variances, [0, 1], [2, 3])
    assert change is not None
    weights = np.where(np.isfinite(patterns), 1.0 / variances, 0.0)
    values = np.nan_to_num(patterns)
    common = np.ones((6, 7), bool)
    common[5, 6] = False
    weighted = values * weights
    first_weight = weights[:2].sum(axis=0)[common]
    second_weight = weights[2:].sum(axis=0)[common]
    first = weighted[:2].sum(axis=0)[common] / first_weight
    second = weighted[2:].sum(axis=0)[common] / second_weight
    noise = 1 / first_weight + 1 / second_weight
    assert change.difference_m == pytest.approx(np.sqrt(np.mean((first - second) ** 2)))
    assert change.noise_m == pytest.approx(np.sqrt(np.mean(noise)))
    assert change.correlation == pytest.approx(np.corrcoef(first, second)[0, 1])
    assert PatternChange(0.0, 5.0, 3.0).excess_m == pytest.approx(4.0)
    assert PatternChange(0.0, 3.0, 5.0).excess_m == 0.0
    # no captures on a side, or fewer than two common pixels
    assert _change(patterns, variances, [], [2]) is None
    assert _change(patterns, variances, [2], []) is None
    for pixels, is_known in ((1, False), (2, True)):
        sparse = np.full((2, 6, 7), np.nan)
        sparse[:, 0, :pixels] = [1.0, 2.0][:pixels]
        assert (_change(sparse, variances, [0], [1]) is not None) == is_known


@pytest.mark.parametrize(
    ("others", "is_moved"),
    [
        ([lone(0.5)], False),
        ([lone(0.5019)], False),
        ([lone(0.5021)], True),
        ([lone(0.4979)], True),
        ([lone(0.5), lone(0.5021)], True),
        ([lone(0.5, (0.0029, 0.0))], False),
        ([lone(0.5, (0.0031, 0.0))], True),
        ([lone(0.5, (0.0, -0.0031))], True),
        ([lone(0.5, (0.0022, 0.0022))], True),
    ],
)
def test_a_camera_has_moved_if_its_plane_has(others, is_moved) -> None:
    """By more than 2 mm, or by more than 0.003 rad."""
    assert _moved([lone(0.5), *others]) == is_moved


@pytest.mark.parametrize(
    ("shift_m", "is_moved"),
    [((0.029, 0.0), False), ((0.031, 0.0), True), ((0.0, -0.031), True), ((0.022, 0.022), True)],
)
def test_a_camera_with_a_pose_has_moved_if_its_places_have(shift_m, is_moved) -> None:
    """By 30 mm along the surface; poses count more than planes."""
    points = np.random.default_rng(6).normal(size=(4, 5, 2))
    first = lone(0.5, places_m=points)
    second = lone(0.9, places_m=points + shift_m)
    assert _moved([first, second]) == is_moved
    assert _moved([first, first, second]) == is_moved


def test_facts_of_a_capture_count_its_finite_pixels() -> None:
    residual_m = np.zeros((4, 5))
    residual_m[0, :3] = np.nan
    capture_3 = lone(0.5, (0.0, np.tan(np.radians(20.0))), residual_m, 9e-6)
    assert capture_3.pixels == 17
    assert capture_3.noise_m == pytest.approx(3e-3)
    assert capture_3.tilt_deg == pytest.approx(20.0)


def test_a_flattened_plane_states_its_distance_normal_and_noise() -> None:
    """A plane tilted by 20 degrees about y and 10 about x: its normal by hand, residuals along the
    ray, and the variance of z over the cosine of the ray squared."""
    slopes = LENS.region_slopes(LENS.whole)
    normal = np.array([np.sin(0.35), 0.18, -np.cos(0.35)])
    normal /= np.linalg.norm(normal)
    z_m = 0.8 * normal[2] / (slopes @ normal[:2] + normal[2])
    length = np.sqrt(1 + (slopes**2).sum(axis=-1))
    bump_m = np.zeros(z_m.shape)
    noise_m = 0.02 * MM * np.random.default_rng(7).standard_normal(z_m.shape)
    # outliers are off by more than six deviations, to both sides
    for row, bump_mm in ((20, -0.13), (40, -0.11), (60, 0.11), (80, 0.13)):
        bump_m[row, 50:54] = bump_mm * MM
        noise_m[row, 50:54] = 0.0
    seen_m = z_m + (bump_m + noise_m) / length
    points = np.concatenate([slopes * seen_m[..., None], seen_m[..., None]], axis=-1)
    cloud = replace(
        capture(0, wall(0.0)),
        points_m=points,
        variance_m2=np.full(z_m.shape, 4e-8),
    )
    mask = cloud.valid & (np.arange(160) < 150)
    plain = flattened(cloud, mask, "plane")
    assert plain.places_m is None
    assert plain.distance_m == pytest.approx(np.median(seen_m[mask]), rel=1e-9)
    np.testing.assert_allclose(plain.normal, normal, atol=1e-4)
    np.testing.assert_allclose(plain.variance_m2[mask], (4e-8 / FRAMES * length**2)[mask])
    assert np.isnan(plain.variance_m2[~mask]).all()
    kept = mask & (np.abs(bump_m) < 0.12 * MM)
    np.testing.assert_array_equal(np.isfinite(plain.residual_m), kept)
    np.testing.assert_allclose(plain.residual_m[kept], (bump_m + noise_m)[kept], atol=0.01 * MM)
    assert np.nanmean(plain.residual_m) == pytest.approx(0.0, abs=1e-12)


def test_a_drifting_pattern_s_variance_holds_for_the_next_capture() -> None:
    """Two parts that scatter by t about the pattern differ by 2 t^2 and their mean is off a third
    by 3/2 t^2, which the variance gains: 3/4 of the excess squared."""
    random = np.random.default_rng(8)
    base = random.normal(size=(64, 64))
    change = 0.5 * random.normal(size=(64, 64))
    first = lone(0.5, residual_m=base * MM, variance_m2=1e-12)
    second = lone(0.5, residual_m=(base + change) * MM, variance_m2=1e-12)
    small_lens = Lens(64, 64, 100.0, 100.0, 32.0, 32.0)
    result = separated([first, second], small_lens)
    assert result.in_time is not None
    excess_m = np.sqrt(np.mean(change**2)) * MM
    assert result.in_time.excess_m == pytest.approx(excess_m, rel=1e-3)
    assert result.in_range is None
    assert not result.separated
    # the disagreement of two values is half of their squared difference
    shape_m2 = 0.5 * excess_m**2 - 1e-12
    assert result.surface_m == pytest.approx(np.sqrt(shape_m2), rel=1e-6)
    averaged_m2 = (shape_m2 + 1e-12) / 2
    np.testing.assert_allclose(
        result.field.variance_m2, averaged_m2 + 0.75 * result.in_time.excess_m**2, rtol=1e-6
    )
    np.testing.assert_allclose(result.field.error_m, (base + 0.5 * change) * MM, rtol=1e-6)
    assert result.noise_m == pytest.approx(np.sqrt(np.mean(result.field.variance_m2)))
    assert result.field.distances_m == (0.5, 0.5)
    notes = result.field.warnings
    assert f"changes from the first captures to the last by {excess_m / MM:.2g} mm" in notes[1]
    # a change below a fifth of the pattern is stable
    small = replace(second, residual_m=(base + 0.19 / 0.5 * change) * MM)
    large = replace(second, residual_m=(base + 0.24 / 0.5 * change) * MM)
    for field, count in ((small, 1), (large, 2)):
        assert len(separated([first, field], small_lens).field.warnings) == count
    # a difference of the size of its noise is no change
    noisy_m2 = (0.5 * MM) ** 2
    quiet = replace(first, variance_m2=np.full((64, 64), 0.4 * noisy_m2))
    noisy = replace(second, variance_m2=np.full((64, 64), 0.4 * noisy_m2))
    assert separated([quiet, noisy], small_lens).in_time.noise_m == pytest.approx(
        np.sqrt(0.8 * noisy_m2)
    )
    for part, count in ((0.25, 2), (0.44, 1)):
        quiet = replace(first, variance_m2=np.full((64, 64), part * noisy_m2))
        noisy = replace(second, variance_m2=np.full((64, 64), part * noisy_m2))
        assert len(separated([quiet, noisy], small_lens).field.warnings) == count


def test_pattern_and_shape_are_those_of_dense_least_squares() -> None:
    """Two captures of 4 x 30 pixels in steps of 1 m: two rows of the first see one cell, and in the
    second each row sees half of that cell's neighbours. Each value is pattern + shape + noise, with
    their variances as a prior."""
    random = np.random.default_rng(11)
    shape = (4, 30)
    rows, columns = np.indices(shape)
    noise_m2 = np.stack([np.full(shape, 0.04), np.full(shape, 0.09)])
    residuals = random.normal(size=(2, *shape))
    residuals[0, 1, 3] = np.nan
    residuals[:, 3, 7] = np.nan
    captures = []
    cells = []
    for number, first_row in enumerate((0, 1)):
        cell_row = (rows + first_row) // 2 + 10 * number
        places_m = np.stack([columns + 0.25, cell_row + 0.25], axis=-1)
        captures.append(lone(0.5, residual_m=residuals[number], places_m=places_m))
        cells.append(cell_row * 30 + columns)
    shape_m2 = 0.25
    result = _solved(captures, residuals, noise_m2, shape_m2)
    error_m, variance_m2, shapes_m = result
    finite = np.isfinite(residuals)
    value = residuals[finite]
    noise = noise_m2[finite]
    pattern_m2 = np.mean(value**2) - noise.mean() - shape_m2
    pixel = np.broadcast_to(np.arange(120).reshape(shape), residuals.shape)[finite]
    names, cell = np.unique(np.stack(cells)[finite], return_inverse=True)
    design = np.zeros((len(value), 120 + len(names)))
    design[np.arange(len(value)), pixel] = 1.0
    design[np.arange(len(value)), 120 + cell] = 1.0
    prior = np.r_[np.full(120, 1 / pattern_m2), np.full(len(names), 1 / shape_m2)]
    information = design.T @ (design / noise[:, None]) + np.diag(prior)
    solution = np.linalg.solve(information, design.T @ (value / noise))
    covariance = np.linalg.inv(information)
    is_seen = finite.any(axis=0)
    np.testing.assert_allclose(error_m[is_seen], solution[:120].reshape(shape)[is_seen], atol=1e-3)
    np.testing.assert_allclose(shapes_m[finite], solution[120:][cell], atol=1e-3)
    exact_m2 = covariance.diagonal()[:120].reshape(shape)
    # beliefs go around in loops
    np.testing.assert_allclose(variance_m2[is_seen], exact_m2[is_seen], rtol=0.25)
    assert np.isnan(error_m[~is_seen]).all()
    assert np.isnan(variance_m2[~is_seen]).all()
    assert np.isnan(shapes_m[~finite]).all()


def test_without_shared_cells_each_value_has_noise_and_shape() -> None:
    """Two captures of cells of their own: the variance is that of two values and the prior."""
    random = np.random.default_rng(12)
    shape = (4, 30)
    rows, columns = np.indices(shape)
    residuals = random.normal(size=(2, *shape))
    noise_m2 = random.uniform(0.02, 0.2, (2, *shape))
    captures = []
    for number in range(2):
        places_m = np.stack([columns + 0.25, rows + 10 * number + 0.25], axis=-1)
        captures.append(lone(0.5, residual_m=residuals[number], places_m=places_m))
    for shape_m2 in (0.25, 3.0):
        error_m, variance_m2, _ = _solved(captures, residuals, noise_m2, shape_m2)
        beyond_m2 = np.mean(residuals**2) - noise_m2.mean() - shape_m2
        # a pattern below the noise counts as large as the noise
        pattern_m2 = max(beyond_m2, noise_m2.mean())
        weights = 1 / (noise_m2 + shape_m2)
        expected_m2 = 1 / (1 / pattern_m2 + weights.sum(axis=0))
        np.testing.assert_allclose(variance_m2, expected_m2, rtol=1e-9)
        expected_m = (weights * residuals).sum(axis=0) * expected_m2
        np.testing.assert_allclose(error_m, expected_m, atol=1e-3)


def test_changes_in_time_and_in_range_compare_halves_and_ends() -> None:
    """Three captures nearby, two in the middle, one far away: the first of the near ones and of the
    middle ones beside the others of both, and the near ones beside the far one."""
    random = np.random.default_rng(10)
    distances_m = (0.5, 0.7, 0.5, 0.9, 0.7, 0.5)
    residuals = random.normal(size=(6, 20, 30))
    captures = []
    for distance_m, residual_m in zip(distances_m, residuals, strict=True):
        captures.append(lone(distance_m, residual_m=residual_m, variance_m2=0.01))
    result = separated(captures, Lens(30, 20, 50.0, 50.0, 15.0, 10.0))
    nearest_mean = residuals[[0, 2, 5]].mean(axis=0)
    first = residuals[[0, 1]].mean(axis=0)
    last = residuals[[2, 5, 4]].mean(axis=0)
    assert result.in_range is not None
    assert result.in_time is not None
    in_range_m = np.sqrt(np.mean((nearest_mean - residuals[3]) ** 2))
    assert result.in_range.difference_m == pytest.approx(in_range_m)
    assert result.in_range.noise_m == pytest.approx(np.sqrt(0.01 / 3 + 0.01))
    in_time_m = np.sqrt(np.mean((first - last) ** 2))
    assert result.in_time.difference_m == pytest.approx(in_time_m)
    assert result.in_time.noise_m == pytest.approx(np.sqrt(0.01 / 2 + 0.01 / 3))
    assert result.field.distances_m == (0.5, 0.9)


# ---- the correction


def test_a_corrected_cloud_has_its_noise_and_the_map_s_left():
    field = found(wall(0.0), poses=False).field
    cloud = capture(9, wall(0.0), (0.7, 0.0, 0.0))
    cleaned = corrected(cloud, field)
    residual_m = flattened(cleaned, cleaned.valid, "corrected").residual_m
    assert cleaned.mean_variance_m2 is not None
    axial_m = residual_m * cloud.points_m[..., 2] / np.linalg.norm(cloud.points_m, axis=-1)
    assert np.nanstd(axial_m) == pytest.approx(
        float(np.sqrt(cleaned.mean_variance_m2.mean())), rel=0.03
    )
    np.testing.assert_allclose(
        np.cross(cleaned.points_m, cloud.points_m),
        0.0,
        atol=1e-15,
    )  # along the rays
    part = Region(10, 90, 30, 120)
    rows, columns = part.within(LENS.whole)
    cut = {
        name: getattr(cloud, name)[rows, columns]
        for name in ("points_m", "reason", "count", "variance_m2")
    }
    np.testing.assert_array_equal(
        corrected(replace(cloud, region=part, **cut), field).points_m,
        cleaned.points_m[rows, columns],
    )
    single = corrected(replace(cloud, n_frames=1), field)
    assert single.mean_variance_m2 is None


def test_the_map_s_variance_counts_along_the_axis() -> None:
    """A range error of variance v makes one of z of v cos^2 of the ray's angle, beside the noise of
    the frames."""
    cloud = capture(5, wall(0.0))
    zeros = np.zeros(cloud.valid.shape)
    plain = corrected(cloud, FlatField(zeros, zeros, LENS, (0.5, 1.0)))
    unsure = corrected(cloud, FlatField(zeros, zeros + 4e-6, LENS, (0.5, 1.0)))
    assert plain.mean_variance_m2 is not None
    assert unsure.mean_variance_m2 is not None
    slopes = LENS.region_slopes(LENS.whole)
    square_cosine = 1.0 / (1.0 + (slopes**2).sum(axis=-1))
    added_m2 = unsure.mean_variance_m2 - plain.mean_variance_m2
    np.testing.assert_allclose(added_m2, 4e-6 * square_cosine, rtol=1e-6)
    assert square_cosine.min() < 0.9


def test_pixels_without_a_pattern_stay_and_are_told():
    field = found(wall(0.0), poses=False).field
    cloud = capture(9, wall(0.0))
    error_m = field.error_m.copy()
    error_m[:, :40] = np.nan
    holed = replace(field, error_m=error_m, warnings=("it drifts",))
    cleaned = corrected(cloud, holed)
    np.testing.assert_array_equal(cleaned.points_m[:, :40], cloud.points_m[:, :40])
    assert cleaned.mean_variance_m2 is not None
    assert cleaned.mean_variance_m2[:, :40].mean() > 10 * cleaned.mean_variance_m2[:, 40:].mean()
    assert doubts(cloud, holed, "unit.npz") == (
        "the flat field unit.npz: it drifts",
        "the flat field unit.npz covers 75 % of the valid pixels; others are not corrected",
    )
    far = doubts(capture(9, wall(0.0), (1.5, 0.0, 0.0)), field, "unit.npz")
    assert far == (
        "the flat field unit.npz was measured at 0.55 to 1.00 m, this capture is at 1.50 m",
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lens": replace(LENS, fx=300.0)}, "is not that of the flat field"),
        (
            {"lens": replace(LENS, width=320, height=256)},
            "has 160 x 128 pixels, the capture has 320 x 256",
        ),
        ({"organised": False}, "no pixel grid"),
        ({"projection": "parallel"}, "no pixel grid"),
    ],
)
def test_another_camera_s_cloud_is_refused(changes, message):
    flat = FlatField(np.zeros((128, 160)), np.ones((128, 160)), LENS, (1.0, 1.0))
    with pytest.raises(UserError, match=message):
        corrected(replace(capture(0, wall(0.0)), **changes), flat)


# ---- files and programs


def test_a_file_holds_what_was_saved_and_others_are_refused(tmp_path):
    flat = FlatField(
        np.full((128, 160), 2e-4),
        np.full((128, 160), 1e-8),
        LENS,
        (0.5, 1.0),
        ("it drifts",),
    )
    flat.error_m[0, 0] = np.nan
    path = tmp_path / "unit.npz"
    save_flat_field(path, flat)
    stored = load_flat_field(path)
    np.testing.assert_array_equal(stored.error_m, flat.error_m.astype(np.float32))
    assert (stored.lens, stored.distances_m, stored.warnings) == (LENS, (0.5, 1.0), ("it drifts",))
    arrays = dict(np.load(path))
    for changes, message in (
        ({"version": np.array(2)}, "was written by a newer tofpod"),
        ({"version": np.array(1.5)}, "states the invalid version"),
        ({"error_m": np.zeros((3, 3))}, "do not belong together"),
        ({"variance_m2": -np.ones((128, 160))}, "do not belong together"),
        ({"lens": np.array([160.0, 128.0])}, "not a flat field"),
        ({"lens": np.full(14, np.nan)}, "not a flat field"),
        ({"warnings": np.array("[1]")}, "do not belong together"),
        ({"error_m": np.array([{}])}, "cannot be read as arrays"),
    ):
        np.savez(path, **{**arrays, **changes})
        with pytest.raises(UserError, match=message):
            load_flat_field(path)
    path.write_bytes(b"PK nonsense")
    with pytest.raises(UserError, match="cannot be read as arrays"):
        load_flat_field(path)
    np.savez(path, depth=np.zeros((4, 4)))
    with pytest.raises(UserError, match="states no version"):
        load_flat_field(path)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three captures of 8 frames each as .npy in metres, and one more to judge, with a lens."""
    folder = tmp_path_factory.mktemp("walls")
    for number, pose_m in enumerate((*SHIFTS[:3], SHIFTS[0])):
        z_m = capture(number, wall(0.0), pose_m, noise_m=0.0).points_m[..., 2]
        noise = np.random.default_rng([4, number]).standard_normal((8, *z_m.shape)) * NOISE_M
        name = "judged" if number == 3 else f"wall{number}"
        np.save(folder / f"{name}.npy", (z_m + noise).astype(np.float32))
    stated = {name: getattr(LENS, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "lens.json").write_text(json.dumps(stated))
    return folder


@pytest.mark.usefixtures("unpictured")
def test_the_program_writes_map_and_figures_and_detect_uses_it(recorded, tmp_path, capsys, truth_m):
    walls = [str(path) for path in sorted(recorded.glob("wall*.npy"))]
    options = ["--unit", "m"]
    options += ["--intrinsics", str(recorded / "lens.json"), "--crop", "none"]
    unit = tmp_path / "unit.npz"
    assert flatfield.main([*walls, *options, "--out", str(unit)]) == 0
    first, *remainder = capsys.readouterr().out.splitlines()
    assert first.startswith("warning: nothing shows that the camera moved")
    assert remainder[0].startswith("fixed pattern 0.4")
    facts = json.loads(unit.with_suffix(".json").read_text())
    assert facts["warnings"] == list(load_flat_field(unit).warnings)
    figures = {row["figure"]: row["value"] for row in facts["figures"]}
    assert figures["noise of the map"] == pytest.approx(NOISE_M / MM / np.sqrt(24), rel=0.05)
    assert figures["pattern"] == pytest.approx(float(np.nanstd(truth_m)) / MM, rel=0.03)
    assert figures["change, near and far captures"] is None
    assert len(facts["captures"]) == 3
    assert unit.with_suffix(".png").read_bytes().startswith(b"\x89PNG")

    own_arguments = [walls[0], *options, "--threshold", "5", "--flat-field", str(unit)]
    assert detect.main(own_arguments) == 2
    assert "was made from this capture: 8 of its frames are in both" in capsys.readouterr().err
    judged = [str(recorded / "judged.npy"), *options, "--threshold", "5"]
    assert detect.main([*judged, "--flat-field", str(unit), "--out", str(tmp_path / "with")]) == 0
    assert capsys.readouterr().out.startswith(f"warning: the flat field {unit}: nothing shows that")
    assert detect.main(judged) == 0
    unit_of_score = float(
        re.search(r"one unit of score is .* ([0-9.]+) mm for", capsys.readouterr().out)[1]
    )
    with_field = json.loads((tmp_path / "with" / "findings.json").read_text())
    assert with_field["surface"]["one_unit_of_score_mm"] < 0.6 * unit_of_score
    assert str(unit) in [file["path"] for file in with_field["provenance"]["files"]]


def test_the_program_refuses_what_makes_no_flat_field(recorded, tmp_path, capsys):
    lone = str(recorded / "wall0.npy")
    lens = ["--unit", "m", "--intrinsics", str(recorded / "lens.json")]
    single = tmp_path.parent / "single.npy"
    np.save(single, np.load(lone)[:1])
    for arguments, message in (
        ([lone, "--unit", "m", "--out", "unit.npz"], "the lens of these depth images is unknown"),
        ([lone, *lens, "--out", "unit.png"], "a name that ends in .npz"),
        ([lone, *lens, "--crop", "sphere", "--out", "unit.npz"], "no such crop"),
        ([lone, lone, *lens, "--out", "unit.npz"], "is named twice"),
        ([str(single), *lens, "--out", "unit.npz"], "record 50 frames"),
    ):
        assert flatfield.main(arguments) == 2
        assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_lone_capture_is_judged_by_its_halves(recorded, tmp_path, capsys):
    lens = ["--unit", "m", "--intrinsics", str(recorded / "lens.json"), "--crop", "none"]
    assert (
        flatfield.main([str(recorded / "wall0.npy"), *lens, "--out", str(tmp_path / "unit.npz")])
        == 0
    )
    facts = json.loads((tmp_path / "unit.json").read_text())
    assert [row["capture"] for row in facts["captures"]] == [
        "wall0.npy, first half",
        "wall0.npy, second half",
    ]
    figures = {row["figure"]: row["value"] for row in facts["figures"]}
    # 4 frames in each half
    signal = figures["pattern"] ** 2
    noise = (NOISE_M / MM) ** 2 / 4
    expected = signal / (signal + noise)
    assert figures["correlation, first and last captures"] == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
def test_a_real_unit_s_pattern_is_stable_within_a_capture(shared_data, tmp_path, capsys):
    """22 frames of a real Azure Kinect from one place: the pattern of the first half is that of
    the second, within the noise, so that their correlation is what pattern and noise make it."""
    walls = tmp_path / "walls"
    walls.mkdir()
    for path in sorted((shared_data / "azure_nfov_walls").glob("[0-9]*.png")):
        (walls / path.name).symlink_to(path)
    unit = tmp_path / "unit.npz"
    assert (
        flatfield.main([str(walls), "--intrinsics", "azure_kinect_nfov", "--out", str(unit)]) == 0
    )
    assert "is assumed to be flat" in capsys.readouterr().out.splitlines()[0]
    facts = json.loads(unit.with_suffix(".json").read_text())
    figures = {row["figure"]: row["value"] for row in facts["figures"]}
    assert figures["pattern"] > 2 * figures["noise of the map"]
    assert figures["change, first and last captures"] < 0.1
    noise_mm = facts["captures"][0]["noise_mm"]
    expected = figures["pattern"] ** 2 / (figures["pattern"] ** 2 + noise_mm**2)
    assert figures["correlation, first and last captures"] == pytest.approx(expected, abs=0.05)


# ---- experiments

BINNED = "source.camera.name=azure_kinect_nfov_binned"  # a quarter of the pixels
FLAT = "capture.flat_field={frames: 20, distance_m: 1.0}"


def test_an_experiment_with_a_flat_field_is_repeatable_and_quieter(study_out, tmp_path):
    records = {}
    for name, changes in (("first", [FLAT]), ("again", [FLAT]), ("without", [])):
        changes = [*changes, "sweep={}", "capture.frames=8", "threshold={k: 5.0}", BINNED]
        changes.append("study={boards: 1, hole_free_boards: 1}")
        experiment = load_experiment(study_out.parent / "tiny.yaml", changes)
        plan = plan_of(experiment, tmp_path / "renders")
        flat_field_of.cache_clear()
        outcome = run_serially(plan, tmp_path / name)
        assert outcome.failures == []
        records[name] = [
            row for record in records_of(tmp_path / name, outcome) for row in record["runs"]
        ]
        for row in records[name]:
            del row["seconds_frames"], row["seconds_detect"]
    assert records["first"] == records["again"]
    quieter = [
        a["scale_mm"] / b["scale_mm"]
        for a, b in zip(records["first"], records["without"], strict=True)
    ]
    # 8 frames of 0.5 mm noise leave 0.18 mm, and the map's own 0.2 mm, of a pattern of 0.55 mm
    assert max(quieter) < 0.6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("capture.flat_field={frames: 50, distance_m: 20.0}", "gives no range at 20 m"),
        ("capture.flat_field={frames: 1, distance_m: 1.0}", "4"),
    ],
)
def test_an_impossible_flat_field_is_refused(tmp_path, change, message):
    (tmp_path / "tiny.yaml").write_text(STUDY)
    with pytest.raises(DeclarationError, match=message):
        load_experiment(tmp_path / "tiny.yaml", [change])


# ---- numbers of a field by hand


def plain_field(error_m: np.ndarray, **values: object) -> FlatField:
    """A field of the camera above, known to 0.01 mm, measured at 0.5 to 1.0 m."""
    variance_m2 = np.full(error_m.shape, (0.01 * MM) ** 2)
    return replace(FlatField(error_m, variance_m2, LENS, (0.5, 1.0)), **values)


def test_the_rms_of_a_pattern_is_that_without_the_map_s_noise() -> None:
    error_m = np.full((128, 160), 5e-4)
    error_m[::2] = -7e-4
    error_m[5, 5] = np.nan
    noisy = plain_field(error_m, variance_m2=np.full(error_m.shape, 1.3e-7))
    squares = (64 * 160 * 4.9e-7 + (64 * 160 - 1) * 2.5e-7) / (128 * 160 - 1)
    assert noisy.rms_m == pytest.approx(np.sqrt(squares - 1.3e-7))
    assert plain_field(0.0 * error_m).rms_m == 0.0


def test_a_correction_moves_points_along_their_rays_by_the_error() -> None:
    random = np.random.default_rng(9)
    error_m = 1e-3 * random.standard_normal((128, 160))
    error_m[:3] = np.nan
    field = plain_field(error_m, variance_m2=random.uniform(1e-9, 5e-9, error_m.shape))
    cloud = capture(9, wall(0.0), (0.7, 0.0, 0.0))
    moved = corrected(cloud, field)
    before_m = np.linalg.norm(cloud.points_m, axis=-1)
    after_m = np.linalg.norm(moved.points_m, axis=-1)
    is_known = np.isfinite(error_m)
    np.testing.assert_allclose((before_m - after_m)[is_known], error_m[is_known], atol=1e-15)
    np.testing.assert_array_equal(moved.points_m[~is_known], cloud.points_m[~is_known])
    rays = cloud.points_m / before_m[..., None]
    np.testing.assert_allclose(moved.points_m / after_m[..., None], rays, atol=1e-12)
    # along the axis: the frames' noise and the map's, or the pattern where that is unknown
    cosine2 = rays[..., 2] ** 2
    assert moved.mean_variance_m2 is not None
    frames_m2 = moved.mean_variance_m2 - cosine2 * np.where(is_known, field.variance_m2, 0.0)
    unknown_m2 = frames_m2[~is_known] - (cosine2 * field.rms_m**2)[~is_known]
    scatter_m2 = NOISE_M**2 / FRAMES
    assert np.median(frames_m2[is_known]) == pytest.approx(scatter_m2, rel=0.02)
    assert np.median(unknown_m2) == pytest.approx(scatter_m2, rel=0.05)
    # a part of the sensor takes its part of the map
    part = replace(
        cloud,
        points_m=cloud.points_m[20:60, 30:90],
        reason=cloud.reason[20:60, 30:90],
        count=cloud.count[20:60, 30:90],
        variance_m2=cloud.variance_m2[20:60, 30:90],
        region=Region(20, 60, 30, 90),
    )
    np.testing.assert_array_equal(corrected(part, field).points_m, moved.points_m[20:60, 30:90])


@pytest.mark.parametrize(
    ("distance_m", "text"),
    [
        (0.42, ""),
        (0.41, "was measured at 0.50 to 1.00 m, this capture is at 0.41 m"),
        (1.19, ""),
        (1.21, "was measured at 0.50 to 1.00 m, this capture is at 1.21 m"),
    ],
)
def test_a_capture_a_fifth_nearer_or_farther_is_doubted(distance_m, text) -> None:
    field = plain_field(np.zeros((128, 160)))
    cloud = capture(9, wall(0.0), (distance_m, 0.0, 0.0), noise_m=1e-6)
    notes = doubts(cloud, field, "f.npz")
    assert [text in note for note in notes] == ([True] if text else [])
    lone_distance = replace(field, distances_m=(1.0, 1.009))
    if distance_m < 0.5:
        assert "measured at 1.00 m, this" in doubts(cloud, lone_distance, "f.npz")[0]


@pytest.mark.parametrize(("rows", "is_doubted"), [(12, False), (13, True)])
def test_a_map_that_covers_less_than_nine_tenths_is_doubted(rows, is_doubted) -> None:
    error_m = np.zeros((128, 160))
    error_m[:rows] = np.nan
    cloud = capture(9, wall(0.0), (0.7, 0.0, 0.0), noise_m=1e-6)
    notes = doubts(cloud, plain_field(error_m), "f.npz")
    covers = f"covers {100 * (1 - rows / 128):.0f} % of the valid pixels"
    assert [covers in note for note in notes] == ([True] if is_doubted else [])


@pytest.mark.parametrize("name", ["fx", "fy", "cx", "cy"])
@pytest.mark.parametrize("share", [0.0199, 0.0201, -0.0199, -0.0201])
def test_a_lens_two_per_cent_off_is_another_one(name: str, share: float) -> None:
    """Of the focal length, which is more than the width."""
    field = plain_field(np.zeros((128, 160)))
    lens = replace(LENS, **{name: getattr(LENS, name) + share * LENS.fx})
    cloud = replace(capture(9, wall(0.0), (0.7, 0.0, 0.0)), lens=lens)
    if abs(share) < 0.02:
        corrected(cloud, field)
    else:
        with pytest.raises(UserError, match="is not that of the flat field"):
            corrected(cloud, field)
