"""The run loop with an engine that runs nothing and ends jobs in any order: no trial is lost,
whatever happens when."""

from __future__ import annotations

import hashlib
import random
import re
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.programs.cluster.merge import merge_into
from harness.runs import run as engine_run
from harness.runs.jobs import Ended, Job, Outcome, Stage, State
from harness.runs.journal import Journal, record_text
from harness.runs.pictures import is_shown
from harness.runs.plan import Group, SweepPlan, parts_of, plan_of
from harness.runs.run import examples_of, run_plan
from harness.runs.shards import Shard
from harness.trials.judge import FINDING_OCTAVES, grid
from harness.trials.trial import Trial
from tests.support.serial_run import trial_count
from tests.support.tiny_sweep import STUDY, TINY

STATES: tuple[State, ...] = ("failed", "crashed", "timed out")


class Pretended:
    """An engine: records are made up from the task, jobs end in the order that ``seed`` draws, or
    badly by ``ends``."""

    def __init__(
        self,
        seed: int = 0,
        ends: Callable[[Job], State | None] = lambda job: None,
        factor: float = 1.0,
    ) -> None:
        self._rng = random.Random(seed)
        self._ends = ends
        self._factor = factor
        self._jobs: list[Job] = []
        self.begun: Counter[str] = Counter()

    def __enter__(self) -> Pretended:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def room(self, stage: Stage) -> int:
        return 4 - len(self._jobs)

    def submit(self, job: Job) -> None:
        self._jobs.append(job)
        self.begun[job.name] += 1

    def ended(self) -> list[tuple[Job, Ended]]:
        job = self._jobs.pop(self._rng.randrange(len(self._jobs)))
        state = self._ends(job)
        if state is not None:
            return [(job, Ended(state, why="a fault"))]
        if job.stage == "renders":
            return [(job, Ended("done", (False, 0.1)))]
        if job.name.startswith("pictures"):
            return [(job, Ended("done", [job.name]))]
        return [(job, Ended("done", made_up(job.arguments[0], self._factor)))]


def made_up(task: Trial, factor: float = 1.0) -> str:
    """A record. ``factor``: by which this machine's scores differ from another's."""
    word = hashlib.sha256(f"{task.board} {task.repeat} {task.role}".encode()).digest()
    quiet = factor * (3 + word[0] / 256)
    runs = [
        {
            "point": point.digest,
            "variant": point.variant,
            "frames": point.frames,
            "quiet_threshold": quiet if point.criteria.threshold is None else None,
            "inspected_m2": 0.06,
            "threshold": point.criteria.threshold,
        }
        for point in task.points
    ]
    operating = [
        {
            "variant": point.variant,
            "frames": point.frames,
            "threshold": grid(point.criteria.threshold, FINDING_OCTAVES).tolist(),
        }
        for point in task.points
        if point.criteria.threshold is not None
    ]
    return record_text({"runs": runs, "operating": operating})


PLANS = {
    "units that share renders": (
        TINY,
        ["sweep={source.camera.unit_seed: [1, 2], capture.frames: [1, 3]}"],
    ),
    "distances": (TINY, ["sweep={source.target.distance_m: [0.6, 0.7]}", "repeats=3"]),
    "a given threshold": (TINY, ["threshold={k: 5.0}", "sweep={source.camera.unit_seed: [1, 2]}"]),
    "many repeats": (TINY, ["repeats=259", "threshold={calibrate: {repeats: 257}}"]),
    "a study": (STUDY, []),
    "a study of two distances": (STUDY, ["sweep={source.target.distance_m: [0.6, 0.7]}"]),
    "a study of two ranges of damage": (
        STUDY,
        ["sweep={source.target.damage.diameter_mm: [[2.0, 8.0], [4.0, 9.0]]}"],
    ),
}


@pytest.fixture(params=PLANS)
def plan(request: pytest.FixtureRequest, tmp_path: Path) -> SweepPlan:
    text, changes = PLANS[request.param]
    (tmp_path / "tiny.yaml").write_text(text)
    return plan_of(load_experiment(tmp_path / "tiny.yaml", changes), tmp_path / "renders")


def go(plan: SweepPlan, folder: Path, engine: Pretended, **asked: object) -> Outcome:
    return run_plan(plan, Journal(folder), engine, lambda _: None, **asked)  # type: ignore[arg-type]


def records(folder: Path) -> dict[str, str | None]:
    return {key: entry.value for key, entry in Journal(folder).entries()}


def test_every_trial_and_picture_is_begun_once_in_any_order(plan, tmp_path):
    expected = None
    for seed in range(2):
        engine = Pretended(seed)
        outcome = go(plan, tmp_path / str(seed), engine)
        assert set(engine.begun.values()) == {1}
        assert (
            outcome.failures == []
            and len(outcome.finished) == trial_count(plan) == outcome.trials.done
        )
        assert outcome.renders.done == len(plan.renders)
        pictures = [
            f"pictures of set-up {n}" for n, group in enumerate(plan.groups) if is_shown(group)
        ]
        assert examples_of(plan, outcome, Pretended(seed)) == pictures
        result = (records(tmp_path / str(seed)), outcome.thresholds, outcome.finished)
        assert expected is None or result == expected
        expected = result


VARIED = """\
sensitivity:
  repeats: 1
  calibration_repeats: 1
  frames: [3]
  vary:
    - {path: source.camera.unit_seed, values: [2, 3], reason: another unit}
"""


@pytest.mark.parametrize(
    ("changes", "drawn"),
    [
        ([], ["pictures of set-up 0"]),
        (["sweep={source.camera.unit_seed: [1, 2]}", "sensitivity=null"], []),
    ],
)
def test_pictures_are_drawn_only_of_what_a_page_shows(changes, drawn, tmp_path):
    """A page shows the clouds of the only set-up, but neither of several nor of variations."""
    (tmp_path / "tiny.yaml").write_text(TINY + VARIED)
    plan = plan_of(load_experiment(tmp_path / "tiny.yaml", changes), tmp_path / "renders")
    outcome = go(plan, tmp_path / "journal", Pretended())
    assert len(plan.groups) > 1
    assert examples_of(plan, outcome, Pretended()) == drawn


def test_resuming_from_any_state_ends_the_same(plan, tmp_path):
    """Any trials are missing from the journal, others are left as failed or skipped."""
    complete = go(plan, tmp_path / "whole", Pretended())
    rng = random.Random(1)
    for number in range(3):
        folder = tmp_path / str(number)
        kept = 0
        journal = Journal(folder)
        source = Journal(tmp_path / "whole")
        for key in complete.finished:
            entry = source.read(key)
            assert entry is not None
            chance = rng.random()
            if number == 0 or chance < 0.5:
                journal.write(key, entry)
                kept += 1
            elif chance < 0.7:
                journal.write(key, Ended(rng.choice((*STATES, "skipped")), why="before"))
        engine = Pretended(number)
        outcome = go(plan, folder, engine, retry_failed=True)
        assert (outcome.trials.found, outcome.trials.over) == (kept, trial_count(plan))
        assert outcome.failures == [] and outcome.finished == complete.finished
        assert records(folder) == records(tmp_path / "whole")
        if number == 0:
            assert not engine.begun, "nothing is rendered or run again"
            assert examples_of(plan, outcome, engine) == examples_of(plan, complete, Pretended())
            groups = [group for group in plan.groups if is_shown(group)]
            shown = {job.path.name for group in groups for job in group.damaged.renders}
            assert {name for name in engine.begun if name.endswith(".npz")} == shown


def test_whatever_fails_is_told_and_nothing_hangs(plan, tmp_path, request):
    """Renders, calibrations and judged trials end badly at random; mended by running on."""
    without_threshold = 0
    for seed in range(3):
        rng = random.Random(seed)

        def ends(job: Job, rng: random.Random = rng) -> State | None:
            return rng.choice(STATES) if rng.random() < 0.2 else None

        folder = tmp_path / str(seed)
        engine = Pretended(seed, ends)
        outcome = go(plan, folder, engine)
        examples_of(plan, outcome, engine)
        assert outcome.trials.over == outcome.trials.total
        assert outcome.trials.failed <= len(outcome.failures)
        reasons = {"a fault"}
        for failure in outcome.failures:
            if failure.what.startswith("threshold of "):
                without_threshold += 1
                assert re.match(r"(no|\d+) hole-free runs? ", failure.why)
                reasons |= {failure.why, f"no threshold: {failure.in_short}"}
        assert {failure.why for failure in outcome.failures} <= reasons
        mended = go(plan, folder, Pretended(seed), retry_failed=True)
        assert mended.failures == [] and len(mended.finished) == trial_count(plan)
    is_calibrated = "a given threshold" not in request.node.name
    assert (without_threshold > 0) == is_calibrated


def test_a_render_whose_process_dies_is_tried_once_more(plan, tmp_path):
    died: Counter[str] = Counter()

    def ends(job: Job) -> State | None:
        died[job.name] += job.stage == "renders"
        return "crashed" if died[job.name] == 1 else None

    outcome = go(plan, tmp_path / "journal", Pretended(0, ends))
    assert outcome.failures == [] and set(died.values()) <= {0, 2}


def test_a_calibration_whose_process_dies_is_tried_once_more(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    plan = plan_of(load_experiment(tmp_path / "tiny.yaml"), tmp_path)
    died: Counter[str] = Counter()

    def ends(job: Job) -> State | None:
        died[job.name] += job.name.startswith("hole_free")
        return "crashed" if died[job.name] == 1 else None

    outcome = go(plan, tmp_path / "journal", Pretended(0, ends))
    assert outcome.failures == [] and sorted(died.values())[-2:] == [2, 2]


def test_shards_that_finish_each_others_calibration(plan, tmp_path):
    """While one shard works, another in the same folder does; in any order of events no judged
    trial is lost."""
    complete = go(plan, tmp_path / "whole", Pretended())
    for seed in range(3):
        folder = tmp_path / str(seed)

        def other_is_faster(job: Job, folder: Path = folder) -> None:
            source = Journal(tmp_path / "whole")
            journal = Journal(folder)
            for key in complete.finished:
                entry = source.read(key)
                if entry is not None and key.startswith(("calibration", "hole_free")):
                    journal.write(key, entry)

        rng = random.Random(seed)
        index = rng.randrange(1, 6)

        def ends(job: Job, at: int = index, seen: list[str] = [], faster=other_is_faster) -> None:  # noqa: B006
            seen.append(job.name)
            if len(seen) == at:
                faster(job)

        total = 0
        for number in (1, 2):
            outcome = go(plan, folder, Pretended(seed, ends), shard=Shard(number, 2))
            assert outcome.failures == [] and outcome.trials.over == outcome.trials.total
            total += outcome.trials.over
        joined = go(plan, folder, Pretended())
        assert (joined.trials.done, joined.trials.found) == (0, trial_count(plan))
        assert total >= trial_count(plan)


def shards_of_unlike_machines(plan: SweepPlan, home: Path, factor: float) -> Path:
    """Two shards, each with a folder of its own, the second on a machine whose scores differ by a
    factor; merged into a third folder."""
    into = Journal(home / "into")
    for number, own_factor in ((1, 1.0), (2, factor)):
        go(plan, home / str(number), Pretended(factor=own_factor), shard=Shard(number, 2))
        assert not merge_into(into, Journal(home / str(number)), Counter()) or factor == 1.01
    return home / "into"


def test_shards_of_unlike_machines_lose_no_work(plan, tmp_path):
    """Their thresholds differ in the last digits: nothing is judged again, and all rows state the
    threshold in use."""
    complete = go(plan, tmp_path / "whole", Pretended())
    into = shards_of_unlike_machines(plan, tmp_path, 1 + 1e-9)
    joined = go(plan, into, Pretended())
    assert (joined.trials.done, joined.trials.found, joined.failures) == (0, trial_count(plan), [])
    assert joined.thresholds == pytest.approx(complete.thresholds, rel=1e-8)
    journal = Journal(into)
    for key in joined.finished:
        entry = journal.read(key)
        assert entry is not None and entry.record is not None
        of = {
            (run["variant"], run["frames"]): joined.thresholds[run["point"]]
            for run in entry.record["runs"]
        }
        assert all(
            run["threshold"] in (None, of[run["variant"], run["frames"]])
            for run in entry.record["runs"]
        )
        for row in entry.record["operating"]:
            assert (
                row["threshold"]
                == grid(of[row["variant"], row["frames"]], FINDING_OCTAVES).tolist()
            )


def test_shards_whose_thresholds_differ_by_more_are_judged_anew(plan, tmp_path):
    into = shards_of_unlike_machines(plan, tmp_path, 1.01)
    joined = go(plan, into, Pretended())
    judged = [parts_of(plan, Shard(number, 2))[1] for number in (1, 2)]
    # groups that share their trials before thresholds also share them between shards
    leaders = [group.leader or group for group in plan.groups]
    shards = [
        [id(leader) for leader, parts in zip(leaders, parts_of_leaders, strict=True) if parts]
        for parts_of_leaders in judged
    ]
    pair = [
        group for group in leaders if all(id(group) in shard for shard in shards) and group.first
    ]
    calibrates = any(
        point.config.threshold.calibrate is not None for group in pair for point in group.points
    )
    assert (joined.trials.done > 0) == calibrates
    assert joined.failures == [] and joined.trials.over == trial_count(plan)


def test_work_ahead_is_bounded(tmp_path, monkeypatch):
    """However many repeats: a few thousand tasks are in memory, and the engine gets its first at
    once."""
    (tmp_path / "tiny.yaml").write_text(TINY)
    changes = ["repeats=100000", "threshold={k: 5.0}"]
    plan = plan_of(load_experiment(tmp_path / "tiny.yaml", changes), tmp_path)
    created = []
    real = Group._key

    class Stopped(Pretended):
        def ended(self) -> list[tuple[Job, Ended]]:
            raise KeyboardInterrupt

    monkeypatch.setattr(Group, "_key", lambda *one: created.append(1) or real(*one))
    with pytest.raises(KeyboardInterrupt):
        go(plan, tmp_path / "journal", Stopped())
    assert 0 < len(created) <= engine_run.AHEAD + 256
