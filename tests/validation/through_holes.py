"""Sizes of through-holes with one frame and with 50, a table: half a minute on one free core for a
camera.

Run ``python tests/validation/through_holes.py CAMERA --cache FOLDER [--seed 1] [--boards 6]``.
Boards 13 mm thick, with eight holes each of sizes spread over a range, stand at random before a
unit each of a camera, in front of a backing. Two detectors search the averages, and
`measure_detection` states sizes with the facts of the camera's filter. Printed are, by detector,
frames and size: how many holes were found, the median of stated over true diameter and over the
depth that is seen, along the optical axis; the medians of their standard errors as shares of the
sizes; how often the truth lies within two of them; how many depths are lower bounds, and how often
the depth that is seen is no less than two standard errors below these, or within two of the others.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from detectors import load_detector
from detectors.averages.average import AverageConfig
from detectors.interface import Detection, Measurement
from harness.trials.averages import Averaging, averages_of
from harness.trials.board import Board, LabelledCloud
from harness.vocabulary.geometry import MM
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.truth import Damage, truth_of

FILTERS: dict[str, dict[str, Any]] = {
    "azure_kinect_nfov": {"blur_px": 5, "lens_px": 0.45},
    "kinect_v2": {
        "blur_px": 3,
        "lens_px": 0.5,
        "by_light": True,
        "emitter_mm": [-80.0, 0.0, 0.0],
    },
}
"""What `HoleModelConfig` has to know of a camera, from its file in `scenes/cameras`."""
THRESHOLDS = {"matched": 5.5, "thesis": 3.0}
FRAMES = (1, 50)
RENDER = RenderConfig(hole_noise_mm=0.3, face_samples=2048)
NEAR_MM = 5.0
"""A finding whose centre lies this close to half of the hole's width beside its centre is it."""
SIZES_MM = (0.0, 7.0, 12.0, 100.0)


def board_of(options: argparse.Namespace, number: int) -> Board:
    """Return a damaged board before a unit of its own."""
    family = DrawnTargetConfig.model_validate(
        {
            "seed": options.seed,
            "damage": {"kind": "through", "per_board": 8, "diameter_mm": options.sizes},
            "board": {"width_mm": 220.0, "height_mm": 150.0, "thickness_mm": 12.7},
            "apart_mm": 40.0,
            "edge_mm": 20.0,
            "distance_m": 0.7,
            "distance_jitter_mm": 10.0,
            "offset_mm": 20.0,
            "tilt_deg": 8.0,
            "roll_deg": 2.0,
            "material": {"albedo_850": 0.6},
            "backing": {"distance_mm": options.backing},
        }
    )
    camera = camera_of(CameraConfig(name=options.camera))
    target = family.drawn("damaged", number).at_wavelength(camera.optics.wavelength_nm)
    view, _ = cached_view(target, camera.optics, RENDER, options.cache)
    unit = SimulatedUnit(camera, CameraConfig(name=options.camera, unit_seed=1 + number), view)
    T_camera_board = target.pose.T_camera_board
    return Board(
        unit=unit,
        damaged=True,
        truth=truth_of(target, T_camera_board),
        target=target,
        T_camera_board=T_camera_board,
    )


def finding_at(
    labelled: LabelledCloud,
    detections: tuple[Detection, ...],
    damage: Damage,
) -> Detection | None:
    """Return the finding that is the hole, if there is one."""
    centres_m = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
    away_m = labelled.on_board(centres_m) - damage.centre_board_m[:2]
    apart_mm = np.linalg.norm(away_m, axis=1) / MM
    if not len(apart_mm) or apart_mm.min() > NEAR_MM + damage.diameter_m / MM / 2:
        return None
    return detections[int(apart_mm.argmin())]


def row_of(measured: Measurement, diameter_m: float, seen_m: float) -> dict[str, Any]:
    """Return what is stated of a hole over what is true, and whether it is covered."""
    least_m = seen_m >= measured.model_depth_m - 2 * measured.model_depth_se_m
    depth_off_m = abs(measured.model_depth_m - seen_m)
    is_within = depth_off_m <= 2 * measured.model_depth_se_m
    diameter_off_m = abs(measured.model_diameter_m - diameter_m)
    return {
        "found": True,
        "diameter": measured.model_diameter_m / diameter_m,
        "diameter_se": measured.model_diameter_se_m / diameter_m,
        "diameter_covered": diameter_off_m <= 2 * measured.model_diameter_se_m,
        "depth": measured.model_depth_m / seen_m,
        "depth_se": measured.model_depth_se_m / seen_m,
        "depth_covered": is_within,
        "is_least": measured.depth_is_least,
        "depth_right": least_m if measured.depth_is_least else is_within,
    }


def rows_of(options: argparse.Namespace, number: int) -> list[dict[str, Any]]:
    """Return a row for each hole of a board, detector and number of frames."""
    board = board_of(options, number)
    capture = board.unit.capture(max(FRAMES), 7, "damaged", number)
    rows = []
    for frames, cloud in averages_of(capture, FRAMES, Averaging(AverageConfig())).items():
        labelled = board.labelled(cloud)
        for name, threshold in THRESHOLDS.items():
            settings = {
                "crop": {"kind": "auto", "inset_px": 4},
                "hole_model": FILTERS[options.camera],
            }
            detector = load_detector(name, settings)
            evidence = detector.analyse(cloud)
            detections = detector.find(cloud, evidence, threshold)
            for damage in board.truth:
                width_mm = damage.diameter_m / MM
                row = {"detector": name, "frames": frames, "width_mm": width_mm, "found": False}
                finding = finding_at(labelled, detections, damage)
                if finding is not None:
                    measured = detector.measure(cloud, evidence, finding)
                    seen_m = labelled.seen_depth_m[damage.id]
                    row.update(row_of(measured, damage.diameter_m, seen_m))
                rows.append(row)
    return rows


def summary(rows: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Return counts, medians and coverages by keys."""
    groups = rows[rows["found"]].groupby(keys, observed=True)
    table = {
        "holes": rows.groupby(keys, observed=True).size(),
        "found": groups.size(),
        "is_least": groups["is_least"].sum(),
    }
    for name in ("diameter", "diameter_se", "depth", "depth_se"):
        table[name] = groups[name].median()
    for name in ("diameter_covered", "depth_covered", "depth_right"):
        table[name] = groups[name].agg(lambda covered: covered.mean())
    return pd.DataFrame(table).astype(float).round(2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("camera", choices=FILTERS)
    parser.add_argument("--cache", type=Path, default=Path("results/.cache/renders"))
    parser.add_argument("--seed", type=int, default=1, help="of the boards")
    parser.add_argument("--boards", type=int, default=6)
    parser.add_argument("--sizes", type=float, nargs=2, default=[4.0, 20.0], metavar="MM")
    parser.add_argument(
        "--backing", type=float, default=20.0, metavar="MM", help="behind the board"
    )
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for number in range(options.boards):
        rows += rows_of(options, number)
    table = pd.DataFrame(rows)
    table["size"] = pd.cut(table["width_mm"], list(SIZES_MM))
    print(summary(table, ["detector", "frames"]).to_string())
    print(summary(table, ["detector", "frames", "size"]).to_string())


if __name__ == "__main__":
    main()
