"""One recording of a solid gauge: all figures of it, their table and page, and what they say for
the camera file."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.averages.average import RECORDED, average
from harness.inspection.arguments import opened_as, reading_of
from harness.inspection.output import print_notes, print_warnings
from harness.programs.camera.camera_file import Stated
from harness.programs.camera.gauge_pockets import (
    POCKETS,
    SEEN,
    PocketSignal,
    answer_of_pockets,
    pocket_rows,
    pocket_signals,
)
from harness.programs.camera.gauge_pose import located
from harness.programs.camera.gauge_range import (
    Blur,
    RangeFit,
    blurred,
    level_pixels,
    range_and_blur,
)
from harness.programs.camera.spheres import (
    RULE,
    SPACINGS,
    SPHERES,
    SpacingRow,
    SphereRow,
    image_of,
    in_mm,
    spacings,
    sphere_picture,
)
from harness.records.schema import Column, Estimate, Table, write_table
from harness.report.blocks import command_of, figure, heading, page, paragraph, svg
from harness.stills.solid_gauge import SolidGauge, corrected, read_solid_gauge
from harness.stills.spheres import (
    NoFit,
    RangeImage,
    SphereFit,
    fit_sphere,
    student,
)
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM, Cloud, rotate_vectors, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.text import many, show

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from scenes.sensor.camera import AnyCamera

WIDTH_10_90 = 2.563
"""Width of a Gaussian edge between 10 and 90 % of its step, in standard deviations."""
WORST_SHOWN_MM = 10.0
"""Residual beyond which the colours end: the outline, where what lies behind is mixed in."""


@dataclass(frozen=True)
class GaugeFigure:
    """A figure of a gauge."""

    figure: str
    where: str
    """Element, or all."""
    unit: str
    value: Estimate
    meaning: str


GAUGE_FIGURES = Table(
    "gauge",
    "one row per figure of a solid gauge",
    (
        Column("figure", "figure", "figure", "name of the figure"),
        Column("where", "where", "where", "element of the gauge, or all"),
        Column("unit", "unit", "unit", "mm, px, 1"),
        Column(
            "value",
            "value",
            "value",
            "with its 95 % interval if known",
            interval=True,
            text=lambda value: value.text(4),
        ),
        Column("meaning", "", "meaning", "meaning of the figure"),
    ),
    formats=("csv",),
    left=3,
)


@dataclass(frozen=True)
class GaugeReading:
    """A gauge in a recording."""

    gauge: SolidGauge
    image: RangeImage
    fit: RangeFit
    blur: Blur | None
    spheres: tuple[SphereRow, ...]
    """Spheres as recorded, without correction of scale and bias."""
    spacings: tuple[SpacingRow, ...]
    """Their distances with those of the gauge."""
    figures: tuple[GaugeFigure, ...]
    pockets: tuple[PocketSignal, ...]
    """Pockets that have pixels."""
    sharp_m: np.ndarray
    """(h, w): range of the gauge without blur."""
    seen_m: np.ndarray
    """(h, w): the same with the fitted blur."""
    frames: int
    """Frames of the recording."""
    residual_mm: np.ndarray
    """(h, w): corrected range minus that of the gauge with the fitted blur."""
    warnings: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def answer(self) -> str:
        """Scale, bias and blur as sentences."""
        percent = 100 * (self.fit.scale - 1)
        scale = self.fit.interval(0)
        bias = in_mm(self.fit.bias_m, self.fit.interval(1))
        low = 100 * (scale.low - 1)
        high = 100 * (scale.high - 1)
        text = (
            f"Range is {percent:+.2f} % off in scale (95 %: {low:+.2f} to {high:+.2f} %) and "
            f"{bias.value:+.2f} mm in bias ({bias.low:+.2f} to {bias.high:+.2f} mm)."
        )
        if self.blur is not None:
            ends = self.blur.interval
            text += (
                f" Edges are blurred by {self.blur.blur_px:.2f} px ({ends.low:.2f} to "
                f"{ends.high:.2f} px), beside the area of a pixel."
            )
        return text

    def stated(self) -> list[Stated]:
        """Return what the gauge says for an empirical camera's file. The offset between units
        becomes the standard error of this unit's range at the gauge."""
        fit = self.fit
        away_m = float(np.linalg.norm(fit.T_camera_gauge[:3, 3]))
        by_both = np.array([away_m, 1.0])
        error_mm = float(np.sqrt(by_both @ fit.covariance @ by_both)) / MM
        scale = fit.interval(0)
        bias = in_mm(fit.bias_m, fit.interval(1))
        of_scale = f"gauge at {away_m:.2f} m, 95 %: {scale.low:.4f} to {scale.high:.4f}"
        of_bias = f"gauge at {away_m:.2f} m, 95 %: {bias.low:.2f} to {bias.high:.2f} mm"
        facts = [
            Stated("range_error", "scale", fit.scale, of_scale),
            Stated("range_error", "bias_mm", bias.value, of_bias),
            Stated("unit", "offset_mm", error_mm, "standard error of range at the gauge"),
        ]
        if self.blur is not None:
            source = f"{self.blur.pixels} pixels at edges of the gauge"
            facts.append(Stated("edge", "blur_px", self.blur.blur_px, source))
        return facts


def read_recording(options: argparse.Namespace) -> GaugeReading:
    """Measure the gauge in the first capture. Raises UserError if it is not recognised or has too
    few pixels."""
    gauge = read_solid_gauge(options.gauge)
    if options.calliper is not None:
        gauge = corrected(gauge, options.calliper)
    recording = opened_as(
        options.like, options.paths[:1], options.intrinsics, **reading_of(options)
    )
    cloud = average(recording, RECORDED)
    image = image_of(recording, cloud)
    T_camera_gauge, how = located(cloud, image, gauge)
    reading = measured(recording.name, cloud, image, gauge, T_camera_gauge)
    notes = (f"{recording.name}: {many(cloud.n_frames, 'frame')}, {recording.unit_text}", how)
    warnings = (*recording.warnings, *reading.warnings)
    return replace(reading, notes=(*notes, *recording.notes), warnings=warnings)


def measured(
    name: str, cloud: Cloud, image: RangeImage, gauge: SolidGauge, T_camera_gauge: np.ndarray
) -> GaugeReading:
    """Measure everything that an averaged recording shows of a gauge near a pose."""
    fit, blur, sharp_m = range_and_blur(image, gauge, T_camera_gauge)
    straight = replace(image, range_m=(image.range_m - fit.bias_m) / fit.scale)
    rows = []
    warnings = []
    for number, (ball, sphere) in enumerate(zip(gauge.spheres, fit.spheres, strict=True), start=1):
        recorded: SphereFit | NoFit = sphere
        if isinstance(sphere, SphereFit):
            ray = sphere.centre_m / np.linalg.norm(sphere.centre_m)
            start_m = sphere.centre_m * fit.scale + ray * fit.bias_m
            recorded = fit_sphere(image, start_m, ball.diameter_mm / 2 * MM)
        if isinstance(recorded, NoFit):
            warnings.append(f"{ball.name} is not measured: {recorded.why}")
            continue
        rows.append(SphereRow(name, number, recorded, name=ball.name))
    pairs = _with_truth(gauge, spacings(rows))
    seen_m = blurred(sharp_m, blur.blur_px if blur else 0.0)
    signals = tuple(pocket_signals(straight, gauge, fit.T_camera_gauge, seen_m))
    figures = [
        *_of_range(fit),
        *_of_edges(blur),
        *_of_surfaces(cloud, straight, gauge, fit),
        *_of_pockets(signals),
    ]
    if fit.birge > 2:
        warnings.append(
            f"the gauge's elements disagree by {fit.birge:.1f} times their noise: fixed pattern, "
            "reflections, or a gauge that is not as its truth says; intervals are widened"
        )
    return GaugeReading(
        gauge=gauge,
        image=image,
        fit=fit,
        blur=blur,
        spheres=tuple(rows),
        spacings=tuple(pairs),
        figures=tuple(figures),
        pockets=signals,
        sharp_m=sharp_m,
        seen_m=seen_m,
        frames=cloud.n_frames,
        residual_mm=(straight.range_m - seen_m) / MM,
        warnings=tuple(warnings),
        notes=(),
    )


def _with_truth(gauge: SolidGauge, pairs: Sequence[SpacingRow]) -> list[SpacingRow]:
    centres_mm = dict(zip((ball.name for ball in gauge.spheres), gauge.centres_mm, strict=True))
    known = []
    for pair in pairs:
        first, second = pair.pair.split(", ")
        true_mm = float(np.linalg.norm(centres_mm[first] - centres_mm[second]))
        known.append(replace(pair, true_mm=true_mm))
    return known


def _of_range(fit: RangeFit) -> Iterator[GaugeFigure]:
    scale = fit.interval(0)
    value = Estimate(fit.scale, scale.low, scale.high)
    yield GaugeFigure("scale of range", "all", "1", value, "measured over true change of range")
    bias = in_mm(fit.bias_m, fit.interval(1))
    meaning = "measured range minus scale times true range"
    yield GaugeFigure("bias of range", "all", "mm", bias, meaning)
    for level, off_m, sigma_m in fit.levels:
        if level.z_m == 0:
            continue
        half_m = student(30) * sigma_m
        value = Estimate(off_m / MM, (off_m - half_m) / MM, (off_m + half_m) / MM)
        meaning = "mean distance behind its place, after correction of scale and bias"
        yield GaugeFigure("level", level.name, "mm", value, meaning)


def _of_edges(blur: Blur | None) -> Iterator[GaugeFigure]:
    if blur is None:
        return
    ends = blur.interval
    value = Estimate(blur.blur_px, ends.low, ends.high)
    meaning = "deviation of the Gaussian that gives edges as captured, beside the area of a pixel"
    yield GaugeFigure("blur at edges", "steps, grooves, pockets", "px", value, meaning)
    wide = Estimate(WIDTH_10_90 * blur.blur_px, WIDTH_10_90 * ends.low, WIDTH_10_90 * ends.high)
    meaning = "edge response from 10 to 90 % of a step"
    yield GaugeFigure("edge width", "steps, grooves, pockets", "px", wide, meaning)
    meaning = "share of pixels with a range at edges, over that beside them"
    fill = Estimate(blur.fill)
    yield GaugeFigure("fill at edges", "steps, grooves, pockets", "1", fill, meaning)


def _of_surfaces(
    cloud: Cloud, straight: RangeImage, gauge: SolidGauge, fit: RangeFit
) -> Iterator[GaugeFigure]:
    """Yield noise of a frame, and the error that all frames share, on the levels."""
    variances_m2 = []
    shared_m2 = []
    normal = rotate_vectors(fit.T_camera_gauge, np.array([0.0, 0.0, 1.0]))
    for level, pixels in level_pixels(straight, gauge, fit.T_camera_gauge):
        point_m = transform_points(fit.T_camera_gauge, np.array([0.0, 0.0, level.z_m]))
        rays = straight.rays.reshape(-1, 3)[pixels]
        off_m = straight.range_m.ravel()[pixels] - (normal @ point_m) / (rays @ normal)
        of_frame_m2 = cloud.variance_m2.ravel()[pixels]
        of_mean_m2 = of_frame_m2 / np.maximum(cloud.count.ravel()[pixels], 1)
        variances_m2.append(np.nanmedian(of_frame_m2))
        shared_m2.append(np.median(off_m**2) * 1.4826**2 - np.nanmean(of_mean_m2))
    if not np.isfinite(variances_m2).any():
        return
    noise_mm = float(np.sqrt(np.nanmedian(variances_m2))) / MM
    meaning = "standard deviation of a pixel's z over frames"
    yield GaugeFigure("temporal noise", "levels", "mm", Estimate(noise_mm), meaning)
    pattern_mm = float(np.sqrt(max(np.nanmedian(shared_m2), 0.0))) / MM
    meaning = "error of range that all frames share, after correction of scale and bias"
    yield GaugeFigure("fixed pattern", "levels", "mm", Estimate(pattern_mm), meaning)


def _of_pockets(signals: Sequence[PocketSignal]) -> Iterator[GaugeFigure]:
    """Yield how much of each pocket's expected depth is measured, and the signal over noise."""
    for signal in signals:
        half = student(signal.degrees) * signal.sigma
        value = Estimate(signal.share, signal.share - half, signal.share + half)
        where = signal.pocket.name
        yield GaugeFigure("depth seen", where, "1", value, "share of its expected depth")
        meaning = f"that share over its standard error; from {SEEN:g} on it counts as seen"
        ratio = Estimate(signal.ratio)
        yield GaugeFigure("signal over noise", where, "1", ratio, meaning)


# ---------------------------------------------------------------- output


def write_reading(options: argparse.Namespace, reading: GaugeReading, command: str) -> None:
    """Print the figures; write gauge.html, the tables and gauge.json."""
    print_warnings(reading.warnings)
    print_notes(reading.notes)
    whole = [row for row in reading.figures if row.where in ("all", "levels") or "," in row.where]
    show([GAUGE_FIGURES.grid(whole, terminal=True)])
    show([SPHERES.grid(reading.spheres, terminal=True)])
    print(reading.answer)
    for table, rows in (
        (GAUGE_FIGURES, reading.figures),
        (SPHERES, reading.spheres),
        (SPACINGS, reading.spacings),
    ):
        write_table(options.out, table, table.frame(rows))
    drawings = {
        "spheres": sphere_picture("spheres", reading.image, reading.spheres),
        "residuals": _residual_picture(reading),
    }
    parts = [row for row in reading.figures if row not in whole]
    body: list[Any] = [
        GAUGE_FIGURES.grid(whole).html(),
        figure(drawings, "residuals", "Corrected range minus the gauge with the fitted blur."),
        heading("Spheres"),
        SPHERES.grid(reading.spheres).html(),
        figure(drawings, "spheres", "Range, spheres, and residuals of their points."),
        paragraph(RULE),
        heading("Spacings"),
        SPACINGS.grid(reading.spacings).html(),
        heading("Steps and pockets"),
        GAUGE_FIGURES.grid(parts).html(),
        *command_of(command),
    ]
    target = options.out / "gauge.html"
    title = f"{options.title} before a gauge"
    write_text(target, page(title, reading.answer, body, warnings=reading.warnings))
    facts = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "T_camera_gauge": reading.fit.T_camera_gauge.tolist(),
        "figures": GAUGE_FIGURES.data(reading.figures),
        "spheres": SPHERES.data(reading.spheres),
        "spacings": SPACINGS.data(reading.spacings),
        "uncertainty_of_gauge": reading.gauge.uncertainty.to_data(),
        "warnings": reading.warnings,
    }
    write_json(options.out / "gauge.json", facts)
    print(f"wrote {target} and the tables")


def write_pockets(options: argparse.Namespace, reading: GaugeReading, camera: AnyCamera) -> None:
    """Print and write which pockets are seen, beside how probably the camera sees each."""
    sharp = replace(reading.image, range_m=reading.sharp_m)
    rows = pocket_rows(
        camera,
        reading.gauge,
        reading.pockets,
        T_camera_gauge=reading.fit.T_camera_gauge,
        view=(sharp, reading.seen_m),
        frames=reading.frames,
        albedo=options.albedo,
    )
    show([POCKETS.grid(rows, terminal=True)])
    print(answer_of_pockets(rows))
    write_table(options.out, POCKETS, POCKETS.frame(rows))


def _residual_picture(reading: GaugeReading) -> str:
    """Return the residuals as a picture of the gauge."""
    from harness.report.clouds import residual_bar, residual_norm

    picture = reading.residual_mm
    rows, columns = np.nonzero(np.isfinite(picture))
    cut = picture[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]

    def draw(canvas: Figure) -> None:
        axes = canvas.subplots()
        drawn = axes.imshow(
            cut, cmap="RdBu_r", norm=residual_norm(cut[np.abs(cut) < WORST_SHOWN_MM])
        )
        axes.set(xticks=[], yticks=[])
        residual_bar(canvas, drawn, "range minus gauge, mm", ax=axes)

    return svg("residuals", (6.5, 5.5), "residuals of the gauge", draw)
