"""Objects on a target, print and edges in its picture, beside which false calls are more
frequent.

Objects are regions that stand before the surface as a whole; edges are those of the colour picture
or the amplitude. Not modelled: objects on clouds without a grid, or that neither stand out nor are
visible in a picture."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from scipy import ndimage

from detectors.findings.extents import extents
from detectors.interface import Detection, Evidence
from detectors.pixels.masks import grown, holes_filled, parts_with, rim_distance_px
from harness.vocabulary.geometry import Cloud

OBJECT_MARGIN_PX = 6
"""Margin around an object: its edge is mixed over 3 pixels, and its shadow lies beside it."""
PATCH_PX = 5  # side of the square that smooths residual and picture
LEAST_OBJECT_PX = 100  # least pixels of an object: four such squares
PROUD = 6.0
"""Smoothed residual in front of the surface at an object's highest point, in deviations."""
PROUD_FOOT = 3.0  # the same everywhere on it
MARKED = 8.0
"""Slope of an edge in the picture, in multiples of the median slope: a tag, print, another
material."""
MOST_MASKED = 0.5
"""Largest share of the judged area under objects: the rest must represent the whole."""
LONGEST_HOLE_PX = 35
"""A longer mark is more than a hole as the picture shows it: the widest filters judge 25 pixels,
and the squares that smooth the picture twice widen its edges by 10."""
OWN_SHARE = 0.5
"""A longer mark is still the finding itself if this share of it lies within the finding and its
margin."""


@dataclass(frozen=True)
class Marks:
    """Objects, print and edges in the picture, where false calls are more frequent."""

    proud: np.ndarray
    """(h, w) bool: objects that stand before the surface."""
    covered: np.ndarray
    """(h, w) bool: objects and edges of the picture, with their margin."""
    labels: np.ndarray
    """(h, w): number of the object or edge that is longer than a hole, without margin; 0 elsewhere.
    """
    areas: np.ndarray
    """(n + 1,): number of pixels with each number."""
    margin_px: int
    """Distance in pixels up to which a finding is at a mark."""

    @property
    def count(self) -> int:
        """Number of long marks."""
        return len(self.areas) - 1

    @cached_property
    def regions(self) -> int:
        """Number of connected regions that are covered."""
        return int(ndimage.label(self.covered)[1])

    @cached_property
    def beside_long(self) -> np.ndarray:
        """(h, w) bool: long marks, with their margin."""
        return grown(self.labels > 0, self.margin_px, cv2.MORPH_ELLIPSE)

    def hold(self, detection: Detection) -> bool:
        """Return whether a finding is at a long mark, most of which lies beyond the finding."""
        if not self.count:
            return False
        height, width = self.labels.shape
        rows, columns = np.unravel_index(detection.pixels, self.labels.shape)
        margin = self.margin_px
        top = max(int(rows.min()) - margin, 0)
        left = max(int(columns.min()) - margin, 0)
        bottom = min(int(rows.max()) + margin + 1, height)
        right = min(int(columns.max()) + margin + 1, width)
        inside = np.zeros((bottom - top, right - left), bool)
        inside[rows - top, columns - left] = True
        labels_nearby = self.labels[top:bottom, left:right][
            grown(inside, margin, cv2.MORPH_ELLIPSE)
        ]
        counts = np.bincount(labels_nearby, minlength=len(self.areas))[1:]
        return bool(((counts > 0) & (counts < OWN_SHARE * self.areas[1:])).any())


def marks_of(cloud: Cloud, evidence: Evidence) -> Marks:
    """Return the objects, print and edges of a cloud; none without a pixel grid.

    A cloud keeps them by the pixels that are judged and by their residuals, which detectors
    share."""
    digest = hashlib.blake2b(np.isfinite(evidence.score).tobytes())
    digest.update(evidence.residual_m.tobytes())
    key = digest.digest()
    if key not in cloud.marks:
        cloud.marks[key] = _marks(cloud, evidence)
    return cloud.marks[key]


def _marks(cloud: Cloud, evidence: Evidence) -> Marks:
    """Find the `marks_of` a cloud."""
    shape = evidence.score.shape
    nowhere = np.zeros(shape, bool)
    margin_px = _margin(cloud)
    if not cloud.organised:
        labels = np.zeros(shape, np.int32)
        return Marks(nowhere, nowhere, labels, np.array([nowhere.size]), margin_px)
    proud = _proud(cloud, evidence)
    objects = proud | _marked(cloud, evidence)
    covered = grown(objects, margin_px, cv2.MORPH_ELLIPSE)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(objects.astype(np.uint8))
    longer = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT])
    is_long = longer > LONGEST_HOLE_PX
    is_long[0] = False
    number = np.cumsum(is_long) * is_long
    labels = number[labels]
    areas = np.bincount(labels.ravel(), minlength=int(is_long.sum()) + 1)
    return Marks(proud, covered, labels, areas, margin_px)


def each_object_once(
    cloud: Cloud,
    evidence: Evidence,
    found: tuple[Detection, ...],
) -> tuple[Detection, ...]:
    """Return the findings, strongest first, with each object on the target as one finding:
    findings that reach its margin and are weaker belong to it.

    An object with a single finding keeps it. Nothing is joined without a pixel grid, or if objects
    would cover more than `MOST_MASKED`."""
    if not cloud.organised or not found:
        return found
    proud = _proud(cloud, evidence)
    judged = np.isfinite(evidence.score)
    if (proud & judged).sum() > MOST_MASKED * judged.sum():
        return found
    labels, count = ndimage.label(proud, np.ones((3, 3)))
    kept = list(found)
    for number in range(1, count + 1):
        region = labels == number
        flat = region.ravel()
        margin = grown(region, _margin(cloud), cv2.MORPH_ELLIPSE).ravel()
        scores = [detection.score for detection in kept if flat[detection.pixels].any()]
        height = max(scores, default=0.0)
        separate = [
            detection
            for detection in kept
            if detection.score > height or not margin[detection.pixels].any()
        ]
        if len(kept) - len(separate) >= 2:
            pixels = np.flatnonzero(region & cloud.valid)
            centre_m = extents(cloud.points_m.reshape(-1, 3)[pixels])[1]
            kept = [*separate, Detection(height, pixels, centre_m, "object")]
    return tuple(sorted(kept, key=lambda detection: -detection.score))


def _margin(cloud: Cloud) -> int:
    """Return the margin around objects in pixels: the reach of noise blurs them farther."""
    return OBJECT_MARGIN_PX + int(np.ceil(cloud.noise_reach_px / 2))


def _proud(cloud: Cloud, evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: connected regions, wider than noise, that are in front of the surface as
    a whole."""
    judged = np.isfinite(evidence.residual_m)
    weights = _boxed(judged.astype(np.float64))
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = _boxed(np.where(judged, evidence.residual_m, 0.0)) / weights
    smooth[~judged | (weights < 0.5)] = np.nan
    if not np.isfinite(smooth).any():
        return np.zeros_like(judged)
    before = np.nanmedian(smooth) - smooth
    spread = 1.4826 * np.nanmedian(np.abs(before))
    before /= max(spread, cloud.z_step_m / PATCH_PX, 1e-9)
    return parts_with(before > PROUD_FOOT, before > PROUD, least=LEAST_OBJECT_PX)


def _marked(cloud: Cloud, evidence: Evidence) -> np.ndarray:
    """Return (h, w) bool: long steep edges of the colour picture or the amplitude."""
    inside = rim_distance_px(holes_filled(np.isfinite(evidence.score))) > 2 * PATCH_PX
    edges = np.zeros(cloud.valid.shape, bool)
    channels: list[np.ndarray] = []
    if cloud.rgb is not None:
        channels += list(np.moveaxis(np.asarray(cloud.rgb, np.float64), -1, 0))
    if cloud.amplitude is not None:
        channels.append(cloud.amplitude)
    for channel in channels:
        judged = np.isfinite(channel) & inside
        if not judged.any():
            continue
        filled = np.where(np.isfinite(channel), channel, np.median(channel[judged]))
        steepness = np.hypot(*np.gradient(_boxed(_boxed(filled))))
        typical = max(float(np.median(steepness[judged])), 1e-9)
        edges |= judged & (steepness > MARKED * typical)
    return parts_with(edges, edges, least=LEAST_OBJECT_PX)


def _boxed(image: np.ndarray) -> np.ndarray:
    return cv2.blur(image, (PATCH_PX, PATCH_PX), borderType=cv2.BORDER_REFLECT)
