"""Measuring a scorecard: which quantities over which conditions, each once; scenes are shared among what is measured
on them, cameras are measured in parallel."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from harness.scorecard.bench import Bench, Effort, Reading
from harness.scorecard.figures import Figure
from harness.scorecard.quantities import (
    QUANTITIES,
    LagConditions,
    PlaneConditions,
    RoomConditions,
    StepConditions,
    SurvivalConditions,
    scene_of,
)
from harness.vocabulary.config import Config
from harness.vocabulary.seeds import canonical_json

SAID_EVERY_S = 10.0
SLOW_FIRST = {"RoomConditions": 0, "SurvivalConditions": 1}
"""Kinds of scenes that take seconds: begun first, so that no worker ends on one alone."""
OWN_FRAMES = {"random_error_mm", "bias_mm", "systematic_error_mm", "fixed_pattern_mm", "frame_jitter_mm"}
"""Quantities that see other effects than noise, so share no frames with the rest."""
EDGES = ("edge_gap_px", "flying_pixels_px", "front_erosion_px", "back_erosion_px")


# ---- curves ----------------------------------------------------------------------------------------------------------


FULL_GRIDS: dict[str, tuple[float, ...]] = {
    "distance_m": tuple(0.5 + 0.25 * k for k in range(15)),
    "albedo": (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 0.95),
    "angle_deg": (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0),
    "lag_px": tuple(range(1, 9)),
    "map_distance_m": (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 7.0),
    "map_albedo": (0.05, 0.1, 0.15, 0.2, 0.4, 0.6, 0.8, 0.95),
    "step_mm": (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0),
    "diameter_px": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0),
    "bias_distance_m": tuple(0.5 + 0.25 * k for k in range(15)),
    "room_distance_m": (0.5, 0.7, 1.0, 1.5),
}
"""The conditions of every curve."""
QUICK_GRIDS: dict[str, tuple[float, ...]] = {
    "distance_m": (0.5, 1.5, 4.0),
    "albedo": (0.05, 0.8),
    "angle_deg": (0.0, 60.0),
    "lag_px": (1, 4),
    "map_distance_m": (1.0, 4.0),
    "map_albedo": (0.05, 0.8),
    "step_mm": (10.0, 200.0),
    "diameter_px": (2.0, 5.0),
    "bias_distance_m": (0.5, 1.5),
    "room_distance_m": (),
}


@dataclass(frozen=True)
class CurvePoint:
    """One point of one curve: ``curve`` names the picture that it belongs to."""

    curve: str
    quantity: str
    conditions: Config


def curve_points(grids: Mapping[str, tuple[float, ...]]) -> Iterator[CurvePoint]:
    """All points of all curves."""
    for quantity in ("temporal_sigma_mm", "amplitude"):
        for curve, key in (("distance", "distance_m"), ("albedo", "albedo"), ("angle", "angle_deg")):
            yield from (CurvePoint(curve, quantity, PlaneConditions(**{key: value})) for value in grids[key])
    for lag in map(int, grids["lag_px"]):
        yield CurvePoint("correlation_x", "noise_correlation", LagConditions(lag_x_px=lag, lag_y_px=0))
        yield CurvePoint("correlation_y", "noise_correlation", LagConditions(lag_x_px=0, lag_y_px=lag))
    for d, a in product(grids["map_distance_m"], grids["map_albedo"]):
        yield CurvePoint("valid", "valid_fraction", PlaneConditions(distance_m=d, albedo=a))
    for step, quantity in product(grids["step_mm"], EDGES):
        yield CurvePoint("edge_lit", quantity, StepConditions(step_mm=step))
        yield CurvePoint("edge_shadowed", quantity, StepConditions(step_mm=step, shadow=True))
        yield CurvePoint("edge_across_y", quantity, StepConditions(step_mm=step, across="y"))
    for size in grids["diameter_px"]:
        yield CurvePoint("survival", "smallest_step_mm", SurvivalConditions(diameter_px=size))
    for d in grids["bias_distance_m"]:
        yield CurvePoint("bias", "bias_mm", PlaneConditions(distance_m=d))
    for d, on, quantity in product(grids["room_distance_m"], (False, True), ("board_bias_mm", "board_bend_mm")):
        yield CurvePoint("room", quantity, RoomConditions(distance_m=d, multipath=on))


# ---- measuring -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Request:
    """One number that is wanted: a quantity of a camera under conditions."""

    camera: str
    quantity: str
    conditions: Config


def requests_of(cameras: Sequence[str], figures: Sequence[Figure], points: Sequence[CurvePoint]) -> tuple[Request, ...]:
    """The numbers that curves and figures need, each once."""
    wanted = [Request(figure.entry.camera, figure.quantity.name, figure.conditions) for figure in figures]
    wanted += [Request(camera, point.quantity, point.conditions) for camera in cameras for point in points]
    return tuple(dict.fromkeys(wanted))


def measured(requests: Iterable[Request], effort: Effort, renders: Path, jobs: int) -> dict[Request, Reading]:
    """Measure all requests, ``jobs`` scenes at a time. The numbers do not depend on ``jobs`` or on the order."""
    scenes: dict[str, list[Request]] = defaultdict(list)
    for request in requests:
        own = request.quantity if request.quantity in OWN_FRAMES else ""
        scenes[canonical_json([request.camera, *scene_of(request.conditions), own])].append(request)
    groups = sorted(scenes.values(), key=lambda group: SLOW_FIRST.get(type(group[0].conditions).__name__, 2))
    results: dict[Request, Reading] = {}
    said = time.monotonic()
    for group, readings in _done(groups, effort, renders, jobs):
        results.update(zip(group, readings, strict=True))
        if time.monotonic() - said > SAID_EVERY_S:
            said = time.monotonic()
            print(f"measured {len(results)} of {sum(map(len, groups))} numbers", file=sys.stderr, flush=True)
    return results


def _done(
    groups: list[list[Request]], effort: Effort, renders: Path, jobs: int
) -> Iterator[tuple[list[Request], list[Reading]]]:
    """Groups with their readings as they are measured, here or by worker processes."""

    def arguments(group: list[Request]) -> tuple[Any, ...]:
        wanted = [(request.quantity, request.conditions.to_data()) for request in group]
        return group[0].camera, wanted, effort, renders

    if jobs == 1:
        yield from ((group, measure_group(*arguments(group))) for group in groups)
        return
    from harness.engine.processes import LocalEngine
    from harness.engine.work import Job, Limits

    by_name = {f"scene {number}": group for number, group in enumerate(groups)}
    waiting, running = list(reversed(by_name.items())), 0
    with LocalEngine(jobs, Limits()) as engine:
        while waiting or running:
            while waiting and engine.room("trials") > 0:
                name, group = waiting.pop()
                engine.submit(Job(name, "trials", measure_group, arguments(group)))
                running += 1
            for job, ended in engine.ended():
                running -= 1
                yield by_name[job.name], ended.result()


def measure_group(
    camera: str, wanted: Sequence[tuple[str, dict[str, Any]]], effort: Effort, renders: Path
) -> list[Reading]:
    """Measure quantities of one camera on one scene, in this process."""
    bench = Bench(camera, effort, renders)
    return [
        QUANTITIES[name].measure(bench, QUANTITIES[name].conditions.from_data(conditions))
        for name, conditions in wanted
    ]
