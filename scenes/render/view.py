"""Renders a view: determines its region, and combines direct light, indirect light and the noise
of the latter.

Direct light is sampled finely where a pixel sees an edge (`scenes.render.direct`). Indirect light
has met at least two surfaces. That of the board's undamaged face is interpolated between nodes
(`scenes.render.face`); all other is gathered along paths from each pixel
(`scenes.render.indirect`)."""

import time

import cv2
import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import MM, Lens, Region, invert, transform_points
from scenes.optics import NoiseFreeView, Optics, RenderConfig, footprint_of
from scenes.perspectives import seen_region
from scenes.render.direct import DirectLight, direct_light
from scenes.render.face import face_light, face_triangles
from scenes.render.indirect import PathWork, gather_in_pixels
from scenes.render.range_noise import noise_lines, range_noise_m
from scenes.render.scene import LitScene, lit_scene, load_mitsuba
from scenes.target.mesh import Target

# rendered surroundings of the board's outline, so that its rim looks as on the whole sensor
RIM_PX = 3
# beyond the outline, edges behind the board are finely sampled: the camera's filter mixes these
# pixels in
NEAR_PX = 3
HOLE_RIM_PX = 1  # on both sides of a hole's rim, pixels are sampled finely
# damage that may lie between a pixel's corners and its centre
NARROW = ("through", "blind", "slot", "gouge", "chip")
# a face's slope is at most 4 / 3, so that lengths on it are at most 5 / 3 of those in plan
NEARBY = 2.0
FIRST_SAMPLES = 32  # paths of each pixel inside the outline before it is known how many are needed
# the pixels around a pixel, without it, whose first paths show how many it needs: 768 paths seldom
# miss bright light
AROUND = 1.0 - np.eye(25)[12].reshape(5, 5)


def target_region(target: Target, optics: Optics) -> Region:
    """Return the region of the sensor that a render of the target covers. Raises UserError as
    `seen_region` does."""
    tight = seen_region(target.config, optics)
    return tight.grown(RIM_PX + optics.margin_px, optics.lens.height, optics.lens.width)


def render_view(
    target: Target,
    optics: Optics,
    config: RenderConfig,
    region: Region | None = None,
) -> NoiseFreeView:
    """Render the noise-free view of a target by a camera, on ``region`` or on that of the target.
    Raises UserError as `target_region` and `load_mitsuba` do."""
    began = time.perf_counter()
    mi = load_mitsuba()
    if region is None:
        region = target_region(target, optics)
    lit = lit_scene(mi, target.parts, optics, face_triangles(target))
    slopes = optics.lens.region_slopes(region)
    inside = _inside_outline(target, optics.lens, region)
    direct = direct_light(
        lit,
        slopes,
        footprint_of(optics.lens, region, optics.beam_fwhm_rad),
        optics.frequencies_hz,
        closely=_at_holes(target, optics.lens, slopes),
        roughly=~ndimage.binary_dilation(inside, np.ones((3, 3), bool), NEAR_PX),
    )
    phasor = direct.phasor
    intensity = direct.intensity
    noise_m = np.zeros(region.shape)
    if config.bounces > 0:
        indirect, noise_m = indirect_light(
            lit,
            target,
            optics,
            slopes,
            direct,
            inside,
            config,
        )
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
        surface_names=tuple(part.name for part in target.parts),
        coverage=direct.coverage,
        rgb=_rgb_of(target, direct),
        slopes=slopes,
        seconds=time.perf_counter() - began,
        variant=mi.variant(),
    )


def _inside_outline(
    target: Target,
    lens: Lens,
    region: Region,
) -> np.ndarray:
    """Return which pixels (h, w) lie within the face's outline as the camera sees it; all if a
    part of the outline is out of view."""
    outline = transform_points(target.T_camera_board, target.outline_board_m)
    if not lens.images(outline).all():
        return np.ones(region.shape, bool)
    polygon = np.round(lens.project(outline) - [region.col0, region.row0]).astype(np.int32)
    image = np.zeros(region.shape, np.uint8)
    return np.asarray(cv2.fillPoly(image, [polygon], (1,)).astype(bool))


def _rgb_of(target: Target, direct: DirectLight) -> np.ndarray:
    """Return the albedo in red, green and blue (h, w, 3) that each pixel's central ray meets; 0
    where it meets nothing."""
    rgb = np.zeros((*direct.surface.shape, 3), np.float32)
    for index, part in enumerate(target.parts):
        pixels = direct.surface == index
        rgb[pixels] = part.rgb_at(direct.uv[pixels])
    return rgb


def _at_holes(
    target: Target,
    lens: Lens,
    slopes: np.ndarray,
) -> np.ndarray:
    """Return 1 in pixels (h, w) whose central ray passes the mouth of `NARROW` damage, 2 within
    HOLE_RIM_PX of its rim on both sides, 0 elsewhere."""
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    closeness = np.zeros(slopes.shape[:2], np.int8)
    T_board_camera = invert(target.T_camera_board)
    for hole, declared in zip(target.truth, target.config.damages, strict=True):
        if hole.kind not in NARROW:
            continue
        centre = hole.centre_camera_m
        axis = hole.axis_camera
        rim_m = HOLE_RIM_PX * float(centre[2]) / min(lens.fx, lens.fy)
        chamfer_m = declared.reach_mm * MM - hole.reach_m
        near = _around(slopes, centre, NEARBY * (hole.reach_m + rim_m + chamfer_m))
        near_rays = rays[near]
        with np.errstate(divide="ignore", invalid="ignore"):
            on_plane = near_rays * ((centre @ axis) / (near_rays @ axis))[:, None]
        x_m, y_m, _ = transform_points(T_board_camera, on_plane).T
        in_mouth = hole.within(x_m, y_m, rim_m + chamfer_m)
        off_rim = hole.within(x_m[in_mouth], y_m[in_mouth], -rim_m)
        near[near] = in_mouth
        closeness[near] = np.maximum(closeness[near], 2 - off_rim)
    return closeness


def _around(slopes: np.ndarray, centre: np.ndarray, radius_m: float) -> np.ndarray:
    """Return which rays (h, w) may come within a radius of a point (3,) before the lens: no point
    of that ball is farther off the centre's slope."""
    slope = centre[:2] / centre[2]
    farthest = radius_m * np.sqrt(1 + slope @ slope) / max(centre[2] - radius_m, 1e-9)
    off = np.abs(slopes - slope)
    return np.asarray((off[..., 0] <= farthest) & (off[..., 1] <= farthest))


def indirect_light(
    lit: LitScene,
    target: Target,
    optics: Optics,
    slopes: np.ndarray,
    direct: DirectLight,
    inside: np.ndarray,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Return indirect phasors (f + 1, h, w), intensity last, and their noise in metres of range
    (h, w). That of the face comes from its nodes, all other from paths through the pixel's
    sub-rays; inside the outline, ``inside`` (h, w), noise sets their number."""
    frequencies_hz = optics.frequencies_hz
    shape = direct.range_m.shape
    indirect = np.zeros((len(frequencies_hz) + 1, direct.range_m.size), complex)
    variance_m2 = np.zeros(direct.range_m.size)
    total = direct.phasor.reshape(len(frequencies_hz), -1).copy()
    face_pixels = np.flatnonzero(direct.face[-1].real)
    if face_pixels.size:
        work = PathWork(frequencies_hz, config.bounces - 1, config.seed)
        light, noise_m = face_light(
            lit,
            target,
            direct,
            slopes,
            work,
            config,
        )
        indirect[:, face_pixels] = light
        total[:, face_pixels] += light[:-1]
        variance_m2[face_pixels] = noise_m**2
    rays = direct.off_face
    pixels = rays.pixel
    if pixels.size:
        work = PathWork(frequencies_hz, config.bounces, config.seed)
        within = inside.ravel()[pixels]
        light = _light_in_pixels(
            lit,
            direct,
            total[:, pixels],
            within,
            work,
            config,
        )
        mean = rays.share * light.mean(axis=0, dtype=complex)
        indirect[:, pixels] += mean
        total[:, pixels] += mean[:-1]
        batches = rays.share * light[:, noise_lines(frequencies_hz)]
        variance_m2[pixels] += range_noise_m(batches, total[:, pixels], frequencies_hz) ** 2
    return indirect.reshape(-1, *shape), np.sqrt(variance_m2).reshape(shape)


def _light_in_pixels(
    lit: LitScene,
    direct: DirectLight,
    total: np.ndarray,
    within: np.ndarray,
    work: PathWork,
    config: RenderConfig,
) -> np.ndarray:
    """Return the light (B, f + 1, p) of paths through the sub-rays off the face, in enough of
    them.

    In the pixels ``within`` (p,), a few first paths show how noisy the range is; the number of
    paths is then doubled until noise is expected to be ``hole_noise_mm``.

    ``total`` (f, p): all other light."""
    rays = direct.off_face
    first = min(FIRST_SAMPLES, config.hole_samples)
    samples = np.where(within, first, config.rest_samples)
    light = gather_in_pixels(lit, rays, work, samples)
    inner = light[..., within]
    share = rays.share[within]
    mean = inner.mean(axis=0, dtype=complex)
    batches = share * inner[:, noise_lines(work.frequencies_hz)]
    other_light = total[:, within]
    noise_m = range_noise_m(batches, other_light + share * mean[:-1], work.frequencies_hz)
    expected_m = _expected_noise_m(
        direct.range_m.shape, rays.pixel[within], other_light[0] / share, mean[0], noise_m
    )

    wanted = (expected_m / (config.hole_noise_mm * MM)) ** 2
    doublings = np.ceil(np.log2(np.clip(wanted, 1, config.hole_samples)) - 0.5)
    samples = np.zeros(len(within), np.int64)
    samples[within] = np.clip(first * 2**doublings, first, config.hole_samples)
    noisy = samples > first
    if noisy.any():
        additional = gather_in_pixels(
            lit, rays.chosen(noisy), work, (samples - first)[noisy], after=first
        )
        light[..., noisy] += (1 - first / samples[noisy]) * (additional - light[..., noisy])
    return light


def _expected_noise_m(
    shape: tuple[int, ...],
    pixels: np.ndarray,
    other_light: np.ndarray,
    mean: np.ndarray,
    noise_m: np.ndarray,
) -> np.ndarray:
    """Return the noise of range (n,) to expect in pixels off the face, from the pixels around
    them.

    A pixel's own paths do not decide: those that missed rare bright light would end too soon, and
    the mean would be biased. Noise of range times the light is noise of the light; the mean of its
    square over the pixels around, over the light that they suggest, is noise of range again.

    ``pixels`` (n,): flat indices in an image of this shape. ``other_light`` (n,): all other
    phasors at the first frequency, over the share of the footprint off the face. ``mean`` (n,):
    indirect ones. ``noise_m`` (n,): the noise of range."""
    light_variance = (noise_m * np.abs(other_light + mean)) ** 2
    image = np.zeros((*shape, 4))
    counted = np.ones(len(pixels))
    image.reshape(-1, 4)[pixels] = np.stack([counted, light_variance, mean.real, mean.imag], -1)
    sums = cv2.filter2D(image, -1, AROUND, borderType=cv2.BORDER_CONSTANT)
    sums = sums.reshape(-1, 4)[pixels]
    count, variance, real, imaginary = (sums / np.maximum(sums[:, :1], 1)).T
    expected_m = np.sqrt(variance) / np.maximum(np.abs(other_light + real + 1j * imaginary), 1e-30)
    return np.where(count > 0, expected_m, noise_m)
