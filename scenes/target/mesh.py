"""From a declaration to what a renderer needs: parts with meshes and reflectances, and the truth beside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from harness.vocabulary.units import MM
from scenes.target.checks import check_target
from scenes.target.custom import TapeConfig, TargetConfig
from scenes.target.face import Face, face_of, outline_board_m
from scenes.target.pose import T_camera_board_of
from scenes.target.solid import cutter, sheet, subtract
from scenes.target.surroundings import backing_corners_board_m, floor_corners_camera_m, wall_corners_camera_m
from scenes.target.texture import grain, look_up, reflectance
from scenes.target.truth import Damage, truth_of

if TYPE_CHECKING:
    import trimesh

COARSEST_SAGITTA_M, FINEST_SAGITTA_M = 2e-6, 0.1e-6
"""How far facets may be off a bent face: well under a camera's noise, and finer below shallow dents (depth / 400)."""
TAPE_SINK_M = 0.1e-3
"""How deep a strip's underside lies in the board, so that no two surfaces coincide."""


@dataclass(frozen=True)
class Part:
    """One surface. ``mesh``: camera frame, metres, normals outwards; sharp edges share vertices, so use face normals.

    ``uv`` (n_vertices, 2) in 0..1 places the textures (convention: `scenes.target.texture`); None where the part is
    plain. ``albedo_850`` and ``rgb`` (3,) are the means of ``texture_850`` (h, w) and ``texture_rgb`` (h, w, 3),
    float32 linear reflectances, None where plain.
    """

    name: str
    mesh: trimesh.Trimesh
    uv: np.ndarray | None
    albedo_850: float
    texture_850: np.ndarray | None
    rgb: np.ndarray
    texture_rgb: np.ndarray | None

    def albedo_850_at(self, uv: np.ndarray) -> np.ndarray:
        """Albedo (...) at ``uv`` (..., 2); the mean where the part is plain."""
        if self.texture_850 is None:
            return np.full(uv.shape[:-1], self.albedo_850, dtype=np.float32)
        return look_up(self.texture_850, uv)

    def rgb_at(self, uv: np.ndarray) -> np.ndarray:
        """Red, green and blue albedo (..., 3) at ``uv`` (..., 2); the mean where the part is plain."""
        if self.texture_rgb is None:
            return np.broadcast_to(self.rgb.astype(np.float32), (*uv.shape[:-1], 3))
        return look_up(self.texture_rgb, uv)


@dataclass(frozen=True)
class Target:
    """A built target.

    ``parts``: "board", then "tape_1".., "backing", "floor", "back_wall" as declared. ``truth``: holes, then dents.
    ``outline_board_m`` (n, 3): the rim of the face, counter-clockwise seen from the camera. ``T_camera_board`` (4, 4).
    """

    config: TargetConfig
    parts: tuple[Part, ...]
    truth: tuple[Damage, ...]
    T_camera_board: np.ndarray
    outline_board_m: np.ndarray

    def face_height_m(self, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """z of the undamaged face over plan positions in the board's frame; NaN beyond the reach of a round shape."""
        return face_of(self.config.board).height_m(x_m, y_m)


def build_target(config: TargetConfig) -> Target:
    """Build a declaration. Raises UserError that names every part that does not fit (`scenes.target.checks`)."""
    check_target(config)
    T_camera_board = T_camera_board_of(config.pose)
    truth = truth_of(config, T_camera_board)
    return Target(
        config=config,
        parts=(
            _board(config, truth, T_camera_board),
            *_tapes(config, T_camera_board),
            *_surroundings(config, T_camera_board),
        ),
        truth=truth,
        T_camera_board=T_camera_board,
        outline_board_m=outline_board_m(config.board),
    )


def board_solid(config: TargetConfig, truth: tuple[Damage, ...]) -> trimesh.Trimesh:
    """The board less its damage, watertight, board frame."""
    size_m, thickness_m = _size_m(config), config.board.thickness_mm * MM
    body = sheet(face_of(config.board), size_m, top_m=0.0, bottom_m=-thickness_m, sagitta_m=_sagitta_m(config))
    return subtract(
        body, [cutter(damage, item.diameter_mm / 2 * MM) for damage, item in zip(truth, config.damages, strict=True)]
    )


def _board(config: TargetConfig, truth: tuple[Damage, ...], T_camera_board: np.ndarray) -> Part:
    mesh, material = board_solid(config, truth), config.material
    plan = mesh.vertices[:, :2] / _size_m(config)
    uv = np.clip(np.column_stack([0.5 + plan[:, 0], 0.5 - plan[:, 1]]), 0.0, 1.0)
    plain = Part(
        "board", mesh.apply_transform(T_camera_board), None, material.albedo_850, None, np.array(material.rgb), None
    )
    if material.grain_contrast == 0:
        return plain
    pattern = grain(material, config.board.width_mm, config.board.height_mm)
    channels = [reflectance(pattern, mean, material.grain_contrast) for mean in material.rgb]
    return Part(
        name=plain.name,
        mesh=plain.mesh,
        uv=uv,
        albedo_850=plain.albedo_850,
        texture_850=reflectance(pattern, material.albedo_850, material.grain_contrast),
        rgb=plain.rgb,
        texture_rgb=np.stack(channels, axis=-1),
    )


def _tapes(config: TargetConfig, T_camera_board: np.ndarray) -> list[Part]:
    face, sagitta_m = face_of(config.board), _sagitta_m(config)
    return [_tape(number, tape, face, sagitta_m, T_camera_board) for number, tape in enumerate(config.tapes, start=1)]


def _tape(number: int, tape: TapeConfig, face: Face, sagitta_m: float, T_camera_board: np.ndarray) -> Part:
    strip = sheet(
        face,
        (tape.size_mm[0] * MM, tape.size_mm[1] * MM),
        top_m=tape.thickness_mm * MM,
        bottom_m=-TAPE_SINK_M,
        sagitta_m=sagitta_m,
        centre_m=(tape.centre_mm[0] * MM, tape.centre_mm[1] * MM),
        angle_rad=float(np.deg2rad(tape.angle_deg)),
    )
    return Part(
        f"tape_{number}", strip.apply_transform(T_camera_board), None, tape.albedo_850, None, np.array(tape.rgb), None
    )


def _surroundings(config: TargetConfig, T_camera_board: np.ndarray) -> list[Part]:
    parts, backing, room = [], config.backing, config.room
    if backing is not None:
        plane = _rectangle(backing_corners_board_m(config, backing)).apply_transform(T_camera_board)
        parts.append(Part("backing", plane, None, backing.albedo_850, None, np.array(backing.rgb), None))
    if room is not None and room.floor_below_lens_m is not None:
        plane = _rectangle(floor_corners_camera_m(room, room.floor_below_lens_m))
        parts.append(Part("floor", plane, None, room.floor_albedo_850, None, np.array(room.floor_rgb), None))
    if room is not None and room.back_wall_distance_m is not None:
        plane = _rectangle(wall_corners_camera_m(room, room.back_wall_distance_m))
        parts.append(
            Part("back_wall", plane, None, room.back_wall_albedo_850, None, np.array(room.back_wall_rgb), None)
        )
    return parts


def _rectangle(corners: np.ndarray) -> trimesh.Trimesh:
    import trimesh

    return trimesh.Trimesh(vertices=corners, faces=[(0, 1, 2), (0, 2, 3)], process=False)


def _size_m(config: TargetConfig) -> tuple[float, float]:
    return config.board.width_mm * MM, config.board.height_mm * MM


def _sagitta_m(config: TargetConfig) -> float:
    depths_m = [dent.depth_mm * MM for dent in config.dents]
    return float(np.clip(min(depths_m, default=np.inf) / 400, FINEST_SAGITTA_M, COARSEST_SAGITTA_M))
