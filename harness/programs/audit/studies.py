"""Simulated studies with known truth: signals of damage and scores of hole-free boards, judged by
the functions that judge real studies.

A damage of size a on a board has the signal s + 0.8 (a - a50 - shift + width l), with s the score
above which one false call per square metre is expected and l logistic: at the threshold s it is
found with probability logistic((a - a50 - shift) / width), and a threshold that misses s moves a50
by 1.25 mm for each unit. Shifts are normal, one for each board. Hole-free boards have independent
places with Gaussian scores or, heavier, Student's with 12 degrees of freedom. Not modelled:
scores that depend on each other, boards that differ in noise, findings that merge."""

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special, stats

from harness.evaluation.intervals import Interval
from harness.evaluation.peaks import RateThreshold, threshold_from_peaks
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import (
    Inspected,
    SetUpRecord,
    ThresholdError,
    Unflawed,
)
from harness.vocabulary.seeds import random_stream

A50_MM = 6.0
SIZES_MM = (1.0, 14.0)
SIGNAL_PER_MM = 0.8
RATE_PER_M2 = 1.0
AREA_M2 = 0.054
PLACES = 2000
PEAKS = 10
SET_BOARDS = 60  # hole-free boards that set the threshold
COUNTED_BOARDS = 60  # hole-free boards on which false calls are counted
DRAWS = 10  # of resampled boards, on which no claim hangs
LAWS = {"Gaussian": stats.norm(), "Student 12": stats.t(12)}


@dataclass(frozen=True)
class StudyCase:
    """Studies that are simulated alike."""

    name: str
    """What distinguishes them."""
    width_mm: float
    """Width of the curve's rise."""
    boards: int = 8
    """Number of damaged boards."""
    holes: int = 8
    """Number of damages on each."""
    shift_mm: float = 0.0
    """Standard deviation of a50 between boards."""
    law: str = "Gaussian"
    """Distribution of scores on hole-free boards, one of `LAWS`."""

    @property
    def wanted_threshold(self) -> float:
        """The score above which `RATE_PER_M2` is expected."""
        share = RATE_PER_M2 * AREA_M2 / PLACES / 2
        return float(LAWS[self.law].isf(share))

    def rate_at(self, threshold: float) -> float:
        """Return the true rate of false calls per square metre."""
        return float(PLACES * 2 * LAWS[self.law].sf(threshold) / AREA_M2)

    def size_at(self, pod: float) -> float:
        """Return the true size with this POD on a board drawn at random."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(80)

        def excess(size_mm: float) -> float:
            pods = special.expit((size_mm - A50_MM - self.shift_mm * nodes) / self.width_mm)
            return float(weights @ pods / weights.sum()) - pod

        return float(optimize.brentq(excess, -50.0, 100.0))


STUDY_CASES = (
    StudyCase("steep, 64 targets", 0.2),
    StudyCase("64 targets", 0.8),
    StudyCase("flat, 64 targets", 1.6),
    StudyCase("20 targets", 0.8, boards=5, holes=4),
    StudyCase("flat, 20 targets", 1.6, boards=5, holes=4),
    StudyCase("160 targets", 0.8, boards=20),
    StudyCase("64 targets, boards differ by 1 mm", 0.8, shift_mm=1.0),
    StudyCase("160 targets, boards differ by 2 mm", 0.8, boards=20, shift_mm=2.0),
    StudyCase("64 targets, heavy tails", 0.8, law="Student 12"),
)


@dataclass(frozen=True)
class Claim:
    """A statement of a study, and whether the truth keeps to it."""

    quantity: str
    """What is stated."""
    nominal: float
    """Nominal coverage."""
    holds: bool
    """Whether the truth lies within it."""
    ratio: float
    """Upper end over the truth; infinite if there is none."""


def claims_of_study(case: StudyCase, number: int) -> list[Claim]:
    """Draw study ``number`` of a case, judge it, and compare what it states with the truth."""
    random = random_stream(0, "audit", case.name, number)
    threshold = drawn_threshold(case, random)
    limit = limit_of(_record(case, threshold, random), draws=DRAWS)
    return claims_of(case, threshold, limit)


def claims_of(case: StudyCase, threshold: RateThreshold, limit: SetUpLimit) -> list[Claim]:
    """Compare what a study states with the truth."""
    a50_mm = case.size_at(0.5)
    a90_mm = case.size_at(0.9)
    claims = [
        _bound_claim("a90/95", limit.a90_95.value, a90_mm),
        _bound_claim("a90/95 over boards", limit.over_boards.value, a90_mm),
        _interval_claim(
            "true rate at the threshold", threshold.interval_per_m2, case.rate_at(threshold.value)
        ),
    ]
    if limit.statement is not None:
        claims.append(_interval_claim("a50", limit.a50_interval_mm, a50_mm))
        claims.append(_interval_claim("a90", limit.a90_interval_mm, a90_mm))
    signals = limit.from_signals
    if signals.lines:
        claims.append(_interval_claim("a50 by signals", signals.a50_interval_mm, a50_mm))
        claims.append(_interval_claim("a90 by signals", signals.a90_interval_mm, a90_mm))
        claims.append(_bound_claim("a90/95 by signals", signals.a90_95_mm, a90_mm))
    if limit.false_calls is not None:
        counted = limit.false_calls.interval_per_m2
        claims.append(_interval_claim("counted rate", counted, case.rate_at(threshold.value)))
    return claims


def _interval_claim(quantity: str, interval: Interval, truth: float) -> Claim:
    holds = bool(interval.low <= truth <= interval.high)
    return Claim(quantity, 0.95, holds, interval.high / truth)


def _bound_claim(quantity: str, bound_mm: float, truth_mm: float) -> Claim:
    return Claim(quantity, 0.95, bound_mm >= truth_mm, bound_mm / truth_mm)


def drawn_threshold(case: StudyCase, random: np.random.Generator) -> RateThreshold:
    """Set the threshold by hole-free boards."""
    law = LAWS[case.law]
    # the highest of n places of either sign: uniform order statistics, from the top
    gaps = random.exponential(size=(SET_BOARDS, PEAKS)) / (PLACES - np.arange(PEAKS))
    above = -np.expm1(-np.cumsum(gaps, axis=1))
    peaks = law.isf(above / 2)
    return threshold_from_peaks(peaks.tolist(), AREA_M2, RATE_PER_M2)


def _record(case: StudyCase, threshold: RateThreshold, random: np.random.Generator) -> SetUpRecord:
    """Draw the inspections of a study at a threshold."""
    count = case.boards * case.holes
    board = np.repeat(np.arange(case.boards), case.holes)
    size_mm = random.permutation(np.linspace(*SIZES_MM, count))
    shift_mm = (case.shift_mm * random.standard_normal(case.boards))[board]
    above_mm = size_mm - A50_MM - shift_mm + case.width_mm * random.logistic(size=count)
    calls = random.poisson(case.rate_at(threshold.value) * AREA_M2, COUNTED_BOARDS)
    return recorded(case, threshold, size_mm=size_mm, above_mm=above_mm, calls=calls)


def recorded(
    case: StudyCase,
    threshold: RateThreshold,
    *,
    size_mm: np.ndarray,
    above_mm: np.ndarray,
    calls: np.ndarray,
) -> SetUpRecord:
    """Return the record of a study whose damages (n,), board by board, lie ``above_mm`` (n,) what
    is found at the wanted threshold; ``calls`` (m,): false calls of the boards that count them."""
    boards = len(size_mm) // case.holes
    signal = case.wanted_threshold + SIGNAL_PER_MM * above_mm
    hit = signal > threshold.value
    return SetUpRecord(
        variant="main",
        frames=1,
        axes={},
        detector="simulated",
        detector_version=1,
        threshold=threshold.value,
        threshold_mm=np.nan,
        calibration_runs=SET_BOARDS,
        failed=0,
        targets_digest="simulated",
        frames_digest="simulated",
        inspected=Inspected(
            board=np.repeat(np.arange(boards), case.holes),
            hole=np.tile(np.arange(case.holes).astype(str), boards),
            repeat=np.zeros(len(size_mm), int),
            diameter_mm=size_mm,
            depth_mm=np.full(len(size_mm), 5.0),
            x_mm=np.zeros(len(size_mm)),
            y_mm=np.zeros(len(size_mm)),
            hit=hit,
            signal=signal,
            by_depth=hit,
            by_no_return=np.zeros(len(size_mm), bool),
        ),
        unflawed=Unflawed(
            board=1000 + np.arange(COUNTED_BOARDS),
            repeat=np.zeros(COUNTED_BOARDS, int),
            calls=calls,
            area_m2=np.full(COUNTED_BOARDS, AREA_M2),
        ),
        threshold_error=ThresholdError(
            error=threshold.error,
            low_per_m2=threshold.interval_per_m2.low,
            high_per_m2=threshold.interval_per_m2.high,
            method=threshold.method,
        ),
    )
