"""The interface between plans and engines: every submitted job comes back exactly once, with how
it ended."""

from __future__ import annotations

import json
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol, get_args

from harness.vocabulary import system
from harness.vocabulary.errors import DiskFull, UserError

State = Literal["done", "failed", "crashed", "timed out", "skipped"]
"""The ends of a job. Failed: it raised; crashed: its process died; skipped: something that it
needs is missing."""
STATES: tuple[State, ...] = get_args(State)
Stage = Literal[
    "renders", "trials"
]  # renders load Mitsuba and need 2 GB; all other jobs run as trials
Code = tuple[
    tuple[str, ...], tuple[str, ...]
]  # modules and packages: the arguments of `source_digest`
TRACEBACK_CHARACTERS = 4000


@dataclass(frozen=True)
class Job:
    """``function(*arguments)``, an importable function; arguments and result are plain data or
    frozen dataclasses."""

    name: str
    stage: Stage
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Ended:
    """The end of a job. ``value``: its result; of a trial, its record as text. ``why``: a user's
    mistake, or the end of a bug's traceback. ``peak_mb``: peak resident memory, 0 if unknown.
    ``ends_all``: the disk is full. ``processor_s``: processor time that another process spent on
    it."""

    state: State
    value: Any = None
    why: str = ""
    is_bug: bool = False
    seconds: float = 0.0
    peak_mb: float = 0.0
    worker: str = ""
    ends_all: bool = False
    processor_s: float = 0.0

    @cached_property
    def record(self) -> dict[str, Any] | None:
        """Rows of a finished trial, by table."""
        return None if self.value is None else json.loads(self.value)


class JobEngine(Protocol):
    """An engine that runs jobs. As a context manager, it drops its jobs within two seconds of an
    exception."""

    def __enter__(self) -> JobEngine: ...
    def __exit__(self, *error: object) -> None: ...

    def room(self, stage: Stage) -> int:
        """Return how many more jobs of a stage the engine can use; its queue stays short, whatever
        the plan's size."""

    def submit(self, job: Job) -> None:
        """Take a job."""

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait until at least one job has ended; return those that have. Raises UserError if the
        engine is gone."""


@dataclass(frozen=True)
class Failure:
    """A trial, render or threshold that did not succeed; fields as in `Ended`."""

    what: str
    why: str
    is_bug: bool = False
    state: State = "failed"

    @property
    def in_short(self) -> str:
        """The last line of a bug's traceback, or else the first line of the message."""
        lines = self.why.strip().splitlines() or [self.state]
        return lines[-1] if self.is_bug else lines[0]


@dataclass
class StageCounts:
    """Numbers of renders or trials: ``done`` in this run, ``found`` finished earlier, ``failed``,
    and in ``total``."""

    done: int = 0
    found: int = 0
    failed: int = 0
    total: int = 0
    seconds: float = 0.0

    @property
    def over(self) -> int:
        """Number of those that need no more work."""
        return self.done + self.found + self.failed


@dataclass
class Outcome:
    """The result of a run. ``finished``: journal keys of the finished trials; ``failures``: all
    others, by name."""

    finished: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    thresholds: dict[str, float] = field(default_factory=dict)
    renders: StageCounts = field(default_factory=StageCounts)
    trials: StageCounts = field(default_factory=StageCounts)
    peak_mb: float = 0.0

    def counted_after(self, earlier: Outcome) -> Outcome:
        """Return this outcome; what the same command did in an earlier batch counts as done, not
        as found."""
        for counts, before in ((self.renders, earlier.renders), (self.trials, earlier.trials)):
            counts.done += before.done
            counts.found -= before.done
            counts.seconds += before.seconds
        self.peak_mb = max(self.peak_mb, earlier.peak_mb)
        return self


@dataclass(frozen=True)
class Limits:
    """Limits of a job: ``seconds`` of time, ``memory_mb`` of its worker's memory; None: no
    limit."""

    seconds: float | None = None
    memory_mb: int | None = None


def attempt(job: Job, worker: str) -> Ended:
    """Run a job in this process; an exception becomes its end. If the process dies, the engine has
    to notice."""
    system.reset_peak_memory()
    began = time.monotonic()
    state: State = "failed"
    value = None
    why = ""
    is_bug = False
    ends_all = False
    try:
        value = job.function(*job.arguments)
        state = "done"
    except UserError as mistake:
        why = str(mistake)
        ends_all = isinstance(mistake, DiskFull)
    except MemoryError as error:
        where = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:]
        why = (
            f"out of memory ({str(error) or 'no more'}): its process has a limit "
            f"(--memory-limit)\n{where}"
        )
    except Exception as error:
        why = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:]
        is_bug = True
    seconds = time.monotonic() - began
    peak_mb = round(system.peak_memory_bytes() / 1e6, 1)
    return Ended(state, value, why, is_bug, seconds, peak_mb, worker, ends_all)
