"""``tofpod efficiency RESULTS``: compares every detector of a study with the ideal observer."""

import argparse
from dataclasses import replace
from pathlib import Path

from harness.records.outputs import EFFICIENCY_PAGE, EXPERIMENT, STUDY, run_at
from harness.runs.engines import engine_of
from harness.runs.options import add_engine_options, engine_options
from harness.runs.shards import locked
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program


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
    from harness.experiment.load import load_experiment
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
    if not (folder / EXPERIMENT.name).is_file():
        fix = f"name the folder in which the sweep left {EXPERIMENT.name} and {STUDY.name}"
        raise UserError(f"{folder}: has no {EXPERIMENT.name}, which says what to simulate", fix=fix)
    experiment = load_experiment(folder / EXPERIMENT.name)
    rate = study.false_calls_per_m2
    if any(
        point.config.mapping is not None or point.config.simulated.views
        for point in experiment.points
    ):
        fix = "name a study of single views"
        raise UserError(
            f"{study.name}: is a study of maps, for which there is no ideal observer", fix=fix
        )
    if rate is None:
        fix = "run the study with threshold.calibrate"
        raise UserError(
            f"{study.name}: its threshold was given, so there is no wanted rate of false calls",
            fix=fix,
        )
    cache = folder.parents[1] / ".cache" / "renders"
    stated = experiment.at_stated_values()
    plan = plan_of(stated, cache, designs=recorded_designs(stated, study))
    detectors = {point.config.detector.name for point in experiment.points}
    with in_use(cache), locked(folder), engine_of(run_options, detectors) as engine:
        ideal = ideal_of_set_ups(plan, engine, rate)
        if unknown := [
            set_up.label for set_up in study.set_ups if (set_up.variant, set_up.frames) not in ideal
        ]:
            message = f"{folder}: {EXPERIMENT.name} lacks the set-up {unknown[0]} of {STUDY.name}"
            raise UserError(message, fix="name an unchanged results folder, or run the study again")
        rows = [
            efficiency_of(limit_of(set_up), ideal[set_up.variant, set_up.frames])
            for set_up in study.set_ups
        ]
        cameras = [point.config.simulated.camera for point in experiment.points]
        warnings = warnings_of(rows)
        names = ", ".join(dict.fromkeys(camera.name for camera in cameras))
        seeds = ", ".join(dict.fromkeys(str(camera.unit_seed) for camera in cameras))
        first = (
            f"The ideal observer judges a new unit of {names} by the noise of "
            f"{rows[0].ideal.units} units, at "
            f"{rate:g} false call{'' if rate == 1 else 's'} per m², with known size and "
            "depth; the detectors' hits are "
            f"on unit {seeds}. Not modelled: missing returns, non-Gaussian tails, noise "
            "that differs within damage."
        )
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
        }
        provenance |= {"digest": study.digest, "seed": experiment.config.seed}
        tables = {EFFICIENCY: EFFICIENCY.frame(rows), DAMAGES: DAMAGES.frame(damage_rows(rows))}
        write_tables(folder, tables, provenance)
        write_text(
            folder / EFFICIENCY_PAGE.name,
            efficiency_html(rows, first, warnings, study.name, command),
        )
    show(efficiency_parts(rows, first, warnings))
    print(f"page: {folder / EFFICIENCY_PAGE.name}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
