"""Several views of one target: where the camera stands for each, and how well that is known beforehand.

A view is a pose of the target before the camera; the room moves with the camera, as if the target were turned on a
table before a camera that stands still.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import count
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import invert
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.target.custom import PoseConfig

MAX_VIEWS = 200


class _Guess(Config):
    """Error of the nominal pose of every view but the first, the guess from which a registration starts: it is turned
    by ``guess_error_deg`` about a random axis through the target's centre, and shifted by ``guess_error_mm`` in a
    random direction."""

    guess_error_deg: Annotated[float, Field(ge=0.0, le=45.0)] = 3.0
    guess_error_mm: Annotated[float, Field(ge=0.0, le=500.0)] = 10.0
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1


class _Spread(_Guess):
    count: Annotated[int, Field(ge=1, le=MAX_VIEWS)]
    spread_deg: Annotated[float, Field(gt=0.0, le=120.0)] = Field(description="from the outermost view to the opposite")
    distance_jitter_mm: Annotated[float, Field(ge=0.0, le=500.0)] = Field(
        0.0, description="standard deviation of each view's distance; the first keeps its own"
    )
    aim_jitter_mm: Annotated[float, Field(ge=0.0, le=500.0)] = Field(
        0.0, description="standard deviation of where each view looks, sideways and upwards; the first keeps its own"
    )


class ArcViews(_Spread):
    """Views on an arc about the target's centre. The first is the target's own pose, then come the ends, then the
    middles of what is left, nearer ones first: fewer views are always the first of more."""

    kind: Literal["arc"]
    about: Literal["x", "y"] = Field("y", description="board axis about which the arc turns")


class GridViews(_Spread):
    """Views on a square grid of two angles, in the same order: centre, corners and edges, then ever finer."""

    kind: Literal["grid"]


class HandHeldViews(_Guess):
    """A walk about the target's own pose, each co-ordinate a sum of three slow sines; the order is that in time."""

    kind: Literal["hand_held"]
    count: Annotated[int, Field(ge=1, le=MAX_VIEWS)]
    sway_deg: Annotated[float, Field(ge=0.0, le=60.0)] = Field(10.0, description="greatest turn about each axis")
    sway_mm: Annotated[float, Field(ge=0.0, le=500.0)] = Field(40.0, description="greatest shift along each axis")


class ListedViews(_Guess):
    """Poses of the target as they are listed; the first is the reference."""

    kind: Literal["list"]
    poses: Annotated[tuple[PoseConfig, ...], Field(min_length=1, max_length=MAX_VIEWS)]


AnyViews = ArcViews | GridViews | HandHeldViews | ListedViews


def view_count(views: AnyViews) -> int:
    """Return the number of views."""
    return len(views.poses) if isinstance(views, ListedViews) else views.count


def poses_of(views: AnyViews, pose: PoseConfig) -> tuple[PoseConfig, ...]:
    """The target's pose before the camera for each view; the first is ``pose`` itself unless poses are listed.

    Raises pydantic.ValidationError where a tilt would pass what a pose may have.
    """
    if isinstance(views, ListedViews):
        return views.poses
    if isinstance(views, HandHeldViews):
        return tuple(_moved(pose, *shift) for shift in _walk(views))
    half = views.spread_deg / 2
    if isinstance(views, ArcViews):
        turns = [(share * half, 0.0) if views.about == "x" else (0.0, share * half) for share in _shares(views.count)]
    else:
        turns = [(x * half, y * half) for x, y in _grid(views.count)]
    return tuple(
        _moved(pose, turn_x, turn_y, 0.0, *_jitter_mm(views, number)) for number, (turn_x, turn_y) in enumerate(turns)
    )


def T_reference_view_of(poses: tuple[PoseConfig, ...], number: int) -> np.ndarray:
    """4x4: a view's camera frame to the first view's, exactly."""
    return poses[0].T_camera_board @ invert(poses[number].T_camera_board)


def guessed_T_reference_view(
    views: AnyViews, poses: tuple[PoseConfig, ...], number: int, *labels: str | int
) -> np.ndarray:
    """4x4: the nominal pose, wrong by what ``views`` says in directions drawn from its seed and ``labels``."""
    T_reference_view = T_reference_view_of(poses, number)
    if number == 0:
        return T_reference_view
    rng = random_stream(views.seed, "guess", number, *labels)
    axis, shift = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
    centre = poses[0].T_camera_board[:3, 3]
    error = np.eye(4)
    error[:3, :3] = _rotation(axis * np.deg2rad(views.guess_error_deg))
    error[:3, 3] = centre - error[:3, :3] @ centre + shift * views.guess_error_mm * MM
    return error @ T_reference_view


def _rotation(vector: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    matrix: np.ndarray = Rotation.from_rotvec(vector).as_matrix()
    return matrix


def _shares(count_: int) -> list[float]:
    """0, 1, -1, 1/2, -1/2, 1/4, -1/4, 3/4 ...: of half the spread, odd multiples of ever smaller powers of two."""
    shares = [0.0, 1.0, -1.0]
    for level in count(1):
        if len(shares) >= count_:
            return shares[:count_]
        step = 0.5**level
        shares += [sign * step * odd for odd in range(1, 2**level, 2) for sign in (1.0, -1.0)]
    raise AssertionError("endless")


def _grid(count_: int) -> list[tuple[float, float]]:
    """Grids of 3 x 3, 5 x 5, 9 x 9 ... places in -1..1, each after the coarser ones; corners before edges."""
    places: dict[tuple[float, float], None] = {(0.0, 0.0): None}
    for level in count(0):
        if len(places) >= count_:
            return list(places)[:count_]
        ticks = np.linspace(-1.0, 1.0, 2 ** (level + 1) + 1).tolist()
        new = [(x, y) for x in ticks for y in ticks if (x, y) not in places]
        places |= dict.fromkeys(sorted(new, key=lambda place: (-(place[0] ** 2) - place[1] ** 2, place)))
    raise AssertionError("endless")


def _jitter_mm(views: ArcViews | GridViews, number: int) -> tuple[float, float, float]:
    """Shifts along the camera's x, y and z; none for the first view."""
    if number == 0:
        return 0.0, 0.0, 0.0
    distance = float(random_stream(views.seed, "distance jitter", number).standard_normal())
    aside, up = random_stream(views.seed, "aim jitter", number).standard_normal(2).tolist()
    return aside * views.aim_jitter_mm, up * views.aim_jitter_mm, distance * views.distance_jitter_mm


@lru_cache(maxsize=16)
def _walk(views: HandHeldViews) -> tuple[tuple[float, ...], ...]:
    """Return for each view: turns about x, y, z in degrees, shifts along x, y, z in mm; none at the first."""
    rng = random_stream(views.seed, "hand-held")
    phases, cycles = rng.uniform(0, 2 * np.pi, (6, 3)), rng.uniform(0.3, 1.5, (6, 3))
    time = np.linspace(0.0, 1.0, views.count) if views.count > 1 else np.zeros(1)
    paths = np.sin(2 * np.pi * cycles[..., None] * time + phases[..., None]).sum(axis=1)
    paths -= paths[:, :1]
    greatest = np.maximum(np.abs(paths).max(axis=1, keepdims=True), 1e-12)
    reach = np.array([views.sway_deg] * 3 + [views.sway_mm] * 3)[:, None]
    # a hand does not roll or move nearer as far as it sways
    reach[[2, 5]] *= 0.5
    return tuple(tuple(step) for step in (paths / greatest * reach).T.tolist())


def _moved(
    pose: PoseConfig, turn_x: float, turn_y: float, turn_z: float, shift_x: float, shift_y: float, shift_z: float
) -> PoseConfig:
    return PoseConfig(
        distance_m=pose.distance_m + shift_z * MM,
        offset_x_mm=pose.offset_x_mm + shift_x,
        offset_y_mm=pose.offset_y_mm + shift_y,
        tilt_x_deg=pose.tilt_x_deg + turn_x,
        tilt_y_deg=pose.tilt_y_deg + turn_y,
        roll_deg=pose.roll_deg + turn_z,
    )
