"""A study with a simulated camera, from a validated experiment to its folder of results."""

from __future__ import annotations

import datetime
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from harness.engine.console import progress_display
from harness.engine.costs import learn
from harness.engine.journal import Journal
from harness.engine.options import EngineOptions, engine_of
from harness.engine.plan import SweepPlan, plan_of
from harness.engine.run import render_missing, run_plan
from harness.engine.shard import locked
from harness.engine.tables import origin_of, summaries, tables_of, write_tables
from harness.engine.work import STATES, JobEngine, Outcome
from harness.experiment.load import resolved_yaml
from harness.experiment.points import Experiment
from harness.experiment.schema import SimulatedSource
from harness.listing.latest import point_to
from harness.tables.grid import Grid, show
from harness.tables.outputs import EXPERIMENT, PROVENANCE, REPORT, STUDY
from harness.tables.schema import write_table
from harness.tables.trials import ResultTables
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import RECORD_BYTES, bounded_bytes
from harness.vocabulary.provenance import record
from harness.vocabulary.units import INCH, MM
from harness.vocabulary.versions import RESULTS_VERSION, check_version
from scenes.render.cache import in_use, read_view, trim_cache
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.thesis import DIAMETERS_IN
from scenes.view import NoiseFreeView

MOST_FAILURES = 200
"""Failures that are listed; the journal has all."""
MOST_VIEWS = 64
"""Views whose render noise is measured: evenly taken from all, 4 MB each."""


def run_study(experiment: Experiment, out: Path, options: EngineOptions, command: str) -> int:
    """Run, write tables and report, print the summary; a shard's trials only go into the journal. Returns 0, 1 where
    trials did not end well, 130 after Ctrl-C."""
    began = time.monotonic()
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    origin = record(command)  # now: a commit that is made while the sweep runs is not what it ran
    folder = experiment.folder(out)
    _refuse_newer(folder)
    detectors = {point.config.detector.name for point in experiment.points}
    try:
        plan = plan_of(experiment, _cache(out))
        # The first file written: an unwritable folder shows before any work is done.
        write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
        journal = Journal(folder / "journal")
        with in_use(_cache(out)), locked(folder, options.shard), engine_of(options, detectors) as engine:
            with progress_display() as show:
                outcome = run_plan(plan, journal, engine, show, shard=options.shard, retry_failed=options.retry_failed)
            learn(plan, outcome, journal, out / ".cache", 1 if options.serial else options.jobs)
            if not options.shard.is_whole:
                return _conclude_shard(folder, outcome, options)
            if not outcome.finished or not outcome.thresholds:
                return _nothing_to_report(experiment, outcome)
            print("writing tables and report", file=sys.stderr)
            tables = tables_of(_records(journal, outcome), experiment)
            provenance = _provenance(experiment, plan, outcome, tables, origin, started)
            provenance["seconds"]["this run in all"] = round(time.monotonic() - began, 1)
            write_tables(folder, tables, provenance)
            write_text(folder / PROVENANCE.name, json.dumps(provenance, indent=2) + "\n")
            if experiment.config.study is None:
                _write_report(folder, experiment, outcome, tables, provenance)
                shown = _final_table(tables)
            else:
                shown = _write_study(folder, experiment, plan, outcome, tables, provenance, engine)
        if options.cache_limit_gb is not None:
            trim_cache(_cache(out), round(options.cache_limit_gb * 1e9), keep=[job.path for job in plan.renders])
    except KeyboardInterrupt:
        print(f"\ninterrupted; finished trials are kept. To go on:\n  {command}", file=sys.stderr)
        return 130
    point_to(folder)
    _conclude(folder, shown, outcome)
    return 1 if outcome.failures else 0


def _refuse_newer(folder: Path) -> None:
    """Results of a newer tofpod are not written over. Raises UserError."""
    try:
        version = strict_json(bounded_bytes(folder / PROVENANCE.name, RECORD_BYTES))["results_version"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if type(version) is int and version > RESULTS_VERSION:
        check_version(version, RESULTS_VERSION, folder / PROVENANCE.name, "a result folder")


def _records(journal: Journal, outcome: Outcome) -> Iterator[dict[str, Any]]:
    """Records of all finished trials, in order of their keys; read as they are needed, to save memory."""
    for key in outcome.finished:
        entry = journal.read(key)
        if entry is None or entry.record is None:
            raise UserError(
                f"{journal.folder}: the record {key} is gone or damaged since it was written",
                fix="run the same command again: what is missing is run again",
            )
        yield entry.record


def _write_study(
    folder: Path,
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    tables: ResultTables,
    provenance: dict[str, Any],
    engine: JobEngine,
) -> list[str | Grid]:
    """Write a study's record, tables and report. Returns what a terminal shows of it."""
    from harness.engine.pictures import shown_in, study_example
    from harness.engine.study_record import failed_by_point, record_of
    from harness.evaluation.study.record import record_text
    from harness.evaluation.study.result import evaluate_study
    from harness.report.study_page import study_parts, write_study_report
    from harness.tables.study import study_tables

    failed = failed_by_point(plan, (failure.what for failure in outcome.failures), outcome.thresholds)
    study = record_of(experiment, plan, tables, failed, provenance)
    if not study.set_ups:
        raise UserError(f"no damaged board of {experiment.config.name} was judged: {_reasons(outcome)}")
    write_text(folder / STUDY.name, record_text(study))
    result = evaluate_study(study, tables, experiment.data, diameters_mm=_table_one_mm(experiment))
    shown = list(shown_in(plan, result.limits))
    # of trials that were run on other machines the views may not be here
    lost = render_missing((job for one in shown for job in one.batch.renders), engine)
    outcome.failures += lost
    examples = [study_example(one, outcome.thresholds) for one in shown if not lost]
    title = experiment.config.title or experiment.config.name
    for table, rows in study_tables(result).items():
        write_table(folder, table, table.frame(rows), origin_of(provenance))
    write_study_report(folder, result, examples, provenance, resolved_yaml(experiment), title)
    return study_parts(result)


def _table_one_mm(experiment: Experiment) -> list[float]:
    """The diameters of the thesis' holes, where any set-up's damage is drilled holes."""
    targets = [cast("SimulatedSource", point.config.source).target for point in experiment.points]
    drilled = any(isinstance(target, DrawnTargetConfig) and target.damage.kind != "dent" for target in targets)
    return [size_in * INCH / MM for size_in in DIAMETERS_IN] if drilled else []


def _cache(out: Path) -> Path:
    return out / ".cache" / "renders"


def _nothing_to_report(experiment: Experiment, outcome: Outcome) -> int:
    """Conclude a run without any result: the user's mistake is raised; a bug keeps its traceback (once) and gives 1."""
    name, detector = experiment.config.name, experiment.config.detector.name
    bug = next((failure for failure in outcome.failures if failure.is_bug), None)
    if bug is None:
        first = next((failure for failure in outcome.failures if failure.state != "skipped"), None)
        alike = {failure.in_short for failure in outcome.failures if failure.state != "skipped"}
        why = first.why if first is not None and len(alike) == 1 else _reasons(outcome)
        what = "trial was judged" if outcome.finished else "trial succeeded"
        old = not outcome.trials.done and any(failure.state != "skipped" for failure in outcome.failures)
        again = "once that is mended, run the same command with --retry-failed: it runs these trials again"
        raise UserError(f"no {what} of {name}: {why}", fix=again if old and "to do:" not in why else None)
    print(bug.why, file=sys.stderr)
    count = outcome.trials.failed
    print(f"no trial of {name} succeeded; {count} failed, the first as above (detector {detector!r})", file=sys.stderr)
    return 1


def _reasons(outcome: Outcome) -> str:
    """The causes of failures, without the trials that were skipped because of them."""
    own = {failure.in_short for failure in outcome.failures if failure.state != "skipped"}
    return "; ".join(sorted(own)[:3]) or "nothing was planned"


def _counted(outcome: Outcome) -> str:
    """The number of failures by state, as text; empty where all ended well."""
    return ", ".join(f"{count} {state}" for state, count in _counts(outcome).items())


def _counts(outcome: Outcome) -> dict[str, int]:
    """The number of failures by state."""
    found = {state: sum(failure.state == state for failure in outcome.failures) for state in STATES}
    return {state: count for state, count in found.items() if count}


def _provenance(
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    tables: ResultTables,
    origin: dict[str, Any],
    started: str,
) -> dict[str, Any]:
    """Everything that a reader needs to repeat the numbers or to doubt them."""
    views = _views_of_set_ups(plan)
    noise = _indirect_noise_mm(views)
    runs, renders, trials = tables.runs, outcome.renders, outcome.trials
    return {
        "results_version": RESULTS_VERSION,
        **origin,
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        "seed": experiment.config.seed,
        "mitsuba_variant": views[0].variant if views else None,
        "started": started,
        "seconds": {
            "renders (not cached)": round(renders.seconds, 1),
            "frames (all workers, resumed trials too)": round(float(runs["seconds_frames"].sum()), 1),
            "detection and measurement (likewise)": round(float(runs["seconds_detect"].sum()), 1),
        },
        "renders": {"done": renders.done, "cached": renders.found, "failed": renders.failed},
        "trials": {"done": trials.done, "resumed": trials.found, "failed": trials.failed},
        "peak_mb": outcome.peak_mb,
        "indirect_noise_mm": noise,
        "failures": [
            {"what": one.what, "state": one.state, "why": one.why} for one in outcome.failures[:MOST_FAILURES]
        ],
        "failures_in_all": _counts(outcome),
    }


def _views_of_set_ups(plan: SweepPlan) -> list[NoiseFreeView]:
    """The damaged views of all set-ups, variations left out."""
    set_ups = [group for group in plan.groups if any(not point.is_variation for point in group.points)]
    jobs = [job for group in set_ups or plan.groups[:1] for job in group.damaged.renders]
    views = (read_view(job.path) for job in jobs[:: -(-len(jobs) // MOST_VIEWS)])
    return [view for view in views if view is not None]


def _indirect_noise_mm(views: list[NoiseFreeView]) -> dict[str, float]:
    """Monte Carlo noise of the renders: the median over each surface's pixels, the worst over set-ups."""
    noise: dict[str, float] = {}
    for view in views:
        for index, name in enumerate(view.surface_names):
            here = view.surface == index
            if here.any():
                median_mm = round(float(np.median(view.indirect_noise_m[here])) / MM, 4)
                noise[name] = max(noise.get(name, 0.0), median_mm)
    return noise


def _write_report(
    folder: Path, experiment: Experiment, outcome: Outcome, tables: ResultTables, provenance: dict[str, Any]
) -> None:
    for table, frame in summaries(tables, outcome.examples).items():
        write_table(folder, table, frame, origin_of(provenance))
    from harness.report.page import write_report

    title = experiment.config.title or experiment.config.name
    target = getattr(getattr(experiment.config.source, "target", None), "name", "")
    write_report(folder, tables, outcome.examples, provenance, resolved_yaml(experiment), title, target)


def _conclude(folder: Path, shown: list[str | Grid], outcome: Outcome) -> None:
    """Print the final table, what did not end well, and where to look."""
    show(shown)
    _tell_failures(outcome)
    print(f"report: {folder / REPORT.name}")


def _tell_failures(outcome: Outcome) -> None:
    if outcome.failures:
        print(f"{_counted(outcome)}: {_reasons(outcome)}", file=sys.stderr)
        counts = _counts(outcome)
        if set(counts) - {"skipped"}:
            print("the same command with --retry-failed runs again what failed, crashed or timed out", file=sys.stderr)
        if "skipped" in counts:
            print("the same command runs again what was skipped", file=sys.stderr)


def _conclude_shard(folder: Path, outcome: Outcome, options: EngineOptions) -> int:
    """Print the work of a shard, and the next step."""
    trials = outcome.trials
    print(f"shard {options.shard}: {trials.done} trials done, {trials.found} found, {trials.failed} not ended well")
    _tell_failures(outcome)
    print(f"journal: {folder / 'journal'}")
    print("when all shards have run: python -m harness.merge, then the same command without --shard")
    return 1 if outcome.failures else 0


def _final_table(tables: ResultTables) -> list[str | Grid]:
    """Return the terminal's summary at the end, by the kind of experiment."""
    from harness.evaluation.maps import compare_maps
    from harness.evaluation.set_ups import compare_set_ups, set_ups_of
    from harness.evaluation.summary import summarise_holes
    from harness.report import terminal
    from harness.report.perspectives import Ways
    from harness.report.set_ups import Layout

    summary = summarise_holes(tables.holes, list(tables.axes["path"]))
    if not tables.registrations.empty:
        compared = compare_maps(tables, summary)
        ways = Ways.of(tables, compared)
        return [terminal.maps_grid(compared, ways)]
    if len(set_ups_of(tables)) > 1:
        compared = compare_set_ups(tables, summary, set_ups_of(tables))
        layout = Layout.of(tables, compared)
        return [terminal.set_ups_grid(compared, layout)]
    return [terminal.holes_grid(summary)]
