"""The smooth free form that is added to a simple shape: penalised splines in the picture."""

from functools import lru_cache

import numba
import numpy as np
from scipy import sparse
from scipy.linalg import solveh_banded

from detectors.pixels.clusters import PLAIN
from detectors.surfaces.surface import RIDGE, SurfaceFunction

KNOTS_PER_WAVELENGTH = 4.0
"""Cubic splines with knots at a quarter of the shortest wave that the penalty lets pass leave the
penalty in charge."""
# most knots along one side: limits time and memory; the free form may then be smoother than
# requested
MOST_KNOTS = 64


def free_form(
    points: np.ndarray,
    weights: np.ndarray,
    base: SurfaceFunction,
    wavelength: float,
    cell: float,
    central: bool,
) -> SurfaceFunction:
    """Fit a base shape plus tensor-product cubic B-splines in the picture's plane, penalised on
    third derivatives (Eilers and Marx 1996). Waves of ``wavelength`` pass by half, shorter ones
    less (as its sixth power); in units of x/z (central) or metres, as ``cell``, the spacing of the
    points."""
    positions = picture_places(points, central)
    low = positions.min(axis=0)
    extent = np.ptp(positions, axis=0)
    spacing = max(wavelength / KNOTS_PER_WAVELENGTH, float(extent.max()) / MOST_KNOTS)
    counts = np.maximum(np.ceil(extent / spacing).astype(int), 1) + 3
    residual = points[:, 2] - base(points)
    fitted_weights = np.where(np.isfinite(residual), weights, 0.0)
    z = np.where(fitted_weights > 0, residual, 0.0)
    values, numbers = _splines((positions - low) / spacing, counts)
    # LAPACK's upper bands
    width = int(3 * counts[1] + 3)
    banded, right = _normal_bands(values, numbers, fitted_weights, z, width, int(counts.prod()))
    # the weights are near 1: 1 / cell^2 points of weight 1 in each unit of area; Parseval's
    # theorem gives the factor
    stiffness = (wavelength / (2 * np.pi)) ** 6 / cell**2 / spacing**4
    penalty = _penalty(int(counts[0]), int(counts[1]))
    banded[width + penalty.row - penalty.col, penalty.col] += stiffness * penalty.data
    banded[-1] += RIDGE * float(banded[-1].max())
    table = solveh_banded(banded, right, check_finite=False).reshape(counts)

    def z_at(q: np.ndarray) -> np.ndarray:
        return base(q) + _spline_sums(q, central, low, spacing, table)

    return z_at


def picture_places(points: np.ndarray, central: bool) -> np.ndarray:
    """Return (n, 2) x/z and y/z, or x and y where rays are parallel."""
    if central:
        return points[:, :2] / points[:, 2:]
    return points[:, :2]


@numba.njit(**PLAIN)
def _spline(position: float, count: int, out: np.ndarray) -> int:
    """Fill (4,) with the cubic splines that reach a position, the nearest on the knots, and return
    the first's number."""
    x = min(max(position, 0.0), count - 3.0) if np.isfinite(position) else 0.0
    first = min(int(x), count - 4)
    t = x - first
    s = 1.0 - t
    out[0] = s**3 / 6.0
    out[1] = (3 * t**3 - 6 * t**2 + 4) / 6.0
    out[2] = (3 * s**3 - 6 * s**2 + 4) / 6.0
    out[3] = t**3 / 6.0
    return first


@numba.njit(**PLAIN)
def _splines(positions: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 16 products of cubic splines that reach each place (n, 2), and their numbers."""
    values = np.empty((len(positions), 16))
    numbers = np.empty((len(positions), 16), np.int64)
    down = np.empty(4)
    across = np.empty(4)
    for i in range(len(positions)):
        row = _spline(positions[i, 0], counts[0], down)
        column = _spline(positions[i, 1], counts[1], across)
        for k in range(16):
            values[i, k] = down[k // 4] * across[k % 4]
            numbers[i, k] = (row + k // 4) * counts[1] + column + k % 4
    return values, numbers


def _normal_bands(
    values: np.ndarray,
    numbers: np.ndarray,
    weights: np.ndarray,
    z: np.ndarray,
    width: int,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted normal matrix of the splines as upper bands (width + 1, size), and the
    right side (size,)."""
    weighted = weights[:, None] * values
    a, b = np.triu_indices(16)
    rows = numbers[:, a]
    columns = numbers[:, b]
    entries = (width + rows - columns) * size + columns
    squares = weighted[:, a] * values[:, b]
    banded = np.bincount(entries.ravel(), squares.ravel(), (width + 1) * size)
    pulls = weighted * z[:, None]
    right = np.bincount(numbers.ravel(), pulls.ravel(), size)
    return banded.reshape(width + 1, size), right


@numba.njit(error_model="numpy", **PLAIN)
def _spline_sums(
    points: np.ndarray,
    central: bool,
    low: np.ndarray,
    spacing: float,
    coefficients: np.ndarray,
) -> np.ndarray:
    """Return the splines' sum (n,) by coefficients (rows, columns) at points (n, 3)."""
    out = np.empty(len(points))
    down = np.empty(4)
    across = np.empty(4)
    rows, columns = coefficients.shape
    for i in range(len(points)):
        z = points[i, 2] if central else 1.0
        row = _spline((points[i, 0] / z - low[0]) / spacing, rows, down)
        column = _spline((points[i, 1] / z - low[1]) / spacing, columns, across)
        total = 0.0
        for k in range(4):
            part = 0.0
            for m in range(4):
                part += coefficients[row + k, column + m] * across[m]
            total += down[k] * part
        out[i] = total
    return out


@lru_cache(maxsize=32)
def _penalty(rows: int, columns: int) -> sparse.coo_array:
    """Return the upper half of the sum of squared third differences of coefficients, mixed ones
    three times."""

    def squared(count: int, order: int) -> np.ndarray:
        differences = np.diff(np.eye(count), order, axis=0)
        return np.asarray(differences.T @ differences)

    penalty = 0
    for order, factor in enumerate((1.0, 3.0, 3.0, 1.0)):
        down = squared(rows, order)
        across = squared(columns, 3 - order)
        mixed = sparse.kron(down, across, format="csr")
        penalty = penalty + factor * sparse.csr_array(mixed)
    return sparse.coo_array(sparse.triu(penalty))
