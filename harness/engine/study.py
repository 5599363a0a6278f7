"""A study with a simulated camera, from a validated experiment to its folder of results."""

from __future__ import annotations

import datetime
import io
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from harness.engine.console import progress_display
from harness.engine.journal import Journal
from harness.engine.plan import Plan, plan_of
from harness.engine.run import Outcome, pending_counts, run_plan
from harness.engine.tables import STUDY_ORDERS, Tables, tables_of
from harness.experiment.load import resolved_yaml
from harness.experiment.points import Experiment
from harness.experiment.schema import SimulatedSource
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import atomic_path, write_text
from harness.vocabulary.provenance import record
from harness.vocabulary.units import INCH, MM
from scenes.render.cache import read_view
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.thesis import DIAMETERS_IN
from scenes.view import NoiseFreeView

if TYPE_CHECKING:
    from rich.table import Table

RESULTS_VERSION = 1
"""Stands in every result folder; raised when the tables' meaning changes."""


def dry_run(experiment: Experiment, out: Path, jobs: int) -> int:
    """Say what would be run."""
    folder = experiment.folder(out)
    plan = plan_of(experiment, _cache(out))
    sets = f"{len(plan.groups)} set{'s' if len(plan.groups) != 1 else ''} of frames"
    print(f"{experiment.config.name}: valid; {len(experiment.points)} points, {sets}")
    for what, planned, there in pending_counts(plan, Journal(folder / "journal")):
        print(f"  {what}: {planned}, {there} already there")
    print(f"  trials of both kinds: {plan.trial_count}, on {jobs} processes")
    print(f"  results would go to {folder}")
    return 0


def run_study(experiment: Experiment, out: Path, jobs: int, command: str) -> int:
    """Run, write tables and report, print the summary. Returns 0, or 1 where trials failed."""
    began = time.perf_counter()
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    folder = experiment.folder(out)
    plan = plan_of(experiment, _cache(out))
    # The first file written: an unwritable folder shows before any work is done.
    write_text(folder / "experiment.yaml", resolved_yaml(experiment))
    try:
        with progress_display() as show:
            outcome = run_plan(plan, Journal(folder / "journal"), jobs, show)
    except KeyboardInterrupt:
        print(f"\ninterrupted; finished trials are kept. To go on:\n  {command}", file=sys.stderr)
        return 130
    if not outcome.records or not outcome.thresholds:
        return _nothing_to_report(experiment, outcome)
    tables = tables_of((outcome.records[key] for key in sorted(outcome.records)), experiment)
    provenance = _provenance(experiment, plan, outcome, command, started, time.perf_counter() - began)
    _write_tables(folder, tables, provenance, is_study=experiment.config.study is not None)
    if experiment.config.study is None:
        _write_report(folder, experiment, outcome, tables, provenance)
        table, text = _final_table(tables)
    else:
        table, text = _write_study(folder, experiment, plan, outcome, tables, provenance)
    _conclude(folder, table, text, outcome)
    return 1 if outcome.failures else 0


def _write_study(
    folder: Path, experiment: Experiment, plan: Plan, outcome: Outcome, tables: Tables, provenance: dict[str, Any]
) -> tuple[Table, str]:
    """A study's record and report; its limits as a table and as text."""
    from harness.engine.study_examples import study_examples
    from harness.engine.study_record import failed_by_point, record_of
    from harness.evaluation.study.record import record_text
    from harness.evaluation.study.result import evaluate_study
    from harness.report.study_page import write_study_report
    from harness.report.study_terminal import study_table, study_text

    failed = failed_by_point(plan, (failure.what for failure in outcome.failures), outcome.thresholds)
    study = record_of(experiment, plan, tables, failed, provenance)
    if not study.set_ups:
        raise UserError(f"no damaged board of {experiment.config.name} was judged: {_reasons(outcome)}")
    write_text(folder / "study.json", record_text(study))
    result = evaluate_study(study, tables, experiment.data, diameters_mm=_table_one_mm(experiment))
    examples = study_examples(plan, result.limits, outcome.thresholds)
    title = experiment.config.title or experiment.config.name
    write_study_report(folder, result, examples, provenance, resolved_yaml(experiment), title)
    return study_table(result), study_text(result)


def _table_one_mm(experiment: Experiment) -> list[float]:
    """The diameters of the thesis' holes, where any set-up's damage is drilled holes."""
    targets = [cast("SimulatedSource", point.config.source).target for point in experiment.points]
    drilled = any(isinstance(target, DrawnTargetConfig) and target.damage.kind != "dent" for target in targets)
    return [size_in * INCH / MM for size_in in DIAMETERS_IN] if drilled else []


def _cache(out: Path) -> Path:
    return out / ".cache" / "renders"


def _nothing_to_report(experiment: Experiment, outcome: Outcome) -> int:
    """Where every trial was refused that is the user's to mend; a bug keeps its traceback (once) and gives 1."""
    name, detector = experiment.config.name, experiment.config.detector.name
    bug = next((failure for failure in outcome.failures if failure.is_bug), None)
    if bug is None:
        raise UserError(f"no trial of {name} succeeded: {_reasons(outcome)}")
    print(bug.why, file=sys.stderr)
    count = len(outcome.failures)
    print(f"no trial of {name} succeeded; {count} failed, the first as above (detector {detector!r})", file=sys.stderr)
    return 1


def _reasons(outcome: Outcome) -> str:
    return "; ".join(sorted({failure.in_short for failure in outcome.failures})[:3]) or "nothing was planned"


def _provenance(
    experiment: Experiment, plan: Plan, outcome: Outcome, command: str, started: str, seconds: float
) -> dict[str, Any]:
    """Everything that a reader needs to repeat the numbers or to doubt them."""
    runs = [row for record in outcome.records.values() for row in record["runs"]]
    views = _views_of_set_ups(plan)
    noise = _indirect_noise_mm(views)
    return {
        "results_version": RESULTS_VERSION,
        **record(command),
        "experiment": experiment.config.name,
        "digest": experiment.digest,
        "seed": experiment.config.seed,
        "mitsuba_variant": views[0].variant if views else None,
        "started": started,
        "seconds": {
            "this run in all": round(seconds, 1),
            "renders (not cached)": round(outcome.render_seconds, 1),
            "frames (all workers, resumed trials too)": round(sum(row["seconds_frames"] for row in runs), 1),
            "detection and measurement (likewise)": round(sum(row["seconds_detect"] for row in runs), 1),
        },
        "renders": {"done": outcome.renders_done, "cached": outcome.renders_cached},
        "trials": {"done": outcome.trials_done, "resumed": outcome.trials_resumed},
        "indirect_noise_mm": noise,
        "failures": [{"what": failure.what, "why": failure.why} for failure in outcome.failures],
    }


def _views_of_set_ups(plan: Plan) -> list[NoiseFreeView]:
    """The damaged views of all set-ups, variations left out."""
    set_ups = [group for group in plan.groups if any(not point.is_variation for point in group.points)]
    jobs = (job for group in set_ups or plan.groups[:1] for job in group.damaged.renders)
    views = (read_view(job.path) for job in jobs)
    return [view for view in views if view is not None]


def _indirect_noise_mm(views: list[NoiseFreeView]) -> dict[str, float]:
    """What the render leaves of Monte Carlo noise: the median over each surface's pixels, the worst over set-ups."""
    noise: dict[str, float] = {}
    for view in views:
        for index, name in enumerate(view.surface_names):
            here = view.surface == index
            if here.any():
                median_mm = round(float(np.median(view.indirect_noise_m[here])) / MM, 4)
                noise[name] = max(noise.get(name, 0.0), median_mm)
    return noise


def _write_tables(folder: Path, tables: Tables, provenance: dict[str, Any], *, is_study: bool) -> None:
    """Parquet with the provenance in its schema, the summary as CSV (a study's boards have none hole by hole), the
    provenance as JSON."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    from harness.evaluation.summary import summarise_holes

    numbers = {k: provenance[k] for k in ("results_version", "experiment", "digest", "seed", "commit", "dirty")}
    note = json.dumps({**numbers, "versions": provenance["versions"]}, sort_keys=True)
    stored_tables = {"trials": tables.holes, "runs": tables.runs, "probes": tables.probes, "noise": tables.noise}
    stored_tables |= {"registrations": tables.registrations, "walls": tables.walls}
    stored_tables |= {name: getattr(tables, name) for name in STUDY_ORDERS}
    for name, table in stored_tables.items():
        if table.empty and name not in ("trials", "runs"):
            continue
        stored = pa.Table.from_pandas(table, preserve_index=False)
        stored = stored.replace_schema_metadata({**(stored.schema.metadata or {}), b"tofpod": note.encode()})
        with atomic_path(folder / f"{name}.parquet") as path:
            pq.write_table(stored, path)
    if not is_study:
        buffer = io.StringIO()
        summarise_holes(tables.holes, list(tables.axes["path"])).to_csv(buffer, index=False, float_format="%.6g")
        write_text(folder / "summary.csv", buffer.getvalue())
    write_text(folder / "provenance.json", json.dumps(provenance, indent=2) + "\n")


def _write_report(
    folder: Path, experiment: Experiment, outcome: Outcome, tables: Tables, provenance: dict[str, Any]
) -> None:
    from harness.report.page import write_report

    title = experiment.config.title or experiment.config.name
    write_report(folder, tables, outcome.examples, provenance, resolved_yaml(experiment), title)


def _conclude(folder: Path, table: Table, text: str, outcome: Outcome) -> None:
    """The final table, the failures, and where to look."""
    from rich.console import Console

    if sys.stdout.isatty():
        Console().print(table)
    else:
        print(text)
    if outcome.failures:
        print(f"{len(outcome.failures)} trials failed: {_reasons(outcome)}", file=sys.stderr)
    print(f"report: {folder / 'report.html'}")


def _final_table(tables: Tables) -> tuple[Table, str]:
    """What a terminal shows at the end, and the same as plain text: by the kind of experiment."""
    from harness.evaluation.maps import compare_maps
    from harness.evaluation.set_ups import compare_set_ups, set_ups_of
    from harness.evaluation.summary import summarise_holes
    from harness.report import terminal
    from harness.report.perspectives_rows import Ways
    from harness.report.set_ups_rows import Layout

    summary = summarise_holes(tables.holes, list(tables.axes["path"]))
    if not tables.registrations.empty:
        compared = compare_maps(tables, summary)
        ways = Ways.of(tables, compared)
        return terminal.maps_table(compared, ways), terminal.maps_text(compared, ways)
    if len(set_ups_of(tables)) > 1:
        compared = compare_set_ups(tables, summary, set_ups_of(tables))
        layout = Layout.of(tables, compared)
        return terminal.set_ups_table(compared, layout), terminal.set_ups_text(compared, layout)
    return terminal.terminal_table(summary), terminal.terminal_text(summary)
