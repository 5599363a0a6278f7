"""Sorts pixels into those that have a range in every frame, those that have none, and those to
simulate one by one.

Each gate's quantity has a mean and a deviation to first order in the noise
(`scenes.sensor.amcw.linear`). A pixel is sure if the engine's table of gates
(`ranging.first_failed`) gives the same result for the worst and the best values within
`DEVIATIONS`. If noise is too large for that, bounds that hold at any noise are used. If a window
shows one even surface, noise lowers the weight of all neighbours by the same share, which a table
gives by the phase noise."""

from typing import NamedTuple

import cv2
import numba
import numpy as np
from scipy import ndimage

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.kernels import FilterSettings
from scenes.sensor.amcw.linear import DEVIATIONS, Filtered, Light, linearised, unknown_filtered
from scenes.sensor.normals import FAST

f4 = np.float32
MOST_LEFT_OUT = (
    # most variance not of first order: it is then right to 1 %; beyond, frames are simulated
    0.025
)
# in place of an unknown deviation: of a phase in radians, of an amplitude in units
MOST_TURNED = 1e3
MOST_SPREAD = 1e9


class Certainty(NamedTuple):
    """Sorted pixels, (n,) bool: ``always`` a range, to first order in the noise; ``never`` a
    range. Without noise, (n,) float32: ``z_m`` before rounding, and its change per metre of half
    path; ``deviation_m`` of a frame's z; ``amplitude``, the mean over frequencies, and its
    deviation; ``reason`` uint8."""

    always: np.ndarray
    never: np.ndarray
    z_m: np.ndarray
    z_by_path: np.ndarray
    deviation_m: np.ndarray
    amplitude: np.ndarray
    amplitude_deviation: np.ndarray
    reason: np.ndarray


def certainty(
    filtered: Filtered,
    engine: ranging.DepthEngine,
    lost: np.ndarray,
    shape: tuple[int, int],
    farthest_error_m: float,
) -> Certainty:
    """Sort the pixels of a view of ``shape`` whose frames are displaced by at most
    ``farthest_error_m``."""
    gates = engine.gates
    lattice = engine.lattice
    amplitude = filtered.amplitude
    f, n = amplitude.shape
    turns = np.minimum(filtered.turned, f4(MOST_TURNED)) / f4(2 * np.pi)
    spread = np.minimum(filtered.spread, f4(MOST_SPREAD))

    # the engine on the mean phasors, and the change of z by half a path: the range is that at
    # which range and distance to the emitter come to twice as much
    planes = np.stack([filtered.phasor.real, filtered.phasor.imag, amplitude], axis=1)
    mean_m, reason, _ = ranging.ranges_of(
        planes, filtered.edge_least, lost.astype(np.uint8), engine, np.zeros(n)
    )
    (along, square, cosine), weights = engine.geometry, lattice.metres_per_turn[:, None]
    range_m = mean_m / cosine
    emitter_m = np.sqrt(range_m * range_m - 2 * range_m * along + square)
    by_path = cosine * 2 * emitter_m / (range_m + emitter_m - along)
    deviation_m = by_path * np.sqrt(((weights * turns) ** 2).sum(axis=0))

    # the lattice residual of the mean phases in turns, and whether the wrap counts are certain
    turn = np.angle(filtered.phasor) / f4(2 * np.pi)
    turn[turn < 0] += 1
    sums = lattice.combination @ turn
    sway = np.sqrt(lattice.combination**2 @ turns**2)
    margin = (0.5 - np.abs(sums - np.round(sums)) > DEVIATIONS * sway).all(axis=0)
    residual2 = np.empty(n, f4)
    ranging.half_path(turn, n, lattice, np.empty(n, f4), residual2)
    residual = np.sqrt(residual2)
    unwraps = margin & np.isfinite(residual2)

    # each gate at the worst (-1) and the best (+1) values that noise and displacements allow
    both = DEVIATIONS * np.sqrt((spread**2).sum(axis=0))
    reach = DEVIATIONS * turns.max(axis=0)
    slack_m = DEVIATIONS * deviation_m + farthest_error_m
    far_m = mean_m if gates.axial > 0 else range_m
    if gates.edge_mean > 0:  # the frequencies' noise is independent
        steepest = (
            filtered.edge.mean(axis=0)
            + DEVIATIONS * np.sqrt((filtered.edge_spread**2).sum(axis=0)) / f
        )
    else:
        steepest = (filtered.edge + DEVIATIONS * filtered.edge_spread).max(axis=0)

    def first_failed(end: int) -> np.ndarray:
        low = amplitude + end * DEVIATIONS * spread
        high = amplitude - end * DEVIATIONS * spread
        inputs = ranging.GateInputs(
            edge=steepest if end < 0 else np.full(n, -np.inf, f4),
            least=low.min(axis=0),
            greatest=high.max(axis=0),
            total=amplitude.sum(axis=0) + end * both,
            residual2=np.maximum(residual - end * reach, 0.0) ** 2,
            brightest=np.maximum(low.max(axis=0), 1e-9),
            range_m=np.maximum(range_m + end * slack_m, 0.0),
            low_m=far_m + end * slack_m,
            high_m=far_m - end * slack_m,
        )
        return np.asarray(ranging.first_failed_each(gates, inputs))

    at_worst = first_failed(-1)
    at_best = first_failed(1)
    known = np.asarray((filtered.left_out <= MOST_LEFT_OUT).all(axis=0))
    # a dim pixel's mean over its window, at its brightest
    dim = np.isfinite(filtered.edge).all(axis=0) & (at_best == ranging.LOW_AMPLITUDE)
    fails = (at_best == ranging.AMPLITUDE_RATIO) | ((at_best == ranging.UNWRAP) & margin)
    unmeasured = engine.outside_mask | lost | _edge_fails(filtered, gates) | dim | (known & fails)
    too_far = (at_best == ranging.OUT_OF_RANGE) | (at_best == ranging.LOW_REFLECTIVITY)
    never = unmeasured | (known & unwraps & too_far)
    always = known & unwraps & (at_worst == ranging.VALID) & ~never
    if engine.flying is not None:
        images = (
            each.reshape(shape) for each in (mean_m, DEVIATIONS * deviation_m, known, unmeasured)
        )
        always &= ~_may_fly(engine.flying, *images)
    of_amplitude = np.sqrt((spread**2).sum(axis=0)) / f
    return Certainty(
        always, never, mean_m, by_path, deviation_m, amplitude.mean(axis=0), of_amplitude, reason
    )


def _edge_fails(filtered: Filtered, gates: ranging.Gates) -> np.ndarray:
    """Find pixels whose edge sum, in one frequency or in the mean of all, always exceeds the
    limit."""
    limit = float(gates.edge)
    least = filtered.edge_least
    loose = np.maximum(filtered.edge_loose, 1e-9)
    if np.isinf(limit):
        return np.zeros(least.shape[1], bool)
    if gates.edge_mean > 0:
        return np.asarray(
            least.sum(axis=0) - DEVIATIONS * np.sqrt((loose**2).sum(axis=0)) > limit * len(least)
        )
    return np.asarray((np.maximum((least - limit) / loose, 0.0) ** 2).sum(axis=0) > DEVIATIONS**2)


def _may_fly(
    gate: ranging.FlyingGate,
    z_m: np.ndarray,
    slack_m: np.ndarray,
    known: np.ndarray,
    unmeasured: np.ndarray,
) -> np.ndarray:
    """Find pixels (h, w), flat, that the gate on the finished image may remove in some frame."""
    slack_m = np.nan_to_num(slack_m)
    z_m = np.nan_to_num(z_m)
    measured = known & ~unmeasured
    low = np.where(measured, z_m - slack_m, np.inf)
    high = np.where(measured, z_m + slack_m, -np.inf)
    square = np.ones((3, 3), np.uint8)
    nearest = np.asarray(cv2.erode(low, square))
    farthest = np.asarray(cv2.dilate(high, square))
    wild = (~known & ~unmeasured).astype(int)
    count = ndimage.convolve(wild, np.ones((3, 3), int), mode="constant")
    before = z_m + slack_m - nearest > gate.near_m
    behind = farthest - z_m + slack_m > gate.far_m
    return np.asarray(before.astype(int) + behind + count >= 2).ravel()


# a window with a smaller edge sum is even: a neighbour 0.13 rad off changes its weight by 3 %
MOST_EDGE = 0.004
MOST_UNLIKE = (
    0.005  # largest difference of c s^2 in a window with even noise: that share of a weight
)
MOST_NOISE = 0.15  # largest phase noise in radians of the table, beyond what `certainty` accepts
NOISES = np.linspace(0.0, MOST_NOISE, 33)


def _shares_of(window: FilterSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return a neighbour's share, and the variance of higher order over the noise's, by phase
    noise `NOISES`."""
    # windows with one noise each, below one another
    side = window.space.shape[0]
    k = window.space.size
    count = len(NOISES)
    weights = window.space.ravel() / window.space.sum()
    each = np.repeat(NOISES, k)[None].astype(f4)
    bright = np.full((1, count * k), 1e3 * max(window.dim, 1.0), f4)
    light = Light(np.ones_like(each, np.complex64), bright, bright, each, each / f4(1e3))
    middles = np.arange(count) * k + k // 2
    out = unknown_filtered(1, count * k)
    lost = np.zeros(count * k, bool)
    moved = linearised(middles[1:], light, window, (count * side, side), lost, out)[0]
    neighbours = np.ones(count)
    rest = np.zeros(count)
    neighbours[1:] = moved[:, 0] / NOISES[1:] / weights[0]
    rest[1:] = out.left_out[0, middles[1:]] * (out.turned[0, middles[1:]] / NOISES[1:]) ** 2
    return neighbours, rest


def even_pixels(
    edge: np.ndarray, light: Light, window: FilterSettings, shape: tuple[int, int], lost: np.ndarray
) -> np.ndarray:
    """Return (n,) bool: pixels before one even surface. ``edge`` (f, n): noise-free edge sum;
    ``lost`` (n,) bool."""
    size = window.space.shape[0]
    half = size // 2
    unlike = lost | (light.amplitude * (1 - DEVIATIONS * light.swell) <= window.dim).any(axis=0)
    unlike |= (light.turn > MOST_NOISE).any(axis=0)
    square = np.ones((size, size), np.uint8)
    even = np.asarray(cv2.dilate(unlike.reshape(shape).astype(np.uint8), square)) == 0
    even[:half], even[-half:], even[:, :half], even[:, -half:] = False, False, False, False
    for f, plane in enumerate(window.concentration * light.turn.reshape(-1, *shape) ** 2):
        even &= (
            np.asarray(cv2.dilate(plane, square)) - np.asarray(cv2.erode(plane, square))
            < MOST_UNLIKE
        )
        even &= edge[f].reshape(shape) < MOST_EDGE
    return even.ravel()


def fill_even(
    even: np.ndarray,
    filtered: np.ndarray,
    edge: np.ndarray,
    light: Light,
    window: FilterSettings,
    shape: tuple[int, int],
    out: Filtered,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill ``out`` at the ``even`` pixels (n,) bool, from the noise-free ``filtered`` (f, 3, n)
    and ``edge`` (f, n). Return, (f, m) each, the change of the phase by a neighbour's noise at
    weight and amplitude 1, over its deviation, and by one deviation of the centre's noise in
    total."""
    at = np.flatnonzero(even)
    tables = _shares_of(window)
    middle = len(window.space) // 2
    each, centre = np.empty((2, len(edge), len(at)), f4)
    # the weights are a product of those along rows and along columns
    taps = window.space[middle] / np.sqrt(window.space[middle, middle])

    def summed(values: np.ndarray, taps: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(
            values.reshape(shape), -1, taps, taps, borderType=cv2.BORDER_CONSTANT
        ).ravel()

    for f in range(len(edge)):
        ours = Light(*(part[f] for part in light))
        theirs = Filtered(*(part[f] for part in out))
        carried = ours.amplitude if window.by_amplitude else np.ones_like(ours.amplitude)
        squares = (carried * ours.turn) ** 2
        spreads = (ours.amplitude * ours.swell) ** 2
        sums = summed(carried, taps), summed(squares, taps**2), summed(spreads, taps**2)
        inputs = (
            at,
            filtered[f],
            edge[f],
            ours,
            carried,
            *sums,
            window.space,
            tables,
            window.by_amplitude,
        )
        _fill_even(*inputs, theirs, each[f], centre[f])
    return each, centre


@numba.njit(**FAST)
def _fill_even(  # type: ignore[no-untyped-def]
    at,
    filtered,
    edge,
    light,
    carried,
    weights,
    squares,
    spreads,
    space,
    tables,
    by_amplitude,
    out,
    each,
    centre,
):
    """Do the work of `fill_even` for one frequency; sums over windows are (n,)."""
    middle = space[len(space) // 2, len(space) // 2]
    kept = space.size - 1
    whole = space.sum()
    (of_neighbours, of_rest), step = tables, MOST_NOISE / (len(tables[0]) - 1)
    for m in range(at.size):
        i = at[m]
        own = light.turn[i]
        own2 = own * own
        low = min(int(own / step), len(of_rest) - 2)
        part = own / step - low
        share = of_neighbours[low] + part * (of_neighbours[low + 1] - of_neighbours[low])
        rest = own2 * (of_rest[low] + part * (of_rest[low + 1] - of_rest[low]))
        each[m] = share / weights[i]
        mine = middle * carried[i] / weights[i]
        centre2 = (1 - share * (1 - mine)) ** 2 * own2 + rest
        variance = each[m] ** 2 * (squares[i] - (middle * carried[i] * own) ** 2) + centre2
        centre[m] = np.sqrt(centre2)
        # noise moves the mean towards the centre's own phase, as it does the shares
        alone = complex(filtered[0, i], filtered[1, i])
        mean = light.phasor[i] * (1 - share) + alone * (
            share / np.sqrt(alone.real**2 + alone.imag**2)
        )
        out.phasor[i] = mean / np.sqrt(mean.real**2 + mean.imag**2)
        # noise perpendicular to a mean phasor lengthens it
        out.amplitude[i] = filtered[2, i] * (1 + 0.5 * variance if by_amplitude else 1.0)
        out.turned[i] = np.sqrt(variance)
        out.spread[i] = np.sqrt(spreads[i]) / whole
        out.left_out[i] = rest / variance
        out.edge[i] = edge[i] + 0.5 * kept * (1 - np.exp(-own2))
        out.edge_spread[i] = np.sqrt(
            (kept * 6 / 16 + kept**2 / 8) * own2 * own2 + (1 + kept) * edge[i] * own2
        )
        out.edge_least[i], out.edge_loose[i] = out.edge[i], out.edge_spread[i]
