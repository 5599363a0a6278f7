"""What engine and journal add to a trial, and what a second worker brings: whole plans, run as a sweep runs them.

A trial's own seconds are those that its worker reports; everything else until the next one begins is overhead: telling
a worker, pickling, the record's way back, the journal's file, the driver's book-keeping. The first trials, in which
processes start and load compiled code, are left out.
"""

from __future__ import annotations

import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clocks import Stage, StageClock, spent
from whole_trials import OVERRIDES, STUDY, render

from harness.engine.journal import Journal
from harness.engine.plan import SweepPlan, plan_of
from harness.engine.processes import LocalEngine
from harness.engine.run import run_plan
from harness.engine.trial import TrialTask, run_trial
from harness.engine.work import Limits, Outcome
from harness.experiment.load import load_experiment

FIRST = 8
"""Trials left out at the start."""
GIVEN = "threshold={k: 5.0}"
"""No calibration, so that workers never wait for one. Draws of a hole-free board set 5.1."""
CHEAP = (
    GIVEN,
    "capture.frames=1",
    "detector={name: blind, settings: {crop: {kind: none}}}",
    "source.target.board={width_mm: 80.0, height_mm: 60.0, thickness_mm: 12.7}",
    "source.target.damage={kind: through, per_board: 1, diameter_mm: [2.0, 8.0]}",
)
"""One frame of a board of a few thousand pixels, judged by a detector that does not look."""


@dataclass
class Watch:
    """A plan's run as its progress tells it, from the `FIRST` trials on. Each moment: seconds by the wall clock, of
    this process' processor time, trials done, and seconds that workers spent on them."""

    begun: tuple[float, float, int, float] | None = None
    last: tuple[float, float, int, float] = (0.0, 0.0, 0, 0.0)

    def __call__(self, progress: Outcome) -> None:
        counts = progress.trials
        now = (time.perf_counter(), time.process_time(), counts.done, counts.seconds)
        if counts.done > self.last[2]:
            self.last = now
        if self.begun is None and counts.done >= FIRST:
            self.begun = now

    def rates(self) -> Rates:
        """Raises RuntimeError where too few trials were run."""
        if self.begun is None or self.last[2] <= self.begun[2]:
            raise RuntimeError(f"{self.last[2]} trials done: nothing to measure")
        wall, driver, count, own = (b - a for a, b in zip(self.begun, self.last, strict=True))
        return Rates(count / wall, 1e3 * wall / count, 1e3 * own / count, 1e3 * driver / count, int(count))


@dataclass(frozen=True)
class Rates:
    """Of one run: trials a second; and a trial's ms by the wall clock, in its worker, and of the driver's processor."""

    a_second: float
    wall_ms: float
    own_ms: float
    driver_ms: float
    trials: int


def run(plan: SweepPlan, folder: Path, jobs: int) -> Rates:
    """Run a plan whose renders are there, with a journal of its own. Raises RuntimeError where a trial failed."""
    watch = Watch()
    with LocalEngine(jobs, Limits()) as engine:
        outcome = run_plan(plan, Journal(folder), engine, watch)
    if outcome.failures:
        raise RuntimeError(f"{len(outcome.failures)} trials failed: {outcome.failures[0].why}")
    return watch.rates()


def _plan(cache: Path, *overrides: str) -> SweepPlan:
    plan = plan_of(load_experiment(STUDY, [*OVERRIDES, *overrides]), cache)
    render(list(plan.renders))
    return plan


# ---------------------------------------------------------------- overhead


def overhead(folder: Path, trials: int) -> dict[str, Any]:
    """Engine and journal with one worker and cheap trials."""
    plan = _plan(folder / "renders", *CHEAP, f"repeats={(trials + FIRST) // 2}")
    journal = folder / "cheap"
    clock = StageClock(time.perf_counter)
    with clock.on([Stage("journal", Journal, "write")]):
        rates = run(plan, journal, 1)
    stored = Journal(journal)
    resumed, keys = spent(lambda: [key for key in stored.trials() if stored.read(key) is not None])
    size = sum(stored.size(key) for key in keys)
    return asdict(rates) | {
        "overhead_ms": rates.wall_ms - rates.own_ms,
        "journal_ms": 1e3 * clock.seconds["journal"] / len(keys),
        "record_bytes": size / len(keys),
        "read_ms": 1e3 * resumed / len(keys),
    }


def overhead_lines(found: dict[str, Any]) -> list[list[str]]:
    """As a table."""
    return [
        ["trials a second, one worker", f"{found['a_second']:.0f}", f"of {found['trials']}"],
        ["a trial in its worker", f"{found['own_ms']:.2f} ms", ""],
        ["overhead a trial", f"{found['overhead_ms']:.2f} ms", ""],
        ["of it, writing the journal", f"{found['journal_ms']:.2f} ms", f"{found['record_bytes']:.0f} bytes"],
        ["the driver's processor time a trial", f"{found['driver_ms']:.2f} ms", ""],
        ["reading a record to resume", f"{found['read_ms']:.2f} ms", ""],
    ]


# ---------------------------------------------------------------- two workers


def two_against_one(
    folder: Path, cache: Path, way: str, said: tuple[str, ...], trials: int, *, control: bool
) -> dict[str, Any]:
    """A study's boards with one worker, then with two; and as a control two processes side by side without an engine,
    which is what the machine can do at best (two threads of one core, shared memory and others' work bring less than
    2)."""
    plan = _plan(cache, *said, GIVEN, f"repeats={(trials + FIRST) // 2}")
    rates = {jobs: run(plan, folder / f"{way} {jobs}".replace(" ", "-"), jobs) for jobs in (1, 2)}
    found = {"one": asdict(rates[1]), "two": asdict(rates[2]), "ratio": rates[2].a_second / rates[1].a_second}
    if not control:
        return found
    group = plan.groups[0]
    given = [task for _, task in group.trials(group.damaged, {}, range(trials // 2))]
    alone, beside = (side_by_side(given, count) for count in (1, 2))
    return found | {"side by side": beside / alone}


def side_by_side(given: list[TrialTask], processes: int) -> float:
    """Trials a second of so many processes together, each doing all these trials on its own."""
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        # a process that is busy warming up takes no second task
        list(pool.map(_warm, [given[:2]] * processes))
        return sum(pool.map(_rate, [given] * processes))


def _warm(given: list[TrialTask]) -> None:
    for task in given:
        run_trial(task)
    time.sleep(0.5)


def _rate(given: list[TrialTask]) -> float:
    return len(given) / spent(lambda: [run_trial(task) for task in given])[0]


def worker_lines(found: dict[str, dict[str, Any]]) -> list[list[str]]:
    """As a table."""
    heads = ["", "one: a second", "two: a second", "ratio", "side by side", "one: overhead ms", "trials"]
    lines = [
        [
            way,
            f"{each['one']['a_second']:.1f}",
            f"{each['two']['a_second']:.1f}",
            f"{each['ratio']:.2f}",
            f"{each['side by side']:.2f}" if "side by side" in each else "not measured",
            f"{each['one']['wall_ms'] - each['one']['own_ms']:.2f}",
            str(each["one"]["trials"]),
        ]
        for way, each in found.items()
    ]
    return [heads, *lines]
