"""The noise of a depth camera from a small table, for any simulator. It needs only NumPy (or
torch) and the table.

`tofpod export_noise` measures the table of a camera and copies this file beside it. For each pixel
and frame, the noise's deviation and the probability of no return depend on the light that comes
back, intensity / range^2. A separable filter correlates neighbours; each unit has a fixed pattern,
the same in all frames. Not modelled: errors at steps of depth (mixing of neighbours, flying
pixels), light over several surfaces, ambient light, warm-up and displacements of whole frames.
`tofpod sweep` simulates all of them."""

import numpy as np


class DepthNoise:
    """Noise of one unit of a camera with images (h, w). ``table``: the arrays of the camera's
    file, or its path. ``slopes`` (h, w, 2): x/z and y/z of each pixel; None: the camera's nominal
    lens. ``seed``: chooses the unit."""

    def __init__(self, table, slopes=None, seed=1):  # type: ignore[no-untyped-def]
        self.table = table = _loaded(table)
        slopes = table["slopes"] if slopes is None else slopes
        self.stretch = np.sqrt(1.0 + (np.asarray(slopes, np.float32) ** 2).sum(axis=-1))
        self.cosine = 1.0 / self.stretch
        self.shape = self.stretch.shape
        self.falloff = table["falloff"] if slopes is table["slopes"] else np.float32(1.0)
        # entry 0 means no return
        self.sigma_m = np.append(0.0, table["sigma_m"]).astype(np.float32)
        self.seen_share = np.append(0.0, table["seen"]).astype(np.float32)
        white = np.random.default_rng(seed).standard_normal(self.shape, dtype=np.float32)
        self.pattern_m = table["pattern_m"] * filtered(
            white, table["pattern_rows"], table["pattern_columns"]
        )

    def __call__(self, z_m, intensity, rng):  # type: ignore[no-untyped-def]
        """Return a frame (h, w) float32, NaN without a return, from the ideal distance along the
        axis ``z_m`` (h, w) metres and ``intensity`` (h, w): albedo times the cosine of the
        incidence. ``rng``: a NumPy Generator."""
        table = self.table
        range_m = np.asarray(z_m, np.float32) * self.stretch
        with np.errstate(divide="ignore", invalid="ignore"):
            level = np.log2(self.falloff * np.asarray(intensity, np.float32) / (range_m * range_m))
        level *= table["per_octave"]
        level += np.float32(1.5) - table["first"] * table["per_octave"]
        # pixels without light (NaN or minus infinity) get entry 0
        np.fmax(level, 0.0, out=level)
        np.fmin(level, np.float32(len(self.seen_share) - 1), out=level)
        entry = level.astype(np.int32)
        white = rng.standard_normal(self.shape, dtype=np.float32)
        z = filtered(white, table["rows"], table["columns"])
        valid = rng.random(self.shape, dtype=np.float32) < self.seen_share.take(entry)
        valid &= (range_m > table["nearest_m"]) & (range_m < table["farthest_m"])
        z *= self.sigma_m.take(entry)
        z += range_m
        z += self.pattern_m
        z *= self.cosine
        step_m = table["step_m"]
        if step_m > 0:
            z *= 1.0 / step_m
            np.round(z, out=z)
            z *= step_m
        z[~valid] = np.nan
        return z


def filtered(image, rows, columns):  # type: ignore[no-untyped-def]
    """Return the image (h, w) after two causal filters, down and across; edges wrap around."""
    for axis, taps in ((0, rows), (1, columns)):
        reach = len(taps) - 1
        side = image.shape[axis]
        longer = np.concatenate([image.take(range(side - reach, side), axis), image], axis)
        image = np.zeros_like(image)
        for k, tap in enumerate(taps[::-1]):
            shifted = longer[k : k + side] if axis == 0 else longer[:, k : k + side]
            image += tap * shifted
    return image


def _loaded(table):  # type: ignore[no-untyped-def]
    if hasattr(table, "keys"):
        return table
    with np.load(table, allow_pickle=False) as arrays:
        return dict(arrays)


class TorchDepthNoise:
    """The same for torch on any ``device`` (torch's name), and for batches (n, h, w)."""

    def __init__(self, table, device="cpu", seed=1):  # type: ignore[no-untyped-def]
        import torch

        self.table = {}
        for name, values in _loaded(table).items():
            if np.asarray(values).dtype.kind == "f":
                self.table[name] = torch.as_tensor(np.float32(values), device=device)
        self.torch = torch
        self.stretch = (1.0 + (self.table["slopes"] ** 2).sum(-1)).sqrt()
        generator = torch.Generator(device=device).manual_seed(seed)
        white = torch.randn(self.stretch.shape, generator=generator, device=device)
        self.pattern_m = self.table["pattern_m"] * self.filtered(
            white, "pattern_rows", "pattern_columns"
        )

    def __call__(self, z_m, intensity, generator=None):  # type: ignore[no-untyped-def]
        """Return frames (.., h, w), NaN without a return, from ideal distances along the axis in
        metres and intensities (albedo times the cosine of the angle of incidence) of the same
        shape."""
        torch = self.torch
        table = self.table
        range_m = z_m * self.stretch
        octaves = torch.log2(table["falloff"] * intensity / range_m**2)
        level = (octaves - table["first"]) * table["per_octave"]
        level = torch.nan_to_num(level, nan=-1.0, posinf=1e6, neginf=-1.0)
        entry = (level + 0.5).clamp(0, len(table["sigma_m"]) - 1).long()
        white = torch.randn(z_m.shape, generator=generator, device=z_m.device)
        noise = self.filtered(white, "rows", "columns")
        noisy_m = range_m + table["sigma_m"][entry] * noise + self.pattern_m
        seen_share = torch.where(level < 0.0, torch.zeros_like(level), table["seen"][entry])
        valid = torch.rand(z_m.shape, generator=generator, device=z_m.device) < seen_share
        valid &= (range_m > table["nearest_m"]) & (range_m < table["farthest_m"])
        z = noisy_m / self.stretch
        step_m = table["step_m"]
        if step_m > 0:
            z = torch.round(z / step_m) * step_m
        return torch.where(valid, z, torch.full_like(z, float("nan")))

    def filtered(self, image, rows, columns):  # type: ignore[no-untyped-def]
        """Return images (.., h, w) after two causal filters of the table; edges wrap around."""
        for axis, taps in ((-2, self.table[rows]), (-1, self.table[columns])):
            image = sum(tap * self.torch.roll(image, k, axis) for k, tap in enumerate(taps))
        return image
