"""Statistics of frames while they come: noise, fill rate, drift, and the target in view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import trim_mean

from detectors.averages.average import RECORDED, average
from detectors.crop import CUT_OFF, RIM_PX, AutoCrop, choice_of, described_text
from detectors.pixels.masks import inset
from detectors.recordings import Recording
from detectors.sources.interface import Stream
from harness.stills.statistics import temporal_sigma_m
from harness.vocabulary.geometry import MM, Cloud, Frame, Lens
from harness.vocabulary.text import many

PERIOD_S = 1.0
"""Time between two lines."""
MOST_JUDGED = 16
"""Frames of a second that are judged; more would cost a camera of 30 Hz frames."""
SPAN_S = 120.0
"""Time over which the drift is fitted: two minutes tell .02 mm/min from none where the seconds'
levels err by .05 mm."""
TRIMMED = 0.25
"""Share of pixels at each end that a level leaves out: what passes before the target."""
FEWEST_LEVELS = 6
"""Seconds from which a line of drift is fitted."""
SIGNIFICANT = 3.0
"""Standard errors from which a slope is a drift."""
SETTLED_M_PER_S = 0.02 * MM / 60
"""A drift that no longer counts: a capture ten minutes later differs by .2 mm. A camera that moves
by 2 mm with a time constant of 20 minutes begins with .1 mm/min and gets there after half an hour.
"""


@dataclass(frozen=True)
class WatchedTarget:
    """The surface that `tofpod detect` would inspect."""

    judged: np.ndarray
    """(h, w) bool: its pixels with a distance, without the rim."""
    inside: np.ndarray
    """(h, w) bool: all pixels within its outline, without the rim."""
    text: str
    """Where it is, and whether the picture's edge cuts it off."""
    is_whole: bool
    """Whether its outline lies within the picture."""


@dataclass(frozen=True)
class WarmUp:
    """The change of the target's distance, which somebody who moves the camera changes as well."""

    change_m: float
    """Mean change of the middle half of its pixels since the target was found."""
    per_s: float
    """Slope over the last `SPAN_S`, m/s; NaN while it is not known."""
    error_per_s: float
    """Standard error of the slope, for seconds that err independently."""

    @property
    def is_warming(self) -> bool:
        """True if the slope is beyond chance and beyond `SETTLED_M_PER_S`."""
        is_certain = abs(self.per_s) > SIGNIFICANT * self.error_per_s
        return bool(is_certain and abs(self.per_s) > SETTLED_M_PER_S)

    @property
    def text(self) -> str:
        """Change, rate and judgement."""
        change = f"drift {self.change_m / MM:+.2f} mm"
        if np.isnan(self.per_s):
            return change
        rate = f"{60 * self.per_s / MM:+.2f} mm/min"
        return f"{change} ({rate}, {'still warming up' if self.is_warming else 'settled'})"


@dataclass(frozen=True)
class Second:
    """Statistics of a second of frames on the target; on all pixels if there is none."""

    time_s: float
    """Time of its last frame since the first frame."""
    frames: int
    """Number of frames so far."""
    noise_m: float
    """Standard deviation of single pixels over frames, rms; NaN below two frames."""
    fill_rate: float
    """Share of the target's pixels with a distance."""
    left_out: int
    """Frames that jump or are disturbed, which count in nothing here."""
    drift: WarmUp
    """The drift so far."""
    target: WatchedTarget | None
    """The target; None if no large smooth surface is in view."""
    is_new: bool
    """Whether the target was sought again, as the picture had changed."""

    @property
    def line(self) -> str:
        """The second as a line."""
        noise = "-" if np.isnan(self.noise_m) else f"{self.noise_m / MM:.2f} mm"
        parts = [
            f"{self.time_s:5.0f} s, {self.frames} frames: noise {noise}",
            f"fill rate {100 * self.fill_rate:.1f} %",
            self.drift.text,
            self.target.text if self.target else "no target in view",
        ]
        if self.left_out:
            parts.append(f"{many(self.left_out, 'frame')} displaced or disturbed")
        return ", ".join(parts)

    def to_data(self) -> dict[str, object]:
        """Return the second as JSON types."""
        return {
            "time_s": self.time_s,
            "frames": self.frames,
            "noise_mm": self.noise_m / MM,
            "fill_rate": self.fill_rate,
            "frames_left_out": self.left_out,
            "drift_mm": self.drift.change_m / MM,
            "drift_mm_per_min": 60 * self.drift.per_s / MM,
            "drift_error_mm_per_min": 60 * self.drift.error_per_s / MM,
            "still_warming_up": self.drift.is_warming,
            "target": self.target.text if self.target else None,
            "target_is_whole": self.target is not None and self.target.is_whole,
            "target_sought_again": self.is_new,
        }


class Watch:
    """Watches a stream second by second."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._frames: list[Frame] = []
        """The frames of this second that will be judged."""
        self._count = 0
        self._first_s = 0.0
        self._second_s = 0.0
        """Time of the second's first frame."""
        self._last_s = 0.0
        self._target: WatchedTarget | None = None
        self._reference_m: np.ndarray | None = None
        """Mean distance (h, w) of the second in which the target was sought."""
        self._levels: list[tuple[float, float]] = []
        """Time and change of each second since then."""

    def add(self, frame: Frame, time_s: float) -> Second | None:
        """Take the next frame. Returns a second when this frame begins the next one."""
        if self._count == 0:
            self._first_s = time_s
            self._second_s = time_s
        second = None
        if time_s - self._second_s >= PERIOD_S and self._frames:
            second = self._judged()
            self._second_s = time_s
        if len(self._frames) < MOST_JUDGED:
            self._frames.append(frame)
        self._count += 1
        self._last_s = time_s
        return second

    def ended(self) -> Second | None:
        """Return what the frames since the last second show; None without one."""
        return self._judged() if self._frames else None

    def _judged(self) -> Second:
        cloud = _averaged(self._stream, self._frames)
        left_out = {frame.name for frame in cloud.left_out} if cloud else set()
        used = [frame for frame in self._frames if frame.name not in left_out]
        stack_m = np.stack([frame.z_m for frame in used])
        mean_m = cloud.points_m[..., 2] if cloud else np.full(stack_m.shape[1:], np.nan)
        is_new = self._reference_m is not None and self._has_changed(stack_m, mean_m)
        if self._reference_m is None or is_new:
            self._target = _target_in(cloud) if cloud else None
            self._reference_m = mean_m
            self._levels = []
        everywhere = np.ones(mean_m.shape, bool)
        judged = self._target.judged if self._target else everywhere
        inside = self._target.inside if self._target else everywhere
        change_m = (mean_m - self._reference_m)[judged]
        known_m = change_m[np.isfinite(change_m)]
        # a median would move in the steps of stored distances
        level_m = float(trim_mean(known_m, TRIMMED)) if known_m.size else np.nan
        time_s = self._last_s - self._first_s
        self._levels.append((time_s, level_m))
        second = Second(
            time_s=time_s,
            frames=self._count,
            noise_m=temporal_sigma_m(stack_m, judged) if len(stack_m) > 1 else np.nan,
            fill_rate=float(np.isfinite(stack_m[:, inside]).mean()),
            left_out=len(left_out),
            drift=drift_of(self._levels),
            target=self._target,
            is_new=is_new,
        )
        self._frames = []
        return second

    def _has_changed(self, stack_m: np.ndarray, mean_m: np.ndarray) -> bool:
        """Return whether so many of the target's pixels have moved or vanished that `tofpod detect`
        would leave these frames out beside the first ones; without a target, always."""
        if self._target is None or self._reference_m is None:
            return True
        before_m = self._reference_m[self._target.judged]
        after_m = mean_m[self._target.judged]
        noise_m = np.nan_to_num(temporal_sigma_m(stack_m, self._target.judged))
        most_m = max(RECORDED.changed_sigmas * noise_m, RECORDED.changed_mm * MM)
        is_same = np.abs(after_m - before_m) <= most_m
        return bool((~is_same).mean() > RECORDED.disturbed_fraction)


def compile_loops() -> None:
    """Watch two frames of a plate, so that no loop is compiled while a camera sends frames: this
    takes some 20 s after an installation, and half a second later."""
    lens = Lens(width=96, height=72, fx=100.0, fy=100.0, cx=47.5, cy=35.5)
    z_m = np.full((lens.height, lens.width), 1.0, np.float32)
    z_m[16:56, 24:72] = 0.7
    frame = Frame("plate", z_m, np.zeros(z_m.shape, np.uint8))
    watch = Watch(Stream("plate", lens, MM, iter(())))
    watch.add(frame, 0.0)
    watch.add(frame, 0.1)
    watch.ended()


def drift_of(levels: Sequence[tuple[float, float]]) -> WarmUp:
    """Return the drift of levels in m at times in s, by a straight line through those of the last
    `SPAN_S`. Not modelled: seconds that err alike, which make its error too small."""
    last_s, change_m = levels[-1]
    recent = np.array([level for level in levels if level[0] > last_s - SPAN_S])
    recent = recent[np.isfinite(recent[:, 1])]
    if len(recent) < FEWEST_LEVELS:
        return WarmUp(change_m, np.nan, np.nan)
    times_s = recent[:, 0] - recent[:, 0].mean()
    square = float(times_s @ times_s)
    slope = float(times_s @ recent[:, 1] / square)
    residuals = recent[:, 1] - recent[:, 1].mean() - slope * times_s
    variance = float(residuals @ residuals) / (len(recent) - 2)
    return WarmUp(change_m, slope, float(np.sqrt(variance / square)))


def _averaged(stream: Stream, frames: Sequence[Frame]) -> Cloud | None:
    """Return the average of frames without those that jump or are disturbed, as `tofpod detect`
    makes it; None if no pixel has a distance."""

    def read() -> Iterator[Frame]:
        return iter(frames)

    height, width = frames[0].z_m.shape
    source = Recording(
        name=stream.name,
        read=read,
        shape=(height, width),
        scale_m=stream.unit_m,
        z_step_m=stream.unit_m,
        lens=stream.lens,
    )
    if not any(np.isfinite(frame.z_m).any() for frame in frames):
        return None
    return average(source, RECORDED)


def _target_in(cloud: Cloud) -> WatchedTarget | None:
    """Return the surface that `tofpod detect` chooses in an average; None without a large smooth
    one."""
    choice = choice_of(cloud, AutoCrop())
    if not choice.candidates:
        return None
    candidate = choice.candidates[choice.taken - 1]
    is_whole = candidate.cut_off < CUT_OFF
    state = "in view" if is_whole else "cut off by the picture's edge"
    return WatchedTarget(
        judged=choice.mask,
        inside=inset(candidate.filled, RIM_PX),
        text=f"target {state}: {described_text(candidate)}",
        is_whole=is_whole,
    )
