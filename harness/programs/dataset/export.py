"""``tofpod export``: exports an experiment's simulated views, with truth, for other mapping
programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.runs.options import add_overrides
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import atomic_folder, write_json, write_text
from harness.vocabulary.program import program, whole_number

if TYPE_CHECKING:
    from harness.experiment.schema import Experiment
    from harness.programs.dataset.exchange import ExportedView
    from harness.records.rows import Role
    from scenes.target.custom import TargetConfig

FORMATS = ("tum", "ros2", "mcap")
# the repeat whose noise is exported, so that the frames equal those of an experiment's first
# repeat
REPEAT = 0


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("experiment", type=Path, help="an experiment's file or name")
    add(
        "--format",
        required=True,
        choices=FORMATS,
        help="tum: one sequence; ros2 (sqlite3), mcap: one bag per view",
    )
    add("--out", required=True, type=Path, metavar="DIR", help="a new or empty folder")
    add_overrides(parser, "source.target.distance_m=90cm")
    add(
        "--views",
        type=whole_number(10_000),
        metavar="N",
        help="export only the first N views (default: all)",
    )
    frames = "frames of each view (default: the experiment's capture.frames)"
    add("--frames", type=whole_number(10_000), metavar="N", help=frames)
    add("--hole-free", action="store_true", help="export the same target without its damage")
    results = (
        "results folder of experiments, whose stored renders are used and extended (default: "
        "results)"
    )
    add("--results", type=Path, default=Path("results"), metavar="DIR", help=results)


@program(
    _options,
    "Render and simulate the views of an experiment, and write them with their true poses and "
    "damages as a TUM RGB-D sequence, or as a ROS 2 bag per view with PointCloud2, CameraInfo and "
    "tf_static.",
    "tofpod export perspectives --format mcap --views 3 --out bags",
    "tofpod export perspectives --format tum --frames 10 --hole-free --out sequence",
)
def main(arguments: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.experiment.load import load_experiment
    from harness.programs.dataset.exchange import in_turn, write_bag, write_tum
    from harness.runs.plan import batch_of
    from scenes.render.cache import cached_view
    from scenes.sensor.camera import camera_of
    from scenes.sensor.source import SimulatedUnit

    experiment = load_experiment(arguments.experiment, arguments.overrides)
    source = experiment.config.simulated
    seed = experiment.config.seed
    role: Role = "hole_free" if arguments.hole_free else "damaged"
    camera = camera_of(source.camera)
    cache = arguments.results / ".cache" / "renders"
    batch = batch_of(source.target.declare(), role, source, cache)
    count = len(batch.renders) if arguments.views is None else arguments.views
    if count > len(batch.renders):
        raise UserError(
            f"--views {count}: the experiment has {len(batch.renders)}",
            legal=f"1 to {len(batch.renders)}",
        )
    frames = arguments.frames or experiment.config.capture.frames
    captures = []
    with atomic_folder(arguments.out) as folder:
        for number, job in enumerate(batch.renders[:count]):
            view, from_cache = cached_view(job.target, camera.optics, job.config, cache)
            origin = f"rendered in {view.seconds:.1f} s"
            if from_cache:
                origin = "render from the cache"
            print(f"view {number}: {origin}")
            unit = SimulatedUnit(camera, job.camera, view)
            labels = ("view", number) if number else ()
            captures.append(unit.capture(frames, seed, role, REPEAT, *labels))
        targets = [job.target for job in batch.renders[:count]]
        rate = camera.unit.frames_per_second.value
        views = in_turn(captures, [target.pose.T_camera_board for target in targets], frames, rate)
        if arguments.format == "tum":
            write_tum(folder, views)
        else:
            for exported in views:
                write_bag(folder / exported.name, exported, arguments.format == "mcap")
        _write_beside(folder, arguments, experiment, targets, views, command)
    swept = [path for path in experiment.config.sweep if path.startswith("source.")]
    if swept:
        print(
            f"note: {', '.join(swept)}: the value of `source` is used, not the axis; --set "
            "chooses another value"
        )
    size_mb = sum(path.stat().st_size for path in arguments.out.rglob("*") if path.is_file()) / 1e6
    print(
        f"wrote {arguments.out}: {len(views)} views of {frames} frames, {size_mb:.0f} MB, with "
        "truth.json"
    )
    return 0


def _write_beside(
    folder: Path,
    arguments: argparse.Namespace,
    experiment: Experiment,
    targets: list[TargetConfig],
    views: tuple[ExportedView, ...],
    command: str,
) -> None:
    """Write the truth, the nominal poses for a registration, the declaration, and the
    provenance."""
    import numpy as np

    from harness.experiment.load import resolved_yaml
    from harness.inspection.arguments import POSES_KEY
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from scenes.perspectives import guessed_T_reference_view
    from scenes.target.truth import truth_of

    nominal = [np.eye(4)]
    poses = tuple(target.pose for target in targets)
    source = experiment.config.simulated
    role = "hole_free" if arguments.hole_free else "damaged"
    if source.views is not None:
        nominal = [
            guessed_T_reference_view(source.views, poses, n, role, REPEAT)
            for n in range(len(poses))
        ]
    frames = {
        "board": "x along the row of holes, y up the face, z out of it to the camera, origin "
        "at its centre",
        "camera": "x right, y down, z along the optical axis; for damages, the first view's camera",
    }
    damages = truth_of(targets[0], targets[0].pose.T_camera_board)
    files: dict[str, dict[str, Any]] = {
        "truth.json": {
            "frames": frames,
            "damages": [damage.to_row() for damage in damages],
            "views": [
                {"name": view.name, "T_board_camera": view.T_board_camera.tolist()}
                for view in views
            ],
        },
        "nominal_poses.json": {POSES_KEY: [pose.tolist() for pose in nominal]},
        "provenance.json": {
            **record(command),
            "experiment": experiment.config.name,
            "seed": experiment.config.seed,
            "hole_free": arguments.hole_free,
            "frames_per_second": views[0].frames_per_second,
            "rounding_step_mm": 1e3 * views[0].source.z_step_m,
            "notes": [
                "The target turns as on a turntable: the poses of all views hold for the target, "
                "not for the room.",
                "Pixels outside the simulated region of each image have no range and are black.",
                "Colour is the surfaces' albedo, evenly lit, on the depth camera's own pixels.",
            ],
        },
    }
    for name, data in files.items():
        write_json(folder / name, {"results_version": RESULTS_VERSION, **data})
    write_text(folder / "experiment.yaml", resolved_yaml(experiment))


if __name__ == "__main__":
    raise SystemExit(main())
