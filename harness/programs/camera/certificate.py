"""Two pages to file or to send: the measurements of a unit, in the terms of the standards, and
their validity.

The terms are those of VDI/VDE 2634 part 2 and ISO 10360-13 (optical 3D measuring systems), and of
MIL-HDBK-1823A, ASTM E2862 and E3023 (probability of detection). The figures follow these standards
without their artefacts and procedures. Nothing here is an accredited calibration."""

from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from detectors.pixels.noise import rounding_left_m2
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import StudyRecord
from harness.programs.camera.measure import Characteristics
from harness.programs.camera.page import shared_figures
from harness.programs.camera.tables import CERTIFIED, FLAT_SURFACES
from harness.report.blocks import bullets, heading, note, page
from harness.tables.limits import LIMITS
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.text import many

LOD_FRAMES = (1, 10, 50)
PRINTED = Markup(
    "<style>@page { margin: 14mm } @media print { body { font-size: 8pt; line-height: 1.25 } "
    "table { font-size: 7pt } th, td { padding: 1px 4px } h1 { font-size: 15pt } h2 { margin: 8px "
    "0 4px } .answer { font-size: 10.5pt } input { display: none } }</style>"
)
SHOWN_LIMITS = (
    "set-up",
    "a90/95 (mm)",
    "over boards (mm)",
    "a90 (mm)",
    "a50 (mm)",
    "calls/m² (95 %)",
    "found",
)
OF_SURFACES = (
    "Temporal noise: standard deviation of a single pixel's z over frames. Plane-fit rms: rms "
    "distance of points from their own plane. Dispersion: width of the layer with 95 % of a "
    "frame's points, as in ISO 10360-13; flatness: 99.7 %, as in VDI/VDE 2634-2; all three "
    "include the surface's own shape and the lens's error. Fill rate: share of pixels and frames "
    "with a return. LoD95: 1.96 standard deviations of a pixel's z, including fixed pattern and "
    "rounding; for more frames than were recorded, noise is assumed to fall with the square root "
    "of their number."
)
POD = (
    "a50, a90 and a90/95 are computed as in MIL-HDBK-1823A, ASTM E2862 (hits and misses) and "
    "E3023 (signals); false calls per square metre have the exact 95 % Poisson interval; a "
    "finding within {:g} mm of a damage is a hit."
)
CONDITIONS = (
    "The figures hold for this unit, mode, distance, angle and surface, and for the stated "
    "warm-up.",
    "The tag of each number in the camera file says whether it was measured, adopted or assumed.",
    "No accreditation is claimed: no artefact was calibrated, and the procedures only resemble "
    "those of the standards.",
)


def level_of_detection_mm(measured: Characteristics, variance_m2: float, frames: int) -> float:
    """Return 1.96 standard deviations of a pixel's z averaged over ``frames``. Noise averages out;
    fixed pattern and the remaining rounding error do not. The difference of two captures of the
    same unit has no fixed pattern."""
    step_m = measured.captures[0].step_m
    pattern_m2 = measured.pattern.field.rms_m**2 if measured.pattern is not None else 0.0
    left_m2 = rounding_left_m2(step_m, variance_m2) if step_m > 0 else 0.0
    return 1.96 * float(np.sqrt(variance_m2 / frames + pattern_m2 + left_m2)) / MM


def spacings_mm(measured: Characteristics, poses: Sequence[np.ndarray]) -> Iterator[float]:
    """Yield the error of spacing along the surface's normal for each further capture: the distance
    between its largest surface and that of the first capture, which are the same plane by the
    stated poses."""
    plane = measured.captures[0].planes[0][0]
    for pose, capture in zip(poses[1:], measured.captures[1:], strict=True):
        point = transform_points(pose, np.array([0.0, 0.0, capture.planes[0][0].distance_m]))
        yield float(plane.distance_m * plane.normal[2] - point @ plane.normal) / MM


def of_surfaces(measured: Characteristics) -> Iterator[dict[str, Any]]:
    """Yield the rows of `FLAT_SURFACES`."""
    names = ("frame_rms_mm", "average_rms_mm", "form95_mm", "form997_mm", "fill_rate")
    for face in measured.surfaces:
        lods = [
            level_of_detection_mm(measured, (face.temporal.value * MM) ** 2, frames)
            for frames in LOD_FRAMES
        ]
        ends = face.temporal.interval
        temporal = {
            "temporal_mm": face.temporal.value,
            "temporal_low_mm": ends.low,
            "temporal_high_mm": ends.high,
        }
        levels = {f"lod95_{frames}_mm": lod for frames, lod in zip(LOD_FRAMES, lods, strict=True)}
        yield {
            "surface": face.where,
            **temporal,
            **{name: getattr(face, name) for name in names},
            **levels,
        }


def certified(
    measured: Characteristics, poses: Sequence[np.ndarray] | None
) -> Iterator[dict[str, str]]:
    """Yield the rows of `CERTIFIED`: the figures that belong to no single surface, then those of
    the standards."""

    def row(quantity: str, conditions: str, value: str, manner: str) -> dict[str, str]:
        return {"quantity": quantity, "conditions": conditions, "value": value, "manner": manner}

    for name, where, unit, value, meaning in shared_figures(measured):
        if name.endswith("correlation") and not where.endswith(" lag 1"):
            continue  # the page of the camera shows the other lags
        yield row(name, where, f"{round(value, 3) + 0.0:.3g} {unit}".removesuffix(" 1"), meaning)
    flat = all(capture.planes for capture in measured.captures)
    errors = [] if poses is None or not flat else list(spacings_mm(measured, poses))
    largest_error = f"{max(map(abs, errors)):.3g} mm at most" if errors else "not measured"
    yield row(
        "spacing error",
        f"{len(errors)} spacings",
        largest_error,
        "between planes, with --poses, as in ISO 10360-13",
    )
    yield row(
        "probing-form and size error",
        "",
        "not measured",
        "VDI/VDE 2634-2 requires a calibrated sphere",
    )


def write_certificate(
    folder: Path,
    measured: Characteristics,
    facts: dict[str, str],
    poses: Sequence[np.ndarray] | None,
    study: StudyRecord | None,
    command: str,
) -> None:
    """Write certificate.html and .json. ``about`` states unit, mode, firmware and warm-up. May
    raise UserError."""
    rows = list(certified(measured, poses))
    limits = [limit_of(set_up) for set_up in study.set_ups] if study else []
    surfaces = list(of_surfaces(measured))
    share = "The camera's figures were measured."
    if study is not None:
        implanted = (
            "For the detection limits, the frames were measured and the damage was simulated."
        )
        share += (
            f" {implanted if study.name == 'implant' else 'The detection limits were simulated.'}"
        )
    answer = (
        f"{many(measured.frames, 'frame')} in {many(len(measured.captures), 'capture')}, "
        f"{len(measured.jumps_m)} displaced."
    )
    for face in measured.surfaces[:1]:
        recorded = next(
            int(capture.kept.sum()) for capture in measured.captures if capture.name == face.capture
        )
        lod_mm = level_of_detection_mm(
            measured, (face.temporal.value * MM) ** 2, frames := min(recorded, LOD_FRAMES[-1])
        )
        noise = f"A pixel's noise is {face.temporal.value:.3g} mm at {face.distance_m:.2f} m"
        lod = (
            f"the mean of {many(frames, 'recorded frame')} reveals a change of {lod_mm:.3g} mm "
            "(LoD95)"
        )
        answer = f"{noise}; {lod}. {answer}"
    body = [PRINTED, heading("Unit"), bullets(f"{key}: {value}" for key, value in facts.items())]
    body += [
        heading("Measured"),
        FLAT_SURFACES.grid(surfaces).html(),
        note(OF_SURFACES),
        CERTIFIED.grid(rows).html(),
    ]
    if study is not None:
        body += [heading("Probability of detection"), LIMITS.grid(limits, only=SHOWN_LIMITS).html()]
        body += [note(POD.format(study.hit_radius_mm))]
    body += [
        heading("Validity"),
        bullets((share, *CONDITIONS)),
        note(f"{date.today().isoformat()}: {command}"),
    ]
    text = page(
        f"Certificate of measurement: {facts['unit']}", answer, body, warnings=measured.doubts
    )
    data = {"results_version": RESULTS_VERSION, "about": facts, "answer": answer, "figures": rows}
    data |= {"surfaces": FLAT_SURFACES.data(surfaces), "conditions": [share, *CONDITIONS]}
    data |= {"limits": LIMITS.data(limits), "doubts": measured.doubts, "command": command}
    write_text(folder / "certificate.html", text)
    write_json(folder / "certificate.json", data)
