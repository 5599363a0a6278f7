"""Compiled inner loops of the surface fit: basis functions, weighted Gram matrices, weights, and the descent of the
least-absolute-residuals fit: Huber's function at one knee, by Newton's method (`detectors.surface` says why that ends
at the L1 solution).

Blocked over points so that a block of all basis functions stays in the first-level cache; one core.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

BLOCK = 256
FAST: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "reassoc", "nsz"}}
PLAIN: dict[str, Any] = {"cache": True, "nogil": True}
LAR_STEPS = 60
HALVINGS = 12


@numba.njit(**FAST)
def chebyshev_basis(u: np.ndarray, v: np.ndarray, powers: np.ndarray) -> np.ndarray:
    """Return the products (p, n) T_a(u) T_b(v) of Chebyshev polynomials for each row (a, b) of ``powers`` (p, 2)."""
    terms, n = len(powers), len(u)
    top = powers.max() + 1
    basis = np.empty((terms, n))
    tu = np.empty((top, BLOCK))
    tv = np.empty((top, BLOCK))
    for start in range(0, n, BLOCK):
        m = min(BLOCK, n - start)
        for i in range(m):
            tu[0, i] = 1.0
            tv[0, i] = 1.0
        if top > 1:
            for i in range(m):
                tu[1, i] = u[start + i]
                tv[1, i] = v[start + i]
        for k in range(2, top):
            for i in range(m):
                tu[k, i] = 2.0 * u[start + i] * tu[k - 1, i] - tu[k - 2, i]
                tv[k, i] = 2.0 * v[start + i] * tv[k - 1, i] - tv[k - 2, i]
        for t in range(terms):
            a = powers[t, 0]
            b = powers[t, 1]
            for i in range(m):
                basis[t, start + i] = tu[a, i] * tv[b, i]
    return basis


@numba.njit(**FAST)
def chebyshev_sum(u: np.ndarray, v: np.ndarray, powers: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return the coefficients times `chebyshev_basis`, (n,), without storing the basis."""
    n = len(u)
    values = np.empty(n)
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        block = chebyshev_basis(u[start:stop], v[start:stop], powers)
        values[start:stop] = 0.0
        for t in range(len(coefficients)):
            c = coefficients[t]
            for i in range(start, stop):
                values[i] += c * block[t, i - start]
    return values


@numba.njit(**FAST)
def weighted_gram(basis: np.ndarray, z: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (B W B', B W z) of a basis (p, n), values (n,) and weights (n,)."""
    terms, n = basis.shape
    gram = np.zeros((terms, terms))
    right = np.zeros(terms)
    weighted = np.empty(BLOCK)
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        zs = z[start:stop]
        ws = weights[start:stop]
        for a in range(terms):
            row = basis[a, start:stop]
            sum_z = 0.0
            for i in range(stop - start):
                weighted[i] = row[i] * ws[i]
                sum_z += weighted[i] * zs[i]
            right[a] += sum_z
            for b in range(a + 1):
                other = basis[b, start:stop]
                total = 0.0
                for i in range(stop - start):
                    total += weighted[i] * other[i]
                gram[a, b] += total
    for a in range(terms):
        for b in range(a):
            gram[b, a] = gram[a, b]
    return gram, right


@numba.njit(**FAST)
def residuals(basis: np.ndarray, z: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return z less the surface (n,)."""
    terms, n = basis.shape
    r = np.empty(n)
    for start in range(0, n, BLOCK):
        stop = min(start + BLOCK, n)
        for i in range(start, stop):
            r[i] = z[i]
        for t in range(terms):
            c = coefficients[t]
            row = basis[t]
            for i in range(start, stop):
                r[i] -= c * row[i]
    return r


@numba.njit(**FAST)
def leverages(basis: np.ndarray, inverse_factor: np.ndarray) -> np.ndarray:
    """Return the diagonal (n,) of the hat matrix, b' (B B')^-1 b, from L^-1 of B B' = L L'."""
    terms, n = basis.shape
    h = np.zeros(n)
    row = np.empty(BLOCK)
    for start in range(0, n, BLOCK):
        m = min(BLOCK, n - start)
        for a in range(terms):
            row[:m] = 0.0
            for b in range(a + 1):
                c = inverse_factor[a, b]
                for i in range(m):
                    row[i] += c * basis[b, start + i]
            for i in range(m):
                h[start + i] += row[i] * row[i]
    return h


@numba.njit(**FAST)
def bisquare_weights(r: np.ndarray, limit: float) -> np.ndarray:
    """Return Tukey's weights (1 - (r / limit)^2)^2 inside the limit, 0 outside."""
    w = np.empty(len(r))
    for i in range(len(r)):
        u = r[i] / limit
        g = 1.0 - u * u
        w[i] = g * g if g > 0.0 else 0.0
    return w


@numba.njit(**FAST)
def huber_state(r: np.ndarray, eps: float) -> tuple[float, float, int]:
    """Return the smoothed L1 (Huber, knee eps), the duality gap of its sub-gradient, and the count inside the knee."""
    smooth = 0.0
    gap = 0.0
    inside = 0
    half = 0.5 * eps
    for i in range(len(r)):
        a = abs(r[i])
        if a > eps:
            smooth += a - half
        else:
            smooth += 0.5 * r[i] * r[i] / eps
            gap += a - r[i] * r[i] / eps
            inside += 1
    return smooth, gap, inside


@numba.njit(**FAST)
def signed_sum(basis: np.ndarray, r: np.ndarray, floor: float) -> np.ndarray:
    """Return B s (p,) with s = sign(r) where |r| exceeds the floor and r / floor inside it."""
    terms, n = basis.shape
    s = np.empty(BLOCK)
    total = np.zeros(terms)
    for start in range(0, n, BLOCK):
        m = min(BLOCK, n - start)
        for i in range(m):
            s[i] = max(-1.0, min(1.0, r[start + i] / floor))
        for t in range(terms):
            row = basis[t, start : start + m]
            part = 0.0
            for i in range(m):
                part += row[i] * s[i]
            total[t] += part
    return total


@numba.njit(**FAST)
def split(basis: np.ndarray, r: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split the points into those near the surface, |r| < margin, and the pull of the others.

    Returns the near points' indices (m,), their basis (p, m) and the sum of basis * sign(r) over the far points (p,).
    """
    terms, n = basis.shape
    near = np.empty(n, dtype=np.int64)
    sign = np.empty(n)
    m = 0
    for i in range(n):
        if abs(r[i]) < margin:
            near[m] = i
            m += 1
            sign[i] = 0.0
        else:
            sign[i] = 1.0 if r[i] > 0.0 else -1.0
    pull = np.zeros(terms)
    chosen = np.empty((terms, m))
    for t in range(terms):
        row = basis[t]
        total = 0.0
        for i in range(n):
            total += row[i] * sign[i]
        pull[t] = total
        for k in range(m):
            chosen[t, k] = row[near[k]]
    return near[:m], chosen, pull


@numba.njit(**FAST)
def sides_changed(before: np.ndarray, after: np.ndarray, margin: float, knee: float) -> bool:
    """Return whether a point outside the margin before has crossed the surface, or come within the knee of it."""
    for i in range(len(before)):
        if abs(before[i]) >= margin and (before[i] * after[i] <= 0.0 or abs(after[i]) < knee):
            return True
    return False


@numba.njit(**PLAIN)
def lower_factor(gram: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return Cholesky's factor (p, p) of a symmetric matrix, and whether it is regular to working precision."""
    n = len(gram)
    factor = np.zeros((n, n))
    least, most = np.inf, 0.0
    for a in range(n):
        for b in range(a + 1):
            total = gram[a, b]
            for k in range(b):
                total -= factor[a, k] * factor[b, k]
            if b < a:
                factor[a, b] = total / factor[b, b]
            elif total > 0.0:
                factor[a, a] = np.sqrt(total)
                least, most = min(least, factor[a, a]), max(most, factor[a, a])
            else:
                return factor, False
    return factor, least > 1e-7 * most


@numba.njit(**PLAIN)
def solved(factor: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return x (p,) of L L' x = right; ``factor`` (p, p) is the lower triangle L. A library's call takes longer than a
    system of ten unknowns."""
    x = right.copy()
    for a in range(len(x)):
        for k in range(a):
            x[a] -= factor[a, k] * x[k]
        x[a] /= factor[a, a]
    for a in range(len(x) - 1, -1, -1):
        for k in range(a + 1, len(x)):
            x[a] -= factor[k, a] * x[k]
        x[a] /= factor[a, a]
    return x


@numba.njit(**PLAIN)
def _smoothed_descent(
    basis: np.ndarray, z: np.ndarray, fixed_pull: np.ndarray, start: np.ndarray, knee: float, enough: float
) -> tuple[np.ndarray, int]:
    """Minimise sum huber(r, knee) - c' fixed_pull: Newton, or where it fails a majorising step, which always descends:
    (c, steps).

    ``basis`` (p, n), ``z`` (n,), ``fixed_pull``, ``start`` (p,). Stops where a step promises or brings less than
    ``enough``.
    """
    c = start
    r = residuals(basis, z, c)
    value = huber_state(r, knee)[0] - np.sum(c * fixed_pull)
    weights = np.empty(len(r))
    for steps in range(1, LAR_STEPS + 1):
        pull = signed_sum(basis, r, knee) + fixed_pull
        for i in range(len(r)):
            weights[i] = 1.0 if abs(r[i]) <= knee else 0.0
        factor, regular = lower_factor(weighted_gram(basis, r, weights)[0] / knee)
        lower = False
        for majorising in (False, True):
            if not majorising and regular:
                step = solved(factor, pull)
                if np.sum(step * pull) < enough:
                    return c, steps
            elif majorising:
                # reweighted least squares: each |r| beyond the knee under its tangent parabola
                for i in range(len(r)):
                    weights[i] = 1.0 / max(abs(r[i]), knee)
                step = np.linalg.lstsq(weighted_gram(basis, r, weights)[0], pull, 1e-12)[0]
            else:
                continue
            # the first of the full, half, quarter ... step that lowers the value
            for halvings in range(HALVINGS):
                trial = c + step * 0.5**halvings
                r_trial = residuals(basis, z, trial)
                new = huber_state(r_trial, knee)[0] - np.sum(trial * fixed_pull)
                lower = new < value
                if lower:
                    break
            if lower:
                break
        if not lower or value - new < enough:
            return c, steps
        c, r, value = trial, r_trial, new
    return c, LAR_STEPS


@numba.njit(**PLAIN)
def lar_stage(
    basis: np.ndarray,
    z: np.ndarray,
    start: np.ndarray,
    r_start: np.ndarray,
    margin: float,
    knee: float,
    enough: float,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the optimum at one knee: (coefficients (p,), residuals (n,), steps). Only points within the margin of the
    start are iterated, the others pull as they did; the margin widens until no far point changes sides."""
    steps = 0
    while True:
        near, part, far_pull = split(basis, r_start, margin)
        c, spent = _smoothed_descent(part, z[near], far_pull, start, knee, enough)
        r = residuals(basis, z, c)
        steps += spent
        if not sides_changed(r_start, r, margin, knee):
            return c, r, steps
        margin *= 3.0
