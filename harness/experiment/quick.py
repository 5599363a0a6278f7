"""The overrides of a first look, ``--quick``: fewer repeats, boards, and values on long axes."""

import json
from collections.abc import Callable, Mapping
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
MOST_VIEWS = 100
"""Most views to render: one takes 0.2 to 0.5 s of processor time, and a first page is to come
within a minute of two cores."""
MOST_JUDGEMENTS = 180
"""Most judgements of a board by a set-up: one takes 0.2 to 0.4 s of processor time with its share
of the frames."""
DETECTORS = "detector.name"
JUDGEMENTS_OF = {"m3c2": 2, "fpfh_memory": 3}
"""For how many judgements one by a slower detector counts: it takes 0.6 and 0.9 s."""
LEAST_DRAWS = 2
CALIBRATION_REPEATS = "threshold.calibrate.repeats"
CALIBRATED_BOARDS = "threshold.calibrate.boards"
BOARDS = "study.boards"
HOLE_FREE_BOARDS = "study.hole_free_boards"
SOURCE = "source."
"""Begins the paths of axes whose values need views of their own."""
Axes = dict[str, list[Any]]


def quick_overrides(data: Any) -> list[str]:
    """Return the overrides for a first look at an experiment, plain data as written: at most
    `MOST_REPEATS` repeats, a third of a study's boards, no sensitivity, no unknowns of a study, and
    ends and even steps of axes, or draws, until `MOST_VIEWS` and `MOST_JUDGEMENTS` hold."""
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
    if is_study:
        trials = sum(count for path, count in counts.items() if path.endswith("boards"))
        views = trials + _reference_views(data, trials)
    else:
        trials = counts.get("repeats", 1) + counts.get(CALIBRATION_REPEATS, 0)
        views = 2  # with and without damage
    return overrides + _fewer_set_ups(data, views, trials)


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


def _fewer_set_ups(data: Any, views: int, trials: int) -> list[str]:
    """Return overrides of axes or of draws. ``views``: of each source; ``trials``: of each set-up.
    Frames cost little, as shorter averages are parts of the longest."""
    written = shape.get(data, ("sweep",))
    axes: Axes = {}
    if isinstance(written, Mapping):
        for path, values in written.items():
            if path != FRAMES and isinstance(values, list) and values:
                axes[path] = values
    draws = _number(data, "draws")
    if draws is not None:
        set_ups = _set_ups(axes) if shape.get(data, (UNKNOWNS,)) else 1
        affordable = min(MOST_VIEWS // views, MOST_JUDGEMENTS // (trials * set_ups))
        return [f"draws={min(draws, max(affordable, LEAST_DRAWS))}"]
    of_source = {path: values for path, values in axes.items() if path.startswith(SOURCE)}
    thinned = axes | _thinned(of_source, MOST_VIEWS // views, _set_ups)
    thinned = _thinned(thinned, MOST_JUDGEMENTS // trials, _judgements)
    overrides = []
    for path, values in thinned.items():
        if len(values) < len(axes[path]):
            overrides.append(f"sweep.{path}={json.dumps(values)}")
    return overrides


def _set_ups(axes: Axes) -> int:
    """Return the number of combinations of values."""
    return prod(len(values) for values in axes.values())


def _judgements(axes: Axes) -> int:
    """Return the number of judgements of a board by all combinations of values."""
    others = {path: values for path, values in axes.items() if path != DETECTORS}
    names = axes.get(DETECTORS, [""])
    return _set_ups(others) * sum(JUDGEMENTS_OF.get(str(name), 1) for name in names)


def _thinned(axes: Axes, most: int, counted: Callable[[Axes], int]) -> Axes:
    """Return axes that are ``counted`` as at most ``most``, with at least one set-up: the longest
    axis, of equals the last, loses a value, and so on. An axis keeps its ends and even steps
    between them."""
    lengths = {path: len(values) for path, values in axes.items()}
    thinned = axes
    while counted(thinned) > most and _set_ups(thinned) > 1:
        longest = max(reversed(lengths), key=lambda path: lengths[path])
        lengths[longest] -= 1
        thinned = {path: _even_steps(values, lengths[path]) for path, values in axes.items()}
    return thinned


def _even_steps(values: list[Any], count: int) -> list[Any]:
    """Return so many of the values, in even steps from the first to the last."""
    places = np.linspace(0, len(values) - 1, count).round().astype(int)
    return [values[place] for place in places]
