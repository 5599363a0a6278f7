"""Measures a depth camera on static captures: noise, correlation, dropouts, displacement of whole
frames, and edges.

Flat surfaces are found in each capture. Without them, every pixel with a steady range counts, and
angle, fixed pattern and edges are not measured. Temporal noise is that of single pixels about
their own mean, without each frame's displacement. Not measured: errors that all frames and pixels
share, and noise slower than the capture."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage, optimize, stats

from detectors.averages.flat_captures import SMOOTH, Separated, flattened, separated
from detectors.pixels.noise import LEAST_FRAMES, rounding_left_m2
from detectors.recordings import Recording
from detectors.surfaces.surface import fit_surface
from harness.stills import statistics
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Lens
from scenes.closed_form import Plane

TOLERANCE_M = 8 * MM
LEAST_PLANE_PX = 2000
"""Distance within which a point is on a plane (a nominal lens bends real walls by 3 mm rms); least
pixels of one."""
EDGE_PX = 3
WIDEST_PX = 24
LEAST_STEP_M = 20 * MM
"""Width of a plane's rim in pixels, which is left out because the camera's filter mixes other
surfaces into it; largest distance in pixels between the two surfaces at an edge; and the least
step of depth there."""
# about 12 windows of 5 x 5 pixels, so that the standard deviation of 20 frames is known to 5 %
LEAST_BIN_PX = 300
MOST_FRAMES = 300  # most frames of a capture that are held in memory: 440 MB for 640 x 576 pixels
RANGE_CELLS = 1.08
LIGHT_CELLS = 1.25
ANGLE_CELL_DEG = 10.0
"""Ratios of the upper to the lower end of cells of range and of brightness, and the width of cells
of angle."""
# least ratio of the largest to the smallest range (or brightness) that determines an exponent
TELLING_RATIO = 1.25
LAGS = 12
PATTERN_LAGS = 40
CORRELATED_FRAMES = 16
"""Largest lags in pixels of the correlations of noise and of pattern, and frames for the
correlation of noise."""
JUMP_M = 3 * MM
JUMP_SIGMAS = 6.0
"""A frame jumps if its displacement exceeds both values, which are ten times the wander of a
static Azure Kinect."""
ASSUMED = np.array([0.0, 2.0, -0.5])
"""Exponents of range (read noise, disparity) and brightness (shot noise) if the captures do not
determine them."""
UNSURE = 0.5  # largest standard error of an exponent that is reported
SLOW = 0.15
WIDE_PX = 6.5
COARSE = 0.35
"""Limits for the correlation of successive frames, the reach of neighbours' correlation, and the
ratio of noise to rounding step, which show that a recording was averaged, smoothed or rounded
before it was stored."""


@dataclass(frozen=True)
class StillCapture:
    """Frames of a static scene. ``z_m`` (n, h, w) float32 is NaN where invalid; ``slopes`` (h, w,
    2); ``amplitude`` (h, w) is a mean, NaN if never above 0, or None; ``step_m`` is that of stored
    z; ``planes`` have their pixels (h, w)."""

    name: str
    lens: Lens
    z_m: np.ndarray
    slopes: np.ndarray
    amplitude: np.ndarray | None
    step_m: float
    planes: tuple[tuple[Plane, np.ndarray], ...]
    used: np.ndarray

    @cached_property
    def steady(self) -> np.ndarray:
        """The pixels of the surfaces, without their rims, that have a range in most frames, (h, w)
        bool."""
        often = np.isfinite(self.z_m).mean(axis=0) > 0.5
        return (
            often & np.any([inner(mask) for _, mask in self.planes], axis=0)
            if self.planes
            else often
        )

    @cached_property
    def offsets_m(self) -> np.ndarray:
        """Displacement (n,) of each whole frame relative to the mean of all frames, in metres of
        z."""
        middle = np.nanmean(self.z_m[:, self.steady], axis=0, dtype=np.float64)
        return np.array([np.nanmean(z[self.steady] - middle) for z in self.z_m])

    @cached_property
    def drift_m(self) -> float:
        """Change of the frames' displacement over the capture, from its robust slope (Theil and
        Sen)."""
        return float(stats.theilslopes(self.offsets_m)[0]) * (len(self.z_m) - 1)

    @cached_property
    def apart_m(self) -> np.ndarray:
        """Displacement (n,) of the frames without the drift."""
        apart = self.offsets_m - self.drift_m * np.linspace(0, 1, len(self.z_m))
        return np.asarray(apart - np.median(apart))

    @cached_property
    def kept(self) -> np.ndarray:
        """The frames that do not jump, (n,) bool."""
        return np.abs(self.apart_m) <= max(
            JUMP_M, JUMP_SIGMAS * 1.4826 * float(np.median(np.abs(self.apart_m)))
        )

    @cached_property
    def _moved_m(self) -> np.ndarray:
        return np.asarray(
            self.z_m[self.kept] - self.offsets_m[self.kept].astype(np.float32)[:, None, None]
        )

    @cached_property
    def mean_m(self) -> np.ndarray:
        """Mean z (h, w) of the frames that do not jump; NaN if there is none."""
        known = np.isfinite(self._moved_m).any(axis=0)
        mean_m = np.full(known.shape, np.nan)
        mean_m[known] = np.nanmean(self._moved_m[:, known], axis=0)
        return mean_m

    @cached_property
    def noise_m(self) -> np.ndarray:
        """Deviations (n, h, w) float32 from the mean, without frames' displacements and without
        frames that jump."""
        return np.asarray(self._moved_m - self.mean_m.astype(np.float32))

    @cached_property
    def variance_m2(self) -> np.ndarray:
        """Temporal variance (h, w) of z; NaN if unknown."""
        count = np.isfinite(self.noise_m).sum(axis=0)
        square = np.nansum(self.noise_m**2, axis=0, dtype=np.float64)
        return np.where(count > 1, square / np.maximum(count - 1, 1), np.nan)

    @cached_property
    def stretch(self) -> np.ndarray:
        """Distance (h, w) along the ray divided by the distance along the axis."""
        return np.asarray(np.sqrt(1 + (self.slopes**2).sum(axis=-1)))

    @cached_property
    def cosine(self) -> np.ndarray:
        """Cosine (h, w) of the angle of incidence on the planes; 1 elsewhere."""
        cosine = np.ones(self.stretch.shape)
        for plane, mask in self.planes:
            along = plane.normal[2] + self.slopes[mask] @ plane.normal[:2]
            cosine[mask] = np.abs(along) / self.stretch[mask]
        return cosine

    @cached_property
    def shapes_m(self) -> tuple[np.ndarray, ...]:
        """Smooth fit of z (h, w) to each flat surface, with its relief and the lens's error, also
        beyond its pixels."""
        shapes_m = []
        for plane, mask in self.planes:
            use = mask & np.isfinite(self.mean_m)
            flat_m = plane.z_along_m(self.slopes)
            fit = fit_surface(
                self.slopes[use, 0], self.slopes[use, 1], 1 / self.mean_m[use], SMOOTH
            )
            off_m = 1 / fit.evaluate(self.slopes[..., 0], self.slopes[..., 1]) - flat_m
            shapes_m.append(flat_m + np.clip(off_m, off_m[use].min(), off_m[use].max()))
        return tuple(shapes_m)

    def whole(self, mask: np.ndarray) -> np.ndarray:
        """Return a surface's pixels without its rim, (h, w) bool, including pixels without a
        return."""
        near = ndimage.binary_closing(np.pad(mask, 8), np.ones((3, 3)), iterations=3)
        return np.asarray(
            inner(np.asarray(ndimage.binary_fill_holes(near))[8:-8, 8:-8]) & self.used
        )

    def cloud(self) -> Cloud:
        """Return the average of the frames that do not jump."""
        count = np.isfinite(self.noise_m).sum(axis=0)
        points = np.concatenate(
            [self.slopes * self.mean_m[..., None], self.mean_m[..., None]], axis=-1
        )
        reason = (count == 0).astype(np.uint8)
        frames = int(self.kept.sum())
        return Cloud(
            points,
            reason,
            count,
            self.variance_m2,
            self.lens.whole,
            self.step_m,
            frames,
            lens=self.lens,
        )


def inner(mask: np.ndarray) -> np.ndarray:
    """Return a mask (h, w) without a rim of `EDGE_PX`, into which the camera's filter mixes other
    surfaces."""
    return np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] > EDGE_PX)


def read_still(recording: Recording, used: np.ndarray | None = None) -> StillCapture:
    """Read at most `MOST_FRAMES` of a recording into memory; only ``used`` (h, w) pixels count.
    Raises UserError if it has too few frames, no pixel grid, no lens, another size than ``used``,
    or no variation."""
    name = recording.name
    lens = recording.lens
    slopes = recording.slopes
    if not recording.organised or lens is None or slopes is None:
        what = f"{name}: without a pixel grid and a lens, the camera's noise cannot be measured"
        raise UserError(
            what, legal="depth images with a lens", fix="state a lens with --intrinsics"
        )
    frames = [
        frame for frame in islice(recording.frames(), MOST_FRAMES) if np.isfinite(frame.z_m).any()
    ]
    if len(frames) < LEAST_FRAMES:
        what = f"{name}: {len(frames)} frame{'s' * (len(frames) > 1)}: too few to measure temporal noise"
        raise UserError(
            what, legal=f"{LEAST_FRAMES} frames or more of a static scene", fix="record 50 or more"
        )
    z_m = np.stack([frame.z_m for frame in frames]).astype(np.float32)
    used = np.ones(z_m.shape[1:], bool) if used is None else used
    if used.shape != z_m.shape[1:]:
        sizes = (f"{image.shape[-1]} x {image.shape[-2]}" for image in (used, z_m))
        raise UserError("--mask: {} pixels, but the frames have {}".format(*sizes))
    z_m[:, ~used] = np.nan
    if all(np.array_equal(z_m[0], z_m[k], equal_nan=True) for k in (len(z_m) // 2, -1)):
        what = f"{name}: all frames are equal, so they show no noise"
        raise UserError(
            what, legal="single frames of the camera", fix="record single frames, not their average"
        )
    often = np.isfinite(z_m).mean(axis=0) >= 0.5
    median_m = np.full(often.shape, np.nan)
    median_m[often] = np.nanmedian(z_m[:, often], axis=0)
    planes = statistics.find_planes(
        median_m, slopes, TOLERANCE_M, min(LEAST_PLANE_PX, often.size // 20)
    )
    amplitude = mean_amplitude([frame.amplitude for frame in frames])
    return StillCapture(name, lens, z_m, slopes, amplitude, recording.z_step_m, tuple(planes), used)


def mean_amplitude(stack: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Return the mean (h, w) over frames, NaN if never above 0; None if a frame has no amplitude."""
    known = [np.nan_to_num(each) for each in stack if each is not None]
    mean = np.mean(known, axis=0) if len(known) == len(stack) else None
    return None if mean is None else np.where(mean > 0, mean, np.nan)


# ---------------------------------------------------------------- single figures


class NoiseCell(NamedTuple):
    """Pixels under similar conditions: means of range, angle, ``amplitude`` (NaN if not recorded)
    and ``light`` (amplitude times range squared, or the cosine of the angle), and temporal noise
    along the ray before rounding."""

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
    use &= True if capture.amplitude is None else np.isfinite(capture.amplitude)
    range_m = (capture.mean_m * capture.stretch)[use]
    cosine = capture.cosine[use]
    angle_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    amplitude = (
        np.full(range_m.shape, np.nan) if capture.amplitude is None else capture.amplitude[use]
    )
    light = cosine if capture.amplitude is None else amplitude * range_m**2
    where = (
        np.log(range_m) / np.log(RANGE_CELLS),
        angle_deg / ANGLE_CELL_DEG,
        np.log(light) / np.log(LIGHT_CELLS),
    )
    places = np.floor(np.stack(where[: 2 if capture.amplitude is None else 3], axis=-1)).astype(int)
    _, cell, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    columns = (range_m, angle_deg, amplitude, light, capture.variance_m2[use], capture.stretch[use])
    means = [np.bincount(cell.ravel(), column, len(counts)) / counts for column in columns]
    for number in np.flatnonzero(counts >= LEAST_BIN_PX):
        *at, variance, stretch = (float(mean[number]) for mean in means)
        sigma_m = np.sqrt(before_rounding_m2(variance, capture.step_m)) * stretch
        if sigma_m > 0:
            yield NoiseCell._make((capture.name, int(counts[number]), *at, float(sigma_m)))


def before_rounding_m2(variance_m2: float, step_m: float) -> float:
    """Return the variance s^2 of z before rounding to a step q, given the variance after rounding.
    Averaged over all phases of the rounding, the latter is s^2 + q^2 / 12 minus the part that
    rounding fixes (`rounding_left_m2`)."""

    def after(s2: float) -> float:
        return s2 + step_m**2 / 12 - rounding_left_m2(step_m, s2) - variance_m2

    if step_m <= 0 or variance_m2 > 100 * step_m**2 or variance_m2 <= 1e-6 * step_m**2:
        return variance_m2
    return float(optimize.brentq(after, 1e-6 * step_m**2, variance_m2 + step_m**2))


class RangeLaw(NamedTuple):
    """Noise of the recorded surface at normal incidence before rounding: ``sigma_m`` at
    ``range_m`` (k,); ``exponents`` of range and brightness with standard ``errors``, NaN for an
    assumed exponent; the brightness that counts as 1."""

    range_m: np.ndarray
    sigma_m: np.ndarray
    exponents: np.ndarray
    errors: np.ndarray
    light_at_1m: float


def noise_law(cells: Sequence[NoiseCell]) -> RangeLaw:
    """Fit the law to the cells of all captures by weighted least squares on the logarithms."""
    _, pixels, r, angle_deg, _, light, sigma_m = zip(*cells, strict=True)
    weight = np.array(pixels, float)
    y = np.log(sigma_m)
    log_r = np.log(r)
    light_at_1m = float(
        np.average(np.log(light) - np.log(np.cos(np.radians(angle_deg))), weights=weight)
    )
    columns = np.stack([np.ones(len(y)), log_r, np.log(light) - light_at_1m], axis=-1)
    varied = np.array([True, *(np.ptp(columns[:, 1:], axis=0) > np.log(TELLING_RATIO))])
    law = ASSUMED.copy()
    root = np.sqrt(weight)
    signs = np.sign(ASSUMED)
    while True:
        errors = np.full(3, np.nan)
        design = columns[:, varied] * root[:, None]
        rest = (y - columns[:, ~varied] @ law[~varied]) * root
        law[varied] = np.linalg.lstsq(design, rest, rcond=None)[0]
        spread = float(((rest - design @ law[varied]) ** 2).sum() / max(len(y) - varied.sum(), 1))
        errors[varied] = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)) * spread)
        doubtful = (errors > UNSURE) | (varied & (law * signs < 0))
        doubtful[0] = False
        if not doubtful.any():
            break
        # on a single slanted surface, range and brightness vary together: the less certain
        # exponent is fixed
        worst = int(np.argmax(np.where(doubtful, errors, -1.0)))
        varied[worst], law[worst] = False, ASSUMED[worst] if errors[worst] > UNSURE else 0.0
    facing = y - law[2] * columns[:, 2]
    number = np.floor(log_r / np.log(RANGE_CELLS) + 1e-9)
    groups = [number == cell for cell in np.unique(number)]
    at, level = (
        np.exp([np.average(v[g], weights=weight[g]) for g in groups]) for v in (log_r, facing)
    )
    return RangeLaw(at, level, law[1:] * signs[1:], errors[1:], float(np.exp(light_at_1m)))


def correlations(capture: StillCapture) -> np.ndarray:
    """Return the correlation (2, `LAGS` + 1) of the noise before rounding by lag in pixels, along
    x and y."""
    noise = capture.noise_m[:CORRELATED_FRAMES]
    use = capture.steady & np.isfinite(noise).all(axis=0)
    variance = float((noise[:, use] ** 2).mean()) if use.any() else 1.0
    raised = min(variance / max(before_rounding_m2(variance, capture.step_m), 1e-18), 4.0)
    pairs = [
        [statistics.correlation(noise, use, *lags) for lags in ((k, 0), (0, k))]
        for k in range(1, LAGS + 1)
    ]
    return np.concatenate(
        [np.ones((2, 1)), np.clip(np.nan_to_num(np.array(pairs).T) * raised, -0.99, 0.99)], axis=1
    )


class Dropouts(NamedTuple):
    """Share of frames without a return, by ascending ``amplitude`` (NaN if not recorded), of
    ``pixels``; (k,) each."""

    amplitude: np.ndarray
    share: np.ndarray
    pixels: np.ndarray


def dropouts_of(captures: Sequence[StillCapture]) -> Dropouts:
    """Return the dropouts on the surfaces of all captures together."""
    parts = [np.zeros((2, 0))]
    for capture in captures:
        share = 1 - np.isfinite(capture.z_m).mean(axis=0)
        level = np.full(share.shape, np.nan) if capture.amplitude is None else capture.amplitude
        parts += [
            np.stack([level[whole], share[whole]])
            for whole in (capture.whole(m) for _, m in capture.planes)
        ]
    level, share = np.concatenate(parts, axis=1)
    cells = np.nan_to_num(np.floor(np.log(level) / np.log(LIGHT_CELLS)), nan=-1e9)
    groups = [
        cells == cell
        for cell in np.unique(cells[np.isfinite(level)])
        if (cells == cell).sum() >= LEAST_BIN_PX
    ]
    if not groups:
        return Dropouts(
            np.array([np.nan]),
            np.array([share.mean() if len(share) else 0.0]),
            np.array([len(share)]),
        )
    means = [np.array([values[group].mean() for group in groups]) for values in (level, share)]
    return Dropouts._make((*means, np.array([group.sum() for group in groups])))


@dataclass(frozen=True)
class SurfaceFigures:
    """Figures of a flat surface in mm, with manufacturers' names. ``temporal`` is the noise with
    its interval. ``frame_rms_mm`` is the rms distance of a frame's points from their own plane,
    ``average_rms_mm`` the average's. Layers of ``form95_mm`` and ``form997_mm`` hold 95 and 99.7 %
    of points. ``fill_rate`` is the share of returns."""

    capture: str
    number: int
    distance_m: float
    angle_deg: float
    temporal: statistics.Reading
    frame_rms_mm: float
    average_rms_mm: float
    form95_mm: float
    form997_mm: float
    fill_rate: float

    @property
    def where(self) -> str:
        """The name of the surface."""
        return f"{self.capture}, surface {self.number} at {self.distance_m:.2f} m, {self.angle_deg:.0f} deg"


def surfaces_of(capture: StillCapture) -> Iterator[SurfaceFigures]:
    """Yield the figures of each flat surface, largest first."""
    for number, (_, mask) in enumerate(capture.planes, start=1):
        pixels = np.flatnonzero((inner(mask) & capture.steady).ravel())
        if len(pixels) < LEAST_BIN_PX:
            continue
        few = pixels[:: max(1, len(pixels) // 20_000)]  # a sample gives the same to within 1 %
        z_m = capture.z_m[capture.kept].reshape(-1, mask.size)[:, few]
        noise = capture.noise_m.reshape(-1, mask.size)[:, few]
        mean_m = capture.mean_m.ravel()[few]
        slopes = capture.slopes.reshape(-1, 2)[few]
        temporal = statistics.jackknifed(
            noise[:, None], lambda part: statistics.temporal_sigma_m(part) / MM
        )
        rms_mm, *forms_mm = np.mean(
            [_form(frame, slopes) for frame in z_m[:: max(1, len(z_m) // 5)]], axis=0
        ).tolist()
        at = (
            float(np.median(mean_m)),
            float(np.degrees(np.arccos(np.median(capture.cosine.ravel()[few])))),
        )
        fill = float(np.isfinite(capture.z_m[:, capture.whole(mask)]).mean())
        values: list[Any] = [*at, temporal, rms_mm, _form(mean_m, slopes)[0], *forms_mm, fill]
        yield SurfaceFigures(capture.name, number, *values)


def _form(z_m: np.ndarray, slopes: np.ndarray) -> tuple[float, float, float]:
    """Return the rms in mm of points about their own plane, and the widths of the layers with 95
    and 99.7 % of them."""
    z_m, slopes = z_m[np.isfinite(z_m)].astype(float), slopes[np.isfinite(z_m)]
    plane = statistics.fit_plane(z_m, slopes)
    points = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) * z_m[:, None]
    off_mm = (points @ plane.normal - plane.distance_m * plane.normal[2]) / MM
    least, low, high, most = np.quantile(off_mm, (0.0015, 0.025, 0.975, 0.9985))
    return float(np.sqrt((off_mm**2).mean())), float(high - low), float(most - least)


class EdgeFigures(NamedTuple):
    """Pixels across an edge between two surfaces, as means over ``lines`` of pixels and all
    frames: ``gap_px`` without a return, ``flying_px`` with a range on neither surface; and the
    median step."""

    lines: int
    gap_px: float
    flying_px: float
    step_m: float


def edge_of(captures: Sequence[StillCapture]) -> EdgeFigures | None:
    """Return the figures of all edges between surfaces in all captures; None if there are no
    edges."""
    lines = defaultdict[tuple[str, frozenset[int]], tuple[list[Any], list[Any]]](lambda: ([], []))
    for capture in captures:
        labels = np.zeros(capture.stretch.shape, int)
        share = np.isfinite(capture.z_m).mean(axis=0)
        for number, (plane, mask) in enumerate(capture.planes, start=1):
            # in a simulated capture, pixels outside the mask may also be lost or off the surface
            off_m = np.abs(capture.mean_m - plane.z_along_m(capture.slopes))
            labels[mask & (share >= 0.5) & (off_m <= statistics.GROWN * TOLERANCE_M)] = number
        images = labels, share, capture.mean_m
        for axis, (image, share, z_m) in enumerate((images, tuple(image.T for image in images))):
            for row, line in enumerate(image):
                (known,) = np.nonzero(line)
                for at in np.flatnonzero(
                    (np.diff(line[known]) != 0) & (np.diff(known) <= WIDEST_PX)
                ):
                    last, first = known[at : at + 2]
                    between = share[row, last + 1 : first]
                    counts = (
                        (1 - between).sum(),
                        between.sum(),
                        abs(z_m[row, first] - z_m[row, last]),
                    )
                    if counts[2] > LEAST_STEP_M:
                        lines[capture.name, frozenset(line[[last, first]])][axis].append(counts)
    # use the axis that crosses more of the edge; the other axis crosses it at a small angle
    rows = np.array([row for line in lines.values() for row in max(line, key=len)])
    if len(rows) < LEAST_BIN_PX // 10:
        return None
    return EdgeFigures(
        len(rows), float(rows[:, 0].mean()), float(rows[:, 1].mean()), float(np.median(rows[:, 2]))
    )


# ---------------------------------------------------------------- all figures


@dataclass(frozen=True)
class Characteristics:
    """The results of all captures of a camera. ``correlation`` (2, lags) is that of the noise
    along x and y; ``pattern_correlation`` is that of the fixed pattern, None if it is unknown."""

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
        """True if every capture records amplitudes."""
        return all(capture.amplitude is not None for capture in self.captures)

    @property
    def frames(self) -> int:
        """The number of frames in all captures."""
        return sum(len(capture.z_m) for capture in self.captures)

    @property
    def jumps_m(self) -> np.ndarray:
        """Displacement (k,) of the frames that jump."""
        return np.concatenate([np.abs(capture.apart_m[~capture.kept]) for capture in self.captures])

    @property
    def jitter_m(self) -> float:
        """Standard deviation of the displacement of the other frames."""
        return float(
            np.sqrt(
                np.mean([capture.apart_m[capture.kept].var(ddof=1) for capture in self.captures])
            )
        )

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Sentences on what these captures cannot show, or show incorrectly."""
        notes = []
        law = self.law
        first = self.captures[0]
        if not self.surfaces:
            notes.append(
                "no flat surface was found: angle, plane fit, fill rate, fixed pattern and edges are unknown"
            )
        if np.isnan(law.errors[0]):
            near = law.range_m.min()
            far = law.range_m.max()
            notes.append(f"surfaces between {near:.2f} and {far:.2f} m do not show how the noise grows with range: the"
                        f" power {law.exponents[0]:g} is assumed")  # fmt: skip
        if not self.has_amplitude:
            notes.append(
                "no amplitude is recorded: noise and dropouts of darker surfaces are unknown"
            )
        if np.isnan(law.errors[1]):
            notes.append("brightness hardly varies, or only together with range: its effect on noise is unknown,"
                        f" and the power -{law.exponents[1]:g} is assumed")  # fmt: skip
        noise = first.noise_m[:, first.steady]
        sigma_m = float(np.sqrt(np.nanmedian(first.variance_m2[first.steady])))
        alike = float(np.nanmean(noise[1:] * noise[:-1]) / np.nanmean(noise**2)) + 1 / len(noise)
        if alike > SLOW:
            notes.append(f"the noise of successive frames is correlated ({alike:.2f}): they were averaged over time"
                         " or repeated, and single frames are noisier than stated")  # fmt: skip
        reach = int(np.argmax([*(self.correlation.max(axis=0) < 0.1), True]))
        if reach > WIDE_PX:
            notes.append(f"the noise of pixels is correlated over {reach} pixels: the depth was upsampled, aligned to"
                         " another camera, compressed or smoothed")  # fmt: skip
        if sigma_m < COARSE * first.step_m:
            notes.append(f"the noise ({sigma_m / MM:.2g} mm) is hidden by the rounding to {first.step_m / MM:.3g} mm,"
                        " and its size before rounding is uncertain")  # fmt: skip
        if drifted := [capture.name for capture in self.captures if abs(capture.drift_m) > JUMP_M]:
            notes.append(f"the distance drifts by more than {JUMP_M / MM:g} mm during {', '.join(drifted)}: the camera"
                        " warmed up or moved")  # fmt: skip
        if jumped := len(self.jumps_m):
            notes.append(
                f"{jumped} of {self.frames} frames are displaced as a whole and are excluded from the noise"
            )
        return (*notes, *(self.pattern.field.warnings if self.pattern is not None else ()))


def characteristics(
    captures: Sequence[StillCapture], poses: Sequence[np.ndarray | None] | None = None
) -> Characteristics:
    """Measure captures of a camera in order of time. ``poses`` (4 x 4, each camera in the first
    camera's frame) separate shape from fixed pattern. Raises UserError for different cameras, and
    if too few pixels are steady."""
    first = captures[0]
    if differing := next((capture for capture in captures if capture.lens != first.lens), None):
        raise UserError(
            f"{differing.name}: has another lens than {first.name}",
            legal="captures of the same camera",
        )
    cells = tuple(cell for capture in captures for cell in cells_of(capture))
    if not cells:
        what = f"{first.name}: has no {LEAST_BIN_PX} steady pixels with similar range, angle and brightness"
        raise UserError(what, legal="a static scene", fix="record a matte wall that fills the view")
    correlation = correlations(max(captures, key=lambda capture: int(capture.steady.sum())))
    flat = []
    for capture, pose in zip(captures, poses or [None] * len(captures), strict=True):
        use = inner(capture.planes[0][1]) & capture.steady if capture.planes else np.zeros(1, bool)
        if use.sum() >= LEAST_BIN_PX:
            flat.append(flattened(capture.cloud(), use, capture.name, pose))
    pattern = separated(flat, first.lens) if flat else None
    surfaces = tuple(figures for capture in captures for figures in surfaces_of(capture))
    shared = (
        _pattern_correlation(pattern, correlation)
        if pattern is not None and pattern.field.rms_m > 0
        else None
    )
    parts = dropouts_of(captures), surfaces, edge_of(captures), pattern, shared
    return Characteristics(tuple(captures), cells, noise_law(cells), correlation, *parts)


def _pattern_correlation(pattern: Separated, of_noise: np.ndarray) -> np.ndarray:
    """Return the correlation (2, lags) of the fixed pattern along x and y, without the map's
    noise, faded to 0."""
    error_m = pattern.field.error_m
    known = np.isfinite(pattern.field.error_m)
    lags = range(PATTERN_LAGS + 1)
    pairs = [
        [statistics.covariance(error_m[None], known, *lag)[0] for lag in ((k, 0), (0, k))]
        for k in lags
    ]
    of_map = float(np.nanmean(pattern.field.variance_m2)) * np.pad(
        of_noise, ((0, 0), (0, PATTERN_LAGS - LAGS))
    )
    found = np.array(pairs).T - of_map
    faded = np.cos(np.linspace(0, np.pi / 2, len(lags)))
    return np.clip(np.nan_to_num(found / np.maximum(found[:, :1], 1e-18)), -1, 1) * faded
