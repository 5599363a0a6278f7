"""Compares a declared drilled board with a real capture of it: noise, fixed pattern, hole depths
and detections.

Every set-up of an experiment is simulated and, if the capture was aligned to the colour camera,
resampled to its pixels. The same analysis is applied to both around each declared hole: a
quadratic surface is fitted to a ring around it, and the hole's peak is the largest deviation
behind that surface near its centre. Detectors see whole images. No parameter is fitted: set-ups
are declared, and all of them are shown.

Not modelled: objects on the board, the board's relief, and the maker's alignment between two
surfaces (here the depth image is interpolated linearly where the board's plane projects to)."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy import ndimage

from detectors import load_detector
from detectors.averages.average import AverageConfig, average
from harness.evaluation.match import match
from harness.experiment.load import load_experiment
from harness.experiment.schema import ExperimentConfig, Point
from harness.programs.scorecard.figures import BESIDE, Beside
from harness.records.schema import write_table
from harness.report.blocks import COLOURS, command_of, figure, heading, note, page, paragraph, svg
from harness.stills.statistics import Reading, jackknifed, mean_of, temporal_sigma_m
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM, Cloud, Lens, invert, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.text import show
from scenes.render.cache import cached_view
from scenes.sensor.camera import AnyCamera, camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from detectors.recordings import Recording

PEAK_MM = 6.0
RING_MM = (6.5, 13.5)
"""Distances from a hole's centre on the board: the largest for its peak, and the radii of the ring
around it."""
OFF_RING = 4.0
"""Robust standard deviations beyond which a ring's pixel is excluded, since it belongs to an
object such as a tag."""
PATTERN_PX = (3, 6, 12)
ANGLES_DEG = (0, 20, 35, 60)
CLOSE = 0.3  # largest difference of a ratio from 1 that counts as agreement
HOW = (
    "The board is declared, its view is rendered with light between its surfaces, the camera is "
    "simulated from its unchanged file, and the frames are resampled to the capture's pixels. The "
    "same analysis is applied to both: a quadratic surface is fitted to a ring of 6.5 to 13.5 mm "
    "around each hole, and the hole's peak is the largest deviation from it within 6 mm of the "
    "centre. No other parameter is fitted. Not simulated: objects on the board, its relief, and "
    "the maker's treatment of pixels between surfaces. Detectors see whole images, at one "
    "threshold."
)
CAPTION = (
    "Peak of each hole behind the face around it. Means over holes have Student's 95 % intervals; "
    "temporal deviations have those of a jackknife over frames."
)
Readings = dict[tuple[str, str, str], tuple[Reading, int]]
"""Readings with their numbers of pixels or holes, by quantity, condition and unit."""


@dataclass(frozen=True)
class Image:
    """The pixels on which board and capture are compared: their lens, and the frames of board and
    depth camera."""

    lens: Lens
    T_image_board: np.ndarray
    T_image_depth: np.ndarray

    @cached_property
    def rays(self) -> np.ndarray:
        """The rays (h, w, 3) of the pixels, with z = 1."""
        return np.concatenate(
            [self.lens.region_slopes(self.lens.whole), np.ones((*self.lens.whole.shape, 1))],
            axis=-1,
        )

    @cached_property
    def plan_mm(self) -> np.ndarray:
        """The points (h, w, 2) where each pixel's ray meets the board's plane, in the board's
        frame."""
        T_board_image = invert(self.T_image_board)
        rays = self.rays @ T_board_image[:3, :3].T
        start = T_board_image[:3, 3]
        return np.asarray((start[:2] - rays[..., :2] * (start[2] / rays[..., 2:])) / MM)

    def resampled(self, z_m: np.ndarray, camera: AnyCamera) -> np.ndarray:
        """Return frames (n, h, w) of the depth camera, aligned to this image, with z in whole
        steps of its output."""
        plane = np.concatenate([self.plan_mm * MM, np.zeros((*self.lens.whole.shape, 1))], axis=-1)
        in_depth = transform_points(invert(self.T_image_depth) @ self.T_image_board, plane)
        u, v = np.moveaxis(camera.nominal_lens.project(in_depth).astype(np.float32), -1, 0)
        depth_per_z = (
            Image(camera.nominal_lens, np.eye(4), np.eye(4)).rays @ self.T_image_depth[2, :3]
        )
        moved = [(z * depth_per_z + self.T_image_depth[2, 3]).astype(np.float32) for z in z_m]
        remapped = [cv2.remap(z, u, v, cv2.INTER_LINEAR, borderValue=float("nan")) for z in moved]
        return np.asarray(np.round(np.stack(remapped) / camera.z_step_m) * camera.z_step_m)


def image_of(target: TargetConfig, camera: AnyCamera, lens: Lens | None) -> Image:
    """Return the image to compare: the depth camera's own if there is no capture or the capture
    has its size, otherwise that of the camera's colour camera. Raises UserError if the camera's
    file has no colour camera."""
    depth_lens = camera.nominal_lens
    T_depth_board = target.pose.T_camera_board
    if lens is None or (lens.width, lens.height) == (depth_lens.width, depth_lens.height):
        return Image(lens or depth_lens, T_depth_board, np.eye(4))
    colour = getattr(camera, "colour", None)
    if colour is None:
        problem = (
            f"the capture has {lens.width} x {lens.height} pixels, {camera.name} has "
            f"{depth_lens.width} x {depth_lens.height}"
        )
        legal = (
            "the camera's own depth images, or images aligned to a colour camera that its file "
            "places"
        )
        raise UserError(problem, legal=legal)
    lens = (
        lens if any(lens.distortion) else replace(lens, distortion=tuple(colour.distortion.value))
    )
    return Image(lens, colour.T_colour_depth @ T_depth_board, colour.T_colour_depth)


def measured(
    z_m: np.ndarray,
    image: Image,
    target: TargetConfig,
    config: ExperimentConfig,
    detectors: dict[str, dict[str, Any]],
) -> tuple[Readings, np.ndarray]:
    """Measure frames (n, h, w) on the image's pixels; ``detectors`` maps names to settings.
    Returns readings and the holes' peaks in mm (n,), NaN for holes that are not entirely in view.
    Raises UserError if no hole is in view."""
    cloud = _cloud(z_m, image)
    noises = []
    centres, (height, width) = (
        np.array([hole.centre_mm for hole in target.holes]),
        image.lens.whole.shape,
    )
    peaks = np.full(len(centres), np.nan)
    patterns: dict[int, list[np.ndarray]] = {size: [np.zeros(0)] for size in PATTERN_PX}
    for number, centre in enumerate(centres):
        rows, columns = np.nonzero(np.linalg.norm(image.plan_mm - centre, axis=-1) < RING_MM[1])
        if (
            not rows.size
            or min(*rows, *columns) == 0
            or rows.max() == height - 1
            or columns.max() == width - 1
        ):
            continue
        cut = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
        plan = image.plan_mm[cut] - centre
        z = cloud.points_m[*cut, 2]
        from_centre, (x, y) = np.linalg.norm(plan, axis=-1), np.moveaxis(plan, -1, 0)
        ring = (from_centre > RING_MM[0]) & (from_centre < RING_MM[1]) & np.isfinite(z)
        basis = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)
        weight = np.ones(int(ring.sum()))
        for _ in range(10):
            surface = np.linalg.lstsq(basis[ring] * weight[:, None], z[ring] * weight, rcond=None)[
                0
            ]
            off = np.abs(z[ring] - basis[ring] @ surface)
            weight = (off <= OFF_RING * 1.4826 * np.median(off)).astype(float)
        ring[ring] = weight > 0
        residual_mm = (z - basis @ surface) / MM
        peaks[number] = float(np.nanmax(residual_mm[from_centre < PEAK_MM]))
        noises.append(z_m[:, *cut][:, ring])
        for size, pattern in patterns.items():
            is_inside = ndimage.uniform_filter(ring.astype(float), size) > 1 - 1e-6
            pattern.append(
                ndimage.uniform_filter(np.where(ring, residual_mm, 0.0), size)[is_inside]
            )
    if not noises:
        raise UserError(
            "no hole is in view together with the face around it", fix="check the declared pose"
        )
    flat = np.concatenate(noises, axis=1)[:, None]
    in_view = np.isfinite(peaks)
    angles = _angles_deg(target)
    noise = jackknifed(flat, lambda z: temporal_sigma_m(z) / MM)
    readings: Readings = {("temporal deviation", "on the face", "mm"): (noise, flat.shape[2])}
    for size, parts in patterns.items():
        values = np.concatenate(parts)
        if values.size:
            condition = f"means over {size} x {size} px"
            readings["fixed pattern", condition, "mm"] = Reading(float(values.std())), values.size
    for low, high in (*pairwise(ANGLES_DEG), (0, 90)):
        condition = "all" if high == 90 else f"{low} to {high} degrees off the axis"
        chosen = peaks[(angles >= low) & (angles < high) & in_view]
        readings["peak of a hole", condition, "mm"] = mean_of(chosen), chosen.size
    for name, settings in detectors.items():
        detector = load_detector(name, settings)
        findings = detector.find(cloud, detector.analyse(cloud), config.threshold.k or 0.0)
        at_mm = np.array(
            [image.plan_mm.reshape(-1, 2)[spot.pixels].mean(axis=0) for spot in findings]
        ).reshape(-1, 2)
        hits = len(match(centres[in_view], at_mm, config.matching.radius_mm))
        readings["share of holes found", name, ""] = (
            Reading(hits / int(in_view.sum())),
            int(in_view.sum()),
        )
    return readings, peaks


def _angles_deg(target: TargetConfig) -> np.ndarray:
    """Return the angle (n,) of each hole from the depth camera's axis."""
    centres_m = transform_points(
        target.pose.T_camera_board, np.array([[*hole.centre_m, 0.0] for hole in target.holes])
    )
    return np.degrees(np.arctan2(np.linalg.norm(centres_m[:, :2], axis=-1), centres_m[:, 2]))


def _cloud(z_m: np.ndarray, image: Image) -> Cloud:
    """Return the average of frames as a cloud for detectors."""
    count = np.isfinite(z_m).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nansum(z_m, axis=0) / count
        variance = np.nansum((z_m - z) ** 2, axis=0) / np.where(count > 1, count - 1, np.nan)
    reason = (count == 0).astype(np.uint8)
    return Cloud(
        image.rays * z[..., None],
        reason,
        count,
        variance,
        image.lens.whole,
        MM,
        len(z_m),
        lens=image.lens,
    )


def run_board(options: argparse.Namespace, recording: Recording | None, command: str) -> int:
    """Compare and print; write capture.csv, capture.html and provenance.json. Returns 0. Raises
    UserError if the experiment declares no board in front of a simulated camera, or if the capture
    cannot be compared with it."""
    experiment = load_experiment(options.board)
    points = list({point.frames_key: point for point in experiment.points}.values())
    detectors = {
        point.config.detector.name: point.config.detector.settings for point in experiment.points
    }
    config = points[0].config
    source = points[0].config.simulated
    target = source.target
    if not isinstance(target, TargetConfig) or not target.holes or config.threshold.k is None:
        problem = (
            f"{options.board}: declares no drilled board in front of a simulated camera, or no "
            "threshold k"
        )
        legal = "source.kind: simulated, source.target.name: custom with holes, threshold: {k: ...}"
        raise UserError(problem, legal=legal)
    camera = camera_of(source.camera)
    frames = config.capture.frames
    remarks = []
    rows = []
    image = image_of(target, camera, recording.lens if recording else None)
    judged = {}
    if recording is not None:
        left_out = {frame.name: frame.why for frame in average(recording, AverageConfig()).left_out}
        remarks = [f"{name} is left out: {why}" for name, why in left_out.items()]
        z_m = np.stack(
            [frame.z_m for frame in recording.frames() if frame.name not in left_out]
        ).astype(float)
        frames = len(z_m)
        judged["capture"] = measured(z_m, image, target, config, detectors)
    for point in points:
        label = point.variant.split(", detector=")[0]
        judged[label] = measured(
            _simulated(point, image, frames, options), image, target, config, detectors
        )
        real = judged["capture"][0] if recording else {}
        for key, (value, count) in judged[label][0].items():
            recorded = real[key][0] if key in real else Reading(float("nan"))
            rows.append(Beside(label, *key, count, recorded, value))
        print(f"simulated: {label}", flush=True)
    answer = (
        _answer(rows) if recording else "No capture is given, so there is nothing to compare with."
    )
    print("\n".join([answer, *remarks]))
    drawn = svg(
        "peaks", (7.2, 4.4), "Peaks of the holes", lambda canvas: _draw(canvas, target, judged)
    )
    body = [
        figure({"peaks": drawn}, "peaks", CAPTION),
        heading("All numbers"),
        BESIDE.grid(rows).html(),
    ]
    under = [*map(note, remarks), paragraph(f"{frames} frames of each set-up. {HOW}")]
    title = f"{config.title or config.name} compared with the simulated {camera.title}"
    show([BESIDE.grid(rows)])
    write_table(options.out, BESIDE, BESIDE.frame(rows))
    write_text(
        options.out / "capture.html", page(title, answer, [*body, *command_of(command)], under)
    )
    files = [str(path) for path in recording.files] if recording else []
    origin = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "experiment": experiment.digest,
        "files": files,
    }
    write_json(options.out / "provenance.json", origin)
    print(f"wrote {options.out / 'capture.html'}")
    return 0


def _simulated(point: Point, image: Image, frames: int, options: argparse.Namespace) -> np.ndarray:
    """Return frames (n, h, w) of a set-up on the image's pixels."""
    source = point.config.simulated
    camera = camera_of(source.camera)
    target = source.target.declare().at_wavelength(camera.optics.wavelength_nm)
    view, _ = cached_view(target, camera.optics, source.render, options.out / ".cache" / "renders")
    unit = SimulatedUnit(camera, source.camera, view)
    z_m = np.full((frames, *camera.nominal_lens.whole.shape), np.nan)
    region = unit.region.within(camera.nominal_lens.whole)
    for number, frame in enumerate(unit.capture(frames, point.config.seed, "board").frames()):
        z_m[number, *region] = frame.z_m
    return z_m if np.array_equal(image.T_image_depth, np.eye(4)) else image.resampled(z_m, camera)


def _answer(rows: list[Beside]) -> str:
    """Return a sentence that names the set-up closest to the capture and its figures that
    differ."""
    ratios: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.measured.value > 0 and np.isfinite(row.simulated.value):
            ratios.setdefault(row.where, {})[f"{row.quantity}, {row.at}"] = (
                row.simulated.value / row.measured.value
            )
    off = {
        where: {k: r for k, r in ratio.items() if abs(r - 1) > CLOSE}
        for where, ratio in ratios.items()
    }
    best = min(
        off,
        key=lambda where: (len(off[where]), sum(abs(np.log(r)) for r in ratios[where].values())),
    )
    share = (
        f"{len(ratios[best]) - len(off[best])} of {len(ratios[best])} figures within "
        f"{100 * CLOSE:.0f} %"
    )
    other_ratios = "".join(
        f"; {quantity}: {ratio:.2f} of the capture's" for quantity, ratio in off[best].items()
    )
    return f"Of {len(ratios)} set-ups, {best} is closest: {share} of the capture{other_ratios}."


def _draw(
    figure: Canvas, target: TargetConfig, judged: dict[str, tuple[Readings, np.ndarray]]
) -> None:
    """Draw the peaks of the holes against their angle from the depth camera's axis."""
    axes = figure.subplots()
    for number, (label, (_, peaks_mm)) in enumerate(judged.items()):
        colour, size = ("black", 60) if label == "capture" else (COLOURS[number % len(COLOURS)], 10)
        marker = "+" if label == "capture" else "o"
        axes.scatter(_angles_deg(target), peaks_mm, s=size, c=colour, marker=marker, label=label)
    axes.set_xlabel("angle from the depth camera's axis / degrees")
    axes.set_ylabel("peak behind the face / mm")
    axes.legend(fontsize=7)
