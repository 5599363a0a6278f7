"""Detectors that learn on boards of their own, and studies over units of the camera, through the
engine."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import detectors
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import StudyRecord
from harness.experiment.load import load_experiment
from harness.programs.cluster import merge
from harness.runs.journal import Journal
from harness.runs.plan import Group, SweepPlan, plan_of
from harness.runs.shards import Shard
from harness.runs.study_record import RECORDED_PROVENANCE, record_of
from harness.runs.tables import tables_of
from harness.tables.limits import limits_grid, quoted, study_answer
from harness.tables.study import set_by, threshold_warnings
from harness.testing import check_detector, learns_plain_arrays
from harness.testing.synthetic_clouds import plane
from harness.trials.learning import LEARNING_BOARDS
from harness.vocabulary.errors import UserError
from tests.support.learning_detector import LearningDetector
from tests.support.serial_run import records_of, run_serially, trial_keys

LEARNING = "detector={name: learning, settings: {crop: {kind: auto, inset_px: 4}}}"
ONE_FRAME = ("sweep={}", "capture.frames=1")
UNITS = "study.units=3"


@pytest.fixture(autouse=True)
def offered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(
        detectors.BUILT_IN, "learning", "tests.support.learning_detector:LearningDetector"
    )


def plan_in(study_out: Path, folder: Path, *changes: str) -> SweepPlan:
    """A plan on the renders that are there; what is learned goes to ``folder``."""
    experiment = load_experiment(study_out.parent / "tiny.yaml", changes)
    return plan_of(experiment, study_out / ".cache" / "renders", folder)


def study_of(study_out: Path, folder: Path, *changes: str, shards: int = 1) -> StudyRecord:
    """A study run serially in this process, its journal in ``folder``."""
    experiment = load_experiment(study_out.parent / "tiny.yaml", changes)
    plan = plan_in(study_out, folder, *changes)
    for number in range(shards if shards > 1 else 0):
        run_serially(plan, folder / "journal", shard=Shard(number + 1, shards))
    outcome = run_serially(plan, folder / "journal")
    assert outcome.failures == []
    assert (outcome.trials.done == 0) == (shards > 1), "shards leave nothing to do"
    tables = tables_of(records_of(folder / "journal", outcome), experiment)
    provenance = dict.fromkeys(RECORDED_PROVENANCE)
    return record_of(experiment, plan, tables, {}, provenance)


def group_in(study_out: Path, folder: Path, *changes: str) -> Group:
    (group,) = plan_in(study_out, folder, *changes).groups
    return group


# ---- learning
# --------------------------------------------------------------------------------------------------------


def test_the_contract_of_a_detector_that_learns_is_checked() -> None:
    check_detector(LearningDetector)

    class Shifting(LearningDetector):
        name = "shifting"
        seen = 0

        def calibrate(self, hole_free):
            Shifting.seen += 1
            return {"scales_m": np.full(3, 1e-3 * Shifting.seen)}

    with pytest.raises(
        AssertionError, match="the same clouds gave another learned state the second time"
    ):
        learns_plain_arrays(lambda: Shifting(Shifting.settings_type()), plane(seed=1))


def test_boards_of_learning_are_nobody_else_s_and_cost_only_detectors_that_learn(
    study_out, tmp_path
):
    group = group_in(study_out, tmp_path, LEARNING)
    (batch,) = group.learning
    assert (len(batch.renders), len(batch.views)) == (LEARNING_BOARDS, LEARNING_BOARDS)
    assert not any(ref.damaged for ref in batch.views)
    assert not set(batch.paths) & {
        path for other in (*group.first, *group.then) for path in other.paths
    }
    assert group.most_repeats(batch) == len(group.points) == 2, "one with each number of frames"
    assert group_in(study_out, tmp_path).learning == ()


@pytest.fixture(scope="module")
def learned(study_out: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, StudyRecord]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            detectors.BUILT_IN, "learning", "tests.support.learning_detector:LearningDetector"
        )
        folder = tmp_path_factory.mktemp("learned")
        return folder, study_of(study_out, folder, LEARNING, *ONE_FRAME)


def test_every_judge_uses_what_was_learned(learned, study_out):
    """The scale is that of the learning boards, for every trial alike, and stands in the journal
    and in a file."""
    folder, record = learned
    (file,) = folder.glob("learning-*.npz")
    with np.load(file) as arrays:
        scales_m = arrays["scales_m"]
    assert scales_m.shape == (LEARNING_BOARDS,)
    (set_up,) = record.set_ups
    assert set_up.threshold_mm / set_up.threshold == pytest.approx(
        1e3 * np.median(scales_m), rel=1e-12
    )
    assert file.stem in trial_keys(Journal(folder / "journal"))


def test_resumed_and_sharded_runs_give_the_same_record(learned, study_out, tmp_path):
    folder, record = learned
    resumed = tmp_path / "resumed"
    shutil.copytree(folder / "journal", resumed / "journal")
    (segment,) = (resumed / "journal").iterdir()
    first, *lines = segment.read_text().splitlines(keepends=True)
    segment.write_text(first + "".join(line for line in lines if "damaged" not in line))
    (file,) = folder.glob("learning-*.npz")
    again = study_of(study_out, resumed, LEARNING, *ONE_FRAME)
    assert again.to_data() == record.to_data()
    assert (resumed / file.name).read_bytes() == file.read_bytes(), "written anew from the journal"
    sharded = study_of(study_out, tmp_path / "sharded", LEARNING, *ONE_FRAME, shards=2)
    assert sharded.to_data() == record.to_data()


def test_what_was_learned_is_merged_as_text_that_need_not_be_equal(learned):
    key = next(
        key for key in trial_keys(Journal(learned[0] / "journal")) if key.startswith("learning")
    )
    entry = Journal(learned[0] / "journal").read(key)
    assert entry is not None and entry.record is not None
    other = {**entry.record, "learned": [{"arrays": "other last digits"}]}
    assert merge._without_seconds(entry.record) == merge._without_seconds(other)


def test_a_detector_that_learns_nothing_costs_itself_only(study_out, tmp_path):
    refusing = "{name: learning, settings: {refuses: true, crop: {kind: auto, inset_px: 4}}}"
    other = "{name: thesis, settings: {crop: {kind: auto, inset_px: 4}}}"
    plan = plan_in(
        study_out, tmp_path, f"sweep={{detector: [{refusing}, {other}]}}", "capture.frames=1"
    )
    outcome = run_serially(plan, tmp_path / "journal")
    assert len(outcome.thresholds) == 1
    printed = sorted(failure.why for failure in outcome.failures)
    assert printed == ["its detector has learned nothing", "these clouds teach nothing"]
    assert all("runs" in record for record in records_of(tmp_path / "journal", outcome))


# ---- units
# -----------------------------------------------------------------------------------------------------------


def test_every_unit_inspects_every_damaged_board_and_others_have_units_of_their_own(
    study_out, tmp_path
):
    group = group_in(study_out, tmp_path, UNITS, LEARNING)
    additional = group_in(study_out, tmp_path, "study.units=4", LEARNING)
    seeds: Counter[int] = Counter()
    for batch in (*group.first, *group.then):
        tasks = [
            task for _, task in group.trials(batch, {point.digest: 5.0 for point in group.points})
        ]
        assert len(tasks) == (3 if batch.role == "damaged" else 1)
        seeds.update(task.views[0].camera.unit_seed for task in tasks)
    boards = Counter(batch.role for batch in (*group.first, *group.then))
    assert (
        sorted(seeds.values())
        == [1] * (boards["calibration"] + boards["hole_free"]) + [boards["damaged"]] * 3
    )
    taught = {ref.camera.unit_seed for ref in group.learning[0].views}
    assert len(taught) == LEARNING_BOARDS and not taught & set(seeds)
    assert {batch.paths for batch in additional.batches} == {
        batch.paths for batch in group.batches
    }, "units share renders"
    at_5 = {point.digest: 5.0 for point in group.points}
    keys = [
        {key for batch in planned_group.then for key, _ in planned_group.trials(batch, at_5)}
        for planned_group in (group, additional)
    ]
    assert keys[0] < keys[1], "a further unit leaves the trials of the others as they were"


def test_one_unit_may_calibrate_for_others(study_out: Path, tmp_path: Path) -> None:
    changes = (UNITS, "study.one_unit_calibrates=true", LEARNING)
    group = group_in(study_out, tmp_path, *changes)
    own_seed = group.points[0].config.simulated.camera.unit_seed
    at_5 = {point.digest: 5.0 for point in group.points}
    seeds: dict[str, set[int]] = {}
    for batch in group.batches:
        for _, task in group.trials(batch, None if batch.role == "learning" else at_5):
            found = {view.camera.unit_seed for view in task.views}
            seeds[batch.role] = seeds.get(batch.role, set()) | found
    assert seeds["learning"] == {own_seed}
    assert seeds["calibration"] == {own_seed}
    boards = [batch for batch in group.then if batch.role == "hole_free"]
    assert len(seeds["hole_free"]) == len(boards)
    assert own_seed not in seeds["hole_free"] | seeds["damaged"]
    with pytest.raises(UserError, match="`one_unit_calibrates` needs `units`"):
        plan_in(study_out, tmp_path, "study.one_unit_calibrates=true")


@pytest.fixture(scope="module")
def over_units(
    study_out: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, StudyRecord]:
    folder = tmp_path_factory.mktemp("units")
    return folder, study_of(study_out, folder, UNITS, *ONE_FRAME)


def test_a_study_over_units_states_the_limit_of_a_new_unit_beside_that_of_one(over_units):
    (set_up,) = over_units[1].set_ups
    limit = limit_of(set_up, draws=50)
    assert set_up.units == 3 and limit.inspections == 3 * limit.targets
    assert limit.over_units is not None and limit.over_units.a90_mm.shape == (3,)
    # equal where the three units find the same holes
    assert quoted(limit).value >= limit.a90_95.value > limit.a90_mm
    assert {"new unit (mm)", "one unit (mm)", "beside/m²"} <= set(limits_grid([limit]).heads)
    assert not study_answer([limit]).startswith("One unit")
    assert set_up.beside is not None and set_up.beside.area_m2.sum() == pytest.approx(
        3 * 4 * 0.054, rel=0.05
    )


@pytest.mark.slow  # shards without units are compared above
def test_units_in_shards_give_the_same_record(over_units, study_out, tmp_path):
    assert (
        study_of(study_out, tmp_path, UNITS, *ONE_FRAME, shards=2).to_data()
        == over_units[1].to_data()
    )


def test_one_unit_is_said_first(study_out, tmp_path):
    limit = limit_of(study_of(study_out, tmp_path, *ONE_FRAME).set_ups[0], draws=50)
    assert study_answer([limit]).startswith("One unit of the camera: 1 frame: ")
    assert limits_grid([limit], terminal=True).title.startswith("One unit of the camera: ")
    assert "new unit (mm)" not in limits_grid([limit]).heads


@pytest.mark.slow  # three studies
def test_one_blob_of_one_unit_decides_its_calibration_and_units_spread_it(study_out, tmp_path):
    """With a fixed pattern alone, without noise, the same pixels of one unit are loudest on most
    boards."""
    asked = ("source.camera.effects={noise: false}", *ONE_FRAME)
    records = (
        study_of(study_out, tmp_path / "one", *asked),
        study_of(study_out, tmp_path / "units", *asked, UNITS),
    )
    limits = []
    for record in records:
        limits.append([limit_of(set_up, draws=10) for set_up in record.set_ups])
    of_one, of_units = limits
    assert set_by(of_one)[0].same_pixels == 4, "of 5 boards"
    assert set_by(of_units)[0].same_pixels == 1
    assert "highest score on the same pixels" in threshold_warnings(of_one)[0]
    assert not any(
        "same pixels" in threshold_warning for threshold_warning in threshold_warnings(of_units)
    )
