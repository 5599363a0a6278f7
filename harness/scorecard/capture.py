"""A real static capture beside the simulation of the planes and edges in it.

Nothing is fitted to make the two agree: the camera's file is used as it stands, with the capture's own lens; planes are
fitted to the capture and simulated in closed form, with one albedo for all surfaces. Not simulated: curved things,
light that met more than one surface, the surfaces' own relief and texture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage

from detectors.recordings.recording import Recording
from harness.scorecard.bench import NOISE
from harness.scorecard.estimate import Estimate, jackknifed, mean_of
from harness.scorecard.pattern import fixed_pattern
from harness.scorecard.planar import JITTER, PATTERNED, jitter_of
from harness.scorecard.planes import FoundPlane, find_planes
from harness.scorecard.temporal import LAGS, correlation, deviations, temporal_sigma_m
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens
from harness.vocabulary.units import MM
from scenes.closed_form import plane_view
from scenes.sensor.camera import AnyCamera, CameraConfig, EffectsConfig, camera_of
from scenes.sensor.source import SimulatedUnit

LEAST_FRAMES = 4
"""Below, no interval can be given for what varies from frame to frame."""
TOLERANCE_M = 8 * MM
"""A point this near to a plane is on it: a nominal lens bows real walls by 3 mm rms."""
LEAST_PLANE_PX = 2000
EDGE_PX = 3
"""Pixels nearer to a plane's rim are left out: the camera's filter mixes in what is beyond."""
BIN_M = 0.1
LEAST_BIN_PX = 300
"""Some 12 windows of 5 x 5: the deviation of 20 frames is then known to 5 %."""
PATTERN_UNITS = (1, 2, 3)
SEED = 1


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


@dataclass(frozen=True)
class Beside:
    """One number of the capture and of the simulation. ``at`` says under which condition, ``unit`` may be empty."""

    where: str
    quantity: str
    at: str
    unit: str
    pixels: int
    measured: Estimate
    simulated: Estimate

    @property
    def ratio(self) -> float:
        """Simulated by measured; NaN for what may be 0."""
        return self.simulated.value / self.measured.value if self.unit == "mm" and self.measured.value else float("nan")


@dataclass(frozen=True)
class Surface:
    """One plane of a capture on its own region: ``mask`` (h, w) of the pixels that count, ``z_m`` (n, h, w)."""

    name: str
    found: FoundPlane
    region: Region
    mask: np.ndarray
    slopes: np.ndarray
    z_m: np.ndarray


@dataclass(frozen=True)
class Twin:
    """The simulated camera that stands in for the one of the capture, and the surfaces' albedo."""

    config: CameraConfig
    albedo: float

    @cached_property
    def camera(self) -> AnyCamera:
        """The camera's file with the capture's lens."""
        return camera_of(self.config)

    def frames(self, surface: Surface, effects: EffectsConfig, unit_seed: int = 1) -> np.ndarray:
        """As many frames of the surface's plane as were captured: z in metres, (n, h, w), NaN where invalid."""
        lens, plane = self.camera.nominal_lens, surface.found.plane
        config = self.config.model_copy(update={"effects": effects, "unit_seed": unit_seed})
        outer = surface.region.grown(self.camera.optics.margin_px, lens.height, lens.width)
        view = plane_view(self.camera, outer, plane.distance_m, self.albedo, plane.slope_x, plane.slope_y)
        unit = SimulatedUnit(self.camera, config, view)
        cut = surface.region.within(unit.region)
        frames = unit.capture(len(surface.z_m), SEED, "capture", surface.name, unit_seed).frames()
        return np.stack([frame.z_m[cut] for frame in frames]).astype(float)


def twin_of(camera_name: str, lens: Lens, albedo: float) -> Twin:
    """The simulated camera with the capture's lens. Raises UserError for an unknown camera or another size."""
    from scenes.sensor.camera import load_camera

    own = load_camera(camera_name).nominal_lens
    if (own.width, own.height) != (lens.width, lens.height):
        raise UserError(
            f"the capture has {lens.width} x {lens.height} pixels, but {camera_name} has {own.width} x {own.height}",
            legal="a capture in the simulated mode of the camera, not aligned to another camera's pixels",
            fix="name the camera that took it with --camera, or record the depth images themselves",
        )
    numbers = {f"lens.{key}_px": getattr(lens, key) for key in ("fx", "fy", "cx", "cy")}
    return Twin(
        CameraConfig(name=camera_name, numbers={**numbers, "lens.distortion": [*map(float, lens.distortion)]}), albedo
    )


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


def surfaces_of(captured: Captured) -> list[Surface]:
    """The planes with the pixels that count: well inside and valid in every frame."""
    always = np.isfinite(captured.z_m).all(axis=0)
    surfaces = []
    for number, found in enumerate(captured.planes, start=1):
        deep = ndimage.distance_transform_edt(np.pad(found.mask, 1))[1:-1, 1:-1] > EDGE_PX
        mask = deep & always
        if mask.sum() < LEAST_BIN_PX:
            continue
        (rows, columns) = ndimage.find_objects(mask.astype(int))[0]
        region = Region(rows.start, rows.stop, columns.start, columns.stop)
        surfaces.append(
            Surface(
                f"plane {number}",
                found,
                region,
                mask[rows, columns],
                captured.slopes[rows, columns],
                captured.z_m[:, rows, columns].astype(float),
            )
        )
    return surfaces


def surface_rows(surface: Surface, twin: Twin) -> list[Beside]:
    """Everything that is compared on one plane: noise by range, correlation, jitter, fixed pattern."""
    simulated = twin.frames(surface, NOISE)
    both = surface.mask & np.isfinite(simulated).all(axis=0)
    share = Beside(
        surface.name,
        "pixels that the simulation sees",
        "all",
        "",
        int(surface.mask.sum()),
        Estimate(1.0),
        Estimate(float(both.sum() / surface.mask.sum())),
    )
    if both.sum() < LEAST_BIN_PX:
        return [share]
    known = replace(surface, mask=both)
    return [
        *_sigma_rows(known, simulated),
        *_correlation_rows(known, simulated),
        _jitter_row(known, twin),
        *_pattern_rows(known, twin),
        share,
    ]


def _sigma_rows(surface: Surface, simulated: np.ndarray) -> list[Beside]:
    """Temporal deviation in bins of range, and over all."""
    number = np.floor(surface.z_m.mean(axis=0) / BIN_M + 1e-9)
    parts = [(f"{b * BIN_M:.1f} to {(b + 1) * BIN_M:.1f} m", surface.mask & (number == b)) for b in np.unique(number)]
    rows = []
    for at, where in (*parts, ("all", surface.mask)):
        if where.sum() >= LEAST_BIN_PX:
            measured, model = (
                jackknifed(z[:, where][:, None], lambda s: temporal_sigma_m(s, np.ones(s.shape[1:], bool)) / MM)
                for z in (surface.z_m, simulated)
            )
            rows.append(Beside(surface.name, "temporal deviation", at, "mm", int(where.sum()), measured, model))
    return rows


def _correlation_rows(surface: Surface, simulated: np.ndarray) -> list[Beside]:
    """Correlation at lags 1 to 5 along x and y, each frame's mean taken off."""
    where, pixels = surface.mask, int(surface.mask.sum())
    measured, model = (correlation(deviations(z, where, keep_jitter=False), where) for z in (surface.z_m, simulated))
    return [
        Beside(
            surface.name,
            "noise correlation",
            f"{'xy'[axis]}, lag {lag}",
            "",
            pixels,
            Estimate(float(measured[axis, lag - 1])),
            Estimate(float(model[axis, lag - 1])),
        )
        for axis in (0, 1)
        for lag in range(1, LAGS + 1)
    ]


def _jitter_row(surface: Surface, twin: Twin) -> Beside:
    """How much the plane's mean varies from frame to frame; jumps of over 5 mm left out."""
    both = (surface.z_m, twin.frames(surface, JITTER))
    measured, model = (jitter_of(np.nanmean(z[:, surface.mask], axis=1)) for z in both)
    return Beside(surface.name, "frame jitter", "all", "mm", int(surface.mask.sum()), measured, model)


def _pattern_rows(surface: Surface, twin: Twin) -> list[Beside]:
    """The fixed pattern of the capture's unit, and of some simulated ones."""
    measured = fixed_pattern(surface.z_m, surface.mask, surface.slopes)
    simulated = []
    for unit in PATTERN_UNITS:
        z_m = twin.frames(surface, PATTERNED, unit)
        mask = surface.mask & np.isfinite(z_m).all(axis=0)
        simulated.append(fixed_pattern(np.nan_to_num(z_m), mask, surface.slopes))
    stds, lengths = [p.std_m / MM for p in simulated], [p.length_px for p in simulated]
    pixels = int(surface.mask.sum())
    return [
        Beside(surface.name, "fixed pattern", "all", "mm", pixels, Estimate(measured.std_m / MM), mean_of(stds)),
        Beside(
            surface.name, "length of the pattern", "all", "px", pixels, Estimate(measured.length_px), mean_of(lengths)
        ),
    ]
