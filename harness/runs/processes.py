"""Runs jobs in processes of this machine. A process that dies, hangs or needs too much memory
fails only its own job.

The standard library's executors fail all jobs if a process dies; here, a thread serves each
process through a pipe."""

from __future__ import annotations

import contextlib
import faulthandler
import importlib
import os
import pickle
import queue
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

from harness.runs.jobs import TRACEBACK_CHARACTERS, Code, Ended, Job, Limits, Stage, attempt
from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import (
    first_content,
    imported_sources,
    reached_sources,
    source_digest,
)

ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}
"""Each process uses one thread, so that sums are taken in the same order on every machine and
processes do not compete for cores. Libraries read these variables when they are loaded."""
MOST_RENDERERS = 2  # processes that render; each needs 2 GB
LOOKS_S = 1.0  # interval at which the driver checks the clock
# time for a process to load its modules: normally seconds, but longer from a network's disk
START_S = 300.0
# time for a hanging process to write its traceback; the signal handler needs a millisecond
DUMP_S = 0.3
# if a wait takes longer than `LOOKS_S` by this time, the machine or process was suspended (Ctrl-Z)
STOPPED_S = 2.0
IDLE_S: dict[Stage, float] = {
    "trials": 300.0,
    "renders": 10.0,
}  # idle processes end then; renderers hold 2 GB
FALSE_STARTS = 3  # give up after this many processes in a row died before they could take a job
_STARTING = threading.Lock()
PROCESSES = system.forked_processes()
TRIALS = "harness.trials.trial"
RENDERS = "scenes.render.view"
"""What processes for trials and for renders need; the latter loads SciPy's statistics."""
NOT_TO_FORK = ("drjit", "open3d")
"""Packages that a process must load in their order (`scenes.render.scene`), and by itself."""


def start_server(preloaded: Sequence[str]) -> None:
    """Start the server process of `PROCESSES` with these modules, unless it runs or there is
    none."""
    with _starting():
        system.start_fork_server(preloaded, NOT_TO_FORK, _forget_sources)


def _forget_sources() -> None:
    """Let forks see sources as they are when they start, as new processes do."""
    for known in (source_digest, reached_sources, imported_sources, first_content):
        known.cache_clear()


@dataclass(eq=False)
class Answers:
    """Queue for the ends of jobs, or for an error that ends all of them. ``is_dropped``: it is no
    longer read."""

    ended: queue.SimpleQueue[tuple[Job, Ended] | UserError] = field(
        default_factory=queue.SimpleQueue
    )
    is_dropped: bool = False


class LocalEngine:
    """Runs jobs in ``jobs`` processes for trials and up to two for renders, which load Mitsuba.
    ``limits`` hold for trials; renders have no memory limit, because Dr.Jit reserves more than it
    uses. ``code``: modules that determine a stage's results. A process that starts after an edit
    of their sources is refused: its results would differ. ``renders``: whether any are to be
    expected; if not, their modules are loaded only when one comes. ``further``: modules that other
    jobs need, such as statistics, which are then loaded once and not by each process."""

    def __init__(
        self,
        jobs: int,
        limits: Limits,
        code: Mapping[Stage, Code] | None = None,
        *,
        renders: bool = True,
        further: Sequence[str] = (),
    ) -> None:
        self.code = dict(code or {})
        self.digests = {stage: source_digest(*code) for stage, code in self.code.items()}
        self.false_starts = 0
        self.is_over = False
        self.trace_files: tempfile.TemporaryDirectory[str]
        self._preloaded = (TRIALS, *([RENDERS] if renders else []), *further)
        self._limits = limits
        self._most: dict[Stage, int] = {"trials": jobs, "renders": min(jobs, MOST_RENDERERS)}
        self._waiting: dict[Stage, deque[tuple[Job, Limits, Answers]]] = {
            "trials": deque(),
            "renders": deque(),
        }
        self._state = threading.Condition()
        self._workers: list[_Worker] = []
        self._answers = Answers()
        self._out: Counter[Stage] = Counter()

    def __enter__(self) -> LocalEngine:
        start_server(self._preloaded)
        self.trace_files = tempfile.TemporaryDirectory(prefix="tofpod-", ignore_cleanup_errors=True)
        return self

    def __exit__(self, *error: object) -> None:
        with self._state:
            self.is_over = True
            for worker in self._workers:
                worker.strike()
            self._state.notify_all()
        for worker in self._workers:
            worker.join(timeout=1.0)
        self.trace_files.cleanup()

    def room(self, stage: Stage) -> int:
        """Return the room for two jobs per process, so that none waits while the driver stores a
        result."""
        return 2 * self._most[stage] - self._out[stage]

    def submit(self, job: Job) -> None:
        """Take a job. Submit no more than there is `room` for."""
        self._out[job.stage] += 1
        self.put(job, self._limits, self._answers)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end. Raises UserError if processes run other code or cannot start."""
        ended_jobs: list[tuple[Job, Ended]] = []
        while not ended_jobs or not self._answers.ended.empty():
            answer = self._answers.ended.get()
            if isinstance(answer, UserError):
                raise answer
            job, ended = answer
            self._out[job.stage] -= 1
            ended_jobs.append((job, ended))
        return ended_jobs

    def put(self, job: Job, limits: Limits, answers: Answers) -> None:
        """Queue a job whose end goes into ``answers``; from any thread."""
        stage = job.stage
        with self._state:
            self._waiting[stage].append(
                (job, limits if stage == "trials" else Limits(limits.seconds), answers)
            )
            stage_workers = [worker for worker in self._workers if worker.stage == stage]
            idle = sum(worker.holds is None for worker in stage_workers)
            if idle < len(self._waiting[stage]) and len(stage_workers) < self._most[stage]:
                self._workers.append(_Worker(self, stage, len(self._workers)))
                self._workers[-1].start()
            self._state.notify_all()

    def drop(self, answers: Answers) -> None:
        """End the jobs whose results are no longer needed."""
        with self._state:
            answers.is_dropped = True
            for worker in self._workers:
                if worker.holds is answers:
                    worker.strike()
        answers.ended.put(UserError("these jobs are no longer awaited"))

    def next_job(self, worker: _Worker) -> tuple[Job, Limits, Answers] | None:
        """Wait for a worker's next job; end its process if idle for long. Return None if there are
        no more jobs."""
        waiting = self._waiting[worker.stage]
        with self._state:
            worker.holds = None
            while not self.is_over:
                if not self._state.wait_for(lambda: waiting or self.is_over, IDLE_S[worker.stage]):
                    worker.end()
                elif waiting:
                    taken = waiting.popleft()
                    worker.holds = taken[2]
                    return taken
            return None


class _Worker(threading.Thread):
    """A thread that serves one process after another through a pipe. ``holds``: the queue for its
    job's end."""

    def __init__(self, engine: LocalEngine, stage: Stage, number: int) -> None:
        super().__init__(daemon=True)
        self.stage = stage
        self._engine = engine
        self.holds: Answers | None = None
        self._label = f"{stage} process {number}"
        self._process: Any = None
        self._pipe: Connection[Any, Any]
        self._trace = Path(engine.trace_files.name) / str(number)

    def run(self) -> None:
        while (taken := self._engine.next_job(self)) is not None:
            job, limits, answers = taken
            try:
                answers.ended.put((job, self._carried_out(job, limits, answers)))
            except UserError as mistake:
                self.end()
                answers.ended.put(mistake)
            except Exception as error:  # a bug here must not block the driver
                why = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:]
                answers.ended.put((job, Ended("failed", why=why, is_bug=True)))
        self.end()

    def _carried_out(self, job: Job, limits: Limits, answers: Answers) -> Ended:
        """Run a job and return its end, which may be the death of the process or the time limit."""
        if (
            self._process is not None and self._pipe.poll()
        ):  # an idle process sends nothing: it has died
            self.end()
        while self._process is None:
            if answers.is_dropped or self._engine.is_over:
                return Ended("crashed", why="it is no longer awaited")
            self._start()
        with contextlib.suppress(OSError):  # a dead process does not answer either
            self._pipe.send((job, limits.memory_mb))
        ended: Ended = self._answer(limits.seconds)
        if ended.state in ("crashed", "timed out"):
            self.end()
        return ended

    def _start(self) -> None:
        """Start a process that can take jobs. Raises UserError if it runs other sources or no
        process can start."""
        engine = self._engine
        self._pipe, child = PROCESSES.Pipe()
        arguments = (
            child,
            self._label,
            self.stage,
            str(self._trace),
            engine.code.get(self.stage),
            dict(os.environ),
        )
        process = PROCESSES.Process(target=serve, args=arguments, daemon=True)
        with _starting(), contextlib.suppress(OSError, EOFError):  # the server process has died
            process.start()
            self._process = process
        child.close()
        if engine.is_over:
            self.strike()
        digest = self._answer(START_S)
        if isinstance(digest, Ended):
            self.end()
            engine.false_starts += 1
            if engine.false_starts >= FALSE_STARTS:
                message = (
                    f"{FALSE_STARTS} worker processes in a row died as they started: {digest.why}"
                )
                fix = (
                    "run the same command again, with fewer --jobs if memory is short, or a "
                    "higher --memory-limit"
                )
                raise UserError(
                    message,
                    legal="about 1 GB of memory per process for trials, 2 GB for renders",
                    fix=fix,
                )
            return
        engine.false_starts = 0
        if digest != engine.digests.get(self.stage):
            message = (
                f"the code of {self.stage} was edited while this sweep ran: a new process has "
                "loaded other sources"
            )
            raise UserError(
                message,
                fix="run the same command again: the trials that are left run by the new code",
            )

    def _answer(self, limit_s: float | None) -> Any:
        """Return the next message, or an `Ended` if none comes. Time while the machine is
        suspended does not count."""
        began = time.monotonic()
        left_s = float("inf") if limit_s is None else limit_s
        while left_s > 0:
            waiting_since = time.monotonic()
            waits_s = min(left_s, LOOKS_S)
            try:
                if self._pipe.poll(waits_s):
                    return self._pipe.recv()
            except (EOFError, OSError):
                return Ended(
                    "crashed",
                    why=self._last_words(),
                    seconds=time.monotonic() - began,
                    worker=self._label,
                )
            spent_s = time.monotonic() - waiting_since
            if spent_s > waits_s + STOPPED_S:
                began = began + spent_s - waits_s
                spent_s = waits_s
            left_s -= spent_s
        where = "a place that is not known"
        with contextlib.suppress(OSError):
            system.ask_for_stack(self._process.pid)
            time.sleep(DUMP_S)
            where = self._trace_text() or where
        why = f"not done after {limit_s:.3g} s (--time-limit); it was at:\n{where}"
        return Ended("timed out", why=why, seconds=time.monotonic() - began, worker=self._label)

    def _last_words(self) -> str:
        """Return the cause of the process's death, as far as it is known."""
        if self._process is None:
            return "the process that it forks from has died"
        self._process.join(timeout=1.0)
        why = system.cause_of_end(self._process.exitcode)
        trace = self._trace_text() if self._trace.exists() else ""
        return why + (f"\n{trace}" if trace else "")

    def _trace_text(self) -> str:
        """Return the end of what the process wrote of its crash or hang."""
        return self._trace.read_text(encoding="utf-8")[-TRACEBACK_CHARACTERS:]

    def strike(self) -> None:
        """Kill the process without waiting; from any thread."""
        if (process := self._process) is not None:
            process.kill()

    def end(self) -> None:
        """Kill the process and wait; called by its own thread."""
        if self._process is not None:
            self._process.kill()
            self._process.join(timeout=1.0)
            self._pipe.close()
            self._process = None


@contextlib.contextmanager
def _environment(stated: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for a while: processes inherit them at their start, libraries read
    them when loaded."""
    before = {name: os.environ.get(name) for name in stated}
    os.environ.update(stated)
    try:
        yield
    finally:
        for name, text in before.items():
            os.environ.pop(name)
            os.environ.update({} if text is None else {name: text})


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, even from a dask worker, which is a daemon."""
    found = {"PYTHONPATH": system.search_path(), "PYTHONSAFEPATH": "1"}
    with _STARTING, _environment(ONE_THREAD | found), system.starting_processes():
        yield


# ---------------------------------------------------------------- in the process


def serve(
    pipe: Connection[Any, Any],
    name: str,
    stage: Stage,
    trace: str,
    code: Code | None,
    environment: dict[str, str],
) -> None:
    """Run jobs until the driver closes the pipe. ``trace``: path of a file for the reason if it is
    killed."""
    os.environ.clear()
    os.environ.update(environment | ONE_THREAD)
    file = _prepare(trace)
    try:
        if stage == "trials":  # before the time limit starts to count
            import cv2

            import harness.trials.trial  # noqa: F401

            cv2.setNumThreads(1)
            # load plug-ins now, so that the digest is that of the code that runs
            for module in code[0] if code else ():
                importlib.import_module(module)
        pipe.send(source_digest(*code) if code else None)
    except BaseException:
        traceback.print_exc(file=file)
        file.flush()
        os._exit(1)
    with contextlib.suppress(EOFError, OSError):
        while True:
            job, memory_mb = pipe.recv()
            system.limit_private_memory(None if memory_mb is None else memory_mb * 1_000_000)
            began_s = time.process_time()
            ended = attempt(job, name)
            ended = replace(ended, processor_s=time.process_time() - began_s)
            try:
                pipe.send(ended)
            except (TypeError, AttributeError, pickle.PicklingError) as error:
                pipe.send(
                    Ended(
                        "failed",
                        why=f"its result cannot be sent: {error}",
                        is_bug=True,
                        worker=name,
                    )
                )


def _prepare(trace: str) -> IO[str]:
    """Ignore Ctrl-C, end together with the driver, and write where a crash or hang occurs to the
    file ``trace``."""
    system.end_with_parent()
    system.ignore_interrupts()
    file = open(trace, "w", encoding="utf-8")  # noqa: SIM115 (open as long as the process lives)
    faulthandler.enable(file)
    system.dump_stack_when_asked(file)
    return file


def render_into_cache(
    target_data: dict[str, Any],
    camera_data: dict[str, Any],
    render_data: dict[str, Any],
    folder: str,
) -> tuple[bool, float]:
    """Render a view unless it is cached; only this loads Mitsuba. Return whether it was cached,
    and the seconds."""
    from scenes.optics import RenderConfig
    from scenes.render.cache import cached_view
    from scenes.sensor.camera import camera_of
    from scenes.sensor.common.config import CameraConfig
    from scenes.target.custom import TargetConfig

    target = TargetConfig.from_data(target_data)
    optics = camera_of(CameraConfig.from_data(camera_data)).optics
    view, was_stored = cached_view(
        target, optics, RenderConfig.from_data(render_data), Path(folder)
    )
    if (
        "drjit" in sys.modules
    ):  # threads wait busily: from the second render on, a process gets its share
        sys.modules["drjit"].set_thread_count(max((os.cpu_count() or 1) // MOST_RENDERERS, 1))
    return was_stored, view.seconds


class SerialEngine:
    """Runs one job at a time in this process, for debuggers and tests, without limits or
    protection against hangs."""

    def __init__(self) -> None:
        self._jobs: deque[Job] = deque()
        self._pinned = contextlib.ExitStack()

    def __enter__(self) -> SerialEngine:
        import cv2
        from threadpoolctl import threadpool_limits

        # libraries that load later read the environment; those already loaded are limited here
        self._pinned.enter_context(_environment(ONE_THREAD))
        self._pinned.enter_context(threadpool_limits(1))
        self._pinned.callback(cv2.setNumThreads, cv2.getNumThreads())
        cv2.setNumThreads(1)
        return self

    def __exit__(self, *error: object) -> None:
        self._jobs.clear()
        self._pinned.close()

    def room(self, stage: Stage) -> int:
        """Return 1 if there is no job, whatever the stage."""
        return 1 - len(self._jobs)

    def submit(self, job: Job) -> None:
        """Take a job; it runs in `ended`."""
        self._jobs.append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Run the next job."""
        job = self._jobs.popleft()
        if job.stage == "renders":
            # Mitsuba must be loaded before Open3D in one process (`scenes.render.scene`)
            from scenes.render.scene import load_mitsuba

            load_mitsuba()
        return [(job, attempt(job, "this process"))]
