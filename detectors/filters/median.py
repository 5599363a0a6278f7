"""A median over a square of pixels, as cameras and OpenCV's users apply it to depth images.

Sources: Luxonis DepthAI, ``StereoDepthConfig.MedianFilter`` (kernels of 3 x 3 and 5 x 5 px; 7 x 7,
which OpenCV offers for 8 bits alone, is left out), and OpenCV, ``medianBlur``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from detectors.filters.interface import DepthFunction, in_metres, in_units
from harness.vocabulary.config import Config


class MedianConfig(Config):
    """``kernel_size``: side of the square in pixels."""

    kernel_size: Literal[3, 5] = 5


@dataclass(frozen=True)
class MedianFilter:
    """Takes the median of a square (OpenCV's ``medianBlur``).

    A missing pixel counts as 0, as in the stored picture: gaps that fill less than half of the
    square close with too near a depth, larger ones lose corners. Pixels beyond the border repeat
    those on it."""

    settings: MedianConfig
    """Its settings."""
    settings_type = MedianConfig
    name = "median"
    version = 1

    def started(self, unit_m: float, *, whole: bool) -> DepthFunction:
        """Return the function, which remembers no frame."""

        def filtered(z_m: np.ndarray) -> np.ndarray:
            units = in_units(z_m, unit_m, whole=whole)
            return in_metres(cv2.medianBlur(units, self.settings.kernel_size), unit_m)

        return filtered
