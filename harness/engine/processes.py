"""Jobs in processes of this machine: a process that dies, hangs or needs too much memory fails its own job only.

The executors of the standard library give up all their jobs when one of their processes dies. Here a thread serves each
process through a pipe of its own, so that it is known which job a process held. A cluster's nodes use the same class.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import multiprocessing
import os
import pickle
import queue
import signal
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

from harness.engine.work import TRACEBACK_CHARACTERS, Code, Ended, Job, Limits, Stage, attempt
from harness.vocabulary.errors import UserError
from harness.vocabulary.sources import source_digest

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One thread a process: sums then have one order on every machine, and processes do not compete for cores."""
MOST_RENDERERS = 2
"""Processes that render, of 2 GB each."""
PR_SET_PDEATHSIG = 1
"""An option of Linux' prctl(2)."""
LOOKS_S = 1.0
"""Interval at which a driver's clock and a process' parent are looked at."""
START_S = 300.0
"""Time for a process to load what it needs: seconds, but from a network's disk more."""
DUMP_S = 0.3
"""Time that a hanging process gets to write its traceback; its signal handler needs a millisecond."""
SHORT_S = 0.5
"""Jobs shorter than this are queued one ahead for each process, so that none waits while the driver stores a result."""
STOPPED_S = 2.0
"""A wait of `LOOKS_S` that takes so much longer was no waiting: Ctrl-Z, or a suspended machine."""
IDLE_S: dict[Stage, float] = {"trials": 300.0, "renders": 10.0}
"""Processes without a job for so long end: those that render hold 2 GB."""
FALSE_STARTS = 3
"""Processes in a row that died before they could take a job: then none will start."""


@dataclass(eq=False)
class Answers:
    """The queue in which somebody awaits the ends of jobs, or the error that ends all. ``is_dropped``: nobody does."""

    ended: queue.SimpleQueue[tuple[Job, Ended] | UserError] = field(default_factory=queue.SimpleQueue)
    is_dropped: bool = False


class LocalEngine:
    """``jobs`` processes for trials, and up to two for renders, which alone load Mitsuba. ``limits`` are a trial's;
    renders have no memory limit, as Dr.Jit reserves more than it uses. ``code``: modules that decide the numbers of
    a stage; a process that starts after one of their sources was edited is refused, because its results would be stored
    as those of the code that this process runs. ``sent_views``: as `harness.engine.setup.sent_views`."""

    def __init__(
        self, jobs: int, limits: Limits, code: Mapping[Stage, Code] | None = None, sent_views: Path | None = None
    ) -> None:
        self._code = code or {}
        self._digests = {stage: source_digest(*which) for stage, which in self._code.items()}
        self._most: dict[Stage, int] = {"trials": jobs, "renders": min(jobs, MOST_RENDERERS)}
        self._limits, self._sent_views = limits, sent_views
        self._waiting: dict[Stage, deque[tuple[Job, Limits, Answers]]] = {"trials": deque(), "renders": deque()}
        self._state = threading.Condition()
        self._idle: Counter[Stage] = Counter()
        """Threads that wait for a job."""
        self._processes: dict[threading.Thread, tuple[Stage, _Process | None, Answers | None]] = {}
        self._answers = Answers()
        self._out: Counter[Stage] = Counter()
        self._is_quick: dict[Stage, bool] = {}
        self._false_starts = self._number = 0
        self._is_over = False
        self._said: tempfile.TemporaryDirectory[str]

    def __enter__(self) -> LocalEngine:
        self._said = tempfile.TemporaryDirectory(prefix="tofpod-", ignore_cleanup_errors=True)
        return self

    def __exit__(self, *error: object) -> None:
        with self._state:
            self._is_over = True
            processes = [process for _, process, _ in self._processes.values() if process is not None]
            for process in processes:
                process.strike()
            self._state.notify_all()
        for process in processes:
            process.wait()
        self._said.cleanup()

    def room(self, stage: Stage) -> int:
        """Processes without a job, those not yet started included; with short jobs also a next job for each."""
        return self._most[stage] * (2 if self._is_quick.get(stage) else 1) - self._out[stage]

    def submit(self, job: Job) -> None:
        """Take a job. Not more than there is `room` for."""
        self._out[job.stage] += 1
        self.put(job, self._limits, self._answers)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end. Raises UserError where processes run other code or cannot start."""
        said = [self._answers.ended.get()]
        with contextlib.suppress(queue.Empty):
            while True:
                said.append(self._answers.ended.get_nowait())
        found = []
        for one in said:
            if isinstance(one, UserError):
                raise one
            job, ended = one
            self._out[job.stage] -= 1
            self._is_quick[job.stage] = ended.seconds < SHORT_S
            found.append((job, ended))
        return found

    def put(self, job: Job, limits: Limits, answers: Answers) -> None:
        """Queue a job whose end goes into ``answers``; from any thread."""
        stage = job.stage
        with self._state:
            self._waiting[stage].append((job, limits if stage == "trials" else Limits(limits.seconds), answers))
            threads = sum(of == stage for of, _, _ in self._processes.values())
            if self._idle[stage] < len(self._waiting[stage]) and threads < self._most[stage]:
                thread = threading.Thread(target=self._serve, args=(stage,), daemon=True)
                self._processes[thread] = (stage, None, None)
                thread.start()
            self._state.notify_all()

    def drop(self, answers: Answers) -> None:
        """End the jobs whose end nobody awaits any more."""
        with self._state:
            answers.is_dropped = True
            for _, process, holder in self._processes.values():
                if holder is answers and process is not None:
                    process.strike()
        answers.ended.put(UserError("nobody awaits these jobs any more"))

    # ---------------------------------------------------------------- one thread for each process

    def _serve(self, stage: Stage) -> None:
        process: _Process | None = None
        while (taken := self._next(stage, process)) is not None:
            job, limits, answers = taken
            if process is not None and (job is None or not process.is_alive()):
                process.kill()
                process = None
            while job is not None and not answers.is_dropped and not self._is_over:
                try:
                    process = process or self._started(stage, answers)
                    if not process.is_ready:
                        self._check_code(stage, process.wait_until_ready())
                    answers.ended.put((job, process.carry_out(job, limits)))
                except _NotStarted as error:
                    process, mistake = None, self._false_start(str(error))
                    if mistake is None:
                        continue  # another process gets the job
                    answers.ended.put(mistake)
                except UserError as mistake:
                    if process is not None:
                        process.kill()
                        process = None
                    answers.ended.put(mistake)
                except Exception as error:  # a bug here must not leave the driver waiting
                    why = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:]
                    answers.ended.put((job, Ended("failed", why=why, is_bug=True)))
                break
        if process is not None:
            process.kill()

    def _next(self, stage: Stage, process: _Process | None) -> tuple[Job | None, Limits, Answers] | None:
        """The next job; no job in its place when the process has been idle for long; None when all is over."""
        with self._state:
            self._processes[threading.current_thread()] = (stage, process, None)
            self._idle[stage] += 1
            waits_s = None if process is None else IDLE_S[stage]
            has_job = self._state.wait_for(lambda: self._waiting[stage] or self._is_over, waits_s)
            self._idle[stage] -= 1
            if self._is_over:
                return None
            if not has_job:
                return None, self._limits, self._answers
            taken = self._waiting[stage].popleft()
            self._processes[threading.current_thread()] = (stage, process, taken[2])
            return taken

    def _started(self, stage: Stage, answers: Answers) -> _Process:
        with self._state:
            self._number += 1
            said = Path(self._said.name) / str(self._number)
            process = _Process(f"{stage} process {self._number}", stage, said, self._code.get(stage), self._sent_views)
            self._processes[threading.current_thread()] = (stage, process, answers)
        if self._is_over:
            process.strike()
        return process

    def _check_code(self, stage: Stage, digest: str | None) -> None:
        """Raise UserError where a process runs other sources than this one."""
        self._false_starts = 0
        if digest != self._digests.get(stage):
            raise UserError(
                f"the code of {stage} was edited while this sweep ran: a new process has loaded other sources",
                legal="one version of the code for all trials of a sweep",
                fix="run the same command again: trials of the old code are kept under its key, the others run anew",
            )

    def _false_start(self, words: str) -> UserError | None:
        """Count a process that died before it could begin; the mistake to tell where none seems to be able to start."""
        self._false_starts += 1
        if self._false_starts < FALSE_STARTS or self._is_over:
            return None
        return UserError(
            f"{FALSE_STARTS} worker processes in a row died as they started: {words}",
            legal="trials need about 1 GB of memory a process, renders 2 GB",
            fix="run the same command again (finished trials are kept), with fewer --jobs if memory is short, or a"
            " higher --memory-limit",
        )


class _NotStarted(Exception):
    """A process died before it could take a job."""


class _Process:
    """A process with its pipe, served by one thread."""

    def __init__(self, name: str, stage: Stage, said: Path, code: Code | None, sent_views: Path | None) -> None:
        self.is_ready = False
        self._name, self._said = name, said
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        with _one_thread(), _without_interrupts(), _may_have_children():
            self._process = context.Process(
                target=serve, args=(theirs, name, stage, str(said), code, sent_views), name=name, daemon=True
            )
            self._process.start()
        theirs.close()

    def is_alive(self) -> bool:
        """Return whether the process still runs."""
        return self._process.is_alive()

    def wait_until_ready(self) -> str | None:
        """Wait until the process can take jobs; returns the digest of its code. Raises _NotStarted."""
        digest = self._answer(START_S)
        if isinstance(digest, Ended):
            self.kill()
            raise _NotStarted(digest.why)
        self.is_ready = True
        return digest

    def carry_out(self, job: Job, limits: Limits) -> Ended:
        """Run a job. A death of the process is how the job ended, and so is its time limit."""
        with contextlib.suppress(OSError):  # a process that is dead by now does not answer either
            self._pipe.send((job, limits.memory_mb))
        ended: Ended = self._answer(limits.seconds)
        if ended.state in ("crashed", "timed out"):
            self.kill()
        return ended

    def _answer(self, limit_s: float | None) -> Any:
        """The next message, or how waiting for it ended. Time in which everything stood still does not count."""
        began, left_s = time.monotonic(), float("inf") if limit_s is None else limit_s
        while left_s > 0:
            asked, waits_s = time.monotonic(), min(left_s, LOOKS_S)
            try:
                if self._pipe.poll(waits_s):
                    return self._pipe.recv()
            except (EOFError, OSError):
                return Ended("crashed", why=self._last_words(), seconds=time.monotonic() - began, worker=self._name)
            spent_s = time.monotonic() - asked
            if spent_s > waits_s + STOPPED_S:
                began, spent_s = began + spent_s - waits_s, waits_s
            left_s -= spent_s
        why = f"not done after {limit_s:.3g} s (--time-limit); it was at:\n{self._where_it_hangs()}"
        return Ended("timed out", why=why, seconds=time.monotonic() - began, worker=self._name)

    def _where_it_hangs(self) -> str:
        """The end of the process' traceback, which its own signal handler writes."""
        if self._process.pid is not None and hasattr(signal, "SIGUSR1"):
            with contextlib.suppress(OSError):
                os.kill(self._process.pid, signal.SIGUSR1)
                time.sleep(DUMP_S)
                return self._said.read_text()[-TRACEBACK_CHARACTERS:]
        return "a place that is not known"

    def _last_words(self) -> str:
        """The cause of the process' death, as far as can be known."""
        self._process.join(timeout=1.0)
        code = self._process.exitcode
        said = self._said.read_text()[-TRACEBACK_CHARACTERS:] if self._said.exists() else ""
        why = f"its process ended itself with code {code}"
        if code is not None and code < 0:
            name = signal.Signals(-code).name if -code in signal.valid_signals() else f"signal {-code}"
            by = ": by hand, or by the system as memory ran out" if name == "SIGKILL" else ""
            why = f"its process was ended by {name}{by}"
        return why + (f"\n{said}" if said else "")

    def strike(self) -> None:
        """Begin to end the process, without waiting for it."""
        self._process.kill()

    def wait(self) -> None:
        """Wait a second at most for a process that was struck."""
        self._process.join(timeout=1.0)

    def kill(self) -> None:
        """End the process, whatever it does; by its own thread."""
        self.strike()
        self.wait()
        self._pipe.close()


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Hold the environment in which a process starts that computes in one thread; libraries read it as they load."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start processes that do not hear Ctrl-C, not even before they can say so themselves."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _may_have_children() -> Iterator[None]:
    """Let a dask worker under its nanny start processes, which multiprocessing refuses to daemons: these end themselves
    when their parent is gone."""
    config: dict[str, Any] = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    before = config.get("daemon")
    config["daemon"] = False
    try:
        yield
    finally:
        config["daemon"] = before


# ---------------------------------------------------------------- in the process


def serve(
    pipe: Connection[Any, Any], name: str, stage: Stage, said: str, code: Code | None, sent_views: Path | None
) -> None:
    """Carry out jobs one after another until the driver closes the pipe."""
    words = _prepare(said)
    try:
        if stage == "trials":  # before time counts
            import cv2

            import harness.engine.trial  # noqa: F401
            from harness.engine import setup

            setup.sent_views = sent_views
            cv2.setNumThreads(1)
            # plug-ins are loaded now, so that the digest is that of what will run
            for module in code[0] if code else ():
                importlib.import_module(module)
        pipe.send(source_digest(*code) if code else None)
    except BaseException:
        traceback.print_exc(file=words)
        words.flush()
        os._exit(1)
    with contextlib.suppress(EOFError, OSError):
        while True:
            job, memory_mb = pipe.recv()
            limit_memory(memory_mb)
            ended = attempt(job, name)
            try:
                pipe.send(ended)
            except (TypeError, AttributeError, pickle.PicklingError) as error:
                why = f"its result cannot be sent: {error}"
                pipe.send(Ended("failed", why=why, is_bug=True, seconds=ended.seconds, worker=name))


def _prepare(said: str) -> IO[str]:
    """Ignore Ctrl-C, end without a driver, and write to the file ``said`` where a crash or a hang happens."""
    import faulthandler

    if sys.platform.startswith("linux"):  # the system ends this process with its parent, whatever it does
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    words = open(said, "w")  # noqa: SIM115 (open as long as the process lives)
    faulthandler.enable(words)
    if hasattr(faulthandler, "register"):
        faulthandler.register(signal.SIGUSR1, words, all_threads=False)
    driver = os.getppid()

    def end_with_the_driver() -> None:
        while os.getppid() == driver:
            time.sleep(LOOKS_S)
        os._exit(1)

    threading.Thread(target=end_with_the_driver, daemon=True).start()
    return words


def render_into_cache(
    target_data: dict[str, Any], camera_data: dict[str, Any], render_data: dict[str, Any], folder: str
) -> tuple[bool, float]:
    """Render a view unless the cache holds it whole; this alone loads Mitsuba. Returns whether the view was there, and
    the seconds that it took. Arguments are plain data."""
    from scenes.render.cache import cached_view
    from scenes.render.settings import RenderConfig
    from scenes.sensor.camera import CameraConfig, camera_of
    from scenes.target.custom import TargetConfig

    target, optics = TargetConfig.from_data(target_data), camera_of(CameraConfig.from_data(camera_data)).optics
    view, found = cached_view(target, optics, RenderConfig.from_data(render_data), Path(folder))
    return found, view.seconds


def limit_memory(memory_mb: int | None) -> None:
    """Let allocations beyond so much private memory of this process fail (Linux; elsewhere nothing happens). None: no
    limit but the system's."""
    try:
        import resource

        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        soft = hard if memory_mb is None else memory_mb * 1_000_000
        resource.setrlimit(resource.RLIMIT_DATA, (soft if hard < 0 else min(soft, hard), hard))
    except (ImportError, ValueError, OSError):
        pass


class SerialEngine:
    """One job at a time in this process, for debuggers and tests. No limits hold, and a job that hangs or kills the
    process is not survived."""

    def __init__(self) -> None:
        self._jobs: deque[Job] = deque()
        self._pinned = contextlib.ExitStack()

    def __enter__(self) -> SerialEngine:
        import cv2
        from threadpoolctl import threadpool_limits

        # libraries that are loaded later read the environment, those that are loaded by now are asked
        self._pinned.enter_context(_one_thread())
        self._pinned.enter_context(threadpool_limits(1))
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        self._pinned.callback(cv2.setNumThreads, threads)
        return self

    def __exit__(self, *error: object) -> None:
        self._jobs.clear()
        self._pinned.close()

    def room(self, stage: Stage) -> int:
        """Room for one job, whatever its stage."""
        return 1 - len(self._jobs)

    def submit(self, job: Job) -> None:
        """Take a job; it runs in `ended`."""
        self._jobs.append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Run the next job."""
        job = self._jobs.popleft()
        if job.stage == "renders":
            # Mitsuba must be loaded before Open3D in one process (`scenes.render.variant`)
            from scenes.render.variant import load_mitsuba

            load_mitsuba()
        return [(job, attempt(job, "this process"))]
