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
from harness.vocabulary.geometry import MM, Cloud, Lens, invert, rays_of, transform_points
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.text import show
from scenes.render.cache import cached_view
from scenes.sensor.camera import AnyCamera, camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

    from detectors.recordings import Recording

PEAK_MM = 6.0  # largest distance of a hole's peak from the hole's centre on the board
RING_MM = (6.5, 13.5)  # radii of the ring around a hole to which the surface is fitted
# robust standard deviations beyond which a ring's pixel is excluded, since it belongs to an object
# such as a tag
OFF_RING = 4.0
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
    """The pixels on which board and capture are compared."""

    lens: Lens
    T_image_board: np.ndarray
    """Pose (4, 4) of the board in the image's frame."""
    T_image_depth: np.ndarray
    """Pose (4, 4) of the depth camera in the image's frame."""

    @cached_property
    def rays(self) -> np.ndarray:
        """The rays (h, w, 3) of the pixels, with z = 1."""
        slopes = self.lens.region_slopes(self.lens.whole)
        return rays_of(slopes)

    @cached_property
    def plan_mm(self) -> np.ndarray:
        """The points (h, w, 2) where each pixel's ray meets the board's plane, in the board's
        frame."""
        T_board_image = invert(self.T_image_board)
        rays = self.rays @ T_board_image[:3, :3].T
        start = T_board_image[:3, 3]
        length = start[2] / rays[..., 2:]
        return np.asarray((start[:2] - rays[..., :2] * length) / MM)

    def resampled(self, z_m: np.ndarray, camera: AnyCamera) -> np.ndarray:
        """Return frames (n, h, w) of the depth camera, aligned to this image, with z in whole
        steps of its output."""
        on_face = np.zeros((*self.lens.whole.shape, 1))
        plane = np.concatenate([self.plan_mm * MM, on_face], axis=-1)
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
    if not any(lens.distortion):
        lens = replace(lens, distortion=tuple(colour.distortion.value))
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
    centres = np.array([hole.centre_mm for hole in target.holes])
    peaks = np.full(len(centres), np.nan)
    patterns: dict[int, list[np.ndarray]] = {size: [np.zeros(0)] for size in PATTERN_PX}
    for number, centre in enumerate(centres):
        cut = _cut_around(image, centre)
        if cut is None:
            continue
        plan = image.plan_mm[cut] - centre
        residual_mm, ring = _residual_mm(plan, cloud.points_m[*cut, 2])
        is_centre = np.linalg.norm(plan, axis=-1) < PEAK_MM
        peaks[number] = float(np.nanmax(residual_mm[is_centre]))
        noises.append(z_m[:, *cut][:, ring])
        for size, pattern in patterns.items():
            is_inside = ndimage.uniform_filter(ring.astype(float), size) > 1 - 1e-6
            smooth_mm = ndimage.uniform_filter(np.where(ring, residual_mm, 0.0), size)
            pattern.append(smooth_mm[is_inside])
    if not noises:
        raise UserError(
            "no hole is in view together with the face around it", fix="check the declared pose"
        )
    flat = np.concatenate(noises, axis=1)[:, None]
    in_view = np.isfinite(peaks)
    angles = angles_deg(target)
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
        plan = image.plan_mm.reshape(-1, 2)
        found_mm = [plan[spot.pixels].mean(axis=0) for spot in findings]
        hits = match(centres[in_view], np.reshape(found_mm, (-1, 2)), config.matching.radius_mm)
        holes = int(in_view.sum())
        readings["share of holes found", name, ""] = Reading(len(hits) / holes), holes
    return readings, peaks


def _cut_around(image: Image, centre_mm: np.ndarray) -> tuple[slice, slice] | None:
    """Return the rows and columns of the ring around a hole and of what is in it; None if they
    reach the image's rim."""
    in_reach = np.linalg.norm(image.plan_mm - centre_mm, axis=-1) < RING_MM[1]
    rows, columns = np.nonzero(in_reach)
    height, width = in_reach.shape
    if not rows.size or rows.min() == 0 or columns.min() == 0:
        return None
    if rows.max() == height - 1 or columns.max() == width - 1:
        return None
    row_slice = slice(rows.min(), rows.max() + 1)
    return row_slice, slice(columns.min(), columns.max() + 1)


def _residual_mm(plan_mm: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return z (h, w) minus the quadratic surface through the ring around a hole, in mm, and the
    ring's pixels (h, w) bool that count. ``plan_mm`` (h, w, 2) is relative to the hole."""
    x, y = np.moveaxis(plan_mm, -1, 0)
    from_centre = np.linalg.norm(plan_mm, axis=-1)
    ring = (from_centre > RING_MM[0]) & (from_centre < RING_MM[1]) & np.isfinite(z)
    basis = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)
    weight = np.ones(int(ring.sum()))
    for _ in range(10):
        design = basis[ring] * weight[:, None]
        surface = np.linalg.lstsq(design, z[ring] * weight, rcond=None)[0]
        off = np.abs(z[ring] - basis[ring] @ surface)
        weight = (off <= OFF_RING * 1.4826 * np.median(off)).astype(float)
    ring[ring] = weight > 0
    return (z - basis @ surface) / MM, ring


def angles_deg(target: TargetConfig) -> np.ndarray:
    """Return the angle (n,) of each hole from the depth camera's axis."""
    on_board_m = np.array([[*hole.centre_m, 0.0] for hole in target.holes])
    centres_m = transform_points(target.pose.T_camera_board, on_board_m)
    from_axis_m = np.linalg.norm(centres_m[:, :2], axis=-1)
    return np.degrees(np.arctan2(from_axis_m, centres_m[:, 2]))


def _cloud(z_m: np.ndarray, image: Image) -> Cloud:
    """Return the average of frames as a cloud for detectors."""
    count = np.isfinite(z_m).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nansum(z_m, axis=0) / count
        degrees = np.where(count > 1, count - 1, np.nan)
        variance = np.nansum((z_m - z) ** 2, axis=0) / degrees
    return Cloud(
        points_m=image.rays * z[..., None],
        reason=(count == 0).astype(np.uint8),
        count=count,
        variance_m2=variance,
        region=image.lens.whole,
        z_step_m=MM,
        n_frames=len(z_m),
        lens=image.lens,
    )


def run_board(options: argparse.Namespace, recording: Recording | None, command: str) -> int:
    """Compare and print; write capture.csv, capture.html and provenance.json. Returns 0. Raises
    UserError if the experiment declares no board in front of a simulated camera, or if the capture
    cannot be compared with it."""
    experiment = load_experiment(options.board).at_stated_values()
    points = list({point.frames_key: point for point in experiment.points}.values())
    detectors = {
        point.config.detector.name: point.config.detector.settings for point in experiment.points
    }
    config = points[0].config
    target = _drilled(config, options)
    camera = camera_of(config.simulated.camera)
    image = image_of(target, camera, recording.lens if recording else None)
    frames = config.capture.frames
    remarks: list[str] = []
    judged: dict[str, tuple[Readings, np.ndarray]] = {}
    if recording is not None:
        z_m, remarks = _captured(recording)
        frames = len(z_m)
        judged["capture"] = measured(z_m, image, target, config, detectors)
    real: Readings = judged["capture"][0] if recording else {}
    rows = []
    for point in points:
        label = point.variant.split(", detector=")[0]
        z_m = _simulated(point, image, frames, options)
        judged[label] = measured(z_m, image, target, config, detectors)
        rows += _beside(label, judged[label][0], real)
        print(f"simulated: {label}", flush=True)
    answer = "No capture is given, so there is nothing to compare with."
    if recording:
        answer = _answer(rows)
    print("\n".join([answer, *remarks]))
    title = "Peaks of the holes"
    drawn = svg("peaks", (7.2, 4.4), title, lambda canvas: _draw(canvas, target, judged))
    body = [
        figure({"peaks": drawn}, "peaks", CAPTION),
        heading("All numbers"),
        BESIDE.grid(rows).html(),
    ]
    under = [*map(note, remarks), paragraph(f"{frames} frames of each set-up. {HOW}")]
    title = f"{config.title or config.name} compared with the simulated {camera.title}"
    show([BESIDE.grid(rows)])
    write_table(options.out, BESIDE, BESIDE.frame(rows))
    body += command_of(command)
    write_text(options.out / "capture.html", page(title, answer, body, under))
    files = [path.as_posix() for path in recording.files] if recording else []
    origin = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "experiment": experiment.digest,
        "files": files,
    }
    write_json(options.out / "provenance.json", origin)
    print(f"wrote {options.out / 'capture.html'}")
    return 0


def _drilled(config: ExperimentConfig, options: argparse.Namespace) -> TargetConfig:
    """Return the drilled board of an experiment. Raises UserError if it declares none."""
    target = config.simulated.target
    if isinstance(target, TargetConfig) and target.holes and config.threshold.k is not None:
        return target
    problem = (
        f"{options.board}: declares no drilled board in front of a simulated camera, or no "
        "threshold k"
    )
    legal = "source.kind: simulated, source.target.name: custom with holes, threshold: {k: ...}"
    raise UserError(problem, legal=legal)


def _captured(recording: Recording) -> tuple[np.ndarray, list[str]]:
    """Return the frames (n, h, w) of a capture, and which were left out."""
    left_out = {frame.name: frame.why for frame in average(recording, AverageConfig()).left_out}
    taken = [frame.z_m for frame in recording.frames() if frame.name not in left_out]
    remarks = [f"{name} is left out: {why}" for name, why in left_out.items()]
    return np.stack(taken).astype(float), remarks


def _beside(label: str, simulated: Readings, real: Readings) -> list[Beside]:
    """Return the rows of a set-up's readings, beside those of the capture."""
    rows = []
    for key, (value, count) in simulated.items():
        quantity, condition, unit = key
        rows.append(
            Beside(
                where=label,
                quantity=quantity,
                at=condition,
                unit=unit,
                pixels=count,
                measured=real[key][0] if key in real else Reading(float("nan")),
                simulated=value,
            )
        )
    return rows


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
    off: dict[str, dict[str, float]] = {}
    for row in rows:
        if row.measured.value > 0 and np.isfinite(row.simulated.value):
            figure = f"{row.quantity}, {row.at}"
            ratio = row.simulated.value / row.measured.value
            ratios.setdefault(row.where, {})[figure] = ratio
            far_off = off.setdefault(row.where, {})
            if abs(ratio - 1) > CLOSE:
                far_off[figure] = ratio

    def distance(set_up: str) -> tuple[int, float]:
        return len(off[set_up]), sum(abs(np.log(ratio)) for ratio in ratios[set_up].values())

    best = min(off, key=distance)
    agreeing = len(ratios[best]) - len(off[best])
    share = f"{agreeing} of {len(ratios[best])} figures within {100 * CLOSE:.0f} %"
    differing = [f"; {name}: {ratio:.2f} of the capture's" for name, ratio in off[best].items()]
    answer = f"Of {len(ratios)} set-ups, {best} is closest: {share} of the capture"
    return f"{answer}{''.join(differing)}."


def _draw(
    figure: Canvas, target: TargetConfig, judged: dict[str, tuple[Readings, np.ndarray]]
) -> None:
    """Draw the peaks of the holes against their angle from the depth camera's axis."""
    axes = figure.subplots()
    for number, (label, (_, peaks_mm)) in enumerate(judged.items()):
        look: dict[str, Any] = {"s": 10, "c": COLOURS[number % len(COLOURS)], "marker": "o"}
        if label == "capture":
            look = {"s": 60, "c": "black", "marker": "+"}
        axes.scatter(angles_deg(target), peaks_mm, label=label, **look)
    axes.set_xlabel("angle from the depth camera's axis / degrees")
    axes.set_ylabel("peak behind the face / mm")
    axes.legend(fontsize=7)
