"""A study's record from the tables of its trials: thresholds, hits and false calls of each set-up,
and what kept a set-up from having a limit."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from harness.evaluation.peaks import threshold_from_peaks
from harness.evaluation.study.record import (
    Calibrated,
    DrawnUnknown,
    Inspected,
    SetUpRecord,
    StudyRecord,
    ThresholdError,
    Unflawed,
)
from harness.experiment.schema import Experiment, ExperimentConfig, Point, detector_version
from harness.experiment.unfold import stated_value
from harness.experiment.unknowns import UnknownConfig
from harness.records.trials import ResultTables
from harness.runs.jobs import Failure, Outcome
from harness.runs.plan import PACKAGES, Group, SweepPlan
from harness.vocabulary.path_names import in_words
from harness.vocabulary.provenance import source_digest
from harness.vocabulary.seeds import digest

SIMULATION = ("scenes.sensor.source",)
"""With all that they import, these modules determine frames."""
RECORDED_PROVENANCE = ("commit", "dirty", "versions", "seed", "command", "digests")


def record_of(
    experiment: Experiment,
    plan: SweepPlan,
    tables: ResultTables,
    failed: Mapping[str, Sequence[Failure]],
    provenance: Mapping[str, Any],
) -> StudyRecord:
    """Return a study's record, without set-ups that have no judged damaged board.

    ``failed``: failed trials by point digest."""
    calibrate = experiment.config.threshold.calibrate
    set_ups = []
    for point in experiment.points:
        failed_count = len(failed.get(point.digest, ()))
        set_up = set_up_record(point, plan, tables, failed_count)
        if set_up is not None:
            set_ups.append(set_up)
    return StudyRecord(
        name=experiment.config.name,
        digest=experiment.digest,
        hit_radius_mm=experiment.config.matching.radius_mm,
        hit_overlap=experiment.config.matching.overlap,
        false_calls_per_m2=None if calibrate is None else calibrate.false_calls_per_m2,
        provenance={key: provenance[key] for key in RECORDED_PROVENANCE},
        set_ups=tuple(set_ups),
        designs=tuple(plan.designs.values()),
    )


def set_up_record(
    point: Point, plan: SweepPlan, tables: ResultTables, failed_count: int
) -> SetUpRecord | None:
    """Return the record of a point; None if no damaged board of it was judged."""
    config = point.config
    group = plan.group_of(point)
    holes = _rows_of(point, tables.holes)
    runs = _rows_of(point, tables.runs)
    if holes.empty:
        return None
    targets = []
    for batch in group.then:
        if batch.role == "damaged":
            board = batch.views[0].target
            damages = [damage.to_data() for damage in board.damages]
            targets.append([board.board.to_data(), *damages])
    units = 1 if config.study is None else config.study.units or 1
    # equal if every frame of every judged board is equal
    frames_decided_by = [
        source_digest(SIMULATION, PACKAGES),
        *(path.stem for batch in group.then for path in batch.paths),
        point.frames_key,
        config.capture.to_data(),
        config.repeats,
        None if config.study is None else config.study.units,
    ]
    calibrating = runs[runs["role"] == "calibration"]
    return set_up_of(
        holes,
        runs,
        variant=point.variant,
        frames=config.capture.frames,
        axes=dict(point.axes),
        detector=config.detector.name,
        detector_version=detector_version(config),
        calibration_runs=len(calibrating),
        failed=failed_count,
        targets_digest=digest(targets),
        frames_digest=digest(frames_decided_by),
        units=units,
        calibrated=_calibrated(calibrating),
        threshold_error=_threshold_error(calibrating, config),
        sizes_chosen=bool(plan.designs),
        drawn=tuple(_drawn(unknown, point, group) for unknown in point.unknowns),
    )


def _drawn(unknown: UnknownConfig, point: Point, group: Group) -> DrawnUnknown:
    """Return an unknown with its level on each damaged board of a point: the number of one of its
    values, or a number of its range."""
    boards = [batch.board or 0 for batch in group.then if batch.role == "damaged"]
    levels = [unknown.drawn(point.config.seed, "damaged", board) for board in boards]
    if unknown.values is not None:
        levels = [unknown.values.index(value) for value in levels]
    return DrawnUnknown(
        key=unknown.key,
        stated=stated_value(point.config, unknown.key),
        reason=unknown.reason,
        board=np.array(boards),
        level=np.array(levels, float),
        values=unknown.values,
        range=unknown.range,
    )


def _rows_of(point: Point, table: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of a table that belong to a point."""
    if table.empty:
        return table
    is_variant = table["variant"] == point.variant
    return table[is_variant & (table["frames"] == point.config.capture.frames)]


def _calibrated(calibrating: pd.DataFrame) -> Calibrated | None:
    """Return where the highest score of each calibration board lies; None without such scores."""
    loudest = calibrating[calibrating["quiet_threshold"].notna()]  # not: runs that judged no pixel
    if loudest.empty:
        return None
    return Calibrated(
        board=loudest["board"].to_numpy(int),
        repeat=loudest["repeat"].to_numpy(int),
        score=loudest["quiet_threshold"].to_numpy(float),
        x_mm=loudest["loudest_x_mm"].to_numpy(float),
        y_mm=loudest["loudest_y_mm"].to_numpy(float),
        u_px=loudest["loudest_u_px"].to_numpy(float),
        v_px=loudest["loudest_v_px"].to_numpy(float),
    )


def _threshold_error(calibrating: pd.DataFrame, config: ExperimentConfig) -> ThresholdError | None:
    """Return the uncertainty of a threshold for a rate; None for a threshold that was given."""
    calibrate = config.threshold.calibrate
    loudest = calibrating[calibrating["quiet_threshold"].notna()]
    if calibrate is None or calibrate.false_calls_per_m2 is None or loudest.empty:
        return None
    threshold = threshold_from_peaks(
        [list(peaks) for peaks in loudest["peaks"]],
        float(loudest["inspected_m2"].mean()),
        calibrate.false_calls_per_m2,
    )
    return ThresholdError(
        error=threshold.error,
        low_per_m2=threshold.interval_per_m2.low,
        high_per_m2=threshold.interval_per_m2.high,
        method=threshold.method,
    )


def set_up_of(holes: pd.DataFrame, runs: pd.DataFrame, **columns: Any) -> SetUpRecord:
    """Return a set-up's record: threshold, hits and false calls from tables of its judged boards.

    ``columns``: the further fields of `SetUpRecord`."""
    judged = runs[runs["threshold"].notna()]
    threshold = float(judged["threshold"].iloc[0])
    by_depth = holes["detected"].to_numpy(bool)
    by_no_return = holes["no_return"].to_numpy(bool)
    inspected = Inspected(
        board=holes["board"].to_numpy(int),
        hole=holes["hole"].to_numpy(str),
        repeat=holes["repeat"].to_numpy(int),
        diameter_mm=holes["true_diameter_mm"].to_numpy(float),
        depth_mm=holes["true_depth_mm"].to_numpy(float),
        x_mm=holes["true_x_mm"].to_numpy(float),
        y_mm=holes["true_y_mm"].to_numpy(float),
        signal=holes["signal"].to_numpy(float),
        hit=by_depth | by_no_return,
        by_depth=by_depth,
        by_no_return=by_no_return,
        size_of=str(holes["size_of"].iloc[0]),
    )
    defaults: dict[str, Any] = {"axes": {}, "detector_version": 0, "failed": 0}
    return SetUpRecord(
        threshold=threshold,
        threshold_mm=threshold * float(judged["scale_mm"].mean()),
        inspected=inspected,
        unflawed=_false_calls(judged[judged["role"] == "hole_free"]),
        beside=_false_calls(judged[judged["role"] == "damaged"]),
        **(defaults | columns),
    )


def _false_calls(runs: pd.DataFrame) -> Unflawed:
    """Return the false calls of judged boards, with those where nothing returned."""
    no_return_calls = runs["no_return_calls"].to_numpy(int)
    return Unflawed(
        board=runs["board"].to_numpy(int),
        repeat=runs["repeat"].to_numpy(int),
        calls=runs["false_calls"].to_numpy(int) + no_return_calls,
        area_m2=runs["inspected_m2"].to_numpy(float),
        no_return_calls=no_return_calls,
    )


def failures_by_point(
    plan: SweepPlan, failures: Iterable[Failure], thresholds: Mapping[str, float]
) -> dict[str, list[Failure]]:
    """Return the failed trials of each point, by its digest."""
    by_key = {failure.what: failure for failure in failures}
    by_point: dict[str, list[Failure]] = {}
    if not by_key:
        return by_point
    for group in plan.groups:
        for batch in group.batches:
            for key, task in group.trials(batch, thresholds if batch in group.then else {}):
                if key not in by_key:
                    continue
                for point in task.points:
                    by_point.setdefault(point.digest, []).append(by_key[key])
    return by_point


def without_limit(
    points: Iterable[Point],
    outcome: Outcome,
    failed: Mapping[str, list[Failure]],
    judged: Iterable[SetUpRecord],
) -> list[str]:
    """Return sentences on the points that are not among the ``judged`` set-ups, each with its most
    common failure."""
    judged_set_ups = {(set_up.variant, set_up.frames) for set_up in judged}
    labels_by_cause: dict[str, list[str]] = {}
    for point in points:
        if (point.variant, point.config.capture.frames) not in judged_set_ups:
            cause = _cause(point, outcome, failed.get(point.digest, ()))
            labels_by_cause.setdefault(cause, []).append(in_words(point.label))
    return [f"no limit for {'; '.join(labels)}: {why}" for why, labels in labels_by_cause.items()]


def _cause(point: Point, outcome: Outcome, failed: Iterable[Failure]) -> str:
    """Return the most common reason why a point was not judged."""
    failures = [failure for failure in failed if failure.state != "skipped"]
    causes = [failure.in_short for failure in failures]
    if not causes:
        of_threshold = f"threshold of {point.label}"
        causes = [failure.in_short for failure in outcome.failures if failure.what == of_threshold]
    cause = Counter([*causes, "its trials did not finish"]).most_common(1)[0][0]
    only_mistakes = all(failure.state == "failed" and not failure.is_bug for failure in failures)
    if failures and only_mistakes:
        return f"the camera sees no part of the board that can be judged ({cause})"
    return cause
