"""The continuous-wave imager: phasors to samples to filtered phasors to range, with a reason for
each invalid pixel.

Modelled: shot and read noise, the harmonics that the number of phases aliases, ambient light,
companding, saturation, fixed pattern and drift, the phase-space joint bilateral filter, unwrapping
of one to three frequencies, the engine's gates, the correction for the emitter beside the lens,
rounding, the lens's natural fall-off of light and, if the camera's file has them, its blur, stray
light, exposure control, or exposures that end early. Not modelled: dark current, motion, light that
changes during a frame, cross-talk between pixels, in-pixel rejection of ambient light, gain
switching, the coarser rounding of a sample that is scaled to the longest exposure, phase errors
that differ between frequencies (except harmonics), any further post-processing. Errors of a unit's
tables of lens, emitter and phase offsets are part of its fixed pattern and offset."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numba
import numpy as np
from scipy import ndimage, optimize, special

from harness.vocabulary.geometry import MM, SPEED_OF_LIGHT_AIR, UW_CM2, Lens, Region
from scenes.optics import NoiseFreeView
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.exposure import AmcwExposure, time_shares
from scenes.sensor.amcw.facts import (
    AmcwCamera,
    EngineFacts,
    FlyingPixelFacts,
    ScatterFacts,
    unwrap_table,
)
from scenes.sensor.amcw.windows import windows_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.common.facts import Fact
from scenes.sensor.common.normals import IN_DOUBLE, standard_normals
from scenes.sensor.common.unit import DecodedFrame, UnitModel, light_of, rays_of, smooth_field

f4 = np.float32
WIDE_PX = 1.5  # deviation from which samples of a Gaussian blur as it does, within 1 %
LEAST_UNITS = 1.0  # sum of amplitudes of a view without light
BLOCK = 512  # pixels of a block
NEVER_ZERO = 1e-300
HIGHEST_HARMONIC = 31  # higher harmonics change the phase by less than 0.1 mrad in total


def with_harmonics(signal: np.ndarray, phases: int, residual: np.ndarray) -> np.ndarray:
    """Return the signal (f, h, w) with the harmonics that N ``phases`` alias onto the fundamental,
    times ``residual`` (f,).

    Square light under square demodulation correlates to a triangle: odd harmonics n of 1/n^2. N
    equidistant samples see harmonic n as the fundamental if n = +1 mod N, and as its conjugate if
    n = -1. Approximation: a pixel that sees several paths has the harmonics of their sum, not the
    sum of their harmonics.
    """
    # the odd harmonics that are aliased lie one below and one above multiples of this
    period = phases if phases % 2 == 0 else 2 * phases
    changed = np.empty_like(signal)
    for light, share, with_them in zip(signal, residual, changed, strict=True):
        _add_harmonics(light.ravel(), share, period, with_them.ravel())
    return changed


@numba.njit(**IN_DOUBLE)
def _add_harmonics(light, share, period, changed):  # type: ignore[no-untyped-def]
    """Write ``changed`` (n,): the light (n,) of one frequency with its aliased harmonics, which lie
    one below and one above multiples of ``period``; in blocks, which stay in the processor's
    cache."""
    direction = np.empty(BLOCK, np.complex128)
    turned_by_period = np.empty(BLOCK, np.complex128)
    power = np.empty(BLOCK, np.complex128)
    factor = np.empty(BLOCK, np.complex128)
    for start in range(0, light.size, BLOCK):
        size = min(BLOCK, light.size - start)
        for i in range(size):
            of_pixel = light[start + i]
            length = np.sqrt(of_pixel.real**2 + of_pixel.imag**2)
            per_length = 1 / max(length, NEVER_ZERO)
            direction[i] = complex(of_pixel.real * per_length, of_pixel.imag * per_length)
        turned_by_period[:size] = direction[:size]
        for _ in range(period - 1):
            _multiply(turned_by_period, direction, size)
        power[:size] = 1
        factor[:size] = 1
        for centre in range(period, HIGHEST_HARMONIC, period):
            _multiply(power, turned_by_period, size)
            of_conjugate = share / (centre - 1) ** 2
            of_signal = share / (centre + 1) ** 2
            along = of_signal + of_conjugate
            across = of_signal - of_conjugate
            for i in range(size):
                factor[i] += complex(along * power[i].real, across * power[i].imag)
        for i in range(size):
            changed[start + i] = factor[i] * light[start + i]


@numba.njit(**IN_DOUBLE)
def _multiply(values, factors, n):  # type: ignore[no-untyped-def]
    """Multiply the first n complex values by their factors, in place."""
    for i in range(n):
        values[i] *= factors[i]


def scattered(image: np.ndarray, facts: ScatterFacts) -> np.ndarray:
    """Return light (..., h, w) after lens blur and stray light. Beyond the view's region, the
    light of its border continues. The fall-off of light towards the corners is assumed to be equal
    at its source and its destination."""
    share = facts.stray_share.value
    sharp = _spread(image, facts.blur_px.value)
    if share == 0:
        return sharp
    return (1 - share) * sharp + share * _spread(image, facts.stray_px.value)


def _spread(light: np.ndarray, sigma_px: float) -> np.ndarray:
    """Return light (..., h, w), averaged over pixels, after a Gaussian blur of this deviation."""
    if sigma_px == 0:
        return light
    if sigma_px >= WIDE_PX:
        blurred = ndimage.gaussian_filter(light, sigma_px, mode="nearest", axes=(-2, -1))
        return np.asarray(blurred)
    weights = blur_weights(sigma_px)
    along_rows = ndimage.correlate1d(light, weights, axis=-1, mode="nearest")
    return np.asarray(ndimage.correlate1d(along_rows, weights, axis=-2, mode="nearest"))


@lru_cache
def blur_weights(sigma_px: float) -> np.ndarray:
    """Return the weights (2 n + 1,), 0 or more and symmetric, that blur pixels most like a Gaussian
    blurs the light before pixels average it: by least squares over all places of a sharp edge.

    Samples of a narrow Gaussian do not: an edge blurred by those of 0.45 pixels looks as if blurred
    by 0.25. From `WIDE_PX` on, the two agree.
    """
    reach_px = int(np.ceil(4 * sigma_px))
    places_px = np.linspace(-reach_px - 1, reach_px + 1, 200 * (reach_px + 1) + 1)

    def sharp_edge(distance_px: np.ndarray) -> np.ndarray:
        """Light of a pixel so far behind a sharp edge."""
        return np.clip(distance_px + 0.5, 0, 1)

    def blurred_integral(distance_px: np.ndarray) -> np.ndarray:
        """Integral of the blurred edge up to this distance."""
        x = distance_px / sigma_px
        density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
        return sigma_px * (x * special.ndtr(x) + density)

    blurred = blurred_integral(places_px + 0.5) - blurred_integral(places_px - 0.5)
    sharp = sharp_edge(places_px)
    changes = []  # by a weight of 1 of the two pixels n away, which the middle one loses
    for n in range(1, reach_px + 1):
        pair = sharp_edge(places_px - n) + sharp_edge(places_px + n)
        changes.append(pair - 2 * sharp)
    outer, _ = optimize.nnls(np.stack(changes, axis=1), blurred - sharp)
    middle = 1 - 2 * outer.sum()
    return np.concatenate([outer[::-1], [middle], outer])


def pixel_spans(lens: Lens, slopes: np.ndarray) -> np.ndarray:
    """Return the area (h, w) of slopes that pixels cover at ``slopes`` (h, w, 2), relative to a
    pixel on the axis."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.distortion
    x = slopes[..., 0]
    y = slopes[..., 1]
    r2 = x**2 + y**2
    numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = numerator / denominator
    # derivatives by r^2, and twice that of the radial factor
    numerator_slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    denominator_slope = k4 + r2 * (2 * k5 + r2 * 3 * k6)
    radial_slope = 2 * (numerator_slope - radial * denominator_slope) / denominator
    # derivatives of u / fx and v / fy by the slopes
    ux = radial + x * x * radial_slope + 2 * p1 * y + 6 * p2 * x
    vy = radial + y * y * radial_slope + 6 * p1 * y + 2 * p2 * x
    uy = x * y * radial_slope + 2 * p1 * x + 2 * p2 * y
    return np.asarray(1 / np.abs(ux * vy - uy**2))


class NoisyLight(NamedTuple):
    """Light of n pixels with noise, before the filter."""

    unit: np.ndarray
    """(2, f, n) float32: real and imaginary parts of unit phasors."""
    amplitude: np.ndarray
    """(f, n) float32: amplitudes times the gains; `kernels.OUTSIDE` where saturated."""
    saturated: np.ndarray
    """(n,) uint8: 1 where a sample is saturated."""


class AmcwImager(UnitModel[AmcwCamera]):
    """A camera of this kind on a region of its sensor: `expose` once per view, then `frame` for
    each exposure."""

    def __init__(
        self, camera: AmcwCamera, config: CameraConfig, region: Region, slopes: np.ndarray
    ) -> None:
        super().__init__(camera, config, region, slopes)
        phases = camera.modulation.phases.value
        self._phase_steps = 2 * np.pi * np.arange(phases) / phases
        self.gains = np.array(camera.engine.amplitude_gains.value, f4)
        self.unwrap = unwrap_table(camera.frequencies_hz, camera.engine.fusion.value)

    @cached_property
    def outside_mask(self) -> np.ndarray:
        """Return (h, w) bool: pixels that look beyond the lens's image or the illuminated polygon,
        if there is one."""
        x = self.slopes[..., 0]
        y = self.slopes[..., 1]
        outside = self.camera.lens.outside_field(self.region)
        if self.camera.emitter.mask_slopes is not None:
            corners = np.array(self.camera.emitter.mask_slopes.value)
            next_corners = np.roll(corners, -1, axis=0)
            for (x0, y0), (x1, y1) in zip(corners, next_corners, strict=True):
                outside |= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) < 0
        return outside

    @cached_property
    def gathered(self) -> np.ndarray:
        """Light (h, w) that a pixel gathers from a surface of given radiance, relative to the
        axis: |d slopes / d pixel| cos^4. Not modelled: mechanical vignetting, and growth of the
        pupil with angle."""
        x = self.slopes[..., 0]
        y = self.slopes[..., 1]
        spans = pixel_spans(self.camera.nominal_lens, self.slopes)
        return np.asarray(spans / (1 + (x * x + y * y)) ** 2)

    def pattern_mm(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """Draw smooth and pixel-wise range errors, before the filter."""
        facts = self.camera.fixed_pattern
        smooth, pixel = rng.standard_normal((2, *shape), dtype=f4)
        field = smooth_field(smooth, facts.smooth_length_px.value)
        return facts.smooth_mm.value * field + facts.pixel_mm.value * pixel

    def expose(self, view: NoiseFreeView) -> AmcwExposure:
        """Return the noise-free samples of a view that covers this imager's region."""
        effects = self.config.effects
        photons = self.camera.photons
        phasor, intensity = light_of(self._scattered(view), effects)
        electrons = photons.signal_electrons.value * self.gathered
        signal = self._demodulated(phasor, electrons)
        both_wells = electrons * intensity + self.ambient_electrons(view, intensity)
        time_share = self._time_shares(signal, both_wells)
        scaled_share = time_share
        if self.camera.exposures is not None and self.camera.exposures.for_frame:
            # these samples are not scaled: the engine sees the amplitudes of the shorter exposure
            signal = signal * time_share
            both_wells = both_wells * time_share
            scaled_share = np.ones_like(time_share)
        # shot noise of both wells, and the read noise of each
        read_noise = photons.read_noise_electrons.value / scaled_share
        variance = both_wells / scaled_share + 2 * read_noise**2
        sigma = np.sqrt(variance) if effects.noise else np.zeros_like(variance)
        limit = self._largest_sample(both_wells, scaled_share)
        per_unit = photons.electrons_per_unit.value
        return AmcwExposure(
            means=self._samples(signal / per_unit),
            sigma=(sigma / per_unit).ravel().astype(f4),
            limit=limit.ravel().astype(f4),
            time_share=time_share.ravel().astype(f4),
            shape=intensity.shape,
        )

    def _scattered(self, view: NoiseFreeView) -> NoiseFreeView:
        """Return a view after lens blur and stray light, whose phasors of all light and of direct
        light are so changed only where `light_of` takes them."""
        facts = self.camera.scatter
        if facts is None:
            return view
        intensity = scattered(view.intensity, facts)
        if self.config.effects.multipath:
            return replace(view, phasor=scattered(view.phasor, facts), intensity=intensity)
        direct = scattered(view.phasor_direct, facts)
        return replace(view, phasor_direct=direct, intensity=intensity)

    def _time_shares(self, signal: np.ndarray, both_wells: np.ndarray) -> np.ndarray:
        """Return the exposure times (h, w) over the longest, in which the demodulated signal is
        ``signal`` (f, h, w) and both wells collect ``both_wells`` (h, w) electrons."""
        photons = self.camera.photons
        if photons.exposure_ends_electrons is not None:
            ends = photons.exposure_ends_electrons.value
            return np.minimum(1.0, ends / np.maximum(both_wells, 1e-9))
        if self.camera.exposures is None:
            return np.ones_like(both_wells)
        largest = np.abs(signal).max(axis=0)
        full_scale = self.camera.converter.full_scale_units.value
        fullness = largest / (photons.electrons_per_unit.value * full_scale)
        if photons.full_well_electrons is not None:
            # the fuller well holds half of both wells' electrons and half the sample
            fuller_well = (both_wells + largest) / 2
            fullness = np.maximum(fullness, fuller_well / photons.full_well_electrons.value)
        return time_shares(self.camera.exposures, fullness)

    def _demodulated(self, phasor: np.ndarray, electrons: np.ndarray) -> np.ndarray:
        """Return the demodulated signal (f, h, w) in electrons of light ``phasor`` (f, h, w), with
        the errors that all frames share."""
        modulation = self.camera.modulation
        contrast = np.array(modulation.contrast.value)[:, None, None]
        frequencies_hz = np.array(self.camera.frequencies_hz)[:, None, None]
        # range errors that all frames share act as a delay of the light
        turns = frequencies_hz * (2 * self.static_error_m / SPEED_OF_LIGHT_AIR)
        # far below one turn: their rounding moves the range by less than 1e-8 m
        angles = (2 * np.pi * turns).astype(f4)
        delay = np.empty(phasor.shape, complex)
        delay.real = np.cos(angles)
        delay.imag = np.sin(angles)
        signal = phasor * delay * (contrast * electrons)
        if not self.config.effects.wiggling:
            return signal
        residual = np.array(modulation.wiggling_residual.value)
        return with_harmonics(signal, modulation.phases.value, residual)

    def _samples(self, signal: np.ndarray) -> np.ndarray:
        """Return the samples (f, k, n) float32: Re(S exp(-2 pi i j / k)) of the demodulated signal
        S (f, h, w) in converter units, at phase steps j = 0 .. k - 1."""
        flat = signal.reshape(len(signal), -1)
        samples = np.empty((len(signal), len(self._phase_steps), flat.shape[1]), f4)
        for k, step in enumerate(self._phase_steps):
            samples[:, k] = flat.real * np.cos(step) + flat.imag * np.sin(step)
        return samples

    def _largest_sample(self, both_wells: np.ndarray, scaled_share: np.ndarray) -> np.ndarray:
        """Return the largest sample (h, w) that fits, in converter units; infinite if saturation
        is off.

        Args:
            both_wells: (h, w), electrons of the exposure to which samples are scaled.
            scaled_share: (h, w), the exposure in which they are taken over that one; samples are
                scaled after conversion."""
        if not self.config.effects.saturation:
            return np.full(both_wells.shape, np.inf)
        photons = self.camera.photons
        limit = self.camera.converter.full_scale_units.value / scaled_share
        if photons.full_well_electrons is None:
            return np.asarray(limit)
        # the fuller well holds half of both wells' electrons and half the sample
        room = 2 * photons.full_well_electrons.value / scaled_share - both_wells
        return np.clip(room / photons.electrons_per_unit.value, 0, limit)

    def ambient_electrons(self, view: NoiseFreeView, intensity: np.ndarray) -> np.ndarray:
        """Return the electrons (h, w) of ambient light in both wells of one exposure: those of the
        emitter times the ratio of irradiances within the filter's band, for equal incidence; at
        edges, those of the nearest surface."""
        config = self.config
        photons = self.camera.photons
        if not config.effects.ambient:
            return np.zeros(intensity.shape)
        irradiance = config.ambient_uw_cm2_nm * UW_CM2 * photons.band_nm.value
        emitter_irradiance = self.camera.emitter.irradiance_w_m2.value
        at_one_metre = photons.signal_electrons.value * irradiance / emitter_irradiance
        finite_m = np.where(np.isfinite(view.range_m), view.range_m, np.inf)
        nearest_m = ndimage.minimum_filter(finite_m, 3, mode="nearest")
        nearest_m = np.where(np.isfinite(nearest_m), nearest_m, 0.0)
        range_m = np.where(view.coverage < 1, nearest_m, np.nan_to_num(view.range_m))
        return np.asarray(at_one_metre * self.gathered * intensity * range_m**2)

    def jitter_mm(self, exposure: AmcwExposure) -> float:
        """Return the deviation of a frame's displacement. Where the file states at which sum of
        amplitudes it has that jitter, the jitter is inversely proportional to the median over the
        view's pixels, as an offset that all samples of a frame share turns phasors by an angle that
        is inversely proportional to their length.

        Not modelled: such an offset moves near and far pixels differently, even in opposite
        directions; the whole frame is displaced."""
        unit = self.camera.unit
        if unit.jitter_at_units is None:
            return unit.jitter_mm.value
        # a view that is too dark to have ranges counts as one that barely has them
        faintest = max(self.camera.engine.min_amplitude_sum_units.value, LEAST_UNITS)
        median = float(np.median(self.amplitude_sums(exposure)))
        return unit.jitter_mm.value * unit.jitter_at_units.value / max(median, faintest)

    def amplitude_sums(self, exposure: AmcwExposure) -> np.ndarray:
        """Return each pixel's sum (n,) of amplitudes over the frequencies, without noise and before
        the filter, in converter units."""
        cosines = np.cos(self._phase_steps)
        sines = np.sin(self._phase_steps)
        re = np.einsum("fkn,k->fn", exposure.means, cosines)
        im = np.einsum("fkn,k->fn", exposure.means, sines)
        amplitudes = self.gains[:, None] * np.sqrt(re * re + im * im) * 2 / len(cosines)
        return np.asarray(amplitudes.sum(axis=0))

    def frame(
        self, exposure: AmcwExposure, rng: np.random.Generator, error_m: float = 0.0
    ) -> DecodedFrame:
        """Draw a frame with noise from ``rng`` on the samples, then run the engine. ``error_m``
        displaces the frame."""
        shape = exposure.shape
        reading = self.reading(exposure, rng)
        filtered, edge = self.filter(reading.unit, reading.amplitude, shape)
        n_frequencies = len(filtered)
        decoded = self.decode(
            filtered=filtered.reshape(n_frequencies, 3, -1),
            edge=edge.reshape(n_frequencies, -1),
            saturated=reading.saturated,
            engine=self.engine,
            neighbours=self._neighbours,
            error_m=error_m,
        )
        return DecodedFrame(
            z_m=decoded.z_m.reshape(shape),
            reason=decoded.reason.reshape(shape),
            amplitude=decoded.amplitude.reshape(shape),
        )

    def reading(self, exposure: AmcwExposure, rng: np.random.Generator) -> NoisyLight:
        """Draw a noisy reading of an exposure."""
        n_frequencies, _, n = exposure.means.shape
        unit = np.empty((2, n_frequencies, n), f4)
        amplitude = np.empty((n_frequencies, n), f4)
        saturated = np.empty(n, np.uint8)
        kernels.expose(
            exposure.means,
            exposure.sigma,
            exposure.limit,
            standard_normals(rng, exposure.means.shape),
            f4(self.camera.converter.knee_units.value),
            self.gains,
            np.cos(self._phase_steps).astype(f4),
            np.sin(self._phase_steps).astype(f4),
            unit,
            amplitude,
            saturated,
        )
        return NoisyLight(unit, amplitude, saturated)

    def filter(
        self, unit: np.ndarray, amplitude: np.ndarray, shape: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Apply the engine's joint bilateral filter: (f, 3, h, w), and edge sums (f, h, w)."""
        filtered = np.empty((len(amplitude), 3, *shape), f4)
        edge = np.empty((len(amplitude), *shape), f4)
        for f in range(len(amplitude)):
            planes = unit[:, f].reshape(2, *shape)
            strength = amplitude[f].reshape(shape)
            kernels.filter_image(planes, strength, self.filter_settings, filtered[f], edge[f])
        return filtered, edge

    def decode(
        self,
        filtered: np.ndarray,
        edge: np.ndarray,
        saturated: np.ndarray,
        engine: ranging.DepthEngine,
        neighbours: np.ndarray,
        error_m: float,
    ) -> DecodedFrame:
        """Unwrap, correct, gate and round: the remaining steps of the depth engine.

        Args:
            filtered: (f, 3, n) float32, real and imaginary part and amplitude.
            edge: (f, n) float32, edge sums.
            saturated: (n,) uint8.
            engine: the engine of these pixels.
            neighbours: (n, 9) int32, indices of each pixel's neighbours and itself, -1 for none.
            error_m: displacement of the frame.

        Returns:
            A frame of n pixels (n,).
        """
        z_m, reason, total = ranging.ranges_of(filtered, edge, saturated, engine, error_m)
        if engine.flying is not None:
            flying = ranging.find_flying(z_m, total, reason, neighbours, engine.flying)
            reason[flying] = ranging.EDGE
        ranging.round_valid(z_m, reason, f4(self.camera.z_step_m))
        return DecodedFrame(z_m, reason, total / f4(len(filtered)))

    @cached_property
    def _neighbours(self) -> np.ndarray:
        """Return (n, 9) int32: the pixels of windows of 3 x 3, -1 beyond the region's border."""
        h, w = self.region.shape
        numbers = np.arange(h * w, dtype=np.int32).reshape(h, w)
        return np.ascontiguousarray(windows_of(numbers, 3, -1, np.arange(h * w)))

    @cached_property
    def filter_settings(self) -> kernels.FilterSettings:
        """The filter's settings in float32."""
        engine = self.camera.engine
        half = engine.window_px.value // 2
        sigma_px = engine.spatial_sigma_px
        twice_variance = 2 * sigma_px.value**2 if sigma_px else np.inf
        taps = np.exp(-(np.arange(-half, half + 1) ** 2) / twice_variance)
        return kernels.FilterSettings(
            space=np.outer(taps, taps).astype(f4),
            concentration=f4(engine.concentration.value),
            dim=f4(engine.dim_amplitude_units.value),
            drop_dim=engine.drop_dim_neighbours.value,
            dim_edges=engine.edges_to_dim.value,
            by_amplitude=engine.filter_on.value == "phasors",
        )

    @cached_property
    def engine(self) -> ranging.DepthEngine:
        """The engine's steps after the filter."""
        emitter_m = self.camera.optics.emitter_m
        along_m, cosine = rays_of(self.slopes, emitter_m)
        geometry = np.stack([along_m, np.full_like(along_m, emitter_m @ emitter_m), cosine])
        return ranging.DepthEngine(
            geometry=geometry.reshape(3, -1).astype(f4),
            outside_mask=self.outside_mask.reshape(-1),
            lattice=self.unwrap,
            gates=_gates(self.camera.engine, self.config.edge_gate),
            flying=_flying_gate(self.camera.engine.flying_pixels),
        )


def _gates(facts: EngineFacts, edge_gate: bool) -> ranging.Gates:
    """Return the gates of single pixels; those that the camera lacks let everything pass."""
    by_amplitude = facts.residual_by_amplitude
    greatest_turns = by_amplitude.greatest_turns if by_amplitude else None
    scale_turns = by_amplitude.scale_turns if by_amplitude else None
    slope = by_amplitude.slope if by_amplitude else None
    return ranging.Gates(
        edge=_limit(facts.edge_threshold if edge_gate else None, np.inf),
        edge_mean=f4(facts.edges_in.value == "mean"),
        residual=_limit(facts.lattice_residual_turns, np.inf),
        residual_most=_limit(greatest_turns, np.inf),
        residual_scale=_limit(scale_turns, 0.0),
        residual_slope=_limit(slope, 0.0),
        ratio=_limit(facts.amplitude_ratio, np.inf),
        least=f4(facts.min_amplitude_units.value),
        total=f4(facts.min_amplitude_sum_units.value),
        reflectivity=_limit(facts.min_reflectivity_units_mm2, 0.0, MM**2),
        nearest_m=f4(facts.min_range_mm.value * MM),
        farthest_m=f4(facts.max_range_mm.value * MM),
        axial=f4(facts.limits_along.value == "axis"),
    )


def _limit(fact: Fact[float] | None, without: float, unit: float = 1.0) -> np.float32:
    """Return a fact's value in float32, or that of a gate that the camera lacks."""
    return f4(without if fact is None else fact.value * unit)


def _flying_gate(facts: FlyingPixelFacts | None) -> ranging.FlyingGate | None:
    """Return the gate on the finished image, if the camera has one."""
    if facts is None:
        return None
    return ranging.FlyingGate(
        relative_deviation=f4(facts.relative_deviation.value),
        least_mean=f4(facts.least_mean_units.value),
        near_m=f4(facts.near_mm.value * MM),
        far_m=f4(facts.far_mm.value * MM),
        most_m=f4(facts.most_mm.value * MM),
    )
