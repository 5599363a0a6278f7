"""The interface between plans and engines: every submitted job comes back exactly once, with how it ended. Also shards
(`--shard 3/10`), and the options of all programs that run experiments."""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar, get_args

from harness.vocabulary.errors import DiskFull, UserError
from harness.vocabulary.files import lock, opened_lock
from harness.vocabulary.program import whole_number

if TYPE_CHECKING:
    from harness.report.clouds import ExampleCloud, MappedExample

State = Literal["done", "failed", "crashed", "timed out", "skipped"]
"""The ends of a job. Failed: it raised; crashed: its process died; skipped: something that it needs is missing."""
STATES: tuple[State, ...] = get_args(State)
Stage = Literal["renders", "trials"]  # renders load Mitsuba and need 2 GB; all other jobs run as trials
Code = tuple[tuple[str, ...], tuple[str, ...]]  # modules and packages: the arguments of `source_digest`
TRACEBACK_CHARACTERS = 4000


@dataclass(frozen=True)
class Job:
    """``function(*arguments)``, an importable function; arguments and result are plain data or frozen dataclasses."""

    name: str
    stage: Stage
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class Ended:
    """The end of a job. ``value``: its result; of a trial, its record as text. ``why``: a user's mistake, or the end of
    a bug's traceback. ``peak_mb``: peak resident memory, 0 if unknown. ``ends_all``: the disk is full."""

    state: State
    value: Any = None
    why: str = ""
    is_bug: bool = False
    seconds: float = 0.0
    peak_mb: float = 0.0
    worker: str = ""
    ends_all: bool = False

    @cached_property
    def record(self) -> dict[str, Any] | None:
        """Rows of a finished trial, by table."""
        return None if self.value is None else json.loads(self.value)


class JobEngine(Protocol):
    """An engine that runs jobs. As a context manager, it drops its jobs within two seconds of an exception."""

    def __enter__(self) -> JobEngine: ...
    def __exit__(self, *error: object) -> None: ...

    def room(self, stage: Stage) -> int:
        """Return how many more jobs of a stage the engine can use; its queue stays short, whatever the plan's size."""

    def submit(self, job: Job) -> None:
        """Take a job."""

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait until at least one job has ended; return those that have. Raises UserError if the engine is gone."""


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
    """Numbers of renders or trials: ``done`` in this run, ``found`` finished earlier, ``failed``, and in ``total``."""

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
    """The result of a run. ``finished``: journal keys of the finished trials; ``failures``: all others, by name."""

    finished: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    thresholds: dict[str, float] = field(default_factory=dict)
    examples: list[ExampleCloud | MappedExample] = field(default_factory=list)
    renders: StageCounts = field(default_factory=StageCounts)
    trials: StageCounts = field(default_factory=StageCounts)
    peak_mb: float = 0.0


@dataclass(frozen=True)
class Limits:
    """Limits of a job: ``seconds`` of time, ``memory_mb`` of its worker's memory; None: no limit."""

    seconds: float | None = None
    memory_mb: int | None = None


def attempt(job: Job, worker: str) -> Ended:
    """Run a job in this process; an exception becomes its end. If the process dies, the engine has to notice."""
    with contextlib.suppress(OSError):  # reset the peak of memory (Linux)
        Path("/proc/self/clear_refs").write_text("5")
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
        why = f"out of memory ({str(error) or 'no more'}): its process has a limit (--memory-limit)\n{where}"
    except Exception as error:
        why, is_bug = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:], True
    seconds, peak_mb = time.monotonic() - began, 0.0
    with contextlib.suppress(OSError, ValueError):
        (high,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
        peak_mb = round(int(high.split()[1]) * 1024 / 1e6, 1)
    return Ended(state, value, why, is_bug, seconds, peak_mb, worker, ends_all)


# ---------------------------------------------------------------- shards


T = TypeVar("T")
MOST = 100_000
LOCK = ".lock"


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1) of ``count``: a contiguous part of a plan's judged trials, and all hole-free trials that
    set its thresholds. Each shard begins these at a different place, so that shards in one folder share them."""

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> Shard:
        """Parse text such as ``3/10``. Raises UserError."""
        found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        shard = cls(int(found[1]), int(found[2])) if found else None
        if shard is None or not 1 <= shard.number <= shard.count <= MOST:
            raise UserError(f"--shard {text!r}: is not a part", legal=f"1/10 to 10/10, for up to {MOST} parts")
        return shard

    @property
    def is_whole(self) -> bool:
        """Return whether this part is the whole sweep."""
        return self.count == 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, total: int) -> range:
        """Return this shard's range of ``total`` items; the ranges of all shards cover each item exactly once."""
        return range((self.number - 1) * total // self.count, self.number * total // self.count)

    def rotated(self, items: Sequence[T]) -> list[T]:
        """Return all items, beginning at this shard's own starting point."""
        start = self.part(len(items)).start
        return [*items[start:], *items[:start]]


WHOLE = Shard()


@contextlib.contextmanager
def locked(folder: Path, shard: Shard = WHOLE) -> Iterator[None]:
    """Lock an existing folder: for a whole sweep exclusively, for shards together, but only once for each shard. Raises
    UserError if another process holds it. Systems without locks continue, with a warning on stderr."""
    with _held(folder / LOCK, shared=not shard.is_whole):
        if shard.is_whole:
            yield
        else:
            with _held(folder / f"{LOCK}-{shard.number}-of-{shard.count}", shared=False):
                yield


@contextlib.contextmanager
def _held(path: Path, *, shared: bool) -> Iterator[None]:
    with opened_lock(path) as file:
        answer = lock(file, shared=shared, wait=False)
        if answer == "busy":
            what = f"{path.parent}: another sweep is running in this folder"
            raise UserError(what, fix="wait for it, or name another folder with --out")
        if answer == "no locks":
            print(f"{path.parent}: cannot be locked on this system: do not start a second sweep in it", file=sys.stderr)
        yield


# ---------------------------------------------------------------- options


DEFAULT_LIMITS = Limits(seconds=900.0, memory_mb=4000)  # a trial needs seconds and 300 MB; maps of many views need 2 GB
LEAST_MEMORY_GB = 0.5  # a process that has loaded the code of trials needs 0.2 GB


@dataclass(frozen=True)
class EngineOptions:
    """``jobs``: processes, or a cluster's workers. ``scheduler`` None: this machine. ``serial``: in this process."""

    jobs: int = 2
    limits: Limits = DEFAULT_LIMITS
    scheduler: str | None = None
    serial: bool = False
    shard: Shard = WHOLE
    retry_failed: bool = False
    cache_limit_gb: float | None = None


def engine_of(options: EngineOptions, detectors: Iterable[str] = (), folder: Path = Path()) -> JobEngine:
    """Return the engine, not yet started, for trials of ``detectors``. ``folder``: of renders. Raises UserError."""
    from harness.engine.processes import LocalEngine, SerialEngine

    if options.serial:
        return SerialEngine()
    if options.scheduler is None:
        return LocalEngine(options.jobs, options.limits, code_of(detectors))
    from harness.engine.cluster import ClusterEngine

    return ClusterEngine(options.scheduler, options.limits, options.jobs, code_of(detectors), folder)


def code_of(detectors: Iterable[str]) -> dict[Stage, Code]:
    """Return the code that determines the results of each stage, for trials of these ``detectors``."""
    from harness.engine.plan import PACKAGES, trial_code
    from scenes.render import cache

    modules = {module for detector in detectors for module in trial_code(detector)}
    return {"trials": (tuple(sorted(modules)), PACKAGES), "renders": (cache.CODE, cache.PACKAGES)}


def add_engine_options(parser: argparse.ArgumentParser) -> None:
    """Add these options to a parser, in their own group."""
    add = parser.add_argument_group("execution").add_argument
    processes = "processes, or workers of a cluster (default: 2)"
    add("--jobs", type=whole_number(4096), default=2, metavar="N", help=processes)
    add("--serial", action="store_true", help="run everything in this process, for a debugger; without limits")
    help = "run on a Dask cluster: tcp://host:8786, or jobqueue:slurm and the like as your Dask configuration has it"
    add("--scheduler", metavar="ADDRESS", help=help)
    add("--shard", metavar="K/N", help="run part K of N only, such as 3/10; python -m harness.merge joins them")
    add("--retry-failed", action="store_true", help="run again the trials that failed, crashed or timed out before")
    for name, unit, default, meaning in (
        ("--time-limit", "SECONDS", 900.0, "time that one trial or render may take"),
        ("--memory-limit", "GB", 4.0, "memory that a trial's process may use, also on a cluster"),
        ("--cache-limit", "GB", 20.0, "size of all stored renders; the least recently used are removed first"),
    ):
        add(name, type=_positive, default=default, metavar=unit, help=f"{meaning} (default: {default:g})")


def engine_options(options: argparse.Namespace) -> EngineOptions:
    """Return the options that were given. Raises UserError if they contradict each other."""
    if options.serial and options.scheduler is not None:
        raise UserError("--serial and --scheduler: ask for different engines", fix="leave one of them out")
    if options.memory_limit < LEAST_MEMORY_GB:
        legal = f"{LEAST_MEMORY_GB:g} GB or more; 1 GB is enough for most trials"
        what = f"--memory-limit {options.memory_limit:g}: a process needs more than that to start"
        raise UserError(what, legal=legal)
    limits = Limits(options.time_limit, round(1000 * options.memory_limit))
    shard = WHOLE if options.shard is None else Shard.of(options.shard)
    where = (options.scheduler, options.serial, shard, options.retry_failed, options.cache_limit)
    return EngineOptions(options.jobs, limits, *where)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
