"""What a dry run says: counts that are exact, costs that grow with what they are costs of, rates learnt from runs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from harness.engine import estimate as estimates
from harness.engine.costs import RATES_NAME, RATES_VERSION, Rates, Taken, learn, read_rates, render_cost, trial_cost
from harness.engine.estimate import dry_run, estimate
from harness.engine.journal import Entry, Journal
from harness.engine.options import EngineOptions
from harness.engine.plan import SweepPlan, plan_of
from harness.engine.shard import Shard
from harness.engine.work import Outcome, StageCounts
from harness.experiment.load import load_experiment
from scenes.render.view import target_region
from scenes.sensor.camera import camera_of
from scenes.target.mesh import build_target

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"
ALONE = ["sensitivity=null", "sweep={}"]
STUDY = ["study.boards=3", "study.hole_free_boards=2", "threshold.calibrate.boards=20"]


def plan(cache: Path, name: str = "smoke", *overrides: str) -> SweepPlan:
    return plan_of(load_experiment(EXPERIMENTS / f"{name}.yaml", list(overrides)), cache / "renders")


def seconds(what: SweepPlan, stage: str) -> float:
    group = what.groups[0]
    if stage == "render":
        return render_cost(group.damaged.renders[0]).seconds
    return trial_cost(group, group.damaged, 1).seconds


# ---------------------------------------------------------------- what things cost


@pytest.mark.parametrize(
    "override",
    [
        "source.target.distance_m=0.5",
        "source.render.hole_noise_mm=0.05",
        "source.render.face_samples=1048576",
        "source.render.face_spacing_mm=40.0",
        "source.render.bounces=20",
    ],
)
def test_more_work_for_a_render_costs_more(tmp_path, override):
    more = [override] if "noise" not in override else [override, "source.render.hole_samples=65536"]
    assert seconds(plan(tmp_path, "smoke", *ALONE, *more), "render") > 1.05 * seconds(
        plan(tmp_path, "smoke", *ALONE), "render"
    )


def test_fewer_paths_and_coarser_noise_cost_less(tmp_path):
    whole = seconds(plan(tmp_path, "smoke", *ALONE), "render")
    for override in ("hole_samples=1024", "hole_noise_mm=0.3", "bounces=0"):
        assert seconds(plan(tmp_path, "smoke", *ALONE, f"source.render.{override}"), "render") < 0.8 * whole


def test_a_board_without_holes_costs_less(tmp_path):
    group = plan(tmp_path, "smoke", *ALONE).groups[0]
    assert render_cost(group.first[0].renders[0]).seconds < 0.7 * render_cost(group.damaged.renders[0]).seconds
    assert trial_cost(group, group.first[0], 1).seconds < trial_cost(group, group.damaged, 1).seconds


def test_trials_cost_by_frames_points_and_pixels(tmp_path):
    exact = (*ALONE, "capture.exact=true")
    one = seconds(plan(tmp_path, "smoke", *exact, "capture.frames=1"), "trial")
    fifty = seconds(plan(tmp_path, "smoke", *exact, "capture.frames=50"), "trial")
    axis = seconds(
        plan(tmp_path, "smoke", "sensitivity=null", "sweep={capture.frames: [1, 50]}", "capture.exact=true"), "trial"
    )
    near = seconds(plan(tmp_path, "smoke", *exact, "capture.frames=50", "source.target.distance_m=0.5"), "trial")
    assert one < fifty < axis < one + fifty
    assert 1.3 * fifty < near < 2.2 * fifty
    assert seconds(plan(tmp_path, "smoke", *ALONE, "capture.frames=50"), "trial") < 0.7 * fifty


def test_points_that_share_their_work_cost_once(tmp_path):
    """Two thresholds on one detector, against two detectors."""
    base = ["sensitivity=null", "threshold={k: 5.0}"]
    thresholds = seconds(plan(tmp_path, "smoke", *base, "sweep={threshold.k: [5.0, 6.0]}"), "trial")
    single = seconds(plan(tmp_path, "smoke", *base, "sweep={}"), "trial")
    detectors = seconds(plan(tmp_path, "smoke", *base, "sweep={detector.settings.min_points: [1, 2]}"), "trial")
    assert single == pytest.approx(thresholds) and detectors > thresholds


@pytest.mark.parametrize("name", ["smoke", "detection_limit"])
def test_the_region_is_the_renders_own(tmp_path, name):
    """The size on the disk is that of the region that the render itself will find, at every camera."""
    for camera in ("azure_kinect_nfov", "kinect_v2", "realsense_l515"):
        more = [*ALONE, "source.target.distance_m=0.9"] if name == "smoke" else ["sweep={}", *STUDY]
        job = plan(tmp_path, name, *more, f"source.camera.name={camera}").groups[0].damaged.renders[0]
        optics = camera_of(job.camera).optics
        h, w = target_region(build_target(job.target), optics).shape
        per_pixel = 58 + 16 * len(optics.frequencies_hz)
        assert render_cost(job).size_bytes == pytest.approx(h * w * per_pixel, rel=0.01)


# ---------------------------------------------------------------- what is there


def counted(what: SweepPlan, journal: Journal, rates: Rates | None = None, **options: Any) -> estimates.SweepEstimate:
    return estimate(what, 3, journal, rates or Rates(), EngineOptions(**options))


def fill(journal: Journal, what: SweepPlan, batches: str, thresholds: dict[str, float], state: str = "done") -> int:
    count = 0
    for group in what.groups:
        for batch in getattr(group, batches):
            for key, task in group.trials(batch, thresholds):
                runs = [{"point": p.digest, "quiet_threshold": 4.0, "inspected_m2": 0.05} for p in task.points]
                journal.write(key, Entry(state, text=json.dumps({"runs": runs}) if state == "done" else None))
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
    assert 0 < some.render_s < found.render_s and some.render_bytes < found.render_bytes
    # hole-free trials set the thresholds; with them the judged ones can be looked for
    first = fill(journal, what, "first", {})
    assert counted(what, journal).found == first == 6
    assert counted(what, journal).trial_s < found.trial_s
    thresholds = {point.digest: 4.0 for group in what.groups for point in group.points}
    fill(journal, what, "then", thresholds)
    over = counted(what, journal)
    assert (over.found, over.to_run, over.to_render, over.trial_s, over.render_s) == (12, 0, 0, 0.0, 0.0)
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
    journal.write(key, Entry("done", text='{"runs": []}'))
    found = counted(what, journal)
    assert not found.trials_known and found.found == 1
    assert "judged ones are looked for once thresholds are set" in found.lines()[2]


def test_shards_share_the_trials(tmp_path):
    what, journal = plan(tmp_path, "detection_limit", *STUDY), Journal(tmp_path / "journal")
    whole = counted(what, journal)
    parts = [counted(what, journal, shard=Shard(number, 3)) for number in (1, 2, 3)]
    assert whole.trials == 25 and sum(part.trials - 20 for part in parts) == 5
    assert all(part.to_render == part.trials for part in parts)
    assert all(part.trial_s < whole.trial_s for part in parts)


def test_more_processes_take_less_time_up_to_the_cores(tmp_path, monkeypatch):
    monkeypatch.setattr(estimates.os, "cpu_count", lambda: 8)
    what, journal = plan(tmp_path, "averaging", "capture.exact=true"), Journal(tmp_path / "journal")
    serial, *times = (
        counted(what, journal, **options).wall_s
        for options in ({"serial": True}, *({"jobs": n} for n in (1, 2, 8, 64)))
    )
    assert serial > times[0] > times[1] > times[2] == times[3]
    cluster = counted(what, journal, jobs=64, scheduler="tcp://x:1")
    assert cluster.wall_s < times[3] and "64 workers" in "\n".join(cluster.lines())


def test_the_dry_run_writes_nothing_and_names_its_basis(tmp_path, capsys):
    experiment = load_experiment(EXPERIMENTS / "smoke.yaml", [])
    assert dry_run(experiment, tmp_path / "out", EngineOptions()) == 0
    assert not (tmp_path / "out").exists()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "smoke: valid"
    assert [line.split(":")[0].strip() for line in lines[2:]] == [
        "renders",
        "trials",
        "time",
        "disk",
        "measured",
        lines[-1].split(":")[0].strip(),
    ]
    assert "another machine" in lines[-2] and str(experiment.folder(tmp_path / "out")) in lines[-1]
    assert max(map(len, lines[:-1])) <= 100


# ---------------------------------------------------------------- what is learnt


def outcome_of(what: SweepPlan, factor: float, *, found: int = 0, jobs: int = 2) -> Outcome:
    """A run that took so many times what was expected."""
    render_s = sum(render_cost(job).seconds for job in what.renders)
    trial_s = sum(trial_cost(g, b, jobs).seconds * g.most_repeats(b) for g in what.groups for b in g.batches)
    done = what.trial_count - found
    return Outcome(
        renders=StageCounts(done=len(what.renders), total=len(what.renders), seconds=factor * render_s),
        trials=StageCounts(
            done=done, found=found, total=what.trial_count, seconds=factor * trial_s * done / what.trial_count
        ),
    )


@pytest.mark.parametrize("found", [0, 60])
def test_a_run_sets_the_estimate_right(tmp_path, found):
    what, journal = plan(tmp_path, "averaging"), Journal(tmp_path / "journal")
    before = counted(what, journal)
    rates = learn(what, outcome_of(what, 3.0, found=found), journal, tmp_path, 2)
    assert read_rates(tmp_path) == rates
    after = counted(what, journal, rates=rates)
    assert after.render_s == pytest.approx(3 * before.render_s) and after.trial_s == pytest.approx(3 * before.trial_s)
    assert before.learnt == (0, 0) and after.learnt == (1, 1)
    assert "1 run of this machine" in after.lines()[-1]
    # later runs weigh more, and the first is not forgotten at once
    rates = learn(what, outcome_of(what, 1.0, found=found), journal, tmp_path, 2)
    assert 1.0 < rates.ratio("renders", "amcw_imager") < 2.0
    for _ in range(10):
        rates = learn(what, outcome_of(what, 1.0, found=found), journal, tmp_path, 2)
    assert rates.ratio("renders", "amcw_imager") == pytest.approx(1.0, abs=0.01)
    # another kind of camera is thought to be as fast, until it is known
    assert rates.ratio("renders", "scanned_lidar") == rates.ratio("renders", "amcw_imager")
    assert rates.runs("renders", ["amcw_imager", "scanned_lidar"]) == 0


def test_a_shard_teaches_what_the_whole_does(tmp_path):
    what, journal = plan(tmp_path, "averaging"), Journal(tmp_path / "journal")
    whole = outcome_of(what, 2.0)
    tenth = Outcome(
        renders=StageCounts(done=len(what.renders), total=len(what.renders), seconds=whole.renders.seconds),
        trials=StageCounts(done=21, total=21, seconds=whole.trials.seconds * 21 / what.trial_count),
    )
    rates = learn(what, tenth, journal, tmp_path, 2)
    assert rates.ratio("trials", "amcw_imager, frame by frame") == pytest.approx(2.0)


def test_sizes_of_records_are_learnt(tmp_path):
    what, journal = plan(tmp_path, "averaging"), Journal(tmp_path / "journal")
    before = counted(what, journal)
    outcome = outcome_of(what, 1.0)
    keys = [key for group in what.groups for batch in group.first for key, _ in group.trials(batch, {})]
    for key in keys:
        journal.write(key, Entry("done", text=json.dumps({"runs": ["x" * 100_000]})))
    outcome.finished = keys
    rates = learn(what, outcome, journal, tmp_path, 2)
    kind = "amcw_imager, drawn at once"
    assert rates.records[kind].taken == pytest.approx(len(keys) * 100_300, rel=0.01)
    after = counted(what, Journal(tmp_path / "other"), rates)
    assert after.record_bytes == pytest.approx(what.trial_count * 100_300, rel=0.01)
    assert after.record_bytes > 2 * before.record_bytes


def test_a_run_that_did_little_says_nothing(tmp_path):
    what, journal = plan(tmp_path), Journal(tmp_path / "journal")
    for outcome in (
        Outcome(),
        replace(
            outcome_of(what, 1.0),
            renders=StageCounts(found=3, total=3),
            trials=StageCounts(done=1, total=12, seconds=0.1),
        ),
    ):
        assert learn(what, outcome, journal, tmp_path, 2) == Rates()
    assert not (tmp_path / RATES_NAME).exists()


def test_a_folder_that_cannot_be_written_is_no_matter(tmp_path):
    what = plan(tmp_path, "averaging")
    (tmp_path / "file").write_text("")
    rates = learn(what, outcome_of(what, 2.0), Journal(tmp_path / "journal"), tmp_path / "file", 2)
    assert rates.ratio("renders", "amcw_imager") == pytest.approx(2.0)


GOOD = {"renders": {"amcw_imager": {"expected": 2.0, "taken": 3.0, "runs": 1}}, "trials": {}, "records": {}}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{",
        "[" * 100_000,
        json.dumps({**GOOD, "version": RATES_VERSION + 1}),
        json.dumps(GOOD),
        json.dumps({**GOOD, "version": RATES_VERSION, "trials": []}),
        json.dumps({**GOOD, "version": RATES_VERSION, "renders": {"x": {"expected": 0, "taken": 1, "runs": 1}}}),
        json.dumps({**GOOD, "version": RATES_VERSION, "renders": {"x": {"expected": 1, "taken": -1, "runs": 1}}}),
        '{"version": 1, "renders": {"x": {"expected": 1, "taken": NaN, "runs": 1}}, "trials": {}, "records": {}}',
        '{"version": 1, "renders": {"x": {"expected": 1, "taken": 1e999, "runs": 1}}, "trials": {}, "records": {}}',
    ],
)
def test_broken_rates_say_nothing(tmp_path, content):
    (tmp_path / RATES_NAME).write_text(json.dumps({**GOOD, "version": RATES_VERSION}))
    assert read_rates(tmp_path).renders == {"amcw_imager": Taken(2.0, 3.0, 1)}
    (tmp_path / RATES_NAME).write_text(content)
    assert read_rates(tmp_path) == Rates()
