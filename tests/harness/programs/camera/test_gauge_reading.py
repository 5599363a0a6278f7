"""A solid gauge before cameras that are wrong in a known way: what one recording shows of them."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from harness.programs.camera import characterise, gauge_report
from harness.programs.camera.gauge_report import GaugeReading, read_recording
from harness.vocabulary.geometry import MM
from scenes.sensor.camera import read_camera
from tests.support.gauge_scene import pose, recorded


def reading(arguments: list[str]) -> GaugeReading:
    """What `tofpod characterise --gauge` reads of a capture, without the camera file."""
    return read_recording(characterise.main.parser().parse_args(arguments))


WRONG = {
    "scale": {"scale": 1.01, "blur_px": 0.3},
    "bias": {"bias_mm": 5.0, "dropped": 0.5},
    "blur": {"blur_px": 0.6, "pattern_mm": 0.3},
    "all": {"scale": 0.99, "bias_mm": -5.0, "blur_px": 0.6, "dropped": 0.3},
}


@pytest.mark.parametrize(
    "name",
    ["all", *(pytest.param(name, marks=pytest.mark.slow) for name in ("scale", "bias", "blur"))],
)
def test_a_wrong_camera_is_recovered_within_its_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
):
    wrong = WRONG[name]
    seen = reading(recorded(tmp_path, **wrong))
    scale = seen.fit.interval(0)
    assert scale.low < wrong.get("scale", 1.0) < scale.high
    assert scale.high - scale.low < 0.006
    bias = seen.fit.interval(1)
    assert bias.low < wrong.get("bias_mm", 0.0) * MM < bias.high
    assert bias.high - bias.low < 4 * MM
    assert seen.blur is not None
    if "blur_px" in wrong:
        assert seen.blur.blur_px == pytest.approx(wrong["blur_px"], abs=0.05)
    assert len(seen.spheres) == 6
    assert seen.fit.T_camera_gauge == pytest.approx(pose(), abs=2e-3)
    # a camera whose blur is unknown is expected to see sharply
    unknown = (seen.fit, None, seen.sharp_m)
    monkeypatch.setattr(gauge_report, "range_and_blur", lambda *_: unknown)
    monkeypatch.setattr(gauge_report, "_of_surfaces", lambda *_: ())
    one_frame = SimpleNamespace(n_frames=1)
    sharp = gauge_report.measured("sharp", one_frame, seen.image, seen.gauge, pose())
    assert np.nanmax(np.abs(seen.seen_m - seen.sharp_m)) > 1 * MM
    np.testing.assert_array_equal(sharp.seen_m, seen.sharp_m)


@pytest.mark.slow  # characterises and simulates the whole capture
def test_one_recording_gives_all_files(tmp_path: Path, capsys):
    arguments = recorded(tmp_path, bias_mm=5.0, blur_px=0.6)
    assert characterise.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "mm in bias" in printed
    assert "of 21 pockets are seen; the camera file expects" in printed
    out = tmp_path / "out"
    camera = read_camera(out / "my_camera.yaml")
    assert camera.range_error.bias_mm.value == pytest.approx(5, abs=1.5)
    assert camera.range_error.scale.value == pytest.approx(1, abs=0.003)
    assert 0 < camera.unit.offset_mm.value < 0.2
    assert camera.edge.blur_px.value == pytest.approx(0.6, abs=0.05)
    pairs = pd.read_csv(out / "spacings.csv")
    assert len(pairs) == 15
    # a bias of 5 mm at 0.45 m stretches what lies across the rays by 1.1 %
    assert (pairs.error_mm / pairs.true_mm).median() == pytest.approx(0.0111, abs=0.003)
    figures = pd.read_csv(out / "gauge.csv").set_index(["figure", "where"]).value
    assert figures["temporal noise", "levels"] == pytest.approx(0.9, rel=0.1)
    assert figures["depth seen", "pocket 12 x 4"] == pytest.approx(1, abs=0.1)
    assert figures["signal over noise", "pocket 12 x 4"] > 10
    assert figures["signal over noise", "pocket 2 x 1"] < 5
    pockets = pd.read_csv(out / "pockets.csv").set_index("pocket")
    assert pockets.loc["pocket 12 x 4", ["simulated", "simulated_high"]].tolist() == [1, 1]
    assert pockets.loc["pocket 2 x 1", ["simulated_low", "simulated"]].tolist() == [0, 0]
    assert pockets.seen.sum() == pytest.approx(pockets.simulated.sum(), abs=3)
    assert (pockets.ratio >= 5).tolist() == pockets.seen.tolist()
    stored = json.loads((out / "gauge.json").read_text())
    assert np.array(stored["T_camera_gauge"]) == pytest.approx(pose(), abs=2e-3)


def test_mistakes_are_explained(tmp_path: Path, capsys):
    arguments = recorded(tmp_path, frames=1)
    without_gauge = [*arguments[:5], "--calliper", "c.csv", "--out", str(tmp_path)]
    assert characterise.main(without_gauge) == 2
    assert "--calliper corrects a gauge" in capsys.readouterr().err
    wall = np.full((1, 224, 240), 7000, np.uint16)
    np.savez(tmp_path / "gauge.npz", depth=wall)
    assert characterise.main(arguments) == 2
    assert "the gauge is not recognised: 0 spheres" in capsys.readouterr().err
