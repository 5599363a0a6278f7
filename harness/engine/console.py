"""What a run shows while it works: a bar on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from harness.engine.run import Progress

PLAIN_EVERY_S = 10.0
"""Seconds between lines where there is no terminal: enough to see life in a log, too few to fill it."""


@contextmanager
def progress_display() -> Iterator[Callable[[Progress], None]]:
    """A function that shows progress: done, planned and the time left."""
    if not sys.stderr.isatty():
        yield _PlainLines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description:8}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=Console(stderr=True)) as bars:
        renders, trials = bars.add_task("renders", total=None), bars.add_task("trials", total=None)

        def show(now: Progress) -> None:
            bars.update(renders, completed=now.renders, total=now.renders_total)
            bars.update(trials, completed=now.trials, total=now.trials_total)

        yield show


class _PlainLines:
    """Prints at the start, every `PLAIN_EVERY_S` seconds, and at the end."""

    def __init__(self) -> None:
        self._began = time.monotonic()
        self._last = float("-inf")

    def __call__(self, now: Progress) -> None:
        finished = now.trials >= now.trials_total
        moment = time.monotonic()
        if not finished and moment - self._last < PLAIN_EVERY_S:
            return
        self._last = moment
        spent = moment - self._began
        left = f", about {spent / now.trials * (now.trials_total - now.trials):.0f} s left" if now.trials else ""
        print(
            f"renders {now.renders}/{now.renders_total}, trials {now.trials}/{now.trials_total}, {spent:.0f} s{left}",
            file=sys.stderr,
            flush=True,
        )
