"""A depth camera's noise from a small table: needs NumPy and the table only, so that any simulator can use it.

`harness.export_noise` measures the table of a camera and copies this file beside it. Per pixel and frame, the noise's
deviation and the chance of no return follow from the light that comes back, intensity / range^2; neighbours are
correlated by a separable filter; a unit has a fixed pattern, the same in all frames.

Not modelled: what happens at steps of depth (mixing of neighbours, flying pixels), light over several surfaces, ambient
light, warm-up and displacements of whole frames. `harness.sweep` simulates all of them.
"""

from __future__ import annotations

import numpy as np


class DepthNoise:
    """Noise of one unit of a camera whose images are (h, w).

    ``table``: the arrays of the camera's file, or its path. ``slopes`` (h, w, 2): x/z and y/z of each pixel; None takes
    the camera's own nominal lens. ``seed``: which unit.
    """

    def __init__(self, table, slopes=None, seed=1):  # type: ignore[no-untyped-def]
        if not hasattr(table, "keys"):
            with np.load(table, allow_pickle=False) as arrays:
                table = dict(arrays)
        self.table = table
        slopes = table["slopes"] if slopes is None else slopes
        self.stretch = np.sqrt(1.0 + (np.asarray(slopes, np.float32) ** 2).sum(axis=-1))
        self.cosine, self.shape = 1.0 / self.stretch, self.stretch.shape
        self.falloff = table["falloff"] if slopes is table["slopes"] else np.float32(1.0)
        self.sigma_m, self.seen = (np.append(first, table[key]).astype(np.float32)
                                   for first, key in ((0.0, "sigma_m"), (0.0, "seen")))  # fmt: skip
        white = np.random.default_rng(seed).standard_normal(self.shape, dtype=np.float32)
        self.pattern_m = table["pattern_m"] * filtered(white, table["pattern_rows"], table["pattern_columns"])

    def __call__(self, z_m, intensity, rng):  # type: ignore[no-untyped-def]
        """Return one frame (h, w) float32, NaN without a return, from the ideal distance along the axis ``z_m`` (h, w)
        metres and ``intensity`` (h, w): albedo times the cosine of the angle of incidence. ``rng``: a NumPy
        Generator."""
        table, range_m = self.table, np.asarray(z_m, np.float32) * self.stretch
        with np.errstate(divide="ignore", invalid="ignore"):
            level = np.log2(self.falloff * np.asarray(intensity, np.float32) / (range_m * range_m))
        level *= table["per_octave"]
        level += np.float32(1.5) - table["first"] * table["per_octave"]
        # entry 0 is no return; no light, which is NaN or minus infinity, falls there
        place = np.fmax(np.fmin(level, np.float32(len(self.seen) - 1), out=level), 0.0, out=level).astype(np.int32)
        noise = filtered(rng.standard_normal(self.shape, dtype=np.float32), table["rows"], table["columns"])
        seen = rng.random(self.shape, dtype=np.float32) < self.seen.take(place)
        seen &= (range_m > table["nearest_m"]) & (range_m < table["farthest_m"])
        noise *= self.sigma_m.take(place)
        noise += range_m
        noise += self.pattern_m
        noise *= self.cosine
        if (step := table["step_m"]) > 0:
            noise *= 1.0 / step
            np.round(noise, out=noise)
            noise *= step
        noise[~seen] = np.nan
        return noise


def filtered(image, rows, columns):  # type: ignore[no-untyped-def]
    """Return the image (h, w) after two causal filters, down and across; edges wrap around."""
    for axis, taps in ((0, rows), (1, columns)):
        reach, side = len(taps) - 1, image.shape[axis]
        longer = np.concatenate([image.take(range(side - reach, side), axis), image], axis)
        parts = (longer[k : k + side] if axis == 0 else longer[:, k : k + side] for k in range(reach + 1))
        image = np.zeros_like(image)
        for tap, part in zip(taps[::-1], parts, strict=True):
            image += tap * part
    return image
