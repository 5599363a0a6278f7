"""The seam between what is to be done and what does it: jobs go in, each comes back once with how it ended.

An engine runs jobs somewhere: in this process, in processes of this machine, on a cluster. It never decides what is
to be done, and it loses nothing: a job that raises, kills its process, hangs or eats the memory comes back as such, and
takes no other with it.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, get_args

from harness.vocabulary.errors import DiskFull, UserError

if TYPE_CHECKING:
    from harness.report.examples import ExampleCloud, MappedExample

State = Literal["done", "failed", "crashed", "timed out", "skipped"]
"""The ways in which a job can end. Done; failed: it raised; crashed: its process died; timed out: it was ended by
the time limit; skipped: it was never begun, because what it needs is not there."""
STATES: tuple[State, ...] = get_args(State)
Stage = Literal["renders", "trials"]
"""Renders load Mitsuba and some 2 GB; everything else runs where trials run."""

Code = tuple[tuple[str, ...], tuple[str, ...]]
"""Modules and packages that decide the numbers of a stage: the arguments of `source_digest`."""

TRACEBACK_CHARACTERS = 4000
"""The end of a traceback that is kept."""


@dataclass(frozen=True)
class Job:
    """``function(*arguments)``, somewhere. The function is importable by its name; arguments and result are plain data
    or frozen dataclasses. ``needs``: stored views that it reads."""

    name: str
    stage: Stage
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    needs: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Ended:
    """The end of a job. ``why``: of a user's mistake its message, of a bug (``is_bug``) the end of its traceback.
    ``seconds``: of the work itself; ``peak_mb``: resident memory at most, 0 where unknown; ``worker``: who did it.
    ``ends_all``: the disk is full, so that no other job can end better."""

    state: State
    value: Any = None
    why: str = ""
    is_bug: bool = False
    seconds: float = 0.0
    peak_mb: float = 0.0
    worker: str = ""
    ends_all: bool = False

    def result(self) -> Any:
        """The value; where there is none, the mistake or the bug as an exception here."""
        if self.state == "done":
            return self.value
        raise RuntimeError(f"{self.state}: {self.why}") if self.is_bug else UserError(f"{self.state}: {self.why}")


class JobEngine(Protocol):
    """An engine that runs jobs. Used as a context: left by an exception it drops its jobs within two seconds."""

    def __enter__(self) -> JobEngine:
        """Start."""
        ...

    def __exit__(self, *error: object) -> None:
        """End; jobs under way are dropped."""
        ...

    def room(self, stage: Stage) -> int:
        """Number of further jobs of a stage that it can use now: its queue stays short, whatever the plan's size."""
        ...

    def submit(self, job: Job) -> None:
        """Take a job."""
        ...

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end; at least one. Raises UserError where the engine itself is gone."""
        ...


@dataclass(frozen=True)
class Failure:
    """A trial, a render or a threshold that did not end well. ``state`` as in `State`; ``why``: a message, or of a bug
    the end of its traceback."""

    what: str
    why: str
    is_bug: bool = False
    state: State = "failed"

    @property
    def in_short(self) -> str:
        """One line: of a bug the last of its traceback, otherwise the first of the message."""
        lines = self.why.strip().splitlines() or [self.state]
        return lines[-1] if self.is_bug else lines[0]


@dataclass
class StageCounts:
    """Counts of renders or trials: ``done`` in this run, ``found`` finished before it, ``failed`` in any way (also
    in an earlier run), of ``total`` wanted. ``seconds``: work of all workers on those done now."""

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
    """The result of a run. ``finished``: journal keys of the trials that are done; ``failures``: the rest, by name."""

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
    """A snapshot of how far a run is."""

    renders: StageCounts
    trials: StageCounts


@dataclass(frozen=True)
class Limits:
    """Limits of a job: ``seconds`` of time, ``memory_mb`` of its worker's memory; None: as much as it likes."""

    seconds: float | None = None
    memory_mb: int | None = None


def attempt(job: Job, worker: str) -> Ended:
    """Run a job here; whatever it raises is how it ended. What ends the process is the engine's to notice."""
    _reset_peak()
    began = time.monotonic()
    state: State = "failed"
    value, why, is_bug, ends_all = None, "", False, False
    try:
        value = job.function(*job.arguments)
        state = "done"
    except UserError as mistake:
        why, ends_all = str(mistake), isinstance(mistake, DiskFull)
    except MemoryError as error:
        where = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:]
        why = f"out of memory ({str(error) or 'no more'}), of what its process may have (--memory-limit)\n{where}"
    except Exception as error:
        why, is_bug = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:], True
    return Ended(state, value, why, is_bug, time.monotonic() - began, _peak_mb(), worker, ends_all)


def _reset_peak() -> None:
    """Let the system count the peak of memory anew (Linux); elsewhere the peak is the process' so far."""
    try:
        with open("/proc/self/clear_refs", "w") as counter:
            counter.write("5")
    except OSError:
        pass


def _peak_mb() -> float:
    """Resident memory at most since the last reset, MB."""
    try:
        with open("/proc/self/status") as lines:
            (high,) = (line for line in lines if line.startswith("VmHWM"))
        return round(int(high.split()[1]) * 1024 / 1e6, 1)
    except (OSError, ValueError):
        return 0.0
