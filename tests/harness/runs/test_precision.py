"""Studies with a stated precision: the same boards however they are run, and an honest end."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from harness.evaluation.study.record import read_record
from harness.evaluation.study.sequential import FIRST_BOARDS
from harness.experiment.load import load_experiment
from harness.programs.gate import check
from harness.runs.estimate import first_work
from harness.runs.journal import DESIGNS, Journal
from harness.runs.plan import plan_of
from harness.runs.precision import recorded_designs
from harness.runs.shards import Shard
from harness.vocabulary.declaration.yaml_source import DeclarationError
from tests.support.tiny_sweep import STUDY, content, results, sweep

PRECISE = STUDY.replace(
    "study: {boards: 4, hole_free_boards: 3}",
    "study: {boards: 11, hole_free_boards: 3, precision: {a90_mm: 0.05}}",
)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A study in one go, in this process; the folder with its YAML."""
    home = tmp_path_factory.mktemp("precise")
    (home / "tiny.yaml").write_text(PRECISE)
    done = sweep(home / "tiny.yaml", home / "out", "--serial")
    assert done.returncode == 0, done.stderr
    (home / "shown.txt").write_text(done.stdout)
    return home


def run_again(whole: Path, tmp_path: Path, *arguments: str) -> Path:
    """Run the same study in another folder, from the same renders and any journal there; the
    folder of its results."""
    shutil.copytree(whole / "out" / ".cache", tmp_path / "out" / ".cache")
    done = sweep(whole / "tiny.yaml", tmp_path / "out", *arguments)
    assert done.returncode == 0, done.stderr
    return results(tmp_path / "out")


def test_the_record_states_the_boards_and_why_there_are_no_more(whole):
    study = read_record(results(whole / "out"))
    (design,) = study.designs
    assert design.boards == 11
    assert not design.is_reached
    assert "all 11 boards" in design.reason
    for set_up in study.set_ups:
        inspected = set_up.inspected
        assert set_up.sizes_chosen
        for board in range(FIRST_BOARDS, 11):
            sizes_mm = inspected.diameter_mm[inspected.board == board].tolist()
            assert sizes_mm == pytest.approx(design.sizes_mm(board))


def test_page_and_terminal_state_the_precision(whole):
    page = (results(whole / "out") / "report.html").read_text()
    assert "a90 wanted to 0.05 mm, not reached with 11 boards" in page
    assert page.count("No more boards: all 11 boards that are allowed were used") == 1
    shown = (whole / "shown.txt").read_text()
    assert "at most 0.05 mm wide" in shown
    assert "No more boards: all 11 boards that are allowed were used" in shown


def test_processes_give_the_same_numbers(whole, tmp_path):
    again = run_again(whole, tmp_path, "--jobs", "2")
    assert content(again) == content(results(whole / "out"))


def test_it_resumes_to_the_same_boards(whole, tmp_path):
    """With the trials of half of the journal, and without any of the last batches' sizes."""
    before = results(whole / "out")
    there = Journal(before / "journal")
    keys = [key for key, _ in there.entries()]
    part = Journal(tmp_path / "out" / "tiny" / before.name / "journal")
    for key in keys[: len(keys) // 2]:
        entry = there.read(key)
        assert entry is not None
        part.write(key, entry)
    again = run_again(whole, tmp_path, "--serial")
    assert content(again) == content(before)


def test_a_resumed_study_takes_its_boards_from_the_journal(whole, tmp_path):
    """Sizes that were stored are used, whatever would be chosen today."""
    before = results(whole / "out")
    folder = tmp_path / "out" / "tiny" / before.name
    shutil.copytree(before / "journal", folder / "journal")
    journal = Journal(folder / "journal")
    last = sorted(key for key, _ in journal.entries() if key.startswith(DESIGNS))[-1]
    entry = journal.read(last)
    assert entry is not None
    assert entry.record is not None
    stored = {**entry.record, "reason": "as stored"}
    journal.write(last, type(entry)("done", json.dumps(stored)))
    again = run_again(whole, tmp_path, "--serial")
    (design,) = read_record(again).designs
    assert design.reason == "as stored"


def test_a_plan_from_the_record_shows_the_same_boards(whole):
    folder = results(whole / "out")
    experiment = load_experiment(whole / "tiny.yaml")
    study = read_record(folder)
    cache = whole / "out" / ".cache" / "renders"
    plan = plan_of(experiment, cache, designs=recorded_designs(experiment, study))
    assert all(render.path.exists() for render in plan.renders)
    unlike = plan_of(experiment, cache)
    assert not all(render.path.exists() for render in unlike.renders)


def test_shards_are_refused(whole, tmp_path, capsys):
    done = sweep(whole / "tiny.yaml", tmp_path, "--shard", "1/2")
    assert done.returncode == 2
    assert "--shard 1/2: the sizes of a study with a precision follow from" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_check_is_refused(whole, tmp_path, capsys):
    assert check.main([str(whole / "tiny.yaml"), "--out", str(tmp_path)]) == 2
    assert "study.precision=null" in capsys.readouterr().err


def test_a_dry_run_says_what_is_expected_and_at_most(whole, tmp_path):
    shown = sweep(whole / "tiny.yaml", tmp_path, "--dry-run").stdout
    counted = re.search(r"renders: (\d+) at most, 0 of them cached\n  trials: (\d+) at most", shown)
    assert counted is not None
    assert re.search(r"expected from nothing: .* idle cores, at most \d", shown)
    # the first boards, and with them the expectation, are fewer than those at most
    experiment = load_experiment(whole / "tiny.yaml")
    first = first_work(experiment, Journal(tmp_path / "none"), tmp_path, Shard())
    assert first is not None and 0 < first.trials < int(counted[2])


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ("study.precision={}", "give either `a90_mm` or `a90_percent`"),
        ("study.precision={a90_mm: 0.2, a90_percent: 5.0}", "give either `a90_mm` or"),
        ("study.precision={a90_mm: -1.0}", "study.precision.a90_mm"),
        ("study.precision={a90: 0.2}", "a90_mm"),
        ("study.boards=9", "9 boards are too few for a precision"),
        ("source.target.damage.diameter_mm=[5.0, 5.0]", "all damages have a diameter of 5 mm"),
        (
            "unknowns=[{key: source.target.distance_m, range: [0.6, 0.8], reason: Not known.}]",
            "cannot draw unknowns",
        ),
        ("sweep={study.precision.a90_mm: [0.1, 0.2]}", "the same for all points"),
    ],
)
def test_bad_values_get_one_clear_message(tmp_path, changed, expected):
    (tmp_path / "tiny.yaml").write_text(PRECISE)
    with pytest.raises(DeclarationError) as message:
        load_experiment(tmp_path / "tiny.yaml", [changed])
    assert expected in str(message.value)
    assert len(message.value.problems) == 1


def test_a_first_look_keeps_enough_boards(tmp_path):
    (tmp_path / "tiny.yaml").write_text(PRECISE)
    study = load_experiment(tmp_path / "tiny.yaml", quick=True).config.study
    assert study is not None
    assert study.boards == 10


def test_a_study_without_a_precision_keeps_its_digest(tmp_path):
    (tmp_path / "tiny.yaml").write_text(STUDY)
    plain = load_experiment(tmp_path / "tiny.yaml")
    null = load_experiment(tmp_path / "tiny.yaml", ["study.precision=null"])
    precise = load_experiment(
        tmp_path / "tiny.yaml", ["study.boards=10", "study.precision={a90_mm: 0.2}"]
    )
    assert plain.digest == null.digest
    assert precise.digest not in (
        plain.digest,
        load_experiment(tmp_path / "tiny.yaml", ["study.boards=10"]).digest,
    )
