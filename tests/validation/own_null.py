"""False calls counted against those expected by a capture's own null, a table: some 20 minutes on
two free cores.

Run ``python tests/validation/own_null.py --cache FOLDER [--boards 50]``. Boards are drawn at
random before three cameras, each before a unit of its own: hole-free, the same with flat objects
lying on them, and drilled. On each, with 1 and with 50 frames,
`detectors.findings.null.own_threshold` sets the threshold at which 1 and 3 false calls are
expected. Counted are the findings that are neither a hole (centres within 15 mm, as in the
studies) nor an object or its edge. Expected is the number asked for, in the share of the judged
area where a finding would be counted. ``asked``: over the boards whose own null was trusted; the
rest is told as ``refused``.

Objects are put into the averaged cloud, with edges blurred over 1 pixel: their light is not
rendered.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from detectors import load_detector
from detectors.averages.average import AverageConfig
from detectors.findings.null import own_threshold
from detectors.interface import Detector
from harness.trials.averages import Averaging, averages_of
from harness.vocabulary.geometry import MM, Cloud, transform_points
from harness.vocabulary.seeds import random_stream
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig, Purpose
from scenes.target.truth import truth_of

CAMERAS = ("azure_kinect_nfov", "kinect_v2", "realsense_l515")
KINDS = ("hole-free", "objects", "drilled")
FRAMES = (1, 50)
ASKED = (1.0, 3.0)
DISTANCES_M = (0.55, 0.7, 0.9)
HIT_M = 15 * MM
FIRST_UNIT = 1000
"""Units and noise of their own: the settings of `detectors.findings.null` were chosen on these
boards before other units."""
RENDER = RenderConfig(hole_noise_mm=0.3)


@dataclass(frozen=True)
class Board:
    """An averaged view. ``excused`` (h, w) bool: where a finding is right, or near enough to be
    counted as such."""

    cloud: Cloud
    excused: np.ndarray


def family(number: int) -> DrawnTargetConfig:
    """Boards as in experiments/detection_limit.yaml, but at three distances and tilted further."""
    return DrawnTargetConfig.model_validate(
        {
            "seed": 5,
            "damage": {
                "kind": "through",
                "per_board": 8,
                "diameter_mm": [2.0, 8.0],
                "sizes": "uniform",
            },
            "distance_m": DISTANCES_M[number % len(DISTANCES_M)],
            "distance_jitter_mm": 50.0,
            "tilt_deg": 12.0,
        }
    )


def boards(camera_name: str, kind: str, number: int, cache: Path) -> dict[int, Board]:
    """One board by the number of frames."""
    camera = camera_of(CameraConfig(name=camera_name))
    role: Purpose = "damaged" if kind == "drilled" else "hole_free"
    target = family(number).drawn(role, number).at_wavelength(camera.optics.wavelength_nm)
    view, _ = cached_view(
        target if kind == "drilled" else target.hole_free(), camera.optics, RENDER, cache
    )
    unit = SimulatedUnit(
        camera, CameraConfig(name=camera_name, unit_seed=FIRST_UNIT + number), view
    )
    capture = unit.capture(max(FRAMES), 7, role, number)
    clouds = averages_of(capture, FRAMES, Averaging(AverageConfig()))
    if kind == "objects":
        return {n: with_objects(cloud, target, number) for n, cloud in clouds.items()}
    holes = holes_near(target, next(iter(clouds.values()))) if kind == "drilled" else None
    return {
        n: Board(c, np.zeros(c.valid.shape, bool) if holes is None else holes)
        for n, c in clouds.items()
    }


def holes_near(target: TargetConfig, cloud: Cloud) -> np.ndarray:
    """(h, w) bool: within `HIT_M` of a hole's centre, across the line of sight."""
    nearby = np.zeros(cloud.valid.shape, bool)
    for damage in truth_of(target, target.pose.T_camera_board):
        centre = transform_points(target.pose.T_camera_board, damage.centre_board_m)
        slopes = cloud.points_m[..., :2] / cloud.points_m[..., 2:]
        with np.errstate(invalid="ignore"):
            nearby |= np.hypot(*np.moveaxis(slopes * centre[2] - centre[:2], -1, 0)) < HIT_M
    return nearby


def with_objects(cloud: Cloud, target: TargetConfig, number: int) -> Board:
    """One to three rectangles of 12 to 40 mm, 4 to 30 mm thick, flat or tilted, on the target's
    face."""
    random = random_stream(11, "objects", number)
    pixel_m = target.pose.distance_m / (cloud.lens.fx if cloud.lens else 500.0)
    height, width = cloud.valid.shape
    rise_m = np.zeros((height, width))
    covered = np.zeros((height, width), bool)
    v, u = np.mgrid[:height, :width] * pixel_m
    for _ in range(int(random.integers(1, 4))):
        position = random.uniform(0.25, 0.75, 2) * (height * pixel_m, width * pixel_m)
        half = random.uniform(6 * MM, 20 * MM, 2)
        turn = random.uniform(0, np.pi)
        along = (v - position[0]) * np.cos(turn) + (u - position[1]) * np.sin(turn)
        across = (u - position[1]) * np.cos(turn) - (v - position[0]) * np.sin(turn)
        inside = (np.abs(along) < half[0]) & (np.abs(across) < half[1])
        thick_m = random.uniform(4 * MM, 30 * MM) * (
            1.0 + random.uniform(-0.4, 0.4) * along / half[0]
        )
        rise_m = np.where(inside, thick_m, rise_m)
        covered |= inside
    points = (
        cloud.points_m
        * (1.0 - ndimage.gaussian_filter(rise_m, 1.0) / cloud.points_m[..., 2])[..., None]
    )
    margin = round(HIT_M / 2 / pixel_m)
    return Board(
        replace(cloud, points_m=points), ndimage.binary_dilation(covered, iterations=margin)
    )


def counts(board: Board, detector: Detector) -> Iterator[tuple[float, int] | None]:
    """For each of `ASKED` what is expected and what is counted; None where the own null is not
    trusted."""
    evidence = detector.analyse(board.cloud)
    for asked in ASKED:
        null = own_threshold(detector, board.cloud, evidence, asked)
        if null.doubts:
            yield None
            continue
        judged = np.isfinite(null.evidence.score)
        share = float((judged & ~board.excused).sum() / judged.sum())
        result = detector.find(board.cloud, null.evidence, null.threshold)
        excused = board.excused.reshape(-1)
        yield null.expected * share, sum(not excused[finding.pixels].any() for finding in result)


def main(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python tests/validation/own_null.py", description=__doc__
    )
    parser.add_argument("--cache", type=Path, required=True, help="where renders are kept")
    parser.add_argument("--boards", type=int, default=50, help="of each camera and kind")
    parser.add_argument("--cameras", nargs="+", default=CAMERAS, choices=CAMERAS)
    parser.add_argument("--kinds", nargs="+", default=KINDS, choices=KINDS)
    parser.add_argument("--detector", default="local")
    options = parser.parse_args(arguments)
    detector = load_detector(options.detector, {"crop": {"kind": "auto"}})
    options.cache.mkdir(parents=True, exist_ok=True)
    print(
        "camera, kind, frames | asked | boards | refused | expected | counted | ratio +- "
        "standard error"
    )
    for name in options.cameras:
        for kind in options.kinds:
            all_rows = [
                boards(name, kind, number, options.cache) for number in range(options.boards)
            ]
            for frames in FRAMES:
                message = [list(counts(board[frames], detector)) for board in all_rows]
                for number, asked in enumerate(ASKED):
                    rows = np.array(
                        [row[number] for row in message if row[number] is not None], float
                    ).reshape(-1, 2)
                    expected, counted = rows.sum(axis=0)
                    error = (
                        rows[:, 1].std(ddof=1) * np.sqrt(len(rows)) / expected
                        if len(rows) > 1
                        else np.nan
                    )
                    print(
                        f"{name}, {kind}, {frames} | {asked:g} | {len(rows)} | "
                        f"{len(message) - len(rows)} |"
                        f" {expected:.1f} | {counted:.0f} | {counted / expected:.2f} +- "
                        f"{error:.2f}",
                        flush=True,
                    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
