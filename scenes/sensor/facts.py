"""What every camera's file holds, whatever its kind: numbers with their sources, the lens, the traits of a unit."""

from __future__ import annotations

from typing import Generic, Literal, TypeVar

from harness.vocabulary.config import Config
from harness.vocabulary.lens import Lens

T = TypeVar("T")


class Fact(Config, Generic[T]):
    """One number of a camera with where it comes from.

    ``tag``: R read in the named public source, D derived from such, S one secondary source, W measured on public
    captures of a real unit, C calibrated at the calibration point, M a guess, U set by the user of an experiment.
    """

    value: T
    tag: Literal["R", "D", "S", "W", "C", "M", "U"]
    source: str


class LensFacts(Config):
    """The nominal lens; ``distortion`` is k1 k2 p1 p2 [k3 [k4 k5 k6]] of OpenCV's model, or empty for none."""

    width_px: Fact[int]
    height_px: Fact[int]
    fx_px: Fact[float]
    fy_px: Fact[float]
    cx_px: Fact[float]
    cy_px: Fact[float]
    distortion: Fact[tuple[float, ...]]

    def lens(self) -> Lens:
        """The lens in the program's own type."""
        terms = self.distortion.value
        return Lens(
            self.width_px.value,
            self.height_px.value,
            self.fx_px.value,
            self.fy_px.value,
            self.cx_px.value,
            self.cy_px.value,
            (*terms, *(0.0,) * (8 - len(terms))),
        )


class UnitFacts(Config):
    """How one unit differs from the nominal camera as a whole, and its frames from each other; any kind of camera.

    ``offset_mm``: standard deviation between units of a constant error of range. ``drift_mm`` exp(-t / ``drift_min``):
    error of range after power-on, greater by ``drift_ramp`` of itself per unit of x/z. ``jump_rate``: share of frames
    that are displaced as a whole by ``jump_mm`` (its sign by chance); ``jitter_mm``: standard deviation of a small
    displacement that every frame has.
    """

    frames_per_second: Fact[float]
    offset_mm: Fact[float]
    drift_mm: Fact[float]
    drift_min: Fact[float]
    drift_ramp: Fact[float]
    jump_rate: Fact[float]
    jump_mm: Fact[float]
    jitter_mm: Fact[float]
