"""The program `tofpod efficiency` on a finished study, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness.programs.efficiency import ideal_trials as ideal
from harness.programs.efficiency.efficiency import main
from harness.programs.efficiency.tables import EFFICIENCY_TABLES
from harness.programs.keeping.written_files import is_output
from harness.records.outputs import EFFICIENCY_PAGE, EXPERIMENT, STUDY


@pytest.fixture
def results(study_out: Path, tmp_path: Path) -> Path:
    """A copy of a study's results beside its renders."""
    run = (study_out / "tiny" / "latest").resolve()
    (tmp_path / ".cache").symlink_to(study_out / ".cache")
    return Path(
        shutil.copytree(
            run, tmp_path / "tiny" / run.name, dirs_exist_ok=True, ignore=lambda *_: [".lock"]
        )
    )


@pytest.mark.usefixtures("unsaved")
def test_detectors_stand_beside_the_ideal_observer(
    results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ideal, "UNITS_A_BOARD", 2)
    assert main([str(results), "--serial"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith(
        "The ideal observer judges a new unit of azure_kinect_nfov by the noise of 8 units, "
        "at 4 false"
    )
    tables = [pd.read_parquet(results / table.files[1]) for table in EFFICIENCY_TABLES]
    efficiency, damages = tables
    assert efficiency["frames"].tolist() == [1, 2] and len(damages) == 2 * 4 * 5
    single_frame = damages[damages["set_up"].str.startswith("1 frame")]
    two = damages[damages["set_up"].str.startswith("2 frames")]
    # more frames, more signal; damage that shows nothing has none
    assert (two["index"].to_numpy() >= single_frame["index"].to_numpy()).mean() > 0.9
    assert (
        np.corrcoef(np.log(single_frame["diameter_mm"]), np.log(single_frame["index"]))[0, 1] > 0.8
    )
    assert (
        single_frame["threshold"].between(3.5, 5.0).all()
        and single_frame["pod"].between(0, 1).all()
    )
    # the ideal observer needs smaller damage than the detector, and none is better than it
    reference = efficiency.dropna(subset="efficiency_50_share")
    assert (reference["ideal_a50_mm"] < reference["a50_mm"]).all() and (
        reference["efficiency_50_share_low"] < 1
    ).all()
    assert EFFICIENCY_PAGE.name in printed and "d' of the ideal observer" not in printed
    assert "Efficiency: tiny" in (results / EFFICIENCY_PAGE.name).read_text()
    assert all(
        is_output(name, "results")
        for table in EFFICIENCY_TABLES
        for name in (*table.files, EFFICIENCY_PAGE.name)
    )


def without_experiment(results: Path) -> None:
    (results / EXPERIMENT.name).unlink()


def without_study(results: Path) -> None:
    (results / STUDY.name).unlink()


def with_a_given_threshold(results: Path) -> None:
    data = json.loads((results / STUDY.name).read_text())
    (results / STUDY.name).write_text(json.dumps(data | {"false_calls_per_m2": None}))


def of_another_study(results: Path) -> None:
    data = json.loads((results / STUDY.name).read_text())
    data["set_ups"][0]["frames"] = 7
    (results / STUDY.name).write_text(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without_experiment, "has no experiment.yaml"),
        (without_study, "cannot be read"),
        (with_a_given_threshold, "no wanted rate of false calls"),
        (of_another_study, "lacks the set-up"),
    ],
)
def test_mistakes_are_one_message(results, change, said, monkeypatch, capsys) -> None:
    monkeypatch.setattr("harness.programs.efficiency.ideal_trials.ideal_of_set_ups", lambda *_: {})
    change(results)
    assert main([str(results), "--serial"]) == 2
    captured = capsys.readouterr()
    assert said in captured.err and "Traceback" not in captured.err
    assert not (results / EFFICIENCY_PAGE.name).exists()


def test_a_board_without_noise_is_a_mistake_and_a_bug_keeps_its_traceback(
    results, monkeypatch, capsys
) -> None:
    monkeypatch.setattr(ideal, "FEWEST_PIXELS", 10**9)
    assert main([str(results), "--serial"]) == 2
    assert "its noise is not known" in capsys.readouterr().err
    monkeypatch.setattr(ideal, "load_board", lambda _: 1 / 0)
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        main([str(results), "--serial"])
