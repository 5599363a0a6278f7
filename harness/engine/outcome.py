"""What a run of a plan gave, and how far it is."""

from __future__ import annotations

from dataclasses import dataclass, field

from harness.engine.work import State
from harness.report.examples import ExampleCloud, MappedExample


@dataclass(frozen=True)
class Failure:
    """What did not end well: a trial, a render, a threshold. ``state`` as in `harness.engine.work.State`; ``why``: a
    message, or of a bug the end of its traceback."""

    what: str
    why: str
    is_bug: bool = False
    state: State = "failed"

    @property
    def in_short(self) -> str:
        """One line: of a bug what the traceback ends with, else what is said first."""
        lines = self.why.strip().splitlines() or [self.state]
        return lines[-1] if self.is_bug else lines[0]


@dataclass
class StageCounts:
    """Of renders or trials: ``done`` in this run, ``found`` finished before it, ``failed`` in any way (those that an
    earlier run left failed among them), of ``total`` wanted. ``seconds``: work of all workers on those done now."""

    done: int = 0
    found: int = 0
    failed: int = 0
    total: int = 0
    seconds: float = 0.0

    @property
    def over(self) -> int:
        """All that need no more work."""
        return self.done + self.found + self.failed


@dataclass
class Outcome:
    """What a run gave. ``finished``: journal keys of the trials that are done; ``failures``: all the rest, by name."""

    finished: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    thresholds: dict[str, float] = field(default_factory=dict)
    examples: list[ExampleCloud | MappedExample] = field(default_factory=list)
    renders: StageCounts = field(default_factory=StageCounts)
    trials: StageCounts = field(default_factory=StageCounts)
    peak_mb: float = 0.0
    seconds: float = 0.0


@dataclass(frozen=True)
class Progress:
    """How far a run is; a snapshot."""

    renders: StageCounts
    trials: StageCounts
