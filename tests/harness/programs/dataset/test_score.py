"""``tofpod score``: limits, AU-PRO and AUROC of given anomaly maps; wrong sets of maps are
refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from harness.evaluation.study.record import read_record
from harness.programs.dataset import score
from harness.programs.gate import compare
from tests.support.tiny_dataset import arrays_of, names_in, truth_of

RATE = ("--false-calls-per-m2", "100")


@pytest.fixture
def folder(dataset_home: Path) -> Path:
    return dataset_home / "set"


@pytest.fixture
def maps(folder: Path, tmp_path: Path) -> Path:
    """Maps of noise, in which damage stands out on some of its pixels; one map is a TIFF, the
    others are arrays."""
    rng = np.random.default_rng(1)
    out = tmp_path / "maps"
    for name in sorted(names_in(folder)):
        damage = arrays_of(folder, name)["damage"]
        path = out / name
        noise = np.round(rng.normal(size=damage.shape), 2) + 6.0 * (damage > 0) * (
            rng.random(damage.shape) < 0.7
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("through/0003"):
            path.with_suffix(".tiff").write_bytes(
                cv2.imencode(".tiff", noise.astype(np.float32))[1].tobytes()
            )
        elif "/train/" not in name:
            np.save(path.with_suffix(".npy"), noise)
    return out


def run(maps: Path, folder: Path, out: Path, *arguments: str) -> int:
    return score.main([str(maps), "--dataset", str(folder), "--out", str(out), *arguments])


def map_of(maps: Path, name: str) -> np.ndarray:
    path = maps / f"{name}.npy"
    return (
        np.load(path)
        if path.exists()
        else cv2.imread(str(maps / f"{name}.tiff"), cv2.IMREAD_UNCHANGED)
    )


def test_areas_are_those_of_scikit_learn(folder, maps, tmp_path):
    from sklearn.metrics import auc, roc_auc_score, roc_curve

    assert run(maps, folder, tmp_path / "out", *RATE) == 0
    scores = []
    damaged = []
    weights = []
    boards = []
    for name in (name for name in names_in(folder) if "/test/" in name):
        arrays = arrays_of(folder, name)
        board_map = map_of(maps, name)
        inspected = arrays["inspected"]
        damage = arrays["damage"][inspected]
        scores.append(board_map[inspected])
        damaged.append(damage > 0)
        counts = np.bincount(damage)
        weights.append(np.where(damage > 0, 1.0 / counts[damage], 1.0))
        boards.append((board_map[inspected].max(), "/good/" not in name))
    flat = np.concatenate(scores)
    truth = np.concatenate(damaged)
    row = pd.read_csv(tmp_path / "out" / "scores.csv").iloc[0]
    assert row["pixel_auroc"] == pytest.approx(roc_auc_score(truth, flat), abs=2e-6)
    assert row["board_auroc"] == pytest.approx(
        roc_auc_score([d for _, d in boards], [s for s, _ in boards]), abs=2e-6
    )
    across, up, _ = roc_curve(
        truth, flat, sample_weight=np.concatenate(weights), drop_intermediate=False
    )
    fine = np.linspace(0, 0.3, 300_001)
    assert row["au_pro"] == pytest.approx(auc(fine, np.interp(fine, across, up)) / 0.3, abs=1e-5)


def test_a_hit_is_a_finding_above_the_threshold_of_the_good_boards(folder, maps, tmp_path):
    assert run(maps, folder, tmp_path / "out", *RATE, "--name", "noise") == 0
    record = read_record(tmp_path / "out").set_ups[0]
    quiet = [
        map_of(maps, name)[arrays_of(folder, name)["inspected"]].max()
        for name in names_in(folder)
        if "/validation/" in name
    ]
    assert record.threshold in quiet
    assert record.calibration_runs == 2
    assert record.detector == "noise"
    assert (
        len(record.inspected.hit) == 8 and record.inspected.hit.all()
    )  # six deviations over a threshold of some four
    truth = truth_of(folder, "tiny/test/through/0000")["damages"]
    assert record.inspected.diameter_mm[:2].tolist() == [flaw["diameter_mm"] for flaw in truth]
    assert record.unflawed.area_m2[0] == pytest.approx(0.13 * 0.09 * 0.83, rel=0.05)
    assert compare.main([str(tmp_path / "out"), str(tmp_path / "out")]) == 0


def test_a_higher_rate_of_false_calls_lowers_the_threshold_and_too_few_boards_are_told(
    folder, maps, tmp_path, capsys
):
    thresholds = []
    for rate in (100, 400):
        assert run(maps, folder, tmp_path / "out", "--false-calls-per-m2", str(rate)) == 0
        thresholds.append(read_record(tmp_path / "out").set_ups[0].threshold)
    assert thresholds[1] < thresholds[0]
    assert run(maps, folder, tmp_path / "out", "--false-calls-per-m2", "1") == 2
    assert "2 hole-free runs" in capsys.readouterr().err


def test_wrong_sets_of_maps_are_refused_at_once(folder, maps, tmp_path, capsys):
    (maps / "tiny/test/good/0000.npy").unlink()
    np.save(maps / "tiny/test/good/0009.npy", np.zeros((3, 3)))
    np.save(maps / "tiny/test/through/0000.npy", np.zeros((3, 4)))
    np.save(
        maps / "tiny/test/through/0001.npy",
        np.full(map_of(maps, "tiny/test/through/0001").shape, np.nan),
    )
    (maps / "tiny/test/through/0002.npy").write_bytes(b"no array")
    assert run(maps, folder, tmp_path / "out", *RATE) == 2
    message = capsys.readouterr().err
    assert "1 maps are missing: tiny/test/good/0000" in message
    assert "1 maps are not for a board of validation or test: tiny/test/good/0009" in message
    assert "0000 (3 x 4 instead of" in message
    assert "0001 (no finite number at" in message
    assert "0002 (cannot be read as an array of numbers)" in message
    assert not (tmp_path / "out").exists()


def test_an_unfinished_data_set_is_refused(folder, maps, tmp_path, capsys):
    shutil.copytree(folder, tmp_path / "set")
    index = json.loads((tmp_path / "set" / "dataset.json").read_text())
    (tmp_path / "set" / "dataset.json").write_text(json.dumps({**index, "samples": None}))
    assert run(maps, tmp_path / "set", tmp_path / "out") == 2
    assert "is not finished" in capsys.readouterr().err
