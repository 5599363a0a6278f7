"""The walk of light backwards from where it is gathered: one compiled loop for all paths.

Every lane belongs to one place and one batch and walks its paths one after another, so that memory does not grow with
the paths, and a path that leaves the scene early costs no more than it went.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from scenes.render.phasors import comb_step, wave_numbers
from scenes.render.scene import LIFT_M, LitScene, facing

PER_VERTEX = 2
"""Low-discrepancy dimensions at each vertex: a direction."""
START_DIMENSIONS = 2
FLOATS_AT_ONCE = 1 << 26
"""Results held on the device at once: 0.25 GB."""


class Starts(Protocol):
    """Where paths begin."""

    first_counts: bool
    """Whether light that reaches the first hit directly counts: it does for a start on a surface, and is the direct
    part for a start at the lens."""

    def ray(self, place: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
        """Point from which the path's length counts, origin of the first ray and its direction."""


@dataclass(frozen=True)
class Lanes:
    """Arrays (n,): the place and batch of each lane, its first low-discrepancy point and how many paths it walks."""

    place: np.ndarray
    batch: np.ndarray
    first: np.ndarray
    count: np.ndarray


@dataclass(frozen=True)
class Points:
    """Low-discrepancy points (batches, n, dimensions) and what turns them anew: ``seed``, and whether each place has
    its own rotation (modulo 1) or all share one."""

    table: np.ndarray
    seed: int
    own_rotation: bool


def walk(
    lit: LitScene,
    starts: Starts,
    lanes: Lanes,
    points: Points,
    frequencies_hz: tuple[float, ...],
    bounces: int,
) -> np.ndarray:
    """Sums over each lane's paths: (f + 1, n) complex64, intensity last.

    Cosine-weighted directions cancel cos/pi of a Lambertian surface, so each bounce multiplies by its albedo only.
    """
    lines = len(frequencies_hz)
    at_once = max(FLOATS_AT_ONCE // (2 * lines + 1), 1)
    sums = np.empty((lines + 1, len(lanes.place)), np.complex64)
    table = lit.mi.Float(np.ascontiguousarray(points.table, np.float32).ravel())
    for begin in range(0, len(lanes.place), at_once):
        here = slice(begin, begin + at_once)
        sums[:, here] = _walk_lanes(lit, starts, lanes, here, table, points, frequencies_hz, bounces)
    return sums


def _walk_lanes(
    lit: LitScene,
    starts: Starts,
    lanes: Lanes,
    here: slice,
    table: Any,
    points: Points,
    frequencies_hz: tuple[float, ...],
    bounces: int,
) -> np.ndarray:
    import drjit as dr

    mi = lit.mi
    place, batch, first, count = (
        mi.UInt32(np.ascontiguousarray(a[here], np.uint32))
        for a in (lanes.place, lanes.batch, lanes.first, lanes.count)
    )
    _, per_batch, dimensions = points.table.shape
    rotation_of = batch + len(points.table) * (place if points.own_rotation else 0)

    def uniform(sample: Any, dimension: Any) -> Any:
        u = dr.gather(mi.Float, table, (batch * per_batch + first + sample) * dimensions + dimension)
        u += mi.sample_tea_float32(rotation_of, dimension + points.seed * 1024, 4)
        return u - dr.floor(u)

    path = _Path(lit, starts, place, uniform, _Lines(mi, frequencies_hz), bounces)
    totals = path.run(count)
    dr.eval(totals)
    values = [total.numpy() for total in totals]
    return np.stack([*(values[2 * k] + 1j * values[2 * k + 1] for k in range(len(frequencies_hz))), values[-1]])


class _Lines:
    """Adds light of a path length to sums of real and imaginary parts, one pair a frequency, intensity last."""

    def __init__(self, mi: Any, frequencies_hz: tuple[float, ...]) -> None:
        self._mi, self._waves = mi, wave_numbers(frequencies_hz)
        step = comb_step(frequencies_hz)
        self._step = None if step is None else float(wave_numbers((step,))[0])

    def zeros(self, lanes: int) -> list[Any]:
        import drjit as dr

        return [dr.zeros(self._mi.Float, lanes) for _ in range(2 * len(self._waves) + 1)]

    def add(self, totals: list[Any], light: Any, length: Any) -> list[Any]:
        """A comb is followed by multiplying with the phasor of its spacing: 1e-7 a line."""
        import drjit as dr

        out = []
        if self._step is None:
            for number in self._waves:
                sine, cosine = dr.sincos(float(number) * length)
                out += [light * cosine, light * sine]
        else:
            sine, cosine = dr.sincos(float(self._waves[0]) * length)
            turn_sine, turn_cosine = dr.sincos(self._step * length)
            re, im = light * cosine, light * sine
            for _ in self._waves:
                out += [re, im]
                re, im = re * turn_cosine - im * turn_sine, re * turn_sine + im * turn_cosine
        return [total + part for total, part in zip(totals, [*out, light], strict=True)]


@dataclass(frozen=True)
class _Path:
    """The loop over vertices of paths; a lane whose path ends begins its next one."""

    lit: LitScene
    starts: Starts
    place: Any
    uniform: Any
    lines: _Lines
    bounces: int

    def run(self, count: Any) -> list[Any]:
        """Walk ``count`` paths in each lane; returns the sums."""
        import drjit as dr

        mi = self.lit.mi
        n = dr.width(self.place)
        state = (
            dr.zeros(mi.UInt32, n),
            dr.zeros(mi.UInt32, n),
            dr.zeros(mi.Point3f, n),
            dr.zeros(mi.Normal3f, n),
            dr.zeros(mi.Vector3f, n),
            dr.zeros(mi.Float, n),
            dr.ones(mi.Float, n),
            self.lines.zeros(n),
        )
        return dr.while_loop(state, lambda sample, *_: sample < count, self._step, label="walk")[-1]

    def _step(
        self,
        sample: Any,
        vertex: Any,
        before: Any,
        before_normal: Any,
        direction: Any,
        length: Any,
        throughput: Any,
        totals: list[Any],
    ) -> tuple[Any, ...]:
        """One vertex. ``before``: the point from which the ray comes; ``length``: of the path up to there."""
        import drjit as dr

        lit, mi = self.lit, self.lit.mi
        fresh = vertex == 0
        start, origin, start_direction = self.starts.ray(self.place, self.uniform(sample, 0), self.uniform(sample, 1))
        before = dr.select(fresh, start, before)
        origin = dr.select(fresh, origin, before + LIFT_M * before_normal)
        direction = dr.select(fresh, start_direction, direction)
        length, throughput = dr.select(fresh, 0, length), dr.select(fresh, 1, throughput)

        hit = lit.scene.ray_intersect(mi.Ray3f(origin, direction))
        met = hit.is_valid()
        normal = facing(hit)
        step = dr.norm(hit.p - before)
        length = length + dr.select(met, step, 0)
        throughput = throughput * dr.select(met, hit.bsdf().eval_diffuse_reflectance(hit, met)[0], 0)
        arriving, leg = lit.arriving(hit, met if self.starts.first_counts else met & ~fresh)
        light = throughput * arriving
        totals = self.lines.add(totals, dr.select(met, light, 0), length + leg)

        more = met & (vertex < self.bounces) & (throughput > 0)
        dimension = 2 + PER_VERTEX * vertex
        chosen = mi.Point2f(self.uniform(sample, dimension), self.uniform(sample, dimension + 1))
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(chosen))
        return (
            sample + dr.select(more, mi.UInt32(0), 1),
            dr.select(more, vertex + 1, 0),
            hit.p,
            normal,
            direction,
            length,
            throughput,
            totals,
        )
