"""The continuous-wave imager: phasors to samples to filtered phasors to range, with a reason for
each invalid pixel.

Modelled: shot and read noise, the harmonics that the number of phases aliases, ambient light,
companding, saturation, fixed pattern and drift, the phase-space joint bilateral filter, unwrapping
of one to three frequencies, the engine's gates, the correction for the emitter beside the lens,
rounding, the lens's natural fall-off of light and, if the camera's file has them, its blur, stray
light and exposures that end early. Not modelled: dark current, motion, light that changes during a
frame, cross-talk between pixels, in-pixel rejection of ambient light, gain switching, the steps in
which exposures end, phase errors that differ between frequencies (except harmonics), any further
post-processing. Errors of a unit's tables of lens, emitter and phase offsets are part of its fixed
pattern and offset."""

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import MM, SPEED_OF_LIGHT_AIR, UW_CM2, Lens, Region
from scenes.optics import NoiseFreeView
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.at_once import windows_of
from scenes.sensor.amcw.facts import AmcwCamera, ScatterFacts, unwrap_table
from scenes.sensor.camera import CameraConfig
from scenes.sensor.normals import standard_normals
from scenes.sensor.unit import DecodedFrame, UnitModel, light_of, rays_of, smooth_field

f4 = np.float32
HIGHEST_HARMONIC = 31  # higher harmonics change the phase by less than 0.1 mrad in total


class AmcwExposure(NamedTuple):
    """Light of a view at the converter, before noise, in converter units, flat over n = h w
    pixels.

    ``means`` (f, k, n): noise-free samples. ``sigma`` (n,): deviation of each sample. ``limit``
    (n,): the largest sample that wells and converter hold; infinite if saturation is off.
    ``shape``: (h, w)."""

    means: np.ndarray
    sigma: np.ndarray
    limit: np.ndarray
    shape: tuple[int, int]


def with_harmonics(signal: np.ndarray, phases: int, residual: np.ndarray) -> np.ndarray:
    """Return the signal (f, h, w) with the harmonics that N ``phases`` alias onto the fundamental,
    times ``residual`` (f,). Square light under square demodulation correlates to a triangle: odd
    harmonics n of 1/n^2. N equidistant samples see harmonic n as the fundamental if n = +1 mod N,
    and as its conjugate if n = -1. Approximation: a pixel that sees several paths has the
    harmonics of their sum, not the sum of their harmonics."""
    apart = phases if phases % 2 == 0 else 2 * phases
    changed = np.ones_like(signal)
    # frequency by frequency, so that all stays in the processor's cache
    for light, share, out in zip(signal, residual, changed, strict=True):
        direction = light / np.maximum(np.abs(light), 1e-300)
        wave = direction.copy()
        power = np.ones_like(light)
        for _ in range(apart - 1):
            wave *= direction
        for centre in range(apart, HIGHEST_HARMONIC, apart):
            power *= wave
            of_conjugate = share / (centre - 1) ** 2
            of_signal = share / (centre + 1) ** 2
            out.real += (of_signal + of_conjugate) * power.real
            out.imag += (of_signal - of_conjugate) * power.imag
        out *= light
    return changed


def scattered(image: np.ndarray, facts: ScatterFacts) -> np.ndarray:
    """Return light (..., h, w) after lens blur and stray light. Beyond the view's region, the
    light of its border continues. The fall-off of light towards the corners is assumed to be equal
    at its source and its destination."""
    share = facts.stray_share.value

    def spread(light: np.ndarray, sigma_px: float) -> np.ndarray:
        return (
            ndimage.gaussian_filter(light, sigma_px, mode="nearest", axes=(-2, -1))
            if sigma_px > 0
            else light
        )

    sharp = spread(image, facts.blur_px.value)
    return (1 - share) * sharp + share * spread(image, facts.stray_px.value) if share > 0 else sharp


def pixel_spans(lens: Lens, slopes: np.ndarray) -> np.ndarray:
    """Return the area (h, w) of slopes that pixels cover at ``slopes`` (h, w, 2), relative to a
    pixel on the axis."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens.distortion
    x = slopes[..., 0]
    y = slopes[..., 1]
    r2 = x**2 + y**2
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    # twice the radial factor's derivative by r^2
    grows = (
        2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / below
    )
    # derivatives of u / fx and v / fy by the slopes
    ux = radial + x * x * grows + 2 * p1 * y + 6 * p2 * x
    vy = radial + y * y * grows + 6 * p1 * y + 2 * p2 * x
    both = x * y * grows + 2 * p1 * x + 2 * p2 * y
    return np.asarray(1 / np.abs(ux * vy - both**2))


class AmcwImager(UnitModel[AmcwCamera]):
    """A camera of this kind on a region of its sensor: `expose` once per view, then `frame` for
    each exposure."""

    def __init__(
        self, camera: AmcwCamera, config: CameraConfig, region: Region, slopes: np.ndarray
    ) -> None:
        super().__init__(camera, config, region, slopes)
        phases = (
            2 * np.pi * np.arange(camera.modulation.phases.value) / camera.modulation.phases.value
        )
        self._waves = np.cos(phases).astype(f4), np.sin(phases).astype(f4)
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
            for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                outside |= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) < 0
        return outside

    @cached_property
    def gathered(self) -> np.ndarray:
        """Light (h, w) that a pixel gathers from a surface of given radiance, relative to the
        axis: |d slopes / d pixel| cos^4. Not modelled: mechanical vignetting, and growth of the
        pupil with angle."""
        return (
            pixel_spans(self.camera.nominal_lens, self.slopes)
            / (1 + (self.slopes**2).sum(axis=-1)) ** 2
        )

    def pattern_mm(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """Draw smooth and pixel-wise range errors, before the filter."""
        facts = self.camera.fixed_pattern
        smooth, pixel = rng.standard_normal((2, *shape), dtype=f4)
        return (
            facts.smooth_mm.value * smooth_field(smooth, facts.smooth_length_px.value)
            + facts.pixel_mm.value * pixel
        )

    def expose(self, view: NoiseFreeView) -> AmcwExposure:
        """Return the noise-free samples of a view that covers this imager's region."""
        if self.camera.scatter is not None:
            light = (view.phasor, view.phasor_direct, view.intensity)
            facts = self.camera.scatter
            phasor, direct, intensity = (scattered(image, facts) for image in light)
            view = replace(view, phasor=phasor, phasor_direct=direct, intensity=intensity)
        camera = self.camera
        photons = self.camera.photons
        phases = self.camera.modulation.phases.value
        phasor, intensity = light_of(view, self.config.effects)
        electrons = photons.signal_electrons.value * self.gathered
        contrast = np.array(camera.modulation.contrast.value)[:, None, None]
        # range errors that all frames share act as a delay of the light
        turns = np.array(camera.frequencies_hz)[:, None, None] * (
            2 * self.static_error_m / SPEED_OF_LIGHT_AIR
        )
        delay = np.empty(phasor.shape, complex)
        delay.real, delay.imag = np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)
        signal = phasor * delay * (contrast * electrons)
        if self.config.effects.wiggling:
            signal = with_harmonics(
                signal, phases, np.array(camera.modulation.wiggling_residual.value)
            )
        both_wells = electrons * intensity + self.ambient_electrons(view, intensity)
        # an exposure that ends early is scaled to the full length, with its noise
        share = 1.0
        if photons.exposure_ends_electrons is not None:
            share = np.minimum(
                1.0, photons.exposure_ends_electrons.value / np.maximum(both_wells, 1e-9)
            )
        variance = both_wells / share + 2 * (photons.read_noise_electrons.value / share) ** 2
        sigma = np.sqrt(variance) if self.config.effects.noise else np.zeros_like(variance)
        # the samples Re(S exp(-2 pi j k / N)) of the demodulated signal S (f, h, w) at N phases
        samples = np.empty((len(signal), phases, both_wells.size), f4)
        units = (signal / photons.electrons_per_unit.value).reshape(len(signal), -1)
        for k, step in enumerate(2 * np.pi * np.arange(phases) / phases):
            samples[:, k] = units.real * np.cos(step) + units.imag * np.sin(step)
        # the largest sample that fits: the fuller well holds half of both wells' electrons and
        # half the sample
        limit = np.full(both_wells.shape, np.inf)
        if self.config.effects.saturation:
            limit = np.full(both_wells.shape, float(camera.converter.full_scale_units.value))
            if photons.full_well_electrons is not None:
                room = 2 * photons.full_well_electrons.value / share - both_wells
                limit = np.clip(room / photons.electrons_per_unit.value, 0, limit)
        return AmcwExposure(
            samples,
            (sigma / photons.electrons_per_unit.value).ravel().astype(f4),
            limit.ravel().astype(f4),
            intensity.shape,
        )

    def ambient_electrons(self, view: NoiseFreeView, intensity: np.ndarray) -> np.ndarray:
        """Return the electrons (h, w) of ambient light in both wells of one exposure: those of the
        emitter times the ratio of irradiances within the filter's band, for equal incidence; at
        edges, those of the nearest surface."""
        config = self.config
        photons = self.camera.photons
        if not config.effects.ambient:
            return np.zeros(intensity.shape)
        irradiance = config.ambient_uw_cm2_nm * UW_CM2 * photons.band_nm.value
        one_metre = (
            photons.signal_electrons.value * irradiance / self.camera.emitter.irradiance_w_m2.value
        )
        nearest_m = ndimage.minimum_filter(
            np.where(np.isfinite(view.range_m), view.range_m, np.inf), 3, mode="nearest"
        )
        nearest_m = np.where(np.isfinite(nearest_m), nearest_m, 0.0)
        range_m = np.where(view.coverage < 1, nearest_m, np.nan_to_num(view.range_m))
        return np.asarray(one_metre * self.gathered * intensity * range_m**2)

    def frame(
        self, exposure: AmcwExposure, rng: np.random.Generator, error_m: float = 0.0
    ) -> DecodedFrame:
        """Draw a frame with noise from ``rng`` on the samples, then run the engine. ``error_m``
        displaces the frame."""
        unit, amplitude, saturated = self.phasors(exposure, rng)
        return self._decode(*self.filter(unit, amplitude, exposure.shape), saturated, error_m)

    def phasors(
        self, exposure: AmcwExposure, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw a noisy reading: unit phasors (2, f, n), amplitudes (f, n) times the gains,
        saturated (n,) uint8."""
        n_frequencies, _, n = exposure.means.shape
        unit = np.empty((2, n_frequencies, n), f4)
        amplitude = np.empty((n_frequencies, n), f4)
        saturated = np.empty(n, np.uint8)
        normals = standard_normals(rng, exposure.means.shape)
        knee = f4(self.camera.converter.knee_units.value)
        kernels.expose(
            *exposure[:3], normals, knee, self.gains, *self._waves, unit, amplitude, saturated
        )
        return unit, amplitude, saturated

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

    def _decode(
        self, filtered: np.ndarray, edge: np.ndarray, saturated: np.ndarray, error_m: float
    ) -> DecodedFrame:
        """Unwrap, correct, gate and round: the remaining steps of the depth engine."""
        (n_frequencies, _, *shape), n, engine = filtered.shape, saturated.size, self.engine
        filtered = filtered.reshape(n_frequencies, 3, -1)
        edge = edge.reshape(n_frequencies, -1)
        z_m, reason, total = ranging.ranges_of(
            filtered, edge, saturated, engine, np.full(n, error_m)
        )
        if engine.flying:
            flying = np.empty((n, 1), bool)
            planes = (plane[:, None] for plane in (z_m, total, reason))
            ranging.find_flying(*planes, np.arange(n), self._near, engine.flying, flying)
            reason[flying[:, 0]] = ranging.EDGE
        ranging.round_valid(z_m, reason, f4(self.camera.z_step_m))
        return DecodedFrame(
            z_m.reshape(shape), reason.reshape(shape), total.reshape(shape) / f4(n_frequencies)
        )

    @cached_property
    def _near(self) -> np.ndarray:
        """Return (n, 9) int32: each pixel's neighbours and itself, -1 beyond the region's border."""
        h, w = self.region.shape
        return np.ascontiguousarray(
            windows_of(np.arange(h * w, dtype=np.int32).reshape(h, w), 3, -1, np.arange(h * w))
        )

    @cached_property
    def filter_settings(self) -> kernels.FilterSettings:
        """The filter's settings in float32."""
        engine = self.camera.engine
        half = engine.window_px.value // 2
        sigma_px = engine.spatial_sigma_px
        across = np.exp(
            -(np.arange(-half, half + 1) ** 2) / (2 * sigma_px.value**2 if sigma_px else np.inf)
        )
        space = np.outer(across, across).astype(f4)
        limits = f4(engine.concentration.value), f4(engine.dim_amplitude_units.value)
        by_amplitude = engine.filter_on.value == "phasors"
        rules = engine.drop_dim_neighbours.value, engine.edges_to_dim.value, by_amplitude
        return kernels.FilterSettings(space, *limits, *rules)

    @cached_property
    def engine(self) -> ranging.DepthEngine:
        """The engine's steps after the filter."""
        facts = self.camera.engine
        emitter = self.camera.optics.emitter_m
        along, cosine = rays_of(self.slopes, emitter)
        geometry = (
            np.stack([along, np.full_like(along, emitter @ emitter), cosine])
            .reshape(3, -1)
            .astype(f4)
        )
        edge = facts.edge_threshold
        lattice = facts.lattice_residual_turns
        by_amplitude = facts.residual_by_amplitude
        gates = ranging.Gates(
            edge=f4(edge.value if edge and self.config.edge_gate else np.inf),
            edge_mean=f4(facts.edges_in.value == "mean"),
            residual=f4(lattice.value if lattice else np.inf),
            residual_most=f4(by_amplitude.greatest_turns.value if by_amplitude else np.inf),
            residual_scale=f4(by_amplitude.scale_turns.value if by_amplitude else 0.0),
            residual_slope=f4(by_amplitude.slope.value if by_amplitude else 0.0),
            ratio=f4(facts.amplitude_ratio.value if facts.amplitude_ratio else np.inf),
            least=f4(facts.min_amplitude_units.value),
            total=f4(facts.min_amplitude_sum_units.value),
            reflectivity=f4((r.value if (r := facts.min_reflectivity_units_mm2) else 0.0) * MM**2),
            nearest_m=f4(facts.min_range_mm.value * MM),
            farthest_m=f4(facts.max_range_mm.value * MM),
            axial=f4(facts.limits_along.value == "axis"),
        )
        flying = None
        if (fly := facts.flying_pixels) is not None:
            lengths_m = (f4(mm.value * MM) for mm in (fly.near_mm, fly.far_mm, fly.most_mm))
            flying = ranging.FlyingGate(
                f4(fly.relative_deviation.value), f4(fly.least_mean_units.value), *lengths_m
            )
        return ranging.DepthEngine(
            geometry, self.outside_mask.reshape(-1), self.unwrap, gates, flying
        )
