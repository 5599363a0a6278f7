"""The large connected smooth surfaces of a cloud, each with its outline.

Neighbours are joined where the step in depth is no more than a tilted surface and noise explain and the surface does
not bend sharply; so a pipe seen to its limb is a surface, and two faces of a box are two.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from detectors.masks import components, grown, holes_filled, nearest_pixel, parts_with, shrunk
from detectors.noise import quantile_of
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import Region
from harness.vocabulary.units import MM

MAX_SURFACE_TILT = 6.0
"""tan(80.5 degrees): a steeper step between neighbouring pixels is an edge, not a surface."""
STEP_SIGMAS = 6.0
"""A step below so many standard deviations of a difference between neighbours may be noise."""
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
"""A surface with a smaller share of all pixels, or fewer pixels, is no candidate. A board of 150 x 100 mm at 1.5 m
holds 0.5 % of an Azure Kinect's view."""
LEAST_SHARED_PX = 10
"""Pixels that the rims of two surfaces must share to be judged as one."""
CONTACT_MM, CONTACT_SIGMAS = 5.0, 3.0
"""Surfaces nearer to one another at a common border meet there; noise of a difference widens that."""
RIM_TURN_DEG = 10.0
"""A rim turns from the surface inside it by no more, beside what that surface bends by: five times what noise may give
a slope (`NORMAL_NOISE`, over the way to the rim), and a third of what a blurred step of 25 mm over 5 pixels does."""
MOST_SURFACES = 8
WIDE_PART = 0.1
"""Least share of a surface's pixels that are the middle of a full smoothing window of its own. The smoothing makes a
ramp of every step in depth, no wider than the window, which is no surface."""
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
    an edge the smoothing is felt. ``contact_m``: a smaller step between two surfaces is none."""

    own: np.ndarray
    filled: np.ndarray
    noise_m: float
    reach_px: int

    @property
    def contact_m(self) -> float:
        """Limit of a step, metres."""
        return max(CONTACT_MM * MM, CONTACT_SIGMAS * self.noise_m)


def smooth_surfaces(cloud: Cloud, crease_deg: float, smooth_px: int) -> Surfaces:
    """Find the smooth surfaces of an organised cloud. ``smooth_px`` is the window's width; a coarse grid takes a
    narrower window (`SMOOTH_MM`), noise a wider one (`NORMAL_NOISE`)."""
    points, seen = cloud.points_m, cloud.valid
    valid = seen
    if seen.any() and not seen.all():
        apart, nearest = nearest_pixel(seen)
        valid = apart <= BRIDGED_PX
        gaps = valid & ~seen
        points = points.copy()
        points[gaps] = cloud.points_m.reshape(-1, 3)[nearest[gaps]]
    # the noise of a difference between neighbours, from the quieter quarter of the second differences of z along rows
    # (three quarters of the picture may be rubble), which have sqrt(6) of white noise's sigma; the first have sqrt(2)
    z = np.ascontiguousarray(cloud.points_m[..., 2])
    bends = np.abs(z[:, 2:] - 2.0 * z[:, 1:-1] + z[:, :-2])
    bends = bends[np.isfinite(bends)]
    noise_m = quantile_of(bends, 0.25) / 0.3186 * np.sqrt(2.0 / 6.0) if len(bends) else 0.0
    noise_m = max(noise_m, cloud.z_step_m * np.sqrt(2.0 / 12.0))
    # the distance of neighbours across the view at the nearest tenth of it
    steps = np.hypot(np.diff(points[::4, :, 0], axis=1), np.diff(points[::4, :, 1], axis=1))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    pitch_m = quantile_of(steps, 0.1) if len(steps) else 0.0
    window, half = smooth_px, max(smooth_px // 2, 1)
    if pitch_m:
        # a central difference of the mean of n x n pixels has noise_m / (sqrt(2) n^1.5 pitch)
        by_noise = (noise_m / (math.sqrt(2.0) * NORMAL_NOISE * pitch_m)) ** (2.0 / 3.0)
        wanted = max(min(smooth_px, SMOOTH_MM * MM / pitch_m), by_noise, 3.0)
        window = min(2 * int(wanted / 2.0) + 1, max(WIDEST_SMOOTH_PX, smooth_px))
        # a camera that interpolates spreads a step over some pixels: on a coarse grid, more than the window
        half = max(window // 2, min(MIXED_PX, int(0.75 * SMOOTH_MM * MM / pitch_m)), 1)

    size = (window, window)
    weight = cv2.blur(valid.astype(np.float64), size, borderType=cv2.BORDER_REFLECT)
    smooth = cv2.blur(np.where(valid[..., None], points, 0.0), size, borderType=cv2.BORDER_REFLECT)
    smooth = np.asarray(smooth / np.maximum(weight, 1e-12)[..., None])
    central = sees_from_origin(cloud)
    if noise_m <= pitch_m:
        right, down = links(points, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m, central)
    else:
        # single points would need so wide a tolerance that it joins what stands apart
        known = np.where(valid[..., None], smooth, np.nan)
        right, down = links(known, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m / window, central)
    normals = unit_normals(smooth)
    bent = turns(normals, half, math.cos(math.radians(crease_deg)))
    cores, sizes = components(valid & ~bent, right, down)
    count = _keep_large(cores, sizes, window)

    # smoothing, slope and comparison flag so many pixels on each side of a crease or edge: given back where no step
    # parts them from the core and no other surface's core lies
    reach = window // 2 + 1 + half
    own = np.zeros((count, *valid.shape), dtype=bool)
    for number, mask in enumerate(own, start=1):
        core = cores == number
        free = valid & grown(core, reach) & (core | (cores == 0))
        mask[:] = core | (components(free, right, down)[0] == 1)
    local = _Smooth(points, smooth, normals, central)
    found = Surfaces(own, own, noise_m, reach)
    own = _joined(own, cores, local, found.contact_m, math.radians(crease_deg / 2.0))
    _share_contested(own, cores, local)
    _trim_rims(own, cores, seen, local, window, reach, found.contact_m)
    filled = np.array([holes_filled(each) for each in own]) if len(own) else own.copy()
    return Surfaces(own & seen, filled, noise_m, reach)


def sees_from_origin(cloud: Cloud) -> bool:
    """Return whether the cloud's grid samples rays through the origin, as a camera does."""
    if cloud.projection != "central":
        return False
    x, y, z = (cloud.points_m[..., k][cloud.valid] for k in range(3))
    return bool(len(z)) and bool(z.min() > 0) and float(max(np.abs(x / z).max(), np.abs(y / z).max())) < WIDEST_SLOPE


# ---------------------------------------------------------------- neighbours


def links(points_m: np.ndarray, tilt: float, noise_m: float, central: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each of the pixels (h, w, 3) lies on one surface with its right (h, w) and its lower neighbour
    (h, w): both have a point, and z changes by no more than a surface of that tilt and noise explain.

    ``central``: the way across is measured between the two rays at the nearer depth, so that a step in depth, which
    off the axis moves x and y too, does not pass for a way across.
    """
    x, y, z = (np.ascontiguousarray(points_m[..., k]) for k in range(3))
    if central:
        with np.errstate(invalid="ignore", divide="ignore"):
            x, y = x / z, y / z
    right, down = np.zeros(z.shape, dtype=bool), np.zeros(z.shape, dtype=bool)
    for axis, linked in ((1, right[:, :-1]), (0, down[:-1])):
        a, b = (np.s_[:, :-1], np.s_[:, 1:]) if axis == 1 else (np.s_[:-1], np.s_[1:])
        dx, dy = x[b] - x[a], y[b] - y[a]
        if central:
            nearer = np.minimum(z[a], z[b])
            dx *= nearer
            dy *= nearer
        linked[:] = np.abs(z[b] - z[a]) <= tilt * np.sqrt(dx * dx + dy * dy) + noise_m
    return right, down


def unit_normals(surface_m: np.ndarray) -> np.ndarray:
    """Return the normals (h, w, 3) of a surface's points (h, w, 3), by central differences; 0 where it has no area."""
    across, downwards = (_slopes(surface_m, axis) for axis in (1, 0))
    (ux, uy, uz), (vx, vy, vz) = np.moveaxis(across, -1, 0), np.moveaxis(downwards, -1, 0)
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = np.maximum(np.sqrt(x * x + y * y + z * z), 1e-15)
    return np.stack([x / length, y / length, z / length], axis=-1)


def _slopes(surface_m: np.ndarray, axis: int) -> np.ndarray:
    return np.gradient(surface_m, axis=axis) if surface_m.shape[axis] > 1 else np.zeros_like(surface_m)


def turns(normals: np.ndarray, half: int, least_cosine: float) -> np.ndarray:
    """Return (h, w) bool: unit normals ``half`` pixels to the left and right, or above and below, enclose a wider
    angle."""
    h, w = normals.shape[:2]
    turned = np.zeros((h, w), dtype=bool)
    across = (normals[:, 2 * half :] * normals[:, : max(w - 2 * half, 0)]).sum(axis=-1)
    along = (normals[2 * half :] * normals[: max(h - 2 * half, 0)]).sum(axis=-1)
    turned[:, half : half + across.shape[1]] = across < least_cosine
    turned[half : half + along.shape[0]] |= along < least_cosine
    return turned


@dataclass(frozen=True)
class _Smooth:
    """Points (h, w, 3), their local means and the unit normals of these; and whether rays meet in the origin."""

    points_m: np.ndarray
    means_m: np.ndarray
    normals: np.ndarray
    central: bool

    def misses_m(self, pixels: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Return the distance in depth (n,) of the points at flat indices ``pixels`` from the planes through the means
        at ``seeds``."""
        points, normals = self.points_m.reshape(-1, 3)[pixels], self.normals.reshape(-1, 3)[seeds]
        height = ((self.means_m.reshape(-1, 3)[seeds] - points) * normals).sum(axis=1)
        way = points / points[:, 2:] if self.central else np.array([[0.0, 0.0, 1.0]])
        return np.abs(height) / np.maximum(np.abs((normals * way).sum(axis=1)), 1e-3)


# ---------------------------------------------------------------- from cores to surfaces


def _keep_large(cores: np.ndarray, sizes: np.ndarray, window: int) -> int:
    """Return the number of candidates: cores that are large enough and wider than the smoothing's ramp at an edge, at
    most `MOST_SURFACES`, and the largest in any case. They are numbered anew in ``cores``, all others 0."""
    large = int((sizes >= max(LEAST_PX, int(LEAST_SHARE * cores.size))).sum())
    kept = []
    for number in range(1, min(large, 4 * MOST_SURFACES) + 1):
        whole = np.pad(holes_filled(cores == number), 1)
        if np.count_nonzero(shrunk(whole, window)) >= WIDE_PART * np.count_nonzero(whole):
            kept.append(number)
    if not kept and len(sizes):
        kept = [1]
    kept = kept[:MOST_SURFACES]
    new = np.zeros(len(sizes) + 1, dtype=cores.dtype)
    new[kept] = np.arange(1, len(kept) + 1)
    cores[:] = new[cores]
    return len(kept)


def _joined(own: np.ndarray, cores: np.ndarray, smooth: _Smooth, apart_m: float, turn: float) -> np.ndarray:
    """Return ``own`` with surfaces made one, in ``cores`` too, where the rims of two hold the same pixels and the plane
    of each goes on into the other's: a row of holes, or a strip lying across a board, parts its core and not the board.
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


def _share_contested(own: np.ndarray, cores: np.ndarray, smooth: _Smooth) -> None:
    """Give each pixel that the rims of several surfaces hold to the surface whose plane, drawn on from its nearest core
    pixel, passes nearest."""
    pixels = np.flatnonzero(own.sum(axis=0) > 1)
    if not len(pixels):
        return
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
    own: np.ndarray, cores: np.ndarray, valid: np.ndarray, smooth: _Smooth, window: int, reach: int, apart_m: float
) -> None:
    """Take off each surface's rim what leaves the surface inside it, and what hangs on that alone.

    A camera's blur spreads a step of 25 mm over five pixels, so that no two neighbours are apart, and behind an edge
    that is tilted by 30 degrees a narrow strip of background leaves no crease in the smoothed surface either. A rim may
    be off the plane at the nearest pixel whose smoothing does not feel it by ``apart_m``, or, as seen from there, by
    `RIM_TURN_DEG` beside the angle that the bend before it leads to: a pipe goes on bending to its limb.
    """
    height, width = valid.shape
    points, means, normals = (each.reshape(-1, 3) for each in (smooth.points_m, smooth.means_m, smooth.normals))
    for number in range(len(own)):
        # the picture's edge is a rim too: what is cut off there may be a strip of background
        whole = np.pad(holes_filled(own[number] & valid), 1)
        rim = own[number] & ~shrunk(whole, 2 * reach + 1)[1:-1, 1:-1]
        inner = shrunk(whole, 2 * reach + window)[1:-1, 1:-1] & shrunk(cores == number + 1, window)
        if not inner.any():
            continue
        apart, nearest = nearest_pixel(inner)
        pixels = np.flatnonzero(rim & (apart <= 3 * reach))
        seeds = nearest.reshape(-1)[pixels]
        way = points[pixels] - means[seeds]
        distance = np.linalg.norm(way, axis=1)
        off = np.abs((way * normals[seeds]).sum(axis=1))
        # the bend of the surface over as many pixels inwards, radians per metre
        rows, columns = np.divmod(seeds, width)
        down, across = rows - pixels // width, columns - pixels % width
        steps = reach / np.maximum(np.hypot(down, across), 1.0)
        inwards = np.clip(np.rint(rows + steps * down), 0, height - 1).astype(np.int64) * width
        inwards += np.clip(np.rint(columns + steps * across), 0, width - 1).astype(np.int64)
        cosine = np.clip((normals[seeds] * normals[inwards]).sum(axis=1), 0.0, 1.0)
        bend = np.arccos(cosine) / np.maximum(np.linalg.norm(means[seeds] - means[inwards], axis=1), 1e-9)
        turn = math.radians(RIM_TURN_DEG) + bend * distance / 2.0
        allowed = np.maximum(apart_m, np.sin(np.minimum(turn, np.pi / 2)) * distance)
        own[number].reshape(-1)[pixels[off > allowed]] = False
        own[number] = parts_with(own[number], inner, connectivity=4)


# ---------------------------------------------------------------- a raster where there is no pixel grid


def raster(points: np.ndarray, cloud: Cloud) -> tuple[Cloud, np.ndarray, np.ndarray, float]:
    """Return a grid that holds the nearest of points (n, 3) in each cell, with an empty border; each point's row and
    column; and the side of a cell in distances between neighbours.

    The plan is x/z, y/z as the camera at the origin sees the points, else x, y. Seen from the camera, what shows
    through a hole lies inside its mouth, and what shows past the rim outside of it, however oblique the view.
    """
    from scipy.spatial import cKDTree

    plan, z = points[:, :2], points[:, 2:]
    if z.min() > 0 and float(np.abs(plan / z).max()) < WIDEST_SLOPE:
        plan = plan / z
    # what nine in ten of the distances to the nearest neighbour do not exceed, of some 2000 places
    some = plan[:: max(1, len(plan) // 2000)]
    to_nearest = cKDTree(plan).query(some, k=min(2, len(plan)))[0].reshape(len(some), -1)[:, -1]
    spacing = max(float(np.quantile(to_nearest, 0.9)), 1e-9)
    side = max(CELL_SPACINGS * spacing, float(np.ptp(plan, axis=0).max()) / MAX_RASTER)
    while True:
        columns, rows = np.floor((plan - plan.min(axis=0)) / side).astype(int).T
        # share of the cells that hold a place, of those in blocks of 2 x 2 that do, as do all eight blocks around
        # them: a gap wider than a block is no lack of points
        held = np.zeros((2 * (rows.max() // 2 + 1), 2 * (columns.max() // 2 + 1)), dtype=bool)
        held[rows, columns] = True
        in_block = held.reshape(held.shape[0] // 2, 2, held.shape[1] // 2, 2).sum(axis=(1, 3))
        inner = shrunk(np.pad(in_block > 0, 1), 3)[1:-1, 1:-1]
        if not inner.any() or float(in_block[inner].mean()) / 4.0 >= CELLS_FILLED:
            break
        side *= CELL_GROWTH
    rows, columns = rows + 1, columns + 1
    shape = (int(rows.max()) + 2, int(columns.max()) + 2)
    image = np.full((*shape, 3), np.nan)
    # of repeated indices numpy keeps the last
    far_first = np.argsort(-points[:, 2], kind="stable")
    image[rows[far_first], columns[far_first]] = points[far_first]
    none, zeros = np.full(shape, np.nan), np.zeros(shape, dtype=np.uint8)
    region = Region(0, shape[0], 0, shape[1])
    grid = Cloud(image, zeros, zeros.astype(int), none, region, cloud.z_step_m, cloud.n_frames)
    return grid, rows, columns, side / spacing
