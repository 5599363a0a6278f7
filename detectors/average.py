"""Streamed averages that make one cloud of frames; frames that do not belong are noticed, left out and named.

The camera is taken to stand still before a static scene. Judging uses the first `REFERENCE_FRAMES` frames as reference,
so a source whose first frames are mostly bad, or a camera that is moved during the capture, is not healed: every frame
after the move is left out and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numba
import numpy as np
from pydantic import Field

from harness.vocabulary.capture import Cloud, Frame, FrameSource, LeftOut, Reason
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM

REFERENCE_FRAMES = 5
"""The median of five survives two bad frames, wherever they stand, and needs no more memory than five frames."""
SAMPLED_PIXELS = 4096
"""Pixels on which a frame is judged: a changed fraction of 5 % is then known to 0.35 %, a shift to 0.02 sigma."""
CORRELATED_PIXELS = 25
"""Pixels that share one noise value in the worst case: a depth engine that filters over 5x5."""
SMALL_MEDIAN = 24
"""Frames up to which an insertion sort is the quickest way to a median."""


class AverageConfig(Config):
    """Settings that say how frames become one cloud, and when a frame is left out.

    ``method``: ``mean`` as in the thesis; ``median`` per pixel (holds all frames' z in memory); ``clipped``: mean of
    the samples within ``clip_sigmas`` of the pixel's median over the first five frames (streams; plain mean below three
    frames). ``frames``: use the first so many; None means all.

    A frame *jumps* if the median over pixels of its difference to the reference exceeds the larger of ``jump_sigmas``
    standard errors of that median and ``jump_mm``. 3 mm is ten times the largest wander of a static Azure Kinect's
    frame (0.3 mm over 22 frames of a wall), and the faults of real captures are larger (17 mm). A frame is *disturbed*
    if more than ``disturbed_fraction`` of its pixels (beyond 1.5 times what the reference frames show) lost their
    range or changed by more than the larger of ``changed_sigmas`` of one frame's noise and ``changed_mm``; in static
    captures 0.3 % change by 6 mm.
    """

    method: Literal["mean", "median", "clipped"] = "mean"
    frames: int | None = Field(default=None, ge=1)
    judge_frames: bool = True
    jump_mm: float = Field(default=3.0, gt=0)
    jump_sigmas: float = Field(default=6.0, gt=0)
    changed_mm: float = Field(default=6.0, gt=0)
    changed_sigmas: float = Field(default=6.0, gt=0)
    disturbed_fraction: float = Field(default=0.05, gt=0, le=1)
    clip_sigmas: float = Field(default=5.0, ge=2)
    median_memory_mb: float = Field(default=2000.0, gt=0)


def average(source: FrameSource, config: AverageConfig) -> Cloud:
    """Average a source's frames.

    Raises UserError where the source has fewer frames than asked for, frames of different sizes, no valid pixel at all,
    or more frames than the median's memory allows.
    """
    running = RunningAverage(source, config)
    for frame in islice(source.frames(), config.frames):
        running.add(frame)
    if config.frames is not None and running.offered < config.frames:
        raise _too_few(source, config.frames, running.offered)
    return running.cloud()


def prefix_averages(source: FrameSource, counts: Sequence[int], config: AverageConfig) -> dict[int, Cloud]:
    """Average the first ``n`` frames for each ``n`` in ``counts``, in one pass.

    Equal to ``average`` with ``frames`` = n, bit by bit; ``config.frames`` is not used. Raises UserError as `average`.
    """
    wanted = sorted(set(counts))
    if not wanted or wanted[0] < 1:
        raise UserError(f"numbers of frames to average: {list(counts)}", legal="one or more whole numbers from 1")
    running = RunningAverage(source, config)
    clouds: dict[int, Cloud] = {}
    for frame in islice(source.frames(), wanted[-1]):
        running.add(frame)
        if running.offered in wanted:
            clouds[running.offered] = running.cloud()
    if running.offered < wanted[-1]:
        raise _too_few(source, wanted[-1], running.offered)
    return clouds


def _too_few(source: FrameSource, wanted: int, found: int) -> UserError:
    return UserError(
        f"{source.name}: {wanted} frames to average, but there are {found}",
        legal=f"1 to {found} frames" if found else None,
        fix="ask for fewer frames, or leave the number out to use all" if found else "check the path",
    )


class RunningAverage:
    """An average that can be read at any time while frames are added.

    The first five frames are held until the fifth arrives, because the reference is their median; from then on ``mean``
    and ``clipped`` need constant memory (about 100 bytes a pixel). Reading early judges by the frames so far.
    """

    def __init__(self, source: FrameSource, config: AverageConfig) -> None:
        self._source = source
        self._config = config
        self._slopes = source.slopes
        self._held: list[Frame] = []
        self._sums: _Sums | None = None
        self._shape = None if self._slopes is None else self._slopes.shape[:2]
        self.offered = 0
        """Frames added so far, those left out included."""

    def add(self, frame: Frame) -> None:
        """Take one more frame. Raises UserError where its size differs from the first frame's."""
        self._shape = self._shape or frame.z_m.shape
        if frame.z_m.shape != self._shape:
            sizes = [f"{w} x {h} pixels" if h > 1 else f"{w} points" for h, w in (frame.z_m.shape, self._shape)]
            raise UserError(
                f"{frame.name}: {sizes[0]}, but {sizes[1]} expected",
                legal="frames of one size, pixel by pixel on the same grid",
                fix="average only frames of one camera mode; average unorganised clouds one at a time",
            )
        self.offered += 1
        if self._sums is not None:
            self._sums.take(frame)
            return
        self._held.append(frame)
        if len(self._held) == REFERENCE_FRAMES:
            self._sums = self._settled()
            self._held = []

    def cloud(self) -> Cloud:
        """Return the average of the frames so far. Raises UserError where no frame has a valid pixel."""
        if self.offered == 0:
            raise UserError(f"{self._source.name}: no frames to average", fix="check the path")
        sums = self._sums or self._settled()
        if not sums.count.any():
            named = "; ".join(f"{left.name}: {left.why}" for left in sums.left_out[:3])
            raise UserError(
                f"{self._source.name}: no pixel has a range in any frame" + (f" ({named})" if named else ""),
                legal="at least one frame with valid depth",
                fix="check the files, their unit and the camera's mode",
            )
        return sums.cloud(self._source, self._slopes)

    def _settled(self) -> _Sums:
        sums = _Sums(_Reference.of(self._held, self._source.z_step_m, self._config), self._config)
        for frame in self._held:
            sums.take(frame)
        return sums


# ---------------------------------------------------------------- frames that belong


@dataclass(frozen=True)
class _Reference:
    """A good frame as the first frames show it: ``z_m`` (n,) median of those that agree; ``spread_m`` (n,) largest
    credible deviation of one frame per pixel, the gate of the clipped mean; ``sample`` (s,) flat indices of the judged
    pixels, all valid in the reference, and their z; and the limits to keep."""

    z_m: np.ndarray
    spread_m: np.ndarray
    sample: np.ndarray
    sampled_z_m: np.ndarray
    jump_m: float
    change_m: float
    fraction: float
    frames: int

    @classmethod
    def of(cls, frames: list[Frame], z_step_m: float, config: AverageConfig) -> _Reference:
        stack = np.stack([frame.z_m.ravel() for frame in frames]).astype(np.float32, copy=False)
        finite = np.isfinite(stack)
        usable = np.flatnonzero(2 * finite.sum(axis=0) > finite.any(axis=1).sum())
        sample = usable[:: max(1, -(-len(usable) // SAMPLED_PIXELS))]
        sampled = stack[:, sample]
        # the frame nearest to the others in range (the earliest on a tie), and each frame's shift against it
        between = np.array([[_median_finite(a - b) for b in sampled] for a in sampled])
        distances = np.sort(np.where(np.isfinite(between), np.abs(between), np.inf), axis=1)
        middle = int(np.argmin(distances[:, len(sampled) // 2]))
        shifts = between[:, middle]
        # robust standard deviation of one frame's z, at least that of the rounding
        deviations = [row - sampled[middle] for i, row in enumerate(sampled) if i != middle]
        spreads = [_median_finite(np.abs(d - _median_finite(d))) / 0.6745 / np.sqrt(2.0) for d in deviations]
        sigma = max(_median_finite(np.array(spreads)) if spreads else 0.0, z_step_m / np.sqrt(12.0), 1e-9)
        # standard error of a median is 1.25 that of a mean; two frames are compared
        standard_error = 1.2533 * sigma * np.sqrt(2.0 * CORRELATED_PIXELS / max(len(sample), CORRELATED_PIXELS))
        jump = max(config.jump_sigmas * standard_error, config.jump_mm * MM)
        agreeing = stack[np.abs(shifts) <= jump]
        # the median of two frames is their mean, which a fault in either spoils
        z = _pixel_medians(agreeing) if len(agreeing) > 2 else stack[middle]
        change = max(config.changed_sigmas * sigma, config.changed_mm * MM)
        usual = [_sampled_change(row, sample, z[sample], change)[1] for row in agreeing]
        # the reference frames look better than others, because they chose the pixels that are judged
        fraction = config.disturbed_fraction + 1.5 * float(np.median(usual)) if usual else 1.0
        spread = np.full(z.shape, np.inf, dtype=np.float32)
        if len(agreeing) > 2:
            # some sigmas of the frame or, where larger, of the pixel itself
            own = _pixel_medians(np.abs(agreeing - z)) / np.float32(0.6745)
            spread = np.asarray(config.clip_sigmas * np.fmax(own, np.float32(sigma)), dtype=np.float32)
        return cls(z, spread, sample, z[sample], jump, change, min(fraction, 1.0), len(frames))

    def fault(self, frame: Frame) -> str | None:
        """Return why this frame does not belong, None if it does."""
        if len(self.sample) == 0:
            return None
        shift, fraction = _sampled_change(frame.z_m.ravel(), self.sample, self.sampled_z_m, self.change_m)
        against = f"the first {self.frames} frames" if self.frames > 2 else "the first frame"
        if not np.isfinite(shift):
            return "no pixel has a range"
        if abs(shift) > self.jump_m:
            return (
                f"the whole range jumps by {shift / MM:+.1f} mm against {against} (allowed {self.jump_m / MM:.1f} mm)"
            )
        if fraction > self.fraction:
            return (
                f"disturbed: {100 * fraction:.1f} % of the pixels lost their range or changed by more than"
                f" {self.change_m / MM:.1f} mm against {against} (allowed {100 * self.fraction:.1f} %)"
            )
        return None


def _median_finite(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


# ---------------------------------------------------------------- sums over frames


class _Sums:
    """Frames are judged one by one, and those that belong are summed, from which the mean cloud follows: float64 of z
    less a per-pixel offset, so that squares keep their digits.

    The offset is the reference's z, or the first sample where it has none; the clipped mean uses no larger deviation
    from it than the reference's spread. For the median every frame's z is kept too (float32).
    """

    def __init__(self, reference: _Reference, config: AverageConfig) -> None:
        self._reference = reference
        self._config = config
        n = reference.z_m.size
        self._offset = reference.z_m.astype(np.float64)
        self._gate = reference.spread_m if config.method == "clipped" else np.empty(0, dtype=np.float32)
        self._stack: list[np.ndarray] = []
        self._total = np.zeros(n)
        self._squares = np.zeros(n)
        self._used = np.zeros(n, dtype=np.uint8)
        self._reasons = np.zeros((max(Reason) + 1, n), dtype=np.uint16)
        self._frames = 0
        self._shape: tuple[int, ...] = (n,)
        self._channels: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._rgb: np.ndarray | None = None
        self._rgb_total: np.ndarray | None = None
        self._rgb_repeats = self._rgb_frames = 0
        self.count = np.zeros(n, dtype=np.int32)
        """(n,) samples used."""
        self.left_out: list[LeftOut] = []

    def take(self, frame: Frame) -> None:
        """Add one frame (h, w), or leave it out; all frames have one size. Raises UserError where the median's frames
        would outgrow their memory."""
        fault = self._reference.fault(frame) if self._config.judge_frames else None
        if fault is not None:
            self.left_out.append(LeftOut(frame.name, fault))
            return
        z = frame.z_m.ravel()
        if self._config.method == "median":
            self._keep(frame.name, z)
        self._shape = frame.z_m.shape
        self._frames += 1
        sums = (self._offset, self._gate, self.count, self._total, self._squares, self._used, self._reasons)
        _add_frame(z, frame.reason.ravel(), *sums)
        # further channels over the samples that the depth used
        for name, values, width in (("xy", frame.xy_m, 2), ("amplitude", frame.amplitude, 1)):
            if values is not None:
                if name not in self._channels:
                    self._channels[name] = np.zeros((z.size, width)), np.zeros((z.size, width), dtype=np.int32)
                _add_where(values.reshape(-1, width), self._used, *self._channels[name])
        # a source that hands out one picture again and again costs nothing
        if frame.rgb is not None:
            if frame.rgb is not self._rgb:
                self._sum_colours()
                self._rgb = frame.rgb
            self._rgb_repeats += 1

    def _keep(self, name: str, z: np.ndarray) -> None:
        # the stack is copied once into one block when the median is taken
        kept, allowed = len(self._stack), int(self._config.median_memory_mb * 1e6)
        needed = 2 * 4 * z.size * (kept + 1)
        if needed > allowed:
            raise UserError(
                f"{name}: the median of {kept + 1} frames of {z.size} pixels needs"
                f" {needed / 1e6:.0f} MB, more than median_memory_mb = {allowed / 1e6:.0f}",
                legal=f"up to {kept} frames",
                fix="use method clipped (constant memory), fewer frames, or raise median_memory_mb",
            )
        self._stack.append(z.astype(np.float32))

    def _sum_colours(self) -> None:
        if self._rgb is not None:
            if self._rgb_total is None:
                self._rgb_total = np.zeros(self._rgb.shape, dtype=np.uint32)
            self._rgb_total += self._rgb.astype(np.uint32) * np.uint32(self._rgb_repeats)
        self._rgb_frames += self._rgb_repeats
        self._rgb_repeats = 0

    def cloud(self, source: FrameSource, slopes: np.ndarray | None) -> Cloud:
        """Return the average of the frames so far; NaN where no sample was used."""
        with np.errstate(invalid="ignore", divide="ignore"):
            z = self._offset + self._total / self.count
            variance = (self._squares - self._total**2 / self.count) / (self.count - 1)
            means = {name: total / count for name, (total, count) in self._channels.items()}
        if self._config.method == "median":
            z = _pixel_medians(np.stack(self._stack)).astype(np.float64)
        z = z.reshape(self._shape)
        if slopes is None and "xy" not in means:
            raise ValueError("a source without slopes must give each frame its xy_m")
        xy = slopes * z[..., None] if slopes is not None else means["xy"].reshape(*self._shape, 2)
        never = np.flatnonzero(self.count == 0)
        reason = np.zeros(self.count.shape, dtype=np.uint8)
        reason[never] = np.argmax(self._reasons[:, never], axis=0)
        self._sum_colours()
        colour = None if self._rgb_total is None else np.round(self._rgb_total / self._rgb_frames).astype(np.uint8)
        return Cloud(
            points_m=np.concatenate([xy, z[..., None]], axis=-1),
            reason=reason.reshape(self._shape),
            count=self.count.reshape(self._shape).copy(),
            variance_m2=np.where(self.count > 1, np.maximum(variance, 0.0), np.nan).reshape(self._shape),
            region=source.region,
            z_step_m=source.z_step_m,
            n_frames=self._frames,
            organised=source.organised,
            lens=source.lens,
            rgb=colour,
            amplitude=means["amplitude"].reshape(self._shape) if "amplitude" in means else None,
            left_out=tuple(self.left_out),
        )


# ---------------------------------------------------------------- compiled loops


@numba.njit(cache=True, nogil=True)
def _pixel_medians(stack: np.ndarray) -> np.ndarray:
    """Return the median (n,) float32 of each pixel's finite samples in (r, n) float32; NaN where there is none."""
    frames, pixels = stack.shape
    medians = np.empty(pixels, dtype=np.float32)
    values = np.empty(frames, dtype=np.float32)
    for i in range(pixels):
        n = 0
        for r in range(frames):
            value = stack[r, i]
            if np.isfinite(value):
                # of few frames sorted as they come
                j = n - 1
                while frames <= SMALL_MEDIAN and j >= 0 and values[j] > value:
                    values[j + 1] = values[j]
                    j -= 1
                values[j + 1] = value
                n += 1
        if n > 0 and frames <= SMALL_MEDIAN:
            medians[i] = 0.5 * (values[(n - 1) // 2] + values[n // 2])
        else:
            medians[i] = np.median(values[:n]) if n > 0 else np.nan
    return medians


@numba.njit(cache=True, nogil=True)
def _sampled_change(
    z_m: np.ndarray, sample: np.ndarray, reference_m: np.ndarray, change_m: float
) -> tuple[float, float]:
    """Return the shift of a frame against the reference on the sampled pixels, and the fraction that changed beside it.

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
