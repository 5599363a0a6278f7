"""Straight edges in a capture where a plane ends before another, beside the simulation of the same edge.

Where the true edge lies is not known to better than the gap, so widths of pixels without a range and of flying pixels
are compared, and not the erosion of either side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from harness.scorecard.bench import NOISE
from harness.scorecard.capture import SEED, Beside, Captured, Twin
from harness.scorecard.edges import EdgeWidths, edge_widths, on_surface_tolerance_m
from harness.scorecard.estimate import mean_of
from harness.scorecard.temporal import temporal_sigma_m
from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.closed_form import Plane, layered_view
from scenes.sensor.source import SimulatedUnit

WIDEST_PX = 24
"""Between the last pixel of one plane and the first of the next; farther apart they are not one edge."""
REACH_PX = 16.0
FLAT_PX = 8.0
LEAST_LINES = 30
"""Lines of pixels across an edge: the mean gap is then known to a tenth of a pixel."""
STRAIGHT_PX = 2.0
"""A crossing this near to the fitted line is on it."""
LEAST_STEP_M = 20 * MM
"""Somewhat more than how far from a plane its pixels may lie."""
TRIES = 200


@dataclass(frozen=True)
class Edge:
    """A straight edge: the front is where sign (p_axis - at - slant p_other) < 0, p the slopes of a ray.

    ``axis`` 0: z steps along x. ``lines``: the rows (columns for axis 1) that cross it.
    """

    name: str
    front: Plane
    back: Plane
    axis: int
    sign: float
    at: float
    slant: float
    lines: np.ndarray
    step_m: float

    def signed(self, slopes: np.ndarray) -> np.ndarray:
        """(...) signed distance in slopes: below 0 on the front."""
        return np.asarray(self.sign * (slopes[..., self.axis] - self.at - self.slant * slopes[..., 1 - self.axis]))

    def covers(self, slopes: np.ndarray) -> np.ndarray:
        """Whether the front is there; False for NaN."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.signed(slopes) < 0)


def edges_of(captured: Captured) -> list[Edge]:
    """The straight edges between the capture's planes, in order of the planes."""
    labels = np.zeros(captured.used.shape, int)
    for number, found in enumerate(captured.planes, start=1):
        labels[found.mask] = number
    edges = []
    for axis in (0, 1):
        turned = labels if axis == 0 else labels.T
        crossings = _crossings(turned)
        for first, second in sorted({(a, b) for _, _, _, a, b in crossings}):
            rows = np.array([c[:3] for c in crossings if c[3:] == (first, second)])
            edge = _fitted(captured, rows, axis, first, second)
            if edge is not None:
                edges.append(edge)
    return edges


def edge_rows(captured: Captured, edge: Edge, twin: Twin) -> list[Beside]:
    """Gap and flying pixels at one edge."""
    region = _region(captured, edge)
    measured_m = captured.z_m[(slice(None), *region.within(captured.lens.whole))].astype(float)
    simulated_m = _simulated(region, edge, twin, len(measured_m))
    measured, simulated = (_widths(z, region, edge, captured) for z in (measured_m, simulated_m))
    at, pixels = f"step {edge.step_m / MM:.0f} mm", len(edge.lines)
    return [
        Beside(edge.name, title, at, "px", pixels, mean_of(getattr(measured, key)), mean_of(getattr(simulated, key)))
        for title, key in (("gap at an edge", "gap"), ("flying pixels", "flying"))
    ]


def _crossings(labels: np.ndarray) -> list[tuple[int, int, int, int, int]]:
    """(row, last column of one plane, first column of the next, both labels) where planes follow each other."""
    found = []
    for row, line in enumerate(labels):
        (known,) = np.nonzero(line)
        if known.size < 2:
            continue
        change = np.flatnonzero((np.diff(line[known]) != 0) & (np.diff(known) <= WIDEST_PX))
        for k in change:
            a, b = int(known[k]), int(known[k + 1])
            found.append((row, a, b, int(line[a]), int(line[b])))
    return found


def _fitted(captured: Captured, rows: np.ndarray, axis: int, first: int, second: int) -> Edge | None:
    """The straight line that most crossings lie on; None where that is no step, too short, or nearer the other axis."""
    if len(rows) < LEAST_LINES:
        return None
    lens = captured.lens
    middle = rows[:, 1:].mean(axis=1)
    pixels = (middle, rows[:, 0]) if axis == 0 else (rows[:, 0], middle)
    slopes = lens.slopes(*pixels)
    across, along = slopes[:, axis], slopes[:, 1 - axis]
    at, slant, near = _line(along, across, STRAIGHT_PX / (lens.fx if axis == 0 else lens.fy), first, second)
    planes = [captured.planes[number - 1].plane for number in (first, second)]
    steps = planes[1].z_along_m(slopes[near]) - planes[0].z_along_m(slopes[near])
    step_m = float(np.median(steps))
    if near.sum() < LEAST_LINES or abs(slant) > 1 or not abs(step_m) > LEAST_STEP_M:
        return None
    front, back = planes if step_m > 0 else planes[::-1]
    return Edge(
        name=f"edge of plane {first if step_m > 0 else second} before plane {second if step_m > 0 else first}, "
        f"across {'xy'[axis]}",
        front=front,
        back=back,
        axis=axis,
        sign=1.0 if step_m > 0 else -1.0,
        at=at,
        slant=slant,
        lines=rows[near, 0],
        step_m=abs(step_m),
    )


def _line(along: np.ndarray, across: np.ndarray, tolerance: float, *labels: int) -> tuple[float, float, np.ndarray]:
    """(at, slant, which lie on it) of across = at + slant along, by RANSAC and a fit to those on it."""
    rng = random_stream(0, "edges", *labels)
    best = np.zeros(along.size, bool)
    for i, j in rng.integers(0, along.size, (TRIES, 2)):
        if along[i] != along[j]:
            slant = (across[i] - across[j]) / (along[i] - along[j])
            near = np.abs(across - across[i] - slant * (along - along[i])) < tolerance
            best = near if near.sum() > best.sum() else best
    if best.sum() < 2:
        return 0.0, np.inf, best
    slant, at = np.polyfit(along[best], across[best], 1)
    return float(at), float(slant), np.abs(across - at - slant * along) < tolerance


def _region(captured: Captured, edge: Edge) -> Region:
    """The pixels within reach of the edge on its lines."""
    near = np.abs(edge.signed(captured.slopes)) * _focal_px(captured, edge) <= REACH_PX
    rows, columns = np.nonzero(near & _on_lines(edge, captured.lens.whole))
    return Region(int(rows.min()), int(rows.max()) + 1, int(columns.min()), int(columns.max()) + 1)


def _focal_px(captured: Captured, edge: Edge) -> float:
    """Pixels in a unit of slope across the edge."""
    return captured.lens.fx if edge.axis == 0 else captured.lens.fy


def _on_lines(edge: Edge, region: Region) -> np.ndarray:
    """(h, w) bool: the pixels of a region that lie on lines that cross the edge."""
    on = np.zeros(region.shape, bool)
    if edge.axis == 0:
        on[edge.lines - region.row0] = True
    else:
        on[:, edge.lines - region.col0] = True
    return on


def _simulated(region: Region, edge: Edge, twin: Twin, frames: int) -> np.ndarray:
    """(n, h, w) simulated z of the edge on a region."""
    camera = twin.camera
    lens = camera.nominal_lens
    outer = region.grown(camera.optics.margin_px, lens.height, lens.width)
    view = layered_view(camera, outer, edge.front, edge.back, edge.covers, twin.albedo)
    unit = SimulatedUnit(camera, twin.config.model_copy(update={"effects": NOISE}), view)
    cut = region.within(unit.region)
    taken = unit.capture(frames, SEED, "capture", edge.name).frames()
    return np.stack([frame.z_m[cut] for frame in taken]).astype(float)


def _widths(z_m: np.ndarray, region: Region, edge: Edge, captured: Captured) -> EdgeWidths:
    """Widths on the lines of the edge; a surface's own unevenness widens what counts as on it."""
    slopes = captured.slopes[region.within(captured.lens.whole)]
    from_edge = np.where(_on_lines(edge, region), edge.signed(slopes) * _focal_px(captured, edge), np.nan)
    front_z, back_z = edge.front.z_along_m(slopes), edge.back.z_along_m(slopes)
    with np.errstate(invalid="ignore"):
        flat = np.abs(from_edge) > FLAT_PX
        off = z_m - np.where(from_edge < 0, front_z, back_z)
    uneven = float(np.nanmedian(np.abs(off[:, flat]))) * 1.4826 if np.isfinite(off[:, flat]).any() else 0.0
    sigma_m = max(temporal_sigma_m(z_m, flat), uneven)
    tolerance_m = on_surface_tolerance_m(sigma_m, edge.step_m)
    return edge_widths(z_m, front_z, back_z, from_edge, tolerance_m, REACH_PX, len(edge.lines))
