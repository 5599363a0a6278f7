"""Unwrapping several modulation frequencies whose ratios are integers: the tables behind `kernels.range_and_gates`."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.units import SPEED_OF_LIGHT_AIR


@dataclass(frozen=True)
class UnwrapTable:
    """How phases of three frequencies become half the light's path.

    ``lattice`` (3,) integers m with f_k = m_k f_0; ``combination`` (2, 3) integer rows orthogonal to m: for a true
    distance they sum the wrapped phases to whole numbers, which name the wrap counts. ``table`` (a, b, 3) wrap counts
    by those two numbers (-1 where no distance has them), ``offset`` (2,) index of zero. ``metres_per_turn`` (3,):
    R m_k / sum(m^2), the least-squares weights for equal phase noise. ``unambiguous_m``: R = c / 2 f_0.
    """

    lattice: np.ndarray
    combination: np.ndarray
    table: np.ndarray
    offset: np.ndarray
    metres_per_turn: np.ndarray
    unambiguous_m: float

    def for_kernel(self) -> tuple[np.ndarray, np.ndarray, int, int, np.ndarray, np.ndarray, np.ndarray]:
        """What `scenes.sensor.amcw.kernels` takes: combination, wrap counts (3, a b), a, b, offset, metres, lattice."""
        rows, columns, _ = self.table.shape
        wraps = np.ascontiguousarray(self.table.reshape(rows * columns, 3).T)
        return self.combination, wraps, rows, columns, self.offset, self.metres_per_turn, self.lattice


def unwrap_table(frequencies_hz: tuple[float, ...]) -> UnwrapTable:
    """The table for three frequencies. Raises UserError where they are not small integer multiples of a common one."""
    lattice, base_hz = _integer_ratios(frequencies_hz)
    combination = _orthogonal_rows(lattice)
    wraps = _wrap_counts(lattice)
    keys = wraps @ combination.T
    offset = -keys.min(axis=0)
    table = np.full((*(keys.max(axis=0) + offset + 1), 3), -1, np.int64)
    table[keys[:, 0] + offset[0], keys[:, 1] + offset[1]] = wraps
    unambiguous_m = SPEED_OF_LIGHT_AIR / (2 * base_hz)
    return UnwrapTable(
        lattice.astype(np.float32),
        combination.astype(np.float32),
        table.astype(np.float32),
        offset,
        (unambiguous_m * lattice / (lattice**2).sum()).astype(np.float32),
        unambiguous_m,
    )


def _integer_ratios(frequencies_hz: tuple[float, ...]) -> tuple[np.ndarray, float]:
    """Smallest integers m and base frequency with f = m * base, to 1e-6."""
    frequencies = np.array(frequencies_hz)
    lowest = frequencies.min()
    for divisor in range(1, 65):
        multiples = frequencies / (lowest / divisor)
        if np.abs(multiples - np.round(multiples)).max() < 1e-6 * divisor:
            return np.round(multiples).astype(np.int64), float(lowest / divisor)
    raise UserError(
        f"modulation frequencies {[f / 1e6 for f in frequencies_hz]} MHz share no base frequency",
        legal="three frequencies that are integer multiples (the lowest at most 64 times) of a common one",
    )


def _wrap_counts(lattice: np.ndarray, noise_turns: float = 0.03) -> np.ndarray:
    """(n, 3) wrap counts that occur within the unambiguous range.

    Where two frequencies wrap at the same distance (a third of the range for ratios 21 and 6), noise lets one wrap
    before the other, so counts that a phase error of ``noise_turns`` can make are among them. The count of a key
    is overwritten by the noise-free one, which comes last.
    """
    distance = (np.arange(0, 1, 1 / (64 * int(lattice.max()))) + 1e-9)[:, None] * lattice
    errors = sorted(product((-noise_turns, 0.0, noise_turns), repeat=3), key=lambda e: -sum(abs(x) for x in e))
    wraps = np.concatenate([np.floor(distance + np.array(error)) for error in errors]).astype(np.int64)
    return wraps[(wraps >= 0).all(axis=1) & (wraps < lattice).all(axis=1)]


def _orthogonal_rows(lattice: np.ndarray, reach: int = 16) -> np.ndarray:
    """The two shortest independent integer rows t with t . m = 0 that tell all wrap counts apart.

    Short rows amplify phase noise least: the rounding fails when |t| times the phase noise reaches half a turn.
    """
    span = range(-reach, reach + 1)
    rows = [np.array(t) for t in product(span, repeat=3) if any(t) and int(np.dot(t, lattice)) == 0]
    rows.sort(key=lambda t: (int((t**2).sum()), tuple(-t)))
    first = rows[0]
    # A pair that spans the whole orthogonal lattice has |t1 x t2| = |m|; a longer cross product would confuse wraps.
    want = int((lattice**2).sum())
    for second in rows[1:]:
        if int((np.cross(first, second) ** 2).sum()) == want:
            return np.stack([first, second])
    raise UserError(f"modulation frequency ratios {lattice.tolist()} cannot be unwrapped within {reach} turns")
