"""The numbers of an empirical camera, as in its file: statistics of a real unit's captures."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM
from scenes.optics import Optics
from scenes.sensor.facts import (
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
BLUR_REACH = (
    3.0  # margin of a region in deviations of the edge's kernel: 0.3 % of the kernel lies beyond
)

Taps = Fact[tuple[float, ...]]  # taps of a causal filter; their squares sum to 1


class SurfaceLightFacts(Config):
    """The recorded surface as a standard of brightness. ``amplitude_at_1m``: in the recording's
    units, facing the camera; amplitudes fall with the square of the distance. ``albedo``: assumed
    for that surface."""

    amplitude_at_1m: Positive
    albedo: Annotated[Fact[float], checked("above 0 and at most 1", lambda value: 0 < value <= 1)]


class NoiseLawFacts(Config):
    """Temporal noise of single pixels along the ray, before rounding. ``sigma_mm``: of the
    recorded surface, facing, at each of ``range_mm``; logarithms are interpolated; beyond the ends
    the power ``range_exponent`` holds. A surface b times as bright has b^-``brightness_exponent``
    times the noise. ``rows``, ``columns``: filters down, across."""

    range_mm: PositiveEach
    sigma_mm: PositiveEach
    range_exponent: NonNegative
    brightness_exponent: NonNegative
    rows: Taps
    columns: Taps


class FilteredPatternFacts(Config):
    """Fixed pattern, the same in every frame of a unit: white noise of ``deviation_mm`` after two
    filters."""

    deviation_mm: NonNegative
    rows: Taps
    columns: Taps


class DropoutFacts(Config):
    """Probability of no return in a frame: ``share`` at each of ``amplitude``, interpolated over
    its logarithm."""

    amplitude: PositiveEach
    share: ShareEach


class EdgeKernelFacts(Config):
    """Losses at steps of depth of ``least_step_mm`` or more between neighbours: no return in a
    band of ``gap_px`` across them. ``blur_px``: deviation of the Gaussian that smooths depth
    everywhere."""

    gap_px: Annotated[Fact[float], checked("from 0 to 100 pixels", lambda value: 0 <= value <= 100)]
    blur_px: Annotated[Fact[float], checked("from 0 to 30 pixels", lambda value: 0 <= value <= 30)]
    least_step_mm: Positive


class EmpiricalCamera(CameraFacts):
    """Any depth camera, described by the statistics of its captures."""

    kind: Literal["empirical"]
    light: SurfaceLightFacts
    noise: NoiseLawFacts
    fixed_pattern: FilteredPatternFacts
    dropouts: DropoutFacts
    edge: EdgeKernelFacts
    engine: LimitFacts

    @model_validator(mode="after")
    def _possible(self) -> EmpiricalCamera:
        for section, key, other in (
            ("noise", "range_mm", "sigma_mm"),
            ("dropouts", "amplitude", "share"),
        ):
            levels = getattr(getattr(self, section), key).value
            values = getattr(getattr(self, section), other).value
            if not levels or len(levels) != len(values) or list(levels) != sorted(set(levels)):
                raise ValueError(
                    f"{section}.{key} must increase, and {section}.{other} needs a value for each of them"
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
