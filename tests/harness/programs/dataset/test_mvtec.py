"""``tofpod score`` on a small data set in the layout of MVTec 3D-AD, which the tests write."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.ndimage import label

from harness.evaluation.study.record import read_record
from harness.programs.dataset import score
from harness.programs.dataset.mvtec import MvtecSet
from harness.vocabulary.errors import UserError

HEIGHT = 60
WIDTH = 80
ACROSS_M = 0.0005
DOWN_M = 0.0004
GOOD = 12
"""Good pictures of validation, and of test."""
DEFECTIVE = 16
RADII_PX = (2, 3, 4, 5, 6, 7, 8, 9)


def written(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


def points() -> np.ndarray:
    """A flat object at 0.5 m with noise, and a missing corner."""
    v, u = np.indices((HEIGHT, WIDTH))
    z_m = 0.5 + np.random.default_rng(1).normal(0, 0.001, v.shape)
    xyz_m = np.stack([u * ACROSS_M, v * DOWN_M, z_m], axis=-1)
    xyz_m[:9, :9] = 0
    return xyz_m.astype(np.float32)


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``set``, and ``maps`` on which larger defects are found and smaller ones are not."""
    home = tmp_path_factory.mktemp("mvtec")
    rng = np.random.default_rng(2)
    names = [f"cookie/validation/good/{number:03d}" for number in range(GOOD)]
    names += [f"cookie/test/good/{number:03d}" for number in range(GOOD)]
    names += [f"cookie/test/crack/{number:03d}" for number in range(DEFECTIVE)]
    for name in names:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        strength = np.zeros(mask.shape)
        if "crack" in name:
            number = int(name[-3:])
            for column, radius in ((20, RADII_PX[number % 8]), (58, RADII_PX[(number + 3) % 8])):
                v, u = np.indices(mask.shape)
                disc = (v - 30) ** 2 + (u - column) ** 2 <= radius**2
                mask[disc] = 255
                mask[31, 23] = 255  # touches the disc of 2 px at a corner
                strength[disc] = 1.2 * (radius - 3.2) + rng.normal(0, 1.5)
        folder_name, _, number_text = name.rpartition("/")
        written(home / "set" / folder_name / "xyz" / f"{number_text}.tiff", points()[..., ::-1])
        if "validation" not in name:
            written(home / "set" / folder_name / "gt" / f"{number_text}.png", mask)
        noise = np.round(rng.normal(0, 1, mask.shape) + strength, 1)
        written(home / "maps" / f"{name}.tiff", noise.astype(np.float32))
    return home


def map_of(home: Path, name: str) -> np.ndarray:
    return cv2.imread(str(home / "maps" / f"{name}.tiff"), cv2.IMREAD_UNCHANGED)


def mask_of(home: Path, name: str) -> np.ndarray:
    folder_name, _, number = name.rpartition("/")
    return cv2.imread(
        str(home / "set" / folder_name / "gt" / f"{number}.png"), cv2.IMREAD_UNCHANGED
    )


def judged_names(home: Path) -> list[str]:
    paths = sorted((home / "maps" / "cookie" / "test").rglob("*.tiff"))
    return [path.relative_to(home / "maps").with_suffix("").as_posix() for path in paths]


def run(home: Path, out: Path, *arguments: str) -> int:
    return score.main(
        [str(home / "maps"), "--dataset", str(home / "set"), "--out", str(out), *arguments]
    )


def plain_au_pro(maps: list[np.ndarray], masks: list[np.ndarray], limit: float) -> float:
    """The definition of MVTec's code: mean overlap of all regions against the share of false
    pixels, threshold by threshold."""
    flat = np.concatenate([scores.ravel() for scores in maps])
    intact = np.concatenate([mask.ravel() == 0 for mask in masks])
    regions = []
    for scores, mask in zip(maps, masks, strict=True):
        numbered, count = label(mask > 0, structure=np.ones((3, 3)))
        regions += [np.sort(scores[numbered == number]) for number in range(1, count + 1)]
    across = [0.0]
    up = [0.0]
    for threshold in np.unique(flat)[::-1]:
        across.append(float((flat[intact] >= threshold).mean()))
        overlaps = [(region >= threshold).mean() for region in regions]
        up.append(float(np.mean(overlaps)))
    fine = np.linspace(0, limit, 100_001)
    return float(np.interp(fine, across, up).mean())


@pytest.fixture(scope="module")
def scored(home: Path) -> Path:
    """The results."""
    assert run(home, home / "out", "--name", "mine") == 0
    return home / "out"


def test_its_own_metrics_are_those_of_their_definitions(home: Path, scored: Path):
    from sklearn.metrics import roc_auc_score

    maps = [map_of(home, name) for name in judged_names(home)]
    masks = [mask_of(home, name) for name in judged_names(home)]
    row = pd.read_csv(scored / "scores.csv").iloc[0]
    damaged = np.concatenate([mask.ravel() > 0 for mask in masks])
    flat = np.concatenate([scores.ravel() for scores in maps])
    assert row["pixel_auroc"] == pytest.approx(roc_auc_score(damaged, flat), abs=2e-6)
    flawed = ["crack" in name for name in judged_names(home)]
    highest = [scores.max() for scores in maps]
    assert row["board_auroc"] == pytest.approx(roc_auc_score(flawed, highest), abs=2e-6)
    assert row["au_pro"] == pytest.approx(plain_au_pro(maps, masks, 0.3), abs=1e-4)


def test_sizes_are_those_of_circles_by_the_spacing_of_points(home: Path):
    data = MvtecSet(home / "set")
    _, damages = data.damages("cookie/test/crack/000")
    mask = mask_of(home, "cookie/test/crack/000")
    expected_mm = 1000 * np.sqrt(4 * (mask[:, :40] > 0).sum() * ACROSS_M * DOWN_M / np.pi)
    leftmost = min(damages, key=lambda damage: damage["x_board_mm"])
    assert leftmost["diameter_mm"] == pytest.approx(expected_mm, rel=1e-3)
    rows, columns = np.nonzero(mask[:, :40])
    centre_m = [columns.mean() * ACROSS_M, rows.mean() * DOWN_M]
    assert leftmost["line_m"][0] == pytest.approx(centre_m, rel=1e-3)
    assert len(damages) == 2


def test_the_limit_is_that_of_regions_above_a_threshold_of_good_pictures(home: Path, scored: Path):
    (record,) = read_record(scored).set_ups
    assert record.detector == "mine"
    quiet = [map_of(home, f"cookie/validation/good/{k:03d}").max() for k in range(GOOD)]
    assert record.threshold == max(quiet)  # a new picture exceeds it with probability 1 / 13
    inspected = record.inspected
    for name in judged_names(home):
        above = map_of(home, name) > record.threshold
        number = MvtecSet(home / "set").damages(name)[0]
        numbered, _ = label(mask_of(home, name) > 0, structure=np.ones((3, 3)))
        rows = np.flatnonzero(inspected.board == number)
        for row in rows:
            is_hit = above[numbered == int(inspected.hole[row])].any()
            assert inspected.hit[row] == is_hit, name
    limits = pd.read_csv(scored / "limits.csv").iloc[0]
    sizes_mm = np.sort(inspected.diameter_mm)
    assert sizes_mm[0] < limits["a90_mm"] < sizes_mm[-1]
    assert record.unflawed.area_m2[0] == pytest.approx(HEIGHT * WIDTH * ACROSS_M * DOWN_M, rel=1e-3)


def test_without_maps_of_validation_the_good_pictures_of_test_set_the_threshold(home: Path):
    data = MvtecSet(home / "set")
    names = judged_names(home)
    assert data.wanted(set(names)) == set(names)
    assert data.quiet_split("cookie", names) == "test"
    quiet = [f"cookie/validation/good/{k:03d}" for k in range(GOOD)]
    assert data.wanted({*names, quiet[0]}) == {*names, *quiet}
    assert data.quiet_split("cookie", [*names, *quiet]) == "validation"


def test_mistakes_are_named(home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    copy = tmp_path / "home"
    shutil.copytree(home, copy)
    (copy / "maps" / "cookie" / "test" / "crack" / "003.tiff").unlink()
    assert run(copy, tmp_path / "out") == 2
    assert "1 maps are missing: cookie/test/crack/003" in capsys.readouterr().err
    in_mm = points()[..., ::-1] * 1000
    written(copy / "set" / "cookie" / "test" / "crack" / "xyz" / "001.tiff", in_mm)
    with pytest.raises(UserError, match=r"neighbouring pixels are 0\.5 and 0\.4 m apart"):
        MvtecSet(copy / "set").damages("cookie/test/crack/001")
    (copy / "set" / "cookie" / "test" / "crack" / "gt" / "002.png").unlink()
    with pytest.raises(UserError, match=r"gt/002\.png: cannot be read"):
        MvtecSet(copy / "set").damages("cookie/test/crack/002")
