"""A scheduler and workers as processes of their own, as a user starts them; and jobs that
misbehave."""

from __future__ import annotations

import ctypes
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from harness.runs.processes import ONE_THREAD
from harness.trials.board import BoardRef, load_board

ROOT = Path(__file__).resolve().parents[2]
HOLD = 600.0
"""Seconds, generous: what must have started or ended by then."""


class Processes:
    """A scheduler, and workers that come and go; all end with the context."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._file = folder / "scheduler.json"
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", self._file
        )
        self.workers: list[subprocess.Popen[bytes]] = []
        until(lambda: self._file.exists() and self._file.stat().st_size > 0)

    @property
    def address(self) -> str:
        return str(json.loads(self._file.read_text())["address"])

    def worker(self, *options: str, search: Path = ROOT) -> subprocess.Popen[bytes]:
        """``search``: where tofpod is."""
        local = ["--local-directory", self.folder / "scratch"]
        arguments = [
            "--scheduler-file",
            self._file,
            "--nthreads",
            "1",
            "--host",
            "127.0.0.1",
            *local,
            *options,
        ]
        self.workers.append(self._start("worker", *arguments, search=search))
        return self.workers[-1]

    def _start(self, kind: str, *options: object, search: Path = ROOT) -> subprocess.Popen[bytes]:
        folders = os.pathsep.join([str(search), str(ROOT / "tests")])
        log = open(self.folder / f"{kind}.log", "ab")  # noqa: SIM115 (the process has its own)
        command = [
            sys.executable,
            "-m",
            "distributed.cli.dask_" + kind,
            *map(str, options),
            "--no-dashboard",
        ]
        # nothing pinned from outside: workers see to their threads themselves
        environment = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
        environment["PYTHONPATH"] = folders
        environment["DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED"] = (
            "False"  # it looks a hundred times a second
        )
        return subprocess.Popen(command, cwd=self.folder, env=environment, stdout=log, stderr=log)

    def close(self) -> None:
        # workers first: one that ends while its scheduler does may wait for it. Nothing is
        # asserted of how they end
        for group in (self.workers, [self.scheduler]):
            for process in group:
                if process.poll() is None:
                    process.send_signal(signal.SIGTERM)
            for process in group:
                try:
                    process.wait(timeout=30)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()


@contextmanager
def processes(folder: Path) -> Iterator[Processes]:
    """A scheduler without workers."""
    folder.mkdir(parents=True, exist_ok=True)
    started = Processes(folder)
    try:
        yield started
    finally:
        started.close()


def until(holds, seconds: float = HOLD) -> None:
    """Wait for something to hold."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


# ---------------------------------------------------------------- jobs


def square(number: int) -> int:
    return number * number


def slow_square(number: int, seconds: float) -> int:
    time.sleep(seconds)
    return number * number


def raises(number: int) -> int:
    raise ValueError(f"no such number: {number}")


def kill_own_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hang() -> None:
    while True:
        time.sleep(0.05)


def hold_the_interpreter() -> None:
    """Wait in C for what never comes, without giving the interpreter's lock back: no other thread
    runs again."""
    nothing, _ = os.pipe()
    ctypes.PyDLL(None).read(nothing, ctypes.create_string_buffer(1), 1)


def eat(megabytes: int) -> int:
    processes = []
    for _ in range(megabytes // 10):
        processes.append(bytes(range(250)) * 40_000)
        time.sleep(0.02)
    return len(processes)


def loaded() -> list[str]:
    return sorted(name for name in ("mitsuba", "drjit") if name in sys.modules)


def threads() -> dict[str, int]:
    """What each library that computes may use, in the thread that a trial gets."""
    import cv2
    from threadpoolctl import threadpool_info

    return {str(pool["filepath"]): pool["num_threads"] for pool in threadpool_info()} | {
        "cv2": cv2.getNumThreads()
    }


def note_node_and_sleep(path: str, seconds: float) -> int:
    """Note the dask worker that this process belongs to."""
    Path(path).write_text(str(multiprocessing.parent_process().pid))  # type: ignore[union-attr]
    time.sleep(seconds)
    return 0


def pid_after(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def probes_of(board: BoardRef) -> int:
    """Load a set-up; how many probes it has."""
    return len(load_board(board).probes)
