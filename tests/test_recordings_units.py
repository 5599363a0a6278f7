"""What stored numbers mean: codes for no return, the unit and who says so, and clouds that look backwards."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from detectors.recordings import Recording, open_capture
from detectors.recordings.distances import no_return_codes
from harness.vocabulary.capture import Reason
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens
from tests import recorded_plane as plane

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
LENS = Lens(640, 576, 504.6, 504.6, 321.7, 333.3)


def noisy(distance_m: float, unit_m: float, seed: int = 0) -> np.ndarray:
    """(72, 96) stored whole numbers of a tilted plane with noise of 1 mm."""
    x = plane.slopes()[..., 0]
    noise_m = np.random.default_rng(seed).normal(0, 1e-3, x.shape)
    return np.rint((distance_m / (1 - 0.1 * x) + noise_m) / unit_m)


def opened(folder: Path, stored: np.ndarray, unit: str | None = None, lens: Lens = plane.LENS) -> Recording:
    folder.mkdir(exist_ok=True)
    cv2.imwrite(str(folder / "1.png"), stored.astype(np.uint16))
    return open_capture([folder], lens=lens, unit=unit)


# ---- codes for no return ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("codes", "dtype"),
    (
        ((65535,), np.uint16),
        ((65534,), np.uint16),
        ((65300, 65400, 65500), np.uint16),
        ((4095,), np.uint16),
        ((32767,), np.int16),
        ((-1,), np.int16),
        ((1,), np.uint16),
        ((10_000.0,), np.float32),
        ((-1.0,), np.float64),
    ),
)
def test_a_code_for_no_return_is_told_by_its_place_among_the_distances(codes: tuple[float, ...], dtype: type) -> None:
    stored = noisy(0.7, 1e-3).astype(dtype).ravel()
    assert no_return_codes(stored) == ()
    for n, code in enumerate(codes):
        stored[30 * n : 30 * n + 30] = code
    assert sorted(no_return_codes(stored)) == sorted(codes)


def test_distances_are_no_codes() -> None:
    far = np.concatenate([noisy(0.4, 1e-3).ravel(), noisy(2.5, 1e-3).ravel()[:40]]).astype(np.uint16)
    assert no_return_codes(far) == ()  # a wall six times as far, with noise
    assert no_return_codes(np.repeat([400, 2500], 500)) == ()  # two faces without noise
    assert no_return_codes(np.array([], np.uint16)) == ()


def test_no_return_is_said_and_left_out(tmp_path: Path) -> None:
    stored = noisy(0.7, 1e-3)
    stored[:7] = 65535
    recording = opened(tmp_path / "c", stored)
    frame = recording.first_frame()
    assert (frame.reason[:7] == Reason.NO_RETURN).all() and np.isfinite(frame.z_m[7:]).all()
    assert "65535 taken as no return, 9.7 % of pixels" in recording.notes


def test_a_cloud_that_looks_backwards_is_turned_and_said(tmp_path: Path) -> None:
    points = plane.points_m(plane.depth_mm())
    recording = open_capture([plane.write_pcd(tmp_path / "c.pcd", points * [1, -1, -1])])
    frame = recording.first_frame()
    assert any("turned" in note for note in recording.notes)
    np.testing.assert_allclose(np.dstack([frame.xy_m, frame.z_m]), points, atol=1e-6)


# ---- units -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stored", "unit_mm"),
    (
        (noisy(0.7, 1e-3).astype(np.uint16), 1.0),
        (noisy(0.7, 1e-3).astype(np.uint16) * np.uint16(5), 0.2),  # TUM RGB-D from a camera with 1 mm
        (noisy(0.7, 1e-3) * 1e-3, 1000.0),
        (noisy(0.7, 1e-3), 1.0),
        (noisy(0.7, 1e-4) / 100, 10.0),
    ),
)
def test_the_unit_is_told_by_the_data_and_printed(tmp_path: Path, stored: np.ndarray, unit_mm: float) -> None:
    np.save(tmp_path / "d.npy", stored)
    recording = open_capture([tmp_path / "d.npy"], lens=plane.LENS)
    assert recording.unit_text.startswith(f"depth unit {unit_mm:.4g} mm, from ")
    assert np.nanmedian(recording.first_frame().z_m) == pytest.approx(0.7, rel=0.02)
    usual = 1000.0 if stored.dtype.kind == "f" else 1.0
    assert bool(recording.warnings) == (unit_mm != usual)


@pytest.mark.parametrize("unit_m", (2.5e-4, 1e-4))
def test_where_two_units_are_plausible_it_asks(tmp_path: Path, unit_m: float) -> None:
    with pytest.raises(UserError, match="nothing states the unit") as caught:
        opened(tmp_path / "c", noisy(0.9, unit_m))
    assert f"--unit {1 / unit_m:.0f}/m (0.9 m)" in str(caught.value) and "--unit mm (" in str(caught.value)
    recording = opened(tmp_path / "c", noisy(0.9, unit_m), unit=f"{1 / unit_m:.0f}/m")
    assert recording.warnings == () and f"from --unit {1 / unit_m:.0f}/m" in recording.unit_text


def test_a_camera_with_millimetres_is_believed_within_its_reach_only(tmp_path: Path) -> None:
    assert opened(tmp_path / "near", np.full((576, 640), 1700), lens=LENS).warnings == ()
    (warning,) = opened(tmp_path / "far", np.full((576, 640), 3200), lens=LENS).warnings
    assert "3.2 m" in warning and "--unit 4000/m (0.8 m)" in warning
    with pytest.raises(UserError, match="--unit 4000/m"):
        opened(tmp_path / "beyond", np.full((576, 640), 5200), lens=LENS)
