"""The numbers of a continuous-wave imager, as its file holds them."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydantic import model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.lens import Lens
from harness.vocabulary.units import MM
from scenes.optics import Optics, PixelFootprint
from scenes.sensor.facts import Fact, LensFacts, UnitFacts


class EmitterFacts(Config):
    """The light source: a point beside the lens, uniform intensity in a cone with a linear roll-off."""

    position_mm: Fact[tuple[float, float, float]]
    full_half_angle_deg: Fact[float]
    cutoff_half_angle_deg: Fact[float]
    mask_slopes: Fact[tuple[tuple[float, float], ...]]


class ModulationFacts(Config):
    """Continuous-wave modulation."""

    frequencies_hz: Fact[tuple[float, ...]]
    phases: Fact[int]
    contrast: Fact[tuple[float, ...]]


class PhotonFacts(Config):
    """The photon budget: one gain, calibrated at one point; the rest is physics."""

    signal_electrons: Fact[float]
    calibration_sigma_mm: Fact[float]
    calibration_distance_m: Fact[float]
    calibration_albedo: Fact[float]
    ambient_electrons: Fact[float]
    read_noise_electrons: Fact[float]
    electrons_per_unit: Fact[float]


class ConverterFacts(Config):
    """Companding converter: unit steps below the knee, then steps that double with each octave."""

    knee_units: Fact[int]
    full_scale_units: Fact[int]


class FixedPatternFacts(Config):
    """What is the same in every frame of one unit: a smooth and a per-pixel error of range."""

    smooth_mm: Fact[float]
    smooth_length_px: Fact[float]
    pixel_mm: Fact[float]


class EngineFacts(Config):
    """The depth engine: phase-space filter, gates, output."""

    window_px: Fact[int]
    concentration: Fact[float]
    dim_amplitude_units: Fact[float]
    edge_threshold: Fact[float]
    lattice_residual_turns: Fact[float]
    amplitude_ratio: Fact[float]
    min_amplitude_units: Fact[float]
    min_amplitude_sum_units: Fact[float]
    min_reflectivity_units_mm2: Fact[float]
    min_range_mm: Fact[float]
    max_range_mm: Fact[float]
    output_step_mm: Fact[float]


class AmcwCamera(Config):
    """A continuous-wave time-of-flight imager: everything that its model needs, as data."""

    name: str
    title: str
    kind: Literal["amcw_imager"]
    wavelength_nm: Fact[float]
    lens: LensFacts
    emitter: EmitterFacts
    modulation: ModulationFacts
    photons: PhotonFacts
    converter: ConverterFacts
    fixed_pattern: FixedPatternFacts
    unit: UnitFacts
    engine: EngineFacts

    @model_validator(mode="after")
    def _possible(self) -> AmcwCamera:
        must_be_positive: dict[str, Any] = {
            "lens.width_px": self.lens.width_px,
            "lens.height_px": self.lens.height_px,
            "lens.fx_px": self.lens.fx_px,
            "lens.fy_px": self.lens.fy_px,
            "photons.signal_electrons": self.photons.signal_electrons,
            "photons.electrons_per_unit": self.photons.electrons_per_unit,
            "engine.window_px": self.engine.window_px,
            "engine.output_step_mm": self.engine.output_step_mm,
        }
        for key, fact in must_be_positive.items():
            if not fact.value > 0:
                raise ValueError(f"{key} must be above 0, not {fact.value}")
        if min(self.modulation.frequencies_hz.value) <= 0:
            raise ValueError("modulation.frequencies_hz must all be above 0")
        if len(self.modulation.contrast.value) != len(self.modulation.frequencies_hz.value):
            raise ValueError("modulation.contrast needs one value for each of modulation.frequencies_hz")
        if self.modulation.phases.value < 3:
            raise ValueError("modulation.phases must be at least 3 to tell phase, amplitude and offset apart")
        if self.engine.window_px.value % 2 == 0:
            raise ValueError("engine.window_px must be odd")
        return self

    @cached_property
    def nominal_lens(self) -> Lens:
        """The lens of the file."""
        return self.lens.lens()

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
        """Pixels beyond a region whose light reaches it through the engine's window."""
        return self.engine.window_px.value // 2

    @property
    def z_step_m(self) -> float:
        """The rounding step of the output's z."""
        return self.engine.output_step_mm.value * MM

    @cached_property
    def optics(self) -> Optics:
        """What the render needs of this camera."""
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
        )
