"""The large connected smooth surfaces of a cloud, each with its outline.

Neighbours are joined where the step in depth is no more than a tilted surface and noise explain and the surface does
not bend sharply; so a pipe seen to its limb is a surface, and two faces of a box are two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from detectors import crop_kernels as kernels
from detectors.median import quantile_of
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import Region
from harness.vocabulary.units import MM

MAX_SURFACE_TILT = 6.0
"""tan(80.5 degrees): a steeper step between neighbouring pixels is an edge, not a surface."""
STEP_SIGMAS = 6.0
"""Of the noise of a difference between neighbours: below this a step may be noise."""
BRIDGED_PX = 2
"""Pixels without a return take the point of the nearest pixel that has one, so near: with 30 % of the pixels missing at
random, chains of neighbours would break."""
SMOOTH_MM = 16.0
"""Width of the window on a coarse grid: a step of 15 mm must still bend the smoothed surface sharply."""
MIXED_PX = 3
"""Bends are judged across at least twice so many pixels, where that is no more than 24 mm."""
NORMAL_NOISE = 0.06
"""Radians: so noisy may the slope of the smoothed surface be at most; a noisier cloud takes a wider window."""
WIDEST_SMOOTH_PX = 41
LEAST_SHARE, LEAST_PX = 0.004, 100
"""Of all pixels, and pixels: a smaller surface is no candidate. A board of 150 x 100 mm at 1.5 m holds 0.5 % of an
Azure Kinect's view."""
LEAST_SHARED_PX = 10
"""Pixels that the rims of two surfaces must share to be judged as one."""
CONTACT_MM, CONTACT_SIGMAS = 5.0, 3.0
"""Surfaces nearer to one another at a common border meet there; noise of a difference widens that."""
RIM_TURN_DEG = 10.0
"""A rim turns from the surface inside it by no more, beside what that surface bends by: five times what noise may give
a slope (`NORMAL_NOISE`, over the way to the rim), and a third of what a blurred step of 25 mm over 5 pixels does."""
MOST_SURFACES = 8
WIDE_PART = 0.1
"""Of a surface's pixels: so many must be the middle of a full smoothing window of its own. The smoothing makes a ramp
of every step in depth, no wider than the window, which is no surface."""
WIDEST_SLOPE = 5.7
"""tan(80 degrees): no camera sees so far off its axis; a cloud that does was not recorded from its origin."""
CELL_SPACINGS = 1.5
"""Least side of a cell over the distance between neighbours: above sqrt 2, so that no cell of a cloud that was an image
stays empty, however its rows lie."""
CELL_GROWTH, CELLS_FILLED = 1.25, 0.99
"""Cells grow by this factor until so many of them, away from rims, hold a point. Where the pixel grids of several views
lie over one another, their points gather in bands, and lines of empty cells between these would part a target."""
MAX_RASTER = 4096
"""Cells along one side of the raster that stands in for a missing pixel grid."""


@dataclass(frozen=True)
class Surfaces:
    """``own`` (n, h, w) bool: each surface's pixels, largest core first; ``filled`` (n, h, w) bool: the same with all
    that they enclose. ``noise_m``: standard deviation of a difference between neighbours; ``reach_px``: how far from
    an edge the smoothing is felt."""

    own: np.ndarray
    filled: np.ndarray
    noise_m: float
    reach_px: int


def smooth_surfaces(cloud: Cloud, crease_deg: float, smooth_px: int) -> Surfaces:
    """Of an organised cloud. ``smooth_px`` is the window's width; a coarse grid takes a narrower window (`SMOOTH_MM`),
    noise a wider one (`NORMAL_NOISE`)."""
    points, valid = _bridged(cloud.points_m, cloud.valid)
    noise_m = _step_noise(cloud)
    pitch_m = _pitch(points)
    window = _window_px(pitch_m, noise_m, smooth_px)
    # a camera that interpolates spreads a step over some pixels: on a coarse grid, more than the window
    half = max(window // 2, min(MIXED_PX, int(0.75 * SMOOTH_MM * MM / pitch_m)) if pitch_m else 0, 1)
    smooth = _smoothed(points, valid, window)
    central = sees_from_origin(cloud)
    if noise_m <= pitch_m:
        right, down = kernels.links(points, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m, central)
    else:
        # single points would need so wide a tolerance that it joins what stands apart
        known = np.where(valid[..., None], smooth, np.nan)
        right, down = kernels.links(known, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m / window, central)
    normals = kernels.unit_normals(smooth)
    bends = kernels.turns(normals, half, math.cos(math.radians(crease_deg)))
    cores, sizes = kernels.components(valid & ~bends, right, down, 1)
    count = _number_large(cores, sizes, max(LEAST_PX, int(LEAST_SHARE * valid.size)), window)
    reach = window // 2 + 1 + half
    own = np.zeros((count, *valid.shape), dtype=bool)
    for number in range(1, count + 1):
        own[number - 1] = _with_rim(cores, number, valid, right, down, reach)
    local = Smooth(points, smooth, normals, central)
    own = _joined(own, cores, local, max(CONTACT_MM * MM, CONTACT_SIGMAS * noise_m), math.radians(crease_deg / 2.0))
    _share_contested(own, cores, local)
    _trim_rims(own, cores, cloud.valid, local, window, half, max(CONTACT_MM * MM, CONTACT_SIGMAS * noise_m))
    filled = np.zeros_like(own)
    for number, each in enumerate(own):
        filled[number] = holes_filled(each)
    return Surfaces(own & cloud.valid, filled, noise_m, reach)


def _number_large(cores: np.ndarray, sizes: np.ndarray, least: int, window: int) -> int:
    """How many surfaces are candidates: those of ``least`` pixels that are wider than the smoothing's ramp at an edge,
    at most `MOST_SURFACES`, and the largest in any case. They are numbered anew in ``cores``, all others 0."""
    kernel = np.ones((window, window), np.uint8)
    kept = []
    for number in range(1, min(int((sizes >= least).sum()), 4 * MOST_SURFACES) + 1):
        whole = holes_filled(cores == number).astype(np.uint8)
        wide = cv2.erode(cv2.copyMakeBorder(whole, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0), kernel)
        if np.count_nonzero(wide) >= WIDE_PART * np.count_nonzero(whole):
            kept.append(number)
    if not kept and len(sizes):
        kept = [1]
    new = np.zeros(len(sizes) + 1, dtype=cores.dtype)
    new[kept[:MOST_SURFACES]] = np.arange(1, min(len(kept), MOST_SURFACES) + 1)
    cores[:] = new[cores]
    return min(len(kept), MOST_SURFACES)


@dataclass(frozen=True)
class Smooth:
    """Points (h, w, 3), their local means and the unit normals of these; and whether rays meet in the origin."""

    points_m: np.ndarray
    means_m: np.ndarray
    normals: np.ndarray
    central: bool

    def misses_m(self, pixels: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """(n,) how far in depth the points at flat indices ``pixels`` lie from the planes through the means at
        ``seeds``."""
        points, normals = self.points_m.reshape(-1, 3)[pixels], self.normals.reshape(-1, 3)[seeds]
        height = ((self.means_m.reshape(-1, 3)[seeds] - points) * normals).sum(axis=1)
        way = points / points[:, 2:] if self.central else np.array([[0.0, 0.0, 1.0]])
        return np.abs(height) / np.maximum(np.abs((normals * way).sum(axis=1)), 1e-3)

    def bend_per_m(self, seeds: np.ndarray, away_from: np.ndarray, reach: int) -> np.ndarray:
        """(n,) turn of the normals, radians per metre, over ``reach`` pixels from flat indices ``seeds`` on, in the
        direction away from the pixels ``away_from``."""
        height, width = self.normals.shape[:2]
        rows, columns = np.divmod(seeds, width)
        down, across = rows - away_from // width, columns - away_from % width
        steps = reach / np.maximum(np.hypot(down, across), 1.0)
        there = np.clip(np.rint(rows + steps * down), 0, height - 1).astype(np.int64) * width
        there += np.clip(np.rint(columns + steps * across), 0, width - 1).astype(np.int64)
        normals, means = self.normals.reshape(-1, 3), self.means_m.reshape(-1, 3)
        cosine = np.clip((normals[seeds] * normals[there]).sum(axis=1), 0.0, 1.0)
        bend: np.ndarray = np.arccos(cosine) / np.maximum(np.linalg.norm(means[seeds] - means[there], axis=1), 1e-9)
        return bend


def sees_from_origin(cloud: Cloud) -> bool:
    """Whether the cloud's grid samples rays through the origin, as a camera does."""
    if cloud.projection != "central":
        return False
    x, y, z = (cloud.points_m[..., k][cloud.valid] for k in range(3))
    return bool(len(z)) and bool(z.min() > 0) and float(max(np.abs(x / z).max(), np.abs(y / z).max())) < WIDEST_SLOPE


def holes_filled(mask: np.ndarray) -> np.ndarray:
    """The mask with everything that it encloses."""
    outside = np.pad(~mask, 1, constant_values=True).astype(np.uint8)
    _, labels = cv2.connectedComponents(outside, connectivity=4)
    filled: np.ndarray = (labels != labels[0, 0])[1:-1, 1:-1]
    return filled


def inset(mask: np.ndarray, pixels: int) -> np.ndarray:
    """The mask without so many pixels of its outer rim. Holes inside do not grow; the picture's edge is no rim."""
    if pixels == 0:
        return mask
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    # OpenCV's default border never erodes: the edge of the image is not the target's rim
    return mask & cv2.erode(holes_filled(mask).astype(np.uint8), kernel).astype(bool)


def nearest_pixel(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(h, w) distance of each pixel to the mask, pixels, and the flat index of the mask's nearest pixel."""
    apart, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    flat = np.zeros(labels.max() + 1, dtype=np.int64)
    inside = np.flatnonzero(mask)
    flat[labels.reshape(-1)[inside]] = inside
    return apart, flat[labels]


def _bridged(points_m: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and their validity with gaps of `BRIDGED_PX` closed by the nearest point."""
    if valid.all() or not valid.any():
        return points_m, valid
    apart, nearest = nearest_pixel(valid)
    closed = apart <= BRIDGED_PX
    points = points_m.copy()
    gaps = closed & ~valid
    points[gaps] = points_m.reshape(-1, 3)[nearest[gaps]]
    return points, closed


def _step_noise(cloud: Cloud) -> float:
    """Standard deviation of a difference between neighbours, from the quieter quarter of the second differences of z
    along rows (three quarters of the picture may be rubble); at least a rounding step's."""
    z = np.ascontiguousarray(cloud.points_m[..., 2])
    bends = np.abs(z[:, 2:] - 2.0 * z[:, 1:-1] + z[:, :-2])
    bends = bends[np.isfinite(bends)]
    # the second difference of white noise has sqrt(6) of its sigma, the first sqrt(2)
    noise = quantile_of(bends, 0.25) / 0.3186 * np.sqrt(2.0 / 6.0) if len(bends) else 0.0
    return max(noise, cloud.z_step_m * np.sqrt(2.0 / 12.0))


def _pitch(points_m: np.ndarray) -> float:
    """Distance of neighbours across the view at the nearest tenth of it, metres; 0 where no two have a point."""
    steps = np.hypot(np.diff(points_m[::4, :, 0], axis=1), np.diff(points_m[::4, :, 1], axis=1))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return quantile_of(steps, 0.1) if len(steps) else 0.0


def _window_px(pitch_m: float, noise_m: float, smooth_px: int) -> int:
    """Odd width of the smoothing window."""
    if pitch_m == 0.0:
        return smooth_px
    # a central difference of the mean of n x n pixels has noise_m / (sqrt(2) n^1.5 pitch)
    by_noise = (noise_m / (math.sqrt(2.0) * NORMAL_NOISE * pitch_m)) ** (2.0 / 3.0)
    wanted = max(min(smooth_px, SMOOTH_MM * MM / pitch_m), by_noise, 3.0)
    return min(2 * int(wanted / 2.0) + 1, max(WIDEST_SMOOTH_PX, smooth_px))


def _smoothed(points_m: np.ndarray, valid: np.ndarray, window: int) -> np.ndarray:
    """(h, w, 3) points averaged over ``window`` x ``window`` valid neighbours."""
    size = (window, window)
    weight = cv2.blur(valid.astype(np.float64), size, borderType=cv2.BORDER_REFLECT)
    smooth = cv2.blur(np.where(valid[..., None], points_m, 0.0), size, borderType=cv2.BORDER_REFLECT)
    mean: np.ndarray = smooth / np.maximum(weight, 1e-12)[..., None]
    return mean


def _with_rim(
    cores: np.ndarray, number: int, valid: np.ndarray, right: np.ndarray, down: np.ndarray, reach: int
) -> np.ndarray:
    """One surface with its rim: smoothing, slope and comparison flag half + 1 + half pixels on each side of a crease or
    edge, given back where no step parts and no other surface's core lies."""
    core = cores == number
    near = cv2.dilate(core.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=reach) > 0
    free = valid & near & (core | (cores == 0))
    numbers, _ = kernels.components(free, right, down, 1)
    whole: np.ndarray = core | (numbers == 1)
    return whole


def _joined(own: np.ndarray, cores: np.ndarray, smooth: Smooth, apart_m: float, turn: float) -> np.ndarray:
    """``own`` with surfaces made one, in ``cores`` too, where the rims of two hold the same pixels and each one's plane
    goes on into the other's: a row of holes, or a strip lying across a board, parts its core and not the board.
    ``apart_m`` and ``turn`` (radians): the most by which the planes may differ."""
    stays = np.arange(len(own))
    for i in range(len(own)):
        for j in range(i + 1, len(own)):
            pixels = np.flatnonzero(own[i] & own[j])
            if len(pixels) < LEAST_SHARED_PX or stays[i] == stays[j]:
                continue
            seeds = [nearest_pixel(cores == number + 1)[1].reshape(-1)[pixels] for number in (i, j)]
            misses = np.maximum(*(smooth.misses_m(pixels, each) for each in seeds))
            cosines = np.prod([smooth.normals.reshape(-1, 3)[each] for each in seeds], axis=0).sum(axis=1)
            if np.median(misses) <= apart_m and np.median(cosines) >= math.cos(turn):
                stays[stays == stays[j]] = stays[i]
    kept = np.unique(stays)
    numbers = np.zeros(max(len(own), int(cores.max(initial=0))) + 1, dtype=cores.dtype)
    numbers[1 : len(own) + 1] = np.searchsorted(kept, stays) + 1
    cores[:] = numbers[cores]
    return np.array([own[stays == each].any(axis=0) for each in kept]) if len(own) else own


def _share_contested(own: np.ndarray, cores: np.ndarray, smooth: Smooth) -> None:
    """Give each pixel that the rims of several surfaces hold to the one whose plane, drawn on from its nearest core
    pixel, passes nearest."""
    contested = own.sum(axis=0) > 1
    if not contested.any():
        return
    pixels = np.flatnonzero(contested)
    misses = np.full((len(own), len(pixels)), np.inf)
    for number, mask in enumerate(own):
        holds = mask.reshape(-1)[pixels]
        if holds.any():
            seeds = nearest_pixel(cores == number + 1)[1].reshape(-1)[pixels[holds]]
            misses[number, holds] = smooth.misses_m(pixels[holds], seeds)
    winner = misses.argmin(axis=0)
    for number in range(len(own)):
        own[number].reshape(-1)[pixels[winner != number]] = False


def _trim_rims(
    own: np.ndarray, cores: np.ndarray, valid: np.ndarray, smooth: Smooth, window: int, half: int, apart_m: float
) -> None:
    """Take off each surface's rim what leaves the surface inside it, and what hangs on that alone.

    A camera's blur spreads a step of 25 mm over five pixels, so that no two neighbours are apart, and behind an edge
    that is tilted by 30 degrees a narrow strip of background leaves no crease in the smoothed surface either. A rim may
    be off the plane at the nearest pixel whose smoothing does not feel it by ``apart_m``, or, as seen from there, by
    `RIM_TURN_DEG` beside the angle that the bend before it leads to: a pipe goes on bending to its limb.
    """
    reach = window // 2 + 1 + half
    for number in range(len(own)):
        # the picture's edge is a rim too: what is cut off there may be a strip of background
        whole = np.pad(holes_filled(own[number] & valid), 1).astype(np.uint8)
        rim = own[number] & (cv2.erode(whole, np.ones((2 * reach + 1,) * 2, np.uint8))[1:-1, 1:-1] == 0)
        inner = cv2.erode(whole, np.ones((2 * reach + window,) * 2, np.uint8))[1:-1, 1:-1] > 0
        inner &= cv2.erode((cores == number + 1).astype(np.uint8), np.ones((window, window), np.uint8)) > 0
        if not inner.any():
            continue
        apart, nearest = nearest_pixel(inner)
        pixels = np.flatnonzero(rim & (apart <= 3 * reach))
        seeds = nearest.reshape(-1)[pixels]
        way = smooth.points_m.reshape(-1, 3)[pixels] - smooth.means_m.reshape(-1, 3)[seeds]
        distance = np.linalg.norm(way, axis=1)
        off = np.abs((way * smooth.normals.reshape(-1, 3)[seeds]).sum(axis=1))
        turn = math.radians(RIM_TURN_DEG) + smooth.bend_per_m(seeds, pixels, reach) * distance / 2.0
        allowed = np.maximum(apart_m, np.sin(np.minimum(turn, np.pi / 2)) * distance)
        own[number].reshape(-1)[pixels[off > allowed]] = False
        parts = cv2.connectedComponents(own[number].astype(np.uint8), connectivity=4)[1]
        own[number] &= np.isin(parts, np.unique(parts[inner]))


# ---------------------------------------------------------------- a raster where there is no pixel grid


def raster(points: np.ndarray, cloud: Cloud) -> tuple[Cloud, np.ndarray, np.ndarray, float]:
    """A grid that holds the nearest of points (n, 3) in each cell, with an empty border; each point's row and column;
    and the side of a cell in distances between neighbours.

    Seen from the camera, what shows through a hole lies inside its mouth, and what shows past the rim outside of it,
    however oblique the view.
    """
    plan = _plan(points)
    spacing = max(_spacing(plan), 1e-9)
    side = max(CELL_SPACINGS * spacing, float(np.ptp(plan, axis=0).max()) / MAX_RASTER)
    while _filled(plan, side) < CELLS_FILLED:
        side *= CELL_GROWTH
    columns, rows = (_cells(plan, side) + 1).T
    shape = (int(rows.max()) + 2, int(columns.max()) + 2)
    image = np.full((*shape, 3), np.nan)
    # of repeated indices numpy keeps the last
    far_first = np.argsort(-points[:, 2], kind="stable")
    image[rows[far_first], columns[far_first]] = points[far_first]
    none, zeros = np.full(shape, np.nan), np.zeros(shape, dtype=np.uint8)
    region = Region(0, shape[0], 0, shape[1])
    raster = Cloud(image, zeros, zeros.astype(int), none, region, cloud.z_step_m, cloud.n_frames)
    return raster, rows, columns, side / spacing


def _cells(plan: np.ndarray, side: float) -> np.ndarray:
    """(n, 2) column and row of each of places (n, 2)."""
    cells: np.ndarray = np.floor((plan - plan.min(axis=0)) / side).astype(int)
    return cells


def _filled(plan: np.ndarray, side: float) -> float:
    """Share of the cells that hold a place, of those in blocks of 2 x 2 that do, as do all eight blocks around them: a
    gap wider than a block is no lack of points. 1 where there are no such blocks."""
    columns, rows = _cells(plan, side).T
    held = np.zeros((2 * (rows.max() // 2 + 1), 2 * (columns.max() // 2 + 1)), dtype=bool)
    held[rows, columns] = True
    in_block = held.reshape(held.shape[0] // 2, 2, held.shape[1] // 2, 2).sum(axis=(1, 3))
    kernel = np.ones((3, 3), np.uint8)
    inner = cv2.erode((in_block > 0).astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    return float(in_block[inner].mean()) / 4.0 if inner.any() else 1.0


def _plan(points: np.ndarray) -> np.ndarray:
    """(n, 2) place of each point (n, 3) in the picture: x/z, y/z as the camera at the origin sees them, else x, y."""
    x_y, z = points[:, :2], points[:, 2:]
    if z.min() > 0 and float(np.abs(x_y / z).max()) < WIDEST_SLOPE:
        seen: np.ndarray = x_y / z
        return seen
    return x_y


def _spacing(places: np.ndarray) -> float:
    """What nine in ten of the distances to the nearest neighbour do not exceed, of some 2000 places (n, 2)."""
    from scipy.spatial import cKDTree

    some = places[:: max(1, len(places) // 2000)]
    to_nearest = cKDTree(places).query(some, k=min(2, len(places)))[0].reshape(len(some), -1)[:, -1]
    return float(np.quantile(to_nearest, 0.9))
