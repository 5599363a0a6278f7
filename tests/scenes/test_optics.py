"""The emitter's cone, and the footprints of pixels and beams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Lens, Region
from scenes.optics import (
    FWHM_PER_DEVIATION,
    Beams,
    Optics,
    Quadrilaterals,
    footprint_of,
    wave_numbers,
)

LENS = Lens(
    width=64,
    height=48,
    fx=100.0,
    fy=80.0,
    cx=31.5,
    cy=23.5,
)
REGION = Region(5, 9, 11, 17)
OPTICS = Optics(
    title="a camera",
    lens=LENS,
    emitter_m=np.array([0.01, 0.02, 0.03]),
    full_half_angle_deg=20.0,
    cutoff_half_angle_deg=40.0,
    frequencies_hz=(20e6, 100e6),
    wavelength_nm=850.0,
    margin_px=2,
)
DEVIATION_RAD = 0.01


def test_a_cone_is_full_inside_none_outside_and_linear_in_the_cosine() -> None:
    middle = np.arccos((np.cos(np.deg2rad(20)) + np.cos(np.deg2rad(40))) / 2)
    angles = np.array([0.0, np.deg2rad(19.9), middle, np.deg2rad(40.1)])
    slopes = np.column_stack([0.6 * np.tan(angles), -0.8 * np.tan(angles)])
    assert OPTICS.cone(slopes) == pytest.approx([1.0, 1.0, 0.5, 0.0], abs=1e-12)


def test_a_wave_number_turns_once_a_wavelength() -> None:
    wavelengths_m = SPEED_OF_LIGHT_AIR / np.array(OPTICS.frequencies_hz)
    turns = wave_numbers(OPTICS.frequencies_hz) * wavelengths_m
    assert turns == pytest.approx([2 * np.pi, 2 * np.pi])


@pytest.mark.parametrize(
    "changed",
    [
        {"lens": replace(LENS, fx=101.0)},
        {"emitter_m": np.zeros(3)},
        {"full_half_angle_deg": 21.0},
        {"cutoff_half_angle_deg": 41.0},
        {"frequencies_hz": (20e6,)},
        {"beam_fwhm_rad": 0.01},
        {"wavelength_nm": 940.0},
        {"margin_px": 3},
    ],
    ids=lambda changed: next(iter(changed)),
)
def test_what_changes_a_render_is_content(changed: dict) -> None:
    assert replace(OPTICS, **changed).content() != OPTICS.content()


def test_title_and_range_change_no_render() -> None:
    renamed = replace(
        OPTICS,
        title="another",
        nearest_m=0.2,
        farthest_m=3.0,
        limits_along="axis",
    )
    assert renamed.content() == OPTICS.content()


def test_an_imagers_footprint_ends_at_its_corners() -> None:
    footprint = footprint_of(LENS, REGION, None)
    rows = np.array([0, 3])
    cols = np.array([2, 5])
    axes = footprint.axes(rows, cols)
    # weights of the corners: upper left, upper right, lower left, lower right
    corners = np.array(
        [
            [1.0, 1.0, 1.0, 1.0],
            [0.0, 1.0, 0.0, 1.0],
            [0.0, 0.0, 1.0, 1.0],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    slopes = footprint.slopes(rows, cols, corners)
    assert type(footprint) is Quadrilaterals
    assert footprint.reach_px == 0
    assert (axes @ corners)[:, 2] == pytest.approx(np.ones((2, 4)))
    for index in range(2):
        u = REGION.col0 + cols[index] + np.array([-0.5, 0.5, -0.5, 0.5])
        v = REGION.row0 + rows[index] + np.array([-0.5, -0.5, 0.5, 0.5])
        assert slopes[index] == pytest.approx(LENS.slopes(u, v), abs=1e-12)


def test_a_grid_has_the_centres_of_cells_row_by_row() -> None:
    footprint = Quadrilaterals(LENS, REGION)
    ones, across, down, products = footprint.grid(2)
    assert ones.tolist() == [1, 1, 1, 1]
    assert across.tolist() == [0.25, 0.75, 0.25, 0.75]
    assert down.tolist() == [0.25, 0.25, 0.75, 0.75]
    assert products == pytest.approx(across * down)
    assert footprint.grid().shape == (4, 16)


def test_every_row_and_column_of_a_lattice_is_crossed_once() -> None:
    """Sub-rays lie evenly in both directions: an edge crosses them one by one."""
    ones, across, down, products = Quadrilaterals(LENS, REGION).lattice(256)
    assert ones.tolist() == [1.0] * 256
    assert across == pytest.approx((np.arange(256) + 0.5) / 256)
    gaps = np.diff(np.sort(down))
    assert gaps.min() > 0.4 / 256
    assert gaps.max() < 2.0 / 256
    assert (down.min(), down.max()) == pytest.approx((0.0, 1.0), abs=1.5 / 256)
    assert products == pytest.approx(across * down)


def test_a_beams_sub_rays_have_its_mean_and_deviation() -> None:
    beams = footprint_of(LENS, REGION, DEVIATION_RAD * FWHM_PER_DEVIATION)
    assert type(beams) is Beams
    for weights in (beams.grid(), beams.lattice()):
        assert weights[0].tolist() == [1.0] * weights.shape[1]
        assert weights[1:].mean(axis=1) == pytest.approx([0.0, 0.0], abs=1e-12)
        assert weights[1:].std(axis=1) == pytest.approx([DEVIATION_RAD] * 2, rel=0.03)
    x, y = beams.grid(3)[1:]
    assert x[:3] == pytest.approx(x[3:6])
    assert y[:3] == pytest.approx([y[0]] * 3)
    assert x[0] < x[1] < x[2]
    assert y[0] < y[3] < y[6]


def test_a_lattices_radii_hold_equal_shares_of_the_gaussian() -> None:
    """Half of a round Gaussian's light lies within sqrt(2 ln 2) deviations."""
    spiral = Beams(LENS, REGION, DEVIATION_RAD).lattice(256)[1:]
    radius = np.linalg.norm(spiral, axis=0)
    for share in (0.25, 0.5, 0.9):
        limit = DEVIATION_RAD * np.sqrt(-2 * np.log(1 - share))
        assert (radius < limit).mean() == pytest.approx(share, abs=0.02)


def test_the_axes_of_a_beam_are_square_to_its_central_ray() -> None:
    beams = Beams(LENS, REGION, DEVIATION_RAD)
    axes = beams.axes(np.array([1]), np.array([4]))[0]
    assert axes.T @ axes == pytest.approx(np.eye(3), abs=1e-12)
    assert axes[:2, 0] / axes[2, 0] == pytest.approx(LENS.region_slopes(REGION)[1, 4])
    assert axes[0, 1] > 0.9
    assert axes[1, 2] > 0.9


def test_a_beam_reaches_three_deviations() -> None:
    """3 deviations of 0.01 rad at 100 px: 3 px on the axis; the slope there adds a little."""
    central = Beams(LENS, Region(23, 25, 31, 33), DEVIATION_RAD)
    assert central.reach_px == 1 + 4
    narrow = Beams(LENS, Region(23, 25, 31, 33), DEVIATION_RAD * 0.99)
    assert narrow.reach_px == 1 + 3
    # at the left edge the squared slope is 0.1: 3 px become 3.3
    oblique = Beams(LENS, Region(23, 25, 0, 2), DEVIATION_RAD * 0.99)
    assert oblique.reach_px == 1 + 4
