"""Two pages to file or to send: the measurements of one unit, in the terms of the standards, and their validity.

The terms are those of VDI/VDE 2634 part 2 and ISO 10360-13 (optical 3D measuring systems), and of MIL-HDBK-1823A, ASTM
E2862 and E3023 (probability of detection). Figures are in their manner: neither their artefacts nor their procedures
were used. Nothing here is an accredited calibration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from detectors.noise import rounding_left_m2
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import StudyRecord
from harness.own_camera.measure import Characteristics
from harness.own_camera.page import shared_figures
from harness.report.blocks import bullets, heading, note, page
from harness.tables.characteristics import CERTIFIED, FLAT_SURFACES
from harness.tables.limits import LIMITS
from harness.tables.text import many
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION

LOD_FRAMES = (1, 10, 50)
PRINTED = Markup(
    "<style>@page { margin: 14mm } @media print { body { font-size: 8pt; line-height: 1.25 } table { font-size: 7pt }"
    " th, td { padding: 1px 4px } h1 { font-size: 15pt } h2 { margin: 8px 0 4px } .answer { font-size: 10.5pt }"
    " input { display: none } }</style>"
)
SHOWN_LIMITS = ("set-up", "a90/95 (mm)", "over boards (mm)", "a90 (mm)", "a50 (mm)", "calls/m² (95 %)", "found")
OF_SURFACES = (
    "Temporal noise: deviation of single pixels over frames, of z. Plane-fit rms: distance of points from their own "
    "plane. Dispersion: width that 95 % of a frame's points need, in the manner of ISO 10360-13; flatness: 99.7 %, in "
    "the manner of VDI/VDE 2634-2; all three include the surface's own shape and the lens' error. Fill rate: share of "
    "pixels and frames with a return. LoD95: 1.96 deviations of a pixel's z, fixed pattern and rounding included; for "
    "more frames than were recorded it is extrapolated, noise falling with the square root of their number."
)
POD = (
    "a50, a90, a90/95 in the manner of MIL-HDBK-1823A, ASTM E2862 (hits and misses) and E3023 (signals); false calls"
    " per square metre with the exact 95 % Poisson interval; a finding within {:g} mm of a damage is a hit."
)
CONDITIONS = (
    "The figures hold for this unit, mode, distance, angle and surface, and for the warm-up that is stated.",
    "Tags of the camera file say of each of its numbers whether it was measured, taken over or assumed.",
    "No accreditation is claimed: no artefact was calibrated, and procedures are in the manner of the named standards.",
)


def level_of_detection_mm(found: Characteristics, variance_m2: float, frames: int) -> float:
    """Return 1.96 standard deviations of one pixel's z after so many frames: noise, which averages out, fixed pattern
    and what rounding leaves, which do not. A difference of two such captures of one unit has no pattern."""
    step_m = found.captures[0].step_m
    pattern_m2 = found.pattern.field.rms_m**2 if found.pattern is not None else 0.0
    left_m2 = rounding_left_m2(step_m, variance_m2) if step_m > 0 else 0.0
    return 1.96 * float(np.sqrt(variance_m2 / frames + pattern_m2 + left_m2)) / MM


def spacings_mm(found: Characteristics, poses: Sequence[np.ndarray]) -> Iterator[float]:
    """Yield how far the largest surface of each further capture lies from the first one's, where both are one plane by
    the stated poses: errors of the spacing along the surface's normal."""
    plane = found.captures[0].planes[0][0]
    for pose, capture in zip(poses[1:], found.captures[1:], strict=True):
        point = transform_points(pose, np.array([0.0, 0.0, capture.planes[0][0].distance_m]))
        yield float(plane.distance_m * plane.normal[2] - point @ plane.normal) / MM


def of_surfaces(found: Characteristics) -> Iterator[dict[str, Any]]:
    """Yield the rows of `FLAT_SURFACES`."""
    names = ("frame_rms_mm", "average_rms_mm", "form95_mm", "form997_mm", "fill_rate")
    for one in found.surfaces:
        lods = [level_of_detection_mm(found, (one.temporal.value * MM) ** 2, frames) for frames in LOD_FRAMES]
        ends = one.temporal.interval
        temporal = {"temporal_mm": one.temporal.value, "temporal_low_mm": ends.low, "temporal_high_mm": ends.high}
        levels = {f"lod95_{frames}_mm": lod for frames, lod in zip(LOD_FRAMES, lods, strict=True)}
        yield {"surface": one.where, **temporal, **{name: getattr(one, name) for name in names}, **levels}


def certified(found: Characteristics, poses: Sequence[np.ndarray] | None) -> Iterator[dict[str, str]]:
    """Yield the rows of `CERTIFIED`: figures that are of no single surface, then those of the standards."""

    def row(quantity: str, conditions: str, value: str, manner: str) -> dict[str, str]:
        return {"quantity": quantity, "conditions": conditions, "value": value, "manner": manner}

    for name, where, unit, value, meaning in shared_figures(found):
        if name.endswith("correlation") and not where.endswith(" lag 1"):
            continue  # the rest stands on the page
        yield row(name, where, f"{round(value, 3) + 0.0:.3g} {unit}".removesuffix(" 1"), meaning)
    flat = all(capture.planes for capture in found.captures)
    errors = [] if poses is None or not flat else list(spacings_mm(found, poses))
    most = f"{max(map(abs, errors)):.3g} mm at most" if errors else "not measured"
    yield row("spacing error", f"{len(errors)} spacings", most, "of planes by --poses, in the manner of ISO 10360-13")
    yield row("probing-form and size error", "", "not measured", "VDI/VDE 2634-2 asks for a calibrated sphere")


def write_certificate(
    folder: Path,
    found: Characteristics,
    about: dict[str, str],
    poses: Sequence[np.ndarray] | None,
    study: StudyRecord | None,
    command: str,
) -> None:
    """Write ``certificate.html``, ``.json``. ``about``: unit, mode, firmware, warm-up. May raise UserError."""
    rows, limits = list(certified(found, poses)), [limit_of(one) for one in study.set_ups] if study else []
    surfaces = list(of_surfaces(found))
    share = "The camera's figures are measured."
    if study is not None:
        implanted = "For the detection limits, the frames are measured and the damage is simulated."
        share += f" {implanted if study.name == 'implant' else 'The detection limits are simulated.'}"
    answer = f"{many(found.frames, 'frame')} in {many(len(found.captures), 'capture')}, {len(found.jumps_m)} displaced."
    for one in found.surfaces[:1]:
        recorded = next(int(capture.kept.sum()) for capture in found.captures if capture.name == one.capture)
        lod_mm = level_of_detection_mm(found, (one.temporal.value * MM) ** 2, frames := min(recorded, LOD_FRAMES[-1]))
        noise = f"A pixel's noise is {one.temporal.value:.3g} mm at {one.distance_m:.2f} m"
        lod = f"the mean of {many(frames, 'recorded frame')} shows a change of {lod_mm:.3g} mm (LoD95)"
        answer = f"{noise}; {lod}. {answer}"
    body = [PRINTED, heading("Unit"), bullets(f"{key}: {value}" for key, value in about.items())]
    body += [heading("Measured"), FLAT_SURFACES.grid(surfaces).html(), note(OF_SURFACES), CERTIFIED.grid(rows).html()]
    if study is not None:
        body += [heading("Probability of detection"), LIMITS.grid(limits, only=SHOWN_LIMITS).html()]
        body += [note(POD.format(study.hit_radius_mm))]
    body += [heading("Validity"), bullets((share, *CONDITIONS)), note(f"{date.today().isoformat()}: {command}")]
    text = page(f"Certificate of measurement: {about['unit']}", answer, body, warnings=found.doubts)
    data = {"results_version": RESULTS_VERSION, "about": about, "answer": answer, "figures": rows}
    data |= {"surfaces": FLAT_SURFACES.data(surfaces), "conditions": [share, *CONDITIONS]}
    data |= {"limits": LIMITS.data(limits), "doubts": found.doubts, "command": command}
    write_text(folder / "certificate.html", text)
    write_json(folder / "certificate.json", data)
