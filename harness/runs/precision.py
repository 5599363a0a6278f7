"""Runs a study with a stated precision in batches of damaged boards: a plan, its trials, their
limits, and from these the sizes of the next batch.

The journal keeps each batch's sizes before it runs, under a key of everything that determines
them. So a study resumes to the same boards, also after a failed trial has been repeated."""

from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import BoardDesign, StudyRecord
from harness.evaluation.study.sequential import first_design, next_design
from harness.experiment.schema import Experiment, Point, PrecisionConfig, StudyConfig
from harness.runs.job_batches import values_of
from harness.runs.jobs import Ended, JobEngine, Outcome
from harness.runs.journal import DESIGNS, JOURNAL_VERSION, Journal
from harness.runs.plan import PACKAGES, Designs, SweepPlan, family_of, plan_of, trial_code
from harness.runs.shards import Shard
from harness.runs.study_record import set_up_record
from harness.runs.tables import tables_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.path_names import in_words
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import canonical_json, digest
from scenes.target.drawn import DrawnTargetConfig

_limit_of = partial(limit_of, draws=10)
"""No batch hangs on resampled boards, which serve comparisons."""
RULE = ("harness.evaluation.study.sequential",)
"""With all that it imports, this module decides the sizes of a batch."""


def refuse_shard(experiment: Experiment, shard: Shard) -> None:
    """Raise UserError for a part of a study with a precision."""
    study = experiment.config.study
    if study is not None and study.precision is not None and not shard.is_whole:
        raise UserError(
            f"--shard {shard}: the sizes of a study with a precision follow from its boards before",
            fix="run it whole (on a cluster with --scheduler), or with study.precision=null",
        )


def families_of(experiment: Experiment) -> dict[str, list[Point]]:
    """Return the points of each family of boards, in the experiment's order."""
    families: dict[str, list[Point]] = {}
    for point in experiment.points:
        families.setdefault(family_of(point), []).append(point)
    return families


def recorded_designs(experiment: Experiment, study: StudyRecord) -> Designs:
    """Return the boards of a finished study; empty if it had no precision."""
    if not study.designs:
        return {}
    return dict(zip(families_of(experiment), study.designs, strict=True))


@dataclass(frozen=True)
class Batches:
    """The plans of an experiment, each with the trials of those before it: one for each batch of
    boards of a study with a precision, and one in all of any other experiment."""

    experiment: Experiment
    """The experiment."""
    journal: Journal
    """Its trials, and the sizes of its batches."""
    cache: Path
    """The cache of renders."""
    folder: Path
    """The folder of results."""

    def first(self) -> SweepPlan:
        """Return the plan of the first boards and of all batches that the journal knows."""
        study = self.experiment.config.study
        designs = {}
        if study is not None and study.precision is not None:
            for family, points in self._families.items():
                first = self._first_design(study, study.precision, points)
                designs[family] = _stored_design(first, points, self.journal)
        return self._plan(designs)

    def after(self, plan: SweepPlan, outcome: Outcome, engine: JobEngine) -> SweepPlan | None:
        """Return the plan with the next batch after a plan that has been run; None if there is
        none."""
        if not outcome.finished or not outcome.thresholds:
            return None
        open_designs = [family for family, design in plan.designs.items() if not design.reason]
        if not open_designs:
            return None
        limits = self._limits(plan, outcome, engine)
        designs = dict(plan.designs)
        for family in open_designs:
            points = self._families[family]
            known = [limits[point.digest] for point in points if point.digest in limits]
            designs[family] = next_design(plan.designs[family], known)
            _store(designs[family], _key(plan.designs[family], points), self.journal)
        return self._plan(designs)

    def _plan(self, designs: Designs) -> SweepPlan:
        return plan_of(self.experiment, self.cache, self.folder, designs)

    @cached_property
    def _families(self) -> dict[str, list[Point]]:
        return families_of(self.experiment)

    def _first_design(
        self, study: StudyConfig, precision: PrecisionConfig, points: list[Point]
    ) -> BoardDesign:
        """Return the first boards of a family."""
        target = points[0].config.simulated.target
        assert isinstance(target, DrawnTargetConfig)
        damage = target.damage
        low_mm, high_mm = damage.limit_range_mm
        words = f"{in_words(damage.kind)}, {damage.limit_of} {low_mm:g} to {high_mm:g} mm"
        return first_design(
            damage=words if len(self._families) > 1 else "",
            range_mm=(low_mm, high_mm),
            per_board=damage.per_board,
            most_boards=study.boards,
            a90_mm=precision.a90_mm,
            a90_percent=precision.a90_percent,
        )

    def _limits(
        self, plan: SweepPlan, outcome: Outcome, engine: JobEngine
    ) -> dict[str, SetUpLimit]:
        """Return the limits so far by the digests of points, without points that have no judged
        board."""
        tables = tables_of(self.journal.records(outcome.finished), self.experiment)
        records = {}
        for point in self.experiment.points:
            record = set_up_record(point, plan, tables, failed_count=0)
            if record is not None:
                records[point.digest] = record
        arguments = [(record,) for record in records.values()]
        limits = {}
        for name, limit in zip(records, values_of(_limit_of, arguments, engine), strict=True):
            # a process that was lost costs no batch
            limits[name] = limit or _limit_of(records[name])
        return limits


def _stored_design(design: BoardDesign, points: list[Point], journal: Journal) -> BoardDesign:
    """Return a design with all batches that the journal has."""
    while not design.reason:
        entry = journal.read(_key(design, points))
        if entry is None or entry.record is None:
            break
        design = TypeAdapter(BoardDesign).validate_python(entry.record)
    return design


def _store(design: BoardDesign, key: str, journal: Journal) -> None:
    """Store a design that follows from what its key names."""
    data = TypeAdapter(BoardDesign).dump_python(design, mode="json")
    journal.write(key, Ended("done", canonical_json(data)))


def _key(design: BoardDesign, points: list[Point]) -> str:
    """Return the key of the design that follows from this one."""
    detectors = sorted({point.config.detector.name for point in points})
    content: list[Any] = [JOURNAL_VERSION, source_digest(RULE, PACKAGES)]
    content += [source_digest(trial_code(name), PACKAGES) for name in detectors]
    content += [[point.variant, point.digest, point.config.repeats] for point in points]
    content.append(TypeAdapter(BoardDesign).dump_python(design, mode="json"))
    return f"{DESIGNS}{design.boards:05d}-{digest(content)}"
