"""Finds the large connected smooth surfaces of a cloud. A pipe up to its limb is one; two faces of
a box are two."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numba
import numpy as np

from detectors.pixels.clusters import PLAIN
from detectors.pixels.masks import (
    components,
    grown,
    holes_filled,
    nearest_pixel,
    parts_with,
    shrunk,
)
from detectors.pixels.noise import quantile_of
from harness.vocabulary.geometry import MM, Cloud, Region

MAX_SURFACE_TILT = 6.0
STEP_SIGMAS = 6.0
"""tan(80.5 degrees): a steeper step is an edge. A step of fewer standard deviations of a
difference may be noise."""
BRIDGED_PX = 2  # largest distance from which a pixel without a return takes its point
SMOOTH_MM = 16.0
MIXED_PX = 3
"""Width of the window on a coarse grid, and half of the least number of pixels over which a bend
is judged."""
NORMAL_NOISE = 0.06
WIDEST_SMOOTH_PX = 41
"""Largest noise of the smoothed surface's slope, radians; noisier clouds use a wider window, up to
this one."""
# a surface with a smaller share of all pixels or fewer pixels is not a candidate
LEAST_SHARE = 0.004
LEAST_PX = 100
LEAST_SHARED_PX = 10  # pixels that the rims of two surfaces must share to be merged
CONTACT_MM = 5.0
CONTACT_SIGMAS = 3.0
"""Two surfaces touch at a common border if their step there is smaller; the noise of a difference
raises this limit."""
RIM_TURN_DEG = (
    10.0  # largest turn of a rim from the surface inside it, beyond the bend of that surface
)
MOST_SURFACES = 8
WIDE_PART = 0.1
"""Most surfaces; least share of pixels at the middle of a full window: a smoothed step has no such
pixel."""
WIDEST_SLOPE = 5.7
"""tan(80 degrees): no camera sees so far off its axis; a cloud with a larger slope was not
recorded from its origin."""
CELL_SPACINGS = 1.5
CELL_GROWTH = 1.25
CELLS_FILLED = 0.99
MAX_RASTER = 4096
"""Least side of a raster's cell in spacings; its growth until this share of cells hold a point;
most cells a side."""


@dataclass(frozen=True)
class Surfaces:
    """``own`` (n, h, w) bool: each surface's pixels, largest core first. ``filled`` (n, h, w)
    bool: the same with all that they enclose. ``contact_m``: smaller steps do not count.
    ``reach_px``: smoothing's reach from an edge."""

    own: np.ndarray
    filled: np.ndarray
    contact_m: float
    reach_px: int


def smooth_surfaces(cloud: Cloud, crease_deg: float, smooth_px: int) -> Surfaces:
    """Find the smooth surfaces of an organised cloud with windows of about ``smooth_px``, wider in
    noisy clouds."""
    points = np.array(cloud.points_m, np.float64)
    seen = cloud.valid
    valid = seen
    if seen.any() and not seen.all():
        apart, nearest = nearest_pixel(seen)
        valid = apart <= BRIDGED_PX
        gaps = valid & ~seen
        points[gaps] = points.reshape(-1, 3)[nearest[gaps]]
    # noise of a difference between neighbours, from the lowest quarter of the second differences
    # of z along rows (three quarters of the picture may be rubble): they have sqrt(6) of white
    # noise's sigma,
    # first differences sqrt(2)
    z = np.ascontiguousarray(cloud.points_m[..., 2])
    bends = np.abs(z[:, 2:] - 2.0 * z[:, 1:-1] + z[:, :-2])
    bends = bends[np.isfinite(bends)]
    noise_m = quantile_of(bends, 0.25) / 0.3186 * np.sqrt(2.0 / 6.0) if len(bends) else 0.0
    noise_m = max(noise_m, cloud.z_step_m * np.sqrt(2.0 / 12.0))
    # the lateral distance of neighbours in the nearest tenth of the view
    steps = np.hypot(np.diff(points[::4, :, 0], axis=1), np.diff(points[::4, :, 1], axis=1))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    pitch_m = quantile_of(steps, 0.1) if len(steps) else 0.0
    window = smooth_px
    half = max(smooth_px // 2, 1)
    if pitch_m:
        # a central difference of the mean of n x n pixels has noise_m / (sqrt(2) n^1.5 pitch)
        by_noise = (noise_m / (math.sqrt(2.0) * NORMAL_NOISE * pitch_m)) ** (2.0 / 3.0)
        wanted = max(min(smooth_px, SMOOTH_MM * MM / pitch_m), by_noise, 3.0)
        window = min(2 * int(wanted / 2.0) + 1, max(WIDEST_SMOOTH_PX, smooth_px))
        # a camera that interpolates spreads a step over several pixels: on a coarse grid, over
        # more than the window
        half = max(window // 2, min(MIXED_PX, int(0.75 * SMOOTH_MM * MM / pitch_m)), 1)

    size = (window, window)
    weight = cv2.blur(valid.astype(np.float64), size, borderType=cv2.BORDER_REFLECT)
    filled = points.copy()
    filled[~valid] = 0.0
    smooth = cv2.blur(filled, size, borderType=cv2.BORDER_REFLECT)
    smooth = np.asarray(smooth / np.maximum(weight, 1e-12)[..., None])
    # whether the grid samples rays through the origin, as a camera does
    central = cloud.projection == "central" and _before_lens(points)
    if noise_m <= pitch_m:
        right, down = links(points, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m, central)
    else:
        # single points would need a tolerance so wide that it joins separate surfaces
        known = np.where(valid[..., None], smooth, np.nan)
        right, down = links(known, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m / window, central)
    normals = unit_normals(smooth)
    bent = turns(normals, half, math.cos(math.radians(crease_deg)))
    cores, sizes = components(valid & ~bent, right, down)
    count = _keep_large(cores, sizes, window)

    # smoothing, slope and comparison flag ``reach`` pixels beside a crease or edge: they are given
    # back if no step and no other surface's core separates them from the core
    reach = window // 2 + 1 + half
    own = np.zeros((count, *valid.shape), dtype=bool)
    for number, mask in enumerate(own, start=1):
        core = cores == number
        free = valid & grown(core, reach) & (core | (cores == 0))
        mask[:] = core | (components(free, right, down)[0] == 1)
    local = _Smooth(points.reshape(-1, 3), smooth.reshape(-1, 3), normals.reshape(-1, 3), central)
    contact_m = max(CONTACT_MM * MM, CONTACT_SIGMAS * noise_m)
    own = _joined(own, cores, local, contact_m, math.radians(crease_deg / 2.0))
    _share_contested(own, cores, local)
    _trim_rims(own, cores, seen, local, window, reach, contact_m)
    filled = np.array([holes_filled(each) for each in own]) if len(own) else own.copy()
    return Surfaces(own & seen, filled, contact_m, reach)


def _before_lens(points: np.ndarray) -> bool:
    """Return whether a camera at the origin may see all finite points (..., 3), and there are any."""
    x, y, z = np.moveaxis(points, -1, 0)
    beyond = (z <= 0) | (np.maximum(np.abs(x), np.abs(y)) >= WIDEST_SLOPE * z)
    return bool(np.isfinite(z).any() and not beyond.any())


@numba.njit(**PLAIN)
def links(
    points_m: np.ndarray, tilt: float, noise_m: float, central: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each of the pixels (h, w, 3) lies on one surface with its right (h, w) and
    its lower neighbour (h, w). ``central``: distances across are measured between the two rays at
    the nearer depth."""
    h, w, _ = points_m.shape
    linked = np.zeros((2, h, w), np.bool_)
    for v in range(h):
        for u in range(w):
            for way in range(2):
                row = v + way
                column = u + 1 - way
                if row < h and column < w:
                    here = points_m[v, u]
                    there = points_m[row, column]
                    ours = 1.0
                    theirs = 1.0
                    if central:
                        ours = min(there[2] / here[2], 1.0)
                        theirs = min(here[2] / there[2], 1.0)
                    dx = there[0] * theirs - here[0] * ours
                    dy = there[1] * theirs - here[1] * ours
                    linked[way, v, u] = (
                        abs(there[2] - here[2]) <= tilt * math.sqrt(dx * dx + dy * dy) + noise_m
                    )
    return linked[0], linked[1]


@numba.njit(**PLAIN)
def unit_normals(surface_m: np.ndarray) -> np.ndarray:
    """Return the normals (h, w, 3) of a surface's points (h, w, 3), from central differences; 0 if
    the area is 0."""
    h, w, _ = surface_m.shape
    normals = np.zeros((h, w, 3))
    along = np.empty(3)
    down = np.empty(3)
    for v in range(h):
        above = max(v - 1, 0)
        below = min(v + 1, h - 1)
        for u in range(w):
            left = max(u - 1, 0)
            right = min(u + 1, w - 1)
            for k in range(3):  # the length of either step does not matter
                along[k] = surface_m[v, right, k] - surface_m[v, left, k]
                down[k] = surface_m[below, u, k] - surface_m[above, u, k]
            x = along[1] * down[2] - along[2] * down[1]
            y = along[2] * down[0] - along[0] * down[2]
            z = along[0] * down[1] - along[1] * down[0]
            length = max(math.sqrt(x * x + y * y + z * z), 1e-15)
            normals[v, u, 0], normals[v, u, 1], normals[v, u, 2] = (
                x / length,
                y / length,
                z / length,
            )
    return normals


def turns(normals: np.ndarray, half: int, least_cosine: float) -> np.ndarray:
    """Return (h, w) bool: whether the unit normals ``half`` pixels to either side enclose a wider
    angle."""
    turned = np.zeros(normals.shape[:2], dtype=bool)
    for ahead, middle, back in (
        (np.s_[2 * half :], np.s_[half:-half], np.s_[: -2 * half]),
        (np.s_[:, 2 * half :], np.s_[:, half:-half], np.s_[:, : -2 * half]),
    ):
        turned[middle] |= np.einsum("ijk,ijk->ij", normals[ahead], normals[back]) < least_cosine
    return turned


class _Smooth(NamedTuple):
    """Points (n, 3), their local means, the unit normals of the means, and whether rays meet in
    the origin."""

    points_m: np.ndarray
    means_m: np.ndarray
    normals: np.ndarray
    central: bool

    def misses_m(self, pixels: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Return the distances in depth (n,) of the points at ``pixels`` from the planes at
        ``seeds``."""
        points = self.points_m[pixels]
        normals = self.normals[seeds]
        height = ((self.means_m[seeds] - points) * normals).sum(axis=1)
        way = points / points[:, 2:] if self.central else np.array([[0.0, 0.0, 1.0]])
        return np.abs(height) / np.maximum(np.abs((normals * way).sum(axis=1)), 1e-3)


def _keep_large(cores: np.ndarray, sizes: np.ndarray, window: int) -> int:
    """Return the number of candidates: cores that are large enough, and wider than the ramp of a
    smoothed edge."""
    large = int((sizes >= max(LEAST_PX, int(LEAST_SHARE * cores.size))).sum())
    kept = []
    for number in range(1, min(large, 4 * MOST_SURFACES) + 1):
        core = cores == number
        u, v, width, height = cv2.boundingRect(core.view(np.uint8))
        whole = holes_filled(core[v : v + height, u : u + width], rim_px=1)
        if np.count_nonzero(shrunk(whole, window)) >= WIDE_PART * np.count_nonzero(whole):
            kept.append(number)
    if not kept and len(sizes):
        kept = [1]
    kept = kept[:MOST_SURFACES]
    new = np.zeros(len(sizes) + 1, dtype=cores.dtype)
    new[kept] = np.arange(1, len(kept) + 1)
    cores[:] = new[cores]
    return len(kept)


def _joined(
    own: np.ndarray, cores: np.ndarray, smooth: _Smooth, apart_m: float, turn: float
) -> np.ndarray:
    """Return ``own`` with surfaces merged, also in ``cores``, if their rims share pixels and their
    planes agree."""
    stays = np.arange(len(own))
    for i in range(len(own)):
        for j in range(i + 1, len(own)):
            pixels = np.flatnonzero(own[i] & own[j])
            if len(pixels) < LEAST_SHARED_PX or stays[i] == stays[j]:
                continue
            seeds = [nearest_pixel(cores == number + 1)[1].reshape(-1)[pixels] for number in (i, j)]
            misses = np.maximum(*(smooth.misses_m(pixels, each) for each in seeds))
            cosines = (smooth.normals[seeds[0]] * smooth.normals[seeds[1]]).sum(axis=1)
            if np.median(misses) <= apart_m and np.median(cosines) >= math.cos(turn):
                stays[stays == stays[j]] = stays[i]
    kept = np.unique(stays)
    numbers = np.zeros(max(len(own), int(cores.max(initial=0))) + 1, dtype=cores.dtype)
    numbers[1 : len(own) + 1] = np.searchsorted(kept, stays) + 1
    cores[:] = numbers[cores]
    return np.array([own[stays == each].any(axis=0) for each in kept]) if len(own) else own


def _share_contested(own: np.ndarray, cores: np.ndarray, smooth: _Smooth) -> None:
    """Give each pixel of several rims to the surface whose plane, extended from its core, is
    nearest."""
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
    own: np.ndarray,
    cores: np.ndarray,
    valid: np.ndarray,
    smooth: _Smooth,
    window: int,
    reach: int,
    apart_m: float,
) -> None:
    """Remove the parts of each surface's rim that depart from the surface inside, and pixels
    connected only by them."""
    points, means, normals, _ = smooth
    for number in range(len(own)):
        # the picture's edge is a rim too: a strip of background may lie there
        whole = holes_filled(own[number] & valid, rim_px=1)
        rim = own[number] & ~shrunk(whole, 2 * reach + 1)[1:-1, 1:-1]
        inner = shrunk(whole, 2 * reach + window)[1:-1, 1:-1] & shrunk(cores == number + 1, window)
        if not inner.any():
            continue
        apart, nearest = nearest_pixel(inner)
        pixels = np.flatnonzero(rim & (apart <= 3 * reach))
        leaves = _leaves(
            pixels,
            nearest.reshape(-1)[pixels],
            points,
            means,
            normals,
            *valid.shape,
            reach,
            apart_m,
        )
        own[number].reshape(-1)[pixels[leaves]] = False
        own[number] = parts_with(own[number], inner, connectivity=4)


@numba.njit(**PLAIN)
def _leaves(pixels, seeds, points, means, normals, h, w, reach, apart_m):  # type: ignore[no-untyped-def]
    """Return whether each of the pixels (n,) departs from the surface at its seed (n,) farther
    inside."""
    found = np.zeros(len(pixels), np.bool_)
    for i in range(len(pixels)):
        pixel = pixels[i]
        seed = seeds[i]
        row = seed // w
        column = seed % w
        down = row - pixel // w
        across = column - pixel % w
        step = reach / max(math.sqrt(down**2 + across**2), 1.0)
        # the bend of the surface over the same distance inwards, radians per metre
        end = min(max(round(row + down * step), 0), h - 1) * w + min(
            max(round(column + across * step), 0), w - 1
        )
        off = distance = cosine = span = 0.0
        for k in range(3):
            off += (points[pixel, k] - means[seed, k]) * normals[seed, k]
            distance += (points[pixel, k] - means[seed, k]) ** 2
            cosine += normals[seed, k] * normals[end, k]
            span += (means[seed, k] - means[end, k]) ** 2
        bend = math.acos(min(max(cosine, 0.0), 1.0)) / max(math.sqrt(span), 1e-9)
        turn = min(math.radians(RIM_TURN_DEG) + bend * math.sqrt(distance) / 2.0, math.pi / 2.0)
        found[i] = abs(off) > max(apart_m, math.sin(turn) * math.sqrt(distance))
    return found


def raster(points: np.ndarray, cloud: Cloud) -> tuple[Cloud, np.ndarray, np.ndarray, float]:
    """Return a grid with an empty border that holds, in each cell, the nearest of the points (n,
    3); each point's row and column; and the side of a cell in distances between neighbours."""
    from scipy.spatial import cKDTree

    plan = points[:, :2]
    z = points[:, 2:]
    if _before_lens(points):
        plan = plan / z
    # the 90th percentile of the distances to the nearest neighbour, from about 2000 places
    some = plan[:: max(1, len(plan) // 2000)]
    to_nearest = cKDTree(plan).query(some, k=min(2, len(plan)))[0].reshape(len(some), -1)[:, -1]
    spacing = max(float(np.quantile(to_nearest, 0.9)), 1e-9)
    side = max(CELL_SPACINGS * spacing, float(np.ptp(plan, axis=0).max()) / MAX_RASTER)
    while True:
        columns, rows = np.floor((plan - plan.min(axis=0)) / side).astype(int).T
        # share of filled cells in blocks of 2 x 2 that hold a place and whose eight neighbours do:
        # a gap that is wider than a block does not come from a lack of points
        held = np.zeros((2 * (rows.max() // 2 + 1), 2 * (columns.max() // 2 + 1)), dtype=bool)
        held[rows, columns] = True
        in_block = held.reshape(held.shape[0] // 2, 2, held.shape[1] // 2, 2).sum(axis=(1, 3))
        inner = shrunk(np.pad(in_block > 0, 1), 3)[1:-1, 1:-1]
        if not inner.any() or float(in_block[inner].mean()) / 4.0 >= CELLS_FILLED:
            break
        side *= CELL_GROWTH
    rows = rows + 1
    columns = columns + 1
    shape = (int(rows.max()) + 2, int(columns.max()) + 2)
    image = np.full((*shape, 3), np.nan)
    # numpy keeps the last value of a repeated index
    far_first = np.argsort(-points[:, 2], kind="stable")
    image[rows[far_first], columns[far_first]] = points[far_first]
    none = np.full(shape, np.nan)
    zeros = np.zeros(shape, dtype=np.uint8)
    region = Region(0, shape[0], 0, shape[1])
    grid = Cloud(image, zeros, zeros.astype(int), none, region, cloud.z_step_m, cloud.n_frames)
    return grid, rows, columns, side / spacing
