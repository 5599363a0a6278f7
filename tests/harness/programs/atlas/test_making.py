"""The parts of the atlas, and shards that are made of them, without running their studies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from harness.programs.atlas import making
from harness.programs.atlas.ask import main as ask
from harness.programs.atlas.atlas import main
from harness.programs.atlas.limits import Conditions, Outside, PlaneNoise
from harness.programs.atlas.parts import Part
from harness.programs.atlas.shards import parts_of, twins_of
from harness.programs.atlas.stored import read_atlas
from harness.runs import engines
from scenes.sensor.camera import camera_names
from tests.support.made_up_atlas import damages_of

FINEST = np.ones((3, 4))


def noise(frame_mm: np.ndarray, nearest_m: float = 0.3) -> PlaneNoise:
    return PlaneNoise((nearest_m, 0.95, 3.0), (0.1, 0.2, 0.4, 0.9), frame_mm, np.full((3, 4), 0.4))


def test_all_cameras_are_answered_by_those_of_their_numbers():
    twins = twins_of(camera_names())
    assert sorted(name for names in twins.values() for name in names) == sorted(camera_names())
    assert twins["azure_kinect_nfov"] == ["azure_kinect_nfov", "femto_bolt_nfov", "femto_mega_nfov"]
    assert twins["kinect_v2"] == ["kinect_v2"]


def test_boards_and_sizes_scale_with_the_distance():
    near, *middle, far = parts_of("azure_kinect_nfov", noise(FINEST))
    assert (near.distance_m, far.distance_m, len(middle)) == (0.3, 3.0, 4)
    assert far.pixel_mm == pytest.approx(10 * near.pixel_mm) == pytest.approx(3e3 / 504.647)
    assert near.damages[0]["diameter_mm"] == [0.594, 7.13]
    assert [damage["kind"] for damage in near.damages] == ["through", "blind", "dent", "slot"]
    # as many false calls on a board, at any distance
    assert near.false_calls_per_m2 == pytest.approx(100 * far.false_calls_per_m2, rel=0.01)


def test_albedo_does_not_go_with_the_distance():
    parts = parts_of("azure_kinect_nfov", noise(FINEST))
    log_distances = np.log([part.distance_m for part in parts])
    assert abs(np.corrcoef(log_distances, [part.albedo for part in parts])[0, 1]) < 0.35


def test_where_the_camera_gives_no_depth_nothing_is_computed():
    frame_mm = FINEST.copy()
    frame_mm[-1, 0] = np.nan  # too dark far away
    frame_mm[0, 3] = np.nan  # too bright near by
    parts = parts_of("kinect_v2", noise(frame_mm))
    assert [part.albedo for part in parts] == [0.3, 0.1, 0.3, 0.3, 0.9, 0.3]
    frame_mm[0] = np.nan  # nothing near by: the next distance is the nearest
    parts = parts_of("kinect_v2", noise(frame_mm))
    assert (parts[0].distance_m, parts[-1].distance_m) == (0.95, 3.0)
    assert parts_of("kinect_v2", noise(FINEST * np.nan)) == []
    with pytest.raises(Outside):
        noise(frame_mm).at(Conditions(0.4, 0.5, 1, 20.0))


class Nothing:
    """Stands for an engine that has no work."""

    def __enter__(self) -> Nothing:
        return self

    def __exit__(self, *error: object) -> None:
        pass


def test_a_shard_is_made_once_and_again_only_after_a_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """One part fails, which the shard says; a run that is stopped writes no shard."""
    runs: list[float] = []
    stream = np.random.default_rng(1)

    def run(experiment, out, engine, origin, *, retry_failed):  # type: ignore[no-untyped-def]
        distance_m = experiment.config.source.target.distance_m
        runs.append(distance_m)
        if len(runs) == 2:
            raise KeyboardInterrupt
        if distance_m > 2.5:
            return None, "the camera sees nothing of the board"
        part = next(
            candidate
            for candidate in parts_of("kinect_v2", near)
            if candidate.distance_m == distance_m
        )
        return damages_of("sharp", part, stream), ""

    near = noise(FINEST, 0.525)
    monkeypatch.setattr(making, "judged", run)
    monkeypatch.setattr(making, "measured_noise", lambda _: near)
    monkeypatch.setattr(engines, "engine_of", lambda *_: Nothing())
    arguments = ["kinect_v2", "--out", str(tmp_path)]
    assert main([*arguments, "--dry-run"]) == 0
    assert "in all: 6 distances, " in capsys.readouterr().out and not list(tmp_path.iterdir())
    atlas = tmp_path / "atlas" / "atlas.json"
    assert main(arguments) == 130 and not atlas.exists()
    assert main(arguments) == 0 and len(runs) == 8
    assert "at 3 m, albedo 0.1: the camera sees nothing" in capsys.readouterr().out
    shard = {limits.camera: limits for limits in read_atlas(atlas)}["kinect_v2"]
    assert len(shard.problems) == 1 and list(shard.kinds) == ["through", "blind", "dent", "slot"]
    assert [set_up.frames for set_up in shard.failed] == [1, 50]
    law = shard.kinds["blind"].law
    assert law.ranges["distance_m"] == (0.525, 2.12) and law.ranges["depth_mm"] == (1, 10)
    assert len(shard.kinds["blind"].set_ups) == 10
    assert main(arguments) == 0 and len(runs) == 8
    assert "kinect_v2: of today's code" in capsys.readouterr().out


def test_a_camera_without_any_part_is_a_shard_that_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(making, "measured_noise", lambda _: noise(FINEST * np.nan))
    monkeypatch.setattr(engines, "engine_of", lambda *_: Nothing())
    assert main(["kinect_v2", "--out", str(tmp_path)]) == 0
    question = ["--distance", "1m", "--atlas", str(tmp_path / "atlas" / "atlas.json")]
    capsys.readouterr()
    assert ask([*question, "--camera", "kinect_v2"]) == 2
    assert "gives no depth of any board" in capsys.readouterr().err


def test_a_part_states_the_settings_of_its_experiment():
    part = Part(
        camera="kinect_v2",
        distance_m=1.0,
        albedo=0.1,
        backing_mm=15.0,
        pixel_mm=2.0,
        depths_mm={"dent": (1.0, 2.0)},
    )
    assert 'source.camera.name="kinect_v2"' in part.overrides
    assert "matching.radius_mm=20.0" in part.overrides
    assert "source.target.backing.distance_mm=15.0" in part.overrides
