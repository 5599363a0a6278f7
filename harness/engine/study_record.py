"""A study's record, made from its tables: every inspection of every set-up, and what names targets and frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from harness.engine.plan import PACKAGES, Batch, Group, SweepPlan
from harness.evaluation.study.record import Calibrated, Inspected, SetUpRecord, StudyRecord, Unflawed
from harness.experiment.points import Experiment, Point, detector_version
from harness.tables.trials import ResultTables
from harness.vocabulary.seeds import digest
from harness.vocabulary.sources import source_digest

SIMULATION = ("scenes.sensor.source",)
"""Modules that decide frames, with all that they import: a change of any makes frames count as different."""


def record_of(
    experiment: Experiment,
    plan: SweepPlan,
    tables: ResultTables,
    failed: Mapping[str, int],
    provenance: Mapping[str, Any],
) -> StudyRecord:
    """The record of a study. ``failed``: trials that raised, by point digest. Set-ups no trial of which ended are left
    out, as nothing can be said of them."""
    calibrate = experiment.config.threshold.calibrate
    found = {point.digest: group for group in plan.groups for point in group.points}
    set_ups = [_set_up(point, found[point.digest], tables, failed.get(point.digest, 0)) for point in experiment.points]
    return StudyRecord(
        name=experiment.config.name,
        digest=experiment.digest,
        hit_radius_mm=experiment.config.matching.radius_mm,
        false_calls_per_m2=None if calibrate is None else calibrate.false_calls_per_m2,
        provenance={key: provenance[key] for key in ("commit", "dirty", "versions", "seed", "command")},
        set_ups=tuple(one for one in set_ups if one is not None),
    )


def _set_up(point: Point, group: Group, tables: ResultTables, failed: int) -> SetUpRecord | None:
    frames = point.config.capture.frames
    holes, runs = (_of(table, point.variant, frames) for table in (tables.holes, tables.runs))
    if holes.empty:
        return None
    judged = runs[runs["threshold"].notna()]
    unflawed = judged[judged["role"] == "hole_free"]
    threshold = float(judged["threshold"].iloc[0])
    return SetUpRecord(
        variant=point.variant,
        frames=frames,
        axes=dict(point.axes),
        detector=point.config.detector.name,
        detector_version=detector_version(point.config),
        threshold=threshold,
        threshold_mm=threshold * float(judged["scale_mm"].mean()),
        calibration_runs=int((runs["role"] == "calibration").sum()),
        failed=failed,
        targets_digest=_targets_digest(group.then),
        frames_digest=_frames_digest(point, group),
        inspected=_inspected(holes),
        unflawed=Unflawed(
            board=unflawed["board"].to_numpy(int),
            repeat=unflawed["repeat"].to_numpy(int),
            calls=(unflawed["false_calls"] + unflawed["no_return_calls"]).to_numpy(int),
            area_m2=unflawed["inspected_m2"].to_numpy(float),
            no_return_calls=unflawed["no_return_calls"].to_numpy(int),
        ),
        calibrated=_calibrated(runs[runs["role"] == "calibration"]),
    )


def _calibrated(runs: pd.DataFrame) -> Calibrated | None:
    """None where no run set a threshold. Runs that judged no pixel are left out."""
    runs = runs[runs["quiet_threshold"].notna()]
    if runs.empty:
        return None
    return Calibrated(
        board=runs["board"].to_numpy(int),
        repeat=runs["repeat"].to_numpy(int),
        score=runs["quiet_threshold"].to_numpy(float),
        x_mm=runs["loudest_x_mm"].to_numpy(float),
        y_mm=runs["loudest_y_mm"].to_numpy(float),
    )


def _of(table: pd.DataFrame, variant: str, frames: int) -> pd.DataFrame:
    if table.empty:
        return table
    return table[(table["variant"] == variant) & (table["frames"] == frames)]


def _inspected(holes: pd.DataFrame) -> Inspected:
    by_depth, by_no_return = holes["detected"].to_numpy(bool), holes["no_return"].to_numpy(bool)
    return Inspected(
        board=holes["board"].to_numpy(int),
        hole=holes["hole"].to_numpy(str),
        repeat=holes["repeat"].to_numpy(int),
        diameter_mm=holes["true_diameter_mm"].to_numpy(float),
        depth_mm=holes["true_depth_mm"].to_numpy(float),
        x_mm=holes["true_x_mm"].to_numpy(float),
        y_mm=holes["true_y_mm"].to_numpy(float),
        hit=by_depth | by_no_return,
        signal=holes["signal"].to_numpy(float),
        by_depth=by_depth,
        by_no_return=by_no_return,
    )


def _targets_digest(batches: Sequence[Batch]) -> str:
    """Names the damage and the size of every damaged board, wherever and before whichever camera it stands."""
    boards = [batch.set_ups[0].target for batch in batches if batch.role == "damaged"]
    return digest([[board.board.to_data(), *(damage.to_data() for damage in board.damages)] for board in boards])


def _frames_digest(point: Point, group: Group) -> str:
    """Equal where every frame of every judged board is: renders, camera, noise, number of frames, simulating code."""
    renders: Iterable[str] = (job.path.stem for batch in group.then for job in batch.renders)
    config = point.config
    code = source_digest(SIMULATION, PACKAGES)
    return digest([code, *renders, point.frames_key, config.capture.to_data(), config.repeats])


def failed_by_point(plan: SweepPlan, whats: Iterable[str], thresholds: Mapping[str, float]) -> dict[str, int]:
    """Count the trials of each point that raised, from the journal keys of failures."""
    keys = set(whats)
    counts: dict[str, int] = {}
    if not keys:
        return counts
    for group in plan.groups:
        for batch in group.batches:
            given = {} if batch in group.first else thresholds
            for key, task in group.trials(batch, given):
                for asked in task.points if key in keys else ():
                    counts[asked.digest] = counts.get(asked.digest, 0) + 1
    return counts
