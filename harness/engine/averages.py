"""Averages of simulated frames: drawn at once where that is equal in distribution, from single frames otherwise.

Drawn at once are plain means of at least `FEWEST_FRAMES` frames, where the camera's model can. Frames that jump as a
whole are left out as `detectors.average` leaves them out: its verdict hangs on how far each frame is displaced, which
is known exactly here. Where a verdict might go either way, by the pixels' noise, the frames are drawn one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from scipy import special

from detectors.average import (
    CORRELATED_PIXELS,
    REFERENCE_FRAMES,
    SAMPLED_PIXELS,
    AverageConfig,
    prefix_averages,
)
from harness.vocabulary.capture import Cloud, LeftOut
from harness.vocabulary.units import MM
from scenes.sensor.amcw.at_once import AtOnce
from scenes.sensor.frames import FrameTotals
from scenes.sensor.source import SimulatedCapture

FEWEST_FRAMES = 20
"""Fewer frames cost less than the sorting of a view's pixels, which takes as long as some 10 frames of a bare board
and 25 of one with holes before a far wall. By number only, so that no result hangs on what was sorted before."""
SURE = 5.0
"""Standard errors by which a frame's displacement keeps from a limit of the judge, so that noise cannot decide; fewer
than `AverageConfig.jump_sigmas`, or no frame of a noisy camera would."""
MOST_DISTURBED = 0.5
"""Share of `AverageConfig.disturbed_fraction` that pixels' own noise may disturb. A frame's own share scatters about
the mean by a thousandth, and the judge allows 1.5 times what it finds usual on top."""


def averages_of(
    capture: SimulatedCapture, counts: Sequence[int], config: AverageConfig, exact: bool
) -> dict[int, Cloud]:
    """Averages of the first n frames of a capture for each n in ``counts``, equal in distribution to
    `detectors.average.prefix_averages`, which is used where ``exact`` or nothing else will do.

    Those that are drawn at once nest as there: the average of 50 frames contains the one of 20. So do those drawn frame
    by frame; the two kinds have noise of their own. What an average is does not hang on which others are asked for.
    Raises UserError as `detectors.average.prefix_averages` does.
    """
    many = sorted({n for n in counts if n >= FEWEST_FRAMES})
    clouds = _at_once(capture, many, config) if many and not exact and config.method == "mean" else {}
    rest = [n for n in counts if n not in clouds]
    return clouds | (prefix_averages(capture, rest, config) if rest or not counts else {})


def _at_once(capture: SimulatedCapture, counts: list[int], config: AverageConfig) -> dict[int, Cloud]:
    """Return the averages that can be drawn at once."""
    summer = capture.unit.at_once
    if summer is None or counts[-1] > capture.n_frames:
        return {}
    judged = {n: verdict for n in counts if (verdict := _verdict(capture, summer, n, config)) is not None}
    parts = _parts(capture, {n: verdict.kept for n, verdict in judged.items()}) if judged else None
    clouds: dict[int, Cloud] = {}
    for n, verdict in judged.items() if parts is not None else ():
        together = [part for frames, part in parts or () if frames[0] < n and verdict.kept[frames[0]]]
        cloud = _cloud(capture, reduce(add, together), verdict.left_out) if together else None
        if cloud is None or (config.judge_frames and _disturbed(cloud, _frame_noise_m(capture, summer), config)):
            continue
        clouds[n] = cloud
    return clouds


def _parts(capture: SimulatedCapture, kept: dict[int, np.ndarray]) -> list[tuple[np.ndarray, FrameTotals]] | None:
    """Frames that every average takes or leaves together, as their numbers and their sums."""
    most = max(kept)
    used = np.array([[number < n and bool(kept[n][number]) for n in sorted(kept)] for number in range(most)])
    parts = []
    for pattern in np.unique(used, axis=0):
        if not pattern.any():
            continue
        frames = np.flatnonzero((used == pattern).all(axis=1))
        totals = capture.totals(frames)
        if totals is None:
            return None
        parts.append((frames, totals))
    return parts


@dataclass(frozen=True)
class _Verdict:
    """``kept`` (n,) bool: frames that belong to an average of n; ``left_out``: those that do not."""

    kept: np.ndarray
    left_out: tuple[LeftOut, ...]


def _verdict(capture: SimulatedCapture, summer: AtOnce, n: int, config: AverageConfig) -> _Verdict | None:
    """The judgement of `detectors.average` on the first n frames; None where the pixels' noise might decide."""
    shift_m = summer.z_by_error * capture.errors_m[:n]
    if not config.judge_frames:
        return _Verdict(np.ones(n, bool), ())
    if summer.sure_pixels == 0:
        return None
    sampled = summer.sure_pixels / -(-summer.sure_pixels // SAMPLED_PIXELS)
    noise_m = _frame_noise_m(capture, summer)
    error_m = 1.2533 * noise_m * np.sqrt(2.0 * CORRELATED_PIXELS / max(sampled, CORRELATED_PIXELS))
    limit_m, slack_m = max(config.jump_sigmas * error_m, config.jump_mm * MM), SURE * error_m
    reference_m = _reference(shift_m[:REFERENCE_FRAMES], limit_m, slack_m)
    if reference_m is None:
        return None
    off_m = np.abs(shift_m - reference_m)
    if (np.abs(off_m - limit_m) < slack_m).any():
        return None
    against = f"the first {min(n, REFERENCE_FRAMES)} frames" if n > 2 else "the first frame"
    left_out = tuple(
        LeftOut(
            f"frame {number}",
            f"the whole range jumps by {(shift_m[number] - reference_m) / MM:+.1f} mm against {against}"
            f" (allowed {limit_m / MM:.1f} mm)",
        )
        for number in np.flatnonzero(off_m > limit_m)
    )
    return _Verdict(off_m <= limit_m, left_out)


def _reference(shift_m: np.ndarray, limit_m: float, slack_m: float) -> float | None:
    """Displacement of the reference that the first frames make; None where noise might decide which of them do."""
    apart = np.abs(shift_m[:, None] - shift_m)
    if (np.abs(apart - limit_m) < slack_m).any():
        return None
    middle = np.sort(apart, axis=1)[:, len(shift_m) // 2]
    nearest = int(np.argmin(middle))
    # two frames are each as far from the other, and the first is taken; of more, the middle one must have company
    if len(shift_m) > 2 and middle[nearest] > limit_m:
        return None
    agreeing = shift_m[apart[nearest] <= limit_m]
    return float(np.median(agreeing)) if len(agreeing) > 2 else float(shift_m[nearest])


def _frame_noise_m(capture: SimulatedCapture, summer: AtOnce) -> float:
    """One frame's noise as the judge finds it: with its rounding."""
    return float(np.hypot(summer.noise_m, capture.z_step_m / np.sqrt(12)))


def _disturbed(cloud: Cloud, noise_m: float, config: AverageConfig) -> bool:
    """Return whether frames may be left out because many of their pixels lose their range or change."""
    judged = 2 * cloud.count > cloud.n_frames
    if not judged.any():
        return True
    change_m = max(config.changed_sigmas * noise_m, config.changed_mm * MM)
    lost = 1 - cloud.count[judged].mean() / cloud.n_frames
    # below a quarter of the change, 6 in 100,000 do
    loud = judged & (cloud.variance_m2 > (change_m / 4) ** 2)
    changed = special.erfc(change_m / np.sqrt(2 * cloud.variance_m2[loud])).sum() / judged.sum()
    return bool(lost + changed > MOST_DISTURBED * config.disturbed_fraction)


def _cloud(capture: SimulatedCapture, totals: FrameTotals, left_out: tuple[LeftOut, ...]) -> Cloud | None:
    """The average that the sums make, as `detectors.average` makes it; None where no pixel has a range."""
    count = totals.count
    if not count.any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = totals.total / count
        z_m = (totals.base + mean) * totals.step_m
        variance = (totals.squares - totals.total * mean) / (count - 1)
        amplitude = totals.amplitude / count
    reason = np.zeros(count.shape, np.uint8)
    never = count == 0
    reason[never] = np.argmax(totals.reasons[:, never], axis=0)
    points_m = np.empty((*count.shape, 3))
    points_m[..., :2] = capture.slopes * z_m[..., None]
    points_m[..., 2] = z_m
    return Cloud(
        points_m=points_m,
        reason=reason,
        count=count,
        variance_m2=np.where(count > 1, np.maximum(variance, 0.0) * totals.step_m**2, np.nan),
        region=capture.region,
        z_step_m=capture.z_step_m,
        n_frames=totals.frames,
        organised=capture.organised,
        lens=capture.lens,
        rgb=capture.unit.rgb,
        amplitude=amplitude,
        left_out=left_out,
    )
