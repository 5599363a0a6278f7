"""Model-assisted POD: real hits and misses correct a simulated curve, also one of a camera that is
wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from harness.evaluation.pod.curve import PodCurve
from harness.evaluation.study.record import record_text
from harness.programs.inspections import pod
from harness.programs.inspections.design_statistics import curve_through, even_sizes
from harness.programs.inspections.mapod import Transfer
from tests.support.synthetic_study import SetUp, Study, study_record
from tests.validation.mapod_coverage import coverage, wrong_by


def simulated(log_size: bool = False) -> PodCurve:
    """A curve with a50 = 5 and a90 = 7 mm as some 200 simulated targets give it."""
    curve = curve_through(5.0, 7.0, log_size=log_size)
    deviations = np.array([0.02 * (1.0 if log_size else curve.mu), 0.1 * curve.sigma])
    return replace(curve, covariance=np.diag(deviations**2))


def campaign(size: np.ndarray, hit: np.ndarray, curve: PodCurve) -> Transfer:
    return Transfer(curve, size, hit, np.full(len(size), "all"))


@pytest.mark.parametrize("log_size", [False, True])
def test_many_real_targets_overrule_the_simulation(log_size: bool):
    curve = simulated(log_size)
    truth = wrong_by(curve, 1.6, 1.5)
    size = np.linspace(1.0, 25.0, 300)
    step = campaign(size, np.random.default_rng(1).random(300) < truth.pod(size), curve)
    last = step.steps()[-1]
    assert last.a50 == pytest.approx(truth.size_at(0.5), rel=0.1)
    assert last.a90 == pytest.approx(truth.size_at(0.9), rel=0.1)
    assert step.agreement() < 0.01


def test_without_real_targets_the_prior_remains():
    before = campaign(np.array([5.0]), np.array([True]), simulated()).steps()[0]
    assert before.board == "none" and before.targets == 0
    assert before.a50 == pytest.approx(5.0, rel=0.05)
    assert before.a90_95 > 1.5 * before.a90


@pytest.mark.slow  # a Monte Carlo campaign
def test_agreement_is_as_rare_as_it_says():
    """P-values of campaigns whose truth is the simulated curve: 5 % and fewer lie below 0.05
    (binomial, 3 sigma)."""
    curve = simulated()
    size = np.linspace(2.0, 12.0, 20)
    random = np.random.default_rng(3)
    below = sum(
        campaign(size, random.random(20) < curve.pod(size), curve).agreement(seed) < 0.05
        for seed in range(10)
    )
    assert below <= 4


def test_a_rise_steeper_than_the_simulated_one_is_credited_only_within_the_study_s_uncertainty():
    size = np.linspace(1.0, 12.0, 60)
    certain, hardly_known = (
        campaign(
            size, size > 5.0, replace(simulated(), covariance=np.diag([1e-6, sigma**2]))
        ).steps()[-1]
        for sigma in (1e-3, 0.6 * simulated().sigma)
    )
    assert hardly_known.a90 - hardly_known.a50 < 1.4 < 1.8 < certain.a90 - certain.a50


@pytest.mark.slow
@pytest.mark.parametrize(
    "curve", [curve_through(4.0, 5.0, log_size=True), curve_through(4.0, 5.0, "cloglog")]
)
def test_the_limit_covers_the_truth_whatever_the_camera(curve: PodCurve):
    """100 campaigns of 24 holes know a share of 0.98 to 0.014; the docs' table has 300 of a
    case."""
    cases = list(product((1.0, 1.25, 1.5, 2.0), (0.6, 1.0, 1.6)))
    rows = coverage(curve, cases, 24, campaigns=100)
    print("\n".join(map(str, rows)))
    assert (
        min(row.covered for row in rows) >= 0.93 and np.mean([row.covered for row in rows]) >= 0.97
    )
    assert np.median([row.median / row.measured for row in rows]) < 1.0


def test_the_program_corrects_a_study(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
):
    record = study_record(Study((SetUp(a50_mm=5.0, width_mm=0.8),), boards=30))
    (tmp_path / "study.json").write_text(record_text(record))
    truth = curve_through(6.0, 7.6)
    size = even_sizes(24, (2.0, 12.0))
    hit = np.random.default_rng(2).random(24) < truth.pod(size)
    rows = [
        f"{a:.3f},{'hit' if h else 'miss'},{'AB'[n % 2]}"
        for n, (a, h) in enumerate(zip(size, hit, strict=True))
    ]
    table = tmp_path / "real.csv"
    table.write_text("\n".join(["size,found,board", *rows]) + "\n")
    arguments = [str(table), "--size", "size", "--hit", "found", "--unit", "mm"]
    prior = ["--prior", str(tmp_path), "--board", "board", "--out", str(tmp_path / "out")]
    assert pod.main([*arguments, *prior]) == 0
    mapod = json.loads((tmp_path / "out" / "mapod.json").read_text())
    printed = capsys.readouterr().out
    assert printed.startswith("warning:") and "real.csv does not state" in printed.splitlines()[0]
    assert "simulated" in printed and "measured" in printed and "combined" in printed
    assert [step["board"] for step in mapod["after_each_board"]] == ["none", "A", "B"]
    assert [step["targets"] for step in mapod["after_each_board"]] == [0, 12, 24]
    assert mapod["a90_95"] > truth.size_at(0.9) > mapod["simulated"]["a90"]
    assert (tmp_path / "out" / "mapod.html").read_text().count("<svg") == 1

    request.getfixturevalue("unsaved")
    for counted, word in (
        ("plane 1,5,15", ""),
        (
            "plane 1,5.4,15",
            "by plane 1 at a threshold of 5.4, within 15 mm; those of the study by plane 1 at",
        ),
        (
            "matched 7,5,12",
            "by matched 7 at a threshold of 5, within 12 mm; those of the study by plane 1",
        ),
    ):
        head = "size,found,board,detector,threshold,hit_radius_mm"
        table.write_text("\n".join([head, *(f"{row},{counted}" for row in rows)]) + "\n")
        assert pod.main([*arguments, *prior]) == 0
        first = capsys.readouterr().out.splitlines()[0]
        assert first.startswith("warning:") == bool(word) and word in first
        assert (
            word in json.loads((tmp_path / "out" / "mapod.json").read_text())["counted_otherwise"]
        )
        assert word in (tmp_path / "out" / "mapod.html").read_text()

    for wrong, word in (
        (["--board", "board"], "--prior"),
        (["--prior", str(tmp_path), "--link", "logit"], "--link"),
        (["--prior", str(tmp_path), "--board", "bord"], "board"),
        (["--prior", str(tmp_path), "--target", "board"], "one size"),
        (["--prior", str(tmp_path / "no")], "no"),
    ):
        assert pod.main([*arguments, *wrong, "--out", str(tmp_path / "none")]) == 2
        assert word in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
