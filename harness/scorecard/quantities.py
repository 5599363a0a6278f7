"""The closed list of what the scorecard measures: each quantity with its conditions and how it is measured.

A published figure names a quantity and conditions; a curve is a quantity over a range of conditions. Both are measured
by the same function, so a figure stands on the curve. All scenes lie about the optical axis. Defaults of conditions are
the usual case; a published figure states what differs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field
from scipy import ndimage

from harness.evaluation.intervals import Interval
from harness.scorecard import steps
from harness.scorecard.bench import (
    JITTER,
    NOISE,
    NOTHING,
    PATTERNED,
    STEADY,
    WHOLE,
    Bench,
    FrameStack,
    Reading,
    jackknifed,
    mean_of,
    share_of,
    taken,
)
from harness.scorecard.noise import correlation_at, fixed_pattern, temporal_sigma_m
from harness.vocabulary.config import Config
from harness.vocabulary.seeds import digest
from harness.vocabulary.units import MM
from scenes.closed_form import plane_view
from scenes.sensor.camera import NO_EFFECTS, EffectsConfig
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
SURVIVES = 0.5
"""A step survives where at least this share of its height is seen, in most plateaus."""
LADDER_MM = (2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 500.0)
"""Heights that are tried for the smallest step that survives."""
MONTE_CARLO_SIGMAS = 2.0

# ---- conditions ------------------------------------------------------------------------------------------------------

Distance = Annotated[float, Field(ge=0.1, le=20.0, description="along the optical axis, in metres")]
Albedo = Annotated[float, Field(gt=0.0, le=1.0, description="diffuse reflectance, above 0 and up to 1")]
Lag = Annotated[int, Field(ge=0, le=16, description="pixels from 0 to 16")]
DiameterPx = Annotated[float, Field(ge=0.5, le=12.0, description="in pixels, 0.5 to 12")]
StepMm = Annotated[float, Field(ge=0.5, le=5e3, description="from front to back, 0.5 to 5000 mm")]


class PlaneConditions(Config):
    """An endless matte plane that fills the field of view."""

    distance_m: Distance = 1.5
    albedo: Albedo = 0.8
    angle_deg: Annotated[float, Field(ge=0.0, le=80.0, description="of incidence, 0 to 80 degrees")] = 0.0


class LagConditions(PlaneConditions):
    """Two pixels of a plane, so far apart."""

    lag_x_px: Lag = 1
    lag_y_px: Lag = 0


class StepConditions(Config):
    """A straight edge of one matte plane before another, both frontal, the edge 6 degrees off the pixel grid.

    ``across``: the image axis along which z steps. ``shadow``: whether the front stands on the emitter's side, so that
    it throws its shadow on the visible back (where the emitter is offset along that axis).
    """

    distance_m: Distance = 0.75
    step_mm: StepMm = 50.0
    albedo: Albedo = 0.6
    across: Literal["x", "y"] = "x"
    shadow: bool = False


class SurvivalConditions(Config):
    """Round plateaus before a plane, at all positions relative to the pixel grid."""

    distance_m: Distance = 0.75
    diameter_px: DiameterPx = 3.0
    albedo: Albedo = 0.6


class PlateauConditions(SurvivalConditions):
    """Round plateaus of one height before a plane."""

    step_mm: StepMm = 18.0


class RoomConditions(Config):
    """A board of 400 x 300 mm, albedo 0.6, in a room with a floor and a back wall."""

    distance_m: Annotated[float, Field(ge=0.4, le=2.2, description="in metres, 0.4 to 2.2")] = 0.7
    multipath: bool = True


_WORDS: dict[str, Callable[[Any], str]] = {
    "distance_m": lambda v: f"{v:g} m",
    "albedo": lambda v: f"albedo {v:g}",
    "angle_deg": lambda v: f"{v:g}°" if v else "",
    "step_mm": lambda v: f"step {v:g} mm",
    "across": lambda v: f"across {v}",
    "shadow": lambda v: "shadowed" if v else "",
    "diameter_px": lambda v: f"⌀ {v:g} px",
    "multipath": lambda v: "multipath on" if v else "multipath off",
    "lag_px": lambda v: f"lag ({v[0]}, {v[1]}) px",
}


def in_words(conditions: Config) -> str:
    """Conditions as a short text with units: ``1.5 m, albedo 0.8``."""
    data = conditions.to_data()
    if "lag_x_px" in data:
        data["lag_px"] = (data.pop("lag_x_px"), data.pop("lag_y_px"))
    return ", ".join(filter(None, (_WORDS[key](value) for key, value in data.items())))


def scene_of(conditions: Config) -> tuple[str, dict[str, Any]]:
    """The scene to simulate for some conditions: equal for those that share it, such as all lags on one plane."""
    shared = _plane(conditions) if isinstance(conditions, LagConditions) else conditions
    return type(shared).__name__, shared.to_data()


def _plane(c: PlaneConditions) -> PlaneConditions:
    """The plane alone, so that all that is measured on it shares its frames."""
    return PlaneConditions(distance_m=c.distance_m, albedo=c.albedo, angle_deg=c.angle_deg)


# ---- the list --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quantity:
    """Something that is measured. ``unit`` is empty for ratios; ``says`` is one sentence for the page."""

    name: str
    title: str
    unit: str
    conditions: type[Config]
    measure: Callable[[Bench, Any], Reading]
    says: str


QUANTITIES: dict[str, Quantity] = {}
M = TypeVar("M", bound=Callable[..., Reading])


def _quantity(title: str, conditions: type[Config]) -> Callable[[M], M]:
    """Put a measuring function on the list. Its name is the quantity's, with the unit as its ending (the amplitude is
    in the camera's own units); its docstring's first paragraph is what the page says of it."""

    def listed(measure: M) -> M:
        name = measure.__name__
        ending = name.rpartition("_")[2]
        unit = "units" if name == "amplitude" else ending if ending in ("mm", "px") else ""
        says = " ".join((measure.__doc__ or "").partition("\n\n")[0].split())
        QUANTITIES[name] = Quantity(name, title, unit, conditions, measure, says)
        return measure

    return listed


# ---- planes ----------------------------------------------------------------------------------------------------------


def _view(bench: Bench, c: PlaneConditions, patch: tuple[int, int]) -> NoiseFreeView:
    slope_x = max(float(np.tan(np.radians(c.angle_deg))), LEAST_TILT[0])
    return plane_view(bench.camera, bench.patch(*patch), c.distance_m, c.albedo, slope_x, LEAST_TILT[1])


def _taken(
    bench: Bench, c: PlaneConditions, view: NoiseFreeView, effects: EffectsConfig, frames: int, unit: int
) -> FrameStack:
    label = digest([c.to_data(), effects.to_data()])
    return taken(bench.unit(view, effects, unit), frames, bench.camera_name, "plane", label, unit)


@lru_cache(maxsize=8)
def plane_stack(bench: Bench, c: PlaneConditions, effects: EffectsConfig, frames: int, unit: int = 1) -> FrameStack:
    """Frames of a plane about the axis."""
    return _taken(bench, c, _view(bench, c, PATCH), effects, frames, unit)


def _noise_stack(bench: Bench, c: PlaneConditions) -> FrameStack:
    return plane_stack(bench, _plane(c), NOISE, bench.effort.noise_frames)


def _deviation(stack: FrameStack) -> Reading:
    return jackknifed(stack.z_m, lambda z: temporal_sigma_m(z, stack.everywhere) / MM)


@_quantity("temporal deviation", PlaneConditions)
def temporal_sigma_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Standard deviation over frames of one pixel's z, rms over pixels, noise alone."""
    return _deviation(_noise_stack(bench, c))


@_quantity("random error", PlaneConditions)
def random_error_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Standard deviation over frames of one pixel's z with whole-frame jitter and jumps, rms over pixels."""
    return _deviation(plane_stack(bench, _plane(c), WHOLE, bench.effort.whole_frames))


@_quantity("noise correlation", LagConditions)
def noise_correlation(bench: Bench, c: LagConditions) -> Reading:
    """Correlation of the temporal noise of two pixels, noise alone."""
    stack = _noise_stack(bench, c)
    return jackknifed(stack.z_m, lambda z: correlation_at(z, stack.everywhere, c.lag_x_px, c.lag_y_px))


@_quantity("valid fraction", PlaneConditions)
def valid_fraction(bench: Bench, c: PlaneConditions) -> Reading:
    """Share of pixels about the axis that have a range.

    As many neighbours count as a single pixel as the camera's own filter mixes.
    """
    stack = plane_stack(bench, _plane(c), NOISE, bench.effort.valid_frames)
    return share_of(np.isfinite(stack.z_m), (2 * bench.camera.optics.margin_px + 1) ** 2)


@_quantity("amplitude", PlaneConditions)
def amplitude(bench: Bench, c: PlaneConditions) -> Reading:
    """Mean amplitude, camera's units."""
    return Reading(float(np.nanmean(_noise_stack(bench, c).amplitude)))


def _mean_errors_mm(bench: Bench, c: PlaneConditions, unit: int) -> np.ndarray:
    """(n,) each frame's mean error over the pixels with a range; NaN where it has none."""
    stack = plane_stack(bench, _plane(c), STEADY, bench.effort.bias_frames, unit)
    some = np.isfinite(stack.z_m).any(axis=(1, 2))
    errors = np.full(len(stack.z_m), np.nan)
    errors[some] = np.nanmean(stack.z_m[some] - stack.true_z_m, axis=(1, 2)) / MM
    return errors


@_quantity("bias of one unit", PlaneConditions)
def bias_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Mean error of z of unit 1 with all its effects but jumps, direct light only."""
    return mean_of(_mean_errors_mm(bench, c, 1))


@_quantity("systematic error", PlaneConditions)
def systematic_error_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Greatest absolute mean error of z among ten units an hour after power-on, direct light only.

    It has no interval: it is the worst of these units.
    """
    units = range(1, bench.effort.units + 1)
    errors = [abs(float(np.nanmean(_mean_errors_mm(bench, c, unit)))) for unit in units]
    known = [error for error in errors if np.isfinite(error)]
    return Reading(max(known)) if known else NOTHING


@_quantity("fixed pattern", PlaneConditions)
def fixed_pattern_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Deviation over pixels of the average less a smooth surface and the noise left in it, mean of five units."""
    view = _view(bench, _plane(c), PATTERN_PATCH)
    found = []
    for unit in range(1, min(bench.effort.units, 5) + 1):
        stack = _taken(bench, _plane(c), view, PATTERNED, bench.effort.noise_frames // 4, unit)
        where = np.isfinite(stack.z_m).all(axis=0)
        if where.mean() > 0.5:
            found.append(fixed_pattern(np.nan_to_num(stack.z_m), where, stack.slopes, lags=12).std_m / MM)
    return mean_of(found)


@_quantity("frame jitter", PlaneConditions)
def frame_jitter_mm(bench: Bench, c: PlaneConditions) -> Reading:
    """Deviation of a frame's mean over 960 pixels from frame to frame; jumps of over 5 mm left out."""
    stack = plane_stack(bench, _plane(c), JITTER, bench.effort.whole_frames)
    if not np.isfinite(stack.z_m).any(axis=(1, 2)).all():
        return NOTHING
    return jitter_of(np.nanmean(stack.z_m - stack.true_z_m, axis=(1, 2)))


def jitter_of(means_m: np.ndarray) -> Reading:
    """Deviation in mm of frames' means (n,), without those that jump."""
    steady = means_m[np.abs(means_m - np.median(means_m)) < JUMP_M]
    return jackknifed(steady, lambda m: float(m.std(ddof=1)) / MM) if steady.size >= 2 else NOTHING


# ---- steps -----------------------------------------------------------------------------------------------------------


@_quantity("gap at an edge", StepConditions)
def edge_gap_px(bench: Bench, c: StepConditions) -> Reading:
    """Width across an edge of pixels without a range, shadow included."""
    return mean_of(steps.widths(bench, c).gap)


@_quantity("flying pixels", StepConditions)
def flying_pixels_px(bench: Bench, c: StepConditions) -> Reading:
    """Width across an edge of pixels whose range is off both surfaces by more than four deviations and a tenth of the
    step."""
    return mean_of(steps.widths(bench, c).flying)


@_quantity("erosion of the front", StepConditions)
def front_erosion_px(bench: Bench, c: StepConditions) -> Reading:
    """Width of pixels that look at the front and do not show it."""
    return mean_of(steps.widths(bench, c).front_erosion)


@_quantity("erosion of the back", StepConditions)
def back_erosion_px(bench: Bench, c: StepConditions) -> Reading:
    """Width of pixels that look at the back and do not show it, shadow included."""
    return mean_of(steps.widths(bench, c).back_erosion)


@_quantity("seen share of a step", PlateauConditions)
def seen_share(bench: Bench, c: PlateauConditions) -> Reading:
    """Height seen in the middle of a round plateau by its true height.

    The mean is over plateaus that most frames see.
    """
    return mean_of(steps.seen_shares(bench, c))


@_quantity("smallest surviving step", SurvivalConditions)
def smallest_step_mm(bench: Bench, c: SurvivalConditions) -> Reading:
    """Lowest step of a round plateau of which at least half is seen in its middle, in most of 16 places.

    It is infinite where none of the heights that are tried survives.
    """
    below = 0.0
    for step_mm in LADDER_MM:
        shares = steps.seen_shares(bench, PlateauConditions(**c.to_data(), step_mm=step_mm))
        if np.mean(np.nan_to_num(shares, nan=0.0) >= SURVIVES) > 0.5:
            return Reading(step_mm, Interval(below, step_mm))
        below = step_mm
    return Reading(float("inf"), Interval(below, float("inf")))


# ---- a board in a room: what light that met more than one surface does to its depth ----------------------------------


@_quantity("bias of a board in a room", RoomConditions)
def board_bias_mm(bench: Bench, c: RoomConditions) -> Reading:
    """Mean error of z over a board of 400 x 300 mm before a floor and a wall, without noise and traits of a unit.

    The interval is two deviations of what the render's Monte Carlo leaves in a pixel, as if all pixels shared it.
    """
    errors_mm, monte_carlo_mm = _room_errors_mm(bench, c)
    if errors_mm.size == 0:
        return NOTHING
    left_mm = MONTE_CARLO_SIGMAS * float(np.sqrt((monte_carlo_mm**2).mean())) if c.multipath else 0.0
    value = float(errors_mm.mean())
    return Reading(value, Interval(value - left_mm, value + left_mm))


@_quantity("bend of a board in a room", RoomConditions)
def board_bend_mm(bench: Bench, c: RoomConditions) -> Reading:
    """Deviation over the board's pixels of the same error; contains the rounding of the output."""
    errors_mm, _ = _room_errors_mm(bench, c)
    return Reading(float(errors_mm.std())) if errors_mm.size else NOTHING


@lru_cache(maxsize=4)
def _room_errors_mm(bench: Bench, c: RoomConditions) -> tuple[np.ndarray, np.ndarray]:
    """(n,) errors of z at the valid pixels of the board's inside, and what the render leaves of noise there; in mm.

    A plain flat board stands on a wooden table, which is lit before the board and lights it from below, with a wall
    behind. Its tilt lets rounding of the output meet every phase of its step.
    """
    from scenes.render.cache import cached_view
    from scenes.render.settings import RenderConfig
    from scenes.target.custom import BoardConfig, FlatConfig, MaterialConfig, PoseConfig, RoomConfig, TargetConfig

    target = TargetConfig(
        board=BoardConfig(width_mm=400.0, height_mm=300.0, thickness_mm=12.0, shape=FlatConfig()),
        material=MaterialConfig(albedo_850=0.6, grain_contrast=0.0),
        room=RoomConfig(floor_below_lens_m=0.2, floor_albedo_850=0.6, back_wall_distance_m=2.5),
        pose=PoseConfig(distance_m=c.distance_m, tilt_x_deg=3.0, tilt_y_deg=4.0),
    )
    view, _ = cached_view(target, bench.camera.optics, RenderConfig(), bench.renders)
    unit = bench.unit(view, NO_EFFECTS.model_copy(update={"multipath": c.multipath}))
    stack = taken(unit, 1, bench.camera_name, "room")
    board = view.surface == view.surface_names.index("board")
    rim = 2 * (2 * bench.camera.optics.margin_px + 1)
    inside = ndimage.binary_erosion(board, iterations=rim)[unit.cut] & np.isfinite(stack.z_m[0])
    return (stack.z_m[0] - stack.true_z_m)[inside] / MM, view.indirect_noise_m[unit.cut][inside] / MM
