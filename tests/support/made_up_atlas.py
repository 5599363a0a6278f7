"""An atlas of made-up cameras whose signals follow a law that is known."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import special

from harness import __version__
from harness.programs.atlas.age import sources_digest
from harness.programs.atlas.limits import Conditions, PlaneNoise
from harness.programs.atlas.making import limits_of
from harness.programs.atlas.parts import DEPTHS_MM, Part
from harness.programs.atlas.stored import CameraLimits, write_atlas

THICKNESS_MM = 12.7
FOCAL_PX = 500.0
TITLES = {"sharp": {"sharp": "Sharp One, short mode", "twin": "Twin Two"}, "dim": {"dim": "Dim 2"}}
FIXED_MM = 0.4
SCATTER = 0.2
"""Deviation of ln(signal / threshold) of single damages."""
BETWEEN_SET_UPS = 0.05
"""The same of whole set-ups."""
THRESHOLD = 5.0
DISTANCES_M = (0.3, 0.46, 0.72, 1.1, 1.7, 2.7)
PER_SET_UP = 24
LEVELS = {"through": -2.3}
"""ln(signal / threshold) of wide damage whose depth is the noise; of other kinds 0."""


def noise_mm(camera: str, conditions: Conditions) -> float:
    """The noise of an average: that of a frame grows with the distance and falls with albedo."""
    frame_mm = (
        (2.0 if camera == "dim" else 1.0) * conditions.distance_m / np.sqrt(conditions.albedo)
    )
    return float(np.hypot(frame_mm / np.sqrt(conditions.frames), FIXED_MM))


def log_signal(camera: str, kind: str, conditions: Conditions, size_mm: np.ndarray) -> np.ndarray:
    """ln(signal / threshold) of typical damage: it rises with the size in pixels and with depth
    over noise, and bends at 4 pixels."""
    pixel_mm = conditions.distance_m / FOCAL_PX * 1e3
    depth_mm = conditions.depth_mm + (THICKNESS_MM if kind == "through" else 0.0)
    log_size = np.log(size_mm / pixel_mm)
    bend = 0.5 * np.logaddexp(0, 2 * (np.log(4.0) - log_size))
    x = np.log(noise_mm(camera, conditions) / depth_mm)
    return np.asarray(LEVELS.get(kind, 0.0) - bend - 0.9 * x)


def law_mm(camera: str, kind: str, conditions: Conditions) -> float:
    """The size that is found nine times out of ten; infinite if none is."""
    pixel_mm = conditions.distance_m / FOCAL_PX * 1e3
    sizes_mm = pixel_mm * np.geomspace(0.2, 100, 4001)
    is_found = log_signal(camera, kind, conditions, sizes_mm) >= SCATTER * special.ndtri(0.9)
    return float(sizes_mm[is_found][0]) if is_found.any() else np.inf


def noise_table(camera: str) -> PlaneNoise:
    """The noise of a made-up camera."""
    distances_m = (0.3, 0.6, 0.9, 1.6, 2.7)
    albedos = (0.1, 0.3, 0.9)
    frame_mm = np.zeros((len(distances_m), len(albedos)))
    for row, distance_m in enumerate(distances_m):
        for column, albedo in enumerate(albedos):
            single_mm = noise_mm(camera, Conditions(distance_m, albedo, 1, 1.0))
            frame_mm[row, column] = np.sqrt(single_mm**2 - FIXED_MM**2)
    return PlaneNoise(distances_m, albedos, frame_mm, np.full_like(frame_mm, FIXED_MM))


def damages_of(camera: str, part: Part, stream: np.random.Generator) -> pd.DataFrame:
    """Damages of all kinds as a study of a part records them."""
    tables = []
    for damage in part.damages:
        kind = damage["kind"]
        low_mm, high_mm = damage["width_mm" if kind == "slot" else "diameter_mm"]
        for frames in part.frames:
            size_mm = np.exp(stream.uniform(np.log(low_mm), np.log(high_mm), PER_SET_UP))
            depth_mm = np.full(PER_SET_UP, part.backing_mm)
            if kind != "through":
                depth_mm = stream.uniform(*damage["depth_mm"], PER_SET_UP)
            log_ratio = stream.normal(0, SCATTER, PER_SET_UP) + stream.normal(0, BETWEEN_SET_UPS)
            for index in range(PER_SET_UP):
                conditions = Conditions(part.distance_m, part.albedo, frames, depth_mm[index])
                log_ratio[index] += log_signal(camera, kind, conditions, size_mm[index])
            table = {
                "kind": kind,
                "frames": frames,
                "true_diameter_mm": size_mm,
                "true_depth_mm": THICKNESS_MM if kind == "through" else depth_mm,
                "signal": THRESHOLD * np.exp(np.maximum(log_ratio, -0.3)),
                "threshold": THRESHOLD,
                "detected": log_ratio >= 0,
            }
            tables.append(pd.DataFrame(table))
    return pd.concat(tables, ignore_index=True)


def parts_of_made_up() -> list[Part]:
    """The parts of a made-up camera."""
    parts = []
    for number, distance_m in enumerate(DISTANCES_M):
        part = Part(
            camera="made_up",
            distance_m=distance_m,
            albedo=(0.9, 0.1)[number % 2],
            backing_mm=(15.0, 60.0)[number // 2 % 2],
            pixel_mm=distance_m / FOCAL_PX * 1e3,
            depths_mm=DEPTHS_MM,
        )
        parts.append(part)
    return parts


@functools.cache
def shard(camera: str, seed: int = 1) -> CameraLimits:
    """The shard of a made-up camera."""
    stream = np.random.default_rng([seed, len(camera)])
    noise = noise_table(camera)
    tables = [(part, damages_of(camera, part, stream)) for part in parts_of_made_up()]
    about = {
        "versions": {"tofpod": __version__},
        "digests": {},
        "sources": sources_digest(),
        "detector": "matched",
        "thickness_mm": THICKNESS_MM,
        "focal_px": FOCAL_PX,
    }
    return CameraLimits(
        camera=camera,
        titles=TITLES[camera],
        warning="",
        about=about,
        problems=(),
        failed=(),
        noise=noise,
        kinds=limits_of(tables, noise),
    )


def written(path: Path) -> Path:
    """Write the atlas of both cameras; return its path."""
    write_atlas(path, [shard("sharp"), shard("dim")])
    return path
