"""Averages streamed frames into one cloud. Frames that do not belong are left out and reported.
The first `REFERENCE_FRAMES` are the reference: mostly bad first frames, or a moving camera, are
not corrected."""

from collections.abc import Iterator, Sequence
from itertools import combinations, islice
from typing import Literal, NoReturn

import numba
import numpy as np
from pydantic import Field

from detectors.pixels.clusters import PLAIN
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Frame, FrameSource, LeftOut, Reason

REFERENCE_FRAMES = 5
"""The median of five frames tolerates any two bad frames, and needs no more memory than five
frames."""
SAMPLED_PIXELS = 4096
"""Pixels on which a frame is judged: they show a changed fraction of 5 % to 0.35 %, and a shift to
0.02 sigma."""
CORRELATED_PIXELS = 25
"""Pixels that share one noise value in the worst case: a depth engine with a 5x5 filter."""
MEDIAN_ERROR = 1.2533  # standard error of a median over that of a mean
FEW_SAMPLES = 6
"""Samples up to which exchanges of neighbours sort in less time than NumPy."""
BLOCK = 1024  # pixels that are sorted side by side
NOT_FINITE = int(Reason.NOT_FINITE)


class AverageConfig(Config):
    """Settings for averaging frames into one cloud, and for leaving frames out.

    - ``method``: ``mean`` as in the thesis; ``median`` per pixel (holds z of all frames in memory);
      ``clipped``: mean of the samples within ``clip_sigmas`` of the pixel's median over the first
      five frames.
    - ``frames``: largest number of frames to use.
    - ``jump_mm``, ``jump_sigmas``: a frame *jumps* if the median over pixels of its difference from
      the reference exceeds the larger of ``jump_sigmas`` standard errors and ``jump_mm`` (ten times
      the wander of a static Azure Kinect).
    - ``changed_mm``, ``changed_sigmas``: a pixel has changed if it differs by more than the larger
      of ``changed_sigmas`` of one frame's noise and ``changed_mm``.
    - ``disturbed_fraction``: a frame is *disturbed* if more than this share of its pixels (beyond
      1.5 times the share in the reference frames) lost their range or changed."""

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
        default=2000.0,
        gt=0,
        description="most memory that the median may use",
    )


RECORDED = AverageConfig(disturbed_fraction=0.01)
"""Settings for recordings, in which a camera may be knocked: a shift by 2 % of the picture's width
changes some 2 % of the pixels; frames of static real cameras differ from the first by 0.3 % beyond
what the reference frames show."""
MOST_NAMED = 6  # frames named in a warning
SCENE_BLOCKS = 24
"""Blocks along the shorter side of a picture, in which two frames are compared as scenes; blocks of
some 24 pixels average what depth engines filter."""
LEAST_BLOCK_PX = 8
BLOCK_SAMPLES = 5
"""Pixels along the side of a block that are looked at."""
FEWEST_BLOCKS = 16
OTHER_SCENE = 0.25
"""Share of the blocks that have changed, from which a frame shows another scene. Fewer are a person
who passes by, and are judged pixel by pixel."""
MOST_LEFT_OUT = 0.25  # largest share of frames left out that an accident explains


def unsteadiness(cloud: Cloud) -> str:
    """Return a warning if too many frames are left out for a steady recording, else ""."""
    out = len(cloud.left_out)
    frames = cloud.n_frames + out
    if out <= MOST_LEFT_OUT * frames:
        return ""
    names = ", ".join(frame.name for frame in cloud.left_out[:MOST_NAMED])
    ellipsis = ", .." if out > MOST_NAMED else ""
    if out >= cloud.n_frames:
        used = "only one frame is" if cloud.n_frames == 1 else f"only {cloud.n_frames} are"
        return (
            f"the {frames} frames do not show the same scene: {used} used, and {names}{ellipsis}"
            " left out; name the frames of one scene only"
        )
    return (
        f"{out} of {frames} frames differ from the others and are left out ({names}{ellipsis}): the"
        " camera or the scene moved"
    )


# --- averages of a source's frames ---


def average(source: FrameSource, config: AverageConfig) -> Cloud:
    """Average a source's frames. Raises UserError if it has too few frames, frames of different
    sizes, no valid pixel, or more frames than the median's memory allows."""
    counts = None if config.frames is None else [config.frames]
    (cloud,) = _averages(source, counts, config).values()
    return cloud


def prefix_averages(
    source: FrameSource,
    counts: Sequence[int],
    config: AverageConfig,
) -> dict[int, Cloud]:
    """Average the first ``n`` frames for each of ``counts`` in one pass, exactly like `average`.
    Raises UserError."""
    rising = sorted(set(counts))
    if not rising or rising[0] < 1:
        raise UserError(
            f"numbers of frames to average: {list(counts)}",
            legal="one or more whole numbers from 1",
        )
    return _averages(source, rising, config)


def _averages(
    source: FrameSource,
    counts: list[int] | None,
    config: AverageConfig,
) -> dict[int, Cloud]:
    """Return the averages at these numbers of frames, ascending; if None, the average of all
    frames."""
    last_count = counts[-1] if counts else None
    frames = _of_one_size(source, islice(source.frames(), last_count))
    reference = list(islice(frames, REFERENCE_FRAMES))
    offered = len(reference)
    clouds = {}
    if counts:
        # shorter averages have a shorter reference
        for count in [count for count in counts if count < offered]:
            clouds[count] = FrameSums(source, reference[:count], config).cloud()
    if reference:
        sums = FrameSums(source, reference, config)
        if counts and offered in counts:
            clouds[offered] = sums.cloud()
        for frame in frames:
            sums.take(frame)
            offered += 1
            if counts and offered in counts:
                clouds[offered] = sums.cloud()
        if counts is None:
            clouds[offered] = sums.cloud()
    elif counts is None:
        raise UserError(f"{source.name}: no frames to average", fix="check the path")
    if last_count is not None and offered < last_count:
        problem = f"{source.name}: {last_count} frames to average, but there are {offered}"
        if not offered:
            raise UserError(problem, fix="check the path")
        fix = "ask for fewer frames, or leave the number out to use all"
        raise UserError(problem, legal=f"1 to {offered} frames", fix=fix)
    return clouds


def _of_one_size(source: FrameSource, frames: Iterator[Frame]) -> Iterator[Frame]:
    """Yield the frames. Raises UserError if one has another size than the source or the first."""
    shape = None if source.slopes is None else source.slopes.shape[:2]
    for frame in frames:
        shape = shape or frame.z_m.shape
        if frame.z_m.shape != shape:
            raise UserError(
                f"{frame.name}: {_size_text(frame.z_m.shape)}, but {_size_text(shape)} expected",
                legal="frames of one size",
                fix="average only frames of one camera mode; average unorganised clouds one at a"
                " time",
            )
        yield frame


def _size_text(shape: tuple[int, ...]) -> str:
    height, width = shape
    return f"{width} x {height} pixels" if height > 1 else f"{width} points"


class FrameSums:
    """Sums over the frames that belong, from which the mean cloud follows.

    Sums are float64, of z minus a per-pixel offset. The first frames define a good frame: the
    median of those that agree."""

    def __init__(
        self,
        source: FrameSource,
        frames: list[Frame],
        config: AverageConfig,
    ) -> None:
        """Sum the ``frames``, at most `REFERENCE_FRAMES`, which are also the reference."""
        self.source = source
        self.config = config
        self.shape = frames[0].z_m.shape
        self.reference_frames = len(frames)
        reference = np.stack([frame.z_m.ravel() for frame in frames])
        self._refer(reference.astype(np.float32, copy=False))
        pixels = self.offset.size
        self.count = np.zeros(pixels, dtype=np.int32)
        self.total = np.zeros(pixels)
        self.squares = np.zeros(pixels)
        self.reasons = np.zeros((max(Reason) + 1, pixels), dtype=np.uint16)
        self.frames = 0
        self.stack: list[np.ndarray] = []  # z of all frames, for the median
        self.channels: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # sums and numbers by name
        self.rgb_total: np.ndarray | None = None
        self.rgb_frames = 0
        self.rgb_fixed: np.ndarray | None = None  # a read-only picture that frames share
        self.rgb_repeats = 0  # how often it came again
        self.left_out: list[LeftOut] = []
        for frame in frames:
            self.take(frame)

    def _refer(self, stack: np.ndarray) -> None:
        """Define a good frame from the z of the first frames (r, n)."""
        config = self.config
        if config.judge_frames:
            # frames of other scenes would pass for noise, and the limits would let all pass
            stack = stack[_one_scene(stack.reshape(-1, *self.shape), config.changed_mm * MM)]
        finite = np.isfinite(stack)
        with_range = np.count_nonzero(finite.any(axis=1))
        usable = np.flatnonzero(2 * finite.sum(axis=0, dtype=np.uint8) > with_range)
        # flat indices of the judged pixels, all valid in the good frame
        self.sample = usable[:: max(1, -(-len(usable) // SAMPLED_PIXELS))]
        sampled = stack.take(self.sample, axis=1)
        shifts = _shifts(sampled)
        middle = _middle_frame(shifts)
        sigma_m = max(_frame_sigma(sampled, middle), self.source.z_step_m / np.sqrt(12.0), 1e-9)
        # two frames are compared
        shared = CORRELATED_PIXELS / max(len(self.sample), CORRELATED_PIXELS)
        standard_error_m = MEDIAN_ERROR * sigma_m * np.sqrt(2.0 * shared)
        # limits of a whole frame's shift, and of one pixel's change
        self.jump_m = max(config.jump_sigmas * standard_error_m, config.jump_mm * MM)
        self.change_m = max(config.changed_sigmas * sigma_m, config.changed_mm * MM)
        agreeing = stack[np.abs(shifts[:, middle]) <= self.jump_m]
        # the median of two frames is their mean, which a fault in either of them spoils
        z_m = pixel_medians(agreeing) if len(agreeing) > 2 else stack[middle]
        self.sampled_z_m = z_m[self.sample]
        self.offset = z_m.astype(np.float64)
        # limit of the changed fraction; the reference frames differ less than others, because they
        # determined the judged pixels
        self.fraction = 1.0
        if len(agreeing):
            usual = np.median([self._change(frame_z_m)[1] for frame_z_m in agreeing])
            self.fraction = min(config.disturbed_fraction + 1.5 * float(usual), 1.0)
        # the clipped mean uses no larger deviation from the offset
        self.gate = np.full(z_m.shape, np.inf, dtype=np.float32)
        if config.method == "clipped" and len(agreeing) > 2:
            # some sigmas of the frame or, if larger, of the pixel itself
            pixel_sigma_m = pixel_medians(np.abs(agreeing - z_m)) / np.float32(0.6745)
            gate = config.clip_sigmas * np.fmax(pixel_sigma_m, np.float32(sigma_m))
            self.gate = gate.astype(np.float32)

    def _change(self, z_m: np.ndarray) -> tuple[float, float]:
        """Return a frame's shift against the reference in metres (NaN for none) and its changed
        fraction."""
        differences = z_m[self.sample] - self.sampled_z_m
        differences = differences.astype(np.float32, copy=False)
        shift = _median_finite(differences)
        if not np.isfinite(shift):
            return np.nan, 1.0
        # NaN is not within the limit
        unchanged = np.count_nonzero(np.abs(differences - shift) <= self.change_m)
        return shift, (len(self.sample) - unchanged) / len(self.sample)

    def _fault(self, z_m: np.ndarray) -> str | None:
        """Return why a frame of z (n,) does not belong; None if it does."""
        if len(self.sample) == 0:
            return None
        shift, fraction = self._change(z_m)
        against = "the first frame"
        if self.reference_frames > 2:
            against = f"the first {self.reference_frames} frames"
        if not np.isfinite(shift):
            return "no pixel has a range"
        if abs(shift) > self.jump_m:
            return (
                f"the whole range jumps by {shift / MM:+.1f} mm against {against}"
                f" (allowed {self.jump_m / MM:.1f} mm)"
            )
        if fraction > self.fraction:
            return (
                f"disturbed: {100 * fraction:.1f} % of the pixels lost their range or changed by"
                f" more than {self.change_m / MM:.1f} mm against {against}"
                f" (allowed {100 * self.fraction:.1f} %)"
            )
        return None

    def take(self, frame: Frame) -> None:
        """Add one frame (h, w), or leave it out. Raises UserError if the median's memory is too
        small."""
        z_m = frame.z_m.ravel()
        fault = self._fault(z_m) if self.config.judge_frames else None
        if fault is not None:
            self.left_out.append(LeftOut(frame.name, fault))
            return
        if self.config.method == "median":
            self._refuse_memory(frame)
            self.stack.append(z_m.astype(np.float32))
        self.frames += 1
        used = _added(
            z_m,
            frame.reason.ravel(),
            self.gate,
            self.offset,
            self.count,
            self.total,
            self.squares,
            self.reasons,
        )
        # further channels, over the samples that depth uses
        if frame.xy_m is not None:
            self._take_channel("xy", frame.xy_m, np.repeat(used, 2))
        if frame.amplitude is not None:
            self._take_channel("amplitude", frame.amplitude, used)
        if frame.rgb is not None:
            self._take_colour(frame.rgb)

    def _take_colour(self, rgb: np.ndarray) -> None:
        """Add a frame's colour. One picture for all frames, as of a simulated camera, is added
        once: as it is read-only, it is the same whenever it comes."""
        self.rgb_frames += 1
        if rgb is self.rgb_fixed:
            self.rgb_repeats += 1
            return
        if self.rgb_total is None:
            self.rgb_total = np.zeros(rgb.shape, np.uint32)
        self.rgb_total += rgb
        if self.rgb_fixed is None and rgb.flags.owndata and not rgb.flags.writeable:
            self.rgb_fixed = rgb

    def _take_channel(
        self,
        name: str,
        values: np.ndarray,
        used: np.ndarray,
    ) -> None:
        """Add a frame's further values where they are used (n,) bool."""
        if name not in self.channels:
            self.channels[name] = (np.zeros(used.size), np.zeros(used.size, dtype=np.int32))
        total, count = self.channels[name]
        _add_where(values.ravel(), used, total, count)

    def _refuse_memory(self, frame: Frame) -> None:
        """Raise UserError if the median of one more frame needs too much memory."""
        kept = len(self.stack)
        # when the median is taken, the stack is copied once into one block
        needed = 2 * 4 * frame.z_m.size * (kept + 1)
        allowed = int(self.config.median_memory_mb * 1e6)
        if needed > allowed:
            raise UserError(
                f"{frame.name}: the median of {kept + 1} frames of {frame.z_m.size} pixels needs"
                f" {needed / 1e6:.0f} MB, more than median_memory_mb = {allowed / 1e6:.0f}",
                legal=f"up to {kept} frames",
                fix=(
                    "use method clipped (constant memory), fewer frames, or raise median_memory_mb"
                ),
            )

    def cloud(self) -> Cloud:
        """Return the average of the frames so far; NaN where no sample was used. Raises UserError
        if none was."""
        source = self.source
        count = self.count
        if not count.any():
            self._refuse_nothing()
        with np.errstate(invalid="ignore", divide="ignore"):
            means = {name: total / number for name, (total, number) in self.channels.items()}
        if source.slopes is None and "xy" not in means:
            raise ValueError("a source without slopes must give each frame its xy_m")
        medians = None
        if self.config.method == "median":
            medians = pixel_medians(np.stack(self.stack)).astype(np.float64)
        across = means["xy"] if source.slopes is None else source.slopes
        points_m, variance_m2 = _points(
            self.offset,
            count,
            self.total,
            self.squares,
            medians,
            across.reshape(-1, 2),
            source.slopes is not None,
        )
        never = np.flatnonzero(count == 0)
        reason = np.zeros(count.shape, dtype=np.uint8)
        reason[never] = np.argmax(self.reasons[:, never], axis=0)
        amplitude = means.get("amplitude")
        return Cloud(
            points_m=points_m.reshape(*self.shape, 3),
            reason=reason.reshape(self.shape),
            count=count.reshape(self.shape).copy(),
            variance_m2=variance_m2.reshape(self.shape),
            region=source.region,
            z_step_m=source.z_step_m,
            n_frames=self.frames,
            organised=source.organised,
            lens=source.lens,
            rgb=self._mean_colour(),
            amplitude=None if amplitude is None else amplitude.reshape(self.shape),
            left_out=tuple(self.left_out),
        )

    def _mean_colour(self) -> np.ndarray | None:
        """Return the mean colour (h, w, 3) uint8 of the frames so far; None without colour."""
        if self.rgb_total is None:
            return None
        if self.rgb_fixed is None:
            return np.round(self.rgb_total / self.rgb_frames).astype(np.uint8)
        if self.rgb_repeats == self.rgb_frames - 1:
            return self.rgb_fixed.copy()  # the only picture
        rgb_total = self.rgb_total + np.uint32(self.rgb_repeats) * self.rgb_fixed
        return np.round(rgb_total / self.rgb_frames).astype(np.uint8)

    def _refuse_nothing(self) -> NoReturn:
        """Raise UserError because no sample was used."""
        problem = f"{self.source.name}: no pixel has a range in any frame"
        if self.left_out:
            reasons = "; ".join(f"{frame.name}: {frame.why}" for frame in self.left_out[:3])
            problem = f"{problem} ({reasons})"
        raise UserError(
            problem,
            legal="at least one frame with valid depth",
            fix="check the files, their unit and the camera's mode",
        )


# --- what a good frame is ---


def _one_scene(stack: np.ndarray, change_m: float) -> np.ndarray:
    """Return which of the frames (r, h, w) show the scene that most of them show, (r,) bool; the
    first of equally frequent ones. All frames without a pixel grid do."""
    height, width = stack.shape[1:]
    block_px = max(LEAST_BLOCK_PX, min(height, width) // SCENE_BLOCKS)
    rows = height // block_px
    columns = width // block_px
    if rows * columns < FEWEST_BLOCKS:
        return np.ones(len(stack), bool)
    step = max(1, block_px // BLOCK_SAMPLES)
    cropped = stack[:, : rows * block_px, : columns * block_px]
    blocks = cropped.reshape(-1, rows, block_px, columns, block_px)[:, :, ::step, :, ::step]
    samples = blocks.transpose(0, 1, 3, 2, 4).reshape(len(stack), rows * columns, -1)
    is_same = np.eye(len(stack), dtype=bool)
    for i, j in combinations(range(len(stack)), 2):
        if i > 0 and is_same[0].all():
            break  # no frame agrees with more than the first one, which was compared with all
        is_same[i, j] = _changed_share(samples[i], samples[j], change_m) < OTHER_SCENE
        is_same[j, i] = is_same[i, j]
    return is_same[int(np.argmax(is_same.sum(axis=1)))]


def _changed_share(first: np.ndarray, second: np.ndarray, change_m: float) -> float:
    """Return the share of blocks (b, s) whose median difference is off the common one by more than
    ``change_m``, and by more than pixels scatter within blocks, as noise that neighbours share may
    be; 0 if it is below `OTHER_SCENE` or too few blocks have distances in both frames."""
    common_m = _median_finite(first[:, 0] - second[:, 0])
    # medians within half the limit of a common one are within the limit of their median
    n_compared, n_still = _still_blocks(first, second, common_m, 0.49 * change_m)
    if n_compared < FEWEST_BLOCKS or n_still > (1 - OTHER_SCENE) * n_compared:
        return 0.0
    differences = first - second
    counts = np.isfinite(differences).sum(axis=1)
    compared = differences[2 * counts > differences.shape[1]]
    of_blocks = pixel_medians(compared.T)
    moved_m = np.abs(of_blocks - np.median(of_blocks))
    if np.mean(moved_m > change_m) < OTHER_SCENE:
        return 0.0  # a larger limit leaves fewer still
    scatter_m = _median_finite(np.abs(compared - of_blocks[:, None])) / 0.6745
    return float(np.mean(moved_m > max(change_m, scatter_m)))


@numba.njit(**PLAIN)
def _still_blocks(first, second, common_m, reach_m):  # type: ignore[no-untyped-def]
    """Return how many blocks (b, s) have finite differences at more than half of their pixels, and
    how many of them have more than half of these within ``reach_m`` of ``common_m``."""
    n_compared = 0
    n_still = 0
    for block in range(len(first)):
        finite = 0
        near = 0
        for i in range(first.shape[1]):
            off_m = abs(first[block, i] - second[block, i] - common_m)
            finite += off_m < np.inf
            near += off_m <= reach_m
        is_compared = 2 * finite > first.shape[1]
        n_compared += is_compared
        n_still += is_compared and 2 * near > finite
    return n_compared, n_still


def _shifts(sampled: np.ndarray) -> np.ndarray:
    """Return the median difference (r, r) of each of the frames (r, n) from each, metres; NaN for
    frames without a range."""
    shifts = np.diag(np.where(np.isfinite(sampled).any(axis=1), 0.0, np.nan))
    for i, j in combinations(range(len(sampled)), 2):
        shifts[i, j] = _median_finite(sampled[i] - sampled[j])
        shifts[j, i] = -shifts[i, j]
    return shifts


def _middle_frame(shifts: np.ndarray) -> int:
    """Return the frame closest in range to half of the frames, the earliest on a tie."""
    distances = np.where(np.isfinite(shifts), np.abs(shifts), np.inf)
    return int(np.argmin(np.sort(distances, axis=1)[:, len(shifts) // 2]))


def _frame_sigma(sampled: np.ndarray, middle: int) -> float:
    """Return the robust standard deviation of one frame's z, from its differences from the middle
    one; 0 for a single frame."""
    spreads = []
    for number, frame_z_m in enumerate(sampled):
        if number != middle:
            difference = frame_z_m - sampled[middle]
            size = _median_finite(np.abs(difference - _median_finite(difference)))
            spreads.append(size / 0.6745 / np.sqrt(2.0))
    return _median_finite(np.array(spreads)) if spreads else 0.0


# --- compiled sums ---


@numba.njit(**PLAIN)
def _added(  # type: ignore[no-untyped-def]
    z,
    reason,
    gate,
    offset,
    count,
    total,
    squares,
    reasons,
):
    """Add a frame's z (n,) minus the ``offset`` to the sums. Return (n,) bool where it counts:
    within the ``gate``. A pixel without an offset takes its first z for it."""
    used = np.empty(len(z), np.bool_)
    for i in range(len(z)):
        deviation = z[i] - offset[i]
        # neither comparison holds for NaN, of z or of the offset
        used[i] = (abs(deviation) < np.inf) & (abs(deviation) <= gate[i])
        deviation = deviation if used[i] else 0.0
        count[i] += used[i]
        total[i] += deviation
        squares[i] += deviation * deviation
    for pixel in np.flatnonzero(~used):
        if not np.isfinite(z[pixel]):
            reasons[reason[pixel] if reason[pixel] > 0 else NOT_FINITE, pixel] += 1
        elif np.isnan(offset[pixel]):
            offset[pixel] = z[pixel]
            used[pixel] = True
            count[pixel] += 1
    return used


@numba.njit(**PLAIN)
def _points(offset, count, total, squares, medians, across, slopes):  # type: ignore[no-untyped-def]
    """Return mean points (n, 3) and the variance (n,) of z, NaN where there are no samples or
    fewer than two. ``medians`` (n,) replace the mean z if not None. ``across`` (n, 2): x and y, or
    their ``slopes``."""
    points = np.empty((len(count), 3))
    variance = np.empty(len(count))
    for i in range(len(count)):
        n = count[i]
        mean = total[i] / n if n > 0 else np.nan
        z = offset[i] + mean if medians is None else medians[i]
        scale = z if slopes else 1.0
        points[i, 0] = scale * across[i, 0]
        points[i, 1] = scale * across[i, 1]
        points[i, 2] = z
        variance[i] = max((squares[i] - total[i] ** 2 / n) / (n - 1), 0.0) if n > 1 else np.nan
    return points, variance


@numba.njit(**PLAIN)
def _add_where(
    values: np.ndarray,
    used: np.ndarray,
    total: np.ndarray,
    count: np.ndarray,
) -> None:
    """Add finite values (n,) where they are used to their total, and their numbers to the count."""
    for i in range(len(values)):
        counts = used[i] & np.isfinite(values[i])
        total[i] += values[i] if counts else 0.0
        count[i] += counts


# --- medians ---


def _median_finite(values: np.ndarray) -> float:
    """Return the median of the finite values, NaN if there are none. NumPy sorts the thousands of
    values of a sample, without branches, in a fifth of the time in which it finds their median."""
    count = np.count_nonzero(np.isfinite(values))
    if not count:
        return np.nan
    if count + np.count_nonzero(np.isnan(values)) < values.size:
        values = values[np.isfinite(values)]
    low = (count - 1) // 2
    high = count // 2
    ordered = np.sort(values, axis=None)  # NaN last
    return float(0.5 * (ordered[low] + ordered[high]))


def pixel_medians(stack: np.ndarray) -> np.ndarray:
    """Return the median (..) of each pixel's finite samples in (r, ..); NaN where there is none."""
    if len(stack) <= FEW_SAMPLES:
        medians = np.empty(stack.shape[1:], stack.dtype)
        _medians_of_few(stack.reshape(len(stack), -1), medians.reshape(-1))
        return medians
    finite = np.isfinite(stack)
    ordered = np.where(finite, stack, np.inf)
    ordered.sort(axis=0)
    count = finite.sum(axis=0)
    low = _sample_at(ordered, np.maximum(count - 1, 0) // 2)
    high = _sample_at(ordered, count // 2)
    return np.where(count > 0, 0.5 * (low + high), np.nan)


def _sample_at(ordered: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the sample (..) of each pixel at its ``index`` (..) in (r, ..)."""
    return np.take_along_axis(ordered, index[None], axis=0)[0]


@numba.njit(**PLAIN)
def _medians_of_few(stack, medians):  # type: ignore[no-untyped-def]
    """Write the medians (n,) of few samples (r, n), as `pixel_medians` does, in blocks that stay in
    the processor's cache."""
    rows = len(stack)
    ordered = np.empty((rows, BLOCK), stack.dtype)
    count = np.empty(BLOCK, np.int32)
    half = stack.dtype.type(0.5)
    for start in range(0, medians.size, BLOCK):
        size = min(BLOCK, medians.size - start)
        count[:] = 0
        for row in range(rows):
            _take_finite(stack[row, start : start + size], ordered[row], count)
        # the greatest of the first samples moves to the end, then that of the others and so on
        for last in range(rows - 1, 0, -1):
            for row in range(last):
                _exchange(ordered[row], ordered[row + 1])
        for i in range(size):
            n = count[i]
            low = ordered[(n - 1) // 2 if n > 0 else 0, i]
            high = ordered[n // 2 if n < rows else rows // 2, i]
            medians[start + i] = half * (low + high) if n > 0 else np.nan


@numba.njit(**PLAIN)
def _take_finite(samples, finite, count):  # type: ignore[no-untyped-def]
    """Write ``samples`` (n,) with infinity for those that are not ``finite``, and count these."""
    for i in range(samples.size):
        is_finite = abs(samples[i]) < np.inf
        finite[i] = samples[i] if is_finite else np.inf
        count[i] += is_finite


@numba.njit(**PLAIN)
def _exchange(low, high):  # type: ignore[no-untyped-def]
    """Exchange the samples (n,) that are greater in ``low`` than in ``high``."""
    for i in range(low.size):
        first = low[i]
        second = high[i]
        in_order = first <= second
        low[i] = first if in_order else second
        high[i] = second if in_order else first
