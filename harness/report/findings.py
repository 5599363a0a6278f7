"""Findings of `harness.detect` as rows and as files: CSV, JSON, and a point cloud with the damage coloured.

All files of one run are written beside their final names first and renamed together at the end.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from harness.report.findings_picture import save_blind_map, save_picture
from harness.tables.outputs import ANNOTATED, BLIND, CLOUD, FINDINGS, FINDINGS_DATA
from harness.vocabulary.capture import Cloud
from harness.vocabulary.files import atomic_path
from harness.vocabulary.units import MM

DAMAGE_RGB = (255, 0, 255)
"""Magenta, as in the thesis' figure 3."""
COLUMNS = (
    "id", "kind", "u_px", "v_px", "x_mm", "y_mm", "z_mm", "diameter_mm", "depth_mm", "volume_mm3", "points", "score",
)  # fmt: skip
FINDINGS_VERSION = 2
"""Raised when a column's or a key's meaning changes; in the CSV it is the last column."""
VERSION_COLUMN = "findings_version"
BLIND_MAP = BLIND.name
"""Written of clouds with a pixel grid only."""
FILES = (FINDINGS.name, FINDINGS_DATA.name, ANNOTATED.name, BLIND_MAP, CLOUD.name)


@dataclass(frozen=True)
class Finding:
    """One row: the best of both measures, camera frame. NaN where nothing could be measured.

    ``kind``: ``hole`` (behind the surface), ``bump`` (before it), or ``no return`` (nothing came back).
    ``size_from``: ``model`` (blurred hole, with standard errors), ``contour`` (half depth), ``extent`` (the thesis'
    extreme points) or ``area`` (of pixels without return). ``depth_from``: likewise, or ``extreme residual`` of the
    cluster's points; ``none`` of pixels without return. ``score``: the detector's, or of pixels without return that of
    `detectors.interface.MissingReturns`.
    """

    id: int
    kind: str
    u_px: float
    v_px: float
    x_mm: float
    y_mm: float
    z_mm: float
    diameter_mm: float
    depth_mm: float
    volume_mm3: float
    points: int
    score: float
    size_from: str
    depth_from: str


@dataclass(frozen=True)
class Judged:
    """A cloud with all that a detector said about it; ``measurements`` and ``detections`` side by side. ``missing``:
    what the cloud lacks, None where it has no pixel grid."""

    cloud: Cloud
    evidence: Evidence
    detections: tuple[Detection, ...]
    measurements: tuple[Measurement, ...]
    missing: MissingReturns | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Numbered from 1, strongest first."""
        pairs = zip(self.detections, self.measurements, strict=True)
        return tuple(finding_of(i, self.evidence, d, m) for i, (d, m) in enumerate(pairs, start=1))


def finding_of(number: int, evidence: Evidence, detection: Detection, measured: Measurement) -> Finding:
    """The row of one detection: the model's numbers where they exist, else those of the extents."""
    modelled = math.isfinite(measured.model_diameter_m)
    placed = bool(np.isfinite(measured.model_centre_m).all())
    centre_mm = (measured.model_centre_m if placed else measured.extent_centre_m) / MM
    diameter_m = measured.model_diameter_m if modelled else measured.extent_diameter_m
    size_from = "extent" if not modelled else "contour" if math.isnan(measured.model_diameter_se_m) else "model"
    depth_m, depth_from = measured.model_depth_m, size_from
    if detection.kind == "no return":
        size_from, depth_from = "area", "none"
    elif math.isnan(depth_m):
        residuals = evidence.residual_m.reshape(-1)[detection.pixels]
        depth_m, depth_from = float(residuals[np.argmax(np.abs(residuals))]), "extreme residual"
    return Finding(
        id=number,
        kind=detection.kind if detection.kind == "no return" else "bump" if depth_m < 0 else "hole",
        u_px=measured.u_px,
        v_px=measured.v_px,
        x_mm=float(centre_mm[0]),
        y_mm=float(centre_mm[1]),
        z_mm=float(centre_mm[2]),
        diameter_mm=diameter_m / MM,
        depth_mm=depth_m / MM,
        volume_mm3=measured.volume_m3 / MM**3,
        points=measured.points,
        score=measured.score,
        size_from=size_from,
        depth_from=depth_from,
    )


def write_findings(
    folder: Path,
    judged: Judged,
    about: Mapping[str, Any],
    title: str,
    cloud_name: str = CLOUD.name,
    beside: Mapping[str, Callable[[Path], object]] | None = None,
) -> tuple[Path, ...]:
    """Write all files of a run into ``folder`` (made where it is missing); all of them or none.

    ``about``: what the JSON says beside the findings (capture, threshold, settings, provenance): plain data.
    ``beside``: further files by name, each written by its function to the path that it is given.
    Raises UserError where the folder cannot be written or the disk is full.
    """
    is_new = not folder.exists()
    further = dict(beside or {})
    if (missing := judged.missing) is not None:
        further[BLIND_MAP] = lambda path: save_blind_map(path, judged.cloud, missing, judged.detections)
    names = (*(name for name in FILES[:-1] if name != BLIND_MAP), cloud_name, *further)
    try:
        with ExitStack() as stack:
            part = {name: stack.enter_context(atomic_path(folder / name)) for name in names}
            part[FINDINGS.name].write_text(csv_text(judged.findings), encoding="utf-8")
            part[FINDINGS_DATA.name].write_text(json_text(judged, about), encoding="utf-8")
            save_picture(part[ANNOTATED.name], judged.cloud, judged.evidence, judged.detections, title)
            part[cloud_name].write_bytes(ply_bytes(judged.cloud, judged.detections))
            for name, write in further.items():
                write(part[name])
    except BaseException:
        if is_new and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        raise
    return tuple(folder / name for name in names)


def csv_text(findings: Sequence[Finding]) -> str:
    """The table with the columns `COLUMNS` and the version; an empty cell where there is no number."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*COLUMNS, VERSION_COLUMN))
    for finding in findings:
        row = asdict(finding)
        writer.writerow([*(_cell(row[column]) for column in COLUMNS), FINDINGS_VERSION])
    return text.getvalue()


def _cell(value: float | int | str) -> str:
    if isinstance(value, int | str):
        return str(value)
    return f"{value:.4f}" if math.isfinite(value) else ""


def json_text(judged: Judged, about: Mapping[str, Any]) -> str:
    """The findings with both measures and their standard errors, then ``about``; null where there is no number."""
    rows = []
    for finding, measured in zip(judged.findings, judged.measurements, strict=True):
        rows.append({**asdict(finding), "extent": _extent(measured), "model": _model(measured)})
    return plain_json({"findings_version": FINDINGS_VERSION, "findings": rows, **about})


def plain_json(data: Mapping[str, Any]) -> str:
    """Plain data and NumPy's numbers as JSON; null where there is no number."""
    return json.dumps(_without_nan(data), indent=2, allow_nan=False) + "\n"


def _extent(measured: Measurement) -> dict[str, Any]:
    return {
        "diameter_mm": measured.extent_diameter_m / MM,
        "centre_mm": [float(value) / MM for value in measured.extent_centre_m],
    }


def _model(measured: Measurement) -> dict[str, Any]:
    return {
        "diameter_mm": measured.model_diameter_m / MM,
        "diameter_se_mm": measured.model_diameter_se_m / MM,
        "depth_mm": measured.model_depth_m / MM,
        "depth_se_mm": measured.model_depth_se_m / MM,
        "centre_mm": [float(value) / MM for value in measured.model_centre_m],
        "centre_se_mm": measured.model_centre_se_m / MM,
        "note": measured.model_note,
    }


def _without_nan(value: Any) -> Any:
    """Plain data with null for NaN and infinity, and Python's numbers for NumPy's."""
    if isinstance(value, Mapping):
        return {str(key): _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, np.generic):
        return _without_nan(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def ply_bytes(cloud: Cloud, detections: Sequence[Detection]) -> bytes:
    """The valid points (camera frame, metres, float32) as a binary PLY: damage magenta, else its colour or grey."""
    import trimesh

    colours = np.full((cloud.valid.size, 3), 160, np.uint8) if cloud.rgb is None else _flat_bytes(cloud.rgb)
    for detection in detections:
        colours[detection.pixels] = DAMAGE_RGB
    valid = cloud.valid.reshape(-1)
    points = trimesh.PointCloud(cloud.points_m.reshape(-1, 3)[valid], colors=colours[valid])
    exported: bytes = points.export(file_type="ply")
    return exported


def _flat_bytes(rgb: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(rgb), 0, 255).reshape(-1, 3).astype(np.uint8)
