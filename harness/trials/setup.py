"""A simulated set-up with what a trial needs, and clouds with the truth on their grid. Detectors
get only the cloud."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numba
import numpy as np
from scipy.spatial import cKDTree

from detectors.findings.clusters import PLAIN
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, invert, rotate_vectors, transform_points
from scenes.render.cache import read_view
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig
from scenes.target.flaws import from_line_m
from scenes.target.truth import Damage, Face, face_of, truth_of

INTACT_MARGIN_PX = (
    8  # pixels closer to damage or rim do not count as undamaged; twice the engine's window
)
FEWEST_PROBES = 100
# pixels followed over repeats for noise and systematic error: 0.5 % accuracy with 50 repeats
PROBES = 500
FACE_STEPS = 8  # fixed-point steps to a curved face; each reduces the error by the face's slope
FACE_ONLY_M = 50 * MM  # points farther behind the face are ignored by `face_errors_m`


@dataclass(frozen=True)
class SetUpRef:
    """A small reference to a set-up, for workers. ``target`` has its damage; ``damaged``: whether
    the view shows it."""

    view_path: str
    camera: CameraConfig
    target: TargetConfig
    damaged: bool


@dataclass(frozen=True)
class SetUp:
    """One target in front of one unit. ``truth`` is the target's damage with its centre in view;
    if the view was rendered without damage (``damaged`` False), these places have no holes. Arrays
    cover ``unit.region``, (h, w)."""

    unit: SimulatedUnit
    damaged: bool
    truth: tuple[Damage, ...]
    target: TargetConfig
    T_camera_board: np.ndarray

    @cached_property
    def on_face_m(self) -> np.ndarray:
        """Points (h, w, 3) where each pixel's central ray meets the undamaged face, board frame;
        NaN off the board."""
        slopes = self.unit.view.slopes[self.unit.cut]
        T_board_camera = invert(self.T_camera_board)
        rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
        origin = np.broadcast_to(T_board_camera[:3, 3], rays.shape)
        board = self.target.board
        met = met_on_face(origin, rotate_vectors(T_board_camera, rays), face_of(board))
        x, y, z = np.moveaxis(met, -1, 0)
        with np.errstate(invalid="ignore"):
            over = (np.abs(x) < board.width_mm / 2 * MM) & (np.abs(y) < board.height_mm / 2 * MM)
        return np.where((over & np.isfinite(z))[..., None], met, np.nan)

    @property
    def board_xy_m(self) -> np.ndarray:
        """The same points in plan, (h, w, 2)."""
        return self.on_face_m[..., :2]

    @cached_property
    def seen_z_m(self) -> np.ndarray:
        """Depth z (h, w) of what each pixel's central ray meets in the rendered view, including
        the floors of holes."""
        view = self.unit.view
        cut = self.unit.cut
        return np.asarray(view.range_m[cut] / np.sqrt(1 + (view.slopes[cut] ** 2).sum(axis=-1)))

    @cached_property
    def outlines(self) -> dict[int, np.ndarray]:
        """Flat indices of the pixels whose central ray enters each damage, or of the nearest
        pixel."""
        return outlined(self.truth, self.board_xy_m)

    @cached_property
    def seen_depth_m(self) -> dict[int, float]:
        """Depth of each damage along the optical axis at which the central rays through it end
        behind the face: the median of those within 1 mm of the deepest (others hit walls). For
        raised damage, the same for the highest, negative; behind a through-hole, the backing's.
        Strips of tape count as face."""
        face_z_m = transform_points(self.T_camera_board, self.on_face_m)[..., 2]
        depth_m = (self.seen_z_m - face_z_m).ravel()
        found = {}
        for damage in self.truth:
            inside = depth_m[self.outlines[damage.id]]
            sign = -1.0 if damage.raised else 1.0
            known = sign * inside[np.isfinite(inside)]
            found[damage.id] = sign * float(
                np.median(known[known > known.max() - 1 * MM]) if known.size else np.nan
            )
        return found

    @cached_property
    def intact(self) -> np.ndarray:
        """Pixels (h, w) bool of undamaged face well away from damage and rim."""
        whole = self.on_board.copy()
        for pixels in self.outlines.values():
            whole.ravel()[pixels] = False
        return _eroded(whole)

    @cached_property
    def on_board(self) -> np.ndarray:
        """Pixels (h, w) bool whose central ray meets the face or a hole in it."""
        return np.isfinite(self.board_xy_m[..., 0])

    @cached_property
    def bare(self) -> np.ndarray:
        """Pixels (h, w) bool of the face well away from the rim, which a hole-free board shows
        undamaged."""
        return _eroded(self.on_board)

    @cached_property
    def pitch_mm(self) -> tuple[float, float]:
        """Median distance on the face between neighbouring columns and between neighbouring rows
        of pixels."""
        steps = (np.linalg.norm(np.diff(self.board_xy_m, axis=axis), axis=-1) for axis in (1, 0))
        u, v = (float(np.nanmedian(step)) / MM for step in steps)
        return u, v

    @cached_property
    def probes(self) -> np.ndarray:
        """Flat indices (p,) of evenly spread undamaged pixels, or of pixels on damage too if those
        are too few."""
        intact = np.flatnonzero(self.intact)
        intact = intact if len(intact) >= FEWEST_PROBES else np.flatnonzero(self.bare)
        return intact[:: max(1, len(intact) // PROBES)][:PROBES]


def outlined(truth: Sequence[Damage], places_m: np.ndarray) -> dict[int, np.ndarray]:
    """Return the flat indices of the places (h, w, 2) inside each damage, by id; the nearest place
    if none is."""
    x = np.ascontiguousarray(places_m[..., 0]).ravel()
    y = np.ascontiguousarray(places_m[..., 1]).ravel()
    found = {damage.id: np.flatnonzero(damage.within(x, y)) for damage in truth}
    for damage in truth:
        if not found[damage.id].size:
            apart = (x - damage.centre_board_m[0]) ** 2 + (y - damage.centre_board_m[1]) ** 2
            found[damage.id] = np.array([int(np.nanargmin(apart))])
    return found


def _eroded(mask: np.ndarray) -> np.ndarray:
    """Return a mask without a rim of `INTACT_MARGIN_PX`."""
    square = np.ones((2 * INTACT_MARGIN_PX + 1,) * 2, np.uint8)
    return np.asarray(
        cv2.erode(mask.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    )


def met_on_face(points_m: np.ndarray, directions: np.ndarray, face: Face) -> np.ndarray:
    """Return the points (..., 3) where lines through points along directions (..., 3), board
    frame, meet a face."""
    place = points_m
    before = None
    for _ in range(FACE_STEPS):
        height = np.nan_to_num(face.height_m(place[..., 0], place[..., 1]))
        if before is not None and np.array_equal(height, before):
            break  # on a flat face the first step is exact
        before = height
        place = (
            points_m + ((height - points_m[..., 2]) / directions[..., 2])[..., None] * directions
        )
    return np.asarray(place)


# set-ups kept, and bytes of their views: three of a lidar with 31 frequencies
KEPT = 32
KEPT_BYTES = 200_000_000
_kept: OrderedDict[SetUpRef, SetUp] = OrderedDict()


def load_set_up(ref: SetUpRef) -> SetUp:
    """Return the set-up of a reference. Workers keep set-ups for later trials, within ``KEPT`` and
    ``KEPT_BYTES``."""
    if ref not in _kept:
        T_camera_board = ref.target.pose.T_camera_board
        view = read_view(Path(ref.view_path))
        if view is None:
            what = f"{ref.view_path}: the stored render is missing or damaged"
            raise UserError(what, fix="run the same command again")
        unit = SimulatedUnit(camera_of(ref.camera), ref.camera, view)
        truth = truth_of(ref.target, T_camera_board)
        in_view = unit.camera.images(
            np.array([damage.centre_camera_m for damage in truth]).reshape(-1, 3)
        )
        seen = tuple(damage for damage, is_seen in zip(truth, in_view, strict=True) if is_seen)
        _kept[ref] = SetUp(unit, ref.damaged, seen, ref.target, T_camera_board)
    _kept.move_to_end(ref)
    held_bytes = sum(kept.unit.view.phasor.nbytes for kept in _kept.values())
    while len(_kept) > 1 and (len(_kept) > KEPT or held_bytes > KEPT_BYTES):
        held_bytes -= _kept.popitem(last=False)[1].unit.view.phasor.nbytes
    return _kept[ref]


@dataclass(frozen=True)
class KnownCloud:
    """A cloud with the truth. ``T_board_cloud`` (4, 4): the true pose, cloud's frame to board's.
    ``outlines``: by damage, the flat indices of the pixels (cells, points) that see into it, at
    least one. ``places_m`` (h, w, 2): position of each on the face in plan, NaN off the board.
    ``undamaged`` (h, w) bool: face well away from damage and rim. ``seen_depth_m``: by damage, the
    depth behind the face of what is seen in it."""

    cloud: Cloud
    T_board_cloud: np.ndarray
    target: TargetConfig
    truth: tuple[Damage, ...]
    outlines: Mapping[int, np.ndarray]
    places_m: np.ndarray
    undamaged: np.ndarray
    seen_depth_m: Mapping[int, float]

    def on_board(self, centres_m: np.ndarray) -> np.ndarray:
        """Return the places (m, 2) on the face that lines of sight through centres (m, 3) of the
        cloud's frame meet."""
        board = transform_points(self.T_board_cloud, np.asarray(centres_m).reshape(-1, 3))
        if self.cloud.projection == "parallel":
            direction = np.broadcast_to(self.T_board_cloud[:3, 2], board.shape)
        else:
            direction = board - self.T_board_cloud[:3, 3]
        return met_on_face(board, direction, face_of(self.target.board))[:, :2]

    def centre_in_cloud_m(self, damage: Damage) -> np.ndarray:
        """Return the true centre (3,) of a damage on the face, in the cloud's frame."""
        return transform_points(invert(self.T_board_cloud), damage.centre_board_m)

    def area_m2(self, pixels: np.ndarray) -> float:
        """Return the area in plan of the face under pixels (h, w) bool; without a grid, by their
        share of points."""
        valid = pixels & np.isfinite(self.places_m[..., 0])
        if not self.cloud.organised:
            board = self.target.board
            return (
                board.width_mm * board.height_mm * MM**2 * float(valid.sum()) / max(valid.size, 1)
            )
        areas = pixel_areas(self.places_m)[valid]
        known = areas[np.isfinite(areas)]
        # at the outline a neighbour is off the board: such a pixel counts as an average one
        usual = np.median(known) if 0 < len(known) < len(areas) else 0.0
        return float(known.sum() + (len(areas) - len(known)) * usual)


def known_view(set_up: SetUp, cloud: Cloud, *, hole_free: bool) -> KnownCloud:
    """Return the average of one view, with the truth along each pixel's central ray."""
    # if the camera is so far away that nothing undamaged is left between damage, use a hole-free
    # board without its rim
    undamaged = set_up.bare if hole_free and not set_up.intact.any() else set_up.intact
    of_truth = (
        set_up.target,
        set_up.truth,
        set_up.outlines,
        set_up.board_xy_m,
        undamaged,
        set_up.seen_depth_m,
    )
    return KnownCloud(cloud, invert(set_up.T_camera_board), *of_truth)


def known_map(
    first: SetUp, cloud: Cloud, T_reference_cloud: np.ndarray, *, hole_free: bool
) -> KnownCloud:
    """Return a map with the truth at the place of each point. ``first``: the set-up of the
    reference view."""
    T_board_cloud = invert(first.T_camera_board) @ T_reference_cloud
    place = board_places_m(cloud, T_board_cloud)
    margin_m = INTACT_MARGIN_PX * max(first.pitch_mm) * MM
    half = np.array([first.target.board.width_mm, first.target.board.height_mm]) / 2 * MM - margin_m
    with np.errstate(invalid="ignore"):
        bare = (np.abs(place) < half).all(axis=-1)
    intact = bare & far_from(first.truth, place, margin_m)
    of_truth = (first.target, first.truth, outlined(first.truth, place), place)
    undamaged = bare if hole_free and not intact.any() else intact
    return KnownCloud(cloud, T_board_cloud, *of_truth, undamaged, first.seen_depth_m)


def far_from(truth: Sequence[Damage], places_m: np.ndarray, margin_m: float) -> np.ndarray:
    """Return (h, w) bool: whether places (h, w, 2) are farther than a margin from all damage."""
    x = np.ascontiguousarray(places_m[..., 0])
    y = np.ascontiguousarray(places_m[..., 1])
    return ~np.any(
        [np.zeros(x.shape, bool), *(damage.within(x, y, margin_m) for damage in truth)], axis=0
    )


def board_places_m(cloud: Cloud, T_board_cloud: np.ndarray) -> np.ndarray:
    """Return the place (h, w, 2) on the board of each point; of a map's empty cells too, from its
    grid."""
    points = cloud.points_m
    if cloud.projection == "parallel":
        x = _ticks(points[..., 0])
        y = _ticks(points[..., 1].T)
        z = float(np.nanmedian(points[..., 2]))
        grid = np.stack([*np.meshgrid(x, y), np.full(cloud.valid.shape, z)], axis=-1)
        points = np.where(cloud.valid[..., None], points, grid)
    return np.asarray(transform_points(T_board_cloud, points)[..., :2])


def _ticks(places: np.ndarray) -> np.ndarray:
    """Return the equally spaced co-ordinates (w,) of the columns of places (h, w), including empty
    columns."""
    known = np.flatnonzero(np.isfinite(places).any(axis=0))
    ticks = np.nanmedian(places[:, known], axis=0)
    step, first = np.polyfit(known, ticks, 1) if len(known) > 1 else (0.0, float(ticks[0]))
    filled = first + step * np.arange(places.shape[1])
    filled[known] = ticks
    return np.asarray(filled)


def face_errors_m(known: KnownCloud, places_m: np.ndarray) -> np.ndarray:
    """Return how far (p,) behind the true face the cloud's point nearest to each place (p, 2) of
    the board lies, along the board's normal; NaN if that point is more than three of the cloud's
    mean spacings away."""
    points = transform_points(known.T_board_cloud, known.cloud.points_m[known.cloud.valid])
    points = points[np.abs(points[:, 2]) < FACE_ONLY_M]
    if not len(points):
        return np.full(len(places_m), np.nan)
    distance, nearest = cKDTree(points[:, :2], balanced_tree=False, compact_nodes=False).query(
        places_m
    )
    spacing_m = float(np.sqrt(np.prod(np.ptp(points[:, :2], axis=0)) / len(points)))
    error = (
        face_of(known.target.board).height_m(points[nearest, 0], points[nearest, 1])
        - points[nearest, 2]
    )
    return np.asarray(np.where(distance <= 3 * spacing_m, error, np.nan))


def highest_within(
    places_m: np.ndarray,
    score: np.ndarray,
    lines_m: Sequence[np.ndarray] | np.ndarray,
    radius_m: float,
) -> np.ndarray:
    """Return the highest (n,) of the finite scores (h, w) within a radius of each centre (2,) or
    line (k, 2); NaN if there is none. ``places_m`` (h, w, 2): the place of each pixel, NaN if it
    has none."""
    flat = places_m.reshape(-1, 2)
    scores = score.ravel()
    found = []
    x, y = np.ascontiguousarray(flat.T)
    for line in map(np.atleast_2d, lines_m):
        (west, north), (east, south) = line.min(axis=0) - radius_m, line.max(axis=0) + radius_m
        near = np.flatnonzero((x >= west) & (x <= east) & (y >= north) & (y <= south))
        near = near[np.isfinite(scores[near]) & (from_line_m(line, flat[near]) <= radius_m)]
        found.append(scores[near].max() if near.size else np.nan)
    return np.array(found)


@numba.njit(**PLAIN)
def pixel_areas(places_m: np.ndarray) -> np.ndarray:
    """Return the areas (h, w) that pixels at ``places_m`` (h, w, 2) cover in plan: parallelograms
    of central differences, one-sided at the edge. NaN beside a pixel without a place. h and w are
    at least 2."""
    h, w, _ = places_m.shape
    areas = np.empty((h, w))
    for v in range(h):
        up = max(v - 1, 0)
        down = min(v + 1, h - 1)
        for u in range(w):
            left = max(u - 1, 0)
            right = min(u + 1, w - 1)
            ax = places_m[v, right, 0] - places_m[v, left, 0]
            ay = places_m[v, right, 1] - places_m[v, left, 1]
            bx = places_m[down, u, 0] - places_m[up, u, 0]
            by = places_m[down, u, 1] - places_m[up, u, 1]
            areas[v, u] = abs(ax * by - ay * bx) / ((right - left) * (down - up))
    return areas
