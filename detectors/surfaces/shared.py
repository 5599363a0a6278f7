"""The fitted surfaces of a cloud, each once for all detectors that judge it."""

import hashlib
from collections.abc import Callable
from typing import TypeVar, cast

import numpy as np

from detectors.surfaces.surface import Surface, SurfaceConfig, fit_surface
from harness.vocabulary.geometry import Cloud

Fitted = TypeVar("Fitted")


def shared(
    fit: Callable[[Cloud, np.ndarray, SurfaceConfig], Fitted],
    cloud: Cloud,
    mask: np.ndarray,
    config: SurfaceConfig,
) -> Fitted:
    """Return what ``fit`` makes of the cloud's points where ``mask`` (h, w) is true; do not write
    to it.

    A cloud keeps its surfaces by kind, mask and settings. Raises UserError as ``fit`` does."""
    key = fit, config.model_dump_json(), hashlib.blake2b(mask.tobytes()).digest()
    if key not in cloud.surfaces:
        cloud.surfaces[key] = fit(cloud, mask, config)
    return cast("Fitted", cloud.surfaces[key])


def stated_surface(cloud: Cloud, mask: np.ndarray, config: SurfaceConfig) -> Surface:
    """Return `fit_surface` of the cloud's points where ``mask`` (h, w) is true."""
    x_m, y_m, z_m = cloud.points_m[mask].T
    return fit_surface(x_m, y_m, z_m, config)
