"""Findings as rows: which measure counts, and along which direction depth is stated."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.interface import Detection, Evidence, Measurement
from harness.report.findings import finding_of, parts_of
from harness.testing.synthetic_clouds import plane

EVIDENCE = Evidence(
    score=np.full((2, 2), 9.0),
    residual_m=np.array([[0.004, -0.001], [0.0, 0.0]]),
    surface_z_m=np.ones((2, 2)),
    scale_m=1e-3,
)
DETECTION = Detection(9.0, np.array([0, 1]), np.zeros(3))


def measured(model_depth_m: float) -> Measurement:
    """A measurement on a surface whose normal leans, seen off the axis."""
    return Measurement(
        u_px=0.0,
        v_px=0.0,
        points=2,
        score=9.0,
        extent_diameter_m=0.03,
        extent_centre_m=np.zeros(3),
        model_diameter_m=0.02,
        model_diameter_se_m=0.001,
        model_depth_m=model_depth_m,
        model_depth_se_m=0.002,
        normal_share=0.8,
        sight_share=1.25,
    )


def test_depth_is_normal_to_the_surface_and_beside_it_along_the_line_of_sight() -> None:
    finding = finding_of(1, EVIDENCE, DETECTION, measured(0.01))
    assert finding.depth_mm == pytest.approx(8.0)
    assert finding.depth_se_mm == pytest.approx(1.6)
    assert finding.sight_depth_mm == pytest.approx(12.5)
    assert finding.diameter_mm == pytest.approx(20.0)
    assert finding.diameter_se_mm == pytest.approx(1.0)
    assert (finding.kind, finding.depth_from) == ("hole", "model")


def test_without_a_model_the_extreme_residual_is_turned_alike() -> None:
    finding = finding_of(1, EVIDENCE, DETECTION, measured(float("nan")))
    assert finding.depth_mm == pytest.approx(0.8 * 4.0)
    assert finding.sight_depth_mm == pytest.approx(1.25 * 4.0)
    assert finding.depth_from == "extreme residual"


def test_joints_have_a_mark_at_each_place_and_other_findings_one() -> None:
    cloud = plane(seed=1)
    width = cloud.valid.shape[1]
    pixels = np.array([2 * width + 3, 2 * width + 4, 3 * width + 5, 20 * width + 30])
    joints = Detection(9.0, pixels, np.zeros(3), count=2)
    large, small = parts_of(cloud, joints)
    assert large.pixels.tolist() == pixels[:3].tolist()
    assert small.pixels.tolist() == pixels[3:].tolist()
    (part,) = parts_of(cloud, Detection(9.0, pixels, np.zeros(3)))
    assert part.pixels.tolist() == pixels.tolist()
