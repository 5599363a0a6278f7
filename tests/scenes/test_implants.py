"""Virtual damage for a real scan, by hand: small boards, and the difference between two views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region, transform_points
from scenes import implants
from scenes.closed_form import plane_view
from scenes.implants import Implant, PartFace, implant_of, tangent_board, unit_config
from scenes.optics import NoiseFreeView, RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom
from scenes.target.truth import outline_board_m

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


def implanted(
    config: CameraConfig,
    board: custom.TargetConfig,
    lens: Lens,
    *,
    same_camera: bool,
    frames: int,
    cache: Path,
) -> Implant:
    """Return what the board's damage does to a recording with this lens, for one draw of noise."""
    return implant_of(config, same_camera, lens, board, frames, 3, cache)


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


def part_face(normal: np.ndarray = NORMAL) -> PartFace:
    """A part 300 x 200 mm in size in a plane with this normal, through PLACE_M at (60, 5) mm: the
    camera's x axis lies in the plane's x and z."""
    along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    along /= np.linalg.norm(along)
    T_camera_part = np.eye(4)
    T_camera_part[:3, :3] = np.column_stack([along, np.cross(normal, along), normal])
    T_camera_part[:3, 3] = PLACE_M - T_camera_part[:3, :2] @ [60.0 * MM, 5.0 * MM]
    return PartFace(T_camera_part, np.array([-0.15, -0.1]), np.array([0.15, 0.1]))


def test_a_tangent_board_is_the_part_with_one_damage_where_it_lies() -> None:
    part = part_face()
    board = tangent_board(TARGET, TARGET.holes[1], part, PLACE_M, NORMAL)
    (damage,) = board.damages
    assert damage.id == 4
    assert damage.centre_mm == pytest.approx((60.0, 5.0))
    assert board.dents == ()
    assert (board.board.width_mm, board.board.height_mm) == pytest.approx((300.0, 200.0))
    assert board.backing is not None
    assert board.backing.size_mm is None
    assert board.pose.T_camera_board == pytest.approx(part.T_camera_part)
    bare = TARGET.model_copy(update={"backing": None})
    assert tangent_board(bare, TARGET.dents[0], part, PLACE_M, NORMAL).backing is None


def test_a_tangent_board_is_no_centred_square_and_may_turn_off_the_plane() -> None:
    """The part reaches from -100 to 150 and from -100 to 50 mm, and the surface is tilted further
    at the damage."""
    part = part_face()
    wider = PartFace(part.T_camera_part, np.array([-0.1, -0.1]), np.array([0.15, 0.05]))
    turned = np.array([0.3, -0.1, -1.0])
    turned /= np.linalg.norm(turned)
    board = tangent_board(TARGET, TARGET.holes[1], wider, PLACE_M, turned)
    (damage,) = board.damages
    assert (board.board.width_mm, board.board.height_mm) == pytest.approx((250.0, 150.0))
    assert damage.centre_mm == pytest.approx((60.0 - 25.0, 5.0 + 25.0))
    T_camera_board = board.pose.T_camera_board
    assert T_camera_board[:3, 2] == pytest.approx(turned)
    # the board's x axis is that of the part, turned into the tangent plane
    across = np.cross(turned, part.T_camera_part[:3, 0])
    assert T_camera_board[:3, 0] @ across == pytest.approx(0.0, abs=1e-9)
    assert T_camera_board[:3, 0] @ part.T_camera_part[:3, 0] > 0.9
    place_m = transform_points(T_camera_board, np.array([*damage.centre_m, 0.0]))
    assert place_m == pytest.approx(PLACE_M)


def test_a_tangent_board_ends_before_the_camera_and_beyond_the_damage() -> None:
    """At 60 degrees a plate of 4 m would reach behind the lens; a damage at the rim of the part as
    its plane has it stays inside the board."""
    steep = np.array([-np.sin(np.radians(60.0)), 0.0, -np.cos(np.radians(60.0))])
    part = part_face()
    large = PartFace(part.T_camera_part, np.array([-2.0, -0.1]), np.array([2.0, 0.1]))
    board = tangent_board(TARGET, TARGET.holes[1], large, PLACE_M, steep)
    corners = transform_points(board.pose.T_camera_board, outline_board_m(board.board))
    nearest_m = corners[:, 2].min()
    assert nearest_m == pytest.approx(implants.NEAREST_M)
    narrow = PartFace(part.T_camera_part, np.array([-0.1, -0.1]), np.array([0.061, 0.1]))
    board = tangent_board(TARGET, TARGET.holes[1], narrow, PLACE_M, NORMAL)
    (damage,) = board.damages
    room_mm = board.board.width_mm / 2 - damage.centre_mm[0]
    assert room_mm == pytest.approx(implants.LEAST_BOARD * 4.5)


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

    def view(target: custom.TargetConfig, *rest: Any) -> tuple[Any, bool]:
        camera = camera_of(unit_config(CAMERA, own_lens())[0])
        return plane_view(camera, rest[-1], *declared[bool(target.damages)]), False

    monkeypatch.setattr(implants, "cached_view", view)
    return declared


FACING = np.array([0.0, 0.0, -1.0])


def test_the_difference_between_two_views(
    planes: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a frame is displaced as a whole, so that the variance of 48 frames is known to a tenth
    monkeypatch.setattr(implants, "LEAST_DRAWS", 400)
    config, same = unit_config(CAMERA, own_lens())
    board = tangent_board(TARGET, TARGET.holes[0], part_face(FACING), PLACE_M, FACING)
    implant = implanted(config, board, own_lens(), same_camera=same, frames=10, cache=tmp_path)
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
    none = implanted(config, board, own_lens(), same_camera=same, frames=10, cache=tmp_path)
    assert np.abs(none.shift_m).max() == 0
    assert np.abs(none.noise_m).max() == 0
    planes[False] = (0.603, 0.2)
    quiet = implanted(config, board, own_lens(), same_camera=same, frames=50, cache=tmp_path)
    assert quiet.noise_m.shape[0] == 400
    assert np.abs(quiet.noise_m).max() == 0  # noise is never removed
    assert quiet.shift_m[quiet.shift_m != 0] == pytest.approx(-3e-3, abs=2e-4)


def test_what_the_camera_loses_before_the_damage_is_lost(
    planes: dict,
    tmp_path: Path,
) -> None:
    config, same = unit_config(CAMERA, own_lens())
    board = tangent_board(TARGET, TARGET.holes[0], part_face(FACING), PLACE_M, FACING)
    planes[True] = (0.6, 0.0)
    implant = implanted(config, board, own_lens(), same_camera=same, frames=10, cache=tmp_path)
    lens = own_lens()
    reach_px = 6.0 * MM / 0.6 * lens.fx + camera_of(config).optics.margin_px + 2
    assert implant.lost[0].sum() == pytest.approx(np.pi * reach_px**2, rel=0.05)
    planes[True] = (0.6, 0.6)
    planes[False] = (0.6, 0.0)
    assert not implanted(
        config, board, own_lens(), same_camera=same, frames=10, cache=tmp_path
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
    board = tangent_board(TARGET, TARGET.holes[0], part_face(FACING), PLACE_M, FACING)
    fine = implanted(config, board, larger, same_camera=same, frames=10, cache=tmp_path)
    coarse = implanted(config, board, lens, same_camera=True, frames=10, cache=tmp_path)
    margin_px = camera_of(config).optics.margin_px
    side_px = 12.0 * MM / 0.6 * larger.fx + 2 * 2 * (margin_px + 2)
    assert fine.region.shape == pytest.approx((side_px, side_px), abs=2)
    assert fine.shift_m.shape == fine.region.shape
    assert fine.noise_m.shape == (implants.LEAST_DRAWS, *fine.region.shape)
    assert fine.shift_m.sum() == pytest.approx(4 * coarse.shift_m.sum(), rel=0.05)
    row, col = (np.array(fine.region.shape) / 2).astype(int)
    assert fine.shift_m[row, col] == pytest.approx(3e-3, abs=2e-4)


def test_damage_beside_the_cameras_view_is_refused(tmp_path: Path) -> None:
    config, same = unit_config(CAMERA, own_lens())
    aside_m = np.array([1.0, 0.0, 0.6])
    board = tangent_board(TARGET, TARGET.holes[0], part_face(FACING), aside_m, FACING)
    with pytest.raises(UserError, match="out of the camera's view"):
        implanted(config, board, own_lens(), same_camera=same, frames=10, cache=tmp_path)


OFF_AXIS_MM = (0.0, 150.0)
"""Places of holes 0.25 m before a camera of a wide view: on the axis, and 31 degrees off it."""


@pytest.mark.parametrize("x_mm", OFF_AXIS_MM)
def test_an_implant_is_as_deep_as_the_hole_in_the_whole_plate(x_mm: float, tmp_path: Path) -> None:
    """Off the axis, a board of 60 mm shows it 1.2 to 1.6 times too deep: light that passes its
    edges reaches what lies behind the hole."""
    name = "azure_kinect_wfov_binned"
    lens = camera_of(CameraConfig(name=name)).nominal_lens
    config, same = unit_config(name, lens)
    camera = camera_of(config)
    hole = custom.HoleConfig(
        id=1,
        diameter_mm=5.0,
        centre_mm=(x_mm, 0.0),
    )
    plate = custom.TargetConfig(
        board=custom.BoardConfig(
            width_mm=500.0,
            height_mm=300.0,
            thickness_mm=12.7,
            shape=custom.FlatConfig(),
        ),
        holes=(hole,),
        backing=custom.BackingConfig(distance_mm=20.0),
        material=custom.MaterialConfig(grain_contrast=0.0),
        pose=custom.PoseConfig(distance_m=0.25),
    )
    quiet = config.effects.model_copy(update={"noise": False})
    z_m = []
    for target in (plate, plate.hole_free()):
        view, _ = cached_view(target, camera.optics, RenderConfig(), tmp_path)
        unit = SimulatedUnit(camera, config.model_copy(update={"effects": quiet}), view)
        z_m.append(next(unit.capture(1, 1).frames()).z_m.astype(float))
    T_camera_board = plate.pose.T_camera_board
    place_m = transform_points(T_camera_board, np.array([x_mm * MM, 0.0, 0.0]))
    half_m = np.array([0.25, 0.15])
    part = PartFace(T_camera_board, -half_m, half_m)
    board = tangent_board(plate, hole, part, place_m, FACING)
    implant = implanted(config, board, lens, same_camera=same, frames=1, cache=tmp_path)
    change_m = (z_m[0] - z_m[1])[implant.region.within(unit.region)]
    assert implant.depth_mm * MM == pytest.approx(np.nanmax(change_m), rel=0.03)
    assert implant.shift_m.sum() == pytest.approx(np.nansum(change_m), rel=0.03)
