"""``tofpod score detector`` and ``tofpod score rank`` on a data set of ten small boards."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.programs.dataset import score
from harness.programs.dataset.judged_sets import BoardSet
from harness.programs.dataset.score_detector import cloud_of, detector_of, map_of
from tests.support.tiny_dataset import arrays_of, names_in, truth_of

RATE = ("--false-calls", "100")


@pytest.fixture(scope="module")
def scored(dataset_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scores of the detector `thesis`, and of maps without damage."""
    home = tmp_path_factory.mktemp("leaderboard")
    folder = str(dataset_home / "set")
    maps = str(home / "maps")
    assert score.main(["detector", "thesis", "--dataset", folder, "--out", maps]) == 0
    blind = home / "blind"
    rng = np.random.default_rng(1)
    for path in sorted(Path(maps).rglob("*.npy")):
        target = blind / path.relative_to(maps)
        target.parent.mkdir(parents=True, exist_ok=True)
        np.save(target, rng.random(np.load(path).shape))
    for name, maps_folder in (("thesis", maps), ("blind", str(blind))):
        out = str(home / name)
        assert (
            score.main([maps_folder, "--dataset", folder, "--name", name, "--out", out, *RATE]) == 0
        )
    return home


def test_maps_are_a_detectors_scores_on_the_stored_clouds(dataset_home: Path, scored: Path):
    folder = dataset_home / "set"
    name = next(name for name in names_in(folder) if "/test/through/" in name)
    stored = np.load(scored / "maps" / f"{name}.npy")
    cloud = cloud_of(folder, name)
    assert cloud.n_frames == truth_of(folder, name)["frames_used"]
    assert np.isfinite(stored).all()
    arrays = arrays_of(folder, name)
    on_damage = stored[arrays["damage"] > 0]
    beside = stored[arrays["inspected"] & (arrays["damage"] == 0)]
    assert np.median(on_damage) > 5 * np.median(beside)
    detector = detector_of("thesis", [], folder)
    assert np.array_equal(stored, map_of(detector, cloud))


def test_a_detector_that_learns_does_so_on_train(dataset_home: Path):
    folder = dataset_home / "set"
    (category,) = BoardSet(folder).categories
    learning = BoardSet(folder).learning(category)
    assert learning and all("/train/good/" in name for name in learning)


def test_the_smallest_a90_comes_first(scored: Path, tmp_path: Path):
    folders = [str(scored / "blind"), str(scored / "thesis")]
    assert score.main(["rank", *folders, "--out", str(tmp_path)]) == 0
    rows = pd.read_csv(tmp_path / "leaderboard.csv")
    assert rows["method"].tolist() == ["thesis", "blind"]
    assert rows["rank"].tolist() == [1, 2]
    assert rows["au_pro"][0] > 0.9 > rows["au_pro"][1]
    page = (tmp_path / "leaderboard.html").read_text().replace("\xa0", " ")
    a90_mm = f"≤ {rows['a90_mm'][0]:.2f}"
    assert f"thesis finds the smallest damage nine times out of ten: {a90_mm} mm." in page
    assert "tofpod score detector NAME" in page


def test_methods_on_other_boards_or_of_one_name_are_refused(
    scored: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    shutil.copytree(scored / "thesis", tmp_path / "again")
    assert score.main(["rank", str(scored / "thesis"), str(tmp_path / "again")]) == 2
    assert "a second method called 'thesis'" in capsys.readouterr().err
    file = tmp_path / "again" / "study.json"
    text = file.read_text()
    start = text.index('"frames_digest": "') + len('"frames_digest": "')
    file.write_text(text[:start] + "0" + text[start + 1 :].replace('"thesis"', '"other"'))
    assert score.main(["rank", str(scored / "blind"), str(tmp_path / "again")]) == 2
    assert "show other boards of tiny" in capsys.readouterr().err
