"""Rendering a view: region, direct light, indirect light and its noise, put together."""

from __future__ import annotations

import time

import cv2
import numpy as np

from harness.vocabulary.geometry import Region, invert, rotate_vectors, transform_points
from harness.vocabulary.lens import Lens
from harness.vocabulary.units import MM, SPEED_OF_LIGHT_AIR
from scenes.field_of_view import seen_region
from scenes.optics import Optics
from scenes.render.direct import DirectLight, direct_light, surface_rgb
from scenes.render.indirect import between_nodes, gather_at_points, gather_in_pixels
from scenes.render.scene import LitScene, lit_scene
from scenes.render.settings import RenderConfig
from scenes.render.variant import load_mitsuba
from scenes.target.mesh import Target
from scenes.view import NoiseFreeView

RIM_PX = 3
"""Pixels of surroundings rendered beyond the board's outline, so that its rim looks as on the whole sensor."""


def target_region(target: Target, optics: Optics) -> Region:
    """The region of the sensor that a render of the target covers. Raises UserError as `seen_region` does."""
    tight = seen_region(transform_points(target.T_camera_board, target.outline_board_m), optics)
    return tight.grown(RIM_PX + optics.margin_px, optics.lens.height, optics.lens.width)


def render_view(target: Target, optics: Optics, config: RenderConfig) -> NoiseFreeView:
    """The noise-free view of a target by a camera. Raises UserError as `target_region` and `load_mitsuba` do."""
    began = time.perf_counter()
    mi = load_mitsuba()
    region = target_region(target, optics)
    lens = optics.lens
    lit = lit_scene(mi, target.parts, optics)
    direct = direct_light(lit, lens, region, optics.frequencies_hz)
    slopes = lens.region_slopes(region)
    phasor, intensity = direct.phasor.copy(), direct.intensity.copy()
    noise_m = np.zeros(region.shape)
    if config.bounces > 0:
        indirect, noise_m = _indirect(lit, target, optics, region, slopes, direct, config)
        phasor += indirect[:-1]
        intensity += indirect[-1].real
    return NoiseFreeView(
        region=region,
        frequencies_hz=optics.frequencies_hz,
        phasor=phasor,
        phasor_direct=direct.phasor,
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


def range_noise_m(batches: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """One standard deviation of range, (n,), from phasors of B independent batches (B, f, n) added to light ``total``.

    Linear: a change dH turns the phase by Im(dH / H); frequencies are fused with the least-squares weights
    c f_k / (4 pi sum f^2). The mean over B batches has the batches' deviation over sqrt(B).
    """
    f = np.array(frequencies_hz)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.imag((batches - batches.mean(axis=0)) / total)
    per_batch = (SPEED_OF_LIGHT_AIR * f / (4 * np.pi * (f**2).sum()) * turn).sum(axis=1)
    return np.nan_to_num(per_batch.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def _indirect(
    lit: LitScene,
    target: Target,
    optics: Optics,
    region: Region,
    slopes: np.ndarray,
    direct: DirectLight,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Indirect phasors (f + 1, h, w) and their noise in metres of range (h, w)."""
    frequencies = optics.frequencies_hz
    shape = region.shape
    indirect = np.zeros((len(frequencies) + 1, *shape), complex)
    noise_m = np.zeros(shape)
    face = _on_face(target, direct, slopes)
    if face.any():
        indirect[:, face], noise_m[face] = _face_light(lit, target, frequencies, slopes, direct, face, config)
    inside = _inside_outline(target, optics.lens, region)
    for pixels, samples in ((~face & inside, config.hole_samples), (~face & ~inside, config.rest_samples)):
        if pixels.any():
            corners = _pixel_corners(optics.lens, region, pixels)
            light = gather_in_pixels(lit, corners, frequencies, samples, config.bounces, config.seed)
            indirect[:, pixels] = light.mean
            total = direct.phasor[:, pixels] + light.mean[:-1]
            noise_m[pixels] = range_noise_m(light.sums[:, :-1], total, frequencies)
    return indirect, noise_m


def _face_light(
    lit: LitScene,
    target: Target,
    frequencies: tuple[float, ...],
    slopes: np.ndarray,
    direct: DirectLight,
    face: np.ndarray,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Indirect light of the pixels on the face (f + 1, n) and its noise (n,), from nodes on the undamaged face.

    Nodes float 1 mm above the face, so that tape does not bury them; what a node would see of a hole is taken as if the
    face were whole: an error of the order of the light from the hole's solid angle.
    """
    points = np.concatenate([slopes[face], np.ones((int(face.sum()), 1))], axis=-1)
    points *= (direct.range_m[face] / np.linalg.norm(points, axis=-1))[:, None]
    board = transform_points(invert(target.T_camera_board), points)
    xs, ys = (_node_places(board[:, k], config.face_spacing_mm * MM) for k in range(2))
    grid_y, grid_x = np.meshgrid(ys, xs, indexing="ij")
    position, normal = _above_face(target, grid_x.ravel(), grid_y.ravel())
    light = gather_at_points(lit, position, normal, frequencies, config.face_samples, config.bounces - 1, config.seed)
    wave = 2 * np.pi * np.array([*frequencies, 0.0])[:, None] / SPEED_OF_LIGHT_AIR
    to_lens = np.exp(1j * wave * direct.range_m[face])
    albedo = np.zeros(int(face.sum()))
    for index, part in enumerate(target.parts):
        here = direct.surface[face] == index
        albedo[here] = part.albedo_850_at(direct.uv[face][here]) if here.any() else 0.0

    sums = np.concatenate([light.mean[None], light.sums])
    nodes = sums.reshape(-1, len(ys), len(xs))
    at_pixels = albedo * between_nodes(xs, ys, nodes, board[:, 0], board[:, 1])
    mean, *batches = at_pixels.reshape(len(sums), len(frequencies) + 1, -1) * to_lens
    return mean, range_noise_m(np.stack(batches)[:, :-1], direct.phasor[:, face] + mean[:-1], frequencies)


def _node_places(values: np.ndarray, spacing: float) -> np.ndarray:
    """At least four evenly spaced places over the range of values."""
    low, high = float(values.min()), float(values.max())
    return np.linspace(low, high, max(int(np.ceil((high - low) / spacing)) + 1, 4))


def _above_face(target: Target, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points 1 mm above the undamaged face and its unit normals, both (n, 3) in the camera's frame."""
    step = 1e-5
    z = target.face_height_m(x, y)
    slope_x = (target.face_height_m(x + step, y) - target.face_height_m(x - step, y)) / (2 * step)
    slope_y = (target.face_height_m(x, y + step) - target.face_height_m(x, y - step)) / (2 * step)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    point = np.stack([x, y, z], axis=-1) + 1 * MM * normal
    return transform_points(target.T_camera_board, point), rotate_vectors(target.T_camera_board, normal)


def _on_face(target: Target, direct: DirectLight, slopes: np.ndarray) -> np.ndarray:
    """(h, w) bool: pixels whose whole footprint is smooth and lies within 0.5 mm (tape) of the undamaged face."""
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    board = transform_points(invert(target.T_camera_board), rays * np.nan_to_num(direct.range_m)[..., None])
    height = board[..., 2] - target.face_height_m(board[..., 0], board[..., 1])
    half_width, half_height = np.abs(target.outline_board_m[:, :2]).max(axis=0)
    over = (np.abs(board[..., 0]) <= half_width) & (np.abs(board[..., 1]) <= half_height)
    return over & (np.abs(height) < 0.5 * MM) & ~direct.fine & np.isfinite(direct.range_m)


def _inside_outline(target: Target, lens: Lens, region: Region) -> np.ndarray:
    """(h, w) bool: pixels within the face's outline as the camera sees it."""
    uv = lens.project(transform_points(target.T_camera_board, target.outline_board_m))
    polygon = np.round(uv - [region.col0, region.row0]).astype(np.int32)
    return cv2.fillPoly(np.zeros(region.shape, np.uint8), [polygon], (1,)).astype(bool)


def _pixel_corners(lens: Lens, region: Region, pixels: np.ndarray) -> np.ndarray:
    """Slopes of the corners (n, 4, 2) of the chosen pixels, in the order 00 01 10 11 (row, column)."""
    v, u = np.mgrid[region.row0 : region.row1 + 1, region.col0 : region.col1 + 1] - 0.5
    corner = lens.slopes(u, v)
    rows, cols = np.nonzero(pixels)
    return np.stack(
        [corner[rows, cols], corner[rows, cols + 1], corner[rows + 1, cols], corner[rows + 1, cols + 1]], axis=1
    )
