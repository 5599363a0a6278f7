"""Compiled inner loops of the scanned lidar's frames: which peak wins, smoothing, gates. One core, float32."""

from __future__ import annotations

import numba
import numpy as np

from harness.vocabulary.capture import Reason
from scenes.sensor.normals import FAST

VALID, SATURATED, LOW_AMPLITUDE, EDGE, OUT_OF_RANGE = (
    int(Reason[name]) for name in ("VALID", "SATURATED", "LOW_AMPLITUDE", "EDGE", "OUT_OF_RANGE")
)
NOWHERE_M = np.float32(1e9)
"""Half path beyond the picture's border: it agrees with nothing."""


@numba.njit(**FAST)
def correlate_along_columns(normals: np.ndarray, taps: np.ndarray) -> None:
    """Take the moving sum along axis 1 of ``normals`` (f, h + q, w) with q + 1 ``taps``, in place: rows 0..h-1 are the
    result.

    A point's sum takes later points only, which are still as they were drawn.
    """
    fields, rows, columns = normals.shape
    q = taps.size - 1
    for f in range(fields):
        for v in range(rows - q):
            row = normals[f, v]
            for u in range(columns):
                row[u] *= taps[0]
            for j in range(1, q + 1):
                later = normals[f, v + j]
                tap = taps[j]
                for u in range(columns):
                    row[u] += tap * later[u]


@numba.njit(**FAST)
def stronger_peak(  # type: ignore[no-untyped-def]
    height, half_m, deviation_m, noise, normals, sweep_m, won_m, won_height, won_deviation_m
):
    """Choose the higher of two peaks after noise, with the noise of its range.

    ``height``, ``half_m``, ``deviation_m`` (2, h, w) of the two peaks; ``noise`` (h, w) deviation of a height;
    ``normals`` (3, h or more, w): of the two heights and of the winner's range; ``sweep_m`` (w,) added to a column.
    Writes half path, height and the expected deviation of the half path into arrays with a border of one pixel.
    """
    h, w = noise.shape
    for v in range(h):
        for u in range(w):
            a = height[0, v, u] + noise[v, u] * normals[0, v, u]
            b = height[1, v, u] + noise[v, u] * normals[1, v, u]
            second = b > a
            deviation = deviation_m[1, v, u] if second else deviation_m[0, v, u]
            place = half_m[1, v, u] if second else half_m[0, v, u]
            won_m[v + 1, u + 1] = place + deviation * normals[2, v, u] + sweep_m[u]
            won_height[v + 1, u + 1] = b if second else a
            won_deviation_m[v + 1, u + 1] = deviation


@numba.njit(**FAST)
def noise_peaks(  # type: ignore[no-untyped-def]
    weak, noise, uniforms, rate, bandwidth_m, unambiguous_m, won_m, won_height, won_deviation_m
):
    """Let the highest maximum of the noise over one period win where it exceeds the return; flat indices ``weak``.

    Rice: a level of x deviations is crossed upwards rate * exp(-x^2 / 2) times in a period; taken as Poisson, the
    highest maximum has P(< x) = exp(-rate exp(-x^2 / 2)), which is inverted. It lies anywhere in the period.
    ``bandwidth_m``: deviation of half the path at a height of one noise deviation.
    """
    w = noise.shape[1]
    for i in range(weak.size):
        v, u = weak[i] // w, weak[i] % w
        crossings = -np.log(max(uniforms[0, i], 1e-300))
        level = np.sqrt(2.0 * np.log(rate / crossings)) if crossings < rate else 0.0
        if level * noise[v, u] > won_height[v + 1, u + 1]:
            won_height[v + 1, u + 1] = level * noise[v, u]
            won_m[v + 1, u + 1] = uniforms[1, i] * unambiguous_m
            won_deviation_m[v + 1, u + 1] = bandwidth_m / max(level, 1.0)


@numba.njit(**FAST)
def smooth_and_gate(  # type: ignore[no-untyped-def]
    won_m, won_height, gate_m, side, along_m, cosine, saturated, limits, error_m, z_m, reason, strength
):
    """Average the 3 x 3 neighbours that agree, then range, gates and rounding.

    ``won_m``, ``won_height`` and ``gate_m`` (h + 2, w + 2): half path, height, and how far a neighbour's half path may
    differ. Weights: 1 in the centre, ``side`` beside, above and below it, its square in the corners. ``strength``
    (h, w): weighted sum of the agreeing heights over the weights of all neighbours in the picture. A pixel whose
    agreeing weights are a smaller share of all than wanted stands alone and is invalid.
    Half the path s by a receiver at e gives the range r = (4 s^2 - e.e) / (4 s - 2 u.e) along the unit ray u;
    ``along_m`` (h, w) is u.e, ``cosine`` (h, w) u_z. ``limits``: e.e, least strength, least
    agreeing share, least and greatest range, step.
    """
    h, w = cosine.shape
    e2, least, alike, nearest, farthest, step = limits
    one = np.float32(1)
    zero = np.float32(0)
    for v in range(h):
        tall = one + (side if v > 0 else zero) + (side if v < h - 1 else zero)
        for u in range(w):
            centre = won_m[v + 1, u + 1]
            gate = gate_m[v + 1, u + 1]
            moved = zero
            total = zero
            heights = zero
            for dy in range(3):
                for dx in range(3):
                    weight = (one if dy == 1 else side) * (one if dx == 1 else side)
                    off = won_m[v + dy, u + dx] - centre
                    weight = weight if abs(off) <= gate else zero
                    moved += weight * off
                    total += weight
                    heights += weight * won_height[v + dy, u + dx]
            wide = one + (side if u > 0 else zero) + (side if u < w - 1 else zero)
            everyone = tall * wide
            support = heights / everyone
            half = centre + moved / total + error_m
            range_m = (np.float32(4) * half * half - e2) / (np.float32(4) * half - np.float32(2) * along_m[v, u])
            code = np.int32(VALID)
            code = code if (range_m >= nearest) & (range_m <= farthest) else np.int32(OUT_OF_RANGE)
            code = code if total >= alike * everyone else np.int32(EDGE)
            code = code if support >= least else np.int32(LOW_AMPLITUDE)
            code = np.int32(SATURATED) if saturated[v, u] else code
            rounded = np.floor(range_m * cosine[v, u] / step + np.float32(0.5)) * step
            z_m[v, u] = rounded if code == np.int32(VALID) else np.float32(np.nan)
            reason[v, u] = np.uint8(code)
            strength[v, u] = max(support, zero)
