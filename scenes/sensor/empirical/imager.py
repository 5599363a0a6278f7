"""Frames of an empirical camera: the ideal range of the view, with the noise that a real unit's
captures show.

Modelled: noise that grows with range and darkness as measured, its correlation between neighbours,
a fixed pattern with the measured spectrum, dropouts by amplitude, smoothed depth and missing
pixels at steps, displacements of whole frames, drift, rounding. Not modelled: light that met more
than one surface (only direct light counts), shadows of an emitter or of a second lens, the texture
that a stereo camera needs, noise shared by successive frames, and clustered dropouts. The effects
multipath, wiggling, ambient and saturation change nothing."""

from typing import NamedTuple

import numba
import numpy as np
from scipy import ndimage

from harness.vocabulary.geometry import MM, Reason, Region
from scenes.optics import NoiseFreeView, wave_numbers
from scenes.sensor.camera import CameraConfig
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.normals import FAST, standard_normals
from scenes.sensor.tabled import filtered
from scenes.sensor.unit import DecodedFrame, UnitModel

f4 = np.float32


class IdealRange(NamedTuple):
    """A view without noise, (h, w) each. ``amplitude``: in the recording's units. ``chance``: that
    of no return."""

    range_m: np.ndarray
    sigma_m: np.ndarray
    amplitude: np.ndarray
    chance: np.ndarray


class EmpiricalImager(UnitModel[EmpiricalCamera]):
    """A camera of this kind on a region of its sensor: `expose` once per view, then `frame` for
    each exposure."""

    def __init__(
        self, camera: EmpiricalCamera, config: CameraConfig, region: Region, slopes: np.ndarray
    ) -> None:
        super().__init__(camera, config, region, slopes)
        self._stretch = np.sqrt(1 + (slopes**2).sum(axis=-1)).astype(f4)
        self._filters = [
            np.asarray(taps.value, f4) for taps in (camera.noise.rows, camera.noise.columns)
        ]

    def pattern_mm(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """Draw a fixed pattern with the measured spectrum."""
        facts = self.camera.fixed_pattern
        taps = (np.asarray(each.value, f4) for each in (facts.rows, facts.columns))
        return filtered(rng.standard_normal(shape, dtype=f4), *taps) * facts.deviation_mm.value

    def _sigma_m(self, range_m: np.ndarray, brightness: np.ndarray) -> np.ndarray:
        law = self.camera.noise
        ends = np.clip(range_m, law.range_mm.value[0] * MM, law.range_mm.value[-1] * MM)
        logs = np.interp(np.log(ends / MM), np.log(law.range_mm.value), np.log(law.sigma_mm.value))
        beyond = (range_m / ends) ** law.range_exponent.value
        return np.asarray(MM * np.exp(logs) * beyond * brightness**-law.brightness_exponent.value)

    def expose(self, view: NoiseFreeView) -> IdealRange:
        """Return range, noise and probabilities of no return of a view that covers this region."""
        camera = self.camera
        direct = view.phasor_direct[0].astype(complex)
        light = np.abs(direct)
        lit = light > 0
        phase = np.mod(np.angle(direct), 2 * np.pi)
        range_m = np.where(lit, phase / wave_numbers(view.frequencies_hz)[0] / 2, np.nan)
        amplitude = light * camera.light.amplitude_at_1m.value / camera.light.albedo.value
        with np.errstate(divide="ignore", invalid="ignore"):
            brightness = np.where(
                lit, amplitude * range_m**2 / camera.light.amplitude_at_1m.value, np.nan
            )
            sigma_m = np.where(lit, self._sigma_m(range_m, brightness), 0.0)
            level = np.log(np.where(lit, amplitude, camera.dropouts.amplitude.value[0]))
        chance = np.interp(
            level, np.log(camera.dropouts.amplitude.value), camera.dropouts.share.value
        )
        if not self.config.effects.noise:
            sigma_m = chance = np.zeros(lit.shape)
        chance = np.where(lit, 1 - (1 - chance) * (1 - self._gap(range_m)), 1.0)
        range_m = self._blurred(range_m) + self.static_error_m
        return IdealRange(*(each.astype(f4) for each in (range_m, sigma_m, amplitude, chance)))

    def _gap(self, range_m: np.ndarray) -> np.ndarray:
        """Return the probability (h, w) that a step of depth removes a pixel's return; a share of
        a pixel is a probability. The gap counts along the row or column that crosses the step, not
        towards diagonal neighbours."""
        edge = self.camera.edge
        beside = ndimage.generate_binary_structure(2, 1)
        far = ndimage.maximum_filter(
            np.where(np.isfinite(range_m), range_m, -np.inf), footprint=beside
        )
        near = ndimage.minimum_filter(
            np.where(np.isfinite(range_m), range_m, np.inf), footprint=beside
        )
        step = np.isfinite(range_m) & (far - near > edge.least_step_mm.value * MM)
        if not step.any():
            return np.zeros(range_m.shape)
        return np.clip(
            edge.gap_px.value / 2 - ndimage.distance_transform_cdt(~step, "taxicab"), 0, 1
        )

    def _blurred(self, range_m: np.ndarray) -> np.ndarray:
        known = np.isfinite(range_m)
        blur_px = self.camera.edge.blur_px.value
        if blur_px == 0:
            return range_m
        # a plane is linear in 1/z, so that only steps and curvature change
        weight = ndimage.gaussian_filter(known.astype(float), blur_px)
        inverse = ndimage.gaussian_filter(
            np.where(known, 1 / (range_m / self._stretch), 0.0), blur_px
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(known, weight / inverse * self._stretch, np.nan)

    def frame(
        self, exposure: IdealRange, rng: np.random.Generator, error_m: float = 0.0
    ) -> DecodedFrame:
        """Draw a frame with noise from ``rng``; ``error_m`` displaces it as a whole."""
        engine = self.camera.engine
        shape = exposure.range_m.shape
        limits = map(
            f4,
            (engine.min_range_mm.value * MM, engine.max_range_mm.value * MM, self.camera.z_step_m),
        )
        noise = filtered(standard_normals(rng, shape), *self._filters)
        images = (
            exposure.range_m,
            exposure.sigma_m,
            exposure.chance,
            self._stretch,
            noise,
            rng.random(shape, dtype=f4),
        )
        z_m = np.empty(shape, f4)
        reason = np.empty(shape, np.uint8)
        decode(*images, f4(error_m), *limits, z_m, reason)
        return DecodedFrame(z_m, reason, exposure.amplitude)


NO_RETURN, OUT_OF_RANGE, VALID = map(
    np.uint8, (Reason.NO_RETURN, Reason.OUT_OF_RANGE, Reason.VALID)
)


@numba.njit(**FAST)
def decode(  # type: ignore[no-untyped-def]
    range_m,
    sigma_m,
    chance,
    stretch,
    noise,
    uniforms,
    error_m,
    nearest_m,
    farthest_m,
    step_m,
    z_m,
    reason,
):
    """Add ``noise`` of deviation 1 to an `IdealRange`, with random ``uniforms``; write z and the
    reason, (h, w) each. ``stretch``: range over z. ``error_m`` displaces the frame."""
    for y in range(range_m.shape[0]):
        for x in range(range_m.shape[1]):
            found_m = range_m[y, x] + sigma_m[y, x] * noise[y, x] + error_m
            beyond = (found_m < nearest_m) | (found_m > farthest_m)
            code = OUT_OF_RANGE if beyond else VALID
            code = NO_RETURN if np.isnan(range_m[y, x]) | (uniforms[y, x] < chance[y, x]) else code
            rounded = np.rint(found_m / stretch[y, x] / step_m) * step_m
            z_m[y, x] = rounded if code == VALID else np.float32(np.nan)
            reason[y, x] = code
