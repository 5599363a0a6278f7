"""One trial: capture the frames of a board, average them, merge views into maps, judge the clouds,
and record what was found.

A `Trial` says what is to be done. A `harness.trials.board.Board` is what is true and what the
camera sees. A `harness.trials.judge.Judgement` is the result, which `harness.trials.record` turns
into rows."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from harness.records.rows import Origin, Role, TrialRecord
from harness.trials.averages import Averaging, averages_of
from harness.trials.board import Board, BoardRef, load_board
from harness.trials.clouds import NOISE_FRAMES, MapClouds, TrialPoint, ViewClouds
from harness.trials.judge import Criteria, Judgement, judge, with_truth
from harness.trials.record import add_judgement
from harness.trials.references import NO_REFERENCES, ReferenceBoards
from harness.vocabulary.geometry import Cloud
from scenes.perspectives import AnyViews
from scenes.sensor.source import SimulatedCapture


@dataclass(frozen=True)
class Trial:
    """Frames of one board, drawn once and judged by all points that share them."""

    views: tuple[BoardRef, ...]
    """The board in each view; the first is the reference."""
    seed: int
    """Seed of the noise."""
    role: Role
    """Purpose of the board."""
    repeat: int
    """Number of the draw of the noise."""
    points: tuple[TrialPoint, ...]
    """The points that judge the frames."""
    poses: AnyViews | None = None
    """Declaration of several views; None for a single view."""
    board: int | None = None
    """Number of the board in a study; None outside studies."""
    references: ReferenceBoards = NO_REFERENCES
    """What the board may be compared with."""

    @property
    def hole_free(self) -> bool:
        """Return whether the target is shown without damage."""
        return self.role != "damaged"

    @property
    def labels(self) -> tuple[str | int, ...]:
        """Labels of the random stream: different for all trials and boards."""
        if self.board is None:
            return (self.role, self.repeat)
        return (self.role, self.repeat, "board", self.board)


def run_trial(trial: Trial) -> TrialRecord:
    """Run one trial. Points that see the same cloud and judge it alike share the judgement."""
    boards = [load_board(view) for view in trial.views]
    record = TrialRecord()
    for points in sharing_averages(trial.points):
        began = time.perf_counter()
        clouds = captured(trial, boards, points)
        seconds_frames = (time.perf_counter() - began) / len(points)
        judgements: dict[tuple[str, Criteria], Judgement] = {}
        for point in points:
            origin = Origin(
                variant=point.variant, frames=point.frames, repeat=trial.repeat, board=trial.board
            )
            judged_as = (clouds.key(point), point.criteria)
            if judged_as not in judgements:
                labelled = clouds.labelled(point)
                judgements[judged_as] = judge(labelled, point.criteria)
            judgement = judgements[judged_as]
            if point.left_out:
                judgement = with_truth(judgement, clouds.labelled(point))
            add_judgement(
                record,
                judgement,
                point=point.digest,
                origin=origin,
                role=trial.role,
                seconds_frames=seconds_frames,
                exposure_share=exposure_share_of(boards, point),
                map_facts=clouds.map_facts(point),
            )
            record.registrations += clouds.registration_rows(point, origin, trial.role)
            if trial.hole_free and trial.board is None:
                record.probes.append(clouds.probes_row(point, origin))
                record.noise += clouds.noise_rows(point, origin)
    return record


def exposure_share_of(boards: Sequence[Board], point: TrialPoint) -> float:
    """Return the mean exposure time of a point's views over the camera's longest."""
    shares = []
    for number, board in enumerate(boards):
        if uses_view(point, number):
            shares.append(board.unit.exposure_share)
    return sum(shares) / len(shares)


def sharing_averages(points: Sequence[TrialPoint]) -> list[list[TrialPoint]]:
    """Group points whose frames become clouds in the same way."""
    groups: dict[Averaging, list[TrialPoint]] = {}
    for point in points:
        groups.setdefault(point.averaging, []).append(point)
    return list(groups.values())


Averages = Sequence[Mapping[int, Cloud]]
"""Clouds by view, then by number of frames."""

_kept: dict[tuple[Any, ...], Averages] = {}
"""The averages of the last hole-free board, by all that determines them."""


def captured(
    trial: Trial, boards: Sequence[Board], points: Sequence[TrialPoint]
) -> ViewClouds | MapClouds:
    """Capture and average the frames of each view at all numbers of frames of the points, which
    share their averaging.

    Set-ups that differ only in their damage see the same hole-free board one after the other, so
    its averages are kept for the next trial, with what detectors have fitted to them."""
    averaging = points[0].averaging
    counts = []
    for number in range(len(boards)):
        counts.append(sorted({point.frames for point in points if uses_view(point, number)}))
    if not trial.hole_free or trial.board is not None:
        return clouds_of(trial, boards, _averages(trial, boards, counts, averaging))
    shown = [(view.view_path, view.camera) for view in trial.views]
    key = (*shown, trial.seed, trial.labels, averaging, repr(counts))
    if key not in _kept:
        _kept.clear()
        _kept[key] = _averages(trial, boards, counts, averaging)
    return clouds_of(trial, boards, _kept[key])


def _averages(
    trial: Trial, boards: Sequence[Board], counts: Sequence[Sequence[int]], averaging: Averaging
) -> Averages:
    """Capture and average the frames of each view at its numbers of frames (``counts``)."""
    averages = []
    for number, board in enumerate(boards):
        clouds: dict[int, Cloud] = {}
        if counts[number]:
            capture = capture_of(trial, number, board, counts[number][-1])
            clouds = averages_of(capture, counts[number], averaging)
        averages.append(clouds)
    return averages


def clouds_of(trial: Trial, boards: Sequence[Board], averages: Averages) -> ViewClouds | MapClouds:
    """Return what points see of averages by view and number of frames."""
    if trial.poses is not None:
        return MapClouds(boards, averages, trial.poses, trial.labels)
    return view_clouds(trial, boards[0], averages[0])


def view_clouds(trial: Trial, board: Board, averages: Mapping[int, Cloud]) -> ViewClouds:
    """Return what points see of a single view's averages by number of frames."""
    return ViewClouds(
        board=board,
        averages=averages,
        first_frames=capture_of(trial, 0, board, NOISE_FRAMES),
        seed=trial.seed,
        labels=trial.labels,
        references=trial.references,
    )


def uses_view(point: TrialPoint, number: int) -> bool:
    """Return whether a point uses the view of a number."""
    if point.mapping is None or point.mapping.views is None:
        return True
    return number < point.mapping.views


def capture_of(trial: Trial, number: int, board: Board, frames: int) -> SimulatedCapture:
    """Return the frames of one view in one trial. Those of the first view are the same without
    other views."""
    labels = trial.labels
    if number:
        labels = (*labels, "view", number)
    return board.unit.capture(frames, trial.seed, *labels)


def cloud_of(trial: Trial, point: TrialPoint) -> Cloud:
    """Return the cloud, or the map, that a point's detector sees in a trial."""
    boards = [load_board(view) for view in trial.views]
    return captured(trial, boards, [point]).cloud(point)
