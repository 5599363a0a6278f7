"""What a real unit does besides noise, as switches: an experiment turns each off to see what it costs."""

from __future__ import annotations

from pydantic import Field

from harness.vocabulary.config import Config


class EffectsConfig(Config):
    """Which effects act. All on is the camera as it is; all off is a noise-free camera that sees direct light only.

    Albedo and wood grain are no effects: they act through the photons.
    """

    noise: bool = Field(True, description="shot and read noise on what the camera samples")
    multipath: bool = Field(True, description="light that met more than one surface")
    wiggling: bool = Field(True, description="what factory calibration leaves of the modulation's harmonics")
    fixed_pattern: bool = Field(True, description="the unit's own error of range in each pixel")
    unit_offset: bool = Field(True, description="the unit's own constant error of range")
    warm_up_drift: bool = Field(True, description="error of range that decays after power-on")
    ambient: bool = Field(
        True, description="light of the surroundings, as much as `ambient_uw_cm2_nm`: its noise, and the room it takes"
    )
    saturation: bool = Field(
        True, description="what exceeds a pixel's or its converter's full scale is cut off and invalid"
    )
    frame_jumps: bool = Field(True, description="whole frames displaced: rare jumps, and a small jitter")


NONE = EffectsConfig(**dict.fromkeys(EffectsConfig.model_fields, False))
"""Every effect off."""
