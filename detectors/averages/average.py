"""Averages streamed frames into one cloud. Frames that do not belong are left out and reported.
The first `REFERENCE_FRAMES` are the reference: mostly bad first frames, or a moving camera, are
not corrected."""

from collections.abc import Iterator, Sequence
from itertools import chain, combinations, islice
from typing import Literal

import numba
import numpy as np
from pydantic import Field

from detectors.findings.clusters import PLAIN
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Frame, FrameSource, LeftOut, Reason

REFERENCE_FRAMES = 5
"""The median of five frames tolerates any two bad frames, and needs no more memory than five
frames."""
SAMPLED_PIXELS = 4096
"""Pixels on which a frame is judged: they show a changed fraction of 5 % to 0.35 %, and a shift to
0.02 sigma."""
CORRELATED_PIXELS = (
    25  # pixels that share one noise value in the worst case: a depth engine with a 5x5 filter
)

NOT_FINITE = int(Reason.NOT_FINITE)


class AverageConfig(Config):
    """Settings for averaging frames into one cloud, and for leaving frames out.

    ``method``: ``mean`` as in the thesis; ``median`` per pixel (holds z of all frames in memory);
    ``clipped``: mean of the samples within ``clip_sigmas`` of the pixel's median over the first
    five frames. ``frames``: largest number of frames to use. A frame *jumps* if the median over
    pixels of its difference from the reference exceeds the larger of ``jump_sigmas`` standard
    errors and ``jump_mm`` (ten times the wander of a static Azure Kinect). It is *disturbed* if
    more than ``disturbed_fraction`` of its pixels (beyond 1.5 times the share in the reference
    frames) lost their range, or changed by more than the larger of ``changed_sigmas`` of one
    frame's noise and ``changed_mm``."""

    method: Literal["mean", "median", "clipped"] = "mean"
    frames: int | None = Field(default=None, ge=1)
    judge_frames: bool = Field(True, description="leaves out frames that jump or are disturbed")
    jump_mm: float = Field(default=3.0, gt=0)
    jump_sigmas: float = Field(default=6.0, gt=0)
    changed_mm: float = Field(default=6.0, gt=0)
    changed_sigmas: float = Field(default=6.0, gt=0)
    disturbed_fraction: float = Field(default=0.05, gt=0, le=1)
    clip_sigmas: float = Field(default=5.0, ge=2)
    median_memory_mb: float = Field(
        default=2000.0, gt=0, description="most memory that the median may use"
    )


MOST_LEFT_OUT = 0.25  # largest share of frames left out that an accident explains
RECORDED = AverageConfig(disturbed_fraction=0.01)
"""Settings for recordings, in which a camera may be knocked: a shift by 2 % of the picture's width
changes some 2 % of the pixels; frames of static real cameras differ from the first by 0.3 % beyond
what the reference frames show."""


def unsteadiness(cloud: Cloud) -> str:
    """Return a warning if too many frames are left out for a steady recording, else ""."""
    out = len(cloud.left_out)
    frames = cloud.n_frames + len(cloud.left_out)
    what = f"{out} of {frames} frames differ from the others and are left out: the camera or the scene moved"
    return what if out > MOST_LEFT_OUT * frames else ""


def average(source: FrameSource, config: AverageConfig) -> Cloud:
    """Average a source's frames. Raises UserError if it has too few frames, frames of different
    sizes, no valid pixel, or more frames than the median's memory allows."""
    (cloud,) = _averages(
        source, None if config.frames is None else [config.frames], config
    ).values()
    return cloud


def prefix_averages(
    source: FrameSource, counts: Sequence[int], config: AverageConfig
) -> dict[int, Cloud]:
    """Average the first ``n`` frames for each of ``counts`` in one pass, exactly like `average`.
    Raises UserError."""
    wanted = sorted(set(counts))
    if not wanted or wanted[0] < 1:
        raise UserError(
            f"numbers of frames to average: {list(counts)}",
            legal="one or more whole numbers from 1",
        )
    return _averages(source, wanted, config)


def _averages(
    source: FrameSource, wanted: list[int] | None, config: AverageConfig
) -> dict[int, Cloud]:
    """Return the averages at these numbers of frames, ascending; if None, the average of all
    frames."""
    frames = _of_one_size(source, islice(source.frames(), wanted[-1] if wanted else None))
    held = list(islice(frames, REFERENCE_FRAMES))
    offered = len(held)
    clouds = {}
    for n in (n for n in wanted or () if n < offered):
        clouds[n] = FrameSums(source, held[:n], config).cloud()
    if held:
        sums = FrameSums(source, held, config)
        for offered, frame in enumerate(chain([None], frames), start=len(held)):
            if frame is not None:
                sums.take(frame)
            if wanted and offered in wanted:
                clouds[offered] = sums.cloud()
        clouds |= {} if wanted else {offered: sums.cloud()}
    elif wanted is None:
        raise UserError(f"{source.name}: no frames to average", fix="check the path")
    if wanted and offered < wanted[-1]:
        legal = f"1 to {offered} frames" if offered else None
        fix = (
            "ask for fewer frames, or leave the number out to use all"
            if offered
            else "check the path"
        )
        raise UserError(
            f"{source.name}: {wanted[-1]} frames to average, but there are {offered}",
            legal=legal,
            fix=fix,
        )
    return clouds


def _of_one_size(source: FrameSource, frames: Iterator[Frame]) -> Iterator[Frame]:
    shape = None if source.slopes is None else source.slopes.shape[:2]
    for frame in frames:
        shape = shape or frame.z_m.shape
        if frame.z_m.shape != shape:
            sizes = [
                f"{w} x {h} pixels" if h > 1 else f"{w} points" for h, w in (frame.z_m.shape, shape)
            ]
            fix = "average only frames of one camera mode; average unorganised clouds one at a time"
            raise UserError(
                f"{frame.name}: {sizes[0]}, but {sizes[1]} expected",
                legal="frames of one size",
                fix=fix,
            )
        yield frame


class FrameSums:
    """Sums over the frames that belong, from which the mean cloud follows: float64 of z minus a
    per-pixel offset. The first frames define a good frame: the median of those that agree.
    ``sample``: flat indices of the judged pixels, all valid in it. The clipped mean uses no larger
    deviation from the offset than ``gate``."""

    def __init__(self, source: FrameSource, frames: list[Frame], config: AverageConfig) -> None:
        """Sum the ``frames``, at most `REFERENCE_FRAMES`, which are also the reference."""
        self.source, self.config, self.shape, self.reference_frames = (
            source,
            config,
            frames[0].z_m.shape,
            len(frames),
        )
        n = self._refer(
            np.stack([frame.z_m.ravel() for frame in frames]).astype(np.float32, copy=False)
        )
        self.count, self.total, self.squares = np.zeros(n, dtype=np.int32), np.zeros(n), np.zeros(n)
        self.reasons = np.zeros((max(Reason) + 1, n), dtype=np.uint16)
        self.frames = 0
        self.stack: list[np.ndarray] = []
        self.channels: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self.rgb_total: np.ndarray | None = None
        self.rgb_frames = 0
        self.left_out: list[LeftOut] = []
        for frame in frames:
            self.take(frame)

    def _refer(self, stack: np.ndarray) -> int:
        """Define a good frame from the first frames (r, n); returns n."""
        config = self.config
        finite = np.isfinite(stack)
        usable = np.flatnonzero(2 * finite.sum(axis=0) > finite.any(axis=1).sum())
        self.sample = usable[:: max(1, -(-len(usable) // SAMPLED_PIXELS))]
        sampled = stack[:, self.sample]
        # the frame closest in range to the others (the earliest on a tie), and each frame's shift
        # against it
        between = np.diag(np.where(np.isfinite(sampled).any(axis=1), 0.0, np.nan))
        for i, j in combinations(range(len(sampled)), 2):
            between[i, j] = _median_finite(sampled[i] - sampled[j])
            between[j, i] = -between[i, j]
        distances = np.sort(np.where(np.isfinite(between), np.abs(between), np.inf), axis=1)
        middle = int(np.argmin(distances[:, len(sampled) // 2]))
        # robust standard deviation of one frame's z, at least that of rounding
        deviations = [row - sampled[middle] for i, row in enumerate(sampled) if i != middle]
        spreads = [
            _median_finite(np.abs(d - _median_finite(d))) / 0.6745 / np.sqrt(2.0)
            for d in deviations
        ]
        sigma = max(
            _median_finite(np.array(spreads)) if spreads else 0.0,
            self.source.z_step_m / np.sqrt(12.0),
            1e-9,
        )
        # the standard error of a median is 1.25 times that of a mean; two frames are compared
        shared = CORRELATED_PIXELS / max(len(self.sample), CORRELATED_PIXELS)
        self.jump_m = max(
            config.jump_sigmas * 1.2533 * sigma * np.sqrt(2.0 * shared), config.jump_mm * MM
        )
        self.change_m = max(config.changed_sigmas * sigma, config.changed_mm * MM)
        agreeing = stack[np.abs(between[:, middle]) <= self.jump_m]
        # the median of two frames is their mean, which a fault in either of them spoils
        z = pixel_medians(agreeing) if len(agreeing) > 2 else stack[middle]
        self.sampled_z_m, self.offset = z[self.sample], z.astype(np.float64)
        # the reference frames differ less than others, because they determined the judged pixels
        usual = [self._change(row)[1] for row in agreeing]
        self.fraction = min(
            config.disturbed_fraction + 1.5 * float(np.median(usual)) if usual else 1.0, 1.0
        )
        self.gate = np.full(z.shape, np.inf, dtype=np.float32)
        if config.method == "clipped" and len(agreeing) > 2:
            # some sigmas of the frame or, if larger, of the pixel itself
            own = pixel_medians(np.abs(agreeing - z)) / np.float32(0.6745)
            self.gate = (config.clip_sigmas * np.fmax(own, np.float32(sigma))).astype(np.float32)
        return z.size

    def _change(self, z_m: np.ndarray) -> tuple[float, float]:
        """Return a frame's shift against the reference in metres (NaN for none) and its changed
        fraction."""
        differences = z_m[self.sample] - self.sampled_z_m
        differences = differences.astype(np.float32, copy=False)
        if not np.isfinite(shift := _median_finite(differences)):
            return np.nan, 1.0
        # NaN is not within the limit
        changed = len(self.sample) - np.count_nonzero(np.abs(differences - shift) <= self.change_m)
        return shift, changed / len(self.sample)

    def _fault(self, frame: Frame) -> str | None:
        """Return why this frame does not belong; None if it does."""
        if len(self.sample) == 0:
            return None
        shift, fraction = self._change(frame.z_m.ravel())
        against = (
            f"the first {self.reference_frames} frames"
            if self.reference_frames > 2
            else "the first frame"
        )
        if not np.isfinite(shift):
            return "no pixel has a range"
        if abs(shift) > self.jump_m:
            allowed = f"(allowed {self.jump_m / MM:.1f} mm)"
            return f"the whole range jumps by {shift / MM:+.1f} mm against {against} {allowed}"
        if fraction > self.fraction:
            changed = f"lost their range or changed by more than {self.change_m / MM:.1f} mm against {against}"
            return f"disturbed: {100 * fraction:.1f} % of the pixels {changed} (allowed {100 * self.fraction:.1f} %)"
        return None

    def take(self, frame: Frame) -> None:
        """Add one frame (h, w), or leave it out. Raises UserError if the median's memory is too
        small."""
        fault = self._fault(frame) if self.config.judge_frames else None
        if fault is not None:
            self.left_out.append(LeftOut(frame.name, fault))
            return
        z = frame.z_m.ravel()
        if self.config.method == "median":
            # when the median is taken, the stack is copied once into one block
            kept = len(self.stack)
            allowed = int(self.config.median_memory_mb * 1e6)
            needed = 2 * 4 * z.size * (kept + 1)
            if needed > allowed:
                what = f"{frame.name}: the median of {kept + 1} frames of {z.size} pixels needs {needed / 1e6:.0f} MB,"
                what += f" more than median_memory_mb = {allowed / 1e6:.0f}"
                fix = (
                    "use method clipped (constant memory), fewer frames, or raise median_memory_mb"
                )
                raise UserError(what, legal=f"up to {kept} frames", fix=fix)
            self.stack.append(z.astype(np.float32))
        self.frames += 1
        sums = self.offset, self.count, self.total, self.squares, self.reasons
        used = _added(z, frame.reason.ravel(), self.gate, *sums)
        # further channels, over the samples that depth uses
        for name, values, width in (("xy", frame.xy_m, 2), ("amplitude", frame.amplitude, 1)):
            if values is not None:
                if name not in self.channels:
                    self.channels[name] = (
                        np.zeros(z.size * width),
                        np.zeros(z.size * width, dtype=np.int32),
                    )
                _add_where(
                    values.ravel(),
                    used if width == 1 else np.repeat(used, width),
                    *self.channels[name],
                )
        if frame.rgb is not None:
            self.rgb_total = (
                np.zeros(frame.rgb.shape, np.uint32) if self.rgb_total is None else self.rgb_total
            )
            self.rgb_total += frame.rgb
            self.rgb_frames += 1

    def cloud(self) -> Cloud:
        """Return the average of the frames so far; NaN where no sample was used. Raises UserError
        if none was."""
        source = self.source
        count = self.count
        if not count.any():
            named = "; ".join(f"{left.name}: {left.why}" for left in self.left_out[:3])
            what = f"{source.name}: no pixel has a range in any frame" + (
                f" ({named})" if named else ""
            )
            fix = "check the files, their unit and the camera's mode"
            raise UserError(what, legal="at least one frame with valid depth", fix=fix)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = {name: total / known for name, (total, known) in self.channels.items()}
        if source.slopes is None and "xy" not in means:
            raise ValueError("a source without slopes must give each frame its xy_m")
        middle = (
            pixel_medians(np.stack(self.stack)).astype(np.float64)
            if self.config.method == "median"
            else None
        )
        across = (
            means["xy"].reshape(-1, 2) if source.slopes is None else source.slopes.reshape(-1, 2)
        )
        sums = self.offset, count, self.total, self.squares
        points_m, variance = _points(*sums, middle, across, source.slopes is not None)
        never = np.flatnonzero(count == 0)
        reason = np.zeros(count.shape, dtype=np.uint8)
        reason[never] = np.argmax(self.reasons[:, never], axis=0)
        return Cloud(
            points_m=points_m.reshape(*self.shape, 3),
            reason=reason.reshape(self.shape),
            count=count.reshape(self.shape).copy(),
            variance_m2=variance.reshape(self.shape),
            region=source.region,
            z_step_m=source.z_step_m,
            n_frames=self.frames,
            organised=source.organised,
            lens=source.lens,
            rgb=None
            if self.rgb_total is None
            else np.round(self.rgb_total / self.rgb_frames).astype(np.uint8),
            amplitude=means["amplitude"].reshape(self.shape) if "amplitude" in means else None,
            left_out=tuple(self.left_out),
        )


@numba.njit(**PLAIN)
def _added(  # type: ignore[no-untyped-def]
    z, reason, gate, offset, count, total, squares, reasons
):
    """Add a frame's z (n,) minus the ``offset`` to the sums. Return (n,) bool where it counts:
    within the ``gate``."""
    used = np.empty(len(z), np.bool_)
    for i in range(len(z)):
        deviation = z[i] - offset[i]
        # neither comparison holds for NaN, of z or of the offset
        used[i] = (abs(deviation) < np.inf) & (abs(deviation) <= gate[i])
        deviation = deviation if used[i] else 0.0
        count[i] += used[i]
        total[i] += deviation
        squares[i] += deviation * deviation
    for i in range(len(z)):
        if used[i]:
            continue
        if not np.isfinite(z[i]):
            reasons[reason[i] if reason[i] > 0 else NOT_FINITE, i] += 1
        elif np.isnan(offset[i]):
            offset[i], used[i] = z[i], True
            count[i] += 1
    return used


@numba.njit(**PLAIN)
def _points(offset, count, total, squares, middle, across, slopes):  # type: ignore[no-untyped-def]
    """Return mean points (n, 3) and the variance (n,) of z, NaN where there are no samples or
    fewer than two. Medians (n,) replace the mean z if ``middle`` is not None. ``across`` (n, 2): x
    and y, or their ``slopes``."""
    points = np.empty((len(count), 3))
    variance = np.empty(len(count))
    for i in range(len(count)):
        n = count[i]
        mean = total[i] / n if n > 0 else np.nan
        z = offset[i] + mean if middle is None else middle[i]
        scale = z if slopes else 1.0
        points[i, 0], points[i, 1], points[i, 2] = scale * across[i, 0], scale * across[i, 1], z
        variance[i] = max((squares[i] - total[i] ** 2 / n) / (n - 1), 0.0) if n > 1 else np.nan
    return points, variance


@numba.njit(**PLAIN)
def _add_where(values: np.ndarray, used: np.ndarray, total: np.ndarray, count: np.ndarray) -> None:
    for i in range(len(values)):
        counts = used[i] & np.isfinite(values[i])
        total[i] += values[i] if counts else 0.0
        count[i] += counts


def _median_finite(values: np.ndarray) -> float:
    """Return the median of the finite values, NaN if there are none, in two thirds of NumPy's
    time."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return np.nan
    low = (len(finite) - 1) // 2
    high = len(finite) // 2
    ordered = np.partition(finite, (low, high))
    return float(0.5 * (ordered[low] + ordered[high]))


def pixel_medians(stack: np.ndarray) -> np.ndarray:
    """Return the median (..) of each pixel's finite samples in (r, ..); NaN where there is none."""
    finite = np.isfinite(stack)
    ordered = np.where(finite, stack, np.inf)
    count = finite.sum(axis=0)
    if len(stack) > 6:  # exchanges of neighbours sort fewer samples in less time
        ordered.sort(axis=0)
    for place in range(len(stack) - 1 if len(stack) <= 6 else 0):
        for row in range(len(stack) - 1 - place):
            pair = ordered[row], ordered[row + 1]
            ordered[row], ordered[row + 1] = np.minimum(*pair), np.maximum(*pair)
    places = (np.maximum(count - 1, 0) // 2, count // 2)
    low, high = (np.take_along_axis(ordered, place[None], axis=0)[0] for place in places)
    return np.where(count > 0, 0.5 * (low + high), np.nan)
