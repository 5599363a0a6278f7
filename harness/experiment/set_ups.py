"""What tells the set-ups of one experiment apart: the axes other than the number of frames, and switches by name."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from harness.experiment.dotted import PathError, get_path, key_path
from harness.experiment.points import Point
from harness.experiment.schema import ExperimentConfig
from harness.vocabulary.declaration.problems import Problem
from harness.vocabulary.declaration.yaml_source import KeyPath, Source
from harness.vocabulary.path_names import names_of, value_text
from harness.vocabulary.seeds import canonical_json

FRAMES = "capture.frames"
SWITCHES = "switches"
"""Key of the file that names a mapping of switches."""


@dataclass(frozen=True)
class Setting:
    """One path set to one value, where in the source that value is written, and what to call it (empty: as it is)."""

    path: str
    value: Any
    written_at: KeyPath
    name: str = ""


def switch_axis(config: ExperimentConfig) -> list[Setting]:
    """An axis over a mapping of switches: none on, each alone, all but each, all. Empty where none is declared."""
    if config.switches is None:
        return []
    names = list(_switches(config, config.switches))
    on: dict[str, set[str]] = {"none": set()}
    on |= {f"{name} alone": {name} for name in names}
    on |= {f"all but {name}": {*names} - {name} for name in names}
    on |= {"all": {*names}}
    distinct = {frozenset(chosen): label for label, chosen in reversed(on.items())}
    return [
        Setting(config.switches, {n: n in chosen for n in names}, (SWITCHES,), label.replace("_", " "))
        for chosen, label in reversed(distinct.items())
    ]


def switch_problems(config: ExperimentConfig, source: Source) -> Iterator[Problem]:
    """Where ``switches`` does not name a mapping of at least two switches, or an axis sets what it sets."""
    path = config.switches
    if path is None:
        return
    place = source.place_of((SWITCHES,))
    if len(_switches(config, path)) < 2:
        legal = "a mapping of at least two keys that are true or false, such as source.camera.effects"
        yield Problem(f"`{path}` does not hold switches", place, legal=legal)
    for axis in config.sweep:
        if f"{axis}.".startswith(f"{path}.") or f"{path}.".startswith(f"{axis}."):
            message = f"the switches `{path}` and the axis `{axis}` set the same key"
            yield Problem(message, place, fix="sweep other keys, or leave the switches out")


def set_up_label(settings: Sequence[Setting]) -> str:
    """What one of several set-ups is called: ``camera=kinect_v2, distance=0.75 m``."""
    varied = [one for one in settings if one.path != FRAMES]
    names = names_of(one.path for one in varied)
    said = (one.name or f"{names[one.path]}={value_text(one.path, one.value)}" for one in varied)
    return ", ".join(said)


def with_references(points: Sequence[Point], axes: Iterable[str]) -> list[Point]:
    """The points with the values of ``axes`` from their resolved declarations, and with what to compare them with."""
    paths = [path for path in axes if path != FRAMES]
    placed = [replace(point, axes=_values(point.config, paths)) for point in points]
    set_ups = {sameness(point.axes): point.variant for point in placed if not point.is_variation}
    return [
        replace(point, reference=set_ups.get(sameness(point.axes), "") if point.is_variation else point.variant)
        for point in placed
    ]


def sameness(value: Any) -> str:
    """Equal for values that YAML writes in two ways, such as 1 and 1.0; true is not 1."""
    if isinstance(value, Mapping):
        return canonical_json({key: sameness(inner) for key, inner in value.items()})
    if isinstance(value, list | tuple):
        return canonical_json([sameness(inner) for inner in value])
    return repr(float(value)) if isinstance(value, int | float) and not isinstance(value, bool) else repr(value)


def _switches(config: ExperimentConfig, path: str) -> dict[str, bool]:
    """The switches at a path, {} where there is anything else."""
    try:
        found = get_path(config.to_data(), key_path(path))
    except PathError:
        return {}
    switches = isinstance(found, dict) and all(isinstance(value, bool) for value in found.values())
    return found if switches else {}


def _values(config: ExperimentConfig, paths: Sequence[str]) -> dict[str, Any]:
    data = json.loads(json.dumps(config.to_data()))
    values = {}
    for path in paths:
        try:
            values[path] = get_path(data, key_path(path))
        except PathError:
            values[path] = None
    return values
