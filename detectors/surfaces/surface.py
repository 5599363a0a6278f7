"""Shapes of a target, fitted to points that include damage: polynomials z(x, y) (the thesis'
"robust cubic" and others) and quadrics (sphere, cylinder, cone, ...).

Large clouds are solved on an even sample first and finished on all points. Not modelled: errors in
x and y, correlated noise, overhangs, creases, several sheets. Damage of one to three sigma shifts
point-wise robust fits by a third of a sigma."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal, Self

import numba
import numpy as np
from pydantic import Field, model_validator
from scipy.linalg import eigh
from scipy.linalg.lapack import dpotrf, dpotrs

from detectors.pixels.clusters import PLAIN
from detectors.pixels.noise import median_of
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.meshes import FILES, FileUnit, FrontAxis

SAMPLE_POINTS = 2048
BISQUARE_TUNING = 4.685  # 95 % efficiency for Gaussian noise; MATLAB's default
LTS_SAMPLE = 8192
LTS_SMALL = 600
LTS_STARTS = 500
LTS_KEPT = 10
LTS_STEPS = 10
"""FAST-LTS: points in the large and in the first sample, elemental starts, continued starts and
their steps."""
LTS_COVERAGE = 0.55  # fraction of points that the fit must explain: it tolerates up to 45 % damage
LTS_SEED = 20201102
LAR_THINNING = 12
LAR_STEPS = 60
HALVINGS = 12
KNEES = np.array(
    [1.0, 0.1, 0.03, 0.003, 3e-4, 3e-5, 3e-6]
)  # knees of Huber's function, in units of the median |r|
BISQUARE_CONVERGED = 1e-2
GAP_CONVERGED = 1e-6
"""Bisquare stops below this share of a standard error of the fit, LAR if the relative duality gap
is this small."""
TINY_M = 1e-9  # residuals below a nanometre are rounding errors

Solution = tuple[np.ndarray, str]  # coefficients (p,) and a description of the fit


class ReferenceConfig(Config):
    """The part's own mesh, which may be open. ``front``: the axis of the file that points to the
    camera."""

    file: Annotated[str, Field(min_length=1, max_length=1000, description=FILES)]
    unit: FileUnit = "mm"
    front: FrontAxis = "+z"


class SurfaceConfig(Config):
    """``shape``: ``polynomial``, of the stated total ``degree`` (3: MATLAB's poly33); ``auto``,
    the simplest of plane, polynomials, quadric and free form that the cloud supports;
    ``free_form``; or ``mesh``, the ``reference`` fitted to the cloud. ``scale_mm``: width above
    which a free form follows the cloud. ``method``: ``lar`` least absolute residuals; ``bisquare``
    Tukey's, from a least-squares start (MATLAB's semantics); ``lts`` bisquare from a FAST-LTS
    start, which tolerates damage of a third of the surface; ``least_squares``.
    ``drop_cross_terms``: whether terms in both x and y are left out (as in the thesis' script)."""

    shape: Literal["polynomial", "auto", "free_form", "mesh"] = "polynomial"
    reference: ReferenceConfig | None = None
    scale_mm: float | None = Field(default=None, gt=0)
    degree: int = Field(default=3, ge=0, le=8)
    method: Literal["lar", "bisquare", "lts", "least_squares"] = "lar"
    drop_cross_terms: bool = False

    @model_validator(mode="after")
    def _one_surface(self) -> Self:
        if (self.shape == "mesh") != (self.reference is not None):
            raise ValueError("shape: mesh and reference: {file: part.stl} need each other")
        return self


@dataclass(frozen=True)
class Chebyshev:
    """Products T_a(u) T_b(v) for rows (a, b) of ``powers`` (p, 2); (u, v) = ((x, y) -
    ``middle_m``) / ``half_m``."""

    powers: np.ndarray
    middle_m: np.ndarray
    half_m: np.ndarray

    @classmethod
    def over(cls, xy_m: np.ndarray, degree: int, cross_terms: bool = True) -> Chebyshev:
        """Return the products up to a total degree over places (n, 2), which may coincide."""
        orders = [(i, total - i) for total in range(degree + 1) for i in range(total, -1, -1)]
        low = np.array([np.min(xy_m[:, 0]), np.min(xy_m[:, 1])])
        high = np.array([np.max(xy_m[:, 0]), np.max(xy_m[:, 1])])
        # separable polynomials f(x) + g(y) stay separable under scaling of each axis
        powers = np.array([(i, j) for i, j in orders if cross_terms or not (i and j)])
        return cls(powers, (low + high) / 2, np.maximum((high - low) / 2, TINY_M))

    def basis(self, xy_m: np.ndarray) -> np.ndarray:
        """Return the products (p, n) at places (n, 2)."""
        products = np.empty((len(self.powers), len(xy_m)))
        places_m = np.ascontiguousarray(xy_m.T, np.float64)
        _write_products(places_m, self.powers, self.middle_m, self.half_m, products)
        return products

    def total(self, coefficients: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
        """Return the sum (n,) of the products at places (n, 2), each times its coefficient (p,)."""
        starts = range(0, max(len(xy_m), 1), AT_ONCE)
        return np.concatenate(
            [coefficients @ self.basis(xy_m[first : first + AT_ONCE]) for first in starts]
        )


# places whose products, and whose orders of u and v, stay in the caches
AT_ONCE = 4096
BLOCK = 512


@numba.njit(**PLAIN)
def _write_orders(places_m: np.ndarray, middle_m: float, half_m: float, orders: np.ndarray) -> None:
    """Write T_0, T_1, ... (d + 1, n) of scaled places (n,) along one axis."""
    for i in range(len(places_m)):
        orders[0, i] = 1.0
        orders[1, i] = (places_m[i] - middle_m) / half_m
    for k in range(2, len(orders)):
        for i in range(len(places_m)):
            orders[k, i] = 2.0 * orders[1, i] * orders[k - 1, i] - orders[k - 2, i]


@numba.njit(**PLAIN)
def _write_products(xy_m, powers, middle_m, half_m, products):  # type: ignore[no-untyped-def]
    """Write the products (p, n) at places (2, n)."""
    orders = np.empty((2, max(powers.max(), 1) + 1, BLOCK))
    for first in range(0, xy_m.shape[1], BLOCK):
        last = min(first + BLOCK, xy_m.shape[1])
        for axis in range(2):
            _write_orders(xy_m[axis, first:last], middle_m[axis], half_m[axis], orders[axis])
        for j in range(len(powers)):
            u = orders[0, powers[j, 0]]
            v = orders[1, powers[j, 1]]
            product = products[j, first:last]
            for i in range(len(product)):
                product[i] = u[i] * v[i]


@dataclass(frozen=True)
class Surface:
    """A fitted surface; ``coefficients`` (p,) metres."""

    chebyshev: Chebyshev
    coefficients: np.ndarray
    note: str

    def evaluate(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return z in metres at x, y of one shape; NaN where they are NaN. Polynomials extrapolate
        badly."""
        x, y = np.broadcast_arrays(
            np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64)
        )
        return self.chebyshev.total(
            self.coefficients, np.column_stack([x.ravel(), y.ravel()])
        ).reshape(x.shape)

    def gradients(self, x_m: np.ndarray, y_m: np.ndarray, step_m: float) -> np.ndarray:
        """Return (..., 3) gradients of z less the surface, (-dz/dx, -dz/dy, 1), at x, y by central
        differences."""
        ways = ((step_m, 0.0), (0.0, step_m))
        twice = [
            self.evaluate(x_m - dx, y_m - dy) - self.evaluate(x_m + dx, y_m + dy) for dx, dy in ways
        ]
        return np.stack([*(each / (2 * step_m) for each in twice), np.ones_like(twice[0])], axis=-1)


def fit_surface(
    x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, config: SurfaceConfig
) -> Surface:
    """Fit z(x, y) to finite points, each (n,). LAR is within 2e-6 of the least sum of absolute
    residuals, bisquare within 0.05 standard errors of the fixed point of all points.
    Deterministic. Raises UserError if there are fewer points than coefficients, or if all points
    lie on a line."""
    terms = (
        (2 * config.degree + 1)
        if config.drop_cross_terms
        else (config.degree + 1) * (config.degree + 2) // 2
    )
    if len(z_m) < terms:
        degree = f"a surface of degree {config.degree}"
        what = f"{len(z_m)} valid points cannot determine the {terms} coefficients of {degree}"
        legal = f"at least {terms} points"
        fix = "widen the crop, lower surface.degree, or check the capture"
        raise UserError(what, legal=legal, fix=fix)
    xy = np.column_stack([x_m, y_m]).astype(np.float64)
    chebyshev = Chebyshev.over(xy, config.degree, not config.drop_cross_terms)
    basis = chebyshev.basis(xy)
    middle = median_of(z_m[:: max(1, len(z_m) // SAMPLE_POINTS)])
    z = np.asarray(z_m, dtype=np.float64) - middle
    plain = (
        _solved(basis, z)
        if config.method == "least_squares"
        else _solved(*_thinned(basis, z, SAMPLE_POINTS))
    )
    if plain is None:
        what = f"the points do not determine a surface of degree {config.degree}: they lie on a line or a curve"
        raise UserError(what, fix="widen the crop, or lower surface.degree")
    if config.method == "lar":
        c, note = _lar(basis, z, plain[0])
    elif config.method == "bisquare":
        c, note = _bisquare(basis, z, None, "bisquare from a least-squares start")
    elif config.method == "lts":
        start = _lts_start(*_thinned(basis, z, LTS_SAMPLE))
        c, note = _bisquare(basis, z, start, "bisquare from a FAST-LTS start")
    else:
        c = plain[0]
        note = "least squares"
    c = c.copy()
    c[0] += middle
    return Surface(chebyshev, c, note)


def _solved(
    basis: np.ndarray, z: np.ndarray, weight: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the weighted least-squares solution (p,) of a basis (p, n) and Cholesky's factor (p,
    p), or None."""
    weighted = basis if weight is None else basis * weight
    factor = _factor(weighted @ basis.T)
    return None if factor is None else (dpotrs(factor, weighted @ z, lower=True)[0], factor)


def _factor(gram: np.ndarray) -> np.ndarray | None:
    """Return the lower Cholesky factor; None if the matrix is singular to working precision."""
    factor, failed = dpotrf(gram, lower=True)
    size = factor.diagonal()
    return None if failed or not size.min() > 1e-7 * size.max() else factor


def _thinned(basis: np.ndarray, z: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``points`` of the points, evenly strided; all if these are too few for the fit."""
    stride = len(z) // points
    if stride < 2:
        return basis, z
    few_basis = np.ascontiguousarray(basis[:, ::stride])
    few_z = np.ascontiguousarray(z[::stride])
    return (basis, z) if _solved(few_basis, few_z) is None else (few_basis, few_z)


def _lar(
    basis: np.ndarray, z: np.ndarray, start: np.ndarray, knees: np.ndarray = KNEES
) -> Solution:
    """Find the L1 solution by smoothing (Madsen and Nielsen 1993)."""
    c = start
    margin = np.inf
    few_basis, few_z = _thinned(basis, z, max(SAMPLE_POINTS, len(z) // LAR_THINNING))
    if len(few_z) < len(z):
        c = _lar(few_basis, few_z, start, KNEES[:3])[0]
        knees = knees[2:]
        # 5 standard errors of the thinned L1 solution, in units of the median |r|
        margin = 5.0 * 1.25 / 0.6745 * np.sqrt(len(basis) / len(few_z))
    r = z - c @ basis
    scale = max(median_of(np.abs(r[:: max(1, len(r) // SAMPLE_POINTS)])), TINY_M)
    for knee in scale * knees:
        enough = 0.001 * GAP_CONVERGED * float(np.abs(r).sum())
        reach = max(margin * scale, 10.0 * knee)
        while True:
            far = np.abs(r) >= reach
            near = np.flatnonzero(~far)
            far_pull = basis @ np.where(far, np.sign(r), 0.0)
            rows = np.ascontiguousarray(np.take(basis, near, axis=1).T)
            new = _smoothed_descent(rows, z[near], far_pull, c, knee, enough)
            after = z - new @ basis
            # a far point may have crossed the surface or come within its knee
            if not (far & ((r * after <= 0.0) | (np.abs(after) < knee))).any():
                break
            reach *= 3.0
        c = new
        r = after
        margin = min(margin, 5.0 * knee / scale)
        sizes = np.abs(r)
        inside = sizes[sizes <= knee]
        gap = float((inside - inside**2 / knee).sum()) / max(float(sizes.sum()), TINY_M)
        if gap <= GAP_CONVERGED:
            break
    return c, f"least absolute residuals, within {min(gap, 1.0):.0e} of the least sum"


@numba.njit(**PLAIN)
def _huber(
    rows: np.ndarray, z: np.ndarray, c: np.ndarray, knee: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the sum of Huber's function over its knee, its negative gradient (p,), the inner
    normal matrix's lower half."""
    terms = len(c)
    value = 0.0
    pull = np.zeros(terms)
    inside = np.zeros((terms, terms))
    for i in range(len(z)):
        r = z[i]
        for j in range(terms):
            r -= rows[i, j] * c[j]
        capped = min(abs(r), knee)
        value += capped * (abs(r) - 0.5 * capped) / knee
        slope = min(max(r / knee, -1.0), 1.0)
        for j in range(terms):
            pull[j] += slope * rows[i, j]
        if abs(r) <= knee:
            for j in range(terms):
                for k in range(j + 1):
                    inside[j, k] += rows[i, j] * rows[i, k]
    return value, pull, inside


def _smoothed_descent(
    rows: np.ndarray,
    z: np.ndarray,
    far_pull: np.ndarray,
    start: np.ndarray,
    knee: float,
    enough: float,
) -> np.ndarray:
    """Minimise sum huber(r, knee) - c' far_pull by Newton steps, or by majorising steps, which
    always descend."""

    def state(c: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        value, pull, inside = _huber(rows, z, c, knee)
        return value - float(c @ far_pull), c, pull + far_pull, inside

    def lower(way: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray] | None:
        """Return the first of the full, half, quarter ... step that lowers the value."""
        trials = (state(c + way * 0.5**halvings) for halvings in range(HALVINGS))
        return next((trial for trial in trials if trial[0] < value), None)

    value, c, pull, inside = state(start)
    for _ in range(LAR_STEPS):
        factor = _factor(inside)
        moved = None
        if factor is not None:
            way = knee * dpotrs(factor, pull, lower=True)[0]
            if way @ pull < enough:
                return c
            moved = lower(way)
        if moved is None:
            # reweighted least squares: each |r| beyond the knee under its tangent parabola
            weighted = rows / np.maximum(np.abs(z - rows @ c), knee)[:, None]
            moved = lower(np.linalg.lstsq(weighted.T @ rows, pull, rcond=1e-12)[0])
        if moved is None or value - moved[0] < enough:
            return c
        value, c, pull, inside = moved
    return c


def bisquare_weights(r: np.ndarray, limit: float) -> np.ndarray:
    """Return Tukey's weights (1 - (r / limit)^2)^2 inside the limit, 0 outside."""
    return np.asarray(np.maximum(1.0 - (r / max(limit, TINY_M)) ** 2, 0.0) ** 2)


def _bisquare(basis: np.ndarray, z: np.ndarray, start: np.ndarray | None, note: str) -> Solution:
    """Reweight least squares with MATLAB's robustfit semantics, on a sample first, then on all
    points."""
    few_basis, few_z = _thinned(basis, z, SAMPLE_POINTS)
    inner = _reweighted(few_basis, few_z, start, 50, note)
    return inner if len(few_z) == len(z) else _reweighted(basis, z, inner[0], 8, note)


def _reweighted(
    basis: np.ndarray, z: np.ndarray, start: np.ndarray | None, steps: int, note: str
) -> Solution:
    plain = _solved(basis, z)
    assert plain is not None
    c = plain[0] if start is None else start
    terms = len(basis)
    leverage = ((np.linalg.inv(plain[1]) @ basis) ** 2).sum(axis=0)
    adjust = 1.0 / np.sqrt(1.0 - np.minimum(leverage, 0.9999))
    for _ in range(steps):
        adjusted = (z - c @ basis) * adjust
        # MATLAB's robust sigma: median of |r| over 0.6745, without the smallest |r|, one for each
        # term
        sizes = np.abs(adjusted)
        place = min(terms - 1 + (len(sizes) - terms + 1) // 2, len(sizes) - 1)
        scale = max(float(np.partition(sizes, place)[place]) / 0.6745, TINY_M)
        found = _solved(basis, z, bisquare_weights(adjusted, BISQUARE_TUNING * scale))
        if found is None:
            return c, note + "; stopped: too few points kept weight"
        new, factor = found
        # norm of the move in standard errors of the fit: factor' (new - c) has unit covariance
        # times scale^2
        moved = float(np.linalg.norm(factor.T @ (new - c))) / scale
        c = new
        if moved < BISQUARE_CONVERGED * np.sqrt(terms):
            break
    return c, note


def _lts_start(basis: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return FAST-LTS's coefficients (p,) (Rousseeuw and Van Driessen 2006)."""
    few_basis, few_z = _thinned(basis, z, LTS_SMALL)
    (terms, points), ridge = few_basis.shape, 1e-12 * np.eye(len(few_basis))

    def concentrated(basis: np.ndarray, z: np.ndarray, c: np.ndarray, steps: int) -> np.ndarray:
        """Return coefficients (m, p) after this many steps, those with the least sum of the
        smallest squares first."""
        kept = min(len(z), max(int(LTS_COVERAGE * len(z)), (len(z) + terms + 1) // 2))
        products = (basis[:, None] * basis).reshape(-1, len(z)).T
        for _ in range(steps):
            squares = (z - c @ basis) ** 2
            chosen = 1.0 * (squares <= np.partition(squares, kept - 1, axis=1)[:, kept - 1 : kept])
            grams = (chosen @ products).reshape(-1, terms, terms)
            c = np.linalg.solve(grams + len(z) * ridge, ((chosen * z) @ basis.T)[..., None])[..., 0]
        sums = np.partition((z - c @ basis) ** 2, kept - 1, axis=1)[:, :kept].sum(axis=1)
        return np.asarray(c[np.argsort(sums, kind="stable")])

    picks = np.argpartition(
        np.random.default_rng(LTS_SEED).random((LTS_STARTS, points)), terms - 1, axis=1
    )[:, :terms]
    starts = np.linalg.solve(few_basis.T[picks] + ridge, few_z[picks][..., None])[..., 0]
    best = concentrated(few_basis, few_z, starts, 2)[:LTS_KEPT]
    return np.asarray(concentrated(basis, z, best, LTS_STEPS)[0])


Fit = Callable[[np.ndarray], np.ndarray]
"""Maps measured points (n, 3), metres, to the surface's z (n,), metres; NaN where a ray misses the
surface."""
# share of the largest diagonal element, added to every one so that normal equations stay regular
RIDGE = 1e-9


def polynomial(points: np.ndarray, weights: np.ndarray, degree: int) -> Fit:
    """Fit Chebyshev products of total degree ``degree`` by weighted least squares; regular for any
    points."""
    chebyshev = Chebyshev.over(points[:, :2], degree)
    level = float(points[:, 2].mean())
    basis = chebyshev.basis(points[:, :2])
    coefficients = _ridged(basis.T, points[:, 2] - level, weights)
    coefficients[0] += level
    return lambda p: chebyshev.total(coefficients, p[:, :2])


def _ridged(design: np.ndarray, z: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the weighted least-squares solution (p,) of a design (n, p), regular by `RIDGE`."""
    weighted = weights[:, None] * design
    gram = design.T @ weighted
    gram[np.diag_indices_from(gram)] += RIDGE * gram.diagonal().max()
    return np.asarray(np.linalg.solve(gram, weighted.T @ z))


def quadric(points: np.ndarray, weights: np.ndarray, central: bool) -> Fit | None:
    """Fit the quadric with the least weighted squares along the rays, to first order: Taubin's
    algebraic fit (1991), then Gauss-Newton. None if it has no single sheet. ``central``: rays
    leave the origin, else along z."""
    middle = np.average(points, axis=0, weights=weights)
    size = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=weights))) or 1.0
    scaled = (points - middle) / size
    along = (
        points / points[:, 2:] if central else np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    ) / size
    (x, y, z), (dx, dy, dz) = scaled.T, along.T
    zero = np.zeros_like(x)
    terms = np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, zero + 1.0], axis=1)
    products = [
        2 * x * dx,
        2 * y * dy,
        2 * z * dz,
        x * dy + y * dx,
        x * dz + z * dx,
        y * dz + z * dy,
    ]
    slopes = np.stack([*products, dx, dy, dz, zero], axis=1)

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
        c = c - _ridged(terms / steep[:, None], (terms @ c) / steep, weights)
        c /= np.linalg.norm(c)
    sheet = float(np.sign(np.average(np.sign(slopes @ c), weights=weights)))
    if sheet == 0.0:
        return None
    matrix = np.array(
        [[c[0], c[3] / 2, c[4] / 2], [c[3] / 2, c[1], c[5] / 2], [c[4] / 2, c[5] / 2, c[2]]]
    )

    def z_at(q: np.ndarray) -> np.ndarray:
        """Return t at which start + t ray meets the quadric where F grows along the ray with the
        sheet's sign."""
        if central:
            start = np.broadcast_to(-middle / size, q.shape)
            ray = q / q[:, 2:] / size
        else:
            start = (q * [1.0, 1.0, 0.0] - middle) / size
            ray = np.broadcast_to([0.0, 0.0, 1.0 / size], q.shape)
        a = np.einsum("ni,ij,nj->n", ray, matrix, ray)
        b = 2 * np.einsum("ni,ij,nj->n", start, matrix, ray) + ray @ c[6:9]
        k = np.einsum("ni,ij,nj->n", start, matrix, start) + start @ c[6:9] + c[9]
        with np.errstate(invalid="ignore", divide="ignore"):
            root = sheet * np.sqrt(b * b - 4 * a * k)
            # the form without cancellation
            return np.where(b * sheet > 0, 2 * k / (-b - root), (-b + root) / (2 * a))

    return z_at
