"""What a camera makes of a depth step: pixels that vanish, that fly between the surfaces, and that change sides.

Pixels are placed by their signed distance from the true edge along one image axis, in pixels: below 0 on the front,
above 0 on the back. Counts are per line of pixels across the edge, so they are widths in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.vocabulary.units import MM

TOLERANCE_SIGMAS = 4.0
TOLERANCE_STEP = 0.1
"""A pixel is on a surface within four deviations of its noise and a tenth of the step of it."""
LEAST_TOLERANCE_M = 0.5 * MM
MOST_OF_STEP = 0.45


@dataclass(frozen=True)
class EdgeWidths:
    """Widths across an edge in pixels, one value a frame (n,).

    ``gap``: pixels without a range. ``flying``: pixels with a range off both surfaces. ``front_erosion``: pixels whose
    central ray meets the front and that do not show it; ``back_erosion``: the same of the back, shadow included.
    All but the gap are NaN where noise hides the step.
    """

    gap: np.ndarray
    flying: np.ndarray
    front_erosion: np.ndarray
    back_erosion: np.ndarray


def on_surface_tolerance_m(sigma_m: float, step_m: float) -> float:
    """How far from a surface a range still counts as this surface's; NaN where noise hides the step: a tolerance of
    more than `MOST_OF_STEP` of it would make the surfaces one."""
    noise = TOLERANCE_SIGMAS * sigma_m if np.isfinite(sigma_m) else 0.0
    tolerance_m = max(noise, TOLERANCE_STEP * step_m, LEAST_TOLERANCE_M)
    return tolerance_m if tolerance_m <= MOST_OF_STEP * step_m else float("nan")


def edge_widths(
    z_m: np.ndarray,
    front_z_m: np.ndarray,
    back_z_m: np.ndarray,
    from_edge_px: np.ndarray,
    tolerance_m: float,
    reach_px: float,
    lines: int,
) -> EdgeWidths:
    """Widths of what frames (n, h, w) show within ``reach_px`` of an edge that ``lines`` lines of pixels cross.

    ``front_z_m`` and ``back_z_m`` (h, w): z of both surfaces along each pixel's ray, the back a step farther.
    ``from_edge_px`` (h, w): signed distance from the edge, NaN for pixels that do not count.
    """
    with np.errstate(invalid="ignore"):
        near = np.abs(from_edge_px) <= reach_px
    z, front_z, back_z, side = z_m[:, near], front_z_m[near], back_z_m[near], from_edge_px[near]
    valid = np.isfinite(z)
    gap = (~valid).sum(axis=1) / lines
    if np.isnan(tolerance_m):
        unknown = np.full(len(z_m), np.nan)
        return EdgeWidths(gap, unknown, unknown, unknown)
    with np.errstate(invalid="ignore"):
        shows_front = valid & (np.abs(z - front_z) <= tolerance_m)
        shows_back = valid & (np.abs(z - back_z) <= tolerance_m)
    return EdgeWidths(
        gap=gap,
        flying=(valid & ~shows_front & ~shows_back).sum(axis=1) / lines,
        front_erosion=(~shows_front[:, side < 0]).sum(axis=1) / lines,
        back_erosion=(~shows_back[:, side >= 0]).sum(axis=1) / lines,
    )
