"""Result tables with known answers: what an experiment would leave if its statistics were exactly
as asked for."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from harness.records.examples import ExampleCloud, HoleInView


@dataclass(frozen=True)
class Tables:
    """Has the tables of `harness.records.trials.ResultTables`."""

    holes: pd.DataFrame
    runs: pd.DataFrame
    probes: pd.DataFrame
    variants: pd.DataFrame
    noise: pd.DataFrame
    axes: pd.DataFrame
    registrations: pd.DataFrame = field(default_factory=pd.DataFrame)


DIAMETERS_MM = 25.4 * np.array([1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 16]) / 16
FRAMES = (1, 2, 5, 10, 20, 50)
OFFSETS_MM = 50.8 * np.arange(10, -1, -1.0)


@dataclass(frozen=True)
class World:
    """The answers. ``rate(hole, frames)`` is the exact share of repeats that detect; scatters are
    standard deviations.

    Sizes and positions are drawn and then rescaled, so that a hole detected in every repeat has
    exactly the mean and standard deviation asked for.
    """

    rate: Callable[[int, int], float] = lambda hole, frames: float(
        hole >= (4 if frames >= 10 else 5)
    )
    size_bias_mm: Callable[[float], float] = lambda diameter: 2.0 / diameter
    size_std_mm: float = 1.2
    model_bias_mm: float = 0.1
    place_bias_mm: float = 0.2
    place_std_mm: float = 2.4
    threshold: Mapping[int, float] | None = None
    temporal_mm: Callable[[int], float] = lambda frames: 0.9 / float(np.sqrt(frames))
    pattern_mm: Callable[[int], float] = lambda frames: 0.3
    offset_mm: float = 0.2
    repeats: int = 50
    seed: int = 1

    def changed(self, **changes: object) -> World:
        return replace(self, **changes)  # type: ignore[arg-type]


def tables(
    world: World | None = None, frames: tuple[int, ...] = FRAMES, variant: str = "main"
) -> Tables:
    """The four tables of one variant."""
    world = world or World()
    rng = np.random.default_rng(world.seed)
    variants = pd.DataFrame(
        [
            {
                "variant": variant,
                "reason": "as declared",
                "settings": json.dumps({"seed": 1}),
                "is_variation": variant != "main",
                "reference": "main",
                "switches": "",
            }
        ]
    )
    return Tables(
        noise=pd.concat([_noise(world, variant, n) for n in frames], ignore_index=True),
        axes=pd.DataFrame(columns=["path", "name", "unit"]),
        holes=pd.concat([_holes(world, rng, variant, n) for n in frames], ignore_index=True),
        runs=pd.concat([_runs(world, rng, variant, n) for n in frames], ignore_index=True),
        probes=_probes(world, rng, variant, frames),
        variants=variants,
    )


def joined(*parts: Tables) -> Tables:
    """Several variants in one set of tables."""
    names = ("holes", "runs", "probes", "variants", "noise")
    together = {
        name: pd.concat([getattr(part, name) for part in parts], ignore_index=True)
        for name in names
    }
    return Tables(**together, axes=parts[0].axes)


CAMERAS = ("azure_kinect_nfov", "kinect_v2", "realsense_l515")
CAMERA_AXES = pd.DataFrame(
    [
        {"path": "source.camera.name", "name": "camera", "unit": ""},
        {"path": "source.target.distance_m", "name": "distance", "unit": "m"},
    ]
)


def placed(part: Tables, camera: str, distance_m: float, of: str = "") -> Tables:
    """One variant's tables as a set-up of the camera comparison, or as a variation of the set-up
    called ``of``."""
    position = {"source.camera.name": camera, "source.target.distance_m": distance_m}
    name = set_up_name(camera, distance_m)
    part = replace(
        part,
        axes=CAMERA_AXES,
        variants=part.variants.assign(is_variation=bool(of), reference=of or name),
    )
    names = ("holes", "runs", "probes", "variants", "noise")
    return replace(part, **{name: getattr(part, name).assign(**position) for name in names})


def set_up_name(camera: str, distance_m: float) -> str:
    """What the experiment calls this set-up."""
    return f"camera={camera}, distance={distance_m:g} m"


def cameras(
    smallest: Mapping[str, Sequence[int]],
    distances_m: Sequence[float] = (0.5, 1.0),
    world: World | None = None,
) -> Tables:
    """A comparison in which a camera finds, at each distance in turn, its ``smallest`` hole and
    all larger ones in every repeat, with one frame one hole fewer."""
    world = world or World(repeats=12)
    return joined(
        *(
            placed(
                tables(
                    world.changed(
                        rate=lambda hole, frames, first=first: float(hole >= first + (frames == 1))
                    ),
                    (1, 50),
                    set_up_name(camera, distance),
                ),
                camera,
                distance,
            )
            for camera in CAMERAS
            for distance, first in zip(distances_m, smallest[camera], strict=True)
        )
    )


def example(
    frames: int = 50, shape: str = "bowl", variant: str = "main", noise_mm: float = 0.2
) -> ExampleCloud:
    """A frontal board at 0.8 m whose holes (12.7 mm deep) look like a bowl or a cylinder; 1.6 mm a
    pixel, 60 x 380."""
    height = 60
    width = 380
    pitch_mm = 1.6
    z_mm = 800.0
    rng = np.random.default_rng(frames)
    v, u = np.indices((height, width), dtype=float)
    truth = []
    z_truth = np.full((height, width), z_mm)
    depth = np.zeros((height, width))
    detected = np.zeros((height, width), bool)
    for number, (diameter, offset) in enumerate(
        zip(DIAMETERS_MM, OFFSETS_MM, strict=True), start=1
    ):
        hole = HoleInView(
            str(number), 348.3 - offset / pitch_mm, 29.4, diameter / 2 / pitch_mm, diameter, 12.7
        )
        rho = np.hypot(u - hole.u_px, v - hole.v_px) / hole.radius_px
        z_truth[rho < 1] += hole.depth_mm
        rounded = (
            np.sqrt(np.clip(1 - rho**2, 0, None)) if shape == "bowl" else (rho < 1).astype(float)
        )
        depth += hole.depth_mm * rounded
        if number >= (4 if frames >= 10 else 5):
            detected |= (rho < 1) & (depth > 1)
        truth.append(hole)
    residual = depth + rng.normal(0, noise_mm, depth.shape)
    residual[:3, :5] = np.nan
    inside = np.ones((height, width), bool)
    inside[:, :2] = False
    return ExampleCloud(frames, variant, residual, detected, inside, tuple(truth), z_truth)


def provenance() -> dict[str, object]:
    """What an engine would tell of a run."""
    return {
        "command": "python -m harness.sweep experiments/averaging.yaml",
        "commit": "0123456789abcdef",
        "dirty": True,
        "versions": {"tofpod": "0.1.0", "numpy": "2.4.6"},
        "mitsuba_variant": "llvm_ad_mono",
        "seed": 7,
        "machine": "two cores, 8 GiB",
        "started": "2025-01-02T03:04:05Z",
        "seconds": {"render": 31.2, "frames": 44.0, "detect": 12.5},
        "indirect_noise_mm": {"median": 0.02, "largest": 0.11},
        "cache_hits": 3,
        "failures": [],
    }


def _exactly(rng: np.random.Generator, n: int, mean: float, std: float) -> np.ndarray:
    """``n`` values with exactly this mean and standard deviation (n - 1)."""
    values = rng.normal(size=n)
    if n == 1:
        return np.array([mean])
    return mean + std * (values - values.mean()) / values.std(ddof=1)


def _holes(world: World, rng: np.random.Generator, variant: str, frames: int) -> pd.DataFrame:
    n = world.repeats
    parts = []
    of_all: dict[str, object] = {
        "point": f"{variant}-{frames}",
        "variant": variant,
        "frames": frames,
    }
    of_all |= {
        "kind": "through",
        "true_depth_mm": 12.7,
        "seen_depth_mm": 12.7,
        "true_y_mm": 0.0,
        "threshold": 4.0,
    }
    of_all |= {"model_note": "", "invalid_fraction": 0.1, "median_residual_mm": 3.0}
    for number, (diameter, offset) in enumerate(
        zip(DIAMETERS_MM, OFFSETS_MM, strict=True), start=1
    ):
        detected = np.arange(n) < round(world.rate(number, frames) * n)
        size = _exactly(rng, n, diameter + world.size_bias_mm(diameter), world.size_std_mm)
        model = _exactly(rng, n, diameter + world.model_bias_mm, 0.3)
        position = (
            _exactly(rng, n, offset + world.place_bias_mm, world.place_std_mm)
            if offset
            else np.zeros(n)
        )
        measured = {
            "score": np.full(n, 9.0),
            "points": np.full(n, float(max(round(diameter**2 / 4), 1))),
            "extent_diameter_mm": size,
            "extent_offset_mm": position,
            "extent_error_mm": np.abs(position - offset) + 0.5,
            "model_diameter_mm": model,
            "model_diameter_se_mm": np.full(n, 0.3),
            "model_depth_mm": np.full(n, 10.0),
            "model_depth_se_mm": np.full(n, 0.5),
            "model_offset_mm": np.full(n, offset) + 0.1,
            "model_error_mm": np.full(n, 0.4),
        }
        of_hole = {"hole": str(number), "true_diameter_mm": diameter, "true_x_mm": 254.0 - offset}
        of_hole |= {"true_offset_mm": offset}
        columns = {name: np.full(n, value) for name, value in of_hole.items()} | {
            "repeat": np.arange(n)
        }
        columns |= {"detected": detected, "state": np.where(detected, "found", "invisible")}
        columns |= {"signal": np.where(detected, 9.0, 3.0)}
        parts.append(
            columns | {name: np.where(detected, v, np.nan) for name, v in measured.items()}
        )
    # one frame: tests make hundreds, and joining one for each hole took most of their time
    return pd.DataFrame(
        of_all | {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    )


def _runs(world: World, rng: np.random.Generator, variant: str, frames: int) -> pd.DataFrame:
    n = world.repeats
    scale = 0.25 + 0.65 / np.sqrt(frames)
    threshold = (world.threshold or {}).get(frames, 5.0)
    parts = []
    for role in ("damaged", "hole_free"):
        parts.append(
            pd.DataFrame(
                {
                    "variant": variant,
                    "frames": frames,
                    "repeat": np.arange(n),
                    "role": role,
                    "false_calls": (np.arange(n) == 3).astype(int) if role == "damaged" else 0,
                    "detections": 8 if role == "damaged" else 0,
                    "threshold": threshold if role == "damaged" else np.nan,
                    "quiet_threshold": np.nan
                    if role == "damaged"
                    else threshold - 0.02 * np.arange(n),
                    "scale_mm": scale + rng.normal(0, 0.003, n),
                    "surface_noise_mm": 0.9 / np.sqrt(frames),
                    "frames_used": frames,
                    "left_out": 0,
                    "seconds_frames": 0.008 * frames,
                    "seconds_detect": 0.05,
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def _noise(world: World, variant: str, frames: int) -> pd.DataFrame:
    grain = {
        f"correlation_{direction}{lag}": 1 - (0.2 if direction == "u" else 0.3) * lag
        for direction in "uv"
        for lag in (1, 2, 3)
    }
    return pd.DataFrame(
        {
            "variant": variant,
            "frames": frames,
            "repeat": np.arange(world.repeats),
            "valid_share": 0.97,
            "pitch_u_mm": 1.5,
            "pitch_v_mm": 1.4,
            "single_frame_mm": world.temporal_mm(1),
            **grain,
        }
    )


def _probes(
    world: World, rng: np.random.Generator, variant: str, frames: tuple[int, ...]
) -> pd.DataFrame:
    pixels = 800
    pattern = rng.normal(size=pixels)
    pattern = (pattern - pattern.mean()) / pattern.std(ddof=1)
    parts = []
    for n in frames:
        sigma = world.temporal_mm(n)
        freedom = max(world.repeats - 1, 1)
        parts.append(
            pd.DataFrame(
                {
                    "variant": variant,
                    "frames": n,
                    "pixel": np.arange(pixels),
                    "mean_error_mm": world.offset_mm
                    + world.pattern_mm(n) * pattern
                    + rng.normal(0, sigma / np.sqrt(world.repeats), pixels),
                    "temporal_std_mm": (np.nan if world.repeats < 2 else sigma)
                    * np.sqrt(rng.chisquare(freedom, pixels) / freedom),
                    "displacement_std_mm": 0.25 / np.sqrt(n),
                    "repeats": world.repeats,
                }
            )
        )
    return pd.concat(parts, ignore_index=True)
