"""``python -m harness.sweep experiments/averaging.yaml``: runs an experiment and writes its
report."""

import argparse
from pathlib import Path

from harness.runs.options import (
    add_engine_options,
    add_overrides,
    add_results_folder,
    engine_options,
)
from harness.vocabulary.program import loading, program


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        type=Path,
        help="a YAML file, or the name of one that comes with tofpod, such as averaging",
    )
    add_overrides(parser, "repeats=5 or source.target.distance_m=90cm")
    help = (
        "a recording (.mkv) whose own lens replaces the camera's nominal one, so that your unit "
        "is simulated"
    )
    add("--calibration", type=Path, metavar="FILE", help=help)
    help = (
        "a first look: at most 5 repeats, a third of a study's boards, few values of long axes, "
        "no sensitivity; wider intervals"
    )
    add("--quick", action="store_true", help=help)
    add_results_folder(parser)
    add("--dry-run", action="store_true", help="validate and print what would be run; run nothing")
    add_engine_options(parser)


@program(
    _options,
    (
        "Run an experiment: render its targets, simulate the camera, detect and measure damage, "
        "and write a report."
    ),
    "tofpod sweep averaging --quick",
    "tofpod sweep detection_limit --set source.target.distance_m=90cm --jobs 8",
    epilog="Finished trials are kept: the same command resumes after Ctrl-C or a fault.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if trials failed, 2 for a user's mistake, 130 after Ctrl-C."""
    run_options = engine_options(options)
    with loading():
        from harness.experiment.load import load_experiment
        from harness.experiment.schema import CaptureSource

        if not options.dry_run:
            from harness.runs.study import run_study

    experiment = load_experiment(
        options.experiment, options.overrides, options.calibration, quick=options.quick
    )
    if isinstance(experiment.config.source, CaptureSource) and not options.dry_run:
        from harness.runs.captures import judge_captures

        return judge_captures(experiment, options.out, command)
    if options.dry_run:
        from harness.runs.estimate import dry_run

        return dry_run(experiment, options.out, run_options)
    return run_study(experiment, options.out, run_options, command)


if __name__ == "__main__":
    raise SystemExit(main())
