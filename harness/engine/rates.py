"""How much longer or shorter than the reference machine this one takes: kept beside the cache, learnt from each run.

So a model that is off, faster code or a graphics processor are set right by the first run.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Literal

from harness.engine.costs import Cost, render_cost, trial_cost
from harness.engine.journal import Journal
from harness.engine.outcome import Outcome
from harness.engine.plan import Plan
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes

Stage = Literal["renders", "trials", "records"]
STAGES: tuple[Stage, ...] = ("renders", "trials", "records")
RATES_VERSION = 1
RATES_NAME = "rates.json"
FORGOTTEN = 0.5
"""What runs before the last one weigh, each time: machines and code change."""
LEAST_S = 1.0
"""Of work: less says nothing about a machine."""


@dataclass(frozen=True)
class Taken:
    """Seconds (or bytes) that were expected, and what it came to; old runs weigh less."""

    expected: float = 0.0
    taken: float = 0.0
    runs: int = 0

    def and_then(self, expected: float, taken: float) -> Taken:
        """With one run more."""
        return Taken(FORGOTTEN * self.expected + expected, FORGOTTEN * self.taken + taken, self.runs + 1)

    @property
    def ratio(self) -> float | None:
        """What was taken by what was expected; None where nothing is known."""
        return self.taken / self.expected if self.runs and self.expected > 0 else None


@dataclass(frozen=True)
class Rates:
    """What this machine took for each kind of render and trial in seconds, and of record in bytes."""

    renders: Mapping[str, Taken] = field(default_factory=dict)
    trials: Mapping[str, Taken] = field(default_factory=dict)
    records: Mapping[str, Taken] = field(default_factory=dict)

    def of(self, stage: Stage) -> Mapping[str, Taken]:
        """Of one stage, by kind."""
        return {"renders": self.renders, "trials": self.trials, "records": self.records}[stage]

    def ratio(self, stage: Stage, kind: str) -> float:
        """How many times the reference's; of a kind not known, as the stage's other kinds; 1 where nothing is known."""
        known = {name: one.ratio for name, one in self.of(stage).items() if one.ratio is not None}
        if kind in known:
            return known[kind]
        return sum(known.values()) / len(known) if known else 1.0

    def runs(self, stage: Stage, kinds: Iterable[str]) -> int:
        """Of how many runs the least known of these kinds is known; 0: of none."""
        return min((self.of(stage).get(kind, Taken()).runs for kind in kinds), default=0)


def read_rates(cache: Path) -> Rates:
    """What is known of this machine. A file that is absent, damaged or of another version says nothing."""
    try:
        said = strict_json(bounded_bytes(cache / RATES_NAME, TEXT_BYTES))
        if said["version"] != RATES_VERSION:
            return Rates()
        return Rates(*({kind: _taken(one) for kind, one in said[stage].items()} for stage in STAGES))
    except (OSError, UserError, ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return Rates()


def _taken(said: dict[str, Any]) -> Taken:
    """Raises ValueError or TypeError where it is none."""
    one = Taken(float(said["expected"]), float(said["taken"]), int(said["runs"]))
    if not (isfinite(one.expected) and isfinite(one.taken) and one.expected > 0 and one.taken > 0 and one.runs > 0):
        raise ValueError("no rate")
    return one


def learn(plan: Plan, outcome: Outcome, journal: Journal, cache: Path, jobs: int) -> Rates:
    """After a run, of a shard too: what it took goes into the rates, which are written; returns them. ``cache``: the
    folder around that of the renders; one that cannot be written is no matter."""
    known = read_rates(cache)
    views, trials = [render_cost(job) for job in plan.renders], _all_trials(plan, jobs)
    r, t = outcome.renders, outcome.trials
    size = _journal_bytes(outcome, journal) if outcome.finished and outcome.trials.done else 0
    rates = Rates(
        renders=_learnt(known.renders, _part(views, r.done, len(plan.renders)), r.seconds, LEAST_S),
        trials=_learnt(known.trials, _part(trials, t.done, plan.trial_count), t.seconds, LEAST_S),
        records=_learnt(known.records, _part(trials, len(outcome.finished), plan.trial_count, sizes=True), size, 1),
    )
    if rates != known:
        content = {stage: {kind: one.__dict__ for kind, one in rates.of(stage).items()} for stage in STAGES}
        text = json.dumps({"version": RATES_VERSION, **content}, indent=2, sort_keys=True)
        with contextlib.suppress(UserError):
            write_text(cache / RATES_NAME, text + "\n")
    return rates


def _all_trials(plan: Plan, jobs: int) -> list[Cost]:
    """Of a plan's trials, those of a batch as one."""
    return [
        trial_cost(group, batch, jobs).times(group.most_repeats(batch))
        for group in plan.groups
        for batch in group.batches
    ]


def _learnt(
    known: Mapping[str, Taken], expected: list[tuple[str, float]], taken: float, least: float
) -> dict[str, Taken]:
    """The rates with a run more: what each cost, by kind, was expected to be, and what all of them took together; so
    kinds that ran together share one ratio."""
    total = sum(value for _, value in expected)
    if total <= 0 or taken < least:
        return dict(known)
    rates = dict(known)
    for kind in sorted({kind for kind, _ in expected}):
        own = sum(value for name, value in expected if name == kind)
        rates[kind] = rates.get(kind, Taken()).and_then(own, own * taken / total)
    return rates


def _part(costs: list[Cost], count: int, total: int, *, sizes: bool = False) -> list[tuple[str, float]]:
    """What ``count`` of ``total`` were expected to take, by kind, as if they were as large as the rest."""
    return [(one.kind, (one.size_bytes if sizes else one.seconds) * count / total) for one in costs] if total else []


def _journal_bytes(outcome: Outcome, journal: Journal) -> int:
    """What the records of all finished trials take."""
    finished, size = set(outcome.finished), 0
    for key, path in journal.entries():
        if key in finished:
            with contextlib.suppress(OSError):
                size += path.stat().st_size
    return size
