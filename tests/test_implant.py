"""`harness.implant`: virtual damage is what the camera would have measured, and the study of it is a study."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from harness import export as exporting
from harness import implant, sweep
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import read_record
from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region
from scenes.closed_form import plane_view
from scenes.implants import Implant, implant_of, local_board, side_mm, unit_config
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import NO_EFFECTS, CameraConfig, camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom

CAMERA = "azure_kinect_nfov"
NOISE = CameraConfig(name=CAMERA, effects=NO_EFFECTS.model_copy(update={"noise": True, "multipath": True}))
REGION = Region(250, 330, 250, 360)
FRAMES = 4


def board(width_mm: float, pose: custom.PoseConfig) -> custom.TargetConfig:
    """A plate with one hole off its centre, before a backing."""
    return custom.TargetConfig(
        board=custom.BoardConfig(width_mm=width_mm, height_mm=width_mm, thickness_mm=12.7, shape=custom.FlatConfig()),
        holes=(custom.HoleConfig(id=1, diameter_mm=7.0, centre_mm=(12.0, -6.0)),),
        backing=custom.BackingConfig(distance_mm=20.0),
        material=custom.MaterialConfig(grain_contrast=0.0),
        pose=pose,
    )


def test_an_implanted_hole_is_the_hole_that_the_camera_would_have_seen(tmp_path: Path):
    """The whole board is rendered with its hole; the hole alone is put into frames of the same board without it."""
    camera = camera_of(NOISE)
    target = board(90.0, custom.PoseConfig(distance_m=0.7, tilt_x_deg=12.0, tilt_y_deg=-7.0, offset_x_mm=20.0))
    units = []
    for each in (target, target.hole_free()):
        view, _ = cached_view(each, camera.optics, RenderConfig(), tmp_path)
        units.append(SimulatedUnit(camera, NOISE, view))
    seen, bare = (
        np.stack([frame.z_m for frame in unit.capture(48, 1, name).frames()]).astype(float)
        for unit, name in zip(units, "ab", strict=True)
    )
    T = target.pose.T_camera_board
    place = (T @ [12.0 * MM, -6.0 * MM, 0.0, 1.0])[:3]
    config, same = unit_config(CAMERA, camera.nominal_lens)
    alone = local_board(target, target.holes[0], place, T[:3, 2], side_mm(target.holes[0], 0.7, config))
    found = implant_of(config, same, camera.nominal_lens, alone, 48, 3, tmp_path)
    assert same
    np.testing.assert_allclose(alone.pose.T_camera_board[:3, 2], T[:3, 2], atol=1e-9)

    cut = found.region.within(units[0].region)
    z_m, valid = np.zeros(found.shift_m.shape), np.zeros(found.shift_m.shape)
    for number, plain in enumerate(bare):
        frame, whole = Frame("", plain[cut], np.zeros(found.shift_m.shape, np.uint8)), plain[cut].copy()
        reason = frame.reason.copy()
        part = Implant(Region(0, whole.shape[0], 0, whole.shape[1]), found.shift_m, found.noise_m, found.lost)
        part.put_into(frame, number, whole, reason)
        assert np.array_equal(np.isnan(whole), (reason != Reason.VALID) | np.isnan(frame.z_m))
        z_m, valid = z_m + np.nan_to_num(whole), valid + np.isfinite(whole)
    with np.errstate(invalid="ignore"):
        depth_m = z_m / valid - np.nanmean(seen[:, *cut], axis=0)
        changed = np.abs(found.shift_m) > 1 * MM
        assert changed.sum() > 20
        assert found.shift_m.max() > 8 * MM  # the backing, 33 mm behind the face, mixed with the rim
        both = changed & (valid > FRAMES)
        assert np.sqrt(np.nanmean(depth_m[both] ** 2)) < 0.05 * found.shift_m.max()
        assert abs(np.nanmean(depth_m[both])) < 0.02 * found.shift_m.max()
        lost = 1 - valid / len(bare)
        assert np.abs(lost - np.isnan(seen[:, *cut]).mean(axis=0))[found.shift_m != 0].mean() < 0.1


def recorded(folder: Path, frames: int = FRAMES) -> Path:
    """Frames of a wall by the whole model of the camera on a part of its sensor, with their lens."""
    camera = camera_of(NOISE)
    config = CameraConfig(name=CAMERA)
    view = plane_view(camera, REGION.grown(camera.optics.margin_px, 576, 640), 0.6, 0.6, 0.05)
    unit = SimulatedUnit(camera, config, view)
    cut = REGION.within(unit.region)
    folder.mkdir()
    np.save(folder / "wall.npy", np.stack([frame.z_m[cut] for frame in unit.capture(frames, 1, "wall").frames()]))
    lens = camera.nominal_lens
    shifted = Lens(REGION.shape[1], REGION.shape[0], lens.fx, lens.fy, lens.cx - REGION.col0, lens.cy - REGION.row0)
    matrix = shifted.matrix.T.ravel().tolist()
    sizes = {"width": shifted.width, "height": shifted.height}
    (folder / "lens.json").write_text(json.dumps({**sizes, "intrinsic_matrix": matrix}))
    return folder


def test_the_program_states_a_limit_of_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = recorded(tmp_path / "wall")
    out = tmp_path / "out"
    given = [str(folder / "wall.npy"), "--intrinsics", str(folder / "lens.json"), "--camera", CAMERA, "--crop", "none"]
    given += ["--damage", "through", "--diameters", "2:14", "--targets", "4", "--hit-radius", "6", "--unit", "m"]
    assert implant.main([*given, "--frames", str(FRAMES), "1", "--threshold", "7", "--out", str(out)]) == 0
    record = read_record(out)
    assert [one.frames for one in record.set_ups] == [1, FRAMES]
    for one in record.set_ups:
        seen = one.inspected
        assert len(seen.hit) >= 4
        assert seen.hit[seen.diameter_mm > 9].all() and not seen.hit[seen.diameter_mm < 2.5].any()
        assert one.unflawed.area_m2[0] == pytest.approx(80 * 110 * (0.6 / 504) ** 2, rel=0.05)
    assert len(record.set_ups[0].unflawed.board) == FRAMES // 2
    said, page = capsys.readouterr().out, (out / "report.html").read_text()
    assert "one average sets the threshold" in said and "one average sets the threshold" in page
    assert "What is measured and what is simulated" in page

    assert implant.main([*given, "--depths", "2:4", "--out", str(tmp_path / "no")]) == 2
    assert "depth_mm" in capsys.readouterr().err
    given[given.index("2:14")] = "60:80"
    assert implant.main([*given, "--out", str(tmp_path / "no")]) == 2
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_the_implanted_limit_is_the_simulated_one(tmp_path: Path):
    """A study of simulated boards, and damage put into the exported frames of one board without any."""
    experiment = Path(__file__).resolve().parents[1] / "experiments" / "detection_limit.yaml"
    common = {name: 0 for name in ("tilt_deg", "offset_mm", "distance_jitter_mm", "roll_deg")}
    common |= {"board.width_mm": 400, "board.height_mm": 300, "seed": 5}
    changes = [text for key, value in common.items() for text in ("--set", f"source.target.{key}={value}")]
    export = ["--format", "mcap", "--frames", "24", "--hole-free", "--results", str(tmp_path / "res")]
    assert exporting.main([str(experiment), *changes, *export, "--out", str(tmp_path / "bags")]) == 0
    study = ['sweep={"capture.frames":[1]}', "detector.name=local", "detector.settings={}", "threshold={k: 7}"]
    study += ["study.boards=7", "study.hole_free_boards=1"]
    study += ["source.target.damage={kind: through, per_board: 8, diameter_mm: [2, 8]}"]
    given = [text for each in study for text in ("--set", each)]
    assert sweep.main([str(experiment), *changes, *given, "--out", str(tmp_path / "sim")]) == 0
    given = ["--camera", CAMERA, "--damage", "through", "--diameters", "2:8", "--targets", "56", "--frames", "1"]
    out = tmp_path / "implanted"
    assert implant.main([str(tmp_path / "bags" / "view_00"), *given, "--threshold", "7", "--out", str(out)]) == 0
    simulated, implanted = (
        limit_of(read_record(folder).set_ups[0]) for folder in (tmp_path / "sim" / "detection_limit" / "latest", out)
    )
    assert simulated.a90_interval_mm.low < implanted.a90_interval_mm.high
    assert implanted.a90_interval_mm.low < simulated.a90_interval_mm.high
