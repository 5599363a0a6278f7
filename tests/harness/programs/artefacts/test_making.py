"""Artefacts are made again if they are older, and only then; documents say what is older."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.programs.artefacts import declaration, ledger, making
from harness.programs.artefacts.artefacts import main
from harness.programs.artefacts.ledger import read_ledger
from harness.programs.artefacts.quoted import quoted_in
from harness.vocabulary import code_digests as digests_module
from harness.vocabulary import provenance

DECLARED = """
artefacts:
  numbers:
    about: two numbers
    documents: [docs/page.md]
    commands: ['python make.py']
    rows: [results/made/latest/limits.csv]
    table:
      labels: {camera: "{camera!t}", damage: "{damage!k}", beside: "{beside!r}", after: "{after!s}"}
      across: {column: frames, head: "frames: {:g}"}
      cells: {a90: "{a90_mm:.1f} mm"}
      absent: none
    inputs: [code.py]
    seconds: 3
  copy:
    about: a copy of them
    documents: [docs/page.md]
    commands: ['python -c "print(1)"']
    stores: {docs/copy.csv: results/made/latest/limits.csv}
    of: [numbers]
  person:
    about: what a person measured
    documents: [docs/page.md]
    by_hand: true
    commands: ['python measure.py']
    rows: [results/times/times.csv]
    table:
      labels: {experiment: "{experiment}"}
      cells: {seconds: "{seconds:.1f}"}
    inputs: [code.py]
"""
MAKE = """
from pathlib import Path
out = Path("results/made/latest")
out.mkdir(parents=True, exist_ok=True)
rows = ["camera,frames,a90_mm,damage,beside,after"]
beside = '"{""kind"": ""good_parts"", ""parts"": 5}"'
after = '"{""kind"": ""made"", ""shape"": {""kind"": ""flat"", ""side_mm"": 2}}"'
for frames, a90_mm in ((1, "4.04"), (50, "")):
    rows.append(f'kinect_v2,{frames},{a90_mm},"{{""kind"": ""blind""}}",{beside},{after}')
(out / "limits.csv").write_text("\\n".join(rows) + "\\n")
with Path("count").open("a") as count:
    count.write("1")
"""
PAGE = """A page.

<!-- artefact: numbers -->
<!-- end: numbers -->
<!-- artefact: copy -->
<!-- end: copy -->
<!-- artefact: person -->
<!-- end: person -->
The end.
"""
TABLE = """| camera | damage | beside | after | a90, frames: 1 | a90, frames: 50 |
|---|---|---|---|---|---|
| Kinect v2 | blind | 5 good parts | flat board | 4.0 mm | none |"""
MEASURED = """| experiment | seconds |
|---|---|
| averaging | 12.3 |"""
CACHED = (
    declaration.declared_artefacts,
    declaration._command_digests,
    provenance.first_content,
    provenance.reached_sources,
    provenance.imported_sources,
    digests_module._syntax_digest,
)


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs/page.md").write_text(PAGE)
    (tmp_path / "make.py").write_text(MAKE)
    (tmp_path / "code.py").write_text("K = 1\n")
    (tmp_path / "artefacts.yaml").write_text(DECLARED)
    monkeypatch.setattr(declaration, "FILE", tmp_path / "artefacts.yaml")
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    monkeypatch.setattr(ledger, "ledger_path", lambda: tmp_path / "artefacts.json")
    forget()
    yield tmp_path
    forget()


def measure_by_hand(checkout: Path) -> None:
    """As a person does."""
    times = checkout / "results/times/times.csv"
    times.parent.mkdir(parents=True)
    times.write_text("experiment,seconds,load\naveraging,12.34,1\n")


def forget() -> None:
    """As another process begins."""
    for cached in CACHED:
        cached.cache_clear()


def run(*arguments: str, code: int = 0) -> None:
    forget()
    assert main([*arguments]) == code


def page(checkout: Path) -> dict[str, str]:
    """What the page quotes, by artefact."""
    quoted = quoted_in((checkout / "docs/page.md").read_text())
    return {name: text.strip() for name, text in quoted}


def times_made(checkout: Path) -> int:
    return len((checkout / "count").read_text())


def test_what_is_current_is_not_made_again(checkout: Path, capsys: pytest.CaptureFixture[str]):
    run()
    assert page(checkout) == {"numbers": TABLE, "copy": "", "person": "*Not yet computed.*"}
    assert (checkout / "docs/copy.csv").is_file()
    assert "2 of 3 artefacts are to be made, in about 0 min" in capsys.readouterr().out
    run()
    assert times_made(checkout) == 1
    assert "0 of 3" in capsys.readouterr().out
    assert read_ledger()["numbers"].seconds is not None

    (checkout / "code.py").write_text("K = 1  # a reason\n")
    run()
    assert times_made(checkout) == 1


def test_a_change_of_code_is_said_and_then_repaired(checkout: Path):
    run()
    measure_by_hand(checkout)
    run("--made", "person")
    assert page(checkout)["person"] == MEASURED
    (checkout / "code.py").write_text("K = 2\n")
    run("--ages")
    assert times_made(checkout) == 1
    older = page(checkout)
    assert older["numbers"].startswith(TABLE)
    for text in older.values():
        assert "*Older than the code: computed on 20" in text

    run()
    assert times_made(checkout) == 2
    now = page(checkout)
    assert now["numbers"] == TABLE and now["copy"] == ""
    assert "Older" in now["person"]  # no command makes it


def test_one_alone(checkout: Path, capsys: pytest.CaptureFixture[str]):
    run("--only", "numbers")
    assert page(checkout)["numbers"] == TABLE
    assert "Not yet" in page(checkout)["copy"]
    run("--only", "numbres", code=2)
    assert "did you mean 'numbers'?" in capsys.readouterr().err
    run("--only", "person", code=2)
    assert "person: is made by hand" in capsys.readouterr().err


def test_what_a_person_measured_is_stored(checkout: Path, capsys: pytest.CaptureFixture[str]):
    run("--made", "person", code=2)
    error = capsys.readouterr().err
    assert "person: results/times/times.csv is absent" in error
    assert "python measure.py" in error
    assert not (checkout / "artefacts.json").exists()
    measure_by_hand(checkout)
    run("--made", "person")
    assert page(checkout)["person"] == MEASURED
    stored = (checkout / "results/baselines/tables/person.csv").read_text()
    assert stored == "experiment,seconds\naveraging,12.34\n"


def test_a_file_that_was_edited_is_made_again(checkout: Path):
    run()
    (checkout / "docs/copy.csv").write_text("1")
    assert ledger.edited_files("copy", read_ledger()) == ["docs/copy.csv"]
    run()
    assert (checkout / "docs/copy.csv").read_text().startswith("camera")
    assert ledger.edited_files("copy", read_ledger()) == []


def test_what_is_made_of_another_follows_it(checkout: Path, capsys: pytest.CaptureFixture[str]):
    run()
    (checkout / "code.py").write_text("K = 2\n")
    (checkout / "make.py").write_text(MAKE.replace("4.04", "5.05"))
    run("--only", "copy")
    assert "0 of 1" in capsys.readouterr().out  # it would be as old as before
    run("--only", "numbers")
    assert "older" in page(checkout)["copy"].lower()
    run("--only", "copy")
    assert "5.05" in (checkout / "docs/copy.csv").read_text()
    assert page(checkout)["copy"] == ""

    (checkout / "code.py").write_text("K = 3\n")
    (checkout / "make.py").write_text(MAKE.replace("4.04", "6.06"))
    run()
    assert "6.06" in (checkout / "docs/copy.csv").read_text()


def test_a_quick_run_says_so_and_a_whole_one_replaces_it(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(making, "SWEEP", ["python", "make.py"])
    run("--quick")
    quick = page(checkout)
    assert "*From a quick run: fewer boards" in quick["numbers"]
    assert "*From a quick run: fewer boards" in quick["copy"]  # made of it
    assert read_ledger()["copy"].quick is False  # its own command has no quick form
    run("--quick")
    assert times_made(checkout) == 1
    run()
    assert times_made(checkout) == 2
    assert page(checkout)["numbers"] == TABLE
    assert page(checkout)["copy"] == ""


def test_a_quick_run_of_a_sweep_keeps_all_its_set_ups() -> None:
    """Documents quote them by name; a first look by hand leaves some out."""
    file = provenance.ROOT / "experiments" / "today.yaml"
    _, sweep = making._with_all_set_ups("experiments/today.yaml")
    complete = load_experiment(file, [sweep], quick=True).config
    assert complete.sweep == load_experiment(file).config.sweep
    assert complete.sweep != load_experiment(file, quick=True).config.sweep


def test_what_fails_is_named_and_the_rest_is_made(
    checkout: Path, capsys: pytest.CaptureFixture[str]
):
    text = DECLARED.replace('python -c "print(1)"', 'python -c "exit(3)"')
    (checkout / "artefacts.yaml").write_text(text)
    run(code=1)
    errors = capsys.readouterr().err
    assert "ended with exit code 3" in errors and "not made: copy" in errors
    assert set(read_ledger()) == {"numbers"}


def test_what_a_command_needs_must_be_there(checkout: Path, capsys: pytest.CaptureFixture[str]):
    text = DECLARED.replace("    of: [numbers]", "    of: [numbers]\n    needs: [no_such_browser]")
    (checkout / "artefacts.yaml").write_text(text)
    run(code=1)
    assert "needs no_such_browser, which is not here" in capsys.readouterr().err


def test_a_run_that_is_killed_goes_on(checkout: Path, monkeypatch: pytest.MonkeyPatch):
    text = DECLARED.replace('python -c "print(1)"', 'python -c "exit(130)"')
    (checkout / "artefacts.yaml").write_text(text)
    run(code=130)
    (checkout / "artefacts.yaml").write_text(DECLARED)
    run()
    assert times_made(checkout) == 1
    assert set(read_ledger()) == {"numbers", "copy"}


def test_an_answer_made_before_there_were_digests_is_older(checkout: Path):
    run()
    stored = json.loads((checkout / "artefacts.json").read_text())
    stored["numbers"] |= {"digests": None, "made": "2026-11-21", "tofpod": None}
    (checkout / "artefacts.json").write_text(json.dumps(stored))
    run("--ages")
    assert page(checkout)["numbers"].endswith("*Older than the code: computed on 2026-11-21.*")
    assert "Older" in page(checkout)["copy"]  # made of it


def test_a_table_of_which_a_column_is_missing_is_a_mistake(
    checkout: Path, capsys: pytest.CaptureFixture[str]
):
    (checkout / "make.py").write_text(MAKE.replace("a90_mm", "a91_mm"))
    run(code=1)
    assert "has no column a90_mm" in capsys.readouterr().err
