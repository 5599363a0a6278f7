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
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.common.normals import standard_normals
from scenes.sensor.common.unit import DecodedFrame, UnitModel, light_of, rays_of, smooth_field
from scenes.sensor.lidar import kernels
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.lidar.kernels import strongest_peaks

f4 = np.float32
BLOCK_ROWS = 16  # rows whose correlations are held at once: 16 rows of 1,024 pixels need 8 MB
CERTAIN_DEVIATIONS = 10.0  # noise never exceeds a return so far above it (probability below 1e-9)
# rows of the matrix whose Cholesky factor ends in the taps of a moving sum, accurate to 0.3 %
FACTOR_ROWS = 400


class LidarReturns(NamedTuple):
    """Light that a view sends back, without noise: the two strongest peaks of each pixel."""

    height: np.ndarray
    """(2, h, w) float32: electrons."""
    half_m: np.ndarray
    """(2, h, w) float32: half the path, with the unit's errors."""
    deviation_m: np.ndarray
    """(2, h, w) float32: deviation of ``half_m``."""
    noise: np.ndarray
    """(h, w) float32: deviation of a height, electrons."""
    saturated: np.ndarray
    """(h, w) bool."""
    weak: np.ndarray
    """(m,): flat indices of pixels where noise may win."""


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
        self.ambient_electrons = 0.0
        if config.effects.ambient:
            self.ambient_electrons = camera.ambient_electrons(config.ambient_uw_cm2_nm)
        self._noise_taps = overlap_taps(camera.integration_points).astype(f4)

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
        ray_length = np.sqrt(1 + (self.slopes**2).sum(axis=-1))
        return np.asarray(self.camera.photons.signal_electrons.value / ray_length)

    @cached_property
    def _rays(self) -> np.ndarray:
        """Return (2, h, w) float32: the receiver's offset along the ray in metres, and the ray's
        cosine to the axis."""
        return np.stack(rays_of(self.slopes, self.camera.optics.emitter_m)).astype(f4)

    @cached_property
    def _limits(self) -> kernels.DeviceLimits:
        camera = self.camera
        engine = camera.engine
        receiver_m = camera.optics.emitter_m
        return kernels.DeviceLimits(
            receiver2_m2=f4(receiver_m @ receiver_m),
            least_strength=f4(engine.confidence_electrons.value),
            least_agreeing=f4(engine.least_agreeing.value),
            nearest_m=f4(engine.min_range_mm.value * MM),
            farthest_m=f4(camera.unambiguous_m),
            step_m=f4(camera.z_step_m),
        )

    def expose(self, view: NoiseFreeView) -> LidarReturns:
        """Return the two strongest returns of each beam of a view that covers this region, and
        their noise."""
        effects = self.config.effects
        photons = self.camera.photons
        phasor, intensity = light_of(view, effects)
        electrons = self.gathered * self._along_sweeps(intensity)
        all_electrons = electrons + self.ambient_electrons
        # deviation of the correlation: sqrt(F (signal + ambient) + amplifier^2)
        shot = photons.excess_noise_factor.value * all_electrons
        noise = np.sqrt(shot + photons.amplifier_electrons.value**2)
        height, half_m, deviation_m = self._peaks(phasor, noise)
        full = photons.full_scale_electrons.value if effects.saturation else np.inf
        weak = np.zeros(noise.shape, bool)
        if effects.noise:
            weak = height[0] < CERTAIN_DEVIATIONS * self.averaged * noise
        return LidarReturns(
            height=height.astype(f4),
            half_m=(half_m + self.static_error_m).astype(f4),
            deviation_m=deviation_m.astype(f4),
            noise=noise.astype(f4),
            saturated=all_electrons > full,
            weak=np.flatnonzero(weak),
        )

    def _peaks(
        self, phasor: np.ndarray, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return heights in electrons, half paths and their deviations in m, (2, h, w) each."""
        camera = self.camera
        blocks = []
        for row in range(0, len(noise), BLOCK_ROWS):
            light = self._along_sweeps(phasor, slice(row, row + BLOCK_ROWS))
            blocks.append(strongest_peaks(light, camera.weights))
        height = np.concatenate([peaks.height for peaks in blocks], axis=1)
        delay = np.concatenate([peaks.delay for peaks in blocks], axis=1)
        curvature = np.concatenate([peaks.curvature for peaks in blocks], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            metres_per_radian = camera.unambiguous_m / (2 * np.pi)
            deviation_m = metres_per_radian * self.slope * noise / (curvature * self.gathered)
        # where two pulses almost separate, the peak is flat; it still lies within their width
        code = camera.code
        width_m = camera.unambiguous_m * code.correlation_fwhm_ns.value / code.period_ns.value
        deviation_m = np.where(deviation_m >= 0, np.minimum(deviation_m, width_m), width_m)
        return height * self.gathered, delay * camera.unambiguous_m, deviation_m

    def _along_sweeps(self, light: np.ndarray, rows: slice = slice(None)) -> np.ndarray:
        """Return light (..., h, w) integrated over the points of a column that one point's time
        spans."""
        all_rows = np.arange(light.shape[-2])
        total = np.zeros((), light.dtype)
        weights = self.smear.astype(light.real.dtype)
        for ahead, weight in enumerate(weights, -(len(weights) // 2)):
            shifted = np.clip(all_rows[rows] + ahead, 0, all_rows[-1])
            total = total + weight * light[..., shifted, :]
        return total

    @cached_property
    def _whole_share(self) -> np.ndarray:
        """Return (h, w) float32: the weight of all neighbours within the picture."""
        share = np.ones(self.region.shape, f4)
        for axis, taps in enumerate(self.camera.smoothing_taps):
            ndimage.convolve1d(share, taps, axis, share, mode="constant")
        return share

    def frame(
        self, exposure: LidarReturns, rng: np.random.Generator, error_m: float = 0.0
    ) -> DecodedFrame:
        """Draw a frame: noise from ``rng`` on the peaks, then the processing; ``error_m``
        displaces the frame."""
        shape = exposure.noise.shape
        won_m, won_height, won_deviation_m = self._noisy_peaks(exposure, rng)
        half_m, share, height = self._smoothed(won_m, won_height, won_deviation_m)
        along_m, cosine = self._rays
        z_m = np.empty(shape, f4)
        strength = np.empty(shape, f4)
        reason = np.empty(shape, np.uint8)
        kernels.gated(
            half_m,
            share,
            height,
            self._whole_share,
            along_m,
            cosine,
            exposure.saturated,
            self._limits,
            f4(error_m),
            z_m,
            reason,
            strength,
        )
        return DecodedFrame(z_m, reason, strength)

    def _noisy_peaks(
        self, exposure: LidarReturns, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw half path, height and the half path's deviation of the highest peak, (h, w) each."""
        camera = self.camera
        h, w = exposure.noise.shape
        # standard normals, correlated along columns, and the sweeps' errors
        normals = np.zeros((3, h, w), f4)
        sweep_m = np.zeros(w, f4)
        if self.config.effects.noise:
            normals = standard_normals(rng, (3, h + len(self._noise_taps) - 1, w))
            kernels.correlate_along_columns(normals, self._noise_taps)
            sweep_m = standard_normals(rng, (w,)) * f4(camera.scan.sweep_jitter_mm.value * MM)
        won_m = np.empty((h, w), f4)
        won_height = np.empty((h, w), f4)
        won_deviation_m = np.empty((h, w), f4)
        kernels.stronger_peak(
            exposure.height,
            exposure.half_m,
            exposure.deviation_m,
            exposure.noise,
            normals,
            sweep_m,
            won_m,
            won_height,
            won_deviation_m,
        )
        # Cramer-Rao bound of a delay in white noise after the matched filter, at a height of one
        # noise deviation
        bound_m = camera.unambiguous_m / (camera.period_s * camera.bandwidth_rad_s)
        kernels.noise_peaks(
            exposure.weak,
            exposure.noise,
            self.averaged,
            rng.random((2, exposure.weak.size)),
            self.slope,
            bound_m,
            camera.unambiguous_m,
            won_m,
            won_height,
            won_deviation_m,
        )
        return won_m, won_height, won_deviation_m

    def _smoothed(
        self, won_m: np.ndarray, won_height: np.ndarray, won_deviation_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return mean half path, weight and strength of the neighbours that agree, (h, w) each:
        along columns, then along rows."""
        h, w = won_m.shape
        along_columns, along_rows = self.camera.smoothing_taps
        p = len(along_columns) // 2
        q = len(along_rows) // 2
        border = ((p, p), (q, q))
        gate_m = won_deviation_m * f4(self.camera.engine.agree_deviations.value)
        half_m = won_m
        share = np.ones((h, w), f4)
        height = won_height
        for taps in (along_columns, along_rows):
            smoothed_m = np.empty((h, w), f4)
            smoothed_share = np.empty((h, w), f4)
            smoothed_height = np.empty((h, w), f4)
            # beyond the border is what agrees with nothing
            kernels.smooth(
                np.pad(half_m, border, constant_values=kernels.NOWHERE_M),
                np.pad(share, border),
                np.pad(height, border),
                gate_m,
                taps,
                taps is along_rows,
                smoothed_m,
                smoothed_share,
                smoothed_height,
            )
            half_m = smoothed_m
            share = smoothed_share
            height = smoothed_height
        return half_m, share, height


def smear_weights(points: float) -> np.ndarray:
    """Return weights, with sum 1, of points around one whose integration covers ``points``; light
    between is linear."""
    reach = int(np.ceil(points / 2))
    hat = interpolate.BSpline.basis_element([-1, 0, 1])
    half = points / 2
    weights = []
    for k in range(-reach, reach + 1):
        weights.append(hat.integrate(-half - k, half - k, extrapolate=False))
    return np.array(weights) / points


def overlap_taps(points: float) -> np.ndarray:
    """Return taps, with squares that sum to 1, of a moving sum of white noise that correlates like
    integrations over ``points`` points, 1 - k / p at lag k: the last row of the Cholesky factor of
    its matrix (Bauer 1955)."""
    lags = np.arange(int(np.ceil(points)) if points > 1 else 1)
    correlation = np.zeros(FACTOR_ROWS)
    correlation[: len(lags)] = 1 - lags / max(points, 1.0)
    factor = np.linalg.cholesky(linalg.toeplitz(correlation))
    taps = factor[-1, -len(lags) :]
    return np.asarray(taps / np.linalg.norm(taps))
