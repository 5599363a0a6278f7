"""Keys change with the sources that a stage reaches, and with no others."""

from __future__ import annotations

from pathlib import Path

import pytest

from harness.vocabulary import provenance
from harness.vocabulary.provenance import reached_sources, source_digest

FILES = {
    "harness/__init__.py": "",
    "harness/trial.py": "import numpy\nfrom harness.trials import (\n    judge,  # why\n)\n",
    "harness/page.py": "from harness.trial import run\n",
    "harness/trials/__init__.py": "",
    "harness/trials/judge.py": (
        "def run():\n    from scenes.board import Board\n    import detectors.methods.thesis as t\n"
    ),
    "harness/trials/other.py": "",
    "scenes/__init__.py": "",
    "scenes/board.py": "class Board: ...\n",
    "detectors/__init__.py": "",
    "detectors/methods/__init__.py": "",
    "detectors/methods/thesis.py": "",
    "detectors/blind.py": "",
}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    return tmp_path


def forget() -> None:
    for cached in (
        reached_sources,
        provenance.imported_sources,
        source_digest,
        provenance.first_content,
    ):
        cached.cache_clear()


def fresh(*modules: str) -> str:
    forget()
    try:
        return source_digest(modules, ("numpy",))
    finally:
        forget()


def test_what_a_module_reaches_counts_and_nothing_else(project: Path) -> None:
    before = fresh("harness.trial")
    reached = {path.relative_to(project).as_posix() for path in reached_sources(("harness.trial",))}
    forget()
    assert reached == set(FILES) - {
        "harness/page.py",
        "harness/trials/other.py",
        "detectors/blind.py",
    }
    for name in FILES:
        path = project / name
        path.write_text(FILES[name] + "# a comment\n")
        assert (fresh("harness.trial") != before) == (name in reached), name
        path.write_text(FILES[name])
    assert fresh("harness.trial") == before


def test_every_source_of_a_plug_ins_package_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "strange_detector"
    package.mkdir()
    (package / "__init__.py").write_text("")
    inner = package / "inner.py"
    inner.write_text("K = 5\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    before = fresh("strange_detector.main")
    inner.write_text("K = 6\n")
    assert fresh("strange_detector.main") != before
    inner.write_text("K = 5\n")
    assert fresh("strange_detector.main") == before


def test_a_trial_reaches_what_it_runs_and_not_what_evaluates_or_draws() -> None:
    from harness.runs.plan import trial_code

    names = {
        path.relative_to(provenance.ROOT).as_posix()
        for path in reached_sources(trial_code("thesis"))
    }
    assert {
        "detectors/methods/thesis.py",
        "detectors/averages/average.py",
        "scenes/sensor/amcw/imager.py",
    } <= names
    assert {
        "harness/trials/trial.py",
        "harness/evaluation/match.py",
        "detectors/views/registration/by_points.py",
    } <= names
    assert not [
        name for name in names if name.startswith(("harness/report/", "harness/evaluation/pod/"))
    ]


def test_a_source_that_is_edited_stays_what_this_process_has_loaded(project: Path) -> None:
    """So that a worker that reads the edited source, or has loaded it, is found out whatever is
    asked later."""
    forget()
    before = source_digest(("harness.trial",), ("numpy",))
    (project / "harness" / "trials" / "judge.py").write_text("K = 5\n")
    source_digest.cache_clear()
    assert source_digest(("harness.trial",), ("numpy",)) == before != fresh("harness.trial")
