"""The indirect part of a view: light that met at least two surfaces, by path tracing, with its noise measured.

Two estimates share one path tracer. On the board's undamaged face indirect light is smooth, so it is gathered at the
nodes of a coarse grid on the face and interpolated. Everywhere else (holes, rims, what lies around the board) each
pixel gathers its own. Low-discrepancy points (Sobol, scrambled anew for each batch) make both converge faster than
random ones; the spread between batches gives the noise that is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import interpolate
from scipy.stats import qmc

from harness.vocabulary.units import SPEED_OF_LIGHT_AIR
from scenes.render.scene import LitScene, facing

BATCHES = 8
LANES = 1 << 22
"""Paths traced at once: 4 million lanes take 0.6 GB."""


@dataclass(frozen=True)
class Gathered:
    """Indirect light at n places: ``sums`` (BATCHES, f + 1, n) complex, per batch; frequency 0 (intensity) last.

    Phase counts from the place of gathering on. Units as in `scenes.view.NoiseFreeView`, without the place's albedo
    where the start was a surface point, with it where the start was the lens.
    """

    sums: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """(f + 1, n) mean over batches."""
        return np.asarray(self.sums.mean(axis=0))


def gather_at_points(
    lit: LitScene,
    points_m: np.ndarray,
    normals: np.ndarray,
    frequencies_hz: tuple[float, ...],
    samples: int,
    bounces: int,
    seed: int,
) -> Gathered:
    """Indirect light that arrives at surface points (n, 3) with normals (n, 3), cosine-weighted, per unit albedo."""

    mi = lit.mi
    position, normal = _Table(mi, points_m), _Table(mi, normals)

    def start(place: Any, u1: Any, u2: Any) -> Any:
        frame = mi.Frame3f(mi.Normal3f(*(normal(place, k) for k in range(3))))
        direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2)))
        return mi.Ray3f(mi.Point3f(*(position(place, k) for k in range(3))), direction)

    return _trace(
        lit, len(points_m), start, frequencies_hz, samples, bounces, seed, first_counts=True, decorrelate=False
    )


def gather_in_pixels(
    lit: LitScene,
    corners: np.ndarray,
    frequencies_hz: tuple[float, ...],
    samples: int,
    bounces: int,
    seed: int,
) -> Gathered:
    """Indirect light of n pixels, each with the slopes of its four corners (n, 4, 2) in the order 00 01 10 11."""

    mi = lit.mi
    table = _Table(mi, corners.reshape(len(corners), 8))

    def start(place: Any, u1: Any, u2: Any) -> Any:
        import drjit as dr

        x, y = (
            (1 - u2) * ((1 - u1) * table(place, k) + u1 * table(place, 2 + k))
            + u2 * ((1 - u1) * table(place, 4 + k) + u1 * table(place, 6 + k))
            for k in range(2)
        )
        return mi.Ray3f(mi.Point3f(0.0), dr.normalize(mi.Vector3f(x, y, 1.0)))

    return _trace(
        lit, len(corners), start, frequencies_hz, samples, bounces, seed, first_counts=False, decorrelate=True
    )


class _Table:
    """Rows of numbers on the device, looked up by row and column."""

    def __init__(self, mi: Any, rows: np.ndarray) -> None:
        self._mi = mi
        self._columns = rows.shape[1]
        self._flat = mi.Float(np.ascontiguousarray(rows, np.float32).ravel())

    def __call__(self, row: Any, column: int) -> Any:
        import drjit as dr

        return dr.gather(self._mi.Float, self._flat, row * self._columns + column)


def _trace(
    lit: LitScene,
    places: int,
    start: Any,
    frequencies_hz: tuple[float, ...],
    samples: int,
    bounces: int,
    seed: int,
    *,
    first_counts: bool,
    decorrelate: bool,
) -> Gathered:
    """Trace ``samples`` paths a place in BATCHES batches. ``first_counts``: whether light that reaches the first hit
    directly counts (it does for a start on a surface, and is the direct part for a start at the lens)."""
    per_batch = max(samples // BATCHES, 1)
    sums = np.empty((BATCHES, len(frequencies_hz) + 1, places), complex)
    rng = np.random.default_rng([seed, 0x1D1EC7])
    dimensions = 2 * (bounces + 1)
    at_once = max(LANES // per_batch, 1)
    for batch in range(BATCHES):
        points = qmc.Sobol(dimensions, seed=rng).random(per_batch).astype(np.float32)
        shift = rng.random((places if decorrelate else 1, dimensions), dtype=np.float32)
        for begin in range(0, places, at_once):
            chunk = np.arange(begin, min(begin + at_once, places))
            rotation = shift[chunk] if decorrelate else np.repeat(shift, len(chunk), axis=0)
            sums[batch][:, chunk] = _trace_chunk(
                lit, chunk, start, frequencies_hz, points, rotation, bounces, first_counts
            )
    return Gathered(sums)


def _trace_chunk(
    lit: LitScene,
    chunk: np.ndarray,
    start: Any,
    frequencies_hz: tuple[float, ...],
    points: np.ndarray,
    rotation: np.ndarray,
    bounces: int,
    first_counts: bool,
) -> np.ndarray:
    """Mean phasors (f + 1, len(chunk)) over the given low-discrepancy points, rotated for each place."""
    import drjit as dr

    mi = lit.mi
    count, per_place = len(chunk), len(points)
    lane = dr.arange(mi.UInt32, count * per_place)
    which, sample = lane // per_place, lane % per_place
    point_table = mi.Float(points.ravel())
    shift_table = mi.Float(rotation.ravel().astype(np.float32))
    dimensions = points.shape[1]

    def uniform(dimension: Any) -> Any:
        u = dr.gather(mi.Float, point_table, sample * dimensions + dimension)
        u += dr.gather(mi.Float, shift_table, which * dimensions + dimension)
        return u - dr.floor(u)

    ray = start(which + int(chunk[0]), uniform(0), uniform(1))
    wave = [2 * np.pi * f / SPEED_OF_LIGHT_AIR for f in frequencies_hz]
    totals = _walk(lit, ray, uniform, wave, bounces, first_counts)
    dr.eval(*totals)
    means = [dr.block_sum(total, per_place).numpy().astype(float) / per_place for total in totals]
    phasors = [means[2 * k] + 1j * means[2 * k + 1] for k in range(len(wave))]
    return np.stack([*phasors, means[-1].astype(complex)])


def _walk(lit: LitScene, ray: Any, uniform: Any, wave: list[float], bounces: int, first_counts: bool) -> list[Any]:
    """Follow the paths; at each vertex add the emitter's light there. Returns re and im per wave, and the sum.

    Cosine-weighted directions cancel cos/pi of a Lambertian surface, so each bounce multiplies by its albedo only.
    """
    import drjit as dr

    mi = lit.mi
    lanes = dr.width(ray)
    totals = [dr.zeros(mi.Float, lanes) for _ in range(2 * len(wave) + 1)]
    path = dr.zeros(mi.Float, lanes)
    throughput = dr.ones(mi.Float, lanes)
    active = dr.full(mi.Bool, True, lanes)
    for vertex in range(bounces + 1):
        hit = lit.scene.ray_intersect(ray, active)
        active = active & hit.is_valid()
        path = path + dr.select(active, hit.t, 0)
        throughput = throughput * dr.select(active, hit.bsdf().eval_diffuse_reflectance(hit, active)[0], 0)
        if vertex > 0 or first_counts:
            arriving, leg = lit.arriving(hit, active)
            light = throughput * arriving
            for k, number in enumerate(wave):
                sine, cosine = dr.sincos(number * (path + leg))
                totals[2 * k] += light * cosine
                totals[2 * k + 1] += light * sine
            totals[-1] += light
        if vertex < bounces:
            sample = mi.Point2f(uniform(2 * vertex + 2), uniform(2 * vertex + 3))
            ray = hit.spawn_ray(mi.Frame3f(facing(hit)).to_world(mi.warp.square_to_cosine_hemisphere(sample)))
    return totals


def between_nodes(
    nodes_x: np.ndarray, nodes_y: np.ndarray, values: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    """Bilinear interpolation of values (m, len(nodes_y), len(nodes_x)), complex, at n places: (m, n).

    Light that left its last surface a distance D away bends over a spacing s by (s/D)^2/8 of itself: 4e-4 at 40 mm and
    0.7 m, of a part that is itself some per cent of the whole.
    """
    grid = interpolate.RegularGridInterpolator((nodes_y, nodes_x), np.moveaxis(values, 0, -1), method="linear")
    return np.asarray(grid(np.column_stack([y, x])).T)
