"""Which pixels have a range in every frame, which in none, and which of them to simulate one by one.

Each gate's quantity has a mean and a deviation to first order in the noise (`scenes.sensor.amcw.linear`); a pixel whose
quantities all keep `DEVIATIONS` from their limits is sure. Where the noise is too much for that, only bounds that hold
at any noise count: of the edge sum, and of a dim pixel's amplitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.filtered import DEVIATIONS, Filtered
from scenes.sensor.amcw.unwrap import Lattice

f4 = np.float32
MOST_LEFT_OUT = 0.025
"""Share of the variance that is not of first order, above which a pixel is simulated frame by frame: up to it (phase
noise of 0.13 rad on a face) the variance is right to 1 %, at half the noise to 0.2 %."""
STEP_M = 1e-3
"""Displacement of half a path by which that of z is found."""
MOST_TURNED, MOST_SPREAD = 1e3, 1e9
"""What stands for an unknown deviation: of a phase in radians, of an amplitude in units."""


@dataclass(frozen=True)
class Mean:
    """Of each pixel, (n,) float64: ``z_m`` without rounding and by how much a metre of half path moves it;
    ``deviation_m``, of one frame's; ``amplitude``, mean over frequencies, and its deviation; ``reason`` uint8."""

    z_m: np.ndarray
    z_by_path: np.ndarray
    deviation_m: np.ndarray
    amplitude: np.ndarray
    amplitude_deviation: np.ndarray
    reason: np.ndarray


@dataclass(frozen=True)
class Certainty:
    """(n,) bool each: ``always`` a range, to first order in the noise; ``never`` one; ``mean`` of either kind."""

    mean: Mean
    always: np.ndarray
    never: np.ndarray


@dataclass(frozen=True)
class Engine:
    """What decides after the filter, as `ranging.range_and_gates` takes it; ``flying`` None where there is none."""

    geometry: np.ndarray
    outside_mask: np.ndarray
    lattice: Lattice
    gates: ranging.Gates
    flying: ranging.FlyingGate | None


def certainty(
    filtered: Filtered, engine: Engine, lost: np.ndarray, shape: tuple[int, int], farthest_error_m: float
) -> Certainty:
    """Sort the pixels of a view of ``shape``; ``farthest_error_m``: what frames are displaced by at most."""
    ours = _Limits(filtered, engine, lost, farthest_error_m)
    known = np.asarray((filtered.left_out <= MOST_LEFT_OUT).all(axis=0))
    unmeasured = np.asarray(engine.outside_mask | lost | ours.edge_fails | ours.dim | (known & ours.fails))
    never = unmeasured | (known & ours.unwraps & ours.fails_at_range)
    always = known & ours.passes & ~never
    if engine.flying is not None:
        undecided = _may_fly(ours.mean, engine.flying, filtered, known, unmeasured, shape)
        always &= ~undecided
    return Certainty(ours.mean, always, never)


class _Limits:
    """What each gate says of each pixel, with how much certainty; arrays (n,)."""

    def __init__(self, filtered: Filtered, engine: Engine, lost: np.ndarray, farthest_error_m: float) -> None:
        gates, lattice = engine.gates, engine.lattice
        turns = np.minimum(filtered.turned, MOST_TURNED) / (2 * np.pi)
        spread = np.minimum(filtered.spread, MOST_SPREAD)
        low, high = filtered.amplitude - DEVIATIONS * spread, filtered.amplitude + DEVIATIONS * spread
        both = DEVIATIONS * np.sqrt((spread**2).sum(axis=0))
        total = filtered.amplitude.sum(axis=0)
        self.mean = _mean(filtered, engine, turns, lost)
        residual, margin, known = _residual(filtered, lattice, turns)
        reach = DEVIATIONS * turns.max(axis=0)
        least = 1 - float(gates.ratio)
        slack_m = DEVIATIONS * self.mean.deviation_m + farthest_error_m
        far_m = self.mean.z_m if gates.axial > 0 else self.mean.z_m / engine.geometry[2]
        reflected = np.sqrt(float(gates.reflectivity) / np.maximum(np.array([total - both, total + both]), 1e-9))
        range_m = self.mean.z_m / engine.geometry[2]
        self.unwraps = margin & known
        self.edge_fails = _edge_fails(filtered, float(gates.edge))
        # a dim pixel's mean over its window, brightest as it may be
        self.dim = np.isfinite(filtered.edge).all(axis=0) & (
            (high.min(axis=0) < gates.least) | (total + both < gates.total)
        )
        edge_high = filtered.edge + DEVIATIONS * filtered.edge_spread
        self.fails = (margin & (~known | (residual - reach > _residual_limit(gates, high.max(axis=0))))) | (
            low.max(axis=0) * least > high.min(axis=0)
        )
        self.fails_at_range = (
            (far_m + slack_m < gates.nearest_m)
            | (far_m - slack_m > gates.farthest_m)
            | (range_m + slack_m < reflected[1])
        )
        self.passes = (
            self.unwraps
            & (residual + reach <= _residual_limit(gates, np.maximum(low.max(axis=0), 1e-9)))
            & (edge_high < gates.edge).all(axis=0)
            & (low.min(axis=0) > gates.least)
            & (total - both > gates.total)
            & (high.max(axis=0) * least <= low.min(axis=0))
            & (range_m - slack_m > reflected[0])
            & (far_m - slack_m > gates.nearest_m)
            & (far_m + slack_m < gates.farthest_m)
        )


def _mean(filtered: Filtered, engine: Engine, turns: np.ndarray, lost: np.ndarray) -> Mean:
    """The engine on the mean phasors, and what half a path's change does to z."""
    f, n = filtered.amplitude.shape
    planes = np.stack([filtered.phasor.real, filtered.phasor.imag, filtered.amplitude], axis=1).astype(f4)
    edge = np.where(np.isfinite(filtered.edge), filtered.edge, filtered.edge_least).astype(f4)
    found = []
    for error_m in (0.0, STEP_M, -STEP_M):
        z_m, total, reason = np.empty(n, f4), np.empty(n, f4), np.empty(n, np.uint8)
        ranging.range_and_gates(
            planes, edge, lost.astype(np.uint8), engine.geometry, engine.outside_mask, engine.lattice,
            engine.gates, np.full(n, error_m, f4), z_m, reason, total,
        )  # fmt: skip
        found.append((z_m.astype(float), reason))
    (z_m, reason), (up_m, _), (down_m, _) = found
    by_path = (up_m - down_m) / (2 * STEP_M)
    weights = engine.lattice.metres_per_turn.astype(float)[:, None]
    deviation_m = by_path * np.sqrt(((weights * turns) ** 2).sum(axis=0))
    amplitude = filtered.amplitude.mean(axis=0)
    spread = np.sqrt((np.minimum(filtered.spread, MOST_SPREAD) ** 2).sum(axis=0)) / f
    return Mean(z_m, by_path, deviation_m, amplitude, spread, reason)


def _residual(filtered: Filtered, lattice: Lattice, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lattice residual of the mean phases in turns; whether the wrap counts are sure; whether they are known."""
    n = turns.shape[1]
    turn = (np.angle(filtered.phasor) / (2 * np.pi) % 1.0).astype(f4)
    sums = lattice.combination.astype(float) @ turn
    spread = np.sqrt(lattice.combination.astype(float) ** 2 @ turns**2)
    sure = (0.5 - np.abs(sums - np.round(sums)) > DEVIATIONS * spread).all(axis=0)
    half, residual2 = np.empty(n, f4), np.empty(n, f4)
    ranging.half_path(turn, n, lattice, half, residual2)
    return np.sqrt(residual2.astype(float)), sure, np.isfinite(residual2)


def _residual_limit(gates: ranging.Gates, greatest: np.ndarray) -> np.ndarray:
    """`ranging._residual_limit2` in turns, for amplitudes (n,)."""
    if gates.residual_slope == 0:
        return np.full(greatest.shape, float(gates.residual))
    by_amplitude = float(gates.residual_scale) * greatest ** float(gates.residual_slope)
    return np.minimum(float(gates.residual_most), np.maximum(float(gates.residual), by_amplitude))


def _edge_fails(filtered: Filtered, limit: float) -> np.ndarray:
    """Pixels whose edge sum is above the limit in some frequency, always.

    At any noise the frequencies' sums are independent, so their deviations from the limit add in squares.
    """
    if np.isinf(limit):
        return np.zeros(filtered.edge.shape[1], bool)
    spread = np.where(np.isfinite(filtered.edge), filtered.edge_spread, 0.0)
    below = (filtered.edge - DEVIATIONS * spread > limit) & np.isfinite(filtered.edge)
    above = np.maximum((filtered.edge_least - limit) / np.maximum(filtered.edge_loose, 1e-9), 0.0)
    return np.asarray(below.any(axis=0) | ((above**2).sum(axis=0) > DEVIATIONS**2))


def _may_fly(
    mean: Mean,
    gate: ranging.FlyingGate,
    filtered: Filtered,
    known: np.ndarray,
    unmeasured: np.ndarray,
    shape: tuple[int, int],
) -> np.ndarray:
    """(n,) bool: pixels that the gate on the finished image may mark in some frame.

    It takes a neighbour that is nearer by ``near_m`` and another that is farther by ``far_m``. A neighbour that may
    have any range counts as one of the two, two of them as both.
    """
    square = np.ones((3, 3), bool)
    slack_m = np.nan_to_num(DEVIATIONS * mean.deviation_m)
    z_m = np.nan_to_num(mean.z_m)
    wild = (~known & ~unmeasured).reshape(shape)
    low = np.where(known & ~unmeasured, z_m - slack_m, np.inf).reshape(shape)
    high = np.where(known & ~unmeasured, z_m + slack_m, -np.inf).reshape(shape)
    nearest = ndimage.minimum_filter(low, footprint=square, mode="constant", cval=np.inf).ravel()
    farthest = ndimage.maximum_filter(high, footprint=square, mode="constant", cval=-np.inf).ravel()
    count = ndimage.convolve(wild.astype(int), square.astype(int), mode="constant").ravel()
    before = z_m + slack_m - nearest > gate.near_m
    behind = farthest - z_m + slack_m > gate.far_m
    return np.asarray(before.astype(int) + behind + count >= 2)
