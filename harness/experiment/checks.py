"""Finds mistakes that involve several keys of an experiment, or things outside the file: names,
files, views."""

from collections.abc import Iterator
from functools import lru_cache
from itertools import combinations
from math import ceil, dist, expm1
from pathlib import Path

from pydantic import ValidationError

from detectors import detector_names, detector_type
from detectors.filters import DepthFilterConfig, filter_names, load_filter
from harness.experiment.schema import (
    CaptureSource,
    ExperimentConfig,
    SimulatedSource,
    recording_of,
    splices_of,
)
from harness.experiment.unknowns import is_same_fact
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import validated, wrong_choice
from harness.vocabulary.declaration.yaml_source import KeyPath, Problem, Source
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.words import nearest
from scenes.optics import Optics
from scenes.perspectives import AnyViews, check_in_view, poses_of, view_count
from scenes.sensor.camera import camera_names, camera_of, is_camera_path, load_camera
from scenes.sensor.common.config import CameraConfig
from scenes.target.checks import check_target
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.thesis import AnyTargetConfig

CAMERA_NAME = ("source", "camera", "name")
DETECTOR_NAME = ("detector", "name")
FILTER_NAME = ("capture", "filter", "name")
CAMERA_NUMBERS = ("source", "camera", "numbers")
TARGET = ("source", "target")
VIEWS = ("source", "views")
LEAST_BOARDS = 10  # of a study with a precision: its first boards, and a batch of chosen sizes


def resolved(source: Source) -> tuple[ExperimentConfig | None, list[Problem]]:
    """Validate an experiment's data; return its declaration (None if it is not valid) and all
    problems."""
    config, problems = validated(ExperimentConfig, source, splices_of(source.data))
    choices = (
        (CAMERA_NAME, camera_names()),
        (DETECTOR_NAME, detector_names()),
        (FILTER_NAME, filter_names()),
    )
    for path, legal in choices:
        name = shape.get(source.data, path)
        if path == CAMERA_NAME and isinstance(name, str) and is_camera_path(name):
            try:
                load_camera(name)
            except UserError as error:
                problems.append(Problem(str(error), source.place_of(path)))
        elif isinstance(name, str) and name not in legal:
            problems.append(wrong_choice(path, name, legal, source.place_of(path)))
    if config is None or problems:
        return config, problems
    if config.capture.average.frames is not None:
        position = source.key_place_of(("capture", "average", "frames"))
        message = "the number of frames is set by"
        problems.append(Problem(f"{message} `capture.frames`", position, fix="remove this key"))
    depth_filter = config.capture.filter
    if depth_filter is not None:
        problems += _filter_problems(depth_filter, source)
    if isinstance(config.source, SimulatedSource):
        for check in (_target_problems, _mapping_problems, _flat_field_problems):
            problems += check(config, config.source, source)
    else:
        problems += _capture_problems(config, config.source, source)
    problems += _reference_problems(config, source)
    return config, [*problems, *_study_problems(config, source), *_unknown_problems(config, source)]


def _reference_problems(config: ExperimentConfig, source: Source) -> Iterator[Problem]:
    """Find what a board cannot be compared with a reference in."""
    if config.compared_with is None:
        return
    position = source.key_place_of(("compared_with",))
    if config.study is None or config.mapping is not None:
        fix = "add study: {boards: 10, hole_free_boards: 10}, without source.views"
        yield Problem("a reference needs a study of single views", position, fix=fix)
    name = config.detector.name
    if "surface" not in detector_type(name).settings_type.model_fields:
        message = f"detector {name} has no surface setting, so that it knows no reference"
        yield Problem(message, source.place_of(DETECTOR_NAME), legal="local, matched or thesis")


def _unknown_problems(config: ExperimentConfig, source: Source) -> Iterator[Problem]:
    """Find unknowns that nothing draws, and two unknowns of one fact."""
    if config.unknowns and config.study is None and config.draws is None:
        fix = "add draws: 100, or make it a study of a family of boards"
        yield Problem("nothing draws the unknowns", source.key_place_of(("unknowns",)), fix=fix)
    for first, second in combinations(range(len(config.unknowns)), 2):
        key = config.unknowns[first].key
        other_key = config.unknowns[second].key
        if is_same_fact(key, other_key):
            message = f"the unknowns `{key}` and `{other_key}` set the same fact"
            position = source.place_of(("unknowns", second, "key"))
            yield Problem(message, position, fix="declare only one of them")


def _study_problems(config: ExperimentConfig, source: Source) -> Iterator[Problem]:
    """Find contradictions between a study, a family of boards and a threshold that is calibrated
    on boards."""
    target = config.source.target if isinstance(config.source, SimulatedSource) else None
    drawn = isinstance(target, DrawnTargetConfig)
    calibrate = config.threshold.calibrate
    boards_at = source.place_of(("threshold", "calibrate", "boards"))
    if config.study is None and drawn:
        fix = (
            "add for instance study: {boards: 60, hole_free_boards: 60}, or choose target: "
            "{name: thesis}"
        )
        yield Problem("a family of boards needs a study", source.place_of(TARGET), fix=fix)
    elif config.study is None and calibrate is not None and calibrate.boards is not None:
        yield Problem("only a study draws boards", boards_at, fix="write `repeats` instead")
    elif config.study is not None and not isinstance(target, DrawnTargetConfig):
        fix = "write source.target: {name: drawn}"
        yield Problem("a study needs a family of boards", source.place_of(TARGET), fix=fix)
    if config.study is None or not isinstance(target, DrawnTargetConfig):
        return
    if config.study.precision is not None:
        yield from _precision_problems(config, target, source)
    if config.sensitivity is not None:
        fix = "sweep the key, or run the study once for each value with --set"
        yield Problem(
            "a study cannot have a sensitivity", source.key_place_of(("sensitivity",)), fix=fix
        )
    # the criterion of a hit and the wanted rate of false calls are rules of the study, equal for
    # all set-ups
    for path in config.sweep:
        if (
            path.split(".")[0] == "matching"
            or path == "threshold"
            or path.startswith("threshold.calibrate")
        ):
            message = f"`{path}` is a rule of the study and cannot be an axis of it"
            fix = (
                "run the study once for each value with --set, and compare them with tofpod compare"
            )
            yield Problem(message, source.key_place_of(("sweep", path)), fix=fix)
    if calibrate is not None and calibrate.boards is None:
        position = source.place_of(("threshold", "calibrate"))
        yield Problem(
            "a study calibrates its threshold on separate boards",
            position,
            fix="write `boards: 60`",
        )
    elif calibrate is not None and calibrate.boards is not None:
        # the number of boards bounds the rate that they can show, even if their whole face is
        # judged: a new run exceeds the highest of n with probability 1 / (n + 1), and has a false
        # call with 1 - exp(-rate *
        # area)
        rate_per_m2 = calibrate.false_calls_per_m2 or 0.0
        area_m2 = target.board.width_mm * target.board.height_mm * MM**2
        needed = ceil(-1 / expm1(-rate_per_m2 * area_m2) * (1 - 1e-12)) - 1
        if calibrate.boards < needed:
            boards = f"{calibrate.boards} hole-free boards of {area_m2:.3g} m2"
            message = f"{boards} cannot show {rate_per_m2:g} false calls per m2"
            fix = "simulate more boards or larger ones, or ask for a higher false_calls_per_m2"
            yield Problem(message, boards_at, f"at least {needed}", fix=fix)


def _precision_problems(
    config: ExperimentConfig, target: DrawnTargetConfig, source: Source
) -> Iterator[Problem]:
    """Find what keeps the sizes of a study with a precision from being chosen."""
    assert config.study is not None
    position = source.key_place_of(("study", "precision"))
    if config.study.boards < LEAST_BOARDS:
        message = f"{config.study.boards} boards are too few for a precision"
        fix = "with a precision, study.boards is the largest number of boards"
        legal = f"at least {LEAST_BOARDS}"
        yield Problem(message, source.place_of(("study", "boards")), legal=legal, fix=fix)
    low_mm, high_mm = target.damage.limit_range_mm
    if low_mm == high_mm:
        message = f"all damages have a {target.damage.limit_of} of {low_mm:g} mm"
        fix = "declare a range of sizes in source.target.damage, or remove study.precision"
        yield Problem(f"{message}, so that no size can be chosen", position, fix=fix)
    if config.unknowns:
        message = "a study with a precision cannot draw unknowns"
        fix = (
            "write unknowns: [], or remove study.precision: what unknowns do shows only on boards "
            "with sizes over the whole range"
        )
        yield Problem(message, position, fix=fix)


def _target_problems(
    config: ExperimentConfig, simulated: SimulatedSource, source: Source
) -> Iterator[Problem]:
    drawn = simulated.target if isinstance(simulated.target, DrawnTargetConfig) else None
    try:
        target = _declared(simulated.target)
    except (
        UserError
    ) as error:  # this includes a family of boards that are too full for their damage
        yield Problem(error.message, source.place_of(TARGET), legal=error.legal, fix=error.fix)
        return
    if unseen := _unseen(simulated.camera, simulated.views, simulated.target):
        path, mistake = unseen
        yield Problem(mistake.message, source.place_of(path), legal=mistake.legal, fix=mistake.fix)
    apart_mm = [dist(a.centre_mm, b.centre_mm) for a, b in combinations(target.damages, 2)]
    pitch_mm = drawn.apart_mm if drawn is not None else min(apart_mm, default=None)
    if pitch_mm is not None and config.matching.radius_mm > pitch_mm / 2:
        message = (
            f"within a matching radius of {config.matching.radius_mm:g} mm, a detection can "
            "match two damages"
        )
        legal = f"at most {pitch_mm / 2:g} mm for damages whose centres are {pitch_mm:g} mm apart"
        yield Problem(message, source.place_of(("matching", "radius_mm")), legal=legal)


@lru_cache(maxsize=10_000)
def _declared(config: AnyTargetConfig) -> TargetConfig:
    """Return the target, or the first board of a family. Raises UserError if it cannot exist."""
    target = config.declare()
    check_target(target)
    return target


@lru_cache(maxsize=10_000)
def _unseen(
    camera: CameraConfig, views: AnyViews | None, declared: AnyTargetConfig
) -> tuple[KeyPath, UserError] | None:
    """Return why the camera does not see the target, and the key that causes it: an unknown
    camera, no albedo at its wavelength, or `_unseen_pose`. A family is checked in its extreme
    poses, first in a single view."""
    target = _declared(declared)
    path: KeyPath = CAMERA_NUMBERS if camera.numbers else CAMERA_NAME
    try:
        optics = camera_of(camera).optics
        path = TARGET
        target.at_wavelength(optics.wavelength_nm)
    except UserError as mistake:
        return path, mistake
    if not isinstance(declared, DrawnTargetConfig):
        return _unseen_pose(optics, views, target)
    for pose in declared.extreme_poses():
        posed = target.model_copy(update={"pose": pose})
        message = _unseen_pose(optics, None, posed) or (
            views and _unseen_pose(optics, views, posed)
        )
        if message:
            path, first = message
            aside = f"{pose.offset_x_mm:.3g} and {pose.offset_y_mm:.3g} mm off the axis"
            turned = (
                f"tilted by {pose.tilt_x_deg:.3g}° and {pose.tilt_y_deg:.3g}°, rolled by "
                f"{pose.roll_deg:.3g}°"
            )
            where = f"a board drawn at {pose.distance_m:.3g} m, {aside}, {turned}"
            return path, UserError(f"{where}: {first.message}", legal=first.legal, fix=first.fix)
    return None


def _unseen_pose(
    optics: Optics, views: AnyViews | None, target: TargetConfig
) -> tuple[KeyPath, UserError] | None:
    """Return the mistake of the first pose that sees nothing of the face within range, and the key
    that causes it."""
    try:
        poses = (target.pose,) if views is None else poses_of(views, target.pose)
    except ValidationError as error:
        first = error.errors()[0]
        key = str(first["loc"][-1])
        value = first["input"]
        legal = shape.legal_at(shape.Declared(type(target.pose), {}, {}).at((key,)))
        message = f"a view's pose is not legal: {key} would be {value:g}"
        return VIEWS, UserError(message, legal=legal, fix="lower the spread or the sway")
    for number, pose in enumerate(poses):
        try:
            check_in_view(target.model_copy(update={"pose": pose}), optics)
        except UserError as mistake:
            if views is None:
                return TARGET, mistake
            tilts = (
                f"tilts {pose.tilt_x_deg:.3g} and {pose.tilt_y_deg:.3g}°, {pose.distance_m:.3g} m"
            )
            message = f"view {number} of {len(poses)} ({tilts}): {mistake.message}"
            return VIEWS, UserError(message, legal=mistake.legal, fix=mistake.fix)
    return None


def _mapping_problems(
    config: ExperimentConfig, simulated: SimulatedSource, source: Source
) -> Iterator[Problem]:
    """Find contradictions between several views and their mapping into one cloud."""
    views = simulated.views
    mapping = config.mapping
    if views is None and mapping is not None:
        fix = "declare source.views, for instance {kind: arc, count: 3, spread_deg: 40.0}"
        yield Problem("a mapping needs several views", source.place_of(("mapping",)), fix=fix)
    elif views is not None and mapping is None:
        fix = "declare mapping, for instance {registration: {method: marks}, merge: {kind: fusion}}"
        yield Problem(
            "several views need a mapping into one cloud", source.place_of(VIEWS), fix=fix
        )
    elif (
        views is not None
        and mapping is not None
        and (mapping.views or 0) > (count := view_count(views))
    ):
        position = source.place_of(("mapping", "views"))
        yield Problem(
            f"{mapping.views} views, but source.views has {count}", position, legal=f"1 to {count}"
        )


def _filter_problems(depth_filter: DepthFilterConfig, source: Source) -> Iterator[Problem]:
    """Report a filter over frames that is to act on an average, which is a single picture."""
    loaded = load_filter(depth_filter.name, depth_filter.settings)
    if depth_filter.acts_on == "average" and getattr(loaded, "remembers_frames", False):
        position = source.place_of(("capture", "filter", "acts_on"))
        message = f"the filter {depth_filter.name!r} changes nothing in a single picture"
        yield Problem(message, position, legal="frames")


def _flat_field_problems(
    config: ExperimentConfig, simulated: SimulatedSource, source: Source
) -> Iterator[Problem]:
    """Report a flat field whose plane lies outside the camera's range."""
    try:
        flat_field = config.capture.flat_field
        optics = camera_of(simulated.camera).optics
    except UserError:
        return  # reported together with the target's pose
    if flat_field is not None and not optics.nearest_m < flat_field.distance_m < optics.farthest_m:
        position = source.place_of(("capture", "flat_field"))
        legal = f"{optics.nearest_m:g} to {optics.farthest_m:g} m"
        yield Problem(
            f"{optics.title} gives no range at {flat_field.distance_m:g} m", position, legal=legal
        )


def _capture_problems(
    config: ExperimentConfig, capture: CaptureSource, source: Source
) -> Iterator[Problem]:
    """Find files that are missing or cannot be read, and keys that only a simulated source can
    have."""
    missing = [number for number, name in enumerate(capture.paths) if not Path(name).exists()]
    for number, path in ((number, Path(capture.paths[number])) for number in missing):
        nearest_name = nearest(path.name, [file.name for file in path.parent.glob("*")])
        position = source.place_of(("source", "paths", number))
        yield Problem(f"{path}: there is no such file or folder", position, nearest=nearest_name)
    lens = capture.intrinsics
    if unknown := bool(lens) and lens not in camera_names() and not Path(str(lens)).is_file():
        legal = f"a file, or one of {', '.join(camera_names())}"
        position = source.place_of(("source", "intrinsics"))
        yield Problem(f"{lens}: is neither a file nor a camera", position, legal)
    try:
        if not missing and not unknown:
            recording_of(capture)
    except UserError as error:
        yield Problem(
            error.message, source.place_of(("source", "paths")), legal=error.legal, fix=error.fix
        )
    reason = "a flat field needs a simulated unit"
    hole_free = "only on hole-free repeats, which a capture does not have"
    for key, value, message, fix in (
        (
            "capture.flat_field",
            config.capture.flat_field,
            reason,
            "use tofpod flatfield, tofpod detect --flat-field",
        ),
        (
            "mapping",
            config.mapping,
            "a mapping needs the views of a simulated source",
            "use tofpod detect --register",
        ),
        (
            "threshold.calibrate",
            config.threshold.calibrate,
            f"a threshold can be calibrated {hole_free}",
            "give `k`",
        ),
    ):
        if value is not None:
            yield Problem(message, source.place_of(tuple(key.split("."))), fix=fix)
