"""Measuring a scorecard: every condition once, scenes shared among what is measured on them, cameras in parallel."""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.scorecard.bench import Bench, Effort
from harness.scorecard.conditions import scene_of
from harness.scorecard.curves import CurvePoint
from harness.scorecard.estimate import Estimate
from harness.scorecard.published import Figure
from harness.scorecard.quantities import QUANTITIES
from harness.vocabulary.config import Config
from harness.vocabulary.seeds import canonical_json

SAID_EVERY_S = 10.0
SLOW_FIRST = {"RoomConditions": 0, "SurvivalConditions": 1}
"""Kinds of scenes that take seconds: begun first, so that no worker ends on one alone."""
OWN_FRAMES = {"random_error_mm", "bias_mm", "systematic_error_mm", "fixed_pattern_mm", "frame_jitter_mm"}
"""Quantities that see other effects than noise, so share no frames with the rest."""


@dataclass(frozen=True)
class Request:
    """One number that is wanted: a quantity of a camera under conditions."""

    camera: str
    quantity: str
    conditions: Config


def requests_of(cameras: Sequence[str], figures: Sequence[Figure], points: Sequence[CurvePoint]) -> tuple[Request, ...]:
    """What curves and figures need, each once."""
    wanted = [Request(figure.entry.camera, figure.quantity.name, figure.conditions) for figure in figures]
    wanted += [Request(camera, point.quantity, point.conditions) for camera in cameras for point in points]
    return tuple(dict.fromkeys(wanted))


def measured(requests: Iterable[Request], effort: Effort, renders: Path, jobs: int) -> dict[Request, Estimate]:
    """Measure all requests, ``jobs`` scenes at a time. The numbers do not depend on ``jobs`` or on the order."""
    scenes: dict[str, list[Request]] = defaultdict(list)
    for request in requests:
        scenes[_scene_key(request)].append(request)
    groups = sorted(scenes.values(), key=lambda g: SLOW_FIRST.get(type(g[0].conditions).__name__, 2))
    results: dict[Request, Estimate] = {}
    done = _in_turn(groups, effort, renders) if jobs == 1 else _in_parallel(groups, effort, renders, jobs)
    said = time.monotonic()
    for group, estimates in done:
        results.update(zip(group, estimates, strict=True))
        if time.monotonic() - said > SAID_EVERY_S:
            said = time.monotonic()
            print(f"measured {len(results)} of {sum(map(len, groups))} numbers", file=sys.stderr, flush=True)
    return results


def _scene_key(request: Request) -> str:
    kind, data = scene_of(request.conditions)
    own = request.quantity if request.quantity in OWN_FRAMES else ""
    return canonical_json([request.camera, kind, data, own])


Done = tuple[list[Request], list[Estimate]]


def _in_turn(groups: list[list[Request]], effort: Effort, renders: Path) -> Iterator[Done]:
    for group in groups:
        yield group, measure_group(group[0].camera, _plain(group), effort, renders)


def _in_parallel(groups: list[list[Request]], effort: Effort, renders: Path, jobs: int) -> Iterator[Done]:
    from harness.engine.processes import LocalEngine
    from harness.engine.work import Job, Limits

    by_name = {f"scene {number}": group for number, group in enumerate(groups)}
    waiting, running = list(reversed(by_name.items())), 0
    with LocalEngine(jobs, Limits()) as engine:
        while waiting or running:
            while waiting and engine.room("trials") > 0:
                name, group = waiting.pop()
                arguments = (group[0].camera, _plain(group), effort, renders)
                engine.submit(Job(name, "trials", measure_group, arguments))
                running += 1
            for job, ended in engine.ended():
                running -= 1
                yield by_name[job.name], ended.result()


def _plain(group: list[Request]) -> list[tuple[str, dict[str, Any]]]:
    return [(request.quantity, request.conditions.to_data()) for request in group]


def measure_group(
    camera: str, wanted: Sequence[tuple[str, dict[str, Any]]], effort: Effort, renders: Path
) -> list[Estimate]:
    """Measure quantities of one camera on one scene, in this process."""
    bench = Bench(camera, effort, renders)
    found = []
    for name, data in wanted:
        quantity = QUANTITIES[name]
        found.append(quantity.measure(bench, quantity.conditions.from_data(data)))
    return found
