"""Each step of the comparison of a drilled board with its capture, on planted surfaces."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from harness.programs.scorecard import board
from harness.programs.scorecard.board import (
    Image,
    _answer,
    _cloud,
    _cut_around,
    _residual_mm,
    angles_deg,
    image_of,
    measured,
)
from harness.programs.scorecard.figures import Beside
from harness.stills.statistics import Reading
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Lens, rays_of
from scenes.sensor.camera import load_camera

LENS = Lens(120, 100, 1000.0, 1000.0, 60.0, 50.0)
"""One pixel is 1 mm at 1 m."""


def pose(z_m: float = 1.0, tilt_deg: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xy", [tilt_deg, 2 * tilt_deg], degrees=True).as_matrix()
    T[:3, 3] = [0.01, -0.02, z_m]
    return T


def facing(distance_m: float = 1.0) -> Image:
    T_image_board = np.eye(4)
    T_image_board[2, 3] = distance_m
    return Image(LENS, T_image_board, np.eye(4))


def target_of(*centres_mm: tuple[float, float], T_camera_board: np.ndarray | None = None) -> Any:
    holes = [SimpleNamespace(centre_mm=c, centre_m=tuple(MM * np.array(c))) for c in centres_mm]
    T = facing().T_image_board if T_camera_board is None else T_camera_board
    return SimpleNamespace(holes=holes, pose=SimpleNamespace(T_camera_board=T))


def test_pixels_see_points_of_the_boards_plane() -> None:
    """The points, moved into the image's frame, lie on the pixels' rays."""
    image = Image(LENS, pose(tilt_deg=10.0), np.eye(4))
    plan_m = image.plan_mm * MM
    points = np.concatenate([plan_m, np.zeros((*plan_m.shape[:2], 1))], axis=-1)
    moved = points @ image.T_image_board[:3, :3].T + image.T_image_board[:3, 3]
    assert moved / moved[..., 2:] == pytest.approx(image.rays, abs=1e-12)
    assert image.rays[50, 80] == pytest.approx([0.02, 0.0, 1.0])


def test_resampled_frames_are_those_of_the_other_image() -> None:
    """A tilted board, seen by the depth camera, has its distance in the image, in whole steps."""
    camera = load_camera("azure_kinect_nfov_binned")
    T_depth_board = pose(0.6, tilt_deg=8.0)
    T_image_depth = np.eye(4)
    T_image_depth[:3, :3] = Rotation.from_euler("x", 3.0, degrees=True).as_matrix()
    T_image_depth[:3, 3] = [-0.03, 0.01, 0.004]
    image = Image(
        Lens(60, 50, 120.0, 120.0, 30.0, 25.0), T_image_depth @ T_depth_board, T_image_depth
    )

    def board_z_m(T: np.ndarray, rays: np.ndarray) -> np.ndarray:
        normal = T[:3, 2]
        return (normal @ T[:3, 3]) / (rays @ normal)

    region = camera.nominal_lens.whole
    slopes = camera.nominal_lens.region_slopes(region)
    rays = rays_of(slopes)
    z_m = board_z_m(T_depth_board, rays)
    frames = image.resampled(np.stack([z_m, z_m + 0.01]), camera)
    expected = board_z_m(image.T_image_board, image.rays)
    step_m = camera.z_step_m
    assert np.abs(frames[0] - expected).max() <= 0.51 * step_m + 0.05 * MM
    steps = frames / step_m
    assert steps == pytest.approx(np.round(steps), abs=1e-6)
    # 10 mm farther along the depth camera's axis
    assert (frames[1] - frames[0]).mean() == pytest.approx(0.01, rel=0.06)


def test_the_image_is_the_cameras_own_or_that_of_its_colour_camera() -> None:
    camera = load_camera("azure_kinect_nfov_binned")
    T_depth_board = pose(0.6)
    target = target_of((0.0, 0.0), T_camera_board=T_depth_board)
    nominal = camera.nominal_lens
    for lens, used in (
        (None, nominal),
        (Lens(nominal.width, nominal.height, 9.0, 9.0, 3.0, 3.0), None),
    ):
        image = image_of(target, camera, lens)
        assert image.lens == (used or lens)
        assert np.array_equal(image.T_image_board, T_depth_board)
        assert np.array_equal(image.T_image_depth, np.eye(4))
    taller = Lens(nominal.width, nominal.height + 1, 9.0, 9.0, 3.0, 3.0)
    aligned = image_of(target, camera, taller)
    assert aligned.lens.distortion == tuple(camera.colour.distortion.value)
    assert np.array_equal(aligned.T_image_depth, camera.colour.T_colour_depth)
    assert aligned.T_image_board == pytest.approx(camera.colour.T_colour_depth @ T_depth_board)
    distorted = Lens(9, 9, 9.0, 9.0, 3.0, 3.0, (1e-9,) + 7 * (0.0,))
    assert image_of(target, camera, distorted).lens == distorted
    blind: Any = SimpleNamespace(nominal_lens=nominal, name="blind")
    with pytest.raises(UserError, match="the capture has 9 x 9 pixels, blind has"):
        image_of(target, blind, distorted)


@pytest.mark.parametrize(
    ("centre_mm", "is_in"),
    [
        # pixels nearer than 13.5 mm reach 13 to either side; columns are -60 to 59, rows -50 to 49
        ((0.0, 0.0), True),
        ((-46.0, 0.0), True),
        ((-47.0, 0.0), False),
        ((45.0, 0.0), True),
        ((46.0, 0.0), False),
        ((0.0, -36.0), True),
        ((0.0, -37.0), False),
        ((0.0, 35.0), True),
        ((0.0, 36.0), False),
        ((200.0, 0.0), False),
    ],
)
def test_a_hole_is_cut_out_with_its_ring(centre_mm: tuple[float, float], is_in: bool) -> None:
    cut = _cut_around(facing(), np.array(centre_mm))
    assert (cut is not None) == is_in
    if cut is not None:
        column = round(60 + centre_mm[0])
        row = round(50 + centre_mm[1])
        assert cut == (slice(row - 13, row + 14), slice(column - 13, column + 14))


def test_a_peak_is_over_the_quadratic_surface_of_the_ring() -> None:
    """All terms of the surface are taken out; an object on the ring is excluded, and so is what
    has no range."""
    y, x = np.mgrid[-13.0:14.0, -13.0:14.0]
    plan_mm = np.stack([x, y], axis=-1)
    distance = np.hypot(x, y)
    surface_mm = 1000.0 + 0.3 * x - 0.2 * y + 0.004 * x**2 - 0.003 * x * y + 0.002 * y**2
    bump_mm = np.where(distance < 4.0, 5.0 - distance, 0.0)
    object_mm = np.where((x > 8.0) & (np.abs(y) < 4.0), -20.0, 0.0)
    rng = np.random.default_rng(1)
    rough_mm = rng.uniform(-0.01, 0.01, x.shape)
    z_mm = surface_mm + bump_mm + object_mm + rough_mm
    z_mm[0, 13] = np.nan
    z_mm[3, 13] = np.nan
    residual_mm, ring = _residual_mm(plan_mm, z_mm * MM)
    is_known = np.isfinite(z_mm)
    added_mm = bump_mm + object_mm + rough_mm
    assert residual_mm[is_known] == pytest.approx(added_mm[is_known], abs=0.012)
    in_ring = (distance > 6.5) & (distance < 13.5) & is_known
    assert np.array_equal(ring, in_ring & (object_mm == 0.0))


def test_four_robust_deviations_belong_to_the_surface() -> None:
    """Pixels of the ring lie 1 mm to either side; one lies 5.5 mm off, one 6.5 mm."""
    y, x = np.mgrid[-13.0:14.0, -13.0:14.0]
    z_mm = 1000.0 + np.where((x + y) % 2 == 0, 1.0, -1.0)
    z_mm[13, 3] = 1005.5
    z_mm[13, 23] = 1006.5
    _, ring = _residual_mm(np.stack([x, y], axis=-1), z_mm * MM)
    # 4 x 1.4826 x 1 mm = 5.93 mm
    assert ring[13, 3]
    assert not ring[13, 23]


def test_the_angle_of_a_hole_is_that_from_the_axis() -> None:
    T = np.eye(4)
    T[:3, 3] = [0.0, 0.0, 0.5]
    target = target_of((0.0, 0.0), (300.0, 400.0), (-500.0, 0.0), T_camera_board=T)
    assert angles_deg(target) == pytest.approx([0.0, 45.0, 45.0])


def test_the_average_of_frames_by_hand() -> None:
    z_m = np.full((3, 100, 120), np.nan)
    z_m[:, 0, 0] = [1.0, 2.0, 6.0]
    z_m[1:, 0, 1] = [2.0, 4.0]
    z_m[0, 0, 2] = 5.0
    cloud = _cloud(z_m, facing())
    assert cloud.points_m[0, :3, 2].tolist() == [3.0, 3.0, 5.0]
    assert cloud.points_m[0, 1, 0] == pytest.approx(3.0 * (1 - 60) / 1000)
    assert cloud.count[0, :4].tolist() == [3, 2, 1, 0]
    assert cloud.reason[0, :4].tolist() == [0, 0, 0, 1]
    assert cloud.variance_m2[0, :2].tolist() == [(4 + 1 + 9) / 2, 2.0]
    assert np.isnan(cloud.variance_m2[0, 2:4]).all()
    assert cloud.n_frames == 3


def test_the_readings_of_a_board_are_the_planted_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plate at 1 m with noise of 1 mm, an uneven face of 0.6 mm that all frames share, and holes
    whose peaks are 4, 6 and 9 mm; the last hole is cut by the image's rim. The plate counts as
    seen from 0.02 m for the angles."""
    rng = np.random.default_rng(3)
    centres = [(-30.0, -20.0), (0.0, 0.0), (25.0, 15.0), (56.0, 0.0)]
    image = facing()
    uneven = 0.6 * rng.standard_normal((100, 120))
    z_mm = 1000.0 + uneven + 1.0 * rng.standard_normal((36, 100, 120))
    for centre, peak_mm in zip(centres, (4.0, 6.0, 9.0, 30.0), strict=True):
        away = np.linalg.norm(image.plan_mm - centre, axis=-1)
        # a step within 2 mm; between that and the ring nothing stands out
        z_mm[:, away < 6.5] = 999.0
        z_mm[:, away < 1.5] = 1000.0 + peak_mm
    close = np.eye(4)
    close[2, 3] = 0.02
    target = target_of(*centres, T_camera_board=close)
    peaks = [(np.array([0.3, 0.0]), 1), (np.array([-30.0, -12.0]), 2)]

    def load_detector(name: str, settings: dict[str, Any]) -> Any:
        assert (name, settings) == ("fake", {"a": 1})

        def find(cloud: Any, evidence: Any, k: float) -> list[Any]:
            assert (evidence, k) == ("evidence", 3.0)
            spots = []
            for centre, reach in peaks:
                away = np.linalg.norm(image.plan_mm.reshape(-1, 2) - centre, axis=1)
                spots.append(SimpleNamespace(pixels=np.flatnonzero(away < reach)))
            return spots

        return SimpleNamespace(analyse=lambda cloud: "evidence", find=find)

    monkeypatch.setattr(board, "load_detector", load_detector)
    config: Any = SimpleNamespace(
        threshold=SimpleNamespace(k=3.0), matching=SimpleNamespace(radius_mm=5.0)
    )
    readings, peaks_mm = measured(z_mm * MM, image, target, config, {"fake": {"a": 1}})
    assert peaks_mm[:3] == pytest.approx([4.0, 6.0, 9.0], abs=0.3)
    assert np.isnan(peaks_mm[3])
    noise, pixels = readings["temporal deviation", "on the face", "mm"]
    assert noise.value == pytest.approx(1.0, rel=0.02)
    assert pixels > 3 * 400
    still_mm = np.hypot(0.6, 1.0 / 6.0)
    for size in (3, 6, 12):
        key = ("fixed pattern", f"means over {size} x {size} px", "mm")
        if size < 12:
            value, count = readings[key]
            assert value.value == pytest.approx(still_mm / size, rel=0.25)
            assert count > 20
        else:
            assert key not in readings  # no such square lies in the ring
    all_peaks, count = readings["peak of a hole", "all", "mm"]
    assert all_peaks.value == pytest.approx(np.mean(peaks_mm[:3]))
    assert count == 3
    # angles of 0 and of arctan(36 / 20) = 61 and arctan(29 / 20) = 56 degrees
    bins = {key[1]: value for key, value in readings.items() if key[0] == "peak of a hole"}
    assert bins["0 to 20 degrees off the axis"][1] == 1
    assert bins["0 to 20 degrees off the axis"][0].value == peaks_mm[1]
    assert bins["20 to 35 degrees off the axis"][1] == 0
    assert bins["35 to 60 degrees off the axis"][1] == 1
    assert bins["35 to 60 degrees off the axis"][0].value == peaks_mm[2]
    share, holes = readings["share of holes found", "fake", ""]
    # the second finding lies 8 mm from the first hole
    assert (share.value, holes) == (pytest.approx(1 / 3), 3)


def test_a_board_out_of_view_is_refused() -> None:
    with pytest.raises(UserError, match="no hole is in view"):
        measured(np.ones((3, 100, 120)), facing(), target_of((200.0, 0.0)), SimpleNamespace(), {})  # type: ignore[arg-type]


def row(where: str, simulated: float, measured: float, at: str = "all") -> Beside:
    return Beside(where, "peak", at, "mm", 5, Reading(measured), Reading(simulated))


def test_the_closest_set_up_has_fewest_figures_off_by_a_third() -> None:
    rows = [
        row("near", 1.29, 1.0, "a"),
        row("near", 0.71, 1.0, "b"),
        row("near", 5.0, np.nan, "c"),
        row("near", np.nan, 1.0, "d"),
        row("near", 1.0, 0.0, "e"),
        row("far", 1.0, 1.0, "a"),
        row("far", 2.62, 2.0, "b"),
    ]
    assert _answer(rows) == (
        "Of 2 set-ups, near is closest: 2 of 2 figures within 30 % of the capture."
    )
    assert _answer(rows[5:]) == (
        "Of 1 set-ups, far is closest: 1 of 2 figures within 30 % of the capture; "
        "peak, b: 1.31 of the capture's."
    )


def test_of_equally_many_figures_the_smaller_ratios_decide() -> None:
    """A half and a double are equally far."""
    rows = [row("half", 0.5, 1.0), row("threefold", 3.0, 1.0), row("more", 1.9, 1.0)]
    assert "more is closest: 0 of 1" in _answer(rows)
    assert "half is closest" in _answer(rows[:2])
