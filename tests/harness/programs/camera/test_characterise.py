"""One's own camera: known cameras' simulated captures measured, the file that repeats them, real
walls, bad input."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from ruamel.yaml import YAML

from harness.programs.camera import characterise
from harness.vocabulary.geometry import MM, Lens, rays_of
from scenes.closed_form import Plane, image_view
from scenes.sensor.camera import load_camera, read_camera
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.empirical.facts import EmpiricalCamera
from scenes.sensor.source import SimulatedUnit

FRAMES = 30
TRUTH = """
name: true_camera
title: A stereo camera
kind: empirical
wavelength_nm: {value: 850.0, tag: M, source: test}
lens:
  width_px: {value: 200, tag: M, source: test}
  height_px: {value: 160, tag: M, source: test}
  fx_px: {value: 220.0, tag: M, source: test}
  fy_px: {value: 221.0, tag: M, source: test}
  cx_px: {value: 99.0, tag: M, source: test}
  cy_px: {value: 81.0, tag: M, source: test}
  distortion: {value: [], tag: M, source: test}
unit:
  frames_per_second: {value: 30.0, tag: M, source: test}
  offset_mm: {value: 0.0, tag: M, source: test}
  drift_mm: {value: 0.0, tag: M, source: test}
  drift_min: {value: 20.0, tag: M, source: test}
  drift_ramp: {value: 0.0, tag: M, source: test}
  jump_rate: {value: 0.1, tag: M, source: test}
  jump_mm: {value: 12.0, tag: M, source: test}
  jitter_mm: {value: 0.5, tag: M, source: test}
light:
  amplitude_at_1m: {value: 400.0, tag: M, source: test}
  albedo: {value: 0.6, tag: M, source: test}
noise:
  range_mm: {value: [1000.0], tag: M, source: test}
  sigma_mm: {value: [2.0], tag: M, source: test}
  range_exponent: {value: 1.6, tag: M, source: test}
  brightness_exponent: {value: 0.7, tag: M, source: test}
  rows: {value: [0.8, 0.6], tag: M, source: test}
  columns: {value: [0.7071, 0.7071], tag: M, source: test}
fixed_pattern:
  deviation_mm: {value: 1.5, tag: M, source: test}
  rows: {value: [0.577, 0.577, 0.577], tag: M, source: test}
  columns: {value: [0.577, 0.577, 0.577], tag: M, source: test}
dropouts:
  amplitude: {value: [10.0, 1000.0], tag: M, source: test}
  share: {value: [0.4, 0.0], tag: M, source: test}
edge:
  gap_px: {value: 4.0, tag: M, source: test}
  blur_px: {value: 0.0, tag: M, source: test}
  least_step_mm: {value: 20.0, tag: M, source: test}
engine:
  min_range_mm: {value: 0.0, tag: M, source: test}
  max_range_mm: {value: 20000.0, tag: M, source: test}
  output_step_mm: {value: 1.0, tag: M, source: test}
"""


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> EmpiricalCamera:
    path = tmp_path_factory.mktemp("camera") / "true_camera.yaml"
    path.write_text(TRUTH)
    camera = read_camera(path)
    assert isinstance(camera, EmpiricalCamera)
    return camera


def recorded(
    path: Path,
    camera,
    z_m: np.ndarray,
    light: np.ndarray,
    frames: int = FRAMES,
    keep=True,
    **config,
) -> Path:
    """A capture of a simulated unit before a depth image, as whole millimetres with amplitude and
    lens."""
    lens: Lens = camera.nominal_lens
    effects = EffectsConfig(unit_offset=False, warm_up_drift=False, **config)
    unit = SimulatedUnit(
        camera, CameraConfig(effects=effects), image_view(camera, lens.whole, z_m, light)
    )
    taken = list(unit.capture(frames, 3, path.stem).frames())
    stored = np.stack([np.rint(np.nan_to_num(frame.z_m) / MM).astype(np.uint16) for frame in taken])
    beside = {"amplitude": np.stack([frame.amplitude for frame in taken])} if keep else {}
    np.savez(path, depth=stored, **beside)
    path.with_name("lens.json").write_text(
        f'{{"fx": {lens.fx}, "fy": {lens.fy}, "cx": {lens.cx}, "cy": {lens.cy}}}'
    )
    return path


def wall(
    camera, distance_m: float, slope: float = 0.0, albedos=(0.3, 0.9)
) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a tilted wall, and its light: a grey ramp times the cosine over range squared."""
    slopes = camera.nominal_lens.region_slopes(camera.nominal_lens.whole)
    plane = Plane(distance_m, slope)
    z_m = plane.z_along_m(slopes)
    rays = rays_of(slopes)
    range_m = z_m * np.linalg.norm(rays, axis=-1)
    cosine = -(rays @ plane.normal) / np.linalg.norm(rays, axis=-1)
    albedo = np.linspace(*albedos, z_m.shape[0])[:, None]
    return z_m, albedo * cosine / range_m**2


def figures_of(folder: Path) -> pd.DataFrame:
    return pd.read_csv(folder / "characteristics.csv")


@pytest.mark.usefixtures("unsaved")
@pytest.mark.slow  # a long recording
def test_an_empirical_camera_s_truth_is_found_again(truth, tmp_path, capsys):
    """Noise law, correlation, dropouts, jitter, jumps and pattern within 10 %, and a file that
    repeats them."""
    paths = [
        recorded(tmp_path / f"{name}.npz", truth, *wall(truth, distance_m, slope))
        for name, distance_m, slope in (
            ("near", 0.8, 0.0),
            ("tilted", 1.1, 0.5),
            ("far", 1.6, 0.05),
        )
    ]
    out = tmp_path / "out"
    arguments = [*map(str, paths), "--intrinsics", str(tmp_path / "lens.json"), "--out", str(out)]
    arguments += ["--certificate", "--about", "firmware=1.6"]
    assert characterise.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "displaced as a whole" in printed
    camera = read_camera(out / "my_camera.yaml")
    assert isinstance(camera, EmpiricalCamera)
    assert camera.noise.range_exponent.value == pytest.approx(1.6, rel=0.1)
    assert camera.noise.brightness_exponent.value == pytest.approx(0.7, rel=0.1)
    # the recorded wall's mean albedo is what counts as 1
    brightness = camera.light.amplitude_at_1m.value / truth.light.amplitude_at_1m.value
    at_1m = np.interp(1000.0, camera.noise.range_mm.value, camera.noise.sigma_mm.value)
    assert at_1m == pytest.approx(2.0 * brightness**-0.7, rel=0.1)
    assert camera.unit.jitter_mm.value == pytest.approx(0.5, rel=0.2)  # 120 frames tell it to 7 %
    assert camera.unit.jump_rate.value == pytest.approx(0.1, abs=0.06)
    assert camera.unit.jump_mm.value == pytest.approx(12.0, rel=0.1)
    assert camera.fixed_pattern.deviation_mm.value == pytest.approx(1.5, rel=0.1)
    share = np.interp(
        np.log(100.0), np.log(camera.dropouts.amplitude.value), camera.dropouts.share.value
    )
    assert share == pytest.approx(0.2, abs=0.02)
    table = figures_of(out)
    close = table[
        table["figure"].isin(
            ["temporal noise", "fill rate", "fixed pattern", "plane-fit rms, one frame"]
        )
    ]
    assert len(close) == 10
    assert close["ratio"].between(0.9, 1.1).all()
    correlated = table[table["figure"].isin(["noise correlation", "pattern correlation"])]
    assert (correlated["simulated"] - correlated["measured"]).abs().max() < 0.1
    first = table[table["figure"] == "noise correlation"].set_index("where")["measured"]
    assert first["x, lag 1"] == pytest.approx(0.5, abs=0.05)
    assert first["y, lag 1"] == pytest.approx(0.48, abs=0.05)
    page = (out / "characterise.html").read_text()
    certificate = (out / "certificate.html").read_text()
    for words in (
        "firmware: 1.6",
        "warm-up: not stated",
        "LoD95",
        "ISO 10360-13",
        "No accreditation",
    ):
        assert words in certificate
    data = json.loads((out / "certificate.json").read_text())
    assert "the mean of 25 recorded frames" in data["answer"]
    assert data["answer"] in certificate.replace("&#39;", "'")
    surfaces = data["surfaces"]
    assert surfaces[0]["temporal_mm"] == pytest.approx(table["measured"].iloc[0], rel=1e-5)
    captures = [row["surface"].split(",")[0] for row in surfaces]
    assert captures == [path.name for path in paths]
    assert "Measured and simulated" in page
    assert "/tmp" not in re.sub(r"<pre>.*?</pre>", "", page, flags=re.DOTALL)


@pytest.mark.usefixtures("unsaved")
def test_edges_and_a_single_distance_without_amplitude(truth, tmp_path, capsys):
    """The gap at a slanted step is found again; what one distance and no amplitude cannot tell is
    said first."""
    slopes = truth.nominal_lens.region_slopes(truth.nominal_lens.whole)
    z_m = np.where(slopes @ [1.0, 0.35] < 0.05, 1.0, 1.25)
    path = recorded(
        tmp_path / "step.npz", truth, z_m, 0.6 / z_m**2, 12, keep=False, frame_jumps=False
    )
    arguments = [
        str(path),
        "--intrinsics",
        str(tmp_path / "lens.json"),
        "--out",
        str(tmp_path / "out"),
        "--rate",
        "15",
    ]
    arguments.append("--certificate")
    assert characterise.main(arguments) == 0
    assert (
        "mean of 12 recorded frames reveals" in (tmp_path / "out" / "certificate.html").read_text()
    )
    printed = capsys.readouterr().out
    assert printed.index("no amplitude is recorded") < printed.index("temporal noise")
    camera = read_camera(tmp_path / "out" / "my_camera.yaml")
    # dropouts near the edge count as gap
    assert camera.edge.gap_px.value == pytest.approx(4.0, rel=0.25)
    assert camera.noise.brightness_exponent.tag == "M"
    assert camera.unit.frames_per_second.value == 15.0
    rows = figures_of(tmp_path / "out").set_index("figure")
    assert rows.loc["gap at an edge", "ratio"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.usefixtures("unsaved")
def test_a_known_camera_s_gain_and_pattern_are_found_again(tmp_path, capsys):
    """A unit of the L515 with other numbers: its gain within 10 %."""
    data = YAML(typ="safe").load(
        (Path(load_camera.__globals__["CAMERA_FOLDER"]) / "realsense_l515.yaml").read_text()
    )
    small = {
        "width_px": 110,
        "height_px": 90,
        "fx_px": 150.0,
        "fy_px": 150.0,
        "cx_px": 55.0,
        "cy_px": 45.0,
    }
    lines = ["name: known", "title: known", "like: realsense_l515", "lens:"]
    lines += [f"  {key}: {{value: {value}, tag: M, source: test}}" for key, value in small.items()]
    known_file = tmp_path / "known.yaml"
    known_file.write_text("\n".join(lines) + "\n")
    gain = 0.5 * data["photons"]["signal_electrons"]["value"]
    ripples = 2.0 * data["fixed_pattern"]["smooth_mm"]["value"]
    other_file = tmp_path / "other.yaml"
    other_file.write_text(
        f"name: other\ntitle: other\nlike: {known_file}\nphotons: {{signal_electrons: {{value: "
        f"{gain}, tag: M, source: test}}}}\nfixed_pattern: {{smooth_mm: {{value: {ripples}, tag: "
        f"M, source: test}}}}\n"
    )
    camera = read_camera(other_file)
    path = recorded(
        tmp_path / "wall.npz", camera, *wall(camera, 1.0, 0.2, (0.6, 0.6)), 16, keep=False
    )
    arguments = [
        str(path),
        "--intrinsics",
        str(tmp_path / "lens.json"),
        "--like",
        str(known_file),
        "--out",
    ]
    assert characterise.main([*arguments, str(tmp_path / "out")]) == 0
    refitted = read_camera(tmp_path / "out" / "my_camera.yaml")
    assert refitted.photons.signal_electrons.value == pytest.approx(gain, rel=0.1)
    assert refitted.photons.signal_electrons.tag == "O"
    assert "wall.npz" in refitted.photons.signal_electrons.source
    noise = figures_of(tmp_path / "out").set_index("figure").loc["temporal noise"]
    assert noise["ratio"] == pytest.approx(1.0, abs=0.05)
    assert noise["known_ratio"] < 0.9


@pytest.mark.slow
def test_real_walls(shared_data, tmp_path, capsys):
    arguments = [
        str(shared_data / "azure_nfov_walls"),
        "--intrinsics",
        "azure_kinect_nfov",
        "--out",
        str(tmp_path),
    ]
    for like_options in ([], ["--like", "azure_kinect_nfov"]):
        assert characterise.main([*arguments, *like_options]) == 0
        rows = figures_of(tmp_path)
        noise = rows[rows["figure"] == "temporal noise"]
        assert len(noise) == 2
        assert noise["ratio"].between(0.85, 1.15).all()
        shape = rows[
            rows["figure"].isin(["plane-fit rms, one frame", "plane-fit rms, average", "fill rate"])
        ]
        assert len(shape) == 6
        assert shape["ratio"].between(0.9, 1.1).all()
    assert "the surface's shape cannot be separated" in capsys.readouterr().out
    emitter = read_camera(tmp_path / "my_camera.yaml").emitter
    assert (
        emitter.mask_slopes.tag == "O" and len(emitter.mask_slopes.value) > 6
    )  # the wall's corner lies outside six


def test_bad_input_is_one_message(tmp_path, capsys):
    equal = np.full((8, 60, 80), 900, np.uint16)
    np.savez(tmp_path / "equal.npz", depth=equal)
    np.savez(tmp_path / "short.npz", depth=equal[:2])
    (tmp_path / "lens.json").write_text('{"fx": 90, "fy": 90, "cx": 40, "cy": 30}')
    lens = ["--intrinsics", str(tmp_path / "lens.json"), "--out", str(tmp_path / "out")]
    for name, options, message in (
        ("equal.npz", [], "all frames are equal"),
        ("short.npz", [], "2 frames: too few to measure temporal noise"),
        ("equal.npz", ["--albedo", "0"], "--albedo 0"),
        ("equal.npz", ["--rate", "-1"], "--rate -1"),
        ("equal.npz", ["--about", "firmware=1"], "need --certificate"),
        ("equal.npz", ["--certificate", "--about", "firmware"], "is not KEY=TEXT"),
        ("none.npz", [], "no such file"),
    ):
        assert characterise.main([str(tmp_path / name), *lens, *options]) == 2
        assert message in capsys.readouterr().err
    assert characterise.main([str(tmp_path / "equal.npz")] * 2 + lens) == 2
    assert "is named twice" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
