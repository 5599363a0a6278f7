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
from harness.report.findings import Finding, Judged, save_targets
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
        print(f"note: {cloud.noise_reach_px:.0f} pixels share their noise: {why}")
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
        nearest, distance, farthest = (m / MM for m in area.depths_m)
        facts: dict[str, Any] = {
            "number": n,
            "nearest_mm": nearest,
            "distance_mm": distance,
            "farthest_mm": farthest,
        }
        facts |= {"extent_mm": [side / MM for side in area.extent_m], "share_of_view": area.share}
        candidates.append({**facts, "tilt_deg": area.tilt_deg, "pixels": int(area.own.sum())})
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


def print_findings(findings: Sequence[Finding], grid: str = "px") -> None:
    """Print the findings, strongest first. ``grid``: the unit of u and v."""
    if not findings:
        print("no findings")
        return
    columns = {
        "u_px": f"u {grid}",
        "v_px": f"v {grid}",
        "x_mm": "x mm",
        "y_mm": "y mm",
        "z_mm": "z mm",
    }
    heads = (
        "id",
        "kind",
        *columns.values(),
        "diam. mm",
        "from",
        "depth mm",
        "vol. mm3",
        "points",
        "score",
    )
    rows = []
    for f in findings:
        sizes = (
            number(f.diameter_mm, 1),
            f.size_from,
            number(f.depth_mm, 2),
            number(f.volume_mm3, 1),
        )
        rows.append(
            (
                f.id,
                f.kind,
                *(number(getattr(f, key), 1) for key in columns),
                *sizes,
                f.points,
                f"{f.score:.2f}",
            )
        )
    if any(f.is_long for f in findings):
        heads += ("long damage: mm, degrees",)
        long = [
            f"{f.length_mm:.1f} x {f.width_mm:.1f}, {f.angle_deg:.0f}" if f.is_long else "-"
            for f in findings
        ]
        rows = [(*row, text) for row, text in zip(rows, long, strict=True)]
    show([Grid.of(heads, rows, left=0)])


def scene_of(mapped: Mapped, judged: Judged) -> Scene3d:
    """Return the merged cloud's valid points (x right, y down, z away, mm), with a ring around
    each finding."""
    cloud = judged.cloud
    merged = mapped.merged
    valid = cloud.valid.reshape(-1)
    detected = np.zeros(valid.size, bool)
    for detection in judged.detections:
        detected[detection.pixels] = True
    rgb = (
        None
        if cloud.rgb is None
        else np.clip(np.nan_to_num(cloud.rgb.reshape(-1, 3)[valid]), 0, 255)
    )
    circles = [
        Circle3d(
            place_mm,
            np.array([0.0, 0.0, -1.0]),
            f.diameter_mm,
            f"{f.id}: {f.diameter_mm:.1f}",
            "finding",
        )
        for f in judged.findings
        if np.isfinite([*(place_mm := np.array([f.x_mm, f.y_mm, f.z_mm])), f.diameter_mm]).all()
    ]
    return Scene3d(
        points_mm=cloud.points_m.reshape(-1, 3)[valid] / MM,
        frame="camera",
        rgb=None if rgb is None else rgb.astype(np.uint8),
        residual_mm=judged.evidence.residual_m.reshape(-1)[valid] / MM,
        view_of=mapped.view_of_points()[valid],
        view_names=merged.views_used,
        detected=detected[valid],
        circles=tuple(circles),
        facts=(
            ("views", str(len(merged.views_used))),
            ("frames in all", str(sum(view.view.cloud.n_frames for view in mapped.views))),
            ("registration", mapped.registrations[-1].method),
            ("findings", str(len(judged.findings))),
        ),
    )
