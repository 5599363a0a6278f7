"""The overrides of a first look, ``--quick``: fewer repeats, boards, and values on long axes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import ceil, prod
from typing import Any

import numpy as np

from harness.experiment.checks import LEAST_BOARDS
from harness.experiment.unfold import FRAMES
from harness.vocabulary.declaration import shape
from harness.vocabulary.path_names import UNKNOWNS

MOST_REPEATS = 5
CALIBRATION_BOARDS = 20
"""Boards that set a threshold, if the experiment has as many: 18 of the shipped size show one false
call per m2, of which 0.054 m2 are judged; two more for cameras whose outline takes more off."""
BUDGET_S = 90.0
"""Processor seconds of views, frames and detections of a first look. With some ten more for
imports, statistics and the page, it ends within a minute on two cores."""
LEAST_VIEW_S = 0.3
"""Processor seconds of a view."""
VIEW_S_MM = 0.08
"""The same, times the noise in mm that is allowed in holes: less noise takes more light."""
DEFAULT_NOISE_MM = 0.1
FIRST_S = 0.17
"""What a first trial on a board takes besides: crop, surface, sorting of rims."""
FRAMES_S = 0.15
"""The frames of a trial."""
DETECTION_S = 0.085
"""A detection at one number of frames."""
DETECTORS_S = {"local": 0.2, "matched": 0.05, "m3c2": 0.7, "fpfh_memory": 1.1}
"""The same of detectors that differ from it by a factor of about two or more."""
MAP_FRAMES_S = 0.45
"""The frames of a view of a map."""
MAP_DETECTION_S = 0.2
"""Making a map and a detection in it. All of these costs are from bills of 2026-11: they come to
0.9 to 1.4 times what first looks of eight shipped experiments were billed."""
DETECTORS = "detector.name"
OF_FRAMES = ("source.", "capture.")
"""Begin the paths of axes whose values need frames of their own."""
LEAST_DRAWS = 2
CALIBRATION_REPEATS = "threshold.calibrate.repeats"
CALIBRATED_BOARDS = "threshold.calibrate.boards"
BOARDS = "study.boards"
HOLE_FREE_BOARDS = "study.hole_free_boards"
SOURCE = "source."
"""Begins the paths of axes whose values need views of their own."""
DAMAGE = "source.target.damage"
UNIT = "source.camera.unit_seed"
"""Its units see the same views."""
LEARNING_BOARDS = 8
"""Further hole-free boards of a study, from which detectors may learn."""
Axes = dict[str, list[Any]]


@dataclass(frozen=True)
class _Costs:
    """Processor seconds of a first look, by the numbers of what it does for a set-up."""

    damaged_views: int
    """Number of views of a source with its damage."""
    hole_free_views: int
    """Number of views without, which sources share that differ in their damage alone."""
    damaged_trials: int
    """Number of trials of a set-up on the former."""
    hole_free_trials: int
    """Number of trials on the latter, shared likewise."""
    frame_counts: int
    """Numbers of frames at which each trial is judged."""
    view_s: float
    """Cost of a view, with the first trial on it."""
    frames_s: float
    """Cost of the frames of a trial."""
    detection_s: float
    """Cost of a detection, for detectors that are not in `DETECTORS_S`."""
    detector: str
    """The detector where no axis sets it."""

    @staticmethod
    def of(data: Any, counts: Mapping[str, int]) -> _Costs:
        """Return the costs of an experiment with these numbers of repeats or boards."""
        frames = shape.get(data, ("sweep", FRAMES))
        noise_mm = shape.get(data, ("source", "render", "hole_noise_mm"))
        if not isinstance(noise_mm, int | float) or noise_mm <= 0:
            noise_mm = DEFAULT_NOISE_MM
        is_mapped = bool(shape.get(data, ("mapping",)))
        places = _number(data, "source.views.count") or 1
        damaged = 1
        hole_free = 1
        damaged_trials = counts.get("repeats", 1)
        hole_free_trials = counts.get(CALIBRATION_REPEATS, 0)
        if BOARDS in counts:
            damaged = counts[BOARDS]
            hole_free = sum(count for path, count in counts.items() if path.endswith("boards"))
            hole_free -= damaged
            damaged_trials = damaged
            hole_free_trials = hole_free
            hole_free += _reference_views(data, damaged + hole_free) + LEARNING_BOARDS
        return _Costs(
            damaged_views=damaged * places,
            hole_free_views=hole_free * places,
            damaged_trials=damaged_trials,
            hole_free_trials=hole_free_trials,
            frame_counts=len(frames) if isinstance(frames, list) else 1,
            view_s=max(LEAST_VIEW_S, VIEW_S_MM / noise_mm) + FIRST_S,
            frames_s=places * (MAP_FRAMES_S if is_mapped else FRAMES_S),
            detection_s=MAP_DETECTION_S if is_mapped else DETECTION_S,
            detector=str(shape.get(data, ("detector", "name"))),
        )

    def seconds(self, axes: Axes) -> float:
        """Return the cost of all set-ups."""
        of_source = []
        for path, values in axes.items():
            if path.startswith(SOURCE) and path != UNIT:
                of_source.append(len(values))
        of_frames = [len(values) for path, values in axes.items() if path.startswith(OF_FRAMES)]
        others = [len(values) for path, values in axes.items() if path != DETECTORS]
        damages = len(axes.get(DAMAGE, [""]))
        views = self.damaged_views + self.hole_free_views / damages
        trials = self.damaged_trials + self.hole_free_trials / damages
        detectors_s = sum(self.of_detector(name) for name in axes.get(DETECTORS, [self.detector]))
        return (
            views * self.view_s * prod(of_source)
            + trials * self.frames_s * prod(of_frames)
            + trials * self.frame_counts * detectors_s * prod(others)
        )

    def of_detector(self, name: Any) -> float:
        """Return the cost of a detection."""
        return DETECTORS_S.get(str(name), self.detection_s)


def quick_overrides(data: Any) -> list[str]:
    """Return the overrides for a first look at an experiment, plain data as written: at most
    `MOST_REPEATS` repeats, a third of a study's boards, no sensitivity, no unknowns of a study, and
    ends and even steps of axes, or draws, that come to `BUDGET_S`."""
    title = shape.get(data, ("title",)) or shape.get(data, ("name",))
    overrides = [f"title={json.dumps(f'{title} (a first look)')}"]
    if shape.get(data, ("sensitivity",)):
        overrides.append("sensitivity=null")
    is_study = bool(shape.get(data, ("study",)))
    # a third of the boards is too few to tell unknowns apart
    if is_study and shape.get(data, (UNKNOWNS,)):
        overrides.append(f"{UNKNOWNS}=[]")
    counts = _fewer_repeats(data) | _fewer_boards(data)
    overrides += [f"{path}={count}" for path, count in counts.items()]
    return overrides + _fewer_set_ups(data, _Costs.of(data, counts))


def _fewer_repeats(data: Any) -> dict[str, int]:
    """Return the numbers of repeats, by their paths."""
    counts = {}
    for path in ("repeats", CALIBRATION_REPEATS):
        repeats = _number(data, path)
        if repeats is not None:
            counts[path] = min(repeats, MOST_REPEATS)
    return counts


def _fewer_boards(data: Any) -> dict[str, int]:
    """Return the numbers of a study's boards, by their paths."""
    least = {CALIBRATED_BOARDS: CALIBRATION_BOARDS}
    if shape.get(data, ("study", "precision")):
        least[BOARDS] = LEAST_BOARDS
    counts = {}
    for path in (BOARDS, HOLE_FREE_BOARDS, CALIBRATED_BOARDS):
        boards = _number(data, path)
        if boards is not None:
            third = ceil(boards / 3)
            counts[path] = min(boards, max(third, least.get(path, 1)))
    return counts


def _reference_views(data: Any, boards: int) -> int:
    """Return the number of views of what ``boards`` boards are compared with."""
    references = shape.get(data, ("sweep", "compared_with"))
    if not isinstance(references, list):
        references = [shape.get(data, ("compared_with",))]
    views = 0
    most_parts = 0
    for reference in references:
        kind = shape.child(reference, "kind")
        if kind == "scan":
            views = boards
        if kind == "good_parts":
            most_parts = max(most_parts, _number(reference, "parts") or 0)
    return views + most_parts


def _number(data: Any, path: str) -> int | None:
    """Return a whole number at a path; None if there is none."""
    value = shape.get(data, tuple(path.split(".")))
    return value if isinstance(value, int) else None


def _fewer_set_ups(data: Any, costs: _Costs) -> list[str]:
    """Return overrides of axes or of draws. Numbers of frames are kept: shorter averages are parts
    of the longest."""
    written = shape.get(data, ("sweep",))
    axes: Axes = {}
    if isinstance(written, Mapping):
        for path, values in written.items():
            is_axis = isinstance(path, str) and isinstance(values, list)
            if is_axis and path != FRAMES and values:
                axes[path] = values
    draws = _number(data, "draws")
    if draws is not None:
        draw_s = max(costs.seconds(axes), 0.1)  # impossible numbers are refused later
        return [f"draws={min(draws, max(int(BUDGET_S / draw_s), LEAST_DRAWS))}"]
    thinned = _thinned(axes, costs)
    overrides = []
    for path, values in thinned.items():
        if len(values) < len(axes[path]):
            overrides.append(f"sweep.{path}={json.dumps(values)}")
    return overrides


def _thinned(axes: Axes, costs: _Costs) -> Axes:
    """Return axes whose set-ups cost at most `BUDGET_S`, with at least one set-up: the longest
    axis, of equals the last, loses a value, and so on. Detectors lose the slowest; other axes keep
    their ends and even steps between them."""
    lengths = {path: len(values) for path, values in axes.items()}
    thinned = axes
    while costs.seconds(thinned) > BUDGET_S and max(lengths.values(), default=1) > 1:
        longest = max(reversed(lengths), key=lambda path: lengths[path])
        lengths[longest] -= 1
        thinned = {path: _even_steps(values, lengths[path]) for path, values in axes.items()}
        if DETECTORS in axes:
            fastest = sorted(axes[DETECTORS], key=costs.of_detector)[: lengths[DETECTORS]]
            thinned[DETECTORS] = [name for name in axes[DETECTORS] if name in fastest]
    return thinned


def _even_steps(values: list[Any], count: int) -> list[Any]:
    """Return so many of the values, in even steps from the first to the last."""
    places = np.linspace(0, len(values) - 1, count).round().astype(int)
    return [values[place] for place in places]
