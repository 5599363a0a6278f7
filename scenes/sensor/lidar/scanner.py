"""The scanned lidar: converts the peaks of each beam's correlation to range, with a reason for
each invalid pixel.

Modelled: a beam per pixel whose light, over all paths, meets one detector; the strongest peak of
the coded pulse; shot noise with the avalanche's excess, ambient light, and the amplifier's noise
on height and position of peaks; maxima of the noise after an average over neighbours; integration
over more than one point's time; an error that a sweep shares; ripples of a unit; smoothing among
agreeing neighbours; confidence threshold, least range, saturation; the receiver beside the
transmitter; rounding. Not modelled: wiggling and the edge gate (these effects change nothing),
side lobes of the real code, uneven speed and direction errors of the mirror, a beam width that
changes with distance, drift over seconds, light of other lidars, motion, walk error with
amplitude, and other filters of the vendor."""

from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import interpolate, linalg, ndimage

from harness.vocabulary.geometry import MM, Region
from scenes.optics import NoiseFreeView
from scenes.sensor.camera import CameraConfig
from scenes.sensor.lidar import kernels
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.lidar.kernels import Peaks, strongest_peaks
from scenes.sensor.normals import standard_normals
from scenes.sensor.unit import DecodedFrame, UnitModel, light_of, rays_of, smooth_field

f4 = np.float32
BLOCK_ROWS = 16  # rows whose correlations are held at once: 16 rows of 1,024 pixels need 8 MB
CERTAIN_DEVIATIONS = 10.0  # noise never exceeds a return so far above it (probability below 1e-9)
# rows of the matrix whose Cholesky factor ends in the taps of a moving sum, accurate to 0.3 %
FACTOR_ROWS = 400


class LidarReturns(NamedTuple):
    """Light that a view sends back, without noise. The two strongest peaks, (2, h, w) float32:
    ``height`` (electrons), ``half_m`` (half the path, with the unit's errors), ``deviation_m`` of
    it. ``noise`` (h, w): deviation of a height, electrons. ``saturated`` (h, w) bool. ``weak``
    (m,): flat indices of pixels where noise may win."""

    height: np.ndarray
    half_m: np.ndarray
    deviation_m: np.ndarray
    noise: np.ndarray
    saturated: np.ndarray
    weak: np.ndarray


class LidarScanner(UnitModel[ScannedLidar]):
    """A camera of this kind on a region of its raster: `expose` once per view, then `frame` for
    each exposure."""

    def __init__(
        self, camera: ScannedLidar, config: CameraConfig, region: Region, slopes: np.ndarray
    ) -> None:
        super().__init__(camera, config, region, slopes)
        # weights of the points along a column whose light one point integrates
        self.smear = smear_weights(camera.integration_points)
        # the error of position is the slope's error over the curvature; the noise has the pulse's
        # own spectrum
        self.slope = camera.bandwidth_rad_s * camera.period_s / (2 * np.pi)
        # electrons of ambient light in one integration, equal for all pixels: one detector sees
        # the whole field
        ambient = config.effects.ambient
        self.ambient_electrons = (
            camera.ambient_electrons(config.ambient_uw_cm2_nm) if ambient else 0.0
        )
        self._noise_taps = overlap_taps(camera.integration_points).astype(f4)
        # (2, h, w): the receiver's offset along the ray in metres, and the ray's cosine to the
        # axis
        receiver_m = camera.optics.emitter_m
        engine = camera.engine
        self._geometry = np.stack(rays_of(slopes, receiver_m)).astype(f4)
        least = (
            receiver_m @ receiver_m,
            engine.confidence_electrons.value,
            engine.least_agreeing.value,
        )
        range_m = engine.min_range_mm.value * MM, camera.unambiguous_m, camera.z_step_m
        self._limits = tuple(map(f4, (*least, *range_m)))

    def pattern_mm(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """Draw smooth ripples of range."""
        facts = self.camera.fixed_pattern
        white = rng.standard_normal(shape, dtype=f4)
        return smooth_field(white, facts.smooth_length_px.value) * facts.smooth_mm.value

    @cached_property
    def averaged(self) -> float:
        """Share of the noise's deviation that smoothing leaves if all neighbours agree."""
        along, across = self.camera.smoothing_taps
        return float(np.linalg.norm(np.convolve(along, self._noise_taps)) * np.linalg.norm(across))

    @cached_property
    def gathered(self) -> np.ndarray:
        """Signal electrons (h, w) of a point per unit of the view's light: the receiver's aperture
        is flat."""
        return np.asarray(
            self.camera.photons.signal_electrons.value / np.sqrt(1 + (self.slopes**2).sum(axis=-1))
        )

    def expose(self, view: NoiseFreeView) -> LidarReturns:
        """Return the two strongest returns of each beam of a view that covers this region, and
        their noise."""
        effects = self.config.effects
        photons = self.camera.photons
        phasor, intensity = light_of(view, effects)
        electrons = self.gathered * self._along_sweeps(intensity)
        # deviation of the correlation: sqrt(F (signal + ambient) + amplifier^2)
        shot = photons.excess_noise_factor.value * (electrons + self.ambient_electrons)
        noise = np.sqrt(shot + photons.amplifier_electrons.value**2)
        height, half_m, deviation_m = self._peaks(phasor, noise)
        full = photons.full_scale_electrons.value if effects.saturation else np.inf
        weak = (
            height[0] < CERTAIN_DEVIATIONS * self.averaged * noise
            if effects.noise
            else np.zeros(noise.shape, bool)
        )
        half_m = half_m + self.static_error_m
        saturated = electrons + self.ambient_electrons > full
        height = height.astype(f4)
        half_m = half_m.astype(f4)
        deviation_m = deviation_m.astype(f4)
        noise = noise.astype(f4)
        return LidarReturns(height, half_m, deviation_m, noise, saturated, np.flatnonzero(weak))

    def _peaks(
        self, phasor: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return heights in electrons, half paths and their deviations in metres, each (2, h, w)."""
        camera = self.camera
        blocks = (slice(row, row + BLOCK_ROWS) for row in range(0, len(noise), BLOCK_ROWS))
        found = [
            strongest_peaks(self._along_sweeps(phasor, rows), camera.weights) for rows in blocks
        ]
        peaks = Peaks(*(np.concatenate(parts, axis=1) for parts in zip(*found, strict=True)))
        with np.errstate(divide="ignore", invalid="ignore"):
            metres_per_radian = camera.unambiguous_m / (2 * np.pi)
            deviation_m = metres_per_radian * self.slope * noise / (peaks.curvature * self.gathered)
        # where two pulses almost separate, the peak is flat; it still lies within their width
        width_m = (
            camera.unambiguous_m
            * camera.code.correlation_fwhm_ns.value
            / camera.code.period_ns.value
        )
        deviation_m = np.where(deviation_m >= 0, np.minimum(deviation_m, width_m), width_m)
        return peaks.height * self.gathered, peaks.delay * camera.unambiguous_m, deviation_m

    def _along_sweeps(self, light: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """Return light (..., h, w) integrated over the points of a column that one point's time
        spans."""
        every = np.arange(light.shape[-2])
        total = np.zeros((), light.dtype)
        for ahead, weight in enumerate(
            self.smear.astype(light.real.dtype), -(len(self.smear) // 2)
        ):
            total = total + weight * light[..., np.clip(every[rows] + ahead, 0, every[-1]), :]
        return total

    @cached_property
    def _everyone(self) -> np.ndarray:
        """Return (h, w) float32: the weight of all neighbours within the picture."""
        everyone = np.ones(self.region.shape, f4)
        for axis, taps in enumerate(self.camera.smoothing_taps):
            ndimage.convolve1d(everyone, taps, axis, everyone, mode="constant")
        return everyone

    def frame(
        self, exposure: LidarReturns, rng: np.random.Generator, error_m: float = 0.0
    ) -> DecodedFrame:
        """Draw a frame: noise from ``rng`` on the peaks, then the processing; ``error_m``
        displaces the frame."""
        camera, (h, w) = self.camera, exposure.noise.shape
        p, q = (len(taps) // 2 for taps in camera.smoothing_taps)
        inner = (slice(p, p + h), slice(q, q + w))
        bordered = (h + 2 * p, w + 2 * q)
        # half path, share and height, with a border that agrees with nothing
        half_m = np.full(bordered, kernels.NOWHERE_M)
        share = np.zeros(bordered, f4)
        height = np.zeros(bordered, f4)
        share[inner] = 1.0
        won = half_m[inner], height[inner], np.empty((h, w), f4)
        # standard normals, correlated along columns, and the sweeps' errors
        normals = np.zeros((3, h, w), f4)
        sweep_m = np.zeros(w, f4)
        taps = self._noise_taps
        if self.config.effects.noise:
            normals = standard_normals(rng, (3, h + len(taps) - 1, w))
            kernels.correlate_along_columns(normals, taps)
            sweep_m = standard_normals(rng, (w,)) * f4(camera.scan.sweep_jitter_mm.value * MM)
        kernels.stronger_peak(*exposure[:4], normals, sweep_m, *won)
        # Cramer-Rao bound of a delay in white noise after the matched filter, at a height of one
        # noise deviation
        bound_m = camera.unambiguous_m / (camera.period_s * camera.bandwidth_rad_s)
        rates = self.slope, bound_m, camera.unambiguous_m
        uniforms = rng.random((2, exposure.weak.size))
        kernels.noise_peaks(exposure.weak, exposure.noise, self.averaged, uniforms, *rates, *won)
        gate_m = won[2] * f4(camera.engine.agree_deviations.value)

        # smoothing along columns, then along rows; range, gates and rounding
        image = half_m, share, height
        for axis, taps in enumerate(camera.smoothing_taps):
            smoothed = tuple(np.empty((h, w), f4) for _ in image)
            kernels.smooth(*image, gate_m, taps, axis == 1, *smoothed)
            for bordered_image, result in zip(
                image, smoothed if axis == 0 else (), strict=axis == 0
            ):
                bordered_image[inner] = result
        z_m = np.empty((h, w), f4)
        strength = np.empty((h, w), f4)
        reason = np.empty((h, w), np.uint8)
        scene = *self._geometry, exposure.saturated, self._limits, f4(error_m)
        kernels.gated(*smoothed, self._everyone, *scene, z_m, reason, strength)
        return DecodedFrame(z_m, reason, strength)


def smear_weights(points: float) -> np.ndarray:
    """Return weights, with sum 1, of points around one whose integration covers ``points``; light
    between is linear."""
    reach = int(np.ceil(points / 2))
    hat = interpolate.BSpline.basis_element([-1, 0, 1])
    half = points / 2
    weights = [
        hat.integrate(-half - k, half - k, extrapolate=False) for k in range(-reach, reach + 1)
    ]
    return np.array(weights) / points


def overlap_taps(points: float) -> np.ndarray:
    """Return taps, with squares that sum to 1, of a moving sum of white noise that correlates like
    integrations over ``points`` points, 1 - k / p at lag k: the last row of the Cholesky factor of
    its matrix (Bauer 1955)."""
    lags = np.arange(int(np.ceil(points)) if points > 1 else 1)
    correlation = np.zeros(FACTOR_ROWS)
    correlation[: len(lags)] = 1 - lags / max(points, 1.0)
    taps = np.linalg.cholesky(linalg.toeplitz(correlation))[-1, -len(lags) :]
    return np.asarray(taps / np.linalg.norm(taps))
