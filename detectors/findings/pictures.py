"""Pictures of damages as the camera's filter leaves them."""

import math

import numba
import numpy as np

from detectors.findings.blurs import smooth, weigh
from detectors.findings.drilled import painted_holes
from detectors.findings.hole_patch import HolePatch
from detectors.findings.shapes import DISC, SHAPES, Shape, reliefs
from detectors.pixels.clusters import PLAIN


def pictures(patch: HolePatch, holes: np.ndarray, shape: Shape = "disc") -> np.ndarray:
    """Return the residuals (m, h, w), without offset, of holes (m, 5): u, v, radius, depth along
    the optical axis, and wall in 0..1; a disc if the depth is negative. Other shapes have 7
    numbers (`detectors.findings.shapes`)."""
    blur_u, blur_v = patch.blur_px
    height, width = patch.used.shape
    return drawn(
        SHAPES.index(shape),
        holes,
        patch.sights,
        patch.metric_m2,
        blur_u,
        blur_v,
        patch.soft,
        patch.weighing,
        height,
        width,
    )


@numba.njit(**PLAIN)
def drawn(  # type: ignore[no-untyped-def]
    shape,
    holes,
    sights,
    metric,
    blur_u,
    blur_v,
    soft,
    weighing,
    h,
    w,
):
    """Return the `pictures` (m, h, w) of damages (m, 7) of a shape."""
    brightness, half, lens_u, lens_v = weighing
    lens = (lens_u, lens_v)
    images = _averaged(shape, holes, sights, metric, blur_u, blur_v, soft, lens, h, w)
    if shape != DISC or not (brightness > 0.0 or half < np.inf):
        return images
    sharp = _averaged(shape, holes, sights, metric, 1.0, 1.0, False, lens, h, w)
    faces = sharp  # what is seen of the face matters only where light weighs
    if brightness > 0.0:
        mouths = holes.copy()
        mouths[:, 3] = -1.0
        faces = 1.0 + _averaged(shape, mouths, sights, metric, blur_u, blur_v, soft, lens, h, w)
    for n in range(len(images)):
        if holes[n, 3] > 0.0:
            weigh(images[n], sharp[n], faces[n], holes[n, 3], brightness, half)
    return images


@numba.njit(**PLAIN)
def _averaged(  # type: ignore[no-untyped-def]
    shape,
    holes,
    sights,
    metric,
    blur_u,
    blur_v,
    soft,
    lens,
    h,
    w,
):
    """Return the `pictures` (m, h, w) of a filter that weighs all pixels alike."""
    if soft:
        blur_u = math.sqrt(0.5) * blur_u
        blur_v = math.sqrt(0.5) * blur_v
    if shape == DISC:
        images = painted_holes(holes, sights, metric, max(blur_u, 1.0), max(blur_v, 1.0), h, w)
    else:
        images = reliefs(shape, holes, sights, metric, max(blur_u, 1.0), max(blur_v, 1.0), h, w)
    if soft:
        for n in range(len(images)):
            smooth(images[n], blur_u, blur_v)
    lens_u, lens_v = lens
    if lens_u > 1.0 or lens_v > 1.0:
        for n in range(len(images)):
            smooth(images[n], lens_u, lens_v)
    return images
