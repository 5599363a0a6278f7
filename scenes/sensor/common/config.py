"""The camera of an experiment as it is declared: its name, its unit, its effects."""

from typing import Annotated, Any

from pydantic import Field

from harness.vocabulary.config import Config
from harness.vocabulary.seeds import canonical_json


class EffectsConfig(Config):
    """Switches for the effects of a real unit. With all off, the camera is noise-free and sees
    direct light only."""

    noise: bool = Field(True, description="shot and read noise of the samples")
    multipath: bool = Field(True, description="light that was reflected by more than one surface")
    wiggling: bool = Field(
        True, description="error that harmonics of the modulation leave after factory calibration"
    )
    fixed_pattern: bool = Field(True, description="the unit's own range error of each pixel")
    unit_offset: bool = Field(True, description="the unit's own constant range error")
    warm_up_drift: bool = Field(True, description="range error that decays after power-on")
    ambient: bool = Field(
        True,
        description="noise and full-scale range that ambient light (`ambient_uw_cm2_nm`) takes",
    )
    saturation: bool = Field(
        True, description="pixels beyond their own or the converter's full scale are invalid"
    )
    frame_jumps: bool = Field(
        True, description="displacement of whole frames: rare jumps and a small jitter"
    )


NO_EFFECTS = EffectsConfig(**dict.fromkeys(EffectsConfig.model_fields, False))  # every effect off


class CameraConfig(Config):
    """The camera of an experiment: its name, the unit, the effects that are on, and the ambient
    light."""

    name: str = Field(
        "azure_kinect_nfov",
        description="a camera of tofpod or of an installed package, or the path of a .yaml file",
    )
    unit_seed: int = Field(
        1, ge=0, description="draws the unit's fixed pattern: another seed is another unit"
    )
    effects: EffectsConfig = EffectsConfig()
    fixed_pattern_scale: float = Field(
        1.0, ge=0, le=100, description="multiplies the file's fixed pattern; 0: off"
    )
    edge_gate: bool = Field(
        True, description="whether pixels at edges are invalid, by a rule inferred from data"
    )
    ambient_uw_cm2_nm: Annotated[float, Field(ge=0, le=200)] = Field(
        0.04,
        description="irradiance of ambient light at the camera's wavelength, in microwatts per "
        "square centimetre and nanometre: 0.04 in a room with 50 lux of daylight, 0.4 at a window "
        "(500 lux of sunlight), 80 in full sun",
    )
    minutes_since_power_on: float = Field(
        60.0, ge=0, le=1e5, description="time for which the unit has warmed up"
    )
    numbers: dict[str, Any] = Field(
        {}, description="replaces numbers of the camera file, such as lens.fx_px: 505.1"
    )

    def __hash__(self) -> int:
        # a mapping has no hash, and workers keep what they derived from a camera by its
        # declaration
        return hash(canonical_json(self.to_data()))
