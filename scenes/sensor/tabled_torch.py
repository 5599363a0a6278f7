"""A depth camera's noise from a small table, for torch on any device: `scenes.sensor.tabled` in torch's words.

Batches (n, h, w) are welcome. What is not modelled is listed there.
"""

from __future__ import annotations

import numpy as np


class TorchDepthNoise:
    """Noise of one unit of a camera whose images are (h, w). ``table``: the arrays of the camera's file, or its path;
    ``device`` as torch names it; ``seed``: which unit."""

    def __init__(self, table, device="cpu", seed=1):  # type: ignore[no-untyped-def]
        import torch

        if not hasattr(table, "keys"):
            with np.load(table, allow_pickle=False) as arrays:
                table = dict(arrays)
        self.torch = torch
        self.table = {
            name: torch.as_tensor(np.asarray(values, np.float32), device=device)
            for name, values in table.items()
            if np.asarray(values).dtype.kind == "f"
        }
        self.stretch = (1.0 + (self.table["slopes"] ** 2).sum(-1)).sqrt()
        generator = torch.Generator(device=device).manual_seed(seed)
        white = torch.randn(self.stretch.shape, generator=generator, device=device)
        self.pattern_m = self.table["pattern_m"] * self.filtered(white, "pattern_rows", "pattern_columns")

    def __call__(self, z_m, intensity, generator=None):  # type: ignore[no-untyped-def]
        """Return frames (.., h, w), NaN without a return, from ideal distances along the axis in metres and
        intensities (albedo times the cosine of the angle of incidence) of the same shape."""
        torch, table = self.torch, self.table
        range_m = z_m * self.stretch
        level = (torch.log2(table["falloff"] * intensity / range_m**2) - table["first"]) * table["per_octave"]
        level = torch.nan_to_num(level, nan=-1.0, posinf=1e6, neginf=-1.0)
        place = (level + 0.5).clamp(0, len(table["sigma_m"]) - 1).long()
        white = torch.randn(z_m.shape, generator=generator, device=z_m.device)
        noise = self.filtered(white, "rows", "columns")
        moved = range_m + table["sigma_m"][place] * noise + self.pattern_m
        chance = torch.where(level < 0.0, torch.zeros_like(level), table["seen"][place])
        seen = torch.rand(z_m.shape, generator=generator, device=z_m.device) < chance
        seen &= (range_m > table["nearest_m"]) & (range_m < table["farthest_m"])
        z, step = moved / self.stretch, table["step_m"]
        z = torch.round(z / step) * step if step > 0 else z
        return torch.where(seen, z, torch.full_like(z, float("nan")))

    def filtered(self, image, rows, columns):  # type: ignore[no-untyped-def]
        """Return images (.., h, w) after two causal filters of the table; edges wrap around."""
        for axis, taps in ((-2, self.table[rows]), (-1, self.table[columns])):
            image = sum(tap * self.torch.roll(image, k, axis) for k, tap in enumerate(taps))
        return image
