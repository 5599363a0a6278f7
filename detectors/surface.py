"""A polynomial surface z(x, y) through a cloud of which some points are damage: the thesis' "robust cubic", and others.

Scaled co-ordinates (x and y to [-1, 1]) and Chebyshev products keep the normal equations well conditioned; the space of
surfaces is that of the plain polynomial. Large clouds are solved on an even sample first and finished on all points.

Not modelled: errors in x and y, correlated noise, several sheets. Damage of one to three sigma bends every point-wise
robust fit by about a third of a sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from detectors import surface_kernels as kernels
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError

SAMPLE_POINTS = 2048
"""First steps are taken on about this many points, evenly strided: their solution is off by a few standard errors."""
BISQUARE_TUNING = 4.685
"""95 % efficiency for Gaussian noise; MATLAB's default."""
LTS_SAMPLE, LTS_SMALL, LTS_STARTS, LTS_KEPT = 8192, 600, 500, 10
"""FAST-LTS: points in the large and in the first sample, elemental starts, and starts carried to the end.

With 35 % damage a start of 10 points is clean with probability 0.65^10 = 1.3 %, so 500 starts miss with 0.1 %."""
LTS_COVERAGE = 0.55
"""Fraction of points that the fit must explain: up to 45 % damage is survived."""
SEED = 20201102
"""Seed of the elemental starts: fixed, so that the same cloud gives the same surface."""
LAR_SAMPLE, LAR_THINNING = 2048, 12
"""Points below which LAR starts from least squares, and the thinning that gives the start above it."""
BISQUARE_CONVERGED = 1e-2
"""Stop when no point of the surface moves by more than this part of a standard error of the fit."""
GAP_CONVERGED = 1e-6
"""LAR stops when the duality gap puts its sum of |r| within this part of the least possible."""
TINY_M = 1e-9
"""Residuals below a nanometre are rounding of the arithmetic."""


class SurfaceConfig(Config):
    """``shape``: ``polynomial`` of the stated degree; ``auto``: the simplest of plane, polynomials, quadric and free
    form that the cloud's own evidence asks for (`detectors.background`), whatever ``degree`` says; ``free_form``: that
    in any case. ``scale_mm``: the width above which a free form follows the cloud; chosen where none is given.

    ``degree``: total degree; 3 has the 10 terms of MATLAB's poly33. ``method``: ``lar`` least absolute residuals;
    ``bisquare`` Tukey's, from a least-squares start (MATLAB's semantics); ``lts`` a FAST-LTS start, then bisquare: the
    one that survives contiguous damage of a third of the surface; ``least_squares``. ``drop_cross_terms``: no term in
    both x and y (the thesis' script sets p11, p21, p12 to zero)."""

    shape: Literal["polynomial", "auto", "free_form"] = "polynomial"
    scale_mm: float | None = Field(default=None, gt=0)
    degree: int = Field(default=3, ge=0, le=8)
    method: Literal["lar", "bisquare", "lts", "least_squares"] = "lar"
    drop_cross_terms: bool = False


@dataclass(frozen=True)
class Scaling:
    """Map of x and y, each between its extremes, to [-1, 1]."""

    x_middle_m: float
    x_half_m: float
    y_middle_m: float
    y_half_m: float

    @classmethod
    def of(cls, x_m: np.ndarray, y_m: np.ndarray) -> Scaling:
        """Return the map for places of which no two need differ."""
        (x0, x1), (y0, y1) = (x_m.min(), x_m.max()), (y_m.min(), y_m.max())
        return cls((x0 + x1) / 2, max((x1 - x0) / 2, TINY_M), (y0 + y1) / 2, max((y1 - y0) / 2, TINY_M))

    def __call__(self, x_m: np.ndarray, y_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return scaled x and y."""
        return (x_m - self.x_middle_m) / self.x_half_m, (y_m - self.y_middle_m) / self.y_half_m


@dataclass(frozen=True)
class Surface:
    """A fitted surface. ``powers`` (p, 2) Chebyshev orders in scaled x and y, ``coefficients`` (p,) metres."""

    coefficients: np.ndarray
    powers: np.ndarray
    scaling: Scaling
    method: str
    iterations: int
    converged: bool
    note: str

    def evaluate(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Return z in metres at x, y of one shape; NaN where they are NaN. Extrapolates as polynomials do: badly."""
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        u, v = self.scaling(x.ravel(), y.ravel())
        return kernels.chebyshev_sum(u, v, self.powers, self.coefficients).reshape(x.shape)


def fit_surface(x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, config: SurfaceConfig) -> Surface:
    """Fit z(x, y) to finite points, each (n,).

    LAR is within 2e-6 of the least sum of absolute residuals (by the duality gap), which moves no point of the surface
    by more than 0.2 sigma sqrt(p / n); bisquare is within 0.05 of that unit of the fixed point of all points.
    Deterministic.

    Raises UserError where there are fewer points than coefficients, or where all points lie on a line.
    """
    # separable polynomials f(x) + g(y) stay separable under scaling of each axis: dropping cross terms here and in
    # metres is the same
    top = range(config.degree + 1)
    pairs = [(i, j) for i in top for j in top if i + j <= config.degree and not (config.drop_cross_terms and i and j)]
    powers = np.array(sorted(pairs, key=lambda p: (p[0] + p[1], -p[0])), dtype=np.int64)
    if len(z_m) < len(powers):
        raise UserError(
            f"{len(z_m)} valid points cannot determine the {len(powers)} coefficients of a surface of degree"
            f" {config.degree}",
            legal=f"at least {len(powers)} points, and many more to be useful",
            fix="widen the crop, lower surface.degree, or check the capture",
        )
    x, y, z = (np.ascontiguousarray(a, dtype=np.float64) for a in (x_m, y_m, z_m))
    scaling = Scaling.of(x, y)
    basis = kernels.chebyshev_basis(*scaling(x, y), powers)
    middle = float(np.median(z[:: max(1, len(z) // SAMPLE_POINTS)]))
    problem = _Problem.of(basis, z - middle)
    if problem is None:
        raise UserError(
            f"the points do not determine a surface of degree {config.degree}: they lie on a line or a curve",
            fix="widen the crop, or lower surface.degree",
        )
    if config.method == "lar":
        solution = _lar(problem)
    elif config.method == "bisquare":
        solution = _bisquare(problem, None, "bisquare from a least-squares start")
    elif config.method == "lts":
        start = _lts_start(problem.sample(LTS_SAMPLE) or problem)
        solution = _bisquare(problem, start, "bisquare from a FAST-LTS start")
    else:
        solution = _SurfaceSolution(problem.least_squares, 1, True, "least squares")
    coefficients = solution.coefficients.copy()
    coefficients[0] += middle
    method, iterations, converged = config.method, solution.iterations, solution.converged
    return Surface(coefficients, powers, scaling, method, iterations, converged, solution.note)


@dataclass(frozen=True)
class _SurfaceSolution:
    coefficients: np.ndarray
    iterations: int
    converged: bool
    note: str


@dataclass(frozen=True)
class _Problem:
    """``basis`` (p, n), ``z`` (n,), the Cholesky factor of the plain Gram matrix, the least-squares solution (p,)."""

    basis: np.ndarray
    z: np.ndarray
    factor: np.ndarray
    least_squares: np.ndarray

    @classmethod
    def of(cls, basis: np.ndarray, z: np.ndarray) -> _Problem | None:
        """None where the points do not determine the coefficients to working precision."""
        found = _weighted(basis, z, np.ones(len(z)))
        return None if found is None else cls(basis, z, *found)

    def sample(self, points: int) -> _Problem | None:
        """Return the problem on about ``points`` of its points; None where it has few or the sample is degenerate."""
        stride = len(self.z) // points
        if stride < 2:
            return None
        return _Problem.of(np.ascontiguousarray(self.basis[:, ::stride]), np.ascontiguousarray(self.z[::stride]))

    def residuals(self, coefficients: np.ndarray) -> np.ndarray:
        """Return z less the surface (n,)."""
        return kernels.residuals(self.basis, self.z, coefficients)


def _weighted(basis: np.ndarray, z: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the Cholesky factor of the weighted Gram matrix and the weighted solution (p,); None where singular."""
    gram, right = kernels.weighted_gram(basis, z, weights)
    factor, regular = kernels.lower_factor(gram)
    return (factor, kernels.solved(factor, right)) if regular else None


# ---------------------------------------------------------------- least absolute residuals


def _lar(problem: _Problem) -> _SurfaceSolution:
    """Find the L1 solution by smoothing (Madsen and Nielsen 1993): Huber's function with a knee that shrinks, by
    Newton.

    The sub-gradient of the smoothed optimum is feasible for the dual linear program, so the gap to the least possible
    sum of |r| is known, not guessed. Most points keep the sign of their residual: they enter as one constant vector,
    and only those near the surface are iterated (Portnoy and Koenker 1997). The start is the solution of every 12th
    point, found the same way.
    """
    terms, n = problem.basis.shape
    sample = problem.sample(max(LAR_SAMPLE, n // LAR_THINNING))
    c, margin, knees = problem.least_squares, np.inf, np.array([1.0, 0.1, 0.03, 0.003, 3e-4, 3e-5, 3e-6])
    if sample is not None:
        c, knees = _lar(sample).coefficients, knees[2:]
        # 5 standard errors of the thinned L1 solution, in units of the median |r|
        margin = 5.0 * 1.25 / 0.6745 * np.sqrt(terms / len(sample.z))
    r = problem.residuals(c)
    scale = max(float(np.median(np.abs(r[:: max(1, len(r) // SAMPLE_POINTS)]))), TINY_M)
    iterations, gap = 0, np.inf
    for knee in scale * knees:
        enough = 0.001 * GAP_CONVERGED * float(np.abs(r).sum())
        reach = max(margin * scale, 10.0 * knee)
        c, r, spent = kernels.lar_stage(problem.basis, problem.z, c, r, reach, knee, enough)
        iterations += spent
        margin = min(margin, 5.0 * knee / scale)
        _, lost, _ = kernels.huber_state(r, knee)
        gap = lost / max(float(np.abs(r).sum()), TINY_M)
        if gap <= GAP_CONVERGED:
            break
    note = f"least absolute residuals, within {min(gap, 1.0):.0e} of the least sum"
    return _SurfaceSolution(c, iterations, gap <= GAP_CONVERGED, note)


# ---------------------------------------------------------------- bisquare


def _bisquare(problem: _Problem, start: np.ndarray | None, note: str) -> _SurfaceSolution:
    """Reweight least squares with MATLAB's robustfit semantics, on a sample first, then on all points; from the
    least-squares solution where no ``start`` is given."""
    sample = problem.sample(SAMPLE_POINTS)
    if sample is None:
        return _reweighted(problem, problem.least_squares if start is None else start, 50, note)
    inner = _reweighted(sample, sample.least_squares if start is None else start, 50, note)
    full = _reweighted(problem, inner.coefficients, 8, note)
    return _SurfaceSolution(full.coefficients, inner.iterations + full.iterations, full.converged, note)


def _reweighted(problem: _Problem, start: np.ndarray, steps: int, note: str) -> _SurfaceSolution:
    inverse = np.linalg.inv(problem.factor)
    leverage = np.minimum(kernels.leverages(problem.basis, inverse), 0.9999)
    adjust = 1.0 / np.sqrt(1.0 - leverage)
    c, terms = start, len(start)
    for step in range(1, steps + 1):
        adjusted = problem.residuals(c) * adjust
        # MATLAB's robust sigma: median of |r| without as many of the smallest as there are terms, over 0.6745
        sizes = np.abs(adjusted)
        place = min(terms - 1 + (len(sizes) - terms + 1) // 2, len(sizes) - 1)
        scale = max(float(np.partition(sizes, place)[place]) / 0.6745, TINY_M)
        found = _weighted(problem.basis, problem.z, kernels.bisquare_weights(adjusted, BISQUARE_TUNING * scale))
        if found is None:
            return _SurfaceSolution(c, step, False, note + "; stopped: too few points kept weight")
        factor, new = found
        # norm of the move in standard errors of the fit: factor' (new - c) has unit covariance times scale^2
        moved = float(np.linalg.norm(factor.T @ (new - c))) / scale
        c = new
        if moved < BISQUARE_CONVERGED * np.sqrt(terms):
            return _SurfaceSolution(c, step, True, note)
    return _SurfaceSolution(c, steps, False, note)


# ---------------------------------------------------------------- least trimmed squares


def _lts_start(problem: _Problem) -> np.ndarray:
    """Return FAST-LTS's coefficients (p,) (Rousseeuw and Van Driessen 2006): concentration steps from elemental starts
    on few points, the best of them carried on to all."""
    random = np.random.default_rng(SEED)
    terms, n = problem.basis.shape
    small = problem.sample(LTS_SMALL) or problem
    points = len(small.z)
    picks = np.argsort(random.random((LTS_STARTS, points)), axis=1)[:, :terms]
    kept, ridge = _kept(points, terms), 1e-12 * np.eye(terms)
    c = np.linalg.solve(small.basis.T[picks] + ridge, small.z[picks][..., None])[..., 0]
    for _ in range(2):
        squares = (small.z - c @ small.basis) ** 2
        chosen = squares <= np.partition(squares, kept - 1, axis=1)[:, kept - 1 : kept]
        weighted = chosen[:, None, :] * small.basis
        gram, right = weighted @ small.basis.T + points * ridge, weighted @ small.z
        c = np.linalg.solve(gram, right[..., None])[..., 0]
    sums = np.partition((small.z - c @ small.basis) ** 2, kept - 1, axis=1)[:, :kept].sum(axis=1)
    finalists = [_concentrate(problem, c[i], _kept(n, terms)) for i in np.argsort(sums, kind="stable")[:LTS_KEPT]]
    return min(finalists, key=lambda finalist: finalist[1])[0]


def _kept(points: int, terms: int) -> int:
    return min(points, max(int(LTS_COVERAGE * points), (points + terms + 1) // 2))


def _concentrate(problem: _Problem, c: np.ndarray, kept: int) -> tuple[np.ndarray, float]:
    """Take concentration steps until the sum of the ``kept`` smallest squares stays: (coefficients, sum)."""
    best = np.inf
    for _ in range(30):
        squares = problem.residuals(c) ** 2
        chosen = squares <= np.partition(squares, kept - 1)[kept - 1]
        total = float(squares[chosen].sum())
        if total >= best * (1.0 - 1e-9):
            break
        best = total
        found = _weighted(problem.basis, problem.z, chosen.astype(np.float64))
        if found is None:
            break
        c = found[1]
    return c, best
