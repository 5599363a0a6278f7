"""The simulated Azure Kinect's frame loop in plain NumPy: a peer of the compiled one, vectorised over pixels.

The same physics from the same noise-free samples: noise, companding, phasors, the joint bilateral filter over 5x5,
unwrapping by the same table, the engine's gates, rounding, and the mean of the frames. float32 throughout, buffers
reused, planes of one frequency at a time so that they stay in the second cache: as one would write it who stays with
NumPy and has measured.
"""

from __future__ import annotations

import math

import numpy as np

from harness.vocabulary.geometry import Reason
from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.imager import AmcwExposure, AmcwImager

f4 = np.float32


class NumpyCamera:
    """Frames of one exposure. ``imager`` lends its constants (tables, geometry, limits), none of its loops.

    Raises ValueError for a camera whose engine does more than the Azure Kinect's.
    """

    def __init__(self, imager: AmcwImager, exposure: AmcwExposure) -> None:
        engine = imager.camera.engine
        if imager.engine.flying or engine.filter_on.value == "phasors" or engine.drop_dim_neighbours.value:
            raise ValueError(f"{imager.camera.name}: its engine has parts that this loop leaves out")
        self.exposure, self.gates = exposure, imager.engine.gates
        self.knee, self.step_m = f4(imager.camera.converter.knee_units.value), f4(imager.camera.z_step_m)
        self.dim, self.concentration = f4(engine.dim_amplitude_units.value), f4(engine.concentration.value)
        self.cosines, self.sines, self.gains = imager._cosines, imager._sines, imager.gains
        self.window, self.geometry = imager.filter_settings.space, imager.engine.geometry
        self.outside = imager.outside_mask.ravel()
        self.unwrap = imager.unwrap
        h, w = exposure.shape
        half = len(self.window) // 2
        self.inner = (slice(half, half + h), slice(half, half + w))
        self.padded = np.zeros((4, h + 2 * half, w + 2 * half), f4)
        self.scratch = np.empty((4, h, w), f4)

    def frame(self, normals: np.ndarray, error_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """One frame from standard normals (f, k, n): z before rounding (n,) in metres, and the reason (n,) of each."""
        unit, amplitude, saturated = self.phasors(normals)
        filtered, edge = self.filter(unit, amplitude)
        return self.decode(filtered, edge, saturated, f4(error_m))

    def rounded(self, z_m: np.ndarray, reason: np.ndarray) -> np.ndarray:
        """As the camera hands it out: on its steps, NaN where there is a reason."""
        out = np.floor(z_m / self.step_m + f4(0.5)) * self.step_m
        out[reason != int(Reason.VALID)] = np.nan
        return out

    def mean(self, frames: int, rng: np.random.Generator) -> np.ndarray:
        """(n,) mean z over the frames in which a pixel is valid, NaN where it never is."""
        total = np.zeros(self.exposure.sigma.size)
        count = np.zeros(self.exposure.sigma.size)
        for _ in range(frames):
            z = self.rounded(*self.frame(rng.standard_normal(self.exposure.means.shape, dtype=f4)))
            valid = np.isfinite(z)
            np.add(total, z, out=total, where=valid)
            count += valid
        with np.errstate(invalid="ignore"):
            return np.asarray(total / count)

    def phasors(self, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit phasors (2, f, n), amplitudes (f, n) times the gains, saturated (n,), as `kernels.expose`."""
        means, sigma, limit = self.exposure.means, self.exposure.sigma, self.exposure.limit
        n_frequencies, n_phases, n = means.shape
        unit, amplitude, saturated = np.zeros((2, n_frequencies, n), f4), np.empty((n_frequencies, n), f4), False
        for f in range(n_frequencies):
            for k in range(n_phases):
                sample = normals[f, k] * sigma
                sample += means[f, k]
                size = np.abs(sample)
                saturated |= size > limit
                np.minimum(size, limit, out=size)
                # the power of two at or below size / knee
                step = np.ldexp(f4(0.5), np.frexp(np.maximum(size / self.knee, f4(1)))[1])
                code = np.copysign(step * np.floor(size / step + f4(0.5)), sample)
                unit[0, f] += self.cosines[k] * code
                unit[1, f] += self.sines[k] * code
            length = np.hypot(unit[0, f], unit[1, f])
            unit[:, f] /= np.where(length > 0, length, f4(1))
            amplitude[f] = self.gains[f] * f4(2 / n_phases) * length
        unit[..., saturated] = 0
        amplitude[:, saturated] = kernels.OUTSIDE
        return unit, amplitude, np.asarray(saturated)

    def filter(self, unit: np.ndarray, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Filtered phasors and amplitudes (f, 3, n) and edge sums (f, n), as `kernels.filter_image`."""
        shape = self.exposure.shape
        filtered, edge = np.empty((len(amplitude), 3, *shape), f4), np.empty((len(amplitude), *shape), f4)
        for f in range(len(amplitude)):
            self.padded[:2, *self.inner] = unit[:, f].reshape(2, *shape)
            self.padded[2, *self.inner] = amplitude[f].reshape(shape)
            self.padded[3, *self.inner] = amplitude[f].reshape(shape) >= 0
            self._filter_one(filtered[f], edge[f])
        return filtered.reshape(len(amplitude), 3, -1), edge.reshape(len(amplitude), -1)

    def _filter_one(self, filtered: np.ndarray, edge: np.ndarray) -> None:
        re, im, amp, kept = self.padded
        gap, weight, part, norm = self.scratch
        own_re, own_im, own_amp = (plane[self.inner] for plane in self.padded[:3])
        slope = np.where(own_amp > self.dim, self.concentration, f4(0))
        h, w = edge.shape
        filtered[...] = edge[...] = norm[...] = 0
        for dy, dx in np.ndindex(self.window.shape):
            near = (slice(dy, dy + h), slice(dx, dx + w))
            np.multiply(own_re, re[near], out=gap)
            gap += np.multiply(own_im, im[near], out=part)
            np.subtract(f4(1), gap, out=gap)
            np.multiply(slope, gap, out=weight)
            np.exp(np.negative(weight, out=weight), out=weight)
            weight *= kept[near]
            if self.window[dy, dx] != 1:
                weight *= self.window[dy, dx]
            filtered[0] += np.multiply(weight, re[near], out=part)
            filtered[1] += np.multiply(weight, im[near], out=part)
            filtered[2] += np.multiply(weight, amp[near], out=part)
            norm += weight
            edge += np.multiply(gap, kept[near], out=part)
        filtered[2] /= np.maximum(norm, f4(1e-30))
        edge *= f4(0.5)

    def decode(
        self, filtered: np.ndarray, edge: np.ndarray, saturated: np.ndarray, error_m: np.float32
    ) -> tuple[np.ndarray, np.ndarray]:
        """Unwrap, correct for the emitter beside the lens, gate: as `ranging.ranges_of`."""
        turns = np.arctan2(filtered[:, 1], filtered[:, 0]) * f4(0.5 / math.pi)
        turns[turns < 0] += f4(1)
        half_m, residual2 = self._half_path(turns)
        half_m += error_m
        along, offset2, cosine = self.geometry
        range_m = (f4(4) * half_m * half_m - offset2) / (f4(4) * half_m - f4(2) * along)
        z_m = range_m * cosine
        amplitudes = filtered[:, 2]
        return z_m, self._reasons(amplitudes, edge, saturated, residual2, range_m, z_m)

    def _half_path(self, turns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half the light's path (n,) in metres and the squared lattice residual (n,) of wrapped phases (f, n)."""
        unwrap, key, named = self.unwrap, np.zeros(turns.shape[1], int), np.ones(turns.shape[1], bool)
        for row, size, offset in zip(unwrap.combination, unwrap.sizes, unwrap.offset, strict=True):
            digit = offset - np.floor(row @ turns + f4(0.5)).astype(int)
            named &= (digit >= 0) & (digit < size)
            key = key * size + np.where(named, digit, 0)
        wraps = unwrap.wraps[:, np.where(named, key, 0)]
        unknown = ~named | (wraps[0] < 0)
        lattice = self.unwrap.lattice.astype(f4)
        unwrapped = turns + np.where(unknown, 0, wraps).astype(f4)
        common = lattice @ unwrapped / f4((lattice**2).sum())
        residual2 = ((unwrapped - lattice[:, None] * common) ** 2).sum(axis=0)
        residual2[unknown] = np.inf
        return self.unwrap.metres_per_turn.astype(f4) @ unwrapped, residual2

    def _reasons(
        self,
        amplitudes: np.ndarray,
        edge: np.ndarray,
        saturated: np.ndarray,
        residual2: np.ndarray,
        range_m: np.ndarray,
        z_m: np.ndarray,
    ) -> np.ndarray:
        """(n,) the first gate that each pixel fails: set from the last to the first."""
        gates = self.gates
        least, greatest, total = amplitudes.min(axis=0), amplitudes.max(axis=0), amplitudes.sum(axis=0)
        limit = np.broadcast_to(gates.residual, greatest.shape)
        if gates.residual_slope != 0:
            by_amplitude = gates.residual_scale * np.power(np.maximum(greatest, f4(0)), gates.residual_slope)
            limit = np.minimum(gates.residual_most, np.maximum(limit, by_amplitude))
        limited = z_m if gates.axial > 0 else range_m
        reason = np.full(z_m.size, int(Reason.VALID), np.uint8)
        failing = (
            (Reason.LOW_REFLECTIVITY, total * range_m * range_m < gates.reflectivity),
            (Reason.OUT_OF_RANGE, ~((limited >= gates.nearest_m) & (limited <= gates.farthest_m))),
            (Reason.UNWRAP, ~(np.isfinite(residual2) & (residual2 <= limit * limit))),
            (Reason.AMPLITUDE_RATIO, greatest - least > gates.ratio * greatest),
            (Reason.EDGE, edge.max(axis=0) >= gates.edge),
            (Reason.LOW_AMPLITUDE, (least < gates.least) | (total < gates.total)),
            (Reason.SATURATED, saturated),
            (Reason.OUTSIDE_MASK, self.outside),
        )
        for name, fails in failing:
            reason[fails] = int(name)
        return reason
