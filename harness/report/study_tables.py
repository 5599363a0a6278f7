"""Rows of the tables on a study's page, as text; the table of limits is in `harness.report.study_rows`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from harness.evaluation.intervals import Interval
from harness.evaluation.pod.false_calls import FalseCallRate
from harness.evaluation.pod.statement import CONFIDENCE, PodStatement
from harness.evaluation.study.chance import ChanceHits
from harness.evaluation.study.curves import PRO_LIMIT
from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import Calibrated, StudyRecord, Unflawed
from harness.evaluation.study.result import SetUpResult
from harness.report.page_parts import mm
from harness.report.study_rows import bound_text, mm_text, name_of, percent_text, unmeasured, with_interval

CHANCE_HEADS = (
    "set-up",
    "shuffled positions (95 %)",
    "unflawed places (95 %)",
    "places",
    "from the rate",
    "curve at the smallest size",
)
THRESHOLD_HEADS = (
    "set-up",
    "threshold",
    "in mm",
    "calibration runs",
    "false calls on other boards",
    "per m² (95 %)",
    "over boards (95 %)",
)
SET_BY_HEADS = ("set-up", "threshold (deviations)", "board", "x, y on it (mm)", "of the runs", "highest of all")
HIGH_THRESHOLD = 10.0
"""Deviations: of a hole-free board's 30,000 pixels the highest is 4 with Gaussian noise, and 5 to 6 with the fixed
pattern that an Azure Kinect's average of 50 frames keeps."""
SIGNAL_HEADS = ("set-up", "signals", "model", "a50 (mm)", "a90 (mm)", "a90/95 (mm)", "from hits: a90/95 (mm)")
OPERATING_HEADS = ("set-up", "sizes", "damages", "places", "ROC's area (95 %)", "AU-PRO (95 %)", "pixels' ROC's area")

OFF_BOARD = "off the board"
Rows = Sequence[tuple[str, ...]]


def chance_rows(results: Sequence[SetUpResult]) -> Rows:
    """How often damage would be hit by chance, beside the curve at the smallest size inspected."""
    return [_chance(result.limit, result.chance) for result in results if result.chance is not None]


def threshold_rows(limits: Sequence[SetUpLimit]) -> Rows:
    """Each threshold, what set it, and the false calls it then had on other boards."""
    rows = []
    for limit in limits:
        record, calls = limit.record, limit.false_calls
        over = limit.false_calls_interval_per_m2
        rows.append(
            (
                name_of(limit),
                f"{record.threshold:.3g}",
                mm(record.threshold_mm),
                str(record.calibration_runs) if record.calibration_runs else "none: given",
                "–" if calls is None else _counted(calls) + _unseen(record.unflawed),
                "–" if calls is None else with_interval(calls.rate_per_m2, calls.interval_per_m2),
                f"{over.low:.2f} to {over.high:.2f}" if over.known else "–",
            )
        )
    return rows


def set_by_rows(limits: Sequence[SetUpLimit]) -> Rows:
    """The hole-free finding that set each threshold: its board, its place, its rank among those of all runs."""
    rows = []
    for limit in limits:
        runs = limit.record.calibrated
        if runs is None:
            continue
        at = _set_by(runs, limit.record.threshold)
        higher = int((runs.score > runs.score[at]).sum())
        rows.append(
            (
                name_of(limit),
                f"{limit.record.threshold:.3g}",
                str(int(runs.board[at])),
                _place(runs.x_mm[at], runs.y_mm[at]),
                f"{'highest' if not higher else f'number {higher + 1}'} of {len(runs.score)}",
                f"{runs.score.max():.3g} on board {int(runs.board[runs.score.argmax()])}",
            )
        )
    return rows


def threshold_warnings(limits: Sequence[SetUpLimit]) -> list[str]:
    """A sentence for each calibrated threshold that is too high for noise to have set it."""
    said = []
    for limit in limits:
        runs, threshold = limit.record.calibrated, limit.record.threshold
        if runs is None or not threshold > HIGH_THRESHOLD:
            continue
        at = _set_by(runs, threshold)
        place = _place(runs.x_mm[at], runs.y_mm[at])
        where = "off the board" if place == OFF_BOARD else f"at x, y = {place} mm"
        said.append(
            f"{limit.record.label}: the threshold is {threshold:.3g} deviations, above {HIGH_THRESHOLD:g}: something "
            f"other than noise sets it (calibration board {int(runs.board[at])}, {where}), and the limit is that of it"
        )
    return said


def _set_by(runs: Calibrated, threshold: float) -> int:
    return int(np.abs(runs.score - threshold).argmin())


def _place(x_mm: float, y_mm: float) -> str:
    if not np.isfinite(x_mm):
        return OFF_BOARD
    return f"{x_mm:.0f}, {y_mm:.0f}".replace("-", "−")


def signal_rows(limits: Sequence[SetUpLimit]) -> Rows:
    """The regression's limits beside those from hits."""
    return [
        (
            name_of(limit),
            str(len(limit.signals.size)),
            limit.signals.model,
            mm_text(limit.signals.a50, limit.largest_mm),
            mm_text(limit.signals.a90, limit.largest_mm),
            bound_text(limit.signals.bound, limit.largest_mm),
            bound_text(limit.a90_95, limit.largest_mm),
        )
        for limit in limits
        if limit.signals is not None
    ]


def signal_tests(limits: Sequence[SetUpLimit]) -> tuple[tuple[str, ...], Rows]:
    """(heads, rows) of the p-values of what a regression takes for granted; those that speak against it are marked."""
    tested = {name_of(limit): dict(_tests(limit.signals)) for limit in limits if limit.signals is not None}
    names = tuple(dict.fromkeys(name for tests in tested.values() for name in tests))
    rows = [(label, *(tests.get(name, "–") for name in names)) for label, tests in tested.items()]
    return ("set-up", *names), rows if names else []


def signal_notes(limits: Sequence[SetUpLimit]) -> list[str]:
    """Why a set-up has no regression, and what to know of one that it has."""
    notes = [f"{name_of(limit)}: no regression: {limit.signals_why}" for limit in limits if limit.signals is None]
    for limit in limits:
        of_fit = () if limit.signals is None else limit.signals.notes
        said = [unmeasured(note) for note in of_fit]
        notes += [f"{name_of(limit)}: {'; '.join(said)}"] if said else []
    return notes


def operating_rows(results: Sequence[SetUpResult]) -> Rows:
    """Areas under the curves, by classes of size; those of pixels stand in a set-up's first row."""
    rows: list[tuple[str, ...]] = []
    for result in results:
        pixels = result.pixels
        of_pixels = (
            ("–", "–")
            if pixels is None
            else (
                _share(pixels.pro, pixels.pro_interval),
                _share(pixels.auroc, pixels.auroc_interval),
            )
        )
        name = name_of(result.limit)
        if not result.roc:
            rows.append((name, "–", "–", "–", "–", *of_pixels))
        for number, curve in enumerate(result.roc):
            area = _share(curve.area, curve.area_interval)
            first = number == 0
            counts = (str(curve.damages), str(curve.unflawed))
            rows.append((name if first else "", curve.name, *counts, area, *(of_pixels if first else ("", ""))))
    return rows


def operating_notes(results: Sequence[SetUpResult]) -> list[str]:
    """What the areas are, and which of them could not be had."""
    notes = [
        f"AU-PRO: mean over damages of the share of pixels above, against undamaged pixels above, up to a share of "
        f"{PRO_LIMIT:g} and divided by it, as MVTec AD does; judged pixels of damaged boards. Intervals over boards."
    ]
    for result in results:
        if result.pixels is not None and result.pixels.why:
            notes.append(f"{name_of(result.limit)}: no AU-PRO: {result.pixels.why}.")
    return notes


def threshold_note(record: StudyRecord) -> str:
    """How thresholds came about."""
    if record.false_calls_per_m2 is None:
        return "Thresholds were given, not calibrated: the rates beside them are what came of it."
    wanted = record.false_calls_per_m2
    return (
        f"Calibrated to {wanted:g} false call{'' if wanted == 1 else 's'} per m² on hole-free boards of their own, "
        "never on those that are judged: of the highest scores of their runs the lowest that, by order statistics "
        "(Wilks 1941), keeps to that rate. A threshold is itself an estimate: the rate on other boards scatters about "
        "the wanted one."
    )


def _counted(calls: FalseCallRate) -> str:
    return f"{calls.calls} call{'' if calls.calls == 1 else 's'} on {calls.area_m2:.3g} m²"


def _unseen(unflawed: Unflawed) -> str:
    """False calls without return among those counted."""
    return "" if unflawed.no_return_calls is None else f", {int(unflawed.no_return_calls.sum())} without return"


def _tests(statement: PodStatement) -> list[tuple[str, str]]:
    doubtful = 1 - CONFIDENCE
    return [(what, f"{p:.2g}{' *' if p < doubtful else ''}") for what, p, _ in statement.tests]


def _chance(limit: SetUpLimit, chance: ChanceHits) -> tuple[str, ...]:
    statement = limit.statement
    least = None if statement is None else float(statement.curve.pod(np.array(statement.size.min())))
    return (
        name_of(limit),
        _per_cent(chance.probability, chance.interval),
        _per_cent(chance.of_sites, chance.sites_interval),
        str(chance.sites),
        _per_cent(chance.expected, Interval(np.nan, np.nan)),
        "–" if least is None or statement is None else f"{percent_text(least)} % at {statement.size.min():.2f} mm",
    )


def _per_cent(share: float, interval: Interval) -> str:
    if np.isnan(share):
        return "–"
    return f"{100 * share:.2g} %" + (
        f" ({100 * interval.low:.2g} to {100 * interval.high:.2g} %)" if interval.known else ""
    )


def _share(value: float, interval: Interval) -> str:
    return "–" if np.isnan(value) else with_interval(value, interval, 3)
