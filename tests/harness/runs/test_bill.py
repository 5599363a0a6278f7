"""The bill of a run: what each phase cost, and what a run is expected to cost."""

from __future__ import annotations

import json
import re
import time

from harness.records.outputs import PROVENANCE
from harness.report.blocks import BILL, closing
from harness.runs import bill as bills
from harness.runs.bill import PHASES, Bill, Metered, expected
from harness.runs.jobs import Ended, Job
from harness.runs.processes import Limits, LocalEngine
from tests.support import faulty_jobs


def test_phases_are_charged_with_this_process_and_with_jobs(monkeypatch):
    clock = {"s": 2.0}
    monkeypatch.setattr(bills.time, "process_time", lambda: clock["s"])
    monkeypatch.setattr(Bill, "_settled_s", 0.0)
    bill = Bill()
    bill.begin("detection")
    clock["s"] = 3.0
    bill.charge(Job("a view", "renders", time.sleep, ()), Ended("done", processor_s=10.0))
    bill.charge(Job("a trial", "trials", time.sleep, ()), Ended("failed", processor_s=7.0))
    bill.begin("statistics")
    clock["s"] = 3.5
    bill.charge(Job("a set-up", "trials", time.sleep, ()), Ended("done", processor_s=0.25))
    bill.divide_trials(frames_share=0.25)
    assert bill.rounded() == {
        "imports": 2.0,
        "plan": 0.0,
        "renders": 10.0,
        "frames": 2.0,
        "detection": 6.0,
        "statistics": 0.75,
        "tables and page": 0.0,
    }
    assert bill.in_words().startswith("processor seconds: 20.8 (imports 2.0, plan 0.0, ")
    clock["s"] = 4.5
    # a second run of this process: what was charged before is not charged again
    assert Bill().rounded()["imports"] == 1.0


def test_a_process_says_what_its_jobs_cost():
    bill = Bill()
    bill.begin("detection")
    with Metered(LocalEngine(1, Limits(seconds=60.0)), bill) as engine:
        engine.submit(Job("works", "trials", faulty_jobs.works, (0.2,)))
        ((_, ended),) = engine.ended()
        assert engine.room("trials") == 2
    assert 0.2 <= ended.processor_s < 1.0
    assert bill.rounded()["detection"] >= 0.2


def test_a_page_shows_each_phase_with_its_share():
    """The bill is asked for when the page is closed, and its parts come to the whole."""
    seconds = {"imports": 1.0, "renders": 6.0, "detection": 3.0}
    provenance = {
        BILL: lambda: dict(seconds),
        "seconds": {"this run in all": 12.3},
        "renders": {"done": 2, "cached": 1},
        "trials": {"done": 5},
    }
    seconds["renders"] = 12.0
    page = " ".join(closing(provenance, ""))
    words = " ".join(re.sub(r"<[^>]+>", " ", page).split())
    for row in ("imports 1.0 6 %", "renders 12.0 75 %", "detection 3.0 19 %", "in all 16.0 100 %"):
        assert row in words
    assert "of this run, for 2 renders and 5 trials. What was" in words and "It took 12 s" in words
    assert words.count("imports") == 1  # not once more among versions


def stored_bill(folder, done: tuple[int, int], **seconds: float) -> None:
    """Store a run's bill, with its numbers of renders and trials."""
    folder.mkdir(parents=True)
    facts = {
        BILL: dict.fromkeys(PHASES, 0.0) | seconds,
        "renders": {"done": done[0]},
        "trials": {"done": done[1]},
    }
    (folder / PROVENANCE.name).write_text(json.dumps(facts))


def test_the_expected_cost_comes_from_runs_of_the_same_experiment(tmp_path, monkeypatch):
    monkeypatch.setattr(bills.os, "cpu_count", lambda: 8)
    assert expected(tmp_path, "crack", 10, 100, processes=2) == (
        "expected from nothing: 54 s of processor time (2 s for renders, 40 s for trials), or 27 s "
        f"on 2 idle cores; very roughly: no such run has been billed in {tmp_path} yet"
    )
    other = {"renders": 50.0, "detection": 3.0, "imports": 1.0}
    stored_bill(tmp_path / "other" / "1", (1, 1), **other)
    (tmp_path / "other" / "latest").symlink_to("1")
    assert expected(tmp_path, "crack", 10, 100, processes=16) == (
        "expected from nothing: 13.3 min of processor time (8.3 min for renders, 5.0 min for "
        "trials), or 1.7 min on 8 idle cores; roughly, by the bills of other experiments"
    )
    first = {"renders": 4.0, "frames": 5.0, "detection": 10.0, "plan": 1.5}
    stored_bill(tmp_path / "crack" / "1", (2, 50), **first)
    # it found everything stored
    stored_bill(tmp_path / "crack" / "2", (0, 0), statistics=3.0, renders=0.5)
    (tmp_path / "crack" / "3").mkdir()
    (tmp_path / "crack" / "3" / PROVENANCE.name).write_text("{}")
    assert expected(tmp_path, "crack", 10, 100, processes=1) == (
        "expected from nothing: 53 s of processor time (20 s for renders, 30 s for trials), or 53 s "
        "on 1 idle core; by the bills of earlier runs of this experiment"
    )


def test_a_cost_that_no_run_of_the_experiment_tells_is_that_of_others(tmp_path):
    stored_bill(tmp_path / "crack" / "1", (0, 10), detection=5.0, plan=2.0)
    stored_bill(tmp_path / "other" / "1", (10, 10), renders=40.0, detection=90.0)
    assert expected(tmp_path, "crack", 1, 2, processes=1).startswith(
        "expected from nothing: 7 s of processor time (4 s for renders, 1 s for trials)"
    )
