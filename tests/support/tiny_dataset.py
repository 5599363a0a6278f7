"""A data set of ten small boards, written in this process."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from harness.programs.dataset import dataset

BOARDS = """\
name: tiny
seed: 3
source:
  kind: simulated
  target:
    name: drawn
    damage: {kind: through, per_board: 2, diameter_mm: [8.0, 14.0]}
    board: {width_mm: 130, height_mm: 90, thickness_mm: 12.7}
    room: null
  camera: {name: azure_kinect_nfov}
  render: {bounces: 0}
capture: {frames: 20}
"""
FAMILY = f"""\
{BOARDS}threshold: {{calibrate: {{boards: 2, false_calls_per_m2: 100.0}}}}
study: {{boards: 4, hole_free_boards: 1, units: 2}}
"""


def write(home: Path, out: str, *arguments: str) -> int:
    """Run the program on the family of boards; renders are kept in ``home/results``."""
    (home / "tiny.yaml").write_text(FAMILY)
    options = [
        str(home / "tiny.yaml"),
        "--boards",
        "10",
        "--out",
        str(home / out),
        "--results",
        str(home / "results"),
    ]
    return dataset.main([*options, "--serial", *arguments])


def names_in(folder: Path) -> list[str]:
    """The names of all boards of a finished data set."""
    return list(json.loads((folder / "dataset.json").read_text())["samples"])


def truth_of(folder: Path, name: str) -> dict:
    return dict(json.loads((folder / "boards" / name / "truth.json").read_text()))


def arrays_of(folder: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(folder / "boards" / name / "cloud.npz") as stored:
        return dict(stored)
