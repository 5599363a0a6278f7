"""Frames of a solid gauge by a simulated camera that is wrong in a known way."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from harness.programs.camera.gauge_range import seen_ranges_m, triangles_of
from harness.programs.inspections.gauge_solid import designed
from harness.stills.solid_gauge import SOLID_VERSION, VERSION_KEY, SolidGauge, SolidUncertainty
from harness.stills.spheres import range_image
from harness.vocabulary.geometry import MM, Lens, invert, rotation_xyz_deg, transform_points
from scenes.closed_form import image_view
from scenes.sensor.camera import read_camera
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit

CAMERA_NAME = "wrong_camera"
CAMERA = """
name: wrong_camera
title: A camera
kind: empirical
wavelength_nm: {value: 850.0, tag: M, source: test}
lens:
  width_px: {value: 240, tag: M, source: test}
  height_px: {value: 224, tag: M, source: test}
  fx_px: {value: 430.0, tag: M, source: test}
  fy_px: {value: 430.0, tag: M, source: test}
  cx_px: {value: 119.0, tag: M, source: test}
  cy_px: {value: 112.0, tag: M, source: test}
  distortion: {value: [], tag: M, source: test}
unit:
  frames_per_second: {value: 30.0, tag: M, source: test}
  offset_mm: {value: OFFSET, tag: M, source: test}
  drift_mm: {value: 0.0, tag: M, source: test}
  drift_min: {value: 20.0, tag: M, source: test}
  drift_ramp: {value: 0.0, tag: M, source: test}
  jump_rate: {value: 0.0, tag: M, source: test}
  jump_mm: {value: 0.0, tag: M, source: test}
  jitter_mm: {value: 0.1, tag: M, source: test}
light:
  amplitude_at_1m: {value: 400.0, tag: M, source: test}
  albedo: {value: 0.6, tag: M, source: test}
noise:
  range_mm: {value: [500.0], tag: M, source: test}
  sigma_mm: {value: [SIGMA], tag: M, source: test}
  range_exponent: {value: 2.0, tag: M, source: test}
  brightness_exponent: {value: 0.5, tag: M, source: test}
  rows: {value: [1.0], tag: M, source: test}
  columns: {value: [1.0], tag: M, source: test}
fixed_pattern:
  deviation_mm: {value: PATTERN, tag: M, source: test}
  rows: {value: [0.577, 0.577, 0.577], tag: M, source: test}
  columns: {value: [0.577, 0.577, 0.577], tag: M, source: test}
dropouts:
  amplitude: {value: [10.0, 10000.0], tag: M, source: test}
  share: {value: [DROPPED, DROPPED], tag: M, source: test}
edge:
  gap_px: {value: 0.0, tag: M, source: test}
  blur_px: {value: BLUR, tag: M, source: test}
  least_step_mm: {value: 20.0, tag: M, source: test}
engine:
  min_range_mm: {value: 0.0, tag: M, source: test}
  max_range_mm: {value: 20000.0, tag: M, source: test}
  output_step_mm: {value: 0.1, tag: M, source: test}
"""
FRAMES = 12
TABLE_M = 0.75
LENS = Lens(width=240, height=224, fx=430.0, fy=430.0, cx=119.0, cy=112.0)
"""That of the camera's file."""


def exact_gauge() -> SolidGauge:
    """The printed gauge, as exact as its facets, which are within 9 um of round."""
    exact = SolidUncertainty(place_mm=0.01, scale=0.0)
    return designed(is_cut=False).model_copy(update={"uncertainty": exact})


def pose() -> np.ndarray:
    """``T_camera_gauge``: 0.47 m away, turned by 25 degrees and less about all axes."""
    T = np.eye(4)
    T[:3, :3] = rotation_xyz_deg(180 - 25, 12, 8)
    T[:3, 3] = [0.005, -0.004, 0.47]
    return T


BLACK = 0.08
WHITE = 0.6
SIDE = 8  # rays along each side of a pixel at an edge


@cache
def _seen(placed: bytes, gauge_json: str) -> tuple[np.ndarray, np.ndarray]:
    """Range (h, w) and reflected share of light (h, w) of the gauge at a pose, in pixels that
    average over their area: at edges by rays of a stratified draw, none of the program's own."""
    gauge = SolidGauge.model_validate_json(gauge_json)
    T_camera_gauge = np.frombuffer(placed).reshape(4, 4)
    triangles = triangles_of(gauge)
    rays = _ahead()
    range_m = _with_table(seen_ranges_m(triangles, rays, T_camera_gauge), rays)
    albedo = _albedo(gauge, T_camera_gauge, rays, range_m)
    step_m = ndimage.maximum_filter(range_m, 3) - ndimage.minimum_filter(range_m, 3)
    change = ndimage.maximum_filter(albedo, 3) - ndimage.minimum_filter(albedo, 3)
    mixed = (step_m > 2 * MM) | (change > 0)
    by_row = np.gradient(rays, axis=0)[mixed]
    by_column = np.gradient(rays, axis=1)[mixed]
    rng = np.random.default_rng(8)
    parts = []
    for cell in np.ndindex(SIDE, SIDE):
        down, across = (np.array(cell) + rng.random((len(by_row), 2))).T / SIDE - 0.5
        part = rays[mixed] + down[:, None] * by_row + across[:, None] * by_column
        parts.append(part / np.linalg.norm(part, axis=-1, keepdims=True))
    rays_of_parts = np.stack(parts)
    parts_m = seen_ranges_m(triangles, rays_of_parts, T_camera_gauge)
    parts_m = _with_table(parts_m, rays_of_parts)
    range_m[mixed] = parts_m.mean(axis=0)
    albedo[mixed] = _albedo(gauge, T_camera_gauge, rays_of_parts, parts_m).mean(axis=0)
    return range_m, albedo


@cache
def _ahead() -> np.ndarray:
    """Rays (h, w, 3) of the camera's pixels."""
    slopes = LENS.region_slopes(LENS.whole)
    return range_image(np.ones((*slopes.shape[:2], 3)), slopes).rays


def _with_table(range_m: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Ranges (...) with a table below the gauge, far enough for no edge to count."""
    return np.where(np.isfinite(range_m), range_m, TABLE_M / rays[..., 2])


def _albedo(
    gauge: SolidGauge, T_camera_gauge: np.ndarray, rays: np.ndarray, range_m: np.ndarray
) -> np.ndarray:
    """Albedo (...) where rays (..., 3) end: black in the recesses of the marks."""
    points_mm = transform_points(invert(T_camera_gauge), rays * range_m[..., None]) / MM
    albedo = np.full(range_m.shape, WHITE)
    floor = np.abs(points_mm[..., 2] + gauge.mark_depth_mm) < 0.01
    for mark in gauge.marks:
        off_mm = np.abs(points_mm[..., :2] - [mark.x_mm, mark.y_mm]).max(axis=-1)
        albedo[floor & (off_mm < mark.side_mm / 2 + 0.1)] = BLACK
    return albedo


def recorded(
    folder: Path,
    scale: float = 1.0,
    bias_mm: float = 0.0,
    blur_px: float = 0.0,
    sigma_mm: float = 1.0,
    pattern_mm: float = 0.0,
    dropped: float = 0.0,
    seed: int = 3,
    frames: int = FRAMES,
    offset_mm: float = 0.0,
    infrared: bool = False,
    gauge: SolidGauge | None = None,
    T_camera_gauge: np.ndarray | None = None,
) -> list[str]:
    """A capture in tenths of a millimetre with its lens, and the options that read it with the
    truth of the exact gauge. ``offset_mm``: deviation of the units' offsets."""
    gauge = gauge or exact_gauge()
    T_camera_gauge = pose() if T_camera_gauge is None else T_camera_gauge
    text = CAMERA.replace("SIGMA", str(sigma_mm)).replace("PATTERN", str(pattern_mm))
    text = text.replace("BLUR", str(blur_px)).replace("DROPPED", str(dropped))
    text = text.replace("OFFSET", str(offset_mm))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "wrong_camera.yaml").write_text(text)
    camera = read_camera(folder / "wrong_camera.yaml")
    rays = _ahead()
    range_m, albedo = _seen(T_camera_gauge.tobytes(), gauge.model_dump_json())
    effects = EffectsConfig(unit_offset=offset_mm > 0, warm_up_drift=False)
    view = image_view(camera, LENS.whole, range_m * rays[..., 2], albedo / range_m**2)
    unit = SimulatedUnit(camera, CameraConfig(effects=effects, unit_seed=seed), view)
    taken = list(unit.capture(frames, seed, "gauge").frames())
    shown_m = np.stack([frame.z_m for frame in taken])
    wrong_m = shown_m * scale + bias_mm * MM * rays[..., 2]
    arrays = {"depth": np.rint(np.nan_to_num(wrong_m) / (0.1 * MM)).astype(np.uint16)}
    if infrared:
        arrays["ir"] = np.stack([frame.amplitude for frame in taken])
    np.savez(folder / "gauge.npz", **arrays)
    facts = {"fx": LENS.fx, "fy": LENS.fy, "cx": LENS.cx, "cy": LENS.cy}
    (folder / "lens.json").write_text(json.dumps(facts))
    truth = {VERSION_KEY: SOLID_VERSION, **exact_gauge().to_data()}
    (folder / "gauge.json").write_text(json.dumps(truth))
    reading = ["--intrinsics", str(folder / "lens.json"), "--unit", "10000/m"]
    gauge = ["--gauge", str(folder / "gauge.json"), "--out", str(folder / "out")]
    return [str(folder / "gauge.npz"), *reading, *gauge]
