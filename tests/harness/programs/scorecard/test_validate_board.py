"""A drilled board beside its capture: a simulated capture whose truth is known, and refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.interpolate import griddata

from harness.experiment.load import load_experiment
from harness.programs.scorecard.validate import main
from harness.vocabulary.geometry import Lens, rays_of
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
from scenes.sensor.source import SimulatedUnit

BOARD = """\
name: known
title: A plate of known drill
seed: 5
source:
  kind: simulated
  target:
    name: custom
    board: {width_mm: 700.0, height_mm: 500.0, thickness_mm: 12.0}
    drill: {diameter_mm: 6.0}
    holes: [{id: 1, centre_mm: [-45, -30]}, {id: 2, centre_mm: [0, -30]},
            {id: 3, centre_mm: [45, -30]}, {id: 4, centre_mm: [-45, 15]},
            {id: 5, centre_mm: [0, 15]}, {id: 6, centre_mm: [45, 15]}]
    material: {albedo_850: 0.5, grain_contrast: 0.0}
    pose: {distance_m: 0.3, tilt_x_deg: 5.0, tilt_y_deg: 4.0, offset_x_mm: 10.0}
  camera: {name: azure_kinect_nfov_binned, effects: {frame_jumps: false}}
  render: {bounces: 0}
capture: {frames: 6}
detector: {name: thesis, settings: {crop: {kind: none}}}
threshold: {k: 4.0}
matching: {radius_mm: 10.0}
sweep:
  source.target.drill.diameter_mm: [4.0, 6.0, 9.0]
"""
COLOUR = Lens(480, 270, 230.0, 230.0, 239.5, 134.5)


def aligned(z_m: np.ndarray, camera, T_colour_depth: np.ndarray) -> np.ndarray:
    """A depth image as it is seen by the colour camera: its points moved and interpolated in the
    other image."""
    slopes = camera.nominal_lens.region_slopes(camera.nominal_lens.whole)
    points = rays_of(slopes)[np.isfinite(z_m)] * z_m[np.isfinite(z_m), None]
    moved = points @ T_colour_depth[:3, :3].T + T_colour_depth[:3, 3]
    v, u = np.mgrid[: COLOUR.height, : COLOUR.width]
    return np.nan_to_num(griddata(COLOUR.project(moved), moved[:, 2], (u, v)))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """Frames of a board with holes of 6 mm by another unit, aligned to a small colour camera, as
    PNGs; the second frame is displaced by 17 mm."""
    home = tmp_path_factory.mktemp("plate")
    (home / "known.yaml").write_text(BOARD)
    points = load_experiment(home / "known.yaml").points
    (point,) = [point for point in points if point.label.endswith("6.0")]
    source = point.config.source
    config = source.camera.model_copy(update={"unit_seed": 9})
    camera = camera_of(config)
    view, _ = cached_view(source.target, camera.optics, source.render, home / "renders")
    (home / "depth").mkdir()
    capture = SimulatedUnit(camera, config, view).capture(6, 77, "real")
    for number, frame in enumerate(capture.frames()):
        image = 1e3 * aligned(frame.z_m, camera, camera.colour.T_colour_depth)
        image = np.where(image > 0, image + 17 * (number == 1), 0)
        assert cv2.imwrite(str(home / "depth" / f"{number}.png"), np.round(image).astype(np.uint16))
    # a distortion of next to nothing: with none at all the nominal colour lens's would count
    lens = {"fx": 230.0, "fy": 230.0, "cx": 239.5, "cy": 134.5, "width": 480, "height": 270}
    (home / "lens.json").write_text(json.dumps({**lens, "distortion": [1e-9, 0, 0, 0, 0, 0, 0, 0]}))
    return home


@pytest.mark.slow
def test_the_drill_of_a_simulated_capture_is_found_again(recorded, capsys):
    options = [
        "--capture",
        str(recorded / "depth"),
        "--intrinsics",
        str(recorded / "lens.json"),
        "--unit",
        "mm",
    ]
    out = recorded / "out"
    assert main(["--board", str(recorded / "known.yaml"), *options, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "diameter=6 mm is closest" in printed
    assert "1.png is left out: the whole range jumps by +17.0 mm" in printed
    rows = list(csv.DictReader((out / "capture.csv").open()))
    compared = [
        row
        for row in rows
        if row["where"].endswith("6 mm")
        and row["quantity"] in ("temporal deviation", "peak of a hole")
        and row["pixels"] != "0"
    ]
    assert {row["quantity"] for row in compared} == {"temporal deviation", "peak of a hole"}
    for row in compared:
        assert float(row["simulated"]) == pytest.approx(float(row["measured"]), rel=0.15)
    peaks = {row["where"]: float(row["simulated"]) for row in rows if row["at"] == "all"}
    assert list(peaks.values()) == sorted(peaks.values())
    assert "is closest" in (out / "capture.html").read_text()


@pytest.mark.slow
def test_without_a_capture_the_simulation_stands_alone(recorded, capsys):
    out = recorded / "alone"
    assert main(["--board", str(recorded / "known.yaml"), "--out", str(out)]) == 0
    assert (
        capsys.readouterr().out.count("No capture is given, so there is nothing to compare with.")
        == 1
    )
    rows = list(csv.DictReader((out / "capture.csv").open()))
    assert {row["measured"] for row in rows} == {""}
    peaks = [
        float(row["simulated"])
        for row in rows
        if row["quantity"] == "peak of a hole" and row["at"] == "all"
    ]
    assert peaks
    assert min(peaks) > 0


def test_an_experiment_without_a_board_is_refused(capsys, tmp_path):
    assert main(["--board", "averaging", "--out", str(tmp_path / "out")]) == 2
    assert "declares no drilled board" in capsys.readouterr().err
    assert main(["--board", "plate", "--camera", "kinect_v2"]) == 2
    assert "the experiment names the camera" in capsys.readouterr().err
