"""Depth steps as a camera shows them: pixels that vanish, that fly between the surfaces, and that change sides.

Pixels are placed by their signed distance from the true edge along one image axis, in pixels: below 0 on the front,
above 0 on the back. Counts are per line of pixels across the edge, so they are widths in pixels. Plateaus of a few
pixels show how much of a step the camera's filter leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from harness.scorecard.bench import NOISE, Bench, taken
from harness.scorecard.noise import temporal_sigma_m
from harness.vocabulary.seeds import digest
from harness.vocabulary.units import MM
from scenes.closed_form import Plane, layered_view

if TYPE_CHECKING:
    from harness.scorecard.quantities import PlateauConditions, StepConditions

TOLERANCE_SIGMAS = 4.0
TOLERANCE_STEP = 0.1
"""A pixel is on a surface within four deviations of its noise and a tenth of the step of it."""
LEAST_TOLERANCE_M = 0.5 * MM
MOST_OF_STEP = 0.45
EDGE_PATCH = (40, 96)
"""Pixels along and across the edge."""
REACH_PX = 44.0
"""Distance from the edge within which pixels are counted: beyond the widest shadow at 0.75 m shorter than 44 pixels."""
SLANT = 0.1
"""Pixels across for each pixel along: every position of the edge within a pixel occurs, as in ISO 12233."""
FLAT_PX = 8.0
"""Distance from an edge beyond which the camera's filter sees a single surface."""
PITCH_PX = 22
"""Distance of plateaus: the largest diameter, and twice the reach of a filter of 11 pixels."""
COPIES = (4, 4)
R2 = (0.7548776662466927, 0.5698402909980532)
"""Roberts' low-discrepancy sequence: the plateaus' positions within a pixel."""


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
    """Return the distance from a surface within which a range counts as this surface's; NaN where noise hides the
    step: a tolerance of more than `MOST_OF_STEP` of it would join the surfaces."""
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


@lru_cache(maxsize=4)
def widths(bench: Bench, c: StepConditions) -> EdgeWidths:
    """Widths at a straight edge near the axis, slightly off the pixel grid.

    The front is where sign (across - slant along) < 0; across and along in pixels of the undistorted lens about the
    principal point, so the edge is straight in space.
    """
    camera, axis = bench.camera, ("x", "y").index(c.across)
    lens = camera.nominal_lens
    region = bench.patch(*(EDGE_PATCH if axis == 0 else EDGE_PATCH[::-1]))
    toward_emitter = -1.0 if camera.optics.emitter_m[axis] < 0 else 1.0
    # the front lies where sign * (position across) < edge: on the emitter's side for a shadow
    sign = -toward_emitter if c.shadow else toward_emitter

    def signed_px(slopes: np.ndarray) -> np.ndarray:
        px = slopes * np.array([lens.fx, lens.fy])
        return np.asarray(sign * (px[..., axis] - SLANT * px[..., 1 - axis]))

    def covers(slopes: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.asarray(signed_px(slopes) < 0)

    front, back = Plane(c.distance_m), Plane(c.distance_m + c.step_mm * MM)
    unit = bench.unit(layered_view(camera, region, front, back, covers, c.albedo), NOISE)
    stack = taken(unit, bench.effort.edge_frames, bench.camera_name, "step", digest(c.to_data()))
    from_edge = signed_px(lens.region_slopes(unit.region))
    flat = np.abs(from_edge) > FLAT_PX
    tolerance_m = on_surface_tolerance_m(temporal_sigma_m(stack.z_m, flat), c.step_mm * MM)
    front_z, back_z = (plane.z_along_m(stack.slopes) for plane in (front, back))
    return edge_widths(stack.z_m, front_z, back_z, from_edge, tolerance_m, REACH_PX, unit.region.shape[axis])


def seen_shares(bench: Bench, c: PlateauConditions) -> np.ndarray:
    """Seen share of the height at the pixel nearest to each plateau's centre; NaN where most frames have no range.

    Round plateaus stand on a grid about the principal point, each at another place within its pixel. Places are in
    pixels of the undistorted lens about the principal point; near the axis these are the sensor's.
    """
    camera, (rows, columns) = bench.camera, COPIES
    lens = camera.nominal_lens
    v, u = np.mgrid[:rows, :columns]
    number = (u + columns * v + 1)[..., None]
    grid = np.stack([u - (columns - 1) / 2, v - (rows - 1) / 2], axis=-1) * PITCH_PX
    centres = grid + (number * np.array(R2)) % 1 - 0.5

    def covers(slopes: np.ndarray) -> np.ndarray:
        known = np.isfinite(slopes).all(axis=-1)
        at = np.where(known[..., None], slopes, 1e3) * [lens.fx, lens.fy]
        cell = at / PITCH_PX + [(columns - 1) / 2, (rows - 1) / 2]
        nearest = np.clip(np.round(cell), 0, [columns - 1, rows - 1]).astype(int)
        off = at - centres[nearest[..., 1], nearest[..., 0]]
        return np.asarray(known & ((off**2).sum(axis=-1) < (c.diameter_px / 2) ** 2))

    region = bench.patch(rows * PITCH_PX, columns * PITCH_PX)
    step_m = c.step_mm * MM
    front, back = Plane(c.distance_m), Plane(c.distance_m + step_m)
    unit = bench.unit(layered_view(camera, region, front, back, covers, c.albedo), NOISE)
    stack = taken(unit, bench.effort.edge_frames, bench.camera_name, "plateaus", digest(c.to_data()))
    middles = centres.reshape(-1, 2) / [lens.fx, lens.fy]
    pixels = np.round(lens.project(np.concatenate([middles, np.ones((len(middles), 1))], axis=-1))).astype(int)
    at = (pixels[:, 1] - unit.region.row0, pixels[:, 0] - unit.region.col0)
    z = stack.z_m[:, at[0], at[1]]
    often = np.isfinite(z).mean(axis=0) > 0.5
    height = np.full(len(pixels), np.nan)
    height[often] = back.z_along_m(stack.slopes)[at][often] - np.nanmean(z[:, often], axis=0)
    return height / step_m
