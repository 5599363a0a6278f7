"""Runs a validated experiment, and writes its folder of results."""

import datetime
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import record_text
from harness.evaluation.study.result import evaluate_study
from harness.experiment.digests import experiment_digests
from harness.experiment.load import resolved_yaml
from harness.experiment.schema import Experiment
from harness.records.examples import ExampleCloud, MappedExample, StudyExample
from harness.records.outputs import EXPERIMENT, PROVENANCE, REPORT, STUDY
from harness.records.trials import ResultTables
from harness.report.blocks import BILL
from harness.report.claims import claim_set_of
from harness.report.page import write_report
from harness.report.sections import final_tables
from harness.report.study_page import study_html, study_parts
from harness.report.summaries import as_files, summaries
from harness.runs.bill import Bill, Metered
from harness.runs.engines import engine_of
from harness.runs.estimate import progress_display
from harness.runs.job_batches import pictures_from, render_missing, values_of
from harness.runs.jobs import STATES, Ended, Job, Outcome
from harness.runs.journal import Journal
from harness.runs.options import EngineOptions
from harness.runs.pictures import (
    examples_as_text,
    examples_of_text,
    pictures_key,
    shown_in,
    study_examples,
)
from harness.runs.plan import SweepPlan
from harness.runs.precision import Batches, refuse_shard
from harness.runs.results_folder import point_to
from harness.runs.run import examples_of, run_plan
from harness.runs.shards import Shard, locked
from harness.runs.study_record import failures_by_point, record_of, without_limit
from harness.runs.tables import tables_of, write_tables
from harness.runs.written import Written, origin_of
from harness.tables.study import study_tables
from harness.vocabulary.code_digests import remembered
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import (
    RECORD_BYTES,
    bounded_bytes,
    strict_json,
    write_json,
    write_text,
)
from harness.vocabulary.path_names import in_words, names_of
from harness.vocabulary.provenance import RESULTS_VERSION, check_version, record
from harness.vocabulary.text import Grid, show
from scenes.render.cache import in_use, read_view, trim_cache
from scenes.sensor.camera import camera_of, guessed_precision

# failures to list; the journal has all of them
MOST_FAILURES = 200
FAILURE = ("what", "state", "why")
STATISTICS = ("harness.evaluation.study.result", "pandas")
"""What processes need to evaluate the set-ups of a study; it takes them 0.35 s to load."""


def run_study(experiment: Experiment, out: Path, options: EngineOptions, command: str) -> int:
    """Run an experiment, write tables and report, print a summary; of a shard only the journal.
    Returns 0, 1, 130."""
    began = time.monotonic()
    bill = Bill()
    bill.begin("plan")
    # recorded now: a commit during the sweep does not change the code that runs
    origin = record(command)
    origin["started"] = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    folder = experiment.folder(out)
    cache = out / ".cache" / "renders"
    _refuse_newer(folder)
    refuse_shard(experiment, options.shard)
    detectors = {point.config.detector.name for point in experiment.points}
    try:
        journal = Journal(folder / "journal")
        # absolute paths: other processes may have started in another folder
        batches = Batches(experiment, journal, cache.absolute(), folder.absolute())
        plan = batches.first()
        # the first file written shows whether the folder is writable, before any work
        write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
        with remembered(out / ".cache" / "sources.json"):
            origin["digests"] = experiment_digests(experiment)
        renders = any(not render.path.exists() for render in plan.renders)
        further = () if experiment.config.study is None else STATISTICS
        plain_engine = engine_of(options, detectors, cache, renders=renders, further=further)
        with (
            in_use(cache),
            locked(folder, options.shard),
            Metered(plain_engine, bill) as engine,
        ):
            bill.begin("detection")
            plan, outcome = _carried_out(plan, batches, engine, options)
            if not options.shard.is_whole:
                return _shard_over(options.shard, outcome, folder)
            if not outcome.finished or not outcome.thresholds:
                return _nothing_to_report(experiment, outcome)
            bill.begin("tables and page")
            shown = _results(
                folder,
                experiment=experiment,
                plan=plan,
                outcome=outcome,
                journal=journal,
                engine=engine,
                origin=origin,
                began=began,
            )
        if options.cache_limit_gb is not None:
            limit_bytes = round(options.cache_limit_gb * 1e9)
            trim_cache(cache, limit_bytes, keep=[render.path for render in plan.renders])
    except KeyboardInterrupt:
        text = f"\ninterrupted; finished trials are kept. To continue:\n  {command}"
        print(text, file=sys.stderr)
        return 130
    point_to(folder)
    show(shown)
    _print_failures(outcome)
    print(bill.in_words(), file=sys.stderr)
    print(f"report: {folder / REPORT.name}")
    return 1 if outcome.failures else 0


def _carried_out(
    plan: SweepPlan, batches: Batches, engine: Metered, options: EngineOptions
) -> tuple[SweepPlan, Outcome]:
    """Run the first plan of an experiment, and those that follow from it. Return the last, which
    holds the trials of all, and its outcome."""
    with progress_display() as report:
        run = partial(
            run_plan,
            journal=batches.journal,
            engine=engine,
            report=report,
            shard=options.shard,
            retry_failed=options.retry_failed,
        )
        outcome = run(plan)
        while following := batches.after(plan, outcome, engine):
            plan = following
            outcome = run(plan).counted_after(outcome)
    return plan, outcome


def _shard_over(shard: Shard, outcome: Outcome, folder: Path) -> int:
    """Say how a shard ended. Returns the program's exit code."""
    trials = outcome.trials
    counts = f"{trials.done} trials done, {trials.found} found, {trials.failed} failed"
    print(f"shard {shard}: {counts}")
    _print_failures(outcome)
    print(f"journal: {folder / 'journal'}")
    print("when all shards have run: tofpod merge, then the same command without --shard")
    return 1 if outcome.failures else 0


def _refuse_newer(folder: Path) -> None:
    """Refuse to overwrite the results of a newer tofpod. Raises UserError."""
    try:
        version = strict_json(bounded_bytes(folder / PROVENANCE.name, RECORD_BYTES))[
            "results_version"
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if type(version) is int and version > RESULTS_VERSION:
        check_version(version, RESULTS_VERSION, folder / PROVENANCE.name, "a result folder")


def _results(
    folder: Path,
    *,
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    journal: Journal,
    engine: Metered,
    origin: dict[str, Any],
    began: float,
) -> list[str | Grid]:
    """Return what the terminal shows of the results. They are written unless the folder has them
    as they would be written."""
    results = origin_of(outcome, resolved_yaml(experiment), origin["digests"])
    written = Written(folder, results)
    shown = written.shown_again(outcome)
    if shown is not None:
        return shown
    print("writing tables and report", file=sys.stderr)
    shown = _write_results(
        folder,
        experiment=experiment,
        plan=plan,
        outcome=outcome,
        journal=journal,
        engine=engine,
        origin=origin,
        began=began,
    )
    if not outcome.failures:  # what failed may succeed the next time
        written.store(shown)
    return shown


def _write_results(
    folder: Path,
    *,
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    journal: Journal,
    engine: Metered,
    origin: dict[str, Any],
    began: float,
) -> list[str | Grid]:
    """Write tables, report and provenance of a run that ``began`` then. Return what the terminal
    shows."""
    tables = tables_of(journal.records(outcome.finished), experiment)
    provenance = _provenance(experiment, plan, outcome, tables, origin)
    provenance["seconds"]["this run in all"] = round(time.monotonic() - began, 1)
    write_tables(folder, tables.stored(), provenance)
    engine.bill.divide_trials(_frames_share(tables))
    # a page calls it when its figures are drawn
    provenance[BILL] = engine.bill.rounded
    if experiment.config.study is None:
        examples = examples_of(plan, outcome, engine)
        answer = _write_report(folder, experiment, examples, tables, provenance)
    else:
        answer = _write_study(
            folder,
            experiment=experiment,
            plan=plan,
            outcome=outcome,
            tables=tables,
            provenance=provenance,
            journal=journal,
            engine=engine,
        )
    provenance[BILL] = engine.bill.rounded()
    write_json(folder / PROVENANCE.name, provenance)
    return [*(f"warning: {text}" for text in provenance["warnings"]), *answer]


def _write_study(
    folder: Path,
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    tables: ResultTables,
    provenance: dict[str, Any],
    journal: Journal,
    engine: Metered,
) -> list[str | Grid]:
    """Write a study's record, tables and report. Return what the terminal shows."""
    failed = failures_by_point(plan, outcome.failures, outcome.thresholds)
    study = record_of(experiment, plan, tables, failed, provenance)
    if not study.set_ups:
        name = experiment.config.name
        raise UserError(f"no damaged board of {name} was judged: {_reasons(outcome)}")
    provenance["warnings"] += without_limit(experiment.points, outcome, failed, study.set_ups)
    write_text(folder / STUDY.name, record_text(study))
    engine.bill.begin("statistics")
    result = evaluate_study(
        study, tables, experiment.data, each_of=partial(values_of, engine=engine)
    )
    engine.bill.begin("tables and page")
    examples = _examples(plan, result.limits, outcome, journal, engine)
    frames = {table: table.frame(rows) for table, rows in study_tables(result).items()}
    write_tables(folder, frames, provenance)
    page = study_html(result, examples, provenance, resolved_yaml(experiment), title_of(experiment))
    write_text(folder / REPORT.name, page)
    return study_parts(result)


def _examples(
    plan: SweepPlan,
    limits: Sequence[SetUpLimit],
    outcome: Outcome,
    journal: Journal,
    engine: Metered,
) -> Iterator[StudyExample]:
    """Return an iterator over the damages to show. Those that the journal lacks are drawn again by
    other processes, while this process draws the figures, and stored: drawing them would be a
    quarter of what a run costs that has nothing else to do."""
    shown = {}
    for damages in shown_in(plan, limits):
        shown[pictures_key(damages, outcome.thresholds)] = damages
    unknown = [damages for key, damages in shown.items() if journal.state(key) != "done"]
    # trials that ran on other machines may have no views here
    views = [job for damages in unknown for damage in damages for job in damage.batch.renders]
    lost = render_missing(views, engine)
    outcome.failures += lost
    jobs = []
    if not lost:
        for number, damages in enumerate(unknown):
            arguments = (damages, outcome.thresholds)
            jobs.append(Job(f"pictures of set-up {number}", "trials", study_examples, arguments))
    drawn = pictures_from(jobs, engine, outcome)

    def examples() -> Iterator[StudyExample]:
        by_set_up: dict[tuple[str, int], list[StudyExample]] = {}
        for example in drawn:
            by_set_up.setdefault((example.variant, example.frames), []).append(example)
        for key, damages in shown.items():
            record = damages[0].limit.record
            own = by_set_up.get((record.variant, record.frames), [])
            entry = journal.read(key)
            if own:
                journal.write(key, Ended("done", examples_as_text(own)))
            elif entry is not None:
                own = examples_of_text(entry.value)
            yield from own

    return examples()


def title_of(experiment: Experiment) -> str:
    """Return the title of an experiment's page: its own title, and the axes."""
    title = experiment.config.title or in_words(experiment.config.name)
    axes = list(names_of(experiment.data.get("sweep") or {}).values())
    if not axes:
        return title
    *first_axes, last_axis = axes
    listed = [", ".join(first_axes), last_axis] if first_axes else [last_axis]
    return f"{title}, by {' and '.join(listed)}"


def _write_report(
    folder: Path,
    experiment: Experiment,
    examples: Sequence[ExampleCloud | MappedExample],
    tables: ResultTables,
    provenance: dict[str, Any],
) -> list[str | Grid]:
    """Write the summaries and the report of an experiment that is not a study. Return what the
    terminal shows."""
    facts = experiment.data
    summary_tables = summaries(tables, examples, claim_set_of(facts))
    write_tables(folder, as_files(summary_tables), provenance)
    write_report(
        folder,
        tables,
        examples,
        provenance,
        resolved_yaml(experiment),
        title_of(experiment),
        facts,
        computed=summary_tables,
    )
    return final_tables(tables, summary_tables)


def _nothing_to_report(experiment: Experiment, outcome: Outcome) -> int:
    """End a run without results: raise the user's mistake, or print a bug's traceback once and
    return 1."""
    name = experiment.config.name
    for failure in outcome.failures:
        if failure.is_bug:
            counts = f"{outcome.trials.failed} failed, the first as above"
            detector = experiment.config.detector.name
            summary = f"no trial of {name} succeeded; {counts} (detector {detector!r})"
            print(f"{failure.why}\n{summary}", file=sys.stderr)
            return 1
    failures = [failure for failure in outcome.failures if failure.state != "skipped"]
    different_reasons = {failure.in_short for failure in failures}
    why = failures[0].why if len(different_reasons) == 1 else _reasons(outcome)
    what_lacks = "trial was judged" if outcome.finished else "trial succeeded"
    fix = None
    if failures and not outcome.trials.done and "to do:" not in why:
        fix = (
            "once the cause is corrected, run the same command with --retry-failed: "
            "it runs these trials again"
        )
    raise UserError(f"no {what_lacks} of {name}: {why}", fix=fix)


def _reasons(outcome: Outcome) -> str:
    """Return the causes of failures, without trials that were skipped because of them."""
    reasons = {failure.in_short for failure in outcome.failures if failure.state != "skipped"}
    return "; ".join(sorted(reasons)[:3]) or "nothing was planned"


def _counts(outcome: Outcome) -> dict[str, int]:
    """Return the number of failures by state."""
    counts = Counter(failure.state for failure in outcome.failures)
    return {state: counts[state] for state in STATES if counts[state]}


def _print_failures(outcome: Outcome) -> None:
    counts = _counts(outcome)
    if not counts:
        return
    totals = ", ".join(f"{count} {state}" for state, count in counts.items())
    if set(counts) == {"skipped"}:
        again = "the same command runs what was skipped"
    else:
        again = "the same command, with --retry-failed, runs them again"
    print(f"{totals}: {_reasons(outcome)}\n{again}", file=sys.stderr)


def _frames_share(tables: ResultTables) -> float:
    """Return the frames' share of the time of trials."""
    frames_s = float(tables.runs["seconds_frames"].sum())
    detect_s = float(tables.runs["seconds_detect"].sum())
    return frames_s / max(frames_s + detect_s, 1e-9)


def _provenance(
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    tables: ResultTables,
    origin: dict[str, Any],
) -> dict[str, Any]:
    """Return everything that a reader needs to reproduce or question the results."""
    views = (read_view(render.path) for render in plan.renders)
    variant = next((view.variant for view in views if view is not None), None)
    cameras = {}
    for point in experiment.points:
        camera = point.config.simulated.camera
        cameras[camera.name] = camera
    guesses = [guessed_precision(camera_of(camera)) for camera in cameras.values()]
    seconds_frames = round(float(tables.runs["seconds_frames"].sum()), 1)
    seconds_detect = round(float(tables.runs["seconds_detect"].sum()), 1)
    renders = outcome.renders
    trials = outcome.trials
    return {
        "results_version": RESULTS_VERSION,
        **origin,
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        "seed": experiment.config.seed,
        "mitsuba_variant": variant,
        "seconds": {
            "renders (not cached)": round(renders.seconds, 1),
            "frames (all workers, resumed trials too)": seconds_frames,
            "detection and measurement (likewise)": seconds_detect,
        },
        "renders": {"done": renders.done, "cached": renders.found, "failed": renders.failed},
        "trials": {"done": trials.done, "resumed": trials.found, "failed": trials.failed},
        "peak_mb": outcome.peak_mb,
        "warnings": [text for text in guesses if text],
        "failures": [
            {name: getattr(failure, name) for name in FAILURE}
            for failure in outcome.failures[:MOST_FAILURES]
        ],
        "failures_in_all": _counts(outcome),
    }
