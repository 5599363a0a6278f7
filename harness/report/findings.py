"""Findings of `tofpod detect` as rows, files and pictures: CSV, JSON, PNG, and a point cloud with
coloured damage.

All files of a run are first written under temporary names and renamed together at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from harness.records import outputs, trials
from harness.report.clouds import residual_bar, residual_norm
from harness.vocabulary.files import atomic_path, plain_json
from harness.vocabulary.geometry import MM, Cloud

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

DAMAGE_RGB = (255, 0, 255)
OTHER_GREY = 160
"""Grey of the points of a cloud without colours."""
ELONGATED = 2.0
"""Least ratio of length to width of a long finding."""
ROUND = ("disc", "cap", "bowl")
"""Shapes that are as long as wide."""
LEAST_WIDTH_MM = 1.0
"""A width below this, which is noise, counts as this."""
MODELLED = ("diameter", "diameter_se", "depth", "depth_se", "centre", "centre_se")
"""Numbers of the model in the JSON."""

# ---------------------------------------------------------------- rows


@dataclass(frozen=True)
class Finding:
    """A row: the better of both measures in the camera frame; NaN if nothing could be measured."""

    id: int
    """Number from 1, strongest first."""
    kind: str
    """``hole``, ``bump`` or ``no return``."""
    u_px: float
    """Column of its centre in the image."""
    v_px: float
    """Row of its centre in the image."""
    x_mm: float
    """x of its centre (to the right)."""
    y_mm: float
    """y of its centre (down)."""
    z_mm: float
    """z of its centre (away from the camera)."""
    diameter_mm: float
    """Diameter of the mouth, see ``size_from``; of a slot, that of the circle with its area."""
    diameter_se_mm: float
    """Standard error of the diameter, with what the shape does not explain; NaN if unknown."""
    depth_mm: float
    """Depth normal to the fitted surface, negative for a bump, see ``depth_from``."""
    depth_se_mm: float
    """Standard error of the depth; NaN if unknown."""
    sight_depth_mm: float
    """Depth along the line of sight, negative for a bump."""
    volume_mm3: float
    """Volume between the surface and the points behind it."""
    points: int
    """Number of points of the cluster."""
    score: float
    """The detector's score."""
    length_mm: float
    """Longer side of a rectangle with the residual's second moments."""
    width_mm: float
    """Shorter side of that rectangle."""
    angle_deg: float
    """Angle of the longer side from x towards y, -90 to 90, across the line of sight."""
    shape: str
    """``disc``, ``cap``, ``bowl`` or ``slot``, ``ragged`` if no shape fits, or empty if the blur
    hides it."""
    size_from: str
    """``model`` (a family of shapes), ``contour`` (half depth), ``extent`` (extreme points) or
    ``area`` (no return)."""
    depth_from: str
    """The same as ``size_from``, ``extreme residual`` of the cluster's points, or ``none``."""
    depth_is_least: bool = False
    """True if the blur hides the floor, so that the damage may be deeper than stated."""
    length_se_mm: float = math.nan
    """Standard error of the length of a fitted slot; NaN for other shapes."""
    width_se_mm: float = math.nan
    """Standard error of its width."""
    angle_se_deg: float = math.nan
    """Standard error of its angle."""
    noise_probability: float = math.nan
    """Probability that it is a false call: noise, or what an object or print makes of the measured
    distance. NaN if the capture does not set its own threshold."""
    certainty: str = ""
    """``sure``, ``doubtful``, ``rim or blind`` or ``feature``; empty where nobody has judged it."""
    flags: str = ""
    """Remarks on it, as words separated by spaces (`harness.inspection.verdict.FLAGS`)."""
    term: str = ""
    """``hole``, ``dent``, ``hole or dent``, ``slot``, ``joints``, ``bump`` or ``no return``."""
    count: int = 1
    """Number of places; more than 1 for joints, whose sizes and place are those of one of them."""

    @property
    def is_long(self) -> bool:
        """True if it is `ELONGATED`, so that its diameter is of little use. A round shape that fits
        it better than a slot decides against length and width, which are noise where blur hides
        them."""
        if self.shape in ROUND:
            return False
        return self.length_mm > ELONGATED * max(self.width_mm, LEAST_WIDTH_MM)

    @property
    def long_text(self) -> str:
        """Length, width and angle of a long finding, else an empty text."""
        if not self.is_long:
            return ""
        return f"{self.length_mm:.1f} x {self.width_mm:.1f}, {self.angle_deg:.0f}"


def probability(value: float) -> str:
    """Return a probability of noise with one digit that means something; ``unknown`` for NaN."""
    if math.isnan(value):
        return "unknown"
    return f"{value:.1g}" if value >= 1e-4 else "< 0.0001"


@dataclass(frozen=True)
class Remark:
    """Words about a finding besides its numbers; see the fields of `Finding`."""

    certainty: str
    flags: str
    term: str


@dataclass(frozen=True)
class Judged:
    """A cloud with a detector's results."""

    cloud: Cloud
    """The cloud."""
    evidence: Evidence
    """The detector's scores and residuals."""
    detections: tuple[Detection, ...]
    """The clusters, strongest first."""
    measurements: tuple[Measurement, ...]
    """The size and place of each cluster."""
    missing: MissingReturns | None = None
    """Missing returns; None without a pixel grid."""
    noise_probabilities: tuple[float, ...] = ()
    """Each finding's probability of being a false call, NaN if unknown; empty if all are."""
    remarks: tuple[Remark, ...] = ()
    """One for each finding, or none at all."""

    @property
    def findings(self) -> tuple[Finding, ...]:
        """The findings, numbered from 1, strongest first."""
        unknown = (math.nan,) * len(self.detections)
        probabilities = self.noise_probabilities or unknown
        triples = zip(self.detections, self.measurements, probabilities, strict=True)
        measured_only = tuple(
            finding_of(number, self.evidence, detection, measured, probability)
            for number, (detection, measured, probability) in enumerate(triples, start=1)
        )
        if not self.remarks:
            return measured_only
        remarked = []
        for finding, remark in zip(measured_only, self.remarks, strict=True):
            remarked.append(replace(finding, **vars(remark)))
        return tuple(remarked)


def finding_of(
    number: int,
    evidence: Evidence,
    detection: Detection,
    measured: Measurement,
    noise_probability: float = math.nan,
) -> Finding:
    """Return the row of a detection: the model's numbers if they exist, or else those of the
    extents."""
    centre_m = measured.extent_centre_m
    if np.isfinite(measured.model_centre_m).all():
        centre_m = measured.model_centre_m
    is_modelled = math.isfinite(measured.model_diameter_m)
    diameter_m = measured.model_diameter_m if is_modelled else measured.extent_diameter_m
    size_from = _size_from(detection, measured)
    axial_depth_m, depth_from = _depth_of(evidence, detection, measured)
    # a measurement without a surface around it has no cosine: the depth is that along the axis
    normal_share = measured.normal_share if math.isfinite(measured.normal_share) else 1.0
    sight_share = measured.sight_share if math.isfinite(measured.sight_share) else 1.0
    depth_m = axial_depth_m * normal_share
    kind: str = detection.kind
    if kind != "no return":
        kind = "bump" if depth_m < 0 else "hole"
    along_x, along_y, _ = measured.along
    # the angle of the direction, turned by multiples of 180 degrees into -90 to 90
    angle_deg = float(np.degrees(np.arctan2(along_y, along_x) + np.pi / 2) % 180 - 90)
    return Finding(
        id=number,
        kind=kind,
        u_px=measured.u_px,
        v_px=measured.v_px,
        x_mm=float(centre_m[0]) / MM,
        y_mm=float(centre_m[1]) / MM,
        z_mm=float(centre_m[2]) / MM,
        diameter_mm=diameter_m / MM,
        diameter_se_mm=measured.model_diameter_se_m / MM,
        depth_mm=depth_m / MM,
        depth_se_mm=measured.model_depth_se_m * normal_share / MM,
        depth_is_least=measured.depth_is_least,
        sight_depth_mm=axial_depth_m * sight_share / MM,
        volume_mm3=measured.volume_m3 / MM**3,
        points=measured.points,
        score=measured.score,
        length_mm=measured.length_m / MM,
        width_mm=measured.width_m / MM,
        angle_deg=angle_deg,
        length_se_mm=measured.length_se_m / MM,
        width_se_mm=measured.width_se_m / MM,
        angle_se_deg=math.degrees(measured.along_se_rad),
        shape=measured.shape,
        size_from=size_from,
        depth_from=depth_from,
        noise_probability=noise_probability,
        count=detection.count,
    )


def _size_from(detection: Detection, measured: Measurement) -> str:
    """Return the measure of the diameter."""
    if detection.kind == "no return":
        return "area"
    if not math.isfinite(measured.model_diameter_m):
        return "extent"
    return "contour" if measured.model_note else "model"


def _depth_of(evidence: Evidence, detection: Detection, measured: Measurement) -> tuple[float, str]:
    """Return the depth in metres and its measure: the model's, or else the extreme residual."""
    depth_m = measured.model_depth_m
    if detection.kind == "no return":
        return depth_m, "none"
    if not math.isnan(depth_m):
        return depth_m, _size_from(detection, measured)
    residuals_m = evidence.residual_m.reshape(-1)[detection.pixels]
    return float(residuals_m[np.argmax(np.abs(residuals_m))]), "extreme residual"


# ---------------------------------------------------------------- files


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
    is_new = not folder.exists()
    cloud = judged.cloud
    detections = judged.detections
    missing = judged.missing
    figure_of_findings = partial(findings_figure, cloud, judged.evidence, detections, title)
    writers: dict[str, Callable[[Path], object]] = {
        outputs.FINDINGS.name: lambda path: path.write_text(
            csv_text(judged.findings), encoding="utf-8"
        ),
        outputs.FINDINGS_DATA.name: lambda path: path.write_text(
            json_text(judged, about), encoding="utf-8"
        ),
        outputs.ANNOTATED.name: lambda path: _save(path, figure_of_findings()),
        cloud_name: lambda path: path.write_bytes(ply_bytes(cloud, detections)),
    }
    writers.update(beside or {})
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
    table = trials.FINDINGS_OF_CAPTURE
    frame = table.frame(findings)
    return str(frame.to_csv(index=False, float_format=table.digits, lineterminator="\n"))


def json_text(judged: Judged, about: Mapping[str, Any]) -> str:
    """Return the findings with both measures and their standard errors, then ``about``; unknown
    numbers are null."""
    rows = []
    for finding, measured in zip(judged.findings, judged.measurements, strict=True):
        extent = {
            "diameter_mm": measured.extent_diameter_m / MM,
            "centre_mm": measured.extent_centre_m / MM,
        }
        model = {f"{name}_mm": getattr(measured, f"model_{name}_m") / MM for name in MODELLED}
        model["note"] = measured.model_note
        rows.append({**asdict(finding), "extent": extent, "model": model})
    return plain_json({"findings_version": trials.FINDINGS_VERSION, "findings": rows, **about})


def ply_bytes(cloud: Cloud, detections: Sequence[Detection]) -> bytes:
    """Return the valid points (camera frame, metres, float32) as a binary PLY: damage magenta, the
    rest coloured."""
    import trimesh

    if cloud.rgb is None:
        colours = np.full((cloud.valid.size, 3), OTHER_GREY, np.uint8)
    else:
        colours = _bytes(cloud.rgb).reshape(-1, 3)
    for detection in detections:
        colours[detection.pixels] = DAMAGE_RGB
    valid = cloud.valid.reshape(-1)
    points = trimesh.PointCloud(cloud.points_m.reshape(-1, 3)[valid], colors=colours[valid])
    exported: bytes = points.export(file_type="ply")
    return exported


# ---------------------------------------------------------------- pictures

WIDTH_IN = 11.0
HIGHEST_IN = 30.0
DPI = 150
TAKEN = "#ff00ff"
OTHERS = ("#ff9f1c", "#2ec4b6", "#ffee32", "#4cc9f0", "#f94144", "#90be6d", "#bdb2ff")
"""Colours that differ from grey and from one another, also for viewers with red-green blindness.
"""
Box = tuple[float, float, float, float]
"""Left, right, bottom and top ends of axes; down is positive."""


def findings_figure(
    cloud: Cloud, evidence: Evidence, detections: Sequence[Detection], title: str
) -> Figure:
    """Draw the colour image (if known) above the residual in mm; without a pixel grid, draw a plan
    view in mm."""
    has_image = cloud.organised and cloud.rgb is not None
    panels = 2 if has_image else 1
    box = part_box(cloud, np.isfinite(evidence.residual_m))

    def draw(figure: Figure) -> None:
        axes = figure.subplots(panels, 1, squeeze=False)[:, 0]
        if has_image:
            axes[0].imshow(_bytes(cloud.rgb), extent=_edges(cloud), interpolation="nearest")
        picture = _draw_residual(axes[-1], cloud, evidence.residual_m / MM)
        residual_bar(figure, picture, "mm behind (+) or before (−) the surface", ax=list(axes))
        for panel in axes:
            _frame(panel, cloud, box)
            for number, detection in enumerate(detections, start=1):
                _circles(panel, cloud, number, detection)

    return _figure(title, panels * _height_in(box), draw)


def _draw_residual(axes: Axes, cloud: Cloud, residual_mm: np.ndarray) -> ScalarMappable:
    """Draw residuals as an image, or as points without a pixel grid."""
    axes.set_facecolor("0.82")
    style: dict[str, Any] = {"cmap": "RdBu_r", "norm": residual_norm(residual_mm)}
    if cloud.organised:
        return axes.imshow(residual_mm, extent=_edges(cloud), interpolation="nearest", **style)
    judged = np.isfinite(residual_mm)
    x_mm = cloud.points_m[..., 0][judged] / MM
    y_mm = cloud.points_m[..., 1][judged] / MM
    return axes.scatter(
        x_mm,
        y_mm,
        c=residual_mm[judged],
        s=2,
        linewidths=0,
        **style,
    )


def save_blind_map(
    path: Path, cloud: Cloud, missing: MissingReturns, detections: Sequence[Detection]
) -> None:
    """Write a PNG with each pixel's share of frames without a return, the outline, and findings
    without a return."""
    box = part_box(cloud, missing.outline)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        unseen_percent = 100 * missing.unseen
        picture = axes.imshow(
            unseen_percent,
            extent=_edges(cloud),
            interpolation="nearest",
            cmap="Greys",
            vmin=0,
            vmax=100,
        )
        bar = figure.colorbar(picture, ax=axes, shrink=0.6)
        bar.set_label("frames without a return, %", fontsize=8)
        if min(missing.outline.shape) > 1 and not missing.outline.all():
            height, width = missing.outline.shape
            columns = np.arange(width) + cloud.region.col0
            rows = np.arange(height) + cloud.region.row0
            axes.contour(
                columns,
                rows,
                missing.outline,
                levels=[0.5],
                colors="#0070c0",
                linewidths=0.8,
            )
        _frame(axes, cloud, box)
        for number, detection in enumerate(detections, start=1):
            if detection.kind == "no return":
                _circles(axes, cloud, number, detection)

    title = f"{100 * missing.blind:.2g} % of the target's pixels returned nothing"
    _save(path, _figure(title, _height_in(box), draw))


def save_targets(
    path: Path,
    grid: Cloud,
    outlines: Sequence[np.ndarray],
    texts: Sequence[str],
    taken: int,
) -> None:
    """Write a PNG with the colour, amplitude or depth of a grid, outlines (h, w), texts, and
    numbers from 1."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.imshow(view_of_grid(grid), interpolation="nearest")
        axes.set_axis_off()
        colours = iter(OTHERS * 2)
        for number, (outline, text) in enumerate(zip(outlines, texts, strict=True), start=1):
            is_taken = number == taken
            colour = TAKEN if is_taken else next(colours)
            _draw_outline(axes, outline, str(number), colour, 2.4 if is_taken else 1.4)
            choice = "taken" if is_taken else f"--target {number}"
            axes.plot([], [], color=colour, linewidth=3, label=f"{number} ({choice}): {text}")
        figure.legend(loc="outside lower center", fontsize=9, frameon=False)

    height, width = grid.valid.shape
    picture_in = min(WIDTH_IN * 0.97 * height / width, 24.0)
    legend_in = 0.26 * len(outlines)
    _save(path, _figure("", picture_in + legend_in + 0.6, draw))


def _draw_outline(
    axes: Axes,
    outline: np.ndarray,
    number: str,
    colour: str,
    line_width: float,
) -> None:
    """Draw the edge of an outline (h, w) bool, and its number at the pixel that is farthest from
    the edge."""
    import cv2
    from matplotlib.patheffects import withStroke

    height, width = outline.shape
    padded = np.pad(outline, 1)
    columns = np.arange(-1, width + 1)
    rows = np.arange(-1, height + 1)
    axes.contour(
        columns,
        rows,
        padded.astype(float),
        [0.5],
        colors=colour,
        linewidths=line_width,
    )
    distance_px = cv2.distanceTransform(padded.astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    v, u = np.unravel_index(int(distance_px.argmax()), distance_px.shape)
    axes.text(
        float(u),
        float(v),
        number,
        fontsize=22,
        weight="bold",
        ha="center",
        va="center",
        color=colour,
        path_effects=[withStroke(linewidth=4, foreground="black")],
    )


def _figure(title: str, height_in: float, draw: Callable[[Figure], None]) -> Figure:
    from matplotlib.figure import Figure

    size_in = (WIDTH_IN, min(height_in + 0.4, HIGHEST_IN))
    figure = Figure(figsize=size_in, dpi=DPI, layout="compressed")
    figure.suptitle(title, fontsize=10, parse_math=False)  # a file may be called $x$
    draw(figure)
    return figure


def _save(path: Path, figure: Figure) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure).print_png(str(path))


def _height_in(box: Box) -> float:
    left, right, bottom, top = box
    return WIDTH_IN * 0.82 * max(bottom - top, 1e-9) / max(right - left, 1e-9) + 0.5


def part_box(cloud: Cloud, part: np.ndarray) -> Box:
    """Return the box of a part (h, w) bool of the cloud's grid with a margin of a twelfth, inside
    the whole box."""
    left, right, bottom, top = _edges(cloud)
    rows, columns = np.nonzero(part)
    if not cloud.organised or not len(rows):
        return left, right, bottom, top
    first_column = float(columns.min())
    end_column = float(columns.max() + 1)
    first_row = float(rows.min())
    end_row = float(rows.max() + 1)
    margin = max(end_column - first_column, end_row - first_row) / 12.0
    u = left + np.array([first_column - margin, end_column + margin])
    v = top + np.array([end_row + margin, first_row - margin])
    part_left, part_right = np.clip(u, left, right)
    part_bottom, part_top = np.clip(v, top, bottom)
    return float(part_left), float(part_right), float(part_bottom), float(part_top)


def _edges(cloud: Cloud) -> Box:
    """Return the box of a whole cloud: sensor pixels, or millimetres without a grid."""
    if cloud.organised:
        region = cloud.region
        return region.col0 - 0.5, region.col1 - 0.5, region.row1 - 0.5, region.row0 - 0.5
    x_mm = cloud.points_m[..., 0][cloud.valid] / MM
    y_mm = cloud.points_m[..., 1][cloud.valid] / MM
    return float(x_mm.min()), float(x_mm.max()), float(y_mm.max()), float(y_mm.min())


def _frame(axes: Axes, cloud: Cloud, box: Box) -> None:
    """Set the ends and the labels of axes."""
    if cloud.organised:
        unit = "cell" if cloud.projection == "parallel" else "px"
        axes.set(xlabel=f"u, {unit}", ylabel=f"v, {unit}")
    else:
        axes.set(xlabel="x, mm", ylabel="y, mm")
    axes.set(
        xlim=box[:2],
        ylim=box[2:],
        aspect="equal",
        autoscale_on=False,
    )


def parts_of(cloud: Cloud, detection: Detection) -> list[Detection]:
    """Return the connected parts of a finding that has several places, such as joints, largest
    first; any other finding as it is."""
    if detection.count == 1 or not cloud.organised:
        return [detection]
    mask = np.zeros(cloud.valid.shape, np.uint8)
    mask.reshape(-1)[detection.pixels] = 1
    count, labels = cv2.connectedComponents(mask, connectivity=8)
    part_of_pixel = labels.reshape(-1)[detection.pixels]
    parts = [
        replace(detection, pixels=detection.pixels[part_of_pixel == part], count=1)
        for part in range(1, count)
    ]
    return sorted(parts, key=lambda part: -len(part.pixels))


def _circles(axes: Axes, cloud: Cloud, number: int, detection: Detection) -> None:
    """Draw a circle around each part of a finding, with its number beside the first."""
    for index, part in enumerate(parts_of(cloud, detection)):
        label = str(number) if index == 0 else ""
        _circle(axes, cloud, label, part)


def _circle(axes: Axes, cloud: Cloud, label: str, detection: Detection) -> None:
    """Draw a circle around a cluster, with its label at the upper right."""
    from matplotlib.patches import Circle

    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.reason.shape)
        u = columns + cloud.region.col0
        v = rows + cloud.region.row0
        margin = 3.0
    else:
        u, v, _ = (cloud.points_m.reshape(-1, 3)[detection.pixels] / MM).T
        margin = 2.0
    u_centre = 0.5 * float(u.min() + u.max())
    v_centre = 0.5 * float(v.min() + v.max())
    radius = 0.5 * float(max(np.ptp(u), np.ptp(v))) + margin
    circle = Circle((u_centre, v_centre), radius, fill=False, color=TAKEN, linewidth=0.9)
    axes.add_patch(circle)
    corner = (u_centre + 0.71 * radius, v_centre - 0.71 * radius)
    annotation = axes.annotate(
        label,
        corner,
        (1, 1),
        textcoords="offset points",
        bbox={
            "facecolor": "white",
            "edgecolor": "none",
            "alpha": 0.6,
            "pad": 0.4,
        },
        fontsize=7,
        annotation_clip=True,
    )
    # both lie inside the axes: measuring hundreds of them takes longer than drawing them
    circle.set_in_layout(False)
    annotation.set_in_layout(False)


def _bytes(rgb: Any) -> np.ndarray:
    return np.clip(np.nan_to_num(np.asarray(rgb)), 0, 255).astype(np.uint8)


def view_of_grid(grid: Cloud) -> np.ndarray:
    """Return (h, w, 3) bytes: colour, else amplitude, else depth."""
    if grid.rgb is not None and np.isfinite(grid.rgb).any():
        return _bytes(grid.rgb)
    values = -grid.points_m[..., 2]
    if grid.amplitude is not None and np.isfinite(grid.amplitude).any():
        values = np.sqrt(np.maximum(grid.amplitude, 0.0))
    finite = values[np.isfinite(values)]
    low, high = np.quantile(finite, (0.02, 0.98)) if len(finite) else (0.0, 1.0)
    grey = np.clip((values - low) / max(high - low, 1e-9), 0.0, 1.0) * 190.0 + 50.0
    return np.repeat(np.nan_to_num(grey)[..., None], 3, axis=-1).astype(np.uint8)
