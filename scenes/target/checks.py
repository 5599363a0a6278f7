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

# dz/dx and dz/dy of a face, 53 degrees: a round face reaches 0.8 of its radius
STEEPEST_SLOPE = 4 / 3
THICKEST_BEND = 0.5  # thickness over the smallest radius of curvature; the back face folds up at 1
# a damage's radius over the radius of curvature there: the truth's volumes are good to its square
WIDEST_BEND = 0.25
# the radius of a dent's ball over the same: at 1 a face that bends away has no rim
SHALLOWEST_BEND = 0.5
# cosine between the face's normals at a flaw's centre, along which depth counts, and at its rim
MOST_TURN = 0.8
# between two damages, or damage and edge: a circle's polygon sticks out by 2.5 um at 1 in
LEAST_WEB_MM = 0.01
NEAREST_M = 0.05  # least distance of the board from the lens plane
SIGNS = np.array(
    [
        (-1, -1),
        (1, -1),
        (1, 1),
        (-1, 1),
    ]
)
_TURN = np.linspace(0, 2 * np.pi, 64, endpoint=False)
_CIRCLE = np.column_stack([np.cos(_TURN), np.sin(_TURN)])


def check_target(config: custom.TargetConfig) -> None:
    """Raise UserError that names every part that does not fit, with the numbers; return if all
    parts fit."""
    board = config.board
    problems = _board_problems(board)
    if not problems:
        face = face_of(board)
        fitting = []
        for damage in config.damages:
            damage_problems = _damage_problems(damage, board, face)
            problems += damage_problems
            if not damage_problems:
                fitting.append(damage)
        problems += _overlap_problems(fitting, board, face)
        problems += _tape_problems(config)
        problems += _pose_problems(config)
    if problems:
        listed = "\n".join(f"  - {problem}" for problem in problems)
        raise UserError(
            f"the target cannot be built:\n{listed}",
            legal="damage and tape lie on the board, apart from one another, "
            "and no deeper than it is thick",
            fix="change the numbers named above in the target's declaration",
        )


def _name(damage: custom.AnyDamage) -> str:
    kind = damage.kind.replace("_", " ")
    if isinstance(damage, custom.HoleConfig):
        kind = "hole"
    x_mm, y_mm = damage.centre_mm
    return f"{kind} {damage.id} ({damage.size_of} {damage.size_mm:g} mm at ({x_mm:g}, {y_mm:g}) mm)"


def _size(board: custom.BoardConfig) -> str:
    return f"the board ({board.width_mm:g} x {board.height_mm:g} mm, centred on (0, 0))"


def _board_problems(board: custom.BoardConfig) -> list[str]:
    """Find a face too steep or too tightly bent for its size."""
    shape = board.shape
    half_x_mm = board.width_mm / 2
    half_y_mm = board.height_mm / 2
    if isinstance(shape, custom.MeshConfig):
        return _mesh_problems(board, shape)
    if isinstance(shape, custom.CylinderConfig | custom.SphereConfig):
        reach_mm = float(np.hypot(half_x_mm, half_y_mm))
        if isinstance(shape, custom.CylinderConfig):
            reach_mm = half_x_mm if shape.straight_along == "y" else half_y_mm
        if shape.radius_mm * 0.8 < reach_mm:
            return [
                f"board: a {shape.kind} of radius {shape.radius_mm:g} mm is too small for "
                f"{_size(board)}, which reaches {reach_mm:g} mm from its middle: "
                f"the radius must be {reach_mm / 0.8:g} mm or more"
            ]
    face = face_of(board)
    x, y = np.meshgrid(
        np.linspace(-half_x_mm, half_x_mm, 65) * MM, np.linspace(-half_y_mm, half_y_mm, 65) * MM
    )
    steepest = float(np.abs(face.slope(x, y)).max())
    tightest = float(np.abs(face.curvatures(x, y)).max())
    # A sphere at 0.8 of its radius has this slope exactly, hence the allowance for rounding.
    if steepest > STEEPEST_SLOPE * (1 + 1e-9):
        return [
            (
                f"board: its face is too steep: slope {steepest:.3g}, the limit is "
                f"{STEEPEST_SLOPE:.3g}"
            )
        ]
    if face.rough:  # its back is flat
        relief_m = float(-face.height_m(x, y).min())
        if board.thickness_mm * MM <= 2 * relief_m:
            return [
                f"board: {board.thickness_mm:g} mm is too thin for a rough face of "
                f"{relief_m / MM:.3g} mm depth"
            ]
    elif board.thickness_mm * MM * tightest > THICKEST_BEND:
        return [
            f"board: radius of curvature {1 / tightest / MM:.3g} mm is too small for a thickness "
            f"of {board.thickness_mm:g} mm; it must be {board.thickness_mm / THICKEST_BEND:g} mm "
            "or more"
        ]
    return []


def _mesh_problems(
    board: custom.BoardConfig,
    shape: custom.MeshConfig,
) -> list[str]:
    """Find sizes that are not those of the part's file."""
    vertices = part_of(shape)[0]
    sizes_mm = (vertices.max(axis=0) - vertices.min(axis=0)) / MM
    off_mm = np.abs(sizes_mm - (board.width_mm, board.height_mm, board.thickness_mm)).max()
    if off_mm <= LEAST_WEB_MM:
        return []
    stated = "width_mm: {:.6g}, height_mm: {:.6g}, thickness_mm: {:.6g}".format(*sizes_mm)
    return [f"board: its sizes are not those of {shape.file}, which has {stated}"]


def _damage_problems(
    damage: custom.AnyDamage,
    board: custom.BoardConfig,
    face: Face,
) -> list[str]:
    """Find damage that is too deep, off the board, or on a face too bent for it."""
    problem = _centre_problem(damage, board) or _face_problem(damage, board, face)
    if problem is not None:
        return [f"{_name(damage)}: {problem}"]
    problems = _depth_problems(damage, board)
    over_mm = _over_edge_mm(damage, board, face)
    if over_mm > -LEAST_WEB_MM:
        shown_mm = max(round(over_mm, 3), 0.0) + 0.0
        problems.append(f"leaves {_size(board)} by {shown_mm:g} mm")
    return [f"{_name(damage)}: {problem}" for problem in problems]


def _centre_problem(
    damage: custom.AnyDamage,
    board: custom.BoardConfig,
) -> str | None:
    """Find a centre beside the board or, of a chip, off its edge."""
    x, y = damage.centre_m
    half_x = board.width_mm * MM / 2
    half_y = board.height_mm * MM / 2
    if isinstance(damage, ChipConfig):
        outward = _outward(damage)
        off_mm = float(np.abs(outward @ ((x, y) - outward * (half_x, half_y)))) / MM
        if off_mm > LEAST_WEB_MM:
            return f"its centre is {off_mm:g} mm away from the edge that angle_deg names"
    elif not (abs(x) < half_x and abs(y) < half_y):
        return f"its centre is outside {_size(board)}"
    return None


def _outward(damage: custom.AnyDamage) -> np.ndarray:
    """Return the direction (2,) out of the board at a chip's edge; 0 for other damage."""
    if not isinstance(damage, ChipConfig):
        return np.zeros(2)
    return np.round([-np.sin(damage.turn_rad), np.cos(damage.turn_rad)])


def _face_problem(
    damage: custom.AnyDamage,
    board: custom.BoardConfig,
    face: Face,
) -> str | None:
    """Find a face that is too bent for the damage, or of the wrong kind."""
    tightest = float(np.abs(face.curvatures(*damage.centre_m)).max())
    on_mesh = isinstance(board.shape, custom.MeshConfig)
    if isinstance(damage, FlawConfig):
        points, _, axis, _ = relief_points(damage, face, board.thickness_mm * MM)
        rim = border(points)
        normals = face.normal(rim[:, 0], rim[:, 1])
        needs_board = isinstance(damage, ChipConfig) or (
            isinstance(damage, RoundConfig) and damage.pressed
        )
        if on_mesh and needs_board:
            return "a part from a mesh has no declared edges and no sheet's back"
        if on_mesh and np.isnan(normals).any():
            return "leaves the part's front"
        if not (normals @ axis).min() > MOST_TURN:
            return "too large for the face, which turns by more than 37 degrees within it"
        return None
    if face.rough or on_mesh:
        return "holes and dents need a smooth face; here use target.flaws (a slot, corrosion ...)"
    if damage.radius_m * tightest > WIDEST_BEND:
        return f"too wide for a face bent to a radius of {1 / tightest / MM:.3g} mm there"
    if isinstance(damage, custom.DentConfig) and damage.ball_m * tightest > SHALLOWEST_BEND:
        return (
            f"too shallow ({damage.depth_mm:g} mm, a ball of radius {damage.ball_m / MM:.3g} mm) "
            f"for a face bent to a radius of {1 / tightest / MM:.3g} mm there"
        )
    return None


def _depth_problems(
    damage: custom.AnyDamage,
    board: custom.BoardConfig,
) -> list[str]:
    """Find damage that is too deep for the board or for its own width."""
    problems = []
    depth_mm = board.thickness_mm
    if damage.depth_mm is not None:
        depth_mm = damage.depth_mm
        if depth_mm >= board.thickness_mm and not isinstance(damage, RoundConfig):
            problems.append(
                f"depth {depth_mm:g} mm is not less than the board's thickness "
                f"{board.thickness_mm:g} mm"
            )
    if isinstance(damage, custom.HoleConfig) and damage.chamfer_mm >= depth_mm:
        problems.append(
            f"a chamfer of {damage.chamfer_mm:g} mm must be less than the depth, {depth_mm:g} mm"
        )
    if isinstance(damage, custom.DentConfig) and damage.depth_mm > damage.diameter_mm / 2:
        problems.append(
            f"depth {depth_mm:g} mm is more than its radius {damage.diameter_mm / 2:g} mm, "
            "the limit of a spherical cap"
        )
    return problems


def _over_edge_mm(
    damage: custom.AnyDamage,
    board: custom.BoardConfig,
    face: Face,
) -> float:
    """Return how far a damage reaches beyond the board's edge in plan, at the face or at its
    bottom.

    The side walls follow the edge's normals, so that below the face the limits move by the depth
    times the normal there."""
    x, y = damage.centre_m
    axis = face.normal(x, y)
    if isinstance(damage, FlawConfig):
        points, _, _, _ = relief_points(damage, face, board.thickness_mm * MM)
        rim = border(points)
    else:
        across = np.cross(axis, [0.0, 1.0, 0.0])
        across /= np.linalg.norm(across)
        circle = _CIRCLE[:, :1] * across + _CIRCLE[:, 1:] * np.cross(axis, across)
        rim = face.point(x, y) + widest_rim_m(damage, face) * circle
    half_x = board.width_mm * MM / 2
    half_y = board.height_mm * MM / 2
    open_side = _outward(damage)
    over_mm = []
    for along, side in ((0, 1), (0, -1), (1, 1), (1, -1)):
        if open_side[along] == side:
            continue
        edge = (side * half_x, y) if along == 0 else (x, side * half_y)
        for depth_m in (0.0, _reach_m(damage, board)):
            limit = (face.point(*edge) - depth_m * face.normal(*edge))[along]
            beyond = side * ((rim - depth_m * axis)[:, along] - limit)
            over_mm.append(float(beyond.max()) / MM)
    return max(over_mm)


def _reach_m(damage: custom.AnyDamage, board: custom.BoardConfig) -> float:
    """Return the depth to which a damage keeps its full width: holes and slots alone do not narrow
    from the face on."""
    if damage.kind not in ("through", "blind", "slot"):
        return 0.0
    return (board.thickness_mm if damage.depth_mm is None else damage.depth_mm) * MM


def _overlap_problems(
    damages: list[custom.AnyDamage],
    board: custom.BoardConfig,
    face: Face,
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
    apart_at_face_m = np.linalg.norm(at_face, axis=-1)
    apart_below_m = np.linalg.norm(at_face - shared_m * turn, axis=-1)
    apart_m = np.minimum(apart_at_face_m, apart_below_m)
    web_m = apart_m - rims_m[first] - rims_m[second]
    problems = []
    for pair in np.flatnonzero(web_m < LEAST_WEB_MM * MM):
        damage = damages[first[pair]]
        neighbour = damages[second[pair]]
        pair_web_m = web_m[pair]
        if isinstance(damage, FlawConfig) or isinstance(neighbour, FlawConfig):
            a = _outline_m(damage, face)
            b = _outline_m(neighbour, face)
            pair_web_m = min(outside_m(a, b).min(), outside_m(b, a).min())
        if pair_web_m < LEAST_WEB_MM * MM:
            problems.append(
                f"{_name(damage)} and {_name(neighbour)} meet: "
                f"centres {apart_m[pair] / MM:.6g} mm apart, "
                f"web {round(pair_web_m / MM, 3) + 0.0:g} mm"
            )
    return problems


def _outline_m(damage: custom.AnyDamage, face: Face) -> np.ndarray:
    """Return the outline (n, 2) of a damage in plan."""
    if isinstance(damage, FlawConfig):
        return border(relief_points(damage, face, 0.0)[0])[:, :2]
    return damage.centre_m + widest_rim_m(damage, face) * _CIRCLE


def off_tape_mm(tape: custom.TapeConfig, places_mm: np.ndarray) -> np.ndarray:
    """Return the distance in plan of places (n, 2) from a strip, mm; 0 on it."""
    along_tape = (places_mm - tape.centre_mm) @ turned(np.deg2rad(tape.angle_deg))
    beyond = np.abs(along_tape) - np.array(tape.size_mm) / 2
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0.0), axis=-1))


def _tape_problems(config: custom.TargetConfig) -> list[str]:
    """Find strips off the board, over a damage, or over one another (their upper sides would
    coincide); in plan."""
    board_mm = np.array([config.board.width_mm, config.board.height_mm])
    problems = []
    for number, tape in enumerate(config.tapes, start=1):
        width_mm, height_mm = tape.size_mm
        x_mm, y_mm = tape.centre_mm
        name = f"tape {number} ({width_mm:g} x {height_mm:g} mm at ({x_mm:g}, {y_mm:g}) mm)"
        turn = turned(np.deg2rad(tape.angle_deg))
        corners = SIGNS * (np.array(tape.size_mm) / 2) @ turn.T + tape.centre_mm
        over_mm = float((np.abs(corners) - board_mm / 2).max())
        if over_mm > 0:
            problems.append(f"{name}: leaves {_size(config.board)} by {over_mm:.3g} mm")
        for damage in config.damages:
            gap_mm = float(off_tape_mm(tape, np.array(damage.centre_mm))) - damage.reach_mm
            if gap_mm <= 0:
                problems.append(f"{name}: lies over {_name(damage)} by {-gap_mm:.3g} mm")
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
    front = face_grid_m(config.board).reshape(-1, 3)
    back = face_grid_m(config.board, config.board.thickness_mm * MM).reshape(-1, 3)
    points = transform_points(T_camera_board, np.concatenate([front, back]))
    nearest_m = points[:, 2].min()
    lowest_m = points[:, 1].max()
    farthest_m = points[:, 2].max()
    if config.backing is not None:
        backing = transform_points(T_camera_board, backing_corners_board_m(config, config.backing))
        farthest_m = max(farthest_m, backing[:, 2].max())
    if nearest_m < NEAREST_M:
        problems.append(
            f"pose: the board's nearest point is {nearest_m:.3g} m in front of the lens; "
            f"the limit is {NEAREST_M} m"
        )
    if room is None:
        return problems
    floor_m = room.floor_below_lens_m
    wall_m = room.back_wall_distance_m
    if floor_m is not None and lowest_m >= floor_m:
        problems.append(
            f"room: the board reaches {lowest_m:.3g} m below the lens, "
            f"through the floor at {floor_m:g} m"
        )
    if wall_m is not None and farthest_m >= wall_m:
        problems.append(
            f"room: board and backing reach {farthest_m:.3g} m, "
            f"beyond the back wall at {wall_m:g} m"
        )
    return problems
