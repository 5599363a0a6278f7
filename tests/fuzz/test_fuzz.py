"""A sample of the malformed inputs, and what the run counts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.__main__ import table
from tests.fuzz.cases import CASES, Case, Input, prepared
from tests.fuzz.mutations import spoiled
from tests.fuzz.trying import End, run_one
from tests.support import recorded_plane as plane

SAMPLE = 12


@pytest.fixture(autouse=True)
def enough_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow machine must not stop an input that a run of the whole campaign would finish."""
    monkeypatch.setattr("tests.fuzz.trying.SECONDS", 600.0)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two captures and a lens, as `tests.fuzz.bases` writes them."""
    folder = tmp_path_factory.mktemp("fuzz") / "bases"
    plane.write_open3d_folder(folder / "pngs", 2, noise_mm=0.6)
    (folder / "depth").mkdir()
    np.save(folder / "depth" / "depth.npy", plane.depth_mm(noise_mm=0.6))
    plane.write_lens(folder / "depth" / "intrinsics.json")
    return folder


def sample_cases() -> tuple[Case, ...]:
    folders = {"pngs", "depth"}
    return tuple(case for case in CASES if case.folders and folders.issuperset(case.folders))


@pytest.mark.parametrize("number", range(SAMPLE))
def test_malformed_captures_end_without_a_traceback(
    base: Path, number: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tests.fuzz.cases.CASES", sample_cases())
    end = run_one(prepared(base, number, seed=2))
    assert end.state in ("refused", "answered"), end.text


def test_an_input_depends_on_its_number_and_seed_only(base: Path, monkeypatch):
    monkeypatch.setattr("tests.fuzz.cases.CASES", sample_cases())

    def content(given: Input) -> dict[str, bytes]:
        files = [path for path in given.folder.rglob("*") if path.is_file()]
        return {str(path.relative_to(given.folder)): path.read_bytes() for path in files}

    first = prepared(base, 3, seed=2)
    before = content(first)
    again = prepared(base, 3, seed=2)
    assert (again.words, content(again)) == (first.words, before)
    contents = [content(prepared(base, 3, seed=seed)) for seed in range(3, 8)]
    assert any(content_of_seed != before for content_of_seed in contents)


def test_a_bug_counts_as_a_traceback(base: Path, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    refused = run_one(Input(1, "detect", ("nowhere",), base))
    assert refused.state == "refused"
    monkeypatch.setattr("harness.inspection.run.inspected", broken)
    end = run_one(Input(0, "detect", ("pngs",), base))
    assert end.state == "traceback" and "ZeroDivisionError" in end.text


@pytest.mark.parametrize("name", ["a.json", "a.yaml", "a.npy", "a.npz", "a.csv", "a.bin"])
def test_every_kind_of_file_gets_a_fault(tmp_path: Path, name: str):
    array = np.arange(60.0).reshape(6, 10)
    path = tmp_path / name
    contents = set()
    for seed in range(20):
        if path.suffix == ".npy":
            np.save(path, array)
        elif path.suffix == ".npz":
            np.savez(path, depth=array)
        elif path.suffix == ".csv":
            path.write_text("size,found\n1,0\n2,1\n")
        else:
            path.write_text(json.dumps({"a": [1, 2.5, "b"], "c": {"d": None}}))
        before = path.read_bytes()
        spoiled(path, np.random.default_rng(seed))
        contents.add(path.read_bytes() != before)
    assert True in contents


def test_the_table_counts_by_program():
    ends = [End("ask", 0, "refused", (), ""), End("ask", 1, "traceback", (), "")]
    ends.append(End("pod", 2, "answered", (), ""))
    rows = [line.split() for line in table(ends).splitlines()]
    assert rows[1] == ["ask", "2", "1", "0", "0", "1"]
    assert rows[-1] == ["all", "3", "1", "1", "0", "1"]


def test_every_case_names_files_that_may_get_a_fault():
    for case in CASES:
        folders = set(case.folders)
        assert all(pattern.split("/")[0].rstrip("?") in folders for pattern in case.files), case
