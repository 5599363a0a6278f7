"""From frames to one cloud: streamed averages, and frames that do not belong are noticed, left out and named.

The camera is taken to stand still before a static scene. Judging uses the first `REFERENCE_FRAMES` frames as reference,
so a source whose first frames are mostly bad, or a camera that is moved during the capture, is not healed: every frame
after the move is left out and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Literal

import cv2
import numpy as np
from pydantic import Field

from detectors.averaging_kernels import FrameStack, FrameSums, pixel_medians, sampled_change
from harness.vocabulary.capture import Cloud, Frame, FrameSource, LeftOut
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM

REFERENCE_FRAMES = 5
"""The median of five survives two bad frames, wherever they stand, and needs no more memory than five frames."""
SAMPLED_PIXELS = 4096
"""Pixels on which a frame is judged: a changed fraction of 5 % is then known to 0.35 %, a shift to 0.02 sigma."""
CORRELATED_PIXELS = 25
"""Pixels that share one noise value in the worst case: a depth engine that filters over 5x5."""


class AverageConfig(Config):
    """How frames become one cloud, and when a frame is left out.

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
    """The average of a source's frames.

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
    """Averages of the first ``n`` frames for each ``n`` in ``counts``, in one pass.

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
        self._settled: _Settled | None = None
        self._shape: tuple[int, ...] | None = None
        self.offered = 0
        """Frames added so far, those left out included."""

    def add(self, frame: Frame) -> None:
        """Take one more frame. Raises UserError where its size differs from the first frame's."""
        self._check_size(frame)
        self.offered += 1
        if self._settled is not None:
            self._settled.take(frame)
            return
        self._held.append(frame)
        if len(self._held) == REFERENCE_FRAMES:
            self._settled = self._settle()
            self._held = []

    def cloud(self) -> Cloud:
        """The average of the frames so far. Raises UserError where no frame has a valid pixel."""
        if self.offered == 0:
            raise UserError(f"{self._source.name}: no frames to average", fix="check the path")
        settled = self._settled if self._settled is not None else self._settle()
        return settled.cloud(self._source, self._slopes)

    def _settle(self) -> _Settled:
        settled = _Settled(_Reference.of(self._held, self._source.z_step_m, self._config), self._config)
        for frame in self._held:
            settled.take(frame)
        return settled

    def _check_size(self, frame: Frame) -> None:
        shape = frame.z_m.shape
        expected = self._shape or (self._slopes.shape[:2] if self._slopes is not None else shape)
        if shape != expected:
            raise UserError(
                f"{frame.name}: {_size(shape)}, but {_size(expected)} expected",
                legal="frames of one size, pixel by pixel on the same grid",
                fix="average only frames of one camera mode; average unorganised clouds one at a time",
            )
        self._shape = shape


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]} x {shape[0]} pixels" if shape[0] > 1 else f"{shape[1]} points"


@dataclass(frozen=True)
class _Reference:
    """What a good frame looks like: ``z_m`` (n,) median of the first frames that agree, and the limits to keep."""

    z_m: np.ndarray
    spread_m: np.ndarray
    """(n,) largest credible deviation of one frame per pixel: the gate of the clipped mean."""
    sample: np.ndarray
    """(s,) flat indices of the judged pixels, all valid in the reference."""
    sampled_z_m: np.ndarray
    jump_m: float
    change_m: float
    fraction: float
    frames: int

    @classmethod
    def of(cls, frames: list[Frame], z_step_m: float, config: AverageConfig) -> _Reference:
        stack = np.stack([frame.z_m.ravel() for frame in frames]).astype(np.float32, copy=False)
        sample = _judged_pixels(stack)
        middle, shifts = _middle_frame(stack[:, sample])
        sigma = _frame_noise(stack[:, sample], middle, z_step_m)
        # standard error of a median is 1.25 that of a mean; two frames are compared
        standard_error = 1.2533 * sigma * np.sqrt(2.0 * CORRELATED_PIXELS / max(len(sample), CORRELATED_PIXELS))
        jump = max(config.jump_sigmas * standard_error, config.jump_mm * MM)
        agreeing = stack[np.abs(shifts) <= jump]
        # the median of two frames is their mean, which a fault in either spoils
        z = pixel_medians(agreeing) if len(agreeing) > 2 else stack[middle]
        change = max(config.changed_sigmas * sigma, config.changed_mm * MM)
        usual = [sampled_change(row, sample, z[sample], change)[1] for row in agreeing]
        spread = _credible_spread(agreeing, z, sigma, config.clip_sigmas)
        # the reference frames look better than others, because they chose the pixels that are judged
        fraction = config.disturbed_fraction + 1.5 * float(np.median(usual)) if usual else 1.0
        return cls(z, spread, sample, z[sample], jump, change, min(fraction, 1.0), len(frames))

    def fault(self, frame: Frame) -> str | None:
        """Why this frame does not belong, None if it does."""
        if len(self.sample) == 0:
            return None
        shift, fraction = sampled_change(frame.z_m.ravel(), self.sample, self.sampled_z_m, self.change_m)
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


def _judged_pixels(stack: np.ndarray) -> np.ndarray:
    """Flat indices of up to `SAMPLED_PIXELS` pixels, evenly taken from those valid in most of the frames (r, n)."""
    finite = np.isfinite(stack)
    usable = np.flatnonzero(2 * finite.sum(axis=0) > finite.any(axis=1).sum())
    return usable[:: max(1, -(-len(usable) // SAMPLED_PIXELS))]


def _middle_frame(sampled: np.ndarray) -> tuple[int, np.ndarray]:
    """The frame nearest to the others in range (the earliest on a tie), and each frame's shift against it, metres."""
    shifts = np.array([[_median_finite(a - b) for b in sampled] for a in sampled])
    distances = np.sort(np.where(np.isfinite(shifts), np.abs(shifts), np.inf), axis=1)
    middle = int(np.argmin(distances[:, len(sampled) // 2]))
    return middle, shifts[:, middle]


def _median_finite(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else np.nan


def _frame_noise(sampled: np.ndarray, middle: int, z_step_m: float) -> float:
    """Robust standard deviation of one frame's z, metres, at least that of the rounding."""
    deviations = [row - sampled[middle] for i, row in enumerate(sampled) if i != middle]
    spreads = [_median_finite(np.abs(d - _median_finite(d))) / 0.6745 / np.sqrt(2.0) for d in deviations]
    return max(_median_finite(np.array(spreads)) if spreads else 0.0, z_step_m / np.sqrt(12.0), 1e-9)


def _credible_spread(agreeing: np.ndarray, z: np.ndarray, sigma: float, clip_sigmas: float) -> np.ndarray:
    """Per pixel the gate of the clipped mean: some sigmas of the frame or, where larger, of the pixel itself."""
    if len(agreeing) < 3:
        return np.full(z.shape, np.inf, dtype=np.float32)
    own = pixel_medians(np.abs(agreeing - z)) / np.float32(0.6745)
    return np.asarray(clip_sigmas * np.fmax(own, np.float32(sigma)), dtype=np.float32)


class _Settled:
    """Frames are judged and accumulated one by one."""

    def __init__(self, reference: _Reference, config: AverageConfig) -> None:
        self._reference = reference
        self._judging = config.judge_frames
        self._left_out: list[LeftOut] = []
        clip = config.method == "clipped"
        if config.method == "median":
            self._sums: FrameSums = FrameStack(reference.z_m, int(config.median_memory_mb * 1e6))
        else:
            self._sums = FrameSums(reference.z_m, reference.spread_m if clip else None)

    def take(self, frame: Frame) -> None:
        fault = self._reference.fault(frame) if self._judging else None
        if fault is None:
            self._sums.add(frame)
        else:
            self._left_out.append(LeftOut(frame.name, fault))

    def cloud(self, source: FrameSource, slopes: np.ndarray | None) -> Cloud:
        if not self._sums.count.any():
            named = "; ".join(f"{left.name}: {left.why}" for left in self._left_out[:3])
            raise UserError(
                f"{source.name}: no pixel has a range in any frame" + (f" ({named})" if named else ""),
                legal="at least one frame with valid depth",
                fix="check the files, their unit and the camera's mode",
            )
        parts = self._sums.parts(slopes)
        return Cloud(
            **parts,
            region=source.region,
            z_step_m=source.z_step_m,
            organised=source.organised,
            lens=source.lens,
            left_out=tuple(self._left_out),
        )


# ---- how far the noise reaches ---------------------------------------------------------------------------------------

REACH_FRAMES = 6
REACH_WINDOW_PX = 384
"""Side of the window, about the middle of the valid pixels, that is looked at."""
FARTHEST_LAG_PX = 30
SHARED = 0.1
"""Correlation below which pixels share nothing: a box of b pixels falls below it at lag b, up to 9 pixels."""
REACH_PIXELS = 5000
"""Pixels that must be valid in two frames: the correlation of so many, of which 25 are alike, is known to 0.07."""


def noise_reach_px(frames: Sequence[Frame]) -> float:
    """The lag, in pixels, at which the noise of neighbours along rows and columns stops being alike; 0 for unknown.

    Differences of successive frames hold noise alone. A filter over b x b pixels correlates them over b - 1 pixels,
    interpolation to a grid f times finer over f b. The median over pairs of frames and both axes. Unknown with one
    frame, without noise beyond the rounding step, or where the correlation does not end (something moves).
    """
    lags: list[int] = []
    for first, second in pairwise(frames):
        difference = second.z_m.astype(np.float64) - first.z_m
        rows, columns = np.isfinite(difference).nonzero()
        if rows.size < REACH_PIXELS:
            continue
        top, left = (max(0, int(np.median(places)) - REACH_WINDOW_PX // 2) for places in (rows, columns))
        difference = difference[top : top + REACH_WINDOW_PX, left : left + REACH_WINDOW_PX]
        known = np.isfinite(difference)
        known &= np.abs(np.nan_to_num(difference)) < 8 * float(np.abs(difference[known]).mean())
        side = (2 * FARTHEST_LAG_PX + 1,) * 2
        weight = cv2.boxFilter(known.astype(np.float64), -1, side)
        level = cv2.boxFilter(np.where(known, difference, 0.0), -1, side) / np.maximum(weight, 1e-9)
        noise = np.where(known, difference - level, 0.0)
        lags += [_first_unlike_lag(noise, known), _first_unlike_lag(noise.T, known.T)]
    known_lags = [lag for lag in lags if lag]
    return float(np.median(known_lags)) if len(known_lags) > len(lags) / 2 else 0.0


def _first_unlike_lag(noise: np.ndarray, known: np.ndarray) -> int:
    """The first lag along rows at which the mean product of noises falls below `SHARED`; 0 for none."""

    def product(lag: int) -> float:
        width = noise.shape[1] - lag
        return float((noise[:, lag:] * noise[:, :width]).sum()) / max((known[:, lag:] & known[:, :width]).sum(), 1)

    variance = product(0)
    lags = range(1, min(FARTHEST_LAG_PX, noise.shape[1]) if variance > 0 else 1)
    return next((lag for lag in lags if product(lag) < SHARED * variance), 0)
