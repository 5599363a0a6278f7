"""Noisy light around listed pixels (`scenes.sensor.amcw.halo`) in NumPy."""

import numpy as np

from scenes.sensor.amcw.halo import Halo


def noisy_phasors(halo: Halo, normals: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return phasors (f, g) in converter units. Arguments as of `halo.draw_light`."""
    noise = []
    for kind, mirror in enumerate((halo.mirror_across, halo.mirror_along)):
        before = np.vstack([normals[kind, halo.pixels], others[kind]])
        noise.append(before - (mirror * before).sum(axis=0) * mirror)
    direction = halo.direction[0] + 1j * halo.direction[1]
    return direction * (halo.length + halo.along * noise[1] + 1j * halo.across * noise[0])
