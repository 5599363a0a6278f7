"""Steps on the bench: straight edges, and plateaus of a few pixels."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from harness.scorecard.bench import NOISE, Bench, Stack, taken
from harness.scorecard.conditions import PlateauConditions, StepConditions, SurvivalConditions
from harness.scorecard.edges import EdgeWidths, edge_widths, on_surface_tolerance_m
from harness.scorecard.estimate import Estimate, mean_of
from harness.scorecard.temporal import temporal_sigma_m
from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import digest
from harness.vocabulary.units import MM
from scenes.closed_form import Plane, layered_view
from scenes.sensor.camera import AnyCamera

EDGE_PATCH = (40, 96)
"""Pixels along and across the edge."""
REACH_PX = 44.0
"""How far from the edge pixels are counted: beyond the widest shadow at 0.75 m that is shorter than 44 pixels."""
SLANT = 0.1
"""Pixels across for each pixel along: every position of the edge within a pixel occurs, as in ISO 12233."""
FLAT_PX = 8.0
"""Beyond this distance from an edge the camera's filter sees one surface."""
PITCH_PX = 22
"""Between plateaus: the largest one, and twice the reach of a filter of 11 pixels."""
COPIES = (4, 4)
SURVIVES = 0.5
"""A step survives where at least this share of its height is seen, in most plateaus."""
LADDER_MM = (2.0, 5.0, 10.0, 20.0, 35.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 500.0)
"""Heights that are tried for the smallest step that survives."""
R2 = (0.7548776662466927, 0.5698402909980532)
"""Roberts' low-discrepancy sequence: the plateaus' positions within a pixel."""


def gap(bench: Bench, c: StepConditions) -> Estimate:
    """Pixels without a range across an edge."""
    return mean_of(_widths(bench, c).gap)


def flying(bench: Bench, c: StepConditions) -> Estimate:
    """Pixels with a range that belongs to neither surface."""
    return mean_of(_widths(bench, c).flying)


def front_erosion(bench: Bench, c: StepConditions) -> Estimate:
    """Pixels that look at the front and do not show it."""
    return mean_of(_widths(bench, c).front_erosion)


def back_erosion(bench: Bench, c: StepConditions) -> Estimate:
    """Pixels that look at the back and do not show it."""
    return mean_of(_widths(bench, c).back_erosion)


def seen_share(bench: Bench, c: PlateauConditions) -> Estimate:
    """Seen height in the middle of a plateau by its true height: the mean over plateaus that most frames see."""
    return mean_of(_shares(bench, c))


def smallest_step(bench: Bench, c: SurvivalConditions) -> Estimate:
    """The lowest height tried of which at least half is seen in most plateaus; infinite where none survives."""
    from harness.evaluation.intervals import Interval

    below = 0.0
    for step_mm in LADDER_MM:
        shares = _shares(bench, PlateauConditions(**c.to_data(), step_mm=step_mm))
        if np.mean(np.nan_to_num(shares, nan=0.0) >= SURVIVES) > 0.5:
            return Estimate(step_mm, Interval(below, step_mm))
        below = step_mm
    return Estimate(float("inf"), Interval(below, float("inf")))


# ---- straight edges --------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def _widths(bench: Bench, c: StepConditions) -> EdgeWidths:
    camera, axis = bench.camera, ("x", "y").index(c.across)
    region = bench.patch(*(EDGE_PATCH if axis == 0 else EDGE_PATCH[::-1]))
    toward_emitter = -1.0 if camera.optics.emitter_m[axis] < 0 else 1.0
    # the front lies where sign * (position across) < edge: on the emitter's side for a shadow
    sign = -toward_emitter if c.shadow else toward_emitter
    front, back = Plane(c.distance_m), Plane(c.distance_m + c.step_mm * MM)
    edge = _SlantedEdge(camera, axis, sign)
    view = layered_view(camera, region, front, back, edge.covers, c.albedo)
    unit = bench.unit(view, NOISE)
    stack = taken(unit, bench.effort.edge_frames, bench.camera_name, "step", digest(c.to_data()))
    from_edge = edge.from_edge_px(unit.region)
    flat = np.abs(from_edge) > FLAT_PX
    tolerance_m = on_surface_tolerance_m(temporal_sigma_m(stack.z_m, flat), c.step_mm * MM)
    front_z, back_z = (plane.z_along_m(stack.slopes) for plane in (front, back))
    lines = unit.region.shape[axis]
    return edge_widths(stack.z_m, front_z, back_z, from_edge, tolerance_m, REACH_PX, lines)


class _SlantedEdge:
    """A straight line near the axis, slightly off the pixel grid; the front is where sign (across - slant along) < 0.

    Across and along in pixels of the undistorted lens about the principal point, so the edge is straight in space.
    """

    def __init__(self, camera: AnyCamera, axis: int, sign: float) -> None:
        self.camera, self.axis, self.sign = camera, axis, sign

    def _signed(self, slopes: np.ndarray) -> np.ndarray:
        lens = self.camera.nominal_lens
        px = slopes * np.array([lens.fx, lens.fy])
        return np.asarray(self.sign * (px[..., self.axis] - SLANT * px[..., 1 - self.axis]))

    def covers(self, slopes: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.asarray(self._signed(slopes) < 0)

    def from_edge_px(self, region: Region) -> np.ndarray:
        return self._signed(self.camera.nominal_lens.region_slopes(region))


# ---- plateaus --------------------------------------------------------------------------------------------------------


def _shares(bench: Bench, c: PlateauConditions) -> np.ndarray:
    """Seen share of the height at the pixel nearest to each plateau's centre; NaN where most frames have no range."""
    camera, plateaus = bench.camera, _Plateaus(bench.camera, c.diameter_px)
    region = bench.patch(*(count * PITCH_PX for count in COPIES))
    step_m = c.step_mm * MM
    front, back = Plane(c.distance_m), Plane(c.distance_m + step_m)
    unit = bench.unit(layered_view(camera, region, front, back, plateaus.covers, c.albedo), NOISE)
    stack = taken(unit, bench.effort.edge_frames, bench.camera_name, "plateaus", digest(c.to_data()))
    return _seen_in_the_middle(stack, unit.region, plateaus.pixels, back.z_along_m(stack.slopes)) / step_m


class _Plateaus:
    """Round plateaus on a grid about the principal point, each at another place within its pixel.

    Places are in pixels of the undistorted lens about the principal point; near the axis these are the sensor's.
    """

    def __init__(self, camera: AnyCamera, diameter_px: float) -> None:
        self._lens, self._radius = camera.nominal_lens, diameter_px / 2
        rows, columns = COPIES
        v, u = np.mgrid[:rows, :columns]
        number = (u + columns * v + 1)[..., None]
        grid = np.stack([u - (columns - 1) / 2, v - (rows - 1) / 2], axis=-1) * PITCH_PX
        self._centres = grid + (number * np.array(R2)) % 1 - 0.5

    @property
    def pixels(self) -> np.ndarray:
        """(n, 2) the sensor's pixel (u, v) nearest to each centre."""
        slopes = self._centres.reshape(-1, 2) / [self._lens.fx, self._lens.fy]
        rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=-1)
        return np.round(self._lens.project(rays)).astype(int)

    def covers(self, slopes: np.ndarray) -> np.ndarray:
        rows, columns = COPIES
        known = np.isfinite(slopes).all(axis=-1)
        at = np.where(known[..., None], slopes, 1e3) * [self._lens.fx, self._lens.fy]
        cell = at / PITCH_PX + [(columns - 1) / 2, (rows - 1) / 2]
        nearest = np.clip(np.round(cell), 0, [columns - 1, rows - 1]).astype(int)
        off = at - self._centres[nearest[..., 1], nearest[..., 0]]
        return np.asarray(known & ((off**2).sum(axis=-1) < self._radius**2))


def _seen_in_the_middle(stack: Stack, region: Region, pixels: np.ndarray, back_z_m: np.ndarray) -> np.ndarray:
    """(n,) height in metres over the back at ``pixels`` (n, 2); NaN where at most half of the frames have a range."""
    at = (pixels[:, 1] - region.row0, pixels[:, 0] - region.col0)
    z = stack.z_m[:, at[0], at[1]]
    often = np.isfinite(z).mean(axis=0) > 0.5
    height = np.full(len(pixels), np.nan)
    height[often] = back_z_m[at][often] - np.nanmean(z[:, often], axis=0)
    return height
