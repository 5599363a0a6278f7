"""A package with a detector and a camera is built, installed into an environment of its own,
listed and swept with."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pandas as pd
import pytest

from detectors import BUILT_IN
from tests.support.third_party import write_package

ROOT = Path(__file__).resolve().parents[3]

SWEEP = """\
name: third_party
seed: 5
source:
  kind: simulated
  target:
    name: custom
    board: {width_mm: 160, height_mm: 100, thickness_mm: 20}
    holes:
      - {id: 1, diameter_mm: 1, centre_mm: [-30, 0], kind: blind, depth_mm: 6}
      - {id: 2, diameter_mm: 20, centre_mm: [30, 0], kind: blind, depth_mm: 12}
  camera: {name: acme_tof}
  render: {bounces: 1, face_samples: 16, hole_samples: 16, rest_samples: 8}
capture: {frames: 2}
detector:
  name: acme_median
  settings:
    window_px: 61
    crop: {kind: box, x_mm: [-74, 74], y_mm: [-44, 44], z_mm: [0, 1100], range_max_m: null, inset_px: 3}
threshold: {k: 8.0}
repeats: 1
"""


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of a new environment that sees this one's packages and has the third-party
    one installed."""
    home = tmp_path_factory.mktemp("third_party")
    subprocess.run(
        [sys.executable, "-m", "venv", "--without-pip", str(home / "venv")], check=True, timeout=900
    )
    interpreter = home / "venv" / "bin" / "python"
    paths = subprocess.run(
        [interpreter, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    (Path(paths.stdout.strip()) / "of_the_tests.pth").write_text(
        sysconfig.get_path("purelib") + "\n"
    )
    source = write_package(home / "acme")
    command = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(interpreter),
        "install",
        "--quiet",
        "--no-deps",
    ]
    command += ["--no-index", "--no-build-isolation", "--disable-pip-version-check", str(source)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    return interpreter


def program(python: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [python, "-m", *arguments],
        cwd=python.parent,
        env=environment,
        capture_output=True,
        text=True,
        timeout=1800,
    )


def test_it_is_listed_with_its_package_and_what_is_broken_is_said_to_be(python: Path) -> None:
    done = program(python, "harness.programs.keeping.ls", "--json")
    assert done.returncode == 0, done.stderr
    listed = json.loads(done.stdout)
    detectors = {row["name"]: row for row in listed["detectors"]}
    assert set(detectors) == {"acme_broken", "acme_median", *BUILT_IN}
    assert detectors["acme_median"] == {
        "name": "acme_median",
        "package": "acme-inspection",
        "package_version": "2.5",
        "version": 4,
        "about": "What departs from the mean of its surroundings, in robust standard deviations.",
    }
    assert "of the package acme-inspection 2.5" in detectors["acme_broken"]["broken"]
    assert "NoSuchDetector" in detectors["acme_broken"]["broken"]
    cameras = {row["name"]: row for row in listed["cameras"]}
    assert (
        cameras["acme_tof"]["title"] == "Acme ToF 1"
        and cameras["acme_tof"]["package"] == "acme-inspection"
    )


@pytest.mark.slow  # a sweep in a process of its own; the listing shows that both are found
def test_an_experiment_sweeps_with_its_detector_and_its_camera(
    python: Path, tmp_path: Path
) -> None:
    (tmp_path / "x.yaml").write_text(SWEEP)
    done = program(
        python,
        "harness.sweep",
        str(tmp_path / "x.yaml"),
        "--out",
        str(tmp_path / "out"),
        "--jobs",
        "1",
    )
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "out" / "third_party").glob("[0-9a-f]*")
    trials = pd.read_parquet(folder / "trials.parquet")
    # a hole of 14 pixels stands out from any mean of its surroundings, one of less than a pixel
    # from none
    assert dict(zip(trials.hole, trials.detected, strict=True)) == {"1": False, "2": True}


def test_a_wrong_setting_of_its_is_told_with_its_place(python: Path, tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text(SWEEP.replace("window_px: 61", "window_pxs: 61"))
    done = program(python, "harness.sweep", str(tmp_path / "x.yaml"), "--dry-run")
    assert done.returncode == 2
    assert "x.yaml:17:5" in done.stderr and "did you mean: window_px" in done.stderr
