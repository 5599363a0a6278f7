"""The shards of the atlas: one for each camera of its own numbers, with its noise and parts."""

from collections.abc import Iterable, Sequence

import numpy as np

from harness.experiment.digests import CAMERA_PART, camera_digests
from harness.programs.atlas.limits import Conditions, Outside, PlaneNoise
from harness.programs.atlas.parts import (
    BRIGHT,
    CHECK_ALBEDO,
    CHECK_FRAMES,
    CHECK_SHARE,
    CHECKED,
    COARSEST_PX_MM,
    DARK,
    DEPTHS_MM,
    FARTHEST_M,
    FRAMES,
    NEAREST_M,
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
    """Return the parts of a camera: at the ends of its range and between, where it gives a depth,
    and of some cameras one that is kept aside.

    As albedo acts by noise alone, only the farthest part has both. The nearest is bright and the
    middle one dark if the camera gives a depth there, so that the noises span all that is asked."""
    distances_m = np.array(noise.distance_m)[np.isfinite(noise.frame_mm).any(axis=1)]
    if not len(distances_m):
        return []
    nearest_m = float(distances_m[0])
    farthest_m = float(distances_m[-1])
    middle_m = between(nearest_m, farthest_m)
    near = _part(name, nearest_m, _first_visible(noise, nearest_m, (BRIGHT, DARK)), FRAMES)
    middle = _part(name, middle_m, _first_visible(noise, middle_m, (DARK, BRIGHT)), FRAMES)
    far = _part(name, farthest_m, _visible(noise, farthest_m, (DARK, BRIGHT)), FRAMES)
    parts = [near, middle, far]
    if name in CHECKED:
        check_m = between(nearest_m, middle_m, CHECK_SHARE)
        albedos = _visible(noise, check_m, (CHECK_ALBEDO,))
        parts.append(_part(name, check_m, albedos, (CHECK_FRAMES,), is_check=True))
    return [part for part in parts if part.albedos]


def _first_visible(
    noise: PlaneNoise, distance_m: float, albedos: Sequence[float]
) -> tuple[float, ...]:
    """Return the first albedo at which the camera gives a depth at a distance, if any."""
    return _visible(noise, distance_m, albedos)[:1]


def _visible(noise: PlaneNoise, distance_m: float, albedos: Sequence[float]) -> tuple[float, ...]:
    """Return those albedos at which the camera gives a depth at a distance."""
    visible = []
    for albedo in albedos:
        try:
            noise.at(Conditions(distance_m, albedo, frames=1))
        except Outside:
            continue
        visible.append(albedo)
    return tuple(visible)


def _part(
    name: str,
    distance_m: float,
    albedos: tuple[float, ...],
    frames: tuple[int, ...],
    *,
    is_check: bool = False,
) -> Part:
    """Return the part at a distance."""
    depths_mm = DEPTHS_MM
    if is_check:
        depths_mm = {kind: _kept_aside(depths) for kind, depths in DEPTHS_MM.items()}
    return Part(
        camera=name,
        distance_m=distance_m,
        albedos=albedos,
        frames=frames,
        pixel_mm=distance_m / load_camera(name).nominal_lens.fx / MM,
        depths_mm=depths_mm,
        is_check=is_check,
    )


def _kept_aside(depths_mm: tuple[float | None, ...]) -> tuple[float | None, ...]:
    """Return the depth between those that the law is fitted to; None of through-holes."""
    lowest_mm = depths_mm[0]
    highest_mm = depths_mm[-1]
    if lowest_mm is None or highest_mm is None:
        return (None,)
    return (between(lowest_mm, highest_mm),)


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
