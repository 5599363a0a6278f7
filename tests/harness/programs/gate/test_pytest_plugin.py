"""The fixture ``tofpod_gate`` in a package of somebody else's, as its own CI would run it."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]
DETECTOR = """\
from dataclasses import replace

import cv2
import numpy as np

from detectors.methods.thesis import ThesisDetector

BLUR_PX = 1


class AcmeDetector(ThesisDetector):
    name = "acme"

    def analyse(self, cloud):
        evidence = super().analyse(cloud)
        blurred = cv2.blur(np.nan_to_num(evidence.score), (BLUR_PX, BLUR_PX))
        return replace(evidence, score=np.where(np.isfinite(evidence.score), blurred, np.nan))
"""
LIMIT = """\
name: acme_limit
source:
  kind: simulated
  target:
    name: drawn
    damage: {kind: through, per_board: 5, diameter_mm: [2.5, 9.0]}
    board: {width_mm: 190, height_mm: 130, thickness_mm: 12.7}
  camera: {name: azure_kinect_nfov}
  render: {bounces: 0}
capture: {frames: 1}
detector: {name: acme, settings: {crop: {kind: auto, inset_px: 4}}}
threshold: {calibrate: {boards: 13, false_calls_per_m2: 10.0}}
study: {boards: 16, hole_free_boards: 6}
"""
TEST = """\
import tofpod
def test_the_limit_is_kept(tofpod_gate):
    assert tofpod.limits(tofpod_gate("limit.yaml"))[0].a90_95.demonstrated
"""


def test_the_plug_in_is_offered_to_pytest():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {"tofpod": "harness.programs.gate.pytest_plugin"}


@pytest.mark.slow
def test_a_package_guards_its_limit(tmp_path):
    """Its CI passes with the committed baseline and fails where the detector got blunt, with the
    reason."""
    for name, text in (
        ("site/acme.py", DETECTOR),
        ("tests/limit.yaml", LIMIT),
        ("tests/test_limit.py", TEST),
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    assert len((LIMIT + TEST).splitlines()) <= 20
    info = tmp_path / "site" / "acme-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme\nVersion: 1.0\n")
    entries = (
        "[tofpod.detectors]\nacme = acme:AcmeDetector\n[pytest11]\ntofpod = "
        "harness.programs.gate.pytest_plugin\n"
    )
    (info / "entry_points.txt").write_text(entries)
    path = os.pathsep.join((str(ROOT), str(tmp_path / "site")))

    def ci(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pytest", "-q", "tests", *arguments]
        environment = {**os.environ, "PYTHONPATH": path}
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=900
        )

    without = ci()
    assert without.returncode == 1 and "there is no such baseline" in without.stdout
    assert "pytest --tofpod-update" in without.stdout
    written = ci("--tofpod-update")
    assert written.returncode == 0, written.stdout + written.stderr
    assert (tmp_path / "tests" / "limit.baseline.json").exists()
    again = ci()
    assert again.returncode == 0, again.stdout + again.stderr
    (tmp_path / "site" / "acme.py").write_text(DETECTOR.replace("BLUR_PX = 1", "BLUR_PX = 15"))
    blunt = ci()
    assert blunt.returncode == 1 and "the check fails" in blunt.stdout and "worse" in blunt.stdout
    assert "Traceback" not in blunt.stdout
