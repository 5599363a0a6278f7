"""Sweeps of seconds, run as a user runs them, and their results as text that can be compared byte
by byte."""

from __future__ import annotations

import io
import json
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from harness.sweep import main

ROOT = Path(__file__).resolve().parents[2]
TINY = """\
name: tiny
seed: 3
source:
  kind: simulated
  target: {name: thesis}
  camera: {name: azure_kinect_nfov}
  render: {bounces: 1, face_samples: 64, hole_samples: 16, rest_samples: 8}
capture: {frames: 3}
detector:
  name: thesis
  settings:
    crop: {kind: box, x_mm: [-294, 294], y_mm: [-51, 51], z_mm: [0, 1100], range_max_m: null, inset_px: 3}
threshold: {calibrate: {repeats: 2}}
repeats: 2
sweep:
  capture.frames: [1, 3]
"""


STUDY = """\
name: tiny
seed: 3
source:
  kind: simulated
  target: {name: drawn, damage: {kind: through, per_board: 5, diameter_mm: [2.0, 12.0]}}
  camera: {name: azure_kinect_nfov}
  render: {bounces: 0}
capture: {frames: 2}
detector: {name: thesis, settings: {crop: {kind: auto, inset_px: 4}}}
threshold: {calibrate: {boards: 5, false_calls_per_m2: 4.0}}
study: {boards: 4, hole_free_boards: 3}
sweep:
  capture.frames: [1, 2]
"""


def sweep_command(yaml: Path, out: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "harness.sweep", str(yaml), "--out", str(out), *arguments]


@dataclass
class Done:
    """How a program ended."""

    returncode: int
    stdout: str
    stderr: str


def sweep(yaml: Path, out: Path, *arguments: str) -> Done:
    """Run the program to its end in this process, its workers in processes of their own."""
    string_io = io.StringIO()
    warned = io.StringIO()
    with redirect_stdout(string_io), redirect_stderr(warned):
        code = main([str(yaml), "--out", str(out), *arguments])
    return Done(code, string_io.getvalue(), warned.getvalue())


def finished(home: Path, text: str, *arguments: str) -> Path:
    """Run an experiment as ``home/tiny.yaml``; returns the folder of results, ``home/out``."""
    (home / "tiny.yaml").write_text(text)
    done = sweep(home / "tiny.yaml", home / "out", *arguments)
    assert done.returncode == 0, done.stderr
    (home / "told.txt").write_text(done.stdout)
    return home / "out"


def results(out: Path) -> Path:
    """The one folder of results."""
    (result,) = (out / "tiny").glob("[0-9a-f]*")
    return result


def content(folder: Path) -> dict[str, str]:
    """Every table and record of a folder of results as text, every digit of every number in it;
    timings left out, and of a study's record what names the run."""
    result = {}
    for path in sorted(folder.glob("*.parquet")):
        table = pd.read_parquet(path)
        numbers = table.drop(
            columns=[column for column in table if str(column).startswith("seconds")]
        )
        result[path.name] = numbers.to_csv(index=False, float_format="%.17g")
    if (folder / "summary.csv").exists():
        result["summary.csv"] = (folder / "summary.csv").read_text()
    if (folder / "study.json").exists():
        record = json.loads((folder / "study.json").read_text())
        del record["provenance"]
        result["study.json"] = json.dumps(record)
    assert "trials.parquet" in result
    return result
