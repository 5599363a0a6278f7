"""The interface of a filter: it turns the depth images of a stream into others, as a camera's
driver does before anybody averages them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from harness.vocabulary.config import Config

DepthFunction = Callable[[np.ndarray], np.ndarray]
"""A function from z (h, w) float32 in metres, NaN where a pixel has none, to z of the same shape.
It may change its argument."""


@runtime_checkable
class DepthFilter(Protocol):
    """A filter with its settings. Its class has ``settings_type``, a Config."""

    @property
    def name(self) -> str:
        """Its name in experiments and tables."""
        ...

    @property
    def version(self) -> int:
        """Its version, which rises when its numbers change: results of another version are not
        used again."""
        ...

    def started(self, unit_m: float, *, whole: bool) -> DepthFunction:
        """Return the function for the frames of one stream in their order; it may remember earlier
        ones. ``unit_m`` is the step of the stored depth, in which vendors state thresholds;
        ``whole``: whether depth is stored in whole steps."""
        ...


class NoSettings(Config):
    """A filter without settings."""


@dataclass(frozen=True)
class FunctionFilter:
    """A plain function from depth to depth, which remembers nothing, as a filter."""

    name: str
    """Its name."""
    function: DepthFunction
    """The function."""
    version: int = 1
    """Its version."""

    def started(self, unit_m: float, *, whole: bool) -> DepthFunction:
        """Return the function."""
        return self.function


def in_units(z_m: np.ndarray, unit_m: float, *, whole: bool) -> np.ndarray:
    """Return z (h, w) float32 in steps of the stored depth, 0 where a pixel has none, as drivers
    hold it. Numbers of 16 bits are exact in this type."""
    units = np.nan_to_num(z_m / unit_m).astype(np.float32)
    return np.round(units) if whole else units


def in_metres(units: np.ndarray, unit_m: float) -> np.ndarray:
    """Return the inverse of `in_units`."""
    return np.where(units > 0, units * np.float32(unit_m), np.float32(np.nan))
