"""A camera's noise as a table: its statistics against the full model, and the files that the
program writes."""

from __future__ import annotations

import subprocess
import sys
from functools import lru_cache

import numpy as np
import pytest

from harness.programs.camera.export_noise import main, noise_table
from harness.trials.clouds import pair_noise
from scenes.sensor.calibration import unit_before_plane
from scenes.sensor.camera import load_camera
from scenes.sensor.common.tabled import DepthNoise, TorchDepthNoise

PAIRS = 15
table_of = lru_cache(lambda name: noise_table(load_camera(name)))


def statistics(frames: list[np.ndarray]) -> tuple[dict[str, float], float]:
    """Deviation in mm and correlations of the frames' noise, and the share of returns."""
    everywhere = np.ones(frames[0].shape, bool)
    pairs = [pair_noise(*frames[2 * k : 2 * k + 2], everywhere) for k in range(PAIRS)]
    means = {key: float(np.mean([pair[key] for pair in pairs])) for key in pairs[0]}
    return means, float(np.isfinite(frames).mean())


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("azure_kinect_nfov", marks=pytest.mark.slow),
        "kinect_v2",
        pytest.param("realsense_l515", marks=pytest.mark.slow),
    ],
)
def test_the_table_has_the_statistics_of_the_full_model(name):
    """Deviation within 5 %, correlations within 0.05, near and far, bright and dark."""
    camera = load_camera(name)
    table = table_of(name)
    for distance_m, albedo in ((0.7, 0.6), (1.5, 0.3), (2.5, 0.8)):
        unit = unit_before_plane(camera, distance_m, albedo)
        full = [frame.z_m.astype(float) for frame in unit.capture(2 * PAIRS, 7).frames()]
        cut = unit.region.within(camera.nominal_lens.whole)
        cut_table = {**table, "slopes": table["slopes"][cut], "falloff": table["falloff"][cut]}
        noise = DepthNoise(cut_table)
        rng = np.random.default_rng(1)
        ideal = np.nanmean(full, axis=0)
        ideal = (
            np.where(np.isfinite(ideal), ideal, np.nanmean(ideal)) - noise.pattern_m / noise.stretch
        )
        drawn = [
            noise(ideal, np.full(ideal.shape, albedo), rng).astype(float) for _ in range(2 * PAIRS)
        ]
        (wanted, seen), (found, kept) = statistics(full), statistics(drawn)
        assert found.pop("single_frame_mm") == pytest.approx(
            wanted.pop("single_frame_mm"), rel=0.05
        )
        assert found == pytest.approx(wanted, abs=0.05)
        assert kept == pytest.approx(seen, abs=0.01)


@pytest.mark.slow  # a Monte Carlo campaign
def test_too_little_light_and_ranges_out_of_reach_return_nothing():
    table = table_of("azure_kinect_nfov")
    noise = DepthNoise(table)
    rng = np.random.default_rng(1)
    far = np.full(noise.shape, 12.0)
    assert np.isnan(noise(far, np.full(noise.shape, 0.01), rng)).all()
    assert np.isnan(noise(np.full(noise.shape, 0.01), np.ones(noise.shape), rng)).all()
    for dark in (0.0, -1.0, np.nan):
        assert np.isnan(noise(np.full(noise.shape, 1.0), np.full(noise.shape, dark), rng)).all()
    close_z_m = noise(np.full(noise.shape, 1.0), np.full(noise.shape, 0.6), rng)
    # inside the lit hexagon, not in the corners
    assert np.isfinite(close_z_m[250:350, 270:370]).all() and np.isnan(close_z_m[0, 0])
    assert np.round(1e3 * close_z_m[300]) == pytest.approx(
        1e3 * close_z_m[300], abs=1e-3, nan_ok=True
    )
    other_unit = DepthNoise(table, seed=2)
    assert np.std(noise.pattern_m) == pytest.approx(float(table["pattern_m"]), rel=0.1)
    assert abs(np.corrcoef(noise.pattern_m.ravel(), other_unit.pattern_m.ravel())[0, 1]) < 0.05


def test_the_program_writes_files_that_stand_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "harness.programs.camera.export_noise.noise_table", lambda camera: table_of(camera.name)
    )  # made once above
    assert main(["kinect_v2", "--out", str(tmp_path)]) == 0
    assert "fixed pattern of a unit" in capsys.readouterr().out
    code = (
        "import numpy as np; from depth_noise import DepthNoise; n = "
        "DepthNoise('kinect_v2.npz');z = n(np.ones(n.shape), np.full(n.shape, 0.6), "
        "np.random.default_rng(0));print(z.shape, np.isfinite(z).mean())"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert ran.stdout.startswith("(424, 512) ")
    assert main(["azure_kinect_nfv", "--out", str(tmp_path / "none")]) == 2
    assert "azure_kinect_nfov" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_torch_has_the_same_statistics():
    torch = pytest.importorskip("torch")
    table = table_of("azure_kinect_nfov")
    noise = TorchDepthNoise(table)
    same = DepthNoise(table)
    z = torch.ones(2 * PAIRS, *noise.stretch.shape)
    bright = torch.full(noise.stretch.shape, 0.6)
    frames = [frame[200:300, 250:400].double().numpy() for frame in noise(z, bright.expand_as(z))]
    rng = np.random.default_rng(1)
    wanted = [
        same(np.ones(same.shape), np.full(same.shape, 0.6), rng)[200:300, 250:400] for _ in frames
    ]
    assert statistics(frames)[0] == pytest.approx(statistics(wanted)[0], rel=0.03, abs=0.02)
