"""Unwrapping several modulation frequencies whose ratios are integers: the tables behind `ranging.half_path`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import Literal, NamedTuple

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.units import SPEED_OF_LIGHT_AIR


class Lattice(NamedTuple):
    """Unwrapping tables as compiled code takes them; f frequencies, r = f - 1 rows, k keys.

    ``combination`` (r, f) and ``lattice``, ``metres_per_turn`` (f,) float32; ``sizes`` and ``offset`` (r,) int32 and
    ``wraps`` (f, k) float32: the table of `UnwrapTable`, laid flat.
    """

    combination: np.ndarray
    sizes: np.ndarray
    offset: np.ndarray
    wraps: np.ndarray
    lattice: np.ndarray
    metres_per_turn: np.ndarray


@dataclass(frozen=True)
class UnwrapTable:
    """Tables by which phases of f = 1, 2 or 3 frequencies become half the light's path.

    ``lattice`` (f,) integers m with f_k = m_k f_0; ``combination`` (f - 1, f) integer rows orthogonal to m: for a true
    distance they sum the wrapped phases to whole numbers, which name the wrap counts. ``table`` (..., f) wrap counts
    by those numbers (-1 where no distance has them), ``offset`` (f - 1,) index of zero. ``metres_per_turn`` (f,):
    R m_k / sum(m^2), the least-squares weights for equal phase noise, or R / sum(m), the mean of the cycle counts
    times its length. ``unambiguous_m``: R = c / 2 f_0.
    """

    lattice: np.ndarray
    combination: np.ndarray
    table: np.ndarray
    offset: np.ndarray
    metres_per_turn: np.ndarray
    unambiguous_m: float

    @cached_property
    def for_kernel(self) -> Lattice:
        """Return the same in the types of the compiled loop."""
        *sizes, frequencies = self.table.shape
        return Lattice(
            self.combination.astype(np.float32),
            np.array(sizes, np.int32),
            self.offset.astype(np.int32),
            np.ascontiguousarray(self.table.reshape(-1, frequencies).T, np.float32),
            self.lattice.astype(np.float32),
            self.metres_per_turn.astype(np.float32),
        )


@lru_cache(maxsize=64)
def unwrap_table(frequencies_hz: tuple[float, ...], fusion: Literal["least_squares", "mean"]) -> UnwrapTable:
    """Return the table for one to three frequencies. Raises UserError where they are no small multiples of a common
    one."""
    lattice, base_hz = _integer_ratios(frequencies_hz)
    combination = _orthogonal_rows(lattice)
    wraps = _wrap_counts(lattice)
    keys = wraps @ combination.T
    offset = -keys.min(axis=0)
    sizes = keys.max(axis=0) + offset + 1
    # a single frequency has no keys: then the table's one entry is the count 0
    strides = np.array([np.prod(sizes[row + 1 :], dtype=int) for row in range(sizes.size)], int)
    table = np.full((*sizes, lattice.size), -1, np.int64)
    table.reshape(-1, lattice.size)[(keys + offset) @ strides] = wraps
    unambiguous_m = SPEED_OF_LIGHT_AIR / (2 * base_hz)
    weights = lattice / (lattice**2).sum() if fusion == "least_squares" else np.full(lattice.size, 1 / lattice.sum())
    return UnwrapTable(lattice, combination, table, offset, unambiguous_m * weights, unambiguous_m)


def _integer_ratios(frequencies_hz: tuple[float, ...]) -> tuple[np.ndarray, float]:
    """Return smallest integers m and base frequency with f = m * base, to 1e-6."""
    frequencies = np.array(frequencies_hz)
    lowest = frequencies.min()
    for divisor in range(1, 65):
        multiples = frequencies / (lowest / divisor)
        if np.abs(multiples - np.round(multiples)).max() < 1e-6 * divisor:
            return np.round(multiples).astype(np.int64), float(lowest / divisor)
    raise UserError(
        f"modulation frequencies {[f / 1e6 for f in frequencies_hz]} MHz share no base frequency",
        legal="frequencies that are integer multiples (the lowest at most 64 times) of a common one",
    )


def _wrap_counts(lattice: np.ndarray, noise_turns: float = 0.03) -> np.ndarray:
    """Return (n, f) wrap counts that occur within the unambiguous range.

    Where two frequencies wrap at the same distance (a third of the range for ratios 21 and 6), noise lets one wrap
    before the other, so counts that a phase error of ``noise_turns`` can make are among them. The count of a key
    is overwritten by the noise-free one, which comes last.
    """
    distance = (np.arange(0, 1, 1 / (64 * int(lattice.max()))) + 1e-9)[:, None] * lattice
    errors = sorted(
        product((-noise_turns, 0.0, noise_turns), repeat=lattice.size), key=lambda e: -sum(abs(x) for x in e)
    )
    wraps = np.concatenate([np.floor(distance + np.array(error)) for error in errors]).astype(np.int64)
    return wraps[(wraps >= 0).all(axis=1) & (wraps < lattice).all(axis=1)]


def _orthogonal_rows(lattice: np.ndarray, reach: int = 16) -> np.ndarray:
    """Return (f - 1, f): the shortest independent integer rows t with t . m = 0 that tell all wrap counts apart.

    Short rows amplify phase noise least: the rounding fails when |t| times the phase noise reaches half a turn.
    """
    if lattice.size == 1:
        return np.empty((0, 1), np.int64)
    if lattice.size == 2:
        return np.array([[-lattice[1], lattice[0]]])
    span = range(-reach, reach + 1)
    rows = [np.array(t) for t in product(span, repeat=3) if any(t) and int(np.dot(t, lattice)) == 0]
    rows.sort(key=lambda t: (int((t**2).sum()), tuple(-t)))
    # A pair that spans the whole orthogonal lattice has |t1 x t2| = |m|; a longer cross product would confuse wraps.
    want = int((lattice**2).sum())
    for second in rows[1:]:
        if int((np.cross(rows[0], second) ** 2).sum()) == want:
            return np.stack([rows[0], second])
    raise UserError(f"modulation frequency ratios {lattice.tolist()} cannot be unwrapped within {reach} turns")
