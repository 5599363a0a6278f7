"""A plan cut into parts: a batch, or some of its repeats, as one shard runs it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from harness.engine.plan import Batch, Plan, RenderJob
from harness.engine.shard import Shard

MOST_REPEATS = 256
"""Of a part, which is looked up and queued as one."""


@dataclass(eq=False)
class Part:
    """Repeats of one batch, and how far they are. ``group``: its number in the plan; ``sets_threshold``: whether they
    set its points' thresholds; ``left``: trials that have not ended; ``absent``: views that they wait for; ``trials``
    that wait for views."""

    group: int
    batch: Batch
    sets_threshold: bool
    repeats: range
    left: int = 0
    absent: set[Path] = field(default_factory=set)
    trials: list[Any] = field(default_factory=list)
    is_over: bool = False

    @property
    def count(self) -> int:
        """Trials, if all points of the group are judged."""
        return len(self.repeats)

    @property
    def renders(self) -> tuple[RenderJob, ...]:
        """The views of its batch."""
        return self.batch.renders

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """Where these are stored."""
        return tuple(job.path for job in self.renders)


def parts_of(plan: Plan, shard: Shard) -> tuple[list[list[Part]], list[list[Part]]]:
    """By group: parts that set its thresholds, and judged parts that are the shard's. A group of which the shard judges
    nothing has none of either."""
    total = sum(group.most_repeats(batch) for group in plan.groups for batch in group.then)
    mine, before = shard.part(total), 0
    first: list[list[Part]] = []
    then: list[list[Part]] = []
    for number, group in enumerate(plan.groups):
        judged = []
        for batch in group.then:
            count = group.most_repeats(batch)
            repeats = range(max(mine.start - before, 0), min(mine.stop - before, count))
            before += count
            judged += [Part(number, batch, False, some) for some in _pieces(repeats)]
        then.append(judged)
        whole = [(batch, range(group.most_repeats(batch))) for batch in group.first if judged]
        first.append([Part(number, batch, True, some) for batch, repeats in whole for some in _pieces(repeats)])
    return first, then


def _pieces(repeats: range) -> Iterator[range]:
    """Repeats in pieces of at most `MOST_REPEATS`."""
    for start in range(repeats.start, repeats.stop, MOST_REPEATS):
        yield range(start, min(start + MOST_REPEATS, repeats.stop))
