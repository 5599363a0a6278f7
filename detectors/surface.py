"""A polynomial surface z(x, y) through a cloud of which some points are damage: the thesis' "robust cubic", and others.

Scaled co-ordinates (x and y to [-1, 1]) and Chebyshev products keep the normal equations well conditioned; the space of
surfaces is that of the plain polynomial. Large clouds are solved on an even sample first and finished on all points.

Not modelled: errors in x and y, correlated noise, several sheets. Damage of one to three sigma bends every point-wise
robust fit by about a third of a sigma.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field

from detectors import surface_kernels as kernels
from detectors.lar_kernels import lar_stage, lower_factor
from detectors.triangular import solved
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
"""Of the elemental starts: fixed, so that the same cloud gives the same surface."""
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
class Surface:
    """A fitted surface. ``powers`` (p, 2) Chebyshev orders in scaled x and y, ``coefficients`` (p,) metres."""

    coefficients: np.ndarray
    powers: np.ndarray
    x_middle_m: float
    x_half_m: float
    y_middle_m: float
    y_half_m: float
    method: str
    iterations: int
    converged: bool
    note: str

    def evaluate(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """z in metres at x, y of any equal shape; NaN where they are NaN. Extrapolates as polynomials do: badly."""
        x, y = np.broadcast_arrays(np.asarray(x_m, dtype=np.float64), np.asarray(y_m, dtype=np.float64))
        u, v = _scaled(x.ravel(), y.ravel(), self)
        return kernels.chebyshev_sum(u, v, self.powers, self.coefficients).reshape(x.shape)


def fit_surface(x_m: np.ndarray, y_m: np.ndarray, z_m: np.ndarray, config: SurfaceConfig) -> Surface:
    """Fit z(x, y) to finite points, each (n,).

    LAR is within 2e-6 of the least sum of absolute residuals (by the duality gap), which moves no point of the surface
    by more than 0.2 sigma sqrt(p / n); bisquare is within 0.05 of that unit of the fixed point of all points.
    Deterministic.

    Raises UserError where there are fewer points than coefficients, or where all points lie on a line.
    """
    powers = _powers(config)
    _check_points(len(z_m), len(powers), config)
    x, y, z = (np.ascontiguousarray(a, dtype=np.float64) for a in (x_m, y_m, z_m))
    blank = _blank_surface(x, y, powers, config)
    basis = kernels.chebyshev_basis(*_scaled(x, y, blank), powers)
    middle = float(np.median(z[:: max(1, len(z) // SAMPLE_POINTS)]))
    problem = _Problem.of(basis, z - middle, config)
    solve = {"least_squares": _least_squares, "lar": _lar, "bisquare": _bisquare, "lts": _lts_bisquare}[config.method]
    solution = solve(problem)
    coefficients = solution.coefficients.copy()
    coefficients[0] += middle
    return replace(
        blank,
        coefficients=coefficients,
        iterations=solution.iterations,
        converged=solution.converged,
        note=solution.note,
    )


def _powers(config: SurfaceConfig) -> np.ndarray:
    """(p, 2) orders (i, j) with i + j <= degree; only those with i = 0 or j = 0 where cross terms are dropped.

    The separable polynomials f(x) + g(y) stay separable under scaling of each axis, so dropping the terms here and in
    metres is the same.
    """
    top = range(config.degree + 1)
    pairs = [(i, j) for i in top for j in top if i + j <= config.degree and not (config.drop_cross_terms and i and j)]
    return np.array(sorted(pairs, key=lambda p: (p[0] + p[1], -p[0])), dtype=np.int64)


def _check_points(points: int, terms: int, config: SurfaceConfig) -> None:
    if points < terms:
        raise UserError(
            f"{points} valid points cannot determine the {terms} coefficients of a surface of degree {config.degree}",
            legal=f"at least {terms} points, and many more to be useful",
            fix="widen the crop, lower surface.degree, or check the capture",
        )


def _blank_surface(x: np.ndarray, y: np.ndarray, powers: np.ndarray, config: SurfaceConfig) -> Surface:
    (x0, x1), (y0, y1) = (x.min(), x.max()), (y.min(), y.max())
    halves = (max((x1 - x0) / 2, TINY_M), max((y1 - y0) / 2, TINY_M))
    return Surface(
        np.zeros(len(powers)), powers, (x0 + x1) / 2, halves[0], (y0 + y1) / 2, halves[1], config.method, 0, False, ""
    )


def _scaled(x: np.ndarray, y: np.ndarray, surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    return (x - surface.x_middle_m) / surface.x_half_m, (y - surface.y_middle_m) / surface.y_half_m


@dataclass(frozen=True)
class _Solution:
    coefficients: np.ndarray
    iterations: int
    converged: bool
    note: str


@dataclass(frozen=True)
class _Problem:
    """``basis`` (p, n), ``z`` (n,), the plain Gram matrix and its Cholesky factor."""

    basis: np.ndarray
    z: np.ndarray
    gram: np.ndarray
    right: np.ndarray
    factor: np.ndarray

    @classmethod
    def of(cls, basis: np.ndarray, z: np.ndarray, config: SurfaceConfig) -> _Problem:
        gram, right = kernels.weighted_gram(basis, z, np.ones(len(z)))
        factor = _cholesky(gram)
        if factor is None:
            raise UserError(
                f"the points do not determine a surface of degree {config.degree}: they lie on a line or a curve",
                fix="widen the crop, or lower surface.degree",
            )
        return cls(basis, z, gram, right, factor)

    def sample(self, points: int) -> _Problem | None:
        """The same problem on about ``points`` of its points; None where it has few or the sample is degenerate."""
        stride = len(self.z) // points
        if stride < 2:
            return None
        basis, z = np.ascontiguousarray(self.basis[:, ::stride]), np.ascontiguousarray(self.z[::stride])
        gram, right = kernels.weighted_gram(basis, z, np.ones(len(z)))
        factor = _cholesky(gram)
        return None if factor is None else _Problem(basis, z, gram, right, factor)

    def residuals(self, coefficients: np.ndarray) -> np.ndarray:
        return kernels.residuals(self.basis, self.z, coefficients)


def _cholesky(gram: np.ndarray) -> np.ndarray | None:
    """Lower factor, None where the matrix is singular to working precision."""
    factor, regular = lower_factor(gram)
    return factor if regular else None


def _least_squares(problem: _Problem) -> _Solution:
    return _Solution(solved(problem.factor, problem.right), 1, True, "least squares")


# ---------------------------------------------------------------- least absolute residuals


def _lar(problem: _Problem) -> _Solution:
    """The L1 solution by smoothing (Madsen and Nielsen 1993): Huber's function with a knee that shrinks, by Newton.

    The sub-gradient of the smoothed optimum is feasible for the dual linear program, so the gap to the least possible
    sum of |r| is known, not guessed. Most points keep the sign of their residual: they enter as one constant vector,
    and only those near the surface are iterated (Portnoy and Koenker 1997). The start is the solution of every 12th
    point, found the same way.
    """
    terms, n = problem.basis.shape
    sample = problem.sample(max(LAR_SAMPLE, n // LAR_THINNING))
    if sample is None:
        c = _least_squares(problem).coefficients
        margin = np.inf
    else:
        c = _lar(sample).coefficients
        # 5 standard errors of the thinned L1 solution, in units of the median |r|
        margin = 5.0 * 1.25 / 0.6745 * np.sqrt(terms / len(sample.z))
    r = problem.residuals(c)
    scale = max(_median_size(r), TINY_M)
    iterations, gap = 0, np.inf
    for knee in scale * np.array([1.0, 0.1, 0.03, 0.003, 3e-4, 3e-5, 3e-6])[0 if sample is None else 2 :]:
        enough = 0.001 * GAP_CONVERGED * float(np.abs(r).sum())
        c, r, spent = lar_stage(problem.basis, problem.z, c, r, max(margin * scale, 10.0 * knee), knee, enough)
        iterations += spent
        margin = min(margin, 5.0 * knee / scale)
        _, lost, _ = kernels.huber_state(r, knee)
        gap = lost / max(float(np.abs(r).sum()), TINY_M)
        if gap <= GAP_CONVERGED:
            break
    note = f"least absolute residuals, within {min(gap, 1.0):.0e} of the least sum"
    return _Solution(c, iterations, gap <= GAP_CONVERGED, note)


def _median_size(r: np.ndarray) -> float:
    return float(np.median(np.abs(r[:: max(1, len(r) // SAMPLE_POINTS)])))


# ---------------------------------------------------------------- bisquare


def _bisquare(problem: _Problem) -> _Solution:
    return _bisquare_from(problem, None, "bisquare from a least-squares start")


def _bisquare_from(problem: _Problem, start: np.ndarray | None, note: str) -> _Solution:
    """Iteratively reweighted least squares with MATLAB's robustfit semantics, on a sample first, then on all points."""
    sample = problem.sample(SAMPLE_POINTS)
    if start is None:
        start = _least_squares(problem if sample is None else sample).coefficients
    coarse = 0
    if sample is not None:
        inner = _reweighted(sample, start, 50, note)
        start, coarse = inner.coefficients, inner.iterations
    full = _reweighted(problem, start, 50 if sample is None else 8, note)
    return _Solution(full.coefficients, coarse + full.iterations, full.converged, note)


def _reweighted(problem: _Problem, start: np.ndarray, steps: int, note: str) -> _Solution:
    inverse = np.linalg.inv(problem.factor)
    leverage = np.minimum(kernels.leverages(problem.basis, inverse), 0.9999)
    adjust = 1.0 / np.sqrt(1.0 - leverage)
    c = start
    for step in range(1, steps + 1):
        adjusted = problem.residuals(c) * adjust
        scale = _mad_scale(adjusted, len(c))
        weights = kernels.bisquare_weights(adjusted, BISQUARE_TUNING * scale)
        gram, right = kernels.weighted_gram(problem.basis, problem.z, weights)
        factor = _cholesky(gram)
        if factor is None:
            return _Solution(c, step, False, note + "; stopped: too few points kept weight")
        new = solved(factor, right)
        # norm of the move in standard errors of the fit: factor' (new - c) has unit covariance times scale^2
        moved = float(np.linalg.norm(factor.T @ (new - c))) / scale
        c = new
        if moved < BISQUARE_CONVERGED * np.sqrt(len(c)):
            return _Solution(c, step, True, note)
    return _Solution(c, steps, False, note)


def _mad_scale(r: np.ndarray, terms: int) -> float:
    """MATLAB's robust sigma: median of |r| without the ``terms`` smallest, over 0.6745."""
    sizes = np.abs(r)
    position = terms - 1 + (len(sizes) - terms + 1) // 2
    return max(
        float(np.partition(sizes, min(position, len(sizes) - 1))[min(position, len(sizes) - 1)]) / 0.6745, TINY_M
    )


# ---------------------------------------------------------------- least trimmed squares


def _lts_bisquare(problem: _Problem) -> _Solution:
    """Bisquare from a FAST-LTS start (Rousseeuw and Van Driessen 2006)."""
    start = _lts_start(problem.sample(LTS_SAMPLE) or problem)
    return _bisquare_from(problem, start, "bisquare from a FAST-LTS start")


def _lts_start(problem: _Problem) -> np.ndarray:
    random = np.random.default_rng(SEED)
    terms, n = problem.basis.shape
    small = problem.sample(LTS_SMALL) or problem
    picks = np.argsort(random.random((LTS_STARTS, len(small.z))), axis=1)[:, :terms]
    solutions, sums = kernels.lts_starts(small.basis, small.z, picks, _kept(len(small.z), terms), 2)
    best = np.argsort(sums, kind="stable")[:LTS_KEPT]
    finalists = [_concentrate(problem, solutions[i], _kept(n, terms)) for i in best]
    return min(finalists, key=lambda finalist: finalist[1])[0]


def _kept(points: int, terms: int) -> int:
    return min(points, max(int(LTS_COVERAGE * points), (points + terms + 1) // 2))


def _concentrate(problem: _Problem, c: np.ndarray, kept: int) -> tuple[np.ndarray, float]:
    """Concentration steps until the sum of the ``kept`` smallest squares stays: (coefficients, sum)."""
    best = np.inf
    for _ in range(30):
        squares = problem.residuals(c) ** 2
        limit = np.partition(squares, kept - 1)[kept - 1]
        chosen = squares <= limit
        total = float(squares[chosen].sum())
        if total >= best * (1.0 - 1e-9):
            break
        best = total
        gram, right = kernels.weighted_gram(problem.basis, problem.z, chosen.astype(np.float64))
        factor = _cholesky(gram)
        if factor is None:
            break
        c = solved(factor, right)
    return c, best
