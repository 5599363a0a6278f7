"""Several views of one target: its pose in each, the error of the nominal poses, and whether a
camera sees it. The room moves with the camera, as if the target were turned on a table."""

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
    places = np.array([damage.centre_m for damage in config.damages]).reshape(-1, 2)
    centres = transform_points(config.pose.T_camera_board, face_of(config.board).point(*places.T))
    if (
        not len(centres) or not optics.lens.images(centres).any()
    ):  # if damage is in view, so is a part of the face
        seen_region(config, optics)
        if len(centres):
            message = f"none of the target's {len(centres)} damages is in view of {optics.title}"
            legal = "at least one damage in view; damage out of view is not counted as a target"
            raise UserError(message, legal=legal, fix="change target.pose, or move the damage")
    range_m = face[..., 2] if optics.limits_along == "axis" else np.sqrt((face**2).sum(axis=-1))
    if range_m.max() < optics.nearest_m or range_m.min() > optics.farthest_m:
        message = (
            f"the target's face lies {range_m.min():.3f} to {range_m.max():.3f} m from the camera"
        )
        legal = f"{optics.nearest_m:g} to {optics.farthest_m:g} m for {optics.title}"
        raise UserError(
            message, legal=legal, fix="change target.pose.distance_m (or target.distance_m)"
        )


def seen_region(config: TargetConfig, optics: Optics) -> Region:
    """Return the pixels on which the face lies, or the whole sensor if a part of the face is out
    of view. Raises UserError if all of it is, or if it reaches behind the lens."""
    lens = optics.lens
    face = _face_before_lens(config, OUTLINE_STEPS).reshape(-1, 3)
    in_view = lens.images(face)
    if not in_view.any():
        fix = "move the target towards the axis (offset) or turn it to the camera (tilt)"
        raise UserError(
            f"the target is out of view of {optics.title}",
            legal="a part of the face in view",
            fix=fix,
        )
    if not in_view.all():
        return lens.whole
    uv = lens.project(face)
    low = np.floor(uv.min(axis=0)).astype(int)
    high = np.ceil(uv.max(axis=0)).astype(int) + 1
    return Region(int(low[1]), int(high[1]), int(low[0]), int(high[0]))


def _face_before_lens(config: TargetConfig, steps: int) -> np.ndarray:
    """Return points (n, n, 3) of the face in the camera's frame. Raises UserError if it reaches
    behind the lens."""
    face = transform_points(config.pose.T_camera_board, face_grid_m(config.board, steps=steps))
    nearest_m = float(face[..., 2].min())
    if nearest_m <= NEAREST_M:
        legal = f"all of the face at least {NEAREST_M:g} m in front of the camera"
        fix = "raise target.pose.distance_m (or target.distance_m) or lower its tilt"
        raise UserError(
            f"the target's nearest point is {nearest_m:.3f} m in front of the lens",
            legal=legal,
            fix=fix,
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
        0.0, ge=0.0, le=500.0, description="deviation of distances but the first"
    )
    aim_jitter_mm: float = Field(
        0.0, ge=0.0, le=500.0, description="deviation of the aim, to the sides and up or down"
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
        return tuple(_moved(pose, *shift) for shift in _walk(views))
    half = views.spread_deg / 2
    poses = []
    turns = _grid(views.count)
    if isinstance(views, ArcViews):
        turns = [
            (share, 0.0) if views.about == "x" else (0.0, share) for share in _shares(views.count)
        ]
    for number, (turn_x, turn_y) in enumerate(turns):
        aside = up = distance = 0.0
        if number > 0:  # the first view keeps its pose
            distance = float(random_stream(views.seed, "distance jitter", number).standard_normal())
            aside, up = random_stream(views.seed, "aim jitter", number).standard_normal(2).tolist()
        shifts = (
            aside * views.aim_jitter_mm,
            up * views.aim_jitter_mm,
            distance * views.distance_jitter_mm,
        )
        poses.append(_moved(pose, turn_x * half, turn_y * half, 0.0, *shifts))
    return tuple(poses)


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
    axis, shift = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
    centre = poses[0].T_camera_board[:3, 3]
    error = np.eye(4)
    error[:3, :3] = Rotation.from_rotvec(axis * np.deg2rad(views.guess_error_deg)).as_matrix()
    error[:3, 3] = centre - error[:3, :3] @ centre + shift * views.guess_error_mm * MM
    return error @ T_reference_view


def _shares(wanted: int) -> list[float]:
    """Return 0, 1, -1, 1/2, -1/2, 1/4, -1/4, 3/4 ... of half the spread: odd multiples of powers
    of two."""
    shares = [0.0, 1.0, -1.0]
    step = 0.5
    while len(shares) < wanted:
        shares += [
            sign * step * odd for odd in range(1, round(1 / step), 2) for sign in (1.0, -1.0)
        ]
        step /= 2
    return shares[:wanted]


def _grid(wanted: int) -> list[tuple[float, float]]:
    """Return grids of 3 x 3, 5 x 5, 9 x 9 ... places in -1..1, each after the coarser ones;
    corners before edges."""
    places = [(0.0, 0.0)]
    side = 3
    while len(places) < wanted:
        ticks = np.linspace(-1.0, 1.0, side).tolist()
        new = [(x, y) for x in ticks for y in ticks if (x, y) not in places]
        places += sorted(new, key=lambda place: (-(place[0] ** 2) - place[1] ** 2, place))
        side = 2 * side - 1
    return places[:wanted]


@lru_cache(maxsize=16)
def _walk(views: HandHeldViews) -> tuple[tuple[float, ...], ...]:
    """Return for each view the rotations about x, y, z in degrees and shifts along x, y, z in mm;
    0 for the first."""
    rng = random_stream(views.seed, "hand-held")
    phases = rng.uniform(0, 2 * np.pi, (6, 3))
    cycles = rng.uniform(0.3, 1.5, (6, 3))
    time = np.linspace(0.0, 1.0, views.count) if views.count > 1 else np.zeros(1)
    paths = np.sin(2 * np.pi * cycles[..., None] * time + phases[..., None]).sum(axis=1)
    paths -= paths[:, :1]
    greatest = np.maximum(np.abs(paths).max(axis=1, keepdims=True), 1e-12)
    reach = np.array([views.sway_deg] * 3 + [views.sway_mm] * 3)[:, None]
    # a hand rolls, and moves towards the target, less than it sways
    reach[[2, 5]] *= 0.5
    return tuple(tuple(step) for step in (paths / greatest * reach).T.tolist())


def _moved(pose: PoseConfig, *by: float) -> PoseConfig:
    """Return the pose turned by three angles in degrees and shifted along x, y and z by
    millimetres."""
    names = ("tilt_x_deg", "tilt_y_deg", "roll_deg", "offset_x_mm", "offset_y_mm", "distance_m")
    moves = zip(names, (*by[:5], by[5] * MM), strict=True)
    return PoseConfig(**{key: getattr(pose, key) + moved for key, moved in moves})
