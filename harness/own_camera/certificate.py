"""Two pages to file or to send: what was measured of one unit, in the terms of the standards, and what that is worth.

The terms are those of VDI/VDE 2634 part 2 and ISO 10360-13 (optical 3D measuring systems), and of MIL-HDBK-1823A, ASTM
E2862 and E3023 (probability of detection). The figures are in their manner: neither their artefacts nor their
procedures were used where the page says so. Nothing here is an accredited calibration.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path

import numpy as np
from markupsafe import Markup

from detectors.noise import rounding_left_m2
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import StudyRecord
from harness.own_camera.measure import Characteristics
from harness.report.blocks import bullets, heading, note, page
from harness.tables.characteristics import CERTIFIED
from harness.tables.limits import LIMITS
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import MM, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION

LOD_FRAMES = (1, 10, 50)
PRINTED = Markup(
    "<style>@page { margin: 14mm } @media print { body { font-size: 9pt } table { font-size: 7.6pt }"
    " th, td { padding: 2px 5px } h1 { font-size: 15pt } h2 { margin: 8px 0 4px } .answer { font-size: 10.5pt }"
    " }</style>"
)
NOT_MEASURED = "not measured"


def level_of_detection_mm(found: Characteristics, variance_m2: float, frames: int) -> float:
    """Return 1.96 standard deviations of one pixel's z after so many frames: noise, which averages out, fixed pattern
    and what rounding leaves, which do not. A difference of two such captures of one unit has no pattern."""
    step_m = found.captures[0].step_m
    pattern_m2 = found.pattern.field.rms_m**2 if found.pattern is not None else 0.0
    left_m2 = rounding_left_m2(step_m, variance_m2) if step_m > 0 else 0.0
    return 1.96 * float(np.sqrt(variance_m2 / frames + pattern_m2 + left_m2)) / MM


def spacings_mm(found: Characteristics, poses: Sequence[np.ndarray] | None) -> list[float]:
    """Return how far the largest surface of each further capture lies from the first one's, where both are one plane
    by the stated poses: errors of the spacing along the surface's normal. Empty without poses."""
    first = found.captures[0]
    if poses is None or not all(capture.planes for capture in found.captures):
        return []
    plane = first.planes[0][0]
    errors = []
    for pose, capture in zip(poses[1:], found.captures[1:], strict=True):
        on_it = np.array([0.0, 0.0, capture.planes[0][0].distance_m])
        x, y, z = transform_points(pose, on_it)
        apart = z - plane.distance_m - plane.slope_x * x - plane.slope_y * y
        errors.append(float(apart / np.sqrt(1 + plane.slope_x**2 + plane.slope_y**2) / MM))
    return errors


def certified(found: Characteristics, poses: Sequence[np.ndarray] | None) -> Iterator[dict[str, str]]:
    """Yield the certificate's rows."""

    def row(quantity: str, conditions: str, value: str, manner: str) -> dict[str, str]:
        return {"quantity": quantity, "conditions": conditions, "value": value, "manner": manner}

    for one in found.surfaces:
        at, ends = f"{one.capture}: {one.distance_m:.2f} m, {one.angle_deg:.0f}°", one.temporal.interval
        told = f" ({ends.low:.3g} to {ends.high:.3g})" if np.isfinite(ends.low) else ""
        yield row(
            "temporal noise", at, f"{one.temporal.value:.3g}{told} mm", "deviation of single pixels, 95 % interval"
        )
        for name, value, manner in (
            ("plane-fit rms, one frame", one.frame_rms_mm, "of all points about their plane"),
            ("plane-fit rms, average", one.average_rms_mm, "of the average of all frames"),
            ("flat-form dispersion, 95 %", one.form95_mm, "in the manner of ISO 10360-13; the flat is not calibrated"),
            ("flatness measurement error", one.form997_mm, "in the manner of VDI/VDE 2634-2, without 0.3 % of points"),
        ):
            yield row(name, at, f"{value:.3g} mm", manner)
        yield row("fill rate", at, f"{100 * one.fill_rate:.2f} %", "share of pixels and frames with a return")
        lods = (level_of_detection_mm(found, (one.temporal.value * MM) ** 2, frames) for frames in LOD_FRAMES)
        frames_at = f"{at}, {' / '.join(map(str, LOD_FRAMES))} frames"
        value = " / ".join(f"{lod:.3g}" for lod in lods)
        yield row(
            "level of detection, LoD95", frames_at, f"{value} mm", "1.96 deviations of a pixel's z, pattern included"
        )
    lags = ", ".join(f"{value:.2f}" for value in found.correlation.mean(axis=0)[1:6])
    yield row("spectrum: noise correlation", "lags 1 to 5 pixels", lags, "mean of rows and columns")
    if found.pattern is not None and found.pattern_correlation is not None:
        near, far = found.pattern.field.distances_m
        value = f"{found.pattern.field.rms_m / MM:.3g} mm"
        yield row(
            "fixed pattern", f"{near:.2f} to {far:.2f} m", value, "error of range that all frames share, less a fit"
        )
    errors = spacings_mm(found, poses)
    value = f"{max(map(abs, errors)):.3g} mm at most" if errors else NOT_MEASURED
    manner = "spacing of planes by the stated poses, in the manner of ISO 10360-13; needs --poses"
    yield row("spacing error", f"{len(errors)} spacings", value, manner)
    yield row("probing-form and size error", "", NOT_MEASURED, "VDI/VDE 2634-2 asks for a calibrated sphere")


def write_certificate(
    folder: Path,
    found: Characteristics,
    about: dict[str, str],
    poses: Sequence[np.ndarray] | None,
    study: StudyRecord | None,
    command: str,
) -> None:
    """Write ``certificate.html`` and ``certificate.json`` into a folder. ``about``: unit, mode, firmware, warm-up and
    such, in words. Raises UserError where they cannot be written."""
    rows, limits = list(certified(found, poses)), [limit_of(one) for one in study.set_ups] if study else []
    implanted = study is not None and study.name == "implant"
    share = "The camera's figures are measured."
    if study is not None:
        share += (" Of the detection limits the frames are measured and the damage is simulated." if implanted else
                  " The detection limits are simulated.")  # fmt: skip
    calls = "" if study is None else f"A finding within {study.hit_radius_mm:g} mm of a damage is a hit."
    conditions = [
        share,
        "The figures hold for this unit, mode, distance, angle and surface, and for the warm-up that is stated.",
        "Tags of the camera file say of each of its numbers whether it was measured, taken over or assumed.",
        f"Frames: {found.frames} in {len(found.captures)} captures, {len(found.jumps_m)} left out as displaced.",
        "No accreditation is claimed: artefacts were not calibrated, and procedures are in the manner of the standards"
        " that are named.",
    ]  # fmt: skip
    body: list[Markup] = [
        PRINTED,
        heading("Unit and conditions"),
        bullets(f"{key}: {value}" for key, value in about.items()),
    ]
    body += [heading("Measured"), CERTIFIED.grid(rows).html()]
    if limits:
        manner = ("a50, a90, a90/95 in the manner of MIL-HDBK-1823A, ASTM E2862 (hits and misses) and E3023 (signals);"
                  " false calls per square metre with the exact 95 % Poisson interval.")  # fmt: skip
        body += [
            heading("Probability of detection"),
            LIMITS.grid(limits, only=SHOWN_LIMITS).html(),
            note(f"{manner} {calls}"),
        ]
    body += [heading("Validity"), bullets(conditions), note(f"Issued {date.today().isoformat()} by: {command}")]
    answer = f"{found.frames} frames, {len(found.surfaces)} flat surfaces" + (f", study {study.name}" if study else "")
    text = page(f"Certificate of measurement: {about['unit']}", answer, body, warnings=found.doubts)
    told = {
        "results_version": RESULTS_VERSION,
        "about": about,
        "figures": CERTIFIED.data(rows),
        "conditions": conditions,
    }
    told |= {"limits": LIMITS.data(limits), "doubts": found.doubts, "command": command}
    write_text(folder / "certificate.html", text)
    write_text(folder / "certificate.json", json.dumps(told, indent=2, ensure_ascii=False) + "\n")


SHOWN_LIMITS = ("set-up", "a90/95 (mm)", "over boards (mm)", "a90 (mm)", "a50 (mm)", "calls/m² (95 %)", "found")
