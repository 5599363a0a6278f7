"""The bill of a run: processor seconds of all its processes, by phase.

Processor seconds depend less than wall-clock seconds on other work on the machine. What a worker
process spends between jobs, some hundredths of a second at its start, is not counted."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from harness.records.outputs import PROVENANCE
from harness.report.blocks import BILL
from harness.runs.jobs import Ended, Job, JobEngine, Stage
from harness.vocabulary.files import RECORD_BYTES, bounded_bytes, strict_json
from harness.vocabulary.text import many

PHASES = ("imports", "plan", "renders", "frames", "detection", "statistics", "tables and page")
FIXED = ("imports", "plan", "statistics", "tables and page")
"""Phases whose cost depends on neither renders nor trials."""
SHOWN_IN_SECONDS = 90.0
"""Longer times are shown in minutes."""


class Bill:
    """Adds up the processor seconds of a run, phase after phase. The first is all that this
    process has spent before, and no earlier bill was charged with: on imports, and on reading the
    experiment."""

    _settled_s = 0.0  # of this process, by all bills

    def __init__(self) -> None:
        self._seconds = dict.fromkeys(PHASES, 0.0)
        self._phase = "imports"

    def begin(self, phase: str) -> None:
        """Charge a phase, from now on, with what this process spends and with jobs that end."""
        self._settle()
        self._phase = phase

    def _settle(self) -> None:
        """Charge what this process has spent since the last time."""
        now_s = time.process_time()
        self._seconds[self._phase] += now_s - Bill._settled_s
        Bill._settled_s = now_s

    def charge(self, job: Job, ended: Ended) -> None:
        """Charge a job that another process has done: a render, or a part of this phase."""
        phase = "renders" if job.stage == "renders" else self._phase
        self._seconds[phase] += ended.processor_s

    def divide_trials(self, frames_share: float) -> None:
        """Charge the frames with their share of what trials cost, so far all detection."""
        self._settle()
        trials_s = self._seconds["detection"]
        self._seconds["frames"] = trials_s * frames_share
        self._seconds["detection"] = trials_s - self._seconds["frames"]

    def rounded(self) -> dict[str, float]:
        """Return the seconds by phase, as provenance records them."""
        self._settle()
        return {phase: round(seconds, 2) for phase, seconds in self._seconds.items()}

    def in_words(self) -> str:
        """Return one line: the sum, and each phase."""
        self._settle()
        parts = [f"{phase} {seconds:.1f}" for phase, seconds in self._seconds.items()]
        return f"processor seconds: {sum(self._seconds.values()):.1f} ({', '.join(parts)})"


class Metered:
    """An engine whose jobs are charged to a bill."""

    def __init__(self, engine: JobEngine, bill: Bill) -> None:
        self._engine = engine
        self.bill = bill

    def __enter__(self) -> Metered:
        self._engine.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._engine.__exit__(*error)

    def room(self, stage: Stage) -> int:
        """Return the engine's room for jobs of a stage."""
        return self._engine.room(stage)

    def submit(self, job: Job) -> None:
        """Give the engine a job."""
        self._engine.submit(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs of the engine to end, and charge them."""
        ended_jobs = self._engine.ended()
        for job, ended in ended_jobs:
            self.bill.charge(job, ended)
        return ended_jobs


def expected(out: Path, name: str, renders: int, trials: int, processes: int) -> str:
    """Return what a run with this many renders and trials is expected to take, and from which
    bills in ``out`` that follows: those of the same experiment as far as there are any, else of
    others, else the `USUAL` costs."""
    every = dict(_bills(out.glob(f"*/*/{PROVENANCE.name}")))
    own = [bill for path, bill in every.items() if path.parent.parent.name == name]
    basis = "by the bills of earlier runs of this experiment"
    known = _unit_costs(own)
    if None in known:
        basis = "roughly, by the bills of other experiments"
        known = known.or_else(_unit_costs([*every.values()]))
    if None in known:
        basis = f"very roughly: no such run has been billed in {out} yet"
        known = known.or_else(USUAL)
    fixed_s, render_s, trial_s = (seconds or 0.0 for seconds in known)
    total_s = fixed_s + renders * render_s + trials * trial_s
    cores = min(processes, os.cpu_count() or 1)
    return (
        f"expected from nothing: {_duration(total_s)} of processor time "
        f"({_duration(renders * render_s)} for renders, {_duration(trials * trial_s)} for trials), "
        f"or {_duration(total_s / cores)} on {many(cores, 'idle core')}; {basis}"
    )


def _duration(seconds: float) -> str:
    """Return a time in words, in seconds or minutes."""
    return f"{seconds:.0f} s" if seconds < SHOWN_IN_SECONDS else f"{seconds / 60:.1f} min"


class _UnitCosts(NamedTuple):
    """Processor seconds of parts of a run; None where no bill tells them."""

    fixed_s: float | None
    """The fixed part."""
    render_s: float | None
    """A render."""
    trial_s: float | None
    """A trial."""

    def or_else(self, others: _UnitCosts) -> _UnitCosts:
        """Return these costs, and ``others`` where they are not known."""
        return _UnitCosts(
            fixed_s=others.fixed_s if self.fixed_s is None else self.fixed_s,
            render_s=others.render_s if self.render_s is None else self.render_s,
            trial_s=others.trial_s if self.trial_s is None else self.trial_s,
        )


USUAL = _UnitCosts(fixed_s=12.0, render_s=0.25, trial_s=0.4)
"""Costs of `detection_limit.yaml` (docs/performance.md)."""


@dataclass(frozen=True)
class _StoredBill:
    """The bill of an earlier run."""

    seconds: Mapping[str, float]
    """Processor seconds by phase."""
    renders: int
    """Number of renders that it did."""
    trials: int
    """Number of trials that it did."""


def _unit_costs(bills: Sequence[_StoredBill]) -> _UnitCosts:
    """Return the costs by these bills. A run that found its renders or trials stored says nothing
    of what they cost."""
    fixed = [sum(bill.seconds[phase] for phase in FIXED) for bill in bills]
    of_renders = [(bill.seconds["renders"], bill.renders) for bill in bills]
    of_trials = [
        (bill.seconds["frames"] + bill.seconds["detection"], bill.trials) for bill in bills
    ]
    return _UnitCosts(max(fixed, default=None), _mean_cost(of_renders), _mean_cost(of_trials))


def _mean_cost(costs: Iterable[tuple[float, int]]) -> float | None:
    """Return the seconds of one piece of work, from (seconds, pieces) of several runs; None if
    none did any."""
    seconds = 0.0
    pieces = 0
    for run_seconds, run_pieces in costs:
        if run_pieces:
            seconds += run_seconds
            pieces += run_pieces
    return seconds / pieces if pieces else None


def _bills(paths: Iterable[Path]) -> Iterator[tuple[Path, _StoredBill]]:
    """Yield the path and the bill of each run; the link to the latest is no further run."""
    for path in paths:
        if path.parent.is_symlink():
            continue
        try:
            facts: Any = strict_json(bounded_bytes(path, RECORD_BYTES))
            seconds = {phase: float(facts[BILL][phase]) for phase in PHASES}
            renders = int(facts["renders"]["done"])
            trials = int(facts["trials"]["done"])
        except (OSError, ValueError, KeyError, TypeError):
            continue
        yield path, _StoredBill(seconds, renders, trials)
