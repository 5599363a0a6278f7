"""Several views of one target: its pose in each, the error of the nominal poses, and whether a
camera sees it. The room moves with the camera, as if the target were turned on a table."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Region, invert, transform_points
from harness.vocabulary.seeds import random_stream
from scenes.optics import Optics
from scenes.target.checks import NEAREST_M
from scenes.target.custom import PoseConfig, TargetConfig
from scenes.target.truth import OUTLINE_STEPS, face_grid_m, face_of

# points along each side of a face at which its range is checked; studies check it in 64 poses
CHECKED_STEPS = 16


def check_in_view(config: TargetConfig, optics: Optics) -> None:
    """Raise UserError if all of the face or all damage is out of the camera's field of view, or
    all of the face out of its range. A face may be partly out of view or range; damage out of view
    is not a target."""
    face = _face_before_lens(config, CHECKED_STEPS)
    x_m, y_m = np.array([damage.centre_m for damage in config.damages]).reshape(-1, 2).T
    centres = transform_points(config.pose.T_camera_board, face_of(config.board).point(x_m, y_m))
    # if damage is in view, so is a part of the face
    if not len(centres) or not optics.lens.images(centres).any():
        seen_region(config, optics)
        if len(centres):
            raise UserError(
                f"none of the target's {len(centres)} damages is in view of {optics.title}",
                legal="at least one damage in view; damage out of view is not counted as a target",
                fix="change target.pose, or move the damage",
            )
    range_m = face[..., 2] if optics.limits_along == "axis" else np.sqrt((face**2).sum(axis=-1))
    if range_m.max() < optics.nearest_m or range_m.min() > optics.farthest_m:
        raise UserError(
            f"the target's face lies {range_m.min():.3f} to {range_m.max():.3f} m from the camera",
            legal=f"{optics.nearest_m:g} to {optics.farthest_m:g} m for {optics.title}",
            fix="change target.pose.distance_m (or target.distance_m)",
        )


def seen_region(config: TargetConfig, optics: Optics) -> Region:
    """Return the pixels on which the face lies, or the whole sensor if a part of the face is out
    of view. Raises UserError if all of it is, or if it reaches behind the lens."""
    lens = optics.lens
    face = _face_before_lens(config, OUTLINE_STEPS).reshape(-1, 3)
    in_view = lens.images(face)
    if not in_view.any():
        raise UserError(
            f"the target is out of view of {optics.title}",
            legal="a part of the face in view",
            fix="move the target towards the axis (offset) or turn it to the camera (tilt)",
        )
    if not in_view.all():
        return lens.whole
    uv = lens.project(face)
    left, top = np.floor(uv.min(axis=0)).astype(int).tolist()
    right, bottom = np.ceil(uv.max(axis=0)).astype(int).tolist()
    return Region(top, bottom + 1, left, right + 1)


def _face_before_lens(config: TargetConfig, steps: int) -> np.ndarray:
    """Return points (n, n, 3) of the face in the camera's frame. Raises UserError if it reaches
    behind the lens."""
    face = transform_points(config.pose.T_camera_board, face_grid_m(config.board, steps=steps))
    nearest_m = float(face[..., 2].min())
    if nearest_m <= NEAREST_M:
        raise UserError(
            f"the target's nearest point is {nearest_m:.3f} m in front of the lens",
            legal=f"all of the face at least {NEAREST_M:g} m in front of the camera",
            fix="raise target.pose.distance_m (or target.distance_m) or lower its tilt",
        )
    return face


MAX_VIEWS = 200


class _Guess(Config):
    """Errors of the nominal poses, from which a registration starts. Every nominal pose but the
    first is rotated about a random axis through the target's centre, and shifted in a random
    direction."""

    guess_error_deg: Annotated[float, Field(ge=0.0, le=45.0)] = 3.0
    guess_error_mm: Annotated[float, Field(ge=0.0, le=500.0)] = 10.0
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1


class _Spread(_Guess):
    count: Annotated[int, Field(ge=1, le=MAX_VIEWS)]
    spread_deg: Annotated[float, Field(gt=0.0, le=120.0)] = Field(
        description="angle between the outermost views"
    )
    distance_jitter_mm: float = Field(
        0.0,
        ge=0.0,
        le=500.0,
        description="deviation of distances but the first",
    )
    aim_jitter_mm: float = Field(
        0.0,
        ge=0.0,
        le=500.0,
        description="deviation of the aim, to the sides and up or down",
    )


class ArcViews(_Spread):
    """Views on an arc about the target's centre. The first is the target's own pose; then come the
    ends, then the middles of the gaps, nearest first, so that fewer views are always the first of
    more."""

    kind: Literal["arc"]
    about: Literal["x", "y"] = Field("y", description="the board's axis about which the arc turns")


class GridViews(_Spread):
    """Views on a square grid of two angles: first the centre, then corners and edges, then ever
    finer."""

    kind: Literal["grid"]


class HandHeldViews(_Guess):
    """A hand-held walk about the target's own pose: each co-ordinate is a sum of three slow sines
    over time."""

    kind: Literal["hand_held"]
    count: Annotated[int, Field(ge=1, le=MAX_VIEWS)]
    sway_deg: Annotated[float, Field(ge=0.0, le=60.0)] = Field(
        10.0, description="largest rotation about each axis"
    )
    sway_mm: Annotated[float, Field(ge=0.0, le=500.0)] = Field(
        40.0, description="largest shift along each axis"
    )


class ListedViews(_Guess):
    """Views at the listed poses of the target; the first is the reference."""

    kind: Literal["list"]
    poses: Annotated[tuple[PoseConfig, ...], Field(min_length=1, max_length=MAX_VIEWS)]


AnyViews = ArcViews | GridViews | HandHeldViews | ListedViews


def view_count(views: AnyViews) -> int:
    """Return the number of views."""
    return len(views.poses) if isinstance(views, ListedViews) else views.count


def poses_of(views: AnyViews, pose: PoseConfig) -> tuple[PoseConfig, ...]:
    """Return the target's pose in front of the camera for each view; the first is ``pose`` itself
    unless poses are listed. Raises pydantic.ValidationError if a tilt exceeds the limits of a
    pose."""
    if isinstance(views, ListedViews):
        return views.poses
    if isinstance(views, HandHeldViews):
        return tuple(_moved(pose, step[:3], step[3:]) for step in _walk(views))
    turns = _grid(views.count)
    if isinstance(views, ArcViews):
        turns = []
        for share in _shares(views.count):
            turns.append((share, 0.0) if views.about == "x" else (0.0, share))
    half_deg = views.spread_deg / 2
    poses = []
    for number, (turn_x, turn_y) in enumerate(turns):
        shift_mm = (0.0, 0.0, 0.0)  # the first view keeps its pose
        if number > 0:
            shift_mm = _jitter_mm(views, number)
        poses.append(_moved(pose, (turn_x * half_deg, turn_y * half_deg, 0.0), shift_mm))
    return tuple(poses)


def _jitter_mm(
    views: ArcViews | GridViews,
    number: int,
) -> tuple[float, float, float]:
    """Draw the deviation of a view's target along x, y and z."""
    distance = float(random_stream(views.seed, "distance jitter", number).standard_normal())
    aside, up = random_stream(views.seed, "aim jitter", number).standard_normal(2).tolist()
    return (
        aside * views.aim_jitter_mm,
        up * views.aim_jitter_mm,
        distance * views.distance_jitter_mm,
    )


def T_reference_view_of(poses: tuple[PoseConfig, ...], number: int) -> np.ndarray:
    """Return the exact 4x4 matrix from a view's camera frame to the first view's."""
    return poses[0].T_camera_board @ invert(poses[number].T_camera_board)


def guessed_T_reference_view(
    views: AnyViews, poses: tuple[PoseConfig, ...], number: int, *labels: str | int
) -> np.ndarray:
    """Return the 4x4 nominal pose: the exact one with the error that ``views`` states, in random
    directions."""
    T_reference_view = T_reference_view_of(poses, number)
    if number == 0:
        return T_reference_view
    rng = random_stream(views.seed, "guess", number, *labels)
    axis, direction = rng.standard_normal((2, 3))
    axis = axis / np.linalg.norm(axis)
    direction = direction / np.linalg.norm(direction)
    turn = Rotation.from_rotvec(axis * np.deg2rad(views.guess_error_deg)).as_matrix()
    centre = poses[0].T_camera_board[:3, 3]
    error = np.eye(4)
    error[:3, :3] = turn
    error[:3, 3] = centre - turn @ centre + direction * views.guess_error_mm * MM
    return error @ T_reference_view


def _shares(wanted: int) -> list[float]:
    """Return 0, 1, -1, 1/2, -1/2, 1/4, -1/4, 3/4 ... of half the spread: odd multiples of powers
    of two."""
    shares = [0.0, 1.0, -1.0]
    step = 0.5
    while len(shares) < wanted:
        for odd in range(1, round(1 / step), 2):
            shares += [step * odd, -step * odd]
        step /= 2
    return shares[:wanted]


def _grid(wanted: int) -> list[tuple[float, float]]:
    """Return grids of 3 x 3, 5 x 5, 9 x 9 ... places in -1..1, each after the coarser ones;
    corners before edges."""

    def farthest_first(point: tuple[float, float]) -> tuple[float, tuple[float, float]]:
        return -(point[0] ** 2) - point[1] ** 2, point

    points = [(0.0, 0.0)]
    side = 3
    while len(points) < wanted:
        ticks = np.linspace(-1.0, 1.0, side).tolist()
        finer = [(x, y) for x in ticks for y in ticks if (x, y) not in points]
        points += sorted(finer, key=farthest_first)
        side = 2 * side - 1
    return points[:wanted]


@lru_cache(maxsize=16)
def _walk(views: HandHeldViews) -> tuple[tuple[float, ...], ...]:
    """Return for each view the rotations about x, y, z in degrees and shifts along x, y, z in mm;
    0 for the first."""
    rng = random_stream(views.seed, "hand-held")
    phases = rng.uniform(0, 2 * np.pi, (6, 3))
    cycles = rng.uniform(0.3, 1.5, (6, 3))
    time = np.linspace(0.0, 1.0, views.count) if views.count > 1 else np.zeros(1)
    waves = np.sin(2 * np.pi * cycles[..., None] * time + phases[..., None])
    paths = waves.sum(axis=1)
    paths -= paths[:, :1]
    greatest = np.maximum(np.abs(paths).max(axis=1, keepdims=True), 1e-12)
    reach = np.array([views.sway_deg] * 3 + [views.sway_mm] * 3)[:, None]
    # a hand rolls, and moves towards the target, less than it sways
    reach[[2, 5]] *= 0.5
    motions = paths / greatest * reach
    return tuple(tuple(step) for step in motions.T.tolist())


def _moved(
    pose: PoseConfig,
    turn_deg: Sequence[float],
    shift_mm: Sequence[float],
) -> PoseConfig:
    """Return the pose turned about x, y and z, and shifted along them."""
    return PoseConfig(
        tilt_x_deg=pose.tilt_x_deg + turn_deg[0],
        tilt_y_deg=pose.tilt_y_deg + turn_deg[1],
        roll_deg=pose.roll_deg + turn_deg[2],
        offset_x_mm=pose.offset_x_mm + shift_mm[0],
        offset_y_mm=pose.offset_y_mm + shift_mm[1],
        distance_m=pose.distance_m + shift_mm[2] * MM,
    )
