"""Marks that carry a code, by OpenCV's detector: their corners are found in the picture and cut with the tag's plane.

Not modelled: a tag that is bent; a lens whose distortion is more than quadratic over one tag.
"""

from __future__ import annotations

import cv2
import numpy as np

from detectors.marks.mark import Mark, MarkSet, problem_of
from detectors.marks.patch import Patch, fit_patch, mean_sigma_m
from harness.vocabulary.capture import Cloud

CORNER_PX = 0.25
"""Standard deviation per axis of a refined corner: on tags of 40 pixels drawn at random places and turns it is 0.18
where the picture is sharp, 0.27 with a blur of 1 and 0.34 with one of 1.5 pixels."""
LEAST_SEEN = 0.5
"""Share of a tag's pixels on the target, below which it is not the target's."""
HALF_STEPS = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
WHOLE = 0.95
"""Share of a tag's pixels that a tag in no doubt has: less may pull the plane."""


def coded_marks(cloud: Cloud, inside: np.ndarray, dictionary: str) -> MarkSet:
    """Find the tags of a cv2.aruco ``dictionary`` on the target, each with its code; two of one code are in doubt."""
    none = np.zeros(0, dtype=np.int64)
    if not cloud.organised:
        return MarkSet((), none, problem="codes are read from a picture, and this cloud has no pixel grid")
    assert cloud.rgb is not None
    grey = cv2.cvtColor(np.ascontiguousarray(cloud.rgb), cv2.COLOR_RGB2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners_px, found, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(grey)
    codes = [] if found is None else [int(code) for code in found.ravel()]
    # corners (4, 2) in pixels of the grid, the centre of the first being (0, 0)
    tags = [(code, tag.reshape(4, 2).astype(float)) for code, tag in zip(codes, corners_px, strict=True)]
    marks, off = [], 0
    for code, corners in sorted(tags, key=lambda tag: (tag[0], tag[1].tolist())):
        mark = _mark(cloud, inside, code, corners, codes.count(code) > 1)
        off += mark is None
        marks += [] if mark is None else [mark]
    pixels = np.unique(np.concatenate([mark.pixels for mark in marks])) if marks else none
    notes = (f"{off} tags lie off the target, or have no range",) if off else ()
    return MarkSet(tuple(marks), pixels, problem_of(marks, f"searched for tags of {dictionary}"), notes)


def _mark(cloud: Cloud, inside: np.ndarray, code: int, corners: np.ndarray, twice: bool) -> Mark | None:
    area = np.zeros(inside.shape, dtype=np.uint8)
    cv2.fillConvexPoly(area, np.rint(corners).astype(np.int32), 1)
    whole = int(area.sum())
    pixels = np.flatnonzero((area > 0) & inside)
    if len(pixels) < max(LEAST_SEEN * whole, 6):
        return None
    points = cloud.points_m.reshape(-1, 3)[pixels]
    patch = fit_patch(points)
    if patch is None:
        return None
    places, steps = _corners_on(patch, corners, pixels, points, inside.shape[1], cloud.projection)
    spread = steps @ steps.T * CORNER_PX**2 / 4
    centre = places.mean(axis=0)
    ray = centre / centre[2] if cloud.projection == "central" else np.array([0.0, 0.0, 1.0])
    along = ray * patch.normal[2] / (patch.normal @ ray)
    covariance = spread + mean_sigma_m(cloud, pixels, patch.sigma_m) ** 2 * np.outer(along, along)
    seen, without = len(pixels) / whole, 1.0 - cloud.valid[area > 0].mean()
    doubt = ""
    if twice:
        doubt = f"code {code} is seen more than once"
    elif seen < WHOLE and without > 1.0 - WHOLE:
        doubt = f"without range in {100 * without:.0f} % of it"
    elif seen < WHOLE:
        doubt = f"{100 * (1 - seen):.0f} % of it beyond the crop's edge"
    diagonals = np.cross(places[2] - places[0], places[3] - places[1])
    return Mark(
        centre_m=centre,
        covariance_m2=(covariance + covariance.T) / 2,
        normal=patch.normal,
        pixels=pixels,
        area_m2=float(np.linalg.norm(diagonals)) / 2,
        code=code,
        doubt=doubt,
    )


def _corners_on(
    patch: Patch, corners: np.ndarray, pixels: np.ndarray, points_m: np.ndarray, width: int, projection: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (4, 3) on the tag's plane, and (3, 2) how their mean moves with the picture's co-ordinates.

    The rays of the corners follow from those of the tag's pixels, whose x/z and y/z (x and y of a map) are a quadratic
    in the pixel's place to well within a hundredth of a pixel, distortion or not.
    """
    grid = np.stack([pixels % width, pixels // width], axis=1).astype(float)
    middle, half = grid.mean(axis=0), max(float(np.ptp(grid, axis=0).max()) / 2, 1.0)
    central = projection == "central"
    rays = points_m[:, :2] / points_m[:, 2:] if central else points_m[:, :2]
    coefficients = np.linalg.lstsq(_quadratic((grid - middle) / half), rays, rcond=1e-10)[0]
    mean = corners.mean(axis=0)
    wanted = np.concatenate([corners, mean + HALF_STEPS])
    found = _quadratic((wanted - middle) / half) @ coefficients
    places = patch.cut(np.column_stack([found, np.ones(len(found))]), projection)
    return places[:4], np.stack([places[4] - places[5], places[6] - places[7]], axis=1)


def _quadratic(uv: np.ndarray) -> np.ndarray:
    u, v = uv.T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)
