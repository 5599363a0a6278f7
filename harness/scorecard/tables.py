"""The scorecard as rows: for the terminal, for CSV, for the page."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.evaluation.intervals import Interval
from harness.scorecard.curves import CurvePoint
from harness.scorecard.estimate import Estimate
from harness.scorecard.judge import Score
from harness.scorecard.quantities import QUANTITIES
from harness.scorecard.run import Request
from harness.vocabulary.versions import RESULTS_VERSION

CONDITION_COLUMNS = (
    "distance_m",
    "albedo",
    "angle_deg",
    "lag_x_px",
    "lag_y_px",
    "step_mm",
    "across",
    "shadow",
    "diameter_px",
    "multipath",
)
HEADS = ("camera", "figure", "simulated", "95 % interval", "published", "tolerance", "unit", "verdict", "use", "source")


def number(value: float) -> str:
    """Three significant digits; ``none`` where there is no value."""
    if np.isnan(value):
        return "none"
    if np.isinf(value):
        return "none survives" if value > 0 else "-inf"
    if 0.0995 <= abs(value) < 99.95:
        return f"{value:#.3g}"
    return f"{value:.3g}" if abs(value) >= 99.95 or value == 0 else f"{value:.2g}"


def interval(between: Interval) -> str:
    """``0.87 to 0.90``, or a dash where unknown."""
    if not between.known:
        return "–"
    return f"{number(between.low)} to {number(between.high) if np.isfinite(between.high) else 'inf'}"


def score_cells(score: Score) -> tuple[str, ...]:
    """One figure as texts under `HEADS`."""
    entry = score.figure.entry
    tolerance = entry.published.tolerance
    return (
        entry.camera,
        score.figure.what(),
        number(score.simulated.value),
        interval(score.simulated.interval),
        entry.published.in_words(),
        f"±{tolerance:g}" if tolerance else "–",
        score.figure.quantity.unit or "–",
        score.verdict,
        "calibration" if entry.calibration else "test",
        f"[{entry.tag}] {entry.source}",
    )


def plain_table(scores: Sequence[Score]) -> str:
    """The scorecard as aligned lines without colour, one a figure."""
    rows = [HEADS, *(score_cells(score) for score in scores)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADS))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def print_scorecard(scores: Sequence[Score]) -> None:
    """The table: in colour and wrapped on a terminal, plain lines elsewhere."""
    import sys

    if not sys.stdout.isatty():
        print(plain_table(scores))
        return
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for head in HEADS:
        table.add_column(head, justify="right" if head in ("simulated", "published", "tolerance") else "left")
    for score in scores:
        colour = "green" if score.passes else "bold red" if score.regressed else "yellow"
        table.add_row(*(Text(cell, style=colour if cell == score.verdict else "") for cell in score_cells(score)))
    Console().print(table)


def scores_csv(scores: Sequence[Score]) -> str:
    """The scorecard as CSV with numbers at full precision."""
    rows = []
    for score in scores:
        entry, published = score.figure.entry, score.figure.entry.published
        low, high = published.limits
        rows.append(
            {
                "name": entry.name,
                "camera": entry.camera,
                "quantity": entry.quantity,
                "unit": score.figure.quantity.unit,
                **_conditions(score.figure.conditions.to_data()),
                **_estimate(score.simulated),
                "published": published.in_words(),
                "tolerance": published.tolerance,
                "passes_from": low,
                "passes_to": high,
                "verdict": score.verdict,
                "passed_before": score.passed_before,
                "calibration": entry.calibration,
                "tag": entry.tag,
                "source": entry.source,
                "note": entry.note,
            }
        )
    return _csv(rows)


def curves_csv(cameras: Sequence[str], points: Sequence[CurvePoint], found: Mapping[Request, Estimate]) -> str:
    """Every point of every curve of every camera."""
    rows = [
        {
            "curve": point.curve,
            "camera": camera,
            "quantity": point.quantity,
            "unit": QUANTITIES[point.quantity].unit,
            **_conditions(point.conditions.to_data()),
            **_estimate(found[Request(camera, point.quantity, point.conditions)]),
        }
        for camera in cameras
        for point in points
    ]
    return _csv(rows)


def _conditions(data: Mapping[str, Any]) -> dict[str, Any]:
    return {column: data.get(column) for column in CONDITION_COLUMNS}


def _estimate(estimate: Estimate) -> dict[str, float]:
    return {"simulated": estimate.value, "low": estimate.interval.low, "high": estimate.interval.high}


def _csv(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows with equal keys, and the version, as CSV text; NaN and None are empty cells, floats have nine digits."""
    listed = [{**row, "results_version": RESULTS_VERSION} for row in rows]
    if not listed:
        return ""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, fieldnames=list(listed[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _cell(value) for key, value in row.items()} for row in listed)
    return buffer.getvalue()


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)
