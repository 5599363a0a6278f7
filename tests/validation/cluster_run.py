"""What a trial costs beside its own work on a cluster: ``python tests/validation/cluster_run.py
--trials 20000``.

A `dask scheduler` and `dask worker` processes are started separately; the plan is real and cheap:
one frame of a board at 2.3 m, rendered once, and the blind detector. Printed: rate, shares of the
workers' time, processor time of driver and scheduler, bytes over the network, and what the journal
and the tables cost.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import pickle
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [
        str(Path(__file__).resolve().parents[2]),
        str(Path(__file__).resolve().parents[1]),
    ]

import psutil

from harness.experiment.load import load_experiment
from harness.programs.cluster.engine import ClusterEngine
from harness.runs.engines import code_of
from harness.runs.jobs import Ended, Job, Limits, Outcome
from harness.runs.journal import Journal
from harness.runs.plan import SweepPlan, plan_of
from harness.runs.run import run_plan
from harness.runs.tables import tables_of
from tests.support.cluster_processes import Processes, processes, square, until

CHEAP = """\
name: cheap
seed: 1
source:
  kind: simulated
  target: {name: thesis, distance_m: 2.3}
  camera: {name: azure_kinect_nfov}
  render: {bounces: 1, face_samples: 64, hole_samples: 16, rest_samples: 8}
capture: {frames: 1}
detector: {name: blind, settings: {crop: {kind: auto, inset_px: 2}}}
threshold: {k: 3.0}
repeats: TRIALS
"""


def main() -> int:
    """The program."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=20_000)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, processes(Path(name) / "cluster") as cluster:
        for _ in range(options.workers):
            cluster.worker("--memory-limit", "2GB")
        printed = measured(Path(name), cluster, options.trials, options.workers)
    print(json.dumps(printed, indent=2))
    print("\nA million trials, hours, by what bounds them (one render for a thousand trials):")
    for cores in (1, 64, 1024):
        print(
            f"{cores:5} cores: "
            + ", ".join(
                f"{content} {hours:.2f}" for content, hours in scaled(printed, cores).items()
            )
        )
    return 0


def scaled(
    said: dict[str, float], cores: int, trials: float = 1e6, per_render: float = 1000.0
) -> dict[str, float]:
    """Hours of each part of a large run: what workers share, and what one driver and one scheduler
    do alone."""
    hours = {
        "renders": trials / per_render * said["render_s"] / cores,
        "trials": trials * said["trial_ms"] / 1e3 / cores,
        "between trials": trials * said["beside_ms_per_trial_and_worker"] / 1e3 / cores,
        "driver": trials * said["driver_ms_per_trial"] / 1e3,
        "scheduler": trials * said["scheduler_ms_per_trial"] / 1e3,
        "report": trials * said["read_and_tables_ms"] / 1e3,
    }
    return {content: seconds / 3600 for content, seconds in hours.items()}


def measured(home: Path, cluster: Processes, trials: int, workers: int) -> dict[str, float]:
    """Run and account for it."""
    (home / "cheap.yaml").write_text(CHEAP.replace("TRIALS", str(trials // 2)))
    experiment = load_experiment(home / "cheap.yaml")
    plan = plan_of(experiment, home / "cache")
    journal = Journal(home / "journal")
    with ClusterEngine(
        cluster.address, Limits(60.0, 2000), workers, code_of(["blind"]), home
    ) as engine:
        until(lambda: engine.room("renders") > workers)
        bare = bare_rate(engine)
        scheduler = psutil.Process(cluster.scheduler.pid)
        steady: list[Look] = []

        def look(now: Outcome) -> None:
            if now.trials.done:
                own_rows = processor_s(psutil.Process())
                theirs = processor_s(scheduler)
                steady[1:] = [
                    Look(time.monotonic(), now.trials.done, now.trials.seconds, own_rows, theirs)
                ]

        outcome = run_plan(plan, journal, engine, look)
    assert len(outcome.finished) == trials and not outcome.failures, (
        len(outcome.finished),
        outcome.failures[:2],
    )
    first, last = steady
    wall = last.at_s - first.at_s
    count = last.trials - first.trials
    work = last.work_s - first.work_s
    return {
        "trials": trials,
        "workers": workers,
        "render_s": round(outcome.renders.seconds / outcome.renders.total, 2),
        "trials_per_s": round(count / wall, 1),
        "trial_ms": round(1e3 * work / count, 2),
        "worker_share_in_trials": round(work / (wall * workers), 3),
        "beside_ms_per_trial_and_worker": round(1e3 * (wall * workers - work) / count, 2),
        "driver_ms_per_trial": round(1e3 * (last.driver_s - first.driver_s) / count, 3),
        "scheduler_ms_per_trial": round(1e3 * (last.scheduler_s - first.scheduler_s) / count, 3),
        "empty_jobs_per_s": round(bare, 1),
        **sizes(plan, journal, outcome),
        **report_cost(experiment, journal, outcome),
    }


@dataclass(frozen=True)
class Look:
    """At one moment: trials done, work of all workers on them, processor time of driver and
    scheduler."""

    at_s: float
    trials: int
    work_s: float
    driver_s: float
    scheduler_s: float


def bare_rate(engine: ClusterEngine, count: int = 4000) -> float:
    """Jobs a second that do nothing; bundles have grown by the time that it counts."""
    began = 0.0
    left_over = 2 * count
    ended = 0
    while ended < 2 * count:
        while left_over > 0 and engine.room("trials") > 0:
            engine.submit(Job(f"empty {left_over}", "trials", square, (left_over,)))
            left_over -= 1
        ended += len(engine.ended())
        began = began or (time.monotonic() if ended >= count else 0.0)
    return count / (time.monotonic() - began)


def processor_s(process: psutil.Process) -> float:
    """User and system, of all its threads."""
    times = process.cpu_times()
    return float(times.user + times.system)


def sizes(plan: SweepPlan, journal: Journal, outcome: Outcome) -> dict[str, float]:
    """Bytes of what is sent for a trial, alone and in a bundle of 32, of its answer, and of what
    is stored."""
    group = plan.groups[0]
    tasks = [task for _, task in group.trials(group.batches[0], {}, range(32))]
    entries = [journal.read(key) for key in outcome.finished[:100]]
    records = [entry.record for entry in entries if entry is not None]
    return {
        "bytes_of_a_task": len(pickle.dumps(tasks[0])),
        "bytes_of_a_task_in_a_bundle": round(len(pickle.dumps(tasks)) / len(tasks)),
        "bytes_of_a_record_sent": round(
            sum(len(pickle.dumps(record)) for record in records) / len(records)
        ),
        "bytes_of_a_journal_entry": round(
            sum(map(journal.size, outcome.finished)) / len(outcome.finished)
        ),
        "files_of_the_journal": len(list(journal.folder.iterdir())),
        "bytes_of_a_view": max(job.path.stat().st_size for job in plan.renders),
    }


def report_cost(experiment: object, journal: Journal, outcome: Outcome) -> dict[str, float]:
    """Milliseconds a trial to write a record, to read it again, and to make tables; and the
    tables' memory."""
    keys = outcome.finished
    began = time.monotonic()
    entries = [entry for key in keys[:2000] if (entry := journal.read(key)) is not None]
    read = (time.monotonic() - began) / len(entries)
    with tempfile.TemporaryDirectory(dir=journal.folder.parent) as second_folder:
        began = time.monotonic()
        copied = Journal(Path(second_folder))
        for key, entry in zip(keys, entries, strict=False):
            copied.write(key, Ended(**vars(entry)))
        write = (time.monotonic() - began) / len(entries)
    process = psutil.Process()
    before = process.memory_info().rss
    began = time.monotonic()
    tables = tables_of((journal.read(key).record for key in keys), experiment)  # type: ignore[union-attr, misc, arg-type]
    spent = time.monotonic() - began
    with contextlib.suppress(AttributeError):
        assert len(tables.runs) > 0
    return {
        "journal_write_ms": round(1e3 * write, 3),
        "journal_read_ms": round(1e3 * read, 3),
        "read_and_tables_ms": round(1e3 * spent / len(keys), 3),
        "tables_kb_per_trial": round((process.memory_info().rss - before) / len(keys) / 1e3, 2),
    }


if __name__ == "__main__":
    sys.exit(main())
