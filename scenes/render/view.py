"""Rendering a view: region, direct light, indirect light and its noise, put together."""

from __future__ import annotations

import dataclasses
import time

import cv2
import numpy as np

from harness.vocabulary.geometry import Region, transform_points
from harness.vocabulary.units import MM
from scenes.field_of_view import seen_region
from scenes.optics import Optics
from scenes.render.direct import DirectLight, OffFace, direct_light, footprint_of, surface_rgb
from scenes.render.indirect import (
    Gathered,
    PathWork,
    face_light,
    face_triangles,
    gather_in_pixels,
    noise_lines,
    range_noise_m,
)
from scenes.render.scene import LitScene, lit_scene
from scenes.render.settings import RenderConfig
from scenes.render.variant import load_mitsuba
from scenes.target.mesh import Target
from scenes.view import NoiseFreeView

RIM_PX = 3
"""Pixels of surroundings rendered beyond the board's outline, so that its rim looks as on the whole sensor."""
HOLE_RIM_PX = 1
PILOT_SAMPLES = 128
"""Paths that tell a pixel's noise, within a third."""
PILOT_SEED = 1 << 20
"""Offset that keeps those apart from the ones that count."""


def target_region(target: Target, optics: Optics) -> Region:
    """Return the region of the sensor that a render of the target covers. Raises UserError as `seen_region` does."""
    tight = seen_region(transform_points(target.T_camera_board, target.outline_board_m), optics)
    return tight.grown(RIM_PX + optics.margin_px, optics.lens.height, optics.lens.width)


def render_view(target: Target, optics: Optics, config: RenderConfig) -> NoiseFreeView:
    """Render the noise-free view of a target by a camera. Raises UserError as `target_region` and `load_mitsuba` do."""
    began = time.perf_counter()
    mi = load_mitsuba()
    region = target_region(target, optics)
    lens = optics.lens
    lit = lit_scene(mi, target.parts, optics, face_triangles(target))
    slopes = lens.region_slopes(region)
    footprint = footprint_of(lens, region, optics.footprint)
    direct = direct_light(lit, slopes, footprint, optics.frequencies_hz, _at_holes(target, optics, slopes))
    phasor, intensity, noise_m = direct.phasor, direct.intensity, np.zeros(region.shape)
    if config.bounces > 0:
        # pixels within the face's outline as the camera sees it
        uv = lens.project(transform_points(target.T_camera_board, target.outline_board_m))
        polygon = np.round(uv - [region.col0, region.row0]).astype(np.int32)
        inside = cv2.fillPoly(np.zeros(region.shape, np.uint8), [polygon], (1,)).astype(bool)
        indirect, noise_m = indirect_light(lit, target, optics, slopes, direct, inside, config)
        phasor = phasor + indirect[:-1]
        intensity = intensity + indirect[-1].real
    return NoiseFreeView(
        region=region,
        frequencies_hz=optics.frequencies_hz,
        phasor=phasor.astype(np.complex64),
        phasor_direct=direct.phasor.astype(np.complex64),
        intensity=intensity,
        indirect_noise_m=noise_m,
        range_m=direct.range_m,
        surface=direct.surface,
        surface_names=lit.names,
        coverage=direct.coverage,
        rgb=surface_rgb(target.parts, direct.surface, direct.uv),
        slopes=slopes,
        seconds=time.perf_counter() - began,
        variant=mi.variant(),
    )


def indirect_light(
    lit: LitScene,
    target: Target,
    optics: Optics,
    slopes: np.ndarray,
    direct: DirectLight,
    inside: np.ndarray,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Return indirect phasors (f + 1, h, w) and their noise in metres of range (h, w).

    By way of the face from its nodes; by way of all else by paths through the pixel's own sub-rays, ``inside`` (h, w)
    the board's outline with as many as their noise asks for.
    """
    frequencies, shape = optics.frequencies_hz, direct.range_m.shape
    indirect = np.zeros((len(frequencies) + 1, direct.range_m.size), complex)
    variance = np.zeros(direct.range_m.size)
    total = direct.phasor.reshape(len(frequencies), -1).copy()
    seen = np.flatnonzero(direct.face[-1].real)
    if seen.size:
        work = PathWork(frequencies, config.bounces - 1, config.seed)
        samples, spacing_m = config.face_samples, config.face_spacing_mm * MM
        mean, batches = face_light(lit, target, direct, slopes, work, spacing_m, samples)
        indirect[:, seen] = mean
        total[:, seen] += mean[:-1]
        variance[seen] = range_noise_m(batches, total[:, seen], frequencies) ** 2
    work = PathWork(frequencies, config.bounces, config.seed)
    off_face, within = direct.off_face, inside.ravel()[direct.off_face.pixel]
    for rays, inner in ((off_face.chosen(within), True), (off_face.chosen(~within), False)):
        if rays.pixel.size:
            if inner:
                light = _gather_inside(lit, rays, total[:, rays.pixel], work, config)
            else:
                light = gather_in_pixels(lit, rays, work, config.rest_samples)
            indirect[:, rays.pixel] += rays.share * light.mean
            total[:, rays.pixel] += rays.share * light.mean[:-1]
            batches = rays.share * light.sums[:, noise_lines(frequencies)]
            variance[rays.pixel] += range_noise_m(batches, total[:, rays.pixel], frequencies) ** 2
    return indirect.reshape(-1, *shape), np.sqrt(variance).reshape(shape)


def _gather_inside(lit: LitScene, rays: OffFace, total: np.ndarray, work: PathWork, config: RenderConfig) -> Gathered:
    """Gather inside the outline: a few paths a pixel tell its noise, then as many as bring it down to
    ``hole_noise_mm``.

    The few are thrown away: kept, they would tie a pixel's light to its own number of paths and bias the mean.
    """
    if config.hole_samples <= PILOT_SAMPLES:
        return gather_in_pixels(lit, rays, work, config.hole_samples)
    pilot = gather_in_pixels(lit, rays, dataclasses.replace(work, seed=work.seed + PILOT_SEED), PILOT_SAMPLES)
    total = total + rays.share * pilot.mean[:-1]
    noise_m = range_noise_m(rays.share * pilot.sums[:, noise_lines(work.frequencies_hz)], total, work.frequencies_hz)
    wanted = PILOT_SAMPLES * (noise_m / (config.hole_noise_mm * MM)) ** 2
    doublings = np.ceil(np.log2(np.maximum(wanted / PILOT_SAMPLES, 1)) - 0.5)
    samples = np.minimum(PILOT_SAMPLES * 2**doublings, config.hole_samples)
    return gather_in_pixels(lit, rays, work, samples.astype(np.int64))


def _at_holes(target: Target, optics: Optics, slopes: np.ndarray) -> np.ndarray:
    """Find pixels (h, w) bool whose central ray goes through a hole's mouth, or HOLE_RIM_PX beside it."""
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    found = np.zeros(slopes.shape[:2], bool)
    for hole in target.truth:
        if hole.kind != "dent":
            centre = hole.centre_camera_m
            rim_m = HOLE_RIM_PX * float(centre[2]) / min(optics.lens.fx, optics.lens.fy)
            with np.errstate(divide="ignore", invalid="ignore"):
                on_plane = rays * ((centre @ hole.axis_camera) / (rays @ hole.axis_camera))[..., None]
            found |= np.linalg.norm(on_plane - centre, axis=-1) < hole.diameter_m / 2 + rim_m
    return found
