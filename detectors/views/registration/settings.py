"""Settings of the registration methods."""

from typing import Annotated, Literal

from pydantic import Field

from harness.vocabulary.config import Config


class IcpRegistration(Config):
    """Iterative closest point, point to point, which starts from the nominal pose."""

    method: Literal["icp"] = "icp"
    points: Literal["marks", "target"] = "marks"


class CpdRegistration(Config):
    """Coherent point drift, rigid and without scale. The defaults are MATLAB's."""

    method: Literal["cpd"] = "cpd"
    points: Literal["marks", "target"] = "marks"
    outlier_ratio: float = Field(default=0.1, ge=0, lt=1)
    max_iterations: int = Field(default=20, ge=1, le=1000)
    tolerance: float = Field(default=1e-5, gt=0)


class PlainRegistration(Config):
    """Methods without settings. ``nominal`` uses the nominal poses unchanged. ``marks`` matches
    centroids of marks by their mutual distances. ``joint`` fits marks and the common surface of
    all views together. ``odometry`` is RGB-D odometry from view to view (Open3D) without marks: a
    SLAM system without loop closure."""

    method: Literal["nominal", "marks", "joint", "odometry"]


AnyRegistration = IcpRegistration | CpdRegistration | PlainRegistration
RegistrationConfig = Annotated[AnyRegistration, Field(discriminator="method")]
PAIRWISE = ("nominal", "icp", "cpd", "marks")
"""Methods that register each view to the first by itself, so that other views cannot change it."""
