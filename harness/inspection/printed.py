"""What the program prints: the capture, the surface, the findings."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from detectors.interface import Evidence
    from detectors.recordings import Recording
    from detectors.views import PreparedView
    from harness.report.findings import Finding
    from harness.vocabulary.capture import Cloud


WIDEST_NATIVE_PX = 6.5
"""The widest filter of a known camera's own image averages 5 pixels; a measured reach scatters by one."""


def mm(metres: float) -> str:
    """A length in millimetres, three digits."""
    return f"{1e3 * metres:.3g} mm"


def print_frames(recording: Recording) -> None:
    """Every frame with its valid part and median distance."""
    import numpy as np

    for frame in recording.frames():
        valid = np.isfinite(frame.z_m)
        median = mm(float(np.median(frame.z_m[valid]))) if valid.any() else "none"
        print(f"frame {frame.name}: {100 * valid.mean():.1f} % valid, median distance {median}")


def print_warnings(warnings: Iterable[str]) -> None:
    """What makes the numbers below unreliable, a line each: printed before anything else."""
    for warning in warnings:
        print(f"warning: {warning}")


def print_capture(recording: Recording, cloud: Cloud, evidence: Evidence, crop: str) -> None:
    """Frames, what was left out, crop and surface, a line each."""
    import numpy as np

    _print_frames_used(recording, cloud, recording.name)
    kept = np.isfinite(evidence.residual_m)
    _print_kept(cloud, kept, crop)
    if not cloud.organised and crop == "auto" and kept.sum() < cloud.valid.sum():
        off = cloud.valid.sum() - kept.sum()
        print(f"note: {off} points lie off the target or on its rim: not judged; --crop none judges all of them")
    print(surface_text(cloud, evidence))


def print_view(recording: Recording, prepared: PreparedView, crop: str) -> None:
    """Of one of several views: frames, what was left out, crop and marks, a line each."""
    cloud, marks = prepared.view.cloud, prepared.marks
    _print_frames_used(recording, cloud, prepared.view.name)
    _print_kept(cloud, prepared.inside, crop)
    doubtful = [mark for mark in marks.marks if mark.doubt]
    doubts = f"; in doubt: {'; '.join(sorted({mark.doubt for mark in doubtful}))}" if doubtful else ""
    print(f"marks: {len(marks.trusted)} of {len(marks.marks)} to be relied on{doubts}")
    for note in (*marks.notes, *((marks.problem,) if marks.problem else ())):
        print(f"note: {note}")


def unit_range_m(evidence: Evidence) -> tuple[float, float] | None:
    """(least, greatest) length that one unit of score is at the points judged, metres; None where it is the same at
    all of them. A detector that is told how well each point is known may count in each point's own deviations."""
    import numpy as np

    known = np.isfinite(evidence.residual_m) & (evidence.score > 0)
    units = np.abs(evidence.residual_m[known]) / evidence.score[known]
    if units.size == 0 or np.ptp(units) <= 1e-6 * units.max():
        return None
    return float(units.min()), float(units.max())


def beyond_text(threshold: float, evidence: Evidence) -> str:
    """The threshold as a length, or in words where it is another length at each point."""
    if evidence.unit:
        return f"{threshold:.4g} units of score"
    if unit_range_m(evidence) is None:
        return mm(threshold * evidence.scale_m)
    return f"{threshold:.4g} of each point's own deviations"


def threshold_text(threshold: float, evidence: Evidence, origin: str) -> str:
    """The threshold, what it is in millimetres, and where it comes from."""
    if evidence.unit:
        return f"threshold: {threshold:.4g} units of score ({origin})"
    at = "" if unit_range_m(evidence) is None else " at the median point"
    return f"threshold: {threshold:.4g} x {mm(evidence.scale_m)} = {mm(threshold * evidence.scale_m)}{at} ({origin})"


def surface_text(cloud: Cloud, evidence: Evidence) -> str:
    """The surface, what a unit of score is, and one frame's noise where it is known."""
    import numpy as np

    within = cloud.variance_m2[np.isfinite(evidence.residual_m) & np.isfinite(cloud.variance_m2)]
    temporal = f"; one frame's noise {mm(float(np.sqrt(np.median(within))))}" if within.size else ""
    varied = None if evidence.unit else unit_range_m(evidence)
    unit = evidence.unit or mm(evidence.scale_m)
    own = f" at the median point, each point's own deviation: {mm(varied[0])} to {mm(varied[1])}" if varied else ""
    return f"surface: {evidence.notes.get('surface', '')}; one unit of score is {unit}{own}{temporal}"


def _print_frames_used(recording: Recording, cloud: Cloud, name: str) -> None:
    height, width = cloud.valid.shape
    size = f"{width} x {height} pixels" if cloud.organised else f"{width} points"
    print(f"{name}: {cloud.n_frames} frames averaged, {size}")
    print(recording.unit_text)
    for note in recording.notes:
        print(f"note: {note}")
    if cloud.noise_reach_px > WIDEST_NATIVE_PX:
        print(
            f"note: {cloud.noise_reach_px:.0f} pixels share their noise: the depth was upsampled, aligned to"
            " another camera or smoothed; sizes are taken with a blur of that many pixels"
        )
    for left in cloud.left_out:
        print(f"left out: {left.name}: {left.why}")


def _print_kept(cloud: Cloud, kept: np.ndarray, crop: str) -> None:
    rows, columns = kept.nonzero()
    where = (
        f", columns {columns.min()} to {columns.max()}, rows {rows.min()} to {rows.max()}" if cloud.organised else ""
    )
    print(f"crop: {crop} keeps {kept.sum()} of {cloud.valid.sum()} valid points{where}")


def print_findings(findings: Sequence[Finding], grid: str = "px") -> None:
    """The findings, strongest first. ``grid``: what u and v count."""
    if not findings:
        print("no findings")
        return
    titles = (
        "id",
        "kind",
        f"u {grid}",
        f"v {grid}",
        "x mm",
        "y mm",
        "z mm",
        "diam. mm",
        "from",
        "depth mm",
        "vol. mm3",
        "points",
        "score",
    )
    print_table(titles, [_cells(finding) for finding in findings])


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """A table on a terminal that is wide enough for it, plain columns elsewhere."""
    widths = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    if sys.stdout.isatty():
        from rich.box import SIMPLE_HEAD
        from rich.console import Console
        from rich.table import Table

        console = Console()
        if sum(widths) + 2 * len(widths) <= console.width:
            table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
            for title, width in zip(titles, widths, strict=True):
                table.add_column(title, justify="right", no_wrap=True, min_width=width)
            for row in rows:
                table.add_row(*row)
            console.print(table)
            return
    for row in (titles, *rows):
        print("  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)))


def _cells(f: Finding) -> tuple[str, ...]:
    numbers = (f.u_px, f.v_px, f.x_mm, f.y_mm, f.z_mm, f.diameter_mm)
    start = [str(f.id), f.kind, *(number(n, 1) for n in numbers), f.size_from]
    return (*start, number(f.depth_mm, 2), number(f.volume_mm3, 1), str(f.points), number(f.score, 2))


def number(value: float, digits: int) -> str:
    """A number with so many decimals, a dash for none."""
    return "-" if value != value else f"{value:.{digits}f}"
