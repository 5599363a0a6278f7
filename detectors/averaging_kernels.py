"""Compiled inner loops of averaging, and the sums that they fill."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from harness.vocabulary.capture import Frame, Reason
from harness.vocabulary.errors import UserError

N_REASONS = max(Reason) + 1


@numba.njit(cache=True, nogil=True)
def _median_of(values: np.ndarray, n: int) -> float:
    """Median of ``values[:n]``, n >= 1, which are left sorted (insertion sort: n is a number of frames)."""
    for i in range(1, n):
        value = values[i]
        j = i - 1
        while j >= 0 and values[j] > value:
            values[j + 1] = values[j]
            j -= 1
        values[j + 1] = value
    return 0.5 * (values[(n - 1) // 2] + values[n // 2])


@numba.njit(cache=True, nogil=True)
def pixel_medians(stack: np.ndarray) -> np.ndarray:
    """Median over the finite samples of each pixel: (r, n) float32 to (n,) float32, NaN where there is none."""
    frames, pixels = stack.shape
    medians = np.empty(pixels, dtype=np.float32)
    values = np.empty(frames, dtype=np.float32)
    for i in range(pixels):
        n = 0
        for r in range(frames):
            if np.isfinite(stack[r, i]):
                values[n] = stack[r, i]
                n += 1
        if n > 24:
            medians[i] = np.median(values[:n])
        else:
            medians[i] = _median_of(values, n) if n > 0 else np.nan
    return medians


@numba.njit(cache=True, nogil=True)
def sampled_change(
    z_m: np.ndarray, sample: np.ndarray, reference_m: np.ndarray, change_m: float
) -> tuple[float, float]:
    """Shift of a frame against the reference on the sampled pixels, and the fraction that changed beside the shift.

    The shift is the median difference in metres (NaN if no sampled pixel is valid); a pixel changed if it lost its
    range or differs from the shifted reference by more than ``change_m``.
    """
    differences = np.empty(len(sample), dtype=np.float32)
    n = 0
    for k in range(len(sample)):
        difference = z_m[sample[k]] - reference_m[k]
        if np.isfinite(difference):
            differences[n] = difference
            n += 1
    if n == 0:
        return np.nan, 1.0
    shift = np.median(differences[:n])
    changed = len(sample) - n
    for k in range(n):
        if abs(differences[k] - shift) > change_m:
            changed += 1
    return float(shift), changed / len(sample)


@numba.njit(cache=True, nogil=True)
def _add_frame(
    z_m: np.ndarray,
    reason: np.ndarray,
    offset_m: np.ndarray,
    gate_m: np.ndarray,
    count: np.ndarray,
    total: np.ndarray,
    squares: np.ndarray,
    used: np.ndarray,
    reasons: np.ndarray,
) -> None:
    """Add one frame's z to the sums (all flat). ``gate_m`` is empty where nothing is clipped."""
    clipped = len(gate_m) > 0
    for i in range(len(z_m)):
        z = np.float64(z_m[i])
        used[i] = 0
        if not np.isfinite(z):
            reasons[reason[i] if reason[i] > 0 else 10, i] += 1
            continue
        if np.isnan(offset_m[i]):
            offset_m[i] = z
        deviation = z - offset_m[i]
        # a pixel that the first frames never saw has no gate (NaN) and takes every sample
        if clipped and abs(deviation) > gate_m[i]:
            continue
        used[i] = 1
        count[i] += 1
        total[i] += deviation
        squares[i] += deviation * deviation


@numba.njit(cache=True, nogil=True)
def _add_where(values: np.ndarray, used: np.ndarray, total: np.ndarray, count: np.ndarray) -> None:
    """Add ``values`` (n, c) to ``total`` where they are used and finite; ``count`` (n, c)."""
    for i in range(values.shape[0]):
        if used[i]:
            for c in range(values.shape[1]):
                if np.isfinite(values[i, c]):
                    total[i, c] += values[i, c]
                    count[i, c] += 1


class _Channel:
    """The running mean of a further channel (xy, amplitude) over the samples that the depth used."""

    def __init__(self, values: np.ndarray, channels: int) -> None:
        self.total = np.zeros((values.size // channels, channels))
        self.count = np.zeros(self.total.shape, dtype=np.int32)

    def add(self, values: np.ndarray, used: np.ndarray) -> None:
        _add_where(values.reshape(self.total.shape), used, self.total, self.count)

    def mean(self) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return self.total / self.count


class _Colour:
    """The mean colour over the used frames; a source that hands out one picture again and again costs nothing."""

    def __init__(self, rgb: np.ndarray) -> None:
        self._total = np.zeros(rgb.shape, dtype=np.uint32)
        self._latest = rgb
        self._repeats = 0
        self._frames = 0

    def add(self, rgb: np.ndarray) -> None:
        if rgb is not self._latest:
            self._flush()
            self._latest = rgb
        self._repeats += 1

    def mean(self) -> np.ndarray:
        self._flush()
        return np.round(self._total / self._frames).astype(np.uint8)

    def _flush(self) -> None:
        self._total += self._latest.astype(np.uint32) * np.uint32(self._repeats)
        self._frames += self._repeats
        self._repeats = 0


class FrameSums:
    """Sums from which the mean cloud follows: float64 of z less a per-pixel offset, so that squares keep their digits.

    ``offset_m`` (n,) any z near the pixel's samples (NaN: the first sample is taken); ``gate_m`` (n,) the largest
    deviation from it that is used, None to use all.
    """

    def __init__(self, offset_m: np.ndarray, gate_m: np.ndarray | None) -> None:
        n = offset_m.size
        self._offset = offset_m.astype(np.float64)
        self._gate = np.empty(0, dtype=np.float32) if gate_m is None else gate_m
        self.count = np.zeros(n, dtype=np.int32)
        self._total = np.zeros(n)
        self._squares = np.zeros(n)
        self._used = np.zeros(n, dtype=np.uint8)
        self._reasons = np.zeros((N_REASONS, n), dtype=np.uint16)
        self._frames = 0
        self._shape: tuple[int, ...] = (n,)
        self._xy: _Channel | None = None
        self._amplitude: _Channel | None = None
        self._colour: _Colour | None = None

    def add(self, frame: Frame) -> None:
        """Add one frame (h, w); all frames have one size."""
        self._shape = frame.z_m.shape
        self._frames += 1
        sums = (self._offset, self._gate, self.count, self._total, self._squares, self._used, self._reasons)
        _add_frame(frame.z_m.ravel(), frame.reason.ravel(), *sums)
        if frame.xy_m is not None:
            self._xy = self._xy or _Channel(frame.xy_m, 2)
            self._xy.add(frame.xy_m, self._used)
        if frame.amplitude is not None:
            self._amplitude = self._amplitude or _Channel(frame.amplitude, 1)
            self._amplitude.add(frame.amplitude, self._used)
        if frame.rgb is not None:
            self._colour = self._colour or _Colour(frame.rgb)
            self._colour.add(frame.rgb)

    def z(self) -> np.ndarray:
        """(n,) the average, NaN where no sample was used."""
        with np.errstate(invalid="ignore"):
            return self._offset + self._total / self.count

    def parts(self, slopes: np.ndarray | None) -> dict[str, Any]:
        """The measured fields of a `harness.vocabulary.capture.Cloud`."""
        z = self.z().reshape(self._shape)
        xy = slopes * z[..., None] if slopes is not None else self._mean_xy()
        return {
            "points_m": np.concatenate([xy, z[..., None]], axis=-1),
            "reason": self._commonest_reason(),
            "count": self.count.reshape(self._shape).copy(),
            "variance_m2": self._variance().reshape(self._shape),
            "n_frames": self._frames,
            "rgb": None if self._colour is None else self._colour.mean(),
            "amplitude": None if self._amplitude is None else self._amplitude.mean().reshape(self._shape),
        }

    def _mean_xy(self) -> np.ndarray:
        if self._xy is None:
            raise ValueError("a source without slopes must give each frame its xy_m")
        return self._xy.mean().reshape(*self._shape, 2)

    def _variance(self) -> np.ndarray:
        with np.errstate(invalid="ignore", divide="ignore"):
            variance = (self._squares - self._total**2 / self.count) / (self.count - 1)
        return np.where(self.count > 1, np.maximum(variance, 0.0), np.nan)

    def _commonest_reason(self) -> np.ndarray:
        reason = np.zeros(self.count.shape, dtype=np.uint8)
        never = np.flatnonzero(self.count == 0)
        reason[never] = np.argmax(self._reasons[:, never], axis=0)
        return reason.reshape(self._shape)


class FrameStack(FrameSums):
    """The median: the sums give count and variance, and every frame's z is kept (float32)."""

    def __init__(self, offset_m: np.ndarray, memory_bytes: int) -> None:
        super().__init__(offset_m, None)
        self._stack: list[np.ndarray] = []
        self._memory_bytes = memory_bytes

    def add(self, frame: Frame) -> None:
        """Add one frame. Raises UserError where the stack would outgrow its memory."""
        # the stack is copied once into one block when the median is taken
        needed = 2 * 4 * frame.z_m.size * (len(self._stack) + 1)
        if needed > self._memory_bytes:
            raise UserError(
                f"{frame.name}: the median of {len(self._stack) + 1} frames of {frame.z_m.size} pixels needs"
                f" {needed / 1e6:.0f} MB, more than median_memory_mb = {self._memory_bytes / 1e6:.0f}",
                legal=f"up to {len(self._stack)} frames",
                fix="use method clipped (constant memory), fewer frames, or raise median_memory_mb",
            )
        self._stack.append(frame.z_m.ravel().astype(np.float32))
        super().add(frame)

    def z(self) -> np.ndarray:
        return pixel_medians(np.stack(self._stack)).astype(np.float64)
