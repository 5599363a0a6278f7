"""The bill of a run: what each phase cost."""

from __future__ import annotations

import re
import time

from harness.report.blocks import BILL, closing
from harness.runs import bill as bills
from harness.runs.bill import Bill, Metered
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
