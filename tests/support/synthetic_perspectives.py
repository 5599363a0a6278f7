"""Result tables of an experiment with maps whose answers are known, and a map to look at."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from harness.evaluation.maps import MERGE, REGISTRATION, VIEWS
from harness.records.examples import Circle3d, MappedExample, Scene3d
from tests.support.synthetic_tables import DIAMETERS_MM, OFFSETS_MM, Tables, World, joined, tables

MAP_AXES = pd.DataFrame(
    [
        {"path": VIEWS, "name": "views", "unit": ""},
        {"path": REGISTRATION, "name": "method", "unit": ""},
        {"path": MERGE, "name": "kind", "unit": ""},
    ]
)
COUNTS = (1, 2, 3, 5, 9)
METHODS = ("nominal", "icp", "cpd", "marks", "joint")
MERGES = ("grid", "fusion", "volume")


@dataclass(frozen=True)
class MapWorld:
    """The answers. ``first(views, method, merge, frames)``: the smallest hole found, with all
    larger ones, in every repeat. ``size_bias_mm(diameter, views, method, merge)`` and
    ``size_std_mm``: of the thesis' measure. ``surface_mm(views, method, merge, frames)``: noise of
    the fitted surface. ``tre_mm``: of each method the median error in the plane and across it;
    ``spread``: standard deviation of its logarithm. ``failing``: share of failures.
    """

    first: Callable[[int, str, str, int], int] = lambda views, method, merge, frames: (
        4 + (frames == 1)
    )
    size_bias_mm: Callable[[float, int, str, str], float] = lambda diameter, views, method, merge: (
        2.0 / diameter
    )
    size_std_mm: float = 0.2
    surface_mm: Callable[[int, str, str, int], float] = lambda views, method, merge, frames: (
        0.9 / np.sqrt(frames)
    )
    threshold: Callable[[int, str], float] = lambda views, merge: 5.0
    place_std_mm: float = 0.5
    temporal_mm: Callable[[int, str, int], float] = lambda views, merge, frames: (
        0.9 / np.sqrt(frames * views)
    )
    tre_mm: Mapping[str, tuple[float, float]] = field(
        default_factory=lambda: {
            "nominal": (9.0, 6.0),
            "icp": (1.5, 0.1),
            "cpd": (0.4, 0.1),
            "marks": (0.2, 0.15),
            "joint": (0.2, 0.05),
            "odometry": (3.0, 2.0),
        }
    )
    spread: float = 0.2
    failing: Mapping[str, float] = field(default_factory=dict)
    repeats: int = 12


def name_of(views: int, method: str, merge: str) -> str:
    return f"views={views}, method={method}, kind={merge}"


def perspectives(
    world: MapWorld | None = None,
    frames: tuple[int, ...] = (1, 50),
    counts: Sequence[int] = COUNTS,
    methods: Sequence[str] = METHODS,
    merges: Sequence[str] = MERGES,
) -> Tables:
    """All set-ups of an experiment over views, registration and merging."""
    world = world or MapWorld()
    complete = joined(
        *(
            placed(mapped(world, views, method, merge, frames), views, method, merge)
            for views in counts
            for method in methods
            for merge in merges
        )
    )
    rows = [registrations(world, counts, method, frames, merges[0]) for method in methods]
    return replace(
        complete,
        axes=MAP_AXES,
        noise=pd.DataFrame(),
        registrations=pd.concat(rows, ignore_index=True),
    )


def with_variation(
    found: Tables,
    world: MapWorld,
    label: str,
    place: tuple[int, str, str],
    frames: tuple[int, ...],
    of: str = "",
) -> Tables:
    """The same tables with one more variation."""
    views, method, merge = place
    variation = placed(
        mapped(world, views, method, merge, frames, label),
        views,
        method,
        merge,
        of=of,
        is_variation=True,
    )
    new_registrations = (
        registrations(world, (views,), method, frames, merge, label)
        if views > 1
        else pd.DataFrame()
    )
    return replace(
        joined(replace(found, noise=variation.noise), variation),
        axes=MAP_AXES,
        noise=pd.DataFrame(),
        registrations=pd.concat([found.registrations, new_registrations], ignore_index=True),
    )


def mapped(
    world: MapWorld, views: int, method: str, merge: str, frames: tuple[int, ...], label: str = ""
) -> Tables:
    """One set-up's tables, without its axes."""
    name = label or name_of(views, method, merge)
    plain = World(
        rate=lambda hole, n: float(hole >= world.first(views, method, merge, n)),
        size_bias_mm=lambda diameter: world.size_bias_mm(diameter, views, method, merge),
        size_std_mm=world.size_std_mm,
        place_std_mm=world.place_std_mm,
        temporal_mm=lambda n: world.temporal_mm(views, merge, n),
        repeats=world.repeats,
        seed=1 + sum(name.encode()),
    )
    part = tables(plain, frames, name)
    rng = np.random.default_rng(plain.seed)
    surface = np.array(
        [world.surface_mm(views, method, merge, int(n)) for n in part.runs["frames"]]
    )
    runs = part.runs.assign(
        surface_noise_mm=surface * np.exp(rng.normal(0, 0.02, len(part.runs))),
        scale_mm=surface,
        threshold=np.where(part.runs["role"] == "damaged", world.threshold(views, merge), np.nan),
        views_used=views,
        views_left_out=0,
        seconds_map=0.05 * views,
    )
    return replace(part, runs=runs)


def placed(
    part: Tables, views: int, method: str, merge: str, of: str = "", is_variation: bool = False
) -> Tables:
    position = {VIEWS: float(views), REGISTRATION: method, MERGE: merge}
    by_name = part.variants.assign(
        is_variation=is_variation, reference=of or part.variants["variant"]
    )
    part = replace(part, axes=MAP_AXES, variants=by_name)
    return replace(
        part,
        **{t: getattr(part, t).assign(**position) for t in ("holes", "runs", "probes", "variants")},
    )


def registrations(
    world: MapWorld,
    counts: Sequence[int],
    method: str,
    frames: tuple[int, ...],
    merge: str,
    label: str = "",
) -> pd.DataFrame:
    """Each view registered once, under the first set-up that has it."""
    rng = np.random.default_rng(3 + sum(method.encode()))
    plane, across = world.tre_mm[method]
    rows = []
    reference = 1
    for views in sorted(counts):
        for view in range(reference, views):
            for n in frames:
                for role in ("damaged", "hole_free"):
                    for repeat in range(world.repeats):
                        fails = repeat < round(world.failing.get(method, 0.0) * world.repeats)
                        noise = np.exp(rng.normal(0, world.spread, 2)) * (2.0 if n == 1 else 1.0)
                        rows.append(
                            {
                                "variant": label or name_of(views, method, merge),
                                "frames": n,
                                "repeat": repeat,
                                "role": role,
                                "view": view,
                                "method": method,
                                "tre_in_plane_mm": plane * noise[0],
                                "tre_across_mm": across * noise[1],
                                "tre_mm": float(np.hypot(plane * noise[0], across * noise[1])),
                                "predicted_in_plane_mm": plane
                                if method in ("marks", "joint")
                                else np.nan,
                                "predicted_across_mm": across
                                if method in ("marks", "joint")
                                else np.nan,
                                "guess_tre_mm": 11.0,
                                "residual_mm": 0.5,
                                "overlap": 0.95,
                                "pairs": 4,
                                "marks": 4,
                                "iterations": 12,
                                "converged": True,
                                "seconds": 0.01,
                                "failure": "the residual is too large" if fails else "",
                                VIEWS: float(views),
                                REGISTRATION: method,
                                MERGE: merge,
                            }
                        )
        reference = max(reference, views)
    return pd.DataFrame(rows)


def circle(x_mm: float, y_mm: float, diameter_mm: float, label: str, kind) -> Circle3d:
    return Circle3d(
        np.array([x_mm, y_mm, 0.0]), np.array([0.0, 0.0, 1.0]), diameter_mm, label, kind
    )


def map_example(
    views: int = 2, merge: str = "grid", points: int = 6000, registration: str = "cpd"
) -> MappedExample:
    """A board with four marks as each view places it."""
    rng = np.random.default_rng(views)
    x = rng.uniform(-300, 300, points)
    y = rng.uniform(-55, 55, points)
    holes = [
        circle(254.0 - offset, 0.0, diameter, str(number), "found" if number >= 4 else "missed")
        for number, (diameter, offset) in enumerate(
            zip(DIAMETERS_MM, OFFSETS_MM, strict=True), start=1
        )
    ]
    z = rng.normal(0, 0.3, points)
    detected = np.zeros(points, bool)
    for hole in holes:
        inside = np.hypot(x - hole.centre_mm[0], y - hole.centre_mm[1]) < hole.diameter_mm / 2
        z[inside] -= 10
        detected |= inside & (hole.kind == "found")
    rgb = np.where((np.abs(np.abs(x) - 200) < 20)[:, None], [200, 40, 30], [205, 170, 120]).astype(
        np.uint8
    )
    findings = [
        circle(
            h.centre_mm[0] + 0.4, 0.3, h.diameter_mm + 0.5, f"{h.diameter_mm + 0.5:.1f}", "finding"
        )
        for h in holes
        if h.kind == "found"
    ]
    findings.append(circle(100.0, 40.0, 4.0, "4.0", "false call"))
    scene = Scene3d(
        frame="board",
        points_mm=np.column_stack([x, y, z]),
        rgb=rgb,
        residual_mm=-z,
        detected=detected,
        view_of=rng.integers(0, views, points) if merge == "grid" else np.full(points, -1),
        circles=(*holes, *findings),
        view_names=tuple(f"view {number}" for number in range(views)),
        facts=(
            ("views", f"{views} ({registration}, {merge})"),
            ("frames a view", "50"),
            ("holes found", "8 of 11"),
        ),
    )
    return MappedExample(name_of(views, registration, merge), 50, views, registration, merge, scene)
