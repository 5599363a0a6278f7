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
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.common.normals import FAST, standard_normals
from scenes.sensor.common.tabled import filtered
from scenes.sensor.common.unit import DecodedFrame, UnitModel
from scenes.sensor.empirical.facts import EmpiricalCamera, Taps

f4 = np.float32


class IdealRange(NamedTuple):
    """A view without noise, (h, w) float32 each."""

    range_m: np.ndarray
    """Range along the ray; NaN without light."""
    sigma_m: np.ndarray
    """Deviation of a frame's range."""
    amplitude: np.ndarray
    """Amplitude in the recording's units."""
    chance: np.ndarray
    """Probability of no return."""


class EmpiricalImager(UnitModel[EmpiricalCamera]):
    """A camera of this kind on a region of its sensor: `expose` once per view, then `frame` for
    each exposure."""

    def __init__(
        self, camera: EmpiricalCamera, config: CameraConfig, region: Region, slopes: np.ndarray
    ) -> None:
        super().__init__(camera, config, region, slopes)
        self._stretch = np.sqrt(1 + (slopes**2).sum(axis=-1)).astype(f4)

    def pattern_mm(self, rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
        """Draw a fixed pattern with the measured spectrum."""
        facts = self.camera.fixed_pattern
        white = rng.standard_normal(shape, dtype=f4)
        return _correlated(white, facts.rows, facts.columns) * facts.deviation_mm.value

    def _sigma_m(self, range_m: np.ndarray, brightness: np.ndarray) -> np.ndarray:
        """Return the noise's deviation (h, w) of surfaces ``brightness`` times as bright as the
        recorded one."""
        law = self.camera.noise
        ranges_mm = law.range_mm.value
        inside_m = np.clip(range_m, ranges_mm[0] * MM, ranges_mm[-1] * MM)
        # the law is a line through its points on doubly logarithmic paper
        log_range = np.log(inside_m / MM)
        log_sigma = np.interp(log_range, np.log(ranges_mm), np.log(law.sigma_mm.value))
        beyond = (range_m / inside_m) ** law.range_exponent.value
        by_brightness = brightness**-law.brightness_exponent.value
        return np.asarray(MM * np.exp(log_sigma) * beyond * by_brightness)

    def expose(self, view: NoiseFreeView) -> IdealRange:
        """Return range, noise and probabilities of no return of a view that covers this region."""
        amplitude_at_1m = self.camera.light.amplitude_at_1m.value
        dropouts = self.camera.dropouts
        direct = view.phasor_direct[0].astype(complex)
        light = np.abs(direct)
        lit = light > 0
        phase = np.mod(np.angle(direct), 2 * np.pi)
        range_m = np.where(lit, phase / wave_numbers(view.frequencies_hz)[0] / 2, np.nan)
        amplitude = light * amplitude_at_1m / self.camera.light.albedo.value
        sigma_m = np.zeros(lit.shape)
        dropped = np.zeros(lit.shape)
        if self.config.effects.noise:
            with np.errstate(divide="ignore", invalid="ignore"):
                brightness = np.where(lit, amplitude * range_m**2 / amplitude_at_1m, np.nan)
                sigma_m = np.where(lit, self._sigma_m(range_m, brightness), 0.0)
                level = np.log(np.where(lit, amplitude, dropouts.amplitude.value[0]))
            dropped = np.interp(level, np.log(dropouts.amplitude.value), dropouts.share.value)
        # a return is lost by noise, or at a step
        chance = np.where(lit, 1 - (1 - dropped) * (1 - self._gap(range_m)), 1.0)
        shown_m = self._blurred(range_m)
        known = self.camera.range_error
        if known is not None and self.config.effects.unit_offset:
            shown_m = known.scale.value * shown_m + known.bias_mm.value * MM
        shown_m = shown_m + self.static_error_m
        return IdealRange(
            range_m=shown_m.astype(f4),
            sigma_m=sigma_m.astype(f4),
            amplitude=amplitude.astype(f4),
            chance=chance.astype(f4),
        )

    def _gap(self, range_m: np.ndarray) -> np.ndarray:
        """Return the probability (h, w) that a step of depth removes a pixel's return; a share of
        a pixel is a probability. The gap counts along the row or column that crosses the step, not
        towards diagonal neighbours."""
        edge = self.camera.edge
        finite = np.isfinite(range_m)
        cross = ndimage.generate_binary_structure(2, 1)
        farthest_m = ndimage.maximum_filter(np.where(finite, range_m, -np.inf), footprint=cross)
        nearest_m = ndimage.minimum_filter(np.where(finite, range_m, np.inf), footprint=cross)
        step = finite & (farthest_m - nearest_m > edge.least_step_mm.value * MM)
        if not step.any():
            return np.zeros(range_m.shape)
        distance_px = ndimage.distance_transform_cdt(~step, "taxicab")
        return np.clip(edge.gap_px.value / 2 - distance_px, 0, 1)

    def _blurred(self, range_m: np.ndarray) -> np.ndarray:
        """Return ranges (h, w) after the smoothing of depth."""
        finite = np.isfinite(range_m)
        blur_px = self.camera.edge.blur_px.value
        if blur_px == 0:
            return range_m
        # a plane is linear in 1/z, so that only steps and curvature change
        inverse = np.where(finite, 1 / (range_m / self._stretch), 0.0)
        weight = ndimage.gaussian_filter(finite.astype(float), blur_px)
        smoothed = ndimage.gaussian_filter(inverse, blur_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(finite, weight / smoothed * self._stretch, np.nan)

    def frame(
        self, exposure: IdealRange, rng: np.random.Generator, error_m: float = 0.0
    ) -> DecodedFrame:
        """Draw a frame with noise from ``rng``; ``error_m`` displaces it as a whole."""
        camera = self.camera
        shape = exposure.range_m.shape
        white = standard_normals(rng, shape)
        noise = _correlated(white, camera.noise.rows, camera.noise.columns)
        uniforms = rng.random(shape, dtype=f4)
        z_m = np.empty(shape, f4)
        reason = np.empty(shape, np.uint8)
        decode(
            exposure.range_m,
            exposure.sigma_m,
            exposure.chance,
            self._stretch,
            noise,
            uniforms,
            f4(error_m),
            f4(camera.engine.min_range_mm.value * MM),
            f4(camera.engine.max_range_mm.value * MM),
            f4(camera.z_step_m),
            z_m,
            reason,
        )
        return DecodedFrame(z_m, reason, exposure.amplitude)


def _correlated(white: np.ndarray, rows: Taps, columns: Taps) -> np.ndarray:
    """Return white noise (h, w) after two filters, down and across."""
    image: np.ndarray = filtered(white, np.asarray(rows.value, f4), np.asarray(columns.value, f4))
    return image


NO_RETURN = np.uint8(Reason.NO_RETURN)
OUT_OF_RANGE = np.uint8(Reason.OUT_OF_RANGE)
VALID = np.uint8(Reason.VALID)


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
            noisy_m = range_m[y, x] + sigma_m[y, x] * noise[y, x] + error_m
            beyond = (noisy_m < nearest_m) | (noisy_m > farthest_m)
            lost = np.isnan(range_m[y, x]) | (uniforms[y, x] < chance[y, x])
            code = OUT_OF_RANGE if beyond else VALID
            code = NO_RETURN if lost else code
            rounded = np.rint(noisy_m / stretch[y, x] / step_m) * step_m
            z_m[y, x] = rounded if code == VALID else np.float32(np.nan)
            reason[y, x] = code
