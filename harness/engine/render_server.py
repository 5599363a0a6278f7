"""A process that renders for a worker of a cluster, which itself must not load Mitsuba: jobs come as JSON lines, and
answers go as JSON lines. ``python -m harness.engine.render_server``, started by the worker, ends when its input does.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict
from typing import Any, TextIO

from harness.engine.processes import DUMP_S, one_thread
from harness.engine.work import TRACEBACK_CHARACTERS, Ended, Job, attempt


class RenderServer:
    """Of the worker: the process, started when it is first needed and again after it died."""

    def __init__(self, worker: str) -> None:
        self._worker = worker
        self._process: subprocess.Popen[str] | None = None
        self._said: Any = None
        self._answers: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._since = time.monotonic()

    def ended(self, job: Job, limit_s: float | None) -> Ended:
        """Do a job whose arguments and result are plain data, JSON's lists standing for tuples. A death of the process
        is how the job ended, and so is its time limit."""
        process = self._running()
        began = time.monotonic()
        line = json.dumps([job.name, job.function.__module__, job.function.__name__, list(job.arguments)])
        answer = ""
        try:
            assert process.stdin is not None
            process.stdin.write(line + "\n")
            process.stdin.flush()
            answer = self._answers.get(timeout=limit_s)
        except queue.Empty:
            why = f"not done after {limit_s:.0f} s (--time-limit); it was at:\n{self._where_it_hangs()}"
            self.close()
            return Ended("timed out", why=why, seconds=time.monotonic() - began, worker=self._worker)
        except OSError:
            pass
        self._since = time.monotonic()
        if not answer:
            why = self._last_words()
            self.close()
            return Ended("crashed", why=why, seconds=time.monotonic() - began, worker=self._worker)
        told = json.loads(answer)
        value = tuple(told["value"]) if isinstance(told["value"], list) else told["value"]
        return Ended(**{**told, "value": value, "worker": self._worker})

    def idle_s(self) -> float:
        """Since the last job; 0 where there is no process."""
        return 0.0 if self._process is None else time.monotonic() - self._since

    def close(self) -> None:
        """End the process, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._said.close()
            self._process = None

    def _running(self) -> subprocess.Popen[str]:
        if self._process is not None and self._process.poll() is None:
            return self._process
        self.close()
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115 (open as long as the process lives)
        with one_thread():
            self._process = subprocess.Popen(
                [sys.executable, "-m", "harness.engine.render_server"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._said,
                text=True,
                # the same modules as here, wherever the worker found them
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
            )
        self._answers = queue.SimpleQueue()
        threading.Thread(target=_listen, args=(self._process.stdout, self._answers), daemon=True).start()
        return self._process

    def _where_it_hangs(self) -> str:
        assert self._process is not None
        if hasattr(signal, "SIGUSR1"):
            with contextlib.suppress(OSError):
                self._process.send_signal(signal.SIGUSR1)
                time.sleep(DUMP_S)
        return self._stderr()

    def _last_words(self) -> str:
        """Why the process died, as far as can be known."""
        assert self._process is not None
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=1.0)
        code = self._process.returncode
        how = f"ended by signal {-code}" if code is not None and code < 0 else f"ended itself with code {code}"
        return f"the render process was {how}\n{self._stderr()}".rstrip()

    def _stderr(self) -> str:
        self._said.seek(0)
        return str(self._said.read()[-TRACEBACK_CHARACTERS:])


def _listen(stream: TextIO, answers: queue.SimpleQueue[str]) -> None:
    """Lines as they come; an empty one for the end."""
    for line in stream:
        answers.put(line)
    answers.put("")


def main() -> None:
    """Of the process: do what the input says, one job after another."""
    import faulthandler

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    faulthandler.enable()
    if hasattr(faulthandler, "register"):
        faulthandler.register(signal.SIGUSR1)
    # what libraries print goes where errors go, at the level of C as well
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    asked: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=_hear, args=(asked,), daemon=True).start()
    while True:
        name, module, function, arguments = json.loads(asked.get())
        job = Job(name, "renders", getattr(importlib.import_module(module), function), tuple(arguments))
        answers.write(json.dumps(asdict(attempt(job, ""))) + "\n")
        answers.flush()


def _hear(asked: queue.SimpleQueue[str]) -> None:
    """Without a worker there is nothing to do, in the middle of a render either."""
    for line in sys.stdin:
        asked.put(line)
    os._exit(0)


if __name__ == "__main__":
    main()
