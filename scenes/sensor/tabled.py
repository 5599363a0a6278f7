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
        self.cosine, self.shape = 1.0 / self.stretch, self.stretch.shape
        self.falloff = table["falloff"] if slopes is table["slopes"] else np.float32(1.0)
        self.sigma_m, self.seen = (np.append(first, table[key]).astype(np.float32)
                                   for first, key in ((0.0, "sigma_m"), (0.0, "seen")))  # fmt: skip
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
        # entry 0 means no return; pixels without light (NaN or minus infinity) get it
        place = np.fmin(
            np.fmax(level, 0.0, out=level), np.float32(len(self.seen) - 1), out=level
        ).astype(np.int32)
        noise = filtered(
            rng.standard_normal(self.shape, dtype=np.float32), table["rows"], table["columns"]
        )
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
        reach = len(taps) - 1
        side = image.shape[axis]
        longer = np.concatenate([image.take(range(side - reach, side), axis), image], axis)
        parts = (
            longer[k : k + side] if axis == 0 else longer[:, k : k + side] for k in range(reach + 1)
        )
        image = np.zeros_like(image)
        for tap, part in zip(taps[::-1], parts, strict=True):
            image += tap * part
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

        numbers = {
            name: values
            for name, values in _loaded(table).items()
            if np.asarray(values).dtype.kind == "f"
        }
        self.table = {
            name: torch.as_tensor(np.float32(each), device=device) for name, each in numbers.items()
        }
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
        level = (torch.log2(table["falloff"] * intensity / range_m**2) - table["first"]) * table[
            "per_octave"
        ]
        level = torch.nan_to_num(level, nan=-1.0, posinf=1e6, neginf=-1.0)
        place = (level + 0.5).clamp(0, len(table["sigma_m"]) - 1).long()
        white = torch.randn(z_m.shape, generator=generator, device=z_m.device)
        noise = self.filtered(white, "rows", "columns")
        moved = range_m + table["sigma_m"][place] * noise + self.pattern_m
        chance = torch.where(level < 0.0, torch.zeros_like(level), table["seen"][place])
        seen = torch.rand(z_m.shape, generator=generator, device=z_m.device) < chance
        seen &= (range_m > table["nearest_m"]) & (range_m < table["farthest_m"])
        z = moved / self.stretch
        step = table["step_m"]
        z = torch.round(z / step) * step if step > 0 else z
        return torch.where(seen, z, torch.full_like(z, float("nan")))

    def filtered(self, image, rows, columns):  # type: ignore[no-untyped-def]
        """Return images (.., h, w) after two causal filters of the table; edges wrap around."""
        for axis, taps in ((-2, self.table[rows]), (-1, self.table[columns])):
            image = sum(tap * self.torch.roll(image, k, axis) for k, tap in enumerate(taps))
        return image
