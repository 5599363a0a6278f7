"""Runs programs in a process of their own, one input after the other, and tells how each ended."""

from __future__ import annotations

import io
import os
import resource
import shutil
import signal
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

from tests.fuzz.cases import Input, prepared

SECONDS = 6.0
"""Processor time for one input: a simulation that a valid input asks for is stopped then."""
HUNG_AFTER = 60.0
"""Seconds after which a process that cannot be stopped so is killed."""
MEMORY_BYTES = 12 << 30


@dataclass(frozen=True)
class End:
    """How a program ended on an input."""

    program: str
    """Name of the program."""
    number: int
    """Number of the input."""
    state: str
    """``refused`` (code 2), ``answered`` (another code), ``stopped`` by time, or ``traceback``."""
    words: Sequence[str]
    """Arguments of the program."""
    text: str
    """The traceback, the last line of the error, or why the process died."""


class Stopped(BaseException):
    """The time for one input is over. No handler of errors catches it."""


def _stop(*_: object) -> None:
    raise Stopped


def tried(base: Path, numbers: Sequence[int], seed: int, only: str) -> Iterator[End]:
    """Yield how each input ended. A process that dies counts as a traceback, and another takes
    over."""
    waiting = list(numbers)
    while waiting:
        ours, theirs = get_context("fork").Pipe(duplex=False)
        process = get_context("fork").Process(
            target=_run_all, args=(theirs, base, waiting, seed, only)
        )
        process.start()
        theirs.close()
        hung = False
        last: Input | None = None
        while waiting:
            try:
                hung = not ours.poll(HUNG_AFTER)
                if hung:
                    process.kill()
                    break
                message = ours.recv()
            except EOFError:
                break
            if isinstance(message, Input):
                last = message
                continue
            waiting.remove(message.number)
            last = None
            yield message
        process.join()
        if waiting:
            number = last.number if last else waiting[0]
            program = last.program if last else "?"
            words = last.words if last else ()
            waiting.remove(number)
            state = "stopped" if hung else "traceback"
            text = f"the process died (exit code {process.exitcode})"
            yield End(program, number, state, words, text)


def _run_all(pipe: Connection, base: Path, numbers: Sequence[int], seed: int, only: str) -> None:
    from scenes.render.scene import load_mitsuba

    load_mitsuba()  # before Open3D, whose C++ library LLVM cannot use
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, resource.RLIM_INFINITY))
    for number in numbers:
        case = prepared(base, number, seed, only)
        pipe.send(case)
        end = run_one(case)
        if end.state != "traceback":
            shutil.rmtree(case.folder, ignore_errors=True)
        pipe.send(end)


def run_one(given: Input) -> End:
    """Run a program on an input in this process, in the input's folder."""
    from harness.__main__ import main

    before = Path.cwd()
    os.chdir(given.folder)
    printed = io.StringIO()
    state = "answered"
    text = ""
    handler_before = signal.signal(signal.SIGPROF, _stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(printed):
            code = main([given.program, *given.words])
        if code == 2:
            state = "refused"
            text = printed.getvalue().strip().splitlines()[-1:][0] if printed.getvalue() else ""
    except SystemExit as end:
        state = "refused" if end.code == 2 else "traceback"
        text = printed.getvalue().strip().splitlines()[-1:][0] if printed.getvalue() else ""
    except Stopped:
        state = "stopped"
    except BaseException:
        state = "traceback"
        text = traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler_before)
        os.chdir(before)
    if "Traceback (most recent call last)" in printed.getvalue():
        state = "traceback"
        text = printed.getvalue()[-3000:]
    sys.stdout.flush()
    return End(given.program, given.number, state, given.words, text)
