"""Studies with a stated precision: damaged boards come in batches until the 95 % interval of a90
of every set-up is narrow enough.

The sizes of the first boards are drawn over the whole range. Each later size is the one that
narrows most the interval that would then be the widest of all set-ups; so all set-ups inspect the
same boards, which serve those that need them (`harness.evaluation.study.next_sizes`).

An interval that is narrow by chance belongs to a curve that is too steep, and so to an a90 that is
too small; therefore no study ends with its first boards. ``tofpod audit`` measures how often what
such studies state covers the truth. Not modelled: what the threshold's own error leaves open,
which no damaged board makes smaller, so that a study may end at its largest number of boards."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.next_sizes import ExpectedWidth, candidates_mm, even_candidate
from harness.evaluation.study.record import BoardDesign

FIRST_BOARDS = 6
"""Boards with sizes over the whole range: with eight damages each, their 48 sizes show a curve that
rises within a tenth of the range."""
LEAST_BATCH = 4  # boards: two for each core of a small machine
LEAST_GROWTH = 0.2  # smallest batch over the boards before it: each look may end a study by chance
MOST_GROWTH = 0.5  # largest batch over the boards before it: the sizes after it are better ones
PATIENCE = 12  # boards after which a set-up without a curve is waited for no longer


def first_design(
    *,
    damage: str,
    range_mm: tuple[float, float],
    per_board: int,
    most_boards: int,
    a90_mm: float | None,
    a90_percent: float | None,
) -> BoardDesign:
    """Return the first boards of a study; the arguments as the fields of `BoardDesign`."""
    return BoardDesign(
        damage=damage,
        range_mm=range_mm,
        per_board=per_board,
        most_boards=most_boards,
        uniform_boards=FIRST_BOARDS,
        a90_mm=a90_mm,
        a90_percent=a90_percent,
    )


def next_design(design: BoardDesign, limits: Sequence[SetUpLimit]) -> BoardDesign:
    """Return the design with a further batch of boards, or with the reason why there is none.

    ``limits``: of all set-ups that inspect these boards, from all boards so far."""
    if not limits:
        return replace(design, reason="no damaged board was judged")
    with_curve = [limit for limit in limits if limit.statement is not None]
    without_curve = [limit for limit in limits if limit.statement is None]
    wide = [limit for limit in with_curve if _excess(design, limit) > 1]
    is_waiting = bool(without_curve) and design.boards < PATIENCE
    is_first = not design.chosen_mm
    if not (wide or is_waiting or is_first):
        return _ended(design, without_curve)
    if design.boards >= design.most_boards:
        return _ended_at_most(design, wide, without_curve)
    chosen_mm = _batch_mm(design, wide or with_curve, without_curve if is_waiting else ())
    return replace(design, chosen_mm=design.chosen_mm + chosen_mm)


def _excess(design: BoardDesign, limit: SetUpLimit) -> float:
    """Return the width of the interval of a90 over the wanted one; infinite if it has no ends."""
    if design.a90_mm is not None:
        wanted_mm = design.a90_mm
    else:
        wanted_mm = (design.a90_percent or 0.0) / 100 * limit.a90_mm
    interval = limit.a90_interval_mm
    excess = (interval.high - interval.low) / wanted_mm
    return float(excess) if np.isfinite(excess) else np.inf


def _ended(design: BoardDesign, without_curve: Sequence[SetUpLimit]) -> BoardDesign:
    """Return the design of a study for which more boards can do nothing."""
    if without_curve:
        return replace(design, reason=_no_curve(without_curve))
    reason = f"every interval of a90 is at most {design.wanted} wide"
    return replace(design, reason=reason, is_reached=True)


def _ended_at_most(
    design: BoardDesign, wide: Sequence[SetUpLimit], without_curve: Sequence[SetUpLimit]
) -> BoardDesign:
    """Return the design of a study that has reached its largest number of boards."""
    used = f"all {design.most_boards} boards that are allowed were used"
    if not wide:
        return replace(design, reason=f"{used}; {_no_curve(without_curve)}")
    worst = max(wide, key=lambda limit: _excess(design, limit))
    interval = worst.a90_interval_mm
    widest = f"a90 of {worst.record.label} is {interval.low:.3g} to {interval.high:.3g} mm"
    return replace(design, reason=f"{used}; {widest}")


def _no_curve(without_curve: Sequence[SetUpLimit]) -> str:
    """Return why there is no curve."""
    first = without_curve[0]
    outcome = "all damages were found" if first.is_at_most else first.why
    suffix = f" and {len(without_curve) - 1} more" if len(without_curve) > 1 else ""
    return f"{first.record.label}{suffix} has no curve: {outcome}"


def _batch_mm(
    design: BoardDesign, with_curve: Sequence[SetUpLimit], without_curve: Sequence[SetUpLimit]
) -> tuple[tuple[float, ...], ...]:
    """Choose the sizes of a batch: as many boards as are expected to make the intervals of the
    set-ups with a curve narrow enough, within bounds."""
    widths = []
    for limit in with_curve:
        widths.append(ExpectedWidth(limit, design.range_mm, _excess(design, limit)))
    least = max(LEAST_BATCH, int(LEAST_GROWTH * design.boards))
    growth = max(least, int(MOST_GROWTH * design.boards))
    most = min(growth, design.most_boards - design.boards)
    boards = 0
    chosen: list[int] = []
    while boards < most and (boards < least or any(width.excess > 1 for width in widths)):
        for hole in range(design.per_board):
            number = (design.boards + boards) * design.per_board + hole
            chosen.append(_next_candidate(widths, len(without_curve), number))
        boards += 1
    # each board gets sizes for all set-ups, so that its luck counts as little as can be in each
    sizes_mm = candidates_mm(design.range_mm)[np.sort(chosen)].tolist()
    return tuple(tuple(sizes_mm[board::boards]) for board in range(boards))


def _next_candidate(widths: Sequence[ExpectedWidth], without_curve: int, number: int) -> int:
    """Choose the size of damage ``number`` and add it to the expected ``widths``. Set-ups without
    a curve get sizes over the whole range, each in its turn."""
    turns = without_curve + bool(widths)
    if number % turns < without_curve:
        candidate = even_candidate(number)
    else:
        candidate = max(widths, key=lambda width: width.excess).best()
    for width in widths:
        width.add(candidate)
    return candidate
