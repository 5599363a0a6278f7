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
from scenes.sensor.normals import FAST, IN_DOUBLE

SAMPLES_PER_LINE = (
    4  # of the correlation per spectral line in a period; two just represent it, four miss no peak
)
# from a sample's parabola: three converge to 1e-7 of a sample even where two pulses almost
# separate
NEWTON_STEPS = 4
NO_PEAK = -1e9  # height of a peak that does not exist


class Peaks(NamedTuple):
    """The two strongest peaks of correlations, the stronger first; all (2, ...) float64.
    ``delay``: in periods, 0..1. ``height``: `NO_PEAK` if there is none. ``curvature``: minus the
    second derivative by the angle 2 pi t / T."""

    delay: np.ndarray
    height: np.ndarray
    curvature: np.ndarray


def strongest_peaks(phasor: np.ndarray, weights: np.ndarray) -> Peaks:
    """Find peaks of correlations with phasors (K, ...) on lines 1..K of the comb and the pulse's
    ``weights`` (K,)."""
    lines, *shape = phasor.shape
    scaled = (phasor.reshape(lines, -1) * (weights / weights.sum())[:, None].astype(np.float32)).T
    spectrum = np.empty((len(scaled), 2 * lines), np.float32)
    spectrum[:, :lines], spectrum[:, lines:] = scaled.real, scaled.imag
    # cosines and sines of the lines at the samples of one period, (2 K, M)
    samples = SAMPLES_PER_LINE * lines
    angle = 2 * np.pi * np.outer(np.arange(1, lines + 1), np.arange(samples)) / samples
    waves = np.concatenate([np.cos(angle), np.sin(angle)]).astype(np.float32)
    out = np.empty((3, 2, len(spectrum)))
    _peaks(spectrum @ waves, spectrum, *out)
    return Peaks(*out.reshape(3, 2, *shape))


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
        re, im = re * step_re - im * step_im, re * step_im + im * step_re
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
                    first, second = j, first
                elif second < 0 or y > row[second]:
                    second = j
        for rank, at in enumerate((first, second)):
            angle = 0.0
            top = NO_PEAK
            bend = 1.0
            if at >= 0:
                angle, top, bend = _refined(spectrum[i], at * spacing, spacing)
            delay[rank, i] = (angle / (2.0 * np.pi)) % 1.0
            height[rank, i] = top
            curvature[rank, i] = bend
        if height[1, i] > height[0, i]:
            for out in (delay, height, curvature):
                out[0, i], out[1, i] = out[1, i], out[0, i]


VALID, SATURATED, LOW_AMPLITUDE, EDGE, OUT_OF_RANGE = map(
    np.int32,
    (Reason.VALID, Reason.SATURATED, Reason.LOW_AMPLITUDE, Reason.EDGE, Reason.OUT_OF_RANGE),
)
NOWHERE_M = np.float32(1e9)  # half path beyond the picture's border: it agrees with nothing


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
    height, half_m, deviation_m, noise, normals, sweep_m, won_m, won_height, won_deviation_m
):
    """Choose the higher of two peaks after noise is added, with the noise of its range.
    ``height``, ``half_m``, ``deviation_m`` (2, h, w): of the peaks. ``noise`` (h, w): deviation of
    a height. ``normals`` (3, h or more, w): for both heights and the winner's range. ``sweep_m``
    (w,): added to each column. Writes into the last three, (h, w)."""
    h, w = noise.shape
    for v in range(h):
        for u in range(w):
            a = height[0, v, u] + noise[v, u] * normals[0, v, u]
            b = height[1, v, u] + noise[v, u] * normals[1, v, u]
            second = b > a
            deviation = deviation_m[1, v, u] if second else deviation_m[0, v, u]
            place = half_m[1, v, u] if second else half_m[0, v, u]
            won_m[v, u] = place + deviation * normals[2, v, u] + sweep_m[u]
            won_height[v, u] = b if second else a
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
    """Let the highest maximum of the noise over one period win where it exceeds the return, at
    flat indices ``weak``. Noise crosses a level of x deviations upwards rate * exp(-x^2 / 2) times
    in a period (Rice); if Poisson, the highest maximum has P(< x) = exp(-rate exp(-x^2 / 2)).
    ``averaged``: share of the noise that the mean over neighbours leaves before the peak is found.
    ``bandwidth_m``: deviation of half the path at one noise deviation."""
    w = noise.shape[1]
    for i in range(weak.size):
        v = weak[i] // w
        u = weak[i] % w
        crossings = -np.log(max(uniforms[0, i], 1e-300))
        level = np.sqrt(2.0 * np.log(rate / crossings)) if crossings < rate else 0.0
        tall = level * averaged * noise[v, u]
        if tall > won_height[v, u]:
            won_height[v, u] = tall
            won_m[v, u] = uniforms[1, i] * unambiguous_m
            won_deviation_m[v, u] = bandwidth_m / max(level, 1.0)


@numba.njit(**FAST)
def smooth(  # type: ignore[no-untyped-def]
    half_m, share, height, gate_m, taps, along_rows, out_m, out_share, out_height
):
    """Average the neighbours of a column (or of a row, with ``along_rows``) that agree, with
    ``taps`` (2 r + 1,). ``half_m``, ``share``, ``height`` (h + 2 p, w + 2 q), with a border of p
    and q at least r where the taps reach: half path, weight of what has agreed so far, and
    strength. ``gate_m`` (h, w): largest difference of a neighbour's half path. Writes the mean
    half path, the weight and the strength of those that agree, (h, w) each."""
    h, w = gate_m.shape
    p = (half_m.shape[0] - h) // 2
    q = (half_m.shape[1] - w) // 2
    r = taps.size // 2
    image = (half_m, share, height)
    sums = np.empty(3 * CHUNK, np.float32)
    for v in range(h):
        for start in range(0, w, CHUNK):
            n = min(CHUNK, w - start)
            sums[:] = np.float32(0)
            for k in range(-r, r + 1):
                near = (v + p, q + start + k) if along_rows else (v + p + k, q + start)
                _add_agreeing(
                    image, gate_m, near, (v + p, q + start), (v, start), n, taps[k + r], sums
                )
            for u in range(n):
                out_m[v, start + u] = half_m[v + p, q + start + u] + sums[u] / sums[CHUNK + u]
                out_share[v, start + u] = sums[CHUNK + u]
                out_height[v, start + u] = sums[2 * CHUNK + u]


CHUNK = 256  # columns whose sums stand side by side: a loop that writes to one array is vectorised


@numba.njit(**FAST)
def _add_agreeing(image, gate_m, near, own, at, n, tap, sums):  # type: ignore[no-untyped-def]
    """Add n neighbours, from the place ``near`` on, of the pixels from ``own`` on, whose gates
    begin at ``at``. Images are passed whole, as a slice costs as much as tens of sums."""
    (half_m, share, height), row, column = image, np.uint64(near[0]), np.uint64(near[1])
    own_row = np.uint64(own[0])
    own_column = np.uint64(own[1])
    v = np.uint64(at[0])
    start = np.uint64(at[1])
    for u in range(np.uint64(n)):
        off = half_m[row, column + u] - half_m[own_row, own_column + u]
        counted = tap if abs(off) <= gate_m[v, start + u] else np.float32(0)
        weight = counted * share[row, column + u]
        sums[u] += weight * off
        sums[np.uint64(CHUNK) + u] += weight
        sums[np.uint64(2 * CHUNK) + u] += counted * height[row, column + u]


@numba.njit(**FAST)
def gated(  # type: ignore[no-untyped-def]
    half_m,
    share,
    height,
    everyone,
    along_m,
    cosine,
    saturated,
    limits,
    error_m,
    z_m,
    reason,
    strength,
):
    """Convert smoothed half paths (h, w) to ranges, with gates and rounding. ``share``,
    ``height``: weight and strength of the neighbours that agree. ``everyone``: weight of all
    within the picture. Half the path s with a receiver at e gives the range r = (4 s^2 - e.e) / (4
    s - 2 u.e) along the unit ray u; ``along_m`` is u.e, ``cosine`` u_z. ``limits``: e.e, least
    strength, least agreeing share, least and greatest range, step."""
    h, w = cosine.shape
    e2, least, alike, nearest, farthest, step = limits
    for v in range(h):
        for u in range(w):
            support = height[v, u] / everyone[v, u]
            half = half_m[v, u] + error_m
            range_m = (np.float32(4) * half * half - e2) / (
                np.float32(4) * half - np.float32(2) * along_m[v, u]
            )
            code = VALID if (range_m >= nearest) & (range_m <= farthest) else OUT_OF_RANGE
            code = code if share[v, u] >= alike * everyone[v, u] else EDGE
            code = code if support >= least else LOW_AMPLITUDE
            code = SATURATED if saturated[v, u] else code
            rounded = np.floor(range_m * cosine[v, u] / step + np.float32(0.5)) * step
            z_m[v, u] = rounded if code == VALID else np.float32(np.nan)
            reason[v, u] = np.uint8(code)
            strength[v, u] = max(support, np.float32(0))
