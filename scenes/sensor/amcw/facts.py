"""The numbers of a continuous-wave imager, as its file holds them."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.units import MM
from scenes.optics import Optics, PixelFootprint
from scenes.sensor.amcw.unwrap import unwrap_table
from scenes.sensor.facts import (
    CameraFacts,
    Fact,
    HalfAngle,
    LengthPx,
    NonNegative,
    Positive,
    PositiveInt,
    Share,
    above_zero,
    checked,
    share,
)

PositiveEach = Annotated[Fact[tuple[float, ...]], above_zero]
Contrasts = Annotated[Fact[tuple[float, ...]], checked("above 0 and at most 1", lambda value: 0 < value <= 1)]
ShareEach = Annotated[Fact[tuple[float, ...]], share]
Window = Annotated[Fact[int], checked("an odd number from 1 to 31", lambda value: 0 < value < 32 and value % 2 == 1)]
Phases = Annotated[Fact[int], checked("3 or more, to tell phase, amplitude and offset apart", lambda value: value >= 3)]
WIDEST_PX = 2128
"""Longest row, the filter's window included: `kernels.STRIDE`, written again so that declarations compile nothing."""


def _turns_one_way(corners: np.ndarray) -> bool:
    """Tell whether corners (n, 2) go round a convex area counter-clockwise in axes x right, y down as the file has
    them."""
    if len(corners) < 3:
        return False
    sides = np.roll(corners, -1, axis=0) - corners
    after = np.roll(sides, -1, axis=0)
    return bool((sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0] > 0).all())


class EmitterFacts(Config):
    """The light source: a point beside the lens, uniform intensity in a cone with a linear roll-off.

    ``irradiance_w_m2``: its light on a surface that faces it on the axis at 1 m, averaged over an exposure; only
    ambient light is measured by it. ``mask_slopes``: corners (x/z, y/z), counter-clockwise in the image's axes, of a
    convex polygon outside which the camera gives no range; None where there is none.
    """

    position_mm: Fact[tuple[float, float, float]]
    full_half_angle_deg: HalfAngle
    cutoff_half_angle_deg: HalfAngle
    irradiance_w_m2: Positive
    mask_slopes: Fact[tuple[tuple[float, float], ...]] | None = None

    @model_validator(mode="after")
    def _rolls_off_outwards(self) -> EmitterFacts:
        if self.cutoff_half_angle_deg.value <= self.full_half_angle_deg.value:
            raise ValueError("cutoff_half_angle_deg must be above full_half_angle_deg")
        if self.mask_slopes is not None and not _turns_one_way(np.array(self.mask_slopes.value)):
            raise ValueError(
                "mask_slopes must be the corners of a convex polygon, counter-clockwise in the image's axes"
            )
        return self


class ModulationFacts(Config):
    """Continuous-wave modulation: one value per frequency but for ``phases``.

    ``contrast``: amplitude of the fundamental by the light's mean. ``wiggling_residual``: what is left, after limited
    bandwidth and factory calibration, of the harmonics that square light under square demodulation would show.
    """

    frequencies_hz: PositiveEach
    phases: Phases
    contrast: Contrasts
    wiggling_residual: ShareEach

    @model_validator(mode="after")
    def _one_value_each(self) -> ModulationFacts:
        count = len(self.frequencies_hz.value)
        if not 1 <= count <= 3:
            raise ValueError(f"there are {count} frequencies_hz; this kind of camera has 1, 2 or 3")
        for key in ("contrast", "wiggling_residual"):
            if len(getattr(self, key).value) != count:
                raise ValueError(f"{key} needs one value for each of the {count} frequencies_hz")
        if len(set(self.frequencies_hz.value)) != count:
            raise ValueError("frequencies_hz names a frequency twice")
        try:
            unwrap_table(self.frequencies_hz.value, "least_squares")
        except UserError as mistake:
            raise ValueError(f"frequencies_hz: {mistake.message}; legal: {mistake.legal}") from mistake
        return self


class PhotonFacts(Config):
    """The photon budget: one gain, calibrated at one point; the rest is physics.

    ``signal_electrons``: of both wells in one exposure, albedo 1, facing, on the axis at 1 m. ``full_well_electrons``
    of one well (None: only the converter saturates). ``band_nm``: width of the band-pass filter before the sensor.
    """

    signal_electrons: Positive
    calibration_sigma_mm: Positive
    calibration_distance_m: Positive
    calibration_albedo: Positive
    read_noise_electrons: NonNegative
    electrons_per_unit: Positive
    full_well_electrons: Positive | None = None
    band_nm: Positive


class ConverterFacts(Config):
    """Companding converter of a sample's size: unit steps below twice the knee, doubling with each octave above.

    A knee of half the full scale or more makes a linear converter.
    """

    knee_units: PositiveInt
    full_scale_units: PositiveInt


class FixedPatternFacts(Config):
    """Fixed pattern, the same in every frame of a unit: a smooth and a per-pixel error of range."""

    smooth_mm: NonNegative
    smooth_length_px: LengthPx
    pixel_mm: NonNegative


class ResidualByAmplitudeFacts(Config):
    """Lattice residual that dim pixels may have: ``scale_turns`` A^``slope`` of the amplitude A of the brightest
    frequency, at most ``greatest_turns`` and at least the engine's ``lattice_residual_turns``."""

    scale_turns: Positive
    slope: Fact[float]
    greatest_turns: Positive


class FlyingPixelFacts(Config):
    """The gate on the finished range image, 3x3: a pixel goes where its neighbours reach more than ``near_mm`` nearer
    and ``far_mm`` farther, either more than ``most_mm``, and their summed amplitudes scatter by ``relative_deviation``
    of their mean or more (the mean taken as at least ``least_mean_units``)."""

    relative_deviation: NonNegative
    least_mean_units: NonNegative
    near_mm: NonNegative
    far_mm: NonNegative
    most_mm: NonNegative


class EngineFacts(Config):
    """The depth engine: phase-space filter, unwrapping, fusion, gates, output. A gate that is left out is none.

    ``filter_on``: each phasor counts by its weight alone (``unit_phasors``), or by its amplitude too (``phasors``).
    ``spatial_sigma_px``: Gaussian of the window; None is a box. A centre not brighter than ``dim_amplitude_units`` gets
    weights by distance alone; before a brighter one, dimmer neighbours are dropped where ``drop_dim_neighbours``.
    ``amplitude_gains`` multiply each frequency's amplitude before all gates. ``limits_along``: whether the limits of
    range are meant along the ray or along the optical axis.
    """

    window_px: Window
    filter_on: Fact[Literal["unit_phasors", "phasors"]]
    spatial_sigma_px: Positive | None = None
    concentration: NonNegative
    dim_amplitude_units: NonNegative
    drop_dim_neighbours: Fact[bool]
    fusion: Fact[Literal["least_squares", "mean"]]
    amplitude_gains: PositiveEach
    edge_threshold: Positive | None = None
    lattice_residual_turns: Positive | None = None
    residual_by_amplitude: ResidualByAmplitudeFacts | None = None
    amplitude_ratio: Share | None = None
    min_amplitude_units: NonNegative
    min_amplitude_sum_units: NonNegative
    min_reflectivity_units_mm2: NonNegative | None = None
    min_range_mm: Positive
    max_range_mm: Positive
    limits_along: Fact[Literal["ray", "axis"]]
    flying_pixels: FlyingPixelFacts | None = None
    output_step_mm: Positive

    @model_validator(mode="after")
    def _gates_can_hold(self) -> EngineFacts:
        if self.min_range_mm.value >= self.max_range_mm.value:
            raise ValueError("min_range_mm must be less than max_range_mm")
        if self.residual_by_amplitude and not self.lattice_residual_turns:
            raise ValueError("residual_by_amplitude needs lattice_residual_turns, the least that it gives")
        return self


class AmcwCamera(CameraFacts):
    """A continuous-wave time-of-flight imager: everything that its model needs, as data."""

    kind: Literal["amcw_imager"]
    emitter: EmitterFacts
    modulation: ModulationFacts
    photons: PhotonFacts
    converter: ConverterFacts
    fixed_pattern: FixedPatternFacts
    engine: EngineFacts

    @model_validator(mode="after")
    def _parts_fit_each_other(self) -> AmcwCamera:
        widest_px = WIDEST_PX - self.engine.window_px.value + 1
        if self.lens.width_px.value > widest_px:
            raise ValueError(f"lens.width_px is {self.lens.width_px.value}; the model takes {widest_px} at most")
        if len(self.engine.amplitude_gains.value) != len(self.frequencies_hz):
            raise ValueError("engine.amplitude_gains needs one value for each of modulation.frequencies_hz")
        return self

    @cached_property
    def emitter_position_m(self) -> np.ndarray:
        """(3,) in the camera's frame."""
        return np.array(self.emitter.position_mm.value) * MM

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Modulation frequencies in the file's order."""
        return self.modulation.frequencies_hz.value

    @property
    def margin_px(self) -> int:
        """Pixels beyond a region whose light reaches it through the engine's windows."""
        return self.engine.window_px.value // 2 + (1 if self.engine.flying_pixels else 0)

    @property
    def z_step_m(self) -> float:
        """The rounding step of the output's z."""
        return self.engine.output_step_mm.value * MM

    @cached_property
    def optics(self) -> Optics:
        """Optics of this camera for the render."""
        return Optics(
            title=self.title,
            lens=self.nominal_lens,
            emitter_m=self.emitter_position_m,
            full_half_angle_deg=self.emitter.full_half_angle_deg.value,
            cutoff_half_angle_deg=self.emitter.cutoff_half_angle_deg.value,
            frequencies_hz=self.frequencies_hz,
            footprint=PixelFootprint(),
            wavelength_nm=self.wavelength_nm.value,
            margin_px=self.margin_px,
            nearest_m=self.engine.min_range_mm.value * MM,
            farthest_m=self.engine.max_range_mm.value * MM,
            limits_along=self.engine.limits_along.value,
        )
