"""Studies with a stated precision: damaged boards come in batches until the 95 % interval of a90
of every set-up is narrow enough.

The sizes of the first boards are drawn over the whole range. A third of those of each later batch
lies in the inner half of the interval of a50 and two thirds in that of a90, in turn of each set-up
whose interval is still too wide; so all set-ups inspect the same boards, and an uncertain curve
gets spread sizes. (With a known curve a tenth at a50 would do best: these thirds give 2.2 to 3.6
times the information on a90 of sizes over seven times the distance from a50 to a90, a tenth and
nine tenths 3.0 to 4.9 times, but one link's a90 alone.)

An interval that is narrow by chance belongs to a curve that is too steep, and so to an a90 that is
too small; therefore no study ends with its first boards. ``tofpod audit`` measures how often what
such studies state covers the truth. Not modelled: what the threshold's own error leaves open,
which no damaged board makes smaller, so that a study may end at its largest number of boards."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import BoardDesign

FIRST_BOARDS = 6
"""Boards with sizes over the whole range: with eight damages each, their 48 sizes show a curve that
rises within a tenth of the range."""
LEAST_BATCH = 4  # boards: two for each core of a small machine
MOST_GROWTH = 0.5  # largest batch over the boards before it: the sizes after it are better ones
PATIENCE = 12  # boards after which a set-up without a curve is waited for no longer
LEVELS = ("a50", "a90", "a90")  # sizes about these in turn
DECIMALS = 3  # sizes are rounded to micrometres: no board hangs on the last digit of an interval


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
    served = [*wide, *without_curve] if is_waiting else wide
    chosen_mm = _batch_mm(design, served or with_curve)
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


def _batch_mm(design: BoardDesign, served: Sequence[SetUpLimit]) -> tuple[tuple[float, ...], ...]:
    """Choose the sizes of a batch of boards, in turn for each set-up and each of `LEVELS`."""
    boards = _batch(design, served)
    first = design.boards * design.per_board
    sizes_mm = []
    for number in range(first, first + boards * design.per_board):
        turn, level = divmod(number, len(LEVELS))
        limit = served[turn % len(served)]
        sizes_mm.append(_size_mm(design, limit, LEVELS[level], number))
    by_board = np.sort(np.reshape(sizes_mm, (boards, design.per_board)), axis=1)
    return tuple(tuple(row) for row in by_board.tolist())


def _batch(design: BoardDesign, served: Sequence[SetUpLimit]) -> int:
    """Return the number of boards of a batch: as many as an interval needs whose width falls with
    the root of the boards, within bounds."""
    needed = design.boards * max(_excess(design, limit) for limit in served) ** 2
    most = min(design.boards * (1 + MOST_GROWTH), design.most_boards)
    boards = ceil(min(needed, most)) - design.boards
    return min(max(boards, LEAST_BATCH), design.most_boards - design.boards)


def _size_mm(design: BoardDesign, limit: SetUpLimit, level: str, number: int) -> float:
    """Return a size in the inner half of the interval of a level; in the whole range if there is
    no curve."""
    low_mm, high_mm = design.range_mm
    interval = limit.a90_interval_mm if level == "a90" else limit.a50_interval_mm
    if limit.statement is not None and interval.known:
        estimate_mm = limit.a90_mm if level == "a90" else limit.a50_mm
        ends_mm = np.clip([interval.low, estimate_mm, interval.high], low_mm, high_mm)
        low_mm, high_mm = ((ends_mm[:-1] + ends_mm[1:]) / 2).tolist()
    size_mm = low_mm + (high_mm - low_mm) * _even(number)
    return float(np.clip(round(size_mm, DECIMALS), *design.range_mm))


def _even(number: int) -> float:
    """Return a number from 0 to 1; each run of consecutive ones is spread evenly, also every third
    (multiples of the golden section; Weyl 1916)."""
    golden = (np.sqrt(5.0) - 1.0) / 2.0
    return float((number * golden) % 1.0)
