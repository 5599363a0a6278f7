"""The curves of the scorecard: which quantities are measured over which conditions, for every camera alike."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from harness.scorecard.conditions import (
    LagConditions,
    PlaneConditions,
    RoomConditions,
    StepConditions,
    SurvivalConditions,
)
from harness.vocabulary.config import Config

STEPS_MM = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
EDGES = ("edge_gap_px", "flying_pixels_px", "front_erosion_px", "back_erosion_px")


@dataclass(frozen=True)
class Grids:
    """The conditions of every curve; distances in metres."""

    distance_m: tuple[float, ...]
    albedo: tuple[float, ...]
    angle_deg: tuple[float, ...]
    lag_px: tuple[int, ...]
    map_distance_m: tuple[float, ...]
    map_albedo: tuple[float, ...]
    step_mm: tuple[float, ...]
    diameter_px: tuple[float, ...]
    bias_distance_m: tuple[float, ...]
    room_distance_m: tuple[float, ...]


FULL_GRIDS = Grids(
    distance_m=tuple(0.5 + 0.25 * k for k in range(15)),
    albedo=(0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 0.95),
    angle_deg=(0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0),
    lag_px=tuple(range(1, 9)),
    map_distance_m=(0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0),
    map_albedo=(0.05, 0.1, 0.15, 0.2, 0.4, 0.6, 0.8, 0.95),
    step_mm=STEPS_MM,
    diameter_px=(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0),
    bias_distance_m=tuple(0.5 + 0.25 * k for k in range(15)),
    room_distance_m=(0.5, 0.7, 1.0, 1.5),
)
QUICK_GRIDS = Grids(
    distance_m=(0.5, 1.5, 4.0),
    albedo=(0.05, 0.8),
    angle_deg=(0.0, 60.0),
    lag_px=(1, 4),
    map_distance_m=(1.0, 4.0),
    map_albedo=(0.05, 0.8),
    step_mm=(10.0, 200.0),
    diameter_px=(2.0, 5.0),
    bias_distance_m=(0.5, 1.5),
    room_distance_m=(),
)


@dataclass(frozen=True)
class CurvePoint:
    """One point of one curve: ``curve`` names the picture that it belongs to."""

    curve: str
    quantity: str
    conditions: Config


def curve_points(grids: Grids) -> Iterator[CurvePoint]:
    """All points of all curves."""
    for quantity in ("temporal_sigma_mm", "amplitude"):
        yield from (CurvePoint("distance", quantity, PlaneConditions(distance_m=d)) for d in grids.distance_m)
        yield from (CurvePoint("albedo", quantity, PlaneConditions(albedo=a)) for a in grids.albedo)
        yield from (CurvePoint("angle", quantity, PlaneConditions(angle_deg=a)) for a in grids.angle_deg)
    for lag in grids.lag_px:
        yield CurvePoint("correlation_x", "noise_correlation", LagConditions(lag_x_px=lag, lag_y_px=0))
        yield CurvePoint("correlation_y", "noise_correlation", LagConditions(lag_x_px=0, lag_y_px=lag))
    for d, a in product(grids.map_distance_m, grids.map_albedo):
        yield CurvePoint("valid", "valid_fraction", PlaneConditions(distance_m=d, albedo=a))
    for step, quantity in product(grids.step_mm, EDGES):
        yield CurvePoint("edge_lit", quantity, StepConditions(step_mm=step))
        yield CurvePoint("edge_shadowed", quantity, StepConditions(step_mm=step, shadow=True))
        yield CurvePoint("edge_across_y", quantity, StepConditions(step_mm=step, across="y"))
    for size in grids.diameter_px:
        yield CurvePoint("survival", "smallest_step_mm", SurvivalConditions(diameter_px=size))
    for d in grids.bias_distance_m:
        yield CurvePoint("bias", "bias_mm", PlaneConditions(distance_m=d))
    for d, on, quantity in product(grids.room_distance_m, (False, True), ("board_bias_mm", "board_bend_mm")):
        yield CurvePoint("room", quantity, RoomConditions(distance_m=d, multipath=on))
