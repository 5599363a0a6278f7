"""`tofpod characterise --spheres`: tables and page of spheres in a capture; what cannot be
measured."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.programs.camera import characterise
from harness.programs.camera.spheres import SphereRow, spacings
from harness.stills.spheres import SphereFit, fit_sphere
from harness.vocabulary.geometry import MM
from tests.support.spheres import LENS, sphere_scene

RADIUS_M = 0.0725
CENTRES_M = np.array([[-0.2, 0.05, 1.0], [0.25, -0.1, 1.2]])


def recorded(folder: Path, centres_m: np.ndarray, radius_m: float = RADIUS_M) -> list[str]:
    """A capture of three frames in whole millimetres, and the options that read it."""
    frames = []
    for seed in range(3):
        image = sphere_scene(centres_m, radius_m, 2e-3, 0.3, seed)
        z_m = image.range_m * image.rays[..., 2]
        frames.append(np.rint(np.nan_to_num(z_m) / MM).astype(np.uint16))
    np.save(folder / "spheres.npy", np.stack(frames))
    lens = {"fx": LENS.fx, "fy": LENS.fy, "cx": LENS.cx, "cy": LENS.cy}
    (folder / "lens.json").write_text(json.dumps(lens))
    options = ["--intrinsics", str(folder / "lens.json"), "--unit", "mm"]
    return [str(folder / "spheres.npy"), *options, "--out", str(folder / "out")]


def test_spheres_of_a_capture(tmp_path: Path, capsys):
    arguments = recorded(tmp_path, CENTRES_M)
    assert characterise.main([*arguments, "--spheres", "145mm"]) == 0
    assert "2 spheres of 145 mm" in capsys.readouterr().out
    rows = pd.read_csv(tmp_path / "out" / "spheres.csv")
    assert rows[["x_mm", "y_mm", "z_mm"]].to_numpy() == pytest.approx(CENTRES_M / MM, abs=1.5)
    assert (rows.size_low_mm < 0).all()
    assert (rows.size_high_mm > 0).all()
    (pair,) = pd.read_csv(tmp_path / "out" / "spacings.csv").itertuples()
    true_mm = np.linalg.norm(CENTRES_M[1] - CENTRES_M[0]) / MM
    assert pair.measured_low_mm < true_mm < pair.measured_high_mm
    assert pair.measured_high_mm - pair.measured_low_mm < 2
    page = (tmp_path / "out" / "spheres.html").read_text()
    assert "VDI/VDE 2634-2" in page
    stored = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert len(stored["spheres"]) == 2


def test_a_spacing_is_as_uncertain_as_both_centres():
    rows = []
    for number, sigma_m in enumerate((1e-3, 3e-3)):
        image = sphere_scene(CENTRES_M, RADIUS_M, sigma_m, seed=number)
        fit = fit_sphere(image, CENTRES_M[number], RADIUS_M)
        assert isinstance(fit, SphereFit)
        rows.append(SphereRow("capture", number, fit))
    (pair,) = spacings(rows)
    apart_m = rows[1].fit.centre_m - rows[0].fit.centre_m
    direction = apart_m / np.linalg.norm(apart_m)
    variances_m2 = [direction @ row.fit.covariance_m2 @ direction for row in rows]
    half_mm = 1.96 * np.sqrt(sum(variances_m2)) / MM
    assert pair.measured_mm.value == pytest.approx(np.linalg.norm(apart_m) / MM)
    assert pair.measured_mm.high - pair.measured_mm.value == pytest.approx(half_mm, rel=0.02)


@pytest.mark.parametrize(
    ("diameter", "radius_m", "message"),
    [
        ("145", RADIUS_M, "is not a length with a unit"),
        ("145mm", 0.2, "no sphere of 145 mm was found"),
    ],
)
def test_no_sphere_is_no_number(tmp_path: Path, capsys, diameter, radius_m, message):
    arguments = recorded(tmp_path, CENTRES_M, radius_m)
    assert characterise.main([*arguments, "--spheres", diameter]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out" / "spheres.csv").exists()
