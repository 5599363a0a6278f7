"""Resampling of scattered samples of a surface to a grid: each cell lies in one triangle of neighbouring samples.

Linear interpolation in triangles leaves no gaps and no beats between two grids of nearly equal pitch, as binning does;
it blurs by a tent whose variance is, averaged over where cells fall, a sixth of the samples' spacing squared along
each axis (a 5 x 5 window has 25/12).
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

LONGEST_EDGE = 4.0
"""Longest edge of a triangle between samples without a grid, in spacings: a longer one bridges a gap."""
EXACT_PARTS = 4
"""Parts along a side up to which the weights of a cell's samples are added up one by one."""
SLACK = 1e-9
"""A cell on the edge between two triangles belongs to the first; rounding must not lose it to both."""


@dataclass(frozen=True)
class CellGrid:
    """Cells centred at (``x0`` + column * ``step``, ``y0`` + row * ``step``)."""

    x0: float
    y0: float
    step: float
    shape: tuple[int, int]

    @property
    def x(self) -> np.ndarray:
        """(w,) of the columns."""
        return self.x0 + self.step * np.arange(self.shape[1])

    @property
    def y(self) -> np.ndarray:
        """(h,) of the rows."""
        return self.y0 + self.step * np.arange(self.shape[0])

    def scaled(self, places: np.ndarray) -> np.ndarray:
        """Places (..., 2) as column and row, not rounded."""
        return np.ascontiguousarray((places - np.array([self.x0, self.y0])) / self.step)

    def finer(self, parts: int) -> CellGrid:
        """Each cell divided into ``parts`` x ``parts``."""
        step = self.step / parts
        inset = 0.5 * (self.step - step)
        return CellGrid(self.x0 - inset, self.y0 - inset, step, (self.shape[0] * parts, self.shape[1] * parts))


@dataclass(frozen=True)
class Raster:
    """The samples around each cell of a grid. ``corners`` (h, w, 3) int64 flat indices of samples,
    -1 where there is no triangle; ``shares`` (h, w, 3) their weights, which sum to 1. Cells that are larger than the
    samples' spacing are divided into ``parts`` x ``parts``, which the arrays then hold, and take their mean."""

    corners: np.ndarray
    shares: np.ndarray
    parts: int = 1

    def at_cells(self, values: np.ndarray) -> np.ndarray:
        """Samples' values (n,) or (n, c) at the cells, (h, w) or (h, w, c); NaN where less than half is covered."""
        flat = np.ascontiguousarray(values.reshape(len(values), -1), dtype=np.float64)
        found = self._block_means(_gather(self.corners, self.shares, flat))
        return found[..., 0] if values.ndim == 1 else found

    @property
    def concentration(self) -> np.ndarray:
        """(h, w) sum of squares of the samples' weights: by what independent errors shrink in variance. Exact up to
        `EXACT_PARTS`; beyond, where the edges of a cell hardly count, that of as many samples as parts."""
        if self.parts == 1:
            squares: np.ndarray = np.einsum("hwk,hwk->hw", self.shares, self.shares)
            return squares
        if self.parts > EXACT_PARTS:
            h, w = self.shares.shape[0] // self.parts, self.shares.shape[1] // self.parts
            return np.full((h, w), 1.0 / self.parts**2)
        found: np.ndarray = _block_squares(self.corners, self.shares, self.parts)
        return found

    def _block_means(self, fine: np.ndarray) -> np.ndarray:
        if self.parts == 1:
            return fine
        h, w, channels = fine.shape
        blocks = fine.reshape(h // self.parts, self.parts, w // self.parts, self.parts, channels)
        known = np.isfinite(blocks)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.where(known, blocks, 0.0).sum(axis=(1, 3)) / known.sum(axis=(1, 3))
        return np.where(2 * known.sum(axis=(1, 3)) >= self.parts**2, means, np.nan)


def raster_between(places: np.ndarray, valid: np.ndarray, organised: bool, spacing: float, grid: CellGrid) -> Raster:
    """The cells of a grid among the valid of samples at ``places`` (v, u, 2), on a pixel grid or not (then v = 1).

    ``spacing`` of the samples: cells are divided until they are no larger.
    """
    parts = max(1, round(grid.step / spacing))
    fine = grid.finer(parts)
    raster = raster_of_grid(places, valid, fine) if organised else raster_of_points(places[0], valid[0], fine)
    return Raster(raster.corners, raster.shares, parts)


def raster_of_grid(places: np.ndarray, valid: np.ndarray, grid: CellGrid) -> Raster:
    """The cells of a grid among samples on a pixel grid with ``places`` (v, u, 2).

    Two triangles for each four neighbours; of four with one invalid the one that is left.
    """
    corners, shares = _empty(grid)
    _fill_from_grid(grid.scaled(places), np.ascontiguousarray(valid), corners, shares)
    return Raster(corners, shares)


def raster_of_points(places: np.ndarray, valid: np.ndarray, grid: CellGrid) -> Raster:
    """Do the same as `raster_of_grid` for samples ``places`` (n, 2) without a grid: Delaunay's triangles with short
    edges."""
    from scipy.spatial import Delaunay

    known = np.flatnonzero(valid)
    triangles = known[Delaunay(places[known]).simplices.astype(np.int64)]
    edges = places[triangles] - places[np.roll(triangles, 1, axis=1)]
    lengths = np.hypot(edges[..., 0], edges[..., 1])
    short = (lengths <= LONGEST_EDGE * np.median(lengths)).all(axis=1)
    corners, shares = _empty(grid)
    _fill_from_triangles(grid.scaled(places), triangles[short], corners, shares)
    return Raster(corners, shares)


def _empty(grid: CellGrid) -> tuple[np.ndarray, np.ndarray]:
    return np.full((*grid.shape, 3), -1, dtype=np.int64), np.zeros((*grid.shape, 3))


@numba.njit(cache=True, nogil=True)
def _triangle(places: np.ndarray, a: int, b: int, c: int, corners: np.ndarray, shares: np.ndarray) -> None:
    """Give the triangle's cells that no earlier triangle has to its corners; ``places`` (n, 2) in cells."""
    h, w = corners.shape[:2]
    ax, ay = places[a]
    bx, by = places[b]
    cx, cy = places[c]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if not abs(area) > 1e-12:
        return
    left, right = max(0, int(np.ceil(min(ax, bx, cx) - SLACK))), min(w - 1, int(np.floor(max(ax, bx, cx) + SLACK)))
    top, bottom = max(0, int(np.ceil(min(ay, by, cy) - SLACK))), min(h - 1, int(np.floor(max(ay, by, cy) + SLACK)))
    for row in range(top, bottom + 1):
        for column in range(left, right + 1):
            if corners[row, column, 0] >= 0:
                continue
            of_b = ((column - ax) * (cy - ay) - (row - ay) * (cx - ax)) / area
            of_c = ((bx - ax) * (row - ay) - (by - ay) * (column - ax)) / area
            of_a = 1.0 - of_b - of_c
            if of_a < -SLACK or of_b < -SLACK or of_c < -SLACK:
                continue
            corners[row, column, 0], corners[row, column, 1], corners[row, column, 2] = a, b, c
            shares[row, column, 0], shares[row, column, 1], shares[row, column, 2] = of_a, of_b, of_c


@numba.njit(cache=True, nogil=True)
def _fill_from_grid(places: np.ndarray, valid: np.ndarray, corners: np.ndarray, shares: np.ndarray) -> None:
    h, w = valid.shape
    flat = places.reshape(h * w, 2)
    for v in range(h - 1):
        for u in range(w - 1):
            a, b, c, d = v * w + u, v * w + u + 1, (v + 1) * w + u, (v + 1) * w + u + 1
            has_a, has_b, has_c, has_d = valid[v, u], valid[v, u + 1], valid[v + 1, u], valid[v + 1, u + 1]
            if has_b and has_c:
                if has_a:
                    _triangle(flat, a, b, c, corners, shares)
                if has_d:
                    _triangle(flat, b, c, d, corners, shares)
            elif has_a and has_d:
                if has_b:
                    _triangle(flat, a, b, d, corners, shares)
                if has_c:
                    _triangle(flat, a, c, d, corners, shares)


@numba.njit(cache=True, nogil=True)
def _fill_from_triangles(places: np.ndarray, triangles: np.ndarray, corners: np.ndarray, shares: np.ndarray) -> None:
    for t in range(len(triangles)):
        _triangle(places, triangles[t, 0], triangles[t, 1], triangles[t, 2], corners, shares)


@numba.njit(cache=True, nogil=True)
def _gather(corners: np.ndarray, shares: np.ndarray, values: np.ndarray) -> np.ndarray:
    h, w = corners.shape[:2]
    channels = values.shape[1]
    found = np.full((h, w, channels), np.nan)
    for row in range(h):
        for column in range(w):
            if corners[row, column, 0] < 0:
                continue
            for k in range(channels):
                total = 0.0
                for j in range(3):
                    total += shares[row, column, j] * values[corners[row, column, j], k]
                found[row, column, k] = total
    return found


@numba.njit(cache=True, nogil=True)
def _block_squares(corners: np.ndarray, shares: np.ndarray, parts: int) -> np.ndarray:
    """Sum over samples of the square of their weight in the mean of a block of cells; 1 where there is none."""
    h, w = corners.shape[0] // parts, corners.shape[1] // parts
    found = np.ones((h, w))
    samples, weights = np.empty(3 * parts * parts, dtype=np.int64), np.empty(3 * parts * parts)
    for row in range(h):
        for column in range(w):
            n = 0
            for r in range(row * parts, (row + 1) * parts):
                for c in range(column * parts, (column + 1) * parts):
                    for j in range(3 if corners[r, c, 0] >= 0 else 0):
                        samples[n], weights[n] = corners[r, c, j], shares[r, c, j]
                        n += 1
            total, square = 0.0, 0.0
            for a in range(n):
                total += weights[a]
                for b in range(n):
                    if samples[a] == samples[b]:
                        square += weights[a] * weights[b]
            if n > 0:
                found[row, column] = square / total**2
    return found
