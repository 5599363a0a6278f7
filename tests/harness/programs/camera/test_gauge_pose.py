"""The pose of a printed gauge by its coded marks in an infrared picture, and by its spheres where
marks are hidden or wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.averages.average import RECORDED, average
from harness.inspection.arguments import opened_as, reading_of
from harness.programs.camera import characterise
from harness.programs.camera.gauge_pose import located
from harness.programs.camera.spheres import image_of
from harness.stills.spheres import RangeImage
from harness.vocabulary.geometry import MM, Cloud, invert, transform_points
from tests.support.gauge_scene import exact_gauge, pose, recorded


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> tuple[Cloud, RangeImage]:
    """An averaged capture of the gauge with infrared."""
    arguments = recorded(tmp_path_factory.mktemp("gauge"), frames=2, infrared=True)
    options = characterise.main.parser().parse_args(arguments)
    recording = opened_as(None, options.paths, options.intrinsics, **reading_of(options))
    cloud = average(recording, RECORDED)
    return cloud, image_of(recording, cloud)


def assert_is_the_pose(T_camera_gauge: np.ndarray):
    """The corners of the plate are where they are, within 2 mm."""
    corners_m = np.array([(x, y, 0.0) for x in (-90, 90) for y in (-90, 90)]) * MM
    off_m = transform_points(T_camera_gauge, corners_m) - transform_points(pose(), corners_m)
    assert np.linalg.norm(off_m, axis=1).max() < 2 * MM


def covered(cloud: Cloud, codes: tuple[int, ...], share: float) -> Cloud:
    """A share of these marks, from their left, under something white."""
    on_gauge_mm = transform_points(invert(pose()), cloud.points_m) / MM
    assert cloud.amplitude is not None
    amplitude = cloud.amplitude.copy()
    for mark in exact_gauge().marks:
        from_left_mm = on_gauge_mm[..., 0] - mark.x_mm + mark.side_mm / 2
        beside_mm = np.abs(on_gauge_mm[..., 1] - mark.y_mm)
        within = (np.abs(from_left_mm - mark.side_mm * share / 2) < mark.side_mm * share / 2) & (
            beside_mm < mark.side_mm / 2
        )
        if mark.code in codes:
            amplitude[within] = np.nanquantile(amplitude, 0.9)
    return replace(cloud, amplitude=amplitude)


def test_marks_in_infrared_place_the_gauge(capture):
    T_camera_gauge, how = located(*capture, exact_gauge())
    assert how == "the gauge is placed by 4 of its marks"
    assert_is_the_pose(T_camera_gauge)


@pytest.mark.parametrize(
    ("codes", "how"),
    [((1,), "by 3 of its marks"), ((1, 3), "by 6 of its spheres")],
)
def test_partly_hidden_marks_do_not_count(capture, codes, how):
    cloud, image = capture
    T_camera_gauge, placed = located(covered(cloud, codes, share=0.4), image, exact_gauge())
    assert placed.endswith(how)
    assert_is_the_pose(T_camera_gauge)


def test_marks_that_do_not_fit_one_another_do_not_count(capture):
    """As codes of the gauge on something else: one 20 mm from its place; and two exchanged, of
    which no three fit."""
    moved = {3: {"x_mm": -60.0, "y_mm": -60.0}}
    exchanged = {0: {"code": 1}, 1: {"code": 0}}
    for changes, expected in ((moved, "by 3 of its marks"), (exchanged, "by 6 of its spheres")):
        marks = tuple(
            mark.model_copy(update=changes.get(mark.code, {})) for mark in exact_gauge().marks
        )
        gauge = exact_gauge().model_copy(update={"marks": marks})
        T_camera_gauge, how = located(*capture, gauge)
        assert how.endswith(expected)
        assert_is_the_pose(T_camera_gauge)
