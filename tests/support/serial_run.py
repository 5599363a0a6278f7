"""A plan run in the test's own process, where patches hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from harness.runs.jobs import Outcome
from harness.runs.journal import NOT_TRIALS, Journal
from harness.runs.plan import SweepPlan
from harness.runs.processes import SerialEngine
from harness.runs.run import run_plan


def run_serially(plan: SweepPlan, folder: Path, **asked: Any) -> Outcome:
    """Run what the journal in ``folder`` lacks."""
    with SerialEngine() as engine:
        return run_plan(plan, Journal(folder), engine, lambda _: None, **asked)


def records_of(folder: Path, outcome: Outcome) -> list[dict[str, Any]]:
    """Of all finished trials, in order of their keys."""
    entries = [Journal(folder).read(key) for key in outcome.finished]
    return [entry.record for entry in entries if entry is not None and entry.record is not None]


def trial_count(plan: SweepPlan) -> int:
    """Trials of all roles."""
    return sum(group.most_repeats(batch) for group in plan.groups for batch in group.batches)


def trial_keys(journal: Journal) -> list[str]:
    """Keys of all trials, sorted."""
    return sorted(key for key, _ in journal.entries() if not key.startswith(NOT_TRIALS))
