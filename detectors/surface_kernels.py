"""Compiled inner loops of the surface fit: basis functions, weighted Gram matrices, weights.

Blocked over points so that a block of all basis functions stays in the first-level cache; one core.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

BLOCK = 256
FAST: dict[str, Any] = {"cache": True, "nogil": True, "fastmath": {"contract", "reassoc", "nsz"}}


@numba.njit(cache=True, nogil=True)
def columns_at(points: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and z, each (n,), of points (h, w, 3) where the mask (h, w) is true, in its order."""
    n = mask.sum()
    x, y, z = np.empty(n), np.empty(n), np.empty(n)
    i = 0
    for r in range(mask.shape[0]):
        for c in range(mask.shape[1]):
            if mask[r, c]:
                x[i], y[i], z[i] = points[r, c, 0], points[r, c, 1], points[r, c, 2]
                i += 1
    return x, y, z


@numba.njit(**FAST)
def chebyshev_basis(u: np.ndarray, v: np.ndarray, powers: np.ndarray) -> np.ndarray:
    """(p, n) products T_a(u) T_b(v) of Chebyshev polynomials for each row (a, b) of ``powers`` (p, 2)."""
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
    """(n,) coefficients times `chebyshev_basis`, without storing the basis."""
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
    """(B W B', B W z) of a basis (p, n), values (n,) and weights (n,)."""
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
    """(n,) z less the surface."""
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
    """(n,) diagonal of the hat matrix, b' (B B')^-1 b, from L^-1 of B B' = L L'."""
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
    """Tukey's weights (1 - (r / limit)^2)^2 inside the limit, 0 outside."""
    w = np.empty(len(r))
    for i in range(len(r)):
        u = r[i] / limit
        g = 1.0 - u * u
        w[i] = g * g if g > 0.0 else 0.0
    return w


@numba.njit(**FAST)
def huber_state(r: np.ndarray, eps: float) -> tuple[float, float, int]:
    """Smoothed L1 (Huber with knee eps), the duality gap of its sub-gradient, and the count inside the knee."""
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
    """(p,) B s with s = sign(r) where |r| exceeds the floor and r / floor inside it."""
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
    """Points near the surface, |r| < margin, and the pull of the others.

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
    """Whether a point outside the margin before has crossed the surface, or come within the knee of it."""
    for i in range(len(before)):
        if abs(before[i]) >= margin and (before[i] * after[i] <= 0.0 or abs(after[i]) < knee):
            return True
    return False


@numba.njit(cache=True, nogil=True)
def lts_starts(
    basis: np.ndarray, z: np.ndarray, picks: np.ndarray, kept: int, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Concentration steps from elemental starts: (s, p) coefficients and (s,) sums of the ``kept`` smallest squares.

    ``picks`` (s, p) are the points of each start. A start whose points are degenerate gets an infinite sum.
    """
    starts, terms = picks.shape
    solutions = np.zeros((starts, terms))
    sums = np.full(starts, np.inf)
    n = len(z)
    for s in range(starts):
        square = np.empty((terms, terms))
        right = np.empty(terms)
        for a in range(terms):
            for b in range(terms):
                square[a, b] = basis[b, picks[s, a]]
            right[a] = z[picks[s, a]]
        for a in range(terms):
            square[a, a] += 1e-12
        c = np.linalg.solve(square, right)
        for _ in range(steps):
            squares = residuals(basis, z, c) ** 2
            limit = np.partition(squares, kept - 1)[kept - 1]
            weights = np.empty(n)
            for i in range(n):
                weights[i] = 1.0 if squares[i] <= limit else 0.0
            gram, moments = weighted_gram(basis, z, weights)
            for a in range(terms):
                gram[a, a] += 1e-12 * n
            c = np.linalg.solve(gram, moments)
        squares = residuals(basis, z, c) ** 2
        solutions[s] = c
        sums[s] = np.partition(squares, kept - 1)[:kept].sum()
    return solutions, sums
