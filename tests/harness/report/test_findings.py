"""Findings as rows: which measure counts, and along which direction depth is stated."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from detectors.interface import Detection, Evidence, Measurement
from harness.report.findings import finding_of, parts_of, probability
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


@pytest.mark.parametrize(
    ("along_deg", "stated_deg"), [(30.0, 30.0), (100.0, -80.0), (-100.0, 80.0)]
)
def test_a_slot_has_sides_in_millimetres_and_an_angle_in_degrees(
    along_deg: float, stated_deg: float
) -> None:
    along = np.array([math.cos(math.radians(along_deg)), math.sin(math.radians(along_deg)), 0.0])
    slot = replace(
        measured(0.01),
        length_m=0.03,
        width_m=0.004,
        along=along,
        length_se_m=5e-4,
        width_se_m=2e-4,
        along_se_rad=0.1,
        shape="slot",
    )
    finding = finding_of(1, EVIDENCE, DETECTION, slot)
    assert (finding.length_mm, finding.width_mm) == pytest.approx((30.0, 4.0))
    assert finding.angle_deg == pytest.approx(stated_deg)
    assert (finding.length_se_mm, finding.width_se_mm) == pytest.approx((0.5, 0.2))
    assert finding.angle_se_deg == pytest.approx(5.73, abs=0.005)
    assert finding.long_text == f"30.0 x 4.0, {stated_deg:.0f}"


@pytest.mark.parametrize(
    ("shape", "length_m", "width_m", "is_long"),
    [
        ("slot", 0.0081, 0.004, True),
        ("slot", 0.0079, 0.004, False),
        # a width of less than 1 mm is noise
        ("", 0.0021, 0.0003, True),
        ("", 0.0019, 0.0003, False),
        # a round shape that fits decides against length and width
        ("disc", 0.0081, 0.004, False),
    ],
)
def test_a_finding_is_long_from_twice_its_width(
    shape: str, length_m: float, width_m: float, is_long: bool
) -> None:
    sides = replace(measured(0.01), shape=shape, length_m=length_m, width_m=width_m)
    assert finding_of(1, EVIDENCE, DETECTION, sides).is_long == is_long


def test_volumes_are_in_cubic_millimetres() -> None:
    """A cube of 2 cm."""
    cube = replace(measured(0.01), volume_m3=8e-6)
    assert finding_of(1, EVIDENCE, DETECTION, cube).volume_mm3 == pytest.approx(8000.0)


def test_what_lies_before_the_surface_is_a_bump_of_negative_depth() -> None:
    bump = finding_of(1, EVIDENCE, DETECTION, measured(-0.01))
    assert (bump.kind, bump.depth_mm) == ("bump", pytest.approx(-8.0))


def test_the_measure_of_the_diameter_is_stated() -> None:
    by_contour = replace(measured(0.01), model_note="no shape fits")
    assert finding_of(1, EVIDENCE, DETECTION, by_contour).size_from == "contour"
    by_points = replace(measured(0.01), model_diameter_m=float("nan"))
    extent = finding_of(1, EVIDENCE, DETECTION, by_points)
    assert (extent.size_from, extent.diameter_mm) == ("extent", pytest.approx(30.0))
    blind = replace(DETECTION, kind="no return")
    assert finding_of(1, EVIDENCE, blind, measured(float("nan"))).size_from == "area"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.23, "0.2"),
        (0.00042, "0.0004"),
        (0.0001, "0.0001"),
        (0.00009, "< 0.0001"),
        (math.nan, "unknown"),
    ],
)
def test_a_probability_of_noise_has_one_digit(value: float, text: str) -> None:
    assert probability(value) == text


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
