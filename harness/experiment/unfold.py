"""Applies ``--set path=value``, unfolds axes, switches and variations into points, and validates
each of them, with problems at the value that causes them. Set-ups differ in the axes other than
the number of frames."""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import prod
from typing import Any

from harness.experiment import checks
from harness.experiment.schema import (
    DRAWN,
    MAIN,
    SHARED_BY_POINTS,
    STATED,
    ExperimentConfig,
    Point,
    SimulatedSource,
    declared_of,
    point_of,
)
from harness.experiment.unknowns import is_same_fact
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import dotted, shown, unknown_key
from harness.vocabulary.declaration.yaml_source import (
    DeclarationError,
    KeyPath,
    Place,
    Problem,
    Source,
    parse_yaml,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.path_names import (
    UNKNOWNS,
    differing,
    names_of,
    on_one_line,
    value_text,
)
from harness.vocabulary.seeds import canonical_json, random_stream
from harness.vocabulary.words import nearest
from scenes.sensor.camera import camera_of

OPTION = "--set"
NOT_VARIED = ("sweep", "sensitivity", "unknowns")  # Keys that hold dotted paths themselves
NUMBERS = ("source", "camera", "numbers")
"""Path of a mapping whose keys have dots, such as ``scatter.blur_px``."""


class PathError(UserError):
    """A dotted path that does not exist in the data."""


def key_path(text: str) -> KeyPath:
    """Return ``a.b.2.c`` as keys and indices. The rest after ``sweep.`` or after
    ``source.camera.numbers.`` is a single key, as in the file."""
    head, _, inner = text.partition(".")
    if head == "sweep" and inner:
        return (head, inner)
    before_number, _, number = text.partition(".".join(NUMBERS) + ".")
    if number and not before_number:
        return (*NUMBERS, number)
    return tuple(
        int(part) if part.isascii() and part.isdigit() else part for part in text.split(".")
    )


def set_path(
    data: Any,
    path: KeyPath,
    value: Any,
    declared: shape.Declared | None = None,
    above: KeyPath = (),
) -> Any:
    """Return a copy of ``data`` with the value at ``path`` replaced or added. With ``declared``,
    missing mappings on the way get their defaults, and a new kind of a mapping (``merge.kind``)
    drops the keys of the former kind. ``above`` is the path of ``data`` itself. Raises PathError
    if the path cannot be followed."""
    if not path:
        return value
    key = _index(data, path[0], above)
    inner_path = path[1:]
    full_path = (*above, key)
    if isinstance(data, list):
        if key >= len(data):
            raise PathError(f"the list has no item {key}; it has {len(data)}, counted from 0")
        return [
            *data[:key],
            set_path(data[key], inner_path, value, declared, full_path),
            *data[key + 1 :],
        ]
    inner = data.get(key)
    if key not in data and inner_path:
        default = shape.default_at(declared.at(full_path)) if declared else ()
        if not default:
            raise PathError(f"there is no `{key}`")
        inner = default[0]
    around = declared.at(above) if declared and not inner_path else None
    kinds = shape.kinds_of(around)
    if kinds and kinds[0] == key:
        old = shape.model_for(around, data)
        new = shape.model_for(around, {**data, key: value})
        gone = {*(old.model_fields if old else ())} - {*(new.model_fields if new else ())}
        data = {name: member for name, member in data.items() if name not in gone}
    return {**data, key: set_path(inner, inner_path, value, declared, full_path)}


def _index(data: Any, key: str | int, above: KeyPath) -> Any:
    if isinstance(data, dict):
        return str(key)
    if isinstance(data, list) and isinstance(key, int):
        return key
    raise PathError(f"`{dotted(above)}` is {shown(data)} here, which has no `{key}`")


def path_problem(path: KeyPath, declared: shape.Declared, position: Place | None) -> Problem | None:
    """Return the problem for a path that the declaration lacks, with the nearest legal path; None
    for a legal path."""
    for depth in range(1, len(path) + 1):
        if declared.at(path[:depth]) is None:
            legal_paths = [
                dotted(legal)
                for legal in declared.paths()
                if path[0] in NOT_VARIED or legal[0] not in NOT_VARIED
            ]
            problem = unknown_key(
                str(path[depth - 1]), path[: depth - 1], declared.names(path[: depth - 1]), position
            )
            message = f"unknown path `{dotted(path)}`: {problem.message}"
            return Problem(message, position, problem.legal, nearest(dotted(path), legal_paths))
    return None


def overridden(
    source: Source, overrides: Sequence[str], declared_of: shape.DeclaredOf
) -> tuple[Source, list[Problem]]:
    """Return the source with every legal ``path=value`` applied in order, and the problems of the
    illegal ones."""
    problems: list[Problem] = []
    parts = [
        (text, *text.partition("=")[::2], Place(OPTION, 0, 1, text, max(1, text.find("="))))
        for text in overrides
    ]
    for text, name, written, position in parts:
        if not name.strip() or not written.strip():
            fix = "write null to state no value" if "=" in text and name.strip() else None
            problems.append(
                Problem("not of the form path=value", position, "capture.frames=10", fix=fix)
            )
            continue
        path = key_path(name.strip())
        declared = declared_of(source.data)
        try:
            value = parse_yaml(
                text, OPTION, start=len(name) + 1, is_argument=True, key=name.strip()
            )
            problem = path_problem(path, declared, position)
            if problem is None:
                source = source.with_value(
                    path, set_path(source.data, path, value.data, declared), value
                )
            problems += [] if problem is None else [problem]
        except DeclarationError as error:
            problems += error.problems
        except PathError as error:
            problems.append(Problem(error.message, position))
    swept = shape.child(source.data, "sweep")
    for _, name, written, position in parts:
        if isinstance(swept, dict) and (path_text := name.strip()) in swept:
            message = f"`{path_text}` is an axis of the sweep, so this value would never be used"
            problems.append(
                Problem(message, position, fix=f"{OPTION} 'sweep.{path_text}=[{written.strip()}]'")
            )
    return source, problems


# More than a machine can run in a week; larger numbers come from mistyped axes
MAX_POINTS = 10_000
# Most problems of combinations, which are found one point at a time and are similar
MAX_SHOWN = 20
FRAMES = "capture.frames"
SWITCHES = "switches"  # Key of the file that states the path of a mapping of switches


@dataclass(frozen=True)
class Setting:
    """A path with its value, the place of that value in the source, and its name (``path=value``
    if empty)."""

    path: str
    value: Any
    written_at: KeyPath
    name: str = ""


@dataclass(frozen=True)
class Draft:
    """An unresolved point. ``named_at`` is the place of its label or last value; ``frames`` are a
    variation's."""

    label: str
    variant: str
    settings: tuple[Setting, ...]
    named_at: KeyPath = ()
    is_variation: bool = False
    frames: tuple[Setting, ...] = ()


def unfolded(
    source: Source, config: ExperimentConfig | None
) -> tuple[tuple[Point, ...], list[Problem]]:
    """Return all points in order, or all problems of axes and variations. ``config``: None if
    other keys are wrong."""
    sweep = shape.child(source.data, "sweep")
    axes = [
        [Setting(path, value, ("sweep", path, index)) for index, value in enumerate(values)]
        for path, values in (sweep.items() if isinstance(sweep, dict) else ())
        if isinstance(values, list) and values
    ]
    variations = list(_written_variations(source.data))
    unknowns = list(_written_unknowns(source.data))
    problems = [*_axis_problems(axes, source), *_variation_problems(variations, axes, source)]
    written_at_by_key = {draft.settings[0].path: draft.named_at for draft in unknowns}
    for key, written_at in written_at_by_key.items():
        position = source.place_of((*written_at[:2], "key"))
        problems += _path_problems(key, position, source, SHARED_BY_POINTS)
    switches, mistakes = (
        _switch_axis(config, source) if config is not None and config.switches else ([], [])
    )
    problems += mistakes
    keep_all = config is not None
    for axis in axes:
        for setting in axis:
            draft = Draft(_label([setting]), "", (setting,), setting.written_at)
            problems += _draft_problems(draft, source, keep_all)
    problems += _level_problems(unknowns, source, keep_all)
    for variation in variations:
        problems += _draft_problems(variation, source, keep_all)
    if problems or config is None:
        return (), problems
    axes = [switches, *axes] if switches else axes
    telling = [axis[0].path for axis in axes if len(axis) > 1 and axis[0].path != FRAMES]
    if config.study is None:
        telling = [unknown.key for unknown in config.unknowns] + telling
    drafts = [*_drafts(axes, telling, variations, config)]
    points, problems = _points(drafts, telling, config, source)
    if config.study is not None and config.unknowns:
        points = tuple(_stated_and_drawn(points, config))
    return points, problems


def _draft_problems(draft: Draft, source: Source, keep_all: bool) -> list[Problem]:
    """Return the problems of a draft whose paths are right; those of paths are reported at the
    paths."""
    for setting in draft.settings:
        if any(_path_problems(setting.path, None, source, SHARED_BY_POINTS)):
            return []
    return _resolved(draft, source, keep_all)[1]


def _level_problems(drafts: Iterable[Draft], source: Source, keep_all: bool) -> list[Problem]:
    """Return the problems of the drafts of unknowns. One that all values of an unknown share, such
    as a number that the camera lacks, is reported for the first value only."""
    by_unknown: dict[KeyPath, list[dict[Problem, Problem]]] = {}
    for draft in drafts:
        lead = _lead(draft)
        problems = {}
        for problem in _draft_problems(draft, source, keep_all):
            unlabelled = problem
            if problem.message.startswith(lead):
                message = problem.message.removeprefix(lead)
                unlabelled = replace(problem, message=message, place=None)
            problems[unlabelled] = problem
        by_unknown.setdefault(draft.named_at[:2], []).append(problems)
    reported = []
    for problems_of_levels in by_unknown.values():
        shared = set.intersection(*map(set, problems_of_levels))
        for level, problems in enumerate(problems_of_levels):
            for unlabelled, problem in problems.items():
                if level == 0 or unlabelled not in shared:
                    reported.append(problem)
    return reported


def _lead(draft: Draft) -> str:
    """Return what begins a problem that does not lie at a draft's own value."""
    return f"with {draft.label}: "


def _written_unknowns(data: Any) -> Iterator[Draft]:
    """Yield a draft for each value of an unknown, or each end of its range, as the file states
    them."""
    unknowns = shape.child(data, UNKNOWNS)
    for index, unknown in enumerate(unknowns if isinstance(unknowns, list) else ()):
        key = shape.child(unknown, "key")
        for name in ("values", "range"):
            levels = shape.child(unknown, name)
            if not isinstance(key, str) or not isinstance(levels, list):
                continue
            for number, level in enumerate(levels):
                setting = Setting(key, level, (UNKNOWNS, index, name, number))
                yield Draft(_label([setting]), "", (setting,), setting.written_at)


def _stated_and_drawn(points: Sequence[Point], config: ExperimentConfig) -> Iterator[Point]:
    """Yield the points of a study, and each of them again with its unknowns drawn for each board.
    An unknown that an axis sets is not drawn."""
    unknowns = []
    for unknown in config.unknowns:
        if not any(is_same_fact(unknown.key, axis) for axis in config.sweep):
            unknowns.append(unknown)
    for point in points:
        yield replace(point, axes={**point.axes, UNKNOWNS: STATED})
    if not unknowns:
        return
    name = f"{UNKNOWNS}={DRAWN}"
    for point in points:
        variant = name if point.variant == MAIN else f"{point.variant}, {name}"
        yield point.with_unknowns(tuple(unknowns), variant)


def source_of(point: Point, purpose: str, number: int) -> SimulatedSource:
    """Return the source that shows the board of a purpose and number, with the unknowns that are
    drawn for it."""
    if not point.unknowns:
        return point.config.simulated
    data = point.config.to_data()
    for unknown in point.unknowns:
        value = unknown.drawn(point.config.seed, purpose, number)
        data = set_path(data, key_path(unknown.key), value, declared_of(data))
    return SimulatedSource.from_data(data["source"])


def stated_value(config: ExperimentConfig, key: str) -> Any:
    """Return what an experiment states at a key, as plain data; of a number of the camera that it
    does not replace, the camera file's."""
    path = key_path(key)
    stated = shape.get(config.to_data(), path)
    if stated is None and path[: len(NUMBERS)] == NUMBERS:
        camera_data = camera_of(config.simulated.camera).to_data()
        number_path = str(path[-1]).split(".")
        stated = shape.get(camera_data, (*number_path, "value"))
    return stated


def _written_variations(data: Any) -> Iterator[Draft]:
    """Yield the variations as the file states them, without the numbers of frames of the
    sensitivity study."""
    vary = shape.get(data, ("sensitivity", "vary"))
    for index, variation in enumerate(vary if isinstance(vary, list) else ()):
        written_at: KeyPath = ("sensitivity", "vary", index)
        path = shape.child(variation, "path")
        values = shape.child(variation, "values")
        label = shape.child(variation, "label")
        together = shape.child(variation, "set")
        frames = _frame_settings(shape.child(variation, "frames"), (*written_at, "frames"))
        if isinstance(path, str) and isinstance(values, list):
            for number, value in enumerate(values):
                setting = Setting(path, value, (*written_at, "values", number))
                yield Draft(
                    _label([setting]),
                    _label([setting]),
                    (setting,),
                    setting.written_at,
                    True,
                    frames,
                )
        elif isinstance(label, str) and isinstance(together, dict):
            settings = tuple(
                Setting(key, value, (*written_at, "set", key)) for key, value in together.items()
            )
            yield Draft(label, label, settings, (*written_at, "label"), True, frames)


def _frame_settings(frames: Any, written_at: KeyPath) -> tuple[Setting, ...]:
    return tuple(
        Setting(FRAMES, n, (*written_at, k))
        for k, n in enumerate(frames if isinstance(frames, list | tuple) else ())
    )


def _label(settings: Iterable[Setting]) -> str:
    parts = (setting.name or f"{setting.path}={on_one_line(setting.value)}" for setting in settings)
    return ", ".join(parts) or "the unchanged experiment"


def _axis_problems(axes: list[list[Setting]], source: Source) -> Iterator[Problem]:
    paths = [axis[0].path for axis in axes]
    for path in paths:
        position = source.key_place_of(("sweep", path))
        yield from _path_problems(path, position, source, SHARED_BY_POINTS)
        outer = next((prefix for prefix in paths if path.startswith(prefix + ".")), None)
        if outer:
            message = f"the axes `{outer}` and `{path}` set the same key"
            yield Problem(message, position, fix=f"sweep only `{outer}`, or only keys within it")
    count = prod(len(axis) for axis in axes)
    if count > MAX_POINTS:
        yield Problem(
            f"the axes make {count} points",
            source.key_place_of(("sweep",)),
            legal=f"at most {MAX_POINTS}",
        )


def _switch_axis(config: ExperimentConfig, source: Source) -> tuple[list[Setting], list[Problem]]:
    """Return an axis over the mapping of switches that the file names: none on, each alone, all
    but each, and all."""
    path = config.switches or ""
    position = source.place_of((SWITCHES,))
    problems = []
    switches = shape.get(config.to_data(), key_path(path))
    names = (
        [*switches]
        if isinstance(switches, dict)
        and all(isinstance(value, bool) for value in switches.values())
        else []
    )
    if len(names) < 2:
        legal = (
            "a mapping of at least two keys that are true or false, such as source.camera.effects"
        )
        problems.append(Problem(f"`{path}` does not hold switches", position, legal=legal))
    for axis in config.sweep:
        if f"{axis}.".startswith(f"{path}.") or f"{path}.".startswith(f"{axis}."):
            message = f"the switches `{path}` and the axis `{axis}` set the same key"
            problems.append(
                Problem(message, position, fix="sweep other keys, or leave the switches out")
            )
    alone = [frozenset({name}) for name in names]
    all_names = frozenset(names)

    def label(switched_on: frozenset[str]) -> str:
        words = {0: "none", len(all_names): "all", 1: f"{''.join(switched_on)} alone"}
        return words.get(len(switched_on), f"all but {''.join(all_names - switched_on)}").replace(
            "_", " "
        )

    chosen = dict.fromkeys(
        [frozenset[str](), *alone, *(all_names - switch for switch in alone), all_names]
    )
    return [
        Setting(
            path, {name: name in switched_on for name in names}, (SWITCHES,), label(switched_on)
        )
        for switched_on in chosen
    ], problems


def _variation_problems(
    variations: list[Draft], axes: list[list[Setting]], source: Source
) -> Iterator[Problem]:
    for draft in variations:
        for setting in draft.settings:
            listed = source.place_of((*setting.written_at[:3], "path"))
            position = (
                listed
                if "values" in setting.written_at
                else source.key_place_of(setting.written_at)
            )
            yield from _path_problems(setting.path, position, source, (*SHARED_BY_POINTS, FRAMES))
    # a variation needs a set-up of the main experiment with the same number of frames for
    # comparison
    main = [setting.value for axis in axes for setting in axis if setting.path == FRAMES]
    main = main or [shape.get(source.data, ("capture", "frames"))]
    listed_at: KeyPath = ("sensitivity", "frames")
    for setting in _frame_settings(shape.get(source.data, listed_at), listed_at):
        if setting.value not in main:
            message = (
                f"the main experiment has no set-up with {setting.value} frames to compare with"
            )
            yield Problem(
                message, source.place_of(setting.written_at), "of " + ", ".join(map(str, main))
            )


def _path_problems(
    path: str, position: Place | None, source: Source, fixed: Iterable[str]
) -> Iterator[Problem]:
    if any(path == key or path.startswith(key + ".") for key in fixed):
        reason = "set by `sensitivity.frames`" if path == FRAMES else "the same for all points"
        yield Problem(f"`{path}` cannot be varied here: it is {reason}", position)
    elif problem := path_problem(key_path(path), declared_of(source.data), position):
        yield problem


def _resolved(
    draft: Draft, source: Source, keep_all: bool
) -> tuple[ExperimentConfig | None, list[Problem]]:
    """Return a point's declaration, or its problems: at the wrong value, or else (if ``keep_all``)
    at its name."""
    position = source.place_of(draft.named_at)
    located = replace(
        source, data={k: v for k, v in source.data.items() if k not in ("sweep", "sensitivity")}
    )
    try:
        for setting in draft.settings:
            path = key_path(setting.path)
            changed = set_path(located.data, path, setting.value, declared_of(located.data))
            located = located.with_value(path, changed, source, setting.written_at)
    except PathError as error:
        return None, [Problem(error.message, position)]
    config, problems = checks.resolved(located)
    starts = [setting.written_at for setting in draft.settings]
    written = (
        (item for positions in (source.values, source.keys) for item in positions.items())
        if problems
        else ()
    )
    own_spots = {
        spot
        for written_at, spot in written
        if any(written_at[: len(start)] == start for start in starts)
    }
    elsewhere = _lead(draft) if draft.settings else ""
    return config, [
        problem
        if problem.place in own_spots
        else replace(problem, message=elsewhere + problem.message, place=position)
        for problem in problems
        if problem.place in own_spots or keep_all
    ]


def _drafts(
    axes: list[list[Setting]], telling: list[str], variations: list[Draft], config: ExperimentConfig
) -> Iterator[Draft]:
    """Yield the product of the axes (the last varies fastest), then all variations with all
    numbers of frames."""
    names = names_of(telling)
    texts = dict[int, str]()
    for axis in axes:
        for setting in axis if axis[0].path in telling else ():
            value = value_text(
                setting.path, differing(setting.value, (setting.value for setting in axis))
            )
            texts[id(setting)] = setting.name or f"{names[setting.path]}={value}"
    chosen = list(product(*axes))
    if config.unknowns and config.study is None:
        chosen = [(*drawn, *settings) for drawn in _drawn_settings(config) for settings in chosen]
        for settings in chosen:
            for setting in settings:
                value = value_text(setting.path, setting.value)
                texts.setdefault(id(setting), f"{names.get(setting.path)}={value}")
    elif config.draws is not None:
        groups: dict[str, list[tuple[Setting, ...]]] = {}
        for settings in chosen:
            groups.setdefault(_label(s for s in settings if s.path != FRAMES), []).append(settings)
        order = random_stream(config.seed, "draws").permutation(len(groups))[: config.draws]
        chosen = [settings for number in sorted(order) for settings in [*groups.values()][number]]
    for settings in chosen:
        # a set-up has a name such as ``camera=kinect_v2, distance=0.75 m``
        parts = [texts[id(setting)] for setting in settings if setting.path in telling]
        yield Draft(
            _label(settings),
            ", ".join(parts) or MAIN,
            settings,
            settings[-1].written_at if settings else (),
        )
    common = _frame_settings(
        config.sensitivity and config.sensitivity.frames, ("sensitivity", "frames")
    )
    for variation in variations:
        for frames in variation.frames or common:
            label = f"{variation.label}, {FRAMES}={frames.value}"
            settings = (frames, *variation.settings)
            yield replace(variation, label=label, variant=variation.label, settings=settings)


def _drawn_settings(config: ExperimentConfig) -> Iterator[tuple[Setting, ...]]:
    """Yield the settings of each draw of the unknowns."""
    for number in range(config.draws or 0):
        settings = []
        for index, unknown in enumerate(config.unknowns):
            drawn = unknown.drawn(config.seed, "set-up", number)
            value = json.loads(json.dumps(drawn))  # lists, as in the file
            settings.append(Setting(unknown.key, value, (UNKNOWNS, index)))
        yield tuple(settings)


def _points(
    drafts: list[Draft], axes: list[str], experiment: ExperimentConfig, source: Source
) -> tuple[tuple[Point, ...], list[Problem]]:
    points: list[Point] = []
    problems: list[Problem] = []
    labels: dict[str, list[Any]] = {}
    drafts_by_name: dict[tuple[str, str], Draft] = {}
    set_ups: dict[str, str] = {}
    for draft in drafts:
        # a set-up and a variation, or two set-ups with long values that are shortened, may get the
        # same name
        values = [setting.value for setting in draft.settings if setting.path != FRAMES]
        if labels.setdefault(draft.variant, values) != values:
            message = f"two different set-ups are called `{draft.variant}`"
            return (), [
                Problem(
                    message, source.place_of(draft.named_at), fix="give one of them another label"
                )
            ]
    for draft in drafts:
        config, own_problems = _resolved(draft, source, True)
        problems += own_problems
        if len(problems) >= MAX_SHOWN:
            break
        if config is None or own_problems:
            continue
        study = experiment.sensitivity
        calibrate = config.threshold.calibrate
        if draft.is_variation and study is not None:
            if (
                calibrate is not None
                and calibrate.repeats is not None
                and study.calibration_repeats is not None
            ):
                calibrate = calibrate.model_copy(update={"repeats": study.calibration_repeats})
            threshold = config.threshold.model_copy(update={"calibrate": calibrate})
            config = config.model_copy(update={"repeats": study.repeats, "threshold": threshold})
        # the resolved values of the axes identify set-ups, and the set-up that a variation is
        # compared with
        data = json.loads(json.dumps(config.to_data())) if axes else {}
        placed = {path: shape.get(data, key_path(path)) for path in axes}
        point = point_of(
            draft.label, draft.variant, {s.path: s.value for s in draft.settings}, config
        )
        reference = draft.variant
        if draft.is_variation:
            reference = set_ups.get(canonical_json(placed), "")
        else:
            set_ups.setdefault(canonical_json(placed), draft.variant)
        twin = drafts_by_name.setdefault(
            (point.digest, draft.variant if draft.is_variation else ""), draft
        )
        if twin is not draft and experiment.draws is not None:
            continue
        if twin is not draft:
            message = f"the points {draft.label} and {twin.label} are the same experiment"
            problems.append(Problem(message, source.place_of(draft.named_at), fix="keep one"))
        points.append(
            replace(point, is_variation=draft.is_variation, axes=placed, reference=reference)
        )
    return tuple(points), problems
