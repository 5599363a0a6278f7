"""Figures of captures whose noise, surfaces, dropouts and edges are planted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import statsmodels.api
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


@pytest.mark.parametrize("sigma_steps", [0.12, 0.25, 0.4, 0.7, 1.5])
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


# ---- frames, surfaces and pixels


def displaced(offsets_mm: list[float] | np.ndarray) -> StillCapture:
    """A relief of 4 x 5 pixels, displaced as a whole in each frame."""
    relief_m = 1.0 + 0.01 * np.arange(20).reshape(4, 5)
    return still(relief_m + np.array(offsets_mm)[:, None, None] * MM)


def test_drift_and_jumps_are_told_apart() -> None:
    """Frames drift by 1 mm each; the fourth jumps by 20 mm."""
    offsets_mm = np.array([0.0, 1.0, 2.0, 23.0, 4.0, 5.0, 6.0])
    capture = displaced(offsets_mm)
    close = {"abs": 2e-7}
    assert capture.offsets_m == pytest.approx((offsets_mm - offsets_mm.mean()) * MM, **close)
    assert capture.drift_m == pytest.approx(6.0 * MM, **close)
    assert capture.without_drift_m == pytest.approx([0, 0, 0, 20.0 * MM, 0, 0, 0], **close)
    assert capture.kept.tolist() == [True, True, True, False, True, True, True]
    relief_m = 1.0 + 0.01 * np.arange(20).reshape(4, 5)
    assert capture.mean_m == pytest.approx(relief_m + offsets_mm.mean() * MM, **close)
    assert np.abs(capture.noise_m).max() < 3e-7
    assert capture.noise_m.shape == (6, 4, 5)


@pytest.mark.parametrize(("jump_mm", "kept"), [(2.9, True), (3.1, False), (-3.1, False)])
def test_a_frame_jumps_by_more_than_three_millimetres(jump_mm: float, kept: bool) -> None:
    assert displaced([0, 0, 0, 0, jump_mm, 0, 0, 0, 0]).kept[4] == kept


@pytest.mark.parametrize(("jump_mm", "kept"), [(18.5, True), (19.1, False)])
def test_a_frame_jumps_by_more_than_six_deviations(jump_mm: float, kept: bool) -> None:
    """Frames alternate by 1 mm to either side; from their median, the median distance is 2 mm, and
    the limit 6 x 1.4826 x 2 mm = 17.8 mm."""
    offsets_mm = np.where(np.arange(41) % 2, -1.0, 1.0)
    offsets_mm[20] = jump_mm
    kept_frames = displaced(offsets_mm).kept
    assert kept_frames[20] == kept
    assert kept_frames.sum() == 40 + kept


def test_the_variance_of_a_pixel_by_hand() -> None:
    """Two pixels deviate to opposite sides, so that no frame is displaced; the third has a single
    range, the fourth none, and the last frame jumps."""
    deviation_mm = np.array([0.0, 1.0, -4.0, 3.0, 0.0])
    z_m = np.full((5, 1, 4), np.nan)
    z_m[:, 0, 0] = 1.0 + deviation_mm * MM
    z_m[:, 0, 1] = 1.0 - deviation_mm * MM
    z_m[0, 0, 2] = 1.0
    z_m[4] += 50.0 * MM
    capture = still(z_m)
    # of the four frames that do not jump, 26 mm^2 over three
    expected = [26 / 3 * MM**2, 26 / 3 * MM**2, np.nan, np.nan]
    assert capture.kept.tolist() == [True] * 4 + [False]
    assert capture.variance_m2[0] == pytest.approx(expected, rel=1e-3, nan_ok=True)
    cloud = capture.cloud()
    assert cloud.count[0].tolist() == [4, 4, 1, 0]
    assert cloud.reason[0].tolist() == [0, 0, 0, 1]
    assert cloud.n_frames == 4
    assert np.array_equal(cloud.points_m[..., 2], capture.mean_m, equal_nan=True)


def test_a_pixel_is_steady_with_a_range_in_most_frames_and_off_the_rim() -> None:
    z_m = np.ones((4, 20, 30))
    z_m[2:, 10, 10] = np.nan
    z_m[3:, 10, 20] = np.nan
    alone = still(z_m).steady
    assert not alone[10, 10]
    assert alone[10, 20]
    assert alone.sum() == 20 * 30 - 1
    mask = np.zeros((20, 30), bool)
    mask[:, 5:25] = True
    on_plane = still(z_m, planes=((Plane(1.0), mask),)).steady
    expected = np.zeros((20, 30), bool)
    expected[3:17, 8:22] = True
    expected[10, 10] = False
    assert np.array_equal(on_plane, expected)


def test_rays_are_longer_than_depth_and_meet_planes_at_an_angle() -> None:
    slopes = np.array([[[0.75, 0.0], [0.3, 0.4], [-0.2, 0.1], [0.0, 0.0]]])
    plane = Plane(1.0, 0.5, -0.2)
    mask = np.array([[True, True, True, False]])
    capture = still(np.ones((3, 1, 4)), slopes=slopes, planes=((plane, mask),))
    assert capture.stretch[0] == pytest.approx([1.25, np.sqrt(1.25), np.sqrt(1.05), 1.0])
    normal = np.array([0.5, -0.2, -1.0])
    rays = np.concatenate([slopes[0], np.ones((4, 1))], axis=1)
    lengths = np.linalg.norm(normal) * np.linalg.norm(rays, axis=1)
    expected = np.abs(rays @ normal) / lengths
    assert capture.cosine[0, :3] == pytest.approx(expected[:3])
    assert capture.cosine[0, 3] == 1.0


@pytest.mark.parametrize(("width", "closed"), [(6, True), (7, False)])
def test_a_surface_as_a_whole_has_its_lost_pixels(width: int, closed: bool) -> None:
    """Holes are filled, and bays of up to six pixels, along both axes; the rim is left out, also at
    the edge of the image."""
    mask = np.zeros((60, 80), bool)
    mask[:50, 10:70] = True
    mask[20:34, 45:60] = False
    across = mask.copy()
    across[20 : 20 + width, 10:30] = False
    along = mask.copy()
    along[:20, 20 : 20 + width] = False
    expected = np.zeros((60, 80), bool)
    expected[3:47, 13:67] = True
    unused = np.zeros((60, 80), bool)
    unused[5, 30] = True
    capture = still(np.ones((3, 60, 80)), used=~unused)
    for bay in (across, along):
        equal = np.array_equal(capture.whole(bay), expected & ~unused)
        assert equal == closed


def test_a_shape_is_a_plane_with_its_relief() -> None:
    """A bowl of 5 mm on a tilted plane; beyond the surface's pixels, the relief does not grow."""
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 80), np.linspace(-0.2, 0.2, 60))
    slopes = np.stack([x, y], axis=-1)
    plane = Plane(1.2, 0.3)
    relief_m = 5e-3 * ((x / 0.3) ** 2 + (y / 0.2) ** 2)
    z_m = plane.z_along_m(slopes) + relief_m
    mask = np.zeros(x.shape, bool)
    mask[10:50, 10:70] = True
    capture = still(np.stack(3 * [z_m]), slopes=slopes, planes=((plane, mask),))
    (shape_m,) = capture.shapes_m
    assert shape_m[mask] == pytest.approx(z_m[mask], abs=0.1 * MM)
    off_m = (shape_m - plane.z_along_m(slopes))[~mask]
    assert off_m.max() == pytest.approx(relief_m[mask].max(), abs=0.1 * MM)
    assert off_m.min() > -0.1 * MM


def test_amplitudes_are_averaged_over_all_frames() -> None:
    frames = [np.array([[4.0, 0.0, np.nan]]), np.array([[8.0, 0.0, 3.0]])]
    mean = measure.mean_amplitude(frames)
    assert mean is not None
    assert mean[0] == pytest.approx([6.0, np.nan, 1.5], nan_ok=True)
    assert measure.mean_amplitude([frames[0], None]) is None


# ---- cells and the law of noise


def test_cells_hold_pixels_of_like_range_angle_and_brightness() -> None:
    """Four parts of a still scene; one with 299 pixels is too small."""
    rng = np.random.default_rng(4)
    z_m = np.full((50, 1, 1499), 1.04)
    z_m[:, 0, 300:700] = 2.08
    sigma_m = np.full(1499, 1e-3)
    sigma_m[300:] = 3e-3
    z_m += sigma_m * rng.standard_normal(z_m.shape)
    amplitude = np.full((1, 1499), 90.0)
    amplitude[0, 700:1000] = 112.0
    amplitude[0, 1000:1200] = 500.0
    amplitude[0, 1200:] = 2000.0
    amplitude[0, 1000] = np.nan
    slopes = np.zeros((1, 1499, 2))
    capture = still(z_m, amplitude=amplitude, slopes=slopes)
    cells = sorted(measure.cells_of(capture), key=lambda cell: cell.light)
    assert [cell.pixels for cell in cells] == [300, 300, 400]
    assert [cell.range_m for cell in cells] == pytest.approx([1.04, 1.04, 2.08], rel=1e-3)
    assert [cell.amplitude for cell in cells] == pytest.approx([90.0, 112.0, 90.0])
    expected = 1.04**2 * np.array([90.0, 112.0, 360.0])
    assert [cell.light for cell in cells] == pytest.approx(expected, rel=1e-3)
    assert [cell.sigma_m for cell in cells] == pytest.approx([1e-3, 3e-3, 3e-3], rel=0.03)
    assert {cell.angle_deg for cell in cells} == {0.0}
    assert {cell.capture for cell in cells} == {"still"}


def test_without_amplitude_the_cosine_is_the_light() -> None:
    """Rays at 10 to 30 degrees on a wall across the axis."""
    angle_deg = np.repeat([12.0, 25.0], 400)
    slopes = np.zeros((1, 800, 2))
    slopes[0, :, 0] = np.tan(np.radians(angle_deg))
    noise_m = 1e-3 * np.random.default_rng(4).standard_normal((20, 1, 800))
    mask = np.ones((1, 800), bool)
    capture = still(1.0 + noise_m, slopes=slopes, planes=((Plane(1.0), mask),))
    capture.__dict__["steady"] = mask  # a single row has no pixel off the rim
    cells = list(measure.cells_of(capture))
    assert [cell.angle_deg for cell in cells] == pytest.approx([12.0, 25.0])
    assert [cell.light for cell in cells] == pytest.approx(np.cos(np.radians([12.0, 25.0])))
    assert np.isnan([cell.amplitude for cell in cells]).all()


def cells(
    sigma_m: np.ndarray, range_m: np.ndarray, light: np.ndarray, pixels: np.ndarray
) -> list[measure.NoiseCell]:
    columns = zip(pixels.tolist(), range_m, light, sigma_m, strict=True)
    return [
        measure.NoiseCell("c", int(n), float(r), 60.0, np.nan, float(b), float(s))
        for n, r, b, s in columns
    ]


def test_the_law_of_noise_is_weighted_least_squares_on_logarithms() -> None:
    """Exponents and standard errors as statsmodels gives them."""
    rng = np.random.default_rng(6)
    range_m = rng.uniform(0.5, 3.0, 40)
    light = rng.uniform(50.0, 500.0, 40)
    pixels = rng.integers(300, 3000, 40)
    sigma_m = 2e-3 * range_m**1.4 * (light / 100.0) ** -0.6 * np.exp(0.05 * rng.standard_normal(40))
    law = measure.noise_law(cells(sigma_m, range_m, light, pixels))
    # cells lie at 60 degrees, where half of the light returns
    light_at_1m = 2.0 * np.exp(np.average(np.log(light), weights=pixels))
    assert law.light_at_1m == pytest.approx(light_at_1m)
    logs = np.stack([np.log(range_m), np.log(light / light_at_1m)], axis=1)
    design = statsmodels.api.add_constant(logs)
    expected = statsmodels.api.WLS(np.log(sigma_m), design, weights=pixels).fit()
    assert law.exponents == pytest.approx(expected.params[1:] * [1.0, -1.0])
    assert law.errors == pytest.approx(expected.bse[1:])
    facing_m = sigma_m * (light / light_at_1m) ** -expected.params[2]
    group = np.floor(np.log(range_m) / np.log(1.08))
    for index, number in enumerate(np.unique(group)):
        use = group == number
        weights = pixels[use]
        at_m = np.exp(np.average(np.log(range_m[use]), weights=weights))
        assert law.range_m[index] == pytest.approx(at_m)
        noise_m = np.exp(np.average(np.log(facing_m[use]), weights=weights))
        assert law.sigma_m[index] == pytest.approx(noise_m)
    assert (np.diff(law.range_m) > 0).all()


def test_exponents_that_the_cells_do_not_show_are_assumed() -> None:
    rng = np.random.default_rng(7)
    wide = np.linspace(1.0, 1.26, 6)
    narrow = np.linspace(1.0, 1.24, 6)
    pixels = np.full(36, 500)

    def law_of(range_m: np.ndarray, light: np.ndarray, powers: tuple[float, float], noise: float):
        ranges_m = np.repeat(range_m, 6)
        lights = np.tile(light, 6)
        sigma_m = 2e-3 * ranges_m ** powers[0] * lights ** -powers[1]
        scattered_m = sigma_m * np.exp(noise * rng.standard_normal(36))
        return measure.noise_law(cells(scattered_m, ranges_m, lights, pixels))

    light = wide
    law = law_of(wide, light, (1.5, 0.8), 1e-3)
    assert law.exponents == pytest.approx([1.5, 0.8], abs=0.02)
    law = law_of(narrow, light, (2.0, 0.8), 1e-3)
    assert law.exponents == pytest.approx([2.0, 0.8], abs=0.02)
    assert np.isnan(law.errors).tolist() == [True, False]
    law = law_of(wide, narrow, (1.5, 0.5), 1e-3)
    assert law.exponents == pytest.approx([1.5, 0.5], abs=0.02)
    assert np.isnan(law.errors).tolist() == [False, True]
    # noise that falls with range or grows with light counts as independent of it
    law = law_of(wide, light, (-1.5, 0.8), 1e-3)
    assert law.exponents == pytest.approx([0.0, 0.8], abs=0.03)
    law = law_of(wide, light, (1.5, -0.8), 1e-3)
    assert law.exponents[1] == 0.0
    # a standard error above 0.5: 36 cells with a scatter of 50 % over a quarter
    law = law_of(wide, light, (1.5, 0.8), 0.5)
    assert law.exponents.tolist() == [2.0, 0.5]
    assert np.isnan(law.errors).all()


# ---- figures of surfaces


def test_the_form_of_points_about_their_plane() -> None:
    """Evenly spread over 2 mm along the normal: an rms of 1 / sqrt(3) mm, and layers of 95 and 99.7
    % of it. On a plane at 45 degrees, a distance along the axis is larger by sqrt(2)."""
    rng = np.random.default_rng(8)
    slopes = rng.uniform(-0.02, 0.02, (20_000, 2))
    spread_m = rng.permutation(np.linspace(-1.0, 1.0, 20_000)) * MM
    for plane, along in ((Plane(1.0), 1.0), (Plane(1.0, 1.0), np.sqrt(2.0))):
        z_m = plane.z_along_m(slopes) + along * spread_m
        z_m[:100] = np.nan
        rms_mm, form95_mm, form997_mm = measure._form(z_m, slopes)
        assert rms_mm == pytest.approx(1 / np.sqrt(3), rel=0.01)
        assert form95_mm == pytest.approx(1.9, rel=0.01)
        assert form997_mm == pytest.approx(1.994, rel=0.01)


def test_the_figures_of_a_surface() -> None:
    """A tilted wall with 2 mm of noise along the axis and a relief of 3 mm; one in ten ranges is
    lost, and a second surface is too small."""
    rng = np.random.default_rng(9)
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 120), np.linspace(-0.2, 0.2, 90))
    slopes = np.stack([x, y], axis=-1)
    plane = Plane(1.5, 0.5)
    relief_m = 3.0 * MM * np.sign(np.sin(80 * x))
    z_m = plane.z_along_m(slopes) + relief_m + 2.0 * MM * rng.standard_normal((40, 90, 120))
    z_m[rng.random(z_m.shape) < 0.1] = np.nan
    z_m[20] += 0.1
    mask = np.ones((90, 120), bool)
    mask[:, 100:] = False
    small = np.zeros((90, 120), bool)
    small[:20, 102:] = True
    capture = still(z_m, slopes=slopes, planes=((plane, mask), (plane, small)))
    (face,) = measure.surfaces_of(capture)
    assert (face.capture, face.number) == ("still", 1)
    inside = mask.copy()
    inside[:, 97:] = False
    inside[:, :3] = inside[:3] = inside[-3:] = False
    assert face.distance_m == pytest.approx(np.median(plane.z_along_m(slopes)[inside]), abs=0.01)
    normal = np.array([0.5, 0.0, -1.0]) / np.sqrt(1.25)
    rays = np.concatenate([slopes, np.ones((90, 120, 1))], axis=-1)
    cosine = np.abs(rays @ normal) / np.linalg.norm(rays, axis=-1)
    angle_deg = np.degrees(np.arccos(np.median(cosine[inside])))
    assert face.angle_deg == pytest.approx(angle_deg, abs=0.05)
    # the mean of all 40 frames, with the one that jumps, moves no other frame
    assert face.temporal.value == pytest.approx(2.0, rel=0.02)
    assert face.temporal.interval.low < 2.0 < face.temporal.interval.high
    across = np.sqrt(np.mean((rays[inside] @ normal) ** 2))
    assert face.average_rms_mm == pytest.approx(3.0 * across, rel=0.03)
    assert face.frame_rms_mm == pytest.approx(np.hypot(3.0, 2.0) * across, rel=0.03)
    assert face.fill_rate == pytest.approx(0.9, abs=0.005)


# ---- edges


def test_crossings_of_an_edge_by_hand() -> None:
    labels = np.array([[1, 1, 0, 0, 2, 2], [1, 0, 1, 1, 1, 0], [0, 3, 2, 0, 0, 0]])
    share = np.array([[1, 1, 0.2, 0.6, 1, 1], [1, 0, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1]])
    z_m = np.array([[1, 1.1, 9, 9, 1.3, 1.4], [1, 9, 2, 2, 2, 9], [9, 1.0, 0.97, 9, 9, 9]])
    first, second = measure._crossings(labels, share, z_m)
    assert first[0] == frozenset({1, 2})
    assert first[1] == pytest.approx((1.2, 0.8, 0.2))
    assert second[0] == frozenset({2, 3})
    assert second[1] == pytest.approx((0.0, 0.0, 0.03))


@pytest.mark.parametrize(
    ("apart_px", "step_m", "counts"),
    [(24, 0.021, True), (25, 0.021, False), (24, 0.019, False), (1, -0.021, True)],
)
def test_an_edge_is_narrow_and_high(apart_px: int, step_m: float, counts: bool) -> None:
    labels = np.zeros((1, 40), int)
    labels[0, 5] = 1
    labels[0, 5 + apart_px] = 2
    z_m = np.ones((1, 40))
    z_m[0, 5 + apart_px] += step_m
    crossings = list(measure._crossings(labels, np.ones((1, 40)), z_m))
    assert bool(crossings) == counts


def test_an_edge_has_at_least_thirty_lines() -> None:
    for lines, is_known in ((30, True), (29, False)):
        z_m = np.ones((4, lines, 40))
        z_m[:, :, 20:] = 1.5
        in_front = np.broadcast_to(np.arange(40) < 20, (lines, 40))
        surfaces = ((Plane(1.0), in_front), (Plane(1.5), ~in_front))
        slopes = np.zeros((lines, 40, 2))
        edge = measure.edge_of([still(z_m, planes=surfaces, slopes=slopes)])
        assert (edge is not None) == is_known
    # a pixel more than two tolerances off its surface belongs to the edge
    z_m = np.ones((4, 30, 40))
    z_m[:, :, 19] = 1.017
    z_m[:, :, 18] = 1.015
    z_m[:, :, 20:] = 1.5
    in_front = np.broadcast_to(np.arange(40) < 20, (30, 40))
    surfaces = ((Plane(1.0), in_front), (Plane(1.5), ~in_front))
    edge = measure.edge_of([still(z_m, planes=surfaces, slopes=np.zeros((30, 40, 2)))])
    assert edge is not None
    assert (edge.flying_px, edge.gap_px) == (1.0, 0.0)


# ---- all captures


def of_captures(*captures: StillCapture, **changes: Any) -> measure.Characteristics:
    law = measure.RangeLaw(np.ones(1), np.ones(1), np.array([2.0, 0.5]), np.full(2, 0.1), 1.0)
    facts: dict[str, Any] = {
        "captures": captures,
        "cells": (),
        "law": law,
        "correlation": np.concatenate([np.ones((2, 1)), np.zeros((2, 12))], axis=1),
        "dropouts": measure.Dropouts(np.ones(1), np.zeros(1), np.ones(1)),
        "surfaces": ("a surface",),
        "edge": None,
        "pattern": None,
        "pattern_correlation": None,
        **changes,
    }
    return measure.Characteristics(**facts)


def test_jumps_and_jitter_of_all_captures() -> None:
    """The variances of both captures, without the frames that jump, are averaged."""
    first = displaced([1.0, -1.0, 1.0, -1.0, 20.0, -1.0, 1.0, -1.0, 1.0])
    second = displaced([0.5, -0.5, -0.5, 0.5])
    measured = of_captures(first, second)
    assert measured.frames == 13
    median = np.median(first.without_drift_m)
    assert measured.jumps_m == pytest.approx([20.0 * MM - 1.0 * MM], abs=0.3 * MM + abs(median))
    variances = [
        first.without_drift_m[first.kept].var(ddof=1),
        second.without_drift_m.var(ddof=1),
    ]
    assert measured.jitter_m == pytest.approx(np.sqrt(np.mean(variances)))
    # eight frames at 1 mm to either side, and four at 0.5 mm
    assert measured.jitter_m == pytest.approx(np.sqrt((8 / 7 + 1 / 3) / 2) * MM, rel=0.05)


def frames_with(correlation: float, frames: int = 40) -> np.ndarray:
    """Noise of 1 mm of which successive frames share a part."""
    rng = np.random.default_rng(11)
    white = rng.standard_normal((frames, 40, 50))
    noise = white.copy()
    for k in range(1, frames):
        noise[k] = correlation * noise[k - 1] + np.sqrt(1 - correlation**2) * white[k]
    return 1.0 + noise * MM


@pytest.mark.parametrize(
    ("capture", "changes", "words"),
    [
        (still(frames_with(0.0)), {}, []),
        (still(frames_with(0.12)), {}, []),
        (still(frames_with(0.18)), {}, ["noise of successive frames is correlated (0.17)"]),
        (still(frames_with(0.0), step_m=2.8 * MM), {}, []),
        (still(frames_with(0.0), step_m=2.95 * MM), {}, ["is hidden by the rounding to 2.95 mm"]),
        (still(frames_with(0.0)), {"surfaces": ()}, ["no flat surface was found"]),
    ],
)
def test_doubts_are_told_where_there_are_some(
    capture: StillCapture, changes: dict[str, Any], words: list[str]
) -> None:
    doubts = of_captures(capture, **changes).doubts
    without_amplitude = (
        "no amplitude is recorded: noise and dropouts of darker surfaces are unknown"
    )
    assert without_amplitude in doubts
    other_doubts = [doubt for doubt in doubts if doubt != without_amplitude]
    assert len(other_doubts) == len(words)
    for doubt, word in zip(other_doubts, words, strict=True):
        assert word in doubt


@pytest.mark.parametrize(("reach", "told"), [(6, False), (7, True)])
def test_smoothed_depth_is_told_by_the_reach_of_correlation(reach: int, told: bool) -> None:
    """The first lag at which neither axis is correlated by 0.1."""
    along_x = np.where(np.arange(13) < reach, 0.11, 0.09)
    correlation = np.stack([along_x, np.where(np.arange(13) < 3, 0.5, 0.0)])
    capture = still(frames_with(0.0), amplitude=np.ones((40, 50)))
    doubts = of_captures(capture, correlation=correlation).doubts
    assert bool(doubts) == told
    if told:
        assert "correlated over 7 pixels" in doubts[0]


def test_assumed_exponents_drift_and_jumps_are_doubts() -> None:
    amplitude = np.ones((4, 5))
    law = measure.RangeLaw(
        np.array([0.8, 1.2]), np.ones(2), np.array([2.0, 0.5]), np.full(2, np.nan), 1.0
    )
    rng = np.random.default_rng(3)
    drift_mm = np.linspace(0.0, 3.2, 9)
    drift_mm[4] += 30.0
    drifting = displaced(drift_mm)
    noise_m = 0.01 * MM * rng.standard_normal((9, 4, 5))
    drifting = still(drifting.z_m + noise_m, amplitude=amplitude)
    doubts = of_captures(drifting, law=law).doubts
    assert len(doubts) == 4
    assert "between 0.80 and 1.20 m" in doubts[0]
    assert "the power 2 is assumed" in doubts[0]
    assert "the power -0.5 is assumed" in doubts[1]
    assert "drifts by more than 3 mm during still" in doubts[2]
    assert doubts[3].startswith("1 of 9 frames are displaced")


def pattern_with(error_m: np.ndarray, variance_m2: float) -> Any:
    field = SimpleNamespace(error_m=error_m, variance_m2=np.full(error_m.shape, variance_m2))
    return SimpleNamespace(field=field)


def test_the_correlation_of_a_pattern_fades_to_nothing() -> None:
    """Waves of 20 pixels along x, without noise of the map."""
    waves_m = np.broadcast_to(np.sin(2 * np.pi * np.arange(200) / 20), (60, 200)) * MM
    no_noise = np.concatenate([np.ones((2, 1)), np.zeros((2, 12))], axis=1)
    along_x, along_y = measure._pattern_correlation(pattern_with(waves_m, 0.0), no_noise)
    fade = np.cos(np.pi / 2 * np.arange(41) / 40)
    assert along_x == pytest.approx(np.cos(2 * np.pi * np.arange(41) / 20) * fade, abs=0.02)
    assert along_y == pytest.approx(fade, abs=1e-9)


def test_the_noise_of_the_map_is_no_pattern() -> None:
    """Half of the map's variance is noise, whose neighbours along x are correlated by 0.4."""
    rng = np.random.default_rng(12)
    pattern_m = np.repeat(rng.standard_normal((300, 150)), 2, axis=1) * MM
    white = rng.standard_normal((300, 301))
    noise_m = (white[:, 1:] + 0.5 * white[:, :-1]) / np.sqrt(1.25) * MM
    of_noise = np.zeros((2, 13))
    of_noise[:, 0] = 1.0
    of_noise[0, 1] = 0.4
    pattern = pattern_with(pattern_m + noise_m, 1.0 * MM**2)
    along_x, along_y = measure._pattern_correlation(pattern, of_noise)
    fade = np.cos(np.pi / 80)
    assert along_x[:3] == pytest.approx([1.0, 0.5 * fade, 0.0], abs=0.02)
    assert along_y[:2] == pytest.approx([1.0, 0.0], abs=0.02)
