"""The numbers of a scanned lidar, as in its file."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, SPEED_OF_LIGHT_AIR, UW_CM2
from scenes.optics import FWHM_PER_DEVIATION, Optics
from scenes.sensor.common.facts import (
    CameraFacts,
    ConeFacts,
    Fact,
    NonNegative,
    OutputFacts,
    Positive,
    Share,
    SmoothPatternFacts,
    checked,
)

# deviations at which the smoothing's weights end: 0.04 of the central weight
SMOOTHING_REACH = 2.5
# seconds in a nanosecond, radians in a milliradian, watts in a milliwatt
NS = 1e-9
MRAD = 1e-3
MW = 1e-3


class BeamFacts(Config):
    """The beam at rest: round, Gaussian in angle."""

    fwhm_mrad: Annotated[
        Fact[float], checked("above 0 and at most 20 milliradians", lambda value: 0 < value <= 20)
    ]
    """Full width at half of its maximum."""
    power_mw: Positive
    """Mean over the code, a reference for ambient light."""


class ScanFacts(Config):
    """The raster: a column is one sweep."""

    point_ns: Positive
    """Time from one point to the next."""
    sweep_jitter_mm: NonNegative
    """Deviation of an error of a whole sweep."""


class CodeFacts(Config):
    """The code, and its correlation's pulse, assumed Gaussian."""

    period_ns: Positive
    """Time after which the code repeats."""
    correlation_fwhm_ns: Positive
    """Full width of the correlation's pulse at half of its maximum."""
    band_floor: Share
    """The spectrum ends at the last line above this share of its maximum."""
    integration_ns: Positive
    """Duration of the return that makes one point."""


class LidarPhotonFacts(Config):
    """The photon budget in primary electrons, before the avalanche, of one point's integration."""

    signal_electrons: Positive
    """Electrons from albedo 1 facing the camera at 1 m on the axis."""
    excess_noise_factor: Annotated[Fact[float], checked("1 or more", lambda value: value >= 1)]
    """Factor by which the avalanche multiplies the variance of shot noise."""
    amplifier_electrons: NonNegative
    """Standard deviation of the amplifier's noise."""
    band_nm: Positive
    """Width of the filter's band, for ambient light."""
    room_albedo: Share
    """Mean over the field, whose ambient light the detector sees."""
    full_scale_electrons: Positive
    """Light from which the detector saturates."""
    calibration_sigma_mm: Positive
    """Published temporal deviation of single pixels, to fit."""
    calibration_distance_m: Positive
    """Its distance."""
    calibration_albedo: Share
    """Its albedo."""
    calibration_reach_m: Positive
    """Published range at which half of the pixels are valid, to fit."""
    calibration_reach_albedo: Share
    """Its albedo."""


class LidarEngineFacts(OutputFacts):
    """Processing on the device."""

    smoothing_px: Annotated[
        Fact[tuple[float, float]], checked("from 0 to 6 pixels", lambda value: 0 <= value <= 6)
    ]
    """Standard deviations of the Gaussian weights of the average over neighbours along columns,
    then along rows; 0: none."""
    agree_deviations: Positive
    """Largest difference of a neighbour's half path, in its deviations."""
    least_agreeing: Share
    """Share of the weights that must agree."""
    confidence_electrons: NonNegative
    """Least strength."""


class ScannedLidar(CameraFacts):
    """A lidar that sends one beam per pixel, one after another; pixels are directions at the
    transmitter."""

    kind: Literal["scanned_lidar"]
    """Chooses this model."""
    receiver: Annotated[
        ConeFacts, Field(description="the one detector, of the whole field, beside the transmitter")
    ]
    beam: BeamFacts
    """The transmitter's beam."""
    scan: ScanFacts
    """The raster of its directions."""
    code: CodeFacts
    """The modulation."""
    photons: LidarPhotonFacts
    """The photon budget."""
    fixed_pattern: SmoothPatternFacts
    """Range errors that a unit's frames share."""
    engine: LidarEngineFacts
    """Processing on the device."""

    @model_validator(mode="after")
    def _possible(self) -> ScannedLidar:
        if not 0 < self.code.band_floor.value < 1:
            raise ValueError("code.band_floor must be above 0 and below 1")
        if self.integration_points > 3:
            raise ValueError("code.integration_ns may span at most three times scan.point_ns")
        if self.engine.min_range_mm.value * MM >= self.unambiguous_m:
            raise ValueError(
                "engine.min_range_mm must lie within the range of one period of the code"
            )
        if len(self.weights) < 3:
            raise ValueError(
                "code.period_ns must be longer: fewer than three spectral lines are within the band"
            )
        return self

    @property
    def period_s(self) -> float:
        """Period of the code, seconds."""
        return self.code.period_ns.value * NS

    @property
    def unambiguous_m(self) -> float:
        """Half the path of light in one period, metres."""
        return SPEED_OF_LIGHT_AIR * self.period_s / 2

    @property
    def integration_points(self) -> float:
        """Number of points whose time the integration of one point covers."""
        return self.code.integration_ns.value / self.scan.point_ns.value

    @cached_property
    def weights(self) -> np.ndarray:
        """Spectrum (K,) of the correlation's pulse on lines 1..K of the comb; 1 at frequency 0,
        which is removed."""
        deviation_s = self.code.correlation_fwhm_ns.value * NS / FWHM_PER_DEVIATION
        last_hz = np.sqrt(-2 * np.log(self.code.band_floor.value)) / (2 * np.pi * deviation_s)
        lines = np.arange(1, int(last_hz * self.period_s) + 1)
        phases = 2 * np.pi * lines / self.period_s * deviation_s
        return np.asarray(np.exp(-0.5 * phases**2))

    @cached_property
    def bandwidth_rad_s(self) -> float:
        """Root mean square angular frequency of the correlation's pulse."""
        omega = 2 * np.pi * np.arange(1, len(self.weights) + 1) / self.period_s
        return float(np.sqrt((self.weights * omega**2).sum() / self.weights.sum()))

    @cached_property
    def field_sr(self) -> float:
        """Solid angle of the field as a flat aperture sees it: foreshortened by the cosine to the
        axis."""
        lens = self.nominal_lens
        slopes = lens.region_slopes(lens.whole)
        return float((1 / (1 + (slopes**2).sum(axis=-1)) ** 2).sum() / (lens.fx * lens.fy))

    def ambient_electrons(self, irradiance_uw_cm2_nm: float) -> float:
        """Return the electrons of an integration from ambient light of that irradiance on the
        whole field. The field's solid angle sends a E / pi times it; the beam of power P sends,
        from albedo 1 at 1 m, P / pi."""
        photons = self.photons
        irradiance_w_m2 = irradiance_uw_cm2_nm * UW_CM2 * photons.band_nm.value
        from_field_w = irradiance_w_m2 * photons.room_albedo.value * self.field_sr
        over_beam = from_field_w / (self.beam.power_mw.value * MW)
        return photons.signal_electrons.value * over_beam

    @cached_property
    def smoothing_taps(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (2 r + 1,) float32 weights with sum 1, along columns and along rows."""
        along_columns_px, along_rows_px = self.engine.smoothing_px.value
        return _gaussian_taps(along_columns_px), _gaussian_taps(along_rows_px)

    @cached_property
    def optics(self) -> Optics:
        """Optics for the render: pixels are beams from the origin; the receiver takes the place of
        an emitter."""
        smeared_px = int(np.ceil(self.integration_points / 2))
        smoothed_px = max(len(taps) // 2 for taps in self.smoothing_taps)
        lines = range(1, len(self.weights) + 1)
        return self.optics_with(
            **self.receiver.optics(),
            frequencies_hz=tuple(float(k / self.period_s) for k in lines),
            beam_fwhm_rad=self.beam.fwhm_mrad.value * MRAD,
            margin_px=smeared_px + smoothed_px,
            farthest_m=self.unambiguous_m,
        )


def _gaussian_taps(deviation_px: float) -> np.ndarray:
    """Return (2 r + 1,) float32 weights of sum 1; a single one if the deviation is 0."""
    reach = int(np.ceil(SMOOTHING_REACH * deviation_px))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(deviation_px, 1e-9)) ** 2)
    return np.asarray((taps / taps.sum()).astype(np.float32))
