"""``tofpod train``: a network from tiny boards, the same one again, and a sweep that uses it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from detectors.methods.learned import LearnedConfig, LearnedDetector
from detectors.methods.network import read_network
from harness.experiment.load import load_experiment
from harness.programs.train import train
from harness.programs.train.pictures import (
    DAMAGE_PIXELS,
    LabelledPicture,
    boards_of,
    example_of,
    pictures_of_board,
    prior_of,
)
from harness.runs.plan import plan_of
from tests.support.tiny_dataset import BOARDS
from tests.support.tiny_sweep import results, sweep

FAMILY = f"""\
{BOARDS}detector:
  name: learned
  settings: {{crop: {{kind: auto, inset_px: 4}}}}
threshold: {{calibrate: {{boards: 2, false_calls_per_m2: 100.0}}}}
study: {{boards: 3, hole_free_boards: 1, units: 2}}
"""


def train_tiny(home: Path, name: str, *arguments: str) -> int:
    (home / "tiny.yaml").write_text(FAMILY)
    common = ["--results", str(home / "out"), "--serial", "--channels", "4", "--passes", "3"]
    return train.main([str(home / "tiny.yaml"), "--out", str(home / name), *common, *arguments])


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("train")
    assert train_tiny(folder, "a.npz") == 0
    return folder


@pytest.fixture(scope="module")
def pictures(home: Path) -> list[LabelledPicture]:
    plan = plan_of(load_experiment(home / "tiny.yaml"), home / "out" / ".cache" / "renders")
    boards = boards_of(plan)
    return [picture for board in boards for picture in pictures_of_board(board)]


def test_the_same_command_gives_the_same_file_and_another_seed_another(home):
    assert train_tiny(home, "b.npz") == 0
    first = read_network(home / "a.npz")
    again = read_network(home / "b.npz")
    for layer, repeated in zip(first.layers, again.layers, strict=True):
        np.testing.assert_array_equal(layer.weights, repeated.weights)
        np.testing.assert_array_equal(layer.bias, repeated.bias)
    assert {**first.facts, "provenance": 0} == {**again.facts, "provenance": 0}
    assert train_tiny(home, "c.npz", "--set", "seed=4") == 0
    with_other_seed = read_network(home / "c.npz")
    assert with_other_seed.facts["content"] != first.facts["content"]
    assert not np.array_equal(with_other_seed.layers[0].weights, first.layers[0].weights)


def test_the_file_says_what_it_was_trained_on(home):
    facts = read_network(home / "a.npz").facts
    assert facts["experiment"] == "tiny"
    assert facts["digest"] == load_experiment(home / "tiny.yaml").digest
    assert facts["cameras"] == ["azure_kinect_nfov"]
    assert facts["frames"] == [20]
    assert facts["seeds"] == {"noise": 3, "boards": 1, "unit": 1}
    assert facts["pictures"] == 6
    assert np.isfinite(facts["losses"]).all()
    assert np.shape(facts["losses"]) == (3, 1)


def test_pictures_show_each_board_before_each_unit_with_its_damage(pictures):
    assert [picture.board for picture in pictures] == [0, 0, 1, 1, 2, 2]
    assert not np.array_equal(pictures[0].whitened, pictures[1].whitened)
    assert pictures[0].damage.sum() == pytest.approx(pictures[1].damage.sum(), abs=2)
    for picture in pictures:
        on_damage = picture.weights[picture.damage]
        assert on_damage.sum() == pytest.approx(2 * DAMAGE_PIXELS, rel=1e-5)
        assert np.median(picture.whitened[picture.damage]) > 1.0
        ring = (picture.weights == 0) & picture.is_known
        assert ring.any()
        assert not (ring & picture.damage).any()
        assert (picture.weights[~picture.is_known] == 0).all()


def test_the_prior_counts_every_picture_with_both_signs(pictures):
    on_damage = len(pictures) * 2 * DAMAGE_PIXELS
    total = sum(float(picture.weights.sum()) for picture in pictures)
    share = on_damage / (2 * total)
    assert prior_of(pictures) == pytest.approx(np.log(share / (1 - share)), rel=1e-5)


def test_with_the_sign_reversed_there_is_no_damage(pictures):
    behind = example_of(pictures[0], 1.0)
    before = example_of(pictures[0], -1.0)
    np.testing.assert_array_equal(behind.damage > 0, pictures[0].damage)
    assert not before.damage.any()
    np.testing.assert_array_equal(before.pictures[0], -behind.pictures[0])
    np.testing.assert_array_equal(before.pictures[1], behind.pictures[1])
    np.testing.assert_array_equal(before.weights, behind.weights)


def test_a_sweep_judges_with_the_network_and_its_results_hang_on_its_content(home):
    network = home / "a.npz"
    text = FAMILY.replace("inset_px: 4}", f"inset_px: 4}}, network: {network}")
    (home / "judged.yaml").write_text(text.replace("seed: 3", "seed: 8", 1))
    done = sweep(home / "judged.yaml", home / "out", "--serial")
    assert done.returncode == 0, done.stderr
    table = pd.read_csv(results(home / "out") / "limits.csv")
    assert table["detector"].tolist() == ["learned"]
    digest = load_experiment(home / "judged.yaml").digest
    content = network.read_bytes()
    assert train_tiny(home, "a.npz", "--set", "seed=5") == 0
    assert load_experiment(home / "judged.yaml").digest != digest
    network.write_bytes(content)
    assert load_experiment(home / "judged.yaml").digest == digest


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "detector.name=matched"], "'matched' has no network to train"),
        (["--out", "n.onnx"], "is not a name of a network"),
        (["--shard", "1/2"], "--shard: a network is trained on all boards"),
        (["--set", "detector.settings.crop={kind: box, x_mm: [900, 999], y_mm: [0, 1],"
          " z_mm: [0, 1100], range_max_m: null, inset_px: 0}"], "board"),
    ],
)  # fmt: skip
def test_mistakes_are_one_message(home, capsys, arguments, message):
    assert train_tiny(home, "d.npz", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "Traceback" not in error


def test_a_detector_of_another_package_brings_its_own_network(home):
    """As docs/extending.md describes: a name, and a default for the network's file."""

    class AcmeConfig(LearnedConfig):
        network: str | None = str(home / "a.npz")

    class AcmeDetector(LearnedDetector):
        """Trained on acme's parts."""

        settings_type = AcmeConfig
        name = "acme"

    detector = AcmeDetector(AcmeConfig.from_data({"crop": {"kind": "none"}}))
    assert detector.network.facts["experiment"] == "tiny"
