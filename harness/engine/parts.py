"""A plan cut into parts: a batch, or some of its repeats, as one shard runs it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from harness.engine.plan import Batch, Plan, RenderJob
from harness.engine.shard import Shard


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
            if repeats:
                judged.append(Part(number, batch, False, repeats))
        then.append(judged)
        whole = [(batch, range(group.most_repeats(batch))) for batch in group.first]
        first.append([Part(number, batch, True, repeats) for batch, repeats in whole if judged and repeats])
    return first, then
