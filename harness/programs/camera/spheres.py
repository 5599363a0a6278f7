"""Spheres of a stated diameter in captures: errors of size and form, and their spacing."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.averages.average import RECORDED, average
from detectors.recordings import Recording
from harness.evaluation.intervals import Interval
from harness.inspection.arguments import opened_as, reading_of
from harness.inspection.output import print_notes, print_warnings
from harness.records.schema import Column, Estimate, Table, write_table
from harness.report.blocks import BLUE, INK, command_of, figure, heading, page, paragraph, svg
from harness.stills.spheres import (
    FEWEST_PX,
    STEEPEST_DEG,
    RangeImage,
    SphereFit,
    farthest_m,
    find_spheres,
    range_image,
    student,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM, Cloud
from harness.vocabulary.program import length_m
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.text import many, show

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RULE = (
    f"A sphere is fitted along the rays, to pixels within {STEEPEST_DEG:g} degrees of incidence "
    "and 1.5 to 2.5 pixels inside its silhouette. Size (PS) is the diameter of the best sphere "
    "minus the stated one, form (PF) the width of the shell that holds 99.7 % (VDI/VDE 2634-2) or "
    "95 % (ISO 10360-13) of the points; spacings are those of centres with the stated diameter. "
    "Intervals of 95 % hold the noise that the average keeps, not errors that a whole sphere "
    "shares."
)


@dataclass(frozen=True)
class SphereRow:
    """A sphere in a capture."""

    capture: str
    number: int
    """Number in its capture, nearest first."""
    fit: SphereFit
    name: str = ""
    """Name on a gauge."""

    @property
    def label(self) -> str:
        """Its name."""
        return self.name or f"sphere {self.number}"

    @property
    def centre_mm(self) -> np.ndarray:
        """(3,): centre in the camera's frame."""
        return self.fit.centre_m / MM

    @property
    def size_mm(self) -> Estimate:
        """Error of size, PS."""
        return in_mm(self.fit.size_error_m, self.fit.size_interval_m)


def in_mm(value_m: float, interval_m: Interval) -> Estimate:
    """Return a length with its interval in mm."""
    return Estimate(value_m / MM, interval_m.low / MM, interval_m.high / MM)


SPHERES = Table(
    "spheres",
    "one row per sphere of a capture",
    (
        Column("capture", "capture", "capture", "name of the capture"),
        Column("sphere", "sphere", "label", "name of the sphere; nearest first"),
        Column("x_mm", "", lambda row: row.centre_mm[0], "centre, camera's frame, to the right"),
        Column("y_mm", "", lambda row: row.centre_mm[1], "centre, camera's frame, down"),
        Column("z_mm", "z (mm)", lambda row: row.centre_mm[2], "centre along the axis"),
        Column("size_mm", "PS (mm)", "size_mm", "measured minus stated diameter", interval=True),
        Column(
            "form_mm",
            "PF (mm)",
            lambda row: row.fit.form_error_m(0.997) / MM,
            "shell with 99.7 % of the points, as in VDI/VDE 2634-2",
        ),
        Column(
            "form95_mm",
            "PF 95 % (mm)",
            lambda row: row.fit.form_error_m(0.95) / MM,
            "shell with 95 % of the points, as in ISO 10360-13",
        ),
        Column(
            "scatter_mm",
            "scatter (mm)",
            lambda row: row.fit.scatter_m / MM,
            "root mean square of ranges about the sphere",
        ),
        Column("pixels", "pixels", lambda row: len(row.fit.pixels), "pixels that count", text=str),
        Column(
            "seen_share",
            "seen",
            lambda row: row.fit.seen_share,
            "share of the sphere's pixels, within the limits of incidence and rim, that count",
        ),
    ),
    formats=("csv",),
    left=2,
)


@dataclass(frozen=True)
class SpacingRow:
    """The distance of two spheres' centres."""

    capture: str
    pair: str
    """Names of both."""
    measured_mm: Estimate
    """Distance with its interval."""
    true_mm: float = np.nan
    """Distance on the gauge; NaN if unknown."""

    @property
    def error_mm(self) -> float:
        """Sphere-spacing error, SD; NaN if the distance is unknown."""
        return self.measured_mm.value - self.true_mm


SPACINGS = Table(
    "spacings",
    "one row per pair of spheres",
    (
        Column("capture", "capture", "capture", "name of the capture"),
        Column("pair", "pair", "pair", "names of both spheres"),
        Column("measured_mm", "distance (mm)", "measured_mm", "of their centres", interval=True),
        Column("true_mm", "true (mm)", "true_mm", "of the gauge; empty if unknown"),
        Column("error_mm", "SD (mm)", "error_mm", "sphere-spacing error"),
    ),
    formats=("csv",),
    left=2,
)


def image_of(recording: Recording, cloud: Cloud) -> RangeImage:
    """Return the ranges of an averaged capture. Raises UserError without a pixel grid."""
    if not recording.organised:
        raise UserError(
            f"{recording.name}: spheres are found in depth images",
            legal="a capture on a pixel grid",
        )
    slopes = recording.slopes
    if slopes is None:
        slopes = cloud.points_m[..., :2] / cloud.points_m[..., 2:]
    return range_image(cloud.points_m, slopes)


def spacings(rows: Sequence[SphereRow]) -> list[SpacingRow]:
    """Return the distances of all pairs of spheres of one capture."""
    pairs = []
    for first, second in combinations(rows, 2):
        apart_m = second.fit.centre_m - first.fit.centre_m
        distance_m = float(np.linalg.norm(apart_m))
        direction = apart_m / distance_m
        covariance_m2 = first.fit.covariance_m2 + second.fit.covariance_m2
        sigma_m = float(np.sqrt(direction @ covariance_m2 @ direction))
        fewest = min(len(first.fit.pixels), len(second.fit.pixels))
        half_m = sigma_m * student(fewest - 3)
        interval_m = Interval(distance_m - half_m, distance_m + half_m)
        pair = f"{first.label}, {second.label}"
        pairs.append(SpacingRow(first.capture, pair, in_mm(distance_m, interval_m)))
    return pairs


def run_spheres(options: argparse.Namespace, command: str) -> int:
    """Find and measure spheres in each capture; write spheres.html, the tables and
    provenance.json. Returns 0. Raises UserError if no capture shows one."""
    diameter_m = length_m("--spheres", options.spheres)
    rows: list[SphereRow] = []
    pairs: list[SpacingRow] = []
    drawings = {}
    warnings: list[str] = []
    limit_m = np.inf
    for number, path in enumerate(options.paths):
        recording = opened_as(options.like, [path], options.intrinsics, **reading_of(options))
        cloud = average(recording, RECORDED)
        image = image_of(recording, cloud)
        limit_m = farthest_m(image.pitch_rad, diameter_m / 2)
        fits = find_spheres(image, diameter_m / 2)
        warnings += recording.warnings
        print(f"{recording.name}: {many(cloud.n_frames, 'frame')}, {recording.unit_text}")
        print_notes(recording.notes)
        if not fits:
            warnings.append(
                f"{recording.name}: no sphere of {diameter_m / MM:g} mm was found: one needs "
                f"{FEWEST_PX} pixels with a range, so it must be closer than {limit_m:.2g} m"
            )
            continue
        seen = [SphereRow(recording.name, k, fit) for k, fit in enumerate(fits, start=1)]
        rows += seen
        pairs += spacings(seen)
        drawings[f"capture{number}"] = sphere_picture(f"capture{number}", image, seen)
    if not rows:
        raise UserError(
            warnings[-1], fix="check the diameter and the lens (--intrinsics), or move closer"
        )
    print_warnings(warnings)
    answer = answer_of(rows, diameter_m)
    show([SPHERES.grid(rows, terminal=True)])
    heads = {"true (mm)": "", "SD (mm)": ""}
    if pairs:
        show([SPACINGS.grid(pairs, terminal=True, heads=heads)])
    print(answer)
    write_table(options.out, SPHERES, SPHERES.frame(rows))
    write_table(options.out, SPACINGS, SPACINGS.frame(pairs))
    body: list[Any] = []
    for name in drawings:
        caption = "Range, the silhouettes of the spheres, and residuals of their points."
        body.append(figure(drawings, name, caption))
    body += [heading("Spheres"), SPHERES.grid(rows).html()]
    if pairs:
        body += [heading("Spacings"), SPACINGS.grid(pairs, heads=heads).html()]
    body += [paragraph(RULE), *command_of(command)]
    title = f"Spheres of {diameter_m / MM:g} mm"
    target = options.out / "spheres.html"
    write_text(target, page(title, answer, body, warnings=warnings))
    facts = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "spheres": SPHERES.data(rows),
        "spacings": SPACINGS.data(pairs),
        "warnings": warnings,
    }
    write_json(Path(options.out) / "provenance.json", facts)
    print(f"wrote {target} and the tables")
    return 0


def answer_of(rows: Sequence[SphereRow], diameter_m: float) -> str:
    """Return the errors of size and form as sentences."""
    worst = max(rows, key=lambda row: abs(row.fit.size_error_m))
    forms_mm = [row.fit.form_error_m(0.997) / MM for row in rows]
    counted = f"{many(len(rows), 'sphere')} of {diameter_m / MM:g} mm."
    size = worst.size_mm
    return (
        f"{counted} The largest error of size is {size.value:+.2f} mm (95 %: {size.low:+.2f} to "
        f"{size.high:+.2f}); errors of form reach {max(forms_mm):.2f} mm."
    )


MOST_DRAWN = 6


def sphere_picture(name: str, image: RangeImage, rows: Sequence[SphereRow]) -> str:
    """Return a drawing of a range image with its spheres, and of the residuals of each."""

    def draw(canvas: Figure) -> None:
        shown = rows[:MOST_DRAWN]
        grid = canvas.add_gridspec(2, max(len(shown), 3), height_ratios=(3, 1))
        axes = canvas.add_subplot(grid[0, :])
        seen = image.range_m[np.isfinite(image.range_m)]
        low, high = np.quantile(seen, [0.02, 0.98])
        axes.imshow(image.range_m, cmap="gray_r", vmin=low, vmax=high)
        axes.set(xticks=[], yticks=[], title="range")
        for row in rows:
            _outline(axes, image, row)
        limit_mm = max(3 * max(row.fit.scatter_m for row in rows) / MM, 1e-3)
        for column, row in enumerate(shown):
            beside = canvas.add_subplot(grid[1, column])
            beside.imshow(_residuals_mm(image, row.fit), cmap="RdBu", vmin=-limit_mm, vmax=limit_mm)
            beside.set(xticks=[], yticks=[])
            beside.set_title(f"{row.label}\n±{limit_mm:.2g} mm", fontsize=8)

    return svg(name, (8.6, 7.4), "range image with spheres", draw)


def _outline(axes: Axes, image: RangeImage, row: SphereRow) -> None:
    """Draw a circle about the pixels of a sphere."""
    from matplotlib.patches import Circle

    width = image.range_m.shape[1]
    rows, columns = np.divmod(row.fit.pixels, width)
    away_m = float(np.linalg.norm(row.fit.centre_m))
    radius_px = np.arcsin(row.fit.stated_m / away_m) / image.pitch_rad
    middle = (float(np.ptp(columns) / 2 + columns.min()), float(np.ptp(rows) / 2 + rows.min()))
    axes.add_patch(Circle(middle, radius_px, fill=False, ec=BLUE, lw=1.2))
    above = (middle[0], middle[1] - radius_px - 3)
    box = {"fc": "white", "ec": "none", "alpha": 0.7, "pad": 1}
    axes.annotate(row.label, above, ha="center", va="bottom", fontsize=8, color=INK, bbox=box)


def _residuals_mm(image: RangeImage, fit: SphereFit) -> np.ndarray:
    """Return the residuals of a sphere as the picture of its pixels, NaN beside them."""
    picture = np.full(image.range_m.shape, np.nan)
    picture.ravel()[fit.pixels] = fit.residual_m / MM
    rows, columns = np.divmod(fit.pixels, image.range_m.shape[1])
    return picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
