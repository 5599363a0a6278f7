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

from harness.engine.console import PLAIN_EVERY_S, Pace, duration, plain_text, progress_display, rate_text
from harness.engine.work import Progress, StageCounts

ROOT = Path(__file__).resolve().parents[1]


class Clock:
    def __init__(self) -> None:
        self.seconds = 1000.0

    def __call__(self) -> float:
        return self.seconds


def at(renders: StageCounts | None = None, trials: StageCounts | None = None) -> Progress:
    return Progress(renders or StageCounts(), trials or StageCounts())


def run_of(pace: Pace, clock: Clock, states: list[tuple[float, Progress]]) -> None:
    for seconds, state in states:
        clock.seconds = 1000.0 + seconds
        pace.take(state)


def test_what_was_found_is_no_part_of_the_rate():
    clock = Clock()
    pace = Pace(clock)
    run_of(
        pace,
        clock,
        [(0, at(trials=StageCounts(total=1000)))]
        + [(s, at(trials=StageCounts(done=5 * s, found=500, total=1000))) for s in range(1, 21)],
    )
    assert pace.rates()[1] == pytest.approx(5.0)
    assert pace.seconds_left() == pytest.approx(400 / 5)


def test_no_number_before_there_is_a_base():
    clock = Clock()
    pace = Pace(clock)
    assert pace.seconds_left() is None and plain_text(pace) == ""
    run_of(pace, clock, [(0, at(StageCounts(total=9), StageCounts(total=90)))])
    assert pace.rates() == (None, None) and pace.seconds_left() is None
    # all renders found so far, trials at a steady rate: what is still to render goes at no known rate
    run_of(pace, clock, [(10, at(StageCounts(found=5, total=9), StageCounts(done=40, total=90)))])
    assert pace.rates()[0] is None and pace.seconds_left() is None
    assert plain_text(pace) == "renders 5/9 (5 found), trials 40/90 4/s"
    run_of(pace, clock, [(12, at(StageCounts(found=9, total=9), StageCounts(done=48, total=90)))])
    assert pace.seconds_left() == pytest.approx(42 / 4)


def test_the_longer_stage_counts_and_its_last_trials_follow():
    clock = Clock()
    slow_renders = at(StageCounts(done=10, total=100), StageCounts(done=20, total=200))
    pace = Pace(clock)
    run_of(pace, clock, [(0, at(StageCounts(total=100), StageCounts(total=200))), (20, slow_renders)])
    assert pace.seconds_left() == pytest.approx(90 / 0.5 + 2 / 1.0)
    slow_trials = at(StageCounts(done=90, total=100), StageCounts(done=20, total=2000))
    pace = Pace(clock)
    run_of(pace, clock, [(0, at(StageCounts(total=100), StageCounts(total=2000))), (20, slow_trials)])
    assert pace.seconds_left() == pytest.approx(1980 / 1.0)


def test_the_rate_is_that_of_the_last_minute():
    clock = Clock()
    pace = Pace(clock)
    fast = [(s, at(trials=StageCounts(done=100 * s, total=100_000))) for s in range(101)]
    slow = [(100 + s, at(trials=StageCounts(done=10_000 + s, total=100_000))) for s in range(1, 101)]
    run_of(pace, clock, fast + slow)
    assert pace.rates()[1] == pytest.approx(1.0)
    # and nothing that happens for long brings it down to nothing
    clock.seconds += 600
    pace.take(slow[-1][1])
    assert pace.rates()[1] is None and pace.seconds_left() is None


def test_a_snapshot_does_not_go_on_with_the_engine():
    clock = Clock()
    pace = Pace(clock)
    counts = StageCounts(done=1, total=10)
    pace.take(at(trials=counts))
    counts.done = 9
    assert pace.now is not None and pace.now.trials.done == 1


def test_the_wall_clock_may_jump(monkeypatch):
    """Only the monotonic clock is read: every function that tells the time of day raises."""

    def wall(*_):
        raise AssertionError("the time of day was asked for")

    for name in ("time", "time_ns", "localtime", "gmtime", "ctime", "strftime"):
        monkeypatch.setattr(time, name, wall)
    stream = io.StringIO()
    with progress_display(stream) as show:
        show(at(StageCounts(done=1, total=2), StageCounts(done=4, total=9)))
    assert stream.getvalue() == "renders 1/2, trials 4/9\n"


def test_lines_come_at_the_start_every_ten_seconds_and_at_the_end():
    clock, stream = Clock(), io.StringIO()
    with progress_display(stream, clock) as show:
        for tenth in range(0, 256):
            clock.seconds = 1000 + tenth / 10
            show(at(StageCounts(done=3, found=3, total=6), StageCounts(done=tenth, total=255)))
        for _ in range(50):  # pictures are made: the trials are over
            show(at(StageCounts(done=3, found=3, total=6), StageCounts(done=255, total=255)))
    lines = stream.getvalue().splitlines()
    assert lines == [
        "renders 6/6 (3 found), trials 0/255",
        "renders 6/6 (3 found), trials 100/255 10/s, about 16 s left",
        "renders 6/6 (3 found), trials 200/255 10/s, about 5.5 s left",
        "renders 6/6 (3 found), trials 255/255",
    ]
    assert PLAIN_EVERY_S == 10


def test_the_last_state_is_told_where_it_is_interrupted():
    clock, stream = Clock(), io.StringIO()
    with pytest.raises(KeyboardInterrupt), progress_display(stream, clock) as show:
        show(at(StageCounts(total=1), StageCounts(total=9)))
        show(at(StageCounts(done=1, total=1), StageCounts(done=2, total=9)))
        raise KeyboardInterrupt
    assert stream.getvalue().splitlines()[-1] == "renders 1/1, trials 2/9"


def test_failures_are_told_where_there_are_any():
    pace = Pace(Clock())
    pace.take(at(StageCounts(done=2, total=4), StageCounts(done=3, failed=2, total=9)))
    assert plain_text(pace) == "renders 2/4, trials 5/9, 2 failed"
    pace.take(at(StageCounts(done=2, failed=1, total=4), StageCounts(done=3, failed=2, total=9)))
    assert plain_text(pace) == "renders 3/4, trials 5/9, 1 render and 2 trials failed"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.44, "0.4 s"),
        (45.2, "45 s"),
        (119, "119 s"),
        (150, "2.5 min"),
        (7100, "118 min"),
        (9000, "2.5 h"),
        (1e6, "12 days"),
    ],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize(
    ("rate", "text"), [(123.4, "123/s"), (9.5, "9.5/s"), (0.8, "0.8/s"), (0.05, "3/min"), (0.002, "7.2/h")]
)
def test_rates(rate, text):
    assert rate_text(rate) == text


SHOWN = """
import time
from harness.engine.console import progress_display
from harness.engine.work import Progress, StageCounts
with progress_display() as show:
    for k in range(12):
        trials = StageCounts(done=40000 * k, found=400, failed=k // 9, total=1000000)
        show(Progress(StageCounts(done=k, found=3, total=180), trials))
        time.sleep(0.15)
"""


@pytest.mark.parametrize("columns", [80, 160])
def test_a_terminal_shows_bars_that_fit(columns):
    text = shown_on_terminal(SHOWN, columns)
    pictures = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text).replace("\r", "\n").splitlines()
    assert max(map(len, pictures)) <= columns
    last = [line.rstrip() for line in pictures if line.startswith("trials")][-1]
    assert re.search(r"^trials +[━╸╺ ]+ +440401/1000000 +400 found +\d+/s +1 failed$", last), last
    assert len(re.findall("[━╸╺]", last)) > columns - 60
    assert re.search(r"about \d", pictures[-1] + pictures[-2]), pictures[-2:]
    # red only once there are failures
    assert "\x1b[1;31m" in text
    assert "\x1b[1;31m" not in shown_on_terminal(SHOWN.replace("k // 9", "0"), columns)


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
    process = subprocess.Popen([sys.executable, "-c", program], cwd=ROOT, stderr=theirs, env=environment)
    os.close(theirs)
    said = b""
    while select.select([ours], [], [], 60)[0]:
        try:
            content = os.read(ours, 65536)
        except OSError:  # Linux says so where the last writer has closed
            break
        if not content:
            break
        said += content
    os.close(ours)
    assert process.wait(timeout=600) == 0
    return said.decode()
