"""Virtual damage for a real scan, by hand: small boards, and the difference between two views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region
from scenes import implants
from scenes.closed_form import plane_view
from scenes.implants import Implant, implant_of, local_board, side_mm, unit_config
from scenes.optics import NoiseFreeView
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom

CAMERA = "azure_kinect_nfov_binned"
TARGET = custom.TargetConfig(
    board=custom.BoardConfig(
        width_mm=300.0,
        height_mm=200.0,
        thickness_mm=12.0,
        shape=custom.FlatConfig(),
    ),
    holes=(
        custom.HoleConfig(
            id=3,
            diameter_mm=12.0,
            centre_mm=(10.0, 5.0),
        ),
        custom.HoleConfig(
            id=4,
            diameter_mm=9.0,
            centre_mm=(60.0, 5.0),
        ),
    ),
    dents=(
        custom.DentConfig(
            id=5,
            diameter_mm=12.0,
            depth_mm=2.0,
            centre_mm=(-40.0, 5.0),
        ),
    ),
    backing=custom.BackingConfig(distance_mm=20.0, size_mm=(50.0, 60.0)),
)
PLACE_M = np.array([0.02, -0.01, 0.6])
NORMAL = np.array([0.2, -0.1, -1.0]) / np.sqrt(1.05)


def own_lens() -> Lens:
    return camera_of(
        unit_config(
            CAMERA,
            Lens(
                1,
                1,
                1.0,
                1.0,
                0.0,
                0.0,
            ),
        )[0]
    ).nominal_lens


def test_a_unit_keeps_what_a_recording_lacks() -> None:
    config, same = unit_config(CAMERA, own_lens())
    assert same
    drawn = {name for name, is_on in config.effects.model_dump().items() if is_on}
    assert drawn == {"noise", "multipath", "wiggling", "ambient", "saturation"}
    assert config.numbers["engine.output_step_mm"] == 1e-3


def test_a_unit_has_the_recordings_lens_where_its_size_is_the_cameras() -> None:
    lens = own_lens()
    moved = Lens(
        lens.width,
        lens.height,
        lens.fx + 1,
        lens.fy,
        lens.cx,
        lens.cy,
        lens.distortion,
    )
    config, same = unit_config(CAMERA, moved)
    assert same
    assert camera_of(config).nominal_lens.fx == pytest.approx(lens.fx + 1)
    for width, height in ((lens.width + 1, lens.height), (lens.width, lens.height + 1)):
        other_lens = Lens(width, height, lens.fx + 1, lens.fy, lens.cx, lens.cy)
        config, same = unit_config(CAMERA, other_lens)
        assert not same
        assert camera_of(config).nominal_lens.fx == pytest.approx(lens.fx)


def test_a_local_board_has_one_damage_at_its_centre_where_it_lies() -> None:
    board = local_board(TARGET, TARGET.holes[1], PLACE_M, NORMAL, side_mm=70.0)
    (damage,) = board.damages
    assert damage.id == 4
    assert damage.centre_mm == (0.0, 0.0)
    assert board.dents == ()
    assert (board.board.width_mm, board.board.height_mm) == (70.0, 70.0)
    assert board.backing is not None
    assert board.backing.size_mm is None
    T_camera_board = board.pose.T_camera_board
    assert T_camera_board[:3, 3] == pytest.approx(PLACE_M)
    assert T_camera_board[:3, 2] == pytest.approx(NORMAL)
    bare = TARGET.model_copy(update={"backing": None})
    assert local_board(bare, TARGET.dents[0], PLACE_M, NORMAL, 70.0).backing is None


def test_a_small_board_has_room_for_damage_filter_and_rim() -> None:
    """12 mm of damage, and on both sides the filter's reach and 2 + 8 pixels of 0.6 m / f."""
    config, _ = unit_config(CAMERA, own_lens())
    camera = camera_of(config)
    lens = camera.nominal_lens
    rim_px = camera.optics.margin_px + 10
    expected_mm = 12.0 + 2 * rim_px * 600.0 / min(lens.fx, lens.fy)
    assert side_mm(TARGET.holes[0], 0.6, config) == pytest.approx(expected_mm)


def test_an_implant_moves_frames_and_loses_their_pixels() -> None:
    shift_m = np.array([[1e-3, -4e-3], [0.0, 2e-3]])
    noise_m = np.stack([np.zeros((2, 2)), np.full((2, 2), 1e-4)])
    lost = np.zeros((2, 2, 2), bool)
    lost[1, 0, 1] = True
    lost[1, 1, 0] = True
    implant = Implant(Region(1, 3, 2, 4), shift_m, noise_m, lost)
    assert implant.depth_mm == pytest.approx(4.0)
    recorded = np.full((4, 5), 0.5)
    recorded[2, 2] = np.nan
    frame = Frame("", recorded, np.zeros((4, 5), np.uint8))
    for number, draw in ((0, 0), (1, 1), (2, 0), (3, 1)):
        z_m = recorded.copy()
        reason = np.zeros((4, 5), np.uint8)
        implant.put_into(frame, number, z_m, reason)
        expected = recorded.copy()
        expected[1:3, 2:4] += shift_m + 1e-4 * draw
        if draw:
            expected[1, 3] = np.nan
        assert np.allclose(z_m, expected, equal_nan=True, rtol=0, atol=1e-15)
        # what was lost already keeps its own reason
        assert reason[1, 3] == (Reason.LOW_AMPLITUDE if draw else 0)
        assert reason[2, 2] == 0


def seen_plane(distance_m: float, albedo: float) -> NoiseFreeView:
    camera = camera_of(unit_config(CAMERA, own_lens())[0])
    u, v = np.round(camera.nominal_lens.project(PLACE_M)).astype(int).tolist()
    region = Region(v - 30, v + 30, u - 30, u + 30)
    return plane_view(camera, region, distance_m, albedo)


def noise_variance(
    config: CameraConfig,
    distance_m: float,
    albedo: float,
) -> float:
    """Return the mean variance of z over the view's inner pixels."""
    unit = SimulatedUnit(camera_of(config), config, seen_plane(distance_m, albedo))
    frames = [frame.z_m for frame in unit.capture(implants.LEAST_DRAWS, 9, "other").frames()]
    return float(np.var(frames, axis=0)[15:45, 15:45].mean())


@pytest.fixture
def planes(monkeypatch: pytest.MonkeyPatch) -> dict[bool, tuple[float, float]]:
    """Distance and albedo of the planes that are seen instead of boards with damage, and without:
    3 mm farther away with it, and darker, hence noisier."""
    declared = {True: (0.603, 0.2), False: (0.6, 0.6)}

    def view(target: custom.TargetConfig, *_: Any) -> tuple[Any, bool]:
        return seen_plane(*declared[bool(target.damages)]), False

    monkeypatch.setattr(implants, "cached_view", view)
    return declared


FACING = np.array([0.0, 0.0, -1.0])


def test_the_difference_between_two_views(planes: dict, tmp_path: Path) -> None:
    config, same = unit_config(CAMERA, own_lens())
    board = local_board(TARGET, TARGET.holes[0], PLACE_M, FACING, side_mm=100.0)
    implant = implant_of(
        config,
        same,
        own_lens(),
        board,
        10,
        3,
        tmp_path,
    )
    assert implant.noise_m.shape[0] == implants.LEAST_DRAWS
    changed = implant.shift_m != 0
    assert implant.shift_m[changed] == pytest.approx(3e-3, abs=2e-4)
    # about the damage, as far as the filter and two pixels reach: the rest stays
    lens = own_lens()
    v, u = np.nonzero(changed)
    pixels = np.column_stack([u + implant.region.col0, v + implant.region.row0])
    apart_px = np.linalg.norm(pixels - lens.project(PLACE_M), axis=1)
    reach_px = 6.0 * MM / 0.6 * lens.fx + camera_of(config).optics.margin_px + 2
    assert apart_px.max() == pytest.approx(reach_px, abs=1.0)
    # recorded and added noise are together that of the damaged board
    config, _ = unit_config(CAMERA, own_lens())
    added = implant.noise_m[:, changed].var(axis=0).mean()
    recorded = noise_variance(config, *planes[False])
    assert added + recorded == pytest.approx(noise_variance(config, *planes[True]), rel=0.05)
    assert added > recorded
    assert (implant.noise_m[:, ~changed] == 0).all()
    planes[True] = planes[False]
    none = implant_of(
        config,
        same,
        own_lens(),
        board,
        10,
        3,
        tmp_path,
    )
    assert np.abs(none.shift_m).max() == 0
    assert np.abs(none.noise_m).max() == 0
    planes[False] = (0.603, 0.2)
    quiet = implant_of(
        config,
        same,
        own_lens(),
        board,
        50,
        3,
        tmp_path,
    )
    assert quiet.noise_m.shape[0] == 50
    assert np.abs(quiet.noise_m).max() == 0  # noise is never removed
    assert quiet.shift_m[quiet.shift_m != 0] == pytest.approx(-3e-3, abs=2e-4)


def test_what_the_camera_loses_before_the_damage_is_lost(
    planes: dict,
    tmp_path: Path,
) -> None:
    config, same = unit_config(CAMERA, own_lens())
    board = local_board(TARGET, TARGET.holes[0], PLACE_M, FACING, side_mm=100.0)
    planes[True] = (0.6, 0.0)
    implant = implant_of(
        config,
        same,
        own_lens(),
        board,
        10,
        3,
        tmp_path,
    )
    assert 100 < implant.lost[0].sum() < implant.lost[0].size / 2
    planes[True] = (0.6, 0.6)
    planes[False] = (0.6, 0.0)
    assert not implant_of(
        config,
        same,
        own_lens(),
        board,
        10,
        3,
        tmp_path,
    ).lost.any()


def test_a_recording_of_other_pixels_gets_the_difference_between_them(
    planes: dict,
    tmp_path: Path,
) -> None:
    """Twice as many pixels along each side: the same difference, on the same part of the view."""
    lens = own_lens()
    larger = Lens(
        width=2 * lens.width,
        height=2 * lens.height,
        fx=2 * lens.fx,
        fy=2 * lens.fy,
        cx=2 * lens.cx + 0.5,
        cy=2 * lens.cy + 0.5,
        distortion=lens.distortion,
    )
    config, same = unit_config(CAMERA, larger)
    assert not same
    board = local_board(TARGET, TARGET.holes[0], PLACE_M, FACING, side_mm=100.0)
    fine = implant_of(
        config,
        same,
        larger,
        board,
        10,
        3,
        tmp_path,
    )
    coarse = implant_of(
        config,
        True,
        lens,
        board,
        10,
        3,
        tmp_path,
    )
    side_px = 100.0 * MM / 0.6 * larger.fx
    assert fine.region.shape == pytest.approx((side_px, side_px), abs=2)
    assert fine.shift_m.shape == fine.region.shape
    assert fine.noise_m.shape == (implants.LEAST_DRAWS, *fine.region.shape)
    assert fine.shift_m.sum() == pytest.approx(4 * coarse.shift_m.sum(), rel=0.05)
    row, col = (np.array(fine.region.shape) / 2).astype(int)
    assert fine.shift_m[row, col] == pytest.approx(3e-3, abs=2e-4)
