"""Shapes of a target, fitted to points that include damage: polynomials z(x, y) (the thesis'
"robust cubic" and others) and quadrics (sphere, cylinder, cone, ...).

Large clouds are solved on an even sample first and finished on all points. Not modelled: errors in
x and y, correlated noise, overhangs, creases, several sheets. Damage of one to three sigma shifts
point-wise robust fits by a third of a sigma."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import numba
import numpy as np
from pydantic import Field
from scipy.linalg import eigh
from scipy.linalg.lapack import dpotrf, dpotrs

from detectors.pixels.clusters import PLAIN
from detectors.pixels.noise import median_of
from detectors.surfaces.interior_point import least_absolute_of_many
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError

SAMPLE_POINTS = 2048
BISQUARE_TUNING = 4.685  # 95 % efficiency for Gaussian noise; MATLAB's default
LTS_SAMPLE = 8192  # points in FAST-LTS's large sample
LTS_SMALL = 600  # points in its first sample
LTS_STARTS = 500  # starts from as few points as there are coefficients
LTS_KEPT = 10  # starts that are continued on the large sample
LTS_STEPS = 10
"""Steps of each continued start."""
LTS_COVERAGE = 0.55  # fraction of points that the fit must explain: it tolerates up to 45 % damage
LTS_SEED = 20201102
LAR_THINNING = 12
LAR_STEPS = 60
REACHES = 3  # margins that are tried, each three times wider than the one before
HALVINGS = 12
KNEES = np.array([1.0, 0.1, 0.03, 0.003, 3e-4, 3e-5, 3e-6])
"""Knees of Huber's function, in units of the median |r|."""
BISQUARE_CONVERGED = 1e-2  # bisquare stops below this share of a standard error of the fit
GAP_CONVERGED = 1e-6
"""LAR stops if the relative duality gap is this small."""
TINY_M = 1e-9  # residuals below a nanometre are rounding errors

Solution = tuple[np.ndarray, str]  # coefficients (p,) and a description of the fit


class SurfaceConfig(Config):
    """The kind of surface that is fitted, and how."""

    # ``polynomial``, of the stated degree; ``auto``, the simplest of plane, polynomials, quadric
    # and free form that the cloud supports; ``free_form``; ``expected``, what the cloud's
    # reference says
    shape: Literal["polynomial", "auto", "free_form", "expected"] = "polynomial"
    # width above which a free form follows the cloud
    scale_mm: float | None = Field(default=None, gt=0)
    # total degree of the polynomial (3: MATLAB's poly33)
    degree: int = Field(default=3, ge=0, le=8)
    # ``lar`` least absolute residuals; ``bisquare`` Tukey's, from a least-squares start (MATLAB's
    # semantics); ``lts`` bisquare from a FAST-LTS start, which tolerates damage of a third of the
    # surface
    method: Literal["lar", "bisquare", "lts", "least_squares"] = "lar"
    # whether terms in both x and y are left out (as in the thesis' script)
    drop_cross_terms: bool = False


@dataclass(frozen=True)
class Chebyshev:
    """Products T_a(u) T_b(v) of Chebyshev polynomials; (u, v) = ((x, y) - middle) / half."""

    powers: np.ndarray
    """Orders (a, b) of each product, (p, 2)."""
    middle_m: np.ndarray
    """Middle of the places (2,)."""
    half_m: np.ndarray
    """Half of their extent (2,)."""

    @classmethod
    def over(cls, xy_m: np.ndarray, degree: int, cross_terms: bool = True) -> Chebyshev:
        """Return the products up to a total degree over places (n, 2), which may coincide."""
        powers = []
        for total in range(degree + 1):
            for i in range(total, -1, -1):
                j = total - i
                # separable polynomials f(x) + g(y) stay separable under scaling of each axis
                if cross_terms or not (i and j):
                    powers.append((i, j))
        low = np.array([np.min(xy_m[:, 0]), np.min(xy_m[:, 1])])
        high = np.array([np.max(xy_m[:, 0]), np.max(xy_m[:, 1])])
        half_m = np.maximum((high - low) / 2, TINY_M)
        return cls(np.array(powers), (low + high) / 2, half_m)

    def basis(self, xy_m: np.ndarray) -> np.ndarray:
        """Return the products (p, n) at places (n, 2)."""
        products = np.empty((len(self.powers), len(xy_m)))
        places_m = np.ascontiguousarray(xy_m.T, np.float64)
        _write_products(places_m, self.powers, self.middle_m, self.half_m, products)
        return products

    def total(self, coefficients: np.ndarray, xy_m: np.ndarray) -> np.ndarray:
        """Return the sum (n,) of the products at places (n, 2), each times its coefficient (p,)."""
        sums = []
        for first in range(0, max(len(xy_m), 1), AT_ONCE):
            basis = self.basis(xy_m[first : first + AT_ONCE])
            sums.append(coefficients @ basis)
        return np.concatenate(sums)


AT_ONCE = 4096  # places whose products stay in the caches
BLOCK = 512  # places whose orders of u and v stay in the caches


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
    """A fitted polynomial surface z(x, y)."""

    chebyshev: Chebyshev
    """The products."""
    coefficients: np.ndarray
    """The factor (p,) of each, metres; z is their sum."""
    note: str
    """How it was fitted."""

    def evaluate(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return z in metres at x, y of one shape; NaN where they are NaN. Polynomials extrapolate
        badly."""
        x = np.asarray(x_m, dtype=np.float64)
        y = np.asarray(y_m, dtype=np.float64)
        x, y = np.broadcast_arrays(x, y)
        places_m = np.column_stack([x.ravel(), y.ravel()])
        return self.chebyshev.total(self.coefficients, places_m).reshape(x.shape)

    def gradients(self, x_m: np.ndarray, y_m: np.ndarray, step_m: float) -> np.ndarray:
        """Return (..., 3) gradients of z less the surface, (-dz/dx, -dz/dy, 1), at x, y by central
        differences."""
        across = self.evaluate(x_m - step_m, y_m) - self.evaluate(x_m + step_m, y_m)
        down = self.evaluate(x_m, y_m - step_m) - self.evaluate(x_m, y_m + step_m)
        twice_m = 2 * step_m
        return np.stack([across / twice_m, down / twice_m, np.ones_like(across)], axis=-1)


def fit_surface(
    x_m: np.ndarray,
    y_m: np.ndarray,
    z_m: np.ndarray,
    config: SurfaceConfig,
) -> Surface:
    """Fit z(x, y) to finite points, each (n,). LAR is within 2e-6 of the least sum of absolute
    residuals, bisquare within 0.05 standard errors of the fixed point of all points.
    Deterministic. Raises UserError if there are fewer points than coefficients, or if all points
    lie on a line."""
    degree = config.degree
    terms = (degree + 1) * (degree + 2) // 2
    if config.drop_cross_terms:
        terms = 2 * degree + 1
    if len(z_m) < terms:
        raise UserError(
            f"{len(z_m)} valid points cannot determine the {terms} coefficients "
            f"of a surface of degree {degree}",
            legal=f"at least {terms} points",
            fix="widen the crop, lower surface.degree, or check the capture",
        )
    xy = np.column_stack([x_m, y_m]).astype(np.float64)
    chebyshev = Chebyshev.over(xy, degree, not config.drop_cross_terms)
    basis = chebyshev.basis(xy)
    middle = median_of(z_m[:: max(1, len(z_m) // SAMPLE_POINTS)])
    z = np.asarray(z_m, dtype=np.float64) - middle
    if config.method == "least_squares":
        plain = _solved(basis, z)
    else:
        few_basis, few_z = _thinned(basis, z, SAMPLE_POINTS)
        plain = _solved(few_basis, few_z)
    if plain is None:
        raise UserError(
            f"the points do not determine a surface of degree {degree}: "
            "they lie on a line or a curve",
            fix="widen the crop, or lower surface.degree",
        )
    c = plain[0]
    note = "least squares"
    if config.method == "lar":
        c, note = _lar(basis, z, c)
    elif config.method == "bisquare":
        c, note = _bisquare(basis, z, None, "bisquare from a least-squares start")
    elif config.method == "lts":
        large_basis, large_z = _thinned(basis, z, LTS_SAMPLE)
        start = _lts_start(large_basis, large_z)
        c, note = _bisquare(basis, z, start, "bisquare from a FAST-LTS start")
    c = c.copy()
    c[0] += middle
    return Surface(chebyshev, c, note)


def _solved(
    basis: np.ndarray,
    z: np.ndarray,
    weight: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the weighted least-squares solution (p,) of a basis (p, n) and Cholesky's factor (p,
    p), or None."""
    weighted = basis if weight is None else basis * weight
    factor = _factor(weighted @ basis.T)
    if factor is None:
        return None
    solution = dpotrs(factor, weighted @ z, lower=True)[0]
    return solution, factor


def _factor(gram: np.ndarray) -> np.ndarray | None:
    """Return the lower Cholesky factor; None if the matrix is singular to working precision."""
    factor, failed = dpotrf(gram, lower=True)
    size = factor.diagonal()
    if failed or not size.min() > 1e-7 * size.max():
        return None
    return np.asarray(factor)


def _thinned(basis: np.ndarray, z: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``points`` of the points, evenly strided; all if these are too few to fit."""
    stride = len(z) // points
    if stride < 2:
        return basis, z
    few_basis = np.ascontiguousarray(basis[:, ::stride])
    few_z = np.ascontiguousarray(z[::stride])
    if _solved(few_basis, few_z) is None:
        return basis, z
    return few_basis, few_z


def _lar(
    basis: np.ndarray,
    z: np.ndarray,
    start: np.ndarray,
    knees: np.ndarray = KNEES,
) -> Solution:
    """Find the L1 solution by smoothing, on a sample first: most points lie on one side of both
    surfaces, so that only those between them need many steps. Where the sample misleads, by an
    interior point method, which takes five times as long as smoothing takes elsewhere."""
    few_basis, few_z = _thinned(basis, z, max(SAMPLE_POINTS, len(z) // LAR_THINNING))
    c = start
    if len(few_z) == len(z):
        solution = _smoothed(basis, z, c, knees, np.inf)
    else:
        c = _lar(few_basis, few_z, start, KNEES[:3])[0]
        # 5 standard errors of the thinned L1 solution, in units of the median |r|
        margin = 5.0 * 1.25 / 0.6745 * np.sqrt(len(basis) / len(few_z))
        solution = _smoothed(basis, z, c, knees[2:], margin)
    if solution is not None:
        return solution
    c, gap = least_absolute_of_many(basis, z, c, GAP_CONVERGED)
    return c, _lar_note(gap)


def _smoothed(
    basis: np.ndarray,
    z: np.ndarray,
    start: np.ndarray,
    knees: np.ndarray,
    margin: float,
) -> Solution | None:
    """Find the L1 solution by smoothing (Madsen and Nielsen 1993). Points farther than ``margin``
    from the start, in units of the median |r|, keep their side of the surface; None if they do
    not even for a margin nine times as wide."""
    c = start
    r = z - c @ basis
    sample = r[:: max(1, len(r) // SAMPLE_POINTS)]
    scale = max(median_of(np.abs(sample)), TINY_M)
    for knee in scale * knees:
        enough = 0.001 * GAP_CONVERGED * float(np.abs(r).sum())
        reach = max(margin * scale, 10.0 * knee)
        for _ in range(REACHES):
            far = np.abs(r) >= reach
            inliers = np.flatnonzero(~far)
            far_pull = basis @ np.where(far, np.sign(r), 0.0)
            rows = np.ascontiguousarray(np.take(basis, inliers, axis=1).T)
            keeps_sides = partial(_keeps_sides, basis, z, c, r, far, knee, reach)
            new = _smoothed_descent(rows, z[inliers], far_pull, c, knee, enough, keeps_sides)
            if new is not None:
                break
            reach *= 3.0
        if new is None:
            return None
        c = new
        r = z - c @ basis
        margin = min(margin, 5.0 * knee / scale)
        sizes = np.abs(r)
        inside = sizes[sizes <= knee]
        excess = float((inside - inside**2 / knee).sum())
        gap = excess / max(float(sizes.sum()), TINY_M)
        if gap <= GAP_CONVERGED:
            break
    return c, _lar_note(gap)


def _lar_note(gap: float) -> str:
    return f"least absolute residuals, within {min(gap, 1.0):.0e} of the least sum"


def _keeps_sides(
    basis: np.ndarray,
    z: np.ndarray,
    start: np.ndarray,
    r: np.ndarray,
    far: np.ndarray,
    knee: float,
    reach: float,
    c: np.ndarray,
) -> bool:
    """Return whether all points that lie ``far`` from the start's surface, at residuals r (n,),
    lie on the same side of another surface, beyond its knee."""
    # no product of Chebyshev polynomials exceeds 1
    if np.abs(c - start).sum() < reach - knee:
        return True
    after = z - c @ basis
    is_near = (r * after <= 0.0) | (np.abs(after) < knee)
    return not (far & is_near).any()


@numba.njit(**PLAIN)
def _huber(
    rows: np.ndarray,
    z: np.ndarray,
    c: np.ndarray,
    knee: float,
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


class _Descent(NamedTuple):
    """One step of the descent that minimises the smoothed sum of absolute residuals."""

    # the sum that is minimised
    value: float
    # coefficients (p,)
    c: np.ndarray
    # negative gradient of the sum (p,)
    pull: np.ndarray
    # lower half of the normal matrix of the points within the knee (p, p)
    inside: np.ndarray


def _smoothed_descent(
    rows: np.ndarray,
    z: np.ndarray,
    far_pull: np.ndarray,
    start: np.ndarray,
    knee: float,
    enough: float,
    keeps_sides: Callable[[np.ndarray], bool],
) -> np.ndarray | None:
    """Minimise sum huber(r, knee) - c' far_pull by Newton steps, or by majorising steps, which
    always descend. None as soon as far points do not keep their sides: their pull is then wrong,
    and the sum may have no least value, so that the descent would never end."""

    def state(c: np.ndarray) -> _Descent:
        value, pull, inside = _huber(rows, z, c, knee)
        return _Descent(value - float(c @ far_pull), c, pull + far_pull, inside)

    def lower(current: _Descent, direction: np.ndarray) -> _Descent | None:
        """Return the first of the full, half, quarter ... step that lowers the value."""
        for halvings in range(HALVINGS):
            trial = state(current.c + direction * 0.5**halvings)
            if trial.value < current.value:
                return trial
        return None

    current = state(start)
    for _ in range(LAR_STEPS):
        factor = _factor(current.inside)
        moved = None
        if factor is not None:
            direction = knee * dpotrs(factor, current.pull, lower=True)[0]
            if direction @ current.pull < enough:
                return current.c
            moved = lower(current, direction)
        if moved is None:
            # reweighted least squares: each |r| beyond the knee under its tangent parabola
            sizes = np.maximum(np.abs(z - rows @ current.c), knee)
            weighted = rows / sizes[:, None]
            direction = np.linalg.lstsq(weighted.T @ rows, current.pull, rcond=1e-12)[0]
            moved = lower(current, direction)
        if moved is None or current.value - moved.value < enough:
            return current.c
        if not keeps_sides(moved.c):
            return None
        current = moved
    return current.c


def bisquare_weights(r: np.ndarray, limit: float) -> np.ndarray:
    """Return Tukey's weights (1 - (r / limit)^2)^2 inside the limit, 0 outside."""
    relative = r / max(limit, TINY_M)
    return np.asarray(np.maximum(1.0 - relative**2, 0.0) ** 2)


def _bisquare(basis: np.ndarray, z: np.ndarray, start: np.ndarray | None, note: str) -> Solution:
    """Reweight least squares with MATLAB's robustfit semantics, on a sample first, then on all
    points."""
    few_basis, few_z = _thinned(basis, z, SAMPLE_POINTS)
    inner = _reweighted(few_basis, few_z, start, 50, note)
    if len(few_z) == len(z):
        return inner
    return _reweighted(basis, z, inner[0], 8, note)


def _reweighted(
    basis: np.ndarray,
    z: np.ndarray,
    start: np.ndarray | None,
    steps: int,
    note: str,
) -> Solution:
    """Reweight least squares until it moves little, at most ``steps`` times."""
    plain = _solved(basis, z)
    assert plain is not None
    c = plain[0] if start is None else start
    terms = len(basis)
    whitened = np.linalg.inv(plain[1]) @ basis
    leverage = (whitened**2).sum(axis=0)
    adjust = 1.0 / np.sqrt(1.0 - np.minimum(leverage, 0.9999))
    # MATLAB's robust sigma: median of |r| over 0.6745, without the smallest |r|, one for each term
    rank = min(terms - 1 + (len(z) - terms + 1) // 2, len(z) - 1)
    for _ in range(steps):
        adjusted = (z - c @ basis) * adjust
        middle = float(np.partition(np.abs(adjusted), rank)[rank])
        scale = max(middle / 0.6745, TINY_M)
        solution = _solved(basis, z, bisquare_weights(adjusted, BISQUARE_TUNING * scale))
        if solution is None:
            return c, note + "; stopped: too few points kept weight"
        new, factor = solution
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
    terms, points = few_basis.shape
    random = np.random.default_rng(LTS_SEED).random((LTS_STARTS, points))
    picks = np.argpartition(random, terms - 1, axis=1)[:, :terms]
    designs = few_basis.T[picks] + 1e-12 * np.eye(terms)
    starts = np.linalg.solve(designs, few_z[picks][..., None])[..., 0]
    best = _concentrated(few_basis, few_z, starts, 2)[:LTS_KEPT]
    return np.asarray(_concentrated(basis, z, best, LTS_STEPS)[0])


def _concentrated(basis: np.ndarray, z: np.ndarray, c: np.ndarray, steps: int) -> np.ndarray:
    """Return coefficients (m, p) after this many steps, each a fit to the points with the smallest
    residuals; those with the least sum of the smallest squares come first."""
    terms = len(basis)
    ridge = 1e-12 * np.eye(terms)
    covered = max(int(LTS_COVERAGE * len(z)), (len(z) + terms + 1) // 2)
    kept = min(len(z), covered)
    products = (basis[:, None] * basis).reshape(-1, len(z)).T
    for _ in range(steps):
        squares = (z - c @ basis) ** 2
        limits = np.partition(squares, kept - 1, axis=1)[:, kept - 1 : kept]
        chosen = 1.0 * (squares <= limits)
        grams = (chosen @ products).reshape(-1, terms, terms)
        right = (chosen * z) @ basis.T
        c = np.linalg.solve(grams + len(z) * ridge, right[..., None])[..., 0]
    squares = (z - c @ basis) ** 2
    smallest = np.partition(squares, kept - 1, axis=1)[:, :kept]
    order = np.argsort(smallest.sum(axis=1), kind="stable")
    return np.asarray(c[order])


SurfaceFunction = Callable[[np.ndarray], np.ndarray]
"""Maps measured points (n, 3), metres, to the surface's z (n,), metres; NaN where a ray misses the
surface."""
RAY_STEP = 1e-4
"""Share of a point's range by which it is moved along its ray to see how the surface falls off."""
LEAST_OPENING = 0.05
"""Least rate, per z, at which a point that moves along its ray leaves the surface: 87 degrees off
the normal, where nothing is judged."""
# share of the largest diagonal element, added to every one so that normal equations stay regular
RIDGE = 1e-9


def along_rays(fit: SurfaceFunction) -> SurfaceFunction:
    """Return a ``fit`` of z at points' own x and y as one of z where the points' rays from the
    origin meet the surface: to first order in the distance between, exactly for planes. A point
    behind a tilted surface has another x and y than the place that its ray meets."""

    def z_at(points: np.ndarray) -> np.ndarray:
        z = points[:, 2]
        surface_z = fit(points)
        farther_z = fit(points * (1.0 + RAY_STEP))
        slope = (farther_z - surface_z) / (RAY_STEP * z)
        opening = np.maximum(1.0 - slope, LEAST_OPENING)
        return np.asarray(z + (surface_z - z) / opening)

    return z_at


def polynomial(points: np.ndarray, weights: np.ndarray, degree: int) -> SurfaceFunction:
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


def quadric(points: np.ndarray, weights: np.ndarray, central: bool) -> SurfaceFunction | None:
    """Fit the quadric with the least weighted squares along the rays, to first order: Taubin's
    algebraic fit (1991), then Gauss-Newton. None if it has no single sheet. ``central``: rays
    leave the origin, else along z."""
    middle = np.average(points, axis=0, weights=weights)
    squares = ((points - middle) ** 2).sum(axis=1)
    size = float(np.sqrt(np.average(squares, weights=weights))) or 1.0
    rays = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    if central:
        rays = points / points[:, 2:]
    terms, slopes = _quadric_terms((points - middle) / size, rays / size)
    c = _taubin(terms, slopes, weights)
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
        [
            [c[0], c[3] / 2, c[4] / 2],
            [c[3] / 2, c[1], c[5] / 2],
            [c[4] / 2, c[5] / 2, c[2]],
        ]
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
            stable = 2 * k / (-b - root)
            return np.where(b * sheet > 0, stable, (-b + root) / (2 * a))

    return z_at


def _quadric_terms(places: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ten terms of a quadric F (n, 10) at places (n, 3), and their slopes (n, 10) along
    the rays (n, 3)."""
    x, y, z = places.T
    dx, dy, dz = rays.T
    zero = np.zeros_like(x)
    terms = [
        x * x,
        y * y,
        z * z,
        x * y,
        x * z,
        y * z,
        x,
        y,
        z,
        zero + 1.0,
    ]
    slopes = [
        2 * x * dx,
        2 * y * dy,
        2 * z * dz,
        x * dy + y * dx,
        x * dz + z * dx,
        y * dz + z * dy,
        dx,
        dy,
        dz,
        zero,
    ]
    return np.stack(terms, axis=1), np.stack(slopes, axis=1)


def _taubin(terms: np.ndarray, slopes: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the coefficients (10,) with the least sum of F^2 for a given sum of (dF/dray)^2."""
    # the constant term, which has no slope, follows from the other nine
    terms = terms[:, :9]
    slopes = slopes[:, :9]
    means = np.average(terms, axis=0, weights=weights)
    centred = terms - means
    squares = centred.T @ (weights[:, None] * centred)
    sloped = slopes.T @ (weights[:, None] * slopes)
    sloped[np.diag_indices_from(sloped)] += 1e-6 * np.trace(sloped)
    _, eigenvectors = eigh(squares, sloped, subset_by_index=(0, 0))
    algebraic = eigenvectors[:, 0]
    c = np.append(algebraic, -means @ algebraic)
    return np.asarray(c / np.linalg.norm(c))
