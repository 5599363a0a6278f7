"""Averages of simulated frames, as a trial needs them.

Averages are drawn at once if that gives the same distribution (plain means of `FEWEST_FRAMES`
frames or more, if the camera's model supports it). Frames that jump are then left out by their
displacement, which is known exactly."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from scipy import special

from detectors.averages.average import (
    CORRELATED_PIXELS,
    REFERENCE_FRAMES,
    SAMPLED_PIXELS,
    AverageConfig,
    prefix_averages,
)
from detectors.averages.flat_captures import flattened, separated
from detectors.averages.flat_field import FlatField, FlatFieldConfig, corrected
from harness.vocabulary.geometry import MM, Cloud, LeftOut
from scenes.closed_form import plane_view
from scenes.sensor.amcw.at_once import AtOnce
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.common.unit import FrameTotals
from scenes.sensor.source import SimulatedCapture, SimulatedUnit

FEWEST_FRAMES = 10
"""Drawing fewer frames costs less than sorting a view's pixels. Results depend on the number only,
not on the cost."""
# albedo of a flat field's plane: painted wood or paper, like the boards of the experiments
FLAT_ALBEDO = 0.6
MOST_DISTURBED = 0.5
"""Share of `AverageConfig.disturbed_fraction` that the pixels' own noise may disturb; it varies by
a thousandth."""
# standard error of a median over the standard error of a mean, for Gaussian noise
MEDIAN_TO_MEAN = 1.2533


@dataclass(frozen=True)
class Averaging:
    """The way in which frames become a cloud."""

    config: AverageConfig
    """The average, and which frames it leaves out."""
    exact: bool = False
    """True if every frame is drawn, even where averages could be drawn at once."""
    flat_field: FlatFieldConfig | None = None
    """The flat field to subtract."""


def averages_of(
    capture: SimulatedCapture,
    counts: Sequence[int],
    config: AverageConfig,
    exact: bool,
    flat_field: FlatFieldConfig | None = None,
) -> dict[int, Cloud]:
    """Return the averages of the first n frames of a capture for each n in ``counts``. Their
    distribution is that of `detectors.averages.average.prefix_averages`, which is used (and may
    raise) if ``exact`` or if averages cannot be drawn at once. Larger averages contain the frames
    of smaller ones drawn in the same way. A ``flat_field`` is subtracted. Clouds state how far the
    camera's edges reach."""
    clouds: dict[int, Cloud] = {}
    large = sorted({n for n in counts if n >= FEWEST_FRAMES})
    if large and not exact and config.method == "mean":
        clouds = _drawn_at_once(capture, large, config)
    remaining = [n for n in counts if n not in clouds]
    if remaining or not counts:
        clouds.update(prefix_averages(capture, remaining, config))
    reach_px = float(capture.unit.camera.optics.margin_px)
    for n, cloud in clouds.items():
        clouds[n] = replace(cloud, edge_reach_px=reach_px)
    if flat_field is None:
        return clouds
    field = flat_field_of(capture.unit.config, flat_field, capture.seed)
    return {n: corrected(cloud, field) for n, cloud in clouds.items()}


def measured_flat_field(camera: CameraConfig, config: FlatFieldConfig, seed: int) -> FlatField:
    """Measure a unit's flat field on a plane across its axis. Raises UserError if no pixel has a
    range."""
    facts = camera_of(camera)
    view = plane_view(facts, facts.nominal_lens.whole, config.distance_m, FLAT_ALBEDO)
    capture = SimulatedUnit(facts, camera, view).capture(config.frames, seed, "flat field")
    clouds = averages_of(capture, [config.frames], AverageConfig(), exact=False)
    cloud = clouds[config.frames]
    flat = flattened(cloud, cloud.valid, "flat field")
    return separated([flat], facts.nominal_lens).field


# all trials of a unit share its flat field
flat_field_of = lru_cache(maxsize=4)(measured_flat_field)


def _drawn_at_once(
    capture: SimulatedCapture, counts: Sequence[int], config: AverageConfig
) -> dict[int, Cloud]:
    """Return the averages of the first n frames, for each n of the ascending ``counts``, that can
    be drawn at once."""
    summer = capture.unit.at_once
    if summer is None or counts[-1] > capture.n_frames:
        return {}
    if config.judge_frames and not summer.sure_pixels:
        return {}
    # noise of one frame, with rounding, as `detectors.averages.average` estimates it
    rounding_m = capture.z_step_m / np.sqrt(12)
    noise_m = float(np.hypot(summer.noise_m, rounding_m))
    left_out: dict[int, LeftOut] = {}
    if config.judge_frames:
        left_out = _left_out(capture, summer, config, noise_m)
    parts = []
    for start, stop in pairwise([0, *counts]):
        kept = [number for number in range(start, stop) if number not in left_out]
        parts.append(np.array(kept, int))
    clouds: dict[int, Cloud] = {}
    for n, totals in zip(counts, capture.totals(parts) or (), strict=False):
        missing = tuple(frame for number, frame in left_out.items() if number < n)
        cloud = _cloud(capture, totals, missing)
        if cloud is None:
            continue
        if config.judge_frames and _is_disturbed(cloud, noise_m, config):
            continue
        clouds[n] = cloud
    return clouds


def _left_out(
    capture: SimulatedCapture, summer: AtOnce, config: AverageConfig, noise_m: float
) -> dict[int, LeftOut]:
    """Return the frames, by number, that jump. The estimate's error, a sixth of the limit, is not
    simulated."""
    sampled = summer.sure_pixels / -(-summer.sure_pixels // SAMPLED_PIXELS)
    independent = max(sampled, CORRELATED_PIXELS)
    error_m = MEDIAN_TO_MEAN * noise_m * np.sqrt(2.0 * CORRELATED_PIXELS / independent)
    limit_m = max(config.jump_sigmas * error_m, config.jump_mm * MM)
    reference_m = np.median(capture.errors_m[:REFERENCE_FRAMES])
    jump_m = summer.z_by_error * (capture.errors_m - reference_m)
    allowed = f"against the first {REFERENCE_FRAMES} frames (allowed {limit_m / MM:.1f} mm)"
    left_out = {}
    for number in np.flatnonzero(np.abs(jump_m) > limit_m).tolist():
        why = f"the whole range jumps by {jump_m[number] / MM:+.1f} mm {allowed}"
        left_out[number] = LeftOut(f"frame {number}", why)
    return left_out


def _is_disturbed(cloud: Cloud, noise_m: float, config: AverageConfig) -> bool:
    """Return whether enough pixels lose their range or change for frames to be left out."""
    judged = 2 * cloud.count > cloud.n_frames
    if not judged.any():
        return True
    change_m = max(config.changed_sigmas * noise_m, config.changed_mm * MM)
    lost = 1 - cloud.count[judged].mean() / cloud.n_frames
    # of pixels with less than a quarter of the change, 6 in 100,000 change
    loud = judged & (cloud.variance_m2 > (change_m / 4) ** 2)
    spread_m = np.sqrt(2 * cloud.variance_m2[loud])
    changed = special.erfc(change_m / spread_m).sum() / judged.sum()
    return bool(lost + changed > MOST_DISTURBED * config.disturbed_fraction)


def _cloud(
    capture: SimulatedCapture, totals: FrameTotals, left_out: tuple[LeftOut, ...]
) -> Cloud | None:
    """Return the average from sums over frames, as `detectors.averages.average` computes it; None
    if no pixel has a range."""
    count = totals.count
    if not count.any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = totals.total / count
        z_m = (totals.base + mean) * totals.step_m
        variance = (totals.squares - totals.total * mean) / (count - 1)
        amplitude = totals.amplitude / count
    reason = np.zeros(count.shape, np.uint8)
    lost = count == 0
    reason[lost] = totals.reasons[:, lost].argmax(axis=0)
    variance_m2 = np.maximum(variance, 0.0) * totals.step_m**2
    xy_m = capture.slopes * z_m[..., None]
    return Cloud(
        points_m=np.concatenate([xy_m, z_m[..., None]], axis=-1),
        reason=reason,
        count=count,
        variance_m2=np.where(count > 1, variance_m2, np.nan),
        region=capture.region,
        z_step_m=capture.z_step_m,
        n_frames=totals.frames,
        organised=capture.organised,
        lens=capture.lens,
        rgb=capture.unit.rgb,
        amplitude=amplitude,
        left_out=left_out,
    )
