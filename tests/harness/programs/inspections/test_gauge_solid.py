"""A solid gauge: its bodies are watertight and hold what the truth says; its files can be read
again; a calliper corrects it."""

from __future__ import annotations

import io
import json
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from harness.programs.inspections import gauge
from harness.programs.inspections.gauge_solid import designed, model_3mf
from harness.stills.solid_body import inlay_of, solid_of
from harness.stills.solid_gauge import SolidGauge, calliper_form, corrected, read_solid_gauge
from harness.vocabulary.errors import UserError


@pytest.fixture(scope="module")
def solid() -> trimesh.Trimesh:
    return solid_of(designed(is_cut=False))


def test_a_printed_gauge_is_one_watertight_body_on_a_usual_bed(solid: trimesh.Trimesh):
    stored = trimesh.load(io.BytesIO(solid.export(file_type="stl")), file_type="stl")
    assert stored.is_volume
    assert stored.body_count == 1
    assert (np.ptp(stored.bounds[:, :2], axis=0) <= 190).all()
    assert inlay_of(designed(is_cut=False)).is_volume


def test_the_body_s_volume_is_that_of_its_elements(solid: trimesh.Trimesh):
    """Plate, steps, posts up to their spheres, and truncated spheres, less pockets, grooves and
    marks: nothing overlaps by mistake. Facets take 0.07 % of circles and 0.2 % of spheres."""
    truth = designed(is_cut=False)
    volume_mm3 = truth.width_mm * truth.height_mm * truth.thickness_mm
    volume_mm3 += sum(step.side_mm**2 * step.height_mm for step in truth.steps)
    post = truth.post_mm / 2
    for ball in truth.spheres:
        radius = ball.diameter_mm / 2
        cap = radius - np.sqrt(radius**2 - post**2)
        volume_mm3 += 4 / 3 * np.pi * radius**3 + np.pi * post**2 * (ball.z_mm - radius + cap)
        volume_mm3 -= np.pi * cap**2 * (radius - cap / 3)
    for pocket in truth.pockets:
        volume_mm3 -= np.pi / 4 * pocket.diameter_mm**2 * pocket.depth_mm
    for groove in truth.grooves:
        straight_mm = groove.length_mm - groove.width_mm
        area_mm2 = np.pi / 4 * groove.width_mm**2 + groove.width_mm * straight_mm
        volume_mm3 -= area_mm2 * groove.depth_mm
    volume_mm3 -= inlay_of(truth).volume
    assert solid.volume == pytest.approx(volume_mm3, rel=8e-4)


def test_the_3mf_has_the_body_and_its_black_marks(solid: trimesh.Trimesh):
    inlay = inlay_of(designed(is_cut=False))
    package = zipfile.ZipFile(io.BytesIO(model_3mf(solid, inlay)))
    model = ET.fromstring(package.read("3D/3dmodel.model"))
    space = "{http://schemas.microsoft.com/3dmanufacturing/core/2015/02}"
    assert model.attrib["unit"] == "millimeter"
    counts = []
    for part in model.iter(f"{space}mesh"):
        corners = [list(map(float, node.attrib.values())) for node in part.iter(f"{space}vertex")]
        faces = [list(map(int, node.attrib.values())) for node in part.iter(f"{space}triangle")]
        counts.append(trimesh.Trimesh(corners, faces, process=False).volume)
    assert counts == pytest.approx([solid.volume, inlay.volume], rel=1e-3)


def test_the_files_of_a_gauge(tmp_path: Path, capsys):
    assert gauge.main(["--cut", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "recessed by 0.6 mm" in printed
    assert "gauge.3mf" not in printed
    body = trimesh.load(tmp_path / "gauge.stl")
    width_mm, height_mm, tallest_mm = np.ptp(body.bounds, axis=0)
    assert f"gauge: {width_mm:g} x {height_mm:g} mm, {tallest_mm:.1f} mm tall: " in printed
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["calliper.csv", "gauge.json", "gauge.stl", "gauge.svg"]
    truth = read_solid_gauge(tmp_path / "gauge.json")
    assert truth == designed(is_cut=True)
    assert truth.width_mm == 270
    assert truth.uncertainty.place_mm < designed(is_cut=False).uncertainty.place_mm


def filled(path: Path, rows: dict[str, str]) -> Path:
    """A form in which these rows, by element and quantity, have a measured size."""
    lines = calliper_form(designed(is_cut=False)).splitlines()
    for number, line in enumerate(lines):
        start = line.removesuffix(",,")
        key = start.rsplit(",", 1)[0]
        if key in rows:
            lines[number] = f"{start},{rows[key]}"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_calliper_corrects_the_truth(tmp_path: Path):
    plain = designed(is_cut=False)
    rows = {
        "plate,width": "179.1,0.05",
        "plate,height": "180,0.02",
        "sphere 2,diameter": "30.2,0.03",
        "sphere 2,top above face": "75.4,0.03",
        "step 8,height": "8.1,0.02",
    }
    better = corrected(plain, filled(tmp_path / "calliper.csv", rows))
    assert better.centres_mm[1] == pytest.approx([29 * 0.995, 74, 75.4 - 15.1])
    assert better.diameters_mm[:2].tolist() == [30, 30.2]
    assert better.steps[4].height_mm == 8.1
    assert better.pockets[0].x_mm == pytest.approx(plain.pockets[0].x_mm * 0.995)
    # both sides of the plate are measured, but not all elements
    assert better.uncertainty.scale == pytest.approx(0.05 / 179.1)
    assert better.uncertainty.place_mm == plain.uncertainty.place_mm
    assert corrected(plain, filled(tmp_path / "empty.csv", {})) == plain


def test_a_calliper_states_the_uncertainty_of_places(tmp_path: Path):
    """A sphere's centre is as uncertain as its top and half of its diameter together."""
    plain = designed(is_cut=False)
    rows = {f"{step.name},height": f"{step.height_mm:g},0.02" for step in plain.steps}
    for ball in plain.spheres:
        rows[f"{ball.name},diameter"] = f"{ball.diameter_mm:g},0.06"
        rows[f"{ball.name},top above face"] = f"{ball.z_mm + 15:g},0.04"
    better = corrected(plain, filled(tmp_path / "calliper.csv", rows))
    assert better.uncertainty.place_mm == pytest.approx(0.05)
    assert better.uncertainty.scale == plain.uncertainty.scale
    rows["step 16,height"] = "16.1,0.2"
    better = corrected(plain, filled(tmp_path / "calliper.csv", rows))
    assert better.uncertainty.place_mm == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"step 8,height": "8.1,"}, "line 20: needs two numbers"),
        ({"step 8,height": "nan,0.1"}, "is far from the nominal 8 mm"),
        ({"step 8,height": "81,0.1"}, "is far from the nominal 8 mm"),
        ({"step 8,height": "8,-1"}, "an uncertainty of -1 mm"),
    ],
)
def test_mistakes_in_the_form_are_explained(tmp_path: Path, row: dict[str, str], message: str):
    with pytest.raises(UserError, match=message):
        corrected(designed(is_cut=False), filled(tmp_path / "calliper.csv", row))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{}", "is not the truth of a solid gauge"),
        ('{"solid_gauge_version": 9}', "version"),
        ('{"solid_gauge_version": 1, "made": "cast"}', "made"),
    ],
)
def test_another_file_is_refused(tmp_path: Path, content: str, message: str):
    path = tmp_path / "gauge.json"
    path.write_text(content)
    with pytest.raises(UserError, match=message):
        read_solid_gauge(path)


def test_the_truth_survives_its_file():
    truth = designed(is_cut=False)
    assert SolidGauge.from_data(json.loads(json.dumps(truth.to_data()))) == truth


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--print", "--diameters", "2:12"], "--diameters belongs to drilled boards"),
        ([], "drilled boards need --diameters"),
    ],
)
def test_a_gauge_is_drilled_or_solid(tmp_path: Path, capsys, options: list[str], message: str):
    assert gauge.main([*options, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
