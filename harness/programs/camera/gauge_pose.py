"""The pose of a solid gauge in a capture: by coded marks, or by the arrangement of its spheres."""

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np

from detectors.rigid_motion import kabsch
from detectors.views.marks.find import find_marks
from detectors.views.marks.mark import CodedMarks
from harness.stills.solid_gauge import SolidGauge
from harness.stills.spheres import RangeImage, find_spheres
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, transform_points

FEWEST_MARKS = 3
FEWEST_SPHERES = 3
# distances between spheres may be off by the sum of both: scale of range, and noise
OFF_SHARE = 0.03
OFF_M = 6 * MM


def located(cloud: Cloud, image: RangeImage, gauge: SolidGauge) -> tuple[np.ndarray, str]:
    """Return ``T_camera_gauge`` (gauge in metres), to a few millimetres, and how it was found.
    Raises UserError if neither marks nor spheres show it."""
    by_marks = _by_marks(cloud, gauge)
    if by_marks is not None:
        return by_marks
    radius_m = float(np.median(gauge.diameters_mm)) / 2 * MM
    found_m = np.array([fit.centre_m for fit in find_spheres(image, radius_m)]).reshape(-1, 3)
    T_camera_gauge, count = _by_arrangement(gauge.centres_mm * MM, found_m)
    if T_camera_gauge is None:
        problem = f"the gauge is not recognised: {len(found_m)} spheres of it were found"
        fix = "show the whole gauge, closer to the camera; check the lens (--intrinsics)"
        raise UserError(problem, legal=f"{FEWEST_MARKS} marks or {FEWEST_SPHERES} spheres", fix=fix)
    return T_camera_gauge, f"the gauge is placed by {count} of its spheres"


def _by_marks(cloud: Cloud, gauge: SolidGauge) -> tuple[np.ndarray, str] | None:
    """Return the pose by marks in colour or infrared; None if too few are readable."""
    if cloud.rgb is None and cloud.amplitude is not None:
        seen = cloud.amplitude[np.isfinite(cloud.amplitude)]
        white = float(np.quantile(seen, 0.99)) if seen.size else 0.0
        scaled = 255 * np.nan_to_num(cloud.amplitude) / max(white, 1e-9)
        grey = np.clip(scaled, 0, 255).astype(np.uint8)
        cloud = replace(cloud, rgb=np.repeat(grey[..., None], 3, axis=2))
    if cloud.rgb is None:
        return None
    marks_read = find_marks(cloud, cloud.valid, CodedMarks(dictionary=gauge.dictionary))
    by_code = {mark.code: mark.centre_m for mark in marks_read.trusted}
    marks = [mark for mark in gauge.marks if mark.code in by_code]
    # a code of something else in view is left out with the marks that then fit one another
    for count in range(len(marks), FEWEST_MARKS - 1, -1):
        for chosen in combinations(marks, count):
            on_gauge_m = np.array([(mark.x_mm, mark.y_mm, 0.0) for mark in chosen]) * MM
            in_camera_m = np.array([by_code[mark.code] for mark in chosen])
            T_camera_gauge = _paired(on_gauge_m, in_camera_m)
            if T_camera_gauge is not None:
                return T_camera_gauge, f"the gauge is placed by {count} of its marks"
    return None


def _by_arrangement(gauge_m: np.ndarray, found_m: np.ndarray) -> tuple[np.ndarray | None, int]:
    """Return the pose that lays most spheres of the gauge (n, 3) on spheres (k, 3) of the capture,
    and their number; None if fewer than three fit."""
    best_T: np.ndarray | None = None
    most = 0
    least_m = np.inf
    for triple in combinations(range(len(found_m)), 3):
        wanted_m = found_m[list(triple)]
        for chosen in permutations(range(len(gauge_m)), 3):
            T = _paired(gauge_m[list(chosen)], wanted_m)
            if T is None:
                continue
            placed_m = transform_points(T, gauge_m)
            apart_m = np.linalg.norm(placed_m[:, None] - found_m, axis=-1).min(axis=1)
            close = apart_m < OFF_M + OFF_SHARE * np.linalg.norm(np.ptp(gauge_m, axis=0))
            rms_m = float(np.sqrt((apart_m[close] ** 2).mean()))
            if (close.sum(), -rms_m) > (most, -least_m):
                best_T = T
                most = int(close.sum())
                least_m = rms_m
    return best_T, most


def _paired(from_m: np.ndarray, to_m: np.ndarray) -> np.ndarray | None:
    """Return the rigid motion of three points or more (n, 3) onto as many; None if their distances
    differ."""
    from_sides_m = np.linalg.norm(from_m - np.roll(from_m, 1, axis=0), axis=1)
    to_sides_m = np.linalg.norm(to_m - np.roll(to_m, 1, axis=0), axis=1)
    if (np.abs(from_sides_m - to_sides_m) > OFF_M + OFF_SHARE * from_sides_m).any():
        return None
    T = kabsch(from_m, to_m, np.ones(len(from_m)))
    apart_m = np.linalg.norm(transform_points(T, from_m) - to_m, axis=1)
    return T if (apart_m < 2 * OFF_M).all() else None
