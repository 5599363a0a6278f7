"""Which pixels belong to the target: a box, a polygon in the image, or the largest smooth surface."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field, model_validator

from detectors import crop_kernels as kernels
from detectors.median import quantile_of
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from harness.vocabulary.units import MM

MAX_SURFACE_TILT = 6.0
"""tan(80.5 degrees): a steeper step between neighbouring pixels is an edge, not a surface."""
STEP_SIGMAS = 6.0
"""Of the noise of a difference between neighbours: below this a step may be noise."""
RIM_PX = 3
"""Width of the rim where a depth pixel mixes target and background: a 5 x 5 window (Azure Kinect's engine, OpenK4A)
reaches 2 pixels, and the edge itself passes through a third. Kinect v2's 3 x 3 window leaves 2. Depth aligned to a
finer colour camera needs as many *depth* pixels: 2.4 times as many for the Azure Kinect's binned WFOV at 1280 x 720."""
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


class _Crop(Config):
    """``inset_px``: take so many pixels off the target's outer rim, where pixels mix target and background. Holes
    inside the target do not grow; the edge of the image is no rim."""

    inset_px: int = Field(default=0, ge=0, le=200)


class NoCrop(_Crop):
    """Every valid pixel."""

    kind: Literal["none"] = "none"


class BoxCrop(_Crop):
    """Points inside an open box in the camera's frame; the defaults are the thesis'.

    ``range_max_m`` limits sqrt(x^2 + z^2). ``keep_fraction`` then multiplies the remaining points' extreme x and y, as
    the thesis' fit script does with 0.75: it shortens a target that surrounds the optical axis on all four sides.
    """

    kind: Literal["box"] = "box"
    x_mm: tuple[float, float] = (-500.0, 400.0)
    y_mm: tuple[float, float] = (-300.0, 190.0)
    z_mm: tuple[float, float] = (0.0, 1100.0)
    range_max_m: float | None = Field(default=1.0, gt=0)
    keep_fraction: float = Field(default=1.0, gt=0, le=1)

    @model_validator(mode="after")
    def _ordered(self) -> BoxCrop:
        for name in ("x_mm", "y_mm", "z_mm"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name}: the lower limit {low:g} must be below the upper limit {high:g}")
        return self


class PolygonCrop(_Crop):
    """Pixels whose centre lies inside a polygon of sensor pixel positions [u, v] (even-odd rule)."""

    kind: Literal["polygon"] = "polygon"
    vertices_px: tuple[tuple[float, float], ...] = Field(min_length=3)


class AutoCrop(_Crop):
    """The largest smooth surface: neighbours are joined where the step in z is no more than a tilted surface and noise
    explain and the surface does not bend by more than ``crease_deg`` over ``smooth_px``; then its holes are filled, so
    that damage and whatever lies inside its outline stay; then ``inset_px`` comes off its rim (`RIM_PX` says why 3).
    A background so close behind that the camera's blur leaves no crease is taken for target (13 mm behind the face, at
    0.7 m with a 5 x 5 window; at 33 mm it is not).

    Without a pixel grid: the same on a raster of x/z, y/z (of x, y where the cloud cannot have been recorded from its
    origin) that holds the nearest point of each cell; all points of a kept cell are kept. ``smooth_px`` counts
    distances between neighbours, ``inset_px`` is the least number of them that is taken off, and the image's edge,
    which such a cloud does not tell, is a rim. Several views laid over one another have closer neighbours than one.
    """

    kind: Literal["auto"] = "auto"
    inset_px: int = Field(default=RIM_PX, ge=0, le=200)
    crease_deg: float = Field(default=35.0, gt=0, le=90)
    smooth_px: int = Field(default=9, ge=3, le=99)


CropConfig = Annotated[NoCrop | BoxCrop | PolygonCrop | AutoCrop, Field(discriminator="kind")]
"""A crop as the user writes it: ``kind: none | box | polygon | auto`` and that kind's fields."""


def crop(cloud: Cloud, config: NoCrop | BoxCrop | PolygonCrop | AutoCrop) -> np.ndarray:
    """(h, w) bool: the valid pixels that belong to the target.

    Raises UserError where nothing is left, with the cloud's actual extent, and for a polygon on a cloud without a grid.
    """
    if not cloud.valid.any():
        raise UserError("the cloud has no valid point to crop", fix="check the capture")
    if isinstance(config, BoxCrop):
        mask = _box(cloud, config)
    elif isinstance(config, PolygonCrop):
        mask = _polygon(cloud, config)
    elif isinstance(config, AutoCrop):
        mask = _largest_surface(cloud, config) if cloud.organised else _largest_on_raster(cloud, config)
    else:
        mask = cloud.valid
    if config.inset_px and cloud.organised:
        mask = _inset(mask, config.inset_px)
    if not mask.any():
        raise _empty(cloud, config)
    return mask


def _box(cloud: Cloud, config: BoxCrop) -> np.ndarray:
    x, y, z = np.moveaxis(cloud.points_m, -1, 0)
    inside = cloud.valid
    with np.errstate(invalid="ignore"):
        for values, (low, high) in ((x, config.x_mm), (y, config.y_mm), (z, config.z_mm)):
            inside = inside & (values > low * MM) & (values < high * MM)
        if config.range_max_m is not None:
            inside &= np.hypot(x, z) < config.range_max_m
        if config.keep_fraction < 1.0 and inside.any():
            part = config.keep_fraction
            limits = [(v, part * v[inside].min(), part * v[inside].max()) for v in (x, y)]
            for values, low, high in limits:
                inside = inside & (values > low) & (values < high)
    return inside


def _polygon(cloud: Cloud, config: PolygonCrop) -> np.ndarray:
    if not cloud.organised:
        raise UserError(
            "a polygon in pixels cannot crop a cloud without a pixel grid", legal="crop.kind none, box or auto"
        )
    v, u = np.mgrid[cloud.region.row0 : cloud.region.row1, cloud.region.col0 : cloud.region.col1].astype(float)
    inside = np.zeros(u.shape, dtype=bool)
    corners = np.array(config.vertices_px)
    for (u0, v0), (u1, v1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if v0 == v1:
            continue
        crossing = u0 + (v - v0) / (v1 - v0) * (u1 - u0)
        inside ^= ((v0 <= v) != (v1 <= v)) & (u < crossing)
    return inside & cloud.valid


def _inset(mask: np.ndarray, pixels: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    # OpenCV's default border never erodes: the edge of the image is not the target's rim
    return mask & cv2.erode(_holes_filled(mask).astype(np.uint8), kernel).astype(bool)


def _holes_filled(mask: np.ndarray) -> np.ndarray:
    """The mask with everything that it encloses."""
    outside = np.pad(~mask, 1, constant_values=True).astype(np.uint8)
    _, labels = cv2.connectedComponents(outside, connectivity=4)
    filled: np.ndarray = (labels != labels[0, 0])[1:-1, 1:-1]
    return filled


# ---------------------------------------------------------------- largest smooth surface


def _largest_surface(cloud: Cloud, config: AutoCrop) -> np.ndarray:
    valid = cloud.valid
    steps = kernels.links(cloud.points_m, MAX_SURFACE_TILT, STEP_SIGMAS * _step_noise(cloud))
    largest = kernels.largest_component(valid & ~_creases(cloud.points_m, valid, config), *steps)
    # smoothing, slope and comparison flag half + 1 + half pixels on each side of a crease or rim: given back where no
    # step parts
    reach = 2 * (config.smooth_px // 2) + 1
    grown = cv2.dilate(largest.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=reach) > 0
    rim = kernels.largest_component(valid & grown, *steps)
    return _holes_filled(largest | rim) & valid


def _step_noise(cloud: Cloud) -> float:
    """Standard deviation of a difference between neighbours, from the quieter quarter of the second differences of z
    along rows (three quarters of the picture may be rubble); at least a rounding step's."""
    z = np.ascontiguousarray(cloud.points_m[..., 2])
    bends = np.abs(z[:, 2:] - 2.0 * z[:, 1:-1] + z[:, :-2])
    bends = bends[np.isfinite(bends)]
    # the second difference of white noise has sqrt(6) of its sigma, the first sqrt(2)
    noise = quantile_of(bends, 0.25) / 0.3186 * np.sqrt(2.0 / 6.0) if len(bends) else 0.0
    return max(noise, cloud.z_step_m * np.sqrt(2.0 / 12.0))


def _creases(points_m: np.ndarray, valid: np.ndarray, config: AutoCrop) -> np.ndarray:
    """(h, w) bool: the normal of the surface of points averaged over ``smooth_px`` x ``smooth_px`` valid neighbours
    turns by more than ``crease_deg`` across ``smooth_px``."""
    size = (config.smooth_px, config.smooth_px)
    weight = cv2.blur(valid.astype(np.float64), size, borderType=cv2.BORDER_REFLECT)
    smooth = cv2.blur(np.where(valid[..., None], points_m, 0.0), size, borderType=cv2.BORDER_REFLECT)
    smooth = smooth / np.maximum(weight, 1e-12)[..., None]
    limit = float(np.cos(np.deg2rad(config.crease_deg)))
    return np.asarray(kernels.turns(kernels.unit_normals(smooth), max(config.smooth_px // 2, 1), limit))


# ---------------------------------------------------------------- the same without a pixel grid


def _largest_on_raster(cloud: Cloud, config: AutoCrop) -> np.ndarray:
    """As `_largest_surface`; a hole's floor, an island without a grid, lies inside the outline as it does on one."""
    mask = cloud.valid.copy()
    raster, rows, columns, spacings = _raster(cloud.points_m[mask], cloud)
    coarse = config.model_copy(update={"smooth_px": max(3, 2 * round(config.smooth_px / spacings / 2) - 1)})
    kept = _largest_surface(raster, coarse)
    if config.inset_px:
        # the cell that holds the rim, and every cell that a point inset_px - 1 spacings farther in may lie in
        kept = _inset(kept, math.ceil((config.inset_px - 1) / spacings) + 1)
    mask[mask] = kept[rows, columns]
    return mask


def _raster(points: np.ndarray, cloud: Cloud) -> tuple[Cloud, np.ndarray, np.ndarray, float]:
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


def _empty(cloud: Cloud, config: NoCrop | BoxCrop | PolygonCrop | AutoCrop) -> UserError:
    points = cloud.points_m[cloud.valid]
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0) / MM, points.max(axis=0) / MM
    extent = f"x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f}, z {z0:.0f} to {z1:.0f} mm"
    if isinstance(config, BoxCrop):
        asked = ", ".join(
            f"{n} {r[0]:g} to {r[1]:g}" for n, r in zip("xyz", (config.x_mm, config.y_mm, config.z_mm), strict=True)
        )
        asked += "" if config.range_max_m is None else f" mm and sqrt(x^2 + z^2) < {1e3 * config.range_max_m:g}"
        unit = "; the cloud looks as if its unit were not the metre" if z1 > 50_000 or z1 < 5 else ""
        return UserError(
            f"the crop box ({asked} mm) holds none of the cloud's {len(points)} points{unit}",
            legal=f"limits that meet the cloud: {extent}",
            fix="change crop.x_mm, crop.y_mm, crop.z_mm, or use crop.kind: auto",
        )
    where = (
        f"columns {cloud.region.col0} to {cloud.region.col1 - 1}, rows {cloud.region.row0} to {cloud.region.row1 - 1}"
    )
    return UserError(
        f"the crop ({config.kind}, inset {config.inset_px} px) leaves none of the cloud's {len(points)} points",
        legal=f"a crop that meets the cloud: {where}; {extent}",
        fix="change the crop or lower crop.inset_px",
    )
