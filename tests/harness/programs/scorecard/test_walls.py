"""The simulated Azure Kinect beside frames of real walls, and the analysis that compares them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from harness.stills.statistics import fixed_pattern, robust_inverse_fit
from harness.vocabulary.geometry import Region
from scenes.sensor.camera import load_camera
from tests.validation.azure_walls import Wall, WallCheck, check_folder, walls_camera
from tests.validation.azure_walls_page import figure, length_px, page, table, white_before_m

FILE = load_camera("azure_kinect_nfov").fixed_pattern


@pytest.fixture(scope="module")
def checks(shared_data: Path) -> list[WallCheck]:
    folder = shared_data / "azure_nfov_walls"
    if not folder.is_dir():
        pytest.skip("no wall frames among the real captures")
    return check_folder(folder)


# ---------------------------------------------------------------- the analysis on numbers that are
# known


def patterned_stack(
    smooth: float, length: float, pixel: float, frames: int = 20
) -> tuple[np.ndarray, ...]:
    """A tilted plane with a planted pattern (metres) behind a box of five, and temporal noise of 1
    mm behind it."""
    rng = np.random.default_rng(4)
    shape = (200, 240)
    slopes = np.stack(
        np.meshgrid(np.linspace(-0.3, 0.2, 240), np.linspace(-0.2, 0.2, 200)), axis=-1
    )
    s = length / np.sqrt(2)
    field = (
        ndimage.gaussian_filter(rng.standard_normal(shape), s, mode="wrap")
        * 2
        * np.sqrt(np.pi)
        * s
        * smooth
    )
    white = ndimage.uniform_filter(rng.standard_normal(shape), 5) * 5 * pixel
    noise = ndimage.uniform_filter(rng.standard_normal((frames, *shape)), (1, 5, 5)) * 5e-3
    return 1.3 / (1 - 0.4 * slopes[..., 0]) + field + white + noise, np.ones(shape, bool), slopes


@pytest.mark.parametrize(
    ("smooth_mm", "pixel_mm"),
    [
        pytest.param(0.5, 0.0, marks=pytest.mark.slow),
        (0.5, 0.2),
        pytest.param(0.0, 0.2, marks=pytest.mark.slow),
    ],
)
def test_a_planted_fixed_pattern_is_found_again(smooth_mm, pixel_mm):
    """Within 0.04 mm: three deviations of a field of some 400 patches of (2 l)^2 pixels. The
    surface takes the longest waves with it, which shortens the correlation by half a pixel."""
    pattern = fixed_pattern(*patterned_stack(smooth_mm * 1e-3, 6.0, pixel_mm * 1e-3))
    assert pattern.std_m * 1e3 == pytest.approx(np.hypot(smooth_mm, pixel_mm), abs=0.04)
    assert max(white_before_m(pattern), 0) * 1e3 == pytest.approx(pixel_mm, abs=0.04)
    if pixel_mm == 0:
        assert length_px(pattern) == pytest.approx(5.6, abs=0.4)


def test_a_plane_is_exact_and_outliers_do_not_move_it():
    y, x = np.mgrid[-0.3:0.3:30j, -0.4:0.2:40j]
    z = 1.7 / (1 - 1.5 * x + 0.03 * y)
    bent = z.copy()
    bent[:6, :8] += 0.02
    mask = np.ones(z.shape, bool)
    slopes = np.stack([x, y], axis=-1)
    frames = np.stack([bent, bent])
    wall = Wall("w", Region(0, 30, 0, 40), mask, slopes, frames)
    assert wall.plane == pytest.approx((1.7, 1.5, -0.03), abs=1e-9)
    basis = np.column_stack([np.ones(z.size), x.ravel(), y.ravel()])
    _, used = robust_inverse_fit(basis, bent.ravel())
    assert not used.reshape(z.shape)[:6, :8].any()


# ---------------------------------------------------------------- the camera model against the
# walls


@pytest.mark.slow
def test_temporal_deviation_follows_the_walls(checks):
    """In the lit cone the simulated deviation is 0.75 to 1 of the measured one, in every bin.

    What is unknown is of this size: the light falls as the root, so an albedo of 0.55 in place of
    0.8 gives 0.83.
    """
    for check in checks:
        assert len(check.by_range_inner) >= 3
        for part in check.by_range_inner:
            assert 0.75 < part.ratio < 1.0, f"{check.wall.name} wall at {part.at} m"


@pytest.mark.slow
def test_temporal_deviation_grows_with_range_as_on_the_walls(checks):
    """Each wall's ratios lie within 10 % of their mean: the growth with range is the model's, not
    the gain's."""
    for check in checks:
        ratios = np.array([part.ratio for part in check.by_range_inner])
        assert np.abs(ratios / ratios.mean() - 1).max() < 0.1


@pytest.mark.slow
def test_whole_walls_are_never_simulated_noisier_than_measured(checks):
    """Towards the edge of the lit field the real light falls off and the closed-form plane's does
    not."""
    for check in checks:
        assert all(0.45 < part.ratio < 1.0 for part in check.by_range)


@pytest.mark.slow
def test_temporal_noise_is_as_smooth_as_on_the_walls(checks):
    """Within 0.1 at lags 1 to 5, along x and y, without what a frame's pixels have in common (not
    modelled).

    With it the left wall's lag 5 differs by 0.103, all others by less than 0.1.
    """
    for check in checks:
        difference = check.correlation["measured", False] - check.correlation["simulated", False]
        assert np.abs(difference).max() < 0.1
        raw = check.correlation["measured", True] - check.correlation["simulated", True]
        assert np.abs(raw[:, :4]).max() < 0.1
        assert np.abs(raw).max() < 0.11


@pytest.mark.slow
def test_real_frames_jitter_as_a_whole(checks):
    """The file has 0.25 mm at 320 units; the walls are simulated at 637 and 359 units. 22 frames
    tell a deviation to 15 %."""
    for check, units in zip(checks, (637, 359), strict=True):
        measured, simulated = check.jitter_m
        assert 0.15e-3 < measured < 0.35e-3
        assert simulated == pytest.approx(0.25e-3 * 320 / units, rel=3 * 0.15)


@pytest.mark.slow
def test_the_files_fixed_pattern_is_that_of_the_walls(checks):
    """0.47 and 0.42 mm of the file's source, and 6.3 px within 1 px as the mean of both walls."""
    left_wall, right_wall = [check.pattern for check in checks]
    assert left_wall.std_m * 1e3 == pytest.approx(0.47, abs=0.01)
    assert right_wall.std_m * 1e3 == pytest.approx(0.42, abs=0.01)
    mean_px = np.mean([length_px(left_wall), length_px(right_wall)])
    assert mean_px == pytest.approx(FILE.smooth_length_px.value, abs=1.0)


@pytest.mark.slow
def test_simulated_fixed_pattern_through_the_same_analysis(checks):
    """The file's pixel part is found again within 0.03 mm; the whole is 0.85 to 1.15 of the
    measured."""
    for check in checks:
        # along the ray in the file, along the axis here
        planted = (
            FILE.pixel_mm.value
            / 5
            * np.cos(np.radians(check.wall.angle_deg[check.wall.mask])).mean()
        )
        pixel = np.sqrt(np.mean([white_before_m(p) ** 2 for p in check.simulated_patterns])) * 1e3
        assert pixel == pytest.approx(planted, abs=0.03)
        std = np.sqrt(np.mean([p.std_m**2 for p in check.simulated_patterns]))
        assert 0.85 < std / check.pattern.std_m < 1.15


@pytest.mark.slow
def test_page_table_and_figure_hold_the_numbers(checks):
    text = " ".join(page(checks, walls_camera()).split())  # a line may end within a number's words
    for check in checks:
        assert f"{check.pattern.std_m * 1e3:.2f} mm" in text
        assert f"{check.needed_albedo:.2f} ({check.wall.name})" in text
        for part in check.by_range:
            mm = f"{part.measured_m * 1e3:.2f}  {part.simulated_m * 1e3:.2f}  {part.ratio:.2f}"
            assert f"{part.pixels} {mm}" in " ".join(table(checks).split())
    assert figure(checks).startswith("<svg")
