"""The parts of every camera file, whatever the kind: numbers with sources, the lens, the
properties of a unit."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Any, Generic, Literal, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.geometry import MM, Lens, Region
from scenes.optics import Optics

T = TypeVar("T")

TERMS = (0, 4, 5, 8)  # numbers of distortion coefficients in OpenCV's models
# largest error of a pixel after undistortion and distortion; good lenses have 1e-6
WORST_PX = 0.01
STEEPEST = 6.0  # slope from the axis up to which distortion is checked: 80 degrees


class Fact(Config, Generic[T]):
    """One number of a camera with its origin. ``tag``: R read in the named public source, D
    derived from such, S a single secondary source, W measured on public captures, O measured on
    the owner's by `tofpod characterise`, C calibrated, M a guess, G a guess of the precision with
    its ``range``, U set by the user of an experiment."""

    value: T
    tag: Literal["R", "D", "S", "W", "O", "C", "M", "G", "U"]
    source: str
    range: tuple[float, float] | None = None

    @model_validator(mode="after")
    def _guess_has_a_range(self) -> Fact[T]:
        message = "a number with the tag G, and no other, states the `range` that it may lie in"
        if (self.tag == "G") != (self.range is not None):
            raise ValueError(message)
        if self.range is not None:
            low, high = self.range
            value: Any = self.value
            if not low <= value <= high:
                raise ValueError(message)
        return self


def checked(legal: str, holds: Callable[[Any], bool]) -> AfterValidator:
    """Return a validator of a fact whose value, or each of its values, must satisfy what ``legal``
    states."""

    def check(fact: Fact[Any]) -> Fact[Any]:
        for value in fact.value if isinstance(fact.value, tuple) else (fact.value,):
            if not holds(value):
                raise ValueError(f"the value is {value}; it must be {legal}")
        return fact

    return AfterValidator(check)


ABOVE_0 = checked("above 0", lambda value: value > 0)
TO_1 = checked("from 0 to 1", lambda value: 0 <= value <= 1)
PositiveInt = Annotated[Fact[int], ABOVE_0]
Positive = Annotated[Fact[float], ABOVE_0]
PositiveEach = Annotated[Fact[tuple[float, ...]], ABOVE_0]
NonNegative = Annotated[Fact[float], checked("0 or more", lambda value: value >= 0)]
Share = Annotated[Fact[float], TO_1]
ShareEach = Annotated[Fact[tuple[float, ...]], TO_1]
LengthPx = Annotated[
    Fact[float], checked("above 0 and at most 1000 pixels", lambda value: 0 < value <= 1000)
]
HalfAngle = Annotated[
    Fact[float], checked("above 0 and below 90 degrees", lambda value: 0 < value < 90)
]
Wavelength = Annotated[
    Fact[float], checked("from 300 to 2000 nanometres", lambda value: 300 <= value <= 2000)
]


class LensFacts(Config):
    """The nominal lens. ``distortion``: k1 k2 p1 p2 [k3 [k4 k5 k6]] of OpenCV's model, or empty.
    Pixels beyond ``field_half_angle_deg`` see nothing, and distortion may fold there; None: the
    image covers the sensor."""

    width_px: PositiveInt
    height_px: PositiveInt
    fx_px: Positive
    fy_px: Positive
    cx_px: Fact[float]
    cy_px: Fact[float]
    distortion: Fact[tuple[float, ...]]
    field_half_angle_deg: HalfAngle | None = None

    @model_validator(mode="after")
    def _sees_each_direction_once(self) -> LensFacts:
        if (count := len(self.distortion.value)) not in TERMS:
            raise ValueError(
                f"distortion has {count} terms; OpenCV's models have {', '.join(map(str, TERMS))}"
            )
        lens = self.lens()
        across = max(lens.cx, lens.width - 1 - lens.cx)
        down = max(lens.cy, lens.height - 1 - lens.cy)
        corner = float(np.hypot(across / lens.fx, down / lens.fy))
        limit = unfolded_slope(lens.distortion)
        if (ends := min(corner, self.image_radius)) > limit:
            end = "corner of the sensor lies" if corner < self.image_radius else "field ends"
            folds = f"distortion folds the image: it turns back at {limit:.3g} focal lengths from the axis"
            raise ValueError(f"{folds}, and the {end} at {ends:.3g}")
        u, v = (
            a.ravel()
            for a in np.meshgrid(
                np.linspace(0, lens.width - 1, 9), np.linspace(0, lens.height - 1, 9)
            )
        )
        seen = np.hypot((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy) < self.image_radius
        u = u[seen]
        v = v[seen]
        again = lens.project(np.concatenate([lens.slopes(u, v), np.ones((u.size, 1))], axis=-1))
        if not (np.abs(again - np.stack([u, v], axis=-1)) < WORST_PX).all():
            raise ValueError(
                "distortion folds the image: somewhere on the sensor no direction leads to a pixel"
            )
        return self

    @cached_property
    def image_radius(self) -> float:
        """Radius of the lens's image in focal lengths; infinite if it covers the sensor."""
        if self.field_half_angle_deg is None:
            return float("inf")
        slope = np.tan(np.deg2rad([self.field_half_angle_deg.value]))
        return float(distorted_slope(slope, self.lens().distortion)[0])

    def outside_field(self, region: Region) -> np.ndarray:
        """Return (h, w) bool: pixels beyond the lens's image."""
        lens = self.lens()
        v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
        return np.asarray(
            np.hypot((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy) > self.image_radius
        )

    def lens(self) -> Lens:
        """The lens as a `Lens` of the program."""
        width = self.width_px.value
        height = self.height_px.value
        terms = self.distortion.value
        centre = self.cx_px.value, self.cy_px.value
        return Lens(
            width, height, self.fx_px.value, self.fy_px.value, *centre, (*terms, *(0.0,) * 8)[:8]
        )


class UnitFacts(Config):
    """Differences of a unit from the nominal camera, and of its frames from each other.
    ``offset_mm``: deviation between units of a constant range error. ``drift_mm`` exp(-t /
    ``drift_min``): range error after power-on, greater by ``drift_ramp`` of itself per unit of
    x/z. ``jump_rate``: share of frames that are displaced as a whole by ``jump_mm``, either way.
    ``jitter_mm``: deviation of a small displacement of every frame."""

    frames_per_second: Positive
    offset_mm: NonNegative
    drift_mm: Fact[float]
    drift_min: Positive
    drift_ramp: Fact[float]
    jump_rate: Share
    jump_mm: NonNegative
    jitter_mm: NonNegative


class SmoothPatternFacts(Config):
    """A fixed pattern, which is the same in every frame of a unit: a smooth range error."""

    smooth_mm: NonNegative
    smooth_length_px: LengthPx


class OutputFacts(Config):
    """The smallest range that a camera gives, and the step of the stored z."""

    min_range_mm: NonNegative
    output_step_mm: Positive


class LimitFacts(OutputFacts):
    """Limits of range."""

    max_range_mm: Positive

    @model_validator(mode="after")
    def _range_is_left(self) -> Self:
        if self.min_range_mm.value >= self.max_range_mm.value:
            raise ValueError("min_range_mm must be less than max_range_mm")
        return self


class ConeFacts(Config):
    """A cone about the optical axis from ``position_mm``, with a linear roll-off between two half
    angles."""

    position_mm: Fact[tuple[float, float, float]]
    full_half_angle_deg: HalfAngle
    cutoff_half_angle_deg: HalfAngle

    @model_validator(mode="after")
    def _rolls_off_outwards(self) -> Self:
        if self.cutoff_half_angle_deg.value <= self.full_half_angle_deg.value:
            raise ValueError("cutoff_half_angle_deg must be above full_half_angle_deg")
        return self

    def optics(self) -> dict[str, Any]:
        """Return the arguments that a camera's optics take from this cone."""
        angles = {
            key: getattr(self, key).value
            for key in ("full_half_angle_deg", "cutoff_half_angle_deg")
        }
        return {"emitter_m": np.array(self.position_mm.value) * MM, **angles}


class CameraFacts(Config):
    """Contents of every camera's file, whatever its kind."""

    name: str
    title: str
    wavelength_nm: Wavelength
    lens: LensFacts
    unit: UnitFacts
    engine: OutputFacts
    modes: Annotated[tuple[str, ...], BeforeValidator(tuple)] = Field((), exclude=True)
    """Cameras that are other modes of this one, or a mapping of them by name; no simulation uses
    them."""

    @cached_property
    def nominal_lens(self) -> Lens:
        """The lens in the file, without distortion; a scanner's is the raster of its beam's
        directions."""
        return self.lens.lens()

    @property
    def z_step_m(self) -> float:
        """The rounding step of the output's z."""
        return self.engine.output_step_mm.value * MM

    def optics_with(self, **own: Any) -> Optics:
        """Return the camera's optics for the render. ``own``: arguments that only its kind knows."""
        facts = {
            "title": self.title,
            "lens": self.nominal_lens,
            "wavelength_nm": self.wavelength_nm.value,
        }
        return Optics(**facts, nearest_m=self.engine.min_range_mm.value * MM, **own)  # type: ignore[arg-type]

    def images(self, points_camera_m: np.ndarray) -> np.ndarray:
        """Return (...) bool: whether points (..., 3) have an image on the sensor and within the
        lens's field."""
        half_angle = self.lens.field_half_angle_deg
        aside = np.linalg.norm(points_camera_m[..., :2], axis=-1)
        widest = np.deg2rad(half_angle.value) if half_angle else np.pi / 2
        return self.nominal_lens.images(points_camera_m) & (
            np.arctan2(aside, points_camera_m[..., 2]) <= widest
        )


def distorted_slope(slope: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Return the slopes (n,) that radial distortion alone (k1 k2 p1 p2 k3 k4 k5 k6) makes of true
    slopes (n,)."""
    k1, k2, _, _, k3, k4, k5, k6 = distortion
    s = slope**2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(
            slope * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        )


def unfolded_slope(distortion: tuple[float, ...]) -> float:
    """Return the largest distorted slope up to which radial distortion grows with the true one, or
    infinity."""
    distorted = distorted_slope(np.linspace(0.0, STEEPEST, 6001), distortion)
    with np.errstate(invalid="ignore"):
        back = np.flatnonzero(~(np.diff(distorted) > 0))
    return float(distorted[back[0]]) if back.size else float("inf")
