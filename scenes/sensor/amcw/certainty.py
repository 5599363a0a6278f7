"""Finds the pixels that have a range in every frame, to first order in the noise.

Each gate's quantity has a mean and a deviation to first order in the noise
(`scenes.sensor.amcw.linear`). A pixel is sure if it passes the engine's table of gates
(`ranging.first_failed`) with the worst values within `DEVIATIONS`."""

from typing import NamedTuple

import cv2
import numpy as np
from scipy import ndimage

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.linear import DEVIATIONS, MOST_HIGHER, Filtered

f4 = np.float32
# in place of an unknown deviation: of a phase in radians, of an amplitude in units
LARGEST_PHASE_NOISE = 1e3
LARGEST_AMPLITUDE_NOISE = 1e9


class Certainty(NamedTuple):
    """Sorted pixels of a view, (n,) each."""

    always: np.ndarray
    """bool: a range in every frame, to first order in the noise."""
    z_m: np.ndarray
    """float32: z without noise, before rounding."""
    z_by_path: np.ndarray
    """float32: change of z per metre of half path."""
    deviation_m: np.ndarray
    """float32: deviation of a frame's z."""
    amplitude: np.ndarray
    """float32: mean over frequencies, without noise."""
    amplitude_deviation: np.ndarray
    """float32: deviation of a frame's amplitude."""


class _Spans(NamedTuple):
    """Means of the quantities of the gates, and how far noise and displacements may carry them."""

    amplitude: np.ndarray
    """(f, n): mean amplitude."""
    amplitude_reach: np.ndarray
    """(f, n): `DEVIATIONS` of it."""
    total_reach: np.ndarray
    """(n,): `DEVIATIONS` of the sum over the frequencies."""
    edge: np.ndarray
    """(n,): largest edge sum."""
    residual: np.ndarray
    """(n,): lattice residual of the mean phases in turns."""
    residual_reach: np.ndarray
    """(n,): `DEVIATIONS` of the noisiest phase in turns."""
    range_m: np.ndarray
    """(n,): range along the ray."""
    limited_m: np.ndarray
    """(n,): range in the direction that the engine limits."""
    range_reach_m: np.ndarray
    """(n,): `DEVIATIONS` of the range, and the largest displacement of a frame."""


def certainty(
    filtered: Filtered,
    engine: ranging.DepthEngine,
    shape: tuple[int, int],
    farthest_error_m: float,
) -> Certainty:
    """Sort the pixels of a view of ``shape`` whose frames are displaced by at most
    ``farthest_error_m``."""
    gates = engine.gates
    lattice = engine.lattice
    amplitude = filtered.amplitude
    f, n = amplitude.shape
    phase_noise = np.minimum(filtered.phase_noise, f4(LARGEST_PHASE_NOISE))
    noise_turns = phase_noise / f4(2 * np.pi)
    amplitude_noise = np.minimum(filtered.amplitude_noise, f4(LARGEST_AMPLITUDE_NOISE))

    # the engine on the mean phasors
    planes = np.stack([filtered.phasor.real, filtered.phasor.imag, amplitude], axis=1)
    z_m, _, _ = ranging.ranges_of(planes, filtered.edge, np.zeros(n, np.uint8), engine, 0.0)
    # change of z by half a path: the range is that at which range and distance to the emitter come
    # to twice as much
    along, square, cosine = engine.geometry
    range_m = z_m / cosine
    emitter_m = np.sqrt(range_m * range_m - 2 * range_m * along + square)
    z_by_path = cosine * 2 * emitter_m / (range_m + emitter_m - along)
    metres_per_turn = lattice.metres_per_turn[:, None]
    deviation_m = z_by_path * np.sqrt(((metres_per_turn * noise_turns) ** 2).sum(axis=0))

    # the lattice residual of the mean phases, and whether the wrap counts are certain
    turn = np.angle(filtered.phasor) / f4(2 * np.pi)
    turn[turn < 0] += 1
    sums = lattice.combination @ turn
    sums_noise = np.sqrt(lattice.combination**2 @ noise_turns**2)
    to_next_key = 0.5 - np.abs(sums - np.round(sums))
    one_key = (to_next_key > DEVIATIONS * sums_noise).all(axis=0)
    residual2 = np.empty(n, f4)
    ranging.half_path(turn, n, lattice, np.empty(n, f4), residual2)
    unwraps = one_key & np.isfinite(residual2)

    # all gates at the worst values that noise and displacements allow
    total_noise = np.sqrt((amplitude_noise**2).sum(axis=0))
    spans = _Spans(
        amplitude=amplitude,
        amplitude_reach=DEVIATIONS * amplitude_noise,
        total_reach=DEVIATIONS * total_noise,
        edge=_largest_edge(filtered, gates),
        residual=np.sqrt(residual2),
        residual_reach=DEVIATIONS * noise_turns.max(axis=0),
        range_m=range_m,
        limited_m=z_m if gates.axial > 0 else range_m,
        range_reach_m=DEVIATIONS * deviation_m + farthest_error_m,
    )
    passes = _first_failed(gates, spans) == ranging.VALID
    linear = np.asarray((filtered.higher_share <= MOST_HIGHER).all(axis=0))
    always = linear & unwraps & passes & ~engine.outside_mask
    if engine.flying is not None:
        always &= ~_may_fly(
            engine.flying,
            z_m.reshape(shape),
            (DEVIATIONS * deviation_m).reshape(shape),
            linear.reshape(shape),
        )
    return Certainty(
        always=always,
        z_m=z_m,
        z_by_path=z_by_path,
        deviation_m=deviation_m,
        amplitude=amplitude.mean(axis=0),
        amplitude_deviation=total_noise / f,
    )


def _largest_edge(filtered: Filtered, gates: ranging.Gates) -> np.ndarray:
    """Return the largest edge sum (n,) of any frequency, or of their mean, within `DEVIATIONS`."""
    if gates.edge_mean == 0:
        return np.asarray((filtered.edge + DEVIATIONS * filtered.edge_noise).max(axis=0))
    # the frequencies' noise is independent
    mean_noise = np.sqrt((filtered.edge_noise**2).sum(axis=0))
    return np.asarray(filtered.edge.mean(axis=0) + DEVIATIONS * mean_noise / len(filtered.edge))


def _first_failed(gates: ranging.Gates, spans: _Spans) -> np.ndarray:
    """Return the code (n,) of the first gate that fails at the worst values."""
    low = spans.amplitude - spans.amplitude_reach
    high = spans.amplitude + spans.amplitude_reach
    inputs = ranging.GateInputs(
        edge=spans.edge,
        least=low.min(axis=0),
        greatest=high.max(axis=0),
        total=spans.amplitude.sum(axis=0) - spans.total_reach,
        residual2=(spans.residual + spans.residual_reach) ** 2,
        brightest=np.maximum(low.max(axis=0), 1e-9),
        range_m=np.maximum(spans.range_m - spans.range_reach_m, 0.0),
        low_m=spans.limited_m - spans.range_reach_m,
        high_m=spans.limited_m + spans.range_reach_m,
    )
    return np.asarray(ranging.first_failed_each(gates, inputs))


def _may_fly(
    gate: ranging.FlyingGate,
    z_m: np.ndarray,
    reach_m: np.ndarray,
    linear: np.ndarray,
) -> np.ndarray:
    """Find pixels (h, w), flat, that the gate on the finished image may remove in some frame."""
    reach_m = np.nan_to_num(reach_m)
    z_m = np.nan_to_num(z_m)
    low = np.where(linear, z_m - reach_m, np.inf)
    high = np.where(linear, z_m + reach_m, -np.inf)
    square = np.ones((3, 3), np.uint8)
    nearest = np.asarray(cv2.erode(low, square))
    farthest = np.asarray(cv2.dilate(high, square))
    undecided_count = ndimage.convolve((~linear).astype(int), np.ones((3, 3), int), mode="constant")
    before = z_m + reach_m - nearest > gate.near_m
    behind = farthest - z_m + reach_m > gate.far_m
    # an undecided neighbour may be nearer or farther
    return np.asarray(before.astype(int) + behind + undecided_count >= 2).ravel()
