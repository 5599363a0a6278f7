"""The audit: claims of simulated studies, rows and verdicts, sizes of boards, and the program."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from harness import api
from harness.evaluation.intervals import Interval
from harness.evaluation.study.limit import limit_of
from harness.experiment.checks import LEAST_BOARDS
from harness.experiment.load import load_experiment
from harness.programs.audit import boards, precise_studies, studies
from harness.programs.audit.audit import BOARDS, main, rows_of_simulated
from harness.programs.audit.page import headline
from harness.programs.audit.precise_studies import PreciseCase, claims_of_precise_study
from harness.programs.audit.rows import audited
from harness.programs.audit.studies import STUDY_CASES, StudyCase, claims_of_study

SHORT = (PreciseCase(StudyCase("steep", 0.2), 5.0),)


def test_the_true_sizes_are_those_of_a_board_drawn_at_random() -> None:
    equal_boards = StudyCase("alike", 0.8)
    assert equal_boards.size_at(0.5) == pytest.approx(6.0)
    assert equal_boards.size_at(0.9) == pytest.approx(6.0 + 0.8 * np.log(9.0))
    random = np.random.default_rng(1)
    a50_mm = 6.0 + 2.0 * random.standard_normal(200_000)
    size_mm = StudyCase("differ", 0.8, shift_mm=2.0).size_at(0.9)
    hits = random.random(200_000) < 1.0 / (1.0 + np.exp((a50_mm - size_mm) / 0.8))
    assert hits.mean() == pytest.approx(0.9, abs=0.003)


@pytest.mark.parametrize("law", ["Gaussian", "Student 12"])
def test_scores_of_hole_free_boards_have_the_stated_law(law: str) -> None:
    """The ten highest of 2,000 places: on average one of a board's scores lies above the score that
    one place in 2,000 exceeds."""
    case = StudyCase("x", 0.8, law=law)
    assert case.rate_at(case.wanted_threshold) == pytest.approx(1.0)
    score = studies.LAWS[law].isf(1 / 2000 / 2)
    random = np.random.default_rng(2)
    sizes = []

    def kept(peaks: list[list[float]], *_: float) -> None:
        sizes.append(np.array(peaks))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studies, "threshold_from_peaks", kept)
        for _ in range(20):
            studies.drawn_threshold(case, random)
    peaks = np.concatenate(sizes)
    assert peaks.shape == (1200, 10)
    assert (np.diff(peaks, axis=1) < 0).all()
    # Poisson: standard error 0.03
    assert (peaks > score).sum(axis=1).mean() == pytest.approx(1.0, abs=0.09)


def test_a_study_claims_all_quantities_and_the_same_again() -> None:
    claims = claims_of_study(STUDY_CASES[1], 0)
    assert {claim.quantity for claim in claims} == {
        "a50",
        "a90",
        "a90/95",
        "a90/95 over boards",
        "a50 by signals",
        "a90 by signals",
        "a90/95 by signals",
        "true rate at the threshold",
        "counted rate",
    }
    assert claims == claims_of_study(STUDY_CASES[1], 0)
    assert claims != claims_of_study(STUDY_CASES[1], 1)


def test_a_precise_study_is_the_same_again_and_ends_when_it_is_precise() -> None:
    *claims, reached = claims_of_precise_study(SHORT[0], 0)
    assert claims == claims_of_precise_study(SHORT[0], 0)[:-1]
    assert claims != claims_of_precise_study(SHORT[0], 1)[:-1]
    assert (reached.holds, reached.ratio) == (True, LEAST_BOARDS)
    never = PreciseCase(StudyCase("steep", 0.2, holes=2), 1e-6)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(precise_studies, "MOST_BOARDS", 12)
        reached = claims_of_precise_study(never, 0)[-1]
    assert (reached.holds, reached.ratio) == (False, 12)


def test_claims_hold_where_the_truth_lies_within() -> None:
    assert studies._interval_claim("x", Interval(1.0, 3.0), 2.0).holds
    assert studies._interval_claim("x", Interval(1.0, 3.0), 2.0).ratio == 1.5
    assert not studies._interval_claim("x", Interval(1.0, 3.0), 3.1).holds
    assert not studies._interval_claim("x", Interval(1.0, 3.0), 0.9).holds
    assert studies._bound_claim("x", 5.0, 5.0).holds
    assert not studies._bound_claim("x", 4.9, 5.0).holds
    assert studies._bound_claim("x", np.inf, 5.0).holds


def test_verdicts_are_by_the_exact_interval() -> None:
    def row(held: int) -> str:
        holds = np.arange(100) < held
        return audited("a90", "case", nominal=0.95, holds=holds, ratio=np.ones(100)).verdict

    assert row(100) == "more often"
    assert row(92) == "as stated"
    assert row(88) == "too seldom"


def test_the_headline_names_the_worst() -> None:
    good = audited("a50", "x", nominal=0.95, holds=np.ones(50, bool), ratio=np.ones(50))
    bad = audited("depth", "y", nominal=0.95, holds=np.arange(50) < 20, ratio=np.ones(50))
    assert headline([good]).startswith("None of 1 statements")
    assert headline([good, bad]) == (
        "1 of 2 statements cover the truth too seldom; the worst is depth (y): 40 % instead of 95 %."
    )


def test_sizes_count_where_model_and_error_are_known() -> None:
    holes = pd.DataFrame(
        {
            "model_diameter_mm": [10.0, 12.0, np.nan, 10.0],
            "model_diameter_se_mm": [0.5, 0.5, 0.5, np.nan],
            "true_diameter_mm": [10.9, 10.0, 10.0, 10.0],
            "model_depth_mm": [np.nan] * 4,
            "model_depth_se_mm": [np.nan] * 4,
            "seen_depth_mm": [5.0] * 4,
        }
    )
    (row,) = boards._sizes(holes, "main, blind, 1 frame")
    assert (row.held, row.stated) == (1, 2)
    assert row.ratio == pytest.approx((10.0 / 10.9 + 1.2) / 2)
    assert row.quantity == "diameter, two standard errors"


def test_counted_false_calls_agree_where_the_intervals_overlap() -> None:
    """Garwood: 5 calls on 3.24 m2 are 0.50 to 3.60 per m2, 15 are 2.59 to 7.64."""
    limits = []
    for number in (5, 15):
        claimed = studies.drawn_threshold(STUDY_CASES[1], np.random.default_rng(1))
        record = studies._record(STUDY_CASES[1], claimed, np.random.default_rng(1))
        assert record.threshold_error is not None
        stated = replace(record.threshold_error, low_per_m2=0.4, high_per_m2=1.8)
        calls = np.zeros(60, int)
        calls[:number] = 1
        unflawed = replace(record.unflawed, calls=calls)
        limits.append(limit_of(replace(record, threshold_error=stated, unflawed=unflawed), draws=2))
    certain = limit_of(replace(limits[0].record, threshold_error=None), draws=2)
    (row,) = boards._rates((*limits, certain))
    assert (row.held, row.stated) == (1, 2)
    assert row.ratio == pytest.approx(10 / 3.24)


def test_the_program_writes_page_and_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(studies, "STUDY_CASES", STUDY_CASES[3:4])
    monkeypatch.setattr(precise_studies, "PRECISE_CASES", SHORT)
    options = ["--no-boards", "--studies", "3", "--jobs", "1", "--out", str(tmp_path)]
    assert main(options) == 0
    assert "statements" in capsys.readouterr().out
    table = api.table(tmp_path, "audit")
    assert set(table["case"]) == {"20 targets", "steep, a90 to 5 mm"}
    reached = table[table["quantity"] == "precision reached"].iloc[0]
    assert (reached["held"], reached["ratio"]) == (3, LEAST_BOARDS)
    assert reached["verdict"] == "no coverage"
    assert (table["stated"] == 3).all()
    assert "median ratio" in (tmp_path / "audit.html").read_text()
    assert (tmp_path / "audit.csv").is_file()


def test_two_processes_judge_as_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "STUDY_CASES", STUDY_CASES[3:4])
    monkeypatch.setattr(precise_studies, "PRECISE_CASES", ())
    assert rows_of_simulated(2, jobs=2) == rows_of_simulated(2, jobs=1)


def test_the_boards_are_a_valid_experiment() -> None:
    experiment = load_experiment(BOARDS, [])
    assert len(experiment.points) == 8
    assert experiment.config.study is not None
    assert experiment.config.study.boards == 12
