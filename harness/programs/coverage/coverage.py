"""``tofpod coverage EXPERIMENT``: where on a part damage is missed, and which poses cover most of
it."""

from __future__ import annotations

import argparse
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.path_names import camera_title, in_words
from harness.vocabulary.program import program, whole_number

if TYPE_CHECKING:
    from harness.programs.coverage.jobs import Pose, Survey

# candidates for --suggest and --goal
TILTS_DEG = (-40.0, -20.0, 0.0, 20.0, 40.0)
GOAL_TILTS_DEG = (-30.0, 0.0, 30.0)
GOAL_DISTANCES = (0.7, 1.0, 1.4)  # Distances for --goal, as multiples of the experiment's distance
# Most poses to reach a goal, and seconds to move the camera between two poses
MOST_POSES = 6
MOVE_S = 10.0


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        type=Path,
        help="a YAML file, or the name of one that comes with tofpod: a study of drawn damage",
    )
    change = "change a value of the file, such as source.target.distance_m=0.9; may be repeated"
    add("--set", dest="overrides", metavar="PATH=VALUE", action="append", default=[], help=change)
    pose = (
        "distance in metres and tilts of the part about x and y in degrees, such as 0.7,20,-10; "
        "may be repeated"
    )
    add(
        "--pose",
        action="append",
        type=_pose,
        metavar="M,DEG,DEG",
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
    try:
        distance_m, tilt_x, tilt_y = map(float, text.split(","))
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
    epilog="example: tofpod coverage pipe --size 3mm --suggest 3",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Return 0 (even if a goal is not reached), 2 after a user's mistake, 130 after Ctrl-C."""
    from harness.experiment.load import load_experiment, resolved_yaml
    from harness.programs.coverage.jobs import declared, refuse_size, survey
    from harness.programs.coverage.page import answer, coverage_html, scene_of, warnings_of
    from harness.programs.coverage.tables import COVERAGE, GOALS, POSES
    from harness.records.outputs import COVERAGE_PAGE, EXPERIMENT
    from harness.runs.engines import engine_of
    from harness.runs.options import EngineOptions
    from harness.runs.shards import locked
    from harness.runs.tables import write_tables
    from harness.vocabulary.files import write_text
    from harness.vocabulary.program import length_m
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from harness.vocabulary.text import many, show
    from scenes.render.cache import in_use

    experiment = load_experiment(options.experiment, options.overrides)
    name = experiment.config.name
    if options.goal and (options.size or options.suggest or options.pose):
        raise UserError(
            "--goal states a size and chooses the poses",
            fix="leave out --size, --suggest and --pose",
        )
    if not 0 < options.share <= 1:
        raise UserError(f"--share {options.share:g}", legal="a share above 0, up to 1")
    if len(experiment.points) > 1 and not options.goal:
        message = (
            f"{name}: has {len(experiment.points)} set-ups, but only --goal can compare several"
        )
        raise UserError(
            message, fix="choose one set-up with --set, such as sweep={} and the values of its axes"
        )
    size = options.goal or options.size
    size_mm = length_m("--goal" if options.goal else "--size", size) / MM if size else None
    for point in experiment.points:
        refuse_size(point.config, size_mm)
    given_poses, further_poses = _poses(options, declared(experiment.config)[1].distance_m)
    folder = options.out or options.results / "coverage" / name
    cache = options.results / ".cache" / "renders"
    write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
    engine = engine_of(
        EngineOptions(jobs=options.jobs, serial=options.serial), {experiment.config.detector.name}
    )
    with in_use(cache), locked(folder), engine:
        surveys = survey(experiment, [*given_poses, *further_poses], cache, folder, engine)
    chosen = surveys[0]
    goals = []
    if options.goal:
        ways = (
            row
            for survey in surveys
            for row in _ways(survey, size_mm or survey.found.sizes_mm[1], options.share)
        )
        order = {True: "capture_s", False: "missing_share"}
        goals = sorted(ways, key=lambda row: (not row["reached"], row[order[row["reached"]]]))
        chosen = goals[0]["survey"]
    wanted = size_mm or chosen.found.sizes_mm[1]
    findable = chosen.found
    poses = (
        goals[0]["rows"]
        if goals
        else _rows(chosen, list(chosen.seen), wanted, len(given_poses), options.suggest)
    )
    if not poses:
        raise UserError(
            f"{name}: no pose finds damage of {wanted:.3g} mm anywhere", fix="ask for a larger size"
        )
    each_mm = np.stack([row["limits_mm"] for row in poses])
    patches = chosen.patches
    best = np.nan_to_num(each_mm, nan=np.inf).argmin(axis=0)
    limits_mm = np.fmin.reduce(each_mm)
    seen_at_poses = [chosen.seen[row["pose"]] for row in poses]
    facts = np.stack(
        [
            [seen_at_pose.deviation_m, seen_at_pose.cosine, seen_at_pose.range_m]
            for seen_at_pose in seen_at_poses
        ]
    )
    columns = [*(patches.points_m / MM).T, patches.areas_m2, limits_mm, best + 1]
    noise_m, cosine, range_m = facts[best, :, np.arange(len(best))].T
    columns += [noise_m / MM, np.degrees(np.arccos(cosine)), range_m]
    names = [column.name for column in COVERAGE.columns]
    rows = {COVERAGE: [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]}
    rows |= {POSES: poses, GOALS: goals}
    provenance = {**record(command), "results_version": RESULTS_VERSION, "experiment": name}
    provenance |= {"digest": experiment.digest, "seed": experiment.config.seed}
    write_tables(folder, {table: table.frame(row) for table, row in rows.items()}, provenance)
    warnings = warnings_of(findable, chosen.seen)
    sentence = answer(findable, patches, limits_mm, wanted, len(poses))
    if (added := len(poses) - len(given_poses)) < options.suggest:
        note_text = (
            f"{added} of {many(options.suggest, 'pose')} suggested: no other pose increases the "
            "coverage"
        )
        warnings.insert(0, note_text)
    if goals:
        lead = f"Quickest capture ({goals[0]['capture_s']:.0f} s)"
        if not goals[0]["reached"]:
            lead = f"No set of poses covers {100 * options.share:g} % of the face; the best one"
        frames = many(goals[0]["frames"], "frame")
        sentence = (
            f"{lead}: {goals[0]['camera']}, {frames}, {goals[0]['distance_m']:g} m. {sentence}"
        )
    config = chosen.point.config
    scene = scene_of(patches, limits_mm, findable)
    camera = config.simulated.camera
    detector = (
        f"the detector {config.detector.name} at a threshold of "
        f"{chosen.task.criteria.threshold:.3g}"
    )
    unit = (
        f"unit {camera.unit_seed} of {camera_title(Path(camera.name).stem)}, "
        f"{many(config.capture.frames, 'frame')}"
    )
    first = f"Simulated, for {unit}, {detector}. {findable.statement}"
    html = coverage_html(name, sentence, first, scene, poses, goals, warnings, command)
    write_text(folder / COVERAGE_PAGE.name, html)
    grids = [table.grid(rows[table], terminal=True) for table in (GOALS, POSES) if rows[table]]
    show([*(f"warning: {text}" for text in warnings), sentence, first, *grids])
    print(f"page: {folder / COVERAGE_PAGE.name}")
    return 0


def _poses(options: argparse.Namespace, own_m: float) -> tuple[list[Pose], list[Pose]]:
    """Return the given poses, and the further poses to choose from."""
    if options.goal:
        distances = [round(own_m * part, 4) for part in GOAL_DISTANCES]
        tilts = GOAL_TILTS_DEG
        return [], list(product(distances, tilts, tilts))
    given_poses = list(dict.fromkeys(options.pose or [(own_m, 0.0, 0.0)]))
    grid = [
        pose
        for pose in product([given_poses[0][0]], TILTS_DEG, TILTS_DEG)
        if min(abs(pose[1]), abs(pose[2])) < 40
    ]
    return given_poses, [
        pose for pose in grid if pose not in given_poses
    ] if options.suggest else []


def _rows(
    surveyed: Survey, poses: list[Pose], size_mm: float, given_count: int, further_count: int
) -> list[dict[str, Any]]:
    """Return a row for each given pose and for each pose that is added, in order."""
    from harness.programs.coverage.statistics import in_turn

    limits_mm = [surveyed.found.limits_mm(surveyed.seen[pose]) for pose in poses]
    rows = list[dict[str, Any]]()
    for pose_index, gain, total in in_turn(
        surveyed.patches,
        [limit_mm <= size_mm for limit_mm in limits_mm],
        given_count,
        further_count,
    ):
        row = {
            "number": len(rows) + 1,
            "pose": poses[pose_index],
            "limits_mm": limits_mm[pose_index],
        }
        row |= dict(zip(("distance_m", "tilt_x_deg", "tilt_y_deg"), poses[pose_index], strict=True))
        row |= {"alone_share": surveyed.patches.share(limits_mm[pose_index] <= size_mm)}
        rows.append(row | {"gain_share": gain, "total_share": total})
    return rows


def _ways(surveyed: Survey, size_mm: float, share: float) -> list[dict[str, Any]]:
    """Return, for each distance, few poses of a set-up that reach the share, chosen greedily, or
    `MOST_POSES` poses."""
    from scenes.sensor.camera import camera_of

    ways = []
    config = surveyed.point.config
    camera = camera_of(config.simulated.camera)
    frames = config.capture.frames
    for distance_m in dict.fromkeys(pose[0] for pose in surveyed.seen):
        rows = _rows(
            surveyed,
            [pose for pose in surveyed.seen if pose[0] == distance_m],
            size_mm,
            0,
            MOST_POSES,
        )
        rows = rows[
            : next((row["number"] for row in rows if row["total_share"] >= share), len(rows))
        ]
        covered = rows[-1]["total_share"] if rows else 0.0
        seconds = (
            len(rows) * frames / camera.unit.frames_per_second.value
            + max(len(rows) - 1, 0) * MOVE_S
        )
        tilts = "; ".join(f"{row['tilt_x_deg']:g}, {row['tilt_y_deg']:g}" for row in rows)
        way = {
            "set_up": in_words(surveyed.point.variant),
            "camera": camera_title(camera.name),
            "frames": frames,
        }
        way |= {"distance_m": distance_m, "poses": len(rows), "tilts": tilts}
        way |= {"total_share": covered, "capture_s": seconds}
        ways.append(
            {
                **way,
                "reached": covered >= share,
                "missing_share": 1 - covered,
                "rows": rows,
                "survey": surveyed,
            }
        )
    return ways


if __name__ == "__main__":
    raise SystemExit(main())
