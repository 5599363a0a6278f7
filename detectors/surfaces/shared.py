"""The fitted surface of a cloud, once for all detectors that judge it."""

import hashlib

import numpy as np

from detectors.surfaces.background import Background, background
from detectors.surfaces.surface import SurfaceConfig
from harness.vocabulary.geometry import Cloud


def shared_background(cloud: Cloud, mask: np.ndarray, config: SurfaceConfig) -> Background:
    """Return `background` of the cloud's points where ``mask`` (h, w) is true; do not write to it.

    A cloud keeps its surfaces by mask and settings. Raises UserError as `background` does."""
    key = config.model_dump_json(), hashlib.blake2b(mask.tobytes()).digest()
    if key not in cloud.surfaces:
        cloud.surfaces[key] = background(cloud, mask, config)
    return cloud.surfaces[key]
