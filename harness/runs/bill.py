"""The bill of a run: processor seconds of all its processes, by phase.

Processor seconds depend less than wall-clock seconds on other work on the machine. What a worker
process spends between jobs, some hundredths of a second at its start, is not counted."""

from __future__ import annotations

import time

from harness.runs.jobs import Ended, Job, JobEngine, Stage

PHASES = ("imports", "plan", "renders", "frames", "detection", "statistics", "tables and page")
FIXED = ("imports", "plan", "statistics", "tables and page")
"""Phases whose cost depends on neither renders nor trials."""


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
