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

# distance within which a point is on a plane (a nominal lens bends real walls by 3 mm rms)
TOLERANCE_M = 8 * MM
LEAST_PLANE_PX = 2000
EDGE_PX = 3  # rim of a plane, into which the camera's filter mixes other surfaces
WIDEST_PX = 24  # largest distance between the two surfaces at an edge
LEAST_STEP_M = 20 * MM  # least step of depth at an edge
# about 12 windows of 5 x 5 pixels, so that the standard deviation of 20 frames is known to 5 %
LEAST_BIN_PX = 300
MOST_FRAMES = 300  # most frames of a capture that are held in memory: 440 MB for 640 x 576 pixels
RANGE_CELLS = 1.08  # ratio of the upper to the lower end of a cell of range
LIGHT_CELLS = 1.25  # ratio of the upper to the lower end of a cell of brightness
ANGLE_CELL_DEG = 10.0
# least ratio of the largest to the smallest range (or brightness) that determines an exponent
TELLING_RATIO = 1.25
LAGS = 12  # largest lag in pixels of the correlation of noise
PATTERN_LAGS = 40  # largest lag in pixels of the correlation of the fixed pattern
CORRELATED_FRAMES = 16  # frames for the correlation of noise
# a frame jumps if its displacement exceeds both values, which are ten times the wander of a
# static Azure Kinect
JUMP_M = 3 * MM
JUMP_SIGMAS = 6.0
# logarithm at 1 m, exponent of range (read noise, disparity) and of brightness (shot noise) where
# the captures do not determine them
ASSUMED = np.array([0.0, 2.0, -0.5])
UNSURE = 0.5  # largest standard error of an exponent that is reported
SLOW = 0.15  # correlation of successive frames above which a recording was averaged over time
WIDE_PX = 6.5  # reach of neighbours' correlation above which a recording was smoothed
COARSE = 0.35  # ratio of noise to rounding step below which rounding hides the noise


@dataclass(frozen=True)
class StillCapture:
    """Frames of a static scene, and the flat surfaces in it."""

    name: str
    lens: Lens
    z_m: np.ndarray
    """Frames (n, h, w) float32, NaN where invalid."""
    slopes: np.ndarray
    """Slopes (h, w, 2) of the pixels' rays."""
    amplitude: np.ndarray | None
    """Mean amplitude (h, w), NaN if never above 0; None if not recorded."""
    step_m: float
    """Rounding step of the stored z; 0 if it is not rounded."""
    planes: tuple[tuple[Plane, np.ndarray], ...]
    """Each flat surface with its pixels (h, w) bool, largest first."""
    used: np.ndarray
    """The pixels (h, w) bool that count."""

    @cached_property
    def steady(self) -> np.ndarray:
        """The pixels of the surfaces, without their rims, that have a range in most frames, (h, w)
        bool."""
        often = np.isfinite(self.z_m).mean(axis=0) > 0.5
        if not self.planes:
            return often
        return often & np.any([inner(mask) for _, mask in self.planes], axis=0)

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
        without_drift_m = self.offsets_m - self.drift_m * np.linspace(0, 1, len(self.z_m))
        return np.asarray(without_drift_m - np.median(without_drift_m))

    @cached_property
    def kept(self) -> np.ndarray:
        """The frames that do not jump, (n,) bool."""
        size_m = np.abs(self.apart_m)
        return size_m <= max(JUMP_M, JUMP_SIGMAS * 1.4826 * float(np.median(size_m)))

    @cached_property
    def _moved_m(self) -> np.ndarray:
        """Frames (n, h, w) float32 that do not jump, without their displacement."""
        offsets_m = self.offsets_m[self.kept].astype(np.float32)
        return np.asarray(self.z_m[self.kept] - offsets_m[:, None, None])

    @cached_property
    def mean_m(self) -> np.ndarray:
        """Mean z (h, w) of the frames that do not jump; NaN if there is none."""
        has_return = np.isfinite(self._moved_m).any(axis=0)
        mean_m = np.full(has_return.shape, np.nan)
        mean_m[has_return] = np.nanmean(self._moved_m[:, has_return], axis=0)
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
        closed_mask = ndimage.binary_closing(np.pad(mask, 8), np.ones((3, 3)), iterations=3)
        filled = np.asarray(ndimage.binary_fill_holes(closed_mask))[8:-8, 8:-8]
        return np.asarray(inner(filled) & self.used)

    def cloud(self) -> Cloud:
        """Return the average of the frames that do not jump."""
        count = np.isfinite(self.noise_m).sum(axis=0)
        points = np.concatenate(
            [self.slopes * self.mean_m[..., None], self.mean_m[..., None]], axis=-1
        )
        return Cloud(
            points_m=points,
            reason=(count == 0).astype(np.uint8),
            count=count,
            variance_m2=self.variance_m2,
            region=self.lens.whole,
            z_step_m=self.step_m,
            n_frames=int(self.kept.sum()),
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
        problem = f"{name}: without a pixel grid and a lens, the camera's noise cannot be measured"
        raise UserError(
            problem, legal="depth images with a lens", fix="state a lens with --intrinsics"
        )
    frames = [
        frame for frame in islice(recording.frames(), MOST_FRAMES) if np.isfinite(frame.z_m).any()
    ]
    if len(frames) < LEAST_FRAMES:
        problem = (
            f"{name}: {len(frames)} frame{'s' * (len(frames) > 1)}: too few to measure temporal "
            "noise"
        )
        raise UserError(
            problem,
            legal=f"{LEAST_FRAMES} frames or more of a static scene",
            fix="record 50 or more",
        )
    z_m = np.stack([frame.z_m for frame in frames]).astype(np.float32)
    used = np.ones(z_m.shape[1:], bool) if used is None else used
    if used.shape != z_m.shape[1:]:
        mask_size = f"{used.shape[-1]} x {used.shape[-2]}"
        frame_size = f"{z_m.shape[-1]} x {z_m.shape[-2]}"
        raise UserError(f"--mask: {mask_size} pixels, but the frames have {frame_size}")
    z_m[:, ~used] = np.nan
    if all(np.array_equal(z_m[0], z_m[k], equal_nan=True) for k in (len(z_m) // 2, -1)):
        problem = f"{name}: all frames are equal, so they show no noise"
        raise UserError(
            problem,
            legal="single frames of the camera",
            fix="record single frames, not their average",
        )
    often = np.isfinite(z_m).mean(axis=0) >= 0.5
    median_m = np.full(often.shape, np.nan)
    median_m[often] = np.nanmedian(z_m[:, often], axis=0)
    planes = statistics.find_planes(
        median_m, slopes, TOLERANCE_M, min(LEAST_PLANE_PX, often.size // 20)
    )
    amplitude = mean_amplitude([frame.amplitude for frame in frames])
    return StillCapture(
        name=name,
        lens=lens,
        z_m=z_m,
        slopes=slopes,
        amplitude=amplitude,
        step_m=recording.z_step_m,
        planes=tuple(planes),
        used=used,
    )


def mean_amplitude(stack: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Return the mean (h, w) over frames, NaN if never above 0; None if a frame has no
    amplitude."""
    amplitudes = [np.nan_to_num(amplitude) for amplitude in stack if amplitude is not None]
    if len(amplitudes) < len(stack):
        return None
    mean = np.mean(amplitudes, axis=0)
    return np.where(mean > 0, mean, np.nan)


# ---------------------------------------------------------------- single figures


class NoiseCell(NamedTuple):
    """Pixels of a capture under similar conditions; range, angle and light are their means."""

    capture: str
    pixels: int
    range_m: float
    angle_deg: float
    """Angle of incidence."""
    amplitude: float
    """Recorded amplitude; NaN if not recorded."""
    light: float
    """Amplitude times range squared; without amplitudes, the cosine of the angle."""
    sigma_m: float
    """Temporal noise along the ray before rounding."""


def cells_of(capture: StillCapture) -> Iterator[NoiseCell]:
    """Yield the noise of a capture in cells of range, angle and brightness."""
    use = capture.steady & np.isfinite(capture.variance_m2)
    if capture.amplitude is not None:
        use &= np.isfinite(capture.amplitude)
    range_m = (capture.mean_m * capture.stretch)[use]
    cosine = capture.cosine[use]
    angle_deg = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
    conditions = [np.log(range_m) / np.log(RANGE_CELLS), angle_deg / ANGLE_CELL_DEG]
    if capture.amplitude is None:
        amplitude = np.full(range_m.shape, np.nan)
        light = cosine
    else:
        amplitude = capture.amplitude[use]
        light = amplitude * range_m**2
        conditions.append(np.log(light) / np.log(LIGHT_CELLS))
    cell_indices = np.floor(np.stack(conditions, axis=-1)).astype(int)
    _, cell, counts = np.unique(cell_indices, axis=0, return_inverse=True, return_counts=True)

    def cell_means(values: np.ndarray) -> np.ndarray:
        return np.bincount(cell.ravel(), values, len(counts)) / counts

    mean_range_m = cell_means(range_m)
    mean_angle_deg = cell_means(angle_deg)
    mean_amplitude = cell_means(amplitude)
    mean_light = cell_means(light)
    mean_variance_m2 = cell_means(capture.variance_m2[use])
    mean_stretch = cell_means(capture.stretch[use])
    for number in np.flatnonzero(counts >= LEAST_BIN_PX):
        variance_m2 = before_rounding_m2(float(mean_variance_m2[number]), capture.step_m)
        sigma_m = float(np.sqrt(variance_m2) * mean_stretch[number])
        if sigma_m > 0:
            yield NoiseCell(
                capture=capture.name,
                pixels=int(counts[number]),
                range_m=float(mean_range_m[number]),
                angle_deg=float(mean_angle_deg[number]),
                amplitude=float(mean_amplitude[number]),
                light=float(mean_light[number]),
                sigma_m=sigma_m,
            )


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
    """Noise of the recorded surface at normal incidence before rounding."""

    range_m: np.ndarray
    """Mean ranges (k,) of the cells, ascending."""
    sigma_m: np.ndarray
    """Noise (k,) at these ranges."""
    exponents: np.ndarray
    """Powers (2,) of range and of brightness, both positive."""
    errors: np.ndarray
    """Standard errors (2,) of the exponents; NaN for an assumed exponent."""
    light_at_1m: float
    """The brightness that counts as 1."""


def noise_law(cells: Sequence[NoiseCell]) -> RangeLaw:
    """Fit the law to the cells of all captures by weighted least squares on the logarithms.

    ln sigma = a + p ln range + q ln light, with the numbers of pixels as weights.
    """
    weight = np.array([cell.pixels for cell in cells], float)
    log_sigma = np.log([cell.sigma_m for cell in cells])
    log_range = np.log([cell.range_m for cell in cells])
    log_light = np.log([cell.light for cell in cells])
    angle = np.radians([cell.angle_deg for cell in cells])
    light_at_1m = float(np.average(log_light - np.log(np.cos(angle)), weights=weight))
    columns = np.stack([np.ones(len(cells)), log_range, log_light - light_at_1m], axis=-1)
    varied = np.array([True, *(np.ptp(columns[:, 1:], axis=0) > np.log(TELLING_RATIO))])
    law = ASSUMED.copy()
    root = np.sqrt(weight)
    signs = np.sign(ASSUMED)
    while True:
        errors = np.full(3, np.nan)
        design = columns[:, varied] * root[:, None]
        target = (log_sigma - columns[:, ~varied] @ law[~varied]) * root
        law[varied] = np.linalg.lstsq(design, target, rcond=None)[0]
        degrees = max(len(cells) - varied.sum(), 1)
        spread = float(((target - design @ law[varied]) ** 2).sum() / degrees)
        errors[varied] = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)) * spread)
        doubtful = (errors > UNSURE) | (varied & (law * signs < 0))
        doubtful[0] = False
        if not doubtful.any():
            break
        # on a single slanted surface, range and brightness vary together: the less certain
        # exponent is fixed
        worst = int(np.argmax(np.where(doubtful, errors, -1.0)))
        varied[worst] = False
        law[worst] = ASSUMED[worst] if errors[worst] > UNSURE else 0.0
    log_facing_sigma = log_sigma - law[2] * columns[:, 2]
    number = np.floor(log_range / np.log(RANGE_CELLS) + 1e-9)
    groups = [number == cell for cell in np.unique(number)]

    def group_means(values: np.ndarray) -> np.ndarray:
        return np.exp([np.average(values[group], weights=weight[group]) for group in groups])

    return RangeLaw(
        range_m=group_means(log_range),
        sigma_m=group_means(log_facing_sigma),
        exponents=law[1:] * signs[1:],
        errors=errors[1:],
        light_at_1m=float(np.exp(light_at_1m)),
    )


def correlations(capture: StillCapture) -> np.ndarray:
    """Return the correlation (2, `LAGS` + 1) of the noise before rounding by lag in pixels, along
    x and y."""
    noise = capture.noise_m[:CORRELATED_FRAMES]
    use = capture.steady & np.isfinite(noise).all(axis=0)
    variance = float((noise[:, use] ** 2).mean()) if use.any() else 1.0
    raised = min(variance / max(before_rounding_m2(variance, capture.step_m), 1e-18), 4.0)
    pairs = [
        (statistics.correlation(noise, use, lag, 0), statistics.correlation(noise, use, 0, lag))
        for lag in range(1, LAGS + 1)
    ]
    at_lags = np.clip(np.nan_to_num(np.array(pairs).T) * raised, -0.99, 0.99)
    return np.concatenate([np.ones((2, 1)), at_lags], axis=1)


class Dropouts(NamedTuple):
    """Frames without a return, in cells (k,) of brightness."""

    amplitude: np.ndarray
    """Mean amplitudes (k,), ascending; NaN if not recorded."""
    share: np.ndarray
    """Shares (k,) of frames without a return."""
    pixels: np.ndarray
    """Numbers (k,) of pixels."""


def dropouts_of(captures: Sequence[StillCapture]) -> Dropouts:
    """Return the dropouts on the surfaces of all captures together."""
    parts = [np.zeros((2, 0))]
    for capture in captures:
        share = 1 - np.isfinite(capture.z_m).mean(axis=0)
        level = np.full(share.shape, np.nan) if capture.amplitude is None else capture.amplitude
        for _, mask in capture.planes:
            whole_mask = capture.whole(mask)
            parts.append(np.stack([level[whole_mask], share[whole_mask]]))
    level, share = np.concatenate(parts, axis=1)
    cells = np.nan_to_num(np.floor(np.log(level) / np.log(LIGHT_CELLS)), nan=-1e9)
    groups = []
    for cell in np.unique(cells[np.isfinite(level)]):
        group = cells == cell
        if group.sum() >= LEAST_BIN_PX:
            groups.append(group)
    if not groups:
        mean_share = share.mean() if len(share) else 0.0
        return Dropouts(np.array([np.nan]), np.array([mean_share]), np.array([len(share)]))
    return Dropouts(
        amplitude=np.array([level[group].mean() for group in groups]),
        share=np.array([share[group].mean() for group in groups]),
        pixels=np.array([group.sum() for group in groups]),
    )


@dataclass(frozen=True)
class SurfaceFigures:
    """Figures of a flat surface, with manufacturers' names."""

    capture: str
    number: int
    """Number of the surface in its capture, from 1 for the largest."""
    distance_m: float
    """Median z."""
    angle_deg: float
    """Median angle of incidence."""
    temporal: statistics.Reading
    """Temporal noise of single pixels in mm, with its interval."""
    frame_rms_mm: float
    """Rms distance of a frame's points from their own plane."""
    average_rms_mm: float
    """The same for the average of all frames."""
    form95_mm: float
    """Width of the layer that holds 95 % of a frame's points."""
    form997_mm: float
    """Width of the layer that holds 99.7 % of a frame's points."""
    fill_rate: float
    """Share of pixels and frames with a return."""

    @property
    def where(self) -> str:
        """The name of the surface."""
        surface = f"{self.capture}, surface {self.number}"
        return f"{surface} at {self.distance_m:.2f} m, {self.angle_deg:.0f} deg"


def surfaces_of(capture: StillCapture) -> Iterator[SurfaceFigures]:
    """Yield the figures of each flat surface, largest first."""
    for number, (_, mask) in enumerate(capture.planes, start=1):
        pixels = np.flatnonzero((inner(mask) & capture.steady).ravel())
        if len(pixels) < LEAST_BIN_PX:
            continue
        sample = pixels[:: max(1, len(pixels) // 20_000)]  # a sample gives the same to within 1 %
        z_m = capture.z_m[capture.kept].reshape(-1, mask.size)[:, sample]
        noise = capture.noise_m.reshape(-1, mask.size)[:, sample]
        mean_m = capture.mean_m.ravel()[sample]
        slopes = capture.slopes.reshape(-1, 2)[sample]
        cosine = capture.cosine.ravel()[sample]
        temporal = statistics.jackknifed(
            noise[:, None], lambda part: statistics.temporal_sigma_m(part) / MM
        )
        forms = [_form(frame, slopes) for frame in z_m[:: max(1, len(z_m) // 5)]]
        rms_mm, form95_mm, form997_mm = np.mean(forms, axis=0).tolist()
        yield SurfaceFigures(
            capture=capture.name,
            number=number,
            distance_m=float(np.median(mean_m)),
            angle_deg=float(np.degrees(np.arccos(np.median(cosine)))),
            temporal=temporal,
            frame_rms_mm=rms_mm,
            average_rms_mm=_form(mean_m, slopes)[0],
            form95_mm=form95_mm,
            form997_mm=form997_mm,
            fill_rate=float(np.isfinite(capture.z_m[:, capture.whole(mask)]).mean()),
        )


def _form(z_m: np.ndarray, slopes: np.ndarray) -> tuple[float, float, float]:
    """Return the rms in mm of points about their own plane, and the widths of the layers with 95
    and 99.7 % of them."""
    valid = np.isfinite(z_m)
    z_m = z_m[valid].astype(float)
    slopes = slopes[valid]
    plane = statistics.fit_plane(z_m, slopes)
    points = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1) * z_m[:, None]
    off_mm = (points @ plane.normal - plane.distance_m * plane.normal[2]) / MM
    rms_mm = float(np.sqrt((off_mm**2).mean()))
    lowest, low, high, highest = np.quantile(off_mm, (0.0015, 0.025, 0.975, 0.9985))
    return rms_mm, float(high - low), float(highest - lowest)


class EdgeFigures(NamedTuple):
    """Pixels across an edge between two surfaces, as means over lines of pixels and all frames."""

    lines: int
    """Number of lines of pixels that cross an edge."""
    gap_px: float
    """Pixels without a return."""
    flying_px: float
    """Pixels with a range on neither surface."""
    step_m: float
    """Median step of depth."""


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
        for surfaces, crossing in _crossings(labels, share, capture.mean_m):
            lines[capture.name, surfaces][0].append(crossing)
        for surfaces, crossing in _crossings(labels.T, share.T, capture.mean_m.T):
            lines[capture.name, surfaces][1].append(crossing)
    # use the axis that crosses more of the edge; the other axis crosses it at a small angle
    rows = np.array([row for line in lines.values() for row in max(line, key=len)])
    if len(rows) < LEAST_BIN_PX // 10:
        return None
    return EdgeFigures(
        lines=len(rows),
        gap_px=float(rows[:, 0].mean()),
        flying_px=float(rows[:, 1].mean()),
        step_m=float(np.median(rows[:, 2])),
    )


def _crossings(
    labels: np.ndarray, share: np.ndarray, z_m: np.ndarray
) -> Iterator[tuple[frozenset[int], tuple[float, float, float]]]:
    """Yield where rows of pixels pass from one surface to another: both surfaces, the pixels
    without and with a return between them (in frames), and the step in metres.

    ``labels`` (h, w) are numbers of surfaces, 0 beside them; ``share`` (h, w) is that of frames
    with a return.
    """
    for row, line in enumerate(labels):
        (on_surface,) = np.nonzero(line)
        is_change = np.diff(line[on_surface]) != 0
        is_close = np.diff(on_surface) <= WIDEST_PX
        for index in np.flatnonzero(is_change & is_close):
            last, first = on_surface[index : index + 2]
            between = share[row, last + 1 : first]
            step_m = abs(z_m[row, first] - z_m[row, last])
            if step_m > LEAST_STEP_M:
                lost_px = (1 - between).sum()
                yield frozenset(line[[last, first]]), (lost_px, between.sum(), step_m)


# ---------------------------------------------------------------- all figures


@dataclass(frozen=True)
class Characteristics:
    """The results of all captures of a camera."""

    captures: tuple[StillCapture, ...]
    """The captures in order of time."""
    cells: tuple[NoiseCell, ...]
    """Noise under the conditions of all captures."""
    law: RangeLaw
    """Noise against range and brightness."""
    correlation: np.ndarray
    """Correlation (2, `LAGS` + 1) of the noise along x and y."""
    dropouts: Dropouts
    """Frames without a return, by brightness."""
    surfaces: tuple[SurfaceFigures, ...]
    """Figures of every flat surface of every capture."""
    edge: EdgeFigures | None
    """Figures of the edges; None if there is none."""
    pattern: Separated | None
    """Fixed pattern; None without a flat surface."""
    pattern_correlation: np.ndarray | None
    """Correlation (2, `PATTERN_LAGS` + 1) of the fixed pattern; None if it is unknown."""

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
        variances = [capture.apart_m[capture.kept].var(ddof=1) for capture in self.captures]
        return float(np.sqrt(np.mean(variances)))

    @cached_property
    def doubts(self) -> tuple[str, ...]:
        """Sentences on what these captures cannot show, or show incorrectly."""
        notes: list[str] = []
        law = self.law
        first = self.captures[0]
        if not self.surfaces:
            notes.append(
                "no flat surface was found: angle, plane fit, fill rate, fixed pattern and edges "
                "are unknown"
            )
        if np.isnan(law.errors[0]):
            nearest_m = law.range_m.min()
            farthest_m = law.range_m.max()
            notes.append(
                f"surfaces between {nearest_m:.2f} and {farthest_m:.2f} m do not show how the noise "
                f"grows with range: the power {law.exponents[0]:g} is assumed"
            )
        if not self.has_amplitude:
            notes.append(
                "no amplitude is recorded: noise and dropouts of darker surfaces are unknown"
            )
        if np.isnan(law.errors[1]):
            notes.append(
                "brightness hardly varies, or only together with range: its effect on noise is "
                f"unknown, and the power -{law.exponents[1]:g} is assumed"
            )
        noise = first.noise_m[:, first.steady]
        sigma_m = float(np.sqrt(np.nanmedian(first.variance_m2[first.steady])))
        frame_correlation = float(
            np.nanmean(noise[1:] * noise[:-1]) / np.nanmean(noise**2)
        ) + 1 / len(noise)
        if frame_correlation > SLOW:
            notes.append(
                f"the noise of successive frames is correlated ({frame_correlation:.2f}): they "
                "were averaged over time or repeated, and single frames are noisier than stated"
            )
        reach = int(np.argmax([*(self.correlation.max(axis=0) < 0.1), True]))
        if reach > WIDE_PX:
            notes.append(
                f"the noise of pixels is correlated over {reach} pixels: the depth was upsampled, "
                "aligned to another camera, compressed or smoothed"
            )
        if sigma_m < COARSE * first.step_m:
            notes.append(
                f"the noise ({sigma_m / MM:.2g} mm) is hidden by the rounding to "
                f"{first.step_m / MM:.3g} mm, and its size before rounding is uncertain"
            )
        if drifted := [capture.name for capture in self.captures if abs(capture.drift_m) > JUMP_M]:
            notes.append(
                f"the distance drifts by more than {JUMP_M / MM:g} mm during "
                f"{', '.join(drifted)}: the camera warmed up or moved"
            )
        if jumped := len(self.jumps_m):
            notes.append(
                f"{jumped} of {self.frames} frames are displaced as a whole and are excluded from "
                "the noise"
            )
        if self.pattern is not None:
            notes += self.pattern.field.warnings
        return tuple(notes)


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
        problem = (
            f"{first.name}: has no {LEAST_BIN_PX} steady pixels with similar range, angle and "
            "brightness"
        )
        raise UserError(
            problem, legal="a static scene", fix="record a matte wall that fills the view"
        )
    correlation = correlations(max(captures, key=lambda capture: int(capture.steady.sum())))
    flat = []
    for capture, pose in zip(captures, poses or [None] * len(captures), strict=True):
        use = inner(capture.planes[0][1]) & capture.steady if capture.planes else np.zeros(1, bool)
        if use.sum() >= LEAST_BIN_PX:
            flat.append(flattened(capture.cloud(), use, capture.name, pose))
    pattern = separated(flat, first.lens) if flat else None
    surfaces = tuple(figures for capture in captures for figures in surfaces_of(capture))
    pattern_correlation = None
    if pattern is not None and pattern.field.rms_m > 0:
        pattern_correlation = _pattern_correlation(pattern, correlation)
    return Characteristics(
        captures=tuple(captures),
        cells=cells,
        law=noise_law(cells),
        correlation=correlation,
        dropouts=dropouts_of(captures),
        surfaces=surfaces,
        edge=edge_of(captures),
        pattern=pattern,
        pattern_correlation=pattern_correlation,
    )


def _pattern_correlation(pattern: Separated, of_noise: np.ndarray) -> np.ndarray:
    """Return the correlation (2, lags) of the fixed pattern along x and y, without the map's
    noise, faded to 0."""
    error_m = pattern.field.error_m
    in_field = np.isfinite(pattern.field.error_m)
    lags = range(PATTERN_LAGS + 1)
    pairs = []
    for lag in lags:
        along_x, _ = statistics.covariance(error_m[None], in_field, lag, 0)
        along_y, _ = statistics.covariance(error_m[None], in_field, 0, lag)
        pairs.append((along_x, along_y))
    noise_correlation = np.pad(of_noise, ((0, 0), (0, PATTERN_LAGS - LAGS)))
    of_map = float(np.nanmean(pattern.field.variance_m2)) * noise_correlation
    products = np.array(pairs).T - of_map
    faded = np.cos(np.linspace(0, np.pi / 2, len(lags)))
    return np.clip(np.nan_to_num(products / np.maximum(products[:, :1], 1e-18)), -1, 1) * faded
