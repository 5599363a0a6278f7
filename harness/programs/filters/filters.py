"""``tofpod filters``: states what filters do to the smallest damage that is found."""

from __future__ import annotations

import argparse
from pathlib import Path

from harness.records.outputs import FILTERS_PAGE
from harness.runs.options import (
    add_engine_options,
    add_overrides,
    add_results_folder,
    engine_options,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program

EXPERIMENT = "filters"
"""The experiment that comes with tofpod."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        nargs="?",
        type=Path,
        default=Path(EXPERIMENT),
        help="a study with the axis capture.filter: a YAML file, or the name of one that comes "
        f"with tofpod (default: {EXPERIMENT})",
    )
    add(
        "--filter",
        dest="filters",
        metavar="NAME",
        action="append",
        default=[],
        help="a filter in place of the study's, such as median or one of your own package, or as "
        "YAML with settings: '{name: median, settings: {kernel_size: 3}}'; may be repeated",
    )
    add_overrides(parser, "detector.name=matched")
    add("--quick", action="store_true", help="a first look: a third of the boards")
    add_results_folder(parser)
    add_engine_options(parser)


@program(
    _options,
    "State what filters from depth to depth cost or gain: a90 and its change against no filter, "
    "false calls with the threshold of no filter, and the bias of diameters and depths. All "
    "filters act on the same frames of the same boards, and each has a threshold with equal "
    f"false calls. Write {FILTERS_PAGE.name} and tables to the study's folder.",
    "tofpod filters --quick",
    "tofpod filters --filter median --quick",
    epilog="Finished trials are kept.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if trials failed, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.experiment.load import load_experiment
    from harness.programs.filters.judging import filter_axis, judged_filters, refuse_other_studies
    from harness.runs.study import run_study

    run_options = engine_options(options)
    if not run_options.shard.is_whole:
        fix = "run tofpod sweep with --shard, merge, and then this command"
        raise UserError("--shard: filters need the whole study", fix=fix)
    overrides = list(options.overrides)
    if options.filters:
        overrides.append(filter_axis(options.filters))
    experiment = load_experiment(options.experiment, overrides, quick=options.quick)
    refuse_other_studies(experiment)
    code = run_study(experiment, options.out, run_options, command)
    if code == 0:
        judged_filters(experiment.folder(options.out), command)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
