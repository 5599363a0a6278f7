"""Averages of simulated frames."""

from __future__ import annotations

import numpy as np

from detectors.averages.average import AverageConfig, prefix_averages
from detectors.averages.flat_field import FlatFieldConfig, corrected
from harness.trials.averages import Averaging, averages_of, flat_field_of
from harness.vocabulary.geometry import Region
from scenes.closed_form import plane_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedCapture, SimulatedUnit


def capture_before_a_plane() -> SimulatedCapture:
    config = CameraConfig(name="kinect_v2")
    camera = camera_of(config)
    view = plane_view(camera, Region(200, 230, 240, 280), 0.7, 0.6)
    return SimulatedUnit(camera, config, view).capture(6, 1)


def test_averages_are_those_of_the_frames_and_state_how_far_edges_reach() -> None:
    capture = capture_before_a_plane()
    clouds = averages_of(capture, [1, 6], Averaging(AverageConfig()))
    expected = prefix_averages(capture, [1, 6], AverageConfig())
    assert list(clouds) == [1, 6]
    for n, cloud in clouds.items():
        assert np.array_equal(cloud.points_m, expected[n].points_m, equal_nan=True)
        assert cloud.edge_reach_px == capture.unit.camera.optics.margin_px


def test_a_flat_field_is_subtracted() -> None:
    capture = capture_before_a_plane()
    flat_field = FlatFieldConfig(frames=4, distance_m=0.8)
    plain = averages_of(capture, [6], Averaging(AverageConfig()))[6]
    cloud = averages_of(capture, [6], Averaging(AverageConfig(), flat_field))[6]
    field = flat_field_of(capture.unit.config, flat_field, capture.seed)
    expected = corrected(plain, field)
    assert np.array_equal(cloud.points_m, expected.points_m, equal_nan=True)
    assert not np.array_equal(cloud.points_m, plain.points_m, equal_nan=True)
