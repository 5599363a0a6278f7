"""What is measured on a plane: noise, its correlation, valid pixels, errors that a whole unit or frame has."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from harness.scorecard.bench import NOISE, WHOLE, Bench, Stack, taken
from harness.scorecard.conditions import LagConditions, PlaneConditions
from harness.scorecard.estimate import NOTHING, Estimate, jackknifed, mean_of, share_of
from harness.scorecard.pattern import fixed_pattern
from harness.scorecard.temporal import correlation_at, temporal_sigma_m
from harness.vocabulary.seeds import digest
from harness.vocabulary.units import MM
from scenes.closed_form import plane_view
from scenes.sensor.camera import EffectsConfig
from scenes.view import NoiseFreeView

PATCH = (40, 24)
"""Height and width in pixels. Narrow: at 70 degrees of incidence z then varies by 6 % to either side on the coarsest
camera, and the deviation's mean by under 1 %."""
PATTERN_PATCH = (140, 180)
"""Some 200 patches of the fixed pattern's correlation length."""
LEAST_TILT = (0.05, 0.02)
"""Slopes of the frontal plane: 3 degrees, so that rounding of the output meets every phase of its step."""
JUMP_M = 5 * MM
"""A frame whose mean is farther than this from the median of all is a jump, no jitter."""
STEADY = WHOLE.model_copy(update={"frame_jumps": False})
JITTER = NOISE.model_copy(update={"frame_jumps": True})
PATTERNED = NOISE.model_copy(update={"fixed_pattern": True})


@lru_cache(maxsize=8)
def plane_stack(bench: Bench, c: PlaneConditions, effects: EffectsConfig, frames: int, unit: int = 1) -> Stack:
    """Frames of a plane about the axis."""
    return _taken(bench, c, _view(bench, c, PATCH), effects, frames, unit)


def temporal_sigma(bench: Bench, c: PlaneConditions) -> Estimate:
    """Deviation over frames of one pixel's z, rms over pixels, noise alone."""
    stack = plane_stack(bench, _plane(c), NOISE, bench.effort.noise_frames)
    return jackknifed(stack.z_m, lambda z: temporal_sigma_m(z, stack.everywhere) / MM)


def random_error(bench: Bench, c: PlaneConditions) -> Estimate:
    """Deviation over frames of one pixel's z with all that differs between frames, rms over pixels."""
    stack = plane_stack(bench, _plane(c), WHOLE, bench.effort.whole_frames)
    return jackknifed(stack.z_m, lambda z: temporal_sigma_m(z, stack.everywhere) / MM)


def noise_correlation(bench: Bench, c: LagConditions) -> Estimate:
    """Correlation of the noise of two pixels."""
    stack = plane_stack(bench, _plane(c), NOISE, bench.effort.noise_frames)
    return jackknifed(stack.z_m, lambda z: correlation_at(z, stack.everywhere, c.lag_x_px, c.lag_y_px))


def valid_fraction(bench: Bench, c: PlaneConditions) -> Estimate:
    """Share of pixels with a range; as many neighbours count as one as the camera's own filter mixes."""
    stack = plane_stack(bench, _plane(c), NOISE, bench.effort.valid_frames)
    return share_of(np.isfinite(stack.z_m), (2 * bench.camera.optics.margin_px + 1) ** 2)


def amplitude(bench: Bench, c: PlaneConditions) -> Estimate:
    """Mean amplitude in the camera's own units."""
    stack = plane_stack(bench, _plane(c), NOISE, bench.effort.noise_frames)
    return Estimate(float(np.nanmean(stack.amplitude)))


def bias(bench: Bench, c: PlaneConditions) -> Estimate:
    """Mean error of z of one unit (number 1) with all its effects but jumps, over the patch."""
    stack = plane_stack(bench, _plane(c), STEADY, bench.effort.bias_frames)
    return mean_of(_mean_errors_mm(stack))


def systematic_error(bench: Bench, c: PlaneConditions) -> Estimate:
    """The greatest absolute mean error among several units; no interval: it is the worst of these units."""
    errors = []
    for unit in range(1, bench.effort.units + 1):
        stack = plane_stack(bench, _plane(c), STEADY, bench.effort.bias_frames, unit)
        errors.append(abs(float(np.nanmean(_mean_errors_mm(stack)))))
    known = [error for error in errors if np.isfinite(error)]
    return Estimate(max(known)) if known else NOTHING


def frame_jitter(bench: Bench, c: PlaneConditions) -> Estimate:
    """Deviation of a frame's mean over the patch from frame to frame, rare jumps left out."""
    stack = plane_stack(bench, _plane(c), JITTER, bench.effort.whole_frames)
    if not np.isfinite(stack.z_m).any(axis=(1, 2)).all():
        return NOTHING
    return jitter_of(np.nanmean(stack.z_m - stack.true_z_m, axis=(1, 2)))


def jitter_of(means_m: np.ndarray) -> Estimate:
    """Deviation in mm of frames' means (n,), without those that jump."""
    steady = means_m[np.abs(means_m - np.median(means_m)) < JUMP_M]
    return jackknifed(steady, lambda m: float(m.std(ddof=1)) / MM) if steady.size >= 2 else NOTHING


def pattern_sigma(bench: Bench, c: PlaneConditions) -> Estimate:
    """Deviation over pixels of what stays of an average after a smooth surface and noise are off; mean over units."""
    view = _view(bench, _plane(c), PATTERN_PATCH)
    found = []
    for unit in range(1, min(bench.effort.units, 5) + 1):
        stack = _taken(bench, _plane(c), view, PATTERNED, bench.effort.noise_frames // 4, unit)
        where = np.isfinite(stack.z_m).all(axis=0)
        if where.mean() > 0.5:
            found.append(fixed_pattern(np.nan_to_num(stack.z_m), where, stack.slopes, lags=12).std_m / MM)
    return mean_of(found)


def _mean_errors_mm(stack: Stack) -> np.ndarray:
    """(n,) each frame's mean error over the pixels with a range; NaN where it has none."""
    some = np.isfinite(stack.z_m).any(axis=(1, 2))
    errors = np.full(len(stack.z_m), np.nan)
    errors[some] = np.nanmean(stack.z_m[some] - stack.true_z_m, axis=(1, 2)) / MM
    return errors


def _plane(c: PlaneConditions) -> PlaneConditions:
    """The plane alone, so that all that is measured on it shares its frames."""
    return PlaneConditions(distance_m=c.distance_m, albedo=c.albedo, angle_deg=c.angle_deg)


def _view(bench: Bench, c: PlaneConditions, patch: tuple[int, int]) -> NoiseFreeView:
    slope_x = max(float(np.tan(np.radians(c.angle_deg))), LEAST_TILT[0])
    return plane_view(bench.camera, bench.patch(*patch), c.distance_m, c.albedo, slope_x, LEAST_TILT[1])


def _taken(
    bench: Bench, c: PlaneConditions, view: NoiseFreeView, effects: EffectsConfig, frames: int, unit: int
) -> Stack:
    label = digest([c.to_data(), effects.to_data()])
    return taken(bench.unit(view, effects, unit), frames, bench.camera_name, "plane", label, unit)
