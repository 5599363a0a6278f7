"""``tofpod coverage EXPERIMENT``: where on a part damage is missed, and which poses cover most of
it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.runs.options import add_overrides
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.lengths import in_unit
from harness.vocabulary.path_names import camera_title, in_words
from harness.vocabulary.program import program, whole_number

if TYPE_CHECKING:
    from harness.experiment.schema import Experiment
    from harness.programs.coverage.jobs import Pose, Survey

# candidates for --suggest and --goal
TILTS_DEG = (-40.0, -20.0, 0.0, 20.0, 40.0)
GOAL_TILTS_DEG = (-30.0, 0.0, 30.0)
# Distances for --goal, as multiples of the experiment's distance
GOAL_DISTANCES = (0.7, 1.0, 1.4)
# Most poses to reach a goal
MOST_POSES = 6
# Seconds to move the camera between two poses
MOVE_S = 10.0


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        type=Path,
        help="a YAML file, or the name of one that comes with tofpod: a study of drawn damage",
    )
    add_overrides(parser, "source.target.distance_m=90cm")
    add("--detector", metavar="NAME", help="the only detector, of an experiment that compares some")
    pose = (
        "distance (bare: m) and tilts of the part about x and y in degrees, such as 0.7,20,-10; "
        "may be repeated"
    )
    add(
        "--pose",
        action="append",
        type=_pose,
        metavar="LENGTH,DEG,DEG",
        help=f"{pose} (default: the experiment's, frontal)",
    )
    add(
        "--size",
        metavar="LENGTH",
        help="the wanted size, such as 5mm (default: the largest of the experiment)",
    )
    best = "add the N best poses, one by one, with tilts from -40 to 40° about x and about y"
    add("--suggest", type=whole_number(20), default=0, metavar="N", help=best)
    goal = (
        "find the quickest capture that finds this size on the share, over all set-ups, "
        "distances and tilts"
    )
    add("--goal", metavar="LENGTH", help=goal)
    add("--share", type=float, default=0.9, help="share of the face for --goal (default: 0.9)")
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help="default: results/coverage/ and the experiment's name",
    )
    results = (
        "results folder of experiments, whose stored renders are used and extended (default: "
        "results)"
    )
    add("--results", type=Path, default=Path("results"), metavar="DIR", help=results)
    add("--jobs", type=whole_number(256), default=2, metavar="N", help="processes (default: 2)")
    add("--serial", action="store_true", help="run everything in this process, for a debugger")


def _pose(text: str) -> Pose:
    distance_text, *tilts = text.split(",")
    distance_m = in_unit(distance_text, "m") or 0.0
    try:
        tilt_x, tilt_y = map(float, tilts)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not DISTANCE,TILT,TILT, such as 0.7,20,0"
        ) from error
    if not (0.1 <= distance_m <= 10 and abs(tilt_x) <= 60 and abs(tilt_y) <= 60):
        raise argparse.ArgumentTypeError(
            f"{text!r}: a distance is 0.1 to 10 m, a tilt -60 to 60 degrees"
        )
    return distance_m, tilt_x, tilt_y


@program(
    _options,
    "State the smallest damage that is found nine times out of ten at each place of a part, "
    "given the noise, angle, "
    "distance and missing returns there, and the share of the part on which a wanted size "
    "is found. Write tables and a "
    "page on which the part can be turned.",
    "tofpod coverage pipe --detector thesis --size 3mm --suggest 2",
    "tofpod coverage pipe --goal 3mm --share 0.9",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Return 0 (even if a goal is not reached), 2 after a user's mistake, 130 after Ctrl-C."""
    from harness.experiment.load import load_experiment, resolved_yaml
    from harness.programs.coverage.jobs import declared, survey
    from harness.records.outputs import EXPERIMENT
    from harness.runs.engines import engine_of
    from harness.runs.options import EngineOptions
    from harness.runs.shards import locked
    from harness.vocabulary.files import write_text
    from scenes.render.cache import in_use

    overrides = options.overrides
    if options.detector:
        overrides = [*overrides, f"sweep.detector.name=[{options.detector}]"]
    experiment = load_experiment(options.experiment, overrides).at_stated_values()
    config = experiment.config
    size_mm = _wanted_mm(options, experiment)
    given_poses, further_poses = _poses(options, declared(config)[1].distance_m)
    folder = options.out or options.results / "coverage" / config.name
    cache = options.results / ".cache" / "renders"
    write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
    engine_options = EngineOptions(jobs=options.jobs, serial=options.serial)
    engine = engine_of(engine_options, {config.detector.name})
    with in_use(cache), locked(folder), engine:
        surveys = survey(experiment, [*given_poses, *further_poses], cache, folder, engine)
    covered = _covered(surveys, size_mm, len(given_poses), options)
    if not covered.poses:
        message = f"{config.name}: no pose finds damage of {covered.size_mm:.3g} mm anywhere"
        raise UserError(message, fix="ask for a larger size")
    _write_tables(folder, covered, experiment, command)
    _write_page(folder, covered, config.name, len(given_poses), options, command)
    return 0


@dataclass(frozen=True, eq=False)
class _Covered:
    """The answer: a set-up, and poses of it."""

    # The set-up whose poses are shown: that of the best way if a goal is given
    survey: Survey
    # The wanted size of damage, mm
    size_mm: float
    # Rows of the table of poses, in the order in which they are added
    poses: list[dict[str, Any]]
    # Rows of the table of ways to the goal, the best first; empty without a goal
    goals: list[dict[str, Any]]
    # Smallest size (n,) found in any of the poses, mm, by patch; inf: none is; NaN: not judged
    limits_mm: np.ndarray


def _wanted_mm(options: argparse.Namespace, experiment: Experiment) -> float | None:
    """Return the wanted size in millimetres, None for the largest of the experiment. Raises
    UserError for options that contradict each other or the experiment."""
    from harness.programs.coverage.jobs import refuse_size
    from harness.vocabulary.program import length_m

    if options.goal and (options.size or options.suggest or options.pose):
        raise UserError(
            "--goal states a size and chooses the poses",
            fix="leave out --size, --suggest and --pose",
        )
    if not 0 < options.share <= 1:
        raise UserError(f"--share {options.share:g}", legal="a share above 0, up to 1")
    set_ups = len(experiment.points)
    if set_ups > 1 and not options.goal:
        raise UserError(
            (
                f"{experiment.config.name}: has {set_ups} set-ups, but only --goal can compare "
                "several"
            ),
            fix="choose one set-up: --detector NAME, or --set sweep={} and the values of its axes",
        )
    size_mm = None
    if options.goal:
        size_mm = length_m("--goal", options.goal) / MM
    elif options.size:
        size_mm = length_m("--size", options.size) / MM
    for point in experiment.points:
        refuse_size(point.config, size_mm)
    return size_mm


def _covered(
    surveys: list[Survey], size_mm: float | None, given_count: int, options: argparse.Namespace
) -> _Covered:
    """Return the given and suggested poses of the only set-up, or the best way to the goal."""
    goals = []
    if options.goal:
        for surveyed in surveys:
            wanted_mm = size_mm or surveyed.findable.sizes_mm[1]
            goals += _ways(surveyed, wanted_mm, options.share)
        goals.sort(key=_rank)
    chosen = goals[0]["survey"] if goals else surveys[0]
    wanted_mm = size_mm or chosen.findable.sizes_mm[1]
    if goals:
        poses = goals[0]["rows"]
    else:
        poses = _rows(chosen, list(chosen.visibility), wanted_mm, given_count, options.suggest)
    limits_mm = np.fmin.reduce([row["limits_mm"] for row in poses]) if poses else np.empty(0)
    return _Covered(survey=chosen, size_mm=wanted_mm, poses=poses, goals=goals, limits_mm=limits_mm)


def _rank(way: dict[str, Any]) -> tuple[bool, float]:
    """Order ways that reach the goal by time, after them the others by what they miss."""
    if way["reached"]:
        return False, way["capture_s"]
    return True, way["missing_share"]


def _write_tables(folder: Path, covered: _Covered, experiment: Experiment, command: str) -> None:
    from harness.programs.coverage.tables import COVERAGE, GOALS, POSES
    from harness.runs.tables import write_tables
    from harness.vocabulary.provenance import RESULTS_VERSION, record

    rows = {COVERAGE: _patch_rows(covered), POSES: covered.poses, GOALS: covered.goals}
    provenance = {
        **record(command),
        "results_version": RESULTS_VERSION,
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        "seed": experiment.config.seed,
    }
    write_tables(folder, {table: table.frame(row) for table, row in rows.items()}, provenance)


def _patch_rows(covered: _Covered) -> list[dict[str, Any]]:
    """Return a row for each patch of the face, with the view of its best pose."""
    from harness.programs.coverage.tables import COVERAGE

    patches = covered.survey.patches
    pose_limits_mm = np.stack([row["limits_mm"] for row in covered.poses])
    best = np.nan_to_num(pose_limits_mm, nan=np.inf).argmin(axis=0)
    views = [covered.survey.visibility[row["pose"]] for row in covered.poses]
    facts = np.stack([[view.deviation_m, view.cosine, view.range_m] for view in views])
    noise_m, cosine, range_m = facts[best, :, np.arange(len(best))].T
    columns = [
        *(patches.points_m / MM).T,
        patches.areas_m2,
        covered.limits_mm,
        best + 1,
        noise_m / MM,
        np.degrees(np.arccos(cosine)),
        range_m,
    ]
    names = [column.name for column in COVERAGE.columns]
    return [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]


def _write_page(
    folder: Path,
    covered: _Covered,
    name: str,
    given_count: int,
    options: argparse.Namespace,
    command: str,
) -> None:
    """Write the page, and show its sentences and tables in the terminal."""
    from harness.programs.coverage.page import answer, coverage_html, scene_of, warnings_of
    from harness.programs.coverage.tables import GOALS, POSES
    from harness.records.outputs import COVERAGE_PAGE
    from harness.vocabulary.files import write_text
    from harness.vocabulary.text import many, show

    patches = covered.survey.patches
    findable = covered.survey.findable
    poses = covered.poses
    goals = covered.goals
    warnings = warnings_of(findable, covered.survey.visibility)
    added = len(poses) - given_count
    if added < options.suggest:
        warnings.insert(
            0,
            f"{added} of {many(options.suggest, 'pose')} suggested: no other pose increases the "
            "coverage",
        )
    sentence = answer(findable, patches, covered.limits_mm, covered.size_mm, len(poses))
    if goals:
        sentence = f"{_lead(goals[0], options.share)}. {sentence}"
    first = _origin(covered.survey)
    scene = scene_of(patches, covered.limits_mm, findable)
    page = folder / COVERAGE_PAGE.name
    write_text(page, coverage_html(name, sentence, first, scene, poses, goals, warnings, command))
    grids = [
        table.grid(rows, terminal=True) for table, rows in ((GOALS, goals), (POSES, poses)) if rows
    ]
    show([*(f"warning: {text}" for text in warnings), sentence, first, *grids])
    print(f"page: {page}")


def _lead(way: dict[str, Any], share: float) -> str:
    """State the best way to the goal."""
    from harness.vocabulary.text import many

    lead = f"Quickest capture ({way['capture_s']:.0f} s)"
    if not way["reached"]:
        lead = f"No set of poses covers {100 * share:g} % of the face; the best one"
    frames = many(way["frames"], "frame")
    return f"{lead}: {way['camera']}, {frames}, {way['distance_m']:g} m"


def _origin(surveyed: Survey) -> str:
    """State what was simulated, and the law of the signal."""
    from harness.vocabulary.text import many

    config = surveyed.point.config
    camera = config.simulated.camera
    title = camera_title(Path(camera.name).stem)
    frames = many(config.capture.frames, "frame")
    return (
        f"Simulated, for unit {camera.unit_seed} of {title}, {frames}, the detector "
        f"{config.detector.name} at a threshold of {surveyed.task.criteria.threshold:.3g}. "
        f"{surveyed.findable.statement}"
    )


def _poses(options: argparse.Namespace, declared_m: float) -> tuple[list[Pose], list[Pose]]:
    """Return the given poses, and the further poses to choose from."""
    if options.goal:
        distances = [round(declared_m * part, 4) for part in GOAL_DISTANCES]
        tilts = GOAL_TILTS_DEG
        return [], list(product(distances, tilts, tilts))
    given_poses = list(dict.fromkeys(options.pose or [(declared_m, 0.0, 0.0)]))
    further_poses: list[Pose] = []
    if options.suggest:
        for pose in product([given_poses[0][0]], TILTS_DEG, TILTS_DEG):
            if min(abs(pose[1]), abs(pose[2])) < 40 and pose not in given_poses:
                further_poses.append(pose)
    return given_poses, further_poses


def _rows(
    surveyed: Survey, poses: list[Pose], size_mm: float, given_count: int, further_count: int
) -> list[dict[str, Any]]:
    """Return a row for each given pose and for each pose that is added, in order."""
    from harness.programs.coverage.statistics import in_turn

    limits_mm = [surveyed.findable.limits_mm(surveyed.visibility[pose]) for pose in poses]
    found_patches = [limit_mm <= size_mm for limit_mm in limits_mm]
    turns = in_turn(surveyed.patches, found_patches, given_count, further_count)
    rows = list[dict[str, Any]]()
    for pose_index, gain, total in turns:
        pose = poses[pose_index]
        distance_m, tilt_x_deg, tilt_y_deg = pose
        row = {
            "number": len(rows) + 1,
            "pose": pose,
            "limits_mm": limits_mm[pose_index],
            "distance_m": distance_m,
            "tilt_x_deg": tilt_x_deg,
            "tilt_y_deg": tilt_y_deg,
            "alone_share": surveyed.patches.share(found_patches[pose_index]),
            "gain_share": gain,
            "total_share": total,
        }
        rows.append(row)
    return rows


def _ways(surveyed: Survey, size_mm: float, share: float) -> list[dict[str, Any]]:
    """Return, for each distance, few poses of a set-up that reach the share, chosen greedily, or
    `MOST_POSES` poses."""
    from scenes.sensor.camera import camera_of

    ways = []
    frames = surveyed.point.config.capture.frames
    camera = camera_of(surveyed.point.config.simulated.camera)
    for distance_m in dict.fromkeys(pose[0] for pose in surveyed.visibility):
        poses = [pose for pose in surveyed.visibility if pose[0] == distance_m]
        rows = _rows(surveyed, poses, size_mm, 0, MOST_POSES)
        needed = (row["number"] for row in rows if row["total_share"] >= share)
        rows = rows[: next(needed, len(rows))]
        covered = rows[-1]["total_share"] if rows else 0.0
        moving_s = max(len(rows) - 1, 0) * MOVE_S
        row = {
            "set_up": in_words(surveyed.point.variant),
            "camera": camera_title(camera.name),
            "frames": frames,
            "distance_m": distance_m,
            "poses": len(rows),
            "tilts": "; ".join(f"{row['tilt_x_deg']:g}, {row['tilt_y_deg']:g}" for row in rows),
            "total_share": covered,
            "capture_s": len(rows) * frames / camera.unit.frames_per_second.value + moving_s,
            "reached": covered >= share,
            "missing_share": 1 - covered,
            "rows": rows,
            "survey": surveyed,
        }
        ways.append(row)
    return ways


if __name__ == "__main__":
    raise SystemExit(main())
