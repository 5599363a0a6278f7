"""The joint bilateral filter (`scenes.sensor.amcw.kernels.filter_image`) in NumPy."""

import numpy as np

from scenes.sensor.amcw.kernels import FilterSettings


def filtered_pixel(
    phasor: np.ndarray, amplitude: np.ndarray, settings: FilterSettings, y: int, x: int
) -> tuple[complex, float, float]:
    """Return the filtered phasor, its amplitude and the edge sum at pixel (y, x) of an image of
    unit phasors (h, w) and amplitudes (h, w)."""
    half = len(settings.space) // 2
    # the window, clipped at the border
    rows = slice(max(y - half, 0), y + half + 1)
    columns = slice(max(x - half, 0), x + half + 1)
    unit = phasor[rows, columns]
    size = amplitude[rows, columns]
    first_row = rows.start - y + half
    first_column = columns.start - x + half
    space = settings.space[first_row : first_row + len(unit)]
    space = space[:, first_column : first_column + unit.shape[1]]

    gap = 1 - np.real(unit * np.conj(phasor[y, x]))
    by_phase = np.ones_like(gap)
    kept = size >= 0  # saturated pixels have no light
    if amplitude[y, x] > settings.dim:
        by_phase = np.exp(-settings.concentration * gap)
        if settings.drop_dim:
            kept = size >= settings.dim
    weight = space * by_phase * kept
    in_edge = kept if settings.dim_edges else kept & (size >= settings.dim)

    total = (weight * unit * (size if settings.by_amplitude else 1)).sum()
    strength = abs(total) if settings.by_amplitude else (weight * size).sum()
    return complex(total), float(strength / weight.sum()), float((gap * in_edge).sum() / 2)
