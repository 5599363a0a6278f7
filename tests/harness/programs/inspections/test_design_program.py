"""The program `tofpod design`, and what it stands on: guessed curves, recommendations, areas."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.evaluation.intervals import threshold_for_rate
from harness.evaluation.pod.curve import LINKS
from harness.evaluation.study.limit import limit_of
from harness.evaluation.study.record import record_text
from harness.programs.inspections.design import FILES, main
from harness.programs.inspections.design_statistics import (
    StudyPlan,
    curve_through,
    design,
    hole_free,
    recommend,
)
from harness.vocabulary.errors import UserError
from tests.support.synthetic_study import AREA_M2, SetUp, Study, study_record

GUESS = curve_through(5.0, 7.0)
TOLD = ["--a50", "5", "--a90", "7", "--sizes", "2:12"]
FEW = ["--studies", "20", "--targets", "30", "60"]


def answered(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        assert main([*arguments, "--out", folder]) == 0
        return dict(json.loads((Path(folder) / "design.json").read_text()))


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two set-ups; the second has a50 = 4."""
    set_ups = (SetUp(frames=1), SetUp(frames=50, a50_mm=4.0))
    folder = tmp_path_factory.mktemp("study")
    (folder / "study.json").write_text(record_text(study_record(Study(set_ups=set_ups, boards=30))))
    return folder


# ---- the guess
# ------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(
    a50=st.floats(0.1, 50),
    ratio=st.floats(1.05, 4),
    link=st.sampled_from(LINKS),
    log_size=st.booleans(),
)
def test_the_guess_goes_through_both_sizes(
    a50: float, ratio: float, link: str, log_size: bool
) -> None:
    curve = curve_through(a50, ratio * a50, link, log_size=log_size)
    assert curve.pod(np.array([a50, ratio * a50])) == pytest.approx([0.5, 0.9], abs=1e-9)
    assert (curve.size_at(0.5), curve.size_at(0.9)) == pytest.approx((a50, ratio * a50), rel=1e-9)


def test_logit_by_hand() -> None:
    """ln(0.9 / 0.1) = ln 9 widths lie between a50 and a90."""
    assert (GUESS.mu, GUESS.sigma) == pytest.approx((5.0, 2.0 / np.log(9.0)))


# ---- what is recommended
# ---------------------------------------------------------------------------------------------


def plans(*targets_and_bounds: tuple[int, float]) -> list[StudyPlan]:
    """(targets, 90 % quantile)."""
    first = StudyPlan(60, 20, 7.0, 7.5, 7.0, 8.0, 1.0, np.arange(60.0))
    return [replace(first, targets=n, high=high) for n, high in targets_and_bounds]


def test_recommends_the_fewest_that_are_sure_of_the_goal() -> None:
    candidates = plans((30, 7.9), (60, 9.0), (120, 8.4), (240, 8.0))
    assert recommend(candidates) == (candidates[1], None), "without a wish the handbook's minimum"
    assert recommend(candidates, 8.5) == (candidates[2], True)
    assert recommend(candidates, 7.5) == (candidates[3], False), (
        "30 targets are no study, whatever they seem to show"
    )
    assert recommend(candidates[:1]) == (candidates[0], None)


# ---- hole-free boards
# ------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(rate=st.floats(0.05, 20), area=st.floats(0.01, 2))
def test_the_fewest_boards_are_what_the_rule_of_thresholds_takes(rate: float, area: float) -> None:
    boards = hole_free(rate, area)
    assert boards.expected_per_m2 <= rate * (1 + 1e-9)
    if boards.calibration_boards > 1:
        with pytest.raises(UserError, match=f"at least {boards.calibration_boards} runs"):
            threshold_for_rate(np.arange(boards.calibration_boards - 1.0), area, rate)


def test_areas_bound_the_rate_exactly() -> None:
    boards = hole_free(1.0, 0.25, 0.9)
    assert boards.silent_m2 == pytest.approx(-np.log(0.1)), "exp(-area) = 0.1"
    assert boards.silent_boards == 10


# ---- the program
# ------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("unsaved")
def test_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    answer = answered(capsys, *TOLD, *FEW, "--goal", "11")
    expected = design(GUESS, (30, 60), (2.0, 12.0), studies=20, seed=1)
    assert [plan["targets"] for plan in answer["plans"]] == [30, 60]
    assert [plan["bound"] for plan in answer["plans"]] == [plan.bound for plan in expected]
    assert [plan["sizes"] for plan in answer["plans"]] == [plan.sizes.tolist() for plan in expected]
    chosen, _ = recommend(expected, 11.0)
    assert [plan["recommended"] for plan in answer["plans"]] == [
        plan is chosen for plan in expected
    ]
    assert answer["recommendation"].startswith("Make 60 targets")
    assert answer["unflawed_sites"] == 180
    assert (answer["guess"]["a50"], answer["guess"]["a90"]) == pytest.approx((5.0, 7.0))


@pytest.mark.usefixtures("unsaved")
def test_a_goal_out_of_reach_says_what_it_would_take(capsys: pytest.CaptureFixture[str]) -> None:
    """The 90 % quantile comes nearer to a90 = 7 as one over the root of the targets: by hand from
    the plan's."""
    answer = answered(capsys, *TOLD, *FEW, "--goal", "7.2")
    assert "no plan listed is sure to show the 7.2 mm" in answer["recommendation"]
    (plan,) = [plan for plan in answer["plans"] if plan["recommended"]]
    wanted = 60 * ((plan["high"] - 7) / 0.2) ** 2
    (note,) = [note for note in answer["notes"] if "needs about" in note]
    number = note.split("needs about ")[1].split()[0]
    assert int(number) == pytest.approx(wanted, rel=0.051)


def test_every_question_on_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--false-calls-per-m2", "1", "--board-m2", "0.25", "--unit", "furlong"]
    assert main([*TOLD, *FEW, "--studies", "10", *options]) == 0
    printed = capsys.readouterr().out
    assert "count as 8 targets" in printed
    assert "a90/95 (furlong)" in printed
    assert "needs at least 4 hole-free boards of 0.25 m2" in printed
    assert "no false call may occur on 2.996 m2, which is 12 other boards" in printed
    assert printed.rstrip().splitlines()[-1].startswith("Make 60 targets, ")
    assert next(line for line in printed.splitlines() if line.startswith("* ")).split()[1] == "60"


def test_files_are_repeatable_and_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("a", "b"):
        assert main([*TOLD, *FEW, "--studies", "10", "--out", str(tmp_path / folder)]) == 0
    assert "design.png" in capsys.readouterr().out
    first = [(tmp_path / "a" / name).read_bytes() for name in FILES]
    second = [(tmp_path / "b" / name).read_bytes() for name in FILES]
    assert first[1] == second[1]
    assert first[1].startswith(b"\x89PNG")
    page = first[2].decode()
    second_page = second[2].decode()
    assert page.replace(str(tmp_path / "a"), str(tmp_path / "b")) == second_page
    assert page.count("<details") == 2
    assert "Make 60 targets" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    data = json.loads(first[0])
    assert " ".join(f"{size:.4g}" for size in data["plans"][1]["sizes"]) in page


def test_no_limit_at_all_is_said_and_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A curve far wider than the sizes: most studies demonstrate nothing."""
    arguments = [
        "--a50",
        "6",
        "--a90",
        "40",
        "--sizes",
        "5:8",
        "--studies",
        "10",
        "--targets",
        "60",
    ]
    assert main([*arguments, "--out", str(tmp_path)]) == 0
    assert "even then, most studies would demonstrate no a90/95" in capsys.readouterr().out
    data = json.loads((tmp_path / "design.json").read_text())
    assert data["plans"][0]["bound"] is None
    assert any("outside the range" in note for note in data["notes"])


@pytest.mark.usefixtures("unsaved")
def test_the_guess_from_a_study(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--study", str(study), "--set-up", "50 frames", "--studies", "10", "--targets", "60"]
    options = ["--false-calls-per-m2", "1"]
    answer = answered(capsys, *asked, *options)
    record = study_record(
        Study(set_ups=(SetUp(frames=1), SetUp(frames=50, a50_mm=4.0)), boards=30)
    ).set_ups[1]
    limit = limit_of(record)
    assert answer["guess"]["a50"] == pytest.approx(limit.a50_mm, rel=1e-12)
    assert answer["guess"]["a90"] == pytest.approx(limit.a90_mm, rel=1e-12)
    assert answer["range_of_sizes"] == [
        record.inspected.diameter_mm.min(),
        record.inspected.diameter_mm.max(),
    ]
    assert answer["hole_free"]["board_m2"] == AREA_M2
    assert answer["guess"]["origin"] == "fitted to synthetic, 50 frames"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--a50", "7", "--a90", "5", "--sizes", "2:12"], "0 < a50 < a90"),
        (["--a50", "5", "--a90", "5", "--sizes", "2:12"], "must grow with size"),
        (["--a50", "nan", "--a90", "5", "--sizes", "2:12"], "--a50 nan: is not a size"),
        (["--a50", "5", "--a90", "7", "--sizes", "12:2"], "FROM < TO"),
        (["--a50", "5", "--a90", "7", "--sizes", "6:12"], "do not include a50 = 5"),
        (["--a50", "5", "--a90", "7", "--sizes", "0:12", "--log"], "FROM above 0"),
        (["--a90", "7"], "--a50, --sizes: not stated"),
        ([*TOLD, "--targets", "60", "9"], "--targets 9"),
        ([*TOLD, "--targets", "20000"], "10 to 10000"),
        ([*TOLD, "--studies", "1"], "--studies 1"),
        ([*TOLD, "--studies", "100000000"], "10 to 100000"),
        ([*TOLD, "--goal", "6.5"], "not above the guess's own 7"),
        ([*TOLD, "--set-up", "main"], "--set-up belongs to --study"),
        ([*TOLD, "--false-calls-per-m2", "1"], "needs --board-m2"),
        ([*TOLD, "--false-calls-per-m2", "-1", "--board-m2", "1"], "both above 0"),
        (["--study", "nowhere", "--a50", "5"], "leave one out: --a50 or --study"),
        (["--study", "nowhere/at/all"], "nowhere/at/all"),
    ],
)
def test_mistakes(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.startswith("error: ")
    assert printed.err.count("error") == 1
    assert printed.out == ""
    assert not (tmp_path / "out").exists()


def test_an_unknown_set_up(study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--study", str(study), "--set-up", "50 frame"]) == 2
    message = capsys.readouterr().err
    assert "did you mean '50 frames'?" in message
    assert "legal: 1 frame; 50 frames" in message
    assert main(["--study", str(study)]) == 2
    assert "has 2 set-ups" in capsys.readouterr().err


def test_a_study_whose_sizes_do_not_hold_the_curve_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = study_record(
        Study((SetUp(a50_mm=3.0, width_mm=1.5),), boards=30, sizes_mm=(4.0, 14.0))
    )
    (tmp_path / "study.json").write_text(record_text(record))
    assert main(["--study", str(tmp_path)]) == 2
    assert "sizes of 4 to 14 do not include a50" in capsys.readouterr().err


def test_a_study_without_a_curve(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record = study_record(Study(boards=5, set_ups=(SetUp(a50_mm=-50.0),)))
    (tmp_path / "study.json").write_text(record_text(record))
    assert main(["--study", str(tmp_path)]) == 2
    assert "has no curve" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert main([*TOLD, "--studies", "10", "--targets", "10", "--out", str(tmp_path / "file")]) == 2
    assert "cannot be written" in capsys.readouterr().err
