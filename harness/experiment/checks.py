"""Mistakes that concern several keys of an experiment together, or things outside the file: names, files, views."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from itertools import combinations
from math import ceil, dist, expm1
from pathlib import Path

from pydantic import ValidationError

from detectors import detector_names
from harness.experiment.schema import (
    DETECTOR_NAME,
    CaptureSource,
    ExperimentConfig,
    SimulatedSource,
    recording_of,
    splices_of,
)
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import nearest, validated, wrong_choice
from harness.vocabulary.declaration.yaml_source import KeyPath, Problem, Source
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from scenes.perspectives import check_in_view, poses_of, view_count
from scenes.sensor.camera import CameraConfig, camera_names, camera_of, is_camera_path, load_camera
from scenes.target.checks import check_target
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig

CAMERA_NAME = ("source", "camera", "name")
CAMERA_NUMBERS = ("source", "camera", "numbers")
TARGET = ("source", "target")


def resolved(source: Source) -> tuple[ExperimentConfig | None, list[Problem]]:
    """Validate an experiment's data; returns its declaration (None where it is not valid) and all problems."""
    config, problems = validated(ExperimentConfig, source, splices_of(source.data))
    for path, legal in ((CAMERA_NAME, camera_names()), (DETECTOR_NAME, detector_names())):
        name = shape.get(source.data, path)
        if path == CAMERA_NAME and isinstance(name, str) and is_camera_path(name):
            try:
                load_camera(name)
            except UserError as error:
                problems.append(Problem(str(error), source.place_of(path)))
        elif isinstance(name, str) and name not in legal:
            problems.append(wrong_choice(path, name, legal, source.place_of(path)))
    if config is not None and not problems:
        if config.capture.average.frames is not None:
            place = source.key_place_of(("capture", "average", "frames"))
            message = "an experiment counts its frames by `capture.frames`"
            problems.append(Problem(message, place, fix="remove this key"))
        if isinstance(config.source, SimulatedSource):
            problems += [*_target_problems(config, config.source, source)]
            problems += [*_mapping_problems(config, config.source, source)]
            problems += [*_flat_field_problems(config, config.source, source)]
        else:
            problems += _capture_problems(config, config.source, source)
        problems += _study_problems(config, source)
    return config, problems


def _study_problems(config: ExperimentConfig, source: Source) -> Iterator[Problem]:
    """Find what does not fit between a study, a family of boards and a threshold set on boards."""
    target = config.source.target if isinstance(config.source, SimulatedSource) else None
    drawn, calibrate = isinstance(target, DrawnTargetConfig), config.threshold.calibrate
    boards_at = source.place_of(("threshold", "calibrate", "boards"))
    if config.study is None and drawn:
        fix = "add for instance study: {boards: 60, hole_free_boards: 60}, or choose target: {name: thesis}"
        yield Problem("a family of boards is for a study", source.place_of(TARGET), fix=fix)
    elif config.study is None and calibrate is not None and calibrate.boards is not None:
        yield Problem("only a study has boards to draw", boards_at, fix="write `repeats` in its place")
    elif config.study is not None and not isinstance(target, DrawnTargetConfig):
        fix = "write source.target: {name: drawn}"
        yield Problem("a study needs a family of boards", source.place_of(TARGET), fix=fix)
    if config.study is None or not isinstance(target, DrawnTargetConfig):
        return
    if config.sensitivity is not None:
        fix = "sweep the key, or run the study once for each value with --set"
        yield Problem("a study takes no sensitivity", source.key_place_of(("sensitivity",)), fix=fix)
    # what is a hit and which rate of false calls is wanted are the study's rules, the same for all its set-ups
    for path in config.sweep:
        if path.split(".")[0] == "matching" or path == "threshold" or path.startswith("threshold.calibrate"):
            message = f"`{path}` is a rule of the study and cannot be an axis of it"
            fix = "run the study once for each value with --set, and compare them with harness.compare"
            yield Problem(message, source.key_place_of(("sweep", path)), fix=fix)
    if calibrate is not None and calibrate.boards is None:
        place = source.place_of(("threshold", "calibrate"))
        yield Problem("a study's threshold is set on boards of their own", place, fix="write `boards: 60`")
    elif calibrate is not None and calibrate.boards is not None:
        # so few boards can show no lower rate, were all of their face judged: a new run exceeds the highest of n with
        # probability 1 / (n + 1), and calls at all with 1 - exp(-rate * area)
        rate_per_m2 = calibrate.false_calls_per_m2 or 0.0
        area_m2 = target.board.width_mm * target.board.height_mm * MM**2
        needed = ceil(-1 / expm1(-rate_per_m2 * area_m2) * (1 - 1e-12)) - 1
        if calibrate.boards < needed:
            boards = f"{calibrate.boards} hole-free boards of {area_m2:.3g} m2"
            message = f"{boards} cannot show {rate_per_m2:g} false calls per m2"
            fix = "simulate more boards or larger ones, or ask for a higher false_calls_per_m2"
            yield Problem(message, boards_at, f"at least {needed}", fix=fix)


def _target_problems(config: ExperimentConfig, simulated: SimulatedSource, source: Source) -> Iterator[Problem]:
    drawn = simulated.target if isinstance(simulated.target, DrawnTargetConfig) else None
    try:
        target = simulated.target.declare()
        _checked(target)
    except UserError as error:  # that includes a family of boards that are too full for their damage
        yield Problem(error.message, source.place_of(TARGET), legal=error.legal, fix=error.fix)
        return
    if drawn is None:
        yield from _pose_problems(simulated, target, source)
    # the first pose that the camera does not see whole stands for all
    for pose in drawn.extreme_poses() if drawn else ():
        posed = target.model_copy(update={"pose": pose})
        problems = [*_pose_problems(simulated.model_copy(update={"views": None}), posed, source)]
        problems += _pose_problems(simulated, posed, source) if simulated.views else ()
        if problems:
            where = (
                f"a board drawn at {pose.distance_m:.3g} m, {pose.offset_x_mm:.3g} and {pose.offset_y_mm:.3g} mm off "
                f"the axis, tilted by {pose.tilt_x_deg:.3g}° and {pose.tilt_y_deg:.3g}°, rolled by {pose.roll_deg:.3g}°"
            )
            of_camera = problems[0].place in [source.place_of(CAMERA_NAME), source.place_of(CAMERA_NUMBERS)]
            yield problems[0] if of_camera else replace(problems[0], message=f"{where}: {problems[0].message}")
            break
    apart_mm = [dist(a.centre_mm, b.centre_mm) for a, b in combinations(target.damages, 2)]
    pitch_mm = drawn.apart_mm if drawn is not None else min(apart_mm, default=None)
    if pitch_mm is not None and config.matching.radius_mm > pitch_mm / 2:
        yield Problem(
            f"a matching radius of {config.matching.radius_mm:g} mm reaches beyond half the way to the next damage, so "
            "that a detection could count for either",
            source.place_of(("matching", "radius_mm")),
            legal=f"at most {pitch_mm / 2:g} mm for damages whose centres are {pitch_mm:g} mm apart",
        )


def _pose_problems(simulated: SimulatedSource, target: TargetConfig, source: Source) -> Iterator[Problem]:
    """Find the first pose (of several views the first view) from which the camera does not see the whole face within
    its range, or finds no albedo at its wavelength; or that the camera cannot be made."""
    views, place = simulated.views, source.place_of(("source", "views"))
    try:
        poses = (target.pose,) if views is None else poses_of(views, target.pose)
    except ValidationError as error:
        first = error.errors()[0]
        key, value = str(first["loc"][-1]), first["input"]
        legal = shape.legal_at(shape.Declared(type(target.pose), {}, {}).at((key,)))
        message = f"a view's pose is not legal: {key} would be {value:g}"
        yield Problem(message, place, legal, fix="lower the spread or the sway")
        return
    for number, pose in enumerate(poses):
        found = _camera_mistake(simulated.camera, target.model_copy(update={"pose": pose}))
        if found:
            path, mistake = found
            message, at = mistake.message, source.place_of(path)
            if views is not None and path == TARGET:
                tilts = f"tilts {pose.tilt_x_deg:.3g} and {pose.tilt_y_deg:.3g}°, {pose.distance_m:.3g} m"
                message, at = f"view {number} of {len(poses)} ({tilts}): {message}", place
            yield Problem(message, at, legal=mistake.legal, fix=mistake.fix)
            return


def _mapping_problems(config: ExperimentConfig, simulated: SimulatedSource, source: Source) -> Iterator[Problem]:
    """Find what does not fit between several views and their mapping into one cloud."""
    if simulated.views is None and config.mapping is not None:
        fix = "declare source.views, for instance {kind: arc, count: 3, spread_deg: 40.0}"
        yield Problem("a mapping needs several views", source.place_of(("mapping",)), fix=fix)
    elif simulated.views is not None and config.mapping is None:
        fix = "declare mapping, for instance {registration: {method: marks}, merge: {kind: fusion}}"
        yield Problem("several views need a mapping into one cloud", source.place_of(("source", "views")), fix=fix)
    elif simulated.views is not None and config.mapping is not None and config.mapping.views is not None:
        there = view_count(simulated.views)
        if config.mapping.views > there:
            place = source.place_of(("mapping", "views"))
            yield Problem(f"{config.mapping.views} views, but source.views has {there}", place, legal=f"1 to {there}")


def _flat_field_problems(config: ExperimentConfig, simulated: SimulatedSource, source: Source) -> Iterator[Problem]:
    """Find a flat field's plane that lies outside of the camera's range."""
    try:
        flat_field, optics = config.capture.flat_field, camera_of(simulated.camera).optics
    except UserError:
        return  # told with the target's pose
    if flat_field is not None and not optics.nearest_m < flat_field.distance_m < optics.farthest_m:
        place = source.place_of(("capture", "flat_field"))
        legal = f"{optics.nearest_m:g} to {optics.farthest_m:g} m"
        yield Problem(f"{optics.title} gives no range at {flat_field.distance_m:g} m", place, legal=legal)


@lru_cache(maxsize=10_000)
def _camera_mistake(config: CameraConfig, target: TargetConfig) -> tuple[KeyPath, UserError] | None:
    path: KeyPath = CAMERA_NUMBERS if config.numbers else CAMERA_NAME
    try:
        optics = camera_of(config).optics
        path = TARGET
        target.at_wavelength(optics.wavelength_nm)
        check_in_view(target, optics)
    except UserError as error:
        return path, error
    return None


_checked = lru_cache(maxsize=10_000)(check_target)


def _capture_problems(config: ExperimentConfig, capture: CaptureSource, source: Source) -> list[Problem]:
    problems = []
    for index, name in enumerate(capture.paths):
        if not Path(name).exists():
            near = nearest(Path(name).name, [file.name for file in Path(name).parent.glob("*")])
            place = source.place_of(("source", "paths", index))
            problems.append(Problem(f"{name}: there is no such file or folder", place, nearest=near))
    lens = capture.intrinsics
    if lens and lens not in camera_names() and not Path(lens).is_file():
        legal, place = f"a file, or one of {', '.join(camera_names())}", source.place_of(("source", "intrinsics"))
        problems.append(Problem(f"{lens}: neither a file nor a camera", place, legal))
    if not problems:
        try:
            recording_of(capture)
        except UserError as error:
            place = source.place_of(("source", "paths"))
            problems.append(Problem(error.message, place, legal=error.legal, fix=error.fix))
    if config.capture.flat_field is not None:
        place, fix = source.place_of(("capture", "flat_field")), "use harness.flatfield and harness.detect --flat-field"
        problems.append(Problem("a flat field needs a simulated unit", place, fix=fix))
    if config.mapping is not None:
        place, fix = source.place_of(("mapping",)), "use harness.detect --register"
        problems.append(Problem("a mapping needs the views of a simulated source", place, fix=fix))
    if config.threshold.calibrate is not None:
        message = "a threshold can be calibrated only on hole-free repeats, which a capture does not have"
        place = source.place_of(("threshold", "calibrate"))
        problems.append(Problem(message, place, legal="a given threshold, such as `k: 3.5`"))
    return problems
