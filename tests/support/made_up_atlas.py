"""An atlas of made-up cameras whose limits follow a law that is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from harness import __version__
from harness.programs.atlas.age import sources_digest
from harness.programs.atlas.limits import Conditions, PlaneNoise, SetUp
from harness.programs.atlas.stored import CameraLimits, write_atlas

SCATTER = 0.05
"""Deviation of ln a90 that the intervals state."""
CONTRAST_MM = 20.0
TITLES = {"sharp": {"sharp": "Sharp One, short mode", "twin": "Twin Two"}, "dim": {"dim": "Dim 2"}}
FIXED_MM = 0.4
DISTANCES_M = (0.3, 0.9, 2.7)
DEPTHS_MM = {"through": (None,), "blind": (2.0, 8.0), "dent": (0.5, 2.0), "slot": (2.0, 8.0)}


def noise_mm(camera: str, conditions: Conditions) -> float:
    """The noise of an average: that of a frame grows with the distance and falls with albedo."""
    frame_mm = (
        (2.0 if camera == "dim" else 1.0) * conditions.distance_m / np.sqrt(conditions.albedo)
    )
    return float(np.hypot(frame_mm / np.sqrt(conditions.frames), FIXED_MM))


def law_mm(camera: str, conditions: Conditions) -> float:
    """a90 of a made-up camera: 2.5 pixels at equal noise and depth, with bends that are no
    polynomials of x."""
    ratio = noise_mm(camera, conditions) / (conditions.depth_mm or CONTRAST_MM)
    pixel_mm = conditions.distance_m / 500.0 * 1e3
    return float(pixel_mm * (1.0 + 2.5 * ratio**0.6))


def noise_table(camera: str) -> PlaneNoise:
    """The noise of a made-up camera."""
    distances_m = (0.3, 0.6, 0.9, 1.6, 2.7)
    albedos = (0.1, 0.3, 0.9)
    frame_mm = np.zeros((len(distances_m), len(albedos)))
    for row, distance_m in enumerate(distances_m):
        for column, albedo in enumerate(albedos):
            single_mm = noise_mm(camera, Conditions(distance_m, albedo, 1))
            frame_mm[row, column] = np.sqrt(single_mm**2 - FIXED_MM**2)
    return PlaneNoise(distances_m, albedos, frame_mm, np.full_like(frame_mm, FIXED_MM))


def set_up(camera: str, kind: str, conditions: Conditions, stream: np.random.Generator) -> SetUp:
    """A limit of the law with an error that its interval states."""
    a90_mm = law_mm(camera, conditions) * float(np.exp(stream.normal(0, SCATTER)))
    return SetUp(
        kind=kind,
        conditions=conditions,
        a90_mm=a90_mm,
        low_mm=a90_mm * float(np.exp(-1.96 * SCATTER)),
        high_mm=a90_mm * float(np.exp(1.96 * SCATTER)),
        smallest_mm=0.2 * a90_mm,
        largest_mm=5.0 * a90_mm,
        is_at_most=False,
        hits=40,
    )


def shard(camera: str, seed: int = 1) -> CameraLimits:
    """The shard of a made-up camera."""
    stream = np.random.default_rng([seed, len(camera)])
    set_ups = []
    for kind, depths_mm in DEPTHS_MM.items():
        for depth_mm in depths_mm:
            for distance_m in DISTANCES_M:
                for albedo in (0.1, 0.9):
                    for frames in (1, 50):
                        conditions = Conditions(distance_m, albedo, frames, depth_mm)
                        set_ups.append(set_up(camera, kind, conditions, stream))
    origin = {
        "versions": {"tofpod": __version__},
        "digests": {},
        "sources": sources_digest(),
        "detector": "matched",
        "contrast_mm": CONTRAST_MM,
        "focal_px": 500.0,
    }
    return CameraLimits(
        camera=camera,
        titles=TITLES[camera],
        warning="",
        about=origin,
        noise=noise_table(camera),
        set_ups=tuple(set_ups),
        checks=(),
    )


def written(path: Path) -> Path:
    """Write the atlas of both cameras; return its path."""
    write_atlas(path, [shard("sharp"), shard("dim")])
    return path
