"""Indirect light: light that met at least two surfaces, gathered by walking paths backwards, with its noise measured.

Low-discrepancy points (Sobol, scrambled anew for each batch) make the mean converge faster than random ones would; the
spread between batches gives the noise that is left. On the board's undamaged face the light is smooth, so it is
gathered at the nodes of a coarse grid and interpolated. One compiled loop walks all paths: every lane belongs to one
place and one batch and walks its paths one after another, so that memory does not grow with the paths, and a path that
leaves the scene early costs no more than it went.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.stats import qmc

from harness.vocabulary.geometry import invert, rotate_vectors, transform_points
from harness.vocabulary.units import MM, SPEED_OF_LIGHT_AIR
from scenes.render.direct import DirectLight, OffFace, comb_step, wave_numbers
from scenes.render.scene import LIFT_M, LitScene, facing
from scenes.target.mesh import Target

BATCHES = 8
PATHS_A_LANE = 64
"""Enough that lanes end together although paths differ in length, few enough that a small job fills the machine."""
NOISE_LINES = 4
"""Lines of a comb of many that tell what noise does to range: paths are the same for all lines."""
PER_VERTEX = 2
"""Low-discrepancy dimensions at each vertex: a direction."""
START_DIMENSIONS = 2
FLOATS_AT_ONCE = 1 << 26
"""Results held on the device at once: 0.25 GB."""
FACE_WITHIN_M = 0.001 * MM
"""The board's vertices so near its undamaged face lie on it: Booleans in double precision leave them within 1 nm."""
ABOVE_FACE_M = 1 * MM
"""Height of the nodes, so that tape does not bury them."""


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
class PathWork:
    """Settings of the walk: at which frequencies, with how many reflections beyond the first, and from which seed."""

    frequencies_hz: tuple[float, ...]
    bounces: int
    seed: int


class _DeviceTable:
    """Rows of numbers on the device, looked up by row and column."""

    def __init__(self, mi: Any, rows: np.ndarray) -> None:
        self._mi, self._columns = mi, rows.shape[1]
        self._flat = mi.Float(np.ascontiguousarray(rows, np.float32).ravel())

    def __call__(self, row: Any, column: int) -> Any:
        import drjit as dr

        return dr.gather(self._mi.Float, self._flat, row * self._columns + column)


def gather_at_points(
    lit: LitScene, points_m: np.ndarray, normals: np.ndarray, work: PathWork, samples: int
) -> Gathered:
    """Gather indirect light that arrives at surface points (n, 3) with normals (n, 3), cosine-weighted, per unit
    albedo.

    All points share their low-discrepancy numbers, so that what noise is left is smooth from point to point.
    """
    mi = lit.mi
    position, facing_to = _DeviceTable(mi, points_m), _DeviceTable(mi, normals)

    def start(place: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
        point = mi.Point3f(*(position(place, k) for k in range(3)))
        normal = mi.Normal3f(*(facing_to(place, k) for k in range(3)))
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2)))
        return point, point + LIFT_M * normal, direction

    return _gather(lit, start, np.full(len(points_m), samples), work, on_surface=True)


def gather_in_pixels(lit: LitScene, rays: OffFace, work: PathWork, samples: int | np.ndarray) -> Gathered:
    """Gather indirect light (mean over the listed sub-rays of each pixel) with ``samples`` paths each, a number or
    (p,).

    The share of the footprint is left out.
    """
    import drjit as dr

    mi = lit.mi
    slopes = _DeviceTable(mi, rays.slopes)
    firsts = mi.UInt32((np.cumsum(rays.count) - rays.count).astype(np.uint32))
    counts = mi.UInt32(rays.count.astype(np.uint32))

    def start(place: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any]:
        first, count = (dr.gather(mi.UInt32, a, place) for a in (firsts, counts))
        which = first + dr.minimum(mi.UInt32(u1 * mi.Float(count)), count - 1)
        direction = dr.normalize(mi.Vector3f(slopes(which, 0), slopes(which, 1), 1.0))
        return mi.Point3f(0.0), mi.Point3f(0.0), direction

    return _gather(lit, start, np.broadcast_to(np.asarray(samples), rays.pixel.shape), work, on_surface=False)


def range_noise_m(batches: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return one standard deviation of range, (n,), from phasors of B independent batches added to light ``total`` (f,
    n).

    ``batches`` (B, l, n): at the frequencies of `noise_lines`. Linear: see `range_change_m`. The mean over B batches
    has their deviation over sqrt(B).
    """
    few = noise_lines(frequencies_hz)
    chosen = tuple(frequencies_hz[k] for k in few)
    per_batch = range_change_m(batches - batches.mean(axis=0), total[few], chosen)
    return np.asarray(per_batch.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def range_change_m(change: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return what a small change (..., f, n) of phasors ``total`` (f, n) does to range, (..., n); 0 without light.

    A change dH turns the phase by Im(dH / H); frequencies are fused with the least-squares weights
    c f_k / (4 pi sum f^2).
    """
    f = np.array(frequencies_hz)[:, None]
    turn = np.imag(np.divide(change, total, out=np.zeros(change.shape, complex), where=np.abs(total) > 0))
    return np.asarray((SPEED_OF_LIGHT_AIR * f / (4 * np.pi * (f**2).sum()) * turn).sum(axis=-2))


def noise_lines(frequencies_hz: tuple[float, ...]) -> list[int]:
    """Return the frequencies from which noise is told: all, or NOISE_LINES spread over the list where there are
    more."""
    count = len(frequencies_hz)
    return [round(k) for k in np.linspace(0, count - 1, min(count, NOISE_LINES))]


def _gather(lit: LitScene, start: Any, samples: np.ndarray, work: PathWork, *, on_surface: bool) -> Gathered:
    """Walk ``samples`` (n,) paths from each place, in BATCHES batches.

    ``start`` (place, u1, u2): point from which the path's length counts, origin of the first ray and its direction.
    ``on_surface``: light that reaches the first hit directly counts (for a start at the lens it is the direct part),
    and all places share one rotation of the low-discrepancy points.
    """
    frequencies, bounces = work.frequencies_hz, work.bounces
    per_batch = np.maximum(samples // BATCHES, 1)
    rng = np.random.default_rng([work.seed, 0x1D1EC7])
    dimensions = START_DIMENSIONS + PER_VERTEX * (bounces + 1)
    longest = int(per_batch.max())
    points = np.stack([qmc.Sobol(dimensions, seed=rng).random(longest) for _ in range(BATCHES)])

    # lanes for so many paths a batch at each place, and where those of each place and batch begin
    groups = -(-per_batch // PATHS_A_LANE)
    per_pair = np.repeat(groups, BATCHES)
    begins = np.cumsum(per_pair) - per_pair
    pair = np.repeat(np.arange(len(per_pair)), per_pair)
    place, batch = np.divmod(pair, BATCHES)
    first = (np.arange(len(pair)) - begins[pair]) * PATHS_A_LANE
    lanes = place, batch, first, np.minimum(per_batch[place] - first, PATHS_A_LANE)

    lines = len(frequencies)
    at_once = max(FLOATS_AT_ONCE // (2 * lines + 1), 1)
    sums = np.empty((lines + 1, len(place)), np.complex64)
    table = lit.mi.Float(np.ascontiguousarray(points, np.float32).ravel())
    turn = longest, dimensions, work.seed, 0 if on_surface else 1
    for begin in range(0, len(place), at_once):
        here = slice(begin, begin + at_once)
        sums[:, here] = _walk(lit, start, [a[here] for a in lanes], table, turn, frequencies, bounces, on_surface)
    by_batch = np.add.reduceat(sums, begins, axis=1).reshape(len(sums), len(samples), BATCHES) / per_batch[:, None]
    return Gathered(np.ascontiguousarray(np.moveaxis(by_batch, 2, 0), np.complex64))


def _walk(
    lit: LitScene,
    start: Any,
    lanes: list[np.ndarray],
    table: Any,
    turn: tuple[int, int, int, int],
    frequencies_hz: tuple[float, ...],
    bounces: int,
    first_counts: bool,
) -> np.ndarray:
    """Return sums over each lane's paths: (f + 1, n) complex64, intensity last.

    ``lanes``: arrays (n,), the place and batch of each lane, its first low-discrepancy point and how many paths it
    walks. ``table``: the points, flat; ``turn``: points a batch, dimensions, seed of what turns them anew, and 1 where
    each place has its own rotation (modulo 1). Cosine-weighted directions cancel cos/pi of a Lambertian surface, so
    each bounce multiplies by its albedo only.
    """
    import drjit as dr

    mi = lit.mi
    place, batch, first, count = (mi.UInt32(np.ascontiguousarray(a, np.uint32)) for a in lanes)
    per_batch, dimensions, seed, own = turn
    rotation_of = batch + BATCHES * (place if own else 0)
    waves, step_hz = wave_numbers(frequencies_hz), comb_step(frequencies_hz)

    def uniform(sample: Any, dimension: Any) -> Any:
        u = dr.gather(mi.Float, table, (batch * per_batch + first + sample) * dimensions + dimension)
        u += mi.sample_tea_float32(rotation_of, dimension + seed * 1024, 4)
        return u - dr.floor(u)

    def added(totals: list[Any], light: Any, length: Any) -> list[Any]:
        """Add light of a path length to sums of real and imaginary parts, one pair a frequency, intensity last. A comb
        is followed by multiplying with the phasor of its spacing: 1e-7 a line."""
        out = []
        if step_hz is None:
            for number in waves:
                sine, cosine = dr.sincos(float(number) * length)
                out += [light * cosine, light * sine]
        else:
            sine, cosine = dr.sincos(float(waves[0]) * length)
            turn_sine, turn_cosine = dr.sincos(float(wave_numbers((step_hz,))[0]) * length)
            re, im = light * cosine, light * sine
            for _ in waves:
                out += [re, im]
                re, im = re * turn_cosine - im * turn_sine, re * turn_sine + im * turn_cosine
        return [total + part for total, part in zip(totals, [*out, light], strict=True)]

    def vertex_of(
        sample: Any,
        vertex: Any,
        before: Any,
        before_normal: Any,
        direction: Any,
        length: Any,
        throughput: Any,
        totals: list[Any],
    ) -> tuple[Any, ...]:
        """Go on by a vertex; a lane whose path ends begins its next one. ``before``: the point from which the ray
        comes; ``length``: of the path up to there."""
        fresh = vertex == 0
        start_point, origin, start_direction = start(place, uniform(sample, 0), uniform(sample, 1))
        before = dr.select(fresh, start_point, before)
        origin = dr.select(fresh, origin, before + LIFT_M * before_normal)
        direction = dr.select(fresh, start_direction, direction)
        length, throughput = dr.select(fresh, 0, length), dr.select(fresh, 1, throughput)

        hit = lit.scene.ray_intersect(mi.Ray3f(origin, direction))
        met = hit.is_valid()
        normal = facing(hit)
        length = length + dr.select(met, dr.norm(hit.p - before), 0)
        throughput = throughput * dr.select(met, hit.bsdf().eval_diffuse_reflectance(hit, met)[0], 0)
        arriving, leg = lit.arriving(hit, met if first_counts else met & ~fresh)
        light = throughput * arriving
        totals = added(totals, dr.select(met, light, 0), length + leg)

        more = met & (vertex < bounces) & (throughput > 0)
        dimension = START_DIMENSIONS + PER_VERTEX * vertex
        chosen = mi.Point2f(uniform(sample, dimension), uniform(sample, dimension + 1))
        direction = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(chosen))
        sample, vertex = sample + dr.select(more, mi.UInt32(0), 1), dr.select(more, vertex + 1, 0)
        return sample, vertex, hit.p, normal, direction, length, throughput, totals

    n = dr.width(place)
    kinds = (mi.UInt32, mi.UInt32, mi.Point3f, mi.Normal3f, mi.Vector3f, mi.Float)
    zeros = [dr.zeros(mi.Float, n) for _ in range(2 * len(waves) + 1)]
    state = (*(dr.zeros(kind, n) for kind in kinds), dr.ones(mi.Float, n), zeros)
    totals = dr.while_loop(state, lambda sample, *_: sample < count, vertex_of, label="walk")[-1]
    dr.eval(totals)
    values = [total.numpy() for total in totals]
    return np.stack([*(values[2 * k] + 1j * values[2 * k + 1] for k in range(len(waves))), values[-1]])


# ---- the board's face


def face_triangles(target: Target) -> list[np.ndarray]:
    """Return for each part which of its triangles (n,) lie on the undamaged face: the board's there, and all of
    tapes."""
    found = []
    for part in target.parts:
        on_face = np.full(len(part.mesh.faces), part.name.startswith("tape"))
        if part.name == "board":
            board = transform_points(invert(target.T_camera_board), part.mesh.vertices)
            near = np.abs(board[:, 2] - target.face_height_m(board[:, 0], board[:, 1])) < FACE_WITHIN_M
            on_face = np.asarray(near[part.mesh.faces].all(axis=1))
        found.append(on_face)
    return found


def face_light(
    lit: LitScene,
    target: Target,
    direct: DirectLight,
    slopes: np.ndarray,
    work: PathWork,
    spacing_m: float,
    samples: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return indirect light by way of the face in the pixels that see any of it: mean (f + 1, n), and batches (B, l, n)
    at the frequencies of `noise_lines`.

    Pixels in the order of `numpy.nonzero` of ``direct.face[-1]``. What a node would see of a hole is taken as if the
    face were whole: on a flat face it sees none.
    """
    seen = direct.face[-1].real > 0
    rays = np.concatenate([slopes[seen], np.ones((int(seen.sum()), 1))], axis=-1)
    rays *= (direct.face_range_m[seen] / np.linalg.norm(rays, axis=-1))[..., None]
    board = transform_points(invert(target.T_camera_board), rays)
    nodes = []
    for low, high in zip(board[:, :2].min(axis=0).tolist(), board[:, :2].max(axis=0).tolist(), strict=True):
        nodes.append(np.linspace(low, high, max(int(np.ceil((high - low) / spacing_m)) + 1, 3)))
    xs, ys = nodes
    # points above the face, and its unit normals, in the camera's frame
    grid_y, grid_x = np.meshgrid(ys, xs, indexing="ij")
    x, y, step = grid_x.ravel(), grid_y.ravel(), 1e-5
    slope_x = (target.face_height_m(x + step, y) - target.face_height_m(x - step, y)) / (2 * step)
    slope_y = (target.face_height_m(x, y + step) - target.face_height_m(x, y - step)) / (2 * step)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    point = np.stack([x, y, target.face_height_m(x, y)], axis=-1) + ABOVE_FACE_M * normal
    T_camera_board = target.T_camera_board
    position, normals = transform_points(T_camera_board, point), rotate_vectors(T_camera_board, normal)
    light = gather_at_points(lit, position, normals, work, samples)
    weights = between_nodes(xs, ys, board[:, 0], board[:, 1])
    share = direct.face[:, seen]
    few = noise_lines(work.frequencies_hz)
    batches = np.stack([share[few] * (weights @ batch[few].T).T for batch in light.sums])
    return share * (weights @ light.mean.T).T, batches


def between_nodes(nodes_x: np.ndarray, nodes_y: np.ndarray, x: np.ndarray, y: np.ndarray) -> sparse.csr_array:
    """Return bilinear weights (n, len(nodes_y) len(nodes_x)) of evenly spaced nodes, row by row, at n places between
    them.

    Light that left its last surface a distance D away bends over a spacing s by (s/D)^2/8 of itself: 2e-3 at 80 mm and
    0.7 m, of a part that is itself some per cent of the whole.
    """
    columns = len(nodes_x)
    parts = []
    for nodes, values in ((nodes_x, x), (nodes_y, y)):
        place = (values - nodes[0]) / (nodes[1] - nodes[0])
        cell = np.clip(place.astype(np.int64), 0, len(nodes) - 2)
        parts.append((cell, place - cell))
    (i, right), (j, down) = parts
    index = np.stack([(j + b) * columns + i + a for b in (0, 1) for a in (0, 1)], axis=1)
    weight = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
    starts = np.arange(len(x) + 1) * 4
    return sparse.csr_array((weight.ravel(), index.ravel(), starts), shape=(len(x), columns * len(nodes_y)))
