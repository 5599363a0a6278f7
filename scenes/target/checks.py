"""Checks of a declaration as a whole: all parts that do not fit are found and named; nothing is
built."""

from itertools import combinations

import cv2
import numpy as np

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, transform_points
from scenes.target import custom
from scenes.target.flaws import ChipConfig, FlawConfig, RoundConfig, border, outside_m, turned
from scenes.target.part import part_of
from scenes.target.truth import (
    Face,
    backing_corners_board_m,
    face_grid_m,
    face_of,
    relief_points,
    widest_rim_m,
)

STEEPEST_SLOPE = (
    4 / 3
)  # dz/dx and dz/dy of a face, 53 degrees: a round face reaches 0.8 of its radius
THICKEST_BEND = 0.5  # thickness over the smallest radius of curvature; the back face folds up at 1
# a damage's radius over the radius of curvature there: the truth's volumes are good to its square
WIDEST_BEND = 0.25
SHALLOWEST_BEND = (
    0.5  # the radius of a dent's ball over the same: at 1 a face that bends away has no rim
)
# cosine between the face's normals at a flaw's centre, along which depth counts, and at its rim
MOST_TURN = 0.8
LEAST_WEB_MM = (
    # between two damages, or damage and edge: a circle's polygon sticks out by 2.5 um at 1 in
    0.01
)
NEAREST_M = 0.05  # least distance of the board from the lens plane
_TURN = np.linspace(0, 2 * np.pi, 64, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_TURN), np.sin(_TURN)])


def check_target(config: custom.TargetConfig) -> None:
    """Raise UserError that names every part that does not fit, with the numbers; return if all
    parts fit."""
    board = config.board
    problems = _board_problems(board)
    if not problems:
        face = face_of(board)
        found = {damage.id: _damage_problems(damage, board, face) for damage in config.damages}
        problems += [problem for each in found.values() for problem in each]
        problems += _overlap_problems(
            [damage for damage in config.damages if not found[damage.id]], board, face
        )
        problems += _tape_problems(config) + _pose_problems(config)
    if problems:
        what = "the target cannot be built:\n" + "\n".join(f"  - {problem}" for problem in problems)
        legal = "damage and tape lie on the board, apart from one another, and no deeper than it is thick"
        raise UserError(
            what, legal=legal, fix="change the numbers named above in the target's declaration"
        )


def _name(damage: custom.AnyDamage) -> str:
    kind, (x, y) = (
        "hole" if isinstance(damage, custom.HoleConfig) else damage.kind.replace("_", " "),
        damage.centre_mm,
    )
    return f"{kind} {damage.id} ({damage.size_of} {damage.size_mm:g} mm at ({x:g}, {y:g}) mm)"


def _size(board: custom.BoardConfig) -> str:
    return f"the board ({board.width_mm:g} x {board.height_mm:g} mm, centred on (0, 0))"


def _board_problems(board: custom.BoardConfig) -> list[str]:
    """Find a face too steep or too tightly bent for its size."""
    shape = board.shape
    half_x = board.width_mm / 2
    half_y = board.height_mm / 2
    if isinstance(shape, custom.MeshConfig):
        vertices = part_of(shape)[0]
        sizes = (vertices.max(axis=0) - vertices.min(axis=0)) / MM
        sizes_mm = "width_mm: {:.6g}, height_mm: {:.6g}, thickness_mm: {:.6g}".format(*sizes)
        off = (
            np.abs(sizes - (board.width_mm, board.height_mm, board.thickness_mm)).max()
            > LEAST_WEB_MM
        )
        return (
            [f"board: its sizes are not those of {shape.file}, which has {sizes_mm}"] if off else []
        )
    if isinstance(shape, custom.CylinderConfig | custom.SphereConfig):
        reach = float(np.hypot(half_x, half_y))
        if isinstance(shape, custom.CylinderConfig):
            reach = half_x if shape.straight_along == "y" else half_y
        if shape.radius_mm * 0.8 < reach:
            small = (
                f"a {shape.kind} of radius {shape.radius_mm:g} mm is too small for {_size(board)}"
            )
            needed = f"the radius must be {reach / 0.8:g} mm or more"
            return [f"board: {small}, which reaches {reach:g} mm from its middle: {needed}"]
    face = face_of(board)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, 65) * MM, np.linspace(-half_y, half_y, 65) * MM)
    steepest = float(np.abs(face.slope(x, y)).max())
    tightest = float(np.abs(face.curvatures(x, y)).max())
    # A sphere at 0.8 of its radius has this slope exactly, hence the allowance for rounding.
    if steepest > STEEPEST_SLOPE * (1 + 1e-9):
        return [
            f"board: its face is too steep: slope {steepest:.3g}, the limit is {STEEPEST_SLOPE:.3g}"
        ]
    if face.rough:  # its back is flat
        if board.thickness_mm * MM <= 2 * (depth_m := float(-face.height_m(x, y).min())):
            return [
                f"board: {board.thickness_mm:g} mm is too thin for a rough face of {depth_m / MM:.3g} mm depth"
            ]
    elif board.thickness_mm * MM * tightest > THICKEST_BEND:
        small = f"radius of curvature {1 / tightest / MM:.3g} mm is too small for a thickness of"
        least = f"{board.thickness_mm:g} mm; it must be {board.thickness_mm / THICKEST_BEND:g} mm or more"
        return [f"board: {small} {least}"]
    return []


def _damage_problems(damage: custom.AnyDamage, board: custom.BoardConfig, face: Face) -> list[str]:
    """Find damage that is too deep, off the board, or on a face too bent for it."""
    name, (x, y), depth_mm, problems = _name(damage), damage.centre_m, damage.depth_mm, []
    half_x = board.width_mm * MM / 2
    half_y = board.height_mm * MM / 2
    outward = np.zeros(2)
    if isinstance(damage, ChipConfig):
        outward = np.round([-np.sin(damage.turn_rad), np.cos(damage.turn_rad)])
        off_mm = float(np.abs(outward @ ((x, y) - outward * (half_x, half_y)))) / MM
        if off_mm > LEAST_WEB_MM:
            return [f"{name}: its centre is {off_mm:g} mm away from the edge that angle_deg names"]
    elif not (abs(x) < half_x and abs(y) < half_y):
        return [f"{name}: its centre is outside {_size(board)}"]
    tightest = float(np.abs(face.curvatures(x, y)).max())
    if isinstance(damage, FlawConfig):
        rim, _, axis, _ = relief_points(damage, face, board.thickness_mm * MM)
        rim = border(rim)
        if isinstance(board.shape, custom.MeshConfig):
            if isinstance(damage, ChipConfig) or (
                isinstance(damage, RoundConfig) and damage.pressed
            ):
                return [f"{name}: a part from a mesh has no declared edges and no sheet's back"]
            if np.isnan(face.normal(rim[:, 0], rim[:, 1])).any():
                return [f"{name}: leaves the part's front"]
        if not (face.normal(rim[:, 0], rim[:, 1]) @ axis).min() > MOST_TURN:
            return [
                f"{name}: too large for the face, which turns by more than 37 degrees within it"
            ]
    elif face.rough or isinstance(board.shape, custom.MeshConfig):
        return [
            f"{name}: holes and dents need a smooth face; here use target.flaws (a slot, corrosion ...)"
        ]
    elif damage.radius_m * tightest > WIDEST_BEND:
        return [f"{name}: too wide for a face bent to a radius of {1 / tightest / MM:.3g} mm there"]
    if isinstance(damage, custom.DentConfig) and damage.ball_m * tightest > SHALLOWEST_BEND:
        ball = f"{damage.depth_mm:g} mm, a ball of radius {damage.ball_m / MM:.3g} mm"
        return [
            f"{name}: too shallow ({ball}) for a face bent to a radius of {1 / tightest / MM:.3g} mm there"
        ]
    if (
        depth_mm is not None
        and depth_mm >= board.thickness_mm
        and not isinstance(damage, RoundConfig)
    ):
        thick = f"the board's thickness {board.thickness_mm:g} mm"
        problems.append(f"{name}: depth {depth_mm:g} mm is not less than {thick}")
    deep_mm = board.thickness_mm if depth_mm is None else depth_mm
    if isinstance(damage, custom.HoleConfig) and damage.chamfer_mm >= deep_mm:
        problems.append(
            f"{name}: a chamfer of {damage.chamfer_mm:g} mm must be less than the depth, {deep_mm:g} mm"
        )
    if isinstance(damage, custom.DentConfig) and damage.depth_mm > damage.diameter_mm / 2:
        radius = f"its radius {damage.diameter_mm / 2:g} mm"
        problems.append(
            f"{name}: depth {depth_mm:g} mm is more than {radius}, the limit of a spherical cap"
        )
    # compare the rim of the damage, at the face and at its bottom, with the board's edge in plan;
    # the side walls follow the edge's normals, so that below the face the limits move by the depth
    # times the normal
    # there
    centre = face.point(x, y)
    axis = face.normal(x, y)
    if not isinstance(damage, FlawConfig):
        across = np.cross(axis, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        circle = _CIRCLE[:, :1] * across + _CIRCLE[:, 1:] * np.cross(axis, across)
        rim = centre + widest_rim_m(damage, face) * circle
    over = []
    for along, side in ((0, 1), (0, -1), (1, 1), (1, -1)):
        if outward[along] == side:
            continue
        edge = (side * half_x, y) if along == 0 else (x, side * half_y)
        for depth_m in (0.0, _reach_m(damage, board)):
            limit = (face.point(*edge) - depth_m * face.normal(*edge))[along]
            over.append(float((side * ((rim - depth_m * axis)[:, along] - limit)).max()) / MM)
    if max(over) > -LEAST_WEB_MM:
        problems.append(
            f"{name}: leaves {_size(board)} by {max(round(max(over), 3), 0.0) + 0.0:g} mm"
        )
    return problems


def _reach_m(damage: custom.AnyDamage, board: custom.BoardConfig) -> float:
    """Return the depth to which a damage keeps its full width: holes and slots alone do not narrow
    from the face on."""
    upright = damage.kind in ("through", "blind", "slot")
    return (
        (board.thickness_mm if damage.depth_mm is None else damage.depth_mm) * MM
        if upright
        else 0.0
    )


def _overlap_problems(
    damages: list[custom.AnyDamage], board: custom.BoardConfig, face: Face
) -> list[str]:
    """Find pairs without a web between them: at the face or at the depth that both reach; other
    outlines in plan."""
    x, y = np.array([damage.centre_m for damage in damages]).reshape(-1, 2).T
    centres = face.point(x, y)
    axes = face.normal(x, y)
    rims_m = np.array([widest_rim_m(damage, face) for damage in damages])
    reach_m = np.array([_reach_m(damage, board) for damage in damages])
    first, second = np.triu_indices(len(damages), k=1)
    shared_m = np.minimum(reach_m[first], reach_m[second])[:, None]
    at_face = centres[first] - centres[second]
    turn = axes[first] - axes[second]
    apart_m = np.minimum(
        np.linalg.norm(at_face, axis=-1), np.linalg.norm(at_face - shared_m * turn, axis=-1)
    )
    web_m = apart_m - rims_m[first] - rims_m[second]
    for i in np.flatnonzero(web_m < LEAST_WEB_MM * MM):
        pair = damages[first[i]], damages[second[i]]
        if any(isinstance(damage, FlawConfig) for damage in pair):
            a, b = (_outline_m(damage, face) for damage in pair)
            web_m[i] = min(outside_m(a, b).min(), outside_m(b, a).min())
    return [
        f"{_name(damages[first[i]])} and {_name(damages[second[i]])} meet: centres {apart_m[i] / MM:.6g} mm apart, "
        f"web {round(web_m[i] / MM, 3) + 0.0:g} mm"
        for i in np.flatnonzero(web_m < LEAST_WEB_MM * MM)
    ]


def _outline_m(damage: custom.AnyDamage, face: Face) -> np.ndarray:
    """Return the outline (n, 2) of a damage in plan."""
    if isinstance(damage, FlawConfig):
        return border(relief_points(damage, face, 0.0)[0])[:, :2]
    return damage.centre_m + widest_rim_m(damage, face) * _CIRCLE


def off_tape_mm(tape: custom.TapeConfig, places_mm: np.ndarray) -> np.ndarray:
    """Return the distance in plan of places (n, 2) from a strip, mm; 0 on it."""
    beyond = (
        np.abs((places_mm - tape.centre_mm) @ turned(np.deg2rad(tape.angle_deg)))
        - np.array(tape.size_mm) / 2
    )
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=-1))


def _tape_problems(config: custom.TargetConfig) -> list[str]:
    """Find strips off the board, over a damage, or over one another (their upper sides would
    coincide); in plan."""
    problems = []
    for number, tape in enumerate(config.tapes, start=1):
        (width, height), (x, y) = tape.size_mm, tape.centre_mm
        name = f"tape {number} ({width:g} x {height:g} mm at ({x:g}, {y:g}) mm)"
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (np.array(tape.size_mm) / 2)
        corners = corners @ turned(np.deg2rad(tape.angle_deg)).T + (x, y)
        over = float(
            (np.abs(corners) - np.array([config.board.width_mm, config.board.height_mm]) / 2).max()
        )
        if over > 0:
            problems.append(f"{name}: leaves {_size(config.board)} by {over:.3g} mm")
        for damage in config.damages:
            gap = float(off_tape_mm(tape, np.array(damage.centre_mm))) - damage.reach_mm
            if gap <= 0:
                problems.append(f"{name}: lies over {_name(damage)} by {-gap:.3g} mm")
    for (first, tape_1), (second, tape_2) in combinations(enumerate(config.tapes, start=1), 2):
        box_1 = (tape_1.centre_mm, tape_1.size_mm, tape_1.angle_deg)
        box_2 = (tape_2.centre_mm, tape_2.size_mm, tape_2.angle_deg)
        _, shared = cv2.rotatedRectangleIntersection(box_1, box_2)
        shared_mm2 = 0.0 if shared is None else cv2.contourArea(cv2.convexHull(shared))
        if shared_mm2 > 1e-3:
            problems.append(
                f"tape {first} and tape {second} lie on each other over {shared_mm2:.3g} mm2"
            )
    return problems


def _pose_problems(config: custom.TargetConfig) -> list[str]:
    """Find a board that reaches behind the lens, through the floor or, with its backing, into the
    wall."""
    T_camera_board = config.pose.T_camera_board
    room = config.room
    problems = []
    solid = [
        face_grid_m(config.board, depth_m).reshape(-1, 3)
        for depth_m in (0.0, config.board.thickness_mm * MM)
    ]
    points = transform_points(T_camera_board, np.concatenate(solid))
    nearest_m = points[:, 2].min()
    lowest_m = points[:, 1].max()
    farthest_m = points[:, 2].max()
    if config.backing is not None:
        backing = transform_points(T_camera_board, backing_corners_board_m(config, config.backing))
        farthest_m = max(farthest_m, backing[:, 2].max())
    if nearest_m < NEAREST_M:
        what = f"the board's nearest point is {nearest_m:.3g} m in front of the lens; the limit is {NEAREST_M} m"
        problems.append(f"pose: {what}")
    floor_m, wall_m = (room.floor_below_lens_m, room.back_wall_distance_m) if room else (None, None)
    if floor_m is not None and lowest_m >= floor_m:
        problems.append(
            f"room: the board reaches {lowest_m:.3g} m below the lens, through the floor at {floor_m:g} m"
        )
    if wall_m is not None and farthest_m >= wall_m:
        problems.append(
            f"room: board and backing reach {farthest_m:.3g} m, beyond the back wall at {wall_m:g} m"
        )
    return problems
