"""A cloud with the truth on its own grid, be it one view's average or a map of several: what a judge needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from harness.engine.setup import INTACT_MARGIN_PX, SetUp, met_on_face
from harness.engine.sight_kernels import pixel_areas
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.units import MM
from scenes.target.custom import TargetConfig
from scenes.target.face import face_of
from scenes.target.truth import Damage


@dataclass(frozen=True)
class Sight:
    """A cloud and where the truth lies in it.

    ``T_board_cloud`` (4, 4): the cloud's frame to the board's, true. ``outlines``: by damage the flat indices of the
    pixels (cells, points) that see into it, at least one. ``places_m`` (h, w, 2): where each lies on the face in plan,
    NaN off the board. ``undamaged`` (h, w) bool: face well away from damage and rim. ``seen_depth_m``: by damage, how
    far behind the face a view of it ends.
    """

    cloud: Cloud
    T_board_cloud: np.ndarray
    target: TargetConfig
    truth: tuple[Damage, ...]
    outlines: Mapping[int, np.ndarray]
    places_m: np.ndarray
    undamaged: np.ndarray
    seen_depth_m: Mapping[int, float]

    def on_board(self, centres_m: np.ndarray) -> np.ndarray:
        """(m, 2) places on the face of findings whose centres (m, 3) are given in the cloud's frame: where the line of
        sight through a centre meets the face.

        The centre itself lies at depth, up to a centimetre aside of where a viewer would point on the face. On a
        map the line of sight is its z axis.
        """
        board = transform_points(self.T_board_cloud, np.asarray(centres_m).reshape(-1, 3))
        if self.cloud.projection == "parallel":
            direction = np.broadcast_to(self.T_board_cloud[:3, 2], board.shape)
        else:
            direction = board - self.T_board_cloud[:3, 3]
        return met_on_face(board, direction, face_of(self.target.board))[:, :2]

    def centre_in_cloud_m(self, damage: Damage) -> np.ndarray:
        """(3,) true centre of a damage on the face, in the cloud's frame."""
        return transform_points(invert(self.T_board_cloud), damage.centre_board_m)

    def area_m2(self, pixels: np.ndarray) -> float:
        """The face's area in plan that the pixels (h, w) bool cover, tilt and perspective included; of a cloud without
        a grid the whole face's, in the share of its points."""
        there = pixels & np.isfinite(self.places_m[..., 0])
        if not self.cloud.organised:
            size = self.target.board
            return size.width_mm * size.height_mm * MM**2 * float(there.sum()) / max(there.size, 1)
        areas = pixel_areas(self.places_m)
        each = areas[there]
        known = np.isfinite(each)
        if not known.all():
            # at the outline a neighbour is off the board: such a pixel is taken for one like the others
            every = areas[np.isfinite(areas)]
            each = np.where(known, each, np.median(every) if every.size else 0.0)
        return float(each.sum())


def sight_of_view(set_up: SetUp, cloud: Cloud, *, hole_free: bool) -> Sight:
    """Of one view's average: the truth along each pixel's central ray."""
    # where the camera is so far that nothing undamaged is left beside the damage, a hole-free board but for its rim
    undamaged = set_up.bare if hole_free and not set_up.intact.any() else set_up.intact
    return Sight(
        cloud=cloud,
        T_board_cloud=invert(set_up.T_camera_board),
        target=set_up.target,
        truth=set_up.truth,
        outlines=set_up.outlines,
        places_m=set_up.board_xy_m,
        undamaged=undamaged,
        seen_depth_m=set_up.seen_depth_m,
    )


def sight_of_map(first: SetUp, cloud: Cloud, T_reference_cloud: np.ndarray, *, hole_free: bool) -> Sight:
    """Of a map of several views, ``first`` being the reference view's set-up: the truth by each point's own place.

    A point deep in a hole that was seen at an angle lies beside the place on the face where it was looked for; on the
    target's scale that is within the margin round the damage.
    """
    T_board_cloud = invert(first.T_camera_board) @ T_reference_cloud
    place = board_places_m(cloud, T_board_cloud)
    margin_m = INTACT_MARGIN_PX * max(first.pitch_mm) * MM
    size = first.target.board
    half = np.array([size.width_mm, size.height_mm]) / 2 * MM - margin_m
    with np.errstate(invalid="ignore"):
        bare = (np.abs(place) < half).all(axis=-1)
    outlines, intact = {}, bare.copy()
    x, y = np.ascontiguousarray(place[..., 0]), np.ascontiguousarray(place[..., 1])
    for damage in first.truth:
        apart_m2 = (x - damage.centre_board_m[0]) ** 2 + (y - damage.centre_board_m[1]) ** 2
        with np.errstate(invalid="ignore"):
            intact &= apart_m2 > (damage.diameter_m / 2 + margin_m) ** 2
            within = np.flatnonzero(apart_m2.ravel() < (damage.diameter_m / 2) ** 2)
        outlines[damage.id] = within if within.size else np.array([int(np.nanargmin(apart_m2))])
    return Sight(
        cloud=cloud,
        T_board_cloud=T_board_cloud,
        target=first.target,
        truth=first.truth,
        outlines=outlines,
        places_m=place,
        undamaged=bare if hole_free and not intact.any() else intact,
        seen_depth_m=first.seen_depth_m,
    )


def board_places_m(cloud: Cloud, T_board_cloud: np.ndarray) -> np.ndarray:
    """(h, w, 2) place on the board of each point; of a map's empty cells too, whose x and y its grid knows."""
    points = cloud.points_m
    if cloud.projection == "parallel":
        x, y = _ticks(points[..., 0]), _ticks(points[..., 1].T)
        z = float(np.nanmedian(points[..., 2]))
        grid = np.stack([*np.meshgrid(x, y), np.full(cloud.valid.shape, z)], axis=-1)
        points = np.where(cloud.valid[..., None], points, grid)
    return np.asarray(transform_points(T_board_cloud, points)[..., :2])


def face_errors_m(sight: Sight, places_m: np.ndarray) -> np.ndarray:
    """(p,) how far behind the true face the cloud's point nearest to each place (p, 2) of the board lies, along the
    board's normal; NaN where the nearest lies more than three of the cloud's mean spacings aside."""
    from scipy.spatial import cKDTree

    points = transform_points(sight.T_board_cloud, sight.cloud.points_m[sight.cloud.valid])
    # the undamaged face only: what lies behind a rim is nearest to no place on the face
    points = points[np.abs(points[:, 2]) < 50 * MM]
    if not len(points):
        return np.full(len(places_m), np.nan)
    tree = cKDTree(points[:, :2], balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(places_m)
    spacing_m = float(np.sqrt(np.prod(np.ptp(points[:, :2], axis=0)) / len(points)))
    face = face_of(sight.target.board)
    error = face.height_m(points[nearest, 0], points[nearest, 1]) - points[nearest, 2]
    return np.asarray(np.where(distance <= 3 * spacing_m, error, np.nan))


def _ticks(places: np.ndarray) -> np.ndarray:
    """(w,) equally spaced co-ordinates of the columns of (h, w) places, those of empty columns filled in."""
    known = np.flatnonzero(np.isfinite(places).any(axis=0))
    ticks = np.nanmedian(places[:, known], axis=0)
    step, first = np.polyfit(known, ticks, 1) if len(known) > 1 else (0.0, float(ticks[0]))
    filled = first + step * np.arange(places.shape[1])
    filled[known] = ticks
    return np.asarray(filled)
