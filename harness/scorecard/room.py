"""A board in a room: what light that met more than one surface does to the depth of the board."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import ndimage

from harness.evaluation.intervals import Interval
from harness.scorecard.bench import Bench, taken
from harness.scorecard.conditions import RoomConditions
from harness.scorecard.estimate import NOTHING, Estimate
from harness.vocabulary.units import MM
from scenes.render.cache import cached_view
from scenes.render.settings import RenderConfig
from scenes.sensor.camera import NO_EFFECTS
from scenes.target.custom import BoardConfig, FlatConfig, MaterialConfig, PoseConfig, RoomConfig, TargetConfig

BOARD_MM = (400.0, 300.0)
FLOOR_BELOW_LENS_M, FLOOR_ALBEDO = 0.2, 0.6
"""A wooden table that the board stands on: lit before the board, it lights the board from below."""
BACK_WALL_M = 2.5
TILT_DEG = (3.0, 4.0)
"""So that rounding of the output meets every phase of its step."""
MONTE_CARLO_SIGMAS = 2.0


def board_bias(bench: Bench, c: RoomConditions) -> Estimate:
    """Mean error of z over the board's inside, without noise and without traits of a unit.

    The interval is two deviations of what the render's Monte Carlo leaves in a pixel, as if all pixels shared it.
    """
    errors_mm, monte_carlo_mm = _errors_mm(bench, c)
    if errors_mm.size == 0:
        return NOTHING
    left_mm = MONTE_CARLO_SIGMAS * float(np.sqrt((monte_carlo_mm**2).mean())) if c.multipath else 0.0
    value = float(errors_mm.mean())
    return Estimate(value, Interval(value - left_mm, value + left_mm))


def board_bend(bench: Bench, c: RoomConditions) -> Estimate:
    """Deviation of the error of z over the board's inside, without noise: how far light in the room bends the board."""
    errors_mm, _ = _errors_mm(bench, c)
    return Estimate(float(errors_mm.std())) if errors_mm.size else NOTHING


@lru_cache(maxsize=4)
def _errors_mm(bench: Bench, c: RoomConditions) -> tuple[np.ndarray, np.ndarray]:
    """(n,) errors of z at the valid pixels of the board's inside, and what the render leaves of noise there; in mm."""
    view, _ = cached_view(board_in_room(c.distance_m), bench.camera.optics, RenderConfig(), bench.renders)
    unit = bench.unit(view, NO_EFFECTS.model_copy(update={"multipath": c.multipath}))
    stack = taken(unit, 1, bench.camera_name, "room")
    board = view.surface == view.surface_names.index("board")
    rim = 2 * (2 * bench.camera.optics.margin_px + 1)
    inside = ndimage.binary_erosion(board, iterations=rim)[unit.cut] & np.isfinite(stack.z_m[0])
    return (stack.z_m[0] - stack.true_z_m)[inside] / MM, view.indirect_noise_m[unit.cut][inside] / MM


def board_in_room(distance_m: float) -> TargetConfig:
    """A plain flat board before the camera, a floor below and a wall behind."""
    return TargetConfig(
        board=BoardConfig(width_mm=BOARD_MM[0], height_mm=BOARD_MM[1], thickness_mm=12.0, shape=FlatConfig()),
        material=MaterialConfig(albedo_850=0.6, grain_contrast=0.0),
        room=RoomConfig(
            floor_below_lens_m=FLOOR_BELOW_LENS_M, floor_albedo_850=FLOOR_ALBEDO, back_wall_distance_m=BACK_WALL_M
        ),
        pose=PoseConfig(distance_m=distance_m, tilt_x_deg=TILT_DEG[0], tilt_y_deg=TILT_DEG[1]),
    )
