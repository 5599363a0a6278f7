"""The continuous-wave imager: phasors to samples to filtered phasors to range, with a reason for each invalid pixel.

Modelled: shot and read noise on the samples, companding, saturation, fixed pattern, the phase-space joint bilateral
filter, three-frequency unwrapping, the engine's gates, the correction for the emitter beside the lens, rounding; the
lens' natural fall-off of light towards the edge of the image.
Not modelled: harmonics of the modulation (wiggling), drift with temperature, lens blur and stray light beyond the
pixel's own footprint, motion, cross-talk between pixels, per-pixel gain switching, and any post-processing beyond this.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM, SPEED_OF_LIGHT_AIR
from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.amcw.unwrap import UnwrapTable, unwrap_table
from scenes.sensor.camera import CameraConfig
from scenes.sensor.decoded import Decoded
from scenes.sensor.unit import drift_m, static_error_m
from scenes.view import NoiseFreeView

f4 = np.float32


@dataclass(frozen=True)
class Exposure:
    """What the converter sees of one view before noise, in converter units, flat over n = h w pixels.

    ``means`` (f, k, n): noise-free samples; ``sigma`` (n,): deviation of each sample; ``shape``: (h, w).
    """

    means: np.ndarray
    sigma: np.ndarray
    shape: tuple[int, int]


class AmcwImager:
    """A camera of this kind on one region of its sensor: `expose` once per view, then `frame` for each exposure."""

    def __init__(self, camera: AmcwCamera, config: CameraConfig, region: Region, slopes: np.ndarray) -> None:
        self.camera = camera
        self.config = config
        self.region = region
        self.slopes = slopes
        self._frequencies = np.array(camera.frequencies_hz)
        phases = 2 * np.pi * np.arange(camera.modulation.phases.value) / camera.modulation.phases.value
        self._cosines = np.cos(phases).astype(f4)
        self._sines = np.sin(phases).astype(f4)

    @cached_property
    def unwrap(self) -> UnwrapTable:
        """The unwrapping tables of this camera's frequencies."""
        return unwrap_table(self.camera.frequencies_hz)

    @cached_property
    def outside_mask(self) -> np.ndarray:
        """(h, w) bool: pixels that look beyond the illuminated polygon."""
        corners = np.array(self.camera.emitter.mask_slopes.value)
        x, y = self.slopes[..., 0], self.slopes[..., 1]
        outside = np.zeros(x.shape, bool)
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            outside |= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) < 0
        return outside

    @cached_property
    def gathered(self) -> np.ndarray:
        """(h, w): light that a pixel gathers from a surface of given radiance, relative to one on the axis.

        Solid angle times the pupil's foreshortening: |d slopes / d pixel| cos^4, which is the cos^4 law for an
        undistorted lens; barrel distortion widens outer pixels and gives part of it back. Not modelled: mechanical
        vignetting and the growth of the pupil with angle that wide lenses are designed to have.
        """
        v, u = np.mgrid[self.region.row0 : self.region.row1, self.region.col0 : self.region.col1].astype(float)
        lens = self.camera.nominal_lens
        along_u = lens.slopes(u + 0.5, v) - lens.slopes(u - 0.5, v)
        along_v = lens.slopes(u, v + 0.5) - lens.slopes(u, v - 0.5)
        area = np.abs(along_u[..., 0] * along_v[..., 1] - along_u[..., 1] * along_v[..., 0])
        return np.asarray(area * lens.fx * lens.fy / (1 + (self.slopes**2).sum(axis=-1)) ** 2)

    @cached_property
    def fixed_pattern_m(self) -> np.ndarray:
        """(h, w): this unit's error of range before the filter, cut from a field over the whole sensor."""
        facts = self.camera.fixed_pattern
        lens = self.camera.nominal_lens
        rng = random_stream(self.config.unit_seed, "fixed pattern", self.camera.name)
        smooth, pixel = rng.standard_normal((2, lens.height, lens.width), dtype=f4)
        # White noise through a Gaussian of s has autocorrelation exp(-k^2 / 4 s^2): s = l / sqrt 2; its variance falls
        # to 1 / (4 pi s^2).
        s = facts.smooth_length_px.value / np.sqrt(2)
        smooth = ndimage.gaussian_filter(smooth, s, mode="wrap") * (2 * np.sqrt(np.pi) * s)
        field = (facts.smooth_mm.value * smooth + facts.pixel_mm.value * pixel) * MM * self.config.fixed_pattern_scale
        return field[self.region.within(lens.whole)]

    @cached_property
    def static_error_m(self) -> np.ndarray:
        """(h, w): all errors of range that frames of this unit share before the filter, as far as they are on."""
        camera, config = self.camera, self.config
        error = drift_m(camera.unit, config.effects, config.minutes_since_power_on, self.slopes[..., 0])
        error = error + static_error_m(camera.unit, config.effects, camera.name, config.unit_seed)
        return np.asarray(error + self.fixed_pattern_m if config.effects.fixed_pattern else error)

    def expose(self, view: NoiseFreeView) -> Exposure:
        """The noise-free samples of a view that covers this imager's region."""
        photons = self.camera.photons
        electrons = photons.signal_electrons.value * self.gathered
        delay = np.exp(
            1j * 2 * np.pi * self._frequencies[:, None, None] * (2 * self.static_error_m / SPEED_OF_LIGHT_AIR)
        )
        contrast = np.array(self.camera.modulation.contrast.value)[:, None, None]
        phasor = view.phasor if self.config.effects.multipath else view.phasor_direct
        signal = contrast * electrons * phasor * delay / photons.electrons_per_unit.value
        samples = (
            signal.real[:, None] * self._cosines[None, :, None, None]
            + signal.imag[:, None] * self._sines[None, :, None, None]
        )
        variance = electrons * view.intensity + photons.ambient_electrons.value
        variance = variance + 2 * photons.read_noise_electrons.value**2
        sigma = np.sqrt(variance) / photons.electrons_per_unit.value
        if not self.config.effects.noise:
            sigma = np.zeros_like(sigma)
        n = sigma.size
        return Exposure(
            samples.reshape(*samples.shape[:2], n).astype(f4), sigma.reshape(n).astype(f4), view.intensity.shape
        )

    def frame(self, exposure: Exposure, rng: np.random.Generator, error_m: float = 0.0) -> Decoded:
        """One frame: noise from ``rng`` on the samples, then the depth engine; ``error_m`` displaces the frame."""
        n_frequencies, n_phases, n = exposure.means.shape
        normals = _standard_normals(rng, (n_frequencies, n_phases, n))
        unit = np.empty((2, n_frequencies, n), f4)
        amplitude = np.empty((n_frequencies, n), f4)
        saturated = np.empty(n, np.uint8)
        converter = self.camera.converter
        kernels.expose(
            exposure.means,
            exposure.sigma,
            normals,
            f4(converter.knee_units.value),
            f4(converter.full_scale_units.value),
            self._cosines,
            self._sines,
            unit,
            amplitude,
            saturated,
        )
        return self._decode(unit, amplitude, saturated, exposure.shape, error_m)

    def _decode(
        self, unit: np.ndarray, amplitude: np.ndarray, saturated: np.ndarray, shape: tuple[int, int], error_m: float
    ) -> Decoded:
        """The depth engine: filter, unwrap, gate, correct, round."""
        engine = self.camera.engine
        n_frequencies = unit.shape[1]
        filtered = np.empty((n_frequencies, 3, *shape), f4)
        edge = np.empty((n_frequencies, *shape), f4)
        for f in range(n_frequencies):
            kernels.joint_bilateral(
                unit[:, f].reshape(2, *shape),
                amplitude[f].reshape(shape),
                engine.window_px.value // 2,
                f4(engine.concentration.value),
                f4(engine.dim_amplitude_units.value),
                filtered[f],
                edge[f],
            )
        z_m = np.empty(shape, f4)
        reason = np.empty(shape, np.uint8)
        strength = np.empty(shape, f4)
        kernels.range_and_gates(
            filtered.reshape(n_frequencies, 3, -1),
            edge.reshape(n_frequencies, -1),
            saturated,
            self._geometry,
            self.outside_mask.reshape(-1),
            self._tables,
            self._gates,
            f4(error_m),
            z_m.reshape(-1),
            reason.reshape(-1),
            strength.reshape(-1),
        )
        return Decoded(z_m, reason, strength)

    @cached_property
    def _geometry(self) -> np.ndarray:
        """(3, n) float32: emitter offset along the ray (m), emitter offset squared (m^2), cosine to the axis."""
        emitter = self.camera.emitter_position_m
        rays = np.concatenate([self.slopes, np.ones((*self.slopes.shape[:2], 1))], axis=-1)
        length = np.linalg.norm(rays, axis=-1)
        along = rays @ emitter / length
        return np.stack([along, np.full_like(along, emitter @ emitter), 1 / length]).reshape(3, -1).astype(f4)

    @cached_property
    def _tables(self) -> tuple[np.ndarray, np.ndarray, int, int, np.ndarray, np.ndarray, np.ndarray]:
        return self.unwrap.for_kernel()

    @cached_property
    def _gates(self) -> tuple[np.float32, ...]:
        engine = self.camera.engine
        values = (
            engine.edge_threshold.value if self.config.edge_gate else np.inf,
            engine.lattice_residual_turns.value**2,
            engine.amplitude_ratio.value,
            engine.min_amplitude_units.value,
            engine.min_amplitude_sum_units.value,
            engine.min_reflectivity_units_mm2.value * MM**2,
            engine.min_range_mm.value * MM,
            engine.max_range_mm.value * MM,
            engine.output_step_mm.value * MM,
        )
        return tuple(f4(value) for value in values)


def _standard_normals(rng: np.random.Generator, shape: tuple[int, int, int]) -> np.ndarray:
    """Standard normals from the generator's raw words; one more word where the count is odd."""
    count = int(np.prod(shape))
    even = count + count % 2
    out = np.empty(even, f4)
    kernels.normals_from_bits(rng.bit_generator.random_raw(even // 2).view(np.uint32), out)
    return out[:count].reshape(shape)
