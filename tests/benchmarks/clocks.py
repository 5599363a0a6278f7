"""Clocks of the benchmarks: rivals in turns, and where the time of nested calls goes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from statistics import median
from typing import Any
from unittest.mock import patch


@dataclass(frozen=True)
class Times:
    """Seconds of so many runs: the least and the median by the wall clock, and the median of the processor's, which
    other work on the machine lengthens less: of one thread that never waits they are equal on an idle machine."""

    least_s: float
    median_s: float
    processor_s: float
    runs: int

    @classmethod
    def of(cls, spent: list[tuple[float, float]], parts: int = 1) -> Times:
        """From `spent` of each run; ``parts``: a run did the work so many times."""
        wall, processor = zip(*spent, strict=True)
        return cls(min(wall) / parts, median(wall) / parts, median(processor) / parts, len(spent))


def spent(function: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of one call: by the wall clock, and of this process' processor time."""
    wall, processor = time.perf_counter(), time.process_time()
    function()
    return time.perf_counter() - wall, time.process_time() - processor


def in_turns(rivals: Mapping[str, Callable[[], Any]], runs: int, parts: int = 1) -> dict[str, Times]:
    """Each rival once to warm up, then ``runs`` rounds of all of them in turns: what slows the machine slows all."""
    for function in rivals.values():
        function()
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in rivals}
    for _ in range(runs):
        for name, function in rivals.items():
            seconds[name].append(spent(function))
    return {name: Times.of(each, parts) for name, each in seconds.items()}


@dataclass(frozen=True)
class Stage:
    """A function to be timed, where it is looked up: ``owner.name``. ``whole``: with all that it calls."""

    label: str
    owner: Any
    name: str
    whole: bool = False


@dataclass
class StageClock:
    """Seconds by stage, each without the stages that it calls: by default of the processor. A microsecond a call is
    added."""

    clock: Callable[[], float] = time.process_time
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    _inner: list[float] = field(default_factory=lambda: [0.0])
    _closed: int = 0

    @contextmanager
    def on(self, stages: list[Stage]) -> Iterator[StageClock]:
        """Time these while the block runs. Raises AttributeError where one of them is gone."""
        with ExitStack() as stack:
            for stage in stages:
                original = getattr(stage.owner, stage.name)
                stack.enter_context(patch.object(stage.owner, stage.name, self._timing(stage, original)))
            yield self

    def _timing(self, stage: Stage, original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            if self._closed:
                return original(*arguments, **named)
            self._closed += stage.whole
            self._inner.append(0.0)
            began = self.clock()
            try:
                return original(*arguments, **named)
            finally:
                took = self.clock() - began
                self._closed -= stage.whole
                self.seconds[stage.label] += took - self._inner.pop()
                self._inner[-1] += took

        return call
