"""The interface of a detector: it turns a cloud into scored evidence; the caller sets the
threshold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from harness.vocabulary.geometry import Cloud


@dataclass(frozen=True, eq=False)
class Evidence:
    """A detector's result for each pixel of a cloud, before any threshold is applied."""

    score: np.ndarray
    """(h, w): the threshold below which the pixel counts as damage; NaN where the detector does
    not judge."""
    residual_m: np.ndarray
    """(h, w): z of the point less that of the fitted surface: + behind it, - before it."""
    surface_z_m: np.ndarray
    """(h, w): z of the fitted surface, where ``residual_along`` says."""
    scale_m: float
    """Standard deviation that corresponds to one unit of score."""
    notes: dict[str, Any] = field(default_factory=dict)
    """Plain data on how the cloud was judged."""
    warnings: tuple[str, ...] = ()
    """Full sentences on reasons why these numbers are unreliable; every program shows them
    first."""
    behind: np.ndarray | None = None
    """(h, w) bool: whether the score indicates something behind the surface; None: the residual's
    sign does."""
    unit: str = ""
    """The unit of score in words, if scores are not residuals over a deviation; ``scale_m`` is
    then its least value at a typical point."""
    residual_along: Literal["ray", "axis"] = "ray"
    """Where the surface's z is taken: "ray" where the pixel's line of sight meets the surface,
    "axis" at the point's own x and y. On a tilted surface they differ off the optical axis."""


@dataclass(frozen=True)
class Detection:
    """A finding."""

    score: float
    """The lowest threshold at which it is no longer found."""
    pixels: np.ndarray
    """(n,): flat indices into the cloud's (h, w) grid, ascending."""
    centre_m: np.ndarray
    """(3,): its position in the cloud's frame, by which it is matched with damage."""
    kind: Literal["depth", "no return", "object"] = "depth"
    """Kinds: "depth" for points that depart from the surface; "no return" for connected pixels
    without return (then invalid) inside the target's outline; "object" for an object on the
    target."""
    count: int = 1
    """Number of places: more than 1 for slots that repeat (`detectors.findings.joints`), which are
    one finding."""


@dataclass(frozen=True)
class MissingReturns:
    """Pixels without a return inside the target's outline."""

    outline: np.ndarray
    """(h, w) bool."""
    unseen: np.ndarray
    """(h, w): share of the frames (of a map: 0 or 1) in which a pixel returned nothing."""
    blind: float
    """Share of the outline's pixels without any return."""
    dropouts: float
    """Rate of scattered missing pixels."""
    least_points: int
    """Smallest cluster that is a finding."""
    expected: float
    """Number of such clusters by chance."""
    detections: tuple[Detection, ...]
    """Kind "no return", largest first. Their score is the Gaussian deviation with the same
    probability as the expected number of chance clusters of that size, at most 37."""

    @property
    def blind_text(self) -> str:
        """Return a sentence on the blind share of the target, and the part of it that chance
        explains."""
        plural = "" if len(self.detections) == 1 else "s"
        return (
            f"blind: {100 * self.blind:.2g} % of the target's pixels returned nothing;"
            f" {len(self.detections)} place{plural} of {self.least_points} connected pixels and"
            f" more ({self.expected:.1g} expected by chance; scattered dropouts"
            f" {100 * self.dropouts:.2g} %)"
        )

    @property
    def facts(self) -> dict[str, float]:
        """Return these figures as plain data."""
        return {
            "blind_share": self.blind,
            "scattered_dropouts": self.dropouts,
            "least_points": self.least_points,
            "expected_by_chance": self.expected,
        }


@dataclass(frozen=True)
class Measurement:
    """Size and position of one detection, camera frame, metres; NaN where an estimate is
    impossible. ``extent_*`` is the thesis' measure, from the extreme points; ``model_*`` comes
    from the model of a blurred hole, with standard errors."""

    u_px: float
    """Column of its centre on the sensor."""
    v_px: float
    """Row of its centre on the sensor."""
    points: int
    """Number of its points."""
    score: float
    """The detection's."""
    extent_diameter_m: float
    """Mean of the distances between the extreme points in x and in y."""
    extent_centre_m: np.ndarray
    """(3,): mean of these points."""
    model_diameter_m: float = np.nan
    model_diameter_se_m: float = np.nan
    model_depth_m: float = np.nan
    """Along the viewing axis from the fitted surface, positive behind it."""
    model_depth_se_m: float = np.nan
    depth_is_least: bool = False
    """True if the blur hides the floor, so that the damage may be deeper than the depth."""
    model_centre_m: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    """(3,): centre of the mouth, on the surface."""
    model_centre_se_m: float = np.nan
    """Along one axis of the surface."""
    volume_m3: float = np.nan
    """Volume between the surface and the points, positive behind it."""
    length_m: float = np.nan
    """Longer side of the rectangle with the second moments of the residual, less the camera's
    blur: a slot's length; for a round hole of diameter d, 0.87 d."""
    width_m: float = np.nan
    """Shorter side of that rectangle."""
    along: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))
    """(3,): direction of the longer side."""
    length_se_m: float = np.nan
    """Standard error of the length of a fitted slot."""
    width_se_m: float = np.nan
    """Standard error of its width."""
    along_se_rad: float = np.nan
    """Standard error of its direction on the surface."""
    normal_share: float = np.nan
    """Depth normal to the surface over the residual."""
    sight_share: float = np.nan
    """Depth along the line of sight over the residual."""
    shape: str = ""
    """The shape that fits (`detectors.findings.shapes`), "ragged" if none does, or empty if the
    blur hides it."""
    model_note: str = ""
    """Reason why an estimate is missing."""

    @property
    def normal_depth_m(self) -> float:
        """Depth normal to the surface."""
        return self.model_depth_m * self.normal_share

    @property
    def normal_depth_se_m(self) -> float:
        """Standard error of the depth normal to the surface."""
        return self.model_depth_se_m * self.normal_share


@dataclass(frozen=True)
class TrueDamage:
    """A true damage, given to detectors that test the harness."""

    centre_m: np.ndarray
    """(3,): centre on the face in the cloud's frame."""
    diameter_m: float
    pixels: np.ndarray
    """(n,): flat indices of the pixels that see into it."""


@runtime_checkable
class NeedsTruth(Protocol):
    """A detector that receives the truth in order to test the harness; no real detector implements
    this."""

    def with_truth(self, truth: tuple[TrueDamage, ...]) -> Detector:
        """Return the detector for one cloud with this truth; empty on a hole-free board."""
        ...


@runtime_checkable
class Calibratable(Protocol):
    """A detector that learns from hole-free clouds before it judges, such as the noise's spectrum,
    its tails, or a memory of the undamaged face. The result is plain arrays named by identifiers,
    so that it can be stored and sent."""

    def calibrate(self, hole_free: Sequence[Cloud]) -> Mapping[str, np.ndarray]:
        """Return what was learned from the clouds, as arrays without objects; empty if there is
        nothing to learn. The clouds show targets without damage and were taken like those to be
        judged (camera, frames, average). Neither the detector nor the clouds change. Raises
        UserError if clouds cannot be judged or are too few."""
        ...

    def calibrated(self, learned: Mapping[str, np.ndarray]) -> Detector:
        """Return the detector, with the same name and version, that uses the result of
        `calibrate`."""
        ...


class Detector(Protocol):
    """A detector receives a cloud and never the truth. Its settings are a
    `harness.vocabulary.config.Config`."""

    @property
    def name(self) -> str: ...
    @property
    def version(self) -> int:
        """Version number; increased with every change that can change a result."""
        ...

    def analyse(self, cloud: Cloud) -> Evidence:
        """Score every pixel. Raises UserError if the cloud cannot be judged (empty crop, too few
        points)."""
        ...

    def find(
        self,
        cloud: Cloud,
        evidence: Evidence,
        threshold: float,
    ) -> tuple[Detection, ...]:
        """Return the findings at a threshold, strongest first."""
        ...

    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        """Return the lowest threshold at which `find` returns nothing."""
        ...

    def measure(
        self,
        cloud: Cloud,
        evidence: Evidence,
        detection: Detection,
    ) -> Measurement:
        """Measure size and place of one detection."""
        ...
