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
from detectors.surfaces.faces import extruded_faces
from detectors.surfaces.pieces import joined_pieces
from harness.vocabulary.geometry import MM, Cloud, Region

MAX_SURFACE_TILT = 6.0  # tan(80.5 degrees): a steeper step is an edge
STEP_SIGMAS = 6.0
"""A step of fewer standard deviations of a difference may be noise."""
BRIDGED_PX = 2  # largest distance from which a pixel without a return takes its point
SMOOTH_MM = 16.0  # width of the window on a coarse grid
MIXED_PX = 3
"""Half of the least number of pixels over which a bend is judged."""
NORMAL_NOISE = 0.06  # largest noise of the smoothed surface's slope, radians
WIDEST_SMOOTH_PX = 41
"""Widest window; noisier clouds use a wider one up to this."""
# a surface with a smaller share of all pixels or fewer pixels is not a candidate
LEAST_SHARE = 0.004
LEAST_PX = 100
LEAST_SHARED_PX = 10  # pixels that the rims of two surfaces must share to be merged
CONTACT_MM = 5.0  # two surfaces touch at a common border if their step there is smaller
CONTACT_SIGMAS = 3.0
"""Least limit of such a step, in standard deviations of a difference."""
RIM_TURN_DEG = 10.0
"""Largest turn of a rim from the surface inside it, beyond the bend of that surface."""
MOST_SURFACES = 8
FACES_FROM = 1.1
"""Least area without a step, in areas of a surface, in which further faces are sought."""
MOST_PIECES = 24
"""Most further pieces that are compared with the surfaces."""
WIDE_PART = 0.1
"""Least share of pixels at the middle of a full window: a smoothed step has no such pixel."""
WIDEST_SLOPE = 5.7
"""tan(80 degrees): no camera sees so far off its axis; a cloud with a larger slope was not
recorded from its origin."""
CELL_SPACINGS = 1.5  # least side of a raster's cell in spacings
CELL_GROWTH = 1.25  # its growth until enough cells hold a point
CELLS_FILLED = 0.99  # enough
MAX_RASTER = 4096
"""Most cells a side."""


@dataclass(frozen=True)
class Surfaces:
    """The smooth surfaces of a cloud, largest core first."""

    # each surface's pixels (n, h, w) bool
    masks: np.ndarray
    # the same with all that they enclose (n, h, w) bool
    filled: np.ndarray
    # smaller steps between surfaces do not count, metres
    contact_m: float
    # smoothing's reach from an edge
    reach_px: int


def smooth_surfaces(cloud: Cloud, crease_deg: float, smooth_px: int) -> Surfaces:
    """Find the smooth surfaces of an organised cloud with windows of about ``smooth_px``, wider in
    noisy clouds."""
    has_return = cloud.valid
    points, valid = _bridged(cloud)
    noise_m = _step_noise_m(cloud)
    pitch_m = _pitch_m(points)
    window, half = _windows(pitch_m, noise_m, smooth_px)

    size = (window, window)
    weight = cv2.blur(valid.astype(np.float64), size, borderType=cv2.BORDER_REFLECT)
    smooth = points.copy()
    smooth[~valid] = 0.0
    smooth = cv2.blur(smooth, size, borderType=cv2.BORDER_REFLECT)
    smooth = np.asarray(smooth / np.maximum(weight, 1e-12)[..., None])
    # whether the grid samples rays through the origin, as a camera does
    central = cloud.projection == "central" and _before_lens(points)
    if noise_m <= pitch_m:
        right, down = links(points, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m, central)
    else:
        # single points would need a tolerance so wide that it joins separate surfaces
        known_m = np.where(valid[..., None], smooth, np.nan)
        right, down = links(known_m, MAX_SURFACE_TILT, STEP_SIGMAS * noise_m / window, central)
    normals = unit_normals(smooth)
    bent = turns(normals, half, math.cos(math.radians(crease_deg)))
    cores, sizes = components(valid & ~bent, right, down)
    small = cores.copy()
    count = _keep_large(cores, sizes, window)
    small[cores > 0] = 0

    # smoothing, slope and comparison flag ``reach`` pixels beside a crease or edge: they are given
    # back if no step and no other surface's core separates them from the core
    reach = window // 2 + 1 + half
    masks = np.zeros((count, *valid.shape), dtype=bool)
    for number, mask in enumerate(masks, start=1):
        core = cores == number
        free = valid & grown(core, reach) & (core | (cores == 0))
        mask[:] = core | (components(free, right, down)[0] == 1)
    local = _Smooth(
        points_m=points.reshape(-1, 3),
        means_m=smooth.reshape(-1, 3),
        normals=normals.reshape(-1, 3),
        central=central,
    )
    contact_m = max(CONTACT_MM * MM, CONTACT_SIGMAS * noise_m)
    masks = _joined(masks, cores, local, contact_m, math.radians(crease_deg / 2.0))
    _share_contested(masks, cores, local)
    _trim_rims(masks, cores, has_return, local, window, reach, contact_m)
    seen_m = np.where(valid[..., None], points, np.nan)
    masks = _with_pieces(masks, small, seen_m, contact_m, reach)
    unbroken = components(valid, right, down)[0]
    masks = _with_faces(
        masks,
        unbroken,
        seen_m,
        apart_m=contact_m,
        crease_deg=crease_deg,
        central=central,
        reach=reach,
    )
    filled = masks.copy()
    for number, mask in enumerate(masks):
        filled[number] = holes_filled(mask)
    return Surfaces(masks & has_return, filled, contact_m, reach)


def _with_pieces(
    masks: np.ndarray,
    small: np.ndarray,
    points_m: np.ndarray,
    apart_m: float,
    reach: int,
) -> np.ndarray:
    """Return the surfaces with those joined that are pieces of one, and with further pieces among
    the ``small`` cores (h, w), which are numbered."""
    if not len(masks):
        return masks
    sizes = np.bincount(small.ravel())
    sizes[0] = 0
    numbers = np.argsort(-sizes, kind="stable")[:MOST_PIECES]
    numbers = numbers[sizes[numbers] >= LEAST_PX]
    taken = masks.any(axis=0)
    pieces = list(masks)
    for number in numbers:
        grown_core = grown(small == number, reach) & ~taken & np.isfinite(points_m[..., 2])
        pieces.append(grown_core)
    groups = joined_pieces(pieces, points_m, apart_m, surfaces=len(masks))
    surfaces = []
    for group in groups:
        surfaces.append(np.logical_or.reduce([pieces[number] for number in group]))
    return np.array(surfaces)


def _with_faces(
    masks: np.ndarray,
    unbroken: np.ndarray,
    points_m: np.ndarray,
    apart_m: float,
    crease_deg: float,
    central: bool,
    reach: int,
) -> np.ndarray:
    """Return the surfaces, each with all faces of the extruded part of which it is one: a sheet's
    flats and webs. ``unbroken`` (h, w): numbers of the areas without a step, which end no surface
    at a crease.

    What is no wider than the smoothing's ``reach`` on both sides is no face: beside a rim, the
    lens's blur and the camera's filter make such a ramp to a strip of what lies a little behind."""
    surfaces = list(masks)
    for number in _areas_of(masks, unbroken):
        area = unbroken == number
        shared = [np.count_nonzero(surface & area) for surface in surfaces]
        largest = surfaces[int(np.argmax(shared))]
        if np.count_nonzero(area) <= FACES_FROM * max(shared):
            continue
        if not _is_wide(area & ~largest, reach):
            continue
        part = extruded_faces(area, largest, points_m, apart_m, crease_deg, central)
        if part is not None and _is_wide(part & ~largest, reach):
            part = part | largest
            surfaces = [part, *[surface for surface in surfaces if not _lies_in(surface, part)]]
    return np.array(surfaces).reshape(-1, *unbroken.shape)


def _is_wide(faces: np.ndarray, reach: int) -> bool:
    """Return whether a place in the mask (h, w) is farther than ``reach`` pixels from its rim, to
    which the picture's edge belongs."""
    inner = shrunk(np.pad(faces, 1), 2 * reach + 1)[1:-1, 1:-1]
    return bool(inner.any())


def _areas_of(masks: np.ndarray, unbroken: np.ndarray) -> list[int]:
    """Return the numbers of the areas (h, w) that include most of a surface."""
    numbers = []
    for mask in masks:
        counts = np.bincount(unbroken[mask], minlength=2)
        counts[0] = 0
        number = int(counts.argmax())
        if counts[number] > 0.5 * np.count_nonzero(mask) and number not in numbers:
            numbers.append(number)
    return numbers


def _lies_in(surface: np.ndarray, area: np.ndarray) -> bool:
    return bool(np.count_nonzero(surface & area) > 0.5 * np.count_nonzero(surface))


def _bridged(cloud: Cloud) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (h, w, 3) with those of near pixels in small gaps, and which are valid."""
    points = np.array(cloud.points_m, np.float64)
    has_return = cloud.valid
    if has_return.all() or not has_return.any():
        return points, has_return
    distance_px, nearest = nearest_pixel(has_return)
    valid = distance_px <= BRIDGED_PX
    gaps = valid & ~has_return
    points[gaps] = points.reshape(-1, 3)[nearest[gaps]]
    return points, valid


def _step_noise_m(cloud: Cloud) -> float:
    """Return the noise of a difference between neighbours, from the lowest quarter of the second
    differences of z along rows: three quarters of the picture may be rubble."""
    z = np.ascontiguousarray(cloud.points_m[..., 2])
    bends = np.abs(z[:, 2:] - 2.0 * z[:, 1:-1] + z[:, :-2])
    bends = bends[np.isfinite(bends)]
    noise_m = 0.0
    if len(bends):
        # second differences have sqrt(6) of white noise's sigma, first differences sqrt(2)
        noise_m = quantile_of(bends, 0.25) / 0.3186 * np.sqrt(2.0 / 6.0)
    return max(noise_m, cloud.z_step_m * np.sqrt(2.0 / 12.0))


def _pitch_m(points: np.ndarray) -> float:
    """Return the lateral distance of neighbours in the nearest tenth of the view; 0 if unknown."""
    rows = points[::4]
    across = np.diff(rows[..., 0], axis=1)
    up = np.diff(rows[..., 1], axis=1)
    steps = np.hypot(across, up)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return quantile_of(steps, 0.1) if len(steps) else 0.0


def _windows(pitch_m: float, noise_m: float, smooth_px: int) -> tuple[int, int]:
    """Return the window of the means, and half of the pixels over which a bend is judged."""
    if not pitch_m:
        return smooth_px, max(smooth_px // 2, 1)
    # a central difference of the mean of n x n pixels has noise_m / (sqrt(2) n^1.5 pitch)
    by_noise = (noise_m / (math.sqrt(2.0) * NORMAL_NOISE * pitch_m)) ** (2.0 / 3.0)
    wanted = max(min(smooth_px, SMOOTH_MM * MM / pitch_m), by_noise, 3.0)
    window = min(2 * int(wanted / 2.0) + 1, max(WIDEST_SMOOTH_PX, smooth_px))
    # a camera that interpolates spreads a step over several pixels: on a coarse grid, over more
    # than the window
    mixed_px = min(MIXED_PX, int(0.75 * SMOOTH_MM * MM / pitch_m))
    return window, max(window // 2, mixed_px, 1)


def _before_lens(points: np.ndarray) -> bool:
    """Return whether there are finite points (..., 3), and a camera at the origin may see all."""
    x, y, z = np.moveaxis(points, -1, 0)
    lateral = np.maximum(np.abs(x), np.abs(y))
    beyond = (z <= 0) | (lateral >= WIDEST_SLOPE * z)
    return bool(np.isfinite(z).any() and not beyond.any())


@numba.njit(**PLAIN)
def links(
    points_m: np.ndarray,
    tilt: float,
    noise_m: float,
    central: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each of the pixels (h, w, 3) lies on one surface with its right (h, w) and
    its lower neighbour (h, w). ``central``: distances across are measured between the two rays at
    the nearer depth."""
    h, w, _ = points_m.shape
    linked = np.zeros((2, h, w), np.bool_)
    for v in range(h):
        for u in range(w):
            for axis in range(2):
                row = v + axis
                column = u + 1 - axis
                if row < h and column < w:
                    point = points_m[v, u]
                    neighbour = points_m[row, column]
                    ours = 1.0
                    theirs = 1.0
                    if central:
                        ours = min(neighbour[2] / point[2], 1.0)
                        theirs = min(point[2] / neighbour[2], 1.0)
                    dx = neighbour[0] * theirs - point[0] * ours
                    dy = neighbour[1] * theirs - point[1] * ours
                    limit = tilt * math.sqrt(dx * dx + dy * dy) + noise_m
                    linked[axis, v, u] = abs(neighbour[2] - point[2]) <= limit
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
            before = max(u - 1, 0)
            after = min(u + 1, w - 1)
            for k in range(3):  # the length of either step does not matter
                along[k] = surface_m[v, after, k] - surface_m[v, before, k]
                down[k] = surface_m[below, u, k] - surface_m[above, u, k]
            x = along[1] * down[2] - along[2] * down[1]
            y = along[2] * down[0] - along[0] * down[2]
            z = along[0] * down[1] - along[1] * down[0]
            length = max(math.sqrt(x * x + y * y + z * z), 1e-15)
            normals[v, u, 0] = x / length
            normals[v, u, 1] = y / length
            normals[v, u, 2] = z / length
    return normals


@numba.njit(**PLAIN)
def turns(normals: np.ndarray, half: int, least_cosine: float) -> np.ndarray:
    """Return (h, w) bool: whether the unit normals (h, w, 3) ``half`` pixels to either side
    enclose a wider angle, along a column or along a row."""
    h, w, _ = normals.shape
    turned = np.zeros((h, w), np.bool_)
    for v in range(h):
        for u in range(w):
            if half <= v < h - half:
                above = normals[v - half, u]
                below = normals[v + half, u]
                cosine = above[0] * below[0] + above[1] * below[1] + above[2] * below[2]
                turned[v, u] = cosine < least_cosine
            if half <= u < w - half:
                before = normals[v, u - half]
                after = normals[v, u + half]
                cosine = before[0] * after[0] + before[1] * after[1] + before[2] * after[2]
                turned[v, u] |= cosine < least_cosine
    return turned


class _Smooth(NamedTuple):
    """The smoothed surface at each pixel of a cloud."""

    # points (n, 3), metres
    points_m: np.ndarray
    # their local means (n, 3), metres
    means_m: np.ndarray
    # unit normals of the means (n, 3)
    normals: np.ndarray
    # whether rays meet in the origin, else they run along z
    central: bool

    def misses_m(self, pixels: np.ndarray, seeds: np.ndarray) -> np.ndarray:
        """Return the distances in depth (n,) of the points at ``pixels`` from the planes at
        ``seeds``."""
        points = self.points_m[pixels]
        normals = self.normals[seeds]
        height = ((self.means_m[seeds] - points) * normals).sum(axis=1)
        rays = points / points[:, 2:] if self.central else np.array([[0.0, 0.0, 1.0]])
        cosines = np.abs((normals * rays).sum(axis=1))
        return np.abs(height) / np.maximum(cosines, 1e-3)


def _keep_large(cores: np.ndarray, sizes: np.ndarray, window: int) -> int:
    """Return the number of candidates: cores that are large enough, and wider than the ramp of a
    smoothed edge."""
    least_px = max(LEAST_PX, int(LEAST_SHARE * cores.size))
    large = int((sizes >= least_px).sum())
    kept = []
    for number in range(1, min(large, 4 * MOST_SURFACES) + 1):
        core = cores == number
        u, v, width, height = cv2.boundingRect(core.view(np.uint8))
        filled_core = holes_filled(core[v : v + height, u : u + width], rim_px=1)
        if np.count_nonzero(shrunk(filled_core, window)) >= WIDE_PART * np.count_nonzero(
            filled_core
        ):
            kept.append(number)
    if not kept and len(sizes):
        kept = [1]
    kept = kept[:MOST_SURFACES]
    new = np.zeros(len(sizes) + 1, dtype=cores.dtype)
    new[kept] = np.arange(1, len(kept) + 1)
    cores[:] = new[cores]
    return len(kept)


def _joined(
    masks: np.ndarray,
    cores: np.ndarray,
    smooth: _Smooth,
    apart_m: float,
    turn: float,
) -> np.ndarray:
    """Return ``masks`` with surfaces merged, also in ``cores``, if their rims share pixels and
    their planes agree."""
    if not len(masks):
        return masks
    stays = np.arange(len(masks))
    for i in range(len(masks)):
        for j in range(i + 1, len(masks)):
            pixels = np.flatnonzero(masks[i] & masks[j])
            if len(pixels) < LEAST_SHARED_PX or stays[i] == stays[j]:
                continue
            first = _seeds(cores == i + 1, pixels)
            second = _seeds(cores == j + 1, pixels)
            misses = np.maximum(smooth.misses_m(pixels, first), smooth.misses_m(pixels, second))
            cosines = (smooth.normals[first] * smooth.normals[second]).sum(axis=1)
            if np.median(misses) <= apart_m and np.median(cosines) >= math.cos(turn):
                stays[stays == stays[j]] = stays[i]
    kept = np.unique(stays)
    count = max(len(masks), int(cores.max(initial=0)))
    numbers = np.zeros(count + 1, dtype=cores.dtype)
    numbers[1 : len(masks) + 1] = np.searchsorted(kept, stays) + 1
    cores[:] = numbers[cores]
    return np.array([masks[stays == label].any(axis=0) for label in kept])


def _seeds(core: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the core's nearest pixel to each of the pixels (n,)."""
    return nearest_pixel(core)[1].reshape(-1)[pixels]


def _share_contested(masks: np.ndarray, cores: np.ndarray, smooth: _Smooth) -> None:
    """Give each pixel of several rims to the surface whose plane, extended from its core, is
    nearest."""
    pixels = np.flatnonzero(masks.sum(axis=0) > 1)
    if not len(pixels):
        return
    misses = np.full((len(masks), len(pixels)), np.inf)
    for number, mask in enumerate(masks):
        holds = mask.reshape(-1)[pixels]
        if holds.any():
            seeds = _seeds(cores == number + 1, pixels[holds])
            misses[number, holds] = smooth.misses_m(pixels[holds], seeds)
    winner = misses.argmin(axis=0)
    for number in range(len(masks)):
        masks[number].reshape(-1)[pixels[winner != number]] = False


def _trim_rims(
    masks: np.ndarray,
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
    h, w = valid.shape
    for number in range(len(masks)):
        # the picture's edge is a rim too: a strip of background may lie there
        filled_mask = holes_filled(masks[number] & valid, rim_px=1)
        rim = masks[number] & ~shrunk(filled_mask, 2 * reach + 1)[1:-1, 1:-1]
        inner = shrunk(filled_mask, 2 * reach + window)[1:-1, 1:-1]
        inner = inner & shrunk(cores == number + 1, window)
        if not inner.any():
            continue
        distance_px, nearest = nearest_pixel(inner)
        pixels = np.flatnonzero(rim & (distance_px <= 3 * reach))
        seeds = nearest.reshape(-1)[pixels]
        leaves = _leaves(pixels, seeds, points, means, normals, h, w, reach, apart_m)
        masks[number].reshape(-1)[pixels[leaves]] = False
        masks[number] = parts_with(masks[number], inner, connectivity=4)


@numba.njit(**PLAIN)
def _leaves(pixels, seeds, points, means, normals, h, w, reach, apart_m):  # type: ignore[no-untyped-def]
    """Return whether each of the pixels (n,) departs from the surface at its seed (n,) farther
    inside."""
    departs = np.zeros(len(pixels), np.bool_)
    for i in range(len(pixels)):
        pixel = pixels[i]
        seed = seeds[i]
        row = seed // w
        column = seed % w
        down = row - pixel // w
        across = column - pixel % w
        step = reach / max(math.sqrt(down**2 + across**2), 1.0)
        # the bend of the surface over the same distance inwards, radians per metre
        end_row = min(max(round(row + down * step), 0), h - 1)
        end_column = min(max(round(column + across * step), 0), w - 1)
        end = end_row * w + end_column
        off = 0.0
        distance = 0.0
        cosine = 0.0
        span = 0.0
        for k in range(3):
            off += (points[pixel, k] - means[seed, k]) * normals[seed, k]
            distance += (points[pixel, k] - means[seed, k]) ** 2
            cosine += normals[seed, k] * normals[end, k]
            span += (means[seed, k] - means[end, k]) ** 2
        bend = math.acos(min(max(cosine, 0.0), 1.0)) / max(math.sqrt(span), 1e-9)
        turn = math.radians(RIM_TURN_DEG) + bend * math.sqrt(distance) / 2.0
        turn = min(turn, math.pi / 2.0)
        departs[i] = abs(off) > max(apart_m, math.sin(turn) * math.sqrt(distance))
    return departs


def raster(points: np.ndarray, cloud: Cloud) -> tuple[Cloud, np.ndarray, np.ndarray, float]:
    """Return a grid with an empty border that holds, in each cell, the nearest of the points (n,
    3); each point's row and column; and the side of a cell in distances between neighbours."""
    from scipy.spatial import cKDTree

    plan = points[:, :2]
    if _before_lens(points):
        plan = plan / points[:, 2:]
    # the 90th percentile of the distances to the nearest neighbour, from about 2000 places
    sample = plan[:: max(1, len(plan) // 2000)]
    distances = cKDTree(plan).query(sample, k=min(2, len(plan)))[0]
    to_nearest = distances.reshape(len(sample), -1)[:, -1]
    spacing = max(float(np.quantile(to_nearest, 0.9)), 1e-9)
    extent = float(np.ptp(plan, axis=0).max())
    side = max(CELL_SPACINGS * spacing, extent / MAX_RASTER)
    while True:
        columns, rows = np.floor((plan - plan.min(axis=0)) / side).astype(int).T
        if _is_filled(rows, columns):
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
    grid = Cloud(
        points_m=image,
        reason=zeros,
        count=zeros.astype(int),
        variance_m2=none,
        region=region,
        z_step_m=cloud.z_step_m,
        n_frames=cloud.n_frames,
    )
    return grid, rows, columns, side / spacing


def _is_filled(rows: np.ndarray, columns: np.ndarray) -> bool:
    """Return whether enough cells hold a place, in blocks of 2 x 2 that hold one and whose eight
    neighbours do: a gap that is wider than a block does not come from a lack of points."""
    down = rows.max() // 2 + 1
    across = columns.max() // 2 + 1
    occupied = np.zeros((2 * down, 2 * across), dtype=bool)
    occupied[rows, columns] = True
    in_block = occupied.reshape(down, 2, across, 2).sum(axis=(1, 3))
    inner = shrunk(np.pad(in_block > 0, 1), 3)[1:-1, 1:-1]
    if not inner.any():
        return True
    share_filled = float(in_block[inner].mean()) / 4.0
    return share_filled >= CELLS_FILLED
