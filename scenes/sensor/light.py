"""Which light of a view counts for a camera, by the effects that are on."""

from __future__ import annotations

import numpy as np

from scenes.sensor.effects import EffectsConfig
from scenes.view import NoiseFreeView


def light_of(view: NoiseFreeView, effects: EffectsConfig) -> tuple[np.ndarray, np.ndarray]:
    """Phasors (f, h, w) and intensity (h, w) of all light, or of direct light only where multipath is off.

    The intensity of the direct part is taken as its longest phasor over the frequencies: exact where one surface fills
    the pixel, too small where the phasors of two surfaces cancel at every frequency.
    """
    if effects.multipath:
        return view.phasor, view.intensity
    return view.phasor_direct, np.minimum(np.abs(view.phasor_direct).max(axis=0), view.intensity)
