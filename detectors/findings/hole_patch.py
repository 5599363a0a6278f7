"""The pixels around one detection as the model of a blurred hole is fitted to them."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

WALL_PRIOR = (0.5, 12.0**-0.5)
"""Prior mean and standard deviation of the wall, which is uniform from 0 to 1."""


class CameraView(NamedTuple):
    """All that a picture depends on beside the damage, as compiled functions take it. `HolePatch`
    has the meanings."""

    sights: np.ndarray
    metric_m2: np.ndarray
    blur_u: float
    blur_v: float
    soft: bool
    brightness: float
    half_m: float
    lens_u: float
    lens_v: float
    height: int
    """Of the picture, in pixels."""
    width: int


@dataclass(frozen=True)
class HolePatch:
    """Residuals around one detection, and how they come about."""

    residual_m: np.ndarray
    """(h, w), along the optical axis, positive behind the surface."""
    used: np.ndarray
    """(h, w) bool: the pixels that the fit uses."""
    metric_m2: np.ndarray
    """(2, 2): its quadratic form is the squared length of a pixel offset (du, dv)."""
    blur_px: tuple[float, float]
    """Sides, along u and along v, of the rectangle over which the image is averaged."""
    noise_m: float
    """Standard deviation of the residuals beside the hole."""
    sights: np.ndarray
    """(s, 8): the viewpoints (`sight`)."""
    soft: bool = False
    """True if the blur falls off from its middle like a lens' or a beam's: two rectangles in turn,
    of 1 / sqrt(2) of its sides; False if it ends sharply like a filter's window."""
    brightness: float = 0.0
    """Light from the floor over that from the face, by which the camera's filter weighs pixels; 0
    if it weighs all alike."""
    half_m: float = math.inf
    """Difference in depth at which the filter gives a pixel half of the weight."""
    lens_px: tuple[float, float] = (1.0, 1.0)
    """Sides of the rectangle of pixels over which the lens averages, before the filter does; 1
    where it is sharp (`lens_side`)."""
    shared_px: tuple[float, float] | None = None
    """Sides of the rectangle over which the noise is averaged; None: those of the blur."""

    @property
    def noise_px(self) -> tuple[float, float]:
        """Sides of the rectangle over which the noise is averaged."""
        return self.blur_px if self.shared_px is None else self.shared_px

    @property
    def view(self) -> CameraView:
        """The camera's view of it, as compiled functions take it."""
        height, width = self.used.shape
        return CameraView(
            sights=self.sights,
            metric_m2=self.metric_m2,
            blur_u=float(self.blur_px[0]),
            blur_v=float(self.blur_px[1]),
            soft=self.soft,
            brightness=float(self.brightness),
            half_m=float(self.half_m),
            lens_u=float(self.lens_px[0]),
            lens_v=float(self.lens_px[1]),
            height=height,
            width=width,
        )

    @property
    def prior_weight(self) -> float:
        """Misfit in metres that corresponds to a deviation of the wall by 1."""
        return self.noise_m * math.sqrt(math.prod(self.noise_px)) / WALL_PRIOR[1]


def lens_side(deviation_px: float) -> float:
    """Return the side of the rectangle of pixels, each in parts, that has the second moment of a
    blur: (s - 1) / s for sides up to 3, some (s^2 - 1) / 12 beyond."""
    variance_px2 = deviation_px**2
    if variance_px2 < 2.0 / 3.0:
        return 1.0 / (1.0 - variance_px2)
    return math.sqrt(12.0 * variance_px2 + 1.0)
