"""Simulated studies with a stated precision: boards in batches, by the rule that adds them to real
studies. Damage, boards and thresholds are those of `studies`."""

from dataclasses import dataclass, replace

import numpy as np

from harness.evaluation.peaks import RateThreshold
from harness.evaluation.study.limit import SetUpLimit, limit_of
from harness.evaluation.study.record import BoardDesign
from harness.evaluation.study.sequential import first_design, next_design
from harness.programs.audit.studies import (
    A50_MM,
    COUNTED_BOARDS,
    DRAWS,
    SIZES_MM,
    Claim,
    StudyCase,
    claims_of,
    drawn_threshold,
    recorded,
)
from harness.vocabulary.seeds import random_stream

MOST_BOARDS = 80


@dataclass(frozen=True)
class PreciseCase:
    """Studies that are simulated alike, until a90 is known well enough."""

    case: StudyCase
    """Their damage; its number of boards does not count."""
    a90_mm: float
    """Width of the interval of a90 at which they end."""

    @property
    def name(self) -> str:
        """Name of the case."""
        return f"{self.case.name}, a90 to {self.a90_mm:g} mm"


PRECISE_CASES = (
    PreciseCase(StudyCase("steep", 0.2), 0.7),
    PreciseCase(StudyCase("sequential", 0.8), 1.4),
    PreciseCase(StudyCase("flat", 1.6), 2.0),
    PreciseCase(StudyCase("boards differ by 1 mm", 0.8, shift_mm=1.0), 1.6),
    PreciseCase(StudyCase("boards differ by 2 mm", 0.8, shift_mm=2.0), 2.2),
)
"""With these widths studies take from the least to the largest number of boards."""


def claims_of_precise_study(precise: PreciseCase, number: int) -> list[Claim]:
    """Run study ``number`` of a case to its end, and compare what it states with the truth. The
    last claim is no coverage: whether the precision was reached, with the number of boards."""
    case = precise.case
    threshold = drawn_threshold(case, random_stream(0, "audit", precise.name, number))
    design = first_design(
        damage="",
        range_mm=SIZES_MM,
        per_board=case.holes,
        most_boards=MOST_BOARDS,
        a90_mm=precise.a90_mm,
        a90_percent=None,
    )
    while not design.reason:
        limit = _limit(precise, number, threshold, design)
        design = next_design(design, [limit])
    claims = [
        claim for claim in claims_of(case, threshold, limit) if claim.quantity in ("a90/95", "a90")
    ]
    reached = Claim("precision reached", np.nan, design.is_reached, design.boards)
    return [*claims, reached]


def _limit(
    precise: PreciseCase, number: int, threshold: RateThreshold, design: BoardDesign
) -> SetUpLimit:
    """Return the limit of a study's boards so far; each board has random numbers of its own."""
    case = precise.case
    sizes_mm = []
    above_mm = []
    for board in range(design.boards):
        random = random_stream(0, "audit", precise.name, number, board)
        own_sizes_mm = _sizes_mm(case, design, board, random)
        shift_mm = case.shift_mm * random.standard_normal()
        luck_mm = case.width_mm * random.logistic(size=case.holes)
        sizes_mm.append(own_sizes_mm)
        above_mm.append(own_sizes_mm - A50_MM - shift_mm + luck_mm)
    record = recorded(
        case,
        threshold,
        size_mm=np.concatenate(sizes_mm),
        above_mm=np.concatenate(above_mm),
        calls=np.zeros(COUNTED_BOARDS, int),
    )
    return limit_of(replace(record, sizes_chosen=True), draws=DRAWS)


def _sizes_mm(
    case: StudyCase, design: BoardDesign, board: int, random: np.random.Generator
) -> np.ndarray:
    """Return the sizes (holes,) of a board: chosen, or one from each part of the range."""
    low_mm, high_mm = SIZES_MM
    parts = (np.arange(case.holes) + random.random(case.holes)) / case.holes
    chosen_mm = design.sizes_mm(board)
    if chosen_mm is None:
        return np.asarray(low_mm + (high_mm - low_mm) * parts)
    return np.array(chosen_mm)
