"""The progress of a sweep, and what there is to do before it runs."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, TextIO

from harness.engine.journal import Journal
from harness.engine.plan import Group, PlanPart, SweepPlan, parts_of, plan_of
from harness.engine.run import Calibration
from harness.engine.work import EngineOptions, Outcome
from harness.experiment.schema import CaptureSource, Experiment
from harness.tables.text import many

PLAIN_EVERY_S = 10.0
"""Seconds between lines where there is no terminal: enough to see life in a log, too few to fill it."""
WINDOW_S = 60.0  # rates are those of the last minute: work of unlike set-ups goes at unlike rates


@contextmanager
def progress_display(
    stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[Outcome], None]]:
    """Yield a function that shows on ``stream`` (None: stderr) how far a run is: done of planned, rate, failures, time
    left. Work that was found done is no part of the rate."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    stream = sys.stderr if stream is None else stream
    names = ("counts", "rate", "failed", "left")
    columns = [TextColumn(f"{'[bold red]' * (name == 'failed')}{{task.fields[{name}]}}") for name in names]
    bars = Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=None),
        *columns,
        console=Console(file=stream),
        refresh_per_second=4,
        speed_estimate_period=WINDOW_S,
        expand=True,
        get_time=clock,
        disable=not stream.isatty(),
    )
    stages = {name: bars.add_task(name, counts="", rate="", failed="", left="") for name in ("renders", "trials")}
    said, said_at = "", float("-inf")

    def show(outcome: Outcome | None) -> None:
        nonlocal said, said_at
        if outcome is not None:
            for name, task in stages.items():
                counts = getattr(outcome, name)
                state = bars.tasks[task]
                bars.update(task, completed=counts.done, total=counts.total - counts.found - counts.failed)
                left_s = (state.total or 0) - counts.done
                left_s = left_s / state.speed if left_s > 0 and state.speed else 0.0
                bars.update(
                    task,
                    counts=f"{counts.over}/{counts.total}" + (f" ({counts.found} found)" if counts.found else ""),
                    rate=rate_text(state.speed) if left_s and state.speed else "",
                    failed=f"{counts.failed} failed" if counts.failed else "",
                    left=f"about {duration(left_s)} left" if left_s else "",
                )
        if bars.disable and bars.tasks[0].fields["counts"] and (outcome is None or clock() >= said_at + PLAIN_EVERY_S):
            lines = (" ".join(filter(None, [task.description, *map(task.fields.get, names)])) for task in bars.tasks)
            text = ", ".join(lines)
            if text != said:
                said, said_at = text, clock()
                print(text, file=stream, flush=True)

    with bars:
        try:
            yield show
        finally:
            show(None)


def rate_text(per_second: float) -> str:
    """Return a rate with two digits, in a unit that leaves a number above 1 where there is one."""
    if per_second >= 0.1:
        return f"{_two_digits(per_second)}/s"
    return f"{_two_digits(60 * per_second)}/min" if 60 * per_second >= 1 else f"{_two_digits(3600 * per_second)}/h"


def duration(seconds: float) -> str:
    """Return a time in words, with two digits: what is estimated deserves no more."""
    for unit, length, most in (("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, 172_800.0)):
        if seconds < most:
            return f"{_two_digits(seconds / length)} {unit}"
    return f"{_two_digits(seconds / 86_400)} days"


def _two_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}".removesuffix(".0")


# ---------------------------------------------------------------- the estimate


class SweepEstimate(NamedTuple):
    """Counts of what there is to do; ``found``: trials in the journal. ``trials_known``: False without thresholds."""

    renders: int
    cached: int
    to_render: int
    trials: int
    found: int
    trials_known: bool

    def lines(self) -> list[str]:
        """Return the same as text."""
        later = "" if self.trials_known else "; judged ones are looked for once thresholds are set"
        to_run = self.trials - self.found
        lines = [
            f"renders: {self.renders}, {self.cached} of them cached, {self.to_render} to do",
            f"trials: {self.trials}, {self.found} of them in the journal, {to_run} to do{later}",
        ]
        return lines if self.to_render or to_run else [*lines, "nothing to run; the report is written anew"]


def dry_run(experiment: Experiment, out: Path, options: EngineOptions) -> int:
    """Say what a sweep would run; nothing is written."""
    folder = experiment.folder(out)
    if isinstance(experiment.config.source, CaptureSource):
        print(f"{experiment.config.name}: valid; {len(experiment.points)} points of a real capture; results: {folder}")
        return 0
    plan = plan_of(experiment, Path(out) / ".cache" / "renders")
    print(f"{experiment.config.name}: valid" + ("" if options.shard.is_whole else f"; shard {options.shard}"))
    print(f"  {many(len(experiment.points), 'point')}, {many(len(plan.groups), 'set')} of frames")
    print("\n".join(f"  {line}" for line in estimate(plan, Journal(folder / "journal"), options).lines()))
    print(f"  results would go to {folder}")
    return 0


def estimate(plan: SweepPlan, journal: Journal, options: EngineOptions) -> SweepEstimate:
    """Count what of a plan, or of a shard of it, is finished, and what is left to do."""
    over = ("done",) if options.retry_failed else ("done", "failed", "crashed", "timed out")
    first, then = parts_of(plan, options.shard)
    missing, is_known = [], True

    def lacks(group: Group, part: PlanPart, sets: list[dict[str, float]]) -> int:
        if not len(journal):
            return len(part.repeats)
        keys = zip(*([key for key, _ in group.trials(part.batch, each, part.repeats)] for each in sets), strict=True)
        return len(part.repeats) - sum(any(journal.state(key) in over for key in alike) for alike in keys)

    for group, own, judged in zip(plan.groups, first, then, strict=True):
        absent = [(part, lacks(group, part, [{}])) for part in own]
        if any(count for _, count in absent):
            is_known &= not judged or not len(journal)
            absent += [(part, len(part.repeats)) for part in judged]
        else:
            calibration = Calibration(group)
            for key in (key for part in own for key, _ in group.trials(part.batch, {}, part.repeats)):
                entry = journal.read(key)
                if entry is not None and entry.record is not None:
                    calibration.add(key, entry.record["runs"])
            sets = calibration.sets(calibration.thresholds()[0], journal)
            absent += [(part, lacks(group, part, sets)) for part in judged]
        missing += [(part, count) for part, count in absent if count]
    trials = sum(len(part.repeats) for parts in (*first, *then) for part in parts)
    cached = {job.path: job.path.exists() for job in plan.renders}
    needed = {path for part, _ in missing for path in part.batch.paths if not cached[path]}
    return SweepEstimate(
        renders=len(cached),
        cached=sum(cached.values()),
        to_render=len(needed),
        trials=trials,
        found=trials - sum(count for _, count in missing),
        trials_known=is_known,
    )
