"""Streams of frames through filters, and filters of other packages."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from detectors.averages.average import AverageConfig, prefix_averages
from detectors.filters import DepthFilterConfig, filter_names, functions_named, load_filter
from detectors.filters.stream import FilteredFrames, averages_through
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Reason, Region
from scenes.closed_form import plane_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedCapture, SimulatedUnit
from tests.support.plug_in_packages import offer

COUNTS = [1, 6]
MEAN = AverageConfig(judge_frames=False)


@pytest.fixture(scope="module")
def capture() -> SimulatedCapture:
    config = CameraConfig(name="kinect_v2")
    camera = camera_of(config)
    view = plane_view(camera, Region(200, 230, 240, 280), 0.7, 0.6)
    return SimulatedUnit(camera, config, view).capture(6, 1)


def test_frames_pass_the_filter_in_order_before_the_average(capture: SimulatedCapture):
    through = averages_through(capture, COUNTS, MEAN, DepthFilterConfig(name="temporal"))
    plain = prefix_averages(capture, COUNTS, MEAN)
    function = load_filter("temporal", {}).started(
        capture.z_step_m or 0.001, whole=capture.z_step_m > 0
    )
    expected = [function(frame.z_m.copy()) for frame in capture.frames()]
    assert np.allclose(through[6].points_m[..., 2], np.mean(expected, axis=0), atol=1e-7)
    assert np.allclose(through[1].points_m, plain[1].points_m, atol=1e-6)
    assert not np.allclose(through[6].points_m, plain[6].points_m, atol=1e-6)


def test_an_average_passes_the_filter_without_rounding(capture: SimulatedCapture):
    config = DepthFilterConfig(name="spatial", acts_on="average")
    through = averages_through(capture, [6], MEAN, config)[6]
    plain = prefix_averages(capture, [6], MEAN)[6]
    z_m = through.points_m[..., 2]
    assert np.diff(z_m).std() < 0.5 * np.diff(plain.points_m[..., 2]).std()
    assert np.allclose(through.points_m[..., :2], capture.slopes * z_m[..., None])
    assert np.isnan(through.variance_m2).all()


def test_reasons_follow_what_a_filter_fills_and_removes(capture: SimulatedCapture):
    def swapped(z_m: np.ndarray) -> np.ndarray:
        filled = np.isnan(z_m)
        z_m[filled] = 0.7
        z_m[0, 0] = -1.0
        return z_m

    with functions_named({"swapped": swapped}):
        frames = FilteredFrames(capture, load_filter("swapped", {}))
        frame = next(frames.frames())
    assert frame.reason[0, 0] == Reason.NO_RETURN
    assert np.isnan(frame.z_m[0, 0])
    assert (frame.reason.ravel()[1:] == Reason.VALID).all()
    assert not np.isnan(next(capture.frames()).z_m[0, 0])  # the source's frames stay


def test_a_function_is_a_filter_of_this_process_only_while_it_is_named(capture: SimulatedCapture):
    with functions_named({"halved": lambda z_m: z_m / 2}):
        assert "halved" in filter_names()
        cloud = averages_through(capture, [1], MEAN, DepthFilterConfig(name="halved"))[1]
    plain = prefix_averages(capture, [1], MEAN)[1]
    assert np.allclose(cloud.points_m, plain.points_m / 2, equal_nan=True)
    with pytest.raises(UserError, match="there is no filter 'halved'"):
        load_filter("halved", {})
    with pytest.raises(UserError, match="there is a filter 'median' already"):
        functions_named({"median": np.copy}).__enter__()


def test_another_package_offers_a_function_or_a_class(
    capture: SimulatedCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "acme_filters.py").write_text(
        "def nearer(z_m):\n    return z_m - 0.01\n\nbroken = 3\n"
    )
    entries = {"nearer": "acme_filters:nearer", "broken": "acme_filters:broken"}
    offer(monkeypatch, tmp_path, "acme-filters", "tofpod.filters", entries)
    cloud = averages_through(capture, [1], MEAN, DepthFilterConfig(name="nearer"))[1]
    plain = prefix_averages(capture, [1], MEAN)[1]
    assert np.allclose(cloud.points_m[..., 2], plain.points_m[..., 2] - 0.01, equal_nan=True)
    with pytest.raises(UserError, match="neither a class nor a function"):
        load_filter("broken", {})


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("medain", {}, "did you mean 'median'"),
        ("median", {"kernel_size": 4}, "kernel_size"),
        ("spatial", {"alpha": 0.5}, "alpha"),
    ],
)
def test_mistakes_are_named(name: str, settings: dict[str, object], message: str):
    with pytest.raises(UserError, match=message):
        load_filter(name, settings)


def test_a_filter_that_changes_the_size_is_refused(capture: SimulatedCapture):
    with (
        functions_named({"small": lambda z_m: z_m[::2, ::2]}),
        pytest.raises(UserError, match="returns 12 x 17 pixels for 24 x 34"),
    ):
        averages_through(capture, [1], MEAN, DepthFilterConfig(name="small"))
