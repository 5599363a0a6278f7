"""The progress of a sweep, and the estimate before it runs: what is there already, the time and disk of the rest.

Costs are rates that earlier runs measured on this machine, kept beside the cache of renders: seconds and bytes a pixel
of a render, seconds a trial for each pixel and frame, bytes a record. Other programs on the machine and unlike
detectors are not modelled, so the estimate is rough where the experiment is another one than those that were measured.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import NamedTuple, TextIO

from harness.engine.journal import Journal
from harness.engine.plan import Batch, Group, PlanPart, RenderJob, SweepPlan, parts_of, plan_of
from harness.engine.run import Calibration
from harness.engine.work import EngineOptions, Outcome
from harness.experiment.schema import Experiment
from harness.listing import size_text
from harness.tables.text import many
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, strict_json, write_text
from harness.vocabulary.geometry import MM
from scenes.sensor.camera import camera_of

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


RATES_NAME = "rates.json"
RATES_VERSION = 2
FORGOTTEN = 0.5  # weight of earlier runs, each time: machines and code change
LEAST_S = 1.0  # seconds of work: less says nothing about a machine
Rates = dict[str, tuple[float, float, int]]
"""Work, what it took (seconds or bytes), and number of runs, by name of the rate."""


class SweepEstimate(NamedTuple):
    """Counts of what there is to do; ``found``: trials in the journal. ``trials_known``: False without thresholds.
    ``costs``: seconds of "renders" and "trials", bytes of "stored" renders and "records"; None where this machine has
    measured none; ``runs``: of how many runs."""

    renders: int
    cached: int
    to_render: int
    trials: int
    found: int
    trials_known: bool
    costs: dict[str, float | None]
    runs: int

    def lines(self, processes: int) -> list[str]:
        """Return the same as text, for so many processes."""
        later = "" if self.trials_known else "; judged ones are looked for once thresholds are set"
        to_run, costs = self.trials - self.found, {name: cost or 0.0 for name, cost in self.costs.items()}
        lines = [
            f"renders: {self.renders}, {self.cached} of them cached, {self.to_render} to do",
            f"trials: {self.trials}, {self.found} of them in the journal, {to_run} to do{later}",
        ]
        if not self.to_render and not to_run:
            return [*lines, "nothing to run; the report is written anew"]
        if None in self.costs.values():
            return [*lines, "time and disk: not known on this machine yet; the first run measures them"]
        on = f"{processes} process" + ("es" if processes > 1 else "")
        work = f"work: renders {duration(costs['renders'])}, trials {duration(costs['trials'])}"
        return [
            *lines,
            f"time: about {duration((costs['renders'] + costs['trials']) / processes)} on {on} ({work})",
            f"disk: renders {size_text(costs['stored'])}, journal {size_text(costs['records'])} more",
            f"measured: {many(self.runs, 'run')} of this machine; expect a factor of 2",
        ]


def dry_run(experiment: Experiment, out: Path, options: EngineOptions) -> int:
    """Say what a sweep would run and what that would take; nothing is written."""
    folder, cache = experiment.folder(out), Path(out) / ".cache"
    plan = plan_of(experiment, cache / "renders")
    found = estimate(plan, Journal(folder / "journal"), read_rates(cache), options)
    cores = os.cpu_count() or 1
    processes = 1 if options.serial else options.jobs if options.scheduler else min(options.jobs, cores)
    print(f"{experiment.config.name}: valid" + ("" if options.shard.is_whole else f"; shard {options.shard}"))
    print(f"  {many(len(experiment.points), 'point')}, {many(len(plan.groups), 'set')} of frames")
    print("\n".join(f"  {line}" for line in found.lines(processes)))
    print(f"  results would go to {folder}")
    return 0


def estimate(plan: SweepPlan, journal: Journal, rates: Rates, options: EngineOptions) -> SweepEstimate:
    """Count the finished trials of a plan (or of a shard of it), and estimate the rest."""
    over = ("done",) if options.retry_failed else ("done", "failed", "crashed", "timed out")
    first, then = parts_of(plan, options.shard)
    missing, is_known = [], True

    def lacks(group: Group, part: PlanPart, sets: list[dict[str, float]]) -> int:
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
        missing += [(group, part.batch, count) for part, count in absent if count]
    trials = sum(len(part.repeats) for parts in (*first, *then) for part in parts)
    to_run = sum(count for *_, count in missing)
    needed = {job.path: job for _, batch, _ in missing for job in batch.renders if not job.path.exists()}
    pixels = sum(map(_pixels, needed.values()))
    work = {"renders": pixels, "stored": pixels, "trials": _pixel_frames(missing), "records": float(to_run)}
    used = [rates.get(_name(plan, stage), (0.0, 0.0, 0)) for stage in work]
    costs = {
        stage: None if amount and not rate[2] else rate[1] * amount / (rate[0] or 1.0)
        for (stage, amount), rate in zip(work.items(), used, strict=True)
    }
    return SweepEstimate(
        renders=len(plan.renders),
        cached=sum(job.path.exists() for job in plan.renders),
        to_render=len(needed),
        trials=trials,
        found=trials - to_run,
        trials_known=is_known,
        costs=costs,
        runs=min((rate[2] for amount, rate in zip(work.values(), used, strict=True) if amount), default=0),
    )


def learn(plan: SweepPlan, outcome: Outcome, journal: Journal, cache: Path) -> Rates:
    """Put what a run took, of a shard too, into the rates, and write them beside the renders' folder; returns them. A
    folder that cannot be written is no matter."""
    rates = read_rates(cache)
    batches = [(group, batch, group.most_repeats(batch)) for group in plan.groups for batch in group.batches]
    pixels = sum(map(_pixels, plan.renders))
    stored = [job for job in plan.renders if outcome.renders.done and job.path.exists()]
    size = sum(map(journal.size, outcome.finished)) if outcome.trials.done else 0
    measured = {
        "renders": (pixels * outcome.renders.done / max(len(plan.renders), 1), outcome.renders.seconds),
        "stored": (sum(map(_pixels, stored)), sum(job.path.stat().st_size for job in stored)),
        "trials": (_pixel_frames(batches) * outcome.trials.done / max(plan.trial_count, 1), outcome.trials.seconds),
        "records": (len(outcome.finished), size),
    }
    learnt = dict(rates)
    for stage, (work, taken) in measured.items():
        if work and taken >= LEAST_S:
            before = rates.get(_name(plan, stage), (0.0, 0.0, 0))
            learnt[_name(plan, stage)] = FORGOTTEN * before[0] + work, FORGOTTEN * before[1] + taken, before[2] + 1
    if learnt != rates:
        with contextlib.suppress(UserError):
            text = json.dumps({"version": RATES_VERSION, "rates": learnt}, indent=2, sort_keys=True)
            write_text(cache / RATES_NAME, text + "\n")
    return learnt


def read_rates(cache: Path) -> Rates:
    """Read the rates of this machine. A file that is absent, damaged or of another version says nothing."""
    try:
        said = strict_json(bounded_bytes(cache / RATES_NAME, TEXT_BYTES))
        rates = {name: (float(rate[0]), float(rate[1]), int(rate[2])) for name, rate in said["rates"].items()}
        whole = all(isfinite(work) and work > 0 and isfinite(taken) and taken > 0 for work, taken, _ in rates.values())
        return rates if said["version"] == RATES_VERSION and whole else {}
    except (OSError, UserError, ValueError, TypeError, LookupError, AttributeError, OverflowError):
        return {}


def _name(plan: SweepPlan, stage: str) -> str:
    """The name of a rate: work before unlike kinds of cameras is measured apart."""
    kinds = {str(camera_of(job.camera).kind) for job in plan.renders}
    return f"{stage} of {' and '.join(sorted(kinds))}"


def _pixels(job: RenderJob) -> float:
    """Pixels of the board, as if it faced the camera."""
    lens, board = camera_of(job.camera).optics.lens, job.target.board
    distance_mm = float(job.target.pose.T_camera_board[2, 3]) / MM
    return lens.fx * lens.fy * board.width_mm * board.height_mm / distance_mm**2


def _pixel_frames(trials: list[tuple[Group, Batch, int]]) -> float:
    """The work of so many trials of each batch: pixels for each frame; judging a point counts as a frame."""
    work = 0.0
    for group, batch, count in trials:
        frames = [point.config.capture.frames for point in group.points]
        work += count * (max(frames) + len(frames)) * sum(map(_pixels, batch.renders))
    return work
