"""The picture of a unit's flat field: map, histogram, and spectrum beside that of its noise."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.report.blocks import save_png
from harness.vocabulary.geometry import MM

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BINS, RINGS = 60, 40
SHOWN_SIGMAS = 3.0


def histogram(error_m: np.ndarray) -> dict[str, list[float]]:
    """Return the edges in mm and the number of pixels between them of a map (h, w), within four deviations."""
    known = error_m[np.isfinite(error_m)] / MM
    counts, edges = np.histogram(known, BINS, (-4 * known.std(), 4 * known.std()))
    return {"edge_mm": edges.tolist(), "pixels": counts.tolist()}


def spectrum(image_m: np.ndarray) -> dict[str, list[float]]:
    """Return the power spectral density (mm² pixel²) of a map (h, w) over rings of spatial frequency (cycles per
    pixel), under a Hann window, what is unknown taken for 0. White noise of a deviation s has the density s²."""
    window = np.outer(np.hanning(image_m.shape[0]), np.hanning(image_m.shape[1])) * np.isfinite(image_m)
    power = np.abs(np.fft.fft2(np.nan_to_num(image_m / MM) * window)) ** 2 / (window**2).sum()
    down, across = (np.fft.fftfreq(side) for side in image_m.shape)
    ring = (np.hypot(down[:, None], across) * 2 * RINGS).astype(int).ravel()
    sums, counts = (np.bincount(ring, weights)[1:RINGS] for weights in (power.ravel(), None))
    return {
        "cycles_per_px": ((np.arange(1, len(sums) + 1) + 0.5) / (2 * RINGS)).tolist(),
        "density_mm2_px2": (sums / np.maximum(counts, 1)).tolist(),
    }


def save_flat_field_png(path: Path, error_m: np.ndarray, curves: dict[str, Any], title: str) -> None:
    """Write the PNG of a map (h, w) and its curves: ``histogram``, ``spectrum``, ``noise_spectrum`` (or None), as the
    JSON holds them. Raises UserError where it cannot be written."""

    def draw(figure: Figure) -> None:
        axes = figure.subplot_mosaic("aab;aac")
        limit = SHOWN_SIGMAS * float(np.nanstd(error_m)) / MM
        shown = axes["a"].imshow(error_m / MM, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
        rows, columns = np.nonzero(np.isfinite(error_m))
        axes["a"].set(
            xlim=(columns.min(), columns.max()), ylim=(rows.max(), rows.min()), xlabel="u, px", ylabel="v, px"
        )
        axes["a"].grid(visible=False)
        figure.colorbar(shown, ax=axes["a"], extend="both", shrink=0.8).set_label("error of range, mm")
        figure.suptitle(title, fontsize=10, parse_math=False)
        counts = curves["histogram"]
        axes["b"].stairs(counts["pixels"], counts["edge_mm"], fill=True)
        axes["b"].set(xlabel="error of range, mm", ylabel="pixels")
        for name, label in (("spectrum", "pattern and noise"), ("noise_spectrum", "noise: first less last captures")):
            if curves[name] is not None:
                axes["c"].semilogy(curves[name]["cycles_per_px"], curves[name]["density_mm2_px2"], label=label)
        axes["c"].set(xlabel="cycles per pixel", ylabel="density, mm² px²")
        axes["c"].legend(fontsize=7)

    save_png(path, (10.0, 5.4), draw)
