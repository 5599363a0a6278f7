"""The fit of a camera's gain, on noise that follows a law."""

from __future__ import annotations

import numpy as np
import pytest

from harness.vocabulary.geometry import MM
from scenes.sensor import calibration
from scenes.sensor.calibration import calibrated_signal_electrons, with_number
from scenes.sensor.camera import load_camera


@pytest.mark.parametrize(
    ("name", "frames", "count"),
    [("azure_kinect_nfov", None, 200), ("realsense_l515", None, 100), ("azure_kinect_nfov", 7, 7)],
)
def test_the_gain_is_where_noise_and_jitter_give_the_published_deviation(
    monkeypatch: pytest.MonkeyPatch, name: str, frames: int | None, count: int
) -> None:
    """Noise of 3 mm at 1,500 electrons, falling with the root; below 1,200 electrons a pixel is
    lost in some frame."""
    camera = with_number(load_camera(name), "unit", "jitter_mm", 0.3)
    camera = with_number(camera, "photons", "calibration_sigma_mm", 0.5)

    def sigma_m(trial, distance_m: float, albedo: float, taken: int, seed: int) -> float:
        photons = camera.photons
        assert distance_m == photons.calibration_distance_m.value
        assert albedo == photons.calibration_albedo.value
        assert (taken, seed) == (count, 5)
        electrons = trial.photons.signal_electrons.value
        return np.nan if electrons < 1200.0 else 3.0 * MM * np.sqrt(1500.0 / electrons)

    monkeypatch.setattr(calibration, "temporal_sigma_m", sigma_m)
    electrons = calibrated_signal_electrons(camera, frames, seed=5)
    # 0.4 mm remain beside the jitter
    assert electrons == pytest.approx(1500.0 * (3.0 / 0.4) ** 2, rel=2e-3)


def test_the_plane_lies_about_the_axis_and_its_noise_is_over_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    camera = load_camera("azure_kinect_nfov")
    unit = calibration.unit_before_plane(camera, 1.2, 0.4)
    region = unit.view.region
    lens = camera.nominal_lens
    assert region.shape == (48, 80)
    assert (region.row0 + 24, region.col0 + 40) == (int(lens.cy), int(lens.cx))
    assert unit.view.range_m.min() > 1.15
    frames = np.array([[[1.0, 2.0]], [[1.0, 4.0]], [[1.0, 9.0]]])

    class RangeFrame:
        def __init__(self, z_m: np.ndarray) -> None:
            self.z_m = z_m

    class Unit:
        def capture(self, count: int, seed: int, label: str):  # type: ignore[no-untyped-def]
            assert (count, seed, label) == (3, 9, "calibration")
            return self

        def frames(self) -> list[RangeFrame]:
            return [RangeFrame(z_m) for z_m in frames]

    monkeypatch.setattr(calibration, "unit_before_plane", lambda *_: Unit())
    variance = np.var([2.0, 4.0, 9.0], ddof=1)
    sigma_m = calibration.temporal_sigma_m(camera, 1.0, 0.5, 3, 9)
    assert sigma_m == pytest.approx(np.sqrt(variance / 2))
    frames[0, 0, 0] = np.nan
    assert np.isnan(calibration.temporal_sigma_m(camera, 1.0, 0.5, 3, 9))
    lidar = load_camera("realsense_l515")
    assert calibration.temporal_sigma_m(lidar, 1.0, 0.5, 3, 9) == pytest.approx(sigma_m)
