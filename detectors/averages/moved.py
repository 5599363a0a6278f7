"""Pictures that move across the image between two frames of one recording.

The whole range does not jump where a camera slides along a flat part, so frames still belong to one
scene by their distances; but the mean smears all damage. Each frame's relief is correlated with the
other's at all displacements. That of a static camera fits best without any."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import scipy.fft

from harness.vocabulary.geometry import Cloud, Frame

RELIEF_PX = 41
"""Side of the square against whose mean the relief is taken."""
LEAST_KNOWN = 0.8  # share of the square's pixels that are known
CLIP_SIGMAS = 6.0
"""Largest relief, in robust deviations of it: deep holes weigh no more than shallow ones."""
NOISE_SIGMAS = 3.0
"""Relief up to this many robust deviations does not count."""
FEWEST_PX = 200
"""Least number of pixels with relief in each frame: fewer may coincide by chance."""
ALIKE = 0.5
"""Least correlation at the best displacement, and largest share of it without a displacement, of a
picture that moved."""


def motion_doubt(frames: Iterable[Frame], cloud: Cloud, z_step_m: float) -> str:
    """Return a warning if the picture of the last frame used lies elsewhere than that of the first,
    else "". ``frames``: of the recording whose average is ``cloud``, with ``z_step_m`` as the
    rounding step of z."""
    if not cloud.organised or cloud.n_frames < 2:
        return ""
    left_out = {frame.name for frame in cloud.left_out}
    first = last = None
    for frame in frames:
        if frame.name in left_out:
            continue
        first = first or frame
        last = frame
    if first is None or last is None:
        return ""
    moved_px = displacement_px(first.z_m, last.z_m, z_step_m)
    if moved_px is None:
        return ""
    across, down = moved_px
    return (
        f"the picture moved by {float(np.hypot(across, down)):.0f} pixels from {first.name} to"
        f" {last.name}: damage is smeared over the frames, or missed; keep the camera still, or use"
        " the frames of one position (--max-frames N)"
    )


def displacement_px(
    first_z_m: np.ndarray, last_z_m: np.ndarray, z_step_m: float
) -> tuple[int, int] | None:
    """Return by how many pixels (across, down) the relief of the last picture (h, w) lies beside
    that of the first; None if it lies there as well as elsewhere, or if there is too little of
    it."""
    first = relief(first_z_m, z_step_m)
    last = relief(last_z_m, z_step_m)
    if min(np.count_nonzero(first), np.count_nonzero(last)) < FEWEST_PX:
        return None
    spectrum = scipy.fft.rfft2(last) * np.conj(scipy.fft.rfft2(first))
    products = scipy.fft.irfft2(spectrum, first.shape)
    correlation = products / np.sqrt(float((first**2).sum()) * float((last**2).sum()))
    height, width = first.shape
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    best = float(correlation[row, column])
    if best < ALIKE or correlation[0, 0] > ALIKE * best:
        return None
    # displacements beyond half of the picture are negative ones
    down = (int(row) + height // 2) % height - height // 2
    across = (int(column) + width // 2) % width - width // 2
    return across, down


def relief(z_m: np.ndarray, z_step_m: float) -> np.ndarray:
    """Return (h, w) by how much each pixel differs from the mean around it, in metres beyond noise
    and rounding (whose steps move across a tilted surface as its distance drifts); 0 where nothing
    is known."""
    is_known = np.isfinite(z_m)
    square = (RELIEF_PX, RELIEF_PX)
    known_z_m = np.where(is_known, z_m, 0.0).astype(np.float64)
    share = cv2.blur(is_known.astype(np.float64), square, borderType=cv2.BORDER_CONSTANT)
    mean_m = cv2.blur(known_z_m, square, borderType=cv2.BORDER_CONSTANT)
    # where much is unknown, what is known lies aside, and a slope would pass for relief
    is_judged = is_known & (share > LEAST_KNOWN)
    difference_m = np.where(is_judged, z_m - mean_m / np.maximum(share, 1e-9), 0.0)
    if not is_judged.any():
        return difference_m
    sigma_m = float(np.median(np.abs(difference_m[is_judged]))) / 0.6745
    least_m = max(NOISE_SIGMAS * sigma_m, z_step_m)
    most_m = max(CLIP_SIGMAS * sigma_m, 2.0 * z_step_m)
    sizes_m = np.clip(np.abs(difference_m), 0.0, most_m)
    return np.where(sizes_m > least_m, np.sign(difference_m) * sizes_m, 0.0)
