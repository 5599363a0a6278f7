"""`harness.programs.implant.implant`: virtual damage is what the camera would have measured, and
the study of it is a study."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness import sweep
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import read_record
from harness.inspection.arguments import opened
from harness.programs.dataset import export as exporting
from harness.programs.implant import implant
from harness.programs.implant.scans import Judging, Scan, damages_placed
from harness.vocabulary.geometry import MM, Frame, Lens, Reason, Region
from harness.vocabulary.words import damage_kind
from scenes.closed_form import plane_view
from scenes.implants import Implant, PartFace, implant_of, tangent_board, unit_config
from scenes.optics import RenderConfig
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target import custom, flaws
from scenes.target.drawn import DrawnTargetConfig

CAMERA = "azure_kinect_nfov"
NOISE = CameraConfig(
    name=CAMERA, effects=NO_EFFECTS.model_copy(update={"noise": True, "multipath": True})
)
REGION = Region(250, 330, 250, 360)
FRAMES = 4


AT = {"id": 1, "centre_mm": (12.0, -6.0)}
HOLE = {"holes": (custom.HoleConfig(diameter_mm=7.0, **AT),)}
SLOT = {
    "flaws": (
        flaws.SlotConfig(
            kind="slot", length_mm=30.0, width_mm=6.0, angle_deg=25.0, depth_mm=5.0, **AT
        ),
    )
}
BUMP = {"flaws": (flaws.RoundConfig(kind="pressed_bump", diameter_mm=25.0, depth_mm=3.0, **AT),)}


def board(width_mm: float, pose: custom.PoseConfig, **damage: Any) -> custom.TargetConfig:
    """A plate with one damage off its centre, before a backing."""
    return custom.TargetConfig(
        board=custom.BoardConfig(
            width_mm=width_mm, height_mm=width_mm, thickness_mm=12.7, shape=custom.FlatConfig()
        ),
        **damage,
        backing=custom.BackingConfig(distance_mm=20.0),
        material=custom.MaterialConfig(grain_contrast=0.0),
        pose=pose,
    )


@pytest.mark.parametrize(
    ("damage", "most_mm"), [(HOLE, 8.0), (SLOT, 2.0), (BUMP, -2.0)], ids=["hole", "slot", "bump"]
)
def test_implanted_damage_is_what_the_camera_would_have_seen(
    damage: dict, most_mm: float, tmp_path: Path
):
    """The whole board is rendered with its damage, which alone is put into frames of the same
    board without it."""
    camera = camera_of(NOISE)
    target = board(
        100.0,
        custom.PoseConfig(distance_m=0.7, tilt_x_deg=12.0, tilt_y_deg=-7.0, offset_x_mm=20.0),
        **damage,
    )
    units = []
    for variant in (target, target.hole_free()):
        view, _ = cached_view(variant, camera.optics, RenderConfig(), tmp_path)
        units.append(SimulatedUnit(camera, NOISE, view))
    stacks = []
    for unit, name in zip(units, "ab", strict=True):
        frames = [frame.z_m for frame in unit.capture(48, 1, name).frames()]
        stacks.append(np.stack(frames).astype(float))
    observed, bare = stacks
    T = target.pose.T_camera_board
    position = (T @ [12.0 * MM, -6.0 * MM, 0.0, 1.0])[:3]
    config, same = unit_config(CAMERA, camera.nominal_lens)
    (placed,) = target.damages
    part = PartFace(T, np.full(2, -50.0 * MM), np.full(2, 50.0 * MM))
    alone = tangent_board(target, placed, part, position, T[:3, 2])
    implant = implant_of(config, same, camera.nominal_lens, alone, 48, 3, tmp_path)
    assert same
    np.testing.assert_allclose(alone.pose.T_camera_board[:3, 2], T[:3, 2], atol=1e-9)

    cut = implant.region.within(units[0].region)
    z_m = np.zeros(implant.shift_m.shape)
    valid = np.zeros(implant.shift_m.shape)
    for number, plain in enumerate(bare):
        frame = Frame("", plain[cut], np.zeros(implant.shift_m.shape, np.uint8))
        complete = plain[cut].copy()
        reason = frame.reason.copy()
        part = Implant(
            Region(0, complete.shape[0], 0, complete.shape[1]),
            implant.shift_m,
            implant.noise_m,
            implant.lost,
        )
        part.put_into(frame, number, complete, reason)
        assert np.array_equal(np.isnan(complete), (reason != Reason.VALID) | np.isnan(frame.z_m))
        z_m = z_m + np.nan_to_num(complete)
        valid = valid + np.isfinite(complete)
    with np.errstate(invalid="ignore"):
        depth_m = z_m / valid - np.nanmean(observed[:, *cut], axis=0)
        changed = np.abs(implant.shift_m) > 1 * MM
        assert changed.sum() > 20
        # of the hole the backing, 33 mm behind the face, mixed with the rim
        assert implant.depth_mm > abs(most_mm) and implant.shift_m.sum() * most_mm > 0
        pair = changed & (valid > FRAMES)
        assert np.sqrt(np.nanmean(depth_m[pair] ** 2)) < 0.05 * implant.depth_mm * MM + 0.1 * MM
        assert abs(np.nanmean(depth_m[pair])) < 0.02 * implant.depth_mm * MM + 0.05 * MM
        lost = 1 - valid / len(bare)
        assert (
            np.abs(lost - np.isnan(observed[:, *cut]).mean(axis=0))[implant.shift_m != 0].mean()
            < 0.1
        )


@pytest.mark.parametrize(("radius_m", "said"), [(0.3, "the inner"), (None, "")])
def test_a_rim_that_is_seen_more_steeply_is_told(radius_m: float | None, said: str, tmp_path: Path):
    """A cylinder that is seen at up to 63 degrees, and a plane: damage keeps off both rims, and
    one of them matters."""
    slope = np.broadcast_to((np.arange(200) - 99.5) / 400, (200, 200))
    z_m = np.full((200, 200), 0.8)
    if radius_m is not None:  # the nearer end of the ray in the circle about (0, 0.8 + radius)
        middle = 0.8 + radius_m
        z_m = (middle - np.sqrt(middle**2 - (1 + slope**2) * (middle**2 - radius_m**2))) / (
            1 + slope**2
        )
    noise = np.random.default_rng(1).normal(scale=0.3 * MM, size=(6, 200, 200))
    np.save(tmp_path / "part.npy", (z_m + noise).astype(np.float32))
    (tmp_path / "lens.json").write_text('{"fx": 400, "fy": 400, "cx": 99.5, "cy": 99.5}')
    settings = '{"crop":{"kind":"none"},"surface":{"shape":"auto"}}'
    judging = Judging("local", settings, 0.015, 7.0, lambda cloud: (7.0, ()))
    scan = Scan(opened([tmp_path / "part.npy"], str(tmp_path / "lens.json"), unit="m"), judging)
    family = DrawnTargetConfig(
        damage={
            "kind": "slot",
            "per_board": 4,
            "width_mm": (2, 6),
            "length_mm": (20, 25),
            "depth_mm": (2, 3),
        }
    )
    assert said in scan.left_out(family) and bool(scan.left_out(family)) == bool(said)
    middle_deg = np.nanmax(np.where(scan.depth_px > 20, scan.angle_deg, np.nan))
    assert (middle_deg > 25) == (radius_m is not None)
    # a slot's own outline is its truth, and what lies within a margin of it is no intact surface
    (site, *_) = [
        placed
        for n in range(9)
        for placed in [damages_placed(scan, family, CAMERA, "damaged", n)]
        if placed.damages
    ]
    reference = scan.known(scan.whole, site, damaged=True)
    for damage in reference.truth:
        wide_m2 = scan.pitch_m**2 * len(reference.outlines[damage.id])
        assert wide_m2 == pytest.approx(damage.length_m * damage.width_m, rel=0.4)
        assert not reference.undamaged.ravel()[reference.outlines[damage.id]].any()


def recorded(folder: Path, frames: int = FRAMES) -> Path:
    """Frames of a wall by the whole model of the camera on a part of its sensor, with their lens."""
    camera = camera_of(NOISE)
    config = CameraConfig(name=CAMERA)
    view = plane_view(camera, REGION.grown(camera.optics.margin_px, 576, 640), 0.6, 0.6, 0.05)
    unit = SimulatedUnit(camera, config, view)
    cut = REGION.within(unit.region)
    folder.mkdir()
    np.save(
        folder / "wall.npy",
        np.stack([frame.z_m[cut] for frame in unit.capture(frames, 1, "wall").frames()]),
    )
    lens = camera.nominal_lens
    shifted = Lens(
        REGION.shape[1],
        REGION.shape[0],
        lens.fx,
        lens.fy,
        lens.cx - REGION.col0,
        lens.cy - REGION.row0,
    )
    matrix = shifted.matrix.T.ravel().tolist()
    sizes = {"width": shifted.width, "height": shifted.height}
    (folder / "lens.json").write_text(json.dumps({**sizes, "intrinsic_matrix": matrix}))
    return folder


@pytest.mark.usefixtures("unsaved")
def test_the_program_states_a_limit_of_a_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = recorded(tmp_path / "wall")
    out = tmp_path / "out"
    arguments = [
        str(folder / "wall.npy"),
        "--intrinsics",
        str(folder / "lens.json"),
        "--camera",
        CAMERA,
        "--crop",
        "none",
    ]
    arguments += [
        "--damage",
        "through",
        "--diameters",
        "2:14",
        "--targets",
        "4",
        "--hit-radius",
        "6",
        "--unit",
        "m",
    ]
    assert (
        implant.main(
            [*arguments, "--frames", str(FRAMES), "1", "--threshold", "7", "--out", str(out)]
        )
        == 0
    )
    record = read_record(out)
    assert [set_up.frames for set_up in record.set_ups] == [1, FRAMES]
    for set_up in record.set_ups:
        inspected = set_up.inspected
        assert len(inspected.hit) >= 4
        assert (
            inspected.hit[inspected.diameter_mm > 9].all()
            and not inspected.hit[inspected.diameter_mm < 2.5].any()
        )
        assert set_up.unflawed.area_m2[0] == pytest.approx(80 * 110 * (0.6 / 504) ** 2, rel=0.05)
    assert len(record.set_ups[0].unflawed.board) == FRAMES // 2
    printed = capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert (
        printed.startswith("warning: virtual damage may be harder to find than real damage")
        and "7 of 23" in page
    )
    assert "one average sets the threshold" in printed and "one average sets the threshold" in page
    assert "What is measured and what is simulated" in page

    assert implant.main([*arguments, "--depths", "2:4", "--out", str(tmp_path / "no")]) == 2
    assert "depth_mm" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        implant.main([*arguments, "--hit-radius", "0"])
    assert "--hit-radius: '0' is not a length" in capsys.readouterr().err
    for name in ("--targets", "--frames"):
        assert implant.main([*arguments, name, "0", "--out", str(tmp_path / "no")]) == 2
        assert f"{name} 0" in capsys.readouterr().err
    arguments[arguments.index("2:14")] = "60:80"
    assert implant.main([*arguments, "--out", str(tmp_path / "no")]) == 2
    assert not (tmp_path / "no").exists()


@pytest.mark.slow
def test_the_implanted_limit_is_the_simulated_one(tmp_path: Path):
    """A study of simulated boards, and damage put into the exported frames of one board without
    any."""
    experiment = Path(__file__).resolve().parents[4] / "experiments" / "detection_limit.yaml"
    common = {name: 0 for name in ("tilt_deg", "offset_mm", "distance_jitter_mm", "roll_deg")}
    common |= {"board.width_mm": 400, "board.height_mm": 300, "seed": 5}
    changes = [
        text for key, value in common.items() for text in ("--set", f"source.target.{key}={value}")
    ]
    export = [
        "--format",
        "mcap",
        "--frames",
        "24",
        "--hole-free",
        "--results",
        str(tmp_path / "res"),
    ]
    assert (
        exporting.main([str(experiment), *changes, *export, "--out", str(tmp_path / "bags")]) == 0
    )
    study = [
        'sweep={"capture.frames":[1]}',
        "detector.name=local",
        "detector.settings={}",
        "threshold={k: 7}",
    ]
    study += ["study.boards=7", "study.hole_free_boards=1"]
    study += ["source.target.damage={kind: through, per_board: 8, diameter_mm: [2, 8]}"]
    arguments = [text for change in study for text in ("--set", change)]
    assert sweep.main([str(experiment), *changes, *arguments, "--out", str(tmp_path / "sim")]) == 0
    arguments = [
        "--camera",
        CAMERA,
        "--damage",
        "through",
        "--diameters",
        "2:8",
        "--targets",
        "56",
        "--frames",
        "1",
    ]
    out = tmp_path / "implanted"
    assert (
        implant.main(
            [str(tmp_path / "bags" / "view_00"), *arguments, "--threshold", "7", "--out", str(out)]
        )
        == 0
    )
    simulated = limit_of(read_record(tmp_path / "sim" / "detection_limit" / "latest").set_ups[0])
    implanted = limit_of(read_record(out).set_ups[0])
    assert simulated.a90_interval_mm.low < implanted.a90_interval_mm.high
    assert implanted.a90_interval_mm.low < simulated.a90_interval_mm.high


@pytest.mark.parametrize(
    ("words", "apart_mm"),
    [
        ("--damage hole --diameters 2:10", 40.0),
        ("--damage through --diameters 3:6cm", 70.0),
        ("--damage through --diameters 30:60 --apart 8cm", 80.0),
        ("--damage hole --diameters 2:10 --hit-radius 30", 70.0),
        ("--damage crack --diameters 3:30 --lengths 40:40 --depths 4:4", 60.0),
    ],
)
def test_large_damage_lies_farther_apart(words: str, apart_mm: float) -> None:
    """Ten millimetres more than two hit radii, and than the largest damage."""
    options = implant.main.parser().parse_args(
        ["captures", "--camera", "azure_kinect_nfov", *words.split()]
    )
    options.damage = damage_kind("--damage", options.damage, implant.DAMAGES)
    scan = SimpleNamespace(size_m=np.array([0.8, 0.6]), area_m2=0.48)
    family = implant._family(options, [scan])
    assert family.apart_mm == apart_mm
    assert family.damage.kind == options.damage
