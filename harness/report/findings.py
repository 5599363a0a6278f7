"""Findings of `tofpod detect` as rows, files and pictures: CSV, JSON, PNG, and a point cloud with
coloured damage.

All files of a run are first written under temporary names and renamed together at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from harness.records import outputs, trials
from harness.report.clouds import residual_bar, residual_norm
from harness.vocabulary.files import atomic_path, plain_json
from harness.vocabulary.geometry import MM, Cloud

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DAMAGE_RGB = (255, 0, 255)
# least ratio of length to width of a long finding; a width below 1 mm, which is noise, counts as 1
# mm
ELONGATED = 2.0


@dataclass(frozen=True)
class Finding:
    """A row: the better of both measures in the camera frame; NaN if nothing could be measured.
    ``kind`` is ``hole``, ``bump`` or ``no return``. ``length_mm`` and ``width_mm`` are the sides
    of a rectangle with the residual's second moments; ``angle_deg`` is the longer side's angle
    from x towards y, -90 to 90, across the line of sight. ``size_from`` is ``model`` (blurred
    hole, standard errors), ``contour`` (half depth), ``extent`` (extreme points) or ``area`` (no
    return); ``depth_from`` is the same, ``extreme residual`` of the cluster's points, or ``none``.
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
    length_mm: float
    width_mm: float
    angle_deg: float
    size_from: str
    depth_from: str

    @property
    def is_long(self) -> bool:
        """True if it is `ELONGATED`, so that its diameter is of little use."""
        return self.length_mm > ELONGATED * max(self.width_mm, 1.0)


@dataclass(frozen=True)
class Judged:
    """A cloud with a detector's results. ``missing`` are its missing returns, None without a pixel
    grid."""

    cloud: Cloud
    evidence: Evidence
    detections: tuple[Detection, ...]
    measurements: tuple[Measurement, ...]
    missing: MissingReturns | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings, numbered from 1, strongest first."""
        pairs = zip(self.detections, self.measurements, strict=True)
        return tuple(finding_of(i, self.evidence, d, m) for i, (d, m) in enumerate(pairs, start=1))


def finding_of(
    number: int, evidence: Evidence, detection: Detection, measured: Measurement
) -> Finding:
    """Return the row of a detection: the model's numbers if they exist, or else those of the
    extents."""
    modelled = math.isfinite(measured.model_diameter_m)
    placed = bool(np.isfinite(measured.model_centre_m).all())
    x_mm, y_mm, z_mm = (
        float(m) / MM for m in (measured.model_centre_m if placed else measured.extent_centre_m)
    )
    diameter_m = measured.model_diameter_m if modelled else measured.extent_diameter_m
    size_from = (
        "extent"
        if not modelled
        else "contour"
        if math.isnan(measured.model_diameter_se_m)
        else "model"
    )
    depth_m = measured.model_depth_m
    depth_from = size_from
    if detection.kind == "no return":
        size_from = "area"
        depth_from = "none"
    elif math.isnan(depth_m):
        residuals = evidence.residual_m.reshape(-1)[detection.pixels]
        depth_m = float(residuals[np.argmax(np.abs(residuals))])
        depth_from = "extreme residual"
    kind = detection.kind if detection.kind == "no return" else "bump" if depth_m < 0 else "hole"
    place = (measured.u_px, measured.v_px, x_mm, y_mm, z_mm)
    sizes = (diameter_m / MM, depth_m / MM, measured.volume_m3 / MM**3)
    x, y, _ = measured.along
    sides = (
        measured.length_m / MM,
        measured.width_m / MM,
        float(np.degrees(np.arctan2(y, x) + np.pi / 2) % 180 - 90),
    )
    return Finding(
        number, kind, *place, *sizes, measured.points, measured.score, *sides, size_from, depth_from
    )


def write_findings(
    folder: Path,
    judged: Judged,
    about: Mapping[str, Any],
    title: str,
    cloud_name: str = outputs.CLOUD.name,
    beside: Mapping[str, Callable[[Path], object]] | None = None,
) -> tuple[Path, ...]:
    """Write all files of a run to ``folder``, or none. The JSON holds the plain data ``about``
    besides the findings; ``beside`` maps names of further files to functions that write them.
    Raises UserError if writing fails."""
    is_new, (cloud, missing, detections) = (
        not folder.exists(),
        (judged.cloud, judged.missing, judged.detections),
    )
    writers: dict[str, Callable[[Path], object]] = {
        outputs.FINDINGS.name: lambda path: path.write_text(
            csv_text(judged.findings), encoding="utf-8"
        ),
        outputs.FINDINGS_DATA.name: lambda path: path.write_text(
            json_text(judged, about), encoding="utf-8"
        ),
        outputs.ANNOTATED.name: lambda path: _save(
            path, findings_figure(cloud, judged.evidence, detections, title)
        ),
        cloud_name: lambda path: path.write_bytes(ply_bytes(cloud, detections)),
        **(beside or {}),
    }
    if missing is not None:
        writers[outputs.BLIND.name] = lambda path: save_blind_map(path, cloud, missing, detections)
    try:
        with ExitStack() as stack:
            parts = {name: stack.enter_context(atomic_path(folder / name)) for name in writers}
            for name, write in writers.items():
                write(parts[name])
    except BaseException:
        if is_new and folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()
        raise
    return tuple(folder / name for name in writers)


def csv_text(findings: Sequence[Finding]) -> str:
    """Return the content of findings.csv; unknown numbers are empty cells."""
    frame = trials.FINDINGS_OF_CAPTURE.frame(findings)
    return str(
        frame.to_csv(
            index=False, float_format=trials.FINDINGS_OF_CAPTURE.digits, lineterminator="\n"
        )
    )


def json_text(judged: Judged, about: Mapping[str, Any]) -> str:
    """Return the findings with both measures and their standard errors, then ``about``; unknown
    numbers are null."""
    rows = [
        asdict(finding)
        | {
            "extent": {
                "diameter_mm": m.extent_diameter_m / MM,
                "centre_mm": m.extent_centre_m / MM,
            },
            "model": {
                **{f"{name}_mm": getattr(m, f"model_{name}_m") / MM for name in MODELLED},
                "note": m.model_note,
            },
        }
        for finding, m in zip(judged.findings, judged.measurements, strict=True)
    ]
    return plain_json({"findings_version": trials.FINDINGS_VERSION, "findings": rows, **about})


def ply_bytes(cloud: Cloud, detections: Sequence[Detection]) -> bytes:
    """Return the valid points (camera frame, metres, float32) as a binary PLY: damage magenta, the
    rest coloured."""
    import trimesh

    colours = np.full((cloud.valid.size, 3), 160, np.uint8)
    if cloud.rgb is not None:
        colours = np.clip(np.nan_to_num(cloud.rgb), 0, 255).reshape(-1, 3).astype(np.uint8)
    for detection in detections:
        colours[detection.pixels] = DAMAGE_RGB
    valid = cloud.valid.reshape(-1)
    points = trimesh.PointCloud(cloud.points_m.reshape(-1, 3)[valid], colors=colours[valid])
    exported: bytes = points.export(file_type="ply")
    return exported


MODELLED = ("diameter", "diameter_se", "depth", "depth_se", "centre", "centre_se")
WIDTH_IN = 11.0
DPI = 150
TAKEN = "#ff00ff"
OTHERS = ("#ff9f1c", "#2ec4b6", "#ffee32", "#4cc9f0", "#f94144", "#90be6d", "#bdb2ff")
"""Colours that differ from grey and from one another, also for viewers with red-green blindness.
"""
Box = tuple[float, float, float, float]


def findings_figure(
    cloud: Cloud, evidence: Evidence, detections: Sequence[Detection], title: str
) -> Figure:
    """Draw the colour image (if known) above the residual in mm; without a pixel grid, draw a plan
    view in mm."""
    panels = 2 if cloud.organised and cloud.rgb is not None else 1
    box = _around(cloud, np.isfinite(evidence.residual_m))
    residual_mm = evidence.residual_m / MM
    style: dict[str, Any] = {"cmap": "RdBu_r", "norm": residual_norm(residual_mm)}

    def draw(figure: Figure) -> None:
        axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
        if panels == 2:
            axes[0].imshow(_bytes(cloud.rgb), extent=_edges(cloud), interpolation="nearest")
        axes[-1].set_facecolor("0.82")
        if cloud.organised:
            shown = axes[-1].imshow(
                residual_mm, extent=_edges(cloud), interpolation="nearest", **style
            )
        else:
            judged = np.isfinite(residual_mm)
            x = cloud.points_m[..., 0][judged] / MM
            y = cloud.points_m[..., 1][judged] / MM
            shown = axes[-1].scatter(x, y, c=residual_mm[judged], s=2, linewidths=0, **style)
        residual_bar(figure, shown, "mm behind (+) or before (−) the surface", ax=list(axes))
        for panel in axes:
            _frame(panel, cloud, box)
            _circle(panel, cloud, enumerate(detections, start=1))

    return _figure(title, panels * _height_in(box), draw)


def save_blind_map(
    path: Path, cloud: Cloud, missing: MissingReturns, detections: Sequence[Detection]
) -> None:
    """Write a PNG with each pixel's share of frames without a return, the outline, and findings
    without a return."""
    box = _around(cloud, missing.outline)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        style: dict[str, Any] = {
            "interpolation": "nearest",
            "cmap": "Greys",
            "vmin": 0,
            "vmax": 100,
        }
        shown = axes.imshow(100 * missing.unseen, extent=_edges(cloud), **style)
        figure.colorbar(shown, ax=axes, shrink=0.6).set_label(
            "frames without a return, %", fontsize=8
        )
        if min(missing.outline.shape) > 1 and not missing.outline.all():
            height, width = missing.outline.shape
            columns = np.arange(width) + cloud.region.col0
            rows = np.arange(height) + cloud.region.row0
            axes.contour(
                columns, rows, missing.outline, levels=[0.5], colors="#0070c0", linewidths=0.8
            )
        _frame(axes, cloud, box)
        _circle(
            axes,
            cloud,
            (
                (n, found)
                for n, found in enumerate(detections, start=1)
                if found.kind == "no return"
            ),
        )

    _save(
        path,
        _figure(
            f"{100 * missing.blind:.2g} % of the target's pixels returned nothing",
            _height_in(box),
            draw,
        ),
    )


def save_targets(
    path: Path, grid: Cloud, outlines: Sequence[np.ndarray], texts: Sequence[str], taken: int
) -> None:
    """Write a PNG with the colour, amplitude or depth of a grid, outlines (h, w), texts, and
    numbers from 1."""
    import cv2
    from matplotlib.patheffects import withStroke

    height, width = grid.valid.shape

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.imshow(_view(grid), interpolation="nearest")
        axes.set_axis_off()
        colours = iter(OTHERS * 2)
        for number, (outline, text) in enumerate(zip(outlines, texts, strict=True), start=1):
            chosen = number == taken
            colour = TAKEN if chosen else next(colours)
            x = np.arange(-1, width + 1)
            y = np.arange(-1, height + 1)
            padded = np.pad(outline, 1)
            axes.contour(
                x, y, padded.astype(float), [0.5], colors=colour, linewidths=2.4 if chosen else 1.4
            )
            # the pixel that is farthest from the outline
            depth = cv2.distanceTransform(padded.astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
            v, u = np.unravel_index(int(depth.argmax()), depth.shape)
            style: dict[str, Any] = {
                "fontsize": 22,
                "weight": "bold",
                "ha": "center",
                "va": "center",
                "color": colour,
            }
            style["path_effects"] = [withStroke(linewidth=4, foreground="black")]
            axes.text(float(u), float(v), str(number), **style)
            how = "taken" if chosen else f"--target {number}"
            axes.plot([], [], color=colour, linewidth=3, label=f"{number} ({how}): {text}")
        figure.legend(loc="outside lower center", fontsize=9, frameon=False)

    _save(
        path,
        _figure("", min(WIDTH_IN * 0.97 * height / width, 24.0) + 0.26 * len(outlines) + 0.6, draw),
    )


def _figure(title: str, height_in: float, draw: Callable[[Figure], None]) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, min(height_in + 0.4, 30.0)), dpi=DPI, layout="compressed")
    figure.suptitle(title, fontsize=10, parse_math=False)  # a file may be called $x$
    draw(figure)
    return figure


def _save(path: Path, figure: Figure) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure).print_png(str(path))


def _height_in(box: Box) -> float:
    left, right, bottom, top = box
    return WIDTH_IN * 0.82 * max(bottom - top, 1e-9) / max(right - left, 1e-9) + 0.5


def _around(cloud: Cloud, part: np.ndarray) -> Box:
    """Return (left, right, bottom, top) of a part (h, w) bool of the cloud's grid with a margin of
    a twelfth."""
    left, right, bottom, top = _edges(cloud)
    rows, columns = np.nonzero(part)
    if not cloud.organised or not len(rows):
        return left, right, bottom, top
    u0 = float(columns.min())
    u1 = float(columns.max() + 1)
    v0 = float(rows.min())
    v1 = float(rows.max() + 1)
    margin = max(u1 - u0, v1 - v0) / 12.0
    sides = left + np.array([u0 - margin, u1 + margin]), top + np.array([v1 + margin, v0 - margin])
    (a, b), (c, d) = np.clip(sides[0], left, right), np.clip(sides[1], top, bottom)
    return float(a), float(b), float(c), float(d)


def _edges(cloud: Cloud) -> Box:
    """Return (left, right, bottom, top) of the axes: sensor pixels, or millimetres without a grid;
    down is positive."""
    if cloud.organised:
        region = cloud.region
        return region.col0 - 0.5, region.col1 - 0.5, region.row1 - 0.5, region.row0 - 0.5
    x = cloud.points_m[..., 0][cloud.valid] / MM
    y = cloud.points_m[..., 1][cloud.valid] / MM
    return float(x.min()), float(x.max()), float(y.max()), float(y.min())


def _frame(axes: Axes, cloud: Cloud, box: Box) -> None:
    unit = "cell" if cloud.projection == "parallel" else "px"
    x, y = (f"u, {unit}", f"v, {unit}") if cloud.organised else ("x, mm", "y, mm")
    axes.set(xlabel=x, ylabel=y, xlim=box[:2], ylim=box[2:], aspect="equal", autoscale_on=False)


def _circle(axes: Axes, cloud: Cloud, numbered: Iterator[tuple[int, Detection]]) -> None:
    """Draw a circle around each cluster, with its number at the upper right."""
    from matplotlib.patches import Circle

    for number, detection in numbered:
        if cloud.organised:
            rows, columns = np.unravel_index(detection.pixels, cloud.valid.shape)
            u = columns + cloud.region.col0
            v = rows + cloud.region.row0
            margin = 3.0
        else:
            u, v = (cloud.points_m.reshape(-1, 3)[detection.pixels] / MM).T[:2]
            margin = 2.0
        centre = 0.5 * float(u.min() + u.max()), 0.5 * float(v.min() + v.max())
        radius = 0.5 * float(max(np.ptp(u), np.ptp(v))) + margin
        axes.add_patch(Circle(centre, radius, fill=False, color=TAKEN, linewidth=0.9))
        at = (centre[0] + 0.71 * radius, centre[1] - 0.71 * radius)
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.6, "pad": 0.4}
        axes.annotate(
            str(number),
            at,
            (1, 1),
            textcoords="offset points",
            bbox=box,
            fontsize=7,
            annotation_clip=True,
        )


def _bytes(rgb: Any) -> np.ndarray:
    return np.clip(np.nan_to_num(np.asarray(rgb)), 0, 255).astype(np.uint8)


def _view(grid: Cloud) -> np.ndarray:
    """Return (h, w, 3) bytes: colour, else amplitude, else depth."""
    if grid.rgb is not None and np.isfinite(grid.rgb).any():
        return _bytes(grid.rgb)
    values = -grid.points_m[..., 2]
    if grid.amplitude is not None and np.isfinite(grid.amplitude).any():
        values = np.sqrt(np.maximum(grid.amplitude, 0.0))
    known = values[np.isfinite(values)]
    low, high = np.quantile(known, (0.02, 0.98)) if len(known) else (0.0, 1.0)
    grey = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0) * 190.0 + 50.0
    return np.repeat(np.nan_to_num(grey)[..., None], 3, axis=-1).astype(np.uint8)
