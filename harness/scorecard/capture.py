"""A real static capture beside the simulation of the planes and straight edges in it.

Nothing is fitted to make the two agree: the camera's file is used as it stands, with the capture's own lens; planes are
fitted to the capture and simulated in closed form, with one albedo for all surfaces. Not simulated: curved things,
light that met more than one surface, the surfaces' own relief and texture.

Where the true edge lies is not known to better than the gap, so widths of pixels without a range and of flying pixels
are compared, and not the erosion of either side.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from detectors.recordings.recording import Recording
from harness.scorecard.bench import JITTER, NOISE, PATTERNED, SEED, Reading, jackknifed, mean_of
from harness.scorecard.noise import LAGS, correlation, deviations, fixed_pattern, temporal_sigma_m
from harness.scorecard.planes import FoundPlane, find_planes
from harness.scorecard.quantities import jitter_of
from harness.scorecard.steps import FLAT_PX, EdgeWidths, edge_widths, on_surface_tolerance_m
from harness.scorecard.tables import Beside
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.camera import AnyCamera, CameraConfig, EffectsConfig, camera_of, load_camera
from scenes.sensor.source import SimulatedUnit
from scenes.view import NoiseFreeView

LEAST_FRAMES = 4
"""Fewest frames: below, no interval can be given for what varies from frame to frame."""
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
"""Longest gap between the last pixel of a plane and the first of the next at an edge."""
REACH_PX = 16.0
LEAST_LINES = 30
"""Lines of pixels across an edge: the mean gap is then known to a tenth of a pixel."""
STRAIGHT_PX = 2.0
"""A crossing this near to the fitted line is on it."""
LEAST_STEP_M = 20 * MM
"""Somewhat more than how far from a plane its pixels may lie."""
TRIES = 200


@dataclass(frozen=True)
class Captured:
    """A capture in memory: ``z_m`` (n, h, w) float32, NaN where invalid; ``slopes`` (h, w, 2); ``used`` (h, w) bool:
    pixels that the user lets count."""

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
    def planes(self) -> list[FoundPlane]:
        """The planes in it, largest first. Raises UserError where there is none."""
        found = find_planes(self.median_m, self.slopes, TOLERANCE_M, LEAST_PLANE_PX)
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
    if len(z_m) < LEAST_FRAMES:
        frames = "1 frame" if len(z_m) == 1 else f"{len(z_m)} frames"
        raise UserError(
            f"{recording.name}: {frames}; temporal noise needs repeats",
            legal=f"{LEAST_FRAMES} frames or more of a static scene, twenty for a useful interval",
        )
    used = np.ones(z_m.shape[1:], bool) if mask is None else mask
    if used.shape != z_m.shape[1:]:
        raise UserError(
            f"--mask: {used.shape[1]} x {used.shape[0]} pixels, but the frames have {z_m.shape[2]} x {z_m.shape[1]}"
        )
    return Captured(recording.name, recording.lens, z_m, recording.slopes, used)


@dataclass(frozen=True)
class Twin:
    """The simulated camera that stands in for the one of the capture, and the surfaces' albedo."""

    config: CameraConfig
    albedo: float

    @cached_property
    def camera(self) -> AnyCamera:
        """The camera's file with the capture's lens."""
        return camera_of(self.config)

    def outer(self, region: Region) -> Region:
        """A region with the margin that the camera's own filter needs."""
        lens = self.camera.nominal_lens
        return region.grown(self.camera.optics.margin_px, lens.height, lens.width)

    def frames(
        self,
        view: NoiseFreeView,
        region: Region,
        count: int,
        effects: EffectsConfig,
        unit_seed: int,
        *labels: str | int,
    ) -> np.ndarray:
        """Frames of a view on a region: z in metres, (n, h, w), NaN where invalid; the noise is the stream of the
        labels."""
        config = self.config.model_copy(update={"effects": effects, "unit_seed": unit_seed})
        unit = SimulatedUnit(self.camera, config, view)
        cut = region.within(unit.region)
        return np.stack([f.z_m[cut] for f in unit.capture(count, SEED, "capture", *labels).frames()]).astype(float)


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
    """All comparisons: planes, then edges."""
    rows = [
        row
        for number, found in enumerate(captured.planes, start=1)
        for row in _plane_rows(f"plane {number}", found, captured, twin)
    ]
    return rows + [row for edge in _edges_of(captured) for row in _edge_rows(captured, edge, twin)]


# ---- planes ----------------------------------------------------------------------------------------------------------


def _plane_rows(name: str, found: FoundPlane, captured: Captured, twin: Twin) -> list[Beside]:
    """Everything that is compared on one plane: noise by range, correlation, jitter, fixed pattern.

    The pixels that count lie well inside and are valid in every frame, of the capture and of the simulation.
    """
    deep = ndimage.distance_transform_edt(np.pad(found.mask, 1))[1:-1, 1:-1] > EDGE_PX
    inside = deep & np.isfinite(captured.z_m).all(axis=0)
    if inside.sum() < LEAST_BIN_PX:
        return []
    (rows, columns) = ndimage.find_objects(inside.astype(int))[0]
    region = Region(rows.start, rows.stop, columns.start, columns.stop)
    slopes, z_m = captured.slopes[rows, columns], captured.z_m[:, rows, columns].astype(float)
    plane = found.plane
    view = plane_view(twin.camera, twin.outer(region), plane.distance_m, twin.albedo, plane.slope_x, plane.slope_y)

    def frames(effects: EffectsConfig, unit_seed: int = 1) -> np.ndarray:
        return twin.frames(view, region, len(z_m), effects, unit_seed, name, unit_seed)

    simulated = frames(NOISE)
    mask = inside[rows, columns] & np.isfinite(simulated).all(axis=0)
    wanted, pixels = int(inside.sum()), int(mask.sum())
    seen = Reading(float(pixels / wanted))
    share = Beside(name, "pixels that the simulation sees", "all", "", wanted, Reading(1.0), seen)
    if pixels < LEAST_BIN_PX:
        return [share]
    both = (z_m, simulated)
    told = []

    # temporal deviation in bins of range, and over all
    number = np.floor(z_m.mean(axis=0) / BIN_M + 1e-9)
    parts = [(f"{b * BIN_M:.1f} to {(b + 1) * BIN_M:.1f} m", mask & (number == b)) for b in np.unique(number)]
    for at, where in (*parts, ("all", mask)):
        if where.sum() >= LEAST_BIN_PX:
            measured, model = (
                jackknifed(z[:, where][:, None], lambda s: temporal_sigma_m(s, np.ones(s.shape[1:], bool)) / MM)
                for z in both
            )
            told.append(Beside(name, "temporal deviation", at, "mm", int(where.sum()), measured, model))

    # correlation along x and y, each frame's mean taken off
    off = [deviations(z, mask, keep_jitter=False) for z in both]
    for axis in "xy":
        for lag in range(1, LAGS + 1):
            lags = (lag, 0) if axis == "x" else (0, lag)
            measured, model = (Reading(correlation(d, mask, *lags)) for d in off)
            told.append(Beside(name, "noise correlation", f"{axis}, lag {lag}", "", pixels, measured, model))

    # how much the plane's mean varies from frame to frame; jumps of over 5 mm left out
    measured, model = (jitter_of(np.nanmean(z[:, mask], axis=1)) for z in (z_m, frames(JITTER)))
    told.append(Beside(name, "frame jitter", "all", "mm", pixels, measured, model))

    # the fixed pattern of the capture's unit, and of some simulated units
    own, others = fixed_pattern(z_m, mask, slopes), []
    for unit in PATTERN_UNITS:
        patterned = frames(PATTERNED, unit)
        known = mask & np.isfinite(patterned).all(axis=0)
        others.append(fixed_pattern(np.nan_to_num(patterned), known, slopes))
    deviation, length = mean_of([p.std_m / MM for p in others]), mean_of([p.length_px for p in others])
    told.append(Beside(name, "fixed pattern", "all", "mm", pixels, Reading(own.std_m / MM), deviation))
    told.append(Beside(name, "length of the pattern", "all", "px", pixels, Reading(own.length_px), length))
    return [*told, share]


# ---- edges -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Edge:
    """A straight edge: the front is where sign (p_axis - at - slant p_other) < 0, p the slopes of a ray.

    ``axis`` 0: z steps along x. ``lines``: the rows (columns for axis 1) that cross it. ``focal_px``: pixels in a unit
    of slope across it.
    """

    name: str
    front: Plane
    back: Plane
    axis: int
    sign: float
    at: float
    slant: float
    lines: np.ndarray
    step_m: float
    focal_px: float

    def signed(self, slopes: np.ndarray) -> np.ndarray:
        """(...) signed distance in slopes: below 0 on the front."""
        return np.asarray(self.sign * (slopes[..., self.axis] - self.at - self.slant * slopes[..., 1 - self.axis]))

    def covers(self, slopes: np.ndarray) -> np.ndarray:
        """Return whether the front is there; False for NaN."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.signed(slopes) < 0)

    def is_crossed(self, region: Region) -> np.ndarray:
        """(h, w) bool: the pixels of a region that lie on lines that cross the edge."""
        on = np.zeros(region.shape, bool)
        if self.axis == 0:
            on[self.lines - region.row0] = True
        else:
            on[:, self.lines - region.col0] = True
        return on


def _edges_of(captured: Captured) -> list[Edge]:
    """The straight edges between the capture's planes, in order of the planes."""
    labels = np.zeros(captured.used.shape, int)
    for number, found in enumerate(captured.planes, start=1):
        labels[found.mask] = number
    edges = []
    for axis in (0, 1):
        # (row, last column of one plane, first column of the next, both labels) where planes follow each other
        crossings = []
        for row, line in enumerate(labels if axis == 0 else labels.T):
            (known,) = np.nonzero(line)
            change = np.flatnonzero((np.diff(line[known]) != 0) & (np.diff(known) <= WIDEST_PX))
            crossings += [
                (row, a, b, int(line[a]), int(line[b])) for a, b in zip(known[change], known[change + 1], strict=True)
            ]
        for pair in sorted({crossing[3:] for crossing in crossings}):
            edge = _fitted(captured, np.array([c[:3] for c in crossings if c[3:] == pair]), axis, *pair)
            edges += [] if edge is None else [edge]
    return edges


def _fitted(captured: Captured, rows: np.ndarray, axis: int, first: int, second: int) -> Edge | None:
    """The straight line that most crossings lie on; None where that is no step, too short, or nearer the other axis."""
    if len(rows) < LEAST_LINES:
        return None
    focal_px = captured.lens.fx if axis == 0 else captured.lens.fy
    middle = rows[:, 1:].mean(axis=1)
    slopes = captured.lens.slopes(*((middle, rows[:, 0]) if axis == 0 else (rows[:, 0], middle)))
    across, along = slopes[:, axis], slopes[:, 1 - axis]

    # across = at + slant along, by RANSAC and a fit to those on it
    rng = random_stream(0, "edges", first, second)
    best = np.zeros(along.size, bool)
    for i, j in rng.integers(0, along.size, (TRIES, 2)):
        if along[i] != along[j]:
            slant = (across[i] - across[j]) / (along[i] - along[j])
            near = np.abs(across - across[i] - slant * (along - along[i])) < STRAIGHT_PX / focal_px
            best = near if near.sum() > best.sum() else best
    if best.sum() < 2:
        return None
    slant, at = map(float, np.polyfit(along[best], across[best], 1))
    near = np.abs(across - at - slant * along) < STRAIGHT_PX / focal_px

    planes = [captured.planes[number - 1].plane for number in (first, second)]
    step_m = float(np.median(planes[1].z_along_m(slopes[near]) - planes[0].z_along_m(slopes[near])))
    if near.sum() < LEAST_LINES or abs(slant) > 1 or not abs(step_m) > LEAST_STEP_M:
        return None
    front, back = (0, 1) if step_m > 0 else (1, 0)
    return Edge(
        name=f"edge of plane {(first, second)[front]} before plane {(first, second)[back]}, across {'xy'[axis]}",
        front=planes[front],
        back=planes[back],
        axis=axis,
        sign=1.0 if step_m > 0 else -1.0,
        at=at,
        slant=slant,
        lines=rows[near, 0],
        step_m=abs(step_m),
        focal_px=focal_px,
    )


def _edge_rows(captured: Captured, edge: Edge, twin: Twin) -> list[Beside]:
    """Gap and flying pixels at one edge, on the pixels within reach of it on its lines."""
    whole = captured.lens.whole
    near = np.abs(edge.signed(captured.slopes)) * edge.focal_px <= REACH_PX
    rows, columns = np.nonzero(near & edge.is_crossed(whole))
    region = Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)
    z_m = captured.z_m[(slice(None), *region.within(whole))].astype(float)
    view = layered_view(twin.camera, twin.outer(region), edge.front, edge.back, edge.covers, twin.albedo)
    simulated_m = twin.frames(view, region, len(z_m), NOISE, twin.config.unit_seed, edge.name)
    slopes = captured.slopes[region.within(whole)]
    from_edge = np.where(edge.is_crossed(region), edge.signed(slopes) * edge.focal_px, np.nan)
    front_z, back_z = edge.front.z_along_m(slopes), edge.back.z_along_m(slopes)

    def widths(z: np.ndarray) -> EdgeWidths:
        """A surface's own unevenness widens what counts as on it."""
        with np.errstate(invalid="ignore"):
            flat = np.abs(from_edge) > FLAT_PX
            off = (z - np.where(from_edge < 0, front_z, back_z))[:, flat]
        uneven = float(np.nanmedian(np.abs(off))) * 1.4826 if np.isfinite(off).any() else 0.0
        tolerance_m = on_surface_tolerance_m(max(temporal_sigma_m(z, flat), uneven), edge.step_m)
        return edge_widths(z, front_z, back_z, from_edge, tolerance_m, REACH_PX, len(edge.lines))

    measured, simulated = widths(z_m), widths(simulated_m)
    at, lines = f"step {edge.step_m / MM:.0f} mm", len(edge.lines)
    return [
        Beside(edge.name, title, at, "px", lines, mean_of(getattr(measured, key)), mean_of(getattr(simulated, key)))
        for title, key in (("gap at an edge", "gap"), ("flying pixels", "flying"))
    ]
