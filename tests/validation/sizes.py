"""Sizes of known damage, a table: some 15 minutes on one core.

Run ``python tests/validation/sizes.py [--cache FOLDER] [--widths 14 25 30 50]``. Each board has
eight damages of one shape, in four widths and two depths, and stands before a camera straight ahead
or turned by 45 degrees. Two detectors search the average of 17 frames, and `measure_detection`
states sizes with the blur that the frames' noise shows, as for a recording. Printed are, by shape,
tilt and camera, the medians of stated over true diameter and depth, and how often the truth lies
within two standard errors. Depths are normal to the board."""

from __future__ import annotations

import argparse
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from detectors import load_detector
from detectors.averages.average import AverageConfig, average
from detectors.pixels.noise import REACH_FRAMES, with_noise
from harness import api
from harness.vocabulary.geometry import MM, Cloud, transform_points
from scenes.target.custom import TargetConfig

DISTANCES_M = {
    "azure_kinect_nfov": 0.7,
    "kinect_v2": 0.8,
    "realsense_l515": 0.6,
    "lucid_helios2plus_1250": 0.7,
}
SHAPES = ("flat", "cap", "bowl")
TILTS_DEG = (0.0, 45.0)
DEPTHS_MM = (4.0, 10.0)
DETECTORS = ("local", "matched")
FRAMES = 17
THRESHOLD = 8.0
NEAR_MM = 5.0
"""A finding whose centre lies this close to half of the damage's width beside its centre is it."""


def damage(
    shape: str,
    number: int,
    diameter_mm: float,
    depth_mm: float,
    centre_mm: tuple[float, float],
) -> tuple[str, dict[str, Any]]:
    """Return the list of a declaration that holds a damage, and the damage."""
    item: dict[str, Any] = {
        "id": number,
        "centre_mm": list(centre_mm),
        "diameter_mm": diameter_mm,
        "depth_mm": depth_mm,
    }
    if shape == "flat":
        return "holes", {**item, "kind": "blind"}
    if shape == "cap":
        # a ball leaves at most a hemisphere
        return "dents", {**item, "depth_mm": min(depth_mm, diameter_mm / 2 - 0.5)}
    return "flaws", {**item, "kind": "pressed_dent"}


def declaration(
    shape: str,
    tilt_deg: float,
    distance_m: float,
    widths_mm: list[float],
) -> dict[str, Any]:
    """Return a board with damage of one shape."""
    rng = np.random.default_rng([SHAPES.index(shape), int(tilt_deg)])
    lists: dict[str, list[dict[str, Any]]] = {"holes": [], "dents": [], "flaws": []}
    for row, depth_mm in enumerate(DEPTHS_MM):
        for column, width_mm in enumerate(widths_mm):
            x_mm = -165.0 + 110.0 * column + rng.uniform(-6.0, 6.0)
            y_mm = -55.0 + 110.0 * row + rng.uniform(-6.0, 6.0)
            number = 1 + row * len(widths_mm) + column
            name, item = damage(shape, number, width_mm, depth_mm, (x_mm, y_mm))
            lists[name].append(item)
    return {
        "name": "custom",
        "board": {"width_mm": 460.0, "height_mm": 240.0, "thickness_mm": 30.0},
        "pose": {"distance_m": distance_m, "tilt_x_deg": tilt_deg},
        **lists,
    }


def cloud_of(spec: dict[str, Any], camera: str, cache: Path) -> Cloud:
    """Return the average of a board's frames, with the blur that their noise shows."""
    unit = api.render(api.target(spec), camera, bounces=2, cache=cache)
    frames = api.frames(unit, FRAMES)
    first = list(islice(frames.frames(), REACH_FRAMES))
    return with_noise(average(frames, AverageConfig()), first, frames.z_step_m)


def rows_of(cloud: Cloud, spec: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return a row for each damage of a board: what one detector states of it."""
    detector = load_detector(name, {"crop": {"kind": "auto", "inset_px": 4}})
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, THRESHOLD)
    centres_m = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
    T_camera_board = TargetConfig.from_data(spec).pose.T_camera_board
    rows: list[dict[str, Any]] = []
    for item in [*spec["holes"], *spec["dents"], *spec["flaws"]]:
        on_board_m = np.array([*item["centre_mm"], 0.0]) * MM
        place_m = transform_points(T_camera_board, on_board_m)
        apart_mm = np.linalg.norm(centres_m - place_m, axis=1) / MM
        if not len(apart_mm) or apart_mm.min() > NEAR_MM + item["diameter_mm"] / 2:
            rows.append({"found": False})
            continue
        measured = detector.measure(cloud, evidence, detections[int(apart_mm.argmin())])
        diameter_mm = measured.model_diameter_m / MM
        depth_mm = measured.normal_depth_m / MM
        diameter_off_mm = abs(diameter_mm - item["diameter_mm"])
        depth_off_mm = abs(depth_mm - item["depth_mm"])
        rows.append(
            {
                "found": True,
                "diameter": diameter_mm / item["diameter_mm"],
                "depth": depth_mm / item["depth_mm"],
                "diameter_covered": diameter_off_mm <= 2 * measured.model_diameter_se_m / MM,
                "depth_covered": depth_off_mm <= 2 * measured.normal_depth_se_m / MM,
            }
        )
    return rows


def summary(rows: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Return medians and coverages by keys."""
    found_rows = rows[rows["found"]]
    groups = found_rows.groupby(keys)
    return pd.DataFrame(
        {
            "damages": rows.groupby(keys).size(),
            "found": groups.size(),
            "diameter": groups["diameter"].median(),
            "depth": groups["depth"].median(),
            "diameter_covered": groups["diameter_covered"].agg(lambda covered: covered.mean()),
            "depth_covered": groups["depth_covered"].agg(lambda covered: covered.mean()),
        }
    ).round(2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cache", type=Path, default=Path("results/.cache/renders"))
    parser.add_argument("--widths", type=float, nargs=4, default=[14.0, 25.0, 30.0, 50.0])
    options = parser.parse_args()
    rows = []
    for camera, shape, tilt_deg in product(DISTANCES_M, SHAPES, TILTS_DEG):
        spec = declaration(shape, tilt_deg, DISTANCES_M[camera], options.widths)
        cloud = cloud_of(spec, camera, options.cache)
        for name in DETECTORS:
            for row in rows_of(cloud, spec, name):
                rows.append({"shape": shape, "tilt": tilt_deg, "camera": camera, **row})
    table = pd.DataFrame(rows)
    print(summary(table, ["shape", "tilt"]).to_string())
    print(summary(table, ["shape", "tilt", "camera"]).to_string())


if __name__ == "__main__":
    main()
