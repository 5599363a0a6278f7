"""What a dry run says: exact counts of what there is to do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from harness.engine.estimate import SweepEstimate, dry_run, estimate
from harness.engine.journal import Journal
from harness.engine.plan import SweepPlan, plan_of
from harness.engine.work import Ended, EngineOptions, Shard, State
from harness.experiment.load import load_experiment

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
STUDY = [
    "study.boards=3",
    "study.hole_free_boards=2",
    "threshold.calibrate.boards=20",
    "sweep={capture.frames: [1, 50]}",
]


def plan(cache: Path, name: str = "smoke", *overrides: str) -> SweepPlan:
    return plan_of(load_experiment(EXPERIMENTS / f"{name}.yaml", list(overrides)), cache / "renders")


def counted(what: SweepPlan, journal: Journal, **options: Any) -> SweepEstimate:
    return estimate(what, journal, EngineOptions(**options))


def fill(journal: Journal, what: SweepPlan, batches: str, thresholds: dict[str, float], state: State = "done") -> int:
    count = 0
    for group in what.groups:
        for batch in getattr(group, batches):
            for key, task in group.trials(batch, thresholds):
                runs = [{"point": p.digest, "quiet_threshold": 4.0, "inspected_m2": 0.05} for p in task.points]
                journal.write(key, Ended(state, json.dumps({"runs": runs}) if state == "done" else None))
                count += 1
    return count


def test_cached_renders_and_recorded_trials_are_not_to_do(tmp_path):
    what, journal = plan(tmp_path), Journal(tmp_path / "journal")
    found = counted(what, journal)
    assert (found.renders, found.cached, found.to_render) == (3, 0, 3)
    assert (found.trials, found.found, found.trials_known) == (12, 0, True)
    what.renders[0].path.parent.mkdir(parents=True)
    what.renders[0].path.touch()
    some = counted(what, journal)
    assert (some.cached, some.to_render) == (1, 2)
    # hole-free trials set the thresholds; with them the judged ones can be looked for
    assert counted(what, journal).found == 0
    assert fill(journal, what, "first", {}) == 6 == counted(what, journal).found
    fill(journal, what, "then", {point.digest: 4.0 for group in what.groups for point in group.points})
    over = counted(what, journal)
    assert (over.found, over.to_render) == (12, 0)
    assert over.lines()[-1] == "nothing to run; the report is written anew"


def test_skipped_trials_are_still_to_do_and_failed_ones_are_not(tmp_path):
    what, journal = plan(tmp_path), Journal(tmp_path / "journal")
    assert fill(journal, what, "first", {}, "skipped") == 6
    assert counted(what, journal).found == 0
    fill(journal, what, "first", {}, "failed")
    assert counted(what, journal).found == 6
    assert counted(what, journal, retry_failed=True).found == 0


def test_where_calibrations_are_missing_the_judged_trials_are_not_known(tmp_path):
    what, journal = plan(tmp_path), Journal(tmp_path / "journal")
    group = what.groups[0]
    key, _ = next(iter(group.trials(group.first[0], {})))
    journal.write(key, Ended("done", '{"runs": []}'))
    found = counted(what, journal)
    assert not found.trials_known and found.found == 1
    assert "judged ones are looked for once thresholds are set" in found.lines()[1]


def test_shards_share_the_trials(tmp_path):
    what, journal = plan(tmp_path, "detection_limit", *STUDY), Journal(tmp_path / "journal")
    parts = [counted(what, journal, shard=Shard(number, 3)) for number in (1, 2, 3)]
    assert counted(what, journal).trials == 25 and sum(part.trials - 20 for part in parts) == 5
    assert all(part.to_render == part.trials for part in parts)


def test_the_dry_run_writes_nothing(tmp_path, capsys):
    experiment = load_experiment(EXPERIMENTS / "smoke.yaml", [])
    assert dry_run(experiment, tmp_path / "out", EngineOptions()) == 0
    assert not (tmp_path / "out").exists()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "smoke: valid"
    assert lines[2:4] == [
        "  renders: 3, 0 of them cached, 3 to do",
        "  trials: 12, 0 of them in the journal, 12 to do",
    ]
    assert str(experiment.folder(tmp_path / "out")) in lines[-1]
