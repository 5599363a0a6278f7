"""``python tests/validation/gate_power.py``: how often the gate fails without a reason, and what
growth it sees.

Whole studies are drawn from a model of a detector: a damage's score grows with a power of its
size, times the luck of its place (the same whenever the board is inspected again) and of its
board, plus noise of each inspection; the highest false scores of a hole-free board are those of
a Poisson process whose highest is Gumbel distributed. Thresholds are calibrated on boards of their own, as a study does it, so the luck of
that calibration is in the result. The baseline and the study differ in the draw of the noise
alone; or also in the camera's noise, by which all scores of damage fall, since they are in units
of it; or in how much luck places have, by which the curve flattens about the same a50; or in the
threshold that it finds at.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.evaluation.peaks import threshold_from_peaks
from harness.evaluation.study.record import (
    Calibrated,
    Inspected,
    SetUpRecord,
    StudyRecord,
    ThresholdError,
    Unflawed,
)
from harness.programs.gate.verdict import compare_studies

AREA_M2 = 0.054
NORMAL_90 = 1.2816
"""The normal distribution's 90th percentile."""
RATE_PER_M2 = 4.0
PEAKS = 10
NOISES = (1.1, 1.2, 1.3, 1.4)
FLATTER = (1.10, 1.20, 1.30)
SHIFTS = (1 / 1.5, 0.85, 1.1, 1.2, 1.3)


@dataclass(frozen=True)
class Model:
    """Scores in units of the deviation that the detector counts in; numbers as regression.yaml
    gives for one frame.

    ``sizes_mm``: smallest and largest; the score is ``score`` at ``size_mm`` and grows with its
    ``power``. ``place``, ``of_board``: deviations of the score's logarithm; ``noise`` of each
    inspection; ``false_score`` and ``false_spread`` of the Gumbel distribution of a hole-free
    board's highest score.
    """

    depth: bool
    sizes_mm: tuple[float, float]
    size_mm: float
    score: float
    power: float
    place: float
    of_board: float = 0.04
    noise: float = 0.47
    false_score: float = 4.22
    false_spread: float = 0.34


MODELS = (
    Model(depth=True, sizes_mm=(1.0, 6.0), size_mm=3.0, score=4.73, power=0.95, place=0.13),
    Model(depth=False, sizes_mm=(2.0, 8.0), size_mm=3.64, score=4.73, power=4.0, place=0.57),
)
"""Blind holes of one diameter, and holes drilled through: set-ups take turns with them."""


@dataclass(frozen=True)
class Size:
    """Boards with damage, damages on each, hole-free boards to judge and to calibrate, set-ups: of
    regression.yaml."""

    boards: int = 24
    holes: int = 10
    hole_free_boards: int = 24
    calibration_boards: int = 48
    set_ups: int = 4


@dataclass(frozen=True)
class Change:
    """What changed: the camera's ``noise``; ``flatter``: growth of a90 over a50 by more luck of
    places; ``bias``: the detector finds at this multiple of the threshold that it was calibrated
    to."""

    noise: float = 1.0
    flatter: float = 1.0
    bias: float = 1.0


def study(size: Size, boards_seed: int, noise_seed: int, change: Change = Change()) -> StudyRecord:
    """A study of the detector as it is, or as it became by ``change``."""
    set_ups = tuple(
        _set_up(size, boards_seed, noise_seed, position, change) for position in range(size.set_ups)
    )
    return StudyRecord("model", "", 15.0, RATE_PER_M2, {}, set_ups)


def _set_up(
    size: Size, boards_seed: int, noise_seed: int, number: int, change: Change
) -> SetUpRecord:
    model = MODELS[number % len(MODELS)]
    # ln(a90 / a50) is the 90th percentile of the luck's logarithm over the power with which scores
    # grow.
    position = model.place + model.power * np.log(change.flatter) / NORMAL_90
    of_boards = np.random.default_rng((boards_seed, 1))
    noise = np.random.default_rng((boards_seed, noise_seed, number, 2))
    n = size.boards * size.holes
    board = np.repeat(np.arange(size.boards), size.holes)
    size_mm = of_boards.uniform(*model.sizes_mm, n)
    luck = position * of_boards.standard_normal(n)
    luck += model.of_board * of_boards.standard_normal(size.boards)[board]
    signal = model.score / change.noise * (size_mm / model.size_mm) ** model.power * np.exp(luck)
    signal = np.abs(signal + model.noise * noise.standard_normal(n))
    # of a unit Poisson process, the arrival times of the highest scores
    times = np.cumsum(noise.exponential(size=(size.calibration_boards, PEAKS)), axis=1)
    peaks = model.false_score - model.false_spread * np.log(times)
    calibration = peaks[:, 0]
    judged = model.false_score + model.false_spread * noise.gumbel(size=size.hole_free_boards)
    calibrated = threshold_from_peaks(peaks.tolist(), AREA_M2, RATE_PER_M2)
    threshold = calibrated.value
    names = np.tile([str(1 + hole) for hole in range(size.holes)], size.boards)
    zero = np.zeros(n)
    repeat = np.zeros(n, int)
    diameter_mm = np.full(n, 10.0) if model.depth else size_mm
    depth_mm = size_mm if model.depth else np.full(n, 12.7)
    first_runs = np.zeros(len(calibration), int)
    at_middle = np.zeros(len(calibration))
    return SetUpRecord(
        variant=f"set-up {number}",
        frames=1,
        axes={},
        detector="model",
        detector_version=1,
        threshold=threshold,
        threshold_mm=threshold,
        calibration_runs=size.calibration_boards,
        failed=0,
        targets_digest=str(boards_seed),
        frames_digest=f"{boards_seed} {noise_seed}",
        inspected=Inspected(
            board=board,
            hole=names,
            repeat=repeat,
            diameter_mm=diameter_mm,
            depth_mm=depth_mm,
            x_mm=zero,
            y_mm=zero,
            hit=signal > change.bias * threshold,
            signal=signal,
        ),
        unflawed=Unflawed(
            np.arange(size.hole_free_boards),
            np.zeros(size.hole_free_boards, int),
            (judged > change.bias * threshold).astype(int),
            np.full(size.hole_free_boards, AREA_M2),
        ),
        calibrated=Calibrated(
            board=first_runs,
            repeat=first_runs,
            score=calibration,
            x_mm=at_middle,
            y_mm=at_middle,
        ),
        threshold_error=ThresholdError(
            error=calibrated.error,
            low_per_m2=calibrated.interval_per_m2.low,
            high_per_m2=calibrated.interval_per_m2.high,
            method=calibrated.method,
        ),
    )


def fails(baseline: StudyRecord, found: StudyRecord) -> bool:
    """Whether the gate fails; it takes about a second for four set-ups."""
    return any(row.is_worse for row in compare_studies(baseline, found).rows)


def share(
    size: Size, times: int, change: Change = Change(), *, other_boards: bool = False
) -> float:
    """Share of ``times`` checks that fail, each with boards and noise of its own."""
    failing = 0
    for draw in range(times):
        boards = 2 * draw
        failing += fails(study(size, boards, 1), study(size, boards + other_boards, 2, change))
    return failing / times


def main() -> None:
    """Print what stands in the documentation of `harness.programs.gate.check`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quiet", type=int, default=500, help="checks in which nothing changes but the noise"
    )
    parser.add_argument(
        "--changed", type=int, default=60, help="checks for each change, and on other boards"
    )
    parser.add_argument(
        "--boards", type=int, default=Size.boards, help="boards with damage (default: %(default)s)"
    )
    options = parser.parse_args()
    began = time.perf_counter()
    size = Size(boards=options.boards)
    print(size)
    changes = {
        **{f"the camera's noise times {noise:.2f}": Change(noise=noise) for noise in NOISES},
        **{
            f"a90 grows by {growth:.2f}, a50 does not": Change(flatter=growth) for growth in FLATTER
        },
        **{f"finds at {shift:.2f} of its threshold": Change(bias=shift) for shift in SHIFTS},
    }
    for content, change in changes.items():
        print(
            (
                f"{content}: {share(size, options.changed, change):.2f} of {options.changed} "
                "checks fail"
            ),
            flush=True,
        )
    print(f"another noise: {share(size, options.quiet):.4f} of {options.quiet}", flush=True)
    print(
        (
            f"other boards: {share(size, options.changed, other_boards=True):.3f} of "
            f"{options.changed}"
        ),
        flush=True,
    )
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
