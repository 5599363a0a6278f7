"""Virtual holes in the residuals of a real capture, as its camera would blur them.

A hole is a disc of one depth, averaged over the square in which the capture's pixels share their
noise, and by a lens. It is added to the residuals, so that they keep their noise, pattern and
shape. Upsampled depth was interpolated besides, and rounding hides where its noise's correlation
ends, so that it blurs more than its noise tells: `UPSAMPLED`. Not modelled: holes so deep that they
mix with what lies behind or return nothing, rims, light in the hole, and what the fitted surface
would absorb of wide holes."""

from dataclasses import dataclass

import cv2
import numpy as np

from detectors.findings.templates import FINER, LENS_BLUR_PX
from detectors.pixels.noise import WIDEST_NATIVE_PX

BESIDE_PX = 4  # what lens and rounding to pixels add around a hole
UPSAMPLED = (1.5, 1.0)
"""Sides of two squares that average upsampled depth, in reaches of its noise. The Azure Kinect's
own filter, 5 pixels, is 12 pixels in depth aligned to colour whose noise reaches 8; there, holes 11
pixels wide look 18 pixels wide at half of their depth, and with these squares 13."""


@dataclass(frozen=True, eq=False)
class VirtualHoles:
    """Holes in one picture, in pixels of the picture."""

    rows: np.ndarray
    """(n,) int: rows of their centres."""
    columns: np.ndarray
    """(n,) int."""
    widths_px: np.ndarray
    """(n,): diameters before the blur."""
    depths_m: np.ndarray
    """(n,): depths along the viewing axis before the blur."""

    def __len__(self) -> int:
        return len(self.rows)


def places_apart(
    free: np.ndarray,
    count: int,
    apart_px: float,
    stream: np.random.Generator,
) -> np.ndarray:
    """Return up to ``count`` places (n, 2), rows and columns, drawn from the pixels that are
    ``free`` (h, w) bool, no two nearer than ``apart_px``."""
    is_free = free.astype(np.uint8)
    centres_px: list[tuple[int, int]] = []
    while len(centres_px) < count:
        remaining = np.flatnonzero(is_free)
        if not len(remaining):
            break
        pixel = int(remaining[stream.integers(len(remaining))])
        row, column = divmod(pixel, free.shape[1])
        centres_px.append((row, column))
        cv2.circle(is_free, (column, row), int(np.ceil(apart_px)), 0, cv2.FILLED)
    return np.array(centres_px, dtype=np.int64).reshape(-1, 2)


def squares_px(reach_px: float) -> tuple[float, ...]:
    """Return the sides of the squares over which a capture averages depth one after the other, by
    how far its noise reaches."""
    if reach_px <= WIDEST_NATIVE_PX:
        return (max(reach_px, 1.0),)
    return tuple(factor * reach_px for factor in UPSAMPLED)


def hole_image(width_px: float, squares: tuple[float, ...]) -> np.ndarray:
    """Return a hole of depth 1 (r, r), r odd, as a camera sees it whose depth is averaged over
    squares of these sides in pixels, and by a lens (`LENS_BLUR_PX`). It sums up to the disc's
    area."""
    half = int(np.ceil((width_px + sum(squares)) / 2)) + BESIDE_PX
    side = 2 * half + 1
    positions = (np.arange(side * FINER) + 0.5) / FINER - (half + 0.5)
    distances = np.hypot(positions[:, None], positions[None, :])
    fine: np.ndarray = (distances < width_px / 2).astype(np.float64)
    border = cv2.BORDER_CONSTANT
    for square_px in squares:
        window = max(1, round(square_px * FINER))
        fine = cv2.blur(fine, (window, window), borderType=border)
    fine = cv2.GaussianBlur(fine, (0, 0), LENS_BLUR_PX * FINER, borderType=border)
    return np.asarray(fine.reshape(side, FINER, side, FINER).mean(axis=(1, 3)))


def with_holes(
    residual_m: np.ndarray,
    holes: VirtualHoles,
    squares: tuple[float, ...],
) -> np.ndarray:
    """Return the residuals (h, w), metres, NaN where unknown, with these holes, averaged over
    ``squares``; what reaches over the picture's edge is cut off."""
    height, width = residual_m.shape
    changed_m = residual_m.copy()
    images: dict[float, np.ndarray] = {}
    for row, column, width_px, depth_m in zip(
        holes.rows.tolist(),
        holes.columns.tolist(),
        holes.widths_px.tolist(),
        holes.depths_m.tolist(),
        strict=True,
    ):
        if width_px not in images:
            images[width_px] = hole_image(width_px, squares)
        image = images[width_px]
        half = len(image) // 2
        top = max(row - half, 0)
        left = max(column - half, 0)
        cut = np.s_[top : min(row + half + 1, height), left : min(column + half + 1, width)]
        rows = np.s_[top - row + half : top - row + half + changed_m[cut].shape[0]]
        columns = np.s_[left - column + half : left - column + half + changed_m[cut].shape[1]]
        changed_m[cut] += depth_m * image[rows, columns]
    return changed_m
