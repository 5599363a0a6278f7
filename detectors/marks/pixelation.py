"""The error of a region's centroid on a grid of pixels: the lattice's own, with sharp edges and no noise.

A pixel belongs to the region where its centre does. Over random shifts of the lattice the error of the sum of
f(x) = x - c over the pixels has, by Poisson's summation formula, the sum of |F(k)|^2 over all integer frequencies k but
0 as its variance, F being the Fourier transform of f over the region (Kendall 1948 for the count of points in an
oval). An edge along the grid gives up to 1/12 square pixel at each end; a slanted one, whose steps average, less: Bose
and Amir (1990) designed fiducials by it.
"""

from __future__ import annotations

import cv2
import numpy as np

HIGHEST = 6
"""Highest frequency along each axis: an edge along the grid gives 1 / k^2, of which the first six are 91 %."""
REST = np.pi**2 / 6 / (1.0 / np.arange(1, HIGHEST + 1) ** 2).sum()
"""Makes up for the higher frequencies of such an edge."""
RECTANGULAR = 0.85
"""Least share of its smallest rectangle that a rectangle's pixels fill; an ellipse's fill 0.79."""

SIZES = 5
"""Outlines between one whole pixel and the next, a rank-1 lattice over width and height."""
TURNS = np.array([-1.0, 0.0, 1.0]) / 3
"""Turns of each, in pixels over its longer side: the thirds of a step."""


def centroid_covariance_px2(polygon_px: np.ndarray) -> np.ndarray:
    """Return the covariance (..., 2, 2) of the centroid of the lattice points within polygons (..., n, 2), vertices in
    order.

    First order in the error, so for regions of some ten pixels and more.
    """
    x = polygon_px.astype(np.float64)
    area, centre = _area_and_centre(x)
    moments = _moment_transform(x - centre[..., None, :], np.sign(area))
    square = np.einsum("...ki,...kj->...ij", moments, moments.conj()).real
    return np.asarray(2.0 * REST * square / area[..., None, None] ** 2)


def region_covariance_px2(pixels: np.ndarray) -> np.ndarray:
    """Return the covariance (2, 2) of the centroid of a region known by its pixel positions (m, 2) alone, which are on
    no line.

    Their convex outline stands for the region. How its size falls between whole pixels is unknown, and decides whether
    the errors of opposite edges add or cancel, and its slope is known to part of a step; so the covariance is the mean
    over outlines up to a pixel larger and turned by up to that.
    """
    outline = outline_px(pixels)
    extent = np.ptp(outline, axis=0)
    middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
    steps = np.arange(SIZES)
    sizes = 1.0 + np.stack([steps, 2 * steps % SIZES], axis=1) / SIZES / extent
    turns = TURNS / extent.max()
    axes = np.moveaxis(np.array([[np.cos(turns), -np.sin(turns)], [np.sin(turns), np.cos(turns)]]), -1, 0)
    outlines = ((outline - middle) * sizes[:, None, None, :]) @ axes
    return np.asarray(centroid_covariance_px2(outlines).mean(axis=(0, 1)))


def outline_px(pixels: np.ndarray) -> np.ndarray:
    """Return the outline (n, 2) of pixel positions (m, 2) that are no line, with as large an area as they have.

    Where they fill their smallest rectangle that rectangle, whose long sides tell the slope of the short ones, where
    few steps are seen; else their convex hull.
    """
    hull = cv2.convexHull(pixels.astype(np.float32))
    middle, size, angle = cv2.minAreaRect(hull)
    # the outermost centres lie half a pixel within the region
    if len(pixels) > RECTANGULAR * (size[0] + 1) * (size[1] + 1):
        outline = cv2.boxPoints((middle, (size[0] + 1, size[1] + 1), angle)).astype(np.float64)
    else:
        outline = hull[:, 0].astype(np.float64)
    area, centre = _area_and_centre(outline)
    return centre + (outline - centre) * np.sqrt(len(pixels) / abs(float(area)))


def _area_and_centre(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return signed areas (...,) and centroids (..., 2) of polygons (..., n, 2)."""
    following = np.roll(x, -1, axis=-2)
    cross = x[..., 0] * following[..., 1] - x[..., 1] * following[..., 0]
    area = cross.sum(axis=-1) / 2
    return area, ((x + following) * cross[..., None]).sum(axis=-2) / (6 * area[..., None])


def _moment_transform(x: np.ndarray, orientation: np.ndarray) -> np.ndarray:
    """Return the integral (..., k, 2) of x exp(-2 pi i k.x) over the polygons, for integer k up to `HIGHEST`, not 0, k
    or -k.

    By the divergence theorem a sum over the edges: of the moment itself, and of the plain transform that is left over.
    """
    steps = np.arange(-HIGHEST, HIGHEST + 1)
    k = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    k = k[len(k) // 2 + 1 :].astype(np.float64)
    edge = np.roll(x, -1, axis=-2) - x
    middle = x + edge / 2
    outward = orientation[..., None, None] * np.stack([edge[..., 1], -edge[..., 0]], axis=-1)
    phase = k @ np.swapaxes(edge, -1, -2)
    flow = (k @ np.swapaxes(outward, -1, -2)) * np.exp(-2j * np.pi * (k @ np.swapaxes(middle, -1, -2)))
    square = (k**2).sum(axis=1, keepdims=True)
    over = -2j * np.pi * square
    flat = np.sinc(phase)
    # the integral of t exp(-2 pi i t phase) over -1/2..1/2: i / (2 pi) times the derivative of the sinc
    small = np.abs(phase) < 1e-4
    safe = np.where(small, 1.0, phase)
    sloped = 0.5j / np.pi * np.where(small, -(np.pi**2) * phase / 3, (np.cos(np.pi * safe) - flat) / safe)
    plain = (flow * flat).sum(axis=-1, keepdims=True) / over
    along = (flow * flat) @ middle + (flow * sloped) @ edge
    return np.asarray(along / over + plain * k / (2j * np.pi * square))
