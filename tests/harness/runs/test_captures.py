"""An experiment on a real capture: each point's findings in its folder, and one table of all."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from harness.experiment.load import load_experiment
from harness.records.trials import POINTS_OF_CAPTURES
from harness.runs.captures import judge_captures

CAPTURE = """\
name: real
source: {kind: capture, paths: [frames], intrinsics: azure_kinect_nfov_binned}
capture: {frames: 4}
detector: {name: thesis, settings: {crop: {kind: none}}}
threshold: {k: 6.0}
sweep:
  threshold.k: [6.0, 9.0]
"""


def test_each_point_is_judged_into_its_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A wall at 0.7 m with a hollow of 20 mm; the second of the four frames jumps and is left out."""
    frames = tmp_path / "frames"
    frames.mkdir()
    rng = np.random.default_rng(1)
    for index in range(5):
        z_mm = 700.0 + rng.normal(0.0, 1.0, (288, 320))
        z_mm[140:150, 155:165] += 20.0
        z_mm += 40.0 * (index == 1)
        cv2.imwrite(str(frames / f"{index}.png"), np.rint(z_mm).astype(np.uint16))
    (tmp_path / "real.yaml").write_text(CAPTURE)
    experiment = load_experiment(tmp_path / "real.yaml")
    out = tmp_path / "out"
    assert judge_captures(experiment, out, "tofpod real.yaml") == 0
    folder = experiment.folder(out)
    table = pd.read_csv(folder / POINTS_OF_CAPTURES.files[0])
    assert table["point"].tolist() == ["point-000", "point-001"]
    assert table["threshold_k"].tolist() == [6.0, 9.0]
    assert table["frames_used"].tolist() == [3, 3]
    assert table["frames_left_out"].tolist() == [1, 1]
    scale_mm = table["threshold_mm"] / table["threshold_k"]
    assert scale_mm[0] == pytest.approx(scale_mm[1], rel=1e-3)
    # a deviation of 1 mm over the root of the frames, and the rounding to 1 mm
    assert 0.3 < scale_mm[0] < 0.8
    for name, found in zip(table["point"], table["findings"], strict=True):
        findings = pd.read_csv(folder / name / "findings.csv")
        assert len(findings) == found >= 1
    printed = capsys.readouterr().out
    assert "point-001" in printed
    assert f"findings: {folder}" in printed
