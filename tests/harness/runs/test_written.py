"""A finished run shows its results again, unless anything that they hang on has changed."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.runs import written as written_module
from harness.runs.jobs import Failure, Outcome
from harness.runs.written import Written, origin_of
from harness.vocabulary.text import Cell, Grid

SHOWN = [
    "warning: few boards",
    Grid.of(("set-up", "a90 (mm)"), [["thesis", Cell("3.9", tone="good", share=0.5)]], title="t"),
    "",
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "limits.csv").write_text("a90_mm\n3.9\n")
    (tmp_path / ".lock").touch()
    (tmp_path / "journal").mkdir()
    Written(tmp_path, "as it was").store(SHOWN)
    return tmp_path


def test_what_was_shown_is_shown_again(folder: Path) -> None:
    assert Written(folder, "as it was").shown_again(Outcome()) == SHOWN
    (folder / "compare.json").write_text("{}")  # another program's file
    (folder / ".lock").unlink()
    assert Written(folder, "as it was").shown_again(Outcome()) == SHOWN


def test_a_run_that_did_something_or_hangs_on_something_else_writes_anew(folder: Path) -> None:
    results = Written(folder, "as it was")
    assert Written(folder, "otherwise").shown_again(Outcome()) is None
    rendered = Outcome()
    rendered.renders.done = 1
    judged = Outcome()
    judged.trials.done = 1
    failed = Outcome(failures=[Failure("trial 3", "why")])
    for outcome in (rendered, judged, failed):
        assert results.shown_again(outcome) is None


@pytest.mark.parametrize("content", ["a90_mm\n3.8\n", None])
def test_a_file_that_was_changed_or_removed_is_written_anew(
    folder: Path, content: str | None
) -> None:
    (folder / "limits.csv").unlink()
    if content is not None:
        (folder / "limits.csv").write_text(content)
    assert Written(folder, "as it was").shown_again(Outcome()) is None


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"origin": "as it was", "files": 3}'])
def test_without_its_own_record_everything_is_written_anew(
    folder: Path, content: str | None
) -> None:
    (folder / "written.json").unlink()
    if content is not None:
        (folder / "written.json").write_text(content)
    assert Written(folder, "as it was").shown_again(Outcome()) is None


def test_results_hang_on_trials_thresholds_experiment_numbers_code_and_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = Outcome(finished=["b", "a"], thresholds={"point": 4.5})
    digests = {"scenes": "1"}
    before = origin_of(outcome, "name: x\n", digests)
    again = Outcome(finished=["a", "b"], thresholds={"point": 4.5})
    assert origin_of(again, "name: x\n", digests) == before

    fewer = Outcome(finished=["a"], thresholds={"point": 4.5})
    other_threshold = Outcome(finished=["a", "b"], thresholds={"point": 4.6})
    assert origin_of(fewer, "name: x\n", digests) != before
    assert origin_of(other_threshold, "name: x\n", digests) != before
    assert origin_of(again, "name: y\n", digests) != before
    assert origin_of(again, "name: x\n", {"scenes": "2"}) != before
    with monkeypatch.context() as patched:
        patched.setattr(written_module, "source_digest", lambda *_: "another")
        assert origin_of(again, "name: x\n", digests) != before
    (tmp_path / "page.html").touch()
    monkeypatch.setattr(written_module, "PAGES", tmp_path)
    assert origin_of(again, "name: x\n", digests) != before
