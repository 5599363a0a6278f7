"""Compiled inner loops of the scanned lidar: peaks of the correlation, choice of peak, smoothing,
gates. One thread.

A code of period T correlates to a pulse that repeats with T, so its spectrum is on the lines k /
T. The view's phasors on that comb are the spectrum H of all light paths within a beam. With
weights W, the correlation is c(t) = sum_k W_k Re(H_k exp(-2 pi i k t / T)) / sum_k W_k; a single
return of light a is a pulse of height a."""

from typing import NamedTuple

import numba
import numpy as np

from harness.vocabulary.geometry import Reason
from scenes.sensor.common.normals import FAST, IN_DOUBLE

# samples of the correlation per spectral line in a period; two just represent it, four miss no
# peak
SAMPLES_PER_LINE = 4
# from a sample's parabola: three converge to 1e-7 of a sample even where two pulses almost
# separate
NEWTON_STEPS = 4
NO_PEAK = -1e9  # height of a peak that does not exist


class CorrelationPeaks(NamedTuple):
    """The two strongest peaks of correlations, the stronger first."""

    delay: np.ndarray
    """(2, ...) float64: in periods, 0..1."""
    height: np.ndarray
    """(2, ...) float64: `NO_PEAK` if there is none."""
    curvature: np.ndarray
    """(2, ...) float64: minus the second derivative by the angle 2 pi t / T."""


def strongest_peaks(phasor: np.ndarray, weights: np.ndarray) -> CorrelationPeaks:
    """Find peaks of correlations with phasors (K, ...) on lines 1..K of the comb and the pulse's
    ``weights`` (K,)."""
    lines = len(phasor)
    shape = phasor.shape[1:]
    shares = (weights / weights.sum())[:, None].astype(np.float32)
    scaled = (phasor.reshape(lines, -1) * shares).T
    spectrum = np.empty((len(scaled), 2 * lines), np.float32)
    spectrum[:, :lines] = scaled.real
    spectrum[:, lines:] = scaled.imag
    # cosines and sines of the lines at the samples of one period, (2 K, M)
    samples = SAMPLES_PER_LINE * lines
    angle = 2 * np.pi * np.outer(np.arange(1, lines + 1), np.arange(samples)) / samples
    waves = np.concatenate([np.cos(angle), np.sin(angle)]).astype(np.float32)
    delay = np.empty((2, len(spectrum)))
    height = np.empty((2, len(spectrum)))
    curvature = np.empty((2, len(spectrum)))
    _peaks(spectrum @ waves, spectrum, delay, height, curvature)
    return CorrelationPeaks(
        delay=delay.reshape(2, *shape),
        height=height.reshape(2, *shape),
        curvature=curvature.reshape(2, *shape),
    )


@numba.njit(**IN_DOUBLE)
def _derivatives(spectrum: np.ndarray, angle: float) -> tuple[float, float, float]:
    """Return the correlation with ``spectrum`` (2 K,) at an angle, and its first and second
    derivative by the angle."""
    lines = spectrum.size // 2
    step_re = np.cos(angle)
    step_im = np.sin(angle)
    re = 1.0
    im = 0.0
    value = 0.0
    slope = 0.0
    bend = 0.0
    for k in range(lines):
        turned_re = re * step_re - im * step_im
        im = re * step_im + im * step_re
        re = turned_re
        a = spectrum[k]
        b = spectrum[lines + k]
        even = a * re + b * im
        order = k + 1.0
        value += even
        slope += order * (b * re - a * im)
        bend -= order * order * even
    return value, slope, bend


@numba.njit(**IN_DOUBLE)
def _refined(spectrum: np.ndarray, start: float, spacing: float) -> tuple[float, float, float]:
    """Return (angle, height, curvature) of the peak next to the sample at ``start``, at most one
    sample away."""
    angle = start
    for _ in range(NEWTON_STEPS):
        _, slope, bend = _derivatives(spectrum, angle)
        # where two pulses merge, the curve may be convex beside its peak: climb by half a sample
        step = -slope / bend if bend < 0.0 else np.sign(slope) * 0.5 * spacing
        angle = min(max(angle + step, start - spacing), start + spacing)
    value, _, bend = _derivatives(spectrum, angle)
    return angle, value, -bend


@numba.njit(**IN_DOUBLE)
def _peaks(
    samples: np.ndarray,
    spectrum: np.ndarray,
    delay: np.ndarray,
    height: np.ndarray,
    curvature: np.ndarray,
) -> None:
    """Find peaks among ``samples`` (n, M) and refine them on ``spectrum`` (n, 2 K); outputs (2,
    n)."""
    n, m = samples.shape
    spacing = 2.0 * np.pi / m
    for i in range(n):
        row = samples[i]
        first = -1
        second = -1
        for j in range(m):
            y = row[j]
            if y > 0.0 and y > row[j - 1] and y >= row[j + 1 if j + 1 < m else 0]:
                if first < 0 or y > row[first]:
                    second = first
                    first = j
                elif second < 0 or y > row[second]:
                    second = j
        for rank, sample in enumerate((first, second)):
            angle = 0.0
            top = NO_PEAK
            bend = 1.0
            if sample >= 0:
                angle, top, bend = _refined(spectrum[i], sample * spacing, spacing)
            delay[rank, i] = (angle / (2.0 * np.pi)) % 1.0
            height[rank, i] = top
            curvature[rank, i] = bend
        if height[1, i] > height[0, i]:
            for values in (delay, height, curvature):
                values[0, i], values[1, i] = values[1, i], values[0, i]


VALID = np.int32(Reason.VALID)
SATURATED = np.int32(Reason.SATURATED)
LOW_AMPLITUDE = np.int32(Reason.LOW_AMPLITUDE)
EDGE = np.int32(Reason.EDGE)
OUT_OF_RANGE = np.int32(Reason.OUT_OF_RANGE)
CHUNK = 256  # columns whose sums stand side by side: a loop that writes to one array is vectorised
NOWHERE_M = np.float32(1e9)  # half path beyond the picture's border: it agrees with nothing
ZERO = np.float32(0)
HALF = np.float32(0.5)
TWO = np.float32(2)
FOUR = np.float32(4)
NAN = np.float32(np.nan)


@numba.njit(**FAST)
def correlate_along_columns(normals: np.ndarray, taps: np.ndarray) -> None:
    """Take the moving sum along axis 1 of ``normals`` (f, h + q, w) with q + 1 ``taps``, in place,
    into rows 0..h-1."""
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
    height,
    half_m,
    deviation_m,
    noise,
    normals,
    sweep_m,
    won_m,
    won_height,
    won_deviation_m,
):
    """Choose the higher of two peaks after noise is added, with the noise of its range.

    Args:
        height, half_m, deviation_m: (2, h, w) of the peaks.
        noise: (h, w) deviation of a height.
        normals: (3, h or more, w) for both heights and the winner's range.
        sweep_m: (w,) added to each column's half path.
        won_m, won_height, won_deviation_m: (h, w) half path, height and deviation of the winner;
            written.
    """
    h, w = noise.shape
    for v in range(h):
        for u in range(w):
            first_height = height[0, v, u] + noise[v, u] * normals[0, v, u]
            second_height = height[1, v, u] + noise[v, u] * normals[1, v, u]
            second_wins = second_height > first_height
            deviation = deviation_m[1, v, u] if second_wins else deviation_m[0, v, u]
            half = half_m[1, v, u] if second_wins else half_m[0, v, u]
            won_m[v, u] = half + deviation * normals[2, v, u] + sweep_m[u]
            won_height[v, u] = second_height if second_wins else first_height
            won_deviation_m[v, u] = deviation


@numba.njit(**FAST)
def noise_peaks(  # type: ignore[no-untyped-def]
    weak,
    noise,
    averaged,
    uniforms,
    rate,
    bandwidth_m,
    unambiguous_m,
    won_m,
    won_height,
    won_deviation_m,
):
    """Let the highest maximum of the noise over one period win where it exceeds the return.

    Noise crosses a level of x deviations upwards rate * exp(-x^2 / 2) times in a period (Rice); if
    Poisson, the highest maximum has P(< x) = exp(-rate exp(-x^2 / 2)).

    Args:
        weak: (m,) flat indices of the pixels where noise may win.
        noise: (h, w) deviation of a height.
        averaged: share of it that the mean over neighbours leaves before the peak is found.
        uniforms: (2, m) random numbers in 0..1, for level and position.
        rate: upward crossings of 0 in a period.
        bandwidth_m: deviation of half the path at a height of one noise deviation.
        unambiguous_m: half the path of one period.
        won_m, won_height, won_deviation_m: (h, w) of the winner so far; changed.
    """
    w = noise.shape[1]
    for i in range(weak.size):
        v = weak[i] // w
        u = weak[i] % w
        crossings = -np.log(max(uniforms[0, i], 1e-300))
        level = np.sqrt(2.0 * np.log(rate / crossings)) if crossings < rate else 0.0
        height = level * averaged * noise[v, u]
        if height > won_height[v, u]:
            won_height[v, u] = height
            won_m[v, u] = uniforms[1, i] * unambiguous_m
            won_deviation_m[v, u] = bandwidth_m / max(level, 1.0)


@numba.njit(**FAST)
def smooth(  # type: ignore[no-untyped-def]
    half_m,
    share,
    height,
    gate_m,
    taps,
    along_rows,
    out_m,
    out_share,
    out_height,
):
    """Average the neighbours of a column, or of a row, that agree.

    Args:
        half_m, share, height: (h + 2 p, w + 2 q) half path, weight of what has agreed so far, and
            strength, with a border of p and q, at least r where the taps reach.
        gate_m: (h, w) largest difference of a neighbour's half path.
        taps: (2 r + 1,) weights.
        along_rows: whether neighbours stand in the same row.
        out_m, out_share, out_height: (h, w) mean half path, weight and strength of those that
            agree; written.
    """
    h, w = gate_m.shape
    p = (half_m.shape[0] - h) // 2
    q = (half_m.shape[1] - w) // 2
    r = taps.size // 2
    image = (half_m, share, height)
    sums = np.empty(3 * CHUNK, np.float32)
    for v in range(h):
        for start in range(0, w, CHUNK):
            n = min(CHUNK, w - start)
            sums[:] = ZERO
            pixels = (v + p, q + start)
            for k in range(-r, r + 1):
                neighbours = (v + p, q + start + k) if along_rows else (v + p + k, q + start)
                _add_agreeing(
                    image,
                    gate_m,
                    neighbours,
                    pixels,
                    (v, start),
                    n,
                    taps[k + r],
                    sums,
                )
            for u in range(n):
                out_m[v, start + u] = half_m[v + p, q + start + u] + sums[u] / sums[CHUNK + u]
                out_share[v, start + u] = sums[CHUNK + u]
                out_height[v, start + u] = sums[2 * CHUNK + u]


@numba.njit(**FAST)
def _add_agreeing(  # type: ignore[no-untyped-def]
    image,
    gate_m,
    neighbours,
    pixels,
    gates,
    n,
    tap,
    sums,
):
    """Add n neighbours of n pixels. ``neighbours``, ``pixels`` and ``gates``: (row, column) of the
    first of each. Images are passed whole, as a slice costs as much as tens of sums."""
    half_m, share, height = image
    row = np.uint64(neighbours[0])
    column = np.uint64(neighbours[1])
    pixel_row = np.uint64(pixels[0])
    pixel_column = np.uint64(pixels[1])
    v = np.uint64(gates[0])
    start = np.uint64(gates[1])
    for u in range(np.uint64(n)):
        off = half_m[row, column + u] - half_m[pixel_row, pixel_column + u]
        counted = tap if abs(off) <= gate_m[v, start + u] else ZERO
        weight = counted * share[row, column + u]
        sums[u] += weight * off
        sums[np.uint64(CHUNK) + u] += weight
        sums[np.uint64(2 * CHUNK) + u] += counted * height[row, column + u]


class DeviceLimits(NamedTuple):
    """Limits that the device sets to a smoothed half path."""

    receiver2_m2: np.float32
    """Squared distance from the transmitter to the receiver."""
    least_strength: np.float32
    """Smallest strength, electrons."""
    least_agreeing: np.float32
    """Smallest share of the weights that must agree."""
    nearest_m: np.float32
    """Smallest range along the ray."""
    farthest_m: np.float32
    """Greatest range along the ray."""
    step_m: np.float32
    """Step of the output's z."""


@numba.njit(**FAST)
def gated(  # type: ignore[no-untyped-def]
    half_m,
    share,
    height,
    whole_share,
    along_m,
    cosine,
    saturated,
    limits,
    error_m,
    z_m,
    reason,
    strength,
):
    """Convert smoothed half paths to ranges, with gates and rounding. Half the path s with a
    receiver at e gives the range r = (4 s^2 - e.e) / (4 s - 2 u.e) along the unit ray u.

    Args:
        half_m, share, height: (h, w) half path, weight and strength of the neighbours that agree.
        whole_share: (h, w) weight of all neighbours within the picture.
        along_m: (h, w) u.e.
        cosine: (h, w) u_z.
        saturated: (h, w) bool.
        limits: the `DeviceLimits`.
        error_m: displacement of the frame.
        z_m, reason, strength: (h, w); written.
    """
    h, w = cosine.shape
    step_m = limits.step_m
    for v in range(h):
        for u in range(w):
            support = height[v, u] / whole_share[v, u]
            half = half_m[v, u] + error_m
            path2_m2 = FOUR * half * half
            range_m = (path2_m2 - limits.receiver2_m2) / (FOUR * half - TWO * along_m[v, u])
            in_range = (range_m >= limits.nearest_m) & (range_m <= limits.farthest_m)
            code = VALID if in_range else OUT_OF_RANGE
            code = code if share[v, u] >= limits.least_agreeing * whole_share[v, u] else EDGE
            code = code if support >= limits.least_strength else LOW_AMPLITUDE
            code = SATURATED if saturated[v, u] else code
            steps = np.floor(range_m * cosine[v, u] / step_m + HALF)
            z_m[v, u] = steps * step_m if code == VALID else NAN
            reason[v, u] = np.uint8(code)
            strength[v, u] = max(support, ZERO)
