"""The scanned lidar: the correlation's peaks in each beam to range, with a reason for each invalid pixel.

Modelled: one beam per pixel whose light, with all its paths, meets one detector; the correlation of the coded pulse and
its strongest peak, which decides between returns; shot noise with the avalanche's excess, ambient light and the
amplifier's noise, as they act on heights and places of peaks; maxima of the noise that exceed a weak return;
integration over more than one point's time, which smears the beam along the sweep and correlates the noise there; an
error that a sweep shares; ripples of a unit; smoothing among agreeing neighbours; confidence threshold, least range,
saturation; the correction for the receiver beside the transmitter; rounding.
Not modelled: wiggling (there is no continuous wave whose harmonics alias, so that effect changes nothing, nor does the
configuration's edge gate, which belongs to another engine), side lobes of the real code, the mirror's uneven speed and
its errors of direction, the beam's own width changing with distance, drift over seconds, light of other lidars, motion,
walk error with amplitude, and the vendor's own filters beyond these.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg

from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.sensor.camera import CameraConfig
from scenes.sensor.decoded import Decoded
from scenes.sensor.lidar import kernels
from scenes.sensor.lidar.correlation import strongest_peaks
from scenes.sensor.lidar.facts import ScannedLidar
from scenes.sensor.light import light_of
from scenes.sensor.normals import standard_normals
from scenes.sensor.unit import drift_m, smooth_field, static_error_m
from scenes.view import NoiseFreeView

f4 = np.float32
BLOCK_ROWS = 16
"""Rows whose correlations are held at once: 16 rows of 1,024 pixels take 8 MB."""
CERTAIN_DEVIATIONS = 10.0
"""A return this much above the noise is never beaten by a maximum of the noise (chance below 1e-9)."""
FACTOR_ROWS = 400
"""Size of the matrix whose Cholesky factor ends in the taps of a moving sum; the taps are good to 0.3 %."""


@dataclass(frozen=True)
class Returns:
    """What one view sends back before noise.

    Of the two strongest peaks, (2, h, w) float32: ``height`` (electrons), ``half_m`` (half the path, with the unit's
    errors), ``deviation_m`` (of the half path, from noise). ``noise`` (h, w): deviation of a height, electrons.
    ``saturated`` (h, w) bool. ``weak`` (m,): flat indices of pixels that a maximum of the noise may win.
    """

    height: np.ndarray
    half_m: np.ndarray
    deviation_m: np.ndarray
    noise: np.ndarray
    saturated: np.ndarray
    weak: np.ndarray


class LidarScanner:
    """A camera of this kind on one region of its raster: `expose` once per view, then `frame` for each exposure."""

    def __init__(self, camera: ScannedLidar, config: CameraConfig, region: Region, slopes: np.ndarray) -> None:
        self.camera = camera
        self.config = config
        self.region = region
        self.slopes = slopes

    @cached_property
    def smear(self) -> np.ndarray:
        """Weights of the points along a column whose light one point integrates, linear between points."""
        return smear_weights(self.camera.integration_points)

    @cached_property
    def noise_taps(self) -> np.ndarray:
        """Taps of a moving sum along a column with the correlation that overlapping integrations have."""
        return overlap_taps(self.camera.integration_points).astype(f4)

    @cached_property
    def static_error_m(self) -> np.ndarray:
        """(h, w): all errors of range that frames of this unit share, as far as they are on."""
        camera, config = self.camera, self.config
        error = drift_m(camera.unit, config.effects, config.minutes_since_power_on, self.slopes[..., 0])
        error = error + static_error_m(camera.unit, config.effects, camera.name, config.unit_seed)
        return np.asarray(error + self.ripples_m if config.effects.fixed_pattern else error)

    @cached_property
    def ripples_m(self) -> np.ndarray:
        """(h, w): this unit's fixed pattern, cut from a field over the whole raster."""
        facts, lens = self.camera.fixed_pattern, self.camera.nominal_lens
        rng = random_stream(self.config.unit_seed, "fixed pattern", self.camera.name)
        white = rng.standard_normal((lens.height, lens.width), dtype=f4)
        field = smooth_field(white, facts.smooth_length_px.value)
        return np.asarray(field * facts.smooth_mm.value * MM * self.config.fixed_pattern_scale)[
            self.region.within(lens.whole)
        ]

    @cached_property
    def gathered(self) -> np.ndarray:
        """(h, w): signal electrons of a point per unit of the view's light: the receiver's aperture is flat.

        The beam's power is the same in all directions, so nothing else of the field's edge comes in.
        """
        return np.asarray(self.camera.photons.signal_electrons.value / np.sqrt(1 + (self.slopes**2).sum(axis=-1)))

    # ---------------------------------------------------------------- once per view

    def expose(self, view: NoiseFreeView) -> Returns:
        """The two strongest returns of each beam of a view that covers this scanner's region, and their noise."""
        camera, effects = self.camera, self.config.effects
        phasor, intensity = light_of(view, effects)
        electrons = self.gathered * self._along_sweeps(intensity)
        noise = self.noise_electrons(electrons)
        height, half_m, deviation_m = self._peaks(phasor, noise)
        full = camera.photons.full_scale_electrons.value if effects.saturation else np.inf
        weak = height[0] < CERTAIN_DEVIATIONS * noise if effects.noise else np.zeros(noise.shape, bool)
        return Returns(
            height.astype(f4),
            (half_m + self.static_error_m).astype(f4),
            deviation_m.astype(f4),
            noise.astype(f4),
            electrons + self.ambient_electrons > full,
            np.flatnonzero(weak),
        )

    @cached_property
    def ambient_electrons(self) -> float:
        """Electrons of ambient light in one integration, the same in all pixels: one detector sees the whole field."""
        config = self.config
        return self.camera.ambient_electrons(config.ambient_uw_cm2_nm) if config.effects.ambient else 0.0

    def noise_electrons(self, signal_electrons: np.ndarray) -> np.ndarray:
        """Deviation of the correlation in a point with that much light: sqrt(F (signal + ambient) + amplifier^2)."""
        photons = self.camera.photons
        shot = photons.excess_noise_factor.value * (signal_electrons + self.ambient_electrons)
        return np.asarray(np.sqrt(shot + photons.amplifier_electrons.value**2))

    @property
    def metres_at_unit_ratio(self) -> float:
        """Deviation of half the path of a lone return as high as the noise's deviation.

        The Cramer-Rao bound of a delay in white noise through the matched filter: 1 / (bandwidth * ratio).
        """
        return self.camera.unambiguous_m / (self.camera.period_s * self.camera.bandwidth_rad_s)

    def _peaks(self, phasor: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Heights in electrons, half paths and their deviations in metres, each (2, h, w)."""
        camera = self.camera
        h, w = noise.shape
        height, half_m, deviation_m = (np.empty((2, h, w)) for _ in range(3))
        # a slope's error over the curvature is the place's error; the noise has the pulse's own spectrum
        slope = camera.bandwidth_rad_s * camera.period_s / (2 * np.pi)
        metres_per_radian = camera.unambiguous_m / (2 * np.pi)
        for row in range(0, h, BLOCK_ROWS):
            rows = slice(row, min(row + BLOCK_ROWS, h))
            block = self._along_sweeps(phasor, rows)
            peaks = strongest_peaks(block.reshape(len(block), -1), camera.weights)
            shape = (2, *block.shape[1:])
            height[:, rows] = peaks.height.reshape(shape) * self.gathered[rows]
            half_m[:, rows] = peaks.delay.reshape(shape) * camera.unambiguous_m
            curvature = peaks.curvature.reshape(shape) * self.gathered[rows]
            with np.errstate(divide="ignore", invalid="ignore"):
                deviation_m[:, rows] = metres_per_radian * slope * noise[rows] / curvature
        # where two pulses are about to part the peak is flat; it still lies within their width
        width_m = camera.unambiguous_m * camera.code.correlation_fwhm_ns.value / camera.code.period_ns.value
        return height, half_m, np.where(deviation_m >= 0, np.minimum(deviation_m, width_m), width_m)

    def _along_sweeps(self, light: np.ndarray, rows: slice | None = None) -> np.ndarray:
        """Light (..., h, w) integrated over the points of a column that one point's time spans; only ``rows`` of it.

        At the region's border the nearest row stands for those beyond it; the margin takes them off.
        """
        h = light.shape[-2]
        first, last = (0, h) if rows is None else (rows.start, rows.stop)
        reach = len(self.smear) // 2
        total = np.zeros((), light.dtype)
        for j, weight in enumerate(self.smear):
            at = np.clip(np.arange(first, last) + j - reach, 0, h - 1)
            total = total + light.real.dtype.type(weight) * light[..., at, :]
        return total

    # ---------------------------------------------------------------- once per frame

    def frame(self, exposure: Returns, rng: np.random.Generator, error_m: float = 0.0) -> Decoded:
        """One frame: noise from ``rng`` on the peaks, then the device's processing; ``error_m`` displaces the frame."""
        h, w = exposure.noise.shape
        won_m = np.full((h + 2, w + 2), kernels.NOWHERE_M, f4)
        won_height = np.zeros((h + 2, w + 2), f4)
        won_deviation_m = np.zeros((h + 2, w + 2), f4)
        normals, sweep_m = self._draw(rng, h, w)
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
        kernels.noise_peaks(
            exposure.weak,
            exposure.noise,
            rng.random((2, exposure.weak.size)),
            self.camera.bandwidth_rad_s * self.camera.period_s / (2 * np.pi),
            self.metres_at_unit_ratio,
            self.camera.unambiguous_m,
            won_m,
            won_height,
            won_deviation_m,
        )
        won_deviation_m *= f4(self.camera.engine.agree_deviations.value)
        return self._processed(won_m, won_height, won_deviation_m, exposure.saturated, error_m)

    def at_once(self, exposure: Returns, asked: np.ndarray) -> None:
        """None: there is no way to sum frames that is equal in distribution and costs much less than they do.

        A neighbour counts where it agrees within a gate of a few of its own deviations, so what a pixel gives is far
        from linear in the noise everywhere, face included, and a frame's noise is one array of three fields that a
        linear camera would need as well.
        """
        return None

    def _draw(self, rng: np.random.Generator, h: int, w: int) -> tuple[np.ndarray, np.ndarray]:
        """Standard normals (3, h or more, w), correlated along columns, and the sweeps' errors (w,) in metres."""
        q = len(self.noise_taps) - 1
        if not self.config.effects.noise:
            return np.zeros((3, h, w), f4), np.zeros(w, f4)
        normals = standard_normals(rng, (3, h + q, w))
        kernels.correlate_along_columns(normals, self.noise_taps)
        return normals, standard_normals(rng, (w,)) * f4(self.camera.scan.sweep_jitter_mm.value * MM)

    def _processed(
        self, won_m: np.ndarray, won_height: np.ndarray, gate_m: np.ndarray, saturated: np.ndarray, error_m: float
    ) -> Decoded:
        """Smoothing, range, gates and rounding."""
        z_m = np.empty(saturated.shape, f4)
        reason = np.empty(saturated.shape, np.uint8)
        strength = np.empty(saturated.shape, f4)
        along_m, cosine = self._geometry
        kernels.smooth_and_gate(
            won_m,
            won_height,
            gate_m,
            f4(self.camera.engine.side_weight.value),
            along_m,
            cosine,
            saturated,
            self._limits,
            f4(error_m),
            z_m,
            reason,
            strength,
        )
        return Decoded(z_m, reason, strength)

    @cached_property
    def _geometry(self) -> np.ndarray:
        """(2, h, w) float32: the receiver's offset along the ray in metres, the ray's cosine to the axis."""
        rays = np.concatenate([self.slopes, np.ones((*self.slopes.shape[:2], 1))], axis=-1)
        length = np.linalg.norm(rays, axis=-1)
        return np.stack([rays @ self.camera.receiver_m / length, 1 / length]).astype(f4)

    @cached_property
    def _limits(self) -> tuple[np.float32, ...]:
        camera = self.camera
        values = (
            camera.receiver_m @ camera.receiver_m,
            camera.engine.confidence_electrons.value,
            camera.engine.least_agreeing.value,
            camera.engine.min_range_mm.value * MM,
            camera.unambiguous_m,
            camera.z_step_m,
        )
        return tuple(f4(value) for value in values)


def smear_weights(points: float) -> np.ndarray:
    """Weights, odd in number and of sum 1, of points about one whose integration spans ``points`` points' time.

    The light between two points is taken as linear between them, so a weight is the integral of a hat function.
    """
    reach = int(np.ceil(points / 2))

    def integral(x: float) -> float:  # of the hat max(0, 1 - |x|) from -1 to x
        x = min(max(x, -1.0), 1.0)
        return float(0.5 + x - np.sign(x) * x**2 / 2)

    weights = [integral(points / 2 - k) - integral(-points / 2 - k) for k in range(-reach, reach + 1)]
    return np.array(weights) / points


def overlap_taps(points: float) -> np.ndarray:
    """Taps, of sum of squares 1, of a moving sum of white noise that correlates as integrations over ``points`` points.

    Windows of length p that start a point apart share 1 - k / p of white noise at lag k. The taps with that
    autocorrelation are the last row of the Cholesky factor of its matrix (Bauer 1955).
    """
    lags = np.arange(int(np.ceil(points)) if points > 1 else 1)
    correlation = np.zeros(FACTOR_ROWS)
    correlation[: len(lags)] = 1 - lags / max(points, 1.0)
    taps = np.linalg.cholesky(linalg.toeplitz(correlation))[-1, -len(lags) :]
    return np.asarray(taps / np.linalg.norm(taps))
