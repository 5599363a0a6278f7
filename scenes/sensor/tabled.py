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
        self.shape, self.falloff = (
            self.stretch.shape,
            table["falloff"] if slopes is table["slopes"] else np.float32(1.0),
        )
        white = np.random.default_rng(seed).standard_normal(self.shape, dtype=np.float32)
        self.pattern_m = table["pattern_m"] * filtered(white, table["pattern_rows"], table["pattern_columns"])

    def __call__(self, z_m, intensity, rng):  # type: ignore[no-untyped-def]
        """Return one frame (h, w) float32, NaN without a return, from the ideal distance along the axis ``z_m`` (h, w)
        metres and ``intensity`` (h, w): albedo times the cosine of the angle of incidence. ``rng``: a NumPy
        Generator."""
        table, range_m = self.table, np.asarray(z_m, np.float32) * self.stretch
        with np.errstate(divide="ignore", invalid="ignore"):
            light = self.falloff * np.asarray(intensity, np.float32) / range_m**2
            level = (np.log2(light) - table["first"]) * table["per_octave"]
            level = np.nan_to_num(level, nan=-1.0, posinf=1e6, neginf=-1.0)
        place = np.clip(level + 0.5, 0, len(table["sigma_m"]) - 1).astype(np.intp)
        noise = filtered(rng.standard_normal(self.shape, dtype=np.float32), table["rows"], table["columns"])
        moved = range_m + table["sigma_m"][place] * noise + self.pattern_m
        seen = rng.random(self.shape, dtype=np.float32) < np.where(level < 0.0, 0.0, table["seen"][place])
        seen &= (range_m > table["nearest_m"]) & (range_m < table["farthest_m"])
        z = moved / self.stretch
        step = table["step_m"]
        return np.where(seen, np.round(z / step) * step if step > 0 else z, np.float32(np.nan)).astype(np.float32)


def filtered(image, rows, columns):  # type: ignore[no-untyped-def]
    """Return the image (h, w) after two causal filters, down and across; edges wrap around."""
    for axis, taps in ((0, rows), (1, columns)):
        reach, side = len(taps) - 1, image.shape[axis]
        longer = np.concatenate([image.take(range(side - reach, side), axis), image], axis)
        parts = (longer[k : k + side] if axis == 0 else longer[:, k : k + side] for k in range(reach + 1))
        image = sum(tap * part for tap, part in zip(taps[::-1], parts, strict=True))
    return image
