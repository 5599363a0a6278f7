"""Model-assisted POD: real hits and misses correct a simulated curve, also one of a camera that is
wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy import special

from harness.evaluation.pod.curve import PodCurve, link_ppf
from harness.evaluation.pod.inspections import Inspections
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import record_text
from harness.programs.inspections import pod
from harness.programs.inspections.design_statistics import curve_through, even_sizes
from harness.programs.inspections.mapod import LIMIT_AT, Mapod, Transfer, quantile
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
    assert before.board == "none"
    assert before.targets == 0
    assert before.a50 == pytest.approx(5.0, rel=0.05)
    assert before.a90_95 > 1.5 * before.a90


def uncertain(log_size: bool, link: str = "cloglog") -> PodCurve:
    """A skewed curve, whose mu is not its a50, with correlated errors."""
    curve = curve_through(5.0, 7.0, link, log_size=log_size)
    scale = np.diag([0.03 * curve.mu, 0.1 * curve.sigma])
    return replace(curve, covariance=scale @ np.array([[1.0, 0.4], [0.4, 1.0]]) @ scale)


@pytest.mark.parametrize("log_size", [False, True])
def test_the_studys_own_covariance_is_by_the_delta_method(log_size: bool) -> None:
    """Numeric slopes of ln a50 and of ln w by mu and sigma: the width counts relative to a50 if
    sizes are no logarithms, as a size that is scaled by k scales the rise as well."""
    curve = uncertain(log_size)

    def of_curve(mu: float, sigma: float) -> np.ndarray:
        moved = replace(curve, mu=mu, sigma=sigma)
        width = sigma if log_size else sigma / moved.size_at(0.5)
        return np.log([moved.size_at(0.5), width])

    step = 1e-6
    by_mu = of_curve(curve.mu + step, curve.sigma) - of_curve(curve.mu - step, curve.sigma)
    by_sigma = of_curve(curve.mu, curve.sigma + step) - of_curve(curve.mu, curve.sigma - step)
    slopes = np.stack([by_mu, by_sigma], axis=1) / (2 * step)
    transfer = campaign(np.array([5.0]), np.array([True]), curve)
    expected = slopes @ curve.covariance @ slopes.T
    assert transfer.own_covariance == pytest.approx(expected, rel=1e-5)
    prior = np.diag([np.log(1.5) ** 2, np.log(2.0) ** 2])
    assert transfer.scale == pytest.approx(prior + expected, rel=1e-5)


@pytest.mark.parametrize("log_size", [False, True])
def test_each_node_is_the_curve_scaled_in_size_and_width(log_size: bool) -> None:
    """Damage of size a is found as simulated damage of a / k, with a rise w times as wide about
    a50."""
    curve = uncertain(log_size)
    sizes = np.array([2.0, 5.0, 6.0, 9.0])
    transfer = campaign(sizes, np.array([False, True, False, True]), curve)
    deviations = np.sqrt(np.diag(transfer.scale))
    assert np.abs(transfer.grid).max(axis=0) == pytest.approx(8.0 * deviations)
    assert len(transfer.grid) == 241 * 61
    assert len(np.unique(transfer.grid[:, 0])) == 241
    log_hit, log_miss = transfer.logs
    a90_mm = transfer.sizes_at(0.9)
    for node in (5000, 6200, 7350, 8000, 9400):
        k, w = np.exp(transfer.grid[node])
        middle = curve.size_at(0.5)
        half = curve.mu + curve.sigma * float(link_ppf("cloglog", np.array(0.5)))
        wider = replace(curve, mu=half - (half - curve.mu) * w, sigma=curve.sigma * w)
        assert wider.size_at(0.5) == pytest.approx(middle)
        pod = wider.pod(sizes / k)
        assert np.exp(log_hit[node]) == pytest.approx(pod, rel=1e-9)
        assert np.exp(log_miss[node]) == pytest.approx(1 - pod, rel=1e-9, abs=1e-12)
        assert a90_mm[node] == pytest.approx(k * wider.size_at(0.9))
    assert (transfer.sizes_at(0.01) >= 0.0).all()


def test_the_prior_is_students_without_steep_rises() -> None:
    """Three degrees of freedom; w < 1 only within the study's own uncertainty and the distance of
    the nodes."""
    transfer = campaign(np.array([5.0]), np.array([True]), uncertain(False))
    grid = transfer.grid
    spacing = np.array([2 * grid[-1, 0] / 240, 2 * grid[-1, 1] / 60])
    own_covariance = transfer.own_covariance + np.diag(spacing**2 / 12)
    assert transfer.own_spread == pytest.approx(own_covariance)
    inverse = np.linalg.inv(transfer.scale)
    square = np.einsum("gi,ij,gj->g", grid, inverse, grid)
    student = -(3 + 2) / 2 * np.log1p(square / 3)
    steep = special.log_ndtr(grid[:, 1] / np.sqrt(own_covariance[1, 1]))
    difference = transfer.log_prior - (student + steep)
    assert np.ptp(difference) < 1e-9


def test_the_posterior_is_prior_times_likelihood() -> None:
    sizes = np.array([3.0, 5.0, 6.0, 9.0])
    hit = np.array([False, True, False, True])
    transfer = Transfer(uncertain(True), sizes, hit, np.array(["b", "a", "a", "b"]))
    used = np.array([True, True, True, False])
    log_hit, log_miss = transfer.logs
    value = transfer.log_prior + log_miss[:, 0] + log_hit[:, 1] + log_miss[:, 2]
    expected = np.exp(value - value.max())
    assert transfer.posterior(used) == pytest.approx(expected / expected.sum(), abs=1e-15)
    steps = transfer.steps()
    assert [step.board for step in steps] == ["none", "b", "a"]
    assert [step.targets for step in steps] == [0, 2, 4]
    assert [step.hits for step in steps] == [0, 1, 2]
    weight = transfer.posterior(np.ones(4, bool))
    a90_mm = transfer.sizes_at(0.9)
    order = np.argsort(a90_mm)
    cumulated = np.cumsum(weight[order])
    for share, value_mm in ((0.5, steps[-1].a90), (LIMIT_AT, steps[-1].a90_95)):
        below = a90_mm[order][np.searchsorted(cumulated, share)]
        assert value_mm == pytest.approx(below, rel=0.01)
    # the quantile of the handbook's likelihood ratio: the normal's at the root of 3.841
    assert pytest.approx(0.975, abs=1e-4) == LIMIT_AT
    middle, low, high = transfer.band(np.array([4.0, 8.0]))
    assert (low < middle).all() and (middle < high).all()
    at_8 = np.exp(transfer._logs(transfer.grid, np.array([8.0]))[0][:, 0])
    order = np.argsort(at_8)
    cumulated = np.cumsum(weight[order])
    for share, level in ((0.5, middle[1]), (1 - LIMIT_AT, low[1]), (LIMIT_AT, high[1])):
        assert level == pytest.approx(at_8[order][np.searchsorted(cumulated, share)], abs=5e-3)


def test_a_weighted_quantile_by_hand() -> None:
    """Weights of 1, 2 and 1 lie about 0.5, 2 and 3.5 of 4."""
    values = np.array([30.0, 10.0, 20.0])
    weights = np.array([1.0, 1.0, 2.0])
    assert quantile(values, weights, 0.5) == 20.0
    assert quantile(values, weights, 0.125) == 10.0
    assert quantile(values, weights, 0.0) == 10.0
    assert quantile(values, weights, 0.6875) == pytest.approx(25.0)


def test_a_step_is_enough_if_the_limit_is_near_the_estimate() -> None:
    step = campaign(np.array([5.0]), np.array([True]), simulated()).steps()[0]
    assert replace(step, a90=10.0, a90_95=12.0).enough
    assert not replace(step, a90=10.0, a90_95=12.1).enough


def test_agreement_counts_simulated_campaigns_that_are_as_far() -> None:
    """Everything found at sizes that the curve misses, and the other way round, is as far as can
    be: 1 of 1000. Hits as expected are no evidence."""
    curve = uncertain(False)
    size = np.array([1.0, 2.0, 3.0, 8.0, 9.0, 10.0])
    assert campaign(size, size < 5.0, curve).agreement() == 1 / 1000
    assert campaign(size, size > 5.0, curve).agreement() > 0.2


def test_the_combined_limit_is_the_largest_over_all_simulated_models() -> None:
    record = study_record(Study((SetUp(a50_mm=5.0, width_mm=0.8),), boards=30))
    statement = limit_of(record.set_ups[0], draws=10).statement
    assert statement is not None
    size = even_sizes(24, (2.0, 12.0))
    hit = np.random.default_rng(2).random(24) < curve_through(6.0, 7.6).pod(size)
    read = Inspections(
        path=Path("real.csv"),
        size_column="size",
        response_column="found",
        size=size,
        response=hit.astype(float),
        target=None,
        line=np.arange(1, 25),
    )
    # the likeliest model has the largest limit here: it is put last
    reversed_fits = replace(statement, fits=statement.fits[::-1])
    combined = Mapod.of("50 frames", reversed_fits, "", read)
    limits = [transfer.steps()[-1].a90_95 for transfer in combined.transfers]
    assert max(limits) > limits[0]
    assert combined.steps[-1].a90_95 == max(limits)
    assert combined.steps[-1].a90 == combined.transfers[0].steps()[-1].a90


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
    curve = simulated()

    def last_step(sigma: float):
        uncertain = replace(curve, covariance=np.diag([1e-6, sigma**2]))
        return campaign(size, size > 5.0, uncertain).steps()[-1]

    certain = last_step(1e-3)
    hardly_known = last_step(0.6 * curve.sigma)
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
    assert min(row.covered for row in rows) >= 0.93
    assert np.mean([row.covered for row in rows]) >= 0.97
    assert np.median([row.median / row.measured for row in rows]) < 1.0


TRUTH = curve_through(6.0, 7.6)
"""The real curve of what the study found at 5 mm half of the time."""
OPTIONS = ("--size", "size", "--hit", "found", "--unit", "mm")


@pytest.fixture
def study_folder(tmp_path: Path) -> Path:
    """A study, whose hits plane 1 counted at a threshold of 5, within 15 mm."""
    record = study_record(Study((SetUp(a50_mm=5.0, width_mm=0.8),), boards=30))
    (tmp_path / "study.json").write_text(record_text(record))
    return tmp_path


def write_real(folder: Path, counted: dict[str, str] | None = None) -> Path:
    """Real hits and misses of two boards, with further columns that say how they were counted."""
    size_mm = even_sizes(24, (2.0, 12.0))
    hit = np.random.default_rng(2).random(24) < TRUTH.pod(size_mm)
    further = counted or {}
    lines = [",".join(["size", "found", "board", *further])]
    for number in range(24):
        word = "hit" if hit[number] else "miss"
        board = "AB"[number % 2]
        lines.append(",".join([f"{size_mm[number]:.3f}", word, board, *further.values()]))
    table = folder / "real.csv"
    table.write_text("\n".join(lines) + "\n")
    return table


def corrected(folder: Path, table: Path, *options: str) -> int:
    prior = ["--prior", str(folder), "--board", "board", "--out", str(folder / "out")]
    return pod.main([str(table), *OPTIONS, *prior, *options])


def test_the_program_corrects_a_study(
    study_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert corrected(study_folder, write_real(study_folder)) == 0
    printed = capsys.readouterr().out
    # the table has no columns on how its hits were counted
    assert printed.startswith("warning:")
    assert "real.csv does not state" in printed.splitlines()[0]
    for word in ("simulated", "measured", "combined"):
        assert word in printed
    mapod = json.loads((study_folder / "out" / "mapod.json").read_text())
    assert [step["board"] for step in mapod["after_each_board"]] == ["none", "A", "B"]
    assert [step["targets"] for step in mapod["after_each_board"]] == [0, 12, 24]
    assert mapod["a90_95"] > TRUTH.size_at(0.9) > mapod["simulated"]["a90"]
    assert (study_folder / "out" / "mapod.html").read_text().count("<svg") == 1


@pytest.mark.parametrize(
    ("detector", "threshold", "radius", "words"),
    [
        ("plane 1", "5", "15", ""),
        (
            "plane 1",
            "5.4",
            "15",
            "by plane 1 at a threshold of 5.4, within 15 mm; those of the study by plane 1 at",
        ),
        (
            "matched 7",
            "5",
            "12",
            "by matched 7 at a threshold of 5, within 12 mm; those of the study by plane 1",
        ),
    ],
)
def test_hits_that_were_counted_otherwise_are_warned_of(
    study_folder: Path,
    capsys: pytest.CaptureFixture[str],
    unsaved: None,
    detector: str,
    threshold: str,
    radius: str,
    words: str,
) -> None:
    counted = {"detector": detector, "threshold": threshold, "hit_radius_mm": radius}
    assert corrected(study_folder, write_real(study_folder, counted)) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("warning:") == bool(words)
    mapod = json.loads((study_folder / "out" / "mapod.json").read_text())
    assert bool(mapod["counted_otherwise"]) == bool(words)
    for text in (
        first,
        mapod["counted_otherwise"],
        (study_folder / "out" / "mapod.html").read_text(),
    ):
        assert words in text


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--board", "board"], "--prior"),
        (["--prior", "STUDY", "--link", "logit"], "--link"),
        (["--prior", "STUDY", "--board", "bord"], "board"),
        (["--prior", "STUDY", "--target", "board"], "one size"),
        (["--prior", "STUDY/no"], "no"),
    ],
)
def test_mistakes_about_a_prior_are_told_and_write_nothing(
    study_folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], word: str
) -> None:
    named = [option.replace("STUDY", str(study_folder)) for option in options]
    out = study_folder / "none"
    table = write_real(study_folder)
    assert pod.main([str(table), *OPTIONS, *named, "--out", str(out)]) == 2
    assert word in capsys.readouterr().err
    assert not out.exists()
