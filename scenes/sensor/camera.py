"""Cameras as data: a YAML file in which every number has a tag and a source, checked against the model of its kind."""

from __future__ import annotations

import difflib
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

import numpy as np
from pydantic import Field, ValidationError, model_validator
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens
from harness.vocabulary.seeds import digest
from harness.vocabulary.units import MM

CAMERA_FOLDER = Path(__file__).resolve().parent.parent / "cameras"

T = TypeVar("T")
Positive = Field(gt=0)


class Fact(Config, Generic[T]):
    """One number of a camera with where it comes from.

    ``tag``: R read in the named public source, D derived from such, S one secondary source, W measured on public
    captures of a real unit, C calibrated at the calibration point, M a guess.
    """

    value: T
    tag: Literal["R", "D", "S", "W", "C", "M"]
    source: str


class LensFacts(Config):
    """The nominal lens; ``distortion`` is k1 k2 p1 p2 k3 k4 k5 k6 of OpenCV's rational model."""

    width_px: Fact[int]
    height_px: Fact[int]
    fx_px: Fact[float]
    fy_px: Fact[float]
    cx_px: Fact[float]
    cy_px: Fact[float]
    distortion: Fact[tuple[float, float, float, float, float, float, float, float]]

    def lens(self) -> Lens:
        """The lens in the program's own type."""
        return Lens(
            self.width_px.value,
            self.height_px.value,
            self.fx_px.value,
            self.fy_px.value,
            self.cx_px.value,
            self.cy_px.value,
            self.distortion.value,
        )


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
    lens: LensFacts
    emitter: EmitterFacts
    modulation: ModulationFacts
    photons: PhotonFacts
    converter: ConverterFacts
    fixed_pattern: FixedPatternFacts
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


class CameraConfig(Config):
    """Which camera an experiment uses, which unit of it, and which of its effects are on."""

    name: str = Field("azure_kinect_nfov", description="a file of scenes/cameras/ without its ending")
    unit_seed: int = Field(1, ge=0, description="which unit: its fixed pattern is drawn from this seed")
    noise: bool = Field(True, description="photon and read noise; false for the noise-free engine")
    fixed_pattern_scale: float = Field(
        1.0, ge=0, le=100, description="times the file's fixed pattern; 0 switches it off"
    )
    edge_gate: bool = Field(
        True,
        description="whether the engine's edge threshold acts; its rule is an inference, so studies vary it",
    )


def camera_names() -> tuple[str, ...]:
    """The cameras that come with tofpod."""
    return tuple(sorted(path.stem for path in CAMERA_FOLDER.glob("*.yaml")))


@lru_cache
def load_camera(name: str) -> AmcwCamera:
    """The camera of that name. Raises UserError for an unknown name or a file that does not describe a camera."""
    path = CAMERA_FOLDER / f"{name}.yaml"
    if name not in camera_names():
        near = difflib.get_close_matches(name, camera_names(), n=1)
        raise UserError(
            f"there is no camera {name!r}" + (f"; did you mean {near[0]!r}?" if near else ""),
            legal=", ".join(camera_names()),
            fix=f"to add one, write {path.name} in scenes/cameras/",
        )
    return read_camera(path)


def read_camera(path: Path) -> AmcwCamera:
    """Read one camera file. Raises UserError naming the file and each key that is missing, unknown or impossible."""
    try:
        data = YAML(typ="safe", pure=True).load(path.read_text())
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    except YAMLError as error:
        raise UserError(f"{path}: is no valid YAML: {error}") from error
    try:
        return AmcwCamera.from_data(data)
    except ValidationError as error:
        lines = [f"  {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()]
        raise UserError(f"{path} does not describe a camera:\n" + "\n".join(lines)) from error


def camera_digest(camera: AmcwCamera) -> str:
    """Digest of a camera's file: its numbers, tags and sources."""
    return digest(camera.to_data())
