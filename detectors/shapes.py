"""Shapes that a target's surface may have, each fitted to a few hundred or thousand weighted points: polynomials
z(x, y), quadrics (sphere, cylinder, cone, ...), and a smooth free form added to either.

A fit is a function from measured points (n, 3) to the z (n,) of the surface: on the ray through the lens and the point
for quadrics and free forms, at the point's x and y for polynomials.

Not modelled: overhangs, creases, several sheets.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numba
import numpy as np
from scipy import sparse
from scipy.linalg import eigh, solveh_banded

from detectors import surface_kernels as kernels
from detectors.surface import Scaling

Fit = Callable[[np.ndarray], np.ndarray]
"""Measured points (n, 3), metres, to the surface's z (n,), metres; NaN where a ray misses the surface."""
RIDGE = 1e-9
"""Share of the largest diagonal element that is added to each: keeps normal equations regular where the points do not
determine a coefficient."""
KNOTS_PER_WAVELENGTH = 4.0
"""Cubic splines with knots at a quarter of the shortest wave that the penalty lets pass leave the penalty in charge."""
MOST_KNOTS = 64
"""Most knots along one side: a limit to time and memory; the free form is then smoother than asked for."""


def polynomial(points: np.ndarray, weights: np.ndarray, degree: int) -> Fit:
    """Fit Chebyshev products of total degree ``degree`` by weighted least squares; regular for any points."""
    powers = np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)], dtype=np.int64)
    scaling, level = Scaling.of(points[:, 0], points[:, 1]), float(points[:, 2].mean())

    def scaled(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return scaling(p[:, 0], p[:, 1])

    basis = kernels.chebyshev_basis(*scaled(points), powers)
    gram, right = kernels.weighted_gram(basis, np.ascontiguousarray(points[:, 2] - level), weights)
    gram[np.diag_indices_from(gram)] += RIDGE * gram.diagonal().max()
    coefficients = np.linalg.solve(gram, right)
    coefficients[0] += level
    return lambda p: kernels.chebyshev_sum(*scaled(p), powers, coefficients)


# ---------------------------------------------------------------- quadrics


def quadric(points: np.ndarray, weights: np.ndarray, central: bool) -> Fit | None:
    """Fit the quadric with the least weighted squares of distances along the rays, to first order: Taubin's algebraic
    fit (1991) along the rays, then Gauss-Newton steps. None where the points lie on no single sheet of it.

    ``central``: rays leave the origin; else they are parallel to z.
    """
    middle = np.average(points, axis=0, weights=weights)
    size = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=weights))) or 1.0
    scaled = (points - middle) / size
    along = (points / points[:, 2:] if central else np.broadcast_to([0.0, 0.0, 1.0], points.shape)) / size
    x, y, z = scaled.T
    terms = np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, np.ones_like(x)], axis=1)
    (dx, dy, dz), zero = along.T, np.zeros_like(x)
    products = [2 * x * dx, 2 * y * dy, 2 * z * dz, x * dy + y * dx, x * dz + z * dx, y * dz + z * dy]
    slopes = np.stack([*products, dx + zero, dy + zero, dz + zero, zero], axis=1)

    # Taubin's fit: the least sum of F^2 for a given sum of (dF/dray)^2
    means = np.average(terms[:, :9], axis=0, weights=weights)
    centred = terms[:, :9] - means
    squares = centred.T @ (weights[:, None] * centred)
    sloped = slopes[:, :9].T @ (weights[:, None] * slopes[:, :9])
    sloped[np.diag_indices_from(sloped)] += 1e-6 * np.trace(sloped)
    algebraic = eigh(squares, sloped, subset_by_index=(0, 0))[1][:, 0]
    c = np.append(algebraic, -means @ algebraic)
    c /= np.linalg.norm(c)
    for _ in range(4):
        steep = slopes @ c
        sheet = np.sign(np.average(np.sign(steep), weights=weights)) or 1.0
        floor = 0.02 * float(np.median(np.abs(steep)))
        steep = np.where(np.abs(steep) < floor, sheet * max(floor, 1e-300), steep)
        jacobian, residual = terms / steep[:, None], (terms @ c) / steep
        gram = jacobian.T @ (weights[:, None] * jacobian)
        gram[np.diag_indices_from(gram)] += RIDGE * gram.diagonal().max()
        c = c - np.linalg.solve(gram, jacobian.T @ (weights * residual))
        c /= np.linalg.norm(c)
    sheet = float(np.sign(np.average(np.sign(slopes @ c), weights=weights)))
    if sheet == 0.0:
        return None

    def z_at(q: np.ndarray) -> np.ndarray:
        if central:
            start, ray = np.broadcast_to(-middle / size, q.shape), q / q[:, 2:] / size
        else:
            start, ray = (q * [1.0, 1.0, 0.0] - middle) / size, np.broadcast_to([0.0, 0.0, 1.0 / size], q.shape)
        return _crossing(c, start, ray, sheet)

    return z_at


def _crossing(c: np.ndarray, start: np.ndarray, ray: np.ndarray, sheet: float) -> np.ndarray:
    """Return t at which start + t ray meets the quadric where F grows along the ray with the sign ``sheet``, or NaN."""
    matrix = np.array([[c[0], c[3] / 2, c[4] / 2], [c[3] / 2, c[1], c[5] / 2], [c[4] / 2, c[5] / 2, c[2]]])
    linear = c[6:9]
    a = np.einsum("ni,ij,nj->n", ray, matrix, ray)
    b = 2 * np.einsum("ni,ij,nj->n", start, matrix, ray) + ray @ linear
    k = np.einsum("ni,ij,nj->n", start, matrix, start) + start @ linear + c[9]
    with np.errstate(invalid="ignore", divide="ignore"):
        root = sheet * np.sqrt(b * b - 4 * a * k)
        # of the two equal forms the one without cancellation
        return np.where(b * sheet > 0, 2 * k / (-b - root), (-b + root) / (2 * a))


# ---------------------------------------------------------------- free form


def free_form(points: np.ndarray, weights: np.ndarray, base: Fit, wavelength: float, cell: float, central: bool) -> Fit:
    """Fit a base shape plus a smooth correction of z: tensor-product cubic B-splines in the picture's plane, penalised
    on third derivatives (Eilers and Marx 1996, in two dimensions).

    ``wavelength``: waves of this length pass by half, shorter ones less (as its sixth power); in units of x/z (central)
    or metres, as ``cell``, the spacing of the points.
    """
    places = picture_places(points, central)
    low, high = places.min(axis=0), places.max(axis=0)
    spacing = max(wavelength / KNOTS_PER_WAVELENGTH, float((high - low).max()) / MOST_KNOTS)
    counts = np.maximum(np.ceil((high - low) / spacing).astype(int), 1) + 3
    residual = points[:, 2] - base(points)
    w = np.where(np.isfinite(residual), weights, 0.0)
    banded, right = _spline_gram(places, np.where(w > 0, residual, 0.0), w, low, spacing, counts)
    # w is near 1: 1 / cell^2 points of weight 1 in each unit of area; Parseval's theorem gives the factor
    stiffness = (wavelength / (2 * np.pi)) ** 6 / cell**2 / spacing**4
    banded += stiffness * _penalty(int(counts[0]), int(counts[1]), len(banded) - 1)
    banded[-1] += RIDGE * float(banded[-1].max())
    coefficients = solveh_banded(banded, right, check_finite=False)

    def z_at(q: np.ndarray) -> np.ndarray:
        return base(q) + _spline_sum(picture_places(q, central), coefficients, low, spacing, counts)

    return z_at


def picture_places(points: np.ndarray, central: bool) -> np.ndarray:
    """Return (n, 2) x/z and y/z, or x and y where rays are parallel."""
    return points[:, :2] / points[:, 2:] if central else points[:, :2]


@numba.njit(cache=True, nogil=True)
def _splines(x: float, count: int, values: np.ndarray) -> int:
    """Fill in the 4 cubic splines that reach x, in units of the knots' spacing; returns the number of the first."""
    x = min(max(x, 0.0), count - 3.0)
    first = min(int(x), count - 4)
    t = x - first
    s = 1.0 - t
    values[0], values[3] = s * s * s / 6.0, t * t * t / 6.0
    values[1] = (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0
    values[2] = (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0
    return first


@numba.njit(cache=True, nogil=True)
def _spline_gram(
    places: np.ndarray, z: np.ndarray, weights: np.ndarray, low: np.ndarray, spacing: float, counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper bands (3 counts[1] + 4, counts[0] counts[1]), as LAPACK wants them, of B' W B; and B' W z."""
    size, width = counts[0] * counts[1], 3 * counts[1] + 3
    banded, right = np.zeros((width + 1, size)), np.zeros(size)
    x, y, value, number = np.empty(4), np.empty(4), np.empty(16), np.empty(16, np.int64)
    for n in range(len(places)):
        if weights[n] <= 0.0:
            continue
        row = _splines((places[n, 0] - low[0]) / spacing, counts[0], x)
        column = _splines((places[n, 1] - low[1]) / spacing, counts[1], y)
        for i in range(4):
            for j in range(4):
                value[4 * i + j] = x[i] * y[j]
                number[4 * i + j] = (row + i) * counts[1] + column + j
        for i in range(16):
            weighted = weights[n] * value[i]
            right[number[i]] += weighted * z[n]
            for j in range(i, 16):
                banded[width + number[i] - number[j], number[j]] += weighted * value[j]
    return banded, right


@numba.njit(cache=True, nogil=True)
def _spline_sum(
    places: np.ndarray, coefficients: np.ndarray, low: np.ndarray, spacing: float, counts: np.ndarray
) -> np.ndarray:
    """Return the splines' sum (n,); beyond their edge the value at the edge."""
    total = np.zeros(len(places))
    x, y = np.empty(4), np.empty(4)
    for n in range(len(places)):
        row = _splines((places[n, 0] - low[0]) / spacing, counts[0], x)
        column = _splines((places[n, 1] - low[1]) / spacing, counts[1], y)
        for i in range(4):
            for j in range(4):
                total[n] += coefficients[(row + i) * counts[1] + column + j] * x[i] * y[j]
    return total


@lru_cache(maxsize=32)
def _penalty(rows: int, columns: int, width: int) -> np.ndarray:
    """Return the upper bands of the sum of squared third differences of (rows, columns) coefficients, mixed ones three
    times."""

    def squared(count: int, order: int) -> np.ndarray:
        differences = np.diff(np.eye(count), order, axis=0)
        return np.asarray(differences.T @ differences)

    penalty = sum(
        factor * sparse.kron(squared(rows, order), squared(columns, 3 - order), format="csr")
        for order, factor in enumerate((1.0, 3.0, 3.0, 1.0))
    )
    upper = sparse.coo_array(sparse.triu(penalty))
    banded = np.zeros((width + 1, rows * columns))
    banded[width + upper.row - upper.col, upper.col] = upper.data
    return banded
