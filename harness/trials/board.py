"""A board in front of a camera: what is true of it, and what a view shows.

`Board` is a target before one unit of a camera, as the rendered view shows it. `LabelledCloud` is
a cloud of a board (the average of one view, or a map) with the truth on its pixels. Detectors get
only the cloud."""

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numba
import numpy as np
from scipy.spatial import cKDTree

from detectors.pixels.clusters import PLAIN
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, invert, rotate_vectors, transform_points
from scenes.render.cache import read_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import TargetConfig
from scenes.target.flaws import from_line_m
from scenes.target.truth import Damage, Face, face_of, truth_of

# pixels closer to damage or rim do not count as undamaged; twice the engine's window
INTACT_MARGIN_PX = 8
FEWEST_PROBES = 100
# pixels followed over repeats for noise and systematic error: 0.5 % accuracy with 50 repeats
PROBES = 500
FACE_STEPS = 8  # fixed-point steps to a curved face; each reduces the error by the face's slope
FACE_ONLY_M = 50 * MM  # points farther behind the face are ignored by `face_errors_m`
SAME_FLOOR_M = 1 * MM  # depths this close to the deepest in a damage are those of its floor


@dataclass(frozen=True)
class BoardRef:
    """A small reference to a board in one view, which is sent to workers (`load_board`)."""

    view_path: str
    """File of the rendered view."""
    camera: CameraConfig
    """The unit of the camera."""
    target: TargetConfig
    """The target with its pose in this view and all its damage."""
    damaged: bool
    """True if the view shows the damage."""


@dataclass(frozen=True)
class Board:
    """A target in front of one unit of a camera, as one view shows it. Arrays (h, w) cover
    ``unit.region``."""

    unit: SimulatedUnit
    """The unit of the camera with the rendered view."""
    damaged: bool
    """True if the view shows the damage; if not, there are no holes at the places of ``truth``."""
    truth: tuple[Damage, ...]
    """The target's damage with its centre in view."""
    target: TargetConfig
    """The target with all its damage."""
    T_camera_board: np.ndarray
    """True pose (4, 4), board's frame to camera's."""

    @cached_property
    def on_face_m(self) -> np.ndarray:
        """Points (h, w, 3) where each pixel's central ray meets the undamaged face, board frame;
        NaN off the board."""
        slopes = self.unit.view.slopes[self.unit.cut]
        T_board_camera = invert(self.T_camera_board)
        h, w, _ = slopes.shape
        rays = np.concatenate([slopes, np.ones((h, w, 1))], axis=-1)
        directions = rotate_vectors(T_board_camera, rays)
        origin = np.broadcast_to(T_board_camera[:3, 3], rays.shape)
        board = self.target.board
        met = met_on_face(origin, directions, face_of(board))
        x, y, z = np.moveaxis(met, -1, 0)
        half_x_m = board.width_mm / 2 * MM
        half_y_m = board.height_mm / 2 * MM
        with np.errstate(invalid="ignore"):
            on_board = (np.abs(x) < half_x_m) & (np.abs(y) < half_y_m)
        on_board &= np.isfinite(z)
        return np.where(on_board[..., None], met, np.nan)

    @property
    def board_xy_m(self) -> np.ndarray:
        """The same points in plan, (h, w, 2)."""
        return self.on_face_m[..., :2]

    @cached_property
    def seen_z_m(self) -> np.ndarray:
        """Depth z (h, w) of what each pixel's central ray meets in the rendered view, including
        the floors of holes."""
        range_m = self.unit.view.range_m[self.unit.cut]
        slopes = self.unit.view.slopes[self.unit.cut]
        range_per_z = np.sqrt(1 + (slopes**2).sum(axis=-1))
        return np.asarray(range_m / range_per_z)

    @cached_property
    def outlines(self) -> dict[int, np.ndarray]:
        """Flat indices of the pixels whose central ray enters each damage, by id; of the nearest
        pixel if none does."""
        return outlined(self.truth, self.board_xy_m)

    @cached_property
    def seen_depth_m(self) -> dict[int, float]:
        """Depth of each damage, by id, along the optical axis at which the central rays through it
        end behind the face: the median of those within 1 mm of the deepest (others hit walls). For
        raised damage, the same for the highest, negative; behind a through-hole, the backing's.
        Strips of tape count as face."""
        face_z_m = transform_points(self.T_camera_board, self.on_face_m)[..., 2]
        depth_m = (self.seen_z_m - face_z_m).ravel()
        seen_m = {}
        for damage in self.truth:
            sign = -1.0 if damage.raised else 1.0
            inside_m = depth_m[self.outlines[damage.id]]
            inside_m = sign * inside_m[np.isfinite(inside_m)]
            if not inside_m.size:
                seen_m[damage.id] = float("nan")
                continue
            floor_m = np.median(inside_m[inside_m > inside_m.max() - SAME_FLOOR_M])
            seen_m[damage.id] = sign * float(floor_m)
        return seen_m

    @cached_property
    def intact(self) -> np.ndarray:
        """Pixels (h, w) bool of undamaged face well away from damage and rim."""
        undamaged = self.on_board.copy()
        for pixels in self.outlines.values():
            undamaged.ravel()[pixels] = False
        return _eroded(undamaged)

    @cached_property
    def on_board(self) -> np.ndarray:
        """Pixels (h, w) bool whose central ray meets the face or a hole in it."""
        return np.asarray(np.isfinite(self.board_xy_m[..., 0]))

    @cached_property
    def bare(self) -> np.ndarray:
        """Pixels (h, w) bool of the face well away from the rim, which a hole-free board shows
        undamaged."""
        return _eroded(self.on_board)

    @cached_property
    def pitch_mm(self) -> tuple[float, float]:
        """Median distance on the face between neighbouring columns and between neighbouring rows
        of pixels."""
        across = np.linalg.norm(np.diff(self.board_xy_m, axis=1), axis=-1)
        down = np.linalg.norm(np.diff(self.board_xy_m, axis=0), axis=-1)
        return float(np.nanmedian(across)) / MM, float(np.nanmedian(down)) / MM

    @cached_property
    def probes(self) -> np.ndarray:
        """Flat indices (p,) of evenly spread undamaged pixels, or of pixels on damage too if those
        are too few."""
        pixels = np.flatnonzero(self.intact)
        if len(pixels) < FEWEST_PROBES:
            pixels = np.flatnonzero(self.bare)
        step = max(1, len(pixels) // PROBES)
        return np.asarray(pixels[::step][:PROBES])

    def labelled(self, cloud: Cloud) -> "LabelledCloud":
        """Return the average of this view with the truth along each pixel's central ray."""
        # if the camera is so far away that nothing undamaged is left between damage, use a
        # hole-free board without its rim
        undamaged = self.intact
        if not self.damaged and not self.intact.any():
            undamaged = self.bare
        return LabelledCloud(
            cloud=cloud,
            damaged=self.damaged,
            T_board_cloud=invert(self.T_camera_board),
            target=self.target,
            truth=self.truth,
            outlines=self.outlines,
            places_m=self.board_xy_m,
            undamaged=undamaged,
            seen_depth_m=self.seen_depth_m,
        )

    def labelled_map(self, cloud: Cloud, T_reference_cloud: np.ndarray) -> "LabelledCloud":
        """Return a map with the truth at the place of each point. This board's view is the
        reference, whose frame ``T_reference_cloud`` (4, 4) maps the cloud's to."""
        T_board_cloud = invert(self.T_camera_board) @ T_reference_cloud
        places_m = board_places_m(cloud, T_board_cloud)
        margin_m = INTACT_MARGIN_PX * max(self.pitch_mm) * MM
        board = self.target.board
        half_m = np.array([board.width_mm, board.height_mm]) / 2 * MM - margin_m
        with np.errstate(invalid="ignore"):
            bare = (np.abs(places_m) < half_m).all(axis=-1)
        undamaged = bare & far_from(self.truth, places_m, margin_m)
        if not self.damaged and not undamaged.any():
            undamaged = bare
        return LabelledCloud(
            cloud=cloud,
            damaged=self.damaged,
            T_board_cloud=T_board_cloud,
            target=self.target,
            truth=self.truth,
            outlines=outlined(self.truth, places_m),
            places_m=places_m,
            undamaged=undamaged,
            seen_depth_m=self.seen_depth_m,
        )


def outlined(truth: Sequence[Damage], places_m: np.ndarray) -> dict[int, np.ndarray]:
    """Return the flat indices of the places (h, w, 2) inside each damage, by id; the nearest place
    if none is."""
    x_m = np.ascontiguousarray(places_m[..., 0]).ravel()
    y_m = np.ascontiguousarray(places_m[..., 1]).ravel()
    outlines = {}
    for damage in truth:
        pixels = np.flatnonzero(damage.within(x_m, y_m))
        if not pixels.size:
            centre_x_m, centre_y_m = damage.centre_board_m[:2]
            squared_m2 = (x_m - centre_x_m) ** 2 + (y_m - centre_y_m) ** 2
            pixels = np.array([int(np.nanargmin(squared_m2))])
        outlines[damage.id] = pixels
    return outlines


def _eroded(mask: np.ndarray) -> np.ndarray:
    """Return a mask without a rim of `INTACT_MARGIN_PX`."""
    side = 2 * INTACT_MARGIN_PX + 1
    square = np.ones((side, side), np.uint8)
    image = mask.astype(np.uint8)
    eroded = cv2.erode(image, square, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded > 0)


def met_on_face(points_m: np.ndarray, directions: np.ndarray, face: Face) -> np.ndarray:
    """Return the points (..., 3) where lines through points along directions (..., 3), board
    frame, meet a face."""
    met_m = points_m
    before_m = None
    for _ in range(FACE_STEPS):
        height_m = np.nan_to_num(face.height_m(met_m[..., 0], met_m[..., 1]))
        if before_m is not None and np.array_equal(height_m, before_m):
            break  # on a flat face the first step is exact
        before_m = height_m
        steps = (height_m - points_m[..., 2]) / directions[..., 2]
        met_m = points_m + steps[..., None] * directions
    return np.asarray(met_m)


# boards kept in memory, and bytes of their views: three of a lidar with 31 frequencies
KEPT = 32
KEPT_BYTES = 200_000_000
_kept: OrderedDict[BoardRef, Board] = OrderedDict()


def load_board(ref: BoardRef) -> Board:
    """Return the board of a reference. Workers keep boards for later trials, within ``KEPT`` and
    ``KEPT_BYTES``. Raises UserError if the view's file is missing or damaged."""
    if ref not in _kept:
        _kept[ref] = _loaded(ref)
    _kept.move_to_end(ref)
    kept_bytes = sum(board.unit.view.phasor.nbytes for board in _kept.values())
    while len(_kept) > 1 and (len(_kept) > KEPT or kept_bytes > KEPT_BYTES):
        _, oldest = _kept.popitem(last=False)
        kept_bytes -= oldest.unit.view.phasor.nbytes
    return _kept[ref]


def _loaded(ref: BoardRef) -> Board:
    unit = _unit_before(ref)
    T_camera_board = ref.target.pose.T_camera_board
    truth = truth_of(ref.target, T_camera_board)
    centres_m = np.array([damage.centre_camera_m for damage in truth]).reshape(-1, 3)
    in_view = unit.camera.images(centres_m)
    return Board(
        unit=unit,
        damaged=ref.damaged,
        truth=tuple(damage for damage, is_seen in zip(truth, in_view, strict=True) if is_seen),
        target=ref.target,
        T_camera_board=T_camera_board,
    )


def _unit_before(ref: BoardRef) -> SimulatedUnit:
    """Return the unit of a reference's camera before its view: that of a board in memory which
    shows the same, so that both share the exposure, or a new one."""
    for kept_ref, board in _kept.items():
        if kept_ref.view_path == ref.view_path and kept_ref.camera == ref.camera:
            return board.unit
    view = read_view(Path(ref.view_path))
    if view is None:
        what = f"{ref.view_path}: the stored render is missing or damaged"
        raise UserError(what, fix="run the same command again")
    return SimulatedUnit(camera_of(ref.camera), ref.camera, view)


@dataclass(frozen=True)
class LabelledCloud:
    """A cloud of a board with the truth on its pixels (for a map, cells or points)."""

    cloud: Cloud
    """The cloud that the detector gets."""
    damaged: bool
    """True if the board has its damage; if not, ``truth`` tells where it was left out."""
    T_board_cloud: np.ndarray
    """True pose (4, 4), cloud's frame to board's."""
    target: TargetConfig
    """The target with all its damage."""
    truth: tuple[Damage, ...]
    """The damages that are judged."""
    outlines: Mapping[int, np.ndarray]
    """Flat indices of the pixels that see into each damage, by id; at least one."""
    places_m: np.ndarray
    """Place (h, w, 2) of each pixel on the face in plan; NaN off the board."""
    undamaged: np.ndarray
    """Pixels (h, w) bool of the face well away from damage and rim."""
    seen_depth_m: Mapping[int, float]
    """Depth behind the face of what is seen in each damage, by id."""

    def on_board(self, centres_m: np.ndarray) -> np.ndarray:
        """Return the places (m, 2) on the face that lines of sight through centres (m, 3) of the
        cloud's frame meet."""
        centres_board_m = transform_points(self.T_board_cloud, np.asarray(centres_m).reshape(-1, 3))
        if self.cloud.projection == "parallel":
            directions = np.broadcast_to(self.T_board_cloud[:3, 2], centres_board_m.shape)
        else:
            directions = centres_board_m - self.T_board_cloud[:3, 3]
        return met_on_face(centres_board_m, directions, face_of(self.target.board))[:, :2]

    def centre_in_cloud_m(self, damage: Damage) -> np.ndarray:
        """Return the true centre (3,) of a damage on the face, in the cloud's frame."""
        return transform_points(invert(self.T_board_cloud), damage.centre_board_m)

    def area_m2(self, pixels: np.ndarray) -> float:
        """Return the area in plan of the face under pixels (h, w) bool; without a grid, by their
        share of points."""
        valid = pixels & np.isfinite(self.places_m[..., 0])
        if not self.cloud.organised:
            board = self.target.board
            board_m2 = board.width_mm * board.height_mm * MM**2
            return float(board_m2 * float(valid.sum()) / max(valid.size, 1))
        areas_m2 = pixel_areas(self.places_m)[valid]
        finite_m2 = areas_m2[np.isfinite(areas_m2)]
        unknown = len(areas_m2) - len(finite_m2)
        usual_m2 = 0.0
        if unknown and len(finite_m2):
            # at the outline a neighbour is off the board: such a pixel counts as an average one
            usual_m2 = np.median(finite_m2)
        return float(finite_m2.sum() + unknown * usual_m2)


def far_from(truth: Sequence[Damage], places_m: np.ndarray, margin_m: float) -> np.ndarray:
    """Return (h, w) bool: whether places (h, w, 2) are farther than a margin from all damage."""
    x_m = np.ascontiguousarray(places_m[..., 0])
    y_m = np.ascontiguousarray(places_m[..., 1])
    close = np.zeros(x_m.shape, bool)
    for damage in truth:
        close |= damage.within(x_m, y_m, margin_m)
    return ~close


def board_places_m(cloud: Cloud, T_board_cloud: np.ndarray) -> np.ndarray:
    """Return the place (h, w, 2) on the board of each point; of a map's empty cells too, from its
    grid."""
    points_m = cloud.points_m
    if cloud.projection == "parallel":
        x_m = _ticks_m(points_m[..., 0])
        y_m = _ticks_m(points_m[..., 1].T)
        grid_x_m, grid_y_m = np.meshgrid(x_m, y_m)
        level_m = float(np.nanmedian(points_m[..., 2]))
        grid_z_m = np.full(cloud.valid.shape, level_m)
        cells_m = np.stack([grid_x_m, grid_y_m, grid_z_m], axis=-1)
        points_m = np.where(cloud.valid[..., None], points_m, cells_m)
    return np.asarray(transform_points(T_board_cloud, points_m)[..., :2])


def _ticks_m(coordinates_m: np.ndarray) -> np.ndarray:
    """Return the equally spaced co-ordinates (w,) of the columns of an array (h, w), including
    empty columns."""
    filled = np.flatnonzero(np.isfinite(coordinates_m).any(axis=0))
    filled_m = np.nanmedian(coordinates_m[:, filled], axis=0)
    step_m = 0.0
    first_m = float(filled_m[0])
    if len(filled) > 1:
        step_m, first_m = np.polyfit(filled, filled_m, 1)
    ticks_m = first_m + step_m * np.arange(coordinates_m.shape[1])
    ticks_m[filled] = filled_m
    return np.asarray(ticks_m)


def face_errors_m(labelled: LabelledCloud, places_m: np.ndarray) -> np.ndarray:
    """Return how far (p,) behind the true face the cloud's point nearest to each place (p, 2) of
    the board lies, along the board's normal; NaN if that point is more than three of the cloud's
    mean spacings away."""
    cloud = labelled.cloud
    points_m = transform_points(labelled.T_board_cloud, cloud.points_m[cloud.valid])
    points_m = points_m[np.abs(points_m[:, 2]) < FACE_ONLY_M]
    if not len(points_m):
        return np.full(len(places_m), np.nan)
    tree = cKDTree(points_m[:, :2], balanced_tree=False, compact_nodes=False)
    distance_m, nearest = tree.query(places_m)
    covered_m2 = np.prod(np.ptp(points_m[:, :2], axis=0))
    spacing_m = float(np.sqrt(covered_m2 / len(points_m)))
    face = face_of(labelled.target.board)
    face_z_m = face.height_m(points_m[nearest, 0], points_m[nearest, 1])
    error_m = face_z_m - points_m[nearest, 2]
    return np.asarray(np.where(distance_m <= 3 * spacing_m, error_m, np.nan))


def highest_within(
    places_m: np.ndarray,
    score: np.ndarray,
    lines_m: Sequence[np.ndarray] | np.ndarray,
    radius_m: float,
) -> np.ndarray:
    """Return the highest (n,) of the finite scores (h, w) within a radius of each centre (2,) or
    line (k, 2); NaN if there is none. ``places_m`` (h, w, 2): the place of each pixel, NaN if it
    has none."""
    flat_m = places_m.reshape(-1, 2)
    scores = score.ravel()
    x_m, y_m = np.ascontiguousarray(flat_m.T)
    highest = []
    for line_m in map(np.atleast_2d, lines_m):
        west_m, north_m = line_m.min(axis=0) - radius_m
        east_m, south_m = line_m.max(axis=0) + radius_m
        in_box = (x_m >= west_m) & (x_m <= east_m) & (y_m >= north_m) & (y_m <= south_m)
        pixels = np.flatnonzero(in_box)
        pixels = pixels[
            np.isfinite(scores[pixels]) & (from_line_m(line_m, flat_m[pixels]) <= radius_m)
        ]
        highest.append(scores[pixels].max() if pixels.size else np.nan)
    return np.array(highest)


@numba.njit(**PLAIN)  # type: ignore[untyped-decorator]
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
            steps = (right - left) * (down - up)
            areas[v, u] = abs(ax * by - ay * bx) / steps
    return areas
