"""What a dry run says: counts that are exact, and costs that rest on what this machine has measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from harness.engine.estimate import RATES_NAME, RATES_VERSION, SweepEstimate, dry_run, estimate, learn, read_rates
from harness.engine.journal import Journal
from harness.engine.plan import SweepPlan, plan_of
from harness.engine.work import Ended, EngineOptions, Outcome, Shard, StageCounts, State
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


def counted(what: SweepPlan, journal: Journal, rates: dict | None = None, **options: Any) -> SweepEstimate:
    return estimate(what, journal, rates or {}, EngineOptions(**options))


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
    assert (over.found, over.to_render, set(over.costs.values())) == (12, 0, {0.0})
    assert over.lines(2)[-1] == "nothing to run; the report is written anew"


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
    assert "judged ones are looked for once thresholds are set" in found.lines(2)[1]


def test_shards_share_the_trials(tmp_path):
    what, journal = plan(tmp_path, "detection_limit", *STUDY), Journal(tmp_path / "journal")
    parts = [counted(what, journal, shard=Shard(number, 3)) for number in (1, 2, 3)]
    assert counted(what, journal).trials == 25 and sum(part.trials - 20 for part in parts) == 5
    assert all(part.to_render == part.trials for part in parts)


def test_the_dry_run_writes_nothing_and_says_that_nothing_was_measured(tmp_path, capsys):
    experiment = load_experiment(EXPERIMENTS / "smoke.yaml", [])
    assert dry_run(experiment, tmp_path / "out", EngineOptions()) == 0
    assert not (tmp_path / "out").exists()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "smoke: valid"
    assert [line.split(":")[0].strip() for line in lines[2:6]] == [
        "renders",
        "trials",
        "time and disk",
        lines[-1].split(":")[0].strip(),
    ]
    assert "not known on this machine yet" in lines[4] and str(experiment.folder(tmp_path / "out")) in lines[-1]


# ---------------------------------------------------------------- what is learnt


def outcome_of(what: SweepPlan, share: float = 1.0, seconds: float = 60.0) -> Outcome:
    """A run of some share of the trials that took 30 s for the renders and so long for all trials."""
    return Outcome(
        renders=StageCounts(done=len(what.renders), total=len(what.renders), seconds=30.0),
        trials=StageCounts(done=round(share * what.trial_count), total=what.trial_count, seconds=share * seconds),
    )


@pytest.mark.parametrize("share", [1.0, 0.25])
def test_a_run_is_what_the_next_one_is_expected_to_take(tmp_path, share):
    what, journal = plan(tmp_path, "averaging"), Journal(tmp_path / "journal")
    outcome = outcome_of(what, share)
    for job in what.renders:
        job.path.parent.mkdir(parents=True, exist_ok=True)
        job.path.write_bytes(bytes(500_000))
    outcome.finished = [key for group in what.groups for batch in group.first for key, _ in group.trials(batch, {})]
    for key in outcome.finished:
        journal.write(key, Ended("done", json.dumps({"runs": ["x" * 10_000]})))
    rates = learn(what, outcome, journal, tmp_path)
    assert read_rates(tmp_path) == rates
    for job in what.renders:
        job.path.unlink()
    found = counted(what, Journal(tmp_path / "other"), rates)
    expected = {"renders": 30.0, "stored": 500_000 * len(what.renders), "trials": 60.0}
    expected["records"] = what.trial_count * 10_200
    assert found.costs == pytest.approx(expected, rel=0.05)
    assert "about 45 s on 2 processes" in found.lines(2)[2] and "1 run of this machine" in found.lines(2)[4]
    # later runs weigh more, and the first is not forgotten at once
    for count in (1, 10):
        for _ in range(count):
            rates = learn(what, outcome_of(what, share, 120.0), journal, tmp_path)
        later_s = counted(what, Journal(tmp_path / "other"), rates).costs["trials"]
        assert later_s is not None and (60.0 < later_s < 120.0 or count == 10)
    assert later_s == pytest.approx(120.0, rel=0.05)


def test_a_run_that_did_little_says_nothing(tmp_path):
    what, journal = plan(tmp_path), Journal(tmp_path / "journal")
    little = Outcome(renders=StageCounts(found=3, total=3), trials=StageCounts(done=1, total=12, seconds=0.1))
    assert learn(what, Outcome(), journal, tmp_path) == learn(what, little, journal, tmp_path) == {}
    assert not (tmp_path / RATES_NAME).exists()


def test_a_folder_that_cannot_be_written_is_no_matter(tmp_path):
    what = plan(tmp_path, "averaging")
    (tmp_path / "file").write_text("")
    assert learn(what, outcome_of(what), Journal(tmp_path / "journal"), tmp_path / "file")


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "[" * 100_000,
        json.dumps({"version": RATES_VERSION + 1, "rates": {"x": [2.0, 3.0, 1]}}),
        json.dumps({"version": RATES_VERSION, "rates": {"x": [0, 1, 1]}}),
        json.dumps({"version": RATES_VERSION, "rates": {"x": [1]}}),
        f'{{"version": {RATES_VERSION}, "rates": {{"x": [1, NaN, 1]}}}}',
        f'{{"version": {RATES_VERSION}, "rates": {{"x": [1, 1e999, 1]}}}}',
    ],
)
def test_broken_rates_say_nothing(tmp_path, content):
    (tmp_path / RATES_NAME).write_text(json.dumps({"version": RATES_VERSION, "rates": {"x": [2.0, 3.0, 1]}}))
    assert read_rates(tmp_path) == {"x": (2.0, 3.0, 1)}
    (tmp_path / RATES_NAME).write_text(content)
    assert read_rates(tmp_path) == {}
