"""The numbers of an empirical camera, as in its file: statistics of a real unit's captures."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM
from scenes.optics import Optics
from scenes.sensor.common.facts import (
    CameraFacts,
    Fact,
    LimitFacts,
    NonNegative,
    Positive,
    PositiveEach,
    ShareEach,
    checked,
)

# its phase gives a pixel's mean distance, unambiguous up to 150 m; complex64 rounds by 2 um
CARRIER_HZ = 1e6
# margin of a region in deviations of the edge's kernel: 0.3 % of the kernel lies beyond
BLUR_REACH = 3.0

Taps = Fact[tuple[float, ...]]  # taps of a causal filter; their squares sum to 1


class SurfaceLightFacts(Config):
    """The recorded surface as a standard of brightness."""

    amplitude_at_1m: Positive
    """Amplitude in the recording's units, facing the camera; it falls with the square of the
    distance."""
    albedo: Annotated[Fact[float], checked("above 0 and at most 1", lambda value: 0 < value <= 1)]
    """Assumed for that surface."""


class NoiseLawFacts(Config):
    """Temporal noise of single pixels along the ray, before rounding."""

    range_mm: PositiveEach
    """Ranges of the table, increasing."""
    sigma_mm: PositiveEach
    """Deviations of the recorded surface, facing, at these; logarithms are interpolated."""
    range_exponent: NonNegative
    """Power of range that holds beyond the table's ends."""
    brightness_exponent: NonNegative
    """e: a surface b times as bright has b^-e times the noise."""
    rows: Taps
    """Filter down the columns."""
    columns: Taps
    """Filter across the rows."""


class FilteredPatternFacts(Config):
    """Fixed pattern, the same in every frame of a unit: white noise after two filters."""

    deviation_mm: NonNegative
    """Its deviation."""
    rows: Taps
    """Filter down the columns."""
    columns: Taps
    """Filter across the rows."""


class DropoutFacts(Config):
    """Probability of no return in a frame."""

    amplitude: PositiveEach
    """Amplitudes of the table, increasing."""
    share: ShareEach
    """Probabilities at these, interpolated over the logarithm of the amplitude."""


class EdgeKernelFacts(Config):
    """Losses at steps of depth between neighbours."""

    gap_px: Annotated[Fact[float], checked("from 0 to 100 pixels", lambda value: 0 <= value <= 100)]
    """Width of the band across a step in which there is no return."""
    blur_px: Annotated[Fact[float], checked("from 0 to 30 pixels", lambda value: 0 <= value <= 30)]
    """Deviation of the Gaussian that smooths depth everywhere."""
    least_step_mm: Positive
    """Smallest step that loses returns."""


class RangeErrorFacts(Config):
    """Error of range that all frames of the measured unit share, along each ray: measured = scale
    * true + bias."""

    scale: Annotated[Fact[float], checked("from 0.5 to 2", lambda value: 0.5 <= value <= 2)]
    """Measured over true change of range."""
    bias_mm: Annotated[Fact[float], checked("up to 1000 mm", lambda value: abs(value) <= 1000)]
    """Measured range minus scale times true range."""


class EmpiricalCamera(CameraFacts):
    """Any depth camera, described by the statistics of its captures."""

    kind: Literal["empirical"]
    """Chooses this model."""
    light: SurfaceLightFacts
    """The recorded surface."""
    noise: NoiseLawFacts
    """Temporal noise."""
    fixed_pattern: FilteredPatternFacts
    """Range errors that a unit's frames share."""
    dropouts: DropoutFacts
    """Pixels without a return."""
    edge: EdgeKernelFacts
    """Losses at steps of depth."""
    engine: LimitFacts
    """Limits and step of the output."""
    range_error: RangeErrorFacts | None = None
    """Scale and bias of the unit, which a gauge shows; none without it. A part of the effect "unit
    offset"."""

    @model_validator(mode="after")
    def _possible(self) -> EmpiricalCamera:
        _check_table("noise.range_mm", self.noise.range_mm, "noise.sigma_mm", self.noise.sigma_mm)
        _check_table(
            "dropouts.amplitude", self.dropouts.amplitude, "dropouts.share", self.dropouts.share
        )
        return self

    @cached_property
    def optics(self) -> Optics:
        """Optics for the render: a light source in the lens, which casts no shadows; the margin of
        the edge kernel."""
        blur_px = BLUR_REACH * self.edge.blur_px.value
        half_gap_px = self.edge.gap_px.value / 2
        return self.optics_with(
            emitter_m=np.zeros(3),
            full_half_angle_deg=89.0,
            cutoff_half_angle_deg=89.9,
            frequencies_hz=(CARRIER_HZ,),
            margin_px=int(np.ceil(blur_px) + np.ceil(half_gap_px)) + 1,
            farthest_m=self.engine.max_range_mm.value * MM,
        )


def _check_table(
    levels_key: str,
    levels: Fact[tuple[float, ...]],
    values_key: str,
    values: Fact[tuple[float, ...]],
) -> None:
    """Raise ValueError unless the levels of a table increase and each has a value."""
    increasing = sorted(set(levels.value))
    if (
        not levels.value
        or len(levels.value) != len(values.value)
        or list(levels.value) != increasing
    ):
        raise ValueError(
            f"{levels_key} must increase, and {values_key} needs a value for each of them"
        )
