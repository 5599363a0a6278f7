"""Gathers indirect light, which has met two surfaces or more, by following paths backwards.

A path begins at a point x0 that the lens sees. From each vertex it goes on in a random direction,
drawn by the cosine from the normal, to the next vertex x1, x2, ... Each vertex x_k adds the light

    albedo(x1) lobe(x0) ... albedo(x_k) lobe(x_(k-1)) E(x_k) exp(i 2 pi f L / c)

where E is the irradiance from the emitter, `lobe` is `LitScene.lobe`, and L is the length of the
way from the lens by x0, x1, ... x_k to the emitter. The density cos / pi of the directions cancels
the same factor of a Lambertian surface. The albedo of x0 is left to the caller.

Directions are low-discrepancy points (Sobol), scrambled anew for each of `BATCHES` batches; the
spread between batches gives the noise of their mean. What differs between boards is data on the
device and not a constant, so that kernels are compiled once for all boards."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc

from scenes.render.direct import OffFace, added
from scenes.render.scene import LIFT_M, LitScene, on_device

BATCHES = 8
PATHS_A_LANE = 64  # enough that lanes end together, few enough that a small job fills the machine
FLOATS_AT_ONCE = 1 << 26  # results held on the device at once: 0.25 GB
PER_VERTEX = 2  # low-discrepancy dimensions for each vertex: a direction
START_DIMENSIONS = 4  # the first direction; which of a pixel's sub-rays, and one to spare

# First directions from points are guided: a probe is sent through parts of the hemisphere, and
# most paths begin where one met something.
CELLS = 16  # along each side of the square from which first directions are drawn
PROBES = 2  # along each side of a cell
GUIDED_SHARE = 0.9  # of paths; the rest begin anywhere


class PathWork(NamedTuple):
    """Settings of light paths."""

    frequencies_hz: tuple[float, ...]
    """Modulation frequencies of the phasors."""
    bounces: int
    """Reflections beyond the first."""
    seed: int
    """Seed of the low-discrepancy points."""


class PathStart(NamedTuple):
    """First vertices of paths and the rays from there, as Dr.Jit arrays."""

    point: Any
    """The vertex."""
    normal: Any
    """Unit normal of its surface."""
    direction: Any
    """Unit direction of the ray to the next vertex."""
    lobe: Any
    """Share that the surface reflects from there to the lens (`LitScene.lobe`)."""
    weight: Any
    """Factor of all light of the path."""
    length_m: Any
    """Length of the path up to the vertex."""


Start = Callable[[Any, Any, Any, Any], PathStart]
"""Begins paths at places, given by their indices, with three numbers in 0..1 for each."""


class Lanes(NamedTuple):
    """Lanes of the device; each follows paths of one place and one batch, one after the other."""

    place: Any
    """Index of the place where the paths begin."""
    batch: Any
    """Index of the batch."""
    first: Any
    """Number in the batch of the lane's first path."""
    count: Any
    """Number of paths."""


def gather_at_points(
    lit: LitScene,
    points_m: np.ndarray,
    normals: np.ndarray,
    work: PathWork,
    samples: int,
    bright: np.ndarray | None = None,
) -> np.ndarray:
    """Gather the indirect light that arrives at surface points, cosine-weighted, per unit albedo,
    weighted by what a glossy board there sends to the lens. Returns light as `_gather` does.

    All points share their low-discrepancy numbers, so that noise is smooth from point to point.

    ``points_m``, ``normals`` (n, 3): in the camera's frame.
    ``samples``: paths from each point.
    ``bright`` (4, 4): half of the paths continue from their first hit towards a rectangle, -1..1
    in x and y of this frame: a lit board, which they would seldom meet by chance."""
    mi = lit.mi
    dr = lit.dr
    columns = [on_device(mi.Float, column) for column in (*points_m.T, *normals.T)]
    names = [part.name for part in lit.parts]
    board = names.index("board") if "board" in names else 0

    def cosine_start(
        index: Any,
        u1: Any,
        u2: Any,
    ) -> PathStart:
        x, y, z, nx, ny, nz = [dr.gather(mi.Float, column, index) for column in columns]
        point = mi.Point3f(x, y, z)
        normal = mi.Normal3f(nx, ny, nz)
        direction = _cosine_direction(lit, normal, u1, u2)
        viewer = -dr.normalize(mi.Vector3f(point))
        lobe = lit.lobe(mi.UInt32(board), normal, viewer, direction)
        return PathStart(
            point=point,
            normal=normal,
            direction=direction,
            lobe=lobe,
            weight=mi.Float(1.0),
            length_m=mi.Float(0.0),
        )

    cell_count = CELLS**2
    guided_cells = _cells_that_meet(lit, cosine_start, len(points_m))
    shares = np.full(cell_count, 1 - GUIDED_SHARE)
    shares[guided_cells] += GUIDED_SHARE * cell_count / guided_cells.size
    cell_table = on_device(mi.UInt32, guided_cells)
    density = on_device(mi.Float, shares)
    guided_count = dr.opaque(mi.UInt32, guided_cells.size)

    def guided_start(
        index: Any,
        u1: Any,
        u2: Any,
        _: Any,
    ) -> PathStart:
        # u1 chooses a cell, and what is left of it the place across the cell
        guided = u1 < GUIDED_SHARE
        along_guided = u1 * mi.Float(guided_count) / GUIDED_SHARE
        along_all = (u1 - GUIDED_SHARE) * (cell_count / (1 - GUIDED_SHARE))
        position = dr.select(guided, along_guided, along_all)
        last = dr.select(guided, guided_count - 1, mi.UInt32(cell_count - 1))
        number = dr.minimum(mi.UInt32(position), last)
        cell = dr.select(guided, dr.gather(mi.UInt32, cell_table, number, guided), number)
        fraction = dr.minimum(position - mi.Float(number), 1.0)
        across = (mi.Float(cell % CELLS) + fraction) / CELLS
        down = (mi.Float(cell // CELLS) + u2) / CELLS
        weight = 1 / dr.gather(mi.Float, density, cell)
        return cosine_start(index, across, down)._replace(weight=weight)

    counts = np.full(len(points_m), samples)
    same_rotation = np.zeros(len(points_m))
    return _gather(
        lit,
        guided_start,
        work,
        counts,
        same_rotation,
        bright,
    )


def _cells_that_meet(
    lit: LitScene,
    start: Callable[[Any, Any, Any], PathStart],
    point_count: int,
) -> np.ndarray:
    """Return the indices of the cells of first directions in which a probe from any point met
    something; all if none did."""
    mi = lit.mi
    side = CELLS * PROBES
    index, row, column = np.indices((point_count, side, side)).reshape(3, -1)
    across = on_device(mi.Float, (column + 0.5) / side)
    down = on_device(mi.Float, (row + 0.5) / side)
    probe = start(on_device(mi.UInt32, index), across, down)
    hit = lit.meet(probe.point + LIFT_M * probe.normal, probe.direction).valid.numpy()
    cell_hit = hit.reshape(-1, CELLS, PROBES, CELLS, PROBES).any(axis=(0, 2, 4))
    return np.flatnonzero(cell_hit if cell_hit.any() else ~cell_hit)


def gather_in_pixels(
    lit: LitScene,
    rays: OffFace,
    work: PathWork,
    samples: np.ndarray | int,
    after: int = 0,
) -> np.ndarray:
    """Gather indirect light, the mean over the listed sub-rays of each pixel. Returns light as
    `_gather` does, with the albedos of the first vertices.

    All paths begin where a sub-ray ends, which is found once.

    ``samples`` (p,) or one: the number of paths of each pixel.
    ``after``: the number of paths that were followed earlier; these go on where they ended."""
    mi = lit.mi
    dr = lit.dr
    slope_x = on_device(mi.Float, rays.slopes[:, 0])
    slope_y = on_device(mi.Float, rays.slopes[:, 1])
    sub_rays = dr.normalize(mi.Vector3f(slope_x, slope_y, 1.0))
    hit = lit.meet(mi.Point3f(0.0), sub_rays, coherent=True)
    ends = (*hit.point, *hit.normal, hit.distance, lit.albedo(hit))
    dr.eval(ends, hit.surface)
    firsts = on_device(mi.UInt32, np.cumsum(rays.counts) - rays.counts)
    counts = on_device(mi.UInt32, rays.counts)

    def start(
        index: Any,
        u1: Any,
        u2: Any,
        u3: Any,
    ) -> PathStart:
        count = dr.gather(mi.UInt32, counts, index)
        chosen = dr.minimum(mi.UInt32(u3 * mi.Float(count)), count - 1)
        ray = dr.gather(mi.UInt32, firsts, index) + chosen
        x, y, z, nx, ny, nz, distance, albedo = [dr.gather(mi.Float, end, ray) for end in ends]
        point = mi.Point3f(x, y, z)
        normal = mi.Normal3f(nx, ny, nz)
        direction = _cosine_direction(lit, normal, u1, u2)
        surface = dr.gather(mi.UInt32, hit.surface, ray)
        lobe = lit.lobe(surface, normal, -mi.Vector3f(point) / distance, direction)
        return PathStart(
            point=point,
            normal=normal,
            direction=direction,
            lobe=lobe,
            weight=albedo,
            length_m=distance,
        )

    work = work._replace(bounces=work.bounces - 1)
    counts_by_pixel = np.broadcast_to(np.asarray(samples), rays.pixel.shape)
    return _gather(
        lit,
        start,
        work,
        counts_by_pixel,
        rays.pixel,
        None,
        after,
    )


def _gather(
    lit: LitScene,
    start: Start,
    work: PathWork,
    samples: np.ndarray,
    rotations: np.ndarray,
    bright: np.ndarray | None,
    after: int = 0,
) -> np.ndarray:
    """Follow ``samples`` (n,) paths from each place, after the first ``after``; the other
    arguments are those of `_Walk`.

    Return the light (BATCHES, f + 1, n) complex64 of each batch: phasors at f frequencies, then
    the intensity. Units as in `NoiseFreeView`, but per unit albedo of the first vertex."""
    per_batch = np.maximum(samples // BATCHES, 1)
    earlier = after // BATCHES
    longest = int(per_batch.max()) + earlier
    walk = _Walk(
        lit,
        start,
        work,
        rotations,
        bright,
        longest,
    )
    # lanes for so many paths a batch at each place; the first lane of each place and batch
    lanes_per_pair = np.repeat(-(-per_batch // PATHS_A_LANE), BATCHES)
    first_lanes = np.cumsum(lanes_per_pair) - lanes_per_pair
    pair = np.repeat(np.arange(len(lanes_per_pair)), lanes_per_pair)
    origin, batch = np.divmod(pair, BATCHES)
    first = (np.arange(len(pair)) - first_lanes[pair]) * PATHS_A_LANE
    count = np.minimum(per_batch[origin] - first, PATHS_A_LANE)
    lanes = np.stack([origin, batch, earlier + first, count])

    lines = len(work.frequencies_hz)
    at_once = max(FLOATS_AT_ONCE // (2 * lines + 1), 1)
    chunks = []
    for begin in range(0, lanes.shape[1], at_once):
        chunks.append(walk.sums(lanes[:, begin : begin + at_once]))
    sums = chunks[0] if len(chunks) == 1 else np.concatenate(chunks, axis=1)
    if len(first_lanes) < lanes.shape[1]:
        sums = np.add.reduceat(sums, first_lanes, axis=1)
    by_batch = np.moveaxis(sums.reshape(lines + 1, len(samples), BATCHES), 2, 0)
    return np.asarray(by_batch * (1 / per_batch), np.complex64, order="C")


class _Walk:
    """Follows paths from places."""

    def __init__(
        self,
        lit: LitScene,
        start: Start,
        work: PathWork,
        rotations: np.ndarray,
        bright: np.ndarray | None,
        longest: int,
    ) -> None:
        """Prepare the low-discrepancy points.

        ``rotations`` (places,): places of the same number share one rotation of the points (modulo
        1).
        ``bright`` (4, 4): as in `gather_at_points`.
        ``longest``: most points in a batch."""
        mi = lit.mi
        dr = lit.dr
        self.lit = lit
        self.start = start
        self.work = work
        self.rotations = on_device(mi.UInt32, rotations)
        self.stream = dr.opaque(mi.UInt32, work.seed * 1024)
        self.dimensions = START_DIMENSIONS + PER_VERTEX * (work.bounces + 1)
        self.table = mi.Float(_sobol(self.dimensions, longest, work.seed))
        self.batch_points = dr.opaque(mi.UInt32, longest)
        self.bright = None
        if bright is not None:
            self.bright = [self._opaque_vector(bright[:3, column]) for column in (0, 1, 3)]

    def _opaque_vector(self, values: np.ndarray) -> Any:
        mi = self.lit.mi
        components = [self.lit.dr.opaque(mi.Float, value) for value in values.tolist()]
        return mi.Vector3f(components)

    def sums(self, lanes: np.ndarray) -> np.ndarray:
        """Return sums over the paths of each lane: (f + 1, n) complex64, intensity last.

        ``lanes`` (4, n): the rows of `Lanes`."""
        mi = self.lit.mi
        dr = self.lit.dr
        on_lanes = Lanes._make([on_device(mi.UInt32, row) for row in lanes])
        lines = len(self.work.frequencies_hz)
        n = lanes.shape[1]
        state = (
            dr.zeros(mi.UInt32, n),  # number of the path in its lane
            dr.zeros(mi.UInt32, n),  # number of the vertex to be found
            dr.zeros(mi.Point3f, n),  # the vertex before it
            dr.zeros(mi.Normal3f, n),  # and its normal
            dr.zeros(mi.Vector3f, n),  # direction from there
            dr.zeros(mi.Float, n),  # length of the path up to there
            dr.ones(mi.Float, n),  # factor of the light of what follows
            [dr.zeros(mi.Float, n) for _ in range(2 * lines + 1)],
        )

        def unfinished(path: Any, *_: Any) -> Any:
            return path < on_lanes.count

        def step(*state: Any) -> tuple[Any, ...]:
            return self._next_vertex(on_lanes, *state)

        totals = dr.while_loop(state, unfinished, step, label="walk")[-1]
        dr.eval(totals)
        sums = np.zeros((lines + 1, n), np.complex64)
        for line in range(lines):
            sums.real[line] = totals[2 * line].numpy()
            sums.imag[line] = totals[2 * line + 1].numpy()
        sums.real[-1] = totals[-1].numpy()
        return sums

    def _next_vertex(
        self,
        lanes: Lanes,
        path: Any,
        vertex: Any,
        before: Any,
        before_normal: Any,
        direction: Any,
        length: Any,
        throughput: Any,
        totals: list[Any],
    ) -> tuple[Any, ...]:
        """Find the next vertex of each lane's path, or the first of its next path, and add its
        light to ``totals``. Arguments and result: the state in `sums`."""
        lit = self.lit
        mi = lit.mi
        dr = lit.dr
        fresh = vertex == 0
        u1, u2 = self._uniform(lanes, path, 0)
        u3, _ = self._uniform(lanes, path, 2)
        start = self.start(lanes.place, u1, u2, u3)
        before = dr.select(fresh, start.point, before)
        before_normal = dr.select(fresh, start.normal, before_normal)
        direction = dr.select(fresh, start.direction, direction)
        length = dr.select(fresh, start.length_m, length)
        throughput = dr.select(fresh, start.lobe * start.weight, throughput)

        # the vertex and its light
        hit = lit.meet(before + LIFT_M * before_normal, direction)
        length = length + dr.select(hit.valid, dr.norm(hit.point - before), 0)
        throughput = throughput * lit.albedo(hit)
        irradiance, leg = lit.arriving(hit)
        light = dr.select(hit.valid, throughput * irradiance, 0)
        totals = added(totals, light, length + leg, self.work.frequencies_hz)

        # the direction to the next
        goes_on = hit.valid & (vertex < self.work.bounces) & (throughput > 0)
        u1, u2 = self._uniform(lanes, path, START_DIMENSIONS + PER_VERTEX * vertex)
        direction = _cosine_direction(lit, hit.normal, u1, u2)
        if self.bright is not None:
            # the half of the square left by the other choice is a square too
            stretched = dr.select(u1 < 0.5, 2 * u1, 2 * u1 - 1)
            spread = _cosine_direction(lit, hit.normal, stretched, u2)
            aimed, weight = _towards_bright(
                lit,
                self.bright,
                hit,
                spread,
                u1,
                u2,
            )
            direction = dr.select(fresh, aimed, direction)
            throughput = throughput * dr.select(fresh, weight, 1)
        throughput = throughput * lit.lobe(hit.surface, hit.normal, hit.viewer, direction)
        goes_on &= throughput > 0
        path = path + dr.select(goes_on, mi.UInt32(0), 1)
        vertex = dr.select(goes_on, vertex + 1, 0)
        return path, vertex, hit.point, hit.normal, direction, length, throughput, totals

    def _uniform(
        self,
        lanes: Lanes,
        path: Any,
        dimension: Any,
    ) -> tuple[Any, Any]:
        """Return two co-ordinates of the low-discrepancy point of each lane's path, shifted by its
        place's rotation."""
        mi = self.lit.mi
        dr = self.lit.dr
        point = lanes.batch * self.batch_points + lanes.first + path
        number = point * self.dimensions + dimension
        rotation = lanes.batch + BATCHES * dr.gather(mi.UInt32, self.rotations, lanes.place)
        shifts = mi.sample_tea_32(rotation, dimension + self.stream, 4)
        u1 = dr.gather(mi.Float, self.table, number) + mi.Float(shifts[0] >> 8) * 2**-24
        u2 = dr.gather(mi.Float, self.table, number + 1) + mi.Float(shifts[1] >> 8) * 2**-24
        return u1 - dr.floor(u1), u2 - dr.floor(u2)


@lru_cache(maxsize=8)
def _sobol(
    dimensions: int,
    longest: int,
    seed: int,
) -> np.ndarray:
    """Return the low-discrepancy points of all batches as flat float32, in the order batch, point,
    dimension."""
    rng = np.random.default_rng([seed, 0x1D1EC7])
    batches = [qmc.Sobol(dimensions, seed=rng).random(longest) for _ in range(BATCHES)]
    return np.ascontiguousarray(np.stack(batches), np.float32).ravel()


def _cosine_direction(
    lit: LitScene,
    normal: Any,
    u1: Any,
    u2: Any,
) -> Any:
    """Return a unit direction drawn by the cosine from the normal, with two numbers in 0..1."""
    mi = lit.mi
    local = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2))
    return mi.Frame3f(normal).to_world(local)


def _towards_bright(
    lit: LitScene,
    bright: list[Any],
    hit: Any,
    spread: Any,
    u1: Any,
    u2: Any,
) -> tuple[Any, Any]:
    """Return directions from hits, and their weights.

    In front of the rectangle ``bright`` (its half axes and its middle), a direction goes with a
    probability of a half to a uniform point of it, otherwise it is ``spread``, drawn by the
    cosine. Its weight is cos / pi over the mixture's density (Veach and Guibas' balance
    heuristic), 2 / (1 + ratio) with the ratio of the rectangle's density to that of the cosine: 2
    at most.

    ``u1`` and ``u2``: in 0..1; the first decides, too."""
    dr = lit.dr
    axis_x, axis_y, middle = bright
    half_x = dr.norm(axis_x)
    half_y = dr.norm(axis_y)
    rectangle_normal = dr.normalize(dr.cross(axis_x, axis_y))
    from_middle = lit.mi.Vector3f(hit.point) - middle
    in_front = dr.dot(from_middle, rectangle_normal) > 0
    aims = in_front & (u1 < 0.5)
    aimed = dr.normalize((4 * u1 - 1) * axis_x + (2 * u2 - 1) * axis_y - from_middle)
    direction = dr.select(aims, aimed, spread)
    # where it meets the rectangle's plane, in the frame of its middle
    falling = -dr.dot(direction, rectangle_normal)
    distance = dr.dot(from_middle, rectangle_normal) / falling
    crossing = from_middle + distance * direction
    within_x = dr.abs(dr.dot(crossing, axis_x)) <= half_x**2
    within_y = dr.abs(dr.dot(crossing, axis_y)) <= half_y**2
    met = (falling > 0) & within_x & within_y
    cosine = dr.dot(hit.normal, direction)
    area = 4 * half_x * half_y
    density_ratio = dr.pi * dr.square(distance) / (area * falling * dr.maximum(cosine, 1e-9))
    ratio = dr.select(met, density_ratio, 0)
    weight = dr.select(in_front, 2 / (1 + ratio), 1)
    return direction, dr.select(cosine > 0, weight, 0)
