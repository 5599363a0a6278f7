"""States in advance what a run is expected to cost, by the bills of earlier runs: of the same
experiment in the same folder of results, else of the experiments that come with tofpod
(``results/baselines/bills.csv``), which `tests/benchmarks/jobs.py` measures on an idle machine."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

from harness.experiment.schema import Experiment
from harness.records.outputs import LATEST, PROVENANCE
from harness.report.blocks import BILL
from harness.runs.bill import FIXED, PHASES
from harness.vocabulary.files import RECORD_BYTES, bounded_bytes, shipped, strict_json
from harness.vocabulary.text import many

SHIPPED = "bills.csv"
"""File of the bills that come with tofpod, in its folder of baselines."""
SHOWN_IN_SECONDS = 90.0
"""Longer times are shown in minutes."""
Kind = Literal["study", "maps", "sweep"]


class RunWork(NamedTuple):
    """The amount of work of a run."""

    renders: int
    """Number of renders."""
    trials: int
    """Number of trials."""


@dataclass(frozen=True)
class PastRun:
    """The work and the cost of an earlier run."""

    experiment: str
    """Name of the experiment."""
    kind: str
    """Its kind (`kind_of`); empty if it is not known."""
    renders: int
    """Number of renders that it did."""
    trials: int
    """Number of trials that it did."""
    all_renders: int
    """Number of renders with those that it found stored."""
    all_trials: int
    """Number of trials, likewise."""
    renders_s: float
    """Processor seconds of renders."""
    trials_s: float
    """Processor seconds of frames and detection."""
    fixed_s: float
    """Processor seconds of all else."""


class _UnitCosts(NamedTuple):
    """Processor seconds of parts of a run; None where no bill tells them."""

    fixed_s: float | None
    """The fixed part."""
    render_s: float | None
    """A render."""
    trial_s: float | None
    """A trial."""

    def or_else(self, others: _UnitCosts) -> _UnitCosts:
        """Return these costs, and ``others`` where they are not known."""
        return _UnitCosts(
            fixed_s=others.fixed_s if self.fixed_s is None else self.fixed_s,
            render_s=others.render_s if self.render_s is None else self.render_s,
            trial_s=others.trial_s if self.trial_s is None else self.trial_s,
        )

    def parts_s(self, work: RunWork) -> tuple[float, float, float]:
        """Return the seconds of the fixed part, the renders and the trials of a run."""
        renders_s = work.renders * (self.render_s or 0.0)
        trials_s = work.trials * (self.trial_s or 0.0)
        return self.fixed_s or 0.0, renders_s, trials_s

    def whole_s(self, work: RunWork, cores: int) -> tuple[float, float]:
        """Return the seconds of a run, of processors and by the clock of a machine with idle
        cores. Its fixed part is one process' work."""
        fixed_s, renders_s, trials_s = self.parts_s(work)
        shared_s = renders_s + trials_s
        return fixed_s + shared_s, fixed_s + shared_s / cores


def kind_of(experiment: Experiment) -> Kind:
    """Return the kind of an experiment. Trials of the same kind cost about the same: a study's
    judge each board once, a sweep's the same board again and again, a map's have many views."""
    if experiment.config.study is not None:
        return "study"
    has_maps = any(point.config.mapping is not None for point in experiment.points)
    return "maps" if has_maps else "sweep"


def expected(
    out: Path, name: str, kind: Kind, most: RunWork, processes: int, least: RunWork | None = None
) -> str:
    """Return what a run of an experiment is expected to take, and from which bills that follows:
    of the same experiment in ``out``, else as it comes with tofpod, else of others of its kind. Of
    a study with a precision, ``least`` is the work on its first boards, and ``most`` on all."""
    own = [run for run in _runs_in(out) if run.experiment == name]
    of_name = [run for run in shipped_runs() if run.experiment == name]
    of_kind = [run for run in shipped_runs() if run.kind == kind]
    basis = "by the bills of earlier runs of this experiment"
    costs = _unit_costs(own)
    if None in costs and of_name:
        basis = "by the bill of this experiment that comes with tofpod"
        costs = costs.or_else(_unit_costs(of_name))
    if None in costs:
        basis = "roughly, by the bills of other experiments that come with tofpod"
        costs = costs.or_else(_unit_costs(of_kind)).or_else(_unit_costs(shipped_runs()))
    work = most if least is None else _expected_work(own or of_name, least, most)
    _, renders_s, trials_s = costs.parts_s(work)
    cores = min(processes, os.cpu_count() or 1)
    total_s, wall_s = costs.whole_s(work, cores)
    bound = ""
    if least is not None:
        most_s, most_wall_s = costs.whole_s(most, cores)
        bound = f", at most {_duration(most_s)} or {_duration(most_wall_s)}"
    return (
        f"expected from nothing: {_duration(total_s)} of processor time "
        f"({_duration(renders_s)} for renders, {_duration(trials_s)} for trials), "
        f"or {_duration(wall_s)} on {many(cores, 'idle core')}{bound}; {basis}"
    )


def _expected_work(runs: Sequence[PastRun], least: RunWork, most: RunWork) -> RunWork:
    """Return the work that a study with a precision is expected to need: that of its longest run
    so far, within its bounds; without one, the middle between these."""
    if not runs:
        return RunWork((least.renders + most.renders) // 2, (least.trials + most.trials) // 2)
    longest = max(runs, key=lambda run: run.all_trials)
    return RunWork(
        renders=min(max(longest.all_renders, least.renders), most.renders),
        trials=min(max(longest.all_trials, least.trials), most.trials),
    )


def _duration(seconds: float) -> str:
    """Return a time in words, in seconds or minutes."""
    return f"{seconds:.0f} s" if seconds < SHOWN_IN_SECONDS else f"{seconds / 60:.1f} min"


def _unit_costs(runs: Sequence[PastRun]) -> _UnitCosts:
    """Return the costs by these runs. One that found its renders or trials stored says nothing of
    what they cost."""
    return _UnitCosts(
        fixed_s=max((run.fixed_s for run in runs), default=None),
        render_s=_mean_cost((run.renders_s, run.renders) for run in runs),
        trial_s=_mean_cost((run.trials_s, run.trials) for run in runs),
    )


def _mean_cost(costs: Iterable[tuple[float, int]]) -> float | None:
    """Return the seconds of one piece of work, from (seconds, pieces) of several runs; None if
    none did any."""
    seconds = 0.0
    pieces = 0
    for run_seconds, run_pieces in costs:
        if run_pieces:
            seconds += run_seconds
            pieces += run_pieces
    return seconds / pieces if pieces else None


# ---------------------------------------------------------------- bills of earlier runs


def past_run(folder: Path, kind: str = "") -> PastRun | None:
    """Return what the run in a folder of results cost; None if that was not recorded."""
    try:
        facts: Any = strict_json(bounded_bytes(folder / PROVENANCE.name, RECORD_BYTES))
        seconds = {phase: float(facts[BILL][phase]) for phase in PHASES}
        renders = facts["renders"]
        trials = facts["trials"]
        return PastRun(
            experiment=folder.parent.name,
            kind=kind,
            renders=int(renders["done"]),
            trials=int(trials["done"]),
            all_renders=int(renders["done"]) + int(renders.get("cached", 0)),
            all_trials=int(trials["done"]) + int(trials.get("resumed", 0)),
            renders_s=seconds["renders"],
            trials_s=seconds["frames"] + seconds["detection"],
            fixed_s=sum(seconds[phase] for phase in FIXED),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _runs_in(out: Path) -> Iterator[PastRun]:
    """Yield the runs in a folder of results; the link to the latest is no further run."""
    for path in out.glob(f"*/*/{PROVENANCE.name}"):
        run = None if path.parent.name == LATEST else past_run(path.parent)
        if run is not None:
            yield run


@cache
def shipped_runs() -> tuple[PastRun, ...]:
    """Return the runs whose bills come with tofpod."""
    with (shipped("baselines") / SHIPPED).open(encoding="utf-8", newline="") as stream:
        return tuple(_run_of(texts) for texts in csv.DictReader(stream))


def _run_of(texts: dict[str, str]) -> PastRun:
    """Return a run, which found nothing stored, from a line of the table."""
    renders = int(texts["renders"])
    trials = int(texts["trials"])
    return PastRun(
        experiment=texts["job"],
        kind=texts["kind"],
        renders=renders,
        trials=trials,
        all_renders=renders,
        all_trials=trials,
        renders_s=float(texts["renders_s"]),
        trials_s=float(texts["trials_s"]),
        fixed_s=float(texts["fixed_s"]),
    )
