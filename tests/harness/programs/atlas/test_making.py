"""The parts of the atlas, and shards that are made of them, without running their studies."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.programs.atlas import making
from harness.programs.atlas.atlas import main
from harness.programs.atlas.limits import Conditions, Outside, PlaneNoise
from harness.programs.atlas.parts import Part
from harness.programs.atlas.shards import parts_of, twins_of
from harness.programs.atlas.stored import read_atlas
from scenes.sensor.camera import camera_names

FINEST = np.ones((3, 4))


def noise(frame_mm: np.ndarray, nearest_m: float = 0.3) -> PlaneNoise:
    return PlaneNoise((nearest_m, 0.95, 3.0), (0.1, 0.2, 0.4, 0.9), frame_mm, np.full((3, 4), 0.4))


def test_all_cameras_are_answered_by_those_of_their_numbers():
    twins = twins_of(camera_names())
    assert sorted(name for names in twins.values() for name in names) == sorted(camera_names())
    assert twins["azure_kinect_nfov"] == ["azure_kinect_nfov", "femto_bolt_nfov", "femto_mega_nfov"]
    assert twins["kinect_v2"] == ["kinect_v2"]


def test_boards_and_sizes_scale_with_the_distance():
    near, _, far, check = parts_of("azure_kinect_nfov", noise(FINEST))
    assert (near.distance_m, far.distance_m) == (0.3, 3.0)
    assert far.pixel_mm == pytest.approx(10 * near.pixel_mm) == pytest.approx(3e3 / 504.647)
    assert near.damages[0]["diameter_mm"] == [0.594, 7.13]
    # a dent of 2 mm in a face of 12 mm of pixels tells no limit
    kinds = [damage["kind"] for damage in near.damages]
    assert kinds == ["through", "blind", "blind", "dent", "slot", "slot"]
    # as many false calls on a board, at any distance
    assert near.false_calls_per_m2 == pytest.approx(100 * far.false_calls_per_m2, rel=0.01)
    assert check.is_check and check.albedos == (0.3,) and 0.3 < check.distance_m < 0.95
    assert [damage.get("depth_mm") for damage in check.damages] == [None, [4, 4], [1, 1], [4, 4]]


def test_where_the_camera_gives_no_depth_nothing_is_computed():
    frame_mm = FINEST.copy()
    frame_mm[-1, 0] = np.nan  # too dark far away
    frame_mm[0, 3] = np.nan  # too bright near by
    parts = parts_of("kinect_v2", noise(frame_mm))
    assert [part.albedos for part in parts] == [(0.1,), (0.1,), (0.9,)]
    assert [part.albedos for part in parts_of("kinect_v2", noise(FINEST))] == [
        (0.9,),
        (0.1,),
        (0.1, 0.9),
    ]
    frame_mm[0] = np.nan  # nothing near by: the next distance is the nearest
    assert [part.distance_m for part in parts_of("kinect_v2", noise(frame_mm))] == [0.95, 1.7, 3.0]
    assert parts_of("kinect_v2", noise(FINEST * np.nan)) == []
    with pytest.raises(Outside):
        noise(frame_mm).at(Conditions(0.4, 0.5, 1))


def written_limits(experiment, out: Path) -> None:  # type: ignore[no-untyped-def]
    """Write the limits of an experiment: a90 is a hundredth of its boards' width and frames."""
    rows = []
    for point in experiment.points:
        target = point.config.source.target
        rows.append(
            {
                "source.target.damage": json.dumps(target.damage.to_data()),
                "source.target.material.albedo_850": target.material.albedo_850,
                "frames": point.config.capture.frames,
                "a90_mm": target.board.width_mm / 100,
                "a90_low_mm": 0.0,
                "a90_high_mm": target.board.width_mm / 50,
                "smallest_mm": 0.1,
                "largest_mm": 99.0,
                "is_at_most": False,
                "hits": 30,
                "detector_version": 13,
            }
        )
    limits = pd.DataFrame(rows)
    albedo = "source.target.material.albedo_850"
    if limits[albedo].nunique() == 1:
        limits = limits.drop(columns=albedo)  # an axis of one value is no column
    folder = experiment.folder(out)
    folder.mkdir(parents=True)
    limits.to_parquet(folder / "limits.parquet")


def test_a_shard_is_made_once_and_again_only_after_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    runs: list[float] = []
    codes = [0, 130]

    def run(experiment, out, options, command):  # type: ignore[no-untyped-def]
        runs.append(experiment.config.source.target.distance_m)
        code = codes.pop(0) if codes else 0
        if code == 0 and not (experiment.folder(out) / "limits.parquet").exists():
            written_limits(experiment, out)
        return code

    monkeypatch.setattr(making, "run_study", run)
    monkeypatch.setattr(making, "measured_noise", lambda _: noise(FINEST, 0.525))
    arguments = ["kinect_v2", "--out", str(tmp_path)]
    assert main([*arguments, "--dry-run"]) == 0
    assert "in all: " in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert main(arguments) == 130 and runs == [0.525, 1.3]
    assert not (tmp_path / "atlas" / "atlas.json").exists()
    assert main(arguments) == 0 and runs[2:] == [0.525, 1.3, 3.0]
    shard = {limits.camera: limits for limits in read_atlas(tmp_path / "atlas" / "atlas.json")}[
        "kinect_v2"
    ]
    pixel_mm = {at_m: 1e3 * at_m / 365.456 for at_m in (0.525, 1.3, 3.0)}
    assert {set_up.conditions.distance_m for set_up in shard.set_ups} == set(pixel_mm)
    for set_up in shard.set_ups:
        width_mm = 150 * pixel_mm[set_up.conditions.distance_m]
        assert set_up.a90_mm == pytest.approx(width_mm / 100, rel=0.01)
    albedos = {(set_up.conditions.distance_m, set_up.conditions.albedo) for set_up in shard.set_ups}
    assert albedos == {(0.525, 0.9), (1.3, 0.1), (3.0, 0.1), (3.0, 0.9)}
    assert main(arguments) == 0 and len(runs) == 5
    assert "kinect_v2: of today's code" in capsys.readouterr().out


def test_a_part_states_the_settings_of_its_experiment():
    part = Part("kinect_v2", 1.0, (0.1,), (1,), 2.0, {"dent": (1.0,)})
    assert 'source.camera.name="kinect_v2"' in part.overrides
    assert "matching.radius_mm=20.0" in part.overrides
