"""A digest of code changes with what decides a number, and with nothing else."""

from __future__ import annotations

import ast
from pathlib import Path
from types import SimpleNamespace

import pytest

from harness.vocabulary import code_digests as digests_module
from harness.vocabulary import provenance
from harness.vocabulary.code_digests import (
    changed_parts,
    code_digests,
    file_digests,
    remembered,
)
from harness.vocabulary.files import strict_json

FILES = {
    "harness/__init__.py": "",
    "harness/trials/__init__.py": "",
    "harness/trials/trial.py": (
        '"""A trial."""\n'
        "from detectors.methods import thesis\n"
        "from harness.report import page\n"
        "K = 5  # a reason\n\n\n"
        'def judge(x):\n    """Judge."""\n    return (x + K) > 0\n'
    ),
    "harness/report/__init__.py": "",
    "harness/report/page.py": "WIDTH = 3\n",
    "detectors/__init__.py": "",
    "detectors/methods/__init__.py": "",
    "detectors/methods/thesis.py": "K = 2.6\n",
    "detectors/methods/local.py": "K = 7\n",
}
TRIAL = "harness/trials/trial.py"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    yield tmp_path
    forget()


def forget() -> None:
    digests_module._known.clear()
    for cached in (
        provenance.reached_sources,
        provenance.imported_sources,
        provenance.first_content,
        digests_module._syntax_digest,
    ):
        cached.cache_clear()


def fresh() -> dict[str, str]:
    forget()
    return code_digests(["harness.trials.trial"])


def changed(project: Path, name: str, old: str, new: str) -> list[str]:
    """The parts that a replacement in a file changes."""
    before = fresh()
    path = project / name
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    after = fresh()
    path.write_text(text)
    return changed_parts(before, after)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# a reason", "# another reason"),
        ('"""Judge."""', '"""Return whether x lies above -K."""'),
        ('"""A trial."""\n', '"""One trial\nof many."""\n'),
        ("\n\n\ndef", "\n\ndef"),
        ("return (x + K) > 0", "return x + K > 0"),
        ("judge(x):", "judge(\n    x,\n):"),
    ],
)
def test_comments_docstrings_and_layout_age_nothing(project: Path, old: str, new: str):
    assert changed(project, TRIAL, old, new) == []


@pytest.mark.parametrize(
    ("name", "old", "new", "room"),
    [
        (TRIAL, "K = 5", "K = 6", "harness/trials"),
        (TRIAL, "x + K", "x - K", "harness/trials"),
        (TRIAL, "> 0", ">= 0", "harness/trials"),
        ("detectors/methods/thesis.py", "2.6", "2.5", "detectors/methods"),
    ],
)
def test_every_number_and_sign_ages_its_room(
    project: Path, name: str, old: str, new: str, room: str
):
    assert changed(project, name, old, new) == [room]


def test_pages_and_what_is_not_reached_age_nothing(project: Path):
    assert changed(project, "harness/report/page.py", "3", "4") == []
    assert changed(project, "detectors/methods/local.py", "7", "8") == []
    assert set(fresh()) == {"harness/trials", "detectors", "detectors/methods"}


def test_files_count_by_their_content(project: Path):
    (project / "a.yaml").write_text("x: 1 # a comment\n")
    (project / "b.bin").write_bytes(b"\x00")
    first = file_digests(["a.yaml", "b.bin", "detectors", "gone"])
    assert first["gone"] == "absent"

    forget()
    (project / "a.yaml").write_text("x:   1\n")
    assert file_digests(["a.yaml", "b.bin", "detectors", "gone"]) == first

    forget()
    (project / "a.yaml").write_text("x: 2\n")
    (project / "b.bin").write_bytes(b"\x01")
    (project / "detectors/methods/local.py").write_text("K = 9\n")
    second = file_digests(["a.yaml", "b.bin", "detectors", "gone"])
    assert changed_parts(first, second) == ["a.yaml", "b.bin", "detectors"]


def test_a_part_that_is_new_or_gone_is_a_change():
    assert changed_parts({"a": "1", "b": "2"}, {"b": "2", "c": "3"}) == ["a", "c"]


def test_sources_that_a_file_remembers_are_not_parsed_again(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed = []

    def parse(content: bytes) -> ast.AST:
        parsed.append(content)
        return ast.parse(content)

    monkeypatch.setattr(digests_module, "ast", SimpleNamespace(**vars(ast) | {"parse": parse}))
    store = project / ".cache" / "sources.json"
    with remembered(store):
        first = fresh()
    assert len(parsed) == 3
    assert fresh() == first
    parsed.clear()
    forget()
    with remembered(store):
        assert code_digests(["harness.trials.trial"]) == first
    assert not parsed

    # a change is seen, and alone parsed
    (project / TRIAL).write_text(FILES[TRIAL].replace("K = 5", "K = 6"))
    forget()
    with remembered(store):
        assert changed_parts(first, code_digests(["harness.trials.trial"])) == ["harness/trials"]
    assert len(parsed) == 1


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"by": "another", "digests": 3}'])
def test_a_file_that_is_no_memory_does_not_count(project: Path, content: str | None) -> None:
    expected = fresh()
    store = project / "sources.json"
    if content is not None:
        store.write_text(content)
    forget()
    with remembered(store):
        assert code_digests(["harness.trials.trial"]) == expected
    assert len(strict_json(store.read_bytes())["digests"]) > 1
