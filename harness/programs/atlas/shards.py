"""The shards of the atlas: one for each camera of its own numbers, with its noise and parts."""

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd

from harness.experiment.digests import CAMERA_PART, camera_digests
from harness.programs.atlas.fitting import Sites
from harness.programs.atlas.law import MIDDLE_ALBEDO
from harness.programs.atlas.limits import Conditions, Outside, PlaneNoise, pixel_width_mm
from harness.programs.atlas.parts import (
    BACKING_MM,
    BRIGHT,
    COARSEST_PX_MM,
    DARK,
    FARTHEST_M,
    NEAREST_M,
    PARTS,
    Part,
    between,
)
from harness.vocabulary.geometry import MM, Region
from scenes.closed_form import plane_view
from scenes.sensor.camera import AnyCamera, load_camera
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit

NOISE_DISTANCES = 7
NOISE_ALBEDOS = (0.1, 0.2, 0.4, 0.9)
NOISE_FRAMES = 24
NOISE_HALF_PX = 24
LEAST_VALID = 0.9
"""Least share of pixels with a depth; with fewer, a surface is too full of holes to be
inspected."""


def parts_of(name: str, noise: PlaneNoise) -> list[Part]:
    """Return the parts of a camera, at distances between the ends of its range where it gives a
    depth.

    Bright and dark targets alternate, where the camera sees them: what acts with distance is so
    told from what acts with albedo."""
    distances_m = np.array(noise.distance_m)[np.isfinite(noise.frame_mm).any(axis=1)]
    if not len(distances_m):
        return []
    focal_px = float(load_camera(name).nominal_lens.fx)
    parts = []
    for number, share in enumerate(np.linspace(0, 1, PARTS)):
        distance_m = between(float(distances_m[0]), float(distances_m[-1]), share)
        wanted = (BRIGHT, MIDDLE_ALBEDO, DARK)
        if number % 2:
            wanted = (DARK, MIDDLE_ALBEDO, BRIGHT)
        albedo = _first_visible(noise, distance_m, wanted)
        if albedo is not None:
            part = Part(
                camera=name,
                distance_m=distance_m,
                albedo=albedo,
                backing_mm=BACKING_MM,
                pixel_mm=pixel_width_mm(distance_m, focal_px),
            )
            parts.append(part)
    return parts


def sites_of(
    damages: pd.DataFrame, part: Part, number: int, noise: PlaneNoise, threshold: float
) -> Sites:
    """Return the damages of one kind of a part, as the law takes them. ``number``: the part's;
    ``threshold``: the camera's typical one."""
    size_mm = damages["true_diameter_mm"].to_numpy(float)
    # what is visible from aside may be the wall of a hole: its whole depth counts
    is_through = (damages["kind"] == "through").to_numpy()
    depth_mm = damages["true_depth_mm"].to_numpy(float) + np.where(is_through, part.backing_mm, 0)
    frames = damages["frames"].to_numpy(int)
    noise_mm = np.zeros(len(damages))
    fixed_share = np.zeros(len(damages))
    for count in np.unique(frames):
        conditions = Conditions(part.distance_m, part.albedo, int(count), part.backing_mm)
        noise_mm[frames == count], fixed_share[frames == count] = noise.at(conditions)
    signal = damages["signal"].to_numpy(float) / threshold
    is_known = signal > 0
    log_signal = np.full(len(damages), np.nan)
    log_signal[is_known] = np.log(signal[is_known])
    return Sites(
        log_size_px=np.log(size_mm / part.pixel_mm),
        x=np.log(noise_mm / depth_mm),
        log_pixel_mm=np.full(len(damages), np.log(part.pixel_mm)),
        fixed_share=fixed_share,
        log_albedo=np.full(len(damages), np.log(part.albedo / MIDDLE_ALBEDO)),
        log_signal=log_signal,
        log_threshold=np.log(damages["threshold"].to_numpy(float) / threshold),
        is_found=damages["detected"].to_numpy(bool),
        part=np.full(len(damages), number),
        frames=frames,
    )


def _first_visible(noise: PlaneNoise, distance_m: float, albedos: Sequence[float]) -> float | None:
    """Return the first albedo at which the camera gives a depth at a distance, if any."""
    for albedo in albedos:
        try:
            noise.at(Conditions(distance_m, albedo, frames=1, depth_mm=BACKING_MM))
        except Outside:
            continue
        return albedo
    return None


def measured_noise(name: str) -> PlaneNoise:
    """Return the depth noise of a camera from simulated frames of an even plane."""
    camera = load_camera(name)
    nearest_m = max(NEAREST_M, camera.optics.nearest_m)
    focal_px = float(camera.nominal_lens.fx)
    farthest_m = min(FARTHEST_M, camera.optics.farthest_m, COARSEST_PX_MM * MM * focal_px)
    # the ends belong to the range, and boards are tilted and moved: a margin of a twentieth
    if nearest_m > NEAREST_M:
        nearest_m *= 1.05
    if farthest_m < FARTHEST_M:
        farthest_m *= 0.95
    distances_m = np.round(np.geomspace(nearest_m, farthest_m, NOISE_DISTANCES), 3)
    shape = (NOISE_DISTANCES, len(NOISE_ALBEDOS))
    frame_mm = np.full(shape, np.nan)
    fixed_mm = np.full(shape, np.nan)
    for row, distance_m in enumerate(distances_m):
        for column, albedo in enumerate(NOISE_ALBEDOS):
            frame_mm[row, column], fixed_mm[row, column] = _noise(
                camera, name, float(distance_m), albedo
            )
    return PlaneNoise(
        distance_m=tuple(float(distance) for distance in distances_m),
        albedo=NOISE_ALBEDOS,
        frame_mm=frame_mm,
        fixed_mm=fixed_mm,
    )


def _noise(camera: AnyCamera, name: str, distance_m: float, albedo: float) -> tuple[float, float]:
    """Return the temporal deviation of a frame, without displacements of whole frames, and the
    deviation of what averaging leaves, millimetres; NaN if too few pixels have a depth."""
    row = int(camera.nominal_lens.cy)
    column = int(camera.nominal_lens.cx)
    half = NOISE_HALF_PX
    region = Region(row - half, row + half, column - half, column + half)
    view = plane_view(camera, region, distance_m, albedo)
    unit = SimulatedUnit(camera, CameraConfig(name=name), view)
    frames = unit.capture(NOISE_FRAMES, 1, "noise of the atlas").frames()
    z_mm = np.stack([frame.z_m for frame in frames]).astype(float) / MM
    is_known = np.isfinite(z_mm).all(axis=0)
    if is_known.mean() < LEAST_VALID:
        return np.nan, np.nan
    known_mm = z_mm[:, is_known]
    known_mm -= np.median(known_mm, axis=1, keepdims=True)
    variance = float(known_mm.var(axis=0, ddof=1).mean())
    rest_mm = _without_slope(known_mm.mean(axis=0), np.argwhere(is_known))
    fixed = float(rest_mm.var()) - variance / NOISE_FRAMES
    return float(np.sqrt(variance)), float(np.sqrt(max(fixed, 0.0)))


def _without_slope(z_mm: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return depths (n,) at pixels (n, 2) less their best quadratic: what a surface takes away."""
    rows = pixels[:, 0] / NOISE_HALF_PX - 1
    columns = pixels[:, 1] / NOISE_HALF_PX - 1
    terms = [np.ones_like(rows), rows, columns, rows**2, columns**2, rows * columns]
    design = np.stack(terms, axis=1)
    coefficients, *_ = np.linalg.lstsq(design, z_mm, rcond=None)
    return np.asarray(z_mm - design @ coefficients)


def twins_of(names: Iterable[str]) -> dict[str, list[str]]:
    """Return the cameras with numbers of their own, each with itself and those that have the same
    numbers: one study answers for all of them."""
    twins: dict[str, list[str]] = {}
    for name in names:
        digest = camera_digests([name])[f"{CAMERA_PART}{name}"]
        twins.setdefault(digest, []).append(name)
    return {group[0]: group for group in twins.values()}
