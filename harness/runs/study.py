"""Runs a validated experiment, and writes its folder of results."""

import datetime
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from harness.evaluation.study.record import (
    Calibrated,
    Inspected,
    SetUpRecord,
    StudyRecord,
    Unflawed,
    record_text,
)
from harness.evaluation.study.result import evaluate_study
from harness.experiment.load import resolved_yaml
from harness.experiment.schema import Experiment, Point, detector_version
from harness.records.outputs import EXPERIMENT, PROVENANCE, REPORT, STUDY
from harness.records.trials import ResultTables
from harness.report.claims import claim_set_of
from harness.report.page import write_report
from harness.report.sections import final_tables
from harness.report.study_page import study_html, study_parts
from harness.report.summaries import as_files, summaries
from harness.runs.engines import engine_of
from harness.runs.estimate import progress_display
from harness.runs.jobs import STATES, Failure, Job, JobEngine, Outcome
from harness.runs.journal import Journal
from harness.runs.options import EngineOptions
from harness.runs.pictures import shown_in, study_examples
from harness.runs.plan import PACKAGES, Group, SweepPlan, plan_of
from harness.runs.results_folder import point_to
from harness.runs.run import pictures_from, render_missing, run_plan, values_of
from harness.runs.shards import locked
from harness.runs.tables import tables_of, write_tables
from harness.tables.study import study_tables
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import (
    RECORD_BYTES,
    bounded_bytes,
    strict_json,
    write_json,
    write_text,
)
from harness.vocabulary.path_names import in_words, names_of
from harness.vocabulary.provenance import RESULTS_VERSION, check_version, record, source_digest
from harness.vocabulary.seeds import digest
from harness.vocabulary.text import Grid, show
from scenes.render.cache import in_use, read_view, trim_cache
from scenes.sensor.camera import camera_of, guessed_precision

# failures to list; the journal has all of them
MOST_FAILURES = 200
FAILURE = ("what", "state", "why")


def run_study(experiment: Experiment, out: Path, options: EngineOptions, command: str) -> int:
    """Run an experiment, write tables and report, print a summary; of a shard only the journal.
    Returns 0, 1, 130."""
    began = time.monotonic()
    origin = record(
        command
    )  # recorded now: a commit during the sweep does not change the code that runs
    origin["started"] = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    folder = experiment.folder(out)
    cache = out / ".cache" / "renders"
    _refuse_newer(folder)
    detectors = {point.config.detector.name for point in experiment.points}
    try:
        # other processes may have started in another folder
        plan = plan_of(experiment, cache.absolute(), folder.absolute())
        # the first file written shows whether the folder is writable, before any work
        write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
        journal = Journal(folder / "journal")
        with (
            in_use(cache),
            locked(folder, options.shard),
            engine_of(options, detectors, cache) as engine,
        ):
            with progress_display() as report:
                retry = options.retry_failed
                outcome = run_plan(
                    plan, journal, engine, report, shard=options.shard, retry_failed=retry
                )
            if not options.shard.is_whole:
                done = outcome.trials
                print(
                    f"shard {options.shard}: {done.done} trials done, {done.found} found, {done.failed} failed"
                )
                _print_failures(outcome)
                print(f"journal: {folder / 'journal'}")
                print(
                    "when all shards have run: tofpod merge, then the same command without --shard"
                )
                return 1 if outcome.failures else 0
            if not outcome.finished or not outcome.thresholds:
                return _nothing_to_report(experiment, outcome)
            print("writing tables and report", file=sys.stderr)
            tables = tables_of(_records(journal, outcome), experiment)
            provenance = _provenance(experiment, plan, outcome, tables, origin)
            provenance["seconds"]["this run in all"] = round(time.monotonic() - began, 1)
            write_tables(folder, tables.stored(), provenance)
            if experiment.config.study is None:
                shown = _write_report(folder, experiment, outcome, tables, provenance)
            else:
                shown = _write_study(folder, experiment, plan, outcome, tables, provenance, engine)
            write_json(folder / PROVENANCE.name, provenance)
        if options.cache_limit_gb is not None:
            trim_cache(
                cache, round(options.cache_limit_gb * 1e9), keep=[job.path for job in plan.renders]
            )
    except KeyboardInterrupt:
        print(
            f"\ninterrupted; finished trials are kept. To continue:\n  {command}", file=sys.stderr
        )
        return 130
    point_to(folder)
    show([*(f"warning: {text}" for text in provenance["warnings"]), *shown])
    _print_failures(outcome)
    print(f"report: {folder / REPORT.name}")
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


def _records(journal: Journal, outcome: Outcome) -> Iterator[dict[str, Any]]:
    """Yield the records of all finished trials in the order of their keys; reading them one by one
    saves memory."""
    for key in outcome.finished:
        entry = journal.read(key)
        if entry is None or entry.record is None:
            fix = "run the same command again: what is missing is run again"
            raise UserError(
                f"{journal.folder}: the record {key} is gone or damaged since it was written",
                fix=fix,
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
    """Write a study's record, tables and report. Return what the terminal shows."""
    failed = failures_by_point(plan, outcome.failures, outcome.thresholds)
    study = record_of(experiment, plan, tables, failed, provenance)
    if not study.set_ups:
        raise UserError(
            f"no damaged board of {experiment.config.name} was judged: {_reasons(outcome)}"
        )
    provenance["warnings"] += without_limit(experiment.points, outcome, failed, study.set_ups)
    write_text(folder / STUDY.name, record_text(study))
    result = evaluate_study(
        study, tables, experiment.data, each_of=partial(values_of, engine=engine)
    )
    shown = list(shown_in(plan, result.limits))
    # trials that ran on other machines may have no views here
    views = (job for damages in shown for damage in damages for job in damage.batch.renders)
    outcome.failures += (lost := render_missing(views, engine))
    # other processes draw the damages again while this process draws the figures
    arguments = [] if lost else [(damages, outcome.thresholds) for damages in shown]
    jobs = [
        Job(f"pictures of set-up {n}", "trials", study_examples, each)
        for n, each in enumerate(arguments)
    ]
    examples = pictures_from(jobs, engine, outcome)
    write_tables(
        folder,
        {table: table.frame(rows) for table, rows in study_tables(result).items()},
        provenance,
    )
    page = study_html(result, examples, provenance, resolved_yaml(experiment), title_of(experiment))
    write_text(folder / REPORT.name, page)
    return study_parts(result)


def title_of(experiment: Experiment) -> str:
    """Return the title of an experiment's page: its own title, and the axes."""
    axes = list(names_of(experiment.data.get("sweep") or {}).values())
    by = ", by " + " and ".join(filter(None, (", ".join(axes[:-1]), axes[-1]))) if axes else ""
    return (experiment.config.title or in_words(experiment.config.name)) + by


def _write_report(
    folder: Path,
    experiment: Experiment,
    outcome: Outcome,
    tables: ResultTables,
    provenance: dict[str, Any],
) -> list[str | Grid]:
    """Write the summaries and the report of an experiment that is not a study. Return what the
    terminal shows."""
    facts = experiment.data
    found = summaries(tables, outcome.examples, claim_set_of(facts))
    write_tables(folder, as_files(found), provenance)
    about = (provenance, resolved_yaml(experiment), title_of(experiment), facts)
    write_report(folder, tables, outcome.examples, *about, computed=found)
    return final_tables(tables, found)


def _nothing_to_report(experiment: Experiment, outcome: Outcome) -> int:
    """End a run without results: raise the user's mistake, or print a bug's traceback once and
    return 1."""
    name = experiment.config.name
    detector = experiment.config.detector.name
    if bug := next((failure for failure in outcome.failures if failure.is_bug), None):
        count = outcome.trials.failed
        summary = f"no trial of {name} succeeded; {count} failed, the first as above (detector {detector!r})"
        print(f"{bug.why}\n{summary}", file=sys.stderr)
        return 1
    own = [failure for failure in outcome.failures if failure.state != "skipped"]
    why = own[0].why if len({failure.in_short for failure in own}) == 1 else _reasons(outcome)
    what = "trial was judged" if outcome.finished else "trial succeeded"
    again = "once the cause is corrected, run the same command with --retry-failed: it runs these trials again"
    is_old = own and not outcome.trials.done and "to do:" not in why
    raise UserError(f"no {what} of {name}: {why}", fix=again if is_old else None)


def _reasons(outcome: Outcome) -> str:
    """Return the causes of failures, without trials that were skipped because of them."""
    own = {failure.in_short for failure in outcome.failures if failure.state != "skipped"}
    return "; ".join(sorted(own)[:3]) or "nothing was planned"


def _counts(outcome: Outcome) -> dict[str, int]:
    """Return the number of failures by state."""
    counts = Counter(failure.state for failure in outcome.failures)
    return {state: counts[state] for state in STATES if counts[state]}


def _print_failures(outcome: Outcome) -> None:
    if counts := _counts(outcome):
        totals = ", ".join(f"{count} {state}" for state, count in counts.items())
        again = "the same command, with --retry-failed, runs them again"
        again = again if set(counts) - {"skipped"} else "the same command runs what was skipped"
        print(f"{totals}: {_reasons(outcome)}\n{again}", file=sys.stderr)


def _provenance(
    experiment: Experiment,
    plan: SweepPlan,
    outcome: Outcome,
    tables: ResultTables,
    origin: dict[str, Any],
) -> dict[str, Any]:
    """Return everything that a reader needs to reproduce or question the results."""
    variant = next(
        (
            view.variant
            for view in (read_view(job.path) for job in plan.renders)
            if view is not None
        ),
        None,
    )
    runs = tables.runs
    renders = outcome.renders
    trials = outcome.trials
    sources = {
        point.config.simulated.camera.name: point.config.simulated.camera
        for point in experiment.points
    }
    guesses = (guessed_precision(camera_of(source)) for source in sources.values())
    return {
        "results_version": RESULTS_VERSION,
        **origin,
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        "seed": experiment.config.seed,
        "mitsuba_variant": variant,
        "seconds": {
            "renders (not cached)": round(renders.seconds, 1),
            "frames (all workers, resumed trials too)": round(
                float(runs["seconds_frames"].sum()), 1
            ),
            "detection and measurement (likewise)": round(float(runs["seconds_detect"].sum()), 1),
        },
        "renders": {"done": renders.done, "cached": renders.found, "failed": renders.failed},
        "trials": {"done": trials.done, "resumed": trials.found, "failed": trials.failed},
        "peak_mb": outcome.peak_mb,
        "warnings": [text for text in guesses if text],
        "failures": [
            {name: getattr(each, name) for name in FAILURE}
            for each in outcome.failures[:MOST_FAILURES]
        ],
        "failures_in_all": _counts(outcome),
    }


SIMULATION = ("scenes.sensor.source",)  # with all that they import, these modules determine frames
INSPECTED = {
    "board": int, "hole": str, "repeat": int, "true_diameter_mm": float, "true_depth_mm": float, "true_x_mm": float,
    "true_y_mm": float, "signal": float,
}  # fmt: skip
"""Columns of the table of holes that go into the record, without the prefix "true"."""


def record_of(
    experiment: Experiment,
    plan: SweepPlan,
    tables: ResultTables,
    failed: Mapping[str, Sequence[Failure]],
    provenance: Mapping[str, Any],
) -> StudyRecord:
    """Return a study's record, without set-ups that have no judged damaged board. ``failed``: by
    point digest."""
    calibrate = experiment.config.threshold.calibrate
    found = {point.digest: group for group in plan.groups for point in group.points}
    counts = {digest: len(failures) for digest, failures in failed.items()}
    set_ups = (
        _set_up(point, found[point.digest], tables, counts.get(point.digest, 0))
        for point in experiment.points
    )
    return StudyRecord(
        name=experiment.config.name,
        digest=experiment.digest,
        hit_radius_mm=experiment.config.matching.radius_mm,
        hit_overlap=experiment.config.matching.overlap,
        false_calls_per_m2=None if calibrate is None else calibrate.false_calls_per_m2,
        provenance={
            key: provenance[key] for key in ("commit", "dirty", "versions", "seed", "command")
        },
        set_ups=tuple(set_up for set_up in set_ups if set_up is not None),
    )


def _set_up(point: Point, group: Group, tables: ResultTables, failed: int) -> SetUpRecord | None:
    config = point.config
    frames = config.capture.frames

    def own(table: pd.DataFrame) -> pd.DataFrame:
        return (
            table
            if table.empty
            else table[(table["variant"] == point.variant) & (table["frames"] == frames)]
        )

    holes = own(tables.holes)
    runs = own(tables.runs)
    if holes.empty:
        return None
    calibrating = runs[runs["role"] == "calibration"]
    boards = [batch.set_ups[0].target for batch in group.then if batch.role == "damaged"]
    targets = [
        [board.board.to_data(), *(damage.to_data() for damage in board.damages)] for board in boards
    ]
    renders = (path.stem for batch in group.then for path in batch.paths)
    loudest = calibrating[
        calibrating["quiet_threshold"].notna()
    ]  # without runs that judged no pixel
    # equal if every frame of every judged board is equal
    decided_by = [
        source_digest(SIMULATION, PACKAGES),
        *renders,
        point.frames_key,
        config.capture.to_data(),
    ]
    study = config.study
    return set_up_of(
        holes,
        runs,
        variant=point.variant,
        frames=frames,
        axes=dict(point.axes),
        detector=config.detector.name,
        detector_version=detector_version(config),
        calibration_runs=len(calibrating),
        failed=failed,
        targets_digest=digest(targets),
        frames_digest=digest([*decided_by, config.repeats, None if study is None else study.units]),
        units=1 if study is None else study.units or 1,
        calibrated=None
        if loudest.empty
        else Calibrated(
            board=loudest["board"].to_numpy(int),
            repeat=loudest["repeat"].to_numpy(int),
            score=loudest["quiet_threshold"].to_numpy(float),
            **{
                name: loudest[f"loudest_{name}"].to_numpy(float)
                for name in ("x_mm", "y_mm", "u_px", "v_px")
            },
        ),
    )


def set_up_of(holes: pd.DataFrame, runs: pd.DataFrame, **named: Any) -> SetUpRecord:
    """Return a set-up's record: threshold, hits and false calls from tables of its judged boards,
    and ``named``."""
    judged = runs[runs["threshold"].notna()]
    threshold = float(judged["threshold"].iloc[0])
    by_depth = holes["detected"].to_numpy(bool)
    by_no_return = holes["no_return"].to_numpy(bool)

    def false_calls(role: str) -> Unflawed:
        ran = judged[judged["role"] == role]
        no_return = ran["no_return_calls"].to_numpy(int)
        return Unflawed(
            board=ran["board"].to_numpy(int),
            repeat=ran["repeat"].to_numpy(int),
            calls=ran["false_calls"].to_numpy(int) + no_return,
            area_m2=ran["inspected_m2"].to_numpy(float),
            no_return_calls=no_return,
        )

    return SetUpRecord(
        threshold=threshold,
        threshold_mm=threshold * float(judged["scale_mm"].mean()),
        inspected=Inspected(
            **{
                name.removeprefix("true_"): holes[name].to_numpy(kind)
                for name, kind in INSPECTED.items()
            },
            hit=by_depth | by_no_return,
            by_depth=by_depth,
            by_no_return=by_no_return,
            size_of=str(holes["size_of"].iloc[0]),
        ),
        unflawed=false_calls("hole_free"),
        beside=false_calls("damaged"),
        **{"axes": {}, "detector_version": 0, "failed": 0, **named},
    )


def failures_by_point(
    plan: SweepPlan, failures: Iterable[Failure], thresholds: Mapping[str, float]
) -> dict[str, list[Failure]]:
    """Return the failed trials of each point, by its digest."""
    by_key = {failure.what: failure for failure in failures}
    found = dict[str, list[Failure]]()
    every = [(group, batch) for group in plan.groups for batch in group.batches] if by_key else []
    for group, batch in every:
        for key, task in group.trials(batch, thresholds if batch in group.then else {}):
            for point in task.points if key in by_key else ():
                found.setdefault(point.digest, []).append(by_key[key])
    return found


def without_limit(
    points: Iterable[Point],
    outcome: Outcome,
    failed: Mapping[str, list[Failure]],
    judged: Iterable[SetUpRecord],
) -> list[str]:
    """Return sentences on the points that are not among the ``judged`` set-ups, each with its most
    common failure."""
    known = {(set_up.variant, set_up.frames) for set_up in judged}
    by_cause = dict[str, list[str]]()
    for point in (
        each for each in points if (each.variant, each.config.capture.frames) not in known
    ):
        own = [each for each in failed.get(point.digest, ()) if each.state != "skipped"]
        causes = [each.in_short for each in own]
        causes = causes or [
            each.in_short for each in outcome.failures if each.what == f"threshold of {point.label}"
        ]
        why = Counter([*causes, "its trials did not finish"]).most_common(1)[0][0]
        if own and all(each.state == "failed" and not each.is_bug for each in own):
            why = f"the camera sees no part of the board that can be judged ({why})"
        by_cause.setdefault(why, []).append(in_words(point.label))
    return [f"no limit for {'; '.join(labels)}: {why}" for why, labels in by_cause.items()]
