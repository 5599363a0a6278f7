"""Digests of what an experiment's results hang on: code, cameras and its own settings."""

from collections.abc import Iterable, Mapping
from typing import Any

from detectors import DETECTORS
from detectors.filters import filter_module
from harness.experiment.schema import Experiment, SimulatedSource
from harness.vocabulary.code_digests import DIGITS, Digests, code_digests
from harness.vocabulary.seeds import digest
from scenes.sensor.camera import load_camera

ROOTS = ("harness.trials.learning", "harness.evaluation.study.result", "harness.runs.calibration")
"""Modules that, with all that they import, decide a study's numbers; detectors come beside them."""
KINDS = ("scenes/sensor/amcw", "scenes/sensor/empirical", "scenes/sensor/lidar")
"""Rooms of one kind of camera each, which no other kind imports."""
ONLY_OF_CAPTURES = ("detectors/recordings",)
ONLY_OF_SEVERAL_VIEWS = ("detectors/views",)
EXPERIMENT = "experiment "
"""Begins the name of the part that stands for an experiment's own settings."""
CAMERA_PART = "camera "
"""Begins the name of the part that stands for a camera's numbers."""
NO_NUMBERS = ("name", "title")
"""Keys of an experiment on which no number hangs."""


def experiment_digests(experiment: Experiment) -> Digests:
    """Return the digests of all that a simulated experiment's results hang on."""
    sources = [point.config.source for point in experiment.points]
    simulated = [source for source in sources if isinstance(source, SimulatedSource)]
    digests = simulation_digests(
        detectors={point.config.detector.name for point in experiment.points},
        filters=_filters_of(experiment),
        cameras={source.camera.name for source in simulated},
        several_views=any(source.views is not None for source in simulated),
    )
    settings = {key: value for key, value in experiment.data.items() if key not in NO_NUMBERS}
    part = f"{EXPERIMENT}{experiment.config.name}"
    digests[part] = digest(_without_empty(settings))[:DIGITS]
    return digests


def _filters_of(experiment: Experiment) -> set[str]:
    """Return the names of the filters that an experiment uses."""
    chosen = [point.config.capture.filter for point in experiment.points]
    return {config.name for config in chosen if config is not None}


def simulation_digests(
    detectors: Iterable[str],
    cameras: Iterable[str],
    *,
    filters: Iterable[str] = (),
    several_views: bool = False,
) -> Digests:
    """Return the digests of the code that simulates and judges with these detectors, filters and
    cameras, and of the cameras' numbers. Rooms of which such a run uses nothing are left out."""
    modules = [DETECTORS.offer(name).target.partition(":")[0] for name in detectors]
    modules += [module for name in filters if (module := filter_module(name)) is not None]
    names = set(cameras)
    kinds = {type(load_camera(name)).__module__.rpartition(".")[0] for name in names}
    unused = [room for room in KINDS if room.replace("/", ".") not in kinds]
    unused += ONLY_OF_CAPTURES
    if not several_views:
        unused += ONLY_OF_SEVERAL_VIEWS
    digests = {}
    for room, room_digest in code_digests([*ROOTS, *modules]).items():
        if not room.startswith(tuple(unused)):
            digests[room] = room_digest
    return digests | camera_digests(names)


def camera_digests(names: Iterable[str]) -> Digests:
    """Return the digest of each camera's numbers, without their tags and sources."""
    digests = {}
    for name in sorted(names):
        numbers = _values(load_camera(name).to_data())
        digests[f"{CAMERA_PART}{name}"] = digest(numbers)[:DIGITS]
    return digests


def _values(data: Any) -> Any:
    """Return a camera's data with the value of each fact in place of value, tag, source and
    range."""
    if isinstance(data, Mapping):
        if "value" in data and "source" in data:
            return data["value"]
        return {key: _values(value) for key, value in data.items() if key not in NO_NUMBERS}
    if isinstance(data, list):
        return [_values(item) for item in data]
    return data


def _without_empty(data: Any) -> Any:
    """Return a declaration without empty keys, so that a new key that an experiment does not use
    changes no digest."""
    if not isinstance(data, Mapping):
        return data
    filled = {}
    for key, item in data.items():
        value = _without_empty(item)
        if value not in (None, {}, [], ()):
            filled[key] = value
    return filled
