"""Characteristics that static captures of a depth camera tell: noise, correlation, dropouts, whole frames, edges.

Flat surfaces are found in each capture; where there is none, every pixel with a steady range counts, and neither angle
nor fixed pattern nor edges are told. Temporal noise is that of single pixels about their own mean, each frame's
displacement taken off. Not told: errors that all frames and all pixels share (a constant offset of range, a wrong scale
of the lens), and noise slower than the capture.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, pairwise

import numpy as np
from scipy import ndimage, optimize, stats

from detectors.flat_captures import FlatCapture, Separated, flattened, separated
from detectors.noise import LEAST_FRAMES, rounding_left_m2
from detectors.recordings import Recording
from harness.scorecard import bench
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens, Reason
from scenes.closed_form import Plane

MOST_FRAMES = 300
"""Frames of a capture that are held in memory: 440 MB of 640 x 576 pixels."""
TOLERANCE_M, LEAST_PLANE_PX, EDGE_PX = 8 * MM, 2000, 3
"""Distance from a plane within which a point is on it, least size of a plane, and depth of its rim that is left out."""
LEAST_CELL_PX = 300
RANGE_CELLS, LIGHT_CELLS, ANGLE_CELL_DEG = 1.08, 1.25, 10.0
"""Ratios of the ends of a cell of range and of brightness, and width of a cell of angle."""
TELLING_RATIO = 1.25
"""Ratio of the largest and the smallest range, or brightness, from which on they tell an exponent."""
LAGS, PATTERN_LAGS, CORRELATED_FRAMES = 12, 40, 16
"""Pixels to which the correlations of noise and of pattern are followed, and frames that tell the former."""
JUMP_M, JUMP_SIGMAS = 3 * MM, 6.0
"""A frame jumps if it is displaced by more than either: ten times the wander of a static Azure Kinect."""
WIDEST_PX, LEAST_STEP_M = 24, 20 * MM
"""Pixels between two surfaces up to which they share an edge, and the step of depth there."""
ASSUMED_RANGE_EXPONENT, ASSUMED_LIGHT_EXPONENT = 2.0, 0.5
"""Exponents where the captures do not tell them: read noise or a disparity's error, and shot noise."""
SLOW, WIDE_PX, COARSE = 0.15, 6.5, 0.35
"""Correlation of successive frames, reach of neighbours' correlation, and noise by rounding steps, beyond which the
recording was averaged, smoothed or rounded before it was stored."""


@dataclass(frozen=True)
class StillCapture:
    """Frames of a static scene: ``z_m`` (n, h, w) float32, NaN where invalid; ``slopes`` (h, w, 2); ``amplitude`` (n,
    h, w) or None; ``step_m`` of the stored z; ``planes`` with their pixels (h, w) bool, largest first."""

    name: str
    lens: Lens
    z_m: np.ndarray
    slopes: np.ndarray
    amplitude: np.ndarray | None
    step_m: float
    planes: tuple[tuple[Plane, np.ndarray], ...]

    @cached_property
    def offsets_m(self) -> np.ndarray:
        """(n,) displacement of each frame as a whole against the mean of all, metres of z."""
        use = self.steady
        middle = np.nanmean(self.z_m[:, use], axis=0, dtype=np.float64)
        return np.array([np.nanmean(z[use] - middle) for z in self.z_m])

    @cached_property
    def drift_m(self) -> float:
        """Change of the frames' displacement over the capture by its robust slope (Theil and Sen)."""
        return float(stats.theilslopes(self.offsets_m)[0]) * (len(self.z_m) - 1)

    @cached_property
    def apart_m(self) -> np.ndarray:
        """(n,) displacement of the frames without the drift."""
        apart = self.offsets_m - self.drift_m * np.linspace(0, 1, len(self.z_m))
        return np.asarray(apart - np.median(apart))

    @cached_property
    def kept(self) -> np.ndarray:
        """(n,) bool: frames that do not jump."""
        return np.abs(self.apart_m) <= max(JUMP_M, JUMP_SIGMAS * 1.4826 * float(np.median(np.abs(self.apart_m))))

    @property
    def jitter_m(self) -> float:
        """Standard deviation of the displacement of frames that do not jump."""
        return float(self.apart_m[self.kept].std(ddof=1))

    @cached_property
    def steady(self) -> np.ndarray:
        """(h, w) bool: pixels of the surfaces, without their rims, that most frames give a range."""
        often = np.isfinite(self.z_m).mean(axis=0) > 0.5
        if not self.planes:
            return often
        return often & np.any([inner(mask) for _, mask in self.planes], axis=0)

    @cached_property
    def mean_m(self) -> np.ndarray:
        """(h, w) mean z of the frames that do not jump; NaN where there is none."""
        known = np.isfinite(self.z_m).any(axis=0)
        mean_m = np.full(known.shape, np.nan)
        moved = self.offsets_m[self.kept].astype(np.float32)
        mean_m[known] = np.nanmean(self.z_m[self.kept][:, known] - moved[:, None], axis=0)
        return mean_m

    @cached_property
    def noise_m(self) -> np.ndarray:
        """(n, h, w) float32: deviations from the mean, displacements of frames taken off; without jumping frames."""
        moved = self.offsets_m[self.kept].astype(np.float32)
        return np.asarray(self.z_m[self.kept] - moved[:, None, None] - self.mean_m.astype(np.float32), np.float32)

    @cached_property
    def variance_m2(self) -> np.ndarray:
        """(h, w) temporal variance of z; NaN where unknown."""
        count = np.isfinite(self.noise_m).sum(axis=0)
        square = np.nansum(self.noise_m**2, axis=0, dtype=np.float64)
        return np.where(count > 1, square / np.maximum(count - 1, 1), np.nan)

    @cached_property
    def stretch(self) -> np.ndarray:
        """(h, w) distance along the ray by that along the axis."""
        return np.asarray(np.sqrt(1 + (self.slopes**2).sum(axis=-1)))

    @cached_property
    def cosine(self) -> np.ndarray:
        """(h, w) of the angle of incidence on the planes, 1 elsewhere."""
        cosine = np.ones(self.stretch.shape)
        for plane, mask in self.planes:
            rays = np.concatenate([self.slopes, np.ones((*self.stretch.shape, 1))], axis=-1) / self.stretch[..., None]
            cosine[mask] = np.abs(rays[mask] @ plane.normal)
        return cosine

    @cached_property
    def mean_amplitude(self) -> np.ndarray | None:
        """(h, w) mean over the frames, NaN where never above 0."""
        if self.amplitude is None:
            return None
        mean = np.where(np.isfinite(self.amplitude), self.amplitude, 0.0).mean(axis=0)
        return np.where(mean > 0, mean, np.nan)

    def cloud(self) -> Cloud:
        """Return the average of the frames that do not jump."""
        count = np.isfinite(self.noise_m).sum(axis=0)
        points = np.concatenate([self.slopes * self.mean_m[..., None], self.mean_m[..., None]], axis=-1)
        reason = np.where(count > 0, Reason.VALID, Reason.NO_RETURN).astype(np.uint8)
        variance = np.where(count > 1, self.variance_m2, np.nan)
        whole, frames = self.lens.whole, int(self.kept.sum())
        return Cloud(points, reason, count, variance, whole, self.step_m, frames, lens=self.lens)


def inner(mask: np.ndarray) -> np.ndarray:
    """Return a mask (h, w) without a rim of `EDGE_PX`: the camera's filter mixes in what is beyond."""
    return np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] > EDGE_PX)


def read_still(recording: Recording) -> StillCapture:
    """Read a recording into memory, `MOST_FRAMES` at most. Raises UserError where it has too few frames, no grid of
    pixels or no lens, or where nothing in it varies."""
    if not recording.organised or recording.lens is None or recording.slopes is None:
        what = f"{recording.name}: points without a pixel grid and a lens do not tell a camera's noise"
        raise UserError(what, legal="depth images with a lens", fix="name a lens with --intrinsics")
    frames = [frame for frame in islice(recording.frames(), MOST_FRAMES) if np.isfinite(frame.z_m).any()]
    if len(frames) < LEAST_FRAMES:
        what = f"{recording.name}: {len(frames)} frame{'s' * (len(frames) > 1)}; temporal noise needs repeats"
        raise UserError(what, legal=f"{LEAST_FRAMES} frames or more of a static scene", fix="record 50 or more")
    z_m = np.stack([frame.z_m for frame in frames]).astype(np.float32)
    if np.array_equal(z_m[0], z_m[-1], equal_nan=True) and np.array_equal(z_m[0], z_m[len(z_m) // 2], equal_nan=True):
        what = f"{recording.name}: all frames are equal, so that they show no noise"
        raise UserError(what, legal="frames as the camera gives them", fix="record single frames, not their average")
    amplitudes = [frame.amplitude for frame in frames if frame.amplitude is not None]
    amplitude = np.stack(amplitudes) if len(amplitudes) == len(frames) else None
    often = np.isfinite(z_m).mean(axis=0) >= 0.5
    median_m = np.full(often.shape, np.nan)
    median_m[often] = np.nanmedian(z_m[:, often], axis=0)
    planes = bench.find_planes(median_m, recording.slopes, TOLERANCE_M, min(LEAST_PLANE_PX, often.size // 20))
    return StillCapture(
        recording.name, recording.lens, z_m, recording.slopes, amplitude, recording.z_step_m, tuple(planes)
    )


# ---------------------------------------------------------------- one figure after the other


@dataclass(frozen=True)
class NoiseCell:
    """Temporal noise ``sigma_m`` along the ray, before rounding, of ``pixels`` at like conditions, means of
    ``range_m``, ``angle_deg``, ``amplitude`` (NaN where not recorded) and ``light``: amplitude times range squared,
    or the cosine of the angle where no amplitude is recorded."""

    capture: str
    pixels: int
    range_m: float
    angle_deg: float
    amplitude: float
    light: float
    sigma_m: float


def cells_of(capture: StillCapture) -> Iterator[NoiseCell]:
    """Yield the noise of a capture in cells of range, angle and brightness."""
    use = capture.steady & np.isfinite(capture.variance_m2)
    range_m, cosine = (capture.mean_m * capture.stretch)[use], capture.cosine[use]
    angle_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    amplitude = np.full(range_m.shape, np.nan) if capture.mean_amplitude is None else capture.mean_amplitude[use]
    light = cosine if capture.mean_amplitude is None else amplitude * range_m**2
    known = np.isfinite(light) & (light > 0)
    where = [np.log(range_m) / np.log(RANGE_CELLS), angle_deg / ANGLE_CELL_DEG]
    if capture.mean_amplitude is not None:
        where.append(np.log(np.where(known, light, 1.0)) / np.log(LIGHT_CELLS))
    places = np.floor(np.stack(where, axis=-1)[known]).astype(int)
    _, cell, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    columns = (range_m, angle_deg, amplitude, light, capture.variance_m2[use], capture.stretch[use])
    means = [np.bincount(cell.ravel(), column[known], len(counts)) / counts for column in columns]
    for number in np.flatnonzero(counts >= LEAST_CELL_PX):
        r, angle, amp, bright, variance, stretch = (float(mean[number]) for mean in means)
        sigma_m = np.sqrt(before_rounding_m2(variance, capture.step_m)) * stretch
        yield NoiseCell(capture.name, int(counts[number]), r, angle, amp, bright, float(sigma_m))


def before_rounding_m2(variance_m2: float, step_m: float) -> float:
    """Return the variance of z before it was rounded, from that of frames after it, averaged over all phases of the
    rounding: s^2 + q^2 / 12 less what rounding fixes (`rounding_left_m2`)."""

    def after(s2: float) -> float:
        return s2 + step_m**2 / 12 - rounding_left_m2(step_m, s2) - variance_m2

    if step_m <= 0 or variance_m2 > 100 * step_m**2:
        return variance_m2
    # an empty difference of squares leaves no noise to speak of
    return float(optimize.brentq(after, 1e-6 * step_m**2, variance_m2 + step_m**2)) if variance_m2 > 0 else 0.0


@dataclass(frozen=True)
class RangeLaw:
    """Noise of the recorded surface, facing, before rounding: ``sigma_m`` at ``range_m`` (k,); as the power of range
    and of brightness, each with its standard error, which is NaN for an exponent that is assumed. ``light_at_1m``: the
    brightness that counts as 1."""

    range_m: np.ndarray
    sigma_m: np.ndarray
    range_exponent: float
    range_exponent_se: float
    light_exponent: float
    light_exponent_se: float
    light_at_1m: float


def noise_law(cells: Sequence[NoiseCell]) -> RangeLaw:
    """Return the law that fits the cells of all captures by weighted least squares of the logarithms."""
    r, light, sigma, angle = (
        np.array([getattr(c, k) for c in cells]) for k in ("range_m", "light", "sigma_m", "angle_deg")
    )
    weight = np.sqrt(np.array([cell.pixels for cell in cells], float))
    light_at_1m = float(np.exp(np.average(np.log(light / np.cos(np.radians(angle))), weights=weight**2)))
    bright = np.log(light / light_at_1m)
    assumed = np.array([0.0, ASSUMED_RANGE_EXPONENT, -ASSUMED_LIGHT_EXPONENT])
    columns = np.stack([np.ones(len(r)), np.log(r), bright], axis=-1)
    told = [True, *(np.ptp(column) > np.log(TELLING_RATIO) for column in columns[:, 1:].T)]
    rest = np.log(sigma) - columns[:, [not one for one in told]] @ assumed[[not one for one in told]]
    design = columns[:, told] * weight[:, None]
    found = np.linalg.lstsq(design, rest * weight, rcond=None)[0]
    spread = float(((rest * weight - design @ found) ** 2).sum() / max(len(r) - sum(told), 1))
    errors = np.full(3, np.nan)
    errors[told] = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)) * spread)
    assumed[told] = found
    facing = np.log(sigma) - assumed[2] * bright
    number = np.floor(np.log(r) / np.log(RANGE_CELLS) + 1e-9)
    groups = [number == one for one in np.unique(number)]
    at, level = (
        np.array([np.average(values[group], weights=weight[group] ** 2) for group in groups])
        for values in (np.log(r), facing)
    )
    exponents = max(float(assumed[1]), 0.0), float(errors[1]), max(-float(assumed[2]), 0.0), float(errors[2])
    return RangeLaw(np.exp(at), np.exp(level), *exponents, light_at_1m)


def correlations(capture: StillCapture) -> np.ndarray:
    """Return the correlation (2, `LAGS` + 1) of the noise before rounding of pixels so far apart, along x and y."""
    noise = capture.noise_m[:CORRELATED_FRAMES]
    use = capture.steady & np.isfinite(noise).all(axis=0)
    variance = float((noise[:, use] ** 2).mean()) if use.any() else float("nan")
    raise_by = variance / max(before_rounding_m2(variance, capture.step_m), 1e-18) if use.any() else 1.0
    found = np.ones((2, LAGS + 1))
    for lag in range(1, LAGS + 1):
        along = (bench.correlation(noise, use, lag, 0), bench.correlation(noise, use, 0, lag))
        found[:, lag] = np.clip(np.nan_to_num(along) * min(raise_by, 4.0), -0.99, 0.99)
    return found


def successive(capture: StillCapture) -> float:
    """Return the correlation of a pixel's noise in successive frames; that of independent frames is 0 on average."""
    noise, n = capture.noise_m[:, capture.steady], int(capture.kept.sum())
    products = [np.nanmean(one * two) for one, two in pairwise(noise)]
    return float(np.mean(products) / np.nanmean(noise**2)) + 1.0 / n


@dataclass(frozen=True)
class Dropouts:
    """Share of frames (k,) in which pixels of a surface return nothing, by mean ``amplitude`` (k,), NaN where that is
    not recorded; ``pixels`` (k,)."""

    amplitude: np.ndarray
    share: np.ndarray
    pixels: np.ndarray


def surface_pixels(mask: np.ndarray) -> np.ndarray:
    """Return a surface's pixels (h, w) bool, those without a return among them, without its rim."""
    near = ndimage.binary_closing(np.pad(mask, 8), np.ones((3, 3)), iterations=3)
    return inner(np.asarray(ndimage.binary_fill_holes(near))[8:-8, 8:-8])


def dropouts_of(captures: Sequence[StillCapture]) -> Dropouts:
    """Return the dropouts of all captures together, on their surfaces."""
    levels, shares = [], []
    for capture in captures:
        for _, mask in capture.planes:
            whole = surface_pixels(mask)
            shares.append(1 - np.isfinite(capture.z_m[:, whole]).mean(axis=0))
            known = capture.mean_amplitude
            levels.append(np.full(shares[-1].shape, np.nan) if known is None else known[whole])
    level, share = (np.concatenate(parts) if parts else np.zeros(0) for parts in (levels, shares))
    known = np.isfinite(level)
    if not known.any():
        return Dropouts(np.array([np.nan]), np.array([share.mean() if len(share) else 0.0]), np.array([len(share)]))
    number = np.floor(np.log(level[known]) / np.log(LIGHT_CELLS)).astype(int)
    groups = [number == one for one in np.unique(number) if (number == one).sum() >= LEAST_CELL_PX]
    groups = groups or [np.ones(len(number), bool)]
    level, share = (np.array([values[known][group].mean() for group in groups]) for values in (level, share))
    return Dropouts(level, share, np.array([int(group.sum()) for group in groups]))


@dataclass(frozen=True)
class SurfaceFigures:
    """Figures of one flat surface, as makers name them. ``temporal``: temporal noise with its interval, mm.
    ``frame_rms_mm``: distance of a single frame's points from their own plane; ``average_rms_mm`` of the average's.
    ``form95_mm``, ``form997_mm``: width that 95 and 99.7 % of a single frame's points need about it. ``fill_rate``:
    share of pixels and frames with a return."""

    capture: str
    number: int
    distance_m: float
    angle_deg: float
    pixels: int
    temporal: bench.Reading
    frame_rms_mm: float
    average_rms_mm: float
    form95_mm: float
    form997_mm: float
    fill_rate: float

    @property
    def where(self) -> str:
        """Name of the surface."""
        return f"{self.capture}, surface {self.number} at {self.distance_m:.2f} m, {self.angle_deg:.0f} deg"


def surfaces_of(capture: StillCapture) -> Iterator[SurfaceFigures]:
    """Yield the figures of each flat surface, largest first."""
    for number, (_, mask) in enumerate(capture.planes, start=1):
        use = inner(mask) & capture.steady
        pixels = np.flatnonzero(use.ravel())
        if len(pixels) < LEAST_CELL_PX:
            continue
        # every k-th pixel tells the same to a per cent
        few = pixels[:: max(1, len(pixels) // 20_000)]
        slopes, z_m = capture.slopes.reshape(-1, 2)[few], capture.z_m[capture.kept].reshape(-1, use.size)[:, few]
        noise = capture.noise_m.reshape(-1, use.size)[:, few]
        temporal = bench.jackknifed(noise[:, None], lambda part: bench.temporal_sigma_m(part) / MM)
        every = [_form(frame, slopes) for frame in z_m[:: max(1, len(z_m) // 5)]]
        average_rms_mm, *_ = _form(capture.mean_m.ravel()[few], slopes)
        fill = float(np.isfinite(capture.z_m[:, surface_pixels(mask)]).mean())
        distance_m = float(np.median(capture.mean_m.ravel()[few]))
        angle_deg = float(np.degrees(np.arccos(np.median(capture.cosine.ravel()[few]))))
        rms_mm, *forms_mm = np.mean(every, axis=0).tolist()
        told = (distance_m, angle_deg, len(pixels), temporal, rms_mm, average_rms_mm, *forms_mm, fill)
        yield SurfaceFigures(capture.name, number, *told)


def _form(z_m: np.ndarray, slopes: np.ndarray) -> tuple[float, float, float]:
    """Return the rms in mm of points about their own plane, and the widths that 95 and 99.7 % of them need."""
    there = np.isfinite(z_m)
    z_m, slopes = z_m[there].astype(float), slopes[there]
    plane = bench.fit_plane(z_m, slopes)
    off_mm = (z_m - plane.z_along_m(slopes)) * (1 - slopes @ np.array([plane.slope_x, plane.slope_y])) / MM
    off_mm /= np.sqrt(1 + plane.slope_x**2 + plane.slope_y**2)
    least, low, high, most = np.quantile(off_mm, (0.0015, 0.025, 0.975, 0.9985))
    return float(np.sqrt((off_mm**2).mean())), float(high - low), float(most - least)


@dataclass(frozen=True)
class EdgeFigures:
    """Pixels across an edge between two surfaces, means over ``lines`` lines of pixels and all frames: ``gap_px`` that
    return nothing, ``flying_px`` with a range on neither; ``step_m``: the median step."""

    lines: int
    gap_px: float
    flying_px: float
    step_m: float


def edge_of(captures: Sequence[StillCapture]) -> EdgeFigures | None:
    """Return the edges between surfaces of all captures together; None without any."""
    found = [row for capture in captures for row in _crossings(capture)]
    if len(found) < LEAST_CELL_PX // 10:
        return None
    gap_px, flying_px, step_m = np.array(found).T
    return EdgeFigures(len(found), float(gap_px.mean()), float(flying_px.mean()), float(np.median(step_m)))


def _crossings(capture: StillCapture) -> Iterator[tuple[float, float, float]]:
    """Yield of each line of pixels from one surface to another: pixels without and with a return between them, and the
    step of depth."""
    labels = np.zeros(capture.stretch.shape, int)
    for number, (_, mask) in enumerate(capture.planes, start=1):
        labels[mask] = number
    valid = np.isfinite(capture.z_m).mean(axis=0)
    for axis in (0, 1):
        image, share, z_m = (each if axis == 0 else each.T for each in (labels, valid, capture.mean_m))
        for row, line in enumerate(image):
            (known,) = np.nonzero(line)
            for at in np.flatnonzero((np.diff(line[known]) != 0) & (np.diff(known) <= WIDEST_PX)):
                last, first = known[at : at + 2]
                step_m = abs(float(z_m[row, first] - z_m[row, last]))
                if step_m > LEAST_STEP_M:
                    between = share[row, last + 1 : first]
                    yield float((1 - between).sum()), float(between.sum()), step_m


# ---------------------------------------------------------------- all of it


@dataclass(frozen=True)
class Characteristics:
    """All that captures of one camera tell. ``correlation`` (2, lags): of the noise along x and y;
    ``pattern_correlation`` likewise of the fixed pattern, None where that is not told."""

    captures: tuple[StillCapture, ...]
    cells: tuple[NoiseCell, ...]
    law: RangeLaw
    correlation: np.ndarray
    dropouts: Dropouts
    surfaces: tuple[SurfaceFigures, ...]
    edge: EdgeFigures | None
    pattern: Separated | None
    pattern_correlation: np.ndarray | None

    @property
    def has_amplitude(self) -> bool:
        """True where every capture records amplitudes."""
        return all(capture.amplitude is not None for capture in self.captures)

    @property
    def frames(self) -> int:
        """Frames of all captures."""
        return sum(len(capture.z_m) for capture in self.captures)

    @property
    def jumped(self) -> int:
        """Frames of all captures that are displaced as a whole."""
        return sum(int((~capture.kept).sum()) for capture in self.captures)

    @property
    def jump_m(self) -> float:
        """Mean size of their displacement, 0 without any."""
        sizes = [np.abs(one.apart_m)[~one.kept] for one in self.captures]
        return float(np.concatenate(sizes).mean()) if self.jumped else 0.0

    @property
    def jitter_m(self) -> float:
        """Standard deviation of the displacement of the other frames."""
        return float(np.sqrt(np.mean([capture.jitter_m**2 for capture in self.captures])))

    @property
    def reach_px(self) -> int:
        """Pixels over which neighbours' noise is alike: the first lag with a correlation below 0.1."""
        low = self.correlation.max(axis=0) < 0.1
        return int(np.argmax(low)) if low.any() else LAGS

    def doubts(self) -> tuple[str, ...]:
        """Return full sentences on what these captures cannot tell, or tell wrongly."""
        said, law, first = [], self.law, self.captures[0]
        if not any(capture.planes for capture in self.captures):
            said.append("no flat surface was found: angle, plane fit, fill rate, fixed pattern and edges are not told")
        if np.isnan(law.range_exponent_se):
            near, far = law.range_m.min(), law.range_m.max()
            said.append(f"all surfaces lie between {near:.2f} and {far:.2f} m: how the noise grows with range is not"
                        f" told, and the power {ASSUMED_RANGE_EXPONENT:g} is assumed")  # fmt: skip
        if not self.has_amplitude:
            said.append("no amplitude is recorded: noise and dropouts of darker surfaces are not told"
                        + (", and shot noise is assumed" if np.isnan(law.light_exponent_se) else ""))  # fmt: skip
        elif np.isnan(law.light_exponent_se):
            said.append("the surface is equally bright everywhere: how noise depends on brightness is not told, and"
                        " shot noise is assumed")  # fmt: skip
        alike = max(map(successive, self.captures))
        if alike > SLOW:
            said.append(f"successive frames share their noise (correlation {alike:.2f}): they were averaged over time"
                        " or repeated, and single frames are noisier than told")  # fmt: skip
        if self.reach_px > WIDE_PX:
            said.append(f"neighbours share their noise over {self.reach_px} pixels: the depth was upsampled, aligned to"
                        " another camera, compressed or smoothed")  # fmt: skip
        variance = float(np.nanmedian(first.variance_m2[first.steady]))
        if np.sqrt(variance) < COARSE * first.step_m:
            said.append(f"the noise ({np.sqrt(variance) / MM:.2g} mm) is hidden by the rounding to"
                        f" {first.step_m / MM:.3g} mm, and its size before rounding is uncertain")  # fmt: skip
        if self.jumped:
            said.append(f"{self.jumped} of {self.frames} frames are displaced as a whole and are left out of the noise")
        said += list(self.pattern.field.warnings) if self.pattern is not None else []
        return tuple(said)


def characteristics(
    captures: Sequence[StillCapture], poses: Sequence[np.ndarray | None] | None = None
) -> Characteristics:
    """Measure captures of one camera in their order of time; ``poses``: 4 x 4, each camera's in the first one's frame,
    which part the surface's own shape from the fixed pattern. Raises UserError for captures of different cameras, and
    where too few pixels hold still."""
    first = captures[0]
    for other in captures[1:]:
        if other.lens != first.lens:
            raise UserError(f"{other.name}: is of another lens than {first.name}", legal="captures of one camera")
    cells = [cell for capture in captures for cell in cells_of(capture)]
    if not any(cell.sigma_m > 0 for cell in cells):
        what = f"{first.name}: nowhere {LEAST_CELL_PX} pixels at like range, angle and brightness that hold still"
        raise UserError(what, legal="a static scene", fix="record a matte wall that fills the view")
    cells = [cell for cell in cells if cell.sigma_m > 0]
    widest = max(captures, key=lambda one: int(one.steady.sum()))
    correlation, pattern, shared = correlations(widest), None, None
    flat = list(_flat(captures, poses or [None] * len(captures)))
    if flat:
        pattern = separated(flat, first.lens)
        shared = _pattern_correlation(pattern, correlation)
    surfaces = [figures for capture in captures for figures in surfaces_of(capture)]
    return Characteristics(
        tuple(captures), tuple(cells), noise_law(cells), correlation, dropouts_of(captures), tuple(surfaces),
        edge_of(captures), pattern, shared,
    )  # fmt: skip


def _flat(captures: Sequence[StillCapture], poses: Sequence[np.ndarray | None]) -> Iterator[FlatCapture]:
    """Yield the largest surface of each capture that has one, less its smooth fit."""
    for capture, pose in zip(captures, poses, strict=True):
        if capture.planes:
            use = inner(capture.planes[0][1]) & capture.steady & np.isfinite(capture.mean_m)
            if use.sum() >= LEAST_CELL_PX:
                yield flattened(capture.cloud(), use, capture.name, pose)


def _pattern_correlation(pattern: Separated, of_noise: np.ndarray) -> np.ndarray:
    """Return the correlation (2, lags) of the fixed pattern along x and y, the map's noise taken off, faded to 0."""
    error_m, noise_m2 = pattern.field.error_m, float(np.nanmean(pattern.field.variance_m2))
    known = np.isfinite(error_m)
    image, found = np.nan_to_num(error_m)[None], np.zeros((2, PATTERN_LAGS + 1))
    for lag in range(PATTERN_LAGS + 1):
        for axis, lags in enumerate(((lag, 0), (0, lag))):
            noise = of_noise[axis, lag] if lag <= LAGS else 0.0
            found[axis, lag] = bench.covariance(image, known, *lags)[0] - noise_m2 * noise
    faded = np.cos(np.linspace(0, np.pi / 2, PATTERN_LAGS + 1))
    return np.clip(np.nan_to_num(found / np.maximum(found[:, :1], 1e-18)), -1, 1) * faded
