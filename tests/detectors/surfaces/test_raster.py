"""Points without a pixel grid on a raster."""

import numpy as np

from detectors.surfaces.smooth_surfaces import CELL_SPACINGS, raster
from harness.vocabulary.geometry import Cloud
from tests.support.plain_clouds import cloud_of_points

STEP = 1.0 / 256.0  # exact, so that cells can be told by hand
SIDE = 40


def _cloud(points_m: np.ndarray) -> Cloud:
    return cloud_of_points(points_m[None], z_step_m=1e-3, n_frames=7, organised=False)


def _square(z_m: float = 1.0) -> np.ndarray:
    """Points (n, 3) of a square lattice."""
    y, x = np.mgrid[:SIDE, :SIDE] * STEP
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])


def test_cells_have_one_and_a_half_spacings_and_an_empty_border() -> None:
    points_m = _square()
    grid, rows, columns, side = raster(points_m, _cloud(points_m))
    assert side == CELL_SPACINGS
    assert (grid.z_step_m, grid.n_frames) == (1e-3, 7)
    # 39 steps of 2/3 of a cell, from cell 1
    assert columns[:9].tolist() == [1, 1, 2, 3, 3, 4, 5, 5, 6]
    assert rows[::SIDE][:9].tolist() == [1, 1, 2, 3, 3, 4, 5, 5, 6]
    assert grid.points_m.shape == (29, 29, 3)
    assert np.isfinite(grid.points_m[1:-1, 1:-1]).all()
    for border in (grid.points_m[0], grid.points_m[-1], grid.points_m[:, 0], grid.points_m[:, -1]):
        assert np.isnan(border).all()


def test_a_cell_shows_the_nearest_of_its_points() -> None:
    # not before a lens, so that places are x and y
    nearest = np.array([[11 * STEP, 5 * STEP, -4.0]])
    points_m = np.concatenate([nearest, _square(-3.0)])
    grid, rows, columns, _ = raster(points_m, _cloud(points_m))
    assert grid.points_m[rows[0], columns[0], 2] == -4.0
    assert (grid.points_m[..., 2] == -4.0).sum() == 1


def test_a_gap_does_not_widen_cells() -> None:
    points_m = _square()
    beside_gap = (points_m[:, 0] < 10 * STEP) | (points_m[:, 0] > 25 * STEP)
    assert raster(points_m[beside_gap], _cloud(points_m[beside_gap]))[3] == CELL_SPACINGS


def test_cells_widen_until_nearly_all_hold_a_point() -> None:
    points_m = _square()
    thinned = points_m[np.random.default_rng(1).random(len(points_m)) < 0.6]
    grid, _, _, side = raster(thinned, _cloud(thinned))
    assert side > 1.5 * CELL_SPACINGS
    filled = np.isfinite(grid.points_m[2:-2, 2:-2, 2])
    assert filled.mean() > 0.97
