"""``tofpod efficiency RESULTS``: compares every detector of a study with the ideal observer."""

from __future__ import annotations

import argparse
from collections.abc import Container, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from harness.records.outputs import EFFICIENCY_PAGE, EXPERIMENT, STUDY, run_at
from harness.runs.engines import engine_of
from harness.runs.options import add_engine_options, engine_options
from harness.runs.shards import locked
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from harness.evaluation.study.record import StudyRecord
    from harness.experiment.schema import Experiment
    from harness.programs.efficiency.statistics import Efficiency


def _options(parser: argparse.ArgumentParser) -> None:
    help = "a result folder of a sweep with a `study`, such as results/detection_limit/latest"
    parser.add_argument("results", type=Path, metavar="RESULTS", help=help)
    add_engine_options(parser)


@program(
    _options,
    "Compare the detectors of a simulated study with the ideal observer, which knows each "
    "damage's exact signature "
    "and the covariance of the noise over units of the camera, but not the place of the "
    "damage. State its a50 and a90 "
    "at the study's rate of false calls, and every detector's efficiency. Write "
    f"{EFFICIENCY_PAGE.name} and tables to "
    "the study's folder.",
    "tofpod efficiency results/detection_limit/latest",
    "tofpod efficiency results/frames/latest --jobs 8",
    epilog=(
        "The program takes some seconds per damaged board. Views without a stored render are "
        "rendered again."
    ),
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.evaluation.study.limit import limit_of
    from harness.evaluation.study.record import read_record
    from harness.programs.efficiency.ideal_trials import ideal_of_set_ups
    from harness.programs.efficiency.page import efficiency_html, efficiency_parts
    from harness.programs.efficiency.statistics import efficiency_of, warnings_of
    from harness.programs.efficiency.tables import DAMAGES, EFFICIENCY, damage_rows
    from harness.runs.plan import plan_of
    from harness.runs.precision import recorded_designs
    from harness.runs.tables import write_tables
    from harness.vocabulary.files import write_text
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from harness.vocabulary.text import show
    from scenes.render.cache import in_use

    run_options = engine_options(options)
    if not run_options.shard.is_whole:
        raise UserError("--shard: efficiency needs the whole study", fix="leave it out")
    folder = run_at(options.results).resolve()
    recorded = read_record(folder)
    at_stated_values = tuple(set_up for set_up in recorded.set_ups if not set_up.drawn)
    study = replace(recorded, set_ups=at_stated_values)
    experiment = _experiment_of(folder)
    rate = _wanted_rate(study, experiment)
    cache = folder.parents[1] / ".cache" / "renders"
    stated = experiment.at_stated_values()
    plan = plan_of(stated, cache, designs=recorded_designs(stated, study))
    detectors = {point.config.detector.name for point in experiment.points}
    with in_use(cache), locked(folder), engine_of(run_options, detectors) as engine:
        ideal = ideal_of_set_ups(plan, engine, rate)
        _refuse_unknown(study, ideal, folder)
        rows = [
            efficiency_of(limit_of(set_up), ideal[set_up.variant, set_up.frames])
            for set_up in study.set_ups
        ]
        first = _first_sentences(experiment, rows, rate)
        warnings = warnings_of(rows)
        if study.digest != experiment.digest:
            changed = (
                "the hits come from another version of the camera or of a detector than the "
                "installed version"
            )
            warnings.insert(0, f"{changed}: run the study again")
        provenance = {
            **record(command),
            "results_version": RESULTS_VERSION,
            "experiment": study.name,
            "digest": study.digest,
            "seed": experiment.config.seed,
        }
        tables = {EFFICIENCY: EFFICIENCY.frame(rows), DAMAGES: DAMAGES.frame(damage_rows(rows))}
        write_tables(folder, tables, provenance)
        page = efficiency_html(rows, first, warnings, study.name, command)
        write_text(folder / EFFICIENCY_PAGE.name, page)
    show(efficiency_parts(rows, first, warnings))
    print(f"page: {folder / EFFICIENCY_PAGE.name}")
    return 0


def _experiment_of(folder: Path) -> Experiment:
    """Read the experiment that a sweep left in its folder. Raises UserError if there is none."""
    from harness.experiment.load import load_experiment

    if not (folder / EXPERIMENT.name).is_file():
        fix = f"name the folder in which the sweep left {EXPERIMENT.name} and {STUDY.name}"
        raise UserError(f"{folder}: has no {EXPERIMENT.name}, which says what to simulate", fix=fix)
    return load_experiment(folder / EXPERIMENT.name)


def _wanted_rate(study: StudyRecord, experiment: Experiment) -> float:
    """Return the wanted false calls per square metre. Raises UserError if the study has none, or
    is one of maps."""
    for point in experiment.points:
        if point.config.mapping is not None or point.config.simulated.views:
            raise UserError(
                f"{study.name}: is a study of maps, for which there is no ideal observer",
                fix="name a study of single views",
            )
    if study.false_calls_per_m2 is None:
        raise UserError(
            f"{study.name}: its threshold was given, so there is no wanted rate of false calls",
            fix="run the study with threshold.calibrate",
        )
    return study.false_calls_per_m2


def _refuse_unknown(study: StudyRecord, ideal: Container[tuple[str, int]], folder: Path) -> None:
    """Raise UserError if the study has a set-up that its experiment lacks."""
    for set_up in study.set_ups:
        if (set_up.variant, set_up.frames) not in ideal:
            raise UserError(
                f"{folder}: {EXPERIMENT.name} lacks the set-up {set_up.label} of {STUDY.name}",
                fix="name an unchanged results folder, or run the study again",
            )


def _first_sentences(experiment: Experiment, rows: Sequence[Efficiency], rate: float) -> str:
    """Say what was compared with what."""
    cameras = [point.config.simulated.camera for point in experiment.points]
    names = ", ".join(dict.fromkeys(camera.name for camera in cameras))
    seeds = ", ".join(dict.fromkeys(str(camera.unit_seed) for camera in cameras))
    calls = f"{rate:g} false call{'' if rate == 1 else 's'} per m²"
    return (
        f"The ideal observer judges a new unit of {names} by the noise of {rows[0].ideal.units} "
        f"units, at {calls}, with known size and depth; the detectors' hits are on unit {seeds}. "
        "Not modelled: missing returns, non-Gaussian tails, noise that differs within damage."
    )


if __name__ == "__main__":
    raise SystemExit(main())
