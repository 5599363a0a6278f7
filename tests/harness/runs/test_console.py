"""What a run shows while it works: counts, rates and time left, by a clock of the test's own."""

from __future__ import annotations

import io
import os
import pty
import re
import select
import subprocess
import sys
import time
from pathlib import Path

import pytest

from harness.runs.estimate import PLAIN_EVERY_S, progress_display
from harness.runs.jobs import Outcome, StageCounts

ROOT = Path(__file__).resolve().parents[3]


class Clock:
    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds


def at(renders: StageCounts | None = None, trials: StageCounts | None = None) -> Outcome:
    return Outcome(renders=renders or StageCounts(), trials=trials or StageCounts())


def lines_of(states: list[tuple[float, Outcome]]) -> list[str]:
    clock = Clock()
    stream = io.StringIO()
    with progress_display(stream, clock) as show:
        for seconds, state in states:
            clock.seconds = 1000.0 + seconds
            show(state)
    return stream.getvalue().splitlines()


def test_what_was_found_is_no_part_of_the_rate():
    states = [(s, at(trials=StageCounts(done=5 * s, found=500, total=1000))) for s in range(21)]
    assert (
        lines_of(states)[-1] == "renders 0/0, trials 600/1000 (500 found) 5.00/s about 0:01:20 left"
    )


def test_no_number_before_there_is_a_base():
    assert lines_of([(0, at(StageCounts(total=9), StageCounts(total=90)))]) == [
        "renders 0/9, trials 0/90"
    ]


def test_the_rate_is_that_of_the_last_minute():
    fast = [(s, at(trials=StageCounts(done=100 * s, total=100_000))) for s in range(101)]
    slow = [
        (100 + s, at(trials=StageCounts(done=10_000 + s, total=100_000))) for s in range(1, 101)
    ]
    assert " 1.00/s " in lines_of(fast + slow)[-1]


def test_the_wall_clock_may_jump(monkeypatch):
    """Only the monotonic clock is read: every function that tells the time of day raises."""

    def wall(*_):
        raise AssertionError("the time of day was asked for")

    for name in ("time", "time_ns", "localtime", "gmtime", "ctime", "strftime"):
        monkeypatch.setattr(time, name, wall)
    assert lines_of([(0, at(StageCounts(done=1, total=2), StageCounts(done=4, total=9)))]) == [
        "renders 1/2, trials 4/9"
    ]


def test_lines_come_at_the_start_every_ten_seconds_and_at_the_end():
    renders = StageCounts(done=3, found=3, total=6)
    states = [(tenth / 10, at(renders, StageCounts(done=tenth, total=255))) for tenth in range(256)]
    assert lines_of([*states, *50 * states[-1:]]) == [
        "renders 6/6 (3 found), trials 0/255",
        "renders 6/6 (3 found), trials 100/255 10/s about 0:00:15 left",
        "renders 6/6 (3 found), trials 200/255 10/s about 0:00:05 left",
        "renders 6/6 (3 found), trials 255/255",
    ]
    assert PLAIN_EVERY_S == 10


def test_the_last_state_is_told_where_it_is_interrupted():
    stream = io.StringIO()
    with pytest.raises(KeyboardInterrupt), progress_display(stream, Clock()) as show:
        show(at(StageCounts(total=1), StageCounts(total=9)))
        show(at(StageCounts(done=1, total=1), StageCounts(done=2, total=9)))
        raise KeyboardInterrupt
    assert stream.getvalue().splitlines()[-1] == "renders 1/1, trials 2/9"


def test_failures_are_told_where_there_are_any():
    state = at(StageCounts(done=2, failed=1, total=4), StageCounts(done=3, failed=2, total=9))
    assert lines_of([(0, state)]) == ["renders 3/4 1 failed, trials 5/9 2 failed"]


SHOWN = """
import time
from harness.runs.estimate import progress_display
from harness.runs.jobs import Outcome, StageCounts
with progress_display() as show:
    for k in range(12):
        trials = StageCounts(done=40000 * k, found=400, failed=k // 9, total=1000000)
        show(Outcome(renders=StageCounts(done=k, found=3, total=180), trials=trials))
        time.sleep(0.15)
"""


def test_a_terminal_shows_bars_that_fit():
    text = shown_on_terminal(SHOWN, 100)
    pictures = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).replace("\r", "\n").splitlines()
    assert max(map(len, pictures)) <= 100
    last = [line.rstrip() for line in pictures if line.startswith("trials")][-1]
    assert re.search(
        r"^trials +[━╸╺ ]+ +440401/1000000 \(400 found\) +\d+/s +1 failed +about \d", last
    ), last
    assert "\x1b[1;31m" in text


def shown_on_terminal(program: str, columns: int) -> str:
    """What a program writes on a terminal of so many columns, on stderr."""
    import fcntl
    import struct
    import termios

    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
    environment = {**os.environ, "TERM": "xterm-256color"}
    for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR"):
        environment.pop(name, None)
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stderr=theirs, env=environment
    )
    os.close(theirs)
    printed = b""
    while select.select([ours], [], [], 60)[0]:
        try:
            content = os.read(ours, 65536)
        except OSError:  # Linux says so where the last writer has closed
            break
        if not content:
            break
        printed += content
    os.close(ours)
    assert process.wait(timeout=600) == 0
    return printed.decode()
