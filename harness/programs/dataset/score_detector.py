"""``tofpod score detector NAME --dataset DIR``: writes a detector's scores as anomaly maps.

Built-in detectors, peers and plug-ins are then judged on a data set exactly as anybody's maps are.
They see the stored clouds, which do not hold the scatter of the frames, and learn from the good
boards of ``train``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.program import Program

if TYPE_CHECKING:
    from detectors.interface import Detector
    from harness.vocabulary.geometry import Cloud

LEARNING_BOARDS = 8  # as in studies
CROP = {"kind": "auto", "inset_px": 4}
"""Outline of the board, for detectors that have a crop, as in the experiments."""
ARRAYS = ("points_m", "reason", "count", "intensity")


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("detector", metavar="NAME", help="a detector, such as thesis or one of your own package")
    add("--dataset", type=Path, required=True, metavar="DIR", help="a folder of tofpod dataset")
    add("--out", type=Path, required=True, metavar="MAPS", help="folder for the maps")


def _run(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness.programs.dataset.judged_sets import BoardSet
    from harness.vocabulary.files import atomic_path

    data = BoardSet(options.dataset)
    names = sorted(data.wanted(set()))
    for category in data.categories:
        detector = detector_of(options.detector, data.learning(category), options.dataset)
        of_category = [name for name in names if name.startswith(f"{category}/")]
        for name in of_category:
            path = options.out / f"{name}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                np.save(file, map_of(detector, cloud_of(options.dataset, name)))
    print(f"wrote {len(names)} maps to {options.out}")
    print(f"next: tofpod score {options.out} --dataset {options.dataset} --name {options.detector}")
    return 0


def detector_of(name: str, learning: Sequence[str], folder: Path) -> Detector:
    """Return a detector with the crop of the experiments and its other settings by default, which
    has learned from the first of these boards. Raises UserError."""
    from detectors import detector_type, load_detector
    from detectors.interface import Calibratable

    settings: dict[str, Any] = {}
    if "crop" in detector_type(name).settings_type.model_fields:
        settings["crop"] = CROP
    detector = load_detector(name, settings)
    if not isinstance(detector, Calibratable):
        return detector
    clouds = [cloud_of(folder, board) for board in learning[:LEARNING_BOARDS]]
    if not clouds:
        raise UserError(f"{folder}: has no good board of train that {name} could learn from")
    return detector.calibrated(detector.calibrate(clouds))


def map_of(detector: Detector, cloud: Cloud) -> np.ndarray:
    """Return a detector's scores (h, w) as an anomaly map: the lowest score where it judges
    nothing."""
    score = detector.analyse(cloud).score
    is_judged = np.isfinite(score)
    lowest = float(score[is_judged].min()) if is_judged.any() else 0.0
    return np.where(is_judged, score, lowest).astype(np.float32)


def cloud_of(folder: Path, name: str) -> Cloud:
    """Return the stored cloud of a board. Raises UserError."""
    from harness.programs.dataset.boards import read_arrays, read_truth
    from harness.vocabulary.geometry import Cloud, Region
    from scenes.sensor.camera import camera_of
    from scenes.sensor.common.config import CameraConfig

    points_m, reason, count, intensity = read_arrays(folder, name, *ARRAYS)
    facts: Mapping[str, Any] = read_truth(folder, name)
    camera = camera_of(CameraConfig(name=facts["camera"]))
    return Cloud(
        points_m=points_m.astype(float),
        reason=reason,
        count=count.astype(int),
        variance_m2=np.full(reason.shape, np.nan),
        region=Region(**facts["window_px"]),
        z_step_m=camera.z_step_m,
        n_frames=facts["frames_used"],
        lens=camera.nominal_lens,
        amplitude=intensity,
        edge_reach_px=float(camera.optics.margin_px),
    )


DETECTOR = Program(
    name="score detector",
    options=_options,
    run=_run,
    description="Write a detector's scores on the boards of a data set as anomaly maps, which "
    "tofpod score judges beside those of any other method. Detectors that learn do so on the "
    "good boards of train.",
    examples=(
        "tofpod score detector matched --dataset boards --out maps/matched",
        "tofpod score detector thesis --dataset boards --out maps/thesis",
    ),
)
