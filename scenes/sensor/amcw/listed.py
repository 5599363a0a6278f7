"""Pixels whose frames are simulated one by one: which light they need, and the sums of their
frames."""

from typing import NamedTuple

import numba
import numpy as np

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.windows import pixels_within, windows_of
from scenes.sensor.common.normals import FAST
from scenes.sensor.common.unit import N_REASONS

f4 = np.float32


class Listed(NamedTuple):
    """Pixels to simulate; -1 means none."""

    halo: np.ndarray
    """(g,): flat indices of pixels whose light is needed."""
    range: np.ndarray
    """(m,): flat indices of pixels that get a range."""
    wanted: np.ndarray
    """(p,): indices in ``range`` of the pixels whose result is wanted."""
    window: np.ndarray
    """(m, k): indices in ``halo`` of each range's window."""
    neighbours: np.ndarray
    """(p, 9): indices in ``range`` of each wanted pixel's neighbours and itself."""


class ListedSums(NamedTuple):
    """Sums over frames of p pixels, for each of k parts of a capture."""

    valid: np.ndarray
    """(k, p) int32: number of valid samples."""
    total: np.ndarray
    """(k, p): of their z minus base, in steps."""
    squares: np.ndarray
    """(k, p): of its square."""
    amplitude: np.ndarray
    """(k, p): of their amplitude, the mean over frequencies."""
    reasons: np.ndarray
    """(k, r, p) uint16: how often each `Reason` occurred."""


def listed_of(wanted: np.ndarray, side: int, flying: bool) -> Listed:
    """Return the list for ``wanted`` (h, w) bool, with windows of ``side``. ``flying``: whether
    the engine looks at a pixel's neighbours in the finished image."""
    ranges = pixels_within(wanted, 3) if flying else wanted
    halo = pixels_within(ranges, side)
    number_in_range = _running_numbers(ranges)
    number_in_halo = _running_numbers(halo)
    range_pixels = np.flatnonzero(ranges)
    wanted_pixels = np.flatnonzero(wanted)
    return Listed(
        halo=np.flatnonzero(halo),
        range=range_pixels,
        wanted=number_in_range.ravel()[wanted_pixels],
        window=windows_of(number_in_halo, side, -1, range_pixels),
        neighbours=windows_of(number_in_range, 3, -1, wanted_pixels),
    )


def _running_numbers(pixels: np.ndarray) -> np.ndarray:
    """Return (h, w) int32: 0, 1, 2 .. at the ``pixels`` (h, w) bool, -1 elsewhere."""
    numbers = np.cumsum(pixels).reshape(pixels.shape) - 1
    return np.where(pixels, numbers, -1).astype(np.int32)


def empty_sums(parts: int, pixels: int) -> ListedSums:
    """Return sums over no frame."""
    return ListedSums(
        valid=np.zeros((parts, pixels), np.int32),
        total=np.zeros((parts, pixels)),
        squares=np.zeros((parts, pixels)),
        amplitude=np.zeros((parts, pixels)),
        reasons=np.zeros((parts, N_REASONS, pixels), np.uint16),
    )


@numba.njit(**FAST)
def add_listed_frames(  # type: ignore[no-untyped-def]
    z_m,
    reason,
    strength,
    flying,
    wanted,
    part_of,
    share,
    step_m,
    base,
    sums,
):
    """Add frames of listed pixels to their sums.

    Args:
        z_m, reason, strength: (m, lanes) of the pixels that get a range; ``strength`` is the sum of
            amplitudes over the frequencies.
        flying: (p, lanes) bool, whether the gate on the finished image removes a wanted pixel.
        wanted: (p,) indices of the wanted pixels among those that get a range.
        part_of: (lanes,) the part that counts a frame; -1 for none.
        share: 1 over the number of frequencies.
        step_m: the output's step.
        base: (p,) whole steps that are taken off z.
        sums: the `ListedSums` that are added to.
    """
    for p in range(wanted.size):
        for t in range(part_of.size):
            k = part_of[t]
            if k < 0:
                continue
            i = wanted[p]
            code = np.uint8(ranging.EDGE) if flying[p, t] else reason[i, t]
            sums.reasons[k, code, p] += 1
            if code == ranging.VALID:
                steps = np.floor(z_m[i, t] / step_m + f4(0.5)) - base[p]
                sums.valid[k, p] += 1
                sums.total[k, p] += steps
                sums.squares[k, p] += steps * steps
                sums.amplitude[k, p] += strength[i, t] * share
