"""The page of one inspection: the verdict, the findings in the picture and in the cloud, the table
by class, and what was judged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup

from detectors.interface import Detection
from harness.records.examples import Scene3d
from harness.report.blocks import command_of, fold, joined, origin_table, tag, template
from harness.report.clouds import (
    SMALL_PX,
    UNJUDGED_RGB,
    css,
    data_url,
    residual_norm,
    residual_rgb,
    signed,
    ticks_within,
)
from harness.report.findings import (
    Finding,
    Judged,
    part_box,
    parts_of,
    probability,
    view_of_grid,
)
from harness.report.view3d import view3d_html
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.text import UNKNOWN_TEXT, Grid

PLAN_PX = 480
"""Longer side of the picture of a cloud without a pixel grid."""
LEAST_RADIUS = 0.012
"""Least radius of a mark, as a share of the picture's longer side."""
MOST_ROWS = 20
"""Most rows of a class that are shown unfolded."""
FEW = 25
"""Up to so many findings the numbers are large."""
DEVIATION = "distance from the surface"
"""Name of the picture of residuals."""


@dataclass(frozen=True)
class PageText:
    """Text of the page besides the findings."""

    title: str
    sentence: str
    """The verdict."""
    conditions: str
    """The capture and the threshold, in a few words."""
    warnings: tuple[str, ...]
    """Doubts about the answer as a whole."""
    classes: Mapping[str, str]
    """Each class of findings, in order, with its meaning."""
    flags: Mapping[str, str]
    """Each flag with its meaning."""
    summary: tuple[tuple[str, str], ...]
    """The figures of the verdict: name and value."""
    judged: tuple[tuple[str, str], ...]
    """What was judged and what not: name and value."""
    facts: tuple[tuple[str, str], ...]
    """How it was judged: name and value."""
    sections: Mapping[str, Markup]
    """Further sections by their headings, in order."""
    files: Mapping[str, str]
    """Further files in the folder, with their content."""
    provenance: Mapping[str, Any]


def inspection_html(judged: Judged, scene: Scene3d, text: PageText) -> str:
    """Return the page as text; it needs no network."""
    turns = tag(
        "iframe",
        srcdoc=view3d_html(scene, text.title),
        kind="turns",
        title="the cloud in three dimensions",
    )
    name, view = best_view(judged)
    first_picture = numbered_picture(judged, view, name)
    deviation = deviation_picture(judged)
    if name == DEVIATION:
        first_picture = deviation
        deviation = Markup("")
    return template("inspection.html").render(
        title=text.title,
        answer=text.sentence,
        warnings=text.warnings,
        conditions=text.conditions,
        picture=first_picture,
        summary=definitions(text.summary),
        deviation=deviation,
        turns=turns,
        tables=joined(class_sections(judged.findings, text.classes)),
        flags=text.flags,
        present_flags=present_flags(judged.findings),
        judged=definitions(text.judged),
        facts=definitions(text.facts),
        sections=text.sections,
        files=text.files,
        closing=fold(
            "Versions and command",
            origin_table(text.provenance),
            *command_of(str(text.provenance.get("command", "not recorded"))),
        ),
    )


# ---------------------------------------------------------------- pictures


@dataclass(frozen=True)
class Picture:
    """A picture of a cloud, of which one pixel is one pixel of the grid, or a square of a plan
    view."""

    rgb: np.ndarray
    """(h, w, 3) uint8."""
    origin: tuple[float, float]
    """Column and row of the upper left corner, in the unit of ``positions``."""
    unit: float
    """Side of a pixel, in that unit."""


def best_view(judged: Judged) -> tuple[str, Picture]:
    """Return the name and the picture of the colour, else of the infrared light, else of the
    deviation."""
    cloud = judged.cloud
    if cloud.organised and cloud.rgb is not None and np.isfinite(cloud.rgb).any():
        return "colour picture", cropped(judged, view_of_grid(cloud))
    if cloud.organised and cloud.amplitude is not None and np.isfinite(cloud.amplitude).any():
        return "infrared picture", cropped(judged, view_of_grid(cloud))
    return DEVIATION, deviation_view(judged)


def deviation_view(judged: Judged) -> Picture:
    """Return the residuals in colours: red behind the surface, blue before it."""
    residual_mm = judged.evidence.residual_m / MM
    if judged.cloud.organised:
        return cropped(judged, residual_rgb(residual_mm, residual_norm(residual_mm)))
    return _plan(judged, residual_mm)


def cropped(judged: Judged, rgb: np.ndarray) -> Picture:
    """Cut the judged area with its surroundings out of a picture of the grid."""
    cloud = judged.cloud
    left, right, bottom, top = part_box(cloud, np.isfinite(judged.evidence.residual_m))
    first_column = int(np.floor(left + 0.5)) - cloud.region.col0
    first_row = int(np.floor(top + 0.5)) - cloud.region.row0
    end_column = int(np.ceil(right + 0.5)) - cloud.region.col0
    end_row = int(np.ceil(bottom + 0.5)) - cloud.region.row0
    part = rgb[first_row:end_row, first_column:end_column]
    corner = (first_column + cloud.region.col0 - 0.5, first_row + cloud.region.row0 - 0.5)
    return Picture(part, corner, 1.0)


def _plan(judged: Judged, residual_mm: np.ndarray) -> Picture:
    """Return the plan view of a cloud without a grid: the largest deviation in each square."""
    cloud = judged.cloud
    is_judged = np.isfinite(residual_mm)
    plan_mm = cloud.points_m[is_judged][:, :2] / MM
    if not len(plan_mm):
        return Picture(np.full((1, 1, 3), UNJUDGED_RGB, np.uint8), (0.0, 0.0), 1.0)
    low_mm = plan_mm.min(axis=0)
    span_mm = np.maximum(np.ptp(plan_mm, axis=0), 1e-6)
    # about four points in a square, so that few squares inside the cloud are empty
    side_mm = max(float(np.sqrt(span_mm.prod() * 4 / len(plan_mm))), span_mm.max() / PLAN_PX)
    columns, rows = np.floor((plan_mm - low_mm) / side_mm).astype(int).T
    image = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    values_mm = residual_mm[is_judged]
    smallest_first = np.argsort(np.abs(values_mm))
    image[rows[smallest_first], columns[smallest_first]] = values_mm[smallest_first]
    rgb = residual_rgb(image, residual_norm(image))
    return Picture(rgb, (float(low_mm[0]), float(low_mm[1])), side_mm)


def numbered_picture(judged: Judged, picture: Picture, name: str) -> Markup:
    """Return a figure with the numbered findings on a picture."""
    height, width = picture.rgb.shape[:2]
    findings = judged.findings
    share = 0.032 if len(findings) <= FEW else 0.02
    font = share * max(width, height)
    marks = []
    for finding, detection in zip(findings, judged.detections, strict=True):
        for index, part in enumerate(parts_of(judged.cloud, detection)):
            mark = _mark(judged.cloud, picture, finding, part, font=font)
            if index > 0:
                mark["id"] = ""
            marks.append(mark)
    return Markup(
        template("findings.svg").render(
            width=width,
            height=height,
            font=round(font, 2),
            image=data_url(picture.rgb),
            sharp=max(width, height) <= SMALL_PX,
            kind="" if len(findings) <= FEW else " many",
            count=len(findings),
            marks=marks,
            name=name,
        )
    )


def _mark(
    cloud: Cloud, picture: Picture, finding: Finding, detection: Detection, font: float
) -> dict[str, Any]:
    """Return the circle around a finding in pixels of the picture, its number's place and its
    text. ``font``: height of the number, which narrow screens enlarge by 1.7."""
    u, v = positions(cloud, detection)
    corner_u, corner_v = picture.origin
    columns = (u - corner_u) / picture.unit
    rows = (v - corner_v) / picture.unit
    height, width = picture.rgb.shape[:2]
    spread = max(float(np.ptp(columns)), float(np.ptp(rows)))
    least = LEAST_RADIUS * max(width, height)
    centre_x = 0.5 * float(columns.min() + columns.max())
    centre_y = 0.5 * float(rows.min() + rows.max())
    radius = max(0.5 * spread + 0.35 * least, least)
    label_x = min(centre_x + 0.75 * radius, width - 1.7 * font)
    label_y = max(centre_y - 0.75 * radius, 1.4 * font)
    return {
        "id": finding.id,
        "kind": class_name(finding.certainty),
        "x": round(centre_x, 2),
        "y": round(centre_y, 2),
        "radius": round(radius, 2),
        "label_x": round(label_x, 2),
        "label_y": round(label_y, 2),
        "text": described_text(finding),
    }


def positions(cloud: Cloud, detection: Detection) -> tuple[np.ndarray, np.ndarray]:
    """Return columns and rows (n,) of a detection's points: pixels of the sensor, or x and y in mm
    without a grid."""
    if cloud.organised:
        rows, columns = np.unravel_index(detection.pixels, cloud.reason.shape)
        return columns + float(cloud.region.col0), rows + float(cloud.region.row0)
    points_mm = cloud.points_m.reshape(-1, 3)[detection.pixels] / MM
    return points_mm[:, 0], points_mm[:, 1]


def described_text(finding: Finding) -> str:
    """Return ``3: hole, 8.3 mm wide, 25.30 mm deep, sure``."""
    parts = [f"{finding.id}: {finding.term or finding.kind}"]
    if np.isfinite(finding.diameter_mm):
        parts.append(f"{finding.diameter_mm:.1f} mm wide")
    if np.isfinite(finding.depth_mm):
        side = "high" if finding.depth_mm < 0 else "deep"
        parts.append(f"{abs(finding.depth_mm):.2f} mm {side}")
    parts.append(finding.certainty)
    return ", ".join(filter(None, parts))


def class_name(certainty: str) -> str:
    """Return a class as one word of the stylesheet."""
    return certainty.replace(" ", "-")


def deviation_picture(judged: Judged) -> Markup:
    """Return the residuals with the findings, and the key of their colours."""
    picture = numbered_picture(judged, deviation_view(judged), DEVIATION)
    residual_mm = judged.evidence.residual_m / MM
    norm = residual_norm(residual_mm)
    limit_mm = float(norm.vmax or 0.0)
    ticks = []
    for value_mm in ticks_within(limit_mm):
        ticks.append((signed(value_mm), round(100 * float(norm(value_mm)), 1)))
    stops = np.linspace(-limit_mm, limit_mm, 256)
    evenly = np.interp(np.linspace(0, 1, 11), np.asarray(norm(stops)), stops)
    colours = [css(rgb) for rgb in residual_rgb(evenly, norm)]
    key = template("residual_key.html").render(ticks=ticks, colours=", ".join(colours))
    return tag("div", picture, Markup(key), kind="deviation")


# ---------------------------------------------------------------- tables


def class_sections(findings: Sequence[Finding], classes: Mapping[str, str]) -> list[Markup]:
    """Return a heading, its meaning and a table for each class that has findings, and a line for
    those that have none."""
    sections = []
    for name, meaning in classes.items():
        members = [finding for finding in findings if finding.certainty == name]
        count = str(len(members)) if members else "none"
        sections.append(tag("h3", f"{name[0].upper()}{name[1:]}: {count}"))
        if members:
            sections.append(tag("p", f"{meaning[0].upper()}{meaning[1:]}.", kind="note"))
            sections.append(findings_grid(members[:MOST_ROWS]).html())
            unshown = members[MOST_ROWS:]
            if unshown:
                sections.append(fold(f"{len(unshown)} more", findings_grid(unshown).html()))
    return sections


def findings_grid(findings: Sequence[Finding]) -> Grid:
    """Return the table of one class."""
    columns: dict[str, Callable[[Finding], str]] = {
        "no.": lambda finding: str(finding.id),
        "what": lambda finding: finding.term or finding.kind,
        "shape": lambda finding: finding.shape,
        "flags": lambda finding: ", ".join(finding.flags.split()).replace("_", " "),
        "width (mm)": _width,
        "depth (mm)": _depth,
        "x (mm)": lambda finding: _number(finding.x_mm, 1),
        "y (mm)": lambda finding: _number(finding.y_mm, 1),
        "z (mm)": lambda finding: _number(finding.z_mm, 1),
        "score": lambda finding: f"{finding.score:.2f}",
        "probability of noise": lambda finding: probability(finding.noise_probability),
    }
    rows = [[text(finding) for text in columns.values()] for finding in findings]
    return Grid.of(columns, rows, left=4, kind="findings")


def _width(finding: Finding) -> str:
    """Return the diameter, or length and width of a long finding."""
    if finding.is_long:
        return f"{finding.length_mm:.1f} × {finding.width_mm:.1f}"
    return _with_error(finding.diameter_mm, finding.diameter_se_mm, 1)


def _depth(finding: Finding) -> str:
    return _with_error(finding.depth_mm, finding.depth_se_mm, 2)


def _with_error(value: float, standard_error: float, digits: int) -> str:
    """Return ``8.3 ± 0.2``, without the error where it is unknown."""
    if not np.isfinite(standard_error):
        return _number(value, digits)
    return f"{_number(value, digits)}\u00a0±\u00a0{standard_error:.{digits}f}"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if np.isfinite(value) else UNKNOWN_TEXT


def present_flags(findings: Iterable[Finding]) -> set[str]:
    """Return the flags that some finding has."""
    return {flag for finding in findings for flag in finding.flags.split()}


def definitions(rows: Iterable[tuple[str, str]]) -> Markup:
    """Return names and values as a table of two columns."""
    lines = [tag("tr", tag("th", name, scope="row"), tag("td", value)) for name, value in rows]
    return tag("table", tag("tbody", joined(lines)), kind="prov")
