"""Studies through the engine: boards of their own for thresholds, what a board gives, the same
numbers however run."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from scipy import stats

from harness.evaluation.study.record import StudyRecord, read_record
from harness.evaluation.study.result import evaluate_study
from harness.experiment.digests import experiment_digests
from harness.experiment.load import load_experiment
from harness.experiment.schema import Point
from harness.records.trials import ResultTables
from harness.runs import run, study
from harness.runs.calibration import QuietRun, threshold_of
from harness.runs.journal import PICTURES, Journal
from harness.runs.options import EngineOptions
from harness.runs.pictures import examples_as_text, examples_of_text
from harness.runs.plan import parts_of, plan_of
from harness.runs.shards import WHOLE
from harness.runs.study_record import (
    RECORDED_PROVENANCE,
    failures_by_point,
    record_of,
    without_limit,
)
from harness.runs.tables import tables_of
from harness.trials.references import ReferenceBoards
from harness.trials.trial import Trial, run_trial
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.errors import UserError
from tests.support.declared_results import assert_declared
from tests.support.serial_run import records_of, run_serially
from tests.support.tiny_sweep import STUDY, results, sweep


def written(folder: Path, text: str = STUDY) -> Path:
    (folder / "tiny.yaml").write_text(text)
    return folder / "tiny.yaml"


# ---- what an experiment may say
# --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ("study=null", "a family of boards needs a study"),
        ("source.target={name: thesis}", "a study needs a family of boards"),
        ("threshold.calibrate={repeats: 5}", "a study calibrates its threshold on separate boards"),
        (
            "threshold.calibrate={boards: 5, false_calls_per_m2: 1.0}",
            "cannot show 1 false calls per m2",
        ),
        ("threshold.calibrate={repeats: 5, false_calls_per_m2: 1.0}", "needs `boards`"),
        ("threshold.calibrate={repeats: 5, boards: 5}", "not both"),
        ("source.target.offset_mm=600.0", "a board drawn at"),
        ("matching.radius_mm=25.0", "at most 20 mm"),
        ("sweep={matching.radius_mm: [5.0, 15.0]}", "is a rule of the study"),
        ("sweep={threshold.calibrate.false_calls_per_m2: [4.0, 5.0]}", "is a rule of the study"),
        ("sweep={threshold: [{k: 5.0}, {k: 6.0}]}", "is a rule of the study"),
    ],
)
def test_what_does_not_fit_together_is_told(tmp_path, changed, expected):
    with pytest.raises(DeclarationError) as message:
        load_experiment(written(tmp_path), [changed])
    assert expected in str(message.value)


def test_the_rate_of_false_calls_has_a_default_and_is_written_out(tmp_path):
    experiment = load_experiment(written(tmp_path), ["threshold.calibrate={boards: 40}"])
    calibrate = experiment.config.threshold.calibrate
    assert calibrate is not None
    assert calibrate.false_calls_per_m2 == 1.0


def test_more_boards_are_another_study_of_the_same_boards(tmp_path):
    smaller = load_experiment(written(tmp_path), ["study.boards=4"])
    larger = load_experiment(written(tmp_path), ["study.boards=6"])
    assert smaller.digest != larger.digest
    assert [point.digest for point in smaller.points] == [point.digest for point in larger.points]
    smaller_batches = plan_of(smaller, tmp_path).groups[0].then
    larger_batches = plan_of(larger, tmp_path).groups[0].then
    smaller_paths = {job.path for batch in smaller_batches for job in batch.renders}
    larger_paths = {job.path for batch in larger_batches for job in batch.renders}
    assert smaller_paths < larger_paths


def test_boards_differ_by_purpose_and_number_and_hole_free_ones_show_no_damage(tmp_path):
    (group,) = plan_of(load_experiment(written(tmp_path)), tmp_path).groups
    assert [(batch.role, batch.board) for batch in group.first] == [
        ("calibration", n) for n in range(5)
    ]
    assert [batch.role for batch in group.then] == ["damaged"] * 4 + ["hole_free"] * 3
    assert len({batch.renders[0].path for batch in group.batches}) == 12
    for batch in group.batches:
        shown = batch.renders[0].target
        target = batch.views[0].target
        assert len(target.damages) == 5
        assert shown == (target if batch.role == "damaged" else target.hole_free())


KINDS = [
    {"kind": "through", "per_board": 5, "diameter_mm": [2.0, 8.0]},
    {"kind": "through", "per_board": 3, "diameter_mm": [4.0, 9.0]},
]


def test_groups_that_differ_in_damage_share_their_trials_before_thresholds(tmp_path):
    by_damage = f"sweep={{source.target.damage: {json.dumps(KINDS)}, capture.frames: [1, 2]}}"
    first, second = plan_of(load_experiment(written(tmp_path), [by_damage]), tmp_path).groups
    assert second.leader is first and second.first == () and len(first.first) == 5
    for batch in first.first:
        ((_, task),) = first.trials(batch, {})
        assert [point.digest for point in task.points] == [
            point.digest for point in (*first.points, *second.points)
        ]
    for group in (first, second):
        tasks = [task for batch in group.then for _, task in group.trials(batch, AT_5)]
        damaged = [task for task in tasks if task.role == "damaged"]
        assert len(damaged) == 4
        for task in damaged:
            assert [point.digest for point in task.points] == [p.digest for p in group.points]
            assert all(not point.left_out for point in task.points)


def test_groups_that_differ_in_damage_share_their_hole_free_boards(tmp_path):
    """Each point with the board from which its own damage is left out."""
    by_damage = f"sweep={{source.target.damage: {json.dumps(KINDS)}, capture.frames: [1, 2]}}"
    plan = plan_of(load_experiment(written(tmp_path), [by_damage]), tmp_path)
    first, second = plan.groups
    assert [len(parts) for parts in parts_of(plan, WHOLE)[1]] == [4 + 3, 4]
    for batch, own in zip(first.hole_free, second.hole_free, strict=True):
        assert own.paths == batch.paths
        assert not list(second.trials(own, AT_5))
        ((_, task),) = first.trials(batch, AT_5)
        assert [point.digest for point in task.points] == [
            point.digest for point in (*first.points, *second.points)
        ]
        assert task.views == batch.views
        left_out = [point.left_out for point in task.points]
        assert left_out == [(), (), own.views, own.views]
        assert {len(view.target.damages) for view in (*batch.views, *own.views)} == {3, 5}
        # a point without a threshold is not judged
        thresholds = {point.digest: 5.0 for point in first.points}
        ((_, task),) = first.trials(batch, thresholds)
        assert len(task.points) == 2


def test_groups_of_several_views_or_other_references_share_no_hole_free_boards(tmp_path):
    by_damage = f"sweep={{source.target.damage: {json.dumps(KINDS)}}}"
    first, second = plan_of(load_experiment(written(tmp_path), [by_damage]), tmp_path).groups
    assert second.shows_the_same_hole_free(first)
    assert not replace(second, poses="several").shows_the_same_hole_free(first)
    (batch, *others) = second.hole_free
    other_unit = batch.views[0].camera.model_copy(update={"unit_seed": 2})
    for changed in (
        replace(batch, units=(other_unit,)),
        replace(batch, views=(replace(batch.views[0], camera=other_unit),)),
        replace(batch, references=ReferenceBoards(earlier=batch.views)),
        replace(batch, renders=others[0].renders),
    ):
        changed_group = replace(second, then=(changed, *others))
        assert not changed_group.shows_the_same_hole_free(first)


def test_groups_of_other_cameras_or_distances_share_no_trials(tmp_path):
    for separation in ("source.camera.unit_seed: [1, 2]", "source.target.distance_m: [0.6, 0.7]"):
        groups = plan_of(
            load_experiment(written(tmp_path), [f"sweep={{{separation}}}"]), tmp_path
        ).groups
        assert [group.leader for group in groups] == [None, None]


# ---- thresholds
# ------------------------------------------------------------------------------------------------------


def point_with(**threshold: object) -> Point:
    calibrate = SimpleNamespace(**{"repeats": None, "false_calls_per_m2": None, **threshold})
    board = SimpleNamespace(width_mm=400.0, height_mm=300.0)
    target = SimpleNamespace(declare=lambda: SimpleNamespace(board=board))
    threshold = SimpleNamespace(k=None, calibrate=calibrate)
    source = SimpleNamespace(target=target)
    return cast(
        "Point", SimpleNamespace(config=SimpleNamespace(threshold=threshold, simulated=source))
    )


def test_a_study_s_threshold_is_set_by_the_wanted_rate():
    """At 1 per m2 a run of 0.1 m2 calls with probability 0.0952. A new run exceeds the third
    highest of 39 with probability 3 / 40, the fourth with 4 / 40, which is too often."""
    quiet = [QuietRun(float(k), 0.1, (float(k),)) for k in range(39)]
    assert threshold_of(point_with(false_calls_per_m2=1.0), quiet) == 36.0
    assert threshold_of(point_with(repeats=39), quiet) == 38.0
    assert threshold_of(point_with(repeats=39), []) is None
    with pytest.raises(UserError, match="too few"):
        threshold_of(point_with(false_calls_per_m2=0.1), quiet)
    with pytest.raises(UserError, match=r"sees nothing of the board here but 0\.83 % of its face"):
        threshold_of(point_with(false_calls_per_m2=1.0), [QuietRun(1.0, 0.001, (1.0,))] * 39)


def test_each_board_has_its_own_noise_and_its_own_errors_of_nominal_poses(tmp_path):
    (group,) = plan_of(load_experiment(written(tmp_path)), tmp_path).groups
    labels = [task.labels for batch in group.batches for _, task in group.trials(batch, AT_5)]
    assert len(set(labels)) == len(labels) == 12
    assert labels[0] == ("calibration", 0, "board", 0)


AT_5 = SimpleNamespace(get=lambda _digest, _given: 5.0)
"""Any point's threshold."""


def test_a_calibration_that_fails_costs_its_set_up_only(finished, tmp_path, monkeypatch):
    """With two numbers of frames, one of which no hole-free run of ends: the other is judged all
    the same."""

    def faulty(task: Trial) -> object:
        if task.role == "calibration":
            task = replace(task, points=tuple(point for point in task.points if point.frames == 2))
        return run_trial(task)

    monkeypatch.setattr(run, "run_trial", faulty)
    experiment = load_experiment(finished.parent / "tiny.yaml")
    plan = plan_of(experiment, finished / ".cache" / "renders")
    outcome = run_serially(plan, tmp_path)
    (failure,) = outcome.failures
    assert failure.what == "threshold of capture.frames=1"
    tables = tables_of(records_of(tmp_path, outcome), experiment)
    assert set(tables.holes["frames"]) == {2}
    assert len(tables.holes) == 4 * 5


def test_a_set_up_that_sees_nothing_is_told_and_costs_no_other(finished, tmp_path, monkeypatch):
    def blinded(task: Trial) -> object:
        if task.views[0].camera.unit_seed == 2:
            raise UserError("the crop leaves none of the cloud's points")
        return run_trial(task)

    monkeypatch.setattr(run, "run_trial", blinded)
    experiment = load_experiment(
        finished.parent / "tiny.yaml", ["sweep={source.camera.unit_seed: [1, 2]}"]
    )
    plan = plan_of(experiment, finished / ".cache" / "renders")
    outcome = run_serially(plan, tmp_path)
    failed = failures_by_point(plan, outcome.failures, outcome.thresholds)
    provenance = dict.fromkeys(RECORDED_PROVENANCE)
    record = record_of(
        experiment, plan, tables_of(records_of(tmp_path, outcome), experiment), failed, provenance
    )
    (set_up,) = record.set_ups
    assert (
        set_up.axes == {"source.camera.unit_seed": 1}
        and set_up.failed == 0
        and len(set_up.inspected.hit) == 20
    )
    (printed,) = without_limit(experiment.points, outcome, failed, record.set_ups)
    assert printed.startswith(
        "no limit for unit seed 2: the camera sees no part of the board that can be judged"
    )
    assert "leaves none of the cloud's points" in printed


# ---- the whole study
# -------------------------------------------------------------------------------------------------


@pytest.fixture
def finished(study_out: Path) -> Path:
    return study_out


def test_a_study_leaves_its_record_tables_and_report(finished):
    assert "a90/95" in (finished.parent / "told.txt").read_text()
    folder = results(finished)
    names = {path.name for path in folder.iterdir()}
    tables = {
        f"{name}.parquet" for name in ("trials", "runs", "sites", "findings", "operating", "pixels")
    }
    assert names >= {"study.json", "report.html", "provenance.json", "experiment.yaml", *tables}
    assert_declared(folder)
    record = read_record(folder)
    limits = pd.read_csv(folder / "limits.csv")
    assert limits["frames"].tolist() == [1, 2] and limits["inspections"].tolist() == [20, 20]
    assert read_record(folder.parent / "latest").digest == record.digest
    assert [set_up.frames for set_up in record.set_ups] == [1, 2]
    for set_up in record.set_ups:
        assert sorted(set(set_up.inspected.board.tolist())) == [0, 1, 2, 3]
        assert len(set_up.inspected.hit) == 20
        # a hole of 10 mm, seven pixels wide, cannot be missed; one of 2 mm is a pixel and a half
        assert set_up.inspected.hit[set_up.inspected.diameter_mm > 10].all()
        assert set_up.unflawed.board.tolist() == [0, 1, 2]
        assert set_up.unflawed.area_m2 == pytest.approx(
            0.054, abs=0.002
        )  # of 0.0619 m2, less a rim of four pixels
        assert set_up.calibration_runs == 5
        assert set_up.threshold_mm > 0.5
    assert record.set_ups[0].targets_digest == record.set_ups[1].targets_digest
    assert record.set_ups[0].frames_digest != record.set_ups[1].frames_digest
    runs = pd.read_parquet(folder / "runs.parquet")
    assert runs[runs.role == "calibration"].threshold.isna().all()
    assert runs[runs.role != "calibration"].groupby("frames").threshold.nunique().eq(1).all()


def test_a_study_states_what_its_numbers_hang_on(finished):
    """In its provenance, in its record, which a gate keeps, and in its tables, which `ask` reads."""
    folder = results(finished)
    digests = json.loads((folder / "provenance.json").read_text())["digests"]
    assert digests == experiment_digests(load_experiment(folder / "experiment.yaml"))
    assert {"camera azure_kinect_nfov", "detectors/methods", "scenes/render"} <= set(digests)
    assert read_record(folder).provenance["digests"] == digests
    stored = pq.read_schema(folder / "limits.parquet").metadata[b"tofpod"]
    assert json.loads(stored)["digests"] == digests


def judged(
    home: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, *changes: str
) -> tuple[StudyRecord, ResultTables]:
    """A study run serially in this process, on the renders that are there, its journal in
    ``folder``."""
    experiment = load_experiment(home / "tiny.yaml", changes)
    plan = plan_of(experiment, home / "out" / ".cache" / "renders")
    outcome = run_serially(plan, folder)
    assert outcome.failures == []
    tables = tables_of(records_of(folder, outcome), experiment)
    provenance = dict.fromkeys(RECORDED_PROVENANCE)
    return record_of(experiment, plan, tables, {}, provenance), tables


def set_ups_of(record: StudyRecord) -> object:
    return record.to_data()["set_ups"]


def test_a_finished_study_shows_its_results_again_and_writes_a_missing_file(finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished, out, symlinks=True)
    yaml = finished.parent / "tiny.yaml"
    told = (finished.parent / "told.txt").read_text()
    page = results(out) / "report.html"
    page.write_text("changed by hand")
    anew = sweep(yaml, out, "--serial")
    assert "writing tables and report" in anew.stderr
    written = page.stat().st_mtime_ns
    again = sweep(yaml, out, "--serial")
    assert "writing tables and report" not in again.stderr
    assert page.stat().st_mtime_ns == written
    for done in (anew, again):
        assert done.returncode == 0
        # all but the place of the report
        assert done.stdout.splitlines()[:-1] == told.splitlines()[:-1]


def test_a_serial_and_a_resumed_study_give_the_same_record(finished, tmp_path, monkeypatch):
    parallel = set_ups_of(read_record(results(finished)))
    serial, _ = judged(finished.parent, tmp_path / "serial", monkeypatch)
    assert set_ups_of(serial) == parallel
    journal = tmp_path / "half"
    shutil.copytree(results(finished) / "journal", journal)
    (segment,) = journal.iterdir()
    first, *lines = segment.read_text().splitlines(keepends=True)
    assert len(lines) == 12 + 1 + 2, "beside the trials: thresholds, and pictures of two set-ups"
    segment.write_text(first + "".join(line for number, line in enumerate(lines) if number % 3))
    resumed, _ = judged(finished.parent, journal, monkeypatch)
    assert set_ups_of(resumed) == parallel


def test_pictures_of_damage_are_drawn_once(finished, tmp_path, monkeypatch):
    """A run that finds all trials takes its pictures from the journal, unknown numbers included,
    and draws those again that other thresholds show."""
    out = tmp_path / "out"
    shutil.copytree(finished, out, symlinks=True)
    before = examples_on(results(out))
    (results(out) / "report.html").unlink()

    def is_drawn(shown: object, thresholds: object) -> None:
        raise AssertionError("drawn again")

    monkeypatch.setattr(study, "study_examples", is_drawn)
    experiment = load_experiment(finished.parent / "tiny.yaml")
    serial = EngineOptions(serial=True)
    assert study.run_study(experiment, out, serial, "again") == 0
    assert examples_on(results(out)) == before
    assert before.count("<figure") == 2

    journal = Journal(results(out) / "journal")
    (key, *_) = [key for key, _ in journal.entries() if key.startswith(PICTURES)]
    entry = journal.read(key)
    assert entry is not None
    (first, *_) = examples_of_text(entry.value)
    unknown = replace(first, depth_mm=np.inf, score=np.nan)
    (again,) = examples_of_text(examples_as_text([unknown]))
    for name, value in vars(unknown).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    assert again.detected.dtype == bool


def examples_on(folder: Path) -> str:
    """Return the part of a study's page that shows damage."""
    page = (folder / "report.html").read_text()
    return page[page.index("<h2>Examples") : page.index("Limits of validity")]


# ---- two detectors that test the harness
# -----------------------------------------------------------------------------

ONE_FRAME = ("sweep={}", "capture.frames=1")


@pytest.mark.usefixtures("control_detectors")
def test_the_oracle_scores_one_everywhere(finished, tmp_path, monkeypatch):
    """Handed the truth it finds every damage once and nothing else: whatever is less is a fault of
    the harness."""
    oracle = "detector={name: oracle, settings: {}}"
    record, tables = judged(finished.parent, tmp_path, monkeypatch, *ONE_FRAME, oracle)
    result = evaluate_study(record, tables, {})
    (set_up,) = result.set_ups
    smallest = record.set_ups[0].inspected.diameter_mm.min()
    assert record.set_ups[0].inspected.hit.all()
    assert (record.set_ups[0].inspected.signal == 1).all()
    assert (set_up.limit.a50_mm, set_up.limit.a90_mm) == (
        smallest,
        smallest,
    ) and set_up.limit.hits == set_up.limit.inspections
    assert record.set_ups[0].unflawed.calls.sum() == 0
    assert tables.findings["score"].eq(1).all()
    assert len(tables.findings) == len(tables.holes)
    assert set_up.roc.area == 1.0
    assert set_up.pixels is not None
    assert set_up.pixels.pro == 1.0


@pytest.mark.slow  # a Monte Carlo of 48 boards
@pytest.mark.usefixtures("control_detectors")
def test_the_blind_detector_scores_what_chance_gives(finished, tmp_path, monkeypatch):
    """Its false calls per area are those of its own law at the threshold, its hits those of places
    laid anywhere: a damage is hit where one guess or more falls within the radius, 1 - exp(-rate
    pi r^2), and no limit is shown.

    Two-sided tests at 0.1 % each; the seed is fixed.
    """
    blind = (
        "detector={name: blind, settings: {guesses_per_m2: 400, crop: {kind: auto, inset_px: 4}}}"
    )
    wanted = "threshold.calibrate={boards: 5, false_calls_per_m2: 60.0}"
    record, tables = judged(
        finished.parent, tmp_path, monkeypatch, *ONE_FRAME, blind, wanted, "repeats=12"
    )
    (of_one,) = record.set_ups
    rate_per_m2 = 400 * np.exp(-of_one.threshold)
    calls = int(of_one.unflawed.calls.sum())
    area_m2 = float(of_one.unflawed.area_m2.sum())
    assert poisson_p(calls, rate_per_m2 * area_m2) > 1e-3
    by_chance = 1 - np.exp(-rate_per_m2 * np.pi * 0.015**2)
    hits = of_one.inspected.hit
    assert len(hits) == 4 * 5 * 12
    # a guess counts for one damage only, but damages stand farther apart than two radii
    assert stats.binomtest(int(hits.sum()), len(hits), by_chance).pvalue > 1e-3
    sites = tables.sites["detected"]
    assert stats.binomtest(int(sites.sum()), len(sites), by_chance).pvalue > 1e-3
    (set_up,) = evaluate_study(record, tables, {}).set_ups
    assert not set_up.limit.a90_95.demonstrated
    assert set_up.chance is not None
    assert set_up.chance.probability == pytest.approx(by_chance, rel=0.25)


def poisson_p(count: int, mean: float) -> float:
    """Two-sided p-value of a Poisson count: twice the smaller tail."""
    return float(2 * min(stats.poisson.cdf(count, mean), stats.poisson.sf(count - 1, mean)))


def test_another_seed_of_the_noise_keeps_the_boards(finished, tmp_path):
    config = finished.parent / "tiny.yaml"
    cache = finished / ".cache" / "renders"
    here = plan_of(load_experiment(config, ()), cache)
    there = plan_of(load_experiment(config, ("seed=4",)), cache)
    assert [job.path for job in here.renders] == [job.path for job in there.renders]
    keys = [
        {key for g in plan.groups for b in g.first for key, _ in g.trials(b, {})}
        for plan in (here, there)
    ]
    assert keys[0].isdisjoint(keys[1])
