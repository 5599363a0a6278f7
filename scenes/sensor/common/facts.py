"""The parts of every camera file, whatever the kind: numbers with sources, the lens, the
properties of a unit."""

from __future__ import annotations

from abc import abstractmethod
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
    """One number of a camera with its origin."""

    value: T
    """The number, in the unit that the key's name ends with."""
    tag: Literal["R", "D", "S", "W", "O", "C", "M", "G", "U"]
    """R: read in the named public source; D: derived from such; S: a single secondary source; W:
    measured on public captures; O: measured on the owner's by `tofpod characterise`; C:
    calibrated; M: a guess; G: a guess of the precision; U: set by the user of an experiment."""
    source: str
    """The document or measurement that says so."""
    range: tuple[float, float] | None = None
    """Least and greatest value that the evidence allows, of each of the values if there are
    several; None: not stated, which the tag G does not permit."""

    @model_validator(mode="after")
    def _lies_in_its_range(self) -> Fact[T]:
        if self.range is None:
            if self.tag == "G":
                raise ValueError("a number with the tag G states the `range` that it may lie in")
            return self
        least, greatest = self.range
        for value in values_of(self):
            if not least <= value <= greatest:
                raise ValueError(f"the value is {value}; its `range` is {least} to {greatest}")
        return self


def values_of(fact: Fact[Any]) -> tuple[Any, ...]:
    """Return the values of a fact that has one or several."""
    return fact.value if isinstance(fact.value, tuple) else (fact.value,)


def checked(legal: str, holds: Callable[[Any], bool]) -> AfterValidator:
    """Return a validator of a fact whose value, or each of its values, must satisfy what ``legal``
    states."""

    def check(fact: Fact[Any]) -> Fact[Any]:
        for value in values_of(fact):
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
    """The nominal lens."""

    width_px: PositiveInt
    """Columns of the sensor."""
    height_px: PositiveInt
    """Rows of the sensor."""
    fx_px: Positive
    """Focal length across."""
    fy_px: Positive
    """Focal length down."""
    cx_px: Fact[float]
    """Column of the optical axis."""
    cy_px: Fact[float]
    """Row of the optical axis."""
    distortion: Fact[tuple[float, ...]]
    """k1 k2 p1 p2 [k3 [k4 k5 k6]] of OpenCV's model, or empty."""
    field_half_angle_deg: HalfAngle | None = None
    """Pixels beyond it see nothing, and distortion may fold there; None: the image covers the
    sensor."""

    @model_validator(mode="after")
    def _sees_each_direction_once(self) -> LensFacts:
        count = len(self.distortion.value)
        if count not in TERMS:
            raise ValueError(
                f"distortion has {count} terms; OpenCV's models have {', '.join(map(str, TERMS))}"
            )
        lens = self.lens()
        across = max(lens.cx, lens.width - 1 - lens.cx)
        down = max(lens.cy, lens.height - 1 - lens.cy)
        corner = float(np.hypot(across / lens.fx, down / lens.fy))
        image_ends = min(corner, self.image_radius)
        limit = unfolded_slope(lens.distortion)
        if image_ends > limit:
            end = "corner of the sensor lies" if corner < self.image_radius else "field ends"
            raise ValueError(
                f"distortion folds the image: it turns back at {limit:.3g} focal lengths from the "
                f"axis, and the {end} at {image_ends:.3g}"
            )
        if not self._pixels_come_back(lens):
            raise ValueError(
                "distortion folds the image: somewhere on the sensor no direction leads to a pixel"
            )
        return self

    def _pixels_come_back(self, lens: Lens) -> bool:
        """Return whether pixels all over the image are met again by the rays that they see."""
        columns = np.linspace(0, lens.width - 1, 9)
        rows = np.linspace(0, lens.height - 1, 9)
        u, v = np.meshgrid(columns, rows)
        radius = np.hypot((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
        in_image = radius < self.image_radius
        pixels = np.stack([u[in_image], v[in_image]], axis=-1)
        slopes = lens.slopes(pixels[:, 0], pixels[:, 1])
        rays = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=-1)
        return bool((np.abs(lens.project(rays) - pixels) < WORST_PX).all())

    @cached_property
    def image_radius(self) -> float:
        """Radius of the lens's image in focal lengths; infinite if it covers the sensor."""
        if self.field_half_angle_deg is None:
            return float("inf")
        slope = np.tan(np.deg2rad([self.field_half_angle_deg.value]))
        return float(distorted_slope(slope, self.lens().distortion)[0])

    def outside_field(self, region: Region) -> np.ndarray:
        """Return (h, w) bool: pixels beyond the lens's image."""
        if np.isinf(self.image_radius):
            return np.zeros(region.shape, bool)
        lens = self.lens()
        v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
        return np.asarray(
            np.hypot((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy) > self.image_radius
        )

    def lens(self) -> Lens:
        """The lens as a `Lens` of the program."""
        terms = self.distortion.value
        missing = 8 - len(terms)
        return Lens(
            width=self.width_px.value,
            height=self.height_px.value,
            fx=self.fx_px.value,
            fy=self.fy_px.value,
            cx=self.cx_px.value,
            cy=self.cy_px.value,
            distortion=terms + (0.0,) * missing,
        )


class UnitFacts(Config):
    """Differences of a unit from the nominal camera, and of its frames from each other."""

    frames_per_second: Positive
    """Rate of frames."""
    offset_mm: NonNegative
    """Deviation between units of a constant range error."""
    drift_mm: Fact[float]
    """Range error at power-on on the axis."""
    drift_min: Positive
    """Minutes after which it has decayed to 1/e."""
    drift_ramp: Fact[float]
    """Share of itself by which it is greater per unit of x/z."""
    jump_rate: Share
    """Share of frames that jump."""
    jump_mm: NonNegative
    """Displacement of a frame that jumps, either way."""
    jitter_mm: NonNegative
    """Deviation of a small displacement of every frame."""


class SmoothPatternFacts(Config):
    """A fixed pattern, which is the same in every frame of a unit: a smooth range error."""

    smooth_mm: NonNegative
    """Its deviation."""
    smooth_length_px: LengthPx
    """l of its correlation exp(-k^2 / 2 l^2) at a distance of k pixels."""


class OutputFacts(Config):
    """The smallest range that a camera gives, and the step of the stored z."""

    min_range_mm: NonNegative
    """Smallest range."""
    output_step_mm: Positive
    """Step of the stored z."""


class LimitFacts(OutputFacts):
    """Limits of range."""

    max_range_mm: Positive
    """Greatest range."""

    @model_validator(mode="after")
    def _range_is_left(self) -> Self:
        if self.min_range_mm.value >= self.max_range_mm.value:
            raise ValueError("min_range_mm must be less than max_range_mm")
        return self


class ConeFacts(Config):
    """A cone about the optical axis from ``position_mm``, with a linear roll-off between two half
    angles."""

    position_mm: Fact[tuple[float, float, float]]
    """x, y, z in the camera's frame."""
    full_half_angle_deg: HalfAngle
    """Angle up to which it is whole."""
    cutoff_half_angle_deg: HalfAngle
    """Angle from which it is 0."""

    @model_validator(mode="after")
    def _rolls_off_outwards(self) -> Self:
        if self.cutoff_half_angle_deg.value <= self.full_half_angle_deg.value:
            raise ValueError("cutoff_half_angle_deg must be above full_half_angle_deg")
        return self

    def optics(self) -> dict[str, Any]:
        """Return the arguments that a camera's optics take from this cone."""
        return {
            "emitter_m": np.array(self.position_mm.value) * MM,
            "full_half_angle_deg": self.full_half_angle_deg.value,
            "cutoff_half_angle_deg": self.cutoff_half_angle_deg.value,
        }


class CameraFacts(Config):
    """Contents of every camera's file, whatever its kind."""

    name: str
    """Name of the file."""
    title: str
    """Name for readers."""
    wavelength_nm: Wavelength
    """Wavelength of the emitter."""
    lens: LensFacts
    """The nominal lens."""
    unit: UnitFacts
    """Differences between units, and between frames."""
    engine: OutputFacts
    """Processing of the measurements."""
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

    @property
    @abstractmethod
    def optics(self) -> Optics:
        """The facts that the render needs."""

    def optics_with(self, **of_kind: Any) -> Optics:
        """Return the camera's optics for the render. ``of_kind``: arguments that only its kind
        knows."""
        return Optics(
            title=self.title,
            lens=self.nominal_lens,
            wavelength_nm=self.wavelength_nm.value,
            nearest_m=self.engine.min_range_mm.value * MM,
            **of_kind,
        )

    def images(self, points_camera_m: np.ndarray) -> np.ndarray:
        """Return (...) bool: whether points (..., 3) have an image on the sensor and within the
        lens's field."""
        half_angle = self.lens.field_half_angle_deg
        widest = np.deg2rad(half_angle.value) if half_angle else np.pi / 2
        aside_m = np.linalg.norm(points_camera_m[..., :2], axis=-1)
        in_field = np.arctan2(aside_m, points_camera_m[..., 2]) <= widest
        return self.nominal_lens.images(points_camera_m) & in_field


def distorted_slope(slope: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """Return the slopes (n,) that radial distortion alone (k1 k2 p1 p2 k3 k4 k5 k6) makes of true
    slopes (n,)."""
    k1, k2, _, _, k3, k4, k5, k6 = distortion
    s = slope**2
    numerator = 1 + s * (k1 + s * (k2 + s * k3))
    denominator = 1 + s * (k4 + s * (k5 + s * k6))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(slope * numerator / denominator)


def unfolded_slope(distortion: tuple[float, ...]) -> float:
    """Return the largest distorted slope up to which radial distortion grows with the true one, or
    infinity."""
    distorted = distorted_slope(np.linspace(0.0, STEEPEST, 6001), distortion)
    with np.errstate(invalid="ignore"):
        back = np.flatnonzero(~(np.diff(distorted) > 0))
    return float(distorted[back[0]]) if back.size else float("inf")
