"""Detectors from other libraries: the contract, each library's numbers against their formulas,
references, memories."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.distance import cdist

from detectors import load_detector
from detectors.interface import Calibratable, Detector
from detectors.methods.peers import FpfhMemoryConfig, FpfhMemoryDetector, coreset, nearest
from harness.programs.keeping.ls import main as ls
from harness.testing import check_detector
from harness.testing.synthetic_clouds import plane, with_gaps
from harness.vocabulary import extras
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, Region

WHOLE = {"crop": {"kind": "none"}}


def part(cloud: Cloud, rows: slice, columns: slice) -> Cloud:
    """A rectangle of a cloud."""
    cut = {
        name: getattr(cloud, name)[rows, columns]
        for name in ("points_m", "reason", "count", "variance_m2")
    }
    return replace(
        cloud,
        region=Region(rows.start, rows.stop, columns.start, columns.stop),
        **cut,
    )


def undamaged(seed: int) -> Cloud:
    """The lower left of a plane, where no damage is."""
    return part(plane(seed), slice(50, 90), slice(0, 60))


@lru_cache(maxsize=1)
def learned() -> FpfhMemoryDetector:
    """The memory of three undamaged planes; features of fewer neighbours than usual take a third
    of the time."""
    blank = FpfhMemoryDetector(
        FpfhMemoryConfig.from_data({**WHOLE, "feature_neighbours": 40, "memory": 60})
    )
    detections = blank.calibrated(blank.calibrate([undamaged(seed) for seed in (11, 12, 13)]))
    assert isinstance(detections, FpfhMemoryDetector)
    return detections


def made(name: str, **settings: Any) -> Detector:
    return learned() if name == "fpfh_memory" else load_detector(name, {**WHOLE, **settings})


@pytest.mark.parametrize(
    "name",
    [
        "plane_ransac",
        "m3c2",
        pytest.param("fpfh_memory", marks=pytest.mark.slow),
    ],
)
def test_they_keep_the_contract(name: str) -> None:
    """On a part of a plane with a hole of 20 mm, some of whose pixels have no range."""
    cloud = part(with_gaps(plane(3), seed=4), slice(10, 50), slice(10, 50))
    check_detector(lambda: made(name), clouds=[cloud])


@pytest.mark.parametrize("name", ["plane_ransac", "m3c2", "fpfh_memory"])
def test_they_find_dents_and_nothing_else(name: str) -> None:
    """Two dents 6 mm deep and 12 mm wide at half their depth; the threshold is well above an
    undamaged plane."""
    quiet = undamaged(14)
    detector = made(name)
    threshold = 1.3 * detector.quiet_threshold(quiet, detector.analyse(quiet))
    centres = quiet.points_m[[12, 26], [14, 42]][:, :2]
    apart_m = np.linalg.norm(quiet.points_m[..., None, :2] - centres, axis=-1)
    dents = 6e-3 * np.exp(-0.5 * (apart_m / 5e-3) ** 2).sum(axis=-1)
    cloud = replace(quiet, points_m=quiet.points_m + dents[..., None] * [0.0, 0.0, 1.0])
    detections = detector.find(cloud, detector.analyse(cloud), threshold)
    found_centres = np.array(sorted(detection.centre_m[:2].tolist() for detection in detections))
    assert found_centres.shape == (2, 2)
    assert np.abs(found_centres - centres).max() < 3e-3


def test_a_rim_and_what_lies_deep_behind_it_are_one_finding_of_m3c2_and_none_of_fpfh() -> None:
    """A hole whose floor lies 35 mm behind the face, with nothing in between; findings are joined
    over 10 mm. The features of some millimetres see two flat surfaces, as is said of them."""
    quiet = undamaged(18)
    detector = made("m3c2")
    apart_m = np.linalg.norm(quiet.points_m[..., :2] - quiet.points_m[20, 30, :2], axis=-1)
    cloud = replace(quiet, points_m=quiet.points_m * np.where(apart_m < 9e-3, 1.05, 1.0)[..., None])
    threshold = 1.3 * detector.quiet_threshold(quiet, detector.analyse(quiet))
    assert len(detector.find(cloud, detector.analyse(cloud), threshold)) == 1
    flat = learned().quiet_threshold(quiet, learned().analyse(quiet))
    assert learned().quiet_threshold(cloud, learned().analyse(cloud)) < 1.3 * flat


# ---------------------------------------------------------------- plane_ransac


def test_a_plane_is_that_of_its_supporting_points() -> None:
    evidence = load_detector("plane_ransac", WHOLE).analyse(plane(1, tilt=0.2))
    x = plane(1).points_m[..., 0]
    y = plane(1).points_m[..., 1]
    z = evidence.surface_z_m
    slope_x, slope_y, level = np.linalg.lstsq(
        np.stack([x.ravel(), y.ravel(), np.ones(x.size)], 1),
        z.ravel(),
        rcond=None,
    )[0]
    assert abs(slope_x - 0.2) < 1e-3
    assert abs(slope_y) < 1e-3
    assert abs(level - 0.7) < 1e-4
    # some 8 % of the pixels are damaged: the deviation of the rest, a little more
    assert 3.0e-4 < evidence.scale_m < 3.6e-4


def test_points_on_a_line_determine_no_plane() -> None:
    row = part(plane(1, tilt=0.0), slice(44, 45), slice(0, 120))
    line = replace(row, points_m=row.points_m * [1.0, 0.0, 0.0] + [0.0, 0.0, 0.7])
    with pytest.raises(UserError, match="no plane"):
        load_detector("plane_ransac", WHOLE).analyse(line)


# ---------------------------------------------------------------- m3c2


def test_m3c2_is_the_formula_of_its_paper() -> None:
    """Beside means and standard deviations over cylinders that are counted out, at places off and
    on a rim."""
    cloud = plane(1, tilt=0.0)
    settings = {"surface": {"shape": "polynomial", "degree": 1}, "registration_error_mm": 0.2}
    evidence = made("m3c2", **settings).analyse(cloud)
    points = cloud.points_m.reshape(-1, 3)
    surface = evidence.surface_z_m.ravel()
    for row, column in ((45, 60), (20, 31), (37, 20), (59, 81)):
        pixel = row * 120 + column
        vicinity = np.hypot(*(points[:, :2] - points[pixel, :2]).T) < 4e-3
        behind_m = points[vicinity, 2] - surface[vicinity]
        error_m = behind_m.std(ddof=1) / np.sqrt(vicinity.sum()) + 2e-4
        # the plane's normal is the optical axis to a thousandth
        assert evidence.score.ravel()[pixel] == pytest.approx(
            abs(behind_m.mean()) / error_m,
            rel=0.03,
            abs=0.02,
        )


def test_without_a_registration_error_the_targets_own_scatter_counts() -> None:
    """Half a millimetre of waviness that neighbours share is no finding, as it is everywhere."""
    cloud = undamaged(15)
    wave = 5e-4 * np.sin(np.arange(40) / 3.0)[:, None] * np.sin(np.arange(60) / 3.0)
    wavy = replace(cloud, points_m=cloud.points_m + np.stack([0 * wave, 0 * wave, wave], axis=-1))
    flat = {"surface": {"shape": "polynomial", "degree": 1}}
    scores = [
        made("m3c2", **flat, **error).analyse(wavy).score
        for error in ({}, {"registration_error_mm": 0.0})
    ]
    assert np.nanmax(scores[0]) < 5 < 10 < np.nanmax(scores[1])


def test_a_reference_scan_of_any_shape(tmp_path: Path) -> None:
    """A step of 20 mm, which no fitted surface follows, with a dent that only the later scan has;
    then the whole moved by 3 mm, which is said."""
    before = plane(5)
    after = plane(6)
    flawless = before.points_m[50:90, 0:60]
    step = np.array([0.0, 0.0, 0.02])
    path = tmp_path / "before.npy"
    stepped = flawless + step * (np.arange(60) >= 30)[None, :, None]
    np.save(path, stepped)
    dent = np.zeros((40, 60, 3))
    dent[12:20, 10:18, 2] = 2e-3
    again = after.points_m[50:90, 0:60] + step * (np.arange(60) >= 30)[None, :, None] + dent
    detector = load_detector("m3c2", {**WHOLE, "reference": str(path)})
    cloud = replace(part(after, slice(50, 90), slice(0, 60)), points_m=again)
    evidence = detector.analyse(cloud)
    best = np.unravel_index(
        int(np.nanargmax(np.where(np.abs(np.arange(60) - 30) > 5, evidence.score, np.nan))),
        (40, 60),
    )
    assert 11 <= best[0] <= 20
    assert 9 <= best[1] <= 18
    assert evidence.warnings == ()
    of_map = detector.analyse(replace(cloud, projection="parallel", lens=None))
    for detection in (evidence, of_map):
        assert np.nanmedian(detection.residual_m[13:19, 11:17]) == pytest.approx(2e-3, abs=2e-4)
    moved = detector.analyse(replace(cloud, points_m=again + np.array([0.0, 0.0, 3e-3])))
    assert "3 mm off its reference scan" in moved.warnings[0]
    np.save(path, stepped[:, :45])
    partly = load_detector("m3c2", {**WHOLE, "reference": str(path)}).analyse(cloud)
    assert "of the target has no counterpart in reference scan" in partly.warnings[0]
    np.save(path, stepped + np.array([1.0, 0.0, 0.0]))
    with pytest.raises(UserError, match="no point of the target has 4 neighbours"):
        load_detector("m3c2", {**WHOLE, "reference": str(path)}).analyse(cloud)
    with pytest.raises(UserError, match="no such file"):
        load_detector("m3c2", {**WHOLE, "reference": str(tmp_path / "gone.npy")}).analyse(cloud)


def test_the_library_neither_prints_nor_writes_nor_sets_threads(
    monkeypatch,
    tmp_path,
    capfd,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    load_detector("m3c2", WHOLE).analyse(undamaged(16))
    assert capfd.readouterr() == ("", "")
    assert not list(tmp_path.iterdir())
    assert "OMP_NUM_THREADS" not in os.environ


def test_a_missing_package_is_told_with_the_command_that_installs_it(monkeypatch, capsys) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda package: None)
    with pytest.raises(UserError, match="needs the package py4dgeo") as caught:
        load_detector("m3c2", {})
    assert caught.value.fix == "pip install 'tofpod[peers]'"
    assert ls(["detectors"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "m3c2" in line]
    assert "needs the package py4dgeo" in row
    assert "tofpod[peers]" in row


# ---------------------------------------------------------------- fpfh_memory


def test_features_are_averaged_over_one_pixel_at_least() -> None:
    assert FpfhMemoryConfig.from_data({**WHOLE, "pool_px": 1}).pool_px == 1
    with pytest.raises(ValidationError, match="pool_px"):
        FpfhMemoryConfig.from_data({**WHOLE, "pool_px": 0})


def test_without_a_memory_nothing_is_judged() -> None:
    blank = load_detector("fpfh_memory", WHOLE)
    assert isinstance(blank, Calibratable)
    with pytest.raises(UserError, match="no memory of hole-free targets"):
        blank.analyse(undamaged(1))
    with pytest.raises(UserError, match="two hole-free clouds"):
        blank.calibrate([undamaged(1)])
    with pytest.raises(UserError, match="too few"):
        blank.calibrate([part(plane(1), slice(50, 58), slice(0, 10))] * 2)


def test_what_was_learned_is_plain_arrays_that_give_the_same_scores() -> None:
    detector = FpfhMemoryDetector(learned().settings)
    arrays = detector.calibrate([undamaged(seed) for seed in (11, 12, 13)])
    assert arrays["memory"].shape == (60, 33)
    assert arrays["unit"].shape == ()
    scores = [
        detection.analyse(undamaged(17)).score
        for detection in (learned(), detector.calibrated(dict(arrays)))
    ]
    np.testing.assert_array_equal(*scores)
    # the memory has not seen this plane either
    assert 0.8 < np.median(scores[0]) < 1.25


def test_the_nearest_and_the_farthest() -> None:
    rng = np.random.default_rng(3)
    features = rng.standard_normal((300, 5)) + 100.0
    taken = coreset(features, 20)
    np.testing.assert_allclose(
        nearest(features, taken),
        cdist(features, taken).min(axis=1),
        atol=1e-5,
    )
    # each is as far from those before it as any feature is
    for count in range(1, 20):
        from_dents_m = cdist(features, taken[:count]).min(axis=1)
        assert cdist(taken[count : count + 1], taken[:count]).min() == pytest.approx(
            from_dents_m.max()
        )
    assert len(coreset(np.repeat(features[:4], 3, axis=0), 20)) == 4
