"""What an experiment's results hang on: its detectors, its cameras and its settings."""

from __future__ import annotations

from pathlib import Path

from harness.experiment import digests as digests_module
from harness.experiment.digests import experiment_digests, simulation_digests
from harness.experiment.load import load_experiment
from harness.vocabulary.code_digests import changed_parts
from scenes.sensor.camera import load_camera

ROOT = Path(__file__).resolve().parents[3]


def of(name: str, *changes: str) -> dict[str, str]:
    return experiment_digests(load_experiment(ROOT / "experiments" / f"{name}.yaml", changes))


def test_a_setting_is_a_change_and_a_title_is_none():
    before = of("regression")
    assert changed_parts(before, of("regression", "title=other")) == []
    assert changed_parts(before, of("regression", "study.boards=30")) == ["experiment regression"]
    assert changed_parts(before, of("regression", "seed=2")) == ["experiment regression"]


def test_rooms_of_which_nothing_is_used_are_left_out():
    kinect = simulation_digests(["thesis"], ["kinect_v2"])
    lidar = simulation_digests(["thesis"], ["realsense_l515"])
    views = simulation_digests(["thesis"], ["kinect_v2"], several_views=True)
    assert set(kinect) - set(lidar) == {"scenes/sensor/amcw", "camera kinect_v2"}
    assert set(lidar) - set(kinect) == {"scenes/sensor/lidar", "camera realsense_l515"}
    assert {"detectors/views/mapping", "detectors/views/registration"} <= set(views) - set(kinect)
    for room in ("harness/trials", "harness/evaluation/pod", "scenes/render", "scenes/target"):
        assert room in kinect
    assert not [room for room in kinect if room.startswith(("harness/report", "harness/records"))]


def test_a_detector_counts_with_the_sources_that_it_reaches():
    thesis = simulation_digests(["thesis"], ["kinect_v2"])
    both_detectors = simulation_digests(["thesis", "matched"], ["kinect_v2"])
    assert "detectors/methods" in changed_parts(thesis, both_detectors)
    assert "scenes/render" not in changed_parts(thesis, both_detectors)


def test_a_cameras_number_counts_and_its_source_does_not(monkeypatch):
    camera = load_camera("kinect_v2")

    def with_read_noise(value: float, source: str) -> dict[str, str]:
        data = camera.to_data()
        data["photons"]["read_noise_electrons"] |= {"value": value, "source": source}
        changed = type(camera).from_data(data)
        monkeypatch.setattr(digests_module, "load_camera", lambda name: changed)
        return simulation_digests(["thesis"], ["kinect_v2"])

    before = with_read_noise(13.0, "a paper")
    assert changed_parts(before, with_read_noise(13.0, "another paper")) == []
    assert changed_parts(before, with_read_noise(14.0, "a paper")) == ["camera kinect_v2"]


def test_a_new_key_without_a_value_changes_nothing():
    without_empty = digests_module._without_empty
    assert without_empty({"a": 1, "b": {"c": None, "d": []}}) == without_empty(
        {"a": 1, "unknowns": []}
    )
    assert without_empty({"a": 0}) == {"a": 0}
    assert without_empty({"a": False}) == {"a": False}
