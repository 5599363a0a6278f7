"""A real static capture beside the simulation of the planes and straight edges in it.

Nothing is fitted to make the two agree: the camera's file is used as it stands, with the capture's own lens; planes are
fitted to the capture and simulated in closed form, with one albedo for all surfaces. Not simulated: curved things,
light that met more than one surface, the surfaces' own relief and texture. Where the true edge lies is not known to
better than the gap, so widths of pixels without a range and of flying pixels are compared, and not the erosion.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from detectors.recordings import Recording
from detectors.recordings.depth_images import read_picture
from harness.inspection.arguments import opened
from harness.report.blocks import COLOURS, plain, svg, template
from harness.scorecard import bench
from harness.scorecard.bench import JITTER, NOISE, PATTERNED, SEED, Reading, jackknifed, mean_of
from harness.scorecard.figures import BESIDE, Beside
from harness.scorecard.quantities import jitter_of
from harness.tables.schema import write_table
from harness.tables.text import show
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import MM, Lens, Region
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.optics import NoiseFreeView
from scenes.sensor.camera import (
    AnyCamera,
    CameraConfig,
    EffectsConfig,
    camera_names,
    camera_of,
    guessed_precision,
    load_camera,
)
from scenes.sensor.source import SimulatedUnit

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

LEAST_FRAMES = 4
TOLERANCE_M = 8 * MM
"""A point this near to a plane is on it: a nominal lens bows real walls by 3 mm rms."""
LEAST_PLANE_PX = 2000
EDGE_PX = 3
"""Pixels nearer to a plane's rim are left out: the camera's filter mixes in what is beyond."""
BIN_M = 0.1
LEAST_BIN_PX = 300
"""Some 12 windows of 5 x 5: the deviation of 20 frames is then known to 5 %."""
PATTERN_UNITS = (1, 2, 3)
WIDEST_PX = 24
REACH_PX = 16.0
LEAST_LINES = 30
STRAIGHT_PX = 2.0
LEAST_STEP_M = 20 * MM
TRIES = 200


@dataclass(frozen=True)
class Captured:
    """A capture: ``z_m`` (n, h, w), NaN where invalid; ``slopes`` (h, w, 2); ``used`` (h, w) bool: pixels to count."""

    name: str
    lens: Lens
    z_m: np.ndarray
    slopes: np.ndarray
    used: np.ndarray

    @cached_property
    def median_m(self) -> np.ndarray:
        """(h, w) median over frames where at least half of them have a range, else NaN."""
        often = self.used & (np.isfinite(self.z_m).mean(axis=0) >= 0.5)
        median = np.full(self.used.shape, np.nan)
        median[often] = np.nanmedian(self.z_m[:, often], axis=0)
        return median

    @cached_property
    def planes(self) -> list[tuple[Plane, np.ndarray]]:
        """The planes in it with their pixels, largest first. Raises UserError where there is none."""
        found = bench.find_planes(self.median_m, self.slopes, TOLERANCE_M, LEAST_PLANE_PX)
        if not found:
            raise UserError(
                f"{self.name}: no plane of {LEAST_PLANE_PX} pixels in it",
                legal="walls, boards, tables: flat surfaces that the simulation can repeat",
                fix="check the lens (--intrinsics), or leave disturbing things out with --mask",
            )
        return found


def captured_of(recording: Recording, mask: np.ndarray | None) -> Captured:
    """Read a recording into memory. Raises UserError where it has too few frames, no pixel grid or a misfit mask."""
    if not recording.organised or recording.lens is None or recording.slopes is None:
        raise UserError(
            f"{recording.name}: points without a pixel grid and a lens cannot be simulated again",
            legal="depth images with a lens: PNG folders, .npy, .npz, .mat, .mkv",
        )
    z_m = np.stack([frame.z_m for frame in recording.frames()]).astype(np.float32)
    count, height, width = z_m.shape
    if count < LEAST_FRAMES:
        raise UserError(
            f"{recording.name}: {count} frame{'s' * (count > 1)}; temporal noise needs repeats",
            legal=f"{LEAST_FRAMES} frames or more of a static scene, twenty for a useful interval",
        )
    used = np.ones((height, width), bool) if mask is None else mask
    if used.shape != (height, width):
        raise UserError(f"--mask: {used.shape[1]} x {used.shape[0]} pixels, but the frames have {width} x {height}")
    return Captured(recording.name, recording.lens, z_m, recording.slopes, used)


@dataclass(frozen=True)
class Twin:
    """The simulated camera that stands in for that of the capture, with its lens, and the surfaces' albedo."""

    config: CameraConfig
    albedo: float

    @property
    def camera(self) -> AnyCamera:
        """The camera's file with the capture's lens."""
        return camera_of(self.config)

    def outer(self, region: Region) -> Region:
        """A region with the margin that the camera's own filter needs."""
        lens = self.camera.nominal_lens
        return region.grown(self.camera.optics.margin_px, lens.height, lens.width)

    def frames(
        self, view: NoiseFreeView, region: Region, count: int, effects: EffectsConfig, unit: int, *labels: str | int
    ) -> np.ndarray:
        """Frames of a view on a region: z in metres, (n, h, w), NaN where invalid; the labels name the noise."""
        config = self.config.model_copy(update={"effects": effects, "unit_seed": unit})
        simulated = SimulatedUnit(self.camera, config, view)
        cut, taken = region.within(simulated.region), simulated.capture(count, SEED, "capture", *labels)
        return np.stack([frame.z_m[cut] for frame in taken.frames()]).astype(float)


def twin_of(camera_name: str, lens: Lens, albedo: float) -> Twin:
    """The simulated camera with the capture's lens. Raises UserError for an unknown camera or another size."""
    own = load_camera(camera_name).nominal_lens
    if (own.width, own.height) != (lens.width, lens.height):
        raise UserError(
            f"the capture has {lens.width} x {lens.height} pixels, but {camera_name} has {own.width} x {own.height}",
            legal="a capture in the simulated mode of the camera, not aligned to another camera's pixels",
            fix="name the camera that took it with --camera, or record the depth images themselves",
        )
    numbers = {f"lens.{key}_px": getattr(lens, key) for key in ("fx", "fy", "cx", "cy")}
    distortion = [*map(float, lens.distortion)]
    return Twin(CameraConfig(name=camera_name, numbers={**numbers, "lens.distortion": distortion}), albedo)


def compared(captured: Captured, twin: Twin) -> list[Beside]:
    """All comparisons: planes, then edges in order of the axis that they cross and of the planes."""
    rows = [
        row
        for number, (plane, mask) in enumerate(captured.planes, start=1)
        for row in _plane_rows(f"plane {number}", plane, mask, captured, twin)
    ]
    labels = np.zeros(captured.used.shape, int)
    for number, (_, mask) in enumerate(captured.planes, start=1):
        labels[mask] = number
    for axis in (0, 1):
        # of each pair of planes that follow each other: line, last pixel of the first, first pixel of the second
        crossings = defaultdict(list)
        for number, line in enumerate(labels if axis == 0 else labels.T):
            (known,) = np.nonzero(line)
            for at in np.flatnonzero((np.diff(line[known]) != 0) & (np.diff(known) <= WIDEST_PX)):
                last, first = known[at : at + 2]
                crossings[int(line[last]), int(line[first])].append((number, last, first))
        for pair in sorted(crossings):
            rows += _edge_rows(captured, np.array(crossings[pair]), axis, pair, twin)
    return rows


def _plane_rows(name: str, plane: Plane, on_plane: np.ndarray, captured: Captured, twin: Twin) -> Iterator[Beside]:
    """Everything that is compared on one plane, on pixels well inside that are valid in every frame of both."""
    deep = ndimage.distance_transform_edt(np.pad(on_plane, 1))[1:-1, 1:-1] > EDGE_PX
    inside = deep & np.isfinite(captured.z_m).all(axis=0)
    wanted = int(inside.sum())
    if wanted < LEAST_BIN_PX:
        return
    (rows, columns) = ndimage.find_objects(inside.astype(int))[0]
    region = Region(rows.start, rows.stop, columns.start, columns.stop)
    slopes, z_m = captured.slopes[rows, columns], captured.z_m[:, rows, columns].astype(float)
    view = plane_view(twin.camera, twin.outer(region), plane.distance_m, twin.albedo, plane.slope_x, plane.slope_y)

    def frames(effects: EffectsConfig, unit: int = 1) -> np.ndarray:
        return twin.frames(view, region, len(z_m), effects, unit, name, unit)

    simulated = frames(NOISE)
    mask = inside[rows, columns] & np.isfinite(simulated).all(axis=0)
    pixels = int(mask.sum())
    if pixels >= LEAST_BIN_PX:
        both = (z_m, simulated)

        # temporal deviation in bins of range, and over all
        number = np.floor(z_m.mean(axis=0) / BIN_M + 1e-9)
        parts = [(f"{b * BIN_M:.1f} to {(b + 1) * BIN_M:.1f} m", mask & (number == b)) for b in np.unique(number)]
        for at, where in (*parts, ("all", mask)):
            if where.sum() >= LEAST_BIN_PX:
                sigmas = (jackknifed(z[:, where][:, None], lambda s: bench.temporal_sigma_m(s) / MM) for z in both)
                yield Beside(name, "temporal deviation", at, "mm", int(where.sum()), *sigmas)

        # correlation along x and y, each frame's mean taken off
        off = [bench.deviations(z, mask, keep_jitter=False) for z in both]
        for axis in "xy":
            for lag in range(1, bench.LAGS + 1):
                lags = (lag, 0) if axis == "x" else (0, lag)
                found = (Reading(bench.correlation(d, mask, *lags)) for d in off)
                yield Beside(name, "noise correlation", f"{axis}, lag {lag}", "", pixels, *found)

        # how much the plane's mean varies from frame to frame; jumps of over 5 mm left out
        jitter = (jitter_of(np.nanmean(z[:, mask], axis=1)) for z in (z_m, frames(JITTER)))
        yield Beside(name, "frame jitter", "all", "mm", pixels, *jitter)

        # the fixed pattern of the capture's unit, and of some simulated units
        own, others = bench.fixed_pattern(z_m, mask, slopes), []
        for unit in PATTERN_UNITS:
            patterned = frames(PATTERNED, unit)
            known = mask & np.isfinite(patterned).all(axis=0)
            others.append(bench.fixed_pattern(np.nan_to_num(patterned), known, slopes))
        std, length = mean_of([p.std_m / MM for p in others]), mean_of([p.length_px for p in others])
        yield Beside(name, "fixed pattern", "all", "mm", pixels, Reading(own.std_m / MM), std)
        yield Beside(name, "length of the pattern", "all", "px", pixels, Reading(own.length_px), length)
    seen = Reading(float(pixels / wanted))
    yield Beside(name, "pixels that the simulation sees", "all", "", wanted, Reading(1.0), seen)


def _edge_rows(captured: Captured, crossings: np.ndarray, axis: int, pair: tuple[int, int], twin: Twin) -> list[Beside]:
    """Gap and flying pixels at the straight edge between two planes; none where there is no such edge. ``crossings``
    (n, 3): line of pixels, last pixel of the first plane, first of the second; ``axis`` 0: along x."""
    lens = captured.lens
    focal_px = lens.fx if axis == 0 else lens.fy
    lines, middle = crossings[:, 0], crossings[:, 1:].mean(axis=1)
    on_lines = lens.slopes(*((middle, lines) if axis == 0 else (lines, middle)))
    across, along = on_lines[:, axis], on_lines[:, 1 - axis]

    # across = at + slant along, by RANSAC and a fit to those on it
    rng = random_stream(0, "edges", *pair)
    near = np.zeros(len(along), bool)
    for i, j in rng.integers(0, len(along), (TRIES, 2)):
        if along[i] != along[j]:
            slant = (across[i] - across[j]) / (along[i] - along[j])
            on_it = np.abs(across - across[i] - slant * (along - along[i])) < STRAIGHT_PX / focal_px
            near = on_it if on_it.sum() > near.sum() else near
    if near.sum() < LEAST_LINES:
        return []
    slant, at = map(float, np.polyfit(along[near], across[near], 1))
    near = np.abs(across - at - slant * along) < STRAIGHT_PX / focal_px
    count, planes = int(near.sum()), [captured.planes[number - 1][0] for number in pair]
    step_m = float(np.median(planes[1].z_along_m(on_lines[near]) - planes[0].z_along_m(on_lines[near])))
    if count < LEAST_LINES or abs(slant) > 1 or not abs(step_m) > LEAST_STEP_M:
        return []
    sign, (before, behind) = np.sign(step_m), pair if step_m > 0 else pair[::-1]
    front, back = (captured.planes[number - 1][0] for number in (before, behind))

    def signed(slopes: np.ndarray) -> np.ndarray:
        """(...) signed distance in slopes: below 0 on the front."""
        return np.asarray(sign * (slopes[..., axis] - at - slant * slopes[..., 1 - axis]))

    # the pixels within reach of the edge on the lines that cross it
    from_edge = signed(captured.slopes) * focal_px
    crossed = np.isin(np.arange(captured.used.shape[axis]), lines[near])
    from_edge[~crossed if axis == 0 else np.s_[:, ~crossed]] = np.nan
    rows, columns = np.nonzero(np.abs(from_edge) <= REACH_PX)
    region = Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)
    cut = region.within(lens.whole)
    from_edge, slopes, z_m = from_edge[cut], captured.slopes[cut], captured.z_m[:, *cut].astype(float)
    name = f"edge of plane {before} before plane {behind}, across {'xy'[axis]}"
    view = layered_view(twin.camera, twin.outer(region), front, back, lambda s: signed(s) < 0, twin.albedo)
    simulated = twin.frames(view, region, len(z_m), NOISE, twin.config.unit_seed, name)
    front_z, back_z = front.z_along_m(slopes), back.z_along_m(slopes)

    def widths(z: np.ndarray) -> dict[str, np.ndarray]:
        """A surface's own unevenness widens what counts as on it."""
        flat = np.abs(from_edge) > bench.FLAT_PX
        off = (z - np.where(from_edge < 0, front_z, back_z))[:, flat]
        uneven = float(np.nanmedian(np.abs(off))) * 1.4826 if np.isfinite(off).any() else 0.0
        tolerance_m = bench.on_surface_tolerance_m(max(bench.temporal_sigma_m(z, flat), uneven), abs(step_m))
        return bench.edge_widths(z, front_z, back_z, from_edge, tolerance_m, REACH_PX, 2 - axis)

    both, step = (widths(z_m), widths(simulated)), f"step {abs(step_m) / MM:.0f} mm"
    return [
        Beside(name, title, step, "px", count, *(mean_of(found[key]) for found in both))
        for title, key in (("gap at an edge", "gap"), ("flying pixels", "flying"))
    ]


def run_capture(options: argparse.Namespace, command: str) -> int:
    """Compare, print, write capture.csv, capture.html and provenance.json. Returns 0. Raises UserError for what cannot
    be read or simulated: too few frames, another size, no plane, no lens."""
    if len(options.camera) > 1:
        raise UserError("--capture: one camera took it", fix="give --camera once, or not at all")
    if not 0 < options.albedo <= 1:
        raise UserError(f"--albedo {options.albedo:g}", legal="above 0 and up to 1")
    recording = opened_capture(options)
    captured = captured_of(recording, None if options.mask is None else read_mask(options.mask))
    name = options.camera[0] if options.camera else camera_of_size(captured.lens)
    twin = twin_of(name, captured.lens, options.albedo)
    rows = compared(captured, twin)
    print(f"{captured.name}: {len(captured.z_m)} frames beside {twin.camera.title}, albedo {options.albedo:g}")
    for remark in recording.notes:
        print(f"note: {remark}")
    ratios = ", ".join(
        f"{row.ratio:.2f} ({row.where})" for row in rows if (row.quantity, row.at) == ("temporal deviation", "all")
    )
    answer = f"Temporal deviation, simulated by measured: {ratios}."
    answer = answer if ratios else "The simulation sees none of the planes of this capture."
    facts = {"camera": name, "files": [str(path) for path in recording.files]}
    words = {"name": captured.name, "camera": twin.camera.title, "answer": answer, "albedo": f"{twin.albedo:g}"}
    figure = svg("capture", (6.0, 4.2), "Planes found", lambda figure: _draw(figure, captured))
    edges, frames = any("edge" in row.where for row in rows), len(captured.z_m)
    write_comparison(options, rows, facts, command, **words, frames=frames, figure=figure, edges=edges)
    return 0


def write_comparison(
    options: argparse.Namespace, rows: list[Beside], facts: dict[str, Any], command: str, **page: Any
) -> None:
    """Print the rows, and write capture.csv, capture.html (``page``: the words of its template) and provenance.json."""
    show([BESIDE.grid(rows)])
    provenance = {"results_version": RESULTS_VERSION, **record(command), **facts}
    described = [(key, plain(value)) for key, value in provenance.items()]
    numbers = BESIDE.grid(rows).html() if rows else ""
    page = {"board": False, "remarks": (), "numbers": numbers, "provenance": described, **page}
    text = template("capture.html", Path(__file__).parent).render(page)
    write_table(options.out, BESIDE, BESIDE.frame(rows))
    write_text(options.out / "capture.html", text)
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    print(f"wrote {options.out / 'capture.html'}")


def opened_capture(options: argparse.Namespace) -> Recording:
    """The capture. Without a lens anywhere, the nominal one of the camera that the user names counts."""
    first = slice(options.frames) if options.frames else None
    try:
        return opened(options.capture, options.intrinsics, unit=options.unit, frames=first)
    except UserError:
        if not options.camera or options.intrinsics is not None:
            raise
        nominal = load_camera(options.camera[0]).nominal_lens
        recording = opened(options.capture, None, unit=options.unit, lens=nominal, frames=first)
        print(f"note: the capture names no lens; the nominal one of {options.camera[0]} counts", file=sys.stderr)
        return recording


def camera_of_size(lens: Lens) -> str:
    """The one simulated camera with as many pixels; of several the one whose precision is no guess. Raises UserError
    where there is none, or more than one."""
    sizes = {name: load_camera(name).nominal_lens for name in camera_names()}
    fitting = [name for name, own in sizes.items() if (own.width, own.height) == (lens.width, lens.height)]
    known = [name for name in fitting if not guessed_precision(load_camera(name))]
    if len(known or fitting) == 1:
        return (known or fitting)[0]
    wrong, size = f"{lens.width} x {lens.height} pixels", "record the camera's own depth images, not ones aligned to a"
    raise UserError(
        f"several cameras have {wrong}: {', '.join(fitting)}" if fitting else f"no simulated camera has {wrong}",
        legal=", ".join(f"{name} {own.width} x {own.height}" for name, own in sizes.items()),
        fix="name the one that took it with --camera" if fitting else f"{size} colour camera or of another mode",
    )


def read_mask(path: Path) -> np.ndarray:
    """(h, w) bool: the pixels of an image that are not black. Raises UserError where it cannot be read."""
    import cv2

    try:
        return np.asarray(read_picture(path, cv2.IMREAD_GRAYSCALE) > 0)
    except UserError as error:
        legal = "a PNG of the frames' size, black = left out"
        why = error.message.removeprefix(f"{path}: ")
        raise UserError(f"--mask {path}: no image that can be read ({why})", legal=legal) from error


def _draw(figure: Canvas, captured: Captured) -> None:
    """The median depth, with each plane's pixels in its colour."""
    from matplotlib.colors import to_rgb

    axes = figure.subplots()
    low, high = np.nanpercentile(captured.median_m, [2, 98])
    shade = np.clip((high - captured.median_m) / max(high - low, MM), 0, 1) * 0.5 + 0.45
    picture = np.repeat(np.nan_to_num(shade, nan=0.05)[..., None], 3, axis=-1)
    for number, (_, mask) in enumerate(captured.planes):
        picture[mask] = 0.45 * picture[mask] + 0.55 * np.array(to_rgb(COLOURS[number % len(COLOURS)]))
    axes.imshow(picture)
    axes.set_axis_off()
