"""Unfolding axes, switches and variations into points: each is validated, problems stand at the value that causes them.

Set-ups of an experiment differ in the axes other than the number of frames, and switches by name.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Any

from harness.experiment import checks
from harness.experiment.dotted import PathError, get_path, key_path, path_problem, set_path
from harness.experiment.points import MAIN, Point, point_of
from harness.experiment.schema import ExperimentConfig, declared_of, splices_of
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import validated
from harness.vocabulary.declaration.problems import Place, Problem
from harness.vocabulary.declaration.yaml_source import KeyPath, Source
from harness.vocabulary.path_names import names_of, on_one_line, value_text
from harness.vocabulary.seeds import canonical_json

MAX_POINTS = 10_000
"""More than a machine works through in a week; beyond it an axis was mistyped."""
MAX_SHOWN = 20
"""Problems of combinations are found one point at a time and look alike."""
FRAMES = "capture.frames"
SWITCHES = "switches"
"""Key of the file that names a mapping of switches."""
FIXED = ("name", "title", "repeats", "study", "sweep", SWITCHES, "sensitivity")
"""Keys that are the same for all points."""


@dataclass(frozen=True)
class Setting:
    """One path set to one value, where in the source that value is written, and what to call it (empty: as it is)."""

    path: str
    value: Any
    written_at: KeyPath
    name: str = ""


@dataclass(frozen=True)
class Draft:
    """A point before its declaration is resolved. ``frames``: a variation's own numbers of frames."""

    label: str
    variant: str
    settings: tuple[Setting, ...]
    is_variation: bool = False
    frames: tuple[Setting, ...] = ()

    @property
    def named_at(self) -> KeyPath:
        """Place in the file: its label where it has one, else its last value."""
        at = self.settings[-1].written_at
        return (*at[:3], "label") if "set" in at[:4] else at


def unfolded(source: Source, config: ExperimentConfig | None) -> tuple[tuple[Point, ...], list[Problem]]:
    """All points of an experiment in order, or all problems of its axes and variations.

    ``config`` is None where the rest of the file is not valid: then axes are checked as far as they can be.
    """
    sweep = shape.child(source.data, "sweep")
    axes = [
        [Setting(path, value, ("sweep", path, index)) for index, value in enumerate(values)]
        for path, values in (sweep.items() if isinstance(sweep, dict) else ())
        if isinstance(values, list)
    ]
    variations = list(_written_variations(source.data))
    switches = _switches(config, config.switches) if config and config.switches else {}
    problems = [*_axis_problems(axes, source), *_variation_problems(variations, axes, source)]
    problems += _switch_problems(config, switches, source) if config is not None else ()
    singles = [Draft(_label([setting]), "", (setting,)) for axis in axes for setting in axis]
    for draft in (*singles, *variations):
        if not any(True for setting in draft.settings for _ in _path_problems(setting.path, _NOWHERE, source, FIXED)):
            problems += _value_problems(draft, source, config is not None)
    if problems or config is None:
        return (), problems
    if config.switches:
        axes = [_switch_axis(config.switches, list(switches)), *axes]
    points, problems = _points(list(_drafts(axes, variations, config)), config, source)
    return tuple(_with_references(points, [axis[0].path for axis in axes if len(axis) > 1])), problems


_NOWHERE = Place("", 0, 1, "")


def sameness(value: Any) -> str:
    """Equal for values that YAML writes in two ways, such as 1 and 1.0; true is not 1."""
    if isinstance(value, Mapping):
        return canonical_json({key: sameness(inner) for key, inner in value.items()})
    if isinstance(value, list | tuple):
        return canonical_json([sameness(inner) for inner in value])
    return repr(float(value)) if isinstance(value, int | float) and not isinstance(value, bool) else repr(value)


# ---- what is written -------------------------------------------------------------------------------------------------


def _written_variations(data: Any) -> Iterator[Draft]:
    """The variations as they are written, without the study's numbers of frames, as far as they have the right form."""
    vary = shape.get(data, ("sensitivity", "vary"))
    for index, each in enumerate(vary if isinstance(vary, list) else ()):
        at: KeyPath = ("sensitivity", "vary", index)
        path, values, label, together = (shape.child(each, key) for key in ("path", "values", "label", "set"))
        frames = _frame_settings(shape.child(each, "frames"), (*at, "frames"))
        if isinstance(path, str) and isinstance(values, list):
            for number, value in enumerate(values):
                setting = Setting(path, value, (*at, "values", number))
                yield Draft(_label([setting]), _label([setting]), (setting,), True, frames)
        elif isinstance(label, str) and isinstance(together, dict):
            settings = tuple(Setting(key, value, (*at, "set", key)) for key, value in together.items())
            yield Draft(label, label, settings, True, frames)


def _frame_settings(frames: Any, at: KeyPath) -> tuple[Setting, ...]:
    """Numbers of frames that are written at a place."""
    return tuple(Setting(FRAMES, n, (*at, k)) for k, n in enumerate(frames if isinstance(frames, list | tuple) else ()))


def _switches(config: ExperimentConfig, path: str) -> dict[str, bool]:
    """The switches at a path, {} where there is anything else."""
    try:
        found = get_path(config.to_data(), key_path(path))
    except PathError:
        return {}
    switches = isinstance(found, dict) and all(isinstance(value, bool) for value in found.values())
    return found if switches else {}


def _switch_axis(path: str, names: Sequence[str]) -> list[Setting]:
    """An axis over a mapping of switches: none on, each alone, all but each, all."""
    on: dict[str, set[str]] = {"none": set()}
    on |= {f"{name} alone": {name} for name in names}
    on |= {f"all but {name}": {*names} - {name} for name in names}
    on |= {"all": {*names}}
    distinct = {frozenset(chosen): label for label, chosen in reversed(on.items())}
    return [
        Setting(path, {name: name in chosen for name in names}, (SWITCHES,), label.replace("_", " "))
        for chosen, label in reversed(distinct.items())
    ]


def _label(settings: Iterable[Setting]) -> str:
    said = (setting.name or f"{setting.path}={on_one_line(setting.value)}" for setting in settings)
    return ", ".join(said) or "the experiment as it stands"


def _set_up_label(settings: Sequence[Setting]) -> str:
    """The name of one of several set-ups: ``camera=kinect_v2, distance=0.75 m``."""
    names = names_of(setting.path for setting in settings)
    return ", ".join(
        setting.name or f"{names[setting.path]}={value_text(setting.path, setting.value)}" for setting in settings
    )


# ---- what is wrong with it -------------------------------------------------------------------------------------------


def _axis_problems(axes: list[list[Setting]], source: Source) -> Iterator[Problem]:
    paths = [axis[0].path for axis in axes if axis]
    for path in paths:
        at = source.key_place_of(("sweep", path))
        yield from _path_problems(path, at, source, FIXED)
        outer = next((other for other in paths if path.startswith(other + ".")), None)
        if outer:
            message = f"the axes `{outer}` and `{path}` set the same key"
            yield Problem(message, at, fix=f"sweep `{outer}` alone, or only keys within it")
    for axis in axes:
        yield from _repeated_values(axis, source)
    count = prod(len(axis) for axis in axes)
    if count > MAX_POINTS:
        yield Problem(f"the axes make {count} points", source.key_place_of(("sweep",)), legal=f"at most {MAX_POINTS}")


def _switch_problems(config: ExperimentConfig, switches: Mapping[str, bool], source: Source) -> Iterator[Problem]:
    """``switches`` must name a mapping of at least two switches, and no axis may set what it sets."""
    path = config.switches
    if path is None:
        return
    place = source.place_of((SWITCHES,))
    if len(switches) < 2:
        legal = "a mapping of at least two keys that are true or false, such as source.camera.effects"
        yield Problem(f"`{path}` does not hold switches", place, legal=legal)
    for axis in config.sweep:
        if f"{axis}.".startswith(f"{path}.") or f"{path}.".startswith(f"{axis}."):
            message = f"the switches `{path}` and the axis `{axis}` set the same key"
            yield Problem(message, place, fix="sweep other keys, or leave the switches out")


def _variation_problems(variations: list[Draft], axes: list[list[Setting]], source: Source) -> Iterator[Problem]:
    first: dict[str, Draft] = {}
    for draft in variations:
        yield from _repeated_values(draft.frames, source)
        for setting in draft.settings:
            is_list = "values" in setting.written_at
            path_at = source.place_of((*setting.written_at[:3], "path"))
            at = path_at if is_list else source.key_place_of(setting.written_at)
            yield from _path_problems(setting.path, at, source, (*FIXED, FRAMES))
        twin = first.setdefault(draft.label, draft)
        if twin is not draft:
            here, there = (source.place_of(each.named_at) for each in (draft, twin))
            message, fix = f"two variations are called `{draft.label}`", "give each its own label or value"
            yield Problem(message, here, other=there, other_says="the first is at", fix=fix)
    # variations at a number of frames that the main experiment does not have could be compared with nothing
    swept = [setting.value for axis in axes for setting in axis if setting.path == FRAMES]
    main = swept or [shape.get(source.data, ("capture", "frames"))]
    written = _frame_settings(shape.get(source.data, ("sensitivity", "frames")), ("sensitivity", "frames"))
    yield from _repeated_values(written, source)
    for setting in written:
        if setting.value not in main:
            legal = "of " + ", ".join(dict.fromkeys(str(n) for n in main if isinstance(n, int)))
            message = (
                f"{setting.value} frames are not run in the main experiment, so that there is nothing to compare with"
            )
            yield Problem(message, source.place_of(setting.written_at), legal)


def _path_problems(path: str, place: Place, source: Source, fixed: Iterable[str]) -> Iterator[Problem]:
    if any(path == key or path.startswith(key + ".") for key in fixed):
        reason = "set by `sensitivity.frames`" if path == FRAMES else "the same for all points"
        yield Problem(f"`{path}` cannot be varied here: it is {reason}", place)
    elif problem := path_problem(key_path(path), declared_of(source.data), place):
        yield problem


def _repeated_values(axis: Iterable[Setting], source: Source) -> Iterator[Problem]:
    first: dict[str, Setting] = {}
    for setting in axis:
        twin = first.setdefault(sameness(setting.value), setting)
        if twin is not setting:
            here, there = (source.place_of(each.written_at) for each in (setting, twin))
            message = f"{on_one_line(setting.value)} is in this list twice"
            yield Problem(message, here, other=there, other_says="first at", fix="keep one")


def _value_problems(draft: Draft, source: Source, base_is_valid: bool) -> Iterator[Problem]:
    """Problems that one value (or one labelled set) makes by itself; the rest of the file reports its own."""
    place = source.place_of(draft.named_at)
    try:
        located = _located(draft, source)
    except PathError as error:
        yield Problem(error.message, place)
        return
    starts = [setting.written_at for setting in draft.settings]
    own = {
        written
        for places in (source.values, source.keys)
        for at, written in places.items()
        if any(at[: len(start)] == start for start in starts)
    }
    for problem in _resolved(located)[1]:
        if problem.place in own:
            yield problem
        elif base_is_valid:
            yield replace(problem, message=f"with {draft.label}: {problem.message}", place=place)


# ---- points ----------------------------------------------------------------------------------------------------------


def _drafts(axes: list[list[Setting]], variations: list[Draft], config: ExperimentConfig) -> Iterator[Draft]:
    """The product of the axes, the last one fastest; then every variation at every number of frames of the study."""
    telling = {axis[0].path for axis in axes if len(axis) > 1} - {FRAMES}
    for settings in product(*axes):
        named = [setting for setting in settings if setting.path in telling]
        yield Draft(_label(settings), _set_up_label(named) if telling else MAIN, settings)
    if config.sensitivity is None:
        return
    common = _frame_settings(config.sensitivity.frames, ("sensitivity", "frames"))
    for variation in variations:
        for frames in variation.frames or common:
            label = f"{variation.label}, {FRAMES}={frames.value}"
            yield Draft(label, variation.label, (frames, *variation.settings), True)


def _points(drafts: list[Draft], experiment: ExperimentConfig, source: Source) -> tuple[list[Point], list[Problem]]:
    points: list[Point] = []
    problems: list[Problem] = []
    first: dict[str, Draft] = {}
    for draft in drafts:
        # a set-up and a variation, or two set-ups whose long values are shortened alike, could not be told apart
        twin = first.setdefault(draft.variant, draft)
        others = ([sameness(s.value) for s in each.settings if s.path != FRAMES] for each in (draft, twin))
        if next(others) != next(others):
            place = source.place_of(draft.named_at)
            message = f"two different set-ups are called `{draft.variant}`"
            problems.append(Problem(message, place, fix="give one another label"))
            break
    known: dict[str, Draft] = {}
    for draft in drafts:
        config, found = _resolved(_located(draft, source))
        if config is None or found:
            problems += [replace(each, message=f"with {draft.label}: {each.message}") for each in found]
            if len(problems) >= MAX_SHOWN:
                break
            continue
        values = {setting.path: setting.value for setting in draft.settings}
        if draft.is_variation and experiment.sensitivity is not None:
            study, calibrate = experiment.sensitivity, config.threshold.calibrate
            if calibrate is not None and calibrate.repeats is not None and study.calibration_repeats is not None:
                calibrate = calibrate.model_copy(update={"repeats": study.calibration_repeats})
            threshold = config.threshold.model_copy(update={"calibrate": calibrate})
            config = config.model_copy(update={"repeats": study.repeats, "threshold": threshold})
        point = replace(point_of(draft.label, draft.variant, values, config), is_variation=draft.is_variation)
        twin = draft if draft.is_variation else known.setdefault(point.digest, draft)
        if twin is not draft:
            place = source.place_of(draft.named_at)
            problems.append(Problem(f"the points {draft.label} and {twin.label} are the same experiment", place))
        points.append(point)
    return points, problems


def _located(draft: Draft, source: Source) -> Source:
    """The source of one point: its values set, with the places where they are written; no axes left."""
    data = {key: value for key, value in source.data.items() if key not in ("sweep", "sensitivity")}
    located = replace(source, data=data)
    for setting in draft.settings:
        path = key_path(setting.path)
        changed = set_path(located.data, path, setting.value, declared_of(located.data))
        located = located.with_value(path, changed, source, setting.written_at)
    return located


def _resolved(located: Source) -> tuple[ExperimentConfig | None, list[Problem]]:
    config, problems = validated(ExperimentConfig, located, splices_of(located.data))
    problems += checks.name_problems(located)
    if config is not None and not problems:
        problems += checks.joint_problems(config, located)
    return config, problems


def _with_references(points: Sequence[Point], axes: Iterable[str]) -> list[Point]:
    """The points with the values of ``axes`` from their resolved declarations, and with what to compare them with."""
    paths = [path for path in axes if path != FRAMES]
    placed = []
    for point in points:
        data, values = json.loads(json.dumps(point.config.to_data())), {}
        for path in paths:
            try:
                values[path] = get_path(data, key_path(path))
            except PathError:
                values[path] = None
        placed.append(replace(point, axes=values))
    set_ups = {sameness(point.axes): point.variant for point in placed if not point.is_variation}
    return [
        replace(point, reference=set_ups.get(sameness(point.axes), "") if point.is_variation else point.variant)
        for point in placed
    ]
