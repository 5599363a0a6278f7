"""Renders a view: determines its region, and combines direct light, indirect light and the noise
of the latter.

Indirect light has met at least two surfaces; it is gathered by following paths backwards. The
spread between batches of low-discrepancy points (Sobol, scrambled anew for each batch) gives its
noise. On the board's undamaged face, indirect light is smooth, so it is gathered at the nodes of a
coarse grid and interpolated."""

import time
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numba
import numpy as np
from scipy import ndimage
from scipy.stats import qmc

from harness.vocabulary.geometry import (
    MM,
    SPEED_OF_LIGHT_AIR,
    Region,
    invert,
    rotate_vectors,
    transform_points,
)
from scenes.optics import NoiseFreeView, Optics, RenderConfig, footprint_of
from scenes.perspectives import seen_region
from scenes.render.direct import FAST, DirectLight, OffFace, added, direct_light
from scenes.render.scene import LIFT_M, LitScene, lit_scene, load_mitsuba, on_device
from scenes.target.mesh import Target
from scenes.target.truth import face_of

BATCHES = 8
PATHS_A_LANE = 64  # enough that lanes end together, few enough that a small job fills the machine
# lines of a long comb from which noise of range is estimated: paths are the same for all lines
NOISE_LINES = 4
PER_VERTEX = 2  # low-discrepancy dimensions for each vertex: a direction
START_DIMENSIONS = 4  # the first direction; which of a pixel's sub-rays, and one to spare
CELLS = 16
PROBES = 2
OFTEN = 0.9
"""Cells along each side of the square of first directions from the face, probes along each side of
a cell, and the share of paths that begin in cells where a probe met something; the others begin
anywhere."""
FLOATS_AT_ONCE = 1 << 26  # results held on the device at once: 0.25 GB
FACE_WITHIN_M = (
    0.001 * MM
)  # vertices this close to the undamaged face lie on it: Booleans place them within 1 nm
MESH_WITHIN_M = 0.05 * MM  # the same for a part from a mesh, whose heights lie on a grid
ABOVE_FACE_M = 1 * MM  # height of the nodes above the face, so that tape does not cover them


class PathWork(NamedTuple):
    """Settings of the paths: their frequencies, the number of reflections beyond the first, and
    the seed."""

    frequencies_hz: tuple[float, ...]
    bounces: int
    seed: int


def gather_at_points(
    lit: LitScene,
    points_m: np.ndarray,
    normals: np.ndarray,
    work: PathWork,
    samples: int,
    bright: Any = None,
) -> np.ndarray:
    """Gather the indirect light that arrives at surface points (n, 3) with normals (n, 3),
    cosine-weighted, per unit albedo, weighted by what a glossy board there sends to the lens. All
    points share their low-discrepancy numbers, so that noise is smooth from point to point.
    ``bright`` (4, 4): half of the paths continue from their first hit towards a rectangle, -1..1
    in x and y of this frame: a lit board, which they would seldom meet by chance. First directions
    are drawn mostly from those cells of the hemisphere in which a probe met something."""
    mi = lit.mi
    dr = lit.dr
    columns = [on_device(mi.Float, each) for each in (*points_m.T, *normals.T)]
    board = next((k for k, part in enumerate(lit.parts) if part.name == "board"), 0)

    def drawn(place: Any, u1: Any, u2: Any) -> tuple[Any, Any, Any, Any]:
        x, y, z, nx, ny, nz = (dr.gather(mi.Float, column, place) for column in columns)
        point = mi.Point3f(x, y, z)
        normal = mi.Normal3f(nx, ny, nz)
        direction = mi.Frame3f(normal).to_world(
            mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2))
        )
        seen = lit.lobe(mi.UInt32(board), normal, -dr.normalize(mi.Vector3f(point)), direction)
        return point, normal, direction, seen

    side = CELLS * PROBES
    cells = CELLS**2
    places, down, across = (each.ravel() for each in np.indices((len(points_m), side, side)))
    probe = [on_device(mi.Float, (each + 0.5) / side) for each in (across, down)]
    point, normal, direction, _ = drawn(on_device(mi.UInt32, places), *probe)
    met = lit.meet(point + LIFT_M * normal, direction).valid.numpy()
    met = met.reshape(-1, CELLS, PROBES, CELLS, PROBES).any(axis=(0, 2, 4))
    chosen = np.flatnonzero(met if met.any() else ~met)
    shares = np.full(cells, 1 - OFTEN)
    shares[chosen] += OFTEN * cells / chosen.size
    table = on_device(mi.UInt32, chosen)
    density = on_device(mi.Float, shares)

    count = dr.opaque(mi.UInt32, chosen.size)

    def start(place: Any, u1: Any, u2: Any, _: Any) -> tuple[Any, ...]:
        often = u1 < OFTEN
        number = dr.select(
            often, u1 * mi.Float(count) / OFTEN, (u1 - OFTEN) * (cells / (1 - OFTEN))
        )
        whole = dr.minimum(mi.UInt32(number), dr.select(often, count - 1, mi.UInt32(cells - 1)))
        cell = dr.select(often, dr.gather(mi.UInt32, table, whole, often), whole)
        u1 = (mi.Float(cell % CELLS) + dr.minimum(number - mi.Float(whole), 1.0)) / CELLS
        u2 = (mi.Float(cell // CELLS) + u2) / CELLS
        return *drawn(place, u1, u2), 1 / dr.gather(mi.Float, density, cell), mi.Float(0.0)

    return _gather(
        lit, start, work, np.full(len(points_m), samples), np.zeros(len(points_m)), bright
    )


def gather_in_pixels(
    lit: LitScene, rays: OffFace, work: PathWork, samples: Any, after: int = 0
) -> np.ndarray:
    """Gather indirect light, the mean over the listed sub-rays of each pixel, with ``samples``
    paths, (p,) or one, that follow the first ``after``. All begin where a sub-ray ends, which is
    found once."""
    mi = lit.mi
    dr = lit.dr
    ray = dr.normalize(mi.Vector3f(*(on_device(mi.Float, each) for each in rays.slopes.T), 1.0))
    hit = lit.meet(mi.Point3f(0.0), ray, coherent=True)
    ends = (*hit.place, *hit.normal, hit.distance, lit.albedo(hit))
    dr.eval(ends, hit.surface)
    firsts = on_device(mi.UInt32, np.cumsum(rays.counts) - rays.counts)
    counts = on_device(mi.UInt32, rays.counts)

    def start(place: Any, u1: Any, u2: Any, u3: Any) -> tuple[Any, ...]:
        first = dr.gather(mi.UInt32, firsts, place)
        count = dr.gather(mi.UInt32, counts, place)
        which = first + dr.minimum(mi.UInt32(u3 * mi.Float(count)), count - 1)
        x, y, z, nx, ny, nz, distance, albedo = (dr.gather(mi.Float, each, which) for each in ends)
        point = mi.Point3f(x, y, z)
        normal = mi.Normal3f(nx, ny, nz)
        direction = mi.Frame3f(normal).to_world(
            mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2))
        )
        surface = dr.gather(mi.UInt32, hit.surface, which)
        seen = lit.lobe(surface, normal, -mi.Vector3f(point) / distance, direction)
        return point, normal, direction, seen, albedo, distance

    work = work._replace(bounces=work.bounces - 1)
    return _gather(
        lit,
        start,
        work,
        np.broadcast_to(np.asarray(samples), rays.pixel.shape),
        rays.pixel,
        None,
        after,
    )


def range_noise_m(
    batches: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]
) -> np.ndarray:
    """Return the standard deviation of range (n,) from phasors (B, l, n) of B independent batches
    at the frequencies of `noise_lines`, added to light ``total`` (f, n). The mean over B batches
    has that deviation over sqrt(B)."""
    few = noise_lines(frequencies_hz)
    chosen = tuple(frequencies_hz[k] for k in few)
    per_batch = range_change_m(batches - batches.mean(axis=0), total[few], chosen)
    return np.asarray(per_batch.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def range_change_m(
    change: np.ndarray, total: np.ndarray, frequencies_hz: tuple[float, ...]
) -> np.ndarray:
    """Return the change of range (..., n) by a small change (..., f, n) of phasors ``total`` (f,
    n); 0 without light. Phases turn by Im(dH / H) and are combined with the `range_weights`."""
    weights = range_weights(frequencies_hz)[:, None]
    by_light = np.divide(
        weights, total, out=np.zeros(total.shape, complex), where=np.abs(total) > 0
    )
    return np.asarray((change.real * by_light.imag + change.imag * by_light.real).sum(axis=-2))


def range_weights(frequencies_hz: tuple[float, ...]) -> np.ndarray:
    """Return the least-squares weights (f,) of phases in a range: c f_k / (4 pi sum f^2), in
    metres per radian."""
    f = np.array(frequencies_hz)
    return np.asarray(SPEED_OF_LIGHT_AIR * f / (4 * np.pi * (f**2).sum()))


def noise_lines(frequencies_hz: tuple[float, ...]) -> list[int]:
    """Return the frequencies at which noise is estimated: all, or NOISE_LINES spread over a longer
    list."""
    count = len(frequencies_hz)
    return [round(k) for k in np.linspace(0, count - 1, min(count, NOISE_LINES))]


@lru_cache(maxsize=8)
def _sobol(dimensions: int, longest: int, seed: int) -> np.ndarray:
    """Return the low-discrepancy points of all batches as flat float32, in the order batch, point,
    dimension."""
    rng = np.random.default_rng([seed, 0x1D1EC7])
    points = np.stack([qmc.Sobol(dimensions, seed=rng).random(longest) for _ in range(BATCHES)])
    return np.ascontiguousarray(points, np.float32).ravel()


def _towards(
    lit: LitScene,
    bright: tuple[Any, Any, Any],
    place: Any,
    normal: Any,
    turned: Any,
    u1: Any,
    u2: Any,
) -> Any:
    """Return a direction from a surface and its weight. It is drawn by its cosine (``turned``) or,
    in front of the rectangle ``bright``, with a probability of a half towards a uniform point of
    it: a mixture of both densities (Veach and Guibas' balance heuristic), so that no weight
    exceeds 2. ``u1`` and ``u2``: in 0..1."""
    mi = lit.mi
    dr = lit.dr
    axis_x, axis_y, middle = bright
    half = [dr.norm(axis) for axis in (axis_x, axis_y)]
    out = dr.normalize(dr.cross(axis_x, axis_y))
    from_middle = mi.Vector3f(place) - middle
    before = dr.dot(from_middle, out) > 0
    chosen = before & (u1 < 0.5)
    aimed = dr.normalize((4 * u1 - 1) * axis_x + (2 * u2 - 1) * axis_y - from_middle)
    direction = dr.select(chosen, aimed, turned)
    # its hit on the rectangle's plane; the density there, relative to that of the cosine
    falling = -dr.dot(direction, out)
    way = dr.dot(from_middle, out) / falling
    at = from_middle + way * direction
    met = (
        (falling > 0)
        & (dr.abs(dr.dot(at, axis_x)) <= half[0] ** 2)
        & (dr.abs(dr.dot(at, axis_y)) <= half[1] ** 2)
    )
    cosine = dr.dot(normal, direction)
    area = 4 * half[0] * half[1]
    ratio = dr.select(met, dr.pi * dr.square(way) / (area * falling * dr.maximum(cosine, 1e-9)), 0)
    return direction, dr.select(cosine > 0, dr.select(before, 2 / (1 + ratio), 1), 0)


class _Walk:
    """Paths that are followed backwards from places. ``start`` (place, u1, u2, u3): a point, its
    normal, the direction of the first ray, two factors of its weight, and the path's length up to
    there. ``turns`` (places,): places of the same number share one rotation of the low-discrepancy
    points (modulo 1). ``longest``: most points in a batch. What differs between boards is data,
    not constants."""

    def __init__(
        self,
        lit: LitScene,
        start: Any,
        work: PathWork,
        turns: np.ndarray,
        bright: Any,
        longest: int,
    ) -> None:
        self.lit = lit
        self.start = start
        self.work = work
        mi = lit.mi
        dr = lit.dr
        self.turns, self.stream = (
            on_device(mi.UInt32, turns),
            dr.opaque(mi.UInt32, work.seed * 1024),
        )
        self.dimensions = START_DIMENSIONS + PER_VERTEX * (work.bounces + 1)
        self.table = mi.Float(_sobol(self.dimensions, longest, work.seed))
        self.batch_points = dr.opaque(mi.UInt32, longest)
        self.aim = None
        if bright is not None:
            self.aim = tuple(
                mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in bright[:3, k]))
                for k in (0, 1, 3)
            )

    def sums(self, lanes: np.ndarray) -> np.ndarray:
        """Return sums over the paths of lanes: (f + 1, n) complex64, intensity last. ``lanes`` (4,
        n): each follows ``count`` paths of a place and batch, starting at number ``first``."""
        mi = self.lit.mi
        dr = self.lit.dr
        lines = len(self.work.frequencies_hz)
        self.place, self.batch, self.first, self.count = (
            on_device(mi.UInt32, each) for each in lanes
        )
        n = lanes.shape[1]
        kinds = (mi.UInt32, mi.UInt32, mi.Point3f, mi.Normal3f, mi.Vector3f, mi.Float)
        zeros = [dr.zeros(mi.Float, n) for _ in range(2 * lines + 1)]
        state = (*(dr.zeros(kind, n) for kind in kinds), dr.ones(mi.Float, n), zeros)

        totals = dr.while_loop(
            state, lambda sample, *_: sample < self.count, self._vertex, label="walk"
        )[-1]
        dr.eval(totals)
        values = [total.numpy() for total in totals]
        return np.stack(
            [*(values[2 * k] + 1j * values[2 * k + 1] for k in range(lines)), values[-1]]
        )

    def _vertex(
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
        """Continue at the next vertex, or begin the next path. ``length``: that up to ``before``,
        the ray's start."""
        lit = self.lit
        mi = self.lit.mi
        dr = self.lit.dr
        fresh = vertex == 0
        which = *self._uniform(sample, 0), self._uniform(sample, 2)[0]
        point, normal, first, seen, weight, way = self.start(self.place, *which)
        before = dr.select(fresh, point, before)
        before_normal = dr.select(fresh, normal, before_normal)
        direction = dr.select(fresh, first, direction)
        length = dr.select(fresh, way, length)
        throughput = dr.select(fresh, seen * weight, throughput)

        hit = lit.meet(before + LIFT_M * before_normal, direction)
        met = hit.valid
        length = length + dr.select(met, dr.norm(hit.place - before), 0)
        throughput = throughput * lit.albedo(hit)
        arriving, leg = lit.arriving(hit)
        light = dr.select(met, throughput * arriving, 0)
        totals = added(totals, light, length + leg, self.work.frequencies_hz)

        more = met & (vertex < self.work.bounces) & (throughput > 0)
        u1, u2 = self._uniform(sample, START_DIMENSIONS + PER_VERTEX * vertex)
        direction = mi.Frame3f(hit.normal).to_world(
            mi.warp.square_to_cosine_hemisphere(mi.Point2f(u1, u2))
        )
        if self.aim is not None:
            # the half of the square left by the other choice is a square too
            wide = dr.select(u1 < 0.5, 2 * u1, 2 * u1 - 1)
            spread = mi.Frame3f(hit.normal).to_world(
                mi.warp.square_to_cosine_hemisphere(mi.Point2f(wide, u2))
            )
            aimed, weight = _towards(lit, self.aim, hit.place, hit.normal, spread, u1, u2)
            direction = dr.select(fresh, aimed, direction)
            throughput = throughput * dr.select(fresh, weight, 1)
        throughput = throughput * lit.lobe(hit.surface, hit.normal, hit.viewer, direction)
        more &= throughput > 0
        sample = sample + dr.select(more, mi.UInt32(0), 1)
        vertex = dr.select(more, vertex + 1, 0)
        return sample, vertex, hit.place, hit.normal, direction, length, throughput, totals

    def _uniform(self, sample: Any, dimension: Any) -> tuple[Any, Any]:
        """Return two co-ordinates of the low-discrepancy point of each lane's path, shifted by its
        place's rotation."""
        mi = self.lit.mi
        dr = self.lit.dr
        number = (
            self.batch * self.batch_points + self.first + sample
        ) * self.dimensions + dimension
        rotation = self.batch + BATCHES * dr.gather(mi.UInt32, self.turns, self.place)
        shifts = mi.sample_tea_32(rotation, dimension + self.stream, 4)
        u = [
            dr.gather(mi.Float, self.table, number + k) + mi.Float(shifts[k] >> 8) * 2**-24
            for k in (0, 1)
        ]
        return u[0] - dr.floor(u[0]), u[1] - dr.floor(u[1])


def _gather(
    lit: LitScene,
    start: Any,
    work: PathWork,
    samples: np.ndarray,
    turns: np.ndarray,
    bright: Any,
    after: int = 0,
) -> np.ndarray:
    """Follow ``samples`` (n,) paths from each place, after the first ``after`` (other arguments:
    `_Walk`). Return the light (BATCHES, f + 1, n) complex64 of each batch, frequency 0 (intensity)
    last. Units as in `NoiseFreeView`, but per unit albedo of a point. Cosine-weighted directions
    cancel cos/pi of a Lambertian surface, so each bounce multiplies by its albedo and, if it is
    glossy, by `LitScene.lobe`."""
    per_batch = np.maximum(samples // BATCHES, 1)
    earlier = after // BATCHES
    walked = _Walk(lit, start, work, turns, bright, int(per_batch.max()) + earlier)
    lines = len(work.frequencies_hz)
    # lanes for so many paths a batch at each place; the first lane of each place and batch
    per_pair = np.repeat(-(-per_batch // PATHS_A_LANE), BATCHES)
    begins = np.cumsum(per_pair) - per_pair
    pair = np.repeat(np.arange(len(per_pair)), per_pair)
    place, batch = np.divmod(pair, BATCHES)
    first = (np.arange(len(pair)) - begins[pair]) * PATHS_A_LANE
    lanes = np.stack(
        [place, batch, earlier + first, np.minimum(per_batch[place] - first, PATHS_A_LANE)]
    )
    at_once = max(FLOATS_AT_ONCE // (2 * lines + 1), 1)
    chunks = (lanes[:, begin : begin + at_once] for begin in range(0, lanes.shape[1], at_once))
    sums = np.concatenate([walked.sums(chunk) for chunk in chunks], axis=1)
    by_batch = (
        np.add.reduceat(sums, begins, axis=1).reshape(lines + 1, len(samples), BATCHES)
        / per_batch[:, None]
    )
    return np.ascontiguousarray(np.moveaxis(by_batch, 2, 0), np.complex64)


def face_triangles(target: Target) -> list[np.ndarray]:
    """Return which triangles (n,) of each part lie on the undamaged face: the board's there, and
    all of tapes."""
    mesh = target.parts[0].mesh
    board = transform_points(invert(target.T_camera_board), mesh.vertices)
    within_m = MESH_WITHIN_M if target.config.board.shape.kind == "mesh" else FACE_WITHIN_M
    near = (
        np.abs(board[:, 2] - face_of(target.config.board).height_m(board[:, 0], board[:, 1]))
        < within_m
    )
    others = (
        np.full(len(part.mesh.faces), part.name.startswith("tape")) for part in target.parts[1:]
    )
    return [np.asarray(near[mesh.faces].all(axis=1)), *others]


def face_light(
    lit: LitScene,
    target: Target,
    direct: DirectLight,
    slopes: np.ndarray,
    work: PathWork,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indirect light (f + 1, n) by way of the face (without its holes) in the pixels
    that see any of it, in the order of `numpy.nonzero` of ``direct.face[-1]``, and its noise of
    range (n,) in metres."""
    seen = direct.face[-1].real > 0
    rays = np.concatenate([slopes[seen], np.ones((int(seen.sum()), 1))], axis=-1)
    rays *= (direct.face_range_m[seen] / np.linalg.norm(rays, axis=-1))[..., None]
    x_seen, y_seen, _ = transform_points(invert(target.T_camera_board), rays).T
    ends = ((each.min(), each.max()) for each in (x_seen, y_seen))
    spacing_m = config.face_spacing_mm * MM
    xs, ys = (
        np.linspace(low, high, max(int(np.ceil((high - low) / spacing_m)) + 1, 3))
        for low, high in ends
    )
    # points above the face and their unit normals, in the camera's frame
    face = face_of(target.config.board)
    T_camera_board = target.T_camera_board
    x, y = (each.ravel() for each in np.meshgrid(xs, ys))
    normal = face.normal(x, y)
    point = face.point(x, y) + ABOVE_FACE_M * normal
    position = transform_points(T_camera_board, point)
    normals = rotate_vectors(T_camera_board, normal)
    # the face's bounds, as a source of light for the surfaces before it
    bright = T_camera_board.copy()
    outline = target.outline_board_m[:, :2]
    low = outline.min(axis=0)
    high = outline.max(axis=0)
    bright[:3, 3] = transform_points(T_camera_board, np.append((low + high) / 2, 0.0))
    bright[:3, :2] *= (high - low) / 2
    light = gather_at_points(lit, position, normals, work, config.face_samples, bright)
    few = noise_lines(work.frequencies_hz)
    mean = np.ascontiguousarray(light.mean(axis=0, dtype=complex).T)
    off = np.ascontiguousarray(
        np.moveaxis(light[:, few] - light[:, few].mean(axis=0), 2, 0), complex
    )
    place = np.stack([(x_seen - xs[0]) / (xs[1] - xs[0]), (y_seen - ys[0]) / (ys[1] - ys[0])])
    weights = range_weights(tuple(work.frequencies_hz[k] for k in few))
    around = place, (len(xs), len(ys)), mean, off, np.array(few), weights
    return _between_nodes(*around, direct.face[:, seen], direct.phasor[:, seen])


@numba.njit(**FAST)
def _between_nodes(place, size, mean, off, few, weights, share, total):  # type: ignore[no-untyped-def]
    """Interpolate light between nodes, bilinearly, at places (2, n) in steps of the nodes
    (``size``: their columns and rows): ``mean`` (nodes, f + 1), and its batches' deviations
    ``off`` (nodes, B, l) at lines ``few``. Return light times ``share`` (f + 1, n), and its noise
    of range when added to ``total`` (f, n). The error is (s/D)^2/8 for a spacing s and a distance
    D of the light source: 2e-3 at 80 mm and 0.7 m."""
    batches, lines = off.shape[1:]
    found = np.empty_like(share)
    noise_m = np.empty(place.shape[1])
    turn = np.zeros(lines, np.complex128)
    for i in range(place.shape[1]):
        c = min(max(int(place[0, i]), 0), size[0] - 2)
        r = min(max(int(place[1, i]), 0), size[1] - 2)
        p = place[0, i] - c
        q = place[1, i] - r
        index = (
            r * size[0] + c,
            r * size[0] + c + 1,
            (r + 1) * size[0] + c,
            (r + 1) * size[0] + c + 1,
        )
        weight = ((1 - q) * (1 - p), (1 - q) * p, q * (1 - p), q * p)
        for k in range(mean.shape[1]):
            value = 0j
            for n in range(4):
                value += weight[n] * mean[index[n], k]
            found[k, i] = share[k, i] * value
        for line in range(lines):
            k = few[line]
            whole = total[k, i] + found[k, i]
            turn[line] = weights[line] * share[k, i] / whole if whole != 0 else 0j
        square = 0.0
        for b in range(batches):
            change = 0.0
            for line in range(lines):
                value = 0j
                for n in range(4):
                    value += weight[n] * off[index[n], b, line]
                change += (turn[line] * value).imag
            square += change * change
        noise_m[i] = np.sqrt(square / (batches - 1) / batches)
    return found, noise_m


RIM_PX = (
    3  # rendered surroundings of the board's outline, so that its rim looks as on the whole sensor
)
# beyond the outline, edges behind the board are finely sampled: the camera's filter mixes these
# pixels in
NEAR_PX = 3
HOLE_RIM_PX = 1
NARROW = (
    "through",
    "blind",
    "slot",
    "gouge",
    "chip",
)  # damage that may lie between a pixel's corners and its centre
FIRST_SAMPLES = 32  # paths of each pixel inside the outline before it is known how many are needed
AROUND = 1.0 - np.eye(25)[12].reshape(
    5, 5
)  # pixels whose first paths show how many: 768 seldom miss bright ones


def target_region(target: Target, optics: Optics) -> Region:
    """Return the region of the sensor that a render of the target covers. Raises UserError as
    `seen_region` does."""
    tight = seen_region(target.config, optics)
    return tight.grown(RIM_PX + optics.margin_px, optics.lens.height, optics.lens.width)


def render_view(target: Target, optics: Optics, config: RenderConfig) -> NoiseFreeView:
    """Render the noise-free view of a target by a camera. Raises UserError as `target_region` and
    `load_mitsuba` do."""
    began = time.perf_counter()
    mi = load_mitsuba()
    region = target_region(target, optics)
    lens = optics.lens
    lit = lit_scene(mi, target.parts, optics, face_triangles(target))
    slopes = lens.region_slopes(region)
    footprint = footprint_of(lens, region, optics.beam_fwhm_rad)
    # pixels within the face's outline as the camera sees it, or all if a part of the outline is
    # out of view
    outline = transform_points(target.T_camera_board, target.outline_board_m)
    inside = np.ones(region.shape, bool)
    if lens.images(outline).all():
        polygon = np.round(lens.project(outline) - [region.col0, region.row0]).astype(np.int32)
        inside = cv2.fillPoly(np.zeros(region.shape, np.uint8), [polygon], (1,)).astype(bool)
    about = ndimage.binary_dilation(inside, np.ones((3, 3), bool), NEAR_PX)
    closely = _at_holes(target, optics, slopes)
    direct = direct_light(lit, slopes, footprint, optics.frequencies_hz, closely, ~about)
    phasor = direct.phasor
    intensity = direct.intensity
    noise_m = np.zeros(region.shape)
    rgb = np.zeros((*region.shape, 3), np.float32)
    for index, part in enumerate(target.parts):
        here = direct.surface == index
        rgb[here] = part.rgb_at(direct.uv[here])
    if config.bounces > 0:
        indirect, noise_m = indirect_light(lit, target, optics, slopes, direct, inside, config)
        phasor = phasor + indirect[:-1]
        intensity = intensity + indirect[-1].real
    return NoiseFreeView(
        region=region,
        frequencies_hz=optics.frequencies_hz,
        phasor=phasor.astype(np.complex64),
        phasor_direct=direct.phasor.astype(np.complex64),
        intensity=intensity,
        indirect_noise_m=noise_m,
        range_m=direct.range_m,
        surface=direct.surface,
        surface_names=tuple(part.name for part in target.parts),
        coverage=direct.coverage,
        rgb=rgb,
        slopes=slopes,
        seconds=time.perf_counter() - began,
        variant=mi.variant(),
    )


def indirect_light(
    lit: LitScene,
    target: Target,
    optics: Optics,
    slopes: np.ndarray,
    direct: DirectLight,
    inside: np.ndarray,
    config: RenderConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Return indirect phasors (f + 1, h, w) and their noise in metres of range (h, w). That of the
    face comes from its nodes, all other from paths through the pixel's sub-rays; ``inside`` (h, w)
    the outline, noise sets their number."""
    frequencies = optics.frequencies_hz
    shape = direct.range_m.shape
    indirect = np.zeros((len(frequencies) + 1, direct.range_m.size), complex)
    variance = np.zeros(direct.range_m.size)
    total = direct.phasor.reshape(len(frequencies), -1).copy()
    seen = np.flatnonzero(direct.face[-1].real)
    if seen.size:
        work = PathWork(frequencies, config.bounces - 1, config.seed)
        indirect[:, seen], noise_m = face_light(lit, target, direct, slopes, work, config)
        total[:, seen] += indirect[:-1, seen]
        variance[seen] = noise_m**2
    work = PathWork(frequencies, config.bounces, config.seed)
    rays = direct.off_face
    here = rays.pixel
    share = rays.share
    within = inside.ravel()[rays.pixel]
    if here.size:
        light = _light_in_pixels(lit, direct, total[:, here], within, work, config)
        mean = share * light.mean(axis=0, dtype=complex)
        indirect[:, here] += mean
        total[:, here] += mean[:-1]
        variance[here] += (
            range_noise_m(share * light[:, noise_lines(frequencies)], total[:, here], frequencies)
            ** 2
        )
    return indirect.reshape(-1, *shape), np.sqrt(variance).reshape(shape)


def _light_in_pixels(
    lit: LitScene,
    direct: DirectLight,
    total: np.ndarray,
    within: np.ndarray,
    work: PathWork,
    config: RenderConfig,
) -> np.ndarray:
    """Return the light (B, f + 1, p) of paths; ``total`` (f, p): all other light. In the pixels
    ``within`` (p,), the first paths of the pixels around show how many reduce the noise of range
    to ``hole_noise_mm``. A pixel's own do not decide: those that missed rare bright light would
    end too soon, and the mean would be biased."""
    first = min(FIRST_SAMPLES, config.hole_samples)
    rays = direct.off_face
    f = work.frequencies_hz
    share = rays.share
    shape = direct.range_m.shape
    light = gather_in_pixels(lit, rays, work, np.where(within, first, config.rest_samples))
    mean = light.mean(axis=0, dtype=complex)
    noise_m = range_noise_m(share * light[:, noise_lines(f)], total + share * mean[:-1], f)
    spread = (noise_m * np.abs(total[0] / share + mean[0])) ** 2
    around = np.zeros((*shape, 4))
    around.reshape(-1, 4)[rays.pixel[within]] = np.stack(
        [within, spread, mean[0].real, mean[0].imag], -1
    )[within]
    summed = cv2.filter2D(around, -1, AROUND, borderType=cv2.BORDER_CONSTANT).reshape(-1, 4)[
        rays.pixel
    ]
    count, spread, re, im = (summed / np.maximum(summed[:, :1], 1)).T
    expected_m = np.sqrt(spread) / np.maximum(np.abs(total[0] / share + re + 1j * im), 1e-30)
    wanted = (np.where(count > 0, expected_m, noise_m) / (config.hole_noise_mm * MM)) ** 2
    doublings = np.ceil(np.log2(np.clip(wanted, 1, config.hole_samples)) - 0.5)
    many = np.where(within, np.clip(first * 2**doublings, first, config.hole_samples), 0).astype(
        np.int64
    )
    if (more := many > first).any():
        further = gather_in_pixels(lit, rays.chosen(more), work, (many - first)[more], after=first)
        light[..., more] += (1 - first / many[more]) * (further - light[..., more])
    return light


def _at_holes(target: Target, optics: Optics, slopes: np.ndarray) -> np.ndarray:
    """Return 1 in pixels (h, w) whose central ray passes the mouth of `NARROW` damage, 2 within
    HOLE_RIM_PX of its rim on both sides, 0 elsewhere."""
    rays = np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    found = np.zeros(slopes.shape[:2], np.int8)
    T_board_camera = invert(target.T_camera_board)
    for hole, declared in zip(target.truth, target.config.damages, strict=True):
        if hole.kind in NARROW:
            centre = hole.centre_camera_m
            axis = hole.axis_camera
            rim_m = HOLE_RIM_PX * float(centre[2]) / min(optics.lens.fx, optics.lens.fy)
            with np.errstate(divide="ignore", invalid="ignore"):
                on_plane = rays * ((centre @ axis) / (rays @ axis))[..., None]
            x, y, _ = np.moveaxis(transform_points(T_board_camera, on_plane), -1, 0)
            about = hole.within(x, y, rim_m + declared.reach_mm * MM - hole.reach_m)
            found[about] = np.maximum(found[about], 2 - hole.within(x[about], y[about], -rim_m))
    return found
