"""Boards compared with references in a trial, and how a study plans them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from harness.experiment.load import load_experiment
from harness.experiment.schema import (
    AnyReference,
    GoodPartsReference,
    MeshReference,
    ScanReference,
)
from harness.runs.plan import Group, plan_of
from harness.runs.tables import _variants
from harness.trials.board import Board
from harness.trials.clouds import TrialPoint, ViewClouds
from harness.trials.references import ReferenceBoards
from harness.trials.trial import Trial, captured, run_trial
from harness.vocabulary.declaration.yaml_source import DeclarationError
from harness.vocabulary.seeds import canonical_json
from tests.support.board_in_closed_form import board_of, point_of, reference_of
from tests.support.tiny_sweep import STUDY

SETTINGS = canonical_json({"crop": {"kind": "none"}, "surface": {"shape": "expected"}})
FRAMES = 20


@pytest.fixture(scope="module")
def damaged() -> Board:
    return board_of(damaged=True)


@pytest.fixture(scope="module")
def hole_free() -> Board:
    return board_of(damaged=False)


def compared_with(reference: AnyReference | None) -> TrialPoint:
    """A point that compares with a reference."""
    point = point_of(frames=FRAMES, digest=str(reference))
    settings = point.criteria.settings_json if reference is None else SETTINGS
    criteria = replace(point.criteria, detector="local", settings_json=settings)
    return replace(point, criteria=criteria, reference=reference)


REFERENCES = (
    None,
    ScanReference(kind="scan"),
    GoodPartsReference(kind="good_parts", parts=1),
    GoodPartsReference(kind="good_parts", parts=3),
    MeshReference(kind="mesh"),
)


@pytest.mark.slow
def test_only_the_hole_departs_from_each_reference(damaged: Board, hole_free: Board) -> None:
    points = tuple(compared_with(reference) for reference in REFERENCES)
    undamaged = reference_of(hole_free)
    trial = Trial(
        views=(reference_of(damaged),),
        seed=5,
        role="damaged",
        repeat=0,
        points=points,
        references=ReferenceBoards((undamaged,), (undamaged,) * 3),
    )
    clouds = captured(trial, [damaged], points)
    assert isinstance(clouds, ViewClouds)
    names = []
    noises_m = {}
    for point in points[1:]:
        cloud = clouds.cloud(point)
        assert clouds.cloud(point) is cloud  # it is placed once
        assert cloud.expected is not None
        names.append(cloud.expected.facts["name"])
        residual_m = cloud.points_m[..., 2].ravel() - cloud.expected.z_at(
            cloud.points_m.reshape(-1, 3)
        )
        residual_m = residual_m[np.isfinite(residual_m)]
        noises_m[names[-1]] = np.median(np.abs(residual_m)) / 0.6745
    assert names == ["the earlier capture", "1 good part", "3 good parts", "the drawing"]
    # the unit's pattern is in every capture at the same pixels, and cancels; the drawing has none
    assert noises_m["the drawing"] > 1.5 * noises_m["the earlier capture"]
    # of independent noise of equal variance: sqrt(1 + 1/3) against sqrt(2)
    ratio = noises_m["3 good parts"] / noises_m["1 good part"]
    assert ratio == pytest.approx(np.sqrt(4 / 6), abs=0.06)
    record = run_trial(trial)
    assert [row.detected for row in record.holes] == [True] * 5
    assert len({row.point for row in record.runs}) == 5


SWEPT = (
    "sweep={compared_with: [null, {kind: scan}, {kind: good_parts, parts: 2},"
    " {kind: good_parts, parts: 3}, {kind: mesh}]}"
)


def planned(folder: Path, *changes: str) -> Group:
    """The one group of a study that compares its boards."""
    (folder / "tiny.yaml").write_text(STUDY)
    changed = ["detector.name=local", SWEPT, *changes]
    (group,) = plan_of(load_experiment(folder / "tiny.yaml", changed), folder).groups
    return group


def test_a_study_plans_what_its_boards_are_compared_with(tmp_path: Path) -> None:
    group = planned(tmp_path)
    good_parts = set()
    for batch in group.batches:
        ((_, trial), *_) = group.trials(batch, {point.digest: 6.0 for point in group.points})
        (earlier,) = trial.references.earlier
        assert not earlier.damaged
        assert earlier.target.board == trial.views[0].target.board
        assert earlier.target.pose != trial.views[0].target.pose
        good_parts.add(trial.references.good_parts)
        # all that the trial needs is rendered
        shown = (*trial.views, earlier, *trial.references.good_parts)
        assert [str(job.path) for job in batch.renders] == [view.view_path for view in shown]
        assert all(not job.target.damages for job in batch.renders[1:])
    ((first, second, third),) = good_parts
    assert len({first.target.pose, second.target.pose, third.target.pose}) == 3
    shapes = [point.config.detector_settings["surface"]["shape"] for point in group.points]
    assert shapes == ["auto"] + ["expected"] * 4


def test_each_unit_records_its_own_references(tmp_path: Path) -> None:
    group = planned(tmp_path, "study.units=2")
    batch = next(batch for batch in group.then if batch.role == "damaged")
    seeds = []
    for _, trial in group.trials(batch, {point.digest: 6.0 for point in group.points}):
        seen = (*trial.views, *trial.references.earlier, *trial.references.good_parts)
        (seed,) = {view.camera.unit_seed for view in seen}
        seeds.append(seed)
    assert len(set(seeds)) == 2


def test_a_point_without_a_reference_keeps_its_digest(tmp_path: Path) -> None:
    (tmp_path / "tiny.yaml").write_text(STUDY)
    plain = load_experiment(tmp_path / "tiny.yaml", ["detector.name=local", "sweep={}"])
    compared = load_experiment(tmp_path / "tiny.yaml", ["detector.name=local", SWEPT])
    tables = _variants(compared)
    assert tables["compared_with"].tolist()[:2] == ["null", '{"kind": "scan"}']
    assert (tables["reference"] == tables["variant"]).all()  # what a variation varies
    digests = [point.digest for point in compared.points]
    assert plain.points[0].digest == digests[0]
    assert len(set(digests)) == 5


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ("detector.name=plane_ransac", "has no surface setting"),
        ("study=null", "a reference needs a study of single views"),
        ("compared_with={kind: good_parts, parts: 0}", "parts"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, changed: str, expected: str) -> None:
    (tmp_path / "tiny.yaml").write_text(STUDY)
    with pytest.raises(DeclarationError) as message:
        load_experiment(tmp_path / "tiny.yaml", ["compared_with={kind: scan}", changed])
    assert expected in str(message.value)
