"""The continuous-wave imager: phasors to samples to filtered phasors to range, with a reason for each invalid pixel.

One model for every camera of its kind; what tells them apart is data (`scenes.sensor.amcw.facts`).
Modelled: shot and read noise on the samples, harmonics, ambient light, companding, saturation, fixed pattern and drift,
the phase-space joint bilateral filter, unwrapping of one to three frequencies, the engine's gates, the correction for
the emitter beside the lens, rounding; the lens' natural fall-off of light towards the edge of the image.
Not modelled: lens blur and stray light beyond the pixel's own footprint, motion, cross-talk between pixels, per-pixel
gain switching, errors of phase that differ between frequencies other than harmonics, and any post-processing beyond
this. Real engines keep tables of each unit's lens, emitter and phase offsets; here they are exact, and what such tables
leave is the fixed pattern and the unit's offset.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np

from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from harness.vocabulary.units import MM
from scenes.sensor.amcw import kernels, ranging
from scenes.sensor.amcw.at_once import AtOnce, at_once, windows_of
from scenes.sensor.amcw.certainty import DepthEngine
from scenes.sensor.amcw.exposure import AmcwExposure, exposure_of
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.amcw.linear import FilterWindow
from scenes.sensor.amcw.unwrap import UnwrapTable, unwrap_table
from scenes.sensor.camera import CameraConfig
from scenes.sensor.frames import DecodedFrame
from scenes.sensor.normals import standard_normals
from scenes.sensor.unit import smooth_field, unit_error_m
from scenes.view import NoiseFreeView

f4 = np.float32


class AmcwImager:
    """A camera of this kind on a region of its sensor: `expose` once per view, then `frame` for each exposure."""

    def __init__(self, camera: AmcwCamera, config: CameraConfig, region: Region, slopes: np.ndarray) -> None:
        self.camera = camera
        self.config = config
        self.region = region
        self.slopes = slopes
        phases = 2 * np.pi * np.arange(camera.modulation.phases.value) / camera.modulation.phases.value
        self._cosines = np.cos(phases).astype(f4)
        self._sines = np.sin(phases).astype(f4)
        self.gains = np.array(camera.engine.amplitude_gains.value, f4)

    @cached_property
    def unwrap(self) -> UnwrapTable:
        """The unwrapping tables of this camera's frequencies."""
        return unwrap_table(self.camera.frequencies_hz, self.camera.engine.fusion.value)

    @cached_property
    def outside_mask(self) -> np.ndarray:
        """(h, w) bool: pixels that look beyond the illuminated polygon, if the camera has one."""
        x, y = self.slopes[..., 0], self.slopes[..., 1]
        outside = np.zeros(x.shape, bool)
        if self.camera.emitter.mask_slopes is None:
            return outside
        corners = np.array(self.camera.emitter.mask_slopes.value)
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
        smooth = smooth_field(smooth, facts.smooth_length_px.value)
        field = (facts.smooth_mm.value * smooth + facts.pixel_mm.value * pixel) * MM * self.config.fixed_pattern_scale
        return field[self.region.within(lens.whole)]

    @cached_property
    def static_error_m(self) -> np.ndarray:
        """(h, w): all errors of range that frames of this unit share before the filter, as far as they are on."""
        error = unit_error_m(self.camera, self.config, self.slopes[..., 0])
        return np.asarray(error + self.fixed_pattern_m if self.config.effects.fixed_pattern else error)

    def expose(self, view: NoiseFreeView) -> AmcwExposure:
        """Return the noise-free samples of a view that covers this imager's region."""
        return exposure_of(self.camera, self.config, view, self.gathered, self.static_error_m)

    def frame(self, exposure: AmcwExposure, rng: np.random.Generator, error_m: float = 0.0) -> DecodedFrame:
        """Draw a frame: noise from ``rng`` on the samples, then the depth engine; ``error_m`` displaces the frame."""
        unit, amplitude, saturated = self.phasors(exposure, rng)
        return self._decode(*self.filter(unit, amplitude, exposure.shape), saturated, error_m)

    def phasors(self, exposure: AmcwExposure, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw a noisy reading: unit phasors (2, f, n), amplitudes (f, n) times the gains, saturated (n,) uint8."""
        n_frequencies, _, n = exposure.means.shape
        unit = np.empty((2, n_frequencies, n), f4)
        amplitude = np.empty((n_frequencies, n), f4)
        saturated = np.empty(n, np.uint8)
        normals, knee = standard_normals(rng, exposure.means.shape), f4(self.camera.converter.knee_units.value)
        kernels.expose(
            exposure.means, exposure.sigma, exposure.limit, normals, knee, self.gains, self._cosines, self._sines,
            unit, amplitude, saturated,
        )  # fmt: skip
        return unit, amplitude, saturated

    def filter(self, unit: np.ndarray, amplitude: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Filter by the engine's joint bilateral filter: phasors and amplitudes (f, 3, h, w), and edge sums (f, h,
        w)."""
        filtered = np.empty((len(amplitude), 3, *shape), f4)
        edge = np.empty((len(amplitude), *shape), f4)
        space, settings = self.filter_settings
        for f in range(len(amplitude)):
            planes, strength = unit[:, f].reshape(2, *shape), amplitude[f].reshape(shape)
            kernels.filter_image(planes, strength, space, settings, filtered[f], edge[f])
        return filtered, edge

    def _decode(self, filtered: np.ndarray, edge: np.ndarray, saturated: np.ndarray, error_m: float) -> DecodedFrame:
        """Unwrap, correct, gate and round: the rest of the depth engine."""
        (n_frequencies, _, *shape), n, engine = filtered.shape, saturated.size, self.engine
        z_m, total, reason = np.empty((n, 1), f4), np.empty((n, 1), f4), np.empty((n, 1), np.uint8)
        ranging.range_and_gates(
            filtered.reshape(n_frequencies, 3, -1), edge.reshape(n_frequencies, -1), saturated, engine.geometry,
            engine.outside_mask, engine.lattice, engine.gates, np.full(n, error_m, f4), z_m[:, 0], reason[:, 0],
            total[:, 0],
        )  # fmt: skip
        if engine.flying:
            flying = np.empty((n, 1), bool)
            ranging.find_flying(z_m, total, reason, np.arange(n), self._near, engine.flying, flying)
            reason[flying] = ranging.EDGE
        ranging.round_valid(z_m[:, 0], reason[:, 0], f4(self.camera.z_step_m))
        return DecodedFrame(z_m.reshape(shape), reason.reshape(shape), total.reshape(shape) / f4(n_frequencies))

    @cached_property
    def _near(self) -> np.ndarray:
        """(n, 9) int32: each pixel's neighbours and itself, -1 beyond the region's border."""
        h, w = self.region.shape
        return np.ascontiguousarray(windows_of(np.arange(h * w, dtype=np.int32).reshape(h, w), 3, -1))

    @cached_property
    def filter_settings(self) -> tuple[np.ndarray, kernels.FilterSettings]:
        """The filter's weights by distance (k, k) float32, and its settings."""
        engine = self.camera.engine
        half = engine.window_px.value // 2
        space = np.ones((2 * half + 1, 2 * half + 1), f4)
        if engine.spatial_sigma_px is not None:
            gauss = np.exp(-(np.arange(-half, half + 1) ** 2) / (2 * engine.spatial_sigma_px.value**2))
            space = np.outer(gauss, gauss).astype(f4)
        return space, kernels.FilterSettings(
            f4(engine.concentration.value),
            f4(engine.dim_amplitude_units.value),
            engine.drop_dim_neighbours.value,
            engine.filter_on.value == "phasors",
        )

    @cached_property
    def engine(self) -> DepthEngine:
        """Everything that decides after the filter."""
        facts, emitter = self.camera.engine, self.camera.emitter_position_m
        # emitter offset along the ray (m), emitter offset squared (m^2), cosine to the axis
        rays = np.concatenate([self.slopes, np.ones((*self.slopes.shape[:2], 1))], axis=-1)
        length = np.linalg.norm(rays, axis=-1)
        along = rays @ emitter / length
        geometry = np.stack([along, np.full_like(along, emitter @ emitter), 1 / length]).reshape(3, -1).astype(f4)
        edge, lattice, by_amplitude = facts.edge_threshold, facts.lattice_residual_turns, facts.residual_by_amplitude
        gates = ranging.Gates(
            edge=f4(edge.value if edge and self.config.edge_gate else np.inf),
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
            flying = ranging.FlyingGate(f4(fly.relative_deviation.value), f4(fly.least_mean_units.value), *lengths_m)
        return DepthEngine(geometry, self.outside_mask.reshape(-1), self.unwrap.for_kernel, gates, flying)

    @cached_property
    def linear_window(self) -> FilterWindow:
        """The filter, as `scenes.sensor.amcw.linear` takes it."""
        weights, settings = self.filter_settings
        space = weights.astype(float)
        concentration, dim = float(settings.concentration), float(settings.dim)
        return FilterWindow(space, space.ravel(), concentration, dim, settings.drop_dim, settings.by_amplitude)

    def at_once(self, exposure: AmcwExposure, asked: np.ndarray) -> AtOnce | None:
        """Return what sums frames of an exposure without drawing each, at the pixels ``asked`` (h, w) bool; None where
        only frames will do."""
        return at_once(self, exposure, asked)
