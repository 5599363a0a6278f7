"""Joins the pieces of one surface that things in front of it separate: a wall behind cables, ribs
or an arm.

Two pieces belong together if one plane or paraboloid holds both, and what lies between them stands
in front of it or returns nothing. If the background shows between them, they are two parts side by
side. Not modelled: pieces of a surface that no polynomial of degree 2 describes to the contact's
limit."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from detectors.pixels.masks import nearest_pixel
from detectors.pixels.noise import sigma_of
from detectors.surfaces.surface import SurfaceFunction, bisquare_weights, polynomial

MOST_SAMPLES = 4000  # points from which a piece's surface is fitted
HELD = 0.9  # share of a piece's points within the limit of a surface that holds it
FACING = 0.1  # share of a piece's pixels, nearest to the other piece, from which one looks across
MOST_LINES = 200
PLACES = 12  # places at which a line between two pieces is looked at
LEAST_PX = 100  # fewest pixels of a piece that is counted
BEHIND = 0.5  # share of the lines that show a background from which pieces are separate parts


def joined_pieces(
    masks: list[np.ndarray],
    points_m: np.ndarray,
    apart_m: float,
    surfaces: int,
) -> list[list[int]]:
    """Return the numbers of the pieces of each surface, the first being the largest.

    Args:
        masks: (h, w) bool each, pieces, largest first.
        points_m: (h, w, 3), metres, NaN where nothing returned.
        apart_m: distance from a surface within which a point belongs to it.
        surfaces: how many of the first pieces are surfaces; the others only join them."""
    samples = [_sample(mask, points_m) for mask in masks]
    free = [number for number in range(len(masks)) if len(samples[number])]
    groups = [[number] for number in range(surfaces) if not len(samples[number])]
    while free and free[0] < surfaces:
        group = [free.pop(0)]
        joined = True
        while joined and free:
            joined = False
            fit, cosine = _fitted(np.concatenate([samples[number] for number in group]))
            if not all(_holds(fit, cosine, samples[number], apart_m) for number in group):
                break
            for number in list(free):
                if not _holds(fit, cosine, samples[number], apart_m):
                    continue
                joined_mask = np.logical_or.reduce([masks[member] for member in group])
                if not _background_between(joined_mask, masks[number], points_m[..., 2], apart_m):
                    group.append(number)
                    free.remove(number)
                    joined = True
        groups.append(group)
    return groups


def _sample(mask: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """Return an even sample (n, 3) of the valid points of a mask."""
    pixels = np.flatnonzero(mask)
    step = max(1, len(pixels) // MOST_SAMPLES)
    points = points_m.reshape(-1, 3)[pixels[::step]]
    return points[np.isfinite(points[:, 2])]


def _fitted(points: np.ndarray) -> tuple[SurfaceFunction, float]:
    """Return the surface of degree 2 through points (n, 3), with little weight for those off it,
    and the cosine by which an error in depth exceeds the distance."""
    weights = np.ones(len(points))
    for _ in range(3):
        fit = polynomial(points, weights, degree=2)
        off_m = points[:, 2] - fit(points)
        scale_m = max(sigma_of(off_m), 1e-6)
        weights = bisquare_weights(off_m, 6.0 * scale_m)
    centred = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    return fit, abs(float(axes[2, 0]))


def _holds(fit: SurfaceFunction, cosine: float, points: np.ndarray, apart_m: float) -> bool:
    off_m = np.abs(points[:, 2] - fit(points)) * cosine
    return bool(len(points) and (off_m <= apart_m).mean() >= HELD)


def _background_between(
    first: np.ndarray, second: np.ndarray, z_m: np.ndarray, apart_m: float
) -> bool:
    """Return whether something behind the surface of two pieces (h, w) shows between them."""
    distance_px, nearest = nearest_pixel(first)
    pixels = np.flatnonzero(second & np.isfinite(z_m))
    by_distance = np.argsort(distance_px.reshape(-1)[pixels], kind="stable")
    facing = pixels[by_distance[: max(int(FACING * len(pixels)), 1)]]
    ends = facing[:: max(1, len(facing) // MOST_LINES)]
    starts = nearest.reshape(-1)[ends]
    width = z_m.shape[1]
    share = (np.arange(PLACES) + 0.5)[:, None] / PLACES
    rows = starts // width + share * (ends // width - starts // width)
    columns = starts % width + share * (ends % width - starts % width)
    line_px = np.rint(rows).astype(int) * width + np.rint(columns).astype(int)
    flat = z_m.reshape(-1)
    # along a line of a picture of a plane, 1 / z is linear
    start_inverse = 1.0 / flat[starts]
    line_m = 1.0 / (start_inverse + share * (1.0 / flat[ends] - start_inverse))
    behind = flat[line_px] > line_m + apart_m
    return bool(behind.any(axis=0).mean() >= BEHIND)


def piece_facts(
    part: np.ndarray, pixel_m2: np.ndarray, residual_m: np.ndarray, fit: str
) -> list[dict[str, Any]]:
    """Return the facts about each piece of a part, largest first: its area in m2, the share of it
    that was judged, and the surface that was fitted to it.

    Args:
        part: (h, w) bool, the valid pixels of the part.
        pixel_m2: (h, w), area of the fitted surface that each pixel sees, m2.
        residual_m: (h, w), metres, NaN where nothing is judged.
        fit: name of the surface, which is common to all pieces."""
    _, labels = cv2.connectedComponents(part.astype(np.uint8), connectivity=4)
    labels = labels.ravel()
    counts = np.bincount(labels)
    areas_m2 = np.bincount(labels, pixel_m2.ravel())
    judged_m2 = np.bincount(labels, np.where(np.isfinite(residual_m), pixel_m2, 0.0).ravel())
    facts = []
    for number in 1 + np.argsort(-counts[1:], kind="stable"):
        if counts[number] < LEAST_PX:
            break
        area_m2 = float(areas_m2[number])
        share = float(judged_m2[number]) / max(area_m2, 1e-12)
        facts.append({"area_m2": area_m2, "share": share, "fit": fit})
    return facts


def part_text(pieces: list[dict[str, Any]]) -> str:
    """Return how many pieces a part has, and the share that was judged of what returned light."""
    area_m2 = sum(piece["area_m2"] for piece in pieces)
    judged_m2 = sum(piece["area_m2"] * piece["share"] for piece in pieces)
    plural = "" if len(pieces) == 1 else "s"
    share = 100.0 * judged_m2 / max(area_m2, 1e-12)
    return f"part: {len(pieces)} piece{plural}, {area_m2:.2g} m2 seen, {share:.0f} % of it judged"
