"""A sweep of seconds, run as a user runs it, and its results as text that can be compared byte by byte."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
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


def sweep_command(yaml: Path, out: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "harness.sweep", str(yaml), "--out", str(out), *arguments]


def sweep(yaml: Path, out: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run it to its end."""
    command = sweep_command(yaml, out, *arguments)
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800, env=os.environ | environment)


def results(out: Path) -> Path:
    """The one folder of results."""
    (found,) = (out / "tiny").glob("[0-9a-f]*")
    return found


def content(folder: Path) -> dict[str, str]:
    """Every table and record of a folder of results as text, every digit of every number in it; timings left out, and
    of a study's record what names the run."""
    found = {}
    for path in sorted(folder.glob("*.parquet")):
        table = pd.read_parquet(path)
        numbers = table.drop(columns=[column for column in table if str(column).startswith("seconds")])
        found[path.name] = numbers.to_csv(index=False, float_format="%.17g")
    if (folder / "summary.csv").exists():
        found["summary.csv"] = (folder / "summary.csv").read_text()
    if (folder / "study.json").exists():
        record = json.loads((folder / "study.json").read_text())
        del record["provenance"]
        found["study.json"] = json.dumps(record)
    assert "trials.parquet" in found
    return found
