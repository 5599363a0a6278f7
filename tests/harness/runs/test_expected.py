"""What a run is expected to cost follows from the bills of earlier runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.records.outputs import PROVENANCE
from harness.report.blocks import BILL
from harness.runs import expected as expected_module
from harness.runs.bill import PHASES
from harness.runs.expected import PastRun, RunWork, expected, kind_of, shipped_runs
from harness.vocabulary.files import shipped
from tests.support.tiny_sweep import STUDY, TINY

WORK = RunWork(renders=10, trials=100)


def past(name: str, kind: str, **costs: float) -> PastRun:
    """A run with 10 renders of 4 s and 10 trials of 9 s, unless stated otherwise."""
    seconds = {"renders_s": 40.0, "trials_s": 90.0, "fixed_s": 3.0} | costs
    return PastRun(name, kind, 10, 10, 10, 10, **seconds)


@pytest.fixture(autouse=True)
def shipped_bills(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = (
        past("crack", "study"),
        past("pipe", "study", renders_s=20.0),
        past("views", "maps", trials_s=300.0),
    )
    monkeypatch.setattr(expected_module, "shipped_runs", lambda: runs)
    monkeypatch.setattr(expected_module.os, "cpu_count", lambda: 8)


def store_bill(folder: Path, done: tuple[int, int], found: int = 0, **seconds: float) -> None:
    """Store a run's bill, with its numbers of renders and trials, and of trials found stored."""
    folder.mkdir(parents=True)
    facts = {
        BILL: dict.fromkeys(PHASES, 0.0) | seconds,
        "renders": {"done": done[0], "cached": 0},
        "trials": {"done": done[1], "resumed": found},
    }
    (folder / PROVENANCE.name).write_text(json.dumps(facts))


def test_without_runs_here_it_follows_from_the_bills_that_come_with_tofpod(tmp_path):
    assert expected(tmp_path, "crack", "study", WORK, processes=2) == (
        "expected from nothing: 15.7 min of processor time (40 s for renders, 15.0 min for "
        "trials), or 7.9 min on 2 idle cores; by the bill of this experiment that comes with tofpod"
    )
    # 20 renders of studies took 60 s
    assert expected(tmp_path, "mine", "study", WORK, processes=16) == (
        "expected from nothing: 15.6 min of processor time (30 s for renders, 15.0 min for "
        "trials), or 2.0 min on 8 idle cores; roughly, by the bills of other experiments that come "
        "with tofpod"
    )
    assert "50.0 min for trials" in expected(tmp_path, "mine", "maps", WORK, processes=1)
    # no sweep comes with it: all kinds
    assert "26.7 min for trials" in expected(tmp_path, "mine", "sweep", WORK, processes=1)


def test_runs_of_the_same_experiment_here_decide(tmp_path):
    first = {"renders": 4.0, "frames": 5.0, "detection": 10.0, "plan": 1.5}
    store_bill(tmp_path / "crack" / "1", (2, 50), **first)
    (tmp_path / "crack" / "latest").symlink_to("1")
    # it found everything stored
    store_bill(tmp_path / "crack" / "2", (0, 0), found=50, statistics=3.0, renders=0.5)
    (tmp_path / "crack" / "3").mkdir()
    (tmp_path / "crack" / "3" / PROVENANCE.name).write_text("{}")
    assert expected(tmp_path, "crack", "study", WORK, processes=1) == (
        "expected from nothing: 53 s of processor time (20 s for renders, 30 s for trials), or 53 s "
        "on 1 idle core; by the bills of earlier runs of this experiment"
    )


def test_a_cost_that_no_run_here_tells_is_that_which_comes_with_tofpod(tmp_path):
    store_bill(tmp_path / "crack" / "1", (0, 10), detection=5.0, plan=2.0)
    assert expected(tmp_path, "crack", "study", RunWork(1, 2), processes=1).startswith(
        "expected from nothing: 7 s of processor time (4 s for renders, 1 s for trials)"
    )


def test_a_study_with_a_precision_has_an_expectation_and_a_bound(tmp_path):
    """Without an earlier run, half of the boards that it may add are expected."""
    least = RunWork(renders=2, trials=2)
    most = RunWork(renders=8, trials=20)
    text = expected(tmp_path, "mine", "maps", most, processes=2, least=least)
    assert text.startswith(
        "expected from nothing: 5.9 min of processor time (20 s for renders, 5.5 min for trials), "
        "or 3.0 min on 2 idle cores, at most 10.6 min or 5.3 min; roughly"
    )
    # an earlier run needed 12 trials, of which it found 2 stored
    store_bill(tmp_path / "mine" / "1", (6, 10), found=2, detection=10.0, renders=6.0, plan=1.0)
    text = expected(tmp_path, "mine", "maps", most, processes=1, least=least)
    assert text.startswith(
        "expected from nothing: 19 s of processor time (6 s for renders, 12 s for trials), "
        "or 19 s on 1 idle core, at most 29 s or 29 s; by the bills"
    )


def test_the_kind_of_an_experiment(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    (tmp_path / "study.yaml").write_text(STUDY)
    assert kind_of(load_experiment(tmp_path / "tiny.yaml")) == "sweep"
    assert kind_of(load_experiment(tmp_path / "study.yaml")) == "study"
    assert kind_of(load_experiment(Path("perspectives"))) == "maps"


def test_the_bills_that_come_with_tofpod_are_of_its_experiments():
    names = {path.stem for path in shipped("experiments").glob("*.yaml")}
    assert shipped_runs()
    for run in shipped_runs():
        assert run.experiment in names
        assert run.kind == kind_of(load_experiment(Path(run.experiment)))
        assert min(run.renders, run.trials, run.renders_s, run.trials_s, run.fixed_s) > 0
