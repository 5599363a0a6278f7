"""Pictures of damages as the camera's filter leaves them."""

import math

import numba
import numpy as np

from detectors.findings.blurs import smooth, weigh
from detectors.findings.drilled import painted_holes
from detectors.findings.hole_patch import CameraView, HolePatch
from detectors.findings.shapes import DISC, SHAPES, Shape, reliefs
from detectors.pixels.clusters import PLAIN


def pictures(patch: HolePatch, holes: np.ndarray, shape: Shape = "disc") -> np.ndarray:
    """Return the residuals (m, h, w), without offset, of holes (m, 5): u, v, radius, depth along
    the optical axis, and wall in 0..1; a disc if the depth is negative. Other shapes have 7
    numbers (`detectors.findings.shapes`)."""
    return drawn(SHAPES.index(shape), holes, patch.view)


@numba.njit(**PLAIN)
def drawn(shape: int, holes: np.ndarray, view: CameraView) -> np.ndarray:
    """Return the `pictures` (m, h, w) of damages (m, 7) of a shape."""
    images = _averaged(shape, holes, view, view.blur_u, view.blur_v, view.soft)
    weighs_light = view.brightness > 0.0
    if shape != DISC or not (weighs_light or view.half_m < np.inf):
        return images
    sharp = _averaged(shape, holes, view, 1.0, 1.0, False)
    faces = sharp  # what is seen of the face matters only where light weighs
    if weighs_light:
        mouths = holes.copy()
        mouths[:, 3] = -1.0
        faces = 1.0 + _averaged(shape, mouths, view, view.blur_u, view.blur_v, view.soft)
    for n in range(len(images)):
        if holes[n, 3] > 0.0:
            weigh(images[n], sharp[n], faces[n], holes[n, 3], view.brightness, view.half_m)
    return images


@numba.njit(**PLAIN)
def _averaged(  # type: ignore[no-untyped-def]
    shape,
    holes,
    view,
    blur_u,
    blur_v,
    soft,
):
    """Return the `pictures` (m, h, w) of a filter that weighs all pixels alike, through a blur that
    need not be that of the view."""
    if soft:
        blur_u = math.sqrt(0.5) * blur_u
        blur_v = math.sqrt(0.5) * blur_v
    side_u = max(blur_u, 1.0)
    side_v = max(blur_v, 1.0)
    h = view.height
    w = view.width
    if shape == DISC:
        images = painted_holes(holes, view.sights, view.metric_m2, side_u, side_v, h, w)
    else:
        images = reliefs(shape, holes, view.sights, view.metric_m2, side_u, side_v, h, w)
    for n in range(len(images)):
        if soft:
            smooth(images[n], blur_u, blur_v)
        if view.lens_u > 1.0 or view.lens_v > 1.0:
            smooth(images[n], view.lens_u, view.lens_v)
    return images
