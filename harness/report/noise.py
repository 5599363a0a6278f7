"""Figure: how the parts of the range error go with the number of averaged frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from harness.evaluation.noise import fit_floor
from harness.report.canvas import BLUE, GREEN, INK, ORANGE, svg

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

GUIDE = "#cfd6dd"


def noise_figure(noise: pd.DataFrame) -> str:
    """Temporal, systematic and total error against frames (log-log) with the 1/sqrt(N) guide and the fitted floor.

    ``noise``: rows of one variant of `harness.evaluation.noise.noise_against_frames`.
    """
    frames = noise["frames"].to_numpy(float)
    fit = fit_floor(frames, noise["total_rms_mm"].to_numpy(float))

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.plot(frames, noise["guide_mm"], color=GUIDE, lw=7, solid_capstyle="round", label="1/√N guide")
        for column, colour, marker, label in (
            ("temporal_rms_mm", BLUE, "o", "temporal noise, rms"),
            ("systematic_mm", ORANGE, "s", "systematic error (offset and pattern)"),
            ("pattern_mm", GREEN, "v", "of it, pattern over pixels"),
            ("total_rms_mm", INK, "D", "total error, rms"),
        ):
            values = noise[column].where(noise[column] > 0)
            axes.plot(frames, values, marker=marker, ms=5, lw=1.4, color=colour, label=label)
        if fit is not None:
            dense = np.geomspace(frames.min(), frames.max(), 60)
            axes.plot(dense, fit.at(dense), ":", color=INK, lw=1.2, label=f"fit: {fit.white_mm:.2f} mm/√N and floor")
            if fit.floor_mm > 0:
                axes.axhline(fit.floor_mm, color=INK, lw=0.8, ls=(0, (6, 3)), label=f"floor {fit.floor_mm:.2f} mm")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(frames, [f"{n:g}" for n in frames])
        axes.minorticks_off()
        low, high = axes.get_ylim()
        ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high]
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.set(xlabel="frames averaged", ylabel="range error (mm)")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    alt = "Range error in millimetres against the number of averaged frames: noise falls, the systematic error stays."
    return svg("noise", (10, 4.2), alt, draw)
