"""The comparison of two folders of results notices every change but those that it declares."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests import compare_results

DIGEST = "0123456789abcdef"
OTHER_DIGEST = "fedcba9876543210"
PROVENANCE = {"command": "tofpod sweep smoke", "seed": 1, "seconds": {"renders": 2.5}}
TABLE = pd.DataFrame({"hole": [1, 2], "rate": [0.25, 1.0], "seconds_detect": [0.1, 0.2]})


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A folder of results with a file of each kind."""
    results = tmp_path / "old" / "results" / "smoke"
    folder = results / DIGEST
    folder.mkdir(parents=True)
    (results / "latest").symlink_to(DIGEST)
    TABLE.to_csv(folder / "summary.csv", index=False)
    TABLE.to_parquet(folder / "summary.parquet")
    (folder / "provenance.json").write_text(json.dumps(PROVENANCE))
    (folder / "report.html").write_text("<p>Found: 5 of 11</p>\n<p>end</p>\n")
    (folder / "picture.png").write_bytes(b"\x89PNG\x00\xff\x01")
    np.savez(folder / "map.npz", score=np.arange(6.0), mask=np.array([True, False]))
    return tmp_path / "old"


@pytest.fixture
def new(old: Path) -> Path:
    """A copy of these results."""
    return shutil.copytree(old, old.parent / "new", symlinks=True)


def results_in(folder: Path) -> Path:
    return folder / "results" / "smoke" / DIGEST


def differences_of(old: Path, new: Path) -> dict[str, list[str]]:
    """Return the differences, by the name of the file."""
    differences = compare_results.compare_folders(old, new).differences
    return {Path(path).name: lines for path, lines in differences.items()}


def change_table(folder: Path, table: pd.DataFrame) -> None:
    """Write a table as CSV and as Parquet."""
    table.to_csv(folder / "summary.csv", index=False)
    table.to_parquet(folder / "summary.parquet")


def change_json(folder: Path, **changed: object) -> None:
    (folder / "provenance.json").write_text(json.dumps({**PROVENANCE, **changed}))


def test_a_copy_is_equal(old: Path, new: Path) -> None:
    comparison = compare_results.compare_folders(old, new)
    assert comparison.differences == {}
    assert comparison.compared == comparison.equal_bytes == 6
    assert compare_results.main([str(old), str(new)]) == 0


def test_a_folder_is_matched_by_its_link_and_not_by_its_digest(old: Path, new: Path) -> None:
    results = new / "results" / "smoke"
    (results / DIGEST).rename(results / OTHER_DIGEST)
    (results / "latest").unlink()
    assert differences_of(old, new) != {}
    (results / "latest").symlink_to(OTHER_DIGEST)
    assert differences_of(old, new) == {}


def test_a_single_folder_needs_no_link(old: Path, new: Path) -> None:
    for folder in (old, new):
        (folder / "results" / "smoke" / "latest").unlink()
    results = new / "results" / "smoke"
    (results / DIGEST).rename(results / OTHER_DIGEST)
    assert differences_of(old, new) == {}


def test_a_digest_in_a_files_name_is_replaced_by_that_of_its_content(old: Path, new: Path) -> None:
    (results_in(old) / f"learning-00000-{DIGEST}.npz").write_bytes(b"spectrum")
    learned = results_in(new) / f"learning-00000-{OTHER_DIGEST}.npz"
    learned.write_bytes(b"spectrum")
    assert differences_of(old, new) == {}
    learned.write_bytes(b"another spectrum")
    assert len(differences_of(old, new)) == 2


def test_a_changed_value_is_listed_with_row_and_column(old: Path, new: Path) -> None:
    change_table(results_in(new), TABLE.assign(rate=[0.25, np.nextafter(1.0, 2.0)]))
    differences = differences_of(old, new)
    assert differences.keys() == {"summary.csv", "summary.parquet"}
    (line,) = differences["summary.parquet"]
    assert line.startswith("column rate: 1 of 2 rows differ, first row 1: '1.0' -> ")


def test_a_sign_of_zero_and_a_type_are_values(old: Path, new: Path) -> None:
    for folder, zero in ((old, 0.0), (new, -0.0)):
        TABLE.assign(rate=zero).to_parquet(results_in(folder) / "summary.parquet")
    assert differences_of(old, new).keys() == {"summary.parquet"}
    for folder, kind in ((old, "float64"), (new, "float32")):
        TABLE.astype({"rate": kind}).to_parquet(results_in(folder) / "summary.parquet")
    assert any("type of rate" in line for line in differences_of(old, new)["summary.parquet"])


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda table: pd.concat([table, table.tail(1)]), "2 rows became 3"),
        (lambda table: table.head(1), "2 rows became 1"),
        (lambda table: table.assign(more=1), "column more is additional"),
        (lambda table: table.drop(columns="rate"), "column rate is missing"),
        (lambda table: table[["rate", "hole", "seconds_detect"]], "the columns stand in another"),
    ],
    ids=["row added", "row lost", "column added", "column lost", "order of columns"],
)
def test_another_shape_of_a_table_is_noticed(
    old: Path, new: Path, change: Callable[[pd.DataFrame], pd.DataFrame], line: str
) -> None:
    change_table(results_in(new), change(TABLE).reset_index(drop=True))
    differences = differences_of(old, new)
    for name in ("summary.csv", "summary.parquet"):
        assert any(difference.startswith(line) for difference in differences[name])


def test_missing_and_additional_files_are_noticed(old: Path, new: Path) -> None:
    (results_in(new) / "picture.png").rename(results_in(new) / "image.png")
    assert differences_of(old, new) == {
        "picture.png": ["the file is missing"],
        "image.png": ["the file is additional"],
    }
    assert compare_results.main([str(old), str(new)]) == 1


def test_json_is_compared_by_key(old: Path, new: Path) -> None:
    change_json(results_in(new), seed=2, more=None)
    lines = differences_of(old, new)["provenance.json"]
    assert lines == ["key more is additional", "key seed: '1' -> '2'"]


def test_the_layout_of_json_counts(old: Path, new: Path) -> None:
    (results_in(new) / "provenance.json").write_text(json.dumps(PROVENANCE, indent=2))
    lines = differences_of(old, new)["provenance.json"]
    assert lines == ["the same values are written in other bytes"]


@pytest.mark.parametrize("name", ["report.html", "picture.png"])
def test_texts_and_pictures_are_compared_by_line(old: Path, new: Path, name: str) -> None:
    file = results_in(new) / name
    file.write_bytes(file.read_bytes().replace(b"5 of", b"6 of").replace(b"\x01", b"\x02"))
    (line,) = differences_of(old, new)[name]
    assert line.startswith("line ")


def test_an_element_of_an_array_is_noticed(old: Path, new: Path) -> None:
    score = np.arange(6.0)
    score[4] += 1e-12
    np.savez(results_in(new) / "map.npz", score=score, mask=np.array([True, False]))
    (line,) = differences_of(old, new)["map.npz"]
    assert line.startswith("array score: ")


def test_exceptions_cover_what_they_name_and_nothing_else(old: Path, new: Path) -> None:
    change_table(results_in(new), TABLE.assign(seconds_detect=9.0))
    change_json(results_in(new), seconds={"renders": 9.0}, command="python -m harness sweep smoke")
    (results_in(new) / "journal").mkdir()
    (results_in(new) / "journal" / "1.jsonl").write_text("{}")
    assert differences_of(old, new) == {}
    change_table(results_in(new), TABLE.assign(seconds_detect=9.0, hole=[1, 3]))
    assert differences_of(old, new).keys() == {"summary.csv", "summary.parquet"}


def test_an_exception_of_text_hides_only_its_part(old: Path, new: Path) -> None:
    exception = compare_results.ExpectedDifference("text", "*.html", "[0-9]+ of", "a test")
    report = results_in(new) / "report.html"
    report.write_text(report.read_text().replace("5 of 11", "6 of 11"))
    assert not compare_results.compare_folders(old, new, [], [exception]).differences
    report.write_text(report.read_text().replace("6 of 11", "6 of 12"))
    assert compare_results.compare_folders(old, new, [], [exception]).differences


def test_an_exception_of_text_holds_in_values_too(old: Path, new: Path) -> None:
    change_json(results_in(old), note="see python -m harness.merge")
    change_json(results_in(new), note="see tofpod merge")
    assert differences_of(old, new) == {}
    change_json(results_in(new), note="see tofpod pod")
    assert differences_of(old, new).keys() == {"provenance.json"}


def test_a_column_of_a_page_may_differ_by_its_title(old: Path, new: Path) -> None:
    head = "<thead><tr><th>hole</th><th>time (s)</th></tr></thead>"
    page = f"<table>{head}<tr><td>{{}}</td><td>{{}}</td></tr></table>"
    (results_in(old) / "report.html").write_text(page.format(1, 0.2))
    (results_in(new) / "report.html").write_text(page.format(1, 0.3))
    assert differences_of(old, new) == {}
    (results_in(new) / "report.html").write_text(page.format(2, 0.2))
    assert differences_of(old, new).keys() == {"report.html"}


def test_parts_limit_the_comparison_to_folders(old: Path, new: Path) -> None:
    for folder in (old, new):
        (folder / "pod").mkdir()
        (folder / "pod" / "a90.txt").write_text(folder.name)
    assert compare_results.main([str(old), str(new), "--only", "results"]) == 0
    assert compare_results.main([str(old), str(new), "--only", "results", "pod"]) == 1
    assert compare_results.main([str(old), str(new)]) == 1
    with pytest.raises(SystemExit, match="2"):
        compare_results.main([str(old), str(new), "--only", "nowhere"])


def test_every_exception_has_a_reason() -> None:
    for exception in compare_results.EXCEPTIONS:
        assert exception.reason
        assert bool(exception.what) == (exception.kind != "file")


def test_folders_without_files_are_no_success(tmp_path: Path) -> None:
    assert compare_results.main([str(tmp_path), str(tmp_path)]) == 1


def test_an_absent_folder_is_a_mistake(old: Path) -> None:
    with pytest.raises(SystemExit, match="2"):
        compare_results.main([str(old), str(old / "nowhere")])
