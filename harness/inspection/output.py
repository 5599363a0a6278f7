"""The results as text for the terminal, as facts for JSON files, and as a 3-D scene for the
browser."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.crop import AutoCrop, Choice, choice_of, described_text
from detectors.pixels.noise import WIDEST_NATIVE_PX
from harness.records.examples import Circle3d, Scene3d
from harness.report.findings import Finding, Judged, probability, save_targets
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.text import Grid, show

if TYPE_CHECKING:
    from detectors.interface import Evidence
    from detectors.recordings import Recording
    from detectors.views.mapping.merge import Mapped
    from detectors.views.view import PreparedView


def mm(metres: float) -> str:
    """Return a length in millimetres with three digits."""
    return f"{metres / MM:.3g} mm"


def number(value: float | None, digits: int) -> str:
    """Return a number with ``digits`` decimals, or a dash for None and NaN."""
    return "-" if value is None or value != value else f"{value:.{digits}f}"


def print_warnings(warnings: Iterable[str]) -> None:
    """Print one line for each reason why the numbers are unreliable, before anything else."""
    for warning in warnings:
        print(f"warning: {warning}")


def print_notes(notes: Iterable[str]) -> None:
    """Print one line for each fact that helps to interpret the numbers."""
    for note in notes:
        print(f"note: {note}")


def print_capture(
    recording: Recording, cloud: Cloud, name: str, kept: np.ndarray, crop: str
) -> None:
    """Print the frames, those left out, and the points that the crop keeps (``kept``, of the
    cloud), one per line."""
    height, width = cloud.valid.shape
    size = f"{width} x {height} pixels" if cloud.organised else f"{width} points"
    print(f"{name}: {cloud.n_frames} frame{'s' * (cloud.n_frames != 1)} averaged, {size}")
    print(recording.unit_text)
    print_notes(recording.notes)
    if cloud.noise_reach_px > WIDEST_NATIVE_PX:
        why = (
            "the depth was upsampled, aligned to another camera or smoothed; sizes are measured "
            "with that blur"
        )
        pixels = f"{cloud.noise_reach_px:.0f}"
        if cloud.noise_sides_px is not None:
            least_px = cloud.noise_sides_px.min()
            most_px = cloud.noise_sides_px.max()
            pixels = f"{least_px:.0f} to {most_px:.0f}"
            why += " at each place"
        print(f"note: {pixels} pixels share their noise: {why}")
    for left_out in cloud.left_out:
        print(f"left out: {left_out.name}: {left_out.why}")
    print(f"crop: {crop} keeps {kept.sum()} of {cloud.valid.sum()} valid points")


def print_marks(prepared: PreparedView) -> None:
    """Print how many of a view's marks are reliable, and why the others are not."""
    marks = prepared.marks
    doubts = "; ".join(sorted({mark.doubt for mark in marks.marks if mark.doubt}))
    in_doubt = f"; in doubt: {doubts}" if doubts else ""
    print(f"marks: {len(marks.trusted)} of {len(marks.marks)} are reliable{in_doubt}")
    print_notes(filter(None, (*marks.notes, marks.problem)))


def capture_facts(recording: Recording, cloud: Cloud) -> dict[str, Any]:
    """Return a capture's facts for the JSON."""
    return {
        "name": recording.name,
        "frames_used": cloud.n_frames,
        "frames_left_out": [asdict(left_out) for left_out in cloud.left_out],
        "lens": asdict(cloud.lens) if cloud.lens else None,
        "noise_reach_px": cloud.noise_reach_px or None,
        "depth_unit": {"mm": recording.scale_m / MM, "from": recording.unit_from},
        "rounding_step_mm": cloud.z_step_m / MM,
        "notes": recording.notes,
        "warnings": recording.warnings,
    }


def choice_by(settings: object, cloud: Cloud) -> Choice | None:
    """Return the automatic crop's choice by settings; None for another crop. Raises UserError as
    the crop does."""
    config = getattr(settings, "crop", None)
    return choice_of(cloud, config) if isinstance(config, AutoCrop) and cloud.valid.any() else None


def print_choice(choice: Choice | None) -> None:
    """Print the surface that was taken, and each other candidate with the option that takes it,
    one per line."""
    if choice is None or not choice.candidates:
        return
    texts = list(map(described_text, choice.candidates))
    print(f"target {choice.taken} of {len(texts)}: {texts[choice.taken - 1]}")
    for n, text in enumerate(texts, start=1):
        if n != choice.taken:
            print(f"  instead, with --target {n}: {text}")


def choice_facts(choice: Choice | None) -> dict[str, Any] | None:
    """Return the choice's facts for the JSON; None if there was none."""
    if choice is None:
        return None
    candidates = []
    for n, area in enumerate(choice.candidates, start=1):
        nearest_m, distance_m, farthest_m = area.depths_m
        facts: dict[str, Any] = {
            "number": n,
            "nearest_mm": nearest_m / MM,
            "distance_mm": distance_m / MM,
            "farthest_mm": farthest_m / MM,
            "extent_mm": [side / MM for side in area.extent_m],
            "share_of_view": area.share,
            "tilt_deg": area.tilt_deg,
            "pixels": int(area.mask.sum()),
        }
        candidates.append(facts)
    return {"taken": choice.taken, "warnings": choice.warnings, "candidates": candidates}


def pictures(
    choice: Choice | None, name: str = "targets.png"
) -> dict[str, Callable[[Path], object]]:
    """Return the writer of the candidates' numbered picture, by file name, for
    `report.findings.write_findings`."""
    if choice is None or not choice.candidates:
        return {}
    outlines = [candidate.outline for candidate in choice.candidates]
    texts = list(map(described_text, choice.candidates))
    return {name: lambda path: save_targets(path, choice.grid, outlines, texts, choice.taken)}


def print_registrations(data: Mapping[str, Any]) -> None:
    """Print ``data`` of registrations.json: a table with one view per line, then notes."""
    columns = {
        "residual mm": ("residual_mm", 3),
        "overlap": ("overlap", 2),
        "in plane mm": ("predicted_in_plane_mm", 3),
        "across mm": ("predicted_across_mm", 3),
        "held out mm": ("held_out_mark_mm", 3),
        "pairs": ("pairs", 0),
    }
    rows = [
        (
            row["view"],
            row["method"],
            *(number(row[key], digits) for key, digits in columns.values()),
        )
        for row in data["views"]
    ]
    print(
        "registration to the first view (in plane, across: predicted root mean square error "
        "over the target)"
    )
    show([Grid.of(("view", "method", *columns), rows, left=0)])
    for row in data["views"]:
        print_notes(f"{row['view']}: {note}" for note in row["notes"])


def threshold_text(threshold: float, evidence: Evidence) -> str:
    """Return the threshold and, if a unit of score has a length, its length at a typical point."""
    if evidence.unit:
        return f"{threshold:.4g} units of score"
    return (
        f"{threshold:.4g} x {mm(evidence.scale_m)} = {mm(threshold * evidence.scale_m)} at the "
        "median point"
    )


MOST_ROWS = 20
"""Most findings that the terminal lists."""


def print_classes(counts: Mapping[str, int]) -> None:
    """Print the number of findings of each class, in one line."""
    parts = [f"{count} {name}" for name, count in counts.items()]
    print(f"classes: {', '.join(parts)}")


def print_findings(findings: Sequence[Finding], grid: str = "px", is_written: bool = True) -> None:
    """Print the strongest findings and the number of the others. ``grid``: the unit of u and v;
    ``is_written``: all of them are written to a file."""
    if not findings:
        print("no findings")
        return
    shown = findings[:MOST_ROWS]
    show([_findings_grid(shown, grid)])
    unshown = len(findings) - len(shown)
    if unshown:
        print(f"... and {unshown} more{_where_written(is_written)}")


def _where_written(is_written: bool) -> str:
    return " in findings.csv" if is_written else " (--out DIR writes all of them)"


def _findings_grid(findings: Sequence[Finding], grid: str) -> Grid:
    columns = {
        "u_px": f"u {grid}",
        "v_px": f"v {grid}",
        "x_mm": "x mm",
        "y_mm": "y mm",
        "z_mm": "z mm",
    }
    heads = ["id", "what", *columns.values(), "diam. mm", "depth mm", "score", "class", "p(noise)"]
    rows = []
    for finding in findings:
        row = [finding.id, finding.term or finding.kind]
        row += [number(getattr(finding, key), 1) for key in columns]
        row += [number(finding.diameter_mm, 1), number(finding.depth_mm, 2)]
        row += [f"{finding.score:.2f}", finding.certainty, probability(finding.noise_probability)]
        rows.append(row)
    if any(finding.is_long for finding in findings):
        heads.append("long damage: mm, degrees")
        for row, finding in zip(rows, findings, strict=True):
            row.append(finding.long_text or "-")
    heads.append("flags")
    for row, finding in zip(rows, findings, strict=True):
        row.append(finding.flags)
    return Grid.of(heads, rows, left=2)


FARTHEST_FROM_PART = 1.0
"""Points that are farther before or behind the part than this share of its width are not shown:
the room behind it would make it small."""


def scene_of(judged: Judged, facts: Sequence[tuple[str, str]], mapped: Mapped | None) -> Scene3d:
    """Return the valid points about the part (x right, y down, z away, mm), with a ring around
    each finding. ``facts``: name and value of what stands beside the cloud; ``mapped``: the views
    of a merged cloud, all of whose points are shown."""
    cloud = judged.cloud
    shown = cloud.valid.reshape(-1)
    if mapped is None:
        shown = shown & _near_part(judged).reshape(-1)
    detected = np.zeros(shown.size, bool)
    for detection in judged.detections:
        detected[detection.pixels] = True
    rgb = None
    if cloud.rgb is not None:
        colours = np.nan_to_num(cloud.rgb.reshape(-1, 3)[shown])
        rgb = np.clip(colours, 0, 255).astype(np.uint8)
    return Scene3d(
        points_mm=cloud.points_m.reshape(-1, 3)[shown] / MM,
        frame="camera",
        rgb=rgb,
        residual_mm=judged.evidence.residual_m.reshape(-1)[shown] / MM,
        view_of=None if mapped is None else mapped.view_of_points()[shown],
        view_names=() if mapped is None else mapped.merged.views_used,
        detected=detected[shown],
        circles=_rings(judged.findings),
        facts=tuple(facts),
    )


def _near_part(judged: Judged) -> np.ndarray:
    """Return (h, w) bool: points in the box of what was judged, `FARTHEST_FROM_PART` larger."""
    points_m = judged.cloud.points_m
    is_judged = np.isfinite(judged.evidence.residual_m) & judged.cloud.valid
    part_m = points_m[is_judged]
    if not len(part_m):
        return judged.cloud.valid
    low_m = part_m.min(axis=0)
    high_m = part_m.max(axis=0)
    beyond_m = FARTHEST_FROM_PART * float((high_m - low_m)[:2].max())
    margin_m = np.array([0.1 * beyond_m, 0.1 * beyond_m, beyond_m])
    with np.errstate(invalid="ignore"):
        inside = (points_m >= low_m - margin_m) & (points_m <= high_m + margin_m)
    return np.asarray(inside.all(axis=-1))


def _rings(findings: Sequence[Finding]) -> tuple[Circle3d, ...]:
    """Return a ring around each finding with a place and a diameter."""
    rings = []
    for finding in findings:
        centre_mm = np.array([finding.x_mm, finding.y_mm, finding.z_mm])
        if not np.isfinite([*centre_mm, finding.diameter_mm]).all():
            continue
        label = f"{finding.id}: {finding.diameter_mm:.1f}"
        to_camera = np.array([0.0, 0.0, -1.0])
        rings.append(Circle3d(centre_mm, to_camera, finding.diameter_mm, label, "finding"))
    return tuple(rings)


def map_facts(mapped: Mapped, judged: Judged) -> list[tuple[str, str]]:
    """Return what stands beside a merged cloud."""
    frames = sum(view.view.cloud.n_frames for view in mapped.views)
    return [
        ("views", str(len(mapped.merged.views_used))),
        ("frames in all", str(frames)),
        ("registration", mapped.registrations[-1].method),
        ("findings", str(len(judged.findings))),
    ]
