"""``tofpod check experiments/regression.yaml``: a gate that fails if a detection limit has become
worse.

The study is run and compared with a committed baseline by `harness.programs.gate.verdict`. A
set-up fails if its a90 or its rate of false calls has grown, or its signals relative to the
threshold have fallen, by more than 10 % and the tests show that this is not by chance (at 0.1 %
for the whole check). It also fails if its limit is lost, if more trials failed, or if it is
missing. With the same seed and code nothing fails.

By hits and signals alone, of 40 checks each, all fail with 1.4 times the camera's noise, 39 with
1.2 times the threshold, and 13 if a90 grows by 20 % at the same a50; with only another draw of
all noise, 2 of 746 fail (95 %: 0.03 to 0.97 %), both by a90. With a90 from signals, half of the
damaged boards (12) do as well: 10 of 10 fail with 1.2 times the noise, 20 of 20 with 1.2 times
the threshold, 8 of 20 if a90 grows by 20 % (none without it; 20 of 20 with 24 boards), and none
of 100 with another draw of all noise, in which 4.4 % of its p-values lie below 5 % and none below
1 % (`tests/validation/gate_power.py`, boards as in regression.yaml).

Nor do 12 boards replace 24 with damages where they tell most. Sizes from half of the range, about
a50 and a90: 4 of 12 fail if a90 grows by 20 %. Twenty damages a board, from two thirds of the
range: 11 of 12, but only 6 of 12 if it grows by 120 % (10 of 10 with 24 boards), since Student's t
over 12 boards must reach 6.3 where that over 24 must reach 4.9, and the test of hits has no p-value
below 2^-12. With half of the hole-free boards and of those of the threshold as well, 4 of 10 fail
with 1.2 times the noise and 3 of 10 with 1.2 times the threshold, whose own error hides it.

The limit of through-holes (a diameter) hardly depends on noise and threshold; that of blind holes
(a depth) is proportional to them. If both thresholds were calibrated again, a90 must grow by two
more standard errors (`verdict.limit_margin`)."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from harness.runs.options import (
    add_engine_options,
    add_overrides,
    add_results_folder,
    engine_options,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import shipped, write_text
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from harness.evaluation.study.record import StudyRecord
    from harness.experiment.schema import Experiment

BASELINES = shipped("baselines")
"""Folder of the committed baselines, one ``<name of the experiment>.json`` each."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "experiment",
        type=Path,
        help="a YAML file with a `study`, such as experiments/regression.yaml",
    )
    add_overrides(parser, "seed=7 for another draw of the noise")
    add(
        "--baseline",
        type=Path,
        metavar="FILE",
        help="default: results/baselines/<name of the experiment>.json",
    )
    add("--update", action="store_true", help="write a new baseline, and print what changes")
    add_results_folder(parser)
    add_engine_options(parser)


@program(
    _options,
    "Run a study of detection limits and compare it with its baseline. The check fails "
    "(exit code 1) if a "
    "limit or the rate of false calls has grown by more than 10 % and a paired test shows "
    "that this is not by "
    "chance, if a set-up no longer has a limit, or if more trials fail.",
    "tofpod check experiments/regression.yaml",
    "tofpod check experiments/regression.yaml --update",
    epilog="Finished trials are kept: the same command resumes after Ctrl-C or a fault.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if a set-up is worse or missing, 2 for a user's mistake, 130
    after Ctrl-C."""
    from harness.evaluation.study.record import read_record, record_text
    from harness.experiment.load import load_experiment
    from harness.programs.gate.compare import FILES, write_comparison
    from harness.programs.gate.page import compare_parts
    from harness.programs.gate.verdict import ALPHA, compare_studies, fewest_boards
    from harness.runs.study import run_study
    from harness.vocabulary.text import many, show

    experiment = load_experiment(options.experiment, options.overrides)
    study = experiment.config.study
    set_ups = len(experiment.points)
    if study is None:
        raise UserError(
            f"{options.experiment}: has no `study`", fix="name an experiment with a study of limits"
        )
    if study.precision is not None:
        raise UserError(
            f"{options.experiment}: a check compares the same boards, but those of a study with a "
            "precision follow from its results",
            fix="add --set study.precision=null",
        )
    needed = fewest_boards(set_ups)
    if study.boards < needed:
        # no loss could ever be significant, so the gate would pass everything
        message = (
            f"with {study.boards} boards no loss is significant at {100 * ALPHA:g} %: the check "
            "cannot fail"
        )
        fix = "raise study.boards: 24 are needed to detect a threshold that is 1.2 times as high"
        raise UserError(
            message, legal=f"at least {needed} boards for {many(set_ups, 'set-up')}", fix=fix
        )
    engine = engine_options(options)
    if not engine.shard.is_whole:
        raise UserError(
            "--shard: a check needs the whole study",
            fix="run tofpod sweep in shards, merge, then check",
        )
    path = options.baseline or BASELINES / f"{experiment.config.name}.json"
    # before anything runs, because a study takes minutes
    baseline = _baseline(path, update=options.update)
    if baseline is not None:
        _state_age(baseline, experiment, path)
    code = run_study(experiment, options.out, engine, command)
    if code not in (0, 1):
        return code
    folder = experiment.folder(options.out)
    record = read_record(folder)
    comparison = None if baseline is None else compare_studies(baseline, record)
    if comparison is not None:
        print()
        show(compare_parts(comparison))
        write_comparison(comparison, folder, command)
        print(f"comparison with the baseline: {folder / FILES[1]}")
    if options.update or comparison is None:
        if code == 1:
            raise UserError(
                f"{path}: is unchanged, because trials failed",
                fix="correct the cause of the failures",
            )
        write_text(path, record_text(record))
        print(f"wrote {path}")
        return 0
    missing = [row.label for row in comparison.marked("only in first")]
    if missing:
        print(f"missing, although in the baseline: {'; '.join(missing)}", file=sys.stderr)
    if missing or any(row.is_worse for row in comparison.rows):
        print(
            "the check fails; if this is intended, run it with --update and commit the baseline",
            file=sys.stderr,
        )
        return 1
    if not_compared := comparison.marked("not comparable"):
        message = "; ".join(f"{row.label}: {row.why}" for row in not_compared)
        fix = "run the check again with --update and commit the baseline"
        raise UserError(f"{path}: cannot serve as a baseline: {message}", fix=fix)
    return 0


def _state_age(baseline: StudyRecord, experiment: Experiment, path: Path) -> None:
    """Print what has changed since the baseline was written, if anything has."""
    from harness.experiment.digests import experiment_digests
    from harness.vocabulary.code_digests import changed_parts
    from harness.vocabulary.provenance import made_by

    stored = baseline.provenance.get("digests")
    changed = "it does not state its code"
    if isinstance(stored, Mapping):
        parts = changed_parts(stored, experiment_digests(experiment))
        changed = f"since then changed: {', '.join(parts)}" if parts else ""
    if changed:
        print(f"{path} is older than the code ({made_by(baseline.provenance)}): {changed}")


def _baseline(path: Path, *, update: bool) -> StudyRecord | None:
    """Read the baseline. Return None if there is none and this run is an ``update``."""
    from harness.evaluation.study.record import read_record

    if path.is_dir():
        raise UserError(
            f"{path}: is a folder",
            fix="name the baseline's file with --baseline, such as regression.json",
        )
    if not path.exists() and not update:
        raise UserError(
            f"{path}: there is no such baseline", fix="write one with --update, and commit it"
        )
    try:
        return read_record(path) if path.exists() else None
    except UserError as mistake:
        if not update:
            raise UserError(
                mistake.message, legal=mistake.legal, fix="write a new one with --update"
            ) from mistake
        print(f"no comparison with the old baseline, which will be overwritten. {mistake.message}")
        return None


if __name__ == "__main__":
    raise SystemExit(main())
