"""The progress that a run shows: bars on a terminal, a line every few seconds elsewhere. All times are differences of
the monotonic clock, so that setting the machine's clock changes nothing."""

from __future__ import annotations

import copy
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

from harness.engine.work import Progress, StageCounts

if TYPE_CHECKING:
    from rich.console import RenderableType

PLAIN_EVERY_S = 10.0
"""Seconds between lines where there is no terminal: enough to see life in a log, too few to fill it."""
WINDOW_S = 60.0
"""Rates are those of the last minute: work of unlike set-ups goes at unlike rates."""
SAMPLE_EVERY_S = 0.5
FEWEST = 3
"""Finished in the window, fewer of which are no base for a rate."""
BAR_EVERY_S = 0.25


@contextmanager
def progress_display(
    stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[Progress], None]]:
    """A function that shows progress on ``stream`` (None: stderr): done of planned, rate, failures, time left."""
    stream = sys.stderr if stream is None else stream
    if not stream.isatty():
        lines = _PlainLines(stream, clock)
        try:
            yield lines
        finally:
            lines.end()
        return
    from rich.console import Console
    from rich.live import Live

    bars = _Bars(clock)
    with Live(
        get_renderable=bars.picture, console=Console(file=stream), refresh_per_second=1 / BAR_EVERY_S, transient=False
    ):
        yield bars


class Pace:
    """The pace of both stages, from snapshots of their progress. ``clock``: seconds, never backwards."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._seen: deque[tuple[float, int, int]] = deque()
        """(moment, renders done, trials done), `SAMPLE_EVERY_S` apart or more; what was found finished is no work."""
        self.now: Progress | None = None

    def take(self, now: Progress) -> None:
        """A new snapshot."""
        moment = self._clock()
        if not self._seen or moment - self._seen[-1][0] >= SAMPLE_EVERY_S:
            self._seen.append((moment, now.renders.done, now.trials.done))
        while len(self._seen) > 2 and moment - self._seen[1][0] > WINDOW_S:
            self._seen.popleft()
        # a copy, as the counts go on in the engine; last, as a terminal is drawn by a thread of its own
        self.now = copy.deepcopy(now)

    def rates(self) -> tuple[float | None, float | None]:
        """Renders and trials a second; None without a base for it."""
        if self.now is None:
            return None, None
        moment, renders, trials = self._seen[0]
        spent = self._clock() - moment
        return _rate(self.now.renders.done - renders, spent), _rate(self.now.trials.done - trials, spent)

    def seconds_left(self) -> float | None:
        """Seconds until all is over; None without a base for it.

        Renders and trials go on beside each other, so the longer of the two counts; after the last render its own
        trials must follow, as many as a render has on average. Pictures and the report are not in it.
        """
        if self.now is None:
            return None
        renders, trials = self.now.renders, self.now.trials
        rates = self.rates()
        left = [
            _time_left(stage.total - stage.over, rate) for stage, rate in zip((renders, trials), rates, strict=True)
        ]
        if left[0] is None or left[1] is None:
            return None
        follow = trials.total / renders.total / rates[1] if left[0] > 0 and rates[1] else 0.0
        return max(left[0] + follow, left[1])


def _rate(count: int, seconds: float) -> float | None:
    return count / seconds if count >= FEWEST and seconds >= SAMPLE_EVERY_S else None


def _time_left(count: int, rate: float | None) -> float | None:
    if count <= 0:
        return 0.0
    return None if rate is None else count / rate


class _PlainLines:
    """Prints at the start, every `PLAIN_EVERY_S` seconds, and how it ended."""

    def __init__(self, stream: TextIO, clock: Callable[[], float]) -> None:
        self._stream, self._clock = stream, clock
        self._pace = Pace(clock)
        self._next = float("-inf")
        self._said = ""

    def __call__(self, now: Progress) -> None:
        self._pace.take(now)
        moment = self._clock()
        if moment >= self._next:
            self._next = moment + PLAIN_EVERY_S
            self._say()

    def end(self) -> None:
        """The last state, if it was not said."""
        if self._pace.now is not None:
            self._say()

    def _say(self) -> None:
        text = plain_text(self._pace)
        if text != self._said:
            self._said = text
            print(text, file=self._stream, flush=True)


def plain_text(pace: Pace) -> str:
    """One line, such as ``renders 12/180 (3 found) 0.8/s, trials 40/360 9.5/s, 2 failed, about 45 s left``."""
    now = pace.now
    if now is None:
        return ""
    stages = zip(("renders", "trials"), (now.renders, now.trials), pace.rates(), strict=True)
    parts = [" ".join([name, *_counted(stage, rate)]) for name, stage, rate in stages]
    if now.renders.failed:
        parts.append(f"{_many(now.renders.failed, 'render')} and {_many(now.trials.failed, 'trial')} failed")
    elif now.trials.failed:
        parts.append(f"{now.trials.failed} failed")
    left = pace.seconds_left()
    return ", ".join(parts + ([f"about {duration(left)} left"] if left else []))


def _counted(stage: StageCounts, rate: float | None) -> list[str]:
    found = [f"({stage.found} found)"] if stage.found else []
    is_going = rate is not None and stage.over < stage.total
    return [f"{stage.over}/{stage.total}", *found, *([rate_text(rate)] if is_going and rate is not None else [])]


def _many(count: int, what: str) -> str:
    return f"{count} {what}" + ("" if count == 1 else "s")


def rate_text(per_second: float) -> str:
    """A rate with two digits, in a unit that leaves a number above 1 where there is one."""
    for unit, seconds in (("s", 1.0), ("min", 60.0)):
        if per_second * seconds >= (0.1 if unit == "s" else 1.0):
            return f"{_two_digits(per_second * seconds)}/{unit}"
    return f"{_two_digits(per_second * 3600)}/h"


def duration(seconds: float) -> str:
    """A time in words, with two digits: what is estimated deserves no more."""
    for unit, length, most in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < most:
            return f"{_two_digits(seconds / length)} {unit}"
    return f"{_two_digits(seconds / 86_400)} days"


def _two_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}".removesuffix(".0")


class _Bars:
    """A bar for each stage, and the time spent and left."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock, self._began = clock, clock()
        self._pace = Pace(clock)

    def __call__(self, now: Progress) -> None:
        self._pace.take(now)

    def picture(self) -> RenderableType:
        """The terminal's content now; it fits into 80 columns with a million trials."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        now = self._pace.now
        if now is None:
            return Text("")
        grid = Table.grid(expand=True, padding=(0, 2, 0, 0))
        grid.add_column()
        grid.add_column(ratio=1, min_width=8)
        for _ in range(4):
            grid.add_column(justify="right", no_wrap=True)
        stages = zip(("renders", "trials"), (now.renders, now.trials), self._pace.rates(), strict=True)
        for name, stage, rate in stages:
            grid.add_row(
                name,
                ProgressBar(max(stage.total, 1), stage.over if stage.total else 1, complete_style="cyan"),
                f"{stage.over}/{stage.total}",
                Text(f"{stage.found} found" if stage.found else "", style="dim"),
                rate_text(rate) if rate is not None and stage.over < stage.total else "",
                Text(f"{stage.failed} failed" if stage.failed else "", style="bold red"),
            )
        left = self._pace.seconds_left()
        spent = f"{duration(self._clock() - self._began)} so far"
        return Group(grid, Text(spent + (f", about {duration(left)} left" if left else "")))
