"""From axes and variations to points: each one validated, each problem at the value that causes it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Any

from harness.experiment import checks
from harness.experiment.declared import declared_of, detector_content, splices_of
from harness.experiment.dotted import PathError, key_path, path_problem, set_path
from harness.experiment.points import MAIN, Point, point_of
from harness.experiment.schema import ExperimentConfig
from harness.experiment.set_ups import (
    FRAMES,
    SWITCHES,
    Setting,
    sameness,
    set_up_label,
    switch_axis,
    switch_problems,
    with_references,
)
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import validated
from harness.vocabulary.declaration.problems import Place, Problem
from harness.vocabulary.declaration.yaml_source import KeyPath, Source
from harness.vocabulary.path_names import on_one_line

MAX_POINTS = 10_000
"""More than a machine works through in a week; beyond it an axis was mistyped."""
MAX_SHOWN = 20
"""Problems of combinations are found one point at a time and look alike."""
FIXED = ("name", "title", "repeats", "study", "sweep", SWITCHES, "sensitivity")
"""Keys that are the same for all points."""


@dataclass(frozen=True)
class Draft:
    """A point before its declaration is resolved."""

    label: str
    variant: str
    settings: tuple[Setting, ...]
    is_variation: bool = False
    repeats: int | None = None
    calibration_repeats: int | None = None
    frames: tuple[Setting, ...] = ()


def unfolded(source: Source, config: ExperimentConfig | None) -> tuple[tuple[Point, ...], list[Problem]]:
    """All points of an experiment in order, or all problems of its axes and variations.

    ``config`` is None where the rest of the file is not valid: then axes are checked as far as they can be.
    """
    axes = _written_axes(source.data)
    variations = list(_written_variations(source.data))
    problems = [*_axis_problems(axes, source), *_variation_problems(variations, axes, source)]
    problems += switch_problems(config, source) if config is not None else ()
    singles = [Draft(_label([one]), "", (one,)) for axis in axes for one in axis]
    for draft in (*singles, *variations):
        if not any(True for one in draft.settings for _ in _path_problems(one.path, _NOWHERE, source, FIXED)):
            problems += _value_problems(draft, source, config is not None)
    if problems or config is None:
        return (), problems
    switches = switch_axis(config)
    axes = [switches, *axes] if switches else axes
    points, problems = _points(list(_drafts(axes, variations, config)), source)
    return tuple(with_references(points, [axis[0].path for axis in axes if len(axis) > 1])), problems


_NOWHERE = Place("", 0, 1, "")


def _written_axes(data: Any) -> list[list[Setting]]:
    """The axes as they are written, as far as they have the right form."""
    sweep = shape.child(data, "sweep")
    axes = sweep.items() if isinstance(sweep, dict) else ()
    return [
        [Setting(path, value, ("sweep", path, index)) for index, value in enumerate(values)]
        for path, values in axes
        if isinstance(values, list)
    ]


def _written_variations(data: Any) -> Iterator[Draft]:
    """The variations as they are written, without their numbers of frames, as far as they have the right form."""
    vary = shape.get(data, ("sensitivity", "vary"))
    for index, one in enumerate(vary if isinstance(vary, list) else ()):
        at: KeyPath = ("sensitivity", "vary", index)
        path, values, label, together = (shape.child(one, key) for key in ("path", "values", "label", "set"))
        own = shape.child(one, "frames")
        frames = tuple(
            Setting(FRAMES, n, (*at, "frames", k)) for k, n in enumerate(own if isinstance(own, list) else ())
        )
        if isinstance(path, str) and isinstance(values, list):
            for number, value in enumerate(values):
                setting = Setting(path, value, (*at, "values", number))
                yield Draft(_label([setting]), _label([setting]), (setting,), is_variation=True, frames=frames)
        elif isinstance(label, str) and isinstance(together, dict):
            settings = tuple(Setting(key, value, (*at, "set", key)) for key, value in together.items())
            yield Draft(label, label, settings, is_variation=True, frames=frames)


def _axis_problems(axes: list[list[Setting]], source: Source) -> Iterator[Problem]:
    paths = [axis[0].path for axis in axes if axis]
    for path in paths:
        at = source.key_place_of(("sweep", path))
        yield from _path_problems(path, at, source, FIXED)
        outer = next((one for one in paths if path.startswith(one + ".")), None)
        if outer:
            message = f"the axes `{outer}` and `{path}` set the same key"
            yield Problem(message, at, fix=f"sweep `{outer}` alone, or only keys within it")
    for axis in axes:
        yield from _repeated_values(axis, source)
    count = prod(len(axis) for axis in axes)
    if count > MAX_POINTS:
        yield Problem(f"the axes make {count} points", source.key_place_of(("sweep",)), legal=f"at most {MAX_POINTS}")


def _variation_problems(variations: list[Draft], axes: list[list[Setting]], source: Source) -> Iterator[Problem]:
    first: dict[str, Draft] = {}
    for draft in variations:
        yield from _repeated_values(list(draft.frames), source)
        for one in draft.settings:
            is_list = "values" in one.written_at
            at = source.place_of((*one.written_at[:3], "path")) if is_list else source.key_place_of(one.written_at)
            yield from _path_problems(one.path, at, source, (*FIXED, FRAMES))
        twin = first.setdefault(draft.label, draft)
        if twin is not draft:
            here, there = (source.place_of(_named_at(each)) for each in (draft, twin))
            message, fix = f"two variations are called `{draft.label}`", "give each its own label or value"
            yield Problem(message, here, other=there, other_says="the first is at", fix=fix)
    yield from _frames_problems(axes, source)


def _frames_problems(axes: list[list[Setting]], source: Source) -> Iterator[Problem]:
    """Variations at a number of frames that the main experiment does not have could be compared with nothing."""
    swept = [one.value for axis in axes for one in axis if one.path == FRAMES]
    main = swept or [shape.get(source.data, ("capture", "frames"))]
    frames = shape.get(source.data, ("sensitivity", "frames"))
    written = [Setting(FRAMES, n, ("sensitivity", "frames", i)) for i, n in enumerate(frames or ())] if frames else []
    yield from _repeated_values(written, source)
    for one in written:
        if one.value not in main:
            legal = "of " + ", ".join(dict.fromkeys(str(n) for n in main if isinstance(n, int)))
            message = f"{one.value} frames are not run in the main experiment, so that there is nothing to compare with"
            yield Problem(message, source.place_of(one.written_at), legal)


def _path_problems(path: str, place: Place, source: Source, fixed: Iterable[str]) -> Iterator[Problem]:
    if any(path == one or path.startswith(one + ".") for one in fixed):
        reason = "set by `sensitivity.frames`" if path == FRAMES else "the same for all points"
        yield Problem(f"`{path}` cannot be varied here: it is {reason}", place)
        return
    problem = path_problem(key_path(path), declared_of(source.data), place)
    if problem:
        yield problem


def _repeated_values(axis: list[Setting], source: Source) -> Iterator[Problem]:
    first: dict[str, Setting] = {}
    for one in axis:
        twin = first.setdefault(sameness(one.value), one)
        if twin is not one:
            yield Problem(
                f"{on_one_line(one.value)} is in this list twice",
                source.place_of(one.written_at),
                other=source.place_of(twin.written_at),
                other_says="first at",
                fix="keep one",
            )


def _value_problems(draft: Draft, source: Source, base_is_valid: bool) -> Iterator[Problem]:
    """What one value (or one labelled set) makes wrong by itself; the rest of the file reports its own problems."""
    try:
        located = _located(draft, source)
    except PathError as error:
        yield Problem(error.message, source.place_of(_named_at(draft)))
        return
    _, problems = _resolved(located)
    own = {place for one in draft.settings for place in _places_within(source, one.written_at)}
    for problem in problems:
        if problem.place in own:
            yield problem
        elif base_is_valid:
            message = f"with {draft.label}: {problem.message}"
            yield replace(problem, message=message, place=source.place_of(_named_at(draft)))


def _places_within(source: Source, path: KeyPath) -> Iterator[Place]:
    for places in (source.values, source.keys):
        yield from (place for at, place in places.items() if at[: len(path)] == path)


def _drafts(axes: list[list[Setting]], variations: list[Draft], config: ExperimentConfig) -> Iterator[Draft]:
    """The product of the axes, the last one fastest; then every variation at every number of frames of the study."""
    telling = {axis[0].path for axis in axes if len(axis) > 1} - {FRAMES}
    for settings in product(*axes):
        variant = set_up_label([one for one in settings if one.path in telling]) if telling else MAIN
        yield Draft(_label(settings), variant, settings)
    study = config.sensitivity
    for variation in variations if study else ():
        common = tuple(
            Setting(FRAMES, n, ("sensitivity", "frames", i)) for i, n in enumerate(study.frames if study else ())
        )
        for frames in variation.frames or common:
            settings = (frames, *variation.settings)
            label = f"{variation.label}, {FRAMES}={frames.value}"
            repeats = (study.repeats, study.calibration_repeats) if study else (None, None)
            yield Draft(label, variation.label, settings, True, *repeats)


def _points(drafts: list[Draft], source: Source) -> tuple[list[Point], list[Problem]]:
    points: list[Point] = []
    problems: list[Problem] = list(_named_alike(drafts, source))
    first: dict[str, Draft] = {}
    for draft in drafts:
        config, found = _resolved(_located(draft, source))
        if config is None or found:
            problems += [replace(one, message=f"with {draft.label}: {one.message}") for one in found]
            if len(problems) >= MAX_SHOWN:
                break
            continue
        values = {one.path: one.value for one in draft.settings}
        point = point_of(draft.label, draft.variant, values, _with_repeats(config, draft), detector_content(config))
        point = replace(point, is_variation=draft.is_variation)
        twin = draft if draft.is_variation else first.setdefault(point.digest, draft)
        if twin is not draft:
            place = source.place_of(_named_at(draft))
            problems.append(Problem(f"the points {draft.label} and {twin.label} are the same experiment", place))
        points.append(point)
    return points, problems


def _named_alike(drafts: list[Draft], source: Source) -> Iterator[Problem]:
    """A set-up and a variation, or two set-ups whose long values are shortened alike, could not be told apart."""
    first: dict[str, Draft] = {}
    for draft in drafts:
        others = tuple(sameness(one.value) for one in draft.settings if one.path != FRAMES)
        twin = first.setdefault(draft.variant, draft)
        if others != tuple(sameness(one.value) for one in twin.settings if one.path != FRAMES):
            place = source.place_of(_named_at(draft))
            yield Problem(f"two different set-ups are called `{draft.variant}`", place, fix="give one another label")
            return


def _located(draft: Draft, source: Source) -> Source:
    """The source of one point: its values set, with the places where they are written; no axes left."""
    data = {key: value for key, value in source.data.items() if key not in ("sweep", "sensitivity")}
    located = Source(source.origin, source.text, data, source.values, source.keys)
    for one in draft.settings:
        path = key_path(one.path)
        changed = set_path(located.data, path, one.value, declared_of(located.data))
        located = located.with_value(path, changed, source, one.written_at)
    return located


def _resolved(located: Source) -> tuple[ExperimentConfig | None, list[Problem]]:
    config, problems = validated(ExperimentConfig, located, splices_of(located.data))
    problems += checks.name_problems(located)
    if config is not None and not problems:
        problems += checks.joint_problems(config, located)
    return config, problems


def _with_repeats(config: ExperimentConfig, draft: Draft) -> ExperimentConfig:
    if draft.repeats is None:
        return config
    config = config.model_copy(update={"repeats": draft.repeats})
    calibrate = config.threshold.calibrate
    if calibrate is None or calibrate.repeats is None or draft.calibration_repeats is None:
        return config
    calibrate = calibrate.model_copy(update={"repeats": draft.calibration_repeats})
    return config.model_copy(update={"threshold": config.threshold.model_copy(update={"calibrate": calibrate})})


def _named_at(draft: Draft) -> KeyPath:
    """Where the user finds a draft: at its label where it has one, else at its last value."""
    at = draft.settings[-1].written_at
    return (*at[:3], "label") if "set" in at[:4] else at


def _label(settings: Iterable[Setting]) -> str:
    said = (one.name or f"{one.path}={on_one_line(one.value)}" for one in settings)
    return ", ".join(said) or "the experiment as it stands"
