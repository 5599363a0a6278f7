"""Finds the faces of one extruded part: the flats and webs of a sheet, the crests of waves.

An area without steps is such a part if one extruded profile holds it everywhere, and if the profile
turns back to a direction after it has left it, as the next flat of a sheet does. A floor and a wall
are extruded too, but do not turn back."""

from __future__ import annotations

import math

import numpy as np

from detectors.pixels.masks import grown, parts_with
from detectors.surfaces.extruded import Profile, direction_of, picked, with_twist
from detectors.surfaces.surface import SurfaceFunction, polynomial

SEARCHED = 40_000  # points of the area that are fitted
CHORD_KNOTS = 6  # distance of the knots between which the profile's direction is taken
HELD_OF_STRIP = 0.85  # share of a strip's points within the limit of a profile that holds it
HELD_STRIPS = 0.9  # share of strips that a profile holds


def extruded_faces(
    area: np.ndarray,
    surface: np.ndarray,
    points_m: np.ndarray,
    apart_m: float,
    crease_deg: float,
    central: bool,
) -> np.ndarray | None:
    """Return (h, w) bool: the pixels of the extruded part that includes a surface.

    Args:
        area: (h, w) bool, an area without steps that includes most of the surface.
        surface: (h, w) bool.
        points_m: (h, w, 3), metres, NaN where nothing returned.
        apart_m: distance from the profile within which a point belongs to it.
        crease_deg: bend that separates two faces.
        central: whether rays leave the origin.

    Returns:
        None if no extruded profile that turns back holds the area."""
    points = points_m[area]
    points = points[np.isfinite(points).all(axis=1)]
    pitch = _pitch(points_m, central)
    sample = picked(points, SEARCHED)
    directed = direction_of(sample, _paraboloid(sample), pitch, central)
    if directed is None:
        return None
    profile = with_twist(directed, sample)
    off_m = np.abs(sample[:, 2] - profile(sample))
    # the twist may hold a bend across the direction, so the curve is taken without it
    curve = directed.fitted(sample)
    if not _held(profile, sample, off_m <= apart_m) or not turns_back(curve, crease_deg):
        return None
    on_profile = np.zeros(area.shape, bool)
    on_profile[area] = np.abs(points_m[area][:, 2] - profile(points_m[area])) <= 2.0 * apart_m
    return parts_with(grown(on_profile, 1) & area, surface)


def _pitch(points_m: np.ndarray, central: bool) -> float:
    """Return the distance of neighbouring pixels in x/z, or in metres with parallel rays."""
    positions = points_m[..., 0]
    if central:
        positions = positions / points_m[..., 2]
    steps = np.abs(np.diff(positions[::4], axis=1))
    return float(np.median(steps[np.isfinite(steps)]))


def _paraboloid(points: np.ndarray) -> SurfaceFunction:
    return polynomial(points, np.ones(len(points)), degree=2)


def _held(profile: Profile, points: np.ndarray, near: np.ndarray) -> bool:
    """Return whether the profile is near the points (n, 3) in nearly all strips along it."""
    knots = profile.knots(profile.slopes(points)).clip(0, len(profile.curve) - 1)
    strips = knots // CHORD_KNOTS
    counts = np.bincount(strips)
    near_counts = np.bincount(strips, near)
    occupied = counts > 0
    shares = near_counts[occupied] / counts[occupied]
    return bool((shares >= HELD_OF_STRIP).mean() >= HELD_STRIPS)


def turns_back(profile: Profile, crease_deg: float) -> bool:
    """Return whether the profile turns by the angle of a crease, and later back by as much."""
    position = profile.first + profile.step * np.arange(len(profile.curve))
    ahead = profile.curve
    if profile.central:
        ahead = 1.0 / profile.curve
        position = position * ahead
    across_m = position[CHORD_KNOTS:] - position[:-CHORD_KNOTS]
    ahead_m = ahead[CHORD_KNOTS:] - ahead[:-CHORD_KNOTS]
    angle = np.unwrap(np.arctan2(ahead_m, across_m))
    # the largest turn from a direction before a place, and the largest turn back behind it
    for sign in (1.0, -1.0):
        turned = sign * angle
        risen = turned - np.minimum.accumulate(turned)
        falls = turned - np.minimum.accumulate(turned[::-1])[::-1]
        if (np.minimum(risen, falls) >= math.radians(crease_deg)).any():
            return True
    return False
