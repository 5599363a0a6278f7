"""Frames of a solid gauge by a simulated camera that is wrong in a known way."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np

from harness.programs.camera.gauge_range import seen_ranges_m, triangles_of
from harness.programs.inspections.gauge_solid import designed
from harness.stills.solid_gauge import SOLID_VERSION, VERSION_KEY, SolidGauge, SolidUncertainty
from harness.stills.spheres import range_image
from harness.vocabulary.geometry import MM, rotation_xyz_deg
from scenes.closed_form import image_view
from scenes.sensor.camera import read_camera
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit

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
  offset_mm: {value: 0.0, tag: M, source: test}
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


@cache
def _triangles():
    return triangles_of(exact_gauge())


def recorded(
    folder: Path,
    scale: float = 1.0,
    bias_mm: float = 0.0,
    blur_px: float = 0.0,
    sigma_mm: float = 1.0,
    pattern_mm: float = 0.0,
    dropped: float = 0.0,
    seed: int = 3,
    marks: bool = False,
    frames: int = FRAMES,
) -> list[str]:
    """A capture in tenths of a millimetre with its lens, and the options that read it."""
    text = CAMERA.replace("SIGMA", str(sigma_mm)).replace("PATTERN", str(pattern_mm))
    text = text.replace("BLUR", str(blur_px)).replace("DROPPED", str(dropped))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "wrong_camera.yaml").write_text(text)
    camera = read_camera(folder / "wrong_camera.yaml")
    lens = camera.nominal_lens
    slopes = lens.region_slopes(lens.whole)
    ahead = range_image(np.ones((*slopes.shape[:2], 3)), slopes)
    range_m = seen_ranges_m(_triangles(), ahead.rays, pose())
    # a table below the gauge, far enough for no edge to count
    range_m = np.where(np.isfinite(range_m), range_m, 0.75 / ahead.rays[..., 2])
    z_m = range_m * ahead.rays[..., 2]
    light = np.where(np.isfinite(z_m), 0.6 / range_m**2, 0.0)
    effects = EffectsConfig(unit_offset=False, warm_up_drift=False)
    view = image_view(camera, lens.whole, z_m, light)
    unit = SimulatedUnit(camera, CameraConfig(effects=effects, unit_seed=seed), view)
    taken = [frame.z_m for frame in unit.capture(frames, seed, "gauge").frames()]
    wrong_m = np.stack(taken) * scale + bias_mm * MM * ahead.rays[..., 2]
    stored = np.rint(np.nan_to_num(wrong_m) / (0.1 * MM)).astype(np.uint16)
    np.savez(folder / "gauge.npz", depth=stored)
    facts = {"fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy}
    (folder / "lens.json").write_text(json.dumps(facts))
    truth = {VERSION_KEY: SOLID_VERSION, **exact_gauge().to_data()}
    (folder / "gauge.json").write_text(json.dumps(truth))
    reading = ["--intrinsics", str(folder / "lens.json"), "--unit", "10000/m"]
    gauge = ["--gauge", str(folder / "gauge.json"), "--out", str(folder / "out")]
    return [str(folder / "gauge.npz"), *reading, *gauge]
