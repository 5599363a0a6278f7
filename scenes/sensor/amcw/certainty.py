"""Pixels that have a range in every frame, in none, or are to be simulated one by one.

Each gate's quantity has a mean and a deviation to first order in the noise (`scenes.sensor.amcw.linear`); a pixel is
sure where the engine's table of gates (`ranging.first_failed`) says the same of the worst and of the best values within
`DEVIATIONS`. Where the noise is too much for that, only bounds that hold at any noise count: of the edge sum, and of a
dim pixel's amplitude.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.linear import DEVIATIONS, Filtered
from scenes.sensor.amcw.unwrap import Lattice

f4 = np.float32
MOST_LEFT_OUT = 0.025
"""Share of the variance that is not of first order, above which a pixel is simulated frame by frame: up to it (phase
noise of 0.13 rad on a face) the variance is right to 1 %, at half the noise to 0.2 %."""
STEP_M = 1e-3
"""Displacement of half a path by which that of z is found."""
MOST_TURNED, MOST_SPREAD = 1e3, 1e9
"""Stand-ins for an unknown deviation: of a phase in radians, of an amplitude in units."""


@dataclass(frozen=True)
class Certainty:
    """Sorted pixels, (n,) bool: ``always`` a range, to first order in the noise; ``never`` a range.

    Without noise, (n,) float64: ``z_m`` without rounding and by how much a metre of half path moves it;
    ``deviation_m`` of a frame's z; ``amplitude``, mean over frequencies, and its deviation; ``reason`` uint8.
    """

    always: np.ndarray
    never: np.ndarray
    z_m: np.ndarray
    z_by_path: np.ndarray
    deviation_m: np.ndarray
    amplitude: np.ndarray
    amplitude_deviation: np.ndarray
    reason: np.ndarray


@dataclass(frozen=True)
class DepthEngine:
    """Everything that decides after the filter, as `ranging.range_and_gates` takes it; ``flying`` None for no gate."""

    geometry: np.ndarray
    outside_mask: np.ndarray
    lattice: Lattice
    gates: ranging.Gates
    flying: ranging.FlyingGate | None


def certainty(
    filtered: Filtered, engine: DepthEngine, lost: np.ndarray, shape: tuple[int, int], farthest_error_m: float
) -> Certainty:
    """Sort the pixels of a view of ``shape``; frames are displaced by ``farthest_error_m`` at most."""
    gates, lattice, amplitude = engine.gates, engine.lattice, filtered.amplitude
    f, n = amplitude.shape
    turns = np.minimum(filtered.turned, MOST_TURNED) / (2 * np.pi)
    spread = np.minimum(filtered.spread, MOST_SPREAD)

    # the engine on the mean phasors, and what half a path's change does to z
    planes = np.stack([filtered.phasor.real, filtered.phasor.imag, amplitude], axis=1).astype(f4)
    edge = np.where(np.isfinite(filtered.edge), filtered.edge, filtered.edge_least).astype(f4)
    z_m, reason = np.empty((3, n), f4), np.empty((3, n), np.uint8)
    for row, error_m in enumerate((0.0, STEP_M, -STEP_M)):
        ranging.range_and_gates(
            planes, edge, lost.astype(np.uint8), engine.geometry, engine.outside_mask, lattice, gates,
            np.full(n, error_m, f4), z_m[row], reason[row], np.empty(n, f4),
        )  # fmt: skip
    mean_m, up_m, down_m = z_m.astype(float)
    by_path = (up_m - down_m) / (2 * STEP_M)
    weights = lattice.metres_per_turn.astype(float)[:, None]
    deviation_m = by_path * np.sqrt(((weights * turns) ** 2).sum(axis=0))

    # the lattice residual of the mean phases in turns; whether the wrap counts are sure
    turn = (np.angle(filtered.phasor) / (2 * np.pi) % 1.0).astype(f4)
    sums = lattice.combination.astype(float) @ turn
    sway = np.sqrt(lattice.combination.astype(float) ** 2 @ turns**2)
    margin = (0.5 - np.abs(sums - np.round(sums)) > DEVIATIONS * sway).all(axis=0)
    residual2 = np.empty(n, f4)
    ranging.half_path(turn, n, lattice, np.empty(n, f4), residual2)
    residual, unwraps = np.sqrt(residual2.astype(float)), margin & np.isfinite(residual2)

    # each gate at the worst and at the best of what noise and displacements leave
    low, high = amplitude - DEVIATIONS * spread, amplitude + DEVIATIONS * spread
    total, both = amplitude.sum(axis=0), DEVIATIONS * np.sqrt((spread**2).sum(axis=0))
    reach = DEVIATIONS * turns.max(axis=0)
    slack_m = DEVIATIONS * deviation_m + farthest_error_m
    range_m = mean_m / engine.geometry[2]
    far_m = mean_m if gates.axial > 0 else range_m
    worst = ranging.GateInputs(
        edge=(filtered.edge + DEVIATIONS * filtered.edge_spread).max(axis=0),
        least=low.min(axis=0),
        greatest=high.max(axis=0),
        total=total - both,
        residual2=(residual + reach) ** 2,
        brightest=np.maximum(low.max(axis=0), 1e-9),
        range_m=np.maximum(range_m - slack_m, 0.0),
        low_m=far_m - slack_m,
        high_m=far_m + slack_m,
    )
    best = ranging.GateInputs(
        edge=np.full(n, -np.inf),
        least=high.min(axis=0),
        greatest=low.max(axis=0),
        total=total + both,
        residual2=np.maximum(residual - reach, 0.0) ** 2,
        brightest=high.max(axis=0),
        range_m=range_m + slack_m,
        low_m=far_m + slack_m,
        high_m=far_m - slack_m,
    )
    at_worst, at_best = (ranging.first_failed_each(gates, inputs) for inputs in (worst, best))

    known = np.asarray((filtered.left_out <= MOST_LEFT_OUT).all(axis=0))
    # a dim pixel's mean over its window, brightest as it may be
    dim = np.isfinite(filtered.edge).all(axis=0) & (at_best == ranging.LOW_AMPLITUDE)
    fails = (at_best == ranging.AMPLITUDE_RATIO) | ((at_best == ranging.UNWRAP) & margin)
    unmeasured = engine.outside_mask | lost | _edge_fails(filtered, float(gates.edge)) | dim | (known & fails)
    too_far = (at_best == ranging.OUT_OF_RANGE) | (at_best == ranging.LOW_REFLECTIVITY)
    never = unmeasured | (known & unwraps & too_far)
    always = known & unwraps & (at_worst == ranging.VALID) & ~never
    if engine.flying is not None:
        always &= ~_may_fly(mean_m, deviation_m, engine.flying, known, unmeasured, shape)
    of_amplitude = np.sqrt((spread**2).sum(axis=0)) / f
    return Certainty(always, never, mean_m, by_path, deviation_m, amplitude.mean(axis=0), of_amplitude, reason[0])


def _edge_fails(filtered: Filtered, limit: float) -> np.ndarray:
    """Find pixels whose edge sum is above the limit in some frequency, always.

    At any noise the frequencies' sums are independent, so their deviations from the limit add in squares.
    """
    if np.isinf(limit):
        return np.zeros(filtered.edge.shape[1], bool)
    spread = np.where(np.isfinite(filtered.edge), filtered.edge_spread, 0.0)
    below = (filtered.edge - DEVIATIONS * spread > limit) & np.isfinite(filtered.edge)
    above = np.maximum((filtered.edge_least - limit) / np.maximum(filtered.edge_loose, 1e-9), 0.0)
    return np.asarray(below.any(axis=0) | ((above**2).sum(axis=0) > DEVIATIONS**2))


def _may_fly(
    z_m: np.ndarray,
    deviation_m: np.ndarray,
    gate: ranging.FlyingGate,
    known: np.ndarray,
    unmeasured: np.ndarray,
    shape: tuple[int, int],
) -> np.ndarray:
    """Find pixels (n,) that the gate on the finished image may mark in some frame.

    It takes a neighbour that is nearer by ``near_m`` and another that is farther by ``far_m``. A neighbour that may
    have any range counts as one of the two, two of them as both.
    """
    square = np.ones((3, 3), bool)
    slack_m, z_m = np.nan_to_num(DEVIATIONS * deviation_m), np.nan_to_num(z_m)
    wild = (~known & ~unmeasured).reshape(shape)
    low = np.where(known & ~unmeasured, z_m - slack_m, np.inf).reshape(shape)
    high = np.where(known & ~unmeasured, z_m + slack_m, -np.inf).reshape(shape)
    nearest = ndimage.minimum_filter(low, footprint=square, mode="constant", cval=np.inf).ravel()
    farthest = ndimage.maximum_filter(high, footprint=square, mode="constant", cval=-np.inf).ravel()
    count = ndimage.convolve(wild.astype(int), square.astype(int), mode="constant").ravel()
    before = z_m + slack_m - nearest > gate.near_m
    behind = farthest - z_m + slack_m > gate.far_m
    return np.asarray(before.astype(int) + behind + count >= 2)
