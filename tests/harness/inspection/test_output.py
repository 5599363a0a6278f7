"""Numbers of an inspection as the terminal prints them, and as its JSON holds them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from detectors.crop import Choice
from detectors.recordings import open_capture
from harness.inspection.output import (
    _rings,
    capture_facts,
    choice_facts,
    mm,
    number,
    scene_of,
    threshold_text,
)
from harness.vocabulary.geometry import LeftOut
from tests.harness.inspection.test_verdict import finding, judged_of
from tests.support import recorded_plane as plane
from tests.support.plain_clouds import cloud_of_points


def test_lengths_have_three_digits_and_unknown_numbers_a_dash() -> None:
    assert mm(0.0123456) == "12.3 mm"
    assert number(1.25, 1) == "1.2"
    assert number(None, 1) == "-"
    assert number(math.nan, 1) == "-"


def test_a_threshold_is_stated_in_millimetres_if_a_unit_of_score_has_a_length() -> None:
    evidence = judged_of(9.0).evidence
    in_lengths = replace(evidence, unit="", scale_m=0.4e-3)
    assert threshold_text(5.0, in_lengths) == "5 x 0.4 mm = 2 mm at the median point"
    assert threshold_text(5.0, replace(evidence, unit="deviations")) == "5 units of score"


def test_the_facts_of_a_capture_are_in_millimetres(tmp_path: Path) -> None:
    recording = open_capture(
        [plane.write_pcd(tmp_path / "c.pcd", plane.points_m(plane.depth_mm()))]
    )
    points = np.ones((4, 5, 3))
    left_out = LeftOut("frame 3", "it is blurred")
    cloud = cloud_of_points(
        points, z_step_m=0.25e-3, n_frames=7, noise_reach_px=3.0, left_out=(left_out,)
    )
    facts = capture_facts(recording, cloud)
    assert facts["rounding_step_mm"] == pytest.approx(0.25)
    assert facts["noise_reach_px"] == 3.0
    assert facts["frames_used"] == 7
    assert facts["frames_left_out"] == [{"name": "frame 3", "why": "it is blurred"}]
    assert facts["depth_unit"]["mm"] == pytest.approx(1000.0)
    unknown = replace(cloud, noise_reach_px=0.0)
    assert capture_facts(recording, unknown)["noise_reach_px"] is None


def test_the_facts_of_a_choice_are_in_millimetres_and_shares() -> None:
    mask = np.zeros((4, 5), bool)
    mask[1:3, 1:4] = True
    candidate = SimpleNamespace(
        depths_m=(0.39, 0.4, 0.45), extent_m=(0.15, 0.11), share=0.3, tilt_deg=4.0, mask=mask
    )
    choice = cast(Choice, SimpleNamespace(taken=1, warnings=(), candidates=(candidate,)))
    facts = choice_facts(choice)
    assert facts is not None
    (stated,) = facts["candidates"]
    depths_mm = (stated["nearest_mm"], stated["distance_mm"], stated["farthest_mm"])
    assert depths_mm == pytest.approx((390.0, 400.0, 450.0))
    assert stated["extent_mm"] == pytest.approx([150.0, 110.0])
    assert stated["share_of_view"] == 0.3
    assert stated["tilt_deg"] == 4.0
    assert stated["pixels"] == 6
    assert choice_facts(None) is None


def test_a_scene_is_in_millimetres_with_a_ring_around_each_finding() -> None:
    result = judged_of(20.0)
    scene = scene_of(result, [], None)
    assert scene.points_mm == pytest.approx(1e3 * result.cloud.points_m.reshape(-1, 3))
    assert np.flatnonzero(scene.detected).tolist() == sorted(result.detections[0].pixels.tolist())
    (ring,) = scene.circles
    assert ring.diameter_mm == pytest.approx(20.0)
    assert ring.label == "1: 20.0"


def test_a_finding_without_a_place_or_a_size_has_no_ring() -> None:
    unknown = (finding(z_mm=math.nan), finding(diameter_mm=math.nan))
    assert _rings(unknown) == ()
    (ring,) = _rings((finding(x_mm=1.0, y_mm=2.0),))
    assert ring.centre_mm.tolist() == [1.0, 2.0, 1000.0]
