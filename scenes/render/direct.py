"""The direct part of a view: light from emitter to surface to pixel, deterministic, with fine
sampling at edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from scipy import ndimage

from scenes.optics import Quadrilaterals, wave_numbers
from scenes.render.scene import LitScene, Met, on_device

# sub-rays where fewer leave an error in a hole: a dark wall beside a strip of what lies behind it
FINEST = 2048
FLOATS_AT_ONCE = 1 << 24  # sums held on the device at once, and their footprints: 0.07 GB
A_LANE = 16  # sub-rays of one lane: a divisor of all numbers of sub-rays, at most 32 bits
KEPT = 32  # at least so many of a pixel's sub-rays off the face, or all, are starts of paths
# a pixel whose corners lie farther off the plane at its centre has an edge, such as that of tape
KINK_M = 2e-5
# up to this, its light follows from that plane without casting sub-rays
BENT_M = 2e-6
UNSURE_M = 1e-4  # pixels whose direct light may be wrong by more are sampled once more, finely
UNEVEN = 0.2  # relative spread of direct light in a footprint that indicates the edge of a shadow
# an edge is misplaced by one or two of m sub-rays; holes of 1/16 to 1 in before a backing showed
# this error
MISPLACED = 1.5
FAST: Any = {  # options for compilation
    "cache": True,
    "fastmath": {"contract", "reassoc", "nsz"},
    "nogil": True,
}
# largest deviation from even spacing, relative to the highest frequency, for the recurrence
COMB_TOLERANCE = 1e-9
EIGHT_AROUND = np.ones((3, 3), bool)
Frequencies = tuple[float, ...]


def comb_step(frequencies_hz: Frequencies) -> float | None:
    """Return the spacing in Hz of four or more evenly spaced frequencies (a comb); None for other
    lists."""
    if len(frequencies_hz) < 4:
        return None
    steps = np.diff(frequencies_hz)
    uneven = np.abs(steps - steps.mean()).max()
    if uneven > COMB_TOLERANCE * max(frequencies_hz):
        return None
    return float(steps.mean())


def added(
    totals: list[Any],
    light: Any,
    length: Any,
    frequencies_hz: Frequencies,
) -> list[Any]:
    """Add light after a path's length to real and imaginary sums by frequency, intensity last; for
    a comb, each phasor is the previous one times that of the spacing."""
    import drjit as dr

    parts = []
    waves = wave_numbers(frequencies_hz)
    step_hz = comb_step(frequencies_hz)
    if step_hz is None:
        for number in waves:
            sine, cosine = dr.sincos(float(number) * length)
            parts += [light * cosine, light * sine]
    else:
        sine, cosine = dr.sincos(float(waves[0]) * length)
        turn_sine, turn_cosine = dr.sincos(float(wave_numbers((step_hz,))[0]) * length)
        real = light * cosine
        imaginary = light * sine
        for _ in waves:
            parts += [real, imaginary]
            turned = real * turn_cosine - imaginary * turn_sine
            imaginary = real * turn_sine + imaginary * turn_cosine
            real = turned
    parts.append(light)
    return [total + part for total, part in zip(totals, parts, strict=True)]


class RayHits(NamedTuple):
    """Hits of n rays from the lens, float32."""

    range_m: np.ndarray
    """(n,): range; NaN for nothing."""
    path_m: np.ndarray
    """(n,): path from the emitter and back to the lens."""
    amplitude: np.ndarray
    """(n,): amplitude of direct light."""
    albedo: np.ndarray
    """(n,): albedo at 850 nm."""
    surface: np.ndarray
    """(n,) int32: index of the surface; -1 for nothing."""
    uv: np.ndarray
    """(n, 2): texture co-ordinates."""
    on_face: np.ndarray
    """(n,) bool: whether on the undamaged face."""
    normal: np.ndarray
    """(n, 3): unit normals towards the lens."""


class OffFace(NamedTuple):
    """Sub-rays of p pixels that met something other than the undamaged face."""

    pixel: np.ndarray
    """(p,): flat indices of the pixels that have any."""
    counts: np.ndarray
    """(p,): number of those that stand for all: every second if there are twice KEPT, and so on.
    """
    share: np.ndarray
    """(p,): share of all of them in the footprint."""
    slopes: np.ndarray
    """(sum of counts, 2) float32: slopes of those that stand for all, by pixel."""

    def chosen(self, mask: np.ndarray) -> OffFace:
        """Return those of the pixels selected by a mask (p,)."""
        return OffFace(
            pixel=self.pixel[mask],
            counts=self.counts[mask],
            share=self.share[mask],
            slopes=self.slopes[np.repeat(mask, self.counts)],
        )


class DirectLight(NamedTuple):
    """The direct part on a region (h, w)."""

    phasor: np.ndarray
    """(f, h, w): phasors."""
    intensity: np.ndarray
    """(h, w): the sum at frequency 0."""
    range_m: np.ndarray
    """(h, w): range of the central ray; NaN for nothing."""
    surface: np.ndarray
    """(h, w) int16: surface of the central ray; -1 for nothing."""
    uv: np.ndarray
    """(h, w, 2): texture co-ordinates of the central ray."""
    coverage: np.ndarray
    """(h, w) float32: share of the footprint on that surface."""
    fine: np.ndarray
    """(h, w) bool: which pixels were finely sampled."""
    face: np.ndarray
    """(f + 1, h, w): mean over a pixel's sub-rays of albedo x exp(i 2 pi f range / c) of those on
    the undamaged face, frequency 0 last."""
    face_range_m: np.ndarray
    """(h, w): their mean range; 0 without any."""
    off_face: OffFace
    """The other sub-rays that met something."""


def cast(lit: LitScene, slopes: np.ndarray) -> RayHits:
    """Cast rays from the lens along ``slopes`` (n, 2) = x/z, y/z."""
    mi = lit.mi
    dr = lit.dr
    x = on_device(mi.Float, slopes[:, 0])
    y = on_device(mi.Float, slopes[:, 1])
    met = lit.meet(mi.Point3f(0.0), dr.normalize(mi.Vector3f(x, y, 1.0)), coherent=True)
    arriving, leg = lit.arriving(met, coherent=True)
    albedo = lit.albedo(met)
    uv = lit.uv(met.point)
    range_m = dr.select(met.valid, met.distance, dr.nan)
    path_m = dr.select(met.valid, met.distance + leg, 0)
    amplitude = albedo * arriving
    surface = dr.select(met.valid, mi.Int32(met.surface), -1)
    on_face = dr.gather(mi.Bool, lit.on_face, met.triangle, met.valid)
    dr.eval(
        range_m,
        path_m,
        amplitude,
        albedo,
        surface,
        uv,
        on_face,
        met.normal,
    )
    # vectors one by one: to interleave them, Dr.Jit would compile a kernel for each number of rays
    return RayHits(
        range_m=range_m.numpy(),
        path_m=path_m.numpy(),
        amplitude=amplitude.numpy(),
        albedo=albedo.numpy(),
        surface=surface.numpy(),
        uv=np.column_stack([component.numpy() for component in uv]),
        on_face=on_face.numpy(),
        normal=np.column_stack([component.numpy() for component in met.normal]),
    )


class _LaneSums(NamedTuple):
    """Sums over the sub-rays of each lane, as Dr.Jit arrays; over those of each pixel, as NumPy
    arrays (n,) or, of the lists, (k, n)."""

    light: Any
    """Phasors of direct light, real and imaginary by turns; intensity last."""
    face: Any
    """The same of `DirectLight.face`."""
    count: Any
    """Number of sub-rays on the undamaged face."""
    same: Any
    """Number on the surface of the central ray."""
    face_range_m: Any
    """Range of those on the face."""
    first: Any
    """Light times the path beyond the central ray's."""
    second: Any
    """Light times the square of that."""
    strongest: Any
    """The largest light of one sub-ray."""


# meets a sub-ray of each lane: its hit, irradiance, distance from the emitter, and if on the face
_Meet = Callable[[Any], tuple[Met, Any, Any, Any]]


class _Sums:
    """Sums of direct light of a region's pixels, flat; fields as in `DirectLight`."""

    def __init__(
        self,
        lit: LitScene,
        slopes: np.ndarray,
        footprint: Quadrilaterals,
        frequencies_hz: Frequencies,
    ) -> None:
        height, width = slopes.shape[:2]
        pixels = height * width
        lines = len(frequencies_hz)
        self.lit = lit
        self.footprint = footprint
        self.frequencies_hz = frequencies_hz
        self.slopes = slopes.reshape(-1, 2)
        self.rows, self.cols = np.divmod(np.arange(pixels), width)
        self.central = cast(lit, self.slopes)
        self.phasor = np.zeros((lines, pixels), complex)
        self.face = np.zeros((lines + 1, pixels), complex)
        self.intensity = np.zeros(pixels)
        self.coverage = np.ones(pixels)
        self.face_range_m = np.zeros(pixels)
        none = np.zeros(0, int)
        no_slopes = np.zeros((0, 2), np.float32)
        self.off_face = [OffFace(none, none, np.zeros(0), no_slopes)]

    def add_all(
        self,
        wanted: np.ndarray,
        weights: np.ndarray,
        again: np.ndarray | None = None,
        plane: bool = False,
    ) -> np.ndarray:
        """Call `add` for the pixels ``wanted`` (h w,), so many at once as memory allows; return a
        mask as well."""
        pixels = np.flatnonzero(wanted)
        unsure = np.zeros(len(wanted), bool)
        lanes_a_pixel = weights.shape[1] // A_LANE
        floats_a_lane = 4 * len(self.frequencies_hz) + 24
        at_once = max(FLOATS_AT_ONCE // lanes_a_pixel // floats_a_lane, 1)
        for begin in range(0, len(pixels), at_once):
            unsure[self.add(pixels[begin : begin + at_once], weights, again, plane)] = True
        return unsure

    def add(
        self,
        pixels: np.ndarray,
        weights: np.ndarray,
        again: np.ndarray | None = None,
        plane: bool = False,
    ) -> np.ndarray:
        """Add the light of the footprints' sub-rays in pixels (n,); no rays are cast if each pixel
        sees only the ``plane`` at its centre. Return those of ``again`` (h w,) that need finer
        sampling.

        ``weights`` (k, m): of m sub-rays, axes (n, 3, k) @ weights."""
        m = weights.shape[1]
        axes = self.footprint.axes(self.rows[pixels], self.cols[pixels])
        sums, off_bits = self._lane_sums(pixels, axes, weights, plane)
        by_lane = (len(pixels), m // A_LANE)
        means = _LaneSums._make([_means(lanes, by_lane) for lanes in sums])
        strongest = np.maximum(sums.strongest.numpy().reshape(by_lane).max(axis=1), 1e-30)

        light = means.light
        face = means.face
        self.phasor.real[:, pixels] = light[:-1:2]
        self.phasor.imag[:, pixels] = light[1::2]
        self.intensity[pixels] = light[-1]
        self.face.real[:-1, pixels] = face[:-1:2]
        self.face.imag[:-1, pixels] = face[1::2]
        self.face[-1, pixels] = face[-1]
        self.coverage[pixels] = means.same
        self.face_range_m[pixels] = means.face_range_m / np.maximum(means.count, 1 / m)
        unsure = np.zeros(len(pixels), bool)
        if again is not None:
            unsure = again[pixels] & (_error_m(means, strongest, m) > UNSURE_M)
        bits = off_bits.numpy().reshape(by_lane)
        sure = ~unsure
        self.off_face.append(_off_face(pixels[sure], bits[sure], axes[sure], weights))
        return pixels[unsure]

    def _lane_sums(
        self,
        pixels: np.ndarray,
        axes: np.ndarray,
        weights: np.ndarray,
        plane: bool,
    ) -> tuple[_LaneSums, Any]:
        """Return the sums of each lane, which has A_LANE sub-rays of a pixel, and the bits of
        those that met something off the face; pixels one after the other."""
        mi = self.lit.mi
        dr = self.lit.dr
        lines = len(self.frequencies_hz)
        n, _, k = axes.shape
        lanes_a_pixel = weights.shape[1] // A_LANE
        lanes = n * lanes_a_pixel

        def by_lane(values: np.ndarray) -> Any:
            return on_device(mi.Float, np.repeat(values.astype(np.float32), lanes_a_pixel))

        axis = [by_lane(column) for column in axes.reshape(n, -1).T]
        table = [on_device(mi.Float, row) for row in weights]
        begin = on_device(mi.UInt32, np.tile(np.arange(lanes_a_pixel) * A_LANE, n))
        central_path_m = by_lane(self.central.path_m[pixels])
        central_surface = by_lane(self.central.surface[pixels])
        meet = self._on_planes(pixels, central_surface) if plane else self._cast

        def component(weight: list[Any], row: int) -> Any:
            return sum(axis[row * k + i] * weight[i] for i in range(k))

        def unfinished(j: Any, *_: Any) -> Any:
            return j < A_LANE

        def step(j: Any, off: Any, *earlier: Any) -> tuple[Any, ...]:
            sums = _LaneSums._make(earlier)  # Dr.Jit takes plain tuples only
            weight = [dr.gather(mi.Float, row, begin + j) for row in table]
            ray = mi.Vector3f(component(weight, 0), component(weight, 1), component(weight, 2))
            met, arriving, leg, on_face = meet(dr.normalize(ray))
            albedo = self.lit.albedo(met)
            amplitude = albedo * arriving
            longer = dr.select(met.valid, met.distance + leg - central_path_m, 0)
            surface = dr.select(met.valid, mi.Float(met.surface), -1)
            length = longer + central_path_m
            on_face_albedo = dr.select(on_face, albedo, 0)
            sums = _LaneSums(
                light=added(sums.light, amplitude, length, self.frequencies_hz),
                face=added(sums.face, on_face_albedo, met.distance, self.frequencies_hz),
                count=sums.count + dr.select(on_face, 1.0, 0.0),
                same=sums.same + dr.select(surface == central_surface, 1.0, 0.0),
                face_range_m=sums.face_range_m + dr.select(on_face, met.distance, 0),
                first=sums.first + amplitude * longer,
                second=sums.second + amplitude * dr.square(longer),
                strongest=dr.maximum(sums.strongest, amplitude),
            )
            off = off | dr.select(met.valid & ~on_face, mi.UInt32(1) << j, 0)
            return j + 1, off, *sums

        no_phasors = [dr.zeros(mi.Float, lanes) for _ in range(2 * lines + 1)]
        no_face = [dr.zeros(mi.Float, lanes) for _ in range(2 * lines + 1)]
        numbers = [dr.zeros(mi.Float, lanes) for _ in range(6)]
        begin_j = dr.zeros(mi.UInt32, lanes)
        no_bits = dr.zeros(mi.UInt32, lanes)
        state = (begin_j, no_bits, no_phasors, no_face, *numbers)
        _, off, *sums = dr.while_loop(state, unfinished, step, label="footprints")
        dr.eval(off, sums)
        return _LaneSums._make(sums), off

    def _cast(self, ray: Any) -> tuple[Met, Any, Any, Any]:
        """Meet the scene."""
        lit = self.lit
        met = lit.meet(lit.mi.Point3f(0.0), ray, coherent=True)
        on_face = lit.dr.gather(lit.mi.Bool, lit.on_face, met.triangle, met.valid)
        arriving, leg = lit.arriving(met, coherent=True)
        return met, arriving, leg, on_face

    def _on_planes(self, pixels: np.ndarray, surface: Any) -> _Meet:
        """Return a function that meets the plane at each pixel's centre; each has one lane."""
        lit = self.lit
        mi = lit.mi
        dr = lit.dr
        central = self.central
        normals = central.normal[pixels]
        rays = np.column_stack([self.slopes[pixels], np.ones(len(pixels))])
        rays *= (central.range_m[pixels] / np.linalg.norm(rays, axis=1))[:, None]
        height = on_device(mi.Float, (normals * rays).sum(axis=1))
        normal = mi.Normal3f([on_device(mi.Float, column) for column in normals.T])
        on_face = on_device(mi.UInt32, central.on_face[pixels]) > 0
        clear = on_device(mi.UInt32, (central.amplitude > 0)[pixels]) > 0

        def meet(ray: Any) -> tuple[Met, Any, Any, Any]:
            distance = height / dr.dot(normal, ray)
            met = Met(
                valid=mi.Bool(True),
                distance=distance,
                point=mi.Point3f(distance * ray),
                normal=normal,
                surface=mi.UInt32(surface),
                triangle=mi.UInt32(0),
                viewer=-ray,
            )
            arriving, leg = lit.arriving(met, clear=clear)
            return met, arriving, leg, on_face

        return meet


def _means(lanes: Any, by_lane: tuple[int, int]) -> np.ndarray:
    """Return the means over each pixel's sub-rays of an array or a list of arrays by lane."""
    if isinstance(lanes, list):
        return np.stack([_means(array, by_lane) for array in lanes])
    sums = lanes.numpy().astype(float)
    if by_lane[1] > 1:
        sums = sums.reshape(by_lane).sum(axis=1)
    sub_rays = by_lane[1] * A_LANE
    return np.asarray(sums / sub_rays)


def _error_m(
    means: _LaneSums,
    strongest: np.ndarray,
    count: int,
) -> np.ndarray:
    """Return the error of range (n,) to expect if MISPLACED of ``count`` sub-rays lie on the other
    side of an edge: the spread of the paths in a pixel, over the number of sub-rays and the root
    of its light over that of ``strongest`` (n,) alone."""
    light = means.light[-1]
    total = np.maximum(light, 1e-30)
    variance_m2 = means.second / total - (means.first / total) ** 2
    spread_m = np.sqrt(np.maximum(variance_m2, 0.0))
    bright_share = np.maximum(light / strongest, 1 / count)
    return np.asarray(MISPLACED * spread_m / (count * np.sqrt(bright_share)))


def _off_face(
    pixels: np.ndarray,
    bits: np.ndarray,
    axes: np.ndarray,
    weights: np.ndarray,
) -> OffFace:
    """Return the sub-rays of pixels (n,) whose bit is set in ``bits`` (n, m / A_LANE)."""
    counts = np.bitwise_count(bits).sum(axis=1, dtype=int)
    any_off = counts > 0
    counts = counts[any_off]
    steps = np.maximum(counts // KEPT, 1)
    kept = -(-counts // steps)
    slopes = np.empty((kept.sum(), 2), np.float32)
    _slopes_kept(bits[any_off], steps, axes[any_off], weights, slopes)
    share = counts / weights.shape[1]
    return OffFace(pixels[any_off], kept, share, slopes)


@numba.njit(**FAST)
def _slopes_kept(  # type: ignore[no-untyped-def]
    off,
    steps,
    axes,
    weights,
    slopes,
):
    """Write the slopes of every ``steps`` (n,)-th of a pixel's sub-rays whose bit is set in
    ``off`` (n, m / A_LANE)."""
    written = 0
    ray = np.zeros(3)
    for i in range(off.shape[0]):
        number = 0
        for j in range(weights.shape[1]):
            if off[i, j // A_LANE] >> (j % A_LANE) & 1:
                if number % steps[i] == 0:
                    ray[:] = 0.0
                    for c in range(3):
                        for k in range(weights.shape[0]):
                            ray[c] += axes[i, c, k] * weights[k, j]
                    slopes[written, 0] = ray[0] / ray[2]
                    slopes[written, 1] = ray[1] / ray[2]
                    written += 1
                number += 1


def _told_closely(closely: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) bool that count as edges because ``closely`` (h, w) says so: above
    1 anywhere, above 0 beside an ``edge`` (h, w) bool."""
    beside_edge = ndimage.binary_dilation(edge, EIGHT_AROUND)
    return np.asarray((closely > 1) | ((closely > 0) & beside_edge))


def direct_light(
    lit: LitScene,
    slopes: np.ndarray,
    footprint: Quadrilaterals,
    frequencies_hz: Frequencies,
    closely: np.ndarray | None = None,
    roughly: np.ndarray | None = None,
) -> DirectLight:
    """Return the direct light of every pixel of a region with central rays ``slopes`` (h, w, 2).

    If the rays to a pixel's centre and corners meet one evenly lit plane, its light follows from
    these. Other pixels are sampled by sub-rays: a few on a curved surface, many where the
    footprint meets an edge or the edge of a shadow.

    ``closely`` (h, w): many in the pixels that are 2, and in those that are 1 beside such edges;
    where it is not 0, more follow if an error is left. ``roughly`` (h, w): in these pixels there
    are a few at edges, too."""
    shape = slopes.shape[:2]
    sums = _Sums(lit, slopes, footprint, frequencies_hz)
    central = sums.central
    bend_m, edge = _corners(lit, footprint.corner, slopes, central)
    if closely is not None:
        edge |= _told_closely(closely, edge)
    reach = 2 * footprint.reach_px + 1
    edge = ndimage.binary_dilation(edge, np.ones((reach, reach), bool))
    fine = edge if roughly is None else edge & ~roughly
    coarse = ~fine.ravel()
    bent = ((bend_m > BENT_M) | edge).ravel()
    sums.add_all(coarse & ~bent & (central.surface >= 0), footprint.grid(), plane=True)
    sums.add_all(coarse & bent, footprint.grid())
    again = None if closely is None else closely.ravel() > 0
    unsure = sums.add_all(fine.ravel(), footprint.lattice(), again)
    sums.add_all(unsure, footprint.lattice(FINEST))
    return DirectLight(
        phasor=sums.phasor.reshape(-1, *shape),
        intensity=sums.intensity.reshape(shape),
        range_m=central.range_m.reshape(shape).astype(float),
        surface=central.surface.reshape(shape).astype(np.int16),
        uv=central.uv.reshape(*shape, 2),
        coverage=sums.coverage.reshape(shape).astype(np.float32),
        fine=fine,
        face=sums.face.reshape(-1, *shape),
        face_range_m=sums.face_range_m.reshape(shape),
        off_face=OffFace._make(map(np.concatenate, zip(*sums.off_face, strict=True))),
    )


def _corners(
    lit: LitScene,
    corner: np.ndarray,
    slopes: np.ndarray,
    central: RayHits,
) -> tuple[np.ndarray, np.ndarray]:
    """Return, (h, w) each, how far rays through a pixel's corners hit off the plane at its centre,
    and whether they show an edge or the edge of a shadow in the pixel.

    ``corner`` (h + 1, w + 1, 2): slopes of the corners."""
    h, w = slopes.shape[:2]
    hits = cast(lit, corner.reshape(-1, 2))
    corner_range_m = hits.range_m.reshape(h + 1, w + 1)
    corner_light = _over_albedo(hits).reshape(h + 1, w + 1)
    corner_surface = hits.surface.reshape(h + 1, w + 1)

    normal_x, normal_y, normal_z = central.normal.reshape(h, w, 3).astype(float).transpose(2, 0, 1)
    slope_x = slopes[..., 0]
    slope_y = slopes[..., 1]
    range_m = central.range_m.reshape(h, w).astype(float)
    along_normal = normal_x * slope_x + normal_y * slope_y + normal_z
    height_m = range_m * along_normal / np.sqrt(slope_x * slope_x + slope_y * slope_y + 1)
    light = _over_albedo(central).reshape(h, w)
    surface = central.surface.reshape(h, w)
    brightest = light.copy()
    darkest = light.copy()
    bend_m = np.zeros((h, w))
    edge = np.zeros((h, w), bool)
    for rows in (slice(h), slice(1, None)):
        for cols in (slice(w), slice(1, None)):
            x = corner[rows, cols, 0]
            y = corner[rows, cols, 1]
            length = np.sqrt(1 + x * x + y * y)
            with np.errstate(invalid="ignore", divide="ignore"):
                along_normal = normal_x * x + normal_y * y + normal_z
                off_m = np.abs(corner_range_m[rows, cols] - height_m * length / along_normal)
            bend_m = np.fmax(bend_m, off_m)
            edge |= corner_surface[rows, cols] != surface
            brightest = np.maximum(brightest, corner_light[rows, cols])
            darkest = np.minimum(darkest, corner_light[rows, cols])
    shadowed = brightest - darkest > UNEVEN * brightest
    return bend_m, edge | (bend_m > KINK_M) | shadowed


def _over_albedo(hits: RayHits) -> np.ndarray:
    """Return the light (n,) of hits on a surface of albedo 1; 0 where the albedo is 0."""
    nothing = np.zeros(len(hits.albedo))
    return np.divide(
        hits.amplitude,
        hits.albedo,
        out=nothing,
        where=hits.albedo > 0,
    )
