"""Groups of coloured pixels: what may be a mark, with its rim."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from detectors.clusters import euclidean_clusters
from detectors.marks.pixelation import region_covariance_px2
from detectors.masks import grown, parts_with, shrunk
from harness.vocabulary.capture import Cloud

LEAST_PIXELS = 9
"""Least pixels of a mark: three by three. Fewer have no inside, so nothing tells them from noise or from a rim."""
MOST_BLOBS = 200
"""The largest are looked at: more than this is speckle."""
RIM_PX = 2
"""Reach beyond the pixels found in which a mixed rim is looked for."""
RING_PX = 8
"""Reach of the surroundings whose colour is compared; they begin where a window of five pixels misses the rim."""
MIXED_SHARE = 0.15
"""Share of the rim two pixels wide: colours that are means over the pixel's area put 0.6 / 2 of it between 0.2 and 0.8
of the way from one colour to the other, colours of the pixel's centre none."""
SHARE_SIGMA = 0.1
"""Deviation of a rim's colour as a share of area: a camera's transfer curve and its lens's blur are not known. A curve
of 1 / 2.2 moves the shares between two colours of a contrast of five by as much."""
ALIKE = 0.35
"""A pixel has a blob's colour where its distance to it is less than this part of that to the surroundings' colour."""
CUT_SHARE = 0.05
"""Share of the pixels around a blob: so many of its own colour, but off the target, mean that it goes on there."""
GAP_SPACINGS = 2.2
"""Steps between points of one mark in a cloud without a grid: neighbours along a diagonal (1.4), and one missing."""


@dataclass(frozen=True)
class Blob:
    """``pixels`` (n,) flat indices and ``weights`` (n,) how much of the blob's colour they have, 0..1. ``grid`` (n, 2)
    their places on a grid of unit step. ``share_covariance`` (2, 2) of the centroid there where weights are shares of
    area, else None. ``surroundings`` (m,) flat indices of the target's points on and about it. ``contrast`` (3,):
    logarithm of its colour over that of its surroundings, channel by channel, in which the light cancels. ``doubt``:
    that it is cut, empty if not."""

    pixels: np.ndarray
    weights: np.ndarray
    grid: np.ndarray
    share_covariance: np.ndarray | None
    surroundings: np.ndarray
    contrast: np.ndarray
    doubt: str = ""

    @property
    def grid_covariance(self) -> np.ndarray:
        """Covariance (2, 2) of the centroid on the grid."""
        return region_covariance_px2(self.grid) if self.share_covariance is None else self.share_covariance


def find_blobs(cloud: Cloud, inside: np.ndarray, coloured: np.ndarray) -> list[Blob]:
    """Find the connected groups of ``coloured`` (h, w) pixels, the largest first; single missing pixels do not part
    them.

    Whether a rim's colours are mixtures is a property of the camera, so it is decided for all groups together.
    """
    if not cloud.organised:
        return _in_space(cloud, inside, coloured)
    closed = cv2.morphologyEx(coloured.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    order = 1 + np.argsort(-boxes[1:, cv2.CC_STAT_AREA], kind="stable")[:MOST_BLOBS]
    windows = [
        _window(cloud, inside, coloured, labels, int(label), boxes[label])
        for label in order
        if boxes[label, cv2.CC_STAT_AREA] >= LEAST_PIXELS
    ]
    rims = np.concatenate([window.share[window.rim] for window in windows]) if windows else np.zeros(0)
    mixed = len(rims) > 0 and bool(np.mean((rims > 0.2) & (rims < 0.8)) >= MIXED_SHARE)
    blobs = [blob for window in windows if (blob := _blob(window, mixed, inside.shape)) is not None]
    # those that share pixels with a larger one are parts of it
    taken = np.zeros(inside.size, dtype=bool)
    kept = []
    for blob in sorted(blobs, key=lambda b: -float(b.weights.sum())):
        own = blob.pixels[blob.weights > 0.5]
        if not taken[own].any():
            kept.append(blob)
        taken[own] = True
    return kept


@dataclass(frozen=True)
class _Window:
    """A part of the grid about one group, from ``row`` and ``column`` on: the ``group``, the target and the other
    groups there; and the ``share`` of the way from the surroundings' colour (0) to the group's (1) of each pixel's.

    ``alike``: pixels of the group's colour. ``strays``: the deviation of independent pixels that would average over
    5 x 5 as the surroundings' shares do: neighbours share their colour in a camera's mosaic and in JPEG.
    """

    row: int
    column: int
    group: np.ndarray
    inside: np.ndarray
    valid: np.ndarray
    others: np.ndarray
    share: np.ndarray
    alike: np.ndarray
    contrast: np.ndarray
    strays: float
    doubt: str

    @property
    def rim(self) -> np.ndarray:
        """Pixels on either side of the group's border."""
        return grown(self.group, 1) & ~_eroded(self.group) & self.inside


def _window(
    cloud: Cloud, inside: np.ndarray, coloured: np.ndarray, labels: np.ndarray, label: int, box: np.ndarray
) -> _Window:
    left, top, width, height, area = (int(value) for value in box)
    margin = max(RING_PX + 2, round(0.5 * np.sqrt(area)))
    row, column = max(top - margin, 0), max(left - margin, 0)
    cut = (slice(row, top + height + margin), slice(column, left + width + margin))
    assert cloud.rgb is not None
    target = inside[cut]
    group = (labels[cut] == label) & coloured[cut]
    core = _eroded(group)
    core = core if core.sum() >= LEAST_PIXELS else group
    ring = grown(group, RING_PX) & ~grown(group, RIM_PX + 2) & target & ~coloured[cut]
    alone = ring.sum() < LEAST_PIXELS
    rgb = cloud.rgb[cut].astype(float) if alone else _evenly_lit(cloud.rgb[cut].astype(float), ring, group)
    other = np.zeros(3) if alone else np.median(rgb[ring], axis=0)
    span = np.median(rgb[core], axis=0) - other
    share = (rgb - other) @ span / max(float(span @ span), 1e-12)
    away, averaged = np.linalg.norm(rgb - other - span, axis=-1), cv2.blur(share, (5, 5))
    if not alone:
        # the threshold that found the group knows the target's colour only, and leaves gaps where contrast is low: the
        # connected pixels more of the group's colour than not, as far as the surroundings reach
        group = parts_with((share > 0.5) & target & grown(group, RING_PX), group)
    return _Window(
        row=row,
        column=column,
        group=group,
        inside=target,
        valid=cloud.valid[cut],
        others=coloured[cut] & ~group,
        share=group.astype(float) if alone else share,
        alike=away < ALIKE * np.linalg.norm(span),
        contrast=_contrast(other + span, np.median(rgb[target], axis=0) if alone else other),
        strays=0.0 if alone else float(np.sqrt(max(np.mean(share[ring] ** 2), 25.0 * np.mean(averaged[ring] ** 2)))),
        doubt="nothing of the target's own colour is seen around it" if alone else "",
    )


def _contrast(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the logarithm (3,) of one colour over another; a count is added to each, so that black has one."""
    return np.asarray(np.log((own + 1.0) / (other + 1.0)))


def _evenly_lit(rgb: np.ndarray, ring: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return colours (h, w, 3) as if the light were everywhere that at the group's middle: each channel over the ring's
    plane through it. Light that falls off along a group would else weigh its two ends differently."""
    v, u = np.mgrid[0 : rgb.shape[0], 0 : rgb.shape[1]]
    middle_v, middle_u = (float(axis[group].mean()) for axis in (v, u))
    basis = np.stack([np.ones(rgb.shape[:2]), (u - middle_u) / rgb.shape[1], (v - middle_v) / rgb.shape[0]], axis=-1)
    plane = np.linalg.lstsq(basis[ring], rgb[ring], rcond=1e-9)[0]
    light = basis @ plane / np.maximum(plane[0], 1.0)
    return np.asarray(rgb / np.clip(light, 0.5, 2.0))


def _blob(window: _Window, mixed: bool, shape: tuple[int, int]) -> Blob | None:
    """Return the group as a blob: with ``mixed`` rims each pixel counts as far as it has the group's colour, else
    wholly."""
    weights = window.group.astype(float)
    if mixed:
        near = grown(window.group, RIM_PX) & window.inside & ~window.others
        weights = np.where(near, np.clip(window.share, 0.0, 1.0), 0.0)
    v, u = np.nonzero((weights > 0.5) & window.inside)
    if len(u) < LEAST_PIXELS or min(np.ptp(u), np.ptp(v)) < 1:
        return None
    used_v, used_u = np.nonzero((weights > 0) & window.inside)
    near_v, near_u = np.nonzero(window.inside)
    return Blob(
        pixels=(used_v + window.row) * shape[1] + used_u + window.column,
        weights=weights[used_v, used_u],
        grid=np.stack([used_u, used_v], axis=1).astype(float),
        share_covariance=_share_covariance(window, float(weights.sum())) if mixed else None,
        surroundings=(near_v + window.row) * shape[1] + near_u + window.column,
        contrast=window.contrast,
        doubt=window.doubt or _cut(np.stack([u, v], axis=1), window, shape),
    )


def _cut(own: np.ndarray, window: _Window, shape: tuple[int, int]) -> str:
    """Return why the group, with its ``own`` places (n, 2), goes on where the target's points do not."""
    around = grown(window.group, 1) & ~window.group
    on = around & window.alike & ~window.inside
    if on.sum() > max(2.0, CUT_SHARE * around.sum()):
        crop_cuts = (on & window.valid).sum() > on.sum() / 2
        return "cut by the crop's edge" if crop_cuts else "without range in parts of it"
    (left, top), (right, bottom) = own.min(axis=0), own.max(axis=0)
    at_start = window.column + left == 0 or window.row + top == 0
    at_end = window.column + right == shape[1] - 1 or window.row + bottom == shape[0] - 1
    return "cut by the picture's edge" if at_start or at_end else ""


def _share_covariance(window: _Window, total: float) -> np.ndarray:
    """Return the covariance (2, 2) of a weighted centroid: the weights of its rim are wrong by `SHARE_SIGMA`, and by
    what the surroundings' colours stray."""
    variance = SHARE_SIGMA**2 + window.strays**2
    v, u = np.nonzero(window.rim)
    own_v, own_u = np.nonzero(window.group)
    arm = np.stack([u - own_u.mean(), v - own_v.mean()], axis=1)
    return np.asarray(variance * arm.T @ arm / max(total, 1.0) ** 2)


def _eroded(mask: np.ndarray) -> np.ndarray:
    """Take a pixel off the mask; beyond the window counts as outside."""
    return shrunk(np.pad(mask, 1), 3)[1:-1, 1:-1]


def _in_space(cloud: Cloud, inside: np.ndarray, coloured: np.ndarray) -> list[Blob]:
    """Find groups of points without a grid, by their distances; no rim, and no telling whether they are cut."""
    from scipy.spatial import cKDTree

    found, target = np.flatnonzero(coloured), np.flatnonzero(inside)
    points = cloud.points_m.reshape(-1, 3)
    if len(found) < LEAST_PIXELS:
        return []
    assert cloud.rgb is not None
    rgb = cloud.rgb.reshape(-1, 3).astype(float)
    usual = np.median(rgb[target], axis=0)
    spacing = float(np.median(cKDTree(points[found]).query(points[found], k=2)[0][:, 1]))
    labels = euclidean_clusters(points[found], GAP_SPACINGS * spacing, LEAST_PIXELS)
    sizes = np.bincount(labels[labels >= 0], minlength=1)
    blobs = []
    for label in np.argsort(-sizes, kind="stable")[:MOST_BLOBS]:
        pixels = found[labels == label]
        if len(pixels) < LEAST_PIXELS:
            continue
        away = points[pixels] - points[pixels].mean(axis=0)
        reach = 1.5 * np.linalg.norm(away, axis=1).max()
        _, sizes_, axes = np.linalg.svd(away, full_matrices=False)
        if sizes_[1] < spacing:
            continue
        grid = away @ axes[:2].T / spacing
        near = np.linalg.norm(points[target] - points[pixels].mean(axis=0), axis=1) < reach
        contrast = _contrast(np.median(rgb[pixels], axis=0), usual)
        blobs.append(Blob(pixels, np.ones(len(pixels)), grid, None, target[near], contrast))
    return blobs
