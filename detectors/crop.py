"""The pixels that belong to the target: a box, a polygon in the image, or the nearest large smooth surface."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from detectors.masks import inset
from detectors.target import Choice, propose
from harness.vocabulary.capture import Cloud
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM

RIM_PX = 3
"""Width of the rim where a depth pixel mixes target and background: a 5 x 5 window (Azure Kinect's engine, OpenK4A)
reaches 2 pixels, and the edge itself passes through a third. Kinect v2's 3 x 3 window leaves 2. Depth aligned to a
finer colour camera needs as many *depth* pixels: 2.4 times as many for the Azure Kinect's binned WFOV at 1280 x 720."""


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
    """The nearest large smooth surface (`detectors.target`), or candidate number ``target`` of those that a run lists.

    Neighbours are joined where the step in z is no more than a tilted surface and noise explain and the surface does
    not bend by more than ``crease_deg`` over ``smooth_px`` (`detectors.smooth_surfaces` says when that is another
    number); then its holes are filled, so that damage and whatever lies on it or inside its outline stay; then
    ``inset_px`` comes off its rim (`RIM_PX` says why 3). A background so close behind that the camera's blur leaves no
    crease is taken for target (13 mm behind the face, at 0.7 m with a 5 x 5 window; at 33 mm it is not).

    Without a pixel grid: the same on a raster of x/z, y/z (of x, y where the cloud cannot have been recorded from its
    origin) that holds the nearest point of each cell; all points of a kept cell are kept. ``smooth_px`` counts
    distances between neighbours, ``inset_px`` is the least number of them that is taken off, and the image's edge,
    which such a cloud does not tell, is a rim. Several views laid over one another have closer neighbours than one.
    """

    kind: Literal["auto"] = "auto"
    inset_px: int = Field(default=RIM_PX, ge=0, le=200)
    crease_deg: float = Field(default=35.0, gt=0, le=90)
    smooth_px: int = Field(default=9, ge=3, le=99)
    target: int | None = Field(default=None, ge=1, le=99)


AnyCrop = NoCrop | BoxCrop | PolygonCrop | AutoCrop
CropConfig = Annotated[AnyCrop, Field(discriminator="kind")]
"""A crop as the user writes it: ``kind: none | box | polygon | auto`` and that kind's fields."""


def crop(cloud: Cloud, config: AnyCrop) -> np.ndarray:
    """Return (h, w) bool: the valid pixels that belong to the target.

    Raises UserError where nothing is left, with the cloud's actual extent, and for a polygon on a cloud without a grid.
    """
    if not cloud.valid.any():
        raise UserError("the cloud has no valid point to crop", fix="check the capture")
    if isinstance(config, AutoCrop):
        mask = choice_of(cloud, config).mask
    elif isinstance(config, BoxCrop):
        mask = _box(cloud, config)
    elif isinstance(config, PolygonCrop):
        mask = _polygon(cloud, config)
    else:
        mask = cloud.valid
    if cloud.organised and not isinstance(config, AutoCrop):
        mask = inset(mask, config.inset_px)
    if mask.any():
        return mask
    points = cloud.points_m[cloud.valid]
    (x0, y0, z0), (x1, y1, z1) = points.min(axis=0) / MM, points.max(axis=0) / MM
    extent = f"x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f}, z {z0:.0f} to {z1:.0f} mm"
    if isinstance(config, BoxCrop):
        limits = zip("xyz", (config.x_mm, config.y_mm, config.z_mm), strict=True)
        asked = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in limits)
        asked += "" if config.range_max_m is None else f" mm and sqrt(x^2 + z^2) < {1e3 * config.range_max_m:g}"
        unit = "; the cloud looks as if its unit were not the metre" if z1 > 50_000 or z1 < 5 else ""
        raise UserError(
            f"the crop box ({asked} mm) holds none of the cloud's {len(points)} points{unit}",
            legal=f"limits that meet the cloud: {extent}",
            fix="change crop.x_mm, crop.y_mm, crop.z_mm, or use crop.kind: auto",
        )
    seen = cloud.region
    where = f"columns {seen.col0} to {seen.col1 - 1}, rows {seen.row0} to {seen.row1 - 1}"
    raise UserError(
        f"the crop ({config.kind}, inset {config.inset_px} px) leaves none of the cloud's {len(points)} points",
        legal=f"a crop that meets the cloud: {where}; {extent}",
        fix="change the crop or lower crop.inset_px",
    )


def choice_of(cloud: Cloud, config: AutoCrop) -> Choice:
    """Return the automatic crop and all that it chose from. Raises UserError where there is no candidate ``target``."""
    return propose(cloud, config.crease_deg, config.smooth_px, config.inset_px, config.target)


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
