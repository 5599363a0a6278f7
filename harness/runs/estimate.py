"""Shows the progress of a sweep, and its amount of work in advance."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from harness.experiment.schema import CaptureSource, Experiment
from harness.runs.expected import RunWork, expected, kind_of
from harness.runs.jobs import Outcome
from harness.runs.journal import Journal
from harness.runs.options import EngineOptions
from harness.runs.plan import SweepPlan, parts_of, plan_of
from harness.runs.shards import Shard
from harness.vocabulary.text import many

PLAIN_EVERY_S = 10.0  # seconds between progress lines in a log, if there is no terminal
WINDOW_S = 60.0  # rates are those of the last minute, because set-ups differ in speed


@contextmanager
def progress_display(
    stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
) -> Iterator[Callable[[Outcome], None]]:
    """Yield a function that shows the progress of a run on ``stream`` (None: stderr). Rates
    exclude work found done."""
    stream = sys.stderr if stream is None else stream
    names = ("counts", "rate", "failed", "left")
    columns = [
        TextColumn(f"{'[bold red]' * (name == 'failed')}{{task.fields[{name}]}}") for name in names
    ]
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
    stages = {
        name: bars.add_task(name, counts="", rate="", failed="", left="")
        for name in ("renders", "trials")
    }
    last = ""
    said_at = float("-inf")

    def show(outcome: Outcome | None) -> None:
        nonlocal last, said_at
        if outcome is not None:
            for name, task in stages.items():
                counts = getattr(outcome, name)
                state = bars.tasks[task]
                total = counts.total - counts.found - counts.failed
                bars.update(task, completed=counts.done, total=total)
                speed = state.speed if state.speed and total > counts.done else None
                time_left = (
                    str(timedelta(seconds=round((total - counts.done) / speed))) if speed else ""
                )
                bars.update(
                    task,
                    counts=f"{counts.over}/{counts.total}"
                    + (f" ({counts.found} found)" if counts.found else ""),
                    rate=f"{speed:.{0 if speed >= 10 else 2}f}/s" if speed else "",
                    failed=f"{counts.failed} failed" if counts.failed else "",
                    left=f"about {time_left} left" if time_left else "",
                )
        if (
            bars.disable
            and bars.tasks[0].fields["counts"]
            and (outcome is None or clock() >= said_at + PLAIN_EVERY_S)
        ):
            lines = (
                " ".join(filter(None, [task.description, *map(task.fields.get, names)]))
                for task in bars.tasks
            )
            text = ", ".join(lines)
            if text != last:
                last = text
                said_at = clock()
                print(text, file=stream, flush=True)

    with bars:
        try:
            yield show
        finally:
            show(None)


def dry_run(experiment: Experiment, out: Path, options: EngineOptions) -> int:
    """Print the amount of work of a sweep or of one shard, without writing anything."""
    name = experiment.config.name
    folder = experiment.folder(out)
    points = many(len(experiment.points), "point")
    if isinstance(experiment.config.source, CaptureSource):
        print(f"{name}: valid; {points} of a real capture; results: {folder}")
        return 0
    cache = Path(out) / ".cache" / "renders"
    journal = Journal(folder / "journal")
    plan = plan_of(experiment, cache)
    views, work = _work_of(plan, options.shard)
    of_first = first_work(experiment, journal, cache, options.shard)
    print(f"{name}: valid" + ("" if options.shard.is_whole else f"; shard {options.shard}"))
    print(f"  {points}, {many(len(plan.groups), 'set')} of frames")
    cached = sum(path.exists() for path in views)
    most = "" if of_first is None else " at most"
    print(f"  renders: {work.renders}{most}, {cached} of them cached")
    print(f"  trials: {work.trials}{most}")
    stored_records = len(journal)
    if stored_records:
        print(
            f"  the journal holds {many(stored_records, 'trial')}; those of the same code "
            "and settings are not run again"
        )
    processes = 1 if options.serial else options.jobs
    kind = kind_of(experiment)
    print(f"  {expected(Path(out), name, kind, work, processes, of_first)}")
    print(f"  results would go to {folder}")
    return 0


def _work_of(plan: SweepPlan, shard: Shard) -> tuple[set[Path], RunWork]:
    """Return the files of the views that a shard of a plan needs, and its amount of work."""
    calibrating, judged = parts_of(plan, shard)
    parts = [part for group in (*calibrating, *judged) for part in group]
    views = {path for part in parts for path in part.batch.paths}
    trials = sum(len(part.repeats) for part in parts)
    return views, RunWork(len(views), trials)


def first_work(
    experiment: Experiment, journal: Journal, cache: Path, shard: Shard
) -> RunWork | None:
    """Return the work on the boards that a study with a precision needs in any case: the first,
    and those that its journal has added. Return None for any other experiment."""
    study = experiment.config.study
    if study is None or study.precision is None:
        return None
    from harness.runs.precision import Batches  # loads the statistics of studies

    first = Batches(experiment, journal, cache, experiment.folder(cache)).first()
    return _work_of(first, shard)[1]
