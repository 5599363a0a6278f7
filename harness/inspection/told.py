"""The results as text on the terminal and as facts for the JSON: captures, targets, registrations and findings."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.vocabulary.units import MM

if TYPE_CHECKING:
    from detectors.interface import Evidence
    from detectors.mapping.merge import Mapped
    from detectors.recordings import Recording
    from detectors.registration.register import LoopError
    from detectors.target import Choice
    from detectors.views import PreparedView
    from harness.report.findings import Finding
    from harness.vocabulary.capture import Cloud

WIDEST_NATIVE_PX = 6.5
"""The widest filter of a known camera's own image averages 5 pixels; a measured reach scatters by one."""


def mm(metres: float) -> str:
    """Return a length in millimetres with three digits."""
    return f"{1e3 * metres:.3g} mm"


def number(value: float | None, digits: int) -> str:
    """Return a number with ``digits`` decimals, a dash for none."""
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def print_warnings(warnings: Iterable[str]) -> None:
    """Print a line for each reason why the numbers below are unreliable, before anything else."""
    for warning in warnings:
        print(f"warning: {warning}")


# ---- captures --------------------------------------------------------------------------------------------------------


def print_frames(recording: Recording) -> None:
    """Print every frame with its valid part and median distance."""
    for frame in recording.frames():
        valid = np.isfinite(frame.z_m)
        median = mm(float(np.median(frame.z_m[valid]))) if valid.any() else "none"
        print(f"frame {frame.name}: {100 * valid.mean():.1f} % valid, median distance {median}")


def print_capture(recording: Recording, cloud: Cloud, name: str, kept: np.ndarray, crop: str) -> None:
    """Print the frames, those left out, and the points that the crop keeps (``kept``, of the cloud), a line each."""
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
    rows, columns = kept.nonzero()
    where = (
        f", columns {columns.min()} to {columns.max()}, rows {rows.min()} to {rows.max()}" if cloud.organised else ""
    )
    print(f"crop: {crop} keeps {kept.sum()} of {cloud.valid.sum()} valid points{where}")


def print_marks(prepared: PreparedView) -> None:
    """Print how many of a view's marks are reliable, and why others are not."""
    marks = prepared.marks
    doubts = "; ".join(sorted({mark.doubt for mark in marks.marks if mark.doubt}))
    in_doubt = f"; in doubt: {doubts}" if doubts else ""
    print(f"marks: {len(marks.trusted)} of {len(marks.marks)} to be relied on{in_doubt}")
    for note in (*marks.notes, *((marks.problem,) if marks.problem else ())):
        print(f"note: {note}")


def capture_facts(recording: Recording, cloud: Cloud) -> dict[str, Any]:
    """Return a capture's facts for the JSON."""
    return {
        "name": recording.name,
        "frames_used": cloud.n_frames,
        "frames_left_out": [asdict(left) for left in cloud.left_out],
        "lens": asdict(cloud.lens) if cloud.lens else None,
        "noise_reach_px": cloud.noise_reach_px or None,
        "depth_unit": {"mm": 1e3 * recording.scale_m, "from": recording.unit_from},
        "rounding_step_mm": 1e3 * cloud.z_step_m,
        "notes": recording.notes,
        "warnings": recording.warnings,
    }


# ---- the target that the automatic crop took -------------------------------------------------------------------------


def choice_by(settings: object, cloud: Cloud) -> Choice | None:
    """Return the choice of the automatic crop among a detector's or a mapping's settings; None where they have another
    crop, or none. Raises UserError as the crop does."""
    from detectors.crop import AutoCrop, choice_of

    config = getattr(settings, "crop", None)
    if not isinstance(config, AutoCrop) or not cloud.valid.any():
        return None
    return choice_of(cloud, config)


def print_choice(choice: Choice | None) -> None:
    """Print the surface that was taken, and a line for each other candidate, with the option that takes it."""
    from detectors.target import described_text

    numbered = list(enumerate(choice.candidates, start=1)) if choice is not None else []
    for n, candidate in numbered:
        if choice is not None and n == choice.taken:
            print(f"target {n} of {len(numbered)}: {described_text(candidate)}")
    for n, candidate in numbered:
        if choice is not None and n != choice.taken:
            print(f"  instead, with --target {n}: {described_text(candidate)}")


def choice_facts(choice: Choice | None) -> dict[str, Any] | None:
    """Return the choice's facts for the JSON; None where there was none."""
    if choice is None:
        return None
    candidates = [
        {
            "number": n,
            "distance_mm": each.distance_m / MM,
            "nearest_mm": each.nearest_m / MM,
            "farthest_mm": each.farthest_m / MM,
            "extent_mm": [side / MM for side in each.extent_m],
            "share_of_view": each.share,
            "tilt_deg": each.tilt_deg,
            "pixels": each.pixels,
        }
        for n, each in enumerate(choice.candidates, start=1)
    ]
    return {"taken": choice.taken, "warnings": choice.warnings, "candidates": candidates}


def pictures(choice: Choice | None, name: str = "targets.png") -> dict[str, Callable[[Path], object]]:
    """Return the writer of the candidates' numbered picture by its name, for `report.findings.write_findings`."""
    from detectors.target import described_text
    from harness.report.targets_picture import save_targets

    if choice is None or not choice.candidates:
        return {}
    outlines = [candidate.outline for candidate in choice.candidates]
    texts = [described_text(candidate) for candidate in choice.candidates]
    return {name: lambda path: save_targets(path, choice.grid, outlines, texts, choice.taken)}


# ---- registrations ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Checks:
    """``held_out_m``: for each view the root mean square miss of a mark that the registration did not use, None where
    there are too few marks. ``predicted_m``: (in the plane, across it) over the target. ``loops``: of three views."""

    held_out_m: tuple[float | None, ...]
    predicted_m: tuple[tuple[float, float], ...]
    loops: tuple[LoopError, ...]


def print_registrations(mapped: Mapped, checks: Checks) -> None:
    """Print a table with a view a line, then notes, loops and held-out marks."""
    titles = (
        "view", "method", "residual mm", "overlap %", "in plane mm", "across mm", "held out mm", "pairs", "steps", "s",
    )  # fmt: skip
    rows = []
    for each, predicted_m, held_m in zip(mapped.registrations, checks.predicted_m, checks.held_out_m, strict=True):
        predicted = [number(error_m / MM, 3) for error_m in predicted_m]
        fit = (number(each.residual_m / MM, 3), number(100 * each.overlap, 0), *predicted)
        held = number(None if held_m is None else held_m / MM, 3)
        counts = (str(each.pairs), str(each.iterations), number(each.seconds, 3))
        rows.append((each.view, each.method, *fit, held, *counts))
    print("registration to the first view (in plane, across: predicted root mean square error over the target)")
    print_table(titles, rows)
    for each in mapped.registrations:
        for note in each.notes:
            print(f"note: {each.view}: {note}")
    closed = [loop for loop in checks.loops if not loop.failure]
    if closed:
        worst = max(closed, key=lambda loop: loop.translation_m)
        print(
            f"loops: {len(closed)} of three views; the worst, {' - '.join(worst.views)}, ends"
            f" {mm(worst.translation_m)} and {worst.rotation_deg:.3f} degrees from where it began"
        )
    for loop in checks.loops:
        if loop.failure:
            print(f"note: the loop {' - '.join(loop.views)} is open: {loop.failure}")


def registration_rows(mapped: Mapped, checks: Checks) -> dict[str, Any]:
    """Return the same as plain data, with the transforms: metres in matrices, millimetres elsewhere."""
    rows = [
        {
            "view": each.view,
            "method": each.method,
            "T_reference_view": each.T_reference_view.tolist(),
            "covariance": each.covariance.tolist(),
            "covariance_about_mm": (each.centre_m / MM).tolist(),
            "residual_mm": each.residual_m / MM,
            "overlap": each.overlap,
            "predicted_in_plane_mm": in_plane / MM,
            "predicted_across_mm": across / MM,
            "held_out_mark_mm": None if held_out is None else held_out / MM,
            "marks": len(view.marks.trusted),
            "marks_doubtful": len(view.marks.marks) - len(view.marks.trusted),
            "pairs": each.pairs,
            "iterations": each.iterations,
            "converged": each.converged,
            "seconds": round(each.seconds, 4),
            "notes": each.notes,
        }
        for view, each, (in_plane, across), held_out in zip(
            mapped.views, mapped.registrations, checks.predicted_m, checks.held_out_m, strict=True
        )
    ]
    loops = [
        {
            "views": loop.views,
            "rotation_deg": loop.rotation_deg,
            "translation_mm": loop.translation_m / MM,
            "failure": loop.failure,
        }
        for loop in checks.loops
    ]
    return {
        "reference": mapped.views[0].view.name,
        "frames": {
            "T_reference_view": "from a view's camera to the first view's camera (x right, y down, z away), metres",
            "T_reference_cloud": "from the merged cloud's frame to the first view's camera, metres",
            "covariance": "of the error of T_reference_view: turn about covariance_about_mm, rad, then shift, metres,"
            " both in the first view's frame",
        },
        "T_reference_cloud": np.asarray(mapped.merged.T_reference_cloud).tolist(),
        "merge_seconds": round(mapped.merged.seconds, 4),
        "views": rows,
        "loops": loops,
    }


# ---- surface, threshold and findings ---------------------------------------------------------------------------------


def unit_range_m(evidence: Evidence) -> tuple[float, float] | None:
    """Return (least, greatest) length that one unit of score is at the points judged, metres; None where it is the same
    at all of them. A detector that is told how well each point is known may count in each point's own deviations."""
    known = np.isfinite(evidence.residual_m) & (evidence.score > 0)
    units = np.abs(evidence.residual_m[known]) / evidence.score[known]
    if units.size == 0 or np.ptp(units) <= 1e-6 * units.max():
        return None
    return float(units.min()), float(units.max())


def beyond_text(threshold: float, evidence: Evidence) -> str:
    """Return the threshold as a length, or in words where it is another length at each point."""
    if evidence.unit:
        return f"{threshold:.4g} units of score"
    if unit_range_m(evidence) is None:
        return mm(threshold * evidence.scale_m)
    return f"{threshold:.4g} of each point's own deviations"


def threshold_text(threshold: float, evidence: Evidence, origin: str) -> str:
    """Return a line with the threshold, its value in millimetres, and its origin."""
    if evidence.unit:
        return f"threshold: {threshold:.4g} units of score ({origin})"
    at = "" if unit_range_m(evidence) is None else " at the median point"
    return f"threshold: {threshold:.4g} x {mm(evidence.scale_m)} = {mm(threshold * evidence.scale_m)}{at} ({origin})"


def surface_text(cloud: Cloud, evidence: Evidence) -> str:
    """Return a line with the surface, the unit of score, and one frame's noise where it is known."""
    within = cloud.variance_m2[np.isfinite(evidence.residual_m) & np.isfinite(cloud.variance_m2)]
    temporal = f"; one frame's noise {mm(float(np.sqrt(np.median(within))))}" if within.size else ""
    varied = None if evidence.unit else unit_range_m(evidence)
    unit = evidence.unit or mm(evidence.scale_m)
    own = f" at the median point, each point's own deviation: {mm(varied[0])} to {mm(varied[1])}" if varied else ""
    return f"surface: {evidence.notes.get('surface', '')}; one unit of score is {unit}{own}{temporal}"


def print_findings(findings: Sequence[Finding], grid: str = "px") -> None:
    """Print the findings, strongest first. ``grid``: the unit of u and v."""
    if not findings:
        print("no findings")
        return
    titles = (
        *("id", "kind", f"u {grid}", f"v {grid}", "x mm", "y mm", "z mm", "diam. mm", "from"),
        *("depth mm", "vol. mm3", "points", "score"),
    )
    rows = []
    for f in findings:
        places = [number(value, 1) for value in (f.u_px, f.v_px, f.x_mm, f.y_mm, f.z_mm, f.diameter_mm)]
        sizes = (number(f.depth_mm, 2), number(f.volume_mm3, 1), str(f.points), number(f.score, 2))
        rows.append((str(f.id), f.kind, *places, f.size_from, *sizes))
    print_table(titles, rows)


def print_table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table on a terminal that is wide enough for it, plain columns elsewhere."""
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
