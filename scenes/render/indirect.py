"""Gathering indirect light, light that met at least two surfaces, with its noise measured.

Low-discrepancy points (Sobol, scrambled anew for each batch) make the mean converge faster than random ones would; the
spread between batches gives the noise that is left.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from harness.vocabulary.units import SPEED_OF_LIGHT_AIR
from scenes.render.direct import OffFace
from scenes.render.scene import LIFT_M, LitScene
from scenes.render.walk import PER_VERTEX, START_DIMENSIONS, Lanes, Points, Starts, walk

BATCHES = 8
PATHS_A_LANE = 64
"""Enough that lanes end together although paths differ in length, few enough that a small job fills the machine."""

NOISE_LINES = 4
"""Of a comb of many, these tell what noise does to range: paths are the same for all lines."""


@dataclass(frozen=True)
class Gathered:
    """Indirect light at n places: ``sums`` (BATCHES, f + 1, n) complex64, per batch; frequency 0 (intensity) last.

    Phase counts from the place of gathering on. Units as in `scenes.view.NoiseFreeView`, without the place's albedo
    where the start was a surface point, with it where the start was the lens.
    """

    sums: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """(f + 1, n) mean over batches."""
        return np.asarray(self.sums.mean(axis=0, dtype=complex))


@dataclass(frozen=True)
class Work:
    """How paths are walked: at which frequencies, with how many reflections beyond the first, and from which seed."""

    frequencies_hz: tuple[float, ...]
    bounces: int
    seed: int


def gather_at_points(lit: LitScene, points_m: np.ndarray, normals: np.ndarray, work: Work, samples: int) -> Gathered:
    """Indirect light that arrives at surface points (n, 3) with normals (n, 3), cosine-weighted, per unit albedo.

    All points share their low-discrepancy numbers, so that what noise is left is smooth from point to point.
    """
    starts = _SurfaceStarts(lit.mi, points_m, normals)
    return _gather(lit, starts, np.full(len(points_m), samples), work, own_rotation=False)


def gather_in_pixels(lit: LitScene, rays: OffFace, work: Work, samples: int | np.ndarray) -> Gathered:
    """Indirect light (mean over the listed sub-rays of each pixel) with ``samples`` paths each, one number or (p,).

    The share of the footprint is left out.
    """
    starts = _LensStarts(lit.mi, rays)
    counts = np.broadcast_to(np.asarray(samples), rays.pixel.shape)
    return _gather(lit, starts, counts, work, own_rotation=True)


def range_noise_m(batches: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """One standard deviation of range, (n,), from phasors of B independent batches added to light ``total`` (f, n).

    ``batches`` (B, l, n): at the frequencies of `noise_lines`. Linear: see `range_change_m`. The mean over B batches
    has their deviation over sqrt(B).
    """
    few = noise_lines(frequencies_hz)
    chosen = tuple(frequencies_hz[k] for k in few)
    per_batch = range_change_m(batches - batches.mean(axis=0), total[few], chosen)
    return np.asarray(per_batch.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def range_change_m(change: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """What a small change (..., f, n) of phasors ``total`` (f, n) does to range, (..., n); 0 where there is no light.

    A change dH turns the phase by Im(dH / H); frequencies are fused with the least-squares weights
    c f_k / (4 pi sum f^2).
    """
    f = np.array(frequencies_hz)[:, None]
    turn = np.imag(np.divide(change, total, out=np.zeros(change.shape, complex), where=np.abs(total) > 0))
    return np.asarray((SPEED_OF_LIGHT_AIR * f / (4 * np.pi * (f**2).sum()) * turn).sum(axis=-2))


def noise_lines(frequencies_hz: tuple[float, ...]) -> list[int]:
    """The frequencies from which noise is told: all, or NOISE_LINES spread over the list where there are more."""
    count = len(frequencies_hz)
    return [round(k) for k in np.linspace(0, count - 1, min(count, NOISE_LINES))]


class _Rows:
    """Rows of numbers on the device, looked up by row and column."""

    def __init__(self, mi: Any, rows: np.ndarray) -> None:
        self._mi = mi
        self._columns = rows.shape[1]
        self._flat = mi.Float(np.ascontiguousarray(rows, np.float32).ravel())

    def __call__(self, row: Any, column: int) -> Any:
        import drjit as dr

        return dr.gather(self._mi.Float, self._flat, row * self._columns + column)


class _SurfaceStarts:
    """Paths that begin at surface points, in cosine-weighted directions."""

    first_counts = True

    def __init__(self, mi: Any, points_m: np.ndarray, normals: np.ndarray) -> None:
        self._mi, self._position, self._normal = mi, _Rows(mi, points_m), _Rows(mi, normals)

    def ray(self, place: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
        mi = self._mi
        point = mi.Point3f(*(self._position(place, k) for k in range(3)))
        normal = mi.Normal3f(*(self._normal(place, k) for k in range(3)))
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2)))
        return point, point + LIFT_M * normal, direction


class _LensStarts:
    """Paths that begin at the lens, along one of a pixel's listed sub-rays."""

    first_counts = False

    def __init__(self, mi: Any, rays: OffFace) -> None:
        self._mi, self._slopes = mi, _Rows(mi, rays.slopes)
        self._first = mi.UInt32((np.cumsum(rays.count) - rays.count).astype(np.uint32))
        self._count = mi.UInt32(rays.count.astype(np.uint32))

    def ray(self, place: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
        import drjit as dr

        mi = self._mi
        first, count = (dr.gather(mi.UInt32, a, place) for a in (self._first, self._count))
        which = first + dr.minimum(mi.UInt32(u1 * mi.Float(count)), count - 1)
        direction = dr.normalize(mi.Vector3f(self._slopes(which, 0), self._slopes(which, 1), 1.0))
        return mi.Point3f(0.0), mi.Point3f(0.0), direction


def _gather(lit: LitScene, starts: Starts, samples: np.ndarray, work: Work, *, own_rotation: bool) -> Gathered:
    """Walk ``samples`` (n,) paths from each place, in BATCHES batches."""
    per_batch = np.maximum(samples // BATCHES, 1)
    rng = np.random.default_rng([work.seed, 0x1D1EC7])
    dimensions = START_DIMENSIONS + PER_VERTEX * (work.bounces + 1)
    longest = int(per_batch.max())
    table = np.stack([qmc.Sobol(dimensions, seed=rng).random(longest) for _ in range(BATCHES)])
    lanes, begins = _lanes(per_batch)
    sums = walk(lit, starts, lanes, Points(table, work.seed, own_rotation), work.frequencies_hz, work.bounces)
    by_batch = np.add.reduceat(sums, begins, axis=1).reshape(len(sums), len(samples), BATCHES) / per_batch[:, None]
    return Gathered(np.ascontiguousarray(np.moveaxis(by_batch, 2, 0), np.complex64))


def _lanes(per_batch: np.ndarray) -> tuple[Lanes, np.ndarray]:
    """Lanes for so many paths a batch at each place (n,), and where those of each place and batch begin."""
    groups = -(-per_batch // PATHS_A_LANE)
    per_pair = np.repeat(groups, BATCHES)
    begins = np.cumsum(per_pair) - per_pair
    pair = np.repeat(np.arange(len(per_pair)), per_pair)
    place, batch = np.divmod(pair, BATCHES)
    first = (np.arange(len(pair)) - begins[pair]) * PATHS_A_LANE
    return Lanes(place, batch, first, np.minimum(per_batch[place] - first, PATHS_A_LANE)), begins
