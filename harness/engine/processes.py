"""Processes of this machine, one job at a time each: a process that dies, hangs or eats memory costs its own job only.

The executors of the standard library give up all their jobs when one of their processes dies; here every process has a
pipe of its own, so who held which job is known.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, Any

from harness.engine.work import TRACEBACK_CHARACTERS, Code, Ended, Job, Limits, Stage, attempt
from harness.vocabulary.errors import UserError
from harness.vocabulary.sources import source_digest

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One thread a process: sums are then in one order on every machine, and processes do not fight for cores."""
MOST_RENDERERS = 2
"""Processes that render, of 2 GB each."""
PR_SET_PDEATHSIG = 1
"""Of Linux' prctl(2)."""
LOOKS_S = 1.0
"""Between looks whether the driver is still there."""
START_S = 300.0
"""For a process to load what it needs; seconds, but from a network's disk."""
DUMP_S = 0.3
"""What a process that hangs is given to say where; its own signal handler needs a millisecond."""
SHORT_S = 0.5
"""A process whose jobs are shorter has its next one ready, so that it need not wait while the driver files the last;
with longer ones the end of a sweep would wait for jobs that are spread unevenly."""
STOPPED_S = 2.0
"""A wait of `LOOKS_S` that takes so much longer was not spent waiting: Ctrl-Z, a suspended machine."""
FALSE_STARTS = 3
"""Processes in a row that died before they could take a job: then none will."""


class LocalEngine:
    """``jobs`` processes for trials, and up to two for renders, which alone load Mitsuba. ``limits`` are a trial's;
    renders have no limit of memory, as Dr.Jit reserves more than it uses. ``code``: modules that decide the numbers of
    a stage; a process that starts after one of their sources was edited is refused, because its results would be stored
    as those of the code that this process runs."""

    def __init__(self, jobs: int, limits: Limits, code: Mapping[Stage, Code] | None = None) -> None:
        self._code = code or {}
        self._digests = {stage: source_digest(*which) for stage, which in self._code.items()}
        self._most: dict[Stage, int] = {"trials": jobs, "renders": min(jobs, MOST_RENDERERS)}
        self._limits: dict[Stage, Limits] = {"trials": limits, "renders": Limits(limits.seconds, None)}
        self._workers: dict[Stage, list[_Worker]] = {"trials": [], "renders": []}
        self._false_starts = 0
        self._said: tempfile.TemporaryDirectory[str]
        self._number = 0

    def __enter__(self) -> LocalEngine:
        self._said = tempfile.TemporaryDirectory(prefix="tofpod-")
        return self

    def __exit__(self, *error: object) -> None:
        everyone = [worker for workers in self._workers.values() for worker in workers]
        for worker in everyone:
            worker.strike()
        for worker in everyone:
            worker.kill()
        self._said.cleanup()

    def room(self, stage: Stage) -> int:
        """Free processes, those not yet started among them; and the next jobs of those that are soon free."""
        workers = self._workers[stage]
        free = self._most[stage] - sum(worker.job is not None for worker in workers)
        return free + sum(worker.is_quick and worker.next_job is None for worker in workers if worker.job is not None)

    def submit(self, job: Job) -> None:
        """Hand a job to a process. Only as many as there is `room` for."""
        workers = self._workers[job.stage]
        for dead in [worker for worker in workers if worker.job is None and not worker.is_alive()]:
            self._remove(dead)
        free = next((worker for worker in workers if worker.job is None), None)
        if free is None and len(workers) == self._most[job.stage]:
            soon = next(worker for worker in workers if worker.is_quick and worker.next_job is None)
            soon.next_job = job
            return
        if free is None:
            free = self._started(job.stage)
            workers.append(free)
        free.take(job)

    def _started(self, stage: Stage) -> _Worker:
        self._number += 1
        name = f"{stage} process {self._number}"
        said = Path(self._said.name) / str(self._number)
        return _Worker(name, stage, self._limits[stage], said, self._code.get(stage))

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end, or to reach their time limit."""
        ended: list[tuple[Job, Ended]] = []
        while not ended and (busy := self._busy()):
            pipes = {worker.pipe: worker for worker in busy}
            asked = time.monotonic()
            heard = wait(list(pipes), timeout=min(_soonest(busy), LOOKS_S))
            stopped_s = time.monotonic() - asked - LOOKS_S
            if stopped_s > STOPPED_S:
                for worker in busy:
                    worker.forgive(stopped_s)
            for pipe in heard:
                ended += self._heard(pipes[pipe])  # type: ignore[index]
            for worker in [one for one in self._busy() if one.left_s() <= 0]:
                ended += self._overdue(worker)
        self._end_idle_renderers()
        return ended

    def _busy(self) -> list[_Worker]:
        return [worker for workers in self._workers.values() for worker in workers if worker.job is not None]

    def _heard(self, worker: _Worker) -> Iterator[tuple[Job, Ended]]:
        """What a process has to say: that it is ready, how its job ended, or nothing more ever."""
        job = worker.job
        assert job is not None
        try:
            said = worker.hear()
        except (EOFError, OSError):
            words = worker.last_words()
            self._remove(worker)
            if worker.is_ready:
                yield job, Ended("crashed", why=words, seconds=worker.spent_s(), worker=worker.name)
                self._pass_on(worker)
            else:
                self._start_again(job, words)
            return
        if not isinstance(said, Ended):
            self._refuse_other_code(worker.stage, said.code)
            self._false_starts = 0
            return
        worker.job = None
        if worker.next_job is not None:
            worker.take(worker.next_job)
            worker.next_job = None
        yield job, said

    def _refuse_other_code(self, stage: Stage, digest: str | None) -> None:
        """Raise UserError where a process runs other sources than this one."""
        if digest != self._digests.get(stage):
            raise UserError(
                f"the code of {stage} was edited while this sweep ran: a new process has loaded other sources",
                legal="one version of the code for all trials of a sweep",
                fix="run the same command again: trials of the old code are kept under its key, the others run anew",
            )

    def _start_again(self, job: Job, words: str) -> None:
        """A process that died before it could begin: another gets the job, unless none seems to be able to start."""
        self._false_starts += 1
        if self._false_starts >= FALSE_STARTS:
            raise UserError(
                f"{FALSE_STARTS} worker processes in a row died as they started: {words}",
                legal="trials need about 1 GB of memory a process, renders 2 GB",
                fix="run the same command again (finished trials are kept), with fewer --jobs if memory is short, or a"
                " higher --memory-limit",
            )
        self.submit(job)

    def _overdue(self, worker: _Worker) -> Iterator[tuple[Job, Ended]]:
        job, seconds = worker.job, worker.spent_s()
        assert job is not None
        where = worker.where_it_hangs()
        self._remove(worker)
        if not worker.is_ready:
            self._start_again(job, f"not ready after {seconds:.0f} s; it was at:\n{where}")
            return
        self._pass_on(worker)
        why = f"not done after {seconds:.3g} s (--time-limit); it was at:\n{where}"
        yield job, Ended("timed out", why=why, seconds=seconds, worker=worker.name)

    def _pass_on(self, worker: _Worker) -> None:
        """The next job of a process that is gone, which it never saw."""
        if worker.next_job is not None:
            self.submit(worker.next_job)

    def _remove(self, worker: _Worker) -> None:
        worker.kill()
        for workers in self._workers.values():
            if worker in workers:
                workers.remove(worker)

    def _end_idle_renderers(self) -> None:
        """Where trials run and nothing is left to render, 2 GB each are of more use elsewhere."""
        renderers = self._workers["renders"]
        if all(worker.job is None for worker in renderers):
            for worker in [one for one in renderers if one.idle_s() > LOOKS_S]:
                self._remove(worker)


def _soonest(busy: list[_Worker]) -> float:
    """Seconds to the next time limit, endless where there is none."""
    return max(min(worker.left_s() for worker in busy), 0.0)


@dataclass(frozen=True)
class _Ready:
    """A process can take jobs. ``code``: digest of the sources that it has loaded, where it was asked for."""

    code: str | None


class _Worker:
    """One process with its pipe; ``job`` is what it is at, ``next_job`` what it gets then. ``is_quick``: whether its
    last job was."""

    def __init__(self, name: str, stage: Stage, limits: Limits, said: Path, code: Code | None) -> None:
        self.name = name
        self.stage = stage
        self.job: Job | None = None
        self.next_job: Job | None = None
        self.is_quick = False
        self.is_ready = False
        self._limits = limits
        self._said = said
        self._since = time.monotonic()
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        with one_thread(), _without_interrupts():
            self._process = context.Process(
                target=_serve, args=(theirs, name, stage, limits.memory_mb, str(said), code), name=name, daemon=True
            )
            self._process.start()
        theirs.close()

    def is_alive(self) -> bool:
        """Whether its process still runs."""
        return self._process.is_alive()

    def take(self, job: Job) -> None:
        """Begin a job. A process that is dead by now is noticed when its answer is awaited."""
        self.job = job
        self._since = time.monotonic()
        with contextlib.suppress(OSError):
            self.pipe.send(job)

    def hear(self) -> Ended | _Ready:
        """How the job ended, or that the process is ready, from when on time counts."""
        said: Ended | _Ready = self.pipe.recv()
        if isinstance(said, _Ready):
            self.is_ready = True
        else:
            self.is_quick = said.seconds < SHORT_S
        self._since = time.monotonic()
        return said

    def spent_s(self) -> float:
        """On this job."""
        return time.monotonic() - self._since

    def forgive(self, seconds: float) -> None:
        """Do not count time in which everything stood still."""
        self._since += seconds

    def idle_s(self) -> float:
        """Since the last job ended."""
        return 0.0 if self.job is not None else self.spent_s()

    def left_s(self) -> float:
        """To the time limit, endless without one; while the process starts, to the end of what that may take."""
        if not self.is_ready:
            return START_S - self.spent_s()
        return float("inf") if self._limits.seconds is None else self._limits.seconds - self.spent_s()

    def where_it_hangs(self) -> str:
        """The end of the process' traceback, by its own signal handler."""
        if self._process.pid is not None and hasattr(signal, "SIGUSR1"):
            with contextlib.suppress(OSError):
                os.kill(self._process.pid, signal.SIGUSR1)
                time.sleep(DUMP_S)
                return self._said.read_text()[-TRACEBACK_CHARACTERS:]
        return "a place that it could not tell"

    def last_words(self) -> str:
        """Why the process died, as far as can be known."""
        self._process.join(timeout=1.0)
        code = self._process.exitcode
        said = self._said.read_text()[-TRACEBACK_CHARACTERS:] if self._said.exists() else ""
        if code is not None and code < 0:
            name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
            hint = ": by hand, or by the system as memory ran out" if name == "SIGKILL" else ""
            return f"its process was ended by {name}{hint}" + (f"\n{said}" if said else "")
        return f"its process ended itself with code {code}" + (f"\n{said}" if said else "")

    def strike(self) -> None:
        """Begin to end the process, without waiting for it."""
        self._process.kill()

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join(timeout=1.0)
        self.pipe.close()


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """The environment that a process of one thread starts in; libraries read it when they are loaded."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """A process that is started here does not hear Ctrl-C, not even before it can say so itself."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(
    pipe: Connection[Any, Any], name: str, stage: Stage, memory_mb: int | None, said: str, code: Code | None
) -> None:
    """Of a worker: jobs one after another until the driver closes the pipe."""
    words = _serve_the_driver(said)
    try:
        if memory_mb is not None:
            limit_memory(memory_mb)
        if stage == "trials":
            _load_what_trials_need()
        # plug-ins are loaded now, so that the digest is that of what will run
        for module in code[0] if code and stage == "trials" else ():
            importlib.import_module(module)
        pipe.send(_Ready(source_digest(*code) if code else None))
    except BaseException:
        traceback.print_exc(file=words)
        words.flush()
        os._exit(1)
    with contextlib.suppress(EOFError, OSError):
        while True:
            pipe.send(attempt(pipe.recv(), name))


def _load_what_trials_need() -> None:
    """Before time counts."""
    import cv2

    import harness.engine.trial  # noqa: F401

    cv2.setNumThreads(1)


def _serve_the_driver(said: str) -> IO[str]:
    """Ctrl-C is the driver's to hear; without a driver there is nothing to do; crashes and hangs tell where."""
    import faulthandler

    _die_with_the_driver()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    words = open(said, "w")  # noqa: SIM115 (open as long as the process lives)
    faulthandler.enable(words)
    if hasattr(faulthandler, "register"):
        faulthandler.register(signal.SIGUSR1, words, all_threads=False)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    return words


def _die_with_the_driver() -> None:
    """Let the system end this process with its parent, even one that never lets Python run (Linux)."""
    if not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _end_with(driver: int) -> None:
    """End this process soon after its parent is another than ``driver``: a killed driver cannot tell its workers."""
    while os.getppid() == driver:
        time.sleep(LOOKS_S)
    os._exit(1)


def limit_memory(memory_mb: int) -> None:
    """Let allocations beyond so much private memory of this process fail (Linux; elsewhere nothing happens)."""
    try:
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (memory_mb * 1_000_000, memory_mb * 1_000_000))
    except (ImportError, ValueError, OSError):
        pass
